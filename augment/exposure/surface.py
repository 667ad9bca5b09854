"""Finds the surfaces on a height map that are open to the sky and can hold a layer.

Input: a `HeightMap` of one square, seen from above. Output: a `Surface` with slopes, sides and
distances to open edges; `CellList` arrays of its cells; `ExposedCells`, the finished record.
Callers: `search` for the background, `vehicle_cells` for a vehicle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from augment.exposure import surface_kernels
from augment.exposure.cells import FLUSH, MAX_EDGE_DISTANCE_M, ExposedCells
from augment.exposure.height_map import HeightMap, classes_of, in_order, slices_of
from augment.exposure.shell_grid import VEHICLE_MAX_SLOPE_DEG, PlacedShell, ShellGrid
from augment.exposure.surface_kernels import LINK
from augment.render.threads import kernel_threads
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Actor, Gaussians
from augment.scene.semantics import SemanticClass, class_of_label

MAX_STEP_M = 0.25  # lower steps, such as kerbs, do not break a layer
_STEP_RADIUS_M = 0.4  # distance from a cell within which heights are compared for steps
# A thing narrower and higher than this holds no layer: wires, arms of lamps.
_MAX_NARROW_WIDTH_M = 0.4
_MIN_NARROW_HEIGHT_M = 1.5
_MIN_HIGH_AREA_M2 = 0.6  # smaller patches so high up are ledges, or float before walls
# Share of a patch's cells that stand high, from which on it is a wire or the top of a fence.
_MIN_LINEAR_SHARE = 0.85
_MAX_GAP_M = 0.6  # wider gaps may be deep
_MAX_BRIDGED_HEIGHT_M = 0.1  # height above a surface from which on a thing is not bridged
MIN_AREA_M2 = 0.05  # smaller patches are specks
MIN_CELLS = 4  # patches of fewer cells are specks
MAX_POCKET_M2 = 0.1  # largest area of a gap that a layer bridges
_MAX_POCKET_STEP_M = 0.3  # largest range of heights around such a gap
_POCKET_BLUR_CELLS = 1.5  # standard deviation of the blur that fills it
# Height over the lowest cell nearby from which on a thing is an obstacle.
MIN_OBSTACLE_HEIGHT_M = 0.4
_OBSTACLE_REACH_M = 1.0  # distance within which that lowest cell is searched
_OBSTACLE_BLUR_M = 0.35  # standard deviation of the blur of obstacles
# Scales of smoothing; one cell at least.
_MEDIAN_RADIUS_M = 0.1
_PLANE_RADIUS_M = 0.15
_PLANE_SLACK_M = 0.05  # height off a plane at which a cell still counts for its fit
_MAX_SMOOTHING_M = 0.02  # largest change of a height by smoothing
_EXTRA_SLOPE_RAD = math.radians(8)  # angle beyond the steepest slope up to which planes are fitted
_MAX_SLOPE_RAD = math.radians(80)  # steepest plane
_ROWS_PER_TASK = 8  # number of grid rows that a thread takes at a time


@dataclass(frozen=True, eq=False)
class Surface:
    """Highest surface on the grid of a height map [H, W]."""

    map: HeightMap
    height_m: np.ndarray  # float32, without the noise of single cells
    slopes: np.ndarray  # float32 [H, W, 2], dz/dx and dz/dy
    is_exposed: np.ndarray  # bool, the cell can hold a layer
    sides: np.ndarray  # int8 [H, W, 4], see surface_kernels.compare_sides
    edge_distance_m: np.ndarray  # float32, see ExposedCells.edge_distance_m
    shells: ShellGrid | None = None  # shells of vehicles, which are the surface where they lie


def find_surface(
    height_map: HeightMap,
    is_candidate: np.ndarray,
    *,
    max_slope_deg: float,
    min_area_m2: float = MIN_AREA_M2,
    floor_m: float | None = None,
    on_vehicles: np.ndarray,
    shells: ShellGrid | None = None,
) -> Surface:
    """Find the surface of a map, and its exposed cells.

    Args:
        height_map: heights of a square, seen from above.
        is_candidate: bool [H, W]; where it is False, nothing is exposed.
        max_slope_deg: steeper surfaces hold no layer.
        min_area_m2: a patch that ends within the map and is smaller than this, or than MIN_CELLS,
            is not exposed.
        floor_m: z of what the map does not show. None: z is low there, except in small gaps.
        on_vehicles: bool [H, W], cells that show a vehicle's body, see `_close_vehicle_tops` and
            `_is_vehicle_top`.
        shells: shells of vehicles, which are the surface where they lie; None without any. The
            height map has their heights already.
    """
    if shells is not None:
        on_vehicles = on_vehicles & ~shells.is_plan
    height_map = _close_vehicle_tops(height_map, on_vehicles)
    cell = height_map.cell_m
    covered = height_map.covered.copy()
    shape = covered.shape
    smoothed = np.empty(shape, np.float32)
    fitted_m = np.empty(shape, np.float32)
    slopes = np.empty((*shape, 2), np.float32)
    is_fitted = np.empty(shape, bool)
    max_slope_rad = math.radians(max_slope_deg)
    with kernel_threads(_ROWS_PER_TASK):
        surface_kernels.median_heights(
            height_map.height_m,
            covered,
            int(np.clip(round(_MEDIAN_RADIUS_M / cell), 1, 3)),
            smoothed,
        )
        max_fit_slope = math.tan(min(max_slope_rad + _EXTRA_SLOPE_RAD, _MAX_SLOPE_RAD))
        surface_kernels.fit_planes(
            smoothed,
            covered,
            int(np.clip(round(_PLANE_RADIUS_M / cell), 1, 5)),
            cell,
            _PLANE_SLACK_M,
            max_fit_slope,
            _MAX_SMOOTHING_M,
            fitted_m,
            slopes,
            is_fitted,
        )
    floor_heights = (
        _floor_heights(fitted_m, covered & is_candidate, cell)
        if floor_m is None
        else np.float32(floor_m)
    )
    lowest, local_range = _local_range(fitted_m, covered, floor_heights, cell)
    is_steep = np.hypot(slopes[..., 0], slopes[..., 1]) > math.tan(max_slope_rad)
    is_exposed = (
        is_fitted
        & is_candidate
        & ~_is_narrow(fitted_m, covered & is_candidate, floor_heights, cell)
    )
    is_exposed &= ~(is_steep & (local_range > _highest_step(max_slope_rad, cell)))
    is_exposed &= ~on_vehicles | _is_vehicle_top(
        fitted_m, covered, is_exposed & on_vehicles, max_slope_rad, cell
    )
    if shells is not None:
        shells.put_on(fitted_m, slopes, is_exposed)
    max_step_m = max(MAX_STEP_M, math.tan(max_slope_rad) * cell)
    sides = _compare_sides(fitted_m, lowest, covered, is_exposed, max_step_m)
    min_cells = max(MIN_CELLS, math.ceil(min_area_m2 / cell**2))
    is_high = fitted_m - lowest > _MIN_NARROW_HEIGHT_M
    is_exposed &= ~_find_specks(
        is_exposed, sides, is_high, min_cells, max(min_cells, round(_MIN_HIGH_AREA_M2 / cell**2))
    )
    filled_mask = _fill_pockets(fitted_m, slopes, is_exposed, covered, cell)
    is_exposed |= filled_mask
    covered |= filled_mask
    if shells is not None:
        shells.put_on(fitted_m, slopes, is_exposed)
    sides = _compare_sides(fitted_m, lowest, covered, is_exposed, max_step_m)
    edges = _edge_distances(is_exposed, sides, cell)
    return Surface(height_map, fitted_m, slopes, is_exposed, sides, edges, shells)


def surface_of_shell(
    height_map: HeightMap, shells: ShellGrid, floor_m: float, max_step_m: float = MAX_STEP_M
) -> Surface:
    """Return the surface of vehicles alone, on a map that holds their shells.

    Args:
        height_map: map with the shells' heights.
        shells: the shells.
        floor_m: z of what lies beside them.
        max_step_m: largest step between linked cells.
    """
    cell = height_map.cell_m
    covered = height_map.covered
    height = np.where(covered, height_map.height_m, np.float32(floor_m))
    lowest, _ = _local_range(height, covered, np.float32(floor_m), cell)
    sides = _compare_sides(height, lowest, covered, shells.is_top, max_step_m)
    edges = _edge_distances(shells.is_top, sides, cell)
    return Surface(height_map, height, shells.slopes, shells.is_top, sides, edges, shells)


def find_narrow_things(height_map: HeightMap, is_candidate: np.ndarray) -> np.ndarray:
    """Find high things so narrow that they shelter nothing: lamps, wires; bool [H, W]."""
    is_solid = height_map.covered & is_candidate
    floor_heights = _floor_heights(height_map.height_m, is_solid, height_map.cell_m)
    return _is_narrow(height_map.height_m, is_solid, floor_heights, height_map.cell_m)


def find_obstacle_vectors(surface: Surface) -> np.ndarray:
    """Vectors towards obstacles, float32 [H, W, 2]; 0 on obstacles.

    See ExposedCells.obstacle_vectors.
    """
    cell = surface.map.cell_m
    covered = surface.map.covered
    heights = np.where(covered, surface.height_m, np.float32(np.inf))
    reach = max(1, round(_OBSTACLE_REACH_M / cell))
    lowest = cv2.erode(heights, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    is_obstacle = covered & (surface.height_m - lowest > MIN_OBSTACLE_HEIGHT_M)
    if not is_obstacle.any():
        return np.zeros((*covered.shape, 2), np.float32)
    sigma = max(_OBSTACLE_BLUR_M / cell, 0.5)
    blurred = cv2.GaussianBlur(
        is_obstacle.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE
    )
    obstacle_vectors = np.stack(_gradient(blurred), -1) * np.float32(sigma * math.sqrt(2 * math.pi))
    length = np.hypot(obstacle_vectors[..., 0], obstacle_vectors[..., 1])
    obstacle_vectors /= np.maximum(length, 1)[..., None]
    obstacle_vectors[is_obstacle | ~surface.is_exposed] = 0
    return obstacle_vectors


def normals_from_slopes(slopes: np.ndarray) -> np.ndarray:
    """Return the upward unit normals [..., 3] of slopes [..., 2]."""
    normals = np.concatenate([-slopes, np.ones_like(slopes[..., :1])], -1)
    return normals / np.sqrt((normals * normals).sum(-1, keepdims=True))


def _floor_heights(height: np.ndarray, is_solid: np.ndarray, cell: float) -> np.ndarray:
    """Assumed heights where the map shows nothing, [H, W].

    A gap up to _MAX_GAP_M wide is as high as the lowest cell about it. Wider gaps are deep.
    """
    size = 2 * max(1, round(_MAX_GAP_M / 2 / cell)) + 1
    kernel = np.ones((size, size), np.uint8)
    is_narrow_gap = cv2.morphologyEx(is_solid.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    lowest = cv2.erode(np.where(is_solid, height, np.float32(1e6)), kernel)
    return np.where(is_narrow_gap & (lowest < 1e6), lowest, np.float32(-1e6))


def _local_range(
    height: np.ndarray, covered: np.ndarray, floor_heights: np.ndarray | np.float32, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest height and range of covered heights within _STEP_RADIUS_M of each cell, [H, W].

    The range means nothing where no cell is covered.
    """
    reach = max(1, round(_STEP_RADIUS_M / cell))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    lowest_covered = cv2.erode(np.where(covered, height, np.float32(1e6)), kernel)
    highest_covered = cv2.dilate(np.where(covered, height, np.float32(-1e6)), kernel)
    lowest = cv2.erode(np.where(covered, height, floor_heights), kernel)
    return lowest, highest_covered - lowest_covered


