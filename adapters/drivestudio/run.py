"""A run's folder: its checkpoint, what of its config.yaml decides how it is read, its data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from adapters.plain_files import inside, read_yaml
from augment.errors import AdapterError

# ---- A run's config.yaml, and values of it by dotted keys such as `data.scene_idx` ---------------


def read_config(path: Path) -> Mapping[str, Any]:
    """The whole of it.

    Raises:
        AdapterError: missing, no YAML, or no mapping.
    """
    what = "a drivestudio run is a folder with config.yaml and checkpoint_*.pth"
    return read_yaml(path, if_missing=what)


def lookup(config: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key; None where there is none.

    Raises:
        AdapterError: it still refers to something else, as in ${data.root}.
    """
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


def needed(config: Mapping[str, Any], key: str, where: str) -> Any:
    value = lookup(config, key)
    if value is None:
        raise AdapterError(f"{where} lacks {key}; expected the config that drivestudio saved")
    return value


def text_of(config: Mapping[str, Any], key: str, where: str) -> str:
    value = needed(config, key, where)
    if not isinstance(value, str):
        raise AdapterError(f"{where}: {key} must be a text; got {value!r}")
    return value


def integer_of(
    config: Mapping[str, Any], key: str, where: str, *, otherwise: int | None = None
) -> int:
    value = lookup(config, key)
    if value is None and otherwise is not None:
        return otherwise
    value = needed(config, key, where)
    if type(value) is not int:
        raise AdapterError(f"{where}: {key} must be a whole number; got {value!r}")
    return value


# ---- What a drivestudio URI may ask for, as in `drivestudio:<run>?data=DIR&frames=0:50` ----------

_KEYS = {
    "data": "the processed scene's folder, such as data/waymo/processed/training/023",
    "checkpoint": "the name of a checkpoint in the run, such as checkpoint_15000.pth",
    "frames": "first:stop, numbers of the data's frames, either of them left out at will",
}
_FRAMES = re.compile(r"(\d*):(\d*)", re.ASCII)


