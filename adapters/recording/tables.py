"""Parquet files of a recording: those that a job wrote, and plain ones of any other program.

A job's files carry NumPy's dtypes in their metadata and are read back to the bit by
augment.batch.label_files. Plain files are read as Arrow gives them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from adapters.lidar.sweep_times import whole_numbers
from augment.batch.columns import is_ours, read_table
from augment.batch.label_files import ATTRIBUTE_PREFIX, read_boxes, read_lidar
from augment.errors import AdapterError, OutputError
from augment.labels import Boxes, LidarSweep
from augment.lidar_weather.codes import INDEX_COLUMN
from augment.lidar_weather.sensors import intensity_column
from recipes.files import open_file

_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}
_REQUIRED = ("frame", "track_id", "label", *(name for names in _VECTORS.values() for name in names))
_CACHED_FILES = 4  # box files kept: every frame asks for its own part of one
_DAMAGED = (OutputError, OSError, pa.ArrowException, KeyError, IndexError, TypeError, ValueError)
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class TimedBoxes:
    """Boxes of one frame. timestamps_ns: int64 [B], when each stood there; None: the frame's."""

    boxes: Boxes
    timestamps_ns: np.ndarray | None


def read_sweep(path: Path) -> LidarSweep:
    """The sweep in a file, every column under its own name.

    Raises:
        AdapterError: damaged, or without numbers x, y, z; the message names the file.
    """

    def read() -> LidarSweep:
        if is_ours(path):
            sweep = read_lidar(path)
        else:
            table = read_table(path, str(path))
            sweep = LidarSweep({n: _column(table, n) for n in table.column_names})
        _ = sweep.points_m  # numbers, not texts
        return sweep

    return _reading(path, "a LiDAR file with columns x, y, z", read)


def sweep_content(path: Path, sweep: LidarSweep) -> bytes:
    """The LiDAR file with a weathered sweep in place of its own: the same columns, types and notes.

    Raises:
        AdapterError: damaged; the message names the file.
    """

    def content() -> bytes:
        table = read_table(path, str(path)).take(pa.array(sweep.columns[INDEX_COLUMN]))
        for name in {*"xyz", intensity_column(sweep)} - {None}:
            at = table.schema.get_field_index(name)
            field = table.schema.field(at)
            values = np.asarray(sweep.columns[name])
            values = np.rint(values) if pa.types.is_integer(field.type) else values
            table = table.set_column(at, field, pa.array(values).cast(field.type, safe=False))
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        return sink.getvalue().to_pybytes()

    return _reading(path, "a LiDAR file with columns x, y, z", content)


def read_frame_boxes(path: Path) -> dict[int, TimedBoxes]:
    """The boxes of every frame that has any.

    Raises:
        AdapterError: damaged, or without a column that a box needs; the message names the file.
    """

    def read() -> dict[int, TimedBoxes]:
        state = path.stat()
        return _read_boxes(path, state.st_mtime_ns, state.st_size)

    return _reading(path, f"a table of boxes with columns {', '.join(_REQUIRED)}", read)


@lru_cache(maxsize=_CACHED_FILES)
def _read_boxes(path: Path, _changed_ns: int, _size: int) -> dict[int, TimedBoxes]:
    if is_ours(path):
        return {
            number: TimedBoxes(f.boxes, np.full(len(f.boxes), f.timestamp_ns, np.int64))
            for number, f in read_boxes(path).items()
        }
    table = read_table(path, str(path))
    missing = [name for name in _REQUIRED if name not in table.column_names]
    if missing:
        raise ValueError(f"it lacks {missing}; it has {table.column_names}")
    frames = whole_numbers(_column(table, "frame"), "frame")
    order = np.argsort(frames, kind="stable")
    numbers, starts = np.unique(frames[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(numbers) else []
    columns = {name: _column(table, name) for name in table.column_names}
    return {int(n): _boxes_at(columns, rows) for n, rows in zip(numbers, parts, strict=True)}


def _boxes_at(columns: dict[str, np.ndarray], rows: np.ndarray) -> TimedBoxes:
    vectors = {
        field: np.stack([columns[name][rows].astype(np.float64) for name in names], axis=1)
        for field, names in _VECTORS.items()
    }
    times = columns.get("timestamp_ns")
    used = {*_REQUIRED, "timestamp_ns"}
    return TimedBoxes(
        Boxes(
            tuple(str(value) for value in columns["track_id"][rows]),
            tuple(str(value) for value in columns["label"][rows]),
            **vectors,
            attributes={
                name.removeprefix(ATTRIBUTE_PREFIX): values[rows]
                for name, values in columns.items()
                if name not in used
            },
        ),
        None if times is None else whole_numbers(times[rows], "timestamp_ns"),
    )


def _column(table: pa.Table, name: str) -> np.ndarray:
    # A copy: Arrow's own memory is read-only, which torch.from_numpy warns about.
    return np.array(table[name].to_numpy())


def _reading(path: Path, expected: str, read: Callable[[], Value]) -> Value:
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        return read()
    except _DAMAGED as error:
        raise AdapterError(f"{path} is not {expected}: {error}") from error
