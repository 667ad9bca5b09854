"""Settings chosen by rendering, recorded in an output, and found there again."""

from __future__ import annotations

import functools
import json
import multiprocessing
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from batch_scenes import FakeView, make_camera, open_fake
from generate_jobs import make_job, make_recipes

from augment.errors import OutputError, SceneError
from augment.jobs import quality as record
from augment.jobs.generate import plan_job, run_generate
from augment.jobs.manifest import read_manifest
from augment.jobs.quality import (
    Question,
    Report,
    Resolved,
    Settings,
    calibration_views,
    recipes_to_try,
    recorded,
    render_trial,
    resolve_quality,
    resolve_quality_once,
    resolved_recipe,
    upsampled,
)
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.store import open_store
from augment.metrics.image import flip
from augment.plan import make_plan
from augment.views import render_view
from recipes.errors import RecipeError
from recipes.fields import found
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Recipe, as_reference, free_knobs

PLAIN = "output: {depth: none, labels: false, lidar: false}\n"


def open_recipe(quality: str, text: str = "", name: str = "fog") -> Recipe:
    text = f"name: {name}\nquality: {{{quality}}}\n{text}{PLAIN}"
    return parse_recipe(text, source="test").resolve(0)


class Workbench:
    """A renderer whose pictures and times depend on the settings in a known way; a fake clock."""

    def __init__(self) -> None:
        self.now_s, self.rendered, self.slowness = 0.0, 0, 1.0

    def clock(self) -> float:
        return self.now_s

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
    """Its clock is the one that jobs time their choices with; errors are plain ones, as FLIP takes
    a tenth of a second however small the picture is.
    """
    bench = Workbench()
    monkeypatch.setattr("augment.jobs.quality.flip", _mean_error)
    monkeypatch.setattr(
        record, "resolve_quality", functools.partial(resolve_quality, clock=bench.clock)
    )
    return bench


def test_a_choice_by_error_is_within_the_bound_and_the_same_again() -> None:
    recipe, scene = open_recipe("max_flip: 0.06"), open_fake("fake:street")
    settled = resolve_quality(recipe, scene)
    assert resolve_quality(recipe, scene).recipe == settled.recipe
    report = settled.report
    assert report is not None and report.is_met and report.ms is None
    assert settled.recipe.quality.settled and not settled.recipe.quality.is_open
    assert settled.recipe.quality.words == "max_flip 0.06"
    errors = []
    for view in calibration_views(scene.frames):
        truth = render_view(scene, view.camera, as_reference(settled.recipe)).rgb
        got = render_view(scene, view.camera, settled.recipe).rgb
        errors.append(flip(upsampled(got, view.camera.width, view.camera.height), truth))
    assert max(errors) == report.flip <= 0.06
    assert settled.recipe.render.scale < 1 or max(errors) > 0  # something was given up
    assert len(report.views) == 3 and report.views[0] == (0, "front")


def test_given_fields_stay_and_are_the_references_too(bench: Workbench) -> None:
    recipe = open_recipe("max_flip: 0.9", "render: {scale: 0.5, transmittance_stop: 0.2}\n")
    settled = resolve_quality(recipe, open_fake("fake:street"), renderer=bench.render)
    assert settled.recipe.render.scale == 0.5 and settled.recipe.render.transmittance_stop == 0.2
    assert settled.recipe.render.sh_degree == 0
    assert settled.report is not None
    assert "render.scale" not in settled.report.settings
    trial = render_trial(
        open_fake("fake:street"),
        make_camera("front", 0, 0.0),
        settled.recipe,
        renderer=bench.render,
    )
    assert trial.picture.shape == (16, 24, 3) and trial.depth is None  # the camera's own size


def test_a_budget_takes_as_little_as_it_needs(bench: Workbench) -> None:
    scene = open_fake("fake:street")

    def chosen(budget_ms: float):
        recipe = open_recipe(f"budget_ms: {budget_ms}")
        settled = resolve_quality(recipe, scene, renderer=bench.render, clock=bench.clock)
        assert settled.report is not None
        return settled.recipe.render, settled.report

    render, report = chosen(150)
    assert (render.scale, render.sh_degree, report.ms) == (1.0, None, pytest.approx(120))
    assert report.measured == () and report.flip == 0  # nothing had to be given up
    render, report = chosen(70)
    assert (render.scale, render.sh_degree) == (0.75, None)  # a smooth picture loses little
    assert report.ms == pytest.approx(67.5) and report.reference_ms == pytest.approx(120)
    assert report.is_met and 0 < report.flip < 0.1
    assert render.radius_clip_px == 0  # saves nothing


