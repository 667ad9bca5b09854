"""Numba kernel of the loss against depth priors."""

from __future__ import annotations

import numba
import numpy as np

CHUNK = 4096  # priors summed at a time


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def compare_depth(expected, alpha, pixels, depth, weight, factor, least_alpha, d_expected, sums):
    """Sum of weight |1/expected - 1/depth| over the priors, and its derivative.

    expected, alpha, d_expected: flat [H, W]; d_expected must be 0 and gets factor times the
    derivative. pixels, depth, weight: the priors. Pixels with alpha <= least_alpha count nothing.
    sums: float64, one per CHUNK of priors; -1 where a pixel lies outside of the image or the order
    does not increase.
    """
    one, zero = np.float32(1), np.float32(0)
    for chunk in numba.prange(sums.size):
        total = 0.0
        before = pixels[chunk * CHUNK - 1] if chunk else np.int32(-1)
        for k in range(chunk * CHUNK, min((chunk + 1) * CHUNK, pixels.size)):
            pixel = pixels[k]
            if pixel <= before or pixel >= expected.size:
                total = -1.0
                break
            before = pixel
            value = expected[pixel]
            if not (alpha[pixel] > least_alpha and value > zero and depth[k] > zero):
                continue
            inverse = one / value
            error = inverse - one / depth[k]
            total += weight[k] * abs(error)
            slope = factor * weight[k] * inverse * inverse
            d_expected[pixel] = -slope if error > zero else slope if error < zero else zero
        sums[chunk] = total
