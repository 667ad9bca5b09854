"""Tables of what is measured of a frame's boxes in each image: a row per box and image.

The numbers are measured where the image is rendered, travel in the line of its progress log, and go
to the variant's files (`labels/boxes_2d.parquet` ...) when the job ends. Files that are missing,
damaged or of another kind raise OutputError.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from augment.boxes import NOT_COUNTED, fraction_of
from augment.errors import OutputError
from augment.jobs.tables import (
    as_described,
    check_count,
    parquet_bytes,
    read_parquet,
    texts_of,
    whole,
)

Item = tuple[int, str]  # frame number and camera name


@dataclass(frozen=True, eq=False)
class BoxNumbers:
    """A frame's boxes in one image, in the labels' order. columns: [B] each, by name."""

    track_ids: tuple[str, ...]
    columns: Mapping[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]


# By the manifest's kind of path: what is seen of a view's boxes, and what each effect does to them.
BoxWeather = Mapping[str, BoxNumbers]


@dataclass(frozen=True)
class BoxTable:
    """How the numbers of one kind are stored. name: as of the manifest's column of paths,
    without `_path`. file: inside a variant's folder. kind: what the file says that it holds.
    columns: the file's, with their types, `object` for texts. derived: what follows from the
    others; those that are columns are there for other readers. later: columns, the last ones, that
    files of older versions lack, with the value that these mean. sampled: those that samples of
    the datasets have. visible, hidden: the column that says how much of a box the effect leaves
    to be seen, or takes; 0 to 1, NaN where it says nothing.
    """

    name: str
    file: str
    kind: str
    columns: Mapping[str, type]
    sampled: tuple[str, ...]
    derived: Mapping[str, Callable[[Mapping[str, Any]], np.ndarray]] = field(default_factory=dict)
    visible: str = ""
    hidden: str = ""
    later: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stored(self) -> tuple[str, ...]:
        return tuple(name for name in self.columns if name not in self.derived)

    def left(self, columns: Any) -> np.ndarray | None:
        """What the effect leaves of each box, float64 [B]; None where the table does not say."""
        if self.hidden:
            return 1 - columns[self.hidden]
        return columns[self.visible] if self.visible else None

    def numbers(self, track_ids: Sequence[str], **stored: np.ndarray) -> BoxNumbers:
        """The numbers of an image, with what follows from them."""
        derived = {name: derive(stored) for name, derive in self.derived.items()}
        return BoxNumbers(tuple(track_ids), stored | derived)

    def to_json(self, numbers: BoxNumbers) -> list[list[Any]]:
        """For the progress log; floats keep all their digits."""
        return [list(numbers.track_ids), *(numbers[name].tolist() for name in self.stored)]

    def from_json(self, columns: Sequence[Sequence[Any]]) -> BoxNumbers:
        """What `to_json` made a list of."""
        track_ids, *arrays = columns
        names = self.stored
        if len(arrays) == len(names) - len(self.later):  # of an older version's log
            arrays += [[value] * len(track_ids) for value in self.later.values()]
        pairs = zip(names, arrays, strict=True)
        return self.numbers(track_ids, **{n: np.array(a, self.columns[n]) for n, a in pairs})

    def to_bytes(self, items: Mapping[Item, BoxNumbers]) -> bytes:
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
            joined = _joined([numbers[name] for numbers in listed], kind)
            if kind is object:
                columns[name] = pa.array(joined, pa.string())
            else:
                is_count = kind is np.int64
                columns[name] = pa.array(joined, mask=joined == NOT_COUNTED) if is_count else joined
        images = [[*item, count] for item, count in zip(order, counts, strict=True)]
        return parquet_bytes(pa.table(columns), {"kind": self.kind, "images": images})

    def read(self, path: Path) -> dict[Item, BoxNumbers]:
        """The file's numbers by frame and camera."""
        table, note = read_parquet(path)
        if note.get("kind") != self.kind:
            raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {self.kind!r}")
        with as_described(path):
            track_ids = texts_of(table["track_id"])
            absent = self.later.keys() - set(table.column_names)
            columns = {
                name: np.full(len(table), self.later[name], self.columns[name])
                if name in absent
                else self._column(table[name], name)
                for name in self.stored
            }
            items, start = {}, 0
            for frame, camera, count in note["images"]:
                rows = slice(start, start + count)
                # Copies: Arrow's own memory is read-only, which torch.from_numpy warns about.
                values = {name: column[rows].copy() for name, column in columns.items()}
                items[whole(frame), camera] = self.numbers(track_ids[rows], **values)
                start += count
            check_count(table, start)
        return items

    def _column(self, data: pa.ChunkedArray, name: str) -> np.ndarray:
        if self.columns[name] is object:
            return np.array(texts_of(data), object)
        if self.columns[name] is np.int64:
            data = data.fill_null(NOT_COUNTED)
        return data.to_numpy().astype(self.columns[name], casting="safe", copy=False)


def _joined(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])


def share_of_pixels(marked: str) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    """A derived column, float64 [B]: that part of the box's `pixels`; 0 where they were not
    counted, NaN of none.
    """
    return lambda columns: fraction_of(columns[marked], columns["pixels"])


def _visible_fraction(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """float64 [B]: the box's pixels of those and of what hides it; NaN where there are neither."""
    both = columns["pixels"] + columns["hidden_pixels"]
    return np.where(both == 0, np.nan, columns["pixels"] / np.maximum(both, 1))


def _modal_xyxy(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """float32 [B, 4]."""
    return np.stack([columns[name] for name in MODAL_SIDES], axis=1).astype(np.float32)


SIDES = ("x0", "y0", "x1", "y1")
MODAL_SIDES = ("modal_x0", "modal_y0", "modal_x1", "modal_y1")
# The boxes in 2D. instance: the object's number (`augment.boxes`). x0 ... y1: pixels, bounds of the
# part inside the image, hidden or not; zeros out of view. modal_x0 ... modal_y1: bounds of the
# pixels that show the box; NaN where none does. pixels, hidden_pixels: those, and those inside its
# outline that show what stands before it. truncated_fraction: of the outline's area, outside the
# image. is_estimated: depth does not resolve the box, and its pixels are those that its projection,
# other boxes and LiDAR returns tell (`augment.box_estimates`).
BOXES_2D = BoxTable(
    name="box_2d",
    file="labels/boxes_2d.parquet",
    kind="boxes 2d",
    columns={
        "instance": np.int64,
        **dict.fromkeys((*SIDES, *MODAL_SIDES), np.float64),
        "pixels": np.int64,
        "hidden_pixels": np.int64,
        "visible_fraction": np.float64,
        "truncated_fraction": np.float64,
        "is_estimated": np.bool_,
    },
    sampled=("modal_xyxy", "visible_fraction", "truncated_fraction", "is_estimated"),
    later={"is_estimated": False},
    derived={"visible_fraction": _visible_fraction, "modal_xyxy": _modal_xyxy},
)
# Which pixels show each box: in the instance image, where the recipe has one, else by depth, the
# smallest box that has the surface. Their bounds, from the first pixel's edge to the last one's,
# how many they are, and COCO's run lengths; zeros and an empty text where there are none.
MASK_SIDES = ("left", "top", "right", "bottom")
MASKS = BoxTable(
    name="box_mask",
    file="labels/masks.parquet",
    kind="boxes masks",
    columns={**dict.fromkeys((*MASK_SIDES, "pixels"), np.int64), "rle": object},
    sampled=(),
)
