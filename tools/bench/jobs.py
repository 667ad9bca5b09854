"""`climategs bench jobs`: measure what jobs cost and how fast scenes are opened.

`measure` returns four tables.
1. A job beside a loop that renders, encodes and writes the same images. The difference is the cost
   of claims, progress logs, durable files, publishing and the manifest.
2. The cameras of one frame drawn one by one and all at once.
3. A job of 10,000 tiny images. It draws nothing, so that only the job's own work is measured.
4. The opening of scene files.

Worker processes import this module by name.
"""

from __future__ import annotations

import contextlib
import dataclasses
import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapters.base import open_scene
from augment.files.export import export_splats
from augment.files.scene_file import save_scene, save_scene_file
from augment.jobs.block_queue import BlockWork
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.blocks import Block, read_status
from augment.jobs.generate import GenerateJob, Workers, plan_job, run_generate
from augment.jobs.write_pump import WritePump
from augment.output.codecs import encode_depth, encode_image
from augment.output.layout import variant_name
from augment.output.manifest import compact
from augment.output.store import open_store
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Gaussians, Scene
from augment.scene.sky import ConstantSky
from augment.view.render_view import render_view, render_views
from augment.view.results import WeatheredView
from recipes.job import Job, JobRecipes
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Recipe
from recipes.template import RecipeTemplate
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    machine_facts,
    median_ms,
    peak_mib_in_subprocess,
    rounds,
    spread_ratio,
    status_mib,
)
from tools.bench.scenes import RasterCase, random_scene, recipe_of, street_uri

# The settings of all jobs here: without labels and LiDAR, which bare rendering does not make.
PLAIN_OUTPUT = {"output.labels": False, "output.lidar": False}
# The number of images of a block: so small that two workers both have work until the end.
BLOCK_IMAGES = 12
BARE = "a loop: render, encode, write"  # The row of bare rendering.
ONE_BY_ONE = "one by one"  # The mode that draws a rig's cameras one after the other.
AT_ONCE = "at once"  # The mode that draws a rig's cameras together.
# The effects of every weather that a rig is drawn in.
RIG_WEATHERS = {
    "clean": {},
    "smog, 50 m": {"smog": {"visibility_m": 50}},
    "snow": {"snow": {"depth_m": 0.1}},
    "flood": {"flood": {"level_m": 0.15}},
}
TINY_CAMERAS = ("front", "rear")  # The cameras of the tiny scene.
TINY_PERIOD_NS = 100_000_000  # The time between two frames of the tiny scene, nanoseconds.


@dataclass(frozen=True)
class JobsCase:
    """The scenes and sizes that are measured."""

    scene: str = "procedural:street?seed=3&frames=4&width=1600&height=1066"
    """The address of the scene whose images in fog are compared."""
    scale: float = 1.0
    """The scale of those images."""
    variants: int = 3
    """The number of variants of the recipe that are compared."""
    rig: str = street_uri()
    """The address of a scene whose frames have several cameras."""
    rig_scale: float = 1.0
    """The scale of the images of that scene."""
    images: int = 10_000
    """The number of images of the long job."""
    gaussians: int = 1_000_000
    """The number of Gaussians, with SH of degree 3, of the scene that is opened."""
    workers: tuple[int, ...] = (1, 2)
    """The numbers of worker processes with which the compared job runs, one run for each."""
    memory: bool = True
    """True if memory is measured."""


FULL_CASE = JobsCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = JobsCase(
    "procedural:street?seed=3&frames=4", 0.1, rig_scale=0.2, images=500, gaussians=50_000
)


