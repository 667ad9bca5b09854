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
    # The diamond angle of elevation, -1 to 1: as an angle, but without its arc functions.
    level = v8.sqrt(v8.fmuladd(forward, forward, right * right))
    rise = v8.absolute(up)
    fold = rise / v8.maximum(rise + level, tiny)
    row = (v8.sqrt(fold + offset) - root) * copies(ROW_SCALE)
    row = v8.select(v8.greater(zero, up), v8.negate(row), row)
    # The diamond angle of azimuth, -2 to 2.
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
        tables: packed patterns or other images, which are read as a flat array.
        texels: index of each direction's node, int32 [8].
        first: what is added to these indices.
        columns: columns of a pattern or image.
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
    """Return a pattern's values in eight directions, bilinear between the nodes.

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
