"""Numba functions: where eight Gaussians stand in the camera, and which ellipses they become."""

from __future__ import annotations

import math

import numpy as np

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner
from augment.render.cpu.simd import scalar_fmuladd
from augment.render.layout import CUT, LANES, RECORD, STRIP, TILE_H, U

# ---- What a batch of splats asks for in a tile, row by row ---------------------------------------
# A tile is worked on in strips one register wide. The rows in which an ellipse meets a strip are an
# interval (both are convex); they become a flat list of (row, splat) items, which one loop without
# branches can blend.

BATCH = 32  # splats between two looks at what is still open
ITEMS = BATCH * TILE_H + TILE_H  # a batch's items at most, and room for the surplus


@inner()
def stage(records, tile_splat_ids, at, count, corner, staged):
    """Records of a batch, turned to one row a field, relative to the tile's corner."""
    n, (left, top) = U(BATCH), corner
    for k in range(count):
        record = U(tile_splat_ids[at + k]) * U(RECORD)
        for field in range(U(RECORD)):
            staged[field * n + k] = records[record + field]
        staged[U(L.MEAN_X) * n + k] -= left
        staged[U(L.MEAN_Y) * n + k] -= top


@inner()
def find_spans(staged, count, strip, rows, log_cut, spans):
    """Rows in which each ellipse meets the strip: first, and one past the last.

    An ellipse is highest where its ridge says (L.LEAN_X L.RADIUS_Y from its mean), or, where that
    column lies outside the strip, in the strip's nearest column.
    """
    zero, half = np.float32(0), np.float32(0.5)
    n = U(BATCH)
    west = np.float32(strip * LANES) + half
    east = west + np.float32(LANES - 1)
    low, high = np.float32(rows[2 * strip]), np.float32(rows[2 * strip + 1])
    for k in range(count):
        mean_x, mean_y = staged[k], staged[n + k]
        budget = staged[U(L.LOG_OPACITY) * n + k] - log_cut
        top = staged[U(L.LEAN_X) * n + k] * staged[U(L.RADIUS_Y) * n + k]
        fall, lean = staged[U(L.FALL_X) * n + k], staged[U(L.LEAN_Y) * n + k]
        blunt = staged[U(L.BLUNT_Y) * n + k]
        d = min(max(top, west - mean_x), east - mean_x)
        left_over = scalar_fmuladd(-fall * d, d, budget)
        reach = math.sqrt(max(left_over, zero)) * blunt
        end = scalar_fmuladd(lean, d, mean_y) + reach + half
        end = end if left_over >= zero else zero
        d = min(max(-top, west - mean_x), east - mean_x)
        left_over = scalar_fmuladd(-fall * d, d, budget)
        reach = math.sqrt(max(left_over, zero)) * blunt
        begin = min(max(scalar_fmuladd(lean, d, mean_y) - reach + half, low), high)
        spans[k] = np.int32(begin)
        spans[n + k] = np.int32(max(min(end, high), begin))


@inner()
def list_items(staged, count, strip, spans, values, places):
    """One item for every (row, splat), in the order of the splats; returns how many.

    An item says where its row of pixels stands in the state, which splat it is, the log2 of alpha
    on the splat's ridge in that row, and how many (sharp) pixels the row's first one is off it.
    A tile's height is always written and the surplus overwritten, which needs no branch.
    """
    n, items = U(BATCH), U(0)
    half = np.float32(0.5)
    first_x = np.float32(strip * LANES) + half
    for k in range(count):
        row, end = spans[k], spans[n + k]
        sharp = staged[U(L.SHARP_X) * n + k]
        fall = v8.splat(-staged[U(L.FALL_Y) * n + k])
        peak = v8.splat(staged[U(L.LOG_OPACITY) * n + k])
        start = v8.splat(sharp * (first_x - staged[k]))
        step = v8.splat(-sharp * staged[U(L.LEAN_X) * n + k])
        y = np.float32(row) + half - staged[n + k]
        place = np.int32(strip * STRIP) + row * np.int32(LANES)
        for j in range(0, TILE_H, LANES):
            dy = v8.lane_numbers() + v8.splat(y + np.float32(j))
            at = items + U(j)
            v8.store(values, at, v8.fmuladd(fall * dy, dy, peak))
            v8.store(values, at + U(ITEMS), v8.fmuladd(step, dy, start))
            v8.store_ramp(places, at, np.int32(k), np.int32(0))
            v8.store_ramp(places, at + U(ITEMS), np.int32(place + j * LANES), np.int32(LANES))
        items += U(end - row)
    return items


