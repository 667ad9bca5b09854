"""Plan of a recipe's snow before it is laid in a scene."""

from __future__ import annotations

from dataclasses import dataclass

from augment.exposure.placement import ExposureSettings, has_invented_drive
from augment.scene.scene import Scene
from recipes.snow import Snow


@dataclass(frozen=True)
class SnowPlan:
    """Snow of one recipe."""

    snow: Snow
    seed: int  # seed of the drifts
    # Height of the flood that melts the snow it reaches, world; None without a flood.
    water_level_z_m: float | None = None


def exposure_settings(snow: Snow, scene: Scene) -> ExposureSettings:
    """Return the settings of a recipe's snow that decide where it can lie in a scene."""
    return ExposureSettings(
        cell_m=snow.cell_m,
        max_slope_deg=snow.max_slope_deg,
        has_invented_tracks=snow.tracks == "always" and has_invented_drive(scene),
    )
