"""Points that recorded images see as sky: splats there are stray returns, or at a wrong depth.

Wires, birds and noise return single points. As splats they are bars and dashes that float over the
roofs, as wide as a voxel. The caller is `adapters.lidar_scene.beyond_beams`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from adapters.lidar_scene.solid_views import SolidView
from augment.scene.scene import Gaussians

_SURE_SKY = 0.98  # share of sky above which an image shows sky
_NEAREST_M = 1.0  # smallest depth of a point that a camera sees
_MIN_VIEWS = 2  # fewest images that must see a splat as sky before it is left out
_MAX_CONFLICTS = 0.6  # part of the images of a splat in which it may cover sky
_SPLAT_PX = 5  # side of the square that a splat may fill, pixels
_SOLID_PX = 15  # side of a square full of splats that is a surface, whatever the image shows


def measure_conflicts(points: np.ndarray, views: Sequence[SolidView]) -> np.ndarray:
    """Return the part of the images of each point that see sky there, float64 [M].

    Sky counts if all pixels around are sky as well: depths are not exact.

    Args:
        points: float64 [M, 3], world.
        views: recorded images.
    """
    num_views, num_sky = _count(points, views)
    return num_sky / np.maximum(num_views, 1)


def without_sky_splats(
    background: Gaussians, views: Sequence[SolidView]
) -> tuple[Gaussians, list[SolidView]]:
    """Return the background without splats that images see as sky, and corrected images.

    Where splats stand close together on all sides of a pixel there is a surface. The images'
    mattes have no sky there any more: a bright wall looks like an overcast sky.
    """
    if not views:
        return background, []
    lowest_m = min(float(view.camera.centre[2]) for view in views)
    high = np.flatnonzero(background.means[:, 2].numpy() > lowest_m)
    points = background.means[torch.from_numpy(high)].numpy().astype(np.float64)
    views = [_with_surfaces(view, points) for view in views]
    num_views, num_sky = _count(points, views)
    is_stray = (num_sky >= _MIN_VIEWS) & (num_sky > _MAX_CONFLICTS * num_views)
    keep = np.ones(len(background), np.bool_)
    keep[high[is_stray]] = False
    return background.select(torch.from_numpy(np.flatnonzero(keep))), views


def _with_surfaces(view: SolidView, points: np.ndarray) -> SolidView:
    """Return the image with no sky inside of areas that are full of points."""
    _, rows, columns = _project(points, view)
    has_point = np.zeros(view.matte.sky_share.shape, np.uint8)
    has_point[rows, columns] = 1
    filled = cv2.dilate(has_point, np.ones((_SPLAT_PX, _SPLAT_PX), np.uint8))
    solid = cv2.erode(filled, np.ones((_SOLID_PX, _SOLID_PX), np.uint8)) > 0
    matte = view.matte._replace(
        sky_share=np.where(solid, np.float32(0), view.matte.sky_share),
        surface_rgb=np.where(solid[..., None], view.rgb, view.matte.surface_rgb),
    )
    return view._replace(matte=matte)


def _count(points: np.ndarray, views: Sequence[SolidView]) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of images that see each point, and see sky there, float64 [M] each."""
    num_views = np.zeros(len(points))
    num_sky = np.zeros(len(points))
    for view in views:
        index, rows, columns = _project(points, view)
        sure_sky = cv2.erode(view.matte.sky_share, np.ones((3, 3), np.uint8)) > _SURE_SKY
        num_views[index] += 1
        num_sky[index] += sure_sky[rows, columns]
    return num_views, num_sky


def _project(points: np.ndarray, view: SolidView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points inside the image, int64 [K], and their rows and columns, int64 [K]."""
    camera = view.camera
    pose = camera.camera_from_world.numpy()
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    front = np.flatnonzero(z > _NEAREST_M)
    u = np.floor(camera.fx * x[front] / z[front] + camera.cx)
    v = np.floor(camera.fy * y[front] / z[front] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return front[inside], v[inside].astype(np.int64), u[inside].astype(np.int64)
