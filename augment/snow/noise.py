"""Noise over the plane that snow's depth and patches follow: the numpy definition.

Gradient noise (Perlin 1985) with the fade curve of Perlin 2002: every point of a lattice has a
level gradient, drawn by a hash of its integer coordinates, and the planes of a square's four
corners are blended. It is a function of the place and the seed alone, takes coordinates of any
size up to the lattice's integers, and is as often above zero as below: its median is 0.

A field is a sum of octaves, each with a lattice and a hash of its own.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

# Standard deviation of the noise over the plane where the gradients' components are uniform in
# [-1, 1]: the mean over a square of 4 w^2 (x^2 + y^2) / 3, w the blend of a corner at (0, 0).
DEVIATION = 0.17612713
MIX_A, MIX_B = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # splitmix64 (Steele et al. 2014)
STEP_X, STEP_Y = 0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F  # odd, far apart in all their bits
_SAMPLES = 1 << 17  # points that the shares of a field's values are measured at
_GOLDEN = (0.7548776662466927, 0.5698402909980532)  # plane-filling sequence (Roberts 2018)
_SPREAD_M = 5000.0  # side of the square that they fill


@dataclass(frozen=True, eq=False)
class Octaves:
    """K octaves of noise.

    turns [K, 2, 2]: lattice coordinates = turns @ (x, y) in metres. amplitudes [K]: standard
    deviation of each. lengths_m [K]: what a lattice's step measures; cells larger than half of it
    cannot show the octave, see `field_of`. seeds [K]: uint64.
    """

    turns: np.ndarray
    amplitudes: np.ndarray
    lengths_m: np.ndarray
    seeds: np.ndarray

    def __len__(self) -> int:
        return len(self.amplitudes)


def octaves_of(
    rows: Iterable[tuple[float, float]],
    rng: np.random.Generator,
    *,
    along: float = 0.0,
    stretch: float = 1.0,
) -> Octaves:
    """Octaves of the given (lattice step in metres, standard deviation) pairs.

    stretch >= 1: what the noise shows is that much shorter in the direction `along` (radians from
    +x) and longer across it. 1: every octave is turned by an angle of its own instead, so that
    their lattices do not line up.
    """
    pairs = np.array(list(rows), np.float64).reshape(-1, 2)
    count = len(pairs)
    angles = np.full(count, along) if stretch != 1 else rng.uniform(0, 2 * math.pi, count)
    cos, sin = np.cos(angles), np.sin(angles)
    turns = np.stack([cos, sin, -sin, cos], -1).reshape(count, 2, 2) / pairs[:, :1, None]
    turns *= np.array([stretch, 1 / stretch])[:, None]
    seeds = rng.integers(0, 2**64, count, np.uint64)
    return Octaves(np.ascontiguousarray(turns), pairs[:, 1].copy(), pairs[:, 0].copy(), seeds)


def mix(bits: np.ndarray) -> np.ndarray:
    """uint64 with every bit of the result hanging on every bit of the input (splitmix64)."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(MIX_A)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(MIX_B)
    return bits ^ (bits >> np.uint64(31))


def gradient_noise(u: np.ndarray, v: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Noise of unit standard deviation at lattice coordinates u, v [N], float64."""
    column, row = np.floor(u), np.floor(v)
    x, y = u - column, v - row
    fade_x, fade_y = (t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y))
    corners = []
    for j in (0, 1):
        for i in (0, 1):
            across = (column.astype(np.int64) + i).astype(np.uint64) * np.uint64(STEP_X)
            down = (row.astype(np.int64) + j).astype(np.uint64) * np.uint64(STEP_Y)
            bits = mix((across + down) ^ seed)
            gx = (bits >> np.uint64(32)).astype(np.float64) * 2.0**-31 - 1
            gy = (bits & np.uint64(0xFFFFFFFF)).astype(np.float64) * 2.0**-31 - 1
            corners.append(gx * (x - i) + gy * (y - j))
    near = corners[0] + fade_x * (corners[1] - corners[0])
    far = corners[2] + fade_x * (corners[3] - corners[2])
    return (near + fade_y * (far - near)) / DEVIATION


def field_of(
    octaves: Octaves, x_m: np.ndarray, y_m: np.ndarray, sizes_m: np.ndarray | float = 0.0
) -> np.ndarray:
    """Sum of the octaves at points [N], float64.

    sizes_m: cells that the points stand for. An octave fades between cells of a quarter of its
    lattice's step and of half of it, which would show no more than its aliases.
    """
    total = np.zeros(np.shape(x_m), np.float64)
    for k in range(len(octaves)):
        (a, b), (c, d) = octaves.turns[k]
        shown = np.clip(2 - 4 * np.asarray(sizes_m) / octaves.lengths_m[k], 0, 1)
        noise = gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, octaves.seeds[k])
        total += octaves.amplitudes[k] * shown * noise
    return total


def threshold_of(octaves: Octaves, share: float) -> float:
    """The value that the field exceeds on `share` of the plane; infinite where that is 0 or 1.

    It hangs on the octaves' steps and amplitudes alone, not on their seeds.
    """
    if share <= 0:
        return math.inf
    if share >= 1:
        return -math.inf
    values = _ordered_values(tuple(octaves.lengths_m), tuple(octaves.amplitudes))
    return float(values[min(int((1 - share) * len(values)), len(values) - 1)])


@functools.lru_cache(maxsize=8)
def _ordered_values(lengths_m: tuple[float, ...], amplitudes: tuple[float, ...]) -> np.ndarray:
    """A field's values at points spread evenly over much of the plane, in rising order."""
    octaves = octaves_of(zip(lengths_m, amplitudes, strict=True), np.random.default_rng(0))
    x_m, y_m = (np.arange(1, _SAMPLES + 1) * g % 1 * _SPREAD_M for g in _GOLDEN)
    return np.sort(field_of(octaves, x_m, y_m))
