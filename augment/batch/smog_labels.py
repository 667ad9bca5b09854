"""What smog leaves of the boxes of one image: `labels/smog.parquet`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from augment.batch.box_tables import BoxTable, Item
from augment.cameras import Camera
from augment.labels import Boxes
from augment.weather.smog import SmogMedium
from augment.weather.smog_labels import box_transmittance


@runtime_checkable
class Smoggy(Protocol):
    """The smog in a view; `augment.apply.SmoggyView` is one."""

    medium: SmogMedium | None  # None where the recipe's has no density
    surface_depth_m: np.ndarray | None  # float32 [H, W]; None where boxes need not be measured
    water_level_z_m: float | None  # scene world; None where no water is drawn


@dataclass(frozen=True, eq=False)
class BoxSmog:
    """A frame's boxes in one image, in the labels' order; entries are [B].

    transmittance: float64, 0 to 1, of the smog between the camera and the box; NaN of a box whose
    numbers are not finite. pixels: int64, those it is the mean of; it is an estimate where none
    shows the box, or they are NOT_COUNTED.
    """

    track_ids: tuple[str, ...]
    transmittance: np.ndarray
    pixels: np.ndarray


SMOG_TABLE = BoxTable(
    kind="box smog",
    record=BoxSmog,
    columns={"transmittance": np.float64, "pixels": np.int64},
    sampled=("transmittance",),
)


def measure_smog(
    boxes: Boxes, world_origin_m: np.ndarray, camera: Camera, smoggy: Smoggy
) -> BoxSmog:
    """The boxes of a frame in one of its images. camera: at the written resolution."""
    measured = box_transmittance(
        boxes,
        world_origin_m,
        camera,
        smoggy.medium,
        smoggy.surface_depth_m,
        smoggy.water_level_z_m,
    )
    return BoxSmog(tuple(boxes.track_ids), measured.transmittance, measured.pixels)


def read_smog(path: Path) -> dict[Item, BoxSmog]:
    """The numbers of a `labels/smog.parquet` by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    return SMOG_TABLE.read(path)
