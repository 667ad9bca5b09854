"""Inverse depth up to scale and shift, brought to metres by the few distances that are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_FEWEST = 30  # known distances that two numbers may be fitted to
_ROUNDS = 30
_LEAST_SPREAD_PER_M = 1e-4  # residuals below this are as good as none
_LEAST_CORRELATION = 0.5
_NEAREST_M, _FURTHEST_M = 0.5, 120.0


@dataclass(frozen=True)
class Alignment:
    """1 / z = scale relative + shift, in 1/m; correlation: of the two, robustly weighted."""

    scale: float
    shift: float
    correlation: float

    def depth_m(self, relative: np.ndarray) -> np.ndarray:
        """Depth of relative values, float32; NaN where it is too near or far to be believed."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1.0 / (self.scale * relative.astype(np.float64) + self.shift)
            depth[~((depth >= _NEAREST_M) & (depth <= _FURTHEST_M))] = np.nan
        return depth.astype(np.float32)


def align(relative: np.ndarray, depth_m: np.ndarray) -> Alignment | None:
    """Robust least squares of inverse depth over known pixels, both [M]; None where it fails.

    Iteratively reweighted with Cauchy's weights, whose spread follows the median residual (Holland
    and Welsch 1977), from a line through the quartiles. It fails with fewer than 30 known pixels,
    without contrast, or where larger values are not clearly nearer.
    """
    x, y = relative.astype(np.float64), 1.0 / depth_m.astype(np.float64)
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) < _FEWEST:
        return None
    low, middle, high = np.quantile(x, [0.1, 0.5, 0.9])
    unit = high - low
    if not unit > 0:
        return None
    x = (x - middle) / unit  # so that the normal equations are well conditioned
    bottom, top = np.quantile(y, [0.1, 0.9])
    scale, shift = top - bottom, float(np.median(y))
    weight = np.ones_like(x)
    for _ in range(_ROUNDS):
        residual = y - (scale * x + shift)
        spread = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_SPREAD_PER_M)
        weight = 1.0 / (1.0 + (residual / (2.385 * spread)) ** 2)
        weight /= weight.sum()
        mean_x, mean_y = float(weight @ x), float(weight @ y)
        variance = float(weight @ (x - mean_x) ** 2)
        covariance = float(weight @ ((x - mean_x) * (y - mean_y)))
        if not variance > 0:
            return None
        scale = covariance / variance
        shift = mean_y - scale * mean_x
    spread_y = float(weight @ (y - mean_y) ** 2)
    correlation = covariance / max((variance * spread_y) ** 0.5, 1e-12)
    if correlation < _LEAST_CORRELATION:
        return None
    return Alignment(scale / unit, shift - scale * middle / unit, correlation)
