"""Compiled parts of the depth priors."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def hidden_returns(
    pixels, depth_m, grid, enough, most_radius, ratio, margin_m
):  # pragma: no cover - compiled
    """Which returns lie behind nearer ones on all sides, bool [M].

    pixels: int32 [M], flat indices into grid; grid: float32 [H, W], depth at them, 0 elsewhere.
    The square window around a return grows until it holds `enough` others or has the radius
    `most_radius` (pixels). The return is hidden if at least three of the window's four quadrants
    hold a return nearer than z / ratio - margin_m: in front of it passes a surface, not just an
    edge beside it."""
    height, width = grid.shape
    out = np.zeros(len(pixels), np.bool_)
    for i in numba.prange(len(pixels)):
        row, column = pixels[i] // width, pixels[i] % width
        limit = depth_m[i] / ratio - margin_m
        found, count = 0, 0
        for radius in range(1, most_radius + 1):
            for dy in range(-radius, radius + 1):
                y = row + dy
                if y < 0 or y >= height:
                    continue
                # Only the window's border is new: whole rows at its ends, else two pixels.
                step = 1 if dy == -radius or dy == radius else 2 * radius
                for dx in range(-radius, radius + 1, step):
                    x = column + dx
                    if x < 0 or x >= width or grid[y, x] == 0:
                        continue
                    count += 1
                    if grid[y, x] >= limit:
                        continue
                    # What lies straight above or beside counts for both quadrants it touches.
                    if dy <= 0 and dx <= 0:
                        found |= 1
                    if dy <= 0 and dx >= 0:
                        found |= 2
                    if dy >= 0 and dx <= 0:
                        found |= 4
                    if dy >= 0 and dx >= 0:
                        found |= 8
            if count >= enough:
                break
        sides = (found & 1) + (found >> 1 & 1) + (found >> 2 & 1) + (found >> 3 & 1)
        out[i] = sides >= 3
    return out
