"""A numba kernel: drops on the glass blended over a picture."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel


@kernel
def blend_drops(rgb, layer, step, margin, least, shown, mask):
    """rgb [H, W, 3], in place: sqrt((1 - c) rgb^2 + light) where c >= least; mask [H, W] becomes
    c >= shown.

    layer [h, w, 4]: light and c of cells `step` pixels wide, the picture's first after `margin`
    cells. Bilinear. All floats float32.
    """
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    for i in prange(rgb.shape[0]):
        y = (np.float32(i) + half) / step + np.float32(margin) - half
        top = int(y)
        down = y - np.float32(top)
        for j in range(rgb.shape[1]):
            x = (np.float32(j) + half) / step + np.float32(margin) - half
            left = int(x)
            right = x - np.float32(left)
            a, b = (one - down) * (one - right), (one - down) * right
            c, d = down * (one - right), down * right
            cover = a * layer[top, left, 3] + b * layer[top, left + 1, 3]
            cover += c * layer[top + 1, left, 3] + d * layer[top + 1, left + 1, 3]
            mask[i, j] = cover >= shown
            if cover >= least:
                clear = max(one - cover, zero)
                for k in range(3):
                    light = a * layer[top, left, k] + b * layer[top, left + 1, k]
                    light += c * layer[top + 1, left, k] + d * layer[top + 1, left + 1, k]
                    behind = max(rgb[i, j, k], zero)
                    rgb[i, j, k] = math.sqrt(clear * behind * behind + max(light, zero))
