"""Frames for scenes that come without: from camera files, or a drive or orbit made for them.

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
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.scene import Gaussians, Scene

# ---- Height of the ground, from Gaussians alone --------------------------------------------------
# There are no labels in a splat file, so the ground is what lies low: a low quantile of the centres
# of solid Gaussians around a place; a quantile, since trained scenes hold stray ones underground.

SOLID_OPACITY = 0.3  # fainter Gaussians are haze and leftovers of training
BULK_REACH = 8.0  # in median distances: of a drive that is dense in the middle, all
_LOW_QUANTILE = 0.1
_ROAD_REACH_M, _ROAD_LAYER_M, _ROAD_ABOVE_LOW_M = 2.5, 0.2, 0.7
_MIN_POINTS = 12
_MAX_POINTS = 300_000
_MAX_PLACES = 128
_CELLS_A_SIDE = 200
_MIN_KNOWN = 6  # of 25 cells: ground is not spread beyond the content's edge


def solid_points(gaussians: Gaussians) -> np.ndarray:
    """Centres [N, 3] of solid Gaussians, or of all where hardly any is, thinned evenly; float64."""
    return gaussians.means[_solid(gaussians)].double().numpy()


def solid_points_and_areas(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """The same centres, and the area [N] each hides from a wide beam: opacity times 2 pi times its
    two larger scales. Thinned areas make up for those left out."""
    index = _solid(gaussians)
    count = int((gaussians.opacities > SOLID_OPACITY).sum())
    scales = gaussians.scales[index].sort(dim=1).values
    area = 2 * math.pi * gaussians.opacities[index] * scales[:, 1] * scales[:, 2]
    thinned = max(count, len(index)) / max(len(index), 1)
    return gaussians.means[index].double().numpy(), area.double().numpy() * thinned


def _solid(gaussians: Gaussians) -> Tensor:
    solid = torch.nonzero(gaussians.opacities > SOLID_OPACITY)[:, 0]
    if len(solid) < _MIN_POINTS:
        solid = torch.arange(len(gaussians))
    return solid[:: 1 + len(solid) // _MAX_POINTS]


def in_bulk(points: np.ndarray, reach: float) -> np.ndarray:
    """Which points [N, 3] lie within `reach` times the median distance from their middle: without
    what floats far around a scene, which would stretch every extent."""
    inside = np.ones(len(points), bool)
    for _ in range(3):  # the middle moves once the far ones are gone
        distance = np.linalg.norm(points - np.median(points[inside], axis=0), axis=1)
        inside = distance <= reach * np.median(distance[inside])
    return inside


def ground_under(
    points: np.ndarray, positions: np.ndarray, *, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ground heights [P'] under positions [P, 3], and the positions [P', 3] they belong to: those
    with enough points within `radius` in plan below them. Long paths are thinned evenly."""
    kept, heights = [], []
    for position in positions[:: 1 + len(positions) // _MAX_PLACES]:
        offset = points[:, :2] - position[:2]
        near = (offset * offset).sum(1) < radius * radius
        below = points[near & (points[:, 2] < position[2]), 2]
        if len(below) >= _MIN_POINTS:
            kept.append(position)
            heights.append(np.quantile(below, _LOW_QUANTILE))
    return np.array(heights), np.array(kept).reshape(-1, 3)


def road_heights(
    points: np.ndarray, areas: np.ndarray, places: np.ndarray, low: np.ndarray, *, unit: float = 1.0
) -> np.ndarray:
    """Heights [P] that hold the most surface around places [P, 2 or 3]; NaN where nothing is near.

    low: [P], what lies low there, such as foundations and strays. Coarse splats lie under fine
    ones, so none counts for many. unit: a metre's length."""
    layer = unit * _ROAD_LAYER_M
    heights, areas = np.full(len(places), np.nan), np.minimum(areas, np.median(areas))
    for number, (place, least) in enumerate(zip(places, low, strict=True)):
        offset = points[:, :2] - place[:2]
        near = (offset * offset).sum(axis=1) < (unit * _ROAD_REACH_M) ** 2
        near &= np.abs(points[:, 2] - least) < unit * _ROAD_ABOVE_LOW_M
        if near.any():
            z, area = points[near, 2], areas[near]
            bins = np.floor((z - z.min()) / (layer / 4)).astype(int)
            layers = np.convolve(np.bincount(bins, area), np.ones(4))
            top = z.min() + (layers.argmax() + 1) * layer / 4
            within = (z <= top) & (z >= top - layer)
            heights[number] = np.average(z[within], weights=area[within])
    return heights


def lowest_ground(points: np.ndarray, positions: np.ndarray, *, radius: float) -> float | None:
    """Height of the ground where it is lowest under a path; None where nothing lies under it."""
    heights, _ = ground_under(points, positions, radius=radius)
    # The 5 % quantile: one hole in the reconstruction must not set the level of a flood.
    return float(np.quantile(heights, 0.05)) if len(heights) else None


@dataclass(frozen=True, eq=False)
class GroundGrid:
    """Ground heights [X, Y] on square cells, NaN where nothing is near. corner: x, y of the
    first."""

    corner: np.ndarray
    cell: float
    height: np.ndarray

    def cells_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices along x and y, clipped to the grid, and which points lie inside it."""
        index = np.floor((points[..., :2] - self.corner) / self.cell).astype(int)
        inside = np.all((index >= 0) & (index < np.array(self.height.shape)), axis=-1)
        x = index[..., 0].clip(0, self.height.shape[0] - 1)
        y = index[..., 1].clip(0, self.height.shape[1] - 1)
        return x, y, inside

    def at(self, points: np.ndarray) -> np.ndarray:
        """Height under points [..., 2 or 3]; NaN outside and where unknown."""
        x, y, inside = self.cells_of(points)
        return np.where(inside, self.height[x, y], np.nan)


def ground_grid(points: np.ndarray, *, cell: float) -> GroundGrid:
    """Ground heights over the bulk of the points: the low quantile of each cell, then the third
    lowest tenth of the 5x5 cells around it, which no car or bush lifts. cell: metres at least."""
    low, high = np.quantile(points[:, :2], [0.005, 0.995], axis=0)
    cell = max(cell, float((high - low).max()) / _CELLS_A_SIDE)
    shape = np.floor((high - low) / cell).astype(int) + 1
    grid = GroundGrid(low, cell, np.full(shape, np.nan))
    x, y, inside = grid.cells_of(points)
    flat = (x * shape[1] + y)[inside]
    heights = points[inside, 2]
    order = np.lexsort((heights, flat))
    cells, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    grid.height.reshape(-1)[cells] = heights[order][first + (_LOW_QUANTILE * count).astype(int)]
    return GroundGrid(low, cell, _smooth(grid.height))


def _smooth(height: np.ndarray) -> np.ndarray:
    padded = np.pad(height, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*height.shape, 25)
    ordered = np.sort(windows, axis=-1)  # NaN last
    known = np.isfinite(ordered).sum(-1)
    pick = (0.3 * known).astype(int).clip(0, 24)
    smooth = np.take_along_axis(ordered, pick[..., None], -1)[..., 0]
    return np.where(known >= _MIN_KNOWN, smooth, np.nan)


# ---- Camera paths for scenes that come without cameras: a drive along the street, or an orbit ----
# A drive is made where the content is wide, flat and metric: the longest straight line over ground
# with nothing at the height of a car in its way. The camera stands CAMERA_HEIGHT_M above the ground
# and stops short of the end, so that there is something ahead in the last image. Everything else is
# orbited.

PathKind = Literal["auto", "drive", "orbit"]

NO_CAMERAS = "no cameras came with the scene"  # how every note begins
CAMERA_HEIGHT_M = 1.6
WIDTH, HEIGHT = 960, 540
DRIVE_CAMERAS_DEG = {"front": 0.0, "left": 60.0, "right": -60.0}  # yaw; 75° wide each, so they meet
_FIELD_OF_VIEW_DEG = {"drive": 75.0, "orbit": 55.0}
_STEP_M = 0.5  # 5 m/s at 10 Hz
_MAX_CELLS = 1010  # a side: up to half a kilometre every step is looked at, beyond that every nth
_MAX_FRAMES = 100
_MAX_DRIVE_M = 1000.0  # what lies between frames farther apart no image shows
_ORBIT_FRAMES = 48
_MIN_DRIVE_M = 8.0
_WIDE_M, _FLATNESS = 20.0, 0.5
_CAR_M = (0.5, 2.5)  # above the ground: what lies between is in the way
_HALF_WIDTH_M = 1.25
_DETAIL_REACH_M, _COARSER_THAN_USUAL = 2.0, 1.7
_BLOCKED_COST = 4.0  # passing half a metre of wall must cost more than it gains
_BEHIND_SHARE, _AHEAD_SHARE = 0.05, 0.3  # of the line, before the first and after the last image
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
    if np.linalg.norm(end - start) < _MIN_DRIVE_M and kind == "auto":
        return _orbit(points, is_metric=is_metric, asked=False)
    return _drive(points, areas, grid, start, end)


def _is_wide_and_flat(points: np.ndarray) -> bool:
    extent = np.subtract(*np.quantile(points, [0.95, 0.05], axis=0))
    wide = float(np.hypot(*extent[:2]))
    return wide >= _WIDE_M and extent[2] < _FLATNESS * wide


def _longest_free_line(
    points: np.ndarray, areas: np.ndarray, grid: GroundGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Ends [2] of the straight line with the most ground under it and the least in its way: each
    step counts +1 over known ground, -1 elsewhere, less the share of a car's front that Gaussians
    hide."""
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
    """Where Gaussians are not much larger than usual: near where the training cameras drove."""
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
    start = start + _BEHIND_SHARE * whole * forward
    length = min((1 - _BEHIND_SHARE - _AHEAD_SHARE) * whole, _MAX_DRIVE_M)
    count = max(2, min(_MAX_FRAMES, round(length / _STEP_M) + 1))
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

FRAME_INTERVAL_S = 0.1
SINGLE_CAMERA = "camera"
_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".exr"}
_FRAME_THEN_CAMERA = re.compile(r"(\d+)[_-](\d{1,2}|\w*[A-Za-z]\w*)")
_CAMERA_THEN_FRAME = re.compile(r"(\w*[A-Za-z]\w*?)[_-]?(\d+)")
_MAX_CAMERAS = 32
_MAX_FRAME_NUMBER = 10**9  # beyond it the digits are a time or a hash


