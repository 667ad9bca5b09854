"""Reads recorded images at the size of a camera, from files that may be missing or damaged.

Datasets, base photos and training read images through this module. Pixels are read as they are
stored: poses and intrinsics belong to the stored image, so no image is rotated as its EXIF
orientation asks for.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from augment.files.image_size import ImageHeader, decode_pixels, read_image_header
from augment.scene.cameras import Camera
from recipes.files import open_file

_MAX_BYTES = 1 << 30  # bytes of an image file that are read
# OpenCV's flags by the factor of reduction. JPEG decoders can leave out the finest parts of each
# 8x8 block, which costs far less.
_REDUCED_FLAGS = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}


_MAX_12_BIT_VALUE = (1 << 12) - 1  # the largest number of 12 bits
# The fault of an image whose values fit into 12 bits.
TWELVE_BITS = (
    f"has 16 bits a channel and no value above {_MAX_12_BIT_VALUE} of 65535, as files of a "
    "sensor's 12 bits; it would be black: store 8 bits, or multiply its values by 16"
)


def has_12_bits(data: bytes | np.ndarray) -> bool:
    """Return True for an image file of 16 bits a channel whose values fit into 12.

    Such an image holds a sensor's own numbers and would be shown at a sixteenth of its brightness.
    """
    values = decode_pixels(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if values is None or values.dtype != np.uint16:
        return False
    return int(values.max()) <= _MAX_12_BIT_VALUE


def decode_image(path: Path, flags: int) -> np.ndarray | None:
    """Return the stored pixels of an image file, see `decode_pixels`; None if it cannot be read.

    Only regular files are read: a pipe would keep the program waiting.
    """
    if _unpack_fault(path):
        return None
    try:
        with open_file(path) as file:
            return decode_pixels(file.read(_MAX_BYTES), flags)
    except OSError:
        return None


def has_image(path: Path) -> bool:
    """Return True if the image exists, or can be written from a table or from a recorded image.

    See `packed_images` and `undistorted_images`.
    """
    if path.is_file():
        return True
    # Imported here: packed_images loads pyarrow.
    from augment.files.packed_images import is_packed
    from augment.files.undistorted_images import is_undistorted_copy

    return is_undistorted_copy(path) or is_packed(path)


def _unpack_fault(path: Path) -> str:
    """Write the image if it is missing and can be made; return the fault of its source, or ""."""
    if os.path.lexists(path):
        return ""
    from augment.files.packed_images import unpack_image
    from augment.files.undistorted_images import unpack_copy

    return unpack_copy(path) or unpack_image(path)


class ImageFault(Exception):
    """A fault of an image file. Its text is the end of a sentence that starts with the path."""


def is_whole_jpeg(path: Path) -> bool:
    """Return True for a JPEG with both its ends, False for any other kind of file.

    Raises:
        ImageFault: the file is missing, unreadable, or a JPEG that is cut short: decoders would
            fill the missing part with grey.
    """
    if fault := _unpack_fault(path):
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
    """Read the image of camera `full` at the size of camera `scaled`.

    Each pixel is the mean of the area it covers. Files may be of any kind that OpenCV decodes.
    Their size may differ from the camera's by less than the reduction of the decoder (8 pixels at
    most).

    Returns:
        RGB, uint8 [H, W, 3].

    Raises:
        ImageFault: the image is missing, cut short, not decodable, or not of the camera's size.
    """
    is_jpeg = is_whole_jpeg(path)
    if fault := twelve_bits_fault(path):
        raise ImageFault(fault)
    step = 1
    while is_jpeg and step < 8 and _can_be_reduced(full, scaled, 2 * step):
        step *= 2
    image = decode_image(path, _REDUCED_FLAGS[step])
    if image is None:
        raise ImageFault("cannot be decoded")
    size = (-(-full.height // step), -(-full.width // step))
    if image.shape[:2] != size:
        height = image.shape[0] * step
        width = image.shape[1] * step
        qualifier = "about " if step > 1 else ""
        raise ImageFault(
            f"is of {qualifier}{width}x{height} pixels; its camera is of {full.width}x{full.height}"
            f"{exif_hint(read_image_header(path), (full.width, full.height))}"
        )
    if (scaled.height, scaled.width) != size:
        image = cv2.resize(image, (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def twelve_bits_fault(path: Path) -> str:
    """Return the fault of an image file of 16 bits a channel that holds 12; "" without."""
    header = read_image_header(path)
    if header is None or header.bits != 16:
        return ""
    with open_file(path) as file:
        return TWELVE_BITS if has_12_bits(file.read(_MAX_BYTES)) else ""


def exif_hint(header: ImageHeader | None, expected: tuple[int, int]) -> str:
    """Return the end of a sentence about an image that lacks the expected width and height.

    The hint names EXIF's orientation if the image would fit after its rotation; else it is empty.
    """
    if header is None or header.size == expected or header.turned_size != expected:
        return ""
    return (
        f"; its EXIF orientation is {header.orientation}, and images are read as they are stored: "
        f"turn the pixels in the file, or give size, intrinsics and pose of the stored image"
    )


def _can_be_reduced(full: Camera, scaled: Camera, step: int) -> bool:
    """Return True if 1/step of the size is large enough, and step divides both sides.

    An odd remainder would shift pixels.
    """
    is_divisor = full.width % step == 0 and full.height % step == 0
    return (
        is_divisor and full.width // step >= scaled.width and full.height // step >= scaled.height
    )
