"""Camera path files: the format, its errors, and scenes that take one."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import street

from adapters.base import open_scene
from adapters.camera_files.camera_files import read_views
from adapters.camera_files.paths import frames_from_path_file, with_camera_path
from augment.errors import AdapterError
from augment.files.ply import write_ply
from augment.scene import Scene
from augment.sky import ConstantSky

LENS = {"width": 96, "height": 54, "fx": 60.0}
LEVEL = {"position": [1.0, 2.0, 3.0], "look_at": [5.0, 2.0, 3.0]}


def save(path: Path, frames: list, **changes) -> Path:
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
        v.world_from_camera for v in read_views(save(tmp_path / "a.json", frames)).views
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
        save(tmp_path / "a.json", [{"world_from_camera": pose.tolist()}], cx=50, fy=61)
    ).views
    np.testing.assert_array_equal(view.world_from_camera, pose)
    assert (view.fx, view.fy, view.cx, view.cy) == (60, 61, 50, 27)


def test_entries_of_one_time_are_one_frame(tmp_path: Path, scene: Scene) -> None:
    frames = [
        LEVEL | {"camera": camera, "timestamp_s": time}
        for time in (0.5, 0.0)
        for camera in ("front", "left")
    ]
    got = frames_from_path_file(save(tmp_path / "a.json", frames), scene)
    assert [(f.index, f.timestamp_ns, list(f.cameras)) for f in got] == [
        (0, 0, ["front", "left"]),
        (1, 500_000_000, ["front", "left"]),
    ]


def test_without_times_entries_count_by_camera(tmp_path: Path, scene: Scene) -> None:
    frames = [LEVEL | {"camera": camera} for camera in ("a", "a", "b", "b", "a")]
    got = frames_from_path_file(save(tmp_path / "a.json", frames), scene)
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
        read_views(save(tmp_path / "a.json", frames, **changes))


def test_scene_with_a_path_opens_again(tmp_path: Path, scene: Scene) -> None:
    path = save(tmp_path / "a path.json", [LEVEL])
    changed = with_camera_path(scene, path)
    assert [list(f.cameras) for f in changed.frames] == [["camera"]]
    assert changed.background is scene.background
    assert not any("no cameras" in p for p in changed.problems)
    again = open_scene(changed.source)
    assert again.source == changed.source
    assert again.frames[0].cameras["camera"].centre.tolist() == [1, 2, 3]
    twice = with_camera_path(changed, save(tmp_path / "b.json", [LEVEL, LEVEL]))
    assert len(open_scene(twice.source).frames) == 2


def test_paths_follow_the_recentring_and_the_clock(tmp_path: Path, scene: Scene) -> None:
    """Poses are in the world before recentring; times count from the scene's first frame."""
    start = 1_557_000_000_000_000_000
    first = dataclasses.replace(scene.frames[0], timestamp_ns=start)
    moved = dataclasses.replace(
        scene, world_origin_m=np.array([1000.0, 0, 0]), frames=(first, *scene.frames[1:])
    )
    pose = {"position": [1001, 2, 3], "look_at": [1005, 2, 3], "timestamp_s": 0.25}
    (frame,) = frames_from_path_file(save(tmp_path / "a.json", [pose]), moved)
    assert frame.cameras["camera"].centre.tolist() == [1, 2, 3]
    assert frame.timestamp_ns == start + 250_000_000


def test_labels_do_not_follow(tmp_path: Path) -> None:
    class Labels:
        def boxes(self, frame_index: int):
            raise AssertionError("not asked for")

        def lidar(self, frame_index: int):
            raise AssertionError("not asked for")

    scene = Scene(
        name="s", source="procedural:street", background=street(), actors=(),
        sky=ConstantSky(torch.zeros(3)), frames=(), labels=Labels(),
    )  # fmt: skip
    changed = with_camera_path(scene, save(tmp_path / "a.json", [LEVEL]))
    assert changed.labels is None
    assert "boxes and LiDAR are left out" in changed.problems[0]
    assert changed.source == f"procedural:street?camera_path={tmp_path}/a.json"


def test_other_formats_serve_as_paths(tmp_path: Path, scene: Scene) -> None:
    pose = np.diag([1.0, -1, -1, 1])  # OpenGL axes: this camera looks along world +z
    frame = {"file_path": "0001.png", "transform_matrix": pose.tolist()}
    nerfstudio = {"w": 9, "h": 9, "fl_x": 9, "frames": [frame]}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(nerfstudio))
    (got,) = frames_from_path_file(path, scene)
    np.testing.assert_array_equal(got.cameras["camera"].world_from_camera, np.eye(4))
    with pytest.raises(AdapterError, match="no such file"):
        frames_from_path_file(tmp_path / "absent.json", scene)
