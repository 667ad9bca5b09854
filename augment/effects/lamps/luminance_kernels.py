"""Numba kernel: the luminance of exposed pictures, and where the lens's glare outshines them.

`luminance` launches it and holds its plain definition.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.effects.lamps.light_kernels import MAX_CODE, light_of_code, light_of_high_code
from augment.render.cpu.jit import kernel
from augment.render.layout import Index


@kernel
def measure_luminance(rgb, glare, numbers, luminance, is_veiled):
    """Write the luminance of each pixel, and whether glare is most of it. All floats are float32.

    Args:
        rgb: exposed picture, display-encoded, [H, W, 3]; 1 saturates the sensor.
        glare: light that the lens scatters, at half the resolution, [h, w, 3]; or empty [0, 0, 0]
            for none.
        numbers: weights of red, green and blue in luminance; cd/m2 of a light of 1; smallest light
            of glare that veils a pixel.
        luminance: output [H, W], cd/m2; or empty [0, 0] for none.
        is_veiled: output [H, W].
    """
    zero = np.float32(0)
    quarter = np.float32(0.25)
    has_glare = glare.shape[0] > 0
    has_luminance = luminance.shape[0] > 0
    red_weight = numbers[0]
    green_weight = numbers[1]
    blue_weight = numbers[2]
    least_veil = numbers[4]
    width = Index(rgb.shape[1])
    last = glare.shape[1] - 1
    for i in prange(rgb.shape[0]):
        veils = np.zeros(rgb.shape[1], np.float32)
        brightest = zero
        if has_glare:
            # Centres of the coarse pixels lie between those of the fine ones: shares 1/4 and 3/4.
            nearest = glare[i // 2]
            other = glare[min(max(i // 2 + 2 * (i % 2) - 1, 0), glare.shape[0] - 1)]
            row = np.empty(glare.shape[1], np.float32)
            for j in range(glare.shape[1]):
                value = red_weight * (nearest[j, 0] + quarter * (other[j, 0] - nearest[j, 0]))
                value += green_weight * (nearest[j, 1] + quarter * (other[j, 1] - nearest[j, 1]))
                value += blue_weight * (nearest[j, 2] + quarter * (other[j, 2] - nearest[j, 2]))
                row[j] = value
                brightest = max(brightest, value)
            if has_luminance or brightest >= least_veil:
                for j in range(rgb.shape[1]):
                    k = j // 2
                    beside = row[min(max(k + 2 * (j % 2) - 1, 0), last)]
                    veils[j] = row[k] + quarter * (beside - row[k])
        if not has_luminance and brightest < least_veil:
            for j in range(rgb.shape[1]):
                is_veiled[i, j] = False
            continue
        lights = np.empty(rgb.shape[1], np.float32)
        has_high = False
        for j in range(Index(0), width, Index(1)):
            red = max(rgb[i, j, 0], zero)
            green = max(rgb[i, j, 1], zero)
            blue = max(rgb[i, j, 2], zero)
            light = red_weight * light_of_code(min(red, MAX_CODE))
            light += green_weight * light_of_code(min(green, MAX_CODE))
            lights[j] = light + blue_weight * light_of_code(min(blue, MAX_CODE))
            has_high |= max(red, green, blue) > MAX_CODE
        if has_high:
            for j in range(rgb.shape[1]):
                if max(rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2]) > MAX_CODE:
                    light = zero
                    for k in range(3):
                        code = max(rgb[i, j, k], zero)
                        value = light_of_high_code(code) if code > MAX_CODE else light_of_code(code)
                        light += numbers[k] * value
                    lights[j] = light
        for j in range(Index(0), width, Index(1)):
            is_veiled[i, j] = (veils[j] > lights[j]) & (veils[j] >= least_veil)
        if has_luminance:
            for j in range(Index(0), width, Index(1)):
                luminance[i, j] = (lights[j] + veils[j]) * numbers[3]
