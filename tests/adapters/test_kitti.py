"""KITTI as scenes: a street whose answer is known in its layouts, and real frames."""

from __future__ import annotations

import math
import pickle
import shutil
from pathlib import Path

import cv2
import kitti_files as street
import numpy as np
import pytest
import torch
from shown import assert_same_bits, psnr, psnr_of, render

from adapters.base import open_scene
from adapters.kitti.adapter import kitti_labels, open_kitti
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.geometry import rotmat_from_quat

QUERY = {"voxel_m": "0.2", "image_scale": "1", "sky_size": "32"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    return street.write_raw(tmp_path_factory.mktemp("kitti") / "2011_09_26")


@pytest.fixture(scope="module")
def scene(drive):
    return open_kitti(str(drive), QUERY)


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> Path:
    return street.write_object(tmp_path_factory.mktemp("object") / "training", numbers=(1, 2))


@pytest.fixture(scope="module")
def object_scene(objects):
    return open_kitti(str(objects), QUERY | {"frame": "000002"})


@pytest.fixture
def copy(drive, tmp_path) -> Path:
    return Path(shutil.copytree(drive.parent, tmp_path / "day")) / drive.name


def pixels(camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the scene's camera shows points [N, 3] of its world, and their depth."""
    local = points @ camera.camera_from_world[:3, :3].numpy().T
    local += camera.camera_from_world[:3, 3].numpy()
    scale = np.array([camera.fx, camera.fy]) / local[:, 2:]
    return local[:, :2] * scale + [camera.cx, camera.cy], local[:, 2]


def assert_projects_as(matrix: np.ndarray, scene, camera, returns: np.ndarray) -> None:
    """Every return of frame `scene.frames[0]` before the camera is where the files' own matrix,
    pixels from Velodyne [3, 4], has it."""
    frame = scene.frames[0]
    world = scene.lidar(frame.index).points_m - scene.world_origin_m
    shown, depth = pixels(frame.cameras[camera], world)
    expected = (
        np.column_stack([returns[:, :3].astype(np.float64), np.ones(len(returns))]) @ matrix.T
    )
    expected = expected[:, :2] / expected[:, 2:]
    off = np.linalg.norm(shown - expected, axis=1)[depth > 1]
    assert len(off) > 1000 and off.mean() < 1e-3, off.mean()


# A raw drive


def test_the_drive_is_described(scene, drive):
    assert scene.name == "2011_09_26_drive_0001_sync" and scene.problems == ()
    assert scene.source == format_uri("kitti", str(drive), QUERY)
    assert scene.camera_names == ("image_02", "image_03")
    assert [frame.index for frame in scene.frames] == [0, 1, 2]
    assert [f.timestamp_ns - street.START_NS for f in scene.frames] == [0, 100_000_001, 200_000_002]
    assert scene.frame(1).cameras["image_03"].timestamp_ns - street.START_NS == 103_000_001
    assert open_scene(str(drive) + "?sky_size=8&voxel_m=2").source.startswith("kitti:")


def test_the_world_is_the_gps_one_recentred(scene):
    origin = street.world_from_street()[:3, 3]
    np.testing.assert_allclose(scene.world_origin_m, origin, atol=2)
    assert (scene.world_origin_m % 1 == 0).all()
    for number, frame in enumerate(scene.frames):
        expected = street.world_from_street() @ street.street_from_velo(number)
        expected[:3, 3] -= scene.world_origin_m
        np.testing.assert_allclose(frame.world_from_ego.numpy(), expected, atol=2e-6)
    assert scene.ground_z_m + scene.world_origin_m[2] == pytest.approx(
        street.ALTITUDE + street.GROUND_Z, abs=0.03
    )


@pytest.mark.parametrize("number", ["02", "03"])
def test_cameras_project_as_the_files_matrices(scene, drive, number):
    returns = np.fromfile(drive / "velodyne_points/data/0000000000.bin", "<f4").reshape(-1, 4)
    assert_projects_as(street.pixels_from_velo(number), scene, f"image_{number}", returns)


@pytest.mark.parametrize("camera", ["image_02", "image_03"])
def test_the_drive_looks_like_its_images(scene, camera):
    # 21.9 and 22.2 dB when written, with voxels of 20 cm.
    assert psnr_of(scene, 1, camera) > 21


def test_the_moving_tracklet_is_the_only_actor(scene):
    (actor,) = scene.actors
    assert (actor.track_id, actor.label) == ("0", "Car")
    assert actor.size_m == pytest.approx(tuple(street.CAR_SIZE_M))
    world = street.world_from_street()
    for number, frame in enumerate(scene.frames):
        pose = actor.track.pose_at(frame.timestamp_ns).numpy()
        centre = world[:3, :3] @ street.car_centre(number) + world[:3, 3] - scene.world_origin_m
        np.testing.assert_allclose(pose[:3, 3], centre, atol=1e-5)
        np.testing.assert_allclose(pose[:3, :3], street.turn(2, street.YAW), atol=1e-7)
    reds = (actor.gaussians.sh[:, 0] * 0.2820948 + 0.5).median(0).values
    np.testing.assert_allclose(reds, street.CAR / 255, atol=0.03)
    # Nothing of it is left in the background: no red.
    colours = scene.background.sh[:, 0].numpy() * 0.2820948 + 0.5
    assert not ((colours[:, 0] > 0.6) & (colours[:, 1] < 0.3)).any()


def test_tracklets_pass_through_as_boxes(scene):
    boxes = scene.boxes(1)
    assert boxes.track_ids == ("0", "1") and boxes.labels == ("Car", "Car")
    assert len(scene.boxes(0)) == 1 and len(scene.boxes(7)) == 0
    velo = (street.world_from_street() @ street.street_from_velo(1)) @ [9, -4, -1.7 + 0.75, 1]
    np.testing.assert_allclose(boxes.centers_m[1], velo[:3], atol=2e-6)
    np.testing.assert_allclose(boxes.sizes_m, [street.CAR_SIZE_M] * 2)
    turned = rotmat_from_quat(torch.from_numpy(boxes.quats[0])).numpy()
    np.testing.assert_allclose(turned, street.turn(2, street.YAW), atol=1e-7)
    said = {name: column[0] for name, column in boxes.attributes.items()}
    assert (said["state"], said["occlusion"], said["amt_occlusion_kf"]) == (2, 1, -1)
    assert said["amt_border_l"] == 0.5 and math.isnan(said["amt_border_kf"])


def test_sweeps_pass_through_in_the_datasets_world(scene):
    sweep = scene.lidar(2)
    expected = street.points_at(2) @ street.world_from_street()[:3, :3].T
    expected += street.world_from_street()[:3, 3]
    np.testing.assert_allclose(sweep.points_m, expected, atol=1e-5)  # float32 in the file
    assert set(sweep.columns) == {"x", "y", "z", "intensity", "timestamp_ns"}
    assert sweep.columns["x"].dtype == np.float64
    assert sweep.columns["intensity"][-1] == np.float32(0.99)
    assert (sweep.columns["timestamp_ns"] == scene.frame(2).timestamp_ns).all()
    assert scene.lidar(9) is None


def test_labels_alone_are_the_scenes_and_survive_pickling(scene, drive):
    for labels in (kitti_labels(str(drive), QUERY), pickle.loads(pickle.dumps(scene.labels))):
        np.testing.assert_array_equal(labels.lidar(1).points_m, scene.lidar(1).points_m)
        np.testing.assert_array_equal(labels.boxes(1).centers_m, scene.boxes(1).centers_m)


def test_opening_twice_gives_the_same_bits(drive):
    query = QUERY | {"poses": "icp", "voxel_m": "0.4", "frames": "0:2"}
    assert_same_bits(open_kitti(str(drive), query), open_kitti(str(drive), query))


def test_held_out_frames_leave_no_trace(copy):
    query = QUERY | {"held_out": "1::2", "voxel_m": "0.4"}
    held = open_kitti(str(copy), query)
    for path in copy.glob("image_*/data/0000000001.png"):
        cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8))
    roof = np.array([[5.0, 0, 2, 0], [5.1, 0, 2, 0]] * 500, "<f4")
    (copy / "velodyne_points/data/0000000001.bin").write_bytes(roof.tobytes())
    assert_same_bits(held, open_kitti(str(copy), query))
    assert len(held.frames) == 3 and set(held.frame(1).image_paths) == {"image_02", "image_03"}


