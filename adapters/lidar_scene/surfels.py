"""Points to surfels: a tangent plane, and an extent along two axes of it that closes the surface.

LiDAR points lie dense along a ring and sparse across rings, so a round splat either leaves gaps or
smears. Each point's extent is measured apart along its two tangent axes, from the nearest
neighbours to either side. Before, accumulated points are thinned to one a voxel, finer near the
path that was driven.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numba
import numpy as np
import torch
from scipy.spatial import cKDTree

from adapters.lidar_scene.split import PointSet, is_flat
from augment.geometry import quat_from_rotmat
from augment.render.sh import SH_C0
from augment.scene import Gaussians
from augment.semantics import SemanticClass

NEAR_M = 6.0  # voxels have their given size up to this distance from the path
# Edges grow with this power of the distance: slower than a LiDAR's spacing, because a narrow camera
# still resolves what is far ahead.
GROWTH = 0.7
_STEP = 0.5  # octaves of distance that share a size, so that points near each other share a grid
_MAX_LEVEL = 15
NEIGHBOURS = 12  # nearest points, and as many again out of a coarser sample
_COARSE = 4.0  # edges between points of that sample: it reaches across the gap between two rings
_STRETCH, _STRETCH_FIRM = 2.0, 4.0  # widest gap in edges that a splat closes; on ground and walls
_UPRIGHT = (SemanticClass.BUILDING, SemanticClass.BARRIER, SemanticClass.SIGN)
_LINE = 0.02  # middle over largest variance below which neighbours lie on a line, not a plane
_GROUND_SIGMA_PER_SPACING = 0.6  # wider than elsewhere: the ground must not leak
_THICKNESS = 0.15  # standard deviation along the normal over the smaller tangent one
_MIN_THICKNESS_M = 0.005


def thin_points(
    points: PointSet, path: np.ndarray, *, voxel_m: float
) -> tuple[PointSet, np.ndarray]:
    """The mean point and commonest class of every occupied voxel, and the voxels' edges in metres.

    path: float [P, 3], positions in the frame of the points. The edge is voxel_m within NEAR_M of
    the path and grows with the power GROWTH of the distance beyond."""
    if len(points) == 0:
        return points, np.zeros(0, np.float32)
    level = _levels(points.points, np.ascontiguousarray(path, np.float32))
    edges = _edges(voxel_m)
    keys = _keys(points.points, level, edges)
    order = np.argsort(keys, kind="stable")
    means, classes, levels = _reduce(
        points.points[order], points.semantic[order], keys[order], level[order]
    )
    return PointSet(means, classes), edges[levels].astype(np.float32)


def edges_at(points: np.ndarray, path: np.ndarray, *, voxel_m: float) -> np.ndarray:
    """The edge that `thin_points` uses at each position, metres, float32 [N]."""
    points, path = (np.ascontiguousarray(a, np.float32) for a in (points, path))
    level = _levels(points, path)
    return _edges(voxel_m)[level].astype(np.float32)


def coarse_sample(points: np.ndarray, cell_m: np.ndarray) -> np.ndarray:
    """Indices of one point a cell of about the given size at it (float32 [N]); int64, ascending."""
    level = np.clip(np.round(2 * np.log2(cell_m / cell_m.min())), 0, _MAX_LEVEL).astype(np.uint8)
    sizes = cell_m.min() * 2.0 ** (0.5 * np.arange(_MAX_LEVEL + 1))
    _, first = np.unique(_keys(points, level, sizes.astype(np.float64)), return_index=True)
    return np.sort(first)


def _edges(voxel_m: float) -> np.ndarray:
    return voxel_m * 2.0 ** (_STEP * GROWTH * np.arange(_MAX_LEVEL + 1))


@numba.njit(cache=True)
def _levels(points, path):  # pragma: no cover - compiled
    out = np.empty(len(points), np.uint8)
    for i in range(len(points)):
        best = np.inf
        for j in range(len(path)):
            dx = points[i, 0] - path[j, 0]
            dy = points[i, 1] - path[j, 1]
            dz = points[i, 2] - path[j, 2]
            best = min(best, dx * dx + dy * dy + dz * dz)
        level = np.ceil(0.5 * np.log2(max(best, 1e-12) / (NEAR_M * NEAR_M)) / _STEP)
        out[i] = np.uint8(min(max(level, 0.0), _MAX_LEVEL))
    return out


@numba.njit(cache=True)
def _keys(points, level, edges):  # pragma: no cover - compiled
    """4 bits of level, then 20 a coordinate: 20 km each way at the finest edge."""
    out = np.empty(len(points), np.uint64)
    mask = np.uint64((1 << 20) - 1)
    for i in range(len(points)):
        key = np.uint64(level[i])
        for axis in range(3):
            cell = np.int64(np.floor(np.float64(points[i, axis]) / edges[level[i]])) + (1 << 19)
            key = (key << np.uint64(20)) | (np.uint64(cell) & mask)
        out[i] = key
    return out


@numba.njit(cache=True)
def _reduce(points, semantic, keys, level):  # pragma: no cover - compiled
    """Runs of equal keys to their mean, commonest class (the lower of equals) and level."""
    runs = 1
    for i in range(1, len(keys)):
        runs += keys[i] != keys[i - 1]
    means = np.empty((runs, 3), np.float32)
    classes = np.empty(runs, np.int16)
    levels = np.empty(runs, np.uint8)
    votes = np.zeros(64, np.int64)
    start, run = 0, 0
    for end in range(1, len(keys) + 1):
        if end < len(keys) and keys[end] == keys[start]:
            continue
        sums = np.zeros(3)
        votes[:] = 0
        for i in range(start, end):
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
        levels[run] = level[start]
        start, run = end, run + 1
    return means, classes, levels


@dataclass(frozen=True, eq=False)
class Surfels:
    """N discs. centres, normals, major: float32 [N, 3]; normals and major are unit and orthogonal,
    major is the first tangent axis and normals x major the second. spacing: float32 [N, 2], metres
    to the neighbours along the tangent axes. isolated: bool [N], too few neighbours for a surface.
    neighbours: int [N, K], see `find_neighbours`."""

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
        """Round surfels of any float type, spacing [N], without neighbours."""
        spacing = np.repeat(spacing_m[:, None], 2, axis=1)
        floats = [a.astype(np.float32) for a in (centres, normals, major, spacing)]
        count = len(centres)
        return Surfels(*floats, np.zeros(count, np.bool_), np.zeros((count, 0), np.int64))

    def select(self, index: np.ndarray) -> Surfels:
        """The surfels at the given indices; neighbours still count through all."""
        return Surfels(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))


def surfels_from_points(
    points: np.ndarray, edge_m: np.ndarray, *, semantic: np.ndarray | None = None
) -> Surfels:
    """A surfel for every point.

    points: float32 [N, 3]. edge_m: float32 [N], distance that the points were thinned to there.
    semantic: int16 [N], SemanticClass: says how wide a gap may be closed, that ground has no rim,
    and which way a lone ring faces: up on the ground, sideways on a building. Normals come from the
    principal axes of the nearest points."""
    count = len(points)
    if count < 4:
        frame = np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))
        spacing = np.repeat(edge_m[:, None], 2, 1).astype(np.float32)
        return Surfels(
            points,
            frame[:, 2],
            frame[:, 0],
            spacing,
            np.ones(count, bool),
            np.zeros((count, 0), int),
        )
    index, distance = find_neighbours(points, edge_m)
    axes = _principal_axes(points, index, semantic)
    if semantic is None:
        semantic = np.zeros(count, np.int16)
    endless = is_flat(semantic)
    firm = endless | _is_upright(semantic) | (semantic == SemanticClass.UNKNOWN)
    stretch = np.where(firm, _STRETCH_FIRM, _STRETCH).astype(np.float32) * edge_m
    spacing = _spacing(points, index, axes[:, 0], axes[:, 2], edge_m, stretch, endless)
    # On a surface thinned to edge_m the fourth neighbour is a little over one edge away.
    isolated = distance[:, min(4, distance.shape[1] - 1)] > 4 * edge_m
    return Surfels(points, axes[:, 2], axes[:, 0], spacing, isolated, index)


def find_neighbours(points: np.ndarray, edge_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours of each point near and further away, int [N, K], and the distances of the near
    ones, float [N, K / 2]. Points may come twice, and come first themselves."""
    k = min(NEIGHBOURS, len(points))
    distance, near = cKDTree(points).query(points, k=k, workers=-1)
    sample = coarse_sample(points, edge_m * np.float32(_COARSE))
    k = min(NEIGHBOURS, len(sample))
    _, far = cKDTree(points[sample]).query(points, k=[*range(1, k + 1)], workers=-1)
    return np.concatenate([near, sample[far]], axis=1), distance


