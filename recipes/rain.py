"""The recipe section of rain: its fields and manifest columns."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from recipes.effect import Column, EffectModel, Section
from recipes.fields import Angle, Colour, Flag, Number, Unit
from recipes.moment import Moment
from recipes.road_water import MAX_FILM_MM, AirCurves, road_state
from recipes.shower import MAX_FRONT_MPS, MAX_PLACES, Along, check_along, with_shower

# Largest rate of rain. The hour's record of most cities is below.
MAX_RATE_MM_H = 300.0
# Largest speed of wind.
MAX_WIND_MPS = 60.0
# Wetness of the ground grows with the rain's rate as 1 - exp(-rate / WET_THROUGH_MM_H), mm/h.
WET_THROUGH_MM_H = 1.5
# Share of the sun that clouds hide grows with the rain's rate as 1 - exp(-rate / OVERCAST_MM_H),
# mm/h.
OVERCAST_MM_H = 0.1
# Share of the open ground on which water stands at 1 mm/h, 0 to 1.
PUDDLE_SHARE_AT_1_MM_H = 0.03
# Power of the rate with which that share grows, about a square root; no unit.
PUDDLE_EXPONENT = 0.55
# Largest share that follows from a rate, 0 to 1.
MAX_PUDDLE_SHARE = 0.35


# Rate of rain that a road had if nothing says so: it wets the road through, mm/h.
DEFAULT_PEAK_RATE_MM_H = 10.0


def wetness_of_rate(rate_mm_h: float) -> float:
    """Return the wetness of ground, 0 to 1, on which rain of this rate has lasted."""
    return -math.expm1(-rate_mm_h / WET_THROUGH_MM_H)


def puddle_share_of_rate(rate_mm_h: float) -> float:
    """Return the share of open ground on which water stands if rain of this rate has lasted."""
    return min(MAX_PUDDLE_SHARE, PUDDLE_SHARE_AT_1_MM_H * rate_mm_h**PUDDLE_EXPONENT)


class RoadWater(Section):
    """Water on the road at one moment: what falls and dries over time has led to it."""

    film_mm: Number = Field(default=MAX_FILM_MM, ge=0, le=MAX_FILM_MM)
    """Film of water, the mean of the road: 0 dry; above the largest value water runs off."""
    peak_film_mm: Number = Field(default=MAX_FILM_MM, ge=0, le=MAX_FILM_MM)
    """Largest film since the road was last dry: where film_mm is less, the road dries in patches;
    where it is not more than film_mm, the film is even."""
    peak_rate_mm_h: Number = Field(default=DEFAULT_PEAK_RATE_MM_H, ge=0, le=MAX_RATE_MM_H)
    """Largest rate of rain since then, from which the wetness under a full film follows."""
    puddle_fill: Unit = 1.0
    """How full the puddles are: 0 dry, 1 full; they shrink from their edges."""
    puddle_rate_mm_h: Number = Field(default=DEFAULT_PEAK_RATE_MM_H, ge=0, le=MAX_RATE_MM_H)
    """Largest rate of rain since the puddles were last dry, from which their share of the ground
    follows."""
    tracks: Unit = 0.0
    """How far wheels have pushed the water out of their tracks: 0 not, 1 to 0.3 of the film."""
    spots: Unit = 0.0
    """Share of the ground that drops of this shower have hit, as dark spots, whatever the film."""

    @property
    def film_share(self) -> float:
        """Return the film over the largest one, 0 to 1."""
        return self.film_mm / MAX_FILM_MM

    @property
    def puddle_share(self) -> float:
        """Return the share of the open ground on which water stands, 0 to 1."""
        return puddle_share_of_rate(self.puddle_rate_mm_h) * self.puddle_fill


class Rain(EffectModel):
    """Rain: drops that streak near the camera and veil what is far, and the wet ground below."""

    later_fields = ("shadow_fade", "gloss_fade", "road", "front_mps", "along", "peak_mm_h")
    synonyms = (
        ("rate_mm_h", "rain_rate mm_h mm_per_hour"),
        ("wind_mps", "wind_speed"),
        ("wind_from_deg", "wind_direction wind_deg"),
        ("wetness", "wet wet_road wet_ground"),
        ("puddles", "puddle standing_water"),
    )
    columns = (
        Column(
            "rain_rate_mm_h",
            lambda rain: rain.rate_mm_h,
            "Rain",
            "mm/h",
            value_if_absent=0.0,
            presence_values="nonzero",
            decides_absence=False,
            label="rain",
            caption="rain {rain_rate_mm_h:.3g} mm/h",
        ),
        Column(
            "rain_wetness",
            lambda rain: rain.ground_wetness,
            "Wetness of the ground",
            value_if_absent=0.0,
            presence_values="nonzero",
            decides_absence=False,
            linear=True,
        ),
        Column(
            "rain_film_mm",
            lambda rain: None if rain.road is None else rain.road.film_mm,
            "Film of water on the road",
            "mm",
            linear=True,
        ),
        Column(
            "rain_puddles",
            lambda rain: rain.puddle_share if rain.wets_ground else 0.0,
            "Share of the ground under puddles",
            value_if_absent=0.0,
            linear=True,
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

    front_mps: Number | None = Field(default=None, gt=0, le=MAX_FRONT_MPS)
    """Speed over the ground at which a shower passes, from where the wind comes; rate_mm_h is then
    the rate at the drive's first camera; null for a rate that is the same everywhere."""
    along: Along | None = Field(default=None, min_length=1, max_length=MAX_PLACES)
    """Rates along the way of a shower; null follows from the rate's course and front_mps."""
    peak_mm_h: Number | None = Field(default=None, ge=0, le=MAX_RATE_MM_H)
    """Largest rate of the weather's course, whose drops the others are a share of, so that drops
    last from image to image; null follows from the rate's course."""

    wetness: Unit | None = None
    """How wet the ground is that is open to the sky: 0 dry, 1 wet through; null follows from the
    rate."""
    puddles: Unit | None = None
    """Share of that ground on which water stands, in its hollows first; null follows from the rate;
    none where wetness is 0."""
    shadow_fade: Unit | None = None
    """How much of the ground's cast shadows goes, since clouds that rain hide the sun: 1 all, 0
    none; null follows from the rate, and is all but in the lightest drizzle."""
    gloss_fade: Unit | None = None
    """How much of the blue that glossy surfaces mirror of a clear sky turns grey: 1 all, 0 none;
    null follows from the rate, and is all but in the lightest drizzle."""
    road: RoadWater | None = None
    """Water on the road at this moment; null for a road as the rate has long made it. A timeline of
    the rate, or weather.air, fills it. With it, wetness is that under a full film."""
    spray: Flag = True
    """Vehicles that drive faster than 40 km/h lift spray, by their speed, the rate and the ground's
    wetness."""

    @model_validator(mode="after")
    def _along_in_order(self) -> Rain:
        check_along(self.along)
        return self

    def state_at(self, path: str, moment: Moment) -> Rain:
        """Return the rain with the water that has gathered on the road up to a moment.

        The road follows if the rate or the air changes or the air is given, unless the recipe
        states the road or its wetness itself. What `recipes.shower` derives follows, too.
        """
        rain = with_shower(self, path, moment, OVERCAST_MM_H)
        is_stated = self.road is not None or self.wetness is not None
        if is_stated or not (f"{path}.rate_mm_h" in moment.curves or moment.air is not None):
            return rain
        rate = moment.curve(f"{path}.rate_mm_h", self.rate_mm_h)
        state = road_state(rate, AirCurves.at(moment), moment.time_s)
        return rain.model_copy(update={"road": RoadWater.model_validate(vars(state))})

    @property
    def has_effect(self) -> bool:
        """Return False for rain without a rate, which changes nothing in the air."""
        return self.rate_mm_h > 0 or any(place.rate_mm_h > 0 for place in self.along or ())

    @property
    def sun_fade(self) -> float:
        """Return the share of the sun's light that the rain's clouds take, 0 to 1."""
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
    def ground_wetness(self) -> float:
        """Return the wetness of the ground, 0 to 1. It follows from the rate if the recipe gives
        none; with `road`, it is the mean over film and puddles.
        """
        if self.road is not None:
            film_share = self.road.film_share
            return self.film_wetness * film_share + (1 - film_share) * self.puddle_share
        return self.film_wetness

    @property
    def wets_ground(self) -> bool:
        """Return True if any ground is wet: by film, puddles or the first drops."""
        return self.ground_wetness > 0 or (self.road is not None and self.road.spots > 0)

    @property
    def film_wetness(self) -> float:
        """Return the wetness of ground under a full film, 0 to 1."""
        if self.wetness is not None:
            return self.wetness
        return wetness_of_rate(self.rate_mm_h if self.road is None else self.road.peak_rate_mm_h)

    @property
    def puddle_wetness(self) -> float:
        """Return the wetness of ground under puddles, 0 to 1; at least that under the film."""
        if self.wetness is not None or self.road is None:
            return self.film_wetness
        return max(self.film_wetness, wetness_of_rate(self.road.puddle_rate_mm_h))

    @property
    def puddle_share(self) -> float:
        """Return the share of the open ground on which water stands, 0 to 1.

        It follows from the rate if the recipe gives none.
        """
        if self.puddles is not None:
            return self.puddles
        if self.road is not None:
            return self.road.puddle_share
        return puddle_share_of_rate(self.rate_mm_h)
