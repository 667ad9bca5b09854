"""Camera paths as text: the frames of a novel trajectory, exact to the last bit.

The text carries a path to worker processes, and its hash is the path's identity in the manifest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import torch

from augment.cameras import Camera, Frame

RECORDED = "recorded"  # the identity of a scene's own frames


def frames_to_json(frames: Sequence[Frame]) -> str:
    """Frames and their cameras; numbers keep all their digits. Image paths are left out."""
    listed = [
        {
            "index": frame.index,
            "timestamp_ns": frame.timestamp_ns,
            "world_from_ego": frame.world_from_ego.tolist(),
            "cameras": [_camera_record(camera) for camera in frame.cameras.values()],
        }
        for frame in frames
    ]
    return json.dumps({"frames": listed}, indent=1)


def frames_from_json(text: str) -> tuple[Frame, ...]:
    """The frames that `frames_to_json` wrote. Poses are camera_from_world in the scene's world.

    Raises:
        ValueError: the text is not such a path; says what is missing.
    """
    try:
        return tuple(
            Frame(
                index=int(entry["index"]),
                timestamp_ns=int(entry["timestamp_ns"]),
                world_from_ego=torch.tensor(entry["world_from_ego"], dtype=torch.float64),
                cameras={c["name"]: _camera(c) for c in entry["cameras"]},
            )
            for entry in json.loads(text)["frames"]
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a camera path: {error!r} is missing or of another type") from error


def trajectory_id(camera_path: Sequence[Frame] | None) -> str:
    """`recorded`, or `path-` and 16 hex digits of the path's SHA-256."""
    if camera_path is None:
        return RECORDED
    return "path-" + hashlib.sha256(frames_to_json(camera_path).encode()).hexdigest()[:16]


def _camera_record(camera: Camera) -> dict[str, Any]:
    numbers = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    return {
        "name": camera.name,
        "timestamp_ns": camera.timestamp_ns,
        **numbers,
        "camera_from_world": camera.camera_from_world.tolist(),
    }


def _camera(record: dict[str, Any]) -> Camera:
    return Camera(
        name=record["name"],
        width=record["width"],
        height=record["height"],
        fx=record["fx"],
        fy=record["fy"],
        cx=record["cx"],
        cy=record["cy"],
        camera_from_world=torch.tensor(record["camera_from_world"], dtype=torch.float64),
        timestamp_ns=record["timestamp_ns"],
    )
