"""A drive in Street Gaussians' layout: cameras, images, labels, and a scene from it alone."""

from __future__ import annotations

import json
import pickle
import shutil
import struct

import cv2
import numpy as np
import pytest
import torch

from adapters.street_gaussians.adapter import StreetGaussiansLabels, labels_of, open_raw
from adapters.street_gaussians.data import ModelConfig, frames_of, held_out_steps, read_data
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.render.sh import SH_C0
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import LabelSource
from tests.adapters.street_gaussians_files import NAMES, ROAD_RGB, Facts, write_as_street_gaussians

FRONT = ModelConfig(cameras=(0, 1, 2))
ALL = ModelConfig(cameras=(0, 1, 2, 3, 4))
QUERY = {"voxel_m": "0.15", "image_scale": "1", "sky_size": "32"}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_as_street_gaussians(tmp_path_factory.mktemp("street"))


@pytest.fixture()
def own_street(street, tmp_path) -> Facts:
    """A copy whose files a test may change."""
    shutil.copytree(street.root, tmp_path / "own")
    return Facts(tmp_path / "own", street.numbers, street.cameras, street.size, street.objects)


def test_the_world_is_centred_on_the_mean_of_all_frames(street):
    data = read_data(street.root, ModelConfig(cameras=(0,), selected_frames=(1, 2)))
    np.testing.assert_allclose(data.world_origin_m, street.origin_m, atol=1e-9)
    for step, number in enumerate((1, 2)):
        pose = street.world_from_ego(number)
        pose[:3, 3] -= street.origin_m
        np.testing.assert_allclose(data.world_from_ego[step], pose, atol=1e-9)


def test_cameras_stand_where_the_car_was_at_their_own_time(street):
    frames = frames_of(read_data(street.root, ALL))
    assert [frame.index for frame in frames] == list(street.numbers)
    for frame in frames:
        assert frame.timestamp_ns == round(street.time_s(frame.index) * 1e9)
        assert list(frame.cameras) == list(NAMES)
        for cam, name in enumerate(NAMES):
            camera = frame.cameras[name]
            pose = street.world_from_ego(frame.index, cam) @ street.ego_from_camera(cam)
            pose[:3, 3] -= street.origin_m
            np.testing.assert_allclose(camera.world_from_camera.numpy(), pose, atol=1e-9)
            assert camera.timestamp_ns == round(street.time_s(frame.index, cam) * 1e9)
            assert (camera.width, camera.height) == street.image_size(cam)
            intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
            assert intrinsics == pytest.approx(street.intrinsics(cam))
            assert frame.image_paths[name] == str(street.image_path(frame.index, cam))


def test_points_fall_on_the_pixels_that_the_file_says(street):
    """The whole chain, from the vehicle's frame to an image taken later by a turned camera."""
    scene_frames = frames_of(read_data(street.root, ALL))
    labels = StreetGaussiansLabels(street.root)
    checked = 0
    for frame in scene_frames:
        sweep = labels.lidar(frame.index)
        for cam, name in enumerate(NAMES):
            own = sweep.columns["camera"] == cam
            camera = frame.cameras[name]
            transform = camera.camera_from_world.numpy()
            world = sweep.points_m[own] - street.origin_m
            local = world @ transform[:3, :3].T + transform[:3, 3]
            u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
            v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
            # Whole pixels in the file: floor, but for the last digits of the arithmetic.
            assert np.abs(u - 0.5 - sweep.columns["u"][own]).max() < 0.5 + 1e-6
            assert np.abs(v - 0.5 - sweep.columns["v"][own]).max() < 0.5 + 1e-6
            checked += int(own.sum())
    assert checked > 10_000


def test_the_images_number_counts_all_of_the_selection(street):
    data = read_data(street.root, ModelConfig(cameras=(2, 0), selected_frames=(1, 3)))
    assert [(i.frame, i.cam, i.number) for i in data.images] == [
        (1, 0, 0), (1, 2, 1), (2, 0, 2), (2, 2, 3), (3, 0, 4), (3, 2, 5),
    ]  # fmt: skip


def test_held_out_images_follow_the_split():
    for split_test, split_train, held_out in (
        (-1, -1, []), (4, -1, [4]), (1, -1, [1, 2, 3, 4, 5, 6]), (-1, 1, []),
        (-1, 3, [1, 2, 4, 5]), (2, 3, [2, 4, 6]),
    ):  # fmt: skip
        config = ModelConfig(split_test=split_test, split_train=split_train)
        assert sorted(held_out_steps(7, config)) == held_out


