"""Puts lying snow on a LiDAR sweep: beams end on its surface, which is bright at 905 nm.

Caller: `SnowEffect.intersect_beams`. The layer has the exposed surface, profile and seed of the
images' layer, so that drifts, patches and wheel tracks are where the pictures have them. It lies on
a grid of GRID_M cells and is not evened out as the images' layer is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import MOVED
from augment.effects.snow import layer_kernels
from augment.effects.snow.changing_snow import changing_cells, find_depths_at, laid_plan, state_of
from augment.effects.snow.depth import find_depths, profile_on_part
from augment.effects.snow.plan import SnowPlan, exposure_settings, naming_cell_field
from augment.effects.snow.slush import road_snow
from augment.exposure.cells import ExposedCells, ExposedSurface
from augment.exposure.exposed_surface import exposed_surface_of
from augment.memo import memo_of
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene

# Fresh snow gives back 0.95 of visible light and 0.90 at 0.9 um; old, coarse snow 0.9 and 0.7
# (Wiscombe and Warren 1980, figure 8): the recipe's albedo times this.
ALBEDO_AT_905 = 0.93
GRID_M = 0.1  # side of a grid's cells
MIN_FACING_COSINE = 0.02  # least cosine of incidence on the layer
_MAX_CELLS = 8_000_000  # largest number of cells of a grid; larger scenes get coarser cells
# Depths below the layer's underside at which it still stops beams, on the ground and on actors.
GROUND_SLACK_M = 0.15
ACTOR_SLACK_M = 0.05
_MAX_ACTOR_DISTANCE_M = 200.0  # distance beyond which actors are ignored
# Returns within _ACTOR_RADIUS_M of an actor, one in _RETURN_STRIDE, give the time when the sensor
# looked at it.
_ACTOR_RADIUS_M = 3.0
_RETURN_STRIDE = 8
_MAX_CLOCK_GAP_NS = 10**9  # largest difference of a sweep's times from its frame's time


@dataclass(frozen=True, eq=False)
class SnowGrid:
    """Snow on one part, in the part's frame: see layer_kernels.intersect_layer."""

    corner: np.ndarray
    cell_m: float
    base: np.ndarray
    top: np.ndarray
    highest: np.ndarray
    radius_m: float  # radius of the circle about the part's origin that holds it, seen from above


@dataclass(frozen=True, eq=False)
class LidarSnow:
    """Snow in a scene."""

    ground: SnowGrid | None  # snow on the background
    actors: Mapping[str, SnowGrid]  # snow on actors, by track_id
    reflectance: float  # reflectance of the snow, met head on


def intersect_snow(
    echoes: Echoes, scene: Scene, recipe_snow: SnowPlan, sweep: LidarSweep, frame_ns: int
) -> None:
    """End beams on the snow where they meet it first. Thread-safe.

    Raises:
        SceneError: this scene cannot have snow.
    """
    snow = find_lidar_snow(scene, recipe_snow)
    ranges = echoes.ranges_m
    hits = intersect_layers(snow, scene, sweep, frame_ns, echoes.origins, echoes.directions, ranges)
    rows = np.flatnonzero(hits < ranges)
    # The layer counts as level, but its grains stand out: no beam slides over it unreflected.
    facing = np.maximum(np.abs(echoes.directions[rows, 2]), MIN_FACING_COSINE)
    echoes.replace_echoes(rows, hits[rows], snow.reflectance * np.clip(facing, 0.0, 1.0), MOVED)


