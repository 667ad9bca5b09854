"""A PandaSet sequence as a scene: a street whose answer is known, and the real one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandaset_folder as street
import pytest
import torch
from scipy.spatial.transform import Rotation
from shown import assert_same_bits, psnr, psnr_of, render

from adapters.pandaset.adapter import open_pandaset
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.render.rasterize import rasterize

QUERY = {"voxel_m": "0.1", "image_scale": "1", "sky_size": "32"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return street.write_sequence(tmp_path_factory.mktemp("pandaset") / "002")


@pytest.fixture(scope="module")
def scene(folder):
    return open_pandaset(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "002"))


def test_the_scene_is_described(scene, folder):
    assert scene.name == "002" and scene.problems == ()
    assert scene.source == format_uri("pandaset", str(folder), QUERY)
    assert scene.camera_names == ("front_camera", "left_camera")
    assert [f.index for f in scene.frames] == [0, 1, 2]
    assert [f.timestamp_ns for f in scene.frames] == sorted(f.timestamp_ns for f in scene.frames)
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z, abs=1e-3)
    assert (scene.world_origin_m == 0).all()


def test_ego_is_x_forward_y_left_z_up(scene):
    for number, frame in enumerate(scene.frames):
        # The street's car drives along the world's x, left is y.
        np.testing.assert_allclose(frame.world_from_ego[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frame.world_from_ego[:3, 3], street.ego_position(number))


def test_cameras_have_their_own_pose_and_time(scene):
    left = scene.frame(2).cameras["left_camera"]
    assert (left.width, left.height, left.fx) == (street.WIDTH, street.HEIGHT, street.FOCAL_PX)
    assert abs(left.timestamp_ns - street.START_NS - 200_000_000) < 1000  # float64 seconds
    np.testing.assert_allclose(left.ray_directions()[48, 80], [0, 1, 0], atol=0.02)
    np.testing.assert_allclose(
        left.centre, street.ego_position(2) + np.array([0, 0, 1.1]), atol=1e-9
    )


@pytest.mark.parametrize("camera", ["front_camera", "left_camera"])
def test_the_scene_looks_like_the_recorded_image(scene, camera):
    # 26 dB when written; edges are as blurred as the voxels of 10 cm are wide.
    assert psnr_of(scene, 1, camera) > 24.5


def test_the_ground_is_closed_under_the_car_too(scene):
    camera = scene.frame(0).cameras["front_camera"]
    out = rasterize([next(iter(scene.parts_at(camera.timestamp_ns)))], camera)
    # Up to 20 m ahead and 5 m to the sides, also where the car hides it in every image.
    ground = out.alpha[street.HEIGHT // 2 + 6 :, 60:100]
    assert ground.min() > 0.8


def test_background_has_no_trace_of_the_moving_car(scene):
    means, half = scene.background.means.numpy(), street.CAR_SIZE_M / 2
    for frame in range(street.FRAMES):
        offset = np.abs(means - street.car_centre(street.FRAME_S * frame))
        above = means[:, 2] > street.GROUND_Z + 0.2
        assert not ((offset < half).all(axis=1) & above).any()


def test_the_two_boxes_of_the_car_are_one_actor(scene):
    (actor,) = scene.actors
    assert actor.track_id == street.CAR_IDS[0] and actor.label == "Car"
    assert actor.size_m == pytest.approx(tuple(street.CAR_SIZE_M))
    inside = np.abs(actor.gaussians.means.numpy()) <= street.CAR_SIZE_M / 2 + 0.1
    assert inside.all()
    reds = actor.gaussians.sh[:, 0] * 0.2820948 + 0.5
    np.testing.assert_allclose(reds.median(0).values, street.CAR / 255, atol=0.03)


def test_the_actor_is_where_the_car_is(scene):
    (actor,) = scene.actors
    for time in (0.0, 0.05, 0.13):
        pose = actor.track.pose_at(street.START_NS + round(time * 1e9))
        # The boxes' own times are known to within the sweep's half width of 10 ms: 6 cm.
        np.testing.assert_allclose(pose[:3, 3], street.car_centre(time), atol=0.07)
        np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-9)


def test_the_sky_is_what_the_images_show_above(scene):
    up_ahead = torch.tensor([[1.0, -0.3, 0.3], [0.1, 1.0, 0.55], [0.0, 0.0, 1.0]])
    # The zenith is in no image: it is filled from the whole sky, wall tops at its rim included.
    for sampled, tolerance in zip(scene.sky.sample(up_ahead), (0.02, 0.02, 0.1), strict=True):
        np.testing.assert_allclose(sampled, street.SKY / 255, atol=tolerance)


def test_opening_twice_gives_the_same_bits(scene, folder):
    assert_same_bits(scene, open_pandaset(str(folder), QUERY))


def test_held_out_frames_leave_no_trace_in_the_gaussians(scene, copy):
    query = QUERY | {"held_out": "1::2"}
    held = open_pandaset(str(copy), query)
    # All of frame 1 changes: its images are black, and its LiDAR sees a roof over the street.
    for path in copy.glob("camera/*/01.jpg"):
        cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8))
    points, classes, times, sensor = street._sweep(1)
    roof = np.concatenate([points, points + np.array([0, 0, 6.0])])
    columns = {c: roof[:, i] for i, c in enumerate("xyz")} | {"i": np.zeros(len(roof))}
    columns |= {"t": np.tile(times, 2), "d": np.tile(sensor, 2)}
    street.write_table(copy / "lidar/01.pkl.gz", columns)
    street.write_table(copy / "annotations/semseg/01.pkl.gz", {"class": np.tile(classes, 2)})
    assert_same_bits(held, open_pandaset(str(copy), query))
    # The frame itself stays, as do its boxes: the track is that of the whole drive.
    assert len(held.frames) == 3 and len(held.boxes(1)) == 2
    assert set(held.frame(1).image_paths) == {"front_camera", "left_camera"}
    assert torch.equal(
        held.actors[0].track.world_from_actor, scene.actors[0].track.world_from_actor
    )
    assert held.source.endswith("held_out=1::2") and held.problems == ()
    with pytest.raises(AdapterError, match="holds out all 3 frames"):
        open_pandaset(str(copy), QUERY | {"held_out": "0::"})


def test_a_world_far_from_its_origin_is_recentred(scene, tmp_path):
    offset = np.array([545_000.25, 4_183_000.5, 12.0])
    moved = open_pandaset(str(street.write_sequence(tmp_path / "utm", offset_m=offset)), QUERY)
    np.testing.assert_array_equal(moved.world_origin_m, np.round(offset))
    shift = offset - np.round(offset)
    ego = moved.frame(2).world_from_ego[:3, 3].numpy()
    np.testing.assert_allclose(ego, street.ego_position(2) + shift, atol=1e-6)
    here, there = scene.background.means.numpy(), moved.background.means.numpy()
    # The voxel grid sits elsewhere on the points, by less than a voxel.
    np.testing.assert_allclose(there.min(0), here.min(0) + shift, atol=0.15)
    np.testing.assert_allclose(there.max(0), here.max(0) + shift, atol=0.15)
    assert moved.ground_z_m == pytest.approx(street.GROUND_Z, abs=1e-3)
    # Labels stay in the dataset's world.
    box = moved.boxes(0).centers_m[0]
    np.testing.assert_allclose(box, street.car_centre(0) + offset, atol=1e-6)


def test_frames_are_limited_and_max_gaussians_respected(folder):
    scene = open_pandaset(str(folder), {**QUERY, "frames": "1:2", "max_gaussians": "3000"})
    assert [f.index for f in scene.frames] == [1]
    total = len(scene.background) + sum(len(a.gaussians) for a in scene.actors)
    assert 1500 < total <= 3000


def test_missing_files_of_single_frames_are_problems(copy):
    (copy / "lidar/01.pkl.gz").unlink()
    (copy / "annotations/cuboids/02.pkl.gz").unlink()
    (copy / "camera/front_camera/00.jpg").unlink()
    left = copy / "camera/left_camera/01.jpg"
    left.write_bytes(left.read_bytes()[:-200])
    scene = open_pandaset(str(copy), QUERY)
    text = " ".join(scene.problems)
    assert len(scene.problems) == 4
    assert "frame 1: lidar/01.pkl.gz is missing" in text
    assert "frame 2: annotations/cuboids/02.pkl.gz is missing" in text
    assert "camera front_camera, frame 0" in text and "00.jpg does not exist" in text
    assert "camera left_camera, frame 1" in text and "01.jpg is cut short" in text
    assert scene.lidar(1) is None and len(scene.boxes(2)) == 0
    assert set(scene.frame(1).image_paths) == {"front_camera"}
    assert set(scene.frame(1).cameras) == {"front_camera", "left_camera"}


def test_images_that_do_not_decode_or_fit_are_problems(copy):
    broken = copy / "camera/left_camera/02.jpg"
    broken.write_bytes(b"\xff\xd8 nothing of a picture \xff\xd9")
    cv2.imwrite(str(copy / "camera/left_camera/01.jpg"), np.zeros((48, 80, 3), np.uint8))
    scene = open_pandaset(str(copy), QUERY)
    text = " ".join(scene.problems)
    assert "02.jpg cannot be decoded" in text and "01.jpg is not of 160x96 pixels" in text
    assert set(scene.frame(2).image_paths) == {"front_camera"}


def test_no_lidar_at_all_is_an_error(copy):
    for path in (copy / "lidar").glob("*.pkl.gz"):
        path.unlink()
    with pytest.raises(AdapterError, match="holds no returns for frames 0 to 2"):
        open_pandaset(str(copy), QUERY)


@pytest.fixture(scope="module")
def real(shared_dir):
    root = shared_dir / "data" / "pandaset_mini" / "002"
    if not root.is_dir():
        pytest.skip(f"no PandaSet sequence at {root}")
    query = {"frames": "10:12", "voxel_m": "0.15", "image_scale": "0.25", "sky_size": "128"}
    return open_pandaset(str(root), query)


def test_the_real_sequence_looks_like_its_images(real):
    values = {}
    for name, full in real.frame(11).cameras.items():
        camera = full.scaled(0.125)
        recorded = cv2.imread(real.frame(11).image_paths[name], cv2.IMREAD_REDUCED_COLOR_8)
        rows = round(0.745 * camera.height) if name == "back_camera" else camera.height
        image = render(real, camera)[:rows]
        values[name] = psnr(image, recorded[:rows, :, ::-1] / 255)
    # 22.0 on average when written, from two sweeps at voxels of 15 cm.
    assert np.mean(list(values.values())) > 20.5, values


def test_real_returns_fall_on_the_pixels_that_the_sources_own_matrices_say(real):
    """Poses and intrinsics as the files have them, projected here without the adapter."""
    root = Path(real.frame(10).image_paths["front_camera"]).parents[2]
    differences = []
    for frame in real.frames:
        points = real.lidar(frame.index).points_m[::50]
        for name, camera in frame.cameras.items():
            pose = json.loads((root / "camera" / name / "poses.json").read_text())[frame.index]
            K = json.loads((root / "camera" / name / "intrinsics.json").read_text())
            quat = [pose["heading"][axis] for axis in "xyzw"]
            position = np.array([pose["position"][axis] for axis in "xyz"])
            seen = (points - position) @ Rotation.from_quat(quat).as_matrix()
            ahead = seen[:, 2] > 1
            u = K["fx"] * seen[ahead, 0] / seen[ahead, 2] + K["cx"]
            v = K["fy"] * seen[ahead, 1] / seen[ahead, 2] + K["cy"]
            own = points[ahead] - real.world_origin_m
            ours = own @ camera.camera_from_world.numpy()[:3, :3].T
            ours = ours + camera.camera_from_world.numpy()[:3, 3]
            du = camera.fx * ours[:, 0] / ours[:, 2] + camera.cx - u
            dv = camera.fy * ours[:, 1] / ours[:, 2] + camera.cy - v
            inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            differences.append(np.hypot(du, dv)[inside])
    differences = np.concatenate(differences)
    assert len(differences) > 5_000
    assert differences.mean() < 1e-6  # px; 0.1 is asked for
