"""What a recipe may say of rain."""

from __future__ import annotations

from pydantic import Field

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Angle, Colour, Flag, Number

MAX_RATE_MM_H = 300.0  # the hour's record of most cities is below
MAX_WIND_MPS = 60.0


class Rain(EffectModel):
    """Rain in the air: drops that streak near the camera and veil what is far."""

    meant_by = (
        ("rate_mm_h", "rain_rate mm_h mm_per_hour"),
        ("wind_mps", "wind_speed"),
        ("wind_from_deg", "wind_direction wind_deg"),
    )
    knobs = (Knob("min_width_px", (1.0, 0.5, 0.25), "drops drawn one by one; the rest is veil", 7),)
    columns = (
        Column(
            "rain_rate_mm_h",
            lambda it: it.rate_mm_h,
            "Rain",
            "mm/h",
            absent=0.0,
            shows="nonzero",
            label="rain",
            caption="rain {rain_rate_mm_h:.3g} mm/h",
        ),
    )

    rate_mm_h: Number = Field(ge=0, le=MAX_RATE_MM_H)
    """Water that falls on level ground: drizzle below 1, moderate rain 2.5 to 10, heavy to 50."""
    wind_mps: Number = Field(default=0.0, ge=0, le=MAX_WIND_MPS)
    """Speed of the wind, which the drops have too."""
    wind_from_deg: Angle = 0.0
    """Where the wind comes from: 0 is world +x, 90 is +y."""
    color: Colour | None = None
    """Colour of the far veil, display-encoded sRGB; null for the sky's above the horizon."""
    min_width_px: Number = Field(default=0.25, ge=0.1, le=16)
    """Drops are drawn one by one up to where they are this wide, pixels of the rendered picture;
    farther ones are the veil."""

    spray: Flag = True
    """Vehicles that drive faster than 40 km/h lift spray, by their speed and the water on the
    road."""

    @property
    def changes(self) -> bool:
        """Rain without a rate changes nothing."""
        return self.rate_mm_h > 0
