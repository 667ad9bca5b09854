"""Where on a height map snow can lie: slopes, what hangs together, edges, obstacles beside."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from augment.effects.snow import surface_kernels
from augment.effects.snow.cells import EDGE_CAP_M, FLUSH, SnowCells
from augment.effects.snow.height_map import (
    Estimator,
    Footprints,
    HeightMap,
    classes_of,
    draw_from_above,
    in_order,
    plain_gaussians,
    slices_of,
)
from augment.effects.snow.surface_kernels import LINK, RISES
from augment.geometry import rotmat_from_quat
from augment.labels import EGO_VEHICLE
from augment.render.buffers import AUTO
from augment.render.threads import kernel_threads
from augment.scene import Actor, Gaussians, PosedGaussians
from augment.semantics import SemanticClass, class_of_label

STEP_M = 0.25  # lower steps do not break a layer: kerbs
_AROUND_M = 0.4  # of a cell: steps are told by the heights within
_NARROW_M, _HIGH_M = 0.4, 1.5  # what is so narrow and so high carries nothing: wires, arms of lamps
_HIGH_M2 = 0.6  # smaller patches so high up are ledges, and what floats before walls
_LINEAR = 0.85  # share of a patch that is high above what is beside it: wires, tops of fences
_GAP_M = 0.6  # wider gaps may be deep
_STANDS_OUT_M = 0.1  # of a surface, so that it is not bridged
MIN_AREA_M2, MIN_CELLS = 0.05, 4  # smaller patches are specks
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
    min_area_m2: float = MIN_AREA_M2,
    floor_m: float | None = None,
    on_vehicles: np.ndarray,
) -> Surface:
    """The surface of a map, and where snow stays on it.

    may_carry: bool [H, W]; where it is false nothing is put, whatever lies there. Patches that end
    within the map and are smaller than min_area_m2 or MIN_CELLS carry nothing. floor_m: how
    high that lies which the map does not show; None for deep but in small gaps. on_vehicles: bool
    [H, W], where it is a vehicle's body, see `_vehicle_tops` and `_is_vehicle_top`.
    """
    height_map = _vehicle_tops(height_map, on_vehicles)
    cell, covered = height_map.cell_m, height_map.covered.copy()
    shape = covered.shape
    smooth, fitted = np.empty(shape, np.float32), np.empty(shape, np.float32)
    slopes, good = np.empty((*shape, 2), np.float32), np.empty(shape, bool)
    limit = math.radians(max_slope_deg)
    with kernel_threads(_ROWS):
        surface_kernels.median_heights(
            height_map.height_m, covered, int(np.clip(round(_MEDIAN_M / cell), 1, 3)), smooth
        )
        steepest = math.tan(min(limit + _STEEPER_RAD, _STEEPEST_RAD))
        surface_kernels.fit_planes(
            *(smooth, covered, int(np.clip(round(_SMOOTH_M / cell), 1, 5)), cell, _SLACK_M),
            *(steepest, _SMOOTHED_BY_M, fitted, slopes, good),
        )
    floor = _floor(fitted, covered & may_carry, cell) if floor_m is None else np.float32(floor_m)
    lowest, rises = _rises(fitted, covered, floor, cell)
    steep = np.hypot(slopes[..., 0], slopes[..., 1]) > math.tan(limit)
    can_carry = good & may_carry & ~_is_narrow(fitted, covered & may_carry, floor, cell)
    can_carry &= ~(steep & (rises > _highest_step(limit, cell)))
    can_carry &= ~on_vehicles | _is_vehicle_top(
        fitted, covered, can_carry & on_vehicles, limit, cell
    )
    step = max(STEP_M, math.tan(limit) * cell)
    sides = _compare(fitted, lowest, covered, can_carry, step)
    least = max(MIN_CELLS, math.ceil(min_area_m2 / cell**2))
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
    height: np.ndarray, lowest: np.ndarray, covered: np.ndarray, can_carry: np.ndarray, step: float
) -> np.ndarray:
    sides = np.empty((*height.shape, 4), np.int8)
    with kernel_threads(_ROWS):
        surface_kernels.compare_sides(height, lowest, covered, can_carry, step, sides)
    return sides


def _specks(
    can_carry: np.ndarray, sides: np.ndarray, is_high: np.ndarray, least: int, least_high: int
) -> np.ndarray:
    """bool [H, W]: cells in patches of fewer than `least` linked cells that end within the grid;
    of fewer than `least_high` where all of them are high above something beside. Also patches that
    are high above it nearly everywhere, whatever their length: they are nowhere wide.

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
    is_linear = low <= (1 - _LINEAR) * sizes
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        sizes[border] = least_high  # it may go on outside
    return (is_linear | (sizes < np.where(low > 0, least, least_high)))[labels]


