"""Numba functions: splats cut at a height (see augment.render.clip for the geometry).

A splat's cut is CUT float32: the kept share of its alpha at pixel p is
clamp(C_AT + C_X (x - mean_x) + C_Y (y - mean_y), 0, 1).
"""

from __future__ import annotations

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_geometry import dot, rotation_row, semi_axes
from augment.render.cpu_items import BATCH
from augment.render.cpu_jit import inner
from augment.render.cpu_layout import (
    LANES,
    MEAN_X,
    MEAN_Y,
    TILE_H,
    V_BLUR,
    V_CLIP_CAMERA,
    V_CLIP_EDGE,
    V_CLIP_EYE,
    V_CLIP_PART,
    V_EXTENT,
    V_FOCAL,
    U,
)

CUT = 4
C_AT, C_X, C_Y = 0, 1, 2
_FAR = np.float32(1e6)  # augment.render.clip.FAR_PX
_TINY = np.float32(1e-20)


@inner()
def height_of(d, view):
    """How far the kept side of the plane means lie. d: from the eye, in the part's axes."""
    up = V_CLIP_PART
    rise = dot(v8.splat(view[up]), v8.splat(view[up + 1]), v8.splat(view[up + 2]), d[0], d[1], d[2])
    return rise + v8.splat(view[V_CLIP_EYE])


@inner()
def cut_eight(quats, scales, picked, at, d, x, y, inverse, view):
    """Of eight Gaussians: which have a part on the kept side, and C_AT, C_X, C_Y of their cuts."""
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    right, down, sizes, _, _, m = semi_axes(quats, scales, picked, at, x, y, inverse, view)
    up0, up1, up2 = (
        v8.splat(view[V_CLIP_PART]),
        v8.splat(view[V_CLIP_PART + 1]),
        v8.splat(view[V_CLIP_PART + 2]),
    )
    t = rotation_row(view, U(2))
    rise0 = sizes[0] * dot(up0, up1, up2, m[0], m[3], m[6])
    rise1 = sizes[1] * dot(up0, up1, up2, m[1], m[4], m[7])
    rise2 = sizes[2] * dot(up0, up1, up2, m[2], m[5], m[8])
    away0 = sizes[0] * dot(t[0], t[1], t[2], m[0], m[3], m[6])
    away1 = sizes[1] * dot(t[0], t[1], t[2], m[1], m[4], m[7])
    away2 = sizes[2] * dot(t[0], t[1], t[2], m[2], m[5], m[8])
    height = height_of(d, view)
    sigma = v8.sqrt(dot(rise0, rise1, rise2, rise0, rise1, rise2))
    reach = v8.splat(view[V_EXTENT]) * sigma

    # Slope of depth: the blurred covariance, inverted, times that of position and depth.
    blur = v8.splat(view[V_BLUR])
    xx = blur + dot(right[0], right[1], right[2], right[0], right[1], right[2])
    yy = blur + dot(down[0], down[1], down[2], down[0], down[1], down[2])
    xy = dot(right[0], right[1], right[2], down[0], down[1], down[2])
    cx = dot(right[0], right[1], right[2], away0, away1, away2)
    cy = dot(down[0], down[1], down[2], away0, away1, away2)
    lean = xy / yy
    gx = (cx - lean * cy) / v8.maximum(xx - lean * xy, blur)
    gy = (cy - xy * gx) / yy

    fall = v8.splat(view[V_CLIP_EYE]) * inverse * inverse
    lx = v8.splat(view[V_CLIP_CAMERA] / view[V_FOCAL]) - fall * gx
    ly = v8.splat(view[V_CLIP_CAMERA + 1] / view[V_FOCAL + 1]) - fall * gy
    slope = v8.sqrt(v8.fmuladd(lx, lx, ly * ly))
    scale = one / v8.maximum(slope, v8.splat(_TINY))
    far = v8.splat(_FAR)
    offset = v8.maximum(v8.minimum(height * inverse * scale, far), v8.negate(far))
    whole = v8.at_least(height, reach)
    offset = v8.select(whole, far, offset)
    lx = v8.select(whole, zero, lx * scale)
    ly = v8.select(whole, zero, ly * scale)
    partly = v8.at_least(height + reach, zero)
    return partly, offset + v8.splat(view[V_CLIP_EDGE]), lx, ly


@inner()
def stage_cuts(cuts, members, at, count, staged, lines):
    """Cuts of a batch, turned to one row a number, about the tile's corner. staged: cpu_items'."""
    n = U(BATCH)
    for k in range(count):
        cut = U(members[at + k]) * U(CUT)
        lx, ly = cuts[cut + U(C_X)], cuts[cut + U(C_Y)]
        start = cuts[cut + U(C_AT)] - lx * staged[U(MEAN_X) * n + k]
        lines[k] = start - ly * staged[U(MEAN_Y) * n + k]
        lines[n + k] = lx
        lines[U(2) * n + k] = ly


@inner()
def list_edges(lines, count, strip, spans, edges):
    """The cut's value at the first pixel of every item of cpu_items.list_items, in its order."""
    n, items = U(BATCH), U(0)
    half = np.float32(0.5)
    first_x = np.float32(strip * LANES) + half
    for k in range(count):
        row, end = spans[k], spans[n + k]
        ly = lines[U(2) * n + k]
        start = lines[k] + lines[n + k] * first_x + ly * (np.float32(row) + half)
        for j in range(0, TILE_H, LANES):
            first = v8.splat(start + ly * np.float32(j))
            v8.store(edges, items + U(j), v8.fmuladd(v8.splat(ly), v8.lane_numbers(), first))
        items += U(end - row)


@inner()
def kept_share(lines, edges, splat, item):
    lx = v8.splat(lines[U(BATCH) + splat])
    value = v8.fmuladd(lx, v8.lane_numbers(), v8.splat(edges[item]))
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    return v8.maximum(v8.minimum(value, one), zero)
