"""A PandaSet sequence as a scene: a street whose answer is known, and the real one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation

from adapters.base import open_scene
from adapters.pandaset.adapter import (
    NO_SURFACE,
    PandaSetLabels,
    boxes_of_cuboids,
    class_meanings,
    open_pandaset,
    read_cuboids,
    read_frames,
    read_lidar,
    read_objects,
    read_semantics,
    read_sweeps,
    tie_boxes,
)
from adapters.raw_drive import DriveOptions
from augment.errors import AdapterError
from augment.render.rasterize import rasterize
from augment.scene.geometry import rotmat_from_quat
from augment.scene.semantics import SemanticClass
from tests.adapters import pandaset_files as files
from tests.adapters import street
from tests.adapters.drives import WHOLE, changed
from tests.adapters.shown import psnr, render

QUERY = {"voxel_m": "0.1", "image_scale": "1", "sky_size": "32"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return files.write_as_pandaset(tmp_path_factory.mktemp("pandaset") / "002")


@pytest.fixture(scope="module")
def scene(folder):
    return open_pandaset(str(folder), QUERY)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "002"))


def test_the_ground_is_closed_under_the_car_too(scene):
    camera = scene.frame(0).cameras["front_camera"]
    out = rasterize([next(iter(scene.parts_at(camera.timestamp_ns)))], camera)
    # Up to 20 m ahead and 5 m to the sides, also where the car hides it in every image.
    ground = out.alpha[street.HEIGHT // 2 + 6 :, 60:100]
    assert ground.min() > 0.8


def test_the_sky_is_what_the_images_show_above(scene):
    up_ahead = torch.tensor([[1.0, -0.3, 0.3], [0.1, 1.0, 0.55], [0.0, 0.0, 1.0]])
    # The zenith is in no image: it is filled from the whole sky, wall tops at its rim included.
    for sampled, tolerance in zip(scene.sky.sample(up_ahead), (0.02, 0.02, 0.1), strict=True):
        np.testing.assert_allclose(sampled, street.SKY / 255, atol=tolerance)


def test_frames_are_limited_and_max_gaussians_respected(folder):
    scene = open_pandaset(str(folder), {**QUERY, "frames": "1:2", "max_gaussians": "3000"})
    assert [f.index for f in scene.frames] == [1]
    total = len(scene.background) + sum(len(a.gaussians) for a in scene.actors)
    assert 1500 < total <= 3000


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


@pytest.fixture
def own(tmp_path) -> Path:
    return files.write_as_pandaset(tmp_path / "002")


# What JSON allows where a number is due: (as text, as in the error).
def test_tables_without_their_columns_are_refused(own):
    files.write_table(own / "lidar/00.pkl.gz", {"x": np.zeros(2), "y": np.zeros(2)})
    with pytest.raises(AdapterError, match=r"00\.pkl\.gz lacks the columns \['z', 'i', 't', 'd'\]"):
        read_lidar(own, 0)
    files.write_table(own / "annotations/semseg/01.pkl.gz", {"class": np.zeros(3, int)})
    rows = len(read_lidar(own, 1))
    with pytest.raises(AdapterError, match=f"each of the {rows} returns .* it has 3"):
        read_semantics(own, 1, rows)


def test_boxes_turn_to_x_forward_and_keep_every_column(own):
    boxes = PandaSetLabels(own).boxes(1)
    forward = rotmat_from_quat(torch.from_numpy(boxes.quats))[0, :, 0]
    np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-12)
    columns = boxes.attributes
    assert list(columns["attributes.rider_status"]) == [None, None]
    assert list(columns["cuboids.sibling_id"]) == [files.CAR_IDS[1], "-"]
    assert list(columns["cuboids.sensor_id"]) == [0, -1]
    np.testing.assert_allclose(columns["yaw"], -np.pi / 2)
    np.testing.assert_allclose(columns["dimensions.y"], street.CAR_SIZE_M[0])
    assert list(columns["attributes.object_motion"]) == ["Moving", "Parked"]
    assert len(columns) == 15


def test_own_car_and_mirror_images_are_left_out(own):
    table = read_lidar(own, 0)
    points = np.array([[0.5, 0.2, 0.8], [2.0, -0.6, 1.2], [4.0, 0.0, 0.3], [5.0, 0.0, 0.3]])
    columns = {c: points[:, i] for i, c in enumerate("xyz")}
    columns |= {"i": np.zeros(4), "t": np.full(4, table["t"].iloc[0]), "d": np.zeros(4, int)}
    files.write_table(own / "lidar/00.pkl.gz", columns)
    files.write_table(own / "annotations/semseg/00.pkl.gz", {"class": np.array([13, 13, 4, 13])})
    frames, chosen, origin, _ = read_frames(own, DriveOptions(frames=range(1)))
    (sweep,), _, _ = read_sweeps(own, frames, chosen.held_out, origin)
    np.testing.assert_allclose(sweep.points, points[3:])  # two on the car itself, one reflection


def test_a_box_called_stationary_that_travels_is_an_actor(own):
    for frame in range(street.FRAMES):
        table = files.cuboids(frame, np.zeros(3)) | {"stationary": np.array([True] * 3)}
        table["position.x"] = table["position.x"] + [2.0 * frame, 2.0 * frame, 0]
        files.write_table(own / f"annotations/cuboids/{frame:02d}.pkl.gz", table)
    assert moving(own) == {files.CAR_IDS[0]}


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


LINKS = ["cuboids.sibling_id"]
LINKS_AND_SENSORS = ["cuboids.sibling_id", "cuboids.sensor_id"]


def cuboids(*boxes: tuple) -> pd.DataFrame:
    """A frame's table. boxes: uuid, sensor, sibling, and where it stands along x; cars of 4.4 m."""
    uuid, sensor, sibling, x = zip(*boxes, strict=True)
    still = {"position.y": 0.0, "position.z": 0.5, "yaw": -np.pi / 2, "stationary": False}
    sizes = {"dimensions.x": 1.8, "dimensions.y": 4.4, "dimensions.z": 1.5}
    columns = {"uuid": uuid, "label": "Car", "position.x": [float(v) for v in x], **still, **sizes}
    return pd.DataFrame(columns | {LINKS[0]: sibling, "cuboids.sensor_id": sensor})


