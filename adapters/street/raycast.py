"""Exact ray casting against shapes, which gives the street's ground truth.

`build_tree` makes a tree of boxes over shapes; `Tree.cast` finds the nearest shape along rays,
`Tree.occluded` tells only if there is one. The callers are `adapters.street.world`,
`adapters.street.light` and `adapters.procedural`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from adapters.street.forms import Kind, Shapes
from augment.render.cpu.jit import kernel_function, serial_kernel

# ---- Kernels: walk a tree of boxes, meet the shapes in its leaves --------------------------------
# A box [6] is (-low, high), so that it grows by six maxima. A tree is flat and depth first: boxes
# [M, 6] float64; first [M] int64: a leaf's first entry of order, or the index of an inner node's
# second child (the first child follows it); count [M] int64: shapes in a leaf, 0 for an inner node;
# order [P] int64: shapes as the leaves list them.

# Number of entries of the traversal's stack, far more than the depth of any street's tree.
STACK_SIZE = 512
# Number of bins of the surface-area heuristic along an axis.
NUM_BINS = 16
# Largest number of shapes in a leaf.
MAX_LEAF_SHAPES = 4
# Hits nearer than this are on the surface where the ray starts.
MIN_HIT_DISTANCE_M = 1e-7


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
    """Find the nearest shape, or any, along each ray. The hit_* arrays are written."""
    boxes, first, count, order = tree
    kind, shape_origin, inverse = shapes
    stack = np.empty(STACK_SIZE, np.int64)
    for ray in range(origins.shape[0]):
        o = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        d = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        nearest = limit
        shape = -1
        local = (0.0, 0.0, 0.0)
        stack[0] = 0
        top = 1
        while top > 0:
            top -= 1
            node = stack[top]
            if count[node] == 0:
                first_child = node + 1
                second_child = first[node]
                first_entry = _box_entry_distance(boxes[first_child], o, d, nearest)
                second_entry = _box_entry_distance(boxes[second_child], o, d, nearest)
                if second_entry < first_entry:
                    first_child, second_child, first_entry, second_entry = (
                        second_child,
                        first_child,
                        second_entry,
                        first_entry,
                    )
                if second_entry < math.inf:
                    stack[top] = second_child
                    top += 1
                if first_entry < math.inf:
                    stack[top] = first_child
                    top += 1
                continue
            for entry in range(first[node], first[node] + count[node]):
                p = order[entry]
                shape_center = shape_origin[p]
                a, b, c = _rotate(
                    inverse[p],
                    o[0] - shape_center[0],
                    o[1] - shape_center[1],
                    o[2] - shape_center[2],
                )
                da, db, dc = _rotate(inverse[p], d[0], d[1], d[2])
                t = _shape_distance(kind[p], a, b, c, da, db, dc, nearest)
                if t < nearest:
                    nearest = t
                    shape = p
                    local = (a + t * da, b + t * db, c + t * dc)
                    if any_hit:
                        top = 0
                        break
        hit_shape[ray] = shape
        hit_distance[ray] = nearest if shape >= 0 else math.inf
        hit_local[ray, 0], hit_local[ray, 1], hit_local[ray, 2] = local


@kernel_function()
def _rotate(m, x, y, z):
    """Return the product of a matrix [3, 3] and a vector (x, y, z)."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@kernel_function()
def _box_entry_distance(box, origin, direction, limit):
    """Return the distance at which a ray enters a box; infinite if it misses or starts too late."""
    entry_distance = 0.0
    exit_distance = limit
    for axis in range(3):
        o = origin[axis]
        d = direction[axis]
        a = -box[axis]
        b = box[3 + axis]
        if d == 0.0:
            if o < a or o > b:
                return math.inf
        else:
            t0 = (a - o) * (1.0 / d)
            t1 = (b - o) * (1.0 / d)
            entry_distance = max(entry_distance, min(t0, t1))
            exit_distance = min(exit_distance, max(t0, t1))
    return entry_distance if entry_distance <= exit_distance else math.inf