def test_single_frames_are_left_out_or_gone_on_without(copy):
    sweeps, left, right = (
        copy / f"{name}/data" for name in ("velodyne_points", "image_02", "image_03")
    )
    (copy / "oxts/data/0000000002.txt").write_text("49 8 112 0 0 nan" + " 0" * 24)
    data = (sweeps / "0000000001.bin").read_bytes()
    (sweeps / "0000000001.bin").write_bytes(data[:-5])
    (left / "0000000000.png").unlink()
    (right / "0000000000.png").write_bytes((right / "0000000000.png").read_bytes()[:-40])
    cv2.imwrite(str(right / "0000000001.png"), np.zeros((70, 160, 3), np.uint8))
    bad = np.fromfile(sweeps / "0000000000.bin", "<f4").reshape(-1, 4)
    bad[5:8, 1] = [np.nan, np.inf, -np.inf]
    bad.tofile(sweeps / "0000000000.bin")
    (right / "0000000002.png").unlink()  # of a frame that is left out
    with pytest.raises(AdapterError, match=r"camera image_03: none of its images.*cut short"):
        shutil.copytree(copy.parent, copy.parent.parent / "again")
        again = copy.parent.parent / "again" / copy.name
        (again / "image_03/data/0000000001.png").unlink()
        open_kitti(str(again), QUERY)
    cv2.imwrite(str(right / "0000000000.png"), np.zeros((street.HEIGHT, 160, 3), np.uint8))
    scene = open_kitti(str(copy), QUERY)
    text = "\n".join(scene.problems)
    assert "frame 2 has no pose" in text and "0000000002.txt holds NaN" in text
    assert "left out 1 frame (2): no pose is known" in text
    assert "frame 1" in text and "0000000001.bin must be returns of 16 bytes" in text
    assert "camera image_02: 1 frame (0) without an image" in text
    assert "0000000001.png is 160x70 pixels, not 160x72; left out" in text
    assert "frame 0: left out 3 returns that are not finite" in text
    assert len(scene.problems) == 6
    assert [frame.index for frame in scene.frames] == [0, 1]
    assert scene.lidar(1) is None and len(scene.lidar(0)) == len(bad)
    assert set(scene.frame(0).image_paths) == {"image_03"}
    assert set(scene.frame(1).cameras) == {"image_02", "image_03"}


