"""From template to numbers and back: independence of draws, probability, round trips."""

from __future__ import annotations

import math
import pickle
from collections import Counter
from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recipes.errors import RecipeError
from recipes.flood import Flood, Wave, Waves
from recipes.load import dump_recipe, parse_recipe
from recipes.ranges import Choice, Draws, Normal, TripleLine, Uniform, draw, ends
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow, SnowLight, SnowWind
from recipes.speed import Speed
from recipes.template import RecipeTemplate

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
    smog = {"visibility_m": 5.0, "color": "blue"}
    made = RecipeTemplate("x", "code", field_values={"weather": {"smog": smog}})
    with pytest.raises(RecipeError, match=r"^code: variant 0: weather.smog.color: Input should"):
        made.resolve(0)
    waves = {"components": [{}, {"steepness": 2.0}]}
    made = RecipeTemplate("x", "code", field_values={"weather": {"flood": {"waves": waves}}})
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
    for line in ("name: foggy", "seed: 7", "variant: 2", "    alpha_max: 0.999", "  image: png"):
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
        speed=st.builds(Speed, antialiased=st.booleans(), layers_px=st.floats(1, 8, **finite)),
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


COUNT = 2000
SEEDS = (0, 1, 12345)


def many(value: Any, seed: int, count: int = COUNT) -> list:
    return [draw(value, Draws(seed, variant), "weather.smog.x") for variant in range(count)]


def kolmogorov_distance(sample: list[float], cdf: Callable[[float], float]) -> float:
    """Largest gap between the empirical distribution and cdf."""
    ordered = sorted(sample)
    n = len(ordered)
    return max(max((i + 1) / n - cdf(x), cdf(x) - i / n) for i, x in enumerate(ordered))


def truncated(normal: NormalDist, low: float, high: float) -> Callable[[float], float]:
    below, above = normal.cdf(low), normal.cdf(high)
    return lambda x: (normal.cdf(x) - below) / (above - below)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("value", "cdf"),
    [
        (Uniform(50.0, 120.0), lambda x: (x - 50) / 70),
        (Uniform(10.0, 1000.0, log=True), lambda x: math.log(x / 10) / math.log(100)),
        (Normal(300.0, 100.0, 100.0, 600.0), truncated(NormalDist(300, 100), 100, 600)),
        (Normal(0.0, 50.0, 0.0, 1.0), truncated(NormalDist(0, 50), 0, 1)),
        (Normal(0.0, 1.0, -40.0, 40.0), truncated(NormalDist(0, 1), -40, 40)),
    ],
    ids=["uniform", "log-uniform", "normal", "nearly uniform normal", "whole normal"],
)
def test_draws_follow_their_distribution(value: Any, cdf, seed: int) -> None:
    # 1.95 / sqrt(n) is exceeded once in a thousand fair samples; the seeds are fixed and pass
    assert kolmogorov_distance(many(value, seed), cdf) < 1.95 / math.sqrt(COUNT)


@pytest.mark.parametrize(
    ("value", "shares"),
    [
        (Uniform(1, 4), {k: 0.25 for k in (1, 2, 3, 4)}),
        (Uniform(1, 3, log=True), {k: math.log((k + 1) / k) / math.log(4) for k in (1, 2, 3)}),
        (
            Normal(2.5, 1.0, 1, 4),
            {
                k: (NormalDist(2.5).cdf(k + 0.5) - NormalDist(2.5).cdf(k - 0.5))
                / (NormalDist(2.5).cdf(4.5) - NormalDist(2.5).cdf(0.5))
                for k in (1, 2, 3, 4)
            },
        ),
        (Choice(("a", "b", "c"), (1.0, 0.0, 3.0)), {"a": 0.25, "c": 0.75}),
        (Choice((True, False), (1.0, 1.0)), {True: 0.5, False: 0.5}),
    ],
    ids=["uniform", "log-uniform", "normal", "weighted choice", "even choice"],
)
def test_discrete_draws_have_their_shares(value: Any, shares: dict) -> None:
    counts = Counter(many(value, seed=3))
    assert counts.keys() == shares.keys()
    for key, share in shares.items():
        # four standard deviations of a binomial share
        assert abs(counts[key] / COUNT - share) < 4 * math.sqrt(share * (1 - share) / COUNT), key


