"""Numba kernels that list splats tile by tile and blend them front to back.

A tile's list is blended batch by batch. In each strip of the tile the items of a batch
(geometry.list_items) are blended in turn. Strips shrink to the rows in which a pixel still lets
light through, and a tile is finished when no row is left.

The kernel is compiled twice: for colour and alpha alone (`buffer_bits` is None), and for all
images, where `buffer_bits` says which images there are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from augment.render import layout as L
from augment.render.constants import DEPTH_EPS
from augment.render.cpu import simd as v8
from augment.render.cpu.geometry import (
    BATCH,
    ITEMS,
    L_BLUE,
    L_GREEN,
    L_RED,
    LINES,
    LIT,
    PLACES,
    SHARE,
    STARTS,
    SURFACE,
    find_spans,
    is_lit,
    kept_share,
    light_share,
    list_items,
    list_lines,
    stage,
    stage_cuts,
    stage_lights,
    surface_depth,
)
from augment.render.cpu.jit import kernel, kernel_function
from augment.render.cpu.simd import ROWS, WIDE
from augment.render.layout import (
    BIN_SHIFT,
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
from augment.render.mode_depth import BETA_PER_SIGMA, FARTHER, GAMMA, NEARER

# ---- Numba kernels: order splats by depth, and list them tile by tile in that order --------------
# The projection has counted each block's splats by bins of z. Sorting moves them to their bins,
# block after block, then sorts every bin within the cache; both keep equal depths in index order.

# Bits of a digit of the key. Two digits are the bits that bins of z leave to sort.
_DIGIT_BITS = BIN_SHIFT // 2
# Number of a digit's values.
_DIGITS = 1 << _DIGIT_BITS
# Largest number of splats that insertion sorts faster.
_MAX_INSERTION_SORT = 32


@kernel
def scatter_to_bins(keys, splat_counts, first_bin, heads, binned_keys, binned_slots):
    """Copy every block's keys, and the slots that they stand for, to their bins.

    Args:
        keys: uint32 [B BLOCK_SIZE], bits of z.
        splat_counts: int64 [B], splats of each block.
        first_bin: number of the first bin.
        heads: int64 [B, Z], position where each block writes its splats of each bin; used up.
        binned_keys, binned_slots: written.
    """
    for block in prange(splat_counts.size):
        for i in range(splat_counts[block]):
            slot = block * BLOCK_SIZE + i
            key = keys[slot]
            z_bin = np.int64(key >> np.uint32(BIN_SHIFT)) - first_bin
            position = heads[block, z_bin]
            heads[block, z_bin] = position + 1
            binned_keys[position] = key
            binned_slots[position] = slot


@kernel
def sort_bins(bin_starts, keys, slots, rects, spare_keys, spare_slots, sorted_rects):
    """Sort every bin [bin_starts[z], bin_starts[z + 1]) by key, and gather the splats' tiles in
    that order.
    """
    for z_bin in prange(bin_starts.size - 1):
        first = bin_starts[z_bin]
        last = bin_starts[z_bin + 1]
        if last - first <= _MAX_INSERTION_SORT:
            _sort_few(keys, slots, first, last)
        else:
            heads = np.empty(_DIGITS, np.int64)
            _sort_digit(keys, slots, spare_keys, spare_slots, first, last, 0, heads)
            _sort_digit(spare_keys, spare_slots, keys, slots, first, last, _DIGIT_BITS, heads)
        for i in range(Index(first), Index(last)):
            sorted_rects[i] = rects[Index(slots[i])]


@kernel_function()
def _sort_few(keys, slots, first, last):
    """Sort a few splats by insertion."""
    for i in range(first + 1, last):
        key = keys[i]
        slot = slots[i]
        j = i
        while j > first and keys[j - 1] > key:
            keys[j], slots[j] = keys[j - 1], slots[j - 1]
            j -= 1
        keys[j] = key
        slots[j] = slot


@kernel_function()
def _sort_digit(keys, slots, to_keys, to_slots, first, last, shift, heads):
    """Run one stable counting sort by a digit of the key."""
    mask = Index(_DIGITS - 1)
    for digit in range(_DIGITS):
        heads[digit] = 0
    for i in range(Index(first), Index(last)):
        heads[(Index(keys[i]) >> Index(shift)) & mask] += 1
    at = first
    for digit in range(_DIGITS):
        count = heads[digit]
        heads[digit] = at
        at += count
    for i in range(Index(first), Index(last)):
        digit = (Index(keys[i]) >> Index(shift)) & mask
        at = heads[digit]
        heads[digit] = at + 1
        to_keys[Index(at)] = keys[i]
        to_slots[Index(at)] = slots[i]


@kernel_function()
def _unpack_rect(rect):
    """Return first column and row, last column and row of a splat's tiles."""
    mask = Index(0xFFFF)
    return rect & mask, (rect >> Index(16)) & mask, (rect >> Index(32)) & mask, rect >> Index(48)


