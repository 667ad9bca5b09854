"""Files that a job writes beside its tables: image files, and `calibration.json`.

In: a rendered view, its camera, its recipe and the boxes of its frame; a scene's frames. Out: bytes
and files, and the numbers measured for the boxes. `worker` and `job_state` call it; readers of an
output decode with it. The same arrays always give the same bytes; every file is complete or absent.
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

from augment import effects
from augment.errors import OutputError, SceneError
from augment.files.image_size import decode_pixels
from augment.jobs.processes import renders_on_gpu, run_uninterrupted
from augment.output.atomic import read_file, write_atomic
from augment.output.box_tables import (
    BOXES_2D,
    MASKS,
    MODAL_SIDES,
    SIDES,
    BoxNumbers,
    BoxTable,
    BoxWeather,
)
from augment.output.layout import TRUST, mask_share_columns
from augment.output.tables import checked_int
from augment.photo import recorded_base
from augment.scene.box_estimates import Estimate, Evidence, estimate_boxes
from augment.scene.boxes import (
    MIN_DEPTH_M,
    Instances,
    Occlusion,
    Outlines,
    WorldBoxes,
    encode_masks,
    find_occlusion,
    instances_of,
    outline_world_boxes,
    paint_boxes,
)
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LabelSource
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from recipes.schema import Output, Recipe

# Depth of the recording car in a picture that shows it, metres: nearer than every box.
OWN_CAR_DEPTH_M = MIN_DEPTH_M / 2


@runtime_checkable
class ViewResult(Protocol):
    """Result of a renderer, a dataclass: `augment.view.render_view.WeatheredView` or a stand-in."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    depth_m: np.ndarray | None  # float32 [H, W], 0 = none
    semantic: np.ndarray | None  # uint8 [H, W]
    instance: np.ndarray | None  # uint16 [H, W]
    masks: Mapping[str, np.ndarray]  # uint8 [H, W], by name: 0 or 255, of TRUST also between
    # The data that labels are measured from, as in augment.view.render_view.
    effects: Mapping[str, Any]  # LabelInputs by name, of the recipe's effects
    surface: Any  # LabelSurfaces, None without boxes


def box_tables() -> dict[str, BoxTable]:
    """Return all tables of measured numbers of boxes, by name.

    They are the tables of the boxes and those of the effects.
    """
    effect_tables = (e.box_table for e in reversed(effects.EFFECTS) if e.box_table is not None)
    return {table.name: table for table in (BOXES_2D, MASKS, *effect_tables)}


def measure_boxes(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: ViewResult,
    *,
    box_visibility: BoxVisibility | None = None,
) -> dict[str, BoxNumbers]:
    """Return the measured numbers of a frame's boxes in one of its images, by table.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_origin_m: Origin that was subtracted from the dataset's world, metres.
        camera: Camera at the written resolution.
        view: The image, with the data that labels are measured from.
        box_visibility: Result of `find_box_visibility` for the image, with masks by depth if it has
            owners; computed here if None.
    """
    world_boxes = WorldBoxes.from_labels(boxes, world_origin_m)
    numbers_of_table: dict[str, BoxNumbers] = {}
    if view.surface is not None:
        numbers = instances.numbers_of(boxes.track_ids)
        box_visibility = box_visibility or find_box_visibility(
            boxes, instances, world_boxes, camera, view
        )
        columns = {"instance": numbers.astype(np.int64), **box_visibility.columns()}
        numbers_of_table[BOXES_2D.name] = BOXES_2D.make_numbers(boxes.track_ids, **columns)
        if box_visibility.occlusion.owner_boxes is not None:
            box_numbers = np.arange(1, len(boxes) + 1).astype(np.uint16)
            owners = box_visibility.paint_estimates(
                box_visibility.occlusion.owner_boxes, box_numbers
            )
            numbers_of_table[MASKS.name] = MASKS.make_numbers(
                boxes.track_ids, **encode_masks(owners, box_numbers)
            )
    for effect in effects.EFFECTS:
        table = effect.box_table
        effect_view = view.effects.get(effect.name)
        if table is not None and effect_view is not None:
            columns = effect.measure_boxes(world_boxes, camera, effect_view)
            numbers_of_table[table.name] = table.make_numbers(boxes.track_ids, **columns)
    return numbers_of_table


