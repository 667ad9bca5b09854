"""Sky mattes in a fortieth of their size, which a scene keeps for each recorded image.

Most pixels of a matte show either sky or a surface and have the image's own colours. So a bit for
each pixel, and numbers for the mixed pixels alone, hold all of it.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Int32, UInt8


class PackedMatte(NamedTuple):
    """Sky matte of one image, without the image."""

    sky_bits: UInt8[np.ndarray, "h w"]
    """Bits of pure sky, eight pixels of a row in a byte; rows below the sky are left out."""
    mixed_pixels: Int32[np.ndarray, " M"]
    """Flat indices of the pixels that show sky and a surface."""
    mixed_shares: Float32[np.ndarray, " M"]
    """Share of sky in each of them, 0 to 1."""
    mixed_rgb: UInt8[np.ndarray, "M 3"]
    """Colour of the surface in each of them, without the sky's."""
    small_sky_rgb: UInt8[np.ndarray, "m n 3"]
    """Mean colour of the sky around each pixel, in a small copy of the rows with sky; [0, 0, 3]
    without sky."""


def pack_matte(
    sky_share: Float32[np.ndarray, "h W"],
    surface_rgb: UInt8[np.ndarray, "h W 3"],
    small_sky_rgb: UInt8[np.ndarray, "m n 3"],
) -> PackedMatte:
    """Return a matte in its packed form.

    Args:
        sky_share: share of sky in each pixel of the rows that may show sky, from the top.
        surface_rgb: the same rows of the image, with the sky's colour taken out of mixed pixels.
        small_sky_rgb: the sky's colour in a small copy of these rows.
    """
    mixed_pixels = np.flatnonzero((sky_share > 0) & (sky_share < 1)).astype(np.int32)
    return PackedMatte(
        np.packbits(sky_share == 1, axis=1),
        mixed_pixels,
        sky_share.reshape(-1)[mixed_pixels],
        surface_rgb.reshape(-1, 3)[mixed_pixels],
        small_sky_rgb,
    )


def unpack_matte(
    packed: PackedMatte, rgb: UInt8[np.ndarray, "H W 3"]
) -> tuple[Float32[np.ndarray, "H W"], UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W 3"]]:
    """Return share of sky, colours of surfaces and colours of the sky, as `pack_matte` took them.

    Args:
        packed: the packed matte.
        rgb: the image that it was made of.
    """
    height, width = rgb.shape[:2]
    share = np.zeros((height, width), np.float32)
    sky_rgb = np.zeros_like(rgb)
    surface_rgb = rgb.copy()
    num_rows = len(packed.sky_bits)
    if num_rows:
        share[:num_rows] = np.unpackbits(packed.sky_bits, axis=1, count=width)
        share.reshape(-1)[packed.mixed_pixels] = packed.mixed_shares
        surface_rgb.reshape(-1, 3)[packed.mixed_pixels] = packed.mixed_rgb
        size = width, num_rows
        cv2.resize(packed.small_sky_rgb, size, sky_rgb[:num_rows], interpolation=cv2.INTER_LINEAR)
    return share, surface_rgb, sky_rgb
