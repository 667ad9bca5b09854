"""Whether Gaussians can be drawn as they are, told without copying them.

`augment.scene.check_gaussians` leaves out what cannot be drawn, at the cost of copies; these say
beforehand whether it has anything to do, and of which rows.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from augment.scene import MAX_EXTENT_M, Gaussians, quat_lengths

_QUAT_TOLERANCE = 1e-4  # of unit length; what is further off is to be normalised
_ROWS = 1 << 16  # looked at together: temporaries stay in the cache


def is_drawable(gaussians: Gaussians) -> bool:
    """Whether `check_gaussians` would leave them as they are, told in one look at each number."""
    return all(
        _piece_is_drawable(gaussians, slice(start, start + _ROWS))
        for start in range(0, len(gaussians), _ROWS)
    )


def drawable_rows(gaussians: Gaussians) -> Bool[Tensor, "N"]:
    """The Gaussians that `check_gaussians` keeps."""
    keep = torch.isfinite(gaussians.opacities)
    for tensor in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        keep &= torch.isfinite(tensor.reshape(len(gaussians), -1).sum(1))
    for tensor in (gaussians.means, gaussians.scales):
        keep &= tensor.abs().amax(1) <= MAX_EXTENT_M
    return keep & (quat_lengths(gaussians.quats) > 0) & (gaussians.scales.amin(1) > 0)


def _piece_is_drawable(gaussians: Gaussians, rows: slice) -> bool:
    means, quats, sh = gaussians.means[rows], gaussians.quats[rows], gaussians.sh[rows]
    scales, opacities = gaussians.scales[rows], gaussians.opacities[rows]
    ranges = [_range(tensor) for tensor in (means, quats, scales, opacities, sh)]
    with np.errstate(over="ignore", invalid="ignore"):
        shortest, longest = _range((quats.numpy() ** 2).sum(1) ** 0.5)
    return (
        bool(np.isfinite(ranges).all())
        and shortest > 1 - _QUAT_TOLERANCE
        and longest < 1 + _QUAT_TOLERANCE
        and -MAX_EXTENT_M <= ranges[0][0] <= ranges[0][1] <= MAX_EXTENT_M
        and 0 < ranges[2][0] <= ranges[2][1] <= MAX_EXTENT_M
        and ranges[3][0] >= 0
        and ranges[3][1] <= 1
    )


def _range(values: Tensor | np.ndarray) -> tuple[float, float]:
    """Lowest and highest value; NaN where there is one. By NumPy, which wakes no threads."""
    array = values.numpy() if isinstance(values, Tensor) else values
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())