def _grow_boxes(world_boxes: WorldBoxes, view: ViewResult) -> WorldBoxes:
    """Return the boxes grown by the layers that lie on them, such as snow."""
    for effect in effects.EFFECTS:
        if effect.name in view.effects:
            world_boxes = effect.grow_boxes(world_boxes, view.effects[effect.name])
    return world_boxes


@dataclass(frozen=True, eq=False)
class BoxVisibility:
    """Visibility of a frame's boxes in one image."""

    outlines: Outlines
    """Outlines of the projected boxes."""
    occlusion: Occlusion
    """Visibility of the boxes by rendered depth."""
    estimates: Mapping[int, Estimate]
    """Estimates of the boxes that depth does not resolve, by their positions."""

    def columns(self) -> dict[str, np.ndarray]:
        """Return the stored columns of BOXES_2D, without the instances."""
        occlusion = self.occlusion
        xyxy = occlusion.xyxy.copy()
        pixels = occlusion.num_shown.copy()
        hidden_pixels = occlusion.num_hidden.copy()
        is_estimated = np.zeros(len(pixels), bool)
        for box, estimate in self.estimates.items():
            xyxy[box] = estimate.xyxy
            pixels[box] = estimate.num_pixels
            hidden_pixels[box] = estimate.num_hidden
            is_estimated[box] = True
        return {
            **dict(zip(SIDES, self.outlines.xyxy.T.copy(), strict=True)),
            **dict(zip(MODAL_SIDES, xyxy.T.copy(), strict=True)),
            "pixels": pixels,
            "hidden_pixels": hidden_pixels,
            "truncated_fraction": self.outlines.truncated_fraction,
            "is_estimated": is_estimated,
        }

    def paint_estimates(
        self,
        image: UInt16[np.ndarray, "H W"],
        numbers: UInt16[np.ndarray, " B"],
        classes: UInt8[np.ndarray, "H W"] | None = None,
    ) -> UInt16[np.ndarray, "H W"]:
        """Return the image with the numbers of the estimated boxes painted in.

        Pixels that have a number already, or that show water, keep their value.

        Args:
            image: Instance numbers; 0 where there is none.
            numbers: Number of each box.
            classes: Classes of the surfaces that the image shows.
        """
        if not self.estimates:
            return image
        painted_image = image.copy()
        can_show = image == 0
        if classes is not None:
            can_show &= classes != SemanticClass.WATER
        for box, estimate in self.estimates.items():
            is_free = can_show[estimate.rows, estimate.columns]
            is_free &= painted_image[estimate.rows, estimate.columns] == 0
            painted_image[estimate.rows[is_free], estimate.columns[is_free]] = numbers[box]
        return painted_image


def find_box_visibility(
    boxes: Boxes,
    instances: Instances,
    world_boxes: WorldBoxes,
    camera: Camera,
    view: ViewResult,
    *,
    masks: bool = False,
    evidence: Callable[[], Evidence | None] | None = None,
    on_photo: bool = False,
) -> BoxVisibility:
    """Return the pixels of an image that show each of its frame's boxes.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_boxes: The boxes in the scene's world.
        camera: Camera of the image, at the written resolution.
        view: The image, with its surface.
        masks: If True, also find the owner of each pixel by depth.
        evidence: Reads further evidence of the frame's objects; if None, depth alone decides.
        on_photo: True if the picture is a recorded one.
    """
    surface = _with_own_car(view.surface)
    outlines = outline_world_boxes(world_boxes, camera)
    numbers = instances.numbers_of(boxes.track_ids)
    actor_numbers = np.where(numbers <= len(instances.actors), numbers, 0)
    grown_boxes = _grow_boxes(world_boxes, view)
    occlusion = find_occlusion(
        grown_boxes,
        camera,
        surface.depth_m,
        surface.actor_instance,
        actor_numbers,
        classes=surface.classes,
        with_owners=masks,
    )
    estimates: Mapping[int, Estimate] = {}
    if evidence is not None:
        estimates = estimate_boxes(
            world_boxes,
            boxes.track_ids,
            camera,
            outlines,
            occlusion,
            evidence,
            on_photo=on_photo,
            own_car=surface.own_car,
            buried_m=np.maximum(grown_boxes.low_m[:, 2] - world_boxes.low_m[:, 2], 0),
        )
    return BoxVisibility(outlines, occlusion, estimates)