@dataclass(frozen=True)
class RunOptions:
    """Options of one opening; None where the run decides. stop_frame is excluded."""

    data: str | None = None
    checkpoint: str | None = None
    first_frame: int = 0
    stop_frame: int | None = None

    @staticmethod
    def from_query(query: dict[str, str]) -> RunOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value that cannot be used.
        """
        unknown = sorted(set(query) - set(_KEYS))
        if unknown:
            known = "; ".join(f"{key}: {kind}" for key, kind in _KEYS.items())
            raise AdapterError(f"drivestudio: unknown option {unknown[0]!r}; known are {known}")
        for key in ("data", "checkpoint"):
            if query.get(key) == "":
                raise AdapterError(f"drivestudio: {key} must be {_KEYS[key]}; got ''")
        first, stop = 0, None
        if "frames" in query:
            match = _FRAMES.fullmatch(query["frames"])
            first, stop = (int(t) if t else None for t in match.groups()) if match else (0, 0)
            first = first or 0
            if stop is not None and stop <= first:
                raise AdapterError(
                    f"drivestudio: frames must be {_KEYS['frames']}; got {query['frames']!r}"
                )
        return RunOptions(query.get("data"), query.get("checkpoint"), first, stop)

    def select(self, numbers: range, where: str) -> tuple[int, ...]:
        """Those of the run's frames that the scene has.

        Raises:
            AdapterError: none is left.
        """
        stop = numbers.stop if self.stop_frame is None else self.stop_frame
        kept = tuple(number for number in numbers if self.first_frame <= number < stop)
        if not kept:
            raise AdapterError(
                f"{where}: frames={self.first_frame}:{stop} selects none of the run's frames "
                f"{numbers[0]} to {numbers[-1]}"
            )
        return kept


# ------------------------------------------------------------------------------------------------
# What drivestudio's processed data of each dataset means: cameras, axes, worlds, LiDAR columns
# Facts of the project's loaders and of its table of image sizes, to which it resizes whatever
# images
# it finds. The model's world is the first frame's pose of `world`, undone.

# Rows: x forward, y left, z up, in OpenCV's camera axes x right, y down, z forward.
FLAT_FROM_OPENCV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Columns: x forward, y left, z up, in axes x right, y forward, z up.
_RIGHT_FORWARD_FROM_FLAT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class CameraKind:
    """A camera as the dataset has it. width, height: pixels that its intrinsics are given for."""

    name: str
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Convention:
    """How one dataset's processed data is to be read.

    cameras: by number. lidar_columns: of lidar/{frame}.bin, float32. poses_per_frame:
    extrinsics/{frame}_{camera}.txt is world_from_camera; else extrinsics/{camera}.txt is
    ego_from_camera. world_of_front_camera: the model's world is camera 0's first frame, else the
    first ego_pose. camera_from_opencv: [3, 3], the axes of the extrinsics. scene_from_model:
    [3, 3], a permutation of axes that turns the model's world z up, as far as the car stands level.
    pose_from_ego: [3, 3], ego axes (x forward, y left, z up) in those of ego_pose, or of camera 0
    where that is the world's. object_from_actor: [3, 3], x forward, y left, z up in the axes of its
    boxes.
    """

    cameras: tuple[CameraKind, ...]
    lidar_columns: tuple[str, ...]
    poses_per_frame: bool = False
    world_of_front_camera: bool = False
    camera_from_opencv: np.ndarray = field(default_factory=lambda: np.eye(3))
    scene_from_model: np.ndarray = field(default_factory=lambda: np.eye(3))
    pose_from_ego: np.ndarray = field(default_factory=lambda: np.eye(3))
    object_from_actor: np.ndarray = field(default_factory=lambda: np.eye(3))


def convention_of(dataset: str, where: str) -> Convention:
    """The convention of `data.dataset`; where: the file that says so, for messages.

    Raises:
        AdapterError: a dataset that is not known here.
    """
    found = _CONVENTIONS.get(dataset.lower())
    if found is None:
        raise AdapterError(
            f"{where}: data.dataset is {dataset!r}; its axes are not known here. Known datasets: "
            f"{', '.join(_CONVENTIONS)}"
        )
    return found


def _cameras(width: int, height: int, *names: str) -> tuple[CameraKind, ...]:
    return tuple(CameraKind(name, width, height) for name in names)


_XYZI = ("x", "y", "z", "intensity")
_CONVENTIONS = {
    "waymo": Convention(
        cameras=(
            *_cameras(1920, 1280, "front_camera", "front_left_camera", "front_right_camera"),
            *_cameras(1920, 866, "left_camera", "right_camera"),
        ),
        lidar_columns=(
            *("origin_x", "origin_y", "origin_z", "x", "y", "z", "flow_x", "flow_y", "flow_z"),
            *("flow_class", "ground", "intensity", "elongation", "laser_id"),
        ),
        camera_from_opencv=FLAT_FROM_OPENCV,
    ),
    "nuscenes": Convention(
        cameras=_cameras(
            *(1600, 900, "CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"),
            *("CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"),
        ),
        lidar_columns=_XYZI,
        poses_per_frame=True,
        world_of_front_camera=True,
        scene_from_model=FLAT_FROM_OPENCV,
        pose_from_ego=FLAT_FROM_OPENCV.T,
    ),
    "pandaset": Convention(
        cameras=_cameras(
            *(1920, 1080, "front_camera", "front_left_camera", "front_right_camera"),
            *("left_camera", "right_camera", "back_camera"),
        ),
        lidar_columns=(*_XYZI, "laser_id"),
        poses_per_frame=True,
        pose_from_ego=_RIGHT_FORWARD_FROM_FLAT,
        object_from_actor=_RIGHT_FORWARD_FROM_FLAT,
    ),
    "argoverse": Convention(
        cameras=(
            CameraKind("ring_front_center", 1550, 2048),
            *_cameras(2048, 1550, "ring_front_left", "ring_front_right", "ring_side_left"),
            *_cameras(2048, 1550, "ring_side_right", "ring_rear_left", "ring_rear_right"),
        ),
        lidar_columns=_XYZI,
    ),
    "kitti": Convention(cameras=_cameras(1242, 375, "CAM_LEFT", "CAM_RIGHT"), lidar_columns=_XYZI),
    "nuplan": Convention(
        cameras=_cameras(
            *(1920, 1080, "CAM_F0", "CAM_L0", "CAM_R0", "CAM_L1"),
            *("CAM_R1", "CAM_L2", "CAM_R2", "CAM_B0"),
        ),
        lidar_columns=(*_XYZI, "ring", "lidar_id"),
    ),
}


# ---- run -----------------------------------------------------------------------------------------

_CHECKPOINT = re.compile(r"checkpoint_(\d+)\.pth", re.ASCII)
_FINAL = "checkpoint_final.pth"
_POSE = re.compile(r"\d{3,}\.txt", re.ASCII)
_SH_INTERVAL = 1000  # steps after which the project adds a degree, unless a config says otherwise


@dataclass(frozen=True, eq=False)
class Run:
    """A trained run and the data it was trained on.

    frames: numbers of all its frames. cameras: numbers, in the model's order. downscale: of each
    camera's images. test_stride: every how manyeth frame was held out; 0 for none. config: the
    whole of it.
    """

    folder: Path
    checkpoint: Path
    data: Path
    convention: Convention
    frames: range
    cameras: tuple[int, ...]
    downscale: tuple[float, ...]
    undistort: bool
    test_stride: int
    config: Mapping[str, Any]

    @property
    def config_file(self) -> Path:
        return self.folder / "config.yaml"

    @property
    def antialiased(self) -> bool:
        return lookup(self.config, "trainer.render.antialiased") is True

    def sh_interval(self, node: str) -> int:
        """Steps of training for each degree of a node's spherical harmonics."""
        for name in (f"model.{node}.ctrl", "trainer.gaussian_ctrl_general_cfg"):
            value = lookup(self.config, f"{name}.sh_degree_interval")
            if isinstance(value, int) and value > 0:
                return value
        return _SH_INTERVAL

    def is_held_out(self, frame: int) -> bool:
        """Whether a frame was not trained on: every stride-th from the stride-th of the run on."""
        position = frame - self.frames.start
        return self.test_stride > 0 and position > 0 and position % self.test_stride == 0


