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

    Knob after knob, in the order of `options`, takes the fastest value with which all that are
    chosen so far stay within the bound, the rest at reference. So the first ones, which should be
    those that save most, have most of the room.

    own_flip: error of one knob at one value, all others at reference; of a value that is beyond the
    bound any number beyond it will do. exceeds: whether settings together are beyond the bound; not
    asked of the reference, whose error is 0.
    """
    settings = reference_settings(options)
    for path, values in options.items():
        for value in values[:-1]:
            tried = settings | {path: value}
            if own_flip(path, value) <= bound and not exceeds(tried):
                settings = tried
                break
    return settings


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
            return _given_back(ladders, places, budget_ms, ms, ms_of)
        left = [path for path, ladder in ladders.items() if places[path] < len(ladder) - 1]
        if not left:
            return Budgeted(settings, ms, is_met=False)
        best = max(left, key=lambda path: _worth(ladders[path][places[path] :]))
        places[best] += 1


def _given_back(
    ladders: Mapping[str, Sequence[Cost]],
    places: dict[str, int],
    budget_ms: float,
    ms: float,
    ms_of: Callable[[Settings], float],
) -> Budgeted:
    """Settings within a budget, each knob as close to reference as the others leave time for."""

    def settings() -> Settings:
        return {path: ladder[places[path]].value for path, ladder in ladders.items()}

    def error(path: str) -> float:
        return ladders[path][places[path]].flip

    for path in sorted(ladders, key=error, reverse=True):
        while places[path] > 0:
            places[path] -= 1
            tried_ms = ms_of(settings())
            if tried_ms > budget_ms:
                places[path] += 1
                break
            ms = tried_ms
    return Budgeted(settings(), ms, is_met=True)


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
