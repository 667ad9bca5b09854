"""The contract of every dataset: a scene gives back what the files state.

A new dataset joins with its `write_as_X` and `drive_of_X` in `all_drives.WRITERS`.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from adapters.base import detect_scheme_of_path
from adapters.datasets import DATASETS
from adapters.uri import format_uri
from augment.render.sh import SH_C0
from augment.scene.scene import Scene
from tests.adapters import nuscenes_files, street
from tests.adapters.all_drives import WRITERS, write_drive
from tests.adapters.shown import psnr_of
from tests.adapters.street import Drive

QUERY = {"voxel_m": "0.1", "image_scale": "1", "sky_size": "32"}


class Opened(NamedTuple):
    """A drive and the scene made of its files."""

    drive: Drive
    scene: Scene


@pytest.fixture(scope="module", params=WRITERS)
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Opened:
    folder = tmp_path_factory.mktemp(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        drive = write_drive(request.param, folder / "drive")
        scene = DATASETS[drive.scheme].open(str(drive.path), drive.query | QUERY)
    return Opened(drive, scene)


def test_a_scene_says_what_it_was_made_of(opened: Opened) -> None:
    drive, scene = opened
    assert scene.name == drive.name
    assert scene.source == format_uri(drive.scheme, drive.path, drive.query | QUERY)
    assert detect_scheme_of_path(drive.path) == drive.scheme
    assert set(scene.camera_names) == {name for views in drive.views.values() for name in views}
    assert len(scene.problems) == len(drive.problems), scene.problems
    for problem, part in zip(sorted(scene.problems), sorted(drive.problems), strict=True):
        assert part in problem
    ground_z_m = scene.ground_z_m + scene.world_origin_m[2]
    assert ground_z_m == pytest.approx(drive.ground_z_m, abs=drive.ground_atol_m)


def test_poses_times_and_lenses_are_those_of_the_files(opened: Opened) -> None:
    drive, scene = opened
    assert [frame.index for frame in scene.frames] == list(drive.times_ns)
    origin = street.rigid(np.eye(3), scene.world_origin_m)
    for frame in scene.frames:
        number = frame.index
        assert abs(frame.timestamp_ns - drive.times_ns[number]) <= drive.time_atol_ns
        pose = origin @ frame.world_from_ego.numpy()
        np.testing.assert_allclose(pose, drive.world_from_ego[number], 0, drive.pose_atol)
        views = drive.views[number]
        assert frame.cameras.keys() == frame.image_paths.keys() == views.keys()
        for name, camera in frame.cameras.items():
            assert abs(camera.timestamp_ns - views[name].timestamp_ns) <= drive.time_atol_ns
            pose = origin @ camera.world_from_camera.numpy()
            np.testing.assert_allclose(pose, views[name].world_from_camera, 0, drive.pose_atol)
            lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            assert lens == pytest.approx(drive.lenses.get(name, lens), abs=1e-9)


def test_a_scene_looks_like_the_recorded_images(opened: Opened) -> None:
    drive, scene = opened
    with_images = [number for number, views in drive.views.items() if views]
    number = with_images[len(with_images) // 2]
    for name in list(drive.views[number])[:2]:
        assert psnr_of(scene, number, name) > drive.min_psnr_db, name


def test_the_car_is_the_only_actor_and_drives_where_it_was(opened: Opened) -> None:
    drive, scene = opened
    (actor,) = scene.actors
    box = next(iter(drive.boxes.values()))[drive.car]
    assert (actor.track_id, actor.label) == (drive.car, box.label)
    assert actor.size_m == pytest.approx(tuple(box.size_m))
    # Returns up to 0.1 m outside count as the car's, in float32.
    assert (np.abs(actor.gaussians.means.numpy()) <= box.size_m / 2 + 0.1001).all()
    for time_ns in list(drive.times_ns.values())[1:-1]:
        pose = actor.track.pose_at(time_ns).numpy()
        expected = drive.world_from_car(time_ns)
        place = expected[:3, 3] - scene.world_origin_m
        np.testing.assert_allclose(pose[:3, 3], place, 0, drive.car_atol_m)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], 0, drive.car_turn_atol)
    rgb = (actor.gaussians.sh[:, 0] * SH_C0 + 0.5).median(0).values
    # The car is some 20 pixels wide where its colours are read, and JPEG blurs red into grey.
    np.testing.assert_allclose(rgb, drive.car_rgb / 255, atol=0.05)


def test_nothing_of_the_car_stays_in_the_background(opened: Opened) -> None:
    drive, scene = opened
    means = scene.background.means.numpy().astype(np.float64) + scene.world_origin_m
    half = next(iter(drive.boxes.values()))[drive.car].size_m / 2
    has_discs = False
    for time_ns in drive.times_ns.values():
        pose = drive.world_from_car(time_ns)
        local = (means - pose[:3, 3]) @ pose[:3, :3]
        is_above_ground = local[:, 2] > 0.25 - half[2]
        has_discs |= bool(((np.abs(local) < half).all(axis=1) & is_above_ground).any())
    assert has_discs == drive.has_discs_in_car


def test_boxes_are_those_of_the_files(opened: Opened) -> None:
    drive, scene = opened
    for number, expected in drive.boxes.items():
        boxes = scene.boxes(number)
        assert boxes.track_ids == tuple(expected)
        assert boxes.labels == tuple(box.label for box in expected.values())
        centres_m = [box.centre_m for box in expected.values()]
        np.testing.assert_allclose(boxes.centers_m, centres_m, 0, drive.box_atol_m)
        np.testing.assert_allclose(boxes.sizes_m, [box.size_m for box in expected.values()])
    assert len(scene.boxes(99)) == 0


def test_sweeps_are_those_of_the_files_and_belong_to_the_labels_alone(opened: Opened) -> None:
    drive, scene = opened
    labels = DATASETS[drive.scheme].open_labels(str(drive.path), drive.query)
    labels = pickle.loads(pickle.dumps(labels))
    for number, points_m in drive.points_m.items():
        np.testing.assert_allclose(scene.lidar(number).points_m, points_m, 0, drive.point_atol_m)
    number = next(iter(drive.boxes))
    np.testing.assert_array_equal(labels.lidar(number).points_m, scene.lidar(number).points_m)
    np.testing.assert_array_equal(labels.boxes(number).centers_m, scene.boxes(number).centers_m)
    assert scene.lidar(99) is None and labels.lidar(99) is None


def cut(num_bytes: int) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(path.read_bytes()[:-num_bytes])


def shrink(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((48, 80, 3), np.uint8))


def nuscenes_file(channel: str, number: int) -> str:
    return nuscenes_files.filename(1, channel, number)


def lidarseg_file(number: int) -> str:
    token = nuscenes_files.data_token(1, "LIDAR_TOP", number)
    return f"lidarseg/{nuscenes_files.VERSION}/{token}_lidarseg.bin"


# Files of a drive, what happens to them, the sentence on it, and what is lost: the sweep of a
# frame, the image of a frame and camera, or neither.
Damage = tuple[str, Callable[[Path], object], str, int | tuple[int, str] | None]
DAMAGES: dict[str, tuple[Damage, ...]] = {
    "pandaset": (
        ("lidar/01.pkl.gz", Path.unlink, r"frame 1: lidar/01\.pkl\.gz is missing", 1),
        ("annotations/cuboids/02.pkl.gz", Path.unlink, r"frame 2: .*cuboids/02.* is missing", None),
        ("annotations/semseg/00.pkl.gz", Path.unlink, r"frame 0: .*semseg/00.* is missing", None),
        ("camera/front_camera/00.jpg", Path.unlink,
         r"camera front_camera, frame 0: .*00\.jpg does not exist", (0, "front_camera")),
        ("camera/left_camera/01.jpg", cut(200),
         r"camera left_camera, frame 1: .*01\.jpg is cut short", (1, "left_camera")),
        ("camera/left_camera/02.jpg", shrink,
         r"02\.jpg is 80x48 pixels, its camera 160x96", (2, "left_camera")),
    ),
    "nuscenes": (
        (nuscenes_file("LIDAR_TOP", 3), Path.unlink,
         r"LiDAR's files of 1 frame \(3\) are missing, their points too", 3),
        (nuscenes_file("LIDAR_TOP", 4), cut(7),
         r"frame 4: sweeps/LIDAR_TOP/.*not of whole records of 20: it is cut", 4),
        (nuscenes_file("CAM_FRONT", 0), Path.unlink,
         r"camera CAM_FRONT, frame 0: image .*does not exist", (0, "CAM_FRONT")),
        (nuscenes_file("CAM_FRONT_LEFT", 1), cut(200),
         r"camera CAM_FRONT_LEFT, frame 2: .*is cut short", (2, "CAM_FRONT_LEFT")),
        (nuscenes_file("CAM_FRONT_LEFT", 4), shrink,
         r"CAM_FRONT_LEFT, frame 10: .*80x48 pixels, its camera 160x96", (10, "CAM_FRONT_LEFT")),
        (lidarseg_file(0), Path.unlink,
         r"frame 0: lidarseg/.*is missing; its points have no class", None),
        (lidarseg_file(5), lambda path: path.write_bytes(b"abc"),
         r"frame 5: lidarseg/.*has 3 classes for 9442 returns", None),
    ),
    "recording": (
        ("lidar/000001.parquet", Path.unlink, r"the files of 1 frame \(1\) are missing", 1),
        ("images/left_camera/000000.png", Path.unlink,
         r"camera left_camera, frame 0: its image is missing", (0, "left_camera")),
        ("images/left_camera/000001.png", cut(30), r"000001\.png is cut short", (1, "left_camera")),
        ("images/left_camera/000002.png", shrink,
         r"000002\.png is 80x48 pixels, its camera 160x96", (2, "left_camera")),
    ),
}  # fmt: skip


@pytest.mark.parametrize("scheme", DAMAGES)
def test_missing_and_damaged_files_are_said_and_cost_no_more(scheme: str, tmp_path: Path) -> None:
    drive = write_drive(scheme, tmp_path / "drive")
    for file, damage, _, _ in DAMAGES[scheme]:
        damage(drive.path / file)
    query = drive.query | {"voxel_m": "0.5", "image_scale": "0.5", "sky_size": "8"}
    scene = DATASETS[scheme].open(str(drive.path), query)
    sentences = [sentence for _, _, sentence, _ in DAMAGES[scheme]]
    text = "\n".join(scene.problems)
    assert all(re.search(sentence, text) for sentence in sentences), text
    assert len(scene.problems) == len(sentences), text
    losses = [loss for _, _, _, loss in DAMAGES[scheme]]
    for frame in scene.frames:
        assert (scene.lidar(frame.index) is None) == (frame.index in losses)
        assert frame.cameras.keys() == drive.views[frame.index].keys()
        lost = {name for name in frame.cameras if (frame.index, name) in losses}
        assert frame.image_paths.keys() == frame.cameras.keys() - lost