def measure(
    quick: bool = False, scene: str | None = None, repeats: int = 3, case: JobsCase | None = None
) -> Figures:
    """Measure jobs and the opening of scenes.

    Args:
        quick: True for QUICK_CASE.
        scene: The address of a further scene to open.
        repeats: The number of rounds that count.
        case: Scenes and sizes; None for FULL_CASE or QUICK_CASE.
    """
    machine = machine_facts()
    case = case or (QUICK_CASE if quick else FULL_CASE)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        folder = Path(name)
        job_rows = _compare_with_loop(case, folder, repeats)
        rig_rows = _measure_rig(case, max(repeats, 5))
        long_job_figures = _run_long_job(case.images, folder / "long")
        file_rows = _open_files(case, scene, folder, repeats)
    tables = [
        Table(
            "Images of a job beside bare rendering, PNG and depth",
            ("what", "ms an image", "rounds differ by", "images/s", "to bare"),
            job_rows,
            "without starting workers, opening scenes and loading kernels",
        ),
        Table(
            "A frame's cameras drawn at once",
            ("weather", "ms one by one", "ms at once", "to one by one", "MiB one by one", "MiB"),
            rig_rows,
            "8-bit images, one held at a time; MiB: at the highest moment, beyond the scene",
        ),
        Table(
            "A long job of tiny images, one process", ("what", "value"), [*long_job_figures.items()]
        ),
        Table(
            f"Opening {case.gaussians:,} Gaussians; files in memory",
            ("what", "ms", "MiB of Gaussians", "peak memory of it"),
            file_rows,
        ),
    ]
    return figures("jobs", tables, machine=machine)


# ---- beside bare rendering ----------------------------------------------------------------------


def _compare_with_loop(case: JobsCase, folder: Path, repeats: int) -> list[tuple]:
    """Rows of a job in fog, with different executors, beside a loop without a job."""
    template = load_recipe("dense-fog", PLAIN_OUTPUT)
    template = dataclasses.replace(template, variants=case.variants)
    job = _make_job(case.scene, template, folder, scale=case.scale, block_images=BLOCK_IMAGES)
    runs: dict[str, Callable[[Path], float]] = {
        BARE: partial(_run_bare_loop, case.scene, job.recipes),
        "generate, this process": partial(_run_job, job, "serial", 1),
    } | {
        f"generate, {count} processes of their own": partial(_run_job, job, "processes", count)
        for count in case.workers
    }
    seconds: dict[str, list[float]] = {name: [] for name in runs}

    def run(name: str) -> None:
        seconds[name].append(runs[name](folder / f"{[*runs].index(name)}-{len(seconds[name])}"))

    rounds({name: partial(run, name) for name in runs}, repeats)
    bare_ms = median_ms(seconds[BARE][1:])
    # The first run of each is the warm-up round, which does not count.
    return [
        (name, ms, 1e3 * (max(times) - min(times)), 1e3 / ms, ms / bare_ms)
        for name, (_, *times) in seconds.items()
        for ms in [median_ms(times)]
    ]


def _run_bare_loop(uri: str, recipes: JobRecipes, out: Path) -> float:
    """Return the seconds an image of a loop that makes no file durable and records no progress."""
    scene = open_scene(uri)
    views = [
        (recipe, camera, out / variant_name(recipe) / f"{name.replace('/', '_')}-{frame.index}")
        for recipe in recipes.resolve_for_scene(recipes.job.scenes[0], scene.name)
        for frame in scene.frames
        for name, camera in frame.cameras.items()
    ]
    render_view(scene, views[0][1], views[0][0])
    pump = WritePump()
    started = time.perf_counter()
    for recipe, camera, path in views:
        pump.submit(partial(_write, render_view(scene, camera, recipe), path, recipe))
    pump.close()
    return (time.perf_counter() - started) / len(views)


