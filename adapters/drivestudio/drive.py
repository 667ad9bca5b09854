"""The drive that a drivestudio run was trained on, from its processed data: poses of car and
cameras.

`find_run` finds the run's files, `read_drive` reads the frames, `read_corrections` what training
changed for each image, `DriveStudioLabels` boxes and LiDAR. The caller is
`adapters.drivestudio.adapter`.

The scene's world is the model's, turned until z is up as in the dataset's world. The model's world
has the origin and axes of the first frame's car (nuScenes: front camera), which stands on a slope
and is tipped by its brakes. Frame t is at t tenths of a second: the data hold no times, and all
cameras of a frame were trained as one moment.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import (
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    RootModel,
    field_validator,
    model_validator,
)

from adapters.camera_files.camera_files import validate
from adapters.plain_files import (
    Number,
    array_of,
    read_json,
    read_numbers,
    read_pose,
    read_yaml,
    resolve_inside,
)
from adapters.raw_drive import DriveOptions, stored_records
from adapters.recorded_lenses import LENS_MEANING, RECORDED_LENS, UNDISTORTED_LENS, LensChoice
from adapters.uri import UriOptions
from adapters.world import rotation_to_z_up
from augment.errors import AdapterError
from augment.files.checkpoints import dictionary_in, finite_array
from augment.files.image_size import read_image_header
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid, quat_from_rotmat
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.lenses import OpenCVLens

# ---- A run's config.yaml, read by dotted keys such as `data.scene_idx` ---------------------------


def read_config(path: Path) -> Mapping[str, Any]:
    """Read a run's config.yaml."""
    return read_yaml(
        path, if_missing="a drivestudio run is a folder with config.yaml and checkpoint_*.pth"
    )


