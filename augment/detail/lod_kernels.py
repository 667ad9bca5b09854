"""Numba kernel of levels of detail: the area that merged splats cover."""

from __future__ import annotations

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel


@kernel
def sum_covered_areas(starts, opacities, places, covariances, out):
    """Compute the area that each of G groups of splats covers in a plane.

    The area is the integral of 1 - prod_i (1 - alpha_i), taken at 49 places within 3.15 standard
    deviations of the group. Lengths are in units in which a group has a standard deviation of 1.
    All arrays but `starts` are float64.

    Args:
        starts: int64 [G + 1]; group g has the splats in rows starts[g] to starts[g + 1].
        opacities: [N].
        places: [N, 2], the splats' means in the plane.
        covariances: [N, 2, 2], the splats' covariances in the plane.
        out: [G].
    """
    for g in prange(len(out)):
        covered = 0.0
        for column in range(7):
            for row in range(7):
                x = 0.9 * (column - 3)
                y = 0.9 * (row - 3)
                transmittance = 1.0
                for i in range(starts[g], starts[g + 1]):
                    a = covariances[i, 0, 0]
                    b = covariances[i, 0, 1]
                    c = covariances[i, 1, 1]
                    dx = x - places[i, 0]
                    dy = y - places[i, 1]
                    sigma = 0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
                    transmittance *= 1 - min(opacities[i] * np.exp(-sigma), 0.999)
                covered += 1 - transmittance
        out[g] = 0.81 * covered
