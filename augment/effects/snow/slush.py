"""Dirty and driven snow on a road: its depth, its colour, and the bare wet road in the tracks.

Input: depths of fresh snow on the ground's cells, the traces of traffic (`traffic.RoadWear`), the
recipe's `dirt` and `traffic`, and noise. Output: `RoadSnow`. Callers: `layer` and `lidar`.

The first wheels flatten the snow. After some more the road is bare and wet, with ragged edges, and
slush lies in ridges beside and between the tracks. Salt and scrapers leave less than fell on all of
a busy road. Soot and grit darken the snow: most of it where wheels splash, in the ridges and along
the kerb, a little on all of the road, and some beside it within a metre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from augment.effects.gradient_noise import Octaves, draw_octaves, sum_octaves
from augment.effects.snow.layer_kernels import MIN_DEPTH_M, CellDepths
from augment.effects.snow.plan import SnowPlan
from augment.effects.snow.traffic import SATURATION, RoadWear, find_road_wear
from augment.exposure.cells import ExposedCells
from augment.exposure.wheel_tracks import WheelPath, find_wheel_paths
from augment.memo import memo_of
from augment.rng import rng_for
from augment.scene.scene import Scene
from recipes.snow import Snow

# ---- Depth ---------------------------------------------------------------------------------------

PRESSED_SHARE = 0.8  # share of the depth that passing wheels take
SCRAPED_SHARE = 0.4  # share of the depth that a traffic of 1 takes on all of the road
# Passes after which the road is bare, of thin snow, and further ones per metre of depth.
BARING_PASSES = 1.8
BARING_PASSES_PER_M = 16.0
BARE_SCATTER = 0.42  # change of that number per deviation of the noise
MAX_RIDGE_M = 0.035  # largest height of a ridge of slush
RIDGE_SHARE = 0.9  # height of a ridge in the depth of the snow
LUMPINESS = 0.45  # change of a ridge's height per deviation of the lumps' noise
# Octaves of the noises: (lattice step in metres, standard deviation).
# Noises but those of lumps are stretched along the road, by these factors each way.
_EDGE_STRETCH = 1.9
_BLOTCH_STRETCH = 1.5
_EDGE_OCTAVES = ((1.9, 0.45), (0.6, 0.6), (0.24, 0.66))  # ragged edges of bare tracks
_LUMP_OCTAVES = ((0.34, 0.75), (0.16, 0.66))  # lumps of slush
_BLOTCH_OCTAVES = ((3.1, 0.6), (0.9, 0.6), (0.33, 0.53))  # blotches of dirt

# ---- Colour --------------------------------------------------------------------------------------

# Factors of the display-encoded colour of clean snow, for the dirtiest snow (a linear reflectance
# of about 0.27, old city snow) and for slush, which is wet.
_DIRTIEST_TINT = (0.60, 0.58, 0.55)
_SLUSH_TINT = (0.70, 0.705, 0.71)
_PACKED_TINT = (0.86, 0.865, 0.875)
_ROAD_DIRT = 0.28  # dirt on all of the road's snow
_SPLASH_DIRT = 0.55  # further dirt where wheels splash
_RIDGE_DIRT = 0.45  # further dirt in ridges of slush
_KERB_DIRT = 0.5  # further dirt at the kerb, falling off within _KERB_WIDTH_M
_KERB_WIDTH_M = 0.5
_VERGE_DIRT = 0.6  # dirt beside the road, falling off within _VERGE_WIDTH_M
_VERGE_WIDTH_M = 0.45
_MAX_VERGE_M = 1.5  # distance from the road beyond which no dirt lies
_BLOTCHINESS = 0.38  # relative change of dirt per deviation of the blotches' noise
WET_PASSES = (1.2, 3.5)  # passes between which a bare road gets wet through
_LEAST_TRAFFIC = 0.35  # traffic whose splashes dirty the snow, where the recipe has less


@dataclass(frozen=True, eq=False)
class RoadSnow:
    """Snow on C cells of the ground, changed by traffic and dirt."""

    depths: CellDepths
    """Depths; 0 where the road is bare."""
    tints: np.ndarray
    """float32 [C, 3], factors of the display-encoded colour of clean snow."""
    wetness: np.ndarray
    """float32 [C], wetness of the bare road in the tracks, 0 to 1; 0 under snow."""


class RoadNoises(NamedTuple):
    """Noises of one recipe."""

    edges: Octaves
    lumps: Octaves
    blotches: Octaves


class Traces(NamedTuple):
    """Traces of a recipe's traffic."""

    wear: RoadWear  # of the cars that press the snow
    splashing_wear: RoadWear  # of the cars that splash dirt
    noises: RoadNoises


