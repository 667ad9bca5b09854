"""Adam for what is not a splat: colour maps (every number, every step) and the sky (few texels)."""

from __future__ import annotations

import numpy as np

from augment.cameras import Camera
from augment.reconstruct import kernels
from augment.reconstruct.config import FitConfig
from augment.reconstruct.kernels import update_rows
from augment.render.cpu.backward_kernels import G_MEAN, G_OPACITY, G_QUAT, G_SCALE
from augment.render.threads import kernel_threads

# ---- Step sizes of one update, as the kernel takes them ------------------------------------------

BETA1, BETA2 = 0.9, 0.999
CORRECTIONS = kernels.bias_corrections(BETA1, BETA2)
_MIN_M = 1e-3  # no splat gets thinner along any axis


def splat_rates(config: FitConfig, step: int, camera: Camera, extent_m: float) -> np.ndarray:
    """float32 [RATES] for the update after `step` updates.

    Means decay exponentially over the run; the others fall to rates.late of their value likewise.
    """
    rates = config.rates
    done = min(1.0, step / max(config.steps, 1))
    late = rates.late**done
    values = np.zeros(kernels.RATES, np.float32)
    values[G_MEAN : G_MEAN + 3] = decayed(rates.means, rates.means_end, done)
    values[G_QUAT : G_QUAT + 4] = rates.quats * late
    values[G_SCALE : G_SCALE + 3] = rates.scales * late
    values[G_OPACITY] = -rates.opacities * late
    values[kernels.R_SH_DC] = rates.sh_dc * late
    values[kernels.R_SH_REST] = rates.sh_rest * late
    values[kernels.R_BETA1], values[kernels.R_BETA2] = BETA1, BETA2
    values[kernels.R_OPACITY_DECAY] = config.loss.opacity_decay
    values[kernels.R_SCALE_DECAY] = config.loss.scale_decay
    values[kernels.R_SMALLEST], values[kernels.R_LARGEST] = _MIN_M, extent_m
    side = max(camera.width, camera.height)
    values[kernels.R_ABS_UNIT], values[kernels.R_RADIUS_UNIT] = 0.5 * side, 1 / side
    return values


def decayed(start: float, end: float, done: float) -> float:
    """From start to end exponentially, done being the part of the run; 0 where either is 0."""
    return start ** (1 - done) * end**done if start and end else 0.0


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
