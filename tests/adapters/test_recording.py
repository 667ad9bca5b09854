"""A recording's folder as a scene: a street whose answer is known, with LiDAR, with depth images,
and with neither."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from adapters.base import detect_scheme_of_path, open_scene
from adapters.recording.adapter import (
    RecordingLabels,
    all_boxes,
    open_recording,
    read_lidar_drive,
    read_objects,
    read_sweep,
)
from adapters.recording.files import find_images, numbered_files, read_calibration, unlisted_images
from augment.errors import AdapterError
from augment.files.recorded_images import ImageFault, read_scaled
from augment.jobs.render_job import RenderJob, run_job
from augment.output.names import folder_name
from augment.output.tables import lidar_bytes
from augment.photo.sky_matte import recorded_sky_regions
from augment.scene.semantics import SemanticClass
from recipes.load import load_recipe
from tests.adapters import recording_files as recording
from tests.adapters import street
from tests.adapters.recording_files import QUERY, edit_calibration, write_as_recording
from tests.adapters.shown import assert_same_bits, psnr_of, render
from tests.exif import with_orientation
from tests.streets import LABELLED_STREET, open_street


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_as_recording(tmp_path_factory.mktemp("recording") / "drive")


@pytest.fixture(scope="module")
def scene(folder):
    return open_recording(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "drive"))


def test_labels_pass_through(scene):
    boxes = scene.boxes(2)
    assert (scene.actors[0].gaussians.semantic == SemanticClass.VEHICLE).all()
    np.testing.assert_array_equal(boxes.attributes["stationary"], [False, True])
    columns = recording.sweep_columns(1)
    sweep = pickle.loads(pickle.dumps(scene.labels)).lidar(1)
    assert list(sweep.columns) == list(columns)
    for name, column in columns.items():
        assert sweep.columns[name].dtype == column.dtype
        np.testing.assert_array_equal(sweep.columns[name], column)


def test_a_world_far_from_its_origin_is_recentred(tmp_path):
    offset = np.array([545_000.25, 4_183_000.5, 12.0])
    moved = open_recording(str(write_as_recording(tmp_path / "utm", offset_m=offset)), QUERY)
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
    assert detect_scheme_of_path(folder) == "recording"
    with pytest.raises(AdapterError, match=r"It holds scenes: give one, such as .*clear-000"):
        detect_scheme_of_path(tmp_path / "raw")
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
    folder = write_as_recording(tmp_path / "drive", lidar=False, depth=True)
    scene = open_recording(str(folder), QUERY)
    (problem,) = scene.problems
    assert "lidar holds no returns: the scene starts from the points of 6 depth images" in problem
    assert scene.ground_z_m == pytest.approx(street.GROUND_Z, abs=0.02)
    (actor,) = scene.actors
    assert actor.track_id == "car"
    # The wall is 8 m away: single pixels are 10 cm on it, no coarser than with LiDAR.
    assert psnr_of(scene, 1, "left_camera") > 24.5 and psnr_of(scene, 1, "front_camera") > 22


def test_with_neither_the_scene_is_guessed_and_says_so(tmp_path):
    folder = write_as_recording(tmp_path / "drive", lidar=False)
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
    folder = write_as_recording(tmp_path / "drive", lidar=False)
    query = QUERY | {"max_gaussians": "6000", "held_out": "1:"}
    held = open_recording(str(folder), query)
    assert len(held.background) + sum(len(a.gaussians) for a in held.actors) <= 6000
    for path in folder.glob("images/*/00000[12].png"):
        cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH, 3), np.uint8))
    assert_same_bits(held, open_recording(str(folder), query))


@pytest.mark.parametrize("lidar", [True, False])
def test_one_camera_and_one_frame_are_enough(tmp_path, lidar):
    folder = write_as_recording(
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
    text = (Path(__file__).parents[2] / "docs" / "datasets" / "recording.md").read_text()
    calibration, program = (
        text.split(f"```{kind}\n")[1].split("```")[0] for kind in ("json", "python")
    )
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs/datasets/recording.md", "exec"), {})
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
    expected = open_recording(str(write_as_recording(tmp_path / "whole")), QUERY)
    root = in_blocks(write_as_recording(tmp_path / "blocks"))
    scene = open_recording(str(root), QUERY)
    assert detect_scheme_of_path(root) == "recording"
    assert [f.cameras.keys() for f in scene.frames] == [f.cameras.keys() for f in expected.frames]
    assert torch.equal(scene.background.means, expected.background.means)
    for frame in expected.frames:
        boxes = scene.labels.boxes(frame.index)
        assert boxes.track_ids == expected.labels.boxes(frame.index).track_ids


def test_boxes_without_a_label_or_a_size_are_said_and_make_no_object(tmp_path):
    root = write_as_recording(tmp_path / "odd")
    path = root / "labels" / "boxes.parquet"
    boxes = pq.ParquetFile(path).read()
    track_ids, lengths = boxes["track_id"].to_pylist(), boxes["length_m"].to_pylist()
    labels = [None if track == "parked" else "Car" for track in track_ids]
    lengths[track_ids.index("car")] *= -1
    for name, values in {"label": labels, "length_m": lengths}.items():
        boxes = boxes.set_column(boxes.column_names.index(name), name, pa.array(values))
    pq.write_table(boxes, path)
    scene = open_recording(str(root), QUERY)
    assert set(scene.labels.boxes(0).labels) == {"", "Car"}
    problems = " ".join(scene.problems)
    assert f"{track_ids.count('parked')} boxes, the first in frame 0, have no label" in problems
    assert "1 boxes, the first in frame 0, have a centre, size or rotation" in problems


def images_of(copy: Path):
    return find_images(copy, read_calibration(copy).frames)


def lidar_of(copy: Path):
    calibration = read_calibration(copy)
    return read_lidar_drive(copy, calibration, calibration.frames)


def test_jpeg_and_other_numbers_of_digits_are_read(copy):
    for frame, name in enumerate(("0.jpg", "01.JPG", "000000002.jpeg")):
        old = copy / f"images/left_camera/{frame:06d}.png"
        image = cv2.imread(str(old))
        old.unlink()
        done, data = cv2.imencode(".jpg", image)
        assert done
        (old.parent / name).write_bytes(data.tobytes())
    (copy / "images/left_camera/notes.txt").write_text("sunny")
    frames, problems = images_of(copy)
    assert problems == () and frames[1].image_paths["left_camera"].endswith("01.JPG")
    (copy / "images/left_camera/1.png").write_bytes(b"")
    with pytest.raises(AdapterError, match=r"01\.JPG and .*1\.png are both of frame 1; delete"):
        images_of(copy)


def test_stored_pixels_count_whatever_exif_says_of_them(copy, tmp_path):
    turned = Path(shutil.copytree(copy, tmp_path / "turned"))
    for path in sorted(copy.glob("images/*/*.png")):
        orientation = 3 if "front" in path.parent.name else 6
        data = cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
        for root, content in ((copy, data), (turned, with_orientation(data, orientation))):
            own = root / path.relative_to(copy)
            own.with_suffix(".jpg").write_bytes(content)
            own.unlink()
    upright, scene = (open_recording(str(root), QUERY) for root in (copy, turned))
    assert upright.problems == ()
    (note,) = scene.problems
    assert "6 of 6 images have an EXIF orientation, such as 3 in camera front_camera" in note
    assert_same_bits(upright, scene)
    for a, b in zip(upright.frames, scene.frames, strict=True):
        for name, camera in a.cameras.items():
            photos = (read_scaled(Path(f.image_paths[name]), camera, camera) for f in (a, b))
            np.testing.assert_array_equal(*photos)
            np.testing.assert_array_equal(
                recorded_sky_regions(upright, a, name), recorded_sky_regions(scene, b, name)
            )

    size = {"width": street.HEIGHT, "height": street.WIDTH}
    edit_calibration(turned, lambda c: c["frames"][0]["cameras"]["left_camera"].update(size))
    _, problems = images_of(turned)
    assert "is 160x96 pixels, its camera 96x160; left out; its EXIF orientation is 6" in problems[0]
    camera = dataclasses.replace(scene.frames[0].cameras["left_camera"], **size)
    with pytest.raises(ImageFault, match="its camera is of 96x160; its EXIF orientation is 6"):
        read_scaled(Path(scene.frames[0].image_paths["left_camera"]), camera, camera)


def test_images_of_16_bits_are_read_and_those_of_12_refused(copy):
    frames, _ = images_of(copy)
    plain = open_recording(str(copy), QUERY)
    paths = sorted(copy.glob("images/*/*.png"))
    images = [cv2.imread(str(path)) for path in paths]
    for path, image in zip(paths, images, strict=True):
        cv2.imwrite(str(path), image.astype(np.uint16) * 257)
    scene = open_recording(str(copy), QUERY)
    (note,) = scene.problems
    assert "6 of 6 images have 16 bits" in note and "values / 256" in note
    assert_same_bits(plain, scene)
    cv2.imwrite(str(paths[0]), images[0].astype(np.uint16) * 16)
    _, problems = images_of(copy)
    assert "000000.png has 16 bits a channel and no value above 4095 of 65535" in problems[0]
    camera = frames[0].cameras["front_camera"]
    with pytest.raises(ImageFault, match="no value above 4095"):
        read_scaled(paths[0], camera, camera)
    for path, image in zip(paths, images, strict=True):
        cv2.imwrite(str(path), image.astype(np.uint16) * 16)
    with pytest.raises(AdapterError, match=r"no usable image.*multiply its values by 16"):
        open_recording(str(copy), QUERY)


def test_links_out_of_the_folder_are_refused(copy, tmp_path):
    secret = tmp_path / "secret.png"
    cv2.imwrite(str(secret), np.zeros((96, 160, 3), np.uint8))
    image = copy / "images/left_camera/000000.png"
    image.unlink()
    image.symlink_to(secret)
    with pytest.raises(AdapterError, match=r"leads through a link to .*secret\.png, outside"):
        images_of(copy)
    for name in ("lidar", "labels"):
        (copy / name).rename(tmp_path / name)
        (copy / name).symlink_to(tmp_path / name)
    with pytest.raises(AdapterError, match="outside"):
        lidar_of(copy)
    with pytest.raises(AdapterError, match="outside"):
        RecordingLabels(copy).boxes(0)


def test_files_of_a_job_and_plain_ones_give_the_same_sweep(copy):
    plain = RecordingLabels(copy).lidar(1)
    (copy / "lidar/000001.parquet").write_bytes(lidar_bytes(plain))
    ours = RecordingLabels(copy).lidar(1)
    assert list(ours.columns) == list(plain.columns)
    for name in plain.columns:
        np.testing.assert_array_equal(ours.columns[name], plain.columns[name])


def test_returns_on_the_own_car_and_not_finite_ones_are_left_out(copy):
    edit_calibration(copy, lambda c: c.update(ego_box_m=[[-2, -1, -1], [2, 1, 2]]))
    columns = recording.sweep_columns(1)
    columns["x"] = columns["x"].copy()
    columns["x"][:5] = np.nan
    recording.write_lidar(copy, 1, columns)
    drive = lidar_of(copy)
    assert np.isfinite(drive.sweeps[1].points).all()
    local = drive.sweeps[1].points - street.ego_position(1)
    # Returns on the box's very edge may be counted either way.
    assert not ((np.abs(local[:, :2]) < [1.99, 0.99]).all(axis=1) & (local[:, 2] > -1)).any()
    assert len(drive.sweeps[1]) < len(columns["x"]) - 5


def test_returns_on_the_own_car_are_noticed(copy):
    columns = recording.sweep_columns(1)
    body = {k: v[:200].copy() for k, v in columns.items()}
    body["x"][:], body["y"][:], body["z"][:] = street.ego_position(1)[0] + 0.6, 0.5, 0.7
    recording.write_lidar(copy, 1, {k: np.append(v, body[k]) for k, v in columns.items()})
    (problem,) = lidar_of(copy).problems
    assert "lidar/: 200 of " in problem and "give ego_box_m" in problem
    edit_calibration(copy, lambda c: c.update(ego_box_m=[[-2, -1, -0.3], [2, 1, 2]]))
    assert lidar_of(copy).problems == ()


def test_classes_are_those_of_the_calibration(copy):
    semantic = lidar_of(copy).sweeps[0].semantic
    assert set(semantic) == {SemanticClass.ROAD, SemanticClass.BUILDING, SemanticClass.VEHICLE}
    edit_calibration(copy, lambda c: c.update(lidar_classes={"7": "road", "41": "none"}))
    semantic = lidar_of(copy).sweeps[0].semantic
    assert set(semantic) == {SemanticClass.ROAD, SemanticClass.UNKNOWN}


def objects_of(copy: Path):
    calibration = read_calibration(copy)
    return read_objects(copy, calibration.frames, calibration.world_origin_m)


def test_an_object_that_travels_moves_whatever_is_said(copy):
    columns = recording.box_columns(3)
    del columns["attribute_stationary"]
    columns["center_x_m"] = [x + 3 * f for x, f in zip(
        columns["center_x_m"], columns["frame"], strict=True
    )]  # fmt: skip
    recording.write_boxes(copy, columns)
    objects = objects_of(copy)
    assert {s.object_id for s in objects.moving_boxes} == {
        "car",
        "parked",
    } and objects.static_boxes == ()


def test_boxes_that_cannot_stand_anywhere_are_left_out_of_tracks_only(copy):
    columns = recording.box_columns(3)
    columns["center_z_m"][0] = float("nan")
    columns["length_m"][2] = 0.0
    columns["qw"][4] = 0.0
    recording.write_boxes(copy, columns)
    objects = objects_of(copy)
    assert objects.moving_boxes == () and [s.object_id for s in objects.static_boxes] == ["parked"]
    (problem,) = objects.problems
    assert "3 boxes, the first in frame 0" in problem
    assert np.isnan(RecordingLabels(copy).boxes(0).centers_m[0, 2])


def put(frame: int, key: str, value):
    return lambda content: content["frames"][frame].update({key: value})


def put_camera(key: str, value, frame: int = 1):
    """Of the left camera in a frame; without the key where there is no value."""

    def change(content):
        entry = content["frames"][frame]["cameras"]["left_camera"]
        entry.update({key: value}) if value is not None else entry.pop(key)

    return change


EYE = np.eye(4).tolist()
WRONG_CALIBRATIONS = [
    (put_camera("world_from_camera", [[1, 0, 0, math.nan], *EYE[1:]]),
     "frame 1, camera 'left_camera': world_from_camera.0.3 must be a finite number; got nan"),
    (put(2, "world_from_ego", np.diag([1.0, 1, 2, 1]).tolist()),
     "frame 2: world_from_ego must be a rotation.*off by 3"),
    (put(2, "world_from_ego", np.diag([1.0, -1, 1, 1]).tolist()), "determinant -1"),
    (put(2, "world_from_ego", [[1, 0, 0, 1e300], *EYE[1:]]), "0.3 must be less .* to 1000000000"),
    (put(2, "world_from_ego", [[1, 0, 0, 10**400], *EYE[1:]]), "0.3 must be a valid number"),
    (put(2, "world_from_ego", [["1", 0, 0, 0], *EYE[1:]]), "0.0 must be a valid number; got '1'"),
    (put(2, "world_from_ego", None), "frame 2: world_from_ego must be a valid tuple; got None"),
    (put(2, "timestamp_ns", 1.5), "frame 2: timestamp_ns must be a valid integer; got 1.5"),
    (put(2, "timestamp_ns", 5), "timestamp_ns must increase with the frame's number; frame 1"),
    (put(2, "frame", 1), "lists frame 1 twice"),
    (put(2, "frame", -3), "frame must be greater than or equal to 0; got -3"),
    (put(2, "cameras", []), r"frame 2: cameras must be a valid dictionary; got \[\]"),
    (put_camera("fx", None), "frame 1, camera 'left_camera': fx is missing"),
    (put_camera("fx", -5), "camera 'left_camera': .*fx must be finite and > 0"),
    (put_camera("fx", "long"), "left_camera': fx must be a valid number; got 'long'"),
    (put_camera("fy", 1e-320), "frame 1, camera 'left_camera': fy must be from 6.999 to 9167 px "
     r"in an image of 160x96 \(a field of view from 170 to 1 degrees.*got 9.99989e-321"),
    (put_camera("fx", 1e9), r"camera 'left_camera': fx must be from 6.999 to 9167 px.*got 1e\+09"),
    (put_camera("cx", -1e6), "camera 'left_camera': cx must lie within 1600 px of the centre"),
    (put_camera("width", 10**9), "left_camera': width must be less than or equal to"),
    (put_camera("timestamp_ns", "now"), "left_camera': timestamp_ns must be a valid integer"),
    (lambda c: c.update(frames=[]), r"frames must have at least 1 item .* got \[\]"),
    (lambda c: c.update(frames=3), "frames must be a valid list; got 3"),
    (lambda c: c.update(ego_above_ground_m="low"), "ego_above_ground_m must be a valid number"),
    (lambda c: c.update(ego_box_m=[[1, 1, 1], [0, 0, 0]]), r"ego_box_m must be \[\[x, y, z\]"),
    (lambda c: c.update(lidar_classes={"7": "street"}), "lidar_classes must map .*, none .*got"),
]  # fmt: skip


def test_wrong_calibration_says_what_is_wrong(copy):
    path = copy / "calibration.json"
    whole = path.read_text()
    for change, message in WRONG_CALIBRATIONS:
        edit_calibration(copy, change)
        with pytest.raises(AdapterError, match=message) as caught:
            read_calibration(copy)
        assert str(path) in str(caught.value)
        path.write_text(whole)
    for text in ("", "[1]", "{", "[" * 100_000):
        path.write_text(text)
        with pytest.raises(AdapterError, match=r"calibration\.json"):
            read_calibration(copy)
    path.unlink()
    with pytest.raises(AdapterError, match=r"calibration\.json does not exist; a recording needs"):
        read_calibration(copy)


def test_frames_are_sorted_and_have_what_the_file_says(copy):
    edit_calibration(copy, put_camera("timestamp_ns", recording.time_ns(1) + 7))
    edit_calibration(copy, lambda content: content["frames"].reverse())
    edit_calibration(copy, lambda content: content["frames"][0]["cameras"].pop("left_camera"))
    edit_calibration(copy, lambda c: c.update(scene="town", variant="clear-000"))
    calibration = read_calibration(copy)
    frames, problems = images_of(copy)
    assert calibration.name == "town-clear-000" and problems == ()
    assert [frame.index for frame in calibration.frames] == [0, 1, 2]
    assert frames[1].cameras["left_camera"].timestamp_ns == recording.time_ns(1) + 7
    assert frames[1].cameras["front_camera"].timestamp_ns == recording.time_ns(1)
    assert set(frames[2].cameras) == set(frames[2].image_paths) == {"front_camera"}
    (problem,) = unlisted_images(copy, frames)
    assert "camera left_camera: 1 images, such as of frame 2" in problem


def test_images_that_cannot_be_used_are_problems(copy):
    left = copy / "images/left_camera"
    for path in left.iterdir():
        path.unlink()
    (copy / "images/roof").mkdir()
    cv2.imwrite(str(copy / "images/front_camera/77.jpg"), np.zeros((96, 160, 3), np.uint8))
    frames, _ = images_of(copy)
    more = unlisted_images(copy, frames)
    assert "front_camera: 1 images, such as of frame 77, have no entry" in more[0]
    assert "images/roof belongs to no camera of calibration.json" in more[1]
    for path in copy.glob("images/front_camera/00000[02].png"):
        path.unlink()
    for query, some in (
        ({"held_out": "1:2"}, r"2 frames \(0, 2\) that are not held out"),
        ({"frames": "0:1"}, r"1 frame \(0\);"),
    ):
        with pytest.raises(AdapterError, match=rf"no usable image in {some}.*camera"):
            open_recording(str(copy), QUERY | query)


@pytest.mark.parametrize("name", ["../../secret", "/etc", "a\0b"])
def test_no_camera_name_leaves_the_folder(copy, name):
    def change(content):
        for frame in content["frames"]:
            frame["cameras"][name] = frame["cameras"].pop("left_camera")

    edit_calibration(copy, change)
    frames, problems = images_of(copy)
    assert len(problems) == 1 and "holds no image" in problems[0]
    # Where such a camera's images are is what a job would have written; links inside are fine.
    (copy / "images/left_camera").rename(copy / "left")
    (copy / "images" / folder_name(name)).symlink_to("../left")
    frames, problems = images_of(copy)
    assert problems == () and set(frames[0].image_paths) == {"front_camera", name}


def test_what_starts_a_scene_without_lidar_can_be_wrong(copy):
    few = {k: v[:30] for k, v in recording.sweep_columns(0).items()}
    for frame in range(3):
        recording.write_lidar(copy, frame, few)
    assert "lidar holds 90 returns and" in open_recording(str(copy), QUERY).problems[-1]
    (copy / "depth/left_camera").mkdir(parents=True)
    cv2.imwrite(str(copy / "depth/left_camera/000000.png"), np.ones((4, 6), np.uint16))
    (copy / "depth/left_camera/000001.png").write_bytes(b"nothing")
    problems = open_recording(str(copy), QUERY).problems
    assert "camera left_camera, frame 0: depth" in problems[0] and "it is 6x4 pixels" in problems[0]
    assert "not a complete PNG" in problems[1]
    edit_calibration(copy, lambda c: c.update(ego_above_ground_m=-1.5))
    message = r"frame 0, camera 'front_camera': it is -0.40 m above .* give ego_above_ground_m"
    with pytest.raises(AdapterError, match=message):
        open_recording(str(copy), QUERY)


def test_points_that_no_image_shows_are_an_error(copy):
    up = np.eye(4)  # the camera's forward is the world's up
    for frame in range(3):
        for name in street.CAMERAS:
            edit_calibration(
                copy,
                lambda c: c["frames"][frame]["cameras"][name].update(world_from_camera=up.tolist()),  # noqa: B023
            )
    with pytest.raises(AdapterError, match="none of the points that were measured is in any image"):
        open_recording(str(copy), QUERY)


def test_times_are_the_returns_own_where_they_can_be_used(copy):
    columns = recording.sweep_columns(0)
    seconds = columns.pop("t")
    nanoseconds = np.round(seconds * 1e9).astype(np.int64)
    gap = np.where(np.arange(len(seconds)) == 3, np.nan, seconds)
    for times, is_usable in (
        ({"t": seconds}, True),
        ({"timestamp_ns": nanoseconds}, True),
        ({"timestamp_ns": nanoseconds.astype("datetime64[ns]")}, True),
        ({}, False),
        ({"t": seconds - street.time_s(0)}, False),
        ({"t": gap}, False),
    ):
        recording.write_lidar(copy, 0, columns | times)
        drive = lidar_of(copy)
        expected = nanoseconds if is_usable else recording.time_ns(0)
        np.testing.assert_array_equal(drive.sweeps[0].timestamps_ns, expected)
        said = "near the frame's time in 1 sweeps (the first of frame 0)"
        assert [said in problem for problem in drive.problems] == [True] * (not is_usable)


def test_what_is_wrong_with_single_sweeps(copy):
    edit_calibration(copy, lambda c: c.pop("lidar_classes"))
    (copy / "lidar/000001.parquet").unlink()
    drive = lidar_of(copy)
    assert "the files of 1 frame (1) are missing" in drive.problems[0]
    assert "semantic holds 41, which is no SemanticClass" in drive.problems[1]
    assert len(drive.sweeps) == 2
    assert (drive.sweeps[0].semantic == SemanticClass.UNKNOWN).all()
    columns = recording.sweep_columns(0)
    recording.write_lidar(copy, 0, columns | {"x": columns["x"] + 5000})
    message = r"000000\.parquet: most returns lie more than 1000 m from the car .* in frame 0"
    with pytest.raises(AdapterError, match=message):
        lidar_of(copy)
    for columns, message in (
        ({"x": [1.0], "y": [2.0]}, r"needs columns x, y, z; missing \['z'\]"),
        ({"x": ["a"], "y": [2.0], "z": [3.0]}, r"000000\.parquet is not a LiDAR file"),
    ):
        recording.write_lidar(copy, 0, columns)
        with pytest.raises(AdapterError, match=message):
            read_sweep(copy / "lidar/000000.parquet")
    (copy / "lidar/000000.parquet").write_bytes(b"PAR1 nothing PAR1")
    with pytest.raises(AdapterError, match=r"000000\.parquet is not a LiDAR file"):
        read_sweep(copy / "lidar/000000.parquet")
    for name in ("a.parquet", "-1.parquet", "²3.parquet", "4.csv", "1.5.parquet"):
        (copy / "lidar" / name).touch()
    assert list(numbered_files(copy, "lidar", (".parquet",))) == [0, 2]


def test_boxes_have_their_own_times_and_one_name_a_frame(copy):
    columns = recording.box_columns(3)
    columns["timestamp_ns"] = [recording.time_ns(f) + 9 for f in columns["frame"]]
    recording.write_boxes(copy, columns)
    assert [s.timestamp_ns for s in objects_of(copy).moving_boxes] == columns["timestamp_ns"][::2]
    recording.write_boxes(copy, columns | {"track_id": ["car"] * 6})
    objects = objects_of(copy)
    assert len(objects.moving_boxes) == 3 and "3 boxes share name and frame" in objects.problems[0]


def test_damaged_boxes_name_their_file(copy):
    for change, message in (
        ({"qw": None}, r"it lacks \['qw'\]"),
        ({"frame": [0.5] * 6}, "column frame must hold whole numbers"),
        ({"frame": [None] * 6}, "column frame must hold whole numbers"),
        ({"frame": [1e300] * 6}, "column frame must hold numbers from -2.62"),
        ({"timestamp_ns": ["x"] * 6}, "column timestamp_ns must hold whole numbers"),
        ({"width_m": ["x"] * 6}, "not a table of boxes"),
    ):
        columns = {k: v for k, v in (recording.box_columns(3) | change).items() if v is not None}
        recording.write_boxes(copy, columns)
        with pytest.raises(AdapterError, match=rf"boxes\.parquet .*{message}"):
            all_boxes(copy)
