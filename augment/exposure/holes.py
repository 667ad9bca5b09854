"""Holes in the ground, closed where their surroundings leave no doubt.

A car's lidar does not see the ground beneath the car, and a fit of a drive that begins or ends
with the car standing still has no Gaussians there. The rim of such a hole gives its height.
Caller: `search`.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from augment.exposure import surface_kernels
from augment.exposure.height_map import HeightMap

MIN_HOLE_M2 = 0.1  # least area of a hole; `surface` closes smaller gaps
MAX_HOLE_M2 = 7.0  # largest area of a hole beside the path
MAX_OVERHUNG_M2 = 0.6  # largest part of it under narrow things: lamps, not eaves
MAX_PATH_HOLE_M2 = 80.0  # largest area of a hole that the path of the cameras crosses
_PATH_HALF_WIDTH_M = 1.0  # half the width of the path
_RIM_CELLS = 3  # width of a hole's rim
_PLANE_TOLERANCE_M = 0.12  # largest distance of a rim's height from the fitted plane
_FIRST_TOLERANCE_M = 0.5  # largest distance from the rim's median height, in the first round
_MIN_RIM_CELLS = 8  # least number of cells of a rim
_MIN_PLANE_SHARE = 0.6  # least share of a rim's cells that must lie in the plane
_MIN_OCTANTS = 7  # least number of octants around a hole that hold cells of the plane
_MIN_OCTANTS_ON_PATH = 5  # the same for a hole on the path
_MAX_PLANE_SLOPE = math.tan(math.radians(20))  # steepest slope of the plane
_MAX_RIM_SAMPLES = 160  # largest number of a rim's cells that heights are taken from
_MIN_CLEARANCE_M = 0.3  # height over the plane beyond which a thin thing in a hole is left as it is


def fill_holes(
    height_map: HeightMap,
    classes: np.ndarray,
    candidate_mask: np.ndarray,
    narrow_mask: np.ndarray,
    pixel_mask: np.ndarray,
    path_xy: np.ndarray,
) -> tuple[HeightMap, np.ndarray]:
    """Close the holes that one smooth surface surrounds.

    Args:
        height_map: view of the square from above.
        classes: int16 [H, W], written: filled cells get the most frequent class around them.
        candidate_mask: bool [H, W], cells where the map shows something that may be exposed.
        narrow_mask: bool [H, W], things that stand high and hide nothing below them.
        pixel_mask: bool [H, W], cells that were rendered.
        path_xy: [P, 2], places of the cameras, world, metres.

    Returns:
        The map without these holes, and the filled cells, bool [H, W].
    """
    filled_mask = np.zeros(candidate_mask.shape, bool)
    covered = height_map.covered
    empty_mask = pixel_mask & (~covered | height_map.is_thin | narrow_mask)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        empty_mask.astype(np.uint8), connectivity=4
    )
    cell_m2 = height_map.cell_m**2
    areas_m2 = stats[:, cv2.CC_STAT_AREA] * cell_m2
    holes = np.flatnonzero((areas_m2 >= MIN_HOLE_M2) & (areas_m2 <= MAX_PATH_HOLE_M2))
    holes = holes[holes > 0]
    if count <= 1 or len(holes) == 0:
        return height_map, filled_mask
    path_labels = labels[_near_path(height_map, path_xy)].astype(np.int64)
    on_path = np.bincount(path_labels, minlength=count) > 0
    overhung_m2 = np.bincount(labels[narrow_mask].astype(np.int64), minlength=count) * cell_m2
    holes = holes[overhung_m2[holes] <= MAX_OVERHUNG_M2]
    arrays = {name: getattr(height_map, name).copy() for name in ("height_m", "rgb", "alpha")}
    is_thin = height_map.is_thin.copy()
    for hole in holes[(areas_m2[holes] <= MAX_HOLE_M2) | on_path[holes]]:
        left, bottom, width, height = stats[hole, :4]
        window = (
            slice(max(0, bottom - _RIM_CELLS), bottom + height + _RIM_CELLS),
            slice(max(0, left - _RIM_CELLS), left + width + _RIM_CELLS),
        )
        hole_mask = labels[window] == hole
        kernel = np.ones((2 * _RIM_CELLS + 1, 2 * _RIM_CELLS + 1), np.uint8)
        rim_mask = (cv2.dilate(hole_mask.astype(np.uint8), kernel) > 0) & ~hole_mask
        if not on_path[hole] and bool((rim_mask & ~pixel_mask[window]).any()):
            continue  # the hole goes on where nothing was rendered
        known_mask = rim_mask & covered[window] & ~height_map.is_thin[window] & ~narrow_mask[window]
        plane, plane_mask = _fit_rim_plane(
            known_mask, candidate_mask[window], height_map.height_m[window], height_map.cell_m
        )
        octants = _MIN_OCTANTS_ON_PATH if on_path[hole] else _MIN_OCTANTS
        if plane is None or not _is_surrounded(hole_mask, plane_mask, octants):
            continue
        rows, columns = np.nonzero(hole_mask)
        plane_m = plane[0] + plane[1] * columns + plane[2] * rows
        is_tall = height_map.is_thin[window][rows, columns]
        is_tall &= height_map.height_m[window][rows, columns] > plane_m + _MIN_CLEARANCE_M
        rows = rows[~is_tall]
        columns = columns[~is_tall]
        plane_m = plane_m[~is_tall]
        rim_rows, rim_columns = (
            indices[:: 1 + len(indices) // _MAX_RIM_SAMPLES] for indices in np.nonzero(plane_mask)
        )
        weights = np.hypot(rows[:, None] - rim_rows, columns[:, None] - rim_columns) ** -3.0
        weights /= weights.sum(1, keepdims=True)
        offsets = height_map.height_m[window][rim_rows, rim_columns]
        offsets = offsets - (plane[0] + plane[1] * rim_columns + plane[2] * rim_rows)
        arrays["height_m"][window][rows, columns] = plane_m + weights @ offsets
        arrays["rgb"][window][rows, columns] = (
            weights @ height_map.rgb[window][rim_rows, rim_columns]
        )
        arrays["alpha"][window][rows, columns] = 1
        is_thin[window][rows, columns] = False
        most_frequent = np.bincount(classes[window][plane_mask].astype(np.int64)).argmax()
        classes[window][rows, columns] = most_frequent
        filled_mask[window][rows, columns] = True
    return dataclasses.replace(height_map, **arrays, is_thin=is_thin), filled_mask


def _near_path(grid: HeightMap, path_xy: np.ndarray) -> np.ndarray:
    """Return the cells near the path's places, bool [H, W]."""
    rows, columns = grid.alpha.shape
    reach = max(1, round(_PATH_HALF_WIDTH_M / grid.cell_m))
    places = np.floor((path_xy - (grid.left_m, grid.bottom_m)) / grid.cell_m).astype(np.int64)
    path_mask = np.zeros((rows, columns), np.uint8)
    places = places[((places >= 0) & (places < (columns, rows))).all(1)]
    path_mask[places[:, 1], places[:, 0]] = 1
    return cv2.dilate(path_mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _fit_rim_plane(
    known_mask: np.ndarray, candidate_mask: np.ndarray, height: np.ndarray, cell: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Fit a plane to most of the known cells around a hole.

    Returns:
        (height at the corner, rise per column, rise per row), or None where no plane fits; and the
        cells that lie in the plane, bool [H, W].
    """
    rows, columns = np.nonzero(known_mask)
    plane_mask = np.zeros_like(known_mask)
    if len(rows) < _MIN_RIM_CELLS:
        return None, plane_mask
    z = height[rows, columns].astype(np.float64)
    is_fitted = np.empty(len(z), bool)
    is_in_plane = np.empty(len(z), bool)
    slopes = surface_kernels.find_plane(
        rows,
        columns,
        z,
        _FIRST_TOLERANCE_M,
        _PLANE_TOLERANCE_M,
        _MIN_RIM_CELLS,
        is_fitted,
        is_in_plane,
    )
    is_in_plane &= candidate_mask[rows, columns]
    if not (
        is_in_plane.mean() >= _MIN_PLANE_SHARE and math.hypot(*slopes) <= _MAX_PLANE_SLOPE * cell
    ):
        return None, plane_mask
    plane_mask[rows[is_in_plane], columns[is_in_plane]] = True
    terms = np.stack([np.ones(len(z)), columns, rows], 1)
    return np.linalg.lstsq(terms[is_fitted], z[is_fitted], rcond=None)[0], plane_mask


def _is_surrounded(hole_mask: np.ndarray, plane_mask: np.ndarray, min_octants: int) -> bool:
    """Tell if cells lie in enough of the eight directions from the middle of a hole."""
    middle = [indices.mean() for indices in np.nonzero(hole_mask)]
    rows, columns = np.nonzero(plane_mask)
    angles = np.arctan2(rows - middle[0], columns - middle[1])
    octants = np.floor((angles + math.pi) * (4 / math.pi)).astype(np.int64) % 8
    return len(np.unique(octants)) >= min_octants
