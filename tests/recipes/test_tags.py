"""Tags: every class begins at the number that its standard states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest

from augment.effects.falling.drops import sizes_of
from recipes.flood import Flood
from recipes.light import Light
from recipes.rain import Rain, RoadWater
from recipes.schema import Recipe, Weather
from recipes.smog import MOR_DEPTH, Smog
from recipes.snow import Snow
from recipes.snowfall import Snowfall
from recipes.tags import (
    CLASS_COLUMNS,
    RAIN_EXPONENT,
    RAIN_EXTINCTION_PER_KM,
    SNOWFALL_EXPONENT,
    SNOWFALL_EXTINCTION_PER_KM,
    Scale,
    Tags,
    columns_of_tags,
    illuminance_of,
    tags_of,
)


def in_smog(**values: float) -> Tags:
    return tags_of(Recipe(weather=Weather(smog=Smog(**values))))  # type: ignore[arg-type]


def in_rain(rate_mm_h: float) -> Tags:
    return tags_of(Recipe(weather=Weather(rain=Rain(rate_mm_h=rate_mm_h))))


def in_snowfall(rate_mm_h: float) -> Tags:
    return tags_of(Recipe(weather=Weather(snowfall=Snowfall(rate_mm_h=rate_mm_h))))


def under_sky(lux: float) -> Tags:
    return tags_of(Recipe(light=Light(sky_luminance_cd_m2=lux / math.pi)))


# Number at which each class begins, in rising order, with the class. The first begins at zero.
CLASSES: dict[str, tuple[Callable[[float], Tags], str, list[tuple[float, str]]]] = {
    "fog of OSI": (
        lambda mor_m: in_smog(mor_m=mor_m),
        "osi_fog",
        [
            (1, "dense"),
            (50, "thick"),
            (200, "light"),
            (1000, "mist"),
            (2000, "poor"),
            (4000, "moderate"),
            (10000, "good"),
            (40000, "excellent"),
        ],
    ),
    "fog of the Met Office": (
        lambda mor_m: in_smog(mor_m=mor_m),
        "met_office_fog",
        [(1, "dense"), (50, "thick"), (200, "fog"), (1000, "none")],
    ),
    "warnings of motorways": (
        lambda mor_m: in_smog(mor_m=mor_m),
        "motorway_fog_warning",
        [(1, "50 m"), (50, "200 m"), (200, "500 m"), (500, "none")],
    ),
    "fog of airports": (
        lambda mor_m: in_smog(mor_m=mor_m),
        "wmo_weather",
        [(1, "FG"), (1000, "BR"), (5000, "NSW")],
    ),
    "precipitation of OSI": (
        in_rain,
        "osi_precipitation",
        [
            (0, "none"),
            (0.1, "very_light"),
            (0.5, "light"),
            (1.9, "moderate"),
            (8.1, "heavy"),
            (34, "very_heavy"),
            (149, "extreme"),
        ],
    ),
    "rain of airports": (
        lambda rate: in_rain(rate + 1e-6 * (rate == 0)),
        "wmo_weather",
        [(0, "-RA"), (2.5, "RA"), (10, "+RA")],
    ),
    "snow of airports": (in_snowfall, "wmo_weather", [(0.1, "-SN"), (1, "SN"), (5, "+SN")]),
    "light of OSI": (
        under_sky,
        "osi_illumination",
        [
            (0, "other"),
            (0.001, "level1"),
            (0.01, "level2"),
            (1, "level3"),
            (3, "level4"),
            (10, "level5"),
            (20, "level6"),
            (400, "level7"),
            (1000, "level8"),
            (10000, "level9"),
        ],
    ),
}


@pytest.mark.parametrize("name", CLASSES)
def test_classes_begin_at_the_numbers_of_their_standards(name: str) -> None:
    tags_at, field, beginnings = CLASSES[name]
    for (begin, word), (end, _) in zip(beginnings, [*beginnings[1:], (math.inf, "")], strict=True):
        assert getattr(tags_at(begin), field) == word, begin
        if end < math.inf:
            assert getattr(tags_at(end * (1 - 1e-6)), field) == word, end


def test_rain_of_iso_ends_with_the_number_itself() -> None:
    ends = [(0, "none"), (2.5, "light"), (7.6, "moderate"), (50, "heavy"), (100, "violent")]
    for end, word in ends:
        assert in_rain(end).iso_rain == word
    assert [in_rain(end * (1 + 1e-6)).iso_rain for end, _ in ends[1:]] == [
        *("moderate", "heavy", "violent", "cloudburst")
    ]


def test_a_border_holds_however_the_density_was_given() -> None:
    """An extinction for a MOR of exactly 200 m is light fog, whatever its last bit."""
    for mor_m in (50, 200, 1000, 2000, 4000, 10000):
        by_mor = in_smog(mor_m=mor_m)
        by_extinction = in_smog(extinction_per_m=MOR_DEPTH / mor_m)
        assert by_mor.mor_m == mor_m
        assert by_extinction.mor_m == pytest.approx(mor_m, rel=1e-12)
        assert by_extinction.osi_fog == by_mor.osi_fog


def test_the_visibilities_of_two_and_five_percent_are_not_confused() -> None:
    tags = in_smog(extinction_per_m=0.005)
    assert tags.visibility_m == pytest.approx(782.4) and tags.mor_m == pytest.approx(
        599.15, abs=0.01
    )
    assert math.exp(-0.005 * tags.mor_m) == pytest.approx(0.05)
    assert tags.visibility_m / tags.mor_m == pytest.approx(1.306, abs=5e-4)
    # Thick by MOR, and light by a visibility of 2 %.
    assert in_smog(visibility_m=240).osi_fog == "thick"
    # A sensor's beam loses the light that droplets diffract, too.
    assert in_smog(extinction_per_m=0.005, scatter=1.0).mor_m == pytest.approx(599.15 / 2, abs=0.01)


# Effect, level, fields of the recipe, and the tags that the level was chosen for.
LEVELS: list[tuple[Weather | Light, dict[str, Any]]] = [
    (Weather(smog=Smog(extinction_per_m=0.005)), {"osi_fog": "light"}),
    (Weather(smog=Smog(extinction_per_m=0.01)), {"osi_fog": "light"}),
    (Weather(smog=Smog(extinction_per_m=0.02)), {"osi_fog": "thick"}),
    (Weather(smog=Smog(extinction_per_m=0.04)), {"osi_fog": "thick"}),
    (Weather(smog=Smog(extinction_per_m=0.08)), {"osi_fog": "dense"}),
    (Weather(rain=Rain(rate_mm_h=1)), {"osi_precipitation": "light", "wmo_4680": 61}),
    (Weather(rain=Rain(rate_mm_h=4)), {"osi_precipitation": "moderate", "wmo_4680": 62}),
    (Weather(rain=Rain(rate_mm_h=16)), {"osi_precipitation": "heavy", "wmo_4680": 63}),
    (Weather(rain=Rain(rate_mm_h=50)), {"osi_precipitation": "very_heavy"}),
    (Weather(rain=Rain(rate_mm_h=100)), {"osi_precipitation": "very_heavy"}),
    (Weather(snowfall=Snowfall(rate_mm_h=0.3)), {"iso_snow": "light", "wmo_weather": "-SN"}),
    (Weather(snowfall=Snowfall(rate_mm_h=1.2)), {"iso_snow": "moderate", "wmo_weather": "SN"}),
    (Weather(snowfall=Snowfall(rate_mm_h=4.8)), {"iso_snow": "moderate", "wmo_4680": 72}),
    (Weather(flood=Flood(level_m=0.05)), {"openscenario_wetness": "lowFlooded"}),
    (Weather(flood=Flood(level_m=0.15)), {"openscenario_wetness": "highFlooded"}),
    (Light(time="dusk", sky_luminance_cd_m2=127.3, street="off"), {"osi_illumination": "level6"}),
    (Light(time="night", street="on", street_lumen=17500), {"osi_illumination": "level6"}),
    (Light(time="night", street="on", street_lumen=2630), {"osi_illumination": "level4"}),
    (
        Light(time="night", street="off", sky_luminance_cd_m2=0, moon_lux=0.2),
        {"osi_illumination": "level2"},
    ),
]


def test_levels_of_a_suite_have_the_classes_that_they_were_chosen_for() -> None:
    for model, expected in LEVELS:
        is_light = isinstance(model, Light)
        tags = tags_of(Recipe(light=model) if is_light else Recipe(weather=model))
        for field, value in expected.items():
            assert getattr(tags, field) == value, (model, field)


def test_ranges_in_rain_and_snowfall_are_those_that_pictures_show() -> None:
    """The laws of tags stay within 20 % of the drops and flakes that are rendered."""
    for rate in (0.5, 1.0, 4.0, 16.0, 50.0, 100.0):
        law_per_m = RAIN_EXTINCTION_PER_KM * rate**RAIN_EXPONENT / 1000
        assert law_per_m == pytest.approx(sizes_of("rain", rate).extinction_per_m, rel=0.2)
        assert in_rain(rate).precipitation_mor_m == pytest.approx(MOR_DEPTH / law_per_m)
    for rate in (0.1, 0.3, 0.6, 1.2, 2.4, 4.8):
        law_per_m = SNOWFALL_EXTINCTION_PER_KM * rate**SNOWFALL_EXPONENT / 1000
        assert law_per_m == pytest.approx(sizes_of("snow", rate).extinction_per_m, rel=0.2)


def test_lamps_of_vehicles_are_tagged_where_auto_turns_them_on() -> None:
    cases = (
        (Light(), Weather(), False),
        (Light(), Weather(rain=Rain(rate_mm_h=1)), True),
        (Light(), Weather(snowfall=Snowfall(rate_mm_h=1)), True),
        (Light(), Weather(smog=Smog(mor_m=400)), True),
        (Light(), Weather(smog=Smog(mor_m=600)), False),
        (Light(sky_luminance_cd_m2=100), Weather(), True),
        (Light(sky_luminance_cd_m2=1000), Weather(), False),
        (Light(vehicles="off", time="night"), Weather(rain=Rain(rate_mm_h=1)), False),
        (Light(vehicles="on"), Weather(), True),
        (None, Weather(rain=Rain(rate_mm_h=1)), False),
    )
    for light, weather, has_lamps in cases:
        names = {tag.name for tag in tags_of(Recipe(light=light, weather=weather)).openlabel}
        assert ("ArtificialVehicleLighting" in names) == has_lamps, (light, weather)


def test_weather_of_several_kinds_has_the_tags_of_each() -> None:
    weather = Weather(
        smog=Smog(mor_m=300),
        rain=Rain(rate_mm_h=3, wind_mps=4, wind_from_deg=-90),
        snowfall=Snowfall(rate_mm_h=6),
        snow=Snow(depth_m=0.1),
    )
    tags = tags_of(Recipe(weather=weather, light=Light(time="night")))
    assert (tags.wmo_weather, tags.wmo_4680) == ("+SNRA FG", 68)
    assert (tags.openscenario_precipitation, tags.openscenario_wetness) == (
        "snow",
        "wetWithPuddles",
    )
    assert tags.osi_precipitation == "heavy" and tags.friction_scale == 0.39
    assert {tag.name for tag in tags.openlabel} >= {
        *("WeatherRain", "WeatherSnow", "ParticulatesWater", "SurfaceConditionSnow"),
        *("LowLightNight", "ArtificialStreetLighting", "ArtificialVehicleLighting"),
    }
    values = {tag.name: tag.value for tag in tags.openlabel}
    assert values["particulatesWaterValue"] == 300 and values["weatherRainValue"] == 3


def test_a_recipe_without_weather_has_no_classes_of_weather() -> None:
    tags = tags_of(Recipe())
    assert columns_of_tags(Recipe()) == {
        **dict.fromkeys(CLASS_COLUMNS, "none"),
        "mor_m": None,
        "osi_fog": "excellent",
        "osi_illumination": "unknown",
        "wmo_weather": "NSW",
        "openscenario_wetness": "dry",
    }
    assert (tags.extinction_per_m, tags.openlabel, tags.friction_scale) == (0.0, (), 1.0)
    numbers = [getattr(tags, f.name) for f in fields(Tags)]
    assert not any(isinstance(n, float) and not math.isfinite(n) for n in numbers)
    # Sections without strength change nothing.
    weak = Weather(smog=Smog(extinction_per_m=0), rain=Rain(rate_mm_h=0), snow=Snow(depth_m=0))
    assert tags_of(Recipe(weather=weak)) == tags


def test_roads_dry_from_puddles_to_moist_to_dry() -> None:
    def wetness(**values: float) -> str:
        return tags_of(Recipe(weather=Weather(rain=Rain(**values)))).openscenario_wetness

    assert wetness(rate_mm_h=0, wetness=0.8, puddles=0.2) == "wetWithPuddles"
    assert wetness(rate_mm_h=0, wetness=0.8, puddles=0.0) == "moist"
    assert wetness(rate_mm_h=0, wetness=0.0, puddles=0.5) == "dry"

    def after_rain(**water: float) -> str:
        road = RoadWater(puddle_fill=0.0, **water)
        weather = Weather(rain=Rain(rate_mm_h=0, road=road))
        return tags_of(Recipe(weather=weather)).openscenario_wetness

    assert [after_rain(film_mm=film_mm) for film_mm in (0.0, 0.009, 0.01, 0.6)] == [
        *("dry", "dry", "moist", "moist")
    ]
    assert after_rain(film_mm=0.0, spots=0.1) == "moist"


def test_light_of_the_street_counts_where_lamps_are_on() -> None:
    night = Light(time="night", sky_luminance_cd_m2=0.0, street_lumen=10000)
    assert illuminance_of(night) == pytest.approx(11.4, abs=0.05)  # 1,000 lm give 1.14 lx
    assert illuminance_of(night.model_copy(update={"street": "off"})) == 0
    half = night.model_copy(update={"street_spacing_m": 60.0})
    assert illuminance_of(half) == pytest.approx(5.7, abs=0.03)
    assert illuminance_of(Light(time="day")) is None and illuminance_of(None) is None


def test_a_scale_has_a_name_for_each_class() -> None:
    scale = Scale((1, 2), ("a", "b", "c"), "a source")
    assert [scale.class_of(n) for n in (0.5, 1, 2, math.inf)] == ["a", "b", "c", "c"]
    assert replace(scale, belongs_below=True).class_of(1) == "a"
    with pytest.raises(ValueError, match="one more than borders"):
        replace(scale, names=("a", "b"))
    with pytest.raises(ValueError, match="which rise"):
        replace(scale, borders=(2, 1))
