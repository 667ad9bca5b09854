"""The files of one PandaSet sequence, read and checked; nothing here builds a scene.

    camera/<name>/NN.jpg            undistorted images; intrinsics.json, poses.json, timestamps.json
    lidar/NN.pkl.gz                 returns of both sensors; poses.json, timestamps.json
    annotations/cuboids/NN.pkl.gz   boxes
    annotations/semseg/NN.pkl.gz    class of each return; classes.json

The world is the sequence's own: metres, z up. Camera poses are world_from_camera with OpenCV axes.
A LiDAR pose is the car's: x right, y forward, z up, so world_from_ego is that pose turned by a
quarter about z. Times are seconds, stored here as integer nanoseconds. Errors are AdapterErrors
that name the file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch

from adapters.plain_files import ImageFault, decode_image, is_whole_jpeg, number_of, read_json
from adapters.raw_drive import drive_origin
from adapters.safe_pickle import read_frame
from augment.errors import AdapterError
from augment.geometry import rigid, rotmat_from_quat

_LATEST_S = 9e9  # int64 nanoseconds reach 9.2e9 s
LIDAR_COLUMNS = ("x", "y", "z", "i", "t", "d")
# Columns: ego x (forward), y (left), z in the axes of the LiDAR pose (x right, y forward).
LIDAR_POSE_FROM_EGO = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """One camera over the sequence. size: width and height, pixels. lens: fx, fy, cx, cy, pixels.

    world_from_camera: float64 [F, 4, 4]; timestamps_ns: int64 [F]; images: one path a frame, None
    where the image is missing or damaged."""

    name: str
    size: tuple[int, int]
    lens: tuple[float, float, float, float]
    world_from_camera: np.ndarray
    timestamps_ns: np.ndarray
    images: tuple[Path | None, ...]


@dataclass(frozen=True, eq=False)
class Sequence:
    """Calibration and timing of a sequence of F frames, numbered from 0 as the files are.

    world_origin_m: float64 [3], what was subtracted from the files' coordinates to give the scene's
    world, in which all poses here are. world_from_ego: float64 [F, 4, 4], ego x forward, y left,
    z up. timestamps_ns: int64 [F], the ends of the sweeps. problems: what was missing and gone on
    without, one sentence each."""

    root: Path
    world_origin_m: np.ndarray
    world_from_ego: np.ndarray
    timestamps_ns: np.ndarray
    cameras: tuple[CameraTrack, ...]
    problems: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.timestamps_ns)


def read_sequence(root: Path) -> Sequence:
    """The calibration, poses and times of the sequence in a folder."""
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a PandaSet sequence such as .../002")
    poses, times = _read_lidar_track(root)
    if not (root / "camera").is_dir():
        raise AdapterError(
            f"{root / 'camera'} does not exist; expected a PandaSet sequence's camera/"
        )
    folders = sorted(p for p in (root / "camera").iterdir() if p.is_dir())
    if not folders:
        raise AdapterError(f"{root / 'camera'} holds no camera folder; unpack the sequence again")
    problems: list[str] = []
    cameras = [_read_camera(folder, len(poses), problems) for folder in folders]
    origin = drive_origin(poses[:, :3, 3])
    poses[:, :3, 3] -= origin
    for camera in cameras:
        camera.world_from_camera[:, :3, 3] -= origin
    ego = poses @ LIDAR_POSE_FROM_EGO
    return Sequence(root, origin, ego, times, tuple(cameras), tuple(problems))


def read_ego_track(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """world_from_ego [F, 4, 4] in the dataset's own world, and the times [F] of the sweeps' ends.

    Remembered as long as the files stay as they are."""
    files = [root / "lidar" / name for name in ("poses.json", "timestamps.json")]
    state = tuple((f.stat().st_mtime_ns, f.stat().st_size) if f.exists() else None for f in files)
    return _ego_track(root, state)


@lru_cache(maxsize=2)
def _ego_track(root: Path, state: object) -> tuple[np.ndarray, np.ndarray]:
    poses, times = _read_lidar_track(root)
    return poses @ LIDAR_POSE_FROM_EGO, times


def _read_lidar_track(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """The LiDAR's poses [F, 4, 4] in the dataset's own world, and the times [F]."""
    poses = _read_poses(root / "lidar" / "poses.json")
    return poses, _read_times(root / "lidar" / "timestamps.json", expected=len(poses))


def frame_file(root: Path, folder: str, frame: int) -> Path:
    """The path of a frame's table: `folder` is lidar, annotations/cuboids or annotations/semseg."""
    return root / folder / f"{frame:02d}.pkl.gz"


def read_lidar(root: Path, frame: int) -> pd.DataFrame | None:
    """The returns of a frame, columns x y z i t d as in the file, or None without a file."""
    path = frame_file(root, "lidar", frame)
    return _read_table(path, LIDAR_COLUMNS) if path.exists() else None


def read_semantics(root: Path, frame: int, rows: int) -> np.ndarray | None:
    """The class number of each return of the frame, int64 [rows], or None without a file."""
    path = frame_file(root, "annotations/semseg", frame)
    if not path.exists():
        return None
    classes = _read_table(path, ("class",))["class"].to_numpy()
    if len(classes) != rows:
        raise AdapterError(
            f"{path} must have a class for each of the {rows} returns in lidar/{frame:02d}.pkl.gz; "
            f"it has {len(classes)}"
        )
    return classes


def read_cuboids(root: Path, frame: int) -> pd.DataFrame | None:
    """The boxes of a frame with all their columns, or None without a file."""
    path = frame_file(root, "annotations/cuboids", frame)
    needed = ("uuid", "label", "yaw", "stationary")
    needed += tuple(f"{group}.{axis}" for group in ("position", "dimensions") for axis in "xyz")
    return _read_table(path, needed) if path.exists() else None


