"""Tables of the numbers measured for a frame's boxes in each image: one row per box and image.

In: numbers of boxes (`augment.view.box_labels.measure_boxes`). Out: lines of a job's progress log,
and the variant's files (`labels/boxes_2d.parquet` ...). The numbers are measured where the image is
rendered, are stored in the image's line of the progress log, and go to the variant's files when the
job ends. Files that are missing, damaged or of another kind raise OutputError.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from augment.errors import OutputError
from augment.output.tables import (
    check_count,
    checked_int,
    column_texts,
    metadata_errors_as_output_errors,
    parquet_bytes,
    read_parquet,
)
from augment.scene.boxes import NOT_COUNTED, marked_fraction

# Frame number and camera name of an image.
Item = tuple[int, str]


@dataclass(frozen=True, eq=False)
class BoxNumbers:
    """Numbers of a frame's boxes in one image, in the labels' order."""

    track_ids: tuple[str, ...]
    """Track of each box."""
    columns: Mapping[str, np.ndarray]
    """Values [B] by column name."""

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]


# Numbers of a view's boxes by the manifest's kind of path: visibility, and the influence of
# effects.
BoxWeather = Mapping[str, BoxNumbers]


@dataclass(frozen=True)
class BoxTable:
    """Storage format of one kind of numbers."""

    name: str
    """Name of the manifest's column of paths, without `_path`."""
    file: str
    """Path of the file inside a variant's folder."""
    kind: str
    """Kind of content that the file states."""
    columns: Mapping[str, type]
    """Types of the file's columns by name; `object` for texts."""
    sample_columns: tuple[str, ...]
    """Columns that samples of the datasets have."""
    derived_columns: Mapping[str, Callable[[Mapping[str, Any]], np.ndarray]] = field(
        default_factory=dict
    )
    """Functions that compute columns from the stored ones, by name; those in `columns` are written
    for other readers.
    """
    visible_column: str = ""
    """Column with the fraction of each box that the effect leaves visible, 0 to 1; NaN where
    unknown. Empty if there is none.
    """
    hidden_column: str = ""
    """Column with the fraction of each box that the effect hides, 0 to 1; NaN where unknown. Empty
    if there is none.
    """
    contrast_column: str = ""
    """Column with the luminance contrast of each box to what is about it, -1 or more; NaN where
    unknown. Empty if there is none.
    """
    later_columns: Mapping[str, Any] = field(default_factory=dict)
    """The last columns, which files of older versions lack, with the values to assume."""

    @property
    def stored_columns(self) -> tuple[str, ...]:
        """Names of the columns that are stored and not derived."""
        return tuple(name for name in self.columns if name not in self.derived_columns)

    def visible_fractions(self, columns: Any) -> np.ndarray | None:
        """Return the fraction of each box that the effect leaves visible, float64 [B].

        None where the table does not say.
        """
        if self.hidden_column:
            return 1 - columns[self.hidden_column]
        return columns[self.visible_column] if self.visible_column else None

    def make_numbers(self, track_ids: Sequence[str], **stored_columns: np.ndarray) -> BoxNumbers:
        """Return the numbers of an image, with the derived columns."""
        derived_columns = {
            name: derive(stored_columns) for name, derive in self.derived_columns.items()
        }
        return BoxNumbers(tuple(track_ids), stored_columns | derived_columns)

    def to_json(self, numbers: BoxNumbers) -> list[list[Any]]:
        """Return the numbers as lists for the progress log; floats keep all their digits."""
        return [list(numbers.track_ids), *(numbers[name].tolist() for name in self.stored_columns)]

    def from_json(self, columns: Sequence[Sequence[Any]]) -> BoxNumbers:
        """Return the numbers that `to_json` made lists of."""
        track_ids, *arrays = columns
        names = self.stored_columns
        if len(arrays) == len(names) - len(self.later_columns):  # log of an older version
            arrays += [[value] * len(track_ids) for value in self.later_columns.values()]
        pairs = zip(names, arrays, strict=True)
        return self.make_numbers(track_ids, **{n: np.array(a, self.columns[n]) for n, a in pairs})

    def to_bytes(self, items: Mapping[Item, BoxNumbers]) -> bytes:
        """Return all images' boxes as one Parquet file, by frame, camera and order in the labels.

        A note in the metadata lists every image, so that an image without boxes differs from one
        that was not measured.
        """
        order = sorted(items)
        image_numbers = [items[item] for item in order]
        counts = [len(numbers.track_ids) for numbers in image_numbers]
        cameras = [camera for (_, camera), n in zip(order, counts, strict=True) for _ in range(n)]
        columns: dict[str, Any] = {
            "frame": np.repeat(np.array([frame for frame, _ in order], np.int64), counts),
            "camera": pa.array(cameras, pa.string()),
            "track_id": pa.array(
                [name for image in image_numbers for name in image.track_ids], pa.string()
            ),
            "box": _joined([np.arange(n) for n in counts], np.int64),
        }
        for name, kind in self.columns.items():
            values = _joined([numbers[name] for numbers in image_numbers], kind)
            if kind is object:
                columns[name] = pa.array(values, pa.string())
            else:
                is_count = kind is np.int64
                columns[name] = pa.array(values, mask=values == NOT_COUNTED) if is_count else values
        images = [[*item, count] for item, count in zip(order, counts, strict=True)]
        return parquet_bytes(pa.table(columns), {"kind": self.kind, "images": images})

    def read(self, path: Path) -> dict[Item, BoxNumbers]:
        """Return the file's numbers by frame and camera."""
        table, note = read_parquet(path)
        if note.get("kind") != self.kind:
            raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {self.kind!r}")
        with metadata_errors_as_output_errors(path):
            track_ids = column_texts(table["track_id"])
            absent_columns = self.later_columns.keys() - set(table.column_names)
            columns = {
                name: np.full(len(table), self.later_columns[name], self.columns[name])
                if name in absent_columns
                else self._column(table[name], name)
                for name in self.stored_columns
            }
            items = {}
            start = 0
            for frame, camera, count in note["images"]:
                rows = slice(start, start + count)
                # Copies: Arrow's own memory is read-only, which torch.from_numpy warns about.
                values = {name: column[rows].copy() for name, column in columns.items()}
                items[checked_int(frame), camera] = self.make_numbers(track_ids[rows], **values)
                start += count
            check_count(table, start)
        return items

    def _column(self, data: pa.ChunkedArray, name: str) -> np.ndarray:
        """Return a column as an array of its type."""
        if self.columns[name] is object:
            return np.array(column_texts(data), object)
        if self.columns[name] is np.int64:
            data = data.fill_null(NOT_COUNTED)
        return data.to_numpy().astype(self.columns[name], casting="safe", copy=False)


