"""Where snow can lie in a scene: cells of the surfaces that are open to the sky and seen.

Square tiles are planned about the cameras' path, finer near it, and the depth that some cameras
along the drive see is drawn. Squares of tiles, each with a margin, are then worked on one by one:
drawn from above, holes closed, surfaces told apart, cells found that a camera sees, their light,
wheel tracks and banks. Vehicles are in their own frames. In the end neighbours are joined across
squares, and the Gaussians found that the cells bury.
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

from augment.cameras import Camera
from augment.cast_shadows import CastShadows, shadows_of
from augment.effects.snow import surface_kernels
from augment.effects.snow.cells import EDGE_CAP_M, FLUSH, SnowCells, SnowSupport
from augment.effects.snow.height_map import (
    Estimator,
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
from augment.effects.snow.surface import (
    CellList,
    Surface,
    banks_of,
    cells_at,
    find_actor_cells,
    find_surface,
    is_vehicle,
    make_cells,
    moves,
    narrow_things,
    normals_of,
)
from augment.effects.snow.surface_kernels import LINK, RISES
from augment.errors import SceneError
from augment.ground import check_metric_and_level
from augment.labels import EGO_VEHICLE
from augment.progress import ProgressBar
from augment.render.buffers import AUTO, CUDA
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.timing import counted

# ---- Which squares of the world a support covers, how fine each is, and where its cells are kept -

# Cells double in size at each of these level distances from the cameras' path, metres; beyond the
# last there are none.
RINGS_M = (8.0, 32.0, 48.0, 80.0, 120.0)
COARSEST_M = 1.0  # cells double up to about this size; a coarser cell_m does not double at all
BYTES_PER_CELL = 70  # of a support
MAX_BYTES = 4 << 30
PLACING = "placing snow"  # what bars and watchers are told
_SIDE_M = 3.2  # of a tile, about
_PATH_STEP_M = 1.0  # camera centres closer than this are one place of the path
_PATH_GAP_M = 25.0  # those farther apart are not joined
_MAX_TILES = 30_000_000  # of the rectangle about the path


class Window(NamedTuple):
    """A rectangle of one level's cells. left, bottom: numbers of its first column and row, counted
    from the plan's origin, + to +x and +y. width, height: cells.
    """

    left: int
    bottom: int
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class TilePlan:
    """Tiles: squares of side_m, row by row from origin_m (x, y; the world's), towards +y.

    levels: int8 [Y, X], -1 where a tile is left out; cells of level k have sides of cell_m 2^k.
    """

    origin_m: tuple[float, float]
    side_m: float
    cell_m: float
    levels: np.ndarray

    def size_m(self, level: int) -> float:
        """Side of a level's cells."""
        return self.cell_m * 2**level

    def cells_per_side(self, level: int) -> int:
        """Cells along a tile's side."""
        return round(self.side_m / self.size_m(level))

    @property
    def cells(self) -> int:
        """Cells of all tiles; a support holds those of them that are open ground."""
        counts = np.bincount(self.levels[self.levels >= 0].astype(np.int64))
        return sum(int(n) * self.cells_per_side(k) ** 2 for k, n in enumerate(counts))

    def check_size(self) -> None:
        """Raises SceneError where a support of these tiles would take more than MAX_BYTES."""
        if self.cells * BYTES_PER_CELL <= MAX_BYTES:
            return
        fits = self.cell_m * math.sqrt(self.cells * BYTES_PER_CELL / MAX_BYTES)
        raise SceneError(
            f"snow in cells of {self.cell_m:g} m would take {self.cells / 1e6:,.0f} million cells "
            f"along this path, about {self.cells * BYTES_PER_CELL / 1e9:,.1f} GB; at most "
            f"{MAX_BYTES / 1e9:.1f} GB are used. Take cells of {_round_up(fits):g} m or more "
            f"(weather.snow.cell_m), or fewer frames"
        )

    def squares(self, level: int, most_cells: int) -> Iterator[Window]:
        """The level's cells in squares of whole tiles, each with one of the level's tiles at least.

        most_cells: on a side, unless one tile has more.
        """
        tiles = self.levels == level
        n = self.cells_per_side(level)
        step = max(1, most_cells // n)
        for row in range(0, tiles.shape[0], step):
            for column in range(0, tiles.shape[1], step):
                part = tiles[row : row + step, column : column + step]
                if part.any():
                    rows, columns = np.flatnonzero(part.any(1)), np.flatnonzero(part.any(0))
                    yield Window(
                        (column + int(columns[0])) * n,
                        (row + int(rows[0])) * n,
                        int(columns[-1] - columns[0] + 1) * n,
                        int(rows[-1] - rows[0] + 1) * n,
                    )

    def is_level(self, level: int, window: Window) -> np.ndarray:
        """bool [height, width]: cells of the window that lie in the level's tiles."""
        n = self.cells_per_side(level)
        rows = (window.bottom + np.arange(window.height)) // n
        columns = (window.left + np.arange(window.width)) // n
        inside = (rows >= 0) & (rows < self.levels.shape[0])
        across = (columns >= 0) & (columns < self.levels.shape[1])
        out = np.zeros((window.height, window.width), bool)
        found = self.levels[np.ix_(rows[inside], columns[across])] == level
        out[np.ix_(inside, across)] = found
        return out


class CellNumbers:
    """Where each cell of a plan stands in a support; -1 where that has none."""

    def __init__(self, plan: TilePlan) -> None:
        self._plan = plan
        levels = plan.levels.ravel()
        sides = np.array([plan.cells_per_side(k) for k in range(max(1, levels.max(initial=0) + 1))])
        self._sides = np.where(levels >= 0, sides[np.maximum(levels, 0)], 0).astype(np.int64)
        ends = np.cumsum(self._sides**2)
        self._starts = ends - self._sides**2
        self._numbers = np.full(int(ends[-1]) if len(ends) else 0, -1, np.int32)

    def put(self, level: int, columns: np.ndarray, rows: np.ndarray, numbers: np.ndarray) -> None:
        """Set the numbers of a level's cells; columns, rows: int64 [C], counted from the origin."""
        n = self._plan.cells_per_side(level)
        tiles = (rows // n) * self._plan.levels.shape[1] + columns // n
        self._numbers[self._starts[tiles] + (rows % n) * n + columns % n] = numbers

    def at(self, xy: np.ndarray) -> np.ndarray:
        """int32 [P]: numbers of the cells under points float64 [P, 2], -1 where there is none."""
        out = np.empty(len(xy), np.int32)
        surface_kernels.find_numbers(
            *(np.ascontiguousarray(xy, np.float64), self._plan.origin_m, self._plan.side_m),
            *(self._plan.levels.shape[0], self._plan.levels.shape[1]),
            *(self._sides, self._starts, self._numbers, out),
        )
        return out


def plan_tiles(
    cameras: Sequence[Camera], cell_m: float, heights_m: tuple[float, float]
) -> TilePlan:
    """The tiles about the cameras' path that may be seen by one of them.

    cameras: those of `views_along` do. heights_m: lowest and highest z that anything can have.

    Raises:
        SceneError: the cameras are so far apart that their tiles cannot be listed.
    """
    coarsest = max(0, min(len(RINGS_M) - 1, math.floor(math.log2(COARSEST_M / cell_m))))
    unit = cell_m * 2**coarsest
    side = unit * max(1 if unit > _SIDE_M else 2, math.ceil(_SIDE_M / unit))
    if not cameras:
        return TilePlan((0.0, 0.0), side, cell_m, np.full((1, 1), -1, np.int8))
    path = path_points(cameras)[:, :2]
    first = np.floor((path.min(0) - RINGS_M[-1]) / side).astype(np.int64)
    size = np.floor((path.max(0) + RINGS_M[-1]) / side).astype(np.int64) + 1 - first
    if float(size[0]) * float(size[1]) > _MAX_TILES:
        extent = path.max(0) - path.min(0)
        raise SceneError(
            f"the cameras' path covers {extent[0] / 1e3:,.1f} km x {extent[1] / 1e3:,.1f} km, more "
            f"than snow can be placed along at once; take fewer frames"
        )
    origin = first * side
    distance = _distance_to_path(path, origin, side, (int(size[1]), int(size[0])))
    rings = np.minimum(np.searchsorted(np.array(RINGS_M), distance, side="right"), len(RINGS_M))
    levels = np.where(rings < len(RINGS_M), np.minimum(rings, coarsest), -1).astype(np.int8)
    seen = np.zeros(levels.shape, bool)
    for camera in cameras:
        _mark_frustum(camera, origin, side, heights_m, seen)
    levels[~seen] = -1
    return TilePlan((float(origin[0]), float(origin[1])), side, cell_m, levels)


def views_along(cameras: Sequence[Camera], step_m: float = 2.0) -> list[Camera]:
    """Cameras spread along the drive: of each name the first, the last, and those between that have
    moved by step_m or turned by 10 degrees since the one taken before.
    """
    taken = []
    for group in _by_name(cameras):
        last = group[0]
        for place, camera in enumerate(group):
            if place in (0, len(group) - 1) or _has_moved(last, camera, step_m):
                taken.append(camera)
                last = camera
    return taken


def path_points(cameras: Sequence[Camera]) -> np.ndarray:
    """float64 [P, 3]: the centres of cameras of one name after another, joined in order of time."""
    points = []
    for group in _by_name(cameras):
        centres = np.stack([camera.centre.numpy() for camera in group])
        points.append(centres)
        for a, b in itertools.pairwise(centres):
            gap = float(np.linalg.norm(b - a))
            if _PATH_STEP_M < gap <= _PATH_GAP_M:
                shares = np.arange(1, math.ceil(gap / _PATH_STEP_M)) * (_PATH_STEP_M / gap)
                points.append(a + shares[:, None] * (b - a))
    joined = np.concatenate(points)
    _, first = np.unique(np.round(joined / (0.5 * _PATH_STEP_M)), axis=0, return_index=True)
    return joined[np.sort(first)]


def _by_name(cameras: Sequence[Camera]) -> Iterable[list[Camera]]:
    """The cameras of each name in order of time."""
    named: dict[str, list[Camera]] = {}
    for camera in sorted(cameras, key=lambda camera: camera.timestamp_ns):
        named.setdefault(camera.name, []).append(camera)
    return (named[name] for name in dict.fromkeys(camera.name for camera in cameras))


def _has_moved(before: Camera, camera: Camera, step_m: float) -> bool:
    gap = float((camera.centre - before.centre).norm())
    turn = float((camera.camera_from_world[2, :3] * before.camera_from_world[2, :3]).sum())
    return gap >= step_m or turn < math.cos(math.radians(10))


def _distance_to_path(
    path: np.ndarray, origin: np.ndarray, side: float, shape: tuple[int, int]
) -> np.ndarray:
    """[Y, X]: level distance from each tile's nearest point to the path, up to the last ring."""
    out = np.full(shape, np.inf)
    reach = math.ceil(RINGS_M[-1] / side) + 1
    for x, y in path - origin:
        rows, columns = _around(y, reach, side, shape[0]), _around(x, reach, side, shape[1])
        dy = np.maximum(np.abs((rows + 0.5) * side - y) - side / 2, 0)
        dx = np.maximum(np.abs((columns + 0.5) * side - x) - side / 2, 0)
        window = out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        np.minimum(window, np.hypot(dy[:, None], dx), out=window)
    return out


def _around(place: float, reach: int, side: float, count: int) -> np.ndarray:
    middle = int(place // side)
    return np.arange(max(0, middle - reach), min(count, middle + reach + 1))


def _mark_frustum(
    camera: Camera,
    origin: np.ndarray,
    side: float,
    heights_m: tuple[float, float],
    seen: np.ndarray,
) -> None:
    """Mark tiles whose column between the two heights is not wholly outside one of the image's
    borders. Columns are taken 2 m wider all round: the cameras between are not asked.
    """
    wider = 2.0
    pose = camera.world_from_camera.numpy()
    centre, axes = pose[:3, 3], pose[:3, :3]
    reach = math.ceil(RINGS_M[-1] / side) + 1
    rows = _around(centre[1] - origin[1], reach, side, seen.shape[0])
    columns = _around(centre[0] - origin[0], reach, side, seen.shape[1])
    window = seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    x = origin[0] + (columns + 0.5) * side - centre[0]
    y = (origin[1] + (rows + 0.5) * side - centre[1])[:, None]
    low, high = heights_m[0] - wider - centre[2], heights_m[1] + wider - centre[2]
    inside = np.ones(window.shape, bool)
    for normal, offset in _image_borders(camera):
        across = axes @ normal
        reach_xy = (side / 2 + wider) * (abs(across[0]) + abs(across[1]))
        reach_z = max(across[2] * low, across[2] * high)
        inside &= across[0] * x + across[1] * y + (reach_xy + reach_z) >= offset
    window |= inside


def _image_borders(camera: Camera) -> list[tuple[np.ndarray, float]]:
    """Planes n . p >= offset, camera coordinates, between which the image lies."""
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
    """To two digits, not below the value."""
    digit = 10 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / digit) * digit, 12)


# ---- How bright the bare ground is for what it is made of: shadows that the recording holds ------

DARKEST, BRIGHTEST = 0.25, 1.5
_SPREAD_M = 0.2  # standard deviation of the blur: shadows have soft edges, gravel is not one
_PAINT_M = 0.1  # so far beyond its own splats a marking may show
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # linear sRGB
_SHARP_CELLS = 0.3  # a narrower blur leaves cells as they are
_MIN_WEIGHT = 0.02
_LIT = 0.8  # share of the light that is left where the sun shines
_MIN_CLASS_CELLS = 50  # cells of a class, for its median to mean anything
# What differs in colour as much as in light: their brightness says half as much.
_MOTLEY = (SemanticClass.UNKNOWN, SemanticClass.VEGETATION, SemanticClass.OTHER)
_MARKING, _ROAD = int(SemanticClass.LANE_MARKING), int(SemanticClass.ROAD)


def ground_luminance(
    height_map: HeightMap, classes: np.ndarray, can_carry: np.ndarray
) -> np.ndarray:
    """Blurred linear luminance float32 [H, W] of what carries snow, NaN where it cannot be told.

    classes: int16 [H, W]. Each class is blurred by itself; under lane markings, the road about them
    shows how bright it is.
    """
    rgb = np.clip(height_map.rgb[can_carry], 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** np.float32(2.4))
    luminance = np.zeros(can_carry.shape, np.float32)
    luminance[can_carry] = (linear.astype(np.float32) * _LUMINANCE).sum(-1)
    out = np.full(luminance.shape, np.nan, np.float32)
    marking = classes == _MARKING
    around = 2 * max(1, round(_PAINT_M / height_map.cell_m)) + 1
    painted = cv2.dilate(marking.astype(np.uint8), np.ones((around, around), np.uint8)).astype(bool)
    surfaces = np.where(marking, np.int16(_ROAD), classes)
    sigma = _SPREAD_M / height_map.cell_m
    for surface in np.unique(surfaces[can_carry]):
        here = can_carry & (surfaces == surface)
        told = here & ~painted
        weights = told.astype(np.float32)
        sums = luminance * weights
        for spread in (sigma, 4 * sigma):
            missing = here & np.isnan(out)
            if not missing.any():
                break
            weight, total = _blur(weights, spread), _blur(sums, spread)
            known = missing & (weight > _MIN_WEIGHT)
            out[known] = total[known] / weight[known]
    return out


def relative_light(
    luminance: np.ndarray, classes: np.ndarray, in_light: np.ndarray | None = None
) -> np.ndarray:
    """float32 [C]: luminance [C] over the median of its class, see SnowCells.light; 1 where it is
    NaN. in_light: [C], what share of the light cast shadows leave, NaN where unknown; then medians
    are of cells in the sun, and motley classes take it.
    """
    out = np.ones(len(luminance), np.float32)
    surfaces = np.where(classes == _MARKING, np.int16(_ROAD), classes)
    known = np.isfinite(luminance)
    if in_light is None:
        in_light = np.full(len(luminance), np.nan)
    for surface in np.unique(surfaces):
        here = known & (surfaces == surface)
        told = here & (in_light > _LIT)
        told = told if told.sum() >= _MIN_CLASS_CELLS else here
        usual = float(np.median(luminance[told])) if told.sum() >= _MIN_CLASS_CELLS else 0.0
        if usual <= 1e-4:
            continue
        ratio = luminance[here] / np.float32(usual)
        if surface in _MOTLEY:
            by_shadows = in_light[here]
            ratio = np.where(np.isfinite(by_shadows), by_shadows, np.sqrt(np.maximum(ratio, 0)))
        out[here] = ratio
    return np.clip(out, DARKEST, BRIGHTEST)


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    if sigma < _SHARP_CELLS:
        return values
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)


# ---- Holes in the ground, closed where it is plain what is there ---------------------------------
# A car's lidar does not see the ground beneath the car, and a fit of a drive that begins or ends
# with the car standing still has no Gaussians there. What lies around such a hole tells its height.

MIN_M2, MAX_M2 = 0.1, 7.0  # what is smaller is left to `surface`
MAX_OVER_M2 = 0.6  # of that, under narrow things: lamps, not eaves
MAX_ON_PATH_M2 = 80.0  # where the path of the cameras leads over it
_PATH_M = 1.0  # on both sides of it
_RIM_CELLS = 3
_ALIKE_M, _FIRST_M = 0.12, 0.5  # off the plane of what lies around; and off its middle, at first
_MIN_CELLS = 8
_MIN_ALIKE, _OCTANTS, _OCTANTS_ON_PATH = 0.6, 7, 5
_STEEPEST = math.tan(math.radians(20))
_MAX_SAMPLES = 160  # of a rim that heights are taken from
_CLEAR_M = 0.3  # over the plane, of thin things that stand in a hole


def fill_holes(
    height_map: HeightMap,
    classes: np.ndarray,
    lies: np.ndarray,
    narrow: np.ndarray,
    pixel_mask: np.ndarray,
    path_xy: np.ndarray,
) -> tuple[HeightMap, np.ndarray]:
    """The map with the holes closed that one smooth surface surrounds, and where, bool [H, W].

    classes: int16 [H, W], which get those of what is around. lies: bool, where the map shows
    something that may carry snow. narrow: bool, what stands high and hides nothing below it.
    pixel_mask: bool, what was drawn. path_xy [P, 2]: places of the cameras.
    """
    filled = np.zeros(lies.shape, bool)
    covered = height_map.covered
    empty = pixel_mask & (~covered | height_map.is_thin | narrow)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        empty.astype(np.uint8), connectivity=4
    )
    cell_m2 = height_map.cell_m**2
    sizes = stats[:, cv2.CC_STAT_AREA] * cell_m2
    possible = np.flatnonzero((sizes >= MIN_M2) & (sizes <= MAX_ON_PATH_M2))
    possible = possible[possible > 0]
    if count <= 1 or len(possible) == 0:
        return height_map, filled
    near = labels[_near_path(height_map, path_xy)].astype(np.int64)
    on_path = np.bincount(near, minlength=count) > 0
    over = np.bincount(labels[narrow].astype(np.int64), minlength=count) * cell_m2
    possible = possible[over[possible] <= MAX_OVER_M2]
    new = {name: getattr(height_map, name).copy() for name in ("height_m", "rgb", "alpha")}
    is_thin = height_map.is_thin.copy()
    for hole in possible[(sizes[possible] <= MAX_M2) | on_path[possible]]:
        left, bottom, width, height = stats[hole, :4]
        window = (
            slice(max(0, bottom - _RIM_CELLS), bottom + height + _RIM_CELLS),
            slice(max(0, left - _RIM_CELLS), left + width + _RIM_CELLS),
        )
        inside = labels[window] == hole
        around = np.ones((2 * _RIM_CELLS + 1, 2 * _RIM_CELLS + 1), np.uint8)
        rim = (cv2.dilate(inside.astype(np.uint8), around) > 0) & ~inside
        if not on_path[hole] and bool((rim & ~pixel_mask[window]).any()):
            continue  # it goes on where nothing was drawn
        known = rim & covered[window] & ~height_map.is_thin[window] & ~narrow[window]
        plane, alike = _plane_around(
            known, lies[window], height_map.height_m[window], height_map.cell_m
        )
        octants = _OCTANTS_ON_PATH if on_path[hole] else _OCTANTS
        if plane is None or not _surrounds(inside, alike, octants):
            continue
        rows, columns = np.nonzero(inside)
        level = plane[0] + plane[1] * columns + plane[2] * rows
        tall = height_map.is_thin[window][rows, columns]
        tall &= height_map.height_m[window][rows, columns] > level + _CLEAR_M
        rows, columns, level = rows[~tall], columns[~tall], level[~tall]
        at_row, at_column = (part[:: 1 + len(part) // _MAX_SAMPLES] for part in np.nonzero(alike))
        weights = np.hypot(rows[:, None] - at_row, columns[:, None] - at_column) ** -3.0
        weights /= weights.sum(1, keepdims=True)
        off = height_map.height_m[window][at_row, at_column]
        off = off - (plane[0] + plane[1] * at_column + plane[2] * at_row)
        new["height_m"][window][rows, columns] = level + weights @ off
        new["rgb"][window][rows, columns] = weights @ height_map.rgb[window][at_row, at_column]
        new["alpha"][window][rows, columns] = 1
        is_thin[window][rows, columns] = False
        usual = np.bincount(classes[window][alike].astype(np.int64)).argmax()
        classes[window][rows, columns] = usual
        filled[window][rows, columns] = True
    return dataclasses.replace(height_map, **new, is_thin=is_thin), filled


def _near_path(grid: HeightMap, path_xy: np.ndarray) -> np.ndarray:
    """bool [H, W]: cells near the path's places."""
    rows, columns = grid.alpha.shape
    reach = max(1, round(_PATH_M / grid.cell_m))
    place = np.floor((path_xy - (grid.left_m, grid.bottom_m)) / grid.cell_m).astype(np.int64)
    near = np.zeros((rows, columns), np.uint8)
    place = place[((place >= 0) & (place < (columns, rows))).all(1)]
    near[place[:, 1], place[:, 0]] = 1
    return cv2.dilate(near, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _plane_around(
    known: np.ndarray, lies: np.ndarray, height: np.ndarray, cell: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Height at the corner, and rises per column and row, of the plane of most known cells; None
    where there is none. bool [H, W]: the cells that lie in it.
    """
    rows, columns = np.nonzero(known)
    alike = np.zeros_like(known)
    if len(rows) < _MIN_CELLS:
        return None, alike
    z = height[rows, columns].astype(np.float64)
    used, fits = np.empty(len(z), bool), np.empty(len(z), bool)
    slopes = surface_kernels.find_plane(
        rows, columns, z, _FIRST_M, _ALIKE_M, _MIN_CELLS, used, fits
    )
    fits &= lies[rows, columns]
    if not (fits.mean() >= _MIN_ALIKE and math.hypot(*slopes) <= _STEEPEST * cell):
        return None, alike
    alike[rows[fits], columns[fits]] = True
    terms = np.stack([np.ones(len(z)), columns, rows], 1)
    return np.linalg.lstsq(terms[used], z[used], rcond=None)[0], alike


def _surrounds(inside: np.ndarray, alike: np.ndarray, min_cells: int) -> bool:
    """Whether cells lie in enough of the eight directions from the middle of a hole."""
    middle = [part.mean() for part in np.nonzero(inside)]
    rows, columns = np.nonzero(alike)
    angles = np.arctan2(rows - middle[0], columns - middle[1])
    octants = np.floor((angles + math.pi) * (4 / math.pi)).astype(np.int64) % 8
    return len(np.unique(octants)) >= min_cells


# ---- Wheel tracks: where the ego and the scene's vehicles drive ----------------------------------

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


def has_invented_drive(scene: Scene) -> bool:
    """Return whether nobody drove where the scene's cameras are: a splat file without cameras."""
    return scene.seen_frames is not None and not scene.seen_frames


def wheel_paths(scene: Scene, *, with_invented: bool = False) -> tuple[WheelPath, ...]:
    """Paths of the ego and of the vehicles that move, each longer than what was recorded.

    Args:
        scene: its recorded frames say where the ego drove, also where a camera path replaces them.
        with_invented: if True, the ego of an invented drive has a path, too.
    """
    paths = []
    frames = scene.seen_frames or scene.frames
    if frames and (with_invented or not has_invented_drive(scene)):
        poses = np.stack([frame.world_from_ego.numpy() for frame in frames])
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


# ---- Foliage: of trees, bushes and hedges, through which snow falls ------------------------------

# Too narrow for snow, whatever a reconstruction makes of them.
BARE_CLASSES = (
    SemanticClass.POLE,
    SemanticClass.SIGN,
    SemanticClass.PEDESTRIAN,
    SemanticClass.TWO_WHEELER,
)
FOLIAGE_M = 0.6  # over the nearest ground: what is lower is grass, which snow closes over
_CLUMP_M = 0.6  # within which the most frequent class counts
_GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)


def foliage_apart(surface: Surface, classes: np.ndarray) -> np.ndarray:
    """The classes [H, W] of a surface's cells, with VEGETATION where most of what is about them is
    vegetation and stands over the ground nearest to it, and TERRAIN for other vegetation.
    """
    cell, can_carry = surface.map.cell_m, surface.can_carry
    green = can_carry & (classes == SemanticClass.VEGETATION)
    if not green.any():
        return classes
    side = 2 * max(1, round(_CLUMP_M / cell / 2)) + 1
    around = np.ones((side, side), np.uint8)
    ground = can_carry & np.isin(classes, _GROUND_CLASSES)  # in specks it is a crown's own noise
    ground = cv2.morphologyEx(ground.astype(np.uint8), cv2.MORPH_OPEN, around) > 0
    is_high = can_carry
    if ground.any():
        _, labels = cv2.distanceTransformWithLabels(
            (~ground).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        nearest = np.array(labels, np.int64)
        heights = np.zeros(int(nearest.max()) + 1, np.float32)
        heights[nearest[ground]] = surface.height_m[ground]
        is_high = can_carry & (surface.height_m - heights[nearest] > FOLIAGE_M)
    share, of = (cv2.blur(part.astype(np.float32), around.shape) for part in (green, can_carry))
    foliage = is_high & (share > 0.5 * of) & (classes != SemanticClass.VEHICLE)
    rest = np.where(green & ~is_high, np.int16(SemanticClass.TERRAIN), classes)
    return np.where(foliage, np.int16(SemanticClass.VEGETATION), rest)


# ---- The support of a scene ----------------------------------------------------------------------

_SQUARE_CELLS = 1024  # on a side of what is drawn at once, about
_MARGIN_M, _MARGIN_CELLS = EDGE_CAP_M + 0.2, 4  # drawn about it
_SEEN_GROWS_CELLS = 2
_SURELY_BELOW_M = 0.5  # the cameras: there is ground behind what lies there, not sky


@dataclass(frozen=True)
class PlacementSettings:
    """How a support is found. cell_m: side of the cells near the path, metres; they double with the
    distance from it. max_slope_deg: nothing steeper carries snow. estimator: the depth buffer that
    heights from above are taken from. invented_tracks: if True, the ego leaves wheel tracks on an
    invented drive, too.
    """

    cell_m: float = 0.05
    max_slope_deg: float = 50.0
    estimator: Estimator = "mode"
    invented_tracks: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ValueError(f"cell_m must be finite and > 0 (metres); got {self.cell_m}")
        if not 0 <= self.max_slope_deg < 90:
            raise ValueError(f"max_slope_deg must be 0 to below 90; got {self.max_slope_deg}")
        if self.estimator not in ("mode", "expected", "median"):
            raise ValueError(
                f"estimator must be 'mode', 'expected' or 'median'; got {self.estimator!r}"
            )


def place_snow_support(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: PlacementSettings = PlacementSettings(),
    *,
    backend: str = AUTO,
    progress: bool = False,
) -> SnowSupport:
    """The cells of a scene that snow can lie on and that some of the cameras can see; the same bits
    from any number of threads. Empty without cameras, or where nothing open is seen.

    backend: "cuda" draws and looks on the GPU; any other on the CPU, since the torch definition
    would take hours. progress: shows a bar.

    Raises:
        SceneError: metres or gravity are not known, or the cells would take too much memory.
    """
    check_metric_and_level(scene)
    if backend != CUDA:
        backend = AUTO
    views = views_along(cameras)
    background = plain_gaussians(scene.background)
    plan = plan_tiles(views, settings.cell_m, _heights(scene))
    plan.check_size()
    vehicles = [actor for actor in scene.actors if is_vehicle(actor)]
    squares = [
        (level, window)
        for level in range(int(plan.levels.max()) + 1)
        for window in plan.squares(level, _SQUARE_CELLS)
    ]
    if not squares:
        return SnowSupport(_no_cells(), {})
    parked = tuple(_parked(scene))
    steps = len(views) + len(squares) + len(vehicles)
    with (
        ProgressBar(total=steps, desc=PLACING, disable=not progress, unit="step") as bar,
        counted(PLACING, steps) as advance,
    ):

        def after_each() -> None:
            bar.update()
            advance()

        parts = [PosedGaussians(background), *parked]
        seen_from = draw_views(views, parts, backend=backend, after_each=after_each)
        paths = wheel_paths(scene, with_invented=settings.invented_tracks)
        work = _Ground(
            *(background, parked, plan, views, seen_from, paths, settings),
            *(shadows_of(scene), backend),
        )
        in_turn = functools.partial(in_order, after_each=after_each, backend=backend)
        found = in_turn(work.find, squares)
        find = functools.partial(
            find_actor_cells,
            cell_m=settings.cell_m,
            max_slope_deg=settings.max_slope_deg,
            estimator=settings.estimator,
            backend=backend,
        )
        on_vehicles = zip(vehicles, in_turn(find, vehicles), strict=True)
        actors = {actor.track_id: cells for actor, cells in on_vehicles if cells is not None}
    return SnowSupport(work.joined(found), actors)


@dataclass(frozen=True, eq=False)
class _Square:
    """A level's window with its margin. window: with it. inner: bool, cells of the window itself in
    tiles of the level. own: bool, cells of the level's tiles, margin included.
    """

    level: int
    window: Window
    inner: np.ndarray
    own: np.ndarray


@dataclass(frozen=True, eq=False)
class _Found:
    """Cells of a level's window, at least one. columns, rows: int64 [C], counted from the plan's
    origin.
    """

    level: int
    columns: np.ndarray
    rows: np.ndarray
    cells: CellList


class _Ground:
    """Finds the background's cells, square by square: several at once, as each is by itself."""

    def __init__(
        self,
        background: Gaussians,
        parked: tuple[PosedGaussians, ...],
        plan: TilePlan,
        cameras: Sequence[Camera],
        views: Views,
        paths: tuple[WheelPath, ...],
        settings: PlacementSettings,
        shadows: CastShadows | None,
        backend: str,
    ) -> None:
        self._background, self._parked, self._plan = background, parked, plan
        self._shadows = shadows
        self._views, self._paths, self._settings = views, paths, settings
        self._backend = backend
        self._classes = classes_of(background)
        self._footprints, self._parked_top_m = Footprints(background), top_of(parked)
        self._path = path_points(cameras)

    def find(self, level_and_window: tuple[int, Window]) -> _Found | None:
        """The cells of one window of a level; None where it has none."""
        square = _with_margin(self._plan, *level_and_window)
        view, classes, lies, filled = self._draw(square)
        surface = find_surface(
            view,
            lies,
            max_slope_deg=self._settings.max_slope_deg,
            on_vehicles=lies & (classes == SemanticClass.VEHICLE),
        )
        classes = foliage_apart(surface, classes)
        seen = self._seen(surface, square, filled)
        rows, columns = np.nonzero(surface.can_carry & seen & square.inner)
        if not len(rows):
            return None
        cells = cells_at(
            surface,
            rows,
            columns,
            sides=_sides(surface, seen & square.own),
            luminance=ground_luminance(view, classes, surface.can_carry),
            tracks=draw_tracks(self._paths, surface, classes),
            banks=banks_of(surface),
            classes=classes,
        )
        window = square.window
        return _Found(square.level, columns + window.left, rows + window.bottom, cells)

    def joined(self, found: Sequence[_Found | None]) -> SnowCells:
        """All those cells, one square's after another's, linked across squares."""
        squares = [square for square in found if square is not None]
        if not squares:
            return _no_cells()
        numbers, count = CellNumbers(self._plan), 0
        for square in squares:
            to = count + np.arange(len(square.rows), dtype=np.int32)
            numbers.put(square.level, square.columns, square.rows, to)
            count += len(square.rows)
        cells = CellList.joined([square.cells for square in squares])
        in_light = None
        if self._shadows is not None and self._shadows.certainty > 0:
            in_light = self._shadows.light_at(cells.centers_m.astype(np.float64))
        light = relative_light(cells.luminance, cells.semantic, in_light)
        return make_cells(cells, light, numbers.at, self._background)

    def _draw(self, square: _Square) -> tuple[HeightMap, np.ndarray, np.ndarray, np.ndarray]:
        """The square from above, its classes, where what is seen is of the background and no
        wall on edge, and where it closes a hole.
        """
        plan, window = self._plan, square.window
        cell = plan.size_m(square.level)
        corner = (plan.origin_m[0] + window.left * cell, plan.origin_m[1] + window.bottom * cell)
        shape = (window.height, window.width)
        far = (corner[0] + window.width * cell, corner[1] + window.height * cell)
        near, chosen = self._background, None
        if self._backend != CUDA:  # where all of them lie already
            inside = self._footprints.in_box(np.array(corner), np.array(far))
            if 2 * len(inside) < len(near):  # else a copy would take longer than what lies outside
                near, chosen = near.select(torch.from_numpy(inside)), inside
        margin = _margin(cell)
        around = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
        pixel_mask = cv2.dilate(square.inner.astype(np.uint8), around).astype(bool)
        view = draw_from_above(
            [PosedGaussians(near), *self._parked],
            corner_m=corner,
            cell_m=cell,
            shape=shape,
            estimator=self._settings.estimator,
            pixel_mask=pixel_mask,
            top_m=max(self._footprints.top_m(chosen), self._parked_top_m),
            backend=self._backend,
        )
        is_ground = (view.ids >= 0) & (view.ids < len(near))
        classes = np.full(shape, SemanticClass.UNKNOWN, np.int16)
        ids = view.ids[is_ground]
        classes[is_ground] = self._classes[ids if chosen is None else chosen[ids]]
        lies = is_ground & ~view.is_thin & ~np.isin(classes, BARE_CLASSES)
        narrow = narrow_things(view, lies)
        view, filled = fill_holes(view, classes, lies, narrow, pixel_mask, self._path[:, :2])
        return view, classes, lies | filled, filled

    def _seen(self, surface: Surface, square: _Square, filled: np.ndarray) -> np.ndarray:
        """bool [H, W]: cells that can carry snow which some camera sees, and those next to them.

        filled: bool [H, W], cells of closed holes, which no camera can show.
        """
        rows, columns = np.nonzero(surface.can_carry)
        x, y = surface.map.centers()
        points = np.stack([x[columns], y[rows], surface.height_m[rows, columns]], 1)
        normals = normals_of(surface.slopes[rows, columns])
        low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
        views = self._views.near(low, high, RINGS_M[-1])
        seen = np.zeros(surface.can_carry.shape, np.uint8)
        is_low = points[:, 2] < views.lowest_m - _SURELY_BELOW_M
        seen[rows, columns] = views.see(points, normals, filled[rows, columns] | is_low)
        side = 2 * _SEEN_GROWS_CELLS + 1
        return cv2.dilate(seen, np.ones((side, side), np.uint8)).astype(bool)


def _with_margin(plan: TilePlan, level: int, window: Window) -> _Square:
    margin = _margin(plan.size_m(level))
    left, bottom, twice = window.left - margin, window.bottom - margin, 2 * margin
    wide = Window(left, bottom, window.width + twice, window.height + twice)
    own = plan.is_level(level, wide)
    inner = np.zeros_like(own)
    inner[margin:-margin, margin:-margin] = own[margin:-margin, margin:-margin]
    return _Square(level, wide, inner, own)


def _margin(cell_m: float) -> int:
    return max(_MARGIN_CELLS, math.ceil(_MARGIN_M / cell_m))


def _sides(surface: Surface, has_cells: np.ndarray) -> np.ndarray:
    """int8 [H, W, 4]: as SnowCells.neighbours, with LINK where a cell follows. The same surface
    that has no cells there, for want of a camera that sees it or because others cover it, is FLUSH.
    """
    sides = np.where(surface.sides == RISES, np.int8(FLUSH), surface.sides)
    has = np.pad(has_cells & surface.can_carry, 1)
    following = np.stack([has[1:-1, :-2], has[1:-1, 2:], has[:-2, 1:-1], has[2:, 1:-1]], -1)
    return np.where((sides == LINK) & ~following, np.int8(FLUSH), sides)


def _parked(scene: Scene) -> list[PosedGaussians]:
    """Actors that stand still, where they stand halfway through their track; the background's
    snow lies beside them.
    """
    return [
        PosedGaussians(
            plain_gaussians(actor.gaussians),
            actor.track.world_from_actor[len(actor.track.world_from_actor) // 2],
            number,
        )
        for number, actor in enumerate(scene.actors, start=1)
        if actor.label != EGO_VEHICLE and not moves(actor) and len(actor.gaussians)
    ]


def _heights(scene: Scene) -> tuple[float, float]:
    """Lowest and highest z of anything in the background."""
    z = scene.background.means[:, 2]
    return (float(z.min()), float(z.max())) if len(z) else (0.0, 0.0)


def _no_cells() -> SnowCells:
    numbers = CellNumbers(plan_tiles([], 1.0, (0.0, 0.0)))
    return make_cells(CellList.empty(), np.zeros(0, np.float32), numbers.at, Gaussians.empty())
