"""What the presets promise in docs/recipes.md, at every end of their ranges."""

from __future__ import annotations

import math

import pytest

from recipes.load import load_recipe
from recipes.schema import KOSCHMIEDER
from recipes.values import as_number


def arriving(name: str, distance_m: float) -> tuple[float, float]:
    """Least and greatest share of a colour that arrives from `distance_m` at the base height."""
    visibility = dict(load_recipe(name).values)["weather.smog.visibility_m"].probes()
    shares = [math.exp(-KOSCHMIEDER * distance_m / as_number(v)) for v in visibility]
    return min(shares), max(shares)


def zenith(name: str) -> tuple[float, float]:
    values = dict(load_recipe(name).values)
    shares = [
        math.exp(-KOSCHMIEDER * as_number(height) / as_number(visibility))
        for height in values["weather.smog.scale_height_m"].probes()
        for visibility in values["weather.smog.visibility_m"].probes()
    ]
    return min(shares), max(shares)


def test_clear_is_without_weather() -> None:
    template = load_recipe("clear")
    assert template.describe_ranges() == {}
    assert template.resolve(0).weather.smog is None


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


@pytest.mark.parametrize("name", ["light-haze", "dense-fog", "brown-smog"])
def test_drawn_presets_differ_between_variants_and_are_pinned(name: str) -> None:
    smog = load_recipe(name).resolve(0).weather.smog
    assert smog is not None
    assert smog.visibility_m == PINNED[name]


PINNED = {"light-haze": 1295.869842, "dense-fog": 86.84725686, "brown-smog": 434.2362843}
