"""Segments of the Waymo Open Dataset v2, written by `waymo_files` without the adapter's code."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from adapters.base import detect_scheme_of_path, open_scene
from adapters.raw_drive import IncompleteDrive, RawDrive
from adapters.waymo.adapter import WaymoOptions, read_waymo, waymo_labels
from adapters.waymo.tables import Rows, SegmentFiles
from augment.effects.lidar.beam import find_reflectances
from augment.errors import AdapterError
from augment.files.recorded_images import ImageFault, decode_image, has_image, is_whole_jpeg
from augment.photo.lidar_view import lidar_top_rad
from augment.scene.semantics import SemanticClass
from tests.adapters import waymo_files as files
from tests.adapters.waymo_files import DRIVER, ORIGIN, PARKED, Form, Rig, Street, car_pose, changed

RIG = Rig()
STAMPS = files.stamps_of(3, 2)
SAMPLE = Path(__file__).parents[2] / "../shared/data/waymo_v2_sample"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return files.write_as_waymo(tmp_path_factory.mktemp("waymo"))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/climategs"


@pytest.fixture
def copy(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "copy"))


def read(root: Path, **query: str) -> RawDrive:
    return read_waymo(str(root), query, WaymoOptions.from_query("waymo", query))


def on_surfaces(points: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """How far points are from the nearest surface of the street, metres, [N]."""
    street = Street((DRIVER, PARKED))
    found = [np.abs(points[:, 2] - ORIGIN[2]), np.abs((points - street.wall) @ street.normal)]
    for box in street.boxes:
        local = np.abs((points - box.place(seconds)) @ files.turn(2, box.yaw)) - box.size / 2
        found.append(np.where((local < 0.01).all(1), np.abs(local).min(1), np.inf))
    return np.min(found, axis=0)


@pytest.mark.parametrize("form", [Form(), Form(older=True, is_alone=True, rows_in_group=1)])
def test_returns_lie_on_what_they_were_cast_at(form: Form, tmp_path: Path) -> None:
    root = files.write_as_waymo(tmp_path / "data", form=form)
    labels = waymo_labels(str(root), {})
    street = Street((DRIVER, PARKED))
    for frame in (2, 0, 1):  # as in any order
        sweep, stamp = labels.lidar(frame), STAMPS[frame]
        scans = [files.scan_of(RIG, street, n, stamp) for n in range(5)]
        first = sweep.columns["return_number"] == 1
        for n, scan in enumerate(scans):
            own = sweep.columns["sensor"] == n + 1
            assert (own & first).sum() == (scan.first[..., 0] > 0).sum() > 50
            assert (own & ~first).sum() == (0 if n == 2 else (scan.second[..., 0] > 0).sum())
        seconds = sweep.columns["timestamp_ns"] * 1e-9 - files.T0
        at_pose = sweep.columns["sensor"] > 1
        np.testing.assert_allclose(seconds[at_pose], stamp + files.POSES_S[0], atol=2e-6)
        assert 0 <= seconds[~at_pose].min() - stamp < 0.05 < seconds[~at_pose].max() - stamp < 0.1
        # Places of 22 km in float32, as the dataset has those of pixels, are 1 mm off at most.
        assert on_surfaces(sweep.points_m[first], seconds[first]).max() < 2e-3
        origins = labels.lidar_origins(frame, sweep)
        for i in np.linspace(0, len(sweep) - 1, 40).astype(int):
            mount = files.laser_extrinsic(sweep.columns["sensor"][i] - 1)[:, 3]
            expected = (car_pose(seconds[i]) @ mount)[:3]
            np.testing.assert_allclose(origins[i], expected, rtol=0, atol=2e-3)
        # The second image of a beam is half a metre further along it.
        is_top = sweep.columns["sensor"] == 1
        picks = (first & is_top, ~first & is_top)
        beams = [sweep.points_m[pick] - origins[pick] for pick in picks]
        lengths = [np.linalg.norm(beam, axis=1) for beam in beams]
        units = [beam / length[:, None] for beam, length in zip(beams, lengths, strict=True)]
        nearest = (units[1] @ units[0].T).argmax(1)
        assert np.abs(lengths[1] - lengths[0][nearest] - 0.5).max() < 1e-5
        assert sweep.columns["in_no_label_zone"].tolist() == (~first).tolist()


def test_a_sweeps_columns_and_classes(written: Path) -> None:
    labels = pickle.loads(pickle.dumps(waymo_labels(str(written), {})))
    sweep = labels.lidar(1)
    raw = sweep.columns["raw_intensity"]
    assert raw.max() > 1000 and np.isclose(np.median(raw), 0.3)
    np.testing.assert_allclose(sweep.columns["intensity"], np.tanh(raw))
    assert np.isclose(
        np.median(find_reflectances(sweep)), np.tanh(0.3)
    )  # weather takes them for fractions
    classes = labels.lidar_classes(sweep)
    is_top, points = sweep.columns["sensor"] == 1, sweep.points_m
    first = sweep.columns["return_number"] == 1
    wall = is_top & first & (np.abs((points - Street().wall) @ Street().normal) < 0.01)
    assert (classes[wall] == SemanticClass.BUILDING).all() and wall.sum() > 50
    assert (classes[is_top & ~wall & first] == SemanticClass.ROAD).mean() > 0.9
    assert (classes[~is_top] == SemanticClass.UNKNOWN).all()
    assert "semantic" not in labels.lidar(0).columns
    assert labels.lidar_classes(labels.lidar(0)) is None
    assert labels.lidar(3) is None and len(labels.boxes(3)) == 0
    part = dataclasses.replace(
        sweep,
        columns={n: c[5:9] for n, c in sweep.columns.items()} | {"source_index": np.arange(5, 9)},
    )
    origins = labels.lidar_origins(1, part)
    np.testing.assert_array_equal(origins, labels.lidar_origins(1, sweep)[5:9])


def test_returns_take_the_classes_of_segmented_images(tmp_path: Path) -> None:
    root = files.write_as_waymo(tmp_path, frames=2, segmented=(), pictured=(1,))
    labels = waymo_labels(str(root), {})
    assert labels.lidar_classes(labels.lidar(0)) is None
    sweep = labels.lidar(1)
    classes, seen = labels.lidar_classes(sweep), sweep.columns["camera_class"]
    first = (sweep.columns["return_number"] == 1) & (seen > 0)
    assert set(np.unique(seen)) <= {0, 1, 2, 19, 20, 25}
    street, points = Street((DRIVER, PARKED)), sweep.points_m
    is_wall = np.abs((points - street.wall) @ street.normal) < 0.01
    is_road = np.abs(points[:, 2] - ORIGIN[2]) < 0.01
    # Cameras and lasers stand apart, so edges differ.
    for part, expected in (
        (is_wall & ~is_road, SemanticClass.BUILDING),
        (is_road & ~is_wall, SemanticClass.ROAD),
        (~is_wall & ~is_road, SemanticClass.VEHICLE),
    ):
        own = part & first & (seen != 1)
        assert own.sum() > 20 and (classes[own] == expected).mean() > 0.9
    assert (classes[(seen <= 1) | (seen == 25)] == SemanticClass.UNKNOWN).all()
    assert 0.2 < first.mean() < 0.9


def test_points_project_to_a_thousandth_of_a_pixel(written: Path) -> None:
    """Through the scene's pinhole camera and the lens against the dataset's formulas: the pose at
    the middle of the readout, the extrinsic with x out of the lens, OpenCV's model."""
    drive = read(written)
    rng = np.random.default_rng(0)
    for frame, stamp in zip(drive.frames, STAMPS, strict=True):
        for n, name in enumerate(files.CAMERA_NAMES):
            middle = stamp + files.MIDDLES_S[n]
            camera, mount = frame.cameras[name], drive.labels.segment.cameras[name]
            assert abs(camera.timestamp_ns * 1e-9 - files.T0 - middle) < 2e-6
            world_from_camera = car_pose(middle) @ files.camera_extrinsic(n)
            local = np.column_stack(
                [rng.uniform(3, 40, 50), rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.25, 0.25, 50)]
            )
            local[:, 1:] *= local[:, :1]
            points = local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
            expected = np.column_stack(files.pixels_of(RIG, n, middle, points)[:2])
            seen = (points - drive.world_origin_m) @ camera.camera_from_world.numpy()[:3, :3].T
            seen += camera.camera_from_world.numpy()[:3, 3]
            u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
            v = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
            rays = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
            found = np.column_stack(mount.lens.project(*rays)[:2])
            # Going on with a velocity over 4 ms of a bend at 1 m/s2 leaves 8 micrometres.
            assert np.abs(found - expected).max() < 2e-3


