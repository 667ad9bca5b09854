"""What an image file says of itself, read before a decoder allocates for its pixels."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from recipes.files import open_file

FORMATS = "JPEG, PNG, WebP, TIFF or BMP"

_FIRST_BYTES = 4096  # hold the header of nearly any image
_MAX_BYTES = 1 << 22  # of a JPEG whose previews and profiles lie before its size
_PNG_GREY = (b"\0", b"\4")  # colour types without and with alpha
_PNG_BITS_AT = 24  # offset of the bits a channel
_TURNED = 5  # from this EXIF orientation on, width and height change places
_JPEG_EXIF = 0xE1  # APP1
_EXIF_START = b"Exif\0\0"
_EXIF_ORIENTATION = 0x112
_TIFF_SIZE = (256, 257)  # ImageWidth, ImageLength
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0-15 less DHT, JPG, DAC


@dataclass(frozen=True)
class ImageHeader:
    """format: one of FORMATS. width, height: as stored, before any turn that EXIF asks for.
    is_grey: one channel (told of PNG only). bits: of a channel (told of PNG only, else 8).
    orientation: EXIF's, 1 to 8, told of JPEG and PNG; 1 where there is none.
    """

    format: str
    width: int
    height: int
    is_grey: bool = False
    bits: int = 8
    orientation: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as stored."""
        return self.width, self.height

    @property
    def turned_size(self) -> tuple[int, int]:
        """Width and height of the image turned as its EXIF orientation asks for."""
        return self.size[::-1] if self.orientation >= _TURNED else self.size


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
            if found is None or min(found) < 1:
                return None
            orientation = _orientation(_exif(name, data))
            if name != "PNG":
                return ImageHeader(name, *found, orientation=orientation)
            is_grey = data[25:26] in _PNG_GREY
            return ImageHeader(name, *found, is_grey, data[_PNG_BITS_AT], orientation)
    return None


def _exif(format: str, data: bytes) -> bytes:
    """EXIF's entries, a TIFF, in the part of a JPEG or PNG before its pixels; empty without any."""
    if format == "JPEG":
        for marker, at in _jpeg_segments(data):
            end = at + int.from_bytes(data[at : at + 2], "big")
            if marker == _JPEG_EXIF and data[at + 2 : end].startswith(_EXIF_START):
                return data[at + 2 + len(_EXIF_START) : end]
    if format == "PNG":
        at = 8
        while len(kind := data[at + 4 : at + 8]) == 4 and kind != b"IDAT":
            end = at + 8 + int.from_bytes(data[at : at + 4], "big")
            if kind == b"eXIf":
                return data[at + 8 : end]
            at = end + 4  # behind the checksum
    return b""


def _orientation(exif: bytes) -> int:
    """EXIF's orientation, 1 to 8; 1 where it is not said, or damaged."""
    try:
        value = _tiff_numbers(exif, (_EXIF_ORIENTATION,)).get(_EXIF_ORIENTATION, 1)
    except struct.error:
        return 1
    return value if 1 <= value <= 8 else 1


def _bmp(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # negative: stored from the top down


def _jpeg(data: bytes) -> tuple[int, int] | None:
    for marker, at in _jpeg_segments(data):
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
    return None


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """The marker of every segment and the offset of its length, up to the frame's header."""
    at, marker = 2, 0
    while marker not in _JPEG_FRAMES and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            yield marker, at + 2
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]


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
    size = _tiff_numbers(data, _TIFF_SIZE)
    return (size[256], size[257]) if len(size) == 2 else None


def _tiff_numbers(data: bytes, tags: Sequence[int]) -> dict[int, int]:
    """The numbers (SHORT or LONG) that the first directory of a TIFF has under some tags."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    numbers = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        if tag in tags and kind in (3, 4):
            code = f"{order}{'H' if kind == 3 else 'I'}"
            (numbers[tag],) = struct.unpack_from(code, data, entry + 8)
    return numbers
