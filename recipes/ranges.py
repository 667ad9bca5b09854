"""Values of a recipe's fields: fixed ones, and draws from ranges.

The random numbers are pure functions of (seed, variant, path of the field). No generator carries
its state from draw to draw, so a new field or variant leaves all others unchanged. Drawn floats
have 10 significant digits: exp, log and erf differ in the last bit by platform.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import TypeGuard

from recipes.files import file_below

# Domain of the hashes. A change of the scheme changes it, so that no number changes silently.
_DOMAIN = "climategs recipe draw 1"

Triple = tuple[float, float, float]  # a colour, or three rates
Plain = bool | int | float | str | Triple | tuple[str, ...] | None


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


# What a template holds for a field has `is_range`, False where every variant gets the same; `draw`,
# the value of one variant, the path naming its random number; `probes`, the extreme values and
# every option, all of which must be allowed; and `describe`, the range in words, without its unit.


@dataclass(frozen=True)
class Fixed:
    value: Plain
    is_range = False

    def draw(self, draws: Draws, path: str) -> Plain:
        return self.value

    def probes(self) -> tuple[Plain, ...]:
        return (self.value,)

    def describe(self) -> str:
        return format_value(self.value)


@dataclass(frozen=True)
class NamedFile(Fixed):
    """Name of a file as it is written. A draw has its absolute path."""

    value: str
    folder: Path

    def draw(self, draws: Draws, path: str) -> str:
        try:
            return str(file_below(self.folder, self.value))
        except ValueError as error:
            raise ValueError(f"{path} = {self.value!r}: {error}") from None


@dataclass(frozen=True)
class Uniform:
    """Uniform range from low to high. Both ends are included if they are whole numbers.

    log: if True, the logarithm is uniform, as often between 10 and 20 as between 100 and 200; then
    0 < low.
    """

    low: float
    high: float
    log: bool = False
    is_range = True

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

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

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
    is_range = True

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

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        return (
            f"normal with mean {format_value(self.mean)} and deviation {format_value(self.std)}, "
            f"from {format_value(self.low)} to {format_value(self.high)}"
        )


@dataclass(frozen=True)
class Choice:
    """Choice of one of the options, which may be ranges themselves. weights: >= 0, their sum >
    0.
    """

    options: tuple[Value, ...]
    weights: tuple[float, ...]
    is_range = True

    def draw(self, draws: Draws, path: str) -> Plain:
        remaining = draws.unit(path) * math.fsum(self.weights)
        option_index = -1
        for index, weight in enumerate(self.weights):
            if weight > 0:
                option_index = index
                if remaining < weight:
                    break
                remaining -= weight
        return self.options[option_index].draw(draws, f"{path}.choice[{option_index}]")

    def probes(self) -> tuple[Plain, ...]:
        return tuple(probe for option in self.options for probe in option.probes())

    def describe(self) -> str:
        total = math.fsum(self.weights)
        is_even = len(set(self.weights)) == 1
        parts = [
            option.describe() + ("" if is_even else f" ({100 * weight / total:.3g} %)")
            for option, weight in zip(self.options, self.weights, strict=True)
        ]
        return f"one of {', '.join(parts)}"


@dataclass(frozen=True)
class TripleLine:
    """Range on the straight line between two colours. One random number makes no odd mixtures."""

    start: Triple
    end: Triple
    is_range = True

    def draw(self, draws: Draws, path: str) -> Triple:
        unit = draws.unit(path)
        ends = zip(self.start, self.end, strict=True)
        return as_triple(_round_to_range(a + unit * (b - a), min(a, b), max(a, b)) for a, b in ends)

    def probes(self) -> tuple[Triple, ...]:
        return (self.start, self.end)

    def describe(self) -> str:
        return f"uniform from {format_value(self.start)} to {format_value(self.end)}"


@dataclass(frozen=True)
class Channels:
    """Three channels that are drawn one by one."""

    channels: tuple[Value, Value, Value]
    is_range = True

    def draw(self, draws: Draws, path: str) -> Triple:
        return as_triple(c.draw(draws, f"{path}[{i}]") for i, c in enumerate(self.channels))

    def probes(self) -> tuple[Triple, ...]:
        probes = [[as_number(probe) for probe in channel.probes()] for channel in self.channels]
        return (as_triple(map(min, probes)), as_triple(map(max, probes)))

    def describe(self) -> str:
        return f"[{', '.join(channel.describe() for channel in self.channels)}]"


Value = Fixed | Uniform | Normal | Choice | TripleLine | Channels


def _round_to_range(number: float, low: float, high: float) -> float:
    return min(max(float(f"{number:.10g}"), low), high)


def _floor_to_range(number: float, low: float, high: float) -> int:
    return min(max(math.floor(number), int(low)), int(high))


def is_number(value: object) -> TypeGuard[int | float]:
    """Return True for a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_number(value: Plain) -> float:
    """Return the value of a field that was checked to hold a number."""
    assert is_number(value), value
    return value


def as_triple(values: Iterable[Plain]) -> Triple:
    """Return the three channels of a field that was checked to hold a colour or rates."""
    red, green, blue = map(as_number, values)
    return (red, green, blue)


def format_value(value: Plain) -> str:
    """Return a value as it would be written in a recipe, floats shortened."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(format_value(channel) for channel in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
