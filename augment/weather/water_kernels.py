"""Numba kernels for a water surface: what `water.shade_water` defines.

The pixels of a row that show water are worked on in strips, stage by stage: loops that compute, and
that a compiler can vectorise, take turns with loops that look pixels up, whose waits overlap. What
a stage leaves for the next stands in scratch memory, one line of `STRIP` numbers for each quantity.
Everything is float32 but the rays' directions, whose sign decides where there is water and whose
small downward part the distance to it is divided by. Indices are unsigned, so that nothing wraps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner, kernel
from augment.render.cpu_math import LOG2_E, exp2_fine

F = np.float32
U = np.uint64
ZERO, HALF, ONE, TWO = F(0), F(0.5), F(1), F(2)
NOTHING = F(-1)  # a distance at which nothing is met
STRIP = 128
N = U(STRIP)


def _lines(first, count):
    return tuple(U(STRIP * line) for line in range(first, first + count))


# Lines of the scratch memory. Points where the rays meet the water, rays to the eye, slopes and
# normals of the surface, cosines in air and water, smog before the water.
PX, PY, VX, VY, VZ, DX, DY, DZ, ALONG, SX, SY, SPREAD, ROUGH, NX, NY, NZ, COS, IN, NEAR = _lines(
    0, 19
)
# The water's own colour; the bed: refracted ray per metre of depth and its length, depths, colour.
WR, WG, WB, TX, TY, STEEP, DEPTH, OWN_DEPTH, FOUND, BR, BG, BB, BA = _lines(19, 13)
# Place and find of a look-up.
COLUMN, ROW, ALPHA, FAR, VALUE_R, VALUE_G, VALUE_B, VALUE_A = _lines(32, 8)
# Reflection: the flat mirror's distance, the ray and its share, the levels of averages, the result.
FIRST, LEVEL, FRONT_LEVEL, DISTANCE, WEIGHT, SUM_R, SUM_G, SUM_B = _lines(40, 8)
SKY_R, SKY_G, SKY_B, REFLECTED_R, REFLECTED_G, REFLECTED_B, EXP = _lines(48, 7)
# Three of each, for three slopes: mirrored ray, share, place in the mirror and in the image.
RX, RY, RZ, SHARE, MIRROR_C, MIRROR_R, FRONT_C, FRONT_R, FRONT_W = _lines(55, 27)[::3]
SCRATCH = 82 * STRIP


class View(NamedTuple):
    """A layer's camera. Tuples hold numbers alone: counting references to arrays would take longer
    than the arithmetic.

    project: focal length times the camera's right, down (fx, fy) and forward axes. rays:
    coefficients of column, row and 1 in the x, y, z of a pixel's ray. columns, rows: the image's
    sides as real numbers. Kernels take it as one array and build it with `_view`.
    """

    project: tuple[np.float32, ...]
    rays: tuple[np.float32, ...]
    cx: np.float32
    cy: np.float32
    columns: np.float32
    rows: np.float32
    width: np.uint64
    height: np.uint64


class Medium(NamedTuple):
    """The water, and the smog over it, as the kernel needs them.

    height: of the eye over the water. smog_per_m: optical depth between eye and water per metre of
    the ray, 0 without smog. smog_above: from the water straight up, < 0 where the sky is seen
    clearly (or replaced by the airlight already).
    """

    height: np.float32
    index: np.float32
    schlick: bool
    extinction: tuple[np.float32, ...]
    rgb: tuple[np.float32, ...]
    smog_per_m: np.float32
    smog_above: np.float32
    airlight: tuple[np.float32, ...]


class Limits(NamedTuple):
    """The definition's constants."""

    cover: np.float32
    farthest: np.float32
    least_cosine: np.float32
    smooth_variance: np.float32
    steepest: np.float32
    least_depth: np.float32
    solid_alpha: np.float32
    bed_steps: int
    edge: np.float32
    match_m: np.float32
    match_share: np.float32


@inner()
def _view(n):
    project = (n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8])
    rays = (n[9], n[10], n[11], n[12], n[13], n[14], n[15], n[16], n[17])
    width, height = U(np.int32(n[20])), U(np.int32(n[21]))
    return View(project, rays, n[18], n[19], n[20], n[21], width, height)


