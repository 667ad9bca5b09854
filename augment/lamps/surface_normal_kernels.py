"""Numba kernels: normals of a picture's surfaces at nodes, one in each block of pixels.

`augment.lamps.surface_normals` prepares the arrays and launches the kernels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.lamps.vector_kernels import copies
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import NUM_LANES, Index

# Distance of the nodes over which slopes are first estimated, nodes.
SLOPE_STEP = 2
# Difference between the slopes on both sides of a node, as a share of the inverse depth and a node,
# up to which both are its surface's.
SLOPE_TOLERANCE = 0.02
# Rows of the nine nodes whose normals are averaged, from the one in the middle.
MEAN_ROWS = np.array([0, -1, 1, 0, 0, -2, -2, 2, 2])
# Columns of those nodes.
MEAN_COLUMNS = np.array([0, 0, 0, -1, 1, -2, 2, -2, 2])
# Difference of inverse depths, as a share, at which a node does not light a pixel.
SAME_SURFACE = 0.08

# Cosine to the vertical from which on a node counts as ground for certain: 25 degrees.
GROUND_COSINE = 0.906
# The same, below which it does not: 40 degrees.
MIN_GROUND_COSINE = 0.766
# Share of the nodes about one that must be ground for it to be taken for ground.
MIN_NEAR_SHARE = 0.45
# Share of them from which on it is for certain.
NEAR_SHARE = 0.65
# Largest difference of its inverse depth from theirs, of theirs.
SAME_GROUND = 0.03
# Length of a mean normal below which a surface is rough, as leaves are.
MIN_SMOOTH = 0.8
# Length from which on it is smooth.
SMOOTH = 0.95
# Difference of a node's inverse depth from the window's, of that, up to which it is of one wall.
SAME_WALL = 0.02
# Nodes on each side of the middle of the window in which the normals of the ground are averaged.
GROUND_COLUMNS = 32
GROUND_ROWS = 8  # the same up and down
# Nodes on each side of the window in which most nodes are ground about one that is taken for it.
NEAR_COLUMNS = 16
NEAR_ROWS = 8  # the same up and down
# Nodes on each side of the window in which the normals of walls are averaged, all ways.
WALL_RADIUS = 24
# Planes of means over windows: x, y and z of weighted normals, then these two.
WEIGHT = 3  # plane of the weights
DEPTH = 4  # plane of the weighted inverse depths
NUM_PLANES = 5  # number of the planes
BLOCK_COLUMNS = 16  # columns of a plane that a thread averages at a time


class NodeView(NamedTuple):
    """View of the nodes."""

    lens: Any
    """1 / fx, 1 / fy, cx, cy of pixels, pixels between nodes, middle of the first node's pixel."""
    axes: Any
    """World_from_camera, [3, 3]."""
    eye: Any
    """Place of the eye, world, metres."""


@kernel_function()
def _least_slope(inverse, row, column, d_row, d_column, centre):
    """Return the change of the inverse depth per node along a direction, on the smoother side."""
    height, width = inverse.shape
    ahead = 0.0
    behind = 0.0
    has_ahead = False
    has_behind = False
    i = row + d_row * SLOPE_STEP
    j = column + d_column * SLOPE_STEP
    if i < height and j < width and inverse[i, j] > 0:
        ahead = (inverse[i, j] - centre) / SLOPE_STEP
        has_ahead = True
    i = row - d_row * SLOPE_STEP
    j = column - d_column * SLOPE_STEP
    if i >= 0 and j >= 0 and inverse[i, j] > 0:
        behind = (centre - inverse[i, j]) / SLOPE_STEP
        has_behind = True
    if has_ahead and has_behind:
        # Where both agree they share the noise; at an edge the smaller one is the surface's own.
        if abs(ahead - behind) < SLOPE_TOLERANCE * centre:
            return 0.5 * (ahead + behind)
        return ahead if abs(ahead) < abs(behind) else behind
    if has_ahead:
        return ahead
    return behind if has_behind else 0.0


@kernel
def find_slopes(inverse, view, normals):
    """Find each node's normal by the slopes of the inverse depth about it.

    A plane is linear in inverse depth: a + b x + c y = 1 / z, at unit depth (x, y). Its normal is
    along (b, c, a) in the camera.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        view: the view of the nodes.
        normals: output, unit normals towards the eye, world, float32 [h, w, 3]; 0 for the sky.
    """
    height, width = inverse.shape
    for row in prange(height):
        ifx = view.lens[0]
        ify = view.lens[1]
        step = view.lens[4]
        y = (row * step + view.lens[5] - view.lens[3]) * ify
        for column in range(width):
            centre = np.float64(inverse[row, column])
            if centre <= 0:
                for k in range(3):
                    normals[row, column, k] = 0.0
                continue
            b = _least_slope(inverse, row, column, 0, 1, centre) / (step * ifx)
            c = _least_slope(inverse, row, column, 1, 0, centre) / (step * ify)
            x = (column * step + view.lens[5] - view.lens[2]) * ifx
            a = centre - b * x - c * y
            per_length = -1.0 / math.sqrt(a * a + b * b + c * c)
            for k in range(3):
                n = view.axes[k, 0] * b + view.axes[k, 1] * c + view.axes[k, 2] * a
                normals[row, column, k] = n * per_length


