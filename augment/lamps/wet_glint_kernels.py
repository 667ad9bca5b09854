"""Numba kernels: lamps in wet ground and water, as streaks of a rough mirror.

`augment.lamps.wet_glints` prepares the arrays and holds the plain definition. Symbols: m Beckmann's
roughness, h the unit vector half way between eye and lamp, theta_h its angle to the normal. All
places are in the water's frame: from the eye, metres, z along the water's normal. Eight pixels, or
eight lamps, are looked at at a time, in float32. Places are rounded to it last, and no difference
of nearly equal numbers is taken along the streak, where the eye grazes the water.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.lamps.lamp_lane_kernels import (
    COLOR,
    PEAK,
    gather_lamp_lanes,
    lux_of_lanes,
    read_lamp_lanes,
)
from augment.lamps.surface_light_kernels import insert_ranked, lit_share
from augment.lamps.vector_kernels import copies, dot
from augment.lamps.water_tile_kernels import (
    NUM_GROUPS,
    NUM_PIXEL_NUMBERS,
    ROUGHNESS2,
    SHARE,
    TILE_PX,
    TILE_SIZE,
    fill_tile,
)
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.simd import LOG2_E, exp2_fine
from augment.render.layout import NUM_LANES, Index

REFRACTION_INDEX = 1.33  # of water
# Exponent of Beckmann's distribution, (tan theta_h / m)^2, from which on nothing glints.
MAX_EXPONENT = 14.0
# Pixels of a whole tile at which the lamps are compared: corners and middle.
SAMPLES = np.array([0, 15, 119, 240, 255])
# Tangent of an angle over its sine, for the tilts of waves.
TILT_MARGIN = 1.2
# Blur across the streak, in squares of a pixel, twice the variance: of half a pixel, so that a far
# lamp's streak keeps its light wherever it lies between the pixels.
PIXEL_BLUR = 0.5
# Largest square of the tangent from pixel to pixel.
MAX_PIXEL_TILT2 = 0.09
# Least cosine between the normal and the eye.
MIN_COSINE = 0.005
# Share of `min_luminance` that a lamp adds to eight pixels at least.
MIN_LUMINANCE_SHARE = 1.0 / 16.0


@kernel_function()
def _half_vector(towards, distance, pixel, pixel_rad):
    """Return the tangents of the half vector of lamp and eye, and what it takes to find them.

    D and E are the vectors from the water to lamp and eye, n is the normal, g the direction along
    the water away from the eye. The half vector is along D |E| + E |D|. With R = -E g, q = R (D g)
    and t = D (E x n), its part along g is

        ((q En - R^2 Dn) (q En + R^2 Dn) / R^2 - t^2) R / (q |E| + R^2 |D|)

    for q > 0, without the small difference of D g |E| and R |D|.

    Returns:
        Squares of h along and across the view, times that of the normal part; the square of the
        normal part; D n; D E; square of the tangent from a pixel to the one beside it.
    """
    px, py, pz, nx, ny, nz, cx, cy, cz, eye_m, eye_n, r2, per_r2 = pixel
    lamp_n = dot(towards, (nx, ny, nz))
    cosine = v8.negate(dot(towards, (px, py, pz)))
    triple = dot(towards, (cx, cy, cz))
    triple2 = triple * triple
    q = lamp_n * eye_n - cosine
    eye_part = q * eye_n
    lamp_part = r2 * lamp_n
    far_m = r2 * distance
    ahead = (eye_part - lamp_part) * (eye_part + lamp_part) * per_r2 - triple2
    ahead = ahead / v8.fmuladd(q, eye_m, far_m)
    behind = q * eye_m - far_m
    along2 = v8.select(v8.greater(q, copies(0)), ahead * ahead * r2, behind * behind * per_r2)
    across2 = triple2 * (eye_m * eye_m * per_r2)
    half_n = v8.fmuladd(lamp_n, eye_m, eye_n * distance)
    half_n2 = v8.maximum(half_n * half_n, copies(1e-20))
    least = copies(MIN_COSINE)
    cosines = v8.maximum(eye_n, least * eye_m) * distance
    cosines = v8.fmuladd(v8.maximum(lamp_n, least * distance), eye_m, cosines)
    tilt = (eye_m + distance) * eye_m * copies(pixel_rad) / cosines
    pixel_tilt2 = v8.minimum(tilt * tilt, copies(MAX_PIXEL_TILT2))
    return along2, across2, half_n2, lamp_n, cosine, pixel_tilt2


@kernel_function()
def fresnel(cosine):
    """Return the reflectance of water for unpolarised light by the cosines of its incidence."""
    unit = copies(1)
    n = copies(REFRACTION_INDEX)
    sine2 = (unit - cosine * cosine) * copies(1.0 / (REFRACTION_INDEX * REFRACTION_INDEX))
    inside = v8.sqrt(unit - sine2)
    s = (cosine - n * inside) / (cosine + n * inside)
    p = (inside - n * cosine) / (inside + n * cosine)
    return copies(0.5) * v8.fmuladd(s, s, p * p)


@kernel_function()
def masking(cosine, m):
    """Return Smith's share of a rough surface that directions reach.

    The rational approximation of Walter et al. 2007, "Microfacet Models for Refraction".
    """
    unit = copies(1)
    sine = v8.sqrt(v8.maximum(unit - cosine * cosine, copies(0)))
    # 1 / a; from a = 1.6 on the share is 1.
    b = v8.maximum(m * sine / cosine, copies(1.0 / 1.6))
    share = v8.fmuladd(copies(3.535), b, copies(2.181))
    below = v8.fmuladd(v8.fmuladd(b, b, copies(2.577)), copies(1), copies(2.276) * b)
    return v8.select(v8.greater(b, copies(1.0 / 1.6)), share / below, unit)


@kernel_function()
def _glint(half, distance, per_m, eye_m, eye_n, m2, across_m2, exponent):
    """Return F D G / (4 cos(eye)): luminance per lux on a surface that faces the lamp.

    half: result of `_half_vector`.
    """
    along2, across2, half_n2, lamp_n, cosine, _ = half
    unit = copies(1)
    per_eye_m = unit / eye_m
    least = copies(MIN_COSINE)
    to_lamp = v8.maximum(lamp_n * per_m, least)
    to_eye = v8.maximum(eye_n * per_eye_m, least)
    # cos(theta_h)^-2 = 1 + tan(theta_h)^2.
    per_cosine2 = unit + (along2 + across2) / half_n2
    double = v8.maximum(v8.fmuladd(cosine, per_m * per_eye_m, unit), copies(0))
    incidence = v8.minimum(v8.sqrt(copies(0.5) * double), unit)
    m = v8.sqrt(m2)
    shares = masking(to_lamp, m) * masking(to_eye, m) * fresnel(incidence)
    spread = exp2_fine(exponent * v8.broadcast(-LOG2_E)) * (per_cosine2 * per_cosine2)
    widths = v8.sqrt(m2 * across_m2) * to_eye * copies(4.0 * math.pi)
    return shares * spread / widths


@kernel_function()
def _strength(lamp, gap, pixel, rough2, pixel_rad, max_exponent):
    """Return luminance per lux of eight pairs of lamp and pixel, and the inverse distances.

    The luminance is 0 where nothing glints, and in all lanes at once without further work.

    Args:
        lamp: the lamps, as `lamp_lane_kernels` reads them.
        gap: result of `_gap`.
        pixel: numbers of the pixels.
        rough2: m^2 of the pixels.
        pixel_rad: width of a pixel, radians.
        max_exponent: exponent from which on nothing glints.
    """
    towards, squared, distance = gap
    zero = copies(0)
    eye_m = pixel[9]
    eye_n = pixel[10]
    half = _half_vector(towards, distance, pixel, pixel_rad)
    along2, across2, half_n2, lamp_n, _, pixel_tilt2 = half
    # The lamp's disc blurs the mirror by half its angle.
    m2 = v8.fmuladd(copies(0.25) * lamp[6], copies(1) / squared, rough2)
    across_m2 = v8.fmuladd(copies(PIXEL_BLUR), pixel_tilt2, m2)
    exponent = v8.fmuladd(along2, across_m2, across2 * m2) / (half_n2 * m2 * across_m2)
    is_lit = v8.at_least(copies(max_exponent), exponent)
    is_lit = v8.mask_and(is_lit, v8.greater(lamp_n, zero))
    is_lit = v8.mask_and(is_lit, v8.greater(eye_n, zero))
    strength = zero
    per_m = zero
    if v8.mask_bits(is_lit) != Index(0):
        per_m = copies(1) / distance
        exponent = v8.minimum(exponent, copies(MAX_EXPONENT))
        strength = _glint(half, distance, per_m, eye_m, eye_n, m2, across_m2, exponent)
        strength = v8.select(is_lit, strength, zero)
    return strength, per_m


@kernel_function()
def _gap(lamp, pixel):
    """Return the ways from the water to the lamps, the squares of their lengths, and these."""
    towards = (lamp[0][0] - pixel[0], lamp[0][1] - pixel[1], lamp[0][2] - pixel[2])
    squared = v8.maximum(dot(towards, towards), copies(1e-6))
    return towards, squared, v8.sqrt(squared)


@kernel_function()
def _load_pixels(pixels, group):
    """Return the numbers of eight pixels of a tile but for their roughness and share."""
    first = group * Index(NUM_LANES)
    size = Index(TILE_SIZE)
    return (
        v8.load(pixels, first),
        v8.load(pixels, first + size),
        v8.load(pixels, first + Index(2) * size),
        v8.load(pixels, first + Index(3) * size),
        v8.load(pixels, first + Index(4) * size),
        v8.load(pixels, first + Index(5) * size),
        v8.load(pixels, first + Index(6) * size),
        v8.load(pixels, first + Index(7) * size),
        v8.load(pixels, first + Index(8) * size),
        v8.load(pixels, first + Index(9) * size),
        v8.load(pixels, first + Index(10) * size),
        v8.load(pixels, first + Index(11) * size),
        v8.load(pixels, first + Index(12) * size),
    )


@kernel_function()
def _flat_pixel(pixels, p):
    """Return eight copies of a pixel's numbers, without its wave."""
    px = np.float64(pixels[0, p])
    py = np.float64(pixels[1, p])
    pz = np.float64(pixels[2, p])
    squared = px * px + py * py + pz * pz
    r2 = max(px * px + py * py, 1e-9 * squared)
    zero = copies(0)
    return (
        copies(px),
        copies(py),
        copies(pz),
        zero,
        zero,
        copies(1),
        copies(-py),
        copies(px),
        zero,
        copies(math.sqrt(squared)),
        copies(-pz),
        copies(r2),
        copies(1.0 / r2),
    )


