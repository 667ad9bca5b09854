"""Where snow can lie in a scene: cells of the surfaces that are open to the sky and seen.

plan      square tiles about the cameras' path, finer near it             (tiles)
views     what each of some cameras along the drive sees                  (visibility)
then for squares of tiles, each with a margin of its surroundings:
  above   heights, colours and classes from straight above                (height_map, holes)
  surface where snow stays, and where its edges are                       (surface)
  ground  light, wheel tracks, banks                                      (ground_light, ...)
actors    the same in each vehicle's own frame                            (actor_cells)
join      neighbours across squares, and what the cells bury              (cell_lists, buried)
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from tqdm import tqdm

from augment.cameras import Camera
from augment.errors import SceneError
from augment.ground import check_metric_and_level
from augment.labels import EGO_VEHICLE
from augment.render.backends import AUTO, CUDA
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.snow.actor_cells import find_actor_cells, is_vehicle, moves
from augment.snow.cell_lists import CellList, cells_at, make_cells
from augment.snow.cells import EDGE_CAP_M, FLUSH, SnowBed, SnowCells
from augment.snow.ground_light import ground_luminance, relative_light
from augment.snow.height_map import (
    Estimator,
    Footprints,
    HeightMap,
    classes_of,
    draw_from_above,
    plain_gaussians,
    top_of,
)
from augment.snow.holes import fill_holes
from augment.snow.in_threads import in_order
from augment.snow.surface import Surface, banks_of, find_surface, narrow_things, normals_of
from augment.snow.surface_kernels import LINK, RISES
from augment.snow.tiles import (
    RINGS_M,
    CellNumbers,
    TilePlan,
    Window,
    path_points,
    plan_tiles,
    views_along,
)
from augment.snow.visibility import Views, draw_views
from augment.snow.wheel_tracks import WheelPath, draw_tracks, wheel_paths

_SQUARE_CELLS = 1024  # on a side of what is drawn at once, about
_MARGIN_M, _MARGIN_CELLS = EDGE_CAP_M + 0.2, 4  # drawn about it
_SEEN_GROWS_CELLS = 2
_SURELY_BELOW_M = 0.5  # the cameras: there is ground behind what lies there, not sky


@dataclass(frozen=True)
class PlacementSettings:
    """How a bed is found. cell_m: side of the cells near the path, metres; they double with the
    distance from it. max_slope_deg: nothing steeper carries snow. estimator: the depth buffer that
    heights from above are taken from.
    """

    cell_m: float = 0.05
    max_slope_deg: float = 50.0
    estimator: Estimator = "mode"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ValueError(f"cell_m must be finite and > 0 (metres); got {self.cell_m}")
        if not 0 <= self.max_slope_deg < 90:
            raise ValueError(f"max_slope_deg must be 0 to below 90; got {self.max_slope_deg}")
        if self.estimator not in ("mode", "expected", "median"):
            raise ValueError(
                f"estimator must be 'mode', 'expected' or 'median'; got {self.estimator!r}"
            )


def place_snow_bed(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: PlacementSettings = PlacementSettings(),
    *,
    backend: str = AUTO,
    progress: bool = False,
) -> SnowBed:
    """The cells of a scene that snow can lie on and that some of the cameras can see.

    Several threads work on squares of the ground, and any number gives the same bits.
    Without cameras, or where nothing open is seen, the bed is empty. backend: "cuda" draws and
    looks on the GPU; any other on the CPU, since the torch definition would take hours. progress:
    shows a bar.

    Raises:
        SceneError: metres or gravity are not known, or the cells would take too much memory.
    """
    check_metric_and_level(scene)
    if backend != CUDA:
        backend = AUTO
    clock = _Clock()
    views = views_along(cameras)
    background = plain_gaussians(scene.background)
    plan = plan_tiles(views, settings.cell_m, _heights(scene))
    plan.check_size()
    clock.lap("plan")
    vehicles = [actor for actor in scene.actors if is_vehicle(actor)]
    squares = [
        (level, window)
        for level in range(int(plan.levels.max()) + 1)
        for window in plan.squares(level, _SQUARE_CELLS)
    ]
    if not squares:
        return SnowBed(_no_cells(), {}, clock.seconds)
    parked = tuple(_parked(scene))
    with tqdm(
        total=len(views) + len(squares) + len(vehicles),
        desc="placing snow",
        disable=not progress,
        unit="step",
    ) as bar:
        seen_from = draw_views(
            views,
            [PosedGaussians(background), *parked],
            backend=backend,
            after_each=lambda: bar.update(),
        )
        clock.lap("views")
        paths = wheel_paths(scene)
        work = _Ground(background, parked, plan, views, seen_from, paths, settings, backend)
        clock.lap("plan")
        found = in_order(work.find, squares, after_each=bar.update)
        clock.share_lap([square.seconds for square in found])
        on_vehicles = in_order(
            lambda actor: find_actor_cells(
                actor,
                cell_m=settings.cell_m,
                max_slope_deg=settings.max_slope_deg,
                estimator=settings.estimator,
                backend=backend,
            ),
            vehicles,
            after_each=bar.update,
        )
        actors = {
            actor.track_id: cells
            for actor, cells in zip(vehicles, on_vehicles, strict=True)
            if cells is not None
        }
        clock.lap("actors")
    ground = work.joined(found)
    clock.lap("join")
    return SnowBed(ground, actors, clock.seconds)


class _Clock:
    """Adds up the seconds between laps by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now

    def share_lap(self, stages: Sequence[Mapping[str, float]]) -> None:
        """End a lap of several threads: its seconds go to stages as those of the threads did."""
        sums: dict[str, float] = {}
        for each in stages:
            for name, seconds in each.items():
                sums[name] = sums.get(name, 0.0) + seconds
        now = time.perf_counter()
        share = (now - self._last) / max(sum(sums.values()), 1e-9)
        self.seconds |= {name: share * seconds for name, seconds in sums.items()}
        self._last = now


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
    """Cells of a level's window; None where it has none. columns, rows: int64 [C], counted from the
    plan's origin. seconds: what finding them took, by stage.
    """

    level: int
    columns: np.ndarray
    rows: np.ndarray
    cells: CellList | None
    seconds: Mapping[str, float]


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
        backend: str,
    ) -> None:
        self._background, self._parked, self._plan = background, parked, plan
        self._views, self._paths, self._settings = views, paths, settings
        self._backend = backend
        self._classes = classes_of(background)
        self._footprints, self._parked_top_m = Footprints(background), top_of(parked)
        self._path = path_points(cameras)

    def find(self, level_and_window: tuple[int, Window]) -> _Found:
        """The cells of one window of a level."""
        clock = _Clock()
        square = _with_margin(self._plan, *level_and_window)
        view, classes, lies, filled = self._draw(square)
        clock.lap("above")
        surface = find_surface(view, lies, max_slope_deg=self._settings.max_slope_deg)
        clock.lap("surface")
        seen = self._seen(surface, square, filled)
        clock.lap("seen")
        rows, columns = np.nonzero(surface.can_carry & seen & square.inner)
        cells = None
        if len(rows):
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
        clock.lap("ground")
        return _Found(
            square.level,
            columns.astype(np.int64) + square.window.left,
            rows.astype(np.int64) + square.window.bottom,
            cells,
            clock.seconds,
        )

    def joined(self, found: Sequence[_Found]) -> SnowCells:
        """All those cells, one square's after another's, linked across squares."""
        numbers, lists, count = CellNumbers(self._plan), [], 0
        for square in found:
            if square.cells is None:
                continue
            to = count + np.arange(len(square.cells), dtype=np.int32)
            numbers.put(square.level, square.columns, square.rows, to)
            lists.append(square.cells)
            count += len(square.cells)
        if not lists:
            return _no_cells()
        cells = CellList.joined(lists)
        light = relative_light(cells.luminance, cells.semantic)
        return make_cells(cells, light, numbers, self._background)

    def _draw(self, square: _Square) -> tuple[HeightMap, np.ndarray, np.ndarray, np.ndarray]:
        """The square from above, its classes, where what is seen is of the background and no
        wall on edge, and where it closes a hole.
        """
        plan, window = self._plan, square.window
        cell = plan.size_m(square.level)
        corner = (
            plan.origin_m[0] + window.left * cell,
            plan.origin_m[1] + window.bottom * cell,
        )
        shape = (window.height, window.width)
        far = (corner[0] + window.width * cell, corner[1] + window.height * cell)
        near, chosen = self._background, None
        if self._backend != CUDA:  # where all of them lie already
            chosen = self._footprints.in_box(np.array(corner), np.array(far))
            if 2 * len(chosen) < len(near):
                near = near.select(torch.from_numpy(chosen))
            else:  # a copy would take longer than what lies outside
                chosen = None
        margin = _margin(cell)
        around = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
        wanted = cv2.dilate(square.inner.astype(np.uint8), around).astype(bool)
        view = draw_from_above(
            [PosedGaussians(near), *self._parked],
            corner_m=corner,
            cell_m=cell,
            shape=shape,
            estimator=self._settings.estimator,
            wanted=wanted,
            top_m=max(self._footprints.top_m(chosen), self._parked_top_m),
            backend=self._backend,
        )
        is_ground = (view.ids >= 0) & (view.ids < len(near))
        classes = np.full(shape, SemanticClass.UNKNOWN, np.int16)
        ids = view.ids[is_ground]
        classes[is_ground] = self._classes[ids if chosen is None else chosen[ids]]
        lies = is_ground & ~view.is_thin
        narrow = narrow_things(view, lies)
        view, filled = fill_holes(view, classes, lies, narrow, wanted, self._path[:, :2])
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
    wide = Window(
        window.left - margin,
        window.bottom - margin,
        window.width + 2 * margin,
        window.height + 2 * margin,
    )
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
    parts = []
    for number, actor in enumerate(scene.actors, start=1):
        if actor.label == EGO_VEHICLE or moves(actor) or len(actor.gaussians) == 0:
            continue
        poses = actor.track.world_from_actor
        parts.append(
            PosedGaussians(plain_gaussians(actor.gaussians), poses[len(poses) // 2], number)
        )
    return parts


def _heights(scene: Scene) -> tuple[float, float]:
    """Lowest and highest z of anything in the background."""
    z = scene.background.means[:, 2]
    if len(z) == 0:
        return 0.0, 0.0
    return float(z.min()), float(z.max())


def _no_cells() -> SnowCells:
    return make_cells(
        CellList.empty(),
        np.zeros(0, np.float32),
        CellNumbers(plan_tiles([], 1.0, (0.0, 0.0))),
        _NOBODY,
    )


_NOBODY = Gaussians.empty()

__all__ = ["PlacementSettings", "SceneError", "place_snow_bed"]
