"""Every message a wrong recipe gets, and what right ones mean."""

from __future__ import annotations

import pytest

from recipes.errors import MAX_SHOWN, RecipeError
from recipes.load import parse_recipe
from recipes.template import Channels, Choice, Fixed, Normal, TripleLine, Uniform


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    return caught.value.problems


def smog(field: str) -> str:
    """A recipe whose line 4 is `field`."""
    return f"version: 1\nweather:\n  smog:\n    {field}\n    extinction_per_m: 0.01\n"


def value_of(field: str):
    template = parse_recipe(smog(field), source="r.yaml")
    return dict(template.values)["weather.smog." + field.split(":")[0]]


S = "r.yaml:4: weather.smog."


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("visibility_m: -5", "visibility_m = -5: must be > 0 and <= 1000000 (metres)"),
        ("visibility_m: far", "visibility_m = 'far': must be a number > 0 and <= 1000000 (metres)"),
        ("base_height_m: .nan", "base_height_m = .nan: must be a number >= -10000 and <= 10000"),
        ("base_height_m: 5 m", "(metres); write the number alone"),
        ("base_height_m: 0,5", "(metres); decimals take a point"),
        ("base_height_m: '5'", "= '5': must be a number >= -10000 and <= 10000 (metres); write it"),
        ("base_height_m:", "base_height_m = null: must be a number >= -10000"),
        ("visibility_km: 3", "visibility_km: unknown field; did you mean visibility_m (metres)?"),
        ("Visibility-M: 3", "Visibility-M: unknown field; did you mean visibility_m (metres)?"),
        ("density: 3", "density: unknown field; did you mean extinction_per_m (1/metre)?"),
        ("colour: [0, 0, 0]", "colour: unknown field; did you mean color?"),
        ("probabilty: 1", "probabilty: unknown field; did you mean probability?"),
        ("scale: 1", "scale: unknown field here; did you mean render.scale?"),
        ("seed: 1", "seed: unknown field here; did you mean seed at the top or weather.flood.wave"),
        ("qqq: 1", "qqq: unknown field; known here: visibility_m, extinction_per_m, color, scale_"),
        ('"a\\nb": 1', "a\\nb: unknown field"),
        ("model: defered", "= 'defered': must be one of per_gaussian, deferred; did you mean def"),
        ("model: {uniform: [a, b]}", "uniform is for numbers; a range here is choice"),
        ("color: grey", "color = 'grey': must be [red, green, blue], each a number >= 0 and <= 1"),
        ("color: [194, 0.2, 0]", "color[0] = 194: must be >= 0 and <= 1; divide 0-255 values by"),
        ("color: [0, 0, {uniform: [0, 2]}]", "color[2].uniform[1] = 2: must be >= 0 and <= 1"),
        ("color: {uniform: [0, [1, 1, 1]]}", "color.uniform[0] = 0: must be [red, green, blue]"),
        ("color: {uniform: [[0, 0, 0]]}", "must be [from, to], two colours"),
        ("color: {normal: {mean: 1}}", "normal is for numbers; a range here is uniform or choice"),
        ("color: {uniform: [[0, 0, 0], [0, 0, {uniform: [0, 1]}]]}", "the two colours must be wri"),
        ("probability: 1.5", "probability = 1.5: must be >= 0 and <= 1"),
        ("probability: {uniform: [0, 1]}", "probability = {uniform: ...}: must be a number >= 0 a"),
        # ranges: both ends, mean and options
        ("base_height_m: {uniform: [-1e5, 0]}", "base_height_m.uniform[0] = -1e5: must be >= -1"),
        ("base_height_m: {uniform: [0, x]}", "base_height_m.uniform[1] = 'x': must be a number"),
        ("visibility_m: {uniform: [null, 1]}", "uniform[0] = null: must be a number > 0"),
        ("base_height_m: {uniform: [3, 1]}", "uniform = [3, 1]: the low end comes first"),
        ("base_height_m: {uniform: [3]}", "base_height_m.uniform = [3]: must be [low, high]"),
        ("base_height_m: {log_uniform: [0, 1]}", "log_uniform[0] = 0: must be > 0: its logarithm"),
        ("base_height_m: {normal: [1, 2]}", "must be {mean: ..., std: ..., min: ..., max: ...}"),
        ("base_height_m: {normal: {mean: 1, std: 1}}", "max: ...}, all four"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: -1e5, max: 2}}", "base_height_m.normal.m"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: 0, max: 1e5}}", "base_height_m.normal.ma"),
        ("base_height_m: {normal: {mean: 5, std: 1, min: 0, max: 2}}", "base_height_m.normal.mean"),
        ("base_height_m: {normal: {mean: 1, std: 0, min: 0, max: 2}}", "base_height_m.normal.std"),
        ("base_height_m: {normal: {mean: 1, std: 1, min: 1, max: 1}}", "base_height_m.normal.max"),
        ("base_height_m: {choice: [0, 1, 1e5]}", "choice[2] = 1e5: must be >= -10000"),
        ("base_height_m: {choice: []}", "choice = []: must be a list of at least one option"),
        ("base_height_m: {choice: [0, {uniform: [0, 1e5]}]}", "base_height_m.choice[1].uniform[1]"),
        ("base_height_m: {choice: [0, 1], weights: [1]}", "weights = [1]: must be 2 numbers, one"),
        ("base_height_m: {choice: [0], weights: [x]}", "weights[0] = 'x': must be a number"),
        ("base_height_m: {choice: [0], weights: [0]}", "weights = [0]: each is 0 or from 1e-9"),
        ("base_height_m: {choice: [0], weight: [1]}", "base_height_m.weight: no part of a range"),
        ("base_height_m: {uniform: [0, 1], choice: [1]}", "or a range: a mapping with one of"),
        ("base_height_m: {unifrom: [0, 1]}", "no range is called 'unifrom'; did you mean uniform?"),
        ("base_height_m: {}", "or a range: a mapping with one of uniform, log_uniform, normal, ch"),
    ],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(field: str, message: str) -> None:
    (problem,) = problems(smog(field))
    assert problem.startswith(S)
    assert message in problem


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version: 2\nanything: else", "r.yaml:1: version = 2: this package reads version 1"),
        ("version: 1.0", "r.yaml:1: version = 1.0: this package reads version 1"),
        ("[1, 2]", "r.yaml:1: a recipe is a mapping of fields; got [1, 2]"),
        ("just text", "r.yaml:1: a recipe is a mapping of fields; got 'just text'"),
        ("null", "r.yaml:1: the file is empty"),
        ("seed: 1.0", "r.yaml:1: seed = 1.0: must be a whole number >= 0 and < 922337203"),
        ("seed: 9223372036854775808", "must be >= 0 and < 9223372036854775808"),
        ("seed: {choice: [1]}", "seed = {choice: ...}: must be a whole number >= 0 and < 92"),
        ("name: a b", "r.yaml:1: name = 'a b': must be up to 64 letters, digits, '.', '_' or '-'"),
        ("variants: 0", "r.yaml:1: variants = 0: must be >= 1 and <= 1000000"),
        ("variant: 2147483647\nvariants: 2", "r.yaml:1: variant = 2147483647: too large with var"),
        ("fog: {}", "r.yaml:1: fog: unknown field here; did you mean weather.smog?"),
        ("wether: {}", "r.yaml:1: wether: unknown field; did you mean weather?"),
        ("weather: 3", "r.yaml:1: weather = 3: must be a mapping, with smog"),
        ("weather: {smog: {choice: [1]}}", "weather.smog.choice: a range stands for one field"),
        ("render: {antialiased: yes}", "antialiased = 'yes': must be true or false; write true"),
        ("render: {sh_degree: 1.5}", "render.sh_degree = 1.5: must be a whole number >= 0 and <="),
        ("output: {jpeg_quality: {uniform: [1, 9.5]}}", "uniform[1] = 9.5: must be a whole number"),
        ("output: {image: PNG}", "image = 'PNG': must be one of png, jpg; did you mean png?"),
        ("\nweather:\n  smog: {}", "r.yaml:3: weather.smog: needs a density: give visibility_m (m"),
        ("weather: {smog: {visibility_m: 1, extinction_per_m: 1}}", "weather.smog: visibility_m a"),
        ("weather: {smog: {visibility_m: {choice: [100, null]}}}", "needs a density: give visibil"),
        ("weather: {smog: {visibility_m: {uniform: [0.01, 100]}}}", "means an extinction of 391/m"),
        ("snow: {depth_m: 0.1}", "snow: unknown field here; did you mean weather.snow?"),
        ("weather: {snowfall: 1}", "weather.snowfall: unknown field; did you mean snow?"),
        ("weather: {snow: 0.1}", "weather.snow = 0.1: must be a mapping, with depth_m, coverage"),
        ("weather: {depth_m: 0.1}", "did you mean weather.snow.depth_m or weather.flood.level_m?"),
        ("weather: {wind: {}}", "did you mean weather.snow.wind or weather.flood.waves?"),
        ("weather: {flood: {level_m: 1, wind: 3}}", "wind: unknown field; did you mean waves?"),
        ("weather: {flood: {level_m: 1, depth_cm: 3}}", "unknown field; did you mean level_m (m"),
        ("output: {surface: snow}", "surface = 'snow': must be one of solid, scene, first"),
        ("stile: {preset: dusk}", "stile: unknown field; did you mean style?"),
        ("weather: {style: {preset: dusk}}", "here; did you mean style at the top?"),
        ("preset: dusk", "did you mean weather.flood.waves.preset or style.preset?"),
        ("per_region: true", "per_region: unknown field here; did you mean style.per_region?"),
        ("style: dusk", "style = 'dusk': must be a mapping, with image, preset, mask, method"),
        ("style: {smog: 1}", "did you mean weather.smog?"),
    ],
)
def test_a_wrong_file(text: str, message: str) -> None:
    (problem,) = problems(text)
    assert message in problem


