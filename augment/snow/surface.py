"""Where on a height map snow can lie: slopes, what hangs together, edges, obstacles beside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from augment.render.threads import kernel_threads
from augment.snow import surface_kernels
from augment.snow.cells import EDGE_CAP_M
from augment.snow.height_map import HeightMap
from augment.snow.surface_kernels import LINK

STEP_M = 0.25  # lower steps do not break a layer: kerbs
_AROUND_M = 0.4  # of a cell: steps are told by the heights within
_NARROW_M, _HIGH_M = 0.4, 1.5  # what is so narrow and so high carries nothing: wires, arms of lamps
_HIGH_M2 = 0.6  # smaller patches so high up are ledges, and what floats before walls
_GAP_M = 0.6  # wider gaps may be deep
_STANDS_OUT_M = 0.1  # of a surface, so that it is not bridged
LEAST_AREA_M2, LEAST_CELLS = 0.05, 4  # smaller patches are specks
POCKET_M2, _POCKET_STEP_M, _POCKET_CELLS = 0.1, 0.3, 1.5  # gaps that are closed
OBSTACLE_M, _BANK_REACH_M, _BANK_SPREAD_M = 0.4, 1.0, 0.35
_MEDIAN_M, _SMOOTH_M = 0.1, 0.15  # scales of smoothing; one cell at least
_SLACK_M, _SMOOTHED_BY_M = 0.05, 0.02
_STEEPER_RAD, _STEEPEST_RAD = math.radians(8), math.radians(80)
_ROWS = 8  # grid rows a thread takes at a time


@dataclass(frozen=True, eq=False)
class Surface:
    """What lies highest, on the grid of a height map [H, W].

    height_m: float32, without the noise of single cells. slopes: float32 [H, W, 2], dz/dx, dz/dy.
    can_carry: bool, snow stays there. sides: int8 [H, W, 4], see surface_kernels.compare_sides.
    edge_m: float32, see SnowCells.
    """

    map: HeightMap
    height_m: np.ndarray
    slopes: np.ndarray
    can_carry: np.ndarray
    sides: np.ndarray
    edge_m: np.ndarray


def find_surface(
    height_map: HeightMap,
    may_carry: np.ndarray,
    *,
    max_slope_deg: float,
    least_area_m2: float = LEAST_AREA_M2,
    floor_m: float | None = None,
) -> Surface:
    """The surface of a map, and where snow stays on it.

    may_carry: bool [H, W]; where it is false nothing is put, whatever lies there. Patches that end
    within the map and are smaller than least_area_m2 or LEAST_CELLS carry nothing. floor_m: how
    high that lies which the map does not show; None for deep but in small gaps.
    """
    cell, covered = height_map.cell_m, height_map.covered.copy()
    shape = covered.shape
    smooth, fitted = np.empty(shape, np.float32), np.empty(shape, np.float32)
    slopes, good = np.empty((*shape, 2), np.float32), np.empty(shape, bool)
    limit = math.radians(max_slope_deg)
    with kernel_threads(_ROWS):
        surface_kernels.median_heights(
            height_map.height_m, covered, int(np.clip(round(_MEDIAN_M / cell), 1, 3)), smooth
        )
        surface_kernels.fit_planes(
            smooth,
            covered,
            int(np.clip(round(_SMOOTH_M / cell), 1, 5)),
            cell,
            _SLACK_M,
            math.tan(min(limit + _STEEPER_RAD, _STEEPEST_RAD)),
            _SMOOTHED_BY_M,
            fitted,
            slopes,
            good,
        )
    floor = _floor(fitted, covered & may_carry, cell) if floor_m is None else np.float32(floor_m)
    lowest, rises = _rises(fitted, covered, floor, cell)
    steep = np.hypot(slopes[..., 0], slopes[..., 1]) > math.tan(limit)
    can_carry = good & may_carry & ~_is_narrow(fitted, covered & may_carry, floor, cell)
    can_carry &= ~(steep & (rises > _highest_step(limit, cell)))
    step = max(STEP_M, math.tan(limit) * cell)
    sides = _compare(fitted, lowest, covered, can_carry, step)
    least = max(LEAST_CELLS, math.ceil(least_area_m2 / cell**2))
    is_high = fitted - lowest > _HIGH_M
    can_carry &= ~_specks(can_carry, sides, is_high, least, max(least, round(_HIGH_M2 / cell**2)))
    filled = _fill_pockets(fitted, slopes, can_carry, covered, cell)
    can_carry |= filled
    covered |= filled
    sides = _compare(fitted, lowest, covered, can_carry, step)
    edges = np.empty(shape, np.float32)
    with kernel_threads(_ROWS):
        surface_kernels.edge_distances(can_carry, sides, max(EDGE_CAP_M / cell, 0.5), edges)
    return Surface(height_map, fitted, slopes, can_carry, sides, edges * np.float32(cell))


def narrow_things(height_map: HeightMap, may_carry: np.ndarray) -> np.ndarray:
    """bool [H, W]: what stands high and is so narrow that snow falls past it: lamps, wires."""
    solid = height_map.covered & may_carry
    floor = _floor(height_map.height_m, solid, height_map.cell_m)
    return _is_narrow(height_map.height_m, solid, floor, height_map.cell_m)


def banks_of(surface: Surface) -> np.ndarray:
    """float32 [H, W, 2]: see SnowCells.banks. 0 on what is itself an obstacle."""
    cell, covered = surface.map.cell_m, surface.map.covered
    low = np.where(covered, surface.height_m, np.float32(np.inf))
    reach = max(1, round(_BANK_REACH_M / cell))
    lowest = cv2.erode(low, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    obstacle = covered & (surface.height_m - lowest > OBSTACLE_M)
    if not obstacle.any():
        return np.zeros((*covered.shape, 2), np.float32)
    sigma = max(_BANK_SPREAD_M / cell, 0.5)
    blurred = cv2.GaussianBlur(
        obstacle.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE
    )
    banks = np.stack(_gradient(blurred), -1) * np.float32(sigma * math.sqrt(2 * math.pi))
    length = np.hypot(banks[..., 0], banks[..., 1])
    banks /= np.maximum(length, 1)[..., None]
    banks[obstacle | ~surface.can_carry] = 0
    return banks


def normals_of(slopes: np.ndarray) -> np.ndarray:
    """Upward unit normals [..., 3] of slopes [..., 2]."""
    normals = np.concatenate([-slopes, np.ones_like(slopes[..., :1])], -1)
    return normals / np.sqrt((normals * normals).sum(-1, keepdims=True))


def _floor(height: np.ndarray, solid: np.ndarray, cell: float) -> np.ndarray:
    """How high what is not known may lie, [H, W]: in gaps up to _GAP_M wide as high as the lowest
    about them, else deep.
    """
    size = 2 * max(1, round(_GAP_M / 2 / cell)) + 1
    around = np.ones((size, size), np.uint8)
    gaps = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_CLOSE, around) > 0
    lowest = cv2.erode(np.where(solid, height, np.float32(1e6)), around)
    return np.where(gaps & (lowest < 1e6), lowest, np.float32(-1e6))


def _rises(
    height: np.ndarray, covered: np.ndarray, floor: np.ndarray | np.float32, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Least height within _AROUND_M of each cell, and range of the heights that are known, [H, W];
    the latter means nothing where none is.
    """
    reach = max(1, round(_AROUND_M / cell))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    lowest_known = cv2.erode(np.where(covered, height, np.float32(1e6)), around)
    highest_known = cv2.dilate(np.where(covered, height, np.float32(-1e6)), around)
    lowest = cv2.erode(np.where(covered, height, floor), around)
    return lowest, highest_known - lowest_known


