"""A log of Argoverse 2: a street whose answer is known, and the one real log without images."""

from __future__ import annotations

import dataclasses
import io
import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pytest
from scipy.spatial.transform import Rotation

from adapters.av2.adapter import Av2Log, open_av2, read_av2
from adapters.av2.files import GroundMap, sensor_of_laser
from adapters.datasets import DATASETS
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.scene.cameras import Camera
from augment.scene.ground import ground_of
from augment.scene.labels import ClassifiesLidar, KnowsLidarOrigins
from augment.scene.semantics import SemanticClass
from tests.adapters import av2_files as files
from tests.adapters.shown import assert_same_bits

QUERY = {"voxel_m": "0.15", "image_scale": "1", "sky_size": "32"}
ORIGIN = np.round(files.city_from_ego(files.START_NS - 80_000_000)[:3, 3])
SAMPLE = Path("../shared/data/av2_sample/7fab2350-7eaf-3b7e-a39d-6937a4c1bede")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return files.write_as_av2(tmp_path_factory.mktemp("av2") / files.NAME)


@pytest.fixture(scope="module")
def scene(folder):
    return open_av2(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / files.NAME))


def test_images_between_sweeps_have_frames_of_their_own_where_asked(scene, folder):
    query = QUERY | {"images": "all"}
    whole = open_av2(str(folder), query)
    assert_same_bits(scene, dataclasses.replace(whole, frames=whole.frames[::2]))
    assert [frame.index for frame in whole.frames] == list(range(2 * len(scene.frames) - 1))
    times = [frame.timestamp_ns for frame in whole.frames]
    assert times == sorted(times)
    for frame, same in zip(scene.frames, whole.frames[::2], strict=True):
        assert dataclasses.replace(same, index=frame.index).image_paths == frame.image_paths
        assert same.timestamp_ns == frame.timestamp_ns
        assert len(whole.lidar(same.index)) == len(scene.lidar(frame.index))
        assert whole.boxes(same.index).track_ids == scene.boxes(frame.index).track_ids
    shown = [path for frame in whole.frames for path in frame.image_paths.values()]
    assert len(set(shown)) == len(shown) == len(whole.frames) * len(files.CAMERAS)
    between = whole.frames[3]
    assert whole.lidar(3) is None and len(whole.boxes(3)) == 0
    assert whole.labels.lidar_files(3) == () and whole.labels.lidar_files(99) == ()
    for name, camera in between.cameras.items():
        assert Path(between.image_paths[name]).stem == str(camera.timestamp_ns)
        car = files.city_from_ego(camera.timestamp_ns)[:3, 3] - ORIGIN
        centre = car + files.city_from_ego(camera.timestamp_ns)[:3, :3] @ mounting(scene, name)
        np.testing.assert_allclose(camera.centre, centre, atol=1e-3)
    labels = DATASETS["av2"].open_labels(str(folder), query)
    assert len(labels.lidar(2)) == len(scene.lidar(1)) and labels.lidar(1) is None


def mounting(scene, name: str) -> np.ndarray:
    """Where a camera is on the car."""
    return scene.labels.lenses[name].ego_from_camera[:3, 3]


def test_without_a_map_the_road_is_looked_for(copy):
    shutil.rmtree(copy / "map")
    scene = open_av2(str(copy), QUERY | {"voxel_m": "0.5", "frames": "0:1"})
    assert ground_of(scene).source != "map" and scene.problems == ()
    assert scene.labels.lidar_classes(scene.lidar(0)) is None
    # 16 bits hold a height of 0.3 m to a tenth of a millimetre, but x of 30 m to 1.6 cm.
    expected = files.GROUND_Z + files.CITY_FROM_STREET[2, 3] - ORIGIN[2]
    assert ground_of(scene).lowest_z_m == pytest.approx(expected, abs=0.02)


