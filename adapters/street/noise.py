"""Smooth noise from hashed lattices: the same value for the same place, whoever asks.

Nothing here holds state, so a splat and a ray that meet a surface at one point see one colour.
"""

from __future__ import annotations

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
    """Smooth noise in [-1, 1] at points [N, D] (D 2 or 3), one lattice cell per unit."""
    base = np.floor(points)
    fraction = (points - base).astype(np.float32)
    fraction = fraction * fraction * (3 - 2 * fraction)
    corner = base.astype(np.int32)
    dimensions = points.shape[1]
    total = np.zeros(len(points), np.float32)
    for bits in range(2**dimensions):
        offset = np.array([(bits >> d) & 1 for d in range(dimensions)], np.int32)
        weight = np.ones(len(points), np.float32)
        for d in range(dimensions):
            weight *= fraction[:, d] if offset[d] else 1 - fraction[:, d]
        total += weight * hashed(corner + offset, seed)
    return 2 * total - 1


def fractal_noise(points: np.ndarray, octaves: int, seed: int = 0) -> np.ndarray:
    """Octaves of value noise, each twice as fine and half as strong; in [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    strength, norm = 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(strength) * value_noise(points * 2.0**octave, seed + 31 * octave)
        norm += strength
        strength *= 0.5
    return total / np.float32(norm)
