"""Suites: the table of levels, seeds, and what may be changed."""

from __future__ import annotations

import hashlib
import math

import pytest

from recipes.errors import RecipeError
from recipes.fields import section_at
from recipes.smog import KOSCHMIEDER
from recipes.suite import CLEAN, SuiteVariant, load_suite, seed_of, suite_names

SUITE = load_suite("weather-c-v1")
LEVELS = range(1, 6)

# The published table of weather-c v1: by effect, the recipe's fields at the levels 1 to 5.
TABLE = {
    "fog": {"weather.smog.extinction_per_m": (0.005, 0.01, 0.02, 0.04, 0.08)},
    "rain": {"weather.rain.rate_mm_h": (1, 4, 16, 50, 100)},
    "wet": {
        "weather.rain.road.film_mm": (0.02, 0.06, 0.2, 0.6, 0.6),
        "weather.rain.rate_mm_h": (0, 0, 0, 0, 0),
        "weather.rain.puddle_share": (0, 0, 0, 0, 0.2),
    },
    "snowfall": {"weather.snowfall.rate_mm_h": (0.3, 0.6, 1.2, 2.4, 4.8)},
    "snow": {
        "weather.snow.depth_m": (0.01, 0.03, 0.08, 0.15, 0.30),
        "weather.snow.coverage": (0.7, 0.85, 1, 1, 1),
    },
    "flood": {"weather.flood.level_m": (0.02, 0.05, 0.15, 0.30, 0.50)},
    "lens": {"camera.lens_drops.share": (0.02, 0.05, 0.10, 0.20, 0.35)},
    "combined": {
        "weather.rain.rate_mm_h": (4, None, 16, None, 16),
        "weather.smog.extinction_per_m": (0.005, None, 0.01, None, None),
        "weather.snowfall.rate_mm_h": (None, 0.6, None, 2.4, None),
        "weather.snow.depth_m": (None, 0.03, None, 0.15, None),
        "light.time": (None, None, None, None, "night"),
    },
}


def recipe(effect: str, level: int, scene: str = "scene-0061"):
    return SUITE.recipe(SuiteVariant(effect, level), scene)


@pytest.mark.parametrize("effect", TABLE)
def test_the_levels_are_those_of_the_table(effect: str) -> None:
    for path, values in TABLE[effect].items():
        assert tuple(section_at(recipe(effect, level), path) for level in LEVELS) == values, path


def test_fog_has_the_ranges_of_the_table() -> None:
    """Rounded as the table has them: MOR at 5 % of contrast, and our visibility at 2 %."""
    extinctions = [recipe("fog", k).weather.smog.resolved_extinction_per_m for k in LEVELS]
    assert extinctions == [0.005 * 2 ** (k - 1) for k in LEVELS]
    mor_m = [math.log(20) / extinction for extinction in extinctions]
    assert [float(f"{m:.2g}") for m in mor_m] == [600, 300, 150, 75, 37]
    assert [round(KOSCHMIEDER / e) for e in extinctions] == [782, 391, 196, 98, 49]
    assert [level.value for level in SUITE.effects["fog"].levels] == [600, 300, 150, 75, 37]


def test_night_has_the_light_of_the_table() -> None:
    """The sky's light at sunset, the mean of a carriageway between street lamps, the moon's."""
    lights = [recipe("night", level).light for level in LEVELS]
    assert math.pi * lights[0].sky_luminance == pytest.approx(400, abs=0.1)
    lux_of_lamps = [1.141e-3 * light.street_lumen for light in lights[1:4]]
    assert [round(lux, 1) for lux in lux_of_lamps] == [20.0, 10.0, 3.0]
    assert (lights[4].moon_lux, lights[4].sky_luminance, lights[4].street) == (0.2, 0.0, "off")
    assert {light.vehicles for light in lights} == {"on"}
    assert [level.value for level in SUITE.effects["night"].levels] == [400, 20, 10, 3, 0.2]


