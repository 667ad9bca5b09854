"""The recipe section of water drops on the glass before a camera's lens."""

from __future__ import annotations

import math

from pydantic import ConfigDict, Field, model_validator
from pydantic.config import JsonDict

from recipes.effect import Column, EffectModel
from recipes.fields import PRESENT, Number, Whole

# Most drops on the part of the glass that a camera looks through.
MAX_COUNT = 500
# Largest share of a picture that drops cover: the count grows without bound towards 1.
MAX_SHARE = 0.6
# In words of JSON Schema: count and share are not both present and not null.
_ONE_NUMBER: JsonDict = {
    "not": {
        "required": ["count", "share"],
        "properties": dict.fromkeys(("count", "share"), PRESENT),
    }
}


class LensDrops(EffectModel):
    """Drops of water on the glass before the lens, out of its focus."""

    model_config = ConfigDict(json_schema_extra=_ONE_NUMBER)
    later_fields = ("share",)
    synonyms = (
        ("lens_drops", "drops raindrops droplets water_drops"),
        ("glass_m", "distance distance_m windshield_m"),
        ("wiper_s", "wiper wipers wiper_period_s"),
    )
    columns = (
        Column(
            "lens_drops_count",
            lambda drops: drops.count,
            "Drops on the lens",
            value_if_absent=0.0,
            presence_values="nonzero",
            label="lens drops",
            caption="{lens_drops_count:.0f} drops on the lens",
        ),
    )

    count: Whole | None = Field(default=None, ge=0, le=MAX_COUNT)
    """Drops on the part of the glass that the camera looks through; with a wiper, just before it
    wipes. null for as many as the recipe's rain brings, none without rain."""
    share: Number | None = Field(default=None, ge=0, le=MAX_SHARE)
    """Share of each camera's picture that lies behind drops, in place of count: the number of drops
    follows from the camera's field of view, in whole drops. Drops above 1.2 mm run out of the
    picture, and leave less."""
    radius_mm: Number = Field(default=1.0, gt=0, le=20)
    """Median radius of a drop on the glass."""
    radius_spread: Number = Field(default=0.4, ge=0, le=1.5)
    """Standard deviation of the radius's logarithm; 0 for drops of one size."""
    glass_m: Number = Field(default=0.05, ge=0.003, le=2)
    """Distance of the glass from the lens's aperture: a windscreen's, or a housing's."""
    focal_mm: Number = Field(default=6.0, ge=0.5, le=500)
    """Focal length of the lens, which is focused at infinity; the picture's angles do not follow
    it."""
    f_number: Number = Field(default=1.8, ge=0.5, le=64)
    """Focal length over the aperture's diameter: the smaller, the softer the drops."""
    wiper_s: Number | None = Field(default=None, ge=0.2, le=3600)
    """Time from one wipe to the next; null for glass that nothing wipes."""

    @model_validator(mode="after")
    def _one_number(self) -> LensDrops:
        if self.count is not None and self.share is not None:
            raise ValueError("count and share both say how many drops there are: keep one of them")
        return self

    @property
    def has_effect(self) -> bool:
        """Return False for glass without drops, which changes nothing."""
        return self.count != 0 and self.share != 0

    @property
    def mean_area_m2(self) -> float:
        """Return the mean area of a drop on the glass: that of radii of a log-normal law."""
        return math.pi * (self.radius_mm / 1000) ** 2 * math.exp(2 * self.radius_spread**2)

    @property
    def aperture_m(self) -> float:
        """Return the radius of the aperture."""
        return self.focal_mm / self.f_number / 2000
