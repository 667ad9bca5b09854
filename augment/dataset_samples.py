"""The samples that the datasets yield, whether read from files or rendered on the fly.

A sample is a dictionary:

    image             float32 [3, H, W] in [0, 1], or uint8 if asked for; RGB, display-encoded
    depth             float32 [H, W], metres along the optical axis, 0 = none; or None
    semantic          uint8 [H, W], augment.semantics.SemanticClass; or None
    instance          int32 [H, W], 0 = none, else 1 + the actor's index; or None
    water             bool [H, W], where a ray meets water first; None where there is no flood
    snow              bool [H, W], where the pixel shows snow; None where there is no snow
    boxes             all boxes of the frame, see `box_tensors`; None where the dataset has none
    camera            name, width, height, timestamp_ns, K float64 [3, 3] in pixels of the image,
                      world_from_camera float64 [4, 4] in the dataset's world
    weather           the recipe's numbers by name, floats; NaN where absent
    paths             the files by kind (image, depth, ...), None where there is none
    scene, variant    names;  frame: the dataset's number;  recipe_hash: 16 hexadecimal digits
    surface           what depth, semantic and instance show of the weather: `solid`, snow but not
                      water, `scene`, neither, or `first`, both
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from augment.batch.box_weather import TABLES, BoxWeather
from augment.batch.calibration import CameraRecord
from augment.batch.encode import depth_in_metres
from augment.labels import Boxes

ImageType = Literal["float32", "uint8"]


@dataclass(frozen=True, eq=False)
class Pixels:
    """Decoded images of one view. rgb: uint8 [H, W, 3]. depth: uint16 [H, W], steps of 1/256 m.

    semantic: uint8 [H, W]. instance: uint16 [H, W]. water, snow: uint8 [H, W], 0 or 255.
    """

    rgb: np.ndarray
    depth: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    water: np.ndarray | None = None
    snow: np.ndarray | None = None


def make_sample(
    *,
    pixels: Pixels,
    image_type: ImageType,
    camera: CameraRecord,
    boxes: Boxes | None,
    box_weather: BoxWeather,
    weather: Mapping[str, float],
    paths: Mapping[str, str | None],
    names: Mapping[str, Any],
) -> dict[str, Any]:
    """One sample as the module describes it. names: scene, variant, frame, recipe_hash, surface."""
    image = torch.from_numpy(np.ascontiguousarray(pixels.rgb.transpose(2, 0, 1)))
    if image_type == "float32":
        image = image.float() / 255
    depth, semantic, instance = pixels.depth, pixels.semantic, pixels.instance
    water, snow = pixels.water, pixels.snow
    return {
        "image": image,
        "depth": None if depth is None else torch.from_numpy(depth_in_metres(depth)),
        "semantic": None if semantic is None else torch.from_numpy(semantic),
        "instance": None if instance is None else torch.from_numpy(instance.astype(np.int32)),
        "water": None if water is None else torch.from_numpy(water == 255),
        "snow": None if snow is None else torch.from_numpy(snow == 255),
        "boxes": None if boxes is None else box_tensors(boxes, box_weather),
        "camera": {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "timestamp_ns": camera.timestamp_ns,
            "K": camera.K,
            "world_from_camera": camera.world_from_camera,
        },
        "weather": dict(weather),
        "paths": dict(paths),
        **names,
    }


def box_tensors(boxes: Boxes, weather: BoxWeather) -> dict[str, Any]:
    """centers_m [B, 3], sizes_m [B, 3] (length, width, height), quats [B, 4] (wxyz,
    world_from_box): float64 tensors in the dataset's world. labels, track_ids: lists of strings.
    attributes: the dataset's further columns, NumPy arrays by name.

    submerged_fraction, hidden_fraction: float64 [B], how much of a box's height is under water,
    and of its pixels behind water (NaN where the image shows none); None where there is no flood.
    snow_fraction: float64 [B], how much of its pixels is snow (as above); None without snow.
    """
    fractions = {
        name: torch.from_numpy(getattr(weather[kind], name)) if kind in weather else None
        for kind, table in TABLES.items()
        for name in table.sampled
    }
    return {
        "centers_m": torch.from_numpy(boxes.centers_m.copy()),
        "sizes_m": torch.from_numpy(boxes.sizes_m.copy()),
        "quats": torch.from_numpy(boxes.quats.copy()),
        "labels": list(boxes.labels),
        "track_ids": list(boxes.track_ids),
        "attributes": dict(boxes.attributes),
        **fractions,
    }


def collate_frames(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch of samples, for `DataLoader(collate_fn=collate_frames)`.

    Images and buffers of one size are stacked to [N, ...]; of unlike sizes, or where a sample has
    none, they stay a list. camera: K [N, 3, 3], world_from_camera [N, 4, 4] and int64 [N] tensors,
    name a list. weather: float64 [N] per number, NaN where a sample lacks it. Everything else,
    boxes above all, is a list with one entry a sample.
    """
    first = samples[0]
    batch: dict[str, Any] = {key: [sample[key] for sample in samples] for key in first}
    for key in ("image", "depth", "semantic", "instance", "water", "snow"):
        batch[key] = _stacked(batch[key])
    cameras = batch["camera"]
    batch["camera"] = {
        "name": [camera["name"] for camera in cameras],
        "K": torch.stack([camera["K"] for camera in cameras]),
        "world_from_camera": torch.stack([camera["world_from_camera"] for camera in cameras]),
        **{
            key: torch.tensor([camera[key] for camera in cameras])
            for key in ("width", "height", "timestamp_ns")
        },
    }
    numbers = dict.fromkeys(name for sample in samples for name in sample["weather"])
    batch["weather"] = {
        name: torch.tensor(
            [sample["weather"].get(name, float("nan")) for sample in samples], dtype=torch.float64
        )
        for name in numbers
    }
    batch["frame"] = torch.tensor(batch["frame"])
    return batch


def _stacked(values: list[torch.Tensor | None]) -> torch.Tensor | list[torch.Tensor | None] | None:
    tensors = [value for value in values if value is not None]
    if not tensors:
        return None
    if len(tensors) < len(values) or len({tensor.shape for tensor in tensors}) > 1:
        return values
    return torch.stack(tensors)
