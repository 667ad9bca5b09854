"""Shells of vehicles on a grid of cells, with the share of a layer that each cell holds.

Input: `PlacedShell` records (a shell, its pose, its speed). Output: a `ShellGrid` over the cells of
a height map. `surface.find_surface` takes heights, slopes and exposed cells of vehicles from it.
Callers: `search` for vehicles of the background, `vehicle_cells` for actors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from augment.exposure.height_map import HeightMap
from augment.exposure.vehicle_shell import GLASS_PARTS, ShellSample, VehiclePart, VehicleShell
from augment.scene.semantics import SemanticClass

# Steepest surface of a vehicle that holds a layer: most windscreens do, side and rear windows of
# hatchbacks do not.
VEHICLE_MAX_SLOPE_DEG = 38.0
_FULL_GLASS_SLOPE_DEG = 10.0  # slope of glass up to which it holds the whole layer
_MIN_GLASS_SHARE = 0.15  # share of the layer that glass of VEHICLE_MAX_SLOPE_DEG holds
# Distance from the ends of a pane over which the layer grows to that of the paint beside it.
_PANE_DRIFT_M = 0.3
# Speeds at which the wind begins to clear a bonnet from its front end, and has cleared all of it.
_BONNET_SPEEDS_MPS = (3.0, 12.0)
_BONNET_RIM_SHARE = 0.25  # length over which the layer on a bonnet thins out, in its length
# Speeds between which the wind takes the upper half of what lies on a roof.
_ROOF_SPEEDS_MPS = (12.0, 28.0)
_FAST_ROOF_SHARE = 0.5  # share that stays on the roof at the higher of these speeds

# Distance within the sides and the ends of a layer at which its cells are looked up.
_EDGE_INSET_M = 0.03
_END_INSET_M = 0.1
PLAN_MARGIN_M = 0.3  # distance beyond the box in which cells are the vehicle's: mirrors, sills
MIN_BODY_HEIGHT_M = 0.3  # height over the bottom of the box from which on a cell is the body
# Height over a shell from which on a thing stands over the vehicle, such as a tree.
MIN_OVERHANG_M = 0.6


@dataclass(frozen=True, eq=False)
class PlacedShell:
    """Shell of a vehicle at a pose."""

    shell: VehicleShell
    centre_m: np.ndarray
    """Centre of the box, float64 [3], in the frame of the grid."""
    rotation: np.ndarray
    """grid_from_box, float64 [3, 3]; the box stands nearly upright."""
    speed_mps: float | None = None
    """Largest speed of a vehicle that moves; None for one that is parked."""

    @property
    def reach_m(self) -> np.ndarray:
        """Half the size of the plan with its margin, along x and y of the grid, float64 [2]."""
        half = np.array(self.shell.size_m[:2]) / 2 + PLAN_MARGIN_M
        return np.abs(self.rotation[:2, :2]) @ half

    def has_in_plan(self, places: np.ndarray) -> np.ndarray:
        """Return True for places [N, 3] of the grid's frame that lie in the plan of the box."""
        local = (places - self.centre_m) @ self.rotation[:, :2]
        return np.asarray((np.abs(local) <= np.array(self.shell.size_m[:2]) / 2).all(1))

    def nearest_tops(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places of the shell next to which, or over which, nothing of the vehicle stands.

        The first is the nearest across the vehicle, and between its ends. The second is the nearest
        on the roof, which nothing overtops.

        Args:
            places: float64 [N, 3], in the frame of the grid.

        Returns:
            The two places, float64 [2, N, 2]; bool [2, N], True where the given place lies beside
            them.
        """
        local = (places - self.centre_m) @ self.rotation
        knots = self.shell.knots_x_m
        nearest_places = []
        is_beside = []
        # The walls of a bed stand beside its floor.
        rear = knots[0] if self.shell.bed_z_m is None else knots[1]
        for first, last in ((rear, knots[5]), (knots[2], knots[3])):
            x = np.clip(local[:, 0], first + _END_INSET_M, max(last - _END_INSET_M, first))
            half = np.maximum(self.shell.half_width_m(x) - _EDGE_INSET_M, 0)
            y = np.clip(local[:, 1], -half, half)
            nearest = np.stack([x, y], 1)
            nearest_places.append(nearest @ self.rotation[:2, :2].T + self.centre_m[:2])
            is_beside.append((nearest != local[:, :2]).any(1))
        return np.array(nearest_places), np.array(is_beside)


@dataclass(frozen=True, eq=False)
class ShellGrid:
    """Shells on the cells of a grid [H, W]."""

    is_plan: np.ndarray
    """bool, cells over a vehicle's plan, margin included, whose surface is the shell's."""
    is_top: np.ndarray
    """bool, cells of these that hold a layer."""
    height_m: np.ndarray
    """float32, z of the shell; of sides, a z so low that surfaces beside them fall away."""
    slopes: np.ndarray
    """float32 [H, W, 2], dz/dx and dz/dy."""
    depth_share: np.ndarray
    """float32, share of a layer's depth that the cell holds, 0 to 1; 1 where there is no shell."""

    def put_on(self, height_m: np.ndarray, slopes: np.ndarray, is_exposed: np.ndarray) -> None:
        """Replace heights, slopes and exposed cells of a surface by those of the shells."""
        height_m[self.is_plan] = self.height_m[self.is_plan]
        slopes[self.is_top] = self.slopes[self.is_top]
        is_exposed[self.is_plan] = self.is_top[self.is_plan]

    def put_under(self, height_map: HeightMap, classes: np.ndarray) -> tuple[HeightMap, np.ndarray]:
        """Return the height map and the classes with the shells as the highest surface."""
        height = np.where(self.is_plan, self.height_m, height_map.height_m)
        alpha = np.where(self.is_top, np.float32(1), height_map.alpha)
        vehicle = np.int16(SemanticClass.VEHICLE)
        return (
            replace(height_map, height_m=height, alpha=alpha),
            np.where(self.is_top, vehicle, classes),
        )


def draw_shells(
    placed_shells: Sequence[PlacedShell],
    height_map: HeightMap,
    classes: np.ndarray,
    *,
    max_slope_deg: float,
    pixel_mask: np.ndarray | None = None,
) -> ShellGrid | None:
    """Draw shells on the cells of a height map; None where no shell lies on it.

    Args:
        placed_shells: the shells; the last of those that overlap counts.
        height_map: the map. A thing that stands over a shell shelters it.
        classes: classes of the cells, int16 [H, W]. Beyond a box, only vehicles are sills or
            mirrors.
        max_slope_deg: the recipe's steepest surface that holds a layer.
        pixel_mask: bool [H, W], cells that count; shells beside them are left out. None: all.
    """
    x, y = height_map.centers()
    windows = []
    for placed_shell in placed_shells:
        reach = placed_shell.reach_m
        rows = np.flatnonzero(np.abs(y - placed_shell.centre_m[1]) <= reach[1])
        columns = np.flatnonzero(np.abs(x - placed_shell.centre_m[0]) <= reach[0])
        if len(rows) and len(columns):
            window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
            if pixel_mask is None or pixel_mask[window].any():
                windows.append((placed_shell, window))
    if not windows:
        return None
    shape = height_map.alpha.shape
    grid = ShellGrid(
        np.zeros(shape, bool),
        np.zeros(shape, bool),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 2), np.float32),
        np.ones(shape, np.float32),
    )
    is_drawn = [
        _draw_shell(grid, placed_shell, window, height_map, classes, max_slope_deg)
        for placed_shell, window in windows
    ]
    return grid if any(is_drawn) else None


