"""Surfels from points: a tangent plane, and an extent along two of its axes that closes the
surface.

LiDAR points are dense along a ring and sparse across rings, so a round splat either leaves gaps or
smears. Each point's extent is therefore measured separately along its two tangent axes, from the
nearest neighbours to either side. Before that, accumulated points are thinned to one per voxel,
finer near the driven path. The caller is `adapters.lidar_scene.scene`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from adapters.lidar_scene.kernels import for_row_slices
from adapters.lidar_scene.split import PointSet, is_flat
from augment.render.cpu.jit import cached_njit
from augment.render.sh import SH_C0
from augment.scene.geometry import quat_from_rotmat
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass as Class

NEAR_M = 6.0  # voxels have their given size up to this distance from the path
# Edges grow with this power of the distance: slower than a LiDAR's spacing, because a narrow camera
# still resolves what is far ahead.
GROWTH = 0.7
_STEP = 0.5  # octaves of distance that share a size, so that points near each other share a grid
_MAX_LEVEL = 15  # largest level: its 4 bits in a voxel's key hold no more
NEIGHBOURS = 12  # nearest points, and as many again out of a coarser sample
_COARSE = 4.0  # edges between points of that sample: it reaches across the gap between two rings
_STRETCH = 2.0  # widest gap that a splat closes, in edges
_STRETCH_FIRM = 4.0  # the same on ground, walls and where there is no class
_UPRIGHT = (Class.BUILDING, Class.BARRIER, Class.SIGN)
_LINE = 0.02  # middle over largest variance below which neighbours lie on a line, not a plane
_GROUND_SIGMA_PER_SPACING = 0.6  # wider than elsewhere: the ground must not leak
_SETTLE_EDGES = 3.0  # largest distance along the normal, in edges, of points that are averaged
_SETTLE_REACH_M = 0.3  # largest such distance: far and sparse points lie on no common plane
_MOST_SETTLED_M = 0.1  # largest distance that a point is moved
_ONE_FACE = 0.7  # least cosine of two normals whose points are of one face, not around its edge
_SETTLE_CROWN = 0.8  # part of the way that foliage is moved: crowns would shrink
_SET_BACK = 0.55  # distance along the normal, in standard deviations, that a disc is set back
_GROUND_SET_BACK = 0.38  # the same on the ground, which is seen at flatter angles
_MOST_SET_BACK_M = 0.04  # largest distance that a disc is set back
_MIN_SINE = 0.45  # least sine that is counted: other cameras see a disc at flatter angles
_EDGE_ON = 0.1  # cosine of the normal and the view below which a disc has no side
_THICKNESS = 0.15  # standard deviation along the normal over the smaller tangent one
_MIN_THICKNESS_M = 0.005  # smallest standard deviation along the normal


def thin_points(
    points: PointSet, path: np.ndarray, *, voxel_m: float, level: np.ndarray | None = None
) -> tuple[PointSet, np.ndarray]:
    """Return the mean point and commonest class of every occupied voxel, and the voxels' edges
    in metres.

    The edge is voxel_m within NEAR_M of the path. Beyond, it grows with the power GROWTH of the
    distance.

    Args:
        points: the points.
        path: float [P, 3].
        voxel_m: smallest edge.
        level: `levels_at` the points, if it is known.
    """
    if len(points) == 0:
        return points, np.zeros(0, np.float32)
    level = levels_at(points.points, path) if level is None else level
    edges = _edges(voxel_m)
    keys = _keys(points.points, level, edges)
    order = np.argsort(keys, kind="stable")
    means, classes, levels = _reduce(points.points, points.semantic, keys, level, order)
    return PointSet(means, classes), edges[levels].astype(np.float32)


def levels_at(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return the distance of each position from the path, in steps of voxels' sizes, uint8 [N]."""
    points, path = (np.ascontiguousarray(a, np.float32) for a in (points, path))
    out = np.empty(len(points), np.uint8)
    for_row_slices(lambda rows: _levels(points[rows], path, out[rows]), len(points))
    return out


