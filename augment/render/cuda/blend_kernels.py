"""Triton kernels that list splats tile by tile, blend them, and transpose the blend for gradients.

A program of `blend_blocks` is one warp and blends a block of a tile's pixels, several for each of
its threads, so that nothing ever waits for another warp. It takes its tile's list in batches of one
splat per thread. Each thread tests whether its splat's ellipse meets the block, and the warp blends
the splats that do, one after the other. The test also brings the records into the nearest cache,
where the blending finds them. A block ends when no light passes through any of its pixels.

`cuda.driver` and `cuda.backward` launch the kernels.
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
_MEAN_X = tl.constexpr(layout.MEAN_X)
_MEAN_Y = tl.constexpr(layout.MEAN_Y)
_LEAN_X = tl.constexpr(layout.LEAN_X)
_SHARP_X = tl.constexpr(layout.SHARP_X)
_FALL_Y = tl.constexpr(layout.FALL_Y)
_LOG_OPACITY = tl.constexpr(layout.LOG_OPACITY)
_RED = tl.constexpr(layout.RED)
_V_ROTATION = tl.constexpr(layout.V_ROTATION)
_V_EYE = tl.constexpr(layout.V_EYE)
_V_PARALLEL = tl.constexpr(layout.V_PARALLEL)


@triton.jit(do_not_specialize=["width", "height"])
def share_colors(
    records, tile_splat_ids, tile_offsets, d_rgb, shares, width, height, limits, BATCH: tl.constexpr
):
    """Sum weight times dL/d rgb over a tile's pixels, for each entry of its list; one program per
    tile.

    BATCH entries are processed at a time, all pixels of them, which leaves the products of
    transmittances as the only chain.

    Args:
        d_rgb: float32 [height, width, 3].
        shares: float32 [3, entries], zeros; written as far as light reaches.
        limits: as in blend_blocks.
    """
    alpha_max, log_cut, min_transmittance, stop = limits
    columns = (width + _TILE - 1) // _TILE
    tile = tl.program_id(0)
    entries = tl.load(tile_offsets + tl.num_programs(0)).to(tl.int64)  # three times as many places
    at = tl.load(tile_offsets + tile)
    last = tl.load(tile_offsets + tile + 1)
    pixel = tl.arange(0, _PIXELS)
    column = tile % columns * _TILE + pixel % _TILE
    row = tile // columns * _TILE + pixel // _TILE
    is_inside = (column < width) & (row < height)
    first = (row * width + column) * 3
    red = tl.load(d_rgb + first, mask=is_inside, other=0.0)[None, :]
    green = tl.load(d_rgb + first + 1, mask=is_inside, other=0.0)[None, :]
    blue = tl.load(d_rgb + first + 2, mask=is_inside, other=0.0)[None, :]
    x = (column.to(tl.float32) + 0.5)[None, :]
    y = (row.to(tl.float32) + 0.5)[None, :]
    transmittance = tl.where(is_inside, 1.0, 0.0)
    while (at < last) & (tl.max(transmittance, 0) > stop):
        entry = at + tl.arange(0, BATCH)
        is_listed = entry < last
        record = (
            records
            + tl.load(tile_splat_ids + entry, mask=is_listed, other=0).to(tl.int64) * _RECORD
        )
        log_opacity = tl.load(record + _LOG_OPACITY, mask=is_listed, other=float("-inf"))[:, None]
        mean_x = tl.load(record + _MEAN_X, mask=is_listed, other=0.0)[:, None]
        mean_y = tl.load(record + _MEAN_Y, mask=is_listed, other=0.0)[:, None]
        sharp = tl.load(record + _SHARP_X, mask=is_listed, other=0.0)[:, None]
        lean = tl.load(record + _LEAN_X, mask=is_listed, other=0.0)[:, None]
        fall = tl.load(record + _FALL_Y, mask=is_listed, other=0.0)[:, None]
        dy = y - mean_y
        off = sharp * (x - mean_x - lean * dy)
        log_alpha = log_opacity - off * off - fall * dy * dy
        alpha = tl.where(log_alpha >= log_cut, tl.minimum(tl.exp2(log_alpha), alpha_max), 0.0)
        pass_share = 1 - alpha
        transmittance_behind = transmittance[None, :] * tl.cumprod(pass_share, 0)
        transmittance_before = (
            transmittance_behind / pass_share
        )  # where not blended, this may be 0 / 0
        is_blended = (transmittance_behind > min_transmittance) & (transmittance_before > stop)
        weight = tl.where(is_blended, alpha * transmittance_before, 0.0)
        tl.store(shares + entry, tl.sum(weight * red, 1), mask=is_listed)
        tl.store(shares + entries + entry, tl.sum(weight * green, 1), mask=is_listed)
        tl.store(shares + 2 * entries + entry, tl.sum(weight * blue, 1), mask=is_listed)
        transmittance = tl.min(transmittance_behind, 0)
        at += BATCH


@triton.jit(do_not_specialize=["count", "entries"])
def sum_shares(
    shares,
    order,
    firsts,
    records,
    d_colors,
    count,
    entries,
    SPLATS: tl.constexpr,
    LANES: tl.constexpr,
):
    """Write dL by every splat's colour before its clamp at 0, float32 [count, 3].

    A splat's entries go to LANES sums in turn, which are then added as a tree.

    Args:
        order: int64 [entries], list entries splat by splat, in the order of the tiles.
        firsts: int64 [count + 1], position in order where each splat's entries begin.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_splat = splat < count
    first = tl.load(firsts + splat, mask=is_splat, other=0)
    last = tl.load(firsts + splat + 1, mask=is_splat, other=0)
    red = tl.zeros([SPLATS, LANES], tl.float32)
    green = tl.zeros([SPLATS, LANES], tl.float32)
    blue = tl.zeros([SPLATS, LANES], tl.float32)
    max_entries = tl.max(last - first, 0)
    place = first[:, None] + tl.arange(0, LANES)[None, :]
    num_done = max_entries * 0
    while num_done < max_entries:
        is_entry = place < last[:, None]
        entry = tl.load(order + place, mask=is_entry, other=0)
        red += tl.load(shares + entry, mask=is_entry, other=0.0)
        green += tl.load(shares + entries + entry, mask=is_entry, other=0.0)
        blue += tl.load(shares + 2 * entries + entry, mask=is_entry, other=0.0)
        place += LANES
        num_done += LANES
    for channel in tl.static_range(3):
        total = red if channel == 0 else (green if channel == 1 else blue)
        # Records of splats that are not drawn hold anything; their sums are 0 either way.
        color = tl.load(records + splat * _RECORD + _RED + channel, mask=is_splat, other=0.0)
        d_color = tl.where(color > 0, tl.sum(total, 1), 0.0)
        tl.store(d_colors + splat * 3 + channel, d_color, mask=is_splat)


