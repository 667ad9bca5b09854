"""Settings chosen by rendering, kept in an output, and found there again."""

from __future__ import annotations

import json
import multiprocessing
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.errors import OutputError, SceneError
from augment.jobs.generate import plan_job, run_generate
from augment.jobs.render_job import RenderJob
from augment.metrics.image import flip
from augment.output.manifest import read_manifest, recipe_columns
from augment.output.store import open_store
from augment.scene.cameras import Frame
from augment.view.plan import make_plan
from augment.view.quality import (
    Cost,
    Question,
    apply_settings,
    calibration_views,
    choose_settings,
    read_choice,
    recipes_to_try,
    render_trial,
    resize_picture,
    resolve_quality,
    search_settings,
    select_useful_values,
    steps_back,
)
from augment.view.render_view import render_view
from recipes.errors import RecipeError
from recipes.fields import section_at
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Recipe, with_reference_settings
from tests.augment.batch_scenes import FakeView, make_camera, open_fake, run_fake
from tests.augment.generate_jobs import make_job, make_recipes

# ---- The search, in tables of errors and times ---------------------------------------------------

LADDERS = {"a": (1, 2, 3), "b": ("fast", "slow"), "c": (0.5, 1.0)}  # the last are the reference
SINGLE = [(path, value) for path, values in LADDERS.items() for value in values[:-1]]
ERRORS = st.fixed_dictionaries(dict.fromkeys(SINGLE, st.floats(0, 0.2)))
TIMES = st.fixed_dictionaries(dict.fromkeys(SINGLE, st.floats(-10, 30)))


def total(table: dict, settings: dict) -> float:
    return sum(table.get(item, 0.0) for item in settings.items())


def chosen_by_error(errors: dict, bound: float, synergy: float = 1.0) -> dict:
    return search_settings(LADDERS, lambda settings: synergy * total(errors, settings) <= bound)


def chosen_by_time(errors: dict, saved: dict, budget_ms: float) -> dict:
    costs = {
        path: [
            Cost(v, 100 - saved.get((path, v), 0), errors.get((path, v), 0.0)) for v in values
        ]
        for path, values in LADDERS.items()
    }  # fmt: skip
    ladders, steps = steps_back(costs)
    return search_settings(
        ladders, lambda settings: 100 - total(saved, settings) <= budget_ms, steps
    )


def test_each_knob_takes_its_fastest_value_within_the_bound() -> None:
    errors = {("a", 1): 0.05, ("a", 2): 0.01, ("b", "fast"): 0.3, ("c", 0.5): 0.02}
    assert chosen_by_error(errors, 0.04) == {"a": 2, "b": "slow", "c": 0.5}
    # The first knobs have first call on the error.
    errors = {("a", 1): 0.03, ("a", 2): 0.02, ("b", "fast"): 0.025, ("c", 0.5): 0.01}
    assert chosen_by_error(errors, 0.04) == {"a": 1, "b": "slow", "c": 0.5}
    # Errors that only appear together lead to the reference.
    errors = dict.fromkeys(SINGLE, 0.01)
    assert chosen_by_error(errors, 0.04, synergy=9) == {"a": 3, "b": "slow", "c": 1.0}


@given(ERRORS, st.floats(0.1, 4), st.floats(0.001, 0.3))
def test_what_is_chosen_is_within_the_bound(errors, synergy: float, bound: float) -> None:
    chosen = chosen_by_error(errors, bound, synergy)
    assert synergy * total(errors, chosen) <= bound
    assert chosen_by_error(errors, bound, synergy) == chosen


def test_a_budget_first_undoes_what_errs_most() -> None:
    errors = {("a", 1): 0.2, ("a", 2): 0.05, ("b", "fast"): 0.01, ("c", 0.5): 0.1}
    saved = {("a", 1): 40, ("a", 2): 15, ("b", "fast"): 10, ("c", 0.5): 50}
    for budget_ms, chosen in (  # error undone: a to 2 0.15, c 0.1, a to 3 0.05, b 0.01
        (100, (3, "slow", 1.0)),
        (95, (3, "fast", 1.0)),
        (45, (3, "fast", 0.5)),
        (30, (2, "fast", 0.5)),
        (0, (1, "fast", 0.5)),
    ):
        assert tuple(chosen_by_time(errors, saved, budget_ms).values()) == chosen