def edges_at(points: np.ndarray, path: np.ndarray, *, voxel_m: float) -> np.ndarray:
    """Return the edge that `thin_points` uses at each position, metres, float32 [N]."""
    return _edges(voxel_m)[levels_at(points, path)].astype(np.float32)


def coarse_sample(points: np.ndarray, cell_m: np.ndarray) -> np.ndarray:
    """Return the indices of one point per cell, int64, ascending.

    cell_m: float32 [N], approximate size of the cell at each point.
    """
    level = np.clip(np.round(2 * np.log2(cell_m / cell_m.min())), 0, _MAX_LEVEL).astype(np.uint8)
    sizes = cell_m.min() * 2.0 ** (0.5 * np.arange(_MAX_LEVEL + 1))
    _, first = np.unique(_keys(points, level, sizes.astype(np.float64)), return_index=True)
    return np.sort(first)


def _edges(voxel_m: float) -> np.ndarray:
    return voxel_m * 2.0 ** (_STEP * GROWTH * np.arange(_MAX_LEVEL + 1))


@cached_njit(nogil=True)
def _levels(points, path, out):  # pragma: no cover - compiled
    for i in range(len(points)):
        best = np.inf
        for j in range(len(path)):
            dx = points[i, 0] - path[j, 0]
            dy = points[i, 1] - path[j, 1]
            dz = points[i, 2] - path[j, 2]
            best = min(best, dx * dx + dy * dy + dz * dz)
        level = np.ceil(0.5 * np.log2(max(best, 1e-12) / (NEAR_M * NEAR_M)) / _STEP)
        out[i] = np.uint8(min(max(level, 0.0), _MAX_LEVEL))