def _principal_axes(
    points: np.ndarray, index: np.ndarray, semantic: np.ndarray | None
) -> np.ndarray:
    """Axis of largest variance, middle one, and normal of every point, float32 [N, 3 axes, 3]."""
    values, vectors = np.linalg.eigh(_covariances(points, index))
    major, normal = vectors[:, :, 2], vectors[:, :, 0]
    if semantic is not None:
        on_line = (values[:, 1] < _LINE * values[:, 2]) & (np.abs(major[:, 2]) < 0.9)
        sideways = np.cross(major, np.array([0.0, 0.0, 1.0]))
        hints = [(is_flat(semantic), np.cross(sideways, major)), (_is_upright(semantic), sideways)]
        for mask, hint in hints:
            hint = hint / np.maximum(np.linalg.norm(hint, axis=1, keepdims=True), 1e-9)
            normal = np.where((mask & on_line)[:, None], hint, normal)
    return np.stack([major, np.cross(normal, major), normal], axis=1).astype(np.float32)


def _is_upright(semantic: np.ndarray) -> np.ndarray:
    return np.isin(semantic, _UPRIGHT)


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def _spacing(points, index, major, normals, edge_m, widest, endless):  # pragma: no cover - compiled
    """Mean over both sides of the gap to the nearest neighbour on the plane within 45 degrees of
    each tangent half axis. With one side far emptier this is the surface's rim, or one of two
    wires: it is not stretched that way. Where the surface is endless (ground) the larger gap
    counts."""
    out = np.empty((len(points), 2), np.float32)
    gaps = np.empty(4)
    for i in range(len(points)):
        e1, n = major[i], normals[i]
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
            reach = np.sqrt(u * u + v * v)
            # Nearer than half an edge is the same sample seen from the next voxel.
            # Steeper than 1 in 2 off the plane is another surface.
            if reach < 0.5 * edge_m[i] or abs(w) > 0.5 * reach:
                continue
            side = (0 if u > 0 else 1) if abs(u) >= abs(v) else (2 if v > 0 else 3)
            gaps[side] = min(gaps[side], reach)
        for axis in range(2):
            a, b = gaps[2 * axis], gaps[2 * axis + 1]
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
    """How a surfel becomes a Gaussian.

    sigma_per_spacing: standard deviation along a tangent axis over the spacing there; 0.4 leaves
    a lattice visible, 0.6 blurs. opacity: of every splat; high, so that a surface hides
    what lies behind it."""

    sigma_per_spacing: float = 0.5
    opacity: float = 0.95


