"""Sky mattes of recorded images: the share of sky in each pixel, and colours without it.

In: a recorded image and its camera. Out: a `SkyMatte`. A pixel at the edge of a roof, or of a wire,
shows both: I = a S + (1 - a) F, with the sky's share a, the sky's colour S and the surface's colour
F. A picture with another sky needs F, since I would keep a rim of the recorded sky.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from augment.files.recorded_images import ImageFault, read_scaled
from augment.memo import memo_of
from augment.photo.recorded_sky import elevation_rad, find_sky, recorded_sky
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene

# Columns of the image in which the sky is looked for, at most.
WORK_WIDTH = 480


class SkyMatte(NamedTuple):
    """The sky in one image, and the image's colours without it."""

    sky_share: Float32[np.ndarray, "H W"]
    """Share of sky in each pixel: 0 for a surface, 1 for sky, between at soft edges."""
    surface_rgb: UInt8[np.ndarray, "H W 3"]
    """The image with the sky's colour taken out of mixed pixels; the image itself where
    `sky_share` is 0. Pixels of sky have the colour of a surface beside them."""
    sky_rgb: UInt8[np.ndarray, "H W 3"]
    """Colour of the sky at each pixel, or behind it; meaningless far from any sky."""


def sky_matte(
    scene: Scene, camera: Camera, rgb: UInt8[np.ndarray, "H W 3"] | None = None
) -> SkyMatte | None:
    """Return the sky matte of the image that a camera recorded, at the camera's size.

    The sky is looked for once for each recorded image, and kept in the scene's memo at WORK_WIDTH.

    Args:
        scene: the scene.
        camera: one of its cameras, at any scale.
        rgb: the recorded image at the camera's size, if the caller has it; else it is read.

    Returns:
        The matte; None where there is no image, or where it does not tell (at night).
    """
    frame = _recorded_frame(scene, camera)
    if frame is None:
        return None
    if rgb is None:
        try:
            path = Path(frame.image_paths[camera.name])
            rgb = read_scaled(path, frame.cameras[camera.name], camera)
        except ImageFault:
            return None
    sky = recorded_sky(scene, frame, camera.name)
    return None if sky is None else _refine(rgb, sky.is_sky)


def find_sky_matte(
    rgb: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    has_return: Bool[np.ndarray, "h w"] | None = None,
    lidar_top_rad: float = float("inf"),
) -> SkyMatte | None:
    """Return the sky matte of an image; None where the image does not tell, as at night.

    Args:
        rgb: the image.
        camera: its camera, at the image's size.
        has_return: pixels with a LiDAR return, at the image's size or smaller; None without LiDAR.
        lidar_top_rad: elevation at which the LiDAR's view ends, as the camera sees it.
    """
    small = camera.scaled(min(1.0, 256 / camera.width))
    size = small.width, small.height
    hits = None
    if has_return is not None:
        factor = has_return.shape[1] / small.width, has_return.shape[0] / small.height
        rows, columns = np.nonzero(has_return)
        hits = np.zeros((small.height, small.width), bool)
        hits[
            np.minimum((rows / factor[1]).astype(int), small.height - 1),
            np.minimum((columns / factor[0]).astype(int), small.width - 1),
        ] = True
    small_rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    sky = find_sky(small_rgb, elevation_rad(small), hits, lidar_top_rad)
    return None if sky is None else _refine(rgb, sky.is_sky)


def _recorded_frame(scene: Scene, camera: Camera) -> Frame | None:
    """Return the frame in which a camera recorded an image at this time and pose; None without."""

    def index() -> dict[tuple[str, int], Frame]:
        return {
            (name, frame.cameras[name].timestamp_ns): frame
            for frame in scene.frames
            for name in frame.image_paths
            if name in frame.cameras
        }

    frames = memo_of(scene).get(("frames with images",), index)
    frame = frames.get((camera.name, camera.timestamp_ns))
    if frame is None:
        return None
    pose = frame.cameras[camera.name].camera_from_world
    is_same = torch.allclose(pose, camera.camera_from_world, rtol=0, atol=1e-6)
    return frame if is_same else None


def _refine(rgb: np.ndarray, is_sky: np.ndarray) -> SkyMatte:
    """Return the matte of an image from a small mask of its sky."""
    height, width = rgb.shape[:2]
    share = cv2.resize(is_sky.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(0.006 * width))
    share = cv2.ximgproc.guidedFilter(rgb, share, radius, 8.0**2)
    share = np.clip((share - 0.1) / 0.8, 0, 1).astype(np.float32)
    sky_rgb = _spread(rgb, share >= 1)
    surface_rgb = _spread(rgb, share <= 0)
    surface_rgb = np.where((share > 0)[..., None], surface_rgb, rgb)
    return SkyMatte(share, surface_rgb, sky_rgb)


def _spread(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mean colour of the pixels of a mask near each pixel."""
    weight = mask.astype(np.float32)[..., None]
    factor = max(1, rgb.shape[1] // WORK_WIDTH)
    size = -(-rgb.shape[1] // factor), -(-rgb.shape[0] // factor)
    sums = cv2.resize(np.concatenate([rgb * weight, weight], 2), size, interpolation=cv2.INTER_AREA)
    out = np.zeros_like(sums[..., :3])
    missing = np.ones(out.shape[:2], np.float32)
    for side in (5, 21, 81, 321):
        blurred = cv2.blur(sums, (side, side))
        part = np.clip(blurred[..., 3] * side, 0, 1) * missing
        out += part[..., None] * blurred[..., :3] / np.maximum(blurred[..., 3:], 1e-6)
        missing -= part
    full = cv2.resize(out, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip(full + 0.5, 0, 255).astype(np.uint8)
