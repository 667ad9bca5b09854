"""Gaussians in .ksplat files: bytes against the format's rules at each level, and refusals."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians
from tests.augment.test_splat_formats import some_gaussians, turn_deg

BUCKET_SIZE = 16  # Gaussians of a full bucket
EDGE = 5.0  # edge of a bucket
STEPS = 32767  # steps of half an edge
HEADER = struct.Struct("<BBxxIIIIHxx12xff")
SECTION = struct.Struct("<IIIIfHxxIIIIH")


class Buckets(NamedTuple):
    """The Gaussians of a section in buckets, the full ones first."""

    order: np.ndarray  # [N], the Gaussians' numbers
    centres: np.ndarray  # float32 [B, 3]
    bucket_of_row: np.ndarray  # [N]
    num_full: int
    partial_lengths: np.ndarray  # uint32 [P]


def buckets_of(means: np.ndarray) -> Buckets:
    """Buckets of the cells of a grid."""
    cells = np.floor(means / EDGE).astype(int)
    full: list[np.ndarray] = []
    partial: list[np.ndarray] = []
    for cell in np.unique(cells, axis=0):
        members = np.flatnonzero((cells == cell).all(1))
        for start in range(0, len(members), BUCKET_SIZE):
            part = members[start : start + BUCKET_SIZE]
            (full if len(part) == BUCKET_SIZE else partial).append(part)
    parts = [*full, *partial]
    centres = np.array([(cells[part[0]] + 0.5) * EDGE for part in parts], np.float32)
    lengths = np.array([len(part) for part in parts])
    return Buckets(
        np.concatenate(parts),
        centres,
        np.repeat(np.arange(len(parts)), lengths),
        len(full),
        np.array([len(part) for part in partial], "<u4"),
    )


def section_of(gaussians: Gaussians, level: int, limit: float) -> tuple[bytes, bytes, np.ndarray]:
    """The header and the data of a section, and the order of the Gaussians in it."""
    count = len(gaussians)
    means = gaussians.means.numpy()
    buckets = buckets_of(means) if level else None
    order = np.arange(count) if buckets is None else buckets.order
    terms = gaussians.sh.numpy()[order, 1:]
    number_type = "<f2" if level else "<f4"
    sh_type = ("<f4", "<f2", "u1")[level]
    rows = np.zeros(
        count,
        [
            ("mean", "<u2" if level else "<f4", 3),
            ("scale", number_type, 3),
            ("quat", number_type, 4),
            ("rgba", "u1", 4),
            ("sh", sh_type, 3 * terms.shape[1]),
        ],
    )
    if buckets is None:
        rows["mean"] = means
    else:
        offsets = means[order] - buckets.centres[buckets.bucket_of_row]
        rows["mean"] = np.rint(offsets / (EDGE / 2) * STEPS) + STEPS
    rows["scale"] = gaussians.scales.numpy()[order]
    rows["quat"] = gaussians.quats.numpy()[order]
    rgb = 0.5 + SH_C0 * gaussians.sh.numpy()[order, 0]
    rgba = np.concatenate([rgb, gaussians.opacities.numpy()[order, None]], axis=1)
    rows["rgba"] = np.rint(255 * rgba).clip(0, 255)
    bands = [terms[:, first:last] for first, last in ((0, 3), (3, 8)) if last <= terms.shape[1]]
    values = np.concatenate(
        [band.transpose(0, 2, 1).reshape(count, -1) for band in bands] or [terms.reshape(count, 0)],
        axis=1,
    )
    if level == 2:
        values = np.rint((values + limit) / (2 * limit) * 255)
    rows["sh"] = values.reshape(rows["sh"].shape)
    data = rows.tobytes()
    facts = [count, count, 0, 0, 0.0, 0, 0, len(data), 0, 0, gaussians.sh_degree]
    if buckets is not None:
        data = buckets.partial_lengths.tobytes() + buckets.centres.tobytes() + data
        num_buckets = len(buckets.centres)
        facts = [count, count, BUCKET_SIZE, num_buckets, EDGE, 12, STEPS, len(data)]
        facts += [buckets.num_full, num_buckets - buckets.num_full, gaussians.sh_degree]
    return SECTION.pack(*facts).ljust(1024, b"\0"), data, order


def ksplat(parts: Sequence[Gaussians], level: int, limit: float = 1.5) -> tuple[bytes, Gaussians]:
    """A .ksplat with a section for each part, and the Gaussians in the file's order."""
    sections = [section_of(part, level, limit) for part in parts]
    count = sum(len(part) for part in parts)
    num = len(parts)
    header = HEADER.pack(0, 1, num, num, count, count, level, -limit, limit).ljust(4096, b"\0")
    data = header + b"".join(h for h, _, _ in sections) + b"".join(d for _, d, _ in sections)
    ordered = [p.select(torch.from_numpy(o)) for p, (_, _, o) in zip(parts, sections, strict=True)]
    num_sh = max(part.sh.shape[1] for part in parts)
    sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, num_sh - p.sh.shape[1])) for p in ordered]
    joined = {
        name: torch.cat([getattr(part, name) for part in ordered])
        for name in ("means", "quats", "scales", "opacities")
    }
    return data, Gaussians(**joined, sh=torch.cat(sh))


