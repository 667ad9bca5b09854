"""What a flood does to the boxes of one image: `labels/water.parquet`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from augment.batch.box_tables import BoxTable, Item
from augment.box_pixels import NOT_COUNTED, fraction_of
from augment.cameras import Camera
from augment.labels import Boxes
from augment.weather.flood_labels import hidden_pixels, submerged_fraction


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

    @property
    def hidden_fraction(self) -> np.ndarray:
        """float64 [B]: hidden of all its pixels; 0 where they were not counted, NaN of none."""
        return fraction_of(self.hidden_pixels, self.pixels)


WATER_TABLE = BoxTable(
    kind="box water",
    record=BoxWater,
    columns={
        "submerged_fraction": np.float64,
        "pixels": np.int64,
        "hidden_pixels": np.int64,
        "hidden_fraction": np.float64,
    },
    sampled=("submerged_fraction", "hidden_fraction"),
)


def measure_water(
    boxes: Boxes, world_origin_m: np.ndarray, camera: Camera, water: np.ndarray, flood: Flooded
) -> BoxWater:
    """The boxes of a frame in one of its images.

    camera: at the written resolution. water: uint8 [H, W], 255 where it is the first surface.
    """
    submerged = submerged_fraction(boxes, world_origin_m, flood.level_z_m)
    pixels, hidden = np.full(len(boxes), NOT_COUNTED), np.zeros(len(boxes), np.int64)
    if flood.scene_depth_m is not None:
        counted = hidden_pixels(boxes, world_origin_m, camera, flood.scene_depth_m, water)
        pixels, hidden = counted.pixels, counted.marked
    return BoxWater(tuple(boxes.track_ids), submerged, pixels, hidden)


def read_water(path: Path) -> dict[Item, BoxWater]:
    """The numbers of a `labels/water.parquet` by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    return WATER_TABLE.read(path)
