"""Water and depth of lying snow over time: balance, density, settling, melt, warm roads."""

from __future__ import annotations

import math

import pytest

from recipes.curve import Curve
from recipes.moment import Air, Moment
from recipes.snow import RAIN, SNOWFALL, Snow, SnowRoad
from recipes.snow_balance import (
    DEGREE_DAY_MM,
    RAIN_MELT_PER_K,
    SETTLING_A_DAY,
    STORED_MM_PER_K,
    SnowWeather,
    Surface,
    first_snow_s,
    fresh_density,
    layer_at,
)

HOUR_S = 3600.0
DAY_S = 86400.0
ZERO = Curve.constant(0.0)
COLD = Curve.constant(-5.0)
# A snowfall that begins in frost and goes over into rain and thaw.
THAW = SnowWeather(
    snowfall_mm_h=Curve((0, 600, 4000, 5000), (0, 3, 2, 0), "smooth"),
    rain_mm_h=Curve((4000, 6000, 30000), (0, 4, 0)),
    air_c=Curve((0, 3000, 8000), (-3, -1, 4), "smooth"),
    begin_s=0.0,
)
WARM_ROAD = Surface(Curve((0.0, 3000.0), (5.0, 1.0)), has_heat=True)


def step_through(weather: SnowWeather, surface: Surface, end_s: float) -> tuple[float, float]:
    """Water that lies and water that fell, mm, by small steps."""
    step_s = 0.5
    first_c = weather.air_c.value(0) + surface.warmer_k.value(0)
    floor_mm = -STORED_MM_PER_K * max(first_c, 0) if surface.has_heat else 0.0
    water_mm = floor_mm
    fallen_mm = 0.0
    for number in range(round(end_s / step_s)):
        time_s = (number + 0.5) * step_s
        warmth = max(weather.air_c.value(time_s) + surface.warmer_k.value(time_s), 0.0)
        fall = weather.snowfall_mm_h.value(time_s) / HOUR_S
        melt = DEGREE_DAY_MM * warmth / DAY_S
        melt += weather.rain_mm_h.value(time_s) / HOUR_S * RAIN_MELT_PER_K * warmth
        water_mm = max(water_mm + (fall - melt) * step_s, floor_mm)
        fallen_mm += fall * step_s
    return max(water_mm, 0.0), fallen_mm


@pytest.mark.parametrize("surface", [Surface(), WARM_ROAD])
@pytest.mark.parametrize("time_s", [300.0, 2000.0, 4500.0, 9000.0, 21000.0])
def test_the_water_balance_closes_and_is_that_of_small_steps(
    surface: Surface, time_s: float
) -> None:
    layer = layer_at(time_s, THAW, surface)
    assert layer.fallen_mm - layer.melted_mm - layer.water_mm == pytest.approx(0, abs=1e-12)
    water_mm, fallen_mm = step_through(THAW, surface, time_s)
    # the midpoint rule's error with steps of half a second
    assert layer.water_mm == pytest.approx(water_mm, abs=1e-5)
    assert layer.fallen_mm == pytest.approx(fallen_mm, abs=1e-5)


def test_fresh_snow_has_the_density_of_hedstrom_and_pomeroy() -> None:
    for air_c, density, depth_cm_per_mm in (
        (-15, 68, 1.47),
        (-10, 69, 1.45),
        (-5, 75, 1.33),
        (-2, 92, 1.09),
        (0, 119, 0.84),
    ):
        assert fresh_density(air_c) == pytest.approx(density, abs=0.5)
        assert 100 / fresh_density(air_c) == pytest.approx(depth_cm_per_mm, abs=0.005)


