"""Numba kernels for passes over finished pictures: airlight by elevation, forward scatter in fog, a
camera's noise. Loops are of one task each, which LLVM writes as vectors.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.composite_kernels import airlight_gain, layered_way
from augment.render.cpu.jit import inner, kernel
from augment.render.fog import MAX_EXPONENT
from augment.render.layout import U


@inner()
def decay(y):
    """exp(-y) for |y| <= 80, within 5e-6 of 1: of plain sums, which LLVM writes as vectors."""
    z = y * np.float32(-1 / 64)
    one = np.float32(1)
    p = one + z * np.float32(1 / 4) * (one + z * np.float32(1 / 5))
    p = one + z * (one + z * np.float32(1 / 2) * (one + z * np.float32(1 / 3) * p))
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@kernel
def add_elevation(rgb, alpha, depth, u, v, rise, medium, gains, varying, behind):
    """rgb += alpha (1 - t) gain varying, in place: what elevation adds to the airlight; of endless
    fog behind also (1 - alpha) (behind + gain varying).

    depth: [H, W], z. u [W], v [H]: image coordinates at unit depth. rise [3]: world z along the
    camera's axes. medium: extinction at its base, height of the eye above that in scale heights,
    1 / scale height (0 of uniform fog). gains: as of airlight_gain. behind: airlight [3], or empty.
    All float32.
    """
    sigma, eye, per_height = medium[0], medium[1], medium[2]
    one, most = np.float32(1), np.float32(MAX_EXPONENT)
    width, uncovered = alpha.shape[1], np.float32(behind.size > 0)
    for i in prange(alpha.shape[0]):
        share = np.empty(width, np.float32)
        far, up = one + v[i] * v[i], v[i] * rise[1] + rise[2]
        for j in range(width):
            share[j] = sigma * depth[i, j] * math.sqrt(u[j] * u[j] + far)
        if per_height > 0:
            for j in range(width):
                climb = depth[i, j] * (u[j] * rise[0] + up) * per_height
                share[j] = layered_way(share[j], eye, climb)
        for j in range(width):
            slope = (u[j] * rise[0] + up) / math.sqrt(u[j] * u[j] + far)
            fogged = alpha[i, j] * (one - decay(min(share[j], most)))
            fogged += uncovered * (one - alpha[i, j])
            share[j] = fogged * airlight_gain(slope, gains)
        for j in range(width):
            for c in range(U(3)):
                rgb[i, j, c] += share[j] * varying[c]
                if uncovered > 0:
                    rgb[i, j, c] += (one - alpha[i, j]) * behind[c]


@kernel
def scattered_share(alpha, depth, u, v, climb, strength, sigma, medium, out):
    """out [H, W] = 1 - exp(-strength tau) of every pixel; without a depth it shows sky.

    u [W], v [H]: image coordinates at unit depth. climb [3]: the world's z along the camera's axes.
    sigma: extinction at the eye's height. medium: 1 / scale height, which is 0 in uniform fog. All
    float32.
    """
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    limit = np.float32(80)  # exp(80) is still finite, and nothing is seen through as much
    for i in prange(depth.shape[0]):
        far, up = one + v[i] * v[i], climb[1] * v[i] + climb[2]
        if medium > zero:
            for j in range(depth.shape[1]):
                length, slope = math.sqrt(u[j] * u[j] + far), climb[0] * u[j] + up
                x = slope * depth[i, j] * medium  # scale heights up to the surface
                x = min(max(x, -limit), np.float32(1e6))
                near = abs(x) < np.float32(0.02)
                series = one - half * x * (one - x * np.float32(1 / 3))
                share = (one - decay(min(x, limit))) / (one if near else x)
                tau = sigma * depth[i, j] * length * (series if near else share)
                # Of a ray that does not climb the limit, too: it ends in the deepest fog.
                sky = strength * sigma / medium * length / max(slope, np.float32(1e-30))
                behind = one - decay(min(sky, limit))
                share = one - decay(min(strength * tau, limit))
                shown = alpha[i, j] if depth[i, j] > zero else zero
                out[i, j] = min(max(behind + shown * (share - behind), zero), one)
        else:
            for j in range(depth.shape[1]):
                tau = strength * sigma * depth[i, j] * math.sqrt(u[j] * u[j] + far)
                shown = alpha[i, j] if depth[i, j] > zero else zero
                out[i, j] = min(max(one - shown * decay(min(tau, limit)), zero), one)


@kernel
def weigh(rgb, weight, around, least, out):
    """out [H, W, 4] = (rgb, 1) weight / sqrt(around), and around becomes 1 / sqrt(around)."""
    for i in prange(weight.shape[0]):
        for j in range(weight.shape[1]):
            around[i, j] = np.float32(1) / math.sqrt(around[i, j] + least)
            own = weight[i, j] * around[i, j]
            out[i, j, 0], out[i, j, 1] = rgb[i, j, 0] * own, rgb[i, j, 1] * own
            out[i, j, 2], out[i, j, 3] = rgb[i, j, 2] * own, own


@kernel
def multiply(image, factors, factor):
    """image [H, W, 4] times factors [H, W] and factor, in place."""
    for i in prange(image.shape[0]):
        for j in range(image.shape[1]):
            own = factors[i, j] * factor
            for c in range(4):
                image[i, j, c] *= own


@kernel
def blend_scattered(rgb, weight, spread):
    """rgb + w (spread - rgb n), in place. weight [H, W]: w. spread [H, W, 4]: colours, n."""
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            w = weight[i, j]
            kept = np.float32(1) - w * spread[i, j, 3]
            red, green, blue = rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2]
            rgb[i, j, 0] = red * kept + w * spread[i, j, 0]
            rgb[i, j, 1] = green * kept + w * spread[i, j, 1]
            rgb[i, j, 2] = blue * kept + w * spread[i, j, 2]


@kernel
def add_noise(values, draws, sigmas):
    """values + sigmas[their 8-bit level] (draws - 128), in place; [H, 3 W], draws: uint8."""
    half, top, middle = np.float32(0.5), np.float32(255), np.float32(128)
    for i in prange(values.shape[0]):
        levels = np.empty(values.shape[1], np.uint8)
        for j in range(values.shape[1]):
            levels[j] = np.uint8(min(max(values[i, j] * top + half, np.float32(0)), top))
        for j in range(values.shape[1]):
            values[i, j] += sigmas[levels[j]] * (np.float32(draws[i, j]) - middle)
