"""The benches: how the harness measures, one small run of each subject, and the rule of tiers."""

from __future__ import annotations

import dataclasses
import importlib.machinery
import importlib.util
import json
import math
import os
import time

import numpy as np
import pytest
import torch

from augment.errors import ClimateGSError
from augment.scene.cameras import Camera
from augment.view.quality import Trial
from recipes.schema import KNOBS, TIERS, knobs_of
from tests.streets import SMALL_STREET, open_street
from tools.bench import dataset, effects, fit, gpu, jobs, lod, raster, trade
from tools.bench.effects import EffectCase, measure_effect
from tools.bench.gpu import GpuCase, Timing, measure
from tools.bench.harness import WallClock, rounds, run_in_subprocess
from tools.bench.scenes import RasterCase
from tools.bench.trade import (
    ALL_KNOBS,
    DEPTH,
    JPEG,
    Standard,
    Unmeasured,
    depth_figures,
    flicker,
    tier_from,
)
from tools.cli import main


class TickingClock(WallClock):
    """Every mark is a second after the last."""

    now = 0.0

    def mark(self):
        self.now += 1.0
        return self.now


def check_figures(result):
    """The JSON form that every subject gives."""
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result.keys() == {"bench", "machine", "load_after", "tables", "facts"}
    for table in result["tables"]:
        assert table["rows"] and {len(row) for row in table["rows"]} == {len(table["columns"])}
    return {table["title"]: table["rows"] for table in result["tables"]}


# ---- the harness --------------------------------------------------------------------------------


def test_cases_take_turns_and_the_first_round_does_not_count():
    calls = []
    cases = {name: lambda name=name: calls.append(name) for name in "ab"}
    seconds = rounds(cases, 2, warm_up=1, clock=TickingClock())
    assert "".join(calls) == "baabba" and seconds == {"a": [1.0, 1.0], "b": [1.0, 1.0]}
    with pytest.raises(ValueError, match="repeats >= 1 and a case"):
        rounds(cases, 0)


@pytest.mark.long
def test_work_in_a_subprocess_ends_in_a_record_whatever_its_end(capfd):
    assert run_in_subprocess(dict, ({"a": 1},), 60)["a"] == 1
    assert run_in_subprocess(os._exit, (3,), 60) == {"failed": "its process ended with code 3"}
    assert run_in_subprocess(int, ("x",), 60)["failed"].startswith("ValueError")
    assert "stopped after 0" in run_in_subprocess(time.sleep, (60,), 0.1)["left_out"]
    assert run_in_subprocess(dict, (), 0) == {"left_out": "no time was left"}


def test_without_the_source_checkout_the_command_says_so(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["bench", "raster"]) == 2
    assert "part of the source checkout" in capsys.readouterr().err


# ---- subjects -----------------------------------------------------------------------------------