@inner()
def gather3(array, picked, at):
    """Rows of a [N, 3] array."""
    first = v8.gather(array, picked, at, U(3), U(0))
    second = v8.gather(array, picked, at, U(3), U(1))
    return first, second, v8.gather(array, picked, at, U(3), U(2))


@inner()
def from_eye(means, picked, at, view):
    """Means minus the camera's centre, in the part's axes: first, so that digits are kept."""
    x, y, z = gather3(means, picked, at)
    x = x - v8.splat(view[L.V_EYE]) - v8.splat(view[L.V_EYE + 3])
    y = y - v8.splat(view[L.V_EYE + 1]) - v8.splat(view[L.V_EYE + 4])
    z = z - v8.splat(view[L.V_EYE + 2]) - v8.splat(view[L.V_EYE + 5])
    return x, y, z


@inner()
def dot(ax, ay, az, bx, by, bz):
    return v8.fmuladd(ax, bx, v8.fmuladd(ay, by, az * bz))


@inner()
def cross(a, b, scale):
    """The cross product of two triples, times a number."""
    return (
        (a[1] * b[2] - a[2] * b[1]) * scale,
        (a[2] * b[0] - a[0] * b[2]) * scale,
        (a[0] * b[1] - a[1] * b[0]) * scale,
    )


@inner()
def rotation_row(view, row):
    at = U(L.V_ROTATION) + U(3) * row
    return v8.splat(view[at]), v8.splat(view[at + U(1)]), v8.splat(view[at + U(2)])


@inner()
def to_camera(d, view):
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    x = dot(r[0], r[1], r[2], d[0], d[1], d[2])
    y = dot(s[0], s[1], s[2], d[0], d[1], d[2])
    return x, y, dot(t[0], t[1], t[2], d[0], d[1], d[2])


@inner()
def inverse_divisor(z, view):
    """1 over what x and y are divided by in the projection: z, or 1 where rays are parallel."""
    one = np.float32(1)
    parallel = view[L.V_PARALLEL]
    return v8.splat(one) / v8.fmuladd(v8.splat(one - parallel), z, v8.splat(parallel))


@inner()
def to_image(x, y, inverse, view):
    x = v8.fmuladd(v8.splat(view[L.V_FOCAL]) * x, inverse, v8.splat(view[L.V_CENTRE]))
    return x, v8.fmuladd(v8.splat(view[L.V_FOCAL + 1]) * y, inverse, v8.splat(view[L.V_CENTRE + 1]))


@inner()
def semi_axes(quats, scales, picked, at, x, y, inverse, view):
    """Ellipsoids' axes in the image, px right (3) and down (3), and what they were made of: the
    scales (3), the Jacobian's rows times the view's rotation (3 and 3), the rotations (9).
    """
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    u = v8.minimum(v8.maximum(x * inverse, v8.splat(view[L.V_LOW])), v8.splat(view[L.V_HIGH]))
    v = v8.minimum(
        v8.maximum(y * inverse, v8.splat(view[L.V_LOW + 1])), v8.splat(view[L.V_HIGH + 1])
    )
    fx, fy = v8.splat(view[L.V_FOCAL]) * inverse, v8.splat(view[L.V_FOCAL + 1]) * inverse
    jx = fx * (r[0] - u * t[0]), fx * (r[1] - u * t[1]), fx * (r[2] - u * t[2])
    jy = fy * (s[0] - v * t[0]), fy * (s[1] - v * t[1]), fy * (s[2] - v * t[2])
    m = rotation_from_quats(quats, picked, at)
    sizes = gather3(scales, picked, at)
    right = (
        sizes[0] * dot(jx[0], jx[1], jx[2], m[0], m[3], m[6]),
        sizes[1] * dot(jx[0], jx[1], jx[2], m[1], m[4], m[7]),
        sizes[2] * dot(jx[0], jx[1], jx[2], m[2], m[5], m[8]),
    )
    down = (
        sizes[0] * dot(jy[0], jy[1], jy[2], m[0], m[3], m[6]),
        sizes[1] * dot(jy[0], jy[1], jy[2], m[1], m[4], m[7]),
        sizes[2] * dot(jy[0], jy[1], jy[2], m[2], m[5], m[8]),
    )
    return right, down, sizes, jx, jy, m


