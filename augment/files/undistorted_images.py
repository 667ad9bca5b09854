"""Writes undistorted copies of recorded image files, once they are read.

    FOLDER/undistorted.json     the cameras with their lenses, and the source of each copy
    FOLDER/CAMERA/NAME.jpg      exists after the copy was read once

A scene is made from the copies, whose cameras are pinholes. `augment.files.recorded_images` calls
this module for missing images.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, PositiveInt, ValidationError

from augment.errors import AdapterError
from augment.files.image_size import decode_pixels
from augment.files.lens_records import LensRecord, lens_record
from augment.output.atomic import temporary_path
from augment.scene.cameras import Camera
from augment.scene.lenses import Intrinsics, Lens
from augment.scene.pixel_rays import turn_between
from recipes.files import open_file

UNDISTORTED = "undistorted.json"
# Bytes of that file, at most.
_MAX_BYTES = 1 << 26
# Bytes of an image file that are read.
_MAX_IMAGE_BYTES = 1 << 30
# JPEG quality of the copies, as of other undistorted images.
_JPEG_QUALITY = 95
# Part of the reach in the middle of the sides that a copy must have, at least.
_MIN_REACH = 0.2
# Side of a copy from which on it is a multiple of 8, pixels.
_MIN_EVEN_PX = 256
# Precision of that part.
_REACH_STEP = 1e-4
# Field of view of a copy over the longer side, at most: beyond it, corners become coarse.
_MAX_VIEW_DEG = 110.0


def inner_pinhole(camera: Camera) -> Camera:
    """Return the pinhole camera of a lens camera's undistorted image.

    Pose and focal lengths are the camera's. The image reaches as far as the recorded one does in
    the middle of its sides, less what is needed so that its border shows recorded pixels only.

    Args:
        camera: a camera with a lens.

    Raises:
        ValueError: the distortion leaves no such image.
    """
    low, high = _reach(camera)
    smallest = _MIN_REACH
    largest = 1.0
    if _is_recorded(camera, low, high):
        smallest = largest
    elif not _is_recorded(camera, smallest * low, smallest * high):
        raise ValueError("the distortion leaves no undistorted picture")
    while largest - smallest > _REACH_STEP:
        middle = (smallest + largest) / 2
        if _is_recorded(camera, middle * low, middle * high):
            smallest = middle
        else:
            largest = middle
    return _pinhole_of(camera, smallest * low, smallest * high)


def _reach(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest x / z and y / z, [2] each, on the lines through the
    principal point, up to _MAX_VIEW_DEG.
    """
    assert camera.lens is not None
    end = np.tan(np.radians(_MAX_VIEW_DEG / 2))
    limits = np.array([[-end, -end], [end, end]])
    for axis, (length, centre) in enumerate(
        ((camera.width, camera.cx), (camera.height, camera.cy))
    ):
        for side, place in enumerate((0.5, length - 0.5)):
            pixel = np.array([camera.cx, camera.cy])
            pixel[axis] = place
            ray, is_inside = camera.lens.rays(pixel, camera.intrinsics)
            if is_inside and ray[2] > 0 and 0.5 < centre < length - 0.5:
                slope = ray[axis] / ray[2]
                limits[side, axis] = np.clip(slope, *limits[:, axis])
    return limits[0], limits[1]


def _pinhole_of(camera: Camera, low: np.ndarray, high: np.ndarray) -> Camera:
    """Return the pinhole camera whose image reaches from `low` to `high`, [2], x / z and y / z."""
    left, top = np.ceil(low * (camera.fx, camera.fy)).astype(int)
    right, bottom = np.floor(high * (camera.fx, camera.fy)).astype(int)
    return replace(
        camera,
        width=_even_side(int(right - left)),
        height=_even_side(int(bottom - top)),
        cx=float(-left),
        cy=float(-top),
        lens=None,
        shutter=None,
    )


