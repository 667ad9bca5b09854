"""Numba kernel: how the loss pulls at whole parts, from the gradients of their splats' means."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.render.cpu_math import floats_at
from augment.render.cpu_project_backward import G_MEAN, G_QUAT, GRAD
from augment.render.layout import BLOCK, U

# Of a block, with g = dL/d mean and p the mean: sums of g (3) and p x g (3), to which is added what
# turning the splats themselves does.
MOMENTS = 6


@kernel
def sum_forces(addresses, sizes, blocks, rows, ids, counts, moments):
    """moments: float64 [B, MOMENTS], filled, in each part's axes.

    addresses, sizes, blocks: as in cpu_project; rows (flat), ids, counts: as project_backward
    wrote them. Splats whose gradient is not finite are left out, as they are of the update.
    """
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        means = floats_at(addresses[part, 0], sizes[part, 0] * 3)
        quats = floats_at(addresses[part, 1], sizes[part, 0] * 4)
        for i in range(MOMENTS):
            moments[block, i] = 0.0
        for at in range(U(block * BLOCK), U(block * BLOCK + counts[block])):
            row = at * U(GRAD)
            splat = U(ids[at])
            p, q = U(3) * splat, U(4) * splat
            gx, gy, gz = _three(rows, row + U(G_MEAN))
            px, py, pz = _three(means, p)
            # A turn by w takes q to q + (0, w) q / 2.
            hw = np.float64(rows[row + U(G_QUAT)])
            hx, hy, hz = _three(rows, row + U(G_QUAT + 1))
            w = np.float64(quats[q])
            x, y, z = _three(quats, q + U(1))
            if not math.isfinite(gx + gy + gz + hw + hx + hy + hz):
                continue
            moments[block, 0] += gx
            moments[block, 1] += gy
            moments[block, 2] += gz
            moments[block, 3] += py * gz - pz * gy + 0.5 * (w * hx - hw * x + y * hz - z * hy)
            moments[block, 4] += pz * gx - px * gz + 0.5 * (w * hy - hw * y + z * hx - x * hz)
            moments[block, 5] += px * gy - py * gx + 0.5 * (w * hz - hw * z + x * hy - y * hx)


@inner()
def _three(array, at):
    return np.float64(array[at]), np.float64(array[at + U(1)]), np.float64(array[at + U(2)])
