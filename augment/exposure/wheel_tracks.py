"""Wheel tracks: paths of the ego and of the scene's vehicles, and their ruts on a grid.

Caller: `search`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from augment.exposure.surface import Surface, is_moving, is_vehicle
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass

EGO_WIDTH_M = 1.9  # width of the recording car
WHEEL_OFFSET_SHARE = 0.42  # distance from a vehicle's middle to its wheels, in its width
RUT_WIDTH_M = 0.25  # width of a rut
_RUT_BLUR_M = 0.05  # standard deviation of the blur of a rut's rim
# Lengths by which paths go straight on before their first and after their last pose.
EGO_EXTENSION_M = 40.0
ACTOR_EXTENSION_M = 15.0
_ROAD_CLASSES = (SemanticClass.ROAD, SemanticClass.LANE_MARKING)
_MAX_WHEEL_GAP_M = 0.3  # height over or under the wheels beyond which a cell is no road
_MAX_ROAD_GAP_M = 0.8  # the same where the scene's classes say that the cell is road
_MIN_POSE_STEP_M = 0.5  # poses closer than this say nothing about the direction
_HEADING_LENGTH_M = 3.0  # length of the stretch of a path that gives the direction of its extension
_GRID_MARGIN_M = 5.0  # distance beyond a grid up to which a path is drawn
_SUBPIXEL_BITS = 4  # binary places of cv2's coordinates


@dataclass(frozen=True, eq=False)
class WheelPath:
    """Path of a vehicle over the ground."""

    points_m: np.ndarray  # float64 [P, 3], places of the vehicle's middle, on the ground
    width_m: float  # width of the vehicle


def has_recorded_drive(scene: Scene) -> bool:
    """Return False if nobody drove where the scene's cameras are: a splat file without cameras."""
    return scene.seen_frames is None or bool(scene.seen_frames)


def find_wheel_paths(
    scene: Scene, *, has_path_without_drive: bool = False
) -> tuple[WheelPath, ...]:
    """Find the paths of the ego and of the vehicles that move, each longer than what was recorded.

    Args:
        scene: its recorded frames give the path of the ego, also where a camera path replaces them.
        has_path_without_drive: if True, the ego has a path also along cameras that nobody drove.
    """
    paths = []
    frames = scene.seen_frames or scene.frames
    if frames and (has_path_without_drive or has_recorded_drive(scene)):
        poses = np.stack([frame.world_from_ego.numpy() for frame in frames])
        ego = _extended_path(poses, EGO_EXTENSION_M)
        ego[:, 2] += _ground_below(scene.background, poses[:, :3, 3])
        paths.append(WheelPath(ego, EGO_WIDTH_M))
    for actor in scene.actors:
        if is_vehicle(actor) and is_moving(actor):
            path = _extended_path(actor.track.world_from_actor.numpy(), ACTOR_EXTENSION_M)
            path[:, 2] -= actor.size_m[2] / 2
            paths.append(WheelPath(path, actor.size_m[1]))
    return tuple(paths)


