"""Numba kernel of greyed photos: mirrored sky taken out of the pixels of an image.

`augment.photo.greyed_photo` calls it, and defines it in NumPy as `grey_pixels`.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel


@kernel
def grey_image(pixels, levels, min_level, grey, weights, fade, full_excess, out):
    """Write the image with the blue of mirrored sky taken out.

    Args:
        pixels: uint8 [H, W, 3].
        levels: share of mirrored sky, uint8 [H, W].
        min_level: level below which a pixel is copied.
        grey: colour of grey things, float32 [3].
        weights: weights of red, green and blue in Y, float32 [3].
        fade: how much of the blue goes at level 255.
        full_excess: excess of blue over red, by the largest channel, at which levels count in full.
        out: uint8 [H, W, 3].
    """
    height, width, _ = pixels.shape
    zero = np.float32(0)
    one_f32 = np.float32(1)
    half = np.float32(0.5)
    max_level = np.float32(255)
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0])
            g = np.float32(pixels[i, j, 1])
            b = np.float32(pixels[i, j, 2])
            relative_r = r / grey[0]
            relative_b = b / grey[2]
            if levels[i, j] < min_level or relative_b <= relative_r:
                out[i, j, 0] = pixels[i, j, 0]
                out[i, j, 1] = pixels[i, j, 1]
                out[i, j, 2] = pixels[i, j, 2]
                continue
            largest = max(max(relative_r, g / grey[1]), max(relative_b, one_f32))
            excess = (relative_b - relative_r) / largest
            share = np.float32(levels[i, j]) / max_level
            weight = fade * share * min(excess / full_excess, one_f32)
            y = weights[0] * r + weights[1] * g + weights[2] * b
            r += weight * (y * grey[0] - r) + half
            g += weight * (y * grey[1] - g) + half
            b += weight * (y * grey[2] - b) + half
            out[i, j, 0] = np.uint8(min(max(r, zero), max_level))
            out[i, j, 1] = np.uint8(min(max(g, zero), max_level))
            out[i, j, 2] = np.uint8(min(max(b, zero), max_level))