def _keys(points: np.ndarray, level: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return keys of voxels: 4 bits of level, then 20 per coordinate, 20 km each way at the
    finest edge.
    """
    out = np.empty(len(points), np.uint64)
    for_row_slices(
        lambda rows: _fill_keys(points[rows], level[rows], edges, out[rows]), len(points)
    )
    return out


@cached_njit(nogil=True)
def _fill_keys(points, level, edges, out):  # pragma: no cover - compiled
    for i in range(len(points)):
        key = np.uint64(level[i])
        for axis in range(3):
            cell = np.int64(np.floor(points[i, axis] / edges[level[i]])) + (1 << 19)
            key = key << np.uint64(20) | np.uint64(cell) & np.uint64((1 << 20) - 1)
        out[i] = key


@cached_njit()
def _reduce(points, semantic, keys, level, order):  # pragma: no cover - compiled
    """Reduce runs of equal keys to their mean, commonest class (the lower of equals) and level."""
    runs = 1
    for i in range(1, len(keys)):
        runs += keys[order[i]] != keys[order[i - 1]]
    means = np.empty((runs, 3), np.float32)
    classes = np.empty(runs, np.int16)
    levels = np.empty(runs, np.uint8)
    votes = np.zeros(64, np.int64)
    start = 0
    run = 0
    for end in range(1, len(keys) + 1):
        if end < len(keys) and keys[order[end]] == keys[order[start]]:
            continue
        sums = np.zeros(3)
        votes[:] = 0
        for i in order[start:end]:
            for axis in range(3):
                sums[axis] += points[i, axis]
            votes[semantic[i]] += 1
        for axis in range(3):
            means[run, axis] = sums[axis] / (end - start)
        # UNKNOWN (0) wins only where nothing else was seen.
        best = 0
        for c in range(1, 64):
            if votes[c] > 0 and (best == 0 or votes[c] > votes[best]):
                best = c
        classes[run] = best
        levels[run] = level[order[start]]
        start = end
        run = run + 1
    return means, classes, levels


@dataclass(frozen=True, eq=False)
class Surfels:
    """N discs.

    Attributes:
        centres, normals, major: float32 [N, 3]. Normals and major are unit and orthogonal. `major`
            is the first tangent axis, normals x major the second.
        spacing: float32 [N, 2], metres to the neighbours along the tangent axes.
        isolated: bool [N], True with too few neighbours for a surface.
        neighbours: int [N, K], see `find_neighbours`.
    """

    centres: np.ndarray
    normals: np.ndarray
    major: np.ndarray
    spacing: np.ndarray
    isolated: np.ndarray
    neighbours: np.ndarray

    def __len__(self) -> int:
        return len(self.centres)

    @staticmethod
    def discs(
        centres: np.ndarray, normals: np.ndarray, major: np.ndarray, spacing_m: np.ndarray
    ) -> Surfels:
        """Return round surfels of any float type, spacing [N], without neighbours."""
        spacing = np.repeat(spacing_m[:, None], 2, axis=1)
        floats = [a.astype(np.float32) for a in (centres, normals, major, spacing)]
        count = len(centres)
        return Surfels(*floats, np.zeros(count, np.bool_), np.zeros((count, 0), np.int64))

    def select(self, index: np.ndarray) -> Surfels:
        """Return the surfels at the given indices. Neighbours still count through all."""
        return Surfels(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))


def surfels_from_points(
    points: np.ndarray, edge_m: np.ndarray, *, semantic: np.ndarray | None = None
) -> Surfels:
    """Return a surfel for every point. Normals are principal axes of the nearest points.

    Args:
        points: float32 [N, 3].
        edge_m: float32 [N], distance to which the points were thinned.
        semantic: int16 [N]. It decides how wide a gap may be closed, that ground has no rim, and
            the direction of a lone ring: up on the ground, sideways on a building.
    """
    count = len(points)
    if count < 4:
        frame = np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))
        spacing = np.repeat(edge_m[:, None], 2, 1).astype(np.float32)
        isolated = np.ones(count, bool)
        neighbours = np.zeros((count, 0), int)
        return Surfels(points, frame[:, 2], frame[:, 0], spacing, isolated, neighbours)
    if semantic is None:
        semantic = np.full(count, Class.UNKNOWN, np.int16)
    index, distance = find_neighbours(points, edge_m)
    axes = _principal_axes(points, index, semantic)
    endless = is_flat(semantic)
    firm = endless | _is_upright(semantic) | (semantic == Class.UNKNOWN)
    stretch = np.where(firm, _STRETCH_FIRM, _STRETCH).astype(np.float32) * edge_m
    spacing = _spacing(points, index, axes[:, 0], axes[:, 2], edge_m, stretch, endless)
    # On a surface thinned to edge_m the fourth neighbour is a little over one edge away.
    isolated = distance[:, min(4, distance.shape[1] - 1)] > 4 * edge_m
    is_crown = semantic == Class.VEGETATION
    part = np.where(is_crown, _SETTLE_CROWN, 1.0).astype(np.float32)
    least_cosine = np.where(is_crown, 0.0, _ONE_FACE).astype(np.float32)
    near = np.ascontiguousarray(index[:, : distance.shape[1]])
    centres = _settle(points, near, axes[:, 2], edge_m, part, least_cosine)
    return Surfels(centres, axes[:, 2], axes[:, 0], spacing, isolated, index)


def find_neighbours(points: np.ndarray, edge_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return near and further neighbours of each point, int [N, K], and the distances of the
    near ones.

    The distances are float [N, K / 2]. Points may come twice, and come first themselves.
    """
    k = min(NEIGHBOURS, len(points))
    distance, near = cKDTree(points).query(points, k=k, workers=-1)
    sample = coarse_sample(points, edge_m * np.float32(_COARSE))
    k = min(NEIGHBOURS, len(sample))
    _, far = cKDTree(points[sample]).query(points, k=[*range(1, k + 1)], workers=-1)
    return np.concatenate([near, sample[far]], axis=1), distance


def _principal_axes(points: np.ndarray, index: np.ndarray, semantic: np.ndarray) -> np.ndarray:
    """Return the axis of largest variance, the middle one, and the normal of every point,
    float32 [N, 3, 3].
    """
    values, vectors = np.linalg.eigh(_covariances(points, index))
    major = vectors[:, :, 2]
    normal = vectors[:, :, 0]
    on_line = (values[:, 1] < _LINE * values[:, 2]) & (np.abs(major[:, 2]) < 0.9)
    sideways = np.cross(major, np.array([0.0, 0.0, 1.0]))
    hints = [(is_flat(semantic), np.cross(sideways, major)), (_is_upright(semantic), sideways)]
    for mask, hint in hints:
        hint = hint / np.maximum(np.linalg.norm(hint, axis=1, keepdims=True), 1e-9)
        normal = np.where((mask & on_line)[:, None], hint, normal)
    return np.stack([major, np.cross(normal, major), normal], axis=1).astype(np.float32)


def _is_upright(semantic: np.ndarray) -> np.ndarray:
    return np.isin(semantic, _UPRIGHT)


@cached_njit()
def _covariances(points, index):  # pragma: no cover - compiled
    out = np.zeros((len(points), 3, 3))
    k = index.shape[1]
    for i in range(len(points)):
        mean = np.zeros(3)
        for j in index[i]:
            for a in range(3):
                mean[a] += points[j, a]
        mean /= k
        for j in index[i]:
            for a in range(3):
                da = points[j, a] - mean[a]
                for b in range(3):
                    out[i, a, b] += da * (points[j, b] - mean[b])
    return out / k


@cached_njit()
def _settle(points, index, normals, edge_m, part, least_cosine):  # pragma: no cover - compiled
    """Return the points moved along their normals to the middle of the points around them.

    Noise spreads the returns of a surface over a layer that is thicker than the voxels. Its front
    would hide the rest, and every surface would stand too near.

    Args:
        points, normals: float32 [N, 3].
        index: int [N, K], nearest points of each point.
        edge_m: float32 [N], distance to which the points were thinned.
        part: float32 [N], part of the way to the middle that a point is moved.
        least_cosine: float32 [N], least cosine of two normals whose points are of one face.
    """
    out = np.empty_like(points)
    for i in range(len(points)):
        limit = min(_SETTLE_EDGES * edge_m[i], _SETTLE_REACH_M)
        total = 0.0
        weight = 0.0
        for j in index[i]:
            cosine = (
                normals[i, 0] * normals[j, 0]
                + normals[i, 1] * normals[j, 1]
                + normals[i, 2] * normals[j, 2]
            )
            if abs(cosine) < least_cosine[i]:
                continue
            dx, dy, dz = _offset(points, i, j)
            w = dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2]
            if abs(w) <= limit:
                total += w
                weight += 1.0
        shift = part[i] * total / max(weight, 1.0)
        most = min(edge_m[i], _MOST_SETTLED_M)
        shift = min(max(shift, -most), most)
        for a in range(3):
            out[i, a] = points[i, a] + shift * normals[i, a]
    return out


