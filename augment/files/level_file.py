"""Levels of detail of scenes too large for memory: scene folders that open without being read.

Beside the files of a scene folder, whose background is then sorted by squares (augment.detail.lod),

    levels.safetensors    of each level k: k.keys, k.starts, k.lows, k.highs, k.longest (Squares),
                          k.boxes.lows, k.boxes.highs, k.boxes.longest (SplatBoxes), k.parents; from
                          level 1 on also k.means, k.quats, ..., k.stands_for

holds the levels of detail, and the metadata `finest_m`. All arrays are mapped: a view reads the
squares that it needs. Their numbers are checked then; those of the whole background are checked
before an effect works on it. `augment.files.large_scene` writes such scenes.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.detail.lod import (
    CELLS_M,
    MAX_LEVELS,
    Level,
    Levels,
    SplatBoxes,
    Squares,
    slice_gaussians,
)
from augment.errors import SceneError
from augment.files.checkpoints import checked_tensor
from augment.files.tensors import read_tensors
from augment.render.cpu.order import CELL_SIZE
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians

LEVELS = "levels.safetensors"  # the file of a scene folder that holds the levels
# Shapes of one row of the arrays, by name.
_ROW_SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
_BOX_SHAPES = {"lows": (3,), "highs": (3,), "longest": ()}


def level_arrays(levels: Levels) -> dict[str, np.ndarray]:
    """Return the arrays of levels.safetensors."""
    arrays = dict[str, np.ndarray]()
    for number, level in enumerate(levels.levels):
        level_arrays = {f.name: getattr(level.squares, f.name) for f in fields(Squares)}
        level_arrays |= {f"boxes.{name}": box for name, box in level.boxes._asdict().items()}
        level_arrays["parents"] = level.parents
        if number > 0:  # the background is level 0
            gaussians = level.gaussians
            values = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
            level_arrays |= {
                name: value.numpy() for name, value in values.items() if value is not None
            }
            level_arrays["stands_for"] = level.stands_for
        arrays |= {
            f"{number}.{name}": np.ascontiguousarray(value) for name, value in level_arrays.items()
        }
    return arrays


def read_levels(path: Path, background: Gaussians) -> Levels:
    """Read the levels of a background whose numbers nobody has checked yet.

    Raises:
        SceneError: the file is damaged, or belongs to another background.
    """
    tensors, metadata = read_tensors(path)
    finest_m = metadata.get("finest_m", "")
    if finest_m not in map(repr, CELLS_M):
        raise SceneError(f"{path}: finest_m must be one of {CELLS_M}; got {finest_m!r}")
    if "0.parents" not in tensors:
        raise SceneError(
            f"{path} has no parents: another version of this package wrote it; write the scene "
            f"again"
        )
    levels = list[Level]()
    while f"{len(levels)}.keys" in tensors and len(levels) <= MAX_LEVELS:
        number = len(levels)
        count = len(background)
        gaussians = slice_gaussians(background, slice(None))
        stands_for = np.arange(count, dtype=np.int32)
        if number > 0:
            gaussians, stands_for = _splats(tensors, number, background, str(path))
        squares = _squares(
            tensors, number, len(gaussians), levels[-1].squares if levels else None, path
        )
        cells_shape = (-(-len(gaussians) // CELL_SIZE),)
        box_arrays = _boxes(tensors, f"{number}.boxes.", cells_shape, str(path))
        boxes = SplatBoxes(*(box_arrays[name] for name in SplatBoxes._fields))
        parents = _take(
            tensors, f"{number}.parents", (len(gaussians),), str(path), torch.int32
        ).numpy()
        level = Level(
            gaussians,
            stands_for,
            squares,
            boxes,
            parents,
            unchecked_file=str(path),
            num_part_splats=count,
        )
        levels.append(level)
    if tensors or not levels:
        raise SceneError(f"{path} must hold levels 0, 1, ... alone; got {sorted(tensors)[:5]}")
    return Levels(float(finest_m), tuple(levels))


def _take(tensors: dict[str, Tensor], name: str, shape: tuple, where: str, dtype: torch.dtype):
    """Remove a checked tensor from the file's tensors and return it."""
    values = checked_tensor(tensors, name, shape, where, dtype=dtype, error=SceneError)
    del tensors[name]
    return values


def _splats(
    tensors: dict[str, Tensor], number: int, background: Gaussians, where: str
) -> tuple[Gaussians, np.ndarray]:
    """Return the splats of one level and the rows of the background that they stand for."""
    stands_for = _take(tensors, f"{number}.stands_for", (None,), where, torch.int32)
    count = len(stands_for)
    num_sh = background.sh.shape[1]
    assert num_sh in NUM_SH_BY_DEGREE
    shapes = _ROW_SHAPES | {"sh": (num_sh, 3)}
    columns = {
        name: _take(tensors, f"{number}.{name}", (count, *shape), where, torch.float32)
        for name, shape in shapes.items()
    }
    if background.semantic is not None:
        columns["semantic"] = _take(tensors, f"{number}.semantic", (count,), where, torch.int16)
    return Gaussians(**columns), stands_for.numpy()


def _squares(
    tensors: dict[str, Tensor], number: int, num_splats: int, finer: Squares | None, path: Path
) -> Squares:
    """Return the checked squares of one level."""
    where = str(path)
    keys = _take(tensors, f"{number}.keys", (None,), where, torch.int64).numpy()
    starts = _take(tensors, f"{number}.starts", (len(keys) + 1,), where, torch.int64).numpy()
    squares = Squares(keys, starts, **_boxes(tensors, f"{number}.", (len(keys),), where))
    ends = (int(starts[0]), int(starts[-1]))
    has_known_parents = finer is None or bool(np.isin(keys, finer.keys >> 2).all())
    is_good = len(keys) > 0 and keys[0] >= 0 and (np.diff(keys) > 0).all() and has_known_parents
    is_good &= ends == (0, num_splats) and (np.diff(starts) >= 0).all()
    if not is_good:
        raise SceneError(
            f"{path}: the squares of level {number} must have increasing keys, those of the level "
            f"before without their last two bits, and starts from 0 to {num_splats}; got keys "
            f"{keys[:3]}..., starts {starts[:2]}...{starts[-1:]}; write the scene again"
        )
    return squares


def _boxes(
    tensors: dict[str, Tensor], prefix: str, shape: tuple[int], where: str
) -> dict[str, np.ndarray]:
    """Return the checked arrays of boxes."""
    arrays = {
        name: _take(tensors, prefix + name, (*shape, *box_shape), where, torch.float32).numpy()
        for name, box_shape in _BOX_SHAPES.items()
    }
    is_good = all(np.isfinite(box).all() for box in arrays.values())
    if not (
        is_good and (arrays["lows"] <= arrays["highs"]).all() and (arrays["longest"] > 0).all()
    ):
        raise SceneError(
            f"{where}: {prefix}lows, highs and longest must be boxes of positive standard "
            f"deviations; write the scene again"
        )
    return arrays
