"""The configuration that a model was trained with: configs/config_{iteration:06d}.yaml."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from adapters.plain_files import read_yaml
from adapters.street_gaussians.records import CAMERA_NAMES, ModelConfig
from augment.errors import AdapterError

_NAME = re.compile(r"config_(\d+)\.yaml")
_MODES = {"color_correction": ("image", "sensor"), "pose_correction": ("image", "frame")}


def newest_config(model: Path) -> Path:
    """The configuration of a model's folder; of several the one of the latest iteration.

    Raises:
        AdapterError: there is none.
    """
    found = {}
    for path in (model / "configs").glob("config_*.yaml"):
        if match := _NAME.fullmatch(path.name):
            found[int(match[1])] = path
    if not found:
        raise AdapterError(
            f"{model / 'configs'} holds no config_*.yaml; which column of the actors' poses "
            f"belongs to which object depends on it. Copy the folder configs/ of the training's "
            f"output to {model}"
        )
    return found[max(found)]


def read_config(path: Path) -> ModelConfig:
    """What of a configuration decides how its model is read; keys it lacks have the project's
    defaults.

    Raises:
        AdapterError: no YAML, or a value of another kind; names the key.
    """
    values = _Values(read_yaml(path), path)
    default = ModelConfig()
    return ModelConfig(
        source_path=values.of("source_path", str, default.source_path),
        cameras=values.cameras(default.cameras),
        selected_frames=values.selected_frames(),
        use_tracker=values.of("data.use_tracker", bool, default.use_tracker),
        split_test=values.of("data.split_test", int, default.split_test),
        split_train=values.of("data.split_train", int, default.split_train),
        white_background=values.of("data.white_background", bool, default.white_background),
        sh_degree=values.of("model.gaussian.sh_degree", int, default.sh_degree),
        fourier_dim=values.of("model.gaussian.fourier_dim", int, default.fourier_dim),
        fourier_scale=values.of("model.gaussian.fourier_scale", float, default.fourier_scale),
        include_sky=values.of("model.nsg.include_sky", bool, default.include_sky),
        opt_track=values.of("model.nsg.opt_track", bool, default.opt_track),
        use_color_correction=values.of(
            "model.use_color_correction", bool, default.use_color_correction
        ),
        color_correction_mode=values.mode("color_correction", default.color_correction_mode),
        color_correction_mlp=values.of(
            "model.color_correction.use_mlp", bool, default.color_correction_mlp
        ),
        use_pose_correction=values.of(
            "model.use_pose_correction", bool, default.use_pose_correction
        ),
        pose_correction_mode=values.mode("pose_correction", default.pose_correction_mode),
    )


class _Values:
    """Values of a configuration by keys such as data.cameras, checked."""

    def __init__(self, tree: Mapping[str, Any], path: Path) -> None:
        self._tree, self._path = tree, path

    def _find(self, key: str) -> Any:
        """The value; None where it is absent or null."""
        found: Any = self._tree
        for name in key.split("."):
            if found is None:
                return None
            if not isinstance(found, Mapping):
                raise self._wrong(key, "a key inside a section", found)
            found = found.get(name)
        return found

    def of(self, key: str, kind: type, default: Any) -> Any:
        found = self._find(key)
        if found is None:
            return default
        if kind is float and type(found) is int:
            found = float(found)
        if type(found) is not kind:
            raise self._wrong(key, f"a value of type {kind.__name__}", found)
        if kind is float and not abs(found) < float("inf"):
            raise self._wrong(key, "a finite number", found)
        return found

    def mode(self, section: str, default: str) -> str:
        found = self.of(f"model.{section}.mode", str, default)
        if found not in _MODES[section]:
            raise self._wrong(f"model.{section}.mode", " or ".join(_MODES[section]), found)
        return found

    def cameras(self, default: tuple[int, ...]) -> tuple[int, ...]:
        found = self._find("data.cameras")
        if found is None:
            return default
        numbers = range(len(CAMERA_NAMES))
        is_list = isinstance(found, list) and all(type(n) is int and n in numbers for n in found)
        if not is_list or not found or len(set(found)) != len(found):
            expected = f"different camera numbers from 0 to {numbers[-1]}, such as [0, 1, 2]"
            raise self._wrong("data.cameras", expected, found)
        return tuple(found)

    def selected_frames(self) -> tuple[int, int] | None:
        found = self._find("data.selected_frames")
        if found is None:
            return None
        is_pair = isinstance(found, list) and [type(n) for n in found] == [int, int]
        if not is_pair or not 0 <= found[0] <= found[1]:
            raise self._wrong("data.selected_frames", "[first, last] or null", found)
        return found[0], found[1]

    def _wrong(self, key: str, expected: str, found: Any) -> AdapterError:
        return AdapterError(f"{self._path}: {key} must be {expected}; got {str(found)[:80]!r}")
