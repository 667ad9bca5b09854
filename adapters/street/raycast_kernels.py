"""The compiled part of ray casting: walk a tree of boxes, meet the shapes in its leaves."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

STACK = 64  # deeper than any balanced tree over 2^40 shapes
NEAREST_M = 1e-7  # hits nearer than this are the surface the ray starts on


@njit(cache=True)
def trace(
    origins,  # [N, 3] float64
    directions,  # [N, 3] float64, any length: distances come out in their unit
    limits,  # [N] float64: how far to look
    any_hit,  # stop at the first shape met, whichever it is
    node_bounds,  # [M, 6] float64: low, high
    node_first,  # [M] int64: leaf: first entry of order; else: index of the second child
    node_count,  # [M] int64: shapes in a leaf; 0 for an inner node, whose first child follows it
    order,  # [P] int64: shapes as the leaves list them
    kind,  # [P] int8
    shape_origin,  # [P, 3] float64
    inverse,  # [P, 3, 3] float64: q = inverse @ (point - origin)
    hit_distance,  # [N] float64 out: infinite where nothing is met
    hit_shape,  # [N] int64 out: -1 where nothing is met
    hit_local,  # [N, 3] float64 out
):
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
                px, py, pz = (
                    ox - shape_origin[p, 0],
                    oy - shape_origin[p, 1],
                    oz - shape_origin[p, 2],
                )
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
    """Distance at which a ray, given in a shape's own frame, meets it; infinite where it does not."""
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
