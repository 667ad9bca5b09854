"""Wheel passes of many cars over a road with snow.

Input: a scene, the cells of its ground, the strength of the traffic and a seed. The result depends
on nothing else, so that it is the same at all times and in all cameras. Output: `RoadWear`, numbers
of each cell. Caller: `slush`.

1. Lanes are the paths of the ego and of the scene's moving vehicles, and lanes parallel to the
   ego's path where there is road and no path of a vehicle.
2. In each lane some cars drive. Each one keeps its own distance from the lane's middle, wanders by
   some decimetres over tens of metres, and now and then changes lanes.
3. Points along the wheels' lines are counted on a grid, block by block, and blurred to the width of
   a tyre. The result is the number of passes over each place.
4. Spreads of it say where wheels splash, and where they push slush to.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import KDTree

from augment.exposure.cells import ExposedCells
from augment.exposure.wheel_tracks import WHEEL_OFFSET_SHARE, WheelPath, parallel_path
from augment.rng import rng_for
from augment.scene.semantics import SemanticClass

# ---- Lanes and cars ------------------------------------------------------------------------------

LANE_WIDTH_M = 3.3  # distance of parallel lanes
NUM_SIDE_LANES = 3  # largest number of parallel lanes on each side of the ego's path
MIN_CARS = 2  # number of cars in a lane at the least traffic
MAX_CARS = 40  # number of cars in a lane at a traffic of 1
_EXTENSION_M = 30.0  # length by which lanes go straight on at both ends
STEP_M = 0.05  # distance of points along a wheel's line
_SMOOTHING_M = 1.5  # standard deviation of the blur along a path: labelled boxes jitter
_SMOOTHING_REACH = 4.0  # half width of that blur, in standard deviations
_SAME_LANE_M = 1.2  # distance of paths that share a lane
_LANE_GAP_M = 1.9  # least distance of a parallel lane from the path of a vehicle
_LANE_HALF_WIDTH_M = 0.95  # distance from a lane's middle at which there must be road
_ROAD_REACH_M = 0.5  # largest distance of a cell of road from a point that counts as road
_ROAD_WINDOW_M = 12.0  # length of the stretch over which the share of road is taken
_RECORDED_WINDOW_M = 3.0  # the same for a path that a vehicle has taken
_MIN_ROAD_SHARE = 0.55  # shares of road between which a lane begins
_FULL_ROAD_SHARE = 0.8
_OFFSET_M = 0.15  # standard deviation of a car's distance from the lane's middle
_WANDER_M = 0.13  # standard deviation of its wandering
_WANDER_LENGTHS_M = (17.0, 34.0, 71.0)  # wave lengths of the wandering
_CAR_WIDTHS_M = (1.6, 2.0)  # narrowest and widest car
_CHANGE_SHARE = 0.12  # share of cars that change lanes
_CHANGE_LENGTHS_M = (18.0, 40.0)  # shortest and longest way of such a change
_RECORDED_WEIGHT = 2.0  # passes of a vehicle whose path is recorded
_LANE_REACH_M = 6.0  # distance from a lane's middle within which its wheels are
_MIN_WEIGHT = 0.4  # least weight of a pass; others lie under fresh snow

# ---- The grid ------------------------------------------------------------------------------------

GRID_M = 0.05  # side of a cell of the grid
_BLOCK_M = 38.4  # side of a block
_MARGIN_M = 3.0  # width of the margin about a block
_TYRE_SIGMA_M = 0.07  # standard deviation of a tyre's print
SATURATION = 2.5  # passes that flatten all but 1/e of the snow
_SPLASH_M = 0.45  # standard deviation of the splash beside wheels
_RIDGE_M = 0.2  # standard deviation of the slush that wheels push aside
_MAX_KERB_M = 2.5  # largest distance from the road's edge that is told apart
# Height over or under the road from which on a cell beside it gets nothing from it.
_MAX_VERGE_GAP_M = 0.35
_CLOSING_M = 0.6  # width of gaps in the road's cells that count as road
_MAX_HEIGHT_GAP_M = 0.8  # height over a lane up to which a cell belongs to its road
_MAX_UNCLASSED_GAP_M = 0.3  # the same where the scene has no classes
_UNCLASSED_WIDTH_M = 5.5  # distance from a lane up to which a cell without class is road
_ROAD_CLASSES = (int(SemanticClass.ROAD), int(SemanticClass.LANE_MARKING))


@dataclass(frozen=True, eq=False)
class RoadWear:
    """Traces of traffic on C cells of the ground, all [C]."""

    is_road: np.ndarray
    """bool, cells of a road that vehicles use."""
    passes: np.ndarray
    """float32, number of wheels that have passed, counted in the middle of a tyre's print."""
    splash: np.ndarray
    """float32, 0 to 1: nearness of wheels that pass often."""
    ridge: np.ndarray
    """float32, 0 to 1: share of slush that wheels have pushed here."""
    kerb_m: np.ndarray
    """float32, distance from the road's edge, metres: positive on the road, negative beside it;
    -_MAX_KERB_M far from any road."""


