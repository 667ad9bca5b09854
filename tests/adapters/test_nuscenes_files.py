"""The tables of nuScenes: what is read, what is chosen, and what is refused."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import nuscenes_files as files
import pandaset_folder as street
import pytest

from adapters.nuscenes import tables as rows
from adapters.nuscenes.adapter import nuscenes_labels, open_nuscenes
from adapters.nuscenes.tables import NuScenesOptions, frame_tokens, read_tables
from augment.errors import AdapterError

ONE, TWO = files.SCENES


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return files.write_dataset(tmp_path_factory.mktemp("nuscenes") / "data")


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    """Tables of its own, everything else the shared folder's."""
    root = tmp_path / "data"
    for name in ("samples", "sweeps", "lidarseg", "maps"):
        root.mkdir(exist_ok=True)
        (root / name).symlink_to(folder / name)
    shutil.copytree(folder / files.VERSION, root / files.VERSION)
    return root


def tables(root: Path, scene: str | None = ONE):
    return read_tables(root, None, scene)


def edit(root: Path, table: str, token: str, change) -> None:
    """Change one row of a table in place."""
    content = files.read_table(root, table)
    change(next(row for row in content if row["token"] == token))
    files.write_table(root, table, content)


def test_one_scene_is_read_in_order_of_time(folder):
    read = tables(folder, TWO)
    assert (read.name, read.version) == (TWO, "v1.0-mini")
    assert [s.token for s in read.samples] == [files.sample_token(1, i) for i in range(3)]
    assert [f.token for f in read.lidar] == [
        files.data_token(1, "LIDAR_TOP", i) for i in range(files.SWEEPS)
    ]
    assert [f.timestamp_ns for f in read.lidar] == [t * 1000 for t in files.sweep_times_us(1)]
    assert [f.is_key_frame for f in read.lidar] == [i % 5 == 0 for i in range(files.SWEEPS)]
    assert list(read.images) == list(files.CAMERAS)
    image = read.images["CAM_FRONT_LEFT"][1]
    assert image.filename == files.filename(1, "CAM_FRONT_LEFT", 1)
    assert (image.width, image.height, image.intrinsic) == (160, 96, (80.0, 80.0, 80.0, 48.0))
    np.testing.assert_allclose(image.world_from_ego, files.world_from_ego(1, 0.202), atol=1e-9)
    np.testing.assert_allclose(
        image.ego_from_sensor, files.ego_from_camera("CAM_FRONT_LEFT"), atol=1e-12
    )
    assert read.class_names[24] == "flat.driveable_surface" and len(read.semantic_files) == 3


def test_boxes_are_the_keyframes_own(folder):
    labels = nuscenes_labels(str(folder), {"scene": TWO, "sweeps": "0"})
    boxes = labels.boxes(1)
    assert boxes.track_ids == tuple(
        files.instance_token(1, thing) for thing in (files.CAR, files.PARKED, files.WALKER)
    )
    assert boxes.labels == ("vehicle.car", "vehicle.truck", "human.pedestrian.adult")
    np.testing.assert_array_equal(
        boxes.sizes_m, [street.CAR_SIZE_M, files.PARKED_SIZE_M, files.WALKER_SIZE_M]
    )
    for i, thing in enumerate((files.CAR, files.PARKED, files.WALKER)):
        np.testing.assert_array_equal(boxes.centers_m[i], files.box_pose(1, thing, 0.5)[:3, 3])
    # Turned by 30 degrees about z, as the whole street.
    half = np.radians(15)
    np.testing.assert_allclose(boxes.quats, [[np.cos(half), 0, 0, np.sin(half)]] * 3, atol=1e-12)
    columns = boxes.attributes
    assert list(columns["attributes"]) == ["vehicle.moving", "vehicle.parked", "pedestrian.moving"]
    assert list(columns["visibility"]) == ["v80-100", "v60-80", "v80-100"]
    assert columns["num_lidar_pts"].tolist() == [900, 0, 0]
    assert columns["num_radar_pts"].tolist() == [0, 0, 0]
    assert columns["token"][0] == files.token(
        "annotation", files.instance_token(1, files.CAR), files.sample_token(1, 1)
    )
    assert not columns["interpolated"].any()


