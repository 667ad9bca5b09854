"""Launches the GPU's kernel that finds which points some camera sees."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from augment.effects.snow import cuda_visibility_kernels
from augment.effects.snow.visibility_layout import CENTRE
from augment.render.cuda import runtime as gpu

_POINTS = 64  # of one warp


def find_seen(
    points: np.ndarray,
    normals: np.ndarray,
    is_sure: np.ndarray,
    views: np.ndarray,
    sizes: np.ndarray,
    depths: Tensor,
    lifts: np.ndarray,
    tolerances: np.ndarray,
) -> np.ndarray:
    """bool [C], as visibility_kernels.find_seen. depths lie on the GPU; waits for the result."""
    if not len(points):
        return np.zeros(0, bool)
    # Near the points float32 tells a tenth of a millimetre, wherever in the world they are.
    origin = points.mean(0)
    about = views.copy()
    about[:, CENTRE : CENTRE + 3] -= origin
    seen = gpu.upload(np.empty(len(points), np.uint8))
    gpu.launch(
        cuda_visibility_kernels.find_seen,
        (-(-len(points) // _POINTS),),
        gpu.upload((points - origin).astype(np.float32).T),
        gpu.upload(normals.astype(np.float32).T),
        gpu.upload(is_sure.astype(np.uint8)),
        gpu.upload(about.astype(np.float32)),
        gpu.upload(sizes.astype(np.int32)),
        depths,
        gpu.upload(tolerances.astype(np.float32)),
        gpu.upload(lifts.astype(np.float32)),
        seen,
        len(points),
        len(views),
        LIFTS=len(lifts),
        BLOCK=_POINTS,
        num_warps=1,
    )
    return seen.cpu().numpy() > 0
