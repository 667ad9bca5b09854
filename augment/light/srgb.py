"""Conversion between sRGB values and linear light (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np

# Weights of linear sRGB in luminance.
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)


def linear_from_display(rgb: np.ndarray) -> np.ndarray:
    """Return linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4)


def display_from_linear(linear: np.ndarray) -> np.ndarray:
    """Convert linear light in [0, 1] to sRGB values; the inverse of `linear_from_display`."""
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, linear * 12.92, high)


def luminance(rgb_linear: np.ndarray) -> float:
    """Return the luminance of a linear colour."""
    return float((rgb_linear * np.asarray(LUMINANCE_WEIGHTS)).sum())
