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

from augment.render import constants, cpu_clip, cpu_shading, cuda_splats, layout
from augment.render.cuda_mode_kernels import add_sample, can_grow, heaviest_mode

TILE = tl.constexpr(cuda_splats.TILE)
DEPTH_EPS = tl.constexpr(constants.DEPTH_EPS)
RECORD, CUT, LINES = (
    tl.constexpr(layout.RECORD),
    tl.constexpr(cpu_clip.CUT),
    tl.constexpr(cpu_shading.LINES),
)
MEAN_X, MEAN_Y = tl.constexpr(layout.MEAN_X), tl.constexpr(layout.MEAN_Y)
LEAN_X, SHARP_X = tl.constexpr(layout.LEAN_X), tl.constexpr(layout.SHARP_X)
FALL_Y, LOG_OPACITY = tl.constexpr(layout.FALL_Y), tl.constexpr(layout.LOG_OPACITY)
LEAN_Y, DEPTH, SPLAT_ID, IS_SNOW = (
    tl.constexpr(layout.LEAN_Y),
    tl.constexpr(layout.DEPTH),
    tl.constexpr(layout.SPLAT_ID),
    tl.constexpr(layout.IS_SNOW),
)
RED, GREEN, BLUE = (
    tl.constexpr(layout.RED),
    tl.constexpr(layout.GREEN),
    tl.constexpr(layout.BLUE),
)
C_AT, C_X, C_Y = tl.constexpr(cpu_clip.C_AT), tl.constexpr(cpu_clip.C_X), tl.constexpr(cpu_clip.C_Y)
C_RIGHT, C_DOWN, C_REACH = (
    tl.constexpr(cpu_clip.C_RIGHT),
    tl.constexpr(cpu_clip.C_DOWN),
    tl.constexpr(cpu_clip.C_REACH),
)
L_FACING, L_X, L_Y, L_WRAP = (
    tl.constexpr(cpu_shading.L_FACING),
    tl.constexpr(cpu_shading.L_X),
    tl.constexpr(cpu_shading.L_Y),
    tl.constexpr(cpu_shading.L_WRAP),
)
L_LEAN_X, L_LEAN_Y = tl.constexpr(cpu_shading.L_LEAN_X), tl.constexpr(cpu_shading.L_LEAN_Y)
L_RED, L_GREEN, L_BLUE = (
    tl.constexpr(cpu_shading.L_RED),
    tl.constexpr(cpu_shading.L_GREEN),
    tl.constexpr(cpu_shading.L_BLUE),
)
TINY = tl.constexpr(1e-20)  # augment.render.shading.TINY
BATCH = tl.constexpr(32)  # splats looked at together: the bits of an int32
# Rounding must not lose a pixel: splats that stay this far below the cut (log2 of alpha) anywhere
# in a block are left out, others tried.
MARGIN = tl.constexpr(0.0625)


