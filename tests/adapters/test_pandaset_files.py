"""Calibration files, options, labels: what is refused, and that nothing is lost."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandaset_folder as street
import pytest
import torch

from adapters.pandaset.adapter import read_drive
from adapters.pandaset.files import (
    NO_SURFACE,
    PandaSetLabels,
    read_lidar,
    read_semantics,
    read_sequence,
    semantic_table,
)
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.geometry import rotmat_from_quat
from augment.semantics import SemanticClass


@pytest.fixture
def folder(tmp_path) -> Path:
    return street.write_sequence(tmp_path / "002")


def edit(path: Path, change) -> None:
    value = json.loads(path.read_text())
    path.write_text(json.dumps(change(value)))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("camera/left_camera/intrinsics.json", lambda v: {"fx": 1.0}, "fy .pixels. must be a num"),
        ("camera/left_camera/intrinsics.json", lambda v: [1, 2], "must hold an object; got list"),
        ("camera/left_camera/poses.json", lambda v: v[:-1], "has 2 poses; lidar/poses.json has 3"),
        ("camera/left_camera/timestamps.json", lambda v: v[:-1], "has 2 entries; there are 3"),
        ("camera/left_camera/timestamps.json", lambda v: v[::-1], "must be increasing; frame 1"),
        ("camera/left_camera/timestamps.json", lambda v: ["now"] * 3, "frame 0: the time in s"),
        ("lidar/timestamps.json", lambda v: [*v, v[-1] + 1], "has 4 entries; there are 3"),
        ("lidar/poses.json", lambda v: [], "holds no poses"),
        ("lidar/poses.json", lambda v: [{"position": v[0]["position"]}] * 3, "a heading w x y z"),
        (
            "lidar/poses.json",
            lambda v: [{**p, "heading": {"w": 2, "x": 0, "y": 0, "z": 0}} for p in v],
            "frame 0: heading must be a unit",
        ),
    ],
)
def test_calibration_that_contradicts_itself_is_refused(folder, name, change, message):
    edit(folder / name, change)
    with pytest.raises(AdapterError, match=message) as caught:
        read_sequence(folder)
    assert Path(name).name in str(caught.value)


def test_folders_that_are_no_sequence_are_refused(tmp_path):
    root = street.write_sequence(tmp_path / "002")
    left = root / "camera/left_camera"
    (left / "03.jpg").write_bytes((left / "00.jpg").read_bytes())
    with pytest.raises(AdapterError, match=r"image 03\.jpg, but timestamps\.json ends with frame"):
        read_sequence(root)
    for path in left.glob("*.jpg"):
        path.unlink()
    with pytest.raises(AdapterError, match="left_camera holds no images"):
        read_sequence(root)
    (root / "camera").rename(root / "cam")
    with pytest.raises(AdapterError, match="camera does not exist"):
        read_sequence(root)
    with pytest.raises(AdapterError, match=r"poses\.json does not exist"):
        read_sequence(tmp_path)
    with pytest.raises(AdapterError, match="is not a folder"):
        read_sequence(tmp_path / "003")


# What JSON allows where a number is due: (as text, as in the error).
NO_NUMBERS = {
    "NaN": "nan",
    "1e999": "inf",
    "1e39": "1e\\+39",
    "1" + "0" * 400: "10000",
    '"1.5"': "'1.5'",
    "true": "True",
}


def test_no_number_is_refused_by_file_frame_and_field(folder):
    poses, times = folder / "camera/left_camera/poses.json", folder / "lidar/timestamps.json"
    lens = folder / "camera/left_camera/intrinsics.json"
    for text, shown in NO_NUMBERS.items():
        for path, place, where in (
            (lens, lambda v: v | {"cy": "?"}, "intrinsics.json: cy .pixels."),
            (times, lambda v: [v[0], "?", v[2]], "timestamps.json, frame 1: the time in seconds"),
            (
                poses,
                lambda v: [*v[:2], v[2] | {"position": v[2]["position"] | {"y": "?"}}],
                "poses.json, frame 2: position.y",
            ),
            (
                poses,
                lambda v: [v[0] | {"heading": v[0]["heading"] | {"w": "?"}}, *v[1:]],
                "poses.json, frame 0: heading.w",
            ),
        ):
            whole = path.read_text()
            path.write_text(json.dumps(place(json.loads(whole))).replace('"?"', text))
            with pytest.raises(AdapterError, match=f"{where} must be a number .* got {shown}"):
                read_sequence(folder)
            path.write_text(whole)


def test_tables_without_their_columns_are_refused(folder):
    street.write_table(folder / "lidar/00.pkl.gz", {"x": np.zeros(2), "y": np.zeros(2)})
    with pytest.raises(AdapterError, match=r"00\.pkl\.gz lacks the columns \['z', 'i', 't', 'd'\]"):
        read_lidar(folder, 0)
    street.write_table(folder / "annotations/semseg/01.pkl.gz", {"class": np.zeros(3, int)})
    rows = len(read_lidar(folder, 1))
    with pytest.raises(AdapterError, match=f"each of the {rows} returns .* it has 3"):
        read_semantics(folder, 1, rows)


def test_boxes_turn_to_x_forward_and_keep_every_column(folder):
    boxes = PandaSetLabels(folder).boxes(1)
    assert boxes.track_ids == (street.CAR_IDS[0], "parked") and boxes.labels == ("Car",) * 2
    np.testing.assert_allclose(boxes.sizes_m[0], street.CAR_SIZE_M)
    np.testing.assert_allclose(boxes.centers_m[0], street.car_centre(0.1))
    forward = rotmat_from_quat(torch.from_numpy(boxes.quats))[0, :, 0]
    np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-12)
    columns = boxes.attributes
    assert list(columns["cuboids.sibling_id"]) == [street.CAR_IDS[1], "-"]
    assert list(columns["cuboids.sensor_id"]) == [0, -1]
    np.testing.assert_allclose(columns["yaw"], -np.pi / 2)
    np.testing.assert_allclose(columns["dimensions.y"], street.CAR_SIZE_M[0])
    assert list(columns["attributes.object_motion"]) == ["Moving", "Parked"]
    assert len(columns) == 15


def test_missing_texts_are_none(folder):
    path = folder / "annotations/cuboids/00.pkl.gz"
    table = street._cuboids(0, np.zeros(3)) | {
        "attributes.rider_status": ["With Rider", np.nan, None]
    }
    street.write_table(path, table)
    status = PandaSetLabels(folder).boxes(0).attributes["attributes.rider_status"]
    assert list(status) == ["With Rider", None]


def test_sweeps_pass_through_bit_for_bit(folder):
    table = read_lidar(folder, 1)
    sweep = PandaSetLabels(folder).lidar(1)
    assert list(sweep.columns) == ["x", "y", "z", "i", "t", "d", "semantic"]
    for name in "xyzitd":
        assert sweep.columns[name].dtype == table[name].dtype
        assert (sweep.columns[name] == table[name].to_numpy()).all()


def test_classes_are_known_by_name(folder):
    table = semantic_table(folder)  # the published numbers
    assert table[7] == SemanticClass.ROAD and table[4] == NO_SURFACE and table[99] == 0
    names = {"3": "Road", "9": "Reflection", "5": "Hovercraft"}
    (folder / "annotations/semseg/classes.json").write_text(json.dumps(names))
    table = semantic_table(folder)
    assert table[3] == SemanticClass.ROAD and table[9] == NO_SURFACE and table[5] == 0
    for wrong in ([1, 2], {"x": "Road"}, {"9" * 5000: "Road"}, {"1": 2}):
        (folder / "annotations/semseg/classes.json").write_text(json.dumps(wrong))
        with pytest.raises(AdapterError, match=r"classes\.json must"):
            semantic_table(folder)


def test_own_car_and_mirror_images_are_left_out(folder):
    table = read_lidar(folder, 0)
    points = np.array([[0.5, 0.2, 0.8], [2.0, -0.6, 1.2], [4.0, 0.0, 0.3], [5.0, 0.0, 0.3]])
    columns = {c: points[:, i] for i, c in enumerate("xyz")}
    columns |= {"i": np.zeros(4), "t": np.full(4, table["t"].iloc[0]), "d": np.zeros(4, int)}
    street.write_table(folder / "lidar/00.pkl.gz", columns)
    street.write_table(
        folder / "annotations/semseg/00.pkl.gz", {"class": np.array([13, 13, 4, 13])}
    )
    (sweep,) = read_drive(read_sequence(folder), [0]).sweeps
    np.testing.assert_allclose(sweep.points, points[3:])  # two on the car itself, one reflection


def test_a_box_called_stationary_that_travels_is_an_actor(folder):
    for frame in range(street.FRAMES):
        table = street._cuboids(frame, np.zeros(3)) | {"stationary": np.array([True] * 3)}
        table["position.x"] = table["position.x"] + [2.0 * frame, 2.0 * frame, 0]
        street.write_table(folder / f"annotations/cuboids/{frame:02d}.pkl.gz", table)
    samples = read_drive(read_sequence(folder), range(street.FRAMES)).samples
    assert {s.object_id for s in samples} == {street.CAR_IDS[0]}


def test_options_are_typed():
    query = {"frames": "2:9", "voxel_m": "0.08", "max_gaussians": "5000", "image_scale": "0.25"}
    options = DriveOptions.from_query("pandaset", query | {"sky_size": "16"})
    assert options == DriveOptions(
        frames=range(2, 9), voxel_m=0.08, max_gaussians=5000, image_scale=0.25, sky_size=16
    )
    assert DriveOptions.from_query("pandaset", {"frames": "4:"}) == DriveOptions(
        frames=range(4, sys.maxsize)
    )
    assert DriveOptions.from_query("pandaset", {}) == DriveOptions()


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ({"voxels": "1"}, "option 'voxels'; did you mean 'voxel_m'. allowed are frames: .*; sky_"),
        ({"frames": "3"}, "frames must be first:stop.*got '3'"),
        ({"frames": "5:5"}, "frames must be first:stop"),
        ({"frames": "-1:5"}, "frames must be first:stop"),
        ({"voxel_m": "nan"}, "voxel_m must be a number of metres from 0.01 to 2; got 'nan'"),
        ({"voxel_m": "0"}, "voxel_m must be"),
        ({"max_gaussians": "1e6"}, "max_gaussians must be an integer from 1000"),
        ({"image_scale": "0.3"}, "image_scale must be one of 1, 0.5, 0.25, 0.125; got '0.3'"),
        ({"sky_size": "4"}, "sky_size must be an integer from 8"),
        ({"held_out": "3"}, "held_out must be first:stop:step.*such as 1::2.*got '3'"),
        ({"held_out": "1::0"}, "held_out must be first:stop:step"),
        ({"held_out": "5:2:1"}, "held_out must be first:stop:step"),
        ({"held_out": "1:2:3:4"}, "held_out must be first:stop:step"),
    ],
)
def test_wrong_options_say_what_is_allowed(query, message):
    with pytest.raises(AdapterError, match=message):
        DriveOptions.from_query("pandaset", query)


@pytest.mark.parametrize(
    ("text", "held"), [("1::2", [3, 5, 7]), ("4:6", [4, 5]), ("0:7:3", [3, 6]), ("30::", [])]
)
def test_held_out_counts_frame_numbers(text, held):
    options = DriveOptions.from_query("pandaset", {"frames": "2:9", "held_out": text})
    chosen = options.select(range(20), where="here")
    assert sorted(chosen.held_out) == held and chosen.numbers == tuple(range(2, 9))
    assert set(chosen.used) == set(range(2, 9)) - set(held)
    said = ("held_out=30::1 holds out none of frames 2 to 8",)
    assert chosen.problems == (() if held else said)


def test_holding_out_everything_is_refused():
    options = DriveOptions(held_out=range(sys.maxsize))
    with pytest.raises(AdapterError, match=r"here: held_out=0::1 holds out all 7 frames \(2 to"):
        options.select(range(2, 9), where="here")
