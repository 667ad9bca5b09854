"""What a job writes beside its tables: image files, `calibration.json`, camera paths; and of what.

The same arrays always give the same bytes; every file is whole or absent.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float64, UInt8, UInt16

from augment import base_photo, effects
from augment.box_estimates import Estimate, Evidence, estimate_boxes
from augment.boxes import (
    NEAR_M,
    Instances,
    Occlusion,
    Outlines,
    PlacedBoxes,
    encode_masks,
    find_occlusion,
    instances_of,
    outline_placed,
    with_boxes,
)
from augment.cameras import Camera, Frame
from augment.errors import OutputError, SceneError
from augment.files.recorded_images import decode_pixels
from augment.jobs.atomic import read_file, write_atomic
from augment.jobs.box_tables import (
    BOXES_2D,
    MASKS,
    MODAL_SIDES,
    SIDES,
    BoxNumbers,
    BoxTable,
    BoxWeather,
)
from augment.jobs.layout import TRUST, share_columns
from augment.jobs.processes import renders_on_gpu, uninterrupted
from augment.jobs.tables import whole
from augment.labels import Boxes, LabelSource
from augment.scene import Scene
from augment.semantics import SemanticClass
from recipes.schema import Output, Recipe

# Depth of the recording car in a picture that shows it: before every box.
OWN_CAR_DEPTH_M = NEAR_M / 2


@runtime_checkable
class View(Protocol):
    """What a renderer returns, a dataclass: `augment.views.WeatheredView` or a stand-in."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    depth_m: np.ndarray | None  # float32 [H, W], 0 = none
    semantic: np.ndarray | None  # uint8 [H, W]
    instance: np.ndarray | None  # uint16 [H, W]
    masks: Mapping[str, np.ndarray]  # uint8 [H, W], by name: 0 or 255, of TRUST also between
    # What labels are measured from, as in augment.views.
    effects: Mapping[str, Any]  # EffectView by name, of the recipe's effects
    surface: Any  # SurfaceView, None without boxes


def box_tables() -> dict[str, BoxTable]:
    """All tables of what is measured of boxes, by name: that of the boxes, then the effects'."""
    own = (e.table for e in reversed(effects.EFFECTS) if e.table is not None)
    return {table.name: table for table in (BOXES_2D, MASKS, *own)}


def measure_boxes(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: View,
    *,
    shown: BoxesShown | None = None,
) -> dict[str, BoxNumbers]:
    """The boxes of a frame in one of its images. camera: at the written resolution. shown: what
    `show_boxes` found of them, with masks by depth if that has owners; None: it is found here.
    """
    placed = PlacedBoxes.of(boxes, world_origin_m)
    measured: dict[str, BoxNumbers] = {}
    if view.surface is not None:
        numbers = instances.of(boxes.track_ids)
        shown = shown or show_boxes(boxes, instances, placed, camera, view)
        columns = {"instance": numbers.astype(np.int64), **shown.columns()}
        measured[BOXES_2D.name] = BOXES_2D.numbers(boxes.track_ids, **columns)
        if shown.occlusion.owners is not None:
            places = np.arange(1, len(boxes) + 1).astype(np.uint16)
            owners = shown.paint_estimates(shown.occlusion.owners, places)
            measured[MASKS.name] = MASKS.numbers(boxes.track_ids, **encode_masks(owners, places))
    for effect in effects.EFFECTS:
        table, seen = effect.table, view.effects.get(effect.name)
        if table is not None and seen is not None:
            columns = effect.measure(placed, camera, seen)
            measured[table.name] = table.numbers(boxes.track_ids, **columns)
    return measured


def _grown(placed: PlacedBoxes, view: View) -> PlacedBoxes:
    """The boxes with what lies on them."""
    for effect in effects.EFFECTS:
        if effect.name in view.effects:
            placed = effect.grow_boxes(placed, view.effects[effect.name])
    return placed


