"""The recipe section of snow that lies on the ground."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Angle, ClosedModel, Number, Unit, Whole


class SnowLight(ClosedModel):
    """The light on the snow; null leaves a field to what the scene's sky and ground show."""

    sun_azimuth_deg: Number | None = Field(default=None, ge=-360, le=360)
    """Where the sun stands: 0 is world +x, 90 is +y; null for the brightest part of the sky."""
    sun_elevation_deg: Number | None = Field(default=None, ge=0, le=90)
    """The sun's height above the horizon; null for the brightest part of the sky."""
    sun: Number | None = Field(default=None, ge=0, le=1)
    """How much of the light comes from the sun: 0 overcast, 1 a clear day; null for what the sky's
    contrast suggests."""
    brightness: Number | None = Field(default=None, ge=0, le=1)
    """Display-encoded brightness of snow of albedo 0.85 that faces the light; null for what the
    scene's ground suggests."""


class SnowWind(ClosedModel):
    """The wind that the snow fell with."""

    direction_deg: Angle = 0.0
    """Where it blows to: 0 is world +x, 90 is +y."""
    drift: Unit = 0.3
    """How uneven the wind left the layer: 0 is level but for its grain, 1 has ridges across the
    wind and banks before obstacles."""


class Snow(EffectModel):
    """Snow lying on what is open to the sky: ground, roofs, vehicles."""

    later_fields = ("dirt", "traffic", "shadow_fade", "gloss_fade")
    synonyms = (
        ("depth_m", "level level_m height height_m thickness thickness_m"),
        ("coverage", "cover"),
        ("max_slope_deg", "slope_deg"),
        ("sparkle", "glitter"),
        ("albedo", "reflectance"),
        ("sun_azimuth_deg", "azimuth azimuth_deg"),
        ("sun_elevation_deg", "elevation elevation_deg"),
        ("drift", "drifts"),
        ("dirt", "dirty soot grit"),
        ("traffic", "cars slush"),
    )
    knobs = (
        Knob("cell_m", (0.2, 0.1, 0.05), "size of the snow's splats near the path", 2),
        Knob("shading", ("per_splat", "per_pixel"), "light on the snow", 3),
    )
    columns = (
        Column(
            "snow_depth_m",
            lambda snow: snow.depth_m,
            "Snow depth",
            "cm",
            presence_values="nonzero",
            factor=100,
            label="snow",
            caption="snow {snow_depth_m:.3g} cm",
        ),
        Column(
            "snow_coverage",
            lambda snow: snow.coverage,
            "Snow coverage",
            presence_values="nonzero",
            linear=True,
        ),
    )

    depth_m: Number = Field(ge=0, le=10)
    """Depth of the layer on level ground."""
    coverage: Unit = 1.0
    """Share of the open surface that is covered; below 1 in patches."""
    max_slope_deg: Number = Field(default=50.0, ge=0, le=85)
    """Snow lies on no surface steeper than this."""
    albedo: Unit = 0.85
    """Share of the light that the snow gives back."""
    grain: Unit = 0.5
    """Unevenness of the snow from splat to splat, and near the camera from pixel to pixel: 0
    smooth, 1 coarse."""
    sparkle: Unit = 0.0
    """How many crystals glint at the sun; 0 is none."""
    tracks: Literal["auto", "always", "never"] = "auto"
    """Packed grey wheel tracks where the ego and the scene's vehicles drive; auto up to a depth of
    0.3 m, and not along a drive that is invented for a splat file without cameras."""
    light: SnowLight = SnowLight()
    shadow_fade: Unit | None = None
    """How much of the cast shadows goes on ground that no snow covers: 1 all, 0 none; null follows
    from light.sun: all where that is 0, none where it is 1 or null."""
    gloss_fade: Unit | None = None
    """How much of the blue that glossy surfaces mirror of a clear sky turns grey: 1 all, 0 none;
    null follows from light.sun: all where that is 0, none where it is 1 or null."""
    wind: SnowWind = SnowWind()
    shading: Literal["per_splat", "per_pixel"] = "per_splat"
    """Lit by one normal a splat, or by one a pixel of every splat."""
    cell_m: Number = Field(default=0.05, ge=0.001, le=10)
    """Size of the splats near the path; they grow with the distance from it."""
    seed: Whole | None = Field(default=None, ge=0, lt=2**63)
    """What drifts, patches and grain are drawn from; null for the recipe's seed."""
    dirt: Unit = 0.0
    """Soot and grit in the snow on and beside roads: 0 clean, 1 the grey-brown of old city snow."""
    traffic: Unit = 0.0
    """Cars that have driven since it snowed, in all lanes: 0 none but those of the scene, 0.3 some
    grey tracks, 0.6 bare wet tracks with slush between them, 1 a busy road."""

    @property
    def has_effect(self) -> bool:
        """Return False for snow without depth or coverage, which changes nothing."""
        return self.depth_m > 0 and self.coverage > 0

    @property
    def has_traces(self) -> bool:
        """Return True if dirt or traffic change the snow on roads."""
        return self.dirt > 0 or self.traffic > 0

    @property
    def sun_fade(self) -> float:
        """Return the share of the sun's light that the recipe's sky takes, 0 to 1."""
        if self.shadow_fade is not None:
            return self.shadow_fade
        return 0.0 if self.light.sun is None else 1.0 - self.light.sun

    @property
    def blue_fade(self) -> float:
        """Return how much of the blue sky in glossy surfaces turns grey, 0 to 1."""
        if self.gloss_fade is not None:
            return self.gloss_fade
        return 0.0 if self.light.sun is None else 1.0 - self.light.sun

    def beam_surface(self, output_surface: str) -> tuple[str, bool] | None:
        return (
            (f"snow {self.depth_m:.3g} m deep", output_surface != "scene")
            if self.has_effect
            else None
        )
