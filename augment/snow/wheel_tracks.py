"""Wheel tracks: where the ego and the scene's vehicles drive, drawn on the cells of the ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from augment.snow.actor_cells import is_vehicle, moves
from augment.snow.surface import Surface

EGO_WIDTH_M = 1.9
WHEEL_SHARE = 0.42  # of a vehicle's width, from its middle to its wheels
RUT_M, _RIM_M = 0.25, 0.05  # width of a rut, and standard deviation of its rim
EGO_BEYOND_M, ACTOR_BEYOND_M = 40.0, 15.0  # straight on before the first and after the last pose
_ROAD_CLASSES = (SemanticClass.ROAD, SemanticClass.LANE_MARKING)
_OFF_ROAD_M = 0.3  # height over or under the wheels beyond which a cell is no road
_OFF_KNOWN_ROAD_M = 0.8  # where classes say that it is one
_STEP_M = 0.5  # poses closer than this say nothing of the direction
_HEADING_M = 3.0  # stretch of a path that gives the direction of what is added to it
_AROUND_M = 5.0  # of a grid: so far a path is followed
_SHIFT = 4  # binary places of cv2's coordinates


@dataclass(frozen=True, eq=False)
class WheelPath:
    """points_m: float64 [P, 3], where a vehicle's middle passes, on the ground. width_m: its."""

    points_m: np.ndarray
    width_m: float


def wheel_paths(scene: Scene) -> tuple[WheelPath, ...]:
    """Paths of the ego and of the vehicles that move, each longer than what was recorded."""
    paths = []
    if scene.frames:
        poses = np.stack([frame.world_from_ego.numpy() for frame in scene.frames])
        ego = _path(poses, EGO_BEYOND_M)
        ego[:, 2] += _ground_below(scene.background, poses[:, :3, 3])
        paths.append(WheelPath(ego, EGO_WIDTH_M))
    for actor in scene.actors:
        if is_vehicle(actor) and moves(actor):
            path = _path(actor.track.world_from_actor.numpy(), ACTOR_BEYOND_M)
            path[:, 2] -= actor.size_m[2] / 2
            paths.append(WheelPath(path, actor.size_m[1]))
    return tuple(paths)


def draw_tracks(paths: Iterable[WheelPath], surface: Surface, classes: np.ndarray) -> np.ndarray:
    """float32 [H, W]: 0 to 1, how much of a wheel track each cell of the surface is.

    classes: int16 [H, W], UNKNOWN throughout where the scene has none.
    """
    grid, shape = surface.map, surface.can_carry.shape
    corner = np.array([grid.left_m, grid.bottom_m])
    size = np.array(shape[::-1]) * grid.cell_m
    ruts, wheels_m = np.zeros(shape, np.uint8), np.full(shape, np.nan, np.float32)
    thickness = max(1, round(RUT_M / grid.cell_m))
    drawn = False
    for path in paths:
        low, high = corner - _AROUND_M, corner + size + _AROUND_M
        for wheels in _wheel_lines(path):
            for line in _within(wheels, low, high):
                pixels = _pixels(line, corner, grid.cell_m)
                cv2.polylines(ruts, [pixels], False, 255, thickness, cv2.LINE_AA, _SHIFT)
                drawn = True
        wide = max(1, round((path.width_m + 2 * RUT_M) / grid.cell_m))
        for line in _within(path.points_m, low, high):
            pixels = _pixels(line, corner, grid.cell_m)
            for start in range(len(line) - 1):
                height = float(line[start : start + 2, 2].mean())
                ends = [pixels[start : start + 2]]
                cv2.polylines(wheels_m, ends, False, height, wide, cv2.LINE_8, _SHIFT)
    if not drawn:
        return np.zeros(shape, np.float32)
    strength = ruts.astype(np.float32) * np.float32(min(1.0, RUT_M / grid.cell_m) / 255)
    if _RIM_M / grid.cell_m > 0.3:
        strength = cv2.GaussianBlur(strength, (0, 0), _RIM_M / grid.cell_m)
    known = bool((classes != SemanticClass.UNKNOWN).any())
    off = _OFF_KNOWN_ROAD_M if known else _OFF_ROAD_M
    on_road = np.abs(surface.height_m - wheels_m) < off  # false where NaN
    if known:
        on_road &= np.isin(classes, _ROAD_CLASSES)
    return np.where(on_road & surface.can_carry, np.clip(strength, 0, 1), np.float32(0))


def _path(poses: np.ndarray, beyond_m: float) -> np.ndarray:
    """[P, 3]: places of poses [T, 4, 4] at least _STEP_M apart, gone on with at both ends."""
    points = [poses[0, :3, 3]]
    for place in poses[1:, :3, 3]:
        if np.linalg.norm(place - points[-1]) >= _STEP_M:
            points.append(place)
    path = np.stack(points)
    if len(path) == 1:
        ahead = poses[0, :3, 0]  # stands still: along its own axis
        back = -ahead
    else:
        back, ahead = _heading(path[::-1]), _heading(path)
    steps = np.arange(1.0, beyond_m + 1)[:, None]
    return np.concatenate([(path[0] + steps * back)[::-1], path, path[-1] + steps * ahead])


def _heading(path: np.ndarray) -> np.ndarray:
    """Unit direction in which a path leaves its last point."""
    gaps = np.linalg.norm(path - path[-1], axis=1)
    far = np.flatnonzero(gaps >= _HEADING_M)
    direction = path[-1] - path[far[-1] if len(far) else 0]
    return direction / max(float(np.linalg.norm(direction)), 1e-9)


def _ground_below(gaussians: Gaussians, positions: np.ndarray) -> float:
    """How far under the positions [P, 3] the ground lies (negative), by what is solid near them."""
    means = gaussians.means.numpy()
    solid = gaussians.opacities.numpy() > 0.3
    samples = positions[:: 1 + len(positions) // 32]
    low, high = samples.min(0) - np.array([1, 1, 3]), samples.max(0) + 1
    near = means[solid & (means >= low).all(1) & (means <= high).all(1)].astype(np.float64)
    gaps = []
    for place in samples:
        below = near[np.hypot(near[:, 0] - place[0], near[:, 1] - place[1]) < 1.0, 2] - place[2]
        below = below[(below > -2.5) & (below < 0.5)]
        if len(below) >= 3:
            gaps.append(np.median(below))
    return float(np.median(gaps)) if gaps else 0.0


def _wheel_lines(path: WheelPath) -> tuple[np.ndarray, np.ndarray]:
    """The path moved to the left and to the right wheels."""
    points = path.points_m
    along = np.gradient(points[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    aside = np.stack([-along[:, 1], along[:, 0], np.zeros(len(points))], -1)
    aside *= WHEEL_SHARE * path.width_m
    return points + aside, points - aside


def _within(line: np.ndarray, low: np.ndarray, high: np.ndarray) -> Sequence[np.ndarray]:
    """Stretches of two points and more between two corners."""
    inside = np.all((line[:, :2] >= low) & (line[:, :2] <= high), axis=1).reshape(-1)
    breaks = np.flatnonzero(np.diff(inside.astype(np.int8))) + 1
    parts = np.split(np.arange(len(line)), breaks)
    return [line[part] for part in parts if len(part) > 1 and inside[part].all()]


def _pixels(line: np.ndarray, corner: np.ndarray, cell_m: float) -> np.ndarray:
    """int32 [P, 1, 2]: as cv2 draws them, which counts from pixel centres."""
    pixels = (line[:, :2] - corner) / cell_m - 0.5
    return np.round(pixels * 2**_SHIFT).astype(np.int32)[:, None]