@kernel
def average_normals(inverse, normals, means):
    """Average the normals of nine nodes of the same surface about each node.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        normals: result of `find_slopes`.
        means: output, means, float32 [h, w, 3]. They are as short as the normals disagree.
    """
    height, width = inverse.shape
    for row in prange(height):
        for column in range(width):
            centre = inverse[row, column]
            x = np.float32(0)
            y = np.float32(0)
            z = np.float32(0)
            count = np.float32(0)
            limit = centre * np.float32(SAME_SURFACE)
            for sample in range(9):
                i = row + MEAN_ROWS[sample]
                j = column + MEAN_COLUMNS[sample]
                if i < 0 or j < 0 or i >= height or j >= width:
                    continue
                if abs(inverse[i, j] - centre) <= limit and centre > 0:
                    x += normals[i, j, 0]
                    y += normals[i, j, 1]
                    z += normals[i, j, 2]
                    count += np.float32(1)
            share = np.float32(1) / max(count, np.float32(1))
            means[row, column, 0] = x * share
            means[row, column, 1] = y * share
            means[row, column, 2] = z * share


# ---- Means over wide windows ---------------------------------------------------------------------
# A row of nodes is read into rows of `length` numbers, a multiple of eight: x, y and z of the
# normals, then the inverse depths. Beyond the picture they are 0.


@kernel_function()
def _read_row(inverse, normals, row, length, work):
    """Enter normals and inverse depths of a row of nodes."""
    for j in range(inverse.shape[1]):
        work[j] = normals[row, j, 0]
        work[length + j] = normals[row, j, 1]
        work[2 * length + j] = normals[row, j, 2]
        work[3 * length + j] = inverse[row, j]


@kernel_function()
def _load_row(work, length, column):
    """Return normals and inverse depths of eight nodes of a row."""
    return (
        v8.load(work, Index(column)),
        v8.load(work, Index(length + column)),
        v8.load(work, Index(2 * length + column)),
        v8.load(work, Index(3 * length + column)),
    )


@kernel_function()
def _between(value, start, end):
    """Return the share of the way from a start to an end, 0 to 1, of eight numbers."""
    share = (value - copies(start)) * copies(1.0 / (end - start))
    return v8.minimum(v8.maximum(share, copies(0)), copies(1))


@kernel_function()
def _ground_weight(z):
    """Return how far eight nodes are ground, 0 to 1, by the heights of their normals."""
    return _between(z, MIN_GROUND_COSINE, GROUND_COSINE)


@kernel_function()
def _wall_weight(x, y, z):
    """Return how far eight nodes are of smooth surfaces off the ground, 0 to 1."""
    lengths = v8.sqrt(v8.fmuladd(x, x, v8.fmuladd(y, y, z * z)))
    return _between(lengths, MIN_SMOOTH, SMOOTH) * _between(z, GROUND_COSINE, MIN_GROUND_COSINE)


@kernel_function()
def _store_weighted(weighted, length, column, weight, x, y, z, inverse):
    """Store eight weighted nodes in the planes of a row."""
    v8.store(weighted, Index(column), weight * x)
    v8.store(weighted, Index(length + column), weight * y)
    v8.store(weighted, Index(2 * length + column), weight * z)
    v8.store(weighted, Index(WEIGHT * length + column), weight)
    v8.store(weighted, Index(DEPTH * length + column), weight * inverse)


@kernel_function()
def _mirrored(index, count):
    """Return the index that stands for one beyond the ends: -1 is 1, `count` is count - 2."""
    index = abs(index)
    if index >= count:
        index = 2 * (count - 1) - index
    return max(index, 0)