@triton.jit(do_not_specialize=["count", "num_functions"])
def spread_to_sh(
    means,
    view,
    d_colors,
    d_sh,
    count,
    num_functions,
    SPLATS: tl.constexpr,
    VALUES: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Write dL by spherical harmonics: basis functions at each splat's direction times dL by its
    colour.

    Args:
        means: [count, 3] of one part.
        view: numbers of the part's view (layout's V_*).
        d_sh: float32 [count, VALUES], VALUES = 3 K, written; 0 from function `num_functions` on.
        COLUMNS: VALUES, or the power of two above it.
    """
    splat = tl.program_id(0).to(tl.int64) * SPLATS + tl.arange(0, SPLATS)
    is_splat = splat < count
    x = tl.load(view + _V_EYE)
    y = tl.load(view + _V_EYE + 1)
    z = tl.load(view + _V_EYE + 2)
    remainder_x = tl.load(view + _V_EYE + 3)
    remainder_y = tl.load(view + _V_EYE + 4)
    remainder_z = tl.load(view + _V_EYE + 5)
    x = tl.load(means + splat * 3, mask=is_splat, other=0.0) - x - remainder_x
    y = tl.load(means + splat * 3 + 1, mask=is_splat, other=0.0) - y - remainder_y
    z = tl.load(means + splat * 3 + 2, mask=is_splat, other=1.0) - z - remainder_z
    is_parallel = tl.load(view + _V_PARALLEL) != 0
    x = tl.where(is_parallel, tl.load(view + _V_ROTATION + 6), x)
    y = tl.where(is_parallel, tl.load(view + _V_ROTATION + 7), y)
    z = tl.where(is_parallel, tl.load(view + _V_ROTATION + 8), z)
    # Scaled first: a square of metres must neither overflow nor vanish.
    size = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    scale = tl.where(size > 0, 1 / size, 0.0)
    x = x * scale
    y = y * scale
    z = z * scale
    length = tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-30))
    x = (x / length)[:, None]
    y = (y / length)[:, None]
    z = (z / length)[:, None]
    functions = sh_basis(x, y, z, VALUES // 3)
    column = tl.arange(0, COLUMNS)[None, :]
    k = column // 3
    channel = column % 3
    basis = tl.zeros([SPLATS, COLUMNS], tl.float32)
    for number in tl.static_range(VALUES // 3):
        basis = tl.where(k == number, functions[number], basis)
    is_value = is_splat[:, None] & (column < VALUES)
    basis = tl.where(k < num_functions, basis, 0.0)
    color = tl.load(d_colors + splat[:, None] * 3 + channel, mask=is_value, other=0.0)
    tl.store(d_sh + splat[:, None] * VALUES + column, basis * color, mask=is_value)


# ---- Triton kernels: the tiles of splats that are in order of depth, pair by pair ----------------


@triton.jit(do_not_specialize=["count", "columns"])
def count_tiles(order, counts, rects, sums, sorted_counts, count, columns, BLOCK: tl.constexpr):
    """Write the number of tiles in which each splat is listed, nearest splat first.

    Args:
        order: int64 [count], rows of CudaSplats.
        counts, rects: as in CudaSplats.
        sums: int32 [rows + 1, columns + 1], drawn tiles above and to the left, or None. A splat
            without a drawn tile counts none.
        sorted_counts: int32 [count], written.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_splat = at < count
    row = tl.load(order + at, mask=is_splat, other=0)
    tiles = tl.load(counts + row, mask=is_splat, other=0)
    if sums is not None:
        is_drawn = is_splat & (tiles > 0)
        first = tl.load(rects + 2 * row, mask=is_drawn, other=0)
        last = tl.load(rects + 2 * row + 1, mask=is_drawn, other=0)
        left = first & 0xFFFF
        right = (last & 0xFFFF) + 1
        top = (first >> 16) * (columns + 1)
        bottom = ((last >> 16) + 1) * (columns + 1)
        num_drawn_tiles = (
            tl.load(sums + bottom + right, mask=is_drawn, other=0)
            - tl.load(sums + top + right, mask=is_drawn, other=0)
            - tl.load(sums + bottom + left, mask=is_drawn, other=0)
            + tl.load(sums + top + left, mask=is_drawn, other=0)
        )
        tiles = tl.where(num_drawn_tiles > 0, tiles, 0)
    tl.store(sorted_counts + at, tiles, mask=is_splat)