TINY_STREET = "procedural:street?seed=3&frames=2&gaussians=60000"
TINY_EFFECTS = EffectCase(
    scenes=(SMALL_STREET,), street=SMALL_STREET, width=96, height=64, frames=(0,),
    cameras=("front",), scale=0.2, cell_m=0.2, splats=2_000, presets=("overcast",), memory=False,
)  # fmt: skip
TINY_JOBS = jobs.JobsCase(
    TINY_STREET, 0.05, variants=2, rig=TINY_STREET, rig_scale=0.05, images=8, gaussians=500,
    workers=(), memory=False,
)  # fmt: skip
TINY_DATASET = dataset.DatasetCase(
    images=5, scale=0.05, rows=700, live=2, workers=(1,), memory=False,
    readings=("image, depth, boxes, float32, verified",),
)  # fmt: skip
TINY_FIT = fit.FitCase(
    splats=20_000, steps=3, frames=2, gaussians=60_000, fit_steps=2, cameras=("front",),
    render_scale=0.1, street_scale=1.0,
)  # fmt: skip
# Each subject on a tiny case, and the beginnings of its tables' titles.
SUBJECTS = {
    "lod": (lambda: lod.measure(quick=True, repeats=1), ["Views", "Most memory"]),
    "dataset": (lambda: dataset.measure(case=TINY_DATASET, repeats=1), 3 * [""]),
    "jobs": (lambda: jobs.measure(case=TINY_JOBS, repeats=1), 4 * [""]),
    "fit": (lambda: fit.measure(case=TINY_FIT), 2 * [""]),
    "smog": (lambda: measure_effect("smog", 1, TINY_EFFECTS), ["Frames", "Stages", "Largest"]),
    "flood": (
        lambda: measure_effect("flood", 1, TINY_EFFECTS),
        ["Frames", "Stages", "Errors inside the water", "Masks of water"],
    ),
    "snow": (
        lambda: measure_effect("snow", 1, TINY_EFFECTS),
        ["Frames", "Stages", "Placement", "Snow"],
    ),
    "rain": (lambda: measure_effect("rain", 1, TINY_EFFECTS), ["Frames", "Stages", "Drops"]),
    "light": (lambda: measure_effect("light", 1, TINY_EFFECTS), ["Frames", "Stages", "Lamps"]),
    "style": (
        lambda: measure_effect("style", 1, TINY_EFFECTS),
        ["Frames", "Stages", "Maps folded into", "Maps folded into SH against", "From a style"],
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_subject_has_its_tables_and_its_times_are_positive(name, monkeypatch):
    monkeypatch.setattr(effects, "open_scene", open_street)
    measure_subject, titles = SUBJECTS[name]
    result = measure_subject()
    check_figures(result)
    assert result["bench"] == name and len(result["tables"]) == len(titles)
    for table, title in zip(result["tables"], titles, strict=True):
        assert table["title"].startswith(title)
        if table["title"].startswith("Stages"):  # a stage takes no time in frames without it
            continue
        for column, heading in enumerate(table["columns"]):
            if {"ms", "images/s"} & set(heading.split()):
                assert all(row[column] > 0 for row in table["rows"]), (heading, table["rows"])


def test_raster_measures_stages_work_and_the_reference():
    cases = raster.RasterCases([RasterCase(400, 48, 32)], RasterCase(300, 64, 48), memory=False)
    result = raster.measure(repeats=3, cases=cases)
    rows = {name: ms for _, name, *ms in check_figures(result)["Frames"]}
    # Every stage lies within its frame, so even their least times must fit into the slowest.
    assert 0 < sum(rows[stage][1] for stage in raster.STAGES) <= rows["frame"][2]
    (case,), beside = result["facts"]["cases"], result["facts"]["reference"]
    assert 0 < case["visible"] <= 400 and case["listed_pairs"] <= case["pairs"]
    assert beside["flipped"] <= 3 and beside["p999"] <= 1e-4  # the agreement of backends
    # A blend takes more than one instruction, and no core does more of them than it can.
    blending = result["facts"]["blending"]
    assert blending["multiply_adds_per_blend"] > 1 and 0 < blending["share"] <= 1


def test_a_fit_without_recorded_images_is_refused():
    with pytest.raises(ClimateGSError, match="no recorded images"):
        fit.measure(scene="procedural:street?seed=3&frames=1&gaussians=60000", case=TINY_FIT)


SMALL = RasterCase(40, 20, 17)


@pytest.mark.long
def test_a_gpus_frame_has_stages_a_floor_and_launches():
    """Kernels interpreted on a tiny scene."""
    with gpu.TorchOps() as ops:
        rows = torch.ones(6).reshape(2, 3)[1]  # one operation and two views of it
        assert float((rows * 2).sum()) == 6
    assert ops.count == 3
    clock = Timing(repeats=1, warm_up=0, clock=TickingClock())
    ceilings = gpu.measure_ceilings(clock, copy_bytes=1 << 12, programs=2, steps=3)
    assert ceilings == gpu.Ceilings(bytes_per_s=2 * 4096, blends_per_s=2 * gpu.LANES * 3)
    found = gpu.measure_raster(SMALL, clock, gpu.Ceilings(bytes_per_s=1e6, blends_per_s=1e6))
    assert found["same_bits"] and found["stages_ms"].keys() == {"project", "list", "blend"}
    assert found["ms"]["clean"]["median"] == 1000 and found["smog_over_clean"]["median"] == 1
    floor = found["floor"]
    assert floor["splats"] == 40 and 0 < floor["used"] <= floor["visible"] <= 40
    scene, camera = gpu.interpreted_street()
    recipes = gpu.frame_recipes(0.4)
    found = gpu.count_launches(scene, camera, {n: recipes[n] for n in ("clean", "smog")})
    clean, smog = found["launches"].values()
    assert clean["triton"] == smog["triton"] > 0  # fog costs the projection, and no launch
    with pytest.raises(ValueError, match=r"sections are ceilings, .*; got y"):
        measure(GpuCase(), sections=("y",), timing=clock)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_commands_say_so(capsys):
    for words in (["gpu"], ["raster", "--device", "cuda"], ["trade", "--device", "cuda"]):
        assert main(["bench", *words]) == 2
        assert "there is no GPU to measure here" in capsys.readouterr().err


@pytest.mark.gpu
def test_a_small_run_on_a_gpu(tmp_path):
    case = dataclasses.replace(
        gpu.QUICK_CASE, load={"copy_bytes": 1 << 24, "programs": 264, "steps": 256}
    )
    result = measure(case, timing=Timing(3, 1), json_file=tmp_path / "gpu.json")
    sections = result["facts"]["sections"]
    assert not [name for name in gpu.SECTIONS if "failed" in sections[name]]
    assert sections["raster"]["same_bits"] and sections["raster"]["peak_mib"] > 0


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


# ---- The rule, in tables made up -----------------------------------------------------------------

STOP, CLIP = "render.speed.transmittance_stop", "render.speed.radius_clip_px"


def row(knob, value, over_reference, worst_flip, settings=None):
    figures = {"over_reference": over_reference, "worst_flip": worst_flip}
    given = {} if settings is None else {"settings": settings}
    return {"knob": knob, "value": value, **figures, **given}


def table(**recipes):
    entries = [{"recipe": name, "rows": rows} for name, rows in recipes.items()]
    return {"scene": "made up", "recipes": entries}


def whole(worst_flip, stop=1e-4, clip=0.0):
    return row(ALL_KNOBS, "some name", 0.5, worst_flip, {STOP: stop, CLIP: clip})


SINGLE = [
    row(STOP, 0.05, 0.80, 0.03),
    row(STOP, 0.01, 0.90, 0.01),
    row(STOP, 1e-3, 0.95, 0.001),
    row(CLIP, 2.0, 0.70, 0.04),
    row(CLIP, 1.0, 0.85, 0.015),
]
BOTH = [*SINGLE, whole(0.018, stop=0.01, clip=1.0)]


def test_the_rule_takes_what_saves_most_within_the_bound():
    less = whole(0.018, stop=1e-3, clip=1.0)
    too_much = [whole(0.03, stop=stop, clip=1.0) for stop in (0.01, 1e-3)]
    only_stop = [row for row in SINGLE if row["knob"] == STOP]
    for why, tables, tier in (
        ("the fastest within the bound", table(clean=BOTH), {STOP: 0.01, CLIP: 1.0}),
        (
            "the worst recipe counts",
            table(clean=[*SINGLE, less], snow=[*SINGLE, less, row(STOP, 0.01, 0.90, 0.05)]),
            {STOP: 1e-3, CLIP: 1.0},
        ),
        (
            "what saves most comes first, and the others fit beside it",
            table(clean=[*SINGLE, too_much[0], less]),
            {STOP: 1e-3, CLIP: 1.0},
        ),
        ("or do not", table(clean=[*SINGLE, *too_much]), {CLIP: 1.0}),
        (
            "a recipe with one of the knobs needs no rendering together",
            table(clean=BOTH, snow=only_stop),
            {STOP: 0.01, CLIP: 1.0},
        ),
        (
            "of all recipes: what saves more of one comes later",
            table(
                clean=[row(STOP, 0.01, 0.8, 0.01)],
                snow=[
                    row(STOP, 0.01, 0.8, 0.01),
                    row(CLIP, 2.0, 0.7, 0.01),
                    whole(0.03, 0.01, 2.0),
                ],
            ),
            {STOP: 0.01},
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
            "a slower value that errs more is never taken",
            table(clean=[row(STOP, 0.05, 0.9, 0.015), row(STOP, 0.01, 0.8, 0.01)]),
            {STOP: 0.01},
        ),
    ):
        assert tier_from([tables], 0.02) == tier, why
    with pytest.raises(Unmeasured) as missing:  # what has not been rendered together
        tier_from([table(clean=SINGLE)], 0.02)
    (asked,) = missing.value.args
    moved = {path: value for path, value in asked.items() if value != KNOBS[path].reference}
    assert moved == {STOP: 0.01, CLIP: 1.0}


def test_published_tiers_and_document_are_those_of_the_published_tables():
    tables = trade.read_tables()
    assert {name: dict(settings) for name, settings in TIERS.items()} == trade.tiers_from(tables)
    files = [r["flip"] for r in trade.rows_of(tables) if (r["knob"], r["value"]) == (JPEG, 92)]
    assert len(files) == sum(len(table["recipes"]) for table in tables)
    assert min(files) >= trade.BOUNDS["balanced"]  # invisible: less than a good JPEG's error
    assert trade.PAGE.read_text() == trade.document(trade.PAGE.read_text(), tables)


@pytest.mark.long
def test_published_figures_make_a_chart(tmp_path):
    pytest.importorskip("matplotlib")
    trade.draw_chart(tmp_path / "chart.png", trade.read_tables()[0])
    assert (tmp_path / "chart.png").stat().st_size > 10_000


@pytest.mark.long
def test_errors_of_settings_grow_away_from_the_reference(monkeypatch):
    some = ("render.scale", DEPTH, JPEG)
    monkeypatch.setattr(trade, "open_scene", open_street)
    monkeypatch.setattr(
        trade, "knobs_of", lambda r: tuple(k for k in knobs_of(r) if k.path in some)
    )
    case = trade.TradeCase(width=64, repeats=1, memory=False)
    found = trade.bench_trade(SMALL_STREET, ["flood"], case)
    assert json.loads(json.dumps(found.figures, allow_nan=False)) is not None
    rows = {(row["knob"], row["value"]): row for row in trade.rows_of([found.figures])}
    tables = trade.printable(found.figures)["tables"]
    assert sum(len(table["rows"]) for table in tables) == len(rows)
    best = rows[ALL_KNOBS, trade.REFERENCE]
    assert (best["flip"], best["psnr"], best["ssim"], best["flicker"]) == (0, None, 1, 0)
    assert (best["off_5cm"], best["abs_rel"], best["over_reference"]) == (0, 0, 1)
    coarse, finer = rows["render.scale", 0.25], rows["render.scale", 0.75]
    assert coarse["flip"] > finer["flip"] > 0 and coarse["psnr"] < finer["psnr"]
    assert coarse["ssim"] < finer["ssim"] < 1 and coarse["off_5cm"] > finer["off_5cm"] > 0
    assert rows[DEPTH, "median"]["flip"] == 0  # the recipe's own
    assert rows[DEPTH, "none"]["off_5cm"] is None
    assert rows[DEPTH, "median"]["depth_against"] == trade.TRUTH  # the street's surfaces
    assert 0.01 < rows[DEPTH, "median"]["abs_rel"] < 0.3  # a pixel of this picture is 15 of its own