@triton.jit(do_not_specialize=["width", "height", "columns"])
def blend_blocks(
    records,
    members,
    starts,
    cuts,
    lights,
    rgb,
    alpha,
    expected,
    median,
    ids,
    mode,
    snow,
    width,
    height,
    columns,
    alpha_max,
    log_cut,
    least,
    end,
    parallel,
    floor,
    inverse_fx2,
    inverse_fy2,
    HAS_CUTS: tl.constexpr,
    HAS_LIGHTS: tl.constexpr,
    HAS_RGB: tl.constexpr,
    HAS_EXPECTED: tl.constexpr,
    HAS_MEDIAN: tl.constexpr,
    HAS_IDS: tl.constexpr,
    HAS_MODE: tl.constexpr,
    HAS_SNOW: tl.constexpr,
    IS_COARSE: tl.constexpr,
    BLOCK_W: tl.constexpr,
    BLOCK_H: tl.constexpr,
):
    """Blend one block of BLOCK_W x BLOCK_H pixels of a tile; a tile's blocks are neighbours.

    records, cuts, lights: as in CudaSplats. members, starts: as in CudaTiles. rgb to snow: images;
    of those that are not asked for, and of cuts and lights that are not there, nothing is read or
    written. width, height: of the image; columns: of its tiles. least: what a splat must leave more
    of than this to be blended. end: the transmittance at which a pixel is finished; IS_COARSE
    where it is not `least`. parallel: 1 where rays are parallel, else 0. floor: mode depth's.
    """
    across = TILE // BLOCK_W
    blocks = across * (TILE // BLOCK_H)
    tile, block = tl.program_id(0) // blocks, tl.program_id(0) % blocks
    left = tile % columns * TILE + block % across * BLOCK_W
    top = tile // columns * TILE + block // across * BLOCK_H
    west, north = left.to(tl.float32) + 0.5, top.to(tl.float32) + 0.5  # its first pixel's centre

    # Axis 1 runs over threads first, so that a thread's pixels lie in one row, and what a splat is
    # in a row is found once a thread.
    i, j = tl.arange(0, BLOCK_W)[:, None], tl.arange(0, BLOCK_H)[None, :]
    x, y = i.to(tl.float32), j.to(tl.float32)
    is_inside = (left + i < width) & (top + j < height)
    nothing = tl.zeros([BLOCK_W, BLOCK_H], tl.float32)
    # Negative where the pixel is finished; its size is then the final transmittance.
    through = tl.where(is_inside, 1.0, -1.0)
    red, green, blue, white = nothing, nothing, nothing, nothing
    weighted_depth, middle, heaviest = nothing, nothing, nothing
    number = tl.full([BLOCK_W, BLOCK_H], -1, tl.int32)
    first, mass, moment, square = nothing, nothing, nothing, nothing
    best, best_first, best_moment, best_spread = nothing, nothing, nothing, nothing

    at = tl.load(starts + tile)
    last = tl.load(starts + tile + 1)
    lanes = tl.arange(0, BATCH)
    is_open = at < last
    while is_open:
        row = tl.load(members + at + lanes, mask=at + lanes < last, other=0)
        reaches = _reaches(
            records + row.to(tl.int64) * RECORD, west, north, BLOCK_W - 1, BLOCK_H - 1, log_cut
        )
        reaches = reaches & (at + lanes < last)
        left_over = tl.sum(tl.where(reaches, 1 << lanes, 0), 0)  # one bit a splat
        # Behind what outweighs all that is left, samples cannot change the mode.
        grows = HAS_MODE
        if HAS_MODE:
            grows = tl.max(tl.max(can_grow(through, mass, best).to(tl.int32), 0), 0) > 0
        while left_over != 0:
            lowest = (left_over & -left_over).to(tl.uint32, bitcast=True)
            left_over = left_over & (left_over - 1)
            # The exponent of a power of two says which it is.
            k = (lowest.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 127
            slot = tl.load(members + at + k).to(tl.int64)
            record = records + slot * RECORD

            # log2 of alpha: e = peak - off^2, peak and where off begins being one a row.
            mean_x, mean_y = tl.load(record + MEAN_X), tl.load(record + MEAN_Y)
            sharp, opacity = tl.load(record + SHARP_X), tl.load(record + LOG_OPACITY)
            dy = y + (north - mean_y)
            peak = opacity - tl.load(record + FALL_Y) * dy * dy
            begin = sharp * (west - mean_x) - sharp * tl.load(record + LEAN_X) * dy
            off = sharp * x + begin
            e = peak - off * off
            a = tl.where(e >= log_cut, tl.minimum(tl.exp2(e), alpha_max), 0.0)
            if HAS_CUTS:
                cut = cuts + slot * CUT
                slope_x, slope_y = tl.load(cut + C_X), tl.load(cut + C_Y)
                share = slope_y * dy + (tl.load(cut + C_AT) + slope_x * (west - mean_x))
                a *= tl.minimum(tl.maximum(slope_x * x + share, 0.0), 1.0)
            weight = a * through
            after = through - weight
            is_kept = after > least
            weight = tl.where(is_kept, weight, 0.0)

            if HAS_RGB:
                red += weight * tl.load(record + RED)
                green += weight * tl.load(record + GREEN)
                blue += weight * tl.load(record + BLUE)
                if HAS_LIGHTS:
                    lines = lights + slot * LINES
                    more_red, more_green = tl.load(lines + L_RED), tl.load(lines + L_GREEN)
                    more_blue = tl.load(lines + L_BLUE)
                    if tl.abs(more_red) + tl.abs(more_green) + tl.abs(more_blue) > 0:
                        dx = x + (west - mean_x)
                        rim = (opacity - e) / tl.maximum(opacity - log_cut, TINY)
                        lit = weight * _light_share(lines, dx, dy, rim, inverse_fx2, inverse_fy2)
                        red += lit * more_red
                        green += lit * more_green
                        blue += lit * more_blue
            if HAS_SNOW:
                white += weight * tl.load(record + IS_SNOW)
            if HAS_EXPECTED or HAS_MEDIAN or HAS_MODE:
                centre = tl.load(record + DEPTH)
            if HAS_EXPECTED or HAS_MODE:
                if HAS_CUTS:
                    growth = tl.load(cut + C_RIGHT) * (x + (west - mean_x))
                    growth += tl.load(cut + C_DOWN) * dy
                    most = tl.load(cut + C_REACH)
                    growth = tl.minimum(tl.maximum(growth, -most), most)
                    z = (centre + parallel * growth) / (1.0 - (1.0 - parallel) * growth)
                else:
                    z = nothing + centre
                if HAS_EXPECTED:
                    weighted_depth += weight * z
                if grows:
                    first, mass, moment, square, best, best_first, best_moment, best_spread = (
                        add_sample(
                            z, weight, floor, first, mass, moment, square,
                            best, best_first, best_moment, best_spread,
                        )
                    )  # fmt: skip
            if HAS_MEDIAN:
                is_crossed = is_kept & (through >= 0.5) & (after < 0.5)
                middle = tl.where(is_crossed, centre, middle)
            if HAS_IDS:
                is_heavier = weight > heaviest
                heaviest = tl.where(is_heavier, weight, heaviest)
                own = tl.load(record + SPLAT_ID).to(tl.int32, bitcast=True)
                number = tl.where(is_heavier, own, number)
            if IS_COARSE:
                final = -tl.abs(tl.where(is_kept, after, through))
                through = tl.where(after > end, after, final)
            else:
                through = tl.where(is_kept, after, -tl.abs(through))
        at += BATCH
        # Of float32 numbers that are positive the bits are in the same order, which integers
        # compare in one step.
        is_open = (at < last) & (tl.max(tl.max(through.to(tl.int32, bitcast=True), 0), 0) > 0)

    pixel = (top + j) * width + left + i
    covered = 1.0 - tl.abs(through)
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
        depth = heaviest_mode(
            first, mass, moment, square, best, best_first, best_moment, best_spread
        )
        tl.store(mode + pixel, depth, mask=is_inside)
    if HAS_SNOW:
        tl.store(snow + pixel, white, mask=is_inside)


@triton.jit
def _reaches(record, west, north, wide, high, log_cut):
    """Whether alpha may reach the cut at a pixel of the block, wide x high from its first centre.

    Where the mean lies outside, alpha is largest on the side that faces it, in x or in y: there,
    where the ellipse's ridge crosses that side, or as near to it as the block goes.
    """
    left = west - tl.load(record + MEAN_X)
    up = north - tl.load(record + MEAN_Y)
    right, down = left + wide, up + high
    x = tl.minimum(tl.maximum(0.0, left), right)
    y = tl.minimum(tl.maximum(0.0, up), down)
    lean = tl.load(record + LEAN_X)
    sharp, fall = tl.load(record + SHARP_X), tl.load(record + FALL_Y)
    above = tl.load(record + LOG_OPACITY) - log_cut + MARGIN
    y_there = tl.minimum(tl.maximum(tl.load(record + LEAN_Y) * x, up), down)
    x_there = tl.minimum(tl.maximum(lean * y, left), right)
    across, along = sharp * (x - lean * y_there), sharp * (x_there - lean * y)
    by_x = across * across + fall * y_there * y_there
    by_y = along * along + fall * y * y
    return tl.minimum(by_x, by_y) <= above


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