@triton.jit(do_not_specialize=["pairs", "count", "steps", "columns", "no_tile"])
def list_pairs(
    order,
    ends,
    rects,
    is_tile_drawn,
    tiles,
    owners,
    pairs,
    count,
    steps,
    columns,
    no_tile,
    BLOCK: tl.constexpr,
):
    """Write every pair of a splat and a tile, nearest splat first, the tiles of each splat row by
    row.

    Args:
        order: as in count_tiles.
        ends: int64 [count], number of pairs up to each splat, itself included.
        steps: halvings that leave one of `count` splats.
        is_tile_drawn: bool [tiles], or None for all.
        tiles: [pairs], written: the tile, `no_tile` if it is not drawn.
        owners: [pairs], written: the row of CudaSplats.
    """
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    is_pair = pair < pairs
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
    is_pair = is_pair & (low < count)
    row = tl.load(order + low, mask=is_pair, other=0)
    begin = tl.load(ends + low - 1, mask=is_pair & (low > 0), other=0)
    first = tl.load(rects + 2 * row, mask=is_pair, other=0)
    last = tl.load(rects + 2 * row + 1, mask=is_pair, other=0)
    width = (last & 0xFFFF) - (first & 0xFFFF) + 1
    tile_in_rect = (pair - begin).to(tl.int32)
    row_in_rect = tile_in_rect // width
    tile = (
        ((first >> 16) + row_in_rect) * columns
        + (first & 0xFFFF)
        + tile_in_rect
        - row_in_rect * width
    )
    if is_tile_drawn is not None:
        is_drawn = tl.load(is_tile_drawn + tile, mask=is_pair, other=0)
        tile = tl.where(is_drawn != 0, tile, no_tile)
    tl.store(tiles + pair, tile.to(tiles.dtype.element_ty), mask=is_pair)
    tl.store(owners + pair, row.to(tl.int32), mask=is_pair)


