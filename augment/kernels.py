"""Kernels of the records themselves: boxes against depth images, poses and colours over time,
hashes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import inner, kernel, serial_kernel
from augment.rng import MIX_A, MIX_B

BLOCK = 2048  # splats a thread takes at a time
_A, _B = np.uint64(MIX_A), np.uint64(MIX_B)
_S27, _S30, _S31 = (np.uint64(s) for s in (27, 30, 31))


@inner()
def mix(bits):
    """As augment.rng.mix."""
    bits = (bits ^ (bits >> _S30)) * _A
    bits = (bits ^ (bits >> _S27)) * _B
    return bits ^ (bits >> _S31)


@serial_kernel
def poses_at(timestamp_ns, straight_rad, tracks, found, out):
    """scene.Track.pose_at of A tracks, to the same bits: out [A, 4, 4] where found [A] is not 0.

    tracks: scene.PackedTracks. straight_rad: sines of smaller angles have lost their digits.
    """
    for actor in range(found.size):
        first, last = tracks.starts[actor], tracks.starts[actor + 1] - 1
        times, hold = tracks.times_ns, tracks.holds_ns[actor]
        found[actor] = 0
        if timestamp_ns < times[first] - hold or timestamp_ns > times[last] + hold:
            continue
        low, high = first, last  # samples beside the moment
        while high - low > 1:
            middle = (low + high) // 2
            if times[middle] <= timestamp_ns:
                low = middle
            else:
                high = middle
        at = low if timestamp_ns <= times[first] else high
        is_between = times[first] < timestamp_ns < times[last]
        gap = tracks.gaps_ns[actor]
        if is_between and 0 <= gap < times[high] - times[low]:
            is_between = False
            at = low if timestamp_ns - times[low] <= hold else high
            if at == high and times[high] - timestamp_ns > hold:
                continue
        found[actor] = 1
        if is_between:
            share = np.float64(timestamp_ns - times[low]) / np.float64(times[high] - times[low])
            _interpolate(tracks, low, high, share, straight_rad, out[actor])
        else:
            for k in range(16):
                out[actor, k // 4, k % 4] = tracks.poses[at, k // 4, k % 4]


@inner()
def _interpolate(tracks, low, high, share, straight_rad, out):
    a, b = tracks.quats[low], tracks.quats[high]
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = math.acos(min(abs(dot), 1.0))
    of_a, of_b = 1 - share, share
    if angle >= straight_rad:
        sine = math.sin(angle)
        of_a, of_b = math.sin(of_a * angle) / sine, math.sin(of_b * angle) / sine
    if dot < 0:  # the shorter way round
        of_b = -of_b
    w, x, y, z = (
        of_a * a[0] + of_b * b[0],
        of_a * a[1] + of_b * b[1],
        of_a * a[2] + of_b * b[2],
        of_a * a[3] + of_b * b[3],
    )
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    out[0, 0], out[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    out[1, 0], out[1, 1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
    out[2, 0], out[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    out[0, 2], out[1, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x)
    out[2, 2], out[3, 3] = 1 - 2 * (x * x + y * y), 1.0
    for k in range(3):
        p, q = tracks.centres[low, k], tracks.centres[high, k]
        out[k, 3] = p + share * (q - p) if share < 0.5 else q - (q - p) * (1 - share)
        out[3, k] = 0.0


@kernel
def colors_at(sh, coefficients, weights, turn, out):
    """out [N, K, 3]: sh with sum_t weights[t] coefficients[:, t] added to its first row, and bands
    turned by the blocks of turn [K, K]; an empty turn leaves them.

    coefficients [N, T, 3]. weights [T]. All float32.
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
                after = first + 3 if first == 1 else first + 5 if first == 4 else first + 7
                for row in range(first, after):
                    red = green = blue = zero
                    for k in range(first, after):
                        share = turn[row, k]
                        red += share * sh[i, k, 0]
                        green += share * sh[i, k, 1]
                        blue += share * sh[i, k, 2]
                    out[i, row, 0], out[i, row, 1], out[i, row, 2] = red, green, blue
                first = after


@kernel
def covered_plane(starts, opacities, places, covariances, out):
    """out [G]: the integral of 1 - prod_i (1 - alpha_i) over a plane, of the splats in rows
    starts[g] to starts[g + 1]: places [N, 2] and covariances [N, 2, 2] in units in which the group
    has a standard deviation of 1. By 49 places within 3.15 deviations. All float64.
    """
    for g in prange(len(out)):
        total = 0.0
        for column in range(7):
            for row in range(7):
                x, y, passed = 0.9 * (column - 3), 0.9 * (row - 3), 1.0
                for i in range(starts[g], starts[g + 1]):
                    a, b, c = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 1, 1]
                    dx, dy = x - places[i, 0], y - places[i, 1]
                    sigma = 0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
                    passed *= 1 - min(opacities[i] * np.exp(-sigma), 0.999)
                total += 1 - passed
        out[g] = 0.81 * total