def _with_own_car(surface: Any) -> Any:
    """Return the LabelSurfaces with the recording car as the nearest surface of its pixels."""
    if surface.own_car is None:
        return surface
    instance_image = surface.actor_instance
    return dataclasses.replace(
        surface,
        depth_m=np.where(surface.own_car, np.float32(OWN_CAR_DEPTH_M), surface.depth_m),
        actor_instance=(
            None
            if instance_image is None
            else np.where(surface.own_car, np.uint16(0), instance_image)
        ),
    )


def combine_visibility(weather: BoxWeather, count: int) -> Float64[np.ndarray, " B"]:
    """Return the fraction of each box that the weather leaves visible, float64 [B], 0 to 1.

    It is the product of the fractions of all effects. An effect that is absent, or that has no
    number of a box (NaN), hides nothing. Whether a box is in view, or behind another one, is in the
    column `pixels` of the tables.

    Args:
        count: Number of boxes.
    """
    tables = box_tables()
    factors = [
        np.ones(count),
        *(tables[name].visible_fractions(numbers) for name, numbers in weather.items()),
    ]
    return np.prod([np.where(np.isnan(f), 1.0, f) for f in factors if f is not None], axis=0)


# ---- The index of a scene without its Gaussians, and the selected images -------------------------


@dataclass(frozen=True, eq=False)
class SceneIndex:
    """A scene without its Gaussians, which a job keeps while workers hold the complete scene."""

    name: str
    """Name of the scene."""
    source: str
    """The scene's own statement of its origin."""
    frames: tuple[Frame, ...]
    """The scene's own frames, or those of a camera path."""
    labels: LabelSource | None
    """Source of boxes and LiDAR; None if there is none."""
    labelled_frames: frozenset[int]
    """Numbers of the frames whose boxes and LiDAR pass through. For a camera path these are the
    frames with number and timestamp of a frame of the scene.
    """
    instances: Instances
    """Numbers of the objects in all of the scene's own frames."""
    world_origin_m: np.ndarray
    """Origin that was subtracted from the dataset's world, metres."""
    has_metric_scale: bool
    """True if the scene's unit is the metre."""

    @staticmethod
    def of(scene: Scene, camera_path: Sequence[Frame] | None = None) -> SceneIndex:
        """Return the index of an open scene."""
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
            labelled_frames=frozenset(labelled) if scene.labels is not None else frozenset(),
            instances=instances_of(scene),
            world_origin_m=np.asarray(scene.world_origin_m, np.float64),
            has_metric_scale=scene.has_metric_scale,
        )

    @functools.cached_property
    def frames_by_number(self) -> dict[int, Frame]:
        """Frames by number."""
        return {frame.index: frame for frame in self.frames}


def check_frames(scene: Scene) -> None:
    """Raise SceneError, with its adapter's messages, where a scene has no frames to render."""
    if not scene.frames:
        message = "; ".join(scene.problems) or "give camera_path=FILE in its URI"
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames to render: {message}"
        )