def waves(rig: Rig, _world: object, number: int, _seconds: float) -> np.ndarray:
    """A smooth picture of the recorded rays' directions: periods of about 12 pixels."""
    return _waves(rig.rays(number), rig.focal)


def _waves(rays: np.ndarray, focal: float) -> np.ndarray:
    phases = rays[..., :2] * focal * 2 * np.pi / 12
    grey = np.sin(phases[..., 0]) + np.sin(phases[..., 1])  # JPEGs halve the size of colours
    return np.repeat(np.round(128 + 60 * grey)[..., None], 3, axis=2).astype(np.uint8)


def test_images_are_what_a_pinhole_camera_would_have_recorded(tmp_path: Path) -> None:
    for k1, zooms in ((-0.25, False), (0.25, True)):  # barrel and pincushion
        rig = dataclasses.replace(RIG, distortion=(k1, 0.02, 0.002, -0.003, 0))
        root = files.write_as_waymo(tmp_path / f"{zooms}", frames=1, rig=rig, image=waves)
        frame = read(root).frames[0]
        for name in files.CAMERA_NAMES:
            camera = frame.cameras[name]
            assert (camera.fx > 1.01 * rig.focal) == zooms
            image = cv2.imread(frame.image_paths[name])[..., ::-1].astype(float)
            rays = camera.ray_directions().numpy() @ camera.camera_from_world.numpy()[:3, :3].T
            error = np.abs(image - _waves(rays, rig.focal)).mean()
            assert error < 2, name  # JPEG leaves one level; a tenth of a pixel would add three
            shifted = np.abs(image[:, 1:] - _waves(rays, rig.focal)[:, :-1]).mean()
            assert shifted > 4 * error


