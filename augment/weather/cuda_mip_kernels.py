"""Triton kernel for averages over ever larger squares of pixels: all levels in one launch."""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather import layer_lookup

HALVINGS = layer_lookup.MIP_LEVELS - 1
SIDE = 2**HALVINGS  # pixels along a program's square, which becomes one of the smallest image

_HALVINGS, _SIDE = tl.constexpr(HALVINGS), tl.constexpr(SIDE)


@triton.jit
def _shown_by(tile, size):
    """Pixels that a tile's SIDE leaves along one axis stand for; at odd borders the last again."""
    leaf = tl.arange(0, _SIDE)
    at = tl.zeros([_SIDE], tl.int32) + tile
    for level in tl.static_range(_HALVINGS - 1, -1, -1):
        last = ((size + (1 << level) - 1) >> level) - 1
        at = tl.minimum(2 * at + ((leaf >> level) & 1), last)
    return at


@triton.jit
def _halve(value, SIZE: tl.constexpr):
    """Averages over 2 x 2 of 2 SIZE x 2 SIZE pixels."""
    return 0.25 * tl.sum(tl.sum(tl.reshape(value, (SIZE, 2, SIZE, 2)), 1), 2)


@triton.jit
def _store(value, image, tile_x, tile_y, width, height, SIZE: tl.constexpr):
    """A tile of one channel into its image of four."""
    row, column = tile_y * SIZE + tl.arange(0, SIZE), tile_x * SIZE + tl.arange(0, SIZE)
    inside = (row < height)[:, None] & (column < width)[None, :]
    tl.store(image + 4 * (row[:, None] * width + column[None, :]), value, mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "levels"])
def average(rgb, alpha, width, height, across, levels, mips):
    """Levels 0 to levels - 1 of an image, one after the other, in mips [sum of pixels, 4].

    A level is an image of ceil(size / 2^level); across: programs that share the width.
    """
    tile_y, tile_x = tl.program_id(0) // across, tl.program_id(0) % across
    row, column = _shown_by(tile_y, height), _shown_by(tile_x, width)
    own_row = tile_y * _SIDE + tl.arange(0, _SIDE)
    own_column = tile_x * _SIDE + tl.arange(0, _SIDE)
    valid = (own_row < height)[:, None] & (own_column < width)[None, :]
    pixel = row[:, None] * width + column[None, :]
    for channel in tl.static_range(4):
        value = tl.load(rgb + 3 * pixel + channel) if channel < 3 else tl.load(alpha + pixel)
        tl.store(mips + 4 * pixel + channel, value, mask=valid)
        image, wide, high = mips + channel, width, height
        for level in tl.static_range(1, _HALVINGS + 1):
            value = _halve(value, _SIDE >> level)
            image += 4 * wide * high
            wide, high = (wide + 1) >> 1, (high + 1) >> 1
            if level < levels:
                _store(value, image, tile_x, tile_y, wide, high, _SIDE >> level)
