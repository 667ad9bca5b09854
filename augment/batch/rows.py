"""A row of the manifest: one image, finished or failed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from augment.batch.journal import Identity
from augment.batch.layout import variant_name
from augment.batch.manifest import OK
from recipes.change import found
from recipes.knobs import knobs_of
from recipes.schema import Recipe


class Pictured(NamedTuple):
    """Which image. width, height: of the written image, pixels."""

    frame: int
    camera: str
    timestamp_ns: int
    width: int
    height: int


def image_row(
    scene: str,
    recipe: Recipe,
    identity: Identity,
    pictured: Pictured,
    *,
    paths: Mapping[str, str | None],
    status: str,
    message: str = "",
    checksum: str = "",
    lidar: str | None = None,
    lidar_note: str | None = None,
) -> dict[str, Any]:
    """The row by columns. paths: by column; a failed image has none, whatever they say."""
    return {
        "scene": scene,
        "variant": variant_name(recipe),
        **pictured._asdict(),
        **(paths if status == OK else dict.fromkeys(paths)),
        **shown_words(recipe),
        "lidar": lidar,
        "lidar_note": lidar_note,
        **recipe.weather_numbers(),
        "seed": recipe.seed,
        "recipe": recipe.name,
        **vars(identity),
        "checksum": checksum,
        "status": status,
        "message": message,
    }


def shown_words(recipe: Recipe) -> dict[str, str | float | None]:
    """What a recipe says of its images beside the weather's numbers, by columns.

    settings: JSON of the values of the knobs that a quality may set (recipes.knobs) and that have
    an effect, by dotted path; None where the recipe has no quality.
    """
    words, settings = recipe.quality.words, None
    if words is not None:
        values = {knob.path: found(recipe, knob.path) for knob in knobs_of(recipe) if knob.chosen}
        settings = json.dumps(values, separators=(",", ":"))
    return {
        "surface": recipe.output.surface,
        **recipe.style_words(),
        "quality": words,
        "render_scale": recipe.render.scale,
        "settings": settings,
    }


def lidar_notes(recipes: Iterable[Recipe]) -> list[str]:
    """Where LiDAR sweeps show another world than images or depth: a line for each recipe of which
    they do, about its first such variant."""
    noted: dict[str, list[str]] = {}
    for recipe in recipes:
        note = recipe.lidar_note(recipe.lidar)
        if note is not None:
            how = "meets the weather" if recipe.lidar == "weather" else "passes through clean"
            line = f"{variant_name(recipe)}: LiDAR {how}: {note}"
            noted.setdefault(recipe.name, []).append(line)
    return [
        lines[0] + (f", and {len(lines) - 1} more likewise" if lines[1:] else "")
        for lines in noted.values()
    ]
