"""Recorded images of cameras with a lens or a rolling shutter, as bases of weathered pictures.

Weather is computed on pinhole views of the image. These are resampled, and their picture is
resampled again to the pixels of the lens. `transfer_change` gives the picture the sharpness of the
image back: what the resampling has taken from the image is added to the picture, as far as the
image's contrast is left in it there. Where nothing changes, the result is the image as recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import uniform_filter
from torch import Tensor

from augment.errors import SceneError
from augment.files.recorded_images import ImageFault, read_scaled
from augment.files.undistorted_images import undistort
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene

# Side of the square in which contrasts are compared, pixels.
WINDOW_PX = 7
# Contrast below which nothing is compared: the deviation of an image's last bits, of 1.
MIN_DEVIATION = 1.5 / 255


@dataclass(frozen=True, eq=False)
class LensPhoto:
    """The image that a camera with a lens or a rolling shutter recorded."""

    camera: Camera
    """The camera, at the size of the picture."""
    frame: Frame
    """The frame, with the lenses."""
    pixels: UInt8[np.ndarray, "H W 3"]
    """The image as recorded, at the camera's size."""

    def pixels_in(self, lens_camera: Camera, view: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image as a pinhole view shows it.

        Args:
            lens_camera: the camera without its shutter, or a window of it, at the pose of a strip.
            view: a pinhole camera at the same place; `lens_camera` itself if it has no lens.
        """
        if lens_camera.lens is None:
            left = round(self.camera.cx - lens_camera.cx)
            top = round(self.camera.cy - lens_camera.cy)
            rows = slice(top, top + lens_camera.height)
            return np.ascontiguousarray(self.pixels[rows, left : left + lens_camera.width])
        # The whole image, seen from where the strip was recorded.
        whole_camera = replace(
            self.camera, camera_from_world=lens_camera.camera_from_world, shutter=None
        )
        return undistort(self.pixels, whole_camera, view)


def open_lens_photo(scene: Scene, camera: Camera) -> LensPhoto:
    """Return the image that a camera with a lens or a shutter recorded.

    Args:
        scene: the scene, with pinhole cameras (`augment.scene.pinhole_scene`).
        camera: one of the cameras that it had, at any scale.

    Raises:
        SceneError: no such camera recorded an image, or the image cannot be read.
    """
    for frame in scene.lens_frames or scene.frames:
        recorded = frame.cameras.get(camera.name)
        path = frame.image_paths.get(camera.name)
        if recorded is None or path is None or recorded.timestamp_ns != camera.timestamp_ns:
            continue
        resized = recorded.resized(camera.width, camera.height)
        is_same = resized.lens == camera.lens and np.allclose(
            resized.intrinsics, camera.intrinsics, rtol=1e-9
        )
        if not (is_same and torch.equal(recorded.camera_from_world, camera.camera_from_world)):
            continue
        try:
            pixels = read_scaled(Path(path), recorded, camera)
        except ImageFault as fault:
            raise SceneError(f"camera {camera.name}: recorded image {path} {fault}") from None
        return LensPhoto(camera, frame, pixels)
    raise SceneError(
        f"scene {scene.name!r} has no recorded image of camera {camera.name!r} at "
        f"{camera.timestamp_ns} ns, this pose and this lens; with render.base 'recorded' only what "
        f"was recorded can be rendered, all else takes base: splats"
    )


def scene_colors(
    pixels: UInt8[np.ndarray, "H W 3"], color_map: Float[Tensor, "3 4"] | None
) -> Float32[np.ndarray, "H W 3"]:
    """Return the colours that recorded pixels have in the scene.

    Args:
        pixels: RGB.
        color_map: colour map that the finished picture gets; None without one.
    """
    rgb = pixels.astype(np.float32) / np.float32(255)
    if color_map is None:
        return rgb
    inverse = torch.linalg.inv(color_map[:, :3].double()).numpy()
    offset = color_map[:, 3].double().numpy()
    return ((rgb - offset) @ inverse.T).astype(np.float32)


def transfer_change(
    picture: Float32[np.ndarray, "H W 3"],
    copy: Float32[np.ndarray, "H W 3"],
    recorded: Float32[np.ndarray, "H W 3"],
) -> Float32[np.ndarray, "H W 3"]:
    """Return a weathered picture with the sharpness of the recorded image.

    With c the copy, p its picture in the weather and r the image, the result is p + g (r - c). g is
    the slope of p over c in the squares around a pixel, from 0 (snow hides the image) to 1 (nothing
    changes). Fog that leaves half of the contrast leaves half of r - c.

    Args:
        picture: the weathered copy at the image's pixels.
        copy: the copy at the image's pixels: the image, resampled.
        recorded: the image.
    """
    of_picture = picture.mean(2, dtype=np.float64)
    of_copy = copy.mean(2, dtype=np.float64)
    mean_picture = uniform_filter(of_picture, WINDOW_PX)
    mean_copy = uniform_filter(of_copy, WINDOW_PX)
    covariance = uniform_filter(of_picture * of_copy, WINDOW_PX) - mean_picture * mean_copy
    variance = uniform_filter(of_copy * of_copy, WINDOW_PX) - mean_copy * mean_copy
    floor = MIN_DEVIATION**2
    # Without contrast the windows tell nothing: there the change of the mean does.
    similarity = (1 - np.abs(mean_picture - mean_copy) / MIN_DEVIATION).clip(0, 1)
    gain = (covariance + floor * similarity) / (np.maximum(variance, 0) + floor)
    gain = gain.clip(0, 1).astype(np.float32)[..., None]
    return picture + gain * (recorded - copy)
