"""Depth maps in folders: where each view's file is, and what is in it."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from adapters.plain_files import decode_image
from adapters.safe_pickle import read_array, read_array_dict
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.reconstruct.view import ViewKey

METRIC_PER_M = 256.0  # levels per metre of 16-bit depth images
_NUMBER = re.compile(r"\d{1,12}")
_SPARSE_NAME = re.compile(r"(\d{1,12})_(.+)")
_ASPECT_TOLERANCE = 0.02  # maps are often rounded to a multiple of 14 or 32 pixels


def find_maps(
    folder: Path, keys: Collection[ViewKey], image_stems: Mapping[ViewKey, str], suffixes: set[str]
) -> dict[ViewKey, Path]:
    """The file of each view that has one: DIR/<camera>/<name>, named as the recorded image is or,
    where no file of the camera is, with the frame's number.

    Raises:
        AdapterError: the folder does not exist.
    """
    _check_folder(folder)
    found: dict[ViewKey, Path] = {}
    for camera in dict.fromkeys(key.camera for key in keys):
        own = [key for key in keys if key.camera == camera]
        files = sorted(p for p in (folder / camera).glob("*") if p.suffix.lower() in suffixes)
        by_stem = {path.stem: path for path in files}
        named = {k: by_stem[image_stems[k]] for k in own if image_stems.get(k) in by_stem}
        by_number = {int(p.stem): p for p in files if _NUMBER.fullmatch(p.stem)}
        found |= named or {k: by_number[k.frame] for k in own if k.frame in by_number}
    return found


def find_sparse(
    folder: Path, keys: Collection[ViewKey], camera_names: Sequence[str]
) -> dict[ViewKey, Path]:
    """The file DIR/<frame>_<camera>.npy of each view that has one. <camera> is a camera's name, or
    its number in the scene's order as Street Gaussians counts them.

    Raises:
        AdapterError: the folder does not exist.
    """
    _check_folder(folder)
    wanted = set(keys)
    found: dict[ViewKey, Path] = {}
    for path in sorted(folder.glob("*.npy")):
        match = _SPARSE_NAME.fullmatch(path.stem)
        if match is None:
            continue
        name = match[2]
        if name not in camera_names and _NUMBER.fullmatch(name) and int(name) < len(camera_names):
            name = camera_names[int(name)]
        key = ViewKey(int(match[1]), name)
        if key in wanted:
            found[key] = path
    return found


def read_metric(path: Path) -> np.ndarray:
    """float32 [h, w] metres, 0 where unknown, from a 16-bit image of metres x 256."""
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise AdapterError(f"{path} cannot be decoded")
    if image.dtype != np.uint16 or image.ndim != 2:
        raise AdapterError(
            f"{path} must be a 16-bit image of one channel, metres x {METRIC_PER_M:.0f}; "
            f"it is {image.dtype} {list(image.shape)}"
        )
    return image.astype(np.float32) / np.float32(METRIC_PER_M)


def read_relative(path: Path) -> np.ndarray:
    """float32 [h, w] of any unit, larger where nearer, NaN where unknown, from .npy or an image."""
    if path.suffix.lower() == ".npy":
        values = read_array(path)
    else:
        values = decode_image(path, cv2.IMREAD_UNCHANGED)
        if values is None:
            raise AdapterError(f"{path} cannot be decoded")
        if values.ndim == 3 and (values[..., :1] == values[..., :3]).all():
            values = values[..., 0]  # grey written with three channels
    values = values[0] if values.ndim == 3 and len(values) == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "fiu" or values.size == 0:
        raise AdapterError(
            f"{path} must be one inverse depth a pixel, [height, width], not colours; "
            f"it is {values.dtype} {list(values.shape)}"
        )
    out = values.astype(np.float32)
    out[~np.isfinite(out)] = np.nan
    return out


def read_sparse(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Street Gaussians' depth: mask bool [h, w] and the metres of its pixels, float32 [M]."""
    held = read_array_dict(path)
    mask, value = held.get("mask"), held.get("value")
    if mask is None or value is None or mask.ndim != 2:
        raise AdapterError(
            f"{path} must hold 'mask' [height, width] and 'value'; it holds "
            f"{ {name: list(array.shape) for name, array in held.items()} }"
        )
    mask = mask.astype(np.bool_)
    if value.dtype.kind not in "fiu" or value.shape != (int(mask.sum()),):
        raise AdapterError(
            f"{path}: 'value' must hold a depth for each of the {int(mask.sum())} pixels of "
            f"'mask'; it is {value.dtype} {list(value.shape)}"
        )
    return mask, value.astype(np.float32)


def check_aspect(path: Path, shape: Sequence[int], camera: Camera) -> None:
    """Refuse maps of another shape than the image: they are of another camera, or cropped."""
    error = (shape[1] / shape[0]) / (camera.width / camera.height) - 1
    if abs(error) > _ASPECT_TOLERANCE:
        raise AdapterError(
            f"{path} is of {shape[1]}x{shape[0]} pixels; a map of camera {camera.name!r} has the "
            f"proportions of its image, {camera.width}x{camera.height}"
        )


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise AdapterError(f"{folder}: no such folder; depth maps were to be read from it")
