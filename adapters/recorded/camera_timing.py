"""Cameras at other times than stamped: where they were then, and which time fits the LiDAR best.

Rolling shutters, exposure and transport leave time stamps some tens of milliseconds beside the
moment an image shows. A car at 15 m/s moves 30 cm in 20 ms.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from adapters.recorded.calibration import Points, Returns, project_returns, shared_information
from adapters.recorded.views import RecordedViews
from augment.cameras import Camera
from augment.geometry import (
    invert_rigid,
    multiply_quats,
    quat_from_rotmat,
    rigid,
    rotmat_from_quat,
    slerp,
)
from augment.reconstruct.view import ViewKey
from augment.scene import Scene

_STEPS_S = np.arange(-5, 6) * 0.010
_NEAR_M = 3.0  # near returns shift most with time
_LEAST_SPEED_MPS = 1.0
_EVERY = 3  # return is enough
_CONTRAST = 0.02  # how much the best time must stand out from the range's mean


def with_camera_times(scene: Scene, offset_s: float) -> Scene:
    """The scene with every image taken offset_s later than stamped: poses and times of cameras.

    Positions and rotations follow the camera's own path, straight on at its ends.
    """
    paths = {name: _path(scene, name) for name in scene.camera_names}
    frames = tuple(
        dataclasses.replace(
            frame,
            cameras={
                name: camera_at(paths[name], camera, offset_s)
                for name, camera in frame.cameras.items()
            },
        )
        for frame in scene.frames
    )
    return dataclasses.replace(scene, frames=frames)


def _path(scene: Scene, name: str) -> list[Camera]:
    return [frame.cameras[name] for frame in scene.frames if name in frame.cameras]


def camera_at(path: Sequence[Camera], camera: Camera, offset_s: float) -> Camera:
    """The camera offset_s later, moving as its neighbours in the path say.

    path: the same camera over time, in order, this one among them.
    """
    times = [other.timestamp_ns for other in path]
    place = times.index(camera.timestamp_ns)
    before, after = path[max(place - 1, 0)], path[min(place + 1, len(path) - 1)]
    span_s = (after.timestamp_ns - before.timestamp_ns) * 1e-9
    if span_s <= 0 or offset_s == 0:
        return camera
    part = torch.tensor(offset_s / span_s, dtype=torch.float64)
    turn = after.world_from_camera[:3, :3] @ before.world_from_camera[:3, :3].T
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    turned = slerp(still, quat_from_rotmat(turn), part)
    now = quat_from_rotmat(camera.world_from_camera[:3, :3])
    pose = rigid(
        rotmat_from_quat(multiply_quats(turned, now)),
        camera.centre + (after.centre - before.centre) * part,
    )
    return dataclasses.replace(
        camera,
        camera_from_world=invert_rigid(pose),
        timestamp_ns=camera.timestamp_ns + round(offset_s * 1e9),
    )


def measure_time_offset(
    scene: Scene,
    returns: Mapping[int, Returns],
    views: RecordedViews,
    keys: Mapping[str, Sequence[ViewKey]],
) -> float | None:
    """Seconds after their stamps at which images fit the LiDAR best, one number for all cameras.

    returns: by frame. keys: views by camera, in order of time. Cameras count by how clearly they
    show a time: those that look sideways do. None where the car hardly moves, sweeps have no
    intensity, or no time within 50 ms stands out.
    """
    returns = {
        frame: Returns(found.points[::_EVERY], found.intensity[::_EVERY])
        for frame, found in returns.items()
    }
    total = np.zeros(len(_STEPS_S))
    cameras = 0
    for name, own in keys.items():
        path = _path(scene, name)
        own = [key for key in own if key.frame in returns]
        moving = [key for key in own if _speed_mps(path, scene, key) > _LEAST_SPEED_MPS]
        scores = [_fit(scene, returns, views, path, moving, float(offset)) for offset in _STEPS_S]
        known = np.array([score for score in scores if score is not None])
        if len(known) == len(_STEPS_S) and known.mean() > 0:
            total += known / known.mean()
            cameras += 1
    i = int(total.argmax())
    if cameras == 0 or not 0 < i < len(total) - 1 or total[i] < (1 + _CONTRAST) * total.mean():
        return None
    bend = total[i - 1] - 2 * total[i] + total[i + 1]
    step = 0.0 if bend == 0 else 0.5 * (total[i - 1] - total[i + 1]) / bend
    return float(_STEPS_S[i] + step * (_STEPS_S[1] - _STEPS_S[0]))


def _fit(
    scene: Scene,
    returns: Mapping[int, Returns],
    views: RecordedViews,
    path: Sequence[Camera],
    keys: Sequence[ViewKey],
    offset_s: float,
) -> float | None:
    """How much images and returns tell of each other if images were taken later by offset_s."""
    seen: list[Points] = []
    for key in keys:
        camera = camera_at(path, scene.frame(key.frame).cameras[key.camera], offset_s)
        seen.append(
            project_returns(returns[key.frame], views, key, camera, reach=0, near_m=_NEAR_M)
        )
    return float(shared_information(seen, 0)[0, 0]) if seen else None


def _speed_mps(path: Sequence[Camera], scene: Scene, key: ViewKey) -> float:
    camera = scene.frame(key.frame).cameras[key.camera]
    later = camera_at(path, camera, 0.01)
    return float((later.centre - camera.centre).norm()) / 0.01