# ---- Vehicles: a reconstruction leaves shells, tufts and slivers on their sides ------------------

VEHICLE_MAX_SLOPE_DEG = 38.0  # wind screens carry snow, side and rear windows do not
_SHELL_M = 0.3  # narrower dips in a roof or bonnet are gaps between shells
_BODY_M = 0.1  # standard deviation of the blur that slopes of bodies are measured by
_SLIVER_M = 0.3  # narrower strips are sills, mirrors and the rims of doors


def _vehicle_tops(height_map: HeightMap, on_vehicles: np.ndarray) -> HeightMap:
    """The map with a vehicle's height everywhere at the top of what surrounds it closely."""
    covered = on_vehicles & height_map.covered
    if not covered.any():
        return height_map
    tops = np.where(covered, height_map.height_m, np.float32(-1e6))
    tops = cv2.morphologyEx(tops, cv2.MORPH_CLOSE, _disc(_SHELL_M, height_map.cell_m))
    tops = np.where(covered, tops, height_map.height_m)
    return dataclasses.replace(height_map, height_m=tops)


def _is_vehicle_top(
    height: np.ndarray, covered: np.ndarray, can_carry: np.ndarray, limit: float, cell: float
) -> np.ndarray:
    """bool [H, W]: cells of vehicles that can carry snow which lie on a roof or bonnet: level, well
    inside its rim, and no sliver. A step blurred by sigma is as steep as h / (sigma sqrt(2 pi)), so
    that the rim of a door is told from the roof's curvature.
    """
    if not can_carry.any():
        return can_carry
    sigma = max(_BODY_M / cell, 0.5)
    weights = covered.astype(np.float32)
    total = cv2.GaussianBlur(weights, (0, 0), sigma)
    mean = cv2.GaussianBlur(height * weights, (0, 0), sigma) / np.maximum(total, np.float32(1e-6))
    steepest = math.tan(min(limit, math.radians(VEHICLE_MAX_SLOPE_DEG)))
    level = can_carry & (np.hypot(*_gradient(mean)) <= steepest * cell)
    return cv2.morphologyEx(level.astype(np.uint8), cv2.MORPH_OPEN, _disc(_SLIVER_M, cell)) > 0


def _disc(width_m: float, cell: float) -> np.ndarray:
    """A round structuring element, of one cell at least."""
    side = 2 * round(width_m / cell / 2) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


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


# ---- Which Gaussians are the surface that snow lies on: it hides them where it is deep enough ----

BELOW_M, ABOVE_M = 0.5, 0.08  # of the support; above, half a cell at least
FACING_RAD = math.radians(40)  # between a flat Gaussian's normal and the support's
_FLAT = 0.5  # shortest axis over the next, of a flat Gaussian
_SMALL_M, _SMALL_BELOW_M = 0.06, 0.15  # what is small and just beneath goes whichever way it faces
_INLAND_M = 0.15  # but not near an open edge, where it may be a wall's top
_SIGMAS = 1.5


# Numbers int32 [P] of the cells under points float64 [P, 2], -1 where there is none.
CellsUnder = Callable[[np.ndarray], np.ndarray]


