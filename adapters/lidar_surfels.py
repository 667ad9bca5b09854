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

NEIGHBOURS = 16
_LINE = 0.02  # middle over largest variance below which neighbours lie on a line, not a plane


@dataclass(frozen=True, eq=False)
class Surfels:
    """N discs. centres, normals, major: float32 [N, 3]; normals and major are unit and orthogonal,
    major is the first tangent axis and normals x major the second. spacing: float32 [N, 2], metres
    to the neighbours along the tangent axes. isolated: bool [N], too few neighbours for a surface.
    """

    centres: np.ndarray
    normals: np.ndarray
    major: np.ndarray
    spacing: np.ndarray
    isolated: np.ndarray

    def __len__(self) -> int:
        return len(self.centres)

    def select(self, index: np.ndarray) -> Surfels:
        """The surfels at the given indices."""
        return Surfels(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))


def surfels_from_points(
    points: np.ndarray,
    edge_m: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    max_stretch: float = 4.0,
) -> Surfels:
    """A surfel for every point.

    points: float32 [N, 3]. edge_m: float32 [N], distance that the points were thinned to there.
    normals: float32 [N, 3] where they are known; else they come from the principal axes of the
    nearest points. max_stretch: longest extent in units of edge_m; wider gaps stay open.
    """
    count = len(points)
    if count < 4:
        frame = np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))
        spacing = np.repeat(edge_m[:, None], 2, 1).astype(np.float32)
        return Surfels(points, frame[:, 2], frame[:, 0], spacing, np.ones(count, bool))
    k = min(NEIGHBOURS, count)
    tree = cKDTree(points)
    distance, index = tree.query(points, k=k, workers=-1)
    axes = _principal_axes(points, index) if normals is None else _axes_about(normals)
    spacing = _spacing(points, index, axes[:, 0], axes[:, 2], edge_m, np.float32(max_stretch))
    # On a surface thinned to edge_m the fourth neighbour is a little over one edge away.
    isolated = distance[:, min(4, k - 1)] > 4 * edge_m
    return Surfels(points, axes[:, 2], axes[:, 0], spacing, isolated)


def _principal_axes(points: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Axis of largest variance, middle one, and normal of every point, float32 [N, 3 axes, 3].

    Where neighbours lie on a line the plane is undefined; if the line is not steep the normal is
    then the steepest direction across it, since most such lines are rings on the ground.
    """
    values, vectors = np.linalg.eigh(_covariances(points, index))
    major, normal = vectors[:, :, 2], vectors[:, :, 0]
    on_line = values[:, 1] < _LINE * values[:, 2]
    up = np.array([0.0, 0.0, 1.0])
    across = up - major * major[:, 2:]
    length = np.linalg.norm(across, axis=1, keepdims=True)
    flat_line = on_line & (length[:, 0] > 0.3)
    normal = np.where(flat_line[:, None], across / np.maximum(length, 1e-9), normal)
    return np.stack([major, np.cross(normal, major), normal], axis=1).astype(np.float32)


def _axes_about(normals: np.ndarray) -> np.ndarray:
    """Tangent axes of given unit normals, the first as level as can be, float32 [N, 3 axes, 3]."""
    up = np.array([0.0, 0.0, 1.0])
    level = np.cross(up, normals)
    steep = np.linalg.norm(level, axis=1, keepdims=True) > 1e-3
    level = np.where(steep, level, np.array([1.0, 0.0, 0.0]))
    level -= normals * (level * normals).sum(1, keepdims=True)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return np.stack([level, np.cross(normals, level), normals], axis=1).astype(np.float32)


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
def _spacing(points, index, major, normals, edge_m, max_stretch):  # pragma: no cover - compiled
    """Mean over both sides of the gap to the nearest neighbour on the plane within 45 degrees of
    each tangent half axis. With a neighbour on one side only this is the surface's rim, or one of two
    wires: it is not stretched towards that neighbour."""
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
            elif np.isinf(a) or np.isinf(b):
                gap = min(min(a, b), 1.5 * edge_m[i])
            else:
                gap = 0.5 * (a + b)
            if gap > max_stretch * edge_m[i]:
                gap = edge_m[i]
            out[i, axis] = max(gap, 0.5 * edge_m[i])
    return out