def draw_tracks(paths: Iterable[WheelPath], surface: Surface, classes: np.ndarray) -> np.ndarray:
    """Draw wheel tracks on a grid, float32 [H, W]: 1 in the middle of a rut, 0 beside it.

    Args:
        paths: paths of vehicles.
        surface: surface that the tracks lie on.
        classes: int16 [H, W], UNKNOWN everywhere if the scene has no classes.
    """
    grid = surface.map
    shape = surface.is_exposed.shape
    corner = np.array([grid.left_m, grid.bottom_m])
    size = np.array(shape[::-1]) * grid.cell_m
    ruts = np.zeros(shape, np.uint8)
    wheel_heights_m = np.full(shape, np.nan, np.float32)
    thickness = max(1, round(RUT_WIDTH_M / grid.cell_m))
    has_lines = False
    for path in paths:
        low = corner - _GRID_MARGIN_M
        high = corner + size + _GRID_MARGIN_M
        for wheels in _wheel_lines(path):
            for line in _clip_line(wheels, low, high):
                pixels = _cv2_coordinates(line, corner, grid.cell_m)
                cv2.polylines(ruts, [pixels], False, 255, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
                has_lines = True
        width_cells = max(1, round((path.width_m + 2 * RUT_WIDTH_M) / grid.cell_m))
        for line in _clip_line(path.points_m, low, high):
            pixels = _cv2_coordinates(line, corner, grid.cell_m)
            for start in range(len(line) - 1):
                height = float(line[start : start + 2, 2].mean())
                ends = [pixels[start : start + 2]]
                cv2.polylines(
                    wheel_heights_m, ends, False, height, width_cells, cv2.LINE_8, _SUBPIXEL_BITS
                )
    if not has_lines:
        return np.zeros(shape, np.float32)
    strength = ruts.astype(np.float32) * np.float32(min(1.0, RUT_WIDTH_M / grid.cell_m) / 255)
    if _RUT_BLUR_M / grid.cell_m > 0.3:
        strength = cv2.GaussianBlur(strength, (0, 0), _RUT_BLUR_M / grid.cell_m)
    has_classes = bool((classes != SemanticClass.UNKNOWN).any())
    max_gap_m = _MAX_ROAD_GAP_M if has_classes else _MAX_WHEEL_GAP_M
    on_road = np.abs(surface.height_m - wheel_heights_m) < max_gap_m  # false where NaN
    if has_classes:
        on_road &= np.isin(classes, _ROAD_CLASSES)
    return np.where(on_road & surface.is_exposed, np.clip(strength, 0, 1), np.float32(0))


def _extended_path(poses: np.ndarray, extension_m: float) -> np.ndarray:
    """Return the path of a vehicle, continued straight beyond both ends of the drive.

    Tiles then also cover the ground that the cameras see beyond the drive.

    Args:
        poses: poses of the vehicle, x forward, [T, 4, 4].
        extension_m: how far the path goes on at each end, metres; one point a metre.

    Returns:
        Points [P, 3]; those of the drive are at least _MIN_POSE_STEP_M apart.
    """
    points = [poses[0, :3, 3]]
    for position in poses[1:, :3, 3]:
        if np.linalg.norm(position - points[-1]) >= _MIN_POSE_STEP_M:
            points.append(position)
    path = np.stack(points)
    if len(path) == 1:
        ahead = poses[0, :3, 0]  # the vehicle stands still: the path follows its x axis
        back = -ahead
    else:
        back = _heading(path[::-1])
        ahead = _heading(path)
    steps = np.arange(1.0, extension_m + 1)[:, None]
    return np.concatenate([(path[0] + steps * back)[::-1], path, path[-1] + steps * ahead])


def _heading(path: np.ndarray) -> np.ndarray:
    """Unit direction in which a path leaves its last point."""
    distances = np.linalg.norm(path - path[-1], axis=1)
    far_rows = np.flatnonzero(distances >= _HEADING_LENGTH_M)
    direction = path[-1] - path[far_rows[-1] if len(far_rows) else 0]
    return direction / max(float(np.linalg.norm(direction)), 1e-9)


def _ground_below(gaussians: Gaussians, positions: np.ndarray) -> float:
    """Height of the ground relative to the positions [P, 3], negative below them, metres.

    It is the median over solid Gaussians near the positions.
    """
    means = gaussians.means.numpy()
    is_solid = gaussians.opacities.numpy() > 0.3
    samples = positions[:: 1 + len(positions) // 32]
    low = samples.min(0) - np.array([1, 1, 3])
    high = samples.max(0) + 1
    nearby = means[is_solid & (means >= low).all(1) & (means <= high).all(1)].astype(np.float64)
    gaps = []
    for position in samples:
        heights = (
            nearby[np.hypot(nearby[:, 0] - position[0], nearby[:, 1] - position[1]) < 1.0, 2]
            - position[2]
        )
        heights = heights[(heights > -2.5) & (heights < 0.5)]
        if len(heights) >= 3:
            gaps.append(np.median(heights))
    return float(np.median(gaps)) if gaps else 0.0


def parallel_path(path: WheelPath, offset_m: float) -> WheelPath:
    """Return the path beside a path, at its height.

    Args:
        path: the path, of two or more points.
        offset_m: distance to the left, metres; negative to the right.
    """
    return WheelPath(path.points_m + offset_m * _left_of(path.points_m), path.width_m)


def _left_of(points: np.ndarray) -> np.ndarray:
    """Return the level unit vectors to the left of a line, [P, 3]."""
    directions = np.gradient(points[:, :2], axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    return np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(points))], -1)


def _wheel_lines(path: WheelPath) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of the left and of the right wheels."""
    offsets = _left_of(path.points_m)
    offsets *= WHEEL_OFFSET_SHARE * path.width_m
    return path.points_m + offsets, path.points_m - offsets


def _clip_line(line: np.ndarray, low: np.ndarray, high: np.ndarray) -> Sequence[np.ndarray]:
    """Return the stretches of a line, of two or more points, that lie between two corners."""
    is_inside = np.all((line[:, :2] >= low) & (line[:, :2] <= high), axis=1).reshape(-1)
    breaks = np.flatnonzero(np.diff(is_inside.astype(np.int8))) + 1
    stretches = np.split(np.arange(len(line)), breaks)
    return [line[stretch] for stretch in stretches if len(stretch) > 1 and is_inside[stretch].all()]


def _cv2_coordinates(line: np.ndarray, corner: np.ndarray, cell_m: float) -> np.ndarray:
    """Line in cv2's fixed-point coordinates, int32 [P, 1, 2], counted from pixel centres."""
    pixels = (line[:, :2] - corner) / cell_m - 0.5
    return np.round(pixels * 2**_SUBPIXEL_BITS).astype(np.int32)[:, None]
