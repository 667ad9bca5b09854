"""Numba functions of the CPU kernels: rows of splats in a tile, and Gaussians as ellipses in an
image.

`project`, `blend` and `backward_kernels` call them. Gaussians are processed eight at a time.
"""

from __future__ import annotations

import numpy as np

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner
from augment.render.cpu.simd import WIDE
from augment.render.layout import CUT, LANES, TILE_H, U

# ---- Rows of a tile that a batch of splats covers ------------------------------------------------
# A tile is blended in strips eight pixels wide. The rows in which an ellipse meets a strip are an
# interval (both are convex). They become a flat list of (rows, splat) items, which one loop without
# branches can blend. An item has as many rows as a register holds: one, or two that begin at an
# even row; the pixels of two rows alternate (simd.wide_columns). The numbers of an item's rows do
# not depend on how many they are.

# Splats that are blended before the tile's open rows are determined again.
BATCH = 32
# Largest number of a batch's rows, and room for the surplus.
ITEMS = BATCH * TILE_H + TILE_H
# Numbers of a batch that find_spans writes for list_items.
STARTS = 3 * BATCH

# Factor of a splat's number in an item. The item is this product plus the place of its rows in the
# tile's state, counted in registers.
PLACES = 256

# log2 of an alpha that is not drawn.
_NEVER = -1e30


def _row_tables() -> tuple[np.ndarray, ...]:
    """Return tables for lists whose first row is even, and for those whose first row is odd.

    The tables say how far each row lies from the start of its half, where its half starts, and, by
    the number of rows, which rows are not drawn.
    """
    rows = np.arange(TILE_H) - np.arange(2)[:, None]  # [2, H] from the first
    halves = np.where(rows >= LANES, LANES, 0)
    counts = np.arange(TILE_H + 1)[:, None]
    is_drawn = (rows[:, None] >= 0) & (rows[:, None] < counts)  # [2, H + 1, H]
    tables = rows - halves, halves, np.where(is_drawn, 0, _NEVER)
    return tuple(table.astype(np.float32).reshape(-1) for table in tables)


_STEPS, _HALVES, _UNDRAWN = _row_tables()


@inner()
def stage(records, tile_splat_ids, at, count, corner, staged):
    """Write the records of a batch, transposed to one row per field, relative to the tile's corner.

    count must be > 0. Numbers beyond it belong to no splat of the batch.
    """
    stride = U(BATCH)
    wide = v8.wide_columns()
    left_edge = v8.splat_as(wide, corner[0])
    top_edge = v8.splat_as(wide, corner[1])
    for k in range(U(0), count, U(WIDE)):
        v8.transpose_rows(wide, records, tile_splat_ids, at + k, at + count - U(1), staged, k)
        v8.store(
            staged,
            U(L.MEAN_X) * stride + k,
            v8.load_as(wide, staged, U(L.MEAN_X) * stride + k) - left_edge,
        )
        v8.store(
            staged,
            U(L.MEAN_Y) * stride + k,
            v8.load_as(wide, staged, U(L.MEAN_Y) * stride + k) - top_edge,
        )


