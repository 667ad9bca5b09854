"""Returns of things that have gone: rays of other sweeps pass through their places.

Returns are gathered in cells, as fine as the voxels of a scene. Every sweep is asked about every
cell: does a ray end there (the cell is occupied), or do all rays near it go on far behind it (the
cell is free)? A cell that is free in more sweeps than it is occupied held something that moved.
This is the test by visibility of Kim and Kim 2020, "Remove, then revert", with the share of
occupied sweeps of an occupancy grid (Moravec and Elfes 1985) as its measure.

The test is made to keep what is real. A sweep counts as free only if no ray within 1.5 cells of
the cell's middle ends near it or before it: at silhouettes, in foliage, behind fences and along
walls that are seen at a flat angle, some ray always does. Ground and labelled objects that stand
still are never tested, so that glass of parked cars stays. The caller is
`adapters.lidar_scene.scene`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.lidar_scene.split import PointSet, indices_between, inside_box
from adapters.lidar_scene.surfels import edges_at, ground_points
from adapters.raw_drive import BoxSample, Sweep
from augment.render.cpu.jit import cached_njit
from augment.scene.semantics import SemanticClass

MOVABLE = (SemanticClass.VEHICLE, SemanticClass.PEDESTRIAN, SemanticClass.TWO_WHEELER)
CELL_M = 0.12  # edge of a cell near the path, metres; it grows as the voxels of a scene do
MIN_FREE_SWEEPS = 3  # fewest sweeps in which a cell is free
MAX_SHARE = 0.5  # largest share of occupied sweeps of a free cell, of things that can move
MAX_SHARE_UNKNOWN = 0.35  # the same without classes
MAX_SHARE_FIXED = 0.2  # the same of classes that do not move: wires, poles, walls
_REACH_M = 120.0  # distance from the sensor up to which a sweep is asked about cells
_FIRST_STEP = 3  # step between the sweeps that are asked first
_STILL_MARGIN_M = 0.3  # growth of the boxes of objects that stand still
_PIXEL_RAD = math.radians(0.3)  # side of a pixel of a sweep's range image
_LOW_RAD = -math.pi / 4  # elevation of the image's lowest row
_ROWS = int(math.pi / 2 / _PIXEL_RAD)
_COLUMNS = int(2 * math.pi / _PIXEL_RAD)
_FEWEST_SLOTS = 1 << 19  # of the hash table of cells
_MIN_RANGE_M = 0.5  # smallest range of a ray
_MOST_PIXELS = 4  # largest radius of the window around a cell, pixels
_NEAR_CELLS = 1.5  # distance from a cell's middle, in edges, within which rays count
_INSIDE_CELLS = 0.6  # distance within which a ray passes through the cell
_BEYOND_RATIO = 1.03  # range over that of the cell from which a ray goes on behind it
_BEYOND_M = 0.5  # metres more than that
_END_M = 0.3  # least distance from a ray's end at which it still ends in the cell
_END_RATIO = 0.01  # part of the range that is added to that distance

UNKNOWN = 0  # no ray passes near the place
FREE = 1  # all rays near the place go on far behind it
OCCUPIED = 2  # a ray ends near the place
HIDDEN = 3  # a ray ends before the place


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one sweep with an image of the nearest returns.

    Attributes:
        points, origins: float32 [N, 3], ends and beginnings in the scene's world.
        ranges: float32 [N], lengths.
        image: int32 [_ROWS, _COLUMNS], index of the nearest return by direction, or -1.
        centre: float64 [3], mean beginning.
    """

    points: np.ndarray
    origins: np.ndarray
    ranges: np.ndarray
    image: np.ndarray
    centre: np.ndarray

    @staticmethod
    def of(points: np.ndarray, origins: np.ndarray) -> Rays:
        """Return the rays to points [N, 3] from origins [N, 3]."""
        image = np.full((_ROWS, _COLUMNS), -1, np.int32)
        ranges = np.empty(len(points), np.float32)
        points = np.ascontiguousarray(points, np.float32)
        origins = np.ascontiguousarray(origins, np.float32)
        _draw(points, origins, image, ranges)
        return Rays(points, origins, ranges, image, origins.mean(axis=0, dtype=np.float64))

    def verdicts(self, places: np.ndarray, cell_m: np.ndarray) -> np.ndarray:
        """Return what the rays say about places [M, 3]: UNKNOWN, FREE, OCCUPIED or HIDDEN.

        cell_m: float [M], edge of the cell around each place.
        """
        return _look(
            np.ascontiguousarray(places, np.float64),
            np.ascontiguousarray(cell_m, np.float64),
            self.points,
            self.origins,
            self.ranges,
            self.image,
            self.centre,
        )


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells with their returns.

    Attributes:
        number: int32 [N], cell of each return.
        places: float64 [C, 3], mean of each cell's returns.
        edge_m: float64 [C], edges of the cells.
        num_occupied: int32 [C], number of sweeps that have returns in the cell.
    """

    number: np.ndarray
    places: np.ndarray
    edge_m: np.ndarray
    num_occupied: np.ndarray

    @staticmethod
    def of(points: np.ndarray, sweep: np.ndarray, path: np.ndarray) -> Cells:
        """Return the cells of points [N, 3], which are in the order of their sweeps [N]."""
        edge_m = edges_at(points, path, voxel_m=CELL_M)
        num_slots = _FEWEST_SLOTS
        number, count = _number_cells(points, edge_m, np.zeros(num_slots, np.uint64))
        while count < 0:  # the table was too small
            num_slots *= 4
            number, count = _number_cells(points, edge_m, np.zeros(num_slots, np.uint64))
        places, edges, num_occupied = _cell_means(points, edge_m, number, sweep, count)
        return Cells(number, places, edges, num_occupied)


def find_transient_returns(
    sweeps: Sequence[Sweep],
    is_static: Sequence[np.ndarray],
    still: Sequence[BoxSample],
    path: np.ndarray,
) -> list[np.ndarray]:
    """Return a mask of each sweep's returns that are of things which have gone, bool [N].

    Sweeps without origins tell nothing about free space, and have no such returns.

    Args:
        sweeps: all sweeps; their rays look.
        is_static: bool [N] of each sweep, the returns that are tested.
        still: boxes of objects that stand still, whose returns are kept.
        path: float [P, 3], the car's places.
    """
    masks = [np.zeros(len(sweep), np.bool_) for sweep in sweeps]
    numbers = [n for n, sweep in enumerate(sweeps) if sweep.origins is not None and len(sweep)]
    if len(numbers) <= MIN_FREE_SWEEPS:
        return masks
    rows = [_tested_rows(sweeps[n], is_static[n]) for n in numbers]
    points = np.concatenate([sweeps[n].points[row] for n, row in zip(numbers, rows, strict=True)])
    sweep_of_point = np.repeat(np.arange(len(numbers), dtype=np.int32), [len(row) for row in rows])
    if not len(points):
        return masks
    cells = Cells.of(points, sweep_of_point, path)
    share = _occupied_shares(cells, [sweeps[n] for n in numbers], still, path)
    max_share = np.full(64, MAX_SHARE_FIXED)
    max_share[list(MOVABLE)] = MAX_SHARE
    max_share[SemanticClass.UNKNOWN] = MAX_SHARE_UNKNOWN
    start = 0
    for n, row in zip(numbers, rows, strict=True):
        share_of_return = share[cells.number[start : start + len(row)]]
        masks[n][row] = share_of_return < max_share[sweeps[n].semantic[row]]
        start += len(row)
    return masks


def in_still_boxes(places: np.ndarray, still: Sequence[BoxSample]) -> np.ndarray:
    """Return True for places [N, 3] in a box of an object that stands still, bool [N]."""
    is_inside = np.zeros(len(places), np.bool_)
    for box in still:
        pose = box.world_from_box
        reach = float(np.linalg.norm(box.size_m)) / 2 + _STILL_MARGIN_M
        near = indices_between(places, pose[:3, 3] - reach, pose[:3, 3] + reach)
        local = (places[near] - pose[:3, 3]) @ pose[:3, :3]
        is_inside[near] |= inside_box(local, np.asarray(box.size_m), _STILL_MARGIN_M)
    return is_inside


def _tested_rows(sweep: Sweep, is_static: np.ndarray) -> np.ndarray:
    rows = np.flatnonzero(is_static)
    ground = ground_points(PointSet(sweep.points[rows], sweep.semantic[rows]))
    return rows[~ground]


def _occupied_shares(
    cells: Cells, sweeps: Sequence[Sweep], still: Sequence[BoxSample], path: np.ndarray
) -> np.ndarray:
    """Return the share of sweeps that find each cell occupied among those that see it, float [C].

    It is 1 for cells that are not tested, or that are free in fewer than MIN_FREE_SWEEPS.
    """
    is_tested = cells.num_occupied <= MAX_SHARE * len(sweeps)
    is_tested &= ~in_still_boxes(cells.places, still)
    num_free = np.zeros(len(cells.places), np.int32)
    num_occupied = np.zeros(len(cells.places), np.int32)
    # Most cells are of what stands, which no sweep finds free: every third sweep tells them.
    order = [n for start in range(_FIRST_STEP) for n in range(start, len(sweeps), _FIRST_STEP)]
    num_first = len(range(0, len(sweeps), _FIRST_STEP))
    for count, number in enumerate(order):
        if count == num_first:
            is_tested &= num_free > 0
        origins = sweeps[number].origins
        assert origins is not None
        rays = Rays.of(sweeps[number].points, origins)
        near = np.abs(cells.places[:, :2] - rays.centre[:2]).max(axis=1) < _REACH_M
        rows = np.flatnonzero(is_tested & near)
        verdicts = rays.verdicts(cells.places[rows], cells.edge_m[rows])
        num_free[rows] += verdicts == FREE
        num_occupied[rows] += verdicts == OCCUPIED
    num_occupied = np.maximum(num_occupied, cells.num_occupied)
    share = num_occupied / np.maximum(num_occupied + num_free, 1)
    return np.where(is_tested & (num_free >= MIN_FREE_SWEEPS), share, 1.0)


@cached_njit(nogil=True)
def _number_cells(points, edge_m, slots):  # pragma: no cover - compiled
    """Return the number of each point's cell, int32 [N], and the number of cells.

    The number is -1 if the cells fill more than half of the slots.

    Args:
        points: float32 [N, 3].
        edge_m: float32 [N], edge of the cell at each point. Cells of two edges are never the same.
        slots: uint64 [2^k], zeros. They become a hash table of cells.
    """
    mask = np.uint64(len(slots) - 1)
    numbers = np.zeros(len(slots), np.int32)
    out = np.empty(len(points), np.int32)
    count = 0
    for i in range(len(points)):
        key = np.uint64(np.int64(16 * np.log2(edge_m[i]) + 256.5))
        for axis in range(3):
            cell = np.int64(np.floor(points[i, axis] / edge_m[i])) + (1 << 17)
            key = key << np.uint64(18) | np.uint64(cell) & np.uint64((1 << 18) - 1)
        key += np.uint64(1)  # zero is an empty slot
        slot = (key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20) & mask
        while slots[slot] != key:
            if slots[slot] == 0:
                if 2 * count >= len(slots):
                    return out, -1
                slots[slot] = key
                numbers[slot] = count
                count += 1
            else:
                slot = (slot + np.uint64(1)) & mask
        out[i] = numbers[slot]
    return out, count


@cached_njit(nogil=True)
def _cell_means(points, edge_m, number, sweep, count):  # pragma: no cover - compiled
    """Return the mean of each cell's points, its edge, and the number of its sweeps."""
    means = np.zeros((count, 3))
    num_points = np.zeros(count, np.int32)
    num_sweeps = np.zeros(count, np.int32)
    last_sweep = np.full(count, -1, np.int32)
    edges = np.zeros(count)
    for i in range(len(points)):
        cell = number[i]
        num_points[cell] += 1
        edges[cell] = edge_m[i]
        for axis in range(3):
            means[cell, axis] += points[i, axis]
        if last_sweep[cell] != sweep[i]:
            last_sweep[cell] = sweep[i]
            num_sweeps[cell] += 1
    for cell in range(count):
        for axis in range(3):
            means[cell, axis] /= num_points[cell]
    return means, edges, num_sweeps


