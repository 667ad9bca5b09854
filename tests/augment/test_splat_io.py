"""Splat files: values against the formats' definitions and an independent reader, and damage."""

from __future__ import annotations

import contextlib
import dataclasses
import struct
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.files.ply import iterate_rows, read_ply, read_ply_header, write_ply
from augment.files.splat import write_splat
from augment.files.splat_format import recentring_origin
from augment.scene.scene import Gaussians

BASIC = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip


def random_gaussians(count: int, degree: int, *, semantic: bool = False) -> Gaussians:
    rng = torch.Generator().manual_seed(count + degree)
    quats = torch.randn(count, 4, generator=rng)
    return Gaussians(
        means=torch.randn(count, 3, generator=rng) * 50,
        quats=quats / quats.norm(dim=1, keepdim=True),
        scales=torch.rand(count, 3, generator=rng) * 2 + 1e-3,
        opacities=torch.rand(count, generator=rng),
        sh=torch.randn(count, (degree + 1) ** 2, 3, generator=rng),
        semantic=torch.arange(count).to(torch.int16) % 15 if semantic else None,
    )


def ply(
    names: list[str], rows: np.ndarray | None = None, *, count: int | None = None, extra: str = ""
) -> bytes:
    """A binary float .ply with any columns, two rows of zeros by default; its count may lie."""
    rows = np.zeros((2, len(names))) if rows is None else rows
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element vertex {len(rows) if count is None else count}"]
    header += [f"property float {name}" for name in names]
    header += [*filter(None, [extra]), "end_header"]
    return ("\n".join(header) + "\n").encode() + np.ascontiguousarray(rows, "<f4").tobytes()


def text_ply(*rows: str) -> bytes:
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in BASIC]
    return "\n".join([*header, "end_header", *rows, ""]).encode()


def saved(folder: Path, content: bytes) -> Path:
    (folder / "a.ply").write_bytes(content)
    return folder / "a.ply"


def test_extreme_opacities_survive(tmp_path: Path) -> None:
    written = random_gaussians(4, 0)
    opacities = torch.tensor([0.0, 1.0, 1e-6, 1 - 2**-24])
    write_ply(tmp_path / "a.ply", dataclasses.replace(written, opacities=opacities))
    raw = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]["opacity"]
    assert np.isfinite(raw).all()
    got = read_ply(tmp_path / "a.ply").gaussians.opacities
    assert got[0] == 0 and got[1] == 1
    torch.testing.assert_close(got, opacities, rtol=2e-6, atol=0)


def test_layout_matches_an_independent_reader(tmp_path: Path) -> None:
    """plyfile sees INRIA's columns: f_rest channel-major, log scales, logits, wxyz."""
    written = random_gaussians(5, 2)
    write_ply(tmp_path / "a.ply", written)
    vertex = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]
    names = [p.name for p in vertex.properties]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:33] == [f"f_rest_{i}" for i in range(24)]
    for channel in range(3):
        for band in range(8):
            expected = written.sh[:, 1 + band, channel].numpy()
            np.testing.assert_array_equal(vertex[f"f_rest_{8 * channel + band}"], expected)
    np.testing.assert_allclose(vertex["scale_1"], written.scales[:, 1].log().numpy(), rtol=1e-6)
    np.testing.assert_array_equal(vertex["rot_0"], written.quats[:, 0])
    assert vertex["nx"].sum() == 0


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_reads_what_an_independent_writer_wrote(tmp_path: Path, order: str) -> None:
    """Any order of columns, other columns between, both byte orders and text."""
    rng = np.random.default_rng(5)
    names = [*BASIC[::-1], "confidence", *(f"f_rest_{i}" for i in range(9))]
    table = np.zeros(7, dtype=[(name, "f4") for name in names])
    for name in names:
        table[name] = rng.normal(size=7)
    other = np.zeros(3, dtype=[("a", "u1"), ("b", "f8")])
    elements = [
        plyfile.PlyElement.describe(other, "other"),
        plyfile.PlyElement.describe(table, "vertex"),
    ]
    data = plyfile.PlyData(
        elements, text=order == "ascii", byte_order="=" if order == "ascii" else order
    )
    data.write(str(tmp_path / "a.ply"))
    got = read_splats(tmp_path / "a.ply").gaussians
    # Text is parsed as float64, so float32's own rounding of exp is all that remains.
    np.testing.assert_allclose(got.means[:, 1], table["y"], rtol=1e-6)
    np.testing.assert_allclose(got.scales[:, 2], np.exp(table["scale_2"]), rtol=1e-6)
    np.testing.assert_allclose(got.opacities, 1 / (1 + np.exp(-table["opacity"])), rtol=1e-6)
    np.testing.assert_allclose(got.sh[:, 2, 1], table["f_rest_4"], rtol=1e-6)
    norms = np.sqrt(sum(table[f"rot_{i}"] ** 2 for i in range(4)))
    np.testing.assert_allclose(got.quats[:, 0], table["rot_0"] / norms, rtol=1e-6)


