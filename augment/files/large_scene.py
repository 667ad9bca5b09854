"""Writes scenes too large for memory, piece by piece, as scene folders with levels of detail."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.detail.lod import LevelPiece, batches, build_levels, square_order
from augment.errors import SceneError
from augment.files.level_file import level_arrays
from augment.files.scene_file import save_scene
from augment.scene.scene import Gaussians, Scene


def save_large_scene(scene: Scene, pieces: Iterable[Gaussians], folder: str | Path) -> None:
    """Write a scene folder with levels of detail, its background piece by piece.

    Never more than one piece and some 30 bytes a splat are in memory. The folder's disk must hold
    the scene twice for a while.

    Args:
        scene: everything else of the scene; its own background is not written.
        pieces: the background.
        folder: the folder to write.

    Raises:
        SceneError, OutputError: as augment.files.scene_file.save_scene.
    """
    folder = Path(folder).absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".levels-", dir=folder.parent) as temporary:
        spool = _Spool(Path(temporary))
        background = spool.keep(_pieces_of_level_0(pieces)).gaussians
        order = square_order(background)[1]
        pieces = (background.select(torch.from_numpy(order[rows])) for rows in batches(len(order)))
        levels = build_levels(
            spool.keep(_pieces_of_level_0(pieces)).gaussians, store_piece=spool.keep
        )
        complete_scene = replace(scene, background=levels.levels[0].gaussians)
        save_scene(complete_scene, folder, levels=level_arrays(levels), finest_m=levels.finest_m)


def _pieces_of_level_0(pieces: Iterable[Gaussians]) -> Iterator[LevelPiece]:
    """Yield pieces without levels."""
    for piece in pieces:
        yield LevelPiece(piece, np.zeros(0, np.int32), np.zeros(0, np.int64))


class _Spool:
    """Stores the splats of pieces in files, one for each array, and maps them into memory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._spool_numbers = itertools.count()

    def keep(self, pieces: Iterable[LevelPiece]) -> LevelPiece:
        """Write pieces into files and return them as one mapped piece."""
        spool_number = next(self._spool_numbers)
        row_numbers = list[tuple[np.ndarray, np.ndarray]]()
        array_types = {}
        for gaussians, *numbers in pieces:
            for field in fields(Gaussians):
                value: Tensor | None = getattr(gaussians, field.name)
                if value is not None:
                    array = value.numpy()
                    array_types[field.name] = (array.dtype, array.shape[1:])
                    with (self._folder / f"{spool_number}.{field.name}").open("ab") as file:
                        file.write(np.ascontiguousarray(array).data)
            row_numbers.append((numbers[0], numbers[1]))
        if not array_types:
            raise SceneError("a scene needs at least one piece of background to be written; got 0")
        mapped = {
            name: torch.from_numpy(
                np.memmap(self._folder / f"{spool_number}.{name}", dtype, "c").reshape(-1, *shape)
            )
            for name, (dtype, shape) in array_types.items()
        }
        stands_for, keys = (np.concatenate(arrays) for arrays in zip(*row_numbers, strict=True))
        return LevelPiece(Gaussians(**mapped), stands_for, keys)