@pytest.mark.parametrize("bands", [1, 4, 9])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_all_levels_and_degrees_are_read(tmp_path: Path, level: int, bands: int) -> None:
    parts = [some_gaussians(300, bands), some_gaussians(77, 1)]
    data, expected = ksplat(parts, level)
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    read = read_splats(path)
    assert read.problems == () and dict(read.notes) == {}
    after = read.gaussians
    # Half a step of an edge; half floats have 11 bits; bytes have 255 steps.
    mean_step = 0.0 if level == 0 else EDGE / 2 / STEPS / 2 + 1e-5
    half = 0.0 if level == 0 else 2**-11
    sh_step = (0.0, 2**-12, 0.5 * 3 / 255)[level]
    assert (after.means - expected.means).abs().max() <= mean_step
    assert ((after.scales / expected.scales - 1).abs() <= half + 1e-6).all()
    assert turn_deg(expected, after) < 0.15
    assert (after.opacities - expected.opacities).abs().max() <= 0.5 / 255 + 1e-6
    visible = 0.5 + SH_C0 * expected.sh[:, 0]
    assert (0.5 + SH_C0 * after.sh[:, 0] - visible).abs().max() <= 0.5 / 255 + 1e-6
    assert after.sh.shape == expected.sh.shape
    has_harmonics = torch.arange(len(after)) < 300  # zeros of the other section stay zeros
    errors = (after.sh - expected.sh)[:, 1:].abs()
    assert (errors[has_harmonics] <= sh_step + 1e-6).all() and not errors[~has_harmonics].any()


def test_the_range_of_bytes_is_the_headers(tmp_path: Path) -> None:
    gaussians = some_gaussians(20, 4)
    path = tmp_path / "a.ksplat"
    for limit in (0.6, 1.5):
        data, expected = ksplat([gaussians], 2, limit)
        is_default = limit == 1.5  # stated as zeros
        path.write_bytes(data[:36] + bytes(8) + data[44:] if is_default else data)
        error = (read_splats(path).gaussians.sh - expected.sh)[:, 1:].abs().max()
        assert error <= limit / 255 + 1e-6


def test_a_scale_too_small_for_half_floats_is_kept(tmp_path: Path) -> None:
    gaussians = some_gaussians(5, 1)
    gaussians.scales[:, 2] = 1e-9
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat([gaussians], 1)[0])
    assert read_splats(path).gaussians.scales[:, 2].tolist() == [2**-25] * 5


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.ksplat"
    whole, _ = ksplat([some_gaussians(100, 4)], 1)
    facts = SECTION.unpack_from(whole, 4096)

    def with_header(offset: int, kind: str, value: float) -> bytes:
        changed = bytearray(whole)
        struct.pack_into(kind, changed, offset, value)
        return bytes(changed)

    def with_section(**changes: float) -> bytes:
        names = ("num", "places", "size", "buckets", "edge", "bytes", "steps", "_", "full")
        fields = dict(zip((*names, "partial", "degree"), facts, strict=True)) | changes
        return whole[:4096] + SECTION.pack(*fields.values()) + whole[4096 + SECTION.size :]

    nan, _ = ksplat([some_gaussians(100, 1)], 0)
    values = np.full(100 * 11, math.nan, "<f4").tobytes()
    start = 4096 + 1024
    data_start = start + 4 * facts[9] + 12 * facts[3]
    cases = {
        "empty": (b"", "header of 4096 bytes; got 0"),
        "a header": (whole[:3000], "header of 4096 bytes; got 3000"),
        "headers": (whole[:4500], "the headers of its 1 sections end early|more than the file"),
        "cut": (whole[:-1], "more than the file holds: truncated"),
        "version": (with_header(0, "B", 1), "version 1.1 of .ksplat is not read"),
        "minor": (with_header(1, "B", 7), "version 0.7"),
        "level": (with_header(20, "<H", 3), r"compression level 3 \(0 to 2\)"),
        "no sections": (with_header(4, "<I", 0), "0 sections"),
        "a bomb of sections": (with_header(4, "<I", (1 << 32) - 1), "4294967295 sections"),
        "more sections": (with_header(4, "<I", 9), "damaged|end early|more than the file"),
        "no Gaussians": (with_header(16, "<I", 0), "announces 0 Gaussians, its sections 100"),
        "many Gaussians": (with_header(16, "<I", 10**9), "announces 1000000000 Gaussians"),
        "half loaded": (with_section(num=50), "its sections 50: .* not loaded to its end"),
        "a bomb": (with_section(places=(1 << 32) - 1), "more than the file holds"),
        "more than places": (with_section(num=101), "101 Gaussians in 100 places"),
        "degree": (with_section(degree=3), "degree 3"),
        "buckets": (with_section(buckets=(1 << 32) - 1), "more than the file holds"),
        "bytes": (with_section(bytes=0), "0 bytes a bucket"),
        "full buckets": (with_section(full=(1 << 32) - 1, size=0), "full buckets of 0"),
        "sizes": (with_section(size=(1 << 32) - 1, full=1, partial=0), "1 full buckets of 4294"),
        "an edge": (with_section(edge=math.nan), "edges of nan"),
        "a far edge": (with_section(edge=3e38, steps=1), "no usable Gaussians"),
        "lengths": (whole[:start] + bytes(4 * facts[9]) + whole[start + 4 * facts[9] :], "buckets"),
        "long lengths": (
            whole[:start] + b"\xff" * (4 * facts[9]) + whole[start + 4 * facts[9] :],
            "its buckets hold .* damaged",
        ),
        "NaN": (nan[:start] + values, "no usable Gaussians"),
        "NaN centres": (
            whole[: start + 4 * facts[9]] + b"\xff" * (12 * facts[3]) + whole[data_start:],
            "no usable Gaussians.*NaN",
        ),
    }
    for name, (data, message) in cases.items():
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