# Of one thread: it runs beside the renderer, on those that write files.
@serial_kernel
def count_occlusion(
    depth,
    instance,
    scenery,
    actors,
    windows,
    across,
    down,
    axes,
    eyes,
    owned,
    labelled,
    near_m,
    found,
    owners,
):
    """found [B, 6]: pixels that show each box, pixels that show what stands before it, and left,
    top, right, bottom of the former, right and bottom excluded. owners [H, W]: 1 + the smallest of
    the boxes that each pixel shows by its depth, 0 = none; or [0, 0] where nobody asks.

    depth [H, W]: z, 0 = none. instance [H, W]: actors' numbers, or [0, 0] where they are not known.
    scenery [H, W]: of a class that no object is of, or [0, 0] where classes are not known. actors
    [B]: of the boxes, 0 = none. windows [B, 4]: left, top, right, bottom of where a box can
    be. across [W], down [H]: x / z and y / z of the pixels' rays. axes [B, 3, 3]: columns, the
    camera's axes in the box. eyes [B, 3]: the camera's centre there. owned, labelled [B, 2, 3]:
    lowest and highest of the part that owns surfaces, and of the labelled box. near_m: what of a
    box is nearer is not seen.
    """
    knows_actors, knows_classes = instance.size > 0, scenery.size > 0
    volumes = np.empty(len(found), np.float64)
    for box in range(len(found)):
        low, high = labelled[box, 0], labelled[box, 1]
        volumes[box] = (high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2])
    boxes_of = np.empty(65536, np.int64)  # the first box of each actor
    for actor in range(len(boxes_of)):
        boxes_of[actor] = -1
    for box in range(len(found)):
        found[box, 2], found[box, 3] = depth.shape[1], depth.shape[0]
        if actors[box] > 0 and boxes_of[actors[box]] < 0:
            boxes_of[actors[box]] = box
    if knows_actors:
        for row in range(instance.shape[0]):
            for column in range(instance.shape[1]):
                if instance[row, column] > 0:
                    box = boxes_of[instance[row, column]]
                    if box >= 0:
                        _add(found[box], row, column)
        for box in range(len(found)):  # a second box of an actor shows what the first one does
            if actors[box] > 0:
                for k in range(found.shape[1]):
                    found[box, k] = found[boxes_of[actors[box]], k]
    for box in range(len(found)):
        left, top, right, bottom = windows[box]
        own = actors[box]
        for row in range(top, bottom):
            for column in range(left, right):
                z = depth[row, column]
                if not z > 0:
                    continue
                number = np.int64(0)
                if knows_actors:
                    number = np.int64(instance[row, column])
                    if own > 0 and number == own:
                        continue  # counted above
                enter, leave = near_m, np.inf  # of the labelled box, by depth
                nearest, farthest = near_m, np.inf  # of what owns surfaces
                for axis in range(3):
                    slope = (
                        axes[box, axis, 0] * across[column]
                        + axes[box, axis, 1] * down[row]
                        + axes[box, axis, 2]
                    )
                    eye = eyes[box, axis]
                    a = (labelled[box, 0, axis] - eye) / slope
                    b = (labelled[box, 1, axis] - eye) / slope
                    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
                    a = (owned[box, 0, axis] - eye) / slope
                    b = (owned[box, 1, axis] - eye) / slope
                    nearest, farthest = max(nearest, min(a, b)), min(farthest, max(a, b))
                if nearest <= z and z <= farthest:
                    if own == 0 and number == 0:
                        if knows_classes and scenery[row, column]:
                            continue
                        _add(found[box], row, column)
                        if owners.size > 0:
                            other = np.int64(owners[row, column]) - 1
                            if other < 0 or volumes[box] < volumes[other]:
                                owners[row, column] = box + 1
                    elif number > 0 and enter <= leave:
                        found[box, 1] += 1  # another actor, in this box
                elif z < nearest and enter <= leave:
                    found[box, 1] += 1
    for box in range(len(found)):
        if found[box, 0] == 0:
            for k in range(2, found.shape[1]):
                found[box, k] = 0


@inner()
def _add(found, row, column):
    found[0] += 1
    found[2], found[3] = min(found[2], column), min(found[3], row)
    found[4], found[5] = max(found[4], column + 1), max(found[5], row + 1)