@dataclass(frozen=True, eq=False)
class BoxesShown:
    """A frame's boxes in one image. outlines: of the projected boxes. occlusion: what rendered
    depth shows of them. estimates: of those that depth does not resolve, by their places.
    """

    outlines: Outlines
    occlusion: Occlusion
    estimates: Mapping[int, Estimate]

    def columns(self) -> dict[str, np.ndarray]:
        """The columns of BOXES_2D that are stored, without the instances."""
        found = self.occlusion
        xyxy, pixels, hidden = found.xyxy.copy(), found.shown.copy(), found.hidden.copy()
        is_estimated = np.zeros(len(pixels), bool)
        for box, estimate in self.estimates.items():
            xyxy[box], pixels[box], hidden[box] = estimate.xyxy, estimate.pixels, estimate.hidden
            is_estimated[box] = True
        return {
            **dict(zip(SIDES, self.outlines.xyxy.T.copy(), strict=True)),
            **dict(zip(MODAL_SIDES, xyxy.T.copy(), strict=True)),
            "pixels": pixels,
            "hidden_pixels": hidden,
            "truncated_fraction": self.outlines.truncated_fraction,
            "is_estimated": is_estimated,
        }

    def paint_estimates(
        self,
        image: UInt16[np.ndarray, "H W"],
        numbers: UInt16[np.ndarray, " B"],
        classes: UInt8[np.ndarray, "H W"] | None = None,
    ) -> UInt16[np.ndarray, "H W"]:
        """The image with the numbers of the estimated boxes, where it has none and does not show
        water. classes: of the surfaces that the image shows.
        """
        if not self.estimates:
            return image
        painted, can_show = image.copy(), image == 0
        if classes is not None:
            can_show &= classes != SemanticClass.WATER
        for box, estimate in self.estimates.items():
            free = can_show[estimate.rows, estimate.columns]
            free &= painted[estimate.rows, estimate.columns] == 0
            painted[estimate.rows[free], estimate.columns[free]] = numbers[box]
        return painted


def show_boxes(
    boxes: Boxes,
    instances: Instances,
    placed: PlacedBoxes,
    camera: Camera,
    view: View,
    *,
    masks: bool = False,
    evidence: Callable[[], Evidence | None] | None = None,
    on_photo: bool = False,
) -> BoxesShown:
    """Return which pixels of an image show each of its frame's boxes.

    Args:
        boxes: of the frame.
        instances: of the scene.
        placed: the boxes in the scene's world.
        camera: of the image, at the written resolution.
        view: the image, with its surface.
        masks: also find the owner of each pixel by depth.
        evidence: reads what else is known of the frame's objects; None: depth alone decides.
        on_photo: the picture is a recorded one.
    """
    surface, outlines = _with_own_car(view.surface), outline_placed(placed, camera)
    numbers = instances.of(boxes.track_ids)
    actors = np.where(numbers <= len(instances.actors), numbers, 0)
    grown = _grown(placed, view)
    occlusion = find_occlusion(
        grown, camera, surface.depth_m, surface.actors, actors,
        classes=surface.classes, with_owners=masks,
    )  # fmt: skip
    estimates: Mapping[int, Estimate] = {}
    if evidence is not None:
        estimates = estimate_boxes(
            placed, boxes.track_ids, camera, outlines, occlusion, evidence,
            on_photo=on_photo, own_car=surface.own_car,
            buried_m=np.maximum(grown.low_m[:, 2] - placed.low_m[:, 2], 0),
        )  # fmt: skip
    return BoxesShown(outlines, occlusion, estimates)


def _with_own_car(surface: Any) -> Any:
    """A SurfaceView in which the recording car of its picture is what is nearest."""
    if surface.own_car is None:
        return surface
    actors = surface.actors
    return dataclasses.replace(
        surface,
        depth_m=np.where(surface.own_car, np.float32(OWN_CAR_DEPTH_M), surface.depth_m),
        actors=None if actors is None else np.where(surface.own_car, np.uint16(0), actors),
    )


def visibility(weather: BoxWeather, count: int) -> Float64[np.ndarray, " B"]:
    """What the weather leaves of each box, [count], 0 to 1: the product of what every effect does.
    One that is absent, or that says nothing of a box (NaN), takes nothing from it: whether a box is
    in view, or behind another, is told by `pixels` of the tables.
    """
    tables = box_tables()
    factors = [np.ones(count), *(tables[name].left(numbers) for name, numbers in weather.items())]
    return np.prod([np.where(np.isnan(f), 1.0, f) for f in factors if f is not None], axis=0)


# ---- What a job renders: a scene as it is known without its Gaussians, and the images wanted -----


