"""Files of a recording: what is refused, what is gone on without, and that nothing leaves the
folder."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pandaset_folder as street
import pytest
import recording_folder as recording
from recording_folder import edit_calibration, write_recording

from adapters.raw_drive import read_objects
from adapters.recording.adapter import RecordingLabels, all_boxes, read_lidar_drive, read_sweep
from adapters.recording.files import find_images, numbered_files, read_calibration, unlisted_images
from augment.errors import AdapterError
from augment.jobs.layout import folder_name
from augment.jobs.tables import lidar_bytes
from augment.semantics import SemanticClass


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_recording(tmp_path / "drive")


def images_of(folder: Path):
    return find_images(folder, read_calibration(folder).frames)


def lidar_of(folder: Path):
    calibration = read_calibration(folder)
    return read_lidar_drive(folder, calibration, calibration.frames)


def camera_entry(content: dict, frame: int = 1, name: str = "left_camera") -> dict:
    return content["frames"][frame]["cameras"][name]


# Calibration


def put(frame: int, key: str, value):
    def change(content):
        content["frames"][frame][key] = value

    return change


def put_camera(key: str, value):
    def change(content):
        if value is None:
            del camera_entry(content)[key]
        else:
            camera_entry(content)[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put_camera("world_from_camera", [[1, 0, 0, math.nan], *np.eye(4).tolist()[1:]]),
         "frame 1, camera 'left_camera': world_from_camera must be finite"),
        (put(2, "world_from_ego", np.diag([1.0, 1, 2, 1]).tolist()),
         "frame 2: world_from_ego must be a rotation.*off by 3"),
        (put(2, "world_from_ego", np.diag([1.0, -1, 1, 1]).tolist()), "determinant -1"),
        (put(2, "world_from_ego", [[1, 0, 0, 1e300], *np.eye(4).tolist()[1:]]), "within 1e.09 m"),
        (put(2, "world_from_ego", [[1, 0, 0, 10**400], *np.eye(4).tolist()[1:]]), "4 rows of 4 n"),
        (put(2, "world_from_ego", [["1", 0, 0, 0], *np.eye(4).tolist()[1:]]), "4 rows of 4 numb"),
        (put(2, "world_from_ego", None), "frame 2: world_from_ego must be 4 rows of 4 numbers"),
        (put(2, "timestamp_ns", 1.5), "frame 2: timestamp_ns must be whole nanoseconds; got 1.5"),
        (put(2, "timestamp_ns", 5), "timestamp_ns must increase with the frame's number; frame 1"),
        (put(2, "frame", 1), "lists frame 1 twice"),
        (put(2, "frame", -3), "needs a number 'frame', 0 or greater; got -3"),
        (put(2, "cameras", []), "'cameras' must map names to cameras"),
        (put_camera("fx", None), "camera 'left_camera': 'fx' is missing"),
        (put_camera("fx", -5), "fx must be finite and > 0"),
        (put_camera("fx", "long"), "camera 'left_camera': fx .pixels. must be a number"),
        (put_camera("cy", math.nan), "left_camera': cy .pixels. must be a number .* got nan"),
        (put_camera("width", 10**9), "width and height must be whole pixels, 1 to"),
        (put_camera("timestamp_ns", "now"), "left_camera': timestamp_ns must be whole"),
        (lambda c: c.update(frames=[]), "must hold a list 'frames'"),
        (lambda c: c.update(ego_above_ground_m="low"), "ego_above_ground_m must be a number from"),
        (lambda c: c.update(ego_box_m=[[1, 1, 1], [0, 0, 0]]), r"ego_box_m must be \[\[x, y, z\]"),
        (lambda c: c.update(lidar_classes={"7": "street"}), "lidar_classes must map .*, none; got"),
    ],
)  # fmt: skip
def test_wrong_calibration_says_what_is_wrong(folder, change, message):
    edit_calibration(folder, change)
    with pytest.raises(AdapterError, match=message) as caught:
        read_calibration(folder)
    assert str(folder / "calibration.json") in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"frames": 3}', "[" * 100_000])
def test_calibration_that_is_no_json_object_is_an_error(folder, text):
    (folder / "calibration.json").write_text(text)
    with pytest.raises(AdapterError, match=r"calibration\.json"):
        read_calibration(folder)
    (folder / "calibration.json").unlink()
    with pytest.raises(AdapterError, match=r"calibration\.json does not exist; a recording needs"):
        read_calibration(folder)


def test_frames_are_sorted_and_a_cameras_own_time_counts(folder):
    edit_calibration(folder, put_camera("timestamp_ns", recording.time_ns(1) + 7))
    edit_calibration(folder, lambda content: content["frames"].reverse())
    frames = read_calibration(folder).frames
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[1].cameras["left_camera"].timestamp_ns == recording.time_ns(1) + 7
    assert frames[1].cameras["front_camera"].timestamp_ns == recording.time_ns(1)


# Images


def test_images_of_other_sizes_are_left_out_and_said(folder):
    path = folder / "images/left_camera/000001.png"
    cv2.imwrite(str(path), np.zeros((street.HEIGHT, street.WIDTH - 1, 3), np.uint8))
    frames, problems = images_of(folder)
    assert problems == (
        f"camera left_camera, frame 1: image {path} is 159x96 pixels, calibration.json says "
        f"160x96; left out",
    )
    assert set(frames[1].image_paths) == {"front_camera"}
    assert set(frames[1].cameras) == {"front_camera", "left_camera"}


def test_missing_and_damaged_images_are_problems(folder):
    (folder / "images/left_camera/000000.png").unlink()
    cut = folder / "images/left_camera/000001.png"
    cut.write_bytes(cut.read_bytes()[:-30])
    (folder / "images/left_camera/000002.png").write_bytes(b"\x89PNG\r\n\x1a\n nothing IEND")
    (folder / "images/roof").mkdir()
    cv2.imwrite(str(folder / "images/front_camera/77.jpg"), np.zeros((96, 160, 3), np.uint8))
    frames, problems = images_of(folder)
    assert [len(frame.image_paths) for frame in frames] == [1, 1, 1]
    assert problems[0] == "camera left_camera, frame 0: its image is missing"
    assert (
        "000001.png is cut short" in problems[1] and "000002.png cannot be decoded" in problems[2]
    )
    more = unlisted_images(folder, frames)
    assert "front_camera: 1 images, such as of frame 77, have no entry" in more[0]
    assert "images/roof belongs to no camera of calibration.json" in more[1]


def test_cameras_may_be_missing_in_some_frames(folder):
    edit_calibration(folder, lambda c: c["frames"][1]["cameras"].pop("left_camera"))
    frames, problems = images_of(folder)
    assert problems == () and set(frames[1].cameras) == {"front_camera"}
    (problem,) = unlisted_images(folder, frames)
    assert "camera left_camera: 1 images, such as of frame 1" in problem


def test_jpeg_and_other_numbers_of_digits_are_read(folder):
    for frame, name in enumerate(("0.jpg", "01.JPG", "000000002.jpeg")):
        old = folder / f"images/left_camera/{frame:06d}.png"
        image = cv2.imread(str(old))
        old.unlink()
        done, data = cv2.imencode(".jpg", image)
        assert done
        (old.parent / name).write_bytes(data.tobytes())
    (folder / "images/left_camera/notes.txt").write_text("sunny")
    frames, problems = images_of(folder)
    assert problems == () and frames[1].image_paths["left_camera"].endswith("01.JPG")
    (folder / "images/left_camera/1.png").write_bytes(b"")
    with pytest.raises(AdapterError, match=r"01\.JPG and .*1\.png are both of frame 1; delete"):
        images_of(folder)


def test_no_image_at_all_is_an_error(folder):
    for path in folder.glob("images/*/*.png"):
        path.unlink()
    with pytest.raises(AdapterError, match="holds no usable image of frames 0 to 2: camera front"):
        images_of(folder)


# Nothing leaves the folder


def test_links_out_of_the_folder_are_refused(folder, tmp_path):
    secret = tmp_path / "secret.png"
    cv2.imwrite(str(secret), np.zeros((96, 160, 3), np.uint8))
    image = folder / "images/left_camera/000000.png"
    image.unlink()
    image.symlink_to(secret)
    with pytest.raises(AdapterError, match=r"leads through a link to .*secret\.png, outside"):
        images_of(folder)
    for name in ("lidar", "labels"):
        (folder / name).rename(tmp_path / name)
        (folder / name).symlink_to(tmp_path / name)
    with pytest.raises(AdapterError, match="outside"):
        lidar_of(folder)
    with pytest.raises(AdapterError, match="outside"):
        RecordingLabels(folder).boxes(0)


def test_links_inside_the_folder_are_fine(folder):
    (folder / "images/left_camera").rename(folder / "left")
    (folder / "images/left_camera").symlink_to("../left")
    assert images_of(folder)[1] == ()


@pytest.mark.parametrize("name", ["../../secret", "/etc", "rear/left", "..", "a\0b"])
def test_no_camera_name_leaves_the_folder(folder, name):
    def change(content):
        for frame in content["frames"]:
            frame["cameras"][name] = frame["cameras"].pop("left_camera")

    edit_calibration(folder, change)
    frames, problems = images_of(folder)
    assert len(problems) == 1 and "holds no image" in problems[0]
    # Where such a camera's images are is what a job would have written.
    (folder / "images/left_camera").rename(folder / "images" / folder_name(name))
    frames, problems = images_of(folder)
    assert problems == () and set(frames[0].image_paths) == {"front_camera", name}


# LiDAR


def test_files_of_a_job_and_plain_ones_give_the_same_sweep(folder):
    plain = RecordingLabels(folder).lidar(1)
    (folder / "lidar/000001.parquet").write_bytes(lidar_bytes(plain))
    ours = RecordingLabels(folder).lidar(1)
    assert list(ours.columns) == list(plain.columns)
    for name in plain.columns:
        np.testing.assert_array_equal(ours.columns[name], plain.columns[name])


@pytest.mark.parametrize("times", ["none", "from zero", "nan"])
def test_without_usable_times_the_frames_time_is_used(folder, times):
    for frame in range(3):
        columns = recording.sweep_columns(frame)
        seconds = columns.pop("t")
        if times == "from zero":
            columns["t"] = seconds - street.time_s(0)
        if times == "nan":
            columns["t"] = np.where(np.arange(len(seconds)) == 3, np.nan, seconds)
        recording.write_lidar(folder, frame, columns)
    drive = lidar_of(folder)
    (problem,) = drive.problems
    assert "near the frame's time in 3 sweeps (the first of frame 0)" in problem
    for frame, sweep in enumerate(drive.sweeps):
        assert (sweep.timestamps_ns == recording.time_ns(frame)).all() and len(sweep)


def test_times_may_be_nanoseconds_or_dates(folder):
    columns = recording.sweep_columns(0)
    nanoseconds = np.round(columns.pop("t") * 1e9).astype(np.int64)
    for times in (nanoseconds, nanoseconds.astype("datetime64[ns]")):
        recording.write_lidar(folder, 0, columns | {"timestamp_ns": times})
        drive = lidar_of(folder)
        assert drive.problems == ()
        np.testing.assert_array_equal(drive.sweeps[0].timestamps_ns, nanoseconds)


def test_returns_on_the_own_car_and_not_finite_ones_are_left_out(folder):
    edit_calibration(folder, lambda c: c.update(ego_box_m=[[-2, -1, -1], [2, 1, 2]]))
    columns = recording.sweep_columns(1)
    columns["x"] = columns["x"].copy()
    columns["x"][:5] = np.nan
    recording.write_lidar(folder, 1, columns)
    drive = lidar_of(folder)
    assert np.isfinite(drive.sweeps[1].points).all()
    local = drive.sweeps[1].points - street.ego_position(1)
    # Returns on the box's very edge may be counted either way.
    assert not ((np.abs(local[:, :2]) < [1.99, 0.99]).all(axis=1) & (local[:, 2] > -1)).any()
    assert len(drive.sweeps[1]) < len(columns["x"]) - 5


def test_returns_on_the_own_car_are_noticed(folder):
    columns = recording.sweep_columns(1)
    body = {k: v[:200].copy() for k, v in columns.items()}
    body["x"][:], body["y"][:], body["z"][:] = street.ego_position(1)[0] + 0.6, 0.5, 0.7
    recording.write_lidar(folder, 1, {k: np.append(v, body[k]) for k, v in columns.items()})
    (problem,) = lidar_of(folder).problems
    assert "lidar/: 200 of " in problem and "give ego_box_m" in problem
    edit_calibration(folder, lambda c: c.update(ego_box_m=[[-2, -1, -0.3], [2, 1, 2]]))
    assert lidar_of(folder).problems == ()


def test_classes_are_those_of_the_calibration(folder):
    semantic = lidar_of(folder).sweeps[0].semantic
    assert set(semantic) == {SemanticClass.ROAD, SemanticClass.BUILDING, SemanticClass.VEHICLE}
    edit_calibration(folder, lambda c: c.update(lidar_classes={"7": "road", "41": "none"}))
    semantic = lidar_of(folder).sweeps[0].semantic
    assert set(semantic) == {SemanticClass.ROAD, SemanticClass.UNKNOWN}


def test_unknown_class_numbers_are_ignored_and_said(folder):
    edit_calibration(folder, lambda c: c.pop("lidar_classes"))
    drive = lidar_of(folder)
    (problem,) = drive.problems
    assert "semantic holds 41, which is no SemanticClass" in problem and "lidar_classes" in problem
    assert (drive.sweeps[0].semantic == SemanticClass.UNKNOWN).all()


def test_a_missing_sweep_is_a_problem(folder):
    (folder / "lidar/000001.parquet").unlink()
    drive = lidar_of(folder)
    assert drive.problems == ("frame 1: lidar/000001.parquet is missing, its points too",)
    assert len(drive.sweeps) == 2


def test_lidar_in_another_world_is_an_error(folder):
    columns = recording.sweep_columns(0)
    recording.write_lidar(folder, 0, columns | {"x": columns["x"] + 5000})
    message = r"000000\.parquet: most returns lie more than 1000 m from the car .* in frame 0"
    with pytest.raises(AdapterError, match=message):
        lidar_of(folder)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": [1.0], "y": [2.0]}, r"needs columns x, y, z; missing \['z'\]"),
        ({"x": ["a"], "y": [2.0], "z": [3.0]}, "is not a LiDAR file"),
    ],
)
def test_damaged_sweeps_name_their_file(folder, columns, message):
    recording.write_lidar(folder, 0, columns)
    with pytest.raises(AdapterError, match=message) as caught:
        read_sweep(folder / "lidar/000000.parquet")
    assert "000000.parquet" in str(caught.value)
    (folder / "lidar/000000.parquet").write_bytes(b"PAR1 nothing PAR1")
    with pytest.raises(AdapterError, match=r"000000\.parquet is not a LiDAR file"):
        read_sweep(folder / "lidar/000000.parquet")


def test_numbers_of_files_ignore_what_is_none(tmp_path):
    assert numbered_files(tmp_path, "lidar", (".parquet",)) == {}
    (tmp_path / "lidar").mkdir()
    for name in ("a.parquet", "-1.parquet", "²3.parquet", "4.csv", "1.5.parquet"):
        (tmp_path / "lidar" / name).touch()
    assert numbered_files(tmp_path, "lidar", (".parquet",)) == {}


# Boxes


def objects_of(folder: Path):
    calibration = read_calibration(folder)
    return read_objects(calibration.frames, all_boxes(folder), calibration.world_origin_m)


def test_an_object_that_travels_moves_whatever_is_said(folder):
    columns = recording.box_columns(3)
    del columns["attribute_stationary"]
    columns["center_x_m"] = [x + 3 * f for x, f in zip(
        columns["center_x_m"], columns["frame"], strict=True
    )]  # fmt: skip
    recording.write_boxes(folder, columns)
    objects = objects_of(folder)
    assert {s.object_id for s in objects.moving} == {"car", "parked"} and objects.still == ()


def test_boxes_that_cannot_stand_anywhere_are_left_out_of_tracks_only(folder):
    columns = recording.box_columns(3)
    columns["center_z_m"][0] = float("nan")
    columns["length_m"][2] = 0.0
    columns["qw"][4] = 0.0
    recording.write_boxes(folder, columns)
    objects = objects_of(folder)
    assert objects.moving == () and [s.object_id for s in objects.still] == ["parked"]
    (problem,) = objects.problems
    assert "3 boxes, the first in frame 0" in problem
    assert np.isnan(RecordingLabels(folder).boxes(0).centers_m[0, 2])


def test_a_name_used_twice_in_a_frame_is_said(folder):
    columns = recording.box_columns(3)
    columns["track_id"] = ["car"] * 6
    recording.write_boxes(folder, columns)
    objects = objects_of(folder)
    assert len(objects.moving) == 3 and "3 boxes share track_id and frame" in objects.problems[0]


def test_own_times_of_boxes_count(folder):
    columns = recording.box_columns(3)
    columns["timestamp_ns"] = [recording.time_ns(f) + 9 for f in columns["frame"]]
    recording.write_boxes(folder, columns)
    assert [s.timestamp_ns for s in objects_of(folder).moving] == [
        recording.time_ns(f) + 9 for f in range(3)
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"qw": None}, r"it lacks \['qw'\]"),
        ({"frame": [0.5] * 6}, "column frame must hold whole numbers"),
        ({"frame": [None] * 6}, "column frame must hold whole numbers"),
        ({"frame": [1e300] * 6}, "column frame must hold numbers from -2.62"),
        ({"timestamp_ns": ["x"] * 6}, "column timestamp_ns must hold whole numbers"),
        ({"width_m": ["x"] * 6}, "not a table of boxes"),
    ],
)
def test_damaged_boxes_name_their_file(folder, change, message):
    columns = {k: v for k, v in (recording.box_columns(3) | change).items() if v is not None}
    recording.write_boxes(folder, columns)
    with pytest.raises(AdapterError, match=message) as caught:
        all_boxes(folder)
    assert "boxes.parquet" in str(caught.value)


def test_the_name_is_what_a_job_called_it(folder):
    assert read_calibration(folder).name == "drive"
    edit_calibration(folder, lambda c: c.update(scene="town", variant="clear-000"))
    assert read_calibration(folder).name == "town-clear-000"
    assert json.loads((folder / "calibration.json").read_text())["scene"] == "town"
