"""Finds the surfaces of a scene that are open to the sky and visible to a camera.

Input: a `Scene`, the cameras that must see the surfaces, `ExposureSettings`. Output: an
`ExposedSurface`, square cells on the background and on vehicles. Caller:
`support.exposed_surface_of`.

1. `plan_tiles` plans square tiles about the cameras' path, with finer cells near it.
2. `draw_views` renders the depth that a sample of the cameras along the drive sees.
3. `_GroundSearch.find` works on one square of tiles at a time, each with a margin: it renders the
   square from above, closes holes, separates the surfaces, keeps the cells that a camera sees, and
   finds their light, wheel tracks and obstacles.
4. `find_actor_cells` does the same for each vehicle, in the vehicle's own frame.
5. `_GroundSearch.join` links neighbouring cells across squares and finds the Gaussians that the
   cells bury.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from augment.errors import SceneError
from augment.exposure import surface_kernels
from augment.exposure.cells import FLUSH, MAX_EDGE_DISTANCE_M, ExposedCells, ExposedSurface
from augment.exposure.height_map import (
    DepthEstimator,
    Footprints,
    HeightMap,
    Views,
    classes_of,
    draw_from_above,
    draw_views,
    in_order,
    plain_gaussians,
    top_of,
)
from augment.exposure.surface import (
    CellList,
    Surface,
    cells_at,
    find_actor_cells,
    find_banks,
    find_narrow_things,
    find_surface,
    is_moving,
    is_vehicle,
    make_cells,
    normals_from_slopes,
)
from augment.exposure.surface_kernels import LINK, RISES
from augment.light.cast_shadows import CastShadows, shadows_of
from augment.progress import ProgressBar
from augment.render.buffers import AUTO, CUDA
from augment.scene.cameras import Camera
from augment.scene.ground import check_metric_and_level
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.timing import counted_steps

# ---- Tiles about the cameras' path, their cell sizes, and the index of every cell ----------------

# Level distances from the cameras' path at which cells double in size; beyond the last there are
# no cells.
RING_DISTANCES_M = (8.0, 32.0, 48.0, 80.0, 120.0)
# Size up to which cells double, about; a coarser cell_m does not double at all.
MAX_DOUBLED_CELL_M = 1.0
BYTES_PER_CELL = 70  # memory of an exposed cell
MAX_BYTES = 4 << 30  # largest memory of an exposed surface
PROGRESS_LABEL = "finding exposed surfaces"  # label of the progress bar and of the step counter
_TILE_SIDE_M = 3.2  # side of a tile, about
_PATH_STEP_M = 1.0  # camera centres closer than this are one place of the path
_MAX_PATH_GAP_M = 25.0  # camera centres farther apart than this are not joined
_MAX_TILES = 30_000_000  # largest number of tiles in the rectangle about the path


class Window(NamedTuple):
    """Rectangle of cells of one level.

    Columns and rows are counted from the plan's origin, towards +x and +y.
    """

    left: int  # first column
    bottom: int  # first row
    width: int  # number of columns
    height: int  # number of rows


@dataclass(frozen=True, eq=False)
class TilePlan:
    """Square tiles, row by row from `origin_m` towards +y."""

    origin_m: tuple[float, float]  # x and y of the first tile's corner, world
    side_m: float  # side of a tile
    cell_m: float  # side of the finest cells; cells of level k have sides of cell_m 2^k
    levels: np.ndarray  # int8 [Y, X], level of each tile's cells; -1 where a tile is left out

    def size_m(self, level: int) -> float:
        """Return the side of a level's cells, metres."""
        return self.cell_m * 2**level

    def cells_per_side(self, level: int) -> int:
        """Return the number of cells along a tile's side."""
        return round(self.side_m / self.size_m(level))

    @property
    def cells(self) -> int:
        """Number of cells in all tiles; those of them that are open ground become exposed cells."""
        counts = np.bincount(self.levels[self.levels >= 0].astype(np.int64))
        return sum(int(n) * self.cells_per_side(k) ** 2 for k, n in enumerate(counts))

    def check_size(self) -> None:
        """Check that the cells of these tiles fit in memory.

        Raises:
            SceneError: the cells would take more than MAX_BYTES.
        """
        if self.cells * BYTES_PER_CELL <= MAX_BYTES:
            return
        min_cell_m = self.cell_m * math.sqrt(self.cells * BYTES_PER_CELL / MAX_BYTES)
        raise SceneError(
            f"exposed surfaces in cells of {self.cell_m:g} m would take "
            f"{self.cells / 1e6:,.0f} million cells along this path, about "
            f"{self.cells * BYTES_PER_CELL / 1e9:,.1f} GB; at most "
            f"{MAX_BYTES / 1e9:.1f} GB are used. Take cells of {_round_up(min_cell_m):g} m or more "
            f"(weather.snow.cell_m), or fewer frames"
        )

    def squares(self, level: int, max_cells: int) -> Iterator[Window]:
        """Yield the level's cells in squares of whole tiles, each with a tile of the level.

        Args:
            level: level of the cells.
            max_cells: largest number of cells on a square's side, unless a single tile has more.
        """
        tiles = self.levels == level
        n = self.cells_per_side(level)
        step = max(1, max_cells // n)
        for row in range(0, tiles.shape[0], step):
            for column in range(0, tiles.shape[1], step):
                part = tiles[row : row + step, column : column + step]
                if part.any():
                    rows = np.flatnonzero(part.any(1))
                    columns = np.flatnonzero(part.any(0))
                    yield Window(
                        (column + int(columns[0])) * n,
                        (row + int(rows[0])) * n,
                        int(columns[-1] - columns[0] + 1) * n,
                        int(rows[-1] - rows[0] + 1) * n,
                    )

    def is_level(self, level: int, window: Window) -> np.ndarray:
        """Return the cells of a window that lie in the level's tiles, bool [height, width]."""
        n = self.cells_per_side(level)
        rows = (window.bottom + np.arange(window.height)) // n
        columns = (window.left + np.arange(window.width)) // n
        row_inside = (rows >= 0) & (rows < self.levels.shape[0])
        column_inside = (columns >= 0) & (columns < self.levels.shape[1])
        mask = np.zeros((window.height, window.width), bool)
        is_level = self.levels[np.ix_(rows[row_inside], columns[column_inside])] == level
        mask[np.ix_(row_inside, column_inside)] = is_level
        return mask


class CellNumbers:
    """Index of the exposed cell at each cell of a plan; -1 where there is none."""

    def __init__(self, plan: TilePlan) -> None:
        self._plan = plan
        levels = plan.levels.ravel()
        sides = np.array([plan.cells_per_side(k) for k in range(max(1, levels.max(initial=0) + 1))])
        self._side_codes = np.where(levels >= 0, sides[np.maximum(levels, 0)], 0).astype(np.int64)
        ends = np.cumsum(self._side_codes**2)
        self._starts = ends - self._side_codes**2
        self._numbers = np.full(int(ends[-1]) if len(ends) else 0, -1, np.int32)

    def put(self, level: int, columns: np.ndarray, rows: np.ndarray, numbers: np.ndarray) -> None:
        """Set the indices of a level's cells; columns, rows: int64 [C], counted from the origin."""
        n = self._plan.cells_per_side(level)
        tiles = (rows // n) * self._plan.levels.shape[1] + columns // n
        self._numbers[self._starts[tiles] + (rows % n) * n + columns % n] = numbers

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Indices int32 [P] of the cells under points float64 [P, 2]; -1 where there is no cell."""
        out = np.empty(len(xy), np.int32)
        surface_kernels.find_cell_ids(
            np.ascontiguousarray(xy, np.float64),
            self._plan.origin_m,
            self._plan.side_m,
            self._plan.levels.shape[0],
            self._plan.levels.shape[1],
            self._side_codes,
            self._starts,
            self._numbers,
            out,
        )
        return out


def plan_tiles(
    cameras: Sequence[Camera], cell_m: float, heights_m: tuple[float, float]
) -> TilePlan:
    """Plan the tiles about the cameras' path that one of the cameras may see.

    Args:
        cameras: cameras along the drive; those of `views_along` are enough.
        cell_m: side of the finest cells, metres.
        heights_m: lowest and highest z that anything in the scene can have, metres.

    Raises:
        SceneError: the cameras are so far apart that their tiles cannot be listed.
    """
    max_level = max(
        0, min(len(RING_DISTANCES_M) - 1, math.floor(math.log2(MAX_DOUBLED_CELL_M / cell_m)))
    )
    max_cell_m = cell_m * 2**max_level
    side_m = max_cell_m * max(
        1 if max_cell_m > _TILE_SIDE_M else 2, math.ceil(_TILE_SIDE_M / max_cell_m)
    )
    if not cameras:
        return TilePlan((0.0, 0.0), side_m, cell_m, np.full((1, 1), -1, np.int8))
    path = path_points(cameras)[:, :2]
    first_tile = np.floor((path.min(0) - RING_DISTANCES_M[-1]) / side_m).astype(np.int64)
    num_tiles = (
        np.floor((path.max(0) + RING_DISTANCES_M[-1]) / side_m).astype(np.int64) + 1 - first_tile
    )
    if float(num_tiles[0]) * float(num_tiles[1]) > _MAX_TILES:
        extent = path.max(0) - path.min(0)
        raise SceneError(
            f"the cameras' path covers {extent[0] / 1e3:,.1f} km x {extent[1] / 1e3:,.1f} km, more "
            f"than exposed surfaces can be searched along at once; take fewer frames"
        )
    origin = first_tile * side_m
    distance = _distance_to_path(path, origin, side_m, (int(num_tiles[1]), int(num_tiles[0])))
    rings = np.minimum(
        np.searchsorted(np.array(RING_DISTANCES_M), distance, side="right"), len(RING_DISTANCES_M)
    )
    levels = np.where(rings < len(RING_DISTANCES_M), np.minimum(rings, max_level), -1).astype(
        np.int8
    )
    is_visible = np.zeros(levels.shape, bool)
    for camera in cameras:
        _mark_frustum(camera, origin, side_m, heights_m, is_visible)
    levels[~is_visible] = -1
    return TilePlan((float(origin[0]), float(origin[1])), side_m, cell_m, levels)


def views_along(cameras: Sequence[Camera], step_m: float = 2.0) -> list[Camera]:
    """Select cameras spread along the drive.

    Of each camera name, the first and the last one are selected, and those between that have moved
    by `step_m` or turned by 10 degrees since the last selected one.
    """
    selected = []
    for group in _group_by_name(cameras):
        last_selected = group[0]
        for index, camera in enumerate(group):
            if index in (0, len(group) - 1) or _has_moved(last_selected, camera, step_m):
                selected.append(camera)
                last_selected = camera
    return selected


def path_points(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the path of the cameras, float64 [P, 3].

    The centres of cameras of one name are joined in order of time, one name after another.
    """
    points = []
    for group in _group_by_name(cameras):
        centres = np.stack([camera.centre.numpy() for camera in group])
        points.append(centres)
        for start, end in itertools.pairwise(centres):
            gap = float(np.linalg.norm(end - start))
            if _PATH_STEP_M < gap <= _MAX_PATH_GAP_M:
                shares = np.arange(1, math.ceil(gap / _PATH_STEP_M)) * (_PATH_STEP_M / gap)
                points.append(start + shares[:, None] * (end - start))
    joined = np.concatenate(points)
    _, first_rows = np.unique(np.round(joined / (0.5 * _PATH_STEP_M)), axis=0, return_index=True)
    return joined[np.sort(first_rows)]


def _group_by_name(cameras: Sequence[Camera]) -> Iterable[list[Camera]]:
    """Group the cameras by name, each group in order of time."""
    groups: dict[str, list[Camera]] = {}
    for camera in sorted(cameras, key=lambda camera: camera.timestamp_ns):
        groups.setdefault(camera.name, []).append(camera)
    return (groups[name] for name in dict.fromkeys(camera.name for camera in cameras))


def _has_moved(before: Camera, camera: Camera, step_m: float) -> bool:
    """Tell if a camera has moved by `step_m` or turned by 10 degrees since another one."""
    gap = float((camera.centre - before.centre).norm())
    turn = float((camera.camera_from_world[2, :3] * before.camera_from_world[2, :3]).sum())
    return gap >= step_m or turn < math.cos(math.radians(10))


def _distance_to_path(
    path: np.ndarray, origin: np.ndarray, side: float, shape: tuple[int, int]
) -> np.ndarray:
    """Level distance from each tile's nearest point to the path, [Y, X], up to the last ring."""
    distances = np.full(shape, np.inf)
    reach = math.ceil(RING_DISTANCES_M[-1] / side) + 1
    for x, y in path - origin:
        rows = _tile_range(y, reach, side, shape[0])
        columns = _tile_range(x, reach, side, shape[1])
        dy = np.maximum(np.abs((rows + 0.5) * side - y) - side / 2, 0)
        dx = np.maximum(np.abs((columns + 0.5) * side - x) - side / 2, 0)
        window = distances[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        np.minimum(window, np.hypot(dy[:, None], dx), out=window)
    return distances


def _tile_range(coordinate: float, reach: int, side: float, count: int) -> np.ndarray:
    """Return the indices of the tiles within `reach` tiles of a coordinate, clipped to `count`."""
    middle = int(coordinate // side)
    return np.arange(max(0, middle - reach), min(count, middle + reach + 1))


def _mark_frustum(
    camera: Camera,
    origin: np.ndarray,
    side: float,
    heights_m: tuple[float, float],
    is_visible: np.ndarray,
) -> None:
    """Mark the tiles that a camera may see, in place.

    A tile counts if its column between the two heights is not wholly outside one of the image's
    borders. Columns are taken 2 m wider all round, since `cameras` leaves out the views between.
    """
    margin_m = 2.0
    pose = camera.world_from_camera.numpy()
    centre = pose[:3, 3]
    axes = pose[:3, :3]
    reach = math.ceil(RING_DISTANCES_M[-1] / side) + 1
    rows = _tile_range(centre[1] - origin[1], reach, side, is_visible.shape[0])
    columns = _tile_range(centre[0] - origin[0], reach, side, is_visible.shape[1])
    window = is_visible[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    x = origin[0] + (columns + 0.5) * side - centre[0]
    y = (origin[1] + (rows + 0.5) * side - centre[1])[:, None]
    low = heights_m[0] - margin_m - centre[2]
    high = heights_m[1] + margin_m - centre[2]
    is_inside = np.ones(window.shape, bool)
    for normal, offset in _image_borders(camera):
        normal_world = axes @ normal
        reach_xy = (side / 2 + margin_m) * (abs(normal_world[0]) + abs(normal_world[1]))
        reach_z = max(normal_world[2] * low, normal_world[2] * high)
        is_inside &= normal_world[0] * x + normal_world[1] * y + (reach_xy + reach_z) >= offset
    window |= is_inside


def _image_borders(camera: Camera) -> list[tuple[np.ndarray, float]]:
    """Return planes n . p >= offset, in camera coordinates, between which the image lies."""
    borders = [(np.array([0.0, 0.0, 1.0]), 0.0)]
    lens = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, middle, size) in enumerate(lens):
        for sign, edge in ((1.0, -middle / focal), (-1.0, (size - middle) / focal)):
            normal = np.zeros(3)
            normal[axis] = sign
            normal[2] = 0.0 if camera.is_orthographic else -sign * edge
            borders.append((normal, sign * edge if camera.is_orthographic else 0.0))
    return borders


def _round_up(value: float) -> float:
    """Round up to two significant digits."""
    digit = 10 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / digit) * digit, 12)


# ---- Light on the bare ground, relative to its class: shadows that the recording holds -----------

MIN_RELATIVE_LIGHT = 0.25  # lower limit of the relative light
MAX_RELATIVE_LIGHT = 1.5  # upper limit of the relative light
# Standard deviation of the luminance blur: shadows have soft edges, and gravel is no shadow.
_LUMINANCE_BLUR_M = 0.2
_PAINT_MARGIN_M = 0.1  # distance beyond its own splats up to which a lane marking may show
_LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722], np.float32)  # weights of linear sRGB
_MIN_BLUR_CELLS = 0.3  # a blur narrower than this number of cells is left out
_MIN_WEIGHT = 0.02  # least weight of the blur at which luminance is known
_MIN_SUNLIT_SHARE = 0.8  # least share of the light at which a cell counts as sunlit
_MIN_CLASS_CELLS = 50  # least number of cells of a class for its median to mean anything
# Classes that differ in colour as much as in light: the square root of their ratio is taken.
_MULTICOLOURED_CLASSES = (SemanticClass.UNKNOWN, SemanticClass.VEGETATION, SemanticClass.OTHER)
_LANE_MARKING = int(SemanticClass.LANE_MARKING)
_ROAD = int(SemanticClass.ROAD)


