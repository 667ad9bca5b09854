"""Classes of a recipe's weather in the words of standards: OSI, OpenSCENARIO, OpenLABEL, ISO, WMO.

In: a recipe in numbers. Out: `Tags`. Each class follows from one physical number by a `Scale`.
Manifests (`columns_of_tags`), `climategs tags` and suites use it.

Two visibilities are easily confused. `visibility_m` of a recipe is Koschmieder's: 2 % of an
object's contrast is left. The meteorological optical range (MOR) of WMO, OSI and road authorities
is that of 5 %. Without forward scatter visibility_m = 1.306 mor_m.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from recipes.light import DIM_LUX, foul_weather
from recipes.smog import KOSCHMIEDER, MOR_DEPTH

if TYPE_CHECKING:
    from recipes.light import Light
    from recipes.schema import Recipe
    from recipes.smog import Smog

# ---- Scales: from a number to a class ------------------------------------------------------------


@dataclass(frozen=True)
class Scale:
    """Classes of a number, from the smallest numbers to the largest ones."""

    borders: tuple[float, ...]
    """Numbers at which a class ends and the next one begins, in rising order."""
    names: tuple[str, ...]
    """Names of the classes, one more than borders."""
    source: str
    """Where the borders are stated."""
    belongs_below: bool = False
    """If True, a number on a border belongs to the class below it."""

    def __post_init__(self) -> None:
        if len(self.names) != len(self.borders) + 1 or list(self.borders) != sorted(self.borders):
            raise ValueError(
                f"names must be one more than borders, which rise; got {self.names}, {self.borders}"
            )

    def class_of(self, number: float) -> str:
        """Return the name of the class of a number.

        Numbers count to nine digits, so that a MOR of 200 m that was an extinction is still 200 m.
        """
        rounded = float(f"{number:.9g}")
        find = bisect_left if self.belongs_below else bisect_right
        return self.names[find(self.borders, rounded)]


_OSI = "ASAM OSI, osi_environment.proto at 689eab70"
_ISO = "BSI PAS 1883:2020 and ISO 34503:2023"
_WMO = "WMO-No. 8, volume I, on intensities of precipitation"

# MOR in metres.
OSI_FOG = Scale(
    (50, 200, 1000, 2000, 4000, 10000, 40000),
    ("dense", "thick", "light", "mist", "poor", "moderate", "good", "excellent"),
    _OSI,
)
# MOR in metres.
MET_OFFICE_FOG = Scale((50, 200, 1000), ("dense", "thick", "fog", "none"), "Met Office")
# MOR in metres: the range below which China's motorways warn.
MOTORWAY_FOG_WARNING = Scale(
    (50, 200, 500), ("50 m", "200 m", "500 m", "none"), "China's motorway warnings of fog"
)
# MOR in metres: FG and BR of reports of present weather.
WMO_FOG = Scale((1000, 5000), ("FG", "BR", ""), "WMO-No. 306, code table 4678")
# Precipitation of either kind as water, mm/h; after Paulat et al. 2008.
OSI_PRECIPITATION = Scale(
    (0.1, 0.5, 1.9, 8.1, 34, 149),
    ("none", "very_light", "light", "moderate", "heavy", "very_heavy", "extreme"),
    _OSI,
)
# Rain in mm/h.
ISO_RAIN = Scale(
    (0, 2.5, 7.6, 50, 100),
    ("none", "light", "moderate", "heavy", "violent", "cloudburst"),
    _ISO,
    belongs_below=True,
)
# MOR in falling snow, metres.
ISO_SNOW = Scale((500, 1000), ("heavy", "moderate", "light"), _ISO, belongs_below=True)
# Rain in mm/h; the American Meteorological Society begins "heavy" at 7.6 mm/h.
WMO_RAIN = Scale((2.5, 10, 50), ("light", "moderate", "heavy", "violent"), _WMO)
# Snowfall as water, mm/h.
WMO_SNOW = Scale((1, 5), ("light", "moderate", "heavy"), _WMO)
# Illuminance of level ground, lux. Level 2 is the full moon's.
OSI_ILLUMINATION = Scale(
    (0.001, 0.01, 1, 3, 10, 20, 400, 1000, 10000, 120000),
    ("other", *(f"level{number}" for number in range(1, 10)), "other"),
    _OSI,
)

# ---- Physical numbers that no field of a recipe holds --------------------------------------------

# Extinction in rain of R mm/h is 0.312 R^0.67 per km, of Marshall and Palmer's drops (1948).
RAIN_EXTINCTION_PER_KM = 0.312
RAIN_EXPONENT = 0.67
# Extinction in snowfall of R mm/h of water is 3.0 R^0.41 per km, of flakes by Sekhon and Srivastava
# (1970). The flakes of pictures are within 18 % of it from 0.1 to 5 mm/h.
SNOWFALL_EXTINCTION_PER_KM = 3.0
SNOWFALL_EXPONENT = 0.41
# Share of the light of street lamps that falls on a carriageway of CARRIAGEWAY_M, in the mean; of
# the common LED lamp at 8 m height, as the lamps of pictures light it.
STREET_UTILISATION = 0.24
# Width of that carriageway.
CARRIAGEWAY_M = 7.0
# Film of water from which a road is moist, mm (DATEX II).
MOIST_FILM_MM = 0.01
# Share of the open ground under standing water from which a road counts as wet with puddles. A
# convention of ours: ASAM gives no number.
MIN_PUDDLE_SHARE = 0.01
# Depth of a flood that counts as high: 15 cm reach the bottom of most cars (FEMA).
HIGH_FLOOD_M = 0.15
# Depth of snow on which wheels still reach the road.
LOOSE_SNOW_M = 0.02
# Friction over that of a dry road, which is 0.9: middles of the ranges of Wallman and Astrom (2001,
# VTI meddelande 911A), wet 0.7 to 0.8, loose snow or slush 0.2 to 0.5, packed snow 0.2 to 0.3.
FRICTION_SCALES = {"dry": 1.0, "wet": 0.83, "loose snow": 0.39, "packed snow": 0.28}

# ---- Tags ----------------------------------------------------------------------------------------

PrecipitationType = Literal["dry", "rain", "snow"]
Wetness = Literal["dry", "moist", "wetWithPuddles", "lowFlooded", "highFlooded"]


@dataclass(frozen=True)
class OpenLabelTag:
    """A tag of OpenLABEL's ontology of scenarios."""

    name: str
    """Name in the ontology, such as WeatherRain."""
    value: float | None = None
    """Number of the tag, in the ontology's unit; None for a tag that is just present."""


