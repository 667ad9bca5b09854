"""A run's folder: its checkpoint, what of its config.yaml decides how it is read, its data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from adapters.drivestudio.conventions import Convention, convention_of
from adapters.drivestudio.options import RunOptions
from adapters.plain_files import inside, read_text
from augment.errors import AdapterError

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
        return _lookup(self.config, "trainer.render.antialiased") is True

    def sh_interval(self, node: str) -> int:
        """Steps of training for each degree of a node's spherical harmonics."""
        for name in (f"model.{node}.ctrl", "trainer.gaussian_ctrl_general_cfg"):
            value = _lookup(self.config, f"{name}.sh_degree_interval")
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
    config = _read_config(config_file)
    where = str(config_file)
    convention = convention_of(_text(config, "data.dataset", where), where)
    cameras = _camera_numbers(config, convention, where)
    checkpoint = _find_checkpoint(path, folder, options)
    data = _find_data(config, folder, options, where)
    stride = _integer(config, "data.pixel_source.test_image_stride", where, otherwise=0)
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
        undistort=_lookup(config, "data.pixel_source.undistort") is True,
        test_stride=stride,
        config=config,
    )


def _read_config(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise AdapterError(
            f"{path} does not exist; a drivestudio run is a folder with config.yaml and "
            f"checkpoint_*.pth"
        )
    try:
        config = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise AdapterError(f"{path} is no readable YAML: {error}") from None
    if not isinstance(config, dict):
        raise AdapterError(f"{path} must hold a mapping; got {type(config).__name__}")
    return config


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
    root, scene = _lookup(config, "data.data_root"), _lookup(config, "data.scene_idx")
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
    start = _integer(config, "data.start_timestep", where)
    end = _integer(config, "data.end_timestep", where)
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
    numbers = _needed(config, key, where)
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
    factors = _needed(config, key, where)
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


def _lookup(config: Mapping[str, Any], key: str) -> Any:
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


def _needed(config: Mapping[str, Any], key: str, where: str) -> Any:
    value = _lookup(config, key)
    if value is None:
        raise AdapterError(f"{where} lacks {key}; expected the config that drivestudio saved")
    return value


def _text(config: Mapping[str, Any], key: str, where: str) -> str:
    value = _needed(config, key, where)
    if not isinstance(value, str):
        raise AdapterError(f"{where}: {key} must be a text; got {value!r}")
    return value


def _integer(
    config: Mapping[str, Any], key: str, where: str, *, otherwise: int | None = None
) -> int:
    value = _lookup(config, key)
    if value is None and otherwise is not None:
        return otherwise
    value = _needed(config, key, where)
    if type(value) is not int:
        raise AdapterError(f"{where}: {key} must be a whole number; got {value!r}")
    return value
