"""Accumulated LiDAR thinned to one point a voxel, finer near the path that was driven."""

from __future__ import annotations

import numba
import numpy as np

from adapters.lidar.split import PointSet

NEAR_M = 6.0  # voxels have their given size up to this distance from the path
# Edges grow with this power of the distance: slower than a LiDAR's spacing, because a narrow camera
# still resolves what is far ahead.
GROWTH = 0.7
_STEP = 0.5  # octaves of distance that share a size, so that points near each other share a grid
_MAX_LEVEL = 15


def thin_points(
    points: PointSet, path: np.ndarray, *, voxel_m: float
) -> tuple[PointSet, np.ndarray]:
    """The mean point and commonest class of every occupied voxel, and the voxels' edges in metres.

    path: float [P, 3], positions in the frame of the points. The edge is voxel_m within NEAR_M of
    the path and grows with the power GROWTH of the distance beyond.
    """
    if len(points) == 0:
        return points, np.zeros(0, np.float32)
    level = _levels(
        points.points, np.ascontiguousarray(path, np.float32), NEAR_M, _STEP, _MAX_LEVEL
    )
    edges = _edges(voxel_m)
    keys = _keys(points.points, level, edges)
    order = np.argsort(keys, kind="stable")
    means, classes, levels = _reduce(
        points.points[order], points.semantic[order], keys[order], level[order]
    )
    return PointSet(means, classes), edges[levels].astype(np.float32)


def edges_at(points: np.ndarray, path: np.ndarray, *, voxel_m: float) -> np.ndarray:
    """The edge that `thin_points` uses at each position, metres, float32 [N]."""
    level = _levels(
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(path, np.float32),
        NEAR_M,
        _STEP,
        _MAX_LEVEL,
    )
    return _edges(voxel_m)[level].astype(np.float32)


def coarse_sample(points: np.ndarray, cell_m: np.ndarray) -> np.ndarray:
    """Indices of one point a cell of about the given size at it (float32 [N]); int64, ascending."""
    level = np.clip(np.round(2 * np.log2(cell_m / cell_m.min())), 0, _MAX_LEVEL).astype(np.uint8)
    sizes = cell_m.min() * 2.0 ** (0.5 * np.arange(_MAX_LEVEL + 1))
    _, first = np.unique(_keys(points, level, sizes.astype(np.float64)), return_index=True)
    return np.sort(first)


def _edges(voxel_m: float) -> np.ndarray:
    return voxel_m * 2.0 ** (_STEP * GROWTH * np.arange(_MAX_LEVEL + 1))


@numba.njit(cache=True)
def _levels(points, path, near_m, step, highest):  # pragma: no cover - compiled
    out = np.empty(len(points), np.uint8)
    for i in range(len(points)):
        best = np.inf
        for j in range(len(path)):
            dx = points[i, 0] - path[j, 0]
            dy = points[i, 1] - path[j, 1]
            dz = points[i, 2] - path[j, 2]
            best = min(best, dx * dx + dy * dy + dz * dz)
        level = np.ceil(0.5 * np.log2(max(best, 1e-12) / (near_m * near_m)) / step)
        out[i] = np.uint8(min(max(level, 0.0), highest))
    return out


@numba.njit(cache=True)
def _keys(points, level, edges):  # pragma: no cover - compiled
    """4 bits of level, then 20 a coordinate: 20 km each way at the finest edge."""
    out = np.empty(len(points), np.uint64)
    mask = np.uint64((1 << 20) - 1)
    for i in range(len(points)):
        key = np.uint64(level[i])
        for axis in range(3):
            cell = np.int64(np.floor(np.float64(points[i, axis]) / edges[level[i]])) + (1 << 19)
            key = (key << np.uint64(20)) | (np.uint64(cell) & mask)
        out[i] = key
    return out


@numba.njit(cache=True)
def _reduce(points, semantic, keys, level):  # pragma: no cover - compiled
    """Runs of equal keys to their mean, commonest class (the lower of equals) and level."""
    runs = 1
    for i in range(1, len(keys)):
        runs += keys[i] != keys[i - 1]
    means = np.empty((runs, 3), np.float32)
    classes = np.empty(runs, np.int16)
    levels = np.empty(runs, np.uint8)
    votes = np.zeros(64, np.int64)
    start, run = 0, 0
    for end in range(1, len(keys) + 1):
        if end < len(keys) and keys[end] == keys[start]:
            continue
        sums = np.zeros(3)
        votes[:] = 0
        for i in range(start, end):
            for axis in range(3):
                sums[axis] += points[i, axis]
            votes[semantic[i]] += 1
        for axis in range(3):
            means[run, axis] = sums[axis] / (end - start)
        # UNKNOWN (0) wins only where nothing else was seen.
        best = 0
        for c in range(1, 64):
            if votes[c] > 0 and (best == 0 or votes[c] > votes[best]):
                best = c
        classes[run] = best
        levels[run] = level[start]
        start, run = end, run + 1
    return means, classes, levels