@cached_njit()
def _tangent(offset, e1, n):  # pragma: no cover - compiled
    """Return an offset along e1, along n x e1 and along n, and the number of the nearest half
    axis.

    Half axes are e1, -e1, n x e1 and its opposite.
    """
    e2x = n[1] * e1[2] - n[2] * e1[1]
    e2y = n[2] * e1[0] - n[0] * e1[2]
    e2z = n[0] * e1[1] - n[1] * e1[0]
    dx, dy, dz = offset
    u = dx * e1[0] + dy * e1[1] + dz * e1[2]
    v = dx * e2x + dy * e2y + dz * e2z
    w = dx * n[0] + dy * n[1] + dz * n[2]
    side = (0 if u > 0 else 1) if abs(u) >= abs(v) else (2 if v > 0 else 3)
    return u, v, w, side


@cached_njit()
def _offset(points, i, j):  # pragma: no cover - compiled
    return (points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2])


@cached_njit()
def _spacing(points, index, major, normals, edge_m, widest, endless):  # pragma: no cover - compiled
    """Return the mean over both sides of the gap to the nearest neighbour along each tangent
    axis.

    Neighbours count on the plane, within 45 degrees of a tangent half axis. If one side is far
    emptier, it is the surface's rim, or one of two wires: the surfel is not stretched that way. If
    the surface is endless (ground), the larger gap counts.
    """
    out = np.empty((len(points), 2), np.float32)
    gaps = np.empty(4)
    for i in range(len(points)):
        gaps[:] = np.inf
        for j in index[i]:
            u, v, w, side = _tangent(_offset(points, i, j), major[i], normals[i])
            reach = np.sqrt(u * u + v * v)
            # Nearer than half an edge is the same sample seen from the next voxel.
            # Steeper than 1 in 2 off the plane is another surface.
            if reach < 0.5 * edge_m[i] or abs(w) > 0.5 * reach:
                continue
            gaps[side] = min(gaps[side], reach)
        for axis in range(2):
            a = gaps[2 * axis]
            b = gaps[2 * axis + 1]
            if np.isinf(a) and np.isinf(b):
                gap = np.inf
            elif endless[i] and not np.isinf(max(a, b)):
                gap = min(max(a, b), widest[i])
            elif max(a, b) > 3 * min(a, b):
                gap = min(min(a, b), 1.5 * edge_m[i])
            else:
                gap = 0.5 * (a + b)
            if gap > widest[i]:
                gap = edge_m[i]
            out[i, axis] = max(gap, 0.5 * edge_m[i])
    return out