@inner()
def image_covariance(quats, scales, picked, at, x, y, inverse, view):
    """xx, xy, yy in px^2, not blurred, and det / (yy + blur), of which no digits cancel."""
    right, down, _, _, _, _ = semi_axes(quats, scales, picked, at, x, y, inverse, view)
    x0, x1, x2 = right
    y0, y1, y2 = down
    xx, xy, yy = (
        dot(x0, x1, x2, x0, x1, x2),
        dot(x0, x1, x2, y0, y1, y2),
        dot(y0, y1, y2, y0, y1, y2),
    )
    # Lagrange's identity, det = |x cross y|^2, each term divided before it is squared.
    scale = v8.splat(np.float32(1)) / v8.sqrt(yy + v8.splat(view[L.V_BLUR]))
    c0, c1, c2 = cross(right, down, scale)
    return xx, xy, yy, dot(c0, c1, c2, c0, c1, c2)


@inner()
def rotation_from_quats(quats, picked, at):
    """Rotation matrices, row by row, of unit quaternions wxyz."""
    one, two = v8.splat(np.float32(1)), v8.splat(np.float32(2))
    w, x = v8.gather(quats, picked, at, U(4), U(0)), v8.gather(quats, picked, at, U(4), U(1))
    y, z = v8.gather(quats, picked, at, U(4), U(2)), v8.gather(quats, picked, at, U(4), U(3))
    return (
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )


# ---- Splats cut at a height (see augment.render.layout) ------------------------------------------

SHARE, SURFACE = 0, 3 * BATCH  # where a batch's lines of each kind begin: value, slope in x and y
REACHES = 6 * BATCH
LINES = 7 * BATCH
_FAR = np.float32(1e6)  # augment.render.layout.FAR_PX
_TINY = np.float32(1e-20)
_SHARP = np.float32(0.003)  # augment.render.layout.SHARP_PX2


@inner()
def height_of(d, view):
    """How far the kept side of the plane means lie. d: from the eye, in the part's axes."""
    up = L.V_CLIP_PART
    rise = dot(v8.splat(view[up]), v8.splat(view[up + 1]), v8.splat(view[up + 2]), d[0], d[1], d[2])
    return rise + v8.splat(view[L.V_CLIP_EYE])