def _even_side(length_px: int) -> int:
    """Return a side that decoders can halve three times, if it is long, no longer than given."""
    is_long = length_px >= _MIN_EVEN_PX
    return length_px - length_px % 8 if is_long else max(1, length_px)


def _is_recorded(camera: Camera, low: np.ndarray, high: np.ndarray) -> bool:
    """Return True if the border of a pinhole image lies inside of the recorded one."""
    pinhole = _pinhole_of(camera, low, high)
    columns = np.arange(pinhole.width) + 0.5
    rows = np.arange(pinhole.height) + 0.5
    u = np.concatenate([columns, columns, 0 * rows + 0.5, 0 * rows + pinhole.width - 0.5])
    v = np.concatenate([0 * columns + 0.5, 0 * columns + pinhole.height - 0.5, rows, rows])
    pixels, is_inside = _recorded_pixels(camera, pinhole, u, v)
    with np.errstate(invalid="ignore"):
        is_inside = is_inside & (pixels >= 0).all(-1)
        return bool((is_inside & (pixels <= [camera.width, camera.height]).all(-1)).all())


def _recorded_pixels(
    camera: Camera, pinhole: Camera, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded places of pixels of a pinhole image [*, 2], and where there is one."""
    assert camera.lens is not None
    x = (u - pinhole.cx) / pinhole.fx
    y = (v - pinhole.cy) / pinhole.fy
    rays = np.stack([x, y, np.ones_like(x)], -1).astype(np.float64)
    return camera.lens.project(rays, camera.intrinsics)


def undistort(image: np.ndarray, camera: Camera, pinhole: Camera) -> np.ndarray:
    """Return an image as a pinhole camera would show it. Beyond the image its border is repeated.

    Args:
        image: the recorded image, [H, W, 3] or [H, W].
        camera: the camera that recorded it, with its lens, at the image's size.
        pinhole: a pinhole camera at the same place, which may be turned.
    """
    assert camera.lens is not None
    rows = tuple(turn_between(camera, pinhole).ravel().tolist())
    size = pinhole.width, pinhole.height
    u, v = _maps(camera.lens, camera.intrinsics, pinhole.intrinsics, *size, rows)
    return cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=16)
def _maps(
    lens: Lens,
    intrinsics: Intrinsics,
    pinhole: Intrinsics,
    width: int,
    height: int,
    camera_from_pinhole: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded position of each undistorted pixel, as maps for cv2.remap.

    Its pixel centres are whole numbers. camera_from_pinhole is a rotation, row by row.
    """
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x = (u - pinhole.cx) / pinhole.fx
    y = (v - pinhole.cy) / pinhole.fy
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.reshape(camera_from_pinhole, (3, 3)).T
    pixels, _ = lens.project(rays.astype(np.float64), intrinsics)
    pixels = np.nan_to_num(pixels - 0.5, nan=-1e6)
    return cv2.convertMaps(
        pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32), cv2.CV_16SC2
    )


# ---- Folders of copies ---------------------------------------------------------------------------


