"""Vertical planes of a scene: the walls that LiDAR returns lie on, as lines seen from above.

A Hough transform finds them one after another (Duda and Hart 1972): each upright splat votes, with
its area, for the lines through it that its normal allows. A line is fitted to the splats near it,
and cut where it has no splat over a long stretch. The caller is `adapters.lidar_scene.dense_depth`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians
from augment.scene.semantics import SemanticClass

_WALL_CLASSES = (
    SemanticClass.BUILDING,
    SemanticClass.BARRIER,
    SemanticClass.OTHER,
    SemanticClass.UNKNOWN,
)
_MAX_NORMAL_RISE = 0.3  # largest upward part of a wall splat's unit normal
_MAX_WALLS = 40  # lines that are looked for
_MIN_AREA_M2 = 3.0  # least area of splats on a wall
_MIN_LENGTH_M = 1.5  # least length of a wall
_MAX_GAP_M = 8.0  # longest stretch without a splat inside a wall
_ANGLE_STEP_DEG = 2.0  # step of the Hough transform
_OFFSET_STEP_M = 0.15  # step of the Hough transform
_FIT_M = 0.6  # distance from the line of votes within which splats are fitted first
_ON_WALL_M = 0.3  # distance from a fitted line within which splats belong to it
_MIN_COSINE = 0.8  # of the angle between the normals of a wall and of its splats
_MIN_SPLATS = 20  # fewest splats that a line is fitted to
_MAX_SPLATS = 60_000  # that vote; of more, every so many
_MIN_SLANT = 0.03  # cosine to a wall's normal below which a ray runs along it


@dataclass(frozen=True, eq=False)
class WallPlanes:
    """W vertical planes, each between two ends.

    A point (x, y) lies on plane i if normals[i] . (x, y) = offsets[i].
    """

    normals: np.ndarray
    """Unit normals in plan, float64 [W, 2]."""
    offsets: np.ndarray
    """Distances from the world's origin along the normals, metres, float64 [W]."""
    starts: np.ndarray
    """First places along the tangents (-normal y, normal x), metres, float64 [W]."""
    ends: np.ndarray
    """Last places along the tangents, metres, float64 [W]."""

    def __len__(self) -> int:
        return len(self.offsets)

    def tangents(self) -> np.ndarray:
        """Return the directions of the walls in plan, float64 [W, 2]."""
        return np.stack([-self.normals[:, 1], self.normals[:, 0]], 1)

    def nearest(self, points: np.ndarray, max_distance_m: float, margin_m: float) -> np.ndarray:
        """Return the number of the wall that each point lies on, -1 for none, int64 [N].

        Args:
            points: float [N, 2], in plan.
            max_distance_m: largest distance from the plane.
            margin_m: length by which walls are prolonged at both ends.
        """
        wall = np.full(len(points), -1, np.int64)
        best = np.full(len(points), max_distance_m)
        for number, tangent in enumerate(self.tangents()):
            distance = np.abs(points @ self.normals[number] - self.offsets[number])
            close = np.flatnonzero(distance < best)
            along = points[close] @ tangent
            on_wall = close[self._is_between(along, number, margin_m)]
            wall[on_wall] = number
            best[on_wall] = distance[on_wall]
        return wall

    def meet(
        self, number: int, centre: np.ndarray, rays: np.ndarray, margin_m: float
    ) -> np.ndarray:
        """Return the distance in plan at which rays meet one wall, infinite for none, float64 [N].

        Args:
            number: the wall.
            centre: float64 [2], where the rays begin, in plan.
            rays: float64 [N, 2], unit directions in plan.
            margin_m: length by which the wall is prolonged at both ends.
        """
        slant = rays @ self.normals[number]
        runs_along = np.abs(slant) < _MIN_SLANT
        distance = self.offsets[number] - centre @ self.normals[number]
        times = distance / np.where(runs_along, 1.0, slant)
        along = (centre + rays * times[:, None]) @ self.tangents()[number]
        meets = (times > 0) & ~runs_along & self._is_between(along, number, margin_m)
        return np.where(meets, times, np.inf)

    def _is_between(self, along: np.ndarray, number: int, margin_m: float) -> np.ndarray:
        return (along > self.starts[number] - margin_m) & (along < self.ends[number] + margin_m)


def find_wall_planes(gaussians: Gaussians) -> WallPlanes:
    """Return the walls of the background, the ones with most surface first."""
    rows: list[tuple[float, ...]] = []
    points, normals, area = _wall_splats(gaussians)
    if len(points) >= _MIN_SPLATS:
        middle = points.mean(axis=0)
        rows = _search(points - middle, normals, area, middle)
    table = np.array(rows, np.float64).reshape(-1, 5)
    return WallPlanes(table[:, :2], table[:, 2], table[:, 3], table[:, 4])


