"""From template to numbers and back: independence of draws, probability, round trips."""

from __future__ import annotations

import math
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recipes.errors import RecipeError
from recipes.flood import Flood, Wave, Waves
from recipes.load import dump_recipe, parse_recipe
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow, SnowLight, SnowWind
from recipes.template import Fixed, RecipeTemplate

TEXT = """
name: foggy
seed: 7
variants: 5
weather:
  smog:
    visibility_m: {log_uniform: [100, 2000]}
    color: [0.7, {uniform: [0.6, 0.8]}, 0.7]
    scale_height_m: {choice: [null, {uniform: [50, 90]}]}
render:
  sh_degree: {choice: [0, 1, null]}
output:
  jpeg_quality: {uniform: [60, 95]}
"""


def template(text: str = TEXT) -> RecipeTemplate:
    return parse_recipe(text, source="foggy.yaml")


def smog_of(recipe: Recipe) -> Smog:
    assert recipe.weather.smog is not None
    return recipe.weather.smog


def test_resolved_numbers_are_pinned() -> None:
    """A recipe must give the same weather in every version of the package."""
    smog = smog_of(template().resolve(0))
    assert (smog.visibility_m, smog.color, smog.scale_height_m) == (
        1851.119861,
        (0.7, 0.6713067383, 0.7),
        57.97103442,
    )
    assert template().resolve(0).hash == "b9f677bcd45fba13"


def test_variants_differ_and_resolve_in_any_order() -> None:
    one = template()
    forwards = [one.resolve(i) for i in range(5)]
    backwards = [template().resolve(i) for i in reversed(range(5))]
    assert forwards == backwards[::-1]
    assert [recipe.variant for recipe in forwards] == [0, 1, 2, 3, 4]
    assert len({smog_of(recipe).visibility_m for recipe in forwards}) == 5
    assert len({recipe.hash for recipe in forwards}) == 5


def test_another_field_or_more_variants_change_no_draw() -> None:
    more = template(TEXT.replace("variants: 5", "variants: 50") + "  image: {choice: [png, jpg]}\n")
    fewer = template("\n".join(line for line in TEXT.splitlines() if "scale_height" not in line))
    for i in range(5):
        here = smog_of(template().resolve(i))
        assert smog_of(more.resolve(i)) == here
        assert smog_of(fewer.resolve(i)).visibility_m == here.visibility_m
        assert smog_of(fewer.resolve(i)).color == here.color


def test_a_first_variant_continues_the_series() -> None:
    later = template(TEXT.replace("variants: 5", "variant: 3\nvariants: 2"))
    assert [later.resolve(i) for i in range(2)] == [template().resolve(i) for i in (3, 4)]


@pytest.mark.parametrize("probability", [0, 0.25, 1])
def test_probability_is_the_share_of_variants_with_the_effect(probability: float) -> None:
    text = f"""
variants: 2000
weather: {{smog: {{visibility_m: {{uniform: [50, 90]}}, probability: {probability}}}}}
"""
    drawn = template(text)
    present = [recipe.weather.smog is not None for recipe in map(drawn.resolve, range(2000))]
    spread = 4 * math.sqrt(probability * (1 - probability) / 2000)  # four standard deviations
    assert abs(sum(present) / 2000 - probability) <= spread
    half = template("variants: 12\nweather: {smog: {visibility_m: 9, probability: 0.5}}")
    pinned = ["01"[half.resolve(i).weather.smog is not None] for i in range(12)]
    assert "".join(pinned) == "000000010111"


def test_probability_leaves_the_other_draws_alone() -> None:
    sometimes = template(TEXT.replace("  smog:\n", "  smog:\n    probability: 0.5\n"))
    pairs = [(template().resolve(i), sometimes.resolve(i)) for i in range(5)]
    kept = [(a, b) for a, b in pairs if b.weather.smog is not None]
    assert 0 < len(kept) < 5
    assert all(a == b for a, b in kept)
    assert all(a.output == b.output for a, b in pairs)


def test_ranges_in_words() -> None:
    assert template().describe_ranges() == {
        "weather.smog.visibility_m": "log-uniform from 100 to 2000 (metres)",
        "weather.smog.color": "[0.7, uniform from 0.6 to 0.8, 0.7]",
        "weather.smog.scale_height_m": "one of null, uniform from 50 to 90 (metres)",
        "render.sh_degree": "one of 0, 1, null",
        "output.jpeg_quality": "uniform from 60 to 95",
    }
    sometimes = "weather: {smog: {visibility_m: 9, probability: 0.5}}"
    assert template(sometimes).describe_ranges() == {"weather.smog": "present with probability 0.5"}


def test_a_rule_broken_by_a_draw_is_a_recipe_error() -> None:
    """The last guard, for templates that were not made by the loader."""
    values = (("weather.smog.visibility_m", Fixed(5.0)), ("weather.smog.color", Fixed("blue")))
    made = RecipeTemplate("x", "code", values=values, effects=(("weather.smog", 1.0),))
    with pytest.raises(RecipeError, match=r"^code: variant 0: weather.smog.color: Input should"):
        made.resolve(0)
    values = (("weather.flood.waves.components[1].steepness", Fixed(2.0)),)
    lists = (("weather.flood.waves.components", 2),)
    made = RecipeTemplate("x", "code", values=values, lists=lists)
    where = r"variant 0: weather\.flood\.waves\.components\[1\]\.steepness: Input should be less"
    with pytest.raises(RecipeError, match=where):
        made.resolve(0)


