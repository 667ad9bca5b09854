"""The benchmark of knobs on a street small enough to be quick; parts whose answer is known; the
rule that makes tiers of tables, and the package's tiers, tables and document agree with it.
"""

import json
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.jobs.quality import Trial
from recipes.schema import KNOBS, TIERS, knobs_of, settings_of
from tests.streets import SMALL_STREET, open_street
from tools.bench import trade as bench
from tools.bench.trade import (
    BOUNDS,
    DEFAULTS,
    DEPTH,
    DOCS,
    JPEG,
    PAGE,
    REFERENCE,
    SCENES,
    TRUTH,
    WHOLE,
    Standard,
    TradeCase,
    Unmeasured,
    depth_figures,
    document,
    draw_chart,
    flicker,
    measure_wholes,
    picture_figures,
    printable,
    read_tables,
    rows_of,
    settings_of_trade,
    settle,
    tier_from,
    tiers_from,
    trade_recipe,
    true_depths,
)

TINY = TradeCase(width=64, repeats=1, memory=False)
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
    return {(row["knob"], row["value"]): row for row in rows_of([trade.figures])}


@pytest.mark.long
def test_every_value_has_a_row(trade, rows):
    assert json.loads(json.dumps(trade.figures, allow_nan=False)) is not None
    expected = [("render.scale", value) for value in (0.25, 0.5, 0.75)]
    expected += [("weather.flood.fresnel", "schlick"), *((DEPTH, v) for v in KNOBS[DEPTH].values)]
    expected += [(WHOLE, name) for name in (REFERENCE, DEFAULTS, "draft", "balanced")]
    expected += [(JPEG, quality) for quality in ("png", 60, 75, 92, 100)]
    assert set(expected) == set(rows)
    assert sum(len(table["rows"]) for table in printable(trade.figures)["tables"]) == len(rows)
    assert set(trade.pictures["flood"]) == {REFERENCE, DEFAULTS, "draft", "balanced"}


@pytest.mark.long
def test_errors_are_none_at_reference_and_grow_away_from_it(rows):
    best = rows[WHOLE, REFERENCE]
    assert (best["flip"], best["psnr"], best["ssim"], best["flicker"]) == (0, None, 1, 0)
    assert (best["off_5cm"], best["abs_rel"], best["over_reference"]) == (0, 0, 1)
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
    (_, best), *others = settings_of_trade(recipe)
    paths = [knob.path for knob in knobs_of(recipe)]
    assert {row["knob"] for row, _ in others} == {*paths, WHOLE}
    good = settings_of(best)
    for row, setting in (each for each in others if each[0]["knob"] != WHOLE):
        own = settings_of(setting)
        moved = {path: own[path] for path in paths if own[path] != good[path]}
        assert moved == {row["knob"]: row["value"]} or row["value"] == good[DEPTH]


# ---- Errors whose answer is known ----------------------------------------------------------------

# A wall 10 m ahead, seen twice by a camera that stands still, so that nothing moves.
WALL = Camera("wall", 40, 30, 30.0, 30.0, 20.0, 15.0, torch.eye(4, dtype=torch.float64))
GREY = np.full((30, 40, 3), 100, np.uint8)


def standard(depth_m=10.0):
    depth, alpha = np.full((30, 40), depth_m, np.float32), np.ones((30, 40), np.float32)
    return Standard(WALL, Trial(GREY, None, 0.0), depth, alpha, alpha > 0)


def test_flicker_is_what_changes_of_an_error():
    errors = np.random.default_rng(0).integers(-20, 20, (2, 30, 40, 3))
    one, two = (GREY + errors).astype(np.uint8)
    walls = (standard(), standard())
    assert flicker(walls, (one, one)) == pytest.approx(0, abs=1e-12)
    assert flicker(walls, (GREY, GREY)) == 0
    # Drawn anew it is the root of two; of 3600 numbers, and the border is left out.
    expected = math.sqrt(2) * math.sqrt((errors[0] ** 2).mean()) / 255
    assert flicker(walls, (one, two)) == pytest.approx(expected, rel=0.05)
    assert math.isnan(flicker((standard(), standard(15.0)), (one, two)))


def test_depth_figures_of_a_known_case():
    right = np.array([[10.0, 10.0, 10.0, 10.0, 10.0]])
    own = np.array([[10.0, 10.04, 10.5, 0.0, 99.0]], np.float32)  # right, near, far off, none
    where = np.array([[True, True, True, True, False]])
    known = depth_figures([own], [right], [where])
    assert known["off_5cm"] == pytest.approx(0.5)
    assert known["abs_rel"] == pytest.approx((0 + 0.004 + 0.05) / 3, rel=1e-5)
    assert depth_figures([None], [right], [where]) == {"abs_rel": None, "off_5cm": None}
    assert depth_figures([own], [right], [where & False])["off_5cm"] is None
    assert depth_figures([0 * own], [right], [where])["off_5cm"] == 1


def test_picture_figures_pool_views():
    assert picture_figures([GREY], [GREY])["psnr"] is None
    other = picture_figures([GREY + np.uint8(51)], [GREY])
    both = picture_figures([GREY, GREY + np.uint8(51)], [GREY, GREY])
    assert both["psnr"] == pytest.approx(-10 * math.log10(0.04 / 2))
    assert both["worst_flip"] == other["flip"] == 2 * both["flip"]


# ---- The rule, in tables made up -----------------------------------------------------------------

STOP, CLIP = "render.transmittance_stop", "render.radius_clip_px"


def row(knob, value, over_reference, worst_flip, settings=None):
    figures = {"over_reference": over_reference, "worst_flip": worst_flip}
    given = {} if settings is None else {"settings": settings}
    return {"knob": knob, "value": value, **figures, **given}