def find_buried(
    gaussians: Gaussians, cells_under: CellsUnder, cells: CellList
) -> tuple[np.ndarray, np.ndarray]:
    """buried int32 [B] and buried_by int32 [B, 5], see SnowCells; only such as can be hidden."""
    found = []
    if len(cells.sizes_m):
        parts = slices_of(len(gaussians))
        found = in_order(lambda part: _find_part(gaussians, cells_under, part, cells), parts)
    return (
        np.concatenate([np.zeros(0, np.int32), *(buried for buried, _ in found)]),
        np.concatenate([np.zeros((0, 5), np.int32), *(by for _, by in found)]),
    )


def _find_part(
    gaussians: Gaussians, cells_under: CellsUnder, part: slice, cells: CellList
) -> tuple[np.ndarray, np.ndarray]:
    """As find_buried, of part of the Gaussians: of so few that what is found lies in the caches."""
    normals = cells.normals
    means = gaussians.means[part].numpy().astype(np.float64)
    under = cells_under(means[:, :2])
    index = np.flatnonzero(under >= 0)
    cell = under[index]
    offset = means[index] - cells.centers_m[cell]
    rise = (offset * normals[cell]).sum(1) / normals[cell, 2]  # above the cell's plane, along z
    near = (rise > -BELOW_M) & (rise < np.maximum(ABOVE_M, cells.sizes_m[cell] / 2))
    index, cell, rise = index[near], cell[near], rise[near]
    rows = torch.from_numpy(index)
    axes = rotmat_from_quat(gaussians.quats[part][rows]).numpy()  # columns: the axes
    scales = gaussians.scales[part][rows].numpy()
    order = np.argsort(scales, axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[:, None, :], 2)
    scales = np.take_along_axis(scales, order, 1)
    facing = np.abs((axes[..., 0] * normals[cell]).sum(1)) >= math.cos(FACING_RAD)
    flat = scales[:, 0] <= _FLAT * scales[:, 1]
    small = (scales[:, 2] < _SMALL_M) & (rise > -_SMALL_BELOW_M) & (cells.edge_m[cell] >= _INLAND_M)
    lies = (flat & facing) | small
    index, cell, axes, scales = index[lies], cell[lies], axes[lies], scales[lies]
    over = [cell]
    for axis in (2, 1):
        for sign in (1, -1):
            reach = sign * _SIGMAS * scales[:, axis, None] * axes[:, :2, axis]
            over.append(cells_under(means[index, :2] + reach))
    buried_by = np.stack(over, 1)
    whole = (buried_by >= 0).all(1)
    return (part.start + index[whole]).astype(np.int32), buried_by[whole].astype(np.int32)


# ---- Cells taken from grids, one list after another, and made into a record ----------------------


class CellList(NamedTuple):
    """Cells of some grid: arrays of C rows, as SnowCells has them but for

    sides: int8 [C, 4], LINK where a cell of the same size is expected, else OPEN_EDGE or FLUSH.
    luminance: of the bare ground (see ground_luminance), NaN where not known.
    """

    centers_m: np.ndarray
    normals: np.ndarray
    sizes_m: np.ndarray
    edge_m: np.ndarray
    sides: np.ndarray
    luminance: np.ndarray
    tracks: np.ndarray
    banks: np.ndarray
    semantic: np.ndarray

    @staticmethod
    def joined(lists: Sequence[CellList]) -> CellList:
        """All of them, in order."""
        return CellList(*map(np.concatenate, zip(*lists, strict=True)))

    @staticmethod
    def empty() -> CellList:
        none, pairs = np.zeros(0, np.float32), np.zeros((0, 2), np.float32)
        normals, sides = np.zeros((0, 3), np.float32), np.zeros((0, 4), np.int8)
        semantic = np.zeros(0, np.int16)
        return CellList(np.zeros((0, 3)), normals, none, none, sides, none, none, pairs, semantic)


