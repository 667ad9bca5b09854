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
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from augment.errors import OutputError
from augment.files.stated_sizes import StatedSizeError, check_table, check_texts
from augment.labels import Boxes, LidarSweep
from recipes.files import open_file

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
    are all stored as JSON, one text an entry. Raises ValueError: a value cannot be stored such that
    reading gives it back exactly.
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
    """A number of JSON that int64 holds. Raises ValueError: it is anything else."""
    if type(value) is not int or not -(2**63) <= value < 2**63:
        raise ValueError(f"expected a whole number; got {value!r:.80}")
    return value


def texts_of(data: pa.ChunkedArray) -> list[str]:
    """The texts of a column without gaps. Raises ValueError: it holds anything else."""
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


def read_table(
    source: Path | bytes,
    where: str,
    columns: Sequence[str] | None = None,
    without: Collection[str] = (),
) -> pa.Table:
    """The table in a Parquet file from anybody: columns of Arrow's own types, valid throughout.
    where: the file, for errors. columns: only those of these that it has. without: none of these.
    """
    with opened_parquet(source, where) as (content, file):
        there = Counter(file.schema_arrow.names)
        if repeated := [name for name, count in there.items() if count > 1]:
            raise OutputError(f"{where} has several columns {repeated[0]!r}; leave one")
        wanted = [n for n in columns or there if n in there and n not in without]
        long_texts = check_table(content, file, wanted)
        if long_texts:
            file = pq.ParquetFile(content, read_dictionary=long_texts)
        # One thread: this runs in DataLoader workers, which bring their own parallelism.
        table = file.read(wanted, use_threads=False)
        table.validate(full=True)  # Arrow does not look at texts as it reads
        return _with_plain_texts(table) if long_texts else table


def _with_plain_texts(table: pa.Table) -> pa.Table:
    """The table with plain texts in place of dictionaries of texts."""
    for number, name in enumerate(table.column_names):
        column = table[name]
        if pa.types.is_dictionary(column.type):
            check_texts(column)
            table = table.set_column(number, name, column.cast(column.type.value_type))
        elif pa.types.is_nested(column.type):
            raise OutputError(f"column {name} has lists of texts that are too long to be read")
    return table


