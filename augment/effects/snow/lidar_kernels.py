"""Numba kernel that finds where beams meet a layer of snow on a grid.

It runs on the calling thread alone, without the GIL: sweeps are weathered beside the renderer.
"""

from __future__ import annotations

import math

import numba
import numpy as np

# Cells a side of a block; nothing in a block is higher than its entry in `highest`.
BLOCK = 16
_NEAR_M = 0.3  # from the sensor, where nothing is looked for
_STEP_M = 1e-7


@numba.njit(nogil=True, cache=True, error_model="numpy")
def meet_layer(
    origins, directions, hits, part_from_world, circle, corner, cell, base, top, highest, slack
):
    """Shorten `hits` [N], the beams' lengths, to where they first meet the layer, in place.

    origins, directions: float64 [N, 3], world. part_from_world: [3, 4]. circle: x, y, radius,
    world, that holds the part. corner: least x and y of the grid, in the part's frame. base, top:
    float32 [H, W], the layer's underside and surface, -inf where there is none. highest [h, w]:
    of `top` in blocks. slack: how far below its underside the layer counts, for grounds that are
    not level. A beam meets the layer from above or from a side, never from below.
    """
    rows, columns = base.shape
    for i in range(len(hits)):
        end = hits[i]
        if not end > _NEAR_M:
            continue
        if not _passes(origins[i], directions[i], end, circle):
            continue
        ox = oy = oz = dx = dy = dz = 0.0
        for k in range(3):
            o, d = origins[i, k], directions[i, k]
            ox += part_from_world[0, k] * o
            oy += part_from_world[1, k] * o
            oz += part_from_world[2, k] * o
            dx += part_from_world[0, k] * d
            dy += part_from_world[1, k] * d
            dz += part_from_world[2, k] * d
        ox = (ox + part_from_world[0, 3] - corner[0]) / cell
        oy = (oy + part_from_world[1, 3] - corner[1]) / cell
        oz += part_from_world[2, 3]
        dx, dy = dx / cell, dy / cell
        first, last = _within(ox, dx, float(columns), _NEAR_M, end)
        first, last = _within(oy, dy, float(rows), first, last)
        over_x = 1.0 / dx if dx != 0.0 else np.inf
        over_y = 1.0 / dy if dy != 0.0 else np.inf
        t, is_met = first, False
        while t < last and not is_met:
            # What lies ahead: a step inside, so that a beam on a border goes on.
            inside = t + _STEP_M
            column = min(max(math.floor(ox + inside * dx), 0), columns - 1)
            row = min(max(math.floor(oy + inside * dy), 0), rows - 1)
            block_column, block_row = column // BLOCK, row // BLOCK
            leaves = min(
                _exit(ox, over_x, block_column * BLOCK, BLOCK),
                _exit(oy, over_y, block_row * BLOCK, BLOCK),
                last,
            )
            leaves = max(leaves, inside)
            ceiling = highest[block_row, block_column]
            if min(oz + t * dz, oz + leaves * dz) > ceiling:
                t = leaves
                continue
            if oz + t * dz > ceiling:  # it falls: nothing is met before it comes so low
                t = max(t, min((ceiling - oz) / dz, leaves))
            while t < leaves:
                inside = t + _STEP_M
                column = min(max(math.floor(ox + inside * dx), 0), columns - 1)
                row = min(max(math.floor(oy + inside * dy), 0), rows - 1)
                after = min(_exit(ox, over_x, column, 1), _exit(oy, over_y, row, 1), leaves)
                after = max(after, inside)
                z, surface = oz + t * dz, top[row, column]
                if z <= surface:
                    is_met = z >= base[row, column] - slack
                elif oz + after * dz < surface:
                    t, is_met = max(t, min((surface - oz) / dz, after)), True
                if is_met:
                    hits[i] = min(t, end)
                    break
                t = after


@numba.njit(nogil=True, inline="always", error_model="numpy")
def _passes(origin, direction, end, circle):
    """Whether a beam comes, seen from above, within a circle."""
    if circle[2] == np.inf:
        return True
    x, y = circle[0] - origin[0], circle[1] - origin[1]
    flat = direction[0] * direction[0] + direction[1] * direction[1]
    t = 0.0
    if flat > 0:
        t = min(max((x * direction[0] + y * direction[1]) / flat, 0.0), end)
    x, y = x - t * direction[0], y - t * direction[1]
    return x * x + y * y <= circle[2] * circle[2]


@numba.njit(nogil=True, inline="always", error_model="numpy")
def _within(o, d, size, first, last):
    """The part of a beam from first to last that lies between 0 and size along an axis."""
    if d == 0.0:
        return (first, last) if 0.0 <= o < size else (1.0, 0.0)
    a, b = -o / d, (size - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@numba.njit(nogil=True, inline="always", error_model="numpy")
def _exit(o, over_d, low, size):
    """Where a beam leaves the stretch from low to low + size along an axis."""
    if over_d == np.inf:
        return np.inf
    return ((low + size if over_d > 0.0 else low) - o) * over_d


@numba.njit(nogil=True, cache=True, error_model="numpy")
def fill_layer(centers, sizes, depths, corner, cell, base, top):
    """Enter snow of some depth on square cells [C] into a grid: the highest where several meet.

    centers [C, 3], sizes [C], depths [C]: see SnowCells; 0 is no snow. base, top: float32 [H, W],
    -inf before.
    """
    rows, columns = base.shape
    for i in range(len(depths)):
        if not depths[i] > 0:
            continue
        half = 0.5 * np.float64(sizes[i]) - 1e-4
        x, y = np.float64(centers[i, 0]) - corner[0], np.float64(centers[i, 1]) - corner[1]
        z = centers[i, 2]
        surface = z + depths[i]
        # A cell finer than the grid's counts where its middle is.
        half = half if 2 * half > cell else 0.0
        left = max(math.floor((x - half) / cell), 0)
        right = min(math.floor((x + half) / cell), columns - 1)
        low = max(math.floor((y - half) / cell), 0)
        high = min(math.floor((y + half) / cell), rows - 1)
        for row in range(low, high + 1):
            for column in range(left, right + 1):
                if surface > top[row, column]:
                    base[row, column], top[row, column] = z, surface
