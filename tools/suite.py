"""`climategs suite`: a robustness suite is rendered, planned and verified."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.base import expand_datasets, expand_job_scenes, open_scene, recorded_conditions
from adapters.scene_cache import scene_digest
from augment.errors import ClimateGSError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.generate import default_scratch
from augment.output.store import open_store
from augment.suite.plan import plan_suite
from augment.suite.run import SuiteRun, quarter_of, run_suite, suite_recipes
from augment.suite.suite_file import SUITE_FILE, SuiteFile, read_suite_file
from augment.suite.verify import verify_suite
from recipes.job import JobScene
from recipes.load import read_overrides
from recipes.suite import load_suite
from recipes.yaml_tree import plain
from tools.generate import ended_by_sigterm, size_text
from tools.options import FITTED
from tools.output import duration_text, print_images, print_note
from tools.warm_up import warm_up_for_workers

if TYPE_CHECKING:
    from tools.cli import SuiteOptions, SuitePlanOptions, SuiteSearchOptions, SuiteSelection

SUITE = "weather-c-v1"
_MAX_PATHS = 20  # that are printed


def render_suite(options: SuiteOptions) -> int:
    """Render a suite and print the result. Return the exit code: 1 if images or scenes failed."""
    number, count = map(int, options.shard.split("/"))
    run = _run_of(
        options, options.out, executor=options.executor, workers=options.workers,
        shard=(number, count), backend=options.backend, scratch=options.scratch,
    )  # fmt: skip

    def lay_into_datasets() -> None:
        """Lay the images into copies of their datasets; sweeps between images are added."""
        if options.layout == "source":
            from tools.mirror import mirror_again

            mirror_again(Path(options.out), links=options.links)

    with ended_by_sigterm():
        result = run_suite(
            run,
            prepare=lambda recipes: warm_up_for_workers(recipes, options.backend),
            before_hashes=lay_into_datasets,
        )
    print_images(result.images, duration_text(result.images.seconds))
    for uri, why in result.images.unusable.items():
        print_note(f"cannot be used: {uri}: {why}")
    if result.suite_file is None:
        print_note(f"{SUITE_FILE} is written when all shards are done")
    else:
        print_suite(result.suite_file)
    print(f"output: {options.out}   (climategs suite verify {shlex.quote(options.out)} checks it)")
    return 1 if result.images.failed or result.images.unusable else 0


def print_suite(suite_file: SuiteFile) -> None:
    """Print what a suite holds, and which scenes are left out of the scores of which effects."""
    print(
        f"{suite_file.suite}: {len(suite_file.variants)} variants of {len(suite_file.scenes)} "
        f"scenes, {len(suite_file.files)} files ({SUITE_FILE})"
    )
    for name, scene in suite_file.scenes.items():
        if scene.omitted_effects:
            print(
                f"  {name} was recorded in {', '.join(scene.recorded_conditions)}: no part of the "
                f"main score of {', '.join(scene.omitted_effects)}"
            )


def show_plan(options: SuitePlanOptions) -> int:
    """Print how many images a suite has, and about how long and how large they get."""
    run = _run_of(options, "unwritten", executor="serial", backend=options.backend)
    facts = plan_suite(run, open_scene, on_recipe=lambda name: print_note(f"trying {name}"))
    for effect, cost in facts.effects.items():
        print(
            f"  {effect}: {cost.variants} levels, {cost.images} images, "
            f"{duration_text(cost.seconds)}, {size_text(cost.bytes)}"
        )
    print(
        f"{run.name}: {facts.plan.images} images of {len(facts.plan.records)} scenes; about "
        f"{duration_text(facts.seconds)} of one worker, {size_text(facts.bytes)} "
        f"(from two pictures an effect; right to a factor of two or so)"
    )
    for uri, why in facts.plan.unusable.items():
        print_note(f"cannot be used: {uri}: {why}")
    return 1 if facts.plan.unusable else 0


def verify_output(out: str) -> int:
    """Compare a suite's files with their hashes. Return the exit code: 1 if any differs."""
    outcome = verify_suite(open_store(out))
    for word, paths in (("changed", outcome.changed), ("missing", outcome.missing)):
        for path in paths[:_MAX_PATHS]:
            print(f"{word}: {path}")
        if (more := len(paths) - _MAX_PATHS) > 0:
            print(f"... and {more} more")
    if outcome.unlisted:
        print_note(
            f"note: {len(outcome.unlisted)} files are no part of the suite, the first of them "
            f"{outcome.unlisted[0]}"
        )
    num_files = len(outcome.suite_file.files)
    if outcome.is_intact:
        print(f"{outcome.suite_file.suite}: all {num_files} files are as they were rendered")
        return 0
    print(
        f"{outcome.suite_file.suite}: of {num_files} files {len(outcome.changed)} changed, "
        f"{len(outcome.missing)} missing"
    )
    return 1


def show_probes(out: str, variant: str | None) -> int:
    """Print the files by which a loader is probed, of one variant or of each."""
    suite_file = read_suite_file(open_store(out))
    if variant is not None and variant not in suite_file.variants:
        raise ClimateGSError(
            f"{out} has no variant {variant!r}; it has {', '.join(suite_file.variants)}"
        )
    for name, facts in suite_file.variants.items():
        if variant in (None, name):
            for path in facts.probes:
                print(f"{name} {suite_file.files[path]} {path}")
    return 0


def scenes_of(options: SuiteSelection | SuiteSearchOptions) -> list[JobScene]:
    """Return the scenes that options name, with patterns and folders of scenes expanded."""
    cameras = None if options.cameras == FITTED else tuple(options.cameras.split(","))
    entries = [
        JobScene.model_validate({"uri": uri, "frames": options.frames, "cameras": cameras})
        for uri in options.scenes
    ]
    return expand_datasets(expand_job_scenes(entries, Path()))


def changes_of(options: SuiteSelection | SuiteSearchOptions) -> dict[str, object]:
    """Return the fields that options set, by dotted path."""
    return {path: plain(node) for path, node in read_overrides(options.overrides).items()}


def _run_of(
    options: SuiteSelection, out: str, *, backend: str, scratch: Path | None = None, **facts: Any
) -> SuiteRun:
    """Return the run that options ask for."""
    suite = load_suite(SUITE)
    variants = suite.select(
        None if options.effects == "all" else options.effects.split(","),
        None if options.levels == "all" else [int(text) for text in options.levels.split(",")],
    )
    scenes = scenes_of(options)
    store = open_store(out)
    setup = JobWorkerSetup(
        store_uri=out if store.local_dir is None else store.uri,
        scratch_dir=scratch or default_scratch(out),
        backend=backend,
        open_scene=open_scene,
        scene_digest=scene_digest,
    )
    return SuiteRun(
        suite_recipes(suite, variants, changes_of(options), scale=options.scale),
        quarter_of(scenes) if options.quarter else scenes,
        setup,
        recorded_conditions,
        is_quarter=options.quarter,
        **facts,
    )
