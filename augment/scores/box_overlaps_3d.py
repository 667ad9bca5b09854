"""Overlaps of upright 3D boxes, from above (bird's eye view) and in space.

A box [7] is x, y, z of the middle of its bottom in the camera's frame (x right, y down, z forward),
height, width, length in metres, and its turn about the camera's y axis in radians, as in KITTI.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64


def corners_from_above(boxes: Float64[np.ndarray, "N 7"]) -> Float64[np.ndarray, "N 4 2"]:
    """Return the four corners (x, z) of boxes seen from above, in order about the outline."""
    length_m = boxes[:, 5, None] * np.array([0.5, 0.5, -0.5, -0.5])
    width_m = boxes[:, 4, None] * np.array([0.5, -0.5, -0.5, 0.5])
    cosine = np.cos(boxes[:, 6, None])
    sine = np.sin(boxes[:, 6, None])
    x_m = boxes[:, 0, None] + cosine * length_m + sine * width_m
    z_m = boxes[:, 2, None] - sine * length_m + cosine * width_m
    return np.stack([x_m, z_m], axis=2)


def overlaps_3d(
    boxes: Float64[np.ndarray, "N 7"],
    other_boxes: Float64[np.ndarray, "T 7"],
    *,
    is_from_above: bool = False,
) -> Float64[np.ndarray, "N T"]:
    """Return the intersection over union of boxes.

    Args:
        is_from_above: If True, of their outlines from above; else of their volumes.
    """
    corners = corners_from_above(boxes)
    other_corners = corners_from_above(other_boxes)
    overlaps = np.zeros((len(boxes), len(other_boxes)))
    for i, box in enumerate(boxes):
        for j, other_box in enumerate(other_boxes):
            reach_m = (np.hypot(box[4], box[5]) + np.hypot(other_box[4], other_box[5])) / 2
            if np.hypot(box[0] - other_box[0], box[2] - other_box[2]) >= reach_m:
                continue
            shared = polygon_area(clip_polygon(corners[i], other_corners[j]))
            size = box[4] * box[5]
            other_size = other_box[4] * other_box[5]
            if not is_from_above:
                top = max(box[1] - box[3], other_box[1] - other_box[3])
                shared *= max(min(box[1], other_box[1]) - top, 0.0)
                size *= box[3]
                other_size *= other_box[3]
            union = size + other_size - shared
            overlaps[i, j] = shared / union if union > 0 else 0.0
    return overlaps


def clip_polygon(
    polygon: Float64[np.ndarray, "P 2"], window: Float64[np.ndarray, "Q 2"]
) -> Float64[np.ndarray, "R 2"]:
    """Return the part of a convex polygon inside another (Sutherland and Hodgman 1974).

    Both have their corners in order; the direction may be either.
    """
    if _signed_area(window) < 0:
        window = window[::-1]
    corners = polygon
    for start, end in zip(window, np.roll(window, -1, axis=0), strict=True):
        if not len(corners):
            break
        edge = end - start
        sides = edge[0] * (corners[:, 1] - start[1]) - edge[1] * (corners[:, 0] - start[0])
        clipped = []
        for k in range(len(corners)):
            next_k = (k + 1) % len(corners)
            if sides[k] >= 0:
                clipped.append(corners[k])
            if (sides[k] >= 0) != (sides[next_k] >= 0):
                share = sides[k] / (sides[k] - sides[next_k])
                clipped.append(corners[k] + share * (corners[next_k] - corners[k]))
        corners = np.array(clipped).reshape(-1, 2)
    return corners


def polygon_area(polygon: Float64[np.ndarray, "P 2"]) -> float:
    """Return the area of a polygon with its corners in order."""
    return abs(_signed_area(polygon))


def _signed_area(polygon: np.ndarray) -> float:
    """Return the area of a polygon, positive if its corners turn from x to the second axis."""
    following = np.roll(polygon, -1, axis=0)
    return float((polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]).sum() / 2)
