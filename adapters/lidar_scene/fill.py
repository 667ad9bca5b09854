"""Points where no LiDAR ring fell.

Walls: the upper channels of a spinning LiDAR lie degrees apart, metres on a building across the
street. A wall is taken to go straight up from one ring to the next. Bridges: a splat stretched over
the gap between two rings would smear one ring's colour across it; new points are put on the
straight line between neighbours that lie in each other's tangent plane, but only as far as gaps of
that class are likely to be surface. Ground: between rings beside the path, under parked cars, under
the sensor; heights are interpolated, the extent is that of the ground seen around the hole.
"""

from __future__ import annotations

import cv2
import numba
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from adapters.lidar_scene.split import PointSet, is_flat
from adapters.lidar_scene.surfels import Surfels, edges_at
from augment.semantics import SemanticClass as Class

MAX_WALL_GAP_M = 3.0  # gaps higher than this stay open
_CELL_M, _CELL_EDGES = 0.2, 1.5  # size in plan of a column of wall
_SPARSER = 1.6  # spacing of new points in edges: what is guessed needs no detail
_UPRIGHT = 0.4  # largest upward part of an upright surface's unit normal
_MAX_GAP_M = {
    Class.BUILDING: 1.0,
    Class.BARRIER: 0.6,
    Class.SIGN: 0.6,
    Class.VEHICLE: 0.4,
    Class.UNKNOWN: 0.4,
}
_MAX_OTHER_GAP_M = 0.25
CELL_M = 0.25
CLOSE_M = 3.0  # holes up to twice this wide are filled
REACH_M = 60.0  # from the path
_RELAXATIONS = 2 * round(CLOSE_M / CELL_M) ** 2 // 3  # to settle across half the widest hole
_STEEP = 0.35  # height over distance that ground can have from one cell to the next


