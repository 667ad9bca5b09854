"""The GPU's benchmark where there is none: kernels interpreted on a tiny scene, and a clock that
ticks by the call.
"""

import dataclasses
import importlib.machinery
import json
import os
import sys
import time
import types
from pathlib import Path

import pytest
import torch

from augment.errors import BackendUnavailable
from augment.ground_heights import Ground
from augment.render.constants import RasterSettings
from augment.render.reference import (
    blend_weights,
    order_by_depth,
    project_parts,
    rasterize_reference,
)
from augment.scene import PosedGaussians
from tests.snow_scenes import drive, sheet, wall
from tools import bench_gpu, bench_gpu_frames, bench_gpu_raster, bench_gpu_scene
from tools.apart import apart
from tools.bench_gpu import GpuCase
from tools.bench_gpu_blends import count_blends
from tools.bench_gpu_ceilings import LANES, Ceilings, Load, measure_ceilings
from tools.bench_gpu_frames import (
    CLEAN,
    FLOOD,
    SMOG,
    SNOW,
    balanced,
    bench_frames,
    frame_agreement,
    frame_recipes,
)
from tools.bench_gpu_gsplat import gsplat_draws
from tools.bench_gpu_raster import BUFFERS, SETTINGS, bench_gpu_case, difference
from tools.bench_gpu_targets import targets_of
from tools.bench_gpu_text import END, START, gpu_text, write_table
from tools.bench_scene import RasterCase, random_scene
from tools.cli import main
from tools.gpu_clock import Timing, times_in_turns

TINY = RasterCase(40, 20, 17)
SPEEDS = Ceilings(bytes_per_s=1e9, blends_per_s=1e6)


class Ticks:
    """Every mark is a millisecond after the last."""

    def __init__(self):
        self.now, self.waits = 0.0, 0

    def mark(self):
        self.now += 1.0
        return self.now

    def wait(self):
        self.waits += 1

    def between_ms(self, first, then):
        return then - first


def once() -> Timing:
    return Timing(repeats=1, warm_up=0, clock=Ticks())


@pytest.fixture(scope="module")
def raster():
    return bench_gpu_case(TINY, once(), SPEEDS)


@pytest.fixture(scope="module")
def street():
    road = sheet((2, 6), (-2, 2), rgb=(0.3, 0.35, 0.3))
    ground = Ground(0.0, 0.0, "stated")
    return drive(road, wall(7.0, (-3, 3), (0, 2.5)), ground=ground, ground_z_m=0.0)


@pytest.fixture(scope="module")
def frames(street):
    """By the CPU backend: how the benchmark goes about it is what is tested here."""
    recipes = {k: v for k, v in frame_recipes(0.4).items() if k in (CLEAN, SMOG, FLOOD, SNOW)}
    camera = street.frames[0].cameras["ahead"].scaled(0.25)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_gpu_frames, "BACKEND", "cpu")
        return bench_frames(street, camera, recipes, once(), SPEEDS)


# ---- clocks and ceilings ------------------------------------------------------------------------


def test_actions_take_turns_and_warm_up_does_not_count():
    clock, calls = Ticks(), []
    actions = {name: lambda name=name: calls.append(name) for name in "ab"}
    ms = times_in_turns(actions, Timing(repeats=2, warm_up=1, clock=clock))
    assert "".join(calls) == "baabba"
    assert ms == {"a": [1.0, 1.0], "b": [1.0, 1.0]} and clock.waits == 2


def test_timings_that_are_refused():
    for wrong in ({"repeats": 0}, {"warm_up": -1}):
        with pytest.raises(ValueError, match="repeats >= 1 and warm_up >= 0"):
            Timing(**wrong, clock=Ticks())


def test_ceilings_are_work_over_time():
    found = measure_ceilings(once(), Load(copy_bytes=1 << 12, programs=2, steps=3))
    assert found == Ceilings(bytes_per_s=2 * 4096 / 1e-3, blends_per_s=2 * LANES * 3 / 1e-3)
    assert found.ms(8192.0) == pytest.approx(1.0)
    assert found.ms(0.0, 2 * 2 * LANES * 3) == pytest.approx(2.0)


# ---- what must be moved and blended -------------------------------------------------------------


