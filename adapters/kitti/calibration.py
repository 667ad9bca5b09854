"""KITTI's calibration files: rectified pinholes, and where they are to the Velodyne.

A point of the Velodyne is at `P_rect_0X @ R_rect_00 @ [R T]` in the image of camera X. P's first
three columns are its intrinsics K; K^-1 times the fourth is what to add to a point of the rectified
camera 0 to have it in camera X. Intrinsics are taken as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.kitti.layout import CAM_TO_CAM, IMU_TO_VELO, VELO_TO_CAM, file_in
from adapters.plain_files import checked_pose, read_text
from augment.errors import AdapterError


@dataclass(frozen=True, eq=False)
class RectifiedCamera:
    """A rectified camera. camera_from_velodyne: float64 [4, 4]. size: width and height in pixels
    where the calibration says so.
    """

    name: str
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_velodyne: np.ndarray
    size: tuple[int, int] | None


@dataclass(frozen=True, eq=False)
class Calibration:
    """rectified_from_velodyne: float64 [4, 4], into camera 0 after rectification."""

    cameras: tuple[RectifiedCamera, ...]
    rectified_from_velodyne: np.ndarray


@dataclass(frozen=True)
class KeyedLines:
    """A file of lines `key: words`."""

    path: Path
    lines: dict[str, str]

    @staticmethod
    def read(folder: Path, name: str) -> KeyedLines:
        """The file; keys that nobody asks for may hold anything.

        Raises:
            AdapterError: missing, no text, a line without a key, or a key that is there twice.
        """
        path = file_in(folder, name)
        lines: dict[str, str] = {}
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            key, colon, words = line.partition(":")
            if not line.strip():
                continue
            if not colon:
                raise AdapterError(
                    f"{path}, line {number}: expected `key: numbers`; got {line[:60]!r}"
                )
            if key.strip() in lines:
                raise AdapterError(
                    f"{path}, line {number}: {key.strip()!r} is there twice; delete the wrong one"
                )
            lines[key.strip()] = words
        return KeyedLines(path, lines)

    def numbers(self, key: str, *shape: int) -> np.ndarray:
        """A key's numbers, float64 in that shape.

        Raises:
            AdapterError: no such key, another count, or anything but finite numbers.
        """
        if key not in self.lines:
            raise AdapterError(
                f"{self.path} has no {key!r}; it has {', '.join(self.lines) or 'nothing'}. Copy it "
                f"from the dataset again"
            )
        words = self.lines[key].split()
        try:
            values = np.array([float(word) for word in words], np.float64)
        except ValueError as error:
            raise AdapterError(f"{self.path}: {key} must hold numbers ({error})") from None
        if values.size != int(np.prod(shape)):
            expected = " x ".join(map(str, shape))
            raise AdapterError(
                f"{self.path}: {key} must hold {expected} numbers; it holds {values.size}"
            )
        if not np.isfinite(values).all():
            raise AdapterError(f"{self.path}: {key} must be finite; got {self.lines[key].strip()}")
        return values.reshape(shape)

    def pose(self, rotation: str, translation: str) -> np.ndarray:
        """A rigid transform from two keys, float64 [4, 4]."""
        matrix = np.column_stack([self.numbers(rotation, 3, 3), self.numbers(translation, 3)])
        return checked_pose(matrix, f"{self.path}: {rotation} and {translation}")

    def rotation(self, key: str) -> np.ndarray:
        """A rotation as a rigid transform, float64 [4, 4]."""
        matrix = np.column_stack([self.numbers(key, 3, 3), np.zeros(3)])
        return checked_pose(matrix, f"{self.path}: {key}")


def read_raw_calibration(folder: Path, names: Sequence[str]) -> Calibration:
    """The calibration of a day's drives. names: of the cameras, such as image_02.

    Raises:
        AdapterError: a file or key is missing, or holds something else.
    """
    cameras = KeyedLines.read(folder, CAM_TO_CAM)
    velodyne = KeyedLines.read(folder, VELO_TO_CAM).pose("R", "T")
    rectified = cameras.rotation("R_rect_00") @ velodyne
    made = []
    for name in names:
        number = name.removeprefix("image_")
        size = None
        if f"S_rect_{number}" in cameras.lines:
            size = _size(cameras, f"S_rect_{number}")
        made.append(_camera(name, cameras, f"P_rect_{number}", rectified, size))
    return Calibration(tuple(made), rectified)


def read_object_calibration(folder: Path, frame: str, names: Sequence[str]) -> Calibration:
    """The calibration of one frame of the object benchmark. frame: its digits. names: of the
    cameras, such as image_2.

    Raises:
        AdapterError: the file or a key is missing, or holds something else.
    """
    keyed = KeyedLines.read(folder, f"{frame}.txt")
    velodyne = checked_pose(keyed.numbers("Tr_velo_to_cam", 3, 4), f"{keyed.path}: Tr_velo_to_cam")
    rectified = keyed.rotation("R0_rect") @ velodyne
    made = [
        _camera(name, keyed, f"P{name.removeprefix('image_')}", rectified, None) for name in names
    ]
    return Calibration(tuple(made), rectified)


def read_velodyne_from_imu(folder: Path) -> np.ndarray:
    """Where the Velodyne is to the GPS/IMU unit that drives are located by, float64 [4, 4].

    Raises:
        AdapterError: calib_imu_to_velo.txt is missing or holds something else.
    """
    return KeyedLines.read(folder, IMU_TO_VELO).pose("R", "T")


def _camera(
    name: str,
    keyed: KeyedLines,
    key: str,
    rectified_from_velodyne: np.ndarray,
    size: tuple[int, int] | None,
) -> RectifiedCamera:
    projection = keyed.numbers(key, 3, 4)
    k = projection[:, :3]
    pinhole = np.array([[k[0, 0], 0, k[0, 2]], [0, k[1, 1], k[1, 2]], [0, 0, 1]])
    if not (np.allclose(k, pinhole, atol=1e-6) and k[0, 0] > 0 and k[1, 1] > 0):
        raise AdapterError(
            f"{keyed.path}: {key} must be a rectified pinhole: fx 0 cx . 0 fy cy . 0 0 1 . with "
            f"fx, fy > 0; got {projection.tolist()}"
        )
    camera_from_rectified = np.eye(4)
    camera_from_rectified[:3, 3] = np.linalg.solve(pinhole, projection[:, 3])
    return RectifiedCamera(
        name,
        float(k[0, 0]),
        float(k[1, 1]),
        float(k[0, 2]),
        float(k[1, 2]),
        camera_from_rectified @ rectified_from_velodyne,
        size,
    )


def _size(keyed: KeyedLines, key: str) -> tuple[int, int]:
    width, height = keyed.numbers(key, 2)
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and width % 1 == 0 and height % 1 == 0):
        raise AdapterError(
            f"{keyed.path}: {key} must be a width and a height in pixels; got {width:g} {height:g}"
        )
    return int(width), int(height)