def kept(*tables: pd.DataFrame) -> list[list[tuple[str, str]]]:
    """Of each frame the boxes that stay, and the names of their objects."""
    objects = tie_boxes(dict(enumerate(tables)))
    uuids = [t["uuid"][objects.is_best_box(t["uuid"])] for t in tables]
    return [[(uuid, objects.names[uuid]) for uuid in frame] for frame in uuids]


@pytest.mark.parametrize(
    "links",
    [
        ("b", "a"),
        ("b", "-"),
        ("-", "a"),
        ("b", "cut sho"),
        ("a", "a"),
        (np.nan, "a"),
        ("gone", "a"),
    ],
)
def test_a_link_in_either_direction_makes_one_object_of_two_boxes(links):
    # Too far from each other to be found by overlap. The spinning sensor's box stays.
    table = cuboids(("b", 1, links[1], 9), ("a", 0, links[0], 0), ("c", -1, "-", 20))
    assert kept(table) == [[("a", "a"), ("c", "c")]]


def test_without_links_boxes_of_one_class_that_overlap_are_one_object():
    table = cuboids(("a", 0, "-", 0), ("b", 1, "-", 1.2), ("c", 0, "-", 4.5), ("d", -1, "-", 5))
    assert kept(table) == [[("a", "a"), ("c", "c"), ("d", "d")]]
    assert kept(table.drop(columns=LINKS)) == kept(table)
    # Without sensors c and d, which share most of their area, are a pair too.
    assert kept(table.drop(columns=LINKS_AND_SENSORS)) == [[("a", "a"), ("c", "c")]]
    table.loc[1, "label"] = "Pedestrian"
    table.loc[2, "dimensions.x"] = np.nan
    assert len(kept(table.drop(columns=LINKS_AND_SENSORS))[0]) == 4
    above = cuboids(("a", 0, "-", 0), ("b", 1, "-", 0))
    above.loc[1, "position.z"] = 6.0  # on a bridge
    assert len(kept(above)[0]) == 2


def test_a_track_keeps_to_the_sensor_that_sees_the_object_longest_and_to_one_name():
    pair = cuboids(("a", 0, "b", 0), ("b", 1, "a", 0))
    only_a, only_b = cuboids(("a", 0, "b", 0)), cuboids(("b", 1, "a", 0))
    assert kept(pair, only_a) == [[("a", "a")]] * 2
    assert kept(only_b, pair, pair) == [[("b", "b")]] * 3
    # Nothing is lost where only the other sensor has a box, and the object keeps its name.
    assert kept(only_b, pair, only_a, only_a) == [[("b", "a")], *[[("a", "a")]] * 3]
    # A sibling that is another from some frame on.
    renamed = cuboids(("a", 0, "c", 0), ("c", 1, "a", 0))
    assert kept(pair, renamed, cuboids(("c", 1, "a", 0))) == [[("a", "a")]] * 2 + [[("c", "a")]]


