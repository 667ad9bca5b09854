"""What a recipe may say of snow, and the messages for what was meant to be said."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from recipes.errors import RecipeError
from recipes.load import dump_recipe
from recipes.parse import parse_recipe
from recipes.template import Choice, Fixed, RecipeTemplate, Uniform
from recipes.weather import Snow, SnowLight, SnowWind


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    return caught.value.problems


def template(text: str) -> RecipeTemplate:
    return parse_recipe(text, source="r.yaml")


def snow(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  snow:\n    {field}\n    depth_m: 0.1\n"


def test_a_depth_is_enough() -> None:
    weather = template("weather: {snow: {depth_m: 0.1}}").resolve(0).weather
    assert weather.snow == Snow(depth_m=0.1) and weather.flood is None and weather.smog is None


def test_sections_may_be_left_empty() -> None:
    assert template(snow("light:")).resolve(0).weather.snow == Snow(depth_m=0.1)
    assert template("weather:\n  snow:\n").resolve(0).weather.snow is None


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("depth_cm: 10", "depth_cm: unknown field; did you mean depth_m (metres)?"),
        ("depth: 10cm", "depth: unknown field; did you mean depth_m (metres)?"),
        ("thickness_cm: 10", "thickness_cm: unknown field; did you mean depth_m (metres)?"),
        ("level_m: 0.1", "level_m: unknown field; did you mean depth_m (metres)?"),
        ("coverage: 80", "coverage = 80: must be >= 0 and <= 1"),
        ("coverage: 80 %", "must be a number >= 0 and <= 1; write the number alone"),
        ("max_slope_rad: 1", "did you mean max_slope_deg (degrees)?"),
        ("max_slope_deg: 86", "max_slope_deg = 86: must be >= 0 and <= 85 (degrees)"),
        ("glitter: 1", "glitter: unknown field; did you mean sparkle?"),
        ("cell_cm: 5", "did you mean cell_m (metres)?"),
        ("cell_m: 0", "cell_m = 0: must be >= 0.001 and <= 10 (metres)"),
        ("tracks: alway", "must be one of auto, always, never; did you mean always?"),
        ("tracks: true", "tracks = true: must be one of auto, always, never"),
        ("shading: per-pixel", "one of per_splat, per_pixel; did you mean per_pixel?"),
        ("wind: 30", "wind = 30: must be a mapping, with direction_deg, drift"),
        ("wind: {direction_deg: 400}", "must be >= -360 and <= 360 (degrees)"),
        ("wind: {drifts: 1}", "drifts: unknown field; did you mean drift?"),
        ("drift: 1", "drift: unknown field here; did you mean weather.snow.wind.drift?"),
        ("brightness: 1", "did you mean weather.snow.light.brightness?"),
        ("light: bright", "a mapping, with sun_azimuth_deg, sun_elevation_deg, sun, brightness"),
        ("light: {azimuth: 90}", "did you mean sun_azimuth_deg (degrees)?"),
        ("light: {elevation_deg: 90}", "did you mean sun_elevation_deg (degrees)?"),
        ("light: {sun_elevation_deg: -1}", "= -1: must be >= 0 and <= 90 (degrees)"),
        ("light: {sun: clear}", "sun = 'clear': must be a number >= 0 and <= 1, or null"),
        ("light: {brightness: {uniform: [0.5, 2]}}", "brightness.uniform[1] = 2: must be >= 0 an"),
    ],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(field: str, message: str) -> None:
    (problem,) = problems(snow(field))
    assert problem.startswith("r.yaml:4: weather.snow.")
    assert message in problem


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("snow: {depth_m: 0.1}", "snow: unknown field here; did you mean weather.snow?"),
        ("weather: {snowfall: 1}", "weather.snowfall: unknown field; did you mean snow?"),
        ("weather: {snow: 0.1}", "weather.snow = 0.1: must be a mapping, with depth_m, coverage"),
        ("weather: {depth_m: 0.1}", "did you mean weather.snow.depth_m or weather.flood.level_m?"),
        ("weather: {wind: {}}", "did you mean weather.snow.wind or weather.flood.waves?"),
        ("weather: {flood: {level_m: 1, wind: 3}}", "wind: unknown field; did you mean waves?"),
        ("weather: {flood: {level_m: 1, depth_cm: 3}}", "unknown field; did you mean level_m (m"),
        ("output: {surface: snow}", "surface = 'snow': must be one of solid, scene, first"),
        ("output: {surface: sold}", "did you mean solid?"),
    ],
)
def test_what_was_meant_in_another_place(text: str, message: str) -> None:
    (problem,) = problems(text)
    assert message in problem


@pytest.mark.parametrize("depth", ["10cm", "10 cm", "-0.1", "11", "null", "true", "[0.1]", "'1'"])
def test_a_depth_that_is_none(depth: str) -> None:
    (problem,) = problems(f"weather:\n  snow:\n    depth_m: {depth}")
    assert problem.startswith("r.yaml:3: weather.snow.depth_m = ")
    assert ">= 0 and <= 10 (metres)" in problem
    assert problem.endswith("; write the number alone") == depth.endswith("cm")


def test_snow_without_a_depth() -> None:
    missing = "weather.snow.depth_m: must be given, a number >= 0 and <= 10 (metres)"
    assert problems("seed: 1\nweather:\n  snow: {}") == (f"r.yaml:3: {missing}",)
    assert problems("weather: {snow: {coverage: 2}}") == (
        "r.yaml:1: weather.snow.coverage = 2: must be >= 0 and <= 1",
        f"r.yaml:1: {missing}",
    )


@pytest.mark.parametrize(
    ("model", "data"),
    [
        (Snow, {}),
        (Snow, {"depth_m": "1"}),
        (Snow, {"depth_m": math.nan}),
        (Snow, {"depth_m": 1, "level_m": 1}),
        (Snow, {"depth_m": 1, "tracks": "sometimes"}),
        (Snow, {"depth_m": 1, "seed": -1}),
        (Snow, {"depth_m": 1, "wind": None}),
        (SnowLight, {"sun": 1.1}),
        (SnowLight, {"sun_azimuth_deg": True}),
        (SnowWind, {"drift": None}),
        (SnowWind, {"speed_mps": 3}),
    ],
)
def test_the_models_are_strict_and_closed(model: type[BaseModel], data: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        model(**data)


RANGED = """
seed: 3
weather:
  snow:
    depth_m: {uniform: [0.05, 0.2]}
    tracks: {choice: [auto, never]}
    light: {sun: {choice: [null, 0.5]}}
    wind: {direction_deg: {uniform: [0, 360]}}
