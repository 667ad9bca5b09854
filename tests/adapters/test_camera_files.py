"""Camera files of other tools: known poses come out where they were put, damage is named."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from adapters.camera_files.camera_files import find_camera_file, read_views
from augment.errors import AdapterError

# A camera at (1, 2, 3) that looks along world +x with world +z up, OpenCV axes as columns.
LOOKS_ALONG_X = np.array(
    [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
)


def inria_entry(**changes) -> dict:
    entry = {
        "id": 0, "img_name": "00001", "width": 640, "height": 480, "fx": 500.0, "fy": 510.0,
        "position": LOOKS_ALONG_X[:3, 3].tolist(), "rotation": LOOKS_ALONG_X[:3, :3].tolist(),
    }  # fmt: skip
    return entry | changes


def nerfstudio_file(**changes) -> dict:
    opengl = LOOKS_ALONG_X @ np.diag([1.0, -1, -1, 1])
    content = {
        "w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 320.5, "cy": 240.5,
        "frames": [{"file_path": "images/frame_00007.png", "transform_matrix": opengl.tolist()}],
    }  # fmt: skip
    return content | changes


def save(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def write_colmap(folder: Path, cameras: str, names: list[str]) -> Path:
    """A text model whose images all stand at (1, 2, 3) and look along +x; camera ids cycle."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(cameras)
    rotation = LOOKS_ALONG_X[:3, :3].T
    translation = -rotation @ LOOKS_ALONG_X[:3, 3]
    quat = [0.5, 0.5, -0.5, 0.5]  # of that rotation: a third of a turn
    lines = []
    count = cameras.count("\n")
    for number, name in enumerate(names):
        numbers = [number + 1, *quat, *translation, 1 + number % count]
        lines += [" ".join(map(str, numbers)) + f" {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")
    return folder


def test_inria_cameras(tmp_path: Path) -> None:
    found = read_views(save(tmp_path / "cameras.json", [inria_entry()]))
    (view,) = found.views
    np.testing.assert_array_equal(view.world_from_camera, LOOKS_ALONG_X)
    assert (view.name, view.width, view.height, view.fx, view.fy) == ("00001", 640, 480, 500, 510)
    assert (view.cx, view.cy) == (320, 240)  # the format has none: the middle
    assert found.problems == ()
    own = read_views(save(tmp_path / "cameras.json", [inria_entry(cx=310.5, cy=251)]))
    assert (own.views[0].cx, own.views[0].cy) == (310.5, 251)  # but our own exports do


def test_nerfstudio_axes_and_intrinsics(tmp_path: Path) -> None:
    """OpenGL cameras look along -z with y up; frames may bring their own lens."""
    content = nerfstudio_file()
    own = {"file_path": "other.png", "fl_x": 400, "w": 320}
    content["frames"].append(content["frames"][0] | own)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "frame_00007.png").touch()
    first, second = read_views(save(tmp_path / "transforms.json", content)).views
    np.testing.assert_array_equal(first.world_from_camera, LOOKS_ALONG_X)
    assert (first.fx, first.cx, first.cy, first.width) == (500, 320.5, 240.5, 640)
    assert first.image_path == str(tmp_path / "images" / "frame_00007.png")
    assert (second.fx, second.fy, second.width, second.image_path) == (400, 510, 320, None)


def test_nerfstudio_angle_and_three_rows(tmp_path: Path) -> None:
    content = nerfstudio_file(camera_angle_x=math.pi / 2)
    del content["fl_x"], content["fl_y"], content["cx"], content["cy"]
    content["frames"][0]["transform_matrix"].pop()
    (view,) = read_views(save(tmp_path / "transforms.json", content)).views
    assert view.fx == view.fy == pytest.approx(320)
    assert (view.cx, view.cy) == (320, 240)


def test_distortion_is_left_out_and_said(tmp_path: Path) -> None:
    assert read_views(save(tmp_path / "a.json", nerfstudio_file(k1=0.0))).problems == ()
    (problem,) = read_views(save(tmp_path / "b.json", nerfstudio_file(k1=0.1))).problems
    assert "1 images have lens distortion (model OPENCV)" in problem
    fisheye = nerfstudio_file(camera_model="OPENCV_FISHEYE")
    assert "FISHEYE" in read_views(save(tmp_path / "c.json", fisheye)).problems[0]
    with pytest.raises(AdapterError, match=r"frames\.0.*EQUIRECTANGULAR has no pinhole"):
        read_views(save(tmp_path / "d.json", nerfstudio_file(camera_model="EQUIRECTANGULAR")))


