"""Numba kernels: the light of a picture's nodes on its pixels.

`augment.lamps.surface_light` launches them. Each pixel takes the four nodes about it, those on its
surface first.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.lamps.surface_normal_kernels import SAME_SURFACE
from augment.lamps.vector_kernels import copies
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.layout import NUM_LANES, Index

# Weight of nodes on other surfaces, for pixels whose surface no node has.
OTHER_SURFACE_WEIGHT = 1e-4
# Coefficient of retroreflection of a white sign at 0.2 degrees, cd/m2 per lux: class RA2.
SIGN_RETURN_PER_LUX = 250.0
# Reflectance that the coefficient belongs to: a white sign's.
SIGN_WHITE = 0.7


@kernel_function()
def _read_row_of_nodes(node_inverse, lux, row, nodes, start, length):
    """Enter inverse depths and red, green and blue lux of a row of nodes as rows of `length`.

    A copy of the first node stands before it, and one of the last node after it.
    """
    rows, columns = node_inverse.shape
    row = min(max(row, 0), rows - 1)
    for j in range(columns + 2):
        column = min(max(j - 1, 0), columns - 1)
        nodes[start + j] = node_inverse[row, column]
        nodes[start + length + j] = lux[row, column, 0]
        nodes[start + 2 * length + j] = lux[row, column, 1]
        nodes[start + 3 * length + j] = lux[row, column, 2]


@kernel_function()
def _likeness_of_eight(inverse_depth, z):
    """Return `_likeness` of eight nodes and pixels, for nodes that are not of the sky."""
    gap = v8.fmuladd(inverse_depth, z, copies(-1)) * copies(1.0 / SAME_SURFACE)
    return v8.maximum(copies(1) - gap * gap, copies(OTHER_SURFACE_WEIGHT))


@kernel_function()
def _sum_of_four(a, b, c, d, nodes, index, length):
    """Return the sum of four weights times the numbers of the four nodes about each pixel."""
    below = index + Index(4 * length)
    total = d * v8.load(nodes, below + Index(1))
    total = v8.fmuladd(c, v8.load(nodes, below), total)
    total = v8.fmuladd(b, v8.load(nodes, index + Index(1)), total)
    return v8.fmuladd(a, v8.load(nodes, index), total)


@kernel_function()
def _spread_row(nodes, length, step, v, ramp, depths, lights, spare):
    """Write the light of a row of pixels that a surface of reflectance 1 sends back.

    Pixels at the same place between two nodes have the same weights, so eight of them, `step`
    pixels apart, are done at a time.

    Args:
        nodes: results of `_read_row_of_nodes` for the nodes above and below the row.
        length: length of a row of them.
        step: pixels between nodes.
        v: share of the way from the nodes above to those below.
        ramp: 0 to 7, int32.
        depths: z of the pixels from the copy of the first node on, 0 beyond the picture.
        lights: output, cd/m2, red, green and blue of those pixels.
        spare: work space, float32 [24].
    """
    zero = copies(0)
    unit = copies(1)
    far = copies(1e6)
    lower = copies(v)
    upper = unit - lower
    wide = Index(length)
    stride = Index(step)
    for first_cell in range(0, length - NUM_LANES, NUM_LANES):
        cell = Index(first_cell)
        a_inverse = v8.load(nodes, cell)
        b_inverse = v8.load(nodes, cell + Index(1))
        c_inverse = v8.load(nodes, cell + Index(4) * wide)
        d_inverse = v8.load(nodes, cell + Index(4) * wide + Index(1))
        a_share = v8.select(v8.greater(a_inverse, zero), upper, zero)
        b_share = v8.select(v8.greater(b_inverse, zero), upper, zero)
        c_share = v8.select(v8.greater(c_inverse, zero), lower, zero)
        d_share = v8.select(v8.greater(d_inverse, zero), lower, zero)
        for phase in range(step):
            z = v8.gather(depths, ramp, Index(0), stride, cell * stride + Index(phase))
            u = copies(np.float32(phase) / np.float32(step))
            a = (unit - u) * a_share * _likeness_of_eight(a_inverse, z)
            b = u * b_share * _likeness_of_eight(b_inverse, z)
            c = (unit - u) * c_share * _likeness_of_eight(c_inverse, z)
            d = u * d_share * _likeness_of_eight(d_inverse, z)
            total = (a + b) + (c + d)
            is_lit = v8.mask_and(v8.greater(total, zero), v8.greater(z, zero))
            is_lit = v8.mask_and(is_lit, v8.greater(far, z))
            gain = v8.select(is_lit, copies(1.0 / math.pi) / total, zero)
            red = _sum_of_four(a, b, c, d, nodes, cell + wide, length) * gain
            green = _sum_of_four(a, b, c, d, nodes, cell + Index(2) * wide, length) * gain
            blue = _sum_of_four(a, b, c, d, nodes, cell + Index(3) * wide, length) * gain
            v8.store(spare, Index(0), red)
            v8.store(spare, Index(NUM_LANES), green)
            v8.store(spare, Index(2 * NUM_LANES), blue)
            at = Index(3) * (cell * stride + Index(phase))
            for lane in range(Index(NUM_LANES)):
                lights[at] = spare[lane]
                lights[at + Index(1)] = spare[lane + Index(NUM_LANES)]
                lights[at + Index(2)] = spare[lane + Index(2 * NUM_LANES)]
                at += Index(3) * stride


@kernel_function()
def _add_row(lights, start, reflectance, picture, first, count):
    """Add light times reflectance to `count` numbers of the picture from `first` on."""
    done = count // NUM_LANES * NUM_LANES
    for k in range(Index(0), Index(done), Index(NUM_LANES)):
        at = Index(first) + k
        light = v8.load(lights, Index(start) + k)
        light = v8.fmuladd(light, v8.load(reflectance, at), v8.load(picture, at))
        v8.store(picture, at, light)
    for k in range(Index(done), Index(count)):
        at = Index(first) + k
        picture[at] += lights[Index(start) + k] * reflectance[at]


@kernel_function()
def _add_sign_light(row, depth, node_inverse, own_lux, step, first, reflectance, is_sign, picture):
    """Add what the signs in a row of pixels send back of the own lamps' light."""
    rows, columns = node_inverse.shape
    unit = np.float32(1)
    v = np.float32(min(max((row - first) / step, 0.0), rows - 1.0))
    i = min(int(v), max(rows - 2, 0))
    v -= np.float32(i)
    below = min(i + 1, rows - 1)
    for column in range(depth.shape[1]):
        if not is_sign[row, column]:
            continue
        z = depth[row, column]
        if not (z > np.float32(0) and z < np.float32(1e6)):
            continue
        u = np.float32(min(max((column - first) / step, 0.0), columns - 1.0))
        j = min(int(u), max(columns - 2, 0))
        u -= np.float32(j)
        beside = min(j + 1, columns - 1)
        a = (unit - u) * (unit - v) * _likeness(node_inverse[i, j], z)
        b = u * (unit - v) * _likeness(node_inverse[i, beside], z)
        c = (unit - u) * v * _likeness(node_inverse[below, j], z)
        d = u * v * _likeness(node_inverse[below, beside], z)
        total = a + b + c + d
        if total <= np.float32(0):
            continue
        share = np.float32(SIGN_RETURN_PER_LUX / SIGN_WHITE) / total
        for k in range(3):
            light = a * own_lux[i, j, k] + b * own_lux[i, beside, k]
            light += c * own_lux[below, j, k] + d * own_lux[below, beside, k]
            picture[row, column, k] += light * share * reflectance[row, column, k]