@dataclass(frozen=True)
class SplatShape:
    """Shape of the splats.

    Attributes:
        sigma_per_spacing: standard deviation along a tangent axis over the spacing there. 0.4
            leaves a lattice visible, 0.6 blurs.
        opacity: high, so that a surface hides everything behind it.
    """

    sigma_per_spacing: float = 0.5
    opacity: float = 0.95


def gaussians_from_surfels(
    surfels: Surfels, colours: np.ndarray, semantic: np.ndarray, shape: SplatShape = SplatShape()
) -> Gaussians:
    """Return degree-0 Gaussians flattened along the surfels' normals.

    Args:
        surfels: the surfels.
        colours: float32 [N, 3] in [0, 1].
        semantic: int16 [N].
        shape: shape of the splats.
    """
    second = np.cross(surfels.normals, surfels.major)
    axes = np.stack([surfels.major, second, surfels.normals], axis=2)  # columns
    sigma = np.full(len(surfels), shape.sigma_per_spacing, np.float32)
    sigma[is_flat(semantic)] = max(_GROUND_SIGMA_PER_SPACING, shape.sigma_per_spacing)
    tangent = surfels.spacing * sigma[:, None]
    thin = np.maximum(tangent.min(axis=1) * _THICKNESS, _MIN_THICKNESS_M)
    scales = np.concatenate([tangent, thin[:, None]], axis=1).astype(np.float32)
    return Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(surfels.centres, np.float32)),
        quats=quat_from_rotmat(torch.from_numpy(axes.astype(np.float64))).float(),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(surfels),), shape.opacity),
        sh=((torch.from_numpy(colours).float() - 0.5) / SH_C0)[:, None, :],
        semantic=torch.from_numpy(semantic.astype(np.int16)),
    )


def set_back(surfels: Surfels, semantic: np.ndarray, eyes: np.ndarray) -> Surfels:
    """Return the surfels moved away from the eyes, so that their splats' depth is that of the
    surface.

    A pixel takes the depth of the centre of the first splat that covers it. Of splats that overlap,
    that is one whose centre lies towards the eye. The mean of this is a part of the splats' width,
    and the more of it the flatter the view. Along the normal it is about _SET_BACK of the width.

    Args:
        surfels: the surfels.
        semantic: int16 [N], classes. Ground is seen from above.
        eyes: float [E, 3], places of the cameras in the surfels' frame.
    """
    if len(surfels) == 0:
        return surfels
    _, nearest = cKDTree(eyes).query(surfels.centres)
    to_eye = eyes[nearest] - surfels.centres
    cosine = (to_eye * surfels.normals).sum(1) / np.maximum(np.linalg.norm(to_eye, axis=1), 1e-6)
    sine = np.sqrt(np.maximum(1 - cosine**2, _MIN_SINE**2))
    side = np.clip(cosine / _EDGE_ON, -1, 1) * sine
    flat = is_flat(semantic)  # which is mostly seen from afar
    side[flat] = np.sign(surfels.normals[flat, 2])
    width = surfels.spacing.max(axis=1) * np.where(flat, _GROUND_SIGMA_PER_SPACING, 0.5)
    part = np.where(flat, _GROUND_SET_BACK, _SET_BACK)
    shift_m = np.clip(part * side * width, -_MOST_SET_BACK_M, _MOST_SET_BACK_M)
    shift = shift_m[:, None] * surfels.normals
    return dataclasses.replace(surfels, centres=(surfels.centres - shift).astype(np.float32))


