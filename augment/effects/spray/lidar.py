"""Spray on a LiDAR sweep: what of an echo comes through it, and its own.

As in fog (Hahner et al. 2021, see augment.effects.smog), but of puffs that are thin against their
distance, so that an echo's strength is the extinction where the densest of them lies on the beam:
backscatter times half the pulse's length, dimmed there and back.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from augment.effects.lidar.beam import Echoes, signal
from augment.effects.lidar.codes import LOST, SCATTERED
from augment.effects.smog import BACKSCATTER_MOR, CLUMPS, MOR_OPTICAL_DEPTH
from augment.effects.spray.puffs import CUT, Puffs

_TOGETHER = 16  # puffs that beams are looked for together


def spray_echoes(echoes: Echoes, puffs: Puffs, rng: np.random.Generator) -> None:
    """Echoes seen through the puffs, or lost to those of the droplets themselves."""
    count = len(echoes.ranges_m)
    clumps = rng.standard_gamma(CLUMPS, count) / CLUMPS
    jitter = rng.standard_normal(count)
    rows = np.flatnonzero(beams_near(echoes, puffs))
    if not len(rows):
        return
    origins = echoes.origins[rows]
    directions = echoes.directions[rows]
    ends_m = echoes.air_m[rows]
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
    echoes.replace(rows[wins], ranges_m[wins], soft[wins], SCATTERED)


def beams_near(echoes: Echoes, puffs: Puffs) -> np.ndarray:
    """Which beams pass near a puff on their way, bool [N]."""
    near = np.zeros(len(echoes.ranges_m), bool)
    radii_m = np.sqrt(CUT) * puffs.scales_m.max(1, initial=0)
    for first in range(0, len(radii_m), _TOGETHER):
        own = slice(first, first + _TOGETHER)
        middle = puffs.centres_m[own].mean(0)
        away = np.linalg.norm(puffs.centres_m[own] - middle, axis=1)
        reach = float((away + radii_m[own]).max())
        offsets = middle - echoes.origins
        along = (offsets * echoes.directions).sum(1)
        aside = (offsets * offsets).sum(1) - along * along
        near |= (aside < reach**2) & (along > -reach) & (along < echoes.air_m + reach)
    return near & (echoes.ranges_m > 0)


def look_through(
    puffs: Puffs, origins: np.ndarray, directions: np.ndarray, ends_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth [M] of the puffs along beams up to their ends, and where the densest one lies
    on each, 0 where there is none. directions: unit.
    """
    tau, at_m, densest = np.zeros((3, len(ends_m)))
    for centre, whitening, extinction in zip(*puffs, strict=True):
        ways = directions @ whitening.T
        starts = (centre - origins) @ whitening.T
        a = (ways * ways).sum(1)
        nearest = (ways * starts).sum(1) / a
        off = (starts * starts).sum(1) - a * nearest * nearest
        there = extinction * np.exp(-off / 2) * (off < CUT)
        per = np.sqrt(a / 2)
        passed = erf(per * (ends_m - nearest)) + erf(per * nearest)
        tau += there * np.sqrt(math.pi / (2 * a)) * np.maximum(passed, 0)
        denser = (there > densest) & (nearest > 0) & (nearest < ends_m)
        at_m[denser], densest[denser] = nearest[denser], there[denser]
    return tau, at_m


def extinction_at(puffs: Puffs, points_m: np.ndarray) -> np.ndarray:
    """Of all puffs together at points [M, 3], 1/metre."""
    total = np.zeros(len(points_m))
    for centre, whitening, extinction in zip(*puffs, strict=True):
        offsets = (points_m - centre) @ whitening.T
        total += extinction * np.exp(-(offsets * offsets).sum(1) / 2)
    return total
