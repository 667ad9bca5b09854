"""A nuScenes scene: a street whose answer is known, and the one real keyframe."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.base import detect_scheme_of_path
from adapters.nuscenes.adapter import EGO_BOX_M, nuscenes_labels, open_nuscenes
from adapters.nuscenes.tables import read_rows, read_tables
from augment.errors import AdapterError
from augment.scene.labels import ClassifiesLidar
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from tests.adapters import nuscenes_files as files
from tests.adapters import street
from tests.adapters.shown import psnr, render

ONE, TWO = files.SCENES
QUERY = {"scene": TWO, "voxel_m": "0.15", "image_scale": "1", "sky_size": "32"}
QUICK = {"scene": ONE, "voxel_m": "0.5", "image_scale": "0.5", "sky_size": "8"}
ORIGIN = np.array([2100.0, 900.0, 3.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return files.write_as_nuscenes(tmp_path_factory.mktemp("nuscenes") / "data")


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


def test_returns_of_the_recording_car_are_in_the_labels_only(scene):
    points, _ = files.sweep(0)
    own = points[-2:]
    np.testing.assert_allclose(into_street(scene.lidar(0).points_m[-2:] - ORIGIN), own, atol=1e-5)
    assert _nearest_to_own_returns(scene) > 0.5


def _nearest_to_own_returns(scene: Scene) -> float:
    """Distance in metres from where the recording car's own returns were to the next Gaussian."""
    means = into_street(scene.background.means.numpy().astype(np.float64))
    path = np.arange(0, 8.1, 0.4)[:, None] * [1, 0, 0]
    places = np.concatenate([own + path for own in files.sweep(0)[0][-2:]])
    return min(np.linalg.norm(means - place, axis=1).min() for place in places)


def test_own_returns_are_known_without_classes(tmp_path):
    root = files.write_as_nuscenes(tmp_path / "data", semantic=False)
    plain = open_nuscenes(str(root), QUERY | {"voxel_m": "0.3"})
    assert plain.problems == () and len(plain.actors) == 1
    assert "semantic" not in plain.lidar(0).columns
    assert (plain.background.semantic == SemanticClass.UNKNOWN).all()
    assert plain.ground_z_m == pytest.approx(street.GROUND_Z, abs=0.02)
    assert _nearest_to_own_returns(plain) > 0.4  # a voxel is 0.3 m


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


def test_a_few_frames_between_keyframes_have_their_tracks(folder):
    scene = open_nuscenes(str(folder), QUICK | {"frames": "6:9"})
    assert [f.index for f in scene.frames] == [6, 7, 8]
    car = next(a for a in scene.actors if a.label == "vehicle.car")
    pose = car.track.pose_at(scene.frame(7).timestamp_ns)
    np.testing.assert_allclose(pose[:3, 3], street.car_centre(0.7), atol=2e-3)


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


def test_a_quarter_of_the_real_returns_are_the_cars_own(real):
    pose = real.frame(0).world_from_ego.numpy()
    world = real.lidar(0).points_m - real.world_origin_m
    ego = (world - pose[:3, 3]) @ pose[:3, :3]
    own = ((ego > EGO_BOX_M[0]) & (ego < EGO_BOX_M[1])).all(axis=1)
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
        # 0.81 to 0.92 and 17.6 to 23.7 dB when measured; the lowest are of the front left camera,
        # at whose border a truck stands of which no image of that camera shows the side.
        alike = np.corrcoef(image[low:].ravel(), recorded[low:].ravel())[0, 1]
        assert alike > 0.8 and psnr(image, recorded) > 17.4, (name, alike)


def _carried(pose, points: np.ndarray) -> np.ndarray:
    pose = np.array(pose)
    return points @ pose[:3, :3].T + pose[:3, 3]


@pytest.fixture
def own_tables(folder, tmp_path) -> Path:
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
    assert (*image.size, image.intrinsic) == (160, 96, (80.0, 80.0, 80.0, 48.0))
    np.testing.assert_allclose(image.world_from_ego, files.world_from_ego(1, 0.202), atol=1e-9)
    np.testing.assert_allclose(
        image.ego_from_sensor, files.ego_from_camera("CAM_FRONT_LEFT"), atol=1e-12
    )
    assert read.class_names[24] == "flat.driveable_surface" and len(read.semantic_files) == 3


def test_boxes_are_the_keyframes_own(folder):
    labels = nuscenes_labels(str(folder), {"scene": TWO, "sweeps": "0"})
    boxes = labels.boxes(1)
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


