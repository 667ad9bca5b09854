"""Adam for what is not a splat: colour maps (every number, every step) and the sky (few texels)."""

from __future__ import annotations

import numpy as np

from augment.reconstruct.adam_kernels import update_rows
from augment.reconstruct.rates import BETA1, BETA2, CORRECTIONS
from augment.render.threads import kernel_threads

_EPS = 1e-15


class DenseAdam:
    """Adam on one small float32 array, which is updated in place; moments in float64."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros(values.shape)
        self._v = np.zeros(values.shape)
        self._count = np.zeros(1, np.int64)

    def update(self, gradient: np.ndarray, rate: float) -> None:
        self._count += 1
        self._m += (1 - BETA1) * (gradient - self._m)
        self._v += (1 - BETA2) * (gradient * gradient - self._v)
        n = int(self._count[0])
        first = self._m / (1 - BETA1**n)
        second = self._v / (1 - BETA2**n)
        self._values -= (rate * first / (np.sqrt(second) + _EPS)).astype(np.float32)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]


class ColorAdam:
    """Adam on rows of a float32 array [N, 3] of colours in place, counting each row's updates."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros_like(values)
        self._v = np.zeros_like(values)
        self._count = np.zeros(len(values), np.int32)

    def update(self, rows: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """rows: int32 [T], each once. gradient: float32 [T, 3]. Colours stay within [0, 1]."""
        with kernel_threads():
            update_rows(
                self._values.reshape(-1),
                self._m.reshape(-1),
                self._v.reshape(-1),
                self._count,
                rows,
                gradient,
                np.float32(rate),
                np.array([BETA1, BETA2], np.float32),
                CORRECTIONS.reshape(-1),
            )

    def arrays(self) -> dict[str, np.ndarray]:
        return {"m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]