def ground_luminance(
    height_map: HeightMap, classes: np.ndarray, can_carry: np.ndarray
) -> np.ndarray:
    """Blurred linear luminance of the cells that carry snow, float32 [H, W]; NaN where unknown.

    Each class is blurred by itself. Under lane markings, the road about them gives the luminance.

    Args:
        height_map: view of the square from above.
        classes: int16 [H, W], class of each cell.
        can_carry: bool [H, W], cells that can carry snow.
    """
    rgb = np.clip(height_map.rgb[can_carry], 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** np.float32(2.4))
    luminance = np.zeros(can_carry.shape, np.float32)
    luminance[can_carry] = (linear.astype(np.float32) * _LUMINANCE_WEIGHTS).sum(-1)
    blurred = np.full(luminance.shape, np.nan, np.float32)
    marking = classes == _LANE_MARKING
    around = 2 * max(1, round(_PAINT_MARGIN_M / height_map.cell_m)) + 1
    painted_mask = cv2.dilate(marking.astype(np.uint8), np.ones((around, around), np.uint8)).astype(
        bool
    )
    surface_classes = np.where(marking, np.int16(_ROAD), classes)
    sigma = _LUMINANCE_BLUR_M / height_map.cell_m
    for surface in np.unique(surface_classes[can_carry]):
        surface_mask = can_carry & (surface_classes == surface)
        sample_mask = surface_mask & ~painted_mask
        weights = sample_mask.astype(np.float32)
        sums = luminance * weights
        for spread in (sigma, 4 * sigma):
            missing_mask = surface_mask & np.isnan(blurred)
            if not missing_mask.any():
                break
            weight = _blur(weights, spread)
            total = _blur(sums, spread)
            known_mask = missing_mask & (weight > _MIN_WEIGHT)
            blurred[known_mask] = total[known_mask] / weight[known_mask]
    return blurred