def fill_walls(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """The new points only, on walls, fences and boards, or without classes on any upright surface.

    edge_m: float32 [N], distance that the points were thinned to. surfels: of the points."""
    wall = np.isin(points.semantic, (Class.BUILDING, Class.BARRIER, Class.SIGN, Class.UNKNOWN))
    wall &= np.abs(surfels.normals[:, 2]) < _UPRIGHT
    some, edges, classes = points.points[wall], edge_m[wall], points.semantic[wall]
    if len(some) < 2:
        return PointSet(points.points[:0], points.semantic[:0])
    column = _columns(some, edges)
    order = np.lexsort((some[:, 2], column))
    return PointSet(
        *_fill(some[order], edges[order], classes[order], column[order], MAX_WALL_GAP_M, _SPARSER)
    )


def _columns(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """A number for the column that each point stands in, int64 [N]."""
    size = np.maximum(_CELL_M, _CELL_EDGES * edges.astype(np.float64))
    level = np.round(4 * np.log2(size)).astype(np.int64) + 64
    cell = np.floor(points[:, :2] / size[:, None]).astype(np.int64) + (1 << 23)
    return (level << 48) | (cell[:, 0] << 24) | cell[:, 1]


@numba.njit(cache=True)
def _fill(points, edges, classes, column, widest, sparser):  # pragma: no cover - compiled
    total = 0
    for i in range(len(points) - 1):
        gap = points[i + 1, 2] - points[i, 2]
        if column[i] == column[i + 1] and sparser * edges[i] < gap <= widest:
            total += int(np.ceil(gap / (sparser * edges[i]))) - 1
    out = np.empty((total, 3), np.float32)
    out_class = np.empty(total, np.int16)
    n = 0
    for i in range(len(points) - 1):
        gap = points[i + 1, 2] - points[i, 2]
        if column[i] == column[i + 1] and sparser * edges[i] < gap <= widest:
            pieces = int(np.ceil(gap / (sparser * edges[i])))
            for k in range(1, pieces):
                f = np.float32(k / pieces)
                for a in range(3):
                    out[n, a] = points[i, a] * (1 - f) + points[i + 1, a] * f
                out_class[n] = classes[i]
                n += 1
    return out, out_class


def bridge_gaps(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """The new points only.

    edge_m: float32 [N], distance that the points were thinned to. surfels: of the points."""
    widest = np.full(64, _MAX_OTHER_GAP_M, np.float32)
    for semantic, width in _MAX_GAP_M.items():
        widest[semantic] = width
    a, b = _find_bridges(
        points.points, points.semantic, surfels.normals, surfels.major, surfels.neighbours,
        edge_m, widest,
    )  # fmt: skip
    length = np.linalg.norm(points.points[a] - points.points[b], axis=1)
    pieces = np.ceil(length / edge_m[a]).astype(np.int64)
    inner = np.maximum(pieces - 1, 0)
    pair = np.repeat(np.arange(len(a)), inner)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(inner) - inner, inner) + 1
    along = (step / pieces[pair]).astype(np.float32)[:, None]
    new = points.points[a[pair]] * (1 - along) + points.points[b[pair]] * along
    return PointSet(new, points.semantic[a[pair]])


@numba.njit(cache=True)
def _find_bridges(
    points, semantic, normals, major, index, edge_m, widest
):  # pragma: no cover - compiled
    """Pairs to join: a's nearest neighbour b to one side, where a has one on the other side too."""
    first = np.empty(4 * len(points), np.int64)
    second = np.empty(4 * len(points), np.int64)
    count = 0
    gaps, who = np.empty(4), np.empty(4, np.int64)
    for i in range(len(points)):
        n, e1 = normals[i], major[i]
        e2x = n[1] * e1[2] - n[2] * e1[1]
        e2y = n[2] * e1[0] - n[0] * e1[2]
        e2z = n[0] * e1[1] - n[1] * e1[0]
        gaps[:] = np.inf
        for j in index[i]:
            dx = points[j, 0] - points[i, 0]
            dy = points[j, 1] - points[i, 1]
            dz = points[j, 2] - points[i, 2]
            u = dx * e1[0] + dy * e1[1] + dz * e1[2]
            v = dx * e2x + dy * e2y + dz * e2z
            w = dx * n[0] + dy * n[1] + dz * n[2]
            m = normals[j]
            wj = dx * m[0] + dy * m[1] + dz * m[2]
            reach = np.sqrt(dx * dx + dy * dy + dz * dz)
            if reach < 0.5 * edge_m[i] or semantic[j] != semantic[i]:
                continue
            # Further off either tangent plane than a quarter of the way is another surface.
            if max(abs(w), abs(wj)) > 0.25 * reach:
                continue
            side = (0 if u > 0 else 1) if abs(u) >= abs(v) else (2 if v > 0 else 3)
            if reach < gaps[side]:
                gaps[side], who[side] = reach, j
        for side in range(4):
            # One of a pair of wires has nothing on its other side.
            if 1.5 * edge_m[i] < gaps[side] <= widest[semantic[i]] and gaps[side ^ 1] < np.inf:
                first[count], second[count] = i, who[side]
                count += 1
    return first[:count], second[:count]


def ground_points(points: PointSet) -> np.ndarray:
    """Which points are ground, bool [N]: by class where any has one, else the lowest of their
    square metre where its height agrees with the squares around it."""
    flat = is_flat(points.semantic)
    if flat.any() or (points.semantic != Class.UNKNOWN).any():
        return flat
    return _low_points(points.points)


def fill_ground(points: PointSet, path: np.ndarray, *, voxel_m: float) -> PointSet:
    """New ground points only, a little sparser than `thin_points`; class of the nearest point."""
    is_ground = ground_points(points)
    ground, classes = points.points[is_ground], points.semantic[is_ground]
    near = cKDTree(path[:, :2]).query(ground[:, :2])[0] < REACH_M
    ground, classes = ground[near], classes[near]
    if len(ground) < 16:
        return PointSet(points.points[:0], points.semantic[:0])
    origin = ground[:, :2].min(axis=0) - 2 * CLOSE_M
    shape = np.ceil((ground[:, :2].max(axis=0) + 2 * CLOSE_M - origin) / CELL_M).astype(int) + 1
    heights, seen = _height_grid(ground, origin, shape)
    # Holes among cells with ground up to 2 CLOSE_M wide count; nothing beyond the outline does.
    radius = round(CLOSE_M / CELL_M)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    inside = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
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
    i, j = (cell - cell.min(axis=0)).T
    grid = np.full((i.max() + 1, j.max() + 1), np.inf)
    np.minimum.at(grid, (i, j), points[:, 2].astype(np.float64))
    around = np.where(np.isinf(grid), 1e6, grid)
    around = cv2.erode(around.astype(np.float32), np.ones((9, 9), np.uint8)).astype(np.float64)
    # A roof or a car is more than this above the lowest square within four metres.
    is_ground = grid - around < 0.25 + _STEEP
    return (points[:, 2] - grid[i, j] < 0.15) & is_ground[i, j]
