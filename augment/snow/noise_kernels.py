"""Numba kernel of the snow's depth; `augment.snow.profile` and `noise` define what it computes."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.snow.noise import DEVIATION, MIX_A, MIX_B, STEP_X, STEP_Y
from augment.snow.profile import (
    BARE_M,
    CRUMBLED,
    FILM_M,
    PILED,
    SCOURED,
    SHELTER,
    STEEPEST,
    WATER_RIM_M,
)

_A, _B, _X, _Y = (np.uint64(c) for c in (MIX_A, MIX_B, STEP_X, STEP_Y))
_LOW = np.uint64(0xFFFFFFFF)
_S27, _S30, _S31, _S32 = (np.uint64(s) for s in (27, 30, 31, 32))


@inner()
def _mix(bits):
    bits = (bits ^ (bits >> _S30)) * _A
    bits = (bits ^ (bits >> _S27)) * _B
    return bits ^ (bits >> _S31)


@inner()
def _corner(across, down, seed, x, y):
    bits = _mix((across + down) ^ seed)
    gx = np.float64(np.int64(bits >> _S32)) * 2.0**-31 - 1.0
    gy = np.float64(np.int64(bits & _LOW)) * 2.0**-31 - 1.0
    return gx * x + gy * y


@inner()
def _noise(u, v, seed):
    column, row = math.floor(u), math.floor(v)
    x, y = u - column, v - row
    fade_x = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    fade_y = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    across, down = np.uint64(np.int64(column)) * _X, np.uint64(np.int64(row)) * _Y
    near = _corner(across, down, seed, x, y)
    near += fade_x * (_corner(across + _X, down, seed, x - 1.0, y) - near)
    far = _corner(across, down + _Y, seed, x, y - 1.0)
    far += fade_x * (_corner(across + _X, down + _Y, seed, x - 1.0, y - 1.0) - far)
    return (near + fade_y * (far - near)) / DEVIATION


@inner()
def _field(x, y, size, turns, amplitudes, lengths, seeds):
    total = 0.0
    for k in range(len(amplitudes)):
        shown = min(max(2.0 - 4.0 * size / lengths[k], 0.0), 1.0)
        if shown > 0.0:
            u = turns[k, 0, 0] * x + turns[k, 0, 1] * y
            v = turns[k, 1, 0] * x + turns[k, 1, 1] * y
            total += amplitudes[k] * shown * _noise(u, v, seeds[k])
    return total


@inner()
def _pillow(t):
    t = min(max(t, 0.0), 1.0)
    return math.sqrt(t * (2.0 - t))


@kernel
def lay(
    centers, sizes, edges, tracks, banks, numbers, drifts, patches, mottling, seed, heights, mottle,
    draws,
):  # fmt: skip
    """Depth of the snow, what mottles its colour, and random bits, all [C], of every cell.

    drifts, patches, mottling: octaves as (turns, amplitudes, lengths, seeds). draws: uint64 that
    hang on the cell's place and the seed. Where nothing of the layer is patchy, the patches' noise
    is not worked out.
    """
    everywhere = numbers.threshold <= -1e9
    for i in prange(len(sizes)):
        x, y = np.float64(centers[i, 0]), np.float64(centers[i, 1])
        size = np.float64(sizes[i])
        column = np.uint64(np.int64(math.floor(x / size))) * _X
        row = np.uint64(np.int64(math.floor(y / size))) * _Y
        draws[i] = _mix((column + row) ^ seed)
        heights[i] = mottle[i] = np.float32(0)
        room = np.float64(centers[i, 2]) - numbers.floor_z_m
        above = 1e9
        if not everywhere:
            bx, by = np.float64(banks[i, 0]), np.float64(banks[i, 1])
            above = _field(x, y, 0.0, patches[0], patches[1], patches[2], patches[3])
            above += SHELTER * math.sqrt(bx * bx + by * by) - numbers.threshold
        if not (room > 0.0 and above > 0.0):
            continue
        at_wind = banks[i, 0] * numbers.wind_x + banks[i, 1] * numbers.wind_y
        piled = 1.0 + numbers.drift * (PILED if at_wind > 0.0 else SCOURED) * at_wind
        drift = _field(x, y, size, drifts[0], drifts[1], drifts[2], drifts[3])
        drift = math.exp(min(max(drift, -STEEPEST), STEEPEST)) * piled
        full = numbers.depth_m * drift * _pillow(edges[i] / numbers.radius_m)
        h = BARE_M + max(full - BARE_M, 0.0) * min(above / numbers.rim, 1.0)
        mottled = _field(x, y, size, mottling[0], mottling[1], mottling[2], mottling[3])
        track = np.float64(tracks[i])
        track += CRUMBLED * mottled * track * (1.0 - track)
        track = min(max(track, 0.0), 1.0)
        h = max(h * (1.0 - numbers.pressed * track), min(h, FILM_M))
        h = BARE_M + (h - BARE_M) * min(room / WATER_RIM_M, 1.0)
        heights[i] = np.float32(h)
        mottle[i] = np.float32(mottled)
