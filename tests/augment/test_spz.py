"""Gaussians in .spz files: what is kept, against the format's rules one by one, and refusals."""

from __future__ import annotations

import dataclasses
import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.files.spz import read_spz, write_spz
from tests.augment.test_splat_formats import some_gaussians

MAGIC = 0x5053474E


def packed(
    version: int, columns: bytes, *, count: int = 1, degree: int = 0, bits: int = 12, flags: int = 0
) -> bytes:
    header = struct.pack("<IIIBBBB", MAGIC, version, count, degree, bits, flags, 0)
    return gzip.compress(header + columns)


def test_bytes_mean_what_the_format_says(tmp_path: Path) -> None:
    """A Gaussian of every version, by hand."""
    place = (-3 * 4096 & 0xFFFFFF).to_bytes(3, "little") + (4096).to_bytes(3, "little") + bytes(3)
    rest = bytes([51, 255, 128, 0, 160, 176, 144])  # opacity, colours, scales
    half = math.sqrt(0.5)
    smallest = 3 << 30 | (1 << 9 | 511) << 20  # w is missing, x = -sqrt(1/2), y = z = 0
    cases = {
        1: (np.array([-3, 1, 0], "<f2").tobytes(), bytes([128, 128, 255]), [0, 0, 0, 1]),
        2: (place, bytes([128, 128, 255]), [0, 0, 0, 1]),
        3: (place, smallest.to_bytes(4, "little"), [half, -half, 0, 0]),
    }
    for version, (where, turn, quat) in cases.items():
        path = tmp_path / f"v{version}.spz"
        path.write_bytes(packed(version, where + rest + turn))
        found = read_spz(path).gaussians
        assert found.means[0].tolist() == [-3, 1, 0]
        assert found.opacities.item() == pytest.approx(0.2)
        colour = [(255 / 255 - 0.5) / 0.15, (128 / 255 - 0.5) / 0.15, -0.5 / 0.15]
        assert found.sh[0, 0].tolist() == pytest.approx(colour)
        assert found.scales[0].log().tolist() == pytest.approx([0, 1, -1], abs=1e-6)
        # A byte of 128 is 1/255 from 0.
        assert found.quats[0].tolist() == pytest.approx(quat, abs=0.005)
    # Colour is the inner axis of coefficients.
    sh = bytes(range(119, 128))
    path.write_bytes(packed(3, place + rest + cases[3][1] + sh, degree=1))
    stored = read_spz(path).gaussians.sh[0, 1:] * 128 + 128
    assert stored.tolist() == [[119, 120, 121], [122, 123, 124], [125, 126, 127]]


def test_places_far_away_keep_fewer_bits(tmp_path: Path) -> None:
    gaussians = some_gaussians(count=8, bands=1)
    far = dataclasses.replace(gaussians, means=gaussians.means * 1000)
    write_spz(tmp_path / "far.spz", far)
    error = (read_spz(tmp_path / "far.spz").gaussians.means - far.means).abs().max()
    assert 2**-12 < error < 0.01
    beyond = dataclasses.replace(gaussians, means=gaussians.means * 1e7)
    with pytest.raises(SceneError, match="ends at 8388607"):
        write_spz(tmp_path / "beyond.spz", beyond)


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    noise = np.random.default_rng(0).bytes(200_000)
    cases = {
        "no stream": (b"\x1f\x8bnothing", "not a whole .spz"),
        "no magic": (gzip.compress(b"x" * 100), "NGSP"),
        "version": (packed(4, bytes(99)), "version 4 .* only 1 to 3"),
        "degree": (packed(3, bytes(99), degree=5), "degree 5"),
        "bits": (packed(3, bytes(99), bits=30), "30 fractional bits"),
        "extended": (packed(3, bytes(99), flags=2), "vendors' extensions"),
        "none": (packed(3, b"", count=0), "announces 0 Gaussians"),
        "a bomb": (packed(3, bytes(99), count=1 << 31), "announces 2147483648 Gaussians"),
        "deflated": (packed(3, noise, count=10**7), "10000000 Gaussians of 56 bytes"),
        "short": (packed(3, bytes(99), count=40), "columns end early"),
    }
    for name, (data, message) in cases.items():
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