def relative_light(
    luminance: np.ndarray, classes: np.ndarray, in_light: np.ndarray | None = None
) -> np.ndarray:
    """Luminance of each cell over the median of its class, float32 [C].

    See ExposedCells.relative_light.

    Args:
        luminance: float32 [C]; where it is NaN, the result is 1.
        classes: int16 [C].
        in_light: share of the light that cast shadows leave, [C], NaN where unknown. If given,
            medians are taken over sunlit cells, and multicoloured classes take this share.
    """
    light = np.ones(len(luminance), np.float32)
    surface_classes = np.where(classes == _LANE_MARKING, np.int16(_ROAD), classes)
    known_mask = np.isfinite(luminance)
    if in_light is None:
        in_light = np.full(len(luminance), np.nan)
    for surface in np.unique(surface_classes):
        surface_mask = known_mask & (surface_classes == surface)
        sample_mask = surface_mask & (in_light > _MIN_SUNLIT_SHARE)
        sample_mask = sample_mask if sample_mask.sum() >= _MIN_CLASS_CELLS else surface_mask
        median = (
            float(np.median(luminance[sample_mask]))
            if sample_mask.sum() >= _MIN_CLASS_CELLS
            else 0.0
        )
        if median <= 1e-4:
            continue
        ratio = luminance[surface_mask] / np.float32(median)
        if surface in _MULTICOLOURED_CLASSES:
            shadow_light = in_light[surface_mask]
            ratio = np.where(np.isfinite(shadow_light), shadow_light, np.sqrt(np.maximum(ratio, 0)))
        light[surface_mask] = ratio
    return np.clip(light, MIN_RELATIVE_LIGHT, MAX_RELATIVE_LIGHT)


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    """Blur values by sigma cells; a narrower blur than _MIN_BLUR_CELLS does nothing."""
    if sigma < _MIN_BLUR_CELLS:
        return values
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)


