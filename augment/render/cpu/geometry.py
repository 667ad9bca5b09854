"""Numba functions: where eight Gaussians stand in the camera, and which ellipses they become."""

from __future__ import annotations

import numpy as np

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner
from augment.render.cpu.simd import WIDE
from augment.render.layout import CUT, LANES, TILE_H, U

# ---- What a batch of splats asks for in a tile, row by row ---------------------------------------
# A tile is worked on in strips eight pixels wide. The rows in which an ellipse meets a strip are an
# interval (both are convex); they become a flat list of (rows, splat) items, which one loop without
# branches can blend. An item is as many rows as a register holds: one, or two that begin at an even
# row, whose pixels then lie in turn (simd.wide_columns). What an item's rows hold does not depend
# on how many they are.

BATCH = 32  # splats between two looks at what is still open
ITEMS = BATCH * TILE_H + TILE_H  # a batch's rows at most, and room for the surplus
STARTS = 3 * BATCH

PLACES = 256  # an item is its splat times this, plus its rows' place in the state, in registers

_NEVER = -1e30  # log2 of an alpha that is not drawn


def _row_tables() -> tuple[np.ndarray, ...]:
    """For lists whose first row is even, and odd: how far their rows lie from the start of their
    half, where their half starts, and, by how many they are, what keeps the others undrawn.
    """
    rows = np.arange(TILE_H) - np.arange(2)[:, None]  # [2, H] from the first
    halves = np.where(rows >= LANES, LANES, 0)
    counts = np.arange(TILE_H + 1)[:, None]
    drawn = (rows[:, None] >= 0) & (rows[:, None] < counts)  # [2, H + 1, H]
    tables = rows - halves, halves, np.where(drawn, 0, _NEVER)
    return tuple(table.astype(np.float32).reshape(-1) for table in tables)


_STEPS, _HALVES, _UNDRAWN = _row_tables()


@inner()
def stage(records, tile_splat_ids, at, count, corner, staged):
    """Records of a batch, turned to one row a field, relative to the tile's corner.

    count must be > 0. What stands beyond it is of no splat of the batch.
    """
    n, wide = U(BATCH), v8.wide_columns()
    left, top = v8.splat_as(wide, corner[0]), v8.splat_as(wide, corner[1])
    for k in range(U(0), count, U(WIDE)):
        v8.turn(wide, records, tile_splat_ids, at + k, at + count - U(1), staged, k)
        v8.store(staged, U(L.MEAN_X) * n + k, v8.load_as(wide, staged, U(L.MEAN_X) * n + k) - left)
        v8.store(staged, U(L.MEAN_Y) * n + k, v8.load_as(wide, staged, U(L.MEAN_Y) * n + k) - top)