def test_rotations_take_the_shorter_way(own_tables):
    key = files.instance_token(0, files.CAR)
    yaws = np.radians([170.0, 190.0])
    for i, yaw in enumerate(yaws):
        quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
        if i == 1:
            quat = [-v for v in quat]  # the same rotation
        token = files.token("annotation", key, files.sample_token(0, i))
        edit(own_tables, "sample_annotation", token, lambda row, q=quat: row.update(rotation=q))
    w, x, y, z = nuscenes_labels(str(own_tables), {"scene": ONE}).boxes(2).quats[0]
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


def test_unlike_cameras_tell_no_turn(own_tables, folder):
    assert np.degrees(tables(folder).turn.end_rad) == pytest.approx(files.TURN_END_DEG, abs=0.5)
    content = files.read_table(own_tables, "sample_data")
    for row in content:
        if "CAM_FRONT__" in row["filename"]:
            row["timestamp"] += 20_000  # of a turn of 50 ms
    files.write_table(own_tables, "sample_data", content)
    assert tables(own_tables).turn.end_rad is None
    times = nuscenes_labels(str(own_tables), {"scene": ONE}).lidar(3).columns["timestamp_ns"]
    assert set(times.tolist()) == {files.sweep_times_us(0)[3] * 1000}
    alone = [row for row in content if "CAM_FRONT__" not in row["filename"]]
    files.write_table(own_tables, "sample_data", alone)
    assert tables(own_tables).turn.end_rad is None


def test_frames_name_their_rows(folder):
    found = frame_files(str(folder), {"scene": TWO})
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
    keys = frame_files(str(folder), {"scene": TWO, "sweeps": "0", "frames": "1:2"})
    assert [sorted(f) for f in keys.values()] == [["CAM_FRONT", "CAM_FRONT_LEFT", "LIDAR_TOP"]] * 3
    assert keys[1]["CAM_FRONT"].token == found[5]["CAM_FRONT"].token
    labels = nuscenes_labels(str(folder), {"scene": TWO, "sweeps": "0"})
    assert not any(labels.boxes(i).attributes["interpolated"].any() for i in range(3))


def test_an_image_is_used_once_and_far_ones_are_said_to_have_no_frame(own_tables):
    content = files.read_table(own_tables, "sample_data")
    ours = {files.data_token(0, "CAM_FRONT", i): i for i in range(files.IMAGES)}
    start = files.START_US[0]
    # Two non-key images nearest to the sweep at 0.2 s: one goes to its next neighbour. The key
    # image of 0.5 s stays with its keyframe although another sweep is nearer to it.
    moved = {1: start + 205_000, 2: start + 420_000, 3: start + 215_000}
    for row in content:
        if ours.get(row["token"]) in moved:
            row["timestamp"] = moved[ours[row["token"]]]
    files.write_table(own_tables, "sample_data", content)
    found = frame_files(str(own_tables), {"scene": ONE})
    used = {i: ours[f["CAM_FRONT"].token] for i, f in found.items() if "CAM_FRONT" in f}
    assert used == {0: 0, 2: 1, 3: 3, 5: 2, 10: 4}
    for row in content:
        if ours.get(row["token"]) == 3:
            row["timestamp"] = start + 9_000_000
    files.write_table(own_tables, "sample_data", content)
    (problem,) = open_nuscenes(str(own_tables), QUICK | {"scene": ONE}).problems
    assert "camera CAM_FRONT: 1 of 5 images have no frame" in problem


def test_the_only_version_and_scene_need_no_name(tmp_path):
    root = files.write_as_nuscenes(tmp_path / "test", version="v1.0-test", scenes=[TWO])
    read = tables(root, None)
    assert (read.version, read.name) == ("v1.0-test", TWO)
    assert tables(root, files.token("scene", TWO)).name == TWO


