"""Numba kernels for the sky behind the splats, for 8-bit images, and for colours under maps."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import prange
from numba.core import types
from numba.extending import intrinsic

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
    scale = np.float32(faces.shape[1] - 2) * half
    middle = scale + half  # of a face, from the centre of the first texel of its border
    for i in prange(height):
        v = (np.float32(i) + half - cy) * ify
        bx = rotation[0, 1] * v + rotation[0, 2]
        by = rotation[1, 1] * v + rotation[1, 2]
        bz = rotation[2, 1] * v + rotation[2, 2]
        for j in range(width):
            u = (np.float32(j) + half - cx) * ifx
            x = rotation[0, 0] * u + bx
            y = rotation[1, 0] * u + by
            z = rotation[2, 0] * u + bz
            ax, ay, az = abs(x), abs(y), abs(z)
            if ax >= ay and ax >= az:
                major, t = ax, -y
                face = 0 if x >= 0 else 1
                s = -z if x >= 0 else z
            elif ay >= az:
                major, s = ay, x
                face = 2 if y >= 0 else 3
                t = z if y >= 0 else -z
            else:
                major, t = az, -y
                face = 4 if z >= 0 else 5
                s = x if z >= 0 else -x
            inverse = scale / major
            column, row = s * inverse + middle, t * inverse + middle
            c0, r0 = int(column), int(row)
            c1, r1 = c0 + 1, r0 + 1
            fc, fr = column - np.float32(c0), row - np.float32(r0)
            transmittance = one - alpha[i, j]
            visible = one
            gain = np.float32(0)
            if strength >= 0:
                visible = np.float32(0)
                slope = z / math.sqrt(x * x + y * y + z * z)
                if z > 0:
                    visible = math.exp(-strength / slope)
                gain = airlight_gain(slope, gains)
            for c in range(3):
                top = faces[face, r0, c0, c] * (one - fc) + faces[face, r0, c1, c] * fc
                bottom = faces[face, r1, c0, c] * (one - fc) + faces[face, r1, c1, c] * fc
                color = top * (one - fr) + bottom * fr
                air = airlight[c] + gain * varying[c]
                color = visible * color + (one - visible) * air
                out[i, j, c] = rgb[i, j, c] + transmittance * color


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
        for j in range(rgb.shape[1]):
            r, g, b = rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2]
            rgb[i, j, 0] = m00 * r + m01 * g + m02 * b + m03
            rgb[i, j, 1] = m10 * r + m11 * g + m12 * b + m13
            rgb[i, j, 2] = m20 * r + m21 * g + m22 * b + m23


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