"""


def snows(text: str, count: int) -> list[Snow | None]:
    read = template(text)
    return [read.resolve(i).weather.snow for i in range(count)]


def test_every_field_takes_ranges_at_every_depth() -> None:
    values = dict(template(RANGED).values)
    assert values["weather.snow.depth_m"] == Uniform(0.05, 0.2)
    assert values["weather.snow.light.sun"] == Choice((Fixed(None), Fixed(0.5)), (1.0, 1.0))
    drawn = [snow for snow in snows(RANGED, 30) if snow is not None]
    assert len({snow.depth_m for snow in drawn}) == len({s.wind.direction_deg for s in drawn}) == 30
    assert {snow.tracks for snow in drawn} == {"auto", "never"}
    assert {snow.light.sun for snow in drawn} == {None, 0.5}
    assert all(snow.coverage == 1 and snow.light.brightness is None for snow in drawn)


def test_another_field_or_a_flood_changes_no_draw() -> None:
    more = RANGED + "    grain: {uniform: [0, 1]}\n  flood: {level_m: {uniform: [0, 1]}}\n"
    for here, there in zip(snows(RANGED, 5), snows(more, 5), strict=True):
        assert here is not None and there is not None and there != here
        assert there.model_copy(update={"grain": here.grain}) == here


def test_snow_that_is_absent_takes_its_sections_along() -> None:
    text = RANGED.replace("  snow:\n", "  snow:\n    probability: 0.5\n")
    pairs = list(zip(snows(RANGED, 12), snows(text, 12), strict=True))
    kept = [(a, b) for a, b in pairs if b is not None]
    assert 0 < len(kept) < 12 and all(a == b for a, b in kept)


def test_drawn_snow_reads_back_equal() -> None:
    for i in range(5):
        recipe = template(RANGED).resolve(i)
        text = dump_recipe(recipe)
        assert "    light:\n      sun_azimuth_deg: null\n" in text and "surface: solid" in text
        again = template(text).resolve(0)
        assert again == recipe and again.hash == recipe.hash
