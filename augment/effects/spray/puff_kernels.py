"""A numba kernel: puffs of spray before a picture."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel


@kernel
def blend_puffs(rgb, depth, rays, puffs, windows, light, fog):
    """rgb [H, W, 3], in place: sqrt((1 - a) rgb^2 + a colour), a = 1 - exp(-tau), of the puffs'
    optical depth tau up to the surface. Pixels that no puff reaches keep their bits.

    depth [H, W]: z, infinity where there is no surface; float32. rays: fx, fy, cx, cy. puffs
    [N, 15]: whitening in camera axes, by rows; the centre, whitened; sqrt(2 pi) times extinction at
    the centre; the fog's transmittance up to it; the cut. windows [N, 5]: top, bottom, left, right,
    and how many pixels of a row share their middle's ray, but not its end.
    light, fog [3]: squared colours of spray, and of what stands before its share.
    """
    for i in prange(rgb.shape[0]):
        row = np.int64(i)
        taus = np.zeros(rgb.shape[1])
        clears = np.zeros(rgb.shape[1])
        v = (np.float64(row) + 0.5 - rays[3]) / rays[1]
        for n in range(len(puffs)):
            if row < windows[n, 0] or row >= windows[n, 1]:
                continue
            x0 = puffs[n, 1] * v + puffs[n, 2]
            y0 = puffs[n, 4] * v + puffs[n, 5]
            z0 = puffs[n, 7] * v + puffs[n, 8]
            cx = puffs[n, 9]
            cy = puffs[n, 10]
            cz = puffs[n, 11]
            cc = cx * cx + cy * cy + cz * cz
            run = windows[n, 4]
            for first in range(windows[n, 2], windows[n, 3], run):
                u = (np.float64(first) + 0.5 * run - rays[2]) / rays[0]
                x = x0 + puffs[n, 0] * u
                y = y0 + puffs[n, 3] * u
                z = z0 + puffs[n, 6] * u
                a = x * x + y * y + z * z
                nearest = (x * cx + y * cy + z * cz) / a  # z where the ray comes closest
                distance2 = cc - a * nearest * nearest
                if distance2 > puffs[n, 14]:
                    continue
                inverse_width = math.sqrt(0.5 * a)
                before = inverse_width * nearest
                entered = 1.0 if before > 4 else math.erf(before)  # within 1e-7
                ray_length = math.sqrt((1 + u * u + v * v) / a)
                half = 0.5 * puffs[n, 12] * ray_length * math.exp(-0.5 * distance2)
                for j in range(first, min(first + run, windows[n, 3])):
                    beyond = inverse_width * (np.float64(depth[row, j]) - nearest)
                    if beyond < -4:
                        continue
                    passed = entered + (1.0 if beyond > 4 else math.erf(beyond))
                    tau = half * max(passed, 0.0)
                    taus[j] += tau
                    clears[j] += tau * puffs[n, 13]
        for j in range(rgb.shape[1]):
            if taus[j] > 0:
                transmittance = math.exp(-taus[j])
                clear = clears[j] / taus[j]
                for k in range(3):
                    color = max(np.float64(rgb[row, j, k]), 0.0)
                    added_light = clear * light[k] + (1 - clear) * fog[k]
                    rgb[row, j, k] = math.sqrt(
                        transmittance * color * color + (1 - transmittance) * added_light
                    )