@pytest.mark.parametrize("stop", [1e-4, 0.05])
def test_blends_are_those_of_the_definition(stop):
    from augment.render.cuda import driver as cuda
    from tools.bench_gpu_floor import noted_passes

    gaussians, camera = random_scene(RasterCase(60, 20, 17))
    opaque, large = gaussians.opacities.clamp_min(0.9), 30 * gaussians.scales
    gaussians = dataclasses.replace(gaussians, opacities=opaque, scales=large)
    parts = [PosedGaussians(gaussians)]
    settings = RasterSettings(transmittance_stop=stop)
    with noted_passes() as passes:
        cuda.rasterize_cuda(parts, camera, frozenset({"alpha"}), settings, None)
    (seen,) = passes
    counted = count_blends(seen.splats, seen.tiles, camera, settings)
    splats = order_by_depth(project_parts(parts, camera, settings))
    y, x = torch.meshgrid(torch.arange(17) + 0.5, torch.arange(20) + 0.5, indexing="ij")
    pixels = torch.stack([x.reshape(-1), y.reshape(-1)])
    weights, after = blend_weights(splats, pixels, torch.ones(340), settings)
    assert counted.done == int((weights > 0).sum()) > 2000
    assert bool((after[-1] <= stop).any())  # some pixels are finished before their lists end
    lengths = seen.tiles.starts.diff()
    assert counted.listed == int((lengths * torch.tensor([256, 64, 16, 4])).sum())
    assert counted.done <= counted.reached <= counted.listed
    assert counted.members <= int(lengths.sum()) and counted.used <= len(gaussians)


def test_bytes_of_a_pass_whose_answer_is_known(raster):
    floor = raster["floor"]
    shown, pairs, pixels = floor["visible"], floor["pairs_reached"], 20 * 17
    assert floor["splats"] == 40 and 0 < floor["used"] <= shown <= 40
    # Means, scales and opacity of all, key and count; of those in view quaternion, 16 functions of
    # SH, record and rectangle.
    assert floor["bytes_of"]["project"] == 40 * (28 + 8) + shown * (16 + 192 + 64 + 8)
    assert floor["bytes_of"]["list"] == 40 * 8 + shown * 8 + 4 * floor["pairs"] + 4 * 5
    assert floor["bytes_of"]["blend"] == 4 * pairs + 64 * floor["used"] + pixels * 16
    assert floor["ms"]["blend"] == pytest.approx(
        max(floor["bytes_of"]["blend"] / 1e6, floor["blends"] / 1e3)
    )
    assert floor["ms"]["frame"] == pytest.approx(
        sum(ms for name, ms in floor["ms"].items() if name != "frame")
    )


# ---- sections -----------------------------------------------------------------------------------


def test_the_raster_section(raster):
    assert json.loads(json.dumps(raster, allow_nan=False)) is not None
    assert raster["ms"].keys() == {"clean", "smog"}
    assert raster["ms"]["clean"]["median"] == raster["smog_over_clean"]["median"] == 1.0
    assert raster["stages_ms"].keys() == {"project", "list", "blend"}
    assert raster["same_bits"] and "not installed" in raster["gsplat"]["left_out"]


def test_the_frames_section(frames):
    assert json.loads(json.dumps(frames, allow_nan=False)) is not None
    assert frames["frames"].keys() == {CLEAN, SMOG, FLOOD, SNOW}
    for row in frames["frames"].values():
        assert row["over_clean"]["median"] == 1.0 and row["same_bits"]
        assert row["peak_mib"] is None
        assert row["delivered"]["in_a_row_ms"] > 0 and row["delivered"]["views"] == 2
    sizes = {name: row["floor"]["bytes_of"]["pixels"] for name, row in frames["frames"].items()}
    assert sizes[CLEAN] == 12 * 40 * 22  # nothing was drawn on a GPU, so only what is finished


def test_the_agreement_section(street, monkeypatch):
    for each in bench_gpu_raster.case_agreement(TINY).values():
        assert each["p999"] < 1e-4 and each["pixels"] == 20 * 17
    monkeypatch.setattr(bench_gpu_frames, "BACKEND", "cpu")
    camera = street.frames[0].cameras["ahead"].scaled(0.25)
    recipes = {name: frame_recipes(0.4)[name] for name in (CLEAN, SNOW)}
    found = frame_agreement(street, camera, recipes)
    assert [each["max"] for each in found.values()] == [0, 0]


def test_recipes_are_of_their_tiers():
    recipes = frame_recipes()
    flood = recipes[FLOOD]
    assert flood.weather.flood.reflection == "mirrored"
    assert flood.render.transmittance_stop == 0.01
    assert recipes[SNOW].weather.snow.shading == "per_splat"
    assert recipes[CLEAN].render.transmittance_stop == RasterSettings().transmittance_stop
    sky = balanced(flood, {"weather.flood.reflection": "sky"})
    assert sky.weather.flood.reflection == "sky" and sky.render.transmittance_stop == 0.01