@kernel_function()
def _shape_distance(kind, a, b, c, da, db, dc, limit):
    """Return the distance at which a ray, in a shape's own frame, meets it.

    It is infinite if it does not.
    """
    if kind <= 2:  # flat
        if dc == 0.0:
            return math.inf
        t = -c / dc
        if t < MIN_HIT_DISTANCE_M or t >= limit:
            return math.inf
        u = a + t * da
        v = b + t * db
        if kind == 2:
            return t if u * u + v * v <= 1.0 else math.inf
        if u < 0.0 or v < 0.0:
            return math.inf
        is_inside = (u <= 1.0 and v <= 1.0) if kind == 0 else u + v <= 1.0
        return t if is_inside else math.inf
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
        if MIN_HIT_DISTANCE_M <= t < limit and (kind == 3 or abs(c + t * dc) <= 1.0):
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
    """Fill a tree, depth first, and return its number of nodes."""
    # Begin and end of a range of `order`, and the parent whose second child it is, or -1.
    ranges = np.empty((STACK_SIZE, 3), np.int64)
    ranges[0, 0] = 0
    ranges[0, 1] = len(order)
    ranges[0, 2] = -1
    num_ranges = 1
    num_nodes = 0
    scratch = np.empty(len(order), np.int64)
    boxes.fill(-math.inf)
    while num_ranges > 0:
        num_ranges -= 1
        start = ranges[num_ranges, 0]
        stop = ranges[num_ranges, 1]
        parent = ranges[num_ranges, 2]
        node = num_nodes
        num_nodes += 1
        if parent >= 0:
            first[parent] = node
        for entry in range(start, stop):
            _grow_box(boxes[node], shape_boxes[order[entry]])
        first[node] = start
        count[node] = stop - start
        if stop - start > MAX_LEAF_SHAPES:
            count[node] = 0
            middle = _split(shape_boxes, order, start, stop, scratch)
            ranges[num_ranges, 0] = middle
            ranges[num_ranges, 1] = stop
            ranges[num_ranges, 2] = node
            ranges[num_ranges + 1, 0] = start
            ranges[num_ranges + 1, 1] = middle
            ranges[num_ranges + 1, 2] = -1
            num_ranges += 2
    return num_nodes


@kernel_function()
def _grow_box(box, other):
    """Grow a box so that it encloses another one, in place."""
    # Element by element: assignments to slices, whose shapes numba checks, take long to compile.
    for side in range(6):
        box[side] = max(box[side], other[side])


@kernel_function()
def _half_box_area(box):
    """Return half of a box's surface area."""
    x = box[3] + box[0]
    y = box[4] + box[1]
    z = box[5] + box[2]
    return x * y + y * z + z * x


@kernel_function()
def _bin_of_box(box, axis, low, high):
    """Return the number of the bin between low and high that holds twice the box's centre."""
    return min(NUM_BINS - 1, int((box[3 + axis] - box[axis] - low) / (high - low) * NUM_BINS))


@kernel_function()
def _split(boxes, order, start, stop, scratch):
    """Reorder a range so that its halves cost least by the binned surface-area heuristic.

    Returns the position in `order` at which the second half begins.
    """
    best_cost = math.inf
    best_axis = -1
    best_bin = 0
    best_low = 0.0
    best_high = 0.0
    bins = np.empty((NUM_BINS, 6))
    counts = np.empty(NUM_BINS, np.int64)
    right_costs = np.empty(NUM_BINS)
    running_box = np.empty(6)
    for axis in range(3):
        low = math.inf
        high = -math.inf
        for entry in range(start, stop):
            box = boxes[order[entry]]
            low = min(low, box[3 + axis] - box[axis])
            high = max(high, box[3 + axis] - box[axis])
        if high <= low:
            continue
        bins.fill(-math.inf)
        counts.fill(0)
        for entry in range(start, stop):
            b = _bin_of_box(boxes[order[entry]], axis, low, high)
            counts[b] += 1
            _grow_box(bins[b], boxes[order[entry]])
        running_box.fill(-math.inf)
        num_shapes = 0
        for b in range(NUM_BINS - 1, 0, -1):
            num_shapes += counts[b]
            _grow_box(running_box, bins[b])
            right_costs[b] = num_shapes * _half_box_area(running_box) if num_shapes > 0 else 0.0
        running_box.fill(-math.inf)
        num_shapes = 0
        for b in range(NUM_BINS - 1):
            num_shapes += counts[b]
            _grow_box(running_box, bins[b])
            if num_shapes > 0 and right_costs[b + 1] > 0:
                cost = num_shapes * _half_box_area(running_box) + right_costs[b + 1]
                if cost < best_cost:
                    best_cost = cost
                    best_axis = axis
                    best_bin = b
                    best_low = low
                    best_high = high
    if best_axis < 0:  # all centres in one place
        return (start + stop) // 2
    left_stop = start
    num_scratch = 0
    for entry in range(start, stop):
        p = order[entry]
        if _bin_of_box(boxes[p], best_axis, best_low, best_high) <= best_bin:
            order[left_stop] = p
            left_stop += 1
        else:
            scratch[num_scratch] = p
            num_scratch += 1
    for entry in range(num_scratch):
        order[left_stop + entry] = scratch[entry]
    return left_stop