@given(ERRORS, TIMES, st.floats(0, 100))
def test_a_budget_is_kept_where_the_fastest_keeps_it(errors, saved, budget_ms: float) -> None:
    chosen = chosen_by_time(errors, saved, budget_ms)
    fastest = chosen_by_time(errors, saved, -1)
    assert 100 - total(saved, chosen) <= max(budget_ms, 100 - total(saved, fastest))
    assert total(errors, chosen) <= total(errors, fastest)


def test_values_that_save_nothing_are_left_out() -> None:
    reference = Cost("exact", 100, 0)
    noise = Cost("noise", 99, 0.01)
    slower = Cost("s", 120, 0.02)
    good = Cost("good", 80, 0.03)
    worse = Cost("worse", 85, 0.05)
    equal = Cost("equal", 90, 0.03)
    fastest = Cost("fastest", 50, 0.2)
    free = Cost("free", 80, 0)
    costs = [fastest, worse, equal, good, slower, noise, reference]
    assert select_useful_values(costs) == [reference, good, fastest]
    assert select_useful_values([free, reference]) == [
        reference,
        free,
    ]  # as accurate as reference, and faster


# ---- Views and trials ----------------------------------------------------------------------------


def picked(frames: int, cameras: int, count: int = 3) -> list[tuple[int, str]]:
    camera_of_name = {f"c{number}": make_camera(f"c{number}", 0, 0.0) for number in range(cameras)}
    eye = torch.eye(4, dtype=torch.float64)
    frame_list = [Frame(index, index, eye, dict(camera_of_name)) for index in range(frames)]
    views = calibration_views(frame_list, count)
    assert calibration_views(frame_list[::-1], count) == views
    return [(view.frame, view.name) for view in views]


def test_views_are_spread_over_frames_and_cameras() -> None:
    assert picked(6, 6) == [(1, "c0"), (3, "c2"), (5, "c4")]
    assert picked(1, 2) == [(0, "c0"), (0, "c1")]
    assert picked(1, 1) == [(0, "c0")]
    assert picked(100, 1, 2) == [(25, "c0"), (75, "c0")]
    assert len(picked(2, 1, 5)) == 2  # no image twice
    with pytest.raises(ValueError, match="none of the 2 frames"):
        picked(2, 0)


def test_small_pictures_are_enlarged_and_depths_are_not_mixed() -> None:
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[:, 1] = 200
    assert resize_picture(picture, 2, 2) is picture
    wide = resize_picture(picture, 4, 2)
    assert wide[0, :, 0].tolist() == [0, 50, 150, 200]
    assert resize_picture(wide, 2, 2)[0, :, 0].tolist() == [25, 175]  # means over areas

    def render(scene, camera, recipe, *, backend: str) -> FakeView:
        return FakeView(picture, np.array([[1, 9], [1, 9]], np.float32))

    arguments = (open_fake("fake:a"), make_camera("front", 0, 0.0), Recipe())
    trial = render_trial(*arguments, renderer=render, size=(4, 4))
    assert trial.depth is not None and trial.depth[3].tolist() == [1, 1, 9, 9]
    own_size = render_trial(*arguments, renderer=render)
    assert own_size.rgb.shape == (16, 24, 3)


# ---- The choice in a scene -----------------------------------------------------------------------

PLAIN = "output: {depth: none, labels: false, lidar: false}\n"


def open_recipe(quality: str, text: str = "", name: str = "fog") -> Recipe:
    text = f"name: {name}\nquality: {{{quality}}}\n{text}{PLAIN}"
    return parse_recipe(text, source="test").resolve(0)