def test_fold_and_placement(street, monkeypatch):
    fold = bench_gpu_scene.bench_fold(TINY, once(), SPEEDS)
    assert fold["floor"]["bytes"] == 2 * 40 * 16 * 3 * 4 and fold["ms"]["median"] == 1.0
    monkeypatch.setattr(bench_gpu_scene, "BACKEND", "cpu")
    monkeypatch.setattr(bench_gpu_scene, "PLACEMENTS", 1)
    placed = bench_gpu_scene.bench_gpu_placement(street, "test:street", cell_m=0.4)
    assert placed["cells"] > 0 and placed["place_s"]["min"] > 0 and placed["cameras"] == 2
    assert json.loads(json.dumps(placed)) == placed


def test_difference_of_known_images():
    own, right = torch.zeros(10, 10, 3), torch.zeros(10, 10, 3)
    own[0, 0, 1], own[5, 5, 2] = 0.5, -0.0005
    found = difference(own, right)
    assert (found["max"], found["flipped"], found["pixels"]) == (0.5, 1, 100)


# ---- gsplat -------------------------------------------------------------------------------------


@pytest.fixture
def fake_gsplat(monkeypatch):
    """A module of gsplat's name that renders by our definition what it is told of the camera."""
    module = types.ModuleType("gsplat")
    module.__spec__ = importlib.machinery.ModuleSpec("gsplat", None)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    gaussians, camera = random_scene(TINY)

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options
    ):
        assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
        assert options.keys() == {"near_plane", "eps2d", "sh_degree", "packed", "render_mode"}
        assert options["sh_degree"] == 3 and opacities.shape == means.shape[:1]
        told = dataclasses.replace(
            camera,
            fx=float(Ks[0, 0, 0]),
            fy=float(Ks[0, 1, 1]),
            cx=float(Ks[0, 0, 2]),
            cy=float(Ks[0, 1, 2]),
            camera_from_world=viewmats[0].double(),
        )
        parts = [PosedGaussians(gaussians)]
        found = rasterize_reference(parts, told, BUFFERS, SETTINGS, None)
        return found.rgb[None], found.alpha[None, ..., None], {}

    module.rasterization = rasterization
    return module


def test_gsplat_takes_turns_with_ours(fake_gsplat, monkeypatch):
    gaussians, camera = random_scene(TINY)
    ours = rasterize_reference([PosedGaussians(gaussians)], camera, BUFFERS, SETTINGS, None)
    monkeypatch.setattr(bench_gpu_raster, "draw", lambda parts, camera: ours)
    found = bench_gpu_raster._beside_gsplat({"clean": int, "smog": int}, gaussians, camera, once())
    assert set(found["ms"]) == {"clean", "smog", "gsplat, packed", "gsplat, unpacked"}
    assert found["gsplat"]["ratio"]["median"] == 1.0 and found["gsplat"]["rgb"]["max"] < 1e-5


def test_a_gsplat_that_cannot_be_built_is_left_out(fake_gsplat, monkeypatch):
    def no_compiler(*args, **kwargs):
        raise RuntimeError("no nvcc")

    fake_gsplat.rasterization = no_compiler
    assert gsplat_draws(*random_scene(TINY)) == "gsplat failed: RuntimeError: no nvcc"


# ---- the whole ----------------------------------------------------------------------------------


@pytest.fixture
def figures(raster, frames, monkeypatch, tmp_path):
    """Of a run whose sections were measured before, but for one that fails."""

    def broken(*_):
        raise ArithmeticError("no such lane")

    placed = {
        "scene": "drive", "uri": "u", "gaussians": 9, "cameras": 1, "cell_m": 0.05, "cells": 5,
        "place_s": {"min": 0.5, "median": 0.75, "p90": 1.5}, "stages_s": {}, "named": True,
    }  # fmt: skip
    same = {"p999": 2e-3, "max": 0.5, "flipped": 7, "pixels": 340}
    found = {
        "ceilings": lambda *_: {**dataclasses.asdict(SPEEDS), "gpu": None},
        "raster": lambda *_: raster,
        "style": broken,
        "frames": lambda *_: {"scene": "a street", **frames},
        "placement": lambda *_: {"scenes": [placed, {**placed, "named": False}]},
        "agreement": lambda *_: {"raster": {"clean": same}, "frames": {CLEAN: same}},
    }
    monkeypatch.setattr(bench_gpu, "SECTIONS", found)
    path = tmp_path / "gpu.json"
    figures = bench_gpu.bench_gpu(
        GpuCase(), timing=once(), sections=tuple(found), json_file=path, in_processes=False,
        progress=False,
    )  # fmt: skip
    assert json.loads(path.read_text()) == json.loads(json.dumps(figures))
    return figures


def test_a_section_that_fails_leaves_the_others(figures, capfd):
    assert figures["style"] == {"failed": "ArithmeticError: no such lane"}
    assert figures["raster"]["seconds"] >= 0 and "frames" in figures["frames"]