def test_level_values_are_the_recipes_numbers_in_their_units() -> None:
    for effect, path, factor in (
        ("rain", "weather.rain.rate_mm_h", 1),
        ("wet", "weather.rain.road.film_mm", 1),
        ("snowfall", "weather.snowfall.rate_mm_h", 1),
        ("snow", "weather.snow.depth_m", 100),
        ("flood", "weather.flood.level_m", 1),
        ("lens", "camera.lens_drops.share", 100),
    ):
        for number, level in enumerate(SUITE.effects[effect].levels, 1):
            value = section_at(recipe(effect, number), path)
            assert level.value == pytest.approx(factor * value, rel=1e-12), (effect, number)


def test_level_0_is_the_clean_render_with_the_outputs_of_all() -> None:
    clean = recipe(CLEAN, 0)
    assert clean.name == "clean-0" and not clean.sections()
    for variant in SUITE.variants:
        other = SUITE.recipe(variant, "scene-0061")
        assert (other.output, other.render, other.quality) == (
            clean.output, clean.render, clean.quality
        ), variant  # fmt: skip
        assert other.name == variant.name and other.lidar == "weather"
        assert bool(other.sections()) == (variant.effect != CLEAN)


def test_a_seed_is_the_first_bits_of_the_hash_of_the_names() -> None:
    text = b"weather-c-v1\nscene-0061\nfog\n3"
    expected = int(hashlib.sha256(text).hexdigest()[:16], 16) >> 1
    assert recipe("fog", 3).seed == expected == seed_of(
        "weather-c-v1", "scene-0061", SuiteVariant("fog", 3)
    )  # fmt: skip
    seeds = {
        SUITE.recipe(variant, scene).seed for variant in SUITE.variants for scene in ("a", "b", "c")
    }
    assert len(seeds) == 3 * len(SUITE.variants) and max(seeds) < 2**63


def test_the_first_recipes_keep_their_hashes() -> None:
    """A version of a suite never changes: another number needs another version."""
    pinned = {"fog-3": "6425e91d1b8109b8", "rain-3": "65e7b688242f5d1a"}
    for name, expected in pinned.items():
        assert SUITE.recipe(SuiteVariant.parse(name), "002").hash == expected, name


def test_a_selection_has_the_clean_render() -> None:
    names = [variant.name for variant in SUITE.select(["snow", "fog"], [1, 5])]
    assert names == ["clean-0", "fog-1", "fog-5", "snow-1", "snow-5"]
    assert [variant.name for variant in SUITE.select(None, [0])] == ["clean-0"]
    assert len(SUITE.select()) == 1 + 5 * len(SUITE.effects)


def test_recorded_conditions_leave_effects_out() -> None:
    assert SUITE.effects_in([]) == ()
    assert {"rain", "lens", "combined"} <= {*SUITE.effects_in(["rain"])}
    assert SUITE.effects_in(["night"]) == ("night", "combined")


def test_a_quarter_has_the_recipes_of_the_whole() -> None:
    assert load_suite("weather-c-v1-q") == SUITE and suite_names() == ("weather-c-v1",)


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (lambda: load_suite("weather-d"), "no such suite: 'weather-d'.*weather-c-v1"),
        (lambda: SUITE.select(["fogg"]), "has no effect 'fogg'; did you mean fog"),
        (lambda: SUITE.select(None, [6]), "levels 0 to 5; got 6"),
        (lambda: SuiteVariant.parse("fog3"), "'fog3' is no variant.*fog-3"),
        (lambda: recipe("fog", 0), "has no variant 'fog-0'"),
        (lambda: recipe("clean", 1), "has no variant 'clean-1'"),
        (
            lambda: SUITE.recipe(SuiteVariant("fog", 1), "a", {"weather.smog.scatter": 1.0}),
            "weather.smog.scatter cannot be changed in weather-c-v1",
        ),
        (
            lambda: SUITE.recipe(SuiteVariant("fog", 1), "a", {"output": {}}),
            "output cannot be changed",
        ),
        (
            lambda: SUITE.recipe(SuiteVariant("fog", 1), "a", {"output.imag": "png"}),
            "weather-c-v1, fog-1: output.imag",
        ),
    ],
)
def test_wrong_requests_are_refused(work, message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        work()


def test_outputs_and_renderer_can_be_changed() -> None:
    changes = {"output.image": "png", "render.base": "recorded"}
    changed = SUITE.recipe(SuiteVariant("fog", 1), "a", changes)
    assert changed.output.image == "png" and changed.render.is_on_recorded
    assert changed.weather == recipe("fog", 1).weather
