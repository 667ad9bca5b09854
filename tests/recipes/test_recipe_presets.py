"""What the presets promise in docs/recipes.md, at every end of their ranges."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from recipes.flood import Flood
from recipes.load import load_recipe
from recipes.ranges import Uniform, ends
from recipes.schema import Weather
from recipes.smog import KOSCHMIEDER

PAGE = (Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")


def end_values(name: str, path: str) -> list[float]:
    """Return the ends of a preset's range."""
    return [end.value for end in ends(load_recipe(name).values[path])]


def arriving(name: str, distance_m: float) -> tuple[float, float]:
    """Least and greatest share of a colour that arrives from `distance_m` at the base height."""
    visibilities_m = end_values(name, "weather.smog.visibility_m")
    shares = [math.exp(-KOSCHMIEDER * distance_m / v) for v in visibilities_m]
    return min(shares), max(shares)


def zenith(name: str) -> tuple[float, float]:
    shares = [
        math.exp(-KOSCHMIEDER * height_m / visibility_m)
        for height_m in end_values(name, "weather.smog.scale_height_m")
        for visibility_m in end_values(name, "weather.smog.visibility_m")
    ]
    return min(shares), max(shares)


def test_clear_is_without_weather() -> None:
    template = load_recipe("clear")
    assert template.describe_ranges() == {}
    assert template.resolve(0).weather == Weather()


@pytest.mark.parametrize(
    ("name", "distance_m", "low", "high"),
    [
        ("light-haze", 200, 0.38, 0.68),
        ("light-haze", 50, 0.78, 0.91),
        ("brown-smog", 200, 0.04, 0.27),
        ("dense-fog", 50, 0.02, 0.20),
        ("dense-fog", 200, 0.00, 0.00),
    ],
)
def test_how_far_one_sees(name: str, distance_m: float, low: float, high: float) -> None:
    # half a unit of the last digit that the preset's comment and the documentation give
    assert arriving(name, distance_m) == pytest.approx((low, high), abs=0.005)


def test_the_sky_over_the_layers() -> None:
    assert zenith("light-haze")[0] > 0.4, "nearly clear overhead"
    assert 0.04 < zenith("brown-smog")[0] < zenith("brown-smog")[1] < 0.8, "dimmed overhead"
    fog = load_recipe("dense-fog").resolve(0).weather.smog
    assert fog is not None and fog.scale_height_m is None


FLOODS = {"street-flood": 0.30912935, "deep-flood": 0.9182587}
KERB_M = 0.068  # over the lane of a road that falls 2 % sideways
HUB_M, WINDOW_M = 0.3, 0.9


def test_how_high_the_water_stands() -> None:
    low_m, high_m = end_values("street-flood", "weather.flood.level_m")
    assert max(KERB_M, HUB_M) <= low_m
    assert high_m < WINDOW_M <= end_values("deep-flood", "weather.flood.level_m")[0]


def test_puddles_stand_on_a_wet_road_after_the_rain() -> None:
    for number in range(20):
        weather = load_recipe("puddled").resolve(number).weather
        assert weather.flood is None and weather.rain is not None
        assert weather.rain.rate_mm_h == 0 and 0.15 <= weather.rain.puddle_share <= 0.35
        assert weather.rain.ground_wetness >= 0.6


def test_how_deep_one_sees() -> None:
    for name, shallow_cm, deep_cm in (("street-flood", 1, 3), ("deep-flood", 0.3, 1.3)):
        depths_cm = [
            100 / Flood(level_m=0, turbidity_ntu=turbidity).extinction_per_m_rgb[1]
            for turbidity in end_values(name, "weather.flood.turbidity_ntu")
        ]
        # as the comments round them
        assert depths_cm[::-1] == pytest.approx((shallow_cm, deep_cm), rel=0.12)


@pytest.mark.parametrize("name", FLOODS)
def test_drawn_floods_are_pinned_and_brown(name: str) -> None:
    variants = [load_recipe(name).resolve(i).weather for i in range(20)]
    floods = [weather.flood for weather in variants if weather.flood is not None]
    assert len(floods) == 20 and all(weather.smog is None for weather in variants)
    assert floods[0].level_m == FLOODS[name]
    assert len({flood.level_m for flood in floods}) == 20
    assert all(red >= green >= blue for red, green, blue in (flood.color for flood in floods))
    assert all(weather.snow is None for weather in variants)


