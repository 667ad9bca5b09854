"""Frames under two plans in turns, so that what the machine does meanwhile falls on both."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping

from augment.cameras import Camera
from augment.plan import Plan
from augment.scene import Scene
from augment.views import render_buffers
from tools.bench.harness import spread, spread_ms, spread_ratio

__all__ = ["spread", "spread_ms", "spread_ratio", "time_frame", "time_in_turns", "turns"]


def time_frame(scene: Scene, camera: Camera, plan: Plan) -> float:
    """Seconds of one frame as floats."""
    start = time.perf_counter()
    render_buffers(scene, camera, plan)
    return time.perf_counter() - start


def turns(names: Iterable[str], repeat: int) -> list[str]:
    """The names in order, and every other time in the opposite one."""
    order = list(names)
    return order if repeat % 2 else order[::-1]


def time_in_turns(
    scene: Scene, camera: Camera, plans: Mapping[str, Plan], repeats: int
) -> dict[str, list[float]]:
    """Seconds of `repeats` frames under each plan, after one that compiles or loads; every other
    time in the opposite order.
    """
    seconds: dict[str, list[float]] = {name: [] for name in plans}
    for repeat in range(repeats + 1):
        for name in turns(plans, repeat):
            seconds[name].append(time_frame(scene, camera, plans[name]))
    return {name: each[1:] for name, each in seconds.items()}
