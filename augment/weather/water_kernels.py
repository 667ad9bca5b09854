"""Numba kernels for a water surface: what `water.shade_water` defines, a pixel at a time.

Everything is float32 but the rays' directions, whose sign decides where there is water and whose
small downward part the distance to it is divided by. Indices are unsigned, so that nothing wraps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from augment.render.cpu_jit import inner, kernel

F = np.float32
U = np.uint64
ZERO, HALF, ONE, TWO = F(0), F(0.5), F(1), F(2)
INFINITE = F(np.inf)


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
def _nearest(view, column, row):
    """Flat index of the nearest pixel, and its column and row."""
    c = _whole(_clamp(column, ZERO, view.columns - ONE))
    r = _whole(_clamp(row, ZERO, view.rows - ONE))
    return r * view.width + c, _real(c) + HALF, _real(r) + HALF


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
def _level(sizes, spacing):
    if not spacing > ONE:
        return ZERO
    return min(F(math.log2(spacing)), _real(sizes.shape[0] - 1))


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
def _bed_along(bed_rgb, bed_alpha, bed_depth, bed, px, py, tx, ty, depth, medium, limits):
    """(found, depth below the plane, colour, alpha) along a refracted ray.

    px, py: where it enters the water. tx, ty: its way per metre of depth.
    """
    for _ in range(limits.bed_steps):
        z = -medium.height - depth
        column, row = _project(bed, px + depth * tx, py + depth * ty, z, limits.least_depth)
        if not _is_inside(bed, column, row):
            return False, ZERO, ZERO, ZERO, ZERO, ZERO
        pixel, column, row = _nearest(bed, column, row)
        if bed_alpha[pixel] < limits.solid_alpha:
            return False, ZERO, ZERO, ZERO, ZERO, ZERO
        z = bed_depth[pixel] * _height_of_ray(bed, column, row)
        depth = max(-medium.height - z, ZERO)
    z = -medium.height - depth
    column, row = _project(bed, px + depth * tx, py + depth * ty, z, limits.least_depth)
    if not _is_inside(bed, column, row):
        return False, ZERO, ZERO, ZERO, ZERO, ZERO
    r, g, b, a = _bilinear(bed_rgb, bed_alpha, bed, column, row)
    return a >= limits.solid_alpha, depth, r, g, b, a


@inner()
def _absorbed(seen, water, extinction, length):
    if length <= ZERO:
        return seen
    a = math.exp(-extinction * length)
    return a * seen + (ONE - a) * water


@inner()
def _distance_at(alpha, depth, mirror, column, row, px, py, medium, limits):
    """From a point of the surface to what a pixel of the mirrored layer shows."""
    pixel, column, row = _nearest(mirror, column, row)
    if alpha[pixel] < limits.solid_alpha:
        return INFINITE
    x, y, z = _point(mirror, depth[pixel], column, row)
    x, y, z = x - px, y - py, z - medium.height
    return math.sqrt(x * x + y * y + z * z)


@inner()
def _end_in_mirror(mirror, px, py, rx, ry, rz, distance, medium, limits):
    """Coordinates of the end of a reflected ray in the mirrored layer, kept inside it."""
    x, y, z = rx, ry, rz
    if distance < INFINITE:
        x, y, z = px + distance * rx, py + distance * ry, medium.height + distance * rz
    column, row = _project(mirror, x, y, z, limits.least_depth)
    return _clamp_to(mirror, column, row)


@inner()
def _end_in_image(alpha, depth, front, px, py, rx, ry, rz, distance, medium, limits):
    """(weight, column, row) of the end of a reflected ray in the image, 0 where it is not seen."""
    x, y, z = rx, ry, rz
    far = not distance < INFINITE
    m = front.project
    gap = reach = solid = INFINITE
    for i in range(2):
        if not far:
            x, y, z = px + distance * rx, py + distance * ry, distance * rz - medium.height
        column, row = _project(front, x, y, z, limits.least_depth)
        pixel, c, r = _nearest(front, column, row)
        solid = ONE if alpha[pixel] >= limits.solid_alpha else ZERO
        if far:
            break
        reach = m[6] * x + m[7] * y + m[8] * z
        gap = INFINITE
        if solid > ZERO:
            gap = abs(depth[pixel] - reach)
            if i == 0:
                x, y, z = _point(front, depth[pixel], c, r)
                x, y, z = x - px, y - py, z + medium.height
                distance = math.sqrt(x * x + y * y + z * z)
    weight = ONE
    if far:
        weight = ONE - solid
    elif not gap < max(limits.match_share * reach, limits.match_m):
        weight = ZERO
    if not _is_inside(front, column, row):
        weight = ZERO
    width, height = front.columns, front.rows
    across = min(column, width - column) / width
    border = min(across, min(row, height - row) / height)
    fade = _clamp(border / limits.edge, ZERO, ONE)
    column, row = _clamp_to(front, column, row)
    return weight * fade * fade * (F(3) - TWO * fade), column, row


@inner()
def _spacing(taps, column, row):
    """Mean distance of the outer coordinates from the first."""
    total = ZERO
    for k in range(U(1), U(3)):
        x = taps[k, column] - taps[U(0), column]
        y = taps[k, row] - taps[U(0), row]
        total += math.sqrt(x * x + y * y)
    return HALF * total


# Columns of the scratch memory that holds a pixel's normals: the mirrored ray, its share of the
# pixel's light, and where it ends in the mirrored layer and in the image.
RX, RY, RZ, SHARE, MIRROR_C, MIRROR_R, FRONT_W, FRONT_C, FRONT_R = map(U, range(9))


@inner()
def _tap(out, k, weight, sx, sy, vx, vy, vz, medium, limits):
    """The mirrored ray of a surface of slopes sx, sy, and its share of the pixel's light.

    Returns the normal and its cosines in air and water too.
    """
    inverse = ONE / math.sqrt(sx * sx + sy * sy + ONE)
    nx, ny, nz = sx * inverse, sy * inverse, inverse
    cosine = nx * vx + ny * vy + nz * vz
    c = _clamp(cosine, limits.least_cosine, ONE)
    inside = _cosine_inside(c, medium)
    twice = TWO * cosine
    x, y = twice * nx - vx, twice * ny - vy
    z = max(twice * nz - vz, limits.least_cosine)
    inverse = ONE / math.sqrt(x * x + y * y + z * z)
    out[k, RX], out[k, RY], out[k, RZ] = x * inverse, y * inverse, z * inverse
    out[k, SHARE] = weight * _reflectance(c, inside, medium)
    return nx, ny, nz, c, inside


@kernel
def shade(
    u, v, axes, cover, normal_x, normal_y, variance, bed_view, bed_rgb, bed_alpha, bed_depth, offset, mirror_view, mirror_rgb, mirror_alpha, mirror_depth, mirror_mips, mirror_sizes, has_mirror, front_view, front_rgb, front_alpha, front_depth, front_mips, front_sizes,
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
        layered = medium.smog_above >= ZERO
        foggy = medium.smog_per_m > ZERO
        taps = np.zeros((3, 9), np.float32)
        bx, by, bz = v[i] * axes[0, 1], v[i] * axes[1, 1], v[i] * axes[2, 1]
        own_row = i + top
        row_inside = own_row >= 0 and own_row < np.int64(bed.height)
        for j in range(width):
            # The order of these sums is that of Camera.ray_directions: the sign has to agree.
            fall = (u[j] * axes[2, 0] + bz) + axes[2, 2]
            if not (fall < 0.0 and cover[i, j] <= limits.cover):
                out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = ZERO
                continue
            dx = F((u[j] * axes[0, 0] + bx) + axes[0, 2])
            dy = F((u[j] * axes[1, 0] + by) + axes[1, 2])
            dz = F(fall)
            along = F(min(np.float64(medium.height) / -fall, np.float64(limits.farthest)))
            px, py = along * dx, along * dy
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            inverse = ONE / length
            vx, vy, vz = -dx * inverse, -dy * inverse, -dz * inverse

            nx, ny = normal_x[i, j], normal_y[i, j]
            upright = ONE / math.sqrt(max(ONE - nx * nx - ny * ny, limits.steepest))
            sx, sy = nx * upright, ny * upright
            rough = variance[i, j] >= limits.smooth_variance
            weight = F(2 / 3) if rough else ONE
            nx, ny, nz, c, inside = _tap(taps, U(0), weight, sx, sy, vx, vy, vz, medium, limits)
            count = U(1)
            if rough and bends:
                count = U(3)
                flat = max(math.sqrt(vx * vx + vy * vy), F(1e-12))
                spread = math.sqrt(F(3) * variance[i, j]) / flat
                hx, hy = spread * vx, spread * vy
                weight = F(1 / 6)
                _tap(taps, U(1), weight, sx + hx, sy + hy, vx, vy, vz, medium, limits)
                _tap(taps, U(2), weight, sx - hx, sy - hy, vx, vy, vz, medium, limits)

            near = medium.smog_per_m * along * length
            wr, wg, wb = medium.rgb[0], medium.rgb[1], medium.rgb[2]
            if foggy:
                t = math.exp(-near)
                wr = t * wr + (ONE - t) * medium.airlight[0]
                wg = t * wg + (ONE - t) * medium.airlight[1]
                wb = t * wb + (ONE - t) * medium.airlight[2]

            red, green, blue = wr, wg, wb
            own_column = j + left
            if row_inside and own_column >= 0 and own_column < np.int64(bed.width):
                pixel = U(own_row) * bed.width + U(own_column)
                alpha = bed_alpha[pixel]
                if alpha >= limits.solid_alpha:
                    depth = max(-bed_depth[pixel] * dz - medium.height, ZERO)
                    tx, ty, tz = -vx, -vy, vz
                    found = False
                    if bends:
                        ratio = ONE / medium.index
                        bend = c * ratio - inside
                        tx, ty = bend * nx - vx * ratio, bend * ny - vy * ratio
                        tz = max(vz * ratio - bend * nz, limits.least_cosine)
                        inverse = ONE / math.sqrt(tx * tx + ty * ty + tz * tz)
                        tx, ty, tz = tx * inverse, ty * inverse, tz * inverse
                    steep = ONE / tz
                    if bends:
                        found, deep, r, g, b, a = _bed_along(
                            bed_rgb,
                            bed_alpha,
                            bed_depth,
                            bed,
                            px,
                            py,
                            tx * steep,
                            ty * steep,
                            depth,
                            medium,
                            limits,
                        )
                    if found:
                        depth = deep
                    else:
                        r, g, b = (
                            bed_rgb[U(3) * pixel],
                            bed_rgb[U(3) * pixel + U(1)],
                            bed_rgb[U(3) * pixel + U(2)],
                        )
                        a = alpha
                    way = depth * steep
                    red = _absorbed(r + (ONE - a) * wr, wr, medium.extinction[0], way)
                    green = _absorbed(g + (ONE - a) * wg, wg, medium.extinction[1], way)
                    blue = _absorbed(b + (ONE - a) * wb, wb, medium.extinction[2], way)
            if not bends:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = red, green, blue
                continue

            mirror_level = front_level = ZERO
            if has_mirror:
                column, row = _project(mirror, dx, dy, -dz, limits.least_depth)
                column, row = _clamp_to(mirror, column, row)
                first = _distance_at(
                    mirror_alpha, mirror_depth, mirror, column, row, px, py, medium, limits
                )
                for k in range(count):
                    rx, ry, rz = taps[k, RX], taps[k, RY], taps[k, RZ]
                    column, row = _end_in_mirror(mirror, px, py, rx, ry, rz, first, medium, limits)
                    distance = _distance_at(
                        mirror_alpha, mirror_depth, mirror, column, row, px, py, medium, limits
                    )
                    column, row = _end_in_mirror(
                        mirror, px, py, rx, ry, rz, distance, medium, limits
                    )
                    taps[k, MIRROR_C], taps[k, MIRROR_R] = column, row
                if count > U(1):
                    mirror_level = _level(mirror_sizes, _spacing(taps, MIRROR_C, MIRROR_R))
            if has_front:
                for k in range(count):
                    rx, ry, rz = taps[k, RX], taps[k, RY], taps[k, RZ]
                    fade, column, row = _end_in_image(
                        front_alpha,
                        front_depth,
                        front,
                        px,
                        py,
                        rx,
                        ry,
                        rz,
                        front_distance[i, j],
                        medium,
                        limits,
                    )
                    taps[k, FRONT_W] = fade * front_weight[i, j]
                    taps[k, FRONT_C], taps[k, FRONT_R] = column, row
                if count > U(1):
                    front_level = _level(front_sizes, _spacing(taps, FRONT_C, FRONT_R))

            below_r, below_g, below_b = red, green, blue
            for k in range(count):
                rx, ry, rz = taps[k, RX], taps[k, RY], taps[k, RZ]
                sr, sg, sb = _sky(faces, size, rx, ry, rz)
                if layered:
                    t = math.exp(-(near + medium.smog_above / rz))
                    sr = t * sr + (ONE - t) * medium.airlight[0]
                    sg = t * sg + (ONE - t) * medium.airlight[1]
                    sb = t * sb + (ONE - t) * medium.airlight[2]
                r, g, b = sr, sg, sb
                if has_mirror:
                    r, g, b, a = _fetch(
                        mirror_rgb,
                        mirror_alpha,
                        mirror,
                        mirror_mips,
                        mirror_sizes,
                        taps[k, MIRROR_C],
                        taps[k, MIRROR_R],
                        mirror_level,
                    )
                    r, g, b = r + (ONE - a) * sr, g + (ONE - a) * sg, b + (ONE - a) * sb
                if has_front and taps[k, FRONT_W] > ZERO:
                    fr, fg, fb, a = _fetch(
                        front_rgb,
                        front_alpha,
                        front,
                        front_mips,
                        front_sizes,
                        taps[k, FRONT_C],
                        taps[k, FRONT_R],
                        front_level,
                    )
                    w = taps[k, FRONT_W]
                    r += w * (fr + (ONE - a) * sr - r)
                    g += w * (fg + (ONE - a) * sg - g)
                    b += w * (fb + (ONE - a) * sb - b)
                share = taps[k, SHARE]
                red += share * (r - below_r)
                green += share * (g - below_g)
                blue += share * (b - below_b)
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = red, green, blue


@kernel
def halve_image(rgb, alpha, out):
    """Averages over 2 x 2 pixels of rgb [H, W, 3] and alpha [H, W] into out [h, w, 4]."""
    height, width = alpha.shape
    quarter = F(0.25)
    for i in numba.prange(out.shape[0]):
        top, bottom = U(2 * i), U(min(2 * i + 1, height - 1))
        for j in range(U(out.shape[1])):
            c0 = U(2) * j
            c1 = min(c0 + U(1), U(width - 1))
            for c in range(U(3)):
                total = (rgb[top, c0, c] + rgb[bottom, c0, c]) + (
                    rgb[top, c1, c] + rgb[bottom, c1, c]
                )
                out[i, j, c] = quarter * total
            total = (alpha[top, c0] + alpha[bottom, c0]) + (alpha[top, c1] + alpha[bottom, c1])
            out[i, j, 3] = quarter * total


@kernel
def halve_mip(image, out):
    """Averages over 2 x 2 pixels of image [H, W, 4] into out [h, w, 4]."""
    height, width, _ = image.shape
    quarter = F(0.25)
    for i in numba.prange(out.shape[0]):
        top, bottom = U(2 * i), U(min(2 * i + 1, height - 1))
        for j in range(U(out.shape[1])):
            c0 = U(2) * j
            c1 = min(c0 + U(1), U(width - 1))
            for c in range(U(4)):
                total = (image[top, c0, c] + image[bottom, c0, c]) + (
                    image[top, c1, c] + image[bottom, c1, c]
                )
                out[i, j, c] = quarter * total