def select_frames(
    index: SceneIndex, frames: Sequence[int] | None, cameras: Sequence[str] | None
) -> list[tuple[Frame, tuple[str, ...]]]:
    """Return the selected frames in order of number, each with its selected cameras by name.

    None selects all. A frame without any of the cameras is left out.

    Raises:
        SceneError: A frame or camera does not exist, or no image is selected.
    """
    frame_of_number = index.frames_by_number
    if len(frame_of_number) != len(index.frames):
        raise SceneError(f"scene {index.name!r}: frame numbers repeat; each must be used once")
    if frames is not None and (unknown_frames := sorted(set(frames) - frame_of_number.keys())):
        raise SceneError(
            f"scene {index.name!r} has no frame {_join_names(unknown_frames)}; it has "
            f"{_format_ranges(frame_of_number)}"
        )
    names = sorted({name for frame in index.frames for name in frame.cameras})
    if cameras is not None and (unknown_cameras := sorted(set(cameras) - set(names))):
        raise SceneError(
            f"scene {index.name!r} has no camera {_join_names(unknown_cameras)}; it has "
            f"{_join_names(names)}"
        )
    requested_cameras = set(names if cameras is None else cameras)
    selection = [
        (
            frame_of_number[number],
            tuple(sorted(requested_cameras & frame_of_number[number].cameras.keys())),
        )
        for number in sorted(frame_of_number if frames is None else set(frames))
    ]
    selection = [(frame, names) for frame, names in selection if names]
    if not selection:
        raise SceneError(
            f"scene {index.name!r} ({index.source}): the selection holds no image; the scene has "
            f"{len(frame_of_number)} frames and the cameras {_join_names(names) or 'none'}"
        )
    return selection


def has_lidar(scene: Scene, frames: Iterable[int]) -> bool:
    """Return True if any of the frames has a LiDAR sweep, readable or not."""
    labels = scene.labels
    if labels is None:
        return False
    for number in frames:
        try:
            if labels.lidar(number) is not None:
                return True
        except Exception:  # a damaged file is reported with its own frame
            return True
    return False


def _join_names(values: Sequence[object]) -> str:
    """Return values as a list for people."""
    return ", ".join(map(str, values))


def _format_ranges(numbers: Sequence[int] | dict[int, Frame]) -> str:
    """Return numbers as ranges: `0-9, 12, 14-15`."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return (
        ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)
        or "no frames"
    )


# ---- `calibration.json`: poses of all cameras of all frames, in the dataset's own world ----------

# Explanations that the file itself carries.
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
    """One camera at one time."""

    name: str
    """Name of the camera."""
    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    timestamp_ns: int
    """Time at which the image was taken."""
    K: torch.Tensor
    """Intrinsics, float64 [3, 3], pixels."""
    world_from_camera: torch.Tensor
    """Pose in the dataset's world, float64 [4, 4]."""


def camera_record(camera: Camera, world_origin_m: np.ndarray) -> CameraRecord:
    """Return the record of a camera at its written resolution, in the dataset's world."""
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
    """Return the JSON entry of a frame with some of its cameras.

    Args:
        names: Camera names.
        scale: Value of recipe.render.scale.
    """
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
    """Return the file's text, ordered by frame and camera; floats keep all their digits."""
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
    """Return the frame entries of a calibration file by frame number."""
    try:
        frames = json.loads(read_file(path))["frames"]
        return {entry["frame"]: entry for entry in frames}
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise OutputError(f"{path} is missing or not a calibration file: {error!r}") from error


