"""From what the values of each knob cost and save to a setting of all of them; renders nothing.

`options` are the values that a choice is made from, by the knobs' paths: from the fastest to the
most accurate, which is the reference. What is not measured yet is asked for when it is needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from recipes.knobs import Value

Settings = dict[str, Value]
Options = Mapping[str, Sequence[Value]]

LEAST_SAVED = 0.02  # of the reference's time: less is noise of a few pictures


@dataclass(frozen=True)
class Cost:
    """One knob at one value, all others at reference. ms: of a frame. flip: against reference."""

    value: Value
    ms: float
    flip: float


@dataclass(frozen=True)
class Budgeted:
    """ms: the frame time of the settings together. is_met: whether it is within the budget."""

    settings: Settings
    ms: float
    is_met: bool


def reference_settings(options: Options) -> Settings:
    return {path: values[-1] for path, values in options.items()}


def within_flip(
    options: Options,
    bound: float,
    own_flip: Callable[[str, Value], float],
    exceeds: Callable[[Settings], bool],
) -> Settings:
    """Fast settings whose pictures together are within the bound.

    Every knob starts at its fastest value whose own error is within the bound. While all together
    exceed it, the knob with the largest own error goes a step back towards reference.

    own_flip: error of one knob at one value, all others at reference; of a value that is beyond the
    bound any number beyond it will do. exceeds: whether settings together are beyond the bound; not
    asked of the reference, whose error is 0.
    """
    places: dict[str, int] = {}
    for path, values in options.items():
        last = len(values) - 1
        fit = (n for n in range(last) if own_flip(path, values[n]) <= bound)
        places[path] = next(fit, last)

    def at_places() -> Settings:
        return {path: options[path][place] for path, place in places.items()}

    def error(path: str) -> float:
        return own_flip(path, options[path][places[path]])

    while left := [path for path, place in places.items() if place < len(options[path]) - 1]:
        if not exceeds(at_places()):
            break
        places[max(left, key=error)] += 1  # of equal ones the first of the table
    return at_places()


def within_budget(
    options: Options,
    budget_ms: float,
    costs: Mapping[str, Sequence[Cost]],
    ms_of: Callable[[Settings], float],
) -> Budgeted:
    """Accurate settings whose frames together take no longer than the budget.

    From reference on, the knob goes a step on that saves the most time for the error that it adds,
    by what each costs alone, and the time of all together is measured again, until it is within
    the budget or no step is left that saves anything.

    costs: of every value of every knob, its reference included. ms_of: time of settings together.
    """
    ladders = {path: useful(costs[path]) for path in options}
    places = dict.fromkeys(options, 0)
    while True:
        settings = {path: ladder[places[path]].value for path, ladder in ladders.items()}
        ms = ms_of(settings)
        if ms <= budget_ms:
            return Budgeted(settings, ms, is_met=True)
        left = [path for path, ladder in ladders.items() if places[path] < len(ladder) - 1]
        if not left:
            return Budgeted(settings, ms, is_met=False)
        best = max(left, key=lambda path: _worth(ladders[path][places[path] :]))
        places[best] += 1


def useful(costs: Sequence[Cost]) -> list[Cost]:
    """Of a knob's values, from the fastest to reference, those worth a step: from reference on,
    each faster than all that are as accurate or more so.
    """
    reference = costs[-1]
    least_ms = LEAST_SAVED * reference.ms
    kept = [reference]
    # Of values with equal errors the fastest comes first, and the others save nothing then.
    for cost in sorted(costs[:-1], key=lambda cost: (cost.flip, cost.ms)):
        if kept[-1].ms - cost.ms > least_ms:
            kept.append(cost)
    return kept


def _worth(ladder: Sequence[Cost]) -> tuple[float, float]:
    """Time saved for the error added, then time saved, of the best of the steps down a ladder.

    Where a step is poor and the one behind it good, it is the way there.
    """
    before, *after = ladder
    saved = [(before.ms - cost.ms, cost.flip - before.flip) for cost in after]
    return max((ms / error if error > 0 else math.inf, ms) for ms, error in saved)
