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
from augment.render.layout import Index

# Largest display-encoded value of the polynomial.
MAX_CODE = np.float32(2.0)
# Display-encoded value below which a colour does not saturate, whatever the rounding.
NEARLY_ONE = np.float32(0.999)
# Values of a row that are computed together: 64 pixels. Rare values are looked for in those blocks
# that have one.
BLOCK = 192
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
# Coefficients of exp(-v), v from 0 to 0.9; relative error 1e-6, none at 0.
_EXP_5 = np.float32(-0.00527526277)  # of power 5
_EXP_4 = np.float32(0.0387034282)  # of power 4
_EXP_3 = np.float32(-0.165271526)  # of power 3
_EXP_2 = np.float32(0.499693296)  # of power 2
_EXP_1 = np.float32(-0.999974538)  # of power 1
_EXP_0 = np.float32(1.0)  # of power 0
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
        lights = np.empty(3 * width, np.float32)
        for j in range(width):
            mask[i, j] = False
        if has_lamps:
            lamps = added[i]
            has_high = False
            for j in range(3 * width):
                lights[j] = added_gain * lamps[j]
                has_high |= lights[j] > min_added
            if min_added >= zero and not has_high:
                for j in range(3 * width):
                    results[j] = codes[j]
                continue
        else:
            for j in range(3 * width):
                lights[j] = zero
        for block in range(0, 3 * width, BLOCK):
            start = Index(block)
            end = Index(min(block + BLOCK, 3 * width))
            has_high = False
            for j in range(start, end):
                code = max(codes[j], zero)
                light = lights[j] + gain * light_of_code(min(code, MAX_CODE))
                results[j] = code_of_light(min(light, MAX_LIGHT))
                has_high |= (light >= one_f32) | (code > MAX_CODE)
            if min_added < zero and not has_high:
                continue
            for at in range(start, end, Index(3)):
                most = max(lights[at], lights[at + Index(1)], lights[at + Index(2)])
                if most <= min_added:
                    for k in range(at, at + Index(3)):
                        results[k] = codes[k]
                    continue
                highest_code = max(codes[at], codes[at + Index(1)], codes[at + Index(2)])
                highest = max(results[at], results[at + Index(1)], results[at + Index(2)])
                if highest_code <= MAX_CODE and highest < NEARLY_ONE:
                    continue
                brightest = zero
                for k in range(at, at + Index(3)):
                    code = max(codes[k], zero)
                    if code > MAX_CODE:
                        light = lights[k] + gain * light_of_high_code(code)
                        results[k] = code_of_light(min(light, MAX_LIGHT))
                    else:
                        light = lights[k] + gain * light_of_code(code)
                    if light > MAX_LIGHT:
                        results[k] = code_of_high_light(light)
                    brightest = max(brightest, light)
                mask[i, at // Index(3)] = brightest >= one_f32 and most >= min_lamp


@kernel
def halve_excess(rgb, out, is_saturated):
    """Write the light beyond saturation at half the resolution. All floats are float32.

    Args:
        rgb: exposed picture, display-encoded, [H, 3 W]; 1 saturates the sensor.
        out: output [h, 3 w], the mean of four pixels; it may reach beyond the picture.
        is_saturated: output bool [h], True for rows with a value beyond saturation.
    """
    zero = np.float32(0)
    one_f32 = np.float32(1)
    quarter = np.float32(0.25)
    for i in prange(out.shape[0]):
        results = out[i]
        is_saturated[i] = False
        for j in range(len(results)):
            results[j] = zero
        for row in range(2 * i, min(2 * i + 2, rgb.shape[0])):
            codes = rgb[row]
            has_high = False
            for j in range(len(codes)):
                has_high |= codes[j] > one_f32
            is_saturated[i] |= has_high
            if not has_high:
                continue
            for j in range(len(codes)):
                code = codes[j]
                if code > one_f32:
                    light = light_of_high_code(code) if code > MAX_CODE else light_of_code(code)
                    results[j // 6 * 3 + j % 3] += quarter * max(light - one_f32, zero)


@kernel
def develop(rgb, glare, draws, numbers, out):
    """Write the picture that a sensor makes of light. All floats are float32.

    Args:
        rgb: exposed picture, display-encoded, [H, 3 W]; 1 saturates the sensor.
        glare: light that the lens scatters, [h, 3 w], at half the resolution; or empty [0, 0].
        draws: normal numbers in 8 bits about 128, [H, 3 W]; or empty [0, 0] for no noise.
        numbers: crosstalk, variance per light, variance of reading; both variances for a draw of
            1 about 128; factors of the three channels for the white balance; largest light
            beyond saturation that leaks.
        out: output [H, 3 W], display-encoded.
    """
    crosstalk = numbers[0]
    per_light = numbers[1]
    of_reading = numbers[2]
    red_factor = numbers[3]
    green_factor = numbers[4]
    blue_factor = numbers[5]
    leaking = numbers[6]
    zero = np.float32(0)
    one_f32 = np.float32(1)
    middle = np.float32(128)
    quarter = np.float32(0.25)
    has_glare = glare.shape[0] > 0
    has_noise = draws.shape[0] > 0
    for i in prange(rgb.shape[0]):
        codes = rgb[i]
        results = out[i]
        num_values = len(codes)
        values = np.empty(num_values, np.float32)
        has_high = False
        for j in range(num_values):
            code = max(codes[j], zero)
            values[j] = light_of_code(min(code, MAX_CODE))
            has_high |= code > MAX_CODE
        if has_high:
            for j in range(num_values):
                if codes[j] > MAX_CODE:
                    values[j] = light_of_high_code(codes[j])
        if has_glare:
            # Centres of the coarse pixels lie between those of the fine ones: shares 1/4 and 3/4.
            nearest = glare[i // 2]
            other = glare[min(max(i // 2 + 2 * (i % 2) - 1, 0), glare.shape[0] - 1)]
            last = len(nearest) - 3
            mean = np.empty(len(nearest) + 6, np.float32)
            for j in range(len(nearest)):
                mean[3 + j] = nearest[j] + quarter * (other[j] - nearest[j])
            for k in range(3):
                mean[k] = mean[3 + k]
                mean[last + 6 + k] = mean[last + 3 + k]
            for j in range(num_values // 6):
                for k in range(3):
                    light = mean[3 * j + 3 + k]
                    values[6 * j + k] += light + quarter * (mean[3 * j + k] - light)
                    values[6 * j + 3 + k] += light + quarter * (mean[3 * j + 6 + k] - light)
            for j in range(num_values // 6 * 6, num_values):
                at = j // 6 * 3 + 3 + j % 3
                values[j] += mean[at] + quarter * (mean[at - 3] - mean[at])
        for block in range(0, num_values, BLOCK):
            start = Index(block)
            end = Index(min(block + BLOCK, num_values))
            has_high = False
            for j in range(start, end):
                has_high |= values[j] > one_f32
            if has_high:
                for j in range(start, end, Index(3)):
                    red = min(max(values[j] - one_f32, zero), leaking)
                    green = min(max(values[j + Index(1)] - one_f32, zero), leaking)
                    blue = min(max(values[j + Index(2)] - one_f32, zero), leaking)
                    values[j] += crosstalk * (green + blue)
                    values[j + Index(1)] += crosstalk * (red + blue)
                    values[j + Index(2)] += crosstalk * (red + green)
            if has_noise:
                noise = draws[i]
                for j in range(start, end):
                    variance = per_light * max(values[j], zero) + of_reading
                    draw = np.float32(noise[j]) - middle
                    values[j] += draw * np.float32(math.sqrt(variance))
            for j in range(start, end, Index(3)):
                values[j] *= red_factor
                values[j + Index(1)] *= green_factor
                values[j + Index(2)] *= blue_factor
            has_bent = False
            for j in range(start, end):
                value = min(max(values[j], zero), MAX_LIGHT)
                results[j] = code_of_light(value)
                has_bent |= value > _SHOULDER_START
            if has_bent:
                for j in range(start, end):
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
def find_surfaces(alpha, depth, min_alpha, surface_m):
    """Write the depth of pixels that show a surface.

    Args:
        alpha: opacity, float32 [H, W].
        depth: z of what the pixels show, metres, float32 [H, W].
        min_alpha: opacity from which on a pixel shows a surface.
        surface_m: output, z of the surfaces, 0 without one or where z is not finite.
    """
    zero = np.float32(0)
    largest = np.float32(np.finfo(np.float32).max)
    for i in prange(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            z = depth[i, j]
            is_surface = (alpha[i, j] >= min_alpha) & (abs(z) <= largest)
            surface_m[i, j] = z if is_surface else zero