def read_camera(entry: Mapping[str, Any], name: str) -> CameraRecord:
    """Return one camera of a frame entry.

    Raises:
        KeyError: The entry lacks the camera or one of its numbers.
        ValueError, TypeError, RuntimeError: A value is not a number.
    """
    camera = entry["cameras"][name]
    rows = [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    return CameraRecord(
        name,
        checked_int(camera["width"]),
        checked_int(camera["height"]),
        checked_int(camera["timestamp_ns"]),
        torch.tensor(rows, dtype=torch.float64),
        torch.tensor(camera["world_from_camera"], dtype=torch.float64),
    )


def _in_dataset(world_from_x: torch.Tensor, world_origin_m: np.ndarray) -> torch.Tensor:
    """Return a pose moved from the scene's world to the dataset's."""
    pose = world_from_x.clone()
    pose[:3, 3] += torch.from_numpy(world_origin_m)
    return pose


# ---- The identity of a camera path in the manifest -----------------------------------------------

# Trajectory of a scene's own frames.
RECORDED = "recorded"
# Numbers of a camera that decide the identity of a path.
_CAMERA_NUMBERS = ("name", "timestamp_ns", "width", "height", "fx", "fy", "cx", "cy")


def trajectory_id(camera_path: Sequence[Frame] | None) -> str:
    """Return the identity of a camera path in the manifest.

    It is `recorded` for a scene's own frames; otherwise `path-` and 16 hex digits of the SHA-256 of
    the path as JSON, exact to the last bit.
    """
    if camera_path is None:
        return RECORDED
    frame_entries = [
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
    text = json.dumps({"frames": frame_entries}, indent=1)
    return "path-" + hashlib.sha256(text.encode()).hexdigest()[:16]


# ---- Arrays to image files and back --------------------------------------------------------------
# PNG settings by time and size at 960x540 on one core: libpng's run-length strategy with one fixed
# filter takes 20 ms for a photograph (Paeth, 0.53 MB) and 10 ms for a depth map (Sub), against
# 30 ms and 0.59 MB for zlib's level 1 and 118 ms and 0.51 MB for its level 6.

# Depth steps per metre, as in KITTI's depth maps: uint16 = metres x 256, 0 = none.
DEPTH_STEPS_PER_M = 256
# First and last bytes of every PNG file.
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"


def _png_settings(filter_name: str) -> list[int]:
    """Return OpenCV's settings of a PNG file.

    Args:
        filter_name: Filter of libpng: PAETH, SUB or UP.
    """
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    settings += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    # Older OpenCV cannot choose the filter: files are then larger, and hold the same pixels.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        settings += [cv2.IMWRITE_PNG_FILTER, getattr(cv2, f"IMWRITE_PNG_FILTER_{filter_name}")]
    return settings


def encode_image(rgb: np.ndarray, output: Output) -> bytes:
    """Return uint8 [H, W, 3] RGB as a PNG or JPEG file.

    A JPEG has the recipe's quality and no chroma subsampling.
    """
    _require(rgb, np.uint8, 3, "rgb")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if output.image == "png":
        return _encode(".png", bgr, _png_settings("PAETH"))
    quality = [cv2.IMWRITE_JPEG_QUALITY, output.jpeg_quality]
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return _encode(".jpg", bgr, quality + sampling)


def decode_image(data: bytes) -> np.ndarray:
    """Return the image in a file's bytes, uint8 [H, W, 3] RGB.

    Raises:
        ValueError: The bytes are no complete image.
    """
    bgr = _decode(data, cv2.IMREAD_COLOR)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def quantise_depth(depth_m: np.ndarray) -> np.ndarray:
    """Return depth in metres [H, W] as uint16 steps of 1/256 m; 0 where there is no depth.

    There is no depth where the value is 0, negative, NaN, infinite, or more than 65535/256 =
    255.996 m.
    """
    steps = np.rint(np.asarray(depth_m, np.float64) * DEPTH_STEPS_PER_M)
    is_valid = (steps >= 1) & (steps <= 65535)  # false for NaN
    return np.where(is_valid, steps, 0).astype(np.uint16)


def depth_in_metres(steps: np.ndarray) -> np.ndarray:
    """Return uint16 steps as float32 metres, exactly (16 bits and a power of two)."""
    return steps.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)


def encode_depth(depth_m: np.ndarray) -> bytes:
    """Return float32 [H, W] metres as a 16-bit PNG."""
    _require(depth_m, np.float32, 2, "depth_m")
    return _encode(".png", quantise_depth(depth_m), _png_settings("SUB"))


def encode_ids(ids: np.ndarray, dtype: type) -> bytes:
    """Return class or instance numbers [H, W] as a PNG.

    It has 8 bits for np.uint8 and 16 bits for np.uint16.
    """
    _require(ids, dtype, 2, "ids")
    return _encode(".png", ids, _png_settings("UP"))


def encode_mask(mask: np.ndarray) -> bytes:
    """Return uint8 [H, W] of 0 and 255 as a PNG of 8 bits."""
    _require(mask, np.uint8, 2, "mask")
    if not ((mask == 0) | (mask == 255)).all():
        raise ValueError(f"mask must hold 0 and 255 only; got {np.unique(mask)[:8].tolist()}")
    return _encode(".png", mask, _png_settings("UP"))


def decode_png(data: bytes, dtype: type) -> np.ndarray:
    """Return the image in a PNG file's bytes, [H, W] of `dtype`.

    Raises:
        ValueError: The bytes are not a complete PNG of that kind.
    """
    # libpng returns the first part of a truncated file, so the end mark is checked.
    if not (data.startswith(_PNG_START) and data.endswith(_PNG_END)):
        raise ValueError(f"not a complete PNG file ({len(data)} bytes)")
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != dtype:
        raise ValueError(
            f"expected one channel of {np.dtype(dtype)}; got {list(image.shape)} {image.dtype}"
        )
    return image


def _encode(extension: str, array: np.ndarray, settings: list[int]) -> bytes:
    """Return an array as an image file."""
    is_encoded, data = cv2.imencode(extension, np.ascontiguousarray(array), settings)
    if not is_encoded:
        raise ValueError(f"OpenCV could not encode {list(array.shape)} {array.dtype} {extension}")
    return data.tobytes()


def _decode(data: bytes, flags: int) -> np.ndarray:
    """Return the array in an image file."""
    image = decode_pixels(data, flags)
    if image is None:
        raise ValueError(f"not a readable image file ({len(data)} bytes)")
    return image


def _require(array: np.ndarray, dtype: type, ndim: int, name: str) -> None:
    """Raise ValueError unless the array has this type and number of dimensions."""
    shape = "[H, W, 3]" if ndim == 3 else "[H, W]"
    has_shape = array.ndim == ndim and (ndim == 2 or array.shape[2] == 3)
    if not has_shape or array.dtype != dtype or array.size == 0:
        raise ValueError(
            f"{name} must be {np.dtype(dtype)} {shape}; got {array.dtype} {list(array.shape)}"
        )


# ---- The files of a view: first its buffers, last its image --------------------------------------


def _mean_share(mask: np.ndarray) -> float:
    """Return the mean of a mask, 0 to 1."""
    return int(mask.sum(dtype=np.int64)) / (255 * mask.size)


@dataclass(frozen=True)
class ViewFiles:
    """Files of one view."""

    checksum: str
    """SHA-256 of the image file, hexadecimal."""
    files: tuple[str, ...]
    """Paths relative to the output folder."""
    encode_s: float
    """Seconds of encoding."""
    write_s: float
    """Seconds of writing."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Shares of the image's pixels in masks, by the manifest's column."""


def check_view(view: ViewResult, camera: Camera, recipe: Recipe) -> None:
    """Raise ValueError unless the view has the size and the buffers that the recipe asks for.

    Args:
        camera: Camera at the written resolution.
    """
    present_effects = [
        effect for effect in effects.EFFECTS if effect.section_of(recipe) is not None
    ]
    effect_names = {effect.name for effect in present_effects}
    measured_names = {effect.name for effect in present_effects if effect.box_table is not None}
    if not measured_names <= set(view.effects) <= effect_names:
        raise ValueError(
            f"the renderer returned what labels of "
            f"{_join_names(sorted(view.effects)) or 'no effect'} are measured from, for a recipe "
            f"with {_join_names(sorted(effect_names)) or 'no effect'}"
        )
    output = recipe.output
    masks = {e.mask_name for e in effects.EFFECTS if e.name in effect_names}
    masks |= {TRUST} if output.trust else set()
    is_requested = {
        "rgb": True,
        "depth_m": output.depth != "none",
        "semantic": output.semantic,
        "instance": output.instance,
        **dict.fromkeys(masks - {None} | set(view.masks), True),
    }
    is_requested |= dict.fromkeys(set(view.masks) - masks, False)
    for name, is_needed in is_requested.items():
        buffer: Any = view.masks.get(name, getattr(view, name, None))
        if (buffer is not None) != is_needed:
            raise ValueError(
                f"the renderer returned {'no' if is_needed else 'a'} {name} buffer, which the "
                f"recipe {'asks' if is_needed else 'does not ask'} for"
            )
        if is_needed and buffer.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the renderer returned {name} of {list(buffer.shape)}; camera {camera.name!r} "
                f"writes {camera.height} rows of {camera.width} pixels"
            )


