"""`climategs demo`: the embedded street under five recipes, with pictures."""

from __future__ import annotations

import time
from pathlib import Path

from adapters.base import open_scene
from adapters.scene_cache import scene_digest
from augment.jobs.render_job import RenderJob, run_job
from recipes.load import load_recipe
from tools.output import compiling_noted, print_note
from tools.sheet import draw_sheet, draw_video
from tools.warm_up import kernel_modules, warm_up

DEMO_RECIPES = ("clear", "dense-fog", "street-flood", "fresh-snow", "evening")
DEMO_CAMERA = "front"  # the one that is shown as a video


def run_demo(out: Path, frames: int) -> int:
    """Render the embedded street under five recipes, with pictures. Return the exit code."""
    start_s = time.perf_counter()
    uri = f"procedural:street?seed=3&frames={frames}"
    print_note(f"building {uri}")
    recipes = [load_recipe(name).resolve(0) for name in DEMO_RECIPES]
    with compiling_noted(kernel_modules(recipes, of_street=True)):
        scene = open_scene(uri)
        warm_up(recipes)
    ready_s = time.perf_counter()
    job = RenderJob(uri, recipes, out, source_digest=scene_digest(uri))
    result = run_job(job, scene_loader=lambda _uri: scene)
    for failure in result.failures:
        print_note(f"failed: {failure}")
    pictures = [draw_sheet(out), draw_video(out, DEMO_CAMERA, frames_per_second=5)]
    end_s = time.perf_counter()
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed: "
        f"{ready_s - start_s:.0f} s to build and compile, "
        f"{end_s - ready_s:.0f} s to render and draw"
    )
    print(f"images, depth, labels, LiDAR: {out}")
    print(f"contact sheet:                {pictures[0]}")
    print(f"video, variants side by side: {pictures[1]}")
    return 1 if result.failed else 0
