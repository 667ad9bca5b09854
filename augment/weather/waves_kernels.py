"""Numba kernel for the water's normals at every pixel of a camera.

Along a row of the image everything is rational in the column. With d the ray (unit z in the
camera), a and b its change per column and row, eye at height h and s = -h / d_z, the plane point n
columns right of an anchor pixel (index 0) lies at

    p = p0 + s n A,   A = a - (a_z / d0_z) d0      (horizontal parts)

and one pixel right and one pixel down move it by

    (s / d_z) d0_z A   and   (s / d_z) (b d0_z - b_z d0 + n (b a_z - b_z a))

So float64 is needed once per wave and chunk of a row; float32 counts turns from the anchor.
"""

# pyright: reportCallIssue=false
# (of numba's intrinsics it sees the compiler's first argument as well)

from __future__ import annotations

import numba
import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner, kernel

CHUNK = 64  # columns that share an anchor; few enough for float32 turns good to 1e-6
KEPT, FADING = 7, 10  # float32 numbers that are laid out per wave
_ZERO, _HALF, _ONE, _THREE = (np.float32(x) for x in (0, 0.5, 1, 3))
TINY = np.float32(1e-24)  # square of a normal's length, before it is made 1, at a cusp
# sin(pi r) / r and cos(pi r) in powers of r^2 for |r| <= 1/2, least maximal error (3e-9, 5e-8).
SINE = (3.14159258, -5.16770688, 2.55003138, -0.598045173, 0.0772201257)
COSINE = (0.999999953, -4.93479286, 4.05841191, -1.33188016, 0.219696799)
_S0, _S1, _S2, _S3, _S4 = (np.float32(c) for c in SINE)
_C0, _C1, _C2, _C3, _C4 = (np.float32(c) for c in COSINE)


@inner()
def _sin_cos(turns):
    """sin and cos of 2 pi turns, off by less than 4e-7 beside what turns is off."""
    r = turns - v8.floor(turns + v8.splat(_HALF))
    z = r * r
    s = v8.fmuladd(v8.splat(_S4), z, v8.splat(_S3))
    s = v8.fmuladd(s, z, v8.splat(_S2))
    s = v8.fmuladd(s, z, v8.splat(_S1))
    s = v8.fmuladd(s, z, v8.splat(_S0)) * r
    c = v8.fmuladd(v8.splat(_C4), z, v8.splat(_C3))
    c = v8.fmuladd(c, z, v8.splat(_C2))
    c = v8.fmuladd(c, z, v8.splat(_C1))
    c = v8.fmuladd(c, z, v8.splat(_C0))
    twice = s + s
    return twice * c, v8.fmuladd(v8.negate(twice), s, v8.splat(_ONE))


@inner()
def _ray_z(column, row_z, rotation, lens):
    """World z of a pixel's ray, by the same roundings as Camera.ray_directions."""
    return (column + 0.5 - lens[2]) / lens[0] * rotation[2, 0] + row_z + rotation[2, 2]


@inner()
def _meets(column, row_z, rotation, lens, height, farthest):
    away = -height / _ray_z(column, row_z, rotation, lens)
    return away > 0.0 and away <= farthest


@inner()
def _columns_that_meet(width, row_z, rotation, lens, height, farthest):
    """First and one past the last column whose rays meet the plane, which are an interval."""
    first, last = 0, width - 1
    meets_first = _meets(first, row_z, rotation, lens, height, farthest)
    meets_last = _meets(last, row_z, rotation, lens, height, farthest)
    if meets_first == meets_last:
        return 0, width if meets_first else 0
    while last - first > 1:
        middle = (first + last) // 2
        if _meets(middle, row_z, rotation, lens, height, farthest) == meets_first:
            first = middle
        else:
            last = middle
    return (0, last) if meets_first else (last, width)


@inner()
def _sort_waves(waves, terms, place, step, z, drop, bend, columns, spacing, kept, fading, faded):
    """Sort the waves of one chunk by whether all, some or none of its pixels resolve them.

    place: p0. step: A. z: of the anchor's ray. drop, bend: the constant and the linear part of the
    step down. columns: the chunk's first and last, from the anchor. spacing: the least of
    (s / d_z)^2 times the square of the length in pixels at which a wave is gone, and the greatest
    times that of its full height. kept, fading: filled with what `_add_kept` and `_add_fading` want
    of a wave; how many there are is returned. faded [3]: slope variance of the rest, xx, xy, yy.
    """
    many = some = np.uint64(0)
    faded[:] = _ZERO
    for i in range(len(waves)):
        kx, ky = waves[i, 0], waves[i, 1]
        along = kx * step[0] + ky * step[1]
        side = (along * z) ** 2
        down = kx * drop[0] + ky * drop[1]
        down_more = kx * bend[0] + ky * bend[1]
        left, right = down + columns[0] * down_more, down + columns[1] * down_more
        nearest = 0.0 if left * right < 0.0 else min(left * left, right * right)
        if spacing[0] * (side + nearest) >= 1.0:
            gx, gy = terms[i, 3], terms[i, 4]
            faded[0] += _HALF * gx * gx
            faded[1] += _HALF * gx * gy
            faded[2] += _HALF * gy * gy
            continue
        turns = kx * place[0] + ky * place[1] + waves[i, 2]
        turns -= np.floor(turns)
        if spacing[1] * (side + max(left * left, right * right)) <= 1.0:
            at = many * np.uint64(KEPT)
            _put(kept, at, turns, along, terms, i)
            many += np.uint64(1)
        else:
            at = some * np.uint64(FADING)
            _put(fading, at, turns, along, terms, i)
            fading[at + np.uint64(7)] = np.float32(side)
            fading[at + np.uint64(8)] = np.float32(down)
            fading[at + np.uint64(9)] = np.float32(down_more)
            some += np.uint64(1)
    return many, some


