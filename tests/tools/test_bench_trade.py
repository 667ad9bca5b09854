"""The benchmark of knobs on a street small enough to be quick; parts whose answer is known."""

import json
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.jobs.quality import Trial
from recipes.schema import knobs_of, settings_of
from tests.streets import SMALL_STREET, open_street
from tools.bench import trade as bench
from tools.bench.trade import (
    DEFAULTS,
    DEPTH,
    JPEG,
    REFERENCE,
    TRUTH,
    WHOLE,
    PictureErrors,
    Standard,
    TradeCase,
    depth_figures,
    flicker,
    picture_figures,
    printable,
    settings_of_trade,
    table_of,
    trade_recipe,
    true_depths,
)

TINY = TradeCase(width=64, repeats=1, depths=("none", "median"), memory=False)
SOME = ("render.scale", "weather.flood.fresnel", DEPTH, JPEG)


@pytest.fixture(scope="module")
def trade():
    def some_knobs(recipe):
        return tuple(knob for knob in knobs_of(recipe) if knob.path in SOME)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "open_scene", open_street)
        patch.setattr(bench, "knobs_of", some_knobs)
        return bench.bench_trade(SMALL_STREET, ["flood"], TINY)


@pytest.fixture(scope="module")
def rows(trade):
    return {(row["knob"], row["value"]): row for row in table_of(trade.figures)}


@pytest.mark.long
def test_every_value_has_a_row(trade, rows):
    assert json.loads(json.dumps(trade.figures, allow_nan=False)) is not None
    expected = [("render.scale", value) for value in (0.25, 0.5, 0.75)]
    expected += [("weather.flood.fresnel", "schlick"), (DEPTH, "none"), (DEPTH, "median")]
    expected += [(WHOLE, name) for name in (REFERENCE, DEFAULTS, "draft", "balanced")]
    expected += [(JPEG, quality) for quality in ("png", 60, 75, 92, 100)]
    assert set(expected) == set(rows)
    assert sum(len(table["rows"]) for table in printable(trade.figures)["tables"]) == len(rows)


@pytest.mark.long
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
    assert all(row["worst_flip"] >= row["flip"] for row in rows.values())
    assert rows[DEPTH, "median"]["flip"] == 0  # the recipe's own
    assert rows[DEPTH, "none"]["off_5cm"] is None


@pytest.mark.long
def test_estimators_are_compared_with_the_streets_surfaces(rows):
    assert rows[DEPTH, "median"]["depth_against"] == TRUTH
    assert 0.01 < rows[DEPTH, "median"]["abs_rel"] < 0.3  # a pixel of this picture is 15 of its own
    assert rows["render.scale", 0.5]["depth_against"] == REFERENCE
    camera = open_street().frames[0].cameras["front"].scaled(0.02)
    (depth,) = true_depths(SMALL_STREET, [camera])
    assert np.isinf(depth).any() and (depth > 0).all()
    assert true_depths("pandaset:folder", [camera]) is None


def test_settings_differ_from_reference_in_one_knob():
    recipe = trade_recipe("all")
    assert None not in (recipe.style, *dict(recipe.weather).values())
    best, *others = settings_of_trade(recipe, TINY)
    paths = [knob.path for knob in knobs_of(recipe) if not knob.path.startswith("output.")]
    assert {setting.knob for setting in others} == {*paths, WHOLE, DEPTH}
    good = settings_of(best.recipe)
    for setting in (each for each in others if each.knob in paths):
        own = settings_of(setting.recipe)
        assert [path for path in paths if own[path] != good[path]] == [setting.knob]


# Flicker: a wall 10 m ahead, seen twice by a camera that stands still, so that nothing moves.
WALL = Camera("wall", 40, 30, 30.0, 30.0, 20.0, 15.0, torch.eye(4, dtype=torch.float64))


def standard(depth_m=10.0):
    depth, alpha = np.full((30, 40), depth_m, np.float32), np.ones((30, 40), np.float32)
    return Standard(WALL, depth, alpha, alpha > 0)


def trials(*errors):
    """Trials of a grey picture and errors [H, W, 3] on it, and the grey pictures alone."""
    grey = np.full((30, 40, 3), 100, np.int16)
    own = [Trial((grey + error).astype(np.uint8), None, 0.0) for error in errors]
    return own, [Trial(grey.astype(np.uint8), None, 0.0) for _ in errors]


def test_flicker_is_what_changes_of_an_error():
    one, two = np.random.default_rng(0).integers(-20, 20, (2, 30, 40, 3))
    walls = (standard(), standard())
    assert flicker(walls, *trials(one, one)) == pytest.approx(0, abs=1e-12)
    assert flicker(walls, *trials(0 * one, 0 * one)) == 0
    # Drawn anew it is the root of two; of 3600 numbers, and the border is left out.
    expected = math.sqrt(2) * math.sqrt((one**2).mean()) / 255
    assert flicker(walls, *trials(one, two)) == pytest.approx(expected, rel=0.05)
    assert math.isnan(flicker((standard(), standard(15.0)), *trials(one, two)))


def test_depth_figures_of_a_known_case():
    right = np.array([[10.0, 10.0, 10.0, 10.0, 10.0]])
    own = np.array([[10.0, 10.04, 10.5, 0.0, 99.0]], np.float32)  # right, near, far off, none
    where = np.array([[True, True, True, True, False]])
    found = depth_figures([own], [right], [where])
    assert found["off_5cm"] == 0.5
    assert found["abs_rel"] == pytest.approx((0 + 0.004 + 0.05) / 3, rel=1e-5)
    assert depth_figures([None], [right], [where]) == {"abs_rel": None, "off_5cm": None}
    assert depth_figures([own], [right], [where & False])["off_5cm"] is None


def test_picture_figures_pool_views():
    grey = np.full((24, 32, 3), 100, np.uint8)
    pictures = (grey, grey + np.uint8(51))
    same, other = (PictureErrors.between(picture, grey) for picture in pictures)
    assert picture_figures([same])["psnr"] is None
    both = picture_figures([same, other])
    assert both["psnr"] == pytest.approx(-10 * math.log10(0.04 / 2))
    assert both["worst_flip"] == other.flip == 2 * both["flip"]
