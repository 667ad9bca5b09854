"""Numba kernels: order splats by depth, and list them tile by tile in that order.

The projection has counted each block's splats by bins of z. Sorting moves them to their bins, block
after block, then sorts every bin within the cache; both keep equal depths in index order.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.render.cpu_jit import inner, kernel
from augment.render.layout import BIN_SHIFT, BLOCK, U

_DIGIT_BITS = BIN_SHIFT // 2  # what z bins leave to sort, in two passes
_DIGITS = 1 << _DIGIT_BITS
_FEW = 32  # splats sorted faster by insertion


@kernel
def scatter_to_bins(keys, found, first_bin, heads, binned_keys, binned_slots):
    """Copy every block's keys, and the slots they stand for, to their bins.

    keys: uint32 [B BLOCK], bits of z. found: int64 [B], how many each block has. heads: int64
    [B, Z], where each block writes its splats of each bin; used up.
    """
    for block in prange(found.size):
        for i in range(found[block]):
            slot = block * BLOCK + i
            key = keys[slot]
            z_bin = np.int64(key >> np.uint32(BIN_SHIFT)) - first_bin
            at = heads[block, z_bin]
            heads[block, z_bin] = at + 1
            binned_keys[at] = key
            binned_slots[at] = slot


@kernel
def sort_bins(bin_starts, keys, slots, rects, spare_keys, spare_slots, sorted_rects):
    """Sort every bin [bin_starts[z], bin_starts[z + 1]) by key; gather the splats' tiles alike."""
    for z_bin in prange(bin_starts.size - 1):
        first, last = bin_starts[z_bin], bin_starts[z_bin + 1]
        if last - first <= _FEW:
            _sort_few(keys, slots, first, last)
        else:
            heads = np.empty(_DIGITS, np.int64)
            _sort_digit(keys, slots, spare_keys, spare_slots, first, last, 0, heads)
            _sort_digit(spare_keys, spare_slots, keys, slots, first, last, _DIGIT_BITS, heads)
        for i in range(U(first), U(last)):
            sorted_rects[i] = rects[U(slots[i])]


@inner()
def _sort_few(keys, slots, first, last):
    for i in range(first + 1, last):
        key, slot = keys[i], slots[i]
        j = i
        while j > first and keys[j - 1] > key:
            keys[j], slots[j] = keys[j - 1], slots[j - 1]
            j -= 1
        keys[j], slots[j] = key, slot


@inner()
def _sort_digit(keys, slots, to_keys, to_slots, first, last, shift, heads):
    """One stable counting sort by a digit of the key."""
    mask = U(_DIGITS - 1)
    for digit in range(_DIGITS):
        heads[digit] = 0
    for i in range(U(first), U(last)):
        heads[(U(keys[i]) >> U(shift)) & mask] += 1
    at = first
    for digit in range(_DIGITS):
        count = heads[digit]
        heads[digit] = at
        at += count
    for i in range(U(first), U(last)):
        digit = (U(keys[i]) >> U(shift)) & mask
        at = heads[digit]
        heads[digit] = at + 1
        to_keys[U(at)] = keys[i]
        to_slots[U(at)] = slots[i]


@inner()
def _unpack(rect):
    """First column and row, last column and row of a splat's tiles."""
    mask = U(0xFFFF)
    return rect & mask, (rect >> U(16)) & mask, (rect >> U(32)) & mask, rect >> U(48)


@kernel
def count_corners(sorted_rects, first, last, columns, corners):
    """Where rectangles of tiles begin and end: +1 and -1 at the corners of each.

    corners: int32 [C, (rows + 1) (columns + 1)], each of C runs of splats its own; summed over
    itself from the top left it says how many splats touch each tile.
    """
    runs = corners.shape[0]
    width = U(columns + 1)
    for run in prange(runs):
        for i in range(corners.shape[1]):
            corners[run, i] = 0
        own = corners[run]
        start = first + (last - first) * run // runs
        for i in range(U(start), U(first + (last - first) * (run + 1) // runs)):
            c0, r0, c1, r1 = _unpack(sorted_rects[i])
            top, bottom = r0 * width, (r1 + U(1)) * width
            own[top + c0] += 1
            own[top + c1 + U(1)] -= 1
            own[bottom + c0] -= 1
            own[bottom + c1 + U(1)] += 1


@kernel
def fill_lists(slots, sorted_rects, first, last, columns, heads, members, bands):
    """Slots of every open tile's splats, nearest first. Bands of rows share the work.

    heads: int64 [tiles], where each tile's list begins; negative where it has none; used up.
    A thread looks at every splat but writes its own tiles only, so lists stay in order and in its
    cache.
    """
    rows = heads.size // columns
    for band in prange(bands):
        top, bottom = rows * band // bands, rows * (band + 1) // bands - 1
        for i in range(U(first), U(last)):
            c0, r0, c1, r1 = _unpack(sorted_rects[i])
            for row in range(max(r0, U(top)), min(r1, U(bottom)) + U(1)):
                base = row * U(columns)
                for tile in range(base + c0, base + c1 + U(1)):
                    at = heads[tile]
                    if at >= 0:
                        members[U(at)] = slots[i]
                        heads[tile] = at + 1
