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

from augment.boxes import (
    NOT_COUNTED,
    Instances,
    PlacedBoxes,
    find_occlusion,
    fraction_of,
    outline_placed,
)
from augment.cameras import Camera
from augment.effects.flood.flood import hidden_pixels, submerged_fraction
from augment.effects.smog import SmogMedium, box_transmittance
from augment.effects.snow.snow import placed_in_snow, snow_pixels
from augment.errors import OutputError
from augment.jobs.tables import (
    as_described,
    check_count,
    parquet_bytes,
    read_parquet,
    texts_of,
    whole,
)
from augment.labels import Boxes

# ---- box tables ----------------------------------------------------------------------------------

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


# ---- The boxes of one image in 2D, and what of each it shows: `labels/boxes_2d.parquet` ----------


@runtime_checkable
class Surfaces(Protocol):
    """What a view's boxes are found by; `augment.views.SurfaceView` is one."""

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

    instance: int64, the object's number (`augment.boxes`). x0, y0, x1, y1: bounds of the part
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


# ---- What smog leaves of the boxes of one image: `labels/smog.parquet` ---------------------------


@runtime_checkable
class Smoggy(Protocol):
    """The smog in a view; `augment.views.SmoggyView` is one."""

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
        boxes, world_origin_m, camera, smoggy.medium, smoggy.surface_depth_m, smoggy.water_level_z_m
    )
    return BoxSmog(tuple(boxes.track_ids), measured.transmittance, measured.pixels)


def read_smog(path: Path) -> dict[Item, BoxSmog]:
    """The numbers of a `labels/smog.parquet` by frame and camera.

    Raises:
        OutputError: the file is missing, damaged, or holds something else.
    """
    return SMOG_TABLE.read(path)


# ---- What snow does to the boxes of one image: `labels/snow.parquet` -----------------------------


@runtime_checkable
class Snowy(Protocol):
    """How the snow lies in a view; `augment.views.SnowyView` is one."""

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


# ---- What a flood does to the boxes of one image: `labels/water.parquet` -------------------------


@runtime_checkable
class Flooded(Protocol):
    """Where the water stands in a view; `augment.views.FloodedView` is one."""

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