def borrow_colours(
    points: np.ndarray, colours: np.ndarray, has_colour: np.ndarray, reach_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours [N, 3], and a mask of the points that have a colour now, bool [N].

    A point without a colour takes that of the nearest point that has one within reach_m [N].
    """
    if has_colour.all() or not has_colour.any():
        return colours, has_colour
    unseen = np.flatnonzero(~has_colour)
    distance, nearest = cKDTree(points[has_colour]).query(points[unseen], workers=-1)
    near = distance <= reach_m[unseen]
    colours = colours.copy()
    has_colour = has_colour.copy()
    colours[unseen[near]] = colours[np.flatnonzero(has_colour)[nearest[near]]]
    has_colour[unseen[near]] = True
    return colours, has_colour


# ---- Points where no LiDAR ring fell -------------------------------------------------------------
# Walls: the upper channels lie metres apart on a building across the street; a wall is taken to go
# straight up from one ring to the next. Bridges: new points on the straight line between neighbours
# that lie in each other's tangent plane, as far as gaps of that class are likely to be surface; a
# stretched splat would smear one ring's colour. Ground: between rings, under parked cars and the
# sensor, heights are interpolated within the extent of the ground seen around the hole.

MAX_WALL_GAP_M = 3.0  # gaps higher than this stay open
_CELL_M = 0.2  # smallest side in plan of a column of wall, metres
_CELL_EDGES = 1.5  # that side in edges, where it is larger
_SPARSER = 1.6  # spacing of new points in edges: what is guessed needs no detail
_MAX_UPWARD = 0.4  # largest upward part of an upright surface's unit normal
_MAX_GAP_M = {
    Class.BUILDING: 1.0,
    Class.BARRIER: 0.6,
    Class.SIGN: 0.6,
    Class.VEHICLE: 0.4,
    Class.UNKNOWN: 0.4,
}
_MAX_OTHER_GAP_M = 0.25  # widest gap that is bridged on any other class
CELL_M = 0.25  # side of a cell of the map of the ground's heights
CLOSE_M = 3.0  # holes up to twice this wide are filled
BESIDE_M = 8.0  # distance from the path up to which every hole is filled
REACH_M = 60.0  # distance from the path up to which ground is filled
# Steps of relaxation: enough to settle across half the widest hole.
_RELAXATIONS = 2 * round(CLOSE_M / CELL_M) ** 2 // 3
_STEEP = 0.35  # height over distance that ground can have from one cell to the next


def fill_walls(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """Return new points on walls, fences and boards, or without classes on any upright surface.

    edge_m: float32 [N], distance to which the points were thinned.
    """
    wall = np.isin(points.semantic, (Class.BUILDING, Class.BARRIER, Class.SIGN, Class.UNKNOWN))
    wall &= np.abs(surfels.normals[:, 2]) < _MAX_UPWARD
    wall_points = points.points[wall]
    edges = edge_m[wall]
    classes = points.semantic[wall]
    if len(wall_points) < 2:
        return PointSet(points.points[:0], points.semantic[:0])
    column = _columns(wall_points, edges)
    order = np.lexsort((wall_points[:, 2], column))
    wall_points = wall_points[order]
    edges = edges[order]
    classes = classes[order]
    column = column[order]
    gap = np.diff(wall_points[:, 2])
    longest = _SPARSER * edges[:-1].astype(np.float64)
    is_open = (column[:-1] == column[1:]) & (longest < gap) & (gap <= MAX_WALL_GAP_M)
    below = np.flatnonzero(is_open)
    pair, along = _cuts(np.ceil(gap[below] / longest[below]).astype(np.int64))
    below = below[pair]
    new = wall_points[below] * (1 - along.astype(np.float64)) + wall_points[below + 1] * along
    return PointSet(new.astype(np.float32), classes[below])


def _cuts(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut the segments between pairs of points into equal pieces.

    pieces: int64 [P], pieces per pair.

    Returns:
        The pair of each cut, int64 [M], and its place as a fraction of the segment, float32 [M, 1].
    """
    inner = np.maximum(pieces - 1, 0)
    pair = np.repeat(np.arange(len(pieces)), inner)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(inner) - inner, inner) + 1
    return pair, (step / pieces[pair]).astype(np.float32)[:, None]


