"""Water on a road over time: evaporation, filling, drying, and the balance of water."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from recipes.curve import Curve, Shape
from recipes.moment import Air, Moment
from recipes.rain import Rain, RoadWater, puddle_share_of_rate, wetness_of_rate
from recipes.road_water import (
    CATCHMENT,
    FULL_PUDDLE_MM,
    MAX_FILM_MM,
    STAIN_RADIUS_M,
    AirCurves,
    RoadState,
    evaporation_mm_h,
    road_state,
    water_balance,
)
from recipes.schema import Recipe, Weather

DRY_AIR = AirCurves.constant(Air())
SATURATED = AirCurves.constant(Air(humidity=1.0))
# (air temperature, humidity, wind, evaporation on a road as warm and on one 5 K warmer), mm/h.
EVAPORATION = [
    (5.0, 0.9, 3.0, 0.013, 0.068),
    (15.0, 0.6, 3.0, 0.105, 0.204),
    (25.0, 0.5, 3.0, 0.245, 0.415),
    (25.0, 0.5, 6.0, 0.49, 0.83),
]


def shower(shape: Shape = "linear") -> Curve:
    """Rain that begins at 0, has 12 mm/h from 120 to 600 s and is over at 700 s."""
    return Curve((0.0, 120.0, 600.0, 700.0), (0.0, 12.0, 12.0, 0.0), shape)


def random_curve(rng: random.Random, shape: Shape) -> Curve:
    """Rain with some dry hours and light drizzle in it."""
    times = sorted(rng.uniform(-3600, 40000) for _ in range(9))
    values = [rng.choice((0.0, 0.02, rng.uniform(0, 2), rng.uniform(0, 60))) for _ in times]
    return Curve(tuple(times), tuple(values), shape)


def halved(curve: Curve) -> Curve:
    """The same linear curve with a point more between each two."""
    times = sorted({*curve.times_s, *((a + b) / 2 for a, b in itertools.pairwise(curve.times_s))})
    return Curve(tuple(times), tuple(map(curve.value, times)), curve.shape)


# ---- Evaporation ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("temperature_c", "humidity", "wind_m_s", "level", "warmer"), EVAPORATION)
def test_evaporation_is_that_of_the_bulk_formula(temperature_c, humidity, wind_m_s, level, warmer):
    for road_warmer_k, expected in ((0.0, level), (5.0, warmer)):
        air = Air(
            temperature_c=temperature_c,
            humidity=humidity,
            wind_m_s=wind_m_s,
            road_warmer_k=road_warmer_k,
        )
        # The table's numbers are rounded to a thousandth.
        assert evaporation_mm_h(air) == pytest.approx(expected, rel=0.02, abs=0.0005)


def test_saturated_air_takes_no_water_and_a_colder_road_has_no_dew():
    assert evaporation_mm_h(Air(humidity=1.0)) == 0
    assert evaporation_mm_h(Air(humidity=0.9, road_warmer_k=-10.0)) == 0
    assert evaporation_mm_h(Air(wind_m_s=0.0)) > 0


# ---- Filling and drying --------------------------------------------------------------------------


@pytest.mark.parametrize(("rate_mm_h", "minutes"), [(10.0, 3.6), (2.0, 18.0)])
def test_a_road_is_full_after_the_time_that_its_film_takes(rate_mm_h, minutes):
    rain = Curve((0.0, 1e-9), (0.0, rate_mm_h))
    nearly = road_state(rain, SATURATED, 60 * minutes * 0.99)
    assert nearly.film_mm == pytest.approx(0.99 * MAX_FILM_MM, rel=1e-6)
    assert road_state(rain, SATURATED, 60 * minutes * 1.001).film_mm == MAX_FILM_MM


@pytest.mark.parametrize(("hours", "air"), [(5.7, Air()), (2.9, Air(road_warmer_k=5.0))])
def test_a_full_road_is_dry_after_the_time_that_the_air_takes(hours, air):
    rain = Curve((0.0, 600.0), (10.0, 0.0), "step")
    air_curves = AirCurves.constant(air)

    def film_mm(share: float) -> float:
        return road_state(rain, air_curves, 600 + 3600 * hours * share).film_mm

    # 2 %: the table rounds hours to a tenth.
    assert film_mm(0.97) > 0
    assert film_mm(1.03) == 0


def test_half_the_ground_is_hit_after_eight_seconds_of_moderate_rain():
    rain = Curve((0.0, 1e-9), (0.0, 10.0))
    drops = 3114 * 8
    expected = 1 - math.exp(-drops * math.pi * STAIN_RADIUS_M**2)
    assert expected == pytest.approx(0.5, abs=0.01)
    # 0.4 %: stains end at a share of 1, which the exponential function never reaches.
    assert road_state(rain, SATURATED, 8.0).spots == pytest.approx(expected, rel=0.004)


def test_puddles_fill_by_their_catchment_and_outlast_the_film():
    rain = Curve((0.0, 1e-9, 300.0, 300.0 + 1e-6), (0.0, 10.0, 10.0, 0.0))
    evaporation = DRY_AIR.evaporation_mm_h(0.0)
    fill = road_state(rain, DRY_AIR, 300.0).puddle_fill
    assert fill == pytest.approx((CATCHMENT * 10 - evaporation) / 12 / FULL_PUDDLE_MM, rel=1e-6)
    later = road_state(rain, DRY_AIR, 300 + 10 * 3600.0)
    assert later.film_mm == 0
    assert later.puddle_fill == pytest.approx(fill - 10 * evaporation / FULL_PUDDLE_MM, rel=1e-5)


def test_wheel_tracks_clear_after_the_rain_and_fill_in_the_next_one():
    rain = Curve((0.0, 600.0, 3600.0), (10.0, 0.0, 10.0), "step")
    assert road_state(rain, DRY_AIR, 599.0).tracks == 0
    assert road_state(rain, DRY_AIR, 660.0).tracks == pytest.approx(0.5)
    assert road_state(rain, DRY_AIR, 3600.0).tracks == 1
    assert 0 < road_state(rain, DRY_AIR, 3660.0).tracks < 1
    assert road_state(rain, DRY_AIR, 4000.0).tracks == 0


# ---- No steps ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["linear", "step", "smooth"])
def test_rain_is_in_the_film_the_puddles_the_drains_or_the_air(shape):
    rng = random.Random(5)
    for rain in [shower(shape), *(random_curve(rng, shape) for _ in range(40))]:
        for time_s in (60.0, 650.0, 3000.0, 2e4, 1e5):
            balance = water_balance(rain, DRY_AIR, time_s)
            gone_mm = balance.film_mm + balance.puddle_mm + balance.drained_mm
            gone_mm += balance.evaporated_mm
            assert gone_mm == pytest.approx(balance.rain_mm, rel=1e-12, abs=1e-12)
            fallen_mm = rain.integral(min(rain.times_s[0], time_s), time_s) / 3600
            assert balance.rain_mm == pytest.approx(fallen_mm, rel=1e-12)


def test_more_points_on_the_same_curve_change_nothing():
    rng = random.Random(6)
    for _ in range(40):
        rain = random_curve(rng, "linear")
        for time_s in (rng.uniform(-1000, 50000) for _ in range(5)):
            coarse = vars(road_state(rain, DRY_AIR, time_s))
            fine = vars(road_state(halved(halved(rain)), DRY_AIR, time_s))
            assert fine == pytest.approx(coarse, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("shape", ["linear", "step", "smooth"])
def test_the_closed_form_is_the_limit_of_small_steps(shape):
    rain = Curve((0.0, 400.0, 900.0, 2000.0), (0.0, 6.0, 0.05, 0.3), shape)
    evaporation = DRY_AIR.evaporation_mm_h(0.0)
    step_s = 0.05
    film_mm = puddle_mm = 0.0
    for n in range(round(3000 / step_s)):
        rate = rain.value((n + 0.5) * step_s)
        film_mm += (rate - evaporation) * step_s / 3600
        film_mm = min(max(film_mm, 0.0), MAX_FILM_MM)
        puddle_mm += (CATCHMENT * rate - evaporation) * step_s / 3600
        puddle_mm = min(max(puddle_mm, 0.0), FULL_PUDDLE_MM)
        if n % 4000 == 3999:
            state = road_state(rain, DRY_AIR, (n + 1) * step_s)
            # Midpoints are exact for lines; clamps and cubics err by some 1e-6.
            assert state.film_mm == pytest.approx(film_mm, abs=2e-5)
            assert state.puddle_fill * FULL_PUDDLE_MM == pytest.approx(puddle_mm, abs=2e-5)


@pytest.mark.parametrize("shape", ["linear", "smooth"])
def test_water_is_continuous_where_the_rain_is(shape):
    rng = random.Random(7)
    for _ in range(10):
        rain = random_curve(rng, shape)
        for time_s in (*rain.times_s, *(rng.uniform(-3600, 50000) for _ in range(10))):
            before, after = (section_at(rain, time_s + step) for step in (0.0, 1e-6))
            assert after.ground_wetness == pytest.approx(before.ground_wetness, abs=1e-5)
            assert after.puddle_share == pytest.approx(before.puddle_share, abs=1e-5)
            assert after.road.spots == pytest.approx(before.road.spots, abs=1e-5)
            assert after.road.tracks == pytest.approx(before.road.tracks, abs=1e-5)


def test_air_that_changes_dries_a_road_by_what_it_takes_in_all():
    rain = Curve((0.0, 600.0), (10.0, 0.0), "step")
    warming = DRY_AIR._replace(temperature_c=Curve((600.0, 7800.0), (10.0, 20.0)))
    film_mm = road_state(rain, warming, 7800.0).film_mm
    taken = [
        warming.evaporation_mm_h(600 + 7200 * (n + 0.5) / 1000) * 2 / 1000 for n in range(1000)
    ]
    # 2e-4: evaporation is constant in each of 16 parts.
    assert MAX_FILM_MM - film_mm == pytest.approx(sum(taken), rel=2e-4)


# ---- The section of a recipe ---------------------------------------------------------------------


def section_at(rate: Curve, time_s: float, **fields) -> Rain:
    """The rain's section at a time of a history."""
    rain = Rain(rate_mm_h=rate.value(time_s), **fields)
    moment = Moment(time_s, None, {"weather.rain.rate_mm_h": rate})
    return rain.state_at("weather.rain", moment)


