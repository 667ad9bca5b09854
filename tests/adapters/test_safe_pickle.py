"""Reading pickled tables without running them."""

from __future__ import annotations

import builtins
import copyreg
import gzip
import operator
import os
import pickle
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pandaset_folder import write_table

from adapters.safe_pickle import read_frame
from augment.errors import AdapterError


class Calls:
    """Unpickles by calling a function: what a hostile file does."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def write(path: Path, value: object, protocol: int = 4) -> Path:
    path.write_bytes(gzip.compress(pickle.dumps(value, protocol=protocol), 1))
    return path


def table() -> pd.DataFrame:
    columns = {
        "x": pd.Series([1.5, -2.0, np.nan]),
        "d": pd.Series([0, 1, 0]),
        "label": pd.Series(["Car", None, np.nan], dtype=object),
        "stationary": pd.Series([True, False, True]),
    }
    frame = pd.DataFrame(columns)
    frame.columns = pd.Index(list(columns), dtype=object)
    return frame


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_tables_come_back_as_they_were(tmp_path, protocol):
    expected = table()
    read = read_frame(write(tmp_path / "t.pkl.gz", expected, protocol))
    pd.testing.assert_frame_equal(read, expected)


def test_a_file_that_is_not_gzipped_is_read_too(tmp_path):
    path = tmp_path / "t.pkl"
    path.write_bytes(pickle.dumps(table()))
    pd.testing.assert_frame_equal(read_frame(path), table())


def test_a_table_indexed_and_named_as_the_dataset_does(tmp_path):
    write_table(tmp_path / "t.pkl.gz", {"uuid": ["a", "b"], "yaw": np.array([0.1, 0.2])})
    read = read_frame(tmp_path / "t.pkl.gz")
    assert list(read["uuid"]) == ["a", "b"] and list(read["yaw"]) == [0.1, 0.2]


class OldFrame:
    """Pickles as a DataFrame of pandas 0.25 did: its manager as `_data`."""

    def __init__(self, values: np.ndarray):
        self.values = values

    def __reduce__(self):
        state = {"_data": OldManager(self.values), "_typ": "dataframe", "_metadata": []}
        return copyreg.__newobj__, (OldFrame,), state


class OldManager:
    def __init__(self, values: np.ndarray):
        self.values = values

    def __reduce__(self):
        axes = [pd.Index(["x", "y"], dtype=object), pd.RangeIndex(self.values.shape[1])]
        blocks = [{"values": self.values, "mgr_locs": slice(0, 2, 1)}]
        state = (axes, [self.values], [axes[0]], {"0.14.1": {"axes": axes, "blocks": blocks}})
        return copyreg.__newobj__, (OldManager,), state


def test_a_table_of_an_old_pandas_and_numpy_is_read(tmp_path):
    values = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    data = pickle.dumps(OldFrame(values), protocol=2)
    module = OldFrame.__module__.encode()
    for ours, theirs in (
        (b"c" + module + b"\nOldFrame\n", b"cpandas.core.frame\nDataFrame\n"),
        (b"c" + module + b"\nOldManager\n", b"cpandas.core.internals.managers\nBlockManager\n"),
        (b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"),
    ):
        assert ours in data
        data = data.replace(ours, theirs)
    (tmp_path / "old.pkl").write_bytes(data)
    read = read_frame(tmp_path / "old.pkl")
    assert list(read.columns) == ["x", "y"]
    np.testing.assert_array_equal(read.to_numpy(), values.T)


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (os.system, ("echo run > {marker}",), r"\.system"),
        (builtins.eval, ("open('{marker}', 'w')",), "builtins.eval"),
        (builtins.exec, ("open('{marker}', 'w')",), "builtins.exec"),
        (builtins.getattr, (np.ndarray, "tofile"), "builtins.getattr"),
        (operator.attrgetter, ("__class__",), "operator.attrgetter"),
        (np.load, ("{marker}",), "numpy.load"),
        (pd.read_pickle, ("{marker}",), "read_pickle"),
        (pd.eval, ("1 + 1",), "eval"),
    ],
)
def test_what_a_hostile_file_asks_for_is_refused_by_name(tmp_path, function, arguments, name):
    marker = tmp_path / "marker"
    arguments = tuple(a.format(marker=marker) if isinstance(a, str) else a for a in arguments)
    path = write(tmp_path / "bad.pkl.gz", Calls(function, *arguments))
    with pytest.raises(AdapterError, match=rf"bad\.pkl\.gz was not read: it asks for .*{name}"):
        read_frame(path)
    assert not marker.exists()


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_call_hidden_in_an_object_column_is_refused(tmp_path, protocol):
    frame = table()
    column = np.empty(3, dtype=object)
    column[:] = [Calls(os.system, f"touch {tmp_path / 'marker'}")] * 3
    frame["label"] = pd.Series(column, dtype=object)
    with pytest.raises(AdapterError, match="system"):
        read_frame(write(tmp_path / "bad.pkl.gz", frame, protocol))
    assert not (tmp_path / "marker").exists()


@pytest.mark.parametrize("value", [[1, 2], {"x": 1}, np.zeros(3), "text"])
def test_something_else_than_a_table_is_refused(tmp_path, value):
    with pytest.raises(AdapterError, match=f"must hold a pandas table; .* {type(value).__name__}"):
        read_frame(write(tmp_path / "t.pkl.gz", value))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(AdapterError, match=r"none\.pkl\.gz does not exist"):
        read_frame(tmp_path / "none.pkl.gz")


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95])
def test_a_truncated_gzip_file_is_named(tmp_path, kept):
    frame = pd.DataFrame(np.random.default_rng(0).normal(size=(2000, 4)))
    path = write(tmp_path / "t.pkl.gz", frame)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(AdapterError, match=r"t\.pkl\.gz is not a whole gzip file.*download"):
        read_frame(path)


def test_a_truncated_or_garbled_pickle_is_named(tmp_path):
    data = pickle.dumps(table())
    for broken in (
        data[:-40],
        data[: len(data) // 2],
        b"",
        b"hello",
        b"\x80\x04\x95" + b"\xff" * 9,
    ):
        (tmp_path / "t.pkl").write_bytes(broken)
        with pytest.raises(AdapterError, match=r"t\.pkl"):
            read_frame(tmp_path / "t.pkl")


def test_a_zip_bomb_stops_at_the_bound(tmp_path):
    path = tmp_path / "bomb.pkl.gz"
    path.write_bytes(gzip.compress(bytes(40_000_000), 1))
    with pytest.raises(AdapterError, match="unpacks to more than 1000000 bytes"):
        read_frame(path, max_bytes=1_000_000)


def test_the_real_files_are_what_pandas_reads(shared_dir):
    root = shared_dir / "data" / "pandaset_mini" / "002"
    if not root.is_dir():
        pytest.skip(f"no PandaSet sequence at {root}")
    for name in ("lidar/00", "annotations/cuboids/00", "annotations/semseg/00"):
        path = root / f"{name}.pkl.gz"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pandas' own reader may deprecate what it finds
            expected = pd.read_pickle(path)
        pd.testing.assert_frame_equal(read_frame(path), expected)
