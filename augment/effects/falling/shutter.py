"""Motion of a camera while its shutter is open, from its recorded poses before and after."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from augment.memo import memo_of
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

_MAX_GAP_S = 2.0  # longest time between two recorded poses that give a speed


class Path(NamedTuple):
    """Recorded poses of one camera."""

    times_ns: list[int]  # rising
    world_from_camera: np.ndarray  # [T, 4, 4], float64


class Motion(NamedTuple):
    """Motion of a camera in the scene's world."""

    velocity_mps: Float64[np.ndarray, "3"]
    turn_radps: Float64[np.ndarray, "3"]  # rotation axis times angular speed

    def pose_after(self, camera: Camera, seconds: float) -> Float64[np.ndarray, "4 4"]:
        """Return camera_from_world this many seconds after the camera's image."""
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
    """Return the recorded poses of each camera, by name and by the images' own times."""

    def collect() -> dict[str, Path]:
        poses: dict[str, dict[int, torch.Tensor]] = {}
        for frame in scene.frames:
            for camera in frame.cameras.values():
                poses.setdefault(camera.name, {})[camera.timestamp_ns] = camera.world_from_camera
        return {
            name: Path(
                sorted(camera_poses),
                torch.stack([camera_poses[t] for t in sorted(camera_poses)]).numpy(),
            )
            for name, camera_poses in poses.items()
        }

    scene = scene.as_recorded
    return memo_of(scene).get(("camera paths",), collect)


def frame_interval_s(scene: Scene) -> float | None:
    """Return the shortest time between two images of a camera; None if no camera has two."""
    times = (path.times_ns for path in paths_of(scene).values() if len(path.times_ns) > 1)
    return min((float(np.diff(camera_times).min()) * 1e-9 for camera_times in times), default=None)


def motion_of(scene: Scene, camera: Camera) -> Motion:
    """Return the camera's motion at its time, from its poses before and after.

    STANDING if no such poses are recorded.
    """
    path = paths_of(scene).get(camera.name)
    if path is None or len(path.times_ns) < 2:
        return STANDING
    times = path.times_ns
    after = bisect_left(times, camera.timestamp_ns)
    is_recorded = after < len(times) and times[after] == camera.timestamp_ns
    first = max(0, min(after - 1, len(times) - 2))
    last = min(after + 1 if is_recorded else max(after, 1), len(times) - 1)
    seconds = (times[last] - times[first]) * 1e-9
    if seconds > _MAX_GAP_S:
        return STANDING
    before_pose = path.world_from_camera[first]
    after_pose = path.world_from_camera[last]
    turn = Rotation.from_matrix(after_pose[:3, :3] @ before_pose[:3, :3].T).as_rotvec()
    return Motion((after_pose[:3, 3] - before_pose[:3, 3]) / seconds, turn / seconds)