def _joined(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])


def pixel_fraction(column_name: str) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    """Return a function that divides a column by the box's column `pixels`, float64 [B].

    The result is 0 where the column was not counted, and NaN for a box without pixels.

    Args:
        column_name: Column with a number of pixels.
    """
    return lambda columns: marked_fraction(columns[column_name], columns["pixels"])


def _visible_fraction(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the box's visible pixels, divided by visible and hidden ones, float64 [B].

    NaN where there are neither.
    """
    all_pixels = columns["pixels"] + columns["hidden_pixels"]
    return np.where(all_pixels == 0, np.nan, columns["pixels"] / np.maximum(all_pixels, 1))


def _modal_xyxy(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the bounds of the visible pixels, float32 [B, 4]."""
    return np.stack([columns[name] for name in MODAL_SIDES], axis=1).astype(np.float32)


SIDES = ("x0", "y0", "x1", "y1")
MODAL_SIDES = ("modal_x0", "modal_y0", "modal_x1", "modal_y1")
# The boxes in 2D. Its columns are:
#   instance: number of the object (`augment.scene.boxes`).
#   x0 ... y1: bounds of the part inside the image, hidden or not, pixels; zeros out of view.
#   modal_x0 ... modal_y1: bounds of the pixels that show the box; NaN where none does.
#   pixels: number of pixels that show the box.
#   hidden_pixels: number of pixels inside its outline that show something in front of it.
#   truncated_fraction: fraction of the outline's area that lies outside the image.
#   is_estimated: True if depth does not resolve the box; its pixels are then estimated from its
#     projection, other boxes and LiDAR returns (`augment.scene.box_estimates`).
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
    sample_columns=("modal_xyxy", "visible_fraction", "truncated_fraction", "is_estimated"),
    later_columns={"is_estimated": False},
    derived_columns={"visible_fraction": _visible_fraction, "modal_xyxy": _modal_xyxy},
)
# Bounds of a mask, from the first pixel's edge to the last one's.
MASK_SIDES = ("left", "top", "right", "bottom")
# Pixels that show each box: those of the instance image, where the recipe has one; otherwise by
# depth, the smallest box that has the surface. Columns: bounds, number of pixels, and COCO's run
# lengths; zeros and an empty text where there are none.
MASKS = BoxTable(
    name="box_mask",
    file="labels/masks.parquet",
    kind="boxes masks",
    columns={**dict.fromkeys((*MASK_SIDES, "pixels"), np.int64), "rle": object},
    sample_columns=(),
)