@dataclass(frozen=True, eq=False)
class SceneIndex:
    """A scene without its Gaussians, which a job keeps while workers hold the whole of it. frames:
    the scene's own or a camera path's. labelled: numbers of the frames whose boxes and LiDAR pass
    through; of a camera path, those that share number and timestamp with a frame of the scene.
    instances: of the objects in all the scene's own frames.
    """

    name: str
    source: str
    frames: tuple[Frame, ...]
    labels: LabelSource | None
    labelled: frozenset[int]
    instances: Instances
    world_origin_m: np.ndarray
    has_metric_scale: bool

    @staticmethod
    def of(scene: Scene, camera_path: Sequence[Frame] | None = None) -> SceneIndex:
        if camera_path is None:
            check_frames(scene)
        frames = scene.frames if camera_path is None else tuple(camera_path)
        times = {frame.index: frame.timestamp_ns for frame in scene.frames}
        labelled = {f.index for f in frames if times.get(f.index) == f.timestamp_ns}
        return SceneIndex(
            name=scene.name,
            source=scene.source,
            frames=frames,
            labels=scene.labels,
            labelled=frozenset(labelled) if scene.labels is not None else frozenset(),
            instances=instances_of(scene),
            world_origin_m=np.asarray(scene.world_origin_m, np.float64),
            has_metric_scale=scene.has_metric_scale,
        )

    @functools.cached_property
    def frames_by_number(self) -> dict[int, Frame]:
        return {frame.index: frame for frame in self.frames}


def check_frames(scene: Scene) -> None:
    """Raises SceneError, with what its adapter said, where a scene has no frames to render."""
    if not scene.frames:
        message = "; ".join(scene.problems) or "give camera_path=FILE in its URI"
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames to render: {message}"
        )


def select_frames(
    index: SceneIndex, frames: Sequence[int] | None, cameras: Sequence[str] | None
) -> list[tuple[Frame, tuple[str, ...]]]:
    """The wanted frames in order of number, each with its wanted cameras in order of name. None
    wants all. A frame without any of the cameras is left out.
    """
    known = index.frames_by_number
    if len(known) != len(index.frames):
        raise SceneError(f"scene {index.name!r}: frame numbers repeat; each must be used once")
    if frames is not None and (unknown := sorted(set(frames) - known.keys())):
        raise SceneError(
            f"scene {index.name!r} has no frame {_listed(unknown)}; it has {_ranges(known)}"
        )
    names = sorted({name for frame in index.frames for name in frame.cameras})
    if cameras is not None and (missing := sorted(set(cameras) - set(names))):
        raise SceneError(
            f"scene {index.name!r} has no camera {_listed(missing)}; it has {_listed(names)}"
        )
    requested = set(names if cameras is None else cameras)
    selected = [
        (known[number], tuple(sorted(requested & known[number].cameras.keys())))
        for number in sorted(known if frames is None else set(frames))
    ]
    selected = [(frame, names) for frame, names in selected if names]
    if not selected:
        raise SceneError(
            f"scene {index.name!r} ({index.source}): the selection holds no image; the scene has "
            f"{len(known)} frames and the cameras {_listed(names) or 'none'}"
        )
    return selected


def has_lidar(scene: Scene, frames: Iterable[int]) -> bool:
    """Whether any of the frames has a LiDAR sweep, readable or not."""
    labels = scene.labels
    if labels is None:
        return False
    for number in frames:
        try:
            if labels.lidar(number) is not None:
                return True
        except Exception:  # of a damaged file its own frame tells
            return True
    return False


def _listed(values: Sequence[object]) -> str:
    return ", ".join(map(str, values))


