"""Numba kernels: order splats by depth, and list them tile by tile in that order."""

from __future__ import annotations

import numba
import numpy as np

from augment.render.cpu_jit import kernel, serial_kernel
from augment.render.cpu_layout import BLOCK, U

RADIX_BITS = 11
_DIGITS = 1 << RADIX_BITS


@kernel()
def list_splats(records_z, counts, keys, slots):
    """Sort keys (bits of z) and slots of all splats that blocks hold, in index order.

    records_z: uint32 [B BLOCK], every record's z. Returns how many there are, and the range of keys.
    """
    blocks = counts.size
    starts = np.zeros(blocks + 1, np.int64)
    lows = np.empty(blocks, np.uint32)
    highs = np.empty(blocks, np.uint32)
    for b in range(blocks):
        starts[b + 1] = starts[b] + counts[b]
    for b in numba.prange(blocks):
        low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
        for i in range(counts[b]):
            key = records_z[b * BLOCK + i]
            keys[starts[b] + i] = key
            slots[starts[b] + i] = b * BLOCK + i
            low, high = min(low, key), max(high, key)
        lows[b], highs[b] = low, high
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    for b in range(blocks):
        low, high = min(low, lows[b]), max(high, highs[b])
    return starts[blocks], low, high


@kernel()
def radix_pass(keys_in, slots_in, keys_out, slots_out, low, shift, runs):
    """One stable counting sort by RADIX_BITS bits of key - low, in `runs` pieces of work."""
    total = keys_in.size
    heads = np.zeros((runs, _DIGITS), np.int64)
    for run in numba.prange(runs):
        head = heads[run]
        for i in range(total * run // runs, total * (run + 1) // runs):
            head[U((keys_in[i] - low) >> shift) & U(_DIGITS - 1)] += 1
    at = 0
    for digit in range(_DIGITS):
        for run in range(runs):
            count = heads[run, digit]
            heads[run, digit] = at
            at += count
    for run in numba.prange(runs):
        head = heads[run]
        for i in range(total * run // runs, total * (run + 1) // runs):
            digit = U((keys_in[i] - low) >> shift) & U(_DIGITS - 1)
            to = U(head[digit])
            head[digit] += 1
            keys_out[to] = keys_in[i]
            slots_out[to] = slots_in[i]


@kernel()
def sort_rects(order, rects, sorted_rects, runs):
    """Tiles of every splat in depth order. Returns how many (splat, tile) pairs there are."""
    total = order.size
    pairs = np.zeros(runs, np.int64)
    for run in numba.prange(runs):
        found = np.int64(0)
        for i in range(total * run // runs, total * (run + 1) // runs):
            slot = order[i]
            c0, r0 = np.int64(rects[slot, 0]), np.int64(rects[slot, 1])
            c1, r1 = np.int64(rects[slot, 2]), np.int64(rects[slot, 3])
            sorted_rects[i, 0], sorted_rects[i, 1] = c0, r0
            sorted_rects[i, 2], sorted_rects[i, 3] = c1, r1
            found += (c1 - c0 + 1) * (r1 - r0 + 1)
        pairs[run] = found
    found = np.int64(0)
    for run in range(runs):
        found += pairs[run]
    return found


@serial_kernel()
def next_cut(sorted_rects, first, limit):
    """Past the last splat for which those from `first` on make no more than `limit` pairs.

    At least one splat, whatever it covers.
    """
    pairs = np.int64(0)
    for i in range(first, sorted_rects.shape[0]):
        across = np.int64(sorted_rects[i, 2]) - np.int64(sorted_rects[i, 0]) + 1
        down = np.int64(sorted_rects[i, 3]) - np.int64(sorted_rects[i, 1]) + 1
        pairs += across * down
        if pairs > limit and i > first:
            return i
    return sorted_rects.shape[0]


@kernel()
def count_pairs(sorted_rects, first, last, columns, open_tiles, heads, bands):
    """Splats [first, last) of every open tile. heads: int64 [tiles]; bands of rows share the work.

    A thread sees every splat but writes its own tiles only, so that lists stay in order and in its
    cache.
    """
    tile_rows = heads.size // columns
    for band in numba.prange(bands):
        top, bottom = tile_rows * band // bands, tile_rows * (band + 1) // bands - 1
        for tile in range(top * columns, (bottom + 1) * columns):
            heads[tile] = 0
        for i in range(first, last):
            r0, r1 = np.int64(sorted_rects[i, 1]), np.int64(sorted_rects[i, 3])
            if r1 < top or r0 > bottom:
                continue
            c0, c1 = np.int64(sorted_rects[i, 0]), np.int64(sorted_rects[i, 2])
            for row in range(max(r0, top), min(r1, bottom) + 1):
                for tile in range(row * columns + c0, row * columns + c1 + 1):
                    heads[U(tile)] += open_tiles[U(tile)] != 0


@serial_kernel()
def place_lists(heads, starts):
    """Where every tile's list begins: starts int64 [tiles + 1]; heads become write positions."""
    at = np.int64(0)
    for tile in range(heads.size):
        starts[tile] = at
        at += heads[tile]
        heads[tile] = starts[tile]
    starts[heads.size] = at
    return at


@kernel()
def fill_lists(order, sorted_rects, first, last, columns, open_tiles, heads, members, bands):
    """Slots of every open tile's splats, nearest first."""
    tile_rows = heads.size // columns
    for band in numba.prange(bands):
        top, bottom = tile_rows * band // bands, tile_rows * (band + 1) // bands - 1
        for i in range(first, last):
            r0, r1 = np.int64(sorted_rects[i, 1]), np.int64(sorted_rects[i, 3])
            if r1 < top or r0 > bottom:
                continue
            slot = order[i]
            c0, c1 = np.int64(sorted_rects[i, 0]), np.int64(sorted_rects[i, 2])
            for row in range(max(r0, top), min(r1, bottom) + 1):
                for tile in range(row * columns + c0, row * columns + c1 + 1):
                    if open_tiles[U(tile)]:
                        at = heads[U(tile)]
                        members[U(at)] = slot
                        heads[U(tile)] = at + 1