def _draw_shell(
    grid: ShellGrid,
    placed_shell: PlacedShell,
    window: tuple[slice, slice],
    height_map: HeightMap,
    classes: np.ndarray,
    max_slope_deg: float,
) -> bool:
    """Draw one shell in a window of the grid, in place; return False where nothing of it lies."""
    x, y = height_map.centers()
    size = np.array(placed_shell.shell.size_m)
    half = size[:2] / 2 + PLAN_MARGIN_M
    offsets = np.stack(np.meshgrid(x[window[1]], y[window[0]]), -1) - placed_shell.centre_m[:2]
    # The box stands nearly upright, so that its plan is the plan seen from above.
    local = offsets @ placed_shell.rotation[:2, :2]
    sample = placed_shell.shell.sample(local.reshape(-1, 2))
    tilt = placed_shell.rotation[2, :2]
    plan_shape = local.shape[:2]
    z = sample.z_m.reshape(plan_shape) + local @ tilt + placed_shell.centre_m[2]
    slopes = (sample.slopes + tilt) @ placed_shell.rotation[:2, :2].T
    share = find_depth_shares(sample, max_slope_deg, placed_shell.speed_mps).reshape(plan_shape)
    is_in_box = (np.abs(local) <= size[:2] / 2).all(-1)
    is_in_margin = (np.abs(local) <= half).all(-1)
    height = height_map.height_m[window]
    covered = height_map.covered[window]
    bottom_z = placed_shell.centre_m[2] - size[2] / 2 + local @ tilt
    is_sheltered = covered & (height > np.maximum(z, bottom_z + 0.5 * size[2]) + MIN_OVERHANG_M)
    is_top = is_in_box & (share > 0) & ~is_sheltered
    is_body = covered & (height > bottom_z + MIN_BODY_HEIGHT_M) & ~is_sheltered
    is_vehicle = classes[window] == SemanticClass.VEHICLE
    is_plan = is_top | (is_body & (is_in_box | (is_in_margin & is_vehicle)))
    is_lower = is_plan & grid.is_top[window] & ~is_top  # the rim of a neighbour's shell
    is_plan &= ~is_lower
    grid.is_plan[window][is_plan] = True
    grid.is_top[window][is_plan] = is_top[is_plan]
    grid.height_m[window][is_plan] = z[is_plan]
    grid.slopes[window][is_plan] = slopes.reshape(*plan_shape, 2)[is_plan]
    grid.depth_share[window][is_plan] = share[is_plan]
    return bool(is_plan.any())


