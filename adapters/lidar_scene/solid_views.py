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


class SolidView(NamedTuple):
    """A recorded image in which surfaces are added, of H x W pixels."""

    camera: Camera
    """Camera at the image's size."""
    rgb: np.ndarray
    """The photo, uint8 [H, W, 3]."""
    matte: SkyMatte
    """Its sky."""
    excluded: np.ndarray
    """Pixels of the recording car and of moving objects, bool [H, W]."""


def read_solid_view(view: View, tracks: Sequence[ObjectTrack]) -> SolidView | None:
    """Return a recorded image with its sky, at WORK_WIDTH columns at most.

    The result is None if it cannot be decoded, or does not tell its sky, as at night.
    """
    camera = view.camera.scaled(min(1.0, WORK_WIDTH / view.camera.width))
    scale = camera.width / view.camera.width
    image = read_image(view.path, next(s for s in IMAGE_SCALES if s >= scale))
    if image is None:
        return None
    rgb = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    matte = find_sky_matte(rgb, camera)
    if matte is None:
        return None
    cover = np.full((camera.height, camera.width), np.inf, np.float32)
    for track in tracks:
        pose = track.motion.pose_at(camera.timestamp_ns)
        if pose is not None:
            draw_cover(cover, camera, camera.camera_from_world.numpy() @ pose, track.size_m)
    excluded = view.shows_car(camera.width, camera.height) | np.isfinite(cover)
    return SolidView(camera, rgb, matte, excluded)
