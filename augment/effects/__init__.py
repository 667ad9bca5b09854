"""The list of all effects, in the order in which they are applied to an image.

The pipeline (`augment.view.plan`, `augment.view.render_view`) walks through EFFECTS. Other packages
may extend the list by `add_effect`.
"""

from __future__ import annotations

from dataclasses import replace

from augment.detail.prune import precompute_errors, prune_error_of
from augment.effects.effect import Effect, JobContext
from augment.effects.falling.effect import RainEffect, SnowfallEffect
from augment.effects.flood.effect import FloodEffect
from augment.effects.lamps.effect import LampsEffect
from augment.effects.lens_drops.effect import LensDropsEffect
from augment.effects.smog import SmogEffect
from augment.effects.snow.effect import SnowEffect
from augment.effects.spray.effect import SprayEffect
from augment.effects.style.effect import StyleEffect
from augment.effects.wet.effect import WetEffect
from augment.scene.pinhole_scene import pinhole_scene
from augment.scene.pinhole_views import covering_camera
from augment.scene.scene_times import scene_times
from recipes.schema import add_section, remove_section

# Effects in the order in which they are applied. Style colours the scene, and rain wets it. Then
# come the air in front of it, the snow on it, the water over it, the spray, falling rain and snow,
# the hour and its lamps, and last the drops on the camera's lens.
EFFECTS: tuple[Effect, ...] = (
    StyleEffect(),
    WetEffect(),
    SmogEffect(),
    SnowEffect(),
    FloodEffect(),
    SprayEffect(),
    RainEffect(),
    SnowfallEffect(),
    LampsEffect(),
    LensDropsEffect(),
)


def precompute_effects(context: JobContext, *, only_files: bool = False) -> None:
    """Precompute data that all images of a job share.

    The data go into the scene's memo, whose `shared()` other processes take over.

    Args:
        context: scene, recipes and cameras of the job.
        only_files: if True, only data that are kept in files are precomputed.

    Raises:
        SceneError: an effect is impossible in this scene.
        StyleError: a style cannot be used.
        RecipeError: a timeline goes beyond the scene's drive.
    """
    cameras = context.cameras
    if cameras is not None:
        cameras = [c if c.is_orthographic else covering_camera(c) for c in cameras]
    context = replace(context, scene=pinhole_scene(context.scene), cameras=cameras)
    times = scene_times(context.scene)
    recipes = [state for recipe in context.recipes for state in recipe.over_time(times)]
    context = replace(context, recipes=recipes)
    for effect in EFFECTS:
        if effect.precomputes_files or not only_files:
            effect.precompute(context)
    error = max((prune_error_of(recipe.render) for recipe in context.recipes), default=0)
    if error > 0 and not only_files:
        precompute_errors(context.scene, error, progress=context.progress)


def add_effect(effect: Effect) -> None:
    """Add an effect to the end of EFFECTS, and its section to recipes.

    Code that walks through the effects reads `augment.effects.EFFECTS` anew each time. Worker
    processes know the effect if a module that they import adds it.

    Raises:
        ValueError: there is an effect of this name already.
    """
    global EFFECTS
    if any(effect.name == known_effect.name for known_effect in EFFECTS):
        raise ValueError(f"there is an effect {effect.name!r} already")
    add_section(effect.section, effect.model)
    EFFECTS = (*EFFECTS, effect)


def remove_effect(name: str) -> None:
    """Remove an effect that `add_effect` added, and its section from recipes."""
    global EFFECTS
    (removed_effect,) = (effect for effect in EFFECTS if effect.name == name)
    remove_section(removed_effect.section)
    EFFECTS = tuple(effect for effect in EFFECTS if effect is not removed_effect)
