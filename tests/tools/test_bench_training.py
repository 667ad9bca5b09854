"""The worked example of training, on walls and roads that are rendered and learnt in a second."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch

from augment.errors import OutputError
from augment.scene import Scene
from augment.semantics import SemanticClass
from tests.scenes import camera_ahead
from tests.snow_scenes import drive, sheet, wall
from tools import bench_commands, bench_training
from tools.training_case import QUICK, RECIPES, WHOLE, TrainingCase, draw
from tools.training_data import CLASSES, IGNORED, Views, generate, grouped, read_views
from tools.training_network import new_network
from tools.training_pictures import draw_training_pictures
from tools.training_run import REGIMES, class_weights, jittered, make_batch, make_schedule, rate_at
from tools.training_scores import confusion, intersection_over_union, spread, summarise
from tools.training_text import training_text

TINY = TrainingCase(
    train_scenes=("test:0",),
    test_scenes=("test:1",),
    frames=2,
    cameras=("ahead",),
    train_weather={"smog": 1},
    test_weather={"clean": ("clear",), "other": ("smog", "thick-smog")},
    steps=6,
    batch=2,
    seeds=(0, 1),
    widths=(8, 8),
)


def corridor(uri: str) -> Scene:
    """A grey road and a coloured wall ahead; 32x16 pixels."""
    number = int(uri.partition(":")[2])
    road = sheet((2, 9), (-4, 4), semantic=int(SemanticClass.ROAD))
    far = wall(9.0, (-6, 6), (0, 2 + number), rgb=(0.8, 0.2 + 0.3 * number, 0.1))
    classes = torch.full((len(far),), int(SemanticClass.BUILDING), dtype=torch.int16)
    scene = drive(road, dataclasses.replace(far, semantic=classes), ground_z_m=0.0)
    frames = tuple(
        dataclasses.replace(
            frame, cameras={"ahead": camera_ahead(32, 16, 16.0, position=(0.2 * n, 0.0, 1.5))}
        )
        for n, frame in enumerate(scene.frames)
    )
    return dataclasses.replace(scene, name=f"corridor-{number}", source=uri, frames=frames)


def never(uri: str) -> Scene:
    raise AssertionError(f"{uri} was opened though nothing is missing")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    assert generate(TINY, folder, scene_loader=corridor, progress=False).written == 2 * 2 + 3 * 2
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    return run(folder)


def run(folder, **options):
    return bench_training.bench_training(
        folder, TINY, scene_loader=never, progress=False, **options
    )


def some_views(count: int = 5, variants: int = 2) -> Views:
    """Images of noise whose labels are those of the clean one."""
    rng = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, 1 + variants, 3, 4, 6), generator=rng)
    labels = torch.randint(0, 8, (count, 1, 4, 6), generator=rng).expand(-1, 1 + variants, -1, -1)
    names = tuple(("scene", n, "ahead") for n in range(count))
    variant_names = (("clear-000", "smog-000", "snow-000")[: 1 + variants],) * count
    return Views(images.to(torch.uint8), labels.to(torch.uint8), names, variant_names)


def test_scores_are_those_counted_by_hand():
    # Four road pixels, of which three are found; two of sidewalk, of which one is called road and
    # one a car, where no car is; one that does not count.
    labels = torch.tensor([[0, 0, 0, 0, 1, 1, IGNORED]], dtype=torch.uint8)
    predicted = torch.tensor([[0, 0, 0, 1, 0, 2, 0]], dtype=torch.uint8)
    counts = confusion(labels, predicted, 4)
    assert counts.tolist() == [[3, 1, 0, 0], [1, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    iou = intersection_over_union(counts)
    assert iou[:2].tolist() == [3 / 5, 0.0]  # 3 of 4 true + 1 falsely called; none of 3
    assert np.isnan(iou[2:]).all()  # classes that no pixel is
    assert np.nanmean(intersection_over_union(confusion(labels, labels, 4))) == 1


def test_figures_over_seeds_are_those_of_each_seed():
    def found(*values):
        each = {
            name: {"miou": v, "iou": {"road": v}} for name, v in zip(names, values, strict=True)
        }
        return each

    names = TINY.conditions
    summary = summarise({"clean": [found(0.8, 0.6, 0.2), found(0.6, 0.4, 0.2)]}, TINY)["clean"]
    assert summary["conditions"]["clear"] == spread([0.8, 0.6])
    assert summary["groups"]["other"]["values"] == pytest.approx([0.4, 0.3])
    assert summary["classes"]["smog"]["road"]["mean"] == pytest.approx(0.5)
    assert spread([1.0, 3.0])["std"] == pytest.approx(np.std([1, 3], ddof=1))
    assert spread([1.0])["std"] is None


def test_classes_are_grouped():
    semantic = torch.arange(17, dtype=torch.uint8)
    names = list(CLASSES)
    found = grouped(semantic).tolist()
    assert names[found[int(SemanticClass.LANE_MARKING)]] == "road"
    assert names[found[int(SemanticClass.PEDESTRIAN)]] == "person"
    ignored = {int(c) for c in SemanticClass} - {int(c) for own in CLASSES.values() for c in own}
    assert [c for c in range(17) if found[c] == IGNORED] == sorted(ignored)
    assert SemanticClass.UNKNOWN in ignored and SemanticClass.SKY not in ignored


def test_regimes_see_the_same_views():
    views = some_views()
    schedule = make_schedule(5, 2, steps=10, batch=3, seed=4)
    assert np.bincount(schedule.views.ravel()).tolist() == [6] * 5  # every view as often
    assert set(schedule.weather.ravel()) == {0, 1, 2} and 0 < schedule.flipped.mean() < 1
    weathered = 0
    for step in range(10):
        batches = {regime: make_batch(views, schedule, step, regime) for regime in REGIMES}
        assert all(torch.equal(batches["clean"][1], labels) for _, labels in batches.values())
        for place in range(3):
            clean, shown = (batches[name][0][place] for name in ("clean", "weather"))
            which = int(schedule.weather[step, place])
            weathered += which > 0
            source = views.images[schedule.views[step, place], which].float() / 255
            assert torch.equal(shown, source.flip(-1) if schedule.flipped[step, place] else source)
            assert torch.equal(clean, shown) == (which == 0)
            assert not torch.equal(clean, batches["jitter"][0][place])
    assert 5 < weathered < 25  # about half of 30
    with pytest.raises(ValueError, match="regime must be one of"):
        make_batch(views, schedule, 0, "rain")


def test_jitter_of_ones_changes_nothing_and_none_leaves_the_range():
    images = some_views().images[:, 0].float() / 255
    assert torch.allclose(jittered(images, torch.ones(5, 3)), images, atol=1e-6)
    grey = jittered(images, torch.tensor([[1.0, 1.0, 0.0]]).expand(5, 3))
    assert torch.allclose(grey[:, 0], grey[:, 2], atol=1e-6)
    flat = jittered(images, torch.tensor([[1.0, 0.0, 1.0]]).expand(5, 3))
    assert float(flat[0].std()) < 1e-6
    wild = jittered(images, torch.full((5, 3), 3.0))
    assert float(wild.min()) >= 0 and float(wild.max()) <= 1


def test_rare_classes_weigh_more():
    labels = torch.zeros(1, 10, 10, dtype=torch.uint8)
    labels[0, 0, :4], labels[0, 1] = 1, IGNORED
    weights = class_weights(labels)
    assert weights[1] / weights[0] == pytest.approx((86 / 4) ** 0.5)
    assert (86 * weights[0] + 4 * weights[1]) / 90 == pytest.approx(1)
    assert weights[2:].tolist() == [0] * (len(CLASSES) - 2)


def test_the_rate_rises_and_falls_to_nothing():
    rates = [rate_at(step / 100) for step in range(101)]
    assert 0 < rates[0] < 0.2 and max(rates) == pytest.approx(1) and rates[-1] < 1e-9
    assert np.argmax(rates) == 10


def test_first_weights_are_the_seeds_alone():
    state = torch.get_rng_state()
    one, again, other = (new_network(3, (8, 8), seed).stem[0].weight for seed in (0, 0, 1))
    assert torch.equal(one, again) and not torch.equal(one, other)
    assert torch.equal(state, torch.get_rng_state())
    assert new_network(3, (8, 16), 0)(torch.rand(2, 3, 8, 12)).shape == (2, 3, 8, 12)


@pytest.mark.parametrize("case", [WHOLE, QUICK, TINY])
def test_no_scene_shares_a_draw_of_weather(case):
    every = [
        (recipe.name, recipe.variant)
        for uri in (*case.train_scenes, *case.test_scenes)
        for recipe in case.recipes_of(uri)
        if recipe.name in case.train_weather
    ]
    assert len(set(every)) == len(every) > 0
    assert not set(case.train_scenes) & set(case.test_scenes)
    assert set(case.conditions) <= set(RECIPES)
    new = {
        name
        for group in ("beyond the range", "unseen weather")
        for name in case.test_weather.get(group, ())
    }
    assert not new & set(case.train_weather)


def test_thick_smog_is_thicker_than_any_that_is_trained_on():
    densest = max(draw("smog", n).weather.smog.sigma_per_m for n in range(20))
    assert draw("thick-smog", 0).weather.smog.sigma_per_m > 1.9 * densest


def test_views_are_read_with_their_weather(folder):
    train, test = (read_views(folder, uris) for uris in (TINY.train_scenes, TINY.test_scenes))
    assert train.names == (("corridor-0", 0, "ahead"), ("corridor-0", 1, "ahead"))
    assert train.variants == (("clear-000", "smog-000"),) * 2
    assert test.variants == (("clear-000", "smog-001", "thick-smog-001"),) * 2
    assert test.images.shape == (2, 3, 3, 16, 32) and test.labels.shape == (2, 3, 16, 32)
    assert torch.equal(test.labels[:, 0], test.labels[:, 2])
    assert not torch.equal(test.images[:, 0], test.images[:, 2])
    seen = {list(CLASSES)[n] for n in test.labels.unique().tolist()}
    assert seen == {"road", "building", "sky"}


def test_views_without_their_clean_image_are_refused(tmp_path):
    # A case whose scene lacks a recipe cannot come from `generate`, but from another job.
    from augment.jobs.render_job import RenderJob, run_job

    run_job(RenderJob("test:0", [draw("smog", 0)], tmp_path), scene_loader=corridor, progress=False)
    with pytest.raises(OutputError, match="no image of clear-000"):
        read_views(tmp_path, ("test:0",))


def test_what_is_there_is_not_rendered_again(folder):
    again = generate(TINY, folder, scene_loader=never, progress=False)
    assert (again.written, again.found) == (0, 10)
    wider = dataclasses.replace(TINY, frames=3)
    with pytest.raises(AssertionError, match="test:0 was opened"):
        generate(wider, folder, scene_loader=never, progress=False)


def test_figures_are_json_and_those_of_every_run(folder, trained):
    figures = trained.figures
    assert json.loads(json.dumps(figures, allow_nan=False)) is not None
    assert figures["generated"]["written"] == 0
    assert [(r["regime"], r["seed"]) for r in figures["runs"]] == [
        (regime, seed) for seed in TINY.seeds for regime in REGIMES
    ]
    for run_figures in figures["runs"]:
        for score in run_figures["scores"].values():
            present = [value for value in score["iou"].values() if value is not None]
            assert len(present) == 3 and score["miou"] == pytest.approx(np.mean(present))
    assert not torch.are_deterministic_algorithms_enabled()
    before = torch.get_num_threads()
    again = run(folder, at_once=1).figures
    assert again["summary"] == figures["summary"]
    assert torch.get_num_threads() == before


def test_text_and_pictures_show_every_figure(trained, tmp_path):
    text = training_text(trained.figures)
    for condition in TINY.conditions:
        assert len(re.findall(rf"^\| {condition} \|", text, re.MULTILINE)) == len(REGIMES)
    assert "| clean: clear |" in text and "| **other, mean** |" in text
    mean = trained.figures["summary"]["weather"]["conditions"]["thick-smog"]["mean"]
    assert "| other: thick-smog |" in text and f" {100 * mean:.1f} (" in text
    paths = draw_training_pictures(tmp_path, trained)
    assert [path.name for path in paths] == ["training-scores.png", "training-samples.jpg"]
    assert all(path.stat().st_size > 1000 for path in paths)


def test_the_command_passes_on_what_it_is_told(monkeypatch, tmp_path, trained, capsys):
    seen = []

    def bench(folder, case):
        seen.append((folder, case))
        return trained

    monkeypatch.setattr(bench_training, "bench_training", bench)
    words = {"out": tmp_path / "data", "pictures": tmp_path, "json_file": tmp_path / "f.json"}
    assert bench_commands.training(quick=True, **words) == 0
    assert seen == [(tmp_path / "data", QUICK)]
    assert json.loads(words["json_file"].read_text())["summary"] == trained.figures["summary"]
    assert str(tmp_path / "training-scores.png") in capsys.readouterr().out
