"""A recording's folder as a scene: a street whose answer is known, with LiDAR, with depth images,
and with neither."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandaset_folder as street
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import recording_folder as recording
import torch
from recording_folder import QUERY, write_recording
from shown import assert_same_bits, psnr_of, render

from adapters.base import open_scene, recognise
from adapters.recording.adapter import open_recording
from adapters.recording.files import read_calibration
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.jobs.render_job import RenderJob, run_job
from augment.semantics import SemanticClass
from recipes.load import load_recipe
from tests.streets import LABELLED_STREET, open_street


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_recording(tmp_path_factory.mktemp("recording") / "drive")


@pytest.fixture(scope="module")
def scene(folder):
    return open_recording(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "drive"))


def test_the_scene_is_described(scene, folder):
    assert scene.name == "drive" and scene.problems == ()
    assert scene.source == format_uri("recording", str(folder), QUERY)
    assert scene.camera_names == tuple(street.CAMERAS)
    assert [f.index for f in scene.frames] == [0, 1, 2]
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z, abs=1e-3)
    left = scene.frame(2).cameras["left_camera"]
    assert left.timestamp_ns == recording.time_ns(2) == scene.frame(2).timestamp_ns
    np.testing.assert_allclose(left.centre, street.ego_position(2) + np.array([0, 0, 1.1]))
    assert set(scene.frame(1).image_paths) == set(street.CAMERAS)


@pytest.mark.parametrize("camera", ["front_camera", "left_camera"])
def test_it_looks_like_the_recorded_image(scene, camera):
    # 26 dB when written; edges are as blurred as the voxels of 10 cm are wide.
    assert psnr_of(scene, 1, camera) > 24.5


def test_what_moves_is_an_actor_and_what_is_parked_is_not(scene):
    (actor,) = scene.actors
    assert (actor.track_id, actor.label) == ("car", "Car")
    pose = actor.track.pose_at(recording.time_ns(1))
    np.testing.assert_allclose(pose[:3, 3], street.car_centre(0.1), atol=1e-6)
    assert (actor.gaussians.semantic == SemanticClass.VEHICLE).all()
    offset = np.abs(scene.background.means.numpy() - street.car_centre(0.1))
    assert not (offset < street.CAR_SIZE_M / 2 - 0.1).all(axis=1).any()


def test_further_files_of_a_job_change_nothing(scene, copy):
    """Masks and numbers of a flood, as a job writes them."""
    shutil.copytree(copy / "images", copy / "water")
    shutil.copy(copy / "labels/boxes.parquet", copy / "labels/water.parquet")
    assert_same_bits(scene, open_recording(str(copy), QUERY))


def test_labels_pass_through(scene):
    boxes = scene.boxes(2)
    assert boxes.track_ids == ("car", "parked") and boxes.labels == ("Car", "Car")
    np.testing.assert_array_equal(boxes.centers_m[0], street.car_centre(0.2))
    np.testing.assert_array_equal(boxes.attributes["stationary"], [False, True])
    columns = recording.sweep_columns(1)
    sweep = pickle.loads(pickle.dumps(scene.labels)).lidar(1)
    assert list(sweep.columns) == list(columns)
    for name, column in columns.items():
        assert sweep.columns[name].dtype == column.dtype
        np.testing.assert_array_equal(sweep.columns[name], column)
    assert scene.lidar(7) is None and len(scene.boxes(7)) == 0


def test_held_out_frames_leave_no_trace_in_the_gaussians(copy):
    query = QUERY | {"held_out": "1:2"}
    held = open_recording(str(copy), query)
    for path in copy.glob("images/*/000001.png"):
        cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8))
    columns = recording.sweep_columns(1)
    recording.write_lidar(copy, 1, columns | {"z": columns["z"] + 3})
    assert_same_bits(held, open_recording(str(copy), query))
    assert len(held.frames) == 3 and held.frame(1).image_paths and len(held.boxes(1)) == 2


def test_a_world_far_from_its_origin_is_recentred(tmp_path):
    offset = np.array([545_000.25, 4_183_000.5, 12.0])
    moved = open_recording(str(write_recording(tmp_path / "utm", offset_m=offset)), QUERY)
    np.testing.assert_array_equal(moved.world_origin_m, np.round(offset))
    shift = offset - np.round(offset)
    ego = moved.frame(2).world_from_ego[:3, 3].numpy()
    np.testing.assert_allclose(ego, street.ego_position(2) + shift, atol=1e-6)
    centre = moved.frame(2).cameras["left_camera"].centre.numpy()
    expected = street.ego_position(2) + np.array([0, 0, 1.1]) + shift
    np.testing.assert_allclose(centre, expected, atol=1e-6)
    # The boxes stay in the recording's world; its actors are in the scene's.
    np.testing.assert_array_equal(moved.boxes(0).centers_m[0], street.car_centre(0) + offset)
    pose = moved.actors[0].track.pose_at(recording.time_ns(0))
    np.testing.assert_allclose(pose[:3, 3], street.car_centre(0) + shift, atol=1e-6)
    assert psnr_of(moved, 1, "front_camera") > 24.5


def test_what_a_job_wrote_is_a_recording(tmp_path):
    source = open_street(LABELLED_STREET)
    job = RenderJob(LABELLED_STREET, [load_recipe("clear").resolve(0)], tmp_path / "raw")
    assert run_job(job, scene_loader=lambda _: source).failed == 0
    folder = tmp_path / "raw" / source.name / "clear-000"
    assert recognise(folder) == "recording"
    with pytest.raises(AdapterError, match=r"It holds scenes: give one, such as .*clear-000"):
        recognise(tmp_path / "raw")
    scene = open_scene(f"{folder}?image_scale=1&sky_size=32&voxel_m=0.3")
    assert scene.problems == () and scene.name == f"{source.name}-clear-000"
    assert scene.source.startswith("recording:")
    for frame in source.frames:
        again = scene.frame(frame.index)
        assert again.timestamp_ns == frame.timestamp_ns
        np.testing.assert_array_equal(again.world_from_ego, frame.world_from_ego)
        for name, camera in frame.cameras.items():
            assert again.cameras[name].timestamp_ns == camera.timestamp_ns
            np.testing.assert_allclose(
                again.cameras[name].camera_from_world, camera.camera_from_world, atol=1e-12
            )
        boxes, sweep = source.boxes(frame.index), source.lidar(frame.index)
        np.testing.assert_array_equal(scene.boxes(frame.index).centers_m, boxes.centers_m)
        assert scene.boxes(frame.index).track_ids == boxes.track_ids
        for name, column in sweep.columns.items():
            np.testing.assert_array_equal(scene.lidar(frame.index).columns[name], column)
    assert {a.track_id for a in scene.actors} <= {a.track_id for a in source.actors}
    assert scene.ground_z_m == pytest.approx(source.ground_z_m, abs=0.03)


def test_without_lidar_depth_images_are_the_start(tmp_path):
    folder = write_recording(tmp_path / "drive", lidar=False, depth=True)
    scene = open_recording(str(folder), QUERY)
    (problem,) = scene.problems
    assert "lidar holds no returns: the scene starts from the points of 6 depth images" in problem
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z, abs=0.02)
    (actor,) = scene.actors
    assert actor.track_id == "car"
    # The wall is 8 m away: single pixels are 10 cm on it, no coarser than with LiDAR.
    assert psnr_of(scene, 1, "left_camera") > 24.5 and psnr_of(scene, 1, "front_camera") > 22


def test_damaged_depth_images_are_problems(tmp_path):
    folder = write_recording(tmp_path / "drive", lidar=False, depth=True, frames=2)
    cv2.imwrite(str(folder / "depth/left_camera/000000.png"), np.ones((4, 6), np.uint16))
    (folder / "depth/left_camera/000001.png").write_bytes(b"nothing")
    problems = open_recording(str(folder), QUERY).problems
    assert "camera left_camera, frame 0: depth" in problems[0] and "it is 6x4 pixels" in problems[0]
    assert "not a complete PNG" in problems[1] and "2 depth images" in problems[2]


def test_with_neither_the_scene_is_guessed_and_says_so(tmp_path):
    folder = write_recording(tmp_path / "drive", lidar=False)
    scene = open_recording(str(folder), QUERY)
    (problem,) = scene.problems
    assert "starts from a flat ground 0.4 m below the ego origin, the labelled boxes" in problem
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z)
    assert 20_000 < len(scene.background) <= 60_000
    means = scene.background.means.numpy()
    assert means[:, 2].min() > street.GROUND_Z - 0.05
    # Nothing stands where the car drives.
    ahead = (np.abs(means[:, 1]) < 1) & (means[:, 0] > -1) & (means[:, 0] < 2)
    assert means[ahead, 2].max() < street.GROUND_Z + 0.05
    (actor,) = scene.actors
    extent = np.abs(actor.gaussians.means.numpy()).max(axis=0)
    np.testing.assert_allclose(extent, street.CAR_SIZE_M / 2, atol=0.1)
    reds = actor.gaussians.sh[:, 0] * 0.2820948 + 0.5
    np.testing.assert_allclose(reds.median(0).values, street.CAR / 255, atol=0.1)
    assert_same_bits(scene, open_recording(str(folder), QUERY))


def test_guesses_respect_max_gaussians_and_held_out_images(tmp_path):
    folder = write_recording(tmp_path / "drive", lidar=False)
    query = QUERY | {"max_gaussians": "6000", "held_out": "1:"}
    held = open_recording(str(folder), query)
    assert len(held.background) + sum(len(a.gaussians) for a in held.actors) <= 6000
    for path in folder.glob("images/*/00000[12].png"):
        cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8))
    assert_same_bits(held, open_recording(str(folder), query))


def test_ground_above_the_cameras_is_an_error(tmp_path):
    folder = write_recording(tmp_path / "drive", lidar=False)
    recording.edit_calibration(folder, lambda c: c.update(ego_above_ground_m=-1.5))
    message = r"frame 0, camera 'front_camera': it is -0.40 m above .* give ego_above_ground_m"
    with pytest.raises(AdapterError, match=message):
        open_recording(str(folder), QUERY)


@pytest.mark.parametrize("count", [0, 30])
def test_a_handful_of_returns_is_no_lidar(copy, count):
    for frame in range(3):
        few = {k: v[:count] for k, v in recording.sweep_columns(frame).items()}
        recording.write_lidar(copy, frame, few)
    (problem,) = open_recording(str(copy), QUERY).problems
    assert f"lidar holds {3 * count or 'no'} returns and" in problem


def test_points_that_no_image_shows_are_an_error(copy):
    def turn_up(content):
        for frame in content["frames"]:
            for camera in frame["cameras"].values():
                pose = np.array(camera["world_from_camera"])
                pose[:3, :3] = np.eye(3)  # the camera's forward is the world's up
                camera["world_from_camera"] = pose.tolist()

    recording.edit_calibration(copy, turn_up)
    with pytest.raises(AdapterError, match="none of the points that were measured is in any image"):
        open_recording(str(copy), QUERY)


def test_images_of_held_out_frames_alone_are_not_enough(copy):
    for path in copy.glob("images/*/00000[02].png"):
        path.unlink()
    with pytest.raises(AdapterError, match="no usable image of the frames that are not held out"):
        open_recording(str(copy), QUERY | {"held_out": "1:2"})


@pytest.mark.parametrize("lidar", [True, False])
def test_one_camera_and_one_frame_are_enough(tmp_path, lidar):
    folder = write_recording(
        tmp_path / "drive", lidar=lidar, boxes=False, frames=1, cameras=("front_camera",)
    )
    scene = open_recording(str(folder), QUERY)
    assert len(scene.problems) == (0 if lidar else 1) and scene.actors == ()
    assert len(scene.frames) == 1 and scene.camera_names == ("front_camera",)
    assert np.isfinite(render(scene, scene.frames[0].cameras["front_camera"])).all()


def test_a_track_of_one_box_is_an_actor_for_a_moment(copy):
    columns = recording.box_columns(1)
    recording.write_boxes(copy, columns)
    scene = open_recording(str(copy), QUERY)
    (actor,) = scene.actors
    assert len(actor.track.timestamps_ns) == 1 and scene.problems == ()
    assert actor.track.pose_at(recording.time_ns(0)) is not None
    assert actor.track.pose_at(recording.time_ns(2)) is None


def test_a_box_without_points_is_said(copy):
    columns = recording.box_columns(3)
    columns["center_y_m"] = [y - 40 if name == "car" else y for y, name in zip(
        columns["center_y_m"], columns["track_id"], strict=True
    )]  # fmt: skip
    recording.write_boxes(copy, columns)
    scene = open_recording(str(copy), QUERY)
    assert scene.actors == () and len(scene.boxes(0)) == 2
    (problem,) = scene.problems
    assert problem.startswith("1 moving objects, such as 'car', have too few points")


def test_the_example_in_the_docs_is_a_recording(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()
    section = text.split("## `recording:PATH`")[1].split("\n## ")[0]
    calibration, program = (
        section.split(f"```{kind}\n")[1].split("```")[0] for kind in ("json", "python")
    )
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs/scenes.md", "exec"), {})
    scene = open_scene("my-drive?image_scale=1&sky_size=16&voxel_m=0.2")
    assert scene.problems == () and scene.name == "my-drive" and len(scene.boxes(0)) == 1
    assert len(scene.background) > 1000 and scene.ground_z_m == pytest.approx(0, abs=1e-6)
    Path("my-drive/calibration.json").write_text(calibration)
    front = read_calibration(Path("my-drive")).frames[0].cameras["front"]
    assert (front.width, front.timestamp_ns) == (1920, 1700000000412000000)
    np.testing.assert_allclose(front.ray_directions()[540, 960], [1, 0, 0], atol=1e-3)


def in_blocks(root: Path) -> Path:
    """The same recording as a `generate` job lays it out: by blocks that share frame 1."""
    whole = json.loads((root / "calibration.json").read_text())
    boxes = pq.ParquetFile(root / "labels" / "boxes.parquet").read()
    (root / "calibration").mkdir()
    (root / "labels" / "boxes").mkdir()
    first, *others = street.CAMERAS
    later = {n: list(street.CAMERAS) for n in range(2, len(whole["frames"]))}
    write_block(root, 0, whole, boxes, {0: list(street.CAMERAS), 1: [first]})
    write_block(root, 1, whole, boxes, {1: others, **later})
    (root / "calibration.json").unlink()
    (root / "labels" / "boxes.parquet").unlink()
    return root


def write_block(root: Path, block: int, whole: dict, boxes: pa.Table, frames: dict) -> None:
    entries = [
        entry | {"cameras": {name: entry["cameras"][name] for name in frames[entry["frame"]]}}
        for entry in whole["frames"]
        if entry["frame"] in frames
    ]
    name = f"{min(frames):06d}-{block}"
    (root / f"calibration/{name}.json").write_text(json.dumps(whole | {"frames": entries}))
    shown = [number in frames for number in boxes["frame"].to_pylist()]
    pq.write_table(boxes.filter(pa.array(shown)), root / f"labels/boxes/{name}.parquet")


def test_a_generated_variant_opens_as_a_rendered_one_does(tmp_path):
    expected = open_recording(str(write_recording(tmp_path / "whole")), QUERY)
    root = in_blocks(write_recording(tmp_path / "blocks"))
    scene = open_recording(str(root), QUERY)
    assert recognise(root) == "recording"
    assert [f.cameras.keys() for f in scene.frames] == [f.cameras.keys() for f in expected.frames]
    assert torch.equal(scene.background.means, expected.background.means)
    for frame in expected.frames:
        boxes = scene.labels.boxes(frame.index)
        assert boxes.track_ids == expected.labels.boxes(frame.index).track_ids
