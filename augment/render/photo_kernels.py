"""Numba kernels of recorded pictures: their colours, transmittance by depth, mixed images.

`augment.photo.recorded_base` calls them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.composite_kernels import layered_distance
from augment.render.cpu.jit import kernel
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import Index


@kernel
def map_photo_colors(pixels, color_map, min_color, out):
    """Write out = max(M (pixels / 255) + m, min_color).

    Args:
        pixels: uint8 [H, W, 3].
        color_map: (M, m), [3, 4].
        min_color: smallest colour.
        out: float32 [H, W, 3].
    """
    height, width, _ = pixels.shape
    max_level = np.float32(255)
    m00 = color_map[0, 0]
    m01 = color_map[0, 1]
    m02 = color_map[0, 2]
    m03 = color_map[0, 3]
    m10 = color_map[1, 0]
    m11 = color_map[1, 1]
    m12 = color_map[1, 2]
    m13 = color_map[1, 3]
    m20 = color_map[2, 0]
    m21 = color_map[2, 1]
    m22 = color_map[2, 2]
    m23 = color_map[2, 3]
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0]) / max_level
            g = np.float32(pixels[i, j, 1]) / max_level
            b = np.float32(pixels[i, j, 2]) / max_level
            out[i, j, 0] = max(m00 * r + m01 * g + m02 * b + m03, min_color)
            out[i, j, 1] = max(m10 * r + m11 * g + m12 * b + m13, min_color)
            out[i, j, 2] = max(m20 * r + m21 * g + m22 * b + m23, min_color)


@kernel
def mix_photo(pixels, color_map, weight, other, is_premultiplied, out):
    """Write out = s other + (1 - weight) (M (pixels / 255) + m); s is 1 or the weight.

    Args:
        pixels: uint8 [H, W, 3].
        color_map: (M, m), float32 [3, 4].
        weight: float32 [H, W], share of each pixel that shows the other image.
        other: float32 [H, W, 3] or [1, 1, 3], the other image.
        is_premultiplied: True if the other image is given times its weight.
        out: float32 [H, W, 3].
    """
    height, width, _ = pixels.shape
    max_level = np.float32(255)
    one_f32 = np.float32(1)
    row_step = np.int64(other.shape[0] > 1)
    column_step = np.int64(other.shape[1] > 1)
    m00 = color_map[0, 0]
    m01 = color_map[0, 1]
    m02 = color_map[0, 2]
    m03 = color_map[0, 3]
    m10 = color_map[1, 0]
    m11 = color_map[1, 1]
    m12 = color_map[1, 2]
    m13 = color_map[1, 3]
    m20 = color_map[2, 0]
    m21 = color_map[2, 1]
    m22 = color_map[2, 2]
    m23 = color_map[2, 3]
    for i in prange(height):
        row = np.int64(i) * row_step
        for j in range(width):
            column = np.int64(j) * column_step
            r = np.float32(pixels[i, j, 0]) / max_level
            g = np.float32(pixels[i, j, 1]) / max_level
            b = np.float32(pixels[i, j, 2]) / max_level
            w = one_f32 - weight[i, j]
            s = one_f32 if is_premultiplied else weight[i, j]
            other_0 = s * other[row, column, 0]
            other_1 = s * other[row, column, 1]
            other_2 = s * other[row, column, 2]
            out[i, j, 0] = other_0 + w * (m00 * r + m01 * g + m02 * b + m03)
            out[i, j, 1] = other_1 + w * (m10 * r + m11 * g + m12 * b + m13)
            out[i, j, 2] = other_2 + w * (m20 * r + m21 * g + m22 * b + m23)


@kernel
def map_photo_colors_with_sky(pixels, land, sky, share, out):
    """Write out = (1 - share) max(land, 0) + share max(sky, 0), each a map [3, 4] of pixels / 255.

    Args:
        pixels: uint8 [H, W, 3].
        land: colour map of the land.
        sky: colour map of the sky.
        share: share of the sky, [H, W].
        out: float32 [H, W, 3].
    """
    height, width, _ = pixels.shape
    max_level = np.float32(255)
    one_f32 = np.float32(1)
    zero = np.float32(0)
    for i in prange(height):
        for j in range(width):
            r = np.float32(pixels[i, j, 0]) / max_level
            g = np.float32(pixels[i, j, 1]) / max_level
            b = np.float32(pixels[i, j, 2]) / max_level
            w = share[i, j]
            for c in range(Index(3)):
                land_color = land[c, 0] * r + land[c, 1] * g + land[c, 2] * b + land[c, 3]
                sky_color = sky[c, 0] * r + sky[c, 1] * g + sky[c, 2] * b + sky[c, 3]
                out[i, j, c] = (one_f32 - w) * max(land_color, zero) + w * max(sky_color, zero)


@kernel
def compute_sky_share(alpha, sky_marks, alpha_limits, u, v, fall, out):
    """Write the share of sky in every pixel of a photo, 1 - a (1 - sky), and 0 where the ray sees
    the road.

    Args:
        alpha: alpha of the surfaces, [H, W].
        sky_marks: alpha times sky in the first channel, [H, W, 3].
        alpha_limits: alphas that count as nothing and as everything.
        u: image coordinates of the columns at unit depth, [W].
        v: image coordinates of the rows at unit depth, [H].
        fall: fall of the camera's axes [3], and the smallest fall of a ray that sees the road.
        out: float32 [H, W].
    """
    height, width = alpha.shape
    zero = np.float32(0)
    one_f32 = np.float32(1)
    tiny = np.float32(1e-6)
    per_alpha = one_f32 / (alpha_limits[1] - alpha_limits[0])
    for i in prange(height):
        down = fall[1] * v[i] + fall[2]
        for j in range(width):
            sky_level = min(sky_marks[i, j, 0] / max(alpha[i, j], tiny), one_f32)
            coverage = min(max((alpha[i, j] - alpha_limits[0]) * per_alpha, zero), one_f32)
            pixel_share = one_f32 - coverage * (one_f32 - sky_level)
            out[i, j] = zero if fall[0] * u[j] + down > fall[3] else pixel_share


@kernel
def blend_images(rgb, other, weight, out):
    """Write out = (1 - weight) rgb + weight other.

    rgb: [H, W, 3]. other: [H, W, 3] or [1, 1, 3].
    """
    height, width, _ = rgb.shape
    one_f32 = np.float32(1)
    step = np.int64(len(other) > 1)
    for i in prange(height):
        for j in range(width):
            w = weight[i, j]
            row = np.int64(i) * step
            column = np.int64(j) * step
            for c in range(3):
                out[i, j, c] = (one_f32 - w) * rgb[i, j, c] + w * other[row, column, c]


@kernel
def add_weighted(base, rgb, weight, out):
    """Write out = base + weight rgb."""
    height, width, _ = rgb.shape
    for i in prange(height):
        for j in range(width):
            for c in range(3):
                out[i, j, c] = base[i, j, c] + weight[i, j] * rgb[i, j, c]


@kernel
def compute_transmittance(alpha, depth, lens, fall, fog_numbers, road, out):
    """Write the transmittance of a photo's pixels, as `Photo.transmittance` asks for it.

    Args:
        alpha: alpha of the surfaces, [H, W].
        depth: z of the surfaces, [H, W], metres.
        lens: 1 / fx, 1 / fy, cx, cy.
        fall: fall of the camera's axes [3].
        fog_numbers: extinction (1/m), 1 / scale height (0 for uniform fog), and the eye's height
            over the base (m).
        road: the camera's height above the road (m; 0 if unknown), and the smallest fall of a ray
            that sees it.
        out: float32 [H, W].
    """
    height, width = alpha.shape
    half = np.float32(0.5)
    one_f32 = np.float32(1)
    zero = np.float32(0)
    extinction_per_m = fog_numbers[0]
    inverse_scale_height = fog_numbers[1]
    eye_scale_heights = fog_numbers[2] * inverse_scale_height
    extinction_at_eye = extinction_per_m * math.exp(
        min(-eye_scale_heights, np.float32(MAX_EXPONENT))
    )
    for i in prange(height):
        v = (np.float32(i) + half - lens[3]) * lens[1]
        for j in range(width):
            u = (np.float32(j) + half - lens[2]) * lens[0]
            ray_fall = fall[0] * u + fall[1] * v + fall[2]
            length = math.sqrt(one_f32 + u * u + v * v)
            surface_share = alpha[i, j]
            transmitted = zero
            if surface_share > zero:
                distance = depth[i, j] * length
                if inverse_scale_height > zero:
                    distance = layered_distance(
                        distance, eye_scale_heights, -depth[i, j] * ray_fall * inverse_scale_height
                    )
                transmitted = surface_share * math.exp(-extinction_per_m * distance)
            if surface_share < one_f32:
                background = zero
                if road[0] > zero and ray_fall > road[1]:
                    distance = road[0] / ray_fall * length
                    if inverse_scale_height > zero:
                        distance = layered_distance(
                            distance, eye_scale_heights, -road[0] * inverse_scale_height
                        )
                    background = math.exp(-extinction_per_m * distance)
                elif inverse_scale_height > zero and ray_fall < zero:
                    background = math.exp(
                        -extinction_at_eye / inverse_scale_height * length / -ray_fall
                    )
                transmitted += (one_f32 - surface_share) * background
            out[i, j] = transmitted
