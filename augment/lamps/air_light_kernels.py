"""Numba kernels of the light that lamps send into the air: nodes and pixels.

`augment.lamps.air_light` calls them, gives the equations and says what the arrays mean. The light
of each lamp comes from the tables of `halo_table_kernels`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.lamps.halo_table_kernels import PLANES, SLICE_START, light_to_ends, place_at_lamp
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import Index

# Least difference of two inverse distances that are told apart, 1/m.
TINY = np.float32(1e-9)
# Radius about a lamp within which nodes soften 1 / h, in their steps.
SOFT_STEPS = 1.5
# Share of the softening that goes on beyond it, as its square over that of the distance.
SOFT_SHARE = 0.4
# Square of the radius about a lamp in which nodes add what coarse nodes lack, in softened radii.
COARSE_END = 6.25
# Square of the radius about a lamp in which pixels add what nodes lack, in softened radii.
CORE_END = 6.25
# Slope of the weight of what is added there: it falls from three quarters of the radius on.
WINDOW_SLOPE = 1 / (1 - 0.75**2)
# Largest relative difference of the two inverse distances of a node that are computed as one.
SAME_DISTANCE = 0.15
# The same for light that is looked up between coarse nodes.
SAME_SLICE = np.float32(0.04)
# Pixels whose mean of 1 / r about a lamp is that at the lamp's own pixel: 1 / SOFT_PX.
SOFT_PX = 0.28


class ImageGrid(NamedTuple):
    """The lens of an image, and the grid of nodes over it."""

    lens: np.ndarray  # float64 [5]: fx, fy, cx, cy and the geometric mean of fx and fy, pixels
    steps: np.ndarray  # int64 [2]: pixels between nodes, nodes between coarse ones


@kernel_function()
def _softened(square, soft_square):
    """Return a distance that is softened about 0, and hardly beyond twice the softening.

    A halo falls as a power of r, so light between nodes exceeds it. SOFT_SHARE takes out most of
    that.

    Args:
        square: square of the distance.
        soft_square: square of the softening.
    """
    mixed = SOFT_SHARE * square * soft_square
    return math.sqrt(math.sqrt(square * square + mixed + soft_square * soft_square))


@kernel
def invert_distances(distances, nearest, columns, rows, step, inverse_distances, cells):
    """Write the inverse distance of each pixel's surface along its ray, and its range in cells.

    Args:
        distances: float32 [H, W], distances, metres; 0 or less, inf or nan for the sky.
        nearest: least distance, metres.
        columns: float32 [W], x of the pixels' rays at depth 1; or 0 for distances along the rays.
        rows: float32 [H], the same for y.
        step: pixels between nodes.
        inverse_distances: output float32 [H, W], 1/m, 0 for the sky.
        cells: output float32 [rows, columns, 2], largest and smallest inverse distance of the
            pixels between four nodes.
    """
    zero = np.float32(0)
    one_f32 = np.float32(1)
    largest = one_f32 / nearest
    height, width = distances.shape
    num_cells = cells.shape[1]
    for band in prange(cells.shape[0]):
        highs = np.zeros(num_cells, np.float32)
        lows = np.full(num_cells, np.inf, np.float32)
        for y in range(band * step, min((band + 1) * step, height)):
            square = one_f32 + rows[y] * rows[y]
            sources = distances[y]
            inverses = inverse_distances[y]
            for x in range(width):
                length = np.float32(math.sqrt(square + columns[x] * columns[x]))
                inverse = min(one_f32 / max(length * sources[x], nearest), largest)
                inverses[x] = inverse if sources[x] > zero else zero
            for cell in range(num_cells):
                high = highs[cell]
                low = lows[cell]
                for x in range(cell * step, min((cell + 1) * step, width)):
                    high = max(high, inverses[x])
                    low = min(low, inverses[x])
                highs[cell] = high
                lows[cell] = low
        for cell in range(num_cells):
            cells[band, cell, 0] = highs[cell]
            cells[band, cell, 1] = lows[cell]


@kernel
def light_slices(grid, lamps, slice_table, slices, ranges, volume):
    """Write the light of all lamps along the rays through coarse nodes, up to slices of distance.

    Far from a lamp its light changes slowly, so that few nodes show it. About the lamp, where it
    goes as 1 / h, it is softened here; `light_nodes` adds the difference.

    Args:
        grid: lens of the image, and its grid of fine nodes.
        lamps: the lamps.
        slice_table: result of `fill_tables`.
        slices: float64 [K], inverse distances, falling, 1/m; the last is 0.
        ranges: float32 [rows, columns, 2] of the nodes: largest and smallest inverse distance, 1/m.
        volume: output float32 [coarse rows, coarse columns, 3, K], luminance in linear sRGB; 0 in
            slices that no fine node looks up.
    """
    num_rows, num_columns, _, num_slices = volume.shape
    num_steps = grid.steps[1]
    step = num_steps * grid.steps[0]
    softness = SOFT_STEPS * step / grid.lens[4]
    for row in prange(num_rows):
        v = (row * step - grid.lens[3]) / grid.lens[1]
        volume[row] = np.float32(0)
        ends = np.empty((num_columns, 2), np.uint64)
        for column in range(num_columns):
            largest = np.float32(0.0)
            smallest = np.float32(np.inf)
            top = max((row - 1) * num_steps, 0)
            left = max((column - 1) * num_steps, 0)
            for i in range(top, min((row + 1) * num_steps + 1, ranges.shape[0])):
                for j in range(left, min((column + 1) * num_steps + 1, ranges.shape[1])):
                    largest = max(largest, ranges[i, j, 0])
                    smallest = min(smallest, ranges[i, j, 1])
            first = 0
            while first < num_slices - 2 and slices[first + 1] >= largest:
                first += 1
            last = first + 1
            while last < num_slices - 1 and slices[last] > smallest:
                last += 1
            ends[column, 0] = first
            ends[column, 1] = last + 1
        for index in range(len(lamps.distances_m)):
            distance = lamps.distances_m[index]
            layout = lamps.layouts[index]
            end_cosine = lamps.ends[index, 1]
            along = lamps.frames[index, 0]
            red = np.float32(lamps.colors[index, 0])
            green = np.float32(lamps.colors[index, 1])
            blue = np.float32(lamps.colors[index, 2])
            for column in range(num_columns):
                u = (column * step - grid.lens[2]) / grid.lens[0]
                z = 1 / math.sqrt(1 + u * u + v * v)
                if (u * along[0] + v * along[1] + along[2]) * z <= end_cosine:
                    continue
                cosine, sine, node, node_share, upper, lower, plane_share = place_at_lamp(
                    lamps, index, u * z, v * z, z
                )
                gain = 1 / distance
                if cosine > 0:
                    gain /= _softened(sine * sine, softness * softness)
                near_gain = gain * (1 - node_share)
                far_gain = gain * node_share
                weight_a = np.float32(near_gain * (1 - plane_share))
                weight_b = np.float32(near_gain * plane_share)
                weight_c = np.float32(far_gain * (1 - plane_share))
                weight_d = np.float32(far_gain * plane_share)
                start = layout[SLICE_START] + node * layout[PLANES] * num_slices
                next_start = start + layout[PLANES] * num_slices
                first = Index(start + upper * num_slices)
                second = Index(start + lower * num_slices)
                third = Index(next_start + upper * num_slices)
                fourth = Index(next_start + lower * num_slices)
                reds = volume[row, column, 0]
                greens = volume[row, column, 1]
                blues = volume[row, column, 2]
                for k in range(ends[column, 0], ends[column, 1], Index(1)):
                    light = weight_a * slice_table[first + k] + weight_b * slice_table[second + k]
                    light += weight_c * slice_table[third + k] + weight_d * slice_table[fourth + k]
                    reds[k] += light * red
                    greens[k] += light * green
                    blues[k] += light * blue


@kernel_function()
def _slice_place(slices, inverse):
    """Return the slice beyond a distance, the share of the one before it, and a factor of both.

    Args:
        slices: float64 [K], inverse distances, falling, 1/m.
        inverse: inverse of the distance, 1/m.
    """
    if inverse >= slices[0]:
        return 1, 1.0, slices[0] / inverse
    k = 1
    while slices[k] > inverse:
        k += 1
    return k, (inverse - slices[k]) / (slices[k - 1] - slices[k]), 1.0


@kernel
def light_nodes(grid, lamps, reach_table, slices, volume, windows, ranges, nodes):
    """Add the light of all lamps along the rays through the nodes, to two distances each.

    It is that of the coarse nodes, and about each lamp what softened coarse nodes lack. Near a lamp
    it goes as 1 / h, which no grid can show. So h is softened here as well, and `add_cores` adds
    the difference.

    Args:
        grid: lens of the image, and its grid of nodes.
        lamps: the lamps.
        reach_table: result of `halo_table_kernels.fill_tables`.
        slices: as in `light_slices`, like volume.
        windows: int64 [M, 4], first row of nodes, last row + 1, first column, last column + 1, in
            which the softening of coarse nodes about each lamp is seen.
        ranges: float32 [rows, columns, 2] of the nodes: largest and smallest inverse distance, 1/m.
        nodes: float32 [rows, columns, 6], changed in place: colour to the nearer and to the further
            distance.
    """
    num_rows, num_columns, _ = nodes.shape
    step = grid.steps[0]
    num_steps = grid.steps[1]
    per_step = 1 / num_steps
    softness = SOFT_STEPS * step / grid.lens[4]
    coarse_softness = num_steps * softness
    last_row = volume.shape[0] - 1
    last_column = volume.shape[1] - 1
    for row in prange(num_rows):
        i = row // num_steps
        v_share = np.float32((row - i * num_steps) * per_step)
        lights = volume[i] + v_share * (volume[min(i + 1, last_row)] - volume[i])
        for column in range(num_columns):
            j = column // num_steps
            u_share = np.float32((column - j * num_steps) * per_step)
            left = lights[j]
            right = lights[min(j + 1, last_column)]
            near = ranges[row, column, 0]
            far = ranges[row, column, 1]
            is_one = near - far <= SAME_SLICE * near
            for side in range(1 if is_one else 2):
                inverse = near if side == 0 else far
                if is_one:
                    inverse = np.float32(0.5) * (near + far)
                k, share, factor = _slice_place(slices, inverse)
                before = np.float32(share * factor)
                beyond = np.float32((1 - share) * factor)
                for channel in range(3):
                    light = before * left[channel, k - 1] + beyond * left[channel, k]
                    other = before * right[channel, k - 1] + beyond * right[channel, k]
                    light += u_share * (other - light)
                    nodes[row, column, 3 * side + channel] += light
                    if is_one:
                        nodes[row, column, 3 + channel] += light
        v = (row * step - grid.lens[3]) / grid.lens[1]
        for index in range(len(lamps.distances_m)):
            if row < windows[index, 0] or row >= windows[index, 1]:
                continue
            frame = lamps.frames[index]
            distance = lamps.distances_m[index]
            soft_square = (softness * distance) ** 2
            coarse_square = (coarse_softness * distance) ** 2
            end_square = COARSE_END * coarse_square
            for column in range(windows[index, 2], windows[index, 3]):
                u = (column * step - grid.lens[2]) / grid.lens[0]
                z = 1 / math.sqrt(1 + u * u + v * v)
                side = (u * frame[1, 0] + v * frame[1, 1] + frame[1, 2]) * z
                rise = (u * frame[2, 0] + v * frame[2, 1] + frame[2, 2]) * z
                square = (side * side + rise * rise) * distance * distance
                if square >= end_square:
                    continue
                near, far, is_ahead = light_to_ends(
                    lamps, index, reach_table, u * z, v * z, z,
                    ranges[row, column, 0], ranges[row, column, 1], SAME_DISTANCE,
                )  # fmt: skip
                window = min((1 - square / end_square) * WINDOW_SLOPE, 1.0)
                gain = 1 / _softened(square, soft_square) - 1 / _softened(square, coarse_square)
                gain *= is_ahead * window * window * (3 - 2 * window)
                node = nodes[row, column]
                for channel in range(3):
                    node[channel] += np.float32(near * gain * lamps.colors[index, channel])
                    node[3 + channel] += np.float32(far * gain * lamps.colors[index, channel])


@kernel
def spread_nodes(step, inverse_distances, ranges, nodes, light):
    """Add each pixel's light from its four nodes, at the pixel's own distance.

    A node's two distances span those of all pixels that read it. Distances and light are
    interpolated between the nodes; the pixel's own distance lies between the two. So light does not
    cross a silhouette.

    Args:
        step: pixels between nodes.
        inverse_distances: float32 [H, W], 1/m.
        ranges: as in `light_nodes`, like nodes.
        light: float32 [H, 3 W], changed in place.
    """
    height, width = inverse_distances.shape
    num_columns = nodes.shape[1]
    one_f32 = np.float32(1)
    zero = np.float32(0)
    shares = ((np.arange(step) + 0.5) / step).astype(np.float32)
    for y in prange(height):
        row_place = np.float32((y + 0.5) / step)
        row = int(row_place)
        below = row_place - np.float32(row)
        above = one_f32 - below
        # Smallest distance and what the largest is more; light to the further one, and what that to
        # the nearer is more: between the rows of nodes.
        columns = np.empty((num_columns, 8), np.float32)
        for j in range(num_columns):
            largest = above * ranges[row, j, 0] + below * ranges[row + 1, j, 0]
            smallest = above * ranges[row, j, 1] + below * ranges[row + 1, j, 1]
            columns[j, 0] = smallest
            columns[j, 1] = largest - smallest
            for k in range(3):
                near = above * nodes[row, j, k] + below * nodes[row + 1, j, k]
                far = above * nodes[row, j, 3 + k] + below * nodes[row + 1, j, 3 + k]
                columns[j, 2 + k] = far
                columns[j, 5 + k] = near - far
        inverses = inverse_distances[y]
        lights = light[y]
        for j in range(num_columns - 1):
            left = columns[j]
            right = columns[j + 1]
            red = left[2]
            green = left[3]
            blue = left[4]
            red_more = left[5]
            green_more = left[6]
            blue_more = left[7]
            brightest = max(red + max(red_more, zero), green + max(green_more, zero))
            brightest = max(brightest, blue + max(blue_more, zero))
            for k in range(2, 5):
                brightest = max(brightest, right[k] + max(right[3 + k], zero))
            if brightest <= zero:
                continue
            smallest = left[0]
            span = left[1]
            smallest_slope = right[0] - smallest
            span_slope = right[1] - span
            red_slope = right[2] - red
            green_slope = right[3] - green
            blue_slope = right[4] - blue
            red_more_slope = right[5] - red_more
            green_more_slope = right[6] - green_more
            blue_more_slope = right[7] - blue_more
            start = Index(j * step)
            for x in range(start, Index(min((j + 1) * step, width)), Index(1)):
                u = shares[x - start]
                share = inverses[x] - (smallest + u * smallest_slope)
                share = share / max(span + u * span_slope, TINY)
                share = min(max(share, zero), one_f32)
                at = Index(3) * x
                lights[at] += red + u * red_slope + share * (red_more + u * red_more_slope)
                lights[at + Index(1)] += (
                    green + u * green_slope + share * (green_more + u * green_more_slope)
                )
                lights[at + Index(2)] += (
                    blue + u * blue_slope + share * (blue_more + u * blue_more_slope)
                )


@kernel
def add_cores(grid, lamps, reach_table, windows, ranges, inverse_distances, light):
    """Add to the pixels about each lamp what softened nodes lack of 1 / r.

    Luminance times h is smooth there. It is computed at the nodes, and 1 / h at the pixels.

    Args:
        grid: lens of the image, and its grid of nodes.
        lamps: the lamps.
        reach_table: result of `halo_table_kernels.fill_tables`.
        windows: int64 [M, 4], first row of nodes, last row + 1, first column, last column + 1, in
            which each lamp's core is.
        ranges: float32 [rows, columns, 2] of the nodes: largest and smallest inverse distance, 1/m.
        inverse_distances: float32 [H, W], 1/m.
        light: float32 [H, W, 3], changed in place.
    """
    height, width, _ = light.shape
    step = grid.steps[0]
    softness = SOFT_STEPS * step / grid.lens[4]
    pixel = SOFT_PX / grid.lens[4]
    num_bands = ranges.shape[0] - 1
    for band in prange(num_bands):  # a band lies between two rows of nodes
        values = np.empty((2, ranges.shape[1], 2), np.float64)
        for index in range(len(lamps.distances_m)):
            if band < windows[index, 0] or band + 1 >= windows[index, 1]:
                continue
            first_column = windows[index, 2]
            num_columns = windows[index, 3] - first_column
            distance = lamps.distances_m[index]
            pixel_square = (pixel * distance) ** 2
            soft_square = (softness * distance) ** 2
            end_square = CORE_END * soft_square
            frame = lamps.frames[index]
            for i in range(2):
                v = ((band + i) * step - grid.lens[3]) / grid.lens[1]
                for j in range(num_columns):
                    column = first_column + j
                    u = (column * step - grid.lens[2]) / grid.lens[0]
                    z = 1 / math.sqrt(1 + u * u + v * v)
                    near, far, _ = light_to_ends(
                        lamps, index, reach_table, u * z, v * z, z,
                        ranges[band + i, column, 0], ranges[band + i, column, 1], SAME_DISTANCE,
                    )  # fmt: skip
                    values[i, j, 0] = near
                    values[i, j, 1] = far
            for y in range(band * step, min((band + 1) * step, height)):
                v = (y + 0.5 - grid.lens[3]) / grid.lens[1]
                row_share = (y + 0.5) / step - band
                for x in range(first_column * step, min((windows[index, 3] - 1) * step, width)):
                    u = (x + 0.5 - grid.lens[2]) / grid.lens[0]
                    z = 1 / math.sqrt(1 + u * u + v * v)
                    side = (u * frame[1, 0] + v * frame[1, 1] + frame[1, 2]) * z
                    rise = (u * frame[2, 0] + v * frame[2, 1] + frame[2, 2]) * z
                    square = (side * side + rise * rise) * distance * distance
                    if square >= end_square:
                        continue
                    column_place = (x + 0.5) / step
                    column = int(column_place)
                    column_share = column_place - column
                    value = 0.0
                    for corner in range(4):
                        i = corner >> 1
                        j = column + (corner & 1)
                        weight = row_share if i else 1 - row_share
                        weight *= column_share if corner & 1 else 1 - column_share
                        largest = ranges[band + i, j, 0]
                        smallest = ranges[band + i, j, 1]
                        share = 0.0
                        if largest > smallest:
                            share = (inverse_distances[y, x] - smallest) / (largest - smallest)
                            share = min(max(share, 0.0), 1.0)
                        k = j - first_column
                        value += weight * (values[i, k, 0] * share + values[i, k, 1] * (1 - share))
                    window = min((1 - square / end_square) * WINDOW_SLOPE, 1.0)
                    gain = 1 / math.sqrt(square + pixel_square)
                    gain -= 1 / _softened(square, soft_square)
                    value *= gain * window * window * (3 - 2 * window)
                    light[y, x, 0] += np.float32(value * lamps.colors[index, 0])
                    light[y, x, 1] += np.float32(value * lamps.colors[index, 1])
                    light[y, x, 2] += np.float32(value * lamps.colors[index, 2])