def _ranges(numbers: Sequence[int] | dict[int, Frame]) -> str:
    """`0-9, 12, 14-15`."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs) or "no frames"


# ---- `calibration.json`: where every camera of every frame stood, in the dataset's own world -----

CONVENTIONS = {
    "world": "the dataset's own: metres, right-handed, +z up; boxes and LiDAR are given in it too",
    "world_origin_m": "subtracted from the dataset's world while rendering, already added back in "
    "every pose here",
    "world_from_camera": "4x4, row by row: p_world = world_from_camera @ p_camera. Camera axes are "
    "OpenCV's: x right, y down, z forward",
    "world_from_ego": "4x4, row by row. Ego axes: x forward, y left, z up",
    "intrinsics": "pinhole without distortion, pixels of the written images: "
    "u = fx x / z + cx, v = fy y / z + cy, where the centre of the first pixel is (0.5, 0.5)",
    "timestamp_ns": "of a frame: its reference time; of a camera: when its image was taken",
    "depth": "uint16 PNG, metres x 256 along the optical axis, 0 = none",
}


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """One camera at one instant. world_from_camera: float64 [4, 4], dataset world. K: float64."""

    name: str
    width: int
    height: int
    timestamp_ns: int
    K: torch.Tensor
    world_from_camera: torch.Tensor


def camera_record(camera: Camera, world_origin_m: np.ndarray) -> CameraRecord:
    """The record of a camera at its written resolution, moved back into the dataset's world."""
    return CameraRecord(
        camera.name,
        camera.width,
        camera.height,
        camera.timestamp_ns,
        camera.K,
        _in_dataset(camera.world_from_camera, world_origin_m),
    )


def frame_entry(
    frame: Frame, names: Iterable[str], scale: float, world_origin_m: np.ndarray
) -> dict[str, Any]:
    """The JSON entry of a frame with some of its cameras. scale: recipe.render.scale."""
    cameras = {}
    for name in sorted(names):
        record = camera_record(frame.cameras[name].scaled(scale), world_origin_m)
        (fx, _, cx), (_, fy, cy), _ = record.K.tolist()
        cameras[name] = {
            **{key: getattr(record, key) for key in ("timestamp_ns", "width", "height")},
            **{"fx": fx, "fy": fy, "cx": cx, "cy": cy},
            "world_from_camera": record.world_from_camera.tolist(),
        }
    return {
        "frame": frame.index,
        "timestamp_ns": frame.timestamp_ns,
        "world_from_ego": _in_dataset(frame.world_from_ego, world_origin_m).tolist(),
        "cameras": cameras,
    }


def calibration_bytes(
    index: SceneIndex, variant: str, trajectory: str, entries: Mapping[int, Mapping[str, Any]]
) -> bytes:
    """The file's text, ordered by frame and camera; floats keep all their digits."""
    content = {
        "scene": index.name,
        "source": index.source,
        "variant": variant,
        "trajectory": trajectory,
        "conventions": CONVENTIONS,
        "has_metric_scale": index.has_metric_scale,
        "world_origin_m": index.world_origin_m.tolist(),
        "frames": [entries[number] for number in sorted(entries)],
    }
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def read_entries(path: Path) -> dict[int, dict[str, Any]]:
    """The frame entries of a calibration file by frame number."""
    try:
        frames = json.loads(read_file(path))["frames"]
        return {entry["frame"]: entry for entry in frames}
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise OutputError(f"{path} is missing or not a calibration file: {error!r}") from error


