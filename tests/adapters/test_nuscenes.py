"""A nuScenes scene: a street whose answer is known, and the one real keyframe."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import nuscenes_files as files
import pandaset_folder as street
import pytest
import torch
from shown import psnr, psnr_of, render

from adapters.base import recognise
from adapters.nuscenes.adapter import EGO_HIGH_M, EGO_LOW_M, open_nuscenes
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.labels import ClassifiesLidar
from augment.semantics import SemanticClass

ONE, TWO = files.SCENES
QUERY = {"scene": TWO, "voxel_m": "0.15", "image_scale": "1", "sky_size": "32"}
QUICK = {"scene": ONE, "voxel_m": "0.5", "image_scale": "0.5", "sky_size": "8"}
ORIGIN = np.array([2100.0, 900.0, 3.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return files.write_dataset(tmp_path_factory.mktemp("nuscenes") / "data")


@pytest.fixture(scope="module")
def scene(folder):
    return open_nuscenes(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "data"))


def into_street(points: np.ndarray) -> np.ndarray:
    """Points of the second scene's own world in the street's coordinates."""
    pose = files.WORLD_FROM_STREET[1]
    return (points + ORIGIN - pose[:3, 3]) @ pose[:3, :3]


def test_the_scene_is_described(scene, folder):
    assert scene.name == TWO and scene.problems == ()
    assert scene.source == format_uri("nuscenes", str(folder), QUERY)
    assert recognise(folder) == "nuscenes"
    assert scene.camera_names == ("CAM_FRONT", "CAM_FRONT_LEFT")
    assert [f.index for f in scene.frames] == list(range(files.SWEEPS))
    assert [f.timestamp_ns for f in scene.frames] == [t * 1000 for t in files.sweep_times_us(1)]
    np.testing.assert_array_equal(scene.world_origin_m, ORIGIN)
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z, abs=1e-3)
    assert [i for i, f in enumerate(scene.frames) if f.cameras] == [0, 2, 5, 7, 10]


def test_ego_and_cameras_have_their_own_poses_and_times(scene):
    frame = scene.frame(7)
    expected = files.world_from_ego(1, 0.7)
    expected[:3, 3] -= ORIGIN
    np.testing.assert_allclose(frame.world_from_ego, expected, atol=1e-9)
    camera = frame.cameras["CAM_FRONT"]
    assert camera.timestamp_ns == files.image_times_us(1, "CAM_FRONT")[3] * 1000
    pose = files.world_from_ego(1, 0.7145) @ files.ego_from_camera("CAM_FRONT")
    pose[:3, 3] -= ORIGIN
    np.testing.assert_allclose(camera.world_from_camera, pose, atol=1e-9)
    assert frame.image_paths["CAM_FRONT"].endswith(files.filename(1, "CAM_FRONT", 3))


@pytest.mark.parametrize("camera", ["CAM_FRONT", "CAM_FRONT_LEFT"])
def test_the_scene_looks_like_the_recorded_image(scene, camera):
    # 24 dB and more when written; edges are as blurred as the voxels of 15 cm are wide.
    assert psnr_of(scene, 5, camera) > 22


def test_the_moving_car_is_an_actor_where_its_boxes_are(scene):
    (actor,) = scene.actors
    assert actor.track_id == files.instance_token(1, files.CAR)
    assert actor.label == "vehicle.car"
    assert actor.size_m == pytest.approx(tuple(street.CAR_SIZE_M))
    inside = np.abs(actor.gaussians.means.numpy()) <= street.CAR_SIZE_M / 2 + 0.1
    assert inside.all()
    for time in (0.0, 0.2, 0.5, 0.83):
        # In the sweep's 40 ms before its boxes' time it moved by 0.24 m: that is accounted for.
        pose = actor.track.pose_at(files.START_US[1] * 1000 + round(time * 1e9)).numpy()
        np.testing.assert_allclose(into_street(pose[:3, 3]), street.car_centre(time), atol=2e-3)
    # Where the car was at any time, nothing of it stays behind.
    means = into_street(scene.background.means.numpy().astype(np.float64))
    above = means[:, 2] > street.GROUND_Z + 0.2
    for time in np.arange(0, 1.01, 0.1):
        offset = np.abs(means - street.car_centre(time))
        assert not ((offset < street.CAR_SIZE_M / 2).all(axis=1) & above).any()


def test_returns_of_the_recording_car_are_in_the_labels_only(scene):
    points, _ = files.sweep(0)
    own = points[-2:]
    np.testing.assert_allclose(into_street(scene.lidar(0).points_m[-2:] - ORIGIN), own, atol=1e-5)
    means = into_street(scene.background.means.numpy().astype(np.float64))
    path = np.arange(0, 8.1, 0.4)[:, None] * [1, 0, 0]
    for place in np.concatenate([own[0] + path, own[1] + path]):
        assert np.linalg.norm(means - place, axis=1).min() > 0.5


def test_own_returns_are_known_without_classes(tmp_path):
    root = files.write_dataset(tmp_path / "data", semantic=False)
    plain = open_nuscenes(str(root), QUERY | {"voxel_m": "0.3"})
    assert plain.problems == () and len(plain.actors) == 1
    assert "semantic" not in plain.lidar(0).columns
    assert (plain.background.semantic == SemanticClass.UNKNOWN).all()
    assert plain.ground_z_m == pytest.approx(street.GROUND_Z, abs=0.02)
    height = into_street(plain.background.means.numpy().astype(np.float64))
    on_road = np.abs(height[:, 1]) < 1.0
    assert height[on_road, 2].max() < street.GROUND_Z + 0.3


def test_points_take_their_class(scene):
    assert isinstance(scene.labels, ClassifiesLidar)
    sweep = scene.lidar(5)
    classes = scene.labels.lidar_classes(sweep)
    assert set(classes.tolist()) == {
        SemanticClass.ROAD, SemanticClass.BUILDING, SemanticClass.VEHICLE,
    }  # fmt: skip
    np.testing.assert_array_equal(classes == SemanticClass.ROAD, sweep.columns["semantic"] == 24)
    assert scene.labels.lidar_classes(scene.lidar(4)) is None
    semantic = scene.background.semantic.numpy()
    means = into_street(scene.background.means.numpy().astype(np.float64))
    known = semantic != SemanticClass.UNKNOWN
    road = np.abs(means[:, 2] - street.GROUND_Z) < 0.05
    assert (semantic[known & road & (means[:, 1] < 7)] == SemanticClass.ROAD).all()
    assert (semantic[known & (means[:, 2] > 1)] == SemanticClass.BUILDING).all()
    assert (known & road).sum() > 1000


def test_keyframes_alone(folder):
    scene = open_nuscenes(str(folder), QUICK | {"sweeps": "0"})
    assert [f.timestamp_ns for f in scene.frames] == [
        files.sweep_times_us(0)[i] * 1000 for i in (0, 5, 10)
    ]
    assert all(set(f.cameras) == set(files.CAMERAS) for f in scene.frames)
    assert (scene.world_origin_m == 0).all()
    assert not any(scene.boxes(i).attributes["interpolated"].any() for i in range(3))


def test_a_few_frames_between_keyframes_have_their_tracks(folder):
    scene = open_nuscenes(str(folder), QUICK | {"frames": "6:9"})
    assert [f.index for f in scene.frames] == [6, 7, 8]
    car = next(a for a in scene.actors if a.label == "vehicle.car")
    pose = car.track.pose_at(scene.frame(7).timestamp_ns)
    np.testing.assert_allclose(pose[:3, 3], street.car_centre(0.7), atol=2e-3)
    with pytest.raises(AdapterError, match=r"frames=20:30 selects none of the 11 frames"):
        open_nuscenes(str(folder), QUICK | {"frames": "20:30"})


def test_held_out_frames_leave_no_trace_in_the_gaussians(copy):
    query = QUICK | {"held_out": "5:6"}
    held = open_nuscenes(str(copy), query)
    for channel in files.CAMERAS:
        black = np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8)
        cv2.imwrite(str(copy / files.filename(0, channel, 2)), black)
    (copy / files.filename(0, "LIDAR_TOP", 5)).write_bytes(bytes(20 * 9442))
    again = open_nuscenes(str(copy), query)
    assert torch.equal(held.background.means, again.background.means)
    assert torch.equal(held.background.sh, again.background.sh)
    assert held.frame(5).image_paths.keys() == set(files.CAMERAS) and len(held.boxes(5)) == 3


def test_missing_and_damaged_files_are_problems(copy):
    (copy / files.filename(0, "LIDAR_TOP", 3)).unlink()
    cut = copy / files.filename(0, "LIDAR_TOP", 4)
    cut.write_bytes(cut.read_bytes()[:-7])
    (copy / files.filename(0, "CAM_FRONT", 0)).unlink()
    left = copy / files.filename(0, "CAM_FRONT_LEFT", 1)
    left.write_bytes(left.read_bytes()[:-200])
    wrong = copy / files.filename(0, "CAM_FRONT_LEFT", 4)
    cv2.imwrite(str(wrong), np.zeros((48, 80, 3), np.uint8))
    classes = copy / f"lidarseg/{files.VERSION}"
    (classes / f"{files.data_token(0, 'LIDAR_TOP', 0)}_lidarseg.bin").unlink()
    (classes / f"{files.data_token(0, 'LIDAR_TOP', 5)}_lidarseg.bin").write_bytes(b"abc")
    scene = open_nuscenes(str(copy), QUICK)
    text = "\n".join(scene.problems)
    assert len(scene.problems) == 7, text
    assert "1 of 11 LiDAR files are missing, their points too (the first: frame 3, sweeps/" in text
    assert "frame 4: sweeps/LIDAR_TOP/" in text and "not of whole records of 20: it is cut" in text
    assert "camera CAM_FRONT, frame 0: image samples/" in text and "does not exist" in text
    assert "camera CAM_FRONT_LEFT, frame 2" in text and "is cut short" in text
    assert "camera CAM_FRONT_LEFT, frame 10" in text and "pixels; its camera is of 160x96" in text
    assert "frame 0: lidarseg/" in text and "is missing; its points have no class" in text
    assert "frame 5: lidarseg/" in text and "has 3 classes for 9442 returns" in text
    assert scene.lidar(3) is None and scene.lidar(4) is None
    assert set(scene.frame(0).image_paths) == {"CAM_FRONT_LEFT"}
    assert set(scene.frame(0).cameras) == {"CAM_FRONT", "CAM_FRONT_LEFT"}


def test_none_at_all_is_an_error(copy):
    for number in range(files.IMAGES):
        path = copy / files.filename(0, "CAM_FRONT", number)
        cv2.imwrite(str(path), np.zeros((48, 80, 3), np.uint8))
    with pytest.raises(AdapterError, match=r"none of the 5 images of CAM_FRONT .* 160x96"):
        open_nuscenes(str(copy), QUICK)
    sweeps = [copy / files.filename(0, "LIDAR_TOP", number) for number in range(files.SWEEPS)]
    for path in sweeps:
        path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(AdapterError, match=r"unpack .* \(frame 0: .*pcd\.bin .* it is cut short"):
        open_nuscenes(str(copy), QUICK)
    for path in sweeps:
        path.unlink()
    with pytest.raises(AdapterError, match=r"no LiDAR returns in frames 0 to 10; .*11 of 11 LiDAR"):
        open_nuscenes(str(copy), QUICK)


def test_frames_without_images_are_an_error(folder):
    with pytest.raises(AdapterError, match="no usable image in frame 1, and"):
        open_nuscenes(str(folder), QUICK | {"frames": "1:2"})
    with pytest.raises(AdapterError, match="no usable image in frames 5 to 6 but those"):
        open_nuscenes(str(folder), QUICK | {"frames": "5:7", "held_out": "5:6"})


@pytest.fixture(scope="module")
def source(shared_dir) -> Path:
    folder = shared_dir / "data/nuscenes_keyframe"
    if not (folder / "info.json").is_file():
        pytest.skip(f"no nuScenes keyframe at {folder}")
    return folder


@pytest.fixture(scope="module")
def real(source, tmp_path_factory):
    root = files.write_keyframe(tmp_path_factory.mktemp("keyframe") / "data", source)
    query = {"voxel_m": "0.1", "image_scale": "0.5", "sky_size": "128"}
    return open_nuscenes(str(root), query)


def test_the_real_keyframe_opens(real):
    assert real.problems == () and len(real.frames) == 1 and len(real.camera_names) == 6
    assert len(real.background) > 20_000 and len(real.actors) >= 5
    # The ego's origin is on the ground.
    assert real.ground_z_m == pytest.approx(0.0, abs=0.15)
    assert len(real.boxes(0)) == 69 and len(real.lidar(0)) == 34_688


def test_real_returns_project_as_by_the_sources_own_matrices(real, source):
    (info,) = json.loads((source / "info.json").read_text())["data_list"]
    path = source / "demo_nuscenes" / info["lidar_points"]["lidar_path"]
    points = np.fromfile(path, np.float32).reshape(-1, 5)[:, :3].astype(np.float64)
    world = real.lidar(0).points_m - real.world_origin_m
    for name, image in info["images"].items():
        camera = real.frame(0).cameras[name]
        theirs = np.array(image["cam2img"]) @ (_carried(image["lidar2cam"], points)).T
        ours = camera.K.numpy() @ _carried(camera.camera_from_world.numpy(), world).T
        visible = (theirs[2] > 1) & (np.abs(theirs[0] / theirs[2] - 800) < 800)
        visible &= np.abs(theirs[1] / theirs[2] - 450) < 450
        assert visible.sum() > 1500
        apart = np.linalg.norm((theirs[:2] / theirs[2] - ours[:2] / ours[2])[:, visible], axis=0)
        assert apart.mean() < 0.1, (name, apart.mean())


def test_real_images_were_taken_as_the_lidar_looked_there(real):
    turn = real.labels.tables.turn
    assert np.degrees(turn.end_rad) == pytest.approx(files.TURN_END_DEG, abs=3)
    for files_of in real.labels.tables.images.values():
        (image,) = files_of
        expected = turn.before_ns(image.ego_from_sensor[None, :3, 2])[0]
        taken = real.frame(0).timestamp_ns - image.timestamp_ns
        assert abs(expected - taken) < 1_000_000, image.channel


def test_real_boxes_hold_their_returns(real):
    boxes, points = real.boxes(0), real.lidar(0).points_m
    counts = boxes.attributes["num_lidar_pts"]
    for i in np.flatnonzero(counts >= 40):
        w, _, _, z = boxes.quats[i] / np.linalg.norm(boxes.quats[i])
        turn = 2 * np.arctan2(z, w)
        local = points - boxes.centers_m[i]
        x = np.cos(turn) * local[:, 0] + np.sin(turn) * local[:, 1]
        y = -np.sin(turn) * local[:, 0] + np.cos(turn) * local[:, 1]
        along = np.stack([x, y, local[:, 2]], axis=1)
        held = (np.abs(along) <= boxes.sizes_m[i] / 2).all(axis=1).sum()
        assert held == pytest.approx(counts[i], rel=0.1)


def test_a_quarter_of_the_real_returns_are_the_cars_own(real):
    pose = real.frame(0).world_from_ego.numpy()
    world = real.lidar(0).points_m - real.world_origin_m
    ego = (world - pose[:3, 3]) @ pose[:3, :3]
    own = ((ego > EGO_LOW_M) & (ego < EGO_HIGH_M)).all(axis=1)
    near = np.linalg.norm(ego[:, :2] - [0.94, 0], axis=1) < 2.5
    assert own.sum() == near.sum() == 8526


def test_the_real_keyframe_looks_like_its_images(real):
    for name, full in real.frame(0).cameras.items():
        camera = full.scaled(0.1)
        recorded = cv2.imread(real.frame(0).image_paths[name])[..., ::-1] / 255
        size = (camera.width, camera.height)
        recorded = cv2.resize(recorded, size, interpolation=cv2.INTER_AREA)
        low = camera.height // 2
        image = render(real, camera)
        # 0.85 to 0.92 and 19.5 to 23.4 dB at a quarter of the size when written.
        alike = np.corrcoef(image[low:].ravel(), recorded[low:].ravel())[0, 1]
        assert alike > 0.8 and psnr(image, recorded) > 18.5, (name, alike)


def _carried(pose, points: np.ndarray) -> np.ndarray:
    pose = np.array(pose)
    return points @ pose[:3, :3].T + pose[:3, 3]
