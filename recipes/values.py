"""How one field of a recipe gets its value: a fixed one, or a draw from a range.

Draws of floats are rounded to 10 significant digits, then kept inside the ends: exp, log and erf
may differ in the last bit between platforms, and a recipe's numbers should not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Protocol, TypeGuard

from recipes.sampler import Draws

Triple = tuple[float, float, float]  # a colour, or three rates
RANGE_KINDS = ("uniform", "log_uniform", "normal", "choice")
Plain = bool | int | float | str | Triple | None


class Value(Protocol):
    """What a template holds for a field."""

    @property
    def is_range(self) -> bool:
        """False where every variant gets the same."""
        ...

    def draw(self, draws: Draws, path: str) -> Plain:
        """The value of one variant; `path` names its random number."""
        ...

    def probes(self) -> tuple[Plain, ...]:
        """The extreme values of the range, and every option of a choice: all must be allowed."""
        ...

    def describe(self) -> str:
        """The range in words, without its unit."""
        ...


@dataclass(frozen=True)
class Fixed:
    value: Plain
    is_range = False

    def draw(self, draws: Draws, path: str) -> Plain:
        return self.value

    def probes(self) -> tuple[Plain, ...]:
        return (self.value,)

    def describe(self) -> str:
        return words(self.value)


@dataclass(frozen=True)
class Uniform:
    """Every value from low to high alike; both ends included where whole."""

    low: float
    high: float
    whole: bool = False
    is_range = True

    def draw(self, draws: Draws, path: str) -> float:
        unit = draws.unit(path)
        if self.whole:
            low, high = int(self.low), int(self.high)
            return min(low + math.floor(unit * (high - low + 1)), high)
        return _rounded(self.low + unit * (self.high - self.low), self.low, self.high)

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        return f"uniform from {words(self.low)} to {words(self.high)}"


@dataclass(frozen=True)
class LogUniform:
    """The logarithm is uniform: as often between 10 and 20 as between 100 and 200. 0 < low."""

    low: float
    high: float
    whole: bool = False
    is_range = True

    def draw(self, draws: Draws, path: str) -> float:
        top = self.high + 1 if self.whole else self.high  # k stands for the reals in [k, k + 1)
        start, end = math.log(self.low), math.log(top)
        drawn = math.exp(start + draws.unit(path) * (end - start))
        if self.whole:
            return min(max(math.floor(drawn), int(self.low)), int(self.high))
        return _rounded(drawn, self.low, self.high)

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        return f"log-uniform from {words(self.low)} to {words(self.high)}"


@dataclass(frozen=True)
class Normal:
    """Normal, cut off at low and high, by the inverse of its distribution. low <= mean <= high."""

    mean: float
    std: float
    low: float
    high: float
    whole: bool = False
    is_range = True

    def draw(self, draws: Draws, path: str) -> float:
        margin = 0.5 if self.whole else 0.0  # a whole number stands for the reals that round to it
        normal = NormalDist(self.mean, self.std)
        below = normal.cdf(self.low - margin)
        inside = normal.cdf(self.high + margin) - below
        # inv_cdf takes no 0 or 1; the values it would give there are cut off to an end anyway
        probability = min(max(below + draws.unit(path) * inside, 1e-300), 1 - 2.0**-53)
        drawn = normal.inv_cdf(probability)
        if self.whole:
            return min(max(math.floor(drawn + 0.5), int(self.low)), int(self.high))
        return _rounded(drawn, self.low, self.high)

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        return (
            f"normal with mean {words(self.mean)} and deviation {words(self.std)}, "
            f"from {words(self.low)} to {words(self.high)}"
        )


@dataclass(frozen=True)
class Choice:
    """One of the options, which may be ranges themselves. weights: >= 0, their sum > 0."""

    options: tuple[Value, ...]
    weights: tuple[float, ...]
    is_range = True

    def draw(self, draws: Draws, path: str) -> Plain:
        remaining = draws.unit(path) * math.fsum(self.weights)
        chosen = -1
        for index, weight in enumerate(self.weights):
            if weight > 0:
                chosen = index
                if remaining < weight:
                    break
                remaining -= weight
        return self.options[chosen].draw(draws, f"{path}.choice[{chosen}]")

    def probes(self) -> tuple[Plain, ...]:
        return tuple(probe for option in self.options for probe in option.probes())

    def describe(self) -> str:
        total = math.fsum(self.weights)
        even = len(set(self.weights)) == 1
        parts = [
            option.describe() + ("" if even else f" ({100 * weight / total:.3g} %)")
            for option, weight in zip(self.options, self.weights, strict=True)
        ]
        return f"one of {', '.join(parts)}"


@dataclass(frozen=True)
class TripleLine:
    """On the straight line from one to another: one random number, so no odd mixtures."""

    start: Triple
    end: Triple
    is_range = True

    def draw(self, draws: Draws, path: str) -> Triple:
        unit = draws.unit(path)
        ends = zip(self.start, self.end, strict=True)
        return as_triple(_rounded(a + unit * (b - a), min(a, b), max(a, b)) for a, b in ends)

    def probes(self) -> tuple[Triple, ...]:
        return (self.start, self.end)

    def describe(self) -> str:
        return f"uniform from {words(self.start)} to {words(self.end)}"


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


def _rounded(drawn: float, low: float, high: float) -> float:
    return min(max(float(f"{drawn:.10g}"), low), high)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether this is a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_number(value: Plain) -> float:
    """The value of a field that was checked to hold a number."""
    assert is_number(value), value
    return value


def as_triple(values: Iterable[Plain]) -> Triple:
    """The three channels of a field that was checked to hold a colour or rates."""
    red, green, blue = map(as_number, values)
    return (red, green, blue)


def words(value: Plain) -> str:
    """A value as it would be written in a recipe, floats shortened."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(words(channel) for channel in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
