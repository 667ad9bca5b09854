"""Numba kernel: how the loss pulls at whole parts, from the gradients of their splats' means."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu_jit import kernel
from augment.render.cpu_layout import BLOCK, U
from augment.render.cpu_math import floats_at
from augment.render.cpu_project_backward import G_MEAN, GRAD

MOMENTS = 12  # of a block: sum of g (3), then of p_i g_j (9, row by row)


@kernel
def sum_forces(addresses, sizes, blocks, rows, ids, counts, moments):
    """moments: float64 [B, MOMENTS], filled: g is dL/d mean and p the mean, in the part's axes.

    addresses, sizes, blocks: as in cpu_project; rows (flat), ids, counts: as project_backward
    wrote them. Splats whose gradient is not finite are left out, as they are of the update.
    """
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        means = floats_at(addresses[part, 0], sizes[part, 0] * 3)
        for i in range(MOMENTS):
            moments[block, i] = 0.0
        for at in range(U(block * BLOCK), U(block * BLOCK + counts[block])):
            row = at * U(GRAD) + U(G_MEAN)
            splat = U(3) * U(ids[at])
            if not math.isfinite(rows[row] + rows[row + U(1)] + rows[row + U(2)]):
                continue
            for j in range(U(3)):
                g = np.float64(rows[row + j])
                moments[block, j] += g
                for i in range(U(3)):
                    moments[block, U(3) + U(3) * i + j] += np.float64(means[splat + i]) * g
