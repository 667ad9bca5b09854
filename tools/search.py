"""`climategs suite search`: the mildest weather at which a user's detector breaks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from adapters.base import expand_datasets, expand_job_scenes, open_scene
from adapters.scene_cache import scene_digest
from augment.errors import ClimateGSError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.generate import GenerateJob, default_scratch, run_generate
from augment.suite.search import (
    Evaluation,
    SearchResult,
    command_judge,
    search_range,
    search_weather,
)
from recipes.job import Job, JobScene, scaled_recipe
from recipes.load import read_overrides
from recipes.schema import Recipe
from recipes.suite import Suite, SuiteVariant, load_suite
from recipes.yaml_tree import plain
from tools.output import print_note, write_json

if TYPE_CHECKING:
    from tools.cli import SuiteSearchOptions

SUITE = "weather-c-v1"


@dataclass(frozen=True)
class SearchRecipes:
    """Recipes of a dataset job with one variant of a suite, under another name."""

    suite: Suite
    """Suite that has the number of the search at level 1."""
    variant: SuiteVariant
    """The variant."""
    name: str
    """Name of the recipes."""
    changes: dict[str, object]
    """Fields of `render` and `output` that differ from the suite, by dotted path."""
    job: Job
    """Name, scale and size of blocks of the job."""

    def resolve_for_scene(self, entry: JobScene, scene_name: str) -> list[Recipe]:
        """Return the recipe in numbers under which a scene is rendered."""
        recipe = self.suite.recipe(self.variant, scene_name, self.changes)
        return [scaled_recipe(recipe.model_copy(update={"name": self.name}), self.job.scale)]


def search_suite(options: SuiteSearchOptions) -> int:
    """Search, and print and write the result. Return 0."""
    suite = load_suite(SUITE)
    mildest, harshest = search_range(suite, options.effect)
    unit = suite.effects[options.effect].unit
    overrides = read_overrides(options.overrides)
    changes = {path: plain(node) for path, node in overrides.items()}
    cameras = None if options.cameras == "fitted" else tuple(options.cameras.split(","))
    entries = [
        JobScene.model_validate({"uri": uri, "frames": options.frames, "cameras": cameras})
        for uri in options.scenes
    ]
    scenes = expand_datasets(expand_job_scenes(entries, Path()))

    def render(suite_at_number: Suite, variant: SuiteVariant, name: str) -> Path:
        folder = options.out / name
        job = Job.model_validate(
            {"name": name, "scenes": ("any",), "recipes": (name,), "scale": options.scale}
        )
        setup = JobWorkerSetup(
            store_uri=str(folder),
            scratch_dir=default_scratch(str(folder)),
            backend=options.backend,
            open_scene=open_scene,
            scene_digest=scene_digest,
        )
        recipes = SearchRecipes(suite_at_number, variant, name, changes, job)
        executor = "serial" if options.workers == 1 else "processes"
        result = run_generate(
            GenerateJob(recipes, scenes, setup, executor=executor, workers=options.workers)
        )
        if result.failed or result.unusable:
            raise ClimateGSError(
                f"{folder}: {result.failed} images and {len(result.unusable)} scenes failed, so "
                f"that numbers would be judged by different images; the manifest has the reasons"
            )
        return folder

    def print_evaluation(evaluation: Evaluation) -> None:
        verdict = "holds" if evaluation.holds else "does not hold"
        print_note(
            f"{options.effect} {evaluation.number:.4g} {unit}: {evaluation.score:.4g}, "
            f"{options.until} {verdict}"
        )

    result = search_weather(
        suite,
        options.effect,
        render,
        command_judge(options.command),
        options.until,
        mildest=options.mildest or mildest,
        harshest=options.harshest or harshest,
        tolerance=options.tolerance,
        max_evaluations=options.max_evaluations,
        on_evaluation=print_evaluation,
    )
    print(result_text(result, options.effect, unit))
    facts = {"suite": SUITE, "effect": options.effect, "unit": unit}
    write_json(options.json_file, facts | result.to_json())
    return 0


def result_text(result: SearchResult, effect: str, unit: str) -> str:
    """Return a sentence about the result of a search."""
    mild, harsh = result.interval
    text = (
        f"{result.condition} from {effect} {result.estimate:.4g} {unit} on: between "
        f"{mild:.4g} and {harsh:.4g} {unit}, after {result.num_evaluations} evaluations"
    )
    if result.largest_reversal > 0:
        text += f"; the score went back by up to {result.largest_reversal:.3g} in harsher weather"
    return text
