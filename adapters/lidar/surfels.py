"""Points to surfels: a tangent plane, and an extent along two axes of it that closes the surface.

LiDAR points lie dense along a ring and sparse across rings, so a round splat either leaves gaps or
smears. Each point's extent is measured apart along its two tangent axes, from the nearest
neighbours to either side.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from adapters.lidar.split import is_flat
from adapters.lidar.voxels import coarse_sample
from augment.semantics import SemanticClass

NEIGHBOURS = 12  # nearest points, and as many again out of a coarser sample
_COARSE = 4.0  # edges between points of that sample: it reaches across the gap between two rings
_STRETCH, _STRETCH_FIRM = 2.0, 4.0  # widest gap in edges that a splat closes; on ground and walls
_UPRIGHT = (SemanticClass.BUILDING, SemanticClass.BARRIER, SemanticClass.SIGN)
_LINE = 0.02  # middle over largest variance below which neighbours lie on a line, not a plane


@dataclass(frozen=True, eq=False)
class Surfels:
    """N discs. centres, normals, major: float32 [N, 3]; normals and major are unit and orthogonal,
    major is the first tangent axis and normals x major the second. spacing: float32 [N, 2], metres
    to the neighbours along the tangent axes. isolated: bool [N], too few neighbours for a surface.
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

    def select(self, index: np.ndarray) -> Surfels:
        """The surfels at the given indices; neighbours still count through all."""
        return Surfels(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))


def surfels_from_points(
    points: np.ndarray,
    edge_m: np.ndarray,
    *,
    semantic: np.ndarray | None = None,
) -> Surfels:
    """A surfel for every point.

    points: float32 [N, 3]. edge_m: float32 [N], distance that the points were thinned to there.
    semantic: int16 [N], SemanticClass: says how wide a gap may be closed, that ground has no rim,
    and which way a lone ring faces: up on the ground, sideways on a building. Normals come from the
    principal axes of the nearest points.
    """
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
