"""Numba kernels that shade a water surface and composite a flooded view's layers.

`shade` implements `water.shade_water`. It sorts a row's water pixels into a smooth and a rough list
and works on eight pixels at a time. Rough pixels need three slopes and mip levels, smooth pixels
need the image itself. Coordinates and colours are vectors of eight; colours are fetched for two
pixels at a time. Everything is float32 except the rays' directions: their sign decides where there
is water, and the distance to the water is divided by their small downward part. Indices are
unsigned, so nothing wraps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import prange
from numba.core import types
from numba.extending import intrinsic

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner, kernel
from augment.render.cpu.simd import LOG2_E, exp2_fine, log2
from augment.render.layout import U

# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# (of numba's intrinsics it sees the compiler's first argument as well, and no result)

# Constants of the definition (`water`), which the kernels round to float32.
# Alpha from which the water behind a surface is drawn in one colour. Opaque surfaces let up to 4 %
# through (a splat that would bring transmittance to 1e-4 is not blended, whatever is left before
# it), and the light through them needs no reflections.
HIDDEN_COVER = 0.95
SOLID_ALPHA = 0.5  # smallest alpha of a pixel that shows a surface at its depth
MIN_DEPTH = 1e-20  # smallest depth in a projection: points behind a camera land far outside
FARTHEST = 1e12  # largest depth of rays along the water
MIN_COSINE = 1e-3  # of rays against the surface, and of reflected rays against the vertical
MIN_NORMAL_Z2 = 1e-6  # smallest square of a normal's z
BED_STEPS = 2  # most corrections of the bed's depth where a refracted ray meets it
CONVERGED_M = 0.01  # size of a correction, metres, after which the corrections stop
EDGE = 0.04  # share of the image's sides over which the screen-space reflection fades out
MATCH_M = 0.3  # largest distance of a ray's end from the surface that it shows, metres
MATCH_SHARE = 0.05  # the same as a share of the depth; the larger one counts
FAINT = 1 / 256  # largest share of the sky that does not visibly change a colour

# ---- Mip levels ----------------------------------------------------------------------------------


@kernel
def pack(rgb, alpha, out):
    """Copy rgb [H, W, 3] and alpha [H, W] side by side into out [H, W, 4]."""
    for i in prange(out.shape[0]):
        for j in range(np.uint64(out.shape[1])):
            for c in range(np.uint64(3)):
                out[i, j, c] = rgb[i, j, c]
            out[i, j, 3] = alpha[i, j]


@kernel
def halve_mip(image, out):
    """Write averages over 2 x 2 pixels of image [H, W, 4] into out [h, w, 4]."""
    height, width, _ = image.shape
    quarter = np.float32(0.25)
    for i in prange(out.shape[0]):
        top = np.uint64(2 * i)
        bottom = np.uint64(min(2 * i + 1, height - 1))
        for j in range(np.uint64(out.shape[1])):
            c0 = np.uint64(2) * j
            c1 = min(c0 + np.uint64(1), np.uint64(width - 1))
            for c in range(np.uint64(4)):
                total = (image[top, c0, c] + image[bottom, c0, c]) + (
                    image[top, c1, c] + image[bottom, c1, c]
                )
                out[i, j, c] = quarter * total


# ---- Layers of a flooded view --------------------------------------------------------------------


@inner()
def _falls(u, v, rise):
    """Return the vertical part of a pixel's ray, summed in the order of Camera.ray_directions."""
    return (u * rise[0] + v * rise[1]) + rise[2]


@kernel
def find_water(u, v, rise, alpha, max_shares, water):
    """Write water [H, W] uint8: 1 where a ray falls and alpha leaves more than half of it, else 0.

    u [W], v [H]: image coordinates at unit depth, float64. rise [3]: world z along the camera's
    axes. max_shares [H]: output, the largest share of a falling ray that alpha leaves in each row,
    0 in rows where no ray falls.
    """
    for i in prange(alpha.shape[0]):
        max_share = np.float32(0)
        for j in range(alpha.shape[1]):
            share = np.float32(1) - alpha[i, j]
            share = share if _falls(u[j], v[i], rise) < 0.0 else np.float32(0)
            max_share = max(max_share, share)
            water[i, j] = np.uint8(share > np.float32(0.5))
        max_shares[i] = max_share


@kernel
def composite_water(u, v, rise, top, left, alpha, color, rgb):
    """Add (1 - alpha) color to rgb [H, W, 3] where rays fall.

    color: [h, w, 3], whose corner is at row top and column left of rgb. u, v: image coordinates at
    unit depth of the columns and rows of color.
    """
    for i in prange(color.shape[0]):
        row = U(top + i)
        for j in range(color.shape[1]):
            if _falls(u[j], v[i], rise) < 0.0:
                column = U(left + j)
                transmittance = np.float32(1) - alpha[row, column]
                for c in range(U(3)):
                    rgb[row, column, c] += transmittance * color[U(i), U(j), c]


