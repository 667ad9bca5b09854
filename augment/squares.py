"""Masks in squares of pixels, as tiles need them."""

from __future__ import annotations

import numpy as np


def any_in_squares(mask: np.ndarray, side: int) -> np.ndarray:
    """bool [ceil(H / side), ceil(W / side)]: squares with a true pixel of mask, bool [H, W].

    Row by row first: whole rows are compared sixteen and more pixels at a time.
    """
    height, width = mask.shape
    whole = height // side
    pixels = mask.view(np.uint8)
    strips = pixels[: whole * side].reshape(whole, side, width).max(1)
    if whole * side < height:
        strips = np.concatenate([strips, pixels[whole * side :].max(0, keepdims=True)])
    padded = np.zeros((len(strips), -(-width // side) * side), np.uint8)
    padded[:, :width] = strips
    return padded.reshape(len(strips), -1, side).max(2).astype(bool)