@kernel_function()
def _average_row(values, length, num_planes, width, is_ground, means):
    """Average the first planes of a row over windows.

    Args:
        values: planes of a row, each of `length` numbers.
        length: length of a row of numbers.
        num_planes: number of the planes.
        width: nodes of the row.
        is_ground: True for the windows of the ground, False for those of walls.
        means: output, planes as those of `values`.
    """
    for k in range(num_planes):
        # Shares of ground go on mirrored beyond the picture; all else is 0 there.
        is_mirrored = is_ground and k >= WEIGHT
        radius = WALL_RADIUS
        if is_ground:
            radius = NEAR_COLUMNS if is_mirrored else GROUND_COLUMNS
        per_node = 1.0 / (2 * radius + 1)
        start = k * length
        total = 0.0
        for j in range(-radius, radius + 1):
            at = _mirrored(j, width) if is_mirrored else j
            if 0 <= at < width:
                total += values[start + at]
        for j in range(width):
            means[start + j] = total * per_node
            ahead = j + radius + 1
            behind = j - radius
            if is_mirrored:
                ahead = _mirrored(ahead, width)
                behind = _mirrored(behind, width)
            if ahead < width:
                total += values[start + ahead]
            if behind >= 0:
                total -= values[start + behind]


@kernel_function()
def _store_planes(values, length, planes, row):
    """Store the planes of a row of nodes."""
    for k in range(NUM_PLANES):
        for j in range(length):
            planes[k, row, j] = values[k * length + j]


@kernel
def weigh_ground(inverse, normals, planes):
    """Average the nodes of each row, weighted by how far they are ground, over wide windows.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        normals: result of `average_normals`.
        planes: output, float32 [NUM_PLANES, h, length].
    """
    height, width = inverse.shape
    length = planes.shape[2]
    for row in prange(height):
        work = np.zeros(4 * length, np.float32)
        weighted = np.zeros(NUM_PLANES * length, np.float32)
        means = np.zeros(NUM_PLANES * length, np.float32)
        _read_row(inverse, normals, np.int64(row), length, work)
        for column in range(0, length, NUM_LANES):
            x, y, z, depth = _load_row(work, length, column)
            _store_weighted(weighted, length, column, _ground_weight(z), x, y, z, depth)
        for turn in range(2):
            count = NUM_PLANES if turn == 0 else WEIGHT  # normals are averaged twice
            _average_row(weighted, length, count, width, True, means)
            for k in range(count * length):
                weighted[k] = means[k]
        _store_planes(weighted, length, planes, np.int64(row))


@kernel_function()
def _average_block(values, height, radius, is_mirrored, means):
    """Average the rows of a block over windows, as `_average_row` does the nodes of a row."""
    per_node = copies(1.0 / (2 * radius + 1))
    zero = copies(0)
    for column in range(0, BLOCK_COLUMNS, NUM_LANES):
        total = zero
        for i in range(-radius, radius + 1):
            at = _mirrored(i, height) if is_mirrored else i
            if 0 <= at < height:
                total = total + v8.load(values, Index(at * BLOCK_COLUMNS + column))
        for i in range(height):
            v8.store(means, Index(i * BLOCK_COLUMNS + column), total * per_node)
            ahead = i + radius + 1
            behind = i - radius
            if is_mirrored:
                ahead = _mirrored(ahead, height)
                behind = _mirrored(behind, height)
            if ahead < height:
                total = total + v8.load(values, Index(ahead * BLOCK_COLUMNS + column))
            if behind >= 0:
                total = total - v8.load(values, Index(behind * BLOCK_COLUMNS + column))


@kernel
def average_columns(planes, is_ground):
    """Average the columns of planes over wide windows, in place.

    Args:
        planes: result of `weigh_ground` or `smooth_ground`.
        is_ground: True for the windows of the ground, False for those of walls.
    """
    height = planes.shape[1]
    num_blocks = planes.shape[2] // BLOCK_COLUMNS
    for task in prange(NUM_PLANES * num_blocks):
        k = np.int64(task) // num_blocks
        left = np.int64(task) % num_blocks * BLOCK_COLUMNS
        values = np.empty(height * BLOCK_COLUMNS, np.float32)
        means = np.empty(height * BLOCK_COLUMNS, np.float32)
        for i in range(height):
            for j in range(BLOCK_COLUMNS):
                values[i * BLOCK_COLUMNS + j] = planes[k, i, left + j]
        is_share = is_ground and k >= WEIGHT
        radius = WALL_RADIUS
        if is_ground:
            radius = NEAR_ROWS if is_share else GROUND_ROWS
        for _ in range(2 if is_ground and k < WEIGHT else 1):
            _average_block(values, height, radius, is_share, means)
            for i in range(height * BLOCK_COLUMNS):
                values[i] = means[i]
        for i in range(height):
            for j in range(BLOCK_COLUMNS):
                planes[k, i, left + j] = means[i * BLOCK_COLUMNS + j]