class _Lane(NamedTuple):
    """Lane with points every metre or so."""

    points_m: np.ndarray  # float64 [P, 3]
    width_m: float  # width of the vehicle that made it
    share: np.ndarray  # float64 [P], share of the cars of a lane that drive here
    is_recorded: bool  # False for a parallel lane


class WheelPoints(NamedTuple):
    """Points under the wheels of cars."""

    xy_m: np.ndarray  # float64 [N, 2]
    weights: np.ndarray  # float64 [N]


class _Cars(NamedTuple):
    """N cars of a lane, all [N] but the last two."""

    threshold: np.ndarray  # a car drives where the lane's share exceeds this
    weight: np.ndarray  # weight of its pass
    half_width_m: np.ndarray  # distance of its wheels from its middle
    offset_m: np.ndarray  # mean distance from the lane's middle
    change_m: np.ndarray  # distance of a change of lane, 0 for most
    change_begin_m: np.ndarray  # place along the lane where the change begins
    change_length_m: np.ndarray  # length of the change
    amplitudes_m: np.ndarray  # [N, W], amplitudes of the wandering, by wave
    phases: np.ndarray  # [N, W], phases of the waves, turns


class _Line(NamedTuple):
    """Lane in steps of STEP_M, with its cars."""

    along_m: np.ndarray  # [P], length up to each point
    middle: np.ndarray  # [P, 2]
    normals: np.ndarray  # [P, 2], unit vectors to the left
    share: np.ndarray  # [P], share of the cars of a lane that drive here
    recorded_width_m: float | None  # width of the vehicle whose path this is; None without one
    cars: _Cars


def find_road_wear(
    cells: ExposedCells, paths: Sequence[WheelPath], *, traffic: float, seed: int, scene_name: str
) -> RoadWear:
    """Return the traces of traffic on the cells of the ground.

    Args:
        cells: cells of the ground.
        paths: paths of the ego, which comes first, and of the scene's vehicles.
        traffic: strength of the traffic, 0 to 1.
        seed: seed of the cars.
        scene_name: name of the scene, which belongs to the random numbers' key.
    """
    is_road = _road_cells(cells, paths)
    centers = cells.centers_m.numpy().astype(np.float64)
    lanes = _find_lanes(centers[is_road, :2], paths)
    num_cars = 0 if traffic == 0 else round(MIN_CARS + (MAX_CARS - MIN_CARS) * traffic**2)
    lines = _lines_of(lanes, num_cars, seed, scene_name)
    sizes = cells.sizes_m.numpy().astype(np.float64)
    count = len(cells)
    zeros = np.zeros(count, np.float32)
    wear = RoadWear(is_road, zeros, zeros.copy(), zeros.copy(), np.full_like(zeros, -_MAX_KERB_M))
    for rows, road_rows, corner in _blocks(centers[:, :2], sizes, is_road):
        _fill_block(rows, road_rows, corner, centers, sizes, lines, wear)
    _leave_out_high_cells(centers, wear)
    return wear


def _leave_out_high_cells(centers: np.ndarray, wear: RoadWear) -> None:
    """Put cells beside the road that lie high above or below it (roofs, crowns) far from it."""
    rows = np.flatnonzero(~wear.is_road & (wear.kerb_m > -_MAX_KERB_M))
    if not len(rows):
        return
    road = centers[wear.is_road]
    nearest = KDTree(road[:, :2]).query(centers[rows, :2])[1]
    is_high = np.abs(centers[rows, 2] - road[nearest, 2]) > _MAX_VERGE_GAP_M
    wear.kerb_m[rows[is_high]] = -_MAX_KERB_M
    wear.splash[rows[is_high]] = 0


