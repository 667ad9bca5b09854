"""How bright the bare ground is for what it is made of: shadows that the recording holds."""

from __future__ import annotations

import cv2
import numpy as np

from augment.semantics import SemanticClass
from augment.snow.height_map import HeightMap

DARKEST, BRIGHTEST = 0.25, 1.5
_SPREAD_M = 0.2  # standard deviation of the blur: shadows have soft edges, gravel is not one
_PAINT_M = 0.1  # so far beyond its own splats a marking may show
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # linear sRGB
_SHARP_CELLS = 0.3  # a narrower blur leaves cells as they are
_LEAST_WEIGHT = 0.02
_FEWEST = 50  # cells of a class, for its median to mean anything
# What differs in colour as much as in light: their brightness says half as much.
_MOTLEY = (SemanticClass.UNKNOWN, SemanticClass.VEGETATION, SemanticClass.OTHER)
_MARKING, _ROAD = int(SemanticClass.LANE_MARKING), int(SemanticClass.ROAD)


def ground_luminance(
    height_map: HeightMap, classes: np.ndarray, can_carry: np.ndarray
) -> np.ndarray:
    """Blurred linear luminance float32 [H, W] of what carries snow, NaN where it cannot be told.

    classes: int16 [H, W]. Each class is blurred by itself; under lane markings, the road about them
    shows how bright it is.
    """
    rgb = np.clip(height_map.rgb[can_carry], 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** np.float32(2.4))
    luminance = np.zeros(can_carry.shape, np.float32)
    luminance[can_carry] = (linear.astype(np.float32) * _LUMINANCE).sum(-1)
    out = np.full(luminance.shape, np.nan, np.float32)
    marking = classes == _MARKING
    around = 2 * max(1, round(_PAINT_M / height_map.cell_m)) + 1
    painted = cv2.dilate(marking.astype(np.uint8), np.ones((around, around), np.uint8)).astype(bool)
    surfaces = np.where(marking, np.int16(_ROAD), classes)
    sigma = _SPREAD_M / height_map.cell_m
    for surface in np.unique(surfaces[can_carry]):
        here = can_carry & (surfaces == surface)
        told = here & ~painted
        weights = told.astype(np.float32)
        sums = luminance * weights
        for spread in (sigma, 4 * sigma):
            missing = here & np.isnan(out)
            if not missing.any():
                break
            weight, total = _blur(weights, spread), _blur(sums, spread)
            known = missing & (weight > _LEAST_WEIGHT)
            out[known] = total[known] / weight[known]
    return out


def relative_light(luminance: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """float32 [C]: luminance [C] over the median of its class, see SnowCells.light; 1 where it is
    NaN.
    """
    out = np.ones(len(luminance), np.float32)
    surfaces = np.where(classes == _MARKING, np.int16(_ROAD), classes)
    known = np.isfinite(luminance)
    for surface in np.unique(surfaces):
        here = known & (surfaces == surface)
        usual = float(np.median(luminance[here])) if here.sum() >= _FEWEST else 0.0
        if usual <= 1e-4:
            continue
        ratio = luminance[here] / np.float32(usual)
        if surface in _MOTLEY:
            ratio = np.sqrt(np.maximum(ratio, 0))
        out[here] = ratio
    return np.clip(out, DARKEST, BRIGHTEST)


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    if sigma < _SHARP_CELLS:
        return values
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