@kernel
def count_corners(sorted_rects, first, last, columns, corners):
    """Count where rectangles of tiles begin and end: +1 and -1 at the corners of each.

    The cumulative sum of the corners, from the top left, is the number of splats that touch each
    tile.

    corners: int32 [C, (rows + 1) (columns + 1)], written; each of C runs of splats has its own.
    """
    num_runs = corners.shape[0]
    width = Index(columns + 1)
    for run in prange(num_runs):
        for i in range(corners.shape[1]):
            corners[run, i] = 0
        run_corners = corners[run]
        start = first + (last - first) * run // num_runs
        for i in range(Index(start), Index(first + (last - first) * (run + 1) // num_runs)):
            c0, r0, c1, r1 = _unpack_rect(sorted_rects[i])
            top = r0 * width
            bottom = (r1 + Index(1)) * width
            run_corners[top + c0] += 1
            run_corners[top + c1 + Index(1)] -= 1
            run_corners[bottom + c0] -= 1
            run_corners[bottom + c1 + Index(1)] += 1


@kernel
def fill_lists(slots, sorted_rects, first, last, columns, heads, tile_splat_ids, bands):
    """Write the slots of every open tile's splats, nearest first. Bands of tile rows share the
    work.

    A thread reads every splat but writes only its own tiles. So lists stay in order and in the
    thread's cache.

    heads: int64 [tiles], position where each tile's list begins, negative for a tile without one;
    used up.
    """
    rows = heads.size // columns
    for band in prange(bands):
        top = rows * band // bands
        bottom = rows * (band + 1) // bands - 1
        for i in range(Index(first), Index(last)):
            c0, r0, c1, r1 = _unpack_rect(sorted_rects[i])
            for row in range(max(r0, Index(top)), min(r1, Index(bottom)) + Index(1)):
                base = row * Index(columns)
                for tile in range(base + c0, base + c1 + Index(1)):
                    at = heads[tile]
                    if at >= 0:
                        tile_splat_ids[Index(at)] = slots[i]
                        heads[tile] = at + 1


# ---- Numba functions: mode depth, item by item (see augment.render.mode_depth) -------------------
# Comparisons are multiplied by the cluster's weight, so that a sample that joins costs no division
# and no root.

# Planes of a tile, from the caller's position on. For the running cluster: the depth with which it
# began, and the sums of w, w (z - first) and w (z - first)^2. For the heaviest cluster: its weight
# and its mode.
FIRST, MASS, MOMENT, SQUARE, HEAVIEST, MODE = (Index(i * PIXELS) for i in range(6))
MODE_PLANES = 6

# Limits of mode_depth, over the spread in beta and over its square.
_FARTHER = np.float32(FARTHER)
_NEARER = np.float32(NEARER)
_FARTHER_2 = np.float32((FARTHER * BETA_PER_SIGMA) ** 2)
_NEARER_2 = np.float32((NEARER * BETA_PER_SIGMA) ** 2)
# Distance of a cluster's mode before its mean, over its standard deviation.
_MODE_SHIFT = np.float32(GAMMA * BETA_PER_SIGMA)
# Margin for the rounding of a sum of weights, far larger than the rounding.
_SLACK = np.float32(1e-4)


@kernel_function()
def add_sample(state, at, depth, weight, floor):
    """Add the next samples of an item's pixels to their clusters.

    state, at: a tile's state, and the position of the pixels in the plane FIRST.
    """
    zeros = v8.broadcast_as(depth, np.float32(0))
    minus_ones = v8.broadcast_as(depth, np.float32(-1))
    first_depth = v8.load_as(depth, state, at + FIRST)
    mass = v8.load_as(depth, state, at + MASS)
    moment = v8.load_as(depth, state, at + MOMENT)
    square = v8.load_as(depth, state, at + SQUARE)
    depth_offset = depth - first_depth
    mass_offset = v8.fmuladd(depth_offset, mass, v8.negate(moment))  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = v8.at_least(mass_offset, zeros)
    reach = v8.select(is_farther, v8.broadcast_as(depth, _FARTHER), v8.broadcast_as(depth, _NEARER))
    reach_2 = v8.select(
        is_farther, v8.broadcast_as(depth, _FARTHER_2), v8.broadcast_as(depth, _NEARER_2)
    )
    floor_margin = v8.broadcast_as(depth, floor) * reach * mass - v8.absolute(mass_offset)
    spread_margin = v8.fmuladd(reach_2, spread, v8.negate(mass_offset * mass_offset))
    has_joined = v8.greater(v8.maximum(floor_margin, spread_margin), zeros)
    new_cluster_sign = v8.select(
        has_joined, minus_ones, v8.select(v8.greater(weight, zeros), zeros, minus_ones)
    )
    if v8.has_nonnegative_lane(new_cluster_sign):
        is_new = v8.at_least(new_cluster_sign, zeros)
        best = v8.load_as(depth, state, at + HEAVIEST)
        is_heavier = v8.mask_and(is_new, v8.greater(mass, best))
        mode = v8.select(
            is_heavier,
            _mode(first_depth, mass, moment, spread),
            v8.load_as(depth, state, at + MODE),
        )
        v8.store(state, at + HEAVIEST, v8.select(is_heavier, mass, best))
        v8.store(state, at + MODE, mode)
        v8.store(state, at + FIRST, v8.select(is_new, depth, first_depth))
        depth_offset = v8.select(is_new, zeros, depth_offset)
        mass = v8.select(is_new, zeros, mass)
        moment = v8.select(is_new, zeros, moment)
        square = v8.select(is_new, zeros, square)
    weighted = weight * depth_offset
    v8.store(state, at + MASS, mass + weight)
    v8.store(state, at + MOMENT, moment + weighted)
    v8.store(state, at + SQUARE, v8.fmuladd(weighted, depth_offset, square))


@kernel_function()
def can_grow(state, at, transmittance):
    """Return numbers that are not negative where the running cluster is the heaviest or may become
    it.

    transmittance: transmittance of the pixels, negative where blending has stopped.
    """
    minus_ones = v8.broadcast_as(transmittance, np.float32(-1))
    mass = v8.load_as(transmittance, state, at + MASS)
    best = v8.load_as(transmittance, state, at + HEAVIEST)
    possible_gain = mass + transmittance + v8.broadcast_as(transmittance, _SLACK) - best
    return v8.select(
        v8.greater(transmittance, v8.broadcast_as(transmittance, np.float32(0))),
        possible_gain,
        minus_ones,
    )


@kernel_function()
def close_clusters(state, start):
    """Compare the last cluster, too, and leave the result in the plane MODE."""
    for i in range(Index(0), Index(PIXELS), Index(NUM_LANES)):
        at = Index(start) + i
        first_depth = v8.load(state, at + FIRST)
        mass = v8.load(state, at + MASS)
        moment = v8.load(state, at + MOMENT)
        square = v8.load(state, at + SQUARE)
        mode = _mode(first_depth, mass, moment, _spread(mass, moment, square))
        is_heavier = v8.greater(mass, v8.load(state, at + HEAVIEST))
        v8.store(state, at + MODE, v8.select(is_heavier, mode, v8.load(state, at + MODE)))


@kernel_function()
def _spread(mass, moment, square):
    """Return mass^2 times the variance."""
    spread = v8.fmuladd(mass, square, v8.negate(moment * moment))
    return v8.maximum(spread, v8.broadcast_as(spread, np.float32(0)))


@kernel_function()
def _mode(first, mass, moment, spread):
    """Return the mode of a cluster."""
    return first + (moment - v8.broadcast_as(first, _MODE_SHIFT) * v8.sqrt(spread)) / mass


# Tiles that a thread takes at a time.
GROUP = 8
# float32 numbers of a cache line.
LINE = 16

# Planes of a tile's state, PIXELS float32 each, strip after strip, row after row. The transmittance
# is negative where blending has stopped; its absolute value is then the final one. An image needs
# its plane and all planes before it, so the most expensive ones come last.
TRANSMITTANCE, P_RED, P_GREEN, P_BLUE, P_OVERLAY = (Index(i * PIXELS) for i in range(5))
P_DEPTH, P_MEDIAN, P_BEST, P_ID, P_MODE = (Index(i * PIXELS) for i in range(5, 10))
# Numbers of a state for colour and alpha, for overlay besides, for all but mode depth, and for all.
COLOR_STATE = 4 * PIXELS
OVERLAY_STATE = 5 * PIXELS
MODELESS_STATE = 9 * PIXELS
STATE = MODELESS_STATE + MODE_PLANES * PIXELS

# Status of a finished tile.
CLOSED = 0
# Status of a tile that is being blended.
OPEN = 1
# Status of a tile that no splat has reached.
FRESH = 2


# Bits of `buffer_bits`: the images, in the order of BUFFERS; then CLIP if splats have cuts, CUT if
# a splat of the batch at hand is cut, and LIT_RGB if colour depends on splats' lights.
RGB, ALPHA, EXPECTED, MEDIAN, IDS, MODES, OVERLAY, CLIP, CUT, LIT_RGB = (1 << i for i in range(10))
# Images of depths that a cut bends.
SURFACES = EXPECTED | MODES
# Images that most pixels have finished early in their list.
ORDERED = MEDIAN | IDS | MODES


class Images(NamedTuple):
    """Flat images to write, in the order of BUFFERS; an image that was not asked for is empty."""

    rgb: Any
    alpha: Any
    expected: Any
    median: Any
    ids: Any
    mode: Any
    overlay: Any


class TileSplats(NamedTuple):
    """Splats that tiles blend.

    records: records of all slots, flat (see layout).
    cuts: cuts of all slots, flat (see layout).
    lights: lights of all slots, flat (see geometry).
    tile_splat_ids: slots of every tile's list, tile after tile.
    tile_offsets: position where each tile's list begins.
    """

    records: Any
    cuts: Any
    lights: Any
    tile_splat_ids: Any
    tile_offsets: Any


class Frame(NamedTuple):
    """Numbers of the image.

    size: image width and height.
    limits: float32: alpha_max; log2(ALPHA_MIN); transmittance that a splat must exceed behind it to
        be blended; 1 for parallel rays; mode depth's floor; 1/fx^2; 1/fy^2; transmittance at which
        a pixel is finished.
    """

    size: Any
    limits: Any


class Work(NamedTuple):
    """A tile's state, and the arrays of a batch of its splats (see geometry)."""

    state: Any
    staged: Any
    spans: Any
    starts: Any
    values: Any
    places: Any
    rows: Any
    lines: Any
    edges: Any
    surfaces: Any
    staged_lights: Any


@kernel
def blend_tiles(splats, tiles, states, is_last, frame, images, buffer_bits):
    """Blend one slice of z into every open tile, and write the pixels of the tiles that are
    finished.

    Args:
        splats: splats of the slice.
        tiles: uint8 [tiles], CLOSED, OPEN or FRESH, updated.
        states: float32 [tiles * numbers of a state], state of open tiles between slices.
        is_last: if True, all tiles are finished.
        frame: numbers of the image.
        images: images to write.
        buffer_bits: images that are asked for, or None for RGB and alpha.
    """
    for group in prange((tiles.size + GROUP - 1) // GROUP):
        _blend_group(np.int64(group), splats, tiles, states, is_last, frame, images, buffer_bits)


@kernel_function()
def _blend_group(group, splats, tiles, states, is_last, frame, images, buffer_bits):
    """Blend the tiles of one group."""
    size = frame.size
    columns = (size[0] + TILE_W - 1) // TILE_W
    state_size = states.size // tiles.size
    work = Work(
        aligned_floats(STATE + LINE),  # v8.load_row reads one number beyond the state
        aligned_floats(RECORD * BATCH),
        np.empty(2 * BATCH, np.int32),
        aligned_floats(STARTS),
        np.empty(2 * ITEMS, np.float32),
        np.empty(ITEMS, np.int32),
        np.empty(2 * STRIPS, np.int64),
        np.empty(LINES, np.float32),
        np.empty(ITEMS, np.float32),
        np.empty(ITEMS, np.float32),
        np.empty(LIT, np.float32),
    )
    state = work.state
    for tile in range(group * GROUP, min((group + 1) * GROUP, tiles.size)):
        first = splats.tile_offsets[tile]
        last = splats.tile_offsets[tile + 1]
        if tiles[tile] == CLOSED or (first == last and not is_last):
            continue
        left = tile % columns * TILE_W
        top = tile // columns * TILE_H
        # State of the tile before this slice.
        if tiles[tile] == FRESH:
            _clear(state, state_size, size[0] - left, size[1] - top)
        else:
            _copy(states, Index(tile * state_size), state, Index(0), Index(state_size))
        # Fetch the pixels' cache lines for writing.
        for y in range(min(TILE_H, size[1] - top)):
            at = Index((top + y) * size[0] + left)
            v8.prefetch_to_write(images.alpha, at)
            if buffer_bits is None or buffer_bits & RGB:
                for line in range(Index(0), Index(3 * TILE_W), Index(LINE)):
                    v8.prefetch_to_write(images.rgb, Index(3) * at + line)
        corner = (np.float32(left), np.float32(top))
        is_open = _blend_list(splats, first, last, corner, frame.limits, buffer_bits, work)
        # Keep the state for the next slice, or write the pixels.
        if is_open and not is_last:
            _copy(state, Index(0), states, Index(tile * state_size), Index(state_size))
            tiles[tile] = OPEN
        else:
            if buffer_bits is not None and buffer_bits & MODES:
                close_clusters(state, P_MODE)
            _write_pixels(state, left, top, size, images, buffer_bits)
            tiles[tile] = CLOSED


@kernel_function()
def aligned_floats(count):
    """Return `count` float32 numbers that begin at a cache line."""
    buffer = np.empty(count + LINE, np.float32)
    start_offset = (Index(buffer.ctypes.data) // Index(buffer.itemsize)) % Index(LINE)
    return buffer[LINE - np.int64(start_offset) :][:count]


@kernel_function()
def _copy(source, source_at, target, target_at, count):
    for i in range(Index(0), count, Index(NUM_LANES)):
        v8.store(target, target_at + i, v8.load(source, source_at + i))


@kernel_function()
def _clear(state, state_size, width, height):
    """Set a tile to its state before the first splat; pixels beyond the image count as finished."""
    no_splat_id = np.int32(-1).view(np.float32)
    for i in range(Index(0), Index(state_size), Index(NUM_LANES)):
        value = np.float32(1) if i < P_RED else np.float32(0)
        value = no_splat_id if P_ID <= i < P_MODE else value
        v8.store(state, i, v8.broadcast(value))
    if width < TILE_W or height < TILE_H:
        for y in range(TILE_H):
            for x in range(TILE_W):
                if x >= width or y >= height:
                    state[_place_of(x, y)] = np.float32(-1)


@kernel_function()
def _place_of(x, y):
    """Return the position of a tile's pixel in a plane of its state."""
    row = x // NUM_LANES * TILE_H + y
    return row // ROWS * WIDE + x % NUM_LANES * ROWS + row % ROWS


@kernel_function()
def _blend_list(splats, first, last, corner, limits, buffer_bits, work):
    """Blend a tile's list into its state. Return True if any pixel still lets light through."""
    state = work.state
    staged = work.staged
    spans = work.spans
    rows = work.rows
    records = splats.records
    ids = splats.tile_splat_ids
    columns = v8.wide_columns()
    # Open rows of every strip.
    for strip in range(STRIPS):
        rows[2 * strip] = 0
        rows[2 * strip + 1] = TILE_H
        shrink(state, strip, rows, columns)
    for at in range(first, last, BATCH):
        if is_closed(rows):
            return False
        count = Index(min(BATCH, last - at))
        # Fetch the next batch's records, then transpose this batch's records, lights and cuts.
        for k in range(Index(at) + count, Index(min(at + 2 * BATCH, last))):
            v8.prefetch(records, Index(ids[k]) * Index(RECORD))
        stage(records, ids, Index(at), count, corner, staged)
        any_cut = False
        if buffer_bits is not None:
            if buffer_bits & LIT_RGB:
                stage_lights(splats.lights, ids, Index(at), count, work.staged_lights)
            if buffer_bits & CLIP:
                has_surfaces = buffer_bits & SURFACES != 0
                any_cut = stage_cuts(
                    splats.cuts, ids, Index(at), count, staged, has_surfaces, work.lines
                )
        # Strip by strip, list the items of the batch and blend them.
        for strip in range(STRIPS):
            if rows[2 * strip] >= rows[2 * strip + 1]:
                continue
            span_bits = find_spans(staged, count, strip, rows, limits[1], spans, work.starts)
            if span_bits == Index(0):
                continue
            items = list_items(
                staged,
                span_bits,
                Index(strip),
                spans,
                work.starts,
                columns,
                work.values,
                work.places,
            )
            batch_bits = buffer_bits
            if buffer_bits is not None:
                if buffer_bits & CLIP and buffer_bits & SURFACES:
                    list_lines(
                        work.lines, SURFACE, span_bits, spans, Index(strip), columns, work.surfaces
                    )
                if any_cut:
                    list_lines(
                        work.lines, SHARE, span_bits, spans, Index(strip), columns, work.edges
                    )
                    batch_bits = buffer_bits | CUT
                elif buffer_bits & ORDERED and not _can_change(
                    state, strip, rows, buffer_bits, columns
                ):
                    batch_bits = buffer_bits & ~ORDERED
            _blend_items(work, items, columns, limits, batch_bits)
            shrink(state, strip, rows, columns)
    return not is_closed(rows)


@kernel_function()
def _can_change(state, strip, rows, buffer_bits, columns):
    """Return True if a pixel of the strip may still find its median depth or a heavier splat or
    cluster.

    It finds none once its transmittance has fallen below one half and the best weight so far. Most
    pixels reach that early; the remaining list then costs them no more than colour does.
    """
    possible_gain = v8.broadcast_as(columns, np.float32(-1))
    half = v8.broadcast_as(columns, np.float32(0.5))
    for row in range(rows[2 * strip] // ROWS * ROWS, rows[2 * strip + 1], ROWS):
        at = Index(strip * STRIP + row * NUM_LANES)
        transmittance = v8.load_as(columns, state, at)
        if buffer_bits & MEDIAN:
            possible_gain = v8.maximum(possible_gain, transmittance - half)
        if buffer_bits & IDS:
            possible_gain = v8.maximum(
                possible_gain, transmittance - v8.load_as(columns, state, at + P_BEST)
            )
        if buffer_bits & MODES:
            possible_gain = v8.maximum(possible_gain, can_grow(state, at + P_MODE, transmittance))
    return v8.has_nonnegative_lane(possible_gain)


@kernel_function()
def is_closed(rows):
    """Return True if no strip has an open row."""
    has_no_open_row = True
    for strip in range(STRIPS):
        has_no_open_row = has_no_open_row and rows[2 * strip] >= rows[2 * strip + 1]
    return has_no_open_row


@kernel_function()
def shrink(state, strip, rows, columns):
    """Leave out a strip's first and last rows while none of their pixels is open."""
    low = rows[2 * strip]
    high = rows[2 * strip + 1]
    while low < high and not _is_open(state, strip, low, columns):
        low += 1
    while low < high and not _is_open(state, strip, high - 1, columns):
        high -= 1
    rows[2 * strip] = low
    rows[2 * strip + 1] = high


@kernel_function()
def _is_open(state, strip, row, columns):
    """Return True if a pixel of the row lets light through."""
    rows_per_item = v8.rows_in(columns)
    first = Index(row) - Index(row) % rows_per_item
    transmittance = v8.load_as(columns, state, Index(strip * STRIP) + first * Index(NUM_LANES))
    if rows_per_item == Index(1):
        return v8.has_nonnegative_lane(transmittance)
    row_numbers = v8.row_numbers(columns)
    is_row = v8.broadcast_as(columns, np.float32(Index(row) - first))
    is_row = v8.mask_and(v8.at_least(row_numbers, is_row), v8.at_least(is_row, row_numbers))
    return v8.has_nonnegative_lane(
        v8.select(is_row, transmittance, v8.broadcast_as(columns, np.float32(-1)))
    )


@kernel_function()
def _blend_items(work, items, columns, limits, buffer_bits):
    """Blend all items in turn. The next item's alpha is begun before an item is blended."""
    state = work.state
    staged = work.staged
    values = work.values
    places = work.places
    lines = work.lines
    staged_lights = work.staged_lights
    alpha_max = v8.broadcast_as(columns, limits[0])
    log_cut = v8.broadcast_as(columns, limits[1])
    min_transmittance = v8.broadcast_as(columns, limits[2])
    stop = v8.broadcast_as(columns, limits[7])
    zeros = v8.broadcast_as(columns, np.float32(0))
    n = Index(BATCH)
    ends_early = limits[7] > limits[2]
    places[items] = 0  # one item is read beyond the last
    item_code = Index(places[0])
    next_log_alpha = log2_alpha(staged, values, item_code // Index(PLACES), Index(0), columns)
    next_alpha = alpha_of(next_log_alpha, alpha_max, log_cut)
    for item in range(items):
        # Take this item's alpha, and begin the next item's.
        splat = item_code // Index(PLACES)
        place = item_code % Index(PLACES)
        log_alpha = next_log_alpha
        alpha = next_alpha
        item_code = Index(places[item + Index(1)])
        next_log_alpha = log2_alpha(
            staged, values, item_code // Index(PLACES), item + Index(1), columns
        )
        next_alpha = alpha_of(next_log_alpha, alpha_max, log_cut)
        if buffer_bits is not None and buffer_bits & CUT:
            alpha = alpha * kept_share(lines, work.edges, splat, item, columns)
        # Weight of the splat, and the transmittance that remains.
        at = place * Index(WIDE)
        transmittance = v8.load_as(columns, state, at)
        weight = alpha * transmittance
        transmittance_behind = transmittance - weight
        is_blended = v8.greater(transmittance_behind, min_transmittance)
        remaining = v8.select(is_blended, transmittance_behind, v8.minus_abs(transmittance))
        if ends_early:
            remaining = remaining_transmittance(
                transmittance, transmittance_behind, is_blended, stop
            )
        v8.store(state, at, remaining)
        weight = v8.select(is_blended, weight, zeros)
        # Sums of the images that are asked for.
        if buffer_bits is None or buffer_bits & RGB:
            _add(state, at + P_RED, weight, staged[Index(L.RED) * n + splat])
            _add(state, at + P_GREEN, weight, staged[Index(L.GREEN) * n + splat])
            _add(state, at + P_BLUE, weight, staged[Index(L.BLUE) * n + splat])
        if buffer_bits is not None:
            if buffer_bits & LIT_RGB and is_lit(staged_lights, splat):
                share = weight * light_share(
                    staged_lights, staged, splat, log_alpha, place, columns, limits
                )
                _add(state, at + P_RED, share, staged_lights[Index(L_RED) * n + splat])
                _add(state, at + P_GREEN, share, staged_lights[Index(L_GREEN) * n + splat])
                _add(state, at + P_BLUE, share, staged_lights[Index(L_BLUE) * n + splat])
            if buffer_bits & OVERLAY:
                _add(state, at + P_OVERLAY, weight, staged[Index(L.IS_OVERLAY) * n + splat])
            if buffer_bits & SURFACES:
                centre = staged[Index(L.DEPTH) * n + splat]
                depth = v8.broadcast_as(columns, centre)
                if buffer_bits & CLIP:
                    depth = surface_depth(
                        lines, work.surfaces, splat, item, columns, centre, limits[3]
                    )
                if buffer_bits & EXPECTED:
                    sums = v8.fmuladd(weight, depth, v8.load_as(columns, state, at + P_DEPTH))
                    v8.store(state, at + P_DEPTH, sums)
                if buffer_bits & MODES:
                    add_sample(state, at + P_MODE, depth, weight, limits[4])
            if buffer_bits & MEDIAN:
                half = v8.broadcast_as(columns, np.float32(0.5))
                has_crossed = v8.mask_and(
                    v8.at_least(transmittance, half), v8.greater(half, transmittance_behind)
                )
                depth = v8.broadcast_as(columns, staged[Index(L.DEPTH) * n + splat])
                previous = v8.load_as(columns, state, at + P_MEDIAN)
                v8.store(
                    state,
                    at + P_MEDIAN,
                    v8.select(v8.mask_and(has_crossed, is_blended), depth, previous),
                )
            if buffer_bits & IDS:
                best = v8.load_as(columns, state, at + P_BEST)
                is_heavier = v8.greater(weight, best)
                v8.store(state, at + P_BEST, v8.select(is_heavier, weight, best))
                number = v8.broadcast_as(columns, staged[Index(L.SPLAT_ID) * n + splat])
                previous = v8.load_as(columns, state, at + P_ID)
                v8.store(state, at + P_ID, v8.select(is_heavier, number, previous))


@kernel_function()
def log2_alpha(staged, values, splat, item, columns):
    """Return the log2 of a splat's alpha at an item's pixels (see augment.render.layout)."""
    sharp = v8.broadcast_as(columns, staged[Index(L.SHARP_X) * Index(BATCH) + splat])
    rows = Index(ITEMS) // v8.rows_in(columns)
    off = v8.fmuladd(sharp, columns, v8.by_row(columns, values, item + rows))
    return v8.fmuladd(v8.negate(off), off, v8.by_row(columns, values, item))


@kernel_function()
def alpha_of(log_alpha, alpha_max, log_cut):
    """Return alpha from its log2: 0 below the cut, at most alpha_max."""
    return v8.minimum(v8.exp2_where(v8.at_least(log_alpha, log_cut), log_alpha), alpha_max)


@kernel_function()
def remaining_transmittance(transmittance, transmittance_behind, is_blended, stop):
    """Return the transmittance behind a splat, negative where the pixel is finished.

    is_blended: mask of the pixels at which the splat is blended.
    """
    final = v8.minus_abs(v8.select(is_blended, transmittance_behind, transmittance))
    return v8.select(v8.greater(transmittance_behind, stop), transmittance_behind, final)


@kernel_function()
def _add(state, at, weight, value):
    before = v8.load_as(weight, state, at)
    v8.store(state, at, v8.fmuladd(weight, v8.broadcast_as(weight, value), before))


@kernel_function()
def _write_pixels(state, left, top, size, images, buffer_bits):
    """Write the pixels of a finished tile to the images."""
    columns = v8.wide_columns()
    ones = v8.broadcast(np.float32(1))
    min_weight = v8.broadcast(np.float32(DEPTH_EPS))
    for y in range(Index(min(TILE_H, size[1] - top))):
        for strip in range(Index(STRIPS)):
            column = left + np.int64(strip) * NUM_LANES
            at = Index(_place_of(np.int64(strip) * NUM_LANES, np.int64(y)))
            pixel = Index((top + np.int64(y)) * size[0] + column)
            count = min(NUM_LANES, size[0] - column)
            opacity = ones - v8.absolute(v8.load_row(columns, state, at))
            _write(images.alpha, pixel, opacity, count)
            if buffer_bits is None or buffer_bits & RGB:
                red = v8.load_row(columns, state, at + P_RED)
                green = v8.load_row(columns, state, at + P_GREEN)
                blue = v8.load_row(columns, state, at + P_BLUE)
                if count >= NUM_LANES:
                    v8.store_colours(images.rgb, Index(3) * pixel, red, green, blue)
                else:
                    for k in range(Index(count)):
                        first = Index(3) * (pixel + k)
                        images.rgb[first] = v8.lane(red, k)
                        images.rgb[first + Index(1)] = v8.lane(green, k)
                        images.rgb[first + Index(2)] = v8.lane(blue, k)
            if buffer_bits is not None:
                if buffer_bits & EXPECTED:
                    weighted = v8.load_row(columns, state, at + P_DEPTH)
                    depth = weighted / v8.maximum(opacity, min_weight)
                    _write(images.expected, pixel, depth, count)
                if buffer_bits & MEDIAN:
                    value = v8.load_row(columns, state, at + P_MEDIAN)
                    _write(images.median, pixel, value, count)
                if buffer_bits & IDS:
                    number = v8.load_row(columns, state, at + P_ID)
                    _write(images.ids.view(np.float32), pixel, number, count)
                if buffer_bits & MODES:
                    value = v8.load_row(columns, state, at + P_MODE + MODE)
                    _write(images.mode, pixel, value, count)
                if buffer_bits & OVERLAY:
                    value = v8.load_row(columns, state, at + P_OVERLAY)
                    _write(images.overlay, pixel, value, count)


@kernel_function()
def _write(image, at, values, count):
    """Write the first of eight values, as many as lie in the image."""
    if count >= NUM_LANES:
        v8.store(image, at, values)
    else:
        for k in range(count):
            image[at + Index(k)] = v8.lane(values, Index(k))
