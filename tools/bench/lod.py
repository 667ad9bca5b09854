"""`climategs bench lod`: levels of detail on a long street.

`measure` compares a view down the whole street with the same view of its nearest 100 m alone:
time, memory, and the pictures' errors.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import time
from pathlib import Path

import numpy as np

from adapters.base import open_scene
from adapters.street.long_street import write_long_street
from augment.metrics.image import flip, psnr
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, RGB, RenderOutput
from augment.render.composite import composite_sky, to_bytes
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians, Scene
from tools.bench.harness import (
    Figures,
    Table,
    WallClock,
    figures,
    machine_facts,
    median_ms,
    rounds,
    run_in_subprocess,
    spread_ratio,
    status_mib,
)
from tools.bench.scenes import front_name

BUFFERS = (RGB, ALPHA, MEDIAN_DEPTH)  # The buffers that are drawn.
NEAR_M = 100.0  # The largest distance from the camera of the street's nearest part, metres.
SIZES_PX = (0.5, 1.0, 2.0)  # The values of lod_px that are measured, pixels.
NEAR = f"nearest {NEAR_M:.0f} m alone"  # The row of the nearest part without levels.
FULL = "everything"  # The row of the whole street without levels.
# The columns of the table of views. Times are of the processor, whatever else runs.
COLUMNS = ("drawn", "ms", "over the nearest 100 m", "least", "p90", "FLIP", "PSNR")
WITHIN_S = 900.0  # The longest time of the process whose memory is measured, seconds.


def measure(quick: bool = False, repeats: int = 7, scene: str | None = None) -> Figures:
    """Measure views, memory and levels of a long street.

    Args:
        quick: True for a street of 200 metres instead of a kilometre.
        repeats: The number of rounds that count.
        scene: The address of a large scene. By default a street is written: a kilometre of 20
            million splats, or if quick 200 metres of about 100,000.
    """
    if scene is not None:
        return _measure(scene, repeats)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "street"
        stretches, splats = (2, 60_000) if quick else (10, 2_000_000)
        write_long_street(folder, stretches=stretches, gaussians=splats)
        return _measure(f"scene:{folder}", repeats)


def first_camera(scene: Scene) -> Camera:
    """Return the front camera where the drive begins: the whole street lies before it."""
    cameras = scene.frames[0].cameras
    return cameras[front_name([*cameras])]


def nearest_part(scene: Scene, camera: Camera) -> Scene:
    """Return the scene with only the splats within NEAR_M of the camera, with new levels."""
    distance_m = (scene.background.means - camera.centre.float()).norm(dim=1)
    return dataclasses.replace(scene, background=scene.background.select(distance_m < NEAR_M))


def _draw(scene: Scene, camera: Camera, lod_px: float) -> RenderOutput:
    """Draw the background. lod_px: the size in pixels from which levels are used, 0 for never."""
    parts = [PosedGaussians(scene.background)]
    return rasterize(parts, camera, buffers=BUFFERS, settings=RasterSettings(lod_px=lod_px))


def _picture(scene: Scene, camera: Camera, lod_px: float) -> np.ndarray:
    """Return the picture of the background and the sky, uint8 [H, W, 3]."""
    rendered = _draw(scene, camera, lod_px)
    assert rendered.rgb is not None and rendered.alpha is not None
    return to_bytes(composite_sky(rendered.rgb, rendered.alpha, camera, scene.sky)).numpy()


class ProcessorClock(WallClock):
    """A clock of the processor time of this process's threads, whatever else runs."""

    def mark(self) -> float:
        return time.process_time()


def _measure(uri: str, repeats: int) -> Figures:
    """Measure a scene with levels at an address."""
    machine = machine_facts()
    memory = [[f"{px:g}" if px else "off", _memory(uri, px)] for px in (1.0, 0.0)]
    full_scene = open_scene(uri)
    camera = first_camera(full_scene)
    near_scene = nearest_part(full_scene, camera)
    cases = {NEAR: (near_scene, 0.0), FULL: (full_scene, 0.0)}
    cases |= {f"lod_px {px:g}": (full_scene, px) for px in SIZES_PX}
    actions = {
        name: functools.partial(_draw, case_scene, camera, px)
        for name, (case_scene, px) in cases.items()
    }
    seconds = rounds(actions, repeats, clock=ProcessorClock())
    truth = _picture(full_scene, camera, 0.0)
    rows = []
    for name, (_, px) in cases.items():
        errors = [None, None]
        if px > 0:
            picture = _picture(full_scene, camera, px)
            is_same = np.array_equal(picture, truth)
            errors = [flip(picture, truth), None if is_same else psnr(picture, truth)]
        ratio = spread_ratio(seconds[name], seconds[NEAR]).values()
        rows.append([name, median_ms(seconds[name]), *ratio, *errors])
    size = f"{len(full_scene.background):,} Gaussians, {camera.width}x{camera.height}"
    note = f"{len(near_scene.background):,} Gaussians within {NEAR_M:g} m"
    tables = [
        Table(f"Views: {full_scene.name}, {size}", COLUMNS, rows, note),
        Table("Most memory of a process that draws this view", ("lod_px", "MiB"), memory),
    ]
    return figures("lod", tables, machine=machine)


def _memory(uri: str, lod_px: float) -> float:
    """Return the peak MiB of a fresh process that opens a scene and draws a view."""
    memory_figures = run_in_subprocess(_measure_memory, (uri, lod_px), WITHIN_S)
    if "most" not in memory_figures:
        raise RuntimeError(f"measuring the memory of {uri} failed: {memory_figures}")
    return memory_figures["most"]


def _measure_memory(uri: str, lod_px: float) -> Figures:
    """Open a scene, draw a view, and return this process's peak of memory, MiB."""
    scene = open_scene(uri)
    _draw(scene, first_camera(scene), lod_px)
    return {"most": status_mib("VmHWM")}
