"""The ego car's path, its six cameras, and where moving actors are at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from adapters.street.layout import EGO_Y_M, FRAME_NS, START_NS, Layout, Mover, road_z
from adapters.street.parameters import StreetParameters
from augment.cameras import Camera, Frame
from augment.scene import Track

FIELD_OF_VIEW_DEG = 72.0
SWAY_M, SWAY_LENGTH_M = 0.10, 55.0
CAMERA_Z_M = 1.6
# name: (forward, left) of the ego origin in metres, yaw in degrees to the left. Each fires when the
# LiDAR's beam, which turns clockwise once a frame and looks ahead at the frame's time, passes it.
MOUNTS = {
    "front": (1.6, 0.0, 0.0),
    "front_left": (1.5, 0.45, 55.0),
    "front_right": (1.5, -0.45, -55.0),
    "left": (1.2, 0.55, 110.0),
    "right": (1.2, -0.55, -110.0),
    "back": (-1.2, 0.0, 180.0),
}


@dataclass(frozen=True, eq=False)
class EgoPose:
    """Where the ego car is at each of N times: positions [N, 3] of its ground point, yaws [N]."""

    positions: np.ndarray
    yaws: np.ndarray


def ego_pose(parameters: StreetParameters, timestamps_ns: np.ndarray) -> EgoPose:
    """The ego car on its lane, swaying gently about the lane's middle."""
    seconds = (np.asarray(timestamps_ns, np.int64) - START_NS) * 1e-9
    x = parameters.speed_mps * seconds
    phase = 2 * np.pi * x / SWAY_LENGTH_M
    y = EGO_Y_M + SWAY_M * np.sin(phase)
    yaw = np.arctan(SWAY_M * 2 * np.pi / SWAY_LENGTH_M * np.cos(phase))
    return EgoPose(np.stack([x, y, road_z(y)], -1), yaw)


def camera_path(parameters: StreetParameters, timestamps_ns: np.ndarray) -> np.ndarray:
    """Where the cameras are at times [N], taken together: above the ego car's middle, [N, 3]."""
    return ego_pose(parameters, timestamps_ns).positions + np.array([0.0, 0.0, CAMERA_Z_M])


def world_from_ego(parameters: StreetParameters, timestamp_ns: int) -> np.ndarray:
    """float64 [4, 4]: ego x forward, y left, z up, origin on the road."""
    pose = ego_pose(parameters, np.array([timestamp_ns]))
    return _rigid(pose.positions[0], float(pose.yaws[0]))


def frame_time_ns(index: int) -> int:
    return START_NS + index * FRAME_NS


def build_frames(parameters: StreetParameters) -> tuple[Frame, ...]:
    """All frames with their six cameras."""
    frames = []
    for index in range(parameters.frames):
        time = frame_time_ns(index)
        cameras = {name: _camera(parameters, name, time) for name in MOUNTS}
        pose = torch.from_numpy(world_from_ego(parameters, time))
        frames.append(Frame(index, time, pose, cameras))
    return tuple(frames)


def focal_px(parameters: StreetParameters) -> float:
    return parameters.width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)


def camera_offset_ns(name: str) -> int:
    """How long after the frame's time a camera fires."""
    return round(-MOUNTS[name][2] / 360 * FRAME_NS) % FRAME_NS - (
        FRAME_NS if MOUNTS[name][2] > 0 and name != "back" else 0
    )


def _camera(parameters: StreetParameters, name: str, frame_ns: int) -> Camera:
    forward, left, yaw_deg = MOUNTS[name]
    time = frame_ns + camera_offset_ns(name)
    mount = _rigid(np.array([forward, left, CAMERA_Z_M]), math.radians(yaw_deg))
    mount[:3, :3] = mount[:3, :3] @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
    world_from_camera = world_from_ego(parameters, time) @ mount
    rotation = world_from_camera[:3, :3].T
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = -rotation @ world_from_camera[:3, 3]
    return Camera(
        name=name,
        width=parameters.width,
        height=parameters.height,
        fx=focal_px(parameters),
        fy=focal_px(parameters),
        cx=parameters.width / 2,
        cy=parameters.height / 2,
        camera_from_world=torch.from_numpy(camera_from_world),
        timestamp_ns=time,
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """A mover's box centre over time; its heading never changes.

    times_ns: int64 [T], one frame beyond the drive on both sides, as far as the street goes.
    centres: float64 [T, 3].
    """

    times_ns: np.ndarray
    centres: np.ndarray
    yaw: float

    @property
    def track(self) -> Track:
        poses = np.stack([_rigid(centre, self.yaw) for centre in self.centres])
        return Track(torch.from_numpy(self.times_ns.copy()), torch.from_numpy(poses))

    def at(self, timestamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres [N, 3] at times [N], and whether the mover is there at all: as Track.pose_at."""
        start, hold = int(self.times_ns[0]), Track.hold_ns
        seconds = (timestamps_ns - start) * 1e-9
        samples = (self.times_ns - start) * 1e-9
        centres = np.stack([np.interp(seconds, samples, c) for c in self.centres.T], -1)
        last = int(self.times_ns[-1])
        return centres, (timestamps_ns >= start - hold) & (timestamps_ns <= last + hold)


def motion_of(mover: Mover, layout: Layout, height_m: float, ground_z: float) -> Motion:
    """Where a mover of this height goes while it is on the street."""
    frames = np.arange(-1, layout.parameters.frames + 1)
    x = mover.x_m + mover.speed_mps * frames * FRAME_NS * 1e-9
    on_street = (x > layout.x0 + 3) & (x < layout.x1 - 3)
    if not on_street.any():
        on_street[0] = True
    frames, x = frames[on_street], x[on_street]
    centres = np.stack(
        [x, np.full_like(x, mover.y_m), np.full_like(x, ground_z + height_m / 2)], -1
    )
    yaw = 0.0 if mover.speed_mps >= 0 else math.pi
    return Motion(START_NS + frames.astype(np.int64) * FRAME_NS, centres, yaw)


def _rigid(translation: np.ndarray, yaw_rad: float) -> np.ndarray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    if abs(s) < 1e-15:
        s = 0.0
    out = np.eye(4)
    out[:2, :2] = [[c, -s], [s, c]]
    out[:3, 3] = translation
    return out
