"""Levels of detail on a long street: a view over its nearest 100 m alone, memory, and accuracy."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adapters.base import open_scene
from adapters.street.long_street import write_long_street
from augment.cameras import Camera
from augment.lod import levels_of
from augment.metrics.image import flip, psnr
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, RGB, RenderOutput
from augment.render.composite import composite_sky, to_bytes
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
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

BUFFERS = (RGB, ALPHA, MEDIAN_DEPTH)
NEAR_M = 100.0
SIZES_PX = (0.5, 1.0, 2.0)
NEAR = f"nearest {NEAR_M:.0f} m alone"
FULL = "everything"
COLUMNS = ("drawn", "ms", "ms of the processor", "over the nearest 100 m", "least", "p90",
           "FLIP", "PSNR")  # fmt: skip
WITHIN_S = 900.0


def measure(quick: bool = False, repeats: int = 7, scene: str | None = None) -> Figures:
    """scene: a large scene; by default a kilometre of 20 million splats is written, or, quick, 200
    metres of 100,000.
    """
    if scene is not None:
        return _measure(scene, repeats)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "street"
        stretches, splats = (2, 60_000) if quick else (10, 2_000_000)
        write_long_street(folder, stretches=stretches, gaussians=splats)
        return _measure(f"scene:{folder}", repeats)


def first_camera(scene: Scene) -> Camera:
    """Ahead, where the drive begins: the whole street lies before it."""
    cameras = scene.frames[0].cameras
    return cameras[front_name([*cameras])]


def nearest(scene: Scene, camera: Camera) -> Scene:
    """The scene without what is further than NEAR_M from the camera; its levels made anew."""
    away = (scene.background.means - camera.centre.float()).norm(dim=1)
    return dataclasses.replace(scene, background=scene.background.select(away < NEAR_M))


def _draw(scene: Scene, camera: Camera, lod_px: float) -> RenderOutput:
    parts = [PosedGaussians(scene.background)]
    return rasterize(parts, camera, buffers=BUFFERS, settings=RasterSettings(lod_px=lod_px))


def _picture(scene: Scene, camera: Camera, lod_px: float) -> np.ndarray:
    rendered = _draw(scene, camera, lod_px)
    assert rendered.rgb is not None and rendered.alpha is not None
    return to_bytes(composite_sky(rendered.rgb, rendered.alpha, camera, scene.sky)).numpy()


class ProcessorClock(WallClock):
    """Time that this process's threads have had of the processors, whatever else runs."""

    def mark(self) -> float:
        return time.process_time()


def _measure(uri: str, repeats: int) -> Figures:
    machine = machine_facts()
    rows = []
    begun = time.perf_counter()
    memory = [[f"{px:g}" if px else "off", *_memory(uri, px)] for px in (1.0, 0.0)]
    full_scene = open_scene(uri)
    opened_s = time.perf_counter() - begun
    camera = first_camera(full_scene)
    near = nearest(full_scene, camera)
    cases = {NEAR: (near, 0.0), f"{NEAR}, lod_px 1": (near, 1.0), FULL: (full_scene, 0.0)}
    cases |= {f"lod_px {px:g}": (full_scene, px) for px in SIZES_PX}
    actions = {name: functools.partial(_draw, of, camera, px) for name, (of, px) in cases.items()}
    seconds = rounds(actions, repeats)
    busy = rounds(actions, max(repeats // 2, 1), warm_up=0, clock=ProcessorClock())
    truth = _picture(full_scene, camera, 0.0)
    for name, (of, px) in cases.items():
        ratio = spread_ratio(seconds[name], seconds[NEAR]).values()
        errors = [None, None]
        if of is full_scene and px > 0:
            picture = _picture(of, camera, px)
            is_same = np.array_equal(picture, truth)
            errors = [flip(picture, truth), None if is_same else psnr(picture, truth)]
        rows.append([name, median_ms(seconds[name]), median_ms(busy[name]), *ratio, *errors])
    levels = levels_of(full_scene.background)
    sizes = [
        [
            number,
            levels.cell_m(number) if number else None,
            len(level.gaussians),
            len(level.squares),
        ]
        for number, level in enumerate(levels.levels)
    ]
    title = (
        f"Views: {full_scene.name}, {len(full_scene.background):,} Gaussians, "
        f"{camera.width}x{camera.height}"
    )
    tables = [
        Table(title, COLUMNS, rows, f"{len(near.background):,} Gaussians within {NEAR_M:g} m"),
        Table("Memory of a process that opens the scene and draws this view",
              ("lod_px", "opened MiB", "most MiB"), memory),
        Table("Levels", ("level", "cell m", "Gaussians", "squares"), sizes),
    ]  # fmt: skip
    return figures("lod", tables, machine=machine, opened_s=opened_s)


def _memory(uri: str, lod_px: float) -> Sequence[float | None]:
    memory_figures = run_in_subprocess(_memory_of, (uri, lod_px), WITHIN_S)
    if "most" not in memory_figures:
        raise RuntimeError(f"measuring the memory of {uri} failed: {memory_figures}")
    return memory_figures["opened"], memory_figures["most"]


def _memory_of(uri: str, lod_px: float) -> Figures:
    scene = open_scene(uri)
    opened = status_mib("VmRSS")
    _draw(scene, first_camera(scene), lod_px)
    return {"opened": opened, "most": status_mib("VmHWM")}
