"""Weather that changes over time, in views, sweeps and samples of a scene."""

from __future__ import annotations

import json
from collections.abc import Hashable
from pathlib import Path

import numpy as np
import pytest

from augment.dataset.live import SceneDataset
from augment.effects import EFFECTS, JobContext, precompute_effects
from augment.jobs.generate import plan_job, run_generate
from augment.jobs.render_job import RenderJob
from augment.output.manifest import read_manifest
from augment.scene.scene_times import scene_times
from augment.view.plan import make_plan, plan_at
from augment.view.quality import calibration_views
from augment.view.render_view import render_view, render_views
from augment.view.weathered_sweep import weathered_sweep
from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.schema import Recipe
from tests.augment.batch_scenes import open_fake, run_fake, tree_digest
from tests.augment.fork_server import quick_context, start_fork_server
from tests.augment.generate_jobs import make_job, make_recipes
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
    scene = open_street(STREET, has_wet_ground=True)
    times = scene_times(scene)
    stamps = [c.timestamp_ns for f in scene.frames for c in f.cameras.values()]
    assert (times.start_ns, times.end_ns, times.num_frames) == (min(stamps), max(stamps), 4)


def test_an_image_has_the_recipe_of_its_own_time() -> None:
    scene = open_street(STREET, has_wet_ground=True)
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
    scene = open_street(STREET, has_wet_ground=True)
    cameras = [next(iter(frame.cameras.values())) for frame in scene.frames]
    sequence = [view.rgb for view in render_views(scene, cameras, CHANGING)]
    alone = render_view(open_street(STREET, has_wet_ground=True), cameras[2], CHANGING).rgb
    assert np.array_equal(sequence[2], alone)
    assert not np.array_equal(sequence[0], sequence[2])


def test_a_changing_image_is_the_image_of_the_plain_recipe_at_its_time() -> None:
    scene = open_street(STREET, has_wet_ground=True)
    camera = next(iter(scene.frames[1].cameras.values()))
    plain = CHANGING.at(scene_times(scene), camera.timestamp_ns)
    assert plain.timelines == ()
    changing = render_view(scene, camera, CHANGING).rgb
    assert np.array_equal(changing, render_view(scene, camera, plain).rgb)


def test_a_constant_timeline_has_the_bits_of_the_plain_number() -> None:
    scene = open_street(STREET, has_wet_ground=True)
    camera = next(iter(scene.frames[1].cameras.values()))
    plain = recipe_of("{smog: {visibility_m: 80}}")
    constant = recipe_of("{smog: {visibility_m: {timeline: [[0, 80], [0.1, 80]]}}}")
    pictures = [render_view(scene, camera, recipe).rgb for recipe in (plain, constant)]
    assert np.array_equal(*pictures)


def test_a_sweep_has_the_weather_of_its_frames_time() -> None:
    scene = open_street(STREET, has_wet_ground=True)
    for frame in (scene.frames[0], scene.frames[-1]):
        sweep = scene.lidar(frame.index)
        assert sweep is not None
        plain = CHANGING.at(scene_times(scene), frame.timestamp_ns)
        changing = weathered_sweep(scene, CHANGING, frame.index, sweep).columns
        fixed = weathered_sweep(scene, plain, frame.index, sweep).columns
        assert all(np.array_equal(changing[n], fixed[n], equal_nan=True) for n in ("x", "y", "z"))


def test_a_live_sample_states_the_weather_of_its_own_time() -> None:
    scene = open_street(STREET, has_wet_ground=True)
    dataset = SceneDataset(scene, CHANGING, load=("image",))
    rates = []
    for frame, index in ((scene.frames[0], 0), (scene.frames[-1], len(dataset) - 1)):
        sample = dataset[index]
        camera = frame.cameras[sample["camera"]["name"]]
        plain = CHANGING.at(scene_times(scene), camera.timestamp_ns)
        assert sample["weather"]["rain_rate_mm_h"] == plain.columns()["rain_rate_mm_h"]
        rates.append(sample["weather"]["rain_rate_mm_h"])
    assert rates[0] != rates[1]


# ---- Jobs, on stand-in scenes of 0.3 s ---------------------------------------------------------

CLEARING = recipe_of(
    "{clock: {speed: 10}, smog: {visibility_m: {timeline: [[0, 50], [1, 350]], times: share}, "
    "scale_height_m: {timeline: [[0, 10], [2, 40]], shape: smooth}}}"
)


def manifest_rows(out: Path, **options) -> list[dict]:
    run_fake(RenderJob("fake:street", [CLEARING], out, **options))
    return list(map(no_nan, read_manifest(out).to_pylist()))


def no_nan(row: dict) -> dict:
    """A row with None in place of NaN, which equals itself."""
    return {name: None if value != value else value for name, value in row.items()}


def test_a_manifest_has_the_values_at_each_images_own_time(tmp_path) -> None:
    scene = open_fake("fake:street")
    rows = manifest_rows(tmp_path / "all")
    assert len(rows) == 8
    assert len({row["smog_extinction_per_m"] for row in rows}) == 8  # two cameras, 1 ns apart
    for row in rows:
        smog = CLEARING.at(scene_times(scene), row["timestamp_ns"]).weather.smog
        assert smog is not None
        assert row["smog_extinction_per_m"] == smog.resolved_extinction_per_m
        assert row["smog_scale_height_m"] == smog.scale_height_m
        assert json.loads(row["timeline_values"]) == {
            "weather.smog.scale_height_m": smog.scale_height_m,
            "weather.smog.visibility_m": smog.visibility_m,
        }
        first_ns = min(row["timestamp_ns"] for row in rows)
        assert row["weather_time_s"] == pytest.approx((row["timestamp_ns"] - first_ns) / 1e8)
        assert row["recipe_hash"] == CLEARING.hash


