"""A shower's rates along the wind, from its rate over time."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from recipes.curve import Curve
from recipes.moment import Moment
from recipes.rain import Rain
from recipes.shower import RateAtPlace, cloud_share, rate_at
from recipes.snowfall import Snowfall

TIMES_S = (0.0, 60.0, 300.0, 420.0)
RATES = (0.0, 12.0, 12.0, 2.0)


def at(time_s: float, shape: str = "linear", **fields) -> Rain:
    curve = Curve(TIMES_S, RATES, shape)  # type: ignore[arg-type]
    rain = Rain(rate_mm_h=curve.value(time_s), **fields)
    return rain.state_at("weather.rain", Moment(time_s, curves={"weather.rain.rate_mm_h": curve}))


@pytest.mark.parametrize(("shape", "error"), [("linear", 1e-9), ("step", 1e-9), ("smooth", 0.02)])
@pytest.mark.parametrize("time_s", [-100.0, 0.0, 37.0, 60.0, 350.0, 420.0, 1e5])
def test_the_field_is_frozen_and_moves_at_its_speed(shape, error, time_s):
    """Taylor: the rate at a distance d falls at the reference place d / U earlier."""
    curve = Curve(TIMES_S, RATES, shape)
    along = at(time_s, shape, front_mps=8.0).along
    assert along is not None
    assert rate_at(along, 0.0) == pytest.approx(curve.value(time_s), abs=1e-9)
    for distance_m in (-4000.0, -900.0, -333.0, 1.0, 77.0, 1500.0, 9000.0):
        expected = curve.value(time_s - distance_m / 8.0)
        assert rate_at(along, distance_m) == pytest.approx(expected, abs=error)


def test_the_cloud_comes_before_the_rain_and_is_whole_within():
    shares = [at(t, front_mps=10.0).shadow_fade for t in (-100.0, -30.0, 30.0, 180.0)]
    assert shares[0] == 0
    assert 0 < shares[1] < shares[2] < 1  # type: ignore[operator]
    assert shares[3] == pytest.approx(1.0, abs=1e-6)
    everywhere = (RateAtPlace(distance_m=0, rate_mm_h=0.1),)
    assert cloud_share(everywhere, 0.1) == pytest.approx(1 - 2.718281828**-1)


def test_what_the_recipe_gives_stays():
    along = (RateAtPlace(distance_m=0, rate_mm_h=3),)
    given = at(30.0, front_mps=10.0, along=along, shadow_fade=0.2, peak_mm_h=50)
    assert (given.along, given.shadow_fade, given.peak_mm_h) == (along, 0.2, 50)
    assert at(30.0).along is None  # it does not pass
    assert at(30.0).peak_mm_h == 12
    still = Snowfall(rate_mm_h=1, front_mps=5)
    assert still.state_at("weather.snowfall", Moment(5.0)) is still


def test_rain_at_a_distance_is_rain():
    assert at(-100.0, front_mps=10.0).has_effect
    assert not Rain(rate_mm_h=0, along=(RateAtPlace(distance_m=0, rate_mm_h=0),)).has_effect


def test_places_out_of_order_are_refused():
    places = [{"distance_m": 5, "rate_mm_h": 1}, {"distance_m": 4, "rate_mm_h": 1}]
    with pytest.raises(ValidationError, match="along must rise by distance_m; 4 comes after 5"):
        Rain.model_validate({"rate_mm_h": 1, "along": places})
