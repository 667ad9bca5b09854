"""Numba kernels for passes over finished images: airlight, forward scatter, and noise.

`composite`, `linear_airlight`, `scatter` and `sensor` launch them. Each loop does one task, which
lets LLVM vectorise it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.composite_kernels import airlight_gain, layered_distance
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import Index


@kernel_function()
def decay(y):
    """Return exp(-y) for |y| <= 80, within 5e-6 of 1, by plain sums that LLVM vectorises."""
    z = y * np.float32(-1 / 64)
    one_f32 = np.float32(1)
    p = one_f32 + z * np.float32(1 / 4) * (one_f32 + z * np.float32(1 / 5))
    p = one_f32 + z * (one_f32 + z * np.float32(1 / 2) * (one_f32 + z * np.float32(1 / 3) * p))
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@kernel
def add_elevation(rgb, alpha, depth, u, v, rise, fog_numbers, gains, varying, airlight_behind):
    """Add to rgb the airlight that elevation adds: rgb += alpha (1 - t) gain varying, in place.

    With endless fog behind, (1 - alpha) (behind + gain varying) is added, too. All arrays are
    float32.

    Args:
        rgb: [H, W, 3].
        alpha: [H, W].
        depth: z, [H, W], metres.
        u: image coordinates of the columns at unit depth, [W].
        v: image coordinates of the rows at unit depth, [H].
        rise: world z along the camera's axes, [3].
        fog_numbers: extinction at the base (1/m), height of the eye above it in scale heights, and
            1 / scale height (0 for uniform fog).
        gains: as in airlight_gain.
        varying: the share of the airlight that varies with elevation, [3].
        airlight_behind: airlight [3], or empty.
    """
    extinction_per_m = fog_numbers[0]
    eye_scale_heights = fog_numbers[1]
    per_height = fog_numbers[2]
    one_f32 = np.float32(1)
    max_exponent = np.float32(MAX_EXPONENT)
    width = alpha.shape[1]
    has_background = np.float32(airlight_behind.size > 0)
    for i in prange(alpha.shape[0]):
        share = np.empty(width, np.float32)
        row_length_squared = one_f32 + v[i] * v[i]
        row_rise = v[i] * rise[1] + rise[2]
        for j in range(width):
            share[j] = extinction_per_m * depth[i, j] * math.sqrt(u[j] * u[j] + row_length_squared)
        if per_height > 0:
            for j in range(width):
                climb = depth[i, j] * (u[j] * rise[0] + row_rise) * per_height
                share[j] = layered_distance(share[j], eye_scale_heights, climb)
        for j in range(width):
            slope = (u[j] * rise[0] + row_rise) / math.sqrt(u[j] * u[j] + row_length_squared)
            fog_share = alpha[i, j] * (one_f32 - decay(min(share[j], max_exponent)))
            fog_share += has_background * (one_f32 - alpha[i, j])
            share[j] = fog_share * airlight_gain(slope, gains)
        for j in range(width):
            for c in range(Index(3)):
                rgb[i, j, c] += share[j] * varying[c]
                if has_background > 0:
                    rgb[i, j, c] += (one_f32 - alpha[i, j]) * airlight_behind[c]


@kernel
def mix_linear_light(
    rgb, fog_share, u, v, rise, gains, airlight_rgb, varying_rgb, min_transmittance
):
    """Mix the airlight of a picture in linear light, in place (`linear_airlight`). All are float32.

    Args:
        rgb: [H, 3 W].
        fog_share: 1 - t, [H, W].
        u: image coordinates of the columns at unit depth, [W].
        v: image coordinates of the rows at unit depth, [H].
        rise: world z along the camera's axes, [3].
        gains: as in airlight_gain; zeros for the same airlight in all directions.
        airlight_rgb: airlight at the horizon, [3].
        varying_rgb: the share of the airlight that varies with elevation, [3].
        min_transmittance: smallest transmittance that is divided by.
    """
    zero = np.float32(0)
    one_f32 = np.float32(1)
    varies = gains[0] != zero
    width = fog_share.shape[1]
    for i in prange(rgb.shape[0]):
        # Plain arrays of all channels, which LLVM vectorises.
        shares = np.empty(3 * width, np.float32)
        airlight = np.empty(3 * width, np.float32)
        growth = np.zeros(width, np.float32)
        row_length_squared = one_f32 + v[i] * v[i]
        row_rise = v[i] * rise[1] + rise[2]
        if varies:
            for j in range(width):
                slope = (u[j] * rise[0] + row_rise) / math.sqrt(u[j] * u[j] + row_length_squared)
                growth[j] = airlight_gain(slope, gains)
        for j in range(width):
            for c in range(Index(3)):
                shares[3 * j + c] = fog_share[i, j]
                airlight[3 * j + c] = max(airlight_rgb[c] + growth[j] * varying_rgb[c], zero)
        for k in range(3 * width):
            share = shares[k]
            value = rgb[i, k]
            transmittance = one_f32 - share
            of_things = value - share * airlight[k]
            within = min(max(of_things, zero), transmittance)
            light = within * within / max(transmittance, min_transmittance)
            light += share * airlight[k] * airlight[k]
            mixed = math.sqrt(light) + (of_things - within)
            darkening = one_f32 / math.sqrt(max(share, min_transmittance))
            darker = min(value, zero) + max(value, zero) * darkening
            rgb[i, k] = darker if of_things < zero else mixed


@kernel
def scattered_share(
    alpha, depth, u, v, climb, strength, extinction_per_m, inverse_scale_height, out
):
    """Write out [H, W] = 1 - exp(-strength tau) of every pixel; a pixel without depth shows sky.

    All arrays are float32.

    Args:
        alpha: alpha of the surfaces, [H, W].
        depth: z of the surfaces, [H, W], metres.
        u: image coordinates of the columns at unit depth, [W].
        v: image coordinates of the rows at unit depth, [H].
        climb: world z along the camera's axes, [3].
        strength: factor of tau.
        extinction_per_m: extinction at the eye's height.
        inverse_scale_height: 1 / scale height; 0 for uniform fog.
        out: float32 [H, W].
    """
    zero = np.float32(0)
    half = np.float32(0.5)
    one_f32 = np.float32(1)
    limit = np.float32(80)  # exp(80) is still finite, and fog that deep is opaque
    for i in prange(depth.shape[0]):
        row_length_squared = one_f32 + v[i] * v[i]
        row_rise = climb[1] * v[i] + climb[2]
        if inverse_scale_height > zero:
            for j in range(depth.shape[1]):
                length = math.sqrt(u[j] * u[j] + row_length_squared)
                slope = climb[0] * u[j] + row_rise
                rise = slope * depth[i, j] * inverse_scale_height  # scale heights up to the surface
                rise = min(max(rise, -limit), np.float32(1e6))
                is_small = abs(rise) < np.float32(0.02)
                series = one_f32 - half * rise * (one_f32 - rise * np.float32(1 / 3))
                share = (one_f32 - decay(min(rise, limit))) / (one_f32 if is_small else rise)
                tau = extinction_per_m * depth[i, j] * length * (series if is_small else share)
                # A ray that does not climb has the limit, too: it ends in the deepest fog.
                sky_depth = (
                    strength
                    * extinction_per_m
                    / inverse_scale_height
                    * length
                    / max(slope, np.float32(1e-30))
                )
                sky_share = one_f32 - decay(min(sky_depth, limit))
                share = one_f32 - decay(min(strength * tau, limit))
                surface_alpha = alpha[i, j] if depth[i, j] > zero else zero
                out[i, j] = min(max(sky_share + surface_alpha * (share - sky_share), zero), one_f32)
        else:
            for j in range(depth.shape[1]):
                tau = (
                    strength
                    * extinction_per_m
                    * depth[i, j]
                    * math.sqrt(u[j] * u[j] + row_length_squared)
                )
                surface_alpha = alpha[i, j] if depth[i, j] > zero else zero
                out[i, j] = min(
                    max(one_f32 - surface_alpha * decay(min(tau, limit)), zero), one_f32
                )


@kernel
def weight_pixels(rgb, weight, neighbourhood_weight, min_weight, out):
    """Write out [H, W, 4] = (rgb, 1) weight / sqrt(neighbourhood_weight + min_weight).

    neighbourhood_weight becomes 1 / sqrt(neighbourhood_weight + min_weight).
    """
    for i in prange(weight.shape[0]):
        for j in range(weight.shape[1]):
            neighbourhood_weight[i, j] = np.float32(1) / math.sqrt(
                neighbourhood_weight[i, j] + min_weight
            )
            pixel_weight = weight[i, j] * neighbourhood_weight[i, j]
            out[i, j, 0] = rgb[i, j, 0] * pixel_weight
            out[i, j, 1] = rgb[i, j, 1] * pixel_weight
            out[i, j, 2] = rgb[i, j, 2] * pixel_weight
            out[i, j, 3] = pixel_weight


@kernel
def scale_pixels(image, factors, factor):
    """Multiply image [H, W, 4] by factors [H, W] and factor, in place."""
    for i in prange(image.shape[0]):
        for j in range(image.shape[1]):
            pixel_factor = factors[i, j] * factor
            for c in range(4):
                image[i, j, c] *= pixel_factor


@kernel
def blend_scattered(rgb, weight, spread):
    """Write rgb + w (spread - rgb n), in place.

    weight [H, W]: w. spread [H, W, 4]: colours, and n.
    """
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            w = weight[i, j]
            sharp_share = np.float32(1) - w * spread[i, j, 3]
            red = rgb[i, j, 0]
            green = rgb[i, j, 1]
            blue = rgb[i, j, 2]
            rgb[i, j, 0] = red * sharp_share + w * spread[i, j, 0]
            rgb[i, j, 1] = green * sharp_share + w * spread[i, j, 1]
            rgb[i, j, 2] = blue * sharp_share + w * spread[i, j, 2]


@kernel
def add_noise(values, draws, sigmas):
    """Add sigmas[8-bit level] (draws - 128) to values, in place.

    values: [H, 3 W]. draws: uint8 [H, 3 W]. sigmas: [256].
    """
    half = np.float32(0.5)
    max_level = np.float32(255)
    mean_draw = np.float32(128)
    for i in prange(values.shape[0]):
        levels = np.empty(values.shape[1], np.uint8)
        for j in range(values.shape[1]):
            levels[j] = np.uint8(
                min(max(values[i, j] * max_level + half, np.float32(0)), max_level)
            )
        for j in range(values.shape[1]):
            values[i, j] += sigmas[levels[j]] * (np.float32(draws[i, j]) - mean_draw)