def test_all_images_of_another_size_are_an_error(copy):
    for path in (copy / "image_02/data").iterdir():
        cv2.imwrite(str(path), np.zeros((36, 80, 3), np.uint8))
    with pytest.raises(AdapterError, match=r"0000000000\.png is 80x36 pixels.*S_rect says 160x72"):
        open_kitti(str(copy), QUERY)


def test_no_usable_sweep_is_an_error(copy):
    for path in (copy / "velodyne_points/data").iterdir():
        path.write_bytes(b"")
    with pytest.raises(AdapterError, match=r"there are no returns in 3 frames.*has 0 bytes"):
        open_kitti(str(copy), QUERY)


def test_grey_cameras_serve_where_there_are_no_others(tmp_path):
    day = tmp_path / "day"
    drive = street.write_raw(day, frames=2, cameras=("00",))
    (drive / "image_02/data").mkdir(parents=True)
    scene = open_kitti(str(drive), QUERY)
    assert scene.camera_names == ("image_00",)


# One frame of the object benchmark


def test_an_object_frame_is_described(object_scene, objects):
    assert object_scene.name == "000002" and object_scene.camera_names == ("image_2",)
    assert [frame.index for frame in object_scene.frames] == [2] and object_scene.actors == ()
    assert torch.equal(object_scene.frame(2).world_from_ego, torch.eye(4, dtype=torch.float64))
    (problem,) = object_scene.problems
    assert "000002.txt: 1 regions marked DontCare have no 3D box" in problem
    height = street.GROUND_Z - street.STREET_FROM_OBJECT[2, 3]
    assert object_scene.ground_z_m == pytest.approx(height, abs=0.03)
    parent = kitti_labels(str(objects.parent), {"frame": "2"})
    assert len(parent.boxes(2)) == 2 and len(parent.boxes(1)) == 0


def test_an_object_frame_looks_like_its_image_and_projects_as_its_matrices(object_scene, objects):
    frame = object_scene.frame(2)
    recorded = cv2.imread(frame.image_paths["image_2"])[..., ::-1] / 255
    # 23.1 dB when written.
    assert psnr(render(object_scene, frame.cameras["image_2"]), recorded) > 22
    returns = np.fromfile(objects / "velodyne/000002.bin", "<f4").reshape(-1, 4)
    assert_projects_as(street.OBJECT_FROM_VELO, object_scene, "image_2", returns)


