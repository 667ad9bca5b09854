"""Recorded images read at the size of a camera, from files that may be missing or damaged."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from augment.cameras import Camera
from recipes.files import open_file

_MAX_BYTES = 1 << 30  # of a file
# JPEG decoders can leave out the finest parts of each 8x8 block, which costs far less.
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}


def decode_image(path: Path, flags: int) -> np.ndarray | None:
    """As cv2.imread, but of regular files only: a pipe would keep it waiting."""
    if _unpacked(path):
        return None
    try:
        with open_file(path) as file:
            data = np.frombuffer(file.read(_MAX_BYTES), np.uint8)
    except OSError:
        return None
    return cv2.imdecode(data, flags) if len(data) else None


def has_image(path: Path) -> bool:
    """Whether the image is there, or can be had from a table (see packed_images)."""
    if path.is_file():
        return True
    from augment.files.packed_images import is_packed  # pyarrow would be loaded with it

    return is_packed(path)


def _unpacked(path: Path) -> str:
    """Have the image written if it is missing and a table has it; what is wrong with it there."""
    if os.path.lexists(path):
        return ""
    from augment.files.packed_images import unpack_image

    return unpack_image(path)


class ImageFault(Exception):
    """What is wrong with an image file, as the end of a sentence that starts with its path."""


def is_whole_jpeg(path: Path) -> bool:
    """Whether the file is a JPEG by its ends; no other kind is looked at further.

    Raises:
        ImageFault: missing, unreadable, or a JPEG that is cut short: decoders fill that with grey.
    """
    if fault := _unpacked(path):
        raise ImageFault(fault)
    try:
        with open_file(path) as file:
            head = file.read(2)
            size = file.seek(0, 2)
            file.seek(max(0, size - 64))  # some cameras pad the file behind the end marker
            tail = file.read()
    except FileNotFoundError:
        raise ImageFault("does not exist") from None
    except OSError as error:
        raise ImageFault(f"cannot be read ({error.strerror or error})") from None
    if head == b"\xff\xd8" and b"\xff\xd9" not in tail:
        raise ImageFault("is cut short")
    return head == b"\xff\xd8"


def read_scaled(path: Path, full: Camera, scaled: Camera) -> np.ndarray:
    """The image of camera `full` at the size of camera `scaled`: RGB uint8 [H, W, 3].

    Each pixel is the mean of the area it covers. Files may be any kind that OpenCV decodes; their
    size may differ from the camera's by less than the reduction of the decoder (8 pixels at most).

    Raises:
        ImageFault: missing, cut short, not decodable, or not of the camera's size."""
    is_jpeg = is_whole_jpeg(path)
    step = 1
    while is_jpeg and step < 8 and _can_be_reduced(full, scaled, 2 * step):
        step *= 2
    image = decode_image(path, _REDUCED[step])
    if image is None:
        raise ImageFault("cannot be decoded")
    size = (-(-full.height // step), -(-full.width // step))
    if image.shape[:2] != size:
        height, width = image.shape[0] * step, image.shape[1] * step
        about = "about " if step > 1 else ""
        raise ImageFault(
            f"is of {about}{width}x{height} pixels; its camera is of {full.width}x{full.height}"
        )
    if (scaled.height, scaled.width) != size:
        image = cv2.resize(image, (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _can_be_reduced(full: Camera, scaled: Camera, step: int) -> bool:
    """Whether 1/step of the size is not below the size asked for, and divides both sides: an odd
    remainder would shift pixels."""
    divides = full.width % step == 0 and full.height % step == 0
    return divides and full.width // step >= scaled.width and full.height // step >= scaled.height
