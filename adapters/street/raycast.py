"""Exact ray casting against shapes: the street's ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from adapters.street.forms import Kind, Shapes

# ---- Kernels: walk a tree of boxes, meet the shapes in its leaves --------------------------------

STACK = 512  # far deeper than the trees of any street
BINS = 16
NEAREST_M = 1e-7  # hits nearer than this are the surface the ray starts on


@njit(cache=True)
def trace(
    origins,  # [N, 3] float64
    directions,  # [N, 3] float64, any length: distances come out in their unit
    limits,  # [N] float64: how far to look
    any_hit,  # stop at the first shape met, whichever it is
    nodes,  # bounds [M, 6] float64: low, high; first [M] int64: leaf: first entry of order, else
    # index of the second child; count [M] int64: shapes in a leaf, 0 for an inner node, whose first
    # child follows it
    order,  # [P] int64: shapes as the leaves list them
    shapes,  # kind [P] int8; origin [P, 3] float64; inverse [P, 3, 3] float64: q = inverse @ (point
    # - origin)
    hits,  # out: distance [N] float64, infinite, and shape [N] int64, -1, where nothing is met;
    # local [N, 3] float64
):
    node_bounds, node_first, node_count = nodes
    kind, shape_origin, inverse = shapes
    hit_distance, hit_shape, hit_local = hits
    stack = np.empty(STACK, np.int64)
    for ray in range(origins.shape[0]):
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        ix = 1.0 / dx if dx != 0.0 else math.inf
        iy = 1.0 / dy if dy != 0.0 else math.inf
        iz = 1.0 / dz if dz != 0.0 else math.inf
        best = limits[ray]
        shape = -1
        bu = bv = bw = 0.0
        top = 0
        if _enter(node_bounds, 0, ox, oy, oz, dx, dy, dz, ix, iy, iz, best) < math.inf:
            stack[0] = 0
            top = 1
        while top > 0:
            top -= 1
            node = stack[top]
            count = node_count[node]
            if count == 0:
                near, far = node + 1, node_first[node]
                t0 = _enter(node_bounds, near, ox, oy, oz, dx, dy, dz, ix, iy, iz, best)
                t1 = _enter(node_bounds, far, ox, oy, oz, dx, dy, dz, ix, iy, iz, best)
                if t1 < t0:
                    near, far = far, near
                    t0, t1 = t1, t0
                if t1 < math.inf:
                    stack[top] = far
                    top += 1
                if t0 < math.inf:
                    stack[top] = near
                    top += 1
                continue
            for entry in range(node_first[node], node_first[node] + count):
                p = order[entry]
                at = shape_origin[p]
                px, py, pz = ox - at[0], oy - at[1], oz - at[2]
                m = inverse[p]
                a = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz
                b = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz
                c = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz
                da = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
                db = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
                dc = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
                t = _meet(kind[p], a, b, c, da, db, dc, best)
                if t < best:
                    best = t
                    shape = p
                    bu, bv, bw = a + t * da, b + t * db, c + t * dc
                    if any_hit:
                        top = 0
                        break
        hit_shape[ray] = shape
        hit_distance[ray] = best if shape >= 0 else math.inf
        hit_local[ray, 0], hit_local[ray, 1], hit_local[ray, 2] = bu, bv, bw


@njit(cache=True)
def _enter(bounds, node, ox, oy, oz, dx, dy, dz, ix, iy, iz, limit):
    """Distance at which a ray enters a node's box, infinite where it misses or starts too late."""
    low, high = 0.0, limit
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        i = ix if axis == 0 else (iy if axis == 1 else iz)
        a, b = bounds[node, axis], bounds[node, 3 + axis]
        if d == 0.0:
            if o < a or o > b:
                return math.inf
        else:
            t0, t1 = (a - o) * i, (b - o) * i
            if t1 < t0:
                t0, t1 = t1, t0
            low = max(low, t0)
            high = min(high, t1)
    return low if low <= high else math.inf


