"""Numba kernel: from gradients of the image to gradients of every splat of every tile's list.

The forward blend is repeated front to back. With q_i = dL/dw_i, the same for all that a weight
w_i = alpha_i T_i is multiplied with, and rest_i = sum of w_j q_j behind splat i,

    dL/dalpha_i = T_i q_i - rest_i / (1 - alpha_i),

where rest starts as the sum over the whole pixel, known from the finished image, and loses w_i q_i
at every splat: no transmittance is ever divided by.

A splat's share of a tile is kept as sums over its pixels of g = dL/de (e: log2 of alpha, see
augment.render.layout) times powers of `off` (sharp pixels off the ridge) and `dy`, from which
cpu_project_backward derives everything geometric. Each list entry has its own place for them, so
nothing is added in an order that depends on threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render import cpu_simd as v8
from augment.render.cpu_blend import alpha_of, is_closed, light_left, shrink
from augment.render.cpu_items import BATCH, ITEMS, find_spans, list_items, stage
from augment.render.cpu_jit import inner, kernel
from augment.render.layout import (
    BLUE,
    DEPTH,
    FALL_Y,
    GREEN,
    LANES,
    LEAN_X,
    MEAN_Y,
    PIXELS,
    RECORD,
    RED,
    SHARP_X,
    STRIP,
    STRIPS,
    TILE_H,
    TILE_W,
    U,
)

# Of a list entry, one cache line: sums of g, g off, g off^2, g dy, g off dy, g dy^2, and of
# |dL/d mean| along x (over 2 sharp) and y (over 2); then dL/d colour (3) and z.
SHARE = 16
S_0, S_X, S_XX, S_Y, S_XY, S_YY, S_ABS_X, S_ABS_Y, S_RED, S_GREEN, S_BLUE, S_DEPTH = range(12)

# Planes of a tile: transmittance as in cpu_blend, what lies behind, and the pixel's gradients.
THROUGH, REST, G_RED, G_GREEN, G_BLUE, G_ALPHA, G_DEPTH = (U(i * PIXELS) for i in range(7))
PLANES = 7 * PIXELS
GROUP = 4  # tiles a thread takes at a time
_LN2 = np.float32(math.log(2))


@kernel
def blend_backward(
    records,
    members,
    starts,
    size,
    limits,
    rgb,
    alpha,
    depth,
    d_rgb,
    d_alpha,
    d_depth,
    shares,
    reached,
):
    """dL of every list entry that the forward blend came to.

    records, members, starts, size, limits: as for cpu_blend.blend_tiles, in one slice. rgb, alpha:
    flat images as rendered. depth: sum of weights times z. d_rgb, d_alpha, d_depth: the loss's
    derivatives by them; depth and d_depth may be None. shares: float32 [entries * SHARE], filled
    up to reached[tile] (int64, tiles) entries of each list.
    """
    columns = (size[0] + TILE_W - 1) // TILE_W
    for group in prange((reached.size + GROUP - 1) // GROUP):
        state = np.empty(PLANES, np.float32)
        staged = np.empty(RECORD * BATCH, np.float32)
        spans = np.empty(2 * BATCH, np.int32)
        values = np.empty(2 * ITEMS, np.float32)
        places = np.empty(2 * ITEMS, np.int32)
        rows = np.empty(2 * STRIPS, np.int64)
        for tile in range(group * GROUP, min((group + 1) * GROUP, reached.size)):
            first, last = starts[tile], starts[tile + 1]
            left, top = tile % columns * TILE_W, tile // columns * TILE_H
            if first < last:
                _load_tile(state, left, top, size, rgb, alpha, depth, d_rgb, d_alpha, d_depth)
            reached[tile] = _replay_list(
                records, members, first, last, np.float32(left), np.float32(top), limits,
                state, staged, spans, values, places, rows, d_depth, shares,
            )  # fmt: skip


@inner()
def _load_tile(state, left, top, size, rgb, alpha, depth, d_rgb, d_alpha, d_depth):
    for pixel in range(U(PIXELS)):
        x = left + np.int64(pixel // U(STRIP) * U(LANES) + pixel % U(LANES))
        y = top + np.int64(pixel % U(STRIP) // U(LANES))
        if x >= size[0] or y >= size[1]:
            state[pixel] = np.float32(-1)
            for plane in range(U(1), U(7)):
                state[plane * U(PIXELS) + pixel] = np.float32(0)
            continue
        at = U(y * size[0] + x)
        first = U(3) * at
        red, green, blue = d_rgb[first], d_rgb[first + U(1)], d_rgb[first + U(2)]
        rest = red * rgb[first] + green * rgb[first + U(1)] + blue * rgb[first + U(2)]
        rest += d_alpha[at] * alpha[at]
        state[pixel] = np.float32(1)
        state[G_RED + pixel] = red
        state[G_GREEN + pixel] = green
        state[G_BLUE + pixel] = blue
        state[G_ALPHA + pixel] = d_alpha[at]
        if d_depth is not None:
            state[G_DEPTH + pixel] = d_depth[at]
            rest += d_depth[at] * depth[at]
        state[REST + pixel] = rest


@inner()
def _replay_list(
    records,
    members,
    first,
    last,
    left,
    top,
    limits,
    state,
    staged,
    spans,
    values,
    places,
    rows,
    d_depth,
    shares,
):
    """Fill the shares of a tile's list as far as light reaches; returns how far that is."""
    for strip in range(STRIPS):
        rows[2 * strip], rows[2 * strip + 1] = 0, TILE_H
        if first < last:
            shrink(state, strip, rows)
    for at in range(first, last, BATCH):
        if is_closed(rows):
            return at - first
        count = min(BATCH, last - at)
        for k in range(U(at + count), U(min(at + 2 * BATCH, last))):
            v8.prefetch(records, U(members[k]) * U(RECORD))
        stage(
            records,
            members,
            U(at),
            U(count),
            left,
            top,
            shares,
            d_depth,
            None,
            None,
            None,
            None,
            staged,
        )
        for i in range(U(at) * U(SHARE), U(at + count) * U(SHARE)):
            shares[i] = np.float32(0)
        for strip in range(STRIPS):
            if rows[2 * strip] >= rows[2 * strip + 1]:
                continue
            find_spans(staged, U(count), strip, rows, limits[1], spans)
            items = list_items(staged, U(count), strip, spans, values, places)
            if items == U(0):
                continue
            places[items] = 0
            item = U(0)
            for k in range(U(count)):
                end = item + U(spans[U(BATCH) + k] - spans[k])
                if end > item:
                    _add_share(
                        state, staged, values, places, k, item, end, limits, d_depth,
                        shares, (U(at) + k) * U(SHARE),
                    )  # fmt: skip
                item = end
            shrink(state, strip, rows)
    return last - first


