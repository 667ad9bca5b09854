"""Frames under two plans in turns, so that what the machine does meanwhile falls on both."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence

from augment.cameras import Camera
from augment.plan import Plan
from augment.scene import Scene
from augment.views import render_buffers
from tools.bench.raster import Spread


def spread(values: Sequence[float]) -> dict[str, float]:
    """Least, median and 90 %, as plain numbers."""
    return dataclasses.asdict(Spread.of(values))


def spread_ms(seconds: Sequence[float]) -> dict[str, float]:
    """The same of seconds, in milliseconds."""
    return spread([1e3 * s for s in seconds])


def spread_ratio(over: Sequence[float], under: Sequence[float]) -> dict[str, float]:
    """Of ratios taken pair by pair."""
    return spread([o / u for o, u in zip(over, under, strict=True)])


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