def test_colmap_text_and_binary(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    cameras = "1 PINHOLE 640 480 500 510 321 242\n2 OPENCV 640 480 400 401 320 240 0.1 0 0 0\n"
    text = write_colmap(tmp_path / "sparse" / "0", cameras, ["front/1.jpg", "left/1.jpg"])
    (tmp_path / "images" / "front").mkdir(parents=True)
    (tmp_path / "images" / "front" / "1.jpg").touch()
    binary = tmp_path / "binary"
    binary.mkdir()
    pycolmap.Reconstruction(str(text)).write_binary(str(binary))
    for model in (tmp_path, text, binary):
        found = read_views(model)
        front, left = found.views
        np.testing.assert_allclose(front.world_from_camera, LOOKS_ALONG_X, atol=1e-12)
        assert (front.name, front.fx, front.fy, front.cx, front.cy) == (
            "front/1.jpg", 500, 510, 321, 242,
        )  # fmt: skip
        assert (left.fx, left.fy) == (400, 401)
        assert len(found.problems) == 1 and "1 images have lens distortion" in found.problems[0]
    front, left = read_views(text).views
    assert front.image_path == str(tmp_path / "images" / "front" / "1.jpg")
    assert left.image_path is None


def test_damaged_colmap_models(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    model = write_colmap(tmp_path / "a", "1 PINHOLE 640 480 500 510 321 242\n", ["1.jpg"])
    (model / "images.txt").write_text("1 not a number\n\n")
    with pytest.raises(AdapterError, match="pycolmap cannot read"):
        read_views(model)
    (model / "images.txt").write_text("# none\n")
    with pytest.raises(AdapterError, match="no image with a pose"):
        read_views(model)
    for name in ("cameras", "images", "points3D"):
        (tmp_path / "b").mkdir(exist_ok=True)
        (tmp_path / "b" / f"{name}.bin").write_bytes(b"\x05\0\0\0\0\0\0\0\x01")
    with pytest.raises(AdapterError, match="pycolmap cannot read"):
        read_views(tmp_path / "b")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "cameras: List should have at least 1 item"),
        ([inria_entry(), inria_entry(fx=-1)], r"cameras\.1\.fx: .*greater than 0 \(got -1\)"),
        ([inria_entry(rotation=[[1, 0], [0, 1]])], r"cameras\.0\.rotation\.0\.2: Field required"),
        ([inria_entry(position=[1, 2, math.nan])], r"cameras\.0\.position\.2: .*finite"),
        ([inria_entry(position=[1, 2, 1e39])], r"cameras\.0\.position\.2: .*less than"),
        ([inria_entry(position=[1, 2, 10**400])], r"cameras\.0\.position\.2: .*valid number"),
        ([inria_entry(fx="500")], r"cameras\.0\.fx: .*valid number \(got 500\)"),
        ([inria_entry(width=True)], r"cameras\.0\.width: .*valid number \(got True\)"),
        ([inria_entry(rotation=(2 * np.eye(3)).tolist())], "00001.*orthonormal.*off by 3"),
        ([inria_entry(rotation=np.diag([1.0, 1, -1]).tolist())], "determinant .*mirrored"),
        ({"cameras": 3}, "expected a list of cameras.*got an object with keys"),
        ("text", "got a str"),
        (nerfstudio_file(w=None), "frames.0 .*w and h .* are missing"),
        (nerfstudio_file(fl_x=None), "fl_x .* or camera_angle_x .* is missing"),
        (nerfstudio_file(fl_x="wide"), "fl_x: .*number.*got wide"),
        (nerfstudio_file(frames=[{"transform_matrix": [[1]]}]), "frames.0.file_path: Field req"),
    ],
)
def test_bad_json_names_the_field(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(AdapterError, match=message):
        read_views(save(tmp_path / "cameras.json", content))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_what_is_not_json(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "cameras.json").write_bytes(content)
    with pytest.raises(AdapterError, match=r"cameras\.json (is not readable|cannot be read)"):
        read_views(tmp_path / "cameras.json")


def test_folders_without_cameras(tmp_path: Path) -> None:
    assert find_camera_file(tmp_path) is None
    with pytest.raises(AdapterError, match=r"no cameras in this folder; looked for cameras\.json"):
        read_views(tmp_path)
    with pytest.raises(AdapterError, match="no such file; expected an INRIA"):
        read_views(tmp_path / "absent.json")
    save(tmp_path / "transforms.json", nerfstudio_file())
    assert find_camera_file(tmp_path) == tmp_path / "transforms.json"
    assert len(read_views(tmp_path).views) == 1