def test_boxes_between_keyframes_are_interpolated(folder):
    labels = nuscenes_labels(str(folder), {"scene": ONE})
    for frame in (6, 7, 8, 9):  # of the last keyframe at 1 s, after the one at 0.5 s
        boxes = labels.boxes(frame)
        assert boxes.attributes["interpolated"].all() and len(boxes) == 3
        fraction = (files.SWEEP_S * frame - 0.5) / 0.5
        for i, thing in enumerate((files.CAR, files.PARKED, files.WALKER)):
            before, after = (files.box_pose(0, thing, t)[:3, 3] for t in (0.5, 1.0))
            expected = before + fraction * (after - before)
            np.testing.assert_allclose(boxes.centers_m[i], expected, atol=1e-9)
    early = labels.boxes(2)
    # The first keyframe has no walker: the second's stands as it is.
    assert early.track_ids[2] == files.instance_token(0, files.WALKER)
    np.testing.assert_array_equal(early.centers_m[2], files.box_pose(0, files.WALKER, 0.5)[:3, 3])
    assert len(labels.boxes(0)) == 2 and not labels.boxes(5).attributes["interpolated"].any()
    assert len(labels.boxes(99)) == 0 and labels.lidar(99) is None


def test_rotations_take_the_shorter_way(copy):
    key = files.instance_token(0, files.CAR)
    yaws = np.radians([170.0, 190.0])
    for i, yaw in enumerate(yaws):
        quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
        if i == 1:
            quat = [-v for v in quat]  # the same rotation
        token = files.token("annotation", key, files.sample_token(0, i))
        edit(copy, "sample_annotation", token, lambda row, q=quat: row.update(rotation=q))
    w, x, y, z = nuscenes_labels(str(copy), {"scene": ONE}).boxes(2).quats[0]
    assert x == y == 0
    # At 0.2 s of 0.5 s: 178 degrees.
    assert np.degrees(2 * np.arctan2(z, w)) % 360 == pytest.approx(178.0, abs=1e-9)


def test_sweeps_pass_through_in_the_global_world(folder):
    labels = nuscenes_labels(str(folder), {"scene": TWO})
    sweep = labels.lidar(5)
    assert list(sweep.columns) == ["x", "y", "z", "intensity", "ring", "timestamp_ns", "semantic"]
    points, classes = files.sweep(5)
    turn = files.WORLD_FROM_STREET[1]
    expected = points @ turn[:3, :3].T + turn[:3, 3]
    assert sweep.points_m.dtype == np.float64
    np.testing.assert_allclose(sweep.points_m, expected, atol=1e-5)  # float32 at 40 m
    np.testing.assert_array_equal(sweep.columns["ring"], np.arange(len(points)) % 32)
    np.testing.assert_array_equal(sweep.columns["intensity"], np.arange(len(points)) % 256)
    # The car is met where it is, some 39 ms before the sweep's time.
    car = np.median(sweep.columns["timestamp_ns"][classes == 17]) - files.START_US[1] * 1000
    assert car == pytest.approx(files.met_s(files.CAR, 0.5) * 1e9, abs=1e6)
    before = files.sweep_times_us(1)[5] * 1000 - sweep.columns["timestamp_ns"]
    assert 0 <= before.min() < 1e6 and 49e6 < before.max() <= 50e6
    np.testing.assert_array_equal(sweep.columns["semantic"], classes)
    assert "semantic" not in labels.lidar(4).columns


def test_unlike_cameras_tell_no_turn(copy, folder):
    assert np.degrees(tables(folder).turn.end_rad) == pytest.approx(files.TURN_END_DEG, abs=0.5)
    content = files.read_table(copy, "sample_data")
    for row in content:
        if "CAM_FRONT__" in row["filename"]:
            row["timestamp"] += 20_000  # of a turn of 50 ms
    files.write_table(copy, "sample_data", content)
    assert tables(copy).turn.end_rad is None
    times = nuscenes_labels(str(copy), {"scene": ONE}).lidar(3).columns["timestamp_ns"]
    assert set(times.tolist()) == {files.sweep_times_us(0)[3] * 1000}
    alone = [row for row in content if "CAM_FRONT__" not in row["filename"]]
    files.write_table(copy, "sample_data", alone)
    assert tables(copy).turn.end_rad is None


