"""Tracked objects in the columns of a trained model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.street_gaussians.data import (
    ModelConfig,
    assign_columns,
    read_data,
    read_track_table,
    tracklets_of,
)
from augment.errors import AdapterError
from tests.adapters.street_gaussians_files import (
    HEADER,
    StreetObject,
    pose_about_z,
    write_as_street_gaussians,
)

FRONT = ModelConfig(cameras=(0, 1, 2))
ALL = ModelConfig(cameras=(0, 1, 2, 3, 4))


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_as_street_gaussians(tmp_path_factory.mktemp("street"), images=False, castrack=True)


@pytest.fixture()
def own_street(tmp_path):
    """A street whose files a test may change."""
    return write_as_street_gaussians(tmp_path / "own", images=False, lidar=False)


def test_objects_stand_in_the_first_free_columns_in_the_files_order(street):
    data = read_data(street.root, ALL)
    # The right side's 6 changes its column when the rider, before it in the file, appears.
    assert data.tracklets.ids.tolist() == [[1, 6, -1], [1, 4, 6], [1, 4, 6], [1, 4, 6]]
    assert [o.track_id for o in data.objects] == [1, 6, 4]
    data = read_data(street.root, FRONT)
    # Of five objects in view 0 and 3 hardly move, 2 is a sign, 6 is seen by no front camera.
    assert data.tracklets.ids.tolist() == [[1, -1], [1, 4], [1, 4], [1, 4]]
    assert [o.track_id for o in data.objects] == [1, 4]


def test_places_and_turns_are_those_of_the_objects_in_the_vehicles_frame(street):
    data = read_data(street.root, ALL)
    for step, number in enumerate(street.numbers):
        for column, track_id in enumerate(data.tracklets.ids[step].tolist()):
            if track_id < 0:
                continue
            pose = street.ego_from_object(track_id, number)
            w, _, _, z = data.tracklets.quats[step, column]
            np.testing.assert_allclose(data.tracklets.positions[step, column], pose[:3, 3])
            turn = pose_about_z(2 * np.arctan2(z, w), pose[:3, 3])
            np.testing.assert_allclose(turn, pose, atol=1e-9)


def test_sizes_are_the_largest_of_the_whole_file(tmp_path):
    fast = StreetObject(1, "vehicle", (4.4, 1.9, 1.5), (16, 3, 0.75), (-30, 0), np.pi)
    facts = write_as_street_gaussians(tmp_path, objects=(fast,), images=False, lidar=False)
    config = ModelConfig(cameras=(0,), selected_frames=(0, 1))
    (car,) = read_data(facts.root, config).objects
    # The largest box is of frame 2, which is not selected.
    np.testing.assert_allclose(car.size_m, (4.6, 1.9, 1.5))


def test_objects_are_drawn_a_little_longer_than_they_are_tracked(street):
    first, last = street.time_s(0), street.time_s(3, 2)  # the last image is FRONT_RIGHT's
    car, rider = read_data(street.root, FRONT).objects
    assert (car.start_frame, car.end_frame) == (0, 3)
    assert (rider.start_frame, rider.end_frame) == (1, 3)
    assert (car.start_s, car.end_s) == pytest.approx((first, last), abs=1e-6)
    assert rider.start_s == pytest.approx(street.time_s(1) - 0.1, abs=1e-6)
    assert rider.end_s == pytest.approx(last, abs=1e-6)  # earlier than 0.1 s after frame 3
    config = ModelConfig(cameras=(0,), selected_frames=(1, 3))
    _, rider = read_data(street.root, config).objects
    assert rider.start_s == pytest.approx(street.time_s(1), abs=1e-6)


def test_what_the_trackers_files_lack_is_not_there(street):
    data = read_data(street.root, ModelConfig(use_tracker=True))
    assert data.tracklets.ids.tolist() == [[1]] * 4


def test_only_what_moves_within_the_selection_is_kept(street):
    # In 0.2 s the oncoming car goes 2.4 m, the rider, in view for half of it, 1.1 m.
    data = read_data(street.root, ModelConfig(cameras=(0,), selected_frames=(0, 2)))
    assert [o.track_id for o in data.objects] == [1]
    data = read_data(street.root, ModelConfig(cameras=(0,), selected_frames=(2, 2)))
    assert data.objects == () and data.tracklets.ids.tolist() == [[-1]]


def test_without_any_row_there_is_one_empty_column(own_street):
    (own_street.root / "track/track_info.txt").write_text(HEADER)
    data = read_data(own_street.root, FRONT)
    assert data.tracklets.ids.tolist() == [[-1]] * 4
    assert data.tracklets.positions.shape == (4, 1, 3) and data.tracklets.quats.shape == (4, 1, 4)


def test_rows_are_not_compacted_where_a_frame_still_fills_every_column(tmp_path):
    # Frame 0 holds two moving objects; later the still one stands before the only other.
    still = StreetObject(3, "vehicle", (4, 2, 1.5), (12, 4, 0.7), frames=(1, 2, 3))
    first = StreetObject(5, "vehicle", (4, 2, 1.5), (20, 3, 0.7), (-30, 0), frames=(0, 1))
    second = StreetObject(7, "vehicle", (4, 2, 1.5), (25, -3, 0.7), (15, 0))
    facts = write_as_street_gaussians(
        tmp_path, objects=(still, first, second), images=False, lidar=False
    )
    data = read_data(facts.root, FRONT)
    # Frame 1 is the only one with three rows, so that there are three columns at first.
    assert data.tracklets.ids.tolist() == [[5, 7], [5, 7], [7, -1], [7, -1]]

    first = StreetObject(5, "vehicle", (4, 2, 1.5), (20, 3, 0.7), (-60, 0), frames=(0, 3))
    still = StreetObject(3, "vehicle", (4, 2, 1.5), (12, 4, 0.7), frames=(1, 2))
    facts = write_as_street_gaussians(
        tmp_path, objects=(still, first, second), images=False, lidar=False
    )
    # Never more than two rows: where the still one was, its column stays empty.
    data = read_data(facts.root, FRONT)
    assert data.tracklets.ids.tolist() == [[5, 7], [-1, 7], [-1, 7], [5, 7]]


def test_a_file_that_begins_without_names_loses_its_first_row_and_says_so(own_street):
    path = own_street.root / "track/track_info.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    data = read_data(own_street.root, FRONT)
    assert any("line 1" in p and "track_info.txt" in p for p in data.problems)


def change_line(root: Path, line: int, change) -> Path:
    path = root / "track" / "track_info.txt"
    lines = path.read_text().splitlines()
    lines[line - 1] = change(lines[line - 1])
    path.write_text("\n".join(lines) + "\n")
    return path


def word(number: int, value: str):
    def change(text: str) -> str:
        words = text.split()
        words[number] = value
        return " ".join(words)

    return change


@pytest.mark.parametrize(
    ("line", "change", "message"),
    [
        (3, lambda text: " ".join(text.split()[:8]), r"line 3: .*box_center_y: Field required"),
        (4, word(7, "left"), r"line 4: .*box_center_x: Input should be a valid number.*got left"),
        (5, word(10, "nan"), r"line 5: .*box_heading: Input should be a finite number"),
        (5, word(11, "inf"), r"line 5: .*speed: Input should be a finite number"),
        (2, word(4, "0"), r"line 2: .*box_height: Input should be greater than 0 .got 0"),
        (2, word(0, "-1"), r"line 2: .*frame_id: Input should be greater than or equal to 0"),
        (2, word(1, "car"), r"line 2: .*track_id: Input should be a valid integer.*got car"),
        (6, lambda text: " ".join(text.split()[:11]), r"line 6: all rows must hold a speed"),
        (4, word(1, "0"), r"line 4: object 0 is already in frame 0 by line 2"),
        (3, word(1, "77"), r"line 3: .*camera_vis\.json does not say .* object 77 in frame 0"),
    ],
)
def test_damaged_rows_are_named_by_file_and_line(own_street, line, change, message):
    path = change_line(own_street.root, line, change)
    with pytest.raises(AdapterError, match=message) as caught:
        read_data(own_street.root, FRONT)
    assert str(path) in str(caught.value)


def test_damaged_and_missing_track_files_are_named(own_street):
    path = own_street.root / "track/track_camera_vis.json"
    for content in (
        '{"1": [0]}', '{"x": {"0": [0]}}', '{"1": {"0": 3}}', '{"1": {"0": ["FRONT"]}}',
    ):  # fmt: skip
        path.write_text(content)
        with pytest.raises(AdapterError, match=r"camera_vis\.json: not a valid list of cam"):
            read_data(own_street.root, FRONT)
    for name in ("track_camera_vis.json", "track_info.txt"):
        (own_street.root / "track" / name).unlink()
        with pytest.raises(AdapterError, match=rf"track/{name} does not exist"):
            read_data(own_street.root, FRONT)


def slow_columns(rows, frames, poses):
    """Ids by frame and column, one step after the other. rows: (frame, id, x, y)."""
    columns = [[i for f, i, *_ in rows if f == frame] for frame in frames]
    width = max(map(len, columns))
    table = [column + [-1] * (width - len(column)) for column in columns]
    places = {}
    for step, column in enumerate(table):
        for found in (i for i in column if i >= 0):
            (at,) = [(x, y, 0, 1) for f, i, x, y in rows if (f, i) == (frames[step], found)]
            places.setdefault(found, []).append((poses[step] @ np.array(at))[:3])
    moving = {
        i
        for i, p in places.items()
        if max(np.std(p, axis=0)) > 0.5 or np.linalg.norm(p[-1] - p[0]) > 2
    }
    table = [[i if i in moving else -1 for i in column] for column in table]
    most = max(sum(i >= 0 for i in column) for column in table)
    if most < width:
        kept = [[i for i in column if i >= 0] for column in table]
        table = [column + [-1] * (most - len(column)) for column in kept]
    return table if most else [[-1]] * len(frames)


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_columns_are_those_of_going_through_the_file_by_hand(tmp_path_factory, data):
    objects = data.draw(st.integers(1, 5))
    speeds = data.draw(
        st.lists(st.sampled_from([0.0, 0.1, 1.5]), min_size=objects, max_size=objects)
    )
    seen = data.draw(
        st.lists(st.tuples(st.integers(2, 6), st.integers(0, objects - 1)), min_size=1, unique=True)
    )
    poses = np.stack([pose_about_z(0.3 * k, (2.0 * k, k, 0)) for k in range(4)])
    rows = []
    for frame, number in seen:
        ego = poses[min(max(frame - 3, 0), 3)]
        world = np.array([10 + speeds[number] * frame, number, 0, 1])
        rows.append((frame, number, *(np.linalg.inv(ego) @ world)[:2]))
    path = tmp_path_factory.mktemp("rows") / "track_info.txt"
    text = [f"{f} {i} vehicle -10 1.5 2 4 {x!r} {y!r} 0 0.5 0" for f, i, x, y in rows]
    path.write_text(HEADER + "\n".join(text).replace("np.float64(", "").replace(")", ""))
    table = read_track_table(path)
    frames = range(3, 7)
    placed = assign_columns(table, np.arange(len(table)), frames, poses)
    if any(f in frames for f, *_ in rows):
        assert tracklets_of(table, placed).ids.tolist() == slow_columns(rows, frames, poses)
    else:
        assert tracklets_of(table, placed).ids.tolist() == [[-1]] * 4
