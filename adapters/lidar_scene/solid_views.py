"""Images of a raw drive in which surfaces beyond the LiDAR's view are added.

The caller is `adapters.lidar_scene.scene`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from adapters.lidar_scene.beyond_beams import WORK_WIDTH, SolidView, add_surfaces_beyond_beams
from adapters.lidar_scene.closing import spread_views
from adapters.lidar_scene.image_views import IMAGE_SCALES, View, draw_cover, read_image
from adapters.lidar_scene.split import ObjectTrack
from augment.photo.sky_matte import find_sky_matte
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians

_STEP_M = 2.0  # distance on the path from one image that is taken to the next
_FRAMES_PART = 1 / 6  # largest part of all frames whose images are taken, beyond a few


def close_above_beams(
    parts: Sequence[Gaussians],
    tracks: Sequence[ObjectTrack],
    views: Sequence[View],
    *,
    lidar_top_rad: float,
    max_gaussians: int,
) -> Gaussians:
    """Return the world's Gaussians with discs where images show a surface above the LiDAR's view.

    Args:
        parts: Gaussians of the world, then those of the tracks, in their frames.
        tracks: moving objects.
        views: recorded images.
        lidar_top_rad: highest elevation that the LiDAR measures.
        max_gaussians: largest number for all parts.
    """
    solid_views = [
        solid_view
        for view in spread_views(views, step_m=_STEP_M, frames_part=_FRAMES_PART)
        if (solid_view := read_solid_view(view, tracks)) is not None
    ]

    def pose_parts(background: Gaussians, camera: Camera) -> list[PosedGaussians]:
        posed = [PosedGaussians(background, None, instance_id=0)]
        for number, (track, part) in enumerate(zip(tracks, parts[1:], strict=True), start=1):
            pose = track.motion.pose_at(camera.timestamp_ns)
            if pose is not None and len(part):
                posed.append(PosedGaussians(part, torch.from_numpy(pose), instance_id=number))
        return posed

    return add_surfaces_beyond_beams(
        parts[0],
        solid_views,
        pose_parts,
        lidar_top_rad=lidar_top_rad,
        max_added=max_gaussians - sum(map(len, parts)),
    )


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
