"""Points between neighbouring LiDAR rings on one surface, so that each piece gets its own colour.

A splat stretched over the gap between two rings would smear one ring's colour across it. New points
are put on the straight line between neighbours that lie in each other's tangent plane, but only as
far as gaps of that class are likely to be surface.
"""

from __future__ import annotations

import numba
import numpy as np

from adapters.lidar.split import PointSet
from adapters.lidar.surfels import Surfels
from augment.semantics import SemanticClass as Class

_WIDEST_M = {
    Class.BUILDING: 1.0,
    Class.BARRIER: 0.6,
    Class.SIGN: 0.6,
    Class.VEHICLE: 0.4,
    Class.UNKNOWN: 0.4,
}
_WIDEST_OTHERWISE_M = 0.25


def bridge_gaps(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """The new points only.

    edge_m: float32 [N], distance that the points were thinned to. surfels: of the points.
    """
    widest = np.full(64, _WIDEST_OTHERWISE_M, np.float32)
    for semantic, width in _WIDEST_M.items():
        widest[semantic] = width
    a, b = _find_bridges(
        points.points,
        points.semantic,
        surfels.normals,
        surfels.major,
        surfels.neighbours,
        edge_m,
        widest,
    )
    pieces = np.ceil(
        np.linalg.norm(points.points[a] - points.points[b], axis=1) / edge_m[a]
    ).astype(np.int64)
    inner = np.maximum(pieces - 1, 0)
    pair = np.repeat(np.arange(len(a)), inner)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(inner) - inner, inner) + 1
    along = (step / pieces[pair]).astype(np.float32)[:, None]
    new = points.points[a[pair]] * (1 - along) + points.points[b[pair]] * along
    return PointSet(new, points.semantic[a[pair]])


@numba.njit(cache=True)
def _find_bridges(
    points, semantic, normals, major, index, edge_m, widest
):  # pragma: no cover - compiled
    """Pairs to join: a's nearest neighbour b to one side, where a has one on the other side too."""
    first = np.empty(4 * len(points), np.int64)
    second = np.empty(4 * len(points), np.int64)
    count = 0
    gaps, who = np.empty(4), np.empty(4, np.int64)
    for i in range(len(points)):
        n, e1 = normals[i], major[i]
        e2x = n[1] * e1[2] - n[2] * e1[1]
        e2y = n[2] * e1[0] - n[0] * e1[2]
        e2z = n[0] * e1[1] - n[1] * e1[0]
        gaps[:] = np.inf
        for j in index[i]:
            dx = points[j, 0] - points[i, 0]
            dy = points[j, 1] - points[i, 1]
            dz = points[j, 2] - points[i, 2]
            u = dx * e1[0] + dy * e1[1] + dz * e1[2]
            v = dx * e2x + dy * e2y + dz * e2z
            w = dx * n[0] + dy * n[1] + dz * n[2]
            m = normals[j]
            wj = dx * m[0] + dy * m[1] + dz * m[2]
            reach = np.sqrt(dx * dx + dy * dy + dz * dz)
            if reach < 0.5 * edge_m[i] or semantic[j] != semantic[i]:
                continue
            # Further off either tangent plane than a quarter of the way is another surface.
            if max(abs(w), abs(wj)) > 0.25 * reach:
                continue
            side = (0 if u > 0 else 1) if abs(u) >= abs(v) else (2 if v > 0 else 3)
            if reach < gaps[side]:
                gaps[side], who[side] = reach, j
        for side in range(4):
            # One of a pair of wires has nothing on its other side.
            if 1.5 * edge_m[i] < gaps[side] <= widest[semantic[i]] and gaps[side ^ 1] < np.inf:
                first[count], second[count] = i, who[side]
                count += 1
    return first[:count], second[:count]