def cells_at(
    surface: Surface,
    rows: np.ndarray,
    columns: np.ndarray,
    *,
    sides: np.ndarray,
    luminance: np.ndarray | None = None,
    tracks: np.ndarray | None = None,
    banks: np.ndarray | None = None,
    classes: np.ndarray,
) -> CellList:
    """The cells of a surface at rows and columns [C]; the other arrays are the grid's."""
    x, y = surface.map.centers()
    count = len(rows)
    at = (rows, columns)
    height = surface.height_m[at].astype(np.float64)
    return CellList(
        centers_m=np.stack([x[columns], y[rows], height], 1),
        normals=normals_of(surface.slopes[at]).astype(np.float32),
        sizes_m=np.full(count, surface.map.cell_m, np.float32),
        edge_m=surface.edge_m[at],
        sides=sides[at],
        luminance=np.full(count, np.nan, np.float32) if luminance is None else luminance[at],
        tracks=np.zeros(count, np.float32) if tracks is None else tracks[at],
        banks=np.zeros((count, 2), np.float32) if banks is None else banks[at],
        semantic=classes[at],
    )


def _link(cells: CellList, cells_under: CellsUnder, part: slice, neighbours: np.ndarray) -> None:
    """Put the numbers of the cells that part of the cells are linked to into int32 [P, 4]."""
    centers_m, sizes_m, sides = cells.centers_m[part, :2], cells.sizes_m[part], cells.sides[part]
    for side, step in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
        linked = np.flatnonzero(sides[:, side] == LINK)
        to = cells_under(centers_m[linked] + np.array(step) * sizes_m[linked, None])
        same = (to >= 0) & (cells.sizes_m[to] == sizes_m[linked])
        neighbours[linked, side] = np.where(same, to, FLUSH)


def make_cells(
    cells: CellList, light: np.ndarray, cells_under: CellsUnder, gaussians: Gaussians
) -> SnowCells:
    """The record: neighbours found by their places, and the Gaussians that the cells bury."""
    neighbours = cells.sides.astype(np.int32)
    in_order(
        lambda part: _link(cells, cells_under, part, neighbours[part]),
        slices_of(len(cells.sizes_m)),
    )
    buried, buried_by = find_buried(gaussians, cells_under, cells)
    kept = ("normals", "sizes_m", "edge_m", "tracks", "banks", "semantic")
    return SnowCells(
        **{name: torch.from_numpy(getattr(cells, name)) for name in kept},
        centers_m=torch.from_numpy(cells.centers_m.astype(np.float32)),
        neighbours=torch.from_numpy(neighbours),
        light=torch.from_numpy(light),
        buried=torch.from_numpy(buried),
        buried_by=torch.from_numpy(buried_by),
    )


# ---- Where snow lies on vehicles: cells in their own frames, carried along as they drive ---------

MAX_CELL_M = 0.05
MIN_ACTOR_AREA_M2 = 0.3  # of all cells of a vehicle: less is not worth a layer
MOVES_M = 0.5  # an actor that goes less far is parked
DRIVEN_MAX_SLOPE_DEG = 25.0  # drivers clear their windows, and what is steeper slides off
_BOTTOM_M = 0.25  # of the box: there are wheels, and the shadow on the road
_MARGIN_M = 0.3  # beyond the box: mirrors, and boxes that are too small
_PATCH_M2 = 0.15
_GROUND = tuple(SemanticClass[n] for n in ("ROAD", "LANE_MARKING", "SIDEWALK", "TERRAIN"))


def is_vehicle(actor: Actor) -> bool:
    """Whether most of its Gaussians, the ground's excepted, are a vehicle's; by its label where
    none has a class. The recording car is none.
    """
    if actor.label == EGO_VEHICLE or len(actor.gaussians) == 0:
        return False
    classes = classes_of(actor.gaussians)
    own = classes[~np.isin(classes, (*_GROUND, SemanticClass.UNKNOWN))]
    if len(own):
        return int(np.bincount(own).argmax()) == SemanticClass.VEHICLE
    return class_of_label(actor.label) == SemanticClass.VEHICLE