def test_the_split_counts_selected_frames_not_their_numbers(street):
    config = ModelConfig(cameras=(0,), selected_frames=(1, 3), split_test=2)
    images = read_data(street.root, config).images
    assert [(i.frame, i.is_held_out) for i in images] == [(1, False), (2, False), (3, True)]


def test_frames_need_not_begin_at_zero(tmp_path):
    facts = write_as_street_gaussians(tmp_path, first_frame=17, frames=3, images=False, lidar=False)
    data = read_data(facts.root, FRONT)
    assert data.frames == (17, 18, 19)
    assert {(i.frame, i.number) for i in data.images if i.cam == 0} == {(17, 0), (18, 3), (19, 6)}
    assert data.tracklets.ids.tolist() == [[1]] * 3  # the rider is in view too shortly


def test_without_images_the_sizes_are_waymos(tmp_path):
    facts = write_as_street_gaussians(tmp_path, images=False, lidar=False)
    data = read_data(facts.root, ALL)
    sizes = {(i.cam, i.camera.width, i.camera.height) for i in data.images}
    assert sizes == {(cam, 1920, 1280 if cam < 3 else 886) for cam in range(5)}
    (problem,) = data.problems
    assert "images" in problem and "5 cameras" in problem and "1920x886 for SIDE_LEFT" in problem
    assert all(not frame.image_paths for frame in frames_of(data))
    assert len(frames_of(data)) == 4


def test_images_that_are_missing_damaged_or_of_another_size(own_street):
    own_street.image_path(1, 0).unlink()
    data = read_data(own_street.root, FRONT)
    assert data.problems == ()
    frame = frames_of(data)[1]
    assert "FRONT" in frame.cameras and "FRONT" not in frame.image_paths
    other, damaged = own_street.image_path(0, 1), own_street.image_path(2, 0)
    cv2.imwrite(str(other), np.zeros((32, 48, 3), np.uint8))
    damaged.write_bytes(damaged.read_bytes()[:20])
    data = read_data(own_street.root, FRONT)
    first, second = data.problems
    assert str(damaged) in first and "damaged" in first
    assert str(other) in second and "48x32" in second and "96x64" in second
    assert "FRONT_LEFT" not in frames_of(data)[0].image_paths
    assert frames_of(data)[0].cameras["FRONT_LEFT"].width == 96


def test_images_that_cannot_be_the_cameras_are_an_error(own_street):
    for number in own_street.numbers:
        path = own_street.image_path(number, 0)
        head = path.read_bytes()
        path.write_bytes(head[:16] + struct.pack(">II", 40, 30) + head[24:])
    with pytest.raises(AdapterError, match=r"intrinsics/0\.txt: cx, cy .* 40x30 .* got 48\.75"):
        read_data(own_street.root, FRONT)
    shutil.copy(own_street.image_path(0, 0), own_street.root / "images" / "000000_0.jpg")
    with pytest.raises(AdapterError, match=r"000000_0\.jpg and .*000000_0\.png are one image"):
        read_data(own_street.root, FRONT)


def test_cameras_that_are_not_used_need_no_calibration(own_street):
    (own_street.root / "extrinsics/4.txt").unlink()
    (own_street.root / "intrinsics/4.txt").unlink()
    assert len(read_data(own_street.root, FRONT).images) == 12


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("intrinsics/0.txt", "900 900", r"intrinsics/0\.txt must begin with fx fy cx cy"),
        ("intrinsics/0.txt", "-1 900 48 32", r"intrinsics/0\.txt must begin with"),
        ("extrinsics/0.txt", "1 2 3", r"extrinsics/0\.txt must hold 4 x 4"),
        ("ego_pose/000001.txt", "nan " * 16, r"000001\.txt holds NaN"),
        ("ego_pose/000001_0.txt", "1 " * 16, r"000001_0\.txt must be a rotation"),
        ("timestamps.json", "[]", r"timestamps\.json must hold an object"),
        ("timestamps.json", "{}", r"timestamps\.json: .*FRAME: Field required"),
        ("timestamps.json", '{"FRAME": {"000000": "x"}}', "FRAME.000000: .*valid number"),
        ("timestamps.json", '{"FRAME": {"000000": NaN}}', "FRAME.000000: .*finite number"),
        ("timestamps.json", '{"FRAME": {"000000": 1.0}}', r"FRAME lacks frame 000001"),
    ],
)
def test_damaged_or_missing_calibration_is_named(own_street, name, text, message):
    (own_street.root / name).write_text(text)
    with pytest.raises(AdapterError, match=message):
        read_data(own_street.root, FRONT)
    if "_0" not in name and "0001" not in name:
        (own_street.root / name).unlink()
        with pytest.raises(AdapterError, match=rf"{name} does not exist"):
            read_data(own_street.root, FRONT)


