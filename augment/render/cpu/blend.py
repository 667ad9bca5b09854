"""Numba kernels: blend every tile's splats front to back.

Batch by batch of a tile's list, strip by strip, the items (geometry.list_items) are blended in
turn. Strips shrink to the rows in which a pixel still lets light through, and a tile ends where
none does.

The kernel is compiled twice: for colour and alpha alone (`wanted` is None), and for everything,
where the bits of `wanted` say which images there are.
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
from augment.render.cpu.jit import inner, kernel
from augment.render.cpu.simd import ROWS, WIDE
from augment.render.layout import (
    BIN_SHIFT,
    BLOCK,
    LANES,
    PIXELS,
    RECORD,
    STRIP,
    STRIPS,
    TILE_H,
    TILE_W,
    U,
)
from augment.render.mode_depth import BETA_PER_SIGMA, FARTHER, GAMMA, NEARER

# ---- Numba kernels: order splats by depth, and list them tile by tile in that order --------------
# The projection has counted each block's splats by bins of z. Sorting moves them to their bins,
# block after block, then sorts every bin within the cache; both keep equal depths in index order.

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
def fill_lists(slots, sorted_rects, first, last, columns, heads, tile_splat_ids, bands):
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
                        tile_splat_ids[U(at)] = slots[i]
                        heads[tile] = at + 1


# ---- Numba functions: mode depth, item by item (see augment.render.mode_depth) -------------------
# Sums are kept times the cluster's weight, so that a sample that joins costs no division and no
# root.

# Planes of a tile, from where the caller says: of the running cluster the depth it began with and
# the sums of w, w (z - first), w (z - first)^2; of the heaviest one its weight and mode.
FIRST, MASS, MOMENT, SQUARE, HEAVIEST, MODE = (U(i * PIXELS) for i in range(6))
MODE_PLANES = 6

_FARTHER, _NEARER = np.float32(FARTHER), np.float32(NEARER)
_FARTHER_2 = np.float32((FARTHER * BETA_PER_SIGMA) ** 2)
_NEARER_2 = np.float32((NEARER * BETA_PER_SIGMA) ** 2)
_BACK = np.float32(GAMMA * BETA_PER_SIGMA)
# What rounding may add to a sum of weights; far more than it does.
_SLACK = np.float32(1e-4)


@inner()
def add_sample(state, at, depth, weight, floor):
    """An item's pixels' next samples. state, at: their place in the plane FIRST."""
    zero, none = v8.splat_as(depth, np.float32(0)), v8.splat_as(depth, np.float32(-1))
    first, mass = v8.load_as(depth, state, at + FIRST), v8.load_as(depth, state, at + MASS)
    moment, square = v8.load_as(depth, state, at + MOMENT), v8.load_as(depth, state, at + SQUARE)
    off = depth - first
    aside = v8.fmuladd(off, mass, v8.negate(moment))  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = v8.at_least(aside, zero)
    reach = v8.select(is_farther, v8.splat_as(depth, _FARTHER), v8.splat_as(depth, _NEARER))
    reach_2 = v8.select(is_farther, v8.splat_as(depth, _FARTHER_2), v8.splat_as(depth, _NEARER_2))
    by_floor = v8.splat_as(depth, floor) * reach * mass - v8.absolute(aside)
    by_spread = v8.fmuladd(reach_2, spread, v8.negate(aside * aside))
    joins = v8.greater(v8.maximum(by_floor, by_spread), zero)
    begins = v8.select(joins, none, v8.select(v8.greater(weight, zero), zero, none))
    if v8.any_not_negative(begins):
        is_new = v8.at_least(begins, zero)
        best = v8.load_as(depth, state, at + HEAVIEST)
        heavier = v8.both(is_new, v8.greater(mass, best))
        mode = v8.select(
            heavier, _mode(first, mass, moment, spread), v8.load_as(depth, state, at + MODE)
        )
        v8.store(state, at + HEAVIEST, v8.select(heavier, mass, best))
        v8.store(state, at + MODE, mode)
        v8.store(state, at + FIRST, v8.select(is_new, depth, first))
        off, mass = v8.select(is_new, zero, off), v8.select(is_new, zero, mass)
        moment, square = v8.select(is_new, zero, moment), v8.select(is_new, zero, square)
    weighted = weight * off
    v8.store(state, at + MASS, mass + weight)
    v8.store(state, at + MOMENT, moment + weighted)
    v8.store(state, at + SQUARE, v8.fmuladd(weighted, off, square))


@inner()
def can_grow(state, at, transmittance):
    """Not negative where the running cluster may still become the heaviest, or is it.

    transmittance: what light is left, negative where blending has stopped.
    """
    none = v8.splat_as(transmittance, np.float32(-1))
    mass, best = (
        v8.load_as(transmittance, state, at + MASS),
        v8.load_as(transmittance, state, at + HEAVIEST),
    )
    most = mass + transmittance + v8.splat_as(transmittance, _SLACK) - best
    return v8.select(
        v8.greater(transmittance, v8.splat_as(transmittance, np.float32(0))), most, none
    )


@inner()
def close_clusters(state, start):
    """The last cluster is compared too: leaves the result in the plane MODE."""
    for i in range(U(0), U(PIXELS), U(LANES)):
        at = U(start) + i
        first, mass = v8.load(state, at + FIRST), v8.load(state, at + MASS)
        moment, square = v8.load(state, at + MOMENT), v8.load(state, at + SQUARE)
        mode = _mode(first, mass, moment, _spread(mass, moment, square))
        heavier = v8.greater(mass, v8.load(state, at + HEAVIEST))
        v8.store(state, at + MODE, v8.select(heavier, mode, v8.load(state, at + MODE)))


@inner()
def _spread(mass, moment, square):
    """mass^2 times the variance."""
    spread = v8.fmuladd(mass, square, v8.negate(moment * moment))
    return v8.maximum(spread, v8.splat_as(spread, np.float32(0)))


@inner()
def _mode(first, mass, moment, spread):
    return first + (moment - v8.splat_as(first, _BACK) * v8.sqrt(spread)) / mass


GROUP = 8  # tiles a thread takes at a time
LINE = 16  # float32 of a cache line

# Planes of a tile's state, PIXELS float32 each, strip after strip, row after row. The transmittance
# is negative where blending has stopped; its size is then the final one. An image needs its plane
# and all before, so those that cost most come last.
TRANSMITTANCE, P_RED, P_GREEN, P_BLUE, P_OVERLAY = (U(i * PIXELS) for i in range(5))
P_DEPTH, P_MEDIAN, P_BEST, P_ID, P_MODE = (U(i * PIXELS) for i in range(5, 10))
COLOR_STATE, OVERLAY_STATE, MODELESS_STATE = 4 * PIXELS, 5 * PIXELS, 9 * PIXELS
STATE = MODELESS_STATE + MODE_PLANES * PIXELS

CLOSED, OPEN, FRESH = 0, 1, 2  # a tile: finished, begun, not begun


# Bits of `wanted`: the images, in the order of BUFFERS; then whether splats have cuts, some splat
# of the batch at hand is cut, and colour depends on splats' lights.
RGB, ALPHA, EXPECTED, MEDIAN, IDS, MODES, OVERLAY, CLIP, CUT, LIT_RGB = (1 << i for i in range(10))
SURFACES = EXPECTED | MODES  # images of depths that a cut bends
ORDERED = MEDIAN | IDS | MODES  # images that most pixels need no more splats for early on


class Images(NamedTuple):
    """Flat images to write, in the order of BUFFERS; empty where one is not asked for."""

    rgb: Any
    alpha: Any
    expected: Any
    median: Any
    ids: Any
    mode: Any
    overlay: Any


class TileSplats(NamedTuple):
    """What tiles blend. records, cuts, lights: flat, of each slot (see layout, geometry).
    tile_splat_ids, tile_offsets: every tile's list of slots.
    """

    records: Any
    cuts: Any
    lights: Any
    tile_splat_ids: Any
    tile_offsets: Any


class Frame(NamedTuple):
    """size: image width and height. limits: float32, alpha_max, log2(ALPHA_MIN), what a splat must
    leave more of than this to be blended, 1 where rays are parallel, mode depth's floor, 1/fx^2,
    1/fy^2, the transmittance at which a pixel is finished.
    """

    size: Any
    limits: Any


class Work(NamedTuple):
    """A tile's state, and what a batch of its splats asks for: see geometry."""

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
    lit: Any


