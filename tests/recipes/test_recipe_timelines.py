"""Timelines: values of fields that change over time, read, checked, written and put in."""

from __future__ import annotations

import time
import timeit

import pytest

from recipes.errors import RecipeError
from recipes.load import dump_recipe, parse_recipe
from recipes.moment import SceneTimes
from recipes.schema import Recipe

# A drive of 8 s, 10 images a second, that begins at a time of the dataset's.
TIMES = SceneTimes(1_000_000_000_000, 1_008_000_000_000, 81)
SHOWER = "{timeline: [[0, 0], [4, 10], [6, 10], [8, 2]]}"


def recipe_of(text: str) -> Recipe:
    return parse_recipe(text, source="weather.yaml", name="weather").resolve(0)


def rain_at(recipe: Recipe, drive_s: float) -> float:
    moment = recipe.at(TIMES, TIMES.start_ns + round(drive_s * 1e9))
    assert moment.weather.rain is not None
    return moment.weather.rain.rate_mm_h


def rain(timeline: str, more: str = "") -> Recipe:
    return recipe_of(f"weather: {{rain: {{rate_mm_h: {timeline}}}, {more}}}")


def test_a_field_has_its_timelines_value_at_the_time_of_an_image() -> None:
    recipe = rain(SHOWER)
    assert [rain_at(recipe, t) for t in (0, 1, 4, 5, 7)] == [0, 2.5, 10, 10, 6]


def test_before_the_first_point_and_after_the_last_the_value_stays() -> None:
    recipe = rain("{timeline: [[2, 3], [6, 7]]}")
    assert [rain_at(recipe, t) for t in (-100, 0, 8)] == [3, 3, 7]


@pytest.mark.parametrize(("shape", "value"), [("linear", 2.5), ("smooth", 1.5625), ("step", 0.0)])
def test_a_shape_decides_the_values_between_points(shape: str, value: float) -> None:
    timeline = f"{{timeline: [[0, 0], [4, 10]], shape: {shape}}}"
    assert rain_at(rain(timeline), 1.0) == pytest.approx(value, abs=1e-12)


def test_shares_are_of_the_drive() -> None:
    recipe = rain("{timeline: [[0, 0], [1, 8]], times: share}")
    assert [rain_at(recipe, t) for t in (0, 2, 8)] == [0, 2, 8]


def test_a_clock_gives_the_weather_its_own_speed_and_start() -> None:
    recipe = rain("{timeline: [[0, 0], [540, 9]]}", "clock: {start_s: 60, speed: 60}")
    assert rain_at(recipe, 0) == 1
    assert rain_at(recipe, 4) == 5
    assert recipe.weather_time_s(TIMES, TIMES.start_ns + 10**9) == 120
    shares = rain("{timeline: [[0, 0], [1, 8]], times: share}", "clock: {start_s: 60, speed: 60}")
    assert rain_at(shares, 2) == 2


def test_words_whole_numbers_and_booleans_step() -> None:
    recipe = recipe_of(
        "weather: {rain: {rate_mm_h: 4, spray: {timeline: [[0, false], [3, true]]}}, "
        "snow: {depth_m: 0.1, tracks: {timeline: [[0, never], [5, always]]}}}"
    )
    early = recipe.at(TIMES, TIMES.start_ns + 2_999_000_000).weather
    late = recipe.at(TIMES, TIMES.start_ns + 5_000_000_000).weather
    assert early.rain and late.rain and early.snow and late.snow
    assert (early.rain.spray, early.snow.tracks) == (False, "never")
    assert (late.rain.spray, late.snow.tracks) == (True, "always")


def test_a_constant_timeline_is_the_plain_number() -> None:
    plain = rain("5")
    constant = rain("{timeline: [[0, 5], [3, 5.0]], shape: smooth}")
    assert constant == plain
    assert constant.hash == plain.hash
    assert constant.at(TIMES, TIMES.end_ns) is constant


def test_recipes_without_anything_new_keep_their_text() -> None:
    text = rain("5").canonical_json()
    assert "timeline" not in text and "clock" not in text and "air" not in text.split("rain")[0]


def test_timelines_are_part_of_the_hash_and_lines_are_not() -> None:
    recipe = rain(SHOWER)
    other_line = recipe_of(f"name: weather\n\n\nweather: {{rain: {{rate_mm_h: {SHOWER}}}}}")
    assert recipe == other_line and recipe.hash == other_line.hash
    assert recipe.timelines[0].place != other_line.timelines[0].place
    others = ("{timeline: [[0, 0], [4, 10]]}", "{timeline: [[0, 0], [4, 10]], shape: smooth}", "10")
    assert len({recipe.hash, *(rain(other).hash for other in others)}) == 4


def test_the_field_holds_the_largest_value() -> None:
    weather = rain(SHOWER).weather
    assert weather.rain and weather.rain.rate_mm_h == 10


def test_a_written_recipe_reads_back() -> None:
    recipe = rain(
        "{timeline: [[{uniform: [0, 1]}, {normal: {mean: 1, std: 1, min: 0, max: 3}}], [4, 10]], "
        "shape: smooth, times: seconds}",
        "air: {humidity: {timeline: [[0, 0.9], [1, 0.3]], times: share}}",
    )
    again = parse_recipe(dump_recipe(recipe), source="again.yaml").resolve(0)
    assert again == recipe and again.hash == recipe.hash
    assert len(again.timelines) == 2


