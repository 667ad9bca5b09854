"""Numba kernels of `composite`: the sky behind the splats, 8-bit images, and colours under maps."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import prange
from numba.core import types
from numba.extending import intrinsic

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import NUM_LANES, Index
from augment.render.sh import BLACK_SH_00, NUM_FOLDED

# ---- Numba kernel: finished pixels become opaque (see augment.render.rasterize) ------------------

# Pixels of a piece of work.
RUN = 4096


@kernel
def renormalise_alpha(alpha, rgb, overlay, min_alpha):
    """Make pixels of alpha >= min_alpha opaque, in place (see `rasterize.renormalise_alpha`).

    Args:
        alpha: float32 [P].
        rgb: float32 [3 P], or empty.
        overlay: float32 [P], or empty.
        min_alpha: smallest alpha of a finished pixel.
    """
    one_f32 = np.float32(1)
    for run in prange((alpha.size + RUN - 1) // RUN):
        for pixel in range(run * RUN, min((run + 1) * RUN, alpha.size)):
            if alpha[pixel] >= min_alpha:
                scale = one_f32 / alpha[pixel]
                alpha[pixel] = one_f32
                if rgb.size > 0:
                    rgb[3 * pixel] *= scale
                    rgb[3 * pixel + 1] *= scale
                    rgb[3 * pixel + 2] *= scale
                if overlay.size > 0:
                    overlay[pixel] *= scale


@kernel_function()
def airlight_gain(slope, gains):
    """Return the factor of varying airlight, minus 1.

    gains [8]: coefficients of `composite.airlight_gains`.
    """
    steepness = abs(slope)
    one_f32 = np.float32(1)
    p = gains[4] + steepness * (gains[5] + steepness * (gains[6] + steepness * gains[7]))
    p = steepness * (
        gains[0]
        + steepness * (gains[1] + steepness * (gains[2] + steepness * (gains[3] + steepness * p)))
    )
    return p if slope >= 0 else -p / (one_f32 + p)


@kernel_function()
def layered_distance(distance, eye, climb):
    """Return the length of a ray in fog of the base's density that holds as much fog
    (augment.render.fog).

    Args:
        distance: length of the ray, metres.
        eye: height of its beginning above the base, scale heights.
        climb: height that it climbs, scale heights.
    """
    half = np.float32(0.5)
    one_f32 = np.float32(1)
    x = abs(climb)
    # Below 0.01 the difference 1 - exp(-x) would lose two digits.
    series = one_f32 - half * x * (one_f32 - x * np.float32(1 / 3))
    mean = series if x < np.float32(0.01) else (one_f32 - math.exp(-x)) / x
    lowest = eye + min(climb, np.float32(0))
    return distance * math.exp(min(-lowest, np.float32(MAX_EXPONENT))) * mean


@kernel
def composite_constant(rgb, alpha, color, out):
    """Write out = rgb + (1 - alpha) color [3]."""
    red = color[0]
    green = color[1]
    blue = color[2]
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            share = np.float32(1) - alpha[i, j]
            out[i, j, 0] = rgb[i, j, 0] + share * red
            out[i, j, 1] = rgb[i, j, 1] + share * green
            out[i, j, 2] = rgb[i, j, 2] + share * blue


@kernel
def composite_cubemap(
    rgb,
    alpha,
    faces,
    rotation,
    ifx,
    ify,
    cx,
    cy,
    vertical_depth,
    gains,
    airlight,
    varying,
    bank_means,
    out,
):
    """Write out = rgb + (1 - alpha) sky of a cube map, through fog if vertical_depth >= 0.

    Args:
        rgb: float32 [H, W, 3].
        alpha: float32 [H, W].
        faces: [6, R + 2, R + 2, 3], with a border (augment.scene.sky.with_border).
        rotation: world_from_camera.
        ifx: 1 / focal length along x, 1/px.
        ify: 1 / focal length along y, 1/px.
        cx: column of the principal point, px.
        cy: row of the principal point, px.
        vertical_depth: optical depth of the fog straight up; negative without fog.
        gains: as in airlight_gain.
        airlight: airlight of the fog at the horizon [3].
        varying: the share of it that varies with elevation [3].
        bank_means: mean density of the fog's banks before the sky [H, W]; [0, 0] without banks.
        out: float32 [H, W, 3].
    """
    height, width = alpha.shape
    half = np.float32(0.5)
    one_f32 = np.float32(1)
    texels = faces.reshape(-1)
    row_stride = Index(3 * faces.shape[1])
    scale = np.float32(faces.shape[1] - 2) * half
    for i in prange(height):
        texel_places = np.empty(4 * _AHEAD, np.float32)
        first_texels = np.empty(_AHEAD, np.uint64)
        v = (np.float32(i) + half - cy) * ify
        bx = rotation[0, 1] * v + rotation[0, 2]
        by = rotation[1, 1] * v + rotation[1, 2]
        bz = rotation[2, 1] * v + rotation[2, 2]
        colors = rgb[i]
        alphas = alpha[i]
        target = out[i]
        # Pixels in runs: runs without sky are copied.
        for first in range(Index(0), Index(width), Index(_AHEAD)):
            if not _shows_sky(alphas, first, min(first + Index(_AHEAD), Index(width))):
                for j in range(first, min(first + Index(_AHEAD), Index(width))):
                    for c in range(Index(3)):
                        target[j, c] = colors[j, c]
                continue
            # Directions of the run's pixels, and their texels.
            for k in range(Index(0), Index(_AHEAD), Index(NUM_LANES)):
                u = v8.broadcast(np.float32(first + k)) + v8.lane_numbers()
                u = (u + v8.broadcast(half) - v8.broadcast(cx)) * v8.broadcast(ifx)
                x = v8.broadcast(rotation[0, 0]) * u + v8.broadcast(bx)
                y = v8.broadcast(rotation[1, 0]) * u + v8.broadcast(by)
                z = v8.broadcast(rotation[2, 0]) * u + v8.broadcast(bz)
                _place_eight(x, y, z, scale, np.float32(faces.shape[1]), texel_places, k)
            count = min(Index(_AHEAD), Index(width) - first)
            # Fetch the texels: a row of pixels crosses many rows of texels, each far in memory.
            for k in range(count):
                texel = Index(np.int32(texel_places[k])) * row_stride + Index(3) * Index(
                    np.int32(texel_places[k + Index(_AHEAD)])
                )
                v8.prefetch(texels, texel)
                v8.prefetch(texels, texel + row_stride)
                first_texels[k] = texel
            # Fog before the sky, and the sky's colour between four texels.
            for k in range(count):
                j = first + k
                texel = first_texels[k]
                fraction_x = texel_places[k + Index(2 * _AHEAD)]
                fraction_y = texel_places[k + Index(3 * _AHEAD)]
                transmittance = one_f32 - alphas[j]
                sky_transmittance = one_f32
                gain = np.float32(0)
                if vertical_depth >= 0:
                    u = (np.float32(j) + half - cx) * ifx
                    x = rotation[0, 0] * u + bx
                    y = rotation[1, 0] * u + by
                    z = rotation[2, 0] * u + bz
                    sky_transmittance = np.float32(0)
                    slope = z / math.sqrt(x * x + y * y + z * z)
                    if z > 0:
                        sky_depth = vertical_depth / slope
                        if bank_means.size > 0:
                            sky_depth *= bank_means[i, j]
                        sky_transmittance = math.exp(-sky_depth)
                    gain = airlight_gain(slope, gains)
                for c in range(Index(3)):
                    top = (
                        texels[texel + c] * (one_f32 - fraction_x)
                        + texels[texel + Index(3) + c] * fraction_x
                    )
                    below = texel + row_stride + c
                    bottom = (
                        texels[below] * (one_f32 - fraction_x)
                        + texels[below + Index(3)] * fraction_x
                    )
                    color = top * (one_f32 - fraction_y) + bottom * fraction_y
                    if vertical_depth >= 0:
                        air = airlight[c] + gain * varying[c]
                        color = sky_transmittance * color + (one_f32 - sky_transmittance) * air
                    target[j, c] = colors[j, c] + transmittance * color


@kernel_function()
def _shows_sky(alphas, first, end):
    """Return True if a pixel lets light from behind through, or may: its alpha is NaN."""
    has_sky = False
    for j in range(first, end):
        has_sky = has_sky or alphas[j] != np.float32(1)
    return has_sky


# Pixels whose texels are computed, and fetched into the cache, before they are read.
_AHEAD = 64


@kernel_function()
def _place_eight(x, y, z, scale, side, places, start):
    """Write the texels and fractions at which eight directions meet a cube map with a border.

    texel_places gets four rows of _AHEAD numbers: the row of the texel above and to the left,
    counted through all faces; its column; and the fractions of a texel to the right of its centre
    and below it.

    Args:
        x, y, z: the directions, of any length.
        scale: half a face, texels.
        side: a face with its border, texels.
        places: the rows, flat.
        start: position in each row.
    """
    zeros = v8.broadcast(np.float32(0))
    half = v8.broadcast(np.float32(0.5))
    ax = v8.absolute(x)
    ay = v8.absolute(y)
    az = v8.absolute(z)
    is_x_face = v8.mask_and(v8.at_least(ax, ay), v8.at_least(ax, az))
    is_y_face = v8.at_least(ay, az)
    is_x_positive = v8.at_least(x, zeros)
    is_y_positive = v8.at_least(y, zeros)
    is_z_positive = v8.at_least(z, zeros)
    major = v8.select(is_x_face, ax, v8.select(is_y_face, ay, az))
    s = v8.select(is_y_face, x, v8.select(is_z_positive, x, v8.negate(x)))
    s = v8.select(is_x_face, v8.select(is_x_positive, v8.negate(z), z), s)
    t = v8.select(is_y_face, v8.select(is_y_positive, z, v8.negate(z)), v8.negate(y))
    t = v8.select(is_x_face, v8.negate(y), t)
    face = v8.select(
        is_y_face, _select_number(is_y_positive, 2, 3), _select_number(is_z_positive, 4, 5)
    )
    face = v8.select(is_x_face, _select_number(is_x_positive, 0, 1), face)
    inverse = v8.broadcast(scale) / major
    middle = v8.broadcast(scale) + half
    column = s * inverse + middle
    row = t * inverse + middle
    left_column = v8.floor(column)
    row_above = v8.floor(row)
    v8.store(places, start, face * v8.broadcast(side) + row_above)
    v8.store(places, start + Index(_AHEAD), left_column)
    v8.store(places, start + Index(2 * _AHEAD), column - left_column)
    v8.store(places, start + Index(3 * _AHEAD), row - row_above)


@kernel_function()
def _select_number(mask, a, b):
    return v8.select(mask, v8.broadcast(np.float32(a)), v8.broadcast(np.float32(b)))


@kernel
def quantise(values, out):
    """Write uint8 of float32 rows: clamped to [0, 1], times 255, rounded to the nearest."""
    half = np.float32(0.5)
    top = np.float32(255)
    for i in prange(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j] * top + half
            out[i, j] = np.uint8(min(max(value, np.float32(0)), top))


@kernel
def map_colors(rgb, matrix):
    """Replace every colour of float32 [H, W, 3] by matrix[:, :3] @ colour + matrix[:, 3]."""
    m00 = matrix[0, 0]
    m01 = matrix[0, 1]
    m02 = matrix[0, 2]
    m03 = matrix[0, 3]
    m10 = matrix[1, 0]
    m11 = matrix[1, 1]
    m12 = matrix[1, 2]
    m13 = matrix[1, 3]
    m20 = matrix[2, 0]
    m21 = matrix[2, 1]
    m22 = matrix[2, 2]
    m23 = matrix[2, 3]
    for i in prange(rgb.shape[0]):
        row = rgb[i].reshape(-1)
        for j in range(Index(0), Index(row.size), Index(3)):
            r = row[j]
            g = row[j + Index(1)]
            b = row[j + Index(2)]
            row[j] = m00 * r + m01 * g + m02 * b + m03
            row[j + Index(1)] = m10 * r + m11 * g + m12 * b + m13
            row[j + Index(2)] = m20 * r + m21 * g + m22 * b + m23


# ---- Numba kernel: colour maps folded into spherical harmonics -----------------------------------
# Memory limits its speed. Results go past the cache: a cache line that is written as a whole need
# not be read first.

# Splats of a piece of work.
SPLATS = 2048
# Splats that are mapped at a time; their results (24 KB at degree 3) stay in the first cache.
SPLAT_RUN = 128
# Bytes to which the target is aligned.
ALIGNMENT_BYTES = 4 * NUM_LANES


@intrinsic
def _stream(typingctx, source, source_start, target, target_start):
    """Store target[target_start : + 8] = source[source_start : + 8] past the cache.

    The address of target[target_start] is aligned.
    """

    def codegen(context, builder, sig, args):
        vector = ir.VectorType(ir.FloatType(), NUM_LANES)

        def pointer(kind, array, index):
            data = context.make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())

        value = builder.load(pointer(sig.args[0], args[0], args[1]), align=4)
        stored = builder.store(value, pointer(sig.args[2], args[2], args[3]), align=ALIGNMENT_BYTES)
        one_i32 = ir.Constant(ir.IntType(32), 1)
        stored.set_metadata("nontemporal", builder.module.add_metadata([one_i32]))
        return context.get_dummy_value()

    return types.void(source, types.uint64, target, types.uint64), codegen


@intrinsic
def _fence(typingctx):
    """Make streamed numbers visible to other threads."""

    def codegen(context, builder, sig, args):
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), codegen


@kernel_function()
def _map_splats(source, source_start, work, target_start, count, num_functions, folded):
    """Map `count` splats by one map, from source[source_start:] to work[target_start:].

    A splat of degree 0 whose colour is below 0 is mapped as the black that it shows (see `map_sh`
    of augment.effects.style.color_maps).
    """
    min_value = BLACK_SH_00 if num_functions == Index(1) else np.float32(-np.inf)
    a0 = folded[0]
    a1 = folded[1]
    a2 = folded[2]
    b0 = folded[3]
    b1 = folded[4]
    b2 = folded[5]
    c0 = folded[6]
    c1 = folded[7]
    c2 = folded[8]
    for i in range(count * num_functions):
        j = source_start + Index(3) * i
        k = target_start + Index(3) * i
        red = max(source[j], min_value)
        green = max(source[j + Index(1)], min_value)
        blue = max(source[j + Index(2)], min_value)
        work[k] = a0 * red + a1 * green + a2 * blue
        work[k + Index(1)] = b0 * red + b1 * green + b2 * blue
        work[k + Index(2)] = c0 * red + c1 * green + c2 * blue
    row = Index(3) * num_functions
    for splat in range(count):
        for channel in range(Index(3)):
            work[target_start + splat * row + channel] += folded[Index(9) + channel]


@kernel_function()
def _map_run(source, first, end, work, num_functions, classes, folded):
    """Map the splats `first` to `end` into work, neighbours of one class together."""
    row = Index(3) * num_functions
    splat = first
    while splat < end:
        class_end = end
        map_index = Index(0)
        if classes.size:
            map_index = Index(classes[splat])
            class_end = splat + Index(1)
            while class_end < end and Index(classes[class_end]) == map_index:
                class_end += Index(1)
        target_start = (splat - first) * row
        if folded[map_index, Index(NUM_FOLDED - 1)] != np.float32(0):
            _map_splats(
                source,
                splat * row,
                work,
                target_start,
                class_end - splat,
                num_functions,
                folded[map_index],
            )
        else:
            for i in range((class_end - splat) * row):
                work[target_start + i] = source[splat * row + i]
        splat = class_end


@kernel
def apply_color_maps(source, target, num_functions, classes, folded):
    """Write target = source with every splat's functions mapped.

    Args:
        source: float32 [N * K * 3]; it may be the target.
        target: float32 [N * K * 3], aligned to ALIGNMENT_BYTES bytes.
        num_functions: K, SH functions of a splat.
        classes: int16 [N], rows of folded; or [0] if all splats take the first.
        folded: float32 [C, NUM_FOLDED]. A last number of 0 says that the map changes nothing; then
            the splat's bits are copied.
    """
    row = Index(3 * num_functions)
    count = source.size // (3 * num_functions)
    for block in prange((count + SPLATS - 1) // SPLATS):
        work = np.empty(SPLAT_RUN * 3 * num_functions, np.float32)
        end = Index(min((block + 1) * SPLATS, count))
        for first in range(Index(block * SPLATS), end, Index(SPLAT_RUN)):
            last = min(first + Index(SPLAT_RUN), end)
            _map_run(source, first, last, work, Index(num_functions), classes, folded)
            size = (last - first) * row
            vector_end = size - size % Index(NUM_LANES)
            for i in range(Index(0), vector_end, Index(NUM_LANES)):
                _stream(work, i, target, first * row + i)
            for i in range(vector_end, size):
                target[first * row + i] = work[i]
        _fence()
