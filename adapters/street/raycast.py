"""Exact ray casting against shapes: the street's ground truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from adapters.street.forms import Kind, Shapes
from augment.render.cpu.jit import inner, serial_kernel

# ---- Kernels: walk a tree of boxes, meet the shapes in its leaves --------------------------------
# A box [6] is (-low, high), so that it grows by six maxima. A tree is flat and depth first: boxes
# [M, 6] float64; first [M] int64: a leaf's first entry of order, or the index of an inner node's
# second child (the first child follows it); count [M] int64: shapes in a leaf, 0 for an inner node;
# order [P] int64: shapes as the leaves list them.

STACK = 512  # far deeper than the trees of any street
BINS = 16
LEAF_SHAPES = 4
NEAREST_M = 1e-7  # hits nearer than this are the surface the ray starts on


@serial_kernel
def trace(
    origins,  # [N, 3] float64
    directions,  # [N, 3] float64, any length: distances come out in their unit
    limit,  # how far to look
    any_hit,  # stop at the first shape met, whichever it is
    tree,
    shapes,  # kind [P] int8; origin [P, 3] float64; inverse [P, 3, 3] float64: q = inverse @ (point
    # - origin)
    hit_distance,  # out [N] float64: infinite where nothing is met
    hit_shape,  # out [N] int64: -1 there
    hit_local,  # out [N, 3] float64
):
    boxes, first, count, order = tree
    kind, shape_origin, inverse = shapes
    stack = np.empty(STACK, np.int64)
    for ray in range(origins.shape[0]):
        o = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        d = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        best, shape, local = limit, -1, (0.0, 0.0, 0.0)
        stack[0], top = 0, 1
        while top > 0:
            top -= 1
            node = stack[top]
            if count[node] == 0:
                near, far = node + 1, first[node]
                t0, t1 = _enter(boxes[near], o, d, best), _enter(boxes[far], o, d, best)
                if t1 < t0:
                    near, far, t0, t1 = far, near, t1, t0
                if t1 < math.inf:
                    stack[top] = far
                    top += 1
                if t0 < math.inf:
                    stack[top] = near
                    top += 1
                continue
            for entry in range(first[node], first[node] + count[node]):
                p = order[entry]
                at = shape_origin[p]
                a, b, c = _turn(inverse[p], o[0] - at[0], o[1] - at[1], o[2] - at[2])
                da, db, dc = _turn(inverse[p], d[0], d[1], d[2])
                t = _meet(kind[p], a, b, c, da, db, dc, best)
                if t < best:
                    best, shape, local = t, p, (a + t * da, b + t * db, c + t * dc)
                    if any_hit:
                        top = 0
                        break
        hit_shape[ray] = shape
        hit_distance[ray] = best if shape >= 0 else math.inf
        hit_local[ray, 0], hit_local[ray, 1], hit_local[ray, 2] = local


@inner()
def _turn(m, x, y, z):
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@inner()
def _enter(box, origin, direction, limit):
    """Distance at which a ray enters a box, infinite where it misses or starts too late."""
    low, high = 0.0, limit
    for axis in range(3):
        o, d = origin[axis], direction[axis]
        a, b = -box[axis], box[3 + axis]
        if d == 0.0:
            if o < a or o > b:
                return math.inf
        else:
            t0, t1 = (a - o) * (1.0 / d), (b - o) * (1.0 / d)
            low = max(low, min(t0, t1))
            high = min(high, max(t0, t1))
    return low if low <= high else math.inf


@inner()
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


@serial_kernel
def build(
    shape_boxes,  # [P, 6] float64
    boxes,  # out: the tree, with room for 2 P nodes
    first,  # out
    count,  # out
    order,  # in: any order of the shapes; out: as the leaves list them
):
    """Fill a tree, depth first; returns how many nodes it has."""
    todo = np.empty((STACK, 3), np.int64)  # range of order, and the parent whose second child it is
    todo[0, 0], todo[0, 1], todo[0, 2] = 0, len(order), -1
    top, nodes = 1, 0
    scratch = np.empty(len(order), np.int64)
    boxes.fill(-math.inf)
    while top > 0:
        top -= 1
        start, stop, parent = todo[top, 0], todo[top, 1], todo[top, 2]
        node = nodes
        nodes += 1
        if parent >= 0:
            first[parent] = node
        for entry in range(start, stop):
            _grow(boxes[node], shape_boxes[order[entry]])
        first[node], count[node] = start, stop - start
        if stop - start > LEAF_SHAPES:
            count[node] = 0
            middle = _split(shape_boxes, order, start, stop, scratch)
            todo[top, 0], todo[top, 1], todo[top, 2] = middle, stop, node
            todo[top + 1, 0], todo[top + 1, 1], todo[top + 1, 2] = start, middle, -1
            top += 2
    return nodes


@inner()
def _grow(box, other):
    # Element by element: assignments to slices, whose shapes numba checks, take long to compile.
    for side in range(6):
        box[side] = max(box[side], other[side])


@inner()
def _area(box):
    x, y, z = box[3] + box[0], box[4] + box[1], box[5] + box[2]
    return x * y + y * z + z * x


@inner()
def _bin(box, axis, low, high):
    """Which of the equal parts between low and high holds twice the box's centre."""
    return min(BINS - 1, int((box[3 + axis] - box[axis] - low) / (high - low) * BINS))


