"""The contract of every dataset: a scene gives back what the files state.

A new dataset joins with its `write_as_X` and `drive_of_X` in `all_drives.WRITERS`.
"""

from __future__ import annotations

import pickle
from typing import NamedTuple

import numpy as np
import pytest

from adapters.base import detect_scheme_of_path
from adapters.datasets import DATASETS
from adapters.uri import format_uri
from augment.render.sh import SH_C0
from augment.scene.scene import Scene
from tests.adapters import street
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
    assert (np.abs(actor.gaussians.means.numpy()) <= box.size_m / 2 + 0.1).all()
    for time_ns in list(drive.times_ns.values())[1:-1]:
        pose = actor.track.pose_at(time_ns).numpy()
        expected = drive.world_from_car(time_ns)
        place = expected[:3, 3] - scene.world_origin_m
        np.testing.assert_allclose(pose[:3, 3], place, 0, drive.car_atol_m)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], 0, drive.car_turn_atol)
    rgb = (actor.gaussians.sh[:, 0] * SH_C0 + 0.5).median(0).values
    np.testing.assert_allclose(rgb, drive.car_rgb / 255, atol=0.03)


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
