"""Kernel functions: tilts of a wet road's surface, from waves of many lengths that are fixed to it.

`augment.lamps.road_unevenness` holds the plain definition; `wet_glint_kernels` calls them.
"""

from __future__ import annotations

import math

import numpy as np

from augment.lamps.vector_kernels import copies, dot
from augment.render.cpu import simd as v8
from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel_function
from augment.render.layout import NUM_LANES, Index

# Standard deviation of a smoothly interpolated lattice of numbers from -1 to 1, inverted.
PER_DEVIATION = 2.33
# Largest |x| or |y| of places, in cells of the finest lattice.
OFFSET = 1 << 30
_HALF_BITS = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
# Largest number of 32 bits, halved.
HALF_RANGE = 2147483647.5
# Row of m^2 among the numbers of a pixel.
_ROUGHNESS2 = 13


@kernel_function()
def _corner(column, row, key):
    """Return two numbers from -1 to 1 of a corner of a lattice."""
    bits = mix(key ^ mix(np.uint64(column + OFFSET) << _HALF_BITS | np.uint64(row + OFFSET)))
    return (
        np.float64(bits >> _HALF_BITS) / HALF_RANGE - 1.0,
        np.float64(bits & _LOW) / HALF_RANGE - 1.0,
    )


@kernel_function()
def tilt_tile(pixels, resolved, view, octaves, keys, tilts):
    """Write the tilts of a tile of a road, and take their variance out of its roughness.

    Pixels side by side mostly lie in one cell of a lattice, whose corners are kept for them.

    Args:
        pixels: numbers of N pixels as `water_tile_kernels` has them, float32; m^2 is changed in
            place.
        resolved: share of the roughness's variance that waves may have, float32 [N].
        view: view of the road, `water_tile_kernels.WaterView`.
        octaves: length of each octave's waves, metres, and cosine and sine of its lattice's angle,
            float64 [O, 3].
        keys: key of each octave's random numbers, uint64 [O].
        tilts: output, x of the unit normals less those of the road's plane, world, then y, float32
            [2 N], 0 before.
    """
    size = Index(pixels.shape[1])
    count = len(octaves)
    zero = copies(0)
    half = copies(0.5)
    unit = copies(1)
    weights = np.empty(pixels.shape[1], np.float32)
    deviations = np.empty(pixels.shape[1], np.float32)
    longest_m = 0.0
    for octave in range(count):
        longest_m = max(longest_m, octaves[octave, 0])
    per_focal = copies(view.lens[1])
    has_waves = False
    for first in range(Index(0), size, Index(NUM_LANES)):
        px = v8.load(pixels, first)
        py = v8.load(pixels, first + size)
        pz = v8.load(pixels, first + size + size)
        share = v8.load(resolved, first)
        squared = dot((px, py, pz), (px, py, pz))
        length = v8.sqrt(squared)
        # Length of a pixel on the road: its angle times the distance, over the grazing sine.
        sine = v8.maximum(v8.absolute(pz), copies(1e-3) * length)
        weight = half * sine / v8.maximum(squared * per_focal, copies(1e-20))
        is_road = v8.mask_and(v8.greater(share, zero), v8.greater(squared, zero))
        weight = v8.select(is_road, weight, zero)
        v8.store(weights, first, weight)
        variance = copies(0.5 / count) * v8.load(pixels, first + Index(_ROUGHNESS2) * size) * share
        v8.store(deviations, first, v8.sqrt(v8.maximum(variance, zero)))
        if v8.mask_bits(v8.greater(weight * copies(longest_m), half)) != Index(0):
            has_waves = True
    if not has_waves:
        return
    frame = view.frame
    eye = view.eye
    columns = np.empty(NUM_LANES, np.int32)
    rows = np.empty(NUM_LANES, np.int32)
    steps = np.empty(3 * NUM_LANES, np.float32)
    limit = copies(1e9)
    corners = np.empty(8, np.float32)
    for octave in range(count):
        wave_m = octaves[octave, 0]
        cosine = octaves[octave, 1]
        sine_angle = octaves[octave, 2]
        per_cell = 2.0 / wave_m
        # Coordinates in the lattice are linear in the place; those of the eye lose whole cells.
        x0 = (cosine * eye[0] - sine_angle * eye[1]) * per_cell
        y0 = (sine_angle * eye[0] + cosine * eye[1]) * per_cell
        first_column = np.int64(math.floor(x0))
        first_row = np.int64(math.floor(y0))
        x0 -= math.floor(x0)
        y0 -= math.floor(y0)
        xx = copies((cosine * frame[0, 0] - sine_angle * frame[0, 1]) * per_cell)
        xy = copies((cosine * frame[1, 0] - sine_angle * frame[1, 1]) * per_cell)
        xz = copies((cosine * frame[2, 0] - sine_angle * frame[2, 1]) * per_cell)
        yx = copies((sine_angle * frame[0, 0] + cosine * frame[0, 1]) * per_cell)
        yy = copies((sine_angle * frame[1, 0] + cosine * frame[1, 1]) * per_cell)
        yz = copies((sine_angle * frame[2, 0] + cosine * frame[2, 1]) * per_cell)
        key = keys[octave]
        last_column = np.int32(-(2**31))
        last_row = np.int32(-(2**31))
        for first in range(Index(0), size, Index(NUM_LANES)):
            # Waves shorter than two pixels are roughness.
            weight = v8.load(weights, first) * copies(wave_m) - half
            weight = v8.minimum(v8.maximum(weight, zero), unit)
            lanes = v8.mask_bits(v8.greater(weight, zero))
            if lanes == Index(0):
                continue
            px = v8.load(pixels, first)
            py = v8.load(pixels, first + size)
            pz = v8.load(pixels, first + size + size)
            deviation = weight * v8.load(deviations, first)
            at = first + Index(_ROUGHNESS2) * size
            m2 = v8.load(pixels, at) - copies(2) * deviation * deviation
            v8.store(pixels, at, v8.maximum(m2, zero))
            x = dot((px, py, pz), (xx, xy, xz)) + copies(x0)
            y = dot((px, py, pz), (yx, yy, yz)) + copies(y0)
            j = v8.floor(v8.minimum(v8.maximum(x, v8.negate(limit)), limit))
            i = v8.floor(v8.minimum(v8.maximum(y, v8.negate(limit)), limit))
            v8.store_integers(columns, Index(0), j)
            v8.store_integers(rows, Index(0), i)
            u = x - j
            v = y - i
            v8.store(steps, Index(0), u * u * v8.fmuladd(copies(-2), u, copies(3)))
            v8.store(steps, Index(NUM_LANES), v * v * v8.fmuladd(copies(-2), v, copies(3)))
            v8.store(steps, Index(2 * NUM_LANES), deviation * copies(PER_DEVIATION))
            while lanes != Index(0):
                lane = v8.lowest_bit(lanes)
                lanes &= lanes - Index(1)
                if columns[lane] != last_column or rows[lane] != last_row:
                    last_column = columns[lane]
                    last_row = rows[lane]
                    _read_cell(first_column + last_column, first_row + last_row, key, corners)
                a = steps[lane]
                b = steps[lane + Index(NUM_LANES)]
                scale = steps[lane + Index(2 * NUM_LANES)]
                slope = corners[0] + corners[1] * a + (corners[2] + corners[3] * a) * b
                tilts[first + lane] += scale * slope
                slope = corners[4] + corners[5] * a + (corners[6] + corners[7] * a) * b
                tilts[size + first + lane] += scale * slope


@kernel_function()
def _read_cell(column, row, key, corners):
    """Write both numbers' value at a cell's corner, and their changes to the other corners."""
    a = _corner(column, row, key)
    b = _corner(column + 1, row, key)
    c = _corner(column, row + 1, key)
    d = _corner(column + 1, row + 1, key)
    corners[0] = a[0]
    corners[1] = b[0] - a[0]
    corners[2] = c[0] - a[0]
    corners[3] = a[0] - b[0] - c[0] + d[0]
    corners[4] = a[1]
    corners[5] = b[1] - a[1]
    corners[6] = c[1] - a[1]
    corners[7] = a[1] - b[1] - c[1] + d[1]