class Ends(Draws):
    """Draws that give the ends of [0, 1) in turn."""

    def unit(self, path: str) -> float:
        return (0.0, 1 - 2.0**-53)[self.variant]


@pytest.mark.parametrize(
    "value",
    [
        Uniform(0.1, 0.3),
        Uniform(0.1, 0.3, log=True),
        Uniform(1e-300, 1e-200, log=True),
        Normal(0.2, 0.1, 0.1, 0.3),
        Normal(0.2, 1e-300, 0.1, 0.3),
        Normal(0.2, 200.0, 0.1, 0.3),
        Normal(0.1, 0.001, 0.1, 0.3),
        Uniform(1, 3),
        Uniform(1, 3, log=True),
        Normal(2.0, 5.0, 1, 3),
        Uniform(0.5, 0.5),
        Uniform(1 / 3, math.nextafter(1 / 3, 1)),  # rounding to 10 digits would leave the range
    ],
)
def test_extreme_random_numbers_stay_inside_the_ends(value: Any) -> None:
    low, high = (end.value for end in ends(value))
    for end in (0, 1):
        drawn = value.draw(Ends(0, end), "x")
        assert isinstance(drawn, int | float) and low <= drawn <= high


def test_a_colour_line_draws_between_its_ends_with_one_number() -> None:
    start, end = (0.2, 0.9, 0.5), (0.6, 0.1, 0.5)
    for red, green, blue in many(TripleLine(start, end), 5, 200):
        share = (red - 0.2) / 0.4
        assert 0 <= share <= 1 and blue == 0.5
        assert green == pytest.approx(0.9 - 0.8 * share, abs=1e-9)  # ten digits of each channel


def test_channels_are_independent() -> None:
    unit = Uniform(0.0, 1.0)
    colours = many((unit, unit, 0.5), 5, 1000)
    reds, greens, blues = zip(*colours, strict=True)
    assert set(blues) == {0.5}
    covariance = sum(r * g for r, g, _ in colours) / 1000 - sum(reds) * sum(greens) / 1e6
    assert abs(covariance * 12) < 4 / math.sqrt(1000)  # a correlation's four standard deviations


def test_random_numbers_are_pinned() -> None:
    """They are part of the format: a recipe must draw the same numbers in every version."""
    assert [Draws(0, v).unit("weather.smog.visibility_m") for v in range(3)] == [
        0.9407067051777119,
        0.21106224314453992,
        0.35328157623300327,
    ]
    assert Draws(1, 0).unit("weather.smog.visibility_m") == 0.5263893837323231
    assert Draws(0, 0).unit("weather.smog.color") == 0.08181626358866012


@pytest.mark.parametrize(
    ("value", "drawn"),
    [
        (Uniform(50.0, 120.0), 99.47355614),
        (Uniform(50.0, 120.0, log=True), 92.83036027),
        (Normal(80.0, 10.0, 50.0, 120.0), 85.45044491),
        (Uniform(1, 100), 71),
        (Choice(("a", "b", "c"), (1.0, 1.0, 1.0)), "c"),
        (TripleLine((0.0, 0.2, 0.4), (1.0, 0.4, 0.2)), (0.7067650877, 0.3413530175, 0.2586469825)),
    ],
)
def test_first_draws_are_pinned(value: Any, drawn: object) -> None:
    assert value.draw(Draws(0, 0), "weather.smog.x") == drawn


def test_descriptions() -> None:
    normal = "normal with mean 3 and deviation 1, from 1 to 6"
    assert Normal(3.0, 1.0, 1.0, 6.0).describe() == normal
    weighted = Choice(("png", True), (1.0, 3.0))
    assert weighted.describe() == "one of png (25 %), true (75 %)"
    assert TripleLine((0, 0.5, 1), (1, 1, 1)).describe() == "uniform from [0, 0.5, 1] to [1, 1, 1]"
