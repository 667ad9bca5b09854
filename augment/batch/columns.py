"""NumPy columns in Parquet files, and back with the same bits and the same dtypes.

Parquet has fewer types than NumPy: `<U5` becomes a string, an object column a string or JSON. Each
column's NumPy dtype is therefore kept in the file's metadata and restored by `unpack_column`.
Writing fails for a column that could not be restored exactly.
"""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from augment.errors import OutputError

METADATA_KEY = b"climategs"

_UNLIKE_METADATA = (
    *(ArithmeticError, AttributeError, LookupError, RecursionError),
    *(SyntaxError, TypeError, ValueError, pa.ArrowException),
)
_BASE64 = re.compile(rb"[A-Za-z0-9+/]{24,}")
_EXTENSION = b"ARROW:extension:name"


@dataclass(frozen=True)
class PackedColumn:
    """An Arrow column of several NumPy pieces joined. encoding: `plain`, or `json` texts."""

    data: pa.ChunkedArray
    encoding: str


def column_type(column: np.ndarray) -> str:
    """What `unpack_column` needs to know: `<f4`, `|O`, `(3,)<f8` for a column of [n, 3]."""
    return "".join(f"({k},)" for k in column.shape[1:]) + column.dtype.str


def pack_column(pieces: Sequence[np.ndarray], *, where: str) -> PackedColumn:
    """Join columns of one meaning (one per frame, say) into one Arrow column, a chunk a piece.

    pieces: each [n] or [n, k]. where: names the column in errors. Pieces of different Arrow types
    are all stored as JSON, one text an entry.

    Raises:
        ValueError: a value cannot be stored such that reading gives it back exactly.
    """
    plain = [_to_arrow(piece) for piece in pieces]
    # Empty pieces have no say: a frame without boxes often has columns of another dtype.
    filled = [array for array, piece in zip(plain, pieces, strict=True) if len(piece)]
    types = {None if array is None else array.type for array in filled}
    if None not in types and len(types) <= 1:
        kind = next(iter(types), pa.null())
        chunks = [a if a is not None and len(a) else pa.array([], kind) for a in plain]
        return PackedColumn(pa.chunked_array(chunks, type=kind), "plain")
    texts = [pa.array(_to_json(piece, where), pa.string()) for piece in pieces]
    return PackedColumn(pa.chunked_array(texts, type=pa.string()), "json")


def check_count(table: pa.Table, described: int) -> None:
    """Raise ValueError where a table has other than the described number of rows."""
    if table.num_rows != described:
        raise ValueError(f"it has {table.num_rows} rows, its metadata describe {described}")


def whole(value: object) -> int:
    """A number of JSON that int64 holds.

    Raises:
        ValueError: it is anything else.
    """
    if type(value) is not int or not -(2**63) <= value < 2**63:
        raise ValueError(f"expected a whole number; got {value!r:.80}")
    return value


def texts_of(data: pa.ChunkedArray) -> list[str]:
    """The texts of a column without gaps.

    Raises:
        ValueError: it holds anything else.
    """
    if not pa.types.is_string(data.type) or data.null_count:
        raise ValueError(f"expected texts; got {data.type} with {data.null_count} nulls")
    return data.to_pylist()


def unpack_column(data: pa.ChunkedArray, kind: str, encoding: str) -> np.ndarray:
    """The NumPy column that was packed. kind: its `column_type`."""
    described = np.dtype(kind)
    wanted, width = described.base, described.shape
    if len(data) == 0:
        return np.empty((0, *width), wanted)
    if encoding == "json":
        return _filled([json.loads(text) for text in data.to_pylist()], wanted)
    if data.null_count:
        raise ValueError(f"a column of {kind} has {data.null_count} gaps")
    array = pa.concat_arrays(data.chunks)
    if pa.types.is_fixed_size_list(array.type):
        flat = array.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(array), *width).astype(wanted)
    if wanted.kind == "O":
        return _filled(array.to_pylist(), wanted)
    # A copy: Arrow's own memory is read-only, which torch.from_numpy warns about.
    return np.array(array.to_numpy(zero_copy_only=False), dtype=wanted)


def parquet_bytes(table: pa.Table, metadata: dict[str, object]) -> bytes:
    """The table as a Parquet file, always the same bytes for the same table."""
    note = json.dumps(metadata, separators=(",", ":")).encode()
    sink = pa.BufferOutputStream()
    # An eighth smaller for coordinates, and no slower.
    split = {f.name: "BYTE_STREAM_SPLIT" for f in table.schema if pa.types.is_floating(f.type)}
    pq.write_table(
        table.replace_schema_metadata({METADATA_KEY: note}),
        sink,
        version="2.6",
        compression="zstd",
        compression_level=1,
        use_dictionary=False,  # dictionaries compare values, which would merge unlike NaNs
        column_encoding=split,
        write_statistics=False,
    )
    return sink.getvalue().to_pybytes()


def read_table(source: Path | bytes, where: str, columns: Sequence[str] | None = None) -> pa.Table:
    """The table in a Parquet file from anybody: columns of Arrow's own types, valid throughout.

    where: the file, for errors. columns: only those of these that it has.

    Raises:
        OutputError: the file is missing or damaged (texts that are not UTF-8 included), two of its
            columns have one name, or a column has an extension type.
    """
    with _opened(source, where) as file:
        there = Counter(file.schema_arrow.names)
        if repeated := [name for name, count in there.items() if count > 1]:
            raise OutputError(f"{where} has several columns {repeated[0]!r}; leave one")
        wanted = None if columns is None else [name for name in columns if name in there]
        # One thread: this runs in DataLoader workers, which bring their own parallelism.
        table = file.read(wanted, use_threads=False)
        table.validate(full=True)  # Arrow does not look at texts as it reads
    return table


