"""Memory that one flooded frame takes on top of its scene, in a process of its own.

See tools.bench_memory for why, and for what is counted. The frame is drawn once small before the
mark is set, so that kernels are loaded and the sky is at hand.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from tools.bench_memory import RESET_PEAK, extra_mib, measured_apart

SMALL = 0.125


def flood_peak_mib(uri: str, width: int, height: int, tier: str | None) -> float | None:
    """MiB above the scene at the highest moment of one frame; tier None is the clean frame; the
    answer is None where the system cannot tell.

    Raises:
        RuntimeError: the measuring process failed; the message is what it wrote.
    """
    if not RESET_PEAK.is_file():
        return None
    arguments = {"uri": uri, "width": width, "height": height, "tier": tier}
    return measured_apart("tools.bench_flood_memory", arguments, "a flood")


def _render_once(uri: str, width: int, height: int, tier: Any) -> float:
    from adapters.base import open_scene
    from augment.plan import make_plan
    from augment.views import render_buffers
    from recipes.schema import Recipe
    from tools.bench_flood_cost import bench_camera
    from tools.bench_flood_error import PICTURE_ONLY, flood_recipe

    scene = open_scene(uri)
    camera = bench_camera(scene, width, height)
    recipe = Recipe(output=PICTURE_ONLY) if tier is None else flood_recipe(tier, "calm")
    plan = make_plan(recipe, scene)
    render_buffers(scene, camera.scaled(SMALL), plan)
    return extra_mib(lambda: render_buffers(scene, camera, plan))


if __name__ == "__main__":
    print(_render_once(**json.loads(sys.argv[1])))