def _is_narrow(
    height: np.ndarray, solid: np.ndarray, floor: np.ndarray | np.float32, cell: float
) -> np.ndarray:
    """bool [H, W]: what stands higher than _HIGH_M above what is on both sides of it, _NARROW_M or
    three cells apart.
    """
    size = max(3, round(_NARROW_M / cell))  # a wall between two cells shows in both
    around = np.ones((size, size), np.uint8)
    before, after = (size - 1) // 2, size - 1 - (size - 1) // 2  # an even square has no middle
    known = np.where(solid, height, floor)
    lowest = cv2.erode(known, around, anchor=(before, before), borderType=cv2.BORDER_REPLICATE)
    opened = cv2.dilate(lowest, around, anchor=(after, after), borderType=cv2.BORDER_REPLICATE)
    return solid & (height - opened > _HIGH_M)


def _highest_step(limit: float, cell: float) -> float:
    """What is steeper than the limit is a low step, not a slope, where heights around it differ by
    no more than this, metres. A slope as steep as the limit may differ by less.
    """
    return min(STEP_M, 2 * max(_AROUND_M, cell) * math.tan(limit))


def _compare(
    height: np.ndarray,
    lowest: np.ndarray,
    covered: np.ndarray,
    can_carry: np.ndarray,
    step: float,
) -> np.ndarray:
    sides = np.empty((*height.shape, 4), np.int8)
    with kernel_threads(_ROWS):
        surface_kernels.compare_sides(height, lowest, covered, can_carry, step, sides)
    return sides


