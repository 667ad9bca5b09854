"""Triton kernels that put the layers of a flooded view together: what `pour` defines.

Programs take LANES pixels one after the other, row by row.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather.cuda_rows_kernels import falls


@triton.jit
def find_water(rows, alpha, width, count, shown, water, LANES: tl.constexpr):
    """water [H, W] uint8: 1 where a ray falls and alpha leaves more than half of it, else 0.

    shown [programs]: the largest share of a falling ray that alpha leaves in each, 0 where none
    falls. count: of pixels.
    """
    program = tl.program_id(0)
    pixel = program * LANES + tl.arange(0, LANES)
    inside = pixel < count
    row = pixel // width
    share = 1.0 - tl.load(alpha + pixel, mask=inside, other=1.0)
    share = tl.where(falls(rows, row, pixel - row * width, inside), share, 0.0)
    tl.store(water + pixel, (share > 0.5).to(tl.uint8), mask=inside)
    tl.store(shown + program, tl.max(share, 0))


@triton.jit(do_not_specialize=["dry", "left", "top", "right", "bottom"])
def pour(
    rows, alpha, color, sky, dry, left, top, right, bottom, width, count, rgb, LANES: tl.constexpr
):
    """rgb [H, W, 3] += (1 - alpha) color where rays fall; elsewhere it becomes that of `sky`.

    color: [h, w, 3], of the rows top to bottom - 1 and columns left to right - 1, which contain all
    pixels whose rays fall. sky: the first `dry` rows, which contain all whose rays do not.
    """
    pixel = tl.program_id(0) * LANES + tl.arange(0, LANES)
    inside = pixel < count
    row = pixel // width
    column = pixel - row * width
    wet = falls(rows, row, column, inside)
    wet = wet & (row >= top) & (row < bottom) & (column >= left) & (column < right)
    rest = inside & (wet == 0) & (row < dry)
    through = 1.0 - tl.load(alpha + pixel, mask=wet, other=0.0)
    own = 3 * ((row - top) * (right - left) + (column - left))
    for channel in tl.static_range(3):
        at = 3 * pixel + channel
        seen = tl.load(rgb + at, mask=wet, other=0.0)
        seen += through * tl.load(color + own + channel, mask=wet, other=0.0)
        seen = tl.where(wet, seen, tl.load(sky + at, mask=rest, other=0.0))
        tl.store(rgb + at, seen, mask=wet | rest)


@triton.jit(
    do_not_specialize=[
        "left", "top", "behind_left", "behind_top", "wide", "count", "behind_width"
    ]
)  # fmt: skip
def join(
    alpha, behind_alpha, depth, behind_depth, a, behind_a, b, behind_b, c, behind_c, d, behind_d,
    least, left, top, behind_left, behind_top, wide, count, width, behind_width,
    HAS_DEPTH: tl.constexpr, OTHERS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Buffers of two layers as one scene's, in place, where a window behind lies over the image.

    alpha, depth (expected): of both together. a to d: OTHERS buffers of 32 bits, which become those
    of the layer that covers more of a pixel. wide, count: columns and pixels that both share, whose
    first is (left, top) in the image and (behind_left, behind_top) behind.
    """
    shared = tl.program_id(0) * LANES + tl.arange(0, LANES)
    inside = shared < count
    row = shared // wide
    column = shared - row * wide
    here = (row + top) * width + column + left
    there = (row + behind_top) * behind_width + column + behind_left
    own = tl.load(alpha + here, mask=inside, other=0.0)
    share = (1.0 - own) * tl.load(behind_alpha + there, mask=inside, other=0.0)
    if HAS_DEPTH:
        total = own * tl.load(depth + here, mask=inside, other=0.0)
        total += share * tl.load(behind_depth + there, mask=inside, other=0.0)
        tl.store(depth + here, total / tl.maximum(own + share, least), mask=inside)
    hidden = inside & (share > own)
    if OTHERS > 0:
        tl.store(a + here, tl.load(behind_a + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 1:
        tl.store(b + here, tl.load(behind_b + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 2:
        tl.store(c + here, tl.load(behind_c + there, mask=hidden, other=0), mask=hidden)
    if OTHERS > 3:
        tl.store(d + here, tl.load(behind_d + there, mask=hidden, other=0), mask=hidden)
    tl.store(alpha + here, own + share, mask=inside)
