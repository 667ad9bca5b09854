"""What generating a dataset costs beside bare rendering, and how it grows with the job.

Three questions: what the machinery (claims, journals, durable files, publishing, manifest) adds to
rendering, encoding and writing the same images; which executor is the faster; and what a job of
10,000 images takes to plan, to resume, and in memory.
"""

from __future__ import annotations

import contextlib
import dataclasses
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapters.base import open_scene
from augment.jobs.block_worker import IndexTask, WorkSetup
from augment.jobs.blocks import Block, SceneRecord, make_plan
from augment.jobs.files import encode_depth, encode_image
from augment.jobs.generate import GenerateJob, make_pool, run_generate
from augment.jobs.layout import variant_name
from augment.jobs.manifest import compact
from augment.jobs.scheduler import Driver
from augment.jobs.status import read_status
from augment.jobs.store import open_store
from augment.jobs.view_files import WritePump
from augment.views import render_view
from recipes.job import Job, JobRecipes
from recipes.load import load_recipe
from recipes.parse import parse_recipe
from recipes.template import RecipeTemplate
from tools.bench_generate_tiny import CAMERAS, open_tiny, render_tiny
from tools.machine import load_average, machine_facts, machine_line
from tools.process_memory import MemorySampler

# Labels and LiDAR are left out of the comparison: they are work that bare rendering does not do.
_PLAIN = "output: {labels: false, lidar: false}\n"


@dataclass(frozen=True)
class Case:
    """scene, scale, recipes, variants: of the images that are compared. images: of the long job,
    tiny.
    """

    scene: str
    scale: float
    recipes: tuple[str, ...]
    variants: int
    repeats: int
    images: int


# Several variants in small blocks: work for both workers from the first to the last.
WHOLE = Case(
    "procedural:street?seed=3&frames=4&width=1600&height=1066", 1.0, ("dense-fog",), 3, 3, 10_000
)
QUICK = Case("procedural:street?seed=3&frames=4", 0.1, ("dense-fog",), 3, 1, 500)
_BLOCK_IMAGES = 12


def bench_generate(case: Case = WHOLE, *, repeats: int | None = None) -> dict[str, Any]:
    """Seconds an image of each way to make the same, and figures of a long job of tiny ones."""
    machine = dataclasses.asdict(machine_facts())
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        folder = Path(name)
        rows = _compare(case, folder, repeats or case.repeats)
        long = _long_job(case.images, folder / "long")
    return {"machine": machine, "load_after": load_average(), "rows": rows, "long": long}


def generate_text(result: dict[str, Any]) -> str:
    long, rows = result["long"], result["rows"]
    bare = rows[0]["seconds"]
    lines = [
        machine_line(result),
        f"{rows[0]['images']} images of {rows[0]['size']}, PNG and depth; without starting, "
        f"opening scenes and loading kernels",
        f"{'':34} {'an image':>9} {'spread':>8} {'images/s':>9} {'to bare':>8}",
    ]
    lines += [
        f"{row['what']:34} {1000 * row['seconds']:6.1f} ms {1000 * row['spread']:5.1f} ms "
        f"{1 / row['seconds']:9.2f} {row['seconds'] / bare:8.3f}"
        for row in rows
    ]
    lines += [
        "",
        f"a job of {long['images']:,} tiny images in {long['blocks']} blocks, one process:",
        f"  plan {long['plan_s']:.2f} s, first image to last {long['render_s']:.1f} s "
        f"({1000 * long['render_s'] / long['images']:.1f} ms an image), "
        f"resume scan {long['scan_s']:.2f} s, --status {long['status_s']:.2f} s",
        f"  resident memory: {long['early_mib']:.0f} MiB after a fifth of the images, "
        f"{long['late_mib']:.0f} MiB at the end, {long['peak_mib']:.0f} MiB at most",
    ]
    return "\n".join(lines)


def _compare(case: Case, folder: Path, repeats: int) -> list[dict[str, Any]]:
    recipes = _recipes(case)
    job = _job(case.scene, recipes, folder)
    scene = open_scene(case.scene)
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    images = len(cameras) * len(recipes.of_scene(recipes.job.scenes[0], scene.name))
    first = cameras[0].scaled(case.scale)
    del scene
    ways: dict[str, Callable[[Path], float]] = {
        "render, encode, write (bare)": lambda out: _bare(case, recipes, out),
        "generate, this process": lambda out: _generate(job, out, "serial", 1),
        "generate, 1 process of its own": lambda out: _generate(job, out, "processes", 1),
        "generate, 2 processes": lambda out: _generate(job, out, "processes", 2),
    }
    took: dict[str, list[float]] = {what: [] for what in ways}
    for number in range(1 + repeats):  # in turn, for the machine's speed changes; the first warms
        for position, (what, way) in enumerate(ways.items()):
            took[what].append(way(folder / f"{number}-{position}"))
    return [
        {
            "what": what,
            "seconds": statistics.median(seconds[1:]),
            "spread": max(seconds[1:]) - min(seconds[1:]),
            "images": images,
            "size": f"{first.width}x{first.height}",
        }
        for what, seconds in took.items()
    ]


