"""What an image shows of its frame's boxes, and what its weather does to them: a table a kind.

A row per box and image. The numbers are measured where the image is rendered, travel in the line of
its progress log, and go to the variant's files (`labels/boxes_2d.parquet` ...) when the job ends.
Files that are missing, damaged or of another kind raise OutputError.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
from jaxtyping import Float64

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
from augment.effects.smog import box_transmittance
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

Item = tuple[int, str]  # frame number and camera name


@runtime_checkable
class View(Protocol):
    """What a renderer returns, a dataclass; `augment.views.WeatheredView` is one."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    depth_m: np.ndarray | None  # float32 [H, W], 0 = none
    semantic: np.ndarray | None  # uint8 [H, W]
    instance: np.ndarray | None  # uint16 [H, W]
    water: np.ndarray | None  # uint8 [H, W], 0 or 255
    snow: np.ndarray | None  # uint8 [H, W], 0 or 255
    # What labels are measured from, as in augment.views: None without the effect, or without boxes.
    flood: Any  # FloodedView
    snowy: Any  # SnowyView
    smoggy: Any  # SmoggyView
    surface: Any  # SurfaceView


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
    """How the numbers of one kind are stored. kind: what the file says that it holds. columns: the
    file's, with their types. derived: what follows from the others; those that are columns are
    there for other readers. sampled: those that samples of the datasets have.
    """

    kind: str
    columns: Mapping[str, type]
    sampled: tuple[str, ...]
    derived: Mapping[str, Callable[[Mapping[str, Any]], np.ndarray]] = field(default_factory=dict)

    @property
    def stored(self) -> tuple[str, ...]:
        return tuple(name for name in self.columns if name not in self.derived)

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
        pairs = zip(self.stored, arrays, strict=True)
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
            columns = {name: self._column(table[name], name) for name in self.stored}
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
        if self.columns[name] is np.int64:
            data = data.fill_null(NOT_COUNTED)
        return data.to_numpy().astype(self.columns[name], casting="safe", copy=False)


def _joined(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])