def read_camera(entry: Mapping[str, Any], name: str) -> CameraRecord:
    """One camera of a frame entry. Raises KeyError: the entry lacks the camera or one of its
    numbers. ValueError, TypeError, RuntimeError: a number is none.
    """
    camera = entry["cameras"][name]
    rows = [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    return CameraRecord(
        name,
        whole(camera["width"]),
        whole(camera["height"]),
        whole(camera["timestamp_ns"]),
        torch.tensor(rows, dtype=torch.float64),
        torch.tensor(camera["world_from_camera"], dtype=torch.float64),
    )


def _in_dataset(world_from_x: torch.Tensor, world_origin_m: np.ndarray) -> torch.Tensor:
    moved = world_from_x.clone()
    moved[:3, 3] += torch.from_numpy(world_origin_m)
    return moved


# ---- The identity of a camera path in the manifest -----------------------------------------------

RECORDED = "recorded"  # a scene's own frames
_CAMERA_NUMBERS = ("name", "timestamp_ns", "width", "height", "fx", "fy", "cx", "cy")


def trajectory_id(camera_path: Sequence[Frame] | None) -> str:
    """`recorded`, or `path-` and 16 hex digits of the SHA-256 of the path as JSON, exact to the
    last bit.
    """
    if camera_path is None:
        return RECORDED
    listed = [
        {
            "index": frame.index,
            "timestamp_ns": frame.timestamp_ns,
            "world_from_ego": frame.world_from_ego.tolist(),
            "cameras": [
                {
                    **{name: getattr(camera, name) for name in _CAMERA_NUMBERS},
                    "camera_from_world": camera.camera_from_world.tolist(),
                }
                for camera in frame.cameras.values()
            ],
        }
        for frame in camera_path
    ]
    text = json.dumps({"frames": listed}, indent=1)
    return "path-" + hashlib.sha256(text.encode()).hexdigest()[:16]


# ---- Arrays to image files and back --------------------------------------------------------------
# PNG settings by time and size at 960x540 on one core: libpng's run-length strategy with one fixed
# filter takes 20 ms for a photograph (Paeth, 0.53 MB) and 10 ms for a depth map (Sub), against
# 30 ms and 0.59 MB for zlib's level 1 and 118 ms and 0.51 MB for its level 6.

DEPTH_STEPS_PER_M = 256  # as KITTI's depth maps: uint16 = metres x 256, 0 = none
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


def _png_settings(filter_name: str) -> list[int]:
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    settings += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    # Older OpenCV cannot choose the filter: files are then larger, and hold the same pixels.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        settings += [cv2.IMWRITE_PNG_FILTER, getattr(cv2, f"IMWRITE_PNG_FILTER_{filter_name}")]
    return settings


def encode_image(rgb: np.ndarray, output: Output) -> bytes:
    """uint8 [H, W, 3] RGB as PNG, or as JPEG of the recipe's quality without chroma subsampling."""
    _require(rgb, np.uint8, 3, "rgb")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if output.image == "png":
        return _encode(".png", bgr, _png_settings("PAETH"))
    quality = [cv2.IMWRITE_JPEG_QUALITY, output.jpeg_quality]
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return _encode(".jpg", bgr, quality + sampling)


def decode_image(data: bytes) -> np.ndarray:
    """uint8 [H, W, 3] RGB. Raises ValueError where the bytes are no complete image."""
    bgr = _decode(data, cv2.IMREAD_COLOR)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def quantise_depth(depth_m: np.ndarray) -> np.ndarray:
    """float [H, W] metres -> uint16 steps of 1/256 m; 0 where there is none. None are: 0, negative,
    NaN, infinite, and more than 65535/256 = 255.996 m.
    """
    steps = np.rint(np.asarray(depth_m, np.float64) * DEPTH_STEPS_PER_M)
    usable = (steps >= 1) & (steps <= 65535)  # false for NaN
    return np.where(usable, steps, 0).astype(np.uint16)


def depth_in_metres(steps: np.ndarray) -> np.ndarray:
    """uint16 steps -> float32 metres, exactly (16 bits and a power of two)."""
    return steps.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)


def encode_depth(depth_m: np.ndarray) -> bytes:
    """float32 [H, W] metres as a 16-bit PNG."""
    _require(depth_m, np.float32, 2, "depth_m")
    return _encode(".png", quantise_depth(depth_m), _png_settings("SUB"))


def encode_ids(ids: np.ndarray, dtype: type) -> bytes:
    """Class or instance numbers [H, W] as a PNG of 8 bits (np.uint8) or 16 bits (np.uint16)."""
    _require(ids, dtype, 2, "ids")
    return _encode(".png", ids, _png_settings("UP"))


def encode_mask(mask: np.ndarray) -> bytes:
    """uint8 [H, W] of 0 and 255 as a PNG of 8 bits."""
    _require(mask, np.uint8, 2, "mask")
    if not ((mask == 0) | (mask == 255)).all():
        raise ValueError(f"mask must hold 0 and 255 only; got {np.unique(mask)[:8].tolist()}")
    return _encode(".png", mask, _png_settings("UP"))


def decode_png(data: bytes, dtype: type) -> np.ndarray:
    """[H, W] of `dtype`. Raises ValueError for anything but a complete PNG of that kind."""
    # libpng returns what it has of a truncated file, so the end mark is looked for.
    if not (data.startswith(_PNG_START) and data.endswith(_PNG_END)):
        raise ValueError(f"not a complete PNG file ({len(data)} bytes)")
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != dtype:
        raise ValueError(
            f"expected one channel of {np.dtype(dtype)}; got {list(image.shape)} {image.dtype}"
        )
    return image


def _encode(extension: str, array: np.ndarray, settings: list[int]) -> bytes:
    done, data = cv2.imencode(extension, np.ascontiguousarray(array), settings)
    if not done:
        raise ValueError(f"OpenCV could not encode {list(array.shape)} {array.dtype} {extension}")
    return data.tobytes()


