"""Numba kernel: lamps' light at points in the air, scattered by drops and flakes towards the eye.

`augment.lamps.drop_light` prepares the arrays and holds the plain definition. Eight columns are
looked at at a time, in float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.lamps.lamp_lane_kernels import COLOR, lux_of_lanes, read_lamp_lanes
from augment.lamps.vector_kernels import copies, dot
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import NUM_LANES, Index

# Asymmetry of the light that a drop refracts through itself.
DROP_FORWARD = 0.85
# Asymmetry of the light that it sends back.
DROP_BACKWARD = -0.6
# Share of the light that it sends back.
DROP_BACKWARD_SHARE = 0.08
# Share of a flake's light that comes through it.
FLAKE_THROUGH_SHARE = 0.4
# acos(x) = sqrt(1 - x) times a polynomial, within 2e-8 for 0 <= x <= 1; lowest power first.
# Source: Abramowitz and Stegun 1964, "Handbook of Mathematical Functions", 4.4.46.
_ACOS = (
    1.5707963050,
    -0.2145988016,
    0.0889789874,
    -0.0501743046,
    0.0308918810,
    -0.0170881256,
    0.0066700901,
    -0.0012624911,
)


@kernel_function()
def henyey_greenstein(gap, g):
    """Return the phase function of asymmetry g, whose mean over the sphere is 1 / 4 pi.

    gap: 1 - cosine of the angle between the light's ways in and out.
    """
    base = v8.fmuladd(gap, copies(2.0 * g), copies((1.0 - g) ** 2))
    return copies((1.0 - g * g) / (4.0 * math.pi)) / (base * v8.sqrt(base))


@kernel_function()
def drop_phase(gap):
    """Return a drop's phase function, 1/sr. gap: as in `henyey_greenstein`."""
    forward = henyey_greenstein(gap, DROP_FORWARD)
    backward = henyey_greenstein(gap, DROP_BACKWARD)
    return v8.fmuladd(backward - forward, copies(DROP_BACKWARD_SHARE), forward)


@kernel_function()
def _acos(x):
    """Return the arc cosine of x in [-1, 1]."""
    size = v8.absolute(x)
    value = copies(_ACOS[7])
    value = v8.fmuladd(value, size, copies(_ACOS[6]))
    value = v8.fmuladd(value, size, copies(_ACOS[5]))
    value = v8.fmuladd(value, size, copies(_ACOS[4]))
    value = v8.fmuladd(value, size, copies(_ACOS[3]))
    value = v8.fmuladd(value, size, copies(_ACOS[2]))
    value = v8.fmuladd(value, size, copies(_ACOS[1]))
    value = v8.fmuladd(value, size, copies(_ACOS[0]))
    value = value * v8.sqrt(v8.maximum(copies(1) - size, copies(0)))
    return v8.select(v8.greater(copies(0), x), copies(math.pi) - value, value)


@kernel_function()
def flake_phase(gap):
    """Return a flake's phase function, 1/sr: a Lambertian sphere through which a share shines.

    gap: as in `henyey_greenstein`.
    """
    # Cosine of the angle alpha between lamp and eye, seen from the flake.
    cosine = v8.minimum(v8.maximum(gap - copies(1), copies(-1)), copies(1))
    alpha = _acos(cosine)
    sine = v8.sqrt(copies(1) - cosine * cosine)
    back = v8.fmuladd(copies(math.pi) - alpha, cosine, sine)
    through = sine - alpha * cosine
    scale = copies(2.0 / (3.0 * math.pi * math.pi))
    return v8.fmuladd(through - back, copies(FLAKE_THROUGH_SHARE), back) * scale


@kernel
def light_cells(rays, distances, lamps, tables, starts, is_snow, min_luminance, cells):
    """Sum the luminance of drops in cells of the air: the lamps' lux times the phase function.

    Args:
        rays: unit directions of the cells' columns, world, float32 [3, h, w]; w is a multiple of 8.
        distances: distances of the cells, metres, float32 [K].
        lamps: the lamps, from the eye, `lamp_lanes.lamp_table`.
        tables: packed patterns, float32 [K, V, U].
        starts: first value of each lamp's pattern in the flat tables, int32 [M].
        is_snow: True for flakes.
        min_luminance: luminance below which a lamp does not light eight cells, cd/m2.
        cells: output, luminance in linear sRGB, cd/m2, float32 [K, h, 3, w].
    """
    height, width = rays.shape[1:]
    count = len(distances)
    for line in prange(height * count):
        row = line // count
        k = line % count
        texels = np.empty(NUM_LANES, np.int32)
        firsts = np.empty(NUM_LANES, np.int32)
        zero = copies(0)
        distance = v8.broadcast(distances[k])
        least = copies(min_luminance)
        place = Index(row * width)
        step = Index(height * width)
        first_cell = Index((k * height + row) * 3 * width)
        for column in range(width):
            for c in range(3):
                cells[k, row, c, column] = np.float32(0)
        for m in range(len(lamps)):
            lamp = read_lamp_lanes(lamps, m)
            red = v8.broadcast(lamps[m, COLOR])
            green = v8.broadcast(lamps[m, COLOR + 1])
            blue = v8.broadcast(lamps[m, COLOR + 2])
            for lane in range(NUM_LANES):
                firsts[lane] = starts[m]
            for column in range(Index(0), Index(width), Index(NUM_LANES)):
                rx = v8.load(rays, place + column)
                ry = v8.load(rays, place + step + column)
                rz = v8.load(rays, place + step + step + column)
                dx = lamp[0][0] - distance * rx
                dy = lamp[0][1] - distance * ry
                dz = lamp[0][2] - distance * rz
                squared = v8.maximum(dot((dx, dy, dz), (dx, dy, dz)), copies(1e-12))
                per_m = copies(1) / v8.sqrt(squared)
                # Light travels along -d, then along -ray to the eye. The chord keeps the digits of
                # 1 - cosine.
                x = dx * per_m - rx
                y = dy * per_m - ry
                z = dz * per_m - rz
                gap = copies(0.5) * dot((x, y, z), (x, y, z))
                phase = flake_phase(gap) if is_snow else drop_phase(gap)
                most = phase * lamp[7] / (squared + lamp[6])
                if v8.mask_bits(v8.greater(most, least)) == Index(0):
                    continue
                lux = lux_of_lanes(tables, firsts, texels, lamp, (dx, dy, dz), squared, per_m)
                light = v8.maximum(lux * phase, zero)
                cell = first_cell + column
                v8.store(cells, cell, v8.fmuladd(light, red, v8.load(cells, cell)))
                cell += Index(width)
                v8.store(cells, cell, v8.fmuladd(light, green, v8.load(cells, cell)))
                cell += Index(width)
                v8.store(cells, cell, v8.fmuladd(light, blue, v8.load(cells, cell)))