@inner()
def _add_share(state, staged, values, places, k, item, end, limits, d_depth, shares, share):
    """Blend one splat into its rows of a strip, adding what each pixel says of it."""
    n = U(BATCH)
    alpha_max, log_cut = v8.splat(limits[0]), v8.splat(limits[1])
    least, end_light = v8.splat(limits[2]), v8.splat(limits[7])
    zero, one = v8.splat(np.float32(0)), v8.splat(np.float32(1))
    sharp = staged[U(SHARP_X) * n + k]
    fall = v8.splat(staged[U(FALL_Y) * n + k])
    tilt = v8.splat(-sharp * staged[U(LEAN_X) * n + k])
    steps, ln2 = v8.splat(sharp), v8.splat(_LN2)
    red, green = v8.splat(staged[U(RED) * n + k]), v8.splat(staged[U(GREEN) * n + k])
    blue, z = v8.splat(staged[U(BLUE) * n + k]), zero
    if d_depth is not None:
        z = v8.splat(staged[U(DEPTH) * n + k])
    s0, sx, sxx, sy, sxy, syy = zero, zero, zero, zero, zero, zero
    sr, sg, sb, sz, ax, ay = zero, zero, zero, zero, zero, zero
    for i in range(item, end):
        at = U(places[i + U(ITEMS)])
        row = np.float32(at % U(STRIP) // U(LANES)) + np.float32(0.5)
        dy = v8.splat(row - staged[U(MEAN_Y) * n + k])
        off = v8.fmuladd(steps, v8.lane_numbers(), v8.splat(values[i + U(ITEMS)]))
        e = v8.fmuladd(v8.negate(off), off, v8.splat(values[i]))
        alpha = alpha_of(staged, values, k, i, alpha_max, log_cut)
        through = v8.load(state, at)
        weight = alpha * through
        after = through - weight
        kept = v8.greater(after, least)
        weight = v8.select(kept, weight, zero)
        v8.store(state, at, light_left(through, after, kept, end_light))
        g_red, g_green = v8.load(state, at + G_RED), v8.load(state, at + G_GREEN)
        g_blue = v8.load(state, at + G_BLUE)
        q = v8.fmuladd(g_red, red, v8.load(state, at + G_ALPHA))
        q = v8.fmuladd(g_green, green, q)
        q = v8.fmuladd(g_blue, blue, q)
        if d_depth is not None:
            g_depth = v8.load(state, at + G_DEPTH)
            q = v8.fmuladd(g_depth, z, q)
            sz = v8.fmuladd(weight, g_depth, sz)
        rest = v8.fmuladd(v8.negate(weight), q, v8.load(state, at + REST))
        v8.store(state, at + REST, rest)
        by_alpha = through * q - rest / (one - alpha)
        # Nothing moves an alpha that is cut off, clamped or behind the stop.
        free = v8.both(v8.both(v8.at_least(e, log_cut), kept), v8.greater(alpha_max, alpha))
        g = v8.select(free, by_alpha * alpha * ln2, zero)
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
    color = v8.totals(sr, sg, sb, sz, zero, zero, zero, zero)
    v8.store(shares, share + U(8), v8.load(shares, share + U(8)) + color)


@kernel
def sum_shares(members, starts, reached, shares, ranges, sums, touched):
    """Every slot's shares of all tiles, added in the order of the tiles.

    Each of `ranges` runs of slots looks at all entries and takes its own, so the order of addition
    depends on nothing. sums: float32 [slots * SHARE]; touched: uint8 [slots], 1 where any entry
    was reached; both are filled.
    """
    slots = touched.size
    for run in prange(ranges):
        low, high = U(slots * run // ranges), U(slots * (run + 1) // ranges)
        for slot in range(low, high):
            touched[slot] = 0
        for tile in range(reached.size):
            for entry in range(U(starts[tile]), U(starts[tile] + reached[tile])):
                slot = U(members[entry])
                if slot < low or slot >= high:
                    continue
                at, share = slot * U(SHARE), entry * U(SHARE)
                if touched[slot] == 0:
                    touched[slot] = 1
                    for i in range(U(0), U(SHARE), U(LANES)):
                        v8.store(sums, at + i, v8.load(shares, share + i))
                else:
                    for i in range(U(0), U(SHARE), U(LANES)):
                        total = v8.load(sums, at + i) + v8.load(shares, share + i)
                        v8.store(sums, at + i, total)