def test_tables_of_other_writers_go_by_any_folder_name_and_may_begin_with_a_mark(tmp_path):
    root = files.write_as_nuscenes(tmp_path / "test", version="converted", scenes=[TWO])
    for path in (root / "converted").glob("*.json"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert detect_scheme_of_path(root) == "nuscenes"
    assert tables(root, None).version == "converted"
    shutil.copytree(root / "converted", root / "v1.0-mini")
    assert tables(root, None).version == "v1.0-mini"  # the dataset's own name comes first
    assert read_tables(root, "converted", None).version == "converted"


IMAGE = files.data_token(0, "CAM_FRONT", 1)
BOX = files.token("annotation", files.instance_token(0, files.CAR), files.sample_token(0, 0))
CALIBRATION = files.token("calibration", ONE, "CAM_FRONT")
CAR = files.instance_token(0, files.CAR)
WRONG_FIELDS = [
    ("sample_data", IMAGE, "ego_pose_token", "gone", r"a row of ego_pose\.json.*got 'gone'"),
    ("sample_data", IMAGE, "calibrated_sensor_token", "gone", r"of calibrated_sensor\.json"),
    ("sample_data", IMAGE, "is_key_frame", 1, "be a valid boolean; got 1"),
    ("sample_data", IMAGE, "timestamp", "soon", "be a valid integer; got 'soon'"),
    ("sample_data", IMAGE, "width", 0, "be greater than or equal to 1; got 0"),
    ("sample_data", IMAGE, "filename", None, "be a valid string; got None"),
    ("sample_data", IMAGE, "filename", "\ud800.jpg", "be a valid string"),
    ("sample_data", IMAGE, "filename", "../x.jpg", "must be relative to .*without '..'"),
    ("sample_data", IMAGE, "filename", "samples/out/secret.jpg", "leads through a link"),
    ("ego_pose", IMAGE, "rotation", [1, 0.1, 0, 0], "a quaternion wxyz of length 1; got"),
    ("ego_pose", IMAGE, "translation", [0, float("nan"), 0], "1 must be a finite number; got nan"),
    ("ego_pose", IMAGE, "translation", [0, 10**400, 0], "1 must be a valid number"),
    ("calibrated_sensor", CALIBRATION, "sensor_token", "gone", r"a row of sensor\.json"),
    ("calibrated_sensor", CALIBRATION, "camera_intrinsic", [[1, 2], [3]], "camera_intrinsic"),
    ("calibrated_sensor", CALIBRATION, "camera_intrinsic", [[0] * 3] * 3, r"\[\[fx, 0, cx\]"),
    ("sample_annotation", BOX, "instance_token", "gone", r"a row of instance\.json"),
    ("sample_annotation", BOX, "visibility_token", "9", r"a row of visibility\.json, or empty"),
    ("sample_annotation", BOX, "attribute_tokens", ["x"], r"rows of attribute\.json"),
    ("sample_annotation", BOX, "size", [2, 0, 1], "size.1 must be greater than 0; got 0"),
    ("sample_annotation", BOX, "num_lidar_pts", 1.5, "be a valid integer; got 1.5"),
    ("instance", CAR, "category_token", "gone", r"a row of category\.json"),
    ("sample", files.sample_token(0, 1), "timestamp", None, "be a valid integer; got None"),
]


def test_wrong_fields_name_table_row_and_field(own_tables, folder):
    outside = own_tables.parent / "outside"
    outside.mkdir()
    (outside / "secret.jpg").write_bytes(b"")
    (own_tables / "samples").unlink()
    (own_tables / "samples").mkdir()
    (own_tables / "samples" / "out").symlink_to(outside)
    for table, token, field, value, expected in WRONG_FIELDS:
        whole = files.read_table(own_tables, table)
        for change in (lambda row: row.update({field: value}), lambda row: row.pop(field)):  # noqa: B023
            edit(own_tables, table, token, change)
            with pytest.raises(
                AdapterError, match=rf"{table}\.json: row {token!r}: .*{field}"
            ) as error:
                tables(own_tables)
            assert re.search(f"{expected}|no such field|is missing", str(error.value))
            files.write_table(own_tables, table, whole)


@pytest.mark.parametrize("table", ["scene", "sample_data", "category"])
def test_tables_are_whole(own_tables, table):
    path = own_tables / files.VERSION / f"{table}.json"
    text = path.read_text()
    broken = {
        text[:-40]: r"is not readable JSON after its first \d+ rows",
        "": "must hold a list of rows; it starts with ''",
        json.dumps({"token": "x"}): "must hold a list of rows",
        "[1, 2]": "row number 0 must be an object; got int",
        '[{"name": "x"}]': "row number 0: field '[a-z_]+' must be a text; got no such field",
        json.dumps(json.loads(text) * 2): "row .*an earlier row too.*unique",
        '[{"token": ' + "x" * 20_000_000: "is not readable JSON after its first 0 rows",
    }
    for content, message in broken.items():
        path.write_text(content)
        with pytest.raises(AdapterError, match=rf"{table}\.json.*{message}"):
            tables(own_tables)
    path.write_bytes(b"[\xff\xfe")
    with pytest.raises(AdapterError, match=rf"{table}\.json cannot be read as text"):
        tables(own_tables)
    path.unlink()
    message = "no nuScenes tables" if table == "scene" else rf"{table}\.json does not exist"
    with pytest.raises(AdapterError, match=message):
        tables(own_tables)


def test_rows_are_the_same_wherever_the_file_is_cut(tmp_path):
    """A table is read in pieces of some megabytes, which end anywhere in its rows."""
    content = [
        {"token": str(i), "text": 'a ] } "\\ é ' * 30_000, "list": [[i], []]} for i in range(30)
    ]
    path = tmp_path / "table.json"
    for text in (json.dumps(content), "\n " + json.dumps(content, indent=2, ensure_ascii=False)):
        path.write_text(text, encoding="utf-8")
        assert [row.fields for row in read_rows(path)] == content
        path.write_text(text[:-1].rstrip(), encoding="utf-8")
        with pytest.raises(AdapterError, match=r"after its first 30 rows \(it is cut short"):
            list(read_rows(path))
    path.write_text(" [ ] ")
    assert list(read_rows(path)) == []


def test_without_images_or_returns_there_is_no_scene(copy):
    for query, message in (
        ({"frames": "1:2"}, r"no usable image in 1 frame \(1\)"),
        ({"frames": "5:7", "held_out": "5:6"}, r"no usable image in 1 frame \(6\) that are not"),
        ({"frames": "20:30"}, r"frames=20:30 selects none of the 11 frames"),
        (
            {"voxels": "1"},
            r"'voxels'; did you mean 'voxel_m'. allowed are .*; version: .*; sweeps: ",
        ),
        ({"sweeps": "yes"}, "sweeps must be 1 for keyframes and .*got 'yes'"),
    ):
        with pytest.raises(AdapterError, match=message):
            open_nuscenes(str(copy), QUICK | query)
    sweeps = [copy / files.filename(0, "LIDAR_TOP", number) for number in range(files.SWEEPS)]
    for path in sweeps:
        path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(AdapterError, match=r"unpack .*; frame 0: .*pcd\.bin .* it is cut short"):
        open_nuscenes(str(copy), QUICK)
    for path in sweeps:
        path.unlink()
    with pytest.raises(
        AdapterError, match=r"no LiDAR returns in 11 frames .*; the LiDAR's files of"
    ):
        open_nuscenes(str(copy), QUICK)
    for number in range(files.IMAGES):
        path = copy / files.filename(0, "CAM_FRONT", number)
        cv2.imwrite(str(path), np.zeros((48, 80, 3), np.uint8))
    with pytest.raises(AdapterError, match=r"none of the 5 images of camera CAM_FRONT .* 160x96"):
        open_nuscenes(str(copy), QUICK)


def test_tables_without_a_scene_are_refused(folder, own_tables, tmp_path):
    many = "v1.0-trainval"
    rows = files.read_table(own_tables, "scene")
    scenes = [{**rows[0], "token": f"t{i}", "name": f"scene-{max(i, 1):04d}"} for i in range(850)]
    found = [
        (folder, None, None, f"holds 2 scenes; add scene= .*: {ONE}, {TWO}$"),
        (folder, None, "scene-9", f"no scene 'scene-9'; it has 2: {ONE}, {TWO}"),
        (own_tables, None, ONE, r"several versions.*v1\.0-mini, v1\.0-trainval"),
        (own_tables, "v1.0-test", ONE, r"no tables of version=v1\.0-test; it has v1\.0-mini"),
        (own_tables, many, None, r"holds 850 scenes.*scene-0009 and 840 more$"),
        (own_tables, many, "scene-0001", "2 scenes 'scene-0001'; give a token: t0, t1"),
        (tmp_path / "nothing", None, None, "is not a folder"),
        (tmp_path, None, None, r"holds no nuScenes tables .* unpack the meta"),
        (folder / files.VERSION, None, None, f"give the folder above it, {folder}$"),
        (folder / "samples", None, None, f"give the folder above it, {folder}$"),
    ]
    shutil.copytree(own_tables / files.VERSION, own_tables / many)
    files.write_table(own_tables, "scene", scenes, many)
    for root, version, scene, message in found:
        with pytest.raises(AdapterError, match=message):
            read_tables(root, version, scene)
    images = [r for r in files.read_table(own_tables, "sample_data") if r["fileformat"] == "jpg"]
    files.write_table(own_tables, "sample_data", images)
    with pytest.raises(AdapterError, match="no file of LIDAR_TOP for scene 'scene-0001'"):
        read_tables(own_tables, files.VERSION, ONE)
    files.write_table(own_tables, "sample", [])
    with pytest.raises(AdapterError, match=r"sample\.json has no keyframe of this scene"):
        read_tables(own_tables, files.VERSION, ONE)


VARIABLE = "CLIMATEGS_NUSCENES_DEVKIT"
SCRIPT = """
import json, os, sys
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from pyquaternion import Quaternion

data = NuScenes(version="v1.0-mini", dataroot=sys.argv[1], verbose=False)
rows = {}
for row in data.sample_data:
    assert os.path.isfile(data.get_sample_data_path(row["token"])), row["filename"]
    found = {"channel": row["channel"], "boxes": [
        [*box.center, *box.wlh, *box.orientation.rotation_matrix.ravel(), box.name, box.token]
        for box in data.get_boxes(row["token"])
    ]}
    if row["channel"] == "LIDAR_TOP":
        cloud = LidarPointCloud.from_file(data.get_sample_data_path(row["token"]))
        for table in ("calibrated_sensor", "ego_pose"):
            pose = data.get(table, row[table + "_token"])
            cloud.rotate(Quaternion(pose["rotation"]).rotation_matrix)
            cloud.translate(np.array(pose["translation"]))
        found["points"] = cloud.points[:3, ::97].T.tolist()
        found["count"] = cloud.points.shape[1]
    rows[row["token"]] = found
for sample in data.sample:
    for token in sample["data"].values():
        assert os.path.isfile(data.get_sample_data(token)[0])
for table in data.map:
    assert os.path.isfile(table["mask"].img_file)
print(json.dumps({"scenes": [scene["name"] for scene in data.scene], "rows": rows}))
"""


@pytest.fixture(scope="module")
def python() -> str:
    path = os.environ.get(VARIABLE)
    if not path:
        pytest.skip(
            f"{VARIABLE} is not set to the Python of an environment with the official devkit; make "
            f"one: python -m venv devkit && devkit/bin/pip install nuscenes-devkit==1.2.0, then "
            f"{VARIABLE}=devkit/bin/python"
        )
    return path


def read_by_devkit(python: str, root: Path) -> dict:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [python, "-c", SCRIPT, str(root)],
        capture_output=True, text=True, timeout=300, env=environment, cwd=root,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def assert_same_labels(found: dict, root: Path, query: dict[str, str]) -> None:
    labels = nuscenes_labels(str(root), query)
    for number, channels in frame_files(str(root), query).items():
        theirs = found["rows"][channels["LIDAR_TOP"].token]
        boxes, sweep = labels.boxes(number), labels.lidar(number)
        assert len(boxes) == len(theirs["boxes"]) and len(sweep) == theirs["count"]
        # Their returns are float32 in the global world: a tenth of a millimetre at 2 km.
        np.testing.assert_allclose(sweep.points_m[::97], theirs["points"], atol=1e-3)
        for i, box in enumerate(theirs["boxes"]):
            assert (boxes.labels[i], boxes.attributes["token"][i]) == (box[15], box[16])
            np.testing.assert_allclose(boxes.centers_m[i], box[:3], atol=1e-9)
            np.testing.assert_array_equal(boxes.sizes_m[i][[1, 0, 2]], box[3:6])
            w, x, y, z = boxes.quats[i] / np.linalg.norm(boxes.quats[i])
            forward = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
            np.testing.assert_allclose(forward, np.reshape(box[6:15], (3, 3))[:, 0], atol=1e-7)


def test_the_devkit_reads_the_street(python, tmp_path):
    root = files.write_as_nuscenes(tmp_path / "data")
    found = read_by_devkit(python, root)
    assert found["scenes"] == list(files.SCENES)
    per_scene = files.SWEEPS + files.IMAGES * len(files.CAMERAS)
    assert len(found["rows"]) == per_scene * len(files.SCENES)
    for scene in files.SCENES:
        assert_same_labels(found, root, {"scene": scene})


def test_the_devkit_reads_the_real_keyframe(python, shared_dir, tmp_path):
    source = shared_dir / "data/nuscenes_keyframe"
    if not (source / "info.json").is_file():
        pytest.skip(f"no nuScenes keyframe at {source}")
    root = files.write_keyframe(tmp_path / "data", source)
    found = read_by_devkit(python, root)
    assert len(found["rows"]) == 7
    assert_same_labels(found, root, {})


def frame_files(root: str, query: dict[str, str]) -> dict:
    """By frame and channel, the rows of sample_data."""
    frames = nuscenes_labels(root, query).frames
    return {f.index: {x.channel: x for x in (f.sweep, *f.images.values())} for f in frames}
