"""Cutting rectangles around holes, so that splats line up with every edge between two colours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapters.street.shapes import U0, U1, V0, V1

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 with x0 < x1 and y0 < y1


def cut(outer: Rectangle, holes: Sequence[Rectangle]) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a rectangle without holes: rectangles [R, 4] and their edge bits [R].

    Cuts run along x first, so long pieces lie along x. Holes may touch each other and reach beyond
    the outer rectangle. An edge bit is set where the piece borders a hole or the outer rim.
    """
    x0, y0, x1, y1 = outer
    clipped = [
        (max(a, x0), max(b, y0), min(c, x1), min(d, y1))
        for a, b, c, d in holes
        if min(c, x1) - max(a, x0) > 1e-9 and min(d, y1) - max(b, y0) > 1e-9
    ]
    levels = sorted({y0, y1, *(h[1] for h in clipped), *(h[3] for h in clipped)})
    pieces: list[Rectangle] = []
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        here = sorted((h[0], h[2]) for h in clipped if h[1] <= low and h[3] >= high)
        start = x0
        for a, b in [*here, (x1, x1)]:
            if a - start > 1e-9:
                pieces.append((start, low, a, high))
            start = max(start, b)
    pieces = _merged(pieces)
    return np.array(pieces).reshape(-1, 4), _edge_bits(pieces, outer, clipped)


def _merged(pieces: list[Rectangle]) -> list[Rectangle]:
    """Pieces of equal x range stacked on each other, joined."""
    out: list[Rectangle] = []
    for piece in pieces:
        for i, other in enumerate(out):
            if other[0] == piece[0] and other[2] == piece[2] and other[3] == piece[1]:
                out[i] = (other[0], other[1], other[2], piece[3])
                break
        else:
            out.append(piece)
    return out


def _edge_bits(
    pieces: Sequence[Rectangle], outer: Rectangle, holes: Sequence[Rectangle]
) -> np.ndarray:
    bits = np.zeros(len(pieces), np.uint8)
    for i, (a, b, c, d) in enumerate(pieces):
        for bit, value, rim in ((U0, a, outer[0]), (U1, c, outer[2])):
            borders = any(value in (h[0], h[2]) and h[1] < d and h[3] > b for h in holes)
            bits[i] |= bit if borders or value == rim else 0
        for bit, value, rim in ((V0, b, outer[1]), (V1, d, outer[3])):
            borders = any(value in (h[1], h[3]) and h[0] < c and h[2] > a for h in holes)
            bits[i] |= bit if borders or value == rim else 0
    return bits
