"""Plan of a recipe's snow before it is laid in a scene."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

from augment.errors import SceneError
from augment.exposure.search import ExposureSettings
from augment.exposure.tiles import TooManyCellsError
from augment.exposure.wheel_tracks import has_recorded_drive
from augment.scene.scene import Scene
from recipes.snow import Snow


@dataclass(frozen=True)
class SnowPlan:
    """Snow of one recipe."""

    snow: Snow
    seed: int  # seed of the drifts
    # Height of the flood that melts the snow it reaches, world; None without a flood.
    water_level_z_m: float | None = None
    # True if rain wets the ground, so that the bare road in tracks is wet already.
    has_wet_ground: bool = False


def exposure_settings(snow: Snow, scene: Scene) -> ExposureSettings:
    """Return the settings of a recipe's snow that decide where it can lie in a scene."""
    return ExposureSettings(
        cell_m=snow.cell_m,
        max_slope_deg=snow.max_slope_deg,
        has_tracks_without_drive=snow.tracks == "always" and not has_recorded_drive(scene),
    )


@contextlib.contextmanager
def naming_cell_field() -> Iterator[None]:
    """Add the recipe's field to the error of an exposed surface with too many cells."""
    try:
        yield
    except TooManyCellsError as error:
        raise SceneError(f"{error}; weather.snow.cell_m sets the size of the cells") from error