def find_run(path: Path, options: RunOptions) -> Run:
    """The run of a folder or of a checkpoint in one.

    Raises:
        AdapterError: no config or checkpoint, a config that lacks something, or no data.
    """
    folder = path if path.is_dir() else path.parent
    config_file = folder / "config.yaml"
    config = read_config(config_file)
    where = str(config_file)
    convention = convention_of(text_of(config, "data.dataset", where), where)
    cameras = _camera_numbers(config, convention, where)
    checkpoint = _find_checkpoint(path, folder, options)
    data = _find_data(config, folder, options, where)
    stride = integer_of(config, "data.pixel_source.test_image_stride", where, otherwise=0)
    if stride < 0:
        raise AdapterError(
            f"{where}: data.pixel_source.test_image_stride must be >= 0; got {stride}"
        )
    return Run(
        folder=folder,
        checkpoint=checkpoint,
        data=data,
        convention=convention,
        frames=_frames(config, data, where),
        cameras=cameras,
        downscale=_downscale(config, len(cameras), where),
        undistort=lookup(config, "data.pixel_source.undistort") is True,
        test_stride=stride,
        config=config,
    )


def _find_checkpoint(path: Path, folder: Path, options: RunOptions) -> Path:
    if not path.is_dir():
        if options.checkpoint is not None:
            raise AdapterError(
                f"{path} is a checkpoint already; leave checkpoint={options.checkpoint} out, or "
                f"give the run's folder"
            )
        return path
    if options.checkpoint is not None:
        found = inside(folder, options.checkpoint, "checkpoint=")
        if not found.is_file():
            names = ", ".join(sorted(p.name for p in folder.glob("checkpoint_*.pth"))) or "none"
            raise AdapterError(f"{found} does not exist; the run has {names}")
        return found
    if (folder / _FINAL).is_file():
        return folder / _FINAL
    steps = {
        int(match[1]): file
        for file in folder.glob("checkpoint_*.pth")
        if (match := _CHECKPOINT.fullmatch(file.name))
    }
    if not steps:
        raise AdapterError(
            f"{folder} holds no {_FINAL} and no checkpoint_NNNNN.pth; give a run that was saved"
        )
    return steps[max(steps)]


