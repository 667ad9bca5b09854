"""Ranges of a recipe's fields, and draws from them.

The random numbers are pure functions of (seed, variant, path of the field). No generator carries
its state from draw to draw, so a new field or variant leaves all others unchanged. Drawn floats
have 10 significant digits: exp, log and erf differ in the last bit by platform.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any, TypeGuard

from recipes.errors import join
from recipes.files import file_below
from recipes.speed import former_path
from recipes.timeline import TIMELINE, DrawnTimeline, Shape, TimeUnit

# Domain of the hashes. A change of the scheme changes it, so that no number changes silently.
_DOMAIN = "climategs recipe draw 1"

# In the order in which messages list them.
RANGE_KINDS = ("uniform", "log_uniform", "normal", "choice")
# Kinds of mappings that stand in the place of a field's value.
FIELD_KINDS = (*RANGE_KINDS, TIMELINE)
# Largest standard deviation of a normal range over its width. A wider normal is uniform for all
# purposes, and loses digits.
MAX_STD_PER_WIDTH = 1000

Triple = tuple[float, float, float]  # a colour, or three rates


@dataclass(frozen=True)
class Draws:
    """Random numbers of one variant."""

    seed: int
    variant: int

    def unit(self, path: str) -> float:
        """Return the number in [0, 1) that belongs to `path`: 53 bits of a SHA-256."""
        key = json.dumps([_DOMAIN, self.seed, self.variant, path])
        digest = hashlib.sha256(key.encode()).digest()
        return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53


Location = tuple[int | str, ...]  # keys and indices: ("weather", "flood", "waves", "seed")
Fault = tuple[Location, str]  # the part of a range, such as ("choice", 1), and what is wrong there


@dataclass(frozen=True)
class End:
    """Value that a field can take: an end of its range, an option of its choice.

    parts: the parts of ranges from which it is, by their places in it: {(): ("uniform", 1)}, or
    {(2,): ("uniform", 1)} for a colour whose third channel has a range.
    """

    value: Any
    parts: dict[Location, Location]


# ---- Ranges --------------------------------------------------------------------------------------
#
# `draw` returns the value of one variant; its path names its random number. `ends` are checked
# first, and then `faults` says what else is wrong. `describe` is the range in words.


@dataclass(frozen=True)
class Uniform:
    """Uniform range from low to high. Both ends are included if they are whole numbers.

    log: if True, the logarithm is uniform, as often between 10 and 20 as between 100 and 200; then
    0 < low.
    """

    low: float
    high: float
    log: bool = False

    def draw(self, draws: Draws, path: str) -> float:
        unit = draws.unit(path)
        low = self.low
        high = self.high
        is_whole = isinstance(low, int)
        if self.log:
            top = high + 1 if is_whole else high  # k stands for the reals in [k, k + 1)
            start = math.log(low)
            end = math.log(top)
            number = math.exp(start + unit * (end - start))
        elif is_whole:
            number = low + unit * (high - low + 1)
        else:
            number = low + unit * (high - low)
        return (
            _floor_to_range(number, low, high) if is_whole else _round_to_range(number, low, high)
        )

    def ends(self) -> list[End]:
        kind = "log_uniform" if self.log else "uniform"
        return [End(self.low, {(): (kind, 0)}), End(self.high, {(): (kind, 1)})]

    def faults(self) -> Iterator[Fault]:
        if self.low > self.high:
            yield (), "the low end comes first"

    def describe(self) -> str:
        kind = "log-uniform" if self.log else "uniform"
        return f"{kind} from {format_value(self.low)} to {format_value(self.high)}"


@dataclass(frozen=True)
class Normal:
    """Normal range cut off at low and high, drawn by the inverse of its distribution.

    low <= mean <= high. Draws are whole if low and high are; the mean and the deviation need not
    be.
    """

    mean: float
    std: float
    low: float
    high: float

    def draw(self, draws: Draws, path: str) -> float:
        is_whole = isinstance(self.low, int)
        margin = 0.5 if is_whole else 0.0  # a whole number stands for the reals that round to it
        normal = NormalDist(self.mean, self.std)
        below = normal.cdf(self.low - margin)
        inside = normal.cdf(self.high + margin) - below
        # inv_cdf takes no 0 or 1; the values it would give there are cut off to an end anyway
        probability = min(max(below + draws.unit(path) * inside, 1e-300), 1 - 2.0**-53)
        number = normal.inv_cdf(probability)
        if is_whole:
            return _floor_to_range(number + 0.5, self.low, self.high)
        return _round_to_range(number, self.low, self.high)

    def ends(self) -> list[End]:
        return [End(self.low, {(): ("normal", "min")}), End(self.high, {(): ("normal", "max")})]

    def faults(self) -> Iterator[Fault]:
        if not self.low < self.high:
            yield (), "max must be > min"
        elif not self.low <= self.mean <= self.high:
            yield (), f"mean must be from min to max, {self.low:g} to {self.high:g}"
        elif self.std > MAX_STD_PER_WIDTH * (self.high - self.low):
            yield (), f"std must be <= {MAX_STD_PER_WIDTH} (max - min); wider is uniform"

    def describe(self) -> str:
        return (
            f"normal with mean {format_value(self.mean)} and deviation {format_value(self.std)}, "
            f"from {format_value(self.low)} to {format_value(self.high)}"
        )


@dataclass(frozen=True)
class Choice:
    """Choice of one of the options, which may be ranges themselves, by weights >= 0."""

    options: tuple[Any, ...]
    weights: tuple[float, ...]

    def draw(self, draws: Draws, path: str) -> Any:
        remaining = draws.unit(path) * math.fsum(self.weights)
        option_index = -1
        for index, weight in enumerate(self.weights):
            if weight > 0:
                option_index = index
                if remaining < weight:
                    break
                remaining -= weight
        return draw(self.options[option_index], draws, f"{path}.choice[{option_index}]")

    def ends(self) -> list[End]:
        return [
            End(end.value, {**end.parts, (): ("choice", i, *end.parts.get((), ()))})
            for i, option in enumerate(self.options)
            for end in ends(option)
        ]

    def faults(self) -> Iterator[Fault]:
        for i, option in enumerate(self.options):
            yield from (((("choice", i, *part), text)) for part, text in faults(option))
        if len(self.weights) != len(self.options):
            yield (), f"weights must be {len(self.options)} numbers, one for each option"
        # bounds keep the sum finite and every share representable
        elif not any(self.weights) or any(0 < weight < 1e-9 for weight in self.weights):
            yield (), "each weight is 0 or from 1e-9 to 1e9, and one is above 0"

    def describe(self) -> str:
        total = math.fsum(self.weights)
        is_even = len(set(self.weights)) == 1
        parts = [
            describe(option) + ("" if is_even else f" ({100 * weight / total:.3g} %)")
            for option, weight in zip(self.options, self.weights, strict=True)
        ]
        return f"one of {', '.join(parts)}"


@dataclass(frozen=True)
class TripleLine:
    """Range on the straight line between two colours. One random number makes no odd mixtures."""

    start: Triple
    end: Triple

    def draw(self, draws: Draws, path: str) -> Triple:
        unit = draws.unit(path)
        ends = zip(self.start, self.end, strict=True)
        red, green, blue = (
            _round_to_range(a + unit * (b - a), min(a, b), max(a, b)) for a, b in ends
        )
        return (red, green, blue)

    def ends(self) -> list[End]:
        return [End(self.start, {(): ("uniform", 0)}), End(self.end, {(): ("uniform", 1)})]

    def faults(self) -> Iterator[Fault]:
        return iter(())

    def describe(self) -> str:
        return f"uniform from {format_value(self.start)} to {format_value(self.end)}"


@dataclass(frozen=True)
class NamedFile:
    """Name of a file as it is written. A draw has its absolute path. folder: None without one."""

    name: str
    folder: Path | None

    def draw(self, draws: Draws, path: str) -> str:
        for _, text in self.faults():
            raise ValueError(f"{path} = {self.name!r}: {text}")
        assert self.folder is not None
        return str(file_below(self.folder, self.name))

    def ends(self) -> list[End]:
        return [End(self.name, {})]

    def faults(self) -> Iterator[Fault]:
        if self.folder is None:
            yield (), "this text is in no file, so there is no folder to look in; save it as one"
            return
        try:
            file_below(self.folder, self.name)
        except ValueError as error:
            yield (), str(error)

    def describe(self) -> str:
        return self.name


@dataclass(frozen=True)
class Timeline:
    """Values over time. Times and values may have ranges; draws keep the times in order.

    Attributes:
        points: pairs of a time and a value, in the order of the times.
        shape: form of the curve between points: linear, step or smooth.
        times: unit of the times: seconds, or share of the drive.
        place: file and line of the timeline, for messages.
    """

    points: tuple[tuple[Any, Any], ...]
    shape: Shape = "linear"
    times: TimeUnit = "seconds"
    place: str = ""

    def draw(self, draws: Draws, path: str) -> DrawnTimeline:
        points = tuple(
            (
                float(draw(time, draws, f"{path}.{TIMELINE}[{i}][0]")),
                draw(value, draws, f"{path}.{TIMELINE}[{i}][1]"),
            )
            for i, (time, value) in enumerate(self.points)
        )
        return DrawnTimeline(points, self.shape, self.times, self.place)

    def ends(self) -> list[End]:
        return [
            End(end.value, {(): (TIMELINE, i, 1, *end.parts.get((), ()))})
            for i, (_, value) in enumerate(self.points)
            for end in ends(value)
        ]

    def faults(self) -> Iterator[Fault]:
        latest = -math.inf
        for i, (time, value) in enumerate(self.points):
            place = (TIMELINE, i)
            for j, part in enumerate((time, value)):
                yield from (((*place, j, *inner), text) for inner, text in faults(part))
            times = [end.value for end in ends(time)]
            if min(times) <= latest:
                text = f"times must rise from point to point; the point before is at {latest:g}"
                yield (*place, 0), text + (" in some draws" if is_range(time) else "")
            latest = max(latest, *times)
            if self.times == "share" and max(times) > 1:
                yield (*place, 0), "must be <= 1, the drive's end; negative is before its start"

    def describe(self) -> str:
        unit = "of the drive" if self.times == "share" else "s"
        texts = [f"{describe(value)} at {describe(time)} {unit}" for time, value in self.points]
        return f"{self.shape} timeline: {', '.join(texts)}"


Range = Uniform | Normal | Choice | TripleLine


# ---- Values of a template: plain ones, ranges, and mappings and lists of them --------------------


def draw(value: Any, draws: Draws, path: str) -> Any:
    """Return a template's value in one variant. Items of lists are drawn one by one."""
    if isinstance(value, Range | NamedFile | Timeline):
        return value.draw(draws, former_path(path))
    if isinstance(value, list | tuple):
        return type(value)(draw(item, draws, f"{path}[{i}]") for i, item in enumerate(value))
    if not isinstance(value, Mapping):
        return value
    share = value.get("probability")
    if share is not None and draws.unit(join(path, "probability")) >= share:
        return None  # the variant has not this effect
    fields = {name: item for name, item in value.items() if name != "probability"}
    return {name: draw(item, draws, join(path, name)) for name, item in fields.items()}


