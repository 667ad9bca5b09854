"""What jobs cost beside bare rendering, a rig's views drawn at once, a job of 10,000 images, and
opening scenes.

Claims, progress logs, durable files, publishing and the manifest are compared with a loop that
renders, encodes and writes the same images; the long job draws nothing, so that the rest is left.
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
from augment.cameras import Camera, Frame
from augment.files.export import export_ply
from augment.files.scene_file import save_scene, save_scene_file
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.blocks import Block, read_status
from augment.jobs.files import WritePump, encode_depth, encode_image
from augment.jobs.generate import BlockWork, GenerateJob, Workers, plan_job, run_generate
from augment.jobs.layout import variant_name
from augment.jobs.manifest import compact
from augment.jobs.store import open_store
from augment.scene import Gaussians, Scene
from augment.sky import ConstantSky
from augment.views import WeatheredView, render_view, render_views
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

# Labels and LiDAR are left out of the comparison: they are work that bare rendering does not do.
PLAIN = {"output.labels": False, "output.lidar": False}
BLOCK_IMAGES = 12  # several variants in small blocks: both workers have work to the end
BARE = "a loop: render, encode, write"
ONE_BY_ONE, AT_ONCE = "one by one", "at once"
RIG_WEATHERS = {
    "clean": {},
    "smog, 50 m": {"smog": {"visibility_m": 50}},
    "snow": {"snow": {"depth_m": 0.1}},
    "flood": {"flood": {"level_m": 0.15}},
}
TINY_CAMERAS, TINY_PERIOD_NS = ("front", "rear"), 100_000_000


@dataclass(frozen=True)
class JobsCase:
    """scene, scale, variants: of the images in fog that are compared. rig: a scene whose frame has
    several cameras; rig_scale: of their images. images: of the long job.
    gaussians: of the scene that is opened, SH of degree 3. workers: processes of the jobs that are
    compared. memory: whether it is measured.
    """

    scene: str = "procedural:street?seed=3&frames=4&width=1600&height=1066"
    scale: float = 1.0
    variants: int = 3
    rig: str = street_uri()
    rig_scale: float = 1.0
    images: int = 10_000
    gaussians: int = 1_000_000
    workers: tuple[int, ...] = (1, 2)
    memory: bool = True


WHOLE = JobsCase()
QUICK = JobsCase(
    "procedural:street?seed=3&frames=4", 0.1, rig_scale=0.2, images=500, gaussians=50_000
)


def measure(
    quick: bool = False, scene: str | None = None, repeats: int = 3, case: JobsCase | None = None
) -> Figures:
    """scene: another scene that is opened."""
    machine, case = machine_facts(), case or (QUICK if quick else WHOLE)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        folder = Path(name)
        compared = _compare(case, folder, repeats)
        rig = _measure_rig(case, max(repeats, 5))
        long = _run_long_job(case.images, folder / "long")
        opened = _open_files(case, scene, folder, repeats)
    tables = [
        Table(
            "Images of a job beside bare rendering, PNG and depth",
            ("what", "ms an image", "rounds differ by", "images/s", "to bare"),
            compared,
            "without starting workers, opening scenes and loading kernels",
        ),
        Table(
            "A frame's cameras drawn at once",
            ("weather", "ms one by one", "ms at once", "to one by one", "MiB one by one", "MiB"),
            rig,
            "8-bit images, one held at a time; MiB: at the highest moment, beyond the scene",
        ),
        Table("A long job of tiny images, one process", ("what", "value"), [*long.items()]),
        Table(
            f"Opening {case.gaussians:,} Gaussians; files in memory",
            ("what", "ms", "MiB of Gaussians", "peak memory of it"),
            opened,
        ),
    ]
    return figures("jobs", tables, machine=machine)


# ---- beside bare rendering ----------------------------------------------------------------------


def _compare(case: JobsCase, folder: Path, repeats: int) -> list[tuple]:
    template = load_recipe("dense-fog", PLAIN)
    template = dataclasses.replace(template, variants=case.variants)
    job = _job(case.scene, template, folder, scale=case.scale, block_images=BLOCK_IMAGES)
    ways: dict[str, Callable[[Path], float]] = {
        BARE: partial(_bare, case.scene, job.recipes),
        "generate, this process": partial(_generate, job, "serial", 1),
    } | {
        f"generate, {count} processes of their own": partial(_generate, job, "processes", count)
        for count in case.workers
    }
    took: dict[str, list[float]] = {name: [] for name in ways}

    def run(name: str) -> None:
        took[name].append(ways[name](folder / f"{[*ways].index(name)}-{len(took[name])}"))

    rounds({name: partial(run, name) for name in ways}, repeats)
    bare = median_ms(took[BARE][1:])
    return [
        (name, ms, 1e3 * (max(own) - min(own)), 1e3 / ms, ms / bare)
        for name, (_, *own) in took.items()
        for ms in [median_ms(own)]
    ]


def _bare(uri: str, recipes: JobRecipes, out: Path) -> float:
    """Seconds an image of a loop: nothing is durable, nothing remembered."""
    scene = open_scene(uri)
    views = [
        (recipe, camera, out / variant_name(recipe) / f"{name.replace('/', '_')}-{frame.index}")
        for recipe in recipes.resolve_for_scene(recipes.job.scenes[0], scene.name)
        for frame in scene.frames
        for name, camera in frame.cameras.items()
    ]
    render_view(scene, views[0][1], views[0][0])
    pump, started = WritePump(), time.perf_counter()
    for recipe, camera, path in views:
        pump.submit(partial(_write, render_view(scene, camera, recipe), path, recipe))
    pump.close()
    return (time.perf_counter() - started) / len(views)


def _write(view: WeatheredView, path: Path, recipe: Recipe) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if view.depth_m is not None:
        path.with_suffix(".depth.png").write_bytes(encode_depth(view.depth_m))
    path.with_suffix(".png").write_bytes(encode_image(view.rgb, recipe.output))


def _generate(job: GenerateJob, executor: str, workers: int, out: Path) -> float:
    """Seconds an image of a job once all its workers have the scene and their kernels."""
    setup = dataclasses.replace(job.setup, store_uri=str(out))
    run = dataclasses.replace(job, setup=setup, executor=executor, workers=workers)
    plan = plan_job(run, progress=False)
    with contextlib.closing(Workers(run)) as own:
        first, rest = (
            BlockWork(blocks, plan.names, own.scene_of_slot, _refuse_failure)
            for blocks in (plan.blocks[:workers], plan.blocks[workers:])
        )
        own.run(first)
        started = time.perf_counter()
        own.run(rest)
        compact(open_store(out))
        took = time.perf_counter() - started
    if first.tally.written + rest.tally.written != plan.images:
        raise RuntimeError(f"the job did not do what is measured: {first.tally}, {rest.tally}")
    return took / rest.tally.written


def _refuse_failure(block: Block, message: str) -> None:
    raise RuntimeError(f"{block.key}: {message}")


def _job(
    uri: str,
    template: RecipeTemplate,
    out: Path,
    *,
    scale: float = 1.0,
    block_images: int = 64,
    **setup: Any,
) -> GenerateJob:
    fields = {"scenes": ["-"], "recipes": [template.name], "scale": scale}
    job = Job.model_validate({**fields, "block_images": block_images})
    given = JobWorkerSetup(str(out), None, "auto", **{"open_scene": open_scene, **setup})
    scenes = [job.scenes[0].model_copy(update={"uri": uri})]
    return GenerateJob(JobRecipes(job, {template.name: template}), scenes, given)


# ---- a rig --------------------------------------------------------------------------------------


def _measure_rig(case: JobsCase, repeats: int) -> list[tuple]:
    rows, scene, both = [], open_scene(case.rig), (ONE_BY_ONE, AT_ONCE)
    for weather in RIG_WEATHERS:
        seconds = rounds({w: _rig_of(scene, case.rig_scale, weather, w) for w in both}, repeats)
        single, together = (seconds[way] for way in both)
        given = (case.rig, case.rig_scale, weather)
        memory = [
            peak_mib_in_subprocess(_opened_rig, (*given, way)) if case.memory else None
            for way in both
        ]
        ratio = spread_ratio(together, single)["median"]
        rows.append((weather, median_ms(single), median_ms(together), ratio, *memory))
    return rows


def _rig_of(scene: Scene, scale: float, weather: str, way: str) -> Action:
    """Draws the cameras of the first frame."""
    recipe = recipe_of(RIG_WEATHERS[weather])
    cameras = [camera.scaled(scale) for camera in scene.frames[0].cameras.values()]

    def draw() -> None:
        views = (render_view(scene, camera, recipe) for camera in cameras)
        for _ in render_views(scene, cameras, recipe) if way == AT_ONCE else views:
            pass

    return draw


def _opened_rig(uri: str, scale: float, weather: str, way: str) -> Action:
    """In a process that has drawn the cameras small, so that it holds kernels and the snow."""
    scene = open_scene(uri)
    _rig_of(scene, 0.1 * scale, weather, ONE_BY_ONE)()
    return _rig_of(scene, scale, weather, way)


# ---- a long job of tiny images ------------------------------------------------------------------


def _run_long_job(images: int, out: Path) -> Mapping[str, float]:
    frames = -(-images // len(TINY_CAMERAS))
    template = parse_recipe("{}", source="tiny", name="tiny", overrides=PLAIN)
    job = _job(f"tiny:{frames}", template, out, open_scene=open_tiny, renderer=render_tiny)
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
    """`tiny:N`: N frames of two cameras and one splat."""
    one, turn = torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]])
    splat = Gaussians(one, turn, one + 0.1, torch.ones(1), torch.zeros(1, 1, 3))
    frames = tuple(map(_tiny_frame, range(int(uri.removeprefix("tiny:")))))
    return Scene(uri, uri, splat, (), ConstantSky(one[0]), frames)


def _tiny_frame(index: int) -> Frame:
    pose, time_ns = torch.eye(4, dtype=torch.float64), index * TINY_PERIOD_NS
    cameras = {n: Camera(n, 32, 18, 20.0, 20.0, 16.0, 9.0, pose, time_ns) for n in TINY_CAMERAS}
    return Frame(index, time_ns, pose, cameras)


def render_tiny(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> WeatheredView:
    """An image of one colour, another for every time."""
    shade = camera.timestamp_ns // TINY_PERIOD_NS % 256
    rgb = np.full((camera.height, camera.width, 3), shade, np.uint8)
    return WeatheredView(camera, rgb, np.full(rgb.shape[:2], 4.0, np.float32), None, None)


# ---- opening scenes -----------------------------------------------------------------------------


def _open_files(case: JobsCase, uri: str | None, folder: Path, repeats: int) -> list[tuple]:
    gaussians, _ = random_scene(RasterCase(case.gaussians, 1600, 1066))
    scene = dataclasses.replace(open_scene(street_uri(gaussians=60_000)), background=gaussians)
    save_scene(scene, folder / "scene")
    save_scene_file(scene, folder / "scene.climategs")
    save_scene_file(scene, folder / "half.climategs", half=True)
    export_ply(scene, folder / "scene.ply", scene.frames[0].timestamp_ns)
    ways = {
        "gaussians: (.ply)": f"gaussians:{folder / 'scene.ply'}",
        "scene: folder": f"scene:{folder / 'scene'}",
        "scene: file": f"scene:{folder / 'scene.climategs'}",
        "scene: file, half precision": f"scene:{folder / 'half.climategs'}",
    } | ({} if uri is None else {uri: uri})
    seconds = rounds({name: partial(open_scene, own) for name, own in ways.items()}, repeats)
    rows = []
    for name, own in ways.items():
        mib = open_scene(own).gaussian_bytes / 2**20
        peak = peak_mib_in_subprocess(_opening_of, (own,)) if case.memory else None
        rows.append((name, median_ms(seconds[name]), mib, None if peak is None else peak / mib))
    return rows


def _opening_of(uri: str) -> Action:
    """A long-lived process imports what opening needs once."""
    open_scene(street_uri(gaussians=60_000))
    with contextlib.suppress(Exception):
        open_scene(f"{uri.partition(':')[0]}:/nowhere")
    return lambda: open_scene(uri)
