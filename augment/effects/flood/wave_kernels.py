"""Numba kernels of waves: the water's normals at every pixel of a camera.

`waves` defines what they compute, and launches `fill_field`.
"""

from __future__ import annotations

import numba
import numpy as np

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function

# pyright: reportCallIssue=false, reportGeneralTypeIssues=false
# (of numba's intrinsics it sees the compiler's first argument as well, and no result)

# Along a row of the image everything is rational in the column. With d the ray (unit z in the
# camera), a and b its change per column and row, eye at height h and s = -h / d_z, the plane point
# n columns right of an anchor pixel (index 0) lies at
#
#     p = p0 + s n A,   A = a - (a_z / d0_z) d0      (horizontal parts)
#
# and one pixel right and one pixel down move it by
#
#     (s / d_z) d0_z A   and   (s / d_z) (b d0_z - b_z d0 + n (b a_z - b_z a))
#
# So float64 is needed once per wave and chunk of a row; float32 counts turns from the anchor.

CHUNK = 64  # columns that share an anchor; few enough for float32 turns good to 1e-6
FULL_SIZE = 7  # float32 numbers per wave that all pixels of a chunk resolve
FADING_SIZE = 10  # float32 numbers per wave that some pixels of a chunk resolve
_ZERO, _HALF, _ONE, _THREE = (np.float32(x) for x in (0, 0.5, 1, 3))
TINY = np.float32(1e-24)  # squared length, before normalisation, of a normal at a cusp
# Minimax coefficients of sin(pi r) / r and cos(pi r) in powers of r^2 for |r| <= 1/2; their errors
# are at most 3e-9 and 5e-8.
SINE = (3.14159258, -5.16770688, 2.55003138, -0.598045173, 0.0772201257)
COSINE = (0.999999953, -4.93479286, 4.05841191, -1.33188016, 0.219696799)
_S0, _S1, _S2, _S3, _S4 = (np.float32(c) for c in SINE)
_C0, _C1, _C2, _C3, _C4 = (np.float32(c) for c in COSINE)


@kernel_function()
def _sin_cos(turns):
    """Return sin and cos of 2 pi turns. Their error beyond that of `turns` is below 4e-7."""
    r = turns - v8.floor(turns + v8.broadcast(_HALF))
    z = r * r
    s = v8.fmuladd(v8.broadcast(_S4), z, v8.broadcast(_S3))
    s = v8.fmuladd(s, z, v8.broadcast(_S2))
    s = v8.fmuladd(s, z, v8.broadcast(_S1))
    s = v8.fmuladd(s, z, v8.broadcast(_S0)) * r
    c = v8.fmuladd(v8.broadcast(_C4), z, v8.broadcast(_C3))
    c = v8.fmuladd(c, z, v8.broadcast(_C2))
    c = v8.fmuladd(c, z, v8.broadcast(_C1))
    c = v8.fmuladd(c, z, v8.broadcast(_C0))
    twice = s + s
    return twice * c, v8.fmuladd(v8.negate(twice), s, v8.broadcast(_ONE))


@kernel_function()
def _ray_z(column, row_z, rotation, lens):
    """Return the world z of a pixel's ray, with the same roundings as Camera.ray_directions."""
    return (column + 0.5 - lens[2]) / lens[0] * rotation[2, 0] + row_z + rotation[2, 2]


@kernel_function()
def _meets(column, row_z, rotation, lens, height, farthest):
    away = -height / _ray_z(column, row_z, rotation, lens)
    return away > 0.0 and away <= farthest


@kernel_function()
def _columns_that_meet(width, row_z, rotation, lens, height, farthest):
    """Return the first and one past the last of the columns, an interval, that meet the plane."""
    first = 0
    last = width - 1
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