def test_depth_of_a_steady_snowfall_is_its_integral_with_settling() -> None:
    weather = SnowWeather(Curve.constant(2.0), ZERO, COLD, begin_s=0.0)
    rate_per_s = -math.log(1 - SETTLING_A_DAY) / DAY_S
    for hours in (0.5, 6, 48):
        time_s = hours * HOUR_S
        fallen_m = 2.0 / HOUR_S / fresh_density(-5)
        expected_m = fallen_m * -math.expm1(-rate_per_s * time_s) / rate_per_s
        assert layer_at(time_s, weather).depth_m == pytest.approx(expected_m, rel=1e-9)


def test_old_snow_settles_by_its_share_a_day_and_keeps_its_water() -> None:
    weather = SnowWeather(ZERO, ZERO, COLD, begin_s=0.0, begin_depth_m=0.1)
    first = layer_at(0.0, weather)
    after = layer_at(DAY_S, weather)
    assert first.depth_m == pytest.approx(0.1)
    assert after.depth_m == pytest.approx(0.1 * (1 - SETTLING_A_DAY))
    assert after.water_mm == first.water_mm
    assert layer_at(-500.0, weather).depth_m == first.depth_m


def test_rain_melts_by_its_heat_and_bare_ground_melts_nothing() -> None:
    warm = Curve.constant(5.0)
    dry = SnowWeather(ZERO, ZERO, warm, begin_s=0.0, begin_depth_m=0.1)
    wet = SnowWeather(ZERO, Curve.constant(10.0), warm, begin_s=0.0, begin_depth_m=0.1)
    more_mm = layer_at(HOUR_S, wet).melted_mm - layer_at(HOUR_S, dry).melted_mm
    assert more_mm == pytest.approx(10 * 4186 * 5 / 334e3, rel=1e-9)
    gone = layer_at(100 * DAY_S, wet)
    assert gone.water_mm == gone.depth_m == 0
    assert gone.melted_mm == pytest.approx(gone.fallen_mm)
    # snow after a thaw lies in full, since nothing melted while the ground was bare
    again = SnowWeather(Curve((0, 10, 20), (0, 0, 2)), ZERO, Curve((0, 10), (9, -9)), 0.0)
    assert layer_at(HOUR_S, again).melted_mm == pytest.approx(0, abs=1e-4)


def test_a_warm_road_whitens_after_its_heat_is_spent() -> None:
    weather = SnowWeather(Curve.constant(1.0), ZERO, COLD, begin_s=0.0)
    road = Surface(Curve.constant(6.0), has_heat=True)  # one degree above zero
    melt_mm_h = DEGREE_DAY_MM / 24
    white_s = STORED_MM_PER_K / (1.0 - melt_mm_h) * HOUR_S
    assert layer_at(white_s - 1, weather, road).depth_m == 0
    assert layer_at(white_s + 60, weather, road).depth_m > 0
    assert layer_at(white_s, weather).depth_m == pytest.approx(0.004, abs=1e-4)
    frozen = Surface(Curve.constant(2.0), has_heat=True)
    assert layer_at(600.0, weather, frozen).depth_m == layer_at(600.0, weather).depth_m


def test_snow_begins_with_the_first_rate_above_zero() -> None:
    weather = SnowWeather(Curve((0, 50, 80), (0, 0, 3)), ZERO, COLD, begin_s=-10.0)
    assert first_snow_s(weather) == 50
    assert first_snow_s(SnowWeather(ZERO, ZERO, COLD, begin_s=-10.0)) == -10


# ---- The recipe's section at a moment ------------------------------------------------------------

FIRST_SNOW = {SNOWFALL: Curve((0, 120, 2400), (0, 3, 3))}


def at(snow: Snow, time_s: float, curves=FIRST_SNOW, air: Air | None = None, **fields) -> Snow:
    return snow.state_at("weather.snow", Moment(time_s, air, curves, end_s=3600.0, **fields))


def test_snow_without_weather_over_time_is_returned_as_it_is() -> None:
    snow = Snow(depth_m=0.05)
    assert at(snow, 100.0, {}) is snow
    assert at(snow, 100.0, {RAIN: Curve((0, 9), (1, 2))}) is snow


