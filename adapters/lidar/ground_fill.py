"""Ground where no LiDAR ring fell: between rings beside the path, under parked cars, under the
sensor. Heights are interpolated, the extent is that of the ground seen around the hole.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from adapters.lidar.split import PointSet, is_flat
from adapters.lidar.voxels import edges_at
from augment.semantics import SemanticClass

CELL_M = 0.25
CLOSE_M = 3.0  # holes up to twice this wide are filled
REACH_M = 60.0  # from the path
_SPARSER = 1.6  # spacing of new points in voxel edges: what is guessed needs no detail
_RELAXATIONS = 2 * round(CLOSE_M / CELL_M) ** 2 // 3  # to settle across half the widest hole
_STEEP = 0.35  # height over distance that ground can have from one cell to the next


def ground_points(points: PointSet) -> np.ndarray:
    """Which points are ground, bool [N]: by class where any has one, else the lowest of their
    square metre where its height agrees with the squares around it."""
    flat = is_flat(points.semantic)
    if flat.any() or (points.semantic != SemanticClass.UNKNOWN).any():
        return flat
    return _low_points(points.points)


def fill_ground(points: PointSet, path: np.ndarray, *, voxel_m: float) -> PointSet:
    """New ground points only, a little sparser than `thin_points`; class of the nearest point."""
    ground = points.points[ground_points(points)]
    classes = points.semantic[ground_points(points)]
    near = cKDTree(path[:, :2]).query(ground[:, :2])[0] < REACH_M
    ground, classes = ground[near], classes[near]
    if len(ground) < 16:
        return PointSet(points.points[:0], points.semantic[:0])
    origin = ground[:, :2].min(axis=0) - 2 * CLOSE_M
    shape = np.ceil((ground[:, :2].max(axis=0) + 2 * CLOSE_M - origin) / CELL_M).astype(int) + 1
    heights, seen = _height_grid(ground, origin, shape)
    inside = _closed(seen)
    heights = _spread(heights, seen)
    voxel_m = voxel_m * _SPARSER
    new = _candidates(heights, inside, origin, path, voxel_m)
    distance, nearest = cKDTree(ground[:, :2]).query(new[:, :2], workers=-1)
    missing = distance > 0.7 * edges_at(new, path, voxel_m=voxel_m)
    return PointSet(new[missing], classes[nearest[missing]])


def _height_grid(
    ground: np.ndarray, origin: np.ndarray, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean height [X, Y] of every cell that holds ground, and which do."""
    cell = ((ground[:, :2] - origin) / CELL_M).astype(np.int64)
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    count = np.bincount(flat, minlength=shape[0] * shape[1])
    total = np.bincount(flat, ground[:, 2].astype(np.float64), shape[0] * shape[1])
    heights = (total / np.maximum(count, 1)).reshape(shape)
    return heights, (count > 0).reshape(shape)


def _closed(seen: np.ndarray) -> np.ndarray:
    """Cells with ground, and holes among them up to 2 CLOSE_M wide; nothing beyond the outline."""
    radius = round(CLOSE_M / CELL_M)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0


def _spread(heights: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Heights for every cell: in holes the smoothest surface that joins their rim (Laplace's
    equation, relaxed from averages over ever wider surroundings)."""
    fixed = np.where(seen, heights, 0.0).astype(np.float32)
    out, known = fixed.copy(), seen.copy()
    sigma = 1.0
    while not known.all() and sigma * CELL_M < 4 * CLOSE_M:
        both = cv2.GaussianBlur(np.dstack([fixed, seen.astype(np.float32)]), (0, 0), sigma)
        reached = ~known & (both[..., 1] > 1e-2)
        out[reached] = both[reached, 0] / both[reached, 1]
        known |= reached
        sigma *= 2.0
    for _ in range(_RELAXATIONS):
        out = np.where(seen, fixed, cv2.blur(out, (3, 3)))
    return out


def _candidates(
    heights: np.ndarray, inside: np.ndarray, origin: np.ndarray, path: np.ndarray, voxel_m: float
) -> np.ndarray:
    """Points over all inside cells, as dense as the voxels are there, float32 [M, 3]."""
    cells = np.argwhere(inside)
    centres = np.column_stack([(cells + 0.5) * CELL_M + origin, heights[inside]])
    edges = edges_at(centres, path, voxel_m=voxel_m)
    out = []
    for edge in np.unique(edges):
        some = centres[edges == edge]
        count = max(1, round(CELL_M / float(edge)))
        # Coarser than a cell: keep about one cell in (edge / cell)^2, on a grid.
        stride = max(1, round(float(edge) / CELL_M))
        index = cells[edges == edge]
        some = some[(index % stride == 0).all(axis=1)]
        ticks = (np.arange(count) + 0.5) / count * CELL_M - CELL_M / 2
        dx, dy = np.meshgrid(ticks, ticks, indexing="ij")
        xy = some[:, None, :2] + np.stack([dx.ravel(), dy.ravel()], 1)[None]
        out.append(xy.reshape(-1, 2))
    xy = np.concatenate(out)
    grid = (xy - origin) / CELL_M - 0.5
    z = map_coordinates(heights, grid.T, order=1, mode="nearest")
    return np.column_stack([xy, z]).astype(np.float32)


def _low_points(points: np.ndarray) -> np.ndarray:
    cell = np.floor(points[:, :2]).astype(np.int64)
    cell -= cell.min(axis=0)
    shape = cell.max(axis=0) + 1
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    low = np.full(int(shape.prod()), np.inf)
    np.minimum.at(low, flat, points[:, 2].astype(np.float64))
    grid = low.reshape(shape)
    around = np.where(np.isinf(grid), 1e6, grid)
    around = cv2.erode(around.astype(np.float32), np.ones((9, 9), np.uint8)).astype(np.float64)
    # A roof or a car is more than this above the lowest square within four metres.
    is_ground = grid - around < 0.25 + _STEEP
    return (points[:, 2] - low[flat] < 0.15) & is_ground.ravel()[flat]
