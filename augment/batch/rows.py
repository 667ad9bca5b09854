"""A row of the manifest: one image, finished or failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from augment.batch.journal import Identity
from augment.batch.layout import variant_name
from augment.batch.manifest import OK
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
) -> dict[str, Any]:
    """The row by columns. paths: by column; a failed image has none, whatever they say."""
    return {
        "scene": scene,
        "variant": variant_name(recipe),
        **pictured._asdict(),
        **(paths if status == OK else dict.fromkeys(paths)),
        "surface": recipe.output.surface,
        **recipe.style_words(),
        **recipe.weather_numbers(),
        "seed": recipe.seed,
        "recipe": recipe.name,
        **vars(identity),
        "checksum": checksum,
        "status": status,
        "message": message,
    }
