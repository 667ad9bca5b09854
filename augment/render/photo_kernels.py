"""Numba kernels of augment.base_photo: colours of a photo, transmittance by depth, mixed images."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.composite_kernels import layered_way
from augment.render.cpu.jit import kernel
from augment.render.fog import MAX_EXPONENT


@kernel
def scene_colors(pixels, color_map, least, out):
    """out = max(M (pixels / 255) + m, least). pixels: uint8 [H, W, 3]. color_map: [3, 4], or empty
    for the pixels' own colours.
    """
    height, width, _ = pixels.shape
    whole = np.float32(255)
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0]) / whole
            g = np.float32(pixels[i, j, 1]) / whole
            b = np.float32(pixels[i, j, 2]) / whole
            if color_map.size == 0:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = r, g, b
            else:
                for c in range(3):
                    m = color_map[c]
                    out[i, j, c] = max(m[0] * r + m[1] * g + m[2] * b + m[3], least)


@kernel
def mix(rgb, other, weight, out):
    """out = (1 - weight) rgb + weight other. rgb: [H, W, 3]. other: the same, or [1, 1, 3]."""
    height, width, _ = rgb.shape
    one, step = np.float32(1), np.int64(len(other) > 1)
    for i in prange(height):
        for j in range(width):
            w = weight[i, j]
            row, column = np.int64(i) * step, np.int64(j) * step
            for c in range(3):
                out[i, j, c] = (one - w) * rgb[i, j, c] + w * other[row, column, c]


@kernel
def add_faded(base, rgb, weight, out):
    """out = base + weight rgb."""
    height, width, _ = rgb.shape
    for i in prange(height):
        for j in range(width):
            for c in range(3):
                out[i, j, c] = base[i, j, c] + weight[i, j] * rgb[i, j, c]


@kernel
def transmittance(alpha, depth, lens, fall, fog, road, out):
    """T of a photo's pixels: augment.base_photo's `transmittance`.

    lens: 1 / fx, 1 / fy, cx, cy. fall: of the camera's axes [3]. fog: sigma, 1 / scale height (0
    for uniform), the eye's height over the base. road: the camera's height
    above it (0 where unknown), and the least fall that sees it.
    """
    height, width = alpha.shape
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    sigma, inverse = fog[0], fog[1]
    a = fog[2] * inverse
    above = sigma * math.exp(min(-a, np.float32(MAX_EXPONENT)))
    for i in prange(height):
        v = (np.float32(i) + half - lens[3]) * lens[1]
        for j in range(width):
            u = (np.float32(j) + half - lens[2]) * lens[0]
            falls = fall[0] * u + fall[1] * v + fall[2]
            length = math.sqrt(one + u * u + v * v)
            share, seen = alpha[i, j], zero
            if share > zero:
                distance = depth[i, j] * length
                if inverse > zero:
                    distance = layered_way(distance, a, -depth[i, j] * falls * inverse)
                seen = share * math.exp(-sigma * distance)
            if share < one:
                behind = zero
                if road[0] > zero and falls > road[1]:
                    distance = road[0] / falls * length
                    if inverse > zero:
                        distance = layered_way(distance, a, -road[0] * inverse)
                    behind = math.exp(-sigma * distance)
                elif inverse > zero and falls < zero:
                    behind = math.exp(-above / inverse * length / -falls)
                seen += (one - share) * behind
            out[i, j] = seen
