"""Numba kernels of actors: their poses and colours over time.

`augment.scene.scene` prepares the arrays. The kernels fill their last argument in place.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function, serial_kernel

BLOCK = 2048  # splats that a thread takes at a time


@serial_kernel
def poses_at(timestamp_ns, straight_rad, tracks, is_present, out):
    """Compute `scene.Track.pose_at` of A tracks, to the same bits.

    Args:
        timestamp_ns: the time.
        straight_rad: angle below which sines lose their digits, and the straight line is exact.
        tracks: scene.PackedTracks.
        is_present: uint8 [A], set to 1 for actors that exist at the time, else 0.
        out: float64 [A, 4, 4], set to world_from_actor of the actors that exist.
    """
    for actor in range(is_present.size):
        first = tracks.starts[actor]
        last = tracks.starts[actor + 1] - 1
        times = tracks.times_ns
        hold_ns = tracks.holds_ns[actor]
        is_present[actor] = 0
        if timestamp_ns < times[first] - hold_ns or timestamp_ns > times[last] + hold_ns:
            continue
        # Samples beside the time, by bisection.
        before = first
        after = last
        while after - before > 1:
            middle = (before + after) // 2
            if times[middle] <= timestamp_ns:
                before = middle
            else:
                after = middle
        sample = before if timestamp_ns <= times[first] else after
        is_between = times[first] < timestamp_ns < times[last]
        max_gap_ns = tracks.max_gaps_ns[actor]
        if is_between and 0 <= max_gap_ns < times[after] - times[before]:
            is_between = False
            sample = before if timestamp_ns - times[before] <= hold_ns else after
            if sample == after and times[after] - timestamp_ns > hold_ns:
                continue
        is_present[actor] = 1
        if is_between:
            fraction = np.float64(timestamp_ns - times[before]) / np.float64(
                times[after] - times[before]
            )
            _interpolate(tracks, before, after, fraction, straight_rad, out[actor])
        else:
            for k in range(16):
                out[actor, k // 4, k % 4] = tracks.poses[sample, k // 4, k % 4]


@kernel_function()
def _interpolate(tracks, before, after, fraction, straight_rad, out):
    """Set `out` [4, 4] to the pose between two samples: slerp in rotation, linear in position.

    Args:
        tracks: scene.PackedTracks.
        before: index of the sample before the time.
        after: index of the sample after the time.
        fraction: part of the time between the samples that has passed, 0 to 1.
        straight_rad: as for `poses_at`.
        out: float64 [4, 4].
    """
    a = tracks.quats[before]
    b = tracks.quats[after]
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = math.acos(min(abs(dot), 1.0))
    weight_a = 1 - fraction
    weight_b = fraction
    if angle >= straight_rad:
        sine = math.sin(angle)
        weight_a = math.sin(weight_a * angle) / sine
        weight_b = math.sin(weight_b * angle) / sine
    if dot < 0:  # the shorter way round
        weight_b = -weight_b
    w = weight_a * a[0] + weight_b * b[0]
    x = weight_a * a[1] + weight_b * b[1]
    y = weight_a * a[2] + weight_b * b[2]
    z = weight_a * a[3] + weight_b * b[3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w = w / length
    x = x / length
    y = y / length
    z = z / length
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[0, 1] = 2 * (x * y - w * z)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    out[3, 3] = 1.0
    for k in range(3):
        p = tracks.centres[before, k]
        q = tracks.centres[after, k]
        out[k, 3] = p + fraction * (q - p) if fraction < 0.5 else q - (q - p) * (1 - fraction)
        out[3, k] = 0.0


@kernel
def colors_at(sh, coefficients, weights, turn, out):
    """Compute the SH of N splats at a time, turned by a rotation.

    The first row of each splat's SH gets sum_t weights[t] coefficients[:, t] added; the bands above
    are multiplied by the blocks of `turn`. All arrays are float32.

    Args:
        sh: [N, K, 3].
        coefficients: [N, T, 3], of the colour waves.
        weights: [T], the waves' values at the time.
        turn: [K, K], block-diagonal; [0, 0] turns nothing.
        out: [N, K, 3].
    """
    count, rows, _ = sh.shape
    zero = np.float32(0)
    for block in prange((count + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            for c in range(3):
                value = sh[i, 0, c]
                for term in range(len(weights)):
                    value += weights[term] * coefficients[i, term, c]
                out[i, 0, c] = value
            if len(turn) == 0:
                for k in range(1, rows):
                    for c in range(3):
                        out[i, k, c] = sh[i, k, c]
                continue
            first = 1
            while first < rows:
                end = first + 3 if first == 1 else first + 5 if first == 4 else first + 7
                for row in range(first, end):
                    red = green = blue = zero
                    for k in range(first, end):
                        weight = turn[row, k]
                        red += weight * sh[i, k, 0]
                        green += weight * sh[i, k, 1]
                        blue += weight * sh[i, k, 2]
                    out[i, row, 0] = red
                    out[i, row, 1] = green
                    out[i, row, 2] = blue
                first = end