def test_templates_and_errors_survive_pickling() -> None:
    """Worker processes receive templates and send errors back."""
    assert pickle.loads(pickle.dumps(template())) == template()
    error = pickle.loads(pickle.dumps(RecipeError("a:1: x", "a:2: y")))
    assert str(error) == "a:1: x\na:2: y" and error.problems == ("a:1: x", "a:2: y")


def read_back(recipe: Recipe) -> Recipe:
    again = parse_recipe(dump_recipe(recipe), source="dump", name="not-this")
    assert again.variants == 1
    return again.resolve(0)


def test_a_dump_says_everything() -> None:
    text = dump_recipe(template().resolve(2))
    assert text.startswith(
        f"# A recipe in numbers, hash {template().resolve(2).hash}.\nversion: 1\n"
    )
    for line in ("name: foggy", "seed: 7", "variant: 2", "  alpha_max: 0.999", "  image: png"):
        assert f"\n{line}\n" in text
    assert "color: [0.7," in text


FLOODED = """
seed: 3
weather:
  flood:
    level_m: {uniform: [0.1, 0.5]}
    absorption_per_m: {uniform: [[1, 2, 3], [3, 6, 9]]}
    waves:
      components:
        - {amplitude_m: {uniform: [0.01, 0.02]}, wavelength_m: 1, steepness: {choice: [0.1, 0.2]}}
        - {amplitude_m: {uniform: [0.01, 0.02]}, wavelength_m: 2}
"""
PINNED_FLOOD = (0.1369834527, (1.79031723, 3.580634461, 5.370951691))
PINNED_WAVES = (0.01428204438, 0.1, 0.01068017609)


def flood_of(recipe: Recipe) -> Flood:
    assert recipe.weather.flood is not None
    return recipe.weather.flood


def test_the_numbers_of_a_list_are_drawn_each_by_itself_and_pinned() -> None:
    flood = flood_of(template(FLOODED).resolve(0))
    assert flood.waves.components is not None
    first, second = flood.waves.components
    assert (flood.level_m, flood.absorption_per_m) == PINNED_FLOOD
    assert (first.amplitude_m, first.steepness, second.amplitude_m) == PINNED_WAVES
    assert (second.wavelength_m, second.steepness) == (2.0, 0.0)
    for red, green, blue in (
        flood_of(template(FLOODED).resolve(i)).extinction_per_m_rgb for i in range(5)
    ):
        # ten digits of each channel
        assert (green, blue) == pytest.approx((2 * red, 3 * red), rel=1e-9)


def test_a_flood_that_is_absent_takes_its_waves_along() -> None:
    text = FLOODED.replace("  flood:\n", "  flood:\n    probability: 0.5\n")
    pairs = [(template(FLOODED).resolve(i), template(text).resolve(i)) for i in range(12)]
    kept = [(a, b) for a, b in pairs if b.weather.flood is not None]
    assert 0 < len(kept) < 12
    assert all(a == b for a, b in kept)


finite = {"allow_nan": False, "allow_infinity": False}
wave_models = st.builds(
    Wave,
    direction_deg=st.floats(-360, 360, **finite),
    amplitude_m=st.floats(0, 1.5, **finite),  # 10 m / 2 pi is 1.59
    wavelength_m=st.floats(10, 1e4, **finite),
    steepness=st.floats(0, 0.2, **finite),  # five of them are 1
)
floods = st.builds(
    Flood,
    level_m=st.floats(-1e4, 1e4, **finite),
    absorption_per_m=st.none() | st.tuples(*[st.floats(0, 1e6, **finite)] * 3),
    waves=st.builds(
        Waves,
        seed=st.none() | st.integers(0, 2**63 - 1),
        components=st.none() | st.lists(wave_models, max_size=5).map(tuple),
    ),
)
snows = st.builds(
    Snow,
    depth_m=st.floats(0, 10, **finite),
    coverage=st.floats(0, 1, **finite),
    tracks=st.sampled_from(["auto", "always", "never"]),
    cell_m=st.floats(0.001, 10, **finite),
    light=st.builds(
        SnowLight,
        sun_azimuth_deg=st.none() | st.floats(-360, 360, **finite),
        sun=st.none() | st.floats(0, 1, **finite),
    ),
    wind=st.builds(SnowWind, drift=st.floats(0, 1, **finite)),
    seed=st.none() | st.integers(0, 2**63 - 1),
)
smogs = st.builds(
    Smog,
    extinction_per_m=st.floats(0, 100, **finite),
    color=st.tuples(*[st.floats(0, 1, **finite)] * 3),
    scale_height_m=st.none() | st.floats(0.1, 1e5, **finite),
    base_height_m=st.floats(-1e4, 1e4, **finite),
    model=st.sampled_from(["per_gaussian", "deferred"]),
)
recipes = st.builds(
    Recipe,
    name=st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"),
    seed=st.integers(0, 2**63 - 1),
    variant=st.integers(0, 2**31 - 1),
    weather=st.builds(
        Weather, smog=st.none() | smogs, flood=st.none() | floods, snow=st.none() | snows
    ),
    render=st.builds(
        Render,
        scale=st.floats(0, 4, exclude_min=True, **finite),
        sh_degree=st.none() | st.integers(0, 3),
        antialiased=st.booleans(),
    ),
    output=st.builds(
        Output, image=st.sampled_from(["png", "jpg"]), jpeg_quality=st.integers(1, 100)
    ),
)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(recipes)
def test_any_recipe_reads_back_equal(recipe: Recipe) -> None:
    again = read_back(recipe)
    assert again == recipe and again.hash == recipe.hash