def test_a_lens_without_distortion_keeps_its_bytes_and_its_focal_length(tmp_path: Path) -> None:
    rig = dataclasses.replace(RIG, distortion=(0.0,) * 5)
    drive = read(files.write_as_waymo(tmp_path / "data", frames=1, rig=rig))
    path = tmp_path / f"data/camera_image/{files.NAME}.parquet"
    table = pq.read_table(path)
    recorded = {bytes(v.as_py()) for v in table["[CameraImageComponent].image"]}
    assert {Path(p).read_bytes() for p in drive.frames[0].image_paths.values()} == recorded
    assert drive.frames[0].cameras["FRONT"].fx == rig.focal
    assert not any("distortion" in problem for problem in drive.problems)


def test_boxes_stand_where_their_objects_were(written: Path) -> None:
    drive = read(written)
    moving = {sample.frame: sample for sample in drive.boxes}
    assert {sample.object_id for sample in drive.boxes} == {"car-1"}
    for n, stamp in enumerate(STAMPS):
        boxes = drive.labels.boxes(n)
        for i, box in enumerate((DRIVER, PARKED)):
            w, x, y, z = boxes.quats[i]
            forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
            # Labels have no pitch: on a slope a box leans with the car.
            assert forward @ files.turn(2, box.yaw)[:, 0] > np.cos(0.03)
        sample, met = moving[n], files.met_s(DRIVER, stamp)
        assert abs(sample.timestamp_ns * 1e-9 - files.T0 - met) < 1e-4
        place = sample.world_from_box[:3, 3] + drive.world_origin_m
        np.testing.assert_allclose(place, DRIVER.place(met), atol=1e-6)
        assert boxes.attributes["num_lidar_points_in_box"].tolist() == [77, 77]
        assert boxes.attributes["difficulty_level_detection"].tolist() == [0, 0]
        assert boxes.attributes["speed_x"][0] == DRIVER.velocity[0]
        assert np.isnan(boxes.attributes["acceleration_x"]).all()
        assert "num_top_lidar_points_in_box" not in boxes.attributes


