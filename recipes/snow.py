"""The recipe section of snow that lies on the ground."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Angle, ClosedModel, Number, Unit, Whole
from recipes.moment import Air, Moment
from recipes.snow_balance import SnowWeather, Surface, first_snow_s, largest_depth_m, layer_at

# Dotted paths of the rates that snow follows from.
SNOWFALL = "weather.snowfall.rate_mm_h"
RAIN = "weather.rain.rate_mm_h"
# Least depth for which a layer is laid that is then scaled, metres.
MIN_LAID_DEPTH_M = 0.01
# Depth at which all but 1/e of a hard surface is white, of snow over time, metres. Assumed.
HARD_COVERING_DEPTH_M = 0.005
# Water on a road, from snow that melted on it, that wets all but 1/e of it, mm. Assumed.
WETTING_MM = 0.15
# Time from the first snow on in which 1 - 1/e of the traffic has driven, seconds. Assumed.
DRIVING_TIME_S = 900.0
# Temperature of the air in which snow falls if the recipe says nothing about it, degrees Celsius.
ASSUMED_AIR_C = -1.0


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


class SnowRoad(ClosedModel):
    """Snow on roads, which are warmer than all else; null if it is as deep there."""

    depth_m: Number = Field(default=0.0, ge=0, le=10)
    """Depth of the layer on roads, before cars drive over it."""
    wetness: Unit = 0.0
    """How wet the bare road is from snow that has melted on it: 0 dry, 1 wet through."""
    driven: Unit = 1.0
    """Share of the cars of `traffic` that have driven so far."""


class Snow(EffectModel):
    """Snow lying on what is open to the sky: ground, roofs, vehicles."""

    later_fields = ("dirt", "traffic", "shadow_fade", "gloss_fade", "placed_depth_m", "road")
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

    placed_depth_m: Number | None = Field(default=None, ge=0.001, le=10)
    """Depth for which the layer is laid once a scene, and then scaled to depth_m: the largest of a
    drive, so that snow can grow and melt from image to image; null lays it for depth_m alone."""
    road: SnowRoad | None = None
    """Snow on roads; null if it is as deep there as elsewhere."""

    @property
    def has_effect(self) -> bool:
        """Return False for snow without depth or coverage, which changes nothing."""
        has_snow = self.depth_m > 0 and self.coverage > 0
        return has_snow or (self.road is not None and self._changes_road(self.road))

    def _changes_road(self, road: SnowRoad) -> bool:
        """Return True if there is snow on roads, or water of it."""
        return road.wetness > 0 or (road.depth_m > 0 and self.coverage > 0)

    @property
    def is_laid(self) -> bool:
        """Return True if a layer is laid for this snow, with or without effect at the moment."""
        return self.has_effect or self.placed_depth_m is not None

    @property
    def road_cover(self) -> float:
        """Return the share of roads under snow, 0 to 1, before cars drive over it."""
        if not self.is_scaled:
            return self.coverage if self.has_effect else 0.0
        road_depth_m = self.depth_m if self.road is None else self.road.depth_m
        return self.coverage * -math.expm1(-road_depth_m / HARD_COVERING_DEPTH_M)

    @property
    def is_scaled(self) -> bool:
        """Return True if the layer is laid for one depth and scaled to another."""
        return self.placed_depth_m is not None or self.road is not None

    @property
    def laid_depth_m(self) -> float:
        """Return the depth for which the layer is laid, metres."""
        if self.placed_depth_m is not None:
            return self.placed_depth_m
        road_depth_m = 0.0 if self.road is None else self.road.depth_m
        return max(self.depth_m, road_depth_m, MIN_LAID_DEPTH_M)

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

    def state_at(self, path: str, moment: Moment) -> Snow:
        """Return the snow at a moment: as deep as the weather has made it.

        A recipe that gives the depth over time keeps it, and one that gives `road` keeps that.
        """
        depths = moment.curves.get(f"{path}.depth_m")
        traffic = moment.curves.get(f"{path}.traffic")
        changes = {f"{path}.coverage", f"{path}.depth_m", f"{path}.traffic"} & set(moment.curves)
        changes |= {name for name in moment.curves if name.startswith(f"{path}.road.")}
        weather = _snow_weather(self.depth_m, moment) if depths is None else None
        if weather is None and not changes:
            return self
        fields: dict[str, object] = {}
        driven = 1.0
        largest_m = self.depth_m if depths is None else max(depths.values)
        if self.road is not None:
            road_depths = moment.curve(f"{path}.road.depth_m", self.road.depth_m)
            largest_m = max(largest_m, *road_depths.values)
        if traffic is not None:
            largest_traffic = max(traffic.values)
            driven = (self.traffic / largest_traffic) ** 2  # as the number of cars grows
            fields["traffic"] = largest_traffic
        if weather is not None:
            road = Surface(moment.curve("weather.air.road_warmer_k", _road_warmer_k(moment)), True)
            fields["depth_m"] = layer_at(moment.time_s, weather).depth_m
            largest_m = max(largest_m, largest_depth_m(weather, moment.end_s))
            if self.road is None:
                layer = layer_at(moment.time_s, weather, road)
                if self.depth_m == 0:
                    driving_s = max(moment.time_s - first_snow_s(weather), 0.0)
                    driven *= -math.expm1(-driving_s / DRIVING_TIME_S)
                wetness = -math.expm1(-max(layer.melted_mm, 0.0) / WETTING_MM)
                fields["road"] = SnowRoad(depth_m=layer.depth_m, wetness=wetness, driven=driven)
        elif self.road is None and traffic is not None:
            fields["road"] = SnowRoad(depth_m=self.depth_m, driven=driven)
        if self.placed_depth_m is None:
            fields["placed_depth_m"] = min(max(largest_m, MIN_LAID_DEPTH_M), 10.0)
        return self.model_copy(update=fields)

    def beam_surface(self, output_surface: str) -> tuple[str, bool] | None:
        depth_m = self.depth_m if self.road is None else max(self.depth_m, self.road.depth_m)
        if depth_m == 0 or self.coverage == 0:
            return None
        return f"snow {depth_m:.3g} m deep", output_surface != "scene"


def _snow_weather(depth_m: float, moment: Moment) -> SnowWeather | None:
    """Return the weather that a recipe's snow lies in; None if it says nothing that changes it.

    Args:
        depth_m: depth of the snow at the weather's begin.
        moment: the moment.
    """
    snowfall = moment.curve(SNOWFALL, 0.0)
    temperature = "weather.air.temperature_c"
    if moment.air is None and snowfall.is_constant and temperature not in moment.curves:
        return None
    air_c = ASSUMED_AIR_C if moment.air is None else moment.air.temperature_c
    curves = (snowfall, moment.curve(RAIN, 0.0), moment.curve(temperature, air_c))
    begins_s = [curve.times_s[0] for curve in curves if not curve.is_constant]
    return SnowWeather(*curves, min([0.0, *begins_s]), depth_m)


def _road_warmer_k(moment: Moment) -> float:
    """Return how much warmer roads are than the air, kelvin."""
    return Air().road_warmer_k if moment.air is None else moment.air.road_warmer_k
