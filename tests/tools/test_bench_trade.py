"""The benchmark of knobs on a street small enough to be quick; parts whose answer is known."""

import json
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.jobs.quality import Trial
from recipes.schema import knobs_of
from tests.streets import SMALL_STREET, open_street
from tools import bench_trade, trade_cases, trade_measure
from tools.trade_cases import (
    CLEAN,
    DEFAULTS,
    DEPTH,
    JPEG,
    REFERENCE,
    TRUTH,
    WHOLE,
    TradeCase,
    View,
    settings_of_trade,
    trade_recipe,
)
from tools.trade_errors import PictureErrors, Standard, depth_figures, flicker, picture_figures
from tools.trade_plots import FLOOR, cropped, draw_trade, pareto
from tools.trade_text import trade_markdown, trade_text

TINY = TradeCase(width=64, repeats=1, depths=("none", "median"), memory=False)
SOME = ("render.scale", "weather.flood.fresnel", DEPTH, JPEG)


@pytest.fixture(scope="module")
def trade():
    def some_knobs(recipe):
        return tuple(knob for knob in knobs_of(recipe) if knob.path in SOME)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_trade, "open_scene", open_street)
        patch.setattr(trade_cases, "knobs_of", some_knobs)
        return bench_trade.bench_trade(SMALL_STREET, ["flood"], TINY, progress=False)


@pytest.fixture(scope="module")
def rows(trade):
    return {(row["knob"], row["value"]): row for row in bench_trade.table_of(trade.figures)}


def test_figures_are_json_and_have_a_row_for_every_value(trade, rows):
    assert json.loads(json.dumps(trade.figures, allow_nan=False)) is not None
    assert len(rows) == len(bench_trade.table_of(trade.figures))
    wanted = [("render.scale", value) for value in (0.25, 0.5, 0.75)]
    wanted += [("weather.flood.fresnel", "schlick"), (DEPTH, "none"), (DEPTH, "median")]
    wanted += [(WHOLE, name) for name in (REFERENCE, DEFAULTS, "draft", "balanced")]
    wanted += [(JPEG, quality) for quality in ("png", 60, 75, 92, 100)]
    assert set(wanted) <= rows.keys()
    assert ("render.scale", 1.0) not in rows  # it is the reference


def test_errors_are_none_at_reference_and_grow_away_from_it(rows):
    best = rows[WHOLE, REFERENCE]
    assert (best["flip"], best["psnr"], best["ssim"], best["flicker"]) == (0, None, 1, 0)
    assert (best["off_5cm"], best["abs_rel"]) == (0, 0)
    coarse, finer = rows["render.scale", 0.25], rows["render.scale", 0.75]
    assert coarse["flip"] > finer["flip"] > 0
    assert coarse["psnr"] < finer["psnr"]
    assert coarse["ssim"] < finer["ssim"] < 1
    assert coarse["off_5cm"] > finer["off_5cm"] > 0
    assert coarse["flicker"] > 0
    for row in rows.values():
        assert row["ms_min"] <= row["ms"] <= row["ms_p90"]
        assert row["worst_flip"] >= row["flip"]


def test_a_setting_that_is_reference_has_its_pictures(rows):
    assert rows[DEPTH, "median"]["flip"] == 0  # the recipe's own
    assert rows[DEPTH, "none"]["off_5cm"] is None


def test_estimators_are_compared_with_the_streets_surfaces(rows):
    assert rows[DEPTH, "median"]["depth_against"] == TRUTH
    assert 0.01 < rows[DEPTH, "median"]["abs_rel"] < 0.3  # a pixel of this picture is 15 of its own
    assert rows["render.scale", 0.5]["depth_against"] == REFERENCE


def test_files_shrink_with_quality(rows):
    sizes = [rows[JPEG, quality]["kilobytes"] for quality in (60, 75, 92, 100)]
    errors = [rows[JPEG, quality]["flip"] for quality in (60, 75, 92, 100)]
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)
    assert rows[JPEG, "png"]["flip"] == 0


def test_text_and_page_have_a_row_for_everything(trade, rows):
    for text in (trade_text(trade.figures), trade_markdown(trade.figures)):
        for _, value in rows:
            assert f" {value}" in text or f"\n{value}" in text


def test_pictures_of_chart_and_tiers(trade, tmp_path):
    paths = draw_trade(tmp_path, trade.figures, trade.pictures)
    assert [path.suffix for path in paths] == [".png", ".jpg"]
    assert all(path.stat().st_size > 1000 for path in paths)


def test_settings_differ_from_reference_in_one_knob():
    recipe = trade_recipe("all")
    best, *others = settings_of_trade(recipe, TINY)
    assert best.is_reference
    paths = [knob.path for knob in knobs_of(recipe) if not knob.path.startswith("output.")]
    assert {setting.knob for setting in others} == {*paths, WHOLE, DEPTH}
    for setting in others:
        if setting.knob != WHOLE and setting.knob != DEPTH:
            own = dict(flat(setting.recipe.model_dump()))
            good = dict(flat(best.recipe.model_dump()))
            assert [path for path in paths if own[path] != good[path]] == [setting.knob]


def flat(value, path=""):
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from flat(inner, f"{path}.{name}".lstrip("."))
    else:
        yield path, value


