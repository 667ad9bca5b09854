"""Pickled point clouds, read without running what they ask for."""

from __future__ import annotations

import io
import pickle
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from adapters.safe_pickle import stream_arrays
from adapters.street_gaussians.adapter import iterate_point_clouds, read_point_cloud
from augment.errors import AdapterError
from augment.files.pickles import PickleError
from tests.adapters.street_gaussians_files import write_members, write_point_clouds

RNG = np.random.default_rng(7)


def clouds(frames: int = 5, points: int = 40, dtype=np.float64):
    return (
        {n: RNG.normal(size=(points + n, 3)).astype(dtype) for n in range(frames)},
        {n: RNG.integers(-1, 1900, (points + n, 6)).astype(np.int16) for n in range(frames)},
    )


def streamed(value, protocol: int = 4) -> dict[int, np.ndarray]:
    return dict(stream_arrays(io.BytesIO(pickle.dumps(value, protocol=protocol))))


def test_frames_come_back_in_whatever_order_they_are_asked_for(tmp_path):
    points, projections = clouds()
    write_point_clouds(tmp_path, points, projections)
    for frame in (1, 2, 9, 4, 0, 4, 2, 2, 9, 1):
        cloud = read_point_cloud(tmp_path, frame)
        if frame == 9:
            assert cloud is None
            continue
        np.testing.assert_array_equal(cloud.points, points[frame])
        np.testing.assert_array_equal(cloud.projections, projections[frame])
        assert cloud.points.dtype == np.float64 and cloud.projections.dtype == np.int16
    found = dict(iterate_point_clouds(tmp_path))
    assert list(found) == list(points)
    assert all((found[n].points == points[n]).all() for n in points)


def test_a_file_that_changed_is_opened_anew(tmp_path):
    points, projections = clouds()
    write_point_clouds(tmp_path, points, projections)
    read_point_cloud(tmp_path, 0)
    points, projections = clouds(points=55)
    write_point_clouds(tmp_path, points, projections)
    np.testing.assert_array_equal(read_point_cloud(tmp_path, 2).points, points[2])


def test_a_file_without_projections_or_no_file(tmp_path):
    points, _ = clouds(dtype=np.float32)
    write_point_clouds(tmp_path, points, None)
    cloud = read_point_cloud(tmp_path, 1)
    assert cloud.projections is None
    np.testing.assert_array_equal(cloud.points, points[1].astype(np.float64))
    assert read_point_cloud(tmp_path / "no", 1) is None
    assert dict(iterate_point_clouds(tmp_path / "no")) == {}


def test_threads_share_a_file(tmp_path):
    points, projections = clouds(frames=12)
    write_point_clouds(tmp_path, points, projections)
    frames = (5, 0, 11, 3, 7, 3, 1, 0)
    with ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda frame: read_point_cloud(tmp_path, frame).points, frames)
    for frame, read in zip(frames, found, strict=True):
        np.testing.assert_array_equal(read, points[frame])


def _sum_of(folder, frame, queue):
    queue.put((frame, float(read_point_cloud(folder, frame).points.sum())))


def test_a_forked_process_opens_the_file_itself(tmp_path):
    # Large enough that the file is not read whole at once.
    points, projections = clouds(frames=6, points=20_000)
    write_point_clouds(tmp_path, points, projections)
    read_point_cloud(tmp_path, 0)
    context = get_context("fork")
    queue = context.Queue()
    children = [context.Process(target=_sum_of, args=(tmp_path, n, queue)) for n in (2, 4)]
    for child in children:
        child.start()
    np.testing.assert_array_equal(read_point_cloud(tmp_path, 5).points, points[5])
    found = dict(queue.get(timeout=30) for _ in children)
    for child in children:
        child.join()
    assert found == {n: float(points[n].sum()) for n in (2, 4)}


def test_arrays_of_any_protocol_type_and_number():
    for protocol, dtype in ((3, "<f8"), (4, ">f4"), (3, "i2"), (4, "u1"), (4, "bool")):
        value = {n: RNG.integers(0, 2, (n + 1, 3)).astype(dtype) for n in range(4)}
        found = streamed(value, protocol)
        for number, array in value.items():
            np.testing.assert_array_equal(found[number], array)
            assert found[number].dtype == array.dtype.newbyteorder("=")
    # Numbers of numpy, columns in Fortran's order, the old name of numpy, and more than a batch.
    value = {np.int64(3): np.asfortranarray(RNG.normal(size=(50, 3))), np.int32(5): np.ones((2, 3))}
    data = pickle.dumps(value, protocol=3).replace(b"numpy._core", b"numpy.core")
    found = dict(stream_arrays(io.BytesIO(data)))
    assert list(found) == [3, 5]
    np.testing.assert_array_equal(found[3], value[np.int64(3)])
    assert len(streamed({n: np.full((2, 3), n, np.float32) for n in range(1001)})) == 1001