@dataclass(frozen=True)
class Tags:
    """Physical numbers of a recipe's weather, and their classes by standards."""

    extinction_per_m: float
    """Extinction of smog at its base height, 0 without smog."""
    visibility_m: float | None
    """Visibility in smog, 2 % of contrast, metres; None without smog."""
    mor_m: float | None
    """Meteorological optical range in smog, 5 % of a sensor's beam, metres; None without smog."""
    rain_mm_h: float
    """Rate of rain."""
    snowfall_mm_h: float
    """Rate of snowfall, as water."""
    precipitation_mor_m: float | None
    """Meteorological optical range in rain and snowfall alone; None where nothing falls."""
    wind_mps: float | None
    """Speed of the wind; None where no precipitation states it."""
    wind_from_deg: float | None
    """Where the wind comes from: 0 is world +x, 90 is +y; None likewise."""
    snow_depth_m: float
    """Depth of lying snow."""
    flood_level_m: float
    """Height of a flood above its reference, at least 0."""
    illuminance_lx: float | None
    """Light of sky, moon and street lamps on level ground, lux; None where the scene decides, as by
    day."""
    osi_fog: str
    """Class by `OSI_FOG`."""
    osi_precipitation: str
    """Class by `OSI_PRECIPITATION`, of rain and snowfall together."""
    osi_illumination: str
    """Class by `OSI_ILLUMINATION`; unknown where the scene decides."""
    met_office_fog: str
    """Class by `MET_OFFICE_FOG`."""
    motorway_fog_warning: str
    """Class by `MOTORWAY_FOG_WARNING`."""
    iso_rain: str
    """Class by `ISO_RAIN`."""
    iso_snow: str
    """Class by `ISO_SNOW`, or none."""
    wmo_weather: str
    """Present weather as in airport reports (WMO-No. 306, code table 4678), such as `+RA FG`; NSW
    for none."""
    wmo_4680: int
    """Present weather of an automatic station (WMO-No. 306, code table 4680)."""
    openscenario_precipitation: PrecipitationType
    """Type of precipitation of OpenSCENARIO XML 1.2, of the greater rate."""
    openscenario_wetness: Wetness
    """Wetness of roads of OpenSCENARIO XML 1.2."""
    friction_scale: float
    """Friction of the road over that of a dry one, by FRICTION_SCALES; an estimate, as no picture
    depends on it."""
    openlabel: tuple[OpenLabelTag, ...]
    """Tags of OpenLABEL 1.0.0."""


