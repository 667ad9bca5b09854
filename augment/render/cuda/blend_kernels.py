"""Triton kernel: blend every tile's splats front to back.

A program is one warp and blends a block of a tile's pixels, several for each of its threads, so
that nothing ever waits for another warp. It takes its tile's list in batches of one splat a thread:
each thread finds out whether its splat's ellipse meets the block, and the warp blends those that
do, one after the other. Looking also brings the records into the nearest cache, where the blending
finds them. A block ends where nothing shines through any of its pixels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import constants, layout, mode_depth
from augment.render.cpu import geometry as cpu_geometry
from augment.render.cuda.project_kernels import sh_basis
from augment.render.cuda.splats import TILE

# ---- Triton kernels: from the loss's gradient by the image to those of the splats' colours -------
# The blend is linear in the colours, so its way back is the transposed blend: the same weights,
# summed over pixels instead of splats. A tile's share of a splat has a place of its own, and those
# places are added up in the order of the tiles; nothing depends on the order in which programs run.

_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_RECORD = tl.constexpr(layout.RECORD)
_MEAN_X, _MEAN_Y = tl.constexpr(layout.MEAN_X), tl.constexpr(layout.MEAN_Y)
_LEAN_X, _SHARP_X = tl.constexpr(layout.LEAN_X), tl.constexpr(layout.SHARP_X)
_FALL_Y, _LOG_OPACITY = tl.constexpr(layout.FALL_Y), tl.constexpr(layout.LOG_OPACITY)
_RED = tl.constexpr(layout.RED)
_V_ROTATION, _V_EYE = tl.constexpr(layout.V_ROTATION), tl.constexpr(layout.V_EYE)
_V_PARALLEL = tl.constexpr(layout.V_PARALLEL)


@triton.jit(do_not_specialize=["width", "height"])
def share_colors(
    records, tile_splat_ids, tile_offsets, d_rgb, shares, width, height, limits,
    BATCH: tl.constexpr,
):  # fmt: skip
    """A program a tile: sum over its pixels of weight times dL/d rgb, for each entry of its list.

    d_rgb: float32 [height, width, 3]. shares: float32 [3, entries], zeros; written as far as light
    reaches. limits: the forward blend's. BATCH entries are looked at at once, all pixels of them,
    which leaves the products of transmittances as the only chain.
    """
    alpha_max, log_cut, least, end = limits
    columns = (width + _TILE - 1) // _TILE
    tile = tl.program_id(0)
    entries = tl.load(tile_offsets + tl.num_programs(0)).to(tl.int64)  # three times as many places
    at = tl.load(tile_offsets + tile)
    last = tl.load(tile_offsets + tile + 1)
    pixel = tl.arange(0, _PIXELS)
    column = tile % columns * _TILE + pixel % _TILE
    row = tile // columns * _TILE + pixel // _TILE
    inside = (column < width) & (row < height)
    first = (row * width + column) * 3
    red = tl.load(d_rgb + first, mask=inside, other=0.0)[None, :]
    green = tl.load(d_rgb + first + 1, mask=inside, other=0.0)[None, :]
    blue = tl.load(d_rgb + first + 2, mask=inside, other=0.0)[None, :]
    x = (column.to(tl.float32) + 0.5)[None, :]
    y = (row.to(tl.float32) + 0.5)[None, :]
    transmittance = tl.where(inside, 1.0, 0.0)
    while (at < last) & (tl.max(transmittance, 0) > end):
        entry = at + tl.arange(0, BATCH)
        listed = entry < last
        record = (
            records + tl.load(tile_splat_ids + entry, mask=listed, other=0).to(tl.int64) * _RECORD
        )
        log_opacity = tl.load(record + _LOG_OPACITY, mask=listed, other=float("-inf"))[:, None]
        mean_x = tl.load(record + _MEAN_X, mask=listed, other=0.0)[:, None]
        mean_y = tl.load(record + _MEAN_Y, mask=listed, other=0.0)[:, None]
        sharp = tl.load(record + _SHARP_X, mask=listed, other=0.0)[:, None]
        lean = tl.load(record + _LEAN_X, mask=listed, other=0.0)[:, None]
        fall = tl.load(record + _FALL_Y, mask=listed, other=0.0)[:, None]
        dy = y - mean_y
        off = sharp * (x - mean_x - lean * dy)
        e = log_opacity - off * off - fall * dy * dy
        alpha = tl.where(e >= log_cut, tl.minimum(tl.exp2(e), alpha_max), 0.0)
        passed = 1 - alpha
        after = transmittance[None, :] * tl.cumprod(passed, 0)
        before = after / passed  # what is not kept may be 0 / 0
        kept = (after > least) & (before > end)
        weight = tl.where(kept, alpha * before, 0.0)
        tl.store(shares + entry, tl.sum(weight * red, 1), mask=listed)
        tl.store(shares + entries + entry, tl.sum(weight * green, 1), mask=listed)
        tl.store(shares + 2 * entries + entry, tl.sum(weight * blue, 1), mask=listed)
        transmittance = tl.min(after, 0)
        at += BATCH


@triton.jit(do_not_specialize=["count", "entries"])
def sum_shares(
    shares, order, firsts, records, d_colors, count, entries,
    SPLATS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """dL by every splat's colour before its clamp at 0, float32 [count, 3].

    order: int64 [entries], list entries splat by splat, in the order of the tiles. firsts: int64
    [count + 1], where each splat's begin in it. A splat's entries go to LANES sums in turn, which
    are then added as a tree.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_one = splat < count
    first = tl.load(firsts + splat, mask=is_one, other=0)
    last = tl.load(firsts + splat + 1, mask=is_one, other=0)
    red = tl.zeros([SPLATS, LANES], tl.float32)
    green = tl.zeros([SPLATS, LANES], tl.float32)
    blue = tl.zeros([SPLATS, LANES], tl.float32)
    longest = tl.max(last - first, 0)
    place = first[:, None] + tl.arange(0, LANES)[None, :]
    done = longest * 0
    while done < longest:
        own = place < last[:, None]
        entry = tl.load(order + place, mask=own, other=0)
        red += tl.load(shares + entry, mask=own, other=0.0)
        green += tl.load(shares + entries + entry, mask=own, other=0.0)
        blue += tl.load(shares + 2 * entries + entry, mask=own, other=0.0)
        place += LANES
        done += LANES
    for channel in tl.static_range(3):
        total = red if channel == 0 else (green if channel == 1 else blue)
        # Records of splats that are not drawn hold anything; their sums are 0 either way.
        color = tl.load(records + splat * _RECORD + _RED + channel, mask=is_one, other=0.0)
        passed = tl.where(color > 0, tl.sum(total, 1), 0.0)
        tl.store(d_colors + splat * 3 + channel, passed, mask=is_one)


