"""What weather does to the boxes, beside their labels: a table of every variant and effect.

A row per box and image. The numbers are measured where the image is rendered, travel in its
journal's line, and go to the variant's file when the job ends.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import pyarrow as pa

from augment.batch.columns import (
    as_described,
    check_count,
    parquet_bytes,
    read_parquet,
    texts_of,
    whole,
)
from augment.box_pixels import NOT_COUNTED
from augment.errors import OutputError

Item = tuple[int, str]  # frame number and camera name


@runtime_checkable
class BoxNumbers(Protocol):
    """A dataclass: what one effect does to a frame's boxes in one image, in the labels' order.

    Its fields are track_ids and then arrays of [B], named as their columns.
    """

    @property
    def track_ids(self) -> tuple[str, ...]: ...


Numbers = TypeVar("Numbers", bound=BoxNumbers)


@dataclass(frozen=True)
class BoxTable(Generic[Numbers]):
    """How the numbers of one effect are stored. kind: what the file says that it holds.

    record: the type of an image's numbers. columns: the file's, with their types; those that are no
    field of the record are its properties, there for other readers. sampled: columns that samples
    of the datasets have.
    """

    kind: str
    record: Callable[..., Numbers]
    columns: Mapping[str, type]
    sampled: tuple[str, ...]

    @property
    def stored(self) -> tuple[str, ...]:
        """The record's arrays."""
        fields: Any = self.record
        return tuple(f.name for f in dataclasses.fields(fields) if f.name != "track_ids")

    def to_json(self, numbers: Numbers) -> list[list[Any]]:
        """For the journal; floats keep all their digits."""
        arrays = [getattr(numbers, name).tolist() for name in self.stored]
        return [list(numbers.track_ids), *arrays]

    def from_json(self, columns: Sequence[Sequence[Any]]) -> Numbers:
        """What `to_json` made a list of."""
        track_ids, *arrays = columns
        values = {
            name: np.array(array, self.columns[name])
            for name, array in zip(self.stored, arrays, strict=True)
        }
        return self.record(track_ids=tuple(track_ids), **values)

    def to_bytes(self, items: Mapping[Item, Numbers]) -> bytes:
        """All images' boxes as one Parquet file, ordered by frame, camera and place in the labels.

        A note in the metadata lists every image, so that one without boxes differs from one that
        was not measured.
        """
        order = sorted(items)
        listed = [items[item] for item in order]
        counts = [len(numbers.track_ids) for numbers in listed]
        cameras = [camera for (_, camera), n in zip(order, counts, strict=True) for _ in range(n)]
        columns: dict[str, Any] = {
            "frame": np.repeat(np.array([frame for frame, _ in order], np.int64), counts),
            "camera": pa.array(cameras, pa.string()),
            "track_id": pa.array([i for one in listed for i in one.track_ids], pa.string()),
            "box": _joined([np.arange(n) for n in counts], np.int64),
        }
        for name, kind in self.columns.items():
            joined = _joined([getattr(numbers, name) for numbers in listed], kind)
            is_count = kind is np.int64
            columns[name] = pa.array(joined, mask=joined == NOT_COUNTED) if is_count else joined
        images = [[*item, count] for item, count in zip(order, counts, strict=True)]
        return parquet_bytes(pa.table(columns), {"kind": self.kind, "images": images})

    def read(self, path: Path) -> dict[Item, Numbers]:
        """The file's numbers by frame and camera.

        Raises:
            OutputError: the file is missing, damaged, or holds something else.
        """
        table, note = read_parquet(path)
        if note.get("kind") != self.kind:
            raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {self.kind!r}")
        with as_described(path):
            track_ids = texts_of(table["track_id"])
            columns = {name: self._column(table[name], name) for name in self.stored}
            items, start = {}, 0
            for frame, camera, count in note["images"]:
                rows = slice(start, start + count)
                # Copies: Arrow's own memory is read-only, which torch.from_numpy warns about.
                values = {name: column[rows].copy() for name, column in columns.items()}
                items[whole(frame), camera] = self.record(
                    track_ids=tuple(track_ids[rows]), **values
                )
                start += count
            check_count(table, start)
        return items

    def _column(self, data: pa.ChunkedArray, name: str) -> np.ndarray:
        if self.columns[name] is np.int64:
            data = data.fill_null(NOT_COUNTED)
        return data.to_numpy().astype(self.columns[name], casting="safe", copy=False)


def _joined(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])
