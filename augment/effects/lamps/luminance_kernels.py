"""Numba kernel: the luminance of exposed pictures, and where the lens's glare outshines them.

`luminance` launches it and holds its plain definition.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.effects.lamps.light_kernels import MAX_CODE, light_of_code, light_of_high_code
from augment.render.cpu.jit import kernel


@kernel
def measure_luminance(rgb, glare, numbers, luminance, is_veiled):
    """Write the luminance of each pixel, and whether glare is most of it. All floats are float32.

    Args:
        rgb: exposed picture, display-encoded, [H, W, 3]; 1 saturates the sensor.
        glare: light that the lens scatters, [H, W, 3]; or empty [0, 0, 3] for none.
        numbers: weights of red, green and blue in luminance; cd/m2 of a light of 1; smallest light
            of glare that veils a pixel.
        luminance: output [H, W], cd/m2; or empty [0, 0] for none.
        is_veiled: output [H, W].
    """
    zero = np.float32(0)
    has_glare = glare.shape[0] > 0
    has_luminance = luminance.shape[0] > 0
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            light = zero
            veil = zero
            for k in range(3):
                code = max(rgb[i, j, k], zero)
                value = light_of_high_code(code) if code > MAX_CODE else light_of_code(code)
                light += numbers[k] * value
                if has_glare:
                    veil += numbers[k] * glare[i, j, k]
            is_veiled[i, j] = veil > light and veil >= numbers[4]
            if has_luminance:
                luminance[i, j] = (light + veil) * numbers[3]