@inner()
def _put(values, at, turns, along, terms, i):
    values[at] = np.float32(turns)
    values[at + np.uint64(1)] = np.float32(along)
    for k in range(5):
        values[at + np.uint64(2 + k)] = terms[i, k]


@inner()
def _term(values, at, k):
    return v8.splat(values[at + np.uint64(k)])


@inner()
def _add_kept(kept, count, way):
    """The sums over waves of the tangents' five terms; way: s n of eight pixels."""
    xx = xy = yy = gx = gy = v8.splat(_ZERO)
    for i in range(count):
        at = i * np.uint64(KEPT)
        sine, cosine = _sin_cos(v8.fmuladd(_term(kept, at, 1), way, _term(kept, at, 0)))
        xx = v8.fmuladd(_term(kept, at, 2), sine, xx)
        xy = v8.fmuladd(_term(kept, at, 3), sine, xy)
        yy = v8.fmuladd(_term(kept, at, 4), sine, yy)
        gx = v8.fmuladd(_term(kept, at, 5), cosine, gx)
        gy = v8.fmuladd(_term(kept, at, 6), cosine, gy)
    return xx, xy, yy, gx, gy


@inner()
def _add_fading(fading, count, way, n, spacing, limits, vx, vy, lost, xx, xy, yy, gx, gy):
    """As `_add_kept` with weights; what they leave out goes to the variance `lost`."""
    gone, rise = limits[1], _ONE / (limits[2] - limits[1])
    for i in range(count):
        at = i * np.uint64(FADING)
        down = v8.fmuladd(_term(fading, at, 9), n, _term(fading, at, 8))
        per_pixel = spacing * v8.sqrt(v8.fmuladd(down, down, _term(fading, at, 7)))
        t = (v8.splat(_ONE) / per_pixel - v8.splat(gone)) * v8.splat(rise)
        t = v8.minimum(v8.maximum(t, v8.splat(_ZERO)), v8.splat(_ONE))
        weight = t * t * (v8.splat(_THREE) - t - t)
        sine, cosine = _sin_cos(v8.fmuladd(_term(fading, at, 1), way, _term(fading, at, 0)))
        sine, cosine = weight * sine, weight * cosine
        xx = v8.fmuladd(_term(fading, at, 2), sine, xx)
        xy = v8.fmuladd(_term(fading, at, 3), sine, xy)
        yy = v8.fmuladd(_term(fading, at, 4), sine, yy)
        slope_x, slope_y = _term(fading, at, 5), _term(fading, at, 6)
        gx = v8.fmuladd(slope_x, cosine, gx)
        gy = v8.fmuladd(slope_y, cosine, gy)
        slope = slope_x * vx + slope_y * vy
        share = v8.splat(_HALF) * (v8.splat(_ONE) - weight * weight)
        lost = v8.fmuladd(share * slope, slope, lost)
    return lost, xx, xy, yy, gx, gy