@inner()
def _medium(n):
    extinction, rgb, airlight = (n[3], n[4], n[5]), (n[6], n[7], n[8]), (n[11], n[12], n[13])
    return Medium(n[0], n[1], n[2] > ZERO, extinction, rgb, n[9], n[10], airlight)


@inner()
def _limits(n):
    return Limits(n[0], n[1], n[2], n[3], n[4], n[5], n[6], np.int64(n[7]), n[8], n[9], n[10])


@inner()
def _real(count):
    return F(np.int32(count))  # from 64 unsigned bits it takes several instructions


@inner()
def _project(view, x, y, z, least_depth):
    m = view.project
    depth = max(m[6] * x + m[7] * y + m[8] * z, least_depth)
    inverse = ONE / depth
    column = (m[0] * x + m[1] * y + m[2] * z) * inverse + view.cx
    row = (m[3] * x + m[4] * y + m[5] * z) * inverse + view.cy
    return column, row


@inner()
def _clamp(x, low, high):
    return min(max(x, low), high)


@inner()
def _clamp_to(view, column, row):
    column = _clamp(column, HALF, view.columns - HALF)
    return column, _clamp(row, HALF, view.rows - HALF)


@inner()
def _is_inside(view, column, row):
    across = column >= ZERO and column < view.columns
    return across and row >= ZERO and row < view.rows


@inner()
def _whole(x):
    return U(np.int32(x))


@inner()
def _height_of_ray(view, column, row):
    return view.rays[6] * column + view.rays[7] * row + view.rays[8]


@inner()
def _point(view, z, column, row):
    """The point that a pixel shows, relative to the layer's eye."""
    m = view.rays
    x = m[0] * column + m[1] * row + m[2]
    y = m[3] * column + m[4] * row + m[5]
    return z * x, z * y, z * _height_of_ray(view, column, row)


@inner()
def _corners(column, row, width, height):
    """Indices of the four pixels round a coordinate, and how far it lies between them."""
    x = _clamp(column - HALF, ZERO, _real(width) - ONE)
    y = _clamp(row - HALF, ZERO, _real(height) - ONE)
    c0, r0 = _whole(x), _whole(y)
    c1, r1 = min(c0 + U(1), width - U(1)), min(r0 + U(1), height - U(1))
    top, bottom = r0 * width, r1 * width
    fc, fr = x - _real(c0), y - _real(r0)
    return top + c0, top + c1, bottom + c0, bottom + c1, fc, fr


@inner()
def _mix(a, b, c, d, wa, wb, wc, wd):
    return (a * wa + b * wb) + (c * wc + d * wd)


@inner()
def _bilinear(v, alphas, view, column, row):
    a, b, c, d, fc, fr = _corners(column, row, view.width, view.height)
    gc, gr = ONE - fc, ONE - fr
    wa, wb, wc, wd = gc * gr, fc * gr, gc * fr, fc * fr
    alpha = _mix(alphas[a], alphas[b], alphas[c], alphas[d], wa, wb, wc, wd)
    a, b, c, d = U(3) * a, U(3) * b, U(3) * c, U(3) * d
    red = _mix(v[a], v[b], v[c], v[d], wa, wb, wc, wd)
    one, two = U(1), U(2)
    green = _mix(v[a + one], v[b + one], v[c + one], v[d + one], wa, wb, wc, wd)
    blue = _mix(v[a + two], v[b + two], v[c + two], v[d + two], wa, wb, wc, wd)
    return red, green, blue, alpha


@inner()
def _mip(v, sizes, level, column, row):
    first, width, height = sizes[level, U(0)], sizes[level, U(1)], sizes[level, U(2)]
    scale = ONE / _real(U(1) << level)
    a, b, c, d, fc, fr = _corners(column * scale, row * scale, width, height)
    a, b, c, d = U(4) * (first + a), U(4) * (first + b), U(4) * (first + c), U(4) * (first + d)
    gc, gr = ONE - fc, ONE - fr
    wa, wb, wc, wd = gc * gr, fc * gr, gc * fr, fc * fr
    one, two, three = U(1), U(2), U(3)
    return (
        _mix(v[a], v[b], v[c], v[d], wa, wb, wc, wd),
        _mix(v[a + one], v[b + one], v[c + one], v[d + one], wa, wb, wc, wd),
        _mix(v[a + two], v[b + two], v[c + two], v[d + two], wa, wb, wc, wd),
        _mix(v[a + three], v[b + three], v[c + three], v[d + three], wa, wb, wc, wd),
    )


