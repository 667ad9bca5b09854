"""Applies a recipe's weather to a LiDAR sweep, in the order in which a beam meets it.

1. Snow ends the beam where the beam comes to the layer first: the echo is the snow's.
2. Water bends the beam, absorbs it, or reflects it away; snow under water has melted.
3. Smog, rain and snowfall dim the echo along its path through the air, there and back, and add
   their own echoes.
4. The sensor reports the strongest echo, if that is above its noise.

Callers: jobs that mirror a data set, `climategs` commands, the viewer.
"""

from __future__ import annotations

import numpy as np

from augment.effects.lidar.beam import DEFAULT_MODEL, Echoes, LidarModel, find_beam_origins
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN
from augment.rng import rng_for
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene
from augment.view.plan import plan_at
from recipes.schema import Recipe


def weathered_sweep(
    scene: Scene,
    recipe: Recipe,
    frame_index: int,
    sweep: LidarSweep,
    *,
    model: LidarModel = DEFAULT_MODEL,
) -> LidarSweep:
    """Return the sweep of a frame as the sensor would have taken it in the recipe's weather.

    All columns of the source are kept; x, y, z and the intensity change where the weather changed
    them. Two columns are new: `source_index` int32 and `weather_code` uint8 (see codes). The class
    of a return that moved onto the snow is still that of the surface beneath. Integer coordinates
    become float64, since lost returns have none. Thread-safe.

    Args:
        scene: the scene, with its labels.
        recipe: the weather; the sweep has that of the frame's time.
        frame_index: index of the frame.
        sweep: the recorded sweep.
        model: optics of the sensor.

    Raises:
        SceneError: the weather is not possible in this scene.
        ValueError: the sweep has a column of one of the new names, or its labels' origins do not
            fit it.
    """
    for name in (CODE_COLUMN, INDEX_COLUMN):
        if name in sweep.columns:
            raise ValueError(
                f"the sweep of frame {frame_index} has a column {name!r} already: it is weathered, "
                f"or the dataset's own column must be renamed"
            )
    scene = scene.as_recorded  # the sweep shows actors where they were recorded
    recipe, plan = plan_at(recipe, scene, scene.frame(frame_index).timestamp_ns)
    origins = find_beam_origins(scene, frame_index, sweep)
    echoes = Echoes.from_sweep(sweep, origins, np.asarray(scene.world_origin_m), model)
    active_effects = plan.active_effects(scene)
    for active_effect in active_effects:
        active_effect.hooks.intersect_beams(
            active_effect, echoes, scene.frame(frame_index).timestamp_ns
        )
    for active_effect in active_effects:
        rng_key = f"lidar.{active_effect.hooks.name}"
        rng = rng_for(seed=recipe.seed, scene=scene.name, frame=frame_index, effect=rng_key)
        active_effect.hooks.attenuate_beams(active_effect, echoes, rng)
    echoes.drop_faint()
    return echoes.to_sweep()