def test_all_moments_of_a_recipe_lay_snow_for_the_same_depth() -> None:
    air = Air(temperature_c=-1, road_warmer_k=3)
    states = [at(Snow(depth_m=0.0), time_s, air=air) for time_s in (0.0, 600.0, 3600.0)]
    assert len({state.placed_depth_m for state in states}) == 1
    depths_m = [state.depth_m for state in states]
    assert depths_m == sorted(depths_m) and depths_m[-1] == states[0].placed_depth_m
    roads = [state.road for state in states]
    assert all(road is not None for road in roads)
    assert roads[1].depth_m < states[1].depth_m and roads[1].wetness > 0.5


def test_a_rate_that_stays_counts_where_the_air_is_stated() -> None:
    state = at(Snow(depth_m=0.0), 3600.0, {}, Air(temperature_c=-5), constants={SNOWFALL: 2.0})
    assert state.depth_m == pytest.approx(2 / fresh_density(-5), rel=0.01)


def test_depths_and_roads_that_a_recipe_gives_stay() -> None:
    curves = {"weather.snow.depth_m": Curve((0, 10), (0.0, 0.2)), **FIRST_SNOW}
    state = at(Snow(depth_m=0.1), 5.0, curves, Air())
    assert (state.depth_m, state.placed_depth_m, state.road) == (0.1, 0.2, None)
    road = SnowRoad(depth_m=0.01)
    assert at(Snow(depth_m=0.0, road=road), 600.0, air=Air(temperature_c=-3)).road == road


def test_traffic_over_time_is_the_share_of_its_most_cars() -> None:
    curves = {"weather.snow.traffic": Curve((0, 10), (0.0, 0.8))}
    state = at(Snow(depth_m=0.05, traffic=0.4), 5.0, curves)
    assert state.traffic == 0.8 and state.road is not None
    assert state.road.driven == pytest.approx(0.25)
    assert state.road.depth_m == 0.05


def test_a_road_over_time_by_hand_has_one_laid_depth() -> None:
    curves = {"weather.snow.road.depth_m": Curve((0, 10), (0.0, 0.3))}
    states = [
        at(Snow(depth_m=0.1, road=SnowRoad(depth_m=depth_m)), 5.0, curves)
        for depth_m in (0.0, 0.15, 0.3)
    ]
    assert [state.placed_depth_m for state in states] == [0.3] * 3


def test_a_recipe_without_the_later_fields_has_snow_only_with_depth() -> None:
    assert not Snow(depth_m=0.0).has_effect
    assert not Snow(depth_m=0.0, placed_depth_m=0.1).has_effect
    assert Snow(depth_m=0.0, road=SnowRoad(wetness=0.5)).has_effect
    assert not Snow(depth_m=0.05).is_scaled


def test_cover_of_a_road_grows_with_its_snow_and_not_with_its_water() -> None:
    assert Snow(depth_m=0.05, coverage=0.7).road_cover == 0.7
    assert Snow(depth_m=0.0).road_cover == 0
    wet = SnowRoad(depth_m=0.0, wetness=1.0)
    assert Snow(depth_m=0.02, road=wet).road_cover == 0
    covers = [
        Snow(depth_m=0.05, coverage=0.7, road=SnowRoad(depth_m=depth_m)).road_cover
        for depth_m in (1e-5, 0.005, 1.0)
    ]
    assert covers == pytest.approx([0.0, 0.7 * (1 - math.exp(-1)), 0.7], abs=2e-3)


def test_a_beam_ends_on_snow_that_lies_on_roads_alone() -> None:
    assert Snow(depth_m=0.0, road=SnowRoad(depth_m=0.03)).beam_surface("first") == (
        "snow 0.03 m deep",
        True,
    )
    assert Snow(depth_m=0.0, road=SnowRoad(wetness=1.0)).beam_surface("first") is None
