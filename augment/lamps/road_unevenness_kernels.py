"""Numba kernel: tilts of a wet road's surface, from waves of many lengths that are fixed to it.

`augment.lamps.road_unevenness` launches it and holds the plain definition.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.hash_kernels import mix
from augment.render.cpu.jit import kernel, kernel_function

# Standard deviation of a smoothly interpolated lattice of numbers from -1 to 1, inverted.
PER_DEVIATION = 2.33
# Largest |x| or |y| of places, in cells of the finest lattice.
OFFSET = 1 << 30
_HALF_BITS = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
# Largest number of 32 bits, halved.
HALF_RANGE = 2147483647.5


@kernel_function()
def _corner(column, row, key):
    """Return two numbers from -1 to 1 of a corner of a lattice."""
    bits = mix(key ^ mix(np.uint64(column + OFFSET) << _HALF_BITS | np.uint64(row + OFFSET)))
    return (
        np.float64(bits >> _HALF_BITS) / HALF_RANGE - 1.0,
        np.float64(bits & _LOW) / HALF_RANGE - 1.0,
    )


@kernel_function()
def _noise(x, y, key):
    """Return two smooth numbers at a place; a cell of the lattice is 1 wide."""
    column = math.floor(x)
    row = math.floor(y)
    u = x - column
    v = y - row
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    j = np.int64(column)
    i = np.int64(row)
    a = _corner(j, i, key)
    b = _corner(j + 1, i, key)
    c = _corner(j, i + 1, key)
    d = _corner(j + 1, i + 1, key)
    first = (1 - v) * ((1 - u) * a[0] + u * b[0]) + v * ((1 - u) * c[0] + u * d[0])
    second = (1 - v) * ((1 - u) * a[1] + u * b[1]) + v * ((1 - u) * c[1] + u * d[1])
    return first, second


@kernel
def tilt_road(share, depth, resolved, lens, axes, eye, up, octaves, keys, roughness, tilts):
    """Write the tilts of a road, and take their variance out of its roughness.

    Args:
        share: share of each pixel that shows water, float32 [H, W].
        depth: z of the road, metres, float32 [H, W].
        resolved: share of the roughness's variance that waves may have, float32 [H, W].
        lens: 1 / fx, 1 / fy, cx, cy, float64 [4].
        axes: world_from_camera, float64 [3, 3].
        eye: place of the eye, world, float64 [3].
        up: normal of the road, world, float64 [3].
        octaves: length of each octave's waves, metres, and cosine and sine of its lattice's angle,
            float64 [O, 3].
        keys: key of each octave's random numbers, uint64 [O].
        roughness: Beckmann's m, float32 [H, W], changed in place.
        tilts: output, x and y of the unit normal less those of `up`, float32 [H, W, 2].
    """
    height, width = share.shape
    count = len(octaves)
    for i in prange(height):
        y = (i + 0.5 - lens[3]) * lens[1]
        for j in range(width):
            tilts[i, j, 0] = np.float32(0)
            tilts[i, j, 1] = np.float32(0)
            z = np.float64(depth[i, j])
            if not (share[i, j] > 0 and resolved[i, j] > 0 and z > 0 and z < 1e6):
                continue
            x = (j + 0.5 - lens[2]) * lens[0]
            ray_x = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2]
            ray_y = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2]
            ray_z = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2]
            length = math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
            sine = abs(ray_x * up[0] + ray_y * up[1] + ray_z * up[2]) / length
            footprint_m = z * length * lens[1] / max(sine, 1e-3)
            m2 = np.float64(roughness[i, j]) ** 2
            variance = 0.5 * m2 * resolved[i, j] / count
            deviation = PER_DEVIATION * math.sqrt(variance)
            world_x = eye[0] + z * ray_x
            world_y = eye[1] + z * ray_y
            tilt_x = 0.0
            tilt_y = 0.0
            for octave in range(count):
                wave_m = octaves[octave, 0]
                # Waves shorter than two pixels are roughness.
                weight = min(max(0.5 * wave_m / footprint_m - 0.5, 0.0), 1.0)
                if weight <= 0:
                    continue
                cosine = octaves[octave, 1]
                sine_angle = octaves[octave, 2]
                per_cell = 2.0 / wave_m
                first, second = _noise(
                    (cosine * world_x - sine_angle * world_y) * per_cell,
                    (sine_angle * world_x + cosine * world_y) * per_cell,
                    keys[octave],
                )
                tilt_x += weight * deviation * first
                tilt_y += weight * deviation * second
                m2 -= weight * weight * 2.0 * variance
            tilts[i, j, 0] = np.float32(tilt_x)
            tilts[i, j, 1] = np.float32(tilt_y)
            roughness[i, j] = np.float32(math.sqrt(m2))
