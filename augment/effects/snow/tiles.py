"""Which squares of the world a support covers, how fine each is, and where its cells are kept."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from augment.cameras import Camera
from augment.effects.snow import surface_kernels as tile_kernels
from augment.errors import SceneError

# Cells double in size at each of these level distances from the cameras' path, metres; beyond the
# last there are none.
RINGS_M = (8.0, 32.0, 48.0, 80.0, 120.0)
COARSEST_M = 1.0  # cells double up to about this size; a coarser cell_m does not double at all
BYTES_PER_CELL = 70  # of a support
MAX_BYTES = 4 << 30
_SIDE_M = 3.2  # of a tile, about
_PATH_STEP_M = 1.0  # camera centres closer than this are one place of the path
_PATH_GAP_M = 25.0  # those farther apart are not joined
_MAX_TILES = 30_000_000  # of the rectangle about the path


@dataclass(frozen=True)
class Window:
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
    """Where each cell of a plan stands in a support: a number for every cell of every tile, -1
    where the support has none.
    """

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
        tile_rows, tile_columns = self._plan.levels.shape
        out = np.empty(len(xy), np.int32)
        tile_kernels.find_numbers(
            np.ascontiguousarray(xy, np.float64),
            self._plan.origin_m,
            self._plan.side_m,
            tile_rows,
            tile_columns,
            self._sides,
            self._starts,
            self._numbers,
            out,
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
    named: dict[str, list[Camera]] = {}
    for camera in cameras:
        named.setdefault(camera.name, []).append(camera)
    taken = []
    for group in named.values():
        group.sort(key=lambda camera: camera.timestamp_ns)
        last: Camera | None = None
        for place, camera in enumerate(group):
            if last is None or place == len(group) - 1 or _has_moved(last, camera, step_m):
                taken.append(camera)
                last = camera
    return taken


def path_points(cameras: Sequence[Camera]) -> np.ndarray:
    """float64 [P, 3]: the centres of cameras of one name after another, joined in order of time."""
    named: dict[str, list[Camera]] = {}
    for camera in cameras:
        named.setdefault(camera.name, []).append(camera)
    points = []
    for group in named.values():
        group.sort(key=lambda camera: camera.timestamp_ns)
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
    borders = []
    for axis, (focal, middle, size) in enumerate(
        ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    ):
        for sign, edge in ((1.0, -middle / focal), (-1.0, (size - middle) / focal)):
            normal = np.zeros(3)
            normal[axis] = sign
            if camera.is_orthographic:
                borders.append((normal, sign * edge))
            else:
                normal[2] = -sign * edge
                borders.append((normal, 0.0))
    borders.append((np.array([0.0, 0.0, 1.0]), 0.0))
    return borders


def _round_up(value: float) -> float:
    """To two digits, not below the value."""
    digit = 10 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / digit) * digit, 12)