@pytest.mark.parametrize("rate_mm_h", [0.5, 2.0, 10.0, 60.0])
def test_rain_that_lasts_ends_at_the_wetness_and_puddles_of_its_rate(rate_mm_h):
    plain = Rain(rate_mm_h=rate_mm_h)
    onset = Curve((0.0, 60.0), (0.0, rate_mm_h))
    for_ever = section_at(Curve((0.0, 60.0), (rate_mm_h, 0.0)), -10.0)
    for rain in (section_at(onset, 1e5), for_ever):
        assert rain.ground_wetness == plain.ground_wetness
        assert rain.puddle_share == plain.puddle_share
        assert (rain.road.tracks, rain.road.spots) == (0, 1)
    assert plain.ground_wetness == wetness_of_rate(rate_mm_h)
    assert plain.puddle_share == puddle_share_of_rate(rate_mm_h)


def test_a_recipe_without_history_or_with_a_stated_road_has_no_derived_one():
    rain = Rain(rate_mm_h=5.0)
    assert rain.state_at("weather.rain", Moment(3.0)) is rain
    history = {"weather.rain.rate_mm_h": shower()}
    for stated in (Rain(rate_mm_h=5.0, wetness=0.5), Rain(rate_mm_h=5.0, road=RoadWater())):
        assert stated.state_at("weather.rain", Moment(3.0, None, history)).road is stated.road
    assert rain.state_at("weather.rain", Moment(3.0, Air())).road == RoadWater(
        peak_rate_mm_h=5.0, puddle_rate_mm_h=5.0, spots=1.0
    )
    puddles = section_at(shower(), 4000.0, puddles=0.2)
    assert puddles.road is not None and puddles.puddle_share == 0.2


def test_a_stated_road_is_part_of_the_hash_and_an_absent_one_is_not():
    plain = Recipe(weather=Weather(rain=Rain(rate_mm_h=5.0)))
    stated = Recipe(weather=Weather(rain=Rain(rate_mm_h=5.0, road=RoadWater())))
    dumped = plain.model_dump()
    del dumped["weather"]["rain"]["road"]
    assert Recipe.model_validate(dumped).hash == plain.hash != stated.hash


def test_first_drops_and_last_puddles_wet_the_ground():
    assert not Rain(rate_mm_h=0.0).wets_ground
    road = {"film_mm": 0.0, "puddle_fill": 0.0}
    assert not Rain(rate_mm_h=0.0, road=RoadWater(**road)).wets_ground
    assert Rain(rate_mm_h=0.0, road=RoadWater(**road, spots=0.1)).wets_ground
    assert Rain(rate_mm_h=0.0, road=RoadWater(film_mm=0.0, puddle_fill=0.1)).wets_ground


def test_dry_states_have_no_water():
    state = road_state(shower(), DRY_AIR, 0.0)
    assert state == RoadState(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
