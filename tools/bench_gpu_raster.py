"""The GPU rasteriser on the random scene: frames, stages, memory, bits; gsplat beside."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.effects.smog import SmogMedium
from augment.render.buffers import ALPHA, RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cuda.splats import GpuStageTimer
from augment.scene import Gaussians, PosedGaussians
from tools.bench_gpu_ceilings import Ceilings
from tools.bench_gpu_gsplat import gsplat_draws
from tools.bench_pairs import spread, spread_ratio
from tools.bench_scene import RasterCase, random_scene
from tools.gpu_clock import Timing, host_times_ms, peak_gpu_mib, times_in_turns

BUFFERS = frozenset({RGB, ALPHA})
SETTINGS = RasterSettings()
SMOG = SmogMedium(sigma_per_m=0.03, rgb=(0.7, 0.72, 0.75))
FLIP = 1e-3  # a pixel off by more lies on the other side of a cut-off
CLEAN, WITH_SMOG = "clean", "smog"


def bench_gpu_case(case: RasterCase, timing: Timing, ceilings: Ceilings) -> dict[str, Any]:
    """One size of the random scene. Times are milliseconds on the GPU, from the call's first work
    to the finished images there; host_ms until the host has seen the end of it.
    """
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    frames = {CLEAN: lambda: draw(parts, camera), WITH_SMOG: lambda: draw(parts, camera, SMOG)}
    start = time.perf_counter()
    for frame in frames.values():
        frame()
    timing.clock.wait()
    first_frames_s = time.perf_counter() - start
    memory = peak_gpu_mib(frames[CLEAN])  # before gsplat's copy of the scene lies there, too
    found: dict[str, Any] = {
        "case": case.name,
        "gaussians": len(gaussians),
        "repeats": timing.repeats,
        "first_frames_s": first_frames_s,
        "scene_mib": gaussians.nbytes / 2**20,
        "peak_mib": None if memory is None else memory[0],
        "frame_mib": None if memory is None else memory[1],
        "stages_ms": stage_times(parts, camera, timing),
        "host_ms": spread(host_times_ms(frames[CLEAN], timing)),
        "same_bits": same_bits(frames[CLEAN](), frames[CLEAN]()),
        "floor": _floor(parts, camera, ceilings),
    }
    return found | _beside_gsplat(frames, gaussians, camera, timing)


def draw(
    parts: list[PosedGaussians],
    camera: Camera,
    smog: SmogMedium | None = None,
    clock: GpuStageTimer | None = None,
) -> RenderOutput:
    from augment.render.cuda import driver as cuda

    return cuda.rasterize_cuda(parts, camera, BUFFERS, SETTINGS, smog, clock=clock)


def stage_times(
    parts: list[PosedGaussians], camera: Camera, timing: Timing
) -> dict[str, dict[str, float]]:
    """Milliseconds of the rasteriser's stages, in frames of their own."""
    times: dict[str, list[float]] = defaultdict(list)
    for turn in range(timing.warm_up + timing.repeats):
        clock = GpuStageTimer()
        draw(parts, camera, clock=clock)
        if turn >= timing.warm_up:
            for name, ms in clock.milliseconds().items():
                times[name].append(ms)
    return {name: spread(values) for name, values in times.items()}


def _floor(parts: list[PosedGaussians], camera: Camera, ceilings: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_floor import Floor, noted_passes

    with noted_passes() as passes:
        draw(parts, camera)
    floor = Floor()
    for seen in passes:
        floor.add_pass(seen)
    return floor.as_dict(ceilings)


def _beside_gsplat(
    frames: dict[str, Any], gaussians: Gaussians, camera: Camera, timing: Timing
) -> dict[str, Any]:
    """Times of our frames, in turns with gsplat's where it can be had, and ratios turn by turn."""
    draws = gsplat_draws(gaussians, camera)
    others = {} if isinstance(draws, str) else {f"gsplat, {k}": d for k, d in draws.items()}
    ms = times_in_turns(frames | others, timing)
    found: dict[str, Any] = {
        "ms": {name: spread(values) for name, values in ms.items()},
        "smog_over_clean": spread_ratio(ms[WITH_SMOG], ms[CLEAN]),
    }
    if isinstance(draws, str):
        return {**found, "gsplat": {"left_out": draws}}
    fastest = min(others, key=lambda name: statistics.median(ms[name]))
    ours = draw([PosedGaussians(gaussians)], camera).rgb
    assert ours is not None
    found["gsplat"] = {
        "way": fastest,
        "ratio": spread_ratio(ms[CLEAN], ms[fastest]),
        "rgb": difference(ours, others[fastest]()),
    }
    return found


@torch.no_grad()
def case_agreement(case: RasterCase) -> dict[str, Any]:
    """How far the GPU's colours are from the CPU backend's, without and with smog."""
    from augment.render.cpu.driver import rasterize_cpu

    gaussians, camera = random_scene(case)
    parts, found = [PosedGaussians(gaussians)], {}
    for name, smog in ((CLEAN, None), (WITH_SMOG, SMOG)):
        right = rasterize_cpu(parts, camera, BUFFERS, SETTINGS, smog).rgb
        own = draw(parts, camera, smog).rgb
        assert right is not None and own is not None
        found[name] = difference(own, right)
    return found


def difference(own: Tensor, right: Tensor) -> dict[str, float]:
    """Of rgb [H, W, 3], the largest of a pixel's channels: what 99.9 % stay below, the most, and
    how many pixels are off by more than FLIP.
    """
    error = (own.detach().cpu() - right.detach().cpu()).abs().amax(-1).numpy()
    return {
        "p999": float(np.quantile(error, 0.999)),
        "max": float(error.max()),
        "flipped": int((error > FLIP).sum()),
        "pixels": int(error.size),
    }


def same_bits(first: RenderOutput, second: RenderOutput) -> bool:
    pairs = [(getattr(first, name), getattr(second, name)) for name in sorted(BUFFERS)]
    return all(torch.equal(a.cpu(), b.cpu()) for a, b in pairs)
