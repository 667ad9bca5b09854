"""Which Gaussians are the surface that snow lies on: it hides them where it is deep enough."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from augment.geometry import rotmat_from_quat
from augment.scene import Gaussians
from augment.snow.in_threads import in_order, slices_of

BELOW_M, ABOVE_M = 0.5, 0.08  # of the bed; above, half a cell at least
FACING_RAD = math.radians(40)  # between a flat Gaussian's normal and the bed's
_FLAT = 0.5  # shortest axis over the next, of a flat Gaussian
_SMALL_M, _SMALL_BELOW_M = 0.06, 0.15  # what is small and just beneath goes whichever way it faces
_INLAND_M = 0.15  # but not near an open edge, where it may be a wall's top
_SIGMAS = 1.5


@runtime_checkable
class NumbersCells(Protocol):
    """Tells which cell is under a point."""

    def at(self, xy: np.ndarray) -> np.ndarray:
        """int32 [P]: numbers of the cells under points float64 [P, 2], -1 where there is none."""
        ...


def find_buried(
    gaussians: Gaussians,
    numbers: NumbersCells,
    *,
    centers_m: np.ndarray,
    normals: np.ndarray,
    sizes_m: np.ndarray,
    edge_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """buried int32 [B] and buried_by int32 [B, 5], see SnowCells; only such as can be hidden.

    centers_m float64 [C, 3], normals [C, 3], sizes_m [C], edge_m [C]: of the cells.
    """
    found = []
    if len(centers_m):
        cells = (centers_m, normals, sizes_m, edge_m)
        parts = slices_of(len(gaussians))
        found = in_order(lambda part: _find_part(gaussians, numbers, part, *cells), parts)
    return (
        np.concatenate([np.zeros(0, np.int32), *(buried for buried, _ in found)]),
        np.concatenate([np.zeros((0, 5), np.int32), *(by for _, by in found)]),
    )


def _find_part(
    gaussians: Gaussians,
    numbers: NumbersCells,
    part: slice,
    centers_m: np.ndarray,
    normals: np.ndarray,
    sizes_m: np.ndarray,
    edge_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """As find_buried, of part of the Gaussians: of so few that what is found lies in the caches."""
    means = gaussians.means[part].numpy().astype(np.float64)
    under = numbers.at(means[:, :2])
    index = np.flatnonzero(under >= 0)
    cell = under[index]
    offset = means[index] - centers_m[cell]
    rise = (offset * normals[cell]).sum(1) / normals[cell, 2]  # above the cell's plane, along z
    near = (rise > -BELOW_M) & (rise < np.maximum(ABOVE_M, sizes_m[cell] / 2))
    index, cell, rise = index[near], cell[near], rise[near]
    rows = torch.from_numpy(index)
    axes = rotmat_from_quat(gaussians.quats[part][rows]).numpy()  # columns: the axes
    scales = gaussians.scales[part][rows].numpy()
    order = np.argsort(scales, axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[:, None, :], 2)
    scales = np.take_along_axis(scales, order, 1)
    facing = np.abs((axes[..., 0] * normals[cell]).sum(1)) >= math.cos(FACING_RAD)
    flat = scales[:, 0] <= _FLAT * scales[:, 1]
    small = (scales[:, 2] < _SMALL_M) & (rise > -_SMALL_BELOW_M) & (edge_m[cell] >= _INLAND_M)
    lies = (flat & facing) | small
    index, cell, axes, scales = index[lies], cell[lies], axes[lies], scales[lies]
    over = [cell]
    for axis in (2, 1):
        for sign in (1, -1):
            reach = sign * _SIGMAS * scales[:, axis, None] * axes[:, :2, axis]
            over.append(numbers.at(means[index, :2] + reach))
    buried_by = np.stack(over, 1)
    whole = (buried_by >= 0).all(1)
    return (part.start + index[whole]).astype(np.int32), buried_by[whole].astype(np.int32)
