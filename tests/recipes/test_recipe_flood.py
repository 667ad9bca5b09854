"""A flood's own rules, the messages of its fields and lists, and how clear its water is."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.parse import parse_recipe
from recipes.template import Channels, Choice, Fixed, TripleLine, Uniform
from recipes.weather import MAX_WAVES, PURE_WATER_PER_M, Flood, Wave, Waves


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    return caught.value.problems


def flood(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  flood:\n    {field}\n    level_m: 0.2\n"


def waves(*items: str) -> str:
    """A recipe with wave i on line 6 + i."""
    lines = "".join(f"        - {{{item}}}\n" for item in items)
    return f"weather:\n  flood:\n    level_m: 0.2\n    waves:\n      components:\n{lines}"


def test_a_level_is_enough() -> None:
    recipe = parse_recipe("weather: {flood: {level_m: 0.2}}", source="r").resolve(0)
    assert recipe.weather.flood == Flood(level_m=0.2)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("level_cm: 20", "level_cm: unknown field; did you mean level_m (metres)?"),
        ("turbidity: 5", "did you mean turbidity_ntu (nephelometric turbidity units)?"),
        ("turbidity_ntu: -1", "turbidity_ntu = -1: must be >= 0 and <= 1000000 (nephelometric"),
        ("turbidity_ntu: 5 NTU", "turbidity units), or null; write the number alone"),
        ("refraction: 1.3", "unknown field; did you mean refraction_index?"),
        ("ior: 1.3", "unknown field; did you mean refraction_index?"),
        ("refraction_index: 0.9", "refraction_index = 0.9: must be >= 1 and <= 3"),
        ("reference: lowst", "one of lowest, median, absolute; did you mean lowest?"),
        ("reflection: screen", "must be one of sky, screen_space, mirrored"),
        ("preset: calm", "preset: unknown field here; did you mean weather.flood.waves.preset?"),
        (
            "absorption_per_m: 3",
            "= 3: must be [red, green, blue], each a number >= 0 and <= 1000000 (1/metre)",
        ),
        ("absorption_per_m: [1, 2]", "absorption_per_m = [1, 2]: must be [red, green, blue], each"),
        ("absorption_per_m: [1, -2, 3]", "_m[1] = -2: must be >= 0 and <= 1000000 (1/metre)"),
        ("absorption_per_m: [1, 2, {uniform: [0, x]}]", "_m[2].uniform[1] = 'x': must be a number"),
        (
            "absorption_per_m: {uniform: [1, [1, 1, 1]]}",
            "uniform[0] = 1: must be [red, green, blue], each",
        ),
        ("absorption_per_m: {uniform: [[1, 1, 1]]}", "must be [from, to], two triples of rates"),
        (
            "absorption_per_m: {uniform: [[1, 1, 1], [2, 2, {uniform: [2, 3]}]]}",
            "the two triples of rates must be written out, without ranges",
        ),
        ("absorption_per_m: {log_uniform: [1, 2]}", "a range here is uniform or choice"),
        ("waves: breeze", "waves = 'breeze': must be a mapping, with preset, count, direction_deg"),
        ("waves: {direction_deg: 400}", "must be >= -360 and <= 360 (degrees)"),
        ("waves: {direction_rad: 4}", "did you mean direction_deg (degrees)?"),
        ("waves: {preset: storm}", "must be one of still, calm, breeze, wind"),
        ("waves: {count: 65}", "waves.count = 65: must be >= 1 and <= 64"),
        (
            "waves: {components: {choice: [1]}}",
            "components = {choice: ...}: must be a list of up to 64 mappings, each with direction_",
        ),
        ("waves: {components: 3}", "phase_deg; or null"),
        ("waves: {components: [3]}", "components[0] = 3: must be a mapping, with direction_deg"),
        ("waves: {components: [null]}", "components[0] = null: must be a mapping, with direction"),
        (
            f"waves: {{components: [{', '.join(['{}'] * (MAX_WAVES + 1))}]}}",
            "components = a list of 65: must be a list of up to 64 mappings",
        ),
    ],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(field: str, message: str) -> None:
    (problem,) = problems(flood(field))
    assert problem.startswith("r.yaml:4: weather.flood.")
    assert message in problem


def test_a_flood_without_a_level() -> None:
    missing = "weather.flood.level_m: must be given, a number >= -10000 and <= 10000 (metres)"
    assert problems("seed: 1\nweather:\n  flood: {}") == (f"r.yaml:3: {missing}",)
    assert problems("weather:\n  flood: {probability: -1}") == (
        "r.yaml:2: weather.flood.probability = -1: must be >= 0 and <= 1",
        f"r.yaml:2: {missing}",
    )
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
        (
            flood("turbidity_ntu: 5\n    absorption_per_m: [1, 1, 1]"),
            "r.yaml:3: weather.flood: turbidity_ntu and absorption_per_m both say how clear the "
            "water is: keep one of them",
        ),
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
            "adds up to 1.2; above 1 the surface would loop (in a draw with all components at the "
            "high ends of their ranges)",
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


@pytest.mark.parametrize(
    ("model", "data"),
    [
        (Flood, {}),
        (Flood, {"level_m": "1"}),
        (Flood, {"level_m": math.nan}),
        (Flood, {"level_m": 1, "depth_m": 1}),
        (Flood, {"level_m": 1, "absorption_per_m": (1, 1)}),
        (Flood, {"level_m": 1, "absorption_per_m": (1, 1, math.inf)}),
        (Flood, {"level_m": 1, "turbidity_ntu": True}),
        (Flood, {"level_m": 1, "reference": "highest"}),
        (Waves, {"count": 2.0}),
        (Waves, {"components": ({"amplitude_m": 0.1},)}),
        (Waves, {"components": (Wave(amplitude_m=0, wavelength_m=1),) * (MAX_WAVES + 1)}),
        (Wave, {"amplitude_m": -0.1, "wavelength_m": 1}),
        (Wave, {"amplitude_m": 0.1, "wavelength_m": 0}),
    ],
)
def test_the_models_are_strict_and_closed(model: type, data: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        model(**data)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("absorption_per_m: [0, 2, 1e3]", Fixed((0.0, 2.0, 1000.0))),
        ("absorption_per_m: {uniform: [[0, 0, 0], [1, 2, 3]]}", TripleLine((0.0,) * 3, (1, 2, 3))),
        (
            "absorption_per_m: [1, {uniform: [0, 9]}, 1]",
            Channels((Fixed(1.0), Uniform(0.0, 9.0), Fixed(1.0))),
        ),
        (
            "absorption_per_m: {choice: [null, [1, 1, 1]]}",
            Choice((Fixed(None), Fixed((1.0, 1.0, 1.0))), (1.0, 1.0)),
        ),
    ],
)
def test_rates_take_the_ranges_of_colours(field: str, value: object) -> None:
    template = parse_recipe(flood(field), source="r")
    assert dict(template.values)["weather.flood.absorption_per_m"] == value


def test_pure_water_takes_red_first() -> None:
    assert Flood(level_m=0, turbidity_ntu=0).extinction_per_m_rgb == PURE_WATER_PER_M
    red, green, blue = PURE_WATER_PER_M
    assert red > green > blue > 0


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


def test_what_the_water_is_drawn_with() -> None:
    assert Flood(level_m=0).effective_turbidity_ntu == 50
    assert Flood(level_m=0).extinction_per_m_rgb == pytest.approx((25.34, 25.0565, 25.00922))
    given = Flood(level_m=0, absorption_per_m=(3.0, 2.0, 0.0))
    assert given.extinction_per_m_rgb == (3.0, 2.0, 0.0) and given.effective_turbidity_ntu is None
    assert Flood(level_m=0, turbidity_ntu=7.0).effective_turbidity_ntu == 7