# ---- The tree ------------------------------------------------------------------------------------


class Hits(NamedTuple):
    """Hits of N rays.

    Attributes:
        distance: float [N], in lengths of the ray's direction, infinite without a hit.
        shape: int [N], number of the shape, -1 without a hit.
        local: float [N, 3], local coordinates on the shape.
    """

    distance: np.ndarray
    shape: np.ndarray
    local: np.ndarray


class Tree(NamedTuple):
    """A bounding volume hierarchy over shapes, in the form that `trace` takes."""

    nodes: tuple[np.ndarray, ...]
    shapes: tuple[np.ndarray, ...]

    def cast(
        self, origins: np.ndarray, directions: np.ndarray, limit: float = np.inf, any_hit=False
    ) -> Hits:
        """Return the nearest shape, or any, along each ray.

        Args:
            origins, directions: float [N, 3]; one of them may be [3].
            limit: largest distance, in lengths of the ray's direction.
            any_hit: True for any shape instead of the nearest.
        """
        num_rays = np.broadcast_shapes(np.shape(origins), np.shape(directions))[0]
        hits = Hits(np.empty(num_rays), np.empty(num_rays, np.int64), np.empty((num_rays, 3)))
        # Copies, as `trace` would be compiled once more for arrays that cannot be written.
        ray_origins, ray_directions = (
            np.array(np.broadcast_to(v, (num_rays, 3)), np.float64, order="C")
            for v in (origins, directions)
        )
        trace(ray_origins, ray_directions, float(limit), any_hit, self.nodes, self.shapes, *hits)
        return hits

    def occluded(
        self, origins: np.ndarray, directions: np.ndarray, limit: float = np.inf
    ) -> np.ndarray:
        """Return True for rays that meet something within `limit` direction lengths, bool [N]."""
        return self.cast(origins, directions, limit, any_hit=True).shape >= 0


def build_tree(shapes: Shapes) -> Tree:
    """Build a tree split by the surface-area heuristic, down to a few shapes per leaf."""
    u, v, w = shapes.axes.transpose(1, 0, 2)
    kind = shapes.kind[:, None]
    radius = np.sqrt(u**2 + v**2)
    reach = np.where(kind == Kind.DISC, radius, 0.0)
    reach = np.where(kind == Kind.CYLINDER, radius + np.abs(w), reach)
    reach = np.where(kind == Kind.ELLIPSOID, np.sqrt(u**2 + v**2 + w**2), reach)
    is_straight = kind <= Kind.TRIANGLE
    corners = [np.zeros_like(u), np.where(is_straight, u, 0), np.where(is_straight, v, 0)]
    corners.append(np.where(kind == Kind.PARALLELOGRAM, u + v, 0))
    padding_m = 1e-6  # flat shapes have boxes without thickness, which rounding could miss
    low = shapes.origin + np.min(corners, axis=0) - reach - padding_m
    high = shapes.origin + np.max(corners, axis=0) + reach + padding_m
    max_nodes = 2 * len(shapes)
    order = np.arange(len(shapes))
    nodes = np.empty((max_nodes, 6)), np.empty(max_nodes, np.int64), np.empty(max_nodes, np.int64)
    num_nodes = build(np.concatenate([-low, high], 1), *nodes, order)
    inverse = np.ascontiguousarray(np.linalg.inv(shapes.axes).transpose(0, 2, 1))
    arrays = np.ascontiguousarray(shapes.kind), np.ascontiguousarray(shapes.origin), inverse
    return Tree((*(values[:num_nodes].copy() for values in nodes), order), arrays)
