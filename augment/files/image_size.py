"""What an image file says of itself, read before a decoder allocates for its pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from recipes.files import open_file

FORMATS = "JPEG, PNG, WebP, TIFF or BMP"

_FIRST_BYTES = 4096  # hold the header of nearly any image
_MAX_BYTES = 1 << 22  # of a JPEG whose previews and profiles lie before its size
_PNG_GREY = (b"\0", b"\4")  # colour types without and with alpha
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0-15 less DHT, JPG, DAC


@dataclass(frozen=True)
class ImageHeader:
    """format: one of FORMATS. width, height: as stored, before any turn that EXIF asks for.
    is_grey: one channel (told of PNG only).
    """

    format: str
    width: int
    height: int
    is_grey: bool = False


def read_image_header(path: str | Path) -> ImageHeader | None:
    """Of a file by its first bytes; None as for `image_header`. Raises OSError: the file cannot be
    read.
    """
    with open_file(path) as file:
        data = file.read(_FIRST_BYTES)
        return image_header(data) or image_header(data + file.read(_MAX_BYTES))


def image_header(data: bytes) -> ImageHeader | None:
    """Of a file's content; None where it is not one of FORMATS, or ends within its header."""
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
                found = size(data)
            except (struct.error, IndexError):
                return None
            is_grey = name == "PNG" and data[25:26] in _PNG_GREY
            return None if found is None or min(found) < 1 else ImageHeader(name, *found, is_grey)
    return None


def _bmp(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # negative: stored from the top down


def _jpeg(data: bytes) -> tuple[int, int] | None:
    at = 2
    while data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
        return width + 1, height + 1
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    size = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        if tag in (256, 257) and kind in (3, 4):  # ImageWidth, ImageLength as SHORT or LONG
            code = f"{order}{'H' if kind == 3 else 'I'}"
            (size[tag],) = struct.unpack_from(code, data, entry + 8)
    return (size[256], size[257]) if len(size) == 2 else None