def test_frames_name_their_rows(folder):
    found = frame_tokens(str(folder), {"scene": TWO})
    assert list(found) == list(range(files.SWEEPS))
    assert all(found[i]["LIDAR_TOP"].token == files.data_token(1, "LIDAR_TOP", i) for i in found)
    # Images some 0.04 s before 0, 0.25, 0.5, 0.75, 1 s; sweeps each tenth of a second.
    for channel in files.CAMERAS:
        numbers = {0: 0, 2: 1, 5: 2, 7: 3, 10: 4}
        assert {i: f[channel].token for i, f in found.items() if channel in f} == {
            i: files.data_token(1, channel, n) for i, n in numbers.items()
        }
    assert found[2]["CAM_FRONT"].filename == files.filename(1, "CAM_FRONT", 1)
    assert [found[i]["CAM_FRONT"].is_key_frame for i in (0, 2, 5)] == [True, False, True]
    keys = frame_tokens(str(folder), {"scene": TWO, "sweeps": "0", "frames": "1:2"})
    assert [sorted(f) for f in keys.values()] == [["CAM_FRONT", "CAM_FRONT_LEFT", "LIDAR_TOP"]] * 3
    assert keys[1]["CAM_FRONT"] == found[5]["CAM_FRONT"]


def test_an_image_is_used_once_and_far_ones_are_said_to_have_no_frame(copy):
    content = files.read_table(copy, "sample_data")
    ours = {files.data_token(0, "CAM_FRONT", i): i for i in range(files.IMAGES)}
    start = files.START_US[0]
    # Two non-key images nearest to the sweep at 0.2 s: one goes to its next neighbour. The key
    # image of 0.5 s stays with its keyframe although another sweep is nearer to it.
    moved = {1: start + 205_000, 2: start + 420_000, 3: start + 215_000}
    for row in content:
        if ours.get(row["token"]) in moved:
            row["timestamp"] = moved[ours[row["token"]]]
    files.write_table(copy, "sample_data", content)
    found = frame_tokens(str(copy), {"scene": ONE})
    used = {i: ours[f["CAM_FRONT"].token] for i, f in found.items() if "CAM_FRONT" in f}
    assert used == {0: 0, 2: 1, 3: 3, 5: 2, 10: 4}
    for row in content:
        if ours.get(row["token"]) == 3:
            row["timestamp"] = start + 9_000_000
    files.write_table(copy, "sample_data", content)
    (problem,) = open_nuscenes(str(copy), QUICK | {"scene": ONE}).problems
    assert "camera CAM_FRONT: 1 of 5 images have no frame" in problem


QUICK = {"voxel_m": "0.5", "image_scale": "0.5", "sky_size": "8"}


def test_the_only_version_and_scene_need_no_name(tmp_path):
    root = files.write_dataset(tmp_path / "test", version="v1.0-test", scenes=[TWO])
    read = tables(root, None)
    assert (read.version, read.name) == ("v1.0-test", TWO)
    assert tables(root, files.token("scene", TWO)).name == TWO


def test_several_are_listed(folder, copy):
    with pytest.raises(AdapterError, match=f"holds 2 scenes; add scene= .*: {ONE}, {TWO}$"):
        tables(folder, None)
    with pytest.raises(AdapterError, match=f"no scene 'scene-9'; it has 2: {ONE}, {TWO}"):
        tables(folder, "scene-9")
    shutil.copytree(copy / files.VERSION, copy / "v1.0-trainval")
    with pytest.raises(AdapterError, match=r"several versions.*v1\.0-mini, v1\.0-trainval"):
        tables(copy)
    assert read_tables(copy, "v1.0-trainval", ONE).version == "v1.0-trainval"
    with pytest.raises(AdapterError, match=r"no tables of version=v1\.0-test; it has v1\.0-mini"):
        read_tables(copy, "v1.0-test", ONE)
    scenes = files.read_table(copy, "scene", "v1.0-trainval")
    many = [{**scenes[0], "token": f"t{i}", "name": f"scene-{i:04d}"} for i in range(850)]
    files.write_table(copy, "scene", many, "v1.0-trainval")
    with pytest.raises(AdapterError, match=r"holds 850 scenes.*scene-0009 and 840 more$"):
        read_tables(copy, "v1.0-trainval", None)
    many[1]["name"] = many[0]["name"]
    files.write_table(copy, "scene", many, "v1.0-trainval")
    with pytest.raises(AdapterError, match="2 scenes 'scene-0000'; give a token: t0, t1"):
        read_tables(copy, "v1.0-trainval", "scene-0000")


