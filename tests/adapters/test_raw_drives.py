"""What holds for raw drives of every dataset: held-out frames, labels on their own, and weathered
sweeps in the form of the dataset's files."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from adapters.av2.adapter import Av2Log
from adapters.base import open_scene
from adapters.datasets import DATASETS
from adapters.drivestudio.adapter import drivestudio_labels
from adapters.kitti.adapter import KittiLabels
from adapters.nuscenes.adapter import nuscenes_labels
from adapters.pandaset.adapter import PandaSetLabels
from adapters.plain_files import Number, read_json, read_numbers, read_yaml, validate_content
from adapters.procedural import StreetLabels
from adapters.raw_drive import NO_SURFACE, IncompleteDrive, Picture, class_of_air, usable_images
from adapters.recording.adapter import RecordingLabels
from adapters.street_gaussians.adapter import StreetGaussiansLabels
from adapters.uri import parse_uri
from augment.effects.lidar import (
    ATTENUATED,
    LOST,
    MOVED,
    PRECIPITATION,
    SCATTERED,
    UNCHANGED,
    drop_lost_returns,
    is_in_air,
)
from augment.effects.lidar.beam import find_intensity_column
from augment.errors import AdapterError
from augment.output.tables import lidar_bytes
from augment.scene.labels import LidarSweep, StoresLidar
from augment.scene.semantics import SemanticClass
from recipes.load import load_recipe
from tests.adapters import av2_files, kitti_files, nuscenes_files, pandaset_files
from tests.adapters.all_drives import WRITERS, write_drive
from tests.adapters.drivestudio_files import write_as_drivestudio
from tests.adapters.recording_files import edit_calibration, write_as_recording
from tests.adapters.shown import assert_same_bits
from tools.cli import main
from tools.inspect import describe_drive, drive_text

QUERY = {"voxel_m": "0.3", "image_scale": "1", "sky_size": "8"}


@pytest.mark.parametrize("scheme", sorted(WRITERS.keys() - {"waymo"}))  # which stores no sweeps
def test_held_out_frames_leave_no_trace_in_the_gaussians(scheme: str, tmp_path: Path) -> None:
    drive = write_drive(scheme, tmp_path / "data")
    number = [number for number, views in drive.views.items() if views][1]
    query = drive.query | QUERY | {"held_out": f"{number}:{number + 1}"}
    path = str(drive.path)
    scene = DATASETS[scheme].open(path, query)
    frame, sweep = scene.frame(number), scene.lidar(number)
    # All of the frame changes: its images are black, and its LiDAR sees a roof over the street.
    for image in frame.image_paths.values():
        assert cv2.imwrite(image, np.zeros_like(cv2.imread(image)))
    columns = {name: np.tile(column, 2) for name, column in sweep.columns.items()}
    columns["z"][len(sweep) :] += 6
    codes = np.repeat([UNCHANGED, MOVED], len(sweep)).astype(np.uint8)
    index = np.tile(np.arange(len(sweep), dtype=np.int32), 2)
    roofed = LidarSweep({**columns, "source_index": index, "weather_code": codes})
    for file in scene.labels.lidar_files(number):
        file.write_bytes(scene.labels.lidar_content(number, file, roofed))
    again = DATASETS[scheme].open(path, query)
    assert len(again.lidar(number)) == 2 * len(sweep)
    assert_same_bits(scene, again)
    # The frame itself stays, as do its boxes.
    assert again.frame(number).image_paths.keys() == drive.views[number].keys()
    assert again.problems == scene.problems and len(again.boxes(number)) == len(scene.boxes(number))


MARK = b"\xef\xbb\xbf"  # with which some editors begin UTF-8


def test_texts_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    text, table, tree = tmp_path / "a.txt", tmp_path / "a.json", tmp_path / "a.yaml"
    text.write_bytes(MARK + b"1 2")
    table.write_bytes(MARK + b'{"a": 1}')
    tree.write_bytes(MARK + b"a: 1")
    assert read_numbers(text).tolist() == [1, 2]
    assert read_json(table) == read_yaml(tree) == {"a": 1}
    tree.write_bytes(MARK + b"name: fog\nweather: {smog: {visibility_m: 100}}\n")
    assert load_recipe(str(tree)).name == "fog"


def test_values_of_another_type_are_said_to_be_corrected_not_copied(tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match=r"x: must be a valid number.* Correct the value") as e:
        validate_content(Number, "a", "x")
    assert "opy" not in str(e.value)


# A dataset, and a pattern of all its images or of all its sweeps.
LACKS = (
    ("pandaset", "camera/*/*.jpg"),
    ("nuscenes", "*/CAM_*/*.jpg"),
    ("kitti", "image_*/data/*"),
    ("kitti", "image_2/*"),  # of the object benchmark
    ("av2", "sensors/cameras/*/*.jpg"),
    ("recording", "images/*/*"),
    ("waymo", "camera_*/*.parquet"),
    ("pandaset", "lidar/*.pkl.gz"),
    ("waymo", "lidar*/*.parquet"),
)


@pytest.mark.parametrize(("scheme", "pattern"), LACKS)
def test_a_drive_without_images_or_returns_is_described_and_makes_no_scene(
    scheme: str, pattern: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    root = tmp_path / "2011_09_26"
    if pattern == "image_2/*":
        uri = f"kitti:{kitti_files.write_as_kitti_object(root)}?frame=1"
    else:
        uri = write_drive(scheme, root).uri()
    files = list(Path(parse_uri(uri)[1]).glob(pattern))
    assert files
    for file in files:
        file.unlink()
    with pytest.raises(
        IncompleteDrive, match=r"there (is no usable image|are no LiDAR returns)"
    ) as e:
        open_scene(uri)
    facts = describe_drive(e.value)
    has_returns = "lidar" not in pattern
    assert (facts["lidar"]["returns"] > 1000) == has_returns
    assert (sum(camera["images"] for camera in facts["cameras"]) > 0) != has_returns
    assert facts["frames"]["count"] >= 1
    assert facts["boxes"]["count"] >= 2 or scheme == "waymo"  # lidar* has lidar_box
    page = drive_text(facts)
    assert "scene       none: there" in page and "LiDAR       " in page and "boxes " in page


def test_inspect_shows_a_drive_without_images_and_render_refuses_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = av2_files.write_as_av2(tmp_path / "log", cameras=list(av2_files.CAMERAS)[:1])
    shutil.rmtree(root / "sensors/cameras")
    facts = tmp_path / "facts.json"
    assert main(["inspect", str(root), "--json", str(facts)]) == 1
    page = capsys.readouterr().out
    assert "scene       none: there is no usable image in 4 frames" in page
    assert "; map, " in page and "usable returns in 4 sweeps of 4 frames" in page
    assert read_json(facts)["boxes"]["count"] == 8
    assert main(["render", "dense-fog", "--scene", str(root), "--out", str(tmp_path / "out")]) == 2
    assert "no usable image" in capsys.readouterr().err


def test_returns_beyond_any_reach_are_left_out_and_paths_must_be_metres(tmp_path: Path) -> None:
    root = kitti_files.write_as_kitti_object(tmp_path)
    (file,) = root.glob("velodyne/*.bin")
    records = np.fromfile(file, "<f4").reshape(-1, 4)
    records[100, 0], records[200, 1] = 1e20, -2000
    records.tofile(file)
    scene = DATASETS["kitti"].open(str(root), QUERY)
    said = "2 LiDAR returns lie further than 1000 m from the car's path and are left out"
    assert any(said in problem for problem in scene.problems)
    wide = write_as_recording(tmp_path / "wide")

    def jump(calibration: dict) -> None:
        for entry in calibration["frames"][2:]:
            entry["world_from_ego"][0][3] += 4e7

    edit_calibration(wide, jump)
    shutil.rmtree(wide / "lidar")
    with pytest.raises(AdapterError, match=r"4e\+07 x 0 m wide.*between frames 1 and 2"):
        DATASETS["recording"].open(str(wide), QUERY)


CODES = np.array(
    [UNCHANGED, UNCHANGED, ATTENUATED, LOST, MOVED, SCATTERED, PRECIPITATION], np.uint8
)
PANOPTIC = "panoptic/v1.0-mini/0_panoptic.npz"
# What returns that drops, flakes or fog made have in columns that say what was hit.
OF_AIR: dict[str, dict[str, float]] = {
    "pandaset": {"semantic": 3},  # Spray or rain
    "nuscenes": {"semantic": 0},  # noise
    "recording": {"semantic": 0},  # of no meaning in its calibration
    "recording-of-ours": {"semantic": 0},
    "waymo": {"flow_x": 0, "flow_y": 0, "flow_z": 0, "flow_class": -1, "ground": 0},
}


def test_images_of_long_drives_are_checked_by_header_and_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (48, 64, 3)))[1]
    whole, damaged = image.tobytes(), bytearray(image.tobytes())
    del damaged[150:-2]  # in its tables: no decoder makes a picture of it
    (tmp_path / "small.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((9, 9, 3)))[1].tobytes())
    for name, data in {"a": whole, "b": whole, "cut": whole[:-200], "torn": bytes(damaged)}.items():
        (tmp_path / f"{name}.jpg").write_bytes(data)
    names = ["a", "b", "cut", "small", "torn", "none"]
    pictures = [Picture("front", i, tmp_path / f"{n}.jpg") for i, n in enumerate(names)]
    sure = usable_images(pictures)
    assert [n for n, own in sure.paths.items() if own] == [0, 1] and sure.sizes["front"] == (64, 48)
    monkeypatch.setattr("adapters.raw_drive._MAX_DECODED", 5)
    quick = usable_images(pictures)
    assert quick.paths == sure.paths and quick.sizes == sure.sizes
    damaged = bytearray(whole)
    damaged[-400:-2] = b"\xff\xc4" * 199  # behind its header
    (tmp_path / "torn.jpg").write_bytes(bytes(damaged))
    assert quick.problems[0].startswith("camera front, frame 2: ")
    assert 4 in [n for n, own in usable_images(pictures).paths.items() if own]


def _pandaset(root: Path) -> PandaSetLabels:
    return PandaSetLabels(
        pandaset_files.write_as_pandaset(root, offset_m=np.array([9e4, -4e4, 30]))
    )


def _nuscenes(root: Path):
    nuscenes_files.write_as_nuscenes(root)
    token = nuscenes_files.data_token(1, "LIDAR_TOP", 0)
    row = {"token": token, "sample_data_token": token, "filename": PANOPTIC}
    nuscenes_files.write_table(root, "panoptic", [row])
    labels = nuscenes_labels(str(root), {"scene": "scene-0002"})
    (root / PANOPTIC).parent.mkdir(parents=True)
    np.savez_compressed(root / PANOPTIC, data=np.arange(len(labels.lidar(0)), dtype=np.uint16))
    return labels


def _kitti(root: Path, matrix: np.ndarray | None = None):
    drive = kitti_files.write_as_kitti(root / "2011_09_26")
    pose = kitti_files.world_from_street() @ kitti_files.street_from_velo(0)
    (name,) = (p.relative_to(drive) for p in drive.glob("velodyne_points/data/*0.bin"))
    return KittiLabels(
        drive, {0: str(name)}, {0: 10**18}, {0: pose}, velodyne_from_rectified=matrix
    )


def _ours(root: Path) -> RecordingLabels:
    (root / "lidar").mkdir(parents=True)
    sweep = RecordingLabels(write_as_recording(root / "plain", frames=1)).lidar(0)
    shutil.copy(root / "plain/calibration.json", root)
    columns = {**sweep.columns, "note": np.array(["a", "b"], object)[np.arange(len(sweep)) % 2]}
    columns["intensity"] = (np.arange(len(sweep)) % 256).astype(np.uint8)
    (root / "lidar/000000.parquet").write_bytes(lidar_bytes(LidarSweep(columns)))
    return RecordingLabels(root)


STORED: dict[str, Callable[[Path], StoresLidar]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "kitti": _kitti,
    "kitti-object": lambda root: _kitti(root, np.eye(4)),
    "av2": lambda root: Av2Log.read(str(av2_files.write_as_av2(root))),
    "recording": lambda root: RecordingLabels(write_as_recording(root, frames=1)),
    "recording-of-ours": _ours,
    "waymo": lambda root: drivestudio_labels(
        str(write_as_drivestudio(root, dataset="waymo").folder), {}
    ),
    "drivestudio-nuscenes": lambda root: drivestudio_labels(
        str(write_as_drivestudio(root, dataset="nuscenes").folder), {}
    ),
}


def weathered(sweep: LidarSweep) -> LidarSweep:
    """All that can become of returns: those that moved by some metres, every other weaker one by
    some millimetres."""
    codes = CODES[np.arange(len(sweep)) % len(CODES)]
    rng = np.random.default_rng(5)
    columns = {name: np.array(column) for name, column in sweep.columns.items()}
    sigma = np.where(np.isin(codes, (MOVED, SCATTERED, PRECIPITATION)), 3.0, 0.0)
    sigma[np.flatnonzero(codes == ATTENUATED)[::2]] = 0.02
    for axis in "xyz":
        noisy = columns[axis] + sigma * rng.normal(0, 1, len(sweep))
        columns[axis] = np.where(sigma > 0, noisy, columns[axis])
        columns[axis][codes == LOST] = np.nan
    name = find_intensity_column(sweep)
    if name is not None:
        values = columns[name] * np.where(codes == UNCHANGED, 1, 0.5)
        columns[name] = values.astype(sweep.columns[name].dtype)
    index = np.arange(len(sweep), dtype=np.int32)
    return LidarSweep({**columns, "source_index": index, "weather_code": codes})


@pytest.mark.parametrize("dataset", STORED)
def test_files_give_back_the_weathered_sweep(dataset: str, tmp_path: Path) -> None:
    labels = STORED[dataset](tmp_path / "data")
    assert isinstance(labels, StoresLidar)
    source = labels.lidar(0)
    wanted = drop_lost_returns(weathered(source))
    assert 0.8 < len(wanted) / len(source) < 0.9
    files = labels.lidar_files(0)
    contents = [labels.lidar_content(0, file, wanted) for file in files]
    assert contents == [labels.lidar_content(0, file, wanted) for file in files]  # every time
    for file, content in zip(files, contents, strict=True):
        file.write_bytes(content)
    read = labels.lidar(0)
    assert {k: v.dtype for k, v in read.columns.items()} == {
        k: v.dtype for k, v in source.columns.items()
    }
    moved = (wanted.points_m != source.points_m[wanted.columns["source_index"]]).any(1)
    np.testing.assert_array_equal(read.points_m[~moved], wanted.points_m[~moved])
    # Argoverse's coordinates have 16 bits: beyond 32 m a step is 3.1 cm, along two turned axes.
    atol_m = 0.5 * 2**-5 * 2**0.5 if dataset == "av2" else 1e-5
    np.testing.assert_allclose(read.points_m, wanted.points_m, rtol=0, atol=atol_m)
    told = "timestamp_ns" if dataset == "nuscenes" else ""  # by the bearing, of those that moved
    in_air = is_in_air(wanted)
    assert 0 < in_air.sum() < len(wanted)
    air = OF_AIR.get(dataset, {})
    for name in source.columns.keys() - {"x", "y", "z", told}:
        expected = np.array(wanted.columns[name])
        expected[in_air] = air.get(name, expected[in_air])
        np.testing.assert_array_equal(read.columns[name], expected, err_msg=name)
    assert labels.lidar_files(99) == ()


def test_without_a_class_of_that_name_returns_of_the_air_have_none() -> None:
    """By meaning then, and at last a number of no class."""
    meaning = {4: SemanticClass.ROAD, 9: NO_SURFACE, 7: NO_SURFACE, 2: SemanticClass.UNKNOWN}
    assert class_of_air(meaning, {4: "noise", 9: "fog"}, "noise") == 4
    assert class_of_air(meaning, {}, "noise") == 7
    del meaning[7], meaning[9]
    assert class_of_air(meaning, {}, "noise") == 2
    assert class_of_air({0: SemanticClass.ROAD, 1: SemanticClass.SIGN}, {}, "noise") == 2


def test_pandas_opens_the_tables_and_their_rows_still_name_each_other(tmp_path: Path) -> None:
    labels = _pandaset(tmp_path)
    before = [pd.read_pickle(file) for file in labels.lidar_files(0)]
    wanted = drop_lost_returns(weathered(labels.lidar(0)))
    for file, old in zip(labels.lidar_files(0), before, strict=True):
        file.write_bytes(labels.lidar_content(0, file, wanted))
        new = pd.read_pickle(file)
        np.testing.assert_array_equal(new.index, old.index[wanted.columns["source_index"]])
        assert list(new.columns) == list(old.columns) and new.dtypes.equals(old.dtypes)
        assert new.columns.dtype == object  # as all versions of pandas read them
    assert set(labels.lidar(0).columns["d"]) == {0, 1}


def test_labels_of_nuscenes_returns_stay_with_their_returns(tmp_path: Path) -> None:
    labels = _nuscenes(tmp_path)
    wanted = drop_lost_returns(weathered(labels.lidar(0)))
    names = [file.parts[len(tmp_path.parts)] for file in labels.lidar_files(0)]
    assert names == ["samples", "lidarseg", "panoptic"]
    panoptic = labels.lidar_files(0)[2]
    content = labels.lidar_content(0, panoptic, wanted)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:  # no time of day: the same bytes again
        assert archive.getinfo("data.npy").date_time == (1980, 1, 1, 0, 0, 0)
    panoptic.write_bytes(content)
    with np.load(panoptic) as archive:
        assert archive["data"].dtype == np.uint16
        expected = np.where(is_in_air(wanted), 0, wanted.columns["source_index"])
        np.testing.assert_array_equal(archive["data"], expected)
    panoptic.write_bytes(b"PK no archive")
    with pytest.raises(AdapterError, match=r"0_panoptic\.npz must hold an array `data`"):
        labels.lidar_content(0, panoptic, wanted)
    classes = labels.lidar_files(0)[1]
    classes.write_bytes(b"abc")
    with pytest.raises(AdapterError, match=r"_lidarseg\.bin has 3 classes, fewer than samples/"):
        labels.lidar_content(0, classes, wanted)
    (between,) = labels.lidar_files(1)  # no keyframe has none of them
    assert between.relative_to(tmp_path).parts[0] == "sweeps"


def test_a_recordings_file_keeps_its_notes(tmp_path: Path) -> None:
    labels = _ours(tmp_path)
    (file,) = labels.lidar_files(0)
    schema = pq.read_schema(file)
    file.write_bytes(labels.lidar_content(0, file, drop_lost_returns(weathered(labels.lidar(0)))))
    assert pq.read_schema(file).equals(schema, check_metadata=True)


def test_sweeps_without_files_of_their_own_cannot_be_stored(tmp_path: Path) -> None:
    assert not isinstance(StreetGaussiansLabels(tmp_path), StoresLidar)
    assert not issubclass(StreetLabels, StoresLidar)
