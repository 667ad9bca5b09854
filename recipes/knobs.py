"""The knobs that trade speed for accuracy: every field of a recipe that does, with its values.

What each value costs and saves is measured by `climategs bench trade`; docs/trade.md has figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel

from recipes.change import changed, found, is_given
from recipes.quality import TIERS

Recipe = TypeVar("Recipe", bound=BaseModel)  # recipes.schema.Recipe, which is made with this table
Value = float | int | str | bool | None


@dataclass(frozen=True)
class Knob:
    """One field. path: dotted. values: from the fastest to the most accurate, which is reference.
    effect: dotted path of the section without which it is of no effect; '' for none. chosen:
    whether a tier or a target may set it; else it is only measured: it says what is written, which
    is the user's to say, or has no value that saves time. what: of which error and which time, in
    a few words.
    """

    path: str
    values: tuple[Value, ...]
    what: str
    effect: str = ""
    chosen: bool = True

    @property
    def reference(self) -> Value:
        return self.values[-1]


# Those that save most come first: they have first call on an error that is allowed.
KNOBS = (
    Knob(
        "render.scale",
        (0.25, 0.5, 0.75, 1.0),
        "resolution, enlarged again for the comparison",
    ),
    Knob(
        "weather.flood.reflection",
        ("sky", "screen_space", "mirrored"),
        "what water reflects",
        effect="weather.flood",
    ),
    Knob(
        "weather.snow.cell_m",
        (0.2, 0.1, 0.05),
        "size of the snow's splats near the path",
        effect="weather.snow",
    ),
    Knob(
        "weather.snow.shading",
        ("per_splat", "per_pixel"),
        "light on the snow",
        effect="weather.snow",
    ),
    Knob(
        "render.radius_clip_px",
        (3.0, 2.0, 1.0, 0.0),
        "splats no larger are left out",
    ),
    Knob(
        "render.transmittance_stop",
        (0.05, 0.01, 1e-3, 1e-4),
        "light behind it is given up",
    ),
    Knob(
        "render.sh_degree",
        (0, 1, 2, None),
        "bands of the colours' spherical harmonics",
    ),
    Knob(
        "weather.flood.waves.count",
        (6, 12, 24),
        "waves that make up the surface",
        effect="weather.flood",
    ),
    Knob(
        "weather.flood.fresnel",
        ("schlick", "exact"),
        "share of reflected light",
        effect="weather.flood",
    ),
    Knob(
        "style.evaluated",
        ("sh", "color"),
        "map folded into the scene or put on each colour",
        effect="style",
    ),
    # Smog on buffers saves nothing here, whatever it costs.
    Knob(
        "weather.smog.model",
        ("deferred", "per_gaussian"),
        "smog on buffers or on splats",
        effect="weather.smog",
        chosen=False,
    ),
    Knob(
        "output.depth",
        ("none", "expected", "median", "mode"),
        "depth estimator",
        chosen=False,
    ),
    Knob(
        "output.jpeg_quality",
        (60, 75, 92, 100),
        "size and error of jpg files",
        chosen=False,
    ),
)
BY_PATH = {knob.path: knob for knob in KNOBS}


def knobs_of(recipe: BaseModel) -> tuple[Knob, ...]:
    """The knobs that have an effect on the recipe's pictures or files."""
    return tuple(knob for knob in KNOBS if _has_effect(knob, recipe))


def free_knobs(recipe: BaseModel) -> tuple[Knob, ...]:
    """Those of them that a tier or a target may set: the recipe does not give their field."""
    return tuple(k for k in knobs_of(recipe) if k.chosen and not is_given(recipe, k.path))


def settings_of(recipe: BaseModel) -> dict[str, Value]:
    """The values of its knobs, by path."""
    return {knob.path: found(recipe, knob.path) for knob in knobs_of(recipe)}


def with_settings(recipe: Recipe, settings: Mapping[str, Value]) -> Recipe:
    """The recipe with some knobs set, which count as given from then on.

    Raises:
        ValueError: the schema refuses a value.
    """
    return changed(recipe, settings)


def tier_settings(recipe: BaseModel, tier: str) -> dict[str, Value]:
    """What a tier sets of this recipe: of its free knobs."""
    chosen: Mapping[str, Value] = TIERS.get(tier, {})
    return {knob.path: chosen.get(knob.path, knob.reference) for knob in free_knobs(recipe)}


def as_reference(recipe: Recipe) -> Recipe:
    """The recipe with all its knobs that a tier may set at reference, given or not."""
    return with_settings(recipe, {k.path: k.reference for k in knobs_of(recipe) if k.chosen})


def _has_effect(knob: Knob, recipe: BaseModel) -> bool:
    section: Any = found(recipe, knob.effect) if knob.effect else recipe
    if section is None:
        return False
    if knob.path == "weather.flood.waves.count":
        waves = found(recipe, "weather.flood.waves")
        return bool(waves.components is None and waves.preset != "still" and waves.height > 0)
    if knob.path == "style.evaluated":
        return bool(found(recipe, "style.applied_to") == "scene")
    if knob.path == "output.jpeg_quality":
        return bool(found(recipe, "output.image") == "jpg")
    return True