def test_one_array_at_a_time_is_held(tmp_path):
    """Arrays are handed over before the next one is read."""
    value = {n: np.zeros((1000, 3)) for n in range(50)}
    file = io.BytesIO(pickle.dumps(value, protocol=4))
    places = [file.tell() for _ in stream_arrays(file)]
    steps = np.diff(places)
    assert (steps > 20_000).all() and (steps < 30_000).all()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cut short"),
        (pickle.dumps({0: np.ones((9, 3))})[:-30], "cut short"),
        (pickle.dumps({"a": np.ones((2, 3))}), "no number"),
        (pickle.dumps({0: np.array([None], object)}), "objects where numbers"),
        (pickle.dumps({0: np.array(["x"])}), "else than numbers"),
        (pickle.dumps({0: np.zeros(2, [("x", "f4")])}), "else than numbers"),
        (b"\x80\x04" + b")" * 5 + b"R.", "calls something"),
        (b"\x80\x04}(K\x00", "cut short"),
        (b"\x80\x04t.", "no mark|damaged"),
        (b"\x80\x04B\xff\xff\xff\x7f", "states 2147483647 bytes"),
        (b"\x80\x04cnumpy" + b"x" * 5000, "name without end"),
        (b"\x80\x04cnumpy\nd\\type\n.", "with escapes"),
    ],
)
def test_damaged_and_strange_pickles_are_refused(data, message):
    with pytest.raises(PickleError, match=message):
        list(stream_arrays(io.BytesIO(data)))


def test_a_value_that_grows_when_it_is_shown_is_not_shown():
    # A tuple of a tuple twice, and so on: 2^60 long when printed. As an array's shape and as a key.
    grown = b")" + b"\x94" + b"2\x86" * 60  # DUP is no step of arrays
    with pytest.raises(PickleError, match="DUP"):
        list(stream_arrays(io.BytesIO(b"\x80\x04" + grown + b".")))
    grown = b")" + b"".join(b"q%ch%c\x86" % (n, n) for n in range(60))
    array = b"cnumpy.core.multiarray\n_reconstruct\n)R"
    dtype = b"cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R"
    start = time.process_time()
    for key, shape in ((grown, b"K\x01\x85"), (b"K\x00", grown)):
        state = b"(K\x01" + shape + dtype + b"\x89C\x08" + bytes(8) + b"t"
        with pytest.raises(PickleError):
            list(stream_arrays(io.BytesIO(b"\x80\x03}" + key + array + state + b"bs.")))
    assert time.process_time() - start < 1


def test_bytes_and_steps_that_no_array_takes_are_not_piled_up(monkeypatch):
    monkeypatch.setattr("augment.files.pickles.MAX_STREAMED_STEPS", 5000)
    with pytest.raises(PickleError, match="more than 5000 steps"):
        list(stream_arrays(io.BytesIO(b"\x80\x04)" + b"\x85" * 6000 + b".")))
    monkeypatch.setattr("augment.files.pickles.MAX_STREAMED_BYTES", 10_000)
    piece = b"B" + (6000).to_bytes(4, "little") + bytes(6000)
    with pytest.raises(PickleError, match=r"12\d* bytes that are in no array"):
        list(stream_arrays(io.BytesIO(b"\x80\x04" + piece * 2 + b".")))
    text = b"X" + (6000).to_bytes(4, "little") + b"x" * 6000
    with pytest.raises(PickleError, match=r"12\d* bytes that are in no array"):
        list(stream_arrays(io.BytesIO(b"\x80\x04" + text * 2 + b".")))
    value = {n: np.zeros((200, 3)) for n in range(50)}  # more than the limit together
    assert len(streamed(value)) == 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, q: (p | {2: np.ones((4, 2))}, q), r"pointcloud\[2\] must be floats \[N, 3\]"),
        (lambda p, q: (p | {2: np.ones((4, 3), int)}, q), r"pointcloud\[2\] must be floats"),
        (lambda p, q: (p, q | {2: q[1].copy()}), r"projection\[2\] must be .* a row for each"),
        (lambda p, q: (p, {n: q[n] for n in (0, 1, 3, 4)}), "same frames in the same order"),
        (lambda p, q: (p, {0: q[0]}), "same frames in the same order; got 1 and None"),
        (lambda p, q: (np.ones((3, 3)), q), r"one dictionary of arrays; it holds float64"),
        (lambda p, q: ({0: {"a": p[0]}}, q), "no number"),
        (lambda p, q: (p | {7: p[0]}, q | {7: q[0]}), "one array twice"),
    ],
)
def test_other_content_is_named(tmp_path, change, message):
    write_point_clouds(tmp_path, *change(*clouds()))
    for _ in range(2):  # an error is no end of the file
        with pytest.raises(AdapterError, match=message) as caught:
            read_point_cloud(tmp_path, 8)
        assert "pointcloud.npz" in str(caught.value)


def test_damaged_files_are_named(tmp_path):
    path = tmp_path / "pointcloud.npz"
    write_point_clouds(tmp_path, *clouds(points=5000))
    whole = path.read_bytes()
    at = len(whole) // 3
    for data in (b"no zip", whole[: len(whole) // 2], whole[:at] + bytes(64) + whole[at + 64 :]):
        path.write_bytes(data)
        with pytest.raises(AdapterError, match=r"pointcloud\.npz"):
            list(iterate_point_clouds(tmp_path))
    write_members(tmp_path, {"points.npy": b""})
    with pytest.raises(AdapterError, match=r"must hold the arrays pointcloud .*'points\.npy'"):
        list(iterate_point_clouds(tmp_path))
    write_members(tmp_path, {"pointcloud.npy": b"text"})
    with pytest.raises(AdapterError, match=r"pointcloud\.npy .*does not start as a \.npy file"):
        list(iterate_point_clouds(tmp_path))
