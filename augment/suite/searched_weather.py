"""Search for the mildest weather of a suite at which a user's detector breaks.

In: an effect of a suite, a renderer, a function that judges a folder of images (`Judge`), a
condition. Out: the result of `augment.suite.search`. Called by `climategs suite search`
(`tools/search.py`).
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from augment.errors import OutputError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.generate import GenerateJob, run_generate
from augment.suite.search import Condition, SearchError, SearchResult, search
from recipes.job import Job, JobScene, scaled_recipe
from recipes.schema import Recipe
from recipes.suite import Suite, SuiteLevel, SuiteVariant

# Function from a folder of images to scores by name.
Judge = Callable[[Path], Mapping[str, Any]]

# Largest number of characters of a command's output in an error.
_MAX_SHOWN = 500

# ---- Weather of a suite at any number ------------------------------------------------------------


def suite_at(suite: Suite, effect: str, number: float) -> Suite:
    """Return a suite whose level 1 of an effect has another physical number.

    Fields follow from those of the neighbouring levels, by a line between the logarithms of
    number and field. All numbers thus have the seed of level 1: the same drops and drifts.

    Args:
        suite: The suite.
        effect: Name of the effect.
        number: The physical number, within those of the levels.

    Raises:
        SearchError: The effect has no single number, or the number is outside of its levels.
    """
    levels, paths = _searchable(suite, effect)
    values = [level.value for level in levels]
    unit = suite.effects[effect].unit
    if not min(values) <= number <= max(values):
        raise SearchError(
            f"{effect}: {number:g} {unit} is not between the levels of {suite.name}, "
            f"{values[0]:g} to {values[-1]:g} {unit}"
        )
    for level in levels:
        if level.value == number:
            return _with_first_level(suite, effect, level)
    upper = next(
        index
        for index in range(1, len(values))
        if min(values[index - 1 : index + 1]) <= number <= max(values[index - 1 : index + 1])
    )
    low_value, high_value = values[upper - 1 : upper + 1]
    share = math.log(number / low_value) / math.log(high_value / low_value)
    low_fields = _flat(levels[upper - 1].set)
    high_fields = _flat(levels[upper].set)
    fields = dict(low_fields)
    for path in paths:
        low = low_fields[path]
        high = high_fields[path]
        fields[path] = low * (high / low) ** share if low > 0 and high > 0 else low
    return _with_first_level(suite, effect, SuiteLevel(value=number, set=fields))


def _with_first_level(suite: Suite, effect: str, level: SuiteLevel) -> Suite:
    """Return a suite with another level 1 of an effect."""
    levels = (level, *suite.effects[effect].levels[1:])
    changed_effect = suite.effects[effect].model_copy(update={"levels": levels})
    return suite.model_copy(update={"effects": {**suite.effects, effect: changed_effect}})


def search_range(suite: Suite, effect: str) -> tuple[float, float]:
    """Return the numbers of an effect's mildest and harshest level.

    Raises:
        SearchError: The effect has no single number.
    """
    levels, _ = _searchable(suite, effect)
    return levels[0].value, levels[-1].value


def _searchable(suite: Suite, effect: str) -> tuple[tuple[SuiteLevel, ...], list[str]]:
    """Return the levels of an effect, and the paths of the fields that change with its number."""
    if effect not in suite.effects:
        suite.select([effect])  # refuses it by name
    paths = _changing_paths(suite, effect)
    if not paths:
        searchable = ", ".join(name for name in suite.effects if _changing_paths(suite, name))
        raise SearchError(
            f"{effect} of {suite.name} cannot be searched: its levels differ in more than a "
            f"number. {searchable} can"
        )
    return suite.effects[effect].levels, paths


def _changing_paths(suite: Suite, effect: str) -> list[str]:
    """Return the paths of the fields that change with an effect's number.

    There are none if the levels differ in anything else, or their numbers do not rise or fall from
    level to level.
    """
    levels = suite.effects[effect].levels
    fields = [_flat(level.set) for level in levels]
    values = [level.value for level in levels]
    is_monotone = sorted({*values}) in (values, values[::-1])
    is_alike = all(f.keys() == fields[0].keys() for f in fields) and not any(x.of for x in levels)
    if not (is_monotone and is_alike):
        return []
    paths = [path for path in fields[0] if any(f[path] != fields[0][path] for f in fields)]
    return paths if all(_is_number(f[path]) for f in fields for path in paths) else []


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _flat(fields: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return fields by dotted path, without nested mappings."""
    flat: dict[str, Any] = {}
    for name, value in fields.items():
        path = f"{prefix}{name}"
        flat |= _flat(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return flat


# ---- Images of that weather ----------------------------------------------------------------------


@dataclass(frozen=True)
class NumberRecipes:
    """Recipes of a dataset job with one variant of a suite, under another name."""

    suite: Suite
    """Suite, of `suite_at`."""
    variant: SuiteVariant
    """The variant."""
    name: str
    """Name of the recipes, by effect and number."""
    changes: Mapping[str, object]
    """Fields of `render` and `output` that differ from the suite, by dotted path."""
    job: Job
    """Name, scale and size of blocks of the job."""

    def resolve_for_scene(self, entry: JobScene, scene_name: str) -> list[Recipe]:
        """Return the recipe in numbers under which a scene is rendered."""
        recipe = self.suite.recipe(self.variant, scene_name, self.changes)
        return [scaled_recipe(recipe.model_copy(update={"name": self.name}), self.job.scale)]


@dataclass(frozen=True)
class NumberRenderer:
    """Renderer of scenes in the weather of a suite at a number."""

    scenes: Sequence[JobScene]
    """Scenes, with patterns already expanded."""
    setup_of: Callable[[str], JobWorkerSetup]
    """Function from an output folder to the output, backend and scene loader of the workers."""
    out_dir: Path
    """Folder in which each number has a folder."""
    changes: Mapping[str, object]
    """Fields of `render` and `output` that differ from the suite, by dotted path."""
    scale: float = 1.0
    """Resolution over that of the suite."""
    workers: int = 1
    """Number of worker processes; 1 renders in this process."""
    progress: bool = True
    """If True, show bars on stderr."""

    def render(self, suite: Suite, variant: SuiteVariant, name: str) -> Path:
        """Render what is missing of a variant, and return the folder of its images.

        Raises:
            OutputError: Images or scenes failed.
        """
        folder = self.out_dir / name
        job = Job.model_validate(
            {"name": name, "scenes": ("any",), "recipes": (name,), "scale": self.scale}
        )
        generate_job = GenerateJob(
            NumberRecipes(suite, variant, name, self.changes, job),
            self.scenes,
            self.setup_of(str(folder)),
            executor="serial" if self.workers == 1 else "processes",
            workers=self.workers,
        )
        result = run_generate(generate_job, progress=self.progress)
        if result.failed or result.unusable:
            raise OutputError(
                f"{folder}: {result.failed} images failed and {len(result.unusable)} scenes cannot "
                f"be used, so that numbers would be judged by different images; the manifest has "
                f"the reasons"
            )
        return folder


# ---- Judges --------------------------------------------------------------------------------------


def command_judge(command: str, timeout_s: float | None = None) -> Judge:
    """Return the judge that runs a command with a folder as its last argument.

    The last line of what the command prints must be a JSON object of scores by name, such as
    `{"recall": 0.48}`. The command is not run by a shell.

    Args:
        command: The command with its arguments, quoted as for a shell.
        timeout_s: Time after which the command is ended; None for any.

    Raises:
        SearchError: The command is empty or ill-quoted.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise SearchError(f"the command {command!r} cannot be read: {error}") from None
    if not words:
        raise SearchError("the command is empty: name a program that reads a folder of images")
    if shutil.which(words[0]) is None:
        raise SearchError(f"{words[0]} cannot be run: there is no such program")

    def judge(folder: Path) -> Mapping[str, Any]:
        try:
            done = subprocess.run(
                [*words, str(folder)], capture_output=True, text=True, timeout=timeout_s
            )
        except OSError as error:
            raise SearchError(f"{words[0]} cannot be run: {error.strerror or error}") from error
        except subprocess.TimeoutExpired as error:
            raise SearchError(f"{words[0]} {folder} took longer than {timeout_s:g} s") from error
        if done.returncode:
            raise SearchError(
                f"{words[0]} {folder} ended with {done.returncode}: "
                f"{(done.stderr or done.stdout).strip()[-_MAX_SHOWN:]}"
            )
        lines = done.stdout.strip().splitlines()
        try:
            scores = json.loads(lines[-1]) if lines else None
        except (ValueError, RecursionError):
            scores = None
        if not isinstance(scores, dict):
            last_line = lines[-1][:_MAX_SHOWN] if lines else ""
            raise SearchError(
                f"{words[0]} {folder}: the last line that it prints must be a JSON object of "
                f'scores, such as {{"recall": 0.48}}; got {last_line!r}'
            )
        return scores

    return judge


# ---- The search ---------------------------------------------------------------------------------


def search_weather(
    suite: Suite,
    effect: str,
    render: Callable[[Suite, SuiteVariant, str], Path],
    judge: Judge,
    until: Condition | str,
    **options: Any,
) -> SearchResult:
    """Return the mildest number of an effect of a suite at which a condition holds.

    Args:
        suite: The suite, which gives the range and all fields that the number does not.
        effect: Name of the effect.
        render: Function that renders a variant of a suite under a name, and returns the folder of
            its images.
        judge: Function from that folder to scores by name.
        until: The condition, or its text.
        options: Further arguments of `search`; `mildest` and `harshest` are the ends of the levels
            by default.

    Raises:
        SearchError: As of `search`, or the effect cannot be searched.
    """
    mildest, harshest = search_range(suite, effect)

    def score_at(number: float) -> Mapping[str, Any]:
        variant = SuiteVariant(effect, 1)
        return judge(render(suite_at(suite, effect, number), variant, f"{effect}-{number:.6g}"))

    return search(
        score_at,
        until,
        options.pop("mildest", mildest),
        options.pop("harshest", harshest),
        **options,
    )
