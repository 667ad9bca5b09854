"""Numba functions: splats cut at a height (see augment.render.clip for the geometry, layout for
what is stored of it).
"""

from __future__ import annotations

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_geometry import cross, dot, rotation_row, semi_axes
from augment.render.cpu_items import BATCH
from augment.render.cpu_jit import inner
from augment.render.layout import (
    C_AT,
    C_DOWN,
    C_REACH,
    C_RIGHT,
    C_X,
    C_Y,
    CUT,
    LANES,
    MEAN_X,
    MEAN_Y,
    TILE_H,
    V_CLIP_CAMERA,
    V_CLIP_EDGE,
    V_CLIP_EYE,
    V_CLIP_FALL,
    V_CLIP_LONGEST,
    V_CLIP_PART,
    V_CLIP_REACH,
    V_EXTENT,
    V_FOCAL,
    U,
)

SHARE, SURFACE = 0, 3 * BATCH  # where a batch's lines of each kind begin: value, slope in x and y
REACHES = 6 * BATCH
LINES = 7 * BATCH
_FAR = np.float32(1e6)  # augment.render.clip.FAR_PX
_TINY = np.float32(1e-20)
_SHARP = np.float32(0.003)  # augment.render.clip.SHARP_PX2


@inner()
def height_of(d, view):
    """How far the kept side of the plane means lie. d: from the eye, in the part's axes."""
    up = V_CLIP_PART
    rise = dot(v8.splat(view[up]), v8.splat(view[up + 1]), v8.splat(view[up + 2]), d[0], d[1], d[2])
    return rise + v8.splat(view[V_CLIP_EYE])


@inner()
def cut_eight(quats, scales, picked, at, d, x, y, inverse, view):
    """Of eight Gaussians: which have a part on the kept side, and their cuts' six numbers."""
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

    gx, gy = _depth_slope(right, down, (away0, away1, away2))

    fall = v8.splat(view[V_CLIP_FALL]) * inverse * inverse
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
    deep = v8.sqrt(dot(away0, away1, away2, away0, away1, away2)) * inverse
    deep = v8.minimum(v8.splat(view[V_EXTENT]) * deep, v8.splat(view[V_CLIP_LONGEST]))
    partly = v8.both(
        v8.at_least(height + reach, zero),
        v8.at_least(v8.splat(view[V_CLIP_REACH]), height - reach),
    )
    return partly, offset + v8.splat(view[V_CLIP_EDGE]), lx, ly, gx * inverse, gy * inverse, deep


@inner()
def _depth_slope(x, y, z):
    """g = S2^-1 c of semi-axes right, down and away (see augment.render.clip), per px.

    By the identities of Lagrange and Binet-Cauchy, with S2 = [x.x + b, x.y; x.y, y.y + b],

        det S2 gx = (x cross y).(z cross y) + b x.z        det S2 = |x cross y|^2 + b (...)
        det S2 gy = (y cross x).(z cross x) + b y.z

    Written out, S2's determinant would lose all digits of needles and of sheets seen edge-on. All
    is divided by y.y + b, each cross product by its root, so that nothing overflows.
    """
    one, blur = v8.splat(np.float32(1)), v8.splat(_SHARP)
    inverse = one / (blur + dot(y[0], y[1], y[2], y[0], y[1], y[2]))
    root = v8.sqrt(inverse)
    c0, c1, c2 = cross(x, y, root)
    right0, right1, right2 = cross(z, y, root)
    down0, down1, down2 = cross(x, z, root)
    by_blur = blur * inverse
    det = dot(c0, c1, c2, c0, c1, c2) + v8.fmuladd(
        by_blur, dot(x[0], x[1], x[2], x[0], x[1], x[2]), blur
    )
    gx = v8.fmuladd(
        by_blur,
        dot(x[0], x[1], x[2], z[0], z[1], z[2]),
        dot(c0, c1, c2, right0, right1, right2),
    )
    gy = v8.fmuladd(
        by_blur,
        dot(y[0], y[1], y[2], z[0], z[1], z[2]),
        dot(c0, c1, c2, down0, down1, down2),
    )
    return gx / det, gy / det


@inner()
def stage_cuts(cuts, members, at, count, staged, expected, mode, lines):
    """Cuts of a batch, turned to one row a number, about the tile's corner. staged: cpu_items'.

    expected, mode: None where the lines of the surfaces are not wanted. Returns whether any splat
    is cut: the others lie wholly on the kept side.
    """
    n, any_cut = U(BATCH), False
    for k in range(count):
        cut = U(members[at + k]) * U(CUT)
        x, y = staged[U(MEAN_X) * n + k], staged[U(MEAN_Y) * n + k]
        lx, ly = cuts[cut + U(C_X)], cuts[cut + U(C_Y)]
        lines[k] = cuts[cut + U(C_AT)] - lx * x - ly * y
        lines[n + k] = lx
        lines[U(2) * n + k] = ly
        any_cut = any_cut or lx != np.float32(0) or ly != np.float32(0)
        if expected is not None or mode is not None:
            gx, gy = cuts[cut + U(C_RIGHT)], cuts[cut + U(C_DOWN)]
            lines[U(3) * n + k] = -gx * x - gy * y
            lines[U(4) * n + k] = gx
            lines[U(5) * n + k] = gy
            lines[U(6) * n + k] = cuts[cut + U(C_REACH)]
    return any_cut


@inner()
def list_lines(lines, kind, count, strip, spans, values):
    """A line's value at the first pixel of every item of cpu_items.list_items, in its order."""
    n, items = U(BATCH), U(0)
    half = np.float32(0.5)
    first_x = np.float32(strip * LANES) + half
    for k in range(count):
        row, end = spans[k], spans[n + k]
        down = lines[U(kind) + U(2) * n + k]
        start = lines[U(kind) + k] + lines[U(kind) + n + k] * first_x
        start = start + down * (np.float32(row) + half)
        for j in range(0, TILE_H, LANES):
            first = v8.splat(start + down * np.float32(j))
            v8.store(values, items + U(j), v8.fmuladd(v8.splat(down), v8.lane_numbers(), first))
        items += U(end - row)


@inner()
def line_at(lines, kind, values, splat, item):
    """A line's values at the eight pixels of an item."""
    slope = v8.splat(lines[U(kind) + U(BATCH) + splat])
    return v8.fmuladd(slope, v8.lane_numbers(), v8.splat(values[item]))


@inner()
def surface_depth(lines, values, splat, item, depth, parallel):
    """Depths of a splat's surface at an item's pixels. parallel: 1 where rays are, else 0."""
    one = np.float32(1)
    reach = v8.splat(lines[U(REACHES) + splat])
    farther = v8.minimum(line_at(lines, SURFACE, values, splat, item), reach)
    farther = v8.maximum(farther, v8.negate(reach))
    depths = v8.fmuladd(v8.splat(parallel), farther, v8.splat(depth))
    return depths / (v8.splat(one) - v8.splat(one - parallel) * farther)


@inner()
def kept_share(lines, values, splat, item):
    value = line_at(lines, SHARE, values, splat, item)
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    return v8.maximum(v8.minimum(value, one), zero)
