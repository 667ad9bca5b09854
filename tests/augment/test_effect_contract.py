"""One contract for every effect: pictures, passes, masks, tables and sweeps, on each backend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from augment import effects
from augment.dataset import WeatherDataset
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.jobs.render_job import RenderJob, run_job
from augment.output.manifest import read_manifest
from augment.render.buffers import CPU, REFERENCE
from augment.timing import stopwatch
from augment.view.plan import make_plan, plan_view
from augment.view.render_view import render_view
from recipes.schema import Recipe
from tests.augment.batch_scenes import tree_digest
from tests.streets import LABELLED_STREET, open_fast_street

DOWNPOUR = {"rate_mm_h": 50.0, "wetness": 0.0, "spray": False}
# Recipes in which each effect can be seen, and recipes in which it has no strength.
STRONG = {
    "style": {"style": {"preset": "dusk"}},
    "wet": {"weather": {"rain": {"rate_mm_h": 20.0, "spray": False}}},
    "smog": {"weather": {"smog": {"visibility_m": 60.0, "scatter": 0.3, "blend": "linear"}}},
    "snow": {"weather": {"snow": {"depth_m": 0.1, "cell_m": 0.2, "traffic": 0.9, "dirt": 0.7}}},
    "flood": {"weather": {"flood": {"level_m": 0.2}}},
    "spray": {"weather": {"rain": {"rate_mm_h": 50.0, "spray": True}}},
    "rain": {"weather": {"rain": DOWNPOUR}},
    "snowfall": {"weather": {"snowfall": {"rate_mm_h": 5.0}}},
    "lamps": {"light": {"time": "night"}},
    "lens_drops": {"camera": {"lens_drops": {"count": 60}}},
}
WEAK = {
    "style": {"style": {"preset": "dusk", "strength": 0.0}},
    "wet": {"weather": {"rain": {"rate_mm_h": 0.0, "wetness": 0.0}}},
    "smog": {"weather": {"smog": {"extinction_per_m": 0.0}}},
    "snow": {"weather": {"snow": {"depth_m": 0.0, "cell_m": 0.2}}},
    "flood": {"weather": {"flood": {"level_m": -50.0}}},
    "spray": {"weather": {"rain": {"rate_mm_h": 0.0, "wetness": 0.0, "spray": True}}},
    "rain": {"weather": {"rain": {**DOWNPOUR, "rate_mm_h": 0.0}}},
    "snowfall": {"weather": {"snowfall": {"rate_mm_h": 0.0}}},
    "lamps": {"light": {"time": "day", "vehicles": "off", "own_beams": "off"}},
    "lens_drops": {"camera": {"lens_drops": {"count": 0}}},
}
# The recipes without the effect, where another effect shares its section.
WITHOUT = {
    "wet": {"weather": {"rain": {"rate_mm_h": 20.0, "spray": False, "wetness": 0.0}}},
    "spray": {"weather": {"rain": {"rate_mm_h": 50.0, "spray": False}}},
}
NAMES = [effect.name for effect in effects.EFFECTS]
# Passes whose work is part of others: the sky is sampled while water is composited, and the image
# of depth is made from the buffers.
PARTS_OF_OTHERS = {"sky", "depth image"}
MAX_LEVELS = 1  # of 255 between two backends: they round in other orders


def recipe_of(sections: dict, name: str = "clear") -> Recipe:
    output = {"lidar": "weather", "instance": True}
    return Recipe.model_validate({"name": name, "output": output, **sections})


@pytest.fixture(scope="module")
def street():
    return open_fast_street()


@pytest.fixture(scope="module")
def camera(street):
    return street.frames[0].cameras["front"]


def run_all(folder: Path, workers: int) -> Path:
    """Render one view in each strong recipe and in none."""
    recipes = [recipe_of({}), *(recipe_of(STRONG[name], name) for name in NAMES)]
    job = RenderJob(
        LABELLED_STREET, recipes, folder, frames=[0], cameras=["front"], workers=workers
    )
    run_job(job, scene_loader=open_fast_street, progress=False)
    return folder


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    return run_all(tmp_path_factory.mktemp("effects"), workers=1)


@pytest.fixture(scope="module")
def samples(output):
    """The sample of each recipe, by the recipe's name."""
    dataset = WeatherDataset(output, load=["image", "boxes", "lidar", *mask_names()])
    return {sample["variant"]: sample for sample in dataset}


def mask_names() -> list[str]:
    return [effect.mask_name for effect in effects.EFFECTS if effect.mask_name is not None]


def test_every_effect_is_in_the_contract():
    assert NAMES == list(STRONG) == list(WEAK)


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_without_strength_changes_no_bit(street, camera, name):
    clear = render_view(street, camera, recipe_of({}))
    view = render_view(street, camera, recipe_of(WEAK[name]))
    for image in ("rgb", "depth_m", "semantic", "instance"):
        assert np.array_equal(getattr(view, image), getattr(clear, image)), image
    assert not any(mask.any() for mask in view.masks.values())


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_shows_runs_the_passes_of_its_plan_and_is_the_same_on_each_backend(
    street, camera, name
):
    recipe = recipe_of(STRONG[name])
    with stopwatch() as seconds:
        view = render_view(street, camera, recipe, backend=CPU)
    without = render_view(street, camera, recipe_of(WITHOUT.get(name, {})), backend=CPU)
    assert (view.rgb != without.rgb).any(-1).mean() > 0.001
    for mask in view.masks.values():
        assert mask.dtype == np.uint8 and set(np.unique(mask)) <= {0, 255}

    steps = plan_view(make_plan(recipe, street), street, camera).steps
    in_rasteriser = {step for effect in effects.EFFECTS for step in effect.off_switches}
    passes = {step.name: step.runs for step in steps if step.name not in in_rasteriser}
    timed_passes = {step for step, runs in passes.items() if runs} - PARTS_OF_OTHERS
    assert timed_passes - seconds.keys() == set()
    assert {step for step, runs in passes.items() if not runs} & seconds.keys() == set()

    by_definition = render_view(street, camera, recipe, backend=REFERENCE)
    levels = view.rgb.astype(int) - by_definition.rgb.astype(int)
    assert np.abs(levels).max() <= MAX_LEVELS
    for mask_name, mask in view.masks.items():
        assert (mask == by_definition.masks[mask_name]).mean() > 0.999


@pytest.mark.parametrize("name", NAMES)
def test_masks_tables_and_sweeps_of_a_job_read_back(output, samples, name):
    effect = next(effect for effect in effects.EFFECTS if effect.name == name)
    sample = samples[f"{name}-000"]
    (row,) = [row for row in read_manifest(output).to_pylist() if row["recipe"] == name]
    if effect.mask_name is not None:
        share = float(sample[effect.mask_name].float().mean())
        assert 0 < share < 1
        if effect.share_column is not None:
            assert row[effect.share_column] == pytest.approx(share)
    if effect.box_table is not None:
        boxes = sample["boxes"]
        for column in effect.box_table.sample_columns:
            assert len(boxes[column]) == len(boxes["centers_m"])
    num_returns = len(samples["clear-000"]["lidar"]["points_m"])
    sweep = sample["lidar"]
    assert all(len(column) == num_returns for column in sweep.values())
    assert np.array_equal(sweep[INDEX_COLUMN], np.arange(num_returns))


@pytest.mark.long
def test_two_workers_write_the_bytes_of_one(output, tmp_path):
    assert tree_digest(run_all(tmp_path, workers=2)) == tree_digest(output)
