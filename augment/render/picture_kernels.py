"""Numba kernels for passes over finished pictures: forward scatter in fog, and a camera's noise."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import inner, kernel


@inner()
def _decay(y):
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
def scattered_share(alpha, depth, rays, climb, strength, sigma, medium, out):
    """out [H, W] = 1 - exp(-strength tau) of every pixel; without a depth it shows sky.

    rays: 1 / fx, 1 / fy, cx, cy. climb: the world's z along the camera's axes. sigma: extinction at
    the eye's height. medium: 1 / scale height, which is 0 in uniform fog. All float32.
    """
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    limit = np.float32(80)  # exp(80) is still finite, and nothing is seen through as much
    for i in prange(depth.shape[0]):
        v = (np.float32(i) + half - rays[3]) * rays[1]
        for j in range(depth.shape[1]):
            u = (np.float32(j) + half - rays[2]) * rays[0]
            length = math.sqrt(one + u * u + v * v)
            tau = sigma * depth[i, j] * length
            behind = one
            if medium > zero:
                slope = climb[0] * u + climb[1] * v + climb[2]
                x = slope * depth[i, j] * medium  # scale heights up to the surface
                x = min(max(x, -limit), np.float32(1e6))
                near = abs(x) < np.float32(0.02)
                series = one - half * x * (one - x * np.float32(1 / 3))
                share = (one - _decay(min(x, limit))) / (one if near else x)
                tau *= series if near else share
                # Of a ray that does not climb the limit, too: it ends in the deepest fog.
                sky = strength * sigma / medium * length / max(slope, np.float32(1e-30))
                behind = one - _decay(min(sky, limit))
            share = one - _decay(min(strength * tau, limit))
            shown = alpha[i, j] if depth[i, j] > zero else zero
            share = behind + shown * (share - behind)
            out[i, j] = min(max(share, zero), one)


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
            own, n = weight[i, j], spread[i, j, 3]
            for c in range(3):
                color = rgb[i, j, c]
                rgb[i, j, c] = color + own * (spread[i, j, c] - color * n)


@kernel
def add_noise(rgb, draws, sigmas):
    """rgb + sigmas[rgb's 8-bit level] (draws - 128), in place; draws: uint8 [H, W, 3]."""
    half, top = np.float32(0.5), np.float32(255)
    for i in prange(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            for c in range(3):
                level = min(max(rgb[i, j, c] * top + half, np.float32(0)), top)
                sigma = sigmas[np.uint8(level)]
                rgb[i, j, c] += sigma * (np.float32(draws[i, j, c]) - np.float32(128))