@njit(cache=True)
def _meet(kind, a, b, c, da, db, dc, limit):
    """Distance at which a ray, in a shape's own frame, meets it; infinite where it does not."""
    if kind <= 2:  # flat
        if dc == 0.0:
            return math.inf
        t = -c / dc
        if t < NEAREST_M or t >= limit:
            return math.inf
        u, v = a + t * da, b + t * db
        if kind == 2:
            return t if u * u + v * v <= 1.0 else math.inf
        if u < 0.0 or v < 0.0:
            return math.inf
        inside = (u <= 1.0 and v <= 1.0) if kind == 0 else u + v <= 1.0
        return t if inside else math.inf
    qa = da * da + db * db
    qb = a * da + b * db
    qc = a * a + b * b - 1.0
    if kind == 3:
        qa += dc * dc
        qb += c * dc
        qc += c * c
    root = qb * qb - qa * qc
    if qa == 0.0 or root < 0.0:
        return math.inf
    root = math.sqrt(root)
    for side in range(2):
        t = (-qb - root) / qa if side == 0 else (-qb + root) / qa
        if NEAREST_M <= t < limit and (kind == 3 or abs(c + t * dc) <= 1.0):
            return t
    return math.inf


@njit(cache=True)
def build(
    low,  # [P, 3] float64: the shapes' boxes
    high,  # [P, 3]
    leaf_shapes,  # most shapes of a leaf
    order,  # [P] int64 in and out: any order of the shapes; afterwards as the leaves list them
    node_bounds,  # [2 P, 6] out
    node_first,  # [2 P] int64 out
    node_count,  # [2 P] int64 out
):
    """Fill a tree as `trace` reads it, depth first; returns how many nodes it has."""
    todo = np.empty((STACK, 3), np.int64)  # range of order, and the parent whose second child it is
    todo[0, 0], todo[0, 1], todo[0, 2] = 0, len(order), -1
    top, nodes = 1, 0
    scratch = np.empty(len(order), np.int64)
    while top > 0:
        top -= 1
        start, stop, parent = todo[top, 0], todo[top, 1], todo[top, 2]
        node = nodes
        nodes += 1
        if parent >= 0:
            node_first[parent] = node
        bounds = node_bounds[node]
        _empty(bounds)
        for entry in range(start, stop):
            _grow(bounds, low[order[entry]], high[order[entry]])
        if stop - start <= leaf_shapes:
            node_first[node], node_count[node] = start, stop - start
            continue
        node_count[node] = 0
        middle = _split(low, high, order, start, stop, scratch)
        todo[top, 0], todo[top, 1], todo[top, 2] = middle, stop, node
        todo[top + 1, 0], todo[top + 1, 1], todo[top + 1, 2] = start, middle, -1
        top += 2
    return nodes


# Element by element: assignments to slices, whose shapes numba checks, take seconds to compile.
@njit(cache=True)
def _empty(bounds):
    for axis in range(3):
        bounds[axis], bounds[3 + axis] = math.inf, -math.inf


@njit(cache=True)
def _grow(bounds, low, high):
    for axis in range(3):
        bounds[axis] = min(bounds[axis], low[axis])
        bounds[3 + axis] = max(bounds[3 + axis], high[axis])


@njit(cache=True)
def _area(bounds):
    x, y, z = bounds[3] - bounds[0], bounds[4] - bounds[1], bounds[5] - bounds[2]
    return x * y + y * z + z * x


