"""Kernel functions that look at eight directions at a time: the lux of lamps at places.

Lanes are eight places under one lamp, or eight lamps at one place. Kernels read a lamp from a row
of a table, float32, whose columns are named here; `augment.lamps.lamp_lanes` fills it.
"""

from __future__ import annotations

import math

import numpy as np

from augment.lamps.pattern_kernels import COLUMN_SCALE, ROOT_OFFSET, ROW_SCALE
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel_function
from augment.render.cpu.simd import LOG2_E, exp2_fine
from augment.render.layout import NUM_LANES, Index

# Columns of a lamp's row: place, axis, right and up of the pattern along x, y and z of the caller's
# frame; candela where the pattern is 1; extinction of the air, per metre; square of the distance
# below which the lamp is no point, m2; largest candela in any direction; red, green and blue of
# luminance 1.
PLACE = 0
AXIS = 3
RIGHT = 6
UP = 9
CANDELA = 12
EXTINCTION = 13
SOFTENING = 14
PEAK = 15
COLOR = 16
NUM_COLUMNS = 19  # number of columns of a lamp's row
_ROOT = math.sqrt(ROOT_OFFSET)


@kernel_function()
def splat(number):
    """Return eight copies of a number."""
    return v8.broadcast(np.float32(number))


@kernel_function()
def dot(x, y, z, a, b, c):
    """Return the dot product of (x, y, z) and (a, b, c)."""
    return v8.fmuladd(x, a, v8.fmuladd(y, b, z * c))


@kernel_function()
def read_lamp_lanes(lamps, m):
    """Return eight copies of the first 16 columns of lamp m.

    Args:
        lamps: the table, float32 [M, NUM_COLUMNS].
        m: row of the lamp.
    """
    row = lamps[m]
    return (
        (v8.broadcast(row[0]), v8.broadcast(row[1]), v8.broadcast(row[2])),
        (v8.broadcast(row[3]), v8.broadcast(row[4]), v8.broadcast(row[5])),
        (v8.broadcast(row[6]), v8.broadcast(row[7]), v8.broadcast(row[8])),
        (v8.broadcast(row[9]), v8.broadcast(row[10]), v8.broadcast(row[11])),
        v8.broadcast(row[12]),
        v8.broadcast(row[13]),
        v8.broadcast(row[14]),
        v8.broadcast(row[15]),
    )


@kernel_function()
def column_of_lamps(lamps, rows, column):
    """Return one column of eight lamps.

    Args:
        lamps: the table, float32 [M, NUM_COLUMNS].
        rows: rows of the lamps, int32 [8].
        column: the column.
    """
    return v8.gather(lamps, rows, Index(0), Index(NUM_COLUMNS), Index(column))


@kernel_function()
def gather_lamp_lanes(lamps, rows):
    """Return the first 16 columns of eight lamps.

    Args:
        lamps: the table, float32 [M, NUM_COLUMNS].
        rows: rows of the lamps, int32 [8].
    """
    return (
        (
            column_of_lamps(lamps, rows, 0),
            column_of_lamps(lamps, rows, 1),
            column_of_lamps(lamps, rows, 2),
        ),
        (
            column_of_lamps(lamps, rows, 3),
            column_of_lamps(lamps, rows, 4),
            column_of_lamps(lamps, rows, 5),
        ),
        (
            column_of_lamps(lamps, rows, 6),
            column_of_lamps(lamps, rows, 7),
            column_of_lamps(lamps, rows, 8),
        ),
        (
            column_of_lamps(lamps, rows, 9),
            column_of_lamps(lamps, rows, 10),
            column_of_lamps(lamps, rows, 11),
        ),
        column_of_lamps(lamps, rows, 12),
        column_of_lamps(lamps, rows, 13),
        column_of_lamps(lamps, rows, 14),
        column_of_lamps(lamps, rows, 15),
    )


