"""Recorded images that tell surfaces from sky.

The callers are `adapters.lidar_scene.beyond_beams` and `adapters.training_views.starting_scene`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from adapters.lidar_scene.image_views import IMAGE_SCALES, View, draw_cover, read_image
from adapters.lidar_scene.split import ObjectTrack
from augment.photo.lidar_view import find_returns
from augment.photo.sky_matte import SkyMatte, find_sky_matte
from augment.photo.sky_regions import largest_channel
from augment.reconstruct.view import ViewKey
from augment.scene.cameras import Camera

WORK_WIDTH = 960  # columns of the images in which surfaces are added, at most
_HALF = np.float32(0.5)  # share of sky that parts sky from surface
_SURE_SKY = 0.5  # share of sky above which a pixel shows sky
_AROUND_PART = 1 / 320  # side of the square that must show sky around, over the image's width
_RIM_PX = 2  # width of rims that show mostly sky
_RIM_LEVELS = 16  # largest difference from the sky of a rim, of 255
_RIM_SHARE = 0.4  # the same as a part of the largest difference around
_SPECK_PX = 300  # largest area of a speck of cloud
_SPECK_SHARE = 0.8  # least brightness of a speck of cloud, as a part of the sky's
_NEAREST_M = 1.0  # smallest depth of a point that a camera sees


@dataclass(frozen=True, eq=False)
class SolidView:
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
    key: ViewKey
    """Frame and camera of the image."""
    known_m: np.ndarray | None = None
    """Depth of the surfaces that returns made, infinite without one, float [H, W]."""

    @cached_property
    def sure_sky(self) -> np.ndarray:
        """Pixels with sky all around, bool [H, W]: depths are not exact."""
        side = max(3, 2 * round(_AROUND_PART * self.camera.width) - 1)
        square = np.ones((side, side), np.uint8)
        return cv2.erode(self.matte.sky_share, square) > _SURE_SKY


def read_solid_view(
    view: View,
    tracks: Sequence[ObjectTrack],
    returns: np.ndarray,
    lidar_top_rad: float,
    *,
    width: int = WORK_WIDTH,
) -> SolidView | None:
    """Return a recorded image with its sky.

    The result is None if it cannot be decoded, or is too dark to tell its sky.

    Args:
        view: the image.
        tracks: moving objects.
        returns: float [N, 3], the LiDAR's returns at the image's time, world. Those of other times
            are no substitute: they lie behind what the image shows, and hide its sky.
        lidar_top_rad: highest elevation that the LiDAR measures.
        width: columns of the result, at most.
    """
    camera = view.camera.scaled(min(1.0, width / view.camera.width))
    scale = camera.width / view.camera.width
    image = read_image(view.path, next(s for s in IMAGE_SCALES if s >= scale))
    if image is None:
        return None
    rgb = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    has_return = find_returns(returns, camera)
    matte = find_sky_matte(rgb, camera, has_return, lidar_top_rad)
    if matte is None:
        return None
    boxes = [
        (pose, track.size_m)
        for track in tracks
        if (pose := track.motion.pose_at(camera.timestamp_ns)) is not None
    ]
    excluded = view.shows_car(camera.width, camera.height)
    key = ViewKey(view.frame, view.camera.name)
    return make_solid_view(key, camera, rgb, matte, excluded, boxes, has_return)


def make_solid_view(
    key: ViewKey,
    camera: Camera,
    rgb: np.ndarray,
    matte: SkyMatte,
    excluded: np.ndarray,
    boxes: Sequence[tuple[np.ndarray, np.ndarray]],
    has_point: np.ndarray,
) -> SolidView:
    """Return a recorded image with a cleaned matte, without the pixels of moving objects.

    Args:
        key: frame and camera of the image.
        camera: the camera at the image's size.
        rgb: uint8 [H, W, 3].
        matte: the image's sky.
        excluded: pixels of the recording car, bool [H, W].
        boxes: world_from_box [4, 4] and size in metres [3] of the moving objects.
        has_point: pixels with a known surface, bool [H, W].
    """
    cover = np.full((camera.height, camera.width), np.inf, np.float32)
    for world_from_box, size_m in boxes:
        draw_cover(cover, camera, camera.camera_from_world.numpy() @ world_from_box, size_m)
    sky_share = _without_specks(rgb, matte, has_point)
    surface_rgb = _without_rims(matte.surface_rgb, matte.sky_rgb, sky_share)
    matte = matte._replace(sky_share=sky_share, surface_rgb=surface_rgb)
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return SolidView(camera, rgb, lab, matte, excluded | np.isfinite(cover), key)


def _without_specks(rgb: np.ndarray, matte: SkyMatte, has_point: np.ndarray) -> np.ndarray:
    """Return the share of sky without specks of cloud, and without bright rims, float32 [H, W].

    At this size an edge is a pixel wide, and half of it shows sky.

    Args:
        rgb: the photo, uint8 [H, W, 3].
        matte: its sky.
        has_point: pixels with a known surface, bool [H, W].
    """
    is_solid = matte.sky_share < _HALF
    difference = largest_channel(cv2.absdiff(rgb, matte.sky_rgb))
    around = cv2.dilate(difference, np.ones((5, 5), np.uint8))
    looks_like_sky = difference < np.maximum(_RIM_LEVELS, _RIM_SHARE * around)
    square = np.ones((3, 3), np.uint8)
    for _ in range(_RIM_PX):
        beside_sky = cv2.dilate((~is_solid).astype(np.uint8), square) > 0
        is_solid &= ~(beside_sky & looks_like_sky)
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    sky_luma = cv2.cvtColor(matte.sky_rgb, cv2.COLOR_RGB2GRAY)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(is_solid.astype(np.uint8))
    flat = labels.ravel()
    is_bright = np.bincount(flat, (luma - _SPECK_SHARE * sky_luma).ravel(), count) > 0
    num_points = np.bincount(flat, has_point.ravel(), count)
    is_speck = is_bright & (num_points == 0) & (stats[:, cv2.CC_STAT_AREA] < _SPECK_PX)
    is_speck[0] = True  # sky itself
    return np.where(is_speck[labels], np.maximum(matte.sky_share, _HALF), matte.sky_share)


def _without_rims(rgb: np.ndarray, sky_rgb: np.ndarray, sky_share: np.ndarray) -> np.ndarray:
    """Return colours in which pixels beside sky have that of the neighbour least like sky.

    Args:
        rgb: colours of surfaces, uint8 [H, W, 3].
        sky_rgb: colours of the sky around, uint8 [H, W, 3].
        sky_share: share of sky, float32 [H, W].
    """
    height, width = sky_share.shape
    is_sky = sky_share >= _HALF
    difference = largest_channel(cv2.absdiff(rgb, sky_rgb)).astype(np.int16)
    difference[is_sky] = -1
    beside_sky = cv2.dilate(is_sky.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rows, columns = np.nonzero(beside_sky & ~is_sky)
    best = difference[rows, columns]
    out = rgb.copy()
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            near_rows = np.clip(rows + down, 0, height - 1)
            near_columns = np.clip(columns + right, 0, width - 1)
            is_better = difference[near_rows, near_columns] > best
            best[is_better] = difference[near_rows, near_columns][is_better]
            chosen = rgb[near_rows[is_better], near_columns[is_better]]
            out[rows[is_better], columns[is_better]] = chosen
    return out


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
