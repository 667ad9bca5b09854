"""What a flood does to the boxes, beside their labels: `labels/water.parquet`.

A row per box and image. The numbers are measured where the image is rendered, travel in its
journal's line, and go to the variant's file when the job ends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa

from augment.batch.columns import parquet_bytes, read_parquet
from augment.cameras import Camera
from augment.errors import OutputError
from augment.labels import Boxes
from augment.weather.flood_labels import NOT_COUNTED, hidden_pixels, submerged_fraction

Item = tuple[int, str]  # frame number and camera name
_KIND = "box water"


@runtime_checkable
class Flooded(Protocol):
    """Where the water stands in a view; `augment.apply.FloodedView` is one."""

    level_z_m: float  # scene world
    scene_depth_m: np.ndarray | None  # float32 [H, W]; None where no water is in view


@dataclass(frozen=True, eq=False)
class BoxWater:
    """A frame's boxes in one image, in the labels' order; entries are [B].

    submerged_fraction: float64, 0 to 1 of the box's height. pixels: int64, that show the box, or
    NOT_COUNTED in an image without water in view. hidden_pixels: int64, those behind water.
    """

    track_ids: tuple[str, ...]
    submerged_fraction: np.ndarray
    pixels: np.ndarray
    hidden_pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.track_ids)

    @property
    def hidden_fraction(self) -> np.ndarray:
        """float64 [B]: hidden of all its pixels; 0 where they were not counted, NaN of none."""
        share = self.hidden_pixels / np.maximum(self.pixels, 1)
        return np.where(self.pixels == 0, np.nan, share)

    def to_json(self) -> list[list[Any]]:
        """For the journal; floats keep all their digits."""
        return [
            list(self.track_ids),
            self.submerged_fraction.tolist(),
            self.pixels.tolist(),
            self.hidden_pixels.tolist(),
        ]

    @staticmethod
    def from_json(columns: list[list[Any]]) -> BoxWater:
        track_ids, submerged, pixels, hidden = columns
        return BoxWater(
            tuple(track_ids),
            np.array(submerged, np.float64),
            np.array(pixels, np.int64),
            np.array(hidden, np.int64),
        )


def measure_boxes(
    boxes: Boxes,
    world_origin_m: np.ndarray,
    camera: Camera,
    water: np.ndarray,
    flood: Flooded,
) -> BoxWater:
    """The boxes of a frame in one of its images.

    camera: at the written resolution. water: uint8 [H, W], 255 where it is the first surface.
    """
    submerged = submerged_fraction(boxes, world_origin_m, flood.level_z_m)
    pixels, hidden = np.full(len(boxes), NOT_COUNTED), np.zeros(len(boxes), np.int64)
    if flood.scene_depth_m is not None:
        counted = hidden_pixels(boxes, world_origin_m, camera, flood.scene_depth_m, water)
        pixels, hidden = counted.pixels, counted.hidden
    return BoxWater(tuple(boxes.track_ids), submerged, pixels, hidden)


def water_bytes(items: Mapping[Item, BoxWater]) -> bytes:
    """All images' boxes as one Parquet file, ordered by frame, camera and place in the labels.

    A note in the metadata lists every image, so that one without boxes differs from one that was
    not measured.
    """
    order = sorted(items)
    listed = [items[item] for item in order]
    counts = [len(water) for water in listed]
    pixels = _joined([water.pixels for water in listed], np.int64)
    columns = {
        "frame": np.repeat(np.array([frame for frame, _ in order], np.int64), counts),
        "camera": pa.array([name for (_, name), n in zip(order, counts, strict=True)
                            for _ in range(n)], pa.string()),
        "track_id": pa.array([i for water in listed for i in water.track_ids], pa.string()),
        "box": _joined([np.arange(n) for n in counts], np.int64),
        "submerged_fraction": _joined([w.submerged_fraction for w in listed], np.float64),
        "pixels": pa.array(pixels, pa.int64(), mask=pixels == NOT_COUNTED),
        "hidden_pixels": _joined([water.hidden_pixels for water in listed], np.int64),
        "hidden_fraction": _joined([water.hidden_fraction for water in listed], np.float64),
    }  # fmt: skip
    images = [[*item, count] for item, count in zip(order, counts, strict=True)]
    return parquet_bytes(pa.table(columns), {"kind": _KIND, "images": images})


def read_water(path: Path) -> dict[Item, BoxWater]:
    """The file's numbers by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    table, note = read_parquet(path)
    if note.get("kind") != _KIND:
        raise OutputError(f"{path} holds {note.get('kind')!r} data; expected {_KIND!r}")
    track_ids = table["track_id"].to_pylist()
    columns = [
        # A copy: Arrow's own memory is read-only, which torch.from_numpy warns about.
        np.array(table[name].to_numpy())
        for name in ("submerged_fraction", "hidden_pixels")
    ]
    pixels = table["pixels"].fill_null(NOT_COUNTED).to_numpy()
    items, start = {}, 0
    images: Any = note["images"]
    for frame, camera, count in images:
        rows = slice(start, start + count)
        submerged, hidden = (column[rows].copy() for column in columns)
        items[frame, camera] = BoxWater(
            tuple(track_ids[rows]), submerged, pixels[rows].copy(), hidden
        )
        start += count
    return items


def _joined(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])
