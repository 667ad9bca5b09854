"""A run's config.yaml, and values of it by dotted keys such as `data.scene_idx`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from adapters.plain_files import read_yaml
from augment.errors import AdapterError


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