def _specks(
    can_carry: np.ndarray, sides: np.ndarray, is_high: np.ndarray, least: int, least_high: int
) -> np.ndarray:
    """bool [H, W]: cells in patches of fewer than `least` linked cells that end within the grid;
    of fewer than `least_high` where all of them are high above something beside.

    cv2 finds patches of pixels; links become pixels between those of the cells.
    """
    rows, columns = can_carry.shape
    pixels = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    pixels[::2, ::2] = can_carry
    right, up = sides[..., 1] == LINK, sides[..., 3] == LINK
    pixels[::2, 1::2] = can_carry[:, :-1] & right[:, :-1] & can_carry[:, 1:]
    pixels[1::2, ::2] = can_carry[:-1] & up[:-1] & can_carry[1:]
    count, labels = cv2.connectedComponents(pixels, connectivity=4)
    labels = labels[::2, ::2]
    labels = labels.astype(np.int64)
    sizes = np.bincount(labels.ravel(), minlength=count)
    low = np.bincount(labels[can_carry & ~is_high], minlength=count)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        sizes[border] = least_high  # it may go on outside
    return sizes[labels] < np.where(low > 0, least, least_high)[labels]


def _fill_pockets(
    height: np.ndarray, slopes: np.ndarray, can_carry: np.ndarray, covered: np.ndarray, cell: float
) -> np.ndarray:
    """bool [H, W]: small gaps in a surface, which snow bridges; their heights and slopes are put
    in as those around. What stands out of the surface, or lies between two levels, is no gap.
    """
    count, labels = cv2.connectedComponents((~can_carry).astype(np.uint8), connectivity=4)
    labels = labels.astype(np.int64)
    is_pocket = np.bincount(labels.ravel(), minlength=count) <= max(1, POCKET_M2 / cell**2)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_pocket[border] = False  # it may go on outside
    is_pocket[labels[can_carry]] = False
    around = np.ones((7, 7), np.uint8)
    highest = cv2.dilate(np.where(can_carry, height, np.float32(-np.inf)), around)
    lowest = cv2.erode(np.where(can_carry, height, np.float32(np.inf)), around)
    inside = is_pocket[labels]
    with np.errstate(invalid="ignore", over="ignore"):  # far from any surface both are infinite
        broken = inside & ~(highest - lowest < _POCKET_STEP_M)
    broken |= inside & covered & (height - highest > _STANDS_OUT_M)
    is_pocket[labels[broken]] = False
    filled = is_pocket[labels]
    if not filled.any():
        return filled
    weights = can_carry.astype(np.float32)
    total = cv2.GaussianBlur(weights, (0, 0), _POCKET_CELLS)
    for values in (height, slopes[..., 0], slopes[..., 1]):
        mean = cv2.GaussianBlur(values * weights, (0, 0), _POCKET_CELLS)
        values[filled] = mean[filled] / total[filled]
    return filled


def _gradient(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences to +x and +y, a cell; 0 beyond the borders."""
    padded = np.pad(values, 1, mode="edge")
    half = np.float32(0.5)
    return (
        (padded[1:-1, 2:] - padded[1:-1, :-2]) * half,
        (padded[2:, 1:-1] - padded[:-2, 1:-1]) * half,
    )
