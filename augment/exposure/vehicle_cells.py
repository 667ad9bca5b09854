"""Vehicles that carry cells: actors, in their own frames, and parked ones in the background.

Input: an actor, or a scene with labelled boxes. Output: an actor's `ExposedCells`, which move along
as it drives, and the `PlacedShell` records of parked vehicles. A vehicle whose form is known has a
shell (`vehicle_shell`); the cells of others are found on a map of heights, as the ground's are.
Caller: `search`.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.errors import ClimateGSError
from augment.exposure.cells import FLUSH, ExposedCells
from augment.exposure.height_map import (
    DepthEstimator,
    Footprints,
    HeightMap,
    classes_of,
    draw_from_above,
    plain_gaussians,
)
from augment.exposure.shell_grid import PLAN_MARGIN_M, PlacedShell, draw_shells, is_upright
from augment.exposure.surface import (
    MIN_TRAVEL_M,
    CellsUnder,
    Surface,
    cells_at,
    find_surface,
    ids_near,
    is_moving,
    make_cells,
    surface_of_shell,
)
from augment.exposure.surface_kernels import RISES
from augment.exposure.vehicle_forms import forms_of_label
from augment.exposure.vehicle_shell import MIN_POINTS, VehicleShell, fit_shell
from augment.memo import memo_of
from augment.render.buffers import AUTO
from augment.scene.boxes import WorldBoxes
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes
from augment.scene.scene import Actor, Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass, class_of_label

logger = logging.getLogger(__name__)

MAX_CELL_M = 0.05  # largest side of a vehicle's cells
MIN_ACTOR_AREA_M2 = 0.3  # least area of all cells of a vehicle; less is not worth a layer
# Steepest slope that holds a layer on a moving vehicle without a shell: drivers clear their
# windows, and a steeper layer slides off.
MOVING_MAX_SLOPE_DEG = 25.0
# Height of the box's bottom part, which holds wheels and the shadow on the road.
_WHEEL_HEIGHT_M = 0.25
_BOX_MARGIN_M = 0.3  # margin about the box, for mirrors and for boxes that are too small
_MIN_PATCH_M2 = 0.15  # least area of a vehicle's patch
_GROUND_CLASSES = tuple(SemanticClass[n] for n in ("ROAD", "LANE_MARKING", "SIDEWALK", "TERRAIN"))
# Classes of splats in a vehicle's box that are not the vehicle.
_OTHER_CLASSES = (
    *_GROUND_CLASSES,
    *(SemanticClass[n] for n in ("VEGETATION", "BUILDING", "POLE", "SIGN", "PEDESTRIAN", "SKY")),
)
_MAX_SPLATS = 4000  # number of splats, spread over all, that a shell is fitted to
_MIN_OPACITY = 0.3  # fainter splats are no surface
_MAX_SCALE_M = 0.6  # larger splats are no surface of a vehicle
# Places of the points on a splat along its two longer axes, in standard deviations, by the largest
# standard deviation to which they apply, metres.
_SPREADS = ((0.05, (0.0,)), (0.1, (-0.5, 0.0, 0.5)), (math.inf, (-0.6, -0.3, 0.0, 0.3, 0.6)))
_MIN_UPWARD = 0.5  # least z of the normal of a splat that faces upwards
_MAX_LABELLED_FRAMES = 8  # number of frames whose boxes are read, spread over the drive
_MIN_SPEED_STEP_NS = 400_000_000  # least time between two poses that tell a speed
_MAX_VEHICLE_M = 30.0  # longest box that counts
# Distance from the path up to which parked vehicles have shells; cells beyond it are too large.
_MAX_SHELL_DISTANCE_M = 60.0


# ---- Shells --------------------------------------------------------------------------------------


def shell_of_gaussians(
    gaussians: Gaussians, label: str, size_m: tuple[float, float, float]
) -> VehicleShell | None:
    """Fit a shell to the Gaussians of a vehicle, in the frame of its box; None if there is none.

    Args:
        gaussians: plain Gaussians in the box and about it.
        label: the dataset's name for the kind of vehicle.
        size_m: length, width and height of its box.
    """
    return _fit_to_rows(gaussians, np.arange(len(gaussians)), label, size_m, np.zeros(3), np.eye(3))


def _fit_to_rows(
    gaussians: Gaussians,
    rows: np.ndarray,
    label: str,
    size_m: tuple[float, float, float],
    centre_m: np.ndarray,
    rotation: np.ndarray,
) -> VehicleShell | None:
    """Fit a shell to some rows of Gaussians; None if there is none.

    Args:
        gaussians: plain Gaussians.
        rows: rows of those in the box and about it, int64 [N].
        label: the dataset's name for the kind of vehicle.
        size_m: length, width and height of its box.
        centre_m: centre of its box, float64 [3], in the frame of the Gaussians.
        rotation: their frame from the box's, float64 [3, 3].
    """
    if len(rows) < MIN_POINTS or not forms_of_label(label, size_m[2]):
        return None
    is_surface = gaussians.opacities.numpy()[rows] > _MIN_OPACITY
    is_surface &= gaussians.scales.numpy()[rows].max(1) < _MAX_SCALE_M
    is_surface &= ~np.isin(classes_of(gaussians)[rows], _OTHER_CLASSES)
    rows = rows[is_surface]
    if len(rows) < MIN_POINTS:
        return None
    rows = rows[:: math.ceil(len(rows) / _MAX_SPLATS)]
    points, is_facing_up = _surface_points(gaussians, rows, centre_m, rotation)
    return fit_shell(points, is_facing_up, label, size_m)


def _surface_points(
    gaussians: Gaussians, rows: np.ndarray, centre_m: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points on flat Gaussians in the frame of a box, and those that face upwards.

    A large Gaussian gives several points, spread over its two longer axes. The arguments are those
    of `_fit_to_rows`.

    Returns:
        The points, float64 [N, 3]; bool [N].
    """
    ids = _index_tensor(rows)
    # The columns are the axes.
    axes = rotation.T @ rotmat_from_quat(gaussians.quats[ids]).numpy().astype(np.float64)
    scales = gaussians.scales[ids].numpy().astype(np.float64)
    means = (gaussians.means[ids].numpy().astype(np.float64) - centre_m) @ rotation
    order = np.argsort(scales, axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[:, None, :], 2)
    scales = np.take_along_axis(scales, order, 1)
    faces_up = np.abs(axes[:, 2, 0]) > _MIN_UPWARD
    points = []
    are_facing_up = []
    low_m = 0.0
    for high_m, sigmas in _SPREADS:
        chosen = (scales[:, 2] >= low_m) & (scales[:, 2] < high_m)
        spread = axes[chosen][:, :, 1:] * scales[chosen][:, None, 1:]  # [N, 3, 2]
        offsets = np.stack(np.meshgrid(sigmas, sigmas), -1).reshape(-1, 2)
        spots = means[chosen][:, None] + np.einsum("nij,kj->nki", spread, offsets)
        points.append(spots.reshape(-1, 3))
        are_facing_up.append(np.repeat(faces_up[chosen], len(offsets)))
        low_m = high_m
    return np.concatenate(points), np.concatenate(are_facing_up)