def gaussians_from_surfels(
    surfels: Surfels,
    colours: np.ndarray,
    semantic: np.ndarray | None = None,
    shape: SplatShape = SplatShape(),
) -> Gaussians:
    """Degree-0 Gaussians flattened along the surfels' normals.

    colours: float32 [N, 3] in [0, 1]. semantic: int16 [N] or None."""
    second = np.cross(surfels.normals, surfels.major)
    axes = np.stack([surfels.major, second, surfels.normals], axis=2)  # columns
    sigma = np.full(len(surfels), shape.sigma_per_spacing, np.float32)
    if semantic is not None:
        sigma[is_flat(semantic)] = _GROUND_SIGMA_PER_SPACING
    tangent = surfels.spacing * sigma[:, None]
    thin = np.maximum(tangent.min(axis=1) * _THICKNESS, _MIN_THICKNESS_M)
    scales = np.concatenate([tangent, thin[:, None]], axis=1).astype(np.float32)
    return Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(surfels.centres, np.float32)),
        quats=quat_from_rotmat(torch.from_numpy(axes.astype(np.float64))).float(),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(surfels),), shape.opacity),
        sh=((torch.from_numpy(colours).float() - 0.5) / SH_C0)[:, None, :],
        semantic=None if semantic is None else torch.from_numpy(semantic.astype(np.int16)),
    )


def borrow_colours(
    points: np.ndarray, colours: np.ndarray, seen: np.ndarray, reach_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours for unseen points from the nearest seen one within reach, and who has a colour now.

    points: float32 [N, 3]. colours: float32 [N, 3]. seen: bool [N]. reach_m: float32 [N]."""
    if seen.all() or not seen.any():
        return colours, seen
    unseen = np.flatnonzero(~seen)
    distance, nearest = cKDTree(points[seen]).query(points[unseen], workers=-1)
    near = distance <= reach_m[unseen]
    colours, seen = colours.copy(), seen.copy()
    colours[unseen[near]] = colours[np.flatnonzero(seen)[nearest[near]]]
    seen[unseen[near]] = True
    return colours, seen