@inner()
def _fetch(rgb, alpha, view, mips, sizes, column, row, level):
    """Colour and alpha at a coordinate; level: of the averages, 0 for the image itself."""
    if not level > ZERO:
        return _bilinear(rgb, alpha, view, column, row)
    low = _whole(level)
    share = level - _real(low)
    keep = ONE - share
    if low == U(0):
        r, g, b, a = _bilinear(rgb, alpha, view, column, row)
    else:
        r, g, b, a = _mip(mips, sizes, low, column, row)
    if share > ZERO:
        r1, g1, b1, a1 = _mip(mips, sizes, low + U(1), column, row)
        r, g, b = keep * r + share * r1, keep * g + share * g1, keep * b + share * b1
        a = keep * a + share * a1
    return r, g, b, a


@inner()
def _reflectance(c, inside, medium):
    """Share of reflected light. c, inside: cosines in the air and in the water."""
    n = medium.index
    if medium.schlick:
        base = (n - ONE) / (n + ONE)
        base = base * base
        x = ONE - c
        return base + (ONE - base) * ((x * x) * (x * x) * x)
    a, b = c - n * inside, c + n * inside
    d, e = n * c - inside, n * c + inside
    quotient = ONE / (b * e)
    rs, rp = a * e * quotient, d * b * quotient
    return HALF * (rs * rs + rp * rp)


@inner()
def _cosine_inside(c, medium):
    inverse = ONE / medium.index
    return math.sqrt(max(ONE - (ONE - c * c) * inverse * inverse, ZERO))