@kernel_function()
def _sort_waves(
    waves,
    terms,
    place,
    step,
    z,
    drop,
    bend,
    columns,
    spacing,
    full_waves,
    fading_waves,
    faded_variance,
):
    """Sort the waves of one chunk by whether all, some or none of its pixels resolve them.

    Args:
        waves: as in `fill_field`.
        terms: as in `fill_field`.
        place: p0.
        step: A.
        z: of the anchor's ray.
        drop: constant part of the step down.
        bend: linear part of the step down.
        columns: the chunk's first and last, from the anchor.
        spacing: the smallest (s / d_z)^2 times the square of the wavelength in pixels at which a
            wave is gone, and the largest (s / d_z)^2 times the square of that of its full height.
        full_waves: output, numbers of the waves that all pixels resolve, for `_add_full`.
        fading_waves: output, numbers of the waves that some pixels resolve, for `_add_fading`.
        faded_variance: output [3], slope variance xx, xy, yy of the waves that no pixel resolves.

    Returns:
        The number of waves in `full_waves` and in `fading_waves`.
    """
    num_full = num_fading = np.uint64(0)
    faded_variance[:] = _ZERO
    for i in range(len(waves)):
        kx = waves[i, 0]
        ky = waves[i, 1]
        along = kx * step[0] + ky * step[1]
        side = (along * z) ** 2
        down = kx * drop[0] + ky * drop[1]
        down_more = kx * bend[0] + ky * bend[1]
        left = down + columns[0] * down_more
        right = down + columns[1] * down_more
        nearest = 0.0 if left * right < 0.0 else min(left * left, right * right)
        if spacing[0] * (side + nearest) >= 1.0:
            gx = terms[i, 3]
            gy = terms[i, 4]
            faded_variance[0] += _HALF * gx * gx
            faded_variance[1] += _HALF * gx * gy
            faded_variance[2] += _HALF * gy * gy
            continue
        turns = kx * place[0] + ky * place[1] + waves[i, 2]
        turns -= np.floor(turns)
        if spacing[1] * (side + max(left * left, right * right)) <= 1.0:
            offset = num_full * np.uint64(FULL_SIZE)
            _put(full_waves, offset, turns, along, terms, i)
            num_full += np.uint64(1)
        else:
            offset = num_fading * np.uint64(FADING_SIZE)
            _put(fading_waves, offset, turns, along, terms, i)
            fading_waves[offset + np.uint64(7)] = np.float32(side)
            fading_waves[offset + np.uint64(8)] = np.float32(down)
            fading_waves[offset + np.uint64(9)] = np.float32(down_more)
            num_fading += np.uint64(1)
    return num_full, num_fading


@kernel_function()
def _put(values, at, turns, along, terms, i):
    values[at] = np.float32(turns)
    values[at + np.uint64(1)] = np.float32(along)
    for k in range(5):
        values[at + np.uint64(2 + k)] = terms[i, k]


@kernel_function()
def _term(values, at, k):
    return v8.broadcast(values[at + np.uint64(k)])


@kernel_function()
def _add_full(full_waves, count, distance):
    """Return the sums over waves of the tangents' five terms. distance: s n of 8 pixels."""
    xx = xy = yy = gx = gy = v8.broadcast(_ZERO)
    for i in range(count):
        offset = i * np.uint64(FULL_SIZE)
        sine, cosine = _sin_cos(
            v8.fmuladd(_term(full_waves, offset, 1), distance, _term(full_waves, offset, 0))
        )
        xx = v8.fmuladd(_term(full_waves, offset, 2), sine, xx)
        xy = v8.fmuladd(_term(full_waves, offset, 3), sine, xy)
        yy = v8.fmuladd(_term(full_waves, offset, 4), sine, yy)
        gx = v8.fmuladd(_term(full_waves, offset, 5), cosine, gx)
        gy = v8.fmuladd(_term(full_waves, offset, 6), cosine, gy)
    return xx, xy, yy, gx, gy