def _bare(case: Case, recipes: JobRecipes, out: Path) -> float:
    """The same images by a loop: nothing is durable, nothing remembered."""
    scene = open_scene(case.scene)
    resolved = recipes.of_scene(recipes.job.scenes[0], scene.name)
    views = [
        (recipe, frame, name, camera)
        for recipe in resolved
        for frame in scene.frames
        for name, camera in frame.cameras.items()
    ]
    render_view(scene, views[0][-1], views[0][0])
    pump, started = WritePump(), time.perf_counter()
    for recipe, frame, name, camera in views:
        view = render_view(scene, camera, recipe)
        path = out / variant_name(recipe) / f"{name.replace('/', '_')}-{frame.index}"
        pump.submit(lambda view=view, path=path, recipe=recipe: _write(view, path, recipe))
    pump.close()
    return (time.perf_counter() - started) / len(views)


def _write(view: Any, path: Path, recipe: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".depth.png").write_bytes(encode_depth(view.depth_m))
    path.with_suffix(".png").write_bytes(encode_image(view.rgb, recipe.output))


def _generate(job: GenerateJob, out: Path, executor: str, workers: int) -> float:
    """As a job does it once all its workers have the scene and their kernels."""
    setup = dataclasses.replace(job.setup, store_uri=str(out))
    run = dataclasses.replace(job, setup=setup, executor=executor, workers=workers)
    uri = job.scenes[0].uri
    found: dict[tuple[str, str | None], SceneRecord | str] = {}
    driver = Driver(lambda tick: make_pool(run, tick))
    with contextlib.closing(driver):
        tasks = [IndexTask(uri, None)] * workers
        driver.index(tasks, lambda task, record: found.update({(task.uri, task.name): record}))
        plan = make_plan(job.recipes, job.scenes, found, setup.backend)
        first, rest = plan.blocks[:workers], plan.blocks[workers:]
        driver.render(first, dict(plan.names), _never)
        started = time.perf_counter()
        driver.render(rest, dict(plan.names), _never)
        compact(open_store(out))
        took = time.perf_counter() - started
    images = sum(block.images for block in rest)
    if driver.tally.failed or driver.tally.written != plan.images:
        raise RuntimeError(f"the job did not do what is measured: {driver.tally}")
    return took / images


def _never(block: Block, message: str) -> None:
    raise RuntimeError(f"{block.key}: {message}")


def _long_job(images: int, out: Path) -> dict[str, Any]:
    frames = -(-images // len(CAMERAS))
    template = parse_recipe("weather: {smog: {visibility_m: 100}}\n", source="tiny", name="tiny")
    job = _job(f"tiny:{frames}", _with([template]), out, tiny=True)
    with MemorySampler() as memory:
        result = run_generate(dataclasses.replace(job, executor="serial"), progress=False)
    again = run_generate(dataclasses.replace(job, executor="serial"), progress=False)
    if (result.written, again.skipped) != (frames * len(CAMERAS),) * 2:
        raise RuntimeError(f"the job did not do what is measured: {result}, {again}")
    started = time.perf_counter()
    (status,) = read_status(open_store(out))
    status_s = time.perf_counter() - started
    return {
        "images": result.written,
        "blocks": status.blocks,
        "plan_s": result.timings["plan"],
        "render_s": result.timings["render_wall"],
        "scan_s": again.timings["plan"] + again.timings["scan"],
        "status_s": status_s,
        "early_mib": memory.at_share(0.2),
        "late_mib": memory.at_share(1.0),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _recipes(case: Case) -> JobRecipes:
    templates = [load_recipe(name) for name in case.recipes]
    off = parse_recipe(_PLAIN, source="bench", name="bench").values
    plain = [
        dataclasses.replace(t, values=(*t.values, *off), variants=case.variants) for t in templates
    ]
    return _with(plain, scale=case.scale, block_images=_BLOCK_IMAGES)


def _with(
    templates: list[RecipeTemplate], scale: float = 1.0, block_images: int = 64
) -> JobRecipes:
    names = [template.name for template in templates]
    job = Job.model_validate(
        {"scenes": ["-"], "recipes": names, "scale": scale, "block_images": block_images}
    )
    return JobRecipes(job, dict(zip(names, templates, strict=True)))


def _job(uri: str, recipes: JobRecipes, out: Path, *, tiny: bool = False) -> GenerateJob:
    setup = WorkSetup(
        str(out),
        None,
        "auto",
        open_scene=open_tiny if tiny else open_scene,
        renderer=render_tiny if tiny else None,
    )
    scene = recipes.job.scenes[0].model_copy(update={"uri": uri})
    return GenerateJob(recipes, [scene], setup)