@inner()
def _split(boxes, order, start, stop, scratch):
    """Reorder a range so that its halves cost least by the surface-area heuristic, over bins."""
    best, best_axis, best_bin, best_low, best_high = math.inf, -1, 0, 0.0, 0.0
    bins, counts, right = np.empty((BINS, 6)), np.empty(BINS, np.int64), np.empty(BINS)
    running = np.empty(6)
    for axis in range(3):
        low, high = math.inf, -math.inf
        for entry in range(start, stop):
            box = boxes[order[entry]]
            low, high = min(low, box[3 + axis] - box[axis]), max(high, box[3 + axis] - box[axis])
        if high <= low:
            continue
        bins.fill(-math.inf)
        counts.fill(0)
        for entry in range(start, stop):
            b = _bin(boxes[order[entry]], axis, low, high)
            counts[b] += 1
            _grow(bins[b], boxes[order[entry]])
        running.fill(-math.inf)
        total = 0
        for b in range(BINS - 1, 0, -1):
            total += counts[b]
            _grow(running, bins[b])
            right[b] = total * _area(running) if total > 0 else 0.0
        running.fill(-math.inf)
        total = 0
        for b in range(BINS - 1):
            total += counts[b]
            _grow(running, bins[b])
            if total > 0 and right[b + 1] > 0:
                cost = total * _area(running) + right[b + 1]
                if cost < best:
                    best, best_axis, best_bin, best_low, best_high = cost, axis, b, low, high
    if best_axis < 0:  # all centres in one place
        return (start + stop) // 2
    left, kept = start, 0
    for entry in range(start, stop):
        p = order[entry]
        if _bin(boxes[p], best_axis, best_low, best_high) <= best_bin:
            order[left] = p
            left += 1
        else:
            scratch[kept] = p
            kept += 1
    for entry in range(kept):
        order[left + entry] = scratch[entry]
    return left


# ---- The tree ------------------------------------------------------------------------------------


class Hits(NamedTuple):
    """What N rays met. distance [N]: in lengths of the ray's direction, infinite where nothing was
    met. shape [N]: -1 there. local [N, 3]: coordinates on the shape."""

    distance: np.ndarray
    shape: np.ndarray
    local: np.ndarray


class Tree(NamedTuple):
    """A bounding volume hierarchy over shapes, as `trace` takes it."""

    nodes: tuple[np.ndarray, ...]
    shapes: tuple[np.ndarray, ...]

    def cast(
        self, origins: np.ndarray, directions: np.ndarray, limit: float = np.inf, any_hit=False
    ) -> Hits:
        """Nearest shape, or any, along each ray; origins and directions [N, 3] or, one of them,
        [3]."""
        rays = np.broadcast_shapes(np.shape(origins), np.shape(directions))[0]
        hits = Hits(np.empty(rays), np.empty(rays, np.int64), np.empty((rays, 3)))
        # Copies, as `trace` would be compiled once more for arrays that cannot be written.
        start, ahead = (
            np.array(np.broadcast_to(v, (rays, 3)), np.float64, order="C")
            for v in (origins, directions)
        )
        trace(start, ahead, float(limit), any_hit, self.nodes, self.shapes, *hits)
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
    size, order = 2 * len(shapes), np.arange(len(shapes))
    nodes = np.empty((size, 6)), np.empty(size, np.int64), np.empty(size, np.int64)
    used = build(np.concatenate([-low, high], 1), *nodes, order)
    inverse = np.ascontiguousarray(np.linalg.inv(shapes.axes).transpose(0, 2, 1))
    arrays = np.ascontiguousarray(shapes.kind), np.ascontiguousarray(shapes.origin), inverse
    return Tree((*(values[:used].copy() for values in nodes), order), arrays)
