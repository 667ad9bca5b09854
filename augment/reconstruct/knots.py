"""Corrections over time: numbers at knots, linear between them, with an Adam of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

# Forces are some 1e-4 a metre: what is smaller than this is rounding, and must not be a direction.
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-10


class Knots:
    """D numbers at the knots of several things, float64, all zero to begin with.

    Before the first and after the last knot the nearest one holds. A thing without knots is never
    corrected.
    """

    def __init__(self, times_ns: Sequence[np.ndarray], width: int) -> None:
        """times_ns: int64 [K] a thing, increasing."""
        self._times = list(times_ns)
        self._firsts = np.cumsum([0, *(len(times) for times in times_ns)])
        shape = (int(self._firsts[-1]), width)
        self.values = np.zeros(shape)
        self._m, self._v = np.zeros(shape), np.zeros(shape)
        self._count = np.zeros(shape[0], np.int64)

    def at(self, number: int, timestamp_ns: int) -> np.ndarray | None:
        """The thing's correction, float64 [D], at a time; None where it has no knots."""
        place = self._place(number, timestamp_ns)
        return None if place is None else place[1] @ self.values[place[0]]

    def update(
        self, number: int, timestamp_ns: int, gradient: np.ndarray, rates: np.ndarray, pull: float
    ) -> None:
        """A step of Adam for the knots around a time. gradient, rates: [D]. pull: towards 0."""
        place = self._place(number, timestamp_ns)
        if place is None:
            return
        for row, weight in zip(*place, strict=True):
            if weight > 0:
                self._step(row, weight * gradient + pull * self.values[row], rates)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"values": self.values, "m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]

    def _place(self, number: int, timestamp_ns: int) -> tuple[list[int], np.ndarray] | None:
        """Rows of `values` around a time, and their weights."""
        times = self._times[number]
        if len(times) == 0:
            return None
        first = int(self._firsts[number])
        after = int(np.searchsorted(times, timestamp_ns, side="right"))
        if after == 0 or after == len(times):
            return [first + min(after, len(times) - 1)], np.ones(1)
        span = int(times[after]) - int(times[after - 1])
        part = (timestamp_ns - int(times[after - 1])) / span
        return [first + after - 1, first + after], np.array([1 - part, part])

    def _step(self, row: int, gradient: np.ndarray, rates: np.ndarray) -> None:
        self._count[row] += 1
        n = int(self._count[row])
        self._m[row] += (1 - _BETA1) * (gradient - self._m[row])
        self._v[row] += (1 - _BETA2) * (gradient * gradient - self._v[row])
        first, second = self._m[row] / (1 - _BETA1**n), self._v[row] / (1 - _BETA2**n)
        self.values[row] -= rates * first / (np.sqrt(second) + _EPS)