def test_rows_are_the_same_for_a_frame_alone_and_after_a_second_run(tmp_path) -> None:
    rows = manifest_rows(tmp_path / "all")
    alone = manifest_rows(tmp_path / "alone", frames=[2])
    assert alone == [row for row in rows if row["frame"] == 2]
    assert manifest_rows(tmp_path / "all") == rows  # nothing is rendered again
    first = manifest_rows(tmp_path / "parts", frames=[0, 1])
    assert manifest_rows(tmp_path / "parts") == rows and first == rows[:4]


@pytest.fixture
def quick_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    start_fork_server("tests.augment.batch_scenes", "augment.jobs.pools")
    monkeypatch.setattr("multiprocessing.get_context", quick_context)


@pytest.mark.usefixtures("quick_workers")
def test_two_workers_write_what_one_writes(tmp_path) -> None:
    fog = recipe_of("{smog: {visibility_m: {timeline: [[0, 10], [1, 90]], times: share}}}")
    for workers in (1, 2):
        job = RenderJob("fake:street", [fog], tmp_path / str(workers), workers=workers)
        run_fake(job, renderer=None)
    trees = [tree_digest(tmp_path / name / "street") for name in "12"]
    assert trees[0] == trees[1]
    manifests = [(tmp_path / name / "manifest.parquet").read_bytes() for name in "12"]
    assert manifests[0] == manifests[1]
    alone = RenderJob("fake:street", [fog], tmp_path / "3", frames=[2])
    run_fake(alone, renderer=None)
    checksums = [
        {(row["frame"], row["camera"]): row["checksum"] for row in read_manifest(path).to_pylist()}
        for path in (tmp_path / "1", tmp_path / "3")
    ]
    assert len(checksums[1]) == 2 and checksums[1].items() <= checksums[0].items()


def test_a_recipe_that_never_changes_has_no_time_in_its_rows(tmp_path) -> None:
    plain = recipe_of("{smog: {visibility_m: 80}}")
    run_fake(RenderJob("fake:street", [plain], tmp_path / "out"))
    rows = read_manifest(tmp_path / "out").to_pylist()
    assert {(row["weather_time_s"], row["timeline_values"]) for row in rows} == {(None, None)}


def test_a_scene_that_ends_before_a_timeline_is_left_out_of_a_job(tmp_path) -> None:
    text = "weather: {smog: {visibility_m: {timeline: [[0, 50], [0.39, 350]]}}}"
    recipes = make_recipes(("fog",), texts={"fog": text})  # 4 frames last 0.4 s, 3 frames 0.3 s
    planned = plan_job(make_job(tmp_path / "out", recipes=recipes), progress=False)
    assert set(planned.records) == {"a"}
    (why,) = planned.unusable.values()
    assert "fog.yaml:4: weather.smog.visibility_m.timeline[1]" in why and "beyond the drive" in why


def test_a_job_of_many_scenes_notes_each_images_time(tmp_path) -> None:
    text = "weather: {smog: {visibility_m: {timeline: [[0, 50], [1, 350]], times: share}}}"
    out = tmp_path / "out"
    run_generate(make_job(out, recipes=make_recipes(("fog",), texts={"fog": text})), progress=False)
    rows = read_manifest(out).to_pylist()
    last = {scene: max((r for r in rows if r["scene"] == scene), key=timestamp) for scene in "ab"}
    values = [json.loads(row["timeline_values"]) for row in last.values()]
    assert values == [{"weather.smog.visibility_m": 350.0}] * 2


def timestamp(row: dict) -> int:
    return row["timestamp_ns"]


@pytest.mark.parametrize(
    "weather",
    [
        "{snow: {depth_m: {timeline: [[0, 0], [0.3, 0.1]]}}}",
        "{rain: {rate_mm_h: 0, wetness: {timeline: [[0, 0], [0.3, 1]]}}}",
    ],
)
def test_weather_that_begins_later_is_warmed_up_too(weather: str) -> None:
    dry, *later = recipe_of(weather).over_time(scene_times(open_fake("fake:street")))

    def kernel_keys(recipe: Recipe) -> list[Hashable]:
        sections = [(effect, effect.section_of(recipe)) for effect in EFFECTS]
        return [effect.kernel_key(section) for effect, section in sections if section is not None]

    assert all(kernel_keys(state) != kernel_keys(dry) for state in later)


def test_a_timeline_beyond_the_drive_stops_a_job_before_it_renders() -> None:
    late = recipe_of("{smog: {visibility_m: {timeline: [[0, 50], [30, 350]]}}}")
    with pytest.raises(RecipeError, match="beyond the drive"):
        precompute_effects(JobContext(open_fake("fake:street"), [late]))


def test_quality_is_measured_at_the_weathers_extremes_too() -> None:
    frames = open_fake("fake:street?frames=40").frames
    usual = calibration_views(frames)
    more = calibration_views(frames, times_ns=[frames[0].timestamp_ns, frames[39].timestamp_ns])
    assert more[: len(usual)] == usual
    assert [view.frame for view in more[len(usual) :]] == [0, 39]


def test_key_times_are_the_drives_ends_the_points_and_the_middles_between() -> None:
    times = scene_times(open_fake("fake:street"))
    assert CLEARING.key_times_s(times) == pytest.approx((0, 1, 2, 2.5, 3))
    states = CLEARING.over_time(times)
    visibilities = [state.weather.smog.visibility_m for state in states if state.weather.smog]
    assert visibilities == pytest.approx([50, 150, 250, 300, 350])
    plain = recipe_of("{smog: {visibility_m: 80}}")
    assert plain.over_time(times) == (plain,) and plain.over_time(times)[0] is plain
