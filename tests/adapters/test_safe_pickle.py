"""Reading pickled tables without running them."""

from __future__ import annotations

import builtins
import copyreg
import encodings.cp437  # noqa: F401  (zipfile decodes the names of a damaged archive by it)
import gzip
import os
import pickle
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from adapters.safe_pickle import read_array_dict, read_frame, stream_arrays
from augment.errors import AdapterError
from augment.files.checkpoints import load_checkpoint
from augment.files.pickles import PickleError
from tests.adapters.pandaset_files import write_table


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
        (builtins.eval, ("open('{marker}', 'w')",), "eval"),
        (builtins.getattr, (np.ndarray, "tofile"), "getattr"),
        (np.load, ("{marker}",), "numpy.load"),
        (pd.read_pickle, ("{marker}",), "read_pickle"),
    ],
)
@pytest.mark.parametrize("is_hidden", [False, True])
def test_what_a_hostile_file_asks_for_is_refused_by_name(
    tmp_path, function, arguments, name, is_hidden
):
    marker = tmp_path / "marker"
    arguments = tuple(a.format(marker=marker) if isinstance(a, str) else a for a in arguments)
    value = Calls(function, *arguments)
    if is_hidden:  # among the texts of a table
        column = np.empty(3, dtype=object)
        column[:] = [value] * 3
        value = table().assign(label=pd.Series(column, dtype=object))
    path = write(tmp_path / "bad.pkl.gz", value, protocol=2 + 2 * is_hidden)
    with pytest.raises(AdapterError, match=rf"bad\.pkl\.gz was not read: it asks for .*{name}"):
        read_frame(path)
    assert not marker.exists()