def moves(actor: Actor) -> bool:
    """Whether it goes anywhere during the drive."""
    places = actor.track.world_from_actor[:, :3, 3]
    return bool(((places - places[0]).norm(dim=1) > MOVES_M).any())


def find_actor_cells(
    actor: Actor, *, cell_m: float, max_slope_deg: float, estimator: Estimator, backend: str = AUTO
) -> SnowCells | None:
    """Cells on a vehicle, in its own frame; None where it has too few to carry snow. backend: that
    draws it.

    Its open edges are all round: what does not rise beside a cell falls away.
    """
    cell = min(cell_m, MAX_CELL_M)
    gaussians = plain_gaussians(actor.gaussians)
    half = np.array(actor.size_m[:2]) / 2 + _MARGIN_M
    if not (np.isfinite(half).all() and (half < 100).all()):
        return None
    classes = classes_of(gaussians)
    own = ~np.isin(classes, _GROUND)
    own &= gaussians.means.numpy()[:, 2] > _BOTTOM_M - actor.size_m[2] / 2
    chosen = np.intersect1d(Footprints(gaussians).in_box(-half, half), np.flatnonzero(own))
    if len(chosen) == 0:
        return None
    cells_half = np.ceil(half / cell).astype(int)
    shape = (2 * int(cells_half[1]), 2 * int(cells_half[0]))
    body = gaussians.select(_index(chosen))
    view = draw_from_above(
        [PosedGaussians(body)],
        corner_m=(-cell * float(cells_half[0]), -cell * float(cells_half[1])),
        cell_m=cell,
        shape=shape,
        estimator=estimator,
        with_thin=False,
        backend=backend,
    )
    bottom = np.float32(_BOTTOM_M - actor.size_m[2] / 2)
    limit = min(max_slope_deg, DRIVEN_MAX_SLOPE_DEG) if moves(actor) else max_slope_deg
    body_only = view.height_m > bottom
    body_only[[0, -1]] = body_only[:, [0, -1]] = False  # an edge all round, even of what is cut off
    view = dataclasses.replace(view, alpha=np.where(body_only, view.alpha, np.float32(0)))
    surface = find_surface(
        view,
        body_only,
        max_slope_deg=limit,
        min_area_m2=_PATCH_M2,
        floor_m=float(bottom),
        on_vehicles=body_only,
    )
    rows, columns = np.nonzero(surface.can_carry)
    if len(rows) * cell**2 < MIN_ACTOR_AREA_M2:
        return None
    grid, own_classes = surface.map, classes[chosen]
    seen = np.where(grid.ids >= 0, own_classes[np.maximum(grid.ids, 0)], SemanticClass.VEHICLE)
    under = _cells_of_grid(grid, rows, columns)
    sides = np.where(surface.sides == RISES, FLUSH, surface.sides)
    cells = cells_at(surface, rows, columns, sides=sides, classes=seen.astype(np.int16))
    found = make_cells(cells, np.ones(len(rows), np.float32), under, body)
    found.buried.copy_(_index(chosen)[found.buried.long()])
    return found


def _index(numbers: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _cells_of_grid(grid: HeightMap, rows: np.ndarray, columns: np.ndarray) -> CellsUnder:
    """Of a single grid that has cells at rows and columns [C]."""
    corner = np.array([grid.left_m, grid.bottom_m])
    numbers: np.ndarray = np.full(grid.alpha.shape, -1, np.int32)
    numbers[rows, columns] = np.arange(len(rows), dtype=np.int32)

    def cells_under(xy: np.ndarray) -> np.ndarray:
        place = np.floor((xy - corner) / grid.cell_m)
        inside = ((place >= 0) & (place < numbers.shape[::-1])).all(1)
        out = np.full(len(xy), -1, np.int32)
        cell = place[inside].astype(np.int64)
        out[inside] = numbers[cell[:, 1], cell[:, 0]]
        return out

    return cells_under