def test_a_budget_beyond_reach_says_so(bench: Workbench, caplog: pytest.LogCaptureFixture) -> None:
    recipe = open_recipe("budget_ms: 1")
    settled = resolve_quality(recipe, open_fake("fake:a"), renderer=bench.render, clock=bench.clock)
    assert settled.report is not None and not settled.report.is_met
    assert settled.recipe.render.scale == 0.25
    assert "its frames take 6 ms with the fastest settings" in caplog.text


def test_snow_that_a_scene_cannot_have_so_fine_is_coarser() -> None:
    def render(scene, camera, recipe: Recipe, *, backend: str) -> FakeView:
        assert recipe.weather.snow is not None
        if recipe.weather.snow.cell_m < 0.1:
            raise SceneError("too many cells")
        return FakeView(np.full((16, 24, 3), 99, np.uint8))

    recipe = open_recipe("budget_ms: 1e6", "weather: {snow: {depth_m: 0}}\nrender: {scale: 1}\n")
    settled = resolve_quality(recipe, open_fake("fake:a"), renderer=render)
    assert found(settled.recipe, "weather.snow.cell_m") == 0.1
    given = open_recipe("max_flip: 0.1", "weather: {snow: {depth_m: 0, cell_m: 0.05}}\n")
    with pytest.raises(SceneError, match="too many cells"):
        resolve_quality(given, open_fake("fake:a"), renderer=render)


def test_what_has_not_chosen_is_not_rendered() -> None:
    scene, recipe = open_fake("fake:street"), open_recipe("max_flip: 0.1")
    with pytest.raises(RecipeError, match=r"fog, variant 0: quality max_flip 0\.1 has still to"):
        render_view(scene, make_camera("front", 0, 0.0), recipe)
    tried = recipes_to_try(recipe)
    assert len(tried) > 8 and not any(r.quality.is_open for r in tried)
    assert (
        recipes_to_try(tried[0]) == [tried[0]] and resolve_quality(tried[0], scene).report is None
    )
    with pytest.raises(ValueError, match="leaves free render"):
        resolved_recipe(recipe, {"render.near_m": 1.0})


def pictures(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.glob("*/*/images/*/*")}


def test_a_job_goes_on_with_its_choice_whatever_the_clock_says(
    bench: Workbench, tmp_path: Path
) -> None:
    recipe = open_recipe("budget_ms: 70")

    def run(**options):
        job = RenderJob("fake:street", [recipe], tmp_path / "a", **options)
        return run_job(job, scene_loader=open_fake, renderer=bench.render, progress=False)

    assert run(frames=[1]).written == 2
    bench.slowness, before = 10.0, bench.rendered
    assert run(workers=1).written == 6
    assert bench.rendered == before + 6  # and none to choose by
    rows = read_manifest(tmp_path / "a").to_pylist()
    assert {r["render_scale"] for r in rows} == {0.75} and {r["width"] for r in rows} == {18}
    assert {r["quality"] for r in rows} == {"budget_ms 70"}
    assert json.loads(rows[0]["settings"])["render.scale"] == 0.75
    (kept,) = (tmp_path / "a/.climategs/quality").iterdir()
    choice, machine = (json.loads(kept.read_bytes())[k] for k in ("choice", "this_machine"))
    assert choice["is_met"] and machine["reference_ms"] == pytest.approx(120)

    # Elsewhere the recipe that the job leaves gives the same images, and chooses nothing.
    settled = load_recipe(tmp_path / "a/street/fog-000/recipe.yaml").resolve(0)
    job = RenderJob("fake:street", [settled], tmp_path / "b")
    run_job(job, scene_loader=open_fake, renderer=bench.render, progress=False)
    assert pictures(tmp_path / "b") == pictures(tmp_path / "a")
    assert len(pictures(tmp_path / "a")) == 8
    assert not (tmp_path / "b/.climategs/quality").exists()

    assert run(overwrite=True).written == 8  # chooses anew
    assert set(read_manifest(tmp_path / "a")["render_scale"].to_pylist()) == {0.25}


@pytest.mark.parametrize("data", [b"", b"[]", b'{"format": 2}', b"\xff"])
def test_a_damaged_choice_is_told(bench: Workbench, tmp_path: Path, data: bytes) -> None:
    store, recipe = open_store(tmp_path), open_recipe("max_flip: 0.5")
    question = Question(recipe, "a", "fake:a", "recorded", "cpu")
    store.write(question.path, data)
    with pytest.raises(OutputError, match=r"recipe fog in scene a, is damaged: .*Delete it"):
        recorded(store, question)