def test_rgb_columns_serve_as_colour(tmp_path: Path) -> None:
    names = [n for n in BASIC if not n.startswith("f_dc")]
    types = [(n, "f4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")]
    table = np.full(2, -1, dtype=types)
    table["red"], table["green"], table["blue"] = 255, 51, 0
    element = plyfile.PlyElement.describe(table, "vertex")
    plyfile.PlyData([element]).write(str(tmp_path / "a.ply"))
    sh = read_ply(tmp_path / "a.ply").gaussians.sh
    colour = 0.5 + 0.28209479177387814 * sh[:, 0]
    torch.testing.assert_close(colour[0], torch.tensor([1.0, 0.2, 0.0]), rtol=0, atol=1e-6)


def test_double_coordinates_are_recentred_before_float32(tmp_path: Path) -> None:
    """UTM-sized doubles keep their millimetres; float32 alone would keep 0.5 m."""
    table = np.full(3, -1, dtype=[(n, "f8" if n in "xyz" else "f4") for n in BASIC])
    table["x"] = [500_000.001, 500_000.002, 500_001.003]
    table["y"] = [5_300_000.004, 5_300_002.005, 5_300_003.006]
    table["z"] = [400.0, 400.5, 401.0]
    element = plyfile.PlyElement.describe(table, "vertex")
    plyfile.PlyData([element]).write(str(tmp_path / "a.ply"))
    read = read_ply(tmp_path / "a.ply")
    assert (read.origin == np.round(read.origin)).all()
    world = read.gaussians.means.double().numpy() + read.origin
    expected = np.stack([table[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(world, expected, atol=1e-6)  # float32 at a few metres: 2.4e-7


def test_recentring_origin_ignores_floaters_and_keeps_near_scenes() -> None:
    points = np.array([[1.0, 2, 3]] * 5 + [[1e9, 0, 0], [np.nan, 0, 0]])
    assert (recentring_origin(points) == 0).all()
    assert recentring_origin(points + np.array([2000.4, 0, 0])).tolist() == [2001, 2, 3]
    assert (recentring_origin(np.full((2, 3), np.inf)) == 0).all()


def test_unusable_gaussians_are_left_out_and_counted(tmp_path: Path) -> None:
    rows = np.full((6, len(BASIC)), -1, np.float32)
    rows[1, 0] = np.nan
    rows[2, BASIC.index("scale_0")] = 500  # exp overflows
    rows[3, BASIC.index("rot_0") :] = 0
    read = read_ply(saved(tmp_path, ply(BASIC, rows)))
    assert len(read.gaussians) == 3
    assert [p.split(": ")[1] for p in read.problems] == [
        "left out 2 of 6 Gaussians with NaN or infinite values",
        "left out 1 of 6 Gaussians with a zero quaternion",
    ]


def test_values_that_look_activated_are_asked_about(tmp_path: Path) -> None:
    """A Gaussian of opacity 0.25 and scales 0.5, 1 and 2, stored as such."""
    row = [1, 2, 3, 0, 0, 0, 0.25, 0.5, 1, 2, 1, 0, 0, 0]
    path = saved(tmp_path, ply(BASIC, np.array([row, row])))
    with pytest.raises(SceneError, match=r"0\.25 to 0\.25 .*\?activated=true .*\?activated=false"):
        read_splats(path)
    taken = read_splats(path, activated=True).gaussians
    assert taken.opacities.tolist() == [0.25] * 2 and taken.scales[0].tolist() == [0.5, 1, 2]
    decoded = read_splats(path, activated=False).gaussians
    torch.testing.assert_close(decoded.opacities, torch.tensor([0.25] * 2).sigmoid())
    torch.testing.assert_close(decoded.scales, taken.scales.exp())
    write_ply(path, taken)  # logits and logarithms, as trainers store them
    torch.testing.assert_close(read_splats(path).gaussians.scales, taken.scales)


def head(*lines: str) -> bytes:
    return "\n".join(["ply", *lines, "end_header", ""]).encode()


REST = [f"f_rest_{number}" for number in range(13)]
WITHOUT_SCALE = [name for name in BASIC if name != "scale_2"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ply(["x", "y", "z", "red", "green", "blue"]), "misses opacity, scale_0.*point cloud"),
        (ply(["x", "y", "z"], extra="element face 0"), "This is a mesh"),
        (ply(WITHOUT_SCALE), "misses scale_2.*2D Gaussians"),
        (ply(["packed_position"]), "expected an element 'chunk'"),
        (ply([]), "it has no properties"),
        (ply([*BASIC, *REST[:10]]), "multiple of 3.*got 10"),
        (ply([*BASIC, *REST[1:10]]), "numbered without gaps"),
        (ply([*BASIC, *REST[:12]]), r"\(0, 9, 24, 45\).*got 12"),
        (ply(BASIC, np.zeros((0, 14))), "has 0 rows"),
        (ply(BASIC, -np.ones((100, 14)))[:-57], "100 rows.*ends after 98 of them.*truncated"),
        (b"ply\n", "no 'end_header'"),
        (head(), "names no format"),
        (head("format text 1.0"), "line 2 of the .ply header"),
        (head("format ascii 1.0", "element vertex -3"), "line 3"),
        (head("format ascii 1.0", "property float x"), "line 3"),
        (head("format ascii 1.0", "element v 1", "property half x"), "line 4"),
        (head("format ascii 1.0", "element v 1", *["property int x"] * 2), "repeats the property"),
        (text_ply("1 " * 14, "1 2" + " " * 40), "row 1 must have 14 values.*got 2"),
        (text_ply("1 " * 14, "x" + " 1" * 13), "not a number"),
    ],
)
def test_what_is_wrong_with_a_ply_is_said(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(SceneError, match=rf"a\.ply.*{message}"):
        read_splats(saved(tmp_path, content))


def test_other_element_names_are_listed(tmp_path: Path) -> None:
    path = saved(tmp_path, ply(BASIC).replace(b"element vertex", b"element vertex_background"))
    with pytest.raises(SceneError, match=r"expected an element 'vertex'.*'vertex_background'"):
        read_ply(path)
    with pytest.raises(SceneError, match="zero quaternion"):
        read_ply(path, element="vertex_background")


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
def test_a_lying_count_allocates_nothing(tmp_path: Path, encoding: str) -> None:
    content = ply(BASIC, count=10**17).replace(b"binary_little_endian", encoding.encode())
    path = saved(tmp_path, content)
    tracemalloc.start()
    with pytest.raises(SceneError, match="100000000000000000 rows"):
        read_ply(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4_000_000  # the header buffer alone may take 1 MiB


def test_surplus_bytes_are_counted(tmp_path: Path) -> None:
    read = read_ply(saved(tmp_path, ply(BASIC, -np.ones((5, 14)), count=3)))
    assert len(read.gaussians) == 3
    assert f"{2 * 14 * 4} bytes follow" in read.problems[0]


def test_lists_are_refused_only_where_they_matter(tmp_path: Path) -> None:
    table = np.full(2, -1, dtype=[(n, "f4") for n in BASIC])
    faces = np.empty(1, dtype=[("idx", "O")])
    faces["idx"][0] = np.array([0, 1, 1], dtype="i4")
    vertex = plyfile.PlyElement.describe(table, "vertex")
    face = plyfile.PlyElement.describe(faces, "face", len_types={"idx": "u1"})
    plyfile.PlyData([vertex, face]).write(str(tmp_path / "after.ply"))
    assert len(read_ply(tmp_path / "after.ply").gaussians) == 2
    plyfile.PlyData([face, vertex]).write(str(tmp_path / "before.ply"))
    with pytest.raises(SceneError, match="'face' has list properties"):
        read_ply(tmp_path / "before.ply")


WORDS = ["ply", "format", "ascii", "binary_little_endian", "binary_big_endian", "1.0", "element",
         "vertex", "property", "list", "float", "uchar", "double", "x", "3", "0", "-1", "99999999",
         "9" * 5000, "comment", "end_header", "\r", "é", *BASIC]  # fmt: skip
LINES = st.lists(st.lists(st.sampled_from(WORDS), max_size=5).map(" ".join), max_size=14)


@settings(max_examples=40, deadline=None)
@given(lines=LINES, tail=st.binary(max_size=80), cut=st.integers(0, 400))
def test_any_header_reads_or_raises_a_scene_error(lines: list[str], tail: bytes, cut: int) -> None:
    content = ("ply\n" + "\n".join([*lines, "end_header\n"])).encode() + tail
    _read_or_scene_error(content)
    _read_or_scene_error(content[:cut])


@settings(max_examples=40, deadline=None)
@given(
    flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=12),
    cut=st.integers(0, 2000),
)
def test_any_damage_reads_or_raises_a_scene_error(flips: list[tuple[int, int]], cut: int) -> None:
    """Flipped bytes in a good file, header and body."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ply"
        write_ply(path, random_gaussians(9, 1))
        content = bytearray(path.read_bytes())
    for position, value in flips:
        content[position % len(content)] = value
    _read_or_scene_error(bytes(content))
    _read_or_scene_error(bytes(content[:cut]))


def _read_or_scene_error(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ply"
        path.write_bytes(content)
        with contextlib.suppress(SceneError):
            header = read_ply_header(path)
            for element in header.elements:
                list(iterate_rows(header, element.name))
        with contextlib.suppress(SceneError):
            assert len(read_splats(path).gaussians) > 0


def test_splat_record_definition(tmp_path: Path, caplog) -> None:
    record = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 102, 128, 255, 128, 128)
    (tmp_path / "a.splat").write_bytes(record)
    got = read_splats(tmp_path / "a.splat").gaussians
    assert got.means.tolist() == [[1, 2, 3]]
    torch.testing.assert_close(got.scales, torch.tensor([[0.1, 0.2, 0.3]]))
    torch.testing.assert_close(got.opacities, torch.tensor([0.4]))
    colour = 0.5 + 0.28209479177387814 * got.sh[0, 0]
    torch.testing.assert_close(colour, torch.tensor([1.0, 0.0, 0.2]), rtol=0, atol=1e-6)
    assert got.quats.tolist() == [[0, 1, 0, 0]]
    write_splat(tmp_path / "b.splat", dataclasses.replace(got, sh=got.sh.repeat(1, 4, 1)))
    assert (tmp_path / "b.splat").read_bytes() == record
    assert "SH bands above 0 are dropped" in caplog.text


def test_bad_splat_files(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(b"\0" * 70)
    with pytest.raises(SceneError, match=r"70 bytes = 2 records and 6 bytes"):
        read_splats(path)
    path.write_bytes(b"")
    with pytest.raises(SceneError, match="0 bytes"):
        read_splats(path)
    path.write_bytes(np.random.default_rng(0).bytes(32_000))
    with pytest.raises(SceneError, match=r"probably no \.splat"):
        read_splats(path)
    with pytest.raises(SceneError, match="no such file"):
        read_ply(tmp_path / "absent.ply")


def test_notes_must_be_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one printable line"):
        write_ply(tmp_path / "a.ply", random_gaussians(1, 0), notes={"up": "+z\nelement x 1"})


def test_real_tiles(shared_dir: Path) -> None:
    for name, count in [("tile_x000_y002", 121_833), ("tile_x001_y001", 88_325)]:
        read = read_splats(shared_dir / "data" / "splats" / f"{name}.splat")
        assert len(read.gaussians) == count
        assert read.problems == ()
