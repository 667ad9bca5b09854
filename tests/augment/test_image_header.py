"""Formats and sizes of image files by their first bytes."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from augment.files.image_size import ImageHeader, image_header, read_image_header
from tests.exif import with_orientation


def encoded(suffix: str, pixels: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(suffix, pixels, options)[1].tobytes()


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [(".png", "PNG"), (".bmp", "BMP"), (".tif", "TIFF"), (".webp", "WebP"), (".jpg", "JPEG")],
)
def test_headers_know_the_size(suffix, kind):
    for width, height in ((1, 1), (300, 7), (17, 301)):
        data = encoded(suffix, np.zeros((height, width, 3), np.uint8))
        assert image_header(data) == ImageHeader(kind, width, height)
        for length in range(0, 24):
            assert image_header(data[:length]) is None or length > 20


def test_lossless_webp_headers_too():
    data = encoded(".webp", np.zeros((9, 33, 4), np.uint8), cv2.IMWRITE_WEBP_QUALITY, 101)
    assert image_header(data) == ImageHeader("WebP", 33, 9)


def test_pngs_of_one_channel_are_told():
    data = encoded(".png", np.zeros((9, 33), np.uint8))
    assert image_header(data) == ImageHeader("PNG", 33, 9, is_grey=True)


def test_the_size_of_a_jpeg_may_lie_behind_previews(tmp_path):
    data = encoded(".jpg", np.zeros((9, 33, 3), np.uint8))
    preview = b"\xff\xe1" + struct.pack(">H", 65535) + bytes(65533)
    path = tmp_path / "a.jpg"
    for previews in (0, 1, 3):
        path.write_bytes(data[:2] + previews * preview + data[2:])
        assert read_image_header(path) == ImageHeader("JPEG", 33, 9)
    path.write_bytes(data[:2] + 100 * preview + data[2:])
    assert read_image_header(path) is None
    with pytest.raises(FileNotFoundError):
        read_image_header(tmp_path / "b.jpg")


def test_orientation_and_bits_are_told_and_damaged_exif_says_nothing():
    pixels = np.zeros((9, 33, 3), np.uint8)
    for suffix in (".jpg", ".png"):
        data = encoded(suffix, pixels)
        for orientation, said, turned in ((3, 3, (33, 9)), (6, 6, (9, 33)), (9, 1, (33, 9))):
            header = image_header(with_orientation(data, orientation))
            assert header is not None and (header.orientation, header.size) == (said, (33, 9))
            assert header.turned_size == turned
        whole = with_orientation(data, 6)
        at = whole.index(b"II*\0")
        for end in range(at, at + 26):  # within EXIF
            damaged = image_header(whole[:at] + whole[at:end].ljust(26, b"\xff") + whole[at + 26 :])
            assert damaged is not None and damaged.size == (33, 9)
    deep = image_header(encoded(".png", pixels.astype(np.uint16)))
    assert deep is not None and deep.bits == 16