@kernel
def spread_light(depth, node_inverse, lux, own_lux, step, first, reflectance, is_sign, picture):
    """Add the nodes' light to the picture: reflectance / pi times lux, and what signs send back.

    Each pixel takes the four nodes about it, those on its surface first.

    Args:
        depth: z of the pixels, metres, 0 for the sky, float32 [H, W].
        node_inverse: 1 / z of the nodes, 0 for the sky, float32 [h, w].
        lux: result of `light_nodes`.
        own_lux: result of `light_nodes`, or empty.
        step: pixels between nodes.
        first: column and row of the first node's pixel.
        reflectance: float32 [H, W, 3].
        is_sign: pixels of signs, bool [H, W]; empty without any.
        picture: luminance in linear sRGB, cd/m2, changed in place, float32 [H, W, 3].
    """
    height, width = depth.shape
    rows, columns = node_inverse.shape
    # Between nodes lie columns + 1 cells, whose first and last reach beyond the picture.
    length = (columns + NUM_LANES) // NUM_LANES * NUM_LANES + NUM_LANES
    offset = step - first
    flat_reflectance = reflectance.reshape(reflectance.size)
    flat_picture = picture.reshape(picture.size)
    for cell in prange(rows + 1):
        cell_row = np.int64(cell)
        top = max(first + (cell_row - 1) * step, 0)
        bottom = min(first + cell_row * step, height)
        if cell_row == rows:
            bottom = height
        nodes = np.zeros(8 * length, np.float32)
        _read_row_of_nodes(node_inverse, lux, cell_row - 1, nodes, 0, length)
        _read_row_of_nodes(node_inverse, lux, cell_row, nodes, 4 * length, length)
        depths = np.zeros(length * step, np.float32)
        lights = np.empty(3 * length * step, np.float32)
        spare = np.empty(3 * NUM_LANES, np.float32)
        ramp = np.arange(NUM_LANES).astype(np.int32)
        for row in range(top, bottom):
            for column in range(width):
                depths[offset + column] = depth[row, column]
            v = np.float32(row - first - (cell_row - 1) * step) / np.float32(step)
            _spread_row(nodes, length, step, v, ramp, depths, lights, spare)
            _add_row(lights, 3 * offset, flat_reflectance, flat_picture, 3 * width * row, 3 * width)
            if is_sign.size > 0:
                has_sign = False
                for column in range(width):
                    has_sign |= is_sign[row, column]
                if has_sign:
                    _add_sign_light(
                        row,
                        depth,
                        node_inverse,
                        own_lux,
                        step,
                        first,
                        reflectance,
                        is_sign,
                        picture,
                    )


@kernel_function()
def _likeness(inverse_depth, z):
    """Return the weight of a node for a pixel: 1 on the same surface, 0 for the sky."""
    if inverse_depth <= np.float32(0):
        return np.float32(0)
    gap = (inverse_depth * z - np.float32(1)) * np.float32(1.0 / SAME_SURFACE)
    return max(np.float32(1) - gap * gap, np.float32(OTHER_SURFACE_WEIGHT))