def test_older_tables_and_a_folder_of_one_segment_are_the_same_drive(
    written: Path, tmp_path: Path
) -> None:
    form = Form(older=True, is_alone=True, compression="snappy")
    one, other = read(written), read(files.write_as_waymo(tmp_path / "older", form=form))
    assert one.name == other.name == files.NAME
    for a, b in zip(one.frames, other.frames, strict=True):
        assert a.timestamp_ns == b.timestamp_ns and list(a.cameras) == list(b.cameras)
        for name, camera in a.cameras.items():
            offset = (camera.centre - b.cameras[name].centre).abs().max()
            assert offset < 2.5e-3 and camera.fx == b.cameras[name].fx  # float32 at 22 km


def test_a_cached_scene_has_its_images_again(written: Path, cache: Path) -> None:
    uri = f"waymo:{written}?voxel_m=0.15&image_scale=1&sky_size=32"
    scene = open_scene(uri)
    # Near lasers look 30 degrees up: their returns do not tell where far walls end.
    assert lidar_top_rad(scene, [0, 1, 2]) == RIG.inclinations().max() < 0.05
    # Kept scenes come with their images, which may have been deleted meanwhile.
    (folder,) = (cache / "images").iterdir()
    before = {p: p.read_bytes() for p in folder.rglob("*.jpg")}
    assert len(before) == 15
    shutil.rmtree(folder)
    again = open_scene(uri)
    assert {p: p.read_bytes() for p in folder.rglob("*.jpg")} == before
    assert len(again.background) == len(scene.background)