def road_snow(
    depths: CellDepths, cells: ExposedCells, scene: Scene, recipe_snow: SnowPlan
) -> RoadSnow | None:
    """Return the snow on the ground with the traces of traffic and dirt; None without these.

    Args:
        depths: snow as it fell.
        cells: cells of the ground.
        scene: the scene.
        recipe_snow: snow of a recipe.
    """
    snow = recipe_snow.snow
    traces = find_traces(cells, scene, recipe_snow)
    if traces is None:
        return None
    if snow.traffic > 0:
        depths, wetness = driven_depths(depths, cells, traces.wear, snow.traffic, traces.noises)
    else:
        wetness = np.zeros(len(cells), np.float32)
    return RoadSnow(depths, road_tints(depths, cells, traces, snow), wetness)


def find_traces(cells: ExposedCells, scene: Scene, recipe_snow: SnowPlan) -> Traces | None:
    """Return the traces of a recipe's traffic and dirt on the ground; None without these.

    Args:
        cells: cells of the ground.
        scene: the scene.
        recipe_snow: snow of a recipe.
    """
    snow = recipe_snow.snow
    if not snow.has_traces or not len(cells):
        return None
    seed = recipe_snow.seed

    def find_wear() -> tuple[RoadWear, RoadWear, float]:
        """Return the traces of pressing and of splashing cars, and the direction of the path."""
        paths = find_wheel_paths(scene, has_path_without_drive=snow.tracks == "always")
        splashing = max(snow.traffic, _LEAST_TRAFFIC)
        wears = {
            traffic: find_road_wear(cells, paths, traffic=traffic, seed=seed, scene_name=scene.name)
            for traffic in {snow.traffic, splashing}
        }
        return wears[snow.traffic], wears[splashing], _heading_rad(paths)

    key = ("road wear", scene.name, snow.traffic, snow.tracks == "always", seed)
    wear, splashing_wear, heading_rad = memo_of(cells).get(key, find_wear)
    across_rad = heading_rad + math.pi / 2
    rng = rng_for(seed=seed, scene=scene.name, effect="snow.slush")
    noises = RoadNoises(
        draw_octaves(_EDGE_OCTAVES, rng, direction_rad=across_rad, stretch=_EDGE_STRETCH),
        draw_octaves(_LUMP_OCTAVES, rng),
        draw_octaves(_BLOTCH_OCTAVES, rng, direction_rad=across_rad, stretch=_BLOTCH_STRETCH),
    )
    return Traces(wear, splashing_wear, noises)


def _heading_rad(paths: Sequence[WheelPath]) -> float:
    """Return the direction of the first path as a whole; 0 without paths."""
    if not paths:
        return 0.0
    displacement_m = paths[0].points_m[-1] - paths[0].points_m[0]
    return math.atan2(displacement_m[1], displacement_m[0])