@inner()
def _sky(v, size, x, y, z):
    """Bilinear from a cube map, flat [6, size, size, 3]."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        major, t = ax, -y
        face = U(0) if x >= ZERO else U(1)
        s = -z if x >= ZERO else z
    elif ay >= az:
        major, s = ay, x
        face = U(2) if y >= ZERO else U(3)
        t = z if y >= ZERO else -z
    else:
        major, t = az, -y
        face = U(4) if z >= ZERO else U(5)
        s = x if z >= ZERO else -x
    scale = HALF * _real(size)
    inverse = scale / major
    a, b, c, d, fc, fr = _corners(s * inverse + scale, t * inverse + scale, size, size)
    first = face * size * size
    a, b, c, d = U(3) * (first + a), U(3) * (first + b), U(3) * (first + c), U(3) * (first + d)
    gc, gr = ONE - fc, ONE - fr
    wa, wb, wc, wd = gc * gr, fc * gr, gc * fr, fc * fr
    one, two = U(1), U(2)
    return (
        _mix(v[a], v[b], v[c], v[d], wa, wb, wc, wd),
        _mix(v[a + one], v[b + one], v[c + one], v[d + one], wa, wb, wc, wd),
        _mix(v[a + two], v[b + two], v[c + two], v[d + two], wa, wb, wc, wd),
    )


@inner()
def _surface(s, n, medium, limits):
    """Points, views and slopes from rays, distances and normals; smog before the water."""
    for k in range(n):
        dx, dy, dz = s[DX + k], s[DY + k], s[DZ + k]
        along = s[ALONG + k]
        s[PX + k], s[PY + k] = along * dx, along * dy
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = ONE / length
        vx, vy = -dx * inverse, -dy * inverse
        s[VX + k], s[VY + k], s[VZ + k] = vx, vy, -dz * inverse
        s[NEAR + k] = medium.smog_per_m * along * length
        nx, ny = s[NX + k], s[NY + k]
        upright = ONE / math.sqrt(max(ONE - nx * nx - ny * ny, limits.steepest))
        s[SX + k], s[SY + k] = nx * upright, ny * upright
        flat = max(math.sqrt(vx * vx + vy * vy), F(1e-12))
        s[SPREAD + k] = math.sqrt(F(3) * max(s[ROUGH + k], ZERO)) / flat


@inner()
def _tap(s, n, t, sign, weight, alone, medium, limits):
    """Mirrored rays and their shares of a pixel's light for one of its slopes.

    weight, alone: of this slope where the surface is rough and where it is not.
    """
    for k in range(n):
        vx, vy, vz = s[VX + k], s[VY + k], s[VZ + k]
        rough = s[ROUGH + k] > ZERO
        spread = sign * s[SPREAD + k] if rough else ZERO
        sx, sy = s[SX + k] + spread * vx, s[SY + k] + spread * vy
        inverse = ONE / math.sqrt(sx * sx + sy * sy + ONE)
        nx, ny, nz = sx * inverse, sy * inverse, inverse
        cosine = nx * vx + ny * vy + nz * vz
        c = _clamp(cosine, limits.least_cosine, ONE)
        inside = _cosine_inside(c, medium)
        s[NX + k], s[NY + k], s[NZ + k], s[COS + k], s[IN + k] = nx, ny, nz, c, inside
        twice = TWO * cosine
        x, y = twice * nx - vx, twice * ny - vy
        z = max(twice * nz - vz, limits.least_cosine)
        inverse = ONE / math.sqrt(x * x + y * y + z * z)
        s[RX + t + k], s[RY + t + k], s[RZ + t + k] = x * inverse, y * inverse, z * inverse
        share = weight if rough else alone
        s[SHARE + t + k] = share * _reflectance(c, inside, medium)


@inner()
def _exponential(s, n):
    """The line EXP becomes its exponentials; of numbers <= 0."""
    least, scale = v8.splat(F(-126)), v8.splat(LOG2_E)
    for k in range(U(0), n, U(8)):
        v8.store(s, EXP + k, exp2_fine(v8.maximum(v8.load(s, EXP + k) * scale, least)))


@inner()
def _water_color(s, n, medium):
    for k in range(n):
        s[EXP + k] = -s[NEAR + k]
    _exponential(s, n)
    fog, rgb = medium.airlight, medium.rgb
    for k in range(n):
        t = s[EXP + k]
        rest = ONE - t
        s[WR + k], s[WG + k] = t * rgb[0] + rest * fog[0], t * rgb[1] + rest * fog[1]
        s[WB + k] = t * rgb[2] + rest * fog[2]


@inner()
def _refract(s, n, medium, limits):
    """Refracted rays per metre of depth, and their length per metre."""
    ratio, bends = ONE / medium.index, medium.index != ONE
    for k in range(n):
        vx, vy, vz = s[VX + k], s[VY + k], s[VZ + k]
        bend = s[COS + k] * ratio - s[IN + k]
        x, y = bend * s[NX + k] - vx * ratio, bend * s[NY + k] - vy * ratio
        z = max(vz * ratio - bend * s[NZ + k], limits.least_cosine)
        steep = ONE / z
        s[TX + k], s[TY + k] = x * steep, y * steep
        length = math.sqrt(x * x + y * y + z * z) * steep
        s[STEEP + k] = length if bends else ONE / vz


@inner()
def _place_on_bed(s, n, bed, medium, limits):
    for k in range(n):
        depth = s[DEPTH + k]
        x, y = s[PX + k] + depth * s[TX + k], s[PY + k] + depth * s[TY + k]
        column, row = _project(bed, x, y, -medium.height - depth, limits.least_depth)
        s[FOUND + k] = s[FOUND + k] if _is_inside(bed, column, row) else ZERO
        s[COLUMN + k], s[ROW + k] = column, row


@inner()
def _look(s, n, index, alpha, depth, view):
    """Alpha and depth of the pixels nearest to COLUMN and ROW, which become their centres."""
    last_column, last_row, width = view.columns - ONE, view.rows - ONE, np.int32(view.width)
    for k in range(n):
        c = np.int32(_clamp(s[COLUMN + k], ZERO, last_column))
        r = np.int32(_clamp(s[ROW + k], ZERO, last_row))
        index[k] = np.int32(r * width + c)
        s[COLUMN + k], s[ROW + k] = F(c) + HALF, F(r) + HALF
    for k in range(n):
        pixel = U(index[k])
        s[ALPHA + k], s[FAR + k] = alpha[pixel], depth[pixel]


@inner()
def _search_bed(s, n, index, alpha, depth, bed, medium, limits):
    """Corrects the bed's depth along the refracted rays; COLUMN, ROW: where they meet it."""
    for _ in range(limits.bed_steps):
        _place_on_bed(s, n, bed, medium, limits)
        _look(s, n, index, alpha, depth, bed)
        for k in range(n):
            found = s[FOUND + k] if s[ALPHA + k] >= limits.solid_alpha else ZERO
            s[FOUND + k] = found
            z = s[FAR + k] * _height_of_ray(bed, s[COLUMN + k], s[ROW + k])
            s[DEPTH + k] = max(-medium.height - z, ZERO) if found > ZERO else s[DEPTH + k]
    _place_on_bed(s, n, bed, medium, limits)