def _write(view: WeatheredView, path: Path, recipe: Recipe) -> None:
    """Encode and write a view's image, and its depth where it has one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if view.depth_m is not None:
        path.with_suffix(".depth.png").write_bytes(encode_depth(view.depth_m))
    path.with_suffix(".png").write_bytes(encode_image(view.rgb, recipe.output))


def _run_job(job: GenerateJob, executor: str, workers: int, out: Path) -> float:
    """Return the seconds an image of a job after all its workers have loaded scene and kernels."""
    setup = dataclasses.replace(job.setup, store_uri=str(out))
    run = dataclasses.replace(job, setup=setup, executor=executor, workers=workers)
    plan = plan_job(run, progress=False)
    with contextlib.closing(Workers(run)) as pool:
        # The first block of each worker loads what it needs; the others are timed.
        loading_work, timed_work = (
            BlockWork(blocks, plan.names, pool.scene_of_slot, _refuse_failure)
            for blocks in (plan.blocks[:workers], plan.blocks[workers:])
        )
        pool.run(loading_work)
        started = time.perf_counter()
        pool.run(timed_work)
        compact(open_store(out))
        seconds = time.perf_counter() - started
    if loading_work.tally.written + timed_work.tally.written != plan.images:
        raise RuntimeError(
            f"the job did not do what is measured: {loading_work.tally}, {timed_work.tally}"
        )
    return seconds / timed_work.tally.written


def _refuse_failure(block: Block, message: str) -> None:
    """Raise an error for a block that failed: its time would be wrong."""
    raise RuntimeError(f"{block.key}: {message}")


def _make_job(
    uri: str,
    template: RecipeTemplate,
    out: Path,
    *,
    scale: float = 1.0,
    block_images: int = 64,
    **setup: Any,
) -> GenerateJob:
    """Return a job of one recipe on one scene. setup: further fields of JobWorkerSetup."""
    fields = {"scenes": ["-"], "recipes": [template.name], "scale": scale}
    job = Job.model_validate({**fields, "block_images": block_images})
    worker_setup = JobWorkerSetup(str(out), None, "auto", **{"open_scene": open_scene, **setup})
    scenes = [job.scenes[0].model_copy(update={"uri": uri})]
    return GenerateJob(JobRecipes(job, {template.name: template}), scenes, worker_setup)


# ---- a rig --------------------------------------------------------------------------------------


def _measure_rig(case: JobsCase, repeats: int) -> list[tuple]:
    """Rows of a frame's cameras, drawn one by one and all at once, in every weather."""
    rows = []
    scene = open_scene(case.rig)
    modes = (ONE_BY_ONE, AT_ONCE)
    for weather in RIG_WEATHERS:
        seconds = rounds(
            {name: _draw_rig(scene, case.rig_scale, weather, name) for name in modes}, repeats
        )
        single_s, together_s = (seconds[mode] for mode in modes)
        rig_arguments = (case.rig, case.rig_scale, weather)
        memory = [
            peak_mib_in_subprocess(_open_and_draw_rig, (*rig_arguments, mode))
            if case.memory
            else None
            for mode in modes
        ]
        ratio = spread_ratio(together_s, single_s)["median"]
        rows.append((weather, median_ms(single_s), median_ms(together_s), ratio, *memory))
    return rows


def _draw_rig(scene: Scene, scale: float, weather: str, mode: str) -> Action:
    """Return an action that draws the cameras of the first frame. mode: ONE_BY_ONE or AT_ONCE."""
    recipe = recipe_of(RIG_WEATHERS[weather])
    cameras = [camera.scaled(scale) for camera in scene.frames[0].cameras.values()]

    def draw() -> None:
        views = (render_view(scene, camera, recipe) for camera in cameras)
        for _ in render_views(scene, cameras, recipe) if mode == AT_ONCE else views:
            pass

    return draw


def _open_and_draw_rig(uri: str, scale: float, weather: str, mode: str) -> Action:
    """Return `_draw_rig` of a scene whose cameras were drawn small before.

    The process so holds the kernels and the snow, which do not count as memory of the action.
    """
    scene = open_scene(uri)
    _draw_rig(scene, 0.1 * scale, weather, ONE_BY_ONE)()
    return _draw_rig(scene, scale, weather, mode)


# ---- a long job of tiny images ------------------------------------------------------------------


