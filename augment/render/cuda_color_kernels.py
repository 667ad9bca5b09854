"""Triton functions: what colour a splat shows to the camera. SH of degrees 0 to 3, then smog."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import layout
from augment.render.cuda_geometry_kernels import dot, four_where, three
from augment.render.cuda_sky_kernels import mean_density, transmittance

LAYERED_SMOG = tl.constexpr(layout.LAYERED_SMOG)
MAP = tl.constexpr(layout.MAP)
V_SIGMA, V_AIRLIGHT = tl.constexpr(layout.V_SIGMA), tl.constexpr(layout.V_AIRLIGHT)
V_EYE_HEIGHT, V_UP = tl.constexpr(layout.V_EYE_HEIGHT), tl.constexpr(layout.V_UP)

C0 = tl.constexpr(math.sqrt(1 / (4 * math.pi)))
C1 = tl.constexpr(math.sqrt(3 / (4 * math.pi)))
C2_XY = tl.constexpr(math.sqrt(15 / (4 * math.pi)))
C2_ZZ = tl.constexpr(math.sqrt(5 / (16 * math.pi)))
C2_XX = tl.constexpr(math.sqrt(15 / (16 * math.pi)))
C3_CUBIC = tl.constexpr(math.sqrt(35 / (32 * math.pi)))
C3_XYZ = tl.constexpr(math.sqrt(105 / (4 * math.pi)))
C3_ZZ = tl.constexpr(math.sqrt(21 / (32 * math.pi)))
C3_ZZZ = tl.constexpr(math.sqrt(7 / (16 * math.pi)))
C3_ZXX = tl.constexpr(math.sqrt(105 / (16 * math.pi)))


@triton.jit
def through_smog(d, distance, view, SMOG: tl.constexpr):
    """Transmittance from the eye to splats; d: from the eye, in the part's axes."""
    tau = tl.load(view + V_SIGMA) * distance
    if SMOG == LAYERED_SMOG:
        tau = tau * mean_density(tl.load(view + V_EYE_HEIGHT), dot(three(view + V_UP), d))
    return transmittance(tau)


@triton.jit
def color_of(sh, functions, towards, distance, mask, FUNCTIONS: tl.constexpr):
    """max(0.5 + sum sh Y, 0). sh: pointers to every splat's coefficients, of `functions` functions;
    FUNCTIONS: how many are read at most. towards: from the eye, in the part's axes, of length
    `distance`.
    """
    inverse = 1.0 / distance
    x, y, z = towards[0] * inverse, towards[1] * inverse, towards[2] * inverse
    basis = _basis(x, y, z, FUNCTIONS)
    half = tl.full(x.shape, 0.5, tl.float32)
    color = (half, half, half)
    read = tl.where(mask, functions, 0)
    if functions % 4 == 0:
        color = _sum_fours(color, sh, basis, read, FUNCTIONS)
    else:
        color = _sum_ones(color, sh, basis, read, FUNCTIONS)
    return tl.maximum(color[0], 0.0), tl.maximum(color[1], 0.0), tl.maximum(color[2], 0.0)


@triton.jit
def _basis(x, y, z, FUNCTIONS: tl.constexpr):
    """Spherical harmonics of unit directions, as render.sh lists them; 0 for those not read."""
    zero = tl.zeros_like(x)
    y0 = zero + C0
    y1, y2, y3, y4, y5, y6, y7, y8 = zero, zero, zero, zero, zero, zero, zero, zero
    y9, y10, y11, y12, y13, y14, y15 = zero, zero, zero, zero, zero, zero, zero
    if FUNCTIONS > 1:
        y1, y2, y3 = y * -C1, z * C1, x * -C1
    if FUNCTIONS > 4:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        y4, y5, y7 = xy * C2_XY, y * z * -C2_XY, x * z * -C2_XY
        y6, y8 = (2.0 * zz - xx - yy) * C2_ZZ, (xx - yy) * C2_XX
        if FUNCTIONS > 9:
            y9 = y * tl.fma(3.0, xx, -yy) * -C3_CUBIC
            y15 = x * tl.fma(-3.0, yy, xx) * -C3_CUBIC
            y10, y14 = xy * z * C3_XYZ, z * (xx - yy) * C3_ZXX
            y11, y13 = y * (4.0 * zz - xx - yy) * -C3_ZZ, x * (4.0 * zz - xx - yy) * -C3_ZZ
            y12 = z * tl.fma(-3.0, xx + yy, 2.0 * zz) * C3_ZZZ
    return y0, y1, y2, y3, y4, y5, y6, y7, y8, y9, y10, y11, y12, y13, y14, y15


@triton.jit
def _sum_ones(color, sh, basis, read, FUNCTIONS: tl.constexpr):
    """Colour plus coefficients times basis; read: of how many functions. Any number in a row."""
    for k in tl.static_range(FUNCTIONS):
        at, mask = sh + 3 * k, read > k
        red, green, blue = (
            tl.load(at, mask, 0.0),
            tl.load(at + 1, mask, 0.0),
            tl.load(at + 2, mask, 0.0),
        )
        color = _add(color, basis[k], red, green, blue)
    return color


@triton.jit
def _sum_fours(color, sh, basis, read, FUNCTIONS: tl.constexpr):
    """As _sum_ones, by 16 bytes: four functions of a splat fill three such pieces, and rows of 4
    and of 16 functions begin at a multiple of 16 bytes.
    """
    for k in tl.static_range(0, FUNCTIONS, 4):
        red, green, blue, red1 = four_where(sh + 3 * k, read > k)
        color = _add(color, basis[k], red, green, blue)
        if k + 1 < FUNCTIONS:
            green1, blue1, red2, green2 = four_where(sh + 3 * k + 4, read > k)
            blue2, red3, green3, blue3 = four_where(sh + 3 * k + 8, read > k)
            color = _add(color, basis[k + 1], red1, green1, blue1)
            color = _add(color, basis[k + 2], red2, green2, blue2)
            color = _add(color, basis[k + 3], red3, green3, blue3)
    return color


@triton.jit
def _add(color, value, red, green, blue):
    return (
        tl.fma(value, red, color[0]),
        tl.fma(value, green, color[1]),
        tl.fma(value, blue, color[2]),
    )


@triton.jit
def mapped(color, maps, rows, map_count, mask):
    """Colours under their maps. maps: of the part, [C, 3, 4]; rows: pointers to every Gaussian's,
    int16, read where there is more than one map. Rows that are none mean the first.
    """
    own = tl.zeros(mask.shape, tl.int32)
    if map_count > 1:
        own = tl.load(rows, mask, 0).to(tl.int32)
        own = tl.where((own >= 0) & (own < map_count), own, 0)
    at = maps + own * MAP
    return (
        _map_channel(at, color, mask),
        _map_channel(at + 4, color, mask),
        _map_channel(at + 8, color, mask),
    )


@triton.jit
def _map_channel(at, color, mask):
    """One row of the maps applied to the colours; not below 0."""
    red, green, blue, more = four_where(at, mask)
    value = tl.fma(green, color[1], tl.fma(red, color[0], more))
    return tl.maximum(tl.fma(blue, color[2], value), 0.0)


@triton.jit
def in_smog(color, through, view):
    """Colours seen through the smog; where all comes through, the same bits."""
    air, hidden = three(view + V_AIRLIGHT), 1.0 - through
    return (
        tl.fma(through, color[0], hidden * air[0]),
        tl.fma(through, color[1], hidden * air[1]),
        tl.fma(through, color[2], hidden * air[2]),
    )
