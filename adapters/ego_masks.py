"""Masks of the recording car that a user states, in place of those that images tell.

    scene URI:  pandaset:PATH/002?ego_masks=FOLDER

FOLDER has a file for each camera that sees the car: CAMERA.png, white on the car, or CAMERA.json
with polygons in pixels of the camera's images, x to the right and y down from the outer corner of
the first pixel:

    {"polygons": [[[0, 896], [960, 823.5], [1920, 897], [1920, 1080], [0, 1080]]]}

An optional "size": [width, height] says in which size the polygons were drawn. A camera without a
file does not see the car; neither does one whose list of polygons is empty. `with_ego_masks` puts
the masks into a scene; `augment.photo.own_car` uses them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool
from pydantic import BaseModel, ConfigDict, Field

from adapters.plain_files import Number, decode_image, read_json, validate_content
from adapters.uri import EGO_MASKS_KEY, add_to_uri
from augment.errors import AdapterError
from augment.files.undistorted_images import undistort
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.errors import nearest_word

# Suffixes of mask files.
SUFFIXES = (".png", ".json")
# Level from which a pixel of a mask image is white, of 255. Any part of a pixel on the car spoils
# it, so that half of white is enough.
_WHITE_LEVEL = 64
# Largest difference of a mask's proportions from the images', as a part.
_MAX_SHAPE_ERROR = 0.01
# Binary digits of a pixel to which corners of polygons are rounded.
_SUBPIXEL_BITS = 4

_Point = tuple[Number, Number]
_Polygon = Annotated[list[_Point], Field(min_length=3, max_length=100_000)]


class MaskFile(BaseModel):
    """Contents of CAMERA.json."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    polygons: list[_Polygon]
    """Outlines of the parts of the car, each a list of corners [x, y] in pixels."""
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    """Width and height of the image in which the corners were read; null for the camera's."""


def with_ego_masks(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the masks of a folder.

    Args:
        scene: the scene, with the cameras of its recorded images.
        folder: the folder of masks.

    Raises:
        AdapterError: the scene has no cameras, or `read_ego_masks` refuses the folder.
    """
    cameras = {
        name: next(f.cameras[name] for f in scene.frames if name in f.cameras)
        for name in scene.camera_names
    }
    if not cameras:
        raise AdapterError(
            f"{EGO_MASKS_KEY}={folder}: scene {scene.name!r} ({scene.source}) has no cameras, so "
            f"there is nothing to mask"
        )
    masks = {
        name: _undistorted(scene, mask, cameras[name])
        for name, mask in read_ego_masks(folder, cameras).items()
    }
    source = add_to_uri(scene.source, EGO_MASKS_KEY, str(folder.absolute()))
    return dataclasses.replace(scene, ego_masks=masks, source=source)


def _undistorted(scene: Scene, mask: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a mask of recorded images as the undistorted copies of these have it.

    Args:
        scene: the scene.
        mask: bool [H, W], of the images as they were recorded.
        camera: the camera of these images.
    """
    copies = (f.cameras[camera.name] for f in scene.seen_frames or () if camera.name in f.cameras)
    pinhole = next((copy for copy in copies if copy.is_pinhole), None)
    if camera.lens is None or pinhole is None:
        return mask
    return undistort(mask.astype(np.uint8) * 255, camera, pinhole) >= _WHITE_LEVEL


def read_ego_masks(
    folder: Path, cameras: Mapping[str, Camera], *, known_names: Sequence[str] = ()
) -> dict[str, Bool[np.ndarray, "_ _"]]:
    """Read the masks of the recording car in a folder, without empty ones.

    Args:
        folder: the folder.
        cameras: the cameras whose masks are read, by name; a mask gets its camera's size.
        known_names: names of further cameras, whose files are passed over.

    Returns:
        Masks by camera name, bool [H, W].

    Raises:
        AdapterError: there is no such folder, it holds no mask, a file is named like no camera, a
            camera has two files, or a file cannot be used.
    """
    names = dict.fromkeys((*cameras, *known_names))
    if not folder.is_dir():
        raise AdapterError(f"{folder}: there is no such folder; expected {_expected(names)}")
    paths: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        name = path.stem
        if path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
            continue
        if name not in names:
            near = nearest_word(name, tuple(names))
            guess = "" if near is None else f"did you mean {near + path.suffix}? "
            raise AdapterError(
                f"{path} is the mask of no camera; {guess}the cameras are {', '.join(names)}"
            )
        if name in paths:
            raise AdapterError(f"{folder} holds {paths[name].name} and {path.name}; keep one")
        paths[name] = path
    if not paths:
        raise AdapterError(f"{folder} holds no mask; expected {_expected(names)}")
    masks = {
        name: read_ego_mask(path, cameras[name]) for name, path in paths.items() if name in cameras
    }
    return {name: mask for name, mask in masks.items() if mask.any()}


def mask_files(folder: Path) -> list[Path]:
    """Return the mask files of a folder, in order of their names; none if it is not there."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def read_ego_mask(path: Path, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Read the mask of one camera, bool [H, W] at the camera's size.

    Args:
        path: CAMERA.png or CAMERA.json.
        camera: the camera.

    Raises:
        AdapterError: the file cannot be read, or has other proportions than the camera's images.
    """
    if path.suffix.lower() == ".json":
        return _draw_polygons(path, camera)
    image = decode_image(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise AdapterError(f"{path} cannot be decoded; expected an image, white on the own car")
    _check_shape(path, (image.shape[1], image.shape[0]), camera)
    interpolation = cv2.INTER_AREA if image.shape[1] >= camera.width else cv2.INTER_LINEAR
    size = (camera.width, camera.height)
    return cv2.resize(image, size, interpolation=interpolation) >= _WHITE_LEVEL


def _draw_polygons(path: Path, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Return the pixels inside the polygons of a file."""
    content = read_json(path, if_missing="a mask file of polygons")
    mask_file = validate_content(MaskFile, content, str(path))
    size = mask_file.size or (camera.width, camera.height)
    _check_shape(path, size, camera)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    scale = np.array([camera.width / size[0], camera.height / size[1]])
    # Corners far outside the image lie on its enlarged border: OpenCV counts in 32 bits.
    far = 8 * np.array([camera.width, camera.height], np.float64)
    for polygon in mask_file.polygons:
        corners = (np.array(polygon) * scale - 0.5).clip(-far, far)
        fixed = np.rint(corners * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(mask, [fixed], 1, shift=_SUBPIXEL_BITS)
    return mask > 0


def _check_shape(path: Path, size: tuple[int, int], camera: Camera) -> None:
    """Refuse a mask with other proportions than the camera's images."""
    error = (size[0] / size[1]) / (camera.width / camera.height) - 1
    if abs(error) > _MAX_SHAPE_ERROR:
        raise AdapterError(
            f"{path} is of {size[0]}x{size[1]} pixels; the mask of camera {camera.name!r} has the "
            f"proportions of its images, {camera.width}x{camera.height}"
        )


def _expected(names: Mapping[str, None]) -> str:
    """Return the files that a folder of masks may hold, for messages."""
    first = next(iter(names), "CAMERA")
    return (
        f"files named like the cameras ({', '.join(names)}): {first}.png, white on the recording "
        f"car, or {first}.json with polygons"
    )