@kernel_function()
def _load_means(planes, row, column):
    """Return the means of eight nodes: unit normals, weights and weighted inverse depths."""
    flat = planes.reshape(planes.size)
    size = planes.shape[1] * planes.shape[2]
    at = row * planes.shape[2] + column
    x = v8.load(flat, Index(at))
    y = v8.load(flat, Index(size + at))
    z = v8.load(flat, Index(2 * size + at))
    squared = v8.fmuladd(x, x, v8.fmuladd(y, y, z * z))
    per_length = copies(1) / v8.sqrt(v8.maximum(squared, copies(1e-12)))
    return (
        x * per_length,
        y * per_length,
        z * per_length,
        v8.load(flat, Index(WEIGHT * size + at)),
        v8.load(flat, Index(DEPTH * size + at)),
    )


@kernel_function()
def _store_normals(work, length, column, x, y, z):
    """Store eight normals of a row."""
    v8.store(work, Index(column), x)
    v8.store(work, Index(length + column), y)
    v8.store(work, Index(2 * length + column), z)


@kernel_function()
def _write_row(work, length, row, normals):
    """Write the normals of a row of nodes."""
    for j in range(normals.shape[1]):
        normals[row, j, 0] = work[j]
        normals[row, j, 1] = work[length + j]
        normals[row, j, 2] = work[2 * length + j]


@kernel
def smooth_ground(inverse, normals, planes, smooth_normals):
    """Replace the normals of the ground by their mean over a window of the picture.

    Single nodes whose normals differ count as ground where most of those about them do, at about
    their depth.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        normals: result of `average_normals`.
        planes: result of `weigh_ground` and `average_columns`; receives the mean of each row's
            nodes over windows, weighted by how far they are of smooth surfaces off the ground.
        smooth_normals: output, float32 [h, w, 3].
    """
    height, width = inverse.shape
    length = planes.shape[2]
    for number in prange(height):
        row = np.int64(number)
        work = np.zeros(4 * length, np.float32)
        weighted = np.zeros(NUM_PLANES * length, np.float32)
        means = np.zeros(NUM_PLANES * length, np.float32)
        _read_row(inverse, normals, row, length, work)
        for column in range(0, length, NUM_LANES):
            x, y, z, depth = _load_row(work, length, column)
            mean_x, mean_y, mean_z, near, near_depth = _load_means(planes, row, column)
            gap = v8.absolute(depth * near - near_depth)
            is_near = v8.greater(near_depth * copies(SAME_GROUND), gap)
            near_share = _between(near, MIN_NEAR_SHARE, NEAR_SHARE)
            share = v8.maximum(_ground_weight(z), v8.select(is_near, near_share, copies(0)))
            x = v8.fmuladd(share, mean_x - x, x)
            y = v8.fmuladd(share, mean_y - y, y)
            z = v8.fmuladd(share, mean_z - z, z)
            _store_normals(work, length, column, x, y, z)
            _store_weighted(weighted, length, column, _wall_weight(x, y, z), x, y, z, depth)
        _write_row(work, length, row, smooth_normals)
        _average_row(weighted, length, NUM_PLANES, width, False, means)
        _store_planes(means, length, planes, row)


@kernel
def smooth_walls(inverse, normals, planes, smooth_normals):
    """Replace the normals of smooth surfaces off the ground by their mean over a window.

    Fronts and paint have wide bulges in the depth of splats and sweeps, which a lamp would show as
    blotches. Leaves, whose normals disagree from node to node, keep theirs; so does what stands
    before something else.

    Args:
        inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        normals: result of `smooth_ground`.
        planes: the planes of `smooth_ground` after `average_columns`.
        smooth_normals: output, float32 [h, w, 3].
    """
    length = planes.shape[2]
    for number in prange(inverse.shape[0]):
        row = np.int64(number)
        work = np.zeros(4 * length, np.float32)
        _read_row(inverse, normals, row, length, work)
        for column in range(0, length, NUM_LANES):
            x, y, z, depth = _load_row(work, length, column)
            mean_x, mean_y, mean_z, total, near_depth = _load_means(planes, row, column)
            lengths = v8.sqrt(v8.fmuladd(x, x, v8.fmuladd(y, y, z * z)))
            gap = v8.absolute(depth * total - near_depth)
            gap = gap / v8.maximum(near_depth, copies(1e-12))
            share = _wall_weight(x, y, z) * _between(gap, 2 * SAME_WALL, SAME_WALL)
            x = v8.fmuladd(share, mean_x * lengths - x, x)
            y = v8.fmuladd(share, mean_y * lengths - y, y)
            z = v8.fmuladd(share, mean_z * lengths - z, z)
            _store_normals(work, length, column, x, y, z)
        _write_row(work, length, row, smooth_normals)
