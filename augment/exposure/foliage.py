"""Separates the foliage of trees, bushes and hedges from low vegetation on a surface.

Caller: `search`.
"""

from __future__ import annotations

import cv2
import numpy as np

from augment.exposure.surface import Surface
from augment.scene.semantics import SemanticClass

# Classes of things that are too narrow to hold a layer, whatever a reconstruction makes of them.
BARE_CLASSES = (
    SemanticClass.POLE,
    SemanticClass.SIGN,
    SemanticClass.PEDESTRIAN,
    SemanticClass.TWO_WHEELER,
)
# Least height of foliage over the nearest ground; lower vegetation is grass, part of the ground.
MIN_FOLIAGE_HEIGHT_M = 0.6
_CLUMP_SIDE_M = 0.6  # side of the square within which the most frequent class counts
_GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)


def separate_foliage(surface: Surface, classes: np.ndarray) -> np.ndarray:
    """Separate foliage from low vegetation in the classes of a surface's cells, int16 [H, W].

    A cell is VEGETATION if most of its surroundings are vegetation and it stands over the nearest
    ground. Other vegetation becomes TERRAIN.
    """
    cell = surface.map.cell_m
    is_exposed = surface.is_exposed
    is_green = is_exposed & (classes == SemanticClass.VEGETATION)
    if not is_green.any():
        return classes
    side = 2 * max(1, round(_CLUMP_SIDE_M / cell / 2)) + 1
    kernel = np.ones((side, side), np.uint8)
    # The opening removes specks of ground, which are noise in a crown.
    is_ground = is_exposed & np.isin(classes, _GROUND_CLASSES)
    is_ground = cv2.morphologyEx(is_ground.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    is_high = is_exposed
    if is_ground.any():
        _, labels = cv2.distanceTransformWithLabels(
            (~is_ground).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        nearest = np.array(labels, np.int64)
        heights = np.zeros(int(nearest.max()) + 1, np.float32)
        heights[nearest[is_ground]] = surface.height_m[is_ground]
        is_high = is_exposed & (surface.height_m - heights[nearest] > MIN_FOLIAGE_HEIGHT_M)
    green_share, exposed_share = (
        cv2.blur(mask.astype(np.float32), kernel.shape) for mask in (is_green, is_exposed)
    )
    is_foliage = is_high & (green_share > 0.5 * exposed_share) & (classes != SemanticClass.VEHICLE)
    classes_without_foliage = np.where(
        is_green & ~is_high, np.int16(SemanticClass.TERRAIN), classes
    )
    return np.where(is_foliage, np.int16(SemanticClass.VEGETATION), classes_without_foliage)
