"""Image files in bytes, of kinds that OpenCV reads and does not write."""

from __future__ import annotations

import struct
import zlib

import numpy as np


def png(pixels: np.ndarray, color_type: int, *extra: tuple[bytes, bytes]) -> bytes:
    """A PNG of rows of uint8 or uint16 pixels [H, W, ...] with further chunks before the pixels."""
    height, width = pixels.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, color_type, 0, 0, 0)
    big = pixels.astype(pixels.dtype.newbyteorder(">"))
    rows = b"".join(b"\0" + row.tobytes() for row in big)
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with EXIF's tag 0x112."""
    entry = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0)
    exif = b"Exif\0\0" + b"II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def cmyk_jpeg(blocks: list[tuple[int, int, int, int]], *, adobe: bool) -> bytes:
    """A row of 8 x 8 blocks of one colour each: four components as stored, without conversion.

    Baseline, with the DC coefficients alone: a quantiser of 8 makes them the samples less 128.
    """
    parts = [b"\xff\xd8"]

    def segment(marker: int, data: bytes) -> None:
        parts.append(bytes((0xFF, marker)) + struct.pack(">H", len(data) + 2) + data)

    if adobe:  # transform 0: CMYK as it is, neither YCCK nor YCbCr
        segment(0xEE, b"Adobe" + struct.pack(">HHHB", 100, 0, 0, 0))
    segment(0xDB, bytes([0]) + bytes([8] * 64))
    components = b"".join(bytes((number, 0x11, 0)) for number in (1, 2, 3, 4))
    segment(0xC0, struct.pack(">BHHB", 8, 8, 8 * len(blocks), 4) + components)
    # Twelve sizes of DC in codes of 4 bits; one AC code of 1 bit, the end of a block.
    segment(0xC4, bytes([0x00, 0, 0, 0, 12, *[0] * 12]) + bytes(range(12)))
    segment(0xC4, bytes([0x10, 1, *[0] * 15]) + bytes([0]))
    scan = b"".join(bytes((number, 0x00)) for number in (1, 2, 3, 4))
    segment(0xDA, bytes([4]) + scan + bytes([0, 63, 0]))
    bits, before = "", [0, 0, 0, 0]
    for block in blocks:
        for at, value in enumerate(block):
            step, before[at] = value - 128 - before[at], value - 128
            size = abs(step).bit_length()
            coded = step if step >= 0 else step + (1 << size) - 1
            bits += f"{size:04b}" + (f"{coded:0{size}b}" if size else "") + "0"
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    return b"".join(parts) + data + b"\xff\xd9"