def _road_cells(cells: ExposedCells, paths: Sequence[WheelPath]) -> np.ndarray:
    """Return the mask of cells of the roads that the paths lead over, bool [C]."""
    classes = cells.semantic.numpy()
    has_classes = bool((classes != SemanticClass.UNKNOWN).any())
    is_road = np.isin(classes, _ROAD_CLASSES) if has_classes else np.ones(len(classes), bool)
    rows = np.flatnonzero(is_road)
    if not paths or not len(rows):
        return is_road & has_classes
    centers = cells.centers_m.numpy()[rows].astype(np.float64)
    points = np.concatenate([path.points_m for path in paths])
    distances, nearest = KDTree(points[:, :2]).query(centers[:, :2])
    gap_m = np.abs(centers[:, 2] - points[nearest, 2])
    if has_classes:  # far from all paths, a road's height may be another
        is_near = gap_m < _MAX_HEIGHT_GAP_M + 0.05 * distances
    else:
        is_near = (gap_m < _MAX_UNCLASSED_GAP_M) & (distances < _UNCLASSED_WIDTH_M)
    is_road[rows] = is_near
    return is_road


# ---- Lanes ---------------------------------------------------------------------------------------


def _find_lanes(road_xy_m: np.ndarray, paths: Sequence[WheelPath]) -> list[_Lane]:
    """Return the lanes that the paths are in, and lanes parallel to the first path.

    Args:
        road_xy_m: middles of the road's cells, [N, 2].
        paths: paths of vehicles.
    """
    if not paths or not len(road_xy_m):
        return []
    road = KDTree(road_xy_m)
    smooth_paths = [WheelPath(_smoothed(path.points_m), path.width_m) for path in paths]
    points = np.concatenate([path.points_m for path in smooth_paths])[:, :2]
    numbers = np.repeat(np.arange(len(paths)), [len(path.points_m) for path in smooth_paths])
    tree = KDTree(points)
    lanes = []
    for path in smooth_paths:
        neighbours = tree.query_ball_point(path.points_m[:, :2], _SAME_LANE_M)
        sharing = np.array([len(np.unique(numbers[rows])) for rows in neighbours])
        lanes.append(_lane_on_road(path, 1 / np.maximum(sharing, 1), road, is_recorded=True))
    for number in range(-NUM_SIDE_LANES, NUM_SIDE_LANES + 1):
        if number == 0:
            continue
        path = parallel_path(smooth_paths[0], number * LANE_WIDTH_M)
        distances = tree.query(path.points_m[:, :2])[0]
        is_free = _smooth_share((distances > _LANE_GAP_M).astype(np.float64), 4.0)
        lanes.append(_lane_on_road(path, np.clip(2 * is_free - 1, 0, 1), road, is_recorded=False))
    return [lane for lane in lanes if lane.share.any()]


def _lane_on_road(path: WheelPath, share: np.ndarray, road: KDTree, *, is_recorded: bool) -> _Lane:
    """Return the lane along a path, without cars where there is no road."""
    extended, extended_share = _extend(path.points_m, share)
    left, right = (
        parallel_path(WheelPath(extended, path.width_m), offset).points_m[:, :2]
        for offset in (-_LANE_HALF_WIDTH_M, _LANE_HALF_WIDTH_M)
    )
    is_road = np.stack(
        [
            road.query(points, distance_upper_bound=_ROAD_REACH_M)[0] < _ROAD_REACH_M
            for points in (extended[:, :2], left, right)
        ]
    )
    window_m = _RECORDED_WINDOW_M if is_recorded else _ROAD_WINDOW_M
    road_share = _smooth_share(is_road.mean(0), window_m)
    on_road = (road_share - _MIN_ROAD_SHARE) / (_FULL_ROAD_SHARE - _MIN_ROAD_SHARE)
    return _Lane(extended, path.width_m, extended_share * np.clip(on_road, 0, 1), is_recorded)