def _visible_fraction(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """float64 [B]: the box's pixels of those and of what hides it; NaN where there are neither."""
    both = columns["pixels"] + columns["hidden_pixels"]
    return np.where(both == 0, np.nan, columns["pixels"] / np.maximum(both, 1))


def _fraction(name: str, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """float64 [B]: that part of the box's pixels; 0 where they were not counted, NaN of none."""
    return fraction_of(columns[name], columns["pixels"])


def _modal_xyxy(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """float32 [B, 4]."""
    return np.stack([columns[name] for name in _MODAL], axis=1).astype(np.float32)


_SIDES = ("x0", "y0", "x1", "y1")
_MODAL = ("modal_x0", "modal_y0", "modal_x1", "modal_y1")
TABLES: Mapping[str, BoxTable] = {
    # The boxes in 2D. instance: the object's number (`augment.boxes`). x0 ... y1: pixels, bounds of
    # the part inside the image, hidden or not; zeros out of view. modal_x0 ... modal_y1: bounds of
    # the pixels that show the box; NaN where none does. pixels, hidden_pixels: those, and those
    # inside its outline that show what stands before it. truncated_fraction: of the outline's area,
    # outside the image.
    "box_2d": BoxTable(
        kind="boxes 2d",
        columns={
            "instance": np.int64,
            **dict.fromkeys((*_SIDES, *_MODAL), np.float64),
            "pixels": np.int64,
            "hidden_pixels": np.int64,
            "visible_fraction": np.float64,
            "truncated_fraction": np.float64,
        },
        sampled=("modal_xyxy", "visible_fraction", "truncated_fraction"),
        derived={"visible_fraction": _visible_fraction, "modal_xyxy": _modal_xyxy},
    ),
    # submerged_fraction: of the box's height. pixels: that show the box, or NOT_COUNTED in an image
    # without water in view. hidden_pixels: those behind water.
    "box_water": BoxTable(
        kind="box water",
        columns={
            "submerged_fraction": np.float64,
            "pixels": np.int64,
            "hidden_pixels": np.int64,
            "hidden_fraction": np.float64,
        },
        sampled=("submerged_fraction", "hidden_fraction"),
        derived={"hidden_fraction": partial(_fraction, "hidden_pixels")},
    ),
    # pixels: that show the box or the snow on it, or NOT_COUNTED in an image without snow in view.
    # snow_pixels: those that show snow.
    "box_snow": BoxTable(
        kind="box snow",
        columns={"pixels": np.int64, "snow_pixels": np.int64, "snow_fraction": np.float64},
        sampled=("snow_fraction",),
        derived={"snow_fraction": partial(_fraction, "snow_pixels")},
    ),
    # transmittance: 0 to 1, of the smog between camera and box; NaN of a box whose numbers are not
    # finite. pixels: those it is the mean of; it is an estimate of none, or where NOT_COUNTED.
    "box_smog": BoxTable(
        kind="box smog",
        columns={"transmittance": np.float64, "pixels": np.int64},
        sampled=("transmittance",),
    ),
}


def measure_boxes(
    boxes: Boxes, instances: Instances, world_origin_m: np.ndarray, camera: Camera, view: View
) -> BoxWeather:
    """The boxes of a frame in one of its images. camera: at the written resolution."""
    measured: dict[str, dict[str, np.ndarray]] = {}
    if view.surface is not None:
        measured["box_2d"] = _measure_2d(boxes, instances, world_origin_m, camera, view.surface)
    if (flood := view.flood) is not None:
        counted, depth_m = None, flood.scene_depth_m
        if depth_m is not None:
            assert view.water is not None
            counted = hidden_pixels(boxes, world_origin_m, camera, depth_m, view.water)
        measured["box_water"] = {
            "submerged_fraction": submerged_fraction(boxes, world_origin_m, flood.level_z_m),
            **_counts(boxes, counted, "hidden_pixels"),
        }
    if (snow := view.snowy) is not None:
        counted, depth_m = None, snow.surface_depth_m
        if depth_m is not None:
            assert view.snow is not None
            thickness_m = snow.thickness_m
            counted = snow_pixels(boxes, world_origin_m, camera, depth_m, view.snow, thickness_m)
        measured["box_snow"] = _counts(boxes, counted, "snow_pixels")
    if (smog := view.smoggy) is not None:
        found = box_transmittance(
            boxes, world_origin_m, camera, smog.medium, smog.surface_depth_m, smog.water_level_z_m
        )
        measured["box_smog"] = {"transmittance": found.transmittance, "pixels": found.pixels}
    return {k: TABLES[k].numbers(boxes.track_ids, **columns) for k, columns in measured.items()}


def _counts(boxes: Boxes, counted: Any, marked: str) -> dict[str, np.ndarray]:
    """The pixels of each box, and those of them that are marked, by that name."""
    if counted is None:
        return {"pixels": np.full(len(boxes), NOT_COUNTED), marked: np.zeros(len(boxes), np.int64)}
    return {"pixels": counted.pixels, marked: counted.marked}


def _measure_2d(
    boxes: Boxes, instances: Instances, world_origin_m: np.ndarray, camera: Camera, surface: Any
) -> dict[str, np.ndarray]:
    placed = PlacedBoxes.of(boxes, world_origin_m)
    outlines = outline_placed(placed, camera)
    if surface.snow_m:
        placed = placed_in_snow(placed, surface.snow_m)
    instance = instances.of(boxes.track_ids)
    actors = np.where(instance <= len(instances.actors), instance, 0)
    occlusion = find_occlusion(placed, camera, surface.depth_m, surface.actors, actors)
    return {
        "instance": instance.astype(np.int64),
        **dict(zip(_SIDES, outlines.xyxy.T.copy(), strict=True)),
        **dict(zip(_MODAL, occlusion.xyxy.T.copy(), strict=True)),
        "pixels": occlusion.shown,
        "hidden_pixels": occlusion.hidden,
        "truncated_fraction": outlines.truncated_fraction,
    }


def visibility(weather: BoxWeather, count: int) -> Float64[np.ndarray, " B"]:
    """What the weather leaves of each box: transmittance of the smog, times the part of its pixels
    that no water hides, times the part that no snow covers; [count], 0 to 1. An effect that there
    is not, or that says nothing of a box (NaN: no pixel shows it, or its own numbers are not
    finite), takes nothing from it. So this is no answer to whether a box is in view, or behind
    another: `pixels` of the tables is.
    """
    factors = [np.ones(count)]
    if "box_smog" in weather:
        factors.append(weather["box_smog"]["transmittance"])
    if "box_water" in weather:
        factors.append(1 - weather["box_water"]["hidden_fraction"])
    if "box_snow" in weather:
        factors.append(1 - weather["box_snow"]["snow_fraction"])
    return np.prod([np.where(np.isnan(factor), 1.0, factor) for factor in factors], axis=0)