@kernel
def join_depth(alpha, behind_alpha, depth, behind_depth, min_alpha):
    """Write the expected depth of two layers, a weighted mean, into depth [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            share = (np.float32(1) - a) * behind_alpha[i, j]
            total = a * depth[i, j] + share * behind_depth[i, j]
            depth[i, j] = total / max(a + share, min_alpha)


@kernel
def join_heavier(alpha, behind_alpha, values, behind):
    """Write the values of the layer that covers more of a pixel into values [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            if (np.float32(1) - a) * behind_alpha[i, j] > a:
                values[i, j] = behind[i, j]


@kernel
def join_alpha(alpha, behind_alpha):
    """Add (1 - alpha) of the alpha behind to alpha [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            alpha[i, j] = a + (np.float32(1) - a) * behind_alpha[i, j]


# ---- The water's colour --------------------------------------------------------------------------

F = np.float32
ZERO = F(0)
HALF = F(0.5)
ONE = F(1)
SOLID = F(SOLID_ALPHA)
TINY = F(1e-7)
STRIP = 64  # pixels of a list that are shaded at a time
LANES = U(8)
EIGHTS = ~U(7)  # bit mask that rounds down to a multiple of eight

# Offsets of the lines of a list, one number a pixel: the ray and the distance to the water along
# it, the surface's normal and slope variance, the depth of the bed straight behind (-1: none), the
# screen-space ray's length and weight.
DX, DY, DZ, ALONG, NX, NY, ROUGH, STRAIGHT_DEPTH, DISTANCE, RAY_WEIGHT = (
    U(STRIP * k) for k in range(10)
)
LIST = U(STRIP * 10)

# Offsets of the lines of the scratch memory: a colour; is the bed found, and its depth; two mip
# levels; for each of three slopes the mirrored ray, its share of the light and its coordinates in
# the mirror.
R, G, B, A, FOUND, DEPTH, SHARE_ABOVE = (U(8 * k) for k in range(7))
LOW, WIDE, HIGH, SCALE = (U(56 + 16 * k) for k in range(4))
RX, RY, RZ, SHARE, MIRROR_C, MIRROR_R = (U(120 + 24 * k) for k in range(6))
SCRATCH = 120 + 24 * 6
# Offsets in the list of first texels, of eight pixels each: two mip levels, and 0 for whole images.
LOWER = U(0)
UPPER = U(8)
WHOLE_IMAGE = U(16)


class View(NamedTuple):
    """A layer's camera, unpacked from an array by `_view`.

    Counting references to arrays would take longer than the arithmetic.
    """

    project: tuple[np.float32, ...]  # fx times right axis, fy times down axis, forward axis
    rays: tuple[np.float32, ...]  # coefficients of column, row and 1 in x, y, z of a pixel's ray
    cx: np.float32
    cy: np.float32
    columns: np.float32  # the image's width as a real number
    rows: np.float32  # the image's height as a real number
    width: np.uint64
    height: np.uint64


class Medium(NamedTuple):
    """The water and the fog over it."""

    height: np.float32  # of the eye over the water
    index: np.float32  # refraction index
    schlick: bool  # True for Schlick's reflectance
    extinction: tuple[np.float32, ...]  # of the water, per metre
    rgb: tuple[np.float32, ...]  # colour of deep water
    fog_per_m: np.float32  # the fog's optical depth per metre of ray to the water; 0 without fog
    fog_above: np.float32  # the fog's optical depth from the water straight up; < 0 for a clear sky
    airlight: tuple[np.float32, ...]  # colour of the fog
    max_optical_depth: np.float32  # of the water; a bed behind more of it is not drawn
    min_extinction: np.float32  # the smallest of the three


@inner()
def _view(n):
    project = (n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8])
    rays = (n[9], n[10], n[11], n[12], n[13], n[14], n[15], n[16], n[17])
    width = U(np.int32(n[20]))
    height = U(np.int32(n[21]))
    return View(project, rays, n[18], n[19], n[20], n[21], width, height)


@inner()
def _medium(n):
    extinction = (n[3], n[4], n[5])
    rgb = (n[6], n[7], n[8])
    airlight = (n[11], n[12], n[13])
    min_extinction = min(n[3], min(n[4], n[5]))
    return Medium(
        n[0], n[1], n[2] > ZERO, extinction, rgb, n[9], n[10], airlight, n[14], min_extinction
    )


def _shuffled(builder, left, right, order):
    lanes = ir.VectorType(ir.IntType(32), len(order))
    return builder.shuffle_vector(left, right, ir.Constant(lanes, order))


def _squares(context, builder, sig, args):
    """Unpack the arguments of a bilinear look-up.

    Returns the images' data, then as vectors of eight: the indices of the upper and lower left
    pixels, the weights of the right and lower pixels, and the weights of the left and upper pixels.
    """
    *arrays, firsts, start, row, column, width, across, down = zip(sig.args, args, strict=True)
    data = [context.make_array(kind)(context, builder, array).data for kind, array in arrays]
    kind, array = firsts
    int32_lanes, int64_lanes = (ir.VectorType(ir.IntType(bits), v8.LANES) for bits in (32, 64))
    pointer = builder.gep(context.make_array(kind)(context, builder, array).data, [start[1]])
    first = builder.load(builder.bitcast(pointer, int64_lanes.as_pointer()), align=8)
    rows, columns, widths = (
        builder.zext(builder.fptosi(v, int32_lanes), int64_lanes) for _, v in (row, column, width)
    )
    above = builder.add(first, builder.add(builder.mul(rows, widths), columns))
    ones = ir.Constant(across[1].type, [1.0] * v8.LANES)
    left_up = [builder.fsub(ones, v) for _, v in (across, down)]
    return data, above, builder.add(above, widths), across[1], down[1], *left_up


def _pointer_to(builder, data, indices, lane, stride, count):
    wide = ir.IntType(64)
    lanes = ir.VectorType(ir.FloatType(), count)
    at = builder.mul(builder.extract_element(indices, ir.IntType(32)(lane)), wide(stride))
    return builder.gep(data, [at]), lanes.as_pointer()


def _channels(context, builder, sig, fours):
    """Return four channels of eight pixels, from vectors of two pixels' four channels each."""
    halves = []
    for left, right in (fours[:2], fours[2:]):
        halves.append(_shuffled(builder, left, right, [0, 4, 8, 12, 1, 5, 9, 13]))
        halves.append(_shuffled(builder, left, right, [2, 6, 10, 14, 3, 7, 11, 15]))
    values = [
        _shuffled(builder, halves[k], halves[k + 2], [*range(n, n + 4), *range(n + 8, n + 12)])
        for k in range(2)
        for n in (0, 4)
    ]
    return context.make_tuple(builder, sig.return_type, values)


@intrinsic
def _texels(typingctx, image, firsts, start, row, column, width, across, down):
    """Look up eight pixels bilinearly in a flat image of four channels; return four vectors.

    firsts[start:]: the first texels of eight images in it. row, column: integers. width: of the
    images. across, down: weights of the next column and row.
    """

    def codegen(context, builder, sig, args):
        (data,), above, below, right, down, left, up = _squares(context, builder, sig, args)
        fours = []
        for lane in range(0, v8.LANES, 2):

            def pairs(indices, lane=lane):
                """Return a texel and the next one, for this lane and the next one."""
                loaded = []
                for k in (lane, lane + 1):
                    at, kind = _pointer_to(builder, data, indices, k, 4, 8)
                    loaded.append(builder.load(builder.bitcast(at, kind), align=4))
                return _shuffled(builder, *loaded, [*range(16)])

            weight_order = [lane] * 8 + [lane + 1] * 8
            weighted_rows = []
            for indices, share in ((above, up), (below, down)):
                weighted_rows.append(
                    builder.fmul(pairs(indices), _shuffled(builder, share, share, weight_order))
                )
            order = [k + side for k in (lane, lane + 1) for side in (0, 8) for _ in range(4)]
            total = builder.fmul(
                builder.fadd(*weighted_rows), _shuffled(builder, left, right, order)
            )
            sides = [[*range(n, n + 4), *range(n + 8, n + 12)] for n in (0, 4)]
            fours.append(builder.fadd(*(_shuffled(builder, total, total, n) for n in sides)))
        return _channels(context, builder, sig, fours)

    result = types.UniTuple(v8.float8, 4)
    return result(image, firsts, types.uint64, *[v8.float8] * 5), codegen


@intrinsic
def _colors(typingctx, rgb, alpha, firsts, start, row, column, width, across, down):
    """Look up like `_texels`, in a flat image of three channels and one of alpha."""

    def codegen(context, builder, sig, args):
        loaded = _squares(context, builder, sig, args)
        (rgb, alpha), above, below, right, down, left, up = loaded
        fours = []
        for lane in range(0, v8.LANES, 2):

            def pairs(indices, lane=lane):
                """Return rgb of a pixel and the next one, and their alphas, for two lanes."""
                loaded = []
                for k in (lane, lane + 1):
                    at, kind = _pointer_to(builder, rgb, indices, k, 3, 4)
                    first = builder.load(builder.bitcast(at, kind), align=4)
                    at = builder.gep(at, [ir.IntType(64)(4)])
                    alpha_pointer, kind = _pointer_to(builder, alpha, indices, k, 1, 2)
                    ends = [
                        builder.load(builder.bitcast(p, kind), align=4) for p in (at, alpha_pointer)
                    ]
                    last = _shuffled(builder, *ends, [*range(4)])
                    loaded.append(_shuffled(builder, first, last, [*range(8)]))
                return _shuffled(builder, *loaded, [*range(16)])

            order = [k + 8 * (n in (3, 4, 5, 7)) for k in (lane, lane + 1) for n in range(8)]
            sides = [[0, 1, 2, 6, 8, 9, 10, 14], [3, 4, 5, 7, 11, 12, 13, 15]]
            sums = []
            for indices, share in ((above, up), (below, down)):
                weights = [builder.fmul(side, share) for side in (left, right)]
                weighted = builder.fmul(pairs(indices), _shuffled(builder, *weights, order))
                sums.append(
                    builder.fadd(*(_shuffled(builder, weighted, weighted, n) for n in sides))
                )
            fours.append(builder.fadd(*sums))
        return _channels(context, builder, sig, fours)

    result = types.UniTuple(v8.float8, 4)
    return result(rgb, alpha, firsts, types.uint64, *[v8.float8] * 5), codegen


@intrinsic
def _pixels(typingctx, alpha, depth, row, column, width):
    """Read two flat images at eight integer rows and columns inside them."""

    def codegen(context, builder, sig, args):
        int32 = ir.IntType(32)
        int64 = ir.IntType(64)
        int_lanes = ir.VectorType(int32, v8.LANES)
        rows, columns = (builder.fptosi(arg, int_lanes) for arg in args[2:4])
        values = [ir.Constant(ir.VectorType(ir.FloatType(), v8.LANES), ir.Undefined)] * 2
        arrays = [
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(sig.args[:2], args[:2], strict=True)
        ]
        for lane in range(v8.LANES):
            r, c = (builder.extract_element(part, int32(lane)) for part in (rows, columns))
            at = builder.add(builder.mul(builder.zext(r, int64), args[4]), builder.zext(c, int64))
            for k, array in enumerate(arrays):
                value = builder.load(builder.gep(array, [at]))
                values[k] = builder.insert_element(values[k], value, int32(lane))
        return context.make_tuple(builder, sig.return_type, values)

    result = types.UniTuple(v8.float8, 2)
    return result(alpha, depth, v8.float8, v8.float8, types.uint64), codegen


@inner()
def _clamp(x, low, high):
    return v8.minimum(v8.maximum(x, v8.splat(low)), v8.splat(high))


@inner()
def _splat3(c):
    return v8.splat(c[0]), v8.splat(c[1]), v8.splat(c[2])


@inner()
def _blend3(t, a, b):
    """Return t a + (1 - t) b of two colours."""
    complement = v8.splat(ONE) - t
    return t * a[0] + complement * b[0], t * a[1] + complement * b[1], t * a[2] + complement * b[2]


@inner()
def _blend4(t, a, b):
    red, green, blue = _blend3(t, (a[0], a[1], a[2]), (b[0], b[1], b[2]))
    return red, green, blue, t * a[3] + (v8.splat(ONE) - t) * b[3]


@inner()
def _select3(mask, a, b):
    return v8.select(mask, a[0], b[0]), v8.select(mask, a[1], b[1]), v8.select(mask, a[2], b[2])


@inner()
def _load3(s, x, y, z):
    return v8.load(s, x), v8.load(s, y), v8.load(s, z)


@inner()
def _norm(x, y, z):
    return v8.sqrt(x * x + y * y + z * z)


@inner()
def _any(mask):
    return v8.any_not_negative(v8.select(mask, v8.splat(ONE), v8.splat(-ONE)))


@inner()
def _exponential(x):
    """Return exp(-x) for x >= 0."""
    return exp2_fine(v8.maximum(x * v8.splat(-LOG2_E), v8.splat(F(-126))))


@inner()
def _dot(m, first, p):
    return v8.splat(m[first]) * p[0] + v8.splat(m[first + 1]) * p[1] + v8.splat(m[first + 2]) * p[2]


@inner()
def _project(view, p):
    m = view.project
    depth = v8.maximum(_dot(m, 6, p), v8.splat(F(MIN_DEPTH)))
    inverse = v8.splat(ONE) / depth
    column = _dot(m, 0, p) * inverse + v8.splat(view.cx)
    return column, _dot(m, 3, p) * inverse + v8.splat(view.cy)


@inner()
def _clamp_to(view, column, row):
    column = _clamp(column, HALF, view.columns - HALF)
    return column, _clamp(row, HALF, view.rows - HALF)


@inner()
def _is_inside(view, column, row):
    zero = v8.splat(ZERO)
    across = v8.both(v8.at_least(column, zero), v8.greater(v8.splat(view.columns), column))
    down = v8.both(v8.at_least(row, zero), v8.greater(v8.splat(view.rows), row))
    return v8.both(across, down)


@inner()
def _look(alpha, depth, view, column, row):
    """Return alpha and depth of the nearest pixels inside, and their centres."""
    column = v8.floor(_clamp(column, ZERO, view.columns - ONE))
    row = v8.floor(_clamp(row, ZERO, view.rows - ONE))
    a, z = _pixels(alpha, depth, row, column, view.width)
    half = v8.splat(HALF)
    return a, z, column + half, row + half


@inner()
def _ray_part(view, first, column, row):
    m = view.rays
    return v8.splat(m[first]) * column + v8.splat(m[first + 1]) * row + v8.splat(m[first + 2])


@inner()
def _distance_to_surface(view, z, column, row, p):
    """Return the distance from points p (relative to the layer's eye) to the pixels' surfaces."""
    x = z * _ray_part(view, 0, column, row) - p[0]
    y = z * _ray_part(view, 3, column, row) - p[1]
    z = z * _ray_part(view, 6, column, row) - p[2]
    return _norm(x, y, z)


@inner()
def _end(p, distance, ray):
    """Return the ends of rays; their directions where they have no end (a distance < 0)."""
    has_end = v8.at_least(distance, v8.splat(ZERO))
    ends = p[0] + distance * ray[0], p[1] + distance * ray[1], p[2] + distance * ray[2]
    return _select3(has_end, ends, ray)


@inner()
def _place(column, row, columns, rows):
    """Return row and column of the first of the four pixels around coordinates, and the weights.

    columns, rows: the image's sides, vectors. On the last pixels the weight of the next one is 1.
    """
    half = v8.splat(HALF)
    ones = v8.splat(ONE)
    two = v8.splat(F(2))
    zero = v8.splat(ZERO)
    x = v8.minimum(v8.maximum(column - half, zero), columns - ones)
    y = v8.minimum(v8.maximum(row - half, zero), rows - ones)
    c0 = v8.maximum(v8.minimum(v8.floor(x), columns - two), zero)
    r0 = v8.maximum(v8.minimum(v8.floor(y), rows - two), zero)
    return r0, c0, x - c0, y - r0


@inner()
def _pixel(x):
    return U(np.int32(x))


@inner()
def _fetch(starts, column, row, rgb, alpha, view):
    columns = v8.splat(view.columns)
    r0, c0, across, down = _place(column, row, columns, v8.splat(view.rows))
    return _colors(rgb, alpha, starts, WHOLE_IMAGE, r0, c0, columns, across, down)


@inner()
def _choose_levels(s, starts, level, sizes):
    """Store the two mip levels around real ones: first pixels, sizes, scales of coordinates."""
    low = v8.floor(level)
    top = v8.splat(F(np.int32(sizes.shape[0] - 1)))
    v8.store(s, SHARE_ABOVE, level - low)
    v8.store(s, LOW, low)
    v8.store(s, LOW + LANES, v8.minimum(low + v8.splat(ONE), top))
    for k in range(U(2) * LANES):
        n = _pixel(s[LOW + k])
        starts[k] = sizes[n, 0]
        s[WIDE + k] = F(np.int32(sizes[n, 1]))
        s[HIGH + k] = F(np.int32(sizes[n, 2]))
        s[SCALE + k] = ONE / F(np.int32(1) << np.int32(n))


@inner()
def _fetch_level(s, starts, second, column, row, mips):
    """Look up one of the chosen levels. second: 0 for the lower level, LANES for the upper one."""
    scale = v8.load(s, SCALE + second)
    wide = v8.load(s, WIDE + second)
    high = v8.load(s, HIGH + second)
    r0, c0, across, down = _place(column * scale, row * scale, wide, high)
    return _texels(mips, starts, second, r0, c0, wide, across, down)


@inner()
def _sky(starts, faces, size, x, y, z, near, medium):
    """Return colours of a flat, bordered cube map in rising directions, behind fog."""
    zero = v8.splat(ZERO)
    ax = v8.absolute(x)
    ay = v8.absolute(y)
    by_x = v8.both(v8.at_least(ax, ay), v8.at_least(ax, z))
    by_y = v8.at_least(ay, z)
    major = v8.select(by_x, ax, v8.select(by_y, ay, z))
    right = v8.at_least(x, zero)
    ahead = v8.at_least(y, zero)
    across = v8.select(by_x, v8.select(right, v8.negate(z), z), x)
    turned = v8.select(v8.both(by_y, ahead), z, v8.select(by_y, v8.negate(z), v8.negate(y)))
    down = v8.select(by_x, v8.negate(y), turned)
    face = v8.select(by_y, v8.select(ahead, v8.splat(F(2)), v8.splat(F(3))), v8.splat(F(4)))
    face = v8.select(by_x, v8.select(right, zero, v8.splat(ONE)), face)
    side = v8.splat(F(np.int32(size)))
    middle = v8.splat(HALF) * side
    inverse = (middle - v8.splat(ONE)) / major
    r0, c0, across, down = _place(across * inverse + middle, down * inverse + middle, side, side)
    r, g, b, _ = _texels(faces, starts, WHOLE_IMAGE, r0 + face * side, c0, side, across, down)
    color = r, g, b
    if medium.fog_above >= ZERO:
        t = _exponential(near + v8.splat(medium.fog_above) / z)
        color = _blend3(t, color, _splat3(medium.airlight))
    return color


@inner()
def _reflectance(c, inside, medium):
    """Return the share of reflected light. c, inside: cosines in the air and in the water."""
    ones = v8.splat(ONE)
    n = v8.splat(medium.index)
    if medium.schlick:
        base = (n - ones) / (n + ones)
        base = base * base
        x = ones - c
        return base + (ones - base) * ((x * x) * (x * x) * x)
    a = c - n * inside
    b = c + n * inside
    d = n * c - inside
    e = n * c + inside
    quotient = ones / (b * e)
    rs = a * e * quotient
    rp = d * b * quotient
    return v8.splat(HALF) * (rs * rs + rp * rp)


@inner()
def _facet(sx, sy, view, medium):
    """Return (normals, cosines in air and water, reflected share, mirrored rays) of facets.

    sx, sy: their slopes. view: unit vectors to the eye.
    """
    ones = v8.splat(ONE)
    min_cosine = v8.splat(F(MIN_COSINE))
    vx, vy, vz = view
    nz = ones / v8.sqrt(sx * sx + sy * sy + ones)
    nx = sx * nz
    ny = sy * nz
    cosine = nx * vx + ny * vy + nz * vz
    c = v8.minimum(v8.maximum(cosine, min_cosine), ones)
    inverse = v8.splat(ONE / medium.index)
    inside = v8.sqrt(v8.maximum(ones - (ones - c * c) * inverse * inverse, v8.splat(ZERO)))
    twice = cosine + cosine
    x = twice * nx - vx
    y = twice * ny - vy
    z = v8.maximum(twice * nz - vz, min_cosine)
    unit = ones / _norm(x, y, z)
    share = _reflectance(c, inside, medium)
    return (nx, ny, nz), c, inside, share, (x * unit, y * unit, z * unit)


@inner()
def _refract(normal, c, inside, view, medium):
    """Return refracted rays per metre of depth, and their length per metre."""
    ones = v8.splat(ONE)
    ratio = v8.splat(ONE / medium.index)
    bend = c * ratio - inside
    x = bend * normal[0] - view[0] * ratio
    y = bend * normal[1] - view[1] * ratio
    z = v8.maximum(view[2] * ratio - bend * normal[2], v8.splat(F(MIN_COSINE)))
    steep = ones / z
    return x * steep, y * steep, _norm(x, y, z) * steep


@inner()
def _place_on_bed(px, py, tx, ty, depth, bed, medium):
    below = px + depth * tx, py + depth * ty, v8.splat(-medium.height) - depth
    column, row = _project(bed, below)
    return column, row, _is_inside(bed, column, row)


@inner()
def _search_bed(is_found, depth, px, py, tx, ty, alpha, depths, bed, medium):
    """Return where refracted rays meet the bed: depth, column and row; 1 where they do, else 0."""
    zero = v8.splat(ZERO)
    ones = v8.splat(ONE)
    is_moving = is_found
    for _ in range(BED_STEPS):
        moves = v8.greater(is_moving, zero)
        if not _any(moves):
            break
        column, row, inside = _place_on_bed(px, py, tx, ty, depth, bed, medium)
        a, z, column, row = _look(alpha, depths, bed, column, row)
        has_bed = v8.select(v8.both(inside, v8.at_least(a, v8.splat(SOLID))), ones, zero)
        is_found = v8.select(moves, v8.minimum(is_found, has_bed), is_found)
        is_moving = v8.minimum(is_moving, has_bed)
        new_depth = v8.splat(-medium.height) - z * _ray_part(bed, 6, column, row)
        new_depth = v8.select(v8.greater(is_moving, zero), v8.maximum(new_depth, zero), depth)
        is_large = v8.greater(v8.absolute(new_depth - depth), v8.splat(F(CONVERGED_M)))
        is_moving = v8.select(is_large, is_moving, zero)
        depth = new_depth
    column, row, inside = _place_on_bed(px, py, tx, ty, depth, bed, medium)
    return depth, column, row, v8.select(inside, is_found, zero)


@inner()
def _use_straight_bed(s, q, straight_pixels, place, at, depth, colors, rgb, alpha):
    """Replace depth and colour by the bed straight behind the pixel where FOUND is 0."""
    r, g, b, a = colors
    v8.store(s, DEPTH, depth)
    v8.store(s, R, r)
    v8.store(s, G, g)
    v8.store(s, B, b)
    v8.store(s, A, a)
    for k in range(LANES):
        if s[FOUND + k] == ZERO:
            pixel = U(straight_pixels[place + k])
            s[R + k] = rgb[U(3) * pixel]
            s[G + k] = rgb[U(3) * pixel + U(1)]
            s[B + k] = rgb[U(3) * pixel + U(2)]
            s[A + k] = alpha[pixel]
            s[DEPTH + k] = q[STRAIGHT_DEPTH + at + k]
    return v8.load(s, DEPTH), v8.load(s, R), v8.load(s, G), v8.load(s, B), v8.load(s, A)


@inner()
def _absorb(bed_color, alpha, water, length, extinction):
    ones = v8.splat(ONE)
    t = _exponential(length * v8.splat(extinction))
    return t * (bed_color + (ones - alpha) * water) + (ones - t) * water


@inner()
def _mirror_distance(alpha, depth, mirror, column, row, p):
    """Return the distance from the water to the mirrored layer's surface; -1 without a surface."""
    a, z, column, row = _look(alpha, depth, mirror, column, row)
    distance = _distance_to_surface(mirror, z, column, row, p)
    return v8.select(v8.at_least(a, v8.splat(SOLID)), distance, v8.splat(-ONE))


@inner()
def _find_in_mirror(s, count, dx, dy, dz, px, py, alpha, depth, mirror, medium):
    """Store in MIRROR_C and MIRROR_R where the reflected rays end in the mirrored layer."""
    p = px, py, v8.splat(medium.height)
    column, row = _project(mirror, (dx, dy, v8.negate(dz)))
    column, row = _clamp_to(mirror, column, row)
    d = _mirror_distance(alpha, depth, mirror, column, row, p)
    column, row = _project(mirror, _end(p, d, _load3(s, RX, RY, RZ)))
    column, row = _clamp_to(mirror, column, row)
    d = _mirror_distance(alpha, depth, mirror, column, row, p)
    for tap in range(count):
        t = tap * LANES
        column, row = _project(mirror, _end(p, d, _load3(s, RX + t, RY + t, RZ + t)))
        column, row = _clamp_to(mirror, column, row)
        v8.store(s, MIRROR_C + t, column)
        v8.store(s, MIRROR_R + t, row)


@inner()
def _level(s, sizes):
    """Return the mip level whose pixels are as wide as the spacing of a pixel's three look-ups."""
    c = v8.load(s, MIRROR_C)
    r = v8.load(s, MIRROR_R)
    x1 = v8.load(s, MIRROR_C + U(8)) - c
    y1 = v8.load(s, MIRROR_R + U(8)) - r
    x2 = v8.load(s, MIRROR_C + U(16)) - c
    y2 = v8.load(s, MIRROR_R + U(16)) - r
    total_spacing = v8.sqrt(x1 * x1 + y1 * y1) + v8.sqrt(x2 * x2 + y2 * y2)
    spacing = v8.maximum(v8.splat(HALF) * total_spacing, v8.splat(ONE))
    top = F(np.int32(sizes.shape[0] - 1))
    return v8.maximum(v8.minimum(log2(spacing), v8.splat(top)), v8.splat(ZERO))


@inner()
def _find_in_image(s, d, trust, px, py, alpha, depth, front, medium):
    """Return (column, row, weight) of the image's pixels in which the first ray ends."""
    zero = v8.splat(ZERO)
    ones = v8.splat(ONE)
    solid = v8.splat(SOLID)
    p = (px, py, v8.splat(-medium.height))
    ray = _load3(s, RX, RY, RZ)
    column, row = _project(front, _end(p, d, ray))
    a, z, c, r = _look(alpha, depth, front, column, row)
    new_distance = v8.select(v8.at_least(a, solid), _distance_to_surface(front, z, c, r, p), d)
    finite = v8.at_least(d, zero)
    end = _end(p, v8.select(finite, new_distance, d), ray)
    column, row = _project(front, end)
    a, z, _, _ = _look(alpha, depth, front, column, row)
    ahead = _dot(front.project, 6, end)
    allowed = v8.maximum(v8.splat(F(MATCH_SHARE)) * ahead, v8.splat(F(MATCH_M)))
    is_near = v8.both(v8.at_least(a, solid), v8.greater(allowed, v8.absolute(z - ahead)))
    on_sky = v8.select(v8.at_least(a, solid), zero, ones)
    matches = v8.select(finite, v8.select(is_near, ones, zero), on_sky)
    columns = v8.splat(front.columns)
    rows = v8.splat(front.rows)
    across = v8.minimum(column, columns - column) / columns
    border = v8.minimum(across, v8.minimum(row, rows - row) / rows)
    fade = _clamp(border / v8.splat(F(EDGE)), ZERO, ONE)
    weight = trust * (fade * fade * (v8.splat(F(3)) - (fade + fade)))
    column, row = _clamp_to(front, column, row)
    return column, row, matches * weight


@inner()
def _store_tap(s, tap, share, ray):
    """Store the mirrored ray of one of a pixel's slopes, and its share of the light."""
    t = tap * LANES
    v8.store(s, RX + t, ray[0])
    v8.store(s, RY + t, ray[1])
    v8.store(s, RZ + t, ray[2])
    v8.store(s, SHARE + t, share)


class Pixels(NamedTuple):
    """The pixels to shade."""

    u: np.ndarray  # [W] image coordinates of columns at unit depth, float64
    v: np.ndarray  # [H] image coordinates of rows at unit depth, float64
    axes: np.ndarray  # [3, 3] world_from_camera, float64
    cover: np.ndarray  # [H, W] alpha in front of the water
    bed: np.ndarray  # [4] `scale_and_offset` into the bed's image


class Normals(NamedTuple):
    """The surface's normals, of a wave field."""

    x: np.ndarray  # [H, W]
    y: np.ndarray  # [H, W]
    variance: np.ndarray  # [H, W] slope variance
    smooth_variance: np.float32  # slope variance from which a pixel is rough


class Image(NamedTuple):
    """A flat layer, with a row and a pixel beyond it if a side is 1; empty if there is no layer."""

    # [22]: focal length times the camera's right, down (fx, fy) and forward axes; coefficients of
    # column, row and 1 in the x, y, z of a pixel's ray; cx, cy, width, height.
    view: np.ndarray
    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


class Mips(NamedTuple):
    """Mip levels of a layer."""

    pixels: np.ndarray  # four numbers a pixel, with a row and a pixel beyond them
    sizes: np.ndarray  # [levels, 3] first pixel, width, height


class Rays(NamedTuple):
    """Screen-space reflection."""

    distance: np.ndarray  # [H, W]
    weight: np.ndarray  # [H, W]


class Faces(NamedTuple):
    """A flat cube map with its border."""

    texels: np.ndarray  # four numbers each, with a row and a texel beyond them
    size: np.uint64  # texels along a face


@inner()
def _shade_row(
    i, pixels, normals, bed_image, mirror_image, mips, front_image, rays, sky, water, out
):
    u, v, axes, cover, in_bed = pixels
    bed_right = in_bed[0]
    bed_left = in_bed[1]
    bed_down = in_bed[2]
    bed_top = in_bed[3]
    normal_x, normal_y, variance, smooth_variance = normals
    bed_view, bed_rgb, bed_alpha, bed_depth = bed_image
    mirror_view, mirror_rgb, mirror_alpha, mirror_depth = mirror_image
    front_view, front_rgb, front_alpha, front_depth = front_image
    mirror_mips, mirror_sizes = mips
    front_distance, front_weight = rays
    faces, size = sky
    has_mirror = mirror_alpha.size > 0
    has_front = front_alpha.size > 0
    width = cover.shape[1]
    bed = _view(bed_view)
    mirror = _view(mirror_view)
    front = _view(front_view)
    medium = _medium(water)
    q = np.zeros(2 * STRIP * 10, np.float32)
    s = np.zeros(SCRATCH, np.float32)
    pixel_columns = np.zeros(2 * STRIP, np.int64)
    straight_pixels = np.zeros(2 * STRIP, np.int64)
    starts = np.zeros(24, np.int64)
    smooth_count = U(0)
    rough_count = U(0)
    j = 0
    bx = v[i] * axes[0, 1]
    by = v[i] * axes[1, 1]
    bz = v[i] * axes[2, 1]
    straight_row = np.int64(np.floor((np.float64(i) + 0.5) * bed_down + bed_top))
    row_inside = straight_row >= 0 and straight_row < np.int64(bed.height)
    max_depth = np.float64(F(FARTHEST))
    while True:
        while j < width and smooth_count < U(STRIP) and rough_count < U(STRIP):
            # The order of these sums is that of Camera.ray_directions: the sign has to agree.
            fall = (u[j] * axes[2, 0] + bz) + axes[2, 2]
            if not (fall < 0.0 and cover[i, j] <= F(HIDDEN_COVER)):
                plain_color = medium.airlight if medium.fog_per_m > ZERO else medium.rgb
                is_water = ONE if fall < 0.0 else ZERO
                for c in range(3):
                    out[i, j, c] = is_water * plain_color[c]
                j += 1
                continue
            spread = variance[i, j]
            if spread >= smooth_variance:
                item = LIST + rough_count
                slot = U(STRIP) + rough_count
                rough_count += U(1)
            else:
                item = slot = smooth_count
                smooth_count += U(1)
            q[DX + item] = F((u[j] * axes[0, 0] + bx) + axes[0, 2])
            q[DY + item] = F((u[j] * axes[1, 0] + by) + axes[1, 2])
            q[DZ + item] = F(fall)
            q[ALONG + item] = F(min(np.float64(medium.height) / -fall, max_depth))
            q[NX + item] = normal_x[i, j]
            q[NY + item] = normal_y[i, j]
            q[ROUGH + item] = spread
            q[STRAIGHT_DEPTH + item] = -ONE
            straight_pixels[slot] = 0
            column = np.int64(np.floor((np.float64(j) + 0.5) * bed_right + bed_left))
            if row_inside and column >= 0 and column < np.int64(bed.width):
                pixel = U(straight_row) * bed.width + U(column)
                if bed_alpha[pixel] >= SOLID:
                    straight_pixels[slot] = np.int64(pixel)
                    q[STRAIGHT_DEPTH + item] = max(
                        -bed_depth[pixel] * F(fall) - medium.height, ZERO
                    )
            if has_front:
                d = front_distance[i, j]
                q[DISTANCE + item] = d if d < F(np.inf) else -ONE
                q[RAY_WEIGHT + item] = front_weight[i, j]
            pixel_columns[slot] = j
            j += 1
        # The fuller list comes first, so that lists are short only at a row's end.
        is_rough = rough_count > smooth_count
        count = rough_count if is_rough else smooth_count
        if count == U(0):
            break
        base = U(0)
        start = U(0)
        taps = U(1)
        if is_rough:
            base = LIST
            start = U(STRIP)
            taps = U(3)
            rough_count = U(0)
        else:
            smooth_count = U(0)
        for last in range(count, (count + U(7)) & EIGHTS):  # spare lanes repeat the last pixel
            straight_pixels[start + last] = straight_pixels[start + count - U(1)]
            for line in range(U(10)):
                at = base + line * U(STRIP)
                q[at + last] = q[at + count - U(1)]
        for first in range(U(0), count, LANES):
            at = base + first
            ones = v8.splat(ONE)
            zero = v8.splat(ZERO)
            dx = v8.load(q, DX + at)
            dy = v8.load(q, DY + at)
            dz = v8.load(q, DZ + at)
            along = v8.load(q, ALONG + at)
            px = along * dx
            py = along * dy
            length = _norm(dx, dy, dz)
            inverse = ones / length
            vx = v8.negate(dx) * inverse
            vy = v8.negate(dy) * inverse
            view = vx, vy, v8.negate(dz) * inverse
            near = v8.splat(medium.fog_per_m) * along * length
            nx = v8.load(q, NX + at)
            ny = v8.load(q, NY + at)
            upright = v8.maximum(ones - nx * nx - ny * ny, v8.splat(F(MIN_NORMAL_Z2)))
            upright = ones / v8.sqrt(upright)
            sx = nx * upright
            sy = ny * upright
            normal, c, inside, share, ray = _facet(sx, sy, view, medium)
            # Light from below, through the surface.
            deep = _splat3(medium.rgb)
            if medium.fog_per_m > ZERO:
                deep = _blend3(_exponential(near), deep, _splat3(medium.airlight))
            below = deep
            straight_depth = v8.load(q, STRAIGHT_DEPTH + at)
            bends = medium.index != ONE
            tx = zero
            ty = zero
            steep = ones / view[2]
            if bends:
                tx, ty, steep = _refract(normal, c, inside, view, medium)
            thick = straight_depth * steep * v8.splat(medium.min_extinction)
            shows_bed = v8.both(
                v8.at_least(straight_depth, zero),
                v8.greater(v8.splat(medium.max_optical_depth), thick),
            )
            if _any(shows_bed):
                is_found = zero
                depth = straight_depth
                colors = (zero, zero, zero, zero)
                if bends:
                    depth, column, row, is_found = _search_bed(
                        v8.select(shows_bed, ones, zero),
                        straight_depth,
                        px,
                        py,
                        tx,
                        ty,
                        bed_alpha,
                        bed_depth,
                        bed,
                        medium,
                    )
                    colors = _fetch(starts, column, row, bed_rgb, bed_alpha, bed)
                    is_found = v8.select(v8.at_least(colors[3], v8.splat(SOLID)), is_found, zero)
                v8.store(s, FOUND, is_found)
                r, g, b, a = colors
                if _any(v8.both(shows_bed, v8.greater(v8.splat(HALF), is_found))):
                    depth, r, g, b, a = _use_straight_bed(
                        s, q, straight_pixels, start + first, at, depth, colors, bed_rgb, bed_alpha
                    )
                path = depth * steep
                absorbed = (
                    _absorb(r, a, deep[0], path, medium.extinction[0]),
                    _absorb(g, a, deep[1], path, medium.extinction[1]),
                    _absorb(b, a, deep[2], path, medium.extinction[2]),
                )
                below = _select3(shows_bed, absorbed, deep)
            sum_r, sum_g, sum_b = below
            if bends:
                # Mirrored rays and shares of the slopes.
                if is_rough:
                    share = v8.splat(F(2 / 3)) * share
                _store_tap(s, U(0), share, ray)
                if is_rough:
                    flat = v8.maximum(v8.sqrt(vx * vx + vy * vy), v8.splat(F(1e-12)))
                    spread8 = v8.sqrt(v8.splat(F(3)) * v8.load(q, ROUGH + at)) / flat
                    for tap in range(U(1), U(3)):
                        sign = ONE if tap == U(1) else -ONE
                        offset8 = v8.splat(sign) * spread8
                        _, _, _, share, ray = _facet(
                            sx + offset8 * vx, sy + offset8 * vy, view, medium
                        )
                        _store_tap(s, tap, v8.splat(F(1 / 6)) * share, ray)
                # Reflection of the scene above the water, where the image shows it.
                image = (zero, zero, zero, zero)
                weight = zero
                needs_mirror = has_mirror
                if has_front and not is_rough:
                    column, row, weight = _find_in_image(
                        s,
                        v8.load(q, DISTANCE + at),
                        v8.load(q, RAY_WEIGHT + at),
                        px,
                        py,
                        front_alpha,
                        front_depth,
                        front,
                        medium,
                    )
                    if _any(v8.greater(weight, zero)):
                        image = _fetch(starts, column, row, front_rgb, front_alpha, front)
                    needs_rest = _any(v8.greater(ones - weight, v8.splat(TINY)))
                    needs_mirror = has_mirror and needs_rest
                if needs_mirror:
                    _find_in_mirror(
                        s, taps, dx, dy, dz, px, py, mirror_alpha, mirror_depth, mirror, medium
                    )
                if needs_mirror and is_rough:
                    _choose_levels(s, starts, _level(s, mirror_sizes), mirror_sizes)
                for tap in range(taps):
                    t8 = tap * LANES
                    reflected = zero, zero, zero, zero
                    if needs_mirror:
                        column = v8.load(s, MIRROR_C + t8)
                        row = v8.load(s, MIRROR_R + t8)
                        if is_rough:
                            lower = _fetch_level(s, starts, LOWER, column, row, mirror_mips)
                            upper = _fetch_level(s, starts, UPPER, column, row, mirror_mips)
                            reflected = _blend4(v8.load(s, SHARE_ABOVE), upper, lower)
                        else:
                            reflected = _fetch(
                                starts, column, row, mirror_rgb, mirror_alpha, mirror
                            )
                    if has_front:
                        reflected = _blend4(weight, image, reflected)
                    r, g, b, a = reflected
                    transmittance = ones - a
                    shines = v8.greater(transmittance, v8.splat(F(FAINT)))
                    inverse_alpha = ones / v8.maximum(a, v8.splat(HALF))
                    color = r * inverse_alpha, g * inverse_alpha, b * inverse_alpha
                    if _any(shines):
                        rx, ry, rz = _load3(s, RX + t8, RY + t8, RZ + t8)
                        behind = _sky(starts, faces, size, rx, ry, rz, near, medium)
                        before = (
                            r + transmittance * behind[0],
                            g + transmittance * behind[1],
                            b + transmittance * behind[2],
                        )
                        color = _select3(shines, before, color)
                    share = v8.load(s, SHARE + t8)
                    sum_r = sum_r + share * (color[0] - below[0])
                    sum_g = sum_g + share * (color[1] - below[1])
                    sum_b = sum_b + share * (color[2] - below[2])
            v8.store(s, R, sum_r)
            v8.store(s, G, sum_g)
            v8.store(s, B, sum_b)
            for k in range(min(LANES, count - first)):
                pixel = pixel_columns[start + first + k]
                out[i, pixel, 0] = s[R + k]
                out[i, pixel, 1] = s[G + k]
                out[i, pixel, 2] = s[B + k]


@kernel
def shade(pixels, normals, bed, mirror, mips, front, rays, sky, water, out):
    """Write the water's colour at the pixels of a camera into out [H, W, 3].

    front: layer that `rays` were traced through. front and mirror do not count if they are empty.
    water: numbers of `Medium`.
    """
    for i in prange(out.shape[0]):
        # The row is a separate function, because numba compiles the body of a parallel loop many
        # times.
        _shade_row(np.int64(i), pixels, normals, bed, mirror, mips, front, rays, sky, water, out)