@inner()
def _fetch_bed(s, n, own, rgb, alpha, bed, limits):
    """The bed's colour where it was found, straight behind the pixel elsewhere."""
    for k in range(n):
        r = g = b = a = ZERO
        if s[FOUND + k] > ZERO:
            r, g, b, a = _bilinear(rgb, alpha, bed, s[COLUMN + k], s[ROW + k])
        if a < limits.solid_alpha:
            r = g = b = a = ZERO
            s[DEPTH + k] = s[OWN_DEPTH + k]
            if own[k] >= 0:
                pixel = U(own[k])
                a = alpha[pixel]
                pixel = U(3) * pixel
                r, g, b = rgb[pixel], rgb[pixel + U(1)], rgb[pixel + U(2)]
        s[BR + k], s[BG + k], s[BB + k], s[BA + k] = r, g, b, a


@inner()
def _absorb(s, n, value, water, extinction):
    for k in range(n):
        s[EXP + k] = -extinction * (s[DEPTH + k] * s[STEEP + k])
    _exponential(s, n)
    for k in range(n):
        seen, own = s[value + k] + (ONE - s[BA + k]) * s[water + k], s[water + k]
        t = s[EXP + k]
        s[value + k] = t * seen + (ONE - t) * own


@inner()
def _measure_mirror(s, n, into, mirror, medium, limits):
    """From the surface to what was looked up in the mirrored layer, or NOTHING."""
    for k in range(n):
        x, y, z = _point(mirror, s[FAR + k], s[COLUMN + k], s[ROW + k])
        x, y, z = x - s[PX + k], y - s[PY + k], z - medium.height
        distance = math.sqrt(x * x + y * y + z * z)
        s[into + k] = distance if s[ALPHA + k] >= limits.solid_alpha else NOTHING


@inner()
def _place_in_mirror(s, n, t, distances, columns, rows, mirror, medium, limits):
    """Where reflected rays of these lengths end in the mirrored layer, kept inside it."""
    for k in range(n):
        rx, ry, rz = s[RX + t + k], s[RY + t + k], s[RZ + t + k]
        d = s[distances + k]
        met = d >= ZERO
        x, y = s[PX + k] + d * rx if met else rx, s[PY + k] + d * ry if met else ry
        z = medium.height + d * rz if met else rz
        column, row = _project(mirror, x, y, z, limits.least_depth)
        s[columns + k], s[rows + k] = _clamp_to(mirror, column, row)


@inner()
def _find_in_mirror(s, n, index, count, alpha, depth, mirror, medium, limits):
    """MIRROR_C, MIRROR_R: where the reflected rays end in the mirrored layer."""
    for k in range(n):
        column, row = _project(mirror, s[DX + k], s[DY + k], -s[DZ + k], limits.least_depth)
        s[COLUMN + k], s[ROW + k] = _clamp_to(mirror, column, row)
    _look(s, n, index, alpha, depth, mirror)
    _measure_mirror(s, n, FIRST, mirror, medium, limits)
    for tap in range(count):
        t = tap * N
        _place_in_mirror(s, n, t, FIRST, COLUMN, ROW, mirror, medium, limits)
        _look(s, n, index, alpha, depth, mirror)
        _measure_mirror(s, n, DISTANCE, mirror, medium, limits)
        _place_in_mirror(s, n, t, DISTANCE, MIRROR_C + t, MIRROR_R + t, mirror, medium, limits)


