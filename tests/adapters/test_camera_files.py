"""Camera files of other tools: known poses come out where they were put, damage is named."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.camera_files.camera_files import PosedView, find_camera_file, look_at_pose, read_views
from adapters.camera_files.paths import (
    CAMERA_HEIGHT_M,
    NO_CAMERAS,
    frames_from_path_file,
    frames_from_views,
    ground_grid,
    make_default_path,
    solid_points,
    with_camera_path,
)
from adapters.street_gaussians.adapter import StreetGaussiansLabels
from adapters.world import WorldChange
from augment.errors import AdapterError
from augment.files.formats import read_splats
from augment.files.ply import write_ply
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from tests.adapters.splat_scenes import gaussians_at, street

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
    content = nerfstudio_file(camera_angle_x=math.pi / 2, fl_x=None, fl_y=None, cx=None, cy=None)
    content["frames"][0]["transform_matrix"].pop()  # of three rows
    (view,) = read_views(save(tmp_path / "transforms.json", content)).views
    assert view.fx == view.fy == pytest.approx(320) and (view.cx, view.cy) == (320, 240)


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


def test_colmap_models_without_pycolmap_name_the_extra(tmp_path: Path, monkeypatch) -> None:
    model = write_colmap(tmp_path / "a", "1 PINHOLE 640 480 500 510 321 242\n", ["1.jpg"])
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(AdapterError, match=r"pip install 'climategs\[colmap\]'"):
        read_views(model)


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
    with pytest.raises(AdapterError, match=r"cameras\.bin is cut short at camera 1 of 5"):
        read_views(tmp_path / "b")


COLMAP_CAMERAS = [
    ("1 EQUIRECTANGULAR 640 480 320 240\n", "model EQUIRECTANGULAR, which has no focal length"),
    ("1 PINHOLE 9999999 480 500 510 321 242\n", r"1 to 65536 pixels wide and high; got \(9999999"),
    ("1 PINHOLE 640 480 1e300 510 321 242\n", "must be finite, at most 1e"),
    ("1 PINHOLE 640 480 -500 510 321 242\n", "focal lengths above 0"),
]


def test_colmap_cameras_that_are_no_pinhole_cameras_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    model = write_colmap(tmp_path / "a", "1 PINHOLE 640 480 500 510 321 242\n", ["1.jpg"])
    for text, message in COLMAP_CAMERAS:
        (model / "cameras.txt").write_text(text)
        with pytest.raises(AdapterError, match=message):
            read_views(model)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap_models_that_are_cut_short_are_named_by_table_and_entry(
    form: str, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    cameras = "1 PINHOLE 640 480 500 510 321 242\n2 OPENCV 640 480 400 401 320 240 0.1 0 0 0\n"
    names = [f"{number}.jpg" for number in range(6)]
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path / "source", cameras, names)))
    for _ in range(9):
        model.add_point3D(np.ones(3), pycolmap.Track([]), np.zeros(3, np.uint8))
    whole = tmp_path / "whole"
    whole.mkdir()
    model.write_binary(str(whole)) if form == "binary" else model.write_text(str(whole))
    assert len(read_views(whole).views) == 6
    for path in sorted(whole.iterdir()):
        data = path.read_bytes()
        # A text's first lines are comments.
        shares = (0.98, 0.6, 0.05) if form == "binary" else (0.98,)
        for share in shares:
            path.write_bytes(data[: int(len(data) * share)])
            said = rf"{path.name} is cut short(: it has \d bytes| at \w+ \d+ of \d+:)"
            with pytest.raises(AdapterError, match=said):
                read_views(whole)
        path.write_bytes(data)


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


def view(name: str, *, position=(0.0, 0.0, 2.0), target=(9.0, 0.0, 2.0), **changes) -> PosedView:
    fields = {"width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0} | changes
    return PosedView(
        name=name, world_from_camera=look_at_pose(position, target, where="test"), **fields
    )


@pytest.mark.parametrize(
    ("names", "frames"),
    [
        (
            "images/left/0010.jpg images/front/0010.jpg images/front/0009.jpg",
            [(9, ["front"]), (10, ["front", "left"])],
        ),
        (
            "0003/cam_l.png 0003/cam_f.png 0002/cam_f.png 0002/cam_l.png",
            [(2, ["cam_f", "cam_l"]), (3, ["cam_f", "cam_l"])],
        ),
        ("000012_0.png 000012_1.png 000013_0.png 000013_1.png",
         [(12, ["0", "1"]), (13, ["0", "1"])]),
        ("000012_0 000013_1 000012_1 000013_0", [(12, ["0", "1"]), (13, ["0", "1"])]),
        ("12_front 12_front_left 13_front 13_front_left",
         [(12, ["front", "front_left"]), (13, ["front", "front_left"])]),
        ("left_0001.jpg right_0001.jpg left_0002.jpg right_0002.jpg",
         [(1, ["left", "right"]), (2, ["left", "right"])]),
        # Dates of a phone are no rig.
        (" ".join(f"20240131_1200{n:02d}.jpg" for n in range(3)),
         [(120000 + n, ["camera"]) for n in range(3)]),
    ],
)  # fmt: skip
def test_cameras_and_frames_are_told_by_names(names, frames) -> None:
    found, problems = frames_from_views([view(name) for name in names.split()], WorldChange())
    assert problems == ()
    assert [(frame.index, list(frame.cameras)) for frame in found] == frames


@pytest.mark.parametrize(
    "names",
    [
        ["frame_00002.png", "frame_00010.png", "frame_00001.png"],
        ["images/IMG_0002.JPG", "images/IMG_0010.JPG", "images/IMG_0001.JPG"],
        ["DSC10", "DSC2", "DSC1"],
        ["0001_0", "0002_0", "0010_0"],
    ],
)
def test_one_camera_in_natural_order(names: list[str]) -> None:
    """10 comes after 2, and a number in the name alone makes no rig."""
    frames, problems = frames_from_views([view(name) for name in names], WorldChange())
    assert problems == ()
    assert [list(frame.cameras) for frame in frames] == [["camera"]] * 3
    assert [f.index for f in frames] == sorted(f.index for f in frames)
    assert [f.timestamp_ns for f in frames] == [0, 100_000_000, 200_000_000]


def test_repeated_names_are_said() -> None:
    frames, problems = frames_from_views([view("0001"), view("0001"), view("0002")], WorldChange())
    assert [list(frame.cameras) for frame in frames] == [["camera"]] * 3
    assert "2 views are named camera 'camera', frame '0001'" in problems[0]


def test_times_count_from_the_start() -> None:
    views = [
        view("a", camera="left", frame=0, timestamp_ns=5),
        view("b", camera="front", frame=0, timestamp_ns=3),
    ]
    (frame,), _ = frames_from_views(views, WorldChange(), start_ns=1000)
    assert frame.timestamp_ns == 1003
    assert frame.cameras["left"].timestamp_ns == 1005


def test_world_change_moves_cameras() -> None:
    """A y-down source in half-metres, recentred: the camera stays rigid and upright."""
    rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # source -y is up
    change = WorldChange(rotation, 0.5, np.array([10.0, 0, 0]))
    pose = np.eye(4)
    pose[:3, 3] = [40, -4, 2]
    source = view("a")
    source = PosedView(**{**vars(source), "world_from_camera": pose})
    (frame,), _ = frames_from_views([source], change)
    camera = frame.cameras["camera"]
    np.testing.assert_allclose(camera.centre, [10, 1, 2])
    np.testing.assert_allclose(camera.world_from_camera[:3, 1], [0, 0, -1])  # image down = -z
    np.testing.assert_allclose(frame.world_from_ego[:3, 0], [0, 1, 0])  # optical axis, level


def test_ego_stands_level_at_the_front_camera() -> None:
    views = [
        view("0001_back", target=(-9.0, 0, 2)),
        view("0001_front", position=(1.0, 0, 2), target=(1.0, 5, -3)),
        view("0001_front_left", target=(0.0, 9, 2)),
    ]
    (frame,), _ = frames_from_views(views, WorldChange())
    expected = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    torch.testing.assert_close(frame.world_from_ego, torch.tensor(expected, dtype=torch.float64))


def test_impossible_numbers_name_the_image() -> None:
    with pytest.raises(AdapterError, match=r"image 'a\.png': .*fx must be finite"):
        frames_from_views([view("a.png", fx=float("inf"))], WorldChange())


LENS = {"width": 96, "height": 54, "fx": 60.0}
LEVEL = {"position": [1.0, 2.0, 3.0], "look_at": [5.0, 2.0, 3.0]}


def save_path(path: Path, frames: list, **changes) -> Path:
    path.write_text(json.dumps(LENS | {"frames": frames} | changes))
    return path


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    write_ply(tmp_path / "street.ply", street())
    return open_scene(f"{tmp_path}/street.ply?scale=1")


def test_look_at_poses_are_upright(tmp_path: Path) -> None:
    frames = [
        LEVEL,
        {"position": [0, 0, 5], "look_at": [0, 0, 0]},
        {"position": [0, 0, 0], "look_at": [3, 4, 5]},
    ]
    level, down, slanted = (
        v.world_from_camera for v in read_views(save_path(tmp_path / "a.json", frames)).views
    )
    expected = [[0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(level, expected, atol=1e-12)
    np.testing.assert_allclose(down[:3, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(down[:3, 1], [0, -1, 0], atol=1e-12)  # image top towards +y
    np.testing.assert_allclose(slanted[:3, 2], np.array([3, 4, 5]) / math.sqrt(50), atol=1e-12)
    assert slanted[2, 0] == 0 and slanted[2, 1] < 0  # no roll, and the right way up
    assert np.linalg.det(slanted) == pytest.approx(1)


def test_defaults_and_matrices(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [4, 5, 6]
    (view,) = read_views(
        save_path(tmp_path / "a.json", [{"world_from_camera": pose.tolist()}], cx=50, fy=61)
    ).views
    np.testing.assert_array_equal(view.world_from_camera, pose)
    assert (view.fx, view.fy, view.cx, view.cy) == (60, 61, 50, 27)


def test_entries_of_one_time_are_one_frame(tmp_path: Path, scene: Scene) -> None:
    frames = [
        LEVEL | {"camera": camera, "timestamp_s": time}
        for time in (0.5, 0.0)
        for camera in ("front", "left")
    ]
    got = frames_from_path_file(save_path(tmp_path / "a.json", frames), scene)
    assert [(f.index, f.timestamp_ns, list(f.cameras)) for f in got] == [
        (0, 0, ["front", "left"]),
        (1, 500_000_000, ["front", "left"]),
    ]


def test_without_times_entries_count_by_camera(tmp_path: Path, scene: Scene) -> None:
    frames = [LEVEL | {"camera": camera} for camera in ("a", "a", "b", "b", "a")]
    got = frames_from_path_file(save_path(tmp_path / "a.json", frames), scene)
    assert [list(f.cameras) for f in got] == [["a", "b"], ["a", "b"], ["a"]]
    assert [f.timestamp_ns for f in got] == [0, 100_000_000, 200_000_000]


@pytest.mark.parametrize(
    ("frames", "changes", "message"),
    [
        ([], {}, "frames: List should have at least 1 item"),
        ([LEVEL | {"look_at": None}], {}, r"frames\.0: .*either position and look_at, or world"),
        ([LEVEL, LEVEL | {"world_from_camera": np.eye(4).tolist()}], {}, r"frames\.1: .*either"),
        ([LEVEL | {"position": [1, 2]}], {}, r"frames\.0\.position\.2: Field required"),
        ([LEVEL | {"position": [1, 2, math.inf]}], {}, r"frames\.0\.position\.2: .*finite"),
        ([LEVEL | {"look_att": [1, 2, 3]}], {}, r"frames\.0\.look_att: Extra inputs"),
        ([LEVEL | {"look_at": LEVEL["position"]}], {}, r"frames\.0: look_at must differ"),
        ([LEVEL | {"camera": "../up"}], {}, r"frames\.0\.camera: .*match pattern"),
        ([LEVEL | {"timestamp_s": 1}, LEVEL], {}, r"in 1 of 2 \(missing first in frames\.1\)"),
        ([LEVEL | {"timestamp_s": 1}] * 2, {}, "camera 'camera' stands 2 times at timestamp_s 1"),
        ([{"world_from_camera": (2 * np.eye(4)).tolist()}], {}, r"frames\.0: the rotation must be"),
        ([LEVEL], {"fx": 0}, "fx: Input should be greater than 0 "),
        ([LEVEL], {"width": 10**9}, "width: Input should be less than or equal to 65536"),
        ([LEVEL], {"speed": 3}, "speed: Extra inputs are not permitted"),
    ],
)
def test_bad_paths_name_the_field(tmp_path: Path, frames, changes, message: str) -> None:
    with pytest.raises(AdapterError, match=message):
        read_views(save_path(tmp_path / "a.json", frames, **changes))


def test_scene_with_a_path_opens_again(tmp_path: Path, scene: Scene) -> None:
    path = save_path(tmp_path / "a path.json", [LEVEL])
    changed = with_camera_path(scene, path)
    assert [list(f.cameras) for f in changed.frames] == [["camera"]]
    assert changed.background is scene.background
    assert not any("no cameras" in p for p in changed.problems)
    again = open_scene(changed.source)
    assert again.source == changed.source
    assert again.frames[0].cameras["camera"].centre.tolist() == [1, 2, 3]
    twice = with_camera_path(changed, save_path(tmp_path / "b.json", [LEVEL, LEVEL]))
    assert len(open_scene(twice.source).frames) == 2


def test_paths_follow_the_recentring_and_the_clock(tmp_path: Path, scene: Scene) -> None:
    """Poses are in the world before recentring; times count from the scene's first frame."""
    start = 1_557_000_000_000_000_000
    first = dataclasses.replace(scene.frames[0], timestamp_ns=start)
    moved = dataclasses.replace(
        scene, world_origin_m=np.array([1000.0, 0, 0]), frames=(first, *scene.frames[1:])
    )
    pose = {"position": [1001, 2, 3], "look_at": [1005, 2, 3], "timestamp_s": 0.25}
    (frame,) = frames_from_path_file(save_path(tmp_path / "a.json", [pose]), moved)
    assert frame.cameras["camera"].centre.tolist() == [1, 2, 3]
    assert frame.timestamp_ns == start + 250_000_000


