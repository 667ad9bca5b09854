"""Scenes too large for memory: scene folders that are opened without being read.

Beside the files of a scene folder, whose background then lies square after square (augment.lod),

    levels.safetensors    of each level k: k.keys, k.starts, k.lows, k.highs, k.longest (Squares),
                          k.boxes.lows, k.boxes.highs, k.boxes.longest (Boxes), k.parents; from
                          level 1 on also k.means, k.quats, ..., k.stands_for

holds its levels of detail, and the metadata `finest_m`. All arrays are mapped: a view reads the
squares that it takes. Their numbers are looked at then, and the whole background's before an effect
works on it.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.errors import SceneError
from augment.files.checkpoints import tensor
from augment.files.scene_file import read_tensors, save_scene
from augment.lod import (
    CELLS_M,
    MAX_LEVELS,
    Boxes,
    Level,
    Levels,
    Piece,
    Squares,
    batches,
    build_levels,
    rows_of,
    square_order,
)
from augment.render.cpu.order import CELL
from augment.scene import SH_COUNTS, Gaussians, Scene

_COLUMNS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
_BOXES = {"lows": (3,), "highs": (3,), "longest": ()}


def save_large_scene(scene: Scene, pieces: Iterable[Gaussians], folder: str | Path) -> None:
    """Write a scene folder with levels, its background piece after piece, so that never more than a
    piece and some 30 bytes a splat are in memory. The folder's disk must hold it twice for a while.

    scene: everything else; its own background is not written.

    Raises:
        SceneError, OutputError: as augment.files.scene_file.save_scene.
    """
    folder = Path(folder).absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".levels-", dir=folder.parent) as temporary:
        spool = _Spool(Path(temporary))
        own = spool.keep(_numbered(pieces)).gaussians
        order = square_order(own)[1]
        pieces = (own.select(torch.from_numpy(order[rows])) for rows in batches(len(order)))
        levels = build_levels(spool.keep(_numbered(pieces)).gaussians, keep=spool.keep)
        whole = replace(scene, background=levels.levels[0].gaussians)
        save_scene(whole, folder, levels=_arrays(levels), finest_m=levels.finest_m)


def _numbered(pieces: Iterable[Gaussians]) -> Iterator[Piece]:
    for piece in pieces:
        yield Piece(piece, np.zeros(0, np.int32), np.zeros(0, np.int64))


class _Spool:
    """Keeps the splats of pieces in files, one an array, and maps them into memory."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, itertools.count()

    def keep(self, pieces: Iterable[Piece]) -> Piece:
        number, rest, kinds = next(self._count), list[tuple[np.ndarray, np.ndarray]](), {}
        for gaussians, *numbers in pieces:
            for own in fields(Gaussians):
                value: Tensor | None = getattr(gaussians, own.name)
                if value is not None:
                    array = value.numpy()
                    kinds[own.name] = (array.dtype, array.shape[1:])
                    with (self._folder / f"{number}.{own.name}").open("ab") as file:
                        file.write(np.ascontiguousarray(array).data)
            rest.append((numbers[0], numbers[1]))
        if not kinds:
            raise SceneError("a scene needs at least one piece of background to be written; got 0")
        mapped = {
            name: torch.from_numpy(
                np.memmap(self._folder / f"{number}.{name}", dtype, "c").reshape(-1, *shape)
            )
            for name, (dtype, shape) in kinds.items()
        }
        stands_for, keys = (np.concatenate(each) for each in zip(*rest, strict=True))
        return Piece(Gaussians(**mapped), stands_for, keys)


def _arrays(levels: Levels) -> dict[str, np.ndarray]:
    arrays = dict[str, np.ndarray]()
    for number, level in enumerate(levels.levels):
        own = {f.name: getattr(level.squares, f.name) for f in fields(Squares)}
        own |= {f"boxes.{name}": box for name, box in level.boxes._asdict().items()}
        own["parents"] = level.parents
        if number > 0:  # the background is level 0
            g = level.gaussians
            values = {f.name: getattr(g, f.name) for f in fields(g)}
            own |= {name: value.numpy() for name, value in values.items() if value is not None}
            own["stands_for"] = level.stands_for
        arrays |= {f"{number}.{name}": np.ascontiguousarray(value) for name, value in own.items()}
    return arrays


