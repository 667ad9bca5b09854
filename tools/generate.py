"""`climategs generate`: a job file becomes a plan, and the plan a dataset."""

from __future__ import annotations

import contextlib
import math
import shlex
import signal
import uuid
from collections.abc import Iterator
from typing import TYPE_CHECKING

from adapters.base import open_scene, scenes_of
from augment.errors import ClimateGSError
from augment.jobs.block_worker import WorkSetup
from augment.jobs.blocks import JobStatus, Plan, read_status, shard_of
from augment.jobs.generate import (
    GenerateJob,
    GenerateResult,
    default_scratch,
    plan_job,
    run_generate,
)
from augment.jobs.layout import STATE_FOLDER
from augment.jobs.store import Store, open_store
from augment.jobs.worker import shares_of
from recipes.job import load_job, load_job_recipes
from tools.output import print_images, print_note

if TYPE_CHECKING:
    from recipes.schema import Recipe
    from tools.cli import GenerateOptions

_MAX_LINES = 20


def generate_dataset(options: GenerateOptions) -> int:
    """Runs the job and prints what became of it. Returns the exit code: 1 where images failed."""
    job, out, backend = options.job, options.out, options.backend
    assert job is not None
    if options.workers is not None and options.workers < 1:
        raise ClimateGSError(f"--workers must be 1 or more; got {options.workers}")
    requested = load_job(job)
    recipes = load_job_recipes(requested, job.parent)
    store = open_store(out)
    setup = WorkSetup(
        store_uri=out if store.local_dir is None else store.uri,
        scratch=options.scratch or default_scratch(out),
        backend=backend,
        open_scene=open_scene,
    )
    task = GenerateJob(
        recipes,
        scenes_of(requested.scenes, job.parent),
        setup,
        executor=options.executor,
        workers=options.workers,
        shard=parse_shard(options.shard),
        rescan=options.rescan,
    )
    if options.dry_run:
        return _dry_run(task)
    _check_writable(store)
    with ended_by_sigterm():
        result = run_generate(task, prepare=lambda recipes: _warm_up(recipes, backend))
    _report(result, out)
    return 1 if result.failed or result.unusable else 0


def show_status(out: str) -> int:
    """Prints how far the jobs of an output have come. Returns the exit code: 1 for unfinished ones.

    Raises:
        ClimateGSError: no job was ever started there.
    """
    found = read_status(open_store(out))
    if not found:
        raise ClimateGSError(f"{out}: no job has been started there (no .climategs/jobs)")
    for status in found:
        _print_status(status)
    return 0 if all(_is_done(status) for status in found) else 1


def parse_shard(text: str) -> tuple[int, int]:
    """`2/8`, the second of eight.

    Raises:
        ClimateGSError: the text is something else.
    """
    number, slash, count = text.partition("/")
    are_numbers = slash and number.isdecimal() and count.isdecimal() and len(text) < 20
    if not are_numbers or not 1 <= int(number) <= int(count):
        raise ClimateGSError(f"--shard {text!r}: write i/n with i from 1 to n, as in 2/8")
    return int(number), int(count)


def _check_writable(store: Store) -> None:
    """Learn that an output cannot be written before scenes are opened, which may take hours."""
    name = f"{STATE_FOLDER}/probe-{uuid.uuid4().hex}"
    store.write(name, b"")
    store.delete([name])


def _dry_run(job: GenerateJob) -> int:
    from augment.jobs.generate import estimate

    plan = plan_job(job)
    blocks = shard_of(plan.blocks, *job.shard)
    _print_plan(plan, len(blocks), job)
    guess = estimate(plan, open_scene, each=lambda name: print_note(f"trying {name}"))
    for name, sample in guess.samples.items():
        print(
            f"  {name}: {sample.seconds_per_mpx:.2f} s and {_size(sample.bytes_per_mpx)} a "
            f"megapixel, {sample.prepare_s:.1f} s to prepare"
        )
    if guess.unsampled:
        print(f"  taken as their mean: {', '.join(guess.unsampled)}")
    print(
        f"about {_duration(guess.seconds)} of one worker, {_size(guess.bytes)} "
        f"(from one picture a recipe; right to a factor of two or so)"
    )
    return 1 if plan.unusable else 0


def _print_plan(plan: Plan, blocks: int, job: GenerateJob) -> None:
    recipes = dict.fromkeys(block.recipe.name for block in plan.blocks)
    variants = len({(block.scene, block.variant) for block in plan.blocks})
    print(
        f"{plan.job}: {len(plan.records)} scenes, {len(recipes)} recipes, {variants} variants, "
        f"{plan.images} images in {len(plan.blocks)} blocks"
    )
    number, count = job.shard
    if count > 1:
        images = sum(block.images for block in shard_of(plan.blocks, number, count))
        print(f"shard {number}/{count}: {images} images in {blocks} blocks")
    for name, record in list(plan.records.items())[:_MAX_LINES]:
        images = sum(block.images for block in plan.blocks if block.scene == name)
        print(f"  {name}: {images} images, opened in {record.open_s:.1f} s")
    if len(plan.records) > _MAX_LINES:
        print(f"  ... and {len(plan.records) - _MAX_LINES} more")
    for uri, why in plan.unusable.items():
        print(f"  cannot be used: {uri}: {why}")


def _report(result: GenerateResult, out: str) -> None:
    print_images(result, _duration(result.seconds))
    if shares := shares_of(result.timings):
        print(shares.sentence)
    for uri, why in result.unusable.items():
        print_note(f"cannot be used: {uri}: {why}")
    print(f"output: {out}   (climategs report {shlex.quote(out)} shows it)")


def _print_status(status: JobStatus) -> None:
    total = status.total
    share = 100 * total.published / max(total.planned, 1)
    print(
        f"{status.job}: {total.published} of {total.planned} images published ({share:.1f} %), "
        f"{status.blocks_published} of {status.blocks} blocks"
    )
    if status.staged:
        print(f"  {status.staged} more are finished in blocks that are not")
    if status.claims:
        print(f"  {status.claims} blocks are being worked on")
    if status.left_s and not _is_done(status):
        print(f"  {status.images_per_s:.1f} images/s; about {_duration(status.left_s)} left")
    for kind, groups in (("scene", status.by_scene), ("recipe", status.by_recipe)):
        open_ones = {n: g for n, g in groups.items() if g.published < g.planned}
        for name, group in list(open_ones.items())[:_MAX_LINES]:
            print(f"  {kind} {name}: {group.published} of {group.planned}")
        if len(open_ones) > _MAX_LINES:
            print(f"  ... and {len(open_ones) - _MAX_LINES} more {kind}s")
    if total.in_failed_blocks:
        print(
            f"  with failures: blocks of {total.in_failed_blocks} images; start it again to retry"
        )
    for uri, why in status.unusable.items():
        print(f"  cannot be used: {uri}: {why}")


def _is_done(status: JobStatus) -> bool:
    total = status.total
    return total.published == total.planned and not total.in_failed_blocks and not status.unusable


def _warm_up(recipes: list[Recipe], backend: str) -> None:
    from tools.warm_up import warm_up_for_workers

    seconds = warm_up_for_workers(recipes, backend)
    if seconds > 1:
        print_note(f"compiled the kernels in {seconds:.1f} s (kept for the next run)")


@contextlib.contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let a scheduler's SIGTERM end the job as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.1f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _size(count: float) -> str:
    steps = ("B", "kB", "MB", "GB", "TB")
    step = min(int(math.log(max(count, 1), 1000)), len(steps) - 1)
    return f"{count / 1000**step:.1f} {steps[step]}"
