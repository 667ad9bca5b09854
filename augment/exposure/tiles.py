"""Square tiles about the cameras' path, their cell sizes, and the index of every cell.

Cells are finer near the path. `plan_tiles` makes the `TilePlan`, and `CellNumbers` finds the cell
under a point. Caller: `search`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from augment.errors import SceneError
from augment.exposure import surface_kernels
from augment.scene.cameras import Camera

# Level distances from the cameras' path at which cells double in size; beyond the last there are
# no cells.
RING_DISTANCES_M = (8.0, 32.0, 48.0, 80.0, 120.0)
# Size up to which cells double, about; a coarser cell_m does not double at all.
MAX_DOUBLED_CELL_M = 1.0
BYTES_PER_CELL = 70  # memory of an exposed cell
MAX_BYTES = 4 << 30  # largest memory of an exposed surface
_TILE_SIDE_M = 3.2  # side of a tile, about
_PATH_STEP_M = 1.0  # camera centres closer than this are one place of the path
_MAX_PATH_GAP_M = 25.0  # camera centres farther apart than this are not joined
_MAX_TILES = 30_000_000  # largest number of tiles in the rectangle about the path


class TooManyCellsError(SceneError):
    """Cells of an exposed surface take more memory than is used for them.

    Callers add the recipe's field that sets the size of the cells.
    """


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
            TooManyCellsError: the cells would take more than MAX_BYTES.
        """
        if self.cells * BYTES_PER_CELL <= MAX_BYTES:
            return
        min_cell_m = self.cell_m * math.sqrt(self.cells * BYTES_PER_CELL / MAX_BYTES)
        raise TooManyCellsError(
            f"exposed surfaces in cells of {self.cell_m:g} m would take "
            f"{self.cells / 1e6:,.0f} million cells along this path, about "
            f"{self.cells * BYTES_PER_CELL / 1e9:,.1f} GB; at most "
            f"{MAX_BYTES / 1e9:.1f} GB are used. Take cells of {_round_up(min_cell_m):g} m or "
            f"more, or fewer frames"
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