def test_a_changed_choice_is_told(bench: Workbench, tmp_path: Path) -> None:
    store, recipe = open_store(tmp_path), open_recipe("max_flip: 0.5")
    question = Question(recipe, "a", "fake:a", "recorded", "cpu")
    scene = open_fake("fake:a")
    resolve_quality_once(
        store, question, lambda: resolve_quality(recipe, scene, renderer=bench.render)
    )
    document = json.loads(store.read(question.path))
    for path, value in (("render.scale", "1"), ("render.near_m", 1.0), ("render.scale", 77.0)):
        changed = json.loads(json.dumps(document))
        changed["choice"]["settings"][path] = value
        store.write(question.path, json.dumps(changed).encode())
        with pytest.raises(OutputError, match="is damaged"):
            recorded(store, question)
    document["asked"]["source"] = "fake:b"
    store.write(question.path, json.dumps(document).encode())
    with pytest.raises(OutputError, match="another question"):
        recorded(store, question)


def test_what_a_recipe_leaves_free_is_part_of_the_question() -> None:
    loose = open_recipe("max_flip: 0.5")
    tight = open_recipe("max_flip: 0.5", "render: {scale: 1}\n")
    assert loose.hash == tight.hash
    digests = {Question(r, "a", "fake:a", "recorded", "cpu").digest for r in (loose, tight)}
    assert len(digests) == 2


def _choose_slowly(folder: str, scale: float, answers) -> None:
    recipe = open_recipe("max_flip: 0.5")

    def choose() -> Resolved:
        time.sleep(0.2)
        settings: Settings = {knob.path: knob.reference for knob in free_knobs(recipe)}
        settings["render.scale"] = scale
        return Resolved(resolved_recipe(recipe, settings), Report(settings, True, 0.0, (), ()))

    question = Question(recipe, "a", "fake:a", "recorded", "cpu")
    answers.put(resolve_quality_once(open_store(folder), question, choose).render.scale)


def test_two_processes_agree(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    scales = (0.25, 0.5)
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


def test_a_plan_alone_chooses_and_keeps_nothing(bench: Workbench, tmp_path: Path) -> None:
    recipes = make_recipes(["slow"], texts={"slow": f"quality: {{max_flip: 0.5}}\n{PLAIN}"})
    job = make_job(tmp_path / "out", ["fake:a?frames=1"], recipes, renderer=bench.render)
    (block,) = plan_job(job, progress=False).blocks
    assert block.recipe.quality.settled and not (tmp_path / "out").exists()


def test_a_scene_in_which_nothing_can_be_chosen_is_told(bench: Workbench, tmp_path: Path) -> None:
    def render(scene, camera, recipe, *, backend: str) -> FakeView:
        if scene.name == "b":
            raise SceneError("it has no road")
        return bench.render(scene, camera, recipe, backend=backend)

    recipes = make_recipes(["slow"], texts={"slow": f"quality: {{max_flip: 0.5}}\n{PLAIN}"})
    scenes = ["fake:a?frames=2", "fake:b?frames=2"]
    result = run_generate(make_job(tmp_path, scenes, recipes, renderer=render), progress=False)
    assert result.written == 4
    why = "recipe slow, variant 0: quality max_flip 0.5 cannot choose its settings: it has no road"
    assert result.unusable == {"fake:b?frames=2": why}


def test_rows_from_before_qualities_have_none(bench: Workbench, tmp_path: Path) -> None:
    recipe = open_recipe("max_flip: 0.5")
    job = RenderJob("fake:street", [recipe], tmp_path)
    run_job(job, scene_loader=open_fake, renderer=bench.render, progress=False)
    path = tmp_path / "manifest.parquet"
    columns = ["quality", "render_scale", "settings"]
    pq.write_table(pq.read_table(path).drop_columns(columns), path)
    table = read_manifest(tmp_path)
    assert table.select(columns).to_pylist() == [dict.fromkeys(columns)] * 8
    at = table.column_names.index("style_method")
    assert table.column_names[at + 1 : at + 4] == columns


def test_small_pictures_are_enlarged_and_depths_are_not_mixed() -> None:
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[:, 1] = 200
    assert upsampled(picture, 2, 2) is picture
    wide = upsampled(picture, 4, 2)
    assert wide[0, :, 0].tolist() == [0, 50, 150, 200]
    assert upsampled(wide, 2, 2)[0, :, 0].tolist() == [25, 175]  # means over areas
    scene = open_fake("fake:a")

    def render(scene, camera, recipe, *, backend: str) -> FakeView:
        return FakeView(picture, np.array([[1, 9], [1, 9]], np.float32))

    trial = render_trial(
        scene, make_camera("front", 0, 0.0), Recipe(), renderer=render, size=(4, 4)
    )
    assert trial.depth is not None and trial.depth[3].tolist() == [1, 1, 9, 9]
