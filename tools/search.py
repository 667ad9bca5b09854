"""`climategs suite search`: the mildest weather at which a user's detector breaks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adapters.base import open_scene
from adapters.scene_cache import scene_digest
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.generate import default_scratch
from augment.suite.search import Evaluation, SearchResult
from augment.suite.searched_weather import (
    NumberRenderer,
    command_judge,
    search_range,
    search_weather,
)
from recipes.suite import load_suite
from tools.output import print_note, write_json
from tools.suite import SUITE, changes_of, scenes_of

if TYPE_CHECKING:
    from tools.cli import SuiteSearchOptions


def search_suite(options: SuiteSearchOptions) -> int:
    """Search, and print and write the result. Return 0."""
    suite = load_suite(SUITE)
    mildest, harshest = search_range(suite, options.effect)
    unit = suite.effects[options.effect].unit

    def setup_of(folder: str) -> JobWorkerSetup:
        return JobWorkerSetup(
            store_uri=folder,
            scratch_dir=default_scratch(folder),
            backend=options.backend,
            open_scene=open_scene,
            scene_digest=scene_digest,
        )

    renderer = NumberRenderer(
        scenes=scenes_of(options),
        setup_of=setup_of,
        out_dir=options.out,
        changes=changes_of(options),
        scale=options.scale,
        workers=options.workers,
    )

    def print_evaluation(evaluation: Evaluation) -> None:
        verdict = "holds" if evaluation.holds else "does not hold"
        print_note(
            f"{options.effect} {evaluation.number:.4g} {unit}: {evaluation.score:.4g}, "
            f"{options.until} {verdict}"
        )

    result = search_weather(
        suite,
        options.effect,
        renderer.render,
        command_judge(options.command),
        options.until,
        mildest=mildest if options.mildest is None else options.mildest,
        harshest=harshest if options.harshest is None else options.harshest,
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
