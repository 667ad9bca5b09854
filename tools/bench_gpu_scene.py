"""What a GPU does once for a scene: a style's map on all its colours, and a place for snow."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import torch

from augment.effects.snow.placement import place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.style.color_maps import style_gaussians
from augment.render.cuda.runtime import gpu_device
from augment.scene import Gaussians, Scene
from recipes.weather import Snow
from tools.bench_gpu_ceilings import Ceilings
from tools.bench_pairs import spread
from tools.bench_scene import RasterCase, random_scene
from tools.bench_style_cost import some_maps
from tools.gpu_clock import Timing, peak_gpu_mib, times_in_turns

BACKEND = "cuda"
PLACEMENTS = 3  # that count


def bench_fold(case: RasterCase, timing: Timing, ceilings: Ceilings) -> dict[str, Any]:
    """Milliseconds of folding one map and writing the mapped SH of random Gaussians, of degree 3,
    from and into the GPU's memory.
    """
    gaussians = on_gpu(random_scene(case)[0])
    out = torch.empty_like(gaussians.sh)
    maps = some_maps(1)
    moved = 2 * out.numel() * out.element_size()

    def fold() -> None:
        style_gaussians(gaussians, maps, out=out, backend=BACKEND)

    fold()
    ms = times_in_turns({"fold": fold}, timing)["fold"]
    floor = ceilings.ms(moved)
    return {
        "gaussians": len(gaussians),
        "repeats": timing.repeats,
        "ms": spread(ms),
        "floor": {"bytes": moved, "blends": 0, "ms": {"frame": floor}},
    }


def on_gpu(gaussians: Gaussians) -> Gaussians:
    device = gpu_device()
    fields = {f.name: getattr(gaussians, f.name) for f in dataclasses.fields(gaussians)}
    moved = {k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in fields.items()}
    return dataclasses.replace(gaussians, **moved)


def bench_gpu_placement(scene: Scene, uri: str, *, cell_m: float = 0.05) -> dict[str, Any]:
    """Seconds of finding where snow can lie, for all cameras of the scene, on the host's clock;
    after one that compiles.
    """
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    settings = placement_settings(Snow(depth_m=0, cell_m=cell_m))
    wholes, stages = [], []
    bed = place_snow_support(scene, cameras, settings, backend=BACKEND)
    for _ in range(PLACEMENTS):
        start = time.perf_counter()
        bed = place_snow_support(scene, cameras, settings, backend=BACKEND)
        wholes.append(time.perf_counter() - start)
        stages.append(bed.seconds)
    memory = peak_gpu_mib(lambda: place_snow_support(scene, cameras, settings, backend=BACKEND))
    return {
        "scene": scene.name,
        "uri": uri,
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "cameras": len(cameras),
        "cell_m": cell_m,
        "cells": len(bed.ground),
        "repeats": PLACEMENTS,
        "place_s": spread(wholes),
        "stages_s": {name: spread([each[name] for each in stages]) for name in stages[0]},
        "peak_mib": None if memory is None else memory[0],
    }