def _wall_splats(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places and unit normals in plan, float64 [N, 2], and areas in m2 of upright splats."""
    assert gaussians.semantic is not None
    rows = np.flatnonzero(np.isin(gaussians.semantic.numpy(), _WALL_CLASSES))
    scales = gaussians.scales[torch.from_numpy(rows)].numpy().astype(np.float64)
    rotations = rotmat_from_quat(gaussians.quats[torch.from_numpy(rows)].double()).numpy()
    thinnest = scales.argmin(axis=1)
    normals = np.take_along_axis(rotations, thinnest[:, None, None], 2)[:, :, 0]
    upright = np.flatnonzero(np.abs(normals[:, 2]) < _MAX_NORMAL_RISE)
    upright = upright[:: max(1, -(-len(upright) // _MAX_SPLATS))]
    level = normals[upright, :2]
    sorted_scales = np.sort(scales[upright], axis=1)
    return (
        gaussians.means.numpy()[rows[upright], :2].astype(np.float64),
        level / np.linalg.norm(level, axis=1, keepdims=True),
        4 * sorted_scales[:, 1] * sorted_scales[:, 2],
    )


def _search(
    points: np.ndarray, normals: np.ndarray, area: np.ndarray, middle: np.ndarray
) -> list[tuple[float, ...]]:
    """Return normal x and y, offset, start and end of each wall. points: around the middle."""
    rows: list[tuple[float, ...]] = []
    angle_step = np.radians(_ANGLE_STEP_DEG)
    turns = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / angle_step).astype(np.int64)
    is_free = np.ones(len(points), np.bool_)
    for _ in range(_MAX_WALLS):
        free = np.flatnonzero(is_free)
        if len(free) < _MIN_SPLATS:
            break
        line = _most_voted_line(points[free], turns[free], area[free])
        if line is None:
            break
        normal, offset = line
        for reach_m in (_FIT_M, _ON_WALL_M, _ON_WALL_M):
            distance = np.abs(points @ normal - offset)
            close = is_free & (distance < reach_m) & (np.abs(normals @ normal) > _MIN_COSINE)
            if close.sum() < _MIN_SPLATS:
                break
            weights = area[close] / area[close].sum()
            mean = weights @ points[close]
            offsets = points[close] - mean
            _, axes = np.linalg.eigh((offsets * weights[:, None]).T @ offsets)
            normal = axes[:, 0]
            offset = float(normal @ mean)
        distance = np.abs(points @ normal - offset)
        on_wall = is_free & (distance < _ON_WALL_M) & (np.abs(normals @ normal) > _MIN_COSINE)
        rows += _cut_into_walls(points, area, np.flatnonzero(on_wall), normal, offset, middle)
        # What the votes were for is used up, even if the fitted line is another.
        is_free &= ~on_wall
        used = np.abs(points @ line[0] - line[1]) < _OFFSET_STEP_M
        is_free &= ~(used & (np.abs(normals @ line[0]) > _MIN_COSINE))
    return rows


def _most_voted_line(
    points: np.ndarray, turns: np.ndarray, area: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Return normal and offset of the line with most area of splats; None below _MIN_AREA_M2.

    turns: int64 [N], directions of the normals in steps of the transform.
    """
    angle_step = np.radians(_ANGLE_STEP_DEG)
    num_angles = round(np.pi / angle_step)
    reach = float(np.linalg.norm(points, axis=1).max()) + _OFFSET_STEP_M
    num_offsets = int(2 * reach / _OFFSET_STEP_M) + 2
    votes = np.zeros((num_angles, num_offsets))
    for beside in (-1, 0, 1):
        angle = (turns + beside) * angle_step
        offset = points[:, 0] * np.cos(angle) + points[:, 1] * np.sin(angle)
        half_turns, row = np.divmod(turns + beside, num_angles)
        offset = np.where(half_turns % 2 == 1, -offset, offset)
        column = ((offset + reach) / _OFFSET_STEP_M).astype(np.int64).clip(0, num_offsets - 1)
        cell = row * num_offsets + column
        votes += np.bincount(cell, area, votes.size).reshape(votes.shape)
    votes[:, 1:-1] = votes[:, :-2] + votes[:, 1:-1] + votes[:, 2:]
    row, column = np.unravel_index(int(votes.argmax()), votes.shape)
    if votes[row, column] < _MIN_AREA_M2:
        return None
    angle = row * angle_step
    normal = np.array([np.cos(angle), np.sin(angle)])
    return normal, float((column + 0.5) * _OFFSET_STEP_M - reach)


def _cut_into_walls(
    points: np.ndarray,
    area: np.ndarray,
    on_wall: np.ndarray,
    normal: np.ndarray,
    offset: float,
    middle: np.ndarray,
) -> list[tuple[float, ...]]:
    """Return the walls on a line. on_wall: int64 [M], the splats on it."""
    if len(on_wall) < _MIN_SPLATS:
        return []
    tangent = np.array([-normal[1], normal[0]])
    along = points[on_wall] @ tangent
    order = np.argsort(along, kind="stable")
    gaps = np.flatnonzero(np.diff(along[order]) > _MAX_GAP_M) + 1
    rows = []
    for piece in np.split(order, gaps):
        start = float(along[piece[0]])
        end = float(along[piece[-1]])
        if area[on_wall[piece]].sum() >= _MIN_AREA_M2 and end - start >= _MIN_LENGTH_M:
            shift = float(tangent @ middle)
            whole_offset = offset + float(normal @ middle)
            rows.append((normal[0], normal[1], whole_offset, start + shift, end + shift))
    return rows
