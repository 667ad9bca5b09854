"""Rendering of a suite: a dataset job under the suite's recipes, and its `suite.json` at the end.

In: a `SuiteRun`. Out: the job's files, and `suite.json` once every image of the job is there.
Called by `climategs suite` (`tools/suite.py`). Resuming, shards, Ray and object stores are those of
`augment.jobs.generate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.blocks import read_status
from augment.jobs.generate import GenerateJob, GenerateResult, run_generate
from augment.output.manifest import read_manifest_rows
from augment.output.store import Store, open_store
from augment.suite.mirrored_files import find_mirrored_files
from augment.suite.suite_file import (
    SUITE_FILE,
    SuiteFile,
    SuiteRequest,
    check_same_suite,
    describe_suite,
)
from recipes.job import Job, JobScene
from recipes.schema import Recipe
from recipes.suite import QUARTER_ENDING, QUARTER_FRAMES, Suite, SuiteRecipes, SuiteVariant

ConditionsOf = Callable[[str], tuple[str, ...]]


@dataclass(frozen=True)
class SuiteRun:
    """Scenes that are rendered under variants of a suite."""

    recipes: SuiteRecipes
    """Recipes of the variants."""
    scenes: Sequence[JobScene]
    """Scenes, with patterns already expanded."""
    setup: JobWorkerSetup
    """Output, backend and scene loader of the workers."""
    conditions_of: ConditionsOf
    """Function from a scene's URI to the conditions that its dataset states of the recording."""
    is_quarter: bool = False
    """True if every fourth frame is rendered."""
    executor: str = "processes"
    """Kind of the workers, as of `GenerateJob`."""
    workers: int | None = None
    """Number of workers; None for one for each core."""
    shard: tuple[int, int] = (1, 1)
    """Part of the job that is done here, counted from 1, and the number of parts."""

    @property
    def name(self) -> str:
        """Return the name of the suite, or of its quarter."""
        return self.recipes.suite.name + (QUARTER_ENDING if self.is_quarter else "")

    @property
    def job(self) -> GenerateJob:
        """Return the dataset job that renders the suite."""
        return GenerateJob(
            self.recipes,
            self.scenes,
            self.setup,
            executor=self.executor,
            workers=self.workers,
            shard=self.shard,
        )


def suite_recipes(
    suite: Suite,
    variants: tuple[SuiteVariant, ...],
    changes: dict[str, object],
    *,
    scale: float = 1.0,
    block_images: int = 64,
) -> SuiteRecipes:
    """Return the recipes of a job that renders variants of a suite.

    Args:
        changes: Fields of `render` and `output` that differ from the definition, by dotted path.
        scale: Resolution over that of the definition.
        block_images: Approximate number of images in a block.

    Raises:
        RecipeError: A change is not allowed.
    """
    suite.recipe(variants[0], suite.name, changes)  # refuses changes before scenes are opened
    job = Job.model_validate({
        "name": suite.name,
        "scenes": ("any",),  # the run has the scenes
        "recipes": tuple(variant.name for variant in variants),
        "scale": scale,
        "block_images": block_images,
    })  # fmt: skip
    return SuiteRecipes(suite, variants, changes, job)


def quarter_of(scenes: Sequence[JobScene]) -> list[JobScene]:
    """Return scenes with every fourth frame: the frames whose numbers are multiples of four."""
    return [scene.model_copy(update={"frames": QUARTER_FRAMES}) for scene in scenes]


@dataclass(frozen=True)
class SuiteResult:
    """Outcome of a run."""

    images: GenerateResult
    """Counts of the images."""
    suite_file: SuiteFile | None
    """Content of `suite.json`; None while other shards have still to render images."""


def run_suite(
    run: SuiteRun,
    *,
    progress: bool = True,
    prepare: Callable[[list[Recipe]], None] = lambda recipes: None,
    before_hashes: Callable[[], None] = lambda: None,
) -> SuiteResult:
    """Render the images of a suite that are not finished yet, and write `suite.json`.

    `suite.json` states all variants of the suite in the output, those of earlier runs too. It is
    written by the run, or the shard, that finds all images of the job finished.

    Args:
        run: Scenes and variants.
        progress: If True, show bars on stderr.
        prepare: Called before the first image is rendered, with one recipe of each name.
        before_hashes: Called when all images of the job are there, before files are hashed: it may
            add files to the variants' folders.

    Raises:
        OutputError: The output cannot be written, or holds another suite.
        ClimateGSError: No scene can be used.
    """
    store = open_store(run.setup.store_uri)
    request = SuiteRequest(
        run.recipes.suite, run.name, dict(run.recipes.changes), run.recipes.job.scale, {}
    )
    check_same_suite(store, request)
    images = run_generate(run.job, progress=progress, prepare=prepare)
    if not is_finished(store, run.recipes.job.name):
        return SuiteResult(images, None)
    before_hashes()
    rows = read_manifest_rows(store).select(["source", "recipe", "variant"]).to_pylist()
    conditions = {source: run.conditions_of(source) for source in {row["source"] for row in rows}}
    recipe_names = {variant.name for variant in run.recipes.suite.variants}
    variants = {row["variant"] for row in rows if row["recipe"] in recipe_names}
    suite_file = describe_suite(
        store, request._replace(conditions=conditions), find_mirrored_files(store, variants)
    )
    store.write(SUITE_FILE, suite_file.to_json())
    return SuiteResult(images, suite_file)


def is_finished(store: Store, job_name: str) -> bool:
    """Return True if all images of a job are published, failed ones among them."""
    statuses = [status for status in read_status(store) if status.job == job_name]
    return bool(statuses) and statuses[0].total.published == statuses[0].total.planned