def driven_depths(
    depths: CellDepths, cells: ExposedCells, wear: RoadWear, traffic: float, noises: RoadNoises
) -> tuple[CellDepths, np.ndarray]:
    """Return the depths of snow that cars have driven over, and the wetness of bare road [C]."""
    fresh_m = depths.depths_m
    new_m = fresh_m.copy()
    wetness = np.zeros(len(fresh_m), np.float32)
    rows = np.flatnonzero(wear.is_road & (fresh_m > 0))
    if not len(rows):
        return depths, wetness
    x_m, y_m, sizes_m = _places(cells, rows)
    passes = wear.passes[rows].astype(np.float64)
    fresh = fresh_m[rows].astype(np.float64)
    edges = sum_octaves(noises.edges, x_m, y_m, sizes_m)
    lumps = sum_octaves(noises.lumps, x_m, y_m, sizes_m)
    pressed = 1 - np.exp(-passes / SATURATION)
    depth = fresh * (1 - SCRAPED_SHARE * traffic) * (1 - PRESSED_SHARE * pressed)
    ridge_m = np.minimum(RIDGE_SHARE * fresh, MAX_RIDGE_M)
    depth += ridge_m * wear.ridge[rows] * np.maximum(1 + LUMPINESS * lumps, 0)
    baring = (BARING_PASSES + BARING_PASSES_PER_M * fresh) * np.exp(BARE_SCATTER * edges)
    is_bare = passes > baring
    depth = np.where(is_bare, 0.0, np.maximum(depth, np.minimum(fresh, MIN_DEPTH_M)))
    new_m[rows] = depth
    first, full = WET_PASSES
    wetness[rows] = np.where(is_bare, np.clip((passes - first) / (full - first), 0, 1), 0)
    return depths._replace(depths_m=new_m), wetness


def road_tints(depths: CellDepths, cells: ExposedCells, traces: Traces, snow: Snow) -> np.ndarray:
    """Return the factors of the colour of clean snow, float32 [C, 3].

    Args:
        depths: the snow.
        cells: cells of the ground.
        traces: traces of traffic.
        snow: the recipe's snow.
    """
    wear, splashing_wear, noises = traces
    tints = np.ones((len(cells), 3))
    covered = depths.depths_m > 0
    rows = np.flatnonzero(covered & (wear.kerb_m > -_MAX_VERGE_M))
    if not len(rows):
        return tints.astype(np.float32)
    x_m, y_m, sizes_m = _places(cells, rows)
    is_road = wear.is_road[rows]
    kerb_m = wear.kerb_m[rows].astype(np.float64)
    pressed = 1 - np.exp(-wear.passes[rows].astype(np.float64) / SATURATION)
    ridge = wear.ridge[rows].astype(np.float64)
    tint = 1 - pressed[:, None] * (1 - np.array(_PACKED_TINT))
    slush = np.clip(ridge, 0, 1) * min(1.0, 2 * snow.traffic)
    tint *= 1 - slush[:, None] * (1 - np.array(_SLUSH_TINT))
    if snow.dirt > 0:
        blotches = sum_octaves(noises.blotches, x_m, y_m, sizes_m)
        splash = np.clip(splashing_wear.splash[rows].astype(np.float64), 0, 1)
        at_kerb = np.exp(-((np.maximum(kerb_m, 0) / _KERB_WIDTH_M) ** 2))
        on_road = _ROAD_DIRT + _SPLASH_DIRT * np.sqrt(splash) + _KERB_DIRT * at_kerb
        on_road += _RIDGE_DIRT * np.clip(splashing_wear.ridge[rows], 0, 1)
        beside = _VERGE_DIRT * np.exp(np.minimum(kerb_m, 0) / _VERGE_WIDTH_M)
        amount = np.where(is_road, on_road, beside) * np.exp(_BLOTCHINESS * blotches)
        amount = np.clip(snow.dirt * amount, 0, 1)
        tint *= 1 - amount[:, None] * (1 - np.array(_DIRTIEST_TINT))
    tints[rows] = tint
    return tints.astype(np.float32)


def _places(cells: ExposedCells, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and sides of cells, float64 [N] each."""
    centers = cells.centers_m.numpy()[rows].astype(np.float64)
    return centers[:, 0], centers[:, 1], cells.sizes_m.numpy()[rows].astype(np.float64)