@inner()
def _shade_chunk(kept, many, fading, some, faded, ray, height, limits, begin, end, out):
    """out [3 * CHUNK]: normal x, normal y and variance of columns begin to end from the anchor.

    ray: d0 and a, their x, y and z. limits [3]: of `fill_field`.
    """
    zero, one = v8.splat(_ZERO), v8.splat(_ONE)
    x0, y0, z0, ax, ay, az = ray
    for block in range((end - begin + 7) // 8):
        n = v8.splat(np.float32(begin + 8 * block)) + v8.lane_numbers()
        inverse = one / v8.fmuladd(v8.splat(az), n, v8.splat(z0))
        away = v8.splat(-height) * inverse
        spacing = v8.absolute(away * inverse)
        dx = v8.fmuladd(v8.splat(ax), n, v8.splat(x0))
        dy = v8.fmuladd(v8.splat(ay), n, v8.splat(y0))
        length = v8.sqrt(v8.fmuladd(dx, dx, dy * dy))
        slanted = v8.at_least(length, v8.splat(limits[0]))
        vx, vy = v8.select(slanted, dx / length, one), v8.select(slanted, dy / length, zero)
        lost = v8.splat(faded[0]) * vx * vx
        lost = v8.fmuladd(v8.splat(faded[1] + faded[1]) * vx, vy, lost)
        lost = v8.fmuladd(v8.splat(faded[2]) * vy, vy, lost)
        way = away * n
        xx, xy, yy, gx, gy = _add_kept(kept, many, way)
        lost, xx, xy, yy, gx, gy = _add_fading(
            fading, some, way, n, spacing, limits, vx, vy, lost, xx, xy, yy, gx, gy
        )
        wide, deep = one - xx, one - yy
        nx = v8.negate(v8.fmuladd(xy, gy, deep * gx))
        ny = v8.negate(v8.fmuladd(xy, gx, wide * gy))
        nz = v8.maximum(wide * deep - xy * xy, zero)
        square = v8.fmuladd(nx, nx, v8.fmuladd(ny, ny, nz * nz))
        scale = one / v8.sqrt(v8.maximum(square, v8.splat(TINY)))
        at = np.uint64(8 * block)
        v8.store(out, at, nx * scale)
        v8.store(out, at + np.uint64(CHUNK), ny * scale)
        v8.store(out, at + np.uint64(2 * CHUNK), v8.maximum(lost, zero))


@inner()
def _anchor(begin, end, row_z, rotation, lens):
    """A column near the middle, or the end with the nearer plane where distances differ much.

    Turns counted from a point near the horizon would be lost in float32.
    """
    middle, last = (begin + end) // 2, end - 1
    z = abs(_ray_z(middle, row_z, rotation, lens))
    z_begin = abs(_ray_z(begin, row_z, rotation, lens))
    z_last = abs(_ray_z(last, row_z, rotation, lens))
    if 2 * z >= max(z_begin, z_last):
        return middle
    return begin if z_begin > z_last else last


@kernel
def fill_field(
    rotation, eye, height, lens, farthest, limits, waves, terms, normal_x, normal_y, slope_variance
):
    """Normals and slope variance where a pixel's ray meets the plane; other pixels are left alone.

    rotation [3, 3]: world_from_camera. eye [2]: its x and y. height: of the eye over the plane.
    lens: fx, fy, cx, cy. farthest: depth at which the plane is still met. waves [N, 3]: turns per
    metre of x and of y, turns at the origin. All float64. limits [3]: horizontal part of a ray, at
    unit z, below which it is vertical; lengths in pixels at which a wave is gone, and at full
    height. terms [N, 5]: S Dx Dx, S Dx Dy, S Dy Dy, k A Dx, k A Dy. Both float32, as the outputs
    [H, W].
    """
    rows, width = normal_x.shape
    ax, ay, az = rotation[0, 0] / lens[0], rotation[1, 0] / lens[0], rotation[2, 0] / lens[0]
    bx, by, bz = rotation[0, 1] / lens[1], rotation[1, 1] / lens[1], rotation[2, 1] / lens[1]
    for i in numba.prange(rows):
        v = (i + 0.5 - lens[3]) / lens[1]
        row_z = v * rotation[2, 1]
        first, end = _columns_that_meet(width, row_z, rotation, lens, height, farthest)
        if first == end:
            continue
        kept = np.empty(len(waves) * KEPT, np.float32)
        fading = np.empty(len(waves) * FADING, np.float32)
        faded = np.empty(3, np.float32)
        out = np.empty(3 * CHUNK, np.float32)
        for begin in range(first, end, CHUNK):
            stop = min(begin + CHUNK, end)
            at = _anchor(begin, stop, row_z, rotation, lens)
            u = (at + 0.5 - lens[2]) / lens[0]
            x = u * rotation[0, 0] + v * rotation[0, 1] + rotation[0, 2]
            y = u * rotation[1, 0] + v * rotation[1, 1] + rotation[1, 2]
            z = _ray_z(at, row_z, rotation, lens)
            z_begin = _ray_z(begin, row_z, rotation, lens)
            z_last = _ray_z(stop - 1, row_z, rotation, lens)
            s = -height / z
            place = eye[0] + s * x, eye[1] + s * y
            step = ax - az / z * x, ay - az / z * y
            drop = bx * z - bz * x, by * z - bz * y
            bend = bx * az - bz * ax, by * az - bz * ay
            near, far = max(abs(z_begin), abs(z_last)), min(abs(z_begin), abs(z_last))
            sparse = (limits[1] * height / (near * near)) ** 2
            dense = (limits[2] * height / (far * far)) ** 2
            columns = float(begin - at), float(stop - 1 - at)
            spacing = sparse, dense
            many, some = _sort_waves(
                waves, terms, place, step, z, drop, bend, columns, spacing, kept, fading, faded
            )
            start = np.float32(x), np.float32(y), np.float32(z)
            ray = (*start, np.float32(ax), np.float32(ay), np.float32(az))
            chunk = begin - at, stop - at
            _shade_chunk(
                kept, many, fading, some, faded, ray, np.float32(height), limits, *chunk, out
            )
            for j in range(stop - begin):
                normal_x[i, begin + j] = out[j]
                normal_y[i, begin + j] = out[CHUNK + j]
                slope_variance[i, begin + j] = out[2 * CHUNK + j]