def read_parquet(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """A table and the metadata that `parquet_bytes` put beside it.

    Raises:
        OutputError: as read_table, or the file is without that metadata.
    """
    table = read_table(path, str(path))
    return table, _note(table.schema, path)


def read_note(path: Path) -> dict[str, Any]:
    """The metadata alone, without reading a column.

    Raises:
        OutputError: as read_parquet.
    """
    with _opened(path, str(path)) as file:
        schema = file.schema_arrow
    return _note(schema, path)


def is_ours(path: Path) -> bool:
    """Whether a Parquet file has metadata as `parquet_bytes` writes it.

    Raises:
        OutputError: as read_table.
    """
    with _opened(path, str(path)) as file:
        return METADATA_KEY in (file.schema_arrow.metadata or {})


def _note(schema: pa.Schema, path: Path) -> dict[str, Any]:
    try:
        note = json.loads((schema.metadata or {}).get(METADATA_KEY, b"null"))
    except (ValueError, RecursionError):
        note = None
    if not isinstance(note, dict):
        raise OutputError(
            f"{path} was not written by this project: its metadata are missing or damaged"
        )
    return note


@contextmanager
def as_described(path: Path) -> Iterator[None]:
    """While a file's columns are taken as its metadata say, what goes wrong is an OutputError."""
    try:
        yield
    except _UNLIKE_METADATA as error:
        raise OutputError(
            f"{path} is damaged: its columns are not as its metadata say ({error!r:.200}). Delete "
            f"it and run the job again, which makes it anew"
        ) from error


@contextmanager
def _opened(source: Path | bytes, where: str) -> Iterator[pq.ParquetFile]:
    """The file, for as long as it is read; what Arrow then raises becomes an OutputError."""
    try:
        with pa.BufferReader(source) if isinstance(source, bytes) else pa.OSFile(str(source)) as at:
            if _has_extension_types(at):
                raise OutputError(
                    f"{where} has a column of an Arrow extension type, which is not read, for it "
                    f"could run code; write plain numbers and texts instead"
                )
            yield pq.ParquetFile(at)
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise OutputError(f"{where} is missing or not a readable Parquet file: {error}") from error


def _has_extension_types(file: pa.NativeFile) -> bool:
    """Whether the Arrow schema in a Parquet file's footer names an extension type.

    As a file is opened, Arrow hands what it says of such a type to whatever this process has
    registered under the type's name; some unpickle it, as pyarrow's own did up to 14.0.0. So the
    footer is searched beforehand, unparsed, for the schema: it is base64, and bytes before it may
    look as if they belonged to it.
    """
    size = file.size()
    file.seek(max(0, size - 8))
    footer = min(int.from_bytes(file.read(4), "little"), max(0, size - 8))
    file.seek(max(0, size - 8) - footer)
    runs = [run[start:] for run in _BASE64.findall(file.read(footer)) for start in range(4)]
    file.seek(0)
    return any(_EXTENSION in base64.b64decode(run[: len(run) // 4 * 4]) for run in runs)


def _to_arrow(piece: np.ndarray) -> pa.Array | None:
    """The column in a native Arrow type, or None where only JSON may hold it."""
    if piece.dtype.kind == "O":
        strings = piece.ndim == 1 and all(isinstance(value, str) for value in piece)
        return pa.array(piece.tolist(), pa.string()) if strings else None
    if piece.dtype.kind in "US" and piece.ndim == 1:
        # From Python values: Arrow's reader of fixed-width text stops at a zero character.
        return pa.array(piece.tolist(), pa.string() if piece.dtype.kind == "U" else pa.binary())
    if piece.dtype.kind not in "biufMm" or piece.ndim not in (1, 2):
        return None
    flat = np.ascontiguousarray(piece).reshape(-1)
    flat = flat.astype(flat.dtype.newbyteorder("="), copy=False)
    try:
        array = pa.array(flat, from_pandas=False)
    except pa.ArrowException:  # times in hours and the like
        return None
    return array if piece.ndim == 1 else pa.FixedSizeListArray.from_arrays(array, piece.shape[1])


def _to_json(piece: np.ndarray, where: str) -> list[str]:
    if piece.ndim > (1 if piece.dtype.kind == "O" else 2):
        raise ValueError(f"{where} has shape {list(piece.shape)}; columns are [n] or [n, k]")
    # NumPy scalars inside an object column come back as the Python value they stand for.
    values = [v.item() if isinstance(v, np.generic) else v for v in piece.tolist()]
    texts = []
    for value in values:
        try:
            text = json.dumps(value, ensure_ascii=False)
            exact = _same(json.loads(text), value)
        except (TypeError, ValueError):
            text, exact = "", False
        if not exact:
            raise ValueError(
                f"{where} holds {value!r} ({type(value).__name__}) in a column of dtype "
                f"{piece.dtype}, which cannot be stored exactly; use numbers, strings, None, or "
                f"lists of them"
            )
        texts.append(text)
    return texts


def _same(a: object, b: object) -> bool:
    """Equal in value and type all the way down; NaN equals NaN."""
    if type(a) is not type(b):
        return False
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(_same(a[key], b[key]) for key in a)
    return a == b or (a != a and b != b)


def _filled(values: list, dtype: np.dtype) -> np.ndarray:
    if dtype.kind != "O":
        return np.array(values, dtype)
    column = np.empty(len(values), object)  # np.array would turn lists of lists into a matrix
    column[:] = values
    return column
