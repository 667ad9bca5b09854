"""Adam for what is not a splat: colour maps (every number, every step) and the sky (few texels)."""

from __future__ import annotations

import numpy as np

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15


class DenseAdam:
    """Adam on one small float32 array, which is updated in place; moments in float64."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros(values.shape)
        self._v = np.zeros(values.shape)
        self._count = np.zeros(1, np.int64)

    def update(self, gradient: np.ndarray, rate: float) -> None:
        self._count += 1
        self._m += (1 - _BETA1) * (gradient - self._m)
        self._v += (1 - _BETA2) * (gradient * gradient - self._v)
        n = int(self._count[0])
        first = self._m / (1 - _BETA1**n)
        second = self._v / (1 - _BETA2**n)
        self._values -= (rate * first / (np.sqrt(second) + _EPS)).astype(np.float32)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]


class SparseAdam:
    """Adam on rows of a float32 array [N, C] in place, counting the updates of each row."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros_like(values)
        self._v = np.zeros_like(values)
        self._count = np.zeros(len(values), np.int32)

    def update(self, rows: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """rows: indices, each once. gradient: float32 [len(rows), C]."""
        self._count[rows] += 1
        n = self._count[rows].astype(np.float32)[:, None]
        m = self._m[rows] + np.float32(1 - _BETA1) * (gradient - self._m[rows])
        v = self._v[rows] + np.float32(1 - _BETA2) * (gradient * gradient - self._v[rows])
        self._m[rows], self._v[rows] = m, v
        first = m / (1 - np.float32(_BETA1) ** n)
        second = v / (1 - np.float32(_BETA2) ** n)
        self._values[rows] -= np.float32(rate) * first / (np.sqrt(second) + np.float32(_EPS))

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]