def read_parquet(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """A table and the metadata that `parquet_bytes` put beside it."""
    table = read_table(path, str(path))
    return table, _note(table.schema, path)


def read_note(path: Path) -> dict[str, Any]:
    """The metadata alone, without reading a column."""
    with opened_parquet(path, str(path)) as (_, file):
        schema = file.schema_arrow
    return _note(schema, path)


def is_ours(path: Path) -> bool:
    """Whether a Parquet file has metadata as `parquet_bytes` writes it."""
    with opened_parquet(path, str(path)) as (_, file):
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
def opened_parquet(
    source: Path | bytes, where: str
) -> Iterator[tuple[pa.NativeFile, pq.ParquetFile]]:
    """The file's content and its reader, for as long as it is read; what Arrow then raises becomes
    an OutputError. A reader takes all the memory that the file asks for: what is read is checked
    by `augment.files.stated_sizes` before.
    """
    try:
        if not isinstance(source, bytes):
            open_file(source).close()  # refuses pipes, at which Arrow would wait without end
        with pa.BufferReader(source) if isinstance(source, bytes) else pa.OSFile(str(source)) as at:
            if _has_extension_types(at):
                raise OutputError(
                    f"{where} has a column of an Arrow extension type, which is not read, for it "
                    f"could run code; write plain numbers and texts instead"
                )
            yield at, pq.ParquetFile(at)
    except (OSError, pa.ArrowException, UnicodeDecodeError, StatedSizeError) as error:
        raise OutputError(f"{where} is missing or not a readable Parquet file: {error}") from error


def _has_extension_types(file: pa.NativeFile) -> bool:
    """Whether the Arrow schema in a Parquet file's footer names an extension type, to whose
    registered class Arrow would hand what the file says (pyarrow's own unpickled it up to 14.0.0).
    The footer is searched beforehand, unparsed: the schema is base64, and bytes before it may look
    as if they belonged to it.
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


# ---- Boxes and LiDAR sweeps as Parquet files, read back exactly as the dataset gave them ---------

ATTRIBUTE_PREFIX = "attribute_"  # keeps a dataset's own columns apart from ours
_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}


@dataclass(frozen=True, eq=False)
class FrameBoxes:
    """The boxes of one frame and the frame's reference time. instances: uint16 [B], the objects'
    numbers (`augment.boxes`); None in older files.
    """

    timestamp_ns: int
    boxes: Boxes
    instances: np.ndarray | None = None


def lidar_bytes(sweep: LidarSweep, *, note: str | None = None) -> bytes:
    """The sweep as a Parquet file: the source's columns, in its order. note: kept beside them for
    `read_lidar_note`.
    """
    columns, kinds = {}, {}
    for name, column in sweep.columns.items():
        packed = pack_column([column], where=f"LiDAR column {name!r}")
        columns[name] = packed.data
        kinds[name] = [column_type(column), packed.encoding]
    extra = {} if note is None else {"note": note}
    return parquet_bytes(pa.table(columns), {"kind": "lidar", "columns": kinds, **extra})


def read_lidar(path: Path) -> LidarSweep:
    """The sweep that was written, dtypes included."""
    table, note = _read(Path(path), "lidar")
    with as_described(path):
        kinds = note["columns"]
        return LidarSweep({name: unpack_column(table[name], *kinds[name]) for name in kinds})


def read_lidar_note(path: Path) -> str | None:
    """The note that a sweep was written with; its returns are not read."""
    note = read_note(path)
    if note.get("kind") != "lidar":
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected 'lidar'")
    text = note.get("note")
    return None if text is None else str(text)


def boxes_bytes(frames: Mapping[int, FrameBoxes]) -> bytes:
    """All boxes of the frames as one Parquet file, one row a box, ordered by frame. The dataset's
    further columns are `attribute_<name>`, null in frames that lack them. A note in the metadata
    lists every frame, so that one without boxes differs from one that was not asked.
    """
    order = sorted(frames)
    listed = [frames[index].boxes for index in order]
    counts = [len(boxes) for boxes in listed]
    times = [frames[index].timestamp_ns for index in order]
    columns: dict[str, Any] = {
        "frame": np.repeat(np.array(order, np.int64), counts),
        "timestamp_ns": np.repeat(np.array(times, np.int64), counts),
        "track_id": pa.array([i for boxes in listed for i in boxes.track_ids], pa.string()),
        "label": pa.array([name for boxes in listed for name in boxes.labels], pa.string()),
    }
    for field, names in _VECTORS.items():
        joined = np.concatenate([np.zeros((0, len(names)))] + [getattr(b, field) for b in listed])
        columns |= {name: joined[:, k].copy() for k, name in enumerate(names)}
    if any(frame.instances is not None for frame in frames.values()):
        columns["instance"] = pa.chunked_array([_instances(frames[n]) for n in order], pa.uint16())
    encodings = {}
    for name in dict.fromkeys(name for boxes in listed for name in boxes.attributes):
        columns[ATTRIBUTE_PREFIX + name], encodings[name] = _attribute(name, listed)
    kinds = [{name: column_type(a) for name, a in boxes.attributes.items()} for boxes in listed]
    note = {
        "kind": "boxes",
        "frames": [list(row) for row in zip(order, times, counts, kinds, strict=True)],
        "encodings": encodings,
    }
    return parquet_bytes(pa.table(columns), note)


def read_boxes(path: Path) -> dict[int, FrameBoxes]:
    """The boxes of every frame in the file, dtypes of the attributes included."""
    table, note = _read(Path(path), "boxes")
    with as_described(path):
        track_ids, labels = texts_of(table["track_id"]), texts_of(table["label"])
        vectors = {
            field: np.stack([table[name].to_numpy() for name in names], axis=1)
            for field, names in _VECTORS.items()
        }
        names = set(table.column_names)
        frames, start = {}, 0
        for index, timestamp_ns, count, kinds in note["frames"]:
            rows = slice(start, start + count)
            attributes = {
                name: unpack_column(
                    table[ATTRIBUTE_PREFIX + name].slice(start, count),
                    kind,
                    note["encodings"][name],
                )
                for name, kind in kinds.items()
            }
            boxes = Boxes(
                tuple(track_ids[rows]),
                tuple(labels[rows]),
                **{field: value[rows].copy() for field, value in vectors.items()},
                attributes=attributes,
            )
            numbers = table["instance"].slice(start, count) if "instance" in names else None
            instances = None if numbers is None or numbers.null_count else numbers.to_numpy().copy()
            frames[whole(index)] = FrameBoxes(whole(timestamp_ns), boxes, instances)
            start += count
        check_count(table, start)
    return frames


def _instances(frame: FrameBoxes) -> pa.Array:
    if frame.instances is None:
        return pa.nulls(len(frame.boxes), pa.uint16())
    return pa.array(frame.instances, pa.uint16())


def _attribute(name: str, listed: list[Boxes]) -> tuple[pa.ChunkedArray, str]:
    having = [boxes.attributes[name] for boxes in listed if name in boxes.attributes]
    packed = pack_column(having, where=f"box attribute {name!r}")
    chunks = iter(packed.data.chunks)
    filled = [
        next(chunks) if name in boxes.attributes else pa.nulls(len(boxes), packed.data.type)
        for boxes in listed
    ]
    return pa.chunked_array(filled, type=packed.data.type), packed.encoding


def _read(path: Path, kind: str) -> tuple[pa.Table, dict[str, Any]]:
    table, note = read_parquet(path)
    if note.get("kind") != kind:
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {kind!r}")
    return table, note