@inner()
def _place_in_image(s, n, t, front, medium, limits):
    for k in range(n):
        rx, ry, rz = s[RX + t + k], s[RY + t + k], s[RZ + t + k]
        d = s[DISTANCE + k]
        met = d >= ZERO
        x, y = s[PX + k] + d * rx if met else rx, s[PY + k] + d * ry if met else ry
        z = d * rz - medium.height if met else rz
        column, row = _project(front, x, y, z, limits.least_depth)
        s[COLUMN + k], s[ROW + k] = column, row
        s[FRONT_C + t + k], s[FRONT_R + t + k] = column, row


@inner()
def _find_in_image(s, n, index, count, alpha, depth, front, medium, limits):
    """FRONT_C, FRONT_R: where the reflected rays end in the image; FRONT_W: is it seen there."""
    m = front.project
    for tap in range(count):
        t = tap * N
        for k in range(n):
            s[DISTANCE + k] = s[FIRST + k]
        _place_in_image(s, n, t, front, medium, limits)
        _look(s, n, index, alpha, depth, front)
        for k in range(n):
            x, y, z = _point(front, s[FAR + k], s[COLUMN + k], s[ROW + k])
            x, y, z = x - s[PX + k], y - s[PY + k], z + medium.height
            better = math.sqrt(x * x + y * y + z * z)
            d = s[DISTANCE + k]
            s[DISTANCE + k] = better if d >= ZERO and s[ALPHA + k] >= limits.solid_alpha else d
        _place_in_image(s, n, t, front, medium, limits)
        _look(s, n, index, alpha, depth, front)
        for k in range(n):
            column, row, d = s[FRONT_C + t + k], s[FRONT_R + t + k], s[DISTANCE + k]
            x, y = s[PX + k] + d * s[RX + t + k], s[PY + k] + d * s[RY + t + k]
            z = d * s[RZ + t + k] - medium.height
            ahead = m[6] * x + m[7] * y + m[8] * z
            near = abs(s[FAR + k] - ahead) < max(limits.match_share * ahead, limits.match_m)
            solid = s[ALPHA + k] >= limits.solid_alpha
            seen = (solid and near) if d >= ZERO else not solid
            across = min(column, front.columns - column) / front.columns
            border = min(across, min(row, front.rows - row) / front.rows)
            fade = _clamp(border / limits.edge, ZERO, ONE)
            weight = s[WEIGHT + k] * (fade * fade * (F(3) - TWO * fade))
            s[FRONT_W + t + k] = weight if seen else ZERO
            s[FRONT_C + t + k], s[FRONT_R + t + k] = _clamp_to(front, column, row)


@inner()
def _set_levels(s, n, count, into, columns, rows, sizes):
    """Level of averages whose pixels are as wide as a pixel's three places lie apart."""
    top = _real(sizes.shape[0] - 1)
    for k in range(n):
        level = ZERO
        if count > U(1) and s[ROUGH + k] > ZERO:
            c, r = s[columns + k], s[rows + k]
            x1, y1 = s[columns + N + k] - c, s[rows + N + k] - r
            x2, y2 = s[columns + N + N + k] - c, s[rows + N + N + k] - r
            spacing = HALF * (math.sqrt(x1 * x1 + y1 * y1) + math.sqrt(x2 * x2 + y2 * y2))
            if spacing > ONE:
                level = min(F(math.log2(spacing)), top)
        s[into + k] = level


@inner()
def _fetch_layer(s, n, columns, rows, levels, rgb, alpha, view, mips, sizes):
    """VALUE: the layer's colour and the sky behind it."""
    for k in range(n):
        r, g, b, a = _fetch(
            rgb, alpha, view, mips, sizes, s[columns + k], s[rows + k], s[levels + k]
        )
        s[VALUE_R + k], s[VALUE_G + k], s[VALUE_B + k], s[VALUE_A + k] = r, g, b, a
    for k in range(n):
        through = ONE - s[VALUE_A + k]
        s[VALUE_R + k] += through * s[SKY_R + k]
        s[VALUE_G + k] += through * s[SKY_G + k]
        s[VALUE_B + k] += through * s[SKY_B + k]


