"""The benches: how the harness measures, and one small run of each subject."""

import importlib.util
import json
import os
import time

import numpy as np
import pytest
import torch

from augment.errors import ClimateGSError
from augment.render.constants import RasterSettings
from augment.render.reference import project_parts
from augment.scene import PosedGaussians
from tests.streets import SMALL_STREET, open_street
from tools.bench import EFFECTS, dataset, fit, flood, jobs, raster, scenes, snow, style
from tools.bench.harness import (
    WallClock,
    peak_mib_in_subprocess,
    replace_marked,
    rounds,
    run_in_subprocess,
    spread,
    spread_ratio,
)
from tools.bench.scenes import EffectCase, RasterCase, measure_effect, random_scene
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


def test_spreads_are_quantiles_and_ratios_are_taken_pair_by_pair():
    found = spread([5.0, 1.0, 2.0, 3.0, 4.0])
    assert found == {"median": 3.0, "min": 1.0, "p90": np.quantile([1, 2, 3, 4, 5], 0.9)}
    assert spread_ratio([2.0, 9.0, 8.0], [1.0, 3.0, 8.0])["median"] == 2.0


def test_a_document_keeps_all_but_what_is_between_its_markers():
    page = "# Speed\n\n<a>\nof another day\n<b>\n\nEnd.\n"
    written = replace_marked(page, "<a>", "<b>", "new\n")
    assert written == "# Speed\n\n<a>\n\nnew\n\n<b>\n\nEnd.\n"
    assert replace_marked(written, "<a>", "<b>", "new") == written
    with pytest.raises(ValueError, match="no '<c>'"):
        replace_marked(page, "<c>", "<b>", "new")


@pytest.mark.long
def test_work_in_a_subprocess_ends_in_a_record_whatever_its_end(capfd):
    assert run_in_subprocess(dict, ({"a": 1},), 60)["a"] == 1
    assert run_in_subprocess(os._exit, (3,), 60) == {"failed": "its process ended with code 3"}
    assert run_in_subprocess(int, ("x",), 60)["failed"].startswith("ValueError")
    assert "stopped after 0" in run_in_subprocess(time.sleep, (60,), 0.1)["left_out"]
    assert run_in_subprocess(dict, (), 0) == {"left_out": "no time was left"}


@pytest.mark.long
def test_peak_memory_holds_the_images_and_little_more():
    extra = peak_mib_in_subprocess(raster.frame_of, (RasterCase(2_000, 1600, 1200),))
    if extra is None:
        pytest.skip("/proc does not tell resident memory here")
    images = 1600 * 1200 * 4 * 4 / 2**20  # rgb and alpha, float32: 29 MiB, and as much again
    assert 0.95 * images < extra < 4 * images  # for the state of the tiles and scratch
    with pytest.raises(RuntimeError, match=r"memory of int.*failed"):
        peak_mib_in_subprocess(int, ("x",))


def test_without_the_source_checkout_the_command_says_so(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["bench", "raster"]) == 2
    assert "part of the source checkout" in capsys.readouterr().err


# ---- scenes and views ---------------------------------------------------------------------------


def test_the_random_scene_is_as_described():
    gaussians, camera = random_scene(RasterCase(20_000, 640, 480))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 520.0, 520.0)
    assert len(gaussians) == 20_000 and gaussians.sh_degree == 3
    z, left, up = gaussians.means.double().unbind(1)  # the camera looks along +x
    assert 2 <= float(z.min()) < 2.01 and 19.99 < float(z.max()) <= 20
    for offsets, half in ((left, 320 / 520), (up, 240 / 520)):
        reach = (offsets.abs() / z).max()
        assert 1.09 * half < float(reach) <= 1.1 * half * (1 + 1e-6)  # float32 means
    scales = gaussians.scales
    assert 0.004 <= float(scales.min()) < 0.00401 and 0.0599 < float(scales.max()) <= 0.06 + 1e-8
    assert float(gaussians.opacities.min()) == pytest.approx(0.005)
    splats = project_parts([PosedGaussians(gaussians)], camera, RasterSettings())
    inside = ((splats.means2d > 0) & (splats.means2d < torch.tensor([640, 480]))).all(1)
    assert float(inside.double().mean()) == pytest.approx(1 / 1.1**2, abs=0.01)


# ---- subjects -----------------------------------------------------------------------------------