def test_object_labels_are_boxes_in_the_velodynes_frame(object_scene):
    boxes = object_scene.boxes(2)
    assert boxes.track_ids == ("0", "2") and boxes.labels == ("Car", "Van")
    centre = street.car_centre(2) - street.STREET_FROM_OBJECT[:3, 3]
    np.testing.assert_allclose(boxes.centers_m[0], centre, atol=1e-9)
    np.testing.assert_allclose(boxes.sizes_m, [street.CAR_SIZE_M, [5.0, 1.9, 2.0]])
    turns = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
    np.testing.assert_allclose(turns[0], np.eye(3), atol=1e-7)
    # rotation_y turns the front from the camera's right towards the camera.
    np.testing.assert_allclose(turns[1, :, 0], [-np.sin(0.4), -np.cos(0.4), 0], atol=1e-7)
    said = {name: tuple(column) for name, column in boxes.attributes.items()}
    assert said == {
        "truncated": (0.1, 0.0),
        "occluded": (1, 2),
        "alpha": (-1.58, 0.3),
        "bbox_left": (40.5, 1),
        "bbox_top": (20.25, 2),
        "bbox_right": (80.75, 3),
        "bbox_bottom": (60, 4),
    }


# Real frames


@pytest.fixture(scope="module")
def real_root(shared_dir):
    root = shared_dir / "data"
    if not (root / "kitti_raw_seq").is_dir():
        pytest.skip(f"no KITTI frames at {root}")
    return root


FAST = {"voxel_m": "0.2", "image_scale": "0.25", "sky_size": "64"}


def real_matrix(lines: dict[str, np.ndarray], projection: str, rectify: str, velo: np.ndarray):
    rotation = street.rigid(lines[rectify].reshape(3, 3), [0, 0, 0])
    return lines[projection].reshape(3, 4) @ rotation @ velo


def keyed(path: Path) -> dict[str, np.ndarray]:
    lines = [line.partition(":") for line in path.read_text().splitlines() if line]
    return {key: np.array(words.split(), float) for key, _, words in lines if key != "calib_time"}


def test_a_real_object_frame(real_root):
    root = real_root / "kitti_object"
    scene = open_kitti(str(root), FAST | {"frame": "1"})
    lines = keyed(root / "calib/000001.txt")
    velo = np.vstack([lines["Tr_velo_to_cam"].reshape(3, 4), [0, 0, 0, 1]])
    returns = np.fromfile(root / "velodyne/000001.bin", "<f4").reshape(-1, 4)
    matrix = real_matrix(lines, "P2", "R0_rect", velo)
    assert_projects_as(matrix, scene, "image_2", returns)
    assert scene.boxes(1).labels == ("Truck", "Car", "Cyclist")
    assert scene.ground_z_m == pytest.approx(-1.73, abs=0.15)
    # Each box's middle is inside the rectangle that the file has for it in the image.
    shown, _ = pixels(scene.frame(1).cameras["image_2"], scene.boxes(1).centers_m)
    sides = scene.boxes(1).attributes
    assert ((shown[:, 0] > sides["bbox_left"]) & (shown[:, 0] < sides["bbox_right"])).all()
    assert ((shown[:, 1] > sides["bbox_top"]) & (shown[:, 1] < sides["bbox_bottom"])).all()


def test_a_real_drive_by_registration(real_root):
    root = real_root / "kitti_raw_seq/2011_09_26"
    scene = open_kitti(str(root), FAST | {"poses": "icp", "frames": "0:3", "sky_size": "256"})
    assert "mean fitness 0.7" in " ".join(scene.problems)
    lines = keyed(root / "calib_cam_to_cam.txt")
    velo = keyed(root / "calib_velo_to_cam.txt")
    transform = street.rigid(velo["R"].reshape(3, 3), velo["T"])
    returns = np.fromfile(root / "velodyne_points/data/0000000000.bin", "<f4").reshape(-1, 4)
    matrix = real_matrix(lines, "P_rect_02", "R_rect_00", transform)
    assert_projects_as(matrix, scene, "image_02", returns)
    step = scene.frame(1).world_from_ego[:3, 3].numpy()
    # About 0.22 m a frame ahead; the road is under the sensor at 1.73 m.
    assert 0.15 < step[0] < 0.3 and np.abs(step[1:]).max() < 0.03
    assert scene.ground_z_m == pytest.approx(-1.73, abs=0.1)
    camera = scene.frame(1).cameras["image_02"].resized(310, 94)
    recorded = cv2.imread(scene.frame(1).image_paths["image_02"])
    recorded = cv2.resize(recorded, (310, 94), interpolation=cv2.INTER_AREA)[..., ::-1] / 255
    # 18.2 dB when written, at voxels of 20 cm; the default of 4 cm gives 22.
    assert psnr(render(scene, camera), recorded) > 17