@inner()
def _fetch_sky(s, n, t, faces, size, medium):
    for k in range(n):
        r, g, b = _sky(faces, size, s[RX + t + k], s[RY + t + k], s[RZ + t + k])
        s[SKY_R + k], s[SKY_G + k], s[SKY_B + k] = r, g, b
    if medium.smog_above < ZERO:
        return
    for k in range(n):
        s[EXP + k] = -(s[NEAR + k] + medium.smog_above / s[RZ + t + k])
    _exponential(s, n)
    fog = medium.airlight
    for k in range(n):
        x = s[EXP + k]
        s[SKY_R + k] = x * s[SKY_R + k] + (ONE - x) * fog[0]
        s[SKY_G + k] = x * s[SKY_G + k] + (ONE - x) * fog[1]
        s[SKY_B + k] = x * s[SKY_B + k] + (ONE - x) * fog[2]


@inner()
def _add_reflection(s, n, t):
    """One slope's share of the pixels' light comes from above instead of below."""
    for k in range(n):
        share = s[SHARE + t + k]
        s[SUM_R + k] += share * (s[REFLECTED_R + k] - s[BR + k])
        s[SUM_G + k] += share * (s[REFLECTED_G + k] - s[BG + k])
        s[SUM_B + k] += share * (s[REFLECTED_B + k] - s[BB + k])


@inner()
def _reflect(s, n, value_r, value_g, value_b):
    """REFLECTED becomes one of the colours in the scratch memory."""
    for k in range(n):
        s[REFLECTED_R + k], s[REFLECTED_G + k] = s[value_r + k], s[value_g + k]
        s[REFLECTED_B + k] = s[value_b + k]


@inner()
def _cover_with_image(s, n, t):
    for k in range(n):
        w = s[FRONT_W + t + k]
        s[REFLECTED_R + k] += w * (s[VALUE_R + k] - s[REFLECTED_R + k])
        s[REFLECTED_G + k] += w * (s[VALUE_G + k] - s[REFLECTED_G + k])
        s[REFLECTED_B + k] += w * (s[VALUE_B + k] - s[REFLECTED_B + k])


