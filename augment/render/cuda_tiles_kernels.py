"""Triton kernels: the tiles of splats that are in order of depth, pair by pair."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["count", "columns"])
def count_tiles(
    order,
    counts,
    rects,
    sums,
    sorted_counts,
    count,
    columns,
    IS_PARTIAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """How many tiles each splat is listed in, nearest splat first.

    order: int64 [count], rows of CudaSplats. counts, rects: as there. sums: int32 [rows + 1,
    columns + 1], wanted tiles above and to the left; read where IS_PARTIAL: splats without a wanted
    tile count none. sorted_counts: int32 [count], written.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_there = at < count
    row = tl.load(order + at, mask=is_there, other=0)
    tiles = tl.load(counts + row, mask=is_there, other=0)
    if IS_PARTIAL:
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
    order,
    ends,
    rects,
    wanted,
    tiles,
    owners,
    pairs,
    count,
    steps,
    columns,
    none,
    IS_PARTIAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Every pair of a splat and a tile, nearest splat first, the tiles of each row by row.

    order: as above. ends: int64 [count], how many pairs there are up to each splat, itself
    included. steps: halvings that leave one of `count` splats. wanted: bool [tiles], read where
    IS_PARTIAL. tiles, owners: [pairs], written: the tile, `none` where it is not wanted, and the
    row of CudaSplats.
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
    if IS_PARTIAL:
        is_wanted = tl.load(wanted + tile, mask=is_there, other=0)
        tile = tl.where(is_wanted != 0, tile, none)
    tl.store(tiles + pair, tile.to(tiles.dtype.element_ty), mask=is_there)
    tl.store(owners + pair, row.to(tl.int32), mask=is_there)
