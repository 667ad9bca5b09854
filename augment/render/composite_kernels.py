"""Numba kernels for the sky behind the splats, for 8-bit images, and for colours under maps."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import prange
from numba.core import types
from numba.extending import intrinsic

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import inner, kernel
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import LANES, U
from augment.render.sh import BLACK, FOLDED

# ---- Numba kernel: finished pixels become opaque (see augment.render.rasterize) ------------------

RUN = 4096  # pixels of a piece of work


@kernel
def renormalise_alpha(alpha, rgb, overlay, least):
    """alpha, overlay: float32 [P]. rgb: [3 P]. rgb, overlay: may be empty. least: of finished."""
    one = np.float32(1)
    for run in prange((alpha.size + RUN - 1) // RUN):
        for pixel in range(run * RUN, min((run + 1) * RUN, alpha.size)):
            if alpha[pixel] >= least:
                scale = one / alpha[pixel]
                alpha[pixel] = one
                if rgb.size > 0:
                    rgb[3 * pixel] *= scale
                    rgb[3 * pixel + 1] *= scale
                    rgb[3 * pixel + 2] *= scale
                if overlay.size > 0:
                    overlay[pixel] *= scale


@inner()
def airlight_gain(slope, gains):
    """What varying airlight is multiplied by, less 1. gains [8]: of augment.render.composite."""
    s, one = abs(slope), np.float32(1)
    p = gains[4] + s * (gains[5] + s * (gains[6] + s * gains[7]))
    p = s * (gains[0] + s * (gains[1] + s * (gains[2] + s * (gains[3] + s * p))))
    return p if slope >= 0 else -p / (one + p)


@inner()
def layered_way(distance, eye, up):
    """Length of fog as dense as at its base with as much in it as a way of this length, which
    begins `eye` scale heights above the base and climbs by `up` (see augment.render.fog).
    """
    half, one, x = np.float32(0.5), np.float32(1), abs(up)
    # Below 0.01 the difference 1 - exp(-x) would lose two digits.
    series = one - half * x * (one - x * np.float32(1 / 3))
    mean = series if x < np.float32(0.01) else (one - math.exp(-x)) / x
    lowest = eye + min(up, np.float32(0))
    return distance * math.exp(min(-lowest, np.float32(MAX_EXPONENT))) * mean


@kernel
def composite_constant(rgb, alpha, color, out):
    """out = rgb + (1 - alpha) color [3]."""
    red, green, blue = color[0], color[1], color[2]
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            share = np.float32(1) - alpha[i, j]
            out[i, j, 0] = rgb[i, j, 0] + share * red
            out[i, j, 1] = rgb[i, j, 1] + share * green
            out[i, j, 2] = rgb[i, j, 2] + share * blue


@kernel
def composite_cubemap(
    rgb, alpha, faces, rotation, ifx, ify, cx, cy, strength, gains, airlight, varying, out
):
    """out = rgb + (1 - alpha) sky of a cube map, through fog where strength >= 0.

    faces: [6, R + 2, R + 2, 3], with a border (augment.sky.with_border). rotation:
    world_from_camera. ifx, ify: 1 / focal length. strength: optical depth straight up. gains:
    as of airlight_gain. airlight [3], varying [3]: of the fog.
    """
    height, width = alpha.shape
    half, one = np.float32(0.5), np.float32(1)
    texels, line = faces.reshape(-1), U(3 * faces.shape[1])
    scale = np.float32(faces.shape[1] - 2) * half
    for i in prange(height):
        places, begins = np.empty(4 * _AHEAD, np.float32), np.empty(_AHEAD, np.uint64)
        v = (np.float32(i) + half - cy) * ify
        bx = rotation[0, 1] * v + rotation[0, 2]
        by = rotation[1, 1] * v + rotation[1, 2]
        bz = rotation[2, 1] * v + rotation[2, 2]
        colors, alphas, target = rgb[i], alpha[i], out[i]
        for first in range(U(0), U(width), U(_AHEAD)):
            if not _shows_sky(alphas, first, min(first + U(_AHEAD), U(width))):
                for j in range(first, min(first + U(_AHEAD), U(width))):
                    for c in range(U(3)):
                        target[j, c] = colors[j, c]
                continue
            for k in range(U(0), U(_AHEAD), U(LANES)):
                u = v8.splat(np.float32(first + k)) + v8.lane_numbers()
                u = (u + v8.splat(half) - v8.splat(cx)) * v8.splat(ifx)
                x = v8.splat(rotation[0, 0]) * u + v8.splat(bx)
                y = v8.splat(rotation[1, 0]) * u + v8.splat(by)
                z = v8.splat(rotation[2, 0]) * u + v8.splat(bz)
                _place_eight(x, y, z, scale, np.float32(faces.shape[1]), places, k)
            count = min(U(_AHEAD), U(width) - first)
            for k in range(count):  # a row of pixels crosses many of texels, each far in memory
                at = U(np.int32(places[k])) * line + U(3) * U(np.int32(places[k + U(_AHEAD)]))
                v8.prefetch(texels, at)
                v8.prefetch(texels, at + line)
                begins[k] = at
            for k in range(count):
                j, at = first + k, begins[k]
                fc, fr = places[k + U(2 * _AHEAD)], places[k + U(3 * _AHEAD)]
                transmittance = one - alphas[j]
                visible, gain = one, np.float32(0)
                if strength >= 0:
                    u = (np.float32(j) + half - cx) * ifx
                    x = rotation[0, 0] * u + bx
                    y = rotation[1, 0] * u + by
                    z = rotation[2, 0] * u + bz
                    visible = np.float32(0)
                    slope = z / math.sqrt(x * x + y * y + z * z)
                    if z > 0:
                        visible = math.exp(-strength / slope)
                    gain = airlight_gain(slope, gains)
                for c in range(U(3)):
                    top = texels[at + c] * (one - fc) + texels[at + U(3) + c] * fc
                    below = at + line + c
                    bottom = texels[below] * (one - fc) + texels[below + U(3)] * fc
                    color = top * (one - fr) + bottom * fr
                    if strength >= 0:
                        air = airlight[c] + gain * varying[c]
                        color = visible * color + (one - visible) * air
                    target[j, c] = colors[j, c] + transmittance * color


@inner()
def _shows_sky(alphas, first, end):
    """Whether anything behind shines through one of the pixels, or might: alpha is NaN."""
    shows = False
    for j in range(first, end):
        shows = shows or alphas[j] != np.float32(1)
    return shows


_AHEAD = 64  # pixels whose places in the cube map are found before they are read


@inner()
def _place_eight(x, y, z, scale, side, places, at):
    """Where eight directions meet a cube map with a border: rows of _AHEAD each of the texel above
    and to the left, its row counted through all faces and its column, and of the parts of a texel
    to the right of its centre and below. scale: half a face in texels. side: with the border.
    """
    zero, half = v8.splat(np.float32(0)), v8.splat(np.float32(0.5))
    ax, ay, az = v8.absolute(x), v8.absolute(y), v8.absolute(z)
    by_x, by_y = v8.both(v8.at_least(ax, ay), v8.at_least(ax, az)), v8.at_least(ay, az)
    right, ahead, up = v8.at_least(x, zero), v8.at_least(y, zero), v8.at_least(z, zero)
    major = v8.select(by_x, ax, v8.select(by_y, ay, az))
    s = v8.select(by_y, x, v8.select(up, x, v8.negate(x)))
    s = v8.select(by_x, v8.select(right, v8.negate(z), z), s)
    t = v8.select(by_y, v8.select(ahead, z, v8.negate(z)), v8.negate(y))
    t = v8.select(by_x, v8.negate(y), t)
    face = v8.select(by_y, _one_of(ahead, 2, 3), _one_of(up, 4, 5))
    face = v8.select(by_x, _one_of(right, 0, 1), face)
    inverse, middle = v8.splat(scale) / major, v8.splat(scale) + half
    column, row = s * inverse + middle, t * inverse + middle
    left, above = v8.floor(column), v8.floor(row)
    v8.store(places, at, face * v8.splat(side) + above)
    v8.store(places, at + U(_AHEAD), left)
    v8.store(places, at + U(2 * _AHEAD), column - left)
    v8.store(places, at + U(3 * _AHEAD), row - above)


@inner()
def _one_of(mask, a, b):
    return v8.select(mask, v8.splat(np.float32(a)), v8.splat(np.float32(b)))


@kernel
def quantise(values, out):
    """uint8 of float32 rows: clamped to [0, 1], times 255, rounded to the nearest."""
    half, top = np.float32(0.5), np.float32(255)
    for i in prange(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j] * top + half
            out[i, j] = np.uint8(min(max(value, np.float32(0)), top))


@kernel
def map_colors(rgb, matrix):
    """Every colour of float32 [H, W, 3] becomes matrix[:, :3] @ colour + matrix[:, 3], in place."""
    m00, m01, m02, m03 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, m12, m13 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, m22, m23 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in prange(rgb.shape[0]):
        row = rgb[i].reshape(-1)
        for j in range(U(0), U(row.size), U(3)):
            r, g, b = row[j], row[j + U(1)], row[j + U(2)]
            row[j] = m00 * r + m01 * g + m02 * b + m03
            row[j + U(1)] = m10 * r + m11 * g + m12 * b + m13
            row[j + U(2)] = m20 * r + m21 * g + m22 * b + m23


# ---- Numba kernel: colour maps folded into spherical harmonics, as fast as memory gives and takes.
# Results go past the cache: a line that is written as a whole need not be read before.

SPLATS = 2048  # of a piece of work
SPLAT_RUN = (
    128  # splats mapped at a time, whose results (24 KB at degree 3) stay in the first cache
)
ALIGNMENT = 4 * LANES  # bytes, of the target


@intrinsic
def _stream(typingctx, source, at, target, to):
    """target[to : to + 8] = source[at : at + 8] past the cache; target + to is aligned."""

    def codegen(context, builder, sig, args):
        vector = ir.VectorType(ir.FloatType(), LANES)

        def pointer(kind, array, index):
            data = context.make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())

        value = builder.load(pointer(sig.args[0], args[0], args[1]), align=4)
        stored = builder.store(value, pointer(sig.args[2], args[2], args[3]), align=ALIGNMENT)
        one = ir.Constant(ir.IntType(32), 1)
        stored.set_metadata("nontemporal", builder.module.add_metadata([one]))
        return context.get_dummy_value()

    return types.void(source, types.uint64, target, types.uint64), codegen


@intrinsic
def _fence(typingctx):
    """Other threads see what was streamed before."""

    def codegen(context, builder, sig, args):
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), codegen


@inner()
def _map_splats(source, at, work, to, count, functions, folded):
    """`count` splats, from source[at:] to work[to:], by one map; see apply.map_sh for `least`."""
    least = BLACK if functions == U(1) else np.float32(-np.inf)
    a0, a1, a2 = folded[0], folded[1], folded[2]
    b0, b1, b2 = folded[3], folded[4], folded[5]
    c0, c1, c2 = folded[6], folded[7], folded[8]
    for i in range(count * functions):
        j, k = at + U(3) * i, to + U(3) * i
        red, green = max(source[j], least), max(source[j + U(1)], least)
        blue = max(source[j + U(2)], least)
        work[k] = a0 * red + a1 * green + a2 * blue
        work[k + U(1)] = b0 * red + b1 * green + b2 * blue
        work[k + U(2)] = c0 * red + c1 * green + c2 * blue
    row = U(3) * functions
    for splat in range(count):
        for channel in range(U(3)):
            work[to + splat * row + channel] += folded[U(9) + channel]


@inner()
def _map_run(source, first, end, work, functions, classes, folded):
    """Splats `first` to `end` into work; neighbours of one class together."""
    row = U(3) * functions
    at = first
    while at < end:
        last, of = end, U(0)
        if classes.size:
            of = U(classes[at])
            last = at + U(1)
            while last < end and U(classes[last]) == of:
                last += U(1)
        to = (at - first) * row
        if folded[of, U(FOLDED - 1)] != np.float32(0):
            _map_splats(source, at * row, work, to, last - at, functions, folded[of])
        else:
            for i in range((last - at) * row):
                work[to + i] = source[at * row + i]
        at = last


@kernel
def map_sh(source, target, functions, classes, folded):
    """target = source with every splat's functions mapped; both float32 [N * K * 3], or one array.

    target: aligned to ALIGNMENT bytes. functions: K. classes: int16 [N], rows of folded, or [0]
    where all splats take the first. folded: float32 [C, FOLDED]; a last number of 0 says that the
    map changes nothing, and the splat's bits are copied.
    """
    row = U(3 * functions)
    count = source.size // (3 * functions)
    for block in prange((count + SPLATS - 1) // SPLATS):
        work = np.empty(SPLAT_RUN * 3 * functions, np.float32)
        end = U(min((block + 1) * SPLATS, count))
        for first in range(U(block * SPLATS), end, U(SPLAT_RUN)):
            last = min(first + U(SPLAT_RUN), end)
            _map_run(source, first, last, work, U(functions), classes, folded)
            size = (last - first) * row
            whole = size - size % U(LANES)
            for i in range(U(0), whole, U(LANES)):
                _stream(work, i, target, first * row + i)
            for i in range(whole, size):
                target[first * row + i] = work[i]
        _fence()
