"""Masks of the recording car from a user, instead of those that `augment.photo.own_car` finds."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from adapters.plain_files import decode_image
from augment.errors import AdapterError
from augment.scene.cameras import Camera

_WHITE = 128  # levels from which a pixel of a mask is white


def read_ego_mask(path: Path, camera: Camera) -> np.ndarray:
    """Read a mask image, white where the camera sees the recording car, at the camera's size."""
    image = decode_image(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise AdapterError(f"{path} cannot be decoded; expected an image, white on the own car")
    error = (image.shape[1] / image.shape[0]) / (camera.width / camera.height) - 1
    if abs(error) > 0.01:
        raise AdapterError(
            f"{path} is of {image.shape[1]}x{image.shape[0]} pixels; the mask of camera "
            f"{camera.name!r} has the proportions of its images, {camera.width}x{camera.height}"
        )
    size = (camera.width, camera.height)
    interpolation = cv2.INTER_AREA if image.shape[1] >= camera.width else cv2.INTER_LINEAR
    # Any part of a pixel on the car spoils it.
    return cv2.resize(image, size, interpolation=interpolation) >= _WHITE // 2
