"""Camera paths for scenes that come without cameras: a drive along the street, or an orbit.

A drive is made where the content is wide, flat and metric: the longest straight line over ground
with nothing at the height of a car in its way. The camera stands CAMERA_HEIGHT_M above the ground
and stops short of the end, so that there is something ahead in the last image. Everything else is
orbited.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adapters.cameras.ground_estimate import (
    BULK_REACH,
    GroundGrid,
    ground_grid,
    in_bulk,
    road_heights,
    solid_points_and_areas,
)
from adapters.cameras.posed_views import PosedView, look_at_pose
from augment.scene import Gaussians

PathKind = Literal["auto", "drive", "orbit"]
PATH_KINDS: dict[str, PathKind] = {"auto": "auto", "drive": "drive", "orbit": "orbit"}

NO_CAMERAS = "no cameras came with the scene"  # how every note begins
CAMERA_HEIGHT_M = 1.6
WIDTH, HEIGHT = 960, 540
DRIVE_CAMERAS_DEG = {"front": 0.0, "left": 60.0, "right": -60.0}  # yaw; 75° wide each, so they meet
_FIELD_OF_VIEW_DEG = {"drive": 75.0, "orbit": 55.0}
_STEP_M = 0.5  # 5 m/s at 10 Hz
_MAX_CELLS = 1010  # a side: up to half a kilometre every step is looked at, beyond that every nth
_MOST_FRAMES = 100
_LONGEST_DRIVE_M = 1000.0  # what lies between frames farther apart no image shows
_ORBIT_FRAMES = 48
_SHORTEST_DRIVE_M = 8.0
_WIDE_M, _FLATNESS = 20.0, 0.5
_CAR_M = (0.5, 2.5)  # above the ground: what lies between is in the way
_HALF_WIDTH_M = 1.25
_DETAIL_REACH_M, _COARSER_THAN_USUAL = 2.0, 1.7
_BLOCKED_COST = 4.0  # passing half a metre of wall must cost more than it gains
_BEHIND_SHARE, _AHEAD_SHARE = (
    0.05,
    0.3,
)  # parts of the line before the first and after the last image
_ORBIT_ELEVATION_DEG = 20.0


@dataclass(frozen=True, eq=False)
class DefaultPath:
    """views: in the scene's world. ground_z_m: lowest ground under the path. note: a sentence."""

    views: tuple[PosedView, ...]
    ground_z_m: float
    note: str


def make_default_path(
    gaussians: Gaussians, *, is_metric: bool, kind: PathKind = "auto"
) -> DefaultPath:
    """A path for the scene; `kind` other than auto insists (a drive then takes units as metres)."""
    points, areas = solid_points_and_areas(gaussians)
    near = in_bulk(points, BULK_REACH)
    points, areas = points[near], areas[near]
    if kind == "orbit" or (kind == "auto" and not (is_metric and _is_wide_and_flat(points))):
        return _orbit(points, is_metric=is_metric, asked=kind == "orbit")
    grid = ground_grid(points, cell=1.0)
    start, end = _longest_free_line(points, areas, grid)
    if np.linalg.norm(end - start) < _SHORTEST_DRIVE_M and kind == "auto":
        return _orbit(points, is_metric=is_metric, asked=False)
    return _drive(points, areas, grid, start, end)


def _is_wide_and_flat(points: np.ndarray) -> bool:
    extent = np.subtract(*np.quantile(points, [0.95, 0.05], axis=0))
    wide = float(np.hypot(*extent[:2]))
    return wide >= _WIDE_M and extent[2] < _FLATNESS * wide