def _is_narrow(
    height: np.ndarray, is_solid: np.ndarray, floor_heights: np.ndarray | np.float32, cell: float
) -> np.ndarray:
    """Things that stand more than _MIN_NARROW_HEIGHT_M above both sides, bool [H, W].

    The two sides are _MAX_NARROW_WIDTH_M or three cells apart.
    """
    size = max(3, round(_MAX_NARROW_WIDTH_M / cell))  # a wall between two cells shows in both
    kernel = np.ones((size, size), np.uint8)
    # An even square has no middle.
    erode_anchor = (size - 1) // 2
    dilate_anchor = size - 1 - (size - 1) // 2
    heights = np.where(is_solid, height, floor_heights)
    lowest = cv2.erode(
        heights, kernel, anchor=(erode_anchor, erode_anchor), borderType=cv2.BORDER_REPLICATE
    )
    opened = cv2.dilate(
        lowest, kernel, anchor=(dilate_anchor, dilate_anchor), borderType=cv2.BORDER_REPLICATE
    )
    return is_solid & (height - opened > _MIN_NARROW_HEIGHT_M)


def _highest_step(max_slope_rad: float, cell: float) -> float:
    """Return the height of the highest step that a layer covers, metres.

    A cell that is steeper than the limit lies on a low step, not on a slope, where heights around
    it differ by no more than this. A slope as steep as the limit may differ by less.
    """
    return min(MAX_STEP_M, 2 * max(_STEP_RADIUS_M, cell) * math.tan(max_slope_rad))


