"""Weather that changes over time, in views, sweeps and samples of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from augment.dataset.live import SceneDataset
from augment.scene.scene_times import scene_times
from augment.view.plan import make_plan, plan_at
from augment.view.render_view import render_view, render_views
from augment.view.weathered_sweep import weathered_sweep
from recipes.load import parse_recipe
from recipes.schema import Recipe
from tests.streets import LABELLED_STREET, open_street

STREET = LABELLED_STREET.replace("frames=2", "frames=4")


def recipe_of(weather: str) -> Recipe:
    text = f"weather: {weather}\noutput: {{labels: true}}"
    return parse_recipe(text, source="weather.yaml", name="weather").resolve(0)


CHANGING = recipe_of(
    "{smog: {visibility_m: {timeline: [[0, 400], [1, 40]], times: share}}, "
    "rain: {rate_mm_h: {timeline: [[0, 0], [0.5, 20], [1, 5]], times: share, shape: smooth}}}"
)


def test_times_of_a_scene_are_those_of_its_first_and_last_image() -> None:
    scene = open_street(STREET)
    times = scene_times(scene)
    stamps = [c.timestamp_ns for f in scene.frames for c in f.cameras.values()]
    assert (times.start_ns, times.end_ns, times.num_frames) == (min(stamps), max(stamps), 4)


def test_an_image_has_the_recipe_of_its_own_time() -> None:
    scene = open_street(STREET)
    times = scene_times(scene)
    middle_ns = (times.start_ns + times.end_ns) // 2
    recipe, plan = plan_at(CHANGING, scene, middle_ns)
    assert recipe.weather.rain is not None and recipe.weather.smog is not None
    assert recipe.weather.rain.rate_mm_h == pytest.approx(20, abs=1e-5)
    assert recipe.weather.smog.visibility_m == pytest.approx(220, abs=1e-4)
    assert plan.weather_time_s == pytest.approx(times.duration_s / 2, abs=1e-6)
    assert all(e.weather_time_s == plan.weather_time_s for e in plan.active_effects(scene))
    assert plan.steps == make_plan(recipe, scene).steps


def test_a_frame_alone_has_the_bits_of_the_frame_in_sequence() -> None:
    scene = open_street(STREET)
    cameras = [next(iter(frame.cameras.values())) for frame in scene.frames]
    sequence = [view.rgb for view in render_views(scene, cameras, CHANGING)]
    alone = render_view(open_street(STREET), cameras[2], CHANGING).rgb
    assert np.array_equal(sequence[2], alone)
    assert not np.array_equal(sequence[0], sequence[2])


def test_a_changing_image_is_the_image_of_the_plain_recipe_at_its_time() -> None:
    scene = open_street(STREET)
    camera = next(iter(scene.frames[1].cameras.values()))
    plain = CHANGING.at(scene_times(scene), camera.timestamp_ns)
    assert plain.timelines == ()
    changing = render_view(scene, camera, CHANGING).rgb
    assert np.array_equal(changing, render_view(scene, camera, plain).rgb)


def test_a_constant_timeline_has_the_bits_of_the_plain_number() -> None:
    scene = open_street(STREET)
    camera = next(iter(scene.frames[1].cameras.values()))
    plain = recipe_of("{smog: {visibility_m: 80}}")
    constant = recipe_of("{smog: {visibility_m: {timeline: [[0, 80], [0.1, 80]]}}}")
    pictures = [render_view(scene, camera, recipe).rgb for recipe in (plain, constant)]
    assert np.array_equal(*pictures)


def test_a_sweep_has_the_weather_of_its_frames_time() -> None:
    scene = open_street(STREET)
    for frame in (scene.frames[0], scene.frames[-1]):
        sweep = scene.lidar(frame.index)
        assert sweep is not None
        plain = CHANGING.at(scene_times(scene), frame.timestamp_ns)
        changing = weathered_sweep(scene, CHANGING, frame.index, sweep).columns
        fixed = weathered_sweep(scene, plain, frame.index, sweep).columns
        assert all(np.array_equal(changing[n], fixed[n], equal_nan=True) for n in ("x", "y", "z"))


def test_a_live_sample_states_the_weather_of_its_own_time() -> None:
    scene = open_street(STREET)
    dataset = SceneDataset(scene, CHANGING, load=("image",))
    rates = []
    for frame, index in ((scene.frames[0], 0), (scene.frames[-1], len(dataset) - 1)):
        sample = dataset[index]
        camera = frame.cameras[sample["camera"]["name"]]
        plain = CHANGING.at(scene_times(scene), camera.timestamp_ns)
        assert sample["weather"]["rain_rate_mm_h"] == plain.columns()["rain_rate_mm_h"]
        rates.append(sample["weather"]["rain_rate_mm_h"])
    assert rates[0] != rates[1]
