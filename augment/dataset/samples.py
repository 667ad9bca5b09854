"""The samples that the datasets yield, whether read from files or rendered on the fly.

A sample is a dictionary:

    image             float32 [3, H, W] in [0, 1], or uint8 if asked for; RGB, display-encoded
    depth             float32 [H, W], metres along the optical axis, 0 = none; or None
    semantic          uint8 [H, W], augment.semantics.SemanticClass; or None
    instance          int32 [H, W], 0 = none, else the object's number: `boxes` has them; or None
    water             bool [H, W], where a ray meets water first; None where there is no flood
    snow              bool [H, W], where the pixel shows snow; None where there is no snow
    boxes             all boxes of the frame, see `boxes.box_tensors`; None where there are none
    lidar             the frame's sweep, see `lidar_tensors`; None where there is none
    camera            name, width, height, timestamp_ns, K float64 [3, 3] in pixels of the image,
                      world_from_camera, world_from_ego float64 [4, 4] in the dataset's world
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

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch

from augment.batch.box_weather import BoxWeather
from augment.batch.calibration import CameraRecord
from augment.batch.encode import depth_in_metres
from augment.dataset.boxes import BOX_FRAMES, BoxFrame, box_tensors, moved_points
from augment.labels import Boxes, LidarSweep

_WORLD = np.eye(4)
ImageType = Literal["float32", "uint8"]
BUFFERS = ("depth", "semantic", "instance", "water", "snow")
LOADABLE = ("image", *BUFFERS, "boxes", "lidar")
DEFAULT_LOAD = ("image", *BUFFERS, "boxes")  # sweeps are large, and few train on both


@dataclass(frozen=True)
class SampleOptions:
    """What samples hold and how. load: of LOADABLE. box_frame: of boxes and LiDAR points."""

    image_type: ImageType = "float32"
    load: frozenset[str] = frozenset(DEFAULT_LOAD)
    box_frame: BoxFrame = "world"

    @staticmethod
    def checked(image_type: str, load: Collection[str], box_frame: str) -> SampleOptions:
        """The options of these values.

        Raises:
            ValueError: a value that there is not.
        """
        if image_type not in ("float32", "uint8"):
            raise ValueError(f"image_type must be 'float32' or 'uint8'; got {image_type!r}")
        if box_frame not in BOX_FRAMES:
            raise ValueError(f"box_frame must be one of {', '.join(BOX_FRAMES)}; got {box_frame!r}")
        # A single name is no collection of names, though its letters are one.
        if isinstance(load, str) or not set(load) <= set(LOADABLE):
            raise ValueError(f"load must be some of {', '.join(LOADABLE)}; got {load!r}")
        return SampleOptions(image_type, frozenset(load), box_frame)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Decoded images of one view. rgb: uint8 [H, W, 3]. depth: uint16 [H, W], steps of 1/256 m.

    semantic: uint8 [H, W]. instance: uint16 [H, W]. water, snow: uint8 [H, W], 0 or 255.
    """

    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    water: np.ndarray | None = None
    snow: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Labels:
    """What a frame has beside its images, in the dataset's world. box_weather: for the boxes.
    instances: uint16 [B], their numbers.
    """

    boxes: Boxes | None = None
    box_weather: BoxWeather | None = None
    lidar: LidarSweep | None = None
    instances: np.ndarray | None = None


def make_sample(
    *,
    options: SampleOptions,
    pixels: Pixels,
    camera: CameraRecord,
    world_from_ego: torch.Tensor,
    labels: Labels,
    weather: Mapping[str, float],
    paths: Mapping[str, str | None],
    names: Mapping[str, Any],
) -> dict[str, Any]:
    """One sample as the module describes it. names: scene, variant, frame, recipe_hash, surface."""
    depth, semantic, instance = pixels.depth, pixels.semantic, pixels.instance
    water, snow = pixels.water, pixels.snow
    origins = {"ego": world_from_ego.numpy(), "camera": camera.world_from_camera.numpy()}
    placed = (options.box_frame, origins.get(options.box_frame, _WORLD))
    boxes, lidar = labels.boxes, labels.lidar
    return {
        "image": None if pixels.rgb is None else image_tensor(pixels.rgb, options.image_type),
        "depth": None if depth is None else torch.from_numpy(depth_in_metres(depth)),
        "semantic": None if semantic is None else torch.from_numpy(semantic),
        "instance": None if instance is None else torch.from_numpy(instance.astype(np.int32)),
        "water": None if water is None else torch.from_numpy(water == 255),
        "snow": None if snow is None else torch.from_numpy(snow == 255),
        "boxes": None
        if boxes is None
        else box_tensors(boxes, labels.box_weather or {}, *placed, instances=labels.instances),
        "lidar": None if lidar is None else lidar_tensors(lidar, *placed),
        "camera": {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "timestamp_ns": camera.timestamp_ns,
            "K": camera.K,
            "world_from_camera": camera.world_from_camera,
            "world_from_ego": world_from_ego,
        },
        "weather": dict(weather),
        "paths": dict(paths),
        **names,
    }


def image_tensor(rgb: np.ndarray, image_type: ImageType) -> torch.Tensor:
    """uint8 [H, W, 3] as [3, H, W] of the type."""
    planes: Any = np.empty((3, *rgb.shape[:2]), np.uint8)
    cv2.split(rgb, list(planes))  # a third of the time of NumPy's transposed copy
    image = torch.from_numpy(planes)
    if image_type == "uint8":
        return image
    # In place: half of the time goes into touching new memory. An integer tensor / 255 takes six
    # times as long as this.
    return image.float().div_(255)


def lidar_tensors(
    sweep: LidarSweep, frame: BoxFrame, world_from_frame: np.ndarray
) -> dict[str, Any]:
    """points_m: float64 [N, 3] in the frame of the boxes. The dataset's further columns under their
    names (intensity, timestamp_ns, weather_code, ...) as tensors of their own types; text stays a
    NumPy array.
    """
    points_m = sweep.points_m
    if frame != "world":
        points_m = moved_points(points_m, world_from_frame)
    rest = {name: column for name, column in sweep.columns.items() if name not in "xyz"}
    return {
        "points_m": torch.from_numpy(points_m),
        **{n: torch.from_numpy(c) if c.dtype.kind in "biuf" else c for n, c in rest.items()},
    }
