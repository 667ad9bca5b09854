"""A run's folder: its checkpoint, what of its config.yaml decides how it is read, its data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapters.drivestudio.config import integer_of, lookup, needed, read_config, text_of
from adapters.drivestudio.conventions import Convention, convention_of
from adapters.drivestudio.options import RunOptions
from adapters.plain_files import inside
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
