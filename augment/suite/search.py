"""Search for the mildest weather at which a user's detector breaks.

In: an effect of a suite, a function that judges a folder of images (`Judge`), a condition such as
`recall<0.5`. Out: the physical number at which the condition begins to hold, with its interval.
Called by `climategs suite search` (`tools/search.py`).

The search looks at the ends of the range and at numbers between them first, to see that the
condition is monotone. Then it halves the interval, in the number's logarithm.
"""

from __future__ import annotations

import json
import math
import numbers
import re
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from augment.errors import ClimateGSError
from recipes.suite import Suite, SuiteLevel, SuiteVariant

# Function from a folder of images to scores by name.
Judge = Callable[[Path], Mapping[str, Any]]

_CONDITION = re.compile(r"\s*([A-Za-z_][\w.@-]*)\s*(<=|>=|<|>)\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")
# Number of numbers between the ends that are looked at before the interval is halved.
NUM_CHECKS = 3
# Width of the interval over the number itself at which the search ends.
TOLERANCE = 0.05
# Largest number of evaluations.
MAX_EVALUATIONS = 24
# Largest number of characters of a command's output in an error.
_MAX_SHOWN = 500


class SearchError(ClimateGSError):
    """A search without an answer: the condition always or never holds, or is not monotone."""


# ---- The condition -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Condition:
    """Comparison of a score with a number."""

    score: str
    """Name of the score."""
    operator: str
    """One of <, <=, > and >=."""
    threshold: float
    """The number."""

    @staticmethod
    def parse(text: str) -> Condition:
        """Return the condition in a text such as `recall<0.5`.

        Raises:
            SearchError: The text is none.
        """
        match = _CONDITION.fullmatch(text)
        try:
            if match is not None:
                return Condition(match[1], match[2], float(match[3]))
        except ValueError:
            pass
        raise SearchError(
            f"{text!r} is no condition; write SCORE<NUMBER, as in recall<0.5; <=, > and >= are "
            f"understood, too"
        )

    def __str__(self) -> str:
        return f"{self.score}{self.operator}{self.threshold:g}"

    def holds(self, value: float) -> bool:
        """Return True if the condition holds for a value of the score."""
        return {
            "<": value < self.threshold,
            "<=": value <= self.threshold,
            ">": value > self.threshold,
            ">=": value >= self.threshold,
        }[self.operator]

    def value_in(self, scores: Mapping[str, Any], place: str) -> float:
        """Return the value of the score.

        Args:
            scores: Scores by name.
            place: What they are scores of, for errors.

        Raises:
            SearchError: The score is missing or no finite number.
        """
        if self.score not in scores:
            raise SearchError(
                f"{place}: there is no score {self.score!r}; got {', '.join(scores) or 'none'}"
            )
        value = scores[self.score]
        is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            raise SearchError(f"{place}: {self.score} must be a finite number; got {value!r:.80}")
        return float(value)


# ---- The search ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Evaluation:
    """Score at one number."""

    number: float
    """The physical number."""
    score: float
    """Value of the condition's score."""
    holds: bool
    """True if the condition holds."""


@dataclass(frozen=True)
class SearchResult:
    """The mildest weather in which a condition holds."""

    condition: str
    """The condition."""
    interval: tuple[float, float]
    """Numbers between which the condition begins to hold: at the first, the milder one, it does
    not; at the second it does."""
    estimate: float
    """Number at which the score reaches the threshold, by a line through the interval's ends over
    the number's logarithm."""
    largest_reversal: float
    """Largest amount by which the score went back in harsher weather; noise of the judgement."""
    evaluations: tuple[Evaluation, ...]
    """All evaluations, mildest first."""

    @property
    def num_evaluations(self) -> int:
        """Return the number of evaluations."""
        return len(self.evaluations)

    def to_json(self) -> dict[str, Any]:
        """Return the result for a JSON file."""
        return {**asdict(self), "num_evaluations": self.num_evaluations}