# Field of a view, and the function that encodes it, by kind of path.
_BUFFERS: Mapping[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": ("depth_m", encode_depth),
    "semantic": ("semantic", partial(encode_ids, dtype=np.uint8)),
    "instance": ("instance", partial(encode_ids, dtype=np.uint16)),
}


def write_view(
    out_dir: Path, paths: Mapping[str, str | None], view: ViewResult, recipe: Recipe
) -> ViewFiles:
    """Encode and write all files of a view that `check_view` has passed.

    Args:
        paths: Paths relative to the output folder, by kind.

    Raises:
        ValueError: A buffer has another type or shape than ViewResult says.
        OutputError: The system refuses; no partial file is left.
    """
    start_s = time.perf_counter()
    files: dict[str, bytes] = {}
    path_of_kind = {kind: path for kind, path in paths.items() if path is not None}
    for kind, (buffer, encode) in _BUFFERS.items():
        if kind in path_of_kind:
            files[path_of_kind[kind]] = encode(getattr(view, buffer))
    files |= {
        path_of_kind[name]: encode_ids(mask, np.uint8) if name == TRUST else encode_mask(mask)
        for name, mask in view.masks.items()
    }
    files[path_of_kind["image"]] = image = encode_image(view.rgb, recipe.output)
    checksum = hashlib.sha256(image).hexdigest()
    encoded_s = time.perf_counter()
    for relative, data in files.items():
        write_atomic(out_dir / relative, data, clear=False)
    write_s = time.perf_counter() - encoded_s
    columns = {mask: c for mask, c in mask_share_columns().items() if mask in view.masks}
    shares = {column: _mean_share(view.masks[mask]) for mask, column in columns.items()}
    return ViewFiles(checksum, tuple(files), encoded_s - start_s, write_s, shares)


