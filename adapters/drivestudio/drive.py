"""The drive that a run was trained on, from its processed data: where car and cameras were.

The scene's world is the model's, whose origin and axes are the first frame's car (nuScenes: front
camera), turned until z is up as it is in the dataset's world: a car stands on a slope, and its
brakes tip it. Frame t is at t tenths of a second: the data hold no times, and all cameras of a
frame were trained as one moment.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.drivestudio.conventions import CameraKind
from adapters.drivestudio.corrections import ImageCorrections
from adapters.drivestudio.run import Run
from adapters.plain_files import read_numbers, read_pose
from adapters.world import rotation_to_z_up
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.image_header import read_image_header

FRAME_NS = 100_000_000
_LEVEL = 1e-4  # slope that is none: a centimetre in 100 m
_STEEPEST_UP = 0.9  # cosine of a slope that no road has


@dataclass(frozen=True, eq=False)
class Drive:
    """frames: those asked for. problems: one sentence for each kind of thing gone on without."""

    frames: tuple[Frame, ...]
    problems: tuple[str, ...]


def model_from_dataset(run: Run) -> np.ndarray:
    """The rigid transform from the dataset's world to the model's, float64 [4, 4].

    Raises:
        AdapterError: the first frame's pose is missing or none.
    """
    return np.linalg.inv(_world_pose(run, run.frames.start))


def scene_from_model(run: Run) -> np.ndarray:
    """The rotation from the model's world to the scene's, float64 [3, 3]: a permutation of axes
    where that leaves z as good as up, or where the dataset's z cannot be what is up.

    Raises:
        AdapterError: as model_from_dataset.
    """
    axes, up = run.convention.scene_from_model, _up(run)
    if _is_steep(up) or np.hypot(up[0], up[1]) < _LEVEL:
        return axes
    return rotation_to_z_up(up / np.linalg.norm(up)) @ axes


def _up(run: Run) -> np.ndarray:
    """The dataset's z axis as the first frame's car has it, x forward, y left, z up."""
    return run.convention.scene_from_model @ model_from_dataset(run)[:3, 2]


def _is_steep(up: np.ndarray) -> bool:
    return up[2] < _STEEPEST_UP * np.linalg.norm(up)


def scene_from_dataset(run: Run) -> np.ndarray:
    """The rigid transform from the dataset's world to the scene's, float64 [4, 4].

    Raises:
        AdapterError: as model_from_dataset.
    """
    return _rigid(scene_from_model(run)) @ model_from_dataset(run)


def read_drive(run: Run, numbers: tuple[int, ...], corrections: ImageCorrections) -> Drive:
    """Frames of the given numbers, their cameras as the model corrects them.

    Raises:
        AdapterError: a pose or calibration is missing or none. Missing images are problems.
    """
    scene = scene_from_dataset(run)
    problems: list[str] = []
    if _is_steep(_up(run)):
        problems.append(
            f"{run.data}: z of its world is not what is up for the first frame's car, which is "
            f"therefore taken to stand level"
        )
    cameras = [_calibrated(run, position, problems) for position in range(len(run.cameras))]
    frames, missing = [], []
    for number in numbers:
        shown, paths = {}, {}
        for position, (camera, fixed) in enumerate(cameras):
            file = run.data / "images" / f"{number:03d}_{run.cameras[position]}.jpg"
            if file.is_file():
                paths[camera.name] = str(file)
            else:
                missing.append(file.name)
            image = (number - run.frames.start) * len(cameras) + position
            world_from_camera = scene @ _dataset_from_camera(run, number, position, fixed)
            pose = torch.from_numpy(world_from_camera @ corrections.camera_from_corrected(image))
            shown[camera.name] = dataclasses.replace(
                camera, camera_from_world=invert_rigid(pose), timestamp_ns=number * FRAME_NS
            )
        ego = scene @ _world_pose(run, number) @ _rigid(run.convention.pose_from_ego)
        frames.append(Frame(number, number * FRAME_NS, torch.from_numpy(ego), shown, paths))
    if missing:
        problems.append(
            f"{run.data / 'images'}: {len(missing)} of {len(numbers) * len(cameras)} images are "
            f"missing, the first {missing[0]}; their cameras are there without them"
        )
    return Drive(tuple(frames), tuple(problems))


def dataset_from_lidar(run: Run, number: int) -> np.ndarray:
    """Pose of a frame's returns in the dataset's world: the car's, or lidar_pose's of nuScenes."""
    folder = "lidar_pose" if run.convention.world_of_front_camera else "ego_pose"
    return read_pose(run.data / folder / f"{number:03d}.txt")


def _world_pose(run: Run, number: int) -> np.ndarray:
    """dataset_from_ego of a frame, or dataset_from_front_camera where that is the world's."""
    if run.convention.world_of_front_camera:
        return read_pose(run.data / "extrinsics" / f"{number:03d}_0.txt")
    return read_pose(run.data / "ego_pose" / f"{number:03d}.txt")


def _dataset_from_camera(
    run: Run, number: int, position: int, ego_from_camera: np.ndarray | None
) -> np.ndarray:
    axes = _rigid(run.convention.camera_from_opencv)
    if ego_from_camera is None:
        name = f"{number:03d}_{run.cameras[position]}.txt"
        return read_pose(run.data / "extrinsics" / name) @ axes
    return _world_pose(run, number) @ ego_from_camera @ axes


def _calibrated(run: Run, position: int, problems: list[str]) -> tuple[Camera, np.ndarray | None]:
    """A camera at no place yet, and its extrinsics where they are the same in all frames."""
    number = run.cameras[position]
    kind = run.convention.cameras[number]
    file = run.data / "intrinsics" / f"{number}.txt"
    values = read_numbers(file)
    if values.size < 4 or not (values[:2] > 0).all():
        raise AdapterError(
            f"{file} must hold fx fy cx cy k1 k2 p1 p2 k3 with fx, fy > 0; got {values.tolist()}"
        )
    if values[4:].any():
        problems.append(
            f"camera {kind.name}: its lens distortion is left out, as the model was trained "
            + (
                "on images without it; the recorded images still have it"
                if run.undistort
                else "as if it had none (undistort is off)"
            )
        )
    problems += _about_size(run.data / "images", number, kind)
    fx, fy, cx, cy = values[:4].tolist()
    nowhere = torch.eye(4, dtype=torch.float64)
    camera = Camera(kind.name, kind.width, kind.height, fx, fy, cx, cy, nowhere)
    width, height = (int(side / run.downscale[position]) for side in (kind.width, kind.height))
    if min(width, height) < 1:
        raise AdapterError(
            f"{run.config_file}: data.pixel_source.downscale_when_loading of {kind.name} is "
            f"{run.downscale[position]:g}, which leaves no pixel of {kind.width}x{kind.height}"
        )
    fixed = None
    if not run.convention.poses_per_frame:
        fixed = read_pose(run.data / "extrinsics" / f"{number}.txt")
    return camera.resized(width, height), fixed


def _about_size(folder: Path, number: int, kind: CameraKind) -> list[str]:
    """A sentence where the first image is of another size than training took it to be."""
    first = min(folder.glob(f"*_{number}.jpg"), default=None)
    if first is None:
        return []
    header = read_image_header(first)
    if header is None or (header.width, header.height) == (kind.width, kind.height):
        return []
    return [
        f"{first} is of {header.width}x{header.height} pixels; drivestudio takes the intrinsics of "
        f"{kind.name} to be for {kind.width}x{kind.height}, and so does the scene"
    ]


def _rigid(rotation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = rotation
    return out