def test_two_boxes_of_one_sensor_are_never_one_object():
    chain = cuboids(("a", 0, "b", 0), ("b", 1, "a", 0), ("c", 0, "b", 1))
    assert kept(chain) == [[("a", "a"), ("c", "c")]]
    assert len(kept(cuboids(("a", 1, "b", 0), ("b", 1, "a", 0)))[0]) == 2
    twice = cuboids(("a", 0, "-", 0), ("a", 0, "-", 30))  # a name that the file has twice
    assert kept(twice) == [[("a", "a")] * 2]


def test_the_real_sequence_has_one_box_an_object_with_the_numbers_of_its_file(shared_dir):
    root = shared_dir / "data" / "pandaset_mini" / "002"
    if not root.is_dir():
        pytest.skip(f"no PandaSet sequence at {root}")
    tables = {frame: read_cuboids(root, frame) for frame in range(0, 26, 6)}
    labels, objects = PandaSetLabels(root), read_objects(root)
    count = 0
    for frame, table in tables.items():
        boxes, given = labels.boxes(frame), boxes_of_cuboids(table)
        rows = [given.track_ids.index(uuid) for uuid in boxes.attributes["uuid"]]
        assert rows == sorted(rows) and len(set(boxes.track_ids)) == len(boxes)
        # Of every box that is left out, the object's other one is there.
        assert {objects.names[uuid] for uuid in given.track_ids} == set(boxes.track_ids)
        for name in ("centers_m", "sizes_m", "quats"):
            np.testing.assert_array_equal(getattr(boxes, name), getattr(given, name)[rows])
        for name, column in boxes.attributes.items():
            np.testing.assert_array_equal(column, given.attributes[name][rows])
        count += len(boxes)
    assert (sum(map(len, tables.values())), count) == (593, 471)
    # Overlap alone finds the very pairs that are linked.
    for names in (LINKS, LINKS_AND_SENSORS):
        without = tie_boxes({frame: t.drop(columns=names) for frame, t in tables.items()})
        assert without.names == {uuid: objects.names[uuid] for uuid in without.names}


def moving(root: Path) -> set[str]:
    frames, chosen, origin, _ = read_frames(root, DriveOptions())
    return {box.object_id for box in read_sweeps(root, frames, chosen.held_out, origin)[1]}


@pytest.mark.parametrize("missing", [[], LINKS, LINKS_AND_SENSORS])
def test_one_vehicle_is_one_box_and_one_track_whatever_its_tables_say(own, missing):
    for frame in range(street.FRAMES):
        table = files.cuboids(frame, np.zeros(3))
        table = {name: table[name] for name in table if name not in missing}
        files.write_table(own / f"annotations/cuboids/{frame:02d}.pkl.gz", table)
    labels = PandaSetLabels(own)
    assert [labels.boxes(f).track_ids for f in range(3)] == [(files.CAR_IDS[0], "parked")] * 3
    assert moving(own) == {files.CAR_IDS[0]}
    # A damaged table is an error of its own frame alone.
    (own / "annotations/cuboids/01.pkl.gz").write_bytes(b"no table")
    assert len(labels.boxes(0)) == len(labels.boxes(2)) == 2
    with pytest.raises(AdapterError, match=r"cuboids/01\.pkl\.gz"):
        labels.boxes(1)


