"""The effects, in the order in which they are applied."""

from __future__ import annotations

from augment.effects.effect import Effect, JobContext
from augment.effects.falling.effect import RainEffect, SnowfallEffect
from augment.effects.flood.effect import FloodEffect
from augment.effects.lens_drops.effect import LensDropsEffect
from augment.effects.smog import SmogEffect
from augment.effects.snow.effect import SnowEffect
from augment.effects.spray.effect import SprayEffect
from augment.effects.style.effect import StyleEffect
from augment.effects.wet.effect import WetEffect
from augment.prune import precompute_errors, prune_error_of
from recipes.schema import add_section, remove_section

# Style colours what stands in the weather, rain wets it; then come the air before it, snow on it,
# water over it, spray, what falls before all of it, and last the camera's own glass.
EFFECTS: tuple[Effect, ...] = (
    StyleEffect(),
    WetEffect(),
    SmogEffect(),
    SnowEffect(),
    FloodEffect(),
    SprayEffect(),
    RainEffect(),
    SnowfallEffect(),
    LensDropsEffect(),
)


def precompute_effects(context: JobContext, *, only_files: bool = False) -> None:
    """Precompute the data that all images of a job share, once.

    The data are then in the scene's memo. Other processes take over the memo's `shared()`.

    Args:
        context: the scene, recipes and cameras of the job.
        only_files: if True, only effects that store their data in files precompute them.

    Raises:
        SceneError, StyleError: an effect is not possible in this scene.
    """
    for effect in EFFECTS:
        if effect.precomputes_files or not only_files:
            effect.precompute(context)
    error = max((prune_error_of(recipe.render) for recipe in context.recipes), default=0)
    if error > 0 and not only_files:
        precompute_errors(context.scene, error, progress=context.progress)


def add_effect(effect: Effect) -> None:
    """Add an effect, which is applied after all others, and its section of recipes.

    Code that walks the effects reads `augment.effects.EFFECTS` each time. Worker processes know the
    effect if a module that they import adds it.

    Raises:
        ValueError: there is an effect of this name already.
    """
    global EFFECTS
    if any(effect.name == other.name for other in EFFECTS):
        raise ValueError(f"there is an effect {effect.name!r} already")
    add_section(effect.section, effect.model)
    EFFECTS = (*EFFECTS, effect)


def remove_effect(name: str) -> None:
    """Undo `add_effect`."""
    global EFFECTS
    (removed_effect,) = (effect for effect in EFFECTS if effect.name == name)
    remove_section(removed_effect.section)
    EFFECTS = tuple(effect for effect in EFFECTS if effect is not removed_effect)