# of draw 0; least and greatest depth, m
SNOWS = {
    "dusting": (0.01805341217, 0.005, 0.02),
    "fresh-snow": (0.1148090991, 0.08, 0.12),
    "deep-snow": (0.476640946, 0.32, 0.5),
    "winter-fog": (0.1096181982, 0.04, 0.12),
}
TRACKS_TO_M = 0.3  # "auto" draws no tracks in deeper snow


@pytest.mark.parametrize("name", SNOWS)
def test_drawn_snow_is_pinned_and_as_deep_as_documented(name: str) -> None:
    first_m, low_m, high_m = SNOWS[name]
    assert load_recipe(name).values["weather.snow.depth_m"] == Uniform(low_m, high_m)
    variants = [load_recipe(name).resolve(i).weather for i in range(20)]
    snows = [weather.snow for weather in variants if weather.snow is not None]
    assert len(snows) == 20 and all(weather.flood is None for weather in variants)
    assert snows[0].depth_m == first_m
    assert len({snow.depth_m for snow in snows}) == 20
    assert (low_m > TRACKS_TO_M) == (name == "deep-snow") and snows[0].tracks == "auto"
    assert (max(s.coverage for s in snows) < 1) == (name == "dusting")
    said = [s.light.sun for s in snows if s.light.sun is not None]
    soft = {"deep-snow": 0.3, "winter-fog": 0.1}
    assert max(said) <= soft[name] if name in soft else not said


def test_fog_over_snow() -> None:
    assert arriving("winter-fog", 200) == pytest.approx((0.02, 0.14), abs=0.005)
    fogs = [load_recipe(name).resolve(0).weather.smog for name in SNOWS]
    assert [fog is not None for fog in fogs] == [name == "winter-fog" for name in SNOWS]
    assert fogs[-1] is not None and fogs[-1].scale_height_m is None, "the sky is hidden"


STYLES = {
    "overcast": {"overcast"},
    "evening": {"golden-hour", "dusk", "blue-hour"},
    "drizzle": {"overcast"},
    "rain": {"overcast"},
    "downpour": {"rain"},
    "storm": {"rain"},
    "flurries": {"overcast"},
    "snowfall": {"snow-light"},
    "blizzard": {"snow-light"},
    "winter-day": {"snow-light"},
}


@pytest.mark.parametrize("name", STYLES)
def test_styled_presets_are_of_the_styles_documented(name: str) -> None:
    template = load_recipe(name)
    low, high = end_values(name, "style.strength")
    rows = [line for line in PAGE.splitlines() if line.startswith(f"| `{name}` |")]
    (row,) = [line for line in rows if f", {low:g} to {high:g} |" in line]
    assert all(f"`{style}`" in row for style in STYLES[name])
    recipes = [template.resolve(i) for i in range(20)]
    drawn = [recipe.style for recipe in recipes if recipe.style is not None]
    assert len(drawn) == 20 and {style.preset for style in drawn} == STYLES[name]
    is_clear = name in {"overcast", "evening"}
    assert all((recipe.weather == Weather()) == is_clear for recipe in recipes)


def test_weather_of_styled_days() -> None:
    assert load_recipe("winter-day").values["weather.snow.depth_m"] == Uniform(0.05, 0.15)


# Least and greatest rate, mm/h, and wind, m/s, as documented.
FALLING = {
    "drizzle": (0.3, 1, 0, 3),
    "rain": (5, 15, 1, 6),
    "downpour": (35, 70, 1, 8),
    "storm": (80, 150, 14, 24),
    "flurries": (0.15, 0.4, 0, 4),
    "snowfall": (0.8, 2.5, 0, 5),
    "blizzard": (6, 15, 14, 22),
}


@pytest.mark.parametrize("name", FALLING)
def test_what_falls_at_which_rate(name: str) -> None:
    values = load_recipe(name).values
    section = "snowfall" if "weather.snowfall.rate_mm_h" in values else "rain"
    fields = (f"weather.{section}.{field}" for field in ("rate_mm_h", "wind_mps"))
    found = [end for field in fields for end in end_values(name, field)]
    assert tuple(found) == FALLING[name]
    low, high, calm, windy = FALLING[name]
    rows = [line for line in PAGE.splitlines() if line.startswith(f"| `{name}` |")]
    (row,) = [line for line in rows if " mm/h" in line]
    assert f"{low:g} to {high:g} mm/h" in row and f"{calm:g} to {windy:g} m/s" in row