def test_no_dataset_is_an_error(folder, tmp_path):
    with pytest.raises(AdapterError, match="is not a folder"):
        tables(tmp_path / "nothing")
    with pytest.raises(AdapterError, match=r"holds no nuScenes tables .* unpack the meta"):
        tables(tmp_path)
    for inner in (files.VERSION, "samples"):
        with pytest.raises(AdapterError, match=f"give the folder above it, {folder}$"):
            tables(folder / inner)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        (
            {"voxels": "1"},
            r"'voxels'; did you mean 'voxel_m'. allowed are frames: .*; version: .*; sweeps: ",
        ),
        ({"sweeps": "yes"}, "sweeps must be 1 for keyframes and .*got 'yes'"),
        ({"voxel_m": "0"}, "nuscenes: voxel_m must be"),
    ],
)
def test_wrong_options_say_what_is_allowed(query, message):
    with pytest.raises(AdapterError, match=message):
        NuScenesOptions.from_query("nuscenes", query)


IMAGE = files.data_token(0, "CAM_FRONT", 1)
BOX = files.token("annotation", files.instance_token(0, files.CAR), files.sample_token(0, 0))
CALIBRATION = files.token("calibration", ONE, "CAM_FRONT")


@pytest.mark.parametrize(
    ("table", "token", "field", "value", "expected"),
    [
        ("sample_data", IMAGE, "ego_pose_token", "gone", r"a row of ego_pose\.json.*got 'gone'"),
        ("sample_data", IMAGE, "calibrated_sensor_token", "gone", r"of calibrated_sensor\.json"),
        ("sample_data", IMAGE, "is_key_frame", 1, "must be true or false; got 1"),
        ("sample_data", IMAGE, "timestamp", "soon", "a time in microseconds.*got 'soon'"),
        ("sample_data", IMAGE, "width", 0, "an integer of at least 1; got 0"),
        ("sample_data", IMAGE, "filename", None, "must be a text; got None"),
        ("sample_data", IMAGE, "filename", "../x.jpg", "must be relative to .*without '..'"),
        ("sample_data", IMAGE, "filename", "out/secret.jpg", "leads through a link"),
        ("ego_pose", IMAGE, "rotation", [1, 0.1, 0, 0], "a quaternion wxyz of length 1; got"),
        ("ego_pose", IMAGE, "translation", [0, float("nan"), 0], "a list of 3 finite numbers"),
        ("ego_pose", IMAGE, "translation", [0, 10**400, 0], "a list of 3 finite numbers"),
        ("calibrated_sensor", CALIBRATION, "camera_intrinsic", [[10**400] * 3] * 3, "fx, 0"),
        ("calibrated_sensor", CALIBRATION, "sensor_token", "gone", r"a row of sensor\.json"),
        ("calibrated_sensor", CALIBRATION, "camera_intrinsic", [[1, 2], [3]], r"\[\[fx, 0, cx\]"),
        ("sample_annotation", BOX, "instance_token", "gone", r"a row of instance\.json"),
        ("sample_annotation", BOX, "visibility_token", "9", r"a row of visibility\.json, or empty"),
        ("sample_annotation", BOX, "attribute_tokens", ["x"], r"rows of attribute\.json"),
        ("sample_annotation", BOX, "size", [2, 0, 1], "width, length and height above 0"),
        ("sample_annotation", BOX, "num_lidar_pts", 1.5, "an integer of at least 0; got 1.5"),
        (
            "instance", files.instance_token(0, files.CAR), "category_token", "gone",
            r"a row of category\.json",
        ),
        ("sample", files.sample_token(0, 1), "timestamp", None, "a time in microseconds"),
    ],
)  # fmt: skip
def test_wrong_fields_name_table_row_and_field(copy, table, token, field, value, expected):
    outside = copy.parent / "outside"
    outside.mkdir()
    (outside / "secret.jpg").write_bytes(b"")
    (copy / "samples").unlink()
    (copy / "samples").mkdir()
    (copy / "samples" / "out").symlink_to(outside)
    if value == "out/secret.jpg":
        value = "samples/out/secret.jpg"
    edit(copy, table, token, lambda row: row.update({field: value}))
    with pytest.raises(AdapterError, match=expected) as error:
        tables(copy)
    assert f"{table}.json: row {token!r}: field {field!r}" in str(error.value)
    edit(copy, table, token, lambda row: row.pop(field))
    with pytest.raises(
        AdapterError, match=f"{table}.json: row {token!r}: field {field!r}.*no such"
    ):
        tables(copy)


