"""Kernel functions that look up a lamp's intensity by direction.

`augment.lamps.patterns` defines the tables and holds the plain definition. Other kernels call these
functions; they are compiled into them.
"""

from __future__ import annotations

import math

from augment.render.cpu.jit import kernel_function

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