def _compare_sides(
    height: np.ndarray, lowest: np.ndarray, covered: np.ndarray, is_exposed: np.ndarray, step: float
) -> np.ndarray:
    """Return the side codes of the cells, int8 [H, W, 4], see surface_kernels.compare_sides."""
    sides = np.empty((*height.shape, 4), np.int8)
    with kernel_threads(_ROWS_PER_TASK):
        surface_kernels.compare_sides(height, lowest, covered, is_exposed, step, sides)
    return sides


def _edge_distances(is_exposed: np.ndarray, sides: np.ndarray, cell: float) -> np.ndarray:
    """Return the distances to open edges, float32 [H, W], see ExposedCells.edge_distance_m."""
    edges = np.empty(is_exposed.shape, np.float32)
    with kernel_threads(_ROWS_PER_TASK):
        surface_kernels.edge_distances(
            is_exposed, sides, max(MAX_EDGE_DISTANCE_M / cell, 0.5), edges
        )
    return edges * np.float32(cell)


def _find_specks(
    is_exposed: np.ndarray,
    sides: np.ndarray,
    is_high: np.ndarray,
    min_cells: int,
    min_high_cells: int,
) -> np.ndarray:
    """Find the cells of patches that are too small to hold a layer, bool [H, W].

    A patch of linked cells that ends within the grid is too small below `min_cells` cells, or below
    `min_high_cells` cells if all of it stands high above something beside it. A patch that stands
    high nearly everywhere is too narrow at any length.

    cv2 labels patches of pixels, so links become pixels between those of the cells.
    """
    rows, columns = is_exposed.shape
    pixels = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    pixels[::2, ::2] = is_exposed
    right_sides = sides[..., 1] == LINK
    up_sides = sides[..., 3] == LINK
    pixels[::2, 1::2] = is_exposed[:, :-1] & right_sides[:, :-1] & is_exposed[:, 1:]
    pixels[1::2, ::2] = is_exposed[:-1] & up_sides[:-1] & is_exposed[1:]
    count, labels = cv2.connectedComponents(pixels, connectivity=4)
    labels = labels[::2, ::2]
    labels = labels.astype(np.int64)
    num_cells = np.bincount(labels.ravel(), minlength=count)
    num_low_cells = np.bincount(labels[is_exposed & ~is_high], minlength=count)
    is_linear = num_low_cells <= (1 - _MIN_LINEAR_SHARE) * num_cells
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        num_cells[border] = min_high_cells  # the patch may go on outside
    return (is_linear | (num_cells < np.where(num_low_cells > 0, min_cells, min_high_cells)))[
        labels
    ]


