"""The benchmark of a reconstruction's step, on a recording small enough to be quick."""

import importlib
import json
from pathlib import Path

import pytest
import torch
from scenes import random_gaussians

from augment.errors import ClimateGSError
from augment.scene import Scene
from augment.sky import ConstantSky
from tools import bench_fit as bench
from tools.bench_fit import bench_fit, fit_text
from tools.fit_data import splat_count

STAGES = {"load", "forward", "loss", "backward", "optimise", "densify"}


@pytest.fixture
def recording(tmp_path, monkeypatch) -> str:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "adapters"))
    folder = importlib.import_module("recording_folder").write_recording(tmp_path / "drive")
    return f"recording:{folder}?voxel_m=0.1&image_scale=1&sky_size=32"


def test_figures_of_a_recording(recording, monkeypatch):
    monkeypatch.setattr(bench, "SCALE", 1.0)
    monkeypatch.setattr(bench, "SPLATS", 20_000)
    figures = bench_fit(recording, quick=True, progress=False)
    assert json.loads(json.dumps(figures))["steps"] == 20
    assert figures["splats"] == 20_000 and figures["actors"] == 1
    assert set(figures["stages_ms"]) == STAGES
    for spread in (*figures["stages_ms"].values(), figures["step_ms"]):
        assert 0 <= spread["min"] <= spread["median"] <= spread["p90"]
    # the stages lie within their step, so even their least times must fit into the slowest tenth
    assert sum(s["min"] for s in figures["stages_ms"].values()) <= figures["step_ms"]["p90"]
    if figures["memory_mib"] is not None:
        assert figures["memory_mib"]["peak"] >= figures["memory_mib"]["before"] > 0
    text = fit_text(figures)
    assert "20000 splats, 1 actors" in text and "whole step" in text and "backward" in text


def test_a_scene_without_images_is_refused(monkeypatch):
    bare = Scene("s", "test:s", random_gaussians(3), (), ConstantSky(torch.zeros(3)), ())
    monkeypatch.setattr(bench, "open_scene", lambda uri: bare)
    with pytest.raises(ClimateGSError, match="no recorded images"):
        bench_fit("procedural:street", progress=False)


def test_thinning_keeps_scenes_that_are_small_enough(monkeypatch):
    sky = ConstantSky(torch.zeros(3))
    scene = Scene("s", "test:s", random_gaussians(50), (), sky, ())
    assert bench._thinned(scene) is scene
    monkeypatch.setattr(bench, "SPLATS", 20)
    thinned = bench._thinned(scene)
    assert splat_count(thinned) == 20
    assert torch.equal(thinned.background.means[[0, -1]], scene.background.means[[0, -1]])