@kernel_function()
def _add_fading(fading_waves, count, distance, n, spacing, limits, view, sums):
    """Add waves as `_add_full` does, with weights; the part they leave out adds to `lost`.

    view: vx, vy. sums: the sums to add to: lost (a slope variance), xx, xy, yy, gx, gy.
    """
    vx, vy = view
    lost, xx, xy, yy, gx, gy = sums
    faded_px = limits[1]
    rise = _ONE / (limits[2] - limits[1])
    for i in range(count):
        offset = i * np.uint64(FADING_SIZE)
        down = v8.fmuladd(_term(fading_waves, offset, 9), n, _term(fading_waves, offset, 8))
        per_pixel = spacing * v8.sqrt(v8.fmuladd(down, down, _term(fading_waves, offset, 7)))
        t = (v8.broadcast(_ONE) / per_pixel - v8.broadcast(faded_px)) * v8.broadcast(rise)
        t = v8.minimum(v8.maximum(t, v8.broadcast(_ZERO)), v8.broadcast(_ONE))
        weight = t * t * (v8.broadcast(_THREE) - t - t)
        sine, cosine = _sin_cos(
            v8.fmuladd(_term(fading_waves, offset, 1), distance, _term(fading_waves, offset, 0))
        )
        sine = weight * sine
        cosine = weight * cosine
        xx = v8.fmuladd(_term(fading_waves, offset, 2), sine, xx)
        xy = v8.fmuladd(_term(fading_waves, offset, 3), sine, xy)
        yy = v8.fmuladd(_term(fading_waves, offset, 4), sine, yy)
        slope_x = _term(fading_waves, offset, 5)
        slope_y = _term(fading_waves, offset, 6)
        gx = v8.fmuladd(slope_x, cosine, gx)
        gy = v8.fmuladd(slope_y, cosine, gy)
        slope = slope_x * vx + slope_y * vy
        share = v8.broadcast(_HALF) * (v8.broadcast(_ONE) - weight * weight)
        lost = v8.fmuladd(share * slope, slope, lost)
    return lost, xx, xy, yy, gx, gy


