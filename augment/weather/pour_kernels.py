"""Numba kernels that put the layers of a flooded view together."""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.render.layout import U


@inner()
def _falls(u, v, rise):
    """Vertical part of a pixel's ray, summed in the order of Camera.ray_directions."""
    return (u * rise[0] + v * rise[1]) + rise[2]


@kernel
def find_water(u, v, rise, alpha, shown, water):
    """water [H, W] uint8: 1 where a ray falls and alpha leaves more than half of it, else 0.

    u [W], v [H]: image coordinates at unit depth, float64. rise [3]: world z along the camera's
    axes. shown [H]: the largest share of a falling ray that alpha leaves in each row, 0 where none
    falls.
    """
    for i in prange(alpha.shape[0]):
        most = np.float32(0)
        for j in range(alpha.shape[1]):
            share = np.float32(1) - alpha[i, j]
            share = share if _falls(u[j], v[i], rise) < 0.0 else np.float32(0)
            most = max(most, share)
            water[i, j] = np.uint8(share > np.float32(0.5))
        shown[i] = most


@kernel
def pour(u, v, rise, top, left, alpha, color, rgb):
    """rgb += (1 - alpha) color where rays fall. color: [h, w, 3], its corner at row top, column
    left of rgb [H, W, 3]; u, v: of its own columns and rows.
    """
    for i in prange(color.shape[0]):
        row = U(top + i)
        for j in range(color.shape[1]):
            if _falls(u[j], v[i], rise) < 0.0:
                column = U(left + j)
                through = np.float32(1) - alpha[row, column]
                for c in range(U(3)):
                    rgb[row, column, c] += through * color[U(i), U(j), c]


@kernel
def join_depth(alpha, behind_alpha, depth, behind_depth, least):
    """Expected depth of two layers as one: means by weight, into depth [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            share = (np.float32(1) - a) * behind_alpha[i, j]
            total = a * depth[i, j] + share * behind_depth[i, j]
            depth[i, j] = total / max(a + share, least)


@kernel
def join_heavier(alpha, behind_alpha, values, behind):
    """Values of the layer that covers more of a pixel, into values [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            if (np.float32(1) - a) * behind_alpha[i, j] > a:
                values[i, j] = behind[i, j]


@kernel
def join_alpha(alpha, behind_alpha):
    """alpha [h, w] += (1 - alpha) of the layer behind."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            alpha[i, j] = a + (np.float32(1) - a) * behind_alpha[i, j]