@cached_njit(nogil=True)
def _pixel(x, y, z, distance):  # pragma: no cover - compiled
    """Return the column and the row of a direction. The row may lie outside of the image."""
    column = int((np.arctan2(y, x) + np.pi) / _PIXEL_RAD) % _COLUMNS
    row = int(np.floor((np.arcsin(z / distance) - _LOW_RAD) / _PIXEL_RAD))
    return column, row


@cached_njit(nogil=True)
def _draw(points, origins, image, ranges):  # pragma: no cover - compiled
    """Write the length of every ray to `ranges`, and the nearest return's index to `image`."""
    for i in range(len(points)):
        x = np.float64(points[i, 0]) - origins[i, 0]
        y = np.float64(points[i, 1]) - origins[i, 1]
        z = np.float64(points[i, 2]) - origins[i, 2]
        ranges[i] = np.sqrt(x * x + y * y + z * z)
        if not ranges[i] >= _MIN_RANGE_M:
            continue
        column, row = _pixel(x, y, z, np.sqrt(x * x + y * y + z * z))
        if row < 0 or row >= _ROWS:
            continue
        other = image[row, column]
        if other < 0 or ranges[i] < ranges[other]:
            image[row, column] = i


@cached_njit(nogil=True)
def _nearest_ray(image, row, column):  # pragma: no cover - compiled
    """Return the return in the image that is nearest to a pixel, or -1 without one."""
    for radius in range(_MOST_PIXELS + 1):
        for r in range(max(row - radius, 0), min(row + radius + 1, _ROWS)):
            # Only the window's border is new: whole rows at its ends, else two pixels.
            step = 1 if r in (row - radius, row + radius) else 2 * radius
            for c in range(column - radius, column + radius + 1, step):
                if image[r, c % _COLUMNS] >= 0:
                    return image[r, c % _COLUMNS]
    return -1