def make_snow_grid(
    cells: ExposedCells, depths_m: np.ndarray, *, grid_m: float = GRID_M
) -> SnowGrid | None:
    """Return snow of depths [C] on cells as a grid; None where there is none."""
    centers = cells.centers_m.numpy()
    sizes = cells.sizes_m.numpy()
    covered = depths_m > 0
    if not covered.any():
        return None
    half = sizes[covered, None] / 2
    low = (centers[covered, :2] - half).min(0).astype(np.float64)
    extent = (centers[covered, :2] + half).max(0) - low
    cell = float(max(grid_m, math.sqrt(float(extent.prod()) / _MAX_CELLS)))
    columns, rows = (int(n) for n in np.ceil(extent / cell) + 1)
    base, top = np.full((2, rows, columns), -np.inf, np.float32)
    depths = np.ascontiguousarray(depths_m, np.float32)
    layer_kernels.fill_layer(centers, sizes, depths, low, cell, base, top)
    radius = float(np.hypot(*(centers[covered, :2] + np.sign(centers[covered, :2]) * half).T).max())
    # The largest value of every block of the grid, so that the march can skip blocks.
    block = layer_kernels.BLOCK
    blocks = [-(-n // block) for n in top.shape]
    padded = np.full([n * block for n in blocks], -np.inf, np.float32)
    padded[:rows, :columns] = top
    highest = padded.reshape(blocks[0], block, blocks[1], block).max((1, 3))
    return SnowGrid(low, cell, base, top, highest, radius)


def find_lidar_snow(scene: Scene, recipe_snow: SnowPlan) -> LidarSnow:
    """Return the snow of a recipe in a scene. Thread-safe.

    Raises:
        SceneError: this scene cannot have snow.
    """
    with naming_cell_field():
        exposed_surface = exposed_surface_of(scene, exposure_settings(recipe_snow.snow, scene))
    if recipe_snow.snow.is_scaled:
        return _scale_grids(exposed_surface, scene, recipe_snow)
    key = ("lidar snow", scene.name, recipe_snow)
    return memo_of(exposed_surface).get(
        key, lambda: _build_grids(exposed_surface, scene, recipe_snow)
    )


def intersect_layers(
    snow: LidarSnow,
    scene: Scene,
    sweep: LidarSweep,
    frame_ns: int,
    origins: np.ndarray,
    directions: np.ndarray,
    ends_m: np.ndarray,
) -> np.ndarray:
    """Return the distances at which beams end, float64 [N], ends_m at most.

    An actor stands where it was at the times of the returns about it, or else at the frame's time.

    Args:
        snow: snow in the scene.
        scene: the scene.
        sweep: the sweep, whose times are read.
        frame_ns: time of the frame.
        origins: [N, 3], world.
        directions: [N, 3], unit, world.
        ends_m: [N], lengths of the beams.
    """
    hits = ends_m.copy()
    if snow.ground is not None:
        _intersect_grid(snow.ground, np.eye(4), math.inf, origins, directions, hits, GROUND_SLACK_M)
    sample_rows = np.flatnonzero(ends_m > 0)[::_RETURN_STRIDE]
    if not snow.actors or not len(sample_rows):
        return hits
    ends = origins[sample_rows] + ends_m[sample_rows, None] * directions[sample_rows]
    times = _return_times(sweep, frame_ns)
    eye = np.median(origins[sample_rows], axis=0)
    for actor in scene.actors:
        layer = snow.actors.get(actor.track_id)
        pose = actor.track.pose_at(frame_ns)
        if layer is None or pose is None:
            continue
        position = pose[:2, 3].numpy()
        if np.hypot(*(position - eye[:2])) > _MAX_ACTOR_DISTANCE_M:
            continue
        if times is not None:
            is_about = np.hypot(*(ends[:, :2] - position).T) < layer.radius_m + _ACTOR_RADIUS_M
            if is_about.any():
                pose = actor.track.pose_at(
                    int(np.sort(times[sample_rows][is_about])[is_about.sum() // 2])
                )
        if pose is not None:
            world_from_part = pose.double().numpy()
            _intersect_grid(
                layer, world_from_part, layer.radius_m, origins, directions, hits, ACTOR_SLACK_M
            )
    return hits


def _intersect_grid(
    layer: SnowGrid,
    world_from_part: np.ndarray,
    radius_m: float,
    origins: np.ndarray,
    directions: np.ndarray,
    hits: np.ndarray,
    slack_m: float,
) -> None:
    """Shorten beams to where they meet one layer, in place."""
    part_from_world = np.eye(4)
    part_from_world[:3, :3] = world_from_part[:3, :3].T
    part_from_world[:3, 3] = -world_from_part[:3, :3].T @ world_from_part[:3, 3]
    layer_kernels.intersect_layer(
        origins,
        directions,
        hits,
        part_from_world[:3].copy(),
        np.array([world_from_part[0, 3], world_from_part[1, 3], radius_m]),
        layer.corner,
        layer.cell_m,
        layer.base,
        layer.top,
        layer.highest,
        slack_m,
    )


def _build_grids(exposed_surface: ExposedSurface, scene: Scene, recipe_snow: SnowPlan) -> LidarSnow:
    """Compute the snow of a recipe on every part of the scene."""

    def layer(cells: ExposedCells, track_id: str | None) -> SnowGrid | None:
        """Return the grid of one part; track_id: None for the background."""
        snow_settings = (recipe_snow.snow, recipe_snow.seed, recipe_snow.water_level_z_m)
        profile, rng = profile_on_part(track_id, scene, *snow_settings)
        seed = rng.integers(0, 2**64, dtype=np.uint64)
        grid_m = GRID_M if track_id is None else min(GRID_M, recipe_snow.snow.cell_m)
        depths = find_depths(cells, profile, seed)
        traces = road_snow(depths, cells, scene, recipe_snow) if track_id is None else None
        depths = depths if traces is None else traces.depths
        return make_snow_grid(cells, depths.depths_m, grid_m=grid_m)

    actors = {
        track_id: layer(cells, track_id) for track_id, cells in exposed_surface.actors.items()
    }
    return LidarSnow(
        ground=layer(exposed_surface.ground, None),
        actors={track_id: grid for track_id, grid in actors.items() if grid is not None},
        reflectance=ALBEDO_AT_905 * recipe_snow.snow.albedo,
    )


def _scale_grids(exposed_surface: ExposedSurface, scene: Scene, recipe_snow: SnowPlan) -> LidarSnow:
    """Return the snow of a recipe at a moment; the numbers of cells are found once a scene."""
    plan = laid_plan(recipe_snow)
    parts = {None: exposed_surface.ground, **exposed_surface.actors}
    numbers = memo_of(exposed_surface).get(
        ("changing cells", scene.name, plan),
        lambda: {name: changing_cells(cells, name, scene, plan) for name, cells in parts.items()},
    )
    state = state_of(recipe_snow.snow)
    grids = dict[str | None, SnowGrid]()
    for name, cells in parts.items():
        grid_m = GRID_M if name is None else min(GRID_M, recipe_snow.snow.cell_m)
        grid = make_snow_grid(cells, find_depths_at(numbers[name], state), grid_m=grid_m)
        if grid is not None:
            grids[name] = grid
    return LidarSnow(
        ground=grids.pop(None, None),
        actors={name: grid for name, grid in grids.items() if name is not None},
        reflectance=ALBEDO_AT_905 * recipe_snow.snow.albedo,
    )


def _return_times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """Return the times of returns, int64 [N], or None where they are not on the frames' clock.

    They come from the column timestamp_ns, or from t in seconds.
    """
    column = sweep.columns.get("timestamp_ns")
    if column is not None and np.asarray(column).dtype.kind in "iu":
        times = np.asarray(column).astype(np.int64)
    else:
        column = sweep.columns.get("t")
        if column is None or np.asarray(column).dtype.kind != "f" or not np.isfinite(column).all():
            return None
        times = np.round(np.clip(column, -9e9, 9e9) * 1e9).astype(np.int64)
    is_on_clock = len(times) > 0 and abs(int(np.median(times)) - frame_ns) <= _MAX_CLOCK_GAP_NS
    return times if is_on_clock else None
