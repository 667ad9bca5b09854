"""The worked example of training on weather: its images, its small network, and its scores."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from adapters.base import open_scene
from adapters.street.layout import StreetParameters
from augment.errors import OutputError
from augment.scene.semantics import SemanticClass
from tools.bench import training
from tools.bench.scene_images import street_uris
from tools.bench.segmentation import (
    IGNORED_LABEL,
    TrainingSettings,
    Views,
    class_weights,
    count_confusions,
    intersection_over_union,
    jitter_colors,
    make_batch,
    make_schedule,
    rate_at,
    score_network,
    train_network,
)
from tools.bench.training import (
    ARMS,
    CLASSES,
    CLEAR,
    CONDITIONS,
    DARK_HOURS,
    DAY_WEATHER,
    FULL_CASE,
    TrainingCase,
    class_indices,
    draw_recipe,
    measure,
    read_views,
    render_missing,
)

SETTINGS = TrainingSettings(
    steps=2, batch=2, learning_rate=4e-3, widths=(8, 16), num_classes=len(CLASSES)
)
STREET = StreetParameters(frames=1, width=48, height=32, gaussians=60_000)
TINY_CASE = TrainingCase(
    train_scenes=street_uris((0,), STREET),
    test_scenes=street_uris((100,), STREET),
    frames=1,
    cameras=("front",),
    draws=1,
    settings=SETTINGS,
    seeds=(0, 1),
)


def make_views(kinds=(CLEAR, "rain", "rain", "night"), num_views=5, size=(16, 24)):
    """Views whose images are of one grey: 10 times the view, and the place of the weather."""
    greys = 10 * torch.arange(num_views)[:, None] + torch.arange(len(kinds))
    images = greys[:, :, None, None, None].expand(-1, -1, 3, *size).to(torch.uint8)
    labels = torch.zeros(num_views, len(kinds), *size, dtype=torch.uint8)
    labels[..., size[1] // 2 :] = 1
    return Views(images.clone(), labels, tuple(kinds))


# ---- the case -----------------------------------------------------------------------------------


def test_every_draw_of_the_case_is_another_and_no_test_image_shows_a_learnt_draw():
    recipes = [
        (uri in FULL_CASE.train_scenes, recipe)
        for uri in (*FULL_CASE.train_scenes, *FULL_CASE.test_scenes)
        for recipe in FULL_CASE.recipes_of(uri)
        if recipe.name != CLEAR
    ]
    assert len({(recipe.name, recipe.variant) for _, recipe in recipes}) == len(recipes)
    learnt = {recipe.name for is_learnt, recipe in recipes if is_learnt}
    tested = {recipe.name for is_learnt, recipe in recipes if not is_learnt}
    assert learnt == {*DAY_WEATHER, *DARK_HOURS} and tested == {*CONDITIONS} - {CLEAR}


def test_only_the_last_arm_learns_night_and_none_learns_the_style_of_night():
    learnt = {name: {*arm.kinds} for name, arm in ARMS.items()}
    assert not learnt["clean"] and not learnt["jitter"] and ARMS["jitter"].is_jittered
    assert not learnt["weather"] & {*DARK_HOURS}
    assert learnt["night"] == learnt["weather"] | {*DARK_HOURS}
    assert not any("night-style" in kinds for kinds in learnt.values())


def test_recipes_of_dark_hours_have_lamps_and_those_by_day_do_not():
    for kind in CONDITIONS:
        light = draw_recipe(kind, 0).light
        assert (light is not None and light.time != "day") == (kind in DARK_HOURS), kind


def test_classes_are_those_of_the_scene_and_weather_neither_teaches_nor_counts():
    semantic = torch.tensor([[member.value for member in SemanticClass]])
    indices = class_indices(semantic)[0]
    names = {
        member.name: [*CLASSES, None][min(index, len(CLASSES))]
        for member, index in zip(SemanticClass, indices.tolist(), strict=True)
    }
    assert names["LANE_MARKING"] == "road" and names["TWO_WHEELER"] == "vehicle"
    assert {names["WATER"], names["SNOW"], names["UNKNOWN"], names["OTHER"]} == {None}


# ---- a small run --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """The folder and the figures of a tiny run, and the streets that it opened."""
    folder = tmp_path_factory.mktemp("training") / "images"
    opened_uris = []

    def load_scene(uri):
        opened_uris.append(uri)
        return open_scene(uri)

    return folder, measure(folder=folder, case=TINY_CASE, scene_loader=load_scene), opened_uris


def refuse_scene(uri):
    """A scene loader for runs that have all images."""
    raise AssertionError(f"{uri} was opened again")


@pytest.mark.long
def test_a_second_run_renders_nothing_and_gives_the_same_scores(tiny_run):
    folder, first, opened_uris = tiny_run
    assert opened_uris == [*TINY_CASE.test_scenes, *TINY_CASE.train_scenes]
    second = measure(folder=folder, case=TINY_CASE, scene_loader=refuse_scene)
    assert second["tables"][:-1] == first["tables"][:-1]
    assert second["facts"] == first["facts"]
    images, num_rendered, *_ = first["tables"][-1]["rows"][0]
    assert images == num_rendered == 10 + 15 and second["tables"][-1]["rows"][0][1] == 0


@pytest.mark.long
def test_the_table_has_a_row_for_every_condition_and_a_column_for_every_arm(tiny_run):
    assert json.loads(json.dumps(tiny_run[1], allow_nan=False)) == tiny_run[1]
    table = tiny_run[1]["tables"][0]
    assert table["columns"] == ["tested on", *(arm.title for arm in ARMS.values())]
    assert [row[0].split(";")[0] for row in table["rows"]] == [
        condition.title for condition in CONDITIONS.values()
    ]
    iou = tiny_run[1]["facts"]["iou"]
    assert {len(runs[kind]) for runs in iou.values() for kind in CONDITIONS} == {2}


@pytest.mark.long
def test_the_sky_is_dark_at_night_and_labels_are_those_of_the_day(tiny_run):
    views = read_views(TINY_CASE, tiny_run[0], TINY_CASE.test_scenes)
    night = views.kinds.index("night")
    greys = views.images.float().mean(2)
    is_sky = views.labels[:, 0] == [*CLASSES].index("sky")
    assert is_sky.any() and greys[:, night][is_sky].mean() < 0.3 * greys[:, 0][is_sky].mean()
    assert torch.equal(views.labels[:, night], views.labels[:, 0])


@pytest.mark.long
def test_an_interrupted_rendering_is_completed_and_a_missing_image_is_named(tiny_run, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(tiny_run[0], folder)
    (uri,) = TINY_CASE.test_scenes
    variant = "night-100"
    for image in folder.glob(f"*/{variant}/**/*.png"):
        image.unlink()
    manifest = pq.read_table(folder / "manifest.parquet")
    is_intact = [name != variant for name in manifest["variant"].to_pylist()]
    pq.write_table(manifest.filter(is_intact), folder / "manifest.parquet")
    with pytest.raises(OutputError, match=f"lacks an image of .*{variant}"):
        read_views(TINY_CASE, folder, [uri])
    assert render_missing(TINY_CASE, folder) == 1
    assert len(read_views(TINY_CASE, folder, [uri])) == 1


# ---- training -----------------------------------------------------------------------------------


def test_a_schedule_shows_every_view_once_before_any_comes_again():
    settings = dataclasses.replace(SETTINGS, steps=6, batch=5)
    schedule = make_schedule(10, settings, seed=3)
    for first in range(0, 30, 10):
        assert sorted(schedule.views.ravel()[first : first + 10]) == [*range(10)]
    assert (make_schedule(10, settings, seed=4).views != schedule.views).any()
    assert (make_schedule(10, settings, seed=3).draws == schedule.draws).all()


def test_half_of_an_arms_images_show_its_weather_and_no_other():
    settings = dataclasses.replace(SETTINGS, steps=100, batch=8)
    views = make_views()
    schedule = make_schedule(len(views), settings, seed=0)

    def places_of(kinds):
        batches = [
            make_batch(views, schedule, step, kinds=kinds, is_jittered=False)[0]
            for step in range(settings.steps)
        ]
        return (torch.cat(batches)[:, 0, 0, 0] * 255).round().long() % 10

    assert (places_of(()) == 0).all()
    rain = places_of(("rain",)).bincount(minlength=4) / 800
    both = places_of(("rain", "night")).bincount(minlength=4) / 800
    # 800 draws: a share of a half has a standard deviation of 0.018, one of a sixth 0.013.
    assert rain[3] == 0 and rain[0] == both[0] == pytest.approx(0.5, abs=0.06)
    assert both[1:].tolist() == pytest.approx([1 / 6] * 3, abs=0.05)


def test_flips_turn_images_and_labels_alike():
    views = make_views()
    views.images[:] = views.labels[:, :, None]
    settings = dataclasses.replace(SETTINGS, steps=1, batch=40)
    schedule = make_schedule(len(views), settings, seed=0)
    images, labels = make_batch(views, schedule, 0, kinds=(), is_jittered=False)
    assert torch.equal((images[:, 0, 0] * 255).round().long(), labels[:, 0])
    assert 0 < schedule.is_flipped.mean() < 1


def test_jitter_of_ones_changes_nothing_and_each_factor_does_its_part():
    images = torch.rand(2, 3, 4, 5, generator=torch.Generator().manual_seed(0)) * 0.4 + 0.2
    ones = torch.ones(2, 3)
    # Two float32 sums and products of values below 1.
    assert torch.allclose(jitter_colors(images, ones), images, atol=1e-6)
    brighter = jitter_colors(images, torch.tensor([[1.5, 1, 1]] * 2))
    assert torch.allclose(brighter, images * 1.5, atol=1e-6)
    grey = jitter_colors(images, torch.tensor([[1.0, 1, 0]] * 2))
    assert torch.allclose(grey[:, 0], grey[:, 2], atol=1e-6)


def test_weights_of_classes_go_with_the_root_of_their_share_and_have_mean_one():
    labels = torch.tensor([0] * 9 + [1] + [IGNORED_LABEL] * 5)
    weights = class_weights(labels, 3)
    assert weights[1] / weights[0] == pytest.approx(3) and weights[2] == 0
    assert 0.9 * weights[0] + 0.1 * weights[1] == pytest.approx(1)


def test_the_learning_rate_rises_then_falls_to_nothing():
    rates = [rate_at(step / 100) for step in range(101)]
    assert 0 < rates[0] < 0.1 and max(rates) == 1 and rates[-1] == pytest.approx(0)
    assert rates[:11] == sorted(rates[:11]) and rates[10:] == sorted(rates[10:], reverse=True)


def test_a_network_learns_two_halves_and_the_same_seed_gives_the_same_bits():
    views = make_views()
    views.images[..., 12:] += 100
    settings = dataclasses.replace(SETTINGS, steps=80, batch=4, num_classes=2)
    arguments = {"kinds": ("rain",), "is_jittered": True, "seed": 1}
    network, losses = train_network(views, settings, **arguments)
    again, _ = train_network(views, settings, **arguments)
    assert losses[-1] < 0.5 * losses[0]
    scores = score_network(network, views, 2)
    assert scores[CLEAR].min() > 0.8 and scores.keys() == {CLEAR, "rain", "night"}
    for first, second in zip(network.parameters(), again.parameters(), strict=True):
        assert torch.equal(first, second)


def test_iou_of_a_known_case():
    labels = torch.tensor([0, 0, 0, 1, 1, IGNORED_LABEL])
    predicted = torch.tensor([0, 0, 1, 1, 2, 0])
    iou = intersection_over_union(count_confusions(labels, predicted, 3))
    assert iou[:2].tolist() == pytest.approx([2 / 3, 1 / 3]) and np.isnan(iou[2])


def test_a_spread_is_in_percent_and_empty_for_a_class_that_no_image_shows():
    assert training.spread_text([0.2, 0.3, 0.4]) == "30.0 (20.0 to 40.0)"
    assert not training.spread_text([float("nan")] * 2)
