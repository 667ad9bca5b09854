"""The samples that the datasets yield, whether read from files or rendered on the fly.

A sample is a dictionary:

    image             float32 [3, H, W] in [0, 1], or uint8 if asked for; RGB, display-encoded
    depth             float32 [H, W], metres along the optical axis (along the ray of a pixel for a
                      fisheye or an f-theta lens), 0 = none; or None
    semantic          uint8 [H, W], augment.scene.semantics.SemanticClass; or None
    instance          int32 [H, W], 0 = none, else the object's number: `boxes` has them; or None
    water             bool [H, W], where a ray meets water first; None where there is no flood
    snow              bool [H, W], where the pixel shows snow; None where there is no snow
    rain, snowfall    bool [H, W], where a streak or a flake covers the pixel; None without
    trust             float32 [H, W], how far the picture can be believed, 0 to 1; None where nobody
                      asked
    boxes             all boxes of the frame, see `box_tensors`; None where there are none
    lidar             the frame's sweep, see `lidar_tensors`; None where there is none
    camera            name, width, height, timestamp_ns, K float64 [3, 3] in pixels of the image,
                      world_from_camera, world_from_ego float64 [4, 4] in the dataset's world;
                      lens and shutter as calibration.json has them, None for a pinhole
    weather           the recipe's numbers by name, floats; NaN where absent
    paths             the files by kind (image, depth, ...), None where there is none
    scene, variant    names;  frame: the dataset's number;  recipe_hash: 16 hexadecimal digits
    surface           what depth, semantic and instance show of the weather: `solid`, snow but not
                      water, `scene`, neither, or `first`, both

What a dataset was not asked to load is None.

Frames: the dataset's world, right-handed, z up, metres; the ego's x forward, y left, z up; the
camera's (OpenCV) x right, y down, z forward. The first pixel's centre is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.utils.data import get_worker_info

from augment.files.lens_records import lens_record, shutter_record
from augment.output.box_tables import BoxWeather
from augment.output.box_weather import box_tables, combine_visibility
from augment.output.calibration import CameraRecord
from augment.output.codecs import depth_in_metres
from augment.output.layout import TRUST, mask_names
from augment.scene.labels import Boxes, LidarSweep

ImageType = Literal["float32", "uint8"]
BoxFrame = Literal["world", "ego", "camera"]
Sample = dict[str, Any]
NAMES = ("scene", "variant", "frame", "recipe_hash", "surface")  # as in the manifest


class Buffer(NamedTuple):
    """Form of an image beside the picture."""

    pixel_type: type
    """Type of the file's pixels."""
    tensor: Callable[[np.ndarray], torch.Tensor]
    """Function that makes the sample's tensor of the file's pixels."""
    is_in_all_samples: bool = True
    """If True, a batch has the image of all samples or of none."""


_BUFFERS = {
    "depth": Buffer(np.uint16, lambda steps: torch.from_numpy(depth_in_metres(steps))),
    "semantic": Buffer(np.uint8, torch.from_numpy),
    "instance": Buffer(np.uint16, lambda ids: torch.from_numpy(ids.astype(np.int32))),
}
# Form of a mask, uint8, 0 or 255; only samples with such weather have it, or those asked for it.
_MASK = Buffer(np.uint8, lambda mask: torch.from_numpy(mask == 255), is_in_all_samples=False)
# Form of the trust mask, whose values are graded.
_TRUST = Buffer(
    np.uint8, lambda mask: torch.from_numpy(mask).float() / 255, is_in_all_samples=False
)


def buffers() -> dict[str, Buffer]:
    """Return the buffers by name: depth, semantic, instance, and the masks."""
    return _BUFFERS | dict.fromkeys(mask_names(), _MASK) | {TRUST: _TRUST}


def loadable() -> tuple[str, ...]:
    """Return the names that `load` may have: all that samples can hold."""
    return ("image", *buffers(), "boxes", "lidar")