@kernel_function()
def _find_candidates(
    lamps, pixels, wet, count, pixel_rad, largest_m, largest_tilt, min_luminance, rows, bounds
):
    """List the lamps that may glint in a tile, and the most luminance that they may have there.

    Args:
        lamps: the table of lamps.
        pixels: numbers of the tile's pixels.
        wet: its pixels that show water.
        count: their number.
        pixel_rad: width of a pixel, radians.
        largest_m: largest roughness.
        largest_tilt: largest tilt of a wave.
        min_luminance: luminance that need not be added.
        rows: output, rows of the lamps, int32 [M].
        bounds: output, luminances, float32 [M].

    Returns:
        The number of the lamps.
    """
    eight = np.empty(NUM_LANES, np.int32)
    lane_bounds = np.empty(NUM_LANES, np.float32)
    zero = copies(0)
    number = 0
    for start in range(0, len(lamps), NUM_LANES):
        for lane in range(NUM_LANES):
            eight[lane] = min(start + lane, len(lamps) - 1)
        lamp = gather_lamp_lanes(lamps, eight)
        # The least tilt of h at some points, less what it may fall between them.
        smallest = copies(1e18)
        largest = zero
        nearest = copies(1e30)
        blur2 = zero
        for sample in range(len(SAMPLES)):
            pixel = _flat_pixel(pixels, wet[SAMPLES[sample] * (count - 1) // (TILE_SIZE - 1)])
            towards, squared, distance = _gap(lamp, pixel)
            along2, across2, half_n2, _, _, pixel_tilt2 = _half_vector(
                towards, distance, pixel, pixel_rad
            )
            tilt = v8.sqrt((along2 + across2) / half_n2)
            smallest = v8.minimum(smallest, tilt)
            largest = v8.maximum(largest, tilt)
            nearest = v8.minimum(nearest, squared)
            blur2 = v8.maximum(blur2, copies(PIXEL_BLUR) * pixel_tilt2)
        reach = smallest + smallest - largest - copies(TILT_MARGIN * largest_tilt)
        reach = v8.maximum(reach, zero)
        m2 = v8.fmuladd(copies(0.25) * lamp[6], copies(1) / nearest, copies(largest_m * largest_m))
        exponent = reach * reach / (m2 + blur2)
        is_near = v8.at_least(copies(MAX_EXPONENT), exponent)
        if v8.mask_bits(is_near) == Index(0):
            continue
        # A bound of F D G / (4 cos), with G / cos at most about 1 / m.
        exponent = v8.minimum(exponent, copies(MAX_EXPONENT))
        bound = lamp[7] / nearest * exp2_fine(exponent * v8.broadcast(-LOG2_E))
        bound = bound / (copies(4.0 * math.pi) * m2 * v8.sqrt(m2))
        bound = v8.select(is_near, bound, zero)
        v8.store(lane_bounds, Index(0), bound)
        for lane in range(min(NUM_LANES, len(lamps) - start)):
            if lane_bounds[lane] >= min_luminance and lane_bounds[lane] > 0:
                rows[number] = start + lane
                bounds[number] = lane_bounds[lane]
                number += 1
    return number


@kernel_function()
def _choose_lamps(
    lamps, tables, starts, pixels, wet, count, pixel_rad, rows, bounds, number, chosen, scores
):
    """Choose the lamps that glint most at some of a tile's pixels; return their number.

    Args:
        lamps: the table of lamps.
        tables: packed patterns.
        starts: first value of each lamp's pattern in the flat tables, int32 [M].
        pixels: numbers of the tile's pixels.
        wet: its pixels that show water.
        count: their number.
        pixel_rad: width of a pixel, radians.
        rows: lamps that may glint, int32 [M].
        bounds: the most luminance that they may have.
        number: their number.
        chosen: output, rows of the lamps, int64 [max_lamps].
        scores: output, their luminances, float64 [max_lamps].
    """
    eight = np.empty(NUM_LANES, np.int32)
    firsts = np.empty(NUM_LANES, np.int32)
    texels = np.empty(NUM_LANES, np.int32)
    lights = np.empty(NUM_LANES, np.float32)
    zero = copies(0)
    num_chosen = 0
    for start in range(0, number, NUM_LANES):
        for lane in range(NUM_LANES):
            eight[lane] = rows[min(start + lane, number - 1)]
            firsts[lane] = starts[eight[lane]]
        lamp = gather_lamp_lanes(lamps, eight)
        brightest = zero
        for sample in range(len(SAMPLES)):
            p = wet[SAMPLES[sample] * (count - 1) // (TILE_SIZE - 1)]
            pixel = _flat_pixel(pixels, p)
            gap = _gap(lamp, pixel)
            rough2 = v8.broadcast(pixels[ROUGHNESS2, p])
            strength, per_m = _strength(lamp, gap, pixel, rough2, pixel_rad, MAX_EXPONENT)
            if v8.mask_bits(v8.greater(strength, zero)) != Index(0):
                lux = lux_of_lanes(tables, firsts, texels, lamp, gap[0], gap[1], per_m)
                brightest = v8.maximum(brightest, strength * lux)
        v8.store(lights, Index(0), brightest)
        for lane in range(min(NUM_LANES, number - start)):
            # Lamps that pass between the points are ranked by a bit of what they may have.
            score = max(1e-4 * np.float64(bounds[start + lane]), np.float64(lights[lane]))
            if num_chosen == len(chosen) and score <= scores[num_chosen - 1]:
                continue
            num_chosen = insert_ranked(chosen, scores, num_chosen, np.int64(eight[lane]), score)
    return num_chosen


@kernel_function()
def _add_lamp(
    lamps,
    m,
    tables,
    starts,
    view,
    shadows,
    shadow_map,
    pixels,
    groups,
    num_groups,
    max_exponent,
    min_light,
    sums,
):
    """Add one lamp's luminance to a tile's pixels.

    Args:
        lamps: the table of lamps.
        m: row of the lamp.
        tables: packed patterns.
        starts: first value of each lamp's pattern in the flat tables, int32 [M].
        view: the view of the water.
        shadows: depth maps.
        shadow_map: index of the lamp's depth map, -1 without one.
        pixels: numbers of the tile's pixels.
        groups: groups of eight pixels that show water, int64 [NUM_GROUPS].
        num_groups: their number.
        max_exponent: exponent from which on the lamp's glints need not be added.
        min_light: luminance that need not be added.
        sums: red, green and blue of the pixels, changed in place, float32 [3, TILE_SIZE].
    """
    firsts = np.full(NUM_LANES, starts[m], np.int32)
    texels = np.empty(NUM_LANES, np.int32)
    lights = np.empty(NUM_LANES, np.float32)
    lamp = read_lamp_lanes(lamps, m)
    pixel_rad = view.lens[0]
    size = Index(TILE_SIZE)
    red = v8.broadcast(lamps[m, COLOR])
    green = v8.broadcast(lamps[m, COLOR + 1])
    blue = v8.broadcast(lamps[m, COLOR + 2])
    least = copies(min_light)
    for g in range(num_groups):
        group = Index(groups[g])
        first = group * Index(NUM_LANES)
        pixel = _load_pixels(pixels, group)
        gap = _gap(lamp, pixel)
        rough2 = v8.load(pixels, first + Index(ROUGHNESS2) * size)
        strength, per_m = _strength(lamp, gap, pixel, rough2, pixel_rad, max_exponent)
        most = strength * (lamp[7] * per_m * per_m)
        if v8.mask_bits(v8.greater(most, least)) == Index(0):
            continue
        lux = lux_of_lanes(tables, firsts, texels, lamp, gap[0], gap[1], per_m)
        light = strength * lux * v8.load(pixels, first + Index(SHARE) * size)
        if shadow_map >= 0:
            v8.store(lights, Index(0), light)
            _hide(lights, first, pixels, view, shadows, shadow_map)
            light = v8.load(lights, Index(0))
        v8.store(sums, first, v8.fmuladd(light, red, v8.load(sums, first)))
        first += size
        v8.store(sums, first, v8.fmuladd(light, green, v8.load(sums, first)))
        first += size
        v8.store(sums, first, v8.fmuladd(light, blue, v8.load(sums, first)))


@kernel_function()
def _hide(lights, first, pixels, view, shadows, shadow_map):
    """Multiply the light of eight pixels by the share that is not in shadow, in place."""
    frame = view.frame
    eye = view.eye
    for lane in range(NUM_LANES):
        if lights[lane] > 0:
            k = np.int64(first) + lane
            px = np.float64(pixels[0, k])
            py = np.float64(pixels[1, k])
            pz = np.float64(pixels[2, k])
            x = eye[0] + frame[0, 0] * px + frame[1, 0] * py + frame[2, 0] * pz
            y = eye[1] + frame[0, 1] * px + frame[1, 1] * py + frame[2, 1] * pz
            z = eye[2] + frame[0, 2] * px + frame[1, 2] * py + frame[2, 2] * pz
            lights[lane] *= np.float32(lit_share(shadows, shadow_map, x, y, z))


@kernel
def add_glints(
    water, view, lamps, tables, starts, shadow_maps, shadows, min_luminance, max_lamps, picture
):
    """Add the lamps' glints to the pixels that show water.

    Args:
        water: the water.
        view: the view of it.
        lamps: the lamps in the water's frame, `lamp_lanes.lamp_table`.
        tables: packed patterns, float32 [K, V, U].
        starts: first value of each lamp's pattern in the flat tables, int32 [M].
        shadow_maps: index of each lamp's shadow map, -1 without any, int64 [M].
        shadows: depth maps, `surface_light_kernels.ShadowArrays`.
        min_luminance: luminance that need not be added, cd/m2.
        max_lamps: largest number of lamps that glint in a tile.
        picture: luminance in linear sRGB, cd/m2, changed in place, float32 [H, W, 3].
    """
    height, width = water.share.shape
    tile_columns = (width + TILE_PX - 1) // TILE_PX
    tile_rows = (height + TILE_PX - 1) // TILE_PX
    for tile in prange(tile_columns * tile_rows):
        top = (tile // tile_columns) * TILE_PX
        left = (tile % tile_columns) * TILE_PX
        bottom = min(top + TILE_PX, height)
        right = min(left + TILE_PX, width)
        pixels = np.empty((NUM_PIXEL_NUMBERS, TILE_SIZE), np.float32)
        wet = np.empty(TILE_SIZE, np.int64)
        count, largest_m, least_m, largest_tilt = fill_tile(
            top, left, bottom, right, water, view, pixels, wet
        )
        if count == 0:
            continue
        rows = np.empty(len(lamps), np.int32)
        bounds = np.empty(len(lamps), np.float32)
        pixel_rad = view.lens[0]
        number = _find_candidates(
            lamps,
            pixels,
            wet,
            count,
            pixel_rad,
            largest_m,
            largest_tilt,
            min_luminance,
            rows,
            bounds,
        )
        if number == 0:
            continue
        chosen = np.empty(max_lamps, np.int64)
        scores = np.empty(max_lamps)
        number = _choose_lamps(
            lamps,
            tables,
            starts,
            pixels,
            wet,
            count,
            pixel_rad,
            rows,
            bounds,
            number,
            chosen,
            scores,
        )
        groups = np.empty(NUM_GROUPS, np.int64)
        num_groups = 0
        last = -1
        for w in range(count):
            if wet[w] // NUM_LANES != last:
                last = wet[w] // NUM_LANES
                groups[num_groups] = last
                num_groups += 1
        sums = np.zeros((3, TILE_SIZE), np.float32)
        min_light = MIN_LUMINANCE_SHARE * min_luminance
        for c in range(number):
            m = chosen[c]
            nearest2 = 1e30
            for sample in range(len(SAMPLES)):
                p = wet[SAMPLES[sample] * (count - 1) // (TILE_SIZE - 1)]
                squared = 0.0
                for k in range(3):
                    squared += (np.float64(lamps[m, k]) - np.float64(pixels[k, p])) ** 2
                nearest2 = min(nearest2, squared)
            bound = np.float64(lamps[m, PEAK]) / max(nearest2, 1e-6)
            bound /= 4.0 * math.pi * max(least_m, 1e-3) ** 3
            max_exponent = min(MAX_EXPONENT, math.log(max(bound / min_light, 1.0)))
            _add_lamp(
                lamps,
                m,
                tables,
                starts,
                view,
                shadows,
                shadow_maps[m],
                pixels,
                groups,
                num_groups,
                max_exponent,
                min_light,
                sums,
            )
        for w in range(count):
            k = wet[w]
            i = top + k // TILE_PX
            j = left + k % TILE_PX
            picture[i, j, 0] += sums[0, k]
            picture[i, j, 1] += sums[1, k]
            picture[i, j, 2] += sums[2, k]
