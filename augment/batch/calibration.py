"""`calibration.json`: where every camera of every frame stood, in the dataset's own world."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.batch.columns import whole
from augment.batch.selection import SceneIndex
from augment.cameras import Camera, Frame
from augment.errors import OutputError

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
        cameras[name] = {
            "timestamp_ns": record.timestamp_ns,
            "width": record.width,
            "height": record.height,
            "fx": record.K[0, 0].item(),
            "fy": record.K[1, 1].item(),
            "cx": record.K[0, 2].item(),
            "cy": record.K[1, 2].item(),
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
    """The frame entries of a calibration file by frame number.

    Raises:
        OutputError: the file is missing or damaged.
    """
    try:
        frames = json.loads(Path(path).read_bytes())["frames"]
        return {entry["frame"]: entry for entry in frames}
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise OutputError(f"{path} is missing or not a calibration file: {error!r}") from error


def read_camera(entry: Mapping[str, Any], name: str) -> CameraRecord:
    """One camera of a frame entry.

    Raises:
        KeyError: the entry lacks the camera or one of its numbers.
        ValueError, TypeError, RuntimeError: a number is none.
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
