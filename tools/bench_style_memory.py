"""Memory that one styled frame takes on top of its scene, in a process of its own.

See tools.bench_memory for why, and for what is counted. The frame is drawn once small before the
mark is set, so that kernels are loaded, the maps are found and the sky is at hand; the styled sky
is the scene's from then on, and counts for both.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
from typing import Any

from augment.scene import Scene
from tools.bench_memory import RESET_PEAK, extra_mib, measured_apart

SMALL = 0.125
RUNS = 3  # of each, in turns: threads that meet otherwise take some MiB more or less


def bench_memory(scene: Scene, uri: str, width: int, preset: str) -> dict[str, float] | None:
    """MiB above the scene at the highest moment of a clean and of a styled frame, medians, and
    their ratio; the scene's own, and the ratio with it in both. None where the system cannot tell.

    Raises:
        RuntimeError: a measuring process failed; the message is what it wrote.
    """
    if not RESET_PEAK.is_file():
        return None
    found: dict[str | None, list[float]] = {None: [], preset: []}
    for _ in range(RUNS):
        for name, each in found.items():
            arguments = {"uri": uri, "width": width, "preset": name}
            each.append(measured_apart("tools.bench_style_memory", arguments, "a style"))
    clean, styled = (statistics.median(each) for each in found.values())
    own = scene_mib(scene)
    return {
        "scene_mib": own,
        "clean_mib": clean,
        "styled_mib": styled,
        "ratio": styled / clean,
        "whole_ratio": (own + styled) / (own + clean),
    }


def scene_mib(scene: Scene) -> float:
    """Of the Gaussians alone."""
    parts = scene.all_gaussians
    tensors = [getattr(part, field.name) for part in parts for field in dataclasses.fields(part)]
    return sum(t.numel() * t.element_size() for t in tensors if t is not None) / 2**20


def _render_once(uri: str, width: int, preset: Any) -> float:
    from adapters.base import open_scene
    from augment.plan import make_plan
    from augment.views import render_buffers
    from recipes.schema import Recipe
    from recipes.weather import Style
    from tools.bench_flood_error import PICTURE_ONLY
    from tools.bench_style_cost import front_camera

    scene = open_scene(uri)
    camera = front_camera(scene, width)
    style = None if preset is None else Style(preset=preset)
    plan = make_plan(Recipe(style=style, output=PICTURE_ONLY), scene)
    render_buffers(scene, camera.scaled(SMALL), plan)
    return extra_mib(lambda: render_buffers(scene, camera, plan))


if __name__ == "__main__":
    print(_render_once(**json.loads(sys.argv[1])))
