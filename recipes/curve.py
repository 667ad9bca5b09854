"""A number as a function of time, with exact values and integrals."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from recipes import polynomial
from recipes.polynomial import Polynomial

Shape = Literal["linear", "step", "smooth"]


@dataclass(frozen=True)
class Piece:
    """Part of a curve on which it is one polynomial of the time since the part began."""

    start_s: float
    """Begin of the part, seconds."""
    end_s: float
    """End of the part, seconds."""
    coefficients: Polynomial
    """Coefficients of 1, t, t^2, t^3, where t is the time since `start_s` in seconds."""

    def value(self, time_s: float) -> float:
        """Return the polynomial's value at a time of the part."""
        return polynomial.value(self.coefficients, time_s - self.start_s)

    def integral(self, time_s: float) -> float:
        """Return the integral from the part's begin to a time of the part, value x seconds."""
        return polynomial.value(polynomial.integral(self.coefficients), time_s - self.start_s)


@dataclass(frozen=True)
class Curve:
    """A number over time: that of the first point before it, that of the last point after it.

    Between two points it is a straight line, or (`step`) the earlier point's number, or (`smooth`)
    a cubic that is level at both points and never leaves the range between their numbers.
    """

    times_s: tuple[float, ...]
    """Times of the points, seconds, rising."""
    values: tuple[float, ...]
    """Numbers at the points."""
    shape: Shape = "linear"
    """Form of the curve between points."""

    @staticmethod
    def constant(value: float) -> Curve:
        """Return the curve that has one number at all times."""
        return Curve((0.0,), (value,))

    @property
    def is_constant(self) -> bool:
        """Return True if the number never changes."""
        return len(set(self.values)) == 1

    def value(self, time_s: float) -> float:
        """Return the number at a time, seconds."""
        index = bisect.bisect_right(self.times_s, time_s) - 1
        if index < 0:
            return self.values[0]
        if index == len(self.times_s) - 1:
            return self.values[-1]
        return self._piece(index).value(time_s)

    def integral(self, start_s: float, end_s: float) -> float:
        """Return the integral from one time to another, number x seconds."""
        return sum(piece.integral(piece.end_s) for piece in self.pieces(start_s, end_s))

    def largest(self, start_s: float, end_s: float) -> float:
        """Return the largest number from one time to another; it lies at an end or a point."""
        inside = [v for t, v in zip(self.times_s, self.values, strict=True) if start_s < t <= end_s]
        return max(self.value(start_s), self.value(end_s), *inside)

    def pieces(self, start_s: float, end_s: float) -> Iterator[Piece]:
        """Yield the parts of the curve from one time to another, in order, without gaps."""
        inner = [t for t in self.times_s if start_s < t < end_s]
        times = [start_s, *inner, end_s]
        for begin, end in itertools.pairwise(times):
            if end > begin:
                yield self._part(begin, end)

    def _part(self, begin_s: float, end_s: float) -> Piece:
        """Return the curve between two times that have no point between them."""
        index = bisect.bisect_right(self.times_s, begin_s) - 1
        if index < 0:
            return Piece(begin_s, end_s, (self.values[0],))
        if index == len(self.times_s) - 1:
            return Piece(begin_s, end_s, (self.values[-1],))
        piece = self._piece(index)
        return Piece(begin_s, end_s, polynomial.shift(piece.coefficients, begin_s - piece.start_s))

    def _piece(self, index: int) -> Piece:
        """Return the curve between point `index` and the next one."""
        start_s = self.times_s[index]
        end_s = self.times_s[index + 1]
        first = self.values[index]
        change = self.values[index + 1] - first
        width = end_s - start_s
        if self.shape == "step" or change == 0:
            return Piece(start_s, end_s, (first,))
        if self.shape == "linear":
            return Piece(start_s, end_s, (first, change / width))
        return Piece(start_s, end_s, (first, 0.0, 3 * change / width**2, -2 * change / width**3))
