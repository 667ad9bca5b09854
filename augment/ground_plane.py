"""Which points lie on the ground, where nothing is labelled: planes through low points (RANSAC).

One plane does not fit a road that bends and climbs, so each WINDOW_M of the path has its own. The
planes are open3d's; open3d is imported when they are wanted.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np

from augment.errors import BackendUnavailable
from augment.ground_heights import STRETCH_M, Stretches
from augment.render.threads import select_thread_pool

WINDOW_M = 40.0
STEEPEST_DEG = 15.0  # a plane further from level is a wall's, a hillside's or a roof's
SYSTEM_LIBRARIES = "libusb-1.0-0, libgl1, libx11-6, libgomp1"
_THRESHOLD_M = 0.1  # a road's camber and unevenness, less than a kerb
_REACHES_M = (6.0, 16.0, math.inf)  # beside the path; beyond its ends, at least _BEYOND_M
_BEYOND_M = 20.0
_CELL_M, _CELLS_A_SIDE = 0.5, 200
_LOW_QUANTILE = 0.1  # in a cell; LiDAR has stray returns below the ground, splats even more
_FEWEST, _LEAST_SHARE = 30, 0.25  # of the low points, on a plane that is believed
_ITERATIONS, _TRIES = 500, 3  # a quarter of the points on a plane: missed once in 2600 times
_SEED = 20260101


def ground_points(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Those of the points [N, 3] that lie on a nearly level plane through low ones near the path
    positions [P, 3]; in the scene's world, metres. None, float64 [0, 3], where no plane is found.

    The same points give the same result every time.

    Raises:
        BackendUnavailable: open3d, or a library it needs, is not installed.
    """
    o3d = load_open3d()
    stretches = Stretches.of(positions)
    located = stretches.locate(points)
    window = located.stretch // math.ceil(WINDOW_M / STRETCH_M)
    for reach_m in _REACHES_M:
        near = located.within(reach_m, max(reach_m, _BEYOND_M))
        found = _on_planes(o3d, points, window, near)
        if found.any():
            return points[found]
    return np.zeros((0, 3))


def load_open3d() -> Any:
    """The module, for its planes.

    Raises:
        BackendUnavailable: it or a library it needs is missing; names Debian's packages.
    """
    # open3d carries an older TBB, which numba refuses. Of one name the library loaded first is used
    # by all, and open3d is content with ours.
    select_thread_pool()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise BackendUnavailable(
            f"open3d cannot be loaded ({error}); it is installed with `pip install open3d` and "
            f"needs Debian's packages {SYSTEM_LIBRARIES}"
        ) from error


def _on_planes(o3d: Any, points: np.ndarray, window: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Which points [N] lie on the plane of their window, bool."""
    found = np.zeros(len(points), bool)
    for number in np.unique(window[near]):
        index = np.flatnonzero(near & (window == number))
        plane = _level_plane(o3d, _low_points(points[index]))
        if plane is not None:
            found[index] = np.abs(points[index] @ plane[:3] + plane[3]) <= 1.5 * _THRESHOLD_M
    return found


def _low_points(points: np.ndarray) -> np.ndarray:
    """One low point of every cell of a grid seen from above."""
    corner = points[:, :2].min(axis=0)
    cell = max(_CELL_M, float(np.ptp(points[:, :2], axis=0).max()) / _CELLS_A_SIDE)
    x, y = np.floor((points[:, :2] - corner) / cell).astype(np.int64).T
    flat = x * (_CELLS_A_SIDE + 1) + y
    order = np.lexsort((points[:, 2], flat))
    _, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    return points[order[first + (_LOW_QUANTILE * count).astype(int)]]


def _level_plane(o3d: Any, points: np.ndarray) -> np.ndarray | None:
    """Unit normal and offset [4] of the nearly level plane with the most points; None if no such
    plane has enough of them."""
    fewest = max(_FEWEST, math.ceil(_LEAST_SHARE * len(points)))
    for _ in range(_TRIES):
        if len(points) < fewest:
            return None
        middle = points.mean(axis=0)
        o3d.utility.random.seed(_SEED)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - middle))
        # A probability below 1 stops early, at a moment that depends on the threads' progress.
        model, inliers = cloud.segment_plane(_THRESHOLD_M, 3, _ITERATIONS, probability=1.0)
        if len(inliers) < fewest:
            return None
        normal = np.array(model[:3]) / np.linalg.norm(model[:3])
        if abs(normal[2]) >= math.cos(math.radians(STEEPEST_DEG)):
            return np.array([*normal, model[3] / np.linalg.norm(model[:3]) - normal @ middle])
        points = np.delete(points, inliers, axis=0)
    return None