def test_sweeps_have_times_and_places_of_their_own(scene):
    assert ground_of(scene).source == "map"
    sweep, raw = scene.lidar(1), files.sweep(1)
    times = files.STAMPS_NS[1] + raw["offset_ns"].astype(np.int64)
    np.testing.assert_array_equal(sweep.columns["timestamp_ns"], times)
    for name in ("intensity", "laser_number"):
        np.testing.assert_array_equal(sweep.columns[name], raw[name])
    assert isinstance(scene.labels, KnowsLidarOrigins)
    origins = scene.labels.lidar_origins(1, sweep)
    for row in (0, 1000, -1):
        name = "up_lidar" if raw["laser_number"][row] < 32 else "down_lidar"
        expected = files.city_from_ego(int(times[row])) @ files.LIDARS[name][:, 3]
        np.testing.assert_allclose(origins[row], expected[:3], atol=2e-6)
    assert scene.labels.lidar(99) is None and scene.labels.lidar_origins(-1, sweep) is None


@pytest.mark.parametrize("rotation_deg", [0.0, 25.0])
def test_the_map_says_what_is_road(copy, rotation_deg):
    files.write_map(copy, rotation_deg=rotation_deg)
    labels = Av2Log.read(str(copy))
    assert isinstance(labels, ClassifiesLidar)
    assert pickle.loads(pickle.dumps(labels)).stamps_ns == labels.stamps_ns
    sweep = labels.lidar(2)
    classes, places = labels.lidar_classes(sweep), files.into_street(sweep.points_m)
    low = np.abs(places[:, 2] - files.GROUND_Z) < 0.05
    clear = np.abs(places[:, 1] - 4.0) > 0.5  # a cell's corner may lie across
    road = low & (places[:, 1] < 4)
    assert (classes[road & clear] == SemanticClass.ROAD).all() and (road & clear).sum() > 2000
    assert (classes[low & ~road & clear] == SemanticClass.TERRAIN).all()
    assert (classes[places[:, 2] > files.GROUND_Z + 0.25] == SemanticClass.UNKNOWN).all()
    far = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
    assert (labels.ground.classes(far) == SemanticClass.UNKNOWN).all()


@pytest.mark.parametrize("swapped", [False, True])
def test_lasers_are_matched_to_sensors_by_their_cones(swapped):
    rng = np.random.default_rng(0)
    lasers = rng.integers(0, 64, 40_000)
    sensors = (lasers >= 32) ^ swapped
    elevation = np.radians(-25 + 40 * (lasers % 32) / 31)
    bearing, distance = rng.uniform(0, 2 * np.pi, len(lasers)), rng.uniform(4, 60, len(lasers))
    flat = np.stack([np.cos(bearing), np.sin(bearing), np.tan(elevation)], 1) * distance[:, None]
    poses = np.stack(list(files.LIDARS.values()))[sensors.astype(int)]
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], flat) + poses[:, :3, 3]
    np.testing.assert_array_equal(sensor_of_laser(lasers, points, files.LIDARS), sensors)
    few = sensor_of_laser(lasers[:40], points[:40], files.LIDARS)  # too few to tell
    np.testing.assert_array_equal(few, lasers[:40] >= 32)


# ---- What is missing or damaged ------------------------------------------------------------------


def table(path: Path, **columns: object) -> Callable[[Path], None]:
    """Replace columns of a table; None takes one away."""

    def change(root: Path) -> None:
        found = feather.read_table(root / path)
        for name, value in columns.items():
            found = found.drop_columns([name])
            if value is not None:
                values = value(feather.read_table(root / path)[name].to_numpy().copy())
                found = found.append_column(name, pa.array(values))
        feather.write_feather(found, root / path)

    return change


