"""A recipe's weather on a LiDAR sweep: the order of effects in plain sight.

A beam meets the weather in this order, and so is it worked out, once for all returns:

1. Snow ends it where it comes to the layer first: the echo is the snow's.
2. Water bends it, swallows it, or sends it away; snow under water has melted.
3. Smog dims the echo along the way through the air, there and back, and adds its own.
4. The sensor reports the strongest echo, if that is above its noise.

Every return is a row of the source and stays one; `codes` says what became of it.
"""

from __future__ import annotations

import numpy as np

from augment.labels import LidarSweep
from augment.lidar_weather.codes import (
    CODE_COLUMN,
    INDEX_COLUMN,
    LOST,
    MOVED,
    SCATTERED,
)
from augment.lidar_weather.echoes import Echoes
from augment.lidar_weather.sensors import (
    LidarModel,
    lambertian,
    origins_of,
    signal,
)
from augment.lidar_weather.smog import (
    apparent_reflectance,
    medium_for,
    optical_depth,
    scatter_before,
)
from augment.lidar_weather.snow import meet_snow, snow_in
from augment.lidar_weather.water import meet_water
from augment.plan import Plan, make_plan
from augment.rng import rng_for
from augment.scene import Scene
from augment.weather.flood import FloodMedium
from augment.weather.smog import SmogMedium
from recipes.schema import Recipe

DEFAULT_MODEL = LidarModel()
LEAST_FACING = 0.02  # cosine


def weathered_sweep(
    scene: Scene,
    recipe: Recipe,
    frame_index: int,
    sweep: LidarSweep,
    *,
    model: LidarModel = DEFAULT_MODEL,
) -> LidarSweep:
    """The sweep of a frame as the recipe's weather would have let the sensor take it.

    All columns of the source with their names, types and order, of which x, y, z and the intensity
    change where the weather changed them, and two more: `source_index` int32, `weather_code` uint8
    (see codes). Other columns say what they said: the class of a return that moved onto the snow is
    still that of what lies beneath. Coordinates of whole numbers become float64, since lost returns
    have none.

    Depends on the recipe, the scene and the frame only. Safe to call from several threads.

    Raises:
        SceneError: the weather cannot be placed in this scene. ValueError: the sweep has a column
            of one of the new names, or its labels' origins do not fit it.
    """
    for name in (CODE_COLUMN, INDEX_COLUMN):
        if name in sweep.columns:
            raise ValueError(
                f"the sweep of frame {frame_index} has a column {name!r} already: it is weathered, "
                f"or the dataset's own column must be renamed"
            )
    plan = make_plan(recipe, scene)
    echoes = Echoes.of(
        sweep, origins_of(scene, frame_index, sweep), np.asarray(scene.world_origin_m), model
    )
    if plan.snow is not None:
        _meet_snow(echoes, scene, plan, sweep, scene.frame(frame_index).timestamp_ns)
    if plan.flood is not None:
        _meet_water(echoes, plan.flood)
    if plan.smog is not None:
        rng = rng_for(seed=recipe.seed, scene=scene.name, frame=frame_index, effect="lidar.smog")
        _meet_smog(echoes, medium_for(plan.smog, model), model, rng)
    echoes.lose_what_is_too_faint(model)
    return echoes.sweep()


def _meet_snow(echoes: Echoes, scene: Scene, plan: Plan, sweep: LidarSweep, frame_ns: int) -> None:
    assert plan.snow is not None
    snow = snow_in(scene, plan.snow)
    ranges = echoes.ranges_m
    hits = meet_snow(snow, scene, sweep, frame_ns, echoes.origins, echoes.directions, ranges)
    rows = np.flatnonzero(hits < ranges)
    # The layer counts as level, but its grains stand out: no beam slides over it unreflected.
    facing = np.maximum(np.abs(echoes.directions[rows, 2]), LEAST_FACING)
    echoes.replace(rows, hits[rows], lambertian(snow.reflectance, facing), MOVED)


def _meet_water(echoes: Echoes, medium: FloodMedium) -> None:
    """A sensor under water sees nothing: its light ends within centimetres."""
    drowned = echoes.origins[:, 2] <= medium.level_z_m
    echoes.lose(drowned & (echoes.ranges_m > 0))
    ends = np.where(drowned, 0.0, echoes.ranges_m)
    water = meet_water(medium, echoes.origins, echoes.directions, ends, echoes.reflectance)
    bed, mud = water.is_bed, ~water.is_bed
    echoes.see_through(water.rows[bed], water.range_m[bed], water.surface_m[bed], water.kept[bed])
    echoes.replace(water.rows[mud], water.surface_m[mud], water.reflectance[mud], SCATTERED)


def _meet_smog(
    echoes: Echoes, medium: SmogMedium, model: LidarModel, rng: np.random.Generator
) -> None:
    eyes_z, air = echoes.origins[:, 2], echoes.air_m
    tau = optical_depth(medium, air, eyes_z, eyes_z + air * echoes.directions[:, 2])
    echoes.gain *= np.exp(-2 * tau)
    scatter = scatter_before(medium, eyes_z, air, model, rng)
    echo = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))
    wins = (scatter.signal > echo) & (echoes.ranges_m > 0) & (echoes.codes != LOST)
    rows = np.flatnonzero(wins)
    ranges = scatter.ranges_m[rows]
    apparent = apparent_reflectance(scatter.signal[rows], ranges)
    echoes.replace(rows, ranges, apparent, SCATTERED)
