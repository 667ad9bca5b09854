"""The page of a plan: reasons, shares that were measured, views that need a pass."""

from __future__ import annotations

import dataclasses

import numba
import pytest

from augment.errors import ClimateGSError
from augment.scene import Scene
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from recipes.style import Style
from tests.snow_scenes import box_car, drive, sheet
from tools import explain
from tools.explain import (
    explain_recipe,
    explanation_text,
    measure_passes,
    sample_views,
    without_folded,
)
from tools.output import compiling_noted


@pytest.fixture(scope="module")
def scene() -> Scene:
    road = sheet((-2.0, 24.0), (-4.0, 4.0), semantic=1)
    return drive(road, actors=[box_car(start=(8.0, -2.0), size=(3.0, 1.8, 1.0))])


def explained(monkeypatch, tmp_path, scene: Scene, recipe: str, **options):
    path = tmp_path / "recipe.yaml"
    path.write_text(recipe)
    monkeypatch.setattr(explain, "open_scene", lambda uri: scene)
    facts = explain_recipe(str(path), "test:sheets", **options)
    return facts, explanation_text(facts)


def test_shares_of_a_frame_add_up(scene):
    times = measure_passes(Recipe(output=Output(depth="none", labels=False)), scene)
    assert times["views"] == 2 and times["frame_ms"] > 0
    assert times["folded"] == times["once_s"] == {}
    assert sum(times["share"].values()) == pytest.approx(1)
    assert {"rasterise", "sky", "view plan", "8 bits", "everything else"} <= set(times["share"])
    assert not any(name.startswith(("flood", "snow", "style")) for name in times["share"])


def test_what_runs_inside_the_rasteriser_is_measured_against_the_view_without_it(scene):
    weather = Weather(
        smog=Smog(visibility_m=50), snow=Snow(depth_m=0.1, cell_m=0.2, shading="per_pixel")
    )
    recipe = Recipe(style=Style(preset="dusk"), weather=weather)
    others = without_folded(recipe, scene)
    assert set(others) == {
        "style on the scene",
        "smog per Gaussian",
        "snow: placement and layer",
        "snow: light per pixel",
    }
    assert others["style on the scene"].style is None
    assert others["smog per Gaussian"].weather == weather.model_copy(update={"smog": None})
    plain = others["snow: light per pixel"].weather.snow
    assert plain is not None and plain.shading == "per_splat" and plain.depth_m == 0.1
    deferred = Recipe(weather=Weather(smog=Smog(visibility_m=50, model="deferred")))
    assert without_folded(deferred, scene) == {}


def test_times_are_on_the_page_only_where_they_were_measured(scene, monkeypatch, tmp_path):
    recipe = "weather: {smog: {visibility_m: 40}}\noutput: {depth: none, labels: false}\n"
    facts, page = explained(monkeypatch, tmp_path, scene, recipe)
    assert "smog per Gaussian" in facts["times"]["folded"]
    lines = {line[9:].split("  ")[0].strip(): line for line in page.splitlines()}
    assert "%" in lines["rasterise"] and "(" in lines["smog per Gaussian"]
    assert "%" not in lines["flood: bed"] and "2 views spread over" in page
    assert "actors can be in view in 2 of 2, 1.0 of 1 on average" in page
    monkeypatch.setattr(explain, "measure_passes", None)  # not called
    facts, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert facts["times"] is None and "%" not in page and "skips  flood: bed" in page


def test_without_times_no_snow_is_laid(scene, monkeypatch, tmp_path):
    recipe = "weather: {snow: {depth_m: 0.1}}\n"
    monkeypatch.setattr("augment.effects.snow.effect.snow_layers_of", None)  # not called
    facts, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert facts["views"]["snow"] is None and "snow can be" not in page


def test_a_variant_that_the_recipe_does_not_have_is_refused(monkeypatch, tmp_path, scene):
    recipe = "variants: 3\n"
    with pytest.raises(ClimateGSError, match="--variant 3: recipe has 3 variants, 0 to 2"):
        explained(monkeypatch, tmp_path, scene, recipe, variant=3, times=False)
    facts, _ = explained(monkeypatch, tmp_path, scene, recipe, variant=2, times=False)
    assert facts["recipe"]["variant"] == 2


def test_compiling_is_said_before_it_is_done(capsys):
    @numba.njit
    def doubled(x):
        return 2 * x

    for said in (
        ["compiling kernels (once; kept for the next run) ...", "compiled the kernels in"],
        [],
    ):
        with compiling_noted():
            doubled(2)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == len(said) and all(map(str.startswith, lines, said))


def test_a_scene_without_views_has_a_plan_all_the_same(scene, monkeypatch, tmp_path):
    facts, page = explained(monkeypatch, tmp_path, dataclasses.replace(scene, frames=()), "{}")
    assert facts["times"] is None and facts["views"]["count"] == 0 and "runs   rasterise" in page


def test_sampled_views_are_spread_over_frames_and_cameras(scene):
    [ahead] = scene.frames[0].cameras.values()
    names = ("a", "b", "c", "d")
    frames = tuple(
        dataclasses.replace(scene.frames[0], index=i, cameras={
            n: dataclasses.replace(ahead, name=n, timestamp_ns=i) for n in names})
        for i in range(8)
    )  # fmt: skip
    picked = sample_views(dataclasses.replace(scene, frames=frames), 4)
    assert [c.name for c in picked] == list(names)
    assert [c.timestamp_ns for c in picked] == [1, 3, 5, 7]


def test_settings_are_those_of_the_quality(monkeypatch, tmp_path, scene):
    facts, text = explained(monkeypatch, tmp_path, scene, "quality: reference\n", times=False)
    assert facts["settings"]["render.scale"] == 1 and "\nquality reference:\n" in text
    open_ = "quality: {max_flip: 0.1}\nrender: {scale: 0.5}\n"
    facts, text = explained(monkeypatch, tmp_path, scene, open_, times=False)
    assert facts["settings"]["render.scale"] == 0.5 and not facts["is_chosen"]
    assert "quality max_flip 0.1, chosen in view of the scene when a job starts" in text
    _, text = explained(monkeypatch, tmp_path, scene, "{}\n", times=False)
    assert "\nno quality is asked for:\n" in text