def lookup(config: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key, or None if there is none."""
    value: Any = config
    for name in key.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, str) and "${" in item:
            raise AdapterError(
                f"config.yaml: {key} is {item!r}, which refers to something else; write its value "
                f"there, as OmegaConf.resolve does"
            )
    return value


class RunConfig(BaseModel):
    """Checked part of config.yaml.

    end_timestep: included; -1 for the data's last. test_image_stride: step between held-out frames;
    0 for none.
    """

    model_config = ConfigDict(frozen=True, strict=True)

    dataset: str = Field(alias="data.dataset")
    start_timestep: int = Field(alias="data.start_timestep")
    end_timestep: int = Field(alias="data.end_timestep")
    cameras: Annotated[list[int], Field(min_length=1)] = Field(alias="data.pixel_source.cameras")
    downscale: list[Annotated[Number, Field(gt=0)]] = Field(
        alias="data.pixel_source.downscale_when_loading"
    )
    test_image_stride: int = Field(0, ge=0, alias="data.pixel_source.test_image_stride")

    @field_validator("dataset")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name.lower() not in CONVENTIONS:
            raise ValueError(
                f"the axes of {name!r} are not known here; known are {', '.join(CONVENTIONS)}"
            )
        return name.lower()

    @model_validator(mode="after")
    def _check_consistency(self) -> RunConfig:
        known_cameras = range(len(CONVENTIONS[self.dataset].cameras))
        if len(set(self.cameras)) != len(self.cameras) or not set(self.cameras) <= set(
            known_cameras
        ):
            raise ValueError(
                f"data.pixel_source.cameras must be camera numbers, 0 to {known_cameras[-1]}, each "
                f"once; got {self.cameras}"
            )
        if len(self.downscale) < len(self.cameras):
            raise ValueError(
                f"data.pixel_source.downscale_when_loading must hold a factor > 0 for each of the "
                f"{len(self.cameras)} cameras; got {self.downscale}"
            )
        return self


# ---- What a drivestudio URI may ask for, as in `drivestudio:<run>?data=DIR&frames=0:50` ----------

_DATA_DESCRIPTION = "the processed scene's folder, such as data/waymo/processed/training/023"
_Text = Annotated[str, Field(min_length=1)]


def _frames_option(text: object) -> DriveOptions:
    """Return the drive options of a range of frames."""
    return DriveOptions.from_query("drivestudio", {"frames": str(text)})


class RunOptions(UriOptions):
    """Options of one opening. None if the run decides."""

    data: _Text | None = Field(None, description=_DATA_DESCRIPTION)
    checkpoint: _Text | None = Field(
        None, description="the name of a checkpoint in the run, such as checkpoint_15000.pth"
    )
    frames: Annotated[DriveOptions, BeforeValidator(_frames_option)] = Field(
        DriveOptions(),
        description="first:stop, numbers of the data's frames, either of them left out at will",
    )
    lens: LensChoice = Field(UNDISTORTED_LENS, description=LENS_MEANING)


# ---- What the processed data of each dataset means: cameras, axes, worlds, LiDAR columns ---------
# Facts of the project's loaders and of its table of image sizes, to which it resizes whatever
# images it finds. The model's world is the first frame's pose of `world`, undone.

# Rows: x forward, y left, z up, in OpenCV's camera axes x right, y down, z forward.
FLAT_FROM_OPENCV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Columns: x forward, y left, z up, in axes x right, y forward, z up.
_RIGHT_FORWARD_FROM_FLAT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class CameraKind:
    """A camera as the dataset has it. width, height: pixels for which its intrinsics are given."""

    name: str
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Convention:
    """Format of one dataset's processed data.

    Attributes:
        cameras: by number.
        lidar_columns: columns of lidar/{frame}.bin, float32.
        poses_per_frame: if True, extrinsics/{frame}_{camera}.txt is world_from_camera; else
            extrinsics/{camera}.txt is ego_from_camera.
        world_of_front_camera: if True, the model's world is camera 0's first frame, else the first
            ego_pose.
        camera_from_opencv: axes of the extrinsics, [3, 3].
        scene_from_model: [3, 3], a permutation that turns the model's world z up, as far as the car
            stands level.
        pose_from_ego: [3, 3], ego axes (x forward, y left, z up) in those of ego_pose, or of camera
            0 if that is the world's.
        object_from_actor: [3, 3], x forward, y left, z up in the axes of the data's boxes.
    """

    cameras: tuple[CameraKind, ...]
    lidar_columns: tuple[str, ...]
    poses_per_frame: bool = False
    world_of_front_camera: bool = False
    camera_from_opencv: np.ndarray = field(default_factory=lambda: np.eye(3))
    scene_from_model: np.ndarray = field(default_factory=lambda: np.eye(3))
    pose_from_ego: np.ndarray = field(default_factory=lambda: np.eye(3))
    object_from_actor: np.ndarray = field(default_factory=lambda: np.eye(3))


def _cameras(width: int, height: int, names: str) -> tuple[CameraKind, ...]:
    """Return camera kinds of one size."""
    return tuple(CameraKind(name, width, height) for name in names.split())


_WAYMO_COLUMNS = (
    "origin_x origin_y origin_z x y z flow_x flow_y flow_z flow_class ground intensity elongation "
    "laser_id"
)
_XYZI = ("x", "y", "z", "intensity")
CONVENTIONS = {
    "waymo": Convention(
        cameras=(
            *_cameras(1920, 1280, "front_camera front_left_camera front_right_camera"),
            *_cameras(1920, 866, "left_camera right_camera"),
        ),
        lidar_columns=tuple(_WAYMO_COLUMNS.split()),
        camera_from_opencv=FLAT_FROM_OPENCV,
    ),
    "nuscenes": Convention(
        cameras=(
            *_cameras(1600, 900, "CAM_FRONT CAM_FRONT_LEFT CAM_FRONT_RIGHT CAM_BACK_LEFT"),
            *_cameras(1600, 900, "CAM_BACK_RIGHT CAM_BACK"),
        ),
        lidar_columns=_XYZI,
        poses_per_frame=True,
        world_of_front_camera=True,
        scene_from_model=FLAT_FROM_OPENCV,
        pose_from_ego=FLAT_FROM_OPENCV.T,
    ),
    "pandaset": Convention(
        cameras=(
            *_cameras(1920, 1080, "front_camera front_left_camera front_right_camera"),
            *_cameras(1920, 1080, "left_camera right_camera back_camera"),
        ),
        lidar_columns=(*_XYZI, "laser_id"),
        poses_per_frame=True,
        pose_from_ego=_RIGHT_FORWARD_FROM_FLAT,
        object_from_actor=_RIGHT_FORWARD_FROM_FLAT,
    ),
    "argoverse": Convention(
        cameras=(
            CameraKind("ring_front_center", 1550, 2048),
            *_cameras(2048, 1550, "ring_front_left ring_front_right ring_side_left"),
            *_cameras(2048, 1550, "ring_side_right ring_rear_left ring_rear_right"),
        ),
        lidar_columns=_XYZI,
    ),
    "kitti": Convention(cameras=_cameras(1242, 375, "CAM_LEFT CAM_RIGHT"), lidar_columns=_XYZI),
    "nuplan": Convention(
        cameras=_cameras(1920, 1080, "CAM_F0 CAM_L0 CAM_R0 CAM_L1 CAM_R1 CAM_L2 CAM_R2 CAM_B0"),
        lidar_columns=(*_XYZI, "ring", "lidar_id"),
    ),
}


# ---- A run's folder: its checkpoint, config and data ---------------------------------------------

_CHECKPOINT_NAME = re.compile(r"checkpoint_(\d+)\.pth", re.ASCII)
_FINAL_CHECKPOINT = "checkpoint_final.pth"
_POSE_NAME = re.compile(r"\d{3,}\.txt", re.ASCII)
# Steps after which the project adds a degree, unless a config says otherwise.
_DEFAULT_SH_INTERVAL = 1000


@dataclass(frozen=True, eq=False)
class Run:
    """A trained run, and the data on which it was trained.

    Attributes:
        folder: the run's folder.
        checkpoint: the checkpoint's file.
        data: the processed scene's folder.
        frames: numbers of all its frames.
        settings: the checked part of the configuration.
        config: the whole configuration.
    """

    folder: Path
    checkpoint: Path
    data: Path
    frames: range
    settings: RunConfig
    config: Mapping[str, Any]

    @property
    def config_file(self) -> Path:
        return self.folder / "config.yaml"

    @property
    def convention(self) -> Convention:
        return CONVENTIONS[self.settings.dataset]

    @property
    def cameras(self) -> list[int]:
        """Return the numbers of the cameras, in the model's order."""
        return self.settings.cameras

    def is_set(self, key: str) -> bool:
        """Return True if a key of the configuration is true."""
        return lookup(self.config, key) is True

    def sh_interval(self, node: str) -> int:
        """Return the steps of training for each degree of a node's spherical harmonics."""
        for name in (f"model.{node}.ctrl", "trainer.gaussian_ctrl_general_cfg"):
            value = lookup(self.config, f"{name}.sh_degree_interval")
            if isinstance(value, int) and value > 0:
                return value
        return _DEFAULT_SH_INTERVAL

    def is_held_out(self, frame: int) -> bool:
        """Return True if a frame was not trained on: every stride-th from the stride-th of the
        run on.
        """
        position = frame - self.frames.start
        stride = self.settings.test_image_stride
        return stride > 0 and position > 0 and position % stride == 0


def find_run(path: Path, options: RunOptions) -> Run:
    """Return the run of a folder, or of a checkpoint in one."""
    folder = path if path.is_dir() else path.parent
    config_file = folder / "config.yaml"
    config = read_config(config_file)
    keys = [str(entry.alias) for entry in RunConfig.model_fields.values()]
    values = {key: value for key in keys if (value := lookup(config, key)) is not None}
    settings = validate(RunConfig, values, config_file, "config that drivestudio saved")
    checkpoint = _find_checkpoint(path, folder, options)
    data = _find_data(config, folder, options)
    return Run(
        folder, checkpoint, data, _frame_range(settings, data, config_file), settings, config
    )


def _find_checkpoint(path: Path, folder: Path, options: RunOptions) -> Path:
    """Return the selected checkpoint, else the final one, else the newest."""
    if not path.is_dir():
        if options.checkpoint is not None:
            raise AdapterError(
                f"{path} is a checkpoint already; leave checkpoint={options.checkpoint} out, or "
                f"give the run's folder"
            )
        return path
    if options.checkpoint is not None:
        checkpoint = resolve_inside(folder, options.checkpoint, "checkpoint=")
        if not checkpoint.is_file():
            names = ", ".join(sorted(p.name for p in folder.glob("checkpoint_*.pth"))) or "none"
            raise AdapterError(f"{checkpoint} does not exist; the run has {names}")
        return checkpoint
    if (folder / _FINAL_CHECKPOINT).is_file():
        return folder / _FINAL_CHECKPOINT
    files = folder.glob("checkpoint_*.pth")
    steps = {
        int(match[1]): file for file in files if (match := _CHECKPOINT_NAME.fullmatch(file.name))
    }
    if not steps:
        raise AdapterError(
            f"{folder} holds no {_FINAL_CHECKPOINT} and no checkpoint_NNNNN.pth; give a run that "
            f"was saved"
        )
    return steps[max(steps)]


def _find_data(config: Mapping[str, Any], folder: Path, options: RunOptions) -> Path:
    """Return the folder of the processed scene."""
    if options.data is not None:
        data = Path(options.data).expanduser()
        if not data.is_dir():
            raise AdapterError(f"data={options.data}: no such folder; give {_DATA_DESCRIPTION}")
        return data
    root = lookup(config, "data.data_root")
    scene = lookup(config, "data.scene_idx")
    reason = "its config.yaml does not say where the data is"
    if isinstance(root, str) and isinstance(scene, int | str):
        name = f"{int(scene):03d}" if str(scene).isdecimal() else str(scene)
        # A relative root is one from where training was started, often a folder above the run.
        for parent in (Path.cwd(), *folder.absolute().parents):
            data = parent / root / name
            if data.is_dir():
                return data
        reason = f"{Path(root) / name} of its config.yaml is not here"
    raise AdapterError(
        f"{folder / 'config.yaml'}: the run needs the processed data it was trained on, and "
        f"{reason}; give the scene's folder as data=DIR"
    )


def _frame_range(config: RunConfig, data: Path, config_file: Path) -> range:
    """Return the numbers of the run's frames."""
    start = config.start_timestep
    end = config.end_timestep
    if end == -1:
        folders = [data / name for name in ("ego_pose", "lidar_pose") if (data / name).is_dir()]
        if not folders:
            raise AdapterError(
                f"{data} holds neither ego_pose nor lidar_pose; expected a processed scene, with "
                f"a pose for each frame"
            )
        end = sum(1 for p in folders[0].iterdir() if _POSE_NAME.fullmatch(p.name)) - 1
    if not 0 <= start <= end:
        raise AdapterError(
            f"{config_file}: frames data.start_timestep {start} to data.end_timestep {end} of "
            f"{data} are none; is it the scene that the run was trained on?"
        )
    return range(start, end + 1)


# ---- What a run learnt for each image: its colours' affine map and its camera's pose -------------
# Image i of a run is frame * cameras + camera, both counted from 0 as the run has them.

_POSE_MODELS = ("CamPosePerturb", "CamPose")  # in the order in which they apply


@dataclass(frozen=True, eq=False)
class ImageCorrections:
    """Corrections that training learnt for each image.

    Attributes:
        color_maps: float32 [n, 3, 4] of each image. None without any.
        mean_color_map: float32 [3, 4], for images that were not trained on. None without any.
        pose_changes: float64 [n, 4, 4], by which world_from_camera is multiplied on its right. None
            for no change.
        problems: one sentence each.
    """

    color_maps: np.ndarray | None = None
    mean_color_map: np.ndarray | None = None
    pose_changes: np.ndarray | None = None
    problems: tuple[str, ...] = ()

    def maps_of(
        self, run: Run, frames: tuple[Frame, ...]
    ) -> tuple[dict[str, torch.Tensor], dict[tuple[str, int], torch.Tensor]]:
        """Return colour maps by camera name, and those of trained images by name and time."""
        if self.color_maps is None or self.mean_color_map is None:
            return {}, {}
        names = [run.convention.cameras[number].name for number in run.cameras]
        by_camera = {name: torch.from_numpy(self.mean_color_map.copy()) for name in names}
        by_image = {
            (name, frame.cameras[name].timestamp_ns): torch.from_numpy(self.color_maps[i].copy())
            for frame in frames
            if not run.is_held_out(frame.index)
            for i, name in enumerate(names, (frame.index - run.frames.start) * len(run.cameras))
        }
        return by_camera, by_image


def read_corrections(models: Mapping[str, Any], run: Run, where: str) -> ImageCorrections:
    """Read the corrections in a checkpoint's models."""
    count = len(run.frames) * len(run.cameras)
    corrections = ImageCorrections()
    if "Affine" in models:
        corrections = _read_color_maps(
            dictionary_in(models, "Affine", where), count, f"{where} Affine"
        )
    pose_changes = None
    for name in _POSE_MODELS:
        if name in models:
            pose_change = _pose_changes(
                dictionary_in(models, name, where), count, f"{where} {name}"
            )
            pose_changes = pose_change if pose_changes is None else pose_changes @ pose_change
    return dataclasses.replace(corrections, pose_changes=pose_changes)


def _read_color_maps(content: Mapping[str, Any], count: int, where: str) -> ImageCorrections:
    """Compute the colour maps from an embedding and a network of two layers."""
    embedding = finite_array(content, "embedding.weight", (count, None), where)
    hidden_weights = finite_array(content, "decoder.0.weight", (None, None), where)
    num_hidden, num_inputs = hidden_weights.shape
    if num_inputs == embedding.shape[1] + 2:
        problem = (
            f"{where}: the colour corrections differ over the image (pixel_affine); they are "
            f"left out, so images have the model's own colours"
        )
        return ImageCorrections(problems=(problem,))
    if num_inputs != embedding.shape[1]:
        raise AdapterError(
            f"{where}: decoder.0.weight must take the {embedding.shape[1]} numbers of "
            f"embedding.weight; it takes {num_inputs}"
        )
    hidden_bias = finite_array(content, "decoder.0.bias", (num_hidden,), where)
    output_weights = finite_array(content, "decoder.2.weight", (12, num_hidden), where)
    output_bias = finite_array(content, "decoder.2.bias", (12,), where)

    def decode(embedding: np.ndarray) -> np.ndarray:
        values = (
            np.maximum(embedding @ hidden_weights.T + hidden_bias, 0) @ output_weights.T
            + output_bias
        )
        return (values.reshape(-1, 3, 4) + np.eye(3, 4)).astype(np.float32)

    return ImageCorrections(decode(embedding), decode(embedding.mean(0, keepdims=True))[0])


def _pose_changes(content: Mapping[str, Any], count: int, where: str) -> np.ndarray:
    """Return rigid transforms, float64 [n, 4, 4], from 3 numbers of a shift and 6 of a rotation
    each.

    The 6 numbers, from which those of the identity were subtracted, are the rotation's first two
    rows before Gram and Schmidt (Zhou et al. 2019, "On the Continuity of Rotation Representations
    in Neural Networks", sec. B).
    """
    values = finite_array(content, "embeds.weight", (count, 9), where)
    first_row = values[:, 3:6] + [1.0, 0, 0]
    second_row = values[:, 6:9] + [0, 1.0, 0]
    with np.errstate(all="ignore"):
        x = first_row / np.linalg.norm(first_row, axis=1, keepdims=True)
        y = second_row - (x * second_row).sum(1, keepdims=True) * x
        y = y / np.linalg.norm(y, axis=1, keepdims=True)
    changes = np.tile(np.eye(4), (count, 1, 1))
    changes[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    changes[:, :3, 3] = values[:, :3]
    if not np.isfinite(changes).all():
        raise AdapterError(f"{where}: embeds.weight holds rows that are no rotation")
    return changes


# ---- Where car and cameras were ------------------------------------------------------------------

# Time between frames.
FRAME_NS = 100_000_000
# Largest slope that counts as level: a centimetre in 100 m.
_MAX_LEVEL_SLOPE = 1e-4
# Cosine of a slope that no road has.
_MIN_UP_COSINE = 0.9


def model_from_dataset(run: Run) -> np.ndarray:
    """Return the rigid transform from the dataset's world to the model's, float64 [4, 4]."""
    return np.linalg.inv(_world_pose(run, run.frames.start))


def scene_from_model(run: Run) -> np.ndarray:
    """Return the rotation from the model's world to the scene's, float64 [3, 3].

    It is a permutation of axes if that leaves z practically up, or if the dataset's z cannot be up.
    """
    axes = run.convention.scene_from_model
    up = _up_of_dataset(run)
    if up[2] < _MIN_UP_COSINE or np.hypot(up[0], up[1]) < _MAX_LEVEL_SLOPE:
        return axes
    return rotation_to_z_up(up) @ axes


def _up_of_dataset(run: Run) -> np.ndarray:
    """Return the dataset's z axis, a unit vector in the first frame's car (x forward, y left, z
    up).
    """
    up = run.convention.scene_from_model @ model_from_dataset(run)[:3, 2]
    return up / np.linalg.norm(up)


def scene_from_dataset(run: Run) -> np.ndarray:
    """Return the rigid transform from the dataset's world to the scene's, float64 [4, 4]."""
    return _rigid_transform(scene_from_model(run)) @ model_from_dataset(run)


def read_drive(
    run: Run,
    numbers: tuple[int, ...],
    corrections: ImageCorrections,
    lens: LensChoice = UNDISTORTED_LENS,
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Read frames, with the cameras as the model corrects them.

    A sentence is returned for each kind of thing that is missing.

    Args:
        run: the run.
        numbers: the frames.
        corrections: the model's changes of poses and colours.
        lens: recorded for cameras with the lenses of the data, where the model was trained on
            images without their distortion.
    """
    scene_from_dataset_matrix = scene_from_dataset(run)
    problems: list[str] = []
    if _up_of_dataset(run)[2] < _MIN_UP_COSINE:
        problems.append(
            f"{run.data}: z of its world is not what is up for the first frame's car, which is "
            f"therefore taken to stand level"
        )
    cameras = [_read_camera(run, position, problems, lens) for position in range(len(run.cameras))]
    frames = []
    missing_images = []
    for number in numbers:
        frame_cameras = {}
        paths = {}
        for position, camera in enumerate(cameras):
            file = run.data / "images" / f"{number:03d}_{run.cameras[position]}.jpg"
            if file.is_file():
                paths[camera.name] = str(file)
            else:
                missing_images.append(file.name)
            world_from_camera = scene_from_dataset_matrix @ _dataset_from_camera(
                run, number, position
            )
            if corrections.pose_changes is not None:
                image = (number - run.frames.start) * len(cameras) + position
                world_from_camera = world_from_camera @ corrections.pose_changes[image]
            pose = torch.from_numpy(world_from_camera)
            frame_cameras[camera.name] = dataclasses.replace(
                camera, camera_from_world=invert_rigid(pose), timestamp_ns=number * FRAME_NS
            )
        world_from_ego = (
            scene_from_dataset_matrix
            @ _world_pose(run, number)
            @ _rigid_transform(run.convention.pose_from_ego)
        )
        frames.append(
            Frame(number, number * FRAME_NS, torch.from_numpy(world_from_ego), frame_cameras, paths)
        )
    if missing_images:
        problems.append(
            f"{run.data / 'images'}: {len(missing_images)} of {len(numbers) * len(cameras)} images "
            f"are missing, the first {missing_images[0]}; their cameras are there without them"
        )
    return tuple(frames), tuple(problems)


def dataset_from_lidar(run: Run, number: int) -> np.ndarray:
    """Return the pose of a frame's returns in the dataset's world: the car's, or lidar_pose of
    nuScenes.
    """
    folder = "lidar_pose" if run.convention.world_of_front_camera else "ego_pose"
    return read_pose(run.data / folder / f"{number:03d}.txt")


def _world_pose(run: Run, number: int) -> np.ndarray:
    """Return dataset_from_ego of a frame, or dataset_from_front_camera if that is the world's."""
    if run.convention.world_of_front_camera:
        return read_pose(run.data / "extrinsics" / f"{number:03d}_0.txt")
    return read_pose(run.data / "ego_pose" / f"{number:03d}.txt")


def _dataset_from_camera(run: Run, number: int, position: int) -> np.ndarray:
    """Return dataset_from_camera of a frame, in OpenCV's axes, float64 [4, 4]."""
    folder = run.data / "extrinsics"
    camera = run.cameras[position]
    axes = _rigid_transform(run.convention.camera_from_opencv)
    if run.convention.poses_per_frame:
        return read_pose(folder / f"{number:03d}_{camera}.txt") @ axes
    return _world_pose(run, number) @ read_pose(folder / f"{camera}.txt") @ axes


def _read_camera(run: Run, position: int, problems: list[str], lens: LensChoice) -> Camera:
    """Read a camera's intrinsics. Its pose is the identity."""
    number = run.cameras[position]
    downscale = run.settings.downscale[position]
    camera_kind = run.convention.cameras[number]
    file = run.data / "intrinsics" / f"{number}.txt"
    values = read_numbers(file)
    if values.size < 4 or not (values[:2] > 0).all():
        raise AdapterError(
            f"{file} must hold fx fy cx cy k1 k2 p1 p2 k3 with fx, fy > 0; got {values.tolist()}"
        )
    is_undistorted = run.is_set("data.pixel_source.undistort")
    has_lens = lens == RECORDED_LENS and bool(values[4:].any()) and is_undistorted
    if values[4:].any() and not has_lens:
        training_kind = "as if it had none (undistort is off)"
        if is_undistorted:
            training_kind = "on images without it; the recorded images still have it"
        problems.append(
            f"camera {camera_kind.name}: its lens distortion is left out, as the model was trained "
            f"{training_kind}"
        )
    first_image = min((run.data / "images").glob(f"*_{number}.jpg"), default=None)
    header = None if first_image is None else read_image_header(first_image)
    if header is not None and header.orientation != 1:
        problems.append(
            f"images of camera {camera_kind.name} have an EXIF orientation, such as "
            f"{header.orientation} in {first_image}; it is ignored: poses and intrinsics are of "
            f"the pixels as they are stored"
        )
    if header is not None and (header.width, header.height) != (
        camera_kind.width,
        camera_kind.height,
    ):
        problems.append(
            f"{first_image} is of {header.width}x{header.height} pixels; drivestudio takes the "
            f"intrinsics of {camera_kind.name} to be for {camera_kind.width}x{camera_kind.height}, "
            f"and so does the scene"
        )
    width, height = (int(side / downscale) for side in (camera_kind.width, camera_kind.height))
    if min(width, height) < 1:
        raise AdapterError(
            f"{run.config_file}: data.pixel_source.downscale_when_loading of {camera_kind.name} is "
            f"{downscale:g}, which leaves no pixel of {camera_kind.width}x{camera_kind.height}"
        )
    identity = torch.eye(4, dtype=torch.float64)
    camera = Camera(
        camera_kind.name,
        camera_kind.width,
        camera_kind.height,
        *values[:4].tolist(),
        identity,
        lens=OpenCVLens.from_coefficients(values[4:9].tolist()) if has_lens else None,
    )
    return camera.resized(width, height)


def _rigid_transform(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation as a rigid transform [4, 4]."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    return transform


# ---- Labelled objects of the processed data: instances/instances_info.json -----------------------
# {"0": {"id": ..., "class_name": ..., "frame_annotations":
#     {"frame_idx": [...], "obj_to_world": [4 x 4, ...], "box_size": [[x, y, z], ...]}}, ...}


def _rows_validator(*shape: int) -> BeforeValidator:
    """Return a validator that reads JSON's numbers as float64 [T, *shape]. Rows may be flat."""

    def parse(value: object) -> np.ndarray:
        values = array_of(value)
        length = len(values) if values is not None and values.ndim else -1
        size = length * math.prod(shape)
        if values is None or values.size != size or not np.isfinite(values).all():
            raise ValueError(f"must hold {' x '.join(('T', *map(str, shape)))} numbers")
        return values.reshape(length, *shape)

    return BeforeValidator(parse)


def _annotation_field(name: str) -> Any:
    return Field(validation_alias=AliasPath("frame_annotations", name))


class Instance(BaseModel):
    """One object over the data's frames, in the dataset's world and its boxes' axes.

    frames: int64 [T], each once, ascending. poses: float64 [T, 4, 4]. sizes_m: float64 [T, 3] along
    the box's x, y and z.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    track_id: Annotated[str, BeforeValidator(str)] = Field(alias="id")
    label: Any = Field(None, alias="class_name")
    frames: Annotated[np.ndarray, _rows_validator()] = _annotation_field("frame_idx")
    poses: Annotated[np.ndarray, _rows_validator(4, 4)] = _annotation_field("obj_to_world")
    sizes_m: Annotated[np.ndarray, _rows_validator(3)] = _annotation_field("box_size")

    @model_validator(mode="after")
    def _check_consistency(self) -> Instance:
        counts = len(self.frames), len(self.poses), len(self.sizes_m)
        if len(set(counts)) != 1:
            raise ValueError(
                f"frame_idx, obj_to_world and box_size must be of equal length; got {counts}"
            )
        order = np.argsort(self.frames, kind="stable")
        numbers = self.frames.astype(np.int64)[order]
        if (numbers != self.frames[order]).any() or (np.diff(numbers, prepend=-1) < 1).any():
            raise ValueError("frame_idx must list frame numbers, each once")
        rotations = self.poses[:, :3, :3]
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0)
        if error > 1e-3 or (np.linalg.det(rotations) < 0).any() or (self.sizes_m <= 0).any():
            raise ValueError(
                "obj_to_world must be rotations and translations, and box_size > 0 (metres)"
            )
        self.frames, self.poses, self.sizes_m = numbers, self.poses[order], self.sizes_m[order]
        if not (isinstance(self.label, str) and self.label):
            self.label = "unknown"
        return self


class _Instances(RootModel[dict[Annotated[int, Field(ge=0, lt=10**9)], Instance]]):
    pass


def read_instances(data: Path) -> dict[int, Instance]:
    """Read all objects by their numbers, which are their keys in the file.

    It is empty without the file.
    """
    path = data / "instances" / "instances_info.json"
    return _read_instances(path, path.stat().st_mtime_ns) if path.is_file() else {}


@functools.lru_cache(maxsize=2)  # labels ask for one frame after the other
def _read_instances(path: Path, _written_ns: int) -> dict[int, Instance]:
    instances = validate(_Instances, read_json(path), path, "table of objects").root
    if len({instance.track_id for instance in instances.values()}) != len(instances):
        raise AdapterError(f"{path}: ids of objects repeat; process the data again")
    return dict(sorted(instances.items()))


# ---- Boxes and LiDAR of the processed data a run was trained on, in the scene's world ------------

_POINT_COLUMNS = (("x", "y", "z"), ("origin_x", "origin_y", "origin_z"))
_VECTOR_COLUMNS = ("flow_x", "flow_y", "flow_z")
# Returns that drops, flakes or fog made: not the ground, and without flow, as Waymo marks those.
_AIR_VALUES = {**dict.fromkeys(_VECTOR_COLUMNS, 0.0), "flow_class": -1.0, "ground": 0.0}


@dataclass(frozen=True, eq=False)
class DriveStudioLabels:
    """Labels of a run's data, read on demand.

    Boxes: x forward; track_ids are the data's ids; `instance` is the number in instances_info.json.
    Sweeps have the columns of Convention.lidar_columns. Points, and Waymo's origins and flows, are
    assumed to be in the frame of the car (nuScenes: lidar_pose) at that moment, as the project
    does.
    """

    run: Run

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame in the scene's world."""
        scene = scene_from_dataset(self.run)
        object_from_actor = self.run.convention.object_from_actor
        matches = [
            (number, instance, int(match_rows[0]))
            for number, instance in read_instances(self.run.data).items()
            if len(match_rows := np.flatnonzero(instance.frames == frame_index))
        ]
        if not matches:
            return Boxes.empty()
        numbers, instances, rows = zip(*matches, strict=True)
        poses = scene @ np.stack([i.poses[row] for i, row in zip(instances, rows, strict=True)])
        rotations = poses[:, :3, :3] @ object_from_actor
        sizes = np.stack([i.sizes_m[row] for i, row in zip(instances, rows, strict=True)])
        return Boxes(
            track_ids=tuple(instance.track_id for instance in instances),
            labels=tuple(instance.label for instance in instances),
            centers_m=poses[:, :3, 3].copy(),
            sizes_m=sizes @ np.abs(object_from_actor),
            quats=quat_from_rotmat(torch.from_numpy(rotations)).numpy(),
            attributes={"instance": np.array(numbers)},
        )

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the sweep of a frame in the scene's world, or None without a file."""
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
        for group in (*_POINT_COLUMNS, _VECTOR_COLUMNS):
            if group[0] not in columns:
                continue
            values = np.stack([columns[name] for name in group], axis=1).astype(np.float64)
            values = values @ pose[:3, :3].T + (0 if group == _VECTOR_COLUMNS else pose[:3, 3])
            columns |= {name: values[:, i].copy() for i, name in enumerate(group)}
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the sensor's position for each return, float64 [N, 3].

        Waymo's files have an origin for each return; nuScenes' sensor is in lidar_pose. The other
        datasets' files have returns in the car's frame and do not say where the sensor is on it:
        the result is None.
        """
        names = _POINT_COLUMNS[1]
        if all(name in sweep.columns for name in names):
            return np.stack([np.asarray(sweep.columns[name], np.float64) for name in names], axis=1)
        if not self.run.convention.world_of_front_camera:
            return None
        return np.broadcast_to(self._world_from_lidar(frame_index)[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Return the file of a frame's sweep."""
        file = self._lidar_file(frame_index)
        return (file,) if file.is_file() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return the content of a file that holds a weathered sweep."""
        names = self.run.convention.lidar_columns
        records = np.fromfile(file, "<f4").reshape(-1, len(names))
        air_values = {name: value for name, value in _AIR_VALUES.items() if name in names}
        return stored_records(
            records, names, sweep, self._world_from_lidar(frame_index), air_values
        )

    def _lidar_file(self, frame: int) -> Path:
        return self.run.data / "lidar" / f"{frame:03d}.bin"

    def _world_from_lidar(self, frame: int) -> np.ndarray:
        return scene_from_dataset(self.run) @ dataset_from_lidar(self.run, frame)
