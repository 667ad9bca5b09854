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
    half = np.float32(0.5)
    one = np.float32(1)
    zero = np.float32(0)
    for i in prange(rgb.shape[0]):
        y = (np.float32(i) + half) / step + np.float32(margin) - half
        top = int(y)
        down = y - np.float32(top)
        cells = np.empty((layer.shape[1], 4), np.float32)
        for left in range(layer.shape[1]):
            for k in range(4):
                above = layer[top, left, k]
                cells[left, k] = above + down * (layer[top + 1, left, k] - above)
        for j in range(rgb.shape[1]):
            x = (np.float32(j) + half) / step + np.float32(margin) - half
            left = int(x)
            right = x - np.float32(left)
            cover = cells[left, 3] + right * (cells[left + 1, 3] - cells[left, 3])
            mask[i, j] = cover >= shown
            if cover >= least:
                clear = max(one - cover, zero)
                for k in range(3):
                    light = cells[left, k] + right * (cells[left + 1, k] - cells[left, k])
                    behind = max(rgb[i, j, k], zero)
                    rgb[i, j, k] = math.sqrt(clear * behind * behind + max(light, zero))
