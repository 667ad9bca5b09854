"""Numba kernels of mirrored rays, eight at a time, through a pyramid of the nearest depth.

`screen_space` defines what they compute, and launches them.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel, kernel_function

# pyright: reportCallIssue=false, reportGeneralTypeIssues=false
# (of numba's intrinsics it sees the compiler's first argument as well, and no result)

# Numbers of the kernels' type.
_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_ONE = np.float32(1)

# `screen_space` defines the symbols and the result. The pyramid holds inverse depths, which are
# linear along a ray's image: a cell of level l is the largest of 4^l x 4^l pixels, 0 without a
# surface. A ray whose inverse depth stays above a cell's value all the way across is in front of
# everything in the cell and passes the cell in one step.
#
# The levels lie in one array: level 0, padded to whole cells of the highest level, [R, C]; to the
# right of it the others, level l from row R (1 - 4 / 4^l) on. view: the vertical in the camera (3),
# its image N (3), fx, fy, cx, cy, the eye's height over the water, and the image's width, height.

COVERED = np.float32(1 - 1 / 512)  # alpha from which the water does not show through
THICKNESS_M = np.float32(0.25)  # assumed thickness of every surface, at least, metres
THICKNESS = np.float32(0.02)  # assumed thickness as a share of the surface's depth
HIDDEN_PX = np.float32(64)  # longest run of a ray behind a surface, pixels
NEAR_M = np.float32(0.05)  # rays that come back end at this distance from the camera's plane
AGREEING = np.float32(0.05)  # largest relative difference of inverse depths within one surface
EDGE = np.float32(0.04)  # share of the image over which the weight falls to 0

LEVELS = 3  # levels above the pixels
BLOCK = 4**LEVELS  # pixels along a cell of the highest level

MAX_STEPS = 1024  # most cells that a ray may visit; streets need 20 on average
NUDGE = np.float32(1e-3)  # step past a cell's border, pixels, against rounding
_INFINITE = np.float32(math.inf)
FARTHEST = np.float32(1e-9)  # smallest inverse depth of a surface
# Largest difference of ray lengths (in |x|) within one bilinear patch: a share of the length, plus
# a constant.
_SMOOTH_SHARE = np.float32(0.2)
_SMOOTH_LENGTH = np.float32(0.05)


@kernel
def build_pyramid(alpha, depth, pyramid):
    """Write the largest inverse depths of the front's solid pixels into pyramid [R, C + C / 4]."""
    height, width = alpha.shape
    rows = pyramid.shape[0]
    columns = pyramid.shape[1] // 5 * 4
    for block in numba.prange(rows // BLOCK):
        for i in range(block * BLOCK, (block + 1) * BLOCK):
            out = pyramid[i]
            if i < height:
                opacity = alpha[i]
                z = depth[i]
                for j in range(width):
                    out[j] = _ONE / z[j] if opacity[j] >= _HALF else _ZERO
                out[width:columns] = _ZERO
            else:
                out[:columns] = _ZERO
        fine = pyramid[block * BLOCK : (block + 1) * BLOCK, :columns]
        size = 4
        for _ in range(LEVELS):
            first = rows - rows * 4 // size + block * (BLOCK // size)
            coarse = pyramid[first : first + BLOCK // size, columns : columns + columns // size]
            for i in range(coarse.shape[0]):
                a = fine[4 * i]
                b = fine[4 * i + 1]
                c = fine[4 * i + 2]
                d = fine[4 * i + 3]
                for j in range(coarse.shape[1]):
                    largest = _ZERO
                    for k in range(4 * j, 4 * j + 4):
                        largest = max(largest, max(max(a[k], b[k]), max(c[k], d[k])))
                    coarse[i, j] = largest
            fine = coarse
            size = size * 4


@intrinsic
def _fetch(typingctx, array, row, column):
    """Read array[row, column] for eight pairs of integers >= -1 from a contiguous 2-D array."""

    def codegen(context, builder, sig, args):
        int_lanes = ir.VectorType(ir.IntType(32), v8.LANES)
        int64 = ir.IntType(64)
        image = context.make_array(sig.args[0])(context, builder, args[0])
        rows, columns = (
            builder.trunc(n, ir.IntType(32)) for n in cgutils.unpack_tuple(builder, image.shape)
        )
        undefined = ir.Constant(int_lanes, ir.Undefined)
        pitch = undefined
        last = undefined
        size = builder.sub(builder.mul(rows, columns), ir.IntType(32)(1))
        for lane in range(v8.LANES):
            pitch = builder.insert_element(pitch, columns, ir.IntType(32)(lane))
            last = builder.insert_element(last, size, ir.IntType(32)(lane))
        index = builder.mul(builder.fptosi(args[1], int_lanes), pitch)
        index = builder.add(index, builder.fptosi(args[2], int_lanes))
        zero = ir.Constant(int_lanes, [0] * v8.LANES)
        index = builder.select(builder.icmp_signed("<", index, zero), zero, index)
        index = builder.select(builder.icmp_signed(">", index, last), last, index)
        value = ir.Constant(ir.VectorType(ir.FloatType(), v8.LANES), ir.Undefined)
        for lane in range(v8.LANES):
            number = ir.IntType(32)(lane)
            element_index = builder.zext(builder.extract_element(index, number), int64)
            element = builder.load(builder.gep(image.data, [element_index]))
            value = builder.insert_element(value, element, number)
        return value

    return v8.float8(array, v8.float8, v8.float8), codegen


@kernel_function()
def _difference(before, center, after, has_before, has_after):
    """Return the change of the inverse depth per pixel, by neighbours on the same surface."""
    total = _ZERO
    count = _ZERO
    if has_after and abs(after - center) < AGREEING * center:
        total += after - center
        count += _ONE
    if has_before and abs(center - before) < AGREEING * center:
        total += center - before
        count += _ONE
    return total / max(count, _ONE)


@kernel_function()
def _edge_weight(x, y, width, height):
    fx = min(max(min(x, width - x) / (EDGE * width), _ZERO), _ONE)
    fy = min(max(min(y, height - y) / (EDGE * height), _ZERO), _ONE)
    two = np.float32(2)
    three = np.float32(3)
    return fx * fx * (three - two * fx) * fy * fy * (three - two * fy)


@kernel_function()
def _set_up(view, xs, ys, first):
    """Return the numbers of eight mirrored rays (see `screen_space._Rays`) and their start."""
    width = view[11]
    height = view[12]
    x0 = v8.load(xs, first)
    y0 = v8.load(ys, first)
    ones = v8.broadcast(_ONE)
    zero = v8.broadcast(_ZERO)
    nx = v8.broadcast(view[0])
    ny = v8.broadcast(view[1])
    nz = v8.broadcast(view[2])
    u = (x0 - v8.broadcast(view[8])) / v8.broadcast(view[6])
    v = (y0 - v8.broadcast(view[9])) / v8.broadcast(view[7])
    slope = u * nx + v * ny + nz
    gx = v8.broadcast(view[3]) - x0 * nz
    gy = v8.broadcast(view[4]) - y0 * nz
    g = v8.maximum(v8.maximum(v8.absolute(gx), v8.absolute(gy)), v8.broadcast(np.float32(1e-9)))
    rise = slope * v8.broadcast(np.float32(-2))
    scale = rise * g
    bend = (ones + rise * nz) / scale
    k_start = v8.negate(slope) / v8.broadcast(view[10])
    dx = gx / g
    dy = gy / g
    # A ray along an axis never gets to the other axis's next border.
    tiny = v8.broadcast(np.float32(1e-30))
    inverse_x = ones / v8.select(v8.greater(v8.absolute(dx), tiny), dx, tiny)
    inverse_y = ones / v8.select(v8.greater(v8.absolute(dy), tiny), dy, tiny)
    ahead_x = v8.select(v8.at_least(inverse_x, zero), ones, zero)
    ahead_y = v8.select(v8.at_least(inverse_y, zero), ones, zero)
    end = v8.minimum(
        (ahead_x * v8.broadcast(width) - x0) * inverse_x,
        (ahead_y * v8.broadcast(height) - y0) * inverse_y,
    )
    back = (ones - ones / (k_start * v8.broadcast(NEAR_M))) / bend
    returns = v8.greater(zero, bend)
    end = v8.select(returns, v8.minimum(end, back), end)
    far = v8.at_least(bend * end, ones)
    end = v8.select(far, ones / bend, end)
    to_sky = v8.select(far, ones, zero)
    ray = (x0, y0, dx, dy, inverse_x, inverse_y, ahead_x, ahead_y, k_start, bend * k_start, end)
    # A ray meets nothing in its first pixel.
    t = v8.broadcast(_HALF) * v8.minimum(v8.absolute(inverse_x), v8.absolute(inverse_y))
    size = v8.broadcast(np.float32(4))
    state = (t + v8.broadcast(NUDGE), end, size, ones / size, zero, ones, zero)
    return ray, state, to_sky, scale


@kernel_function()
def _step(pyramid, ray, state):
    """Move eight rays through one cell each, or down into its parts.

    state: t, the t to stop at, the cell's size and its inverse, pixels behind a surface without a
    break, 1 if there never were any, 1 if the ray has hit a surface.
    """
    x0, y0, dx, dy, inverse_x, inverse_y, ahead_x, ahead_y, k_start, change, end = ray
    t, stop, size, inverse, hidden_px, clean, has_hit = state
    zero = v8.broadcast(_ZERO)
    half = v8.broadcast(_HALF)
    ones = v8.broadcast(_ONE)
    four = v8.broadcast(np.float32(4))
    quarter = v8.broadcast(np.float32(0.25))
    rows = v8.broadcast(np.float32(pyramid.shape[0]))
    columns = v8.broadcast(np.float32(pyramid.shape[1] // 5 * 4))
    going = v8.greater(stop, t)
    cell_x = v8.floor(v8.fmuladd(t, dx, x0) * inverse)
    cell_y = v8.floor(v8.fmuladd(t, dy, y0) * inverse)
    level_row = v8.maximum(rows - rows * four * inverse, zero)
    level_column = v8.select(v8.greater(size, ones), columns, zero)
    surface = _fetch(pyramid, cell_y + level_row, cell_x + level_column)
    leave_x = ((cell_x + ahead_x) * size - x0) * inverse_x
    leave_y = ((cell_y + ahead_y) * size - y0) * inverse_y
    leave = v8.maximum(v8.minimum(v8.minimum(leave_x, leave_y), end), t)
    beyond = leave + v8.broadcast(NUDGE)
    # A ray goes up only when it leaves the parent cell, which it has tested already.
    above = inverse * quarter
    parent_step_x = v8.floor(v8.fmuladd(beyond, dx, x0) * above) - v8.floor(cell_x * quarter)
    parent_step_y = v8.floor(v8.fmuladd(beyond, dy, y0) * above) - v8.floor(cell_y * quarter)
    climbs = v8.mask_and(
        v8.greater(v8.broadcast(np.float32(BLOCK)), size),
        v8.greater(v8.absolute(parent_step_x) + v8.absolute(parent_step_y), half),
    )
    k0 = k_start - change * t
    k1 = k_start - change * leave
    nearest = v8.maximum(v8.minimum(k0, k1), v8.broadcast(FARTHEST))
    reached = v8.mask_and(going, v8.at_least(surface, nearest))
    thick = v8.maximum(v8.broadcast(THICKNESS), v8.broadcast(THICKNESS_M) * surface)
    entered = v8.at_least(v8.maximum(k0, k1) * (ones + thick), surface)
    pixel = v8.mask_and(reached, v8.at_least(ones, size))
    hit = v8.mask_and(pixel, entered)
    has_hit = v8.select(hit, ones, has_hit)
    clean = v8.select(pixel, v8.select(entered, clean, zero), clean)
    hidden_px = v8.select(pixel, hidden_px + (leave - t), v8.select(reached, hidden_px, zero))
    stop = v8.select(hit, v8.negate(ones), stop)
    stop = v8.select(v8.greater(hidden_px, v8.broadcast(HIDDEN_PX)), v8.negate(ones), stop)
    next_t = v8.select(pixel, beyond, v8.select(reached, t, beyond))
    t = v8.select(hit, t, v8.select(going, next_t, t))
    up = v8.select(climbs, four, ones)
    size = v8.select(reached, v8.maximum(size * quarter, ones), size * up)
    up = v8.select(climbs, above, inverse)
    inverse = v8.select(reached, v8.minimum(inverse * four, ones), up)
    return t, stop, size, inverse, hidden_px, clean, has_hit


@kernel_function()
def _finish(pyramid, view, lanes, ray, state, to_sky, scale, first, lengths, trusts):
    """Write the results of eight rays that have ended."""
    x0, y0, dx, dy, _, _, _, _, k_start, change, end = ray
    t, stop, _, _, _, clean, has_hit = state
    half = v8.broadcast(_HALF)
    zero = v8.broadcast(_ZERO)
    sky = v8.select(v8.at_least(t, stop), clean * to_sky, zero)
    t = v8.select(v8.greater(has_hit, half), t, end)
    v8.store(lanes, np.uint64(0), has_hit)
    v8.store(lanes, np.uint64(8), sky)
    v8.store(lanes, np.uint64(16), t)
    v8.store(lanes, np.uint64(24), dx)
    v8.store(lanes, np.uint64(32), dy)
    v8.store(lanes, np.uint64(40), change)
    v8.store(lanes, np.uint64(48), k_start)
    v8.store(lanes, np.uint64(56), end)
    v8.store(lanes, np.uint64(64), scale)
    v8.store(lanes, np.uint64(72), x0)
    v8.store(lanes, np.uint64(80), y0)
    width = view[11]
    height = view[12]
    for lane in range(8):
        length = _INFINITE
        trust = _ZERO
        t_last = lanes[16 + lane]
        x = lanes[72 + lane]
        y = lanes[80 + lane]
        step_x = lanes[24 + lane]
        step_y = lanes[32 + lane]
        if lanes[lane] > _HALF:
            change_of_lane = lanes[40 + lane]
            k_start_of_lane = lanes[48 + lane]
            length, t_last = _meet(
                pyramid,
                width,
                height,
                x,
                y,
                step_x,
                step_y,
                t_last,
                change_of_lane,
                k_start_of_lane,
            )
            t_last = min(t_last, lanes[56 + lane])
            length = length * k_start_of_lane / lanes[64 + lane]
        if lanes[lane] > _HALF or lanes[8 + lane] > _HALF:
            trust = _edge_weight(x + t_last * step_x, y + t_last * step_y, width, height)
        lengths[first + np.uint64(lane)] = length
        trusts[first + np.uint64(lane)] = trust


@kernel_function()
def _meet(pyramid, width, height, x0, y0, dx, dy, t, change, k_start):
    """Return t / k and t where the ray meets the plane through the surface in the pixel at t.

    k is the ray's inverse depth there. The result is at most 1 px off that pixel.
    """
    cx = min(max(int(x0 + t * dx), 0), int(width) - 1)
    cy = min(max(int(y0 + t * dy), 0), int(height) - 1)
    center = pyramid[cy, cx]
    left = max(cx - 1, 0)
    above = max(cy - 1, 0)  # a pixel is its own neighbour at the border
    right = min(cx + 1, int(width) - 1)
    below = min(cy + 1, int(height) - 1)
    across = _difference(pyramid[cy, left], center, pyramid[cy, right], cx > left, right > cx)
    down = _difference(pyramid[above, cx], center, pyramid[below, cx], cy > above, below > cy)
    off_x = np.float32(cx) + _HALF - x0
    off_y = np.float32(cy) + _HALF - y0
    closing = -change - across * dx - down * dy
    middle = off_x * dx if abs(dx) >= abs(dy) else off_y * dy
    t_meet = middle
    if closing != _ZERO:
        t_meet = (center - across * off_x - down * off_y - k_start) / closing
    reach = np.float32(1.5)
    t_meet = max(min(max(t_meet, middle - reach), middle + reach), _ZERO)
    # The end is not beyond the surface that was hit, even if the ray grazes it.
    back = center / (_ONE + max(THICKNESS, THICKNESS_M * center))
    return t_meet / max(k_start - change * t_meet, back), t_meet


@kernel_function()
def _run(pyramid, view, lanes, xs, ys, count, lengths, trusts):
    """Trace the mirrored rays of the first `count` pixels of a list, which has room for 8 more.

    xs, ys: pixel centres that see the water. lanes: scratch. lengths, trusts: outputs, ray lengths
    over |x| and weights.
    """
    for first in range(0, count, 8):
        for spare in range(count, first + 8):
            xs[spare] = xs[count - 1]
            ys[spare] = ys[count - 1]
        at = np.uint64(first)
        ray, state, to_sky, scale = _set_up(view, xs, ys, at)
        for _ in range(MAX_STEPS):
            # The sign bit is clear while a ray goes on. A ray that ends exactly here does no harm.
            if not v8.has_nonnegative_lane(state[1] - state[0]):
                break
            state = _step(pyramid, ray, state)
        _finish(pyramid, view, lanes, ray, state, to_sky, scale, at, lengths, trusts)


@kernel_function()
def _sees_water(view, alpha, column, row):
    """Return True if the pixel's ray falls and the front does not cover the water."""
    if 0 <= row < alpha.shape[0] and 0 <= column < alpha.shape[1] and alpha[row, column] >= COVERED:
        return False
    u = (np.float32(column) + _HALF - view[8]) / view[6]
    v = (np.float32(row) + _HALF - view[9]) / view[7]
    return u * view[0] + v * view[1] + view[2] < _ZERO


@kernel_function()
def _inside(alpha, column, row):
    return 0 <= row < alpha.shape[0] and 0 <= column < alpha.shape[1]


@kernel
def trace(pyramid, view, alpha, needed, left, top, stride, lengths, weights):
    """Write ray lengths (in |x|) and weights (-1 if not needed) of every `stride`-th pixel."""
    columns = lengths.shape[1]
    for i in numba.prange(lengths.shape[0]):
        lanes = np.empty(88, np.float32)
        lists = np.empty((4, columns + 8), np.float32)
        row = top + i * stride
        count = 0
        for j in range(columns):
            column = left + j * stride
            lengths[i, j] = _INFINITE
            weights[i, j] = _ZERO
            if not (needed[i * stride, j * stride] and _sees_water(view, alpha, column, row)):
                weights[i, j] = -_ONE
            elif _inside(alpha, column, row):
                lists[0, count] = np.float32(column) + _HALF
                lists[1, count] = np.float32(row) + _HALF
                count += 1
        _run(pyramid, view, lanes, lists[0], lists[1], count, lists[2], lists[3])
        for n in range(count):
            j = (int(lists[0, n]) - left) // stride
            lengths[i, j] = lists[2, n]
            weights[i, j] = lists[3, n]


@kernel_function()
def _to_metres(view, alpha, needed, column, row, distance, weight):
    """Convert a row of ray lengths from |x| to metres; zero the weights of other pixels.

    Only needed pixels that show water keep a weight.
    """
    v = (np.float32(row) + _HALF - view[9]) / view[7]
    vv = _ONE + v * v
    slope_v = v * view[1] + view[2]
    inside = 0 <= row < alpha.shape[0]
    for j in range(distance.shape[0]):
        u = (np.float32(column + j) + _HALF - view[8]) / view[6]
        slope = u * view[0] + slope_v
        covered = inside and 0 <= column + j < alpha.shape[1] and alpha[row, column + j] >= COVERED
        is_hidden = slope >= _ZERO or covered or not needed[j] or weight[j] < _ZERO
        r = math.sqrt(vv + u * u) * view[10] / -slope
        distance[j] = _INFINITE if is_hidden else distance[j] * r
        weight[j] = _ZERO if is_hidden else weight[j]


@kernel
def spread(pyramid, view, alpha, needed, left, top, stride, lengths, weights, distance, weight):
    """Write metres and weights of all pixels.

    A pixel is interpolated if the four traced pixels around it agree. If they do not, at
    silhouettes and beside covered pixels, the pixel itself is traced.
    """
    height, width = distance.shape
    rows, columns = lengths.shape
    inverse_stride = _ONE / np.float32(stride)
    for i in numba.prange(rows):
        lanes = np.empty(88, np.float32)
        lists = np.empty((4, stride * (width + stride) + 8), np.float32)
        count = 0
        below = min(i + 1, rows - 1)
        num_rows = min(stride, height - i * stride)
        y0 = i * stride
        for j in range(columns):
            right = min(j + 1, columns - 1)
            num_columns = min(stride, width - j * stride)
            x0 = j * stride
            w00 = lengths[i, j]
            w01 = lengths[i, right]
            w10 = lengths[below, j]
            w11 = lengths[below, right]
            t00 = weights[i, j]
            t01 = weights[i, right]
            t10 = weights[below, j]
            t11 = weights[below, right]
            min_length = min(min(w00, w01), min(w10, w11))
            max_length = max(max(w00, w01), max(w10, w11))
            min_weight = min(min(t00, t01), min(t10, t11))
            max_weight = max(max(t00, t01), max(t10, t11))
            is_same_surface = min_weight > _ZERO or (min_weight == _ZERO and max_weight == _ZERO)
            if is_same_surface and min_length < _INFINITE:
                is_same_surface = (
                    max_length - min_length <= _SMOOTH_SHARE * min_length + _SMOOTH_LENGTH
                )
            if is_same_surface or max_weight < _ZERO:
                for di in range(num_rows):
                    fy = np.float32(di) * inverse_stride
                    w0 = w00 + (w10 - w00) * fy
                    w1 = w01 + (w11 - w01) * fy
                    t0 = t00 + (t10 - t00) * fy
                    t1 = t01 + (t11 - t01) * fy
                    for dj in range(num_columns):
                        fx = np.float32(dj) * inverse_stride
                        length = w0 + (w1 - w0) * fx if min_length < _INFINITE else _INFINITE
                        distance[y0 + di, x0 + dj] = length
                        weight[y0 + di, x0 + dj] = t0 + (t1 - t0) * fx
                continue
            for di in range(num_rows):
                for dj in range(num_columns):
                    length = w00
                    pixel_weight = t00
                    column = left + x0 + dj
                    row = top + y0 + di
                    if di > 0 or dj > 0:
                        length = _INFINITE
                        pixel_weight = _ZERO
                        is_needed = needed[y0 + di, x0 + dj] and _inside(alpha, column, row)
                        if is_needed and _sees_water(view, alpha, column, row):
                            lists[0, count] = np.float32(column) + _HALF
                            lists[1, count] = np.float32(row) + _HALF
                            count += 1
                    distance[y0 + di, x0 + dj] = length
                    weight[y0 + di, x0 + dj] = pixel_weight
        _run(pyramid, view, lanes, lists[0], lists[1], count, lists[2], lists[3])
        for n in range(count):
            x = int(lists[0, n]) - left
            y = int(lists[1, n]) - top
            distance[y, x] = lists[2, n]
            weight[y, x] = lists[3, n]
        for y in range(y0, y0 + num_rows):
            _to_metres(view, alpha, needed[y], left, top + y, distance[y], weight[y])