def put(value: object, at: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[at] = value
        return values

    return change


def write(name: str, content: bytes | None) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        (path,) = root.glob(name)
        path.unlink() if content is None else path.write_bytes(content)

    return change


def feather_of_zeros(count: int) -> bytes:
    """A Feather file of some kB."""
    sink = io.BytesIO()
    feather.write_feather(pa.table({"qw": np.zeros(count, np.int8)}), sink, compression="zstd")
    return sink.getvalue()


POSES = Path("city_SE3_egovehicle.feather")
LENSES = Path("calibration/intrinsics.feather")
SENSORS = Path("calibration/egovehicle_SE3_sensor.feather")
BOXES = Path("annotations.feather")
REFUSED = {
    "no path": (write(str(POSES), None), r"is not a log .* it has no city_SE3_egovehicle\.feather"),
    "no table": (write(str(LENSES), b"ARROW1 no"), r"intrinsics\.feather is not a whole Feather"),
    "zeros without an end": (
        write(str(SENSORS), feather_of_zeros(9_000_000)),
        r"sensor\.feather is not a whole Feather table \(it states more than 8388608 rows",
    ),
    "lists in place of texts": (
        table(SENSORS, sensor_name=lambda v: [[name] for name in v]),
        r"sensor_name must hold texts; it holds list",
    ),
    "no lenses": (write(str(LENSES), None), r"intrinsics\.feather does not exist; copy it"),
    "no column": (table(POSES, qz=None), r"must have one column qz; it has \["),
    "texts": (table(POSES, qz=lambda v: v.astype(str)), r"qz must hold numbers .* holds string"),
    "float stamps": (
        table(POSES, timestamp_ns=lambda v: v.astype(np.float64)),
        r"timestamp_ns must hold whole numbers; it holds float64",
    ),
    "not finite": (table(POSES, tx_m=put(np.nan, 3)), r"row 3: tx_m, ty_m, tz_m must be finite"),
    "no rotation": (table(SENSORS, qw=put(2.0, 1)), r"row 1: .* quaternion of length 1; got \[2"),
    "twice": (
        table(POSES, timestamp_ns=lambda v: put(v[0], 1)(v)),
        r"two poses or more, of different timestamp_ns; it holds (\d+), of",
    ),
    "no lidar": (
        table(SENSORS, sensor_name=lambda v: put("roof", 3)(v)),
        r"has no row up_lidar; it has \['down_lidar', 'ring_",
    ),
    "no pose of a camera": (
        table(SENSORS, sensor_name=lambda v: put("front", 0)(v)),
        r"camera ring_front_center has no pose",
    ),
    "a path": (table(LENSES, sensor_name=lambda v: put("../up", 0)(v)), r"'\.\./up' cannot be a"),
    "no focal length": (table(LENSES, fx_px=put(0.0)), r"ring_front_center: fx_px, .* above 0"),
    "a null": (
        table(BOXES, tx_m=lambda v: [None, *v[1:]]),
        r"annotations\.feather: the column tx_m lacks 1 values",
    ),
    "heights": (write("map/*.npy", b"\x93NUMPY"), r"PIT\.npy is no whole \.npy file"),
    "no grid": (write("map/*Sim2*", None), r"has no \*___img_Sim2_city\.json, which places"),
    "a grid": (
        write("map/*Sim2*", json.dumps({"R": [1, 0, 0, 2], "t": [0, 0], "s": 1}).encode()),
        r"R must be a rotation, 4 numbers by rows; got \(1\.0, 0\.0, 0\.0, 2\.0\)",
    ),
    "areas": (
        write("map/log_map*", b'{"drivable_areas": {"7": {"area_boundary": [{"x": 1}]}}}'),
        r"PIT_city_1\.json: drivable_areas\.7\.area_boundary",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_damaged_logs_are_refused(copy, case):
    damage, message = REFUSED[case]
    damage(copy)
    with pytest.raises(AdapterError, match=message):
        Av2Log.read(str(copy))


def test_a_folder_of_logs_names_one(folder):
    with pytest.raises(AdapterError, match=rf"it holds logs, give one: av2:.*{files.NAME}"):
        Av2Log.read(str(folder.parent))


def test_what_single_frames_lack_is_said(copy):
    """Read without building the scene."""
    cameras = copy / "sensors/cameras"
    front, side, stereo = (sorted((cameras / name).iterdir()) for name in files.CAMERAS)
    front[0].rename(cameras / "ring_front_center" / f"{files.START_NS - 10**9}.jpg")
    side[5].unlink()
    front[5].write_bytes(front[5].read_bytes()[:300])
    shutil.rmtree(stereo[0].parent)
    (copy / f"sensors/lidar/{files.STAMPS_NS[3]}.feather").write_bytes(b"")
    (copy / f"sensors/lidar/{files.START_NS + 10**10}.feather").write_bytes(b"")
    (copy / BOXES).unlink()
    log = Av2Log.read(str(copy))
    drive = read_av2(log, "av2:log", DriveOptions.from_query("av2", {}))
    expected = (
        r"left out 1 sweeps before or after all poses",
        r"has no annotations\.feather: no boxes are known",
        r"camera ring_front_center: left out 1 images before or after all poses",
        r"camera ring_side_left: no image within 25 ms of 1 frame \(2\)",
        r"camera stereo_front_left: .* has no image of the frames",
        r"camera ring_front_center, frame 2: image .*\.jpg is cut short",
        r"frame 3: .*\.feather is not a whole Feather table",
    )
    assert len(drive.problems) == len(expected), drive.problems
    for pattern, problem in zip(expected, drive.problems, strict=True):
        assert re.search(pattern, problem), (pattern, problem)
    assert len(drive.sweeps) == 3 and drive.boxes == () and len(drive.frames) == 4
    assert "ring_side_left" not in drive.frames[2].cameras


# ---- The real log --------------------------------------------------------------------------------

needs_sample = pytest.mark.skipif(not SAMPLE.is_dir(), reason=f"{SAMPLE} is not there")


def sample_columns(name: str) -> dict[str, np.ndarray]:
    found = feather.read_table(SAMPLE / name)
    return {c: found[c].to_numpy() for c in found.column_names}


def sample_poses(columns: dict[str, np.ndarray]) -> np.ndarray:
    quats = np.stack([columns[f"q{axis}"] for axis in "xyzw"], 1)
    poses = np.tile(np.eye(4), (len(quats), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quats).as_matrix()
    poses[:, :3, 3] = np.stack([columns[f"t{axis}_m"] for axis in "xyz"], 1)
    return poses


@needs_sample
def test_boxes_of_the_real_log_hold_as_many_returns_as_it_says():
    log = Av2Log.read(str(SAMPLE))
    assert log.stamps_ns == (315966265259836000, 315966265360032000) and log.problems == ()
    counted = 0
    for number, returns in ((0, 99_229), (1, 99_466)):
        sweep, boxes = log.lidar(number), log.boxes(number)
        assert len(sweep) == returns and len(boxes) == 81
        turns = Rotation.from_quat(boxes.quats[:, [1, 2, 3, 0]]).as_matrix()
        for i in range(len(boxes)):
            local = (sweep.points_m - boxes.centers_m[i]) @ turns[i]
            # Coordinates of 16 bits lie on faces: by a nanometre on either side of them.
            inside = (np.abs(local) <= boxes.sizes_m[i] / 2 + 1e-6).all(axis=1).sum()
            counted += inside == boxes.attributes["num_interior_pts"][i]
    assert counted == 162


@needs_sample
def test_the_real_map_lies_under_the_real_returns_and_the_car():
    log = Av2Log.read(str(SAMPLE))
    path = log.city.poses[:, :3, 3]
    cells = np.floor(log.ground.cells(path[:, :2])).astype(int)
    above = path[:, 2] - log.ground.heights_m[cells[:, 1], cells[:, 0]]
    np.testing.assert_allclose([above.min(), np.median(above), above.max()], [0.24, 0.32, 0.40],
                               atol=0.01)  # fmt: skip
    classes = log.lidar_classes(log.lidar(0))
    share = np.bincount(classes, minlength=5) / len(classes)
    assert 0.10 < share[SemanticClass.ROAD] < 0.12
    assert 0.04 < share[SemanticClass.TERRAIN] < 0.07
    near = GroundMap.under(log.ground, path)
    assert len(near) > 10_000 and np.isfinite(near).all()


@needs_sample
def test_the_real_lasers_draw_cones_around_their_sensors():
    log = Av2Log.read(str(SAMPLE))
    for number in (0, 1):
        sweep = log.lidar(number)
        origins = log.lidar_origins(number, sweep)
        lasers = sweep.columns["laser_number"]
        poses = sample_poses(sample_columns("calibration/egovehicle_SE3_sensor.feather"))
        names = list(sample_columns("calibration/egovehicle_SE3_sensor.feather")["sensor_name"])
        first = log.city.at(sweep.columns["timestamp_ns"][:1])[0]
        sensor = "down_lidar" if lasers[0] >= 32 else "up_lidar"
        np.testing.assert_allclose(
            origins[0], (first @ poses[names.index(sensor)])[:3, 3], atol=1e-6
        )
        spreads = []
        for swap in (False, True):
            own = sensor_of_laser(lasers, np.zeros((len(lasers), 3)), log.ego_from_sensor) ^ swap
            spread = []
            for i, name in enumerate(("up_lidar", "down_lidar")):
                ego = np.linalg.inv(log.city.at(np.array([log.stamps_ns[number]]))[0])
                points = sweep.points_m[own == i] @ ego[:3, :3].T + ego[:3, 3]
                local = (points - log.ego_from_sensor[name][:3, 3]) @ log.ego_from_sensor[name][
                    :3, :3
                ]
                angle = np.degrees(np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1])))
                of = lasers[own == i]
                spread += [np.ptp(np.quantile(angle[of == n], (0.1, 0.9))) for n in np.unique(of)]
            spreads.append(np.median(spread))
        assert spreads[0] < 0.2 and spreads[1] > 1.5 * spreads[0]


@needs_sample
def test_points_of_the_real_log_fall_where_the_formula_puts_them(tmp_path):
    """cv_cam = inv(ego_SE3_cam) inv(city_SE3_ego(image)) city_SE3_ego(sweep) p, with blank images
    at times between poses."""
    root = Path(shutil.copytree(SAMPLE, tmp_path / "log"))
    lenses = sample_columns("calibration/intrinsics.feather")
    path = sample_columns(str(POSES))
    poses, knots = sample_poses(path), path["timestamp_ns"]
    sensors = sample_columns("calibration/egovehicle_SE3_sensor.feather")
    ego_from = dict(zip(sensors["sensor_name"], sample_poses(sensors), strict=True))
    stamp = 315966265259836000
    times = {
        name: stamp - 24_000_000 + 6_000_001 * i for i, name in enumerate(lenses["sensor_name"])
    }
    for i, (name, time) in enumerate(times.items()):
        image = np.full((lenses["height_px"][i], lenses["width_px"][i], 3), 99, np.uint8)
        target = root / "sensors/cameras" / name / f"{time}.jpg"
        target.parent.mkdir(parents=True)
        assert cv2.imwrite(str(target), image)
    options = DriveOptions.from_query("av2", {"frames": "0:1"})
    drive = read_av2(Av2Log.read(str(root)), "av2:log", options)
    assert drive.problems == () and len(drive.frames[0].cameras) == 9
    assert drive.grey_cameras == set(times)
    table = feather.read_table(SAMPLE / f"sensors/lidar/{stamp}.feather")
    points = np.stack([table[axis].to_numpy().astype(np.float64) for axis in "xyz"], 1)
    boxes = drive.labels.boxes(0)
    compared = 0
    for i, (name, time) in enumerate(times.items()):
        after = int(np.searchsorted(knots, time))
        span = int(knots[after] - knots[after - 1])
        part = int(time - knots[after - 1]) / span
        a, b = poses[after - 1], poses[after]
        vector = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
        at_image = np.eye(4)
        at_image[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(part * vector).as_matrix()
        at_image[:3, 3] = a[:3, 3] + part * (b[:3, 3] - a[:3, 3])
        at_sweep = poses[list(knots).index(stamp)]
        chain = np.linalg.inv(ego_from[name]) @ np.linalg.inv(at_image) @ at_sweep
        own = drive.frames[0].cameras[name]
        centres = (boxes.centers_m - at_sweep[:3, 3]) @ at_sweep[:3, :3]
        both = np.concatenate([points, centres])
        cv = both @ chain[:3, :3].T + chain[:3, 3]
        front = cv[:, 2] > 1.0
        lens = {key: lenses[f"{key}_px"][i] for key in ("fx", "fy", "cx", "cy")}
        u = lens["fx"] * cv[front, 0] / cv[front, 2] + lens["cx"]
        v = lens["fy"] * cv[front, 1] / cv[front, 2] + lens["cy"]
        seen = (np.abs(u - 775) < 1200) & (np.abs(v - 1024) < 1200)
        city = both @ at_sweep[:3, :3].T + at_sweep[:3, 3] - drive.world_origin_m
        ours = project(own, city[front])
        # The dataset counts whole numbers at the middle of pixels, we at +0.5.
        np.testing.assert_allclose(ours[seen], np.stack([u, v], 1)[seen] + 0.5, atol=1e-3)
        compared += int(seen.sum())
    assert compared > 50_000


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    pose = camera.camera_from_world.numpy()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
