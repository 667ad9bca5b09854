"""Numba kernel that draws the discs of lamps into a picture. `augment.lamps.emitters` calls it."""

from __future__ import annotations

import math

import numpy as np

from augment.render.cpu.jit import serial_kernel

# Radius of a disc, pixels, beyond which the sum of its weights is its area.
MAX_SUMMED_RADIUS_PX = 4.0


@serial_kernel
def draw_discs(lens, centres_px, radii_px, energies, picture):
    """Add discs of given energy to a picture, in order.

    A pixel's weight falls from 1 to 0 over a pixel about the disc's edge. Weights are divided by
    their sum, so the energy does not depend on where between pixels a disc lies.

    Args:
        lens: float64 [4], fx, fy, cx, cy, pixels.
        centres_px: float64 [M, 2], column and row of each disc.
        radii_px: float64 [M], radius of each disc, at least half a pixel.
        energies: float64 [M, 3], illuminance at the camera by each lamp, lux in linear sRGB.
        picture: float32 [H, W, 3], cd/m2 in linear sRGB, changed in place.
    """
    height, width, _ = picture.shape
    for m in range(len(radii_px)):
        radius = radii_px[m]
        centre_x = centres_px[m, 0]
        centre_y = centres_px[m, 1]
        first_x = math.floor(centre_x - radius - 1)
        last_x = math.ceil(centre_x + radius + 1)
        first_y = math.floor(centre_y - radius - 1)
        last_y = math.ceil(centre_y + radius + 1)
        total = math.pi * (radius * radius + 1 / 12)  # of a cone's frustum, one pixel wide
        if radius < MAX_SUMMED_RADIUS_PX:
            total = 0.0
            for y in range(first_y, last_y):
                for x in range(first_x, last_x):
                    distance = math.hypot(x + 0.5 - centre_x, y + 0.5 - centre_y)
                    total += min(max(radius + 0.5 - distance, 0.0), 1.0)
        for y in range(max(first_y, 0), min(last_y, height)):
            v = (y + 0.5 - lens[3]) / lens[1]
            for x in range(max(first_x, 0), min(last_x, width)):
                distance = math.hypot(x + 0.5 - centre_x, y + 0.5 - centre_y)
                weight = min(max(radius + 0.5 - distance, 0.0), 1.0)
                if weight > 0:
                    # A pixel's solid angle is cos^3 / (fx fy).
                    u = (x + 0.5 - lens[2]) / lens[0]
                    square = 1 + u * u + v * v
                    gain = weight / total * lens[0] * lens[1] * square * math.sqrt(square)
                    picture[y, x, 0] += np.float32(gain * energies[m, 0])
                    picture[y, x, 1] += np.float32(gain * energies[m, 1])
                    picture[y, x, 2] += np.float32(gain * energies[m, 2])
