"""Where snow lies on vehicles: cells in their own frames, carried along as they drive."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from augment.labels import EGO_VEHICLE
from augment.render.backends import AUTO
from augment.scene import Actor, Gaussians, PosedGaussians
from augment.semantics import SemanticClass, class_of_label
from augment.snow.cell_lists import cells_at, make_cells
from augment.snow.cells import FLUSH, SnowCells
from augment.snow.height_map import (
    Estimator,
    HeightMap,
    classes_of,
    draw_from_above,
    in_box,
    plain_gaussians,
)
from augment.snow.surface import Surface, find_surface
from augment.snow.surface_kernels import RISES

LARGEST_CELL_M = 0.05
LEAST_AREA_M2 = 0.3  # of all cells of a vehicle: less is not worth a layer
MOVES_M = 0.5  # an actor that goes less far is parked
DRIVEN_MAX_SLOPE_DEG = 25.0  # drivers clear their windows, and what is steeper slides off
_BOTTOM_M = 0.25  # of the box: there are wheels, and the shadow on the road
_MARGIN_M = 0.3  # beyond the box: mirrors, and boxes that are too small
_PATCH_M2 = 0.02
_GROUND = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)


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
    actor: Actor,
    *,
    cell_m: float,
    max_slope_deg: float,
    estimator: Estimator,
    backend: str = AUTO,
) -> SnowCells | None:
    """Cells on a vehicle, in its own frame; None where it has too few to carry snow. backend: that
    draws it.

    Its open edges are all round: what does not rise beside a cell falls away.
    """
    cell = min(cell_m, LARGEST_CELL_M)
    gaussians = plain_gaussians(actor.gaussians)
    half = np.array(actor.size_m[:2]) / 2 + _MARGIN_M
    if not (np.isfinite(half).all() and (half < 100).all()):
        return None
    classes = classes_of(gaussians)
    own = ~np.isin(classes, _GROUND)
    own &= gaussians.means.numpy()[:, 2] > _BOTTOM_M - actor.size_m[2] / 2
    chosen = np.intersect1d(in_box(gaussians, -half, half), np.flatnonzero(own))
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
        view, body_only, max_slope_deg=limit, least_area_m2=_PATCH_M2, floor_m=float(bottom)
    )
    rows, columns = np.nonzero(surface.can_carry)
    if len(rows) * cell**2 < LEAST_AREA_M2:
        return None
    return _record(surface, rows, columns, classes[chosen], body, chosen)


def _record(
    surface: Surface,
    rows: np.ndarray,
    columns: np.ndarray,
    classes: np.ndarray,
    body: Gaussians,
    chosen: np.ndarray,
) -> SnowCells:
    grid = surface.map
    seen = np.where(grid.ids >= 0, classes[np.maximum(grid.ids, 0)], SemanticClass.VEHICLE)
    numbers = GridNumbers(grid, rows, columns)
    sides = np.where(surface.sides == RISES, FLUSH, surface.sides)
    cells = cells_at(surface, rows, columns, sides=sides, classes=seen.astype(np.int16))
    found = make_cells(cells, np.ones(len(rows), np.float32), numbers, body)
    found.buried.copy_(_index(chosen)[found.buried.long()])
    return found


def _index(numbers: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(numbers))


class GridNumbers:
    """Numbers of the cells of a single grid, see buried.NumbersCells."""

    def __init__(self, grid: HeightMap, rows: np.ndarray, columns: np.ndarray) -> None:
        self._corner = np.array([grid.left_m, grid.bottom_m])
        self._cell_m = grid.cell_m
        self._numbers: np.ndarray = np.full(grid.alpha.shape, -1, np.int32)
        self._numbers[rows, columns] = np.arange(len(rows), dtype=np.int32)

    def at(self, xy: np.ndarray) -> np.ndarray:
        """int32 [P]: numbers of the cells under points float64 [P, 2], -1 where there is none."""
        high, wide = self._numbers.shape[:2]
        place = np.floor((xy - self._corner) / self._cell_m)
        inside = ((place >= 0) & (place < (wide, high))).all(1)
        out = np.full(len(xy), -1, np.int32)
        cell = place[inside].astype(np.int64)
        out[inside] = self._numbers[cell[:, 1], cell[:, 0]]
        return out
