"""Height of the ground, from Gaussians alone.

There are no labels in a splat file, so the ground is what lies low: a low quantile of the centres
of solid Gaussians around a place; a quantile, since trained scenes hold stray ones underground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from augment.scene import Gaussians

SOLID_OPACITY = 0.3  # fainter Gaussians are haze and leftovers of training
BULK_REACH = 8.0  # in median distances: of a drive that is dense in the middle, all
_LOW_QUANTILE = 0.1
_ROAD_REACH_M, _ROAD_LAYER_M, _ROAD_ABOVE_LOW_M = 2.5, 0.2, 0.7
_FEWEST_POINTS = 12
_MOST_POINTS = 300_000
_MOST_PLACES = 128
_CELLS_A_SIDE = 200
_FEWEST_KNOWN = 6  # of 25 cells: ground is not spread beyond the content's edge


def solid_points(gaussians: Gaussians) -> np.ndarray:
    """Centres [N, 3] of solid Gaussians, or of all where hardly any is solid; float64.

    Large scenes are thinned evenly to a few hundred thousand.
    """
    return gaussians.means[_solid(gaussians)].double().numpy()


def solid_points_and_areas(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """The same centres, and the area [N] each hides: opacity times 2 pi times its two larger
    scales, which is what it takes from a wide beam across its face. Thinned areas make up for
    those left out.
    """
    index = _solid(gaussians)
    count = int((gaussians.opacities > SOLID_OPACITY).sum())
    scales = gaussians.scales[index].sort(dim=1).values
    area = 2 * math.pi * gaussians.opacities[index] * scales[:, 1] * scales[:, 2]
    thinned = max(count, len(index)) / max(len(index), 1)
    return gaussians.means[index].double().numpy(), area.double().numpy() * thinned


def _solid(gaussians: Gaussians) -> Tensor:
    solid = torch.nonzero(gaussians.opacities > SOLID_OPACITY)[:, 0]
    if len(solid) < _FEWEST_POINTS:
        solid = torch.arange(len(gaussians))
    return solid[:: 1 + len(solid) // _MOST_POINTS]


def in_bulk(points: np.ndarray, reach: float) -> np.ndarray:
    """Which points [N, 3] lie within `reach` times the median distance from their middle: without
    what floats far around a scene, which would stretch every extent.
    """
    inside = np.ones(len(points), bool)
    for _ in range(3):  # the middle moves once the far ones are gone
        distance = np.linalg.norm(points - np.median(points[inside], axis=0), axis=1)
        inside = distance <= reach * np.median(distance[inside])
    return inside


def ground_under(
    points: np.ndarray, positions: np.ndarray, *, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ground heights [P'] under positions [P, 3], and the positions [P', 3] they belong to.

    Points within `radius` horizontally and below the position count. Positions with too few of
    them are left out; long paths are thinned evenly.
    """
    kept, heights = [], []
    for position in positions[:: 1 + len(positions) // _MOST_PLACES]:
        offset = points[:, :2] - position[:2]
        near = (offset * offset).sum(1) < radius * radius
        below = points[near & (points[:, 2] < position[2]), 2]
        if len(below) >= _FEWEST_POINTS:
            kept.append(position)
            heights.append(np.quantile(below, _LOW_QUANTILE))
    return np.array(heights), np.array(kept).reshape(-1, 3)


def road_heights(
    points: np.ndarray, areas: np.ndarray, places: np.ndarray, low: np.ndarray, *, unit: float = 1.0
) -> np.ndarray:
    """Heights [P] that hold the most surface around places [P, 2 or 3]; NaN where nothing is near.

    low: [P], heights of what lies low there, which a road may lie above: files have foundations,
    and strays below the ground. Coarse splats lie under fine ones, so none counts for many.
    unit: a metre's length.
    """
    layer = unit * _ROAD_LAYER_M
    heights, areas = np.full(len(places), np.nan), np.minimum(areas, np.median(areas))
    for number, (place, least) in enumerate(zip(places, low, strict=True)):
        offset = points[:, :2] - place[:2]
        near = (offset * offset).sum(axis=1) < (unit * _ROAD_REACH_M) ** 2
        near &= np.abs(points[:, 2] - least) < unit * _ROAD_ABOVE_LOW_M
        if near.any():
            z, area = points[near, 2], areas[near]
            bins = np.floor((z - z.min()) / (layer / 4)).astype(int)
            layers = np.convolve(np.bincount(bins, area), np.ones(4))
            top = z.min() + (layers.argmax() + 1) * layer / 4
            within = (z <= top) & (z >= top - layer)
            heights[number] = np.average(z[within], weights=area[within])
    return heights


def lowest_ground(points: np.ndarray, positions: np.ndarray, *, radius: float) -> float | None:
    """Height of the ground where it is lowest under a path; None where nothing lies under it."""
    heights, _ = ground_under(points, positions, radius=radius)
    # The 5 % quantile: one hole in the reconstruction must not set the level of a flood.
    return float(np.quantile(heights, 0.05)) if len(heights) else None


@dataclass(frozen=True, eq=False)
class GroundGrid:
    """Ground heights on square cells. height: [X, Y], NaN where nothing is near.

    corner: x, y of the first cell's corner. cell: side length.
    """

    corner: np.ndarray
    cell: float
    height: np.ndarray

    def cells_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices along x and y, clipped to the grid, and which points lie inside it."""
        index = np.floor((points[..., :2] - self.corner) / self.cell).astype(int)
        inside = np.all((index >= 0) & (index < np.array(self.height.shape)), axis=-1)
        x = index[..., 0].clip(0, self.height.shape[0] - 1)
        y = index[..., 1].clip(0, self.height.shape[1] - 1)
        return x, y, inside

    def at(self, points: np.ndarray) -> np.ndarray:
        """Height under points [..., 2 or 3]; NaN outside and where unknown."""
        x, y, inside = self.cells_of(points)
        return np.where(inside, self.height[x, y], np.nan)


def ground_grid(points: np.ndarray, *, cell: float) -> GroundGrid:
    """Ground heights over the bulk of the points: the low quantile of each cell, then the third
    lowest tenth of the 5x5 cells around it, which a car, a bush or a canopy alone does not lift.

    cell: metres; larger where the scene would need more than _CELLS_A_SIDE cells.
    """
    low, high = np.quantile(points[:, :2], [0.005, 0.995], axis=0)
    cell = max(cell, float((high - low).max()) / _CELLS_A_SIDE)
    shape = np.floor((high - low) / cell).astype(int) + 1
    grid = GroundGrid(low, cell, np.full(shape, np.nan))
    x, y, inside = grid.cells_of(points)
    flat = (x * shape[1] + y)[inside]
    heights = points[inside, 2]
    order = np.lexsort((heights, flat))
    cells, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    grid.height.reshape(-1)[cells] = heights[order][first + (_LOW_QUANTILE * count).astype(int)]
    return GroundGrid(low, cell, _smooth(grid.height))


def _smooth(height: np.ndarray) -> np.ndarray:
    padded = np.pad(height, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*height.shape, 25)
    ordered = np.sort(windows, axis=-1)  # NaN last
    known = np.isfinite(ordered).sum(-1)
    pick = (0.3 * known).astype(int).clip(0, 24)
    smooth = np.take_along_axis(ordered, pick[..., None], -1)[..., 0]
    return np.where(known >= _FEWEST_KNOWN, smooth, np.nan)