# ---- Holes in the ground, closed where their surroundings leave no doubt -------------------------
# A car's lidar does not see the ground beneath the car, and a fit of a drive that begins or ends
# with the car standing still has no Gaussians there. The rim of such a hole gives its height.

MIN_HOLE_M2 = 0.1  # least area of a hole; `surface` closes smaller gaps
MAX_HOLE_M2 = 7.0  # largest area of a hole beside the path
MAX_OVERHUNG_M2 = 0.6  # largest part of it under narrow things: lamps, not eaves
MAX_PATH_HOLE_M2 = 80.0  # largest area of a hole that the path of the cameras crosses
_PATH_HALF_WIDTH_M = 1.0  # half the width of the path
_RIM_CELLS = 3  # width of a hole's rim
_PLANE_TOLERANCE_M = 0.12  # largest distance of a rim's height from the fitted plane
_FIRST_TOLERANCE_M = 0.5  # largest distance from the rim's median height, in the first round
_MIN_RIM_CELLS = 8  # least number of cells of a rim
_MIN_PLANE_SHARE = 0.6  # least share of a rim's cells that must lie in the plane
_MIN_OCTANTS = 7  # least number of octants around a hole that hold cells of the plane
_MIN_OCTANTS_ON_PATH = 5  # the same for a hole on the path
_MAX_PLANE_SLOPE = math.tan(math.radians(20))  # steepest slope of the plane
_MAX_RIM_SAMPLES = 160  # largest number of a rim's cells that heights are taken from
_MIN_CLEARANCE_M = 0.3  # height over the plane beyond which a thin thing in a hole is left as it is