def test_times_must_increase_and_be_there_for_every_image(own_street):
    path = own_street.root / "timestamps.json"
    times = json.loads(path.read_text())
    del times["FRONT_LEFT"]["000002"]
    path.write_text(json.dumps(times))
    with pytest.raises(AdapterError, match="FRONT_LEFT lacks frame 000002"):
        read_data(own_street.root, FRONT)
    times["FRAME"]["000002"] = 1.5e9
    path.write_text(json.dumps(times))
    with pytest.raises(AdapterError, match="must increase"):
        read_data(own_street.root, FRONT)


def test_frames_without_a_pose_are_left_out_and_nothing_shifts(own_street):
    (own_street.root / "ego_pose/000002.txt").unlink()
    data = read_data(own_street.root, FRONT)
    (problem,) = data.problems
    assert "lacks the poses of 1 of 4 frames" in problem and "000002" in problem
    assert [frame.index for frame in frames_of(data)] == [0, 1, 3]
    # The rows and numbers stay those of the model that was trained on all of them, and the middle
    # of the drive, had with a guess between its neighbours, stays within a millimetre.
    assert data.frames == (0, 1, 2, 3)
    assert data.tracklets.ids.tolist() == [[1, -1], [1, 4], [1, 4], [1, 4]]
    assert [i.number for i in data.images if i.cam == 0] == [0, 3, 9]
    np.testing.assert_allclose(data.world_origin_m, own_street.origin_m, atol=1e-3)
    guess, pose = data.world_from_ego[2], own_street.world_from_ego(2)
    np.testing.assert_allclose(guess[:3, :3], pose[:3, :3], atol=1e-6)
    (own_street.root / "ego_pose/000000.txt").unlink()  # and at the end
    data = read_data(own_street.root, FRONT)
    assert [frame.index for frame in frames_of(data)] == [1, 3]
    np.testing.assert_allclose(data.world_origin_m, own_street.origin_m, atol=1e-3)


def test_images_without_a_pose_are_left_out(own_street):
    (own_street.root / "ego_pose/000001_2.txt").unlink()
    data = read_data(own_street.root, FRONT)
    (problem,) = data.problems
    assert "1 images are left out" in problem and "000001_2.txt" in problem
    assert list(frames_of(data)[1].cameras) == ["FRONT", "FRONT_LEFT"]


def test_without_any_pose_there_is_no_scene(own_street):
    for path in (own_street.root / "ego_pose").glob("*_*.txt"):
        path.unlink()
    with pytest.raises(AdapterError, match=r"ego_pose lacks poses NNNNNN_0\.txt"):
        read_data(own_street.root, FRONT)
    for path in (own_street.root / "ego_pose").iterdir():
        path.unlink()
    with pytest.raises(AdapterError, match=r"ego_pose holds no pose"):
        read_data(own_street.root, FRONT)
    (own_street.root / "ego_pose").rmdir()
    with pytest.raises(AdapterError, match=r"ego_pose does not exist; expected a drive"):
        read_data(own_street.root, FRONT)
    with pytest.raises(AdapterError, match=r"nowhere is not a folder"):
        read_data(own_street.root / "nowhere", FRONT)


def test_a_selection_beyond_the_dataset(street):
    data = read_data(street.root, ModelConfig(cameras=(0,), selected_frames=(2, 90)))
    assert data.frames == (2, 3) and any("2 to 90" in problem for problem in data.problems)
    with pytest.raises(AdapterError, match=r"selected_frames are 50 to 90; .* has 0 to 3"):
        read_data(street.root, ModelConfig(cameras=(0,), selected_frames=(50, 90)))


def test_boxes_are_all_rows_of_the_frame_in_the_datasets_world(street):
    labels = labels_of(street.root)
    assert isinstance(labels, LabelSource)
    assert pickle.loads(pickle.dumps(labels)) == labels
    boxes = labels.boxes(2)
    assert boxes.track_ids == ("0", "1", "2", "3", "4", "6")
    assert boxes.labels[2] == "sign" and boxes.centers_m.dtype == np.float64
    for i, track_id in enumerate(map(int, boxes.track_ids)):
        pose = street.world_from_object(track_id, street.seconds(2))
        np.testing.assert_allclose(boxes.centers_m[i], pose[:3, 3], atol=1e-9)
        rotation = rotmat_from_quat(torch.from_numpy(boxes.quats[i])).numpy()
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-9)
        length, width, height = street.object(track_id).size_m
        np.testing.assert_allclose(boxes.sizes_m[i], (length + 0.2, width, height))
    np.testing.assert_allclose(boxes.attributes["alpha"], -10)
    np.testing.assert_allclose(boxes.attributes["speed"][[0, 1, 5]], (0, 12, 9.5))
    assert len(labels.boxes(0)) == 5 and len(labels.boxes(99)) == 0


