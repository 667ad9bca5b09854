"""What snow does to the boxes of one image: `labels/snow.parquet`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from augment.batch.box_tables import BoxTable, Item
from augment.box_pixels import NOT_COUNTED, fraction_of
from augment.cameras import Camera
from augment.labels import Boxes
from augment.snow.labels import snow_pixels


@runtime_checkable
class Snowy(Protocol):
    """How the snow lies in a view; `augment.apply.SnowyView` is one."""

    surface_depth_m: np.ndarray | None  # float32 [H, W]; None where boxes need not be measured
    thickness_m: float


@dataclass(frozen=True, eq=False)
class BoxSnow:
    """A frame's boxes in one image, in the labels' order; entries are [B].

    pixels: int64, that show the box or the snow on it, or NOT_COUNTED in an image without snow in
    view. snow_pixels: int64, those that show snow.
    """

    track_ids: tuple[str, ...]
    pixels: np.ndarray
    snow_pixels: np.ndarray

    @property
    def snow_fraction(self) -> np.ndarray:
        """float64 [B]: snow of all its pixels; 0 where they were not counted, NaN of none."""
        return fraction_of(self.snow_pixels, self.pixels)


SNOW_TABLE = BoxTable(
    kind="box snow",
    record=BoxSnow,
    columns={"pixels": np.int64, "snow_pixels": np.int64, "snow_fraction": np.float64},
    sampled=("snow_fraction",),
)


def measure_snow(
    boxes: Boxes, world_origin_m: np.ndarray, camera: Camera, snow: np.ndarray, snowy: Snowy
) -> BoxSnow:
    """The boxes of a frame in one of its images.

    camera: at the written resolution. snow: uint8 [H, W], 255 where the pixel shows snow.
    """
    pixels, covered = np.full(len(boxes), NOT_COUNTED), np.zeros(len(boxes), np.int64)
    depth = snowy.surface_depth_m
    if depth is not None:
        counted = snow_pixels(boxes, world_origin_m, camera, depth, snow, snowy.thickness_m)
        pixels, covered = counted.pixels, counted.marked
    return BoxSnow(tuple(boxes.track_ids), pixels, covered)


def read_snow(path: Path) -> dict[Item, BoxSnow]:
    """The numbers of a `labels/snow.parquet` by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    return SNOW_TABLE.read(path)
