"""`climategs demo`: the embedded street under five recipes, and pictures of it."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from adapters.base import open_scene
from augment.jobs.render_job import RenderJob, run_job
from recipes.load import load_recipe
from tools.pictures import draw_sheet, draw_video
from tools.warm_up import warm_up, warming_up_beside

RECIPES = ("clear", "dense-fog", "street-flood", "fresh-snow", "evening")
CAMERA = "front"  # the one that is shown as a video


def run_demo(out: Path, frames: int) -> int:
    """Renders, draws, prints where the pictures are. Returns the exit code."""
    started = time.perf_counter()
    uri = f"procedural:street?seed=3&frames={frames}"
    print(f"building {uri} and compiling the kernels (kept for the next run)", file=sys.stderr)
    recipes = [load_recipe(name).resolve(0) for name in RECIPES]
    with warming_up_beside(recipes):
        scene = open_scene(uri)
        warm_up(recipes)
    ready = time.perf_counter()
    job = RenderJob(scene_uri=uri, recipes=recipes, out_dir=out)
    result = run_job(job, scene_loader=lambda _uri: scene)
    for failure in result.failures:
        print(f"failed: {failure}", file=sys.stderr)
    pictures = [draw_sheet(out), draw_video(out, CAMERA, frames_per_second=5)]
    done = time.perf_counter()
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed: "
        f"{ready - started:.0f} s to build and compile, {done - ready:.0f} s to render and draw"
    )
    print(f"images, depth, labels, LiDAR: {out}")
    print(f"contact sheet:                {pictures[0]}")
    print(f"video, variants side by side: {pictures[1]}")
    return 1 if result.failed else 0
