"""LiDAR returns as cameras see them: pixels with returns, and the LiDAR's highest view.

In: a scene's sweeps and cameras. Out: masks and elevations. Sky mattes and fits use them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from augment.memo import memo_of
from augment.scene.cameras import Camera
from augment.scene.labels import KnowsLidarElevation
from augment.scene.scene import Scene

# Distance from which LiDAR and cameras see a return at nearly the same elevation, metres.
_TOP_FROM_M = 10.0
# Quantile of the returns' elevations that is the highest view; a few returns are stray.
_TOP_QUANTILE = 0.999
# Returns that the highest view is measured from, at least.
_ENOUGH_RETURNS = 5000
# Frames that the highest view is measured in.
_NUM_TOP_FRAMES = 5
# Depth from which a return is before a camera, metres.
_MIN_DEPTH_M = 0.5


def elevation_rad(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Return the elevation of every pixel's ray above the world's horizontal plane."""
    rays = camera.ray_directions().numpy()
    return np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))


def sweep_of(scene: Scene, frame: int) -> np.ndarray | None:
    """Return the points [N, 3] of a frame's sweep, float32; None without one that can be read.

    The result is kept in the scene's memo.
    """
    scene = scene.as_recorded
    return memo_of(scene).get(("sweep", frame), lambda: (_readable_sweep(scene, frame),))[0]


def _readable_sweep(scene: Scene, frame: int) -> np.ndarray | None:
    """Return the points of a frame's sweep; None without one that can be read."""
    try:
        return _sweep_points(scene, frame, np.float32)
    except Exception:  # a damaged sweep is its own frame's matter, and not that of the sky
        return None


def _sweep_points(scene: Scene, frame: int, dtype: type[np.floating]) -> np.ndarray | None:
    """Return the finite points [N, 3] of a frame's sweep, scene world; None without a sweep."""
    sweep = scene.lidar(frame)
    if sweep is None:
        return None
    points = (sweep.points_m - np.asarray(scene.world_origin_m)).astype(dtype)
    return points[np.isfinite(points).all(1)]


def find_returns(points: Float[np.ndarray, "N 3"], camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Return the mask of pixels with a LiDAR return.

    Args:
        points: the returns, scene world.
        camera: the view.
    """
    pose = camera.camera_from_world.numpy().astype(np.float32)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > _MIN_DEPTH_M]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy)
    is_inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    has_return = np.zeros((camera.height, camera.width), bool)
    has_return[v[is_inside].astype(int), u[is_inside].astype(int)] = True
    return has_return


def highest_channel_rad(scene: Scene, points: np.ndarray, camera: Camera) -> float:
    """Return the elevation of the LiDAR's highest channel, as a camera sees it.

    It is known from the labels, or measured in some frames of the scene, or else in this sweep.
    Infinite where there are too few returns.

    Args:
        scene: the scene.
        points: the returns of the camera's frame, [N, 3].
        camera: the camera.
    """
    scene = scene.as_recorded
    indices = [frame.index for frame in scene.frames]
    sample = indices[:: max(1, -(-len(indices) // _NUM_TOP_FRAMES))]
    top_rad = memo_of(scene).get(("lidar top",), lambda: (lidar_top_rad(scene, sample),))[0]
    if top_rad is None:
        top_rad = _top_rad(points, camera.centre.numpy().astype(np.float32))
    return math.inf if top_rad is None else top_rad


def lidar_top_rad(scene: Scene, frames: Sequence[int]) -> float | None:
    """Return the highest elevation that the LiDAR looks at, as cameras see it.

    It is known from the labels, or measured from the returns of some frames (too low where nothing
    tall stood near). None where there are not enough of them.
    """
    if isinstance(scene.labels, KnowsLidarElevation):
        return scene.labels.max_lidar_elevation_rad
    tops = []
    for index in frames:
        cameras = scene.frame(index).cameras.values()
        points = _sweep_points(scene, index, np.float64)
        if points is None or not cameras:
            continue
        centre = np.mean([camera.centre.numpy() for camera in cameras], axis=0)
        top_rad = _top_rad(points, centre, _ENOUGH_RETURNS)
        if top_rad is not None:
            tops.append(top_rad)
    return float(np.median(tops)) if tops else None


def _top_rad(points: np.ndarray, centre: np.ndarray, min_returns: int = 1) -> float | None:
    """Return the highest elevation of returns that are not close, without a few stray ones.

    Args:
        points: the returns, [N, 3].
        centre: where they are seen from, [3].
        min_returns: number of returns below which the result is None.
    """
    offset = points - centre
    distance_m = np.hypot(offset[:, 0], offset[:, 1])
    is_far = distance_m > _TOP_FROM_M
    if is_far.sum() < min_returns:
        return None
    return float(np.quantile(np.arctan2(offset[is_far, 2], distance_m[is_far]), _TOP_QUANTILE))
