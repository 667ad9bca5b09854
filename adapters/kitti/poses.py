"""Where the Velodyne was in each frame of a raw drive: from GPS/IMU files or a file of poses.

The ego frame is the Velodyne's: x forward, y left, z up, its origin 1.73 m above the road.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.kitti.layout import file_in, some
from adapters.plain_files import checked_pose, read_numbers, read_text
from augment.errors import AdapterError

EARTH_RADIUS_M = 6378137.0
_OXTS_NUMBERS = 30
_MOST_LATITUDE_DEG = 85.0  # Mercator's scale goes to infinity at the poles
# Rows: a z-up world's x (camera's forward), y (its left), z (its up) in a camera's axes.
_UP_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Poses:
    """world_from_velodyne: float64 [4, 4] by frame number, in the dataset's world, z up. problems:
    one sentence each."""

    world_from_velodyne: Mapping[int, np.ndarray]
    problems: tuple[str, ...] = ()


def oxts_poses(root: Path, names: Mapping[int, str], velodyne_from_imu: np.ndarray) -> Poses:
    """Poses from the GPS/IMU files `names`, in KITTI's Mercator world: x east, y north, z the
    altitude, metres, scaled by the cosine of the first file's latitude.

    Raises:
        AdapterError: no file is usable.
    """
    packets, problems = {}, []
    for number, name in sorted(names.items()):
        try:
            packets[number] = _read_packet(file_in(root, name))
        except AdapterError as error:
            problems.append(f"frame {number} has no pose: {error}")
    if not packets:
        raise AdapterError(f"{root / 'oxts'}: no file can be used: {'; '.join(problems[:3])}")
    scale = float(np.cos(np.radians(next(iter(packets.values()))[0])))
    imu_from_velodyne = np.linalg.inv(velodyne_from_imu)
    poses = {n: _mercator_pose(p, scale) @ imu_from_velodyne for n, p in packets.items()}
    return Poses(poses, tuple(problems))


def odometry_poses(
    path: Path, numbers: Sequence[int], rectified_from_velodyne: np.ndarray
) -> Poses:
    """Poses from a file as of KITTI's odometry benchmark: a line of 12 numbers a frame, the rows of
    world_from_camera for the rectified left grey camera 0, whose world is turned to z up here.

    Lines are the frames in their order if there are as many, else line n (from 0) is frame n.
    numbers: the drive's frames.

    Raises:
        AdapterError: no such file, a line is no pose, or no line is of any frame.
    """
    if not path.is_file():
        raise AdapterError(
            f"kitti: poses must be icp or a file of poses; got {str(path)!r}, and there is no file "
            f"{path.absolute()}"
        )
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    in_order = len(lines) == len(numbers)
    poses = {}
    for row, line in enumerate(lines):
        number = numbers[row] if in_order else row
        where = f"{path}, line {row + 1}"
        try:
            values = np.array([float(word) for word in line.split()], np.float64)
        except ValueError as error:
            raise AdapterError(f"{where}: expected 12 numbers ({error})") from None
        if values.size != 12:
            raise AdapterError(f"{where}: expected 12 numbers, a pose; got {values.size}")
        world_from_rectified = checked_pose(values.reshape(3, 4), where)
        poses[number] = _UP_FROM_CAMERA @ world_from_rectified @ rectified_from_velodyne
    if not set(poses) & set(numbers):
        raise AdapterError(
            f"{path} has {len(lines)} poses, none of them of frames {numbers[0]} to {numbers[-1]}"
        )
    return Poses(poses)


def without_poses(numbers: Sequence[int], poses: Mapping[int, np.ndarray]) -> tuple[str, ...]:
    """A sentence for the frames that have no pose."""
    missing = [number for number in numbers if number not in poses]
    return (f"left out {some(missing)}: no pose is known",) if missing else ()


def _read_packet(path: Path) -> np.ndarray:
    """The numbers of a GPS/IMU file: latitude and longitude (degrees), altitude (metres), roll,
    pitch and yaw (radians), and 24 that are not used."""
    values = read_numbers(path, (_OXTS_NUMBERS,))
    latitude, longitude, altitude = values[:3]
    if abs(latitude) > _MOST_LATITUDE_DEG or abs(longitude) > 180 or abs(altitude) > 1e4:
        raise AdapterError(
            f"{path} must begin with latitude, longitude (degrees) and altitude (metres); got "
            f"{latitude:g} {longitude:g} {altitude:g}"
        )
    return values


def _mercator_pose(packet: np.ndarray, scale: float) -> np.ndarray:
    """world_from_imu, float64 [4, 4]."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    pose = np.eye(4)
    pose[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    pose[0, 3] = scale * EARTH_RADIUS_M * np.radians(longitude)
    pose[1, 3] = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi * (90 + latitude) / 360))
    pose[2, 3] = altitude
    return pose


def _about(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z (0, 1, 2), float64 [3, 3]."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix
