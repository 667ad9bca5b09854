"""Kernel functions that look at eight directions at a time: the lux of lamps at places.

Lanes are eight places under one lamp, or eight lamps at one place. Kernels read a lamp from a row
of a table, float32, whose columns are named here; `augment.lamps.lamp_lanes` fills it.
"""

from __future__ import annotations

from augment.lamps.pattern_kernels import between_nodes, place_eight
from augment.lamps.vector_kernels import copies, dot
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
def pattern_of_lanes(tables, starts, texels, forward, right, up):
    """Return the values of eight patterns, each in a unit direction.

    Args:
        tables: packed patterns, float32 [K, V, U].
        starts: index of each lane's first value in the flat tables, int32 [8].
        texels: work space, int32 [8].
        forward: directions from the lamp, along the lamp's axis.
        right: the same, towards the lamp's right.
        up: the same, along the lamp's upward direction.
    """
    columns = tables.shape[2]
    u, v = place_eight(tables.shape[1], columns, forward, right, up, texels)
    for lane in range(Index(NUM_LANES)):
        texels[lane] += starts[lane]
    return between_nodes(tables, texels, 0, columns, u, v)


@kernel_function()
def lux_of_lanes(tables, starts, texels, lamp, towards, squared, per_m):
    """Return lux on surfaces that face a lamp, as `surface_light.illuminance` defines it.

    Args:
        tables: packed patterns, float32 [K, V, U].
        starts: index of each lane's first value in the flat tables, int32 [8].
        texels: work space, int32 [8].
        lamp: result of `read_lamp_lanes` or `gather_lamp_lanes`.
        towards: from the places to the lamps, metres.
        squared: their squared lengths.
        per_m: one over their lengths.
    """
    _, axis, right, up, candela, extinction, softening, _ = lamp
    away = v8.negate(per_m)
    share = pattern_of_lanes(
        tables,
        starts,
        texels,
        dot(towards, axis) * away,
        dot(towards, right) * away,
        dot(towards, up) * away,
    )
    # Air thicker than exp(-80) is black.
    path = v8.minimum(extinction * squared * per_m, copies(80))
    return candela * share / (squared + softening) * exp2_fine(path * v8.broadcast(-LOG2_E))
