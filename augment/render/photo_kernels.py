"""Numba kernels of augment.base_photo: colours of a photo, transmittance by depth, mixed images."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.composite_kernels import layered_way
from augment.render.cpu.jit import kernel
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import U


@kernel
def scene_colors(pixels, color_map, least, out):
    """out = max(M (pixels / 255) + m, least). pixels: uint8 [H, W, 3]. color_map: [3, 4]."""
    height, width, _ = pixels.shape
    whole = np.float32(255)
    m00, m01, m02, m03 = color_map[0, 0], color_map[0, 1], color_map[0, 2], color_map[0, 3]
    m10, m11, m12, m13 = color_map[1, 0], color_map[1, 1], color_map[1, 2], color_map[1, 3]
    m20, m21, m22, m23 = color_map[2, 0], color_map[2, 1], color_map[2, 2], color_map[2, 3]
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0]) / whole
            g = np.float32(pixels[i, j, 1]) / whole
            b = np.float32(pixels[i, j, 2]) / whole
            out[i, j, 0] = max(m00 * r + m01 * g + m02 * b + m03, least)
            out[i, j, 1] = max(m10 * r + m11 * g + m12 * b + m13, least)
            out[i, j, 2] = max(m20 * r + m21 * g + m22 * b + m23, least)


@kernel
def styled_colors(pixels, land, sky, share, out):
    """out = (1 - share) max(land, 0) + share max(sky, 0), each a map [3, 4] of pixels / 255.

    pixels: uint8 [H, W, 3]. share: [H, W].
    """
    height, width, _ = pixels.shape
    whole, one, zero = np.float32(255), np.float32(1), np.float32(0)
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0]) / whole
            g = np.float32(pixels[i, j, 1]) / whole
            b = np.float32(pixels[i, j, 2]) / whole
            w = share[i, j]
            for c in range(U(3)):
                near = land[c, 0] * r + land[c, 1] * g + land[c, 2] * b + land[c, 3]
                far = sky[c, 0] * r + sky[c, 1] * g + sky[c, 2] * b + sky[c, 3]
                out[i, j, c] = (one - w) * max(near, zero) + w * max(far, zero)


@kernel
def sky_share(alpha, marks, solid, u, v, fall, out):
    """1 - a (1 - sky) of what the photo shows: how much of each pixel is sky; 0 where it falls.

    alpha [H, W]: of surfaces; marks [H, W, 3]: times sky, the first channel. solid: alphas that are
    taken for nothing and for all. u [W], v [H]: image coordinates at unit depth. fall: of the
    camera's axes [3], and the least at which a ray sees the road.
    """
    height, width = alpha.shape
    zero, one, tiny = np.float32(0), np.float32(1), np.float32(1e-6)
    per = one / (solid[1] - solid[0])
    for i in prange(height):
        down = fall[1] * v[i] + fall[2]
        for j in range(width):
            level = min(marks[i, j, 0] / max(alpha[i, j], tiny), one)
            a = min(max((alpha[i, j] - solid[0]) * per, zero), one)
            share = one - a * (one - level)
            out[i, j] = zero if fall[0] * u[j] + down > fall[3] else share


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