def _find_data(config: Mapping[str, Any], folder: Path, options: RunOptions, where: str) -> Path:
    if options.data is not None:
        data = Path(options.data).expanduser()
        if not data.is_dir():
            raise AdapterError(
                f"data={options.data}: no such folder; give the processed scene's, such as "
                f"data/waymo/processed/training/023"
            )
        return data
    root, scene = lookup(config, "data.data_root"), lookup(config, "data.scene_idx")
    said = "its config.yaml does not say where the data is"
    if isinstance(root, str) and isinstance(scene, int | str):
        name = f"{int(scene):03d}" if str(scene).isdecimal() else str(scene)
        # A relative root is one from where training was started, often a folder above the run.
        for start in (Path.cwd(), *folder.absolute().parents):
            data = start / root / name
            if data.is_dir():
                return data
        said = f"{Path(root) / name} of its config.yaml is not here"
    raise AdapterError(
        f"{where}: the run needs the processed data it was trained on, and {said}; give the "
        f"scene's folder as data=DIR"
    )


def _frames(config: Mapping[str, Any], data: Path, where: str) -> range:
    """start_timestep to end_timestep, both included; -1 stands for the data's last."""
    start = integer_of(config, "data.start_timestep", where)
    end = integer_of(config, "data.end_timestep", where)
    if end == -1:
        folders = [data / name for name in ("ego_pose", "lidar_pose") if (data / name).is_dir()]
        if not folders:
            raise AdapterError(
                f"{data} holds neither ego_pose nor lidar_pose; expected a processed scene, with "
                f"a pose for each frame"
            )
        end = sum(1 for p in folders[0].iterdir() if _POSE.fullmatch(p.name)) - 1
    if not 0 <= start <= end:
        raise AdapterError(
            f"{where}: frames data.start_timestep {start} to data.end_timestep {end} of {data} are "
            f"none; is it the scene that the run was trained on?"
        )
    return range(start, end + 1)


def _camera_numbers(
    config: Mapping[str, Any], convention: Convention, where: str
) -> tuple[int, ...]:
    key = "data.pixel_source.cameras"
    numbers = needed(config, key, where)
    known = range(len(convention.cameras))
    is_list = isinstance(numbers, list) and len(numbers) > 0
    if (
        not is_list
        or len({*map(str, numbers)}) != len(numbers)
        or not all(type(number) is int and number in known for number in numbers)
    ):
        raise AdapterError(
            f"{where}: {key} must list numbers of cameras, 0 to {known[-1]}, each once; "
            f"got {numbers!r}"
        )
    return tuple(numbers)


def _downscale(config: Mapping[str, Any], cameras: int, where: str) -> tuple[float, ...]:
    key = "data.pixel_source.downscale_when_loading"
    factors = needed(config, key, where)
    if (
        not isinstance(factors, list)
        or len(factors) < cameras
        or not all(type(f) in (int, float) and math.isfinite(f) and f > 0 for f in factors)
    ):
        raise AdapterError(
            f"{where}: {key} must list a factor > 0 for each of the {cameras} cameras; "
            f"got {factors!r}"
        )
    return tuple(float(factor) for factor in factors[:cameras])