def frames_from_views(
    views: Sequence[PosedView], change: WorldChange, *, start_ns: int = 0
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Frames in order of time (or of their names), and sentences on what could not be kept.
    world_from_ego stands at the front camera, level.

    change: from the views' world to the scene's. start_ns: what times in the views count from."""
    keys, problems = _keys_of_views(views)
    order = sorted(set(frame for _, frame in keys), key=_natural)
    numbers = _frame_numbers(order)
    frames = []
    for rank, key in enumerate(order):
        of_frame = [(k[0], v) for k, v in zip(keys, views, strict=True) if k[1] == key]
        of_frame.sort(key=lambda named: _natural(named[0]))
        default_ns = start_ns + round(rank * FRAME_INTERVAL_S * 1e9)
        times = {
            name: default_ns if view.timestamp_ns is None else start_ns + view.timestamp_ns
            for name, view in of_frame
        }
        cameras = {name: _camera(name, view, change, times[name]) for name, view in of_frame}
        frames.append(
            Frame(
                index=numbers[rank],
                timestamp_ns=min(camera.timestamp_ns for camera in cameras.values()),
                world_from_ego=ego_from_front_camera(cameras),
                cameras=cameras,
                image_paths={name: v.image_path for name, v in of_frame if v.image_path},
            )
        )
    return tuple(frames), problems


def split_names(names: Sequence[str]) -> list[tuple[str, str]] | None:
    """Camera and frame of every image name by the module's rules; None where none of them fits
    (then every image is a frame of a single camera)."""
    parts = [_parts(name) for name in names]
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
    """Whether at least half of the frames have two cameras or more, of not too many in all."""
    per_frame = Counter(frame for _, frame in pairs)
    shared = sum(count > 1 for count in per_frame.values())
    return 2 * shared >= len(per_frame) and len({c for c, _ in pairs}) <= _MAX_CAMERAS


def ego_from_front_camera(cameras: dict[str, Camera]) -> torch.Tensor:
    """world_from_ego of a level vehicle at the front camera: the one named so, else the first."""
    named = [name for name in cameras if "front" in name.lower()]
    front = min(named, key=len) if named else next(iter(cameras))
    world_from_camera = cameras[front].world_from_camera
    heading = world_from_camera[:2, 2]
    if heading.norm() < 1e-6:  # straight up or down: the top of the image is ahead
        heading = -world_from_camera[:2, 1]
    x, y = (heading / heading.norm()).tolist()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[x, -y], [y, x]], dtype=torch.float64)
    pose[:3, 3] = world_from_camera[:3, 3]
    return pose


def _keys_of_views(views: Sequence[PosedView]) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    keys = [(v.camera, str(v.frame)) for v in views if v.camera is not None]
    if len(keys) < len(views):
        names = [v.name for v in views]
        keys = split_names(names) or [(SINGLE_CAMERA, "/".join(_parts(name))) for name in names]
    if len(set(keys)) == len(keys):
        return keys, ()
    (camera, frame), count = Counter(keys).most_common(1)[0]
    problem = (
        f"{count} views are named camera {camera!r}, frame {frame!r}, so cameras and frames cannot "
        "be told apart by name: every view is a frame of one camera, in the file's order"
    )
    width = len(str(len(views)))
    return [(SINGLE_CAMERA, f"{number:0{width}d}") for number in range(len(views))], (problem,)


def _parts(name: str) -> tuple[str, ...]:
    """Folders and stem; only extensions of images are taken off, a stem may hold dots."""
    path = PurePosixPath(name.replace("\\", "/"))
    stem = path.stem if path.suffix.lower() in _IMAGE_SUFFIXES else path.name
    return (*(part for part in path.parts[:-1] if part not in (".", "..", "/")), stem)


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key in which digits count as numbers: 2 before 10."""
    pieces = re.findall(r"\d+|\D+", text)
    return [(0, int(p), p) if p.isdecimal() and len(p) < 100 else (1, 0, p) for p in pieces]


def _frame_numbers(order: Sequence[str]) -> list[int]:
    """The dataset's own frame numbers where the names end in distinct, growing ones."""
    found = [re.search(r"(\d{1,10})$", key) for key in order]
    numbers = [int(match[1]) for match in found if match]
    growing = all(a < b for a, b in itertools.pairwise(numbers))
    if len(numbers) == len(order) and growing and max(numbers) < _MAX_FRAME_NUMBER:
        return numbers
    return list(range(len(order)))


def _camera(name: str, view: PosedView, change: WorldChange, timestamp_ns: int) -> Camera:
    camera_from_world = invert_pose(change.pose(view.world_from_camera))
    try:
        return Camera(
            name,
            *(view.width, view.height, view.fx, view.fy, view.cx, view.cy),
            camera_from_world=torch.from_numpy(camera_from_world),
            timestamp_ns=timestamp_ns,
        )
    except ValueError as error:
        raise AdapterError(f"image {view.name!r}: {error}") from error


# ---- A scene with the frames of a path file ------------------------------------------------------


def frames_from_path_file(path: str | Path, scene: Scene) -> tuple[Frame, ...]:
    """The frames of a path file, in the scene's recentred world."""
    return _frames_and_problems(Path(path), scene)[0]


def with_camera_path(scene: Scene, path: str | Path) -> Scene:
    """The scene with the frames of a path file in place of its own and without the labels, which
    belong to those. Its `source` opens it again, path included."""
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
    found = read_views(path)
    start_ns = scene.frames[0].timestamp_ns if scene.frames else 0
    change = WorldChange(origin_m=scene.world_origin_m)
    frames, problems = frames_from_views(found.views, change, start_ns=start_ns)
    if scene.labels is not None:
        problems += (f"{path}: its frames are not the dataset's, so boxes and LiDAR are left out",)
    return frames, (*found.problems, *problems)
