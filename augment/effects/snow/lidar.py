"""Lying snow on a LiDAR sweep: beams end on its surface, which is bright at 905 nm.

The layer has the support, profile and seed of the images', so that drifts, patches and wheel tracks
are where the pictures have them, on a grid of GRID_M cells, without the images' levelling.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import MOVED
from augment.effects.snow import kernels
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.layer import find_depths, profile_on
from augment.effects.snow.snow import PlacedSnow, placement_settings
from augment.effects.snow.support import support_of
from augment.labels import LidarSweep
from augment.memo import memo_of
from augment.scene import Scene

# Fresh snow gives back 0.95 of visible light and 0.90 at 0.9 um; old, coarse snow 0.9 and 0.7
# (Wiscombe and Warren 1980, figure 8): the recipe's albedo times this.
ALBEDO_AT_905 = 0.93
GRID_M = 0.1
MIN_FACING = 0.02  # cosine
_MAX_CELLS = 8_000_000  # of a grid; larger scenes get coarser ones
GROUND_SLACK_M, ACTOR_SLACK_M = 0.15, 0.05
_REACH_M = 200.0  # actors farther away are not asked
_ABOUT_M, _EVERY = 3.0, 8  # returns that tell when the sensor looked at an actor
_SAME_DRIVE_NS = 10**9  # a sweep's times are within this of its frame's


@dataclass(frozen=True, eq=False)
class SnowGrid:
    """Snow on one part, in the part's frame: see kernels.meet_layer. radius_m: of the circle
    about the part's origin that holds it, seen from above.
    """

    corner: np.ndarray
    cell_m: float
    base: np.ndarray
    top: np.ndarray
    highest: np.ndarray
    radius_m: float


@dataclass(frozen=True, eq=False)
class LidarSnow:
    """The snow in a scene. actors: by track_id. reflectance: of it, met head on."""

    ground: SnowGrid | None
    actors: Mapping[str, SnowGrid]
    reflectance: float


def meet_snow(
    echoes: Echoes, scene: Scene, placed: PlacedSnow, sweep: LidarSweep, frame_ns: int
) -> None:
    """End beams on the snow where they come to it first. Thread-safe.

    Raises:
        SceneError: snow cannot be placed in this scene.
    """
    snow = snow_in(scene, placed)
    ranges = echoes.ranges_m
    hits = meet_layers(snow, scene, sweep, frame_ns, echoes.origins, echoes.directions, ranges)
    rows = np.flatnonzero(hits < ranges)
    # The layer counts as level, but its grains stand out: no beam slides over it unreflected.
    facing = np.maximum(np.abs(echoes.directions[rows, 2]), MIN_FACING)
    echoes.replace(rows, hits[rows], snow.reflectance * np.clip(facing, 0.0, 1.0), MOVED)


def layer_of(cells: SnowCells, depths_m: np.ndarray, *, grid_m: float = GRID_M) -> SnowGrid | None:
    """Snow of depths [C] on cells; None where there is none."""
    centers, sizes = cells.centers_m.numpy(), cells.sizes_m.numpy()
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
    kernels.fill_layer(centers, sizes, depths, low, cell, base, top)
    radius = float(np.hypot(*(centers[covered, :2] + np.sign(centers[covered, :2]) * half).T).max())
    # The greatest of every block of the grid, for the march to skip.
    block = kernels.BLOCK
    blocks = [-(-n // block) for n in top.shape]
    padded = np.full([n * block for n in blocks], -np.inf, np.float32)
    padded[:rows, :columns] = top
    highest = padded.reshape(blocks[0], block, blocks[1], block).max((1, 3))
    return SnowGrid(low, cell, base, top, highest, radius)


def snow_in(scene: Scene, placed: PlacedSnow) -> LidarSnow:
    """The snow of a recipe in a scene. Thread-safe.

    Raises:
        SceneError: snow cannot be placed in this scene.
    """
    support = support_of(scene, placement_settings(placed.snow, scene))
    key = ("lidar snow", scene.name, placed)
    return memo_of(support).get(key, lambda: _lay(support, scene, placed))


def meet_layers(
    snow: LidarSnow,
    scene: Scene,
    sweep: LidarSweep,
    frame_ns: int,
    origins: np.ndarray,
    directions: np.ndarray,
    ends_m: np.ndarray,
) -> np.ndarray:
    """Where beams [N] end, ends_m at most, float64 [N]. origins, directions: [N, 3], scene world.

    An actor stands where it was at the times of the returns about it, else at the frame's time.
    """
    hits = ends_m.copy()
    if snow.ground is not None:
        _meet(snow.ground, np.eye(4), math.inf, origins, directions, hits, GROUND_SLACK_M)
    every = np.flatnonzero(ends_m > 0)[::_EVERY]
    if not snow.actors or not len(every):
        return hits
    ends = origins[every] + ends_m[every, None] * directions[every]
    times = _times(sweep, frame_ns)
    eye = np.median(origins[every], axis=0)
    for actor in scene.actors:
        layer = snow.actors.get(actor.track_id)
        pose = actor.track.pose_at(frame_ns)
        if layer is None or pose is None:
            continue
        place = pose[:2, 3].numpy()
        if np.hypot(*(place - eye[:2])) > _REACH_M:
            continue
        if times is not None:
            about = np.hypot(*(ends[:, :2] - place).T) < layer.radius_m + _ABOUT_M
            if about.any():
                pose = actor.track.pose_at(int(np.sort(times[every][about])[about.sum() // 2]))
        if pose is not None:
            world = pose.double().numpy()
            _meet(layer, world, layer.radius_m, origins, directions, hits, ACTOR_SLACK_M)
    return hits


def _meet(
    layer: SnowGrid,
    world_from_part: np.ndarray,
    radius_m: float,
    origins: np.ndarray,
    directions: np.ndarray,
    hits: np.ndarray,
    slack_m: float,
) -> None:
    part_from_world = np.eye(4)
    part_from_world[:3, :3] = world_from_part[:3, :3].T
    part_from_world[:3, 3] = -world_from_part[:3, :3].T @ world_from_part[:3, 3]
    kernels.meet_layer(
        *(origins, directions, hits, part_from_world[:3].copy()),
        np.array([world_from_part[0, 3], world_from_part[1, 3], radius_m]),
        *(layer.corner, layer.cell_m, layer.base, layer.top, layer.highest, slack_m),
    )


def _lay(support: SnowSupport, scene: Scene, placed: PlacedSnow) -> LidarSnow:
    def layer(cells: SnowCells, track_id: str | None) -> SnowGrid | None:
        given = (placed.snow, placed.seed, placed.water_level_z_m)
        profile, rng = profile_on(track_id, scene, *given)
        seed = rng.integers(0, 2**64, dtype=np.uint64)
        grid_m = GRID_M if track_id is None else min(GRID_M, placed.snow.cell_m)
        return layer_of(cells, find_depths(cells, profile, seed).heights, grid_m=grid_m)

    actors = {track_id: layer(cells, track_id) for track_id, cells in support.actors.items()}
    return LidarSnow(
        ground=layer(support.ground, None),
        actors={track_id: laid for track_id, laid in actors.items() if laid is not None},
        reflectance=ALBEDO_AT_905 * placed.snow.albedo,
    )


def _times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """int64 [N] of timestamp_ns, or t in seconds, where they are on the frames' clock."""
    column = sweep.columns.get("timestamp_ns")
    if column is not None and np.asarray(column).dtype.kind in "iu":
        times = np.asarray(column).astype(np.int64)
    else:
        column = sweep.columns.get("t")
        if column is None or np.asarray(column).dtype.kind != "f" or not np.isfinite(column).all():
            return None
        times = np.round(np.clip(column, -9e9, 9e9) * 1e9).astype(np.int64)
    near = len(times) > 0 and abs(int(np.median(times)) - frame_ns) <= _SAME_DRIVE_NS
    return times if near else None