def fill_holes(
    height_map: HeightMap,
    classes: np.ndarray,
    carry_mask: np.ndarray,
    narrow_mask: np.ndarray,
    pixel_mask: np.ndarray,
    path_xy: np.ndarray,
) -> tuple[HeightMap, np.ndarray]:
    """Close the holes that one smooth surface surrounds.

    Args:
        height_map: view of the square from above.
        classes: int16 [H, W], written: filled cells get the most frequent class around them.
        carry_mask: bool [H, W], cells where the map shows something that may carry snow.
        narrow_mask: bool [H, W], things that stand high and hide nothing below them.
        pixel_mask: bool [H, W], cells that were rendered.
        path_xy: [P, 2], places of the cameras, world, metres.

    Returns:
        The map without these holes, and the filled cells, bool [H, W].
    """
    filled_mask = np.zeros(carry_mask.shape, bool)
    covered = height_map.covered
    empty_mask = pixel_mask & (~covered | height_map.is_thin | narrow_mask)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        empty_mask.astype(np.uint8), connectivity=4
    )
    cell_m2 = height_map.cell_m**2
    areas_m2 = stats[:, cv2.CC_STAT_AREA] * cell_m2
    holes = np.flatnonzero((areas_m2 >= MIN_HOLE_M2) & (areas_m2 <= MAX_PATH_HOLE_M2))
    holes = holes[holes > 0]
    if count <= 1 or len(holes) == 0:
        return height_map, filled_mask
    path_labels = labels[_near_path(height_map, path_xy)].astype(np.int64)
    on_path = np.bincount(path_labels, minlength=count) > 0
    overhung_m2 = np.bincount(labels[narrow_mask].astype(np.int64), minlength=count) * cell_m2
    holes = holes[overhung_m2[holes] <= MAX_OVERHUNG_M2]
    arrays = {name: getattr(height_map, name).copy() for name in ("height_m", "rgb", "alpha")}
    is_thin = height_map.is_thin.copy()
    for hole in holes[(areas_m2[holes] <= MAX_HOLE_M2) | on_path[holes]]:
        left, bottom, width, height = stats[hole, :4]
        window = (
            slice(max(0, bottom - _RIM_CELLS), bottom + height + _RIM_CELLS),
            slice(max(0, left - _RIM_CELLS), left + width + _RIM_CELLS),
        )
        hole_mask = labels[window] == hole
        kernel = np.ones((2 * _RIM_CELLS + 1, 2 * _RIM_CELLS + 1), np.uint8)
        rim_mask = (cv2.dilate(hole_mask.astype(np.uint8), kernel) > 0) & ~hole_mask
        if not on_path[hole] and bool((rim_mask & ~pixel_mask[window]).any()):
            continue  # the hole goes on where nothing was rendered
        known_mask = rim_mask & covered[window] & ~height_map.is_thin[window] & ~narrow_mask[window]
        plane, plane_mask = _fit_rim_plane(
            known_mask, carry_mask[window], height_map.height_m[window], height_map.cell_m
        )
        octants = _MIN_OCTANTS_ON_PATH if on_path[hole] else _MIN_OCTANTS
        if plane is None or not _is_surrounded(hole_mask, plane_mask, octants):
            continue
        rows, columns = np.nonzero(hole_mask)
        plane_m = plane[0] + plane[1] * columns + plane[2] * rows
        is_tall = height_map.is_thin[window][rows, columns]
        is_tall &= height_map.height_m[window][rows, columns] > plane_m + _MIN_CLEARANCE_M
        rows = rows[~is_tall]
        columns = columns[~is_tall]
        plane_m = plane_m[~is_tall]
        rim_rows, rim_columns = (
            indices[:: 1 + len(indices) // _MAX_RIM_SAMPLES] for indices in np.nonzero(plane_mask)
        )
        weights = np.hypot(rows[:, None] - rim_rows, columns[:, None] - rim_columns) ** -3.0
        weights /= weights.sum(1, keepdims=True)
        offsets = height_map.height_m[window][rim_rows, rim_columns]
        offsets = offsets - (plane[0] + plane[1] * rim_columns + plane[2] * rim_rows)
        arrays["height_m"][window][rows, columns] = plane_m + weights @ offsets
        arrays["rgb"][window][rows, columns] = (
            weights @ height_map.rgb[window][rim_rows, rim_columns]
        )
        arrays["alpha"][window][rows, columns] = 1
        is_thin[window][rows, columns] = False
        most_frequent = np.bincount(classes[window][plane_mask].astype(np.int64)).argmax()
        classes[window][rows, columns] = most_frequent
        filled_mask[window][rows, columns] = True
    return dataclasses.replace(height_map, **arrays, is_thin=is_thin), filled_mask


def _near_path(grid: HeightMap, path_xy: np.ndarray) -> np.ndarray:
    """Return the cells near the path's places, bool [H, W]."""
    rows, columns = grid.alpha.shape
    reach = max(1, round(_PATH_HALF_WIDTH_M / grid.cell_m))
    places = np.floor((path_xy - (grid.left_m, grid.bottom_m)) / grid.cell_m).astype(np.int64)
    path_mask = np.zeros((rows, columns), np.uint8)
    places = places[((places >= 0) & (places < (columns, rows))).all(1)]
    path_mask[places[:, 1], places[:, 0]] = 1
    return cv2.dilate(path_mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _fit_rim_plane(
    known_mask: np.ndarray, carry_mask: np.ndarray, height: np.ndarray, cell: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Fit a plane to most of the known cells around a hole.

    Returns:
        (height at the corner, rise per column, rise per row), or None where no plane fits; and the
        cells that lie in the plane, bool [H, W].
    """
    rows, columns = np.nonzero(known_mask)
    plane_mask = np.zeros_like(known_mask)
    if len(rows) < _MIN_RIM_CELLS:
        return None, plane_mask
    z = height[rows, columns].astype(np.float64)
    is_fitted = np.empty(len(z), bool)
    is_in_plane = np.empty(len(z), bool)
    slopes = surface_kernels.find_plane(
        rows,
        columns,
        z,
        _FIRST_TOLERANCE_M,
        _PLANE_TOLERANCE_M,
        _MIN_RIM_CELLS,
        is_fitted,
        is_in_plane,
    )
    is_in_plane &= carry_mask[rows, columns]
    if not (
        is_in_plane.mean() >= _MIN_PLANE_SHARE and math.hypot(*slopes) <= _MAX_PLANE_SLOPE * cell
    ):
        return None, plane_mask
    plane_mask[rows[is_in_plane], columns[is_in_plane]] = True
    terms = np.stack([np.ones(len(z)), columns, rows], 1)
    return np.linalg.lstsq(terms[is_fitted], z[is_fitted], rcond=None)[0], plane_mask


def _is_surrounded(hole_mask: np.ndarray, plane_mask: np.ndarray, min_octants: int) -> bool:
    """Tell if cells lie in enough of the eight directions from the middle of a hole."""
    middle = [indices.mean() for indices in np.nonzero(hole_mask)]
    rows, columns = np.nonzero(plane_mask)
    angles = np.arctan2(rows - middle[0], columns - middle[1])
    octants = np.floor((angles + math.pi) * (4 / math.pi)).astype(np.int64) % 8
    return len(np.unique(octants)) >= min_octants


# ---- Wheel tracks: where the ego and the scene's vehicles drive ----------------------------------

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


def has_invented_drive(scene: Scene) -> bool:
    """Return True if nobody drove where the scene's cameras are: a splat file without cameras."""
    return scene.seen_frames is not None and not scene.seen_frames


def find_wheel_paths(scene: Scene, *, has_invented_path: bool = False) -> tuple[WheelPath, ...]:
    """Find the paths of the ego and of the vehicles that move, each longer than what was recorded.

    Args:
        scene: its recorded frames give the path of the ego, also where a camera path replaces them.
        has_invented_path: if True, the ego of an invented drive has a path, too.
    """
    paths = []
    frames = scene.seen_frames or scene.frames
    if frames and (has_invented_path or not has_invented_drive(scene)):
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
        surface: surface that carries the tracks.
        classes: int16 [H, W], UNKNOWN everywhere if the scene has no classes.
    """
    grid = surface.map
    shape = surface.can_carry.shape
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
    return np.where(on_road & surface.can_carry, np.clip(strength, 0, 1), np.float32(0))


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


def _wheel_lines(path: WheelPath) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of the left and of the right wheels."""
    points = path.points_m
    directions = np.gradient(points[:, :2], axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    offsets = np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(points))], -1)
    offsets *= WHEEL_OFFSET_SHARE * path.width_m
    return points + offsets, points - offsets


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


# ---- Foliage of trees, bushes and hedges, through which snow falls -------------------------------

# Classes of things that are too narrow for snow, whatever a reconstruction makes of them.
BARE_CLASSES = (
    SemanticClass.POLE,
    SemanticClass.SIGN,
    SemanticClass.PEDESTRIAN,
    SemanticClass.TWO_WHEELER,
)
# Least height of foliage over the nearest ground; lower vegetation is grass, which snow covers.
MIN_FOLIAGE_HEIGHT_M = 0.6
_CLUMP_SIDE_M = 0.6  # side of the square within which the most frequent class counts
_GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)


