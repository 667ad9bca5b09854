"""Numba kernel: which cells around a hole lie in one plane."""

from __future__ import annotations

import math

import numba
import numpy as np

_ROUNDS = 4
_LINE = 1e-9  # of the extents' product: cells that spread less across are in a line


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_plane(rows, columns, heights, first_m, alike_m, fewest, used, fits):
    """Slopes per column and row of the plane of most of the cells, NaN where there is none.

    rows, columns: int64 [P]. heights: float64 [P]. Cells within first_m of the median of the
    heights are taken at first, then, round by round, those within alike_m of the last plane; there
    must be `fewest` of them, not in a line. used, fits: bool [P], what the last plane was fitted to
    and what lies in it.
    """
    median = np.median(heights)
    for p in range(len(heights)):
        fits[p] = abs(heights[p] - median) < first_m
    across = along = math.nan
    for _ in range(_ROUNDS):
        n = x = y = z = 0.0
        for p in range(len(heights)):
            used[p] = fits[p]
            if used[p]:
                n, x, y, z = n + 1.0, x + columns[p], y + rows[p], z + heights[p]
        if n < fewest:
            return math.nan, math.nan
        x, y, z = x / n, y / n, z / n
        xx = xy = yy = xz = yz = 0.0
        for p in range(len(heights)):
            if used[p]:
                dx, dy, dz = columns[p] - x, rows[p] - y, heights[p] - z
                xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
                xz, yz = xz + dx * dz, yz + dy * dz
        determinant = xx * yy - xy * xy
        if determinant <= _LINE * (xx + yy) ** 2:
            return math.nan, math.nan
        across, along = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
        for p in range(len(heights)):
            level = z + across * (columns[p] - x) + along * (rows[p] - y)
            fits[p] = abs(heights[p] - level) < alike_m
    return across, along
