"""Numba kernels that split near discs of snow into finer ones; `augment.snow.close` launches."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.render.sh import SH_C0
from augment.snow.splat_kernels import SPREAD

REACH = 1.4  # cells that a disc's parts cover: discs lie scattered, up to so far apart
FARTHEST_M = 10.0  # from the camera: discs farther away stay whole
MOST_SPLITS = 3  # of a disc, along each of its sides
MARGIN = 0.15  # of the image's half width or height: discs so far outside are split as well
TEXEL_M = 0.01  # of the table of noise that the grain follows
COARSER = 0.37  # how fast the table is read a second time, turned: for clods
CRUMB, CLOD = 0.6, 0.4  # shares of the two


@kernel
def count_splits(means, scales, pose, limits, finest, splits):
    """Into how many discs along each side every disc is split, uint8 [S]; 0 where it stays whole.

    pose: camera_from_part, float64 [3, 4]. limits: lowest and highest x / z, then y / z. finest:
    standard deviation of a disc over its distance, that splitting stops at.
    """
    for i in prange(len(splits)):
        x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        right = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        down = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        away = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        distance = math.sqrt(right * right + down * down + away * away)
        splits[i] = 0
        if away <= 0.0 or distance >= FARTHEST_M:
            continue
        if not (limits[0] * away <= right <= limits[1] * away):
            continue
        if not (limits[2] * away <= down <= limits[3] * away):
            continue
        side = REACH * np.float64(max(scales[i, 0], scales[i, 1]))
        count = min(math.floor(side / (finest * distance) + 0.5), MOST_SPLITS)
        splits[i] = count if count > 1 else 0


@inner()
def _grain(x, y, z, shift, noise):
    """The noise that the grain follows, at a place in metres: two scales of one table."""
    mask, texel = noise.shape[0] - 1, 1.0 / TEXEL_M
    u, v = x + 0.7 * z + shift[0], y + 0.7 * z + shift[1]
    crumb = noise[np.int64(math.floor(u * texel)) & mask, np.int64(math.floor(v * texel)) & mask]
    u, v = (0.8 * u - 0.6 * v) * COARSER * texel, (0.6 * u + 0.8 * v) * COARSER * texel
    clod = noise[np.int64(math.floor(u)) & mask, np.int64(math.floor(v)) & mask]
    return CRUMB * crumb + CLOD * clod


@kernel
def split(
    chosen, splits, firsts, eye, sun, shift, noise, relief, mottle, finest,
    means, quats, scales, sh, slopes, fine_means, fine_quats, fine_scales, fine_sh, fine_slopes,
):  # fmt: skip
    """The finer discs of the chosen ones, splits[c]^2 of each from index firsts[c] on.

    eye: the camera's centre; sun: its level direction times half a step in metres, in the part's
    frame. shift, noise: see `_grain`. relief: brightness per fall of the noise towards the sun;
    mottle: per noise. finest: as for count_splits. slopes, fine_slopes: [., 3] or empty. The arrays
    are a part's Gaussians, sh [S, 1, 3].
    """
    for c in prange(len(chosen)):
        i, n = chosen[c], np.int64(splits[c])
        w, x = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        y, z = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        ux, uy, uz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
        vx, vy, vz = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        far = math.sqrt((mx - eye[0]) ** 2 + (my - eye[1]) ** 2 + (mz - eye[2]) ** 2)
        fade = min(max(2.0 * (1.0 - far / FARTHEST_M), 0.0), 1.0)
        side = REACH * np.float64(max(scales[i, 0], scales[i, 1]))
        fade *= min(
            max(2.0 * side / (finest * far) - 3.0, 0.0), 1.0
        )  # 0 where discs grow whole again
        wide, deep = REACH * np.float64(scales[i, 0]), REACH * np.float64(scales[i, 1])
        along, across = wide / SPREAD, deep / SPREAD
        s = firsts[c]
        for j in range(n):
            p = ((j + 0.5) / n - 0.5) * along
            for k in range(n):
                q = ((k + 0.5) / n - 0.5) * across
                px, py, pz = mx + p * ux + q * vx, my + p * uy + q * vy, mz + p * uz + q * vz
                fine_means[s, 0], fine_means[s, 1] = np.float32(px), np.float32(py)
                fine_means[s, 2] = np.float32(pz)
                for axis in range(4):
                    fine_quats[s, axis] = quats[i, axis]
                fine_scales[s, 0], fine_scales[s, 1] = np.float32(wide / n), np.float32(deep / n)
                fine_scales[s, 2] = scales[i, 2]
                behind = _grain(px - sun[0], py - sun[1], pz, shift, noise)
                sunward = _grain(px + sun[0], py + sun[1], pz, shift, noise)
                bright = relief * (behind - sunward) + 0.5 * mottle * (behind + sunward)
                factor = 1.0 + fade * bright
                for channel in range(3):
                    color = 0.5 + SH_C0 * np.float64(sh[i, 0, channel])
                    fine_sh[s, 0, channel] = np.float32((factor * color - 0.5) / SH_C0)
                    if len(slopes) > 0:
                        fine_slopes[s, channel] = np.float32(factor * slopes[i, channel])
                s += 1