# --------------------------------------------------------------------------------------------------
# Triton functions: mode depth (augment.render.mode_depth), one sample of every pixel at a time..
# Sums are kept times the cluster's weight, so that a sample that joins costs no division and no
# root.

FARTHER = tl.constexpr(mode_depth.FARTHER)
NEARER = tl.constexpr(mode_depth.NEARER)
FARTHER_2 = tl.constexpr((mode_depth.FARTHER * mode_depth.BETA_PER_SIGMA) ** 2)
NEARER_2 = tl.constexpr((mode_depth.NEARER * mode_depth.BETA_PER_SIGMA) ** 2)
MODE_SHIFT = tl.constexpr(mode_depth.GAMMA * mode_depth.BETA_PER_SIGMA)
SLACK = tl.constexpr(1e-4)  # what rounding may add to a sum of weights; far more than it does


@triton.jit
def add_sample(depth, weight, floor, first, mass, moment, square, best, best_mode):
    """Return the clusters with every pixel's next sample; samples of weight 0 change nothing.

    Args:
        depth, weight: the samples.
        floor: floor of beta.
        first, mass, moment, square: of the running cluster, the depth with which it began, and the
            sums of w, w (z - first) and w (z - first)^2.
        best, best_mode: weight and mode of the heaviest closed cluster.
    """
    depth_offset = depth - first
    mass_offset = depth_offset * mass - moment  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = mass_offset >= 0
    reach = tl.where(is_farther, FARTHER, NEARER)
    reach_2 = tl.where(is_farther, FARTHER_2, NEARER_2)
    floor_margin = floor * reach * mass - tl.abs(mass_offset)
    spread_margin = reach_2 * spread - mass_offset * mass_offset
    is_new = (weight > 0) & (tl.maximum(floor_margin, spread_margin) <= 0)
    if tl.max(tl.max(is_new.to(tl.int32), 0), 0) > 0:
        is_best = is_new & (mass > best)
        best_mode = tl.where(is_best, _mode(first, mass, moment, spread), best_mode)
        best = tl.where(is_best, mass, best)
        first = tl.where(is_new, depth, first)
        depth_offset = tl.where(is_new, 0.0, depth_offset)
        mass = tl.where(is_new, 0.0, mass)
        moment = tl.where(is_new, 0.0, moment)
        square = tl.where(is_new, 0.0, square)
    weighted = weight * depth_offset
    return (
        first,
        mass + weight,
        moment + weighted,
        square + weighted * depth_offset,
        best,
        best_mode,
    )


@triton.jit
def can_grow(transmittance, mass, best):
    """Return True where a pixel's running cluster is the heaviest or may become it.

    transmittance: transmittance of the pixels, negative where blending has stopped.
    """
    return (transmittance > 0) & (mass + transmittance + SLACK >= best)


@triton.jit
def heaviest_mode(first, mass, moment, square, best, best_mode):
    """Return the mode of the heaviest cluster, the running one included; 0 without a cluster."""
    last = _mode(first, mass, moment, _spread(mass, moment, square))
    return tl.where(mass > best, last, best_mode)


@triton.jit
def _spread(mass, moment, square):
    """Return mass^2 times the variance."""
    return tl.maximum(mass * square - moment * moment, 0.0)


@triton.jit
def _mode(first, mass, moment, spread):
    """Return the mode of a cluster."""
    return first + (moment - MODE_SHIFT * tl.sqrt(spread)) / tl.where(mass > 0, mass, 1.0)