@dataclass(frozen=True)
class SampleOptions:
    """Content and form of samples."""

    image_type: ImageType
    """Type of the image's values."""
    load: frozenset[str]
    """Names of `loadable` that samples hold."""
    box_frame: BoxFrame
    """Frame of boxes and LiDAR points."""

    @staticmethod
    def create(
        image_type: str = "float32", load: Collection[str] | None = None, box_frame: str = "world"
    ) -> SampleOptions:
        """Return checked options.

        Args:
            image_type: type of the image's values.
            load: names of `loadable`; None takes all but sweeps, which are large and which few
                users train on together with images.
            box_frame: frame of boxes and LiDAR points.

        Raises:
            ValueError: a value does not exist.
        """
        if load is None:
            load = set(loadable()) - {"lidar"}
        check_choice("image_type", image_type, ImageType)
        check_choice("box_frame", box_frame, BoxFrame)
        # A single name is no collection of names, though its letters are one.
        if isinstance(load, str) or not set(load) <= set(loadable()):
            raise ValueError(f"load must be some of {', '.join(loadable())}; got {load!r}")
        return SampleOptions(image_type, frozenset(load), box_frame)  # pyright: ignore[reportArgumentType]


def check_choice(name: str, value: str, choices: Any) -> None:
    """Raise ValueError unless the value is one of a Literal's."""
    if value not in get_args(choices):
        raise ValueError(f"{name} must be one of {', '.join(get_args(choices))}; got {value!r}")


def check_index(index: int, count: int, item_name: str = "sample") -> int:
    """Return the index counted from 0, as a list counts it.

    Raises:
        IndexError: the index is outside.
    """
    if not -count <= index < count:
        raise IndexError(f"{item_name} {index} of a dataset of {count}")
    return index % count


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels of a frame, in the dataset's world."""

    boxes: Boxes | None = None
    """Labelled boxes; None without any."""
    box_weather: BoxWeather | None = None
    """Numbers of the weather at each box."""
    lidar: LidarSweep | None = None
    """The frame's sweep; None without one."""
    instances: np.ndarray | None = None
    """Numbers of the boxes in instance images, uint16 [B]."""


def make_sample(
    *,
    options: SampleOptions,
    images: Mapping[str, np.ndarray],
    camera: CameraRecord,
    world_from_ego: torch.Tensor,
    labels: Labels,
    metadata: Mapping[str, Any],
) -> Sample:
    """Return one sample, a dictionary as the head of this module lists it.

    Args:
        options: content and form of the sample.
        images: images by the names of `load`, RGB [H, W, 3] or [H, W], with the pixels that files
            store.
        camera: the camera of the image.
        world_from_ego: pose of the car, float64 [4, 4].
        labels: labels of the frame.
        metadata: weather, paths and NAMES.
    """
    sample: Sample = dict.fromkeys(loadable())
    for name, image in images.items():
        if name == "image":
            sample[name] = image_tensor(image, options.image_type)
        else:
            sample[name] = buffers()[name].tensor(image)
    origins = {"ego": world_from_ego, "camera": camera.world_from_camera}
    axes = (options.box_frame, origins.get(options.box_frame, torch.eye(4)).numpy())
    if labels.boxes is not None:
        weather = labels.box_weather or {}
        sample["boxes"] = box_tensors(labels.boxes, weather, *axes, instances=labels.instances)
    if labels.lidar is not None:
        sample["lidar"] = lidar_tensors(labels.lidar, *axes)
    return {**sample, "camera": _camera_entry(camera, world_from_ego), **metadata}


def _camera_entry(camera: CameraRecord, world_from_ego: torch.Tensor) -> dict[str, Any]:
    """Return the camera of a sample, with lens and shutter in the form of calibration.json."""
    return {
        **vars(camera),
        "lens": None if camera.lens is None else lens_record(camera.lens),
        "shutter": None if camera.shutter is None else shutter_record(camera.shutter),
        "world_from_ego": world_from_ego,
    }


def image_tensor(rgb: np.ndarray, image_type: ImageType) -> torch.Tensor:
    """Return an image, uint8 [H, W, 3], as a tensor [3, H, W] of the type."""
    planes: Any = np.empty((3, *rgb.shape[:2]), np.uint8)
    cv2.split(rgb, list(planes))  # a third of the time of NumPy's transposed copy
    image = torch.from_numpy(planes)
    if image_type == "uint8":
        return image
    # In place: half of the time goes into touching new memory. An integer tensor / 255 takes six
    # times as long as this.
    return image.float().div_(255)