@pytest.mark.parametrize("table", ["sample", "ego_pose"])
def test_tokens_are_unique(copy, table):
    content = files.read_table(copy, table)
    files.write_table(copy, table, [*content, content[0]])
    with pytest.raises(AdapterError, match=rf"{table}\.json: row .*an earlier row too.*unique"):
        tables(copy)


@pytest.mark.parametrize("table", ["scene", "sample_data", "sample_annotation", "category"])
def test_tables_are_whole(copy, table):
    path = copy / files.VERSION / f"{table}.json"
    text = path.read_text()
    for broken, message in {
        text[:-40]: r"is not readable JSON after its first \d+ rows",
        "": "must hold a list of rows; it starts with ''",
        json.dumps({"token": "x"}): "must hold a list of rows",
        "[1, 2]": "row number 0 must be an object; got int",
        '[{"name": "x"}]': "row number 0: field '[a-z_]+' must be a text; got no such field",
    }.items():
        path.write_text(broken)
        with pytest.raises(AdapterError, match=rf"{table}\.json.*{message}"):
            tables(copy)
    path.write_bytes(b"[\xff\xfe")
    with pytest.raises(AdapterError, match=rf"{table}\.json cannot be read as text"):
        tables(copy)
    path.unlink()
    message = "no nuScenes tables" if table == "scene" else rf"{table}\.json does not exist"
    with pytest.raises(AdapterError, match=message):
        tables(copy)


def test_a_scene_without_lidar_or_keyframes_is_an_error(copy):
    content = [r for r in files.read_table(copy, "sample_data") if r["fileformat"] == "jpg"]
    files.write_table(copy, "sample_data", content)
    with pytest.raises(AdapterError, match="no file of LIDAR_TOP for scene 'scene-0001'"):
        tables(copy)
    files.write_table(copy, "sample", [])
    with pytest.raises(AdapterError, match=r"sample\.json has no keyframe of this scene"):
        tables(copy)


@pytest.mark.parametrize("chunk", [1, 7, 1 << 20])
def test_rows_are_the_same_however_the_file_is_cut(monkeypatch, tmp_path, chunk):
    content = [{"token": str(i), "text": 'a ] } "\\ é ' * i, "list": [[i], []]} for i in range(9)]
    path = tmp_path / "table.json"
    monkeypatch.setattr(rows, "_CHUNK", chunk)
    for text in (json.dumps(content), "\n " + json.dumps(content, indent=2, ensure_ascii=False)):
        path.write_text(text, encoding="utf-8")
        assert [row.fields for row in rows.read_rows(path)] == content
        with pytest.raises(AdapterError, match=r"after its first 9 rows \(it is cut short"):
            path.write_text(text[:-1].rstrip(), encoding="utf-8")
            list(rows.read_rows(path))
    path.write_text(" [ ] ")
    assert list(rows.read_rows(path)) == []


def test_a_broken_table_is_not_read_to_its_end(monkeypatch, tmp_path):
    """What is no JSON is noticed after the longest row that there may be."""
    monkeypatch.setattr(rows, "_CHUNK", 1000)
    monkeypatch.setattr(rows, "_MAX_ROW", 5000)
    file = io.StringIO('[{"token": ' + "x" * 100_000)
    with pytest.raises(AdapterError, match="is not readable JSON after its first 0 rows"):
        list(rows._rows(tmp_path, file))
    assert file.tell() < 10_000
