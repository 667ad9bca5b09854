"""Numba functions: light by the normal of every pixel of a splat (see augment.render.shading).

A splat's lights are LINES float32, as there; all 0 for a splat of one colour.
"""

from __future__ import annotations

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_geometry import dot, rotation_row
from augment.render.cpu_items import BATCH, ITEMS
from augment.render.cpu_jit import inner
from augment.render.layout import (
    LANES,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    SHARP_X,
    STRIP,
    V_FOCAL,
    V_SUN,
    V_WRAP,
    U,
)

LINES = 9
L_FACING, L_X, L_Y, L_WRAP, L_LEAN_X, L_LEAN_Y, L_RED, L_GREEN, L_BLUE = range(LINES)
LIT = (LINES + 1) * BATCH  # of a batch: one row a line, then whether a splat has any
_LEAST_FACING = np.float32(0.05)  # augment.render.shading.LEAST_FACING
_TINY = np.float32(1e-20)  # augment.render.shading.TINY


@inner()
def light_eight(m, towards, view):
    """Eight Gaussians' lines but for the slopes. m: rotations; towards: from the eye, camera."""
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    nx = dot(r[0], r[1], r[2], m[2], m[5], m[8])
    ny = dot(s[0], s[1], s[2], m[2], m[5], m[8])
    nz = dot(t[0], t[1], t[2], m[2], m[5], m[8])
    is_back = v8.greater(dot(nx, ny, nz, towards[0], towards[1], towards[2]), zero)
    nx = v8.select(is_back, v8.negate(nx), nx)
    ny = v8.select(is_back, v8.negate(ny), ny)
    nz = v8.select(is_back, v8.negate(nz), nz)
    sx, sy, sz = v8.splat(view[V_SUN]), v8.splat(view[V_SUN + 1]), v8.splat(view[V_SUN + 2])
    inverse = one / v8.maximum(v8.negate(nz), v8.splat(_LEAST_FACING))
    ax, ay = nx * inverse, ny * inverse
    fx, fy = v8.splat(view[V_FOCAL]), v8.splat(view[V_FOCAL + 1])
    scale = one / (one + v8.splat(view[V_WRAP]))
    return (
        dot(nx, ny, nz, sx, sy, sz) * scale,
        v8.fmuladd(sz, ax, sx) / fx * scale,
        v8.fmuladd(sz, ay, sy) / fy * scale,
        v8.splat(view[V_WRAP]) * scale,
        ax / fx,
        ay / fy,
    )


@inner()
def stage_lights(lights, members, at, count, lit):
    """Lines of a batch, turned to one row a number."""
    n = U(BATCH)
    for k in range(count):
        first, most = U(members[at + k]) * U(LINES), np.float32(0)
        for line in range(U(LINES)):
            lit[line * n + k] = lights[first + line]
        for line in range(U(L_RED), U(LINES)):
            most = max(most, abs(lights[first + line]))
        lit[U(LINES) * n + k] = most


@inner()
def is_lit(lit, splat):
    return lit[U(LINES * BATCH) + splat] > np.float32(0)


@inner()
def light_share(lit, staged, values, splat, item, at, limits):
    """The share of the light at eight pixels of a splat.

    staged, values: cpu_items', of the item. at: its place in the tile's state. limits: of
    cpu_blend; the second is log2(ALPHA_MIN), the last two 1/fx^2 and 1/fy^2.
    """
    n, zero, one = U(BATCH), v8.splat(np.float32(0)), v8.splat(np.float32(1))
    half = np.float32(0.5)
    left = np.float32(at // U(STRIP) * U(LANES)) + half - staged[U(MEAN_X) * n + splat]
    down = np.float32(at % U(STRIP) // U(LANES)) + half - staged[U(MEAN_Y) * n + splat]
    x, y = v8.lane_numbers() + v8.splat(left), v8.splat(down)
    # Squared distance from the mean, of that at which alpha is cut off: from the log of alpha.
    peak = staged[U(LOG_OPACITY) * n + splat]
    off = v8.splat(staged[U(SHARP_X) * n + splat])
    off = v8.fmuladd(off, v8.lane_numbers(), v8.splat(values[item + U(ITEMS)]))
    e = v8.fmuladd(v8.negate(off), off, v8.splat(values[item]))
    rim = (v8.splat(peak) - e) / v8.splat(max(peak - limits[1], _TINY))
    rim = v8.maximum(v8.minimum(rim, one), zero)
    lean = v8.splat(lit[U(L_LEAN_X) * n + splat]) * x + v8.splat(lit[U(L_LEAN_Y) * n + splat]) * y
    away = v8.fmuladd(lean, lean, v8.splat(limits[6]) * y * y + v8.splat(_TINY))
    away = v8.fmuladd(v8.splat(limits[5]) * x, x, away)
    tilt = v8.splat(lit[U(L_X) * n + splat]) * x + v8.splat(lit[U(L_Y) * n + splat]) * y
    share = v8.fmuladd(v8.sqrt(rim / away), tilt, v8.splat(lit[U(L_WRAP) * n + splat]))
    share = v8.fmuladd(v8.sqrt(one - rim), v8.splat(lit[U(L_FACING) * n + splat]), share)
    return v8.maximum(v8.minimum(share, one), zero)
