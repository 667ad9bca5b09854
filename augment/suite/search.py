"""Search for the mildest number at which a condition on scores begins to hold.

In: a function from a physical number to scores, a condition such as `recall<0.5`. Out: the number,
with its interval. `augment.suite.searched_weather` has the weather of a suite at any number.

The search looks at the ends of the range and at numbers between them first, to see that the
condition is monotone. Then it halves the interval, in the number's logarithm.
"""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from augment.errors import ClimateGSError

_CONDITION = re.compile(r"\s*([A-Za-z_][\w.@-]*)\s*(<=|>=|<|>)\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")
# Number of numbers between the ends that are looked at before the interval is halved.
NUM_CHECKS = 3
# Width of the interval over the number itself at which the search ends.
TOLERANCE = 0.05
# Largest number of evaluations.
MAX_EVALUATIONS = 24


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
