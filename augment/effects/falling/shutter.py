"""How a camera moves while its shutter is open, from where it was recorded before and after."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from augment.cameras import Camera
from augment.memo import memo_of
from augment.scene import Scene

_MAX_GAP_S = 2.0  # between recorded poses, beyond which they say nothing of a speed


class Path(NamedTuple):
    """Of one camera. times_ns: rising. world_from_camera [T, 4, 4]: float64."""

    times_ns: list[int]
    world_from_camera: np.ndarray


class Motion(NamedTuple):
    """Scene world. velocity_mps [3]. turn_radps [3]: axis times speed of the turn."""

    velocity_mps: Float64[np.ndarray, "3"]
    turn_radps: Float64[np.ndarray, "3"]

    def pose_after(self, camera: Camera, seconds: float) -> Float64[np.ndarray, "4 4"]:
        """camera_from_world so long after the camera's image."""
        pose = camera.world_from_camera.numpy().copy()
        turn = Rotation.from_rotvec(self.turn_radps * seconds).as_matrix()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += self.velocity_mps * seconds
        out = np.eye(4)
        out[:3, :3] = pose[:3, :3].T
        out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
        return out


STANDING = Motion(np.zeros(3), np.zeros(3))


def paths_of(scene: Scene) -> Mapping[str, Path]:
    """Where each camera was, by name; of an image without a time of its own nothing is known."""

    def find() -> dict[str, Path]:
        poses: dict[str, dict[int, torch.Tensor]] = {}
        for frame in scene.frames:
            for camera in frame.cameras.values():
                poses.setdefault(camera.name, {})[camera.timestamp_ns] = camera.world_from_camera
        return {
            name: Path(sorted(own), torch.stack([own[t] for t in sorted(own)]).numpy())
            for name, own in poses.items()
        }

    return memo_of(scene).get(("camera paths",), find)


def frame_interval_s(scene: Scene) -> float | None:
    """The shortest time between two images of a camera; None where no camera has two."""
    times = (path.times_ns for path in paths_of(scene).values() if len(path.times_ns) > 1)
    return min((float(np.diff(own).min()) * 1e-9 for own in times), default=None)


def motion_of(scene: Scene, camera: Camera) -> Motion:
    """The camera's motion at its time: between its poses before and after; STANDING without any."""
    path = paths_of(scene).get(camera.name)
    if path is None or len(path.times_ns) < 2:
        return STANDING
    times = path.times_ns
    after = bisect_left(times, camera.timestamp_ns)
    is_known = after < len(times) and times[after] == camera.timestamp_ns
    first = max(0, min(after - 1, len(times) - 2))
    last = min(after + 1 if is_known else max(after, 1), len(times) - 1)
    seconds = (times[last] - times[first]) * 1e-9
    if seconds > _MAX_GAP_S:
        return STANDING
    before = path.world_from_camera[first]
    then = path.world_from_camera[last]
    turn = Rotation.from_matrix(then[:3, :3] @ before[:3, :3].T).as_rotvec()
    return Motion((then[:3, 3] - before[:3, 3]) / seconds, turn / seconds)