@inner()
def cut_eight(quats, scales, picked, at, d, x, y, inverse, view):
    """Of eight Gaussians: which have a part on the kept side, and their cuts' six numbers."""
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    right, down, sizes, _, _, m = semi_axes(quats, scales, picked, at, x, y, inverse, view)
    up0, up1, up2 = (
        v8.splat(view[L.V_CLIP_PART]),
        v8.splat(view[L.V_CLIP_PART + 1]),
        v8.splat(view[L.V_CLIP_PART + 2]),
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
    reach = v8.splat(view[L.V_EXTENT]) * sigma

    gx, gy = _depth_slope(right, down, (away0, away1, away2))

    fall = v8.splat(view[L.V_CLIP_FALL]) * inverse * inverse
    lx = v8.splat(view[L.V_CLIP_CAMERA] / view[L.V_FOCAL]) - fall * gx
    ly = v8.splat(view[L.V_CLIP_CAMERA + 1] / view[L.V_FOCAL + 1]) - fall * gy
    slope = v8.sqrt(v8.fmuladd(lx, lx, ly * ly))
    scale = one / v8.maximum(slope, v8.splat(_TINY))
    far = v8.splat(_FAR)
    offset = v8.maximum(v8.minimum(height * inverse * scale, far), v8.negate(far))
    whole = v8.at_least(height, reach)
    offset = v8.select(whole, far, offset)
    lx = v8.select(whole, zero, lx * scale)
    ly = v8.select(whole, zero, ly * scale)
    deep = v8.sqrt(dot(away0, away1, away2, away0, away1, away2)) * inverse
    deep = v8.minimum(v8.splat(view[L.V_EXTENT]) * deep, v8.splat(view[L.V_CLIP_LONGEST]))
    partly = v8.both(
        v8.at_least(height + reach, zero),
        v8.at_least(v8.splat(view[L.V_CLIP_REACH]), height - reach),
    )
    return partly, offset + v8.splat(view[L.V_CLIP_EDGE]), lx, ly, gx * inverse, gy * inverse, deep


@inner()
def _depth_slope(x, y, z):
    """g = S2^-1 c of semi-axes right, down and away (see augment.render.layout), per px.

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
        by_blur, dot(x[0], x[1], x[2], z[0], z[1], z[2]), dot(c0, c1, c2, right0, right1, right2)
    )
    gy = v8.fmuladd(
        by_blur, dot(y[0], y[1], y[2], z[0], z[1], z[2]), dot(c0, c1, c2, down0, down1, down2)
    )
    return gx / det, gy / det


@inner()
def stage_cuts(cuts, tile_splat_ids, at, count, staged, has_surfaces, lines):
    """Cuts of a batch, turned to one row a number, about the tile's corner. staged: list_items'.

    has_surfaces: whether the lines of the surfaces are wanted. Returns whether any splat is cut:
    the others lie wholly on the kept side.
    """
    n, any_cut = U(BATCH), False
    for k in range(count):
        cut = U(tile_splat_ids[at + k]) * U(CUT)
        x, y = staged[U(L.MEAN_X) * n + k], staged[U(L.MEAN_Y) * n + k]
        lx, ly = cuts[cut + U(L.C_X)], cuts[cut + U(L.C_Y)]
        lines[k] = cuts[cut + U(L.C_AT)] - lx * x - ly * y
        lines[n + k] = lx
        lines[U(2) * n + k] = ly
        any_cut = any_cut or lx != np.float32(0) or ly != np.float32(0)
        if has_surfaces:
            gx, gy = cuts[cut + U(L.C_RIGHT)], cuts[cut + U(L.C_DOWN)]
            lines[U(3) * n + k] = -gx * x - gy * y
            lines[U(4) * n + k] = gx
            lines[U(5) * n + k] = gy
            lines[U(6) * n + k] = cuts[cut + U(L.C_REACH)]
    return any_cut


@inner()
def list_lines(lines, kind, count, strip, spans, values):
    """A line's value at the first pixel of every item of list_items, in its order."""
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


# ---- Light by the normal of every pixel of a splat (see augment.render.shading) ------------------
# A splat's lights are SHADING_LINES float32, as there; all 0 for a splat of one colour.

SHADING_LINES = 9
L_FACING, L_X, L_Y, L_WRAP, L_LEAN_X, L_LEAN_Y, L_RED, L_GREEN, L_BLUE = range(SHADING_LINES)
LIT = (SHADING_LINES + 1) * BATCH  # of a batch: one row a line, then whether a splat has any
_MIN_FACING = np.float32(0.05)  # augment.render.shading.MIN_FACING


@inner()
def light_eight(m, towards, view):
    """Eight Gaussians' lines but for the slopes. m: rotations; towards: from the eye, camera."""
    r, s, t = rotation_row(view, U(0)), rotation_row(view, U(1)), rotation_row(view, U(2))
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    nx = dot(r[0], r[1], r[2], m[2], m[5], m[8])
    ny = dot(s[0], s[1], s[2], m[2], m[5], m[8])
    nz = dot(t[0], t[1], t[2], m[2], m[5], m[8])
    is_back = v8.greater(dot(nx, ny, nz, towards[0], towards[1], towards[2]), zero)
    nx = v8.select(is_back, v8.negate(nx), nx)
    ny = v8.select(is_back, v8.negate(ny), ny)
    nz = v8.select(is_back, v8.negate(nz), nz)
    sx, sy, sz = v8.splat(view[L.V_SUN]), v8.splat(view[L.V_SUN + 1]), v8.splat(view[L.V_SUN + 2])
    inverse = one / v8.maximum(v8.negate(nz), v8.splat(_MIN_FACING))
    ax, ay = nx * inverse, ny * inverse
    fx, fy = v8.splat(view[L.V_FOCAL]), v8.splat(view[L.V_FOCAL + 1])
    scale = one / (one + v8.splat(view[L.V_WRAP]))
    return (
        dot(nx, ny, nz, sx, sy, sz) * scale,
        v8.fmuladd(sz, ax, sx) / fx * scale,
        v8.fmuladd(sz, ay, sy) / fy * scale,
        v8.splat(view[L.V_WRAP]) * scale,
        ax / fx,
        ay / fy,
    )


@inner()
def stage_lights(lights, tile_splat_ids, at, count, lit):
    """Lines of a batch, turned to one row a number."""
    n = U(BATCH)
    for k in range(count):
        first, most = U(tile_splat_ids[at + k]) * U(SHADING_LINES), np.float32(0)
        for line in range(U(SHADING_LINES)):
            lit[line * n + k] = lights[first + line]
        for line in range(U(L_RED), U(SHADING_LINES)):
            most = max(most, abs(lights[first + line]))
        lit[U(SHADING_LINES) * n + k] = most


@inner()
def is_lit(lit, splat):
    return lit[U(SHADING_LINES * BATCH) + splat] > np.float32(0)


@inner()
def light_share(lit, staged, values, splat, item, at, limits):
    """The share of the light at eight pixels of a splat.

    staged, values: list_items', of the item. at: its place in the tile's state. limits: of
    blend; the second is log2(ALPHA_MIN), the last two 1/fx^2 and 1/fy^2.
    """
    n, zero, one = U(BATCH), v8.splat(np.float32(0)), v8.splat(np.float32(1))
    half = np.float32(0.5)
    left = np.float32(at // U(STRIP) * U(LANES)) + half - staged[U(L.MEAN_X) * n + splat]
    down = np.float32(at % U(STRIP) // U(LANES)) + half - staged[U(L.MEAN_Y) * n + splat]
    x, y = v8.lane_numbers() + v8.splat(left), v8.splat(down)
    # Squared distance from the mean, of that at which alpha is cut off: from the log of alpha.
    peak = staged[U(L.LOG_OPACITY) * n + splat]
    off = v8.splat(staged[U(L.SHARP_X) * n + splat])
    off = v8.fmuladd(off, v8.lane_numbers(), v8.splat(values[item + U(ITEMS)]))
    e = v8.fmuladd(v8.negate(off), off, v8.splat(values[item]))
    rim = (v8.splat(peak) - e) / v8.splat(max(peak - limits[1], _TINY))
    rim = v8.maximum(v8.minimum(rim, one), zero)
    lean = v8.splat(lit[U(L_LEAN_X) * n + splat]) * x + v8.splat(lit[U(L_LEAN_Y) * n + splat]) * y
    away = v8.fmuladd(lean, lean, v8.splat(limits[6]) * y * y + v8.splat(_TINY))
    away = v8.fmuladd(v8.splat(limits[5]) * x, x, away)
    tilt = v8.splat(lit[U(L_X) * n + splat]) * x + v8.splat(lit[U(L_Y) * n + splat]) * y
    share = v8.fmuladd(v8.sqrt(rim / away), tilt, v8.splat(lit[U(L_WRAP) * n + splat]))
    share = v8.fmuladd(v8.sqrt(one - rim), v8.splat(lit[U(L_FACING) * n + splat]), share)
    return v8.maximum(v8.minimum(share, one), zero)
