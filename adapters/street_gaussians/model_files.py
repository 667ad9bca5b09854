"""Where the files of a trained model are."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from adapters.street_gaussians.config import newest_config, read_config
from adapters.street_gaussians.options import ModelOptions
from adapters.street_gaussians.records import ModelConfig
from augment.errors import AdapterError

_PTH, _PLY = re.compile(r"iteration_(\d+)\.pth"), re.compile(r"iteration_(\d+)")
_DATA_FOLDERS = ("ego_pose", "extrinsics", "track")


@dataclass(frozen=True)
class ModelFiles:
    """weights: a .pth or .ply. data: the folder of the dataset."""

    folder: Path
    weights: Path
    iteration: int | None
    config_file: Path
    config: ModelConfig
    data: Path


def is_dataset(path: Path) -> bool:
    """Whether a path is a dataset's folder and no model's."""
    return all((path / name).is_dir() for name in _DATA_FOLDERS) and not _saved(path)


def find_model(path: Path, options: ModelOptions) -> ModelFiles:
    """The files of a model, given its folder or its weights.

    Raises:
        AdapterError: no weights, no such iteration, no configuration, or no dataset.
    """
    folder, weights, iteration = _weights(path, options)
    config_file = newest_config(folder)
    config = read_config(config_file)
    return ModelFiles(
        folder, weights, iteration, config_file, config, _data(config, config_file, options)
    )


def find_data(path: Path, options: ModelOptions) -> Path:
    """The dataset of a model.

    Raises:
        AdapterError: as find_model.
    """
    return find_model(path, options).data


def _weights(path: Path, options: ModelOptions) -> tuple[Path, Path, int | None]:
    """The model's folder, its weights and their iteration, where their name says it."""
    if path.is_file():
        return _given_file(path, options)
    saved = _saved(path)
    if not saved:
        raise AdapterError(
            f"{path} is no Street Gaussians model and no dataset of one: expected "
            f"trained_model/iteration_N.pth or point_cloud/iteration_N/point_cloud.ply in it, or "
            f"{', '.join(f'{name}/' for name in _DATA_FOLDERS)}"
        )
    kind = options.weights or ("pth" if any(kind == "pth" for kind, _ in saved) else "ply")
    of_kind = {number: file for (k, number), file in saved.items() if k == kind}
    if not of_kind:
        raise AdapterError(f"{path} holds no .{kind} of a saved iteration; give the other weights=")
    iteration = max(of_kind) if options.iteration is None else options.iteration
    if iteration not in of_kind:
        known = ", ".join(map(str, sorted(of_kind)))
        raise AdapterError(f"{path} has no .{kind} of iteration {iteration}; it has {known}")
    return path, of_kind[iteration], iteration


def _given_file(path: Path, options: ModelOptions) -> tuple[Path, Path, int | None]:
    if options.iteration is not None or options.weights is not None:
        raise AdapterError(
            f"{path} is one file, so iteration= and weights= say nothing; give the model's folder "
            f"or leave them out"
        )
    if path.suffix.lower() not in (".pth", ".ply"):
        raise AdapterError(f"{path}: expected a model's folder, .pth or .ply")
    is_pth = path.suffix.lower() == ".pth"
    match = _PTH.fullmatch(path.name) if is_pth else _PLY.fullmatch(path.parent.name)
    folders = path.absolute().parents[:3]
    folder = next((folder for folder in folders if (folder / "configs").is_dir()), folders[-1])
    return folder, path, int(match[1]) if match else None


def _saved(folder: Path) -> dict[tuple[str, int], Path]:
    """Weights by kind and iteration."""
    found = {}
    for file in folder.glob("trained_model/iteration_*.pth"):
        if match := _PTH.fullmatch(file.name):
            found["pth", int(match[1])] = file
    for file in folder.glob("point_cloud/iteration_*/point_cloud.ply"):
        if match := _PLY.fullmatch(file.parent.name):
            found["ply", int(match[1])] = file
    return found


def _data(config: ModelConfig, config_file: Path, options: ModelOptions) -> Path:
    if options.data is not None:
        if not options.data.is_dir():
            raise AdapterError(f"data={options.data}: no such folder; expected the model's dataset")
        return options.data
    if config.source_path and Path(config.source_path).is_dir():
        return Path(config.source_path)
    raise AdapterError(
        f"{config_file}: source_path {config.source_path!r} is not here; the model needs poses, "
        f"tracks and cameras of its dataset. Give its folder as data=DIR"
    )
