"""Numba kernels from gradients of the image to gradients of every Gaussian.

The forward blend is repeated front to back. Let q_i = dL/dw_i, the sum of the terms that a weight
w_i = alpha_i T_i is multiplied with, and behind_i the sum of w_j q_j behind splat i. Then

    dL/dalpha_i = T_i q_i - behind_i / (1 - alpha_i),

where `behind` starts as the sum over the whole pixel, known from the finished image, and loses
w_i q_i at every splat. So nothing is divided by a transmittance.

A splat's share of a tile is kept as sums over its pixels of g = dL/de (e: log2 of alpha, see
augment.render.layout) times powers of `off` (sharp pixels off the ridge) and `dy`, from which
project_backward derives the gradients of the geometry. Each list entry has its own place for them,
so no order of addition depends on threads.

`cpu.backward` launches blend_backward, sum_shares and project_backward, in this order.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.blend import (
    Work,
    aligned_floats,
    alpha_of,
    is_closed,
    remaining_transmittance,
    shrink,
)
from augment.render.cpu.geometry import (
    BATCH,
    ITEMS,
    PLACES,
    STARTS,
    dot,
    find_spans,
    list_items,
    offsets_from_eye,
    rotation_row,
    semi_axes,
    stage,
    to_camera,
)
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.project import add_direction_slopes
from augment.render.cpu.simd import LOG2_E, floats_at
from augment.render.layout import (
    BLOCK_SIZE,
    NUM_LANES,
    PIXELS,
    RECORD,
    STRIP,
    STRIPS,
    TILE_H,
    TILE_W,
    Index,
)

# Sums of a list entry, one cache line: of g, g off, g off^2, g dy, g off dy, g dy^2, and of
# |dL/d mean| along x (over 2 sharp) and y (over 2); then dL/d colour (3) and dL/d z.
SHARE = 16
S_0, S_X, S_XX, S_Y, S_XY, S_YY, S_ABS_X, S_ABS_Y, S_RED, S_GREEN, S_BLUE, S_DEPTH = range(12)

# Planes of a tile: transmittance as in blend, `behind`, and the pixel's gradients.
TRANSMITTANCE, BEHIND, G_RED, G_GREEN, G_BLUE, G_ALPHA, G_DEPTH = (
    Index(i * PIXELS) for i in range(7)
)
PLANES = 7 * PIXELS
# Tiles that a thread takes at a time.
GROUP = 4
_LN2 = np.float32(math.log(2))


class Slopes(NamedTuple):
    """Images and the loss's derivatives by them, flat.

    rgb, alpha: images as rendered.
    depth: sum of weights times z; may be None.
    d_rgb, d_alpha, d_depth: derivatives of the loss by them; d_depth may be None.
    """

    rgb: Any
    alpha: Any
    depth: Any
    d_rgb: Any
    d_alpha: Any
    d_depth: Any


@kernel
def blend_backward(splats, frame, slopes, shares, num_reached):
    """Write dL of every list entry that the forward blend reached.

    Args:
        splats, frame: as for blend.blend_tiles, in one slice.
        slopes: images and derivatives.
        shares: float32 [entries * SHARE], written up to num_reached[tile] entries of each list.
        num_reached: int64 [tiles], written.
    """
    for group in prange((num_reached.size + GROUP - 1) // GROUP):
        columns = (frame.size[0] + TILE_W - 1) // TILE_W
        s = slopes
        state = np.empty(PLANES, np.float32)
        rows = np.empty(2 * STRIPS, np.int64)
        staged = aligned_floats(RECORD * BATCH)
        spans = np.empty(2 * BATCH, np.int32)
        values = np.empty(2 * ITEMS, np.float32)
        places = np.empty(ITEMS, np.int32)
        starts = aligned_floats(STARTS)
        work = Work(state, staged, spans, starts, values, places, rows, None, None, None, None)
        for tile in range(group * GROUP, min((group + 1) * GROUP, num_reached.size)):
            first = splats.tile_offsets[tile]
            last = splats.tile_offsets[tile + 1]
            left = tile % columns * TILE_W
            top = tile // columns * TILE_H
            if first < last:
                _load_tile(
                    state,
                    left,
                    top,
                    frame.size,
                    s.rgb,
                    s.alpha,
                    s.depth,
                    s.d_rgb,
                    s.d_alpha,
                    s.d_depth,
                )
            corner = (np.float32(left), np.float32(top))
            num_reached[tile] = _replay_list(
                splats, first, last, corner, frame.limits, work, slopes.d_depth, shares
            )


@kernel_function()
def _load_tile(state, left, top, size, rgb, alpha, depth, d_rgb, d_alpha, d_depth):
    """Load the gradients of a tile's pixels, and the sums that lie behind their first splat."""
    for pixel in range(Index(PIXELS)):
        x = left + np.int64(pixel // Index(STRIP) * Index(NUM_LANES) + pixel % Index(NUM_LANES))
        y = top + np.int64(pixel % Index(STRIP) // Index(NUM_LANES))
        if x >= size[0] or y >= size[1]:
            state[pixel] = np.float32(-1)
            for plane in range(Index(1), Index(7)):
                state[plane * Index(PIXELS) + pixel] = np.float32(0)
            continue
        at = Index(y * size[0] + x)
        first = Index(3) * at
        red = d_rgb[first]
        green = d_rgb[first + Index(1)]
        blue = d_rgb[first + Index(2)]
        behind = red * rgb[first] + green * rgb[first + Index(1)] + blue * rgb[first + Index(2)]
        behind += d_alpha[at] * alpha[at]
        state[pixel] = np.float32(1)
        state[G_RED + pixel] = red
        state[G_GREEN + pixel] = green
        state[G_BLUE + pixel] = blue
        state[G_ALPHA + pixel] = d_alpha[at]
        if d_depth is not None:
            state[G_DEPTH + pixel] = d_depth[at]
            behind += d_depth[at] * depth[at]
        state[BEHIND + pixel] = behind


@kernel_function()
def _replay_list(splats, first, last, corner, limits, work, d_depth, shares):
    """Fill the shares of a tile's list as far as light reaches, and return how far that is."""
    state = work.state
    staged = work.staged
    spans = work.spans
    rows = work.rows
    values = work.values
    places = work.places
    starts = work.starts
    records = splats.records
    ids = splats.tile_splat_ids
    columns = v8.lane_numbers()
    for strip in range(STRIPS):
        rows[2 * strip] = 0
        rows[2 * strip + 1] = TILE_H
        if first < last:
            shrink(state, strip, rows, columns)
    for at in range(first, last, BATCH):
        if is_closed(rows):
            return at - first
        count = Index(min(BATCH, last - at))
        for k in range(Index(at) + count, Index(min(at + 2 * BATCH, last))):
            v8.prefetch(records, Index(ids[k]) * Index(RECORD))
        stage(records, ids, Index(at), count, corner, staged)
        for i in range(Index(at) * Index(SHARE), (Index(at) + count) * Index(SHARE)):
            shares[i] = np.float32(0)
        for strip in range(STRIPS):
            if rows[2 * strip] >= rows[2 * strip + 1]:
                continue
            span_bits = find_spans(staged, count, strip, rows, limits[1], spans, starts)
            list_items(staged, span_bits, Index(strip), spans, starts, columns, values, places)
            item = Index(0)
            while span_bits != Index(0):
                k = v8.lowest_bit(span_bits)
                span_bits &= span_bits - Index(1)
                end = item + Index(spans[Index(BATCH) + k] - spans[k])
                _add_share(
                    work, k, item, end, limits, d_depth, shares, (Index(at) + k) * Index(SHARE)
                )
                item = end
            shrink(state, strip, rows, columns)
    return last - first


@kernel_function()
def _add_share(work, k, item, end, limits, d_depth, shares, share):
    """Blend one splat into its rows of a strip, and add its pixels' gradients to its share."""
    state = work.state
    staged = work.staged
    values = work.values
    places = work.places
    n = Index(BATCH)
    alpha_max = v8.broadcast(limits[0])
    log_cut = v8.broadcast(limits[1])
    min_transmittance = v8.broadcast(limits[2])
    stop = v8.broadcast(limits[7])
    zeros = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    # Shape and colour of the splat in all lanes.
    sharp = staged[Index(L.SHARP_X) * n + k]
    fall = v8.broadcast(staged[Index(L.FALL_Y) * n + k])
    tilt = v8.broadcast(-sharp * staged[Index(L.LEAN_X) * n + k])
    steps = v8.broadcast(sharp)
    ln2 = v8.broadcast(_LN2)
    red = v8.broadcast(staged[Index(L.RED) * n + k])
    green = v8.broadcast(staged[Index(L.GREEN) * n + k])
    blue = v8.broadcast(staged[Index(L.BLUE) * n + k])
    z = zeros
    if d_depth is not None:
        z = v8.broadcast(staged[Index(L.DEPTH) * n + k])
    # Sums over the pixels: of g and its products, of colour and depth, of |dL/d mean|.
    s0 = zeros
    sx = zeros
    sxx = zeros
    sy = zeros
    sxy = zeros
    syy = zeros
    sr = zeros
    sg = zeros
    sb = zeros
    sz = zeros
    ax = zeros
    ay = zeros
    for i in range(item, end):
        # Alpha, weight and transmittance, as in the forward blend.
        pixel = Index(places[i]) % Index(PLACES) * Index(NUM_LANES)
        row = np.float32(pixel % Index(STRIP) // Index(NUM_LANES)) + np.float32(0.5)
        dy = v8.broadcast(row - staged[Index(L.MEAN_Y) * n + k])
        off = v8.fmuladd(steps, v8.lane_numbers(), v8.broadcast(values[i + Index(ITEMS)]))
        log_alpha = v8.fmuladd(v8.negate(off), off, v8.broadcast(values[i]))
        alpha = alpha_of(log_alpha, alpha_max, log_cut)
        transmittance = v8.load(state, pixel)
        weight = alpha * transmittance
        transmittance_behind = transmittance - weight
        is_blended = v8.greater(transmittance_behind, min_transmittance)
        weight = v8.select(is_blended, weight, zeros)
        v8.store(
            state,
            pixel,
            remaining_transmittance(transmittance, transmittance_behind, is_blended, stop),
        )
        # q = dL/dw, and what remains of the sum behind the splat.
        g_red = v8.load(state, pixel + G_RED)
        g_green = v8.load(state, pixel + G_GREEN)
        g_blue = v8.load(state, pixel + G_BLUE)
        q = v8.fmuladd(g_red, red, v8.load(state, pixel + G_ALPHA))
        q = v8.fmuladd(g_green, green, q)
        q = v8.fmuladd(g_blue, blue, q)
        if d_depth is not None:
            g_depth = v8.load(state, pixel + G_DEPTH)
            q = v8.fmuladd(g_depth, z, q)
            sz = v8.fmuladd(weight, g_depth, sz)
        behind = v8.fmuladd(v8.negate(weight), q, v8.load(state, pixel + BEHIND))
        v8.store(state, pixel + BEHIND, behind)
        # g = dL/de.
        by_alpha = transmittance * q - behind / (ones - alpha)
        # An alpha that is cut off, clamped or behind the stop has no gradient.
        is_free = v8.mask_and(
            v8.mask_and(v8.at_least(log_alpha, log_cut), is_blended), v8.greater(alpha_max, alpha)
        )
        g = v8.select(is_free, by_alpha * alpha * ln2, zeros)
        g_off = g * off
        sr = v8.fmuladd(weight, g_red, sr)
        sg = v8.fmuladd(weight, g_green, sg)
        sb = v8.fmuladd(weight, g_blue, sb)
        s0 = s0 + g
        sx = sx + g_off
        sxx = v8.fmuladd(g_off, off, sxx)
        sy = v8.fmuladd(g, dy, sy)
        sxy = v8.fmuladd(g_off, dy, sxy)
        syy = v8.fmuladd(g * dy, dy, syy)
        ax = ax + v8.absolute(g_off)
        ay = ay + v8.absolute(v8.fmuladd(tilt, g_off, fall * (g * dy)))
    shape = v8.totals(s0, sx, sxx, sy, sxy, syy, ax, ay)
    v8.store(shares, share, v8.load(shares, share) + shape)
    color = v8.totals(sr, sg, sb, sz, zeros, zeros, zeros, zeros)
    v8.store(shares, share + Index(8), v8.load(shares, share + Index(8)) + color)


@kernel
def sum_shares(tile_splat_ids, tile_offsets, num_reached, shares, ranges, sums, is_touched):
    """Add every slot's shares of all tiles, in the order of the tiles.

    Each of `ranges` runs of slots looks at all entries and takes its own. So the order of addition
    is always the same.

    sums: float32 [slots * SHARE], written. is_touched: uint8 [slots], written: 1 if any entry was
    reached.
    """
    slots = is_touched.size
    for run in prange(ranges):
        low = Index(slots * run // ranges)
        high = Index(slots * (run + 1) // ranges)
        for slot in range(low, high):
            is_touched[slot] = 0
        for tile in range(num_reached.size):
            for entry in range(
                Index(tile_offsets[tile]), Index(tile_offsets[tile] + num_reached[tile])
            ):
                slot = Index(tile_splat_ids[entry])
                if slot < low or slot >= high:
                    continue
                at = slot * Index(SHARE)
                share = entry * Index(SHARE)
                if is_touched[slot] == 0:
                    is_touched[slot] = 1
                    for i in range(Index(0), Index(SHARE), Index(NUM_LANES)):
                        v8.store(sums, at + i, v8.load(shares, share + i))
                else:
                    for i in range(Index(0), Index(SHARE), Index(NUM_LANES)):
                        total = v8.load(sums, at + i) + v8.load(shares, share + i)
                        v8.store(sums, at + i, total)


# ---- From gradients of a splat's ellipse, depth and colour to those of its Gaussian --------------
# Eight splats at a time, by the chain rule through the projection. Names: g_a is dL/da.

# A row of gradients, one cache line: by mean (3, metres, in the part's axes), unit quaternion (4,
# tangential), logarithms of scales (3) and opacity, colour before its clamp at 0 (3). The row also
# holds two numbers for densification: G_ABS_MEAN, the sum of |dL/d mean| over pixels (1/px), and
# G_MAX_SIGMA, the largest sigma, px.
NUM_GRADIENTS = 16
G_MEAN = 0
G_QUAT = 3
G_ABS_MEAN = 7
G_SCALE = 8
G_OPACITY = 11
G_COLOR = 12
G_MAX_SIGMA = 15

_INVERSE_LN2 = np.float32(1 / math.log(2))
_SLOPES = 16  # rows of eight: gradients of the SH functions, weighted


@kernel
def project_backward(inputs, splats, is_touched, sums, grads, ids, counts):
    """Write a row of `grads` for every touched splat, block by block in the order of its Gaussians.

    Block b fills rows b BLOCK_SIZE to b BLOCK_SIZE + counts[b].

    Args:
        inputs, splats: as for project_slice.
        is_touched, sums: as sum_shares wrote them.
        grads: float32 [B BLOCK_SIZE * NUM_GRADIENTS], written.
        ids: int32 [B BLOCK_SIZE], written: index of the Gaussian in its part.
        counts: int64 [B], written: rows of each block.
    """
    for block in prange(inputs.blocks.shape[0]):
        part = inputs.blocks[block, 0]
        records = splats.records
        view = inputs.views[part]
        modes = inputs.modes
        addresses = inputs.addresses
        slots = np.empty(BLOCK_SIZE + NUM_LANES, np.int32)
        gaussian_ids = np.empty(BLOCK_SIZE + NUM_LANES, np.int32)
        rows = np.empty((_SLOPES + NUM_GRADIENTS) * NUM_LANES, np.float32)
        base = block * BLOCK_SIZE
        num_touched = Index(0)
        # Touched splats of the block, filled up to a whole group of eight.
        for slot in range(base, base + splats.splat_counts[block]):
            if is_touched[slot] != 0:
                number = np.float32(records[slot * RECORD + L.SPLAT_ID]).view(np.int32)
                slots[num_touched] = np.int32(slot)
                gaussian_ids[num_touched] = number - np.int32(inputs.first_ids[part])
                ids[Index(base) + num_touched] = gaussian_ids[num_touched]
                num_touched += Index(1)
        counts[block] = num_touched
        if num_touched == Index(0):
            continue
        for lane in range(Index(NUM_LANES)):
            slots[num_touched + lane] = slots[num_touched - Index(1)]
            gaussian_ids[num_touched + lane] = gaussian_ids[num_touched - Index(1)]
        # Arrays of the block's part.
        count, num_stored_functions = inputs.sizes[part]
        means = floats_at(addresses[part, L.A_MEANS], count * 3)
        quats = floats_at(addresses[part, L.A_QUATS], count * 4)
        scales = floats_at(addresses[part, L.A_SCALES], count * 3)
        sh = floats_at(addresses[part, L.A_SH], count * num_stored_functions * 3)
        num_functions = min(modes[L.M_NUM_SH_FUNCTIONS], num_stored_functions)
        # Gradients of eight Gaussians, then their rows.
        for group in range(Index(0), num_touched, Index(NUM_LANES)):
            _color_backward(
                sh,
                Index(num_stored_functions),
                Index(num_functions),
                means,
                view,
                slots,
                gaussian_ids,
                group,
                records,
                sums,
                rows,
            )
            _geometry_backward(
                means, quats, scales, view, slots, gaussian_ids, group, modes, records, sums, rows
            )
            for lane in range(min(Index(NUM_LANES), num_touched - group)):
                row = (Index(base) + group + lane) * Index(NUM_GRADIENTS)
                for field in range(Index(NUM_GRADIENTS)):
                    grads[row + field] = rows[(Index(_SLOPES) + field) * Index(NUM_LANES) + lane]


@kernel_function()
def _write(rows, field, value):
    v8.store(rows, Index(_SLOPES + field) * Index(NUM_LANES), value)


@kernel_function()
def _color_backward(
    sh,
    num_stored_functions,
    num_functions,
    means,
    view,
    slots,
    gaussian_ids,
    group,
    records,
    sums,
    rows,
):
    """Write the rows of colour, and of the mean as far as the direction changes the colour."""
    for lane in range(Index(NUM_LANES)):
        slot = Index(slots[group + lane])
        splat = Index(gaussian_ids[group + lane])
        share = slot * Index(SHARE)
        record = slot * Index(RECORD)
        zeros = np.float32(0)
        red = sums[share + Index(S_RED)] if records[record + Index(L.RED)] > zeros else zeros
        green = sums[share + Index(S_GREEN)] if records[record + Index(L.GREEN)] > zeros else zeros
        blue = sums[share + Index(S_BLUE)] if records[record + Index(L.BLUE)] > zeros else zeros
        rows[Index(_SLOPES + G_COLOR) * Index(NUM_LANES) + lane] = red
        rows[Index(_SLOPES + G_COLOR + 1) * Index(NUM_LANES) + lane] = green
        rows[Index(_SLOPES + G_COLOR + 2) * Index(NUM_LANES) + lane] = blue
        first = splat * num_stored_functions * Index(3)
        for k in range(Index(1), num_functions):
            c = first + k * Index(3)
            rows[k * Index(NUM_LANES) + lane] = (
                red * sh[c] + green * sh[c + Index(1)] + blue * sh[c + Index(2)]
            )
    zeros = v8.broadcast(np.float32(0))
    if num_functions == Index(1):
        for axis in range(3):
            _write(rows, G_MEAN + axis, zeros)
        return
    dx, dy, dz = offsets_from_eye(means, gaussian_ids, group, view)
    inverse = v8.broadcast(np.float32(1)) / v8.sqrt(dot(dx, dy, dz, dx, dy, dz))
    x = dx * inverse
    y = dy * inverse
    z = dz * inverse
    gx, gy, gz = add_direction_slopes(x, y, z, num_functions, rows)
    radial = dot(gx, gy, gz, x, y, z)
    _write(rows, G_MEAN, (gx - radial * x) * inverse)
    _write(rows, G_MEAN + 1, (gy - radial * y) * inverse)
    _write(rows, G_MEAN + 2, (gz - radial * z) * inverse)


@kernel_function()
def _share(sums, slots, at, field):
    """Return one sum of eight splats."""
    return v8.gather(sums, slots, at, Index(SHARE), Index(field))


@kernel_function()
def _geometry_backward(
    means, quats, scales, view, slots, gaussian_ids, group, modes, records, sums, rows
):
    """Write the rows of mean, quaternion, scales and opacity, and those for densification."""
    ones = v8.broadcast(np.float32(1))
    two = v8.broadcast(np.float32(2))
    k = v8.broadcast(np.float32(0.5) * LOG2_E)
    x, y, z = to_camera(offsets_from_eye(means, gaussian_ids, group, view), view)
    inverse = ones / z
    right, down, sizes, jx, jy, m = semi_axes(
        quats, scales, gaussian_ids, group, x, y, inverse, view
    )
    x0, x1, x2 = right
    y0, y1, y2 = down
    s0, s1, s2 = sizes
    blur = v8.broadcast(view[L.V_BLUR])
    xx = dot(x0, x1, x2, x0, x1, x2)
    yy = dot(y0, y1, y2, y0, y1, y2)
    cxx = xx + blur
    cyy = yy + blur
    sharp_x = v8.gather(records, slots, group, Index(RECORD), Index(L.SHARP_X))
    lean_x = v8.gather(records, slots, group, Index(RECORD), Index(L.LEAN_X))
    variance_along_row = k / (sharp_x * sharp_x)

    # The conic: e = ... - sharp^2 (dx - lean dy)^2 - k / cyy dy^2, sharp^2 = k / along.
    sum_0 = _share(sums, slots, group, S_0)
    sum_x = _share(sums, slots, group, S_X)
    inverse_cyy = ones / cyy
    g_along = _share(sums, slots, group, S_XX) / variance_along_row
    g_lean = two * sharp_x * _share(sums, slots, group, S_XY) * inverse_cyy
    g_fall = k * inverse_cyy * inverse_cyy * _share(sums, slots, group, S_YY)
    g_xx = g_along
    g_xy = g_lean - two * lean_x * g_along
    g_yy = lean_x * lean_x * g_along - lean_x * g_lean + g_fall
    if modes[L.M_ANTIALIASED]:
        # log2 of opacity holds half of log2(det / det_blurred), det = |x cross y|^2.
        half = v8.broadcast(np.float32(0.5) * _INVERSE_LN2) * sum_0
        c0 = x1 * y2 - x2 * y1
        c1 = x2 * y0 - x0 * y2
        c2 = x0 * y1 - x1 * y0
        tiny = v8.broadcast(np.float32(1e-30))
        inverse_det = half / v8.maximum(dot(c0, c1, c2, c0, c1, c2), tiny)
        inverse_blurred = half / v8.maximum(variance_along_row * cyy, tiny)
        xy = lean_x * cyy
        g_xx = g_xx + yy * inverse_det - cyy * inverse_blurred
        g_yy = g_yy + xx * inverse_det - cxx * inverse_blurred
        g_xy = g_xy + two * xy * (inverse_blurred - inverse_det)

    g_px = two * sharp_x * sum_x
    fall = k * inverse_cyy
    g_py = two * (fall * _share(sums, slots, group, S_Y) - sharp_x * lean_x * sum_x)
    abs_x = two * sharp_x * _share(sums, slots, group, S_ABS_X)
    abs_y = two * _share(sums, slots, group, S_ABS_Y)
    _write(rows, G_ABS_MEAN, v8.sqrt(v8.fmuladd(abs_x, abs_x, abs_y * abs_y)))
    _write(rows, G_MAX_SIGMA, v8.sqrt(v8.maximum(cxx, cyy)))
    _write(rows, G_OPACITY, v8.broadcast(_INVERSE_LN2) * sum_0)

    # Semi-axes: xx = sum x_j^2, xy = sum x_j y_j, yy = sum y_j^2.
    two_xx = two * g_xx
    two_yy = two * g_yy
    a0 = two_xx * x0 + g_xy * y0
    b0 = g_xy * x0 + two_yy * y0
    a1 = two_xx * x1 + g_xy * y1
    b1 = g_xy * x1 + two_yy * y1
    a2 = two_xx * x2 + g_xy * y2
    b2 = g_xy * x2 + two_yy * y2
    _write(rows, G_SCALE, a0 * x0 + b0 * y0)
    _write(rows, G_SCALE + 1, a1 * x1 + b1 * y1)
    _write(rows, G_SCALE + 2, a2 * x2 + b2 * y2)
    a0 = s0 * a0
    a1 = s1 * a1
    a2 = s2 * a2
    b0 = s0 * b0
    b1 = s1 * b1
    b2 = s2 * b2
    _write_quats(
        quats,
        gaussian_ids,
        group,
        rows,
        (
            a0 * jx[0] + b0 * jy[0],
            a1 * jx[0] + b1 * jy[0],
            a2 * jx[0] + b2 * jy[0],
            a0 * jx[1] + b0 * jy[1],
            a1 * jx[1] + b1 * jy[1],
            a2 * jx[1] + b2 * jy[1],
            a0 * jx[2] + b0 * jy[2],
            a1 * jx[2] + b1 * jy[2],
            a2 * jx[2] + b2 * jy[2],
        ),
    )

    # The Jacobian's rows jx = fx (r - u t) / z, jy = fy (s - v t) / z.
    p0 = dot(a0, a1, a2, m[0], m[1], m[2])
    p1 = dot(a0, a1, a2, m[3], m[4], m[5])
    p2 = dot(a0, a1, a2, m[6], m[7], m[8])
    q0 = dot(b0, b1, b2, m[0], m[1], m[2])
    q1 = dot(b0, b1, b2, m[3], m[4], m[5])
    q2 = dot(b0, b1, b2, m[6], m[7], m[8])
    zeros = v8.broadcast(np.float32(0))
    t = rotation_row(view, Index(2))
    fx = v8.broadcast(view[L.V_FOCAL]) * inverse
    fy = v8.broadcast(view[L.V_FOCAL + 1]) * inverse
    u_low = v8.broadcast(view[L.V_LOW])
    u_high = v8.broadcast(view[L.V_HIGH])
    v_low = v8.broadcast(view[L.V_LOW + 1])
    v_high = v8.broadcast(view[L.V_HIGH + 1])
    raw_u = x * inverse
    raw_v = y * inverse
    free_u = v8.mask_and(v8.at_least(raw_u, u_low), v8.at_least(u_high, raw_u))
    free_v = v8.mask_and(v8.at_least(raw_v, v_low), v8.at_least(v_high, raw_v))
    g_u = v8.select(free_u, zeros - fx * dot(p0, p1, p2, t[0], t[1], t[2]), zeros)
    g_v = v8.select(free_v, zeros - fy * dot(q0, q1, q2, t[0], t[1], t[2]), zeros)
    g_x = (g_u + g_px * v8.broadcast(view[L.V_FOCAL])) * inverse
    g_y = (g_v + g_py * v8.broadcast(view[L.V_FOCAL + 1])) * inverse
    g_z = dot(p0, p1, p2, jx[0], jx[1], jx[2]) + dot(q0, q1, q2, jy[0], jy[1], jy[2])
    g_z = _share(sums, slots, group, S_DEPTH) - g_z * inverse - g_x * raw_u - g_y * raw_v
    for axis in range(3):
        at_axis = Index(_SLOPES + G_MEAN + axis) * Index(NUM_LANES)
        from_color = v8.load(rows, at_axis)
        g = g_x * v8.broadcast(view[axis]) + g_y * v8.broadcast(view[3 + axis])
        v8.store(rows, at_axis, from_color + v8.fmuladd(g_z, v8.broadcast(view[6 + axis]), g))


@kernel_function()
def _write_quats(quats, gaussian_ids, group, rows, g):
    """Write dL by the unit quaternion, without its radial part.

    g: dL by its rotation matrix, row by row.
    """
    two = v8.broadcast(np.float32(2))
    w = v8.gather(quats, gaussian_ids, group, Index(4), Index(0))
    x = v8.gather(quats, gaussian_ids, group, Index(4), Index(1))
    y = v8.gather(quats, gaussian_ids, group, Index(4), Index(2))
    z = v8.gather(quats, gaussian_ids, group, Index(4), Index(3))
    g_w = two * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    g_x = two * (
        w * (g[7] - g[5]) + y * (g[1] + g[3]) + z * (g[2] + g[6]) - two * x * (g[4] + g[8])
    )
    g_y = two * (
        w * (g[2] - g[6]) + x * (g[1] + g[3]) + z * (g[5] + g[7]) - two * y * (g[0] + g[8])
    )
    g_z = two * (
        w * (g[3] - g[1]) + x * (g[2] + g[6]) + y * (g[5] + g[7]) - two * z * (g[0] + g[4])
    )
    radial = v8.fmuladd(g_w, w, dot(g_x, g_y, g_z, x, y, z))
    _write(rows, G_QUAT, g_w - radial * w)
    _write(rows, G_QUAT + 1, g_x - radial * x)
    _write(rows, G_QUAT + 2, g_y - radial * y)
    _write(rows, G_QUAT + 3, g_z - radial * z)
