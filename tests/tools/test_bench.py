import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from augment.render.reference import project_parts
from augment.scene import PosedGaussians
from tools.bench import raster as bench
from tools.bench.raster import STAGES, Spread, bench_raster, bench_text
from tools.bench_memory import peak_extra_mib
from tools.bench_scene import DEFAULT_CASES, RasterCase, random_scene
from tools.machine import machine_facts

TINY, OBLONG = RasterCase(400, 48, 32), RasterCase(900, 33, 70)


@pytest.fixture(autouse=True, scope="module")
def small_reference():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "SMALL", RasterCase(300, 64, 48))
        yield


@pytest.fixture(scope="module")
def figures(small_reference):
    return bench_raster([TINY, OBLONG], repeats=3, memory=False, progress=False)


# ---- the scene --------------------------------------------------------------------------------


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
    # the logarithm is uniform: its mean is the middle, within 4 standard errors of 60 000 draws
    middle = math.log(0.004 * 0.06) / 2
    spread = math.log(0.06 / 0.004) / math.sqrt(12 * 60_000)
    assert float(scales.double().log().mean()) == pytest.approx(middle, abs=4 * spread)
    torch.testing.assert_close(gaussians.quats.norm(dim=1), torch.ones(20_000))
    assert float(gaussians.opacities.min()) == pytest.approx(0.005)
    assert 0.9 / 2.1 - 0.01 < float(gaussians.opacities.mean()) < 0.9 / 2.1 + 0.01
    splats = project_parts([PosedGaussians(gaussians)], camera, bench.SETTINGS)
    inside = ((splats.means2d > 0) & (splats.means2d < torch.tensor([640, 480]))).all(1)
    assert float(inside.double().mean()) == pytest.approx(1 / 1.1**2, abs=0.01)


def test_the_scene_follows_from_its_seed():
    again, other = random_scene(TINY)[0], random_scene(TINY, seed=1)[0]
    assert torch.equal(random_scene(TINY)[0].sh, again.sh)
    assert not torch.equal(again.means, other.means)


@pytest.mark.parametrize("text", ["100k@640x480", "1M@1600x1066", "1500@64x48", "12k@1x1"])
def test_names_of_cases_read_back(text):
    assert RasterCase.parse(text).name == text


def test_default_cases():
    assert [case.name for case in DEFAULT_CASES] == ["100k@640x480", "1M@1600x1066"]


@pytest.mark.parametrize("text", ["100k", "k@640x480", "1G@640x480", "5@640*480", "0@640x480"])
def test_cases_that_are_refused(text):
    with pytest.raises(ValueError, match=r"COUNT@WIDTHxHEIGHT|must be >= 1"):
        RasterCase.parse(text)


# ---- figures ----------------------------------------------------------------------------------


def test_spread():
    spread = Spread.of([5.0, 1.0, 2.0, 3.0, 4.0])
    assert (spread.min, spread.median) == (1.0, 3.0)
    assert spread.p90 == pytest.approx(np.quantile([1, 2, 3, 4, 5], 0.9))


def test_figures_are_json_and_hang_together(figures):
    assert json.loads(json.dumps(figures))["cases"] == list(figures["cases"])
    assert [case["case"] for case in figures["cases"]] == [TINY.name, OBLONG.name]
    for case in figures["cases"]:
        assert set(case["stages_ms"]) == set(STAGES)
        for spread in (*case["stages_ms"].values(), case["frame_ms"], case["smog_frame_ms"]):
            assert 0 <= spread["min"] <= spread["median"] <= spread["p90"]
        # every stage lies within its frame, so even their least times must fit into the slowest
        stages = sum(spread["min"] for spread in case["stages_ms"].values())
        assert 0 < stages <= case["frame_ms"]["p90"]
        seconds = case["frame_ms"]["median"] / 1e3
        assert case["pairs_per_s"] == pytest.approx(case["pairs"] / seconds)
        assert 0 < case["visible"] <= 900
    assert figures["warm_up_s"] > 0
    reference = figures["reference"]
    assert reference["pixels"] == 64 * 48
    assert reference["p999_difference"] <= 1e-4  # the agreement that backends promise
    assert reference["flipped_pixels"] <= 3
    assert reference["max_difference"] >= reference["p999_difference"]


def test_pairs_are_counted_by_boxes_and_tiles():
    """Against a loop over splats: tiles that the box of each one touches."""
    gaussians, camera = random_scene(TINY)
    splats = project_parts([PosedGaussians(gaussians)], camera, bench.SETTINGS)
    pairs = 0
    for centre, cov, opacity in zip(splats.means2d, splats.covs2d, splats.opacities, strict=True):
        sigmas = min(3.33, math.sqrt(2 * math.log(max(1.0, 255 * float(opacity)))))
        spans = []
        for axis, size in ((0, 48), (1, 32)):
            half = sigmas * math.sqrt(float(cov[2 * axis]))
            low, high = float(centre[axis]) - half, float(centre[axis]) + half
            spans.append(sum(low <= t * 16 + 16 and high >= t * 16 for t in range(size // 16)))
        pairs += spans[0] * spans[1]
    counted = bench_raster([TINY], repeats=1, memory=False, progress=False)["cases"][0]["pairs"]
    assert counted == pytest.approx(pairs, rel=0.01)  # boxes are widened a little for rounding


def test_text_shows_every_case_and_the_machine(figures):
    text = bench_text(figures)
    for words in (TINY.name, OBLONG.name, "raster", "whole frame", "with smog", "torch reference"):
        assert words in text
    assert f"{figures['cases'][0]['frame_ms']['median']:.2f}" in text
    assert text.count("memory of a frame: not measured") == 2
    assert figures["machine"]["versions"]["numba"] in text


def test_quick_measures_the_first_case_only():
    case_figures = bench_raster(
        [TINY, OBLONG], repeats=1, quick=True, memory=False, progress=False
    )["cases"]
    assert [case["case"] for case in case_figures] == [TINY.name]


@pytest.mark.parametrize("arguments", [{"repeats": 0}, {"cases": []}])
def test_nothing_to_measure_is_refused(arguments):
    with pytest.raises(ValueError, match="need repeats >= 1 and a case"):
        bench_raster(**arguments, progress=False)


def test_machine_facts():
    facts = machine_facts()
    assert facts.cores >= 1 and facts.threads >= 1 and facts.processor
    assert facts.thread_pool in ("tbb", "omp", "workqueue")
    assert {"torch", "numpy", "numba"} <= set(facts.versions)


def test_peak_memory_holds_the_images_and_little_more():
    extra = peak_extra_mib(RasterCase(2_000, 1600, 1200))
    if extra is None:
        pytest.skip("/proc does not tell resident memory here")
    images = 1600 * 1200 * 4 * 4 / 2**20  # rgb and alpha, float32: 29 MiB, and as much again
    assert 0.95 * images < extra < 4 * images  # for the state of the tiles and scratch


def test_a_failing_probe_is_reported(monkeypatch):
    if not Path("/proc/self/clear_refs").is_file():
        pytest.skip("/proc does not tell resident memory here")
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(RuntimeError, match=f"measuring the memory of {TINY.name} failed"):
        peak_extra_mib(TINY)
