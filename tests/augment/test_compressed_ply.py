"""Gaussians in PlayCanvas' compressed .ply files: bits against the format's rules, and refusals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.render.sh import SH_C0

POSITION = ("x", "y", "z")
SCALE = ("scale_x", "scale_y", "scale_z")
COLOR = ("r", "g", "b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed_ply(
    packed: np.ndarray,
    ranges: Mapping[str, float],
    *,
    sh: np.ndarray | None = None,
    packed_names: tuple[str, ...] = PACKED,
    num_announced: int | None = None,
    num_chunks: int | None = None,
    sh_type: str = "uchar",
    order: str = "little",
) -> bytes:
    """A compressed .ply with one range for all chunks; numbers in its header may be wrong.

    packed: uint32 [N, 4]. ranges: the columns of a chunk. sh: uint8 [N, K].
    """
    count = len(packed) if num_announced is None else num_announced
    real_num_chunks = -(-len(packed) // 256)
    num_chunks = real_num_chunks if num_chunks is None else num_chunks
    lines = ["ply", f"format binary_{order}_endian 1.0", "comment up: -y"]
    lines += [f"element chunk {num_chunks}", *(f"property float {name}" for name in ranges)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in packed_names)]
    if sh is not None:
        lines += [f"element sh {count}"]
        lines += [f"property {sh_type} f_rest_{i}" for i in range(sh.shape[1])]
    mark = "<" if order == "little" else ">"
    body = np.tile(np.array(list(ranges.values()), f"{mark}f4"), real_num_chunks).tobytes()
    body += packed.astype(f"{mark}u4").tobytes()
    body += b"" if sh is None else sh.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + body


def ranges_of(has_colors: bool = True) -> dict[str, float]:
    """Ranges: x from -1 to 1, y from 0 to 10, z from 5 to 5, scales from e^-4 to e^2."""
    ranges = {}
    for end, position, scale, color in (("min", (-1, 0, 5), -4, -0.5), ("max", (1, 10, 5), 2, 1.5)):
        ranges |= {f"{end}_{name}": value for name, value in zip(POSITION, position, strict=True)}
        ranges |= {f"{end}_{name}": scale for name in SCALE}
        ranges |= {f"{end}_{name}": color for name in COLOR if has_colors}
    return ranges


def packed_row(largest: int = 0) -> list[int]:
    """A Gaussian whose numbers are all at one end of their bits, or the other."""
    position = 2047 << 21 | 0 << 11 | 1000
    rotation = largest << 30 | 1023 << 20 | 0 << 10 | 512
    scale = 0 << 21 | 1023 << 11 | 2047
    color = 255 << 24 | 0 << 16 | 51 << 8 | 204
    return [position, rotation, scale, color]


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("has_colors", [True, False])
def test_bits_mean_what_the_format_says(tmp_path: Path, has_colors: bool, order: str) -> None:
    path = tmp_path / "a.ply"
    packed = np.array([packed_row()])
    path.write_bytes(compressed_ply(packed, ranges_of(has_colors), order=order))
    read = read_splats(path)
    assert read.notes == {"up": "-y"} and read.problems == ()
    gaussians = read.gaussians
    assert gaussians.means[0].tolist() == [1, 0, 5]
    logs = gaussians.scales[0].log().tolist()
    assert logs == pytest.approx([-4, 2, 2], abs=1e-6)
    fractions = np.array([1, 0, 0.2])
    rgb = fractions * 2 - 0.5 if has_colors else fractions
    assert gaussians.sh[0, 0].tolist() == pytest.approx((rgb - 0.5) / SH_C0, abs=1e-6)
    assert gaussians.opacities.item() == pytest.approx(0.8)


@pytest.mark.parametrize("largest", range(4))
def test_the_largest_component_of_a_rotation_follows_from_the_others(
    tmp_path: Path, largest: int
) -> None:
    path = tmp_path / "a.ply"
    row = packed_row(largest)
    row[1] = largest << 30 | 700 << 20 | 400 << 10 | 512
    path.write_bytes(compressed_ply(np.array([row]), ranges_of()))
    others = [(code / 1023 - 0.5) * math.sqrt(2) for code in (700, 400, 512)]
    expected = [*others[:largest], math.sqrt(1 - sum(v * v for v in others)), *others[largest:]]
    assert read_splats(path).gaussians.quats[0].tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("num_terms", [3, 8, 15])
def test_coefficients_are_channel_after_channel(tmp_path: Path, num_terms: int) -> None:
    path = tmp_path / "a.ply"
    sh = np.arange(3 * num_terms, dtype=np.uint8)[None] + 100
    sh[0, :2] = (0, 255)
    path.write_bytes(compressed_ply(np.array([packed_row()]), ranges_of(), sh=sh))
    codes = torch.from_numpy(sh.astype(np.float32)).reshape(3, num_terms).T
    expected = ((codes + 0.5) / 256 - 0.5) * 8
    expected[0, 0] = -4
    expected[1, 0] = 4
    read = read_splats(path).gaussians
    torch.testing.assert_close(read.sh[0, 1:], expected, rtol=0, atol=1e-6)


def test_each_chunk_of_256_has_its_range(tmp_path: Path) -> None:
    """Across the pieces in which rows are read, 64 chunks each."""
    count = 256 * 65 + 7
    data = compressed_ply(np.tile(np.array([packed_row()]), (count, 1)), ranges_of())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    ranges = np.frombuffer(data[start:], "<f4", 66 * 18).reshape(66, 18).copy()
    ranges[:, list(ranges_of()).index("max_x")] = np.arange(66)
    path = tmp_path / "a.ply"
    path.write_bytes(data[:start] + ranges.tobytes() + data[start + ranges.nbytes :])
    x = read_splats(path).gaussians.means[:, 0]
    assert torch.equal(x, (torch.arange(count) // 256).float())


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    packed = np.tile(np.array([packed_row()]), (300, 1))
    sh = np.zeros((300, 9), np.uint8)
    good = ranges_of()
    whole = compressed_ply(packed, good, sh=sh)
    path.write_bytes(whole)
    assert len(read_splats(path).gaussians) == 300
    nan = {**good, "min_x": math.nan}
    without = {name: value for name, value in good.items() if name != "max_scale_y"}
    cases = {
        "cut in the chunks": (whole[:900], "rows of 'chunk', .* truncated"),
        "cut in the rows": (whole[:3000], "rows of 'vertex', .* truncated"),
        "cut in the harmonics": (whole[:-5], "rows of 'sh', .* truncated"),
        "a header": (whole[:100], "no 'end_header'"),
        "no chunk": (compressed_ply(packed, {}, num_chunks=2), "lacks min_x, min_y"),
        "a range": (compressed_ply(packed, without), "lacks max_scale_y"),
        "few chunks": (compressed_ply(packed, good, num_chunks=1), "300 Gaussians in 1 chunks"),
        "many chunks": (compressed_ply(packed, good, num_chunks=10**9), "in 1000000000 chunks"),
        "none": (compressed_ply(packed[:0], good), "0 Gaussians in 0 chunks"),
        "too many": (
            compressed_ply(packed, good, num_announced=10**9, num_chunks=3906250),
            "announces 3906250 rows of 'chunk'",
        ),
        "no number": (
            compressed_ply(packed, good, num_announced=10**30),
            "header cannot be used: 'element vertex",
        ),
        "a column": (
            compressed_ply(packed, good, packed_names=(*PACKED[:3], "colour")),
            "lacks packed_color",
        ),
        "twice": (
            compressed_ply(packed, good, packed_names=(*PACKED, "packed_scale")),
            "repeats the property 'packed_scale'",
        ),
        "type of harmonics": (compressed_ply(packed, good, sh=sh, sh_type="float"), "type uchar"),
        "ten harmonics": (
            compressed_ply(packed, good, sh=np.zeros((300, 10), np.uint8)),
            "it has 10 columns",
        ),
        "degree 4": (
            compressed_ply(packed, good, sh=np.zeros((300, 72), np.uint8)),
            "it has 72 columns",
        ),
        "lists": (
            whole.replace(b"property float min_y", b"property list uchar float min_y"),
            "lacks min_y",
        ),
        "wide": (
            whole.replace(b"property uint packed_scale", b"property float packed_scale"),
            "packed_scale must be of type uint",
        ),
        "NaN": (compressed_ply(packed, nan), "no usable Gaussians.*300 of 300.*NaN"),
        "infinite": (
            compressed_ply(packed, {**good, "max_scale_x": math.inf, "min_scale_x": math.inf}),
            "no usable Gaussians.*NaN or infinite",
        ),
        "large": (
            compressed_ply(packed, {**good, "max_scale_x": 1e9, "min_scale_x": 1e9}),
            "no usable Gaussians.*NaN or infinite",
        ),
        "harmonics of others": (whole.replace(b"element sh 300", b"element sh 299"), "for 299"),
        "no format": (whole.replace(b"format binary_little", b"format binary_middle"), "line 2"),
    }
    for name, (data, message) in cases.items():
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)


def test_the_option_of_other_ply_files_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(compressed_ply(np.array([packed_row()]), ranges_of()))
    with pytest.raises(SceneError, match="leave activated out"):
        read_splats(path, activated=True)
