"""Labelled boxes with snow on them, and the share of snow in what an image shows of them."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float32, UInt8

from augment.scene.boxes import SIDE_MARGIN_M, BoxPixels, WorldBoxes, count_pixels
from augment.scene.cameras import Camera

SURFACE_MARGIN_M = 0.05  # width by which splats blur the layer's surface
DRIFT_DEPTH_RATIO = 1.5  # depth of the layer in drifts over its depth on level ground
MIN_BOX_HEIGHT_SHARE = 0.25  # least share of a low box, from its top down, that stays in deep snow


def count_snow_pixels(
    boxes: WorldBoxes,
    camera: Camera,
    surface_depth_m: Float32[np.ndarray, "H W"],
    snow: UInt8[np.ndarray, "H W"],
    thickness_m: float,
) -> BoxPixels:
    """Count the pixels that show each box or the snow on it, and those of them that show snow.

    The second count is `num_marked`.

    Args:
        boxes: labelled boxes.
        camera: the camera.
        surface_depth_m: z of the first solid surface, snow included; 0 = none.
        snow: 255 where the pixel shows snow.
        thickness_m: depth of the layer on level ground.
    """
    return count_pixels(extend_boxes_by_snow(boxes, thickness_m), camera, surface_depth_m, snow)


def extend_boxes_by_snow(boxes: WorldBoxes, thickness_m: float) -> WorldBoxes:
    """Return the boxes with the snow on them; thickness_m: depth of the layer on level ground.

    The top of a box is raised, since the snow on it counts as the box. Its bottom is raised, since
    the snow around its wheels does not.
    """
    height = boxes.sizes_m[:, 2]
    low = boxes.low_m.copy()
    high = boxes.high_m.copy()
    above_ground = np.minimum(thickness_m + SURFACE_MARGIN_M, (1 - MIN_BOX_HEIGHT_SHARE) * height)
    low[:, 2] = np.maximum(low[:, 2], above_ground - height / 2)
    high[:, 2] = height / 2 + max(SIDE_MARGIN_M, DRIFT_DEPTH_RATIO * thickness_m + SURFACE_MARGIN_M)
    return dataclasses.replace(boxes, low_m=low, high_m=high)