# Tags that are columns of manifests. The numbers in the manifest's other columns are not repeated.
NUMBER_COLUMNS = ("mor_m",)
CLASS_COLUMNS = (
    "osi_fog",
    "osi_precipitation",
    "osi_illumination",
    "iso_rain",
    "iso_snow",
    "wmo_weather",
    "openscenario_wetness",
)


def columns_of_tags(recipe: Recipe) -> dict[str, str | float | None]:
    """Return the tags that are columns of manifests, by column.

    Args:
        recipe: the recipe in numbers, at the time of an image.
    """
    tags = tags_of(recipe)
    return {name: getattr(tags, name) for name in (*NUMBER_COLUMNS, *CLASS_COLUMNS)}


def tags_of(recipe: Recipe) -> Tags:
    """Return the tags of a recipe in numbers.

    Args:
        recipe: the recipe. One that changes over time has the tags of its largest values: take
            `recipe.at(...)` for those of a moment.
    """
    weather = recipe.weather
    mor_m = _mor_of(weather.smog)
    extinction_per_m = weather.smog.resolved_extinction_per_m if weather.smog else 0.0
    rain_mm_h = weather.rain.rate_mm_h if weather.rain else 0.0
    snowfall_mm_h = weather.snowfall.rate_mm_h if weather.snowfall else 0.0
    snowfall_mor_m = _mor_of_precipitation(0.0, snowfall_mm_h)
    falling = max(
        (section for section in (weather.rain, weather.snowfall) if section and section.has_effect),
        key=lambda section: section.rate_mm_h,
        default=None,
    )
    illuminance_lx = illuminance_of(recipe.light)
    snow_depth_m = weather.snow.depth_m if weather.snow and weather.snow.has_effect else 0.0
    flood_level_m = max(weather.flood.level_m, 0.0) if weather.flood else 0.0
    fog_range_m = math.inf if mor_m is None else mor_m
    wetness = _wetness(recipe)
    precipitation_type: PrecipitationType = "dry"
    if rain_mm_h + snowfall_mm_h > 0:
        precipitation_type = "rain" if rain_mm_h >= snowfall_mm_h else "snow"
    return Tags(
        extinction_per_m=extinction_per_m,
        visibility_m=KOSCHMIEDER / extinction_per_m if extinction_per_m > 0 else None,
        mor_m=mor_m,
        rain_mm_h=rain_mm_h,
        snowfall_mm_h=snowfall_mm_h,
        precipitation_mor_m=_mor_of_precipitation(rain_mm_h, snowfall_mm_h),
        wind_mps=falling.wind_mps if falling else None,
        wind_from_deg=falling.wind_from_deg if falling else None,
        snow_depth_m=snow_depth_m,
        flood_level_m=flood_level_m,
        illuminance_lx=illuminance_lx,
        osi_fog=OSI_FOG.class_of(fog_range_m),
        osi_precipitation=OSI_PRECIPITATION.class_of(rain_mm_h + snowfall_mm_h),
        osi_illumination=(
            "unknown" if illuminance_lx is None else OSI_ILLUMINATION.class_of(illuminance_lx)
        ),
        met_office_fog=MET_OFFICE_FOG.class_of(fog_range_m),
        motorway_fog_warning=MOTORWAY_FOG_WARNING.class_of(fog_range_m),
        iso_rain=ISO_RAIN.class_of(rain_mm_h),
        iso_snow="none" if snowfall_mor_m is None else ISO_SNOW.class_of(snowfall_mor_m),
        wmo_weather=_wmo_weather(fog_range_m, rain_mm_h, snowfall_mm_h),
        wmo_4680=_wmo_4680(fog_range_m, rain_mm_h, snowfall_mm_h),
        openscenario_precipitation=precipitation_type,
        openscenario_wetness=wetness,
        friction_scale=FRICTION_SCALES[_friction_key(snow_depth_m, wetness)],
        openlabel=_openlabel_tags(recipe, mor_m, snowfall_mor_m, snow_depth_m, wetness),
    )


