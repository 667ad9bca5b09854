"""Sources of lamps: how many lamps each adds to a view, and recipes without it, for `explain`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from augment.effects.lamps.plan import LightPlan
from augment.effects.lamps.scene_exposure import exposure_of
from augment.effects.lamps.view_lamps import lamps_of_view
from augment.lamps.lamp import LampKind
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.schema import Recipe

# Fields of the section that turn a source off, with the value that does, by the source's name.
SOURCES = {
    "lamps of vehicles": ("vehicles", "off"),
    "own beams": ("own_beams", "off"),
    "street lamps": ("street", "off"),
    "lamps of the recipe": ("lamps", None),
}


def count_lamps(plan: LightPlan, scene: Scene, camera: Camera) -> dict[str, dict[str, int]]:
    """Return the number of lamps of each kind that light a view, by source.

    Args:
        plan: the plan.
        scene: the scene.
        camera: the view.
    """
    light = plan.light.model_copy(update={"lamps": None})
    dark = replace(
        plan, light=light, has_vehicle_lamps=False, own_beam="off", has_street_lamps=False
    )
    plans = (
        replace(dark, has_vehicle_lamps=plan.has_vehicle_lamps),
        replace(dark, own_beam=plan.own_beam),
        replace(dark, has_street_lamps=plan.has_street_lamps),
        replace(dark, light=plan.light),
    )
    counts: dict[str, dict[str, int]] = {}
    for name, plan_of_source in zip(SOURCES, plans, strict=True):
        kinds, numbers = np.unique(
            lamps_of_view(plan_of_source, scene, camera).kinds, return_counts=True
        )
        counts[name] = {
            LampKind(kind).name.lower(): int(number)
            for kind, number in zip(kinds, numbers, strict=True)
        }
    return counts


def without_sources(plan: LightPlan, scene: Scene, recipe: Recipe) -> dict[str, Recipe]:
    """Return recipes that each lack one source of lamps, in the exposure that all of them give.

    Args:
        plan: the plan of the recipe.
        scene: the scene.
        recipe: the recipe.
    """
    exposure: dict[str, object] = {}
    if plan.hour.is_dark:
        metered = exposure_of(plan, scene)
        exposure = {"exposure": "fixed", "exposure_ms": metered.exposure_ms, "iso": metered.iso}
    recipes = {}
    for name, (field, value) in SOURCES.items():
        if getattr(plan.light, field) == value:
            continue
        light = plan.light.model_copy(update={**exposure, field: value})
        recipes[name] = recipe.model_copy(update={"light": light})
    return recipes