def test_recipes_by_name():
    assert trade_recipe(CLEAN).weather.flood is None
    assert trade_recipe("flood").weather.flood is not None
    assert trade_recipe("overcast").style.preset == "overcast"  # any preset
    everything = trade_recipe("all")
    assert None not in (everything.style, *dict(everything.weather).values())


def test_what_is_named_renders_and_its_memory_counts(monkeypatch):
    asked = []

    def render(scene, camera, recipe, backend):
        asked.append(backend)
        return Trial(np.zeros((2, 2, 3), np.uint8), None, 0.25)

    monkeypatch.setattr(trade_measure, "render_trial", render)
    monkeypatch.setattr(trade_measure, "gpu_mib", lambda: 10.0 + len(asked))
    monkeypatch.setattr(trade_measure, "peak_gpu_mib", lambda action: (action(), 7.0))
    (setting, *_) = settings_of_trade(trade_recipe(CLEAN), TINY)
    stage = trade_measure.Stage(open_street(), View(0, WALL), "cuda")
    timed = trade_measure.time_group(stage, [View(0, WALL)], [setting], 2)
    assert list(timed.seconds.values()) == [[0.25, 0.25]]
    assert trade_measure._memory(stage, View(0, WALL), setting) == {"mib": 7.0, "kept_mib": 1.0}
    assert set(asked) == {"cuda"}


# Flicker: a wall 10 m ahead, seen twice by a camera that stands still, so that nothing moves.
WALL = Camera("wall", 40, 30, 30.0, 30.0, 20.0, 15.0, torch.eye(4, dtype=torch.float64))


def standards():
    depth, alpha = np.full((30, 40), 10.0, np.float32), np.ones((30, 40), np.float32)
    everywhere, nowhere = alpha > 0, alpha < 0
    one = Standard(View(0, WALL), depth, alpha, everywhere, nowhere, nowhere)
    return one, one


def trials(*errors):
    """Trials of a grey picture and errors [H, W, 3] on it, and the grey pictures alone."""
    grey = np.full((30, 40, 3), 100, np.int16)
    own = [Trial((grey + error).astype(np.uint8), None, 0.0) for error in errors]
    return own, [Trial(grey.astype(np.uint8), None, 0.0) for _ in errors]


def test_error_that_stays_does_not_flicker():
    error = np.random.default_rng(0).integers(-20, 20, (30, 40, 3))
    assert flicker(*standards(), *trials(error, error)) == pytest.approx(0, abs=1e-12)
    assert flicker(*standards(), *trials(0 * error, 0 * error)) == 0


def test_error_drawn_anew_flickers_by_the_root_of_two():
    one, two = np.random.default_rng(0).integers(-20, 20, (2, 30, 40, 3))
    found = flicker(*standards(), *trials(one, two))
    expected = math.sqrt(2) * math.sqrt((one**2).mean()) / 255
    assert found == pytest.approx(expected, rel=0.05)  # of 3600 numbers, and the border is left out


def test_flicker_is_not_a_number_where_views_share_nothing():
    first, second = standards()
    far = Standard(second.view, second.first_m + 5, *list(vars(second).values())[2:])
    one, two = np.random.default_rng(0).integers(-20, 20, (2, 30, 40, 3))
    assert math.isnan(flicker(first, far, *trials(one, two)))


def test_depth_figures_of_a_known_case():
    right = np.array([[10.0, 10.0, 10.0, 10.0, 10.0]])
    own = np.array([[10.0, 10.04, 10.5, 0.0, 99.0]], np.float32)  # right, near, far off, none
    where = np.array([[True, True, True, True, False]])
    found = depth_figures([own], [right], [where])
    assert found["off_5cm"] == 0.5
    assert found["abs_rel"] == pytest.approx((0 + 0.004 + 0.05) / 3, rel=1e-5)
    assert depth_figures([None], [right], [where]) == {"abs_rel": None, "off_5cm": None}
    assert depth_figures([own], [right], [~where & False])["off_5cm"] is None


def test_picture_figures_pool_views():
    grey = np.full((24, 32, 3), 100, np.uint8)
    same, other = (
        PictureErrors.between(grey, grey),
        PictureErrors.between(grey + np.uint8(51), grey),
    )
    assert picture_figures([same])["psnr"] is None
    both = picture_figures([same, other])
    assert both["psnr"] == pytest.approx(-10 * math.log10(0.04 / 2))
    assert both["worst_flip"] == other.flip == 2 * both["flip"]


def test_pareto_front_is_what_nothing_beats():
    points = [(3.0, 0.0), (1.0, 0.5), (2.0, 0.6), (2.0, 0.2), (4.0, 0.0)]
    assert pareto(points) == [(1.0, 0.5), (2.0, 0.2), (3.0, 0.0)]
    assert pareto([]) == []
    assert FLOOR > 0


def test_crops_have_one_height():
    for shape in ((30, 64, 3), (540, 960, 3), (100, 20, 3)):
        assert cropped(np.zeros(shape, np.uint8)).shape[0] == 300


def test_truth_of_the_street_only():
    from tools.trade_errors import true_depths

    camera = open_street().frames[0].cameras["front"].scaled(0.02)
    (depth,) = true_depths(SMALL_STREET, [camera])
    assert true_depths("pandaset:folder", [camera]) is None
    assert depth.shape == (camera.height, camera.width)
    assert np.isinf(depth).any() and (depth > 0).all()