def box_tensors(
    boxes: Boxes,
    weather: BoxWeather,
    box_frame: BoxFrame,
    world_from_frame: np.ndarray,
    *,
    instances: np.ndarray | None = None,
) -> dict[str, Any]:
    """Return the boxes of a sample, a dictionary of float64 tensors and lists.

        centers_m         [B, 3], in `frame`
        sizes_m           [B, 3], length, width, height
        quats             [B, 4], wxyz, frame_from_box
        frame             `box_frame`
        labels, track_ids lists of strings
        attributes        the dataset's further columns, NumPy arrays by name
        instance          int32 [B], the objects' numbers in instance images
        modal_xyxy        float32 [B, 4], as `Boxes2d.xyxy`, but of the pixels that show a box; NaN
                          where none does
        visible_fraction  [B], of the pixels that show a box or what stands before it; NaN where
        there
                          are neither
        truncated_fraction [B], part of the projected box's area outside the image
        submerged_fraction [B], part of a box's height under water
        hidden_fraction   [B], part of its pixels behind water; NaN where the image shows none
        snow_fraction     [B], part of its pixels that is snow; NaN as above
        transmittance, rain_transmittance, snowfall_transmittance
                          [B], of the smog, rain or snowfall before the box, 0 to 1
        streak_fraction, flake_fraction
                          [B], part of its pixels that shows a streak or a flake; NaN as above
        visibility        [B], part of the box that all of this leaves visible, 0 to 1
                          (`augment.output.box_weather.combine_visibility`)

    Values are None without the weather that they measure. instance, modal_xyxy, visible_fraction
    and truncated_fraction are None where the output is older than they.

    Args:
        boxes: the boxes, in the dataset's world.
        weather: numbers of the weather at each box.
        box_frame: frame of the result.
        world_from_frame: pose of that frame, float64 [4, 4]; unused where the frame is the world,
            whose numbers keep their bits.
        instances: numbers of the boxes in instance images; None where not known.
    """
    centers_m = boxes.centers_m.copy()
    quats = boxes.quats.copy()
    if box_frame != "world":
        centers_m = points_in_frame(centers_m, world_from_frame)
        quats = quats_in_frame(quats, world_from_frame)
    fractions = {
        name: torch.from_numpy(weather[kind][name].copy()) if kind in weather else None
        for kind, table in box_tables().items()
        for name in table.sample_columns
    }
    return {
        "frame": box_frame,
        "centers_m": torch.from_numpy(centers_m),
        "sizes_m": torch.from_numpy(boxes.sizes_m.copy()),
        "quats": torch.from_numpy(quats),
        "labels": list(boxes.labels),
        "track_ids": list(boxes.track_ids),
        "attributes": dict(boxes.attributes),
        "instance": None if instances is None else torch.from_numpy(instances.astype(np.int32)),
        **fractions,
        "visibility": torch.from_numpy(combine_visibility(weather, len(boxes))),
    }


