"""Cameras, poses and times of a drive in Street Gaussians' layout, and which images there are.

intrinsics/<cam>.txt             fx fy cx cy and distortion, which is not used
extrinsics/<cam>.txt             ego_from_camera, OpenCV axes
ego_pose/<frame>.txt             world_from_ego at the frame's time
ego_pose/<frame>_<cam>.txt       the same at the camera's
timestamps.json                  seconds by FRAME or camera name, then by frame
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.plain_files import read_json, read_numbers, read_pose
from adapters.street_gaussians.records import CAMERA_NAMES
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat, rotmat_from_quat, slerp

TIMES = "timestamps.json"
_FRAME_POSE = re.compile(r"([0-9]{1,9})\.txt")
_MOST_GAPS = 1000  # numbers between the first frame and the last that nothing is known of


@dataclass(frozen=True, eq=False)
class Lens:
    """fx, fy, cx, cy: pixels. camera_from_ego: float64 [4, 4], OpenCV axes. path: of the
    intrinsics, for messages."""

    path: Path
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_ego: np.ndarray


@dataclass(frozen=True, eq=False)
class EgoPath:
    """The car at every frame of the drive, in the dataset's world.

    numbers: consecutive. times_s: float64 [N]. world_from_ego: float64 [N, 4, 4]. is_known: bool
    [N], False where the pose is missing and was put between its neighbours. camera_times_s: by
    camera name, then frame number. problems: one sentence each.
    """

    numbers: range
    times_s: np.ndarray
    world_from_ego: np.ndarray
    is_known: np.ndarray
    camera_times_s: Mapping[str, Mapping[int, float]]
    problems: tuple[str, ...]

    @property
    def centre_m(self) -> np.ndarray:
        """The mean position, float64 [3]: the origin of the models' worlds."""
        return self.world_from_ego[:, :3, 3].mean(axis=0)


def calibrated_cameras(root: Path) -> tuple[int, ...]:
    """The numbers of the cameras that have extrinsics."""
    return tuple(c for c in range(len(CAMERA_NAMES)) if (root / f"extrinsics/{c}.txt").exists())


def read_lens(root: Path, cam: int) -> Lens:
    """A camera's calibration.

    Raises:
        AdapterError: a file is missing, or holds no focal lengths or no pose.
    """
    path = root / "intrinsics" / f"{cam}.txt"
    values = read_numbers(path)
    if values.size < 4 or min(values[:2]) <= 0:
        raise AdapterError(
            f"{path} must begin with fx fy cx cy in pixels, fx and fy > 0; got {values.tolist()}"
        )
    fx, fy, cx, cy = values[:4].tolist()
    ego_from_camera = read_pose(root / "extrinsics" / f"{cam}.txt")
    return Lens(path, fx, fy, cx, cy, inverse(ego_from_camera))


