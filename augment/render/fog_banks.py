"""Fog banks: the extinction of fog as a log-normal field that drifts with the wind.

    sigma(x, t) = sigma0(z) m(x - U t),    m = exp(s n - ln E[exp(s n)])

sigma0 is the extinction of plain fog (`augment.render.fog`), s the patchiness, U the wind, and n a
sum of octaves of gradient noise with variance 1. The field is frozen: it drifts and does not change
(Taylor 1938, "The spectrum of turbulence"). It varies along the ground alone, so a bank is a column
whose density sigma0 thins with height. The mean of m over space is 1, so sigma0 is the mean of
the field. Its logarithm is s^2 / 2 for a normal n; the noise has shorter tails, see `log_mean`.

Octaves: lacunarity 2, persistence 2^(-1/3), from E(k) ~ k^(-5/3). The first octave has the outer
scale of the field (Welch and Wielicki 1986, "The stratocumulus nature of fog"), which is ASPECT
times as long along the wind.

This file has the record and the definition in NumPy. `fog_bank_kernels` computes the same for
images and beams, and `fog_table` tabulates it for a camera.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from augment.rng import STEP_X, STEP_Y, mix, rng_for

# Number of octaves.
NUM_OCTAVES = 4
# Ratio of the scales of an octave and the next.
LACUNARITY = 2.0
# Ratio of the amplitudes of an octave and the one before it.
PERSISTENCE = 2 ** (-1 / 3)
# Length of banks along the wind over their width.
ASPECT = 2.0
# Standard deviation over the plane of one octave whose gradients have components uniform in
# [-1, 1]: the square is the mean over a square of 4 w^2 (x^2 + y^2) / 3, w the blend of a corner.
DEVIATION = 0.17612713
# ln E[exp(a g)] of one octave g of variance 1 is a^2 / 2 plus these times a^4 and a^6, to 1e-4 up
# to a = 1.2. Fitted to ten million points.
CUMULANTS = (-0.00273, -0.00056)
# Angle by which the lattice of an octave is turned against that of the one before, radians: the
# golden angle, so that no two lattices line up.
TURN_RAD = math.pi * (3 - math.sqrt(5))
# Side of the square from which the octaves' origins are drawn, lattice steps.
ORIGIN_STEPS = 4096.0


@dataclass(frozen=True)
class FogBanks:
    """Banks of a fog at one moment.

    patchiness: standard deviation s of the logarithm of the extinction.
    bank_m: width of the largest banks, metres.
    wind_from_rad: direction that the wind comes from, radians from world +x towards +y.
    drift_m: way of the field along the wind since the scene's start, metres.
    seed: seed of the field.
    origin_m: x and y of the scene world's origin in the dataset's world, metres. The field is fixed
        to the latter, so that it does not depend on which frames of a drive are opened.
    """

    patchiness: float
    bank_m: float
    wind_from_rad: float
    drift_m: float
    seed: int
    origin_m: tuple[float, float] = (0.0, 0.0)

    @property
    def finest_m(self) -> float:
        """Return the lattice step of the last octave across the wind, metres."""
        return self.bank_m / LACUNARITY ** (NUM_OCTAVES - 1)

    @property
    def lattices(self) -> np.ndarray:
        """Return the octaves, float64 [NUM_OCTAVES, 7]: lattice coordinates are M x + o.

        A row has the four numbers of M (per metre), the two of o, and the amplitude. `seeds` has
        the hashes' seeds.
        """
        rows = np.zeros((NUM_OCTAVES, 7))
        amplitudes = PERSISTENCE ** np.arange(NUM_OCTAVES)
        amplitudes *= self.patchiness / np.linalg.norm(amplitudes)
        cos = math.cos(self.wind_from_rad)
        sin = math.sin(self.wind_from_rad)
        axes = np.array([[cos, sin], [-sin, cos]])  # along the wind, and across it
        air_way_m = -self.drift_m * axes[0]  # air that comes from +x moves towards -x
        start_m = np.array(self.origin_m) - air_way_m
        steps_m = self.bank_m / LACUNARITY ** np.arange(NUM_OCTAVES)
        for octave, step_m in enumerate(steps_m):
            turn = octave * TURN_RAD
            turned = [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
            matrix = turned @ np.diag([1 / (ASPECT * step_m), 1 / step_m]) @ axes
            rows[octave, :4] = matrix.reshape(-1)
            rows[octave, 4:6] = _origins(self.seed)[0][octave] + matrix @ start_m
            rows[octave, 6] = amplitudes[octave]
        return rows

    @property
    def seeds(self) -> np.ndarray:
        """Return the seeds of the octaves' hashes, uint64 [NUM_OCTAVES]."""
        return _origins(self.seed)[1]

    @property
    def log_mean(self) -> float:
        """Return ln E[exp(s n)], which is s^2 / 2 but for the noise's shorter tails."""
        squares = np.square(self.lattices[:, 6])
        fourth, sixth = CUMULANTS
        return float((squares / 2 + fourth * squares**2 + sixth * squares**3).sum())


@functools.lru_cache(maxsize=64)
def _origins(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the origins of the octaves, lattice steps, [NUM_OCTAVES, 2], and the hashes' seeds."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(0, ORIGIN_STEPS, (NUM_OCTAVES, 2))
    return origins, rng.integers(0, 2**64, NUM_OCTAVES, np.uint64)


def bank_seed(seed: int, scene: str) -> int:
    """Return the seed of the banks of a recipe's seed in a scene; all cameras share it."""
    return int(rng_for(seed=seed, scene=scene, effect="smog.banks").integers(0, 2**62))


def bank_density(banks: FogBanks, places_m: np.ndarray) -> np.ndarray:
    """Return m, the extinction over its mean, at places.

    Args:
        banks: the banks.
        places_m: x and y of the places [N, 2], scene world, metres.
    """
    exponent = np.full(len(places_m), -banks.log_mean)
    for row, seed in zip(banks.lattices, banks.seeds, strict=True):
        exponent += row[6] * _gradient_noise(places_m @ row[:4].reshape(2, 2).T + row[4:6], seed)
    return np.exp(exponent)


def _gradient_noise(places: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Return gradient noise of variance 1 at lattice coordinates [N, 2]."""
    cells = np.floor(places)
    x, y = (places - cells).T
    columns, rows = cells.astype(np.int64).T
    fade_x, fade_y = (t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y))
    total = np.zeros(len(places))
    for i, weight_x in ((0, 1 - fade_x), (1, fade_x)):
        for j, weight_y in ((0, 1 - fade_y), (1, fade_y)):
            bits = (columns + i).astype(np.uint64) * np.uint64(STEP_X)
            bits = mix((bits + (rows + j).astype(np.uint64) * np.uint64(STEP_Y)) ^ seed)
            gx = (bits >> np.uint64(32)).astype(np.float64) * 2.0**-31 - 1
            gy = (bits & np.uint64(0xFFFFFFFF)).astype(np.float64) * 2.0**-31 - 1
            total += weight_x * weight_y * (gx * (x - i) + gy * (y - j))
    return total / DEVIATION