@kernel
def blend_tiles(splats, tiles, states, is_last, frame, images, wanted):
    """Blend one slice of z into every open tile; write the pixels of those that end.

    tiles: uint8 [tiles], CLOSED, OPEN or FRESH, updated. states: float32 [tiles * used part of
    STATE], where open tiles wait for the next slice. wanted: bits, or None for RGB and alpha.
    """
    for group in prange((tiles.size + GROUP - 1) // GROUP):
        _blend_group(np.int64(group), splats, tiles, states, is_last, frame, images, wanted)


@inner()
def _blend_group(group, splats, tiles, states, is_last, frame, images, wanted):
    size = frame.size
    columns = (size[0] + TILE_W - 1) // TILE_W
    used = states.size // tiles.size
    work = Work(
        aligned_floats(STATE + LINE),  # v8.load_row reads a number beyond
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
        first, last = splats.tile_offsets[tile], splats.tile_offsets[tile + 1]
        if tiles[tile] == CLOSED or (first == last and not is_last):
            continue
        left, top = tile % columns * TILE_W, tile // columns * TILE_H
        if tiles[tile] == FRESH:
            _clear(state, used, size[0] - left, size[1] - top)
        else:
            _copy(states, U(tile * used), state, U(0), U(used))
        for y in range(min(TILE_H, size[1] - top)):
            at = U((top + y) * size[0] + left)
            v8.prefetch_to_write(images.alpha, at)
            if wanted is None or wanted & RGB:
                for line in range(U(0), U(3 * TILE_W), U(LINE)):
                    v8.prefetch_to_write(images.rgb, U(3) * at + line)
        corner = (np.float32(left), np.float32(top))
        is_open = _blend_list(splats, first, last, corner, frame.limits, wanted, work)
        if is_open and not is_last:
            _copy(state, U(0), states, U(tile * used), U(used))
            tiles[tile] = OPEN
        else:
            if wanted is not None and wanted & MODES:
                close_clusters(state, P_MODE)
            _write_pixels(state, left, top, size, images, wanted)
            tiles[tile] = CLOSED


@inner()
def aligned_floats(count):
    """So many float32 that begin where a cache line does."""
    room = np.empty(count + LINE, np.float32)
    past = (U(room.ctypes.data) // U(room.itemsize)) % U(LINE)
    return room[LINE - np.int64(past) :][:count]


@inner()
def _copy(source, source_at, target, target_at, count):
    for i in range(U(0), count, U(LANES)):
        v8.store(target, target_at + i, v8.load(source, source_at + i))


@inner()
def _clear(state, used, width, height):
    """A tile before the first splat; pixels beyond the image count as finished."""
    nobody = np.int32(-1).view(np.float32)
    for i in range(U(0), U(used), U(LANES)):
        value = np.float32(1) if i < P_RED else np.float32(0)
        value = nobody if P_ID <= i < P_MODE else value
        v8.store(state, i, v8.splat(value))
    if width < TILE_W or height < TILE_H:
        for y in range(TILE_H):
            for x in range(TILE_W):
                if x >= width or y >= height:
                    state[_place_of(x, y)] = np.float32(-1)


@inner()
def _place_of(x, y):
    """Where a pixel of the tile stands in a plane of its state."""
    row = x // LANES * TILE_H + y
    return row // ROWS * WIDE + x % LANES * ROWS + row % ROWS


@inner()
def _blend_list(splats, first, last, corner, limits, wanted, work):
    """Blend a tile's list into its state. Returns whether any pixel still lets light through."""
    state, staged, spans, rows = work.state, work.staged, work.spans, work.rows
    records, ids, columns = splats.records, splats.tile_splat_ids, v8.wide_columns()
    for strip in range(STRIPS):
        rows[2 * strip], rows[2 * strip + 1] = 0, TILE_H
        shrink(state, strip, rows, columns)
    for at in range(first, last, BATCH):
        if is_closed(rows):
            return False
        count = U(min(BATCH, last - at))
        for k in range(U(at) + count, U(min(at + 2 * BATCH, last))):
            v8.prefetch(records, U(ids[k]) * U(RECORD))
        stage(records, ids, U(at), count, corner, staged)
        any_cut = False
        if wanted is not None:
            if wanted & LIT_RGB:
                stage_lights(splats.lights, ids, U(at), count, work.lit)
            if wanted & CLIP:
                bent = wanted & SURFACES != 0
                any_cut = stage_cuts(splats.cuts, ids, U(at), count, staged, bent, work.lines)
        for strip in range(STRIPS):
            if rows[2 * strip] >= rows[2 * strip + 1]:
                continue
            found = find_spans(staged, count, strip, rows, limits[1], spans, work.starts)
            if found == U(0):
                continue
            items = list_items(
                staged, found, U(strip), spans, work.starts, columns, work.values, work.places
            )
            now = wanted
            if wanted is not None:
                if wanted & CLIP and wanted & SURFACES:
                    list_lines(work.lines, SURFACE, found, spans, U(strip), columns, work.surfaces)
                if any_cut:
                    list_lines(work.lines, SHARE, found, spans, U(strip), columns, work.edges)
                    now = wanted | CUT
                elif wanted & ORDERED and not _can_change(state, strip, rows, wanted, columns):
                    now = wanted & ~ORDERED
            _blend_items(work, items, columns, limits, now)
            shrink(state, strip, rows, columns)
    return not is_closed(rows)


@inner()
def _can_change(state, strip, rows, wanted, columns):
    """Whether a pixel of the strip may still find its median depth or a heavier splat or cluster.

    It finds none once its transmittance has fallen below one half and the best weight so far,
    which most pixels reach early: the rest of the list costs them no more than colour does.
    """
    most = v8.splat_as(columns, np.float32(-1))
    half = v8.splat_as(columns, np.float32(0.5))
    for row in range(rows[2 * strip] // ROWS * ROWS, rows[2 * strip + 1], ROWS):
        at = U(strip * STRIP + row * LANES)
        transmittance = v8.load_as(columns, state, at)
        if wanted & MEDIAN:
            most = v8.maximum(most, transmittance - half)
        if wanted & IDS:
            most = v8.maximum(most, transmittance - v8.load_as(columns, state, at + P_BEST))
        if wanted & MODES:
            most = v8.maximum(most, can_grow(state, at + P_MODE, transmittance))
    return v8.any_not_negative(most)


@inner()
def is_closed(rows):
    closed = True
    for strip in range(STRIPS):
        closed = closed and rows[2 * strip] >= rows[2 * strip + 1]
    return closed


@inner()
def shrink(state, strip, rows, columns):
    """Leave out a strip's first and last rows while no pixel of them is open."""
    low, high = rows[2 * strip], rows[2 * strip + 1]
    while low < high and not _is_open(state, strip, low, columns):
        low += 1
    while low < high and not _is_open(state, strip, high - 1, columns):
        high -= 1
    rows[2 * strip], rows[2 * strip + 1] = low, high


@inner()
def _is_open(state, strip, row, columns):
    each = v8.rows_in(columns)
    first = U(row) - U(row) % each
    left = v8.load_as(columns, state, U(strip * STRIP) + first * U(LANES))
    if each == U(1):
        return v8.any_not_negative(left)
    at, here = v8.row_numbers(columns), v8.splat_as(columns, np.float32(U(row) - first))
    here = v8.both(v8.at_least(at, here), v8.at_least(here, at))
    return v8.any_not_negative(v8.select(here, left, v8.splat_as(columns, np.float32(-1))))


@inner()
def _blend_items(work, items, columns, limits, wanted):
    """Blend all items in turn. The next one's alpha is begun before this one is blended."""
    state, staged, values, places = work.state, work.staged, work.values, work.places
    lines, lit = work.lines, work.lit
    alpha_max, log_cut = v8.splat_as(columns, limits[0]), v8.splat_as(columns, limits[1])
    least, end = v8.splat_as(columns, limits[2]), v8.splat_as(columns, limits[7])
    zero = v8.splat_as(columns, np.float32(0))
    n, ends_early = U(BATCH), limits[7] > limits[2]
    places[items] = 0  # one item is read beyond the last
    coded = U(places[0])
    next_e = log2_alpha(staged, values, coded // U(PLACES), U(0), columns)
    next_alpha = alpha_of(next_e, alpha_max, log_cut)
    for item in range(items):
        splat, place, e, alpha = coded // U(PLACES), coded % U(PLACES), next_e, next_alpha
        coded = U(places[item + U(1)])
        next_e = log2_alpha(staged, values, coded // U(PLACES), item + U(1), columns)
        next_alpha = alpha_of(next_e, alpha_max, log_cut)
        if wanted is not None and wanted & CUT:
            alpha = alpha * kept_share(lines, work.edges, splat, item, columns)
        at = place * U(WIDE)
        transmittance = v8.load_as(columns, state, at)
        weight = alpha * transmittance
        after = transmittance - weight
        kept = v8.greater(after, least)
        left = v8.select(kept, after, v8.minus_abs(transmittance))
        if ends_early:
            left = remaining_transmittance(transmittance, after, kept, end)
        v8.store(state, at, left)
        weight = v8.select(kept, weight, zero)
        if wanted is None or wanted & RGB:
            _add(state, at + P_RED, weight, staged[U(L.RED) * n + splat])
            _add(state, at + P_GREEN, weight, staged[U(L.GREEN) * n + splat])
            _add(state, at + P_BLUE, weight, staged[U(L.BLUE) * n + splat])
        if wanted is not None:
            if wanted & LIT_RGB and is_lit(lit, splat):
                share = weight * light_share(lit, staged, splat, e, place, columns, limits)
                _add(state, at + P_RED, share, lit[U(L_RED) * n + splat])
                _add(state, at + P_GREEN, share, lit[U(L_GREEN) * n + splat])
                _add(state, at + P_BLUE, share, lit[U(L_BLUE) * n + splat])
            if wanted & OVERLAY:
                _add(state, at + P_OVERLAY, weight, staged[U(L.IS_OVERLAY) * n + splat])
            if wanted & SURFACES:
                centre = staged[U(L.DEPTH) * n + splat]
                depth = v8.splat_as(columns, centre)
                if wanted & CLIP:
                    depth = surface_depth(
                        lines, work.surfaces, splat, item, columns, centre, limits[3]
                    )
                if wanted & EXPECTED:
                    sums = v8.fmuladd(weight, depth, v8.load_as(columns, state, at + P_DEPTH))
                    v8.store(state, at + P_DEPTH, sums)
                if wanted & MODES:
                    add_sample(state, at + P_MODE, depth, weight, limits[4])
            if wanted & MEDIAN:
                half = v8.splat_as(columns, np.float32(0.5))
                crossed = v8.both(v8.at_least(transmittance, half), v8.greater(half, after))
                depth = v8.splat_as(columns, staged[U(L.DEPTH) * n + splat])
                before = v8.load_as(columns, state, at + P_MEDIAN)
                v8.store(state, at + P_MEDIAN, v8.select(v8.both(crossed, kept), depth, before))
            if wanted & IDS:
                best = v8.load_as(columns, state, at + P_BEST)
                heavier = v8.greater(weight, best)
                v8.store(state, at + P_BEST, v8.select(heavier, weight, best))
                number = v8.splat_as(columns, staged[U(L.SPLAT_ID) * n + splat])
                before = v8.load_as(columns, state, at + P_ID)
                v8.store(state, at + P_ID, v8.select(heavier, number, before))


@inner()
def log2_alpha(staged, values, splat, item, columns):
    """Of a splat at an item's pixels (see augment.render.layout)."""
    sharp = v8.splat_as(columns, staged[U(L.SHARP_X) * U(BATCH) + splat])
    rows = U(ITEMS) // v8.rows_in(columns)
    off = v8.fmuladd(sharp, columns, v8.by_row(columns, values, item + rows))
    return v8.fmuladd(v8.negate(off), off, v8.by_row(columns, values, item))


@inner()
def alpha_of(e, alpha_max, log_cut):
    return v8.minimum(v8.exp2_where(v8.at_least(e, log_cut), e), alpha_max)


@inner()
def remaining_transmittance(transmittance, after, kept, end):
    """Transmittance behind a splat, negative where the pixel is finished. kept: it is blended."""
    final = v8.minus_abs(v8.select(kept, after, transmittance))
    return v8.select(v8.greater(after, end), after, final)


@inner()
def _add(state, at, weight, value):
    before = v8.load_as(weight, state, at)
    v8.store(state, at, v8.fmuladd(weight, v8.splat_as(weight, value), before))


@inner()
def _write_pixels(state, left, top, size, images, wanted):
    """Pixels of a finished tile to the images."""
    columns = v8.wide_columns()
    one, least = v8.splat(np.float32(1)), v8.splat(np.float32(DEPTH_EPS))
    for y in range(U(min(TILE_H, size[1] - top))):
        for strip in range(U(STRIPS)):
            column = left + np.int64(strip) * LANES
            at = U(_place_of(np.int64(strip) * LANES, np.int64(y)))
            pixel = U((top + np.int64(y)) * size[0] + column)
            count = min(LANES, size[0] - column)
            opacity = one - v8.absolute(v8.load_row(columns, state, at))
            _write(images.alpha, pixel, opacity, count)
            if wanted is None or wanted & RGB:
                red = v8.load_row(columns, state, at + P_RED)
                green = v8.load_row(columns, state, at + P_GREEN)
                blue = v8.load_row(columns, state, at + P_BLUE)
                if count >= LANES:
                    v8.store_colours(images.rgb, U(3) * pixel, red, green, blue)
                else:
                    for k in range(U(count)):
                        first = U(3) * (pixel + k)
                        images.rgb[first] = v8.lane(red, k)
                        images.rgb[first + U(1)] = v8.lane(green, k)
                        images.rgb[first + U(2)] = v8.lane(blue, k)
            if wanted is not None:
                if wanted & EXPECTED:
                    weighted = v8.load_row(columns, state, at + P_DEPTH)
                    depth = weighted / v8.maximum(opacity, least)
                    _write(images.expected, pixel, depth, count)
                if wanted & MEDIAN:
                    value = v8.load_row(columns, state, at + P_MEDIAN)
                    _write(images.median, pixel, value, count)
                if wanted & IDS:
                    number = v8.load_row(columns, state, at + P_ID)
                    _write(images.ids.view(np.float32), pixel, number, count)
                if wanted & MODES:
                    value = v8.load_row(columns, state, at + P_MODE + MODE)
                    _write(images.mode, pixel, value, count)
                if wanted & OVERLAY:
                    value = v8.load_row(columns, state, at + P_OVERLAY)
                    _write(images.overlay, pixel, value, count)


@inner()
def _write(image, at, values, count):
    """The first of eight values, as many as lie in the image."""
    if count >= LANES:
        v8.store(image, at, values)
    else:
        for k in range(count):
            image[at + U(k)] = v8.lane(values, U(k))
