"""How long a job will take and how large its output gets, from a few pictures."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from augment.batch.job import RenderJob, SceneLoader, run_job
from augment.batch.layout import STATE_FOLDER
from augment.generate.plan import Plan
from augment.generate.records import Block
from augment.scene import Scene

MOST_SAMPLED = 8  # recipes whose pictures are made; the others take their mean


@dataclass(frozen=True)
class Sample:
    """What a recipe's images cost. per megapixel: seconds of rendering and writing, and bytes."""

    seconds_per_mpx: float
    bytes_per_mpx: float
    prepare_s: float


@dataclass(frozen=True)
class Estimate:
    """samples: by recipe. seconds: of one worker alone, its scenes' opening included. bytes: of
    all files. unsampled: recipes that were not tried.
    """

    samples: dict[str, Sample]
    seconds: float
    bytes: float
    unsampled: tuple[str, ...]


def estimate(
    plan: Plan, open_scene: SceneLoader, *, each: Callable[[str], None] = lambda name: None
) -> Estimate:
    """Render a frame under each recipe, and scale what it takes by the pixels of the job.

    The pictures are the middle frame of the recipe's first scene in one camera, twice: what the
    first takes beyond the second (where snow can lie, what a style maps, compiling) counts once a
    scene. Scenes and weather differ, so this is right to within a factor of two or so.

    each: told of every recipe before it is tried.
    """
    firsts: dict[str, Block] = {}
    for block in plan.blocks:
        firsts.setdefault(block.recipe.name, block)
    tried = dict(list(firsts.items())[:MOST_SAMPLED])
    samples: dict[str, Sample] = {}
    opened: dict[str, Scene] = {}  # never more than one
    for name, block in tried.items():
        each(name)
        if block.uri not in opened:
            opened.clear()
            opened[block.uri] = open_scene(block.uri)
        samples[name] = _sample(block, opened.__getitem__, plan)
    mean = Sample(
        *(
            sum(getattr(s, field) for s in samples.values()) / len(samples)
            for field in Sample.__dataclass_fields__
        )
    )
    pixels, scenes = _megapixels(plan)
    costs = {name: samples.get(name, mean) for name in firsts}
    opening = sum(record.open_s for record in plan.records.values())
    seconds = sum(pixels[n] * c.seconds_per_mpx + scenes[n] * c.prepare_s for n, c in costs.items())
    size = sum(pixels[name] * cost.bytes_per_mpx for name, cost in costs.items())
    return Estimate(samples, opening + seconds, size, tuple(sorted(firsts.keys() - tried.keys())))


def _megapixels(plan: Plan) -> tuple[dict[str, float], dict[str, int]]:
    """By recipe: pixels of all its images, in millions, and how many scenes have it."""
    pixels: defaultdict[str, float] = defaultdict(float)
    scenes: defaultdict[str, set[str]] = defaultdict(set)
    for block in plan.blocks:
        pictured = block.pictured(plan.records[block.scene])
        pixels[block.recipe.name] += sum(p.width * p.height for p in pictured) / 1e6
        scenes[block.recipe.name].add(block.scene)
    return dict(pixels), {name: len(held) for name, held in scenes.items()}


def _sample(block: Block, loader: SceneLoader, plan: Plan) -> Sample:
    record = plan.records[block.scene]
    camera = block.cameras[0]
    having = [f.number for f in record.frames if camera in f.cameras]
    middle = having[len(having) // 2 :][:1] * 2
    pictures = next(p for p in block.pictured(record) if p.camera == camera)
    mpx = pictures.width * pictures.height / 1e6
    took, size = [], 0
    with tempfile.TemporaryDirectory(prefix="climategs-estimate-") as folder:
        for run, frame in enumerate(middle):
            out = Path(folder) / str(run)
            job = RenderJob(
                block.uri,
                [block.recipe],
                out,
                frames=[frame],
                cameras=[camera],
                backend=plan.backend,
                beds_dir=Path(folder) / "beds",
            )
            started = time.perf_counter()
            run_job(job, scene_loader=loader, progress=False)
            took.append(time.perf_counter() - started)
            files = [p for p in out.rglob("*") if p.is_file()]
            size = sum(p.stat().st_size for p in files if STATE_FOLDER not in p.parts)
    return Sample(took[1] / mpx, size / mpx, max(0.0, took[0] - took[1]))