@njit(cache=True)
def _split(low, high, order, start, stop, scratch):
    """Reorder a range so that its halves cost least by the surface-area heuristic, over bins."""
    best, best_axis, best_bin = math.inf, -1, 0
    spans = np.empty((3, 2))
    boxes, counts = np.empty((BINS, 6)), np.empty(BINS, np.int64)
    right = np.empty((BINS, 2))
    running = np.empty(6)
    for axis in range(3):
        first, last = math.inf, -math.inf
        for entry in range(start, stop):
            centre = low[order[entry], axis] + high[order[entry], axis]
            first, last = min(first, centre), max(last, centre)
        spans[axis, 0], spans[axis, 1] = first, last
        if last <= first:
            continue
        for b in range(BINS):
            _empty(boxes[b])
            counts[b] = 0
        for entry in range(start, stop):
            p = order[entry]
            b = min(BINS - 1, int((low[p, axis] + high[p, axis] - first) / (last - first) * BINS))
            counts[b] += 1
            _grow(boxes[b], low[p], high[p])
        _empty(running)
        total = 0
        for b in range(BINS - 1, 0, -1):
            total += counts[b]
            _grow(running, boxes[b], boxes[b, 3:])
            right[b, 0], right[b, 1] = total, _area(running) if total > 0 else 0.0
        _empty(running)
        total = 0
        for b in range(BINS - 1):
            total += counts[b]
            _grow(running, boxes[b], boxes[b, 3:])
            if total == 0 or right[b + 1, 0] == 0:
                continue
            cost = total * _area(running) + right[b + 1, 0] * right[b + 1, 1]
            if cost < best:
                best, best_axis, best_bin = cost, axis, b
    if best_axis < 0:  # all centres in one place
        return (start + stop) // 2
    first, last = spans[best_axis, 0], spans[best_axis, 1]
    left, kept = start, 0
    for entry in range(start, stop):
        p = order[entry]
        centre = low[p, best_axis] + high[p, best_axis]
        if min(BINS - 1, int((centre - first) / (last - first) * BINS)) <= best_bin:
            order[left] = p
            left += 1
        else:
            scratch[kept] = p
            kept += 1
    for entry in range(kept):
        order[left + entry] = scratch[entry]
    return left


# ---- The tree ------------------------------------------------------------------------------------

LEAF_SHAPES = 4


class Hits(NamedTuple):
    """What N rays met. distance [N]: in lengths of the ray's direction, infinite where nothing was
    met. shape [N]: -1 there. local [N, 3]: coordinates on the shape."""

    distance: np.ndarray
    shape: np.ndarray
    local: np.ndarray


@dataclass(frozen=True, eq=False)
class Tree:
    """A bounding volume hierarchy over shapes, flat and depth first, as `trace` takes it."""

    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]
    order: np.ndarray
    shapes: tuple[np.ndarray, np.ndarray, np.ndarray]

    def cast(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        limit: float = np.inf,
        any_hit: bool = False,
    ) -> Hits:
        """Nearest shape, or any, along each ray; origins and directions [N, 3]."""
        rays = len(directions)
        hits = Hits(np.empty(rays), np.empty(rays, np.int64), np.empty((rays, 3)))
        origins = np.ascontiguousarray(np.broadcast_to(origins, (rays, 3)), np.float64)
        ahead = np.ascontiguousarray(directions, np.float64)
        limits = np.full(rays, limit)
        trace(origins, ahead, limits, any_hit, self.nodes, self.order, self.shapes, tuple(hits))
        return hits

    def occluded(
        self, origins: np.ndarray, directions: np.ndarray, limit: float = np.inf
    ) -> np.ndarray:
        """Whether anything stands within `limit` direction lengths of each ray's origin, [N]."""
        return self.cast(origins, directions, limit, any_hit=True).shape >= 0


def build_tree(shapes: Shapes) -> Tree:
    """A tree split by the surface-area heuristic, down to a few shapes a leaf."""
    u, v, w = shapes.axes.transpose(1, 0, 2)
    kind = shapes.kind[:, None]
    round_flat = np.sqrt(u**2 + v**2)
    reach = np.where(kind == Kind.DISC, round_flat, 0.0)
    reach = np.where(kind == Kind.CYLINDER, round_flat + np.abs(w), reach)
    reach = np.where(kind == Kind.ELLIPSOID, np.sqrt(u**2 + v**2 + w**2), reach)
    straight = kind <= Kind.TRIANGLE
    corners = [np.zeros_like(u), np.where(straight, u, 0), np.where(straight, v, 0)]
    corners.append(np.where(kind == Kind.PARALLELOGRAM, u + v, 0))
    pad = 1e-6  # flat shapes have boxes without thickness, which rounding could miss
    low = shapes.origin + np.min(corners, axis=0) - reach - pad
    high = shapes.origin + np.max(corners, axis=0) + reach + pad
    count = len(shapes)
    order = np.arange(count, dtype=np.int64)
    nodes = np.empty((2 * count, 6)), np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
    used = build(low, high, LEAF_SHAPES, order, *nodes)
    bounds, first, sizes = (values[:used].copy() for values in nodes)
    inverse = np.ascontiguousarray(np.linalg.inv(shapes.axes).transpose(0, 2, 1))
    return Tree((bounds, first, sizes), order, (shapes.kind, shapes.origin, inverse))