def _decode(data: bytes, flags: int) -> np.ndarray:
    image = decode_pixels(data, flags)
    if image is None:
        raise ValueError(f"not a readable image file ({len(data)} bytes)")
    return image


def _require(array: np.ndarray, dtype: type, ndim: int, name: str) -> None:
    shape = "[H, W, 3]" if ndim == 3 else "[H, W]"
    good = array.ndim == ndim and (ndim == 2 or array.shape[2] == 3)
    if not good or array.dtype != dtype or array.size == 0:
        raise ValueError(
            f"{name} must be {np.dtype(dtype)} {shape}; got {array.dtype} {list(array.shape)}"
        )


# ---- The files of a view: its buffers first, its image last --------------------------------------


def _mean_share(mask: np.ndarray) -> float:
    """The mean of a mask, 0 to 1."""
    return int(mask.sum(dtype=np.int64)) / (255 * mask.size)


@dataclass(frozen=True)
class Written:
    """checksum: SHA-256 of the image file, hexadecimal. files: relative to the output folder.
    shares: of its pixels in masks, by the manifest's column. Times in seconds.
    """

    checksum: str
    files: tuple[str, ...]
    encode_s: float
    write_s: float
    shares: Mapping[str, float] = field(default_factory=dict)


def check_view(view: View, camera: Camera, recipe: Recipe) -> None:
    """Raise ValueError unless the view has the camera's size and the buffers the recipe asks for.
    camera: at the written resolution.
    """
    present = [effect for effect in effects.EFFECTS if effect.of(recipe) is not None]
    expected = {effect.name for effect in present}
    measured = {effect.name for effect in present if effect.table is not None}
    if not measured <= set(view.effects) <= expected:
        raise ValueError(
            f"the renderer returned what labels of {_listed(sorted(view.effects)) or 'no effect'} "
            f"are measured from, for a recipe with {_listed(sorted(expected)) or 'no effect'}"
        )
    output, masks = recipe.output, {e.mask for e in effects.EFFECTS if e.name in expected}
    masks |= {TRUST} if output.trust else set()
    requested = {
        "rgb": True,
        "depth_m": output.depth != "none",
        "semantic": output.semantic,
        "instance": output.instance,
        **dict.fromkeys(masks - {None} | set(view.masks), True),
    }
    requested |= dict.fromkeys(set(view.masks) - masks, False)
    for name, needed in requested.items():
        buffer: Any = view.masks.get(name, getattr(view, name, None))
        if (buffer is not None) != needed:
            raise ValueError(
                f"the renderer returned {'no' if needed else 'a'} {name} buffer, which the "
                f"recipe {'asks' if needed else 'does not ask'} for"
            )
        if needed and buffer.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the renderer returned {name} of {list(buffer.shape)}; camera {camera.name!r} "
                f"writes {camera.height} rows of {camera.width} pixels"
            )


# By kind of path: the field of a view, and what makes a file of it.
_BUFFERS: Mapping[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": ("depth_m", encode_depth),
    "semantic": ("semantic", partial(encode_ids, dtype=np.uint8)),
    "instance": ("instance", partial(encode_ids, dtype=np.uint16)),
}


def write_view(
    out_dir: Path, paths: Mapping[str, str | None], view: View, recipe: Recipe
) -> Written:
    """Encode and write all files of a view that `check_view` has passed. Raises ValueError: a
    buffer has another type or shape than View says. OutputError: the system refused; no partial
    file is left.
    """
    started = time.perf_counter()
    files: dict[str, bytes] = {}
    used = {kind: path for kind, path in paths.items() if path is not None}
    for kind, (buffer, encode) in _BUFFERS.items():
        if kind in used:
            files[used[kind]] = encode(getattr(view, buffer))
    files |= {
        used[name]: encode_ids(mask, np.uint8) if name == TRUST else encode_mask(mask)
        for name, mask in view.masks.items()
    }
    files[used["image"]] = image = encode_image(view.rgb, recipe.output)
    checksum = hashlib.sha256(image).hexdigest()
    encoded = time.perf_counter()
    for relative, data in files.items():
        write_atomic(out_dir / relative, data, clear=False)
    write_s = time.perf_counter() - encoded
    columns = {mask: c for mask, c in share_columns().items() if mask in view.masks}
    shares = {column: _mean_share(view.masks[mask]) for mask, column in columns.items()}
    return Written(checksum, tuple(files), encoded - started, write_s, shares)


