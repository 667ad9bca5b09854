"""How images become frames of cameras."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from adapters.camera_files.camera_files import PosedView, look_at_pose
from adapters.camera_files.paths import frames_from_views, split_names
from adapters.world import WorldChange
from augment.errors import AdapterError


def view(name: str, *, position=(0.0, 0.0, 2.0), target=(9.0, 0.0, 2.0), **changes) -> PosedView:
    fields = {"width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0} | changes
    return PosedView(
        name=name, world_from_camera=look_at_pose(position, target, where="test"), **fields
    )


def grouped(names: list[str]) -> list[tuple[int, list[str]]]:
    frames, problems = frames_from_views([view(name) for name in names], WorldChange())
    assert problems == ()
    return [(frame.index, list(frame.cameras)) for frame in frames]


def test_folder_per_camera() -> None:
    names = ["images/left/0010.jpg", "images/front/0010.jpg", "images/front/0009.jpg"]
    assert grouped(names) == [(9, ["front"]), (10, ["front", "left"])]


def test_folder_per_frame() -> None:
    names = ["0003/cam_l.png", "0003/cam_f.png", "0002/cam_f.png", "0002/cam_l.png"]
    assert grouped(names) == [(2, ["cam_f", "cam_l"]), (3, ["cam_f", "cam_l"])]


@pytest.mark.parametrize(
    "names",
    [
        ["000012_0.png", "000012_1.png", "000013_0.png", "000013_1.png"],
        ["000012_0", "000013_1", "000012_1", "000013_0"],
    ],
)
def test_frame_then_camera(names: list[str]) -> None:
    assert grouped(names) == [(12, ["0", "1"]), (13, ["0", "1"])]
    words = [name.replace("_0", "_front").replace("_1", "_front_left") for name in names]
    assert grouped(words)[0] == (12, ["front", "front_left"])


def test_camera_then_frame() -> None:
    names = ["left_0001.jpg", "right_0001.jpg", "left_0002.jpg", "right_0002.jpg"]
    assert grouped(names) == [(1, ["left", "right"]), (2, ["left", "right"])]


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


def test_phone_dates_are_no_rig() -> None:
    names = [f"20240131_1200{n:02d}.jpg" for n in range(20)]
    assert split_names(names) is None
    assert all(cameras == ["camera"] for _, cameras in grouped(names))


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
