"""Safe reading of pickled tables and dictionaries of arrays (see `augment.files.pickles`).

The files come from strangers: nothing in them is run. The callers are the adapters of PandaSet and
Street Gaussians.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from augment.errors import AdapterError
from augment.files.pickles import (
    ARRAY_NAMES,
    ArrayRecord,
    Name,
    Pickle,
    PickleError,
    Record,
    read_npy,
    read_npy_header,
)
from recipes.files import open_file

MAX_BYTES = 1 << 29  # unpacked; a sweep of 170,000 points takes 8 MB
_CHUNK = 1 << 22
_GZIP_MAGIC = b"\x1f\x8b"


def read_frame(path: Path, *, max_bytes: int = MAX_BYTES) -> pd.DataFrame:
    """Read the pandas table pickled in a file, gzipped or not.

    Numbers, booleans and object columns (strings, None, NaN) of pandas 0.25 to 3 are read. pandas'
    own string columns, dates and categories are refused.

    Raises:
        AdapterError: the file is missing, truncated, larger than max_bytes when unpacked, asks for
            anything but tables and arrays, or holds no table.
    """
    stream = io.BytesIO(_read_bounded(path, max_bytes))
    try:
        content = Pickle(stream, _TABLE_NAMES).value()
        if isinstance(content, _Frame):
            return content.frame()
    except PickleError as error:
        raise AdapterError(
            f"{path} was not read: {error}. Only pickled pandas tables of numbers and object "
            f"columns of strings are accepted: obtain the file from the dataset's publisher again"
        ) from None
    kind = "ndarray" if isinstance(content, ArrayRecord) else type(content).__name__.lstrip("_")
    raise AdapterError(f"{path} must hold a pandas table; it holds a {kind}")


def read_array(path: Path, *, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """Read the numbers of a .npy file."""
    try:
        return read_npy(io.BytesIO(_read_bounded(path, max_bytes)))
    except PickleError as error:
        raise AdapterError(f"{path} is no readable array of numbers: {error}") from None


def read_array_dict(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read the arrays by name that `np.save` wrote as one dictionary into a .npy file."""
    stream = io.BytesIO(_read_bounded(path, max_bytes))
    try:
        check_holds_object(stream)
        content = _unwrapped(Pickle(stream, ARRAY_NAMES).value())
        arrays = {
            name: value.take()
            for name, value in content.items()
            if type(name) is str and isinstance(value, ArrayRecord)
        }
    except PickleError as error:
        raise AdapterError(
            f"{path} was not read: {error}. Only a .npy file of one dictionary of arrays is "
            f"accepted"
        ) from None
    if len(arrays) != len(content) or any(array.dtype.hasobject for array in arrays.values()):
        raise AdapterError(f"{path} must hold a dictionary of arrays; it holds something else")
    return arrays


def check_holds_object(file: BufferedIOBase) -> None:
    """Read the header of a .npy file that must hold one pickled object."""
    header = read_npy_header(file)
    if header.dtype is not None or header.shape != ():
        raise PickleError(
            f"it must hold one dictionary of arrays; it holds {header.dtype or 'objects'} "
            f"{list(header.shape)}"
        )


def stream_arrays(file: BufferedIOBase) -> Iterator[tuple[int, np.ndarray]]:
    """Yield number and array of every entry of a pickled dictionary, in the pickle's order.

    The pickle is a dictionary, bare or the only object of an array without axes, as `np.save`
    writes it. Each array is handed over and forgotten before the next is read: a file of many
    gigabytes passes through little memory. file: read forward from its position to the pickle's
    end.

    Raises:
        PickleError: anything else is in it, or it is cut short.
    """
    pickle = Pickle(file, ARRAY_NAMES, is_streamed=True)
    count = 0
    for record in pickle.steps():
        if isinstance(record, ArrayRecord) and record.values is not None:
            number = pickle.stack[-2] if len(pickle.stack) > 1 else None
            number = number.item() if isinstance(number, np.generic) else number
            if type(number) is not int:
                raise PickleError("it holds an array under something that is no number")
            array = record.take()
            if array.dtype.hasobject:
                raise PickleError("it holds an array of objects where numbers are expected")
            count += 1
            yield number, array
    content = _unwrapped(pickle.stack[-1])
    if len(content) != count or not all(isinstance(v, ArrayRecord) for v in content.values()):
        raise PickleError("it holds one array twice, or something that is no array")


def _unwrapped(content: Any) -> dict[Any, Any]:
    content = content.wrapped if isinstance(content, ArrayRecord) else content
    if type(content) is not dict:
        raise PickleError("it holds no dictionary")
    return content


# ---- Tables of pandas ----------------------------------------------------------------------------


class _Frame(Record):
    """Stand-in for a DataFrame.

    Its state is a dictionary whose `_mgr` (before pandas 1.1 `_data`) holds all.
    """

    def __init__(self) -> None:
        self.manager: Any = None

    def build(self, state: Any) -> None:
        if type(state) is not dict:
            raise PickleError("it holds a table without its columns")
        self.manager = state.get("_mgr", state.get("_data"))

    def frame(self) -> pd.DataFrame:
        if not isinstance(self.manager, _Manager) or len(self.manager.axes) != 2:
            raise PickleError("it holds a table without its columns")
        names, rows = (_index(axis) for axis in self.manager.axes)
        columns: list[np.ndarray | None] = [None] * len(names)
        for block in self.manager.blocks:
            for place, column in _columns(block, len(names), len(rows)):
                if columns[place] is not None:
                    raise PickleError(f"it holds column {place} twice")
                columns[place] = column
        if missing := [place for place, column in enumerate(columns) if column is None]:
            raise PickleError(f"it lacks column {missing[0]} of {len(names)}")
        # A type is given with each column: pandas would make its own text columns of objects.
        series = {
            place: pd.Series(column, index=rows, dtype=column.dtype)
            for place, column in enumerate(columns)
            if column is not None
        }
        table = pd.DataFrame(series, index=rows)
        table.columns = names
        return table