@triton.jit(do_not_specialize=["count", "used"])
def spread_to_sh(
    means, view, d_colors, d_sh, count, used,
    SPLATS: tl.constexpr, VALUES: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """dL by spherical harmonics: basis functions at each splat's direction times dL by its colour.

    means: [count, 3] of one part; view: its numbers (layout's V_*). d_sh: float32 [count, VALUES],
    VALUES = 3 K, filled; 0 in functions from `used` on. COLUMNS: VALUES or the power of two above.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_one = splat < count
    x, y, z = tl.load(view + _V_EYE), tl.load(view + _V_EYE + 1), tl.load(view + _V_EYE + 2)
    rest_x, rest_y = tl.load(view + _V_EYE + 3), tl.load(view + _V_EYE + 4)
    rest_z = tl.load(view + _V_EYE + 5)
    x = tl.load(means + splat * 3, mask=is_one, other=0.0) - x - rest_x
    y = tl.load(means + splat * 3 + 1, mask=is_one, other=0.0) - y - rest_y
    z = tl.load(means + splat * 3 + 2, mask=is_one, other=1.0) - z - rest_z
    parallel = tl.load(view + _V_PARALLEL) != 0
    x = tl.where(parallel, tl.load(view + _V_ROTATION + 6), x)
    y = tl.where(parallel, tl.load(view + _V_ROTATION + 7), y)
    z = tl.where(parallel, tl.load(view + _V_ROTATION + 8), z)
    # Scaled first: a square of metres must neither overflow nor vanish.
    size = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    scale = tl.where(size > 0, 1 / size, 0.0)
    x, y, z = x * scale, y * scale, z * scale
    length = tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-30))
    x, y, z = (x / length)[:, None], (y / length)[:, None], (z / length)[:, None]
    functions = sh_basis(x, y, z, VALUES // 3)
    column = tl.arange(0, COLUMNS)[None, :]
    k, channel = column // 3, column % 3
    basis = tl.zeros([SPLATS, COLUMNS], tl.float32)
    for number in tl.static_range(VALUES // 3):
        basis = tl.where(k == number, functions[number], basis)
    own = is_one[:, None] & (column < VALUES)
    basis = tl.where(k < used, basis, 0.0)
    color = tl.load(d_colors + splat[:, None] * 3 + channel, mask=own, other=0.0)
    tl.store(d_sh + splat[:, None] * VALUES + column, basis * color, mask=own)


# ---- Triton kernels: the tiles of splats that are in order of depth, pair by pair ----------------


@triton.jit(do_not_specialize=["count", "columns"])
def count_tiles(order, counts, rects, sums, sorted_counts, count, columns, BLOCK: tl.constexpr):
    """How many tiles each splat is listed in, nearest splat first.

    order: int64 [count], rows of CudaSplats. counts, rects: as there. sums: int32 [rows + 1,
    columns + 1], wanted tiles above and to the left, or None: splats without a wanted tile count
    none. sorted_counts: int32 [count], written.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_there = at < count
    row = tl.load(order + at, mask=is_there, other=0)
    tiles = tl.load(counts + row, mask=is_there, other=0)
    if sums is not None:
        is_drawn = is_there & (tiles > 0)
        first = tl.load(rects + 2 * row, mask=is_drawn, other=0)
        last = tl.load(rects + 2 * row + 1, mask=is_drawn, other=0)
        left, right = first & 0xFFFF, (last & 0xFFFF) + 1
        top, bottom = (first >> 16) * (columns + 1), ((last >> 16) + 1) * (columns + 1)
        wanted = (
            tl.load(sums + bottom + right, mask=is_drawn, other=0)
            - tl.load(sums + top + right, mask=is_drawn, other=0)
            - tl.load(sums + bottom + left, mask=is_drawn, other=0)
            + tl.load(sums + top + left, mask=is_drawn, other=0)
        )
        tiles = tl.where(wanted > 0, tiles, 0)
    tl.store(sorted_counts + at, tiles, mask=is_there)


@triton.jit(do_not_specialize=["pairs", "count", "steps", "columns", "none"])
def list_pairs(
    order, ends, rects, wanted, tiles, owners, pairs, count, steps, columns, none,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Every pair of a splat and a tile, nearest splat first, the tiles of each row by row.

    order: as above. ends: int64 [count], how many pairs there are up to each splat, itself
    included. steps: halvings that leave one of `count` splats. wanted: bool [tiles], or None for
    all. tiles, owners: [pairs], written: the tile, `none` where it is not wanted, and the row of
    CudaSplats.
    """
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    is_there = pair < pairs
    # The first splat whose pairs end behind this one, between low and high. Neighbours take the
    # same way, so that a warp's loads are mostly of one place.
    low = tl.zeros([BLOCK], tl.int32)
    high = tl.zeros([BLOCK], tl.int32) + count
    for _ in range(steps):
        middle = (low + high) >> 1  # count where the search is over
        end = tl.load(ends + middle, mask=middle < count, other=0x7FFFFFFFFFFFFFFF)
        is_behind = end > pair
        high = tl.where(is_behind, middle, high)
        low = tl.where(is_behind, low, middle + 1)
    is_there = is_there & (low < count)
    row = tl.load(order + low, mask=is_there, other=0)
    begin = tl.load(ends + low - 1, mask=is_there & (low > 0), other=0)
    first = tl.load(rects + 2 * row, mask=is_there, other=0)
    last = tl.load(rects + 2 * row + 1, mask=is_there, other=0)
    width = (last & 0xFFFF) - (first & 0xFFFF) + 1
    within = (pair - begin).to(tl.int32)
    down = within // width
    tile = ((first >> 16) + down) * columns + (first & 0xFFFF) + within - down * width
    if wanted is not None:
        is_wanted = tl.load(wanted + tile, mask=is_there, other=0)
        tile = tl.where(is_wanted != 0, tile, none)
    tl.store(tiles + pair, tile.to(tiles.dtype.element_ty), mask=is_there)
    tl.store(owners + pair, row.to(tl.int32), mask=is_there)


# --------------------------------------------------------------------------------------------------
# Triton functions: mode depth (augment.render.mode_depth), one sample of every pixel at a time..
# Sums are kept times the cluster's weight, so that a sample that joins costs no division and no
# root.

FARTHER = tl.constexpr(mode_depth.FARTHER)
NEARER = tl.constexpr(mode_depth.NEARER)
FARTHER_2 = tl.constexpr((mode_depth.FARTHER * mode_depth.BETA_PER_SIGMA) ** 2)
NEARER_2 = tl.constexpr((mode_depth.NEARER * mode_depth.BETA_PER_SIGMA) ** 2)
BACK = tl.constexpr(mode_depth.GAMMA * mode_depth.BETA_PER_SIGMA)
SLACK = tl.constexpr(1e-4)  # what rounding may add to a sum of weights; far more than it does


@triton.jit
def add_sample(depth, weight, floor, first, mass, moment, square, best, best_mode):
    """The clusters with every pixel's next sample; those of weight 0 change nothing.

    Of the running cluster: first, the depth it began with, and the sums of w, w (z - first) and
    w (z - first)^2. Of the heaviest closed one: its weight and its mode.
    """
    off = depth - first
    aside = off * mass - moment  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = aside >= 0
    reach = tl.where(is_farther, FARTHER, NEARER)
    reach_2 = tl.where(is_farther, FARTHER_2, NEARER_2)
    by_floor = floor * reach * mass - tl.abs(aside)
    by_spread = reach_2 * spread - aside * aside
    begins = (weight > 0) & (tl.maximum(by_floor, by_spread) <= 0)
    if tl.max(tl.max(begins.to(tl.int32), 0), 0) > 0:
        is_best = begins & (mass > best)
        best_mode = tl.where(is_best, _mode(first, mass, moment, spread), best_mode)
        best = tl.where(is_best, mass, best)
        first = tl.where(begins, depth, first)
        off = tl.where(begins, 0.0, off)
        mass = tl.where(begins, 0.0, mass)
        moment = tl.where(begins, 0.0, moment)
        square = tl.where(begins, 0.0, square)
    weighted = weight * off
    return first, mass + weight, moment + weighted, square + weighted * off, best, best_mode


@triton.jit
def can_grow(transmittance, mass, best):
    """Whether a pixel's running cluster may still become the heaviest, or is it.

    transmittance: the light left, negative where blending has stopped.
    """
    return (transmittance > 0) & (mass + transmittance + SLACK >= best)


@triton.jit
def heaviest_mode(first, mass, moment, square, best, best_mode):
    """Mode of the heaviest cluster, the running one included; 0 where there is none."""
    last = _mode(first, mass, moment, _spread(mass, moment, square))
    return tl.where(mass > best, last, best_mode)


@triton.jit
def _spread(mass, moment, square):
    """mass^2 times the variance."""
    return tl.maximum(mass * square - moment * moment, 0.0)


@triton.jit
def _mode(first, mass, moment, spread):
    return first + (moment - BACK * tl.sqrt(spread)) / tl.where(mass > 0, mass, 1.0)


# Records and cuts are read four numbers at a time, in their order (the launch module checks it).
DEPTH_EPS = tl.constexpr(constants.DEPTH_EPS)
RECORD, CUT, LINES = (
    tl.constexpr(layout.RECORD),
    tl.constexpr(layout.CUT),
    tl.constexpr(cpu_geometry.SHADING_LINES),
)
L_FACING, L_X, L_Y, L_WRAP = (
    tl.constexpr(cpu_geometry.L_FACING),
    tl.constexpr(cpu_geometry.L_X),
    tl.constexpr(cpu_geometry.L_Y),
    tl.constexpr(cpu_geometry.L_WRAP),
)
L_LEAN_X, L_LEAN_Y = tl.constexpr(cpu_geometry.L_LEAN_X), tl.constexpr(cpu_geometry.L_LEAN_Y)
L_RED, L_GREEN, L_BLUE = (
    tl.constexpr(cpu_geometry.L_RED),
    tl.constexpr(cpu_geometry.L_GREEN),
    tl.constexpr(cpu_geometry.L_BLUE),
)
TINY = tl.constexpr(1e-20)  # augment.render.shading.TINY
LANES = tl.constexpr(32)  # threads of a warp, splats looked at together, bits of an int32
# Rounding must not lose a pixel: splats that stay this far below the cut (log2 of alpha) anywhere
# in a block are left out, others tried.
MARGIN = tl.constexpr(0.0625)


@triton.jit(do_not_specialize=["width", "height"])
def blend_blocks(
    splats, tile_splat_ids, tile_offsets, images, width, height, limits, lens,
    IS_COARSE: tl.constexpr, BLOCK_W: tl.constexpr, BLOCK_H: tl.constexpr,
):  # fmt: skip
    """Blend one block of BLOCK_W x BLOCK_H pixels of a tile; a tile's blocks are neighbours.

    splats: records, cuts and lights of CudaSplats; cuts and lights may be None. tile_splat_ids,
    tile_offsets: as in CudaTiles. images: in the order of BUFFERS; None where one is not asked for.
    limits: alpha_max, log2(ALPHA_MIN), what a splat must leave more of than this to be blended, and
    the transmittance at which a pixel is finished; IS_COARSE where these two differ. lens: 1 where
    rays are parallel, else 0, mode depth's floor, 1/fx^2 and 1/fy^2.
    """
    records, cuts, lights = splats
    rgb, alpha, expected, median, ids, mode, overlay = images
    alpha_max, log_cut, least, end = limits
    parallel, floor, inverse_fx2, inverse_fy2 = lens
    HAS_CUTS: tl.constexpr = cuts is not None
    HAS_LIGHTS: tl.constexpr = lights is not None
    HAS_RGB: tl.constexpr = rgb is not None
    HAS_EXPECTED: tl.constexpr = expected is not None
    HAS_MEDIAN: tl.constexpr = median is not None
    HAS_IDS: tl.constexpr = ids is not None
    HAS_MODE: tl.constexpr = mode is not None
    HAS_OVERLAY: tl.constexpr = overlay is not None
    columns = (width + _TILE - 1) // _TILE
    across = _TILE // BLOCK_W
    blocks = across * (_TILE // BLOCK_H)
    tile, block = tl.program_id(0) // blocks, tl.program_id(0) % blocks
    left = tile % columns * _TILE + block % across * BLOCK_W
    top = tile // columns * _TILE + block // across * BLOCK_H

    # Axis 1 runs over the warp's threads. The pixels of each, axis 0, lie in one row, in even
    # steps: what a splat is in a row is found once a thread, and the steps are constants.
    STEP: tl.constexpr = LANES // BLOCK_H
    EACH: tl.constexpr = BLOCK_W // STEP
    lanes = tl.arange(0, LANES)
    steps = (tl.arange(0, EACH) * STEP)[:, None]
    first_x, y = left + lanes % STEP, top + lanes // STEP
    is_inside = (first_x[None, :] + steps < width) & (y < height)[None, :]
    west, north = first_x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5  # the first pixel's centre
    ahead = steps.to(tl.float32)
    nothing = tl.zeros([EACH, LANES], tl.float32)
    # Negative where the pixel is finished; its size is then the final transmittance.
    transmittance = tl.where(is_inside, 1.0, -1.0)
    red, green, blue, white = nothing, nothing, nothing, nothing
    weighted_depth, middle, heaviest = nothing, nothing, nothing
    number = tl.full([EACH, LANES], -1, tl.int32)
    first, mass, moment, square = nothing, nothing, nothing, nothing
    best, best_mode = nothing, nothing

    at = tl.load(tile_offsets + tile)
    last = tl.load(tile_offsets + tile + 1)
    row = tl.load(tile_splat_ids + at + lanes, mask=at + lanes < last, other=0)
    is_open = at < last
    while is_open:
        is_listed = at + lanes < last
        # The next batch's, which is there by then.
        following = tl.load(
            tile_splat_ids + at + LANES + lanes, mask=at + LANES + lanes < last, other=0
        )
        reaches = is_listed & _reaches(
            records + row.to(tl.int64) * RECORD, left, top, BLOCK_W - 1, BLOCK_H - 1, log_cut
        )
        left_over = tl.sum(tl.where(reaches, 1 << lanes, 0), 0)  # one bit a splat
        # Behind what outweighs all that is left, samples cannot change the mode.
        grows = HAS_MODE
        if HAS_MODE:
            grows = tl.max(tl.max(can_grow(transmittance, mass, best).to(tl.int32), 0), 0) > 0
        while left_over != 0:
            lowest = (left_over & -left_over).to(tl.uint32, bitcast=True)
            left_over = left_over & (left_over - 1)
            # The exponent of a power of two says which it is.
            k = (lowest.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 127
            slot = tl.load(tile_splat_ids + at + k).to(tl.int64)
            # Every thread reads the whole record, which costs a warp no more than one of them.
            record = (records + slot * RECORD) + tl.zeros([LANES], tl.int32)
            mean_x, mean_y, lean_x, sharp_x = _quarter(record, 0)
            fall_y, log_opacity, _, _ = _quarter(record, 1)

            # log2 of alpha: e = peak - off^2, peak and where off begins being one a row.
            dx, dy = west - mean_x, north - mean_y
            peak = log_opacity - fall_y * dy * dy
            off = (sharp_x * dx - sharp_x * lean_x * dy)[None, :] + sharp_x[None, :] * ahead
            e = peak[None, :] - off * off
            a = tl.where(e >= log_cut, tl.minimum(tl.exp2(e), alpha_max), 0.0)
            if HAS_CUTS:
                cut = (cuts + slot * CUT) + tl.zeros([LANES], tl.int32)
                kept, slope_x, slope_y, right = _quarter(cut, 0)
                share = (kept + slope_x * dx + slope_y * dy)[None, :] + slope_x[None, :] * ahead
                a *= tl.minimum(tl.maximum(share, 0.0), 1.0)
            weight = a * transmittance
            after = transmittance - weight
            is_kept = after > least
            weight = tl.where(is_kept, weight, 0.0)

            if HAS_RGB or HAS_OVERLAY:
                splat_red, splat_green, splat_blue, is_overlay = _quarter(record, 3)
            if HAS_RGB:
                red += weight * splat_red[None, :]
                green += weight * splat_green[None, :]
                blue += weight * splat_blue[None, :]
            if HAS_OVERLAY:
                white += weight * is_overlay[None, :]
            if HAS_EXPECTED or HAS_MEDIAN or HAS_MODE or HAS_IDS:
                _, _, depth, own_id = _quarter(record, 2)
            if HAS_EXPECTED or HAS_MODE:
                if HAS_CUTS:
                    down, most, _, _ = _quarter(cut, 1)
                    growth = (right * dx + down * dy)[None, :] + right[None, :] * ahead
                    growth = tl.minimum(tl.maximum(growth, -most[None, :]), most[None, :])
                    z = depth[None, :] + parallel * growth
                    z = z / (1.0 - (1.0 - parallel) * growth)
                else:
                    z = nothing + depth[None, :]
                if HAS_EXPECTED:
                    weighted_depth += weight * z
                if grows:
                    first, mass, moment, square, best, best_mode = add_sample(
                        z, weight, floor, first, mass, moment, square, best, best_mode
                    )
            if HAS_MEDIAN:
                is_crossed = is_kept & (transmittance >= 0.5) & (after < 0.5)
                middle = tl.where(is_crossed, depth[None, :], middle)
            if HAS_IDS:
                is_heavier = weight > heaviest
                heaviest = tl.where(is_heavier, weight, heaviest)
                number = tl.where(is_heavier, own_id.to(tl.int32, bitcast=True)[None, :], number)
            if HAS_LIGHTS:  # last, when most of what is above need not be kept
                lines = lights + slot * LINES
                more_red, more_green = tl.load(lines + L_RED), tl.load(lines + L_GREEN)
                more_blue = tl.load(lines + L_BLUE)
                if tl.abs(more_red) + tl.abs(more_green) + tl.abs(more_blue) > 0:
                    reach = tl.maximum(log_opacity - log_cut, TINY)[None, :]
                    rim = (log_opacity[None, :] - e) / reach
                    aside = dx[None, :] + ahead
                    share = _light_share(lines, aside, dy[None, :], rim, inverse_fx2, inverse_fy2)
                    red += weight * share * more_red
                    green += weight * share * more_green
                    blue += weight * share * more_blue
            if IS_COARSE:
                final = -tl.abs(tl.where(is_kept, after, transmittance))
                transmittance = tl.where(after > end, after, final)
            else:
                transmittance = tl.where(is_kept, after, -tl.abs(transmittance))
        row = following
        at += LANES
        # Of float32 numbers that are positive the bits are in the same order, which integers
        # compare in one step.
        is_open = (at < last) & (tl.max(tl.max(transmittance.to(tl.int32, bitcast=True), 0), 0) > 0)

    pixel = (y * width + first_x)[None, :] + steps
    covered = 1.0 - tl.abs(transmittance)
    tl.store(alpha + pixel, covered, mask=is_inside)
    if HAS_RGB:
        tl.store(rgb + 3 * pixel, red, mask=is_inside)
        tl.store(rgb + 3 * pixel + 1, green, mask=is_inside)
        tl.store(rgb + 3 * pixel + 2, blue, mask=is_inside)
    if HAS_EXPECTED:
        tl.store(expected + pixel, weighted_depth / tl.maximum(covered, DEPTH_EPS), mask=is_inside)
    if HAS_MEDIAN:
        tl.store(median + pixel, middle, mask=is_inside)
    if HAS_IDS:
        tl.store(ids + pixel, number, mask=is_inside)
    if HAS_MODE:
        z = heaviest_mode(first, mass, moment, square, best, best_mode)
        tl.store(mode + pixel, z, mask=is_inside)
    if HAS_OVERLAY:
        tl.store(overlay + pixel, white, mask=is_inside)


@triton.jit
def _quarter(pointers, which: tl.constexpr):
    """Numbers 4 which to 4 which + 3 of every row, in one read each. Rows begin at 16 bytes."""
    places = pointers[:, None] + (4 * which + tl.arange(0, 4))[None, :]
    numbers = tl.load(tl.multiple_of(places, (16, 16)))
    even, odd = tl.split(tl.reshape(numbers, (LANES, 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def _reaches(record, left, top, wide, high, log_cut):
    """Whether alpha may reach the cut at a pixel of the block at (left, top), wide + 1 x high + 1.

    Where the mean lies outside, alpha is largest on the side that faces it, in x or in y: there,
    where the ellipse's ridge crosses that side, or as near to it as the block goes.
    """
    mean_x, mean_y, lean_x, sharp_x = _quarter(record, 0)
    fall_y, log_opacity, _, _ = _quarter(record, 1)
    lean_y, _, _, _ = _quarter(record, 2)
    west, north = left.to(tl.float32) + 0.5 - mean_x, top.to(tl.float32) + 0.5 - mean_y
    east, south = west + wide, north + high
    x = tl.minimum(tl.maximum(0.0, west), east)
    y = tl.minimum(tl.maximum(0.0, north), south)
    y_there = tl.minimum(tl.maximum(lean_y * x, north), south)
    x_there = tl.minimum(tl.maximum(lean_x * y, west), east)
    off_x, off_y = sharp_x * (x - lean_x * y_there), sharp_x * (x_there - lean_x * y)
    by_x = off_x * off_x + fall_y * y_there * y_there
    by_y = off_y * off_y + fall_y * y * y
    return tl.minimum(by_x, by_y) <= log_opacity - log_cut + MARGIN


@triton.jit
def _light_share(lines, dx, dy, rim, inverse_fx2, inverse_fy2):
    """The share of the light (augment.render.shading). dx, dy: pixels from the mean; rim: D^2."""
    rim = tl.minimum(tl.maximum(rim, 0.0), 1.0)
    lean = tl.load(lines + L_LEAN_X) * dx + tl.load(lines + L_LEAN_Y) * dy
    away = inverse_fx2 * dx * dx + (lean * lean + (inverse_fy2 * dy * dy + TINY))
    tilt = tl.load(lines + L_X) * dx + tl.load(lines + L_Y) * dy
    share = tl.sqrt(rim / away) * tilt + tl.load(lines + L_WRAP)
    share = tl.sqrt(1.0 - rim) * tl.load(lines + L_FACING) + share
    return tl.minimum(tl.maximum(share, 0.0), 1.0)