@inner()
def find_spans(staged, count, strip, rows, log_cut, spans, starts):
    """Find the rows in which each ellipse meets a strip: first, and one past the last.

    An ellipse is highest where its ridge says (L.LEAN_X L.RADIUS_Y from its mean), or, if that
    column lies outside the strip, in the strip's nearest column.

    Args:
        staged: records of a batch, as `stage` writes them.
        count: splats of the batch.
        strip: the strip.
        rows: first row, and one past the last, of each strip that is still open.
        log_cut: log2 of the alpha below which a splat is skipped.
        spans: written: first rows, then ends.
        starts: written for list_items, for each splat: how far its first row lies below its mean,
            how many (sharp) pixels the first column is off the mean, and by how many each row is
            farther off the ridge.

    Returns:
        A bit for each splat, 1 if it has any rows.
    """
    n = U(BATCH)
    wide = v8.wide_columns()
    span_bits = U(0)
    zeros = v8.splat_as(wide, np.float32(0))
    half = v8.splat_as(wide, np.float32(0.5))
    first_x = np.float32(strip * LANES) + np.float32(0.5)
    west = v8.splat_as(wide, first_x)
    east = v8.splat_as(wide, first_x + np.float32(LANES - 1))
    low_row = v8.splat_as(wide, np.float32(rows[2 * strip]))
    high_row = v8.splat_as(wide, np.float32(rows[2 * strip + 1]))
    cut = v8.splat_as(wide, log_cut)
    for k in range(U(0), count, U(WIDE)):
        mean_x = v8.load_as(wide, staged, U(L.MEAN_X) * n + k)
        mean_y = v8.load_as(wide, staged, U(L.MEAN_Y) * n + k)
        lean_x = v8.load_as(wide, staged, U(L.LEAN_X) * n + k)
        sharp = v8.load_as(wide, staged, U(L.SHARP_X) * n + k)
        budget = v8.load_as(wide, staged, U(L.LOG_OPACITY) * n + k) - cut
        top_column = lean_x * v8.load_as(wide, staged, U(L.RADIUS_Y) * n + k)
        fall = v8.negate(v8.load_as(wide, staged, U(L.FALL_X) * n + k))
        lean = v8.load_as(wide, staged, U(L.LEAN_Y) * n + k)
        blunt = v8.load_as(wide, staged, U(L.BLUNT_Y) * n + k)
        leftmost = west - mean_x
        rightmost = east - mean_x
        # End of the rows: the ellipse's lowest point within the strip.
        d = v8.minimum(v8.maximum(top_column, leftmost), rightmost)
        log_margin = v8.fmuladd(fall * d, d, budget)
        half_height = v8.sqrt(v8.maximum(log_margin, zeros)) * blunt
        end_row = v8.fmuladd(lean, d, mean_y) + half_height + half
        end_row = v8.select(v8.at_least(log_margin, zeros), end_row, zeros)
        # First row: the ellipse's highest point within the strip.
        d = v8.minimum(v8.maximum(v8.negate(top_column), leftmost), rightmost)
        log_margin = v8.fmuladd(fall * d, d, budget)
        half_height = v8.sqrt(v8.maximum(log_margin, zeros)) * blunt
        first_row = v8.fmuladd(lean, d, mean_y) - half_height + half
        first_row = v8.floor(v8.minimum(v8.maximum(first_row, low_row), high_row))
        end_row = v8.floor(v8.minimum(end_row, high_row))
        # Spans, and the numbers that list_items begins with.
        v8.store_whole(spans, k, first_row)
        v8.store_whole(spans, n + k, v8.maximum(end_row, first_row))
        v8.store(starts, k, first_row + half - mean_y)
        v8.store(starts, n + k, sharp * (west - mean_x))
        v8.store(starts, U(2) * n + k, v8.negate(sharp) * lean_x)
        span_bits |= v8.mask_bits(v8.greater(end_row, first_row)) << k
    return span_bits & ((U(1) << count) - U(1))


