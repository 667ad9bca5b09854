"""Points of a part in blocks of neighbours, so that those near an eye are found by the block."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

_SQUARE_M = 0.25  # points of one square need no order among themselves
_GROUP = 32  # blocks
_MANY = 1024  # blocks, of which groups are looked at first
_BITS = 16  # of a square's number, along x and along y


@dataclass(frozen=True, eq=False)
class Blocks:
    """P points, `size` at a time in the order int32 [P]; the last block may be short.

    lows, highs [B, 3]: corners of every block's box, metres, part's frame.
    """

    size: int
    order: Int[np.ndarray, "P"]
    lows: Float[np.ndarray, "B 3"]
    highs: Float[np.ndarray, "B 3"]

    def __len__(self) -> int:
        return len(self.lows)

    def counts(self, chosen: Int[np.ndarray, "C"]) -> Int[np.ndarray, "C"]:
        """Points of the chosen blocks."""
        return np.minimum(self.size, len(self.order) - self.size * chosen)

    def near(
        self, eye_m: Float[np.ndarray, "3"], reach_m: float
    ) -> tuple[Int[np.ndarray, "C"], Float[np.ndarray, "C"]]:
        """Blocks whose boxes are nearer to the eye than that, and how near; 0 within a box."""
        if len(self) > _MANY:
            lows, highs = self._groups
            groups = np.flatnonzero(_distances(lows, highs, eye_m) < reach_m)
            some = (groups[:, None] * _GROUP + np.arange(_GROUP)).reshape(-1)
            some = some[some < len(self)]
        else:
            some = np.arange(len(self))
        distances = _distances(self.lows[some], self.highs[some], eye_m)
        inside = distances < reach_m
        return some[inside], distances[inside]

    @cached_property
    def _groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Boxes around as many blocks at a time, so that few are looked at one by one."""
        starts = np.arange(0, len(self), _GROUP)
        return np.minimum.reduceat(self.lows, starts), np.maximum.reduceat(self.highs, starts)

    def may_lie_in(self, chosen: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """bool: whether a point of each chosen block may have sides [S, 4] @ (x, y, z, 1) >= 0 in
        every row.
        """
        lows, highs = self.lows[chosen], self.highs[chosen]
        axes = sides[:, :3].T
        most = (lows + highs) / 2 @ axes + (highs - lows) / 2 @ np.abs(axes) + sides[:, 3]
        return np.logical_and.reduce(most >= 0, axis=1)

    def largest(self, values: np.ndarray) -> np.ndarray:
        """The largest of the points' values in every block."""
        if not len(self):
            return np.zeros(0, values.dtype)
        return np.maximum.reduceat(values[self.order], self.size * np.arange(len(self)))


def blocks_of(points: Float[np.ndarray, "P 3"], size: int) -> Blocks:
    """Along a curve that visits every square of the ground after its neighbours (Morton's)."""
    points = points.astype(np.float64)
    low = points[:, :2].min(0, initial=np.inf)
    squares = np.minimum((points[:, :2] - low) / _SQUARE_M, 2**_BITS - 1).astype(np.uint64)
    codes = _spread(squares[:, 0]) | (_spread(squares[:, 1]) << np.uint64(1))
    order = np.argsort(codes, kind="stable").astype(np.int32)
    starts = np.arange(0, len(points), size)
    if not len(starts):
        return Blocks(size, order, np.zeros((0, 3)), np.zeros((0, 3)))
    sorted_points = points[order]
    return Blocks(
        size,
        order,
        np.minimum.reduceat(sorted_points, starts, axis=0),
        np.maximum.reduceat(sorted_points, starts, axis=0),
    )


def _distances(lows: np.ndarray, highs: np.ndarray, eye_m: np.ndarray) -> np.ndarray:
    gaps = np.maximum(np.maximum(lows - eye_m, eye_m - highs), 0.0)
    return np.sqrt(np.einsum("ij,ij->i", gaps, gaps))


def _spread(numbers: np.ndarray) -> np.ndarray:
    """Bits of uint64 numbers below 2^16, with a zero between each and the next."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers
