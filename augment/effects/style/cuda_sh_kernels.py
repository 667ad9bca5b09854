"""Triton kernel that folds colour maps into spherical harmonics, at the speed of memory.

A program's lanes each take four colours in a row: twelve numbers, which are three 16-byte vectors.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import sh as sh_layout

FOLDED = tl.constexpr(sh_layout.FOLDED)
OFFSET = tl.constexpr(9)  # of what the first function gets, in a folded map
CHANGES = tl.constexpr(sh_layout.FOLDED - 1)


@triton.jit
def map_sh(
    source, target, numbers, classes, folded, least,
    FUNCTIONS: tl.constexpr, BY_CLASS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """target = source with every splat's functions mapped; both float32 [numbers], or one array.

    numbers: 3 FUNCTIONS of every splat. classes: int16, rows of folded [C, FOLDED], read where
    BY_CLASS; else all take the first. least: what shows of a colour, where FUNCTIONS is 1.
    """
    quad = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    place = quad[:, None] * 12 + tl.arange(0, 4)[None, :]
    first = tl.load(source + place, mask=place < numbers, other=0.0)
    second = tl.load(source + place + 4, mask=place + 4 < numbers, other=0.0)
    third = tl.load(source + place + 8, mask=place + 8 < numbers, other=0.0)
    r0, g0, b0, r1 = _parts(first)
    g1, b1, r2, g2 = _parts(second)
    b2, r3, g3, b3 = _parts(third)
    r0, g0, b0 = _color(r0, g0, b0, quad, 0, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r1, g1, b1 = _color(r1, g1, b1, quad, 1, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r2, g2, b2 = _color(r2, g2, b2, quad, 2, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    r3, g3, b3 = _color(r3, g3, b3, quad, 3, numbers, classes, folded, least, FUNCTIONS, BY_CLASS)
    tl.store(target + place, _joined(r0, g0, b0, r1), mask=place < numbers)
    tl.store(target + place + 4, _joined(g1, b1, r2, g2), mask=place + 4 < numbers)
    tl.store(target + place + 8, _joined(b2, r3, g3, b3), mask=place + 8 < numbers)


@triton.jit
def _color(
    red, green, blue, quad, NUMBER: tl.constexpr, numbers, classes, folded, least,
    FUNCTIONS: tl.constexpr, BY_CLASS: tl.constexpr,
):  # fmt: skip
    """The mapped colour that is NUMBER of each quad."""
    if FUNCTIONS % 4 == 0:  # a splat's functions fill whole quads, which share its map
        splat = quad // (FUNCTIONS // 4)
        is_first = (quad % (FUNCTIONS // 4) == 0) & (NUMBER == 0)
    else:
        splat = (quad * 4 + NUMBER) // FUNCTIONS
        is_first = (quad * 4 + NUMBER) % FUNCTIONS == 0
    if BY_CLASS:
        known = splat * (3 * FUNCTIONS) < numbers
        row = folded + FOLDED * tl.load(classes + splat, mask=known, other=0).to(tl.int32)
    else:
        row = folded
    shown_red, shown_green, shown_blue = red, green, blue
    if FUNCTIONS == 1:
        shown_red = tl.maximum(red, least)
        shown_green = tl.maximum(green, least)
        shown_blue = tl.maximum(blue, least)
    changes = tl.load(row + CHANGES) != 0
    return (
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 0, is_first), red),
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 1, is_first), green),
        tl.where(changes, _row(shown_red, shown_green, shown_blue, row, 2, is_first), blue),
    )


@triton.jit
def _row(red, green, blue, row, CHANNEL: tl.constexpr, is_first):
    mapped = tl.load(row + 3 * CHANNEL) * red
    mapped += tl.load(row + 3 * CHANNEL + 1) * green
    mapped += tl.load(row + 3 * CHANNEL + 2) * blue
    return tl.where(is_first, mapped + tl.load(row + OFFSET + CHANNEL), mapped)


@triton.jit
def _parts(four):
    """The columns of [N, 4]."""
    even, odd = tl.split(tl.reshape(four, (four.shape[0], 2, 2)))
    a, c = tl.split(even)
    b, d = tl.split(odd)
    return a, b, c, d


@triton.jit
def _joined(a, b, c, d):
    return tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), (a.shape[0], 4))