def search(
    score_at: Callable[[float], Mapping[str, Any]],
    until: Condition | str,
    mildest: float,
    harshest: float,
    *,
    tolerance: float = TOLERANCE,
    num_checks: int = NUM_CHECKS,
    max_evaluations: int = MAX_EVALUATIONS,
    on_evaluation: Callable[[Evaluation], None] = lambda evaluation: None,
) -> SearchResult:
    """Return the mildest number at which a condition holds.

    Args:
        score_at: Function from a physical number to scores by name. It is called once a number.
        until: The condition, or its text.
        mildest: End of the range at which the condition must not hold; above 0.
        harshest: Other end, at which it must hold; above 0. It may be the smaller number, as of
            visibilities.
        tolerance: Width of the interval over its smaller end at which the search ends.
        num_checks: Numbers between the ends that are looked at before the interval is halved; more
            of them find a condition that holds in mild weather and not in harsher weather.
        max_evaluations: Largest number of calls of `score_at`.
        on_evaluation: Called after each evaluation.

    Raises:
        SearchError: The condition holds at both ends or at none, is not monotone, or a score is
            missing.
        ValueError: An argument is out of range.
    """
    condition = Condition.parse(until) if isinstance(until, str) else until
    if not all(math.isfinite(end) and end > 0 for end in (mildest, harshest)):
        raise ValueError(f"mildest and harshest must be above 0; got {mildest}, {harshest}")
    if mildest == harshest:
        raise ValueError(f"mildest and harshest must differ; got {mildest} for both")
    if not 0 < tolerance < 10:
        raise ValueError(f"tolerance must be above 0 and below 10; got {tolerance}")
    if num_checks < 0 or max_evaluations < num_checks + 2:
        raise ValueError(
            f"max_evaluations must be at least num_checks + 2 = {num_checks + 2}; got "
            f"{max_evaluations}"
        )
    evaluations: dict[float, Evaluation] = {}

    def evaluate(number: float) -> Evaluation:
        value = condition.value_in(score_at(number), f"at {number:g}")
        evaluations[number] = Evaluation(number, value, condition.holds(value))
        on_evaluation(evaluations[number])
        return evaluations[number]

    mild = evaluate(mildest)
    if mild.holds:
        raise SearchError(
            f"{condition} holds at the mildest number {mildest:g} already, where {condition.score} "
            f"is {mild.score:.4g}: begin with milder weather, or see whether it holds in clean "
            f"images too"
        )
    harsh = evaluate(harshest)
    if not harsh.holds:
        raise SearchError(
            f"{condition} never holds: at the harshest number {harshest:g} {condition.score} is "
            f"{harsh.score:.4g}, at the mildest, {mildest:g}, {mild.score:.4g}. Go on to harsher "
            f"weather, or ask for less"
        )
    ratio = harshest / mildest
    for step in range(1, num_checks + 1):
        evaluate(mildest * ratio ** (step / (num_checks + 1)))
    mild, harsh = _bracket(condition, evaluations, mildest, harshest)
    while _relative_width(mild, harsh) > tolerance and len(evaluations) < max_evaluations:
        middle = evaluate(math.sqrt(mild.number * harsh.number))
        mild, harsh = (mild, middle) if middle.holds else (middle, harsh)
    ordered = _from_mildest(evaluations, mildest, harshest)
    return SearchResult(
        condition=str(condition),
        interval=(mild.number, harsh.number),
        estimate=_estimate(condition, mild, harsh),
        largest_reversal=_largest_reversal(condition, ordered),
        evaluations=tuple(ordered),
    )


def _from_mildest(
    evaluations: Mapping[float, Evaluation], mildest: float, harshest: float
) -> list[Evaluation]:
    """Return evaluations from the mildest number to the harshest one."""
    return [evaluations[n] for n in sorted(evaluations, reverse=harshest < mildest)]


def _bracket(
    condition: Condition, evaluations: Mapping[float, Evaluation], mildest: float, harshest: float
) -> tuple[Evaluation, Evaluation]:
    """Return the neighbouring evaluations between which a condition begins to hold.

    Raises:
        SearchError: It begins to hold more than once.
    """
    ordered = _from_mildest(evaluations, mildest, harshest)
    first = next(index for index, evaluation in enumerate(ordered) if evaluation.holds)
    if exceptions := [e for e in ordered[first:] if not e.holds]:
        scores = ", ".join(f"{e.score:.4g} at {e.number:.4g}" for e in ordered)
        raise SearchError(
            f"{condition} is not monotone: it holds at {ordered[first].number:.4g} and not in the "
            f"harsher weather of {exceptions[0].number:.4g}; {condition.score} is {scores}. Judge "
            f"more images, so that the score has less noise, or search in a smaller range"
        )
    return ordered[first - 1], ordered[first]


def _relative_width(mild: Evaluation, harsh: Evaluation) -> float:
    """Return the width of an interval over its smaller end."""
    low, high = sorted((mild.number, harsh.number))
    return high / low - 1


def _estimate(condition: Condition, mild: Evaluation, harsh: Evaluation) -> float:
    """Return the number at which a line through two evaluations meets the threshold."""
    change = harsh.score - mild.score
    share = (condition.threshold - mild.score) / change if change else 0.5
    return mild.number * (harsh.number / mild.number) ** min(max(share, 0.0), 1.0)


def _largest_reversal(condition: Condition, ordered: Sequence[Evaluation]) -> float:
    """Return the largest amount by which the score went back on the way to harsher weather."""
    sign = -1.0 if condition.operator.startswith("<") else 1.0
    extreme = -math.inf
    reversal = 0.0
    for evaluation in ordered:
        extreme = max(extreme, sign * evaluation.score)
        reversal = max(reversal, extreme - sign * evaluation.score)
    return reversal


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
    levels = suite.effects[effect].levels
    fields = [_flat(level.set) for level in levels]
    values = [level.value for level in levels]
    rises = sorted(values) in (values, values[::-1]) and len({*values}) == len(values)
    is_alike = all(f.keys() == fields[0].keys() for f in fields) and not any(x.of for x in levels)
    changing = [path for path in fields[0] if is_alike and len({str(f[path]) for f in fields}) > 1]
    if not changing or not rises or not all(_is_number(f[p]) for f in fields for p in changing):
        searchable = ", ".join(name for name in suite.effects if _is_searchable(suite, name))
        raise SearchError(
            f"{effect} of {suite.name} cannot be searched: its levels differ in more than a "
            f"number. {searchable} can"
        )
    return levels, changing


def _is_searchable(suite: Suite, effect: str) -> bool:
    levels = suite.effects[effect].levels
    fields = [_flat(level.set) for level in levels]
    return (
        not any(level.of for level in levels)
        and all(f.keys() == fields[0].keys() for f in fields)
        and all(_is_number(f[p]) or f[p] == fields[0][p] for f in fields for p in f)
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _flat(fields: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return fields by dotted path, without nested mappings."""
    flat: dict[str, Any] = {}
    for name, value in fields.items():
        path = f"{prefix}{name}"
        flat |= _flat(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return flat


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
