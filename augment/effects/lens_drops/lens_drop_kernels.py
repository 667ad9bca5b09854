"""A numba kernel: drops on the glass blended over a picture."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel


@kernel
def blend_drops(rgb, layer, step, margin, min_cover, mask_share, mask):
    """Blend drops over rgb [H, W, 3] in place: sqrt((1 - c) rgb^2 + light) where c >= min_cover.

    Light and cover c are bilinear in the layer. All floats are float32.

    Args:
        rgb: the picture, changed in place.
        layer: [h, w, 4] light and c of cells that are `step` pixels wide.
        step: width of a cell, pixels.
        margin: number of cells before the picture's first.
        min_cover: smallest c that changes a pixel.
        mask_share: smallest c of a pixel in the mask.
        mask: output [H, W], c >= mask_share.
    """
    half = np.float32(0.5)
    unit = np.float32(1)
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
            mask[i, j] = cover >= mask_share
            if cover >= min_cover:
                clear = max(unit - cover, zero)
                for k in range(3):
                    light = cells[left, k] + right * (cells[left + 1, k] - cells[left, k])
                    color = max(rgb[i, j, k], zero)
                    rgb[i, j, k] = math.sqrt(clear * color * color + max(light, zero))
