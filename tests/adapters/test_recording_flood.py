"""What a job wrote under a flood is a recording like any other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.base import open_scene, recognise
from augment.jobs.render_job import RenderJob, run_job
from augment.scene import Scene
from recipes.schema import Output, Recipe, Weather
from recipes.weather import Flood
from tests.streets import LABELLED_STREET, open_street


@dataclass(frozen=True)
class _Water:
    level_z_m: float
    scene_depth_m: np.ndarray


@dataclass(frozen=True)
class _View:
    rgb: np.ndarray
    depth_m: np.ndarray
    water: np.ndarray | None
    flood: _Water | None
    semantic: None = None
    instance: None = None
    snow: None = None
    snowy: None = None
    smoggy: None = None
    surface: None = None


def _render(scene, camera, recipe, *, backend) -> _View:
    """The same picture in every weather, so that water can differ in its own files alone."""
    shape = (camera.height, camera.width)
    steps = np.arange(camera.width, dtype=np.uint8)[:, None] * np.array([1, 2, 0], np.uint8)
    depth = np.full(shape, 9.0, np.float32)
    is_wet = recipe.weather.flood is not None
    return _View(
        np.ascontiguousarray(np.broadcast_to(steps, (*shape, 3))),
        depth,
        np.full(shape, 255, np.uint8) if is_wet else None,
        _Water(0.4, depth) if is_wet else None,
    )


def _written(source: Scene, out: Path, flood: Flood | None) -> Path:
    output = Output(surface="first", lidar=True)  # the sweeps as they were
    recipe = Recipe(name="any", weather=Weather(flood=flood), output=output)
    job = RenderJob(LABELLED_STREET, [recipe], out)
    result = run_job(job, scene_loader=lambda _: source, renderer=_render, progress=False)
    assert result.failures == ()
    return out / source.name / "any-000"


def test_masks_and_numbers_of_a_flood_change_nothing(tmp_path: Path) -> None:
    source = open_street(LABELLED_STREET)
    dry = _written(source, tmp_path / "dry", None)
    wet = _written(source, tmp_path / "wet", Flood(level_m=0.4))
    assert (wet / "labels" / "water.parquet").is_file() and (wet / "water").is_dir()
    assert recognise(wet) == "recording"
    scenes = [
        open_scene(f"{folder}?image_scale=1&sky_size=32&voxel_m=0.4") for folder in (dry, wet)
    ]
    assert scenes[0].problems == scenes[1].problems
    for name in ("means", "sh", "scales"):
        first, second = (getattr(scene.background, name) for scene in scenes)
        assert len(first) > 100 and torch.equal(first, second)
    for frame in source.frames:
        a, b = (scene.boxes(frame.index) for scene in scenes)
        np.testing.assert_array_equal(a.centers_m, b.centers_m)
        assert list(a.attributes) == list(b.attributes)
