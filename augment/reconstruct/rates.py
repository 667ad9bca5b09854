"""Step sizes of one update, as the kernel takes them."""

from __future__ import annotations

import numpy as np

from augment.cameras import Camera
from augment.reconstruct import adam_kernels as kernels
from augment.reconstruct.config import FitConfig
from augment.render.cpu_project_backward import G_MEAN, G_OPACITY, G_QUAT, G_SCALE

BETA1, BETA2 = 0.9, 0.999
CORRECTIONS = kernels.bias_corrections(BETA1, BETA2)
_SMALLEST_M = 1e-3  # no splat gets thinner along any axis


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
    values[kernels.R_SMALLEST], values[kernels.R_LARGEST] = _SMALLEST_M, extent_m
    side = max(camera.width, camera.height)
    values[kernels.R_ABS_UNIT], values[kernels.R_RADIUS_UNIT] = 0.5 * side, 1 / side
    return values


def decayed(start: float, end: float, done: float) -> float:
    """From start to end exponentially, done being the part of the run; 0 where either is 0."""
    return start ** (1 - done) * end**done if start and end else 0.0