@inner()
def find_spans(staged, count, strip, rows, log_cut, spans, starts):
    """Rows in which each ellipse meets the strip: first, and one past the last. Returns the bits of
    the splats that have any.

    An ellipse is highest where its ridge says (L.LEAN_X L.RADIUS_Y from its mean), or, where that
    column lies outside the strip, in the strip's nearest column. starts: what list_items begins
    with, of each splat: how far its first row lies below its mean, how many (sharp) pixels the
    first column is off the mean, and by how many each row is farther off the ridge.
    """
    n, wide, found = U(BATCH), v8.wide_columns(), U(0)
    zero, half = v8.splat_as(wide, np.float32(0)), v8.splat_as(wide, np.float32(0.5))
    first_x = np.float32(strip * LANES) + np.float32(0.5)
    west = v8.splat_as(wide, first_x)
    east = v8.splat_as(wide, first_x + np.float32(LANES - 1))
    low = v8.splat_as(wide, np.float32(rows[2 * strip]))
    high = v8.splat_as(wide, np.float32(rows[2 * strip + 1]))
    cut = v8.splat_as(wide, log_cut)
    for k in range(U(0), count, U(WIDE)):
        mean_x = v8.load_as(wide, staged, U(L.MEAN_X) * n + k)
        mean_y = v8.load_as(wide, staged, U(L.MEAN_Y) * n + k)
        lean_x = v8.load_as(wide, staged, U(L.LEAN_X) * n + k)
        sharp = v8.load_as(wide, staged, U(L.SHARP_X) * n + k)
        budget = v8.load_as(wide, staged, U(L.LOG_OPACITY) * n + k) - cut
        top = lean_x * v8.load_as(wide, staged, U(L.RADIUS_Y) * n + k)
        fall = v8.negate(v8.load_as(wide, staged, U(L.FALL_X) * n + k))
        lean = v8.load_as(wide, staged, U(L.LEAN_Y) * n + k)
        blunt = v8.load_as(wide, staged, U(L.BLUNT_Y) * n + k)
        leftmost, rightmost = west - mean_x, east - mean_x
        d = v8.minimum(v8.maximum(top, leftmost), rightmost)
        left_over = v8.fmuladd(fall * d, d, budget)
        reach = v8.sqrt(v8.maximum(left_over, zero)) * blunt
        end = v8.fmuladd(lean, d, mean_y) + reach + half
        end = v8.select(v8.at_least(left_over, zero), end, zero)
        d = v8.minimum(v8.maximum(v8.negate(top), leftmost), rightmost)
        left_over = v8.fmuladd(fall * d, d, budget)
        reach = v8.sqrt(v8.maximum(left_over, zero)) * blunt
        begin = v8.fmuladd(lean, d, mean_y) - reach + half
        begin = v8.floor(v8.minimum(v8.maximum(begin, low), high))
        end = v8.floor(v8.minimum(end, high))
        v8.store_whole(spans, k, begin)
        v8.store_whole(spans, n + k, v8.maximum(end, begin))
        v8.store(starts, k, begin + half - mean_y)
        v8.store(starts, n + k, sharp * (west - mean_x))
        v8.store(starts, U(2) * n + k, v8.negate(sharp) * lean_x)
        found |= v8.mask_bits(v8.greater(end, begin)) << k
    return found & ((U(1) << count) - U(1))


