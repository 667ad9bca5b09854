"""A recipe's weather on a LiDAR sweep, in the order in which a beam meets it.

1. Snow ends it where it comes to the layer first: the echo is the snow's.
2. Water bends it, swallows it, or sends it away; snow under water has melted.
3. Smog, rain and snowfall dim the echo along the way through the air, there and back, and add
   their own.
4. The sensor reports the strongest echo, if that is above its noise.
"""

from __future__ import annotations

import numpy as np

from augment.effects.lidar.beam import DEFAULT_MODEL, Echoes, LidarModel, origins_of
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN
from augment.labels import LidarSweep
from augment.plan import make_plan
from augment.rng import rng_for
from augment.scene import Scene
from recipes.schema import Recipe


def weathered_sweep(
    scene: Scene,
    recipe: Recipe,
    frame_index: int,
    sweep: LidarSweep,
    *,
    model: LidarModel = DEFAULT_MODEL,
) -> LidarSweep:
    """The sweep of a frame as the recipe's weather would have let the sensor take it.

    All columns of the source, of which x, y, z and the intensity change where the weather changed
    them, and `source_index` int32, `weather_code` uint8 (see codes). The class of a return that
    moved onto the snow is still that of what lies beneath. Whole coordinates become float64, since
    lost returns have none. Thread-safe.

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
    origins = origins_of(scene, frame_index, sweep)
    echoes = Echoes.of(sweep, origins, np.asarray(scene.world_origin_m), model)
    active = plan.active(scene)
    for own in active:
        own.effect.meet(own, echoes, scene.frame(frame_index).timestamp_ns)
    for own in active:
        effect = f"lidar.{own.effect.name}"
        rng = rng_for(seed=recipe.seed, scene=scene.name, frame=frame_index, effect=effect)
        own.effect.attenuate(own, echoes, rng)
    echoes.lose_faint()
    return echoes.sweep()