def test_raster_measures_stages_work_and_the_reference():
    cases = raster.RasterCases([RasterCase(400, 48, 32)], RasterCase(300, 64, 48), memory=False)
    result = raster.measure(repeats=3, cases=cases)
    rows = {name: ms for _, name, *ms in check_figures(result)["Frames"]}
    assert [*rows] == ["project", "sort", "bin", "raster", "frame", "with smog"]
    # every stage lies within its frame, so even their least times must fit into the slowest
    assert 0 < sum(low for _, low, _ in [*rows.values()][:4]) <= rows["frame"][2]
    (case,), beside = result["facts"]["cases"], result["facts"]["reference"]
    assert 0 < case["visible"] <= 400 and case["listed_pairs"] <= case["pairs"]
    assert beside["pixels"] == 64 * 48 and beside["flipped"] <= 3
    assert beside["p999"] <= 1e-4  # the agreement that backends promise


@pytest.mark.long
@pytest.mark.parametrize("name", EFFECTS)
def test_effects_have_their_tables(name, monkeypatch):
    for module in (scenes, snow, style):
        monkeypatch.setattr(module, "open_scene", open_street)
    monkeypatch.setattr(flood, "WAVES", ("calm",))
    size = {"width": 96, "height": 64, "scale": 0.2, "cell_m": 0.2, "splats": 2_000}
    views = {"frames": (0,), "cameras": ("front",), "presets": ("overcast",), "memory": False}
    case = EffectCase(scenes=(SMALL_STREET,), street=SMALL_STREET, **size, **views)
    result = measure_effect(name, 1, case)
    tables = check_figures(result)
    frames, stages = (
        next(rows for title, rows in tables.items() if title.startswith(start))
        for start in ("Frames", "Stages")
    )
    assert result["bench"] == name and all(min(row[1:]) > 0 for row in frames)
    assert "rasterise" in [row[0] for row in stages]


@pytest.mark.long
def test_dataset_measures_reading_rendering_and_a_large_manifest():
    readings = ("image, depth, boxes, float32, verified",)
    size = {"images": 5, "scale": 0.05, "rows": 700, "live": 2}
    case = dataset.DatasetCase(**size, workers=(1,), readings=readings, memory=False)
    tables = check_figures(dataset.measure(case=case, repeats=1))
    reading, live, [(rows, held, _)] = tables.values()
    assert [row[0] for row in reading] == [dataset.DECODING, *readings]
    assert [row[3] for row in (*reading, *live)][::2] == [1, 1]
    assert all(rate > 0 for *_, rate, _ in (*reading, *live))
    # Some 150 bytes a row with so few images a variant, where the whole table has 440.
    assert rows == 700 and 700 * 32 < held * 2**20 < 700 * 200


@pytest.mark.long
def test_jobs_measures_machinery_a_long_job_and_opening():
    scene = "procedural:street?seed=3&frames=2&gaussians=60000"
    size = {"variants": 2, "images": 8, "gaussians": 500, "workers": (), "memory": False}
    result = jobs.measure(case=jobs.JobsCase(scene, 0.05, **size), repeats=1)
    compared, long, opened = check_figures(result).values()
    assert [name for name, *_ in compared] == [jobs.BARE, "generate, this process"]
    assert all(ms > 0 for _, ms, *_ in (*compared, *opened)) and compared[0][-1] == 1
    assert dict(long)["images"] == 8 and dict(long)["blocks"] == 1
    assert len(opened) == 4 and all(mib > 0 for _, _, mib, _ in opened)


@pytest.mark.long
def test_fit_measures_steps_at_a_fixed_number_of_splats():
    size = {"splats": 20_000, "steps": 3, "frames": 2, "gaussians": 60_000, "fit_steps": 2}
    images = {"cameras": ("front",), "render_scale": 0.1, "street_scale": 1.0}
    case = fit.FitCase(**size, **images)
    result = fit.measure(case=case)
    (steps, fits), facts = check_figures(result).values(), result["facts"]
    stages = {name: ms for name, *ms in steps}
    assert stages.keys() == {
        "whole step", "load", "forward", "loss", "backward", "optimise", "densify"
    }  # fmt: skip
    # the stages lie within their step, so even their least times must fit into the slowest tenth
    least = sum(low for name, (_, low, _) in stages.items() if name != "whole step")
    assert least <= stages["whole step"][2]
    assert facts["splats"] == 20_000 and facts["memory_mib"]["peak"] > 0
    assert fits[0][1] == 2 and fits[0][2] > 10
    with pytest.raises(ClimateGSError, match="no recorded images"):
        fit.measure(scene="procedural:street?seed=3&frames=1&gaussians=60000", case=case)
