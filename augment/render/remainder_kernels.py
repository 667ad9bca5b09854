"""Numba kernel: finished pixels become opaque (see augment.render.remainder)."""

from __future__ import annotations

import numba
import numpy as np

RUN = 4096  # pixels of a piece of work


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def share_remainder(alpha, rgb, snow, least):
    """alpha, snow: float32 [P]. rgb: [3 P]. rgb and snow may be empty. least: alpha of finished."""
    one = np.float32(1)
    for run in numba.prange((alpha.size + RUN - 1) // RUN):
        for pixel in range(run * RUN, min((run + 1) * RUN, alpha.size)):
            if alpha[pixel] >= least:
                scale = one / alpha[pixel]
                alpha[pixel] = one
                if rgb.size > 0:
                    rgb[3 * pixel] *= scale
                    rgb[3 * pixel + 1] *= scale
                    rgb[3 * pixel + 2] *= scale
                if snow.size > 0:
                    snow[pixel] *= scale
