"""Frames of scenes without cameras: from camera files, or from a generated drive or orbit.

`with_camera_path` replaces a scene's frames by those of a path file, `make_default_path` makes a
drive or an orbit, `frames_from_views` groups views into frames.

A path file is a camera path (`adapters.camera_files.camera_files`), an INRIA cameras.json, a
nerfstudio transforms.json or a COLMAP model. Its poses are in the scene's world before recentring:
metres, +z up, `Scene.world_origin_m` not yet subtracted. Its times count from the scene's first
frame, so that moving actors are where they were then. (Cameras in a splat file's own axes and unit
belong into that scene's URI: `gaussians:FILE?cameras=…`.)
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from adapters.camera_files.camera_files import PosedView, lens_of, look_at_pose, read_views
from adapters.uri import CAMERA_PATH_KEY, add_to_uri
from adapters.world import WorldChange, invert_pose
from augment.errors import AdapterError
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Gaussians, Scene

# ---- Height of the ground, from Gaussians alone --------------------------------------------------
# There are no labels in a splat file, so the ground is what lies low: a low quantile of the centres
# of solid Gaussians around a place; a quantile, since trained scenes hold stray ones underground.

# Gaussians of lower opacity are haze and leftovers of training.
SOLID_OPACITY = 0.3
# Reach of the bulk in median distances: it holds all of a drive that is dense in the middle.
BULK_REACH = 8.0
# Quantile of heights that is the ground.
_LOW_QUANTILE = 0.1
# The road's height at a place is measured within this distance in plan.
_ROAD_REACH_M = 2.5
# Thickness of the layer that holds the road.
_ROAD_LAYER_M = 0.2
# The road lies at most this far above the low quantile.
_ROAD_ABOVE_LOW_M = 0.7
# Fewer points say nothing about the ground.
_MIN_POINTS = 12
# Points are thinned to about this number.
_MAX_POINTS = 300_000
# Positions are thinned to about this number.
_MAX_POSITIONS = 128
# Largest number of cells along a side of the grid.
_CELLS_A_SIDE = 200
# Known cells, of 25, that give a height: ground is not spread beyond the content's edge.
_MIN_KNOWN_CELLS = 6


def solid_points(gaussians: Gaussians) -> np.ndarray:
    """Return the centres [N, 3] of solid Gaussians, thinned evenly, float64.

    If hardly any Gaussian is solid, all are used.
    """
    return gaussians.means[_solid_indices(gaussians)].double().numpy()


def solid_points_and_areas(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the same centres, and the area [N] that each hides from a wide beam.

    The area is the opacity times 2 pi times the two larger scales. Thinned areas are scaled up for
    those left out.
    """
    index = _solid_indices(gaussians)
    count = int((gaussians.opacities > SOLID_OPACITY).sum())
    scales = gaussians.scales[index].sort(dim=1).values
    area = 2 * math.pi * gaussians.opacities[index] * scales[:, 1] * scales[:, 2]
    thinning_factor = max(count, len(index)) / max(len(index), 1)
    return gaussians.means[index].double().numpy(), area.double().numpy() * thinning_factor


