"""Labelled objects of the processed data: instances/instances_info.json.

{"0": {"id": ..., "class_name": ..., "frame_annotations":
    {"frame_idx": [...], "obj_to_world": [4 x 4, ...], "box_size": [[x, y, z], ...]}}, ...}
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapters.plain_files import array_of, read_json
from augment.errors import AdapterError


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