@kernel
def shade(
    u, v, axes, cover, normal_x, normal_y, variance, bed_view, bed_rgb, bed_alpha, bed_depth,
    offset, mirror_view, mirror_rgb, mirror_alpha, mirror_depth, mirror_mips, mirror_sizes,
    has_mirror, front_view, front_rgb, front_alpha, front_depth, front_mips, front_sizes,
    has_front, front_distance, front_weight, faces, size, medium_numbers, limit_numbers, out,
):  # fmt: skip
    """Water of the pixels of a camera into out [H, W, 3].

    u [W], v [H]: image coordinates at unit depth. axes [3, 3]: world_from_camera, float64. offset:
    (left, top) of the camera's window in the bed's. front: the layer of the screen-space reflection
    whose rays run front_distance. faces: flat cube map of `size` squared texels a face.
    """
    height, width = cover.shape
    left, top = offset
    for i in numba.prange(height):
        bed, mirror, front = _view(bed_view), _view(mirror_view), _view(front_view)
        medium, limits = _medium(medium_numbers), _limits(limit_numbers)
        bends = medium.index != ONE
        s = np.zeros(SCRATCH, np.float32)
        pixels, own = np.empty(STRIP, np.int64), np.empty(STRIP, np.int64)
        index = np.empty(STRIP, np.int32)
        bx, by, bz = v[i] * axes[0, 1], v[i] * axes[1, 1], v[i] * axes[2, 1]
        own_row = i + top
        row_inside = own_row >= 0 and own_row < np.int64(bed.height)
        j = 0
        while j < width:
            n, rough = U(0), False
            while j < width and n < N:
                # The order of these sums is that of Camera.ray_directions: the sign has to agree.
                fall = (u[j] * axes[2, 0] + bz) + axes[2, 2]
                if not (fall < 0.0 and cover[i, j] <= limits.cover):
                    out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = ZERO
                    j += 1
                    continue
                s[DX + n] = F((u[j] * axes[0, 0] + bx) + axes[0, 2])
                s[DY + n] = F((u[j] * axes[1, 0] + by) + axes[1, 2])
                s[DZ + n] = F(fall)
                far = np.float64(limits.farthest)
                s[ALONG + n] = F(min(np.float64(medium.height) / -fall, far))
                s[NX + n], s[NY + n] = normal_x[i, j], normal_y[i, j]
                spread = variance[i, j] if variance[i, j] >= limits.smooth_variance else ZERO
                rough = rough or spread > ZERO
                s[ROUGH + n] = spread
                own[n] = -1
                s[FOUND + n] = s[DEPTH + n] = ZERO
                column = j + left
                if row_inside and column >= 0 and column < np.int64(bed.width):
                    pixel = U(own_row) * bed.width + U(column)
                    if bed_alpha[pixel] >= limits.solid_alpha:
                        own[n], s[FOUND + n] = np.int64(pixel), ONE
                        s[DEPTH + n] = max(-bed_depth[pixel] * F(fall) - medium.height, ZERO)
                s[OWN_DEPTH + n] = s[DEPTH + n]
                if has_front:
                    s[FIRST + n] = front_distance[i, j]
                    s[WEIGHT + n] = front_weight[i, j]
                pixels[n] = j
                n += U(1)
                j += 1
            if n == U(0):
                continue
            _surface(s, n, medium, limits)
            _tap(s, n, U(0), ZERO, F(2 / 3), ONE, medium, limits)
            _water_color(s, n, medium)
            _refract(s, n, medium, limits)
            if bends:
                _search_bed(s, n, index, bed_alpha, bed_depth, bed, medium, limits)
            else:
                for k in range(n):
                    s[FOUND + k] = ZERO
            _fetch_bed(s, n, own, bed_rgb, bed_alpha, bed, limits)
            _absorb(s, n, BR, WR, medium.extinction[0])
            _absorb(s, n, BG, WG, medium.extinction[1])
            _absorb(s, n, BB, WB, medium.extinction[2])
            for k in range(n):
                s[SUM_R + k], s[SUM_G + k], s[SUM_B + k] = s[BR + k], s[BG + k], s[BB + k]
            if bends:
                count = U(1)
                if rough:
                    count = U(3)
                    _tap(s, n, N, ONE, F(1 / 6), ZERO, medium, limits)
                    _tap(s, n, N + N, -ONE, F(1 / 6), ZERO, medium, limits)
                if has_front:
                    for k in range(n):
                        d = s[FIRST + k]
                        s[FIRST + k] = d if d < F(np.inf) else NOTHING
                    _find_in_image(
                        s, n, index, count, front_alpha, front_depth, front, medium, limits
                    )
                    _set_levels(s, n, count, FRONT_LEVEL, FRONT_C, FRONT_R, front_sizes)
                if has_mirror:
                    _find_in_mirror(
                        s, n, index, count, mirror_alpha, mirror_depth, mirror, medium, limits
                    )
                    _set_levels(s, n, count, LEVEL, MIRROR_C, MIRROR_R, mirror_sizes)
                for tap in range(count):
                    t = tap * N
                    _fetch_sky(s, n, t, faces, size, medium)
                    if has_mirror:
                        _fetch_layer(
                            s, n, MIRROR_C + t, MIRROR_R + t, LEVEL, mirror_rgb, mirror_alpha,
                            mirror, mirror_mips, mirror_sizes,
                        )  # fmt: skip
                        _reflect(s, n, VALUE_R, VALUE_G, VALUE_B)
                    else:
                        _reflect(s, n, SKY_R, SKY_G, SKY_B)
                    if has_front:
                        _fetch_layer(
                            s, n, FRONT_C + t, FRONT_R + t, FRONT_LEVEL, front_rgb, front_alpha,
                            front, front_mips, front_sizes,
                        )  # fmt: skip
                        _cover_with_image(s, n, t)
                    _add_reflection(s, n, t)
            for k in range(n):
                at = pixels[k]
                out[i, at, 0], out[i, at, 1] = s[SUM_R + k], s[SUM_G + k]
                out[i, at, 2] = s[SUM_B + k]
