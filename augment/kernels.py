"""Numba kernels for the records themselves: poses and colours over time, merged splats, boxes
against depth images, hashes.

`augment.scene` (poses_at, colors_at), `augment.lod` (sum_covered_areas) and `augment.boxes`
(count_box_pixels) prepare the arrays and call these. Kernels of effects call `mix`. Every other
kernel fills its last arguments in place.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function, serial_kernel
from augment.rng import MIX_A, MIX_B

BLOCK = 2048  # splats that a thread takes at a time
_A = np.uint64(MIX_A)
_B = np.uint64(MIX_B)
_S27, _S30, _S31 = (np.uint64(s) for s in (27, 30, 31))


@kernel_function()
def mix(bits):
    """Return the mixed bits of `augment.rng.mix`, for one uint64."""
    bits = (bits ^ (bits >> _S30)) * _A
    bits = (bits ^ (bits >> _S27)) * _B
    return bits ^ (bits >> _S31)


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


@kernel
def sum_covered_areas(starts, opacities, places, covariances, out):
    """Compute the area that each of G groups of splats covers in a plane.

    The area is the integral of 1 - prod_i (1 - alpha_i), taken at 49 places within 3.15 standard
    deviations of the group. Lengths are in units in which a group has a standard deviation of 1.
    All arrays but `starts` are float64.

    Args:
        starts: int64 [G + 1]; group g has the splats in rows starts[g] to starts[g + 1].
        opacities: [N].
        places: [N, 2], the splats' means in the plane.
        covariances: [N, 2, 2], the splats' covariances in the plane.
        out: [G].
    """
    for g in prange(len(out)):
        covered = 0.0
        for column in range(7):
            for row in range(7):
                x = 0.9 * (column - 3)
                y = 0.9 * (row - 3)
                transmittance = 1.0
                for i in range(starts[g], starts[g + 1]):
                    a = covariances[i, 0, 0]
                    b = covariances[i, 0, 1]
                    c = covariances[i, 1, 1]
                    dx = x - places[i, 0]
                    dy = y - places[i, 1]
                    sigma = 0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
                    transmittance *= 1 - min(opacities[i] * np.exp(-sigma), 0.999)
                covered += 1 - transmittance
        out[g] = 0.81 * covered


# This kernel takes one thread: it runs beside the renderer, on threads that write files.
@serial_kernel
def count_box_pixels(
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
    counts,
    owners,
):
    """Count the pixels that show each of B boxes, and those that show what hides it.

    A pixel shows a box if the surface there lies in the part of the box that owns surfaces. It
    shows what hides the box if its ray meets the labelled box and the surface lies before that
    part.

    Args:
        depth: float32 [H, W], z of the surfaces, metres, 0 = none.
        instance: uint16 [H, W], the actors' numbers; [0, 0] where they are not known.
        scenery: bool [H, W], surfaces of a class that no object has; [0, 0] where classes are not
            known.
        actors: int64 [B], the boxes' actors, 0 = none.
        windows: int64 [B, 4], left, top, right, bottom of the pixels that can show a box.
        across: float64 [W], x / z of the pixels' rays.
        down: float64 [H], y / z of the pixels' rays.
        axes: float64 [B, 3, 3], columns are the camera's axes in the box's frame.
        eyes: float64 [B, 3], the camera's centre in the box's frame, metres.
        owned: float64 [B, 2, 3], lowest and highest corner of the part that owns surfaces, metres.
        labelled: float64 [B, 2, 3], lowest and highest corner of the labelled box, metres.
        near_m: z below which a box is not seen.
        counts: int64 [B, 6], set to the pixels that show the box, the pixels that show what hides
            it, and left, top, right, bottom of the former, right and bottom excluded.
        owners: uint16 [H, W], set to 1 + the smallest of the boxes that a pixel shows by its depth,
            0 = none; [0, 0] where nobody asks.
    """
    knows_actors = instance.size > 0
    knows_classes = scenery.size > 0
    volumes = np.empty(len(counts), np.float64)
    for box in range(len(counts)):
        low = labelled[box, 0]
        high = labelled[box, 1]
        volumes[box] = (high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2])
    # Pixels of known actors: they show the actor's boxes wherever they are.
    boxes_of = np.empty(65536, np.int64)  # the first box of each actor
    for actor in range(len(boxes_of)):
        boxes_of[actor] = -1
    for box in range(len(counts)):
        counts[box, 2] = depth.shape[1]
        counts[box, 3] = depth.shape[0]
        if actors[box] > 0 and boxes_of[actors[box]] < 0:
            boxes_of[actors[box]] = box
    if knows_actors:
        for row in range(instance.shape[0]):
            for column in range(instance.shape[1]):
                if instance[row, column] > 0:
                    box = boxes_of[instance[row, column]]
                    if box >= 0:
                        _add(counts[box], row, column)
        for box in range(len(counts)):  # a second box of an actor shows what the first one does
            if actors[box] > 0:
                for k in range(counts.shape[1]):
                    counts[box, k] = counts[boxes_of[actors[box]], k]
    for box in range(len(counts)):
        left, top, right, bottom = windows[box]
        actor_number = actors[box]
        for row in range(top, bottom):
            for column in range(left, right):
                z = depth[row, column]
                if not z > 0:
                    continue
                pixel_actor = np.int64(0)
                if knows_actors:
                    pixel_actor = np.int64(instance[row, column])
                    if actor_number > 0 and pixel_actor == actor_number:
                        continue  # counted above
                # Depths at which the ray enters and leaves the labelled box, then the owning part.
                enter = near_m
                leave = np.inf
                nearest = near_m
                farthest = np.inf
                for axis in range(3):
                    slope = (
                        axes[box, axis, 0] * across[column]
                        + axes[box, axis, 1] * down[row]
                        + axes[box, axis, 2]
                    )
                    eye = eyes[box, axis]
                    a = (labelled[box, 0, axis] - eye) / slope
                    b = (labelled[box, 1, axis] - eye) / slope
                    enter = max(enter, min(a, b))
                    leave = min(leave, max(a, b))
                    a = (owned[box, 0, axis] - eye) / slope
                    b = (owned[box, 1, axis] - eye) / slope
                    nearest = max(nearest, min(a, b))
                    farthest = min(farthest, max(a, b))
                if nearest <= z and z <= farthest:
                    if actor_number == 0 and pixel_actor == 0:
                        if knows_classes and scenery[row, column]:
                            continue
                        _add(counts[box], row, column)
                        if owners.size > 0:
                            owner = np.int64(owners[row, column]) - 1
                            if owner < 0 or volumes[box] < volumes[owner]:
                                owners[row, column] = box + 1
                    elif pixel_actor > 0 and enter <= leave:
                        counts[box, 1] += 1  # another actor, in this box
                elif z < nearest and enter <= leave:
                    counts[box, 1] += 1
    for box in range(len(counts)):
        if counts[box, 0] == 0:
            for k in range(2, counts.shape[1]):
                counts[box, k] = 0


@kernel_function()
def _add(counts, row, column):
    """Add one pixel to a box's counts (a row of `count_box_pixels`'s)."""
    counts[0] += 1
    counts[2] = min(counts[2], column)
    counts[3] = min(counts[3], row)
    counts[4] = max(counts[4], column + 1)
    counts[5] = max(counts[5], row + 1)