def separate_foliage(surface: Surface, classes: np.ndarray) -> np.ndarray:
    """Separate foliage from low vegetation in the classes of a surface's cells, int16 [H, W].

    A cell is VEGETATION if most of its surroundings are vegetation and it stands over the nearest
    ground. Other vegetation becomes TERRAIN.
    """
    cell = surface.map.cell_m
    can_carry = surface.can_carry
    is_green = can_carry & (classes == SemanticClass.VEGETATION)
    if not is_green.any():
        return classes
    side = 2 * max(1, round(_CLUMP_SIDE_M / cell / 2)) + 1
    kernel = np.ones((side, side), np.uint8)
    # The opening removes specks of ground, which are noise in a crown.
    is_ground = can_carry & np.isin(classes, _GROUND_CLASSES)
    is_ground = cv2.morphologyEx(is_ground.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    is_high = can_carry
    if is_ground.any():
        _, labels = cv2.distanceTransformWithLabels(
            (~is_ground).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        nearest = np.array(labels, np.int64)
        heights = np.zeros(int(nearest.max()) + 1, np.float32)
        heights[nearest[is_ground]] = surface.height_m[is_ground]
        is_high = can_carry & (surface.height_m - heights[nearest] > MIN_FOLIAGE_HEIGHT_M)
    green_share, carry_share = (
        cv2.blur(mask.astype(np.float32), kernel.shape) for mask in (is_green, can_carry)
    )
    is_foliage = is_high & (green_share > 0.5 * carry_share) & (classes != SemanticClass.VEHICLE)
    classes_without_foliage = np.where(
        is_green & ~is_high, np.int16(SemanticClass.TERRAIN), classes
    )
    return np.where(is_foliage, np.int16(SemanticClass.VEGETATION), classes_without_foliage)


# ---- The exposed surface of a scene --------------------------------------------------------------

_MAX_SQUARE_CELLS = 1024  # cells on a side of the square that is rendered at once, about
_MARGIN_M = MAX_EDGE_DISTANCE_M + 0.2  # width of the margin that is rendered about a square
_MARGIN_CELLS = 4  # least width of that margin
_VISIBLE_MARGIN_CELLS = 2  # width by which the visible area grows
# Height below the lowest camera from which on a camera sees ground, not sky, behind a point.
_MIN_DROP_BELOW_CAMERAS_M = 0.5


@dataclass(frozen=True)
class ExposureSettings:
    """Settings that decide where a scene has exposed cells."""

    cell_m: float = 0.05  # side of the cells near the path; it doubles with the distance from it
    max_slope_deg: float = 50.0  # steeper surfaces carry no snow
    estimator: DepthEstimator = "mode"  # depth buffer that heights from above are taken from
    has_invented_tracks: bool = (
        False  # if True, the ego leaves wheel tracks on an invented drive, too
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ValueError(f"cell_m must be finite and > 0 (metres); got {self.cell_m}")
        if not 0 <= self.max_slope_deg < 90:
            raise ValueError(f"max_slope_deg must be 0 to below 90; got {self.max_slope_deg}")
        if self.estimator not in ("mode", "expected", "median"):
            raise ValueError(
                f"estimator must be 'mode', 'expected' or 'median'; got {self.estimator!r}"
            )


def find_exposed_surface(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: ExposureSettings = ExposureSettings(),
    *,
    backend: str = AUTO,
    progress: bool = False,
) -> ExposedSurface:
    """Find the cells of a scene that are open to the sky and that some of the cameras can see.

    The result is the same to the bit for any number of threads. It is empty without cameras, or
    where no open surface is visible.

    Args:
        scene: scene with metric scale and known gravity.
        cameras: cameras that must see the cells.
        settings: size of the cells, steepest slope and depth estimator.
        backend: "cuda" renders on the GPU; any other value renders on the CPU, since the torch
            definition would take hours.
        progress: if True, a progress bar is shown.

    Raises:
        SceneError: metres or gravity are not known, or the cells would take too much memory.
    """
    check_metric_and_level(scene)
    if backend != CUDA:
        backend = AUTO
    views = views_along(cameras)
    background = plain_gaussians(scene.background)
    plan = plan_tiles(views, settings.cell_m, _height_range(scene))
    plan.check_size()
    vehicles = [actor for actor in scene.actors if is_vehicle(actor)]
    squares = [
        (level, window)
        for level in range(int(plan.levels.max()) + 1)
        for window in plan.squares(level, _MAX_SQUARE_CELLS)
    ]
    if not squares:
        return ExposedSurface(_empty_cells(), {})
    parked_actors = tuple(_parked_actors(scene))
    steps = len(views) + len(squares) + len(vehicles)
    with (
        ProgressBar(total=steps, desc=PROGRESS_LABEL, disable=not progress, unit="step") as bar,
        counted_steps(PROGRESS_LABEL, steps) as advance,
    ):

        def after_each() -> None:
            bar.update()
            advance()

        visible_parts = [PosedGaussians(background), *parked_actors]
        visible_depths = draw_views(views, visible_parts, backend=backend, after_each=after_each)
        paths = find_wheel_paths(scene, has_invented_path=settings.has_invented_tracks)
        search = _GroundSearch(
            background,
            parked_actors,
            plan,
            views,
            visible_depths,
            paths,
            settings,
            shadows_of(scene),
            backend,
        )
        map_in_order = functools.partial(in_order, after_each=after_each, backend=backend)
        square_cells = map_in_order(search.find, squares)
        find_cells = functools.partial(
            find_actor_cells,
            cell_m=settings.cell_m,
            max_slope_deg=settings.max_slope_deg,
            estimator=settings.estimator,
            backend=backend,
        )
        on_vehicles = zip(vehicles, map_in_order(find_cells, vehicles), strict=True)
        actors = {actor.track_id: cells for actor, cells in on_vehicles if cells is not None}
    return ExposedSurface(search.join(square_cells), actors)


@dataclass(frozen=True, eq=False)
class _Square:
    """Square of one level, with its margin."""

    level: int
    window: Window  # margin included
    inner_mask: np.ndarray  # bool, cells in tiles of the level, without the margin
    level_mask: np.ndarray  # bool, cells in tiles of the level, margin included


@dataclass(frozen=True, eq=False)
class _SquareCells:
    """Cells of one square, at least one."""

    level: int
    columns: np.ndarray  # int64 [C], counted from the plan's origin
    rows: np.ndarray  # int64 [C], counted from the plan's origin
    cells: CellList


class _GroundSearch:
    """Search for the background's cells, square by square; several squares can run at once."""

    def __init__(
        self,
        background: Gaussians,
        parked: tuple[PosedGaussians, ...],
        plan: TilePlan,
        cameras: Sequence[Camera],
        views: Views,
        paths: tuple[WheelPath, ...],
        settings: ExposureSettings,
        shadows: CastShadows | None,
        backend: str,
    ) -> None:
        self._background = background
        self._parked_actors = parked
        self._plan = plan
        self._shadows = shadows
        self._views = views
        self._paths = paths
        self._settings = settings
        self._backend = backend
        self._classes = classes_of(background)
        self._footprints = Footprints(background)
        self._parked_top_m = top_of(parked)
        self._path = path_points(cameras)

    def find(self, level_and_window: tuple[int, Window]) -> _SquareCells | None:
        """Return the cells of one window of a level; None where it has none."""
        square = _with_margin(self._plan, *level_and_window)
        height_map, classes, carry_mask, filled_mask = self._draw(square)
        surface = find_surface(
            height_map,
            carry_mask,
            max_slope_deg=self._settings.max_slope_deg,
            on_vehicles=carry_mask & (classes == SemanticClass.VEHICLE),
        )
        classes = separate_foliage(surface, classes)
        visible_mask = self._visible_cells(surface, square, filled_mask)
        rows, columns = np.nonzero(surface.can_carry & visible_mask & square.inner_mask)
        if not len(rows):
            return None
        cells = cells_at(
            surface,
            rows,
            columns,
            sides=_side_codes(surface, visible_mask & square.level_mask),
            luminance=ground_luminance(height_map, classes, surface.can_carry),
            tracks=draw_tracks(self._paths, surface, classes),
            banks=find_banks(surface),
            classes=classes,
        )
        window = square.window
        return _SquareCells(square.level, columns + window.left, rows + window.bottom, cells)

    def join(self, square_cells: Sequence[_SquareCells | None]) -> ExposedCells:
        """Join the cells of all squares, and link them across squares."""
        squares = [part for part in square_cells if part is not None]
        if not squares:
            return _empty_cells()
        numbers = CellNumbers(self._plan)
        count = 0
        for part in squares:
            indices = count + np.arange(len(part.rows), dtype=np.int32)
            numbers.put(part.level, part.columns, part.rows, indices)
            count += len(part.rows)
        cells = CellList.joined([part.cells for part in squares])
        in_light = None
        if self._shadows is not None and self._shadows.certainty > 0:
            in_light = self._shadows.light_at(cells.centers_m.astype(np.float64))
        light = relative_light(cells.luminance, cells.semantic, in_light)
        return make_cells(cells, light, numbers.at, self._background)

    def _draw(self, square: _Square) -> tuple[HeightMap, np.ndarray, np.ndarray, np.ndarray]:
        """Render a square from above.

        Returns:
            The height map; classes, int16 [H, W]; cells that show the background and no thin thing,
            bool [H, W]; cells of closed holes, bool [H, W].
        """
        plan = self._plan
        window = square.window
        cell = plan.size_m(square.level)
        corner = (plan.origin_m[0] + window.left * cell, plan.origin_m[1] + window.bottom * cell)
        shape = (window.height, window.width)
        far_corner = (corner[0] + window.width * cell, corner[1] + window.height * cell)
        gaussians = self._background
        chosen_ids = None
        if self._backend != CUDA:  # on the GPU all Gaussians are resident already
            ids_in_box = self._footprints.in_box(np.array(corner), np.array(far_corner))
            if 2 * len(ids_in_box) < len(gaussians):  # otherwise the copy costs more than it saves
                gaussians = gaussians.select(torch.from_numpy(ids_in_box))
                chosen_ids = ids_in_box
        margin = _margin_cells(cell)
        kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
        pixel_mask = cv2.dilate(square.inner_mask.astype(np.uint8), kernel).astype(bool)
        height_map = draw_from_above(
            [PosedGaussians(gaussians), *self._parked_actors],
            corner_m=corner,
            cell_m=cell,
            shape=shape,
            estimator=self._settings.estimator,
            pixel_mask=pixel_mask,
            top_m=max(self._footprints.top_m(chosen_ids), self._parked_top_m),
            backend=self._backend,
        )
        is_ground = (height_map.ids >= 0) & (height_map.ids < len(gaussians))
        classes = np.full(shape, SemanticClass.UNKNOWN, np.int16)
        local_ids = height_map.ids[is_ground]
        classes[is_ground] = self._classes[
            local_ids if chosen_ids is None else chosen_ids[local_ids]
        ]
        carry_mask = is_ground & ~height_map.is_thin & ~np.isin(classes, BARE_CLASSES)
        narrow_mask = find_narrow_things(height_map, carry_mask)
        height_map, filled_mask = fill_holes(
            height_map, classes, carry_mask, narrow_mask, pixel_mask, self._path[:, :2]
        )
        return height_map, classes, carry_mask | filled_mask, filled_mask

    def _visible_cells(
        self, surface: Surface, square: _Square, filled_mask: np.ndarray
    ) -> np.ndarray:
        """Cells that can carry snow and that a camera sees, and their neighbours, bool [H, W].

        Args:
            surface: surface of the square.
            square: the square.
            filled_mask: bool [H, W], cells of closed holes, which no camera can show.
        """
        rows, columns = np.nonzero(surface.can_carry)
        x, y = surface.map.centers()
        points = np.stack([x[columns], y[rows], surface.height_m[rows, columns]], 1)
        normals = normals_from_slopes(surface.slopes[rows, columns])
        low = np.array([x[0], y[0]])
        high = np.array([x[-1], y[-1]])
        views = self._views.near(low, high, RING_DISTANCES_M[-1])
        visible_mask = np.zeros(surface.can_carry.shape, np.uint8)
        is_low = points[:, 2] < views.lowest_m - _MIN_DROP_BELOW_CAMERAS_M
        visible_mask[rows, columns] = views.see(
            points, normals, filled_mask[rows, columns] | is_low
        )
        side = 2 * _VISIBLE_MARGIN_CELLS + 1
        return cv2.dilate(visible_mask, np.ones((side, side), np.uint8)).astype(bool)


def _with_margin(plan: TilePlan, level: int, window: Window) -> _Square:
    """Return a window with its margin."""
    margin = _margin_cells(plan.size_m(level))
    left = window.left - margin
    bottom = window.bottom - margin
    both_margins = 2 * margin
    window_with_margin = Window(
        left, bottom, window.width + both_margins, window.height + both_margins
    )
    level_mask = plan.is_level(level, window_with_margin)
    inner_mask = np.zeros_like(level_mask)
    inner_mask[margin:-margin, margin:-margin] = level_mask[margin:-margin, margin:-margin]
    return _Square(level, window_with_margin, inner_mask, level_mask)


def _margin_cells(cell_m: float) -> int:
    """Return the width of a square's margin, cells."""
    return max(_MARGIN_CELLS, math.ceil(_MARGIN_M / cell_m))


def _side_codes(surface: Surface, has_cells: np.ndarray) -> np.ndarray:
    """Side codes as in ExposedCells.neighbours, with LINK where a cell follows, int8 [H, W, 4].

    The code is FLUSH where the same surface goes on without cells: no camera sees it there, or
    other cells cover it.
    """
    sides = np.where(surface.sides == RISES, np.int8(FLUSH), surface.sides)
    has_cell = np.pad(has_cells & surface.can_carry, 1)
    has_neighbour = np.stack(
        [has_cell[1:-1, :-2], has_cell[1:-1, 2:], has_cell[:-2, 1:-1], has_cell[2:, 1:-1]], -1
    )
    return np.where((sides == LINK) & ~has_neighbour, np.int8(FLUSH), sides)


def _parked_actors(scene: Scene) -> list[PosedGaussians]:
    """Actors that stand still, at their pose halfway through the track.

    The background's snow lies beside them.
    """
    return [
        PosedGaussians(
            plain_gaussians(actor.gaussians),
            actor.track.world_from_actor[len(actor.track.world_from_actor) // 2],
            number,
        )
        for number, actor in enumerate(scene.actors, start=1)
        if actor.label != EGO_VEHICLE and not is_moving(actor) and len(actor.gaussians)
    ]


def _height_range(scene: Scene) -> tuple[float, float]:
    """Return the lowest and the highest z of the background's Gaussians."""
    z = scene.background.means[:, 2]
    return (float(z.min()), float(z.max())) if len(z) else (0.0, 0.0)


def _empty_cells() -> ExposedCells:
    """Return a record without cells."""
    numbers = CellNumbers(plan_tiles([], 1.0, (0.0, 0.0)))
    return make_cells(CellList.empty(), np.zeros(0, np.float32), numbers.at, Gaussians.empty())