@inner()
def list_items(staged, found, strip, spans, starts, columns, values, places):
    """One item for every (rows, splat), in the order of the splats; returns how many.

    columns: of an item's pixels. An item is its place and splat (see PLACES); for each row there
    are the log2 of alpha on the splat's ridge, and how many (sharp) pixels the row's first one is
    off it. All rows of a tile are always written and the surplus overwritten: that takes no branch.
    """
    n, items, each = U(BATCH), U(0), v8.rows_in(columns)
    while found != U(0):
        k = v8.lowest_bit(found)
        found &= found - U(1)
        row, end = U(spans[k]), U(spans[n + k])
        odd = row & (each - U(1))
        fall = v8.splat_as(columns, -staged[U(L.FALL_Y) * n + k])
        peak = v8.splat_as(columns, staged[U(L.LOG_OPACITY) * n + k])
        y, start = v8.splat_as(columns, starts[k]), v8.splat_as(columns, starts[n + k])
        step = v8.splat_as(columns, starts[U(2) * n + k])
        first = k * U(PLACES) + (strip * U(TILE_H) + row) // each
        for j in range(U(0), U(TILE_H), U(LANES) * each):
            table = odd * U(TILE_H) + j
            down, half = v8.load_as(columns, _STEPS, table), v8.load_as(columns, _HALVES, table)
            dy = down + (y + half)
            rest = v8.fmuladd(fall * dy, dy, peak)
            if each > U(1):
                drawn = (odd * U(TILE_H + 1) + end - row) * U(TILE_H)
                rest = rest + v8.load_as(columns, _UNDRAWN, drawn)
            at = items * each + j
            v8.store(values, at, rest)
            v8.store(values, at + U(ITEMS), v8.fmuladd(step, dy, start))
            v8.store_ramp(places, items + j // each, np.int32(first + j // each))
        items += (end - row + odd + each - U(1)) // each
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
def list_lines(lines, kind, found, spans, strip, columns, values):
    """A line's value at the first pixel of every item's rows, in the order of list_items."""
    n, items, each = U(BATCH), U(0), v8.rows_in(columns)
    half = np.float32(0.5)
    first_x = np.float32(strip * U(LANES)) + half
    while found != U(0):
        k = v8.lowest_bit(found)
        found &= found - U(1)
        row, end = U(spans[k]), U(spans[n + k])
        odd = row & (each - U(1))
        slope = lines[U(kind) + U(2) * n + k]
        start = lines[U(kind) + k] + lines[U(kind) + n + k] * first_x
        start = start + slope * (np.float32(row) + half)
        slopes = v8.splat_as(columns, slope)
        for j in range(U(0), U(TILE_H), U(LANES) * each):
            table = odd * U(TILE_H) + j
            first = v8.splat_as(columns, start) + slopes * v8.load_as(columns, _HALVES, table)
            down = v8.load_as(columns, _STEPS, table)
            v8.store(values, items * each + j, v8.fmuladd(slopes, down, first))
        items += (end - row + odd + each - U(1)) // each


@inner()
def line_at(lines, kind, values, splat, item, columns):
    """A line's values at the pixels of an item."""
    slope = v8.splat_as(columns, lines[U(kind) + U(BATCH) + splat])
    return v8.fmuladd(slope, columns, v8.by_row(columns, values, item))


@inner()
def surface_depth(lines, values, splat, item, columns, depth, parallel):
    """Depths of a splat's surface at an item's pixels. parallel: 1 where rays are, else 0."""
    one = np.float32(1)
    reach = v8.splat_as(columns, lines[U(REACHES) + splat])
    farther = v8.minimum(line_at(lines, SURFACE, values, splat, item, columns), reach)
    farther = v8.maximum(farther, v8.negate(reach))
    depths = v8.fmuladd(v8.splat_as(columns, parallel), farther, v8.splat_as(columns, depth))
    return depths / (v8.splat_as(columns, one) - v8.splat_as(columns, one - parallel) * farther)


@inner()
def kept_share(lines, values, splat, item, columns):
    value = line_at(lines, SHARE, values, splat, item, columns)
    zero, one = v8.splat_as(columns, np.float32(0)), v8.splat_as(columns, np.float32(1))
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
def light_share(lit, staged, splat, e, place, columns, limits):
    """The share of the light at an item's pixels.

    e: log2 of the splat's alpha there. place: of the item (see PLACES). limits: of blend; the
    second is log2(ALPHA_MIN), the last two 1/fx^2 and 1/fy^2.
    """
    n, zero = U(BATCH), v8.splat_as(columns, np.float32(0))
    one, half = v8.splat_as(columns, np.float32(1)), np.float32(0.5)
    row = place * v8.rows_in(columns)
    left = np.float32(row // U(TILE_H) * U(LANES)) + half - staged[U(L.MEAN_X) * n + splat]
    down = v8.splat_as(columns, np.float32(row % U(TILE_H)) + half) + v8.row_numbers(columns)
    x = columns + v8.splat_as(columns, left)
    y = down - v8.splat_as(columns, staged[U(L.MEAN_Y) * n + splat])
    # Squared distance from the mean, of that at which alpha is cut off: from the log of alpha.
    peak = staged[U(L.LOG_OPACITY) * n + splat]
    span = v8.splat_as(columns, max(peak - limits[1], _TINY))
    rim = (v8.splat_as(columns, peak) - e) / span
    rim = v8.maximum(v8.minimum(rim, one), zero)
    lean_x = v8.splat_as(columns, lit[U(L_LEAN_X) * n + splat])
    lean = lean_x * x + v8.splat_as(columns, lit[U(L_LEAN_Y) * n + splat]) * y
    away = v8.splat_as(columns, limits[6]) * y * y + v8.splat_as(columns, _TINY)
    away = v8.fmuladd(lean, lean, away)
    away = v8.fmuladd(v8.splat_as(columns, limits[5]) * x, x, away)
    tilt_x = v8.splat_as(columns, lit[U(L_X) * n + splat])
    tilt = tilt_x * x + v8.splat_as(columns, lit[U(L_Y) * n + splat]) * y
    wrap = v8.splat_as(columns, lit[U(L_WRAP) * n + splat])
    share = v8.fmuladd(v8.sqrt(rim / away), tilt, wrap)
    facing = v8.splat_as(columns, lit[U(L_FACING) * n + splat])
    share = v8.fmuladd(v8.sqrt(one - rim), facing, share)
    return v8.maximum(v8.minimum(share, one), zero)
