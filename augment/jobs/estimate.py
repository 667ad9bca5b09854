"""Estimate of a job's time and of its output's size, from a few pictures.

In: the plan of a dataset job. Out: an `Estimate`. Called by `climategs generate --dry-run`.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from augment.jobs.blocks import Block, JobPlan
from augment.jobs.render_job import RenderJob, SceneLoader, run_job
from augment.output.names import STATE_FOLDER
from augment.scene.scene import Scene

# Recipes for which pictures are rendered; other recipes take the mean of these.
MAX_SAMPLED = 8


class Sample(NamedTuple):
    """Cost of a recipe's images."""

    seconds_per_mpx: float
    """Seconds of rendering and writing for one million pixels."""
    bytes_per_mpx: float
    """Bytes of the files for one million pixels."""
    prepare_s: float
    """Seconds that each scene takes once, before its first image."""


@dataclass(frozen=True)
class Estimate:
    """Estimated time and size of a job."""

    samples: dict[str, Sample]
    """Measured cost by recipe name."""
    seconds: float
    """Seconds of a single worker, including the time to open its scenes."""
    bytes: float
    """Bytes of all files."""
    unsampled_recipes: tuple[str, ...]
    """Names of the recipes that were not tried."""


def estimate_job(
    plan: JobPlan,
    open_scene: SceneLoader,
    *,
    on_recipe: Callable[[str], None] = lambda name: None,
    max_sampled: int = MAX_SAMPLED,
) -> Estimate:
    """Estimate time and size of a job from two to four pictures of each recipe.

    The estimate is right to within a factor of about two. The first picture and a second one
    show the middle frame of the recipe's first scene in one camera; of a recipe that changes over
    time the second one is the mean of the first, the middle and the last frame. Its cost is scaled
    by the pixels of the job. The time that the first picture takes beyond it (snow placement, style
    maps, compiling) counts once for each scene.

    Args:
        open_scene: Opens a scene by its URI.
        on_recipe: Called with a recipe's name before its pictures.
        max_sampled: Number of recipes for which pictures are rendered; other recipes take the mean
            of these.
    """
    first_blocks: dict[str, Block] = {}
    for block in plan.blocks:
        first_blocks.setdefault(block.recipe.name, block)
    sampled_blocks = dict(list(first_blocks.items())[:max_sampled])
    samples: dict[str, Sample] = {}
    scene_by_uri: dict[str, Scene] = {}  # at most one scene at a time
    for name, block in sampled_blocks.items():
        on_recipe(name)
        if block.uri not in scene_by_uri:
            scene_by_uri.clear()
            scene_by_uri[block.uri] = open_scene(block.uri)
        samples[name] = _sample(block, scene_by_uri.__getitem__, plan)
    mean = Sample(*(sum(costs) / len(samples) for costs in zip(*samples.values(), strict=True)))
    megapixels, num_scenes = _megapixels(plan)
    costs = {name: samples.get(name, mean) for name in first_blocks}
    opening_s = sum(record.open_s for record in plan.records.values())
    seconds = sum(
        megapixels[n] * c.seconds_per_mpx + num_scenes[n] * c.prepare_s for n, c in costs.items()
    )
    size = sum(megapixels[name] * cost.bytes_per_mpx for name, cost in costs.items())
    return Estimate(
        samples,
        opening_s + seconds,
        size,
        tuple(sorted(first_blocks.keys() - sampled_blocks.keys())),
    )


def _megapixels(plan: JobPlan) -> tuple[dict[str, float], dict[str, int]]:
    """Return the millions of pixels of all images and the number of scenes, by recipe."""
    megapixels: defaultdict[str, float] = defaultdict(float)
    scenes: defaultdict[str, set[str]] = defaultdict(set)
    for block in plan.blocks:
        pictured = block.list_images(plan.records[block.scene])
        megapixels[block.recipe.name] += sum(p.width * p.height for p in pictured) / 1e6
        scenes[block.recipe.name].add(block.scene)
    return dict(megapixels), {name: len(scene_names) for name, scene_names in scenes.items()}


def _sample(block: Block, loader: SceneLoader, plan: JobPlan) -> Sample:
    """Render the block's middle frame twice and return its cost.

    Of a recipe that changes over time the second run has the first and the last frame, too.
    """
    record = plan.records[block.scene]
    camera = block.cameras[0]
    frame_numbers = [f.number for f in record.frames if camera in f.cameras]
    pictured = next(p for p in block.list_images(record) if p.camera == camera)
    megapixels = pictured.width * pictured.height / 1e6
    middle = frame_numbers[len(frame_numbers) // 2]
    last_frames = [middle]
    if block.recipe.changes_over_time:
        last_frames = sorted({frame_numbers[0], middle, frame_numbers[-1]})
    picture_times_s = []
    num_bytes = 0.0
    with tempfile.TemporaryDirectory(prefix="climategs-estimate-") as folder:
        runs = {Path(folder) / "0": [middle], Path(folder) / "1": last_frames}
        for output_dir, frames in runs.items():
            job = RenderJob(
                block.uri,
                [block.recipe],
                output_dir,
                frames=frames,
                cameras=[camera],
                backend=plan.backend,
                shared_files_dir=Path(folder) / "shared",
            )
            start_s = time.perf_counter()
            run_job(job, scene_loader=loader, progress=False)
            picture_times_s.append((time.perf_counter() - start_s) / len(frames))
            files = [p for p in output_dir.rglob("*") if p.is_file()]
            sizes = [p.stat().st_size for p in files if STATE_FOLDER not in p.parts]
            num_bytes = sum(sizes) / len(frames)
    return Sample(
        picture_times_s[1] / megapixels,
        num_bytes / megapixels,
        max(0.0, picture_times_s[0] - picture_times_s[1]),
    )