def _columns(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return a number for the column in which each point stands, int64 [N]."""
    size = np.maximum(_CELL_M, _CELL_EDGES * edges.astype(np.float64))
    level = np.round(4 * np.log2(size)).astype(np.int64) + 64
    cell = np.floor(points[:, :2] / size[:, None]).astype(np.int64) + (1 << 23)
    return (level << 48) | (cell[:, 0] << 24) | cell[:, 1]


def bridge_gaps(points: PointSet, edge_m: np.ndarray, surfels: Surfels) -> PointSet:
    """Return new points in gaps. edge_m: float32 [N], distance to which the points were thinned."""
    widest = np.full(64, _MAX_OTHER_GAP_M, np.float32)
    for semantic, width in _MAX_GAP_M.items():
        widest[semantic] = width
    a, b = _find_bridges(
        points.points,
        points.semantic,
        surfels.normals,
        surfels.major,
        surfels.neighbours,
        edge_m,
        widest,
    )
    length = np.linalg.norm(points.points[a] - points.points[b], axis=1)
    pair, along = _cuts(np.ceil(length / edge_m[a]).astype(np.int64))
    new = points.points[a[pair]] * (1 - along) + points.points[b[pair]] * along
    return PointSet(new, points.semantic[a[pair]])


@cached_njit()
def _find_bridges(
    points, semantic, normals, major, index, edge_m, widest
):  # pragma: no cover - compiled
    """Return pairs to join: a point's nearest neighbour to one side, if it has one on the other
    side too.
    """
    first = np.empty(4 * len(points), np.int64)
    second = np.empty(4 * len(points), np.int64)
    count = 0
    gaps = np.empty(4)
    who = np.empty(4, np.int64)
    for i in range(len(points)):
        gaps[:] = np.inf
        for j in index[i]:
            dx, dy, dz = _offset(points, i, j)
            _, _, w, side = _tangent((dx, dy, dz), major[i], normals[i])
            m = normals[j]
            wj = dx * m[0] + dy * m[1] + dz * m[2]
            reach = np.sqrt(dx * dx + dy * dy + dz * dz)
            if reach < 0.5 * edge_m[i] or semantic[j] != semantic[i]:
                continue
            # Further off either tangent plane than a quarter of the way is another surface.
            if max(abs(w), abs(wj)) > 0.25 * reach:
                continue
            if reach < gaps[side]:
                gaps[side] = reach
                who[side] = j
        for side in range(4):
            # One of a pair of wires has nothing on its other side.
            if 1.5 * edge_m[i] < gaps[side] <= widest[semantic[i]] and gaps[side ^ 1] < np.inf:
                first[count] = i
                second[count] = who[side]
                count += 1
    return first[:count], second[:count]


def ground_points(points: PointSet) -> np.ndarray:
    """Return True for points that are ground, bool [N].

    They are found by class if any point has one. Else they are the lowest of their square metre
    where its height agrees with the squares around it.
    """
    flat = is_flat(points.semantic)
    if flat.any() or (points.semantic != Class.UNKNOWN).any():
        return flat
    return _low_points(points.points)


def fill_ground(points: PointSet, path: np.ndarray, *, voxel_m: float) -> PointSet:
    """Return new ground points, a little sparser than `thin_points`, with the class of the
    nearest point.
    """
    is_ground = ground_points(points)
    ground = points.points[is_ground]
    classes = points.semantic[is_ground]
    near = cKDTree(path[:, :2]).query(ground[:, :2])[0] < REACH_M
    ground = ground[near]
    classes = classes[near]
    if len(ground) < 16:
        return PointSet(points.points[:0], points.semantic[:0])
    origin = ground[:, :2].min(axis=0) - 2 * CLOSE_M
    shape = np.ceil((ground[:, :2].max(axis=0) + 2 * CLOSE_M - origin) / CELL_M).astype(int) + 1
    heights, has_ground = _height_grid(ground, origin, shape)
    # Holes among cells with ground up to 2 CLOSE_M wide count; nothing beyond the outline does.
    radius = round(CLOSE_M / CELL_M)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    inside = cv2.morphologyEx(has_ground.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
    inside |= _is_near_path(path, origin, shape)
    heights = _fill_holes(heights, has_ground)
    voxel_m = voxel_m * _SPARSER
    new = _candidates(heights, inside, origin, path, voxel_m)
    distance, nearest = cKDTree(ground[:, :2]).query(new[:, :2], workers=-1)
    missing = distance > 0.7 * edges_at(new, path, voxel_m=voxel_m)
    return PointSet(new[missing], classes[nearest[missing]])


def _is_near_path(path: np.ndarray, origin: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the cells within BESIDE_M of the path, bool [X, Y]: its car stood or drove there."""
    cells = np.floor((path[:, :2] - origin) / CELL_M).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    away = np.ones(shape, np.uint8)
    away[cells[:, 0], cells[:, 1]] = 0
    if not len(cells):
        return away == 0
    return cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M < BESIDE_M


def _height_grid(
    ground: np.ndarray, origin: np.ndarray, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean height [X, Y] of every cell that holds ground, and a mask of these cells."""
    cell = ((ground[:, :2] - origin) / CELL_M).astype(np.int64)
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    count = np.bincount(flat, minlength=shape[0] * shape[1])
    total = np.bincount(flat, ground[:, 2].astype(np.float64), shape[0] * shape[1])
    heights = (total / np.maximum(count, 1)).reshape(shape)
    return heights, (count > 0).reshape(shape)


def _fill_holes(heights: np.ndarray, has_ground: np.ndarray) -> np.ndarray:
    """Return heights for every cell.

    Holes get the smoothest surface that joins their rim (Laplace's equation, relaxed from averages
    over ever wider surroundings).
    """
    fixed = np.where(has_ground, heights, 0.0).astype(np.float32)
    out = fixed.copy()
    has_height = has_ground.copy()
    sigma = 1.0
    while not has_height.all() and sigma * CELL_M < 4 * CLOSE_M:
        both = cv2.GaussianBlur(np.dstack([fixed, has_ground.astype(np.float32)]), (0, 0), sigma)
        reached = ~has_height & (both[..., 1] > 1e-2)
        out[reached] = both[reached, 0] / both[reached, 1]
        has_height |= reached
        sigma *= 2.0
    for _ in range(_RELAXATIONS):
        out = np.where(has_ground, fixed, cv2.blur(out, (3, 3)))
    return out


def _candidates(
    heights: np.ndarray, inside: np.ndarray, origin: np.ndarray, path: np.ndarray, voxel_m: float
) -> np.ndarray:
    """Return points over all inside cells, as dense as the voxels are there, float32 [M, 3]."""
    cells = np.argwhere(inside)
    centres = np.column_stack([(cells + 0.5) * CELL_M + origin, heights[inside]])
    edges = edges_at(centres, path, voxel_m=voxel_m)
    out = []
    for edge in np.unique(edges):
        cell_centres = centres[edges == edge]
        count = max(1, round(CELL_M / float(edge)))
        # Coarser than a cell: keep about one cell in (edge / cell)^2, on a grid.
        stride = max(1, round(float(edge) / CELL_M))
        index = cells[edges == edge]
        cell_centres = cell_centres[(index % stride == 0).all(axis=1)]
        ticks = (np.arange(count) + 0.5) / count * CELL_M - CELL_M / 2
        dx, dy = np.meshgrid(ticks, ticks, indexing="ij")
        xy = cell_centres[:, None, :2] + np.stack([dx.ravel(), dy.ravel()], 1)[None]
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