@cached_njit(nogil=True)
def _look(places, cell_m, points, origins, ranges, image, centre):  # pragma: no cover - compiled
    """Return the verdict of a sweep on each place, int8 [M].

    A sensor moves during a sweep, and a sweep may be of several sensors. So a place is looked up
    from the mean beginning first, then from the beginning of the ray that is found there. The rays
    in the window around are compared with the place from their own beginnings.
    """
    out = np.zeros(len(places), np.int8)
    for m in range(len(places)):
        start_x = centre[0]
        start_y = centre[1]
        start_z = centre[2]
        edge = cell_m[m]
        column = 0
        row = 0
        distance = 0.0
        is_in_image = True
        for _ in range(2):
            x = places[m, 0] - start_x
            y = places[m, 1] - start_y
            z = places[m, 2] - start_z
            distance = np.sqrt(x * x + y * y + z * z)
            if distance < _MIN_RANGE_M:
                is_in_image = False
                break
            column, row = _pixel(x, y, z, distance)
            if row < 0 or row >= _ROWS:
                is_in_image = False
                break
            near = _nearest_ray(image, row, column)
            if near < 0:
                break
            start_x = np.float64(origins[near, 0])
            start_y = np.float64(origins[near, 1])
            start_z = np.float64(origins[near, 2])
        if not is_in_image:
            continue
        radius = int(_NEAR_CELLS * edge / distance / _PIXEL_RAD) + 1
        radius = min(radius, _MOST_PIXELS)
        beyond = distance * _BEYOND_RATIO + max(_BEYOND_M, _NEAR_CELLS * edge)
        end = max(_END_M, edge) + _END_RATIO * distance
        is_passed = False
        is_hidden = False
        is_occupied = False
        for r in range(max(row - radius, 0), min(row + radius + 1, _ROWS)):
            for c in range(column - radius, column + radius + 1):
                i = image[r, c % _COLUMNS]
                if i < 0:
                    continue
                x = places[m, 0] - origins[i, 0]
                y = places[m, 1] - origins[i, 1]
                z = places[m, 2] - origins[i, 2]
                dx = np.float64(points[i, 0]) - origins[i, 0]
                dy = np.float64(points[i, 1]) - origins[i, 1]
                dz = np.float64(points[i, 2]) - origins[i, 2]
                along = (x * dx + y * dy + z * dz) / ranges[i]
                aside2 = x * x + y * y + z * z - along * along
                if aside2 > (_NEAR_CELLS * edge) ** 2:
                    continue
                if ranges[i] > beyond:
                    is_passed |= aside2 < (_INSIDE_CELLS * edge) ** 2
                elif ranges[i] > along - end:
                    is_occupied = True
                else:
                    is_hidden = True
        if is_occupied:
            out[m] = OCCUPIED
        elif is_hidden:
            out[m] = HIDDEN
        elif is_passed:
            out[m] = FREE
    return out