def _read_table(path: Path, needed: tuple[str, ...]) -> pd.DataFrame:
    table = read_frame(path)
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise AdapterError(f"{path} lacks the columns {missing}; it has {list(table.columns)}")
    return table


def _read_camera(folder: Path, frames: int, problems: list[str]) -> CameraTrack:
    path = folder / "intrinsics.json"
    lens = read_json(path)
    fx, fy, cx, cy = (
        number_of(lens.get(key), f"{path}: {key} (pixels)") for key in ("fx", "fy", "cx", "cy")
    )
    if min(fx, fy) <= 0:
        raise AdapterError(f"{path}: fx and fy (pixels) must be above 0; got {fx} and {fy}")
    poses = _read_poses(folder / "poses.json")
    if len(poses) != frames:
        raise AdapterError(
            f"{folder / 'poses.json'} has {len(poses)} poses; lidar/poses.json has {frames}"
        )
    times = _read_times(folder / "timestamps.json", expected=frames)
    images, (height, width) = _find_images(folder, frames, problems)
    return CameraTrack(folder.name, (width, height), (fx, fy, cx, cy), poses, times, images)


def _find_images(
    folder: Path, frames: int, problems: list[str]
) -> tuple[tuple[Path | None, ...], tuple[int, int]]:
    """The usable image of every frame, and the rows and columns of all."""
    numbers = {int(p.stem) for p in folder.glob("*.jpg") if re.fullmatch(r"\d+", p.stem)}
    if not numbers:
        raise AdapterError(f"{folder} holds no images NN.jpg; unpack the sequence again")
    if max(numbers) >= frames:
        raise AdapterError(
            f"{folder} holds image {max(numbers):02d}.jpg, but timestamps.json ends with frame "
            f"{frames - 1:02d}: images and timestamps are not of one sequence"
        )
    paths = [folder / f"{frame:02d}.jpg" for frame in range(frames)]
    faults = [_file_fault(path) for path in paths]
    size = _image_size(folder, [p for p, fault in zip(paths, faults, strict=True) if not fault])
    images: list[Path | None] = []
    for frame, (path, fault) in enumerate(zip(paths, faults, strict=True)):
        fault = fault or _picture_fault(path, size)
        if fault:
            problems.append(f"camera {folder.name}, frame {frame}: image {path} {fault}")
        images.append(None if fault else path)
    return tuple(images), size


def _file_fault(path: Path) -> str:
    try:
        return "" if is_whole_jpeg(path) else "is not a JPEG file"
    except ImageFault as fault:
        return str(fault)


def _picture_fault(path: Path, size: tuple[int, int]) -> str:
    """What is wrong with the picture in a JPEG file, decoded at an eighth of its size."""
    image = decode_image(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    if image is None:
        return "cannot be decoded"
    if image.shape != tuple(-(-side // 8) for side in size):
        return f"is not of {size[1]}x{size[0]} pixels as the camera's first image"
    return ""


def _image_size(folder: Path, paths: list[Path]) -> tuple[int, int]:
    """Rows and columns of the first image that can be decoded."""
    for path in paths:
        image = decode_image(path, cv2.IMREAD_UNCHANGED)
        if image is not None:
            return image.shape[0], image.shape[1]
    raise AdapterError(f"{folder} holds no image that can be decoded; unpack the sequence again")


def _read_times(path: Path, *, expected: int) -> np.ndarray:
    """Nanoseconds, int64 [expected]."""
    times = np.array(
        [
            number_of(seconds, f"{path}, frame {frame}: the time in seconds", largest=_LATEST_S)
            for frame, seconds in enumerate(read_json(path, list))
        ]
    )
    if len(times) != expected:
        raise AdapterError(f"{path} has {len(times)} entries; there are {expected} LiDAR poses")
    if not (np.diff(times) > 0).all():
        frame = int(np.argmin(np.diff(times) > 0)) + 1
        raise AdapterError(
            f"{path} must be increasing; frame {frame} is at {times[frame]} s after "
            f"{times[frame - 1]} s. Copy it again"
        )
    return np.round(times * 1e9).astype(np.int64)


def _read_poses(path: Path) -> np.ndarray:
    """Rigid transforms, float64 [F, 4, 4]."""
    values = np.array(
        [
            _pose_numbers(entry, f"{path}, frame {i}")
            for i, entry in enumerate(read_json(path, list))
        ]
    )
    if len(values) == 0:
        raise AdapterError(f"{path} holds no poses")
    norms = np.linalg.norm(values[:, 3:], axis=1)
    # Headings are stored to 16 digits; a norm off by a thousandth is no rotation.
    if not (np.abs(norms - 1) < 1e-3).all():
        frame = int(np.argmax(np.abs(norms - 1) >= 1e-3))
        raise AdapterError(
            f"{path}, frame {frame}: heading must be a unit quaternion w x y z; got "
            f"{values[frame, 3:].tolist()}. Copy the file again"
        )
    rotation = rotmat_from_quat(torch.from_numpy(values[:, 3:]))
    return rigid(rotation, torch.from_numpy(values[:, :3])).numpy()


def _pose_numbers(entry: Any, where: str) -> list[float]:
    """x y z and w x y z of an entry of poses.json."""
    numbers = []
    for group, axes in (("position", "xyz"), ("heading", "wxyz")):
        values = entry.get(group) if isinstance(entry, dict) else None
        if not isinstance(values, dict):
            raise AdapterError(
                f"{where} must have a position x y z and a heading w x y z; got {entry!r:.80}"
            )
        numbers += [number_of(values.get(axis), f"{where}: {group}.{axis}") for axis in axes]
    return numbers