@kernel_function()
def _place_of_root(fold, scale):
    """Return the place of a diamond angle among the nodes, 0 to 1."""
    root = v8.sqrt(fold + splat(ROOT_OFFSET)) - splat(_ROOT)
    return root * splat(scale)


@kernel_function()
def pattern_of_lanes(tables, starts, texels, forward, right, up):
    """Return `pattern_kernels.pattern_at` of eight unit directions.

    Args:
        tables: packed patterns, float32 [K, V, U].
        starts: index of each lane's first value in the flat tables, int32 [8].
        texels: work space, int32 [8].
        forward: directions from the lamp, along the lamp's axis.
        right: the same, towards the lamp's right.
        up: the same, along the lamp's upward direction.
    """
    zero = splat(0)
    unit = splat(1)
    tiny = splat(1e-30)
    last_row = tables.shape[1] - 1
    last_column = tables.shape[2] - 1
    level = v8.sqrt(v8.fmuladd(forward, forward, right * right))
    height = v8.absolute(up)
    row = _place_of_root(height / v8.maximum(height + level, tiny), ROW_SCALE)
    row = v8.select(v8.greater(zero, up), v8.negate(row), row)
    side = v8.absolute(right)
    fold = side / v8.maximum(v8.absolute(forward) + side, tiny)
    fold = v8.select(v8.greater(zero, forward), splat(2) - fold, fold)
    column = _place_of_root(fold, COLUMN_SCALE)
    column = v8.select(v8.greater(zero, right), v8.negate(column), column)
    row = v8.minimum(v8.maximum((row + unit) * splat(0.5 * last_row), zero), splat(last_row))
    column = (column + unit) * splat(0.5 * last_column)
    column = v8.minimum(v8.maximum(column, zero), splat(last_column))
    i = v8.minimum(v8.floor(row), splat(last_row - 1))
    j = v8.minimum(v8.floor(column), splat(last_column - 1))
    v = row - i
    u = column - j
    v8.store_integers(texels, Index(0), v8.fmuladd(i, splat(last_column + 1), j))
    for lane in range(Index(NUM_LANES)):
        texels[lane] += starts[lane]
    one_on = Index(1)
    down = Index(last_column + 1)
    a = v8.gather(tables, texels, Index(0), one_on, Index(0))
    b = v8.gather(tables, texels, Index(0), one_on, one_on)
    c = v8.gather(tables, texels, Index(0), one_on, down)
    d = v8.gather(tables, texels, Index(0), one_on, down + one_on)
    below = v8.fmuladd(b - a, u, a)
    above = v8.fmuladd(d - c, u, c)
    return v8.fmuladd(above - below, v, below)


@kernel_function()
def lux_of_lanes(tables, starts, texels, lamp, dx, dy, dz, squared, per_m):
    """Return lux on surfaces that face a lamp, as `surface_light_kernels.lux_along_ray`.

    Args:
        tables: packed patterns, float32 [K, V, U].
        starts: index of each lane's first value in the flat tables, int32 [8].
        texels: work space, int32 [8].
        lamp: result of `read_lamp_lanes` or `gather_lamp_lanes`.
        dx: x from the place to the lamp, metres.
        dy: y of that.
        dz: z of that.
        squared: square of the distance, m2.
        per_m: inverse of the distance, 1 / metres.
    """
    _, axis, right, up, candela, extinction, softening, _ = lamp
    away = v8.negate(per_m)
    share = pattern_of_lanes(
        tables,
        starts,
        texels,
        dot(dx, dy, dz, axis[0], axis[1], axis[2]) * away,
        dot(dx, dy, dz, right[0], right[1], right[2]) * away,
        dot(dx, dy, dz, up[0], up[1], up[2]) * away,
    )
    # Air thicker than exp(-80) is black.
    path = v8.minimum(extinction * squared * per_m, splat(80))
    return candela * share / (squared + softening) * exp2_fine(path * v8.broadcast(-LOG2_E))