def inverse(pose: np.ndarray) -> np.ndarray:
    """Of a rigid transform, float64 [4, 4]."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def read_ego_path(root: Path) -> EgoPath:
    """Every frame's pose and time.

    Raises:
        AdapterError: the folder is missing, holds no pose or a damaged one; times are missing, not
            numbers, or do not increase.
    """
    folder = root / "ego_pose"
    if not folder.is_dir():
        raise AdapterError(
            f"{folder} does not exist; expected a drive in Street Gaussians' layout, with "
            f"ego_pose/, extrinsics/, intrinsics/, track/ and {TIMES}"
        )
    found = {int(m[1]): p for p in folder.iterdir() if (m := _FRAME_POSE.fullmatch(p.name))}
    if not found:
        raise AdapterError(f"{folder} holds no pose NNNNNN.txt; copy the folder from the dataset")
    times = read_times(root / TIMES)
    timed = times["FRAME"]
    untimed = sorted(set(found) - set(timed))
    if untimed:
        raise AdapterError(
            f"{root / TIMES}: FRAME lacks frame {untimed[0]:06d}, of which there is {folder}/"
            f"{untimed[0]:06d}.txt; both must be of one conversion"
        )
    numbers = range(min(timed), max(timed) + 1)
    if len(numbers) - len(timed) > _MOST_GAPS:
        raise AdapterError(
            f"{root / TIMES}: FRAME must hold consecutive frames; it holds {len(timed)} from "
            f"{numbers[0]} to {numbers[-1]}"
        )
    known = np.array([number in found for number in numbers])
    timed_numbers = np.array(sorted(timed))
    times_s = np.interp(numbers, timed_numbers, [timed[n] for n in timed_numbers.tolist()])
    if not (np.diff(times_s) > 0).all():
        raise AdapterError(f"{root / TIMES}: the seconds of FRAME must increase with the frames")
    poses = _fill(times_s, known, np.stack([read_pose(found[n]) for n in sorted(found)]))
    return EgoPath(numbers, times_s, poses, known, times, tuple(_said(folder, numbers, known)))


def _said(folder: Path, numbers: range, known: np.ndarray) -> list[str]:
    missing = [number for number, is_known in zip(numbers, known, strict=True) if not is_known]
    if not missing:
        return []
    return [
        f"{folder} lacks the poses of {len(missing)} of {len(numbers)} frames, such as "
        f"{missing[0]:06d}: these frames are left out, and the middle of the drive, on which the "
        f"world of trained models is centred, is had with guesses from the frames beside them"
    ]


def read_times(path: Path) -> dict[str, dict[int, float]]:
    """Seconds by FRAME or camera name, then frame number.

    Raises:
        AdapterError: missing, without FRAME, or something else in it.
    """
    content = read_json(path)
    times: dict[str, dict[int, float]] = {}
    for name, entries in content.items():
        if name != "FRAME" and name not in CAMERA_NAMES:
            continue
        if not isinstance(entries, dict):
            raise AdapterError(f"{path}: {name} must hold seconds by frame; got {entries!r:.80}")
        times[name] = {}
        for key, value in entries.items():
            is_time = isinstance(value, int | float) and not isinstance(value, bool)
            if not (is_time and 0 <= value < 9e9 and re.fullmatch(r"[0-9]{1,9}", key)):
                raise AdapterError(
                    f"{path}: {name} must hold seconds by frame, such as "
                    f'"000000": 1550083467.3; got {key!r}: {value!r:.80}'
                )
            times[name][int(key)] = float(value)
    if not times.get("FRAME"):
        raise AdapterError(f"{path} must hold FRAME, seconds by frame; it holds {list(content)}")
    return times


def _fill(times_s: np.ndarray, known: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The poses of all times, float64 [N, 4, 4], from those of the known ones: on the straight line
    through the two nearest in time, turned as far as between them and no further."""
    filled = np.empty((len(times_s), 4, 4))
    filled[known] = poses
    known_s = times_s[known]
    for i in np.flatnonzero(~known):
        if len(poses) == 1:
            filled[i] = poses[0]
            continue
        after = int(np.clip(np.searchsorted(known_s, times_s[i]), 1, len(poses) - 1))
        a, b = poses[after - 1], poses[after]
        part = (times_s[i] - known_s[after - 1]) / (known_s[after] - known_s[after - 1])
        filled[i] = a + part * (b - a)
        filled[i, :3, :3] = _turned(a[:3, :3], b[:3, :3], min(max(part, 0.0), 1.0))
    return filled


def _turned(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    quats = quat_from_rotmat(torch.from_numpy(np.stack([a, b])))
    turned = slerp(quats[0], quats[1], torch.tensor(part, dtype=torch.float64))
    return rotmat_from_quat(turned).numpy()


@dataclass(frozen=True, eq=False)
class CameraMoment:
    """When a camera took its image of a frame, and where the car was, dataset world."""

    timestamp_s: float
    world_from_ego: np.ndarray


def read_camera_moments(
    root: Path, path: EgoPath, frames: Sequence[int], cams: Sequence[int]
) -> tuple[dict[tuple[int, int], CameraMoment], tuple[str, ...]]:
    """The moments by frame and camera, and a sentence where poses are missing.

    Raises:
        AdapterError: a pose is damaged, has no time, or is missing everywhere.
    """
    moments: dict[tuple[int, int], CameraMoment] = {}
    missing: list[Path] = []
    for frame in frames:
        if not path.is_known[path.numbers.index(frame)]:
            continue
        for cam in cams:
            file = root / "ego_pose" / f"{frame:06d}_{cam}.txt"
            if not file.exists():
                missing.append(file)
                continue
            seconds = path.camera_times_s.get(CAMERA_NAMES[cam], {}).get(frame, math.nan)
            if math.isnan(seconds):
                raise AdapterError(
                    f"{root / TIMES}: {CAMERA_NAMES[cam]} lacks frame {frame:06d}, of which there "
                    f"is {file}; both must be of one conversion"
                )
            moments[frame, cam] = CameraMoment(seconds, read_pose(file))
    if not moments:
        raise AdapterError(
            f"{root / 'ego_pose'} lacks poses NNNNNN_{cams[0]}.txt at the cameras' times for all "
            f"frames from {frames[0]} to {frames[-1]}; copy the whole folder from the dataset"
        )
    if not missing:
        return moments, ()
    said = (
        f"{len(missing)} images are left out for want of the car's pose at their time, such as "
        f"{missing[0]}"
    )
    return moments, (said,)
