"""Cutting rectangles around holes, so that splats line up with every edge between two colours."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from adapters.street.shapes import ALL_EDGES, U0, U1, V0, V1

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 with x0 < x1 and y0 < y1


def cut(
    outer: Rectangle, holes: Sequence[Rectangle], rim: int = ALL_EDGES
) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a rectangle without holes: rectangles [R, 4] and their edge bits [R].

    Cuts run along x first, so long pieces lie along x. Holes may touch each other and reach beyond
    the outer rectangle. An edge bit is set where the piece borders a hole, or lies on those sides
    of the outer rectangle that `rim` names.
    """
    x0, y0, x1, y1 = outer
    clipped = [
        (max(a, x0), max(b, y0), min(c, x1), min(d, y1))
        for a, b, c, d in holes
        if min(c, x1) - max(a, x0) > 1e-9 and min(d, y1) - max(b, y0) > 1e-9
    ]
    levels = sorted({y0, y1, *(h[1] for h in clipped), *(h[3] for h in clipped)})
    pieces: list[Rectangle] = []
    for low, high in itertools.pairwise(levels):
        here = sorted((h[0], h[2]) for h in clipped if h[1] <= low and h[3] >= high)
        start = x0
        for a, b in [*here, (x1, x1)]:
            if a - start > 1e-9:
                pieces.append((start, low, a, high))
            start = max(start, b)
    pieces = _merged(pieces)
    return np.array(pieces).reshape(-1, 4), _edge_bits(pieces, outer, clipped, rim)


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
    pieces: Sequence[Rectangle], outer: Rectangle, holes: Sequence[Rectangle], rim: int
) -> np.ndarray:
    """Bits [R] of the sides of each piece that border a hole or a named side of the rim."""
    p = np.array(pieces).reshape(-1, 4)[:, None]  # [R, 1, 4] against holes [1, H, 4]
    h = np.array(holes).reshape(-1, 4)[None]
    beside = (h[..., 1] < p[..., 3]) & (h[..., 3] > p[..., 1])
    above = (h[..., 0] < p[..., 2]) & (h[..., 2] > p[..., 0])
    bits = np.zeros(len(pieces), np.uint8)
    for bit, side, across in ((U0, 0, beside), (V0, 1, above), (U1, 2, beside), (V1, 3, above)):
        value = p[..., side]
        touches = (value == h[..., side]) | (value == h[..., (side + 2) % 4])
        borders = (touches & across).any(1) | ((value[:, 0] == outer[side]) & bool(rim & bit))
        bits |= np.where(borders, bit, 0).astype(np.uint8)
    return bits