class _Manager(Record):
    """Columns of a table in blocks of one type. blocks: (values [columns, rows], places)."""

    def __init__(self, blocks: Any = (), axes: Any = (), *_: Any) -> None:
        self.blocks = blocks
        self.axes = axes
        if blocks:
            self.blocks = [(block.values, block.places) for block in blocks]

    def build(self, state: Any) -> None:
        """Take the state of pandas before 1.3, whose last entry counts."""
        content = state[-1]["0.14.1"]
        self.axes = content["axes"]
        self.blocks = [(block["values"], block["mgr_locs"]) for block in content["blocks"]]


@dataclass(frozen=True)
class _Block:
    values: Any
    places: Any
    dimensions: Any = 2


@dataclass(frozen=True)
class _Slice:
    start: Any
    stop: Any
    step: Any = None


class _IndexClass:
    """Stand-in for pandas' Index and its older classes by kind of number."""


@dataclass(frozen=True)
class _Index:
    data: Any
    name: Any


@dataclass(frozen=True)
class _RangeIndex:
    start: Any
    stop: Any
    step: Any
    name: Any = None


def _new_index(kind: Any, attributes: Any) -> _Index | _RangeIndex:
    if type(kind) is not Name or type(attributes) is not dict:
        raise PickleError("it holds an index of another kind")
    if kind.make is _RangeIndex:
        return _RangeIndex(**{str(key): value for key, value in attributes.items()})
    if kind.make is not _IndexClass:
        raise PickleError("it holds an index of another kind")
    return _Index(attributes["data"], attributes.get("name"))


def _index(record: Any) -> pd.Index:
    if isinstance(record, _RangeIndex):
        bounds = (record.start, record.stop, record.step)
        if not all(type(bound) is int and abs(bound) < 1 << 48 for bound in bounds):
            raise PickleError("it numbers its rows by what are no numbers")
        values: Any = pd.RangeIndex(*bounds)
        if len(values) > MAX_BYTES:
            raise PickleError(f"it numbers {len(values)} rows")
    elif isinstance(record, _Index) and isinstance(record.data, ArrayRecord):
        array = record.data.take()
        if array.ndim != 1:
            raise PickleError(f"it names rows or columns by an array {list(array.shape)}")
        values = pd.Index(array, dtype=array.dtype)
    else:
        raise PickleError("it holds rows or columns without names")
    name = record.name
    return values.rename(name if type(name) in (str, int) else None)


def _columns(block: Any, count: int, rows: int) -> Iterator[tuple[int, np.ndarray]]:
    """Return (place, values [rows]) of the columns of a block."""
    record, places = block
    if not isinstance(record, ArrayRecord):
        raise PickleError("it holds columns of another kind than numbers and objects")
    values = record.take()
    if isinstance(places, ArrayRecord):
        listed = places.take().tolist()
    elif isinstance(places, _Slice):
        listed = range(count)[slice(places.start, places.stop, places.step)]
    else:
        raise PickleError("it does not say which columns it holds")
    if values.shape != (len(listed), rows):
        raise PickleError(
            f"it holds values {list(values.shape)} for {len(listed)} columns of {rows} rows"
        )
    for place, column in zip(listed, values, strict=True):
        if type(place) is not int or not 0 <= place < count:
            raise PickleError(f"it holds a column {place} of {count}")
        yield place, column


def _table_names() -> dict[tuple[str, str], Callable[..., Any]]:
    table: dict[tuple[str, str], Callable[..., Any]] = {
        **ARRAY_NAMES,
        **{(module, "slice"): _Slice for module in ("builtins", "__builtin__")},
        ("pandas._libs.internals", "_unpickle_block"): _Block,
        ("pandas.core.indexes.base", "_new_Index"): _new_index,
    }
    homes = {
        "DataFrame": ("pandas.core.frame", _Frame),
        "RangeIndex": ("pandas.core.indexes.range", _RangeIndex),
        "Index": ("pandas.core.indexes.base", _IndexClass),
        # Before pandas 2 an index of numbers had a class of its own.
        "Int64Index": ("pandas.core.indexes.numeric", _IndexClass),
        "UInt64Index": ("pandas.core.indexes.numeric", _IndexClass),
        "Float64Index": ("pandas.core.indexes.numeric", _IndexClass),
    }
    for name, (home, record_class) in homes.items():
        table["pandas", name] = table[home, name] = record_class
    for module in ("pandas.core.internals.managers", "pandas.core.internals"):
        table[module, "BlockManager"] = _Manager
    return table


_TABLE_NAMES = _table_names()


def _read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a file's bytes, unpacked if gzipped, never more than max_bytes of them."""
    try:
        with open_file(path) as raw:
            zipped = raw.read(2) == _GZIP_MAGIC
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if zipped else raw
            chunks = []
            size = 0
            while chunk := stream.read(_CHUNK):
                size += len(chunk)
                if size > max_bytes:
                    raise AdapterError(
                        f"{path} unpacks to more than {max_bytes} bytes; a sweep or a list of "
                        f"boxes is far smaller, so the file is not what its name says"
                    )
                chunks.append(chunk)
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist") from None
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise AdapterError(
            f"{path} is not a whole gzip file ({error}); download it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error
    return b"".join(chunks)
