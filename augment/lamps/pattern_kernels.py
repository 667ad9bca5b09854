"""Kernel functions that look up a lamp's intensity by direction.

`augment.lamps.patterns` defines the tables and holds the plain definition. Other kernels call these
functions; they are compiled into them.
"""

from __future__ import annotations

import math

from augment.lamps.vector_kernels import copies
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel_function
from augment.render.layout import Index

# Offset of the square root that spaces a table's nodes: nodes are 0.07 to 0.1 degrees apart at the
# axis, and 2 to 4 degrees apart far from it.
ROOT_OFFSET = 0.001
# Square root of that offset.
ROOT = math.sqrt(ROOT_OFFSET)
# Scale that brings the last row (straight up) to 1.
ROW_SCALE = 1.0 / (math.sqrt(1.0 + ROOT_OFFSET) - ROOT)
# Scale that brings the last column (straight back) to 1.
COLUMN_SCALE = 1.0 / (math.sqrt(2.0 + ROOT_OFFSET) - ROOT)


@kernel_function()
def pattern_at(tables, pattern, forward, right, up):
    """Return a pattern's value in a direction, bilinear between the nodes.

    Args:
        tables: packed patterns, float32 [K, V, U].
        pattern: row of the tables.
        forward: unit direction from the lamp, along the lamp's axis.
        right: the same, towards the lamp's right (axis x up).
        up: the same, along the lamp's upward direction.
    """
    last_row = tables.shape[1] - 1
    last_column = tables.shape[2] - 1
    level = math.sqrt(forward * forward + right * right)
    # The diamond angle of elevation, -1 to 1: as an angle, but without its arc functions.
    fold = abs(up) / max(abs(up) + level, 1e-30)
    row = (math.sqrt(fold + ROOT_OFFSET) - ROOT) * ROW_SCALE
    if up < 0.0:
        row = -row
    # The diamond angle of azimuth, -2 to 2.
    fold = abs(right) / max(abs(forward) + abs(right), 1e-30)
    if forward < 0.0:
        fold = 2.0 - fold
    column = (math.sqrt(fold + ROOT_OFFSET) - ROOT) * COLUMN_SCALE
    if right < 0.0:
        column = -column
    row = min(max((row + 1.0) * (0.5 * last_row), 0.0), float(last_row))
    column = min(max((column + 1.0) * (0.5 * last_column), 0.0), float(last_column))
    i = min(int(row), last_row - 1)
    j = min(int(column), last_column - 1)
    v = row - i
    u = column - j
    below = tables[pattern, i, j] * (1.0 - u) + tables[pattern, i, j + 1] * u
    above = tables[pattern, i + 1, j] * (1.0 - u) + tables[pattern, i + 1, j + 1] * u
    return below * (1.0 - v) + above * v


@kernel_function()
def place_eight(rows, columns, forward, right, up, texels):
    """Return how far eight directions are from a table's nodes, along a row and along a column.

    Args:
        rows: rows of a pattern.
        columns: columns of a pattern.
        forward: unit directions from the lamp, along its axis.
        right: the same, towards the lamp's right.
        up: the same, along the lamp's upward direction.
        texels: receives the index of each direction's node in its pattern, int32 [8].
    """
    zero = copies(0)
    unit = copies(1)
    tiny = copies(1e-30)
    offset = copies(ROOT_OFFSET)
    root = copies(ROOT)
    level = v8.sqrt(v8.fmuladd(forward, forward, right * right))
    rise = v8.absolute(up)
    fold = rise / v8.maximum(rise + level, tiny)
    row = (v8.sqrt(fold + offset) - root) * copies(ROW_SCALE)
    row = v8.select(v8.greater(zero, up), v8.negate(row), row)
    side = v8.absolute(right)
    fold = side / v8.maximum(v8.absolute(forward) + side, tiny)
    fold = v8.select(v8.greater(zero, forward), copies(2) - fold, fold)
    column = (v8.sqrt(fold + offset) - root) * copies(COLUMN_SCALE)
    column = v8.select(v8.greater(zero, right), v8.negate(column), column)
    last_row = copies(rows - 1)
    last_column = copies(columns - 1)
    row = v8.minimum(v8.maximum((row + unit) * (copies(0.5) * last_row), zero), last_row)
    column = (column + unit) * (copies(0.5) * last_column)
    column = v8.minimum(v8.maximum(column, zero), last_column)
    i = v8.floor(v8.minimum(row, last_row - unit))
    j = v8.floor(v8.minimum(column, last_column - unit))
    v8.store_integers(texels, Index(0), v8.fmuladd(i, copies(columns), j))
    return column - j, row - i


@kernel_function()
def between_nodes(tables, texels, first, columns, u, v):
    """Return values between four nodes of tables, for eight directions.

    Args:
        tables: packed patterns, which are read as a flat array.
        texels: index of each direction's node, int32 [8].
        first: what is added to these indices.
        columns: columns of a pattern.
        u: share of the way from the node to the next one of its row.
        v: share of the way from the node to the next one of its column.
    """
    below_left = v8.gather(tables, texels, Index(0), Index(1), Index(first))
    below_right = v8.gather(tables, texels, Index(0), Index(1), Index(first + 1))
    above_left = v8.gather(tables, texels, Index(0), Index(1), Index(first + columns))
    above_right = v8.gather(tables, texels, Index(0), Index(1), Index(first + columns + 1))
    below = v8.fmuladd(below_right - below_left, u, below_left)
    above = v8.fmuladd(above_right - above_left, u, above_left)
    return v8.fmuladd(above - below, v, below)


@kernel_function()
def patterns_of_eight(tables, first, rows, columns, forward, right, up, texels):
    """Return a pattern's values in eight directions, as `pattern_at` does for one.

    Args:
        tables: packed patterns, flat.
        first: index of the pattern's first value.
        rows: rows of a pattern.
        columns: columns of a pattern.
        forward: unit directions from the lamp, along its axis.
        right: the same, towards the lamp's right.
        up: the same, along the lamp's upward direction.
        texels: work space, int32 [8].
    """
    u, v = place_eight(rows, columns, forward, right, up, texels)
    return between_nodes(tables, texels, first, columns, u, v)


@kernel_function()
def intensity(tables, pattern, axis, up, dx, dy, dz):
    """Return a pattern's value in a direction of the world.

    Times `intensities_cd` it is the intensity in candela.

    Args:
        tables: packed patterns, float32 [K, V, U].
        pattern: row of the tables.
        axis: the lamp's axis: a row of `Lamps.axes`, or a tuple.
        up: the lamp's upward direction: a row of `Lamps.ups`, or a tuple.
        dx: x of the unit direction from the lamp.
        dy: y of that direction.
        dz: z of that direction.
    """
    side_x = axis[1] * up[2] - axis[2] * up[1]
    side_y = axis[2] * up[0] - axis[0] * up[2]
    side_z = axis[0] * up[1] - axis[1] * up[0]
    return pattern_at(
        tables,
        pattern,
        dx * axis[0] + dy * axis[1] + dz * axis[2],
        dx * side_x + dy * side_y + dz * side_z,
        dx * up[0] + dy * up[1] + dz * up[2],
    )
