"""What finding a place for snow costs: seconds by stage, file, memory; and laying it anew."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from augment.effects.snow.cells import SnowSupport
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.light import illumination_of
from augment.effects.snow.placement import place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import bed_key, load_bed, remember_support, save_bed
from augment.render.buffers import AUTO
from augment.scene import Scene
from recipes.weather import Snow
from tools.bench_memory import RESET_PEAK, extra_mib, measured_apart
from tools.bench_pairs import spread

PLACEMENTS = 3  # that count
DEPTHS_M = (0.05, 0.1, 0.3)  # laid in turns


def bench_placement(
    scene: Scene, *, cell_m: float = 0.05, repeats: int = 7, backend: str = AUTO
) -> dict[str, Any]:
    """Seconds of the bed of all cameras and of the snow on it; remembers the bed for the scene.
    backend: that places it.
    """
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    settings = placement_settings(Snow(depth_m=0, cell_m=cell_m))
    wholes, stages = [], []
    bed = place_snow_support(scene, cameras, settings, backend=backend)
    for _ in range(min(repeats, PLACEMENTS)):
        start = time.perf_counter()
        bed = place_snow_support(scene, cameras, settings, backend=backend)
        wholes.append(time.perf_counter() - start)
        stages.append(bed.seconds)
    remember_support(scene, settings, bed)
    return {
        "cameras": len(cameras),
        "cell_m": cell_m,
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "place_s": spread(wholes),
        "stages_s": {name: spread([each[name] for each in stages]) for name in stages[0]},
        "cells": len(bed.ground),
        "vehicles": len(bed.actors),
        "vehicle_cells": sum(len(cells) for cells in bed.actors.values()),
        "buried": len(bed.ground.buried),
        "lay": {shading: _lay(scene, bed, shading, repeats) for shading in SHADINGS},
        "file": _file(scene, bed, cameras, settings),
    }


SHADINGS = ("per_splat", "per_pixel")


def _lay(scene: Scene, bed: SnowSupport, shading: Any, repeats: int) -> dict[str, Any]:
    """Snow of depths in turns on a bed that snow was laid on before."""
    seconds, gaussians = [], 0
    for repeat in range(repeats + 1):
        snow = Snow(depth_m=DEPTHS_M[repeat % len(DEPTHS_M)], shading=shading)
        start = time.perf_counter()
        light = illumination_of(scene, snow)
        cover = build_snow_layer(bed, scene, snow, light, seed=0)
        seconds.append(time.perf_counter() - start)
        gaussians = len(cover.ground.gaussians) + sum(
            len(layer.gaussians) for layer in cover.actors.values()
        )
    return {"seconds": spread(seconds[1:]), "gaussians": gaussians}


def _file(scene: Scene, bed: SnowSupport, cameras: Any, settings: Any) -> dict[str, float]:
    start = time.perf_counter()
    key = bed_key(scene, cameras, settings)
    keyed = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bed.safetensors"
        save_bed(path, bed, key)
        saved = time.perf_counter()
        load_bed(path, key)
        loaded = time.perf_counter()
        size = path.stat().st_size
    return {
        "mib": size / 2**20,
        "key_s": keyed - start,
        "save_s": saved - keyed,
        "load_s": loaded - saved,
    }


def placement_peak_mib(uri: str, cell_m: float) -> float | None:
    """MiB above the scene at the highest moment of placement, in a process of its own; None where
    the system cannot tell.

    Raises:
        RuntimeError: the measuring process failed; the message is what it wrote.
    """
    if not RESET_PEAK.is_file():
        return None
    arguments = {"uri": uri, "cell_m": cell_m}
    return measured_apart("tools.bench_snow_placement", arguments, "placement")


def _place_once(uri: str, cell_m: float) -> float:
    from adapters.base import open_scene

    scene = open_scene(uri)
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    coarse = placement_settings(Snow(depth_m=0, cell_m=10 * cell_m))
    place_snow_support(scene, cameras[:1], coarse)  # loads the kernels
    settings = placement_settings(Snow(depth_m=0, cell_m=cell_m))
    return extra_mib(lambda: place_snow_support(scene, cameras, settings))


if __name__ == "__main__":
    print(_place_once(**json.loads(sys.argv[1])))