@inner()
def list_items(staged, span_bits, strip, spans, starts, columns, values, places):
    """List one item for every (rows, splat), in the order of the splats, and return their number.

    An item is its place and splat (see PLACES). For each of its rows are written the log2 of alpha
    on the splat's ridge, and how many (sharp) pixels the row's first pixel is off the ridge. All
    rows of a tile are always written and the surplus is overwritten, which takes no branch.

    Args:
        staged: records of a batch.
        span_bits: as find_spans returns them.
        strip: the strip.
        spans, starts: as find_spans writes them.
        columns: columns of an item's pixels.
        values: written: log2 of alpha on the ridge, then offsets from the ridge.
        places: written: the items.
    """
    n = U(BATCH)
    items = U(0)
    rows_per_item = v8.rows_in(columns)
    while span_bits != U(0):
        k = v8.lowest_bit(span_bits)
        span_bits &= span_bits - U(1)
        row = U(spans[k])
        end = U(spans[n + k])
        is_odd = row & (rows_per_item - U(1))
        fall = v8.splat_as(columns, -staged[U(L.FALL_Y) * n + k])
        peak = v8.splat_as(columns, staged[U(L.LOG_OPACITY) * n + k])
        y = v8.splat_as(columns, starts[k])
        start = v8.splat_as(columns, starts[n + k])
        step = v8.splat_as(columns, starts[U(2) * n + k])
        first = k * U(PLACES) + (strip * U(TILE_H) + row) // rows_per_item
        for j in range(U(0), U(TILE_H), U(LANES) * rows_per_item):
            table = is_odd * U(TILE_H) + j
            row_steps = v8.load_as(columns, _STEPS, table)
            half_start = v8.load_as(columns, _HALVES, table)
            dy = row_steps + (y + half_start)
            ridge_log_alpha = v8.fmuladd(fall * dy, dy, peak)
            if rows_per_item > U(1):
                drawn_row = (is_odd * U(TILE_H + 1) + end - row) * U(TILE_H)
                ridge_log_alpha = ridge_log_alpha + v8.load_as(columns, _UNDRAWN, drawn_row)
            at = items * rows_per_item + j
            v8.store(values, at, ridge_log_alpha)
            v8.store(values, at + U(ITEMS), v8.fmuladd(step, dy, start))
            v8.store_ramp(places, items + j // rows_per_item, np.int32(first + j // rows_per_item))
        items += (end - row + is_odd + rows_per_item - U(1)) // rows_per_item
    return items


@inner()
def gather3(array, gaussian_ids, at):
    """Return rows of a [N, 3] array."""
    first = v8.gather(array, gaussian_ids, at, U(3), U(0))
    second = v8.gather(array, gaussian_ids, at, U(3), U(1))
    return first, second, v8.gather(array, gaussian_ids, at, U(3), U(2))


@inner()
def from_eye(means, gaussian_ids, at, view):
    """Return means minus the camera's centre, in the part's axes.

    This subtraction comes first, so that digits are kept.
    """
    x, y, z = gather3(means, gaussian_ids, at)
    x = x - v8.splat(view[L.V_EYE]) - v8.splat(view[L.V_EYE + 3])
    y = y - v8.splat(view[L.V_EYE + 1]) - v8.splat(view[L.V_EYE + 4])
    z = z - v8.splat(view[L.V_EYE + 2]) - v8.splat(view[L.V_EYE + 5])
    return x, y, z


@inner()
def dot(ax, ay, az, bx, by, bz):
    """Return the dot product of two triples."""
    return v8.fmuladd(ax, bx, v8.fmuladd(ay, by, az * bz))


@inner()
def cross(a, b, scale):
    """Return the cross product of two triples, times a number."""
    return (
        (a[1] * b[2] - a[2] * b[1]) * scale,
        (a[2] * b[0] - a[0] * b[2]) * scale,
        (a[0] * b[1] - a[1] * b[0]) * scale,
    )


@inner()
def rotation_row(view, row):
    """Return a row of the rotation camera_from_part, in all lanes."""
    at = U(L.V_ROTATION) + U(3) * row
    return v8.splat(view[at]), v8.splat(view[at + U(1)]), v8.splat(view[at + U(2)])


@inner()
def to_camera(d, view):
    """Return vectors from the eye, turned from the part's axes to the camera's."""
    r = rotation_row(view, U(0))
    s = rotation_row(view, U(1))
    t = rotation_row(view, U(2))
    x = dot(r[0], r[1], r[2], d[0], d[1], d[2])
    y = dot(s[0], s[1], s[2], d[0], d[1], d[2])
    return x, y, dot(t[0], t[1], t[2], d[0], d[1], d[2])


@inner()
def inverse_divisor(z, view):
    """Return 1 over the divisor of x and y in the projection: z, or 1 for parallel rays."""
    one_f32 = np.float32(1)
    parallel = view[L.V_PARALLEL]
    return v8.splat(one_f32) / v8.fmuladd(v8.splat(one_f32 - parallel), z, v8.splat(parallel))


@inner()
def to_image(x, y, inverse, view):
    """Return the image positions of points in the camera, pixels."""
    x = v8.fmuladd(v8.splat(view[L.V_FOCAL]) * x, inverse, v8.splat(view[L.V_CENTRE]))
    return x, v8.fmuladd(v8.splat(view[L.V_FOCAL + 1]) * y, inverse, v8.splat(view[L.V_CENTRE + 1]))


@inner()
def semi_axes(quats, scales, gaussian_ids, at, x, y, inverse, view):
    """Return ellipsoids' axes in the image, px right (3) and down (3), and the terms that form
    them.

    The terms are the scales (3), the Jacobian's rows times the view's rotation (3 and 3), and the
    rotations (9).
    """
    r = rotation_row(view, U(0))
    s = rotation_row(view, U(1))
    t = rotation_row(view, U(2))
    u = v8.minimum(v8.maximum(x * inverse, v8.splat(view[L.V_LOW])), v8.splat(view[L.V_HIGH]))
    v = v8.minimum(
        v8.maximum(y * inverse, v8.splat(view[L.V_LOW + 1])), v8.splat(view[L.V_HIGH + 1])
    )
    fx = v8.splat(view[L.V_FOCAL]) * inverse
    fy = v8.splat(view[L.V_FOCAL + 1]) * inverse
    jx = fx * (r[0] - u * t[0]), fx * (r[1] - u * t[1]), fx * (r[2] - u * t[2])
    jy = fy * (s[0] - v * t[0]), fy * (s[1] - v * t[1]), fy * (s[2] - v * t[2])
    m = rotation_from_quats(quats, gaussian_ids, at)
    sizes = gather3(scales, gaussian_ids, at)
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
def image_covariance(quats, scales, gaussian_ids, at, x, y, inverse, view):
    """Return xx, xy, yy in px^2, not blurred, and det / (yy + blur), in which no digits cancel."""
    right, down, _, _, _, _ = semi_axes(quats, scales, gaussian_ids, at, x, y, inverse, view)
    x0, x1, x2 = right
    y0, y1, y2 = down
    xx = dot(x0, x1, x2, x0, x1, x2)
    xy = dot(x0, x1, x2, y0, y1, y2)
    yy = dot(y0, y1, y2, y0, y1, y2)
    # Lagrange's identity, det = |x cross y|^2, each term divided before it is squared.
    scale = v8.splat(np.float32(1)) / v8.sqrt(yy + v8.splat(view[L.V_BLUR]))
    c0, c1, c2 = cross(right, down, scale)
    return xx, xy, yy, dot(c0, c1, c2, c0, c1, c2)


@inner()
def rotation_from_quats(quats, gaussian_ids, at):
    """Return rotation matrices, row by row, of unit quaternions wxyz."""
    ones = v8.splat(np.float32(1))
    two = v8.splat(np.float32(2))
    w = v8.gather(quats, gaussian_ids, at, U(4), U(0))
    x = v8.gather(quats, gaussian_ids, at, U(4), U(1))
    y = v8.gather(quats, gaussian_ids, at, U(4), U(2))
    z = v8.gather(quats, gaussian_ids, at, U(4), U(3))
    return (
        ones - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        ones - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        ones - two * (x * x + y * y),
    )


# ---- Splats cut at a height (see augment.render.layout) ------------------------------------------

# Start of the lines of the kept share in a batch's lines: value, slope in x, slope in y.
SHARE = 0
# Start of the lines of the surfaces' depths: value, slope in x, slope in y.
SURFACE = 3 * BATCH
# Start of the limits of the surfaces' depths.
REACHES = 6 * BATCH
# Numbers of a batch's lines.
LINES = 7 * BATCH
# augment.render.layout.FAR_PX.
_FAR = np.float32(1e6)
# Smallest divisor.
_TINY = np.float32(1e-20)
# augment.render.layout.SHARP_PX2.
_SHARP = np.float32(0.003)


@inner()
def height_of(d, view):
    """Return how far means lie on the kept side. d: from the eye, in the part's axes."""
    first = L.V_CLIP_PART
    rise = dot(
        v8.splat(view[first]),
        v8.splat(view[first + 1]),
        v8.splat(view[first + 2]),
        d[0],
        d[1],
        d[2],
    )
    return rise + v8.splat(view[L.V_CLIP_EYE])


@inner()
def cut_eight(quats, scales, gaussian_ids, at, d, x, y, inverse, view):
    """Return which of eight Gaussians have a part on the kept side, and the six numbers of their
    cuts.
    """
    zeros = v8.splat(np.float32(0))
    ones = v8.splat(np.float32(1))
    right, down, sizes, _, _, m = semi_axes(quats, scales, gaussian_ids, at, x, y, inverse, view)
    up0 = v8.splat(view[L.V_CLIP_PART])
    up1 = v8.splat(view[L.V_CLIP_PART + 1])
    up2 = v8.splat(view[L.V_CLIP_PART + 2])
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
    scale = ones / v8.maximum(slope, v8.splat(_TINY))
    max_offset = v8.splat(_FAR)
    offset = v8.maximum(v8.minimum(height * inverse * scale, max_offset), v8.negate(max_offset))
    is_uncut = v8.at_least(height, reach)
    offset = v8.select(is_uncut, max_offset, offset)
    lx = v8.select(is_uncut, zeros, lx * scale)
    ly = v8.select(is_uncut, zeros, ly * scale)
    growth_limit = v8.sqrt(dot(away0, away1, away2, away0, away1, away2)) * inverse
    growth_limit = v8.minimum(
        v8.splat(view[L.V_EXTENT]) * growth_limit, v8.splat(view[L.V_CLIP_LONGEST])
    )
    has_kept_part = v8.both(
        v8.at_least(height + reach, zeros),
        v8.at_least(v8.splat(view[L.V_CLIP_REACH]), height - reach),
    )
    return (
        has_kept_part,
        offset + v8.splat(view[L.V_CLIP_EDGE]),
        lx,
        ly,
        gx * inverse,
        gy * inverse,
        growth_limit,
    )


@inner()
def _depth_slope(x, y, z):
    """Return g = S2^-1 c of semi-axes right, down and away (see augment.render.layout), per px.

    By the identities of Lagrange and Binet-Cauchy, with S2 = [x.x + b, x.y; x.y, y.y + b],

        det S2 gx = (x cross y).(z cross y) + b x.z        det S2 = |x cross y|^2 + b (...)
        det S2 gy = (y cross x).(z cross x) + b y.z

    Written out, S2's determinant would lose all digits for needles and for sheets seen edge-on.
    Everything is divided by y.y + b, each cross product by its root, so that nothing overflows.
    """
    ones = v8.splat(np.float32(1))
    blur = v8.splat(_SHARP)
    inverse = ones / (blur + dot(y[0], y[1], y[2], y[0], y[1], y[2]))
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
    """Write the cuts of a batch, transposed to one row per number, relative to the tile's corner.

    Args:
        cuts: cuts of all slots.
        tile_splat_ids: slots of the tile's splats.
        at: position of the batch in them.
        count: splats of the batch.
        staged: records of the batch.
        has_surfaces: if True, the lines of the surfaces are written, too.
        lines: written.

    Returns:
        True if any splat is cut; splats that are not cut lie wholly on the kept side.
    """
    n = U(BATCH)
    any_cut = False
    for k in range(count):
        cut = U(tile_splat_ids[at + k]) * U(CUT)
        x = staged[U(L.MEAN_X) * n + k]
        y = staged[U(L.MEAN_Y) * n + k]
        lx = cuts[cut + U(L.C_X)]
        ly = cuts[cut + U(L.C_Y)]
        lines[k] = cuts[cut + U(L.C_AT)] - lx * x - ly * y
        lines[n + k] = lx
        lines[U(2) * n + k] = ly
        any_cut = any_cut or lx != np.float32(0) or ly != np.float32(0)
        if has_surfaces:
            gx = cuts[cut + U(L.C_RIGHT)]
            gy = cuts[cut + U(L.C_DOWN)]
            lines[U(3) * n + k] = -gx * x - gy * y
            lines[U(4) * n + k] = gx
            lines[U(5) * n + k] = gy
            lines[U(6) * n + k] = cuts[cut + U(L.C_REACH)]
    return any_cut


@inner()
def list_lines(lines, kind, span_bits, spans, strip, columns, values):
    """Write a line's value at the first pixel of every item's rows, in the order of list_items."""
    n = U(BATCH)
    items = U(0)
    rows_per_item = v8.rows_in(columns)
    half = np.float32(0.5)
    first_x = np.float32(strip * U(LANES)) + half
    while span_bits != U(0):
        k = v8.lowest_bit(span_bits)
        span_bits &= span_bits - U(1)
        row = U(spans[k])
        end = U(spans[n + k])
        is_odd = row & (rows_per_item - U(1))
        slope = lines[U(kind) + U(2) * n + k]
        start = lines[U(kind) + k] + lines[U(kind) + n + k] * first_x
        start = start + slope * (np.float32(row) + half)
        slopes = v8.splat_as(columns, slope)
        for j in range(U(0), U(TILE_H), U(LANES) * rows_per_item):
            table = is_odd * U(TILE_H) + j
            first = v8.splat_as(columns, start) + slopes * v8.load_as(columns, _HALVES, table)
            row_steps = v8.load_as(columns, _STEPS, table)
            v8.store(values, items * rows_per_item + j, v8.fmuladd(slopes, row_steps, first))
        items += (end - row + is_odd + rows_per_item - U(1)) // rows_per_item


@inner()
def line_at(lines, kind, values, splat, item, columns):
    """Return a line's values at the pixels of an item."""
    slope = v8.splat_as(columns, lines[U(kind) + U(BATCH) + splat])
    return v8.fmuladd(slope, columns, v8.by_row(columns, values, item))


@inner()
def surface_depth(lines, values, splat, item, columns, depth, parallel):
    """Return the depths of a splat's surface at an item's pixels. parallel: 1 for parallel rays,
    else 0.
    """
    one_f32 = np.float32(1)
    reach = v8.splat_as(columns, lines[U(REACHES) + splat])
    growth = v8.minimum(line_at(lines, SURFACE, values, splat, item, columns), reach)
    growth = v8.maximum(growth, v8.negate(reach))
    depths = v8.fmuladd(v8.splat_as(columns, parallel), growth, v8.splat_as(columns, depth))
    return depths / (
        v8.splat_as(columns, one_f32) - v8.splat_as(columns, one_f32 - parallel) * growth
    )


@inner()
def kept_share(lines, values, splat, item, columns):
    """Return the share of alpha that a cut keeps at an item's pixels."""
    value = line_at(lines, SHARE, values, splat, item, columns)
    zeros = v8.splat_as(columns, np.float32(0))
    ones = v8.splat_as(columns, np.float32(1))
    return v8.maximum(v8.minimum(value, ones), zeros)


# ---- Light by the normal of every pixel of a splat (see augment.render.shading) ------------------
# A splat's lights are SHADING_LINES float32, as listed there; all are 0 for a splat of one colour.

SHADING_LINES = 9
L_FACING, L_X, L_Y, L_WRAP, L_LEAN_X, L_LEAN_Y, L_RED, L_GREEN, L_BLUE = range(SHADING_LINES)
# Numbers of a batch's lights: a row for each line, then a row that is > 0 for a lit splat.
LIT = (SHADING_LINES + 1) * BATCH
# augment.render.shading.MIN_FACING.
_MIN_FACING = np.float32(0.05)


@inner()
def light_eight(m, view_directions, view):
    """Return the shading numbers of eight Gaussians without the slopes.

    m: rotations. view_directions: vectors from the eye, camera axes.
    """
    r = rotation_row(view, U(0))
    s = rotation_row(view, U(1))
    t = rotation_row(view, U(2))
    zeros = v8.splat(np.float32(0))
    ones = v8.splat(np.float32(1))
    nx = dot(r[0], r[1], r[2], m[2], m[5], m[8])
    ny = dot(s[0], s[1], s[2], m[2], m[5], m[8])
    nz = dot(t[0], t[1], t[2], m[2], m[5], m[8])
    is_back = v8.greater(
        dot(nx, ny, nz, view_directions[0], view_directions[1], view_directions[2]), zeros
    )
    nx = v8.select(is_back, v8.negate(nx), nx)
    ny = v8.select(is_back, v8.negate(ny), ny)
    nz = v8.select(is_back, v8.negate(nz), nz)
    sx = v8.splat(view[L.V_SUN])
    sy = v8.splat(view[L.V_SUN + 1])
    sz = v8.splat(view[L.V_SUN + 2])
    inverse = ones / v8.maximum(v8.negate(nz), v8.splat(_MIN_FACING))
    ax = nx * inverse
    ay = ny * inverse
    fx = v8.splat(view[L.V_FOCAL])
    fy = v8.splat(view[L.V_FOCAL + 1])
    scale = ones / (ones + v8.splat(view[L.V_WRAP]))
    return (
        dot(nx, ny, nz, sx, sy, sz) * scale,
        v8.fmuladd(sz, ax, sx) / fx * scale,
        v8.fmuladd(sz, ay, sy) / fy * scale,
        v8.splat(view[L.V_WRAP]) * scale,
        ax / fx,
        ay / fy,
    )


@inner()
def stage_lights(lights, tile_splat_ids, at, count, staged_lights):
    """Write the lights of a batch, transposed to one row per number."""
    n = U(BATCH)
    for k in range(count):
        first = U(tile_splat_ids[at + k]) * U(SHADING_LINES)
        max_slope = np.float32(0)
        for line in range(U(SHADING_LINES)):
            staged_lights[line * n + k] = lights[first + line]
        for line in range(U(L_RED), U(SHADING_LINES)):
            max_slope = max(max_slope, abs(lights[first + line]))
        staged_lights[U(SHADING_LINES) * n + k] = max_slope


@inner()
def is_lit(staged_lights, splat):
    """Return True if a splat of the batch is lit pixel by pixel."""
    return staged_lights[U(SHADING_LINES * BATCH) + splat] > np.float32(0)


@inner()
def light_share(staged_lights, staged, splat, log_alpha, place, columns, limits):
    """Return the share of the light at an item's pixels.

    Args:
        staged_lights: as stage_lights writes them.
        staged: records of the batch.
        splat: number of the splat in the batch.
        log_alpha: log2 of the splat's alpha at the pixels.
        place: place of the item (see PLACES).
        columns: columns of the item's pixels.
        limits: as in blend.Frame: the second is log2(ALPHA_MIN), the sixth and seventh are 1/fx^2
            and 1/fy^2.
    """
    n = U(BATCH)
    zeros = v8.splat_as(columns, np.float32(0))
    ones = v8.splat_as(columns, np.float32(1))
    half = np.float32(0.5)
    row = place * v8.rows_in(columns)
    left = np.float32(row // U(TILE_H) * U(LANES)) + half - staged[U(L.MEAN_X) * n + splat]
    down = v8.splat_as(columns, np.float32(row % U(TILE_H)) + half) + v8.row_numbers(columns)
    x = columns + v8.splat_as(columns, left)
    y = down - v8.splat_as(columns, staged[U(L.MEAN_Y) * n + splat])
    # The squared distance from the mean, relative to that of the alpha cut-off, follows from the
    # log of alpha.
    peak = staged[U(L.LOG_OPACITY) * n + splat]
    span = v8.splat_as(columns, max(peak - limits[1], _TINY))
    rim_share = (v8.splat_as(columns, peak) - log_alpha) / span
    rim_share = v8.maximum(v8.minimum(rim_share, ones), zeros)
    lean_x = v8.splat_as(columns, staged_lights[U(L_LEAN_X) * n + splat])
    lean = lean_x * x + v8.splat_as(columns, staged_lights[U(L_LEAN_Y) * n + splat]) * y
    distance_squared = v8.splat_as(columns, limits[6]) * y * y + v8.splat_as(columns, _TINY)
    distance_squared = v8.fmuladd(lean, lean, distance_squared)
    distance_squared = v8.fmuladd(v8.splat_as(columns, limits[5]) * x, x, distance_squared)
    tilt_x = v8.splat_as(columns, staged_lights[U(L_X) * n + splat])
    tilt = tilt_x * x + v8.splat_as(columns, staged_lights[U(L_Y) * n + splat]) * y
    wrap = v8.splat_as(columns, staged_lights[U(L_WRAP) * n + splat])
    share = v8.fmuladd(v8.sqrt(rim_share / distance_squared), tilt, wrap)
    facing = v8.splat_as(columns, staged_lights[U(L_FACING) * n + splat])
    share = v8.fmuladd(v8.sqrt(ones - rim_share), facing, share)
    return v8.maximum(v8.minimum(share, ones), zeros)
