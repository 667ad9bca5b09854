"""Numba kernels that shade a water surface and composite a flooded view's layers.

`shade` implements `water.shade_water`. It sorts a row's water pixels into a smooth and a rough list
and works on eight pixels at a time: rough ones need three slopes and mip levels, smooth ones the
image itself. Coordinates and colours are vectors of eight; colours are fetched for two pixels at a
time. All is float32 but the rays' directions, whose sign decides where there is water and whose
small downward part the distance to it is divided by. Indices are unsigned, so nothing wraps.
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
# Water that is covered more than HIDDEN_COVER is one colour. Opaque surfaces let up to 4 % through
# (a splat that would bring transmittance to 1e-4 is not blended, whatever is left before it), and
# what shines through them is worth no reflections.
HIDDEN_COVER = 0.95
SOLID_ALPHA = 0.5  # a pixel at least this opaque shows a surface at its depth
MIN_DEPTH = 1e-20  # of what is projected: things behind a camera land far outside its image
FARTHEST = 1e12  # times the eye's distance from the image plane: rays along the water end here
MIN_COSINE = 1e-3  # of rays against the surface, and of reflected ones against the horizon
STEEPEST = 1e-6  # least square of a normal's z
BED_STEPS = 2  # corrections of the bed's depth where a refracted ray meets it,
SETTLED_M = 0.01  # unless the last one was smaller
EDGE = 0.04  # share of the image's sides over which what the image shows fades out
MATCH_M = 0.3
MATCH_SHARE = 0.05  # how far beside a surface a ray may end and still show it
FAINT = 1 / 256  # a share of the sky that does not change what it shows through

# ---- Mip levels ----------------------------------------------------------------------------------


@kernel
def pack(rgb, alpha, out):
    """rgb [H, W, 3] and alpha [H, W] side by side in out [H, W, 4]."""
    for i in prange(out.shape[0]):
        for j in range(np.uint64(out.shape[1])):
            for c in range(np.uint64(3)):
                out[i, j, c] = rgb[i, j, c]
            out[i, j, 3] = alpha[i, j]


@kernel
def halve_mip(image, out):
    """Averages over 2 x 2 pixels of image [H, W, 4] into out [h, w, 4]."""
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
    """Vertical part of a pixel's ray, summed in the order of Camera.ray_directions."""
    return (u * rise[0] + v * rise[1]) + rise[2]


@kernel
def find_water(u, v, rise, alpha, shown, water):
    """water [H, W] uint8: 1 where a ray falls and alpha leaves more than half of it, else 0.

    u [W], v [H]: image coordinates at unit depth, float64. rise [3]: world z along the camera's
    axes. shown [H]: the largest share of a falling ray that alpha leaves in each row, 0 where none
    falls.
    """
    for i in prange(alpha.shape[0]):
        most = np.float32(0)
        for j in range(alpha.shape[1]):
            share = np.float32(1) - alpha[i, j]
            share = share if _falls(u[j], v[i], rise) < 0.0 else np.float32(0)
            most = max(most, share)
            water[i, j] = np.uint8(share > np.float32(0.5))
        shown[i] = most


