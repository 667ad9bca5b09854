"""Exact ray casting against shapes: the street's ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.forms import Kind, Shapes
from adapters.street.raycast_kernels import build, trace

LEAF_SHAPES = 4


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
    """A tree split by the surface-area heuristic, down to a few shapes a leaf."""
    low, high = bounds_of(shapes)
    pad = 1e-6  # flat shapes have boxes without thickness, which rounding could miss
    count = len(shapes)
    order = np.arange(count, dtype=np.int64)
    bounds = np.empty((2 * count, 6))
    first, sizes = np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
    nodes = build(low - pad, high + pad, LEAF_SHAPES, order, bounds, first, sizes)
    return Tree(
        bounds=bounds[:nodes].copy(),
        first=first[:nodes].copy(),
        count=sizes[:nodes].copy(),
        order=order,
        kind=shapes.kind,
        origin=shapes.origin,
        inverse=np.ascontiguousarray(np.linalg.inv(shapes.axes).transpose(0, 2, 1)),
    )
