"""What a recipe may say of snow that lies on the ground."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recipes.types import Closed, Number, Unit, Whole


class SnowLight(Closed):
    """The light on the snow; null leaves a field to what the scene's sky and ground show."""

    sun_azimuth_deg: Number | None = Field(
        default=None,
        ge=-360,
        le=360,
        description="Where the sun stands: 0 is world +x, 90 is +y; null for the brightest part "
        "of the sky.",
    )
    sun_elevation_deg: Number | None = Field(
        default=None,
        ge=0,
        le=90,
        description="The sun's height above the horizon; null for the brightest part of the sky.",
    )
    sun: Number | None = Field(
        default=None,
        ge=0,
        le=1,
        description="How much of the light comes from the sun: 0 overcast, 1 a clear day; null "
        "for what the sky's contrast suggests.",
    )
    brightness: Number | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Display-encoded brightness of snow of albedo 0.85 that faces the light; null "
        "for what the scene's ground suggests.",
    )


class SnowWind(Closed):
    """The wind that the snow fell with."""

    direction_deg: Number = Field(
        default=0.0, ge=-360, le=360, description="Where it blows to: 0 is world +x, 90 is +y."
    )
    drift: Unit = Field(
        default=0.3,
        description="How uneven the wind left the layer: 0 is level but for its grain, 1 has "
        "ridges across the wind and banks before obstacles.",
    )


class Snow(Closed):
    """Snow lying on what is open to the sky: ground, roofs, vehicles."""

    depth_m: Number = Field(ge=0, le=10, description="Depth of the layer on level ground.")
    coverage: Unit = Field(
        default=1.0, description="Share of the open surface that is covered; below 1 in patches."
    )
    max_slope_deg: Number = Field(
        default=50.0, ge=0, le=85, description="Snow lies on no surface steeper than this."
    )
    albedo: Unit = Field(default=0.85, description="Share of the light that the snow gives back.")
    grain: Unit = Field(
        default=0.5, description="Unevenness of the size of the splats: 0 smooth, 1 coarse."
    )
    sparkle: Unit = Field(default=0.0, description="How many crystals glint at the sun; 0 is none.")
    tracks: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="Packed grey wheel tracks where the ego and the scene's vehicles drive; auto "
        "up to a depth of 0.3 m.",
    )
    light: SnowLight = SnowLight()
    wind: SnowWind = SnowWind()
    shading: Literal["per_splat", "per_pixel"] = Field(
        default="per_splat",
        description="Lit by one normal a splat, or by one a pixel of every splat.",
    )
    cell_m: Number = Field(
        default=0.05,
        ge=0.001,
        le=10,
        description="Size of the splats near the path; they grow with the distance from it.",
    )
    seed: Whole | None = Field(
        default=None,
        ge=0,
        lt=2**63,
        description="What drifts, patches and grain are drawn from; null for the recipe's seed.",
    )

    @property
    def lies(self) -> bool:
        """Whether there is any: snow without depth or coverage changes nothing."""
        return self.depth_m > 0 and self.coverage > 0
