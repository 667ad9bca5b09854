"""Triton kernel for the water's normals at every pixel of a camera.

As in `waves_kernels`, stretches of a row share an anchor pixel that float64 has placed, here on the
host; n counts columns from it, s is the way to the plane at unit depth, and A the horizontal step:

    p = p0 + s n A

A wave's turns at the anchor are p0 times its turns per metre, hundreds of turns of which only the
fraction counts. Both come as sums of a float32 of 12 significant bits and a rest, so that float32
holds the product of the large parts exactly, whose fraction is all that is kept of it.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather import waves_kernels as cpu

# Numbers of a stretch of a row: its pixels that meet the plane, the anchor, the anchor's ray, the
# step A, the constant part of the step per row, p0 (of each coordinate the large part, the rest).
BEGIN, END, ANCHOR, X, Y, Z, STEP_X, STEP_Y, DROP_X, DROP_Y = range(10)
PLACE_X, REST_X, PLACE_Y, REST_Y = range(10, 14)
STRETCH = 16
# Numbers of a wave: turns per metre of x and y (as above), turns at the eye, tangents' terms.
TURN_X, TURN_REST_X, TURN_Y, TURN_REST_Y, TURNS, TERMS = range(6)
WAVE = 12

_BEGIN, _END, _ANCHOR = tl.constexpr(BEGIN), tl.constexpr(END), tl.constexpr(ANCHOR)
_RAY, _STEP, _DROP = tl.constexpr(X), tl.constexpr(STEP_X), tl.constexpr(DROP_X)
_PLACE, _STRETCH, _WAVE = tl.constexpr(PLACE_X), tl.constexpr(STRETCH), tl.constexpr(WAVE)
_TURNS, _TERMS = tl.constexpr(TURNS), tl.constexpr(TERMS)
_S0, _S1, _S2, _S3, _S4 = (tl.constexpr(float(c)) for c in cpu.SINE)
_C0, _C1, _C2, _C3, _C4 = (tl.constexpr(float(c)) for c in cpu.COSINE)
_TINY = tl.constexpr(float(cpu.TINY))


@triton.jit
def _sin_cos(turns):
    """sin and cos of 2 pi turns, off by less than 4e-7 beside what turns is off."""
    r = turns - tl.floor(turns + 0.5)
    z = r * r
    s = ((((_S4 * z + _S3) * z + _S2) * z + _S1) * z + _S0) * r
    c = (((_C4 * z + _C3) * z + _C2) * z + _C1) * z + _C0
    twice = s + s
    return twice * c, 1.0 - twice * s


@triton.jit
def _fraction(x):
    return x - tl.floor(x)


@triton.jit(do_not_specialize=["count", "width", "per_row"])
def fill_field(
    stretches, waves, count, width, per_row, height, step_z, bend_x, bend_y, upright, gone, full,
    normal_x, normal_y, variance, LANES: tl.constexpr,
):  # fmt: skip
    """Normals and slope variance of the pixels of a camera; 0 where their rays miss the plane.

    One program a stretch of LANES columns. stretches [H, per_row, STRETCH], waves [count, WAVE]:
    lines as above. height: of the eye over the plane. step_z: change of the ray's z per column.
    bend: the linear part of the step per row. upright: horizontal part of a ray below which it is
    vertical. gone, full: lengths in pixels at which a wave is gone, and at full height.
    """
    pid = tl.program_id(0)
    line = stretches + pid * _STRETCH
    columns = (pid % per_row) * LANES + tl.arange(0, LANES)
    begin, end = tl.load(line + _BEGIN), tl.load(line + _END)
    x0, y0, z0 = tl.load(line + _RAY), tl.load(line + _RAY + 1), tl.load(line + _RAY + 2)
    ax, ay = tl.load(line + _STEP), tl.load(line + _STEP + 1)
    drop_x, drop_y = tl.load(line + _DROP), tl.load(line + _DROP + 1)
    place_x, rest_x = tl.load(line + _PLACE), tl.load(line + _PLACE + 1)
    place_y, rest_y = tl.load(line + _PLACE + 2), tl.load(line + _PLACE + 3)
    column = columns.to(tl.float32)
    meets = (column >= begin) & (column < end)
    n = tl.where(meets, column - tl.load(line + _ANCHOR), 0.0)
    inverse = 1.0 / (step_z * n + z0)
    away = -height * inverse
    dense = 1.0 / tl.abs(away * inverse)
    way = away * n
    # A column is a step of the image's first axis: rays go on by it.
    dx = x0 + n * (ax + step_z / z0 * x0)
    dy = y0 + n * (ay + step_z / z0 * y0)
    length = tl.sqrt(dx * dx + dy * dy)
    slanted = length >= upright
    vx, vy = tl.where(slanted, dx / length, 1.0), tl.where(slanted, dy / length, 0.0)
    rise = 1.0 / (full - gone)
    xx = tl.zeros([LANES], tl.float32)
    xy, yy, gx, gy, lost = xx, xx, xx, xx, xx
    for i in range(tl.where(begin < end, count, 0)):
        wave = waves + i * _WAVE
        kx, ky = tl.load(wave), tl.load(wave + 2)
        fine_x, fine_y = tl.load(wave + 1), tl.load(wave + 3)
        turns = _fraction(place_x * kx) + _fraction(place_y * ky) + tl.load(wave + _TURNS)
        fine = place_x * fine_x + place_y * fine_y
        kx, ky = kx + fine_x, ky + fine_y
        turns = _fraction(turns + (fine + (rest_x * kx + rest_y * ky)))
        along = kx * ax + ky * ay
        side = along * z0
        down = (kx * drop_x + ky * drop_y) + (kx * bend_x + ky * bend_y) * n
        # The wave's length in pixels is that over the metres (in turns) of a pixel's step.
        pixels = dense * tl.rsqrt(tl.maximum(down * down + side * side, 1e-36))
        t = tl.minimum(tl.maximum((pixels - gone) * rise, 0.0), 1.0)
        weight = t * t * (3.0 - t - t)
        sine, cosine = _sin_cos(along * way + turns)
        sine, cosine = weight * sine, weight * cosine
        xx += tl.load(wave + _TERMS) * sine
        xy += tl.load(wave + _TERMS + 1) * sine
        yy += tl.load(wave + _TERMS + 2) * sine
        slope_x, slope_y = tl.load(wave + _TERMS + 3), tl.load(wave + _TERMS + 4)
        gx += slope_x * cosine
        gy += slope_y * cosine
        slope = slope_x * vx + slope_y * vy
        lost += (0.5 * (1.0 - weight * weight)) * (slope * slope)
    wide, deep = 1.0 - xx, 1.0 - yy
    nx, ny = -(xy * gy + deep * gx), -(xy * gx + wide * gy)
    nz = tl.maximum(wide * deep - xy * xy, 0.0)
    scale = 1.0 / tl.sqrt(tl.maximum(nx * nx + ny * ny + nz * nz, _TINY))
    pixels = (pid // per_row) * width + columns
    inside = columns < width
    tl.store(normal_x + pixels, tl.where(meets, nx * scale, 0.0), mask=inside)
    tl.store(normal_y + pixels, tl.where(meets, ny * scale, 0.0), mask=inside)
    tl.store(variance + pixels, tl.where(meets, tl.maximum(lost, 0.0), 0.0), mask=inside)
