"""Numba kernels: what colour a splat shows to the camera. SH of degrees 0 to 3, then smog.

Eight splats at a time for what depends on the direction alone (`prepare_colors`), one at a time for
the sum over its coefficients (`write_color`), which are read where they lie in the scene.
"""

from __future__ import annotations

import math

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner
from augment.render.cpu_math import LOG2_E, exp2_fine, fmuladd
from augment.render.layout import (
    BLUE,
    GREEN,
    LANES,
    LAYERED_SMOG,
    NO_SMOG,
    RED,
    V_AIRLIGHT,
    V_EYE_HEIGHT,
    V_SIGMA,
    V_UP,
    U,
)
from augment.weather.smog import MAX_EXPONENT

MAX_FUNCTIONS = 16
THROUGH = MAX_FUNCTIONS  # row of the smog's transmittance, after those of the SH functions
COLOR_ROWS = MAX_FUNCTIONS + 1

_C0 = np.float32(math.sqrt(1 / (4 * math.pi)))
_C1 = np.float32(math.sqrt(3 / (4 * math.pi)))
_C2_XY = np.float32(math.sqrt(15 / (4 * math.pi)))
_C2_ZZ = np.float32(math.sqrt(5 / (16 * math.pi)))
_C2_XX = np.float32(math.sqrt(15 / (16 * math.pi)))
_C3_CUBIC = np.float32(math.sqrt(35 / (32 * math.pi)))
_C3_XYZ = np.float32(math.sqrt(105 / (4 * math.pi)))
_C3_ZZ = np.float32(math.sqrt(21 / (32 * math.pi)))
_C3_ZZZ = np.float32(math.sqrt(7 / (16 * math.pi)))
_C3_ZXX = np.float32(math.sqrt(105 / (16 * math.pi)))


@inner()
def prepare_colors(dx, dy, dz, view, functions, smog, rows):
    """SH functions and transmittance of eight splats, d from the eye in the part's axes.

    rows: flat, COLOR_ROWS of eight, filled.
    """
    distance = v8.sqrt(v8.fmuladd(dx, dx, v8.fmuladd(dy, dy, dz * dz)))
    inverse = v8.splat(np.float32(1)) / distance
    write_basis(dx * inverse, dy * inverse, dz * inverse, functions, rows)
    if smog != NO_SMOG:
        tau = v8.splat(view[V_SIGMA]) * distance
        if smog == LAYERED_SMOG:
            tau = tau * _layered_density(dx, dy, dz, view)
        lowest = v8.splat(np.float32(-126))  # 1e-38: nothing is seen through it
        through = exp2_fine(v8.maximum(tau * v8.splat(-LOG2_E), lowest))
        v8.store(rows, U(THROUGH * LANES), through)


@inner()
def _layered_density(dx, dy, dz, view):
    """Mean density along the way, relative to the base: exp(-min(a, b)) (1 - exp(-x)) / x.

    a, b: heights of eye and splat in scale heights, x = |b - a|; see weather.smog.
    """
    one, zero = v8.splat(np.float32(1)), v8.splat(np.float32(0))
    up = v8.splat(view[V_UP + 2]) * dz
    up = v8.fmuladd(v8.splat(view[V_UP + 1]), dy, up)
    up = v8.fmuladd(v8.splat(view[V_UP]), dx, up)
    x = v8.maximum(up, v8.negate(up))
    lowest = v8.splat(view[V_EYE_HEIGHT]) + v8.minimum(up, zero)
    fade = exp2_fine(v8.maximum(x * v8.splat(-LOG2_E), v8.splat(np.float32(-126))))
    series = v8.fmuladd(x, v8.splat(np.float32(1 / 120)), v8.splat(np.float32(-1 / 24)))
    series = v8.fmuladd(x, series, v8.splat(np.float32(1 / 6)))
    series = v8.fmuladd(x, series, v8.splat(np.float32(-1 / 2)))
    series = v8.fmuladd(x, series, one)
    # Below 0.1 the difference 1 - exp(-x) has lost a digit, and the series' next term is 1e-8.
    short = v8.greater(v8.splat(np.float32(0.1)), x)
    mean = v8.select(short, series, (one - fade) / v8.select(short, one, x))
    power = v8.minimum(v8.negate(lowest), v8.splat(np.float32(MAX_EXPONENT))) * v8.splat(LOG2_E)
    return exp2_fine(v8.maximum(power, v8.splat(np.float32(-126)))) * mean


@inner()
def write_basis(x, y, z, functions, rows):
    """The first `functions` spherical harmonics of unit directions, as render.sh lists them."""
    v8.store(rows, U(0 * LANES), v8.splat(_C0))
    if functions > 1:
        v8.store(rows, U(1 * LANES), v8.splat(-_C1) * y)
        v8.store(rows, U(2 * LANES), v8.splat(_C1) * z)
        v8.store(rows, U(3 * LANES), v8.splat(-_C1) * x)
    if functions > 4:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        two = v8.splat(np.float32(2))
        v8.store(rows, U(4 * LANES), v8.splat(_C2_XY) * xy)
        v8.store(rows, U(5 * LANES), v8.splat(-_C2_XY) * y * z)
        v8.store(rows, U(6 * LANES), v8.splat(_C2_ZZ) * (two * zz - xx - yy))
        v8.store(rows, U(7 * LANES), v8.splat(-_C2_XY) * x * z)
        v8.store(rows, U(8 * LANES), v8.splat(_C2_XX) * (xx - yy))
        if functions > 9:
            three, four = v8.splat(np.float32(3)), v8.splat(np.float32(4))
            v8.store(rows, U(9 * LANES), v8.splat(-_C3_CUBIC) * y * (three * xx - yy))
            v8.store(rows, U(10 * LANES), v8.splat(_C3_XYZ) * xy * z)
            v8.store(rows, U(11 * LANES), v8.splat(-_C3_ZZ) * y * (four * zz - xx - yy))
            v8.store(rows, U(12 * LANES), v8.splat(_C3_ZZZ) * z * (two * zz - three * (xx + yy)))
            v8.store(rows, U(13 * LANES), v8.splat(-_C3_ZZ) * x * (four * zz - xx - yy))
            v8.store(rows, U(14 * LANES), v8.splat(_C3_ZXX) * z * (xx - yy))
            v8.store(rows, U(15 * LANES), v8.splat(-_C3_CUBIC) * x * (xx - three * yy))


