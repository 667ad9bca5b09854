"""Numba kernels: pictures between display-encoded colours and light, with lamps' light and noise.

`picture_light` launches them and holds their plain definitions. The sRGB curve is a polynomial in
roots of its argument, so that the compiler computes many values at a time. Loops over rows have no
branches for the same reason; rare values are computed again afterwards.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.effects.lamps.exposure import SHOULDER_START
from augment.render.cpu.jit import kernel, kernel_function

# Largest display-encoded value of the polynomial.
MAX_CODE = np.float32(2.0)
# Pixels of a row that are looked at together.
BLOCK_PX = 64
# Largest light of the polynomial.
MAX_LIGHT = np.float32(6.25)
# Display-encoded value and light at which the curve's straight part ends.
_STRAIGHT_CODE = np.float32(0.04045)
_STRAIGHT_LIGHT = np.float32(0.0031308)
# Coefficients of s^4.8, s the square root of (code + 0.055) / 1.055; relative error 1e-5.
_LIGHT_6 = np.float32(-0.0324186193)  # of power 6
_LIGHT_5 = np.float32(0.798360325)  # of power 5
_LIGHT_4 = np.float32(0.324210979)  # of power 4
_LIGHT_3 = np.float32(-0.118590484)  # of power 3
_LIGHT_2 = np.float32(0.0335866892)  # of power 2
_LIGHT_1 = np.float32(-0.00554995448)  # of power 1
_LIGHT_0 = np.float32(0.000393252227)  # of power 0
# Coefficients of r^(10/3), r the eighth root of light; relative error 2e-6.
_CODE_5 = np.float32(-0.0279651528)  # of power 5
_CODE_4 = np.float32(0.28113043)  # of power 4
_CODE_3 = np.float32(0.883903099)  # of power 3
_CODE_2 = np.float32(-0.169741873)  # of power 2
_CODE_1 = np.float32(0.0364163367)  # of power 1
_CODE_0 = np.float32(-0.00374462632)  # of power 0
# Coefficients of exp(-v), v from 0 to 0.9; relative error 1e-6.
_EXP_5 = np.float32(-0.00527526277)  # of power 5
_EXP_4 = np.float32(0.0387034282)  # of power 4
_EXP_3 = np.float32(-0.165271526)  # of power 3
_EXP_2 = np.float32(0.499693296)  # of power 2
_EXP_1 = np.float32(-0.999974538)  # of power 1
_EXP_0 = np.float32(1)  # of power 0; exactly 1, so that black stays black
# Light from which on the response curve bends, and what is left of the range above it.
_SHOULDER_START = np.float32(SHOULDER_START)
_SHOULDER_ROOM = np.float32(1 - SHOULDER_START)


@kernel_function()
def light_of_code(code):
    """Return the linear light of a display-encoded value from 0 to MAX_CODE."""
    s = np.float32(math.sqrt((code + np.float32(0.055)) * np.float32(1 / 1.055)))
    light = _LIGHT_6 * s + _LIGHT_5
    light = light * s + _LIGHT_4
    light = light * s + _LIGHT_3
    light = light * s + _LIGHT_2
    light = light * s + _LIGHT_1
    light = light * s + _LIGHT_0
    return light if code > _STRAIGHT_CODE else code * np.float32(1 / 12.92)


@kernel_function()
def light_of_high_code(code):
    """Return the linear light of a display-encoded value above MAX_CODE."""
    return np.float32(((code + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4))


@kernel_function()
def code_of_light(light):
    """Return the display-encoded value of linear light from 0 to MAX_LIGHT."""
    r = np.float32(math.sqrt(np.float32(math.sqrt(np.float32(math.sqrt(light))))))
    code = _CODE_5 * r + _CODE_4
    code = code * r + _CODE_3
    code = code * r + _CODE_2
    code = code * r + _CODE_1
    code = code * r + _CODE_0
    code = np.float32(1.055) * code - np.float32(0.055)
    return code if light > _STRAIGHT_LIGHT else light * np.float32(12.92)


@kernel_function()
def code_of_high_light(light):
    """Return the display-encoded value of linear light above MAX_LIGHT."""
    return np.float32(1.055) * np.float32(light ** np.float32(1 / 2.4)) - np.float32(0.055)


@kernel_function()
def bent_by_shoulder(light):
    """Return the light of the response curve for exposed light from 0 to MAX_LIGHT."""
    beyond = max(light - _SHOULDER_START, np.float32(0))
    v = beyond * (np.float32(1 / 16) / _SHOULDER_ROOM)
    fall = _EXP_5 * v + _EXP_4
    fall = fall * v + _EXP_3
    fall = fall * v + _EXP_2
    fall = fall * v + _EXP_1
    fall = fall * v + _EXP_0
    for _ in range(4):  # the sixteenth power
        fall *= fall
    return min(light, _SHOULDER_START) + _SHOULDER_ROOM * (np.float32(1) - fall)


@kernel
def relight(rgb, added, gains, min_added, out, mask):
    """Scale a picture's light and add that of lamps. All floats are float32.

    Args:
        rgb: the picture, display-encoded, [H, 3 W].
        added: luminance that lamps add, cd/m2, [H, 3 W]; or empty [0, 0] for none.
        gains: factor of the picture's own light, factor of the added light, smallest light that
            lamps must add for a saturated pixel to be theirs.
        min_added: pixels keep their bits if no channel gets more light than this; negative to
            change all.
        out: output [H, 3 W], display-encoded, may exceed 1.
        mask: output [H, W], True where lamps saturate the pixel.
    """
    gain = gains[0]
    added_gain = gains[1]
    min_lamp = gains[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    has_lamps = added.shape[0] > 0
    width = mask.shape[1]
    for i in prange(rgb.shape[0]):
        codes = rgb[i]
        results = out[i]
        lights = np.zeros(3 * BLOCK_PX, np.float32)
        for first in range(0, width, BLOCK_PX):
            begin = 3 * first
            num_pixels = min(BLOCK_PX, width - first)
            for j in range(num_pixels):
                mask[i, first + j] = False
            num_lit = 0
            if has_lamps:
                for j in range(3 * num_pixels):
                    lights[j] = added_gain * added[i, begin + j]
                    num_lit += lights[j] > min_added
            if min_added >= zero and num_lit == 0:
                for j in range(3 * num_pixels):
                    results[begin + j] = codes[begin + j]
                continue
            num_high = 0
            for j in range(3 * num_pixels):
                code = max(codes[begin + j], zero)
                light = lights[j] + gain * light_of_code(min(code, MAX_CODE))
                results[begin + j] = code_of_light(min(light, MAX_LIGHT))
                num_high += (light >= one_f32) | (code > MAX_CODE)
            if num_high == 0 and (min_added < zero or num_lit == 3 * num_pixels):
                continue
            for j in range(num_pixels):
                most = max(lights[3 * j], lights[3 * j + 1], lights[3 * j + 2])
                if most <= min_added:
                    for k in range(begin + 3 * j, begin + 3 * j + 3):
                        results[k] = codes[k]
                    continue
                if num_high == 0:
                    continue
                brightest = zero
                for k in range(3 * j, 3 * j + 3):
                    code = max(codes[begin + k], zero)
                    if code > MAX_CODE:
                        light = lights[k] + gain * light_of_high_code(code)
                        results[begin + k] = code_of_light(min(light, MAX_LIGHT))
                    else:
                        light = lights[k] + gain * light_of_code(code)
                    if light > MAX_LIGHT:
                        results[begin + k] = code_of_high_light(light)
                    brightest = max(brightest, light)
                mask[i, first + j] = brightest >= one_f32 and most >= min_lamp


@kernel
def decode(rgb, out):
    """Write the light of float32 rows of codes; codes below 0 count as 0."""
    zero = np.float32(0)
    for i in prange(rgb.shape[0]):
        codes = rgb[i]
        lights = out[i]
        num_high = 0
        for j in range(len(codes)):
            code = max(codes[j], zero)
            lights[j] = light_of_code(min(code, MAX_CODE))
            num_high += code > MAX_CODE
        if num_high > 0:
            for j in range(len(codes)):
                if codes[j] > MAX_CODE:
                    lights[j] = light_of_high_code(codes[j])


@kernel
def develop(light, glare, draws, numbers, out):
    """Write the picture that a sensor makes of light. All floats are float32.

    Args:
        light: exposed linear light, [H, 3 W]; 1 saturates the sensor.
        glare: light that the lens scatters, [H, 3 W]; or empty [0, 0].
        draws: normal numbers in 8 bits about 128, [H, 3 W]; or empty [0, 0] for no noise.
        numbers: crosstalk, variance per light, variance of reading; both variances for a draw of
            1 about 128.
        out: output [H, 3 W], display-encoded.
    """
    crosstalk = numbers[0]
    per_light = numbers[1]
    of_reading = numbers[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    middle = np.float32(128)
    has_glare = glare.shape[0] > 0
    has_noise = draws.shape[0] > 0
    for i in prange(light.shape[0]):
        lights = light[i]
        results = out[i]
        num_values = len(lights)
        values = np.empty(num_values, np.float32)
        num_high = 0
        if has_glare:
            scattered = glare[i]
            for j in range(num_values):
                values[j] = lights[j] + scattered[j]
                num_high += values[j] > one_f32
        else:
            for j in range(num_values):
                values[j] = lights[j]
                num_high += values[j] > one_f32
        if num_high > 0:
            for j in range(0, num_values, 3):
                red = max(values[j] - one_f32, zero)
                green = max(values[j + 1] - one_f32, zero)
                blue = max(values[j + 2] - one_f32, zero)
                values[j] += crosstalk * (green + blue)
                values[j + 1] += crosstalk * (red + blue)
                values[j + 2] += crosstalk * (red + green)
        if has_noise:
            numbers_row = draws[i]
            for j in range(num_values):
                variance = per_light * max(values[j], zero) + of_reading
                draw = np.float32(numbers_row[j]) - middle
                values[j] += draw * np.float32(math.sqrt(variance))
        for j in range(num_values):
            value = min(max(values[j], zero), MAX_LIGHT)
            results[j] = code_of_light(bent_by_shoulder(value))


@kernel
def find_reflectance(rgb, fog_share, airlight, numbers, out):
    """Write the reflectance of surfaces, times the transmittance of the fog before them.

    All floats are float32.

    Args:
        rgb: the picture, display-encoded, [H, 3 W].
        fog_share: share of the airlight in each pixel, [H, W]; or empty [0, 0] for none.
        airlight: linear light of the fog, [3].
        numbers: inverse of the linear light of white, least and greatest reflectance.
        out: output [H, 3 W].
    """
    per_white = numbers[0]
    least = numbers[1]
    most = numbers[2]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    has_fog = fog_share.shape[0] > 0
    for i in prange(rgb.shape[0]):
        codes = rgb[i]
        results = out[i]
        if has_fog:
            shares = fog_share[i]
            for j in range(len(shares)):
                share = min(max(shares[j], zero), one_f32)
                through = one_f32 - share
                for k in range(3):
                    code = min(max(codes[3 * j + k], zero), MAX_CODE)
                    light = (light_of_code(code) - share * airlight[k]) * per_white
                    results[3 * j + k] = min(max(light, least * through), most * through)
        else:
            for j in range(len(codes)):
                code = min(max(codes[j], zero), MAX_CODE)
                results[j] = min(max(light_of_code(code) * per_white, least), most)


@kernel
def saturated_light(light, out):
    """Write the light beyond saturation, the mean of each block of two by two pixels.

    Args:
        light: exposed linear light, float32 [H, 3 W]; 1 saturates the sensor.
        out: output float32 [h, 3 w], h >= H / 2, w >= W / 2; beyond the picture it is 0.
    """
    height, num_values = light.shape
    one_f32 = np.float32(1)
    zero = np.float32(0)
    quarter = np.float32(0.25)
    for i in prange(out.shape[0]):
        results = out[i]
        for j in range(len(results)):
            results[j] = zero
        for row in range(2 * i, min(2 * i + 2, height)):
            lights = light[row]
            num_high = 0
            for j in range(num_values):
                num_high += lights[j] > one_f32
            if num_high > 0:
                for j in range(num_values):
                    excess = lights[j] - one_f32
                    if excess > zero:
                        results[j // 6 * 3 + j % 3] += quarter * excess