# ---- Vehicles: a reconstruction leaves shells, tufts and slivers on their sides ------------------

_MAX_SHELL_GAP_M = 0.3  # narrower dips in a roof or bonnet are gaps between shells
_BODY_BLUR_M = 0.1  # standard deviation of the blur with which slopes of bodies are measured
_MIN_STRIP_WIDTH_M = 0.3  # narrower strips are sills, mirrors and the rims of doors


def _close_vehicle_tops(height_map: HeightMap, on_vehicles: np.ndarray) -> HeightMap:
    """Raise the heights of vehicles to the top of their close surroundings."""
    covered = on_vehicles & height_map.covered
    if not covered.any():
        return height_map
    tops = np.where(covered, height_map.height_m, np.float32(-1e6))
    tops = cv2.morphologyEx(tops, cv2.MORPH_CLOSE, _disc(_MAX_SHELL_GAP_M, height_map.cell_m))
    tops = np.where(covered, tops, height_map.height_m)
    return dataclasses.replace(height_map, height_m=tops)


def _is_vehicle_top(
    height: np.ndarray,
    covered: np.ndarray,
    is_exposed: np.ndarray,
    max_slope_rad: float,
    cell: float,
) -> np.ndarray:
    """Cells on the roof or bonnet of a vehicle that can hold a layer, bool [H, W].

    Such a cell is level, lies well inside the rim, and is no sliver. A step blurred by sigma is as
    steep as h / (sigma sqrt(2 pi)), which separates the rim of a door from the roof's curvature.
    """
    if not is_exposed.any():
        return is_exposed
    sigma = max(_BODY_BLUR_M / cell, 0.5)
    weights = covered.astype(np.float32)
    total = cv2.GaussianBlur(weights, (0, 0), sigma)
    mean = cv2.GaussianBlur(height * weights, (0, 0), sigma) / np.maximum(total, np.float32(1e-6))
    max_gradient = math.tan(min(max_slope_rad, math.radians(VEHICLE_MAX_SLOPE_DEG)))
    is_level = is_exposed & (np.hypot(*_gradient(mean)) <= max_gradient * cell)
    return (
        cv2.morphologyEx(is_level.astype(np.uint8), cv2.MORPH_OPEN, _disc(_MIN_STRIP_WIDTH_M, cell))
        > 0
    )