def points_in_frame(points_m: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Return points of the world [N, 3] in the coordinates of another frame."""
    with np.errstate(invalid="ignore"):  # points that are not finite stay so
        return (points_m - world_from_frame[:3, 3]) @ world_from_frame[:3, :3]


def quats_in_frame(quats: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Return rotations world_from_box as frame_from_box; the quaternions keep their norms."""
    x, y, z, w = Rotation.from_matrix(world_from_frame[:3, :3].T).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    with np.errstate(invalid="ignore"):
        return quats @ left.T


def lidar_tensors(
    sweep: LidarSweep, frame: BoxFrame, world_from_frame: np.ndarray
) -> dict[str, Any]:
    """Return a sweep as tensors.

    points_m is float64 [N, 3] in the frame of the boxes. The dataset's further columns keep their
    names (intensity, timestamp_ns, weather_code, ...) as tensors of their own types; text stays a
    NumPy array.

    Args:
        sweep: the sweep, in the dataset's world.
        frame: frame of the result.
        world_from_frame: pose of that frame, float64 [4, 4].
    """
    points_m = sweep.points_m
    if frame != "world":
        points_m = points_in_frame(points_m, world_from_frame)
    other_columns = {name: column for name, column in sweep.columns.items() if name not in "xyz"}
    return {
        "points_m": torch.from_numpy(points_m),
        **{
            n: torch.from_numpy(c) if c.dtype.kind in "biuf" else c
            for n, c in other_columns.items()
        },
    }


# ---- Batches of samples for a DataLoader ---------------------------------------------------------


def collate_frames(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a batch of samples, for `DataLoader(collate_fn=collate_frames)`.

    Images and buffers of one size are stacked to [N, ...]. Of unlike sizes they stay a list, as do
    masks of water and snow where a sample has none. Cameras have K [N, 3, 3], world_from_camera and
    world_from_ego [N, 4, 4], int64 [N] tensors, and lists of names, lenses and shutters. Weather is
    float64 [N] per number, NaN where a sample lacks it. Everything else, boxes above all, is a list
    with one entry a sample. Clips gain the same dimension in front: image [N, T, C, 3, H, W],
    K [N, T, C, 3, 3], frame [N, T]. Pairs become a dictionary of two batches.

    Raises:
        ValueError: some samples have an image or buffer that others lack, masks excepted: datasets
            of unlike outputs or `load` are mixed.
    """
    first = samples[0]
    if "weathered" in first and "clean" in first:
        return {side: collate_frames([pair[side] for pair in samples]) for side in first}
    batch: dict[str, Any] = {key: [sample[key] for sample in samples] for key in first}
    for key in ("image", *buffers()):
        if key == "image" or buffers()[key].is_in_all_samples:
            _check_in_all(key, samples)
        batch[key] = stack_same_shape(batch[key], _stack_shared)
    batch["camera"] = stack_cameras(batch["camera"], _stack_shared)
    batch["frame"] = _stack_numbers(batch["frame"], _stack_shared)
    columns = dict.fromkeys(name for weather in batch["weather"] for name in weather)
    batch["weather"] = {
        name: torch.tensor([w.get(name, np.nan) for w in batch["weather"]], dtype=torch.float64)
        for name in columns
    }
    return batch


def _check_in_all(key: str, samples: Sequence[Mapping[str, Any]]) -> None:
    """Raise ValueError if some samples lack a value that others have."""
    gaps = [sample for sample in samples if sample[key] is None]
    if 0 < len(gaps) < len(samples):
        names = dict.fromkeys(f"{sample['scene']}/{sample['variant']}" for sample in gaps)
        raise ValueError(
            f"{len(gaps)} of a batch's {len(samples)} samples have no {key}: of scene/variant "
            f"{', '.join(names)}. Leave {key!r} out of `load` in all datasets that are mixed, or "
            f"mix only outputs that have it"
        )


# Entries of a camera that are no numbers.
_CAMERA_LISTS = ("name", "lens", "shutter")
Stack = Callable[[list[torch.Tensor]], torch.Tensor]


def stack_same_shape(values: list[Any], stack: Stack = torch.stack) -> Any:
    """Stack tensors of one shape.

    Returns:
        The stack; None if all values are None; the list if their shapes differ.
    """
    shapes = {None if value is None else value.shape for value in values}
    if shapes == {None}:
        return None
    return values if None in shapes or len(shapes) > 1 else stack(values)


def _stack_shared(tensors: list[torch.Tensor]) -> torch.Tensor:
    """Stack tensors in memory that a worker process shares with its parent.

    Otherwise the queue to the parent would copy the batch once more; torch's own collate function
    does the same.
    """
    if get_worker_info() is None:
        return torch.stack(tensors)
    example = tensors[0]
    size = (len(tensors), *tensors[0].shape)
    storage = example._typed_storage()._new_shared(
        example.numel() * len(tensors), device=example.device
    )
    return torch.stack(tensors, out=example.new(storage).resize_(size))


def stack_cameras(cameras: Sequence[Mapping[str, Any]], stack: Stack) -> dict[str, Any]:
    """Stack the matrices and numbers of cameras.

    Names, lenses and shutters become a list; so do matrices and numbers of clips that differ in
    shape.
    """
    values = {key: [camera[key] for camera in cameras] for key in cameras[0]}
    return {k: v if k in _CAMERA_LISTS else _stack_numbers(v, stack) for k, v in values.items()}


def _stack_numbers(values: list[Any], stack: Stack) -> Any:
    """Stack tensors, or make a tensor int64 [N] of whole numbers."""
    is_tensor = isinstance(values[0], torch.Tensor)
    return stack_same_shape(values, stack) if is_tensor else torch.tensor(values)
