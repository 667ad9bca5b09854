"""Memory that one styled frame takes on top of its scene, in a process of its own.

See tools.bench_memory for why, and for what is counted. The frame is drawn once small before the
mark is set, so that kernels are loaded, the maps are found and the sky is at hand; the styled sky
is the scene's from then on, and counts for both.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from tools.bench_memory import RESET_PEAK, extra_mib, measured_apart

SMALL = 0.125


def bench_memory(uri: str, width: int, preset: str) -> dict[str, float] | None:
    """MiB above the scene at the highest moment of a clean and of a styled frame, and their ratio;
    None where the system cannot tell.

    Raises:
        RuntimeError: a measuring process failed; the message is what it wrote.
    """
    if not RESET_PEAK.is_file():
        return None
    clean, styled = (
        measured_apart(
            "tools.bench_style_memory", {"uri": uri, "width": width, "preset": name}, "a style"
        )
        for name in (None, preset)
    )
    return {"clean_mib": clean, "styled_mib": styled, "ratio": styled / clean}


def _render_once(uri: str, width: int, preset: Any) -> float:
    from adapters.base import open_scene
    from augment.apply import render_buffers
    from augment.plan import make_plan
    from recipes.schema import Recipe
    from recipes.style import Style
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
