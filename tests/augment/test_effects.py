"""One more effect, in one file (tests/augment/dust.py), is found wherever effects are."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from augment import effects
from augment.dataset import WeatherDataset
from augment.effects.lidar.codes import ATTENUATED, CODE_COLUMN, LOST, UNCHANGED
from augment.jobs.render_job import RenderJob, run_job
from augment.output.manifest import read_manifest
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.errors import RecipeError
from recipes.json_schema import recipe_json_schema
from recipes.load import load_recipe
from recipes.schema import KNOBS, Recipe
from tests.augment.dust import TINT, DustEffect
from tests.streets import LABELLED_STREET, open_street
from tools.explain import explain_recipe, explanation_text
from tools.report import write_report

URI = LABELLED_STREET
HALF_M = 25.0
TEXT = f"""weather: {{dust: {{half_m: {HALF_M}, color: [1, 0, 0]}}}}
output: {{lidar: weather, instance: true}}
"""


@pytest.fixture(scope="module", autouse=True)
def dust():
    effects.add_effect(DustEffect())
    yield
    effects.remove_effect("dust")


@pytest.fixture(scope="module")
def recipe_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "dusty.yaml"
    path.write_text(f"version: 1\n{TEXT}")
    return path


@pytest.fixture(scope="module")
def job(tmp_path_factory, recipe_file):
    """Output folder of one frame of one camera."""
    out = tmp_path_factory.mktemp("dusty")
    recipes = [load_recipe(str(recipe_file)).resolve(0)]
    run_job(
        RenderJob(URI, recipes, out, frames=[0], cameras=["front"], workers=1),
        scene_loader=open_street,
        progress=False,
    )
    return out


def test_recipes_speak_of_it(recipe_file, tmp_path):
    recipe = load_recipe(str(recipe_file)).resolve(0)
    assert recipe.weather.dust.half_m == HALF_M
    assert "weather.dust.distance" in KNOBS
    assert "half_m" in json.dumps(recipe_json_schema())
    assert recipe.hash != Recipe().hash
    path = tmp_path / "ranges.yaml"
    path.write_text("version: 1\nvariants: 4\nweather: {dust: {half_m: {uniform: [20, 40]}}}\n")
    drawn = {load_recipe(str(path)).resolve(n).weather.dust.half_m for n in range(4)}
    assert len(drawn) == 4 and all(20 <= half_m <= 40 for half_m in drawn)
    path.write_text("version: 1\nweather: {dust: {half: 3}}\n")
    with pytest.raises(RecipeError, match="half_m"):
        load_recipe(str(path)).resolve(0)


def test_a_recipe_without_it_has_the_hash_it_had():
    with_dust = Recipe().hash
    effects.remove_effect("dust")
    try:
        assert Recipe().hash == with_dust
        with pytest.raises(ValueError, match="dust"):
            Recipe.model_validate({"weather": {"dust": {"half_m": 3}}})
    finally:
        effects.add_effect(DustEffect())


def test_plans_name_its_passes(recipe_file):
    scene = open_street(URI)
    plan = make_plan(load_recipe(str(recipe_file)).resolve(0), scene)
    assert "expected_depth" in plan.buffers
    assert [s.runs for s in plan.steps if s.name == TINT] == [True]
    assert [s.runs for s in make_plan(Recipe(), scene).steps if s.name == TINT] == [False]


@pytest.mark.long
def test_explanations_name_its_passes(recipe_file):
    page = explanation_text(explain_recipe(str(recipe_file), URI, times=False))
    assert f"dust.half_m = {HALF_M}" in page and f"runs   {TINT}" in page


def test_pictures_are_tinted_with_the_distance(recipe_file):
    scene, dusty = open_street(URI), load_recipe(str(recipe_file)).resolve(0)
    camera = scene.frames[0].cameras["front"]
    clear = render_view(scene, camera, dusty.model_copy(update={"weather": Recipe().weather}))
    view = render_view(scene, camera, dusty)
    sky = view.depth_m == 0
    assert sky.any() and (view.rgb[sky] == [255, 0, 0]).all()
    near = (view.depth_m > 0) & (view.depth_m < HALF_M / 4)
    assert (view.masks["dust"][sky] == 255).all() and not view.masks["dust"][near].any()
    green = view.rgb[..., 1] / np.maximum(clear.rgb[..., 1], 1.0)  # the dust has none
    lengths = scene.frames[0].cameras["front"].ray_lengths().numpy()
    expected = np.exp2(-view.depth_m * lengths / HALF_M)
    assert np.median(np.abs(green - expected)[~sky]) < 0.02  # of 8-bit colours


def test_jobs_datasets_and_reports_have_its_columns_masks_and_labels(job, tmp_path):
    rows = read_manifest(job)
    assert rows["dust_half_m"].to_pylist() == [HALF_M]
    assert rows["dust_path"][0].as_py().endswith("dust/front/000000.png")
    (sample,) = list(WeatherDataset(job))
    assert sample["dust"].any() and not sample["dust"].all()
    assert sample["weather"]["dust_half_m"] == HALF_M
    boxes = sample["boxes"]
    eye = sample["camera"]["world_from_camera"][:3, 3]
    away = (boxes["centers_m"] - eye).norm(dim=1)
    torch.testing.assert_close(boxes["clear_fraction"], torch.exp2(-away / HALF_M))
    assert (boxes["visibility"] <= boxes["clear_fraction"] + 1e-9).all()
    assert sample["paths"]["box_dust"].endswith("labels/dust.parquet")
    page = write_report(job, tmp_path / "report.html").path.read_text()
    assert "dust 25 m" in page and "Dust mask" in page


def test_a_sweep_loses_light_to_it(job):
    (sample,) = list(WeatherDataset(job, load=["lidar"]))
    codes = sample["lidar"][CODE_COLUMN].numpy()
    assert set(np.unique(codes)) <= {UNCHANGED, ATTENUATED, LOST}
    assert (codes == ATTENUATED).mean() > 0.2
