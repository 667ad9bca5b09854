"""The boxes of one image in 2D, and what of each it shows: `labels/boxes_2d.parquet`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from augment.batch.box_tables import BoxTable, Item
from augment.box_pixels import PlacedBoxes
from augment.boxes_2d import find_occlusion, outline_placed
from augment.cameras import Camera
from augment.instances import Instances
from augment.labels import Boxes
from augment.snow.labels import placed_in_snow


@runtime_checkable
class Surfaces(Protocol):
    """What a view's boxes are found by; `augment.apply.SurfaceView` is one."""

    depth_m: np.ndarray  # float32 [H, W], of the first solid surface, snow included; 0 = none
    snow_m: float  # the snow's depth; 0 where none is in view
    actors: np.ndarray | None  # uint16 [H, W], actors' numbers there; None where not known
    # Of the surfaces that the instance image shows, None without one: float32, uint8 [H, W]
    shown_depth_m: np.ndarray | None
    shown_classes: np.ndarray | None
    shown_snow_m: float


@dataclass(frozen=True, eq=False)
class Box2d:
    """A frame's boxes in one image, in the labels' order; entries are [B], floats float64.

    instance: int64, the object's number (`augment.instances`). x0, y0, x1, y1: bounds of the part
    inside the image, in pixels, hidden or not; zeros out of view. modal_x0 ... modal_y1: bounds of
    the pixels that show the box; NaN where none does. pixels, hidden_pixels: int64, those, and
    those inside its outline that show what stands before it. truncated_fraction: of the outline's
    area, outside the image.
    """

    track_ids: tuple[str, ...]
    instance: np.ndarray
    x0: np.ndarray
    y0: np.ndarray
    x1: np.ndarray
    y1: np.ndarray
    modal_x0: np.ndarray
    modal_y0: np.ndarray
    modal_x1: np.ndarray
    modal_y1: np.ndarray
    pixels: np.ndarray
    hidden_pixels: np.ndarray
    truncated_fraction: np.ndarray

    @property
    def visible_fraction(self) -> np.ndarray:
        """float64 [B]: pixels of these and the hidden ones; NaN where there are neither."""
        both = self.pixels + self.hidden_pixels
        return np.where(both == 0, np.nan, self.pixels / np.maximum(both, 1))

    @property
    def modal_xyxy(self) -> np.ndarray:
        """float32 [B, 4]."""
        sides = (self.modal_x0, self.modal_y0, self.modal_x1, self.modal_y1)
        return np.stack(sides, axis=1).astype(np.float32)


_SIDES = ("x0", "y0", "x1", "y1")
_MODAL = ("modal_x0", "modal_y0", "modal_x1", "modal_y1")
BOX_2D_TABLE = BoxTable(
    kind="boxes 2d",
    record=Box2d,
    columns={
        "instance": np.int64,
        **dict.fromkeys((*_SIDES, *_MODAL), np.float64),
        "pixels": np.int64,
        "hidden_pixels": np.int64,
        "visible_fraction": np.float64,
        "truncated_fraction": np.float64,
    },
    sampled=("modal_xyxy", "visible_fraction", "truncated_fraction"),
)


def measure_2d(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    surfaces: Surfaces,
) -> Box2d:
    """The boxes of a frame in one of its images. camera: at the written resolution."""
    placed = PlacedBoxes.of(boxes, world_origin_m)
    outlines = outline_placed(placed, camera)
    if surfaces.snow_m:
        placed = placed_in_snow(placed, surfaces.snow_m)
    instance = instances.of(boxes.track_ids)
    actors = np.where(instance <= len(instances.actors), instance, 0)
    occlusion = find_occlusion(placed, camera, surfaces.depth_m, surfaces.actors, actors)
    return Box2d(
        track_ids=tuple(boxes.track_ids),
        instance=instance.astype(np.int64),
        **dict(zip(_SIDES, outlines.xyxy.T.copy(), strict=True)),
        **dict(zip(_MODAL, occlusion.xyxy.T.copy(), strict=True)),
        pixels=occlusion.shown,
        hidden_pixels=occlusion.hidden,
        truncated_fraction=outlines.truncated_fraction,
    )


def read_boxes_2d(path: Path) -> dict[Item, Box2d]:
    """The numbers of a `labels/boxes_2d.parquet` by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    return BOX_2D_TABLE.read(path)
