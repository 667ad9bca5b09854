"""Wet ground on a LiDAR sweep: a film of water mirrors beams away, and darkens what it lies on.

Light that meets the film at an angle of incidence whose cosine is c enters with 1 - F(c), is thrown
back and forth between the ground and the film's upper side (`darkening`), and leaves towards the
sensor through the same side, wider by n^2 (Lekner and Dorf 1988):

    wet over dry = (1 - F(c))^2 / (n^2 (1 - p a))

a is the ground's albedo, the recorded reflectance over the cosine; (1 - F)^2 is its mean over the
film's slopes that face the sensor. Stones that stand out of asphalt's film are dark and mirror
little, c = 1 for them. Flat beams lose most: of the return of asphalt of 10 % that is 5, 20 and
60 m from a sensor 1.8 m high 0.48, 0.3 and 0.26 are left, of a puddle's 0.44, 0.11 and 0.02. What a
mirrored beam meets gives no echo.
"""

from __future__ import annotations

import functools

import numpy as np
import torch

from augment.effects.flood.flood import exact
from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import ATTENUATED, UNCHANGED
from augment.effects.wet.darkening import INSIDE, REFRACTION_INDEX
from augment.effects.wet.ground import WetGround
from augment.effects.wet.kernels import ASPHALT, FILM, HEIGHT, HOLLOW, OPEN, PUDDLE, RISE_X, RISE_Y

NEAR_M = 0.2  # returns as far above the ground, or below it, are of it
_STEPS = 256  # of the cosine, tabulated
_NODES = 24  # of the slopes


@functools.cache
def passed_twice(slope: float) -> np.ndarray:
    """Mean of (1 - F)^2 by the cosine of incidence, 0 to 1 evenly, [_STEPS]. slope: standard
    deviation of the film's along the beam; one of m counts as it is seen, by c + m sqrt(1 - c^2).
    """
    cosines = np.linspace(0, 1, _STEPS)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    slopes = nodes * slope
    seen = cosines[:, None] + slopes * np.sqrt(1 - cosines[:, None] ** 2)
    facing = np.clip(seen / np.sqrt(1 + slopes**2), 0, 1)
    passed = (1 - exact(torch.from_numpy(facing), REFRACTION_INDEX).numpy()) ** 2
    weights = weights * np.maximum(seen, 0)
    return (weights * passed).sum(1) / weights.sum(1)


def film_gain(cosine: np.ndarray, reflectance: np.ndarray, puddle: np.ndarray) -> np.ndarray:
    """What wet ground gives back over what it gave dry, [N]. cosine: of incidence. reflectance:
    recorded, incidence included. puddle: share of the spot that is under standing water.
    """
    at = np.linspace(0, 1, _STEPS)
    asphalt, still = (np.interp(cosine, at, passed_twice(s)) for s in (ASPHALT, PUDDLE))
    asphalt = FILM * asphalt + (1 - FILM) * passed_twice(ASPHALT)[-1]
    albedo = np.clip(reflectance / np.maximum(cosine, 1e-3), 0.0, 1.0)
    inside = REFRACTION_INDEX**2 * (1 - INSIDE * albedo)
    return (asphalt + puddle * (still - asphalt)) / inside


def wet_echoes(echoes: Echoes, ground: WetGround, wetness: float, puddles: float) -> None:
    """Dim echoes of the wet ground; not those that a surface of other weather gives."""
    own = (echoes.codes == UNCHANGED) | (echoes.codes == ATTENUATED)
    rows = np.flatnonzero(own & (echoes.ranges_m > 0))
    directions = echoes.directions[rows]
    x, y, z = (echoes.origins[rows] + echoes.ranges_m[rows, None] * directions).T
    channels = ground.at(torch.from_numpy(x), torch.from_numpy(y)).double().numpy()
    near = np.abs(z - channels[:, HEIGHT]) < NEAR_M
    wet = wetness * np.where(near, channels[:, OPEN], 0.0)
    rise = channels[:, [RISE_X, RISE_Y]]
    cosine = (rise * directions[:, :2]).sum(1) - directions[:, 2]
    cosine = np.clip(cosine / np.sqrt(1 + (rise**2).sum(1)), 0.0, 1.0)
    puddle = (channels[:, HOLLOW] > ground.puddle_level(puddles)).astype(np.float64)
    gain = film_gain(cosine, echoes.reflectance[rows], puddle)
    echoes.gain[rows] *= 1 + wet * (gain - 1)
