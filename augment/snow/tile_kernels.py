"""Numba kernel: the cells of a plan's tiles that lie under points."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_numbers(xy, origin, side_m, tile_rows, tile_columns, sides, starts, numbers, out):
    """Numbers of the cells under points float64 [P, 2], into out int32 [P]; -1 where there is none.

    The tiles, row by row from origin: sides, starts: int64 [Y X], cells along each one's side and
    where it begins in numbers int32, a tile's cells row by row.
    """
    for p in range(xy.shape[0]):
        out[p] = -1
        x, y = (xy[p, 0] - origin[0]) / side_m, (xy[p, 1] - origin[1]) / side_m
        if not (x >= 0.0 and y >= 0.0 and x < tile_columns and y < tile_rows):  # NaN is nowhere
            continue
        column, row = math.floor(x), math.floor(y)
        tile = np.int64(row) * tile_columns + np.int64(column)
        side = sides[tile]
        if side > 0:
            i = min(np.int64((y - row) * side), side - 1)
            j = min(np.int64((x - column) * side), side - 1)
            out[p] = numbers[starts[tile] + i * side + j]