# Records and cuts are read four numbers at a time, in their order (the launch module checks it).
DEPTH_EPS = tl.constexpr(constants.DEPTH_EPS)
RECORD = tl.constexpr(layout.RECORD)
CUT = tl.constexpr(layout.CUT)
LINES = tl.constexpr(cpu_geometry.SHADING_LINES)
L_FACING = tl.constexpr(cpu_geometry.L_FACING)
L_X = tl.constexpr(cpu_geometry.L_X)
L_Y = tl.constexpr(cpu_geometry.L_Y)
L_WRAP = tl.constexpr(cpu_geometry.L_WRAP)
L_LEAN_X = tl.constexpr(cpu_geometry.L_LEAN_X)
L_LEAN_Y = tl.constexpr(cpu_geometry.L_LEAN_Y)
L_RED = tl.constexpr(cpu_geometry.L_RED)
L_GREEN = tl.constexpr(cpu_geometry.L_GREEN)
L_BLUE = tl.constexpr(cpu_geometry.L_BLUE)
TINY = tl.constexpr(1e-20)  # augment.render.shading.TINY
LANES = tl.constexpr(32)  # threads of a warp, splats looked at together, bits of an int32
# Rounding must not lose a pixel: splats that stay this far below the cut (log2 of alpha) anywhere
# in a block are left out, others tried.
MARGIN = tl.constexpr(0.0625)