def table(**recipes):
    entries = [{"recipe": name, "rows": rows} for name, rows in recipes.items()]
    return {"scene": "made up", "recipes": entries}


def whole(worst_flip, stop=1e-4, clip=0.0):
    return row(WHOLE, "some name", 0.5, worst_flip, {STOP: stop, CLIP: clip})


SINGLE = [
    row(STOP, 0.05, 0.80, 0.03),
    row(STOP, 0.01, 0.90, 0.01),
    row(STOP, 1e-3, 0.95, 0.001),
    row(CLIP, 2.0, 0.70, 0.04),
    row(CLIP, 1.0, 0.85, 0.015),
]
BOTH = [*SINGLE, whole(0.018, stop=0.01, clip=1.0)]
LESS = whole(0.018, stop=1e-3, clip=1.0)


@pytest.mark.parametrize(
    ("why", "tables", "tier"),
    [
        ("the fastest within the bound", table(clean=BOTH), {STOP: 0.01, CLIP: 1.0}),
        (
            "the worst recipe counts",
            table(clean=[*SINGLE, LESS], snow=[*SINGLE, LESS, row(STOP, 0.01, 0.90, 0.05)]),
            {STOP: 1e-3, CLIP: 1.0},
        ),
        (
            "what saves most comes first, and the others fit beside it",
            table(clean=[*SINGLE, whole(0.03, stop=0.01, clip=1.0), LESS]),
            {STOP: 1e-3, CLIP: 1.0},
        ),
        (
            "or do not",
            table(clean=[*SINGLE, *(whole(0.03, stop=stop, clip=1.0) for stop in (0.01, 1e-3))]),
            {CLIP: 1.0},
        ),
        (
            "a recipe with one of the knobs needs no rendering together",
            table(clean=BOTH, snow=[row for row in SINGLE if row["knob"] == STOP]),
            {STOP: 0.01, CLIP: 1.0},
        ),
        (
            "times of values that change nothing are noise",
            table(
                clean=[row(STOP, 0.05, 0.5, 0.0), row(CLIP, 2.0, 0.5, 0.0)],
                snow=[row(STOP, 0.05, 0.5, 0.0), row(CLIP, 2.0, 1.0, 0.01)],
            ),
            {},
        ),
        (
            "a value that saves nothing is never taken",
            table(
                clean=[
                    *(row(STOP, 0.05, 1.02, 0.001), row(STOP, 0.01, 0.99, 0.001)),
                    *(row(CLIP, 2.0, 0.5, 0.01), whole(0.01, clip=2.0)),
                ]
            ),
            {CLIP: 2.0},
        ),
        (
            "nor a slower one that errs more",
            table(clean=[row(STOP, 0.05, 0.9, 0.015), row(STOP, 0.01, 0.8, 0.01)]),
            {STOP: 0.01},
        ),
    ],
)
def test_the_rule(why, tables, tier):
    assert tier_from([tables], 0.02) == tier, why


def test_what_has_not_been_rendered_together_is_asked_for_and_added(monkeypatch):
    with pytest.raises(Unmeasured) as missing:
        tier_from([table(clean=SINGLE)], 0.02)
    (asked,) = missing.value.args
    moved = {path: value for path, value in asked.items() if value != KNOBS[path].reference}
    assert moved == {STOP: 0.01, CLIP: 1.0}

    def measured(uri, names, case, *, wholes):
        ((name, given),) = wholes.items()
        own = {path: given[path] for path in (STOP, CLIP)}
        rows = [row(WHOLE, REFERENCE, 1.0, 0.0, {}), row(WHOLE, name, 0.5, 0.005, own)]
        return bench.Trade(table(clean=rows), {})

    monkeypatch.setattr(bench, "bench_trade", measured)
    made_up = table(clean=[*SINGLE])
    tiers = settle([made_up], ["some:scene"], TINY)
    assert tiers == {"draft": {STOP: 0.05, CLIP: 2.0}, "balanced": {STOP: 0.01, CLIP: 1.0}}
    names = [r["value"] for r in made_up["recipes"][0]["rows"] if r["knob"] == WHOLE]
    assert names == ["candidate 1", "candidate 2"]
    measure_wholes(made_up, "some:scene", {"candidate 1": {STOP: 0.05, CLIP: 0.0}}, TINY)
    again = [r for r in made_up["recipes"][0]["rows"] if r["value"] == "candidate 1"]
    assert [r["settings"] for r in again] == [{STOP: 0.05, CLIP: 0.0}]


# ---- What is published ---------------------------------------------------------------------------

MAX_BYTES = 150_000


@pytest.fixture(scope="module")
def tables():
    return read_tables()


def test_tiers_are_what_the_rule_gives_for_the_published_tables(tables):
    assert {name: dict(settings) for name, settings in TIERS.items()} == tiers_from(tables)


def test_the_invisible_bound_is_below_a_good_jpegs_error(tables):
    files = [r["flip"] for r in rows_of(tables) if (r["knob"], r["value"]) == (JPEG, 92)]
    assert len(files) == sum(len(table["recipes"]) for table in tables)
    assert min(files) >= BOUNDS["balanced"]


def test_the_document_agrees_with_the_tables(tables):
    assert PAGE.read_text() == document(PAGE.read_text(), tables)
    for name in SCENES:
        assert (DOCS / "trade" / f"{name}.json").stat().st_size < MAX_BYTES


def test_published_figures_make_a_chart(tables, tmp_path):
    pytest.importorskip("matplotlib")
    draw_chart(tmp_path / "chart.png", tables[0])
    assert (tmp_path / "chart.png").stat().st_size > 10_000