def _run_long_job(images: int, out: Path) -> Mapping[str, float]:
    """Run a job of tiny images, and run it again when all is done; return its figures."""
    frames = -(-images // len(TINY_CAMERAS))
    template = parse_recipe("{}", source="tiny", name="tiny", overrides=PLAIN_OUTPUT)
    job = _make_job(f"tiny:{frames}", template, out, open_scene=open_tiny, renderer=render_tiny)
    job = dataclasses.replace(job, executor="serial")
    result = run_generate(job, progress=False)
    resident = status_mib("VmRSS")
    again = run_generate(job, progress=False)
    if (result.written, again.skipped) != (frames * len(TINY_CAMERAS),) * 2:
        raise RuntimeError(f"the job did not do what is measured: {result}, {again}")
    started = time.perf_counter()
    (status,) = read_status(open_store(out))
    status_s = time.perf_counter() - started
    return {
        "images": result.written,
        "blocks": status.blocks,
        "plan, s": result.timings["plan"],
        "first image to last, s": result.timings["render_wall"],
        "an image, ms": 1e3 * result.timings["render_wall"] / result.written,
        "resume when all is done, s": again.timings["plan"] + again.timings["find_finished"],
        "--status, s": status_s,
        "resident at the end, MiB": resident,
        "resident at most, MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def open_tiny(uri: str) -> Scene:
    """Return the scene of the address `tiny:N`: N frames of two cameras, and one splat."""
    mean = torch.zeros(1, 3)
    quat = torch.tensor([[1.0, 0, 0, 0]])
    splat = Gaussians(mean, quat, mean + 0.1, torch.ones(1), torch.zeros(1, 1, 3))
    frames = tuple(map(_tiny_frame, range(int(uri.removeprefix("tiny:")))))
    return Scene(uri, uri, splat, (), ConstantSky(mean[0]), frames)


def _tiny_frame(index: int) -> Frame:
    pose = torch.eye(4, dtype=torch.float64)
    time_ns = index * TINY_PERIOD_NS
    cameras = {n: Camera(n, 32, 18, 20.0, 20.0, 16.0, 9.0, pose, time_ns) for n in TINY_CAMERAS}
    return Frame(index, time_ns, pose, cameras)


def render_tiny(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> WeatheredView:
    """Return a view of one grey that depends on the camera's time, and a depth of 4 m."""
    shade = camera.timestamp_ns // TINY_PERIOD_NS % 256
    rgb = np.full((camera.height, camera.width, 3), shade, np.uint8)
    return WeatheredView(camera, rgb, np.full(rgb.shape[:2], 4.0, np.float32), None, None)


# ---- opening scenes -----------------------------------------------------------------------------


def _open_files(case: JobsCase, uri: str | None, folder: Path, repeats: int) -> list[tuple]:
    """Rows of scene files of every format, and of the scene at `uri` where it is given."""
    gaussians, _ = random_scene(RasterCase(case.gaussians, 1600, 1066))
    scene = dataclasses.replace(open_scene(street_uri(gaussians=60_000)), background=gaussians)
    save_scene(scene, folder / "scene")
    save_scene_file(scene, folder / "scene.climategs")
    save_scene_file(scene, folder / "half.climategs", half=True)
    export_splats(scene, folder / "scene.ply", scene.frames[0].timestamp_ns)
    uris = {
        "gaussians: (.ply)": f"gaussians:{folder / 'scene.ply'}",
        "scene: folder": f"scene:{folder / 'scene'}",
        "scene: file": f"scene:{folder / 'scene.climategs'}",
        "scene: file, half precision": f"scene:{folder / 'half.climategs'}",
    } | ({} if uri is None else {uri: uri})
    seconds = rounds(
        {name: partial(open_scene, scene_uri) for name, scene_uri in uris.items()}, repeats
    )
    rows = []
    for name, scene_uri in uris.items():
        mib = open_scene(scene_uri).gaussian_bytes / 2**20
        peak = peak_mib_in_subprocess(_open_warm, (scene_uri,)) if case.memory else None
        rows.append((name, median_ms(seconds[name]), mib, None if peak is None else peak / mib))
    return rows


def _open_warm(uri: str) -> Action:
    """Return an action that opens a scene in a process that has imported everything for it."""
    open_scene(street_uri(gaussians=60_000))
    with contextlib.suppress(Exception):
        open_scene(f"{uri.partition(':')[0]}:/nowhere")
    return lambda: open_scene(uri)
