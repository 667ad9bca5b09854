"""Smooth noise from hashed lattices: the same value for the same place, whoever asks.

Nothing here holds state, so a splat and a ray that meet a surface at one point see one colour.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np


def hashed(integers: np.ndarray, seed: int = 0) -> np.ndarray:
    """Numbers in [0, 1), float32, from int32 rows [N, D]: a Murmur-style mix of each row."""
    state = np.full(integers.shape[0], (seed * 0x9E3779B1 + 0x7F4A7C15) & 0xFFFFFFFF, np.uint32)
    for column in integers.astype(np.int32).view(np.uint32).T:
        state ^= column * np.uint32(0xCC9E2D51)
        state = (state << np.uint32(13)) | (state >> np.uint32(19))
        state = state * np.uint32(5) + np.uint32(0xE6546B64)
    state ^= state >> np.uint32(16)
    state *= np.uint32(0x85EBCA6B)
    state ^= state >> np.uint32(13)
    state *= np.uint32(0xC2B2AE35)
    state ^= state >> np.uint32(16)
    return (state >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def value_noise(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Smooth noise in [-1, 1] at points [N, D] (D 2 or 3), one lattice cell per unit, float32.

    Lattice values come from one table, so the pattern repeats after some 200 cells.
    """
    base = np.floor(points)
    share = (points - base).astype(np.float32)
    share = share * share * (3 - 2 * share)
    steps = _STEPS[: points.shape[1]]
    index = base.astype(np.int64) @ steps + seed * 7919

    def blend(offset: int, axes: int) -> np.ndarray:
        if axes == 0:
            return _table()[(index + offset) & (TABLE_SIZE - 1)]
        low, high = blend(offset, axes - 1), blend(offset + int(steps[axes - 1]), axes - 1)
        return low + share[:, axes - 1] * (high - low)

    return blend(0, points.shape[1])


TABLE_SIZE = 1 << 16
_STEPS = np.array([1, 40503, 12289])  # far apart in the table, whichever few cells are compared


@lru_cache(maxsize=1)
def _table() -> np.ndarray:
    integers = np.arange(TABLE_SIZE, dtype=np.int32)[:, None]
    return 2 * hashed(integers, 1) - 1


def fractal_noise(points: np.ndarray, octaves: int, seed: int = 0) -> np.ndarray:
    """Octaves of value noise, each twice as fine and half as strong; in [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    strength, norm = 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(strength) * value_noise(points * 2.0**octave, seed + 31 * octave)
        norm += strength
        strength *= 0.5
    return total / np.float32(norm)
