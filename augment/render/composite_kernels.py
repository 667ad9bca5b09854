"""Numba kernels for the sky behind the splats and for 8-bit images."""

from __future__ import annotations

import math

import numba
import numpy as np

# ---- Numba kernel: finished pixels become opaque (see augment.render.rasterize) ------------------

RUN = 4096  # pixels of a piece of work


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def renormalise_alpha(alpha, rgb, snow, least):
    """alpha, snow: float32 [P]. rgb: [3 P]. rgb and snow may be empty. least: alpha of finished."""
    one = np.float32(1)
    for run in numba.prange((alpha.size + RUN - 1) // RUN):
        for pixel in range(run * RUN, min((run + 1) * RUN, alpha.size)):
            if alpha[pixel] >= least:
                scale = one / alpha[pixel]
                alpha[pixel] = one
                if rgb.size > 0:
                    rgb[3 * pixel] *= scale
                    rgb[3 * pixel + 1] *= scale
                    rgb[3 * pixel + 2] *= scale
                if snow.size > 0:
                    snow[pixel] *= scale


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def composite_cubemap(rgb, alpha, faces, rotation, ifx, ify, cx, cy, strength, airlight, out):
    """out = rgb + (1 - alpha) sky of a cube map, through smog where strength >= 0.

    faces: [6, R + 2, R + 2, 3], with a border (augment.sky.with_border). rotation:
    world_from_camera. ifx, ify: 1 / focal length. strength: optical depth straight up.
    """
    height, width = alpha.shape
    half, one = np.float32(0.5), np.float32(1)
    scale = np.float32(faces.shape[1] - 2) * half
    middle = scale + half  # of a face, from the centre of the first texel of its border
    for i in numba.prange(height):
        v = (np.float32(i) + half - cy) * ify
        bx = rotation[0, 1] * v + rotation[0, 2]
        by = rotation[1, 1] * v + rotation[1, 2]
        bz = rotation[2, 1] * v + rotation[2, 2]
        for j in range(width):
            u = (np.float32(j) + half - cx) * ifx
            x = rotation[0, 0] * u + bx
            y = rotation[1, 0] * u + by
            z = rotation[2, 0] * u + bz
            ax, ay, az = abs(x), abs(y), abs(z)
            if ax >= ay and ax >= az:
                major, t = ax, -y
                face = 0 if x >= 0 else 1
                s = -z if x >= 0 else z
            elif ay >= az:
                major, s = ay, x
                face = 2 if y >= 0 else 3
                t = z if y >= 0 else -z
            else:
                major, t = az, -y
                face = 4 if z >= 0 else 5
                s = x if z >= 0 else -x
            inverse = scale / major
            column, row = s * inverse + middle, t * inverse + middle
            c0, r0 = int(column), int(row)
            c1, r1 = c0 + 1, r0 + 1
            fc, fr = column - np.float32(c0), row - np.float32(r0)
            transmittance = one - alpha[i, j]
            visible = one
            if strength >= 0:
                visible = np.float32(0)
                if z > 0:
                    slope = z / math.sqrt(x * x + y * y + z * z)
                    visible = math.exp(-strength / slope)
            for c in range(3):
                top = faces[face, r0, c0, c] * (one - fc) + faces[face, r0, c1, c] * fc
                bottom = faces[face, r1, c0, c] * (one - fc) + faces[face, r1, c1, c] * fc
                color = top * (one - fr) + bottom * fr
                color = visible * color + (one - visible) * airlight[c]
                out[i, j, c] = rgb[i, j, c] + transmittance * color


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def quantise(values, out):
    """uint8 of float32 rows: clamped to [0, 1], times 255, rounded to the nearest."""
    half, top = np.float32(0.5), np.float32(255)
    for i in numba.prange(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j] * top + half
            out[i, j] = np.uint8(min(max(value, np.float32(0)), top))


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def map_colors(rgb, matrix):
    """Every colour of float32 [H, W, 3] becomes matrix[:, :3] @ colour + matrix[:, 3], in place."""
    m00, m01, m02, m03 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, m12, m13 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, m22, m23 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in numba.prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            r, g, b = rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2]
            rgb[i, j, 0] = m00 * r + m01 * g + m02 * b + m03
            rgb[i, j, 1] = m10 * r + m11 * g + m12 * b + m13
            rgb[i, j, 2] = m20 * r + m21 * g + m22 * b + m23
