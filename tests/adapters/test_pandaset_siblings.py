"""Cuboids of one object: by PandaSet's links as they are published, and without any."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pandaset_folder as street
import pytest

from adapters.pandaset.adapter import read_drive
from adapters.pandaset.files import (
    PandaSetLabels,
    boxes_of_cuboids,
    find_objects,
    read_cuboids,
    read_objects,
    read_sequence,
)
from augment.errors import AdapterError

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
    objects = find_objects(dict(enumerate(tables)))
    uuids = [t["uuid"][objects.kept(t["uuid"])] for t in tables]
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


@pytest.mark.parametrize("missing", [[], LINKS, LINKS_AND_SENSORS])
def test_one_vehicle_is_one_box_and_one_track_whatever_its_tables_say(tmp_path, missing):
    root = street.write_sequence(tmp_path / "002")
    for frame in range(street.FRAMES):
        table = street._cuboids(frame, np.zeros(3))
        table = {name: table[name] for name in table if name not in missing}
        street.write_table(root / f"annotations/cuboids/{frame:02d}.pkl.gz", table)
    labels = PandaSetLabels(root)
    assert [labels.boxes(f).track_ids for f in range(3)] == [(street.CAR_IDS[0], "parked")] * 3
    drive = read_drive(read_sequence(root), range(3))
    assert {sample.object_id for sample in drive.samples} == {street.CAR_IDS[0]}


def test_a_damaged_table_is_an_error_of_its_own_frame_alone(tmp_path):
    root = street.write_sequence(tmp_path / "002")
    (root / "annotations/cuboids/01.pkl.gz").write_bytes(b"no table")
    labels = PandaSetLabels(root)
    assert len(labels.boxes(0)) == len(labels.boxes(2)) == 2
    with pytest.raises(AdapterError, match=r"cuboids/01\.pkl\.gz"):
        labels.boxes(1)


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
        without = find_objects({frame: t.drop(columns=names) for frame, t in tables.items()})
        assert without.names == {uuid: objects.names[uuid] for uuid in without.names}
