"""Numba kernels: pictures between display-encoded colours and light, with lamps' light and noise.

`picture_light` launches them and holds their plain definitions. The sRGB curve is looked up in
tables and interpolated: from codes evenly, to codes by the square root of the light.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function


@kernel_function()
def light_of_code(code, table):
    """Return the linear light of a display-encoded value >= 0; the table ends at some code."""
    place = code * np.float32(CODE_STEPS)
    index = int(place)
    if index >= len(table) - 1:
        return np.float32(((code + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4))
    share = place - np.float32(index)
    return table[index] + share * (table[index + 1] - table[index])


@kernel_function()
def code_of_light(light, table):
    """Return the display-encoded value of linear light >= 0; the table ends at some light."""
    place = np.float32(math.sqrt(light)) * np.float32(ROOT_STEPS)
    index = int(place)
    if index >= len(table) - 1:
        root = light ** np.float32(1 / 2.4)
        return np.float32(1.055) * root - np.float32(0.055)
    share = place - np.float32(index)
    return table[index] + share * (table[index + 1] - table[index])


# Entries of a table of light for codes from 0 to 1.
CODE_STEPS = 4096
# Entries of a table of codes for square roots of light from 0 to 1.
ROOT_STEPS = 4096


@kernel
def relight(rgb, added, gains, min_added, light_table, code_table, out, mask):
    """Scale a picture's light and add that of lamps. All floats are float32.

    Args:
        rgb: the picture, display-encoded, [H, W, 3].
        added: luminance that lamps add, cd/m2, [H, W, 3]; or empty [0, 0, 3] for none.
        gains: factor of the picture's own light, factor of the added light, smallest light that
            lamps must add for a saturated pixel to be theirs.
        min_added: pixels keep their bits if no channel gets more light than this; negative to
            change all.
        light_table: light by code.
        code_table: code by the square root of light.
        out: output [H, W, 3], display-encoded, may exceed 1.
        mask: output [H, W], True where lamps saturate the pixel.
    """
    gain = gains[0]
    added_gain = gains[1]
    min_lamp = gains[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    has_lamps = added.shape[0] > 0
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            most = zero
            if has_lamps:
                most = max(added[i, j, 0], added[i, j, 1], added[i, j, 2]) * added_gain
            mask[i, j] = False
            if most <= min_added:
                for k in range(3):
                    out[i, j, k] = rgb[i, j, k]
                continue
            brightest = zero
            for k in range(3):
                light = gain * light_of_code(max(rgb[i, j, k], zero), light_table)
                if has_lamps:
                    light += added_gain * added[i, j, k]
                brightest = max(brightest, light)
                out[i, j, k] = code_of_light(light, code_table)
            mask[i, j] = brightest >= one_f32 and most >= min_lamp


@kernel
def decode(rgb, light_table, out):
    """Write the light of float32 rows of codes; codes below 0 count as 0."""
    zero = np.float32(0)
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            out[i, j] = light_of_code(max(rgb[i, j], zero), light_table)


@kernel
def develop(light, glare, draws, numbers, code_table, out):
    """Write the picture that a sensor makes of light. All floats are float32.

    Args:
        light: exposed linear light, [H, W, 3]; 1 saturates the sensor.
        glare: light that the lens scatters, [H, W, 3]; or empty [0, 0, 3].
        draws: normal numbers in 8 bits about 128, [H, W, 3]; or empty [0, 0, 3] for no noise.
        numbers: crosstalk, variance per light, variance of reading; both variances for a draw of
            1 about 128.
        code_table: codes by the square root of light, with the response curve.
        out: output [H, W, 3], display-encoded.
    """
    crosstalk = numbers[0]
    per_light = numbers[1]
    of_reading = numbers[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    middle = np.float32(128)
    has_glare = glare.shape[0] > 0
    has_noise = draws.shape[0] > 0
    last = np.float32((len(code_table) - 2) / ROOT_STEPS)
    brightest = last * last
    for i in prange(light.shape[0]):
        for j in range(light.shape[1]):
            red = light[i, j, 0]
            green = light[i, j, 1]
            blue = light[i, j, 2]
            if has_glare:
                red += glare[i, j, 0]
                green += glare[i, j, 1]
                blue += glare[i, j, 2]
            excess_red = max(red - one_f32, zero)
            excess_green = max(green - one_f32, zero)
            excess_blue = max(blue - one_f32, zero)
            red += crosstalk * (excess_green + excess_blue)
            green += crosstalk * (excess_red + excess_blue)
            blue += crosstalk * (excess_red + excess_green)
            for k in range(3):
                value = red
                if k == 1:
                    value = green
                elif k == 2:
                    value = blue
                if has_noise:
                    variance = per_light * max(value, zero) + of_reading
                    draw = np.float32(draws[i, j, k]) - middle
                    value += draw * np.float32(math.sqrt(variance))
                value = min(max(value, zero), brightest)
                out[i, j, k] = code_of_light(value, code_table)


@kernel
def find_reflectance(rgb, fog_share, airlight, numbers, light_table, out):
    """Write the reflectance of surfaces, times the transmittance of the fog before them.

    All floats are float32.

    Args:
        rgb: the picture, display-encoded, [H, W, 3].
        fog_share: share of the airlight in each pixel, [H, W]; or empty [0, 0] for none.
        airlight: linear light of the fog, [3].
        numbers: linear light of white, least and greatest reflectance.
        light_table: light by code.
        out: output [H, W, 3].
    """
    white = numbers[0]
    least = numbers[1]
    most = numbers[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    has_fog = fog_share.shape[0] > 0
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            share = zero
            if has_fog:
                share = min(max(fog_share[i, j], zero), one_f32)
            through = one_f32 - share
            for k in range(3):
                light = light_of_code(max(rgb[i, j, k], zero), light_table)
                light = (light - share * airlight[k]) / white
                out[i, j, k] = min(max(light, least * through), most * through)