@dataclass(frozen=True, eq=False)
class ParkedVehicle:
    """Labelled vehicle that stands still, and is part of the background."""

    label: str
    """Dataset's name for the kind of vehicle."""
    size_m: tuple[float, float, float]
    """Length, width and height of its box."""
    centre_m: np.ndarray
    """Centre of its box, float64 [3], world."""
    rotation: np.ndarray
    """world_from_box, float64 [3, 3]."""
    track_id: str
    """Track of its box."""
    is_stopped: bool
    """True where the dataset says that it has stopped in traffic, and is not parked."""


def parked_vehicles(scene: Scene) -> tuple[ParkedVehicle, ...]:
    """Return the labelled vehicles of the background, in the order in which frames show them.

    Boxes of some frames are read, spread over the recorded drive. The result is remembered.
    """
    scene = scene.as_recorded
    return memo_of(scene).get(("parked vehicles",), lambda: _find_parked_vehicles(scene))


def _find_parked_vehicles(scene: Scene) -> tuple[ParkedVehicle, ...]:
    """Read the boxes of some frames, and return those of vehicles that go nowhere."""
    frames = scene.frames if scene.seen_frames is None else scene.seen_frames
    if scene.labels is None or not frames:
        return ()
    count = min(len(frames), _MAX_LABELLED_FRAMES)
    rows = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    actor_ids = {actor.track_id for actor in scene.actors}
    vehicles_by_track: dict[str, list[ParkedVehicle]] = {}
    for row in rows:
        try:
            labels = scene.labels.boxes(frames[row].index)
        except ClimateGSError as error:
            logger.warning("no boxes of frame %d for parked vehicles: %s", frames[row].index, error)
            continue
        boxes = WorldBoxes.from_labels(labels, scene.world_origin_m)
        for i, (track_id, label) in enumerate(zip(labels.track_ids, labels.labels, strict=True)):
            is_counted = boxes.is_usable[i] and boxes.sizes_m[i].max() < _MAX_VEHICLE_M
            if (
                is_counted
                and track_id not in actor_ids
                and class_of_label(label) == SemanticClass.VEHICLE
                and is_upright(boxes.rotations[i])
            ):
                length, width, height = boxes.sizes_m[i].tolist()
                vehicles_by_track.setdefault(track_id, []).append(
                    ParkedVehicle(
                        label,
                        (length, width, height),
                        boxes.centres_m[i],
                        boxes.rotations[i],
                        track_id,
                        _is_stopped(labels, i),
                    )
                )
    return tuple(
        vehicles[len(vehicles) // 2]
        for vehicles in vehicles_by_track.values()
        if all(
            np.linalg.norm(vehicle.centre_m - vehicles[0].centre_m) <= MIN_TRAVEL_M
            for vehicle in vehicles
        )
    )


def _is_stopped(boxes: Boxes, row: int) -> bool:
    """Return True if a text of a box says that it has stopped: PandaSet's and nuScenes's word."""
    texts = [column[row] for column in boxes.attributes.values() if column.dtype == object]
    return any(isinstance(text, str) and "stopped" in text.lower() for text in texts)


def shells_of_parked(
    vehicles: Sequence[ParkedVehicle], background: Gaussians, path_m: np.ndarray
) -> tuple[PlacedShell, ...]:
    """Return the shells of those parked vehicles whose form is known, and which are near the path.

    Args:
        vehicles: the vehicles.
        background: plain Gaussians of the background.
        path_m: path of the cameras, float64 [P, 2].
    """
    vehicles = [
        vehicle
        for vehicle in vehicles
        if np.hypot(*(path_m - vehicle.centre_m[:2]).T).min() <= _MAX_SHELL_DISTANCE_M
    ]
    if not vehicles:
        return ()
    means = background.means.numpy()
    centres = np.array([vehicle.centre_m[:2] for vehicle in vehicles])
    halves = [np.array(vehicle.size_m) / 2 + PLAN_MARGIN_M for vehicle in vehicles]
    reaches = np.array(
        [(np.abs(v.rotation) @ half)[:2] for v, half in zip(vehicles, halves, strict=True)]
    )
    body_ids = ids_near(means, centres, reaches)
    body_ids = body_ids[~np.isin(classes_of(background)[body_ids], _OTHER_CLASSES)]
    means = means[body_ids].astype(np.float64)
    order = np.argsort(means[:, 0], kind="stable")
    sorted_x = means[order, 0]
    placed_shells = []
    for vehicle, half, reach in zip(vehicles, halves, reaches, strict=True):
        ends = np.searchsorted(sorted_x, vehicle.centre_m[0] + np.array([-reach[0], reach[0]]))
        nearby = np.sort(order[ends[0] : ends[1]])
        local = (means[nearby] - vehicle.centre_m) @ vehicle.rotation
        rows = body_ids[nearby[(np.abs(local) <= half).all(1)]]
        shell = _fit_to_rows(
            background, rows, vehicle.label, vehicle.size_m, vehicle.centre_m, vehicle.rotation
        )
        if shell is not None:
            placed_shells.append(PlacedShell(shell, vehicle.centre_m, vehicle.rotation))
    return tuple(placed_shells)


def top_speed_mps(actor: Actor) -> float | None:
    """Return the largest speed of an actor between two of its poses; None for a parked one.

    Metres a second. Poses that are closer in time than _MIN_SPEED_STEP_NS tell none, since boxes
    are labelled to some centimetres.
    """
    if not is_moving(actor):
        return None
    times_ns = actor.track.timestamps_ns.numpy()
    places = actor.track.world_from_actor[:, :3, 3].numpy()
    speeds = [0.0]
    start = 0
    for end in range(1, len(times_ns)):
        duration_ns = int(times_ns[end] - times_ns[start])
        if duration_ns >= _MIN_SPEED_STEP_NS or (start == 0 and end == len(times_ns) - 1):
            distance_m = float(np.linalg.norm(places[end] - places[start]))
            speeds.append(distance_m / max(duration_ns, 1) * 1e9)
            start = end
    return max(speeds)


# ---- Cells of actors -----------------------------------------------------------------------------


def find_actor_cells(
    actor: Actor,
    *,
    cell_m: float,
    max_slope_deg: float,
    estimator: DepthEstimator,
    backend: str = AUTO,
) -> ExposedCells | None:
    """Find the cells on a vehicle, in its own frame; None where it has too few to hold a layer.

    All cells on its outline have open edges, since the surface falls away there.

    Args:
        actor: the vehicle.
        cell_m: side of the cells; MAX_CELL_M at most.
        max_slope_deg: steeper surfaces hold no layer.
        estimator: depth buffer that heights are taken from, for a vehicle without a shell.
        backend: backend that renders such a vehicle from above.
    """
    cell_side_m = min(cell_m, MAX_CELL_M)
    gaussians = plain_gaussians(actor.gaussians)
    half_size_m = np.array(actor.size_m[:2]) / 2 + _BOX_MARGIN_M
    if not (np.isfinite(half_size_m).all() and (half_size_m < 100).all()):
        return None
    classes = classes_of(gaussians)
    body_mask = ~np.isin(classes, _GROUND_CLASSES)
    body_mask &= gaussians.means.numpy()[:, 2] > _WHEEL_HEIGHT_M - actor.size_m[2] / 2
    body_ids = np.intersect1d(
        Footprints(gaussians).in_box(-half_size_m, half_size_m), np.flatnonzero(body_mask)
    )
    if len(body_ids) == 0:
        return None
    body = gaussians.select(_index_tensor(body_ids))
    shell = shell_of_gaussians(body, actor.label, actor.size_m)
    placed_shells: tuple[PlacedShell, ...] = ()
    if shell is not None:
        placed_shells = (PlacedShell(shell, np.zeros(3), np.eye(3), top_speed_mps(actor)),)
        shell_surface = _surface_on_shell(placed_shells[0], cell_side_m, max_slope_deg)
        if shell_surface is None:
            return None
        surface = shell_surface
    else:
        surface = _surface_from_above(body, actor, cell_side_m, max_slope_deg, estimator, backend)
    rows, columns = np.nonzero(surface.is_exposed)
    if len(rows) * cell_side_m**2 < MIN_ACTOR_AREA_M2:
        return None
    grid = surface.map
    body_classes = classes[body_ids]
    cell_classes = np.where(
        grid.ids >= 0, body_classes[np.maximum(grid.ids, 0)], SemanticClass.VEHICLE
    )
    lookup = _grid_lookup(grid, rows, columns)
    sides = np.where(surface.sides == RISES, FLUSH, surface.sides)
    cells = cells_at(surface, rows, columns, sides=sides, classes=cell_classes.astype(np.int16))
    actor_cells = make_cells(cells, np.ones(len(rows), np.float32), lookup, body, placed_shells)
    actor_cells.hideable_ids.copy_(_index_tensor(body_ids)[actor_cells.hideable_ids.long()])
    return actor_cells


def _surface_on_shell(
    placed_shell: PlacedShell, cell_m: float, max_slope_deg: float
) -> Surface | None:
    """Return the surface of a shell, in the frame of its box; None where no cell holds a layer."""
    shell = placed_shell.shell
    half_m = np.array(shell.size_m[:2]) / 2 + cell_m  # a rim of cells without a layer
    half_cells = np.ceil(half_m / cell_m).astype(int)
    shape = (2 * int(half_cells[1]), 2 * int(half_cells[0]))
    empty = HeightMap(
        left_m=-cell_m * float(half_cells[0]),
        bottom_m=-cell_m * float(half_cells[1]),
        cell_m=cell_m,
        alpha=np.zeros(shape, np.float32),
        height_m=np.zeros(shape, np.float32),
        rgb=np.zeros((*shape, 3), np.float32),
        ids=np.full(shape, -1, np.int32),
        is_thin=np.zeros(shape, bool),
    )
    classes = np.full(shape, SemanticClass.VEHICLE, np.int16)
    grid = draw_shells([placed_shell], empty, classes, max_slope_deg=max_slope_deg)
    if grid is None:
        return None
    height_map, _ = grid.put_under(empty, classes)
    return surface_of_shell(height_map, grid, floor_m=-shell.size_m[2] / 2)


def _surface_from_above(
    body: Gaussians,
    actor: Actor,
    cell_m: float,
    max_slope_deg: float,
    estimator: DepthEstimator,
    backend: str,
) -> Surface:
    """Return the surface of a vehicle without a shell, as it is rendered from above."""
    half_size_m = np.array(actor.size_m[:2]) / 2 + _BOX_MARGIN_M
    half_size_cells = np.ceil(half_size_m / cell_m).astype(int)
    height_map = draw_from_above(
        [PosedGaussians(body)],
        corner_m=(-cell_m * float(half_size_cells[0]), -cell_m * float(half_size_cells[1])),
        cell_m=cell_m,
        shape=(2 * int(half_size_cells[1]), 2 * int(half_size_cells[0])),
        estimator=estimator,
        with_thin=False,
        backend=backend,
    )
    bottom_z_m = np.float32(_WHEEL_HEIGHT_M - actor.size_m[2] / 2)
    max_slope = min(max_slope_deg, MOVING_MAX_SLOPE_DEG) if is_moving(actor) else max_slope_deg
    is_body = height_map.height_m > bottom_z_m
    is_body[[0, -1]] = is_body[:, [0, -1]] = (
        False  # open edges all round, also where the body is cut off
    )
    height_map = dataclasses.replace(
        height_map, alpha=np.where(is_body, height_map.alpha, np.float32(0))
    )
    return find_surface(
        height_map,
        is_body,
        max_slope_deg=max_slope,
        min_area_m2=_MIN_PATCH_M2,
        floor_m=float(bottom_z_m),
        on_vehicles=is_body,
    )


def _index_tensor(numbers: np.ndarray) -> torch.Tensor:
    """Return an index tensor of an array."""
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _grid_lookup(grid: HeightMap, rows: np.ndarray, columns: np.ndarray) -> CellsUnder:
    """Return the lookup for a single grid that has cells at rows and columns [C]."""
    corner = np.array([grid.left_m, grid.bottom_m])
    numbers: np.ndarray = np.full(grid.alpha.shape, -1, np.int32)
    numbers[rows, columns] = np.arange(len(rows), dtype=np.int32)

    def cells_under(xy: np.ndarray) -> np.ndarray:
        """Return the indices of the cells under points [P, 2]; -1 where there is no cell."""
        grid_places = np.floor((xy - corner) / grid.cell_m)
        is_inside = ((grid_places >= 0) & (grid_places < numbers.shape[::-1])).all(1)
        cell_ids = np.full(len(xy), -1, np.int32)
        indices = grid_places[is_inside].astype(np.int64)
        cell_ids[is_inside] = numbers[indices[:, 1], indices[:, 0]]
        return cell_ids

    return cells_under
