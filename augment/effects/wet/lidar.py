"""Dims the echoes of wet ground: a film of water mirrors beams away and darkens what it lies on.

Caller: `WetEffect.attenuate_beams`. Light that meets the film at an angle of incidence whose cosine
is c enters with 1 - F(c), is thrown back and forth between the ground and the film's upper side
(`darkening`), and leaves towards the sensor through the same side, wider by n^2 (Lekner and Dorf
1988):

    wet over dry = (1 - F(c))^2 / (n^2 (1 - p a))

- a: the ground's albedo, the recorded reflectance over the cosine.
- (1 - F)^2: its mean over the film's slopes that face the sensor.
- Stones that stand out of asphalt's film are dark and mirror little: c = 1 for them.

Flat beams lose most. Asphalt of 10 % that is 5, 20 and 60 m from a sensor 1.8 m high keeps 0.48,
0.3 and 0.26 of its return; a puddle keeps 0.44, 0.11 and 0.02. A mirrored beam gives no echo.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch

from augment.effects.flood.flood_medium import fresnel_reflectance
from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import ATTENUATED, UNCHANGED
from augment.effects.wet.darkening import INNER_REFLECTANCE, REFRACTION_INDEX
from augment.effects.wet.drying import DryingMap, RoadFilm, local_water
from augment.effects.wet.film_kernels import (
    ASPHALT_ROUGHNESS,
    EXPOSURE,
    FILM_SHARE,
    HEIGHT,
    PUDDLE_ORDER,
    PUDDLE_ROUGHNESS,
    SLOPE_X,
    SLOPE_Y,
)
from augment.effects.wet.ground_map import WetGround

MAX_GROUND_DISTANCE_M = 0.2  # distance from the ground up to which a return is of it
_NUM_COSINES = 256  # number of tabulated cosines
_NUM_NODES = 24  # number of quadrature nodes over slopes


@functools.cache
def mean_transmission(slope: float) -> np.ndarray:
    """Return the mean of (1 - F)^2 over the cosine of incidence, 0 to 1 evenly, [_NUM_COSINES].

    slope: standard deviation of the film's slopes along the beam. A slope m is weighted by the area
    that the sensor sees of it, c + m sqrt(1 - c^2).
    """
    cosines = np.linspace(0, 1, _NUM_COSINES)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NUM_NODES)
    slopes = nodes * slope
    visible_area = cosines[:, None] + slopes * np.sqrt(1 - cosines[:, None] ** 2)
    incidence_cosine = np.clip(visible_area / np.sqrt(1 + slopes**2), 0, 1)
    transmission = (
        1 - fresnel_reflectance(torch.from_numpy(incidence_cosine), REFRACTION_INDEX).numpy()
    ) ** 2
    weights = weights * np.maximum(visible_area, 0)
    return (weights * transmission).sum(1) / weights.sum(1)


def wet_echo_ratio(
    cosine: np.ndarray, reflectance: np.ndarray, puddle: np.ndarray, film: np.ndarray | float = 1.0
) -> np.ndarray:
    """Return the echo of wet ground over that of dry ground, [N].

    Args:
        cosine: [N], cosine of incidence.
        reflectance: [N], recorded, incidence included.
        puddle: [N], share of the spot that is under standing water.
        film: [N], share of a full film's mirroring area that wet asphalt has; damp stones have
            none.
    """
    cosines = np.linspace(0, 1, _NUM_COSINES)
    asphalt_transmission, puddle_transmission = (
        np.interp(cosine, cosines, mean_transmission(s))
        for s in (ASPHALT_ROUGHNESS, PUDDLE_ROUGHNESS)
    )
    film_share = FILM_SHARE * film
    asphalt_transmission = (
        film_share * asphalt_transmission
        + (1 - film_share) * mean_transmission(ASPHALT_ROUGHNESS)[-1]
    )
    albedo = np.clip(reflectance / np.maximum(cosine, 1e-3), 0.0, 1.0)
    film_factor = REFRACTION_INDEX**2 * (1 - INNER_REFLECTANCE * albedo)
    return (
        asphalt_transmission + puddle * (puddle_transmission - asphalt_transmission)
    ) / film_factor


def dim_wet_echoes(echoes: Echoes, ground: WetGround, wetness: float, puddle_share: float) -> None:
    """Dim the echoes of wet ground; echoes of other weather's surfaces stay as they are."""
    hits = _find_hits(echoes, ground)
    is_puddle = (
        hits.channels[:, PUDDLE_ORDER] > ground.find_puddle_threshold(puddle_share)
    ).astype(np.float64)
    gain = wet_echo_ratio(hits.cosine, echoes.reflectance[hits.rows], is_puddle)
    echoes.gain[hits.rows] *= 1 + wetness * hits.exposure * (gain - 1)


def dim_echoes_by_film(
    echoes: Echoes, ground: WetGround, order: DryingMap, film: RoadFilm, puddle_threshold: float
) -> None:
    """Dim the echoes of a road that gets wet or dries, by the film where each beam meets it.

    Args:
        echoes: the sweep, changed in place.
        ground: map of the ground.
        order: order in which the ground dries.
        film: water on the road.
        puddle_threshold: value of PUDDLE_ORDER above which water stands.
    """
    hits = _find_hits(echoes, ground)
    x, y = (torch.from_numpy(places) for places in (hits.x, hits.y))
    rank, puddle_order, track = ground.interpolate_values(order.channels, x, y).unbind(-1)
    puddle = (puddle_order > puddle_threshold).to(rank)
    spots = torch.full_like(rank, film.spots)
    wetness, mirror = (
        part.double().numpy() for part in local_water(film, rank, track, spots, puddle)
    )
    is_puddle = puddle.double().numpy()
    gain = wet_echo_ratio(hits.cosine, echoes.reflectance[hits.rows], is_puddle, mirror)
    echoes.gain[hits.rows] *= 1 + wetness * hits.exposure * (gain - 1)


class _Hits(NamedTuple):
    """Echoes [N] that may come from dry or wet ground."""

    rows: np.ndarray  # rows of the sweep
    x: np.ndarray  # world
    y: np.ndarray  # world
    channels: np.ndarray  # [N, NUM_CHANNELS] of the map
    exposure: np.ndarray  # how open the ground is, 0 for echoes off the ground
    cosine: np.ndarray  # cosine of incidence


def _find_hits(echoes: Echoes, ground: WetGround) -> _Hits:
    """Return the echoes that no other weather's surface sent back, and the ground there."""
    is_dry_surface = (echoes.codes == UNCHANGED) | (echoes.codes == ATTENUATED)
    rows = np.flatnonzero(is_dry_surface & (echoes.ranges_m > 0))
    directions = echoes.directions[rows]
    x, y, z = (echoes.origins[rows] + echoes.ranges_m[rows, None] * directions).T
    channels = ground.interpolate(torch.from_numpy(x), torch.from_numpy(y)).double().numpy()
    is_near = np.abs(z - channels[:, HEIGHT]) < MAX_GROUND_DISTANCE_M
    slope = channels[:, [SLOPE_X, SLOPE_Y]]
    cosine = (slope * directions[:, :2]).sum(1) - directions[:, 2]
    cosine = np.clip(cosine / np.sqrt(1 + (slope**2).sum(1)), 0.0, 1.0)
    return _Hits(rows, x, y, channels, np.where(is_near, channels[:, EXPOSURE], 0.0), cosine)
