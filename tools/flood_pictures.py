"""Pictures of floods for the docs: levels, waves and tiers, with time and error under each."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from adapters.base import open_scene
from augment.cameras import Camera
from augment.plan import make_plan
from augment.render.composite import quantise
from augment.scene import Scene
from augment.views import WeatheredBuffers, render_buffers
from recipes.schema import Output, Recipe, Weather
from recipes.weather import Flood, Waves
from tools.bench_flood_error import inside
from tools.drawing import captioned, strip, write_jpeg

STREET = "procedural:street?seed=3"
CAMERA, FRAME, SCALE = "front", 5, 0.6
REPEATS = 5
LEVELS = {"kerb": 0.08, "knee": 0.4, "waist": 1.1}
TIERS = ("sky", "screen_space", "mirrored")


def draw_flood_pictures(folder: Path) -> list[Path]:
    """Three JPEGs of three pictures each: flood-levels, flood-waves, flood-tiers."""
    scene = open_scene(STREET)
    camera = scene.frame(FRAME).cameras[CAMERA].scaled(SCALE)
    rows = {
        "flood-levels": {
            f"{name}: {level:g} m above the road": Flood(level_m=level, turbidity_ntu=30)
            for name, level in LEVELS.items()
        },
        "flood-waves": {
            f"waves: {preset}": Flood(level_m=0.3, turbidity_ntu=30, waves=Waves(preset=preset))
            for preset in ("calm", "breeze", "wind")
        },
        "flood-tiers": {
            f"reflection: {tier}": Flood(level_m=0.3, turbidity_ntu=30, reflection=tier)
            for tier in TIERS
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, floods in tqdm(rows.items(), unit="row"):
        panels = [_panel(scene, camera, title, flood) for title, flood in floods.items()]
        paths.append(folder / f"{name}.jpg")
        write_jpeg(paths[-1], strip(panels))
    return paths


def _panel(scene: Scene, camera: Camera, title: str, flood: Flood) -> np.ndarray:
    """A picture with its title, its time beside the clean frame's, and its error under it."""
    dry_s, _ = _timed(scene, camera, None)
    wet_s, wet = _timed(scene, camera, flood)
    text = f"{wet_s * 1000:.0f} ms, {wet_s / dry_s:.2f} x the clean frame"
    if flood.reflection != "mirrored":
        _, truth = _timed(scene, camera, flood.model_copy(update={"reflection": "mirrored"}))
        text += f"; {_psnr(wet, truth):.1f} dB to mirrored"
    else:
        text += "; the reference"
    return captioned(quantise(wet.rgb), title, text)


def _timed(scene: Scene, camera: Camera, flood: Flood | None) -> tuple[float, WeatheredBuffers]:
    """Least seconds of a few frames after one that is not counted, and the frame."""
    recipe = Recipe(weather=Weather(flood=flood), output=Output(depth="none", labels=False))
    plan = make_plan(recipe, scene)
    frame = render_buffers(scene, camera, plan)
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        frame = render_buffers(scene, camera, plan)
        seconds.append(time.perf_counter() - started)
    return min(seconds), frame


def _psnr(one: WeatheredBuffers, other: WeatheredBuffers) -> float:
    """Of the 8-bit pictures where both show water, away from its rim."""
    assert one.water is not None
    mask = inside(one.water.numpy())
    difference = quantise(one.rgb)[mask].astype(float) - quantise(other.rgb)[mask]
    return float(10 * np.log10(255**2 / np.mean(difference**2)))
