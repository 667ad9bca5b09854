"""Cells taken from grids, one list after another, and made into the record of a bed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from augment.scene import Gaussians
from augment.snow.buried import NumbersCells, find_buried
from augment.snow.cells import FLUSH, SnowCells
from augment.snow.in_threads import in_order, slices_of
from augment.snow.surface import Surface, normals_of
from augment.snow.surface_kernels import LINK


@dataclass(frozen=True, eq=False)
class CellList:
    """Cells of some grid: arrays of C rows, as SnowCells has them but for

    sides: int8 [C, 4], LINK where a cell of the same size is expected, else OPEN_EDGE or FLUSH.
    luminance: of the bare ground (see ground_light), NaN where not known.
    """

    centers_m: np.ndarray
    normals: np.ndarray
    sizes_m: np.ndarray
    edge_m: np.ndarray
    sides: np.ndarray
    luminance: np.ndarray
    tracks: np.ndarray
    banks: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.sizes_m)

    @staticmethod
    def joined(lists: Sequence[CellList]) -> CellList:
        """All of them, in order."""
        return CellList(
            **{
                field.name: np.concatenate([getattr(one, field.name) for one in lists])
                for field in fields(CellList)
            }
        )

    @staticmethod
    def empty() -> CellList:
        none = np.zeros(0, np.float32)
        return CellList(
            centers_m=np.zeros((0, 3)),
            normals=np.zeros((0, 3), np.float32),
            sizes_m=none,
            edge_m=none,
            sides=np.zeros((0, 4), np.int8),
            luminance=none,
            tracks=none,
            banks=np.zeros((0, 2), np.float32),
            semantic=np.zeros(0, np.int16),
        )


def cells_at(
    surface: Surface,
    rows: np.ndarray,
    columns: np.ndarray,
    *,
    sides: np.ndarray,
    luminance: np.ndarray | None = None,
    tracks: np.ndarray | None = None,
    banks: np.ndarray | None = None,
    classes: np.ndarray,
) -> CellList:
    """The cells of a surface at rows and columns [C]; the other arrays are the grid's."""
    x, y = surface.map.centers()
    count = len(rows)
    at = (rows, columns)
    height = surface.height_m[at].astype(np.float64)
    return CellList(
        centers_m=np.stack([x[columns], y[rows], height], 1),
        normals=normals_of(surface.slopes[at]).astype(np.float32),
        sizes_m=np.full(count, surface.map.cell_m, np.float32),
        edge_m=surface.edge_m[at],
        sides=sides[at],
        luminance=np.full(count, np.nan, np.float32) if luminance is None else luminance[at],
        tracks=np.zeros(count, np.float32) if tracks is None else tracks[at],
        banks=np.zeros((count, 2), np.float32) if banks is None else banks[at],
        semantic=classes[at],
    )


def _link(cells: CellList, numbers: NumbersCells, part: slice, neighbours: np.ndarray) -> None:
    """Put the numbers of the cells that part of the cells are linked to into int32 [P, 4]."""
    centers_m, sizes_m, sides = cells.centers_m[part, :2], cells.sizes_m[part], cells.sides[part]
    for side, step in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        linked = np.flatnonzero(sides[:, side] == LINK)
        to = numbers.at(centers_m[linked] + np.array(step) * sizes_m[linked, None])
        same = (to >= 0) & (cells.sizes_m[to] == sizes_m[linked])
        neighbours[linked, side] = np.where(same, to, FLUSH)


def make_cells(
    cells: CellList, light: np.ndarray, numbers: NumbersCells, gaussians: Gaussians
) -> SnowCells:
    """The record: neighbours found by their places, and the Gaussians that the cells bury."""
    neighbours = cells.sides.astype(np.int32)
    in_order(lambda part: _link(cells, numbers, part, neighbours[part]), slices_of(len(cells)))
    buried, buried_by = find_buried(
        gaussians,
        numbers,
        centers_m=cells.centers_m,
        normals=cells.normals,
        sizes_m=cells.sizes_m,
        edge_m=cells.edge_m,
    )
    return SnowCells(
        centers_m=torch.from_numpy(cells.centers_m.astype(np.float32)),
        normals=torch.from_numpy(cells.normals),
        sizes_m=torch.from_numpy(cells.sizes_m),
        edge_m=torch.from_numpy(cells.edge_m),
        neighbours=torch.from_numpy(neighbours),
        light=torch.from_numpy(light),
        tracks=torch.from_numpy(cells.tracks),
        banks=torch.from_numpy(cells.banks),
        semantic=torch.from_numpy(cells.semantic),
        buried=torch.from_numpy(buried),
        buried_by=torch.from_numpy(buried_by),
    )
