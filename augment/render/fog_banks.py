"""Fog banks: the extinction of fog as a log-normal field that drifts with the wind.

    sigma(x, t) = sigma0(z) m(x - U t),    m = exp(s n - ln E[exp(s n)])

sigma0 is the extinction of plain fog (`augment.render.fog`), s the patchiness, U the wind, and n a
sum of octaves of gradient noise with variance 1. The field is frozen: it drifts and does not change
(Taylor 1938, "The spectrum of turbulence"). The mean of m over space is 1, so sigma0 is the mean of
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
# Odd factor of the third lattice coordinate, far from STEP_X and STEP_Y in all its bits.
STEP_Z = 0xD6E8FEB86659FD93
# Standard deviation over space of one octave whose gradients have components uniform in [-1, 1]:
# the square is the mean over a cube of 8 w^2 (x^2 + y^2 + z^2) / 3, w the blend of a corner.
DEVIATION = 0.1909436378767241
# ln E[exp(a g)] of one octave g of variance 1 is a^2 / 2 plus these times a^4 and a^6, to 1e-4 up
# to a = 1.2. Fitted to ten million points.
CUMULANTS = (-0.00836, 0.00049)
# Angle by which the lattice of an octave is turned against that of the one before, radians: the
# golden angle, so that no two lattices line up.
TURN_RAD = math.pi * (3 - math.sqrt(5))
# Side of the cube from which the octaves' origins are drawn, lattice steps.
ORIGIN_STEPS = 4096.0
# Bits of a gradient's component.
_BITS = 21


@dataclass(frozen=True)
class FogBanks:
    """Banks of a fog at one moment.

    patchiness: standard deviation s of the logarithm of the extinction.
    bank_m: width of the largest banks, metres.
    wind_from_rad: direction that the wind comes from, radians from world +x towards +y.
    drift_m: way of the field along the wind since the scene's start, metres.
    seed: seed of the field.
    """

    patchiness: float
    bank_m: float
    wind_from_rad: float
    drift_m: float
    seed: int

    @property
    def finest_m(self) -> float:
        """Return the lattice step of the last octave across the wind, metres."""
        return self.bank_m / LACUNARITY ** (NUM_OCTAVES - 1)

    @property
    def lattices(self) -> np.ndarray:
        """Return the octaves, float64 [NUM_OCTAVES, 14]: lattice coordinates are M x + o.

        A row has the nine numbers of M (per metre), the three of o, the amplitude, and an unused
        number. `seeds` has the hashes' seeds.
        """
        rows = np.zeros((NUM_OCTAVES, 14))
        amplitudes = PERSISTENCE ** np.arange(NUM_OCTAVES)
        amplitudes *= self.patchiness / np.linalg.norm(amplitudes)
        cos = math.cos(self.wind_from_rad)
        sin = math.sin(self.wind_from_rad)
        # Axes along the wind, across it and up. Air that comes from +x moves towards -x.
        axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        steps_m = self.bank_m / LACUNARITY ** np.arange(NUM_OCTAVES)
        for octave, step_m in enumerate(steps_m):
            turn = octave * TURN_RAD
            turned = np.eye(3)
            turned[:2, :2] = [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
            matrix = turned @ np.diag([1 / (ASPECT * step_m), 1 / step_m, 1 / step_m]) @ axes
            origin = _origins(self.seed)[0][octave]
            drift = matrix @ np.array([-cos, -sin, 0.0]) * self.drift_m
            rows[octave, :9] = matrix.reshape(-1)
            rows[octave, 9:12] = origin - drift
            rows[octave, 12] = amplitudes[octave]
        return rows

    @property
    def seeds(self) -> np.ndarray:
        """Return the seeds of the octaves' hashes, uint64 [NUM_OCTAVES]."""
        return _origins(self.seed)[1]

    @property
    def log_mean(self) -> float:
        """Return ln E[exp(s n)], which is s^2 / 2 but for the noise's shorter tails."""
        squares = np.square(self.lattices[:, 12])
        fourth, sixth = CUMULANTS
        return float((squares / 2 + fourth * squares**2 + sixth * squares**3).sum())


@functools.lru_cache(maxsize=64)
def _origins(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the origins of the octaves, lattice steps, [NUM_OCTAVES, 3], and the hashes' seeds."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(0, ORIGIN_STEPS, (NUM_OCTAVES, 3))
    return origins, rng.integers(0, 2**64, NUM_OCTAVES, np.uint64)


def bank_seed(seed: int, scene: str) -> int:
    """Return the seed of the banks of a recipe's seed in a scene; all cameras share it."""
    return int(rng_for(seed=seed, scene=scene, effect="smog.banks").integers(0, 2**62))


def bank_density(banks: FogBanks, points_m: np.ndarray) -> np.ndarray:
    """Return m, the extinction over its mean, at points.

    Args:
        banks: the banks.
        points_m: points [N, 3], scene world, metres.
    """
    exponent = np.full(len(points_m), -banks.log_mean)
    for row, seed in zip(banks.lattices, banks.seeds, strict=True):
        lattice = points_m @ row[:9].reshape(3, 3).T + row[9:12]
        exponent += row[12] * _gradient_noise(lattice, seed)
    return np.exp(exponent)


def _gradient_noise(points: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Return gradient noise of variance 1 at lattice coordinates [N, 3]."""
    cells = np.floor(points)
    x, y, z = (points - cells).T
    columns, rows, layers = cells.astype(np.int64).T
    fades = [t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y, z)]
    total = np.zeros(len(points))
    for corner in range(8):
        i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
        bits = (columns + i).astype(np.uint64) * np.uint64(STEP_X)
        bits += (rows + j).astype(np.uint64) * np.uint64(STEP_Y)
        bits += (layers + k).astype(np.uint64) * np.uint64(STEP_Z)
        bits = mix(bits ^ seed)
        gradients = (
            (bits >> np.uint64(shift) & np.uint64(2**_BITS - 1)).astype(np.float64)
            * 2.0 ** (1 - _BITS)
            - 1
            for shift in (0, _BITS, 2 * _BITS)
        )
        offsets = (x - i, y - j, z - k)
        value = sum(g * offset for g, offset in zip(gradients, offsets, strict=True))
        for chosen, fade in zip((i, j, k), fades, strict=True):
            value = value * (fade if chosen else 1 - fade)
        total += value
    return total / DEVIATION