def test_points_are_drawn_one_by_one() -> None:
    text = """
variants: 20
weather:
  rain:
    rate_mm_h:
      timeline: [[{uniform: [0, 1]}, {uniform: [1, 2]}], [{uniform: [2, 3]}, {choice: [7, 8]}]]
"""
    template = parse_recipe(text, source="weather.yaml", name="weather")
    points = [template.resolve(variant).timelines[0].points for variant in range(20)]
    assert len({first for first, _ in points}) == 20
    assert all(0 <= a <= 1 <= x <= 2 <= b <= 3 and y in (7, 8) for (a, x), (b, y) in points)
    assert "timeline" in template.describe_draws()


def test_a_choice_may_be_between_timelines() -> None:
    text = f"variants: 9\nweather: {{rain: {{rate_mm_h: {{choice: [3, {SHOWER}]}}}}}}"
    template = parse_recipe(text, source="weather.yaml", name="weather")
    assert {len(template.resolve(v).timelines) for v in range(9)} == {0, 1}


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("{timeline: []}", "timeline = []: must be a list of at least one point"),
        ("{timeline: [[0, 1], [0, 2]]}", "timeline[1][0] = 0: times must rise"),
        ("{timeline: [[5, 1], [0, 2]]}", "times must rise from point to point; the point before"),
        (
            "{timeline: [[0, 1], [{uniform: [-1, 2]}, 2]]}",
            "times must rise from point to point; the point before is at 0 in some draws",
        ),
        ("{timeline: [[0, 1], [4, -2]]}", "timeline[1][1] = -2: must be >= 0 and <= 300"),
        ("{timeline: [[0, 1], [4, {uniform: [5, 500]}]]}", "timeline[1][1].uniform[1] = 500: must"),
        ("{timeline: [[0, 1], [4, null]]}", "timeline[1][1] = null: must be a number"),
        ("{timeline: [[0, 1], [a, 2]]}", "timeline[1][0] = 'a': must be a number"),
        ("{timeline: [[0, 1], 4]}", "timeline[1] = 4: must be a point, [time, value]"),
        ("{timeline: [[0, 1], [4, 2]], shape: smoth}", "did you mean smooth?"),
        ("{timeline: [[0, 1], [4, 2]], unit: s}", "unit: no part of a timeline"),
        ("{timeline: [[0, 1], [1.5, 2]], times: share}", "timeline[1][0] = 1.5: must be <= 1"),
        ("{timeline: [[0, 1], [.nan, 2]]}", "timeline[1][0]"),
    ],
)
def test_a_wrong_timeline_is_refused_with_its_line(field: str, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        recipe_of(f"weather:\n  rain:\n    rate_mm_h: {field}\n")
    assert "weather.yaml:3: weather.rain.rate_mm_h" in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("weather: {air: {humidity: 1.4}}", "weather.air.humidity = 1.4: must be >= 0 and <= 1"),
        ("weather: {air: {wind_m_s: 100}}", "weather.air.wind_m_s = 100: must be >= 0 and <= 60"),
        ("weather: {clock: {speed: 0}}", "weather.clock.speed = 0: must be > 0"),
        ("render: {scale: {timeline: [[0, 1], [1, 0.5]]}}", "render.scale"),
        ("weather: {snow: {depth_m: 1, cell_m: {timeline: [[0, 1], [1, 2]]}}}", "snow.cell_m"),
        ("weather: {snow: {depth_m: 1, seed: {timeline: [[0, 1], [1, 2]]}}}", "snow.seed"),
        ("timelines: []", "timelines: unknown field"),
    ],
)
def test_other_wrong_fields_are_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=r"weather\.yaml:1: ") as caught:
        recipe_of(text)
    assert message in str(caught.value)


def test_a_point_beyond_the_drive_is_refused_with_its_line() -> None:
    recipe = recipe_of("weather:\n  rain:\n    rate_mm_h: {timeline: [[0, 1], [9, 2]]}")
    with pytest.raises(RecipeError) as caught:
        recipe.at(TIMES, TIMES.start_ns)
    assert "weather.yaml:3: weather.rain.rate_mm_h.timeline[1]: time 9 s lies" in str(caught.value)
    assert "from 0 to 8 s" in str(caught.value)
    # 81 images at 10 Hz are 8.1 s of driving
    assert rain_at(rain("{timeline: [[0, 1], [8.1, 2]]}"), 0) == 1


def test_the_note_of_snow_that_the_weather_makes_states_no_depth() -> None:
    falling = "{timeline: [[0, 0], [1, 2]], times: share}"
    recipe = recipe_of(
        f"weather: {{snow: {{depth_m: 0}}, snowfall: {{rate_mm_h: {falling}}}, "
        "air: {temperature_c: -2}}\noutput: {lidar: true}"
    )
    note = recipe.lidar_note("clean")
    assert note is not None and note.startswith("snow that changes over time in images and depth")


def test_shares_of_a_drive_of_one_frame_are_refused() -> None:
    still = SceneTimes(5, 5, 1)
    with pytest.raises(RecipeError, match="times: share"):
        rain("{timeline: [[0, 1], [1, 2]], times: share}").at(still, 5)
    before = rain("{timeline: [[-10, 1], [0, 2]]}").at(still, 5)
    assert before.weather.rain and before.weather.rain.rate_mm_h == 2


def test_a_recipe_at_a_moment_costs_less_than_a_millisecond() -> None:
    recipe = rain(SHOWER, "air: {humidity: {timeline: [[0, 0.9], [1, 0.3]], times: share}}")
    runs = timeit.repeat(
        lambda: recipe.at(TIMES, TIMES.end_ns), timer=time.process_time, number=20, repeat=5
    )
    seconds = min(runs) / 20
    assert seconds < 1e-3