def test_all_problems_are_reported_in_the_order_of_the_lines() -> None:
    text = """
seed: x
weather:
  smog:
    visibility_m: -1
    visibility_m: 5
    color: [2, 0.5, -1]
output: {image: gif}
"""
    found = problems(text)
    assert [problem.split(":")[1] for problem in found] == ["2", "5", "6", "7", "7", "8"]
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml")
    assert str(caught.value) == "\n".join(found)


def test_a_flood_of_problems_is_cut_short() -> None:
    found = problems("\n".join(f"qqq{i}: 1" for i in range(MAX_SHOWN + 10)))
    assert len(found) == MAX_SHOWN + 1
    assert found[-1] == "r.yaml: and 10 problems more"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("base_height_m: 5", Fixed(5.0)),
        ("base_height_m: 1e-3", Fixed(0.001)),
        ("scale_height_m: null", Fixed(None)),
        ("scale_height_m:", Fixed(None)),
        ("model: deferred", Fixed("deferred")),
        ("color: [0, 0.5, 1]", Fixed((0.0, 0.5, 1.0))),
        ("base_height_m: {uniform: [0, 2]}", Uniform(0.0, 2.0)),
        ("base_height_m: {uniform: [2, 2]}", Uniform(2.0, 2.0)),
        ("base_height_m: {log_uniform: [1, 2]}", Uniform(1.0, 2.0, log=True)),
        ("base_height_m: {normal: {mean: 1, std: 2, min: 0, max: 3}}", Normal(1.0, 2.0, 0.0, 3.0)),
        ("scale_height_m: {choice: [null, 5]}", Choice((Fixed(None), Fixed(5.0)), (1.0, 1.0))),
        ("model: {choice: [deferred], weights: [2]}", Choice((Fixed("deferred"),), (2.0,))),
        ("color: {uniform: [[0, 0, 0], [1, 1, 1]]}", TripleLine((0.0,) * 3, (1.0,) * 3)),
        ("color: [0, {uniform: [0, 1]}, 1]", Channels((Fixed(0.0), Uniform(0.0, 1.0), Fixed(1.0)))),
        ("color: {choice: [[0, 0, 0]]}", Choice((Fixed((0.0, 0.0, 0.0)),), (1.0,))),
    ],
)
def test_right_fields(field: str, value: object) -> None:
    got = value_of(field)
    assert got == value and repr(got) == repr(value)  # repr tells 5 from 5.0


def test_whole_numbers_stay_whole_in_ranges() -> None:
    text = "output: {jpeg_quality: {normal: {mean: 80.5, std: 2.5, min: 70, max: 95}}}"
    ((_, value),) = parse_recipe(text, source="r").values
    assert repr(value) == "Normal(mean=80.5, std=2.5, low=70, high=95, whole=True)"


def test_a_name_is_taken_as_written() -> None:
    for name in ("2024", "1e3", "0x1F", "true", "'null'"):
        assert parse_recipe(f"name: {name}", source="r").name == name.strip("'")


def test_aliases_may_repeat_a_range() -> None:
    text = "render: {scale: &r {choice: [0.5, 1]}, near_m: *r}"
    values = dict(parse_recipe(text, source="r").values)
    assert values["render.scale"] == values["render.near_m"]


def test_variants_without_a_range_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    parse_recipe("variants: 3", source="r.yaml")
    assert "r.yaml: variants = 3, but no field has a range" in caplog.text
    caplog.clear()
    parse_recipe("variants: 3\nrender: {scale: {choice: [0.5, 1]}}", source="r.yaml")
    parse_recipe("variants: 3\nweather: {smog: {visibility_m: 9, probability: 0.5}}", source="r")
    assert caplog.text == ""
