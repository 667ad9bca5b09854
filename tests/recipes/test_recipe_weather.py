"""Flood and snow: their own rules, messages of fields and lists, and how clear water is."""

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.flood import MAX_WAVES, PURE_WATER_PER_M, Flood, Wave, Waves
from recipes.load import parse_recipe
from recipes.ranges import Choice, Uniform
from recipes.template import RecipeTemplate


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    return caught.value.problems


def template(text: str) -> RecipeTemplate:
    return parse_recipe(text, source="r.yaml")


def flood(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  flood:\n    {field}\n    level_m: 0.2\n"


def snow(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  snow:\n    {field}\n    depth_m: 0.1\n"


def waves(*items: str) -> str:
    """A recipe with wave i on line 6 + i."""
    lines = "".join(f"        - {{{item}}}\n" for item in items)
    return f"weather:\n  flood:\n    level_m: 0.2\n    waves:\n      components:\n{lines}"


WRONG = {
    "flood": [
        ("level_cm: 20", "level_cm: unknown field; did you mean level_m (metres)?"),
        ("turbidity: 5", "did you mean turbidity_ntu (nephelometric turbidity units)?"),
        ("turbidity_ntu: 5 NTU", "turbidity units), or null; write the number alone"),
        ("refraction: 1.3", "unknown field; did you mean refraction_index?"),
        ("refraction_index: 0.9", "refraction_index = 0.9: must be >= 1 and <= 3"),
        ("reference: lowst", "one of lowest, median, absolute; did you mean lowest?"),
        ("reflection: screen", "must be one of sky, screen_space, mirrored"),
        ("preset: calm", "preset: unknown field here; did you mean weather.flood.waves.preset?"),
        ("absorption_per_m: 3", "= 3: must be [red, green, blue], each a number >= 0 and <= 10000"),
        ("absorption_per_m: [1, 2, {uniform: [0, x]}]", "_m[2].uniform[1] = 'x': must be a number"),
        ("absorption_per_m: {uniform: [1, [1, 1, 1]]}", "uniform[0] = 1: must be [red, green, blu"),
        ("absorption_per_m: {uniform: [[1, 1, 1]]}", "must be [from, to], each [red, green, blue]"),
        (
            "absorption_per_m: {uniform: [[1, 1, 1], [2, 2, {uniform: [2, 3]}]]}",
            "uniform[1][2] = {uniform: ...}: must be a number",
        ),
        ("absorption_per_m: {log_uniform: [1, 2]}", "a range here is uniform or choice"),
        ("waves: breeze", "waves = 'breeze': must be a mapping, with preset, count, direction_deg"),
        ("waves: {direction_rad: 4}", "did you mean direction_deg (degrees)?"),
        ("waves: {components: {choice: [1]}}", "components = {choice: ...}: must be a list of up"),
        ("waves: {components: [3]}", "components[0] = 3: must be a mapping, with direction_deg"),
        (
            f"waves: {{components: [{', '.join(['{}'] * (MAX_WAVES + 1))}]}}",
            "components = a list of 65: must be a list of up to 64 mappings",
        ),
    ],
    "snow": [
        ("depth_cm: 10", "depth_cm: unknown field; did you mean depth_m (metres)?"),
        ("depth: 10cm", "depth: unknown field; did you mean depth_m (metres)?"),
        ("level_m: 0.1", "level_m: unknown field; did you mean depth_m (metres)?"),
        ("coverage: 80 %", "must be a number >= 0 and <= 1; write the number alone"),
        ("max_slope_deg: 86", "max_slope_deg = 86: must be >= 0 and <= 85 (degrees)"),
        ("cell_cm: 5", "did you mean cell_m (metres)?"),
        ("shading: per-pixel", "one of per_splat, per_pixel; did you mean per_pixel?"),
        ("wind: 30", "wind = 30: must be a mapping, with direction_deg, drift"),
        ("drift: 1", "drift: unknown field here; did you mean weather.snow.wind.drift?"),
        ("brightness: 1", "did you mean weather.snow.light.brightness?"),
        ("light: bright", "a mapping, with sun_azimuth_deg, sun_elevation_deg, sun, brightness"),
        ("light: {azimuth: 90}", "did you mean sun_azimuth_deg (degrees)?"),
        ("light: {sun_elevation_deg: -1}", "= -1: must be >= 0 and <= 90 (degrees)"),
        ("light: {brightness: {uniform: [0.5, 2]}}", "brightness.uniform[1] = 2: must be >= 0 an"),
    ],
}


@pytest.mark.parametrize(
    ("effect", "field", "message"),
    [(effect, *row) for effect, rows in WRONG.items() for row in rows],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(
    effect: str, field: str, message: str
) -> None:
    (problem,) = problems(flood(field) if effect == "flood" else snow(field))
    assert problem.startswith(f"r.yaml:4: weather.{effect}.")
    assert message in problem


def test_a_flood_without_a_level() -> None:
    missing = "weather.flood.level_m: must be given, a number >= -10000 and <= 10000 (metres)"
    assert problems("seed: 1\nweather:\n  flood: {}") == (f"r.yaml:3: {missing}",)
    assert set(problems("weather:\n  flood: {probability: -1}")) == {
        "r.yaml:2: weather.flood.probability = -1: must be >= 0 and <= 1",
        f"r.yaml:2: {missing}",
    }
    (null,) = problems("weather:\n  flood: {level_m: null}")
    assert null.startswith("r.yaml:2: weather.flood.level_m = null: must be a number >= -10000")


def test_problems_of_a_list_name_the_item_and_its_line() -> None:
    found = problems(
        waves(
            "amplitude_m: 0.1, wavelength_m: 2, steepness: 2",
            "amplitude_m: 0.1",
            "amplitude_m: 0.1, wavelength_m: 2, phase_deg: {uniform: [0, 400]}",
            "amplitude_cm: 1, wavelength_m: 2, amplitude_m: 0.1",
        )
    )
    path = "weather.flood.waves.components"
    assert found == (
        f"r.yaml:6: {path}[0].steepness = 2: must be >= 0 and <= 1",
        f"r.yaml:7: {path}[1].wavelength_m: must be given, a number >= 0.001 and <= 10000 (metres)",
        f"r.yaml:8: {path}[2].phase_deg.uniform[1] = 400: must be >= -360 and <= 360 (degrees)",
        f"r.yaml:9: {path}[3].amplitude_cm: unknown field; did you mean amplitude_m (metres)?",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (flood("turbidity_ntu: 5\n    absorption_per_m: [1, 1, 1]"), "r.yaml:3: weather.flood: tu"),
        (
            flood("turbidity_ntu: {choice: [null, 5]}\n    absorption_per_m: [1, 1, 1]"),
            "keep one of them (in a draw with turbidity_ntu = 5)",
        ),
        (
            waves("amplitude_m: 0.1, wavelength_m: 2", "amplitude_m: 0.5, wavelength_m: 2"),
            "r.yaml:7: weather.flood.waves.components[1]: amplitude_m = 0.5 is too high for "
            "wavelength_m = 2: the wave would break; at most 0.3183 (wavelength / 2 pi)",
        ),
        (
            waves("amplitude_m: {uniform: [0.1, 0.5]}, wavelength_m: {uniform: [1, 4]}"),
            "at most 0.1591 (wavelength / 2 pi) (in a draw with amplitude_m = 0.5, wavelength_m",
        ),
        (
            waves(*["amplitude_m: 0.1, wavelength_m: 2, steepness: 0.4"] * 3),
            "r.yaml:4: weather.flood.waves: the steepness of its 3 components adds up to 1.2; "
            "above 1 the surface would loop",
        ),
        (
            waves(
                "amplitude_m: 0.1, wavelength_m: 2, steepness: 0.4",
                "amplitude_m: 0.1, wavelength_m: 2, steepness: {uniform: [0.1, 0.8]}",
            ),
            "adds up to 1.2; above 1 the surface would loop (in a draw with "
            "components[1].steepness = 0.8)",
        ),
    ],
)
def test_rules_between_fields(text: str, message: str) -> None:
    assert any(message in problem for problem in problems(text))


def test_rules_that_hold_at_the_ends_are_quiet() -> None:
    parse_recipe(
        waves(
            "amplitude_m: {uniform: [0.1, 0.3]}, wavelength_m: {uniform: [2, 4]}, steepness: 0.4",
            "amplitude_m: 0, wavelength_m: 0.001, steepness: {choice: [0, {uniform: [0.1, 0.6]}]}",
        ),
        source="r",
    )
    text = "turbidity_ntu: {choice: [null, 5]}\n    absorption_per_m: null"
    parse_recipe(flood(text), source="r")


@pytest.mark.parametrize("wavelength_m", [1e-3, 0.3, 1.0, 2.0, 12.34, 628.0])
def test_the_amplitude_that_a_message_allows_is_allowed(wavelength_m: float) -> None:
    with pytest.raises(ValidationError) as caught:
        Wave(amplitude_m=wavelength_m / 6.281, wavelength_m=wavelength_m)
    allowed = str(caught.value).split("at most ")[1].split(" ")[0]
    wave = Wave(amplitude_m=float(allowed), wavelength_m=wavelength_m)
    # four digits, rounded down
    assert 0.999 < 2 * math.pi * wave.amplitude_m / wavelength_m <= 1


def test_steepness_may_add_up_to_one() -> None:
    ten = [Wave(amplitude_m=0.01, wavelength_m=1, steepness=0.1)] * 10
    assert Waves(components=tuple(ten)).components == tuple(ten)
    with pytest.raises(ValidationError, match=r"of its 11 components adds up to 1\.1;"):
        Waves(components=(*ten, ten[0]))


def test_particles_add_the_same_to_every_channel_and_in_proportion() -> None:
    one, ten = (Flood(level_m=0, turbidity_ntu=t).extinction_per_m_rgb for t in (1.0, 10.0))
    added = [a - b for a, b in zip(one, PURE_WATER_PER_M, strict=True)]
    # a few rounding errors of numbers near 10
    assert added == pytest.approx([0.5, 0.5, 0.5], abs=1e-12)
    assert [a - b for a, b in zip(ten, PURE_WATER_PER_M, strict=True)] == pytest.approx(
        [10 * a for a in added], abs=1e-12
    )


def test_clarity_is_that_of_rivers() -> None:
    """A black disc is seen as far as 4.8 / extinction: 0.2 m at 50 NTU, within a factor two."""
    green = Flood(level_m=0, turbidity_ntu=50).extinction_per_m_rgb[1]
    assert 0.1 < 4.8 / green < 0.4


RANGED = """
seed: 3
weather:
  snow:
    depth_m: {uniform: [0.05, 0.2]}
    tracks: {choice: [auto, never]}
    light: {sun: {choice: [null, 0.5]}}
    wind: {direction_deg: {uniform: [0, 360]}}
"""


def test_every_field_takes_ranges_at_every_depth() -> None:
    values = template(RANGED).values
    assert values["weather.snow.depth_m"] == Uniform(0.05, 0.2)
    assert values["weather.snow.light.sun"] == Choice((None, 0.5), (1.0, 1.0))
    weather = [template(RANGED).resolve(i).weather for i in range(30)]
    drawn = [each.snow for each in weather if each.snow is not None]
    assert len({snow.depth_m for snow in drawn}) == len({s.wind.direction_deg for s in drawn}) == 30
    assert {snow.tracks for snow in drawn} == {"auto", "never"}
    assert {snow.light.sun for snow in drawn} == {None, 0.5}
    assert all(snow.coverage == 1 and snow.light.brightness is None for snow in drawn)
