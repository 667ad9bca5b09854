"""Recorded images that tell surfaces from sky.

The callers are `adapters.lidar_scene.beyond_beams` and `adapters.training_views.starting_scene`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from adapters.lidar_scene.image_views import IMAGE_SCALES, View, draw_cover, read_image
from adapters.lidar_scene.split import ObjectTrack
from augment.photo.sky_matte import SkyMatte, find_sky_matte
from augment.scene.cameras import Camera

WORK_WIDTH = 480  # columns of the images in which surfaces are added, at most
_NEAREST_M = 1.0  # smallest depth of a point that a camera sees


class SolidView(NamedTuple):
    """A recorded image in which surfaces are added, of H x W pixels."""

    camera: Camera
    """Camera at the image's size."""
    rgb: np.ndarray
    """The photo, uint8 [H, W, 3]."""
    lab: np.ndarray
    """The photo in CIELAB, float32 [H, W, 3]."""
    matte: SkyMatte
    """Its sky."""
    excluded: np.ndarray
    """Pixels of the recording car and of moving objects, bool [H, W]."""
    known_m: np.ndarray | None = None
    """Depth of the surfaces that returns made, infinite without one, float [H, W]."""


def read_solid_view(
    view: View, tracks: Sequence[ObjectTrack], points: np.ndarray, lidar_top_rad: float
) -> SolidView | None:
    """Return a recorded image with its sky, at WORK_WIDTH columns at most.

    The result is None if it cannot be decoded, or is too dark to tell its sky.

    Args:
        view: the image.
        tracks: moving objects.
        points: float [N, 3], surfaces of what stands still, world.
        lidar_top_rad: highest elevation that the LiDAR measures.
    """
    camera = view.camera.scaled(min(1.0, WORK_WIDTH / view.camera.width))
    scale = camera.width / view.camera.width
    image = read_image(view.path, next(s for s in IMAGE_SCALES if s >= scale))
    if image is None:
        return None
    rgb = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    has_point = np.zeros((camera.height, camera.width), np.bool_)
    _, rows, columns, _ = project_into(camera, points)
    has_point[rows, columns] = True
    matte = find_sky_matte(rgb, camera, has_point, lidar_top_rad)
    if matte is None:
        return None
    cover = np.full((camera.height, camera.width), np.inf, np.float32)
    for track in tracks:
        pose = track.motion.pose_at(camera.timestamp_ns)
        if pose is not None:
            draw_cover(cover, camera, camera.camera_from_world.numpy() @ pose, track.size_m)
    excluded = view.shows_car(camera.width, camera.height) | np.isfinite(cover)
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return SolidView(camera, rgb, lab, matte, excluded)


def project_into(
    camera: Camera, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points inside the image, their rows, columns (all int64 [K]) and depths, [K].

    points: float [N, 3], world.
    """
    pose = camera.camera_from_world.numpy()
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    front = np.flatnonzero(z > _NEAREST_M)
    u = np.floor(camera.fx * x[front] / z[front] + camera.cx)
    v = np.floor(camera.fy * y[front] / z[front] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    index = front[inside]
    return index, v[inside].astype(np.int64), u[inside].astype(np.int64), z[index]
