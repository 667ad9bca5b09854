"""`climategs generate`: a job file becomes a data set, or a page about how far it has come."""

from __future__ import annotations

import contextlib
import math
import shlex
import signal
import uuid
from collections.abc import Iterator
from typing import TYPE_CHECKING

from adapters.base import expand_job_scenes, open_scene
from adapters.scene_cache import scene_digest
from augment.errors import ClimateGSError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.blocks import JobStatus, read_status, select_shard
from augment.jobs.generate import GenerateJob, default_scratch, plan_job, run_generate
from augment.jobs.time_shares import compute_time_shares
from augment.output.names import STATE_FOLDER
from augment.output.store import open_store
from recipes.job import load_job, load_job_recipes
from tools.labels import write_labels_of_job
from tools.options import with_tracks_key
from tools.output import LABELS_OF_STORES, duration_text, fill, print_images, print_note
from tools.warm_up import warm_up_for_workers

if TYPE_CHECKING:
    from tools.cli import GenerateOptions


_MAX_LINES = 20  # of scenes and recipes


def generate_dataset(options: GenerateOptions) -> int:
    """Run the job and print its result. Return the exit code: 1 if images failed."""
    job = options.job
    out = options.out
    backend = options.backend
    assert job is not None
    requested = load_job(job)
    recipes = load_job_recipes(requested, job.parent)
    store = open_store(out)
    number, count = map(int, options.shard.split("/"))
    setup = JobWorkerSetup(
        store_uri=out if store.local_dir is None else store.uri,
        scratch_dir=options.scratch or default_scratch(out),
        backend=backend,
        open_scene=open_scene,
        scene_digest=scene_digest,
    )
    scenes = [
        entry.model_copy(update={"uri": with_tracks_key(entry.uri, options.tracks)})
        for entry in expand_job_scenes(requested.scenes, job.parent)
    ]
    task = GenerateJob(
        recipes,
        scenes,
        setup,
        executor=options.executor,
        workers=options.workers,
        shard=(number, count),
        reopens_scenes=options.rescan,
    )
    if options.dry_run:
        return _dry_run(task)
    # Learn that an output cannot be written before scenes are opened, which may take hours.
    probe = f"{STATE_FOLDER}/probe-{uuid.uuid4().hex}"
    store.write(probe, b"")
    store.delete([probe])
    with ended_by_sigterm():
        result = run_generate(task, prepare=lambda recipes: warm_up_for_workers(recipes, backend))
    print_images(result, duration_text(result.seconds))
    if shares := compute_time_shares(result.timings):
        print(shares.sentence)
    for uri, why in result.unusable.items():
        print_note(f"cannot be used: {uri}: {why}")
    firsts = [template.resolve(0) for template in recipes.templates.values()]
    if store.local_dir is not None:
        write_labels_of_job(store.local_dir, firsts, result.written + result.skipped)
    elif any(recipe.output.label_formats for recipe in firsts):
        print_note(f"note: labels for trainers need the images on this machine; {LABELS_OF_STORES}")
    print(f"output: {out}   (climategs report {shlex.quote(out)} shows it)")
    return 1 if result.failed or result.unusable else 0


def show_status(out: str) -> int:
    """Print the progress of an output's jobs. Return the exit code: 1 for unfinished jobs.

    Raises:
        ClimateGSError: no job was ever started there.
    """
    statuses = read_status(open_store(out))
    if not statuses:
        raise ClimateGSError(f"{out}: no job has been started there (no .climategs/jobs)")
    for status in statuses:
        print(_status_text(status))
    return 0 if all(_is_done(status) for status in statuses) else 1


def _dry_run(job: GenerateJob) -> int:
    from augment.jobs.estimate import estimate_job

    plan = plan_job(job)
    page = fill(
        "plan.txt",
        plan=plan,
        recipes=len({block.recipe.name for block in plan.blocks}),
        variants=len({(block.scene, block.variant) for block in plan.blocks}),
        shard=job.shard,
        blocks=select_shard(plan.blocks, *job.shard),
        max_lines=_MAX_LINES,
    )
    print(page)
    guess = estimate_job(plan, open_scene, on_recipe=lambda name: print_note(f"trying {name}"))
    for name, sample in guess.samples.items():
        print(
            f"  {name}: {sample.seconds_per_mpx:.2f} s and {size_text(sample.bytes_per_mpx)} a "
            f"megapixel, {sample.prepare_s:.1f} s to prepare"
        )
    if guess.unsampled_recipes:
        print(f"  taken as their mean: {', '.join(guess.unsampled_recipes)}")
    print(
        f"about {duration_text(guess.seconds)} of one worker, {size_text(guess.bytes)} "
        f"(from two to four pictures a recipe; right to a factor of two or so)"
    )
    return 1 if plan.unusable else 0


def _status_text(status: JobStatus) -> str:
    unfinished = {
        kind: [(name, g) for name, g in groups.items() if g.published < g.planned]
        for kind, groups in (("scene", status.by_scene), ("recipe", status.by_recipe))
    }
    left = duration_text(status.remaining_s) if status.remaining_s and not _is_done(status) else ""
    return fill("status.txt", status=status, left=left, unfinished=unfinished, max_lines=_MAX_LINES)


def _is_done(status: JobStatus) -> bool:
    total = status.total
    return total.published == total.planned and not total.in_failed_blocks and not status.unusable


@contextlib.contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let a scheduler's SIGTERM end the job as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous_handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def size_text(count: float) -> str:
    steps = ("B", "kB", "MB", "GB", "TB")
    step = min(int(math.log(max(count, 1), 1000)), len(steps) - 1)
    return f"{count / 1000**step:.1f} {steps[step]}"