def test_images_that_give_no_colours_are_written_when_they_are_read(
    copy: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = [Path(p) for frame in read(copy).frames for p in frame.image_paths.values()]
    expected = {path: path.read_bytes() for path in whole}
    (folder,) = (cache / "images").iterdir()
    shutil.rmtree(folder)
    monkeypatch.setattr("adapters.raw_drive._MAX_COLOUR_IMAGES", 5)
    drive = read(copy)
    assert drive.colour_every == 3 and not any("left out" in said for said in drive.problems)
    later = [Path(p) for frame in drive.frames[1:] for p in frame.image_paths.values()]
    assert len(list(folder.rglob("*.jpg"))) == 5 and not any(path.exists() for path in later)
    assert all(map(has_image, later)) and not has_image(folder / "FRONT/1.jpg")
    assert decode_image(later[0], cv2.IMREAD_COLOR) is not None
    assert {path: path.read_bytes() for path in expected} == expected
    assert decode_image(folder / "FRONT/1.jpg", cv2.IMREAD_COLOR) is None
    for path in later:
        path.unlink()
    files.table_path(copy, "camera_image").write_bytes(b"no Parquet")
    with pytest.raises(ImageFault, match=r"cannot be had from its table: .*camera_image.* as Parq"):
        is_whole_jpeg(later[3])
    (folder / "packed.json").write_text("{}")
    assert not has_image(later[3])


def test_frames_that_are_held_out_give_no_returns(written: Path) -> None:
    drive = read(written, held_out="1:2")
    assert len(drive.frames) == 3 and len(drive.sweeps) == 2
    alone = read(written, frames="1:2")
    assert [frame.index for frame in alone.frames] == [1] and len(alone.sweeps) == 1


def test_long_drives_are_built_from_some_returns_of_every_frame(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = read(written)
    monkeypatch.setattr("adapters.waymo.adapter._MAX_RETURNS", sum(map(len, whole.sweeps)) // 3)
    some = read(written)
    assert any("one return in 4, of 3 frames" in problem for problem in some.problems)
    for all_of_it, sweep in zip(whole.sweeps, some.sweeps, strict=True):
        assert 0.2 < len(sweep) / len(all_of_it) < 0.3
        assert set(map(bytes, sweep.points)) < set(map(bytes, all_of_it.points))
    assert len(some.labels.lidar(0)) == len(whole.labels.lidar(0))  # labels have all of them


def test_segments_go_by_their_names_or_first_parts(written: Path, tmp_path: Path) -> None:
    root = tmp_path / "waymo"
    shutil.copytree(written, root / "validation")
    other = files.NAME.replace("100170", "200170")
    for path in (root / "validation").glob("*/*.parquet"):
        table = pq.read_table(path)
        place = table.column_names.index("key.segment_context_name")
        names = pa.array([other] * len(table))
        table = table.set_column(place, "key.segment_context_name", names)
        pq.write_table(table, path.with_stem(other))
    assert (
        detect_scheme_of_path(root)
        == detect_scheme_of_path(root / "validation")
        == detect_scheme_of_path(written)
        == "waymo"
    )
    for segment in (other, other.split("_")[0], f"segment-{other}_with_camera_labels"):
        labels = waymo_labels(str(root), {"segment": segment})
        assert labels.segment.files.name == other and len(labels.boxes(0)) == 2
    for segment, message in (
        (None, rf"has 2 segments; .* \?segment={files.NAME}"),
        ("3", "has no segment '3'; it has 2"),
        ("../x", "has no segment '../x'"),
    ):
        with pytest.raises(AdapterError, match=message):
            waymo_labels(str(root), {} if segment is None else {"segment": segment})
    with pytest.raises(AdapterError, match="holds no segment of the Waymo Open Dataset v2"):
        waymo_labels(str(tmp_path), {})


def _without(name: str):
    return lambda table: table.drop_columns([name])


def _set(name: str, values, kind: pa.DataType | None = None):
    """kind: of the new column, where it is not that of the old one."""

    def change(table: pa.Table) -> pa.Table:
        column = table[name]
        own = values(column.to_pylist()) if callable(values) else values
        array = pa.array(own, kind or column.type)
        return table.set_column(table.column_names.index(name), name, array)

    return change


def _first(value):
    return lambda values: [value, *values[1:]]


POSE, LASER, IMAGE, CAMERA, BOX = (
    f"[{files.CLASSES[tag]}]."
    for tag in (
        "vehicle_pose", "lidar_calibration", "camera_image", "camera_calibration", "lidar_box"
    )
)  # fmt: skip
REFUSED = [
    ("vehicle_pose", _without(POSE + "world_from_vehicle.transform"), "transform is missing"),
    ("vehicle_pose", _set(POSE + "world_from_vehicle.transform", lambda v: [[0.0] * 16] * 3),
     "row 0 must be a rotation and a translation"),
    ("vehicle_pose", _set("key.frame_timestamp_micros", lambda v: [v[0]] * 3), "stands twice"),
    ("vehicle_pose", _set("key.segment_context_name", ["other"] * 3), f"must be '{files.NAME}'"),
    ("camera_calibration", _set("key.camera_name", ["FRONT"] * 4 + ["BACK"], pa.string()),
     "got 'BACK'"),
    ("camera_calibration", _set(CAMERA + "intrinsic.f_u", _first(-2.0)), "focal length is not > 0"),
    ("camera_calibration", _set(CAMERA + "intrinsic.k1", _first(5.0)), "leaves no picture"),
    ("camera_calibration", _set(CAMERA + "intrinsic.c_v", _first(float("nan"))), "finite numbers"),
    ("camera_calibration", _set(CAMERA + "width", _first(0)), "1 to 65536 pixels"),
    ("camera_image", _set(IMAGE + "pose_timestamp", _first(0.4)), "seconds of Unix time within"),
    ("camera_image", _set("key.frame_timestamp_micros", _first(7)),
     "without a row in vehicle_pose"),
    ("camera_image", lambda t: pa.concat_tables([t, t.slice(0, 1)]), "has two images of"),
    ("lidar_calibration", _set(LASER + "extrinsic.transform", _first([1.0] * 16)), "a rotation"),
    ("lidar_calibration",
     _set(LASER + "beam_inclination.values", [["a"]] * 5, pa.list_(pa.string())),
     "lists of numbers"),
    ("lidar_box", _set("key.laser_object_id", list(range(6)), pa.int32()),
     "must hold a text in every row"),
    ("lidar_box", _set(BOX + "type", [[1]] * 6, pa.list_(pa.int8())), "whole numbers or texts"),
    ("camera_calibration", _set("key.camera_name", [[]] * 5, pa.list_(pa.int8())),
     "whole numbers or texts; it holds list"),
    ("vehicle_pose", _set("key.segment_context_name", [7] * 3, pa.int8()), "a text in every row"),
    ("vehicle_pose", _set("key.frame_timestamp_micros", _first(-(2**63))), "Unix time in micro"),
]  # fmt: skip


def _zeros(table: pa.Table) -> pa.Table:
    """A lidar table of 3 kB with 5 million zeros in one row."""
    array = pa.ListArray.from_arrays(pa.array([0, ZEROS], pa.int32()), pa.array(np.zeros(ZEROS)))
    table = table.slice(0, 1)
    return table.set_column(table.column_names.index(RANGES.format(1, "values")), "v", array)


ZEROS = 5_000_000
RANGES = "[LiDARComponent].range_image_return{}.{}"
LABELS = "[LiDARSegmentationLabelComponent].range_image_return{}.{}"
SWEEPS_LEFT_OUT = [
    ("lidar", _set(RANGES.format(2, "values"), lambda v: [-1] * len(v), pa.int64()),
     "return2.values must hold lists of numbers; it holds int64"),
    ("lidar_segmentation", _set(LABELS.format(2, "shape"), lambda v: [-1] * len(v), pa.int64()),
     "return2.shape must hold lists of numbers; it holds int64"),
    ("lidar_segmentation", _set("key.laser_name", lambda v: [[]] * len(v), pa.list_(pa.int8())),
     "key.laser_name must hold whole numbers or texts; it holds list"),
    ("lidar", lambda t: _zeros(t).rename_columns(t.column_names),
     "states 5000000 values in 1 rows; at most 4194304 a row are read"),
]  # fmt: skip


def test_sweeps_in_columns_of_other_types_or_sizes_are_left_out_and_said(copy: Path) -> None:
    for tag, change, message in SWEEPS_LEFT_OUT:
        path = files.table_path(copy, tag)
        before = path.read_bytes()
        changed(copy, tag, change, Form())
        drive = read(copy, frames="1:2")
        assert len(drive.sweeps) == 0
        assert any(message in problem and str(path) in problem for problem in drive.problems)
        path.write_bytes(before)


def test_contradictions_are_refused_by_file_and_column(copy: Path) -> None:
    for tag, change, message in REFUSED:
        path = files.table_path(copy, tag)
        before = path.read_bytes()
        changed(copy, tag, change, Form())
        with pytest.raises(AdapterError, match=message) as caught:
            read(copy)
        assert str(path) in str(caught.value)
        path.write_bytes(before)
    for tag in ("lidar_calibration", "camera_image"):
        path = files.table_path(copy, tag)
        content = path.read_bytes()
        path.unlink()
        with pytest.raises(IncompleteDrive, match=rf"lacks .*{tag}.*download them too"):
            open_scene(f"waymo:{copy}")
        path.write_bytes(content[:-100])
        with pytest.raises(AdapterError, match=rf"{tag}.*cannot be read as Parquet"):
            read(copy)
        path.write_bytes(content)
    words = pa.array(files.CAMERA_NAMES).dictionary_encode()
    changed(
        copy, "camera_calibration", _set("key.camera_name", words.to_pylist(), words.type), Form()
    )
    read(copy)


def test_what_single_frames_lack_is_said(copy: Path) -> None:
    def damage(table: pa.Table) -> pa.Table:
        images = [v.as_py() for v in table[IMAGE + "image"]]
        images[0], images[1] = images[0][:-300], None
        images[2] = cv2.imencode(".jpg", np.zeros((20, 30, 3), np.uint8))[1].tobytes()
        return _set(IMAGE + "image", images)(table).slice(0, 14)

    def cut(table: pa.Table) -> pa.Table:
        stamp = table["key.frame_timestamp_micros"]
        return table.filter(pc.not_equal(stamp, files.stamp_us(STAMPS[1])))

    changed(copy, "camera_image", damage, Form())
    changed(copy, "lidar", cut, Form())
    shape = f"[{files.CLASSES['lidar_pose']}].range_image_return1.shape"
    changed(copy, "lidar_pose", _set(shape, [[5, 5, 6]] * 3), Form())
    files.table_path(copy, "lidar_box").unlink()
    drive = read(copy)
    said = "\n".join(drive.problems)
    assert "is no whole JPEG; left out" in said and "of 0 bytes" in said
    assert "is of 30x20 pixels, its camera of 192x" in said
    assert "no image of 1 frame (" in said and "the LiDAR has no row of 1 frame (1)" in said
    assert "must have height x width x 6 numbers" in said and "no boxes are known" in said
    assert len(drive.problems) == 10 and drive.sweeps == ()
    assert sum(len(frame.image_paths) for frame in drive.frames) == 11
    assert sum(len(frame.cameras) for frame in drive.frames) == 14


def test_images_of_other_drives_make_room(
    written: Path, copy: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLIMATEGS_SCENE_CACHE_GB", "0")
    read(written)
    (first,) = (cache / "images").iterdir()
    monkeypatch.setattr("adapters.scene_cache._IN_USE_S", -1.0)
    read(copy)
    assert len(list((cache / "images").iterdir())) == 1 and not first.exists()


@pytest.mark.skipif(not SAMPLE.is_dir(), reason="no sample of the dataset here")
def test_published_poses_are_read_to_the_bit() -> None:
    name = "10023947602400723454_1120_000_1140_000"
    rows = Rows(
        SegmentFiles(name, SAMPLE), "vehicle_pose",
        ["key.frame_timestamp_micros", "world_from_vehicle.transform"],
    )  # fmt: skip
    stamps, poses = rows.stamps(), rows.poses("world_from_vehicle.transform")
    assert len(rows) == 199 and stamps[0] == 1552440195362591 and stamps[-1] == 1552440215162553
    steps = np.diff(stamps)
    assert steps.min() >= 99_900 and steps.max() <= 100_100
    np.testing.assert_allclose(poses[0, 0], [0.69906, 0.71503, 0.00663, 860.595], atol=5e-4)
    path = SAMPLE / "vehicle_pose" / f"{name}.parquet"
    table = pq.read_table(path)["[VehiclePoseComponent].world_from_vehicle.transform"]
    stored = np.array(table.to_pylist()).reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses[:, :3, 3], stored[:, :3, 3])
    np.testing.assert_allclose(poses, stored, atol=2e-6)  # rotations made orthonormal, of float32
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / (steps * 1e-6)
    assert speeds.max() < 20