class WritePump:
    """Runs writes on threads beside the renderer.

    Few writes wait at a time, so that memory stays bounded. The first exception of a task stops the
    pump: `submit` and `close` raise it.
    """

    def __init__(self, threads: int = 2, waiting: int = 4) -> None:
        """Start the pool of threads.

        Args:
            threads: Number of threads.
            waiting: Most tasks at a time, including those that threads work on.
        """
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="writer")
        self._slots = threading.BoundedSemaphore(waiting)
        self._error: BaseException | None = None

    @staticmethod
    def beside(backend: str, cores: int) -> WritePump:
        """Return the pump of a process with so many cores.

        A CPU backend renders on the same cores, so two threads write. A GPU leaves the cores free,
        and renders faster than one core can encode.
        """
        return WritePump(cores, cores + 2) if renders_on_gpu(backend) else WritePump()

    def submit(self, task: Callable[[], Any]) -> Future:
        """Queue a task; blocks while too many wait. Tasks start in the order of the calls."""
        if self._slots.acquire(blocking=False):
            return self._queue(task)
        # A rendered view is written also where an interrupt comes during the wait.
        return run_uninterrupted(lambda: self._queue_when_free(task))

    def _queue_when_free(self, task: Callable[[], Any]) -> Future:
        self._slots.acquire()
        return self._queue(task)

    def _queue(self, task: Callable[[], Any]) -> Future:
        if self._error is not None:
            self._slots.release()
            raise self._error
        future = self._pool.submit(task)
        future.add_done_callback(self._note_done)
        return future

    def after(self, future: Future, task: Callable[[], Any]) -> None:
        """Run a short task as soon as `future` is done: now, or in the thread that completes it.

        So no thread waits for another thread's task.
        """

        def run(_: Future) -> None:
            try:
                task()
            except BaseException as error:  # a future would only log it
                self._error = self._error or error

        future.add_done_callback(run)

    def close(self) -> None:
        """Wait for all tasks, then raise the first error of one of them.

        An interrupt that comes meanwhile is raised after all tasks are done.
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

    def _note_done(self, future: Future) -> None:
        self._error = self._error or future.exception()
        self._slots.release()


def uses_boxes(recipe: Recipe) -> bool:
    """Return True if images of the recipe need the boxes of their frame."""
    return bool(recipe.output.labels) or recipe.output.instance


def label_view(
    boxes: Boxes,
    instances: Instances,
    world_origin_m: np.ndarray,
    camera: Camera,
    view: ViewResult,
    recipe: Recipe,
    evidence: Callable[[], Evidence | None] | None = None,
) -> tuple[ViewResult, BoxWeather]:
    """Return the view with its frame's boxes, and the measured numbers of the boxes.

    Boxes without an actor are added to the view's instance image. Numbers are measured where labels
    are written.

    Args:
        boxes: Boxes of the frame.
        instances: Numbers of the scene's objects.
        world_origin_m: Origin that was subtracted from the dataset's world, metres.
        camera: Camera at the written resolution.
        view: result that `check_view` has passed.
        evidence: Reads further evidence of the frame's objects.
    """
    numbers_of_table: dict[str, BoxNumbers] = {}
    wants_masks = bool(recipe.output.label_formats)
    output = recipe.output
    surface = view.surface
    world_boxes = WorldBoxes.from_labels(boxes, world_origin_m)
    box_visibility = None
    if surface is not None:
        uses_depth = wants_masks and not output.instance
        on_photo = recipe.render.base == recorded_base.RECORDED
        box_visibility = find_box_visibility(
            boxes,
            instances,
            world_boxes,
            camera,
            view,
            masks=uses_depth,
            evidence=evidence,
            on_photo=on_photo,
        )
    if output.labels:
        numbers_of_table = measure_boxes(
            boxes, instances, world_origin_m, camera, view, box_visibility=box_visibility
        )
    if view.instance is None or surface is None or box_visibility is None:
        return view, numbers_of_table
    assert surface.instance_depth_m is not None and surface.instance_classes is not None
    box_numbers = instances.numbers_of(boxes.track_ids)
    if not surface.is_bare:
        world_boxes = _grow_boxes(world_boxes, view)
    instance_image = paint_boxes(
        view.instance,
        world_boxes,
        box_numbers,
        camera,
        surface.instance_depth_m,
        surface.instance_classes,
        len(instances.actors),
    )
    instance_image = box_visibility.paint_estimates(
        instance_image, box_numbers, surface.instance_classes
    )
    if surface.own_car is not None:
        instance_image = np.where(surface.own_car, np.uint16(0), instance_image)
    if wants_masks:
        numbers_of_table[MASKS.name] = MASKS.make_numbers(
            boxes.track_ids, **encode_masks(instance_image, box_numbers)
        )
    untyped_view: Any = view
    return dataclasses.replace(untyped_view, instance=instance_image), numbers_of_table