class WritePump:
    """Runs writes on threads beside the renderer, with few waiting, so that memory stays bounded.
    The first exception of a task stops the pump: `submit` and `close` raise it.
    """

    def __init__(self, threads: int = 2, waiting: int = 4) -> None:
        """waiting: how many tasks there are at most, those included that threads are at."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="writer")
        self._slots = threading.BoundedSemaphore(waiting)
        self._error: BaseException | None = None

    @staticmethod
    def beside(backend: str, cores: int) -> WritePump:
        """For a process of so many cores: a CPU backend draws on the same cores, so two threads do;
        a GPU leaves them free, and draws faster than one of them can encode.
        """
        return WritePump(cores, cores + 2) if renders_on_gpu(backend) else WritePump()

    def submit(self, task: Callable[[], Any]) -> Future:
        """Queue a task; blocks while too many wait. Tasks start in the order they come."""
        if self._slots.acquire(blocking=False):
            return self._queue(task)
        # What has been drawn is written also where an interrupt comes during the wait.
        return uninterrupted(lambda: self._queue_when_free(task))

    def _queue_when_free(self, task: Callable[[], Any]) -> Future:
        self._slots.acquire()
        return self._queue(task)

    def _queue(self, task: Callable[[], Any]) -> Future:
        if self._error is not None:
            self._slots.release()
            raise self._error
        future = self._pool.submit(task)
        future.add_done_callback(self._done)
        return future

    def after(self, future: Future, task: Callable[[], Any]) -> None:
        """Run a short task as soon as `future` is done: now, or in the thread that is at it. So no
        thread waits for another one's task.
        """

        def run(_: Future) -> None:
            try:
                task()
            except BaseException as error:  # a future would only log it
                self._error = self._error or error

        future.add_done_callback(run)

    def close(self) -> None:
        """Wait for all tasks, also where an interrupt comes meanwhile, which is raised afterwards.
        Raises what one of them raised.
        """
        interrupt: BaseException | None = None
        while True:
            try:
                self._pool.shutdown(wait=True)
                break
            except KeyboardInterrupt as error:
                interrupt = error
        if (error := self._error or interrupt) is not None:
            raise error

    def _done(self, future: Future) -> None:
        self._error = self._error or future.exception()
        self._slots.release()


def uses_boxes(recipe: Recipe) -> bool:
    """Whether images of the recipe take the boxes of their frame."""
    return bool(recipe.output.labels) or recipe.output.instance


def label_view(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: View,
    recipe: Recipe,
    evidence: Callable[[], Evidence | None] | None = None,
) -> tuple[View, BoxWeather]:
    """A checked view with its frame's boxes: those without an actor are added to its instance
    image; and what is measured of them, where labels are written. camera: at the written
    resolution. evidence: reads what else is known of the frame's objects.
    """
    measured: dict[str, BoxNumbers] = {}
    wants_masks, output, surface = bool(recipe.output.label_formats), recipe.output, view.surface
    placed, shown = PlacedBoxes.of(boxes, world_origin_m), None
    if surface is not None:
        by_depth = wants_masks and not output.instance
        on_photo = recipe.render.base == base_photo.RECORDED
        shown = show_boxes(
            boxes, instances, placed, camera, view,
            masks=by_depth, evidence=evidence, on_photo=on_photo,
        )  # fmt: skip
    if output.labels:
        measured = measure_boxes(boxes, instances, world_origin_m, camera, view, shown=shown)
    if view.instance is None or surface is None or shown is None:
        return view, measured
    assert surface.shown_depth_m is not None and surface.shown_classes is not None
    numbers = instances.of(boxes.track_ids)
    if not surface.is_bare:
        placed = _grown(placed, view)
    painted = with_boxes(
        view.instance,
        placed,
        numbers,
        camera,
        surface.shown_depth_m,
        surface.shown_classes,
        len(instances.actors),
    )
    painted = shown.paint_estimates(painted, numbers, surface.shown_classes)
    if surface.own_car is not None:
        painted = np.where(surface.own_car, np.uint16(0), painted)
    if wants_masks:
        measured[MASKS.name] = MASKS.numbers(boxes.track_ids, **encode_masks(painted, numbers))
    changed: Any = view
    return dataclasses.replace(changed, instance=painted), measured