def _disc(width_m: float, cell: float) -> np.ndarray:
    """Return a round structuring element of one cell or more."""
    side = 2 * round(width_m / cell / 2) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _fill_pockets(
    height: np.ndarray, slopes: np.ndarray, is_exposed: np.ndarray, covered: np.ndarray, cell: float
) -> np.ndarray:
    """Fill small gaps in a surface, which a layer bridges; return their cells, bool [H, W].

    Heights and slopes of the gaps are replaced by those around them, in place. A thing that stands
    out of the surface, or a gap between two levels, is not filled.
    """
    count, labels = cv2.connectedComponents((~is_exposed).astype(np.uint8), connectivity=4)
    labels = labels.astype(np.int64)
    is_pocket = np.bincount(labels.ravel(), minlength=count) <= max(1, MAX_POCKET_M2 / cell**2)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_pocket[border] = False  # the gap may go on outside
    is_pocket[labels[is_exposed]] = False
    kernel = np.ones((7, 7), np.uint8)
    highest = cv2.dilate(np.where(is_exposed, height, np.float32(-np.inf)), kernel)
    lowest = cv2.erode(np.where(is_exposed, height, np.float32(np.inf)), kernel)
    pocket_mask = is_pocket[labels]
    with np.errstate(invalid="ignore", over="ignore"):  # far from any surface both are infinite
        broken_mask = pocket_mask & ~(highest - lowest < _MAX_POCKET_STEP_M)
    broken_mask |= pocket_mask & covered & (height - highest > _MAX_BRIDGED_HEIGHT_M)
    is_pocket[labels[broken_mask]] = False
    filled_mask = is_pocket[labels]
    if not filled_mask.any():
        return filled_mask
    weights = is_exposed.astype(np.float32)
    total = cv2.GaussianBlur(weights, (0, 0), _POCKET_BLUR_CELLS)
    for values in (height, slopes[..., 0], slopes[..., 1]):
        mean = cv2.GaussianBlur(values * weights, (0, 0), _POCKET_BLUR_CELLS)
        values[filled_mask] = mean[filled_mask] / total[filled_mask]
    return filled_mask


