"""Walls between LiDAR rings: the upper channels of a spinning LiDAR lie degrees apart, metres on a
building across the street. A wall is taken to go straight up from one ring to the next.
"""

from __future__ import annotations

import numba
import numpy as np

from adapters.lidar.split import PointSet
from adapters.lidar.surfels import Surfels
from augment.semantics import SemanticClass as Class

WIDEST_M = 3.0  # gaps higher than this stay open
_CELL_M, _CELL_EDGES = 0.2, 1.5  # size in plan of a column of wall
_SPARSER = 1.6  # spacing of new points in edges: what is guessed needs no detail
_UPRIGHT = 0.4  # largest upward part of an upright surface's unit normal


def fill_walls(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """The new points only, on walls, fences and boards, or without classes on any upright surface.

    edge_m: float32 [N], distance that the points were thinned to. surfels: of the points.
    """
    wall = np.isin(points.semantic, (Class.BUILDING, Class.BARRIER, Class.SIGN, Class.UNKNOWN))
    wall &= np.abs(surfels.normals[:, 2]) < _UPRIGHT
    some, edges, classes = points.points[wall], edge_m[wall], points.semantic[wall]
    if len(some) < 2:
        return PointSet(points.points[:0], points.semantic[:0])
    column = _columns(some, edges)
    order = np.lexsort((some[:, 2], column))
    return PointSet(
        *_fill(some[order], edges[order], classes[order], column[order], WIDEST_M, _SPARSER)
    )


def _columns(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """A number for the column that each point stands in, int64 [N]."""
    size = np.maximum(_CELL_M, _CELL_EDGES * edges.astype(np.float64))
    level = np.round(4 * np.log2(size)).astype(np.int64) + 64
    cell = np.floor(points[:, :2] / size[:, None]).astype(np.int64) + (1 << 23)
    return (level << 48) | (cell[:, 0] << 24) | cell[:, 1]


@numba.njit(cache=True)
def _fill(points, edges, classes, column, widest, sparser):  # pragma: no cover - compiled
    total = 0
    for i in range(len(points) - 1):
        gap = points[i + 1, 2] - points[i, 2]
        if column[i] == column[i + 1] and sparser * edges[i] < gap <= widest:
            total += int(np.ceil(gap / (sparser * edges[i]))) - 1
    out = np.empty((total, 3), np.float32)
    out_class = np.empty(total, np.int16)
    n = 0
    for i in range(len(points) - 1):
        gap = points[i + 1, 2] - points[i, 2]
        if column[i] == column[i + 1] and sparser * edges[i] < gap <= widest:
            pieces = int(np.ceil(gap / (sparser * edges[i])))
            for k in range(1, pieces):
                f = np.float32(k / pieces)
                for a in range(3):
                    out[n, a] = points[i, a] * (1 - f) + points[i + 1, a] * f
                out_class[n] = classes[i]
                n += 1
    return out, out_class
