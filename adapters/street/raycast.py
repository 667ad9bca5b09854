"""Exact ray casting against shapes: the street's ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.raycast_kernels import trace
from adapters.street.shapes import Kind, Shapes

LEAF_SHAPES = 4
MEDIAN_BELOW = 64  # nodes this small are not worth a careful split


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays met. distance [N]: in lengths of the ray's direction, infinite where nothing was
    met. shape [N]: -1 there. local [N, 3]: coordinates on the shape.
    """

    distance: np.ndarray
    shape: np.ndarray
    local: np.ndarray


@dataclass(frozen=True, eq=False)
class Tree:
    """A bounding volume hierarchy over shapes, flat and depth first (see `raycast_kernels`)."""

    bounds: np.ndarray
    first: np.ndarray
    count: np.ndarray
    order: np.ndarray
    kind: np.ndarray
    origin: np.ndarray
    inverse: np.ndarray

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Nearest shape along each ray; origins and directions [N, 3]."""
        return self._trace(origins, directions, np.full(len(directions), np.inf), False)

    def occluded(
        self, origins: np.ndarray, directions: np.ndarray, limit: float = np.inf
    ) -> np.ndarray:
        """Whether anything stands within `limit` direction lengths of each ray's origin, [N]."""
        return self._trace(origins, directions, np.full(len(directions), limit), True).shape >= 0

    def _trace(
        self, origins: np.ndarray, directions: np.ndarray, limits: np.ndarray, any_hit: bool
    ) -> Hits:
        rays = len(directions)
        hits = Hits(np.empty(rays), np.empty(rays, np.int64), np.empty((rays, 3)))
        trace(
            np.ascontiguousarray(np.broadcast_to(origins, (rays, 3)), np.float64),
            np.ascontiguousarray(directions, np.float64),
            limits,
            any_hit,
            self.bounds,
            self.first,
            self.count,
            self.order,
            self.kind,
            self.origin,
            self.inverse,
            hits.distance,
            hits.shape,
            hits.local,
        )
        return hits


def bounds_of(shapes: Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners [P, 3] of each shape."""
    u, v, w = (shapes.axes[:, i] for i in range(3))
    kind = shapes.kind[:, None]
    round_flat = np.sqrt(u**2 + v**2)
    reach = np.where(kind == Kind.DISC, round_flat, 0.0)
    reach = np.where(kind == Kind.CYLINDER, round_flat + np.abs(w), reach)
    reach = np.where(kind == Kind.ELLIPSOID, np.sqrt(u**2 + v**2 + w**2), reach)
    straight = kind <= Kind.TRIANGLE
    corners = [np.zeros_like(u), np.where(straight, u, 0), np.where(straight, v, 0)]
    corners.append(np.where(kind == Kind.PARALLELOGRAM, u + v, 0))
    low = shapes.origin + np.min(corners, axis=0) - reach
    high = shapes.origin + np.max(corners, axis=0) + reach
    return low, high


def build_tree(shapes: Shapes) -> Tree:
    """Large nodes split where the surface-area heuristic is least, small ones at the median."""
    low, high = bounds_of(shapes)
    pad = 1e-6  # flat shapes have boxes without thickness, which rounding could miss
    low, high = low - pad, high + pad
    order = np.arange(len(shapes))
    bounds, first, count = [], [], []
    stack = [(0, len(shapes), -1)]  # range of order, and the parent whose second child this is
    while stack:
        start, stop, parent = stack.pop()
        node = len(first)
        if parent >= 0:
            first[parent] = node
        inside = order[start:stop]
        bounds.append(np.concatenate([low[inside].min(0), high[inside].max(0)]))
        if stop - start <= LEAF_SHAPES:
            first.append(start)
            count.append(stop - start)
            continue
        split = _best_split if stop - start > MEDIAN_BELOW else _median_split
        ranked, left = split(low[inside], high[inside])
        order[start:stop] = inside[ranked]
        first.append(-1)
        count.append(0)
        stack.append((start + left, stop, node))
        stack.append((start, start + left, -1))
    return Tree(
        bounds=np.array(bounds),
        first=np.array(first, np.int64),
        count=np.array(count, np.int64),
        order=order.astype(np.int64),
        kind=shapes.kind,
        origin=shapes.origin,
        inverse=np.ascontiguousarray(np.linalg.inv(shapes.axes).transpose(0, 2, 1)),
    )


def _median_split(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, int]:
    """An order of boxes and how many of them go left: halves along the longest side."""
    centres = low + high
    axis = int(np.argmax(centres.max(0) - centres.min(0)))
    return np.argsort(centres[:, axis], kind="stable"), len(low) // 2


def _best_split(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, int]:
    """As _median_split, at the least sum of count times surface area over all three axes."""
    count = len(low)
    best_cost, best = np.inf, (np.arange(count), count // 2)
    for axis in range(3):
        ranked = np.argsort(low[:, axis] + high[:, axis], kind="stable")
        a, b = low[ranked], high[ranked]
        left = _area(np.minimum.accumulate(a), np.maximum.accumulate(b))[:-1]
        right = _area(np.minimum.accumulate(a[::-1]), np.maximum.accumulate(b[::-1]))[::-1][1:]
        sizes = np.arange(1, count)
        cost = left * sizes + right * (count - sizes)
        least = int(np.argmin(cost))
        if cost[least] < best_cost:
            best_cost, best = cost[least], (ranked, least + 1)
    return best


def _area(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    x, y, z = (high - low).T
    return x * y + y * z + z * x
