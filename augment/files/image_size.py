"""Reads the header of an image file before a decoder allocates memory, and the stored pixels."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from recipes.files import open_file

FORMATS = "JPEG, PNG, WebP, TIFF or BMP"

_FIRST_BYTES = 4096  # bytes that hold the header of nearly any image
_MAX_BYTES = 1 << 22  # bytes searched in a JPEG whose previews and profiles lie before its size
_PNG_GREY_TYPES = (b"\0", b"\4")  # PNG's grey colour types, without and with alpha
_PNG_BITS_OFFSET = 24  # byte offset of the bits a channel in a PNG
_MIN_SIDEWAYS_ORIENTATION = 5  # from this EXIF orientation on, width and height change places
_JPEG_EXIF_MARKER = 0xE1  # APP1
_EXIF_START = b"Exif\0\0"  # first bytes of an EXIF segment
_EXIF_ORIENTATION_TAG = 0x112  # EXIF's tag of the orientation
_TIFF_SIZE_TAGS = (256, 257)  # ImageWidth, ImageLength
_JPEG_LONE_MARKERS = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without a length
_JPEG_FRAME_MARKERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0-15 less DHT, JPG, DAC


@dataclass(frozen=True)
class ImageHeader:
    """The header of an image file."""

    format: str  # one of FORMATS
    width: int  # pixels, as stored, before any rotation that EXIF asks for
    height: int  # pixels, likewise
    is_grey: bool = False  # True for a PNG of one channel; False for other formats
    bits: int = 8  # bits a channel of a PNG; 8 for other formats
    orientation: int = 1  # EXIF's orientation of a JPEG or PNG, 1 to 8; 1 where there is none

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height in pixels as stored."""
        return self.width, self.height

    @property
    def turned_size(self) -> tuple[int, int]:
        """Return width and height in pixels, rotated as the EXIF orientation asks for."""
        return (
            (self.height, self.width)
            if self.orientation >= _MIN_SIDEWAYS_ORIENTATION
            else self.size
        )


def read_image_header(path: str | Path) -> ImageHeader | None:
    """Read the header of an image file from its first bytes.

    Returns:
        The header, or None as `image_header`.

    Raises:
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        data = file.read(_FIRST_BYTES)
        return image_header(data) or image_header(data + file.read(_MAX_BYTES))


def image_header(data: bytes) -> ImageHeader | None:
    """Return the header of an image file's content.

    Returns:
        None where the content is not one of FORMATS, or ends within its header.
    """
    for head, name, size in (
        (b"\xff\xd8", "JPEG", _jpeg),
        (b"\x89PNG\r\n\x1a\n", "PNG", lambda data: struct.unpack_from(">II", data, 16)),
        (b"RIFF", "WebP", _webp),
        (b"II*\0", "TIFF", _tiff),
        (b"MM\0*", "TIFF", _tiff),
        (b"BM", "BMP", _bmp),
    ):
        if data.startswith(head):
            try:
                image_size = size(data)
            except (struct.error, IndexError):
                return None
            if image_size is None or min(image_size) < 1:
                return None
            orientation = _orientation(_exif(name, data))
            if name != "PNG":
                return ImageHeader(name, *image_size, orientation=orientation)
            is_grey = data[25:26] in _PNG_GREY_TYPES
            return ImageHeader(name, *image_size, is_grey, data[_PNG_BITS_OFFSET], orientation)
    return None


def _exif(format: str, data: bytes) -> bytes:
    """Return EXIF's entries (a TIFF) from a JPEG or PNG before its pixels; empty without EXIF."""
    if format == "JPEG":
        for marker, offset in _jpeg_segments(data):
            end = offset + int.from_bytes(data[offset : offset + 2], "big")
            if marker == _JPEG_EXIF_MARKER and data[offset + 2 : end].startswith(_EXIF_START):
                return data[offset + 2 + len(_EXIF_START) : end]
    if format == "PNG":
        offset = 8
        while len(kind := data[offset + 4 : offset + 8]) == 4 and kind != b"IDAT":
            end = offset + 8 + int.from_bytes(data[offset : offset + 4], "big")
            if kind == b"eXIf":
                return data[offset + 8 : end]
            offset = end + 4  # behind the checksum
    return b""


def _orientation(exif: bytes) -> int:
    """Return EXIF's orientation, 1 to 8; 1 where it is missing or damaged."""
    try:
        value = _tiff_numbers(exif, (_EXIF_ORIENTATION_TAG,)).get(_EXIF_ORIENTATION_TAG, 1)
    except struct.error:
        return 1
    return value if 1 <= value <= 8 else 1


def _bmp(data: bytes) -> tuple[int, int]:
    """Return the width and height of a BMP in pixels."""
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # negative: stored from the top down


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """Return the width and height of a JPEG in pixels."""
    for marker, offset in _jpeg_segments(data):
        if marker in _JPEG_FRAME_MARKERS:
            height, width = struct.unpack_from(">HH", data, offset + 3)
            return width, height
    return None


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the marker of every segment and the offset of its length, up to the frame's header."""
    offset = 2
    marker = 0
    while marker not in _JPEG_FRAME_MARKERS and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # padding
            offset += 1
        elif marker in _JPEG_LONE_MARKERS:
            offset += 2
        else:
            yield marker, offset + 2
            offset += 2 + struct.unpack_from(">H", data, offset + 2)[0]


def _webp(data: bytes) -> tuple[int, int] | None:
    """Return the width and height of a WebP in pixels."""
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[offset : offset + 3], "little") for offset in (24, 27))
        return width + 1, height + 1
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """Return the width and height of a TIFF in pixels."""
    size = _tiff_numbers(data, _TIFF_SIZE_TAGS)
    return (size[256], size[257]) if len(size) == 2 else None


def _tiff_numbers(data: bytes, tags: Sequence[int]) -> dict[int, int]:
    """Return the numbers (SHORT or LONG) of the given tags in the first directory of a TIFF."""
    byte_order = "<" if data[:2] == b"II" else ">"
    (offset,) = struct.unpack_from(f"{byte_order}I", data, 4)
    (count,) = struct.unpack_from(f"{byte_order}H", data, offset)
    numbers = {}
    for entry_offset in range(offset + 2, offset + 2 + 12 * count, 12):
        tag, value_type = struct.unpack_from(f"{byte_order}HH", data, entry_offset)
        if tag in tags and value_type in (3, 4):
            number_format = f"{byte_order}{'H' if value_type == 3 else 'I'}"
            (numbers[tag],) = struct.unpack_from(number_format, data, entry_offset + 8)
    return numbers


def decode_pixels(data: bytes | np.ndarray, flags: int) -> np.ndarray | None:
    """Return the pixels of an image file's content as they are stored; EXIF rotates nothing.

    Args:
        data: the file's bytes.
        flags: flags of cv2.imdecode.

    Returns:
        The array of cv2.imdecode; None where the content cannot be decoded.
    """
    data = np.frombuffer(data, np.uint8)
    try:
        return cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    except cv2.error:  # larger than OpenCV allows
        return None
