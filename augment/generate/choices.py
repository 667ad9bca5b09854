"""What the qualities of a job's recipes choose in its scenes, before there is a plan.

A choice is kept in the output: the scenes in which everything was chosen are not opened again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from tqdm import tqdm

from augment.batch.layout import variant_name
from augment.batch.store import Store
from augment.batch.trajectory import RECORDED
from augment.generate.drive import Driver
from augment.generate.records import SceneRecord
from augment.generate.workshop import SettledRecipes, SettleTask
from recipes.schema import Recipe

if TYPE_CHECKING:
    from augment.generate.job import GenerateJob

_READS = 16  # at a time: most of the time of one is waiting

Found = Mapping[tuple[str, str | None], SceneRecord | str]
Choices = dict[tuple[str, str], Recipe | str]


def settle_recipes(
    job: GenerateJob, store: Store, driver: Driver, found: Found, *, progress: bool, keep: bool
) -> Choices:
    """By scene and variant: the recipes that had to choose, settled, or why they could not.

    found: the scene of every URI and name. keep: whether new choices are kept in the output.

    Raises:
        OutputError: a record in the output is damaged, or cannot be read or written.
    """
    wanted = _wanted(job, found)
    if not wanted:
        return {}
    choices, left = _recorded(store, wanted, job.setup.backend)
    tasks = {
        SettleTask(record.uri, name, tuple(recipes), keep): record for record, name, recipes in left
    }
    bar = tqdm(
        total=len(tasks),
        unit="scene",
        desc="choosing settings",
        disable=not progress or not tasks,
    )

    def each(task: SettleTask, settled: SettledRecipes | str) -> None:
        for number, recipe in enumerate(task.recipes):
            outcome = settled if isinstance(settled, str) else settled.recipes[number]
            choices[tasks[task].name, variant_name(recipe)] = outcome
        bar.update()

    with bar:
        timed = any(r.quality.budget_ms is not None for task in tasks for r in task.recipes)
        driver.settle(_turned(list(tasks), *job.shard), each, one_by_one=timed)
    return choices


_Wanted = list[tuple[SceneRecord, str | None, list[Recipe]]]


def _wanted(job: GenerateJob, found: Found) -> _Wanted:
    """Scenes with their names in the job and the recipes that have to choose there."""
    wanted: _Wanted = []
    for entry in job.scenes:
        record = found[entry.uri, entry.name]
        if isinstance(record, SceneRecord):
            drawn = job.recipes.of_scene(entry, record.name)
            if unsettled := [recipe for recipe in drawn if recipe.quality.is_open]:
                wanted.append((record, entry.name, unsettled))
    return wanted


def _recorded(store: Store, wanted: _Wanted, backend: str) -> tuple[Choices, _Wanted]:
    """What the output knows already, and what is left to choose."""
    from augment.quality.record import Question, recorded

    questions = [
        Question(recipe, record.name, record.source, RECORDED, backend)
        for record, _, recipes in wanted
        for recipe in recipes
    ]
    with ThreadPoolExecutor(_READS, thread_name_prefix="choices") as pool:
        answers = list(pool.map(lambda question: recorded(store, question), questions))
    choices: Choices = {
        (question.scene, variant_name(question.recipe)): answer
        for question, answer in zip(questions, answers, strict=True)
        if answer is not None
    }
    left: _Wanted = []
    for record, name, recipes in wanted:
        rest = [r for r in recipes if (record.name, variant_name(r)) not in choices]
        if rest:
            left.append((record, name, rest))
    return choices, left


def _turned(tasks: Sequence[SettleTask], number: int, count: int) -> list[SettleTask]:
    """Each shard begins elsewhere, so that those that start together do not wait for each other."""
    start = (number - 1) * len(tasks) // count
    return [*tasks[start:], *tasks[:start]]