def test_labels_do_not_follow(tmp_path: Path) -> None:
    scene = Scene(
        name="s", source="procedural:street", background=street(), actors=(),
        sky=ConstantSky(torch.zeros(3)), frames=(), labels=StreetGaussiansLabels(tmp_path),
    )  # fmt: skip
    changed = with_camera_path(scene, save_path(tmp_path / "a.json", [LEVEL]))
    assert changed.labels is None
    assert "boxes and LiDAR are left out" in changed.problems[0]
    assert changed.source == f"procedural:street?camera_path={tmp_path}/a.json"


def along_and_across(positions: np.ndarray, heading_deg: float) -> tuple[np.ndarray, np.ndarray]:
    angle = math.radians(heading_deg)
    forward = np.array([math.cos(angle), math.sin(angle)])
    left = np.array([-forward[1], forward[0]])
    return positions[:, :2] @ forward, positions[:, :2] @ left


@pytest.mark.parametrize(("heading_deg", "slope"), [(0.0, 0.0), (30.0, 0.05), (117.0, -0.05)])
def test_drive_follows_the_road(heading_deg: float, slope: float) -> None:
    path = make_default_path(street(heading_deg=heading_deg, slope=slope), is_metric=True)
    front = [v for v in path.views if v.camera == "front"]
    assert [v.frame for v in front] == list(range(len(front)))
    assert {v.camera for v in path.views} == {"front", "left", "right"}
    eyes = np.stack([v.world_from_camera[:3, 3] for v in front])
    along, across = along_and_across(eyes, heading_deg)
    assert np.ptp(along) > 30  # of 60 m of road, 30 % are left ahead
    # In the free part of the road: cars stand at -4 to -2 m, the wall at 4 m, a car is 2.5 m wide.
    assert across.min() > -1.5 and across.max() < 3.5
    # The ground is a low quantile within cells of 1 m: half a metre of slope off, and smoothed.
    np.testing.assert_allclose(eyes[:, 2] - slope * along, CAMERA_HEIGHT_M, atol=0.35)
    ahead = front[0].world_from_camera[:2, 2]
    angle = math.radians(heading_deg)
    assert abs(ahead @ [math.cos(angle), math.sin(angle)]) > math.cos(math.radians(6))
    assert path.ground_z_m == pytest.approx(min(0, slope * along.max()), abs=0.6)
    assert path.note.startswith(NO_CAMERAS) and "straight drive" in path.note