@kernel
def composite_water(u, v, rise, top, left, alpha, color, rgb):
    """rgb += (1 - alpha) color where rays fall. color: [h, w, 3], its corner at row top, column
    left of rgb [H, W, 3]; u, v: of its own columns and rows.
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
def join_depth(alpha, behind_alpha, depth, behind_depth, least):
    """Expected depth of two layers as one: means by weight, into depth [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            share = (np.float32(1) - a) * behind_alpha[i, j]
            total = a * depth[i, j] + share * behind_depth[i, j]
            depth[i, j] = total / max(a + share, least)


@kernel
def join_heavier(alpha, behind_alpha, values, behind):
    """Values of the layer that covers more of a pixel, into values [h, w]."""
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            a = alpha[i, j]
            if (np.float32(1) - a) * behind_alpha[i, j] > a:
                values[i, j] = behind[i, j]


@kernel
def join_alpha(alpha, behind_alpha):
    """alpha [h, w] += (1 - alpha) of the layer behind."""
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
STRIP = 64  # pixels of a list that are worked on at a time
LANES = U(8)
EIGHTS = ~U(7)  # a number's multiple of eight

# Lines of a list, one number a pixel: the ray and how far the water is along it, the surface's
# normal and slope variance, the depth of the bed straight behind (-1: none), the screen-space ray's
# length and weight.
DX, DY, DZ, ALONG, NX, NY, ROUGH, OWN_DEPTH, DISTANCE, TRUST = (U(STRIP * k) for k in range(10))
LIST = U(STRIP * 10)

# Lines of the scratch memory. A colour; was the bed found and how deep; two mip levels; for each of
# three slopes the mirrored ray, its share of the light and its place in the mirror.
R, G, B, A, FOUND, DEPTH, SHARE_ABOVE = (U(8 * k) for k in range(7))
LOW, WIDE, HIGH, SCALE = (U(56 + 16 * k) for k in range(4))
RX, RY, RZ, SHARE, MIRROR_C, MIRROR_R = (U(120 + 24 * k) for k in range(6))
SCRATCH = 120 + 24 * 6
# Where flat images begin, of eight pixels each: two mip levels, and 0.
LOWER = U(0)
UPPER = U(8)
WHOLE = U(16)


class View(NamedTuple):
    """A layer's camera, unpacked from an array by `_view`: counting references to arrays would take
    longer than the arithmetic.

    project: focal length times the camera's right, down (fx, fy) and forward axes. rays:
    coefficients of column, row and 1 in the x, y, z of a pixel's ray. columns, rows: the image's
    sides as real numbers.
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
    """The water and the fog over it.

    height: of the eye over the water. fog_per_m: optical depth between eye and water per metre of
    the ray, 0 without fog. fog_above: from the water straight up, < 0 where the sky is seen
    clearly (or replaced by the airlight already). opaque: optical depth of the water from which no
    bed is looked for. least_extinction: of the three.
    """

    height: np.float32
    index: np.float32
    schlick: bool
    extinction: tuple[np.float32, ...]
    rgb: tuple[np.float32, ...]
    fog_per_m: np.float32
    fog_above: np.float32
    airlight: tuple[np.float32, ...]
    opaque: np.float32
    least_extinction: np.float32


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
    least = min(n[3], min(n[4], n[5]))
    return Medium(n[0], n[1], n[2] > ZERO, extinction, rgb, n[9], n[10], airlight, n[14], least)


def _shuffled(builder, left, right, order):
    lanes = ir.VectorType(ir.IntType(32), len(order))
    return builder.shuffle_vector(left, right, ir.Constant(lanes, order))


def _squares(context, builder, sig, args):
    """Of a bilinear look-up's arguments: the images' data, then, as vectors of eight, the indices
    of the upper and lower left pixels, ways right and down from them and what is left of 1.
    """
    *arrays, firsts, start, row, column, width, across, down = zip(sig.args, args, strict=True)
    data = [context.make_array(kind)(context, builder, array).data for kind, array in arrays]
    kind, array = firsts
    number, wide = (ir.VectorType(ir.IntType(bits), v8.LANES) for bits in (32, 64))
    at = builder.gep(context.make_array(kind)(context, builder, array).data, [start[1]])
    first = builder.load(builder.bitcast(at, wide.as_pointer()), align=8)
    r, c, w = (builder.zext(builder.fptosi(v, number), wide) for _, v in (row, column, width))
    above = builder.add(first, builder.add(builder.mul(r, w), c))
    one = ir.Constant(across[1].type, [1.0] * v8.LANES)
    rest = [builder.fsub(one, v) for _, v in (across, down)]
    return data, above, builder.add(above, w), across[1], down[1], *rest


def _pointer_to(builder, data, indices, lane, stride, count):
    wide = ir.IntType(64)
    lanes = ir.VectorType(ir.FloatType(), count)
    at = builder.mul(builder.extract_element(indices, ir.IntType(32)(lane)), wide(stride))
    return builder.gep(data, [at]), lanes.as_pointer()


def _channels(context, builder, sig, fours):
    """Four channels of eight pixels, from vectors of two pixels' four channels each."""
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
    """Bilinear from a flat image of four channels, for eight pixels: four vectors.

    firsts[start:]: the first texels of eight images in it. row, column: whole; width: of the
    images; across, down: the way from there.
    """

    def codegen(context, builder, sig, args):
        (data,), above, below, right, down, left, up = _squares(context, builder, sig, args)
        fours = []
        for lane in range(0, v8.LANES, 2):

            def pairs(indices, lane=lane):
                """A texel and the next one, of this lane and the next one."""
                found = []
                for k in (lane, lane + 1):
                    at, kind = _pointer_to(builder, data, indices, k, 4, 8)
                    found.append(builder.load(builder.bitcast(at, kind), align=4))
                return _shuffled(builder, *found, [*range(16)])

            own = [lane] * 8 + [lane + 1] * 8
            both = []
            for indices, share in ((above, up), (below, down)):
                both.append(builder.fmul(pairs(indices), _shuffled(builder, share, share, own)))
            order = [k + side for k in (lane, lane + 1) for side in (0, 8) for _ in range(4)]
            total = builder.fmul(builder.fadd(*both), _shuffled(builder, left, right, order))
            sides = [[*range(n, n + 4), *range(n + 8, n + 12)] for n in (0, 4)]
            fours.append(builder.fadd(*(_shuffled(builder, total, total, n) for n in sides)))
        return _channels(context, builder, sig, fours)

    result = types.UniTuple(v8.float8, 4)
    return result(image, firsts, types.uint64, *[v8.float8] * 5), codegen


@intrinsic
def _colors(typingctx, rgb, alpha, firsts, start, row, column, width, across, down):
    """As `_texels`, from a flat image of three channels and one of alpha."""

    def codegen(context, builder, sig, args):
        found = _squares(context, builder, sig, args)
        (rgb, alpha), above, below, right, down, left, up = found
        fours = []
        for lane in range(0, v8.LANES, 2):

            def pairs(indices, lane=lane):
                """rgb, rgb of a pixel and the next one and their alphas, of two lanes."""
                found = []
                for k in (lane, lane + 1):
                    at, kind = _pointer_to(builder, rgb, indices, k, 3, 4)
                    first = builder.load(builder.bitcast(at, kind), align=4)
                    at = builder.gep(at, [ir.IntType(64)(4)])
                    rest, kind = _pointer_to(builder, alpha, indices, k, 1, 2)
                    ends = [builder.load(builder.bitcast(p, kind), align=4) for p in (at, rest)]
                    last = _shuffled(builder, *ends, [*range(4)])
                    found.append(_shuffled(builder, first, last, [*range(8)]))
                return _shuffled(builder, *found, [*range(16)])

            order = [k + 8 * (n in (3, 4, 5, 7)) for k in (lane, lane + 1) for n in range(8)]
            sides = [[0, 1, 2, 6, 8, 9, 10, 14], [3, 4, 5, 7, 11, 12, 13, 15]]
            sums = []
            for indices, share in ((above, up), (below, down)):
                weights = [builder.fmul(side, share) for side in (left, right)]
                shown = builder.fmul(pairs(indices), _shuffled(builder, *weights, order))
                sums.append(builder.fadd(*(_shuffled(builder, shown, shown, n) for n in sides)))
            fours.append(builder.fadd(*sums))
        return _channels(context, builder, sig, fours)

    result = types.UniTuple(v8.float8, 4)
    return result(rgb, alpha, firsts, types.uint64, *[v8.float8] * 5), codegen


@intrinsic
def _pixels(typingctx, alpha, depth, row, column, width):
    """Two flat images at eight whole rows and columns inside them."""

    def codegen(context, builder, sig, args):
        number = ir.IntType(32)
        wide = ir.IntType(64)
        whole = ir.VectorType(number, v8.LANES)
        rows, columns = (builder.fptosi(arg, whole) for arg in args[2:4])
        found = [ir.Constant(ir.VectorType(ir.FloatType(), v8.LANES), ir.Undefined)] * 2
        arrays = [
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(sig.args[:2], args[:2], strict=True)
        ]
        for lane in range(v8.LANES):
            r, c = (builder.extract_element(part, number(lane)) for part in (rows, columns))
            at = builder.add(builder.mul(builder.zext(r, wide), args[4]), builder.zext(c, wide))
            for k, array in enumerate(arrays):
                value = builder.load(builder.gep(array, [at]))
                found[k] = builder.insert_element(found[k], value, number(lane))
        return context.make_tuple(builder, sig.return_type, found)

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
    """t a + (1 - t) b of two colours."""
    rest = v8.splat(ONE) - t
    return t * a[0] + rest * b[0], t * a[1] + rest * b[1], t * a[2] + rest * b[2]


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
    """exp(-x) for x >= 0."""
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
    """Alpha and depth of the nearest pixels inside, and their centres."""
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
def _way(view, z, column, row, p):
    """How far the points that pixels show (relative to the layer's eye) are from others."""
    x = z * _ray_part(view, 0, column, row) - p[0]
    y = z * _ray_part(view, 3, column, row) - p[1]
    z = z * _ray_part(view, 6, column, row) - p[2]
    return _norm(x, y, z)


@inner()
def _end(p, distance, ray):
    """Where rays end, and their directions where that is nowhere (a distance < 0)."""
    met = v8.at_least(distance, v8.splat(ZERO))
    ends = p[0] + distance * ray[0], p[1] + distance * ray[1], p[2] + distance * ray[2]
    return _select3(met, ends, ray)


@inner()
def _place(column, row, columns, rows):
    """The first of the four pixels round coordinates, row and column, and the way right and down.

    columns, rows: the image's sides, vectors. On the last pixels the way is 1, from those before.
    """
    half = v8.splat(HALF)
    one = v8.splat(ONE)
    two = v8.splat(F(2))
    zero = v8.splat(ZERO)
    x = v8.minimum(v8.maximum(column - half, zero), columns - one)
    y = v8.minimum(v8.maximum(row - half, zero), rows - one)
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
    return _colors(rgb, alpha, starts, WHOLE, r0, c0, columns, across, down)


@inner()
def _choose_levels(s, starts, level, sizes):
    """The two mip levels round real ones: first pixels, sizes, scales of coordinates."""
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
    """Colours and alphas from one of the chosen levels; second: LANES for the upper one."""
    scale = v8.load(s, SCALE + second)
    wide = v8.load(s, WIDE + second)
    high = v8.load(s, HIGH + second)
    r0, c0, across, down = _place(column * scale, row * scale, wide, high)
    return _texels(mips, starts, second, r0, c0, wide, across, down)


@inner()
def _sky(starts, faces, size, x, y, z, near, medium):
    """Colours of a flat, bordered cube map in directions that climb, behind fog."""
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
    r, g, b, _ = _texels(faces, starts, WHOLE, r0 + face * side, c0, side, across, down)
    seen = r, g, b
    if medium.fog_above >= ZERO:
        t = _exponential(near + v8.splat(medium.fog_above) / z)
        seen = _blend3(t, seen, _splat3(medium.airlight))
    return seen


@inner()
def _reflectance(c, inside, medium):
    """Share of reflected light. c, inside: cosines in the air and in the water."""
    one = v8.splat(ONE)
    n = v8.splat(medium.index)
    if medium.schlick:
        base = (n - one) / (n + one)
        base = base * base
        x = one - c
        return base + (one - base) * ((x * x) * (x * x) * x)
    a = c - n * inside
    b = c + n * inside
    d = n * c - inside
    e = n * c + inside
    quotient = one / (b * e)
    rs = a * e * quotient
    rp = d * b * quotient
    return v8.splat(HALF) * (rs * rs + rp * rp)


@inner()
def _facet(sx, sy, view, medium):
    """Facets with these slopes, seen from unit `view`: (normals, cosines in air and water,
    reflected share, mirrored rays).
    """
    one = v8.splat(ONE)
    least = v8.splat(F(MIN_COSINE))
    vx, vy, vz = view
    nz = one / v8.sqrt(sx * sx + sy * sy + one)
    nx = sx * nz
    ny = sy * nz
    cosine = nx * vx + ny * vy + nz * vz
    c = v8.minimum(v8.maximum(cosine, least), one)
    inverse = v8.splat(ONE / medium.index)
    inside = v8.sqrt(v8.maximum(one - (one - c * c) * inverse * inverse, v8.splat(ZERO)))
    twice = cosine + cosine
    x = twice * nx - vx
    y = twice * ny - vy
    z = v8.maximum(twice * nz - vz, least)
    unit = one / _norm(x, y, z)
    share = _reflectance(c, inside, medium)
    return (nx, ny, nz), c, inside, share, (x * unit, y * unit, z * unit)


@inner()
def _refract(normal, c, inside, view, medium):
    """Refracted rays per metre of depth, and their length per metre."""
    one = v8.splat(ONE)
    ratio = v8.splat(ONE / medium.index)
    bend = c * ratio - inside
    x = bend * normal[0] - view[0] * ratio
    y = bend * normal[1] - view[1] * ratio
    z = v8.maximum(view[2] * ratio - bend * normal[2], v8.splat(F(MIN_COSINE)))
    steep = one / z
    return x * steep, y * steep, _norm(x, y, z) * steep


@inner()
def _place_on_bed(px, py, tx, ty, depth, bed, medium):
    below = px + depth * tx, py + depth * ty, v8.splat(-medium.height) - depth
    column, row = _project(bed, below)
    return column, row, _is_inside(bed, column, row)


@inner()
def _search_bed(found, depth, px, py, tx, ty, alpha, depths, bed, medium):
    """Where refracted rays meet the bed: its depth and its place in the bed's image; 1 where they
    do, else 0.
    """
    zero = v8.splat(ZERO)
    one = v8.splat(ONE)
    going = found
    for _ in range(BED_STEPS):
        goes = v8.greater(going, zero)
        if not _any(goes):
            break
        column, row, inside = _place_on_bed(px, py, tx, ty, depth, bed, medium)
        a, z, column, row = _look(alpha, depths, bed, column, row)
        met = v8.select(v8.both(inside, v8.at_least(a, v8.splat(SOLID))), one, zero)
        found = v8.select(goes, v8.minimum(found, met), found)
        going = v8.minimum(going, met)
        better = v8.splat(-medium.height) - z * _ray_part(bed, 6, column, row)
        better = v8.select(v8.greater(going, zero), v8.maximum(better, zero), depth)
        moved = v8.greater(v8.absolute(better - depth), v8.splat(F(SETTLED_M)))
        going = v8.select(moved, going, zero)
        depth = better
    column, row, inside = _place_on_bed(px, py, tx, ty, depth, bed, medium)
    return depth, column, row, v8.select(inside, found, zero)


@inner()
def _own_bed(s, q, own, place, at, depth, colors, rgb, alpha):
    """The bed straight behind the pixel where the other one's FOUND is 0: its depth and colour."""
    r, g, b, a = colors
    v8.store(s, DEPTH, depth)
    v8.store(s, R, r)
    v8.store(s, G, g)
    v8.store(s, B, b)
    v8.store(s, A, a)
    for k in range(LANES):
        if s[FOUND + k] == ZERO:
            pixel = U(own[place + k])
            s[R + k] = rgb[U(3) * pixel]
            s[G + k] = rgb[U(3) * pixel + U(1)]
            s[B + k] = rgb[U(3) * pixel + U(2)]
            s[A + k] = alpha[pixel]
            s[DEPTH + k] = q[OWN_DEPTH + at + k]
    return v8.load(s, DEPTH), v8.load(s, R), v8.load(s, G), v8.load(s, B), v8.load(s, A)


@inner()
def _absorb(seen, alpha, water, length, extinction):
    one = v8.splat(ONE)
    t = _exponential(length * v8.splat(extinction))
    return t * (seen + (one - alpha) * water) + (one - t) * water


@inner()
def _mirror_distance(alpha, depth, mirror, column, row, p):
    """From the surface to what the mirrored layer shows, -1 where that is nothing."""
    a, z, column, row = _look(alpha, depth, mirror, column, row)
    way = _way(mirror, z, column, row, p)
    return v8.select(v8.at_least(a, v8.splat(SOLID)), way, v8.splat(-ONE))


@inner()
def _find_in_mirror(s, count, dx, dy, dz, px, py, alpha, depth, mirror, medium):
    """MIRROR_C, MIRROR_R: where the reflected rays end in the mirrored layer."""
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
    """Mip level whose pixels are as wide as a pixel's three places lie apart."""
    c = v8.load(s, MIRROR_C)
    r = v8.load(s, MIRROR_R)
    x1 = v8.load(s, MIRROR_C + U(8)) - c
    y1 = v8.load(s, MIRROR_R + U(8)) - r
    x2 = v8.load(s, MIRROR_C + U(16)) - c
    y2 = v8.load(s, MIRROR_R + U(16)) - r
    apart = v8.sqrt(x1 * x1 + y1 * y1) + v8.sqrt(x2 * x2 + y2 * y2)
    spacing = v8.maximum(v8.splat(HALF) * apart, v8.splat(ONE))
    top = F(np.int32(sizes.shape[0] - 1))
    return v8.maximum(v8.minimum(log2(spacing), v8.splat(top)), v8.splat(ZERO))


@inner()
def _find_in_image(s, d, trust, px, py, alpha, depth, front, medium):
    """(column, row, weight) of the image's pixels in which the first ray ends."""
    zero = v8.splat(ZERO)
    one = v8.splat(ONE)
    solid = v8.splat(SOLID)
    p = (px, py, v8.splat(-medium.height))
    ray = _load3(s, RX, RY, RZ)
    column, row = _project(front, _end(p, d, ray))
    a, z, c, r = _look(alpha, depth, front, column, row)
    better = v8.select(v8.at_least(a, solid), _way(front, z, c, r, p), d)
    finite = v8.at_least(d, zero)
    end = _end(p, v8.select(finite, better, d), ray)
    column, row = _project(front, end)
    a, z, _, _ = _look(alpha, depth, front, column, row)
    ahead = _dot(front.project, 6, end)
    allowed = v8.maximum(v8.splat(F(MATCH_SHARE)) * ahead, v8.splat(F(MATCH_M)))
    near = v8.both(v8.at_least(a, solid), v8.greater(allowed, v8.absolute(z - ahead)))
    on_sky = v8.select(v8.at_least(a, solid), zero, one)
    seen = v8.select(finite, v8.select(near, one, zero), on_sky)
    columns = v8.splat(front.columns)
    rows = v8.splat(front.rows)
    across = v8.minimum(column, columns - column) / columns
    border = v8.minimum(across, v8.minimum(row, rows - row) / rows)
    fade = _clamp(border / v8.splat(F(EDGE)), ZERO, ONE)
    weight = trust * (fade * fade * (v8.splat(F(3)) - (fade + fade)))
    column, row = _clamp_to(front, column, row)
    return column, row, seen * weight


@inner()
def _store_tap(s, tap, share, ray):
    """The mirrored ray of one of a pixel's slopes, and its share of the light."""
    t = tap * LANES
    v8.store(s, RX + t, ray[0])
    v8.store(s, RY + t, ray[1])
    v8.store(s, RZ + t, ray[2])
    v8.store(s, SHARE + t, share)


class Pixels(NamedTuple):
    """u [W], v [H]: image coordinates at unit depth. axes [3, 3]: world_from_camera; all float64.
    cover [H, W]: alpha before the water. bed: places_in the bed's image.
    """

    u: np.ndarray
    v: np.ndarray
    axes: np.ndarray
    cover: np.ndarray
    bed: np.ndarray


class Normals(NamedTuple):
    """Of a wave field. smooth_variance: slope variance from which a pixel is rough."""

    x: np.ndarray
    y: np.ndarray
    variance: np.ndarray
    smooth_variance: np.float32


class Image(NamedTuple):
    """A layer, flat, with a row and a pixel beyond it where a side is 1; empty where there is none.
    view [22]: focal length times the camera's right, down (fx, fy) and forward axes; coefficients
    of column, row and 1 in the x, y, z of a pixel's ray; cx, cy, width, height.
    """

    view: np.ndarray
    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


class Mips(NamedTuple):
    """Mip levels, four numbers a pixel, and a row and a pixel beyond them. sizes [levels, 3]: their
    first pixels, widths, heights.
    """

    pixels: np.ndarray
    sizes: np.ndarray


class Rays(NamedTuple):
    """Of the screen-space reflection: [H, W]."""

    distance: np.ndarray
    weight: np.ndarray


class Faces(NamedTuple):
    """A flat cube map with its border, `size` squared texels a face, four numbers each; a row and a
    texel beyond them.
    """

    texels: np.ndarray
    size: np.uint64


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
    places = np.zeros(2 * STRIP, np.int64)
    own = np.zeros(2 * STRIP, np.int64)
    starts = np.zeros(24, np.int64)
    smooth_count = U(0)
    rough_count = U(0)
    j = 0
    bx = v[i] * axes[0, 1]
    by = v[i] * axes[1, 1]
    bz = v[i] * axes[2, 1]
    own_row = np.int64(np.floor((np.float64(i) + 0.5) * bed_down + bed_top))
    row_inside = own_row >= 0 and own_row < np.int64(bed.height)
    far = np.float64(F(FARTHEST))
    while True:
        while j < width and smooth_count < U(STRIP) and rough_count < U(STRIP):
            # The order of these sums is that of Camera.ray_directions: the sign has to agree.
            fall = (u[j] * axes[2, 0] + bz) + axes[2, 2]
            if not (fall < 0.0 and cover[i, j] <= F(HIDDEN_COVER)):
                plain = medium.airlight if medium.fog_per_m > ZERO else medium.rgb
                met = ONE if fall < 0.0 else ZERO
                for c in range(3):
                    out[i, j, c] = met * plain[c]
                j += 1
                continue
            spread = variance[i, j]
            if spread >= smooth_variance:
                n = LIST + rough_count
                p = U(STRIP) + rough_count
                rough_count += U(1)
            else:
                n = p = smooth_count
                smooth_count += U(1)
            q[DX + n] = F((u[j] * axes[0, 0] + bx) + axes[0, 2])
            q[DY + n] = F((u[j] * axes[1, 0] + by) + axes[1, 2])
            q[DZ + n] = F(fall)
            q[ALONG + n] = F(min(np.float64(medium.height) / -fall, far))
            q[NX + n] = normal_x[i, j]
            q[NY + n] = normal_y[i, j]
            q[ROUGH + n] = spread
            q[OWN_DEPTH + n] = -ONE
            own[p] = 0
            column = np.int64(np.floor((np.float64(j) + 0.5) * bed_right + bed_left))
            if row_inside and column >= 0 and column < np.int64(bed.width):
                pixel = U(own_row) * bed.width + U(column)
                if bed_alpha[pixel] >= SOLID:
                    own[p] = np.int64(pixel)
                    q[OWN_DEPTH + n] = max(-bed_depth[pixel] * F(fall) - medium.height, ZERO)
            if has_front:
                d = front_distance[i, j]
                q[DISTANCE + n] = d if d < F(np.inf) else -ONE
                q[TRUST + n] = front_weight[i, j]
            places[p] = j
            j += 1
        # The fuller list first, so that lists are short at a row's end only.
        rough = rough_count > smooth_count
        n = rough_count if rough else smooth_count
        if n == U(0):
            break
        base = U(0)
        start = U(0)
        taps = U(1)
        if rough:
            base = LIST
            start = U(STRIP)
            taps = U(3)
            rough_count = U(0)
        else:
            smooth_count = U(0)
        for last in range(n, (n + U(7)) & EIGHTS):  # the last pixel again in lanes left over
            own[start + last] = own[start + n - U(1)]
            for line in range(U(10)):
                at = base + line * U(STRIP)
                q[at + last] = q[at + n - U(1)]
        for first in range(U(0), n, LANES):
            at = base + first
            one = v8.splat(ONE)
            zero = v8.splat(ZERO)
            dx = v8.load(q, DX + at)
            dy = v8.load(q, DY + at)
            dz = v8.load(q, DZ + at)
            along = v8.load(q, ALONG + at)
            px = along * dx
            py = along * dy
            length = _norm(dx, dy, dz)
            inverse = one / length
            vx = v8.negate(dx) * inverse
            vy = v8.negate(dy) * inverse
            view = vx, vy, v8.negate(dz) * inverse
            near = v8.splat(medium.fog_per_m) * along * length
            nx = v8.load(q, NX + at)
            ny = v8.load(q, NY + at)
            upright = v8.maximum(one - nx * nx - ny * ny, v8.splat(F(STEEPEST)))
            upright = one / v8.sqrt(upright)
            sx = nx * upright
            sy = ny * upright
            normal, c, inside, share, ray = _facet(sx, sy, view, medium)
            # Through the surface.
            deep = _splat3(medium.rgb)
            if medium.fog_per_m > ZERO:
                deep = _blend3(_exponential(near), deep, _splat3(medium.airlight))
            below = deep
            own_depth = v8.load(q, OWN_DEPTH + at)
            bends = medium.index != ONE
            tx = zero
            ty = zero
            steep = one / view[2]
            if bends:
                tx, ty, steep = _refract(normal, c, inside, view, medium)
            thick = own_depth * steep * v8.splat(medium.least_extinction)
            clear = v8.both(
                v8.at_least(own_depth, zero), v8.greater(v8.splat(medium.opaque), thick)
            )
            if _any(clear):
                found = zero
                depth = own_depth
                colors = (zero, zero, zero, zero)
                if bends:
                    depth, column, row, found = _search_bed(
                        v8.select(clear, one, zero),
                        own_depth,
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
                    found = v8.select(v8.at_least(colors[3], v8.splat(SOLID)), found, zero)
                v8.store(s, FOUND, found)
                r, g, b, a = colors
                if _any(v8.both(clear, v8.greater(v8.splat(HALF), found))):
                    depth, r, g, b, a = _own_bed(
                        s, q, own, start + first, at, depth, colors, bed_rgb, bed_alpha
                    )
                way = depth * steep
                absorbed = (
                    _absorb(r, a, deep[0], way, medium.extinction[0]),
                    _absorb(g, a, deep[1], way, medium.extinction[1]),
                    _absorb(b, a, deep[2], way, medium.extinction[2]),
                )
                below = _select3(clear, absorbed, deep)
            sum_r, sum_g, sum_b = below
            if bends:
                # Mirrored rays and shares of the slopes.
                if rough:
                    share = v8.splat(F(2 / 3)) * share
                _store_tap(s, U(0), share, ray)
                if rough:
                    flat = v8.maximum(v8.sqrt(vx * vx + vy * vy), v8.splat(F(1e-12)))
                    spread8 = v8.sqrt(v8.splat(F(3)) * v8.load(q, ROUGH + at)) / flat
                    for tap in range(U(1), U(3)):
                        sign = ONE if tap == U(1) else -ONE
                        offset8 = v8.splat(sign) * spread8
                        _, _, _, share, ray = _facet(
                            sx + offset8 * vx, sy + offset8 * vy, view, medium
                        )
                        _store_tap(s, tap, v8.splat(F(1 / 6)) * share, ray)
                # What stands above the water, where the image shows it.
                image = (zero, zero, zero, zero)
                weight = zero
                needs_mirror = has_mirror
                if has_front and not rough:
                    column, row, weight = _find_in_image(
                        s,
                        v8.load(q, DISTANCE + at),
                        v8.load(q, TRUST + at),
                        px,
                        py,
                        front_alpha,
                        front_depth,
                        front,
                        medium,
                    )
                    if _any(v8.greater(weight, zero)):
                        image = _fetch(starts, column, row, front_rgb, front_alpha, front)
                    rest = _any(v8.greater(one - weight, v8.splat(TINY)))
                    needs_mirror = has_mirror and rest
                if needs_mirror:
                    _find_in_mirror(
                        s, taps, dx, dy, dz, px, py, mirror_alpha, mirror_depth, mirror, medium
                    )
                if needs_mirror and rough:
                    _choose_levels(s, starts, _level(s, mirror_sizes), mirror_sizes)
                for tap in range(taps):
                    t8 = tap * LANES
                    seen = zero, zero, zero, zero
                    if needs_mirror:
                        column = v8.load(s, MIRROR_C + t8)
                        row = v8.load(s, MIRROR_R + t8)
                        if rough:
                            lower = _fetch_level(s, starts, LOWER, column, row, mirror_mips)
                            upper = _fetch_level(s, starts, UPPER, column, row, mirror_mips)
                            seen = _blend4(v8.load(s, SHARE_ABOVE), upper, lower)
                        else:
                            seen = _fetch(starts, column, row, mirror_rgb, mirror_alpha, mirror)
                    if has_front:
                        seen = _blend4(weight, image, seen)
                    r, g, b, a = seen
                    transmittance = one - a
                    shines = v8.greater(transmittance, v8.splat(F(FAINT)))
                    whole = one / v8.maximum(a, v8.splat(HALF))
                    color = r * whole, g * whole, b * whole
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
            for k in range(min(LANES, n - first)):
                pixel = places[start + first + k]
                out[i, pixel, 0] = s[R + k]
                out[i, pixel, 1] = s[G + k]
                out[i, pixel, 2] = s[B + k]


@kernel
def shade(pixels, normals, bed, mirror, mips, front, rays, sky, water, out):
    """Water of the pixels of a camera into out [H, W, 3]. front: what `rays` run through; only one
    that is not empty counts, as of the mirror. water: numbers of `Medium`.
    """
    for i in prange(out.shape[0]):
        # A function of its own: numba compiles what stands in a parallel loop many times over.
        _shade_row(np.int64(i), pixels, normals, bed, mirror, mips, front, rays, sky, water, out)
