"""What a flood does to labelled boxes: how deep each stands in the water, and what of it is hidden.

Boxes come in the dataset's world (`augment.labels`), water and cameras in the scene's, which is the
dataset's less `world_origin_m`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from augment.box_pixels import BoxPixels, PlacedBoxes, count_pixels
from augment.cameras import Camera
from augment.labels import Boxes


def submerged_fraction(
    boxes: Boxes, world_origin_m: Float64[np.ndarray, "3"], level_z_m: float
) -> Float64[np.ndarray, " B"]:
    """The part of each box's height that is under water, 0 to 1; tilted boxes from their corners.

    level_z_m: scene world. A box without height is wholly in or out; one whose numbers are not
    finite has NaN.
    """
    placed = PlacedBoxes.of(boxes, world_origin_m)
    z = placed.corners_m[..., 2]  # [B, 8]
    low, high = z.min(axis=1), z.max(axis=1)
    height = high - low
    with np.errstate(invalid="ignore"):
        fraction = (level_z_m - low) / np.where(height > 0, height, 1.0)
        flat = np.where(level_z_m > low, 1.0, 0.0)
    fraction = np.where(height > 0, np.clip(fraction, 0.0, 1.0), flat)
    return np.where(placed.is_finite, fraction, np.nan)


def hidden_pixels(
    boxes: Boxes,
    world_origin_m: Float64[np.ndarray, "3"],
    camera: Camera,
    scene_depth_m: Float32[np.ndarray, "H W"],
    water: UInt8[np.ndarray, "H W"],
) -> BoxPixels:
    """How many pixels show each box, and how many of them (`marked`) do so through water.

    scene_depth_m: z of the scene's own surface, seen through the water where there is some; 0 =
    none. water: 255 where water is the first surface.
    """
    return count_pixels(PlacedBoxes.of(boxes, world_origin_m), camera, scene_depth_m, water)