def test_a_scene_of_any_extent_gets_a_drive_of_a_kilometre_at_most(ends_soon) -> None:
    for size in (500.0, 1e7):
        ground = torch.rand(5000, 3, generator=torch.Generator().manual_seed(1))
        ground = gaussians_at(ground * torch.tensor([size, 0.5 * size, 0.4]))
        path = make_default_path(replace(ground, scales=ground.scales + size / 500), is_metric=True)
        positions = np.array([v.world_from_camera[:3, 3] for v in path.views])
        extent = np.ptp(positions[:, :2], axis=0)
        assert 300 < np.hypot(*extent) <= 1000.1
        assert (positions[:, :2] >= 0).all() and (positions[:, :2] <= [size, size / 2]).all()


def test_what_floats_far_away_does_not_move_the_drive() -> None:
    rng = torch.Generator().manual_seed(4)
    road = street(heading_deg=0)
    far = 900 + 300 * torch.rand(len(road) // 4, 3, generator=rng)
    alone = make_default_path(road, is_metric=True)
    path = make_default_path(gaussians_at(torch.cat([road.means, far])), is_metric=True)
    for one, other in zip(alone.views, path.views, strict=True):
        np.testing.assert_array_equal(one.world_from_camera, other.world_from_camera)


def test_a_road_above_its_foundations_is_driven_on() -> None:
    """Layers some decimetres below a road, as foundations and floaters leave them."""
    road = street(heading_deg=0)
    rng = torch.Generator().manual_seed(6)
    low = torch.rand(2000, 3, generator=rng) * torch.tensor([60.0, 8, 0.15])
    low += torch.tensor([0.0, -4, -0.45])
    path = make_default_path(gaussians_at(torch.cat([road.means, low])), is_metric=True)
    eyes = np.stack([view.world_from_camera[:3, 3] for view in path.views])
    np.testing.assert_allclose(eyes[:, 2], CAMERA_HEIGHT_M, atol=0.05)
    assert path.ground_z_m == pytest.approx(0, abs=0.05)


def test_what_blocks_the_road_is_avoided() -> None:
    """A truck across two thirds of the road: the line passes on the free side or stops before."""
    rng = torch.Generator().manual_seed(1)
    low, high = torch.tensor([25.0, -4.0, 0.0]), torch.tensor([33.0, 1.0, 3.0])
    truck = low + (high - low) * torch.rand(3000, 3, generator=rng)
    road = street(heading_deg=0)
    path = make_default_path(gaussians_at(torch.cat([road.means, truck])), is_metric=True)
    eyes = np.stack([v.world_from_camera[:3, 3] for v in path.views])
    inside = (eyes[:, 0] > 25) & (eyes[:, 0] < 33) & (eyes[:, 1] < 1)
    assert not inside.any()


@pytest.mark.parametrize("is_metric", [True, False])
def test_an_object_is_orbited(is_metric: bool) -> None:
    rng = torch.Generator().manual_seed(2)
    ball = torch.nn.functional.normalize(torch.randn(500, 3, generator=rng), dim=1) + 5.0
    path = make_default_path(gaussians_at(ball), is_metric=is_metric)
    assert "orbit of 48 frames" in path.note
    assert ("METRES_PER_UNIT" in path.note) is not is_metric
    for view in path.views:
        pose = view.world_from_camera
        towards = np.array([5.0, 5, 5]) - pose[:3, 3]
        assert pose[:3, 2] @ towards / np.linalg.norm(towards) > 0.99
        # All of the unit ball is in view: its angle from the axis is within half the image height.
        assert math.asin(1 / np.linalg.norm(towards)) < math.atan(view.height / 2 / view.fy)


def test_kinds_can_be_insisted_on() -> None:
    assert "orbit" in make_default_path(street(), is_metric=True, kind="orbit").note
    assert "orbit" in make_default_path(street(), is_metric=False).note
    assert "drive" in make_default_path(street(), is_metric=False, kind="drive").note


def test_degenerate_scenes_get_a_path() -> None:
    """One Gaussian, or many in one place: no division by their extent."""
    for kind, count in (("auto", 1), ("drive", 1), ("drive", 40), ("orbit", 1), ("orbit", 40)):
        made = make_default_path(gaussians_at(torch.ones(count, 3)), is_metric=True, kind=kind)
        assert frames_from_views(made.views, WorldChange())[0] and made.note.startswith(NO_CAMERAS)


@pytest.mark.long
def test_real_tiles_are_driven(shared_dir: Path) -> None:
    """30 m tiles of a street, so blurred that nothing is free: a drive nonetheless, inside them."""
    for tile in sorted((shared_dir / "data" / "splats").glob("*.splat")):
        gaussians = read_splats(tile).gaussians
        path = make_default_path(gaussians, is_metric=True)
        assert "straight drive" in path.note
        eyes = np.stack([v.world_from_camera[:3, 3] for v in path.views])
        assert np.ptp(eyes[:, :2], axis=0).max() > 8
        low, high = np.quantile(gaussians.means.numpy(), [0.005, 0.995], axis=0)
        assert (eyes > low).all() and (eyes < high).all()
        above = eyes[:, 2] - ground_grid(solid_points(gaussians), cell=1.0).at(eyes)
        # Their ground jumps by metres from cell to cell; the path is smoothed, so only on average.
        assert np.nanmedian(above) == pytest.approx(CAMERA_HEIGHT_M, abs=0.8)