# A file, what is replaced in it by what, options, and the error
REFUSALS = [
    ("camera/left_camera/intrinsics.json", WHOLE, '{"fx": 1.0}', {}, "intrinsics.json: fy is miss"),
    ("camera/left_camera/intrinsics.json", WHOLE, "[1, 2]", {}, "must hold an object; got list"),
    (
        "camera/left_camera/intrinsics.json",
        '(?<="cy": )[^}]+',
        "NaN",
        {},
        "cy must be a finite num",
    ),
    ("camera/left_camera/poses.json", WHOLE, "[]", {}, "poses.json holds no poses"),
    (
        "camera/left_camera/poses.json",
        r"^.*?\}\}, ",
        "[",
        {},
        "has 2 poses; lidar/poses.json has 3",
    ),
    ("camera/left_camera/poses.json", '(?<="y": )[^,}]+', "1e999", {}, "0: position.y .*finite"),
    ("camera/left_camera/poses.json", '(?<="w": )[^,}]+', "true", {}, "0: heading.w .*got True"),
    ("camera/left_camera/poses.json", '(?<="w": )[^,}]+', "2", {}, "0: heading must be a unit"),
    ("camera/left_camera/poses.json", '(?<="z": )[^,}]+', "1" * 400, {}, "must be a valid number"),
    ("camera/left_camera/timestamps.json", WHOLE, "[0, 1]", {}, "has 2 entries; there are 3"),
    ("camera/left_camera/timestamps.json", WHOLE, "[0, 2, 1]", {}, "must be increasing; frame 2"),
    ("lidar/timestamps.json", WHOLE, '["now", 1, 2]', {}, "frame 0, seconds: must be a valid num"),
    ("lidar/timestamps.json", WHOLE, "[0, 1, 2e10]", {}, "frame 2, seconds: must be less than"),
    ("lidar/timestamps.json", WHOLE, "[0, 1, 2, 3]", {}, "has 4 entries; there are 3"),
    ("lidar/poses.json", WHOLE, '[{"position": 3}]', {}, "frame 0: position must be a valid"),
    ("lidar/poses.json", None, "", {}, r"poses\.json does not exist"),
    ("", "", "", {"voxels": "1"}, "'voxels'; did you mean 'voxel_m'. allowed are frames: .*; sky_"),
    ("", "", "", {"frames": "3"}, "frames must be first:stop.*got '3'"),
    ("", "", "", {"frames": "5:5"}, "frames must be first:stop"),
    ("", "", "", {"frames": "-1:5"}, "frames must be first:stop"),
    ("", "", "", {"voxel_m": "nan"}, "voxel_m must be a number of metres from 0.01 .* got 'nan'"),
    ("", "", "", {"max_gaussians": "1e6"}, "max_gaussians must be an integer from 1000"),
    ("", "", "", {"image_scale": "0.3"}, "image_scale must be one of 1, 0.5, 0.25, .* got '0.3'"),
    ("", "", "", {"sky_size": "4"}, "sky_size must be an integer from 8"),
    ("", "", "", {"held_out": "3"}, "held_out must be first:stop:step.*such as 1::2.*got '3'"),
    ("", "", "", {"held_out": "1::0"}, "held_out must be first:stop:step"),
    ("", "", "", {"held_out": "1:2:3:4"}, "held_out must be first:stop:step"),
    ("", "", "", {"held_out": "0::"}, r"held_out=0::1 holds out all 3 frames \(0 to 2\)"),
]


def test_a_sequence_that_contradicts_itself_is_refused(own):
    for name, pattern, text, query, message in REFUSALS:
        path = own / (name or "lidar/poses.json")
        with changed(path, pattern, text), pytest.raises(AdapterError, match=message) as caught:
            open_pandaset(str(own), query)
        assert Path(name).name in str(caught.value)


def test_a_lens_beyond_all_limits_is_refused_with_its_scene(own):
    path = own / "camera/left_camera/intrinsics.json"
    for focal in ("1e-320", "1e9"):
        with (
            changed(path, '(?<="fx": )[^,}]+', focal),
            pytest.raises(AdapterError, match=r"'pandaset:.*': frame 0, camera 'left_.*: fx must"),
        ):
            open_scene(f"pandaset:{own}")


def test_folders_that_are_no_sequence_are_refused(own):
    left = own / "camera/left_camera"
    (left / "03.jpg").write_bytes((left / "00.jpg").read_bytes())
    damage = (
        (lambda: None, r"image 03\.jpg, but timestamps\.json ends with frame"),
        (lambda: [path.unlink() for path in left.glob("*.jpg")], "left_camera holds no images"),
        (lambda: shutil.rmtree(left), "no LiDAR returns in 3 frames"),
        (lambda: (own / "camera").rename(own / "cam"), "camera holds no images <camera>/NN"),
        (lambda: own.rename(own.parent / "elsewhere"), "is not a folder"),
    )
    for path in (own / "lidar").glob("*.pkl.gz"):
        path.unlink()
    for change, message in damage:
        change()
        with pytest.raises(AdapterError, match=message):
            open_pandaset(str(own), QUERY)


def test_sweeps_pass_through_bit_for_bit_with_classes_known_by_name(own):
    table, labels = read_lidar(own, 1), PandaSetLabels(own)
    sweep = labels.lidar(1)
    assert list(sweep.columns) == ["x", "y", "z", "i", "t", "d", "semantic"]
    for name in "xyzitd":
        assert sweep.columns[name].dtype == table[name].dtype
        assert (sweep.columns[name] == table[name].to_numpy()).all()
    assert set(labels.lidar_classes(sweep)) == {
        SemanticClass.ROAD, SemanticClass.BUILDING, SemanticClass.VEHICLE,
    }  # fmt: skip
    assert class_meanings(own)[4] == NO_SURFACE  # of the published numbers
    names = own / "annotations/semseg/classes.json"
    names.write_text(json.dumps({"7": "Reflection", "41": "Road", "5": "Hovercraft"}))
    assert set(labels.lidar_classes(sweep)) == {NO_SURFACE, SemanticClass.ROAD, 0}
    for wrong in ([1, 2], {"x": "Road"}, {"9" * 5000: "Road"}, {"1": 2}):
        names.write_text(json.dumps(wrong))
        with pytest.raises(AdapterError, match=r"classes\.json must"):
            class_meanings(own)
