"""Triton functions: what colour a splat shows to the camera. SH of degrees 0 to 3, then smog."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.render import layout
from augment.render.cuda_geometry_kernels import dot, floats_at, three
from augment.weather import smog

LOG2_E = tl.constexpr(math.log2(math.e))
LAYERED_SMOG = tl.constexpr(layout.LAYERED_SMOG)
MAX_EXPONENT = tl.constexpr(smog.MAX_EXPONENT)
LOWEST = tl.constexpr(-126.0)  # 2^-126: nothing is seen through it
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
        tau = tau * _layered_density(d, view)
    return tl.exp2(tl.maximum(tau * -LOG2_E, LOWEST))


@triton.jit
def _layered_density(d, view):
    """Mean density along the way, relative to the base: exp(-min(a, b)) (1 - exp(-x)) / x.

    a, b: heights of eye and splat in scale heights, x = |b - a|; see weather.smog.
    """
    up = dot(three(view + V_UP), d)
    x = tl.abs(up)
    lowest = tl.load(view + V_EYE_HEIGHT) + tl.minimum(up, 0.0)
    series = tl.fma(x, 1 / 120, -1 / 24)
    series = tl.fma(x, series, 1 / 6)
    series = tl.fma(x, series, -1 / 2)
    series = tl.fma(x, series, 1.0)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    short = x < 0.1
    fade = tl.exp2(tl.maximum(x * -LOG2_E, LOWEST))
    mean = tl.where(short, series, (1.0 - fade) / tl.where(short, 1.0, x))
    power = tl.minimum(-lowest, MAX_EXPONENT) * LOG2_E
    return tl.exp2(tl.maximum(power, LOWEST)) * mean


@triton.jit
def _add(color, sh, k, value, mask):
    """Colour plus the coefficients of SH function k times its value; sh: of every splat."""
    at = sh + 3 * k
    return (
        tl.fma(value, tl.load(at, mask, 0.0), color[0]),
        tl.fma(value, tl.load(at + 1, mask, 0.0), color[1]),
        tl.fma(value, tl.load(at + 2, mask, 0.0), color[2]),
    )


@triton.jit
def color_of(sh, functions, towards, distance, mask, FUNCTIONS: tl.constexpr):
    """max(0.5 + sum sh Y, 0). sh: pointers to every splat's coefficients, of which `functions` are
    read, FUNCTIONS at most. towards: from the eye, in the part's axes, of length `distance`.
    """
    inverse = 1.0 / distance
    x, y, z = towards[0] * inverse, towards[1] * inverse, towards[2] * inverse
    read = tl.where(mask, functions, 0)
    half = tl.full(x.shape, 0.5, tl.float32)
    color = (half, half, half)
    color = _add(color, sh, 0, C0, mask)
    if FUNCTIONS > 1:
        more = read > 1
        color = _add(color, sh, 1, y * -C1, more)
        color = _add(color, sh, 2, z * C1, more)
        color = _add(color, sh, 3, x * -C1, more)
    if FUNCTIONS > 4:
        more = read > 4
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        color = _add(color, sh, 4, xy * C2_XY, more)
        color = _add(color, sh, 5, y * z * -C2_XY, more)
        color = _add(color, sh, 6, (2.0 * zz - xx - yy) * C2_ZZ, more)
        color = _add(color, sh, 7, x * z * -C2_XY, more)
        color = _add(color, sh, 8, (xx - yy) * C2_XX, more)
        if FUNCTIONS > 9:
            more = read > 9
            color = _add(color, sh, 9, y * (3.0 * xx - yy) * -C3_CUBIC, more)
            color = _add(color, sh, 10, xy * z * C3_XYZ, more)
            color = _add(color, sh, 11, y * (4.0 * zz - xx - yy) * -C3_ZZ, more)
            color = _add(color, sh, 12, z * (2.0 * zz - 3.0 * (xx + yy)) * C3_ZZZ, more)
            color = _add(color, sh, 13, x * (4.0 * zz - xx - yy) * -C3_ZZ, more)
            color = _add(color, sh, 14, z * (xx - yy) * C3_ZXX, more)
            color = _add(color, sh, 15, x * (xx - 3.0 * yy) * -C3_CUBIC, more)
    return tl.maximum(color[0], 0.0), tl.maximum(color[1], 0.0), tl.maximum(color[2], 0.0)


@triton.jit
def mapped(color, maps_address, rows_address, map_count, row, mask):
    """Colours under their maps; maps [C, 3, 4] and int16 rows lie at the addresses.

    row: of the Gaussians in their part. Rows that are none mean the first map.
    """
    own = tl.zeros(row.shape, tl.int32)
    if map_count > 1:
        rows = rows_address.to(tl.pointer_type(tl.int16))
        own = tl.load(rows + row, mask, 0).to(tl.int32)
        own = tl.where((own >= 0) & (own < map_count), own, 0)
    at = floats_at(maps_address) + own * MAP
    return (
        _map_channel(at, color, mask),
        _map_channel(at + 4, color, mask),
        _map_channel(at + 8, color, mask),
    )


@triton.jit
def _map_channel(at, color, mask):
    value = tl.fma(tl.load(at, mask, 0.0), color[0], tl.load(at + 3, mask, 0.0))
    value = tl.fma(tl.load(at + 1, mask, 0.0), color[1], value)
    return tl.maximum(tl.fma(tl.load(at + 2, mask, 0.0), color[2], value), 0.0)


@triton.jit
def in_smog(color, through, view):
    """Colours seen through the smog; where all comes through, the same bits."""
    air, hidden = three(view + V_AIRLIGHT), 1.0 - through
    return (
        tl.fma(through, color[0], hidden * air[0]),
        tl.fma(through, color[1], hidden * air[1]),
        tl.fma(through, color[2], hidden * air[2]),
    )
