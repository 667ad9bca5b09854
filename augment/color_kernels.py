"""Numba kernel for splats whose colours change with time or stand still while they turn."""

from __future__ import annotations

import numba
import numpy as np

BLOCK = 2048  # splats a thread takes at a time


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def colors_at(sh, coefficients, weights, turn, out):
    """out [N, K, 3]: sh with sum_t weights[t] coefficients[:, t] added to its first row, and bands
    turned by the blocks of turn [K, K]; an empty turn leaves them.

    coefficients [N, T, 3]. weights [T]. All float32.
    """
    count, rows, _ = sh.shape
    zero = np.float32(0)
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            for c in range(3):
                value = sh[i, 0, c]
                for term in range(len(weights)):
                    value += weights[term] * coefficients[i, term, c]
                out[i, 0, c] = value
            if len(turn) == 0:
                for k in range(1, rows):
                    for c in range(3):
                        out[i, k, c] = sh[i, k, c]
                continue
            first = 1
            while first < rows:
                after = first + 3 if first == 1 else first + 5 if first == 4 else first + 7
                for row in range(first, after):
                    red = green = blue = zero
                    for k in range(first, after):
                        share = turn[row, k]
                        red += share * sh[i, k, 0]
                        green += share * sh[i, k, 1]
                        blue += share * sh[i, k, 2]
                    out[i, row, 0], out[i, row, 1], out[i, row, 2] = red, green, blue
                first = after
