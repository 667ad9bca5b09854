"""Numba kernels of surfaces on a photo: the best outline of an object, and depth that spreads.

`augment.photo.outlines` and `augment.photo.photo_surface` call them, and say what the arrays mean.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, serial_kernel


@serial_kernel
def find_best_path(gains, bend_cost, path):
    """Write the offset of each point of an outline that has the largest sum of gains.

    Neighbouring points may differ by MAX_BEND offsets, each of which costs `bend_cost`. This is
    the dynamic programming of Amini, Weymouth and Jain 1990 ("Using dynamic programming for
    solving variational problems in vision"), first order.

    Args:
        gains: float32 [N, K], gain of point n at offset k.
        bend_cost: cost of a difference of one offset between neighbours.
        path: output int64 [N], the offset of each point.
    """
    num_points, num_offsets = gains.shape
    back = np.empty((num_points, num_offsets), np.int16)
    sums = gains[0].copy()
    next_sums = np.empty(num_offsets, np.float32)
    for point in range(1, num_points):
        for offset in range(num_offsets):
            best_sum = sums[offset]
            best_offset = offset
            for bend in range(1, 3):  # MAX_BEND
                cost = np.float32(bend) * bend_cost
                if offset >= bend and sums[offset - bend] - cost > best_sum:
                    best_sum = sums[offset - bend] - cost
                    best_offset = offset - bend
                if offset + bend < num_offsets and sums[offset + bend] - cost > best_sum:
                    best_sum = sums[offset + bend] - cost
                    best_offset = offset + bend
            next_sums[offset] = best_sum + gains[point, offset]
            back[point, offset] = best_offset
        for offset in range(num_offsets):
            sums[offset] = next_sums[offset]
    offset = np.int64(np.argmax(sums))
    path[num_points - 1] = offset
    for point in range(num_points - 1, 0, -1):
        offset = np.int64(back[point, offset])
        path[point - 1] = offset


@serial_kernel
def spread_roots(pixels, state, step_costs, max_cost, roots):
    """Write for each open pixel the known pixel to which the cheapest path leads.

    This is the image foresting transform of Falcao, Stolfi and Lotufo 2004 with additive costs: a
    step costs the difference of colour, in the channel where it is largest, and the cost of its
    direction. Pixels of equal cost are visited in a fixed order.

    Args:
        pixels: uint8 [H, W, 3], the photo.
        state: uint8 [H, W]; 0 for a barrier, 1 for an open pixel, 2 for a known one.
        step_costs: int64 [4], cost of a step up, down, left, right from a known pixel.
        max_cost: largest cost of a step.
        roots: output int64 [H, W], flat index of the known pixel; that of the pixel itself where
            it is known, -1 where no path leads to one.
    """
    height, width = state.shape
    num_buckets = max_cost + 1
    unreached = np.int64(2**40)
    costs = np.full((height, width), unreached, np.int64)
    # Entries of the circular buckets: each open pixel is entered at most four times.
    capacity = np.int64(0)
    for i in range(height):
        for j in range(width):
            capacity += 4 if state[i, j] == 1 else 1
            roots[i, j] = i * width + j if state[i, j] == 2 else -1
    entry_pixels = np.empty(capacity, np.int64)
    entry_costs = np.empty(capacity, np.int64)
    next_entries = np.empty(capacity, np.int64)
    first_entries = np.full(num_buckets, -1, np.int64)
    last_entries = np.full(num_buckets, -1, np.int64)
    num_entries = np.int64(0)
    num_waiting = np.int64(0)
    cost = np.int64(0)
    for i in range(height):
        for j in range(width):
            if state[i, j] != 2:
                continue
            is_beside = (i > 0 and state[i - 1, j] == 1) or (
                i + 1 < height and state[i + 1, j] == 1
            )
            is_beside = is_beside or (j > 0 and state[i, j - 1] == 1)
            is_beside = is_beside or (j + 1 < width and state[i, j + 1] == 1)
            if is_beside:
                entry_pixels[num_entries] = i * width + j
                entry_costs[num_entries] = 0
                next_entries[num_entries] = -1
                if last_entries[0] >= 0:
                    next_entries[last_entries[0]] = num_entries
                else:
                    first_entries[0] = num_entries
                last_entries[0] = num_entries
                costs[i, j] = 0
                num_entries += 1
                num_waiting += 1
    while num_waiting > 0:
        bucket = cost % num_buckets
        entry = first_entries[bucket]
        if entry < 0:
            cost += 1
            continue
        first_entries[bucket] = next_entries[entry]
        if first_entries[bucket] < 0:
            last_entries[bucket] = -1
        num_waiting -= 1
        i = entry_pixels[entry] // width
        j = entry_pixels[entry] - i * width
        if entry_costs[entry] != costs[i, j]:
            continue  # a cheaper path has come first
        for direction in range(4):
            row = i
            column = j
            if direction == 0:
                row -= 1
            elif direction == 1:
                row += 1
            elif direction == 2:
                column -= 1
            else:
                column += 1
            if row < 0 or column < 0 or row >= height or column >= width:
                continue
            if state[row, column] != 1:
                continue
            difference = np.int64(0)
            for channel in range(3):
                level = np.int64(pixels[i, j, channel])
                next_level = np.int64(pixels[row, column, channel])
                difference = max(difference, abs(level - next_level))
            next_cost = cost + min(difference + step_costs[direction], max_cost)
            if next_cost >= costs[row, column]:
                continue
            costs[row, column] = next_cost
            roots[row, column] = roots[i, j]
            bucket = next_cost % num_buckets
            entry_pixels[num_entries] = row * width + column
            entry_costs[num_entries] = next_cost
            next_entries[num_entries] = -1
            if last_entries[bucket] >= 0:
                next_entries[last_entries[bucket]] = num_entries
            else:
                first_entries[bucket] = num_entries
            last_entries[bucket] = num_entries
            num_entries += 1
            num_waiting += 1


@kernel
def fill_surfaces(sky_share, overlay, is_complete, limits, alpha, is_missing):
    """Replace alpha by that of what a photo shows, and mark the surfaces that the scene lacks.

    Args:
        sky_share: float32 [H, W], share of sky in each pixel.
        overlay: float32 [H, W], share of snow in each pixel; [0, 0] without snow.
        is_complete: bool [H, W], pixels that the scene shows in full; [0, 0] for none.
        limits: float32 [3]; alphas that count as nothing and as everything, and the alpha below
            which the scene lacks a surface.
        alpha: float32 [H, W], alpha of the scene, which is replaced.
        is_missing: output bool [H, W].
    """
    height, width = alpha.shape
    zero = np.float32(0)
    one_f32 = np.float32(1)
    has_overlay = len(overlay) > 0
    has_complete = len(is_complete) > 0
    for i in prange(height):
        for j in range(width):
            solid_share = one_f32 - sky_share[i, j]
            if has_overlay:
                solid_share = max(solid_share, overlay[i, j])
            missing = alpha[i, j] < limits[2]
            if has_complete and is_complete[i, j]:
                solid_share = (alpha[i, j] - limits[0]) / (limits[1] - limits[0])
                solid_share = min(max(solid_share, zero), one_f32)
                missing = False
            alpha[i, j] = solid_share
            is_missing[i, j] = missing


@kernel
def fill_missing(is_missing, small_values, u, v, road, values):
    """Replace values where they are missing by those of a smaller image, at most the road's depth.

    Args:
        is_missing: bool [H, W].
        small_values: [h, w], values of missing pixels.
        u: float32 [W], image coordinates of the columns at unit depth.
        v: float32 [H], image coordinates of the rows at unit depth.
        road: float32 [5]; fall of the camera's axes (3), the camera's height above the road (m; 0
            for no largest value), and the smallest fall of a ray that meets the road.
        values: [H, W], which is written.
    """
    height, width = values.shape
    small_height, small_width = small_values.shape
    has_road = road[3] > 0
    for i in prange(height):
        row = np.int64(i) * small_height // height
        for j in range(width):
            if not is_missing[i, j]:
                continue
            value = small_values[row, np.int64(j) * small_width // width]
            values[i, j] = value
            if has_road:
                fall = (road[0] * u[j] + road[2]) + road[1] * v[i]
                if fall > road[4] and road[3] / fall < value:
                    values[i, j] = road[3] / fall
