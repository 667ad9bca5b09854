"""Gerstner waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class WaveSet:
    """N Gerstner waves, float64.

    directions [N, 2]: unit, world x and y, where each runs to. amplitudes_m, wavelengths_m,
    steepness (Q k A of each wave; their sum is <= 1), phases_rad [N]. depth_m: of the water, for
    the dispersion.
    """

    directions: np.ndarray
    amplitudes_m: np.ndarray
    wavelengths_m: np.ndarray
    steepness: np.ndarray
    phases_rad: np.ndarray
    depth_m: float
