"""Numba kernels: lamps' light at points in the air, scattered by drops and flakes towards the eye.

`augment.lamps.drop_light` prepares the arrays and holds the plain definition.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.lamps.surface_light_kernels import lux_along_ray, read_lamp
from augment.render.cpu.jit import kernel, kernel_function

# Asymmetry of the light that a drop refracts through itself.
DROP_FORWARD = 0.85
# Asymmetry of the light that it sends back.
DROP_BACKWARD = -0.6
# Share of the light that it sends back.
DROP_BACKWARD_SHARE = 0.08
# Share of a flake's light that comes through it.
FLAKE_THROUGH_SHARE = 0.4


@kernel_function()
def henyey_greenstein(cosine, g):
    """Return the phase function of asymmetry g, whose mean over the sphere is 1 / 4 pi."""
    base = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (4.0 * math.pi * base * math.sqrt(base))


@kernel_function()
def drop_phase(cosine):
    """Return a drop's phase function, 1/sr; cosine of the angle between light's ways in and out."""
    forward = henyey_greenstein(cosine, DROP_FORWARD)
    backward = henyey_greenstein(cosine, DROP_BACKWARD)
    return forward + DROP_BACKWARD_SHARE * (backward - forward)


@kernel_function()
def flake_phase(cosine):
    """Return a flake's phase function, 1/sr: a Lambertian sphere through which a share shines.

    cosine: of the angle between the light's ways in and out.
    """
    alpha = math.acos(min(max(-cosine, -1.0), 1.0))  # between lamp and eye, seen from the flake
    sine = math.sin(alpha)
    scale = 2.0 / (3.0 * math.pi * math.pi)
    back = (sine + (math.pi - alpha) * math.cos(alpha)) * scale
    through = (sine - alpha * math.cos(alpha)) * scale
    return back + FLAKE_THROUGH_SHARE * (through - back)


@kernel
def light_cells(rays, distances, eye, lamps, is_snow, min_lux, cells):
    """Sum the luminance of drops in cells of the air: the lamps' lux times the phase function.

    Args:
        rays: unit directions of the cells' columns, world, float64 [h, w, 3].
        distances: distances of the cells, metres, float64 [K].
        eye: place of the eye, world, float64 [3].
        lamps: the lamps, `surface_light_kernels.LampArrays`.
        is_snow: True for flakes.
        min_lux: lux below which a lamp does not light a cell.
        cells: output, luminance in linear sRGB, cd/m2, float32 [K, h, w, 3].
    """
    height = rays.shape[0]
    width = rays.shape[1]
    for row in prange(height):
        for k in range(len(distances)):
            for column in range(width):
                for c in range(3):
                    cells[k, row, column, c] = 0.0
        for m in range(len(lamps.intensities)):
            lamp = read_lamp(lamps, m)
            tables = lamps.tables
            for k in range(len(distances)):
                for column in range(width):
                    rx = rays[row, column, 0]
                    ry = rays[row, column, 1]
                    rz = rays[row, column, 2]
                    x = eye[0] + distances[k] * rx
                    y = eye[1] + distances[k] * ry
                    z = eye[2] + distances[k] * rz
                    dx = lamp[0][0] - x
                    dy = lamp[0][1] - y
                    dz = lamp[0][2] - z
                    if lamps.peaks[m] < min_lux * (dx * dx + dy * dy + dz * dz):
                        continue
                    lux, dx, dy, dz = lux_along_ray(tables, lamp, x, y, z)
                    if lux <= 0:
                        continue
                    # Light travels along -d, then along -ray to the eye.
                    cosine = dx * rx + dy * ry + dz * rz
                    phase = flake_phase(cosine) if is_snow else drop_phase(cosine)
                    lux *= phase
                    cells[k, row, column, 0] += np.float32(lux * lamps.colors[m, 0])
                    cells[k, row, column, 1] += np.float32(lux * lamps.colors[m, 1])
                    cells[k, row, column, 2] += np.float32(lux * lamps.colors[m, 2])


@kernel
def add_cells(covers, cells, transmittances, step, picture):
    """Add the light of drops that cover pixels, nearest first, and hide what is behind them.

    Args:
        covers: share of each pixel that drops of each distance cover, float32 [K, H, W].
        cells: result of `light_cells`.
        transmittances: transmittance of the air before the drops of each distance, float64 [K].
        step: pixels between the cells' columns.
        picture: luminance in linear sRGB, cd/m2, changed in place, float32 [H, W, 3].
    """
    height, width = picture.shape[:2]
    rows, columns = cells.shape[1:3]
    for row in prange(height):
        v = min(max((row + 0.5) / step - 0.5, 0.0), rows - 1.0)
        i = min(int(v), max(rows - 2, 0))
        v -= i
        below = min(i + 1, rows - 1)
        light = np.empty(3)
        for column in range(width):
            clear = 1.0
            has_drops = False
            for k in range(len(covers)):
                cover = covers[k, row, column]
                if cover <= 0:
                    continue
                if not has_drops:
                    has_drops = True
                    light[0] = 0.0
                    light[1] = 0.0
                    light[2] = 0.0
                u = min(max((column + 0.5) / step - 0.5, 0.0), columns - 1.0)
                j = min(int(u), max(columns - 2, 0))
                u -= j
                beside = min(j + 1, columns - 1)
                weight = clear * cover * transmittances[k]
                for c in range(3):
                    above = cells[k, i, j, c] * (1.0 - u) + cells[k, i, beside, c] * u
                    under = cells[k, below, j, c] * (1.0 - u) + cells[k, below, beside, c] * u
                    light[c] += weight * (above + (under - above) * v)
                clear *= 1.0 - cover
            if has_drops:
                for c in range(3):
                    picture[row, column, c] += np.float32(light[c])
