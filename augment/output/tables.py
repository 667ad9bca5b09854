"""Parquet files of NumPy columns, read back with the same bits and the same dtypes.

In: NumPy columns, boxes of frames, LiDAR sweeps. Out: bytes of Parquet files, and the columns
again. Jobs write with it; readers of outputs and recordings read with it. Parquet has fewer types
than NumPy: `<U5` becomes a string, an object column a string or JSON. Each column's NumPy dtype is
therefore kept in the file's metadata and restored by `unpack_column`. Writing fails for a column
that could not be restored exactly.
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
from augment.scene.labels import Boxes, LidarSweep
from recipes.files import open_file

# Key of our metadata in a Parquet file.
METADATA_KEY = b"climategs"

# Errors of reading columns that differ from what their metadata describe.
_UNLIKE_METADATA = (
    *(ArithmeticError, AttributeError, LookupError, RecursionError),
    *(SyntaxError, TypeError, ValueError, pa.ArrowException),
)
# Runs of base64 text, in which a Parquet file stores its Arrow schema.
_BASE64 = re.compile(rb"[A-Za-z0-9+/]{24,}")
# Metadata key of Arrow extension types.
_EXTENSION = b"ARROW:extension:name"


@dataclass(frozen=True)
class PackedColumn:
    """Arrow column of several joined NumPy pieces."""

    data: pa.ChunkedArray
    """The column, one chunk for each piece."""
    encoding: str
    """`plain`, or `json` for texts of JSON."""


def column_type(column: np.ndarray) -> str:
    """Return the type for `unpack_column`: `<f4`, `|O`, `(3,)<f8` for a column of [n, 3]."""
    return "".join(f"({k},)" for k in column.shape[1:]) + column.dtype.str


def pack_column(pieces: Sequence[np.ndarray], *, source_name: str) -> PackedColumn:
    """Join columns of one meaning, such as one per frame, into one Arrow column.

    Each piece becomes a chunk. Pieces of different Arrow types are all stored as JSON, one text for
    each entry.

    Args:
        pieces: Columns, each [n] or [n, k].
        source_name: Name of the column, for errors.

    Raises:
        ValueError: A value cannot be stored such that reading returns it exactly.
    """
    arrays = [_to_arrow(piece) for piece in pieces]
    # Empty pieces do not count: a frame without boxes often has columns of another dtype.
    filled_arrays = [array for array, piece in zip(arrays, pieces, strict=True) if len(piece)]
    types = {None if array is None else array.type for array in filled_arrays}
    if None not in types and len(types) <= 1:
        kind = next(iter(types), pa.null())
        chunks = [a if a is not None and len(a) else pa.array([], kind) for a in arrays]
        return PackedColumn(pa.chunked_array(chunks, type=kind), "plain")
    texts = [pa.array(_to_json(piece, source_name), pa.string()) for piece in pieces]
    return PackedColumn(pa.chunked_array(texts, type=pa.string()), "json")


def check_count(table: pa.Table, num_described_rows: int) -> None:
    """Raise ValueError where a table has another number of rows than described."""
    if table.num_rows != num_described_rows:
        raise ValueError(
            f"it has {table.num_rows} rows, its metadata describe {num_described_rows}"
        )


def checked_int(value: object) -> int:
    """Return a number of JSON as an int that int64 holds.

    Raises:
        ValueError: The value is anything else.
    """
    if type(value) is not int or not -(2**63) <= value < 2**63:
        raise ValueError(f"expected a whole number; got {value!r:.80}")
    return value


def column_texts(data: pa.ChunkedArray) -> list[str]:
    """Return the texts of a column without gaps.

    Raises:
        ValueError: The column holds anything else.
    """
    if not pa.types.is_string(data.type) or data.null_count:
        raise ValueError(f"expected texts; got {data.type} with {data.null_count} nulls")
    return data.to_pylist()


def unpack_column(data: pa.ChunkedArray, kind: str, encoding: str) -> np.ndarray:
    """Return the NumPy column that `pack_column` stored, with the same bits and dtype.

    Args:
        data: the stored column.
        kind: text of its dtype with the shape of a row, as `column_type` gives it.
        encoding: "json", or another `PackedColumn.encoding`.

    Raises:
        ValueError: the column has missing values.
    """
    packed_dtype = np.dtype(kind)
    dtype = packed_dtype.base
    row_shape = packed_dtype.shape
    if len(data) == 0:
        return np.empty((0, *row_shape), dtype)
    if encoding == "json":
        return _make_array([json.loads(text) for text in data.to_pylist()], dtype)
    if data.null_count:
        raise ValueError(f"a column of {kind} has {data.null_count} gaps")
    array = pa.concat_arrays(data.chunks)
    if pa.types.is_fixed_size_list(array.type):
        flat = array.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(array), *row_shape).astype(dtype)
    if dtype.kind == "O":
        return _make_array(array.to_pylist(), dtype)
    # A copy: Arrow's own memory is read-only, which torch.from_numpy warns about.
    return np.array(array.to_numpy(zero_copy_only=False), dtype=dtype)


def parquet_bytes(table: pa.Table, metadata: dict[str, object]) -> bytes:
    """Return the table as a Parquet file; the same table gives the same bytes."""
    note = json.dumps(metadata, separators=(",", ":")).encode()
    sink = pa.BufferOutputStream()
    # Files of coordinates are an eighth smaller with it, and writing is no slower.
    encodings = {f.name: "BYTE_STREAM_SPLIT" for f in table.schema if pa.types.is_floating(f.type)}
    pq.write_table(
        table.replace_schema_metadata({METADATA_KEY: note}),
        sink,
        version="2.6",
        compression="zstd",
        compression_level=1,
        use_dictionary=False,  # dictionaries compare values, which would merge unlike NaNs
        column_encoding=encodings,
        write_statistics=False,
    )
    return sink.getvalue().to_pybytes()


def read_table(
    source: Path | bytes,
    source_name: str,
    columns: Sequence[str] | None = None,
    excluded_columns: Collection[str] = (),
) -> pa.Table:
    """Return the table in a Parquet file of any origin, with valid columns of Arrow's own types.

    Args:
        source_name: Name of the file, for errors.
        columns: If given, only those of these columns that the file has.
        excluded_columns: Columns to leave out.
    """
    with open_parquet(source, source_name) as (content, file):
        name_counts = Counter(file.schema_arrow.names)
        if repeated_names := [name for name, count in name_counts.items() if count > 1]:
            raise OutputError(f"{source_name} has several columns {repeated_names[0]!r}; leave one")
        column_names = [
            n for n in columns or name_counts if n in name_counts and n not in excluded_columns
        ]
        long_texts = check_table(content, file, column_names)
        if long_texts:
            file = pq.ParquetFile(content, read_dictionary=long_texts)
        # One thread: this runs in DataLoader workers, which bring their own parallelism.
        table = file.read(column_names, use_threads=False)
        table.validate(full=True)  # Arrow does not check texts while it reads
        return _with_plain_texts(table) if long_texts else table


def _with_plain_texts(table: pa.Table) -> pa.Table:
    """Return the table with plain texts in place of dictionaries of texts."""
    for number, name in enumerate(table.column_names):
        column = table[name]
        if pa.types.is_dictionary(column.type):
            check_texts(column)
            table = table.set_column(number, name, column.cast(column.type.value_type))
        elif pa.types.is_nested(column.type):
            raise OutputError(f"column {name} has lists of texts that are too long to be read")
    return table


def read_parquet(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """Return a table and the metadata that `parquet_bytes` stored with it."""
    table = read_table(path, str(path))
    return table, _note(table.schema, path)


def read_note(path: Path) -> dict[str, Any]:
    """Return the metadata without reading a column."""
    with open_parquet(path, str(path)) as (_, file):
        schema = file.schema_arrow
    return _note(schema, path)


def has_climategs_metadata(path: Path) -> bool:
    """Return True if a Parquet file has metadata as `parquet_bytes` writes them."""
    with open_parquet(path, str(path)) as (_, file):
        return METADATA_KEY in (file.schema_arrow.metadata or {})


def _note(schema: pa.Schema, path: Path) -> dict[str, Any]:
    """Return our metadata in a schema."""
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
def metadata_errors_as_output_errors(path: Path) -> Iterator[None]:
    """Context manager for reading columns by their metadata; errors become an OutputError."""
    try:
        yield
    except _UNLIKE_METADATA as error:
        raise OutputError(
            f"{path} is damaged: its columns are not as its metadata say ({error!r:.200}). Delete "
            f"it and run the job again, which makes it anew"
        ) from error


@contextmanager
def open_parquet(
    source: Path | bytes, source_name: str
) -> Iterator[tuple[pa.NativeFile, pq.ParquetFile]]:
    """Context manager of a file's content and its reader; errors of Arrow become an OutputError.

    A reader takes all the memory that the file asks for, so `augment.files.stated_sizes` checks the
    columns before they are read.
    """
    try:
        if not isinstance(source, bytes):
            open_file(source).close()  # refuses pipes, which Arrow would wait for without end
        with (
            pa.BufferReader(source)
            if isinstance(source, bytes)
            else pa.OSFile(str(source)) as content
        ):
            if _has_extension_types(content):
                raise OutputError(
                    f"{source_name} has a column of an Arrow extension type, which is not read, "
                    f"for it could run code; write plain numbers and texts instead"
                )
            yield content, pq.ParquetFile(content)
    except (OSError, pa.ArrowException, UnicodeDecodeError, StatedSizeError) as error:
        raise OutputError(
            f"{source_name} is missing or not a readable Parquet file: {error}"
        ) from error


def _has_extension_types(file: pa.NativeFile) -> bool:
    """Return True if the Arrow schema in a Parquet file's footer names an extension type.

    Arrow would hand the file's data to the type's registered class (pyarrow's own unpickled it up
    to 14.0.0). The footer is searched beforehand, unparsed: the schema is base64, and bytes before
    it may look as if they belonged to it.
    """
    size = file.size()
    file.seek(max(0, size - 8))
    footer_bytes = min(int.from_bytes(file.read(4), "little"), max(0, size - 8))
    file.seek(max(0, size - 8) - footer_bytes)
    base64_runs = [
        run[start:] for run in _BASE64.findall(file.read(footer_bytes)) for start in range(4)
    ]
    file.seek(0)
    return any(_EXTENSION in base64.b64decode(run[: len(run) // 4 * 4]) for run in base64_runs)


def _to_arrow(piece: np.ndarray) -> pa.Array | None:
    """Return the column in a native Arrow type, or None where only JSON can hold it."""
    if piece.dtype.kind == "O":
        are_texts = piece.ndim == 1 and all(isinstance(value, str) for value in piece)
        return pa.array(piece.tolist(), pa.string()) if are_texts else None
    if piece.dtype.kind in "US" and piece.ndim == 1:
        # From Python values: Arrow's reader of fixed-width text stops at a zero character.
        return pa.array(piece.tolist(), pa.string() if piece.dtype.kind == "U" else pa.binary())
    if piece.dtype.kind not in "biufMm" or piece.ndim not in (1, 2):
        return None
    values = np.ascontiguousarray(piece).reshape(-1)
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    try:
        array = pa.array(values, from_pandas=False)
    except pa.ArrowException:  # times in hours and the like
        return None
    return array if piece.ndim == 1 else pa.FixedSizeListArray.from_arrays(array, piece.shape[1])


def _to_json(piece: np.ndarray, source_name: str) -> list[str]:
    """Return a text of JSON for each value of the column."""
    if piece.ndim > (1 if piece.dtype.kind == "O" else 2):
        raise ValueError(f"{source_name} has shape {list(piece.shape)}; columns are [n] or [n, k]")
    # NumPy scalars inside an object column come back as the Python value they stand for.
    values = [v.item() if isinstance(v, np.generic) else v for v in piece.tolist()]
    texts = []
    for value in values:
        try:
            text = json.dumps(value, ensure_ascii=False)
            is_exact = _is_same(json.loads(text), value)
        except (TypeError, ValueError):
            text = ""
            is_exact = False
        if not is_exact:
            raise ValueError(
                f"{source_name} holds {value!r} ({type(value).__name__}) in a column of dtype "
                f"{piece.dtype}, which cannot be stored exactly; use numbers, strings, None, or "
                f"lists of them"
            )
        texts.append(text)
    return texts


def _is_same(a: object, b: object) -> bool:
    """Return True for equal values of equal types, at every level; NaN equals NaN."""
    if type(a) is not type(b):
        return False
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_is_same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(_is_same(a[key], b[key]) for key in a)
    return a == b or (a != a and b != b)


def _make_array(values: list, dtype: np.dtype) -> np.ndarray:
    """Return values as an array of that type."""
    if dtype.kind != "O":
        return np.array(values, dtype)
    column = np.empty(len(values), object)  # np.array would turn lists of lists into a matrix
    column[:] = values
    return column


# ---- Boxes and LiDAR sweeps as Parquet files, read back exactly as the dataset gave them ---------

# Prefix that keeps a dataset's own columns apart from ours.
ATTRIBUTE_PREFIX = "attribute_"
# Columns of the boxes' vectors, by field of Boxes.
_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}


@dataclass(frozen=True, eq=False)
class FrameBoxes:
    """Boxes of one frame."""

    timestamp_ns: int
    """Reference time of the frame."""
    boxes: Boxes
    """The boxes."""
    instances: np.ndarray | None = None
    """Numbers of the objects (`augment.scene.boxes`), uint16 [B]; None in older files."""


def lidar_bytes(sweep: LidarSweep, *, note: str | None = None) -> bytes:
    """Return the sweep as a Parquet file, with the source's columns in their order.

    Args:
        note: Text that `read_lidar_note` returns.
    """
    columns = {}
    kinds = {}
    for name, column in sweep.columns.items():
        packed_column = pack_column([column], source_name=f"LiDAR column {name!r}")
        columns[name] = packed_column.data
        kinds[name] = [column_type(column), packed_column.encoding]
    note_entries = {} if note is None else {"note": note}
    return parquet_bytes(pa.table(columns), {"kind": "lidar", "columns": kinds, **note_entries})


def read_lidar(path: Path) -> LidarSweep:
    """Return the sweep that was written, including its dtypes."""
    table, note = _read_kind(Path(path), "lidar")
    with metadata_errors_as_output_errors(path):
        kinds = note["columns"]
        return LidarSweep({name: unpack_column(table[name], *kinds[name]) for name in kinds})


def read_lidar_note(path: Path) -> str | None:
    """Return the note that a sweep was written with, without reading its returns."""
    note = read_note(path)
    if note.get("kind") != "lidar":
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected 'lidar'")
    text = note.get("note")
    return None if text is None else str(text)


def boxes_bytes(frames: Mapping[int, FrameBoxes]) -> bytes:
    """Return all boxes of the frames as one Parquet file, one row for each box, ordered by frame.

    The dataset's further columns are `attribute_<name>`, null in frames that lack them. A note in
    the metadata lists every frame, so that a frame without boxes differs from one that is not in
    the file.
    """
    frame_numbers = sorted(frames)
    boxes_of_frames = [frames[index].boxes for index in frame_numbers]
    counts = [len(boxes) for boxes in boxes_of_frames]
    times = [frames[index].timestamp_ns for index in frame_numbers]
    columns: dict[str, Any] = {
        "frame": np.repeat(np.array(frame_numbers, np.int64), counts),
        "timestamp_ns": np.repeat(np.array(times, np.int64), counts),
        "track_id": pa.array(
            [i for boxes in boxes_of_frames for i in boxes.track_ids], pa.string()
        ),
        "label": pa.array(
            [name for boxes in boxes_of_frames for name in boxes.labels], pa.string()
        ),
    }
    for field, names in _VECTORS.items():
        vectors = np.concatenate(
            [np.zeros((0, len(names)))] + [getattr(b, field) for b in boxes_of_frames]
        )
        columns |= {name: vectors[:, k].copy() for k, name in enumerate(names)}
    if any(frame.instances is not None for frame in frames.values()):
        columns["instance"] = pa.chunked_array(
            [_instances(frames[n]) for n in frame_numbers], pa.uint16()
        )
    encodings = {}
    for name in dict.fromkeys(name for boxes in boxes_of_frames for name in boxes.attributes):
        columns[ATTRIBUTE_PREFIX + name], encodings[name] = _attribute(name, boxes_of_frames)
    kinds = [
        {name: column_type(a) for name, a in boxes.attributes.items()} for boxes in boxes_of_frames
    ]
    note = {
        "kind": "boxes",
        "frames": [list(row) for row in zip(frame_numbers, times, counts, kinds, strict=True)],
        "encodings": encodings,
    }
    return parquet_bytes(pa.table(columns), note)


def read_boxes(path: Path) -> dict[int, FrameBoxes]:
    """Return the boxes of every frame in the file, including the dtypes of the attributes."""
    table, note = _read_kind(Path(path), "boxes")
    with metadata_errors_as_output_errors(path):
        track_ids = column_texts(table["track_id"])
        labels = column_texts(table["label"])
        vectors = {
            field: np.stack([table[name].to_numpy() for name in names], axis=1)
            for field, names in _VECTORS.items()
        }
        names = set(table.column_names)
        frames = {}
        start = 0
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
            frames[checked_int(index)] = FrameBoxes(checked_int(timestamp_ns), boxes, instances)
            start += count
        check_count(table, start)
    return frames


def _instances(frame: FrameBoxes) -> pa.Array:
    """Return the numbers of a frame's objects, null where they are not known."""
    if frame.instances is None:
        return pa.nulls(len(frame.boxes), pa.uint16())
    return pa.array(frame.instances, pa.uint16())


def _attribute(name: str, boxes_of_frames: list[Boxes]) -> tuple[pa.ChunkedArray, str]:
    """Return a further column of the dataset, and its encoding.

    It has gaps in frames that lack it.
    """
    columns = [boxes.attributes[name] for boxes in boxes_of_frames if name in boxes.attributes]
    packed_column = pack_column(columns, source_name=f"box attribute {name!r}")
    chunks = iter(packed_column.data.chunks)
    filled_chunks = [
        next(chunks) if name in boxes.attributes else pa.nulls(len(boxes), packed_column.data.type)
        for boxes in boxes_of_frames
    ]
    return pa.chunked_array(filled_chunks, type=packed_column.data.type), packed_column.encoding


def _read_kind(path: Path, kind: str) -> tuple[pa.Table, dict[str, Any]]:
    """Return the table and metadata of a file of that kind."""
    table, note = read_parquet(path)
    if note.get("kind") != kind:
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {kind!r}")
    return table, note