def _solid_indices(gaussians: Gaussians) -> Tensor:
    """Return the indices of solid Gaussians, thinned evenly."""
    indices = torch.nonzero(gaussians.opacities > SOLID_OPACITY)[:, 0]
    if len(indices) < _MIN_POINTS:
        indices = torch.arange(len(gaussians))
    return indices[:: 1 + len(indices) // _MAX_POINTS]


def is_in_bulk(points: np.ndarray, reach: float) -> np.ndarray:
    """Return True for points [N, 3] within `reach` times the median distance from their middle.

    This excludes floaters far around a scene, which would stretch every extent.
    """
    is_inside = np.ones(len(points), bool)
    for _ in range(3):  # the middle moves once the far ones are gone
        distance = np.linalg.norm(points - np.median(points[is_inside], axis=0), axis=1)
        is_inside = distance <= reach * np.median(distance[is_inside])
    return is_inside


def ground_under(
    points: np.ndarray, positions: np.ndarray, *, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return ground heights [P'] under positions [P, 3], and the positions [P', 3] that have
    one.

    These are the positions with enough points within `radius` in plan below them. Long paths are
    thinned evenly.
    """
    ground_positions = []
    heights = []
    for position in positions[:: 1 + len(positions) // _MAX_POSITIONS]:
        offset = points[:, :2] - position[:2]
        is_near = (offset * offset).sum(1) < radius * radius
        heights_below = points[is_near & (points[:, 2] < position[2]), 2]
        if len(heights_below) >= _MIN_POINTS:
            ground_positions.append(position)
            heights.append(np.quantile(heights_below, _LOW_QUANTILE))
    return np.array(heights), np.array(ground_positions).reshape(-1, 3)


def road_heights(
    points: np.ndarray, areas: np.ndarray, places: np.ndarray, low: np.ndarray, *, unit: float = 1.0
) -> np.ndarray:
    """Return the heights [P] that hold the most surface around places; NaN without points near.

    Coarse splats lie under fine ones, so none counts for many.

    Args:
        points: float64 [N, 3].
        areas: float64 [N], areas of the points.
        places: float64 [P, 2 or 3].
        low: float64 [P], low quantiles of the height, which foundations and strays pull down.
        unit: length of a metre.
    """
    layer_m = unit * _ROAD_LAYER_M
    heights = np.full(len(places), np.nan)
    areas = np.minimum(areas, np.median(areas))
    for number, (place, low_height) in enumerate(zip(places, low, strict=True)):
        offset = points[:, :2] - place[:2]
        is_near = (offset * offset).sum(axis=1) < (unit * _ROAD_REACH_M) ** 2
        is_near &= np.abs(points[:, 2] - low_height) < unit * _ROAD_ABOVE_LOW_M
        if is_near.any():
            z = points[is_near, 2]
            area = areas[is_near]
            bins = np.floor((z - z.min()) / (layer_m / 4)).astype(int)
            layers = np.convolve(np.bincount(bins, area), np.ones(4))
            top = z.min() + (layers.argmax() + 1) * layer_m / 4
            is_in_layer = (z <= top) & (z >= top - layer_m)
            heights[number] = np.average(z[is_in_layer], weights=area[is_in_layer])
    return heights


def lowest_ground(points: np.ndarray, positions: np.ndarray, *, radius: float) -> float | None:
    """Return the height of the ground where it is lowest under a path.

    The result is None without points under it.
    """
    heights, _ = ground_under(points, positions, radius=radius)
    # The 5 % quantile: one hole in the reconstruction must not set the level of a flood.
    return float(np.quantile(heights, 0.05)) if len(heights) else None


@dataclass(frozen=True, eq=False)
class GroundGrid:
    """Ground heights on square cells.

    Attributes:
        corner: x, y of the first cell's corner.
        cell: edge of a cell.
        height: float64 [X, Y], NaN without points near.
    """

    corner: np.ndarray
    cell: float
    height: np.ndarray

    def cells_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return indices along x and y, clipped to the grid, and a mask of the points inside it."""
        index = np.floor((points[..., :2] - self.corner) / self.cell).astype(int)
        is_inside = np.all((index >= 0) & (index < np.array(self.height.shape)), axis=-1)
        x = index[..., 0].clip(0, self.height.shape[0] - 1)
        y = index[..., 1].clip(0, self.height.shape[1] - 1)
        return x, y, is_inside

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the heights under points [..., 2 or 3]; NaN outside and where unknown."""
        x, y, is_inside = self.cells_of(points)
        return np.where(is_inside, self.height[x, y], np.nan)


def ground_grid(points: np.ndarray, *, cell: float) -> GroundGrid:
    """Return ground heights over the bulk of the points.

    Each cell has the low quantile of its points, then the lower third of the 5x5 cells around it,
    which no car or bush lifts. cell: smallest edge of a cell.
    """
    min_corner, max_corner = np.quantile(points[:, :2], [0.005, 0.995], axis=0)
    cell = max(cell, float((max_corner - min_corner).max()) / _CELLS_A_SIDE)
    shape = np.floor((max_corner - min_corner) / cell).astype(int) + 1
    grid = GroundGrid(min_corner, cell, np.full(shape, np.nan))
    x, y, is_inside = grid.cells_of(points)
    flat_index = (x * shape[1] + y)[is_inside]
    heights = points[is_inside, 2]
    order = np.lexsort((heights, flat_index))
    cells, first_rows, count = np.unique(flat_index[order], return_index=True, return_counts=True)
    grid.height.reshape(-1)[cells] = heights[order][
        first_rows + (_LOW_QUANTILE * count).astype(int)
    ]
    return GroundGrid(min_corner, cell, _smooth_heights(grid.height))


def _smooth_heights(height: np.ndarray) -> np.ndarray:
    """Replace each height by the lower third of the 5x5 heights around it."""
    padded = np.pad(height, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*height.shape, 25)
    sorted_windows = np.sort(windows, axis=-1)  # NaN last
    num_known = np.isfinite(sorted_windows).sum(-1)
    rank = (0.3 * num_known).astype(int).clip(0, 24)
    smooth = np.take_along_axis(sorted_windows, rank[..., None], -1)[..., 0]
    return np.where(num_known >= _MIN_KNOWN_CELLS, smooth, np.nan)


# ---- Camera paths for scenes that come without cameras: a drive along the street, or an orbit ----
# A drive is made where the content is wide, flat and metric: the longest straight line over ground
# with nothing at the height of a car in its way. The camera stands CAMERA_HEIGHT_M above the ground
# and stops short of the end, so that there is something ahead in the last image. Everything else is
# orbited.

PathKind = Literal["auto", "drive", "orbit"]

# Beginning of every note.
NO_CAMERAS = "no cameras came with the scene"
# Height of the drive's cameras above the ground.
CAMERA_HEIGHT_M = 1.6
# Width of the images in pixels.
WIDTH = 960
# Height of the images in pixels.
HEIGHT = 540
# Yaw of the drive's cameras. Each is 75° wide, so that their images adjoin.
DRIVE_CAMERAS_DEG = {"front": 0.0, "left": 60.0, "right": -60.0}
# Horizontal field of view by kind of path.
_FIELD_OF_VIEW_DEG = {"drive": 75.0, "orbit": 55.0}
# Distance between frames of a drive: 5 m/s at 10 Hz.
_STEP_M = 0.5
# Largest number of cells along a side. Up to half a kilometre every step has its cell.
_MAX_CELLS = 1010
# Largest number of frames of a drive.
_MAX_FRAMES = 100
# Largest length of a drive. In a longer one no image would show what lies between frames.
_MAX_DRIVE_M = 1000.0
# Frames of an orbit.
_ORBIT_FRAMES = 48
# A shorter free line gives no drive.
_MIN_DRIVE_M = 8.0
# Content of smaller width is orbited.
_MIN_WIDTH_M = 20.0
# Content of larger height, relative to its width, is orbited.
_MAX_HEIGHT_PER_WIDTH = 0.5
# Heights above the ground between which Gaussians block a car.
_CAR_HEIGHTS_M = (0.5, 2.5)
# Half of a car's width.
_HALF_WIDTH_M = 1.25
# The detail of a place is measured within this distance.
_DETAIL_REACH_M = 2.0
# Where Gaussians are larger than usual by this factor, there is no detail.
_MAX_SIZE_RATIO = 1.7
# Cost of a blocked step. Passing half a metre of wall must cost more than it gains.
_BLOCKED_COST = 4.0
# Fraction of the line before the first image.
_START_FRACTION = 0.05
# Fraction of the line after the last image.
_END_FRACTION = 0.3
# Elevation of an orbit's cameras.
_ORBIT_ELEVATION_DEG = 20.0


@dataclass(frozen=True, eq=False)
class DefaultPath:
    """A generated path.

    Attributes:
        views: views in the scene's world.
        ground_z_m: lowest ground under the path.
        note: a sentence about it.
    """

    views: tuple[PosedView, ...]
    ground_z_m: float
    note: str


def make_default_path(
    gaussians: Gaussians, *, is_metric: bool, kind: PathKind = "auto"
) -> DefaultPath:
    """Make a path for a scene.

    A `kind` other than auto is always made; a drive then takes units as metres.
    """
    points, areas = solid_points_and_areas(gaussians)
    is_near = is_in_bulk(points, BULK_REACH)
    points = points[is_near]
    areas = areas[is_near]
    if kind == "orbit" or (kind == "auto" and not (is_metric and _is_wide_and_flat(points))):
        return _make_orbit(points, is_metric=is_metric, is_requested=kind == "orbit")
    grid = ground_grid(points, cell=1.0)
    start, end = _longest_free_line(points, areas, grid)
    if np.linalg.norm(end - start) < _MIN_DRIVE_M and kind == "auto":
        return _make_orbit(points, is_metric=is_metric, is_requested=False)
    return _make_drive(points, areas, grid, start, end)


def _is_wide_and_flat(points: np.ndarray) -> bool:
    """Return True if the points are wide and low enough for a street."""
    extent = np.subtract(*np.quantile(points, [0.95, 0.05], axis=0))
    width = float(np.hypot(*extent[:2]))
    return width >= _MIN_WIDTH_M and extent[2] < _MAX_HEIGHT_PER_WIDTH * width


def _longest_free_line(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends [2] of the straight line with the most ground under it and the least in
    its way.

    Each step counts +1 over known ground and -1 elsewhere, less the fraction of a car's front that
    Gaussians hide.
    """
    worth, cell = _worth_of_cells(points, areas, grid)
    middle = grid.corner + 0.5 * grid.cell * np.array(grid.height.shape)
    reach = 0.5 * grid.cell * float(np.hypot(*grid.height.shape))
    along_line = np.arange(-reach, reach, cell)
    across_lines = np.arange(-reach, reach, 2 * cell)
    padded_worth = np.pad(worth, 1, constant_values=-1.0)  # so that places outside need no mask
    best_gain = -math.inf
    ends = (middle, middle)
    for angle in np.arange(0, math.pi, math.pi / 36):
        forward = np.array([math.cos(angle), math.sin(angle)])
        left = np.array([-forward[1], forward[0]])
        positions = tuple(
            middle[axis] + along_line * forward[axis] + across_lines[:, None] * left[axis]
            for axis in (0, 1)
        )
        x, y = (
            1
            + np.floor((positions[a] - grid.corner[a]) / cell).astype(int).clip(-1, worth.shape[a])
            for a in (0, 1)
        )
        total = np.cumsum(padded_worth[x, y], axis=1)
        total = np.pad(total, ((0, 0), (1, 0)))
        lowest_total = np.minimum.accumulate(total, axis=1)
        gain = total - lowest_total
        row, stop = np.unravel_index(gain.argmax(), gain.shape)
        if gain[row, stop] > best_gain:
            best_gain = gain[row, stop]
            first_step = int(total[row, : stop + 1].argmin())
            last_step = max(first_step, int(stop) - 1)
            first, last = (
                np.array([p[row, i] for p in positions]) for i in (first_step, last_step)
            )
            ends = first, last
    return ends


def _worth_of_cells(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid
) -> tuple[np.ndarray, float]:
    """Return the value of a step over each fine cell, and the cell's edge."""
    cell = max(_STEP_M, grid.cell * max(grid.height.shape) / _MAX_CELLS)
    shape = np.ceil(np.array(grid.height.shape) * grid.cell / cell).astype(int)
    centres = grid.corner + (np.moveaxis(np.indices(tuple(shape)), 0, -1) + 0.5) * cell
    is_known = np.isfinite(grid.at(centres)) & _is_detailed(points, areas, grid.corner, cell, shape)
    height_above_ground = points[:, 2] - grid.at(points)  # NaN compares false below
    is_in_way = (height_above_ground > _CAR_HEIGHTS_M[0]) & (
        height_above_ground < _CAR_HEIGHTS_M[1]
    )
    hidden_area = _sum_in_cells(points[is_in_way], areas[is_in_way], grid.corner, cell, shape)
    half_width_cells = round(_HALF_WIDTH_M / cell)
    front_area = (2 * half_width_cells + 1) * cell * (_CAR_HEIGHTS_M[1] - _CAR_HEIGHTS_M[0])
    blocked_fraction = _sum_around(hidden_area, half_width_cells) / front_area
    # In a blurred reconstruction something hangs everywhere: there, less than usual is free.
    usual_cover = np.median(blocked_fraction[is_known]) if is_known.any() else 0.0
    blocked_fraction = (blocked_fraction / max(1.0, usual_cover)).clip(0, 1)
    return np.where(is_known, 1.0, -1.0) - _BLOCKED_COST * blocked_fraction, cell


def _is_detailed(
    points: np.ndarray, areas: np.ndarray, corner: np.ndarray, cell: float, shape: np.ndarray
) -> np.ndarray:
    """Return True for cells whose Gaussians are not much larger than usual: near the training
    cameras.
    """
    size = np.log(np.maximum(areas, 1e-12))
    reach = round(_DETAIL_REACH_M / cell)
    total = _sum_around(_sum_in_cells(points, size, corner, cell, shape), reach)
    count = _sum_around(_sum_in_cells(points, np.ones_like(size), corner, cell, shape), reach)
    local_size = total / np.maximum(count, 1)
    return local_size < np.median(size) + 2 * math.log(_MAX_SIZE_RATIO)


def _sum_in_cells(
    points: np.ndarray, values: np.ndarray, corner: np.ndarray, cell: float, shape: np.ndarray
) -> np.ndarray:
    """Return the sums of values [N] of the points in each cell."""
    index = np.floor((points[:, :2] - corner) / cell).astype(int)
    is_inside = ((index >= 0) & (index < shape)).all(1)
    total = np.zeros(shape)
    np.add.at(total, tuple(index[is_inside].T), values[is_inside])
    return total


def _sum_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Return sums over squares of 2 reach + 1 cells, by running totals."""
    for axis in (0, 1):
        padding = [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)]
        total = np.cumsum(np.pad(values, padding), axis=axis)
        upper = np.take(total, range(2 * reach + 1, total.shape[axis]), axis=axis)
        lower = np.take(total, range(0, total.shape[axis] - 2 * reach - 1), axis=axis)
        values = upper - lower
    return values


def _make_drive(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid, start: np.ndarray, end: np.ndarray
) -> DefaultPath:
    """Return a drive along a line."""
    line_length = float(np.linalg.norm(end - start))
    forward = (end - start) / line_length if line_length > 1e-6 else np.array([1.0, 0.0])
    num_points_beyond = [
        int(((points[:, :2] - p) @ d > 0).sum()) for p, d in ((end, forward), (start, -forward))
    ]
    if (
        num_points_beyond[1] > num_points_beyond[0]
    ):  # drive towards the side where more lies ahead of the end
        start, end, forward = end, start, -forward
    start = start + _START_FRACTION * line_length * forward
    length = min((1 - _START_FRACTION - _END_FRACTION) * line_length, _MAX_DRIVE_M)
    count = max(2, min(_MAX_FRAMES, round(length / _STEP_M) + 1))
    positions = start + np.linspace(0, length, count)[:, None] * forward
    heights = road_heights(points, areas, positions, grid.at(positions))
    ground_heights = _smooth_profile(heights, fallback=float(np.quantile(points[:, 2], 0.1)))
    views = []
    for frame, (position, height) in enumerate(zip(positions, ground_heights, strict=True)):
        eye = np.array([*position, height + CAMERA_HEIGHT_M])
        for name, yaw_deg in DRIVE_CAMERAS_DEG.items():
            yaw = math.radians(yaw_deg)
            rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            target = eye + np.array([*(rotation @ forward), 0.0])
            views.append(_view(name, frame, look_at_pose(eye, target, where="drive"), "drive"))
    note = (
        f"{NO_CAMERAS}: made a straight drive of {length:.0f} m in {count} frames with cameras "
        f"{', '.join(DRIVE_CAMERAS_DEG)}, {CAMERA_HEIGHT_M} m above the estimated ground; give "
        "camera_path=FILE for another"
    )
    return DefaultPath(tuple(views), float(np.quantile(ground_heights, 0.05)), note)


def _smooth_profile(heights: np.ndarray, *, fallback: float) -> np.ndarray:
    """Return the ground along the path without gaps and jolts: interpolated, then averaged over
    6 m.
    """
    is_known = np.isfinite(heights)
    if not is_known.any():
        return np.full(len(heights), fallback)
    indices = np.arange(len(heights))
    heights_filled = np.interp(indices, indices[is_known], heights[is_known])
    reach = 6
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    return np.convolve(np.pad(heights_filled, reach, mode="edge"), kernel, mode="valid")


def _make_orbit(points: np.ndarray, *, is_metric: bool, is_requested: bool) -> DefaultPath:
    """Return an orbit around the content. is_requested: True if the user asked for it."""
    centre = np.median(points, axis=0)
    elevation = math.radians(_ORBIT_ELEVATION_DEG)
    distance = _distance_to_see(points - centre, elevation)
    views = []
    for frame in range(_ORBIT_FRAMES):
        angle = 2 * math.pi * frame / _ORBIT_FRAMES
        horizontal = math.cos(elevation)
        direction = (
            horizontal * math.cos(angle),
            horizontal * math.sin(angle),
            math.sin(elevation),
        )
        pose = look_at_pose(centre + distance * np.array(direction), centre, where="orbit")
        views.append(_view("orbit", frame, pose, "orbit"))
    ground = float(np.quantile(points[:, 2], 0.05))
    hint = (
        ""
        if is_requested or is_metric
        else " (give scale=METRES_PER_UNIT, 1 for metres, for a drive)"
    )
    note = (
        f"{NO_CAMERAS}: made an orbit of {_ORBIT_FRAMES} frames around its "
        f"content{hint}; give camera_path=FILE for another"
    )
    return DefaultPath(tuple(views), ground, note)


def _distance_to_see(offsets: np.ndarray, elevation: float) -> float:
    """Return the distance at which the bulk of the content fits into an orbiting camera's image."""
    horizontal_extent = _robust_extent(np.linalg.norm(offsets[:, :2], axis=1))
    vertical_extent = _robust_extent(np.abs(offsets[:, 2])) * math.cos(
        elevation
    ) + horizontal_extent * math.sin(elevation)
    half_width = math.radians(_FIELD_OF_VIEW_DEG["orbit"]) / 2
    half_height = math.atan(HEIGHT / WIDTH * math.tan(half_width))
    return 1.15 * max(
        horizontal_extent / math.sin(half_width), vertical_extent / math.sin(half_height), 1e-3
    )


def _robust_extent(distances: np.ndarray) -> float:
    """Return the 90 % quantile of distances, or less if a far background stretches it."""
    median, upper = np.quantile(distances, [0.5, 0.9])
    return float(min(upper, 2.5 * median)) if median > 0 else float(upper)


def _view(camera: str, frame: int, pose: np.ndarray, kind: str) -> PosedView:
    """Return a view of one of the path's cameras."""
    focal = 0.5 * WIDTH / math.tan(math.radians(_FIELD_OF_VIEW_DEG[kind]) / 2)
    lens = lens_of(WIDTH, HEIGHT, focal, None, None, None)
    return PosedView(f"{camera}/{frame:04d}", *lens, pose, camera=camera, frame=frame)


# ---- Views grouped into the frames of a drive ----------------------------------------------------
# Which camera took an image is read from the images' names, in the first of these ways that fits
# all of them (extension and folders common to all names aside):
#
#     front/000012.jpg            one folder a camera, the file name is the frame
#     000012/front.jpg            one folder a frame, the file name is the camera
#     000012_front, 000012_0      a frame number, then the camera
#     front_000012                a camera, then the frame number
#
# The last two count only if at least half of the frames then have two cameras or more: numbers in
# names are common, and a single camera's images are one frame each. Without times, the cameras of a
# frame fire at one moment, and frames are FRAME_INTERVAL_S apart.

# Time between frames without times.
FRAME_INTERVAL_S = 0.1
# Name of the camera of images whose names tell none.
SINGLE_CAMERA = "camera"
_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".exr"}
_FRAME_THEN_CAMERA = re.compile(r"(\d+)[_-](\d{1,2}|\w*[A-Za-z]\w*)")
_CAMERA_THEN_FRAME = re.compile(r"(\w*[A-Za-z]\w*?)[_-]?(\d+)")
# Largest number of cameras that names may tell.
_MAX_CAMERAS = 32
# Larger numbers are times or hashes.
_MAX_FRAME_NUMBER = 10**9


def frames_from_views(
    views: Sequence[PosedView], change: WorldChange, *, start_ns: int = 0
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Group views into frames in order of time (or of their names), and return sentences on
    problems.

    world_from_ego stands at the front camera, level.

    Args:
        views: the views.
        change: from the views' world to the scene's.
        start_ns: time from which times in the views count.
    """
    keys, problems = _camera_and_frame_keys(views)
    frame_keys = sorted(set(frame for _, frame in keys), key=_natural_sort_key)
    numbers = _frame_numbers(frame_keys)
    frames = []
    for rank, key in enumerate(frame_keys):
        views_of_frame = [(k[0], v) for k, v in zip(keys, views, strict=True) if k[1] == key]
        views_of_frame.sort(key=lambda named_view: _natural_sort_key(named_view[0]))
        default_ns = start_ns + round(rank * FRAME_INTERVAL_S * 1e9)
        times = {
            name: default_ns if view.timestamp_ns is None else start_ns + view.timestamp_ns
            for name, view in views_of_frame
        }
        cameras = {name: _camera(name, view, change, times[name]) for name, view in views_of_frame}
        frames.append(
            Frame(
                index=numbers[rank],
                timestamp_ns=min(camera.timestamp_ns for camera in cameras.values()),
                world_from_ego=ego_from_front_camera(cameras),
                cameras=cameras,
                image_paths={name: v.image_path for name, v in views_of_frame if v.image_path},
            )
        )
    return tuple(frames), problems


def split_names(names: Sequence[str]) -> list[tuple[str, str]] | None:
    """Return camera and frame of every image name by the module's rules.

    The result is None if no rule fits; then every image is a frame of a single camera.
    """
    parts = [_split_name(name) for name in names]
    while len({p[0] for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[1:] for p in parts]
    if all(len(p) > 1 for p in parts):
        pairs = [("_".join(p[:-1]), p[-1]) for p in parts]
        if all(folder.isdigit() and not stem.isdigit() for folder, stem in pairs):
            pairs = [(stem, folder) for folder, stem in pairs]
        return pairs
    if any(len(p) > 1 for p in parts):
        return None
    stems = [p[0] for p in parts]
    for pattern, camera, frame in ((_FRAME_THEN_CAMERA, 2, 1), (_CAMERA_THEN_FRAME, 1, 2)):
        matches = [pattern.fullmatch(stem) for stem in stems]
        pairs = [(m[camera], m[frame]) for m in matches if m]
        if len(pairs) == len(stems) and _is_rig(pairs):
            return pairs
    return None


def _is_rig(pairs: Sequence[tuple[str, str]]) -> bool:
    """Return True if at least half of the frames have two cameras or more, of at most
    _MAX_CAMERAS.
    """
    per_frame = Counter(frame for _, frame in pairs)
    num_shared = sum(count > 1 for count in per_frame.values())
    return 2 * num_shared >= len(per_frame) and len({c for c, _ in pairs}) <= _MAX_CAMERAS


def ego_from_front_camera(cameras: dict[str, Camera]) -> torch.Tensor:
    """Return world_from_ego of a level vehicle at the front camera.

    This is the camera with "front" in its name, else the first.
    """
    front_names = [name for name in cameras if "front" in name.lower()]
    front_name = min(front_names, key=len) if front_names else next(iter(cameras))
    world_from_camera = cameras[front_name].world_from_camera
    heading = world_from_camera[:2, 2]
    if heading.norm() < 1e-6:  # straight up or down: the top of the image is ahead
        heading = -world_from_camera[:2, 1]
    x, y = (heading / heading.norm()).tolist()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[x, -y], [y, x]], dtype=torch.float64)
    pose[:3, 3] = world_from_camera[:3, 3]
    return pose


def _camera_and_frame_keys(
    views: Sequence[PosedView],
) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    """Return camera and frame of every view, and a sentence if names do not tell them."""
    keys = [(v.camera, str(v.frame)) for v in views if v.camera is not None]
    if len(keys) < len(views):
        names = [v.name for v in views]
        keys = split_names(names) or [
            (SINGLE_CAMERA, "/".join(_split_name(name))) for name in names
        ]
    if len(set(keys)) == len(keys):
        return keys, ()
    (camera, frame), count = Counter(keys).most_common(1)[0]
    problem = (
        f"{count} views are named camera {camera!r}, frame {frame!r}, so cameras and frames cannot "
        "be told apart by name: every view is a frame of one camera, in the file's order"
    )
    width = len(str(len(views)))
    return [(SINGLE_CAMERA, f"{number:0{width}d}") for number in range(len(views))], (problem,)


def _split_name(name: str) -> tuple[str, ...]:
    """Return folders and stem of a name.

    Only extensions of images are removed; a stem may hold dots.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    stem = path.stem if path.suffix.lower() in _IMAGE_SUFFIXES else path.name
    return (*(part for part in path.parts[:-1] if part not in (".", "..", "/")), stem)


def _natural_sort_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sort key in which digits count as numbers: 2 before 10."""
    pieces = re.findall(r"\d+|\D+", text)
    return [(0, int(p), p) if p.isdecimal() and len(p) < 100 else (1, 0, p) for p in pieces]


def _frame_numbers(order: Sequence[str]) -> list[int]:
    """Return the dataset's own frame numbers if the names end in distinct, growing ones."""
    matches = [re.search(r"(\d{1,10})$", key) for key in order]
    numbers = [int(match[1]) for match in matches if match]
    is_growing = all(a < b for a, b in itertools.pairwise(numbers))
    if len(numbers) == len(order) and is_growing and max(numbers) < _MAX_FRAME_NUMBER:
        return numbers
    return list(range(len(order)))


def _camera(name: str, view: PosedView, change: WorldChange, timestamp_ns: int) -> Camera:
    """Return a view's camera in the scene's world."""
    camera_from_world = invert_pose(change.pose(view.world_from_camera))
    try:
        return Camera(
            name,
            *(view.width, view.height, view.fx, view.fy, view.cx, view.cy),
            camera_from_world=torch.from_numpy(camera_from_world),
            timestamp_ns=timestamp_ns,
            lens=view.lens,
            shutter=view.shutter,
        )
    except ValueError as error:
        raise AdapterError(f"image {view.name!r}: {error}") from error


# ---- A scene with the frames of a path file ------------------------------------------------------


def frames_from_path_file(path: str | Path, scene: Scene) -> tuple[Frame, ...]:
    """Return the frames of a path file, in the scene's recentred world."""
    return _frames_and_problems(Path(path), scene)[0]


def with_camera_path(scene: Scene, path: str | Path) -> Scene:
    """Return the scene with the frames of a path file instead of its own.

    It has no labels, which belong to the recorded frames. Its `source` opens it again, path
    included.
    """
    frames, problems = _frames_and_problems(Path(path), scene)
    return dataclasses.replace(
        scene,
        frames=frames,
        seen_frames=scene.frames if scene.seen_frames is None else scene.seen_frames,
        labels=None,
        source=add_to_uri(scene.source, CAMERA_PATH_KEY, str(path)),
        problems=(*(p for p in scene.problems if not p.startswith(NO_CAMERAS)), *problems),
    )


def _frames_and_problems(path: Path, scene: Scene) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Return the frames of a path file, and sentences on problems."""
    view_set = read_views(path)
    start_ns = scene.frames[0].timestamp_ns if scene.frames else 0
    change = WorldChange(origin_m=scene.world_origin_m)
    frames, problems = frames_from_views(view_set.views, change, start_ns=start_ns)
    if scene.labels is not None:
        problems += (f"{path}: its frames are not the dataset's, so boxes and LiDAR are left out",)
    return frames, (*view_set.problems, *problems)
