"""Triton functions: the sky in a direction, and what is seen of it and of surfaces through smog.

Definitions: augment.sky, augment.weather.smog.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from augment.weather import smog

LOG2_E = tl.constexpr(math.log2(math.e))
MAX_EXPONENT = tl.constexpr(smog.MAX_EXPONENT)
# exp(-tau) from there on is below the least normal float32.
MOST_DEPTH = tl.constexpr(126.0)


@triton.jit
def transmittance(tau):
    """exp(-tau) for tau >= 0, which may be infinite; exactly 1 at 0."""
    return tl.exp2(tl.maximum(tau * -LOG2_E, -MOST_DEPTH))


@triton.jit
def mean_density(eye_height, up):
    """Mean density of layered smog from the eye to a point, relative to its base.

    exp(-min(a, b)) (1 - exp(-x)) / x with x = |b - a|. eye_height: a, the eye's height above the
    base in scale heights. up: b - a, likewise.
    """
    x = tl.abs(up)
    series = tl.fma(x, 1 / 120, -1 / 24)
    series = tl.fma(x, series, 1 / 6)
    series = tl.fma(x, series, -1 / 2)
    series = tl.fma(x, series, 1.0)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    short = x < 0.1
    mean = tl.where(short, series, (1.0 - transmittance(x)) / tl.where(short, 1.0, x))
    lowest = eye_height + tl.minimum(up, 0.0)
    power = tl.minimum(-lowest, MAX_EXPONENT) * LOG2_E
    return tl.exp2(tl.maximum(power, -MOST_DEPTH)) * mean


@triton.jit
def sky_transmittance(x, y, z, strength):
    """What layered smog lets through of the sky in a direction of any length.

    strength: the smog's optical depth straight up. 0 for rays that do not climb.
    """
    climbs = z > 0
    tau = strength * tl.sqrt(x * x + y * y + z * z) / tl.where(climbs, z, 1.0)
    return tl.where(climbs, transmittance(tau), 0.0)


@triton.jit
def cubemap_color(faces, side, x, y, z, mask):
    """Red, green and blue of a cube map in directions of any length, bilinear.

    faces: float32 [6, side, side, 3] with one texel of their neighbours around each
    (augment.sky.with_border).
    """
    ax, ay, az = tl.abs(x), tl.abs(y), tl.abs(z)
    along_x = (ax >= ay) & (ax >= az)
    along_y = ay >= az
    axis = tl.where(along_x, x, tl.where(along_y, y, z))
    positive = axis >= 0
    face = tl.where(along_x, 0, tl.where(along_y, 2, 4)) + tl.where(positive, 0, 1)
    s_other = tl.where(along_y, x, tl.where(positive, x, -x))
    s = tl.where(along_x, tl.where(positive, -z, z), s_other)
    t = tl.where(along_x | (az > ay), -y, tl.where(positive, z, -z))
    scale = (side - 2).to(tl.float32) * 0.5
    inverse = scale / tl.abs(axis)
    middle = scale + 0.5  # of a face, from the centre of the first texel of its border
    column, row = tl.fma(s, inverse, middle), tl.fma(t, inverse, middle)
    c0, r0 = column.to(tl.int32), row.to(tl.int32)
    fc, fr = column - c0.to(tl.float32), row - r0.to(tl.float32)
    first = faces + 3 * ((face * side + r0) * side + c0)
    red = _bilinear(first, side, fc, fr, mask)
    green = _bilinear(first + 1, side, fc, fr, mask)
    return red, green, _bilinear(first + 2, side, fc, fr, mask)


@triton.jit
def _bilinear(first, side, fc, fr, mask):
    """Between four texels, of which `first` are the upper left ones."""
    below = first + 3 * side
    top = tl.load(first, mask, 0.0) * (1.0 - fc) + tl.load(first + 3, mask, 0.0) * fc
    bottom = tl.load(below, mask, 0.0) * (1.0 - fc) + tl.load(below + 3, mask, 0.0) * fc
    return top * (1.0 - fr) + bottom * fr
