"""The drive that a run was trained on, from its processed data: where car and cameras were.

The scene's world is the model's, whose origin and axes are the first frame's car (nuScenes: front
camera), turned until z is up as it is in the dataset's world: a car stands on a slope, and its
brakes tip it. Frame t is at t tenths of a second: the data hold no times, and all cameras of a
frame were trained as one moment.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapters.drivestudio.run import CameraKind, Run, RunOptions, find_run
from adapters.lidar_scene.scene import stored_records
from adapters.plain_files import array_of, read_json, read_numbers, read_pose
from adapters.world import rotation_to_z_up
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.files.checkpoints import section, taken, tensor
from augment.files.image_size import read_image_header
from augment.geometry import invert_rigid, quat_from_rotmat
from augment.labels import Boxes, LidarSweep

# ---- What a run learnt for each image: its colours' affine map and its camera's pose -------------
# Image i of a run is frame * cameras + camera, both counted from 0 as the run has them.

_POSES = ("CamPosePerturb", "CamPose")  # in the order in which they apply


@dataclass(frozen=True, eq=False)
class ImageCorrections:
    """color_maps: float32 [n, 3, 4] of each image, mean_color_map: [3, 4] of images that were not
    trained on; both None without any. pose_changes: float64 [n, 4, 4], what world_from_camera is
    multiplied by on its right; None for no change.
    """

    color_maps: np.ndarray | None
    mean_color_map: np.ndarray | None
    pose_changes: np.ndarray | None
    problems: tuple[str, ...] = ()

    def camera_from_corrected(self, image: int) -> np.ndarray:
        return np.eye(4) if self.pose_changes is None else self.pose_changes[image]

    def camera_maps(self, run: Run) -> dict[str, torch.Tensor]:
        """Of cameras whose images were not trained on, by name."""
        if self.mean_color_map is None:
            return {}
        names = [run.convention.cameras[number].name for number in run.cameras]
        return {name: torch.from_numpy(self.mean_color_map.copy()) for name in names}

    def image_maps(
        self, run: Run, frames: tuple[Frame, ...]
    ) -> dict[tuple[str, int], torch.Tensor]:
        """Of the images that were trained on, by camera name and time."""
        if self.color_maps is None:
            return {}
        maps = {}
        for frame in frames:
            if run.is_held_out(frame.index):
                continue
            first = (frame.index - run.frames.start) * len(run.cameras)
            for position, number in enumerate(run.cameras):
                name = run.convention.cameras[number].name
                color_map = torch.from_numpy(self.color_maps[first + position].copy())
                maps[name, frame.cameras[name].timestamp_ns] = color_map
        return maps


def read_corrections(models: Mapping[str, Any], run: Run, where: str) -> ImageCorrections:
    """The corrections of a checkpoint's models.

    Raises:
        AdapterError: a tensor is missing, of another shape, or not finite.
    """
    count = len(run.frames) * len(run.cameras)
    maps, mean, problems = None, None, ()
    if "Affine" in models:
        maps, mean, problems = _affine(section(models, "Affine", where), count, f"{where} Affine")
    changes = None
    for name in _POSES:
        if name in models:
            found = _pose_changes(section(models, name, where), count, f"{where} {name}")
            changes = found if changes is None else changes @ found
    return ImageCorrections(maps, mean, changes, problems)


def _affine(
    content: Mapping[str, Any], count: int, where: str
) -> tuple[np.ndarray | None, np.ndarray | None, tuple[str, ...]]:
    embedding = _numbers(content, "embedding.weight", (count, None), where)
    hidden = _numbers(content, "decoder.0.weight", (None, None), where)
    width, inputs = hidden.shape
    if inputs == embedding.shape[1] + 2:
        return (
            *(None, None),
            (
                f"{where}: the colour corrections differ over the image (pixel_affine); they are "
                f"left out, so images have the model's own colours",
            ),
        )
    if inputs != embedding.shape[1]:
        raise AdapterError(
            f"{where}: decoder.0.weight must take the {embedding.shape[1]} numbers of "
            f"embedding.weight; it takes {inputs}"
        )
    hidden_bias = _numbers(content, "decoder.0.bias", (width,), where)
    output = _numbers(content, "decoder.2.weight", (12, width), where)
    output_bias = _numbers(content, "decoder.2.bias", (12,), where)

    def decoded(embedding: np.ndarray) -> np.ndarray:
        values = np.maximum(embedding @ hidden.T + hidden_bias, 0) @ output.T + output_bias
        return (values.reshape(-1, 3, 4) + np.eye(3, 4)).astype(np.float32)

    return decoded(embedding), decoded(embedding.mean(0, keepdims=True))[0], ()


def _pose_changes(content: Mapping[str, Any], count: int, where: str) -> np.ndarray:
    """float64 [n, 4, 4] of 3 numbers of a shift and 6 of a rotation each.

    The 6, of which the identity's were taken off, are its first two rows before Gram and Schmidt
    (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks", sec. B).
    """
    values = _numbers(content, "embeds.weight", (count, 9), where)
    first = values[:, 3:6] + [1.0, 0, 0]
    second = values[:, 6:9] + [0, 1.0, 0]
    with np.errstate(all="ignore"):
        x = first / np.linalg.norm(first, axis=1, keepdims=True)
        y = second - (x * second).sum(1, keepdims=True) * x
        y = y / np.linalg.norm(y, axis=1, keepdims=True)
    changes = np.tile(np.eye(4), (count, 1, 1))
    changes[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    changes[:, :3, 3] = values[:, :3]
    if not np.isfinite(changes).all():
        raise AdapterError(f"{where}: embeds.weight holds rows that are no rotation")
    return changes


def _numbers(
    content: Mapping[str, Any], name: str, shape: tuple[int | None, ...], where: str
) -> np.ndarray:
    values = taken(tensor(content, name, shape, where)).double().numpy()
    if not np.isfinite(values).all():
        raise AdapterError(f"{where}: {name} holds NaN or infinite numbers")
    return values


# ---- drive ---------------------------------------------------------------------------------------

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


# ---- Labelled objects of the processed data: instances/instances_info.json -----------------------
# {"0": {"id": ..., "class_name": ..., "frame_annotations":
#     {"frame_idx": [...], "obj_to_world": [4 x 4, ...], "box_size": [[x, y, z], ...]}}, ...}


@dataclass(frozen=True, eq=False)
class Instance:
    """One object over the data's frames, in the dataset's world and its boxes' axes.

    number: its key in the file. frames: int64 [T], each once, ascending. poses: float64 [T, 4, 4].
    sizes_m: float64 [T, 3] along the box's x, y and z.
    """

    number: int
    track_id: str
    label: str
    frames: np.ndarray
    poses: np.ndarray
    sizes_m: np.ndarray


def read_instances(data: Path) -> tuple[Instance, ...] | None:
    """All objects, by their numbers; None without the file.

    Raises:
        AdapterError: the file is damaged, or an entry is no object.
    """
    path = data / "instances" / "instances_info.json"
    if not path.is_file():
        return None
    return _read(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=2)  # labels ask for one frame after the other
def _read(path: Path, _written_ns: int) -> tuple[Instance, ...]:
    content = read_json(path)
    objects = [_instance(key, entry, f"{path}: object {key!r}") for key, entry in content.items()]
    ids = [found.track_id for found in objects]
    if len(set(ids)) != len(ids):
        raise AdapterError(f"{path}: ids of objects repeat; process the data again")
    return tuple(sorted(objects, key=lambda found: found.number))


def _instance(key: str, entry: Any, where: str) -> Instance:
    notes = entry.get("frame_annotations") if isinstance(entry, Mapping) else None
    if not re.fullmatch("[0-9]{1,9}", key) or not isinstance(notes, Mapping) or "id" not in entry:
        raise AdapterError(
            f"{where} must have a number as its key, and id, class_name and frame_annotations"
        )
    frames = _array(notes, "frame_idx", (), where)
    poses = _array(notes, "obj_to_world", (4, 4), where)
    sizes = _array(notes, "box_size", (3,), where)
    if not len(frames) == len(poses) == len(sizes):
        raise AdapterError(
            f"{where}: frame_idx, obj_to_world and box_size must be of equal length; got "
            f"{len(frames)}, {len(poses)} and {len(sizes)}"
        )
    numbers = frames.astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    if (numbers != frames).any() or (np.diff(numbers[order]) < 1).any() or (numbers < 0).any():
        raise AdapterError(f"{where}: frame_idx must list frame numbers, each once")
    rotations = poses[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0)
    if error > 1e-3 or (np.linalg.det(rotations) < 0).any() or (sizes <= 0).any():
        raise AdapterError(
            f"{where}: obj_to_world must be rotations and translations, and box_size > 0 (metres)"
        )
    label = entry.get("class_name")
    return Instance(
        number=int(key),
        track_id=str(entry["id"]),
        label=label if isinstance(label, str) and label else "unknown",
        frames=numbers[order],
        poses=poses[order],
        sizes_m=sizes[order],
    )


def _array(notes: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """float64 [T, *shape]; rows may be flat."""
    values = array_of(notes.get(name))
    length = len(values) if values is not None and values.ndim else -1
    if values is None or values.size != length * math.prod(shape) or not np.isfinite(values).all():
        expected = " x ".join(("T", *map(str, shape)))
        raise AdapterError(f"{where}: {name} must hold {expected} numbers")
    return values.reshape(length, *shape)


# ---- Boxes and LiDAR of the processed data a run was trained on, in the scene's world ------------

_MOVED = (("x", "y", "z"), ("origin_x", "origin_y", "origin_z"))
_TURNED = ("flow_x", "flow_y", "flow_z")


@dataclass(frozen=True, eq=False)
class DriveStudioLabels:
    """Labels of a run's data, read when asked.

    The scene's world is the model's (see adapters.drivestudio.drive), not the dataset's, from which
    it is turned: so are these labels. Boxes: x forward; track_ids are the data's ids; `instance` is
    their number in instances_info.json. Sweeps: the columns of Convention.lidar_columns, of which
    points, and Waymo's origins and flows, are moved from the frame of the car (nuScenes: of the
    sensor, lidar_pose) at that moment; they are taken to be in it, as the project's loaders do.
    """

    run: Run

    def boxes(self, frame_index: int) -> Boxes:
        scene = scene_from_dataset(self.run)
        object_from_actor = self.run.convention.object_from_actor
        found = [
            (instance, int(at[0]))
            for instance in read_instances(self.run.data) or ()
            if len(at := np.flatnonzero(instance.frames == frame_index))
        ]
        if not found:
            return Boxes.empty()
        poses = scene @ np.stack([instance.poses[at] for instance, at in found])
        rotations = poses[:, :3, :3] @ object_from_actor
        sizes = np.stack([instance.sizes_m[at] for instance, at in found])
        return Boxes(
            track_ids=tuple(instance.track_id for instance, _ in found),
            labels=tuple(instance.label for instance, _ in found),
            centers_m=poses[:, :3, 3].copy(),
            sizes_m=sizes @ np.abs(object_from_actor),
            quats=quat_from_rotmat(torch.from_numpy(rotations)).numpy(),
            attributes={"instance": np.array([instance.number for instance, _ in found])},
        )

    def lidar(self, frame_index: int) -> LidarSweep | None:
        file = self._lidar_file(frame_index)
        if not file.is_file():
            return None
        names = self.run.convention.lidar_columns
        if file.stat().st_size % (4 * len(names)):
            raise AdapterError(
                f"{file} must hold rows of {len(names)} float32 ({', '.join(names)}); its "
                f"{file.stat().st_size} bytes are no whole number of them"
            )
        table = np.fromfile(file, "<f4").reshape(-1, len(names))
        pose = self._world_from_lidar(frame_index)
        columns = {name: table[:, i].copy() for i, name in enumerate(names)}
        for group in (*_MOVED, _TURNED):
            if group[0] not in columns:
                continue
            values = np.stack([columns[name] for name in group], axis=1).astype(np.float64)
            values = values @ pose[:3, :3].T + (0 if group == _TURNED else pose[:3, 3])
            columns |= {name: values[:, i].copy() for i, name in enumerate(group)}
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Waymo's own origins, return by return; nuScenes' sensor in lidar_pose. The other
        datasets' files have returns in the car's frame and do not say where the sensor is on it.
        """
        names = _MOVED[1]
        if all(name in sweep.columns for name in names):
            return np.stack([np.asarray(sweep.columns[name], np.float64) for name in names], axis=1)
        if not self.run.convention.world_of_front_camera:
            return None
        return np.broadcast_to(self._world_from_lidar(frame_index)[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        file = self._lidar_file(frame_index)
        return (file,) if file.is_file() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        names = self.run.convention.lidar_columns
        records = np.fromfile(file, "<f4").reshape(-1, len(names))
        return stored_records(records, names, sweep, self._world_from_lidar(frame_index))

    def _lidar_file(self, frame: int) -> Path:
        return self.run.data / "lidar" / f"{frame:03d}.bin"

    def _world_from_lidar(self, frame: int) -> np.ndarray:
        return scene_from_dataset(self.run) @ dataset_from_lidar(self.run, frame)


def drivestudio_labels(path: str, query: dict[str, str]) -> DriveStudioLabels:
    """The labels of a run's data; whatever frames the query asks for, they are those of all.

    Raises:
        AdapterError: as for open_drivestudio, as far as config and data are concerned.
    """
    return DriveStudioLabels(find_run(Path(path), RunOptions.from_query(query)))