@inner()
def write_color(sh, at, functions, maps, at_map, view, smog, rows, lane, records, slot):
    """max(0.5 + sum sh Y, 0), mapped and in the smog, to the record that starts at `slot`.

    sh, maps: flat; the splat's coefficients start at `at`, its colour map at `at_map`, which is
    negative where it has none.
    """
    r = g = b = np.float32(0.5)
    for k in range(U(functions)):
        value = rows[k * U(LANES) + lane]
        r = fmuladd(value, sh[at], r)
        g = fmuladd(value, sh[at + U(1)], g)
        b = fmuladd(value, sh[at + U(2)], b)
        at += U(3)
    zero = np.float32(0)
    r, g, b = max(r, zero), max(g, zero), max(b, zero)
    if at_map >= 0:
        mapped_r = _map_channel(maps, U(at_map), r, g, b)
        mapped_g = _map_channel(maps, U(at_map) + U(4), r, g, b)
        b = _map_channel(maps, U(at_map) + U(8), r, g, b)
        r, g = mapped_r, mapped_g
    if smog != NO_SMOG:
        t = rows[U(THROUGH * LANES) + lane]
        hidden = np.float32(1) - t
        r = fmuladd(t, r, hidden * view[V_AIRLIGHT])
        g = fmuladd(t, g, hidden * view[V_AIRLIGHT + 1])
        b = fmuladd(t, b, hidden * view[V_AIRLIGHT + 2])
    records[slot + U(RED)] = r
    records[slot + U(GREEN)] = g
    records[slot + U(BLUE)] = b


@inner()
def _map_channel(maps, at, r, g, b):
    """One row of a colour map, at four numbers from `at`, applied to a colour; not below 0."""
    value = fmuladd(maps[at], r, maps[at + U(3)])
    value = fmuladd(maps[at + U(1)], g, value)
    return max(fmuladd(maps[at + U(2)], b, value), np.float32(0))


@inner()
def add_direction_slopes(x, y, z, functions, rows):
    """Sum over SH functions k >= 1 of a row's weight times the slope of the function, by x, y, z.

    rows: flat; the weights of function k for eight splats start at k LANES. Slopes are those of
    the polynomials in `write_basis`; only their part across the direction has a meaning.
    """
    two, three = v8.splat(np.float32(2)), v8.splat(np.float32(3))
    c1 = v8.splat(_C1)
    gx = v8.negate(c1 * v8.load(rows, U(3 * LANES)))
    gy = v8.negate(c1 * v8.load(rows, U(1 * LANES)))
    gz = c1 * v8.load(rows, U(2 * LANES))
    if functions > U(4):
        xy, zz = v8.splat(_C2_XY), v8.splat(_C2_ZZ)
        a4, a5 = xy * v8.load(rows, U(4 * LANES)), xy * v8.load(rows, U(5 * LANES))
        a6, a7 = two * zz * v8.load(rows, U(6 * LANES)), xy * v8.load(rows, U(7 * LANES))
        a8 = two * v8.splat(_C2_XX) * v8.load(rows, U(8 * LANES))
        gx = gx + a4 * y - a6 * x - a7 * z + a8 * x
        gy = gy + a4 * x - a5 * z - a6 * y - a8 * y
        gz = gz - a5 * y + two * a6 * z - a7 * x
    if functions > U(9):
        four = v8.splat(np.float32(4))
        xx, yy, zz = x * x, y * y, z * z
        cubic, high = v8.splat(_C3_CUBIC), v8.splat(_C3_ZZ)
        a9, a15 = cubic * v8.load(rows, U(9 * LANES)), cubic * v8.load(rows, U(15 * LANES))
        a10 = v8.splat(_C3_XYZ) * v8.load(rows, U(10 * LANES))
        a11, a13 = high * v8.load(rows, U(11 * LANES)), high * v8.load(rows, U(13 * LANES))
        a12 = three * v8.splat(_C3_ZZZ) * v8.load(rows, U(12 * LANES))
        a14 = v8.splat(_C3_ZXX) * v8.load(rows, U(14 * LANES))
        three_diff = three * (xx - yy)
        two_xy = two * x * y
        gx = gx - three * a9 * two_xy + a10 * y * z + a11 * two_xy - two * a12 * x * z
        gx = gx - a13 * (four * zz - three * xx - yy) + two * a14 * x * z - a15 * three_diff
        gy = gy - a9 * three_diff + a10 * x * z - a11 * (four * zz - xx - three * yy)
        gy = gy - two * a12 * y * z + a13 * two_xy - two * a14 * y * z + three * a15 * two_xy
        gz = gz + a10 * x * y - two * four * a11 * y * z + a12 * (two * zz - xx - yy)
        gz = gz - two * four * a13 * x * z + a14 * (xx - yy)
    return gx, gy, gz