def find_depth_shares(
    sample: ShellSample, max_slope_deg: float, speed_mps: float | None
) -> np.ndarray:
    """Return the share of a layer's depth that places of a shell hold, float32 [N], 0 to 1.

    - Roof, bonnet, boot and bed hold all of it, up to the steepest slope.
    - Glass holds less, the steeper it is, and nothing beyond VEHICLE_MAX_SLOPE_DEG. Towards roof
      and bonnet the layer grows to theirs.
    - On a vehicle that moves, the driver has cleared the glass. The wind clears the bonnet from
      its front end, by speed; the roof thins out at higher speeds.

    Args:
        sample: places of a shell.
        max_slope_deg: the recipe's steepest surface that holds a layer.
        speed_mps: largest speed; None for a parked vehicle.
    """
    limit_deg = min(max_slope_deg, VEHICLE_MAX_SLOPE_DEG)
    slope_deg = np.degrees(np.arctan(sample.steepness))
    shares = ((sample.parts != VehiclePart.SIDE) & (slope_deg <= limit_deg)).astype(np.float64)
    is_glass = np.isin(sample.parts, GLASS_PARTS)
    full_deg = min(_FULL_GLASS_SLOPE_DEG, limit_deg)
    steep = np.clip((slope_deg - full_deg) / max(limit_deg - full_deg, 1e-6), 0, 1)
    thinning = (1 - _MIN_GLASS_SHARE) * steep
    drift = np.clip(1 - sample.pane_edge_m / _PANE_DRIFT_M, 0, 1)
    shares[is_glass] *= (1 - thinning * (1 - drift**2))[is_glass]
    if speed_mps is not None:
        shares[is_glass] = 0
        is_bonnet = sample.parts == VehiclePart.BONNET
        slow, fast = _BONNET_SPEEDS_MPS
        cleared = np.clip((speed_mps - slow) / (fast - slow), 0, 1) * (1 + _BONNET_RIM_SHARE)
        rim = (sample.bonnet_share - cleared) / _BONNET_RIM_SHARE + 1
        shares[is_bonnet] *= np.clip(rim, 0, 1)[is_bonnet]
        slow, fast = _ROOF_SPEEDS_MPS
        blown = (1 - _FAST_ROOF_SHARE) * np.clip((speed_mps - slow) / (fast - slow), 0, 1)
        shares[sample.parts == VehiclePart.ROOF] *= 1 - blown
    return shares.astype(np.float32)


def is_upright(rotation: np.ndarray) -> bool:
    """Return True if a box with this rotation stands nearly upright."""
    return bool(rotation[2, 2] > math.cos(math.radians(15)))
