"""Spray on a LiDAR sweep: it weakens echoes and sends back its own.

The model is that of fog (Hahner et al. 2021, see augment.effects.smog), with puffs that are thin
compared with their distance. The strength of a puff's echo follows from the extinction at the
densest point on the beam: backscatter times half the pulse's length, dimmed there and back.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from augment.effects.lidar.beam import Echoes, signal
from augment.effects.lidar.codes import LOST, SCATTERED
from augment.effects.smog import BACKSCATTER_MOR, CLUMPS, MOR_OPTICAL_DEPTH
from augment.effects.spray.puffs import CUT_DISTANCE2, Puffs

_GROUP_SIZE = 16  # puffs that are tested against the beams together


def spray_echoes(echoes: Echoes, puffs: Puffs, rng: np.random.Generator) -> None:
    """Weaken echoes by the puffs, and replace those that the droplets' own echoes exceed."""
    count = len(echoes.ranges_m)
    clumps = rng.standard_gamma(CLUMPS, count) / CLUMPS
    jitter = rng.standard_normal(count)
    rows = np.flatnonzero(beams_near(echoes, puffs))
    if not len(rows):
        return
    origins = echoes.origins[rows]
    directions = echoes.directions[rows]
    ends_m = echoes.air_path_m[rows]
    tau, at_m = look_through(puffs, origins, directions, ends_m)
    before, _ = look_through(puffs, origins, directions, at_m)
    extinction = extinction_at(puffs, origins + at_m[:, None] * directions)
    model = echoes.model
    backscatter = BACKSCATTER_MOR / MOR_OPTICAL_DEPTH * extinction * model.pulse_m  # 1/sr
    soft = math.pi * backscatter * np.exp(-2 * before) * clumps[rows]  # as a reflectance
    echoes.gain[rows] *= np.exp(-2 * tau)
    hard = signal(echoes.reflectance[rows] * echoes.gain[rows], np.maximum(ends_m, 1e-3))
    ranges_m = np.clip(at_m + 0.3 * jitter[rows], model.overlap_from_m, ends_m)
    wins = (signal(soft, np.maximum(ranges_m, 1e-3)) > hard) & (at_m > model.overlap_from_m)
    wins &= (soft > model.noise_reflectance(ranges_m)) & (echoes.codes[rows] != LOST)
    echoes.replace_echoes(rows[wins], ranges_m[wins], soft[wins], SCATTERED)


def beams_near(echoes: Echoes, puffs: Puffs) -> np.ndarray:
    """Return the mask [N] of the beams that pass near a puff."""
    is_near = np.zeros(len(echoes.ranges_m), bool)
    radii_m = np.sqrt(CUT_DISTANCE2) * puffs.scales_m.max(1, initial=0)
    for first in range(0, len(radii_m), _GROUP_SIZE):
        group = slice(first, first + _GROUP_SIZE)
        middle = puffs.centres_m[group].mean(0)
        distances = np.linalg.norm(puffs.centres_m[group] - middle, axis=1)
        reach = float((distances + radii_m[group]).max())
        offsets = middle - echoes.origins
        along = (offsets * echoes.directions).sum(1)
        distance2 = (offsets * offsets).sum(1) - along * along
        is_near |= (distance2 < reach**2) & (along > -reach) & (along < echoes.air_path_m + reach)
    return is_near & (echoes.ranges_m > 0)


def look_through(
    puffs: Puffs, origins: np.ndarray, directions: np.ndarray, ends_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the optical depth [M] of the puffs along beams, and the range of the densest point.

    The range is 0 for a beam without a puff. directions: unit.
    """
    tau, at_m, densest = np.zeros((3, len(ends_m)))
    for centre, whitening, extinction in zip(*puffs, strict=True):
        whitened_directions = directions @ whitening.T
        starts = (centre - origins) @ whitening.T
        a = (whitened_directions * whitened_directions).sum(1)
        nearest = (whitened_directions * starts).sum(1) / a
        distance2 = (starts * starts).sum(1) - a * nearest * nearest
        extinction_at_nearest = extinction * np.exp(-distance2 / 2) * (distance2 < CUT_DISTANCE2)
        inverse_width = np.sqrt(a / 2)
        passed = erf(inverse_width * (ends_m - nearest)) + erf(inverse_width * nearest)
        tau += extinction_at_nearest * np.sqrt(math.pi / (2 * a)) * np.maximum(passed, 0)
        denser = (extinction_at_nearest > densest) & (nearest > 0) & (nearest < ends_m)
        at_m[denser] = nearest[denser]
        densest[denser] = extinction_at_nearest[denser]
    return tau, at_m


def extinction_at(puffs: Puffs, points_m: np.ndarray) -> np.ndarray:
    """Return the extinction of all puffs together at points [M, 3], 1/metre."""
    total = np.zeros(len(points_m))
    for centre, whitening, extinction in zip(*puffs, strict=True):
        offsets = (points_m - centre) @ whitening.T
        total += extinction * np.exp(-(offsets * offsets).sum(1) / 2)
    return total