def _gradient(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences to +x and +y per cell; 0 beyond the borders."""
    padded = np.pad(values, 1, mode="edge")
    half = np.float32(0.5)
    return (
        (padded[1:-1, 2:] - padded[1:-1, :-2]) * half,
        (padded[2:, 1:-1] - padded[:-2, 1:-1]) * half,
    )


# ---- Gaussians of the surface, which a deep enough layer hides -----------------------------------

HIDEABLE_DEPTH_M = 0.5  # depth below the surface down to which Gaussians can be hidden
HIDEABLE_HEIGHT_M = 0.08  # height above it up to which they can be hidden; half a cell at least
# The same depth below a vehicle's shell: its rear window may stand close below a spoiler.
SHELL_HIDEABLE_DEPTH_M = 0.06
# Largest angle between a flat Gaussian's normal and the surface's.
MAX_FACING_ANGLE_RAD = math.radians(40)
_MAX_FLATNESS = 0.5  # largest ratio of the shortest axis to the next one, of a flat Gaussian
# A Gaussian with no longer axis than this, no deeper below the surface, is hidden at any attitude,
_MAX_SMALL_SCALE_M = 0.06
_MAX_SMALL_DEPTH_M = 0.15
_MIN_EDGE_DISTANCE_M = 0.15  # but only so far from an open edge, where it may be a wall's top
_LOOKUP_SIGMAS = 1.5  # distance along a Gaussian's axes at which the cells over it are looked up


# Function that returns the indices, int32 [P], of the cells under points float64 [P, 2]; -1 where
# there is no cell.
CellsUnder = Callable[[np.ndarray], np.ndarray]


def find_hideable(
    gaussians: Gaussians, cells_under: CellsUnder, cells: CellList
) -> tuple[np.ndarray, np.ndarray]:
    """Find the Gaussians that are the surface or lie close beneath it.

    Returns:
        hideable_ids int32 [B] and covering_cells int32 [B, 5], see ExposedCells.
    """
    results = []
    if len(cells.sizes_m):
        slices = slices_of(len(gaussians))
        results = in_order(
            lambda part: _find_hideable_slice(gaussians, cells_under, part, cells), slices
        )
    return (
        np.concatenate([np.zeros(0, np.int32), *(ids for ids, _ in results)]),
        np.concatenate([np.zeros((0, 5), np.int32), *(cells_above for _, cells_above in results)]),
    )


def _find_hideable_slice(
    gaussians: Gaussians, cells_under: CellsUnder, part_slice: slice, cells: CellList
) -> tuple[np.ndarray, np.ndarray]:
    """Do the work of `find_hideable` for a slice of the Gaussians that fits a core's caches."""
    normals = cells.normals
    means = gaussians.means[part_slice].numpy().astype(np.float64)
    ids_below = cells_under(means[:, :2])
    index = np.flatnonzero(ids_below >= 0)
    cell_ids = ids_below[index]
    offset = means[index] - cells.centers_m[cell_ids]
    rise = (offset * normals[cell_ids]).sum(1) / normals[
        cell_ids, 2
    ]  # above the cell's plane, along z
    hideable_depth_m = np.where(cells.is_shell[cell_ids], SHELL_HIDEABLE_DEPTH_M, HIDEABLE_DEPTH_M)
    is_near = (rise > -hideable_depth_m) & (
        rise < np.maximum(HIDEABLE_HEIGHT_M, cells.sizes_m[cell_ids] / 2)
    )
    index = index[is_near]
    cell_ids = cell_ids[is_near]
    rise = rise[is_near]
    rows = torch.from_numpy(index)
    axes = rotmat_from_quat(gaussians.quats[part_slice][rows]).numpy()  # columns: the axes
    scales = gaussians.scales[part_slice][rows].numpy()
    order = np.argsort(scales, axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[:, None, :], 2)
    scales = np.take_along_axis(scales, order, 1)
    is_facing = np.abs((axes[..., 0] * normals[cell_ids]).sum(1)) >= math.cos(MAX_FACING_ANGLE_RAD)
    is_flat = scales[:, 0] <= _MAX_FLATNESS * scales[:, 1]
    is_small = (
        (scales[:, 2] < _MAX_SMALL_SCALE_M)
        & (rise > -_MAX_SMALL_DEPTH_M)
        & (cells.edge_distance_m[cell_ids] >= _MIN_EDGE_DISTANCE_M)
    )
    is_surface = (is_flat & is_facing) | is_small
    index = index[is_surface]
    cell_ids = cell_ids[is_surface]
    axes = axes[is_surface]
    scales = scales[is_surface]
    lookups = [cell_ids]
    for axis in (2, 1):
        for sign in (1, -1):
            offset_xy = sign * _LOOKUP_SIGMAS * scales[:, axis, None] * axes[:, :2, axis]
            lookups.append(cells_under(means[index, :2] + offset_xy))
    covering_cells = np.stack(lookups, 1)
    is_covered = (covering_cells >= 0).all(1)
    return (part_slice.start + index[is_covered]).astype(np.int32), covering_cells[
        is_covered
    ].astype(np.int32)


# Standing things that lean into a vehicle's box, and the ground below it, do not stray.
_FIXED_CLASSES = tuple(
    SemanticClass[n]
    for n in (
        *("ROAD", "LANE_MARKING", "SIDEWALK", "TERRAIN"),
        *("VEGETATION", "BUILDING", "POLE", "SIGN", "PEDESTRIAN"),
    )
)
# Depth below the middle of a box down to which a bonnet or boot may lie, in heights of the box.
_MAX_BELT_SHARE = 0.2
_SQUARE_M = 2.0  # side of the squares in which Gaussians near shells are looked for
_MAX_STRAY_SCALE_M = 0.12  # longest axis of a Gaussian that strays; larger ones are no stray
_MAX_STRAY_HEIGHT_M = 0.2  # height above a shell up to which Gaussians stray
_MIN_STRAY_HEIGHT_M = 0.02  # height above a shell from which on they do
_MIN_STRAY_HEIGHT_BESIDE_M = -0.04  # the same beside a roof or bonnet, over its edge


def ids_near(means: np.ndarray, centres: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """Return the ids of means in the squares of a coarse grid that some rectangles touch.

    Args:
        means: places, [N, 3].
        centres: centres of the rectangles, [R, 2], at least one.
        reaches: half their sizes, [R, 2].
    """
    corner = (centres - reaches).min(0)
    first = np.floor((centres - reaches - corner) / _SQUARE_M).astype(int)
    last = np.floor((centres + reaches - corner) / _SQUARE_M).astype(int)
    num_squares = last.max(0) + 1
    is_touched = np.zeros(num_squares, bool)
    for (x0, y0), (x1, y1) in zip(first, last, strict=True):
        is_touched[x0 : x1 + 1, y0 : y1 + 1] = True
    side = means.dtype.type(_SQUARE_M)
    columns = np.floor((means[:, 0] - means.dtype.type(corner[0])) / side)
    rows = np.floor((means[:, 1] - means.dtype.type(corner[1])) / side)
    is_inside = (columns >= 0) & (columns < num_squares[0])
    is_inside &= (rows >= 0) & (rows < num_squares[1])
    ids = np.flatnonzero(is_inside)
    return ids[is_touched[columns[ids].astype(np.int64), rows[ids].astype(np.int64)]]


def find_strays(
    gaussians: Gaussians, shells: Sequence[PlacedShell], cells_under: CellsUnder, cells: CellList
) -> tuple[np.ndarray, np.ndarray]:
    """Find the Gaussians that float over a shell or beside its edges, within the vehicle's box.

    Nothing of a vehicle is there but rails and aerials. A reconstruction leaves noise there, which
    would lie before the layer.

    Returns:
        Ids of the Gaussians int32 [B], in order, and covering cells int32 [B, 5], five times the
        cell below or next to each, see ExposedCells.
    """
    found_ids = [np.zeros(0, np.int64)]
    found_cells = [np.zeros(0, np.int32)]
    if len(cells.sizes_m) and len(shells):
        centres = np.array([shell.centre_m[:2] for shell in shells])
        reaches = np.array([shell.reach_m for shell in shells])
        candidate_ids = ids_near(gaussians.means.numpy(), centres, reaches)
        classes = classes_of(gaussians)[candidate_ids]
        candidate_ids = candidate_ids[~np.isin(classes, _FIXED_CLASSES)]
        for axis in range(3):
            is_small = gaussians.scales.numpy()[candidate_ids, axis] < _MAX_STRAY_SCALE_M
            candidate_ids = candidate_ids[is_small]
        means = gaussians.means.numpy()[candidate_ids]
        order = np.argsort(means[:, 0], kind="stable")
        sorted_x = means[order, 0]
        for placed_shell in shells:
            reach = placed_shell.reach_m[0]
            low, high = np.searchsorted(
                sorted_x, placed_shell.centre_m[0] + np.array([-reach, reach])
            )
            rows = np.sort(order[low:high])
            lowest_m = placed_shell.centre_m[2] - _MAX_BELT_SHARE * placed_shell.shell.size_m[2]
            rows = rows[means[rows, 2] > lowest_m]
            rows = rows[placed_shell.has_in_plan(means[rows])]
            places = means[rows].astype(np.float64)
            nearest_tops, is_beside = placed_shell.nearest_tops(places)
            for nearest_xy, is_aside in zip(nearest_tops, is_beside, strict=True):
                cell_ids = cells_under(nearest_xy)
                offset = places - cells.centers_m[cell_ids]
                offset[:, :2] = nearest_xy - cells.centers_m[cell_ids, :2]
                normals = cells.normals[cell_ids]
                rise = (offset * normals).sum(1) / normals[:, 2]
                lowest = np.where(is_aside, _MIN_STRAY_HEIGHT_BESIDE_M, _MIN_STRAY_HEIGHT_M)
                is_stray = (cell_ids >= 0) & cells.is_shell[cell_ids]
                is_stray &= (rise > lowest) & (rise < _MAX_STRAY_HEIGHT_M)
                found_ids.append(candidate_ids[rows[is_stray]])
                found_cells.append(cell_ids[is_stray])
    ids, first = np.unique(np.concatenate(found_ids), return_index=True)
    covering = np.concatenate(found_cells)[first]
    return ids.astype(np.int32), np.repeat(covering[:, None], 5, 1).astype(np.int32)


# ---- Cells of grids, joined list by list, and made into a record ---------------------------------


class CellList(NamedTuple):
    """Cells of some grid: C rows of arrays, with the fields of ExposedCells and three others."""

    centers_m: np.ndarray
    normals: np.ndarray
    sizes_m: np.ndarray
    edge_distance_m: np.ndarray
    # int8 [C, 4], LINK where a cell of the same size follows, or OPEN_EDGE or FLUSH.
    sides: np.ndarray
    luminance: np.ndarray  # luminance of the bare ground, see ground_luminance; NaN where unknown
    track_share: np.ndarray
    obstacle_vectors: np.ndarray
    semantic: np.ndarray
    depth_share: np.ndarray
    is_shell: np.ndarray  # bool [C], the surface is the shell of a vehicle

    @staticmethod
    def joined(lists: Sequence[CellList]) -> CellList:
        """Join several lists, in order."""
        return CellList(*map(np.concatenate, zip(*lists, strict=True)))

    @staticmethod
    def empty() -> CellList:
        """Return a list without cells."""
        no_values = np.zeros(0, np.float32)
        no_pairs = np.zeros((0, 2), np.float32)
        normals = np.zeros((0, 3), np.float32)
        sides = np.zeros((0, 4), np.int8)
        semantic = np.zeros(0, np.int16)
        return CellList(
            np.zeros((0, 3)),
            normals,
            no_values,
            no_values,
            sides,
            no_values,
            no_values,
            no_pairs,
            semantic,
            no_values,
            np.zeros(0, bool),
        )


def cells_at(
    surface: Surface,
    rows: np.ndarray,
    columns: np.ndarray,
    *,
    sides: np.ndarray,
    luminance: np.ndarray | None = None,
    track_share: np.ndarray | None = None,
    obstacle_vectors: np.ndarray | None = None,
    classes: np.ndarray,
) -> CellList:
    """Return the cells of a surface at rows and columns [C]; the other arrays are [H, W]."""
    x, y = surface.map.centers()
    num_cells = len(rows)
    index = (rows, columns)
    height = surface.height_m[index].astype(np.float64)
    return CellList(
        centers_m=np.stack([x[columns], y[rows], height], 1),
        normals=normals_from_slopes(surface.slopes[index]).astype(np.float32),
        sizes_m=np.full(num_cells, surface.map.cell_m, np.float32),
        edge_distance_m=surface.edge_distance_m[index],
        sides=sides[index],
        luminance=np.full(num_cells, np.nan, np.float32) if luminance is None else luminance[index],
        track_share=np.zeros(num_cells, np.float32) if track_share is None else track_share[index],
        obstacle_vectors=np.zeros((num_cells, 2), np.float32)
        if obstacle_vectors is None
        else obstacle_vectors[index],
        semantic=classes[index],
        depth_share=np.ones(num_cells, np.float32)
        if surface.shells is None
        else surface.shells.depth_share[index],
        is_shell=np.zeros(num_cells, bool)
        if surface.shells is None
        else surface.shells.is_top[index],
    )


def _link_slice(
    cells: CellList, cells_under: CellsUnder, part_slice: slice, neighbours: np.ndarray
) -> None:
    """Write the indices of linked cells into `neighbours`, int32 [P, 4], for a slice of cells."""
    centers_m = cells.centers_m[part_slice, :2]
    sizes_m = cells.sizes_m[part_slice]
    sides = cells.sides[part_slice]
    for side, step in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        rows = np.flatnonzero(sides[:, side] == LINK)
        cell_ids = cells_under(centers_m[rows] + np.array(step) * sizes_m[rows, None])
        is_same_size = (cell_ids >= 0) & (cells.sizes_m[cell_ids] == sizes_m[rows])
        neighbours[rows, side] = np.where(is_same_size, cell_ids, FLUSH)


def make_cells(
    cells: CellList,
    light: np.ndarray,
    cells_under: CellsUnder,
    gaussians: Gaussians,
    shells: Sequence[PlacedShell] = (),
) -> ExposedCells:
    """Make the record of cells: link neighbours by their places, and find the Gaussians below.

    Args:
        cells: the cells.
        light: light on them, float32 [C].
        cells_under: function that finds the cells under points.
        gaussians: Gaussians of the part.
        shells: shells of vehicles in the part's frame; Gaussians that stray about them are hidden.
    """
    neighbours = cells.sides.astype(np.int32)
    in_order(
        lambda part: _link_slice(cells, cells_under, part, neighbours[part]),
        slices_of(len(cells.sizes_m)),
    )
    hideable_ids, covering_cells = find_hideable(gaussians, cells_under, cells)
    stray_ids, cells_beside = find_strays(gaussians, shells, cells_under, cells)
    is_further = ~np.isin(stray_ids, hideable_ids)
    hideable_ids = np.concatenate([hideable_ids, stray_ids[is_further]])
    covering_cells = np.concatenate([covering_cells, cells_beside[is_further]])
    return ExposedCells(
        centers_m=torch.from_numpy(cells.centers_m.astype(np.float32)),
        normals=torch.from_numpy(cells.normals),
        sizes_m=torch.from_numpy(cells.sizes_m),
        edge_distance_m=torch.from_numpy(cells.edge_distance_m),
        neighbours=torch.from_numpy(neighbours),
        relative_light=torch.from_numpy(light),
        track_share=torch.from_numpy(cells.track_share),
        obstacle_vectors=torch.from_numpy(cells.obstacle_vectors),
        semantic=torch.from_numpy(cells.semantic),
        depth_share=torch.from_numpy(cells.depth_share),
        hideable_ids=torch.from_numpy(hideable_ids),
        covering_cells=torch.from_numpy(covering_cells),
    )


# ---- Vehicles among the actors -------------------------------------------------------------------

MIN_TRAVEL_M = 0.5  # an actor that goes less far than this is parked
_GROUND_CLASSES = tuple(SemanticClass[n] for n in ("ROAD", "LANE_MARKING", "SIDEWALK", "TERRAIN"))


def is_vehicle(actor: Actor) -> bool:
    """Tell if an actor is a vehicle.

    Most of its Gaussians, those of the ground excepted, must be a vehicle's. Without classes, its
    label decides. The recording car does not count.
    """
    if actor.label == EGO_VEHICLE or len(actor.gaussians) == 0:
        return False
    classes = classes_of(actor.gaussians)
    body_classes = classes[~np.isin(classes, (*_GROUND_CLASSES, SemanticClass.UNKNOWN))]
    if len(body_classes):
        return int(np.bincount(body_classes).argmax()) == SemanticClass.VEHICLE
    return class_of_label(actor.label) == SemanticClass.VEHICLE


def is_moving(actor: Actor) -> bool:
    """Tell if an actor goes anywhere during the drive."""
    positions = actor.track.world_from_actor[:, :3, 3]
    return bool(((positions - positions[0]).norm(dim=1) > MIN_TRAVEL_M).any())