def read_levels(path: Path, background: Gaussians) -> Levels:
    """The levels of a background whose numbers nobody has looked at.

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
        number, count = len(levels), len(background)
        own, stands_for = rows_of(background, slice(None)), np.arange(count, dtype=np.int32)
        if number > 0:
            own, stands_for = _splats(tensors, number, background, str(path))
        squares = _squares(tensors, number, len(own), levels[-1].squares if levels else None, path)
        cells = (-(-len(own) // CELL),)
        found = _boxes(tensors, f"{number}.boxes.", cells, str(path))
        boxes = Boxes(*(found[name] for name in Boxes._fields))
        parents = _take(tensors, f"{number}.parents", (len(own),), str(path), torch.int32).numpy()
        level = Level(own, stands_for, squares, boxes, parents, unchecked=str(path), splats=count)
        levels.append(level)
    if tensors or not levels:
        raise SceneError(f"{path} must hold levels 0, 1, ... alone; got {sorted(tensors)[:5]}")
    return Levels(float(finest_m), tuple(levels))


def _take(tensors: dict[str, Tensor], name: str, shape: tuple, where: str, dtype: torch.dtype):
    found = tensor(tensors, name, shape, where, dtype=dtype, error=SceneError)
    del tensors[name]
    return found


def _splats(
    tensors: dict[str, Tensor], number: int, background: Gaussians, where: str
) -> tuple[Gaussians, np.ndarray]:
    stands_for = _take(tensors, f"{number}.stands_for", (None,), where, torch.int32)
    count, functions = len(stands_for), background.sh.shape[1]
    assert functions in SH_COUNTS
    shapes = _COLUMNS | {"sh": (functions, 3)}
    own = {
        name: _take(tensors, f"{number}.{name}", (count, *shape), where, torch.float32)
        for name, shape in shapes.items()
    }
    if background.semantic is not None:
        own["semantic"] = _take(tensors, f"{number}.semantic", (count,), where, torch.int16)
    return Gaussians(**own), stands_for.numpy()


def _squares(
    tensors: dict[str, Tensor], number: int, splats: int, finer: Squares | None, path: Path
) -> Squares:
    where = str(path)
    keys = _take(tensors, f"{number}.keys", (None,), where, torch.int64).numpy()
    starts = _take(tensors, f"{number}.starts", (len(keys) + 1,), where, torch.int64).numpy()
    squares = Squares(keys, starts, **_boxes(tensors, f"{number}.", (len(keys),), where))
    ends = (int(starts[0]), int(starts[-1]))
    known = finer is None or bool(np.isin(keys, finer.keys >> 2).all())
    is_good = len(keys) > 0 and keys[0] >= 0 and (np.diff(keys) > 0).all() and known
    is_good &= ends == (0, splats) and (np.diff(starts) >= 0).all()
    if not is_good:
        raise SceneError(
            f"{path}: the squares of level {number} must have increasing keys, those of the level "
            f"before without their last two bits, and starts from 0 to {splats}; got keys "
            f"{keys[:3]}..., starts {starts[:2]}...{starts[-1:]}; write the scene again"
        )
    return squares


def _boxes(
    tensors: dict[str, Tensor], prefix: str, shape: tuple[int], where: str
) -> dict[str, np.ndarray]:
    found = {
        name: _take(tensors, prefix + name, (*shape, *own), where, torch.float32).numpy()
        for name, own in _BOXES.items()
    }
    is_good = all(np.isfinite(box).all() for box in found.values())
    if not (is_good and (found["lows"] <= found["highs"]).all() and (found["longest"] > 0).all()):
        raise SceneError(
            f"{where}: {prefix}lows, highs and longest must be boxes of positive standard "
            f"deviations; write the scene again"
        )
    return found