class Workbench:
    """A renderer whose pictures and times depend on the settings in a known way; a fake clock."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.rendered = 0
        self.slowness = 1.0

    def render(self, scene, camera, recipe: Recipe, *, backend: str) -> FakeView:
        make_plan(recipe, scene)  # as the real one, refuses what is not settled
        self.rendered += 1
        settings = recipe.render
        self.now_s += self.slowness * settings.scale**2 * (0.1 if settings.sh_degree == 0 else 0.12)
        small = camera.scaled(settings.scale)
        y, x = np.mgrid[: small.height, : small.width]
        shade = 60 + 2 * x / settings.scale + 3 * y / settings.scale + 10 * (camera.name == "front")
        shade = shade + (12 if settings.sh_degree == 0 else 0)
        rgb = np.repeat(shade[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)
        return FakeView(rgb)


def _mean_error(picture: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(picture.astype(np.float64) - truth).mean() / 255)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Workbench:
    """Choices are timed with its clock; errors are plain ones, as FLIP takes a tenth of a second
    however small the picture is.
    """
    bench = Workbench()
    monkeypatch.setattr("augment.view.quality.flip", _mean_error)
    monkeypatch.setattr("augment.view.quality.perf_counter", lambda: bench.now_s)
    return bench


def test_a_choice_by_error_is_within_the_bound_and_the_same_again() -> None:
    recipe = open_recipe("max_flip: 0.06")
    scene = open_fake("fake:street")
    chosen = resolve_quality(recipe, scene)
    assert resolve_quality(recipe, scene).recipe == chosen.recipe
    assert chosen.is_met and chosen.ms is None
    assert chosen.recipe.render.speed.settled and not chosen.recipe.has_open_choice
    assert chosen.recipe.quality.summary == "max_flip 0.06"
    errors = []
    for view in calibration_views(scene.frames):
        truth = render_view(scene, view.camera, with_reference_settings(chosen.recipe)).rgb
        got = render_view(scene, view.camera, chosen.recipe).rgb
        errors.append(flip(resize_picture(got, view.camera.width, view.camera.height), truth))
    assert max(errors) == chosen.flip <= 0.06
    assert chosen.recipe.render.scale < 1 or max(errors) > 0  # something was given up
    assert len(chosen.views) == 3 and chosen.views[0] == (0, "front")


def test_given_fields_stay_and_are_the_references_too(bench: Workbench) -> None:
    recipe = open_recipe(
        "max_flip: 0.9", "render: {scale: 0.5, speed: {transmittance_stop: 0.2}}\n"
    )
    chosen = resolve_quality(recipe, open_fake("fake:street"), renderer=bench.render)
    render = chosen.recipe.render
    assert (render.scale, render.speed.transmittance_stop, render.sh_degree) == (0.5, 0.2, 0)
    assert "render.scale" not in chosen.settings
    same = open_recipe("max_flip: 1e-9", "render: {scale: 0.5, sh_degree: 0}\n")
    assert resolve_quality(same, open_fake("fake:street"), renderer=bench.render).flip == 0


def test_a_budget_takes_as_little_as_it_needs(bench: Workbench) -> None:
    def chosen(budget_ms: float):
        recipe = open_recipe(f"budget_ms: {budget_ms}")
        return resolve_quality(recipe, open_fake("fake:street"), renderer=bench.render)

    enough = chosen(150)
    half = chosen(70)
    assert (enough.recipe.render.scale, enough.recipe.render.sh_degree) == (1.0, None)
    assert enough.ms == enough.reference_ms == pytest.approx(120) and enough.flip == 0
    render = half.recipe.render
    assert (render.scale, render.sh_degree) == (0.75, None)  # a smooth picture loses little
    assert half.ms == pytest.approx(67.5) and half.reference_ms == pytest.approx(120)
    assert half.is_met and 0 < half.flip < 0.1
    assert render.speed.radius_clip_px == 0  # saves nothing


def test_a_budget_beyond_reach_says_so(bench: Workbench, caplog: pytest.LogCaptureFixture) -> None:
    recipe = open_recipe("budget_ms: 1")
    chosen = resolve_quality(recipe, open_fake("fake:a"), renderer=bench.render)
    assert not chosen.is_met and chosen.recipe.render.scale == 0.25
    assert "its frames take 6 ms with the fastest settings" in caplog.text


def test_snow_that_a_scene_cannot_have_so_fine_is_coarser() -> None:
    def render(scene, camera, recipe: Recipe, *, backend: str) -> FakeView:
        assert recipe.weather.snow is not None
        if recipe.weather.snow.cell_m < 0.1:
            raise SceneError("too many cells")
        return FakeView(np.full((16, 24, 3), 99, np.uint8))

    recipe = open_recipe("budget_ms: 1e6", "weather: {snow: {depth_m: 0}}\nrender: {scale: 1}\n")
    chosen = resolve_quality(recipe, open_fake("fake:a"), renderer=render)
    assert section_at(chosen.recipe, "weather.snow.cell_m") == 0.1
    quality_recipe = open_recipe("max_flip: 0.1", "weather: {snow: {depth_m: 0, cell_m: 0.05}}\n")
    with pytest.raises(SceneError, match="too many cells"):
        resolve_quality(quality_recipe, open_fake("fake:a"), renderer=render)


def test_what_has_not_chosen_is_not_rendered() -> None:
    scene = open_fake("fake:street")
    recipe = open_recipe("max_flip: 0.1")
    with pytest.raises(RecipeError, match=r"fog, variant 0: quality max_flip 0\.1 has still to"):
        render_view(scene, make_camera("front", 0, 0.0), recipe)
    tried = recipes_to_try(recipe)
    assert len(tried) > 8 and not any(r.has_open_choice for r in tried)
    assert recipes_to_try(tried[0]) == [tried[0]]
    assert resolve_quality(tried[0], scene).recipe is tried[0]
    with pytest.raises(ValueError, match="leaves free render"):
        apply_settings(recipe, {"render.near_m": 1.0})


# ---- What an output keeps of it ------------------------------------------------------------------


def pictures(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.glob("*/*/images/*/*")}


def test_a_job_goes_on_with_its_choice_whatever_the_clock_says(
    bench: Workbench, tmp_path: Path
) -> None:
    recipe = open_recipe("budget_ms: 70")

    def run(**options):
        job = RenderJob("fake:street", [recipe], tmp_path / "a", **options)
        return run_fake(job, bench.render)

    assert run(frames=[1]).written == 2
    bench.slowness, before = 10.0, bench.rendered
    assert run(workers=1).written == 6
    assert bench.rendered == before + 6  # and none to choose by
    rows = read_manifest(tmp_path / "a").to_pylist()
    assert {r["render_scale"] for r in rows} == {0.75} and {r["width"] for r in rows} == {18}
    assert {r["quality"] for r in rows} == {"budget_ms 70"}
    assert json.loads(rows[0]["settings"])["render.scale"] == 0.75
    (choice_file,) = (tmp_path / "a/.climategs/quality").iterdir()
    choice, machine = (json.loads(choice_file.read_bytes())[k] for k in ("choice", "this_machine"))
    assert choice["is_met"] and machine["reference_ms"] == pytest.approx(120)

    # Elsewhere the recipe that the job leaves gives the same images, and chooses nothing.
    settled = load_recipe(tmp_path / "a/street/fog-000/recipe.yaml").resolve(0)
    job = RenderJob("fake:street", [settled], tmp_path / "b")
    run_fake(job, bench.render)
    assert pictures(tmp_path / "b") == pictures(tmp_path / "a")
    assert len(pictures(tmp_path / "a")) == 8
    assert not (tmp_path / "b/.climategs/quality").exists()

    assert run(overwrite=True).written == 8  # chooses anew
    assert set(read_manifest(tmp_path / "a")["render_scale"].to_pylist()) == {0.25}


def changed(document: dict, part: str, key: str, value) -> bytes:
    text = json.dumps({**document, part: {**document[part], key: value}})
    return text.encode()


def test_a_damaged_choice_is_told(bench: Workbench, tmp_path: Path) -> None:
    store = open_store(tmp_path)
    recipe = open_recipe("max_flip: 0.5")
    scene = open_fake("fake:a")
    arguments = (store, recipe, scene)
    chosen = choose_settings(*arguments, backend="cpu", renderer=bench.render)
    question = Question(recipe, scene.name, scene.source, "recorded", "cpu")
    assert read_choice(store, question) == chosen
    document = json.loads(store.read(question.path))
    settings = document["choice"]["settings"]
    wrong = [("render.scale", "1"), ("render.near_m", 1.0), ("render.scale", 77.0)]
    for data in (
        *(b"", b"[]", b'{"format": 2}', b"\xff"),
        *(changed(document, "choice", "settings", settings | {p: v}) for p, v in wrong),
        changed(document, "choice", "settings", []),
        changed(document, "asked", "source", "fake:b"),
    ):
        store.write(question.path, data)
        message = r"recipe fog in scene a, is damaged: .*Delete it"
        with pytest.raises(OutputError, match=message):
            choose_settings(*arguments, backend="cpu", renderer=bench.render)


def test_outputs_name_fields_of_speed_as_version_0_6_did(bench: Workbench, tmp_path: Path) -> None:
    store = open_store(tmp_path)
    recipe = open_recipe("max_flip: 0.5", "weather: {rain: {rate_mm_h: 5}}\n")
    scene = open_fake("fake:a")
    chosen = choose_settings(store, recipe, scene, backend="cpu", renderer=bench.render)
    question = Question(recipe, scene.name, scene.source, "recorded", "cpu")
    document = json.loads(store.read(question.path))
    columns = recipe_columns(chosen)
    for paths in (
        document["asked"]["free"],
        document["choice"]["settings"],
        json.loads(str(columns["settings"])),
    ):
        assert {"render.prune", "weather.rain.mirror_px", "weather.rain.min_width_px"} <= {*paths}
        assert not [path for path in paths if path.startswith("render.speed")]


def test_what_a_recipe_leaves_free_is_part_of_the_question() -> None:
    loose = open_recipe("max_flip: 0.5")
    tight = open_recipe("max_flip: 0.5", "render: {scale: 1}\n")
    assert loose.hash == tight.hash
    digests = {Question(r, "a", "fake:a", "recorded", "cpu").digest for r in (loose, tight)}
    assert len(digests) == 2


def _choose_slowly(folder: str, worst_scale: float, answers) -> None:
    """Pictures below a scale are all wrong."""

    def render(scene, camera, recipe, *, backend: str) -> FakeView:
        time.sleep(0.01)
        size = camera.scaled(recipe.render.scale)
        shade = 0 if recipe.render.scale < worst_scale else 255
        return FakeView(np.full((size.height, size.width, 3), shade, np.uint8))

    recipe = open_recipe("max_flip: 0.5")
    store = open_store(folder)
    options = {"backend": "cpu", "renderer": render}
    answers.put(choose_settings(store, recipe, open_fake("fake:a"), **options).render.scale)


def test_two_processes_agree(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    scales = (0.25, 0.5)
    answers = context.Queue()
    children = [
        context.Process(target=_choose_slowly, args=(str(tmp_path), s, answers)) for s in scales
    ]
    for child in children:
        child.start()
    got = [answers.get(timeout=60) for _ in children]
    for child in children:
        child.join()
    assert got[0] == got[1] and got[0] in scales


def test_a_dataset_keeps_its_choices(bench: Workbench, tmp_path: Path) -> None:
    text = f"quality: {{budget_ms: 70}}\n{PLAIN}"
    recipes = make_recipes(["slow", "dry"], texts={"slow": text})
    opened: list[str] = []

    def opener(uri: str):
        opened.append(uri)
        return open_fake(uri)

    def job(**options):
        scenes = ["fake:a?frames=2", "fake:b?frames=2"]
        return make_job(
            tmp_path / "out", scenes, recipes, renderer=bench.render, opener=opener, **options
        )

    first = run_generate(job(shard=(1, 2)), progress=False)
    assert first.written == 8 and not first.unusable
    bench.slowness, before = 10.0, bench.rendered
    opened.clear()
    second = run_generate(job(shard=(2, 2)), progress=False)
    assert second.written == 8 and bench.rendered == before + 8
    assert opened == ["fake:b?frames=2"]
    rows = read_manifest(tmp_path / "out").to_pylist()
    assert {(r["recipe"], r["render_scale"]) for r in rows} == {("slow", 0.75), ("dry", 1.0)}
    planned = plan_job(job(), progress=False)
    assert {b.recipe.render.scale for b in planned.blocks} == {0.75, 1.0}
    assert opened == ["fake:b?frames=2"]