@triton.jit(do_not_specialize=["width", "height"])
def blend_blocks(
    splats,
    tile_splat_ids,
    tile_offsets,
    images,
    width,
    height,
    limits,
    lens,
    IS_COARSE: tl.constexpr,
    BLOCK_W: tl.constexpr,
    BLOCK_H: tl.constexpr,
):
    """Blend one block of BLOCK_W x BLOCK_H pixels of a tile; a tile's blocks are neighbours.

    Args:
        splats: records, cuts and lights of CudaSplats; cuts and lights may be None.
        tile_splat_ids, tile_offsets: as in CudaTiles.
        images: in the order of BUFFERS; None for an image that is not asked for.
        limits: alpha_max, log2(ALPHA_MIN), transmittance that a splat must exceed behind it to be
            blended, and transmittance at which a pixel is finished.
        lens: 1 for parallel rays, else 0; mode depth's floor; 1/fx^2; 1/fy^2.
        IS_COARSE: True if the two transmittances differ.
    """
    records, cuts, lights = splats
    rgb, alpha, expected, median, ids, mode, overlay = images
    alpha_max, log_cut, min_transmittance, stop = limits
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
    blocks_per_row = _TILE // BLOCK_W
    blocks = blocks_per_row * (_TILE // BLOCK_H)
    tile = tl.program_id(0) // blocks
    block = tl.program_id(0) % blocks
    left = tile % columns * _TILE + block % blocks_per_row * BLOCK_W
    top = tile // columns * _TILE + block // blocks_per_row * BLOCK_H

    # Axis 1 runs over the warp's threads. The pixels of each, axis 0, lie in one row, in even
    # steps: what a splat is in a row is found once a thread, and the steps are constants.
    STEP: tl.constexpr = LANES // BLOCK_H
    EACH: tl.constexpr = BLOCK_W // STEP
    lanes = tl.arange(0, LANES)
    steps = (tl.arange(0, EACH) * STEP)[:, None]
    first_x = left + lanes % STEP
    y = top + lanes // STEP
    is_inside = (first_x[None, :] + steps < width) & (y < height)[None, :]
    # the first pixel's centre
    west = first_x.to(tl.float32) + 0.5
    north = y.to(tl.float32) + 0.5
    ahead = steps.to(tl.float32)
    no_light = tl.zeros([EACH, LANES], tl.float32)
    # Negative where the pixel is finished; its size is then the final transmittance.
    transmittance = tl.where(is_inside, 1.0, -1.0)
    red = no_light
    green = no_light
    blue = no_light
    overlay_weight = no_light
    weighted_depth = no_light
    median_depth = no_light
    heaviest = no_light
    number = tl.full([EACH, LANES], -1, tl.int32)
    first = no_light
    mass = no_light
    moment = no_light
    square = no_light
    best = no_light
    best_mode = no_light

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
        does_reach = is_listed & _reaches(
            records + row.to(tl.int64) * RECORD, left, top, BLOCK_W - 1, BLOCK_H - 1, log_cut
        )
        reach_bits = tl.sum(tl.where(does_reach, 1 << lanes, 0), 0)  # one bit a splat
        # Behind what outweighs all that is left, samples cannot change the mode.
        grows = HAS_MODE
        if HAS_MODE:
            grows = tl.max(tl.max(can_grow(transmittance, mass, best).to(tl.int32), 0), 0) > 0
        while reach_bits != 0:
            lowest = (reach_bits & -reach_bits).to(tl.uint32, bitcast=True)
            reach_bits = reach_bits & (reach_bits - 1)
            # The exponent of a power of two says which it is.
            k = (lowest.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 127
            slot = tl.load(tile_splat_ids + at + k).to(tl.int64)
            # Every thread reads the whole record, which costs a warp no more than one of them.
            record = (records + slot * RECORD) + tl.zeros([LANES], tl.int32)
            mean_x, mean_y, lean_x, sharp_x = _quarter(record, 0)
            fall_y, log_opacity, _, _ = _quarter(record, 1)

            # log2 of alpha: e = peak - off^2, peak and where off begins being one a row.
            dx = west - mean_x
            dy = north - mean_y
            peak = log_opacity - fall_y * dy * dy
            off = (sharp_x * dx - sharp_x * lean_x * dy)[None, :] + sharp_x[None, :] * ahead
            log_alpha = peak[None, :] - off * off
            alpha_at_pixels = tl.where(
                log_alpha >= log_cut, tl.minimum(tl.exp2(log_alpha), alpha_max), 0.0
            )
            if HAS_CUTS:
                cut = (cuts + slot * CUT) + tl.zeros([LANES], tl.int32)
                value_at_mean, slope_x, slope_y, right = _quarter(cut, 0)
                share = (value_at_mean + slope_x * dx + slope_y * dy)[None, :] + slope_x[
                    None, :
                ] * ahead
                alpha_at_pixels *= tl.minimum(tl.maximum(share, 0.0), 1.0)
            weight = alpha_at_pixels * transmittance
            transmittance_behind = transmittance - weight
            is_blended = transmittance_behind > min_transmittance
            weight = tl.where(is_blended, weight, 0.0)

            if HAS_RGB or HAS_OVERLAY:
                splat_red, splat_green, splat_blue, is_overlay = _quarter(record, 3)
            if HAS_RGB:
                red += weight * splat_red[None, :]
                green += weight * splat_green[None, :]
                blue += weight * splat_blue[None, :]
            if HAS_OVERLAY:
                overlay_weight += weight * is_overlay[None, :]
            if HAS_EXPECTED or HAS_MEDIAN or HAS_MODE or HAS_IDS:
                _, _, depth, splat_id = _quarter(record, 2)
            if HAS_EXPECTED or HAS_MODE:
                if HAS_CUTS:
                    down, max_growth, _, _ = _quarter(cut, 1)
                    growth = (right * dx + down * dy)[None, :] + right[None, :] * ahead
                    growth = tl.minimum(
                        tl.maximum(growth, -max_growth[None, :]), max_growth[None, :]
                    )
                    z = depth[None, :] + parallel * growth
                    z = z / (1.0 - (1.0 - parallel) * growth)
                else:
                    z = no_light + depth[None, :]
                if HAS_EXPECTED:
                    weighted_depth += weight * z
                if grows:
                    first, mass, moment, square, best, best_mode = add_sample(
                        z, weight, floor, first, mass, moment, square, best, best_mode
                    )
            if HAS_MEDIAN:
                is_crossed = is_blended & (transmittance >= 0.5) & (transmittance_behind < 0.5)
                median_depth = tl.where(is_crossed, depth[None, :], median_depth)
            if HAS_IDS:
                is_heavier = weight > heaviest
                heaviest = tl.where(is_heavier, weight, heaviest)
                number = tl.where(is_heavier, splat_id.to(tl.int32, bitcast=True)[None, :], number)
            if HAS_LIGHTS:  # last, when most of what is above need not be kept
                lines = lights + slot * LINES
                more_red = tl.load(lines + L_RED)
                more_green = tl.load(lines + L_GREEN)
                more_blue = tl.load(lines + L_BLUE)
                if tl.abs(more_red) + tl.abs(more_green) + tl.abs(more_blue) > 0:
                    reach = tl.maximum(log_opacity - log_cut, TINY)[None, :]
                    rim = (log_opacity[None, :] - log_alpha) / reach
                    column_offset = dx[None, :] + ahead
                    share = _light_share(
                        lines, column_offset, dy[None, :], rim, inverse_fx2, inverse_fy2
                    )
                    red += weight * share * more_red
                    green += weight * share * more_green
                    blue += weight * share * more_blue
            if IS_COARSE:
                final = -tl.abs(tl.where(is_blended, transmittance_behind, transmittance))
                transmittance = tl.where(transmittance_behind > stop, transmittance_behind, final)
            else:
                transmittance = tl.where(is_blended, transmittance_behind, -tl.abs(transmittance))
        row = following
        at += LANES
        # Of float32 numbers that are positive the bits are in the same order, which integers
        # compare in one step.
        is_open = (at < last) & (tl.max(tl.max(transmittance.to(tl.int32, bitcast=True), 0), 0) > 0)

    pixel = (y * width + first_x)[None, :] + steps
    opacity = 1.0 - tl.abs(transmittance)
    tl.store(alpha + pixel, opacity, mask=is_inside)
    if HAS_RGB:
        tl.store(rgb + 3 * pixel, red, mask=is_inside)
        tl.store(rgb + 3 * pixel + 1, green, mask=is_inside)
        tl.store(rgb + 3 * pixel + 2, blue, mask=is_inside)
    if HAS_EXPECTED:
        tl.store(expected + pixel, weighted_depth / tl.maximum(opacity, DEPTH_EPS), mask=is_inside)
    if HAS_MEDIAN:
        tl.store(median + pixel, median_depth, mask=is_inside)
    if HAS_IDS:
        tl.store(ids + pixel, number, mask=is_inside)
    if HAS_MODE:
        z = heaviest_mode(first, mass, moment, square, best, best_mode)
        tl.store(mode + pixel, z, mask=is_inside)
    if HAS_OVERLAY:
        tl.store(overlay + pixel, overlay_weight, mask=is_inside)


@triton.jit
def _quarter(pointers, which: tl.constexpr):
    """Return the numbers 4 which to 4 which + 3 of every row, in one read of 16 aligned bytes."""
    places = pointers[:, None] + (4 * which + tl.arange(0, 4))[None, :]
    numbers = tl.load(tl.multiple_of(places, (16, 16)))
    even, odd = tl.split(tl.reshape(numbers, (LANES, 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def _reaches(record, left, top, wide, high, log_cut):
    """Return True where alpha may reach the cut at a pixel of the block (wide + 1 x high + 1
    pixels).

    If the mean lies outside, alpha is largest on the side that faces it, in x or in y. On that side
    it is largest where the ellipse's ridge crosses it, or at the nearest pixel of the block.
    """
    mean_x, mean_y, lean_x, sharp_x = _quarter(record, 0)
    fall_y, log_opacity, _, _ = _quarter(record, 1)
    lean_y, _, _, _ = _quarter(record, 2)
    west = left.to(tl.float32) + 0.5 - mean_x
    north = top.to(tl.float32) + 0.5 - mean_y
    east = west + wide
    south = north + high
    x = tl.minimum(tl.maximum(0.0, west), east)
    y = tl.minimum(tl.maximum(0.0, north), south)
    ridge_y = tl.minimum(tl.maximum(lean_y * x, north), south)
    ridge_x = tl.minimum(tl.maximum(lean_x * y, west), east)
    off_x = sharp_x * (x - lean_x * ridge_y)
    off_y = sharp_x * (ridge_x - lean_x * y)
    by_x = off_x * off_x + fall_y * ridge_y * ridge_y
    by_y = off_y * off_y + fall_y * y * y
    return tl.minimum(by_x, by_y) <= log_opacity - log_cut + MARGIN


@triton.jit
def _light_share(lines, dx, dy, rim_share, inverse_fx2, inverse_fy2):
    """Return the share of the light (augment.render.shading).

    dx, dy: pixels from the mean. rim: D^2.
    """
    rim_share = tl.minimum(tl.maximum(rim_share, 0.0), 1.0)
    lean = tl.load(lines + L_LEAN_X) * dx + tl.load(lines + L_LEAN_Y) * dy
    distance_squared = inverse_fx2 * dx * dx + (lean * lean + (inverse_fy2 * dy * dy + TINY))
    tilt = tl.load(lines + L_X) * dx + tl.load(lines + L_Y) * dy
    share = tl.sqrt(rim_share / distance_squared) * tilt + tl.load(lines + L_WRAP)
    share = tl.sqrt(1.0 - rim_share) * tl.load(lines + L_FACING) + share
    return tl.minimum(tl.maximum(share, 0.0), 1.0)
