"""Draws: their distributions, their ends, and pinned first numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from statistics import NormalDist

import pytest

from recipes.template import Channels, Choice, Draws, Fixed, Normal, TripleLine, Uniform, Value

COUNT = 2000
SEEDS = (0, 1, 12345)


def many(value: Value, seed: int, count: int = COUNT) -> list:
    return [value.draw(Draws(seed, variant), "weather.smog.x") for variant in range(count)]


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
def test_draws_follow_their_distribution(value: Value, cdf, seed: int) -> None:
    # 1.95 / sqrt(n) is exceeded once in a thousand fair samples; the seeds are fixed and pass
    assert kolmogorov_distance(many(value, seed), cdf) < 1.95 / math.sqrt(COUNT)


@pytest.mark.parametrize(
    ("value", "shares"),
    [
        (Uniform(1, 4, whole=True), {k: 0.25 for k in (1, 2, 3, 4)}),
        (
            Uniform(1, 3, whole=True, log=True),
            {k: math.log((k + 1) / k) / math.log(4) for k in (1, 2, 3)},
        ),
        (
            Normal(2.5, 1.0, 1, 4, whole=True),
            {
                k: (NormalDist(2.5).cdf(k + 0.5) - NormalDist(2.5).cdf(k - 0.5))
                / (NormalDist(2.5).cdf(4.5) - NormalDist(2.5).cdf(0.5))
                for k in (1, 2, 3, 4)
            },
        ),
        (Choice((Fixed("a"), Fixed("b"), Fixed("c")), (1.0, 0.0, 3.0)), {"a": 0.25, "c": 0.75}),
        (Choice((Fixed(True), Fixed(False)), (1.0, 1.0)), {True: 0.5, False: 0.5}),
    ],
    ids=["uniform", "log-uniform", "normal", "weighted choice", "even choice"],
)
def test_discrete_draws_have_their_shares(value: Value, shares: dict) -> None:
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
        Uniform(1, 3, True),
        Uniform(1, 3, True, log=True),
        Normal(2.0, 5.0, 1, 3, True),
        Uniform(0.5, 0.5),
        Uniform(1 / 3, math.nextafter(1 / 3, 1)),  # rounding to 10 digits would leave the range
    ],
)
def test_extreme_random_numbers_stay_inside_the_ends(value: Value) -> None:
    low, high = value.probes()
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
    colours = many(Channels((unit, unit, Fixed(0.5))), 5, 1000)
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
        (Uniform(1, 100, True), 71),
        (Choice((Fixed("a"), Fixed("b"), Fixed("c")), (1.0, 1.0, 1.0)), "c"),
        (TripleLine((0.0, 0.2, 0.4), (1.0, 0.4, 0.2)), (0.7067650877, 0.3413530175, 0.2586469825)),
    ],
)
def test_first_draws_are_pinned(value: Value, drawn: object) -> None:
    assert value.draw(Draws(0, 0), "weather.smog.x") == drawn


def test_descriptions() -> None:
    normal = "normal with mean 3 and deviation 1, from 1 to 6"
    assert Normal(3.0, 1.0, 1.0, 6.0).describe() == normal
    weighted = Choice((Fixed("png"), Fixed(True)), (1.0, 3.0))
    assert weighted.describe() == "one of png (25 %), true (75 %)"
    assert TripleLine((0, 0.5, 1), (1, 1, 1)).describe() == "uniform from [0, 0.5, 1] to [1, 1, 1]"