def _longest_free_line(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Ends [2] of the straight line with the most ground under it and the least in its way.

    Every half metre of a line (more in scenes of more than half a kilometre) counts +1 over known
    ground, -1 elsewhere, and less by the share of a car's front that Gaussians there hide; of every
    line the best stretch is taken.
    """
    worth, cell = _worth_of_cells(points, areas, grid)
    middle = grid.corner + 0.5 * grid.cell * np.array(grid.height.shape)
    reach = 0.5 * grid.cell * float(np.hypot(*grid.height.shape))
    along = np.arange(-reach, reach, cell)
    across = np.arange(-reach, reach, 2 * cell)
    framed = np.pad(worth, 1, constant_values=-1.0)  # so that places outside need no mask
    best, ends = -math.inf, (middle, middle)
    for angle in np.arange(0, math.pi, math.pi / 36):
        forward = np.array([math.cos(angle), math.sin(angle)])
        left = np.array([-forward[1], forward[0]])
        places = tuple(
            middle[axis] + along * forward[axis] + across[:, None] * left[axis] for axis in (0, 1)
        )
        x, y = (
            1 + np.floor((places[a] - grid.corner[a]) / cell).astype(int).clip(-1, worth.shape[a])
            for a in (0, 1)
        )
        total = np.cumsum(framed[x, y], axis=1)
        total = np.pad(total, ((0, 0), (1, 0)))
        floor = np.minimum.accumulate(total, axis=1)
        gain = total - floor
        row, stop = np.unravel_index(gain.argmax(), gain.shape)
        if gain[row, stop] > best:
            best = gain[row, stop]
            begin = int(total[row, : stop + 1].argmin())
            end = max(begin, int(stop) - 1)
            first, last = (np.array([p[row, i] for p in places]) for i in (begin, end))
            ends = first, last
    return ends


def _worth_of_cells(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid
) -> tuple[np.ndarray, float]:
    """What a step over each fine cell counts, and the cell's side."""
    cell = max(_STEP_M, grid.cell * max(grid.height.shape) / _MAX_CELLS)
    shape = np.ceil(np.array(grid.height.shape) * grid.cell / cell).astype(int)
    centres = grid.corner + (np.moveaxis(np.indices(tuple(shape)), 0, -1) + 0.5) * cell
    known = np.isfinite(grid.at(centres)) & _is_detailed(points, areas, grid.corner, cell, shape)
    above = points[:, 2] - grid.at(points)  # NaN compares false below
    in_the_way = (above > _CAR_M[0]) & (above < _CAR_M[1])
    hidden = _sum_in_cells(points[in_the_way], areas[in_the_way], grid.corner, cell, shape)
    reach = round(_HALF_WIDTH_M / cell)
    front = (2 * reach + 1) * cell * (_CAR_M[1] - _CAR_M[0])
    blocked = _sum_around(hidden, reach) / front
    # In a blurred reconstruction something hangs everywhere: there, less than usual is free.
    usual = np.median(blocked[known]) if known.any() else 0.0
    blocked = (blocked / max(1.0, usual)).clip(0, 1)
    return np.where(known, 1.0, -1.0) - _BLOCKED_COST * blocked, cell


def _is_detailed(
    points: np.ndarray, areas: np.ndarray, corner: np.ndarray, cell: float, shape: np.ndarray
) -> np.ndarray:
    """Where Gaussians are not much larger than usual: scenes are sharp where their cameras drove,
    and a path far from there would look into a blur.
    """
    size = np.log(np.maximum(areas, 1e-12))
    reach = round(_DETAIL_REACH_M / cell)
    total = _sum_around(_sum_in_cells(points, size, corner, cell, shape), reach)
    count = _sum_around(_sum_in_cells(points, np.ones_like(size), corner, cell, shape), reach)
    local = total / np.maximum(count, 1)
    return local < np.median(size) + 2 * math.log(_COARSER_THAN_USUAL)


def _sum_in_cells(
    points: np.ndarray, values: np.ndarray, corner: np.ndarray, cell: float, shape: np.ndarray
) -> np.ndarray:
    index = np.floor((points[:, :2] - corner) / cell).astype(int)
    inside = ((index >= 0) & (index < shape)).all(1)
    total = np.zeros(shape)
    np.add.at(total, tuple(index[inside].T), values[inside])
    return total


def _sum_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Sums over squares of 2 reach + 1 cells, by running totals."""
    for axis in (0, 1):
        padding = [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)]
        total = np.cumsum(np.pad(values, padding), axis=axis)
        upper = np.take(total, range(2 * reach + 1, total.shape[axis]), axis=axis)
        lower = np.take(total, range(0, total.shape[axis] - 2 * reach - 1), axis=axis)
        values = upper - lower
    return values


def _drive(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid, start: np.ndarray, end: np.ndarray
) -> DefaultPath:
    whole = float(np.linalg.norm(end - start))
    forward = (end - start) / whole if whole > 1e-6 else np.array([1.0, 0.0])
    beyond = [
        int(((points[:, :2] - p) @ d > 0).sum()) for p, d in ((end, forward), (start, -forward))
    ]
    if beyond[1] > beyond[0]:  # drive towards the side where more lies ahead of the end
        start, end, forward = end, start, -forward
    start, length = (
        start + _BEHIND_SHARE * whole * forward,
        min((1 - _BEHIND_SHARE - _AHEAD_SHARE) * whole, _LONGEST_DRIVE_M),
    )
    count = max(2, min(_MOST_FRAMES, round(length / _STEP_M) + 1))
    places = start + np.linspace(0, length, count)[:, None] * forward
    heights = road_heights(points, areas, places, grid.at(places))
    ground = _smooth_profile(heights, fallback=float(np.quantile(points[:, 2], 0.1)))
    views = []
    for frame, (place, height) in enumerate(zip(places, ground, strict=True)):
        eye = np.array([*place, height + CAMERA_HEIGHT_M])
        for name, yaw_deg in DRIVE_CAMERAS_DEG.items():
            yaw = math.radians(yaw_deg)
            turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            target = eye + np.array([*(turn @ forward), 0.0])
            views.append(_view(name, frame, look_at_pose(eye, target, where="drive"), "drive"))
    note = (
        f"{NO_CAMERAS}: made a straight drive of {length:.0f} m in {count} frames with cameras "
        f"{', '.join(DRIVE_CAMERAS_DEG)}, {CAMERA_HEIGHT_M} m above the estimated ground; give "
        "camera_path=FILE for another"
    )
    return DefaultPath(tuple(views), float(np.quantile(ground, 0.05)), note)


def _smooth_profile(heights: np.ndarray, *, fallback: float) -> np.ndarray:
    """Ground along the path without gaps and jolts: interpolated, then averaged over 6 m."""
    known = np.isfinite(heights)
    if not known.any():
        return np.full(len(heights), fallback)
    where = np.arange(len(heights))
    filled = np.interp(where, where[known], heights[known])
    reach = 6
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    return np.convolve(np.pad(filled, reach, mode="edge"), kernel, mode="valid")


def _orbit(points: np.ndarray, *, is_metric: bool, asked: bool) -> DefaultPath:
    centre = np.median(points, axis=0)
    elevation = math.radians(_ORBIT_ELEVATION_DEG)
    distance = _distance_to_see(points - centre, elevation)
    views = []
    for frame in range(_ORBIT_FRAMES):
        angle = 2 * math.pi * frame / _ORBIT_FRAMES
        flat = math.cos(elevation)
        direction = (flat * math.cos(angle), flat * math.sin(angle), math.sin(elevation))
        pose = look_at_pose(centre + distance * np.array(direction), centre, where="orbit")
        views.append(_view("orbit", frame, pose, "orbit"))
    ground = float(np.quantile(points[:, 2], 0.05))
    why = "" if asked or is_metric else " (give scale=METRES_PER_UNIT, 1 for metres, for a drive)"
    note = (
        f"{NO_CAMERAS}: made an orbit of {_ORBIT_FRAMES} frames around its "
        f"content{why}; give camera_path=FILE for another"
    )
    return DefaultPath(tuple(views), ground, note)


def _distance_to_see(offsets: np.ndarray, elevation: float) -> float:
    """How far an orbiting camera must be for the bulk of the content to fit into its image."""
    flat = _reach(np.linalg.norm(offsets[:, :2], axis=1))
    upright = _reach(np.abs(offsets[:, 2])) * math.cos(elevation) + flat * math.sin(elevation)
    half_width = math.radians(_FIELD_OF_VIEW_DEG["orbit"]) / 2
    half_height = math.atan(HEIGHT / WIDTH * math.tan(half_width))
    return 1.15 * max(flat / math.sin(half_width), upright / math.sin(half_height), 1e-3)


def _reach(distances: np.ndarray) -> float:
    """Most of the distances, unless a far background stretches them."""
    usual, most = np.quantile(distances, [0.5, 0.9])
    return float(min(most, 2.5 * usual)) if usual > 0 else float(most)


def _view(camera: str, frame: int, pose: np.ndarray, kind: str) -> PosedView:
    focal = 0.5 * WIDTH / math.tan(math.radians(_FIELD_OF_VIEW_DEG[kind]) / 2)
    return PosedView(
        name=f"{camera}/{frame:04d}",
        width=WIDTH,
        height=HEIGHT,
        fx=focal,
        fy=focal,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
        world_from_camera=pose,
        camera=camera,
        frame=frame,
    )