def illuminance_of(light: Light | None) -> float | None:
    """Return the light of sky, moon and street lamps on level ground, lux.

    Street lamps count by their spacing, in the mean of a carriageway, where they are on. Lamps of
    vehicles do not count. The result is None where the scene says how much light there is.
    """
    if light is None or light.sky_luminance is None:
        return None
    illuminance_lx = math.pi * light.sky_luminance
    if light.is_dark:
        illuminance_lx += light.moon_lux
    if _has_street_lamps(light):
        area_m2 = light.street_spacing_m * CARRIAGEWAY_M
        illuminance_lx += STREET_UTILISATION * light.street_lumen / area_m2
    return illuminance_lx


def _has_street_lamps(light: Light) -> bool:
    return light.street == "on" or (light.street == "auto" and light.is_dark)


def _has_vehicle_lamps(recipe: Recipe, light: Light) -> bool:
    if light.vehicles != "auto":
        return light.vehicles == "on"
    rain = recipe.weather.rain
    snowfall = recipe.weather.snowfall
    smog = recipe.weather.smog
    is_foul = foul_weather(
        rain.rate_mm_h if rain else 0.0,
        snowfall.rate_mm_h if snowfall else 0.0,
        smog.resolved_extinction_per_m if smog else 0.0,
    )
    is_dim = light.sky_luminance is not None and math.pi * light.sky_luminance < DIM_LUX
    return light.is_dark or bool(is_foul) or is_dim


def _mor_of(smog: Smog | None) -> float | None:
    """Return the meteorological optical range in smog, metres; None without any."""
    if smog is None or smog.resolved_extinction_per_m <= 0:
        return None
    if smog.mor_m is not None:
        return smog.mor_m
    return MOR_DEPTH / (smog.resolved_extinction_per_m * (1 + smog.scatter))


def _mor_of_precipitation(rain_mm_h: float, snowfall_mm_h: float) -> float | None:
    """Return the meteorological optical range in rain and snowfall, metres; None without any."""
    extinction_per_km = RAIN_EXTINCTION_PER_KM * rain_mm_h**RAIN_EXPONENT
    extinction_per_km += SNOWFALL_EXTINCTION_PER_KM * snowfall_mm_h**SNOWFALL_EXPONENT
    return 1000 * MOR_DEPTH / extinction_per_km if extinction_per_km > 0 else None


def _wetness(recipe: Recipe) -> Wetness:
    """Return the wetness of roads in OpenSCENARIO's words."""
    flood = recipe.weather.flood
    if flood is not None and flood.level_m > 0:
        return "highFlooded" if flood.level_m >= HIGH_FLOOD_M else "lowFlooded"
    rain = recipe.weather.rain
    if rain is None or not rain.wets_ground:
        return "dry"
    if rain.puddle_share >= MIN_PUDDLE_SHARE:
        return "wetWithPuddles"
    road = rain.road
    is_moist = road is None or road.film_mm >= MOIST_FILM_MM or road.spots > 0
    return "moist" if is_moist else "dry"


def _friction_key(snow_depth_m: float, wetness: Wetness) -> str:
    """Return the key of FRICTION_SCALES for a road."""
    if snow_depth_m > 0:
        is_loose = snow_depth_m < LOOSE_SNOW_M or wetness != "dry"
        return "loose snow" if is_loose else "packed snow"
    return "dry" if wetness == "dry" else "wet"


