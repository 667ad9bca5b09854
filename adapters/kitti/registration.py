"""Poses from the sweeps themselves, where a drive has none: point-to-plane ICP between neighbours.

Every step is NumPy on one thread, so that the same sweeps give the same bits; parallel sums, as
libraries for point clouds take them, change the last ones from run to run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.kitti.poses import Poses
from augment.errors import AdapterError

_VOXEL_M = 0.25
_NEAR_M, _FAR_M = 2.6, 60.0  # nearer is the recording car, further is sparse
_NEIGHBOURS = 12
_FLAT = 0.05  # a normal is believed where its variance is less than this of the next
_STAGES = ((4.0, 12), (1.5, 12), (0.5, 15))  # reach of a match in metres, iterations
_LOOSE_M = 0.2  # of a residual, in the last stage, where its weight has fallen to half
_SETTLED = 1e-6  # metres and radians that a step still changes
_FEWEST = 200
_POOR_FITNESS = 0.5


@dataclass(frozen=True, eq=False)
class _Surface:
    """Thinned points [N, 3] of a sweep, those of them on surfaces [M, 3], and normals [M, 3]."""

    points: np.ndarray
    flat: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class Match:
    """before_from_after: float64 [4, 4]. fitness: part of the points with a surface within half a
    metre. rmse_m: of their distances from it."""

    before_from_after: np.ndarray
    fitness: float
    rmse_m: float


def registered_poses(numbers: Sequence[int], read: Callable[[int], np.ndarray | None]) -> Poses:
    """Poses of the frames with a sweep, in the Velodyne's frame of the first.

    read: the returns [N, 3 or more] of a frame in the Velodyne's frame, or None.
    Each sweep is matched with the one before, starting from the motion between the two before.

    Raises:
        AdapterError: no frame has a sweep, or one has too few surfaces.
    """
    pose, step = np.eye(4), np.eye(4)
    poses: dict[int, np.ndarray] = {}
    matches: dict[int, Match] = {}
    before: _Surface | None = None
    for number in tqdm(numbers, desc="registration", unit="sweep", disable=None):
        returns = read(number)
        if returns is None:
            continue
        after = _surface(returns[:, :3].astype(np.float64), number)
        if before is not None:
            match = _match(after, before, step)
            matches[number] = match
            step = match.before_from_after
            pose = pose @ step
        poses[number] = pose
        before = after
    if not poses:
        raise AdapterError(
            f"poses=icp: frames {numbers[0]} to {numbers[-1]} have no sweep to find poses from"
        )
    return Poses(poses, _described(matches))


def _described(matches: dict[int, Match]) -> tuple[str, ...]:
    if not matches:
        return ()
    fitness = np.mean([m.fitness for m in matches.values()])
    rmse = np.mean([m.rmse_m for m in matches.values()])
    said = (
        f"poses are from registering {len(matches) + 1} sweeps one after the other (poses=icp): "
        f"mean fitness {fitness:.3f}, inlier RMSE {rmse:.3f} m; they drift over long drives"
    )
    poor = [number for number, m in matches.items() if m.fitness < _POOR_FITNESS]
    if not poor:
        return (said,)
    return (
        said,
        f"the sweep of frame {poor[0]} and {len(poor) - 1} others hardly match the one before",
    )


def _match(after: _Surface, before: _Surface, guess: np.ndarray) -> Match:
    tree = cKDTree(before.flat)
    transform = guess
    for reach_m, iterations in _STAGES:
        loose = _LOOSE_M * reach_m / _STAGES[-1][0]
        for _ in range(iterations):
            moved, index, near = _nearest(tree, after, transform, reach_m)
            residual = _residuals(moved[near], before, index[near])
            step = _step(moved[near], before.normals[index[near]], residual, loose)
            transform = step @ transform
            if np.abs(step - np.eye(4)).max() < _SETTLED:
                break
    moved, index, near = _nearest(tree, after, transform, _STAGES[-1][0])
    residual = _residuals(moved[near], before, index[near])
    rmse = float(np.sqrt(np.mean(residual**2))) if near.any() else float("inf")
    return Match(transform, float(near.mean()), rmse)


def _nearest(
    tree: cKDTree, after: _Surface, transform: np.ndarray, reach_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points moved [N, 3], the nearest surface point of each [N], and whether it is in reach."""
    moved = after.points @ transform[:3, :3].T + transform[:3, 3]
    distance, index = tree.query(moved, distance_upper_bound=reach_m)
    return moved, index, np.isfinite(distance)


def _residuals(points: np.ndarray, surface: _Surface, index: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", points - surface.flat[index], surface.normals[index])


def _step(
    points: np.ndarray, normals: np.ndarray, residual: np.ndarray, loose_m: float
) -> np.ndarray:
    """The Gauss-Newton step as a rigid transform; far residuals, as of what moves, weigh little."""
    weight = 1 / (1 + (residual / loose_m) ** 2)
    jacobian = np.concatenate([np.cross(points, normals), normals], axis=1)  # [N, 6]
    hessian = np.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    gradient = np.einsum("n,n,ni->i", weight, residual, jacobian)
    # A direction that no surface holds stays where it is.
    change = -np.linalg.solve(hessian + 1e-6 * np.trace(hessian) * np.eye(6), gradient)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix()
    step[:3, 3] = change[3:]
    return step


def _surface(points: np.ndarray, number: int) -> _Surface:
    distance = np.linalg.norm(points, axis=1)
    points = points[(distance > _NEAR_M) & (distance < _FAR_M)]  # False for NaN too
    thin = _thinned(points)
    if len(thin) >= _FEWEST:
        normals, flat = _normals(thin)
        if flat.sum() >= _FEWEST:
            return _Surface(thin, thin[flat], normals[flat])
    raise AdapterError(
        f"poses=icp: the sweep of frame {number} has too few surfaces ({len(thin)} points) to be "
        f"registered; give poses=FILE, or frames without it"
    )


def _thinned(points: np.ndarray) -> np.ndarray:
    """The mean of the points of each voxel."""
    x, y, z = np.floor((points + _FAR_M) / _VOXEL_M).astype(np.int64).T
    side = int(2 * _FAR_M / _VOXEL_M) + 1
    _, cell, counts = np.unique((x * side + y) * side + z, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, points[:, i], len(counts)) for i in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def _normals(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The direction of least spread around each point [N, 3]; whether that is flat, bool [N]."""
    _, index = cKDTree(points).query(points, _NEIGHBOURS)
    offset = points[index] - points[index].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    return axes[:, :, 0], variance[:, 0] < _FLAT * variance[:, 1]