def test_what_is_no_whole_table_is_named(tmp_path):
    path = tmp_path / "t.pkl"
    for value in ([1, 2], {"x": 1}, np.zeros(3), "text"):
        with pytest.raises(AdapterError, match=f"a pandas table; .* {type(value).__name__}"):
            read_frame(write(path, value))
    data = pickle.dumps(table())
    zipped = gzip.compress(
        pickle.dumps(pd.DataFrame(np.random.default_rng(0).normal(size=(2000, 4))))
    )
    for broken, message in (
        (data[:-40], "cut short"),
        (data[: len(data) // 2], "cut short"),
        (b"", "cut short"),
        (b"hello", "was not read"),
        (b"\x80\x04\x95" + b"\xff" * 9, "cut short"),
        (zipped[: len(zipped) // 10], "is not a whole gzip file.*download"),
        (zipped[:-500], "is not a whole gzip file.*download"),
    ):
        path.write_bytes(broken)
        with pytest.raises(AdapterError, match=rf"t\.pkl.*{message}"):
            read_frame(path)
    with pytest.raises(AdapterError, match=r"none\.pkl\.gz does not exist"):
        read_frame(tmp_path / "none.pkl.gz")


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


WATCHED = (
    "import", "exec", "compile", "open", "ctypes.", "os.", "subprocess.", "socket.", "marshal.",
)  # fmt: skip


class _Watch:
    """An audit hook cannot be removed: it looks only while a path is set."""

    path: str | None = None
    seen: str | None = None

    def __call__(self, event: str, arguments: tuple) -> None:
        if self.path is None or not event.startswith(WATCHED):
            return
        if event == "open" and (str(arguments[0]) == self.path or isinstance(arguments[0], int)):
            return  # the file, or a descriptor that is open already
        self.seen = f"{event} {arguments!r}"[:300]


_watch = _Watch()


@contextmanager
def nothing_runs(path: Path) -> Iterator[None]:
    """Fails if anything is imported, compiled, executed or opened, but the path itself."""
    if not hasattr(sys, "_watch_is_installed"):
        sys.addaudithook(_watch)
        sys._watch_is_installed = True
    _watch.path, _watch.seen = str(path), None
    try:
        yield
    finally:
        _watch.path = None
    assert _watch.seen is None, _watch.seen


# ---- what a file may be made of --------------------------------------------------------------


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def number(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def content(value: bytes) -> bytes:
    return b"B" + struct.pack("<I", len(value)) + value


def name(module: str, attribute: str) -> bytes:
    return b"c" + module.encode() + b"\n" + attribute.encode() + b"\n"


def tuple_of(*items: bytes) -> bytes:
    return b"(" + b"".join(items) + b"t"


def called(function: bytes, *arguments: bytes) -> bytes:
    return function + tuple_of(*arguments) + b"R"


NONE, FALSE, TRUE = b"N", b"\x89", b"\x88"
DTYPE, NDARRAY = name("numpy", "dtype"), name("numpy", "ndarray")
CORE = "numpy.core.multiarray"


def dtype(
    code="f8", order="<", sub=NONE, names=NONE, fields=NONE, size=-1, align=-1, flags=0, more=()
):
    numbers = (number(size), number(align), number(flags))
    state = tuple_of(number(3), text(order), sub, names, fields, *numbers, *more)
    return called(DTYPE, text(code), FALSE, TRUE) + state + b"b"


def array(kind=None, shape=None, data=None, target=NDARRAY, order=FALSE, more=()) -> bytes:
    kind = dtype() if kind is None else kind
    shape = tuple_of(number(2)) if shape is None else shape
    data = content(bytes(16)) if data is None else data
    made = called(name(CORE, "_reconstruct"), target, tuple_of(number(0)), content(b"b"))
    return made + tuple_of(number(1), shape, kind, order, data, *more) + b"b"


def dictionary(value: bytes) -> bytes:
    """A .npy file of {"a": value}, as `np.save` frames it."""
    pickled = b"\x80\x02}" + text("a") + value + b"s."
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + pickled


OBJECTS = dtype("O8", order="|", flags=63)
FIELD = b"}" + text("rc") + tuple_of(dtype("i8"), number(-32)) + b"s"
HUGE = b"\x8a\x08" + struct.pack("<q", 1 << 60)
FILLED = tuple_of(number(1), tuple_of(number(2)), dtype(), FALSE, content(bytes(16))) + b"b"
TITLE = b"}" + text("t") + tuple_of(dtype(), number(0), text("T")) + b"s"
HOSTILE = {
    "fields": array(dtype("V8", names=tuple_of(text("rc")), fields=FIELD, size=8)),
    "fields of a plain code": array(dtype("f8", names=tuple_of(text("rc")), fields=FIELD)),
    "sub-array": array(dtype("V16", sub=tuple_of(dtype(), tuple_of(number(2))), size=16)),
    "sub-array of a plain code": array(dtype(sub=tuple_of(dtype(), tuple_of(number(2))))),
    "titles": array(dtype("f8", fields=TITLE)),
    "metadata": array(dtype(more=(b"}",))),
    "objects without their flag": array(dtype("O8", order="|", flags=0), data=content(bytes(16))),
    "objects of raw bytes": array(OBJECTS, data=content(bytes(16))),
    "numbers with objects' flag": array(dtype(flags=63)),
    "size of its own": array(dtype(size=1 << 20)),
    "alignment of its own": array(dtype(align=4)),
    "records": array(called(DTYPE, text("f4,f4"), FALSE, TRUE)),
    "dates": array(dtype("M8")),
    "texts": array(dtype("U2")),
    "void": array(dtype("V8", size=8)),
    "a list as type": array(called(DTYPE, b"]" + text("f8") + b"a", FALSE, TRUE)),
    "aligned type": array(called(DTYPE, text("f8"), TRUE, TRUE)),
    "wrong size": array(data=content(bytes(15))),
    "negative side": array(shape=tuple_of(number(-1), number(-2))),
    "huge shape": array(shape=tuple_of(HUGE)),
    "huge empty shape": array(shape=tuple_of(HUGE, HUGE, number(0)), data=content(b"")),
    "a shape of True": array(shape=tuple_of(TRUE)),
    "bytes for a list": array(OBJECTS, data=content(b"ab")),
    "a cell that is a list": array(OBJECTS, data=b"](]]e"),
    "filled twice": array() + FILLED,
    "subclass": array(target=name("numpy", "matrix")),
    "subclass by its module": array(target=name("numpy.core.records", "recarray")),
    "_reconstruct of dtype": array(target=DTYPE),
    "memory by ndarray": called(NDARRAY, tuple_of(number(1)), dtype(), content(b"x"), number(8)),
    "scalar of raw bytes": called(name(CORE, "scalar"), OBJECTS, content(bytes(8))),
    "scalar of void": called(name(CORE, "scalar"), dtype("V64", size=64), content(bytes(64))),
    "scalar longer than its bytes": called(name(CORE, "scalar"), dtype(), content(bytes(4))),
    "state of a name": NDARRAY + b"}" + text("__init__") + number(1) + b"sb",
    "state of a text": text("x") + b"}b",
    "state of a list": b"]}b",
    "state of a tuple": b")}b",
    "state of a number": number(1) + b"}b",
    "a call of what was made": array() + b")R",
    "a call by a list": NDARRAY + b"]R",
    "a new object by keywords": NDARRAY + b")}\x92",
    "an instance": b"(inumpy\nndarray\n",
    "an object": b"(" + NDARRAY + b"o",
    "an extension": b"\x82\x01",
    "a long extension": b"\x84\x01\x00\x00\x00",
    "a persistent id": text("x") + b"Q",
    "a buffer out of band": b"\x97",
    "a buffer made read-only": content(b"x") + b"\x98",
    "what the memo lacks": b"h\x07",
    "one array twice": array() + b"q\x01s" + text("b") + b"h\x01",
    "a memo of gigabytes": number(1) + b"r\xff\xff\xff\x7f" + b"j\xff\xff\xff\x7e",
    "endless bytes": b"\x8e" + HUGE[2:],
    "an endless bytearray": b"\x96" + HUGE[2:],
    "the array itself in its state": array()[:-1] + b"q\x01h\x01b",
    "a dotted name": b"\x8c\x05numpy\x8c\x10ndarray.__init__\x93",
    "a name by a number": number(1) + number(2) + b"\x93",
    "another codec": called(name("_codecs", "encode"), text("x"), text("rot13")),
    "an endless number": b"\x8b" + struct.pack("<i", 1 << 30),
    "axes that are not there": called(
        name("numpy.core.numeric", "_frombuffer"), content(bytes(16)), dtype(),
        tuple_of(number(2)), text("K"), tuple_of(number(5)),
    ),
}  # fmt: skip


def test_what_a_pickle_says_of_arrays_is_believed_in_plain_cases_only(tmp_path):
    path = tmp_path / "a.npy"
    path.write_bytes(dictionary(array()))
    assert read_array_dict(path)["a"].tolist() == [0, 0]  # the frame of all the cases is sound
    for what, data in HOSTILE.items():
        path.write_bytes(dictionary(data))
        with nothing_runs(path), pytest.raises(AdapterError, match=r"a\.npy"):
            pytest.fail(f"{what}: {read_array_dict(path)}")


def test_the_known_attack_by_numpys_own_constructors_is_refused(tmp_path, shared_dir):
    tool = shared_dir / "tools" / "hostile-pickle"
    if not tool.is_file():
        pytest.skip(f"no {tool}")
    path, marker = tmp_path / "hostile.pkl.gz", tmp_path / "marker"
    subprocess.run([sys.executable, str(tool), str(path), str(marker)], check=True)
    with nothing_runs(path), pytest.raises(AdapterError, match=r"hostile\.pkl\.gz was not read"):
        read_frame(path)
    assert not marker.exists()


# ---- real files, changed at random -----------------------------------------------------------


def _stream(path: Path) -> None:
    with open(path, "rb") as file:
        for _ in stream_arrays(file):
            pass


def _files(folder: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    for protocol in (2, 3, 4, 5):
        (folder / f"{protocol}.pkl").write_bytes(pickle.dumps(table(), protocol))
    (folder / "table.pkl.gz").write_bytes(gzip.compress(pickle.dumps(table(), 4), 1))
    np.save(folder / "a.npy", {"mask": np.eye(3), "value": np.arange(4)})
    arrays = {n: np.arange(6.0).reshape(2, 3) for n in range(3)}
    (folder / "stream.pkl").write_bytes(pickle.dumps(arrays, 4))
    weights = {"w": torch.nn.Parameter(torch.eye(3)), "step": 4, "half": torch.ones(2).half()}
    torch.save(weights, folder / "new.pth")
    torch.save(weights, folder / "old.pth", _use_new_zipfile_serialization=False)
    readers: dict[str, Callable] = {".npy": read_array_dict, ".pth": load_checkpoint}
    return [
        (path, _stream if path.name == "stream.pkl" else readers.get(path.suffix, read_frame))
        for path in sorted(folder.iterdir())
    ]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, cut out, doubled, or moved."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, other = rng.integers(0, len(changed), 2)
        length = int(rng.integers(1, 24))
        match rng.integers(0, 5):
            case 0:
                changed[at] = rng.integers(0, 256)
            case 1:
                changed[at] ^= 1 << rng.integers(0, 8)
            case 2:
                del changed[at : at + length]
            case 3:
                changed[at:at] = changed[other : other + length]
            case _:
                changed[at : at + length] = changed[other : other + length]
        changed = changed or bytearray(b"x")
    return bytes(changed)


@pytest.mark.parametrize("mutations", [15, pytest.param(300, marks=pytest.mark.long)])
def test_files_changed_at_random_run_nothing_and_give_our_errors(tmp_path, mutations):
    rng = np.random.default_rng(mutations)
    (tmp_path / "whole").mkdir()
    for whole, read in _files(tmp_path / "whole"):
        read(whole)  # whatever is imported at first use
        data = whole.read_bytes()
        path = tmp_path / whole.name
        for _ in range(mutations):
            path.write_bytes(mutated(data, rng))
            with nothing_runs(path), suppress(AdapterError, PickleError):
                read(path)
