"""Numba kernels for averages over ever larger squares of pixels: images are halved."""

from __future__ import annotations

import numba
import numpy as np

from augment.render.cpu_jit import kernel


@kernel
def pack(rgb, alpha, out):
    """rgb [H, W, 3] and alpha [H, W] side by side in out [H, W, 4]."""
    for i in numba.prange(out.shape[0]):
        for j in range(np.uint64(out.shape[1])):
            for c in range(np.uint64(3)):
                out[i, j, c] = rgb[i, j, c]
            out[i, j, 3] = alpha[i, j]


@kernel
def halve_mip(image, out):
    """Averages over 2 x 2 pixels of image [H, W, 4] into out [h, w, 4]."""
    height, width, _ = image.shape
    quarter = np.float32(0.25)
    for i in numba.prange(out.shape[0]):
        top, bottom = np.uint64(2 * i), np.uint64(min(2 * i + 1, height - 1))
        for j in range(np.uint64(out.shape[1])):
            c0 = np.uint64(2) * j
            c1 = min(c0 + np.uint64(1), np.uint64(width - 1))
            for c in range(np.uint64(4)):
                total = (image[top, c0, c] + image[bottom, c0, c]) + (
                    image[top, c1, c] + image[bottom, c1, c]
                )
                out[i, j, c] = quarter * total