def ends(value: Any) -> list[End]:
    """Return the ends of a field's range and the options of a choice; a plain value is its end.

    A colour whose channels have ranges takes the first ends of all, then the second ones.
    """
    if isinstance(value, Range | NamedFile | Timeline):
        return value.ends()
    if not isinstance(value, tuple) or not value:
        return [End(value, {})]
    columns = [ends(item) for item in value]
    rows = [[c[min(row, len(c) - 1)] for c in columns] for row in range(max(map(len, columns)))]
    return [
        End(
            tuple(end.value for end in row),
            {(i,): end.parts[()] for i, end in enumerate(row) if end.parts},
        )
        for row in rows
    ]


def faults(value: Any) -> Iterator[Fault]:
    """Yield what is wrong with ranges and files' names, though every end is allowed."""
    if isinstance(value, Range | NamedFile | Timeline):
        yield from value.faults()
    for i, item in enumerate(value if isinstance(value, tuple) else ()):
        yield from (((i, *part), text) for part, text in faults(item))


def is_range(value: Any) -> bool:
    """Return True if the value of a field differs between variants."""
    if isinstance(value, Timeline):
        return is_range(value.points)
    return isinstance(value, Range) or (isinstance(value, tuple) and any(map(is_range, value)))


def describe(value: Any) -> str:
    """Return the value of a field in words, without its unit."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(describe, value))}]"
    is_plain = not isinstance(value, Range | NamedFile | Timeline)
    return format_value(value) if is_plain else value.describe()


def _round_to_range(number: float, low: float, high: float) -> float:
    return min(max(float(f"{number:.10g}"), low), high)


def _floor_to_range(number: float, low: float, high: float) -> int:
    return min(max(math.floor(number), int(low)), int(high))


def is_number(value: object) -> TypeGuard[int | float]:
    """Return True for a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def format_value(value: object) -> str:
    """Return a plain value as it would be written in a recipe, floats shortened."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(format_value(channel) for channel in value)}]"
    if isinstance(value, DrawnTimeline):
        return format_value(value.points)
    return f"{value:g}" if isinstance(value, float) else str(value)