@kernel_function()
def _shade_chunk(
    full_waves,
    num_full,
    fading_waves,
    num_fading,
    faded_variance,
    ray,
    height,
    limits,
    begin,
    end,
    out,
):
    """Write normal x, normal y and variance of one chunk into out [3 * CHUNK].

    begin, end: the columns, from the anchor. ray: d0 and a, their x, y and z. limits [3]: as in
    `fill_field`.
    """
    zero = v8.broadcast(_ZERO)
    ones = v8.broadcast(_ONE)
    x0, y0, z0, ax, ay, az = ray
    for block in range((end - begin + 7) // 8):
        n = v8.broadcast(np.float32(begin + 8 * block)) + v8.lane_numbers()
        inverse = ones / v8.fmuladd(v8.broadcast(az), n, v8.broadcast(z0))
        away = v8.broadcast(-height) * inverse
        spacing = v8.absolute(away * inverse)
        dx = v8.fmuladd(v8.broadcast(ax), n, v8.broadcast(x0))
        dy = v8.fmuladd(v8.broadcast(ay), n, v8.broadcast(y0))
        length = v8.sqrt(v8.fmuladd(dx, dx, dy * dy))
        slanted = v8.at_least(length, v8.broadcast(limits[0]))
        vx = v8.select(slanted, dx / length, ones)
        vy = v8.select(slanted, dy / length, zero)
        lost = v8.broadcast(faded_variance[0]) * vx * vx
        lost = v8.fmuladd(v8.broadcast(faded_variance[1] + faded_variance[1]) * vx, vy, lost)
        lost = v8.fmuladd(v8.broadcast(faded_variance[2]) * vy, vy, lost)
        distance = away * n
        xx, xy, yy, gx, gy = _add_full(full_waves, num_full, distance)
        lost, xx, xy, yy, gx, gy = _add_fading(
            fading_waves,
            num_fading,
            distance,
            n,
            spacing,
            limits,
            (vx, vy),
            (lost, xx, xy, yy, gx, gy),
        )
        wide = ones - xx
        deep = ones - yy
        nx = v8.negate(v8.fmuladd(xy, gy, deep * gx))
        ny = v8.negate(v8.fmuladd(xy, gx, wide * gy))
        nz = v8.maximum(wide * deep - xy * xy, zero)
        square = v8.fmuladd(nx, nx, v8.fmuladd(ny, ny, nz * nz))
        scale = ones / v8.sqrt(v8.maximum(square, v8.broadcast(TINY)))
        offset = np.uint64(8 * block)
        v8.store(out, offset, nx * scale)
        v8.store(out, offset + np.uint64(CHUNK), ny * scale)
        v8.store(out, offset + np.uint64(2 * CHUNK), v8.maximum(lost, zero))


@kernel_function()
def _anchor(begin, end, row_z, rotation, lens):
    """Return the middle column, or the end with the nearer plane if distances differ much.

    Turns counted from a point near the horizon would lose their digits in float32.
    """
    middle = (begin + end) // 2
    last = end - 1
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
    """Write normals and slope variance of the pixels whose rays meet the plane.

    Other pixels are not written.

    Args:
        rotation: [3, 3] world_from_camera, float64.
        eye: [2] x and y of the eye, float64.
        height: of the eye over the plane.
        lens: fx, fy, cx, cy, float64.
        farthest: largest depth at which a ray meets the plane.
        limits: [3] horizontal part of a ray, at unit z, below which it counts as vertical;
            wavelengths in pixels at which a wave is gone and at which it has its full height;
            float32.
        waves: [N, 3] turns per metre of x and of y, turns at the origin, float64.
        terms: [N, 5] S Dx Dx, S Dx Dy, S Dy Dy, k A Dx, k A Dy, float32.
        normal_x: output [H, W], float32.
        normal_y: output [H, W], float32.
        slope_variance: output [H, W], float32.
    """
    images = (normal_x, normal_y, slope_variance)
    for i in numba.prange(normal_x.shape[0]):
        # The row is a separate function, because numba compiles the body of a parallel loop many
        # times.
        _fill_row(np.int64(i), rotation, eye, height, lens, farthest, limits, waves, terms, images)


@kernel_function()
def _fill_row(i, rotation, eye, height, lens, farthest, limits, waves, terms, images):
    normal_x, normal_y, slope_variance = images
    width = normal_x.shape[1]
    ax = rotation[0, 0] / lens[0]
    ay = rotation[1, 0] / lens[0]
    az = rotation[2, 0] / lens[0]
    bx = rotation[0, 1] / lens[1]
    by = rotation[1, 1] / lens[1]
    bz = rotation[2, 1] / lens[1]
    v = (i + 0.5 - lens[3]) / lens[1]
    row_z = v * rotation[2, 1]
    first, end = _columns_that_meet(width, row_z, rotation, lens, height, farthest)
    if first == end:
        return
    full_waves = np.empty(len(waves) * FULL_SIZE, np.float32)
    fading_waves = np.empty(len(waves) * FADING_SIZE, np.float32)
    faded_variance = np.empty(3, np.float32)
    out = np.empty(3 * CHUNK, np.float32)
    for begin in range(first, end, CHUNK):
        stop = min(begin + CHUNK, end)
        anchor = _anchor(begin, stop, row_z, rotation, lens)
        u = (anchor + 0.5 - lens[2]) / lens[0]
        x = u * rotation[0, 0] + v * rotation[0, 1] + rotation[0, 2]
        y = u * rotation[1, 0] + v * rotation[1, 1] + rotation[1, 2]
        z = _ray_z(anchor, row_z, rotation, lens)
        z_begin = _ray_z(begin, row_z, rotation, lens)
        z_last = _ray_z(stop - 1, row_z, rotation, lens)
        s = -height / z
        place = eye[0] + s * x, eye[1] + s * y
        step = ax - az / z * x, ay - az / z * y
        drop = bx * z - bz * x, by * z - bz * y
        bend = bx * az - bz * ax, by * az - bz * ay
        nearest = max(abs(z_begin), abs(z_last))
        farthest_z = min(abs(z_begin), abs(z_last))
        sparse = (limits[1] * height / (nearest * nearest)) ** 2
        dense = (limits[2] * height / (farthest_z * farthest_z)) ** 2
        columns = float(begin - anchor), float(stop - 1 - anchor)
        spacing = sparse, dense
        num_full, num_fading = _sort_waves(
            waves,
            terms,
            place,
            step,
            z,
            drop,
            bend,
            columns,
            spacing,
            full_waves,
            fading_waves,
            faded_variance,
        )
        start = np.float32(x), np.float32(y), np.float32(z)
        ray = (*start, np.float32(ax), np.float32(ay), np.float32(az))
        chunk = begin - anchor, stop - anchor
        _shade_chunk(
            full_waves,
            num_full,
            fading_waves,
            num_fading,
            faded_variance,
            ray,
            np.float32(height),
            limits,
            *chunk,
            out,
        )
        for j in range(stop - begin):
            normal_x[i, begin + j] = out[j]
            normal_y[i, begin + j] = out[CHUNK + j]
            slope_variance[i, begin + j] = out[2 * CHUNK + j]
