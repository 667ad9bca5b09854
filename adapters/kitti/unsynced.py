"""Drives of KITTI's release before synchronisation and rectification (`..._drive_NNNN_extract`).

In it each sensor counts its own files: sweep 7 and image 7 are of different moments, and GPS/IMU
has a hundred files a second. The files belong together by their times. A frame here is a sweep; it
takes the image of each camera that is nearest in time. Sweeps are text.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from adapters.kitti.files import Poses, read_times
from adapters.raw_drive import describe_frames
from augment.errors import AdapterError

# Largest difference between the times of a sweep and its image: half a turn of the Velodyne.
_MAX_OFFSET_NS = 50_000_000
# Largest time between a moment and the nearest pose.
_MAX_POSE_GAP_NS = 200_000_000


@dataclass(frozen=True, eq=False)
class PosePath:
    """Poses of the Velodyne over time.

    Attributes:
        times_ns: int64 [N], ascending.
        world_from_velodyne: float64 [N, 4, 4].
    """

    times_ns: np.ndarray
    world_from_velodyne: np.ndarray

    def at(self, time_ns: int) -> np.ndarray | None:
        """Return the pose at a time: linear in place, spherical in rotation.

        The result is None where no pose is near.
        """
        place = int(np.clip(np.searchsorted(self.times_ns, time_ns), 1, len(self.times_ns) - 1))
        if len(self.times_ns) < 2 or np.abs(self.times_ns - time_ns).min() > _MAX_POSE_GAP_NS:
            return None
        start_ns = int(self.times_ns[place - 1])
        end_ns = int(self.times_ns[place])
        share = float(np.clip((time_ns - start_ns) / (end_ns - start_ns), 0.0, 1.0))
        poses = self.world_from_velodyne[place - 1 : place + 1]
        pose = np.eye(4)
        pose[:3, :3] = Slerp([0, 1], Rotation.from_matrix(poses[:, :3, :3]))(share).as_matrix()
        pose[:3, 3] = (1 - share) * poses[0, :3, 3] + share * poses[1, :3, 3]
        return pose


def pose_path(poses: Mapping[int, np.ndarray], times_ns: Mapping[int, int]) -> PosePath:
    """Return poses by number as a path over time. Numbers without a time are left out."""
    numbers = sorted((n for n in poses if n in times_ns), key=lambda n: times_ns[n])
    times = np.array([times_ns[n] for n in numbers], np.int64)
    is_later = np.diff(times, prepend=np.int64(-(2**62))) > 0
    stacked = np.stack([poses[n] for n in numbers]) if numbers else np.zeros((0, 4, 4))
    return PosePath(times[is_later], stacked[is_later])


def unsynced_times(root: Path, folder: str) -> dict[int, int]:
    """Return the times of a sensor's files by number, nanoseconds.

    Raises:
        AdapterError: there are none; nothing else says which files belong together.
    """
    times = read_times(root, folder)
    if not times:
        raise AdapterError(
            f"{root / folder / 'timestamps.txt'} does not exist or is empty; in a drive before "
            f"synchronisation (sweeps in .txt) only times tell which files belong together"
        )
    return times


def match_images(
    root: Path,
    images: Mapping[str, Mapping[int, str]],
    image_times_ns: Mapping[str, Mapping[int, int]],
    sweep_times_ns: Mapping[int, int],
) -> tuple[dict[str, dict[int, str]], dict[str, dict[int, int]], tuple[str, ...]]:
    """Return the images' files and times by camera and sweep, and sentences on missing images.

    Each image is of one sweep at most.

    Args:
        root: the drive's folder.
        images: files by camera and the camera's own number.
        image_times_ns: times, in the same way.
        sweep_times_ns: times of the sweeps by number.
    """
    files_by_camera: dict[str, dict[int, str]] = {}
    times_by_camera: dict[str, dict[int, int]] = {}
    problems = []
    for name, files in images.items():
        numbers = np.array([n for n in sorted(files) if n in image_times_ns[name]], np.int64)
        times = np.array([image_times_ns[name][int(n)] for n in numbers], np.int64)
        nearest: dict[int, tuple[int, int]] = {}
        for sweep, sweep_ns in sweep_times_ns.items():
            if not len(times):
                break
            place = int(np.abs(times - sweep_ns).argmin())
            offset_ns = abs(int(times[place]) - sweep_ns)
            number = int(numbers[place])
            if offset_ns <= nearest.get(number, (_MAX_OFFSET_NS, -1))[0]:
                nearest[number] = offset_ns, sweep
        number_of_sweep = {sweep: number for number, (_, sweep) in nearest.items()}
        files_by_camera[name] = {s: files[n] for s, n in sorted(number_of_sweep.items())}
        times_by_camera[name] = {
            s: image_times_ns[name][n] for s, n in sorted(number_of_sweep.items())
        }
        if missing := [sweep for sweep in sweep_times_ns if sweep not in number_of_sweep]:
            problems.append(
                f"camera {name}: no image of {root.name} lies within "
                f"{_MAX_OFFSET_NS // 1_000_000} ms of {describe_frames(missing)}"
            )
    return files_by_camera, times_by_camera, tuple(problems)


def poses_at_sweeps(path: PosePath, sweep_times_ns: Mapping[int, int], poses: Poses) -> Poses:
    """Return the poses at the times of sweeps, with the sentences of the poses they come from."""
    at_sweeps = {n: pose for n, t in sweep_times_ns.items() if (pose := path.at(t)) is not None}
    return Poses(at_sweeps, poses.problems)


def is_unsynced(sweeps: Mapping[int, str]) -> bool:
    """Return True if the sweeps of a drive are text: it is one before synchronisation."""
    return any(name.lower().endswith(".txt") for name in sweeps.values())