def test_targets_are_met_missed_or_not_measured_and_say_why(figures):
    lines = {line.what: line for line in targets_of(figures)}
    assert lines["clean frame"].met and lines["clean frame"].value == 1.0
    assert lines["clean frame"].share == pytest.approx(figures["raster"]["floor"]["ms"]["frame"])
    assert lines["placement of snow, PandaSet"].value == 0.75
    assert lines["rgb off the CPU backend's, 99.9 %"].met is False
    assert lines["clean frame, over gsplat's"].met is None
    assert "not installed" in lines["clean frame, over gsplat's"].why
    assert "no such lane" in lines["style: fold and apply to all SH"].why
    slow = {**figures["raster"], "ms": {"clean": {"min": 3.0, "median": 3.5, "p90": 4.0}}}
    (clean, *_) = targets_of({**figures, "raster": slow})
    assert clean.met is False and clean.spread == (3.0, 4.0)


def test_without_any_section_every_target_says_why():
    for found in ({}, {"raster": {"left_out": "no time was left"}}):
        lines = targets_of(found)
        assert len(lines) == 12 and all(line.met is None and line.why for line in lines)


def test_the_page_has_a_place_for_the_tables():
    page = (Path(__file__).parents[2] / "docs" / "performance.md").read_text()
    before, found, rest = page.partition(START)
    assert before and found and END in rest


def test_text_and_page(figures, tmp_path):
    text, page = gpu_text(figures), tmp_path / "performance.md"
    page.write_text(f"# Speed\n\n{START}\nof another day\n{END}\n\nEnd.\n")
    write_table(page, figures)
    written = page.read_text()
    assert written.startswith("# Speed\n") and written.endswith("\nEnd.\n")
    assert "of another day" not in written and written.count(START) == 1
    for line in targets_of(figures):
        assert line.what in text and f"| {line.what} |" in written
    for words in ("project", "blend", FLOOD, "drive", "ArithmeticError", "times mean nothing"):
        assert words in text and words in written
    write_table(page, figures)
    assert page.read_text() == written
    write_table(tmp_path / "new.md", figures)
    assert START in (tmp_path / "new.md").read_text()


def test_sections_by_name(monkeypatch):
    measured = []
    sections = {name: lambda *_, name=name: measured.append(name) or {} for name in ("raster", "x")}
    sections = {"ceilings": lambda *_: dataclasses.asdict(SPEEDS), **sections}
    monkeypatch.setattr(bench_gpu, "SECTIONS", sections)
    found = bench_gpu.bench_gpu(
        GpuCase(), sections=("x",), timing=once(), in_processes=False, progress=False
    )
    assert measured == ["x"] and found["raster"] == {"left_out": "not asked for"}
    with pytest.raises(ValueError, match="sections are ceilings, raster, x; got y"):
        bench_gpu.bench_gpu(GpuCase(), sections=("y",), timing=once())


def test_without_ceilings_nothing_else_is_measured(monkeypatch):
    monkeypatch.setitem(bench_gpu.SECTIONS, "ceilings", lambda *_: {"left_out": "no time was left"})
    found = bench_gpu.bench_gpu(GpuCase(), timing=once(), in_processes=False, progress=False)
    assert "could not be measured" in found["raster"]["left_out"]
    assert "no time was left" in gpu_text(found)


def test_work_apart_ends_in_a_record_whatever_its_end(capfd):
    assert apart(dict, ({"a": 1},), 60)["a"] == 1
    assert apart(os._exit, (3,), 60) == {"failed": "its process ended with code 3"}
    assert apart(int, ("x",), 60)["failed"].startswith("ValueError")
    assert "stopped after 0" in apart(time.sleep, (60,), 0.1)["left_out"]
    assert apart(dict, (), 0) == {"left_out": "no time was left"}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("words", [["gpu"], ["raster", "--device", "cuda"]])
def test_without_a_gpu_the_commands_say_so(words, capsys):
    assert main(["bench", *words]) == 2
    assert "there is no GPU to measure here" in capsys.readouterr().err


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_trade_on_a_gpu_needs_one():
    from tools.bench_commands import trade

    with pytest.raises(BackendUnavailable, match="no GPU to measure"):
        trade(device="cuda")


@pytest.mark.gpu
def test_a_small_run_on_a_gpu(tmp_path):
    case = dataclasses.replace(bench_gpu.QUICK, load=Load(1 << 24, 264, 256))
    path = tmp_path / "gpu.json"
    found = bench_gpu.bench_gpu(case, timing=Timing(3, 1), json_file=path, progress=False)
    assert not [name for name in bench_gpu.SECTIONS if "failed" in found[name]]
    assert found["raster"]["same_bits"] and found["raster"]["peak_mib"] > 0
    for line in targets_of(found):
        assert line.value is None or line.value > 0
    assert found["gpu"]["name"] in gpu_text(found)
