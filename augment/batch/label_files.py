"""Boxes and LiDAR sweeps as Parquet files, read back exactly as the dataset gave them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from augment.batch.columns import (
    as_described,
    check_count,
    column_type,
    pack_column,
    parquet_bytes,
    read_note,
    read_parquet,
    texts_of,
    unpack_column,
    whole,
)
from augment.errors import OutputError
from augment.labels import Boxes, LidarSweep

ATTRIBUTE_PREFIX = "attribute_"  # keeps a dataset's own columns apart from ours
_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}


@dataclass(frozen=True, eq=False)
class FrameBoxes:
    """The boxes of one frame and the frame's reference time.

    instances: uint16 [B], the objects' numbers (`augment.instances`); None in older files.
    """

    timestamp_ns: int
    boxes: Boxes
    instances: np.ndarray | None = None


def lidar_bytes(sweep: LidarSweep, *, note: str | None = None) -> bytes:
    """The sweep as a Parquet file: the source's columns, in its order.

    note: kept beside them for `read_lidar_note`.
    """
    columns, kinds = {}, {}
    for name, column in sweep.columns.items():
        packed = pack_column([column], where=f"LiDAR column {name!r}")
        columns[name] = packed.data
        kinds[name] = [column_type(column), packed.encoding]
    said = {} if note is None else {"note": note}
    return parquet_bytes(pa.table(columns), {"kind": "lidar", "columns": kinds, **said})


def read_lidar(path: Path) -> LidarSweep:
    """The sweep that was written, dtypes included.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    table, note = _read(Path(path), "lidar")
    with as_described(path):
        kinds = note["columns"]
        return LidarSweep({name: unpack_column(table[name], *kinds[name]) for name in kinds})


def read_lidar_note(path: Path) -> str | None:
    """The note that a sweep was written with; its returns are not read.

    Raises:
        OutputError: as for read_lidar.
    """
    note = read_note(path)
    if note.get("kind") != "lidar":
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected 'lidar'")
    text = note.get("note")
    return None if text is None else str(text)


def boxes_bytes(frames: Mapping[int, FrameBoxes]) -> bytes:
    """All boxes of the frames as one Parquet file, one row a box, ordered by frame.

    The dataset's further columns are `attribute_<name>`, null in frames that lack them. A note in
    the metadata lists every frame, so that one without boxes differs from one that was not asked.
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
    """The boxes of every frame in the file, dtypes of the attributes included.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
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