def _wmo_weather(fog_range_m: float, rain_mm_h: float, snowfall_mm_h: float) -> str:
    """Return groups of present weather as in airport reports; NSW for no significant weather."""
    signs = {"light": "-", "moderate": "", "heavy": "+", "violent": "+"}
    groups = []
    if rain_mm_h > 0 and snowfall_mm_h > 0:  # mixed: the greater part first, the stronger sign
        names = "RASN" if rain_mm_h >= snowfall_mm_h else "SNRA"
        strength = max(
            (WMO_RAIN.class_of(rain_mm_h), WMO_SNOW.class_of(snowfall_mm_h)),
            key=WMO_RAIN.names.index,
        )
        groups.append(signs[strength] + names)
    elif rain_mm_h > 0:
        groups.append(signs[WMO_RAIN.class_of(rain_mm_h)] + "RA")
    elif snowfall_mm_h > 0:
        groups.append(signs[WMO_SNOW.class_of(snowfall_mm_h)] + "SN")
    groups.append(WMO_FOG.class_of(fog_range_m))
    return " ".join(filter(None, groups)) or "NSW"


def _wmo_4680(fog_range_m: float, rain_mm_h: float, snowfall_mm_h: float) -> int:
    """Return the code of an automatic station; the highest one where several hold."""
    rain_class = WMO_RAIN.class_of(rain_mm_h)
    snow_class = WMO_SNOW.class_of(snowfall_mm_h)
    if rain_mm_h > 0 and snowfall_mm_h > 0:
        return 67 if rain_class == snow_class == "light" else 68
    if snowfall_mm_h > 0:
        return {"light": 71, "moderate": 72, "heavy": 73}[snow_class]
    if rain_mm_h > 0:
        return {"light": 61, "moderate": 62, "heavy": 63, "violent": 63}[rain_class]
    return {"FG": 30, "BR": 10, "": 0}[WMO_FOG.class_of(fog_range_m)]


def _openlabel_tags(
    recipe: Recipe,
    mor_m: float | None,
    snowfall_mor_m: float | None,
    snow_depth_m: float,
    wetness: Wetness,
) -> tuple[OpenLabelTag, ...]:
    """Return OpenLABEL's tags of the weather.

    Args:
        recipe: the recipe.
        mor_m: meteorological optical range in smog, metres; None without any.
        snowfall_mor_m: the same in snowfall.
        snow_depth_m: depth of lying snow.
        wetness: wetness of the road.
    """
    rain = recipe.weather.rain
    light = recipe.light
    tags: list[OpenLabelTag] = []
    if rain is not None and rain.has_effect:
        tags += OpenLabelTag("WeatherRain"), OpenLabelTag("weatherRainValue", rain.rate_mm_h)
    if snowfall_mor_m is not None:
        tags += OpenLabelTag("WeatherSnow"), OpenLabelTag("weatherSnowValue", snowfall_mor_m / 1000)
    falling = [s for s in (rain, recipe.weather.snowfall) if s is not None and s.has_effect]
    if falling:
        wind_mps = max(section.wind_mps for section in falling)
        tags += OpenLabelTag("WeatherWind"), OpenLabelTag("weatherWindValue", wind_mps)
    if mor_m is not None:
        tags += OpenLabelTag("ParticulatesWater"), OpenLabelTag("particulatesWaterValue", mor_m)
    if snow_depth_m > 0:
        tags.append(OpenLabelTag("SurfaceConditionSnow"))
    surface = {
        "moist": ("SurfaceConditionWet",),
        "wetWithPuddles": ("SurfaceConditionWet", "SurfaceConditionStandingWater"),
        "lowFlooded": ("SurfaceConditionFlooded",),
        "highFlooded": ("SurfaceConditionFlooded",),
    }
    tags += [OpenLabelTag(name) for name in surface.get(wetness, ())]
    if light is not None and light.is_dark:
        name = "LowLightNight" if light.time == "night" else "LowLightAmbient"
        tags.append(OpenLabelTag(name))
    if light is not None and _has_street_lamps(light):
        tags.append(OpenLabelTag("ArtificialStreetLighting"))
    if light is not None and _has_vehicle_lamps(recipe, light):
        tags.append(OpenLabelTag("ArtificialVehicleLighting"))
    return tuple(tags)
