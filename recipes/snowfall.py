"""The recipe section of falling snow."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from recipes.effect import Column, EffectModel
from recipes.fields import Angle, Colour, Number, Unit
from recipes.moment import Moment
from recipes.rain import MAX_WIND_MPS, OVERCAST_MM_H
from recipes.shower import MAX_FRONT_MPS, MAX_PLACES, Along, check_along, with_shower

# Largest rate of snowfall, as water: more than half a metre of snow an hour.
MAX_SNOWFALL_MM_H = 50.0


class Snowfall(EffectModel):
    """Snow in the air: flakes near the camera, a white veil beyond; what lies is `snow`."""

    later_fields = ("shadow_fade", "gloss_fade", "front_mps", "along", "peak_mm_h")
    synonyms = (("rate_mm_h", "snow_rate snowfall_rate"), ("turbulence_mps", "turbulence gusts"))
    columns = (
        Column(
            "snowfall_rate_mm_h",
            lambda snowfall: snowfall.rate_mm_h,
            "Snowfall",
            "mm/h",
            value_if_absent=0.0,
            presence_values="nonzero",
            label="snowfall",
            caption="snowfall {snowfall_rate_mm_h:.3g} mm/h",
        ),
    )

    rate_mm_h: Number = Field(ge=0, le=MAX_SNOWFALL_MM_H)
    """Water that falls as snow, about a tenth of the fresh snow's depth: light below 1, heavy above
    2.5."""
    wind_mps: Number = Field(default=0.0, ge=0, le=MAX_WIND_MPS)
    """Speed of the wind, which the flakes have too."""
    wind_from_deg: Angle = 0.0
    """Where the wind comes from: 0 is world +x, 90 is +y."""
    turbulence_mps: Number = Field(default=0.3, ge=0, le=5)
    """Speed of eddies that the flakes follow, and of their own flutter."""
    color: Colour | None = None
    """Colour of the far veil, display-encoded sRGB; null for the sky's above the horizon."""

    front_mps: Number | None = Field(default=None, gt=0, le=MAX_FRONT_MPS)
    """Speed over the ground at which a shower passes, from where the wind comes; rate_mm_h is then
    the rate at the drive's first camera; null for a rate that is the same everywhere."""
    along: Along | None = Field(default=None, min_length=1, max_length=MAX_PLACES)
    """Rates along the way of a shower; null follows from the rate's course and front_mps."""
    peak_mm_h: Number | None = Field(default=None, ge=0, le=MAX_SNOWFALL_MM_H)
    """Largest rate of the weather's course, whose flakes the others are a share of, so that flakes
    last from image to image; null follows from the rate's course."""

    shadow_fade: Unit | None = None
    """How much of the ground's cast shadows goes, since clouds that snow hide the sun: 1 all, 0
    none; null follows from the rate, and is all but in the lightest flurries."""
    gloss_fade: Unit | None = None
    """How much of the blue that glossy surfaces mirror of a clear sky turns grey: 1 all, 0 none;
    null follows from the rate, and is all but in the lightest flurries."""

    @model_validator(mode="after")
    def _along_in_order(self) -> Snowfall:
        check_along(self.along)
        return self

    def state_at(self, path: str, moment: Moment) -> Snowfall:
        return with_shower(self, path, moment, OVERCAST_MM_H)

    @property
    def sun_fade(self) -> float:
        """Return the share of the sun's light that the clouds take, 0 to 1."""
        if self.shadow_fade is not None:
            return self.shadow_fade
        return -math.expm1(-self.rate_mm_h / OVERCAST_MM_H)

    @property
    def blue_fade(self) -> float:
        """Return how much of the blue sky in glossy surfaces turns grey, 0 to 1."""
        if self.gloss_fade is not None:
            return self.gloss_fade
        return -math.expm1(-self.rate_mm_h / OVERCAST_MM_H)

    @property
    def has_effect(self) -> bool:
        """Return False for snowfall without a rate, which changes nothing."""
        return self.rate_mm_h > 0 or any(place.rate_mm_h > 0 for place in self.along or ())