def _extend(points: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points and shares, continued straight by _EXTENSION_M at both ends."""
    steps = np.arange(1.0, _EXTENSION_M + 1)[:, None]
    back, ahead = (_unit(ends[0] - ends[min(3, len(ends) - 1)]) for ends in (points, points[::-1]))
    before = (points[0] + steps * back)[::-1]
    after = points[-1] + steps * ahead
    ends = (np.full(len(steps), share[0]), np.full(len(steps), share[-1]))
    return np.concatenate([before, points, after]), np.concatenate([ends[0], share, ends[1]])


def _unit(vector: np.ndarray) -> np.ndarray:
    """Return a level unit vector [3]."""
    level = np.array([vector[0], vector[1], 0.0])
    return level / max(float(np.linalg.norm(level)), 1e-9)


def _smoothed(points: np.ndarray) -> np.ndarray:
    """Return a path in steps of about a metre and without jitter, [P, 3]; its ends stay."""
    lengths = _arc_length(points)
    along_m = np.linspace(0.0, lengths[-1], max(2, math.ceil(lengths[-1]) + 1))
    even = np.stack([np.interp(along_m, lengths, points[:, k]) for k in range(3)], 1)
    # Near its ends a path is averaged over as much before a point as behind it.
    to_end = np.minimum(along_m, along_m[-1] - along_m)
    step_m = along_m[1] - along_m[0]
    sums = np.zeros_like(even)
    weight_sums = np.zeros(len(even))
    reach = math.ceil(_SMOOTHING_REACH * _SMOOTHING_M / max(step_m, 1e-9))
    rows = np.arange(len(even))
    for shift in range(-min(reach, len(even)), min(reach, len(even)) + 1):
        weight = math.exp(-0.5 * (shift * step_m / _SMOOTHING_M) ** 2)
        weights = np.where(abs(shift) * step_m <= to_end + 1e-9, weight, 0.0)
        sums += weights[:, None] * even[np.clip(rows + shift, 0, len(even) - 1)]
        weight_sums += weights
    return sums / weight_sums[:, None]


def _smooth_share(values: np.ndarray, window_m: float) -> np.ndarray:
    """Return the mean of values a metre apart over a window about each."""
    half = max(1, round(window_m / 2))
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1 / (2 * half + 1)), mode="valid")


def _arc_length(points: np.ndarray) -> np.ndarray:
    """Return the length of a path up to each point, metres."""
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


# ---- Cars ----------------------------------------------------------------------------------------


def _lines_of(lanes: Sequence[_Lane], num_cars: int, seed: int, scene: str) -> list[_Line]:
    """Return the lanes in fine steps, with the cars that drive in them."""
    lines = []
    for number, lane in enumerate(lanes):
        lengths = _arc_length(lane.points_m)
        along_m = np.arange(0.0, lengths[-1], STEP_M)
        middle = np.stack([np.interp(along_m, lengths, lane.points_m[:, k]) for k in (0, 1)], 1)
        share = np.interp(along_m, lengths, lane.share)
        rng = rng_for(seed=seed, scene=scene, effect=f"snow.traffic of lane {number}")
        cars = _draw_cars(num_cars, along_m[-1], rng)
        width_m = lane.width_m if lane.is_recorded and num_cars > 0 else None
        lines.append(_Line(along_m, middle, _normals(middle), share, width_m, cars))
    return lines


def _draw_cars(num_cars: int, lane_m: float, rng: np.random.Generator) -> _Cars:
    """Draw the cars of a lane that is `lane_m` long."""
    rows = []
    num_waves = len(_WANDER_LENGTHS_M)
    for _ in range(num_cars):
        threshold, weight, width = rng.uniform(0, 1, 3)
        offset_m = _OFFSET_M * rng.standard_normal()
        waves = [(rng.standard_normal(), rng.uniform()) for _ in range(num_waves)]
        amplitudes, phases = zip(*waves, strict=True)
        changes, side, begin, length = rng.uniform(0, 1, 4)
        change_m = math.copysign(LANE_WIDTH_M, side - 0.5) if changes < _CHANGE_SHARE else 0.0
        shortest_m, longest_m = _CHANGE_LENGTHS_M
        change = (change_m, begin * lane_m, shortest_m + (longest_m - shortest_m) * length)
        narrow_m, wide_m = _CAR_WIDTHS_M
        half_width_m = WHEEL_OFFSET_SHARE * (narrow_m + (wide_m - narrow_m) * width)
        pass_weight = _MIN_WEIGHT + (1 - _MIN_WEIGHT) * weight
        rows.append((threshold, pass_weight, half_width_m, offset_m, *change, *amplitudes, *phases))
    table = np.array(rows, np.float64).reshape(num_cars, 7 + 2 * num_waves)
    amplitudes = _WANDER_M * math.sqrt(2 / num_waves) * table[:, 7 : 7 + num_waves]
    threshold, weight, half_width_m, offset_m, change_m, begin_m, length_m = table[:, :7].T
    return _Cars(
        threshold=threshold,
        weight=weight,
        half_width_m=half_width_m,
        offset_m=offset_m,
        change_m=change_m,
        change_begin_m=begin_m,
        change_length_m=length_m,
        amplitudes_m=amplitudes,
        phases=table[:, 7 + num_waves :],
    )


def _car_offsets(cars: _Cars, along_m: np.ndarray) -> np.ndarray:
    """Return the distances of N cars from the lane's middle at places along it, metres [N, P]."""
    offsets = np.repeat(cars.offset_m[:, None], len(along_m), axis=1)
    for number, wave_m in enumerate(_WANDER_LENGTHS_M):
        turns = along_m / wave_m + cars.phases[:, number, None]
        offsets += cars.amplitudes_m[:, number, None] * np.sin(2 * math.pi * turns)
    t = (along_m - cars.change_begin_m[:, None]) / cars.change_length_m[:, None]
    t = np.clip(t, 0, 1)
    return offsets + cars.change_m[:, None] * t * t * (3 - 2 * t)


def _points_between(lines: Sequence[_Line], low: np.ndarray, high: np.ndarray) -> WheelPoints:
    """Return the points under wheels in and about a rectangle.

    Args:
        lines: lanes with their cars.
        low: least x and y of the rectangle.
        high: largest x and y.
    """
    xy = [np.zeros((0, 2))]
    weights = [np.zeros(0)]
    for line in lines:
        is_near = ((line.middle > low - _LANE_REACH_M) & (line.middle < high + _LANE_REACH_M)).all(
            1
        )
        rows = np.flatnonzero(is_near & (line.share > 0))
        if not len(rows):
            continue
        middle = line.middle[rows]
        normals = line.normals[rows]
        if line.recorded_width_m is not None:
            half_width_m = WHEEL_OFFSET_SHARE * line.recorded_width_m
            xy += [middle + side * half_width_m * normals for side in (-1, 1)]
            weights += 2 * [np.full(len(rows), _RECORDED_WEIGHT)]
        cars = line.cars
        is_here = line.share[rows] > cars.threshold[:, None]  # [N, P]
        offsets_m = _car_offsets(cars, line.along_m[rows])
        car, place = np.nonzero(is_here)
        for side in (-1, 1):
            beside_m = offsets_m[car, place] + side * cars.half_width_m[car]
            xy.append(middle[place] + beside_m[:, None] * normals[place])
            weights.append(cars.weight[car])
    return WheelPoints(np.concatenate(xy), np.concatenate(weights))


def _normals(points: np.ndarray) -> np.ndarray:
    """Return unit vectors to the left of a line, [N, 2]."""
    directions = np.gradient(points, axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    return np.stack([-directions[:, 1], directions[:, 0]], 1)


# ---- Counting passes on a grid -------------------------------------------------------------------


def _blocks(
    centers_xy: np.ndarray, sizes: np.ndarray, is_road: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the blocks that have road in them or in their margin.

    Yields:
        Rows of the cells in the block, rows of the cells of road in it and its margin, and the
        corner [2] of the block with its margin.
    """
    keys, inverse = np.unique(
        np.floor(centers_xy / _BLOCK_M).astype(np.int64), axis=0, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(np.bincount(inverse, minlength=len(keys)))
    road_rows = np.flatnonzero(is_road)
    road_xy = centers_xy[road_rows]
    reach = sizes[road_rows, None]
    for key, rows in zip(keys, np.split(order, ends[:-1]), strict=True):
        corner = key * _BLOCK_M - _MARGIN_M
        far = corner + _BLOCK_M + 2 * _MARGIN_M
        nearby = road_rows[((road_xy > corner - reach) & (road_xy < far + reach)).all(1)]
        if len(nearby):
            yield rows, nearby, corner


def _fill_block(
    rows: np.ndarray,
    road_rows: np.ndarray,
    corner: np.ndarray,
    centers: np.ndarray,
    sizes: np.ndarray,
    lines: Sequence[_Line],
    wear: RoadWear,
) -> None:
    """Write the traces on the cells of one block into `wear`."""
    side = round((_BLOCK_M + 2 * _MARGIN_M) / GRID_M)
    shape = (side, side)
    road_xy = centers[road_rows, :2]
    road = paint_cells(road_xy, sizes[road_rows], corner, GRID_M, shape).astype(np.uint8)
    kernel = np.ones((round(_CLOSING_M / GRID_M) | 1,) * 2, np.uint8)
    road = cv2.morphologyEx(road, cv2.MORPH_CLOSE, kernel)
    inwards, outwards = (
        cv2.distanceTransform(mask, cv2.DIST_L2, 5) * np.float32(GRID_M)
        for mask in (road, 1 - road)
    )
    kerb = np.clip(inwards - outwards, -_MAX_KERB_M, _MAX_KERB_M)
    far_corner = corner + side * GRID_M
    passes = count_passes(_points_between(lines, corner, far_corner), corner, shape)
    flattened = 1 - np.exp(-passes / SATURATION)
    splash = _blur(flattened, _SPLASH_M)
    ridge = np.maximum(_blur(flattened, _RIDGE_M) - flattened, 0)
    # A straight edge between bare road and snow has a ridge of 1/2.
    images = (passes, splash, 2 * ridge)
    cell_sizes = sizes[rows]
    local = (centers[rows, :2] - corner) / GRID_M
    column, line = np.clip(np.floor(local).astype(np.int64), 0, side - 1).T
    wear.kerb_m[rows] = kerb[line, column]
    is_road = wear.is_road[rows]
    for target, image in zip((wear.passes, wear.splash, wear.ridge), images, strict=True):
        values = np.zeros(len(rows), np.float32)
        for size in np.unique(cell_sizes):
            chosen = cell_sizes == size
            width = max(1, round(float(size) / GRID_M)) | 1
            mean = image if width == 1 else cv2.blur(image, (width, width))
            values[chosen] = mean[line[chosen], column[chosen]]
        target[rows] = np.where(is_road | (target is wear.splash), values, 0)


def count_passes(points: WheelPoints, corner: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the number of passes over each cell of a block's grid, float32 [H, W]."""
    local = (points.xy_m - corner) / GRID_M
    is_inside = ((local >= 0) & (local < np.array(shape[::-1]))).all(1)
    columns, lines = np.floor(local[is_inside]).astype(np.int64).T
    counts = np.bincount(
        lines * shape[1] + columns, points.weights[is_inside], minlength=shape[0] * shape[1]
    )
    blurred = _blur(counts.reshape(shape).astype(np.float32), _TYRE_SIGMA_M)
    # One line of points has 1 in its middle.
    return blurred * np.float32(math.sqrt(2 * math.pi) * _TYRE_SIGMA_M * STEP_M / GRID_M**2)


def paint_cells(
    centers_xy: np.ndarray,
    sizes: np.ndarray,
    corner: np.ndarray,
    grid_m: float,
    shape: tuple[int, int],
) -> np.ndarray:
    """Return the mask of a grid's cells that lie under square cells, bool [H, W].

    Args:
        centers_xy: middles of the square cells, [C, 2].
        sizes: their sides, [C].
        corner: least x and y of the grid.
        grid_m: side of the grid's cells.
        shape: rows and columns of the grid.
    """
    mask = np.zeros(shape, bool)
    for size in np.unique(sizes):
        width = max(1, round(float(size) / grid_m))
        low = centers_xy[sizes == size] - corner
        low = np.floor((low - 0.5 * (width - 1) * grid_m) / grid_m + 1e-6).astype(np.int64)
        is_near = ((low > -width) & (low < np.array(shape[::-1]))).all(1)
        for down in range(width):
            for across in range(width):
                columns = low[is_near, 0] + across
                lines = low[is_near, 1] + down
                is_inside = (columns >= 0) & (columns < shape[1]) & (lines >= 0)
                is_inside &= lines < shape[0]
                mask[lines[is_inside], columns[is_inside]] = True
    return mask


def _blur(image: np.ndarray, sigma_m: float) -> np.ndarray:
    """Return an image of the grid, blurred by a standard deviation in metres."""
    return cv2.GaussianBlur(image, (0, 0), sigma_m / GRID_M, borderType=cv2.BORDER_REPLICATE)
