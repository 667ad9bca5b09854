"""Ground that a recording does not hold, though it shows: closed where it is plain what is there.

A car's lidar does not see the ground beneath the car, and a fit of a drive that begins or ends with
the car standing still has no Gaussians there. What lies around such a hole, and that the car stood
on it, tell how high the ground in it is.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from augment.snow import hole_kernels
from augment.snow.height_map import HeightMap

LEAST_M2, MOST_M2 = 0.1, 7.0  # what is smaller is left to `surface`
MOST_OVER_M2 = 0.6  # of that, under narrow things: lamps, not eaves
MOST_ON_PATH_M2 = 80.0  # where the path of the cameras leads over it
_PATH_M = 1.0  # on both sides of it
_RIM_CELLS = 3
_ALIKE_M, _FIRST_M = 0.12, 0.5  # off the plane of what lies around; and off its middle, at first
_FEWEST_CELLS = 8
_FEWEST_ALIKE, _OCTANTS, _OCTANTS_ON_PATH = 0.6, 7, 5
_STEEPEST = math.tan(math.radians(20))
_MOST_SAMPLES = 160  # of a rim that heights are taken from
_CLEAR_M = 0.3  # over the plane, of thin things that stand in a hole


def fill_holes(
    height_map: HeightMap,
    classes: np.ndarray,
    lies: np.ndarray,
    narrow: np.ndarray,
    wanted: np.ndarray,
    path_xy: np.ndarray,
) -> tuple[HeightMap, np.ndarray]:
    """The map with the holes closed that one smooth surface surrounds, and where, bool [H, W].

    classes: int16 [H, W], which get those of what is around. lies: bool, where the map shows
    something that may carry snow. narrow: bool, what stands high and hides nothing below it.
    wanted: bool, what was drawn. path_xy [P, 2]: places of the cameras.
    """
    filled = np.zeros(lies.shape, bool)
    covered = height_map.covered
    empty = wanted & (~covered | height_map.is_thin | narrow)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        empty.astype(np.uint8), connectivity=4
    )
    cell_m2 = height_map.cell_m**2
    sizes = stats[:, cv2.CC_STAT_AREA] * cell_m2
    possible = np.flatnonzero((sizes >= LEAST_M2) & (sizes <= MOST_ON_PATH_M2))
    possible = possible[possible > 0]
    if count <= 1 or len(possible) == 0:
        return height_map, filled
    near = labels[_near_path(height_map, path_xy)].astype(np.int64)
    on_path = np.bincount(near, minlength=count) > 0
    over = np.bincount(labels[narrow].astype(np.int64), minlength=count) * cell_m2
    possible = possible[over[possible] <= MOST_OVER_M2]
    new = {name: getattr(height_map, name).copy() for name in ("height_m", "rgb", "alpha")}
    is_thin = height_map.is_thin.copy()
    for hole in possible[(sizes[possible] <= MOST_M2) | on_path[possible]]:
        left, bottom, width, height = stats[hole, :4]
        window = (
            slice(max(0, bottom - _RIM_CELLS), bottom + height + _RIM_CELLS),
            slice(max(0, left - _RIM_CELLS), left + width + _RIM_CELLS),
        )
        inside = labels[window] == hole
        around = np.ones((2 * _RIM_CELLS + 1, 2 * _RIM_CELLS + 1), np.uint8)
        rim = (cv2.dilate(inside.astype(np.uint8), around) > 0) & ~inside
        if not on_path[hole] and bool((rim & ~wanted[window]).any()):
            continue  # it goes on where nothing was drawn
        known = rim & covered[window] & ~height_map.is_thin[window] & ~narrow[window]
        plane, alike = _plane_around(
            known, lies[window], height_map.height_m[window], height_map.cell_m
        )
        octants = _OCTANTS_ON_PATH if on_path[hole] else _OCTANTS
        if plane is None or not _surrounds(inside, alike, octants):
            continue
        rows, columns = np.nonzero(inside)
        level = plane[0] + plane[1] * columns + plane[2] * rows
        tall = height_map.is_thin[window][rows, columns]
        tall &= height_map.height_m[window][rows, columns] > level + _CLEAR_M
        rows, columns, level = rows[~tall], columns[~tall], level[~tall]
        at_row, at_column = (part[:: 1 + len(part) // _MOST_SAMPLES] for part in np.nonzero(alike))
        weights = np.hypot(rows[:, None] - at_row, columns[:, None] - at_column) ** -3.0
        weights /= weights.sum(1, keepdims=True)
        off = height_map.height_m[window][at_row, at_column]
        off = off - (plane[0] + plane[1] * at_column + plane[2] * at_row)
        new["height_m"][window][rows, columns] = level + weights @ off
        new["rgb"][window][rows, columns] = weights @ height_map.rgb[window][at_row, at_column]
        new["alpha"][window][rows, columns] = 1
        is_thin[window][rows, columns] = False
        usual = np.bincount(classes[window][alike].astype(np.int64)).argmax()
        classes[window][rows, columns] = usual
        filled[window][rows, columns] = True
    return dataclasses.replace(height_map, **new, is_thin=is_thin), filled


def _near_path(grid: HeightMap, path_xy: np.ndarray) -> np.ndarray:
    """bool [H, W]: cells near the path's places."""
    rows, columns = grid.alpha.shape
    reach = max(1, round(_PATH_M / grid.cell_m))
    place = np.floor((path_xy - (grid.left_m, grid.bottom_m)) / grid.cell_m).astype(np.int64)
    near = np.zeros((rows, columns), np.uint8)
    place = place[((place >= 0) & (place < (columns, rows))).all(1)]
    near[place[:, 1], place[:, 0]] = 1
    return cv2.dilate(near, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _plane_around(
    known: np.ndarray, lies: np.ndarray, height: np.ndarray, cell: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Height at the corner, and rises per column and row, of the plane of most known cells; None
    where there is none. bool [H, W]: the cells that lie in it.
    """
    rows, columns = np.nonzero(known)
    alike = np.zeros_like(known)
    if len(rows) < _FEWEST_CELLS:
        return None, alike
    z = height[rows, columns].astype(np.float64)
    used, fits = np.empty(len(z), bool), np.empty(len(z), bool)
    slopes = hole_kernels.find_plane(
        rows, columns, z, _FIRST_M, _ALIKE_M, _FEWEST_CELLS, used, fits
    )
    fits &= lies[rows, columns]
    if not (fits.mean() >= _FEWEST_ALIKE and math.hypot(*slopes) <= _STEEPEST * cell):
        return None, alike
    alike[rows[fits], columns[fits]] = True
    terms = np.stack([np.ones(len(z)), columns, rows], 1)
    return np.linalg.lstsq(terms[used], z[used], rcond=None)[0], alike


def _surrounds(inside: np.ndarray, alike: np.ndarray, fewest: int) -> bool:
    """Whether cells lie in enough of the eight directions from the middle of a hole."""
    middle = [part.mean() for part in np.nonzero(inside)]
    rows, columns = np.nonzero(alike)
    angles = np.arctan2(rows - middle[0], columns - middle[1])
    octants = np.floor((angles + math.pi) * (4 / math.pi)).astype(np.int64) % 8
    return len(np.unique(octants)) >= fewest
