"""Light on the bare ground, relative to its class: shadows that the recording holds.

Caller: `search`.
"""

from __future__ import annotations

import cv2
import numpy as np

from augment.exposure.height_map import HeightMap
from augment.light.srgb import LUMINANCE_WEIGHTS
from augment.scene.semantics import SemanticClass

MIN_RELATIVE_LIGHT = 0.25  # lower limit of the relative light
MAX_RELATIVE_LIGHT = 1.5  # upper limit of the relative light
# Standard deviation of the luminance blur: shadows have soft edges, and gravel is no shadow.
_LUMINANCE_BLUR_M = 0.2
_PAINT_MARGIN_M = 0.1  # distance beyond its own splats up to which a lane marking may show
_LUMINANCE_WEIGHTS = np.array(LUMINANCE_WEIGHTS, np.float32)  # weights of linear sRGB
_MIN_BLUR_CELLS = 0.3  # a blur narrower than this number of cells is left out
_MIN_WEIGHT = 0.02  # least weight of the blur at which luminance is known
_MIN_SUNLIT_SHARE = 0.8  # least share of the light at which a cell counts as sunlit
_MIN_CLASS_CELLS = 50  # least number of cells of a class for its median to mean anything
# Classes that differ in colour as much as in light: the square root of their ratio is taken.
_MULTICOLOURED_CLASSES = (SemanticClass.UNKNOWN, SemanticClass.VEGETATION, SemanticClass.OTHER)
_LANE_MARKING = int(SemanticClass.LANE_MARKING)
_ROAD = int(SemanticClass.ROAD)


def ground_luminance(
    height_map: HeightMap, classes: np.ndarray, is_exposed: np.ndarray
) -> np.ndarray:
    """Blurred linear luminance of the exposed cells, float32 [H, W]; NaN where unknown.

    Each class is blurred by itself. Under lane markings, the road about them gives the luminance.

    Args:
        height_map: view of the square from above.
        classes: int16 [H, W], class of each cell.
        is_exposed: bool [H, W], cells open to the sky.
    """
    rgb = np.clip(height_map.rgb[is_exposed], 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** np.float32(2.4))
    luminance = np.zeros(is_exposed.shape, np.float32)
    luminance[is_exposed] = (linear.astype(np.float32) * _LUMINANCE_WEIGHTS).sum(-1)
    blurred = np.full(luminance.shape, np.nan, np.float32)
    marking = classes == _LANE_MARKING
    around = 2 * max(1, round(_PAINT_MARGIN_M / height_map.cell_m)) + 1
    painted_mask = cv2.dilate(marking.astype(np.uint8), np.ones((around, around), np.uint8)).astype(
        bool
    )
    surface_classes = np.where(marking, np.int16(_ROAD), classes)
    sigma = _LUMINANCE_BLUR_M / height_map.cell_m
    for surface in np.unique(surface_classes[is_exposed]):
        surface_mask = is_exposed & (surface_classes == surface)
        sample_mask = surface_mask & ~painted_mask
        weights = sample_mask.astype(np.float32)
        sums = luminance * weights
        for spread in (sigma, 4 * sigma):
            missing_mask = surface_mask & np.isnan(blurred)
            if not missing_mask.any():
                break
            weight = _blur(weights, spread)
            total = _blur(sums, spread)
            known_mask = missing_mask & (weight > _MIN_WEIGHT)
            blurred[known_mask] = total[known_mask] / weight[known_mask]
    return blurred


def relative_light(
    luminance: np.ndarray, classes: np.ndarray, in_light: np.ndarray | None = None
) -> np.ndarray:
    """Luminance of each cell over the median of its class, float32 [C].

    See ExposedCells.relative_light.

    Args:
        luminance: float32 [C]; where it is NaN, the result is 1.
        classes: int16 [C].
        in_light: share of the light that cast shadows leave, [C], NaN where unknown. If given,
            medians are taken over sunlit cells, and multicoloured classes take this share.
    """
    light = np.ones(len(luminance), np.float32)
    surface_classes = np.where(classes == _LANE_MARKING, np.int16(_ROAD), classes)
    known_mask = np.isfinite(luminance)
    if in_light is None:
        in_light = np.full(len(luminance), np.nan)
    for surface in np.unique(surface_classes):
        surface_mask = known_mask & (surface_classes == surface)
        sample_mask = surface_mask & (in_light > _MIN_SUNLIT_SHARE)
        sample_mask = sample_mask if sample_mask.sum() >= _MIN_CLASS_CELLS else surface_mask
        median = (
            float(np.median(luminance[sample_mask]))
            if sample_mask.sum() >= _MIN_CLASS_CELLS
            else 0.0
        )
        if median <= 1e-4:
            continue
        ratio = luminance[surface_mask] / np.float32(median)
        if surface in _MULTICOLOURED_CLASSES:
            shadow_light = in_light[surface_mask]
            ratio = np.where(np.isfinite(shadow_light), shadow_light, np.sqrt(np.maximum(ratio, 0)))
        light[surface_mask] = ratio
    return np.clip(light, MIN_RELATIVE_LIGHT, MAX_RELATIVE_LIGHT)


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    """Blur values by sigma cells; a narrower blur than _MIN_BLUR_CELLS does nothing."""
    if sigma < _MIN_BLUR_CELLS:
        return values
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
