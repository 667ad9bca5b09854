"""Gaussians in .spz files: what is kept, against the format's rules one by one, and refusals."""

from __future__ import annotations

import dataclasses
import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import torch

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
        "version": (packed(9, bytes(99)), "version 9 .* only 1 to 4"),
        "version 4": (packed(4, bytes(99)), "version 4 inside a gzip stream"),
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


# ---- Version 4 -----------------------------------------------------------------------------------


def packed_4(
    columns: list[bytes],
    *,
    count: int = 1,
    degree: int = 0,
    flags: int = 0,
    records: bytes = b"",
    offset: int | None = None,
    num_streams: int | None = None,
    sizes: dict[int, tuple[int, int]] | None = None,
) -> bytes:
    """A file of version 4. Offset, number and sizes of the streams may be wrong."""
    streams = [pyarrow.compress(column, codec="zstd", asbytes=True) for column in columns]
    header = struct.pack(
        "<IIIBBBB", MAGIC, 4, count, degree, 12, flags, num_streams or len(streams)
    )
    header += struct.pack("<I12x", 32 + len(records) if offset is None else offset)
    table = [(len(s), len(c)) for s, c in zip(streams, columns, strict=True)]
    for number, entry in (sizes or {}).items():
        table[number] = entry
    return header + records + b"".join(struct.pack("<QQ", *e) for e in table) + b"".join(streams)


def version_4_of(path: Path, *, flags: int = 0, records: bytes = b"") -> bytes:
    """The same content as in a file of version 3."""
    data = gzip.decompress(path.read_bytes())
    _, _, count, degree, _, _, _ = struct.unpack_from("<IIIBBBB", data)
    columns = []
    start = 16
    for width in (9, 1, 3, 3, 4, *((3 * ((degree + 1) ** 2 - 1),) if degree else ())):
        columns.append(data[start : start + count * width])
        start += count * width
    return packed_4(columns, count=count, degree=degree, flags=flags, records=records)


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_version_4_holds_the_same_numbers_as_version_3(tmp_path: Path, bands: int) -> None:
    old, new, bare = tmp_path / "3.spz", tmp_path / "4.spz", tmp_path / "bare.spz"
    write_spz(old, some_gaussians(300, bands))
    new.write_bytes(version_4_of(old))
    bare.write_bytes(gzip.decompress(old.read_bytes()))
    expected = read_splats(old)
    for path in (new, bare):
        read = read_splats(path)
        assert read.notes == expected.notes and read.problems == ()
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.equal(getattr(read.gaussians, name), getattr(expected.gaussians, name))


def record(kind: int, payload: bytes) -> bytes:
    """A record of vendors."""
    return struct.pack("<II", kind, len(payload)) + payload


def test_records_of_vendors_are_named_and_axes_are_followed(tmp_path: Path) -> None:
    old, path = tmp_path / "3.spz", tmp_path / "4.spz"
    write_spz(old, some_gaussians(3, 1))
    orbit = record(0xADBE0002, bytes(12))
    # Numbers of the axes: 4 is RUB, 6 RDF, 0 not stated, 16 RFU; letters are where x, y, z point.
    for number, up in ((4, "+y"), (6, "-y"), (0, "+y"), (16, "+z")):
        records = orbit + record(0xADBE0003, struct.pack("<I", number))
        path.write_bytes(version_4_of(old, flags=2, records=records))
        read = read_splats(path)
        assert read.notes == {"up": up}, number
        assert [p for p in read.problems if "left out 1 records of vendors: 0xadbe0002" in p]
    for number, message in (
        (8, "RUF are left-handed"),
        (15, "LFU are left-handed"),
        (17, "0 to 16"),
    ):
        records = record(0xADBE0003, struct.pack("<I", number))
        path.write_bytes(version_4_of(old, flags=2, records=records))
        with pytest.raises(SceneError, match=message):
            read_splats(path)


def test_refusals_of_version_4(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    columns = [bytes(9), b"\x80", bytes(3), bytes(3), bytes(4)]
    whole = packed_4(columns)
    path.write_bytes(whole)
    assert len(read_splats(path).gaussians) == 1
    many = 10**7  # positions that zstd packs into some kilobytes
    bomb = [bytes(9 * many), b"", b"", b"", b""]
    flagged = {"flags": 2}
    cases = {
        "a header": (whole[:20], "not a whole .spz"),
        "a table": (whole[:60], "not a whole .spz"),
        "a stream": (whole[:-5], "table states .* truncated"),
        "none": (packed_4(columns, count=0), "announces 0 Gaussians"),
        "too many": (packed_4(columns, count=2), "18 are expected for 2 Gaussians"),
        "memory": (packed_4(columns, count=1 << 31), "announces 2147483648 Gaussians"),
        "a bomb": (packed_4(bomb, count=many), "announces 10000000 Gaussians"),
        "a hidden bomb": (packed_4([bytes(1 << 26), *columns[1:]]), "67108864 unpacked; 9 are"),
        "a stated bomb": (packed_4(columns, sizes={0: (18, 1 << 60)}), "unpacked; 9 are"),
        "a false size": (
            packed_4([bytes(1 << 20), *columns[1:]], sizes={0: (50, 9)}),
            "not a whole .spz",
        ),
        "a long stream": (packed_4(columns, sizes={4: (1 << 62, 4)}), "truncated or damaged"),
        "a short stream": (packed_4(columns, sizes={0: (3, 9)}), "not a whole .spz"),
        "an empty stream": (packed_4(columns, sizes={1: (0, 1)}), "not a whole .spz"),
        "few streams": (packed_4(columns, num_streams=4), "4 streams; 5 are expected"),
        "many streams": (packed_4(columns, num_streams=255), "255 streams; 5 are expected"),
        "no harmonics": (packed_4(columns, degree=3), "5 streams; 6 are expected"),
        "degree": (packed_4(columns, degree=5), "degree 5"),
        "an offset": (packed_4(columns, offset=16), "table begins at byte 16"),
        "a far offset": (
            packed_4(columns, offset=(1 << 32) - 1),
            "table begins at byte 4294967295",
        ),
        "a long record": (packed_4(columns, records=b"12345678", **flagged), "ends behind all"),
        "half a record": (packed_4(columns, records=b"123", **flagged), "not a whole .spz"),
        "no axes": (packed_4(columns, records=record(0xADBE0003, b"\xff" * 99), **flagged), "axes"),
        "long axes": (
            packed_4(columns, records=record(0xADBE0003, b"\xff" * 9999), **flagged),
            "its axes are number 4294967295; 0 to 16 are known",
        ),
        "noise": (whole[:112] + np.random.default_rng(0).bytes(len(whole) - 112), "not a whole"),
        "version 5": (b"NGSP\5" + whole[5:], "version 5 of .spz is not read"),
    }
    for name, (data, message) in cases.items():
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