def test_boxes_follow_a_file_that_changes(own_street):
    labels = StreetGaussiansLabels(own_street.root)
    assert len(labels.boxes(0)) == 5
    path = own_street.root / "track/track_info.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:3]))
    assert len(labels.boxes(0)) == 2
    path.unlink()
    assert len(labels.boxes(0)) == 0


def test_sweeps_are_in_the_datasets_world_at_the_frames_time(street):
    sweep = labels_of(street.root).lidar(3)
    pose = street.world_from_ego(3)
    expected = street.points[3] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(sweep.points_m, expected, atol=1e-9)
    assert sweep.columns["x"].dtype == np.float64
    assert set(sweep.columns) == {"x", "y", "z", "timestamp_ns", "camera", "u", "v"}
    assert set(sweep.columns["timestamp_ns"].tolist()) == {round(street.time_s(3) * 1e9)}
    for i, name in enumerate(("camera", "u", "v")):
        np.testing.assert_array_equal(sweep.columns[name], street.projections[3][:, i])


def test_frames_without_pose_or_points_have_no_labels(own_street):
    labels = labels_of(own_street.root)
    assert labels.lidar(44) is None
    (own_street.root / "ego_pose/000001.txt").unlink()
    assert labels.lidar(1) is None and len(labels.boxes(1)) == 0
    (own_street.root / "pointcloud.npz").unlink()
    assert labels.lidar(0) is None and len(labels.boxes(0)) == 5
    assert labels_of(own_street.root / "images") is None


@pytest.fixture(scope="module")
def raw_scene(street):
    return open_raw(street.root, QUERY)


def test_a_dataset_alone_is_a_scene_of_its_lidar(street, raw_scene):
    scene = raw_scene
    assert scene.source == format_uri("street_gaussians", street.root, QUERY)
    assert scene.problems == () and len(scene.frames) == 4
    np.testing.assert_allclose(scene.world_origin_m, street.origin_m, atol=1e-9)
    assert scene.ground_z_m == pytest.approx(0, abs=0.02)
    assert len(scene.frames[0].image_paths) == 5
    assert len(scene.boxes(0)) == 5 and len(scene.lidar(0)) == len(street.points[0])
    road = scene.background.means[:, 2].abs() < 0.1
    colour = (scene.background.sh[road, 0] * SH_C0 + 0.5).median(dim=0).values * 255
    np.testing.assert_allclose(colour.numpy(), ROAD_RGB, atol=8)


def test_labelled_objects_that_move_become_actors(street, raw_scene):
    assert {a.track_id for a in raw_scene.actors} == {"1", "4", "6"}
    for actor in raw_scene.actors:
        found = street.object(int(actor.track_id))
        assert actor.label == found.label
        for number in street.numbers:
            if not found.is_in(number):
                continue
            pose = street.world_from_object(found.track_id, street.seconds(number))
            pose[:3, 3] -= street.origin_m
            there = actor.track.pose_at(round(street.time_s(number) * 1e9))
            np.testing.assert_allclose(there.numpy(), pose, atol=1e-4)
        colour = (actor.gaussians.sh[:, 0] * SH_C0 + 0.5).median(dim=0).values * 255
        np.testing.assert_allclose(colour.numpy(), found.rgb, atol=12)
        half = np.array(found.size_m) / 2 + 0.2
        assert (np.abs(actor.gaussians.means.numpy()) < half).all()


def test_a_scene_of_some_frames(street):
    scene = open_raw(street.root, QUERY | {"frames": "1:4", "held_out": "2:3"})
    assert [frame.index for frame in scene.frames] == [1, 2, 3]
    with pytest.raises(AdapterError, match="unknown option 'data'"):
        open_raw(street.root, {"data": "x"})


def test_a_scene_needs_lidar_and_images(own_street):
    shutil.rmtree(own_street.root / "images")
    with pytest.raises(AdapterError, match=r"there is no usable image in 4 frames"):
        open_raw(own_street.root, QUERY)
    write_as_street_gaussians(own_street.root)
    (own_street.root / "pointcloud.npz").unlink()
    with pytest.raises(AdapterError, match=r"no LiDAR returns in 4 frames.*npz lacks 4 frames"):
        open_raw(own_street.root, QUERY)
    shutil.rmtree(own_street.root / "extrinsics")
    with pytest.raises(AdapterError, match=r"extrinsics holds no calibration"):
        open_raw(own_street.root, QUERY)
