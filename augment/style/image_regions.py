"""Where a picture shows sky, vegetation and road."""

from __future__ import annotations

import numpy as np

from augment.style.statistics import LAND, SKY


def find_sky(rgb: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """bool [H, W]."""
    return np.zeros(weights.shape, bool)


def region_masks(rgb: np.ndarray, weights: np.ndarray, sky: np.ndarray) -> dict[str, np.ndarray]:
    """bool [H, W] by region."""
    return {SKY: sky, LAND: ~sky}
