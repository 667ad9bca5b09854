"""Finds the surfaces of a scene that are open to the sky and visible to a camera.

Input: a `Scene`, the cameras that must see the surfaces, `ExposureSettings`. Output: an
`ExposedSurface`, square cells on the background and on vehicles. Caller:
`exposed_surface.exposed_surface_of`.

1. `plan_tiles` plans square tiles about the cameras' path, with finer cells near it.
2. `draw_views` renders the depth that a sample of the cameras along the drive sees.
3. `_GroundSearch.find` works on one square of tiles at a time, each with a margin: it renders the
   square from above, closes holes, separates the surfaces, selects the cells that a camera sees,
   and finds their light, wheel tracks and obstacles.
4. `find_actor_cells` finds the cells of each moving vehicle, in the vehicle's own frame. Shells
   (`vehicle_shell`) are the surface of vehicles whose form is known, parked ones among them.
5. `_GroundSearch.join` links neighbouring cells across squares and finds the Gaussians that a
   layer on the cells can hide.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from augment.exposure.cells import FLUSH, MAX_EDGE_DISTANCE_M, ExposedCells, ExposedSurface
from augment.exposure.foliage import BARE_CLASSES, separate_foliage
from augment.exposure.ground_light import (
    MAX_RELATIVE_LIGHT,
    MIN_RELATIVE_LIGHT,
    ground_luminance,
    relative_light,
)
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
from augment.exposure.holes import fill_holes
from augment.exposure.shell_grid import PlacedShell, ShellGrid, draw_shells
from augment.exposure.surface import (
    CellList,
    Surface,
    cells_at,
    find_narrow_things,
    find_obstacle_vectors,
    find_surface,
    is_moving,
    is_vehicle,
    make_cells,
    normals_from_slopes,
)
from augment.exposure.surface_kernels import LINK, RISES
from augment.exposure.tiles import (
    RING_DISTANCES_M,
    CellNumbers,
    TilePlan,
    Window,
    path_points,
    plan_tiles,
    views_along,
)
from augment.exposure.vehicle_cells import find_actor_cells, parked_vehicles, shells_of_parked
from augment.exposure.wheel_tracks import WheelPath, draw_tracks, find_wheel_paths
from augment.light.cast_shadows import CastShadows, shadows_of
from augment.progress import ProgressBar
from augment.render.buffers import AUTO, CUDA
from augment.scene.cameras import Camera
from augment.scene.ground import check_metric_and_level
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.timing import counted_steps

PROGRESS_LABEL = "finding exposed surfaces"  # label of the progress bar and of the step counter
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
    max_slope_deg: float = 50.0  # steeper surfaces hold no layer
    estimator: DepthEstimator = "mode"  # depth buffer that heights from above are taken from
    # If True, the ego leaves wheel tracks also along cameras that nobody drove.
    has_tracks_without_drive: bool = False

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
        SceneError: metres or gravity are not known.
        TooManyCellsError: the cells would take too much memory.
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
        paths = find_wheel_paths(scene, has_path_without_drive=settings.has_tracks_without_drive)
        search = _GroundSearch(
            background,
            parked_actors,
            plan,
            views,
            visible_depths,
            paths,
            settings,
            shadows_of(scene),
            shells_of_parked(parked_vehicles(scene), background, path_points(views)[:, :2]),
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
        shells: tuple[PlacedShell, ...],
        backend: str,
    ) -> None:
        self._background = background
        self._parked_actors = parked
        self._plan = plan
        self._shadows = shadows
        self._shells = shells
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
        height_map, classes, candidate_mask, filled_mask = self._draw(square)
        max_slope_deg = self._settings.max_slope_deg
        shells = draw_shells(
            self._shells,
            height_map,
            classes,
            max_slope_deg=max_slope_deg,
            pixel_mask=square.level_mask,
        )
        if shells is not None:
            height_map, classes = shells.put_under(height_map, classes)
            candidate_mask = candidate_mask | shells.is_top
            filled_mask = filled_mask | shells.is_top  # a shell is sure of its surface
        surface = find_surface(
            height_map,
            candidate_mask,
            max_slope_deg=max_slope_deg,
            on_vehicles=candidate_mask & (classes == SemanticClass.VEHICLE),
            shells=shells,
        )
        classes = separate_foliage(surface, classes)
        visible_mask = self._visible_cells(surface, square, filled_mask)
        rows, columns = np.nonzero(surface.is_exposed & visible_mask & square.inner_mask)
        if not len(rows):
            return None
        cells = cells_at(
            surface,
            rows,
            columns,
            sides=_side_codes(surface, visible_mask & square.level_mask),
            luminance=_luminance_without_paint(
                ground_luminance(height_map, classes, surface.is_exposed), shells
            ),
            track_share=draw_tracks(self._paths, surface, classes),
            obstacle_vectors=find_obstacle_vectors(surface),
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
        if in_light is not None:  # the paint of vehicles tells nothing about the light
            is_in_known_light = np.isnan(cells.luminance) & np.isfinite(in_light)
            is_in_known_light &= cells.semantic == SemanticClass.VEHICLE
            light[is_in_known_light] = np.clip(
                in_light[is_in_known_light], MIN_RELATIVE_LIGHT, MAX_RELATIVE_LIGHT
            )
        return make_cells(cells, light, numbers.at, self._background, self._shells)

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
        candidate_mask = is_ground & ~height_map.is_thin & ~np.isin(classes, BARE_CLASSES)
        narrow_mask = find_narrow_things(height_map, candidate_mask)
        height_map, filled_mask = fill_holes(
            height_map, classes, candidate_mask, narrow_mask, pixel_mask, self._path[:, :2]
        )
        return height_map, classes, candidate_mask | filled_mask, filled_mask

    def _visible_cells(
        self, surface: Surface, square: _Square, filled_mask: np.ndarray
    ) -> np.ndarray:
        """Exposed cells that a camera sees, and their neighbours, bool [H, W].

        Args:
            surface: surface of the square.
            square: the square.
            filled_mask: bool [H, W], cells of closed holes, which no camera can show.
        """
        rows, columns = np.nonzero(surface.is_exposed)
        x, y = surface.map.centers()
        points = np.stack([x[columns], y[rows], surface.height_m[rows, columns]], 1)
        normals = normals_from_slopes(surface.slopes[rows, columns])
        low = np.array([x[0], y[0]])
        high = np.array([x[-1], y[-1]])
        views = self._views.near(low, high, RING_DISTANCES_M[-1])
        visible_mask = np.zeros(surface.is_exposed.shape, np.uint8)
        is_low = points[:, 2] < views.lowest_m - _MIN_DROP_BELOW_CAMERAS_M
        visible_mask[rows, columns] = views.see(
            points, normals, filled_mask[rows, columns] | is_low
        )
        side = 2 * _VISIBLE_MARGIN_CELLS + 1
        return cv2.dilate(visible_mask, np.ones((side, side), np.uint8)).astype(bool)


def _luminance_without_paint(luminance: np.ndarray, shells: ShellGrid | None) -> np.ndarray:
    """Return the luminance with NaN on vehicles: their paint tells nothing about the light."""
    return luminance if shells is None else np.where(shells.is_plan, np.float32(np.nan), luminance)


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
    has_cell = np.pad(has_cells & surface.is_exposed, 1)
    has_neighbour = np.stack(
        [has_cell[1:-1, :-2], has_cell[1:-1, 2:], has_cell[:-2, 1:-1], has_cell[2:, 1:-1]], -1
    )
    return np.where((sides == LINK) & ~has_neighbour, np.int8(FLUSH), sides)


def _parked_actors(scene: Scene) -> list[PosedGaussians]:
    """Actors that stand still, at their pose halfway through the track.

    They shelter the background below them.
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
