"""Gradient noise over a plane: the numpy definition of its octaves.

Gradient noise (Perlin 1985) with the fade curve of Perlin 2002. A hash of the lattice's integers
draws the gradients, so the noise is a function of the place and the seed alone; its median is 0. A
field is a sum of octaves, each with a lattice and a hash of its own. Callers: the depth of snow,
and the order in which puddles form.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from augment.rng import STEP_X, STEP_Y, mix

# Standard deviation of the noise over the plane if the gradients' components are uniform in
# [-1, 1]: the mean over a square of 4 w^2 (x^2 + y^2) / 3, w the blend of a corner at (0, 0).
DEVIATION = 0.17612713
_NUM_SAMPLES = 1 << 17  # number of points at which a field's values are measured
# Steps of a plane-filling sequence (Roberts 2018).
_GOLDEN_STEPS = (0.7548776662466927, 0.5698402909980532)
_SAMPLED_SIDE_M = 5000.0  # side of the square that the points fill


@dataclass(frozen=True, eq=False)
class Octaves:
    """K octaves of noise."""

    turns: np.ndarray  # [K, 2, 2], lattice coordinates = turns @ (x, y) in metres
    amplitudes: np.ndarray  # [K], standard deviation of each octave
    # [K], step of each lattice. Cells larger than half of it cannot show the octave, see
    # `sum_octaves`.
    lengths_m: np.ndarray
    seeds: np.ndarray  # [K], uint64

    def __len__(self) -> int:
        return len(self.amplitudes)


def draw_octaves(
    rows: Iterable[tuple[float, float]],
    rng: np.random.Generator,
    *,
    direction_rad: float = 0.0,
    stretch: float = 1.0,
) -> Octaves:
    """Draw octaves of noise.

    Args:
        rows: (lattice step in metres, standard deviation) of each octave.
        rng: random numbers.
        direction_rad: direction of the stretch, radians from +x.
        stretch: factor >= 1 by which the noise is shorter in that direction and longer across it.
            With 1, each octave is turned by a random angle instead, so that the lattices do not
            line up.
    """
    pairs = np.array(list(rows), np.float64).reshape(-1, 2)
    count = len(pairs)
    angles = np.full(count, direction_rad) if stretch != 1 else rng.uniform(0, 2 * math.pi, count)
    cos = np.cos(angles)
    sin = np.sin(angles)
    turns = np.stack([cos, sin, -sin, cos], -1).reshape(count, 2, 2) / pairs[:, :1, None]
    turns *= np.array([stretch, 1 / stretch])[:, None]
    seeds = rng.integers(0, 2**64, count, np.uint64)
    return Octaves(np.ascontiguousarray(turns), pairs[:, 1].copy(), pairs[:, 0].copy(), seeds)


def gradient_noise(u: np.ndarray, v: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Noise of unit standard deviation at lattice coordinates u, v [N], float64."""
    column = np.floor(u)
    row = np.floor(v)
    x = u - column
    y = v - row
    fade_x, fade_y = (t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y))
    corners = []
    for j in (0, 1):
        for i in (0, 1):
            column_bits = (column.astype(np.int64) + i).astype(np.uint64) * np.uint64(STEP_X)
            row_bits = (row.astype(np.int64) + j).astype(np.uint64) * np.uint64(STEP_Y)
            bits = mix((column_bits + row_bits) ^ seed)
            gx = (bits >> np.uint64(32)).astype(np.float64) * 2.0**-31 - 1
            gy = (bits & np.uint64(0xFFFFFFFF)).astype(np.float64) * 2.0**-31 - 1
            corners.append(gx * (x - i) + gy * (y - j))
    lower = corners[0] + fade_x * (corners[1] - corners[0])
    upper = corners[2] + fade_x * (corners[3] - corners[2])
    return (lower + fade_y * (upper - lower)) / DEVIATION


def sum_octaves(
    octaves: Octaves, x_m: np.ndarray, y_m: np.ndarray, sizes_m: np.ndarray | float = 0.0
) -> np.ndarray:
    """Sum the octaves at points [N], float64.

    Args:
        octaves: octaves of the noise.
        x_m: [N], world.
        y_m: [N], world.
        sizes_m: sides of the cells that the points stand for. An octave fades between cells of a
            quarter and of half its lattice's step; larger cells would show its aliases only.
    """
    total = np.zeros(np.shape(x_m), np.float64)
    for k in range(len(octaves)):
        (a, b), (c, d) = octaves.turns[k]
        visible_share = np.clip(2 - 4 * np.asarray(sizes_m) / octaves.lengths_m[k], 0, 1)
        noise = gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, octaves.seeds[k])
        total += octaves.amplitudes[k] * visible_share * noise
    return total


def find_threshold(octaves: Octaves, share: float) -> float:
    """Return the value that the field exceeds on `share` of the plane; infinite for 0 and 1.

    It depends on the octaves' steps and amplitudes alone, not on their seeds.
    """
    if share <= 0:
        return math.inf
    if share >= 1:
        return -math.inf
    values = _ordered_values(tuple(octaves.lengths_m), tuple(octaves.amplitudes))
    return float(values[min(int((1 - share) * len(values)), len(values) - 1)])


@functools.lru_cache(maxsize=8)
def _ordered_values(lengths_m: tuple[float, ...], amplitudes: tuple[float, ...]) -> np.ndarray:
    """Return a field's values at points spread evenly over much of the plane, in rising order."""
    octaves = draw_octaves(zip(lengths_m, amplitudes, strict=True), np.random.default_rng(0))
    x_m, y_m = (np.arange(1, _NUM_SAMPLES + 1) * g % 1 * _SAMPLED_SIDE_M for g in _GOLDEN_STEPS)
    return np.sort(sum_octaves(octaves, x_m, y_m))