class _CameraRecord(BaseModel):
    """A camera with its lens, and the pinhole of its copies, which has its focal lengths."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    width: PositiveInt
    height: PositiveInt
    fx: float
    fy: float
    cx: float
    cy: float
    lens: LensRecord
    pinhole_width: PositiveInt
    pinhole_height: PositiveInt
    pinhole_cx: float
    pinhole_cy: float

    def cameras(self, name: str) -> tuple[Camera, Camera]:
        """Return the camera with its lens, and the pinhole of its copies."""
        pose = torch.eye(4, dtype=torch.float64)
        numbers = (self.width, self.height, self.fx, self.fy, self.cx, self.cy)
        camera = Camera(name, *numbers, camera_from_world=pose, lens=self.lens.lens())
        pinhole = replace(
            camera,
            width=self.pinhole_width,
            height=self.pinhole_height,
            cx=self.pinhole_cx,
            cy=self.pinhole_cy,
            lens=None,
        )
        return camera, pinhole


class UndistortedImages(BaseModel):
    """The content of undistorted.json: the sources of a folder's copies."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    cameras: Mapping[str, _CameraRecord]
    """Cameras by name."""
    sources: Mapping[str, str]
    """Path of the recorded image by CAMERA/NAME.jpg."""

    def unpack(self, folder: Path, name: str) -> str:
        """Write a copy; return the fault of its source as the end of a sentence, or ""."""
        source = Path(self.sources[name])
        try:
            with open_file(source) as file:
                image = decode_pixels(file.read(_MAX_IMAGE_BYTES), cv2.IMREAD_COLOR)
        except OSError as error:
            return f"is the copy of {source}, which cannot be read ({error.strerror or error})"
        if image is None:
            return f"is the copy of {source}, which cannot be decoded"
        camera, pinhole = self.cameras[name.split("/")[0]].cameras(name)
        if image.shape[:2] != (camera.height, camera.width):
            return (
                f"is the copy of {source}, which is of {image.shape[1]}x{image.shape[0]} pixels; "
                f"its camera is of {camera.width}x{camera.height}"
            )
        quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        data = cv2.imencode(".jpg", undistort(image, camera, pinhole), quality)[1].tobytes()
        write_copy(folder / name, data)
        return ""


def write_undistorted(
    folder: Path, cameras: Mapping[str, tuple[Camera, Camera]], sources: Mapping[str, str]
) -> None:
    """Write a folder's undistorted.json. The copies are written once they are read.

    Args:
        folder: the folder of the copies.
        cameras: the camera with its lens and the pinhole of its copies, by the camera's folder.
        sources: path of the recorded image by CAMERA/NAME.jpg.

    Raises:
        AdapterError: the folder cannot be written.
    """
    records = {}
    for name, (camera, pinhole) in cameras.items():
        assert camera.lens is not None
        records[name] = {
            **{"width": camera.width, "height": camera.height, **camera.intrinsics._asdict()},
            "lens": lens_record(camera.lens),
            **{"pinhole_width": pinhole.width, "pinhole_height": pinhole.height},
            **{"pinhole_cx": pinhole.cx, "pinhole_cy": pinhole.cy},
        }
    content = UndistortedImages.model_validate({"cameras": records, "sources": dict(sources)})
    write_copy(folder / UNDISTORTED, content.model_dump_json().encode())


def is_undistorted_copy(path: Path) -> bool:
    """Return True if the image can be written from a recorded one; it may exist already."""
    content = _content_of(path)
    return content is not None and _name(path) in content.sources


def unpack_copy(path: Path) -> str:
    """Write a missing copy if its folder knows its source.

    Returns:
        The fault, as the end of a sentence; "" without a fault, and if no source is known.
    """
    content = _content_of(path)
    if content is None or _name(path) not in content.sources:
        return ""
    try:
        return content.unpack(path.parents[1], _name(path))
    except AdapterError as error:
        return f"cannot be written: {error}"


def write_copy(path: Path, data: bytes) -> None:
    """Write a file of a folder of copies atomically.

    Raises:
        AdapterError: the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(path)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        raise AdapterError(
            f"{path} cannot be written ({error.strerror or error}); images without distortion "
            f"are kept there, set XDG_CACHE_HOME to a folder with room for them"
        ) from error


def _name(path: Path) -> str:
    """Return CAMERA/NAME of an image."""
    return f"{path.parent.name}/{path.name}"


def _content_of(path: Path) -> UndistortedImages | None:
    """Return the content of undistorted.json in the image's folder, if there is one."""
    if len(path.parents) < 2:
        return None
    file = path.parents[1] / UNDISTORTED
    try:
        return _read_content(file, file.stat().st_mtime_ns)
    except (OSError, ValidationError):
        return None


@lru_cache(maxsize=4)
def _read_content(file: Path, _changed_ns: int) -> UndistortedImages:
    """Read undistorted.json; the time of its last change is a part of the cache's key."""
    with open_file(file) as opened:
        return UndistortedImages.model_validate_json(opened.read(_MAX_BYTES))
