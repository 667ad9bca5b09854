"""The cells that snow can lie on against the procedural street's true surface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from adapters.procedural import StreetTruth
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.surface import DRIVEN_MAX_SLOPE_DEG, moves
from augment.scene import Scene
from augment.semantics import SemanticClass
from tools.bench_snow_truth import TruePoints, body_tops, surface_below

OVER_M = 0.2  # a cell farther above or below the true surface does not lie on it
RINGS_M = (8.0, 16.0, 32.0)
EDGE_M, STEP_M = 0.2, 0.1  # a point is at an edge if this near to it the surface is that far off
TOP_PIXEL_M = 0.03  # between points on a car


def cells_over(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """int64 [P]: the cell over each point and close to its surface, -1 where there is none."""
    centers, sizes = cells.centers_m.numpy().astype(np.float64), cells.sizes_m.numpy()
    normals = cells.normals.numpy().astype(np.float64)
    out = np.full(len(points), -1, np.int64)
    for size in np.unique(sizes):
        own = np.flatnonzero(sizes == size)
        low = centers[own, :2] - size / 2
        offset = low[0] % size  # cells of one size share a grid
        key = _keys(np.round((low - offset) / size).astype(np.int64))
        place = _keys(np.floor((points.xy - offset) / size).astype(np.int64))
        order = np.argsort(key)
        at = np.minimum(np.searchsorted(key[order], place), len(own) - 1)
        found = own[order[at]]
        met = key[order[at]] == place
        z = _plane_z(centers[found], normals[found], points.xy)
        met &= np.abs(z - points.z) <= OVER_M
        out[met] = found[met]
    return out


def _keys(columns_rows: np.ndarray) -> np.ndarray:
    return (columns_rows[:, 0] << 32) + columns_rows[:, 1]


def _plane_z(centers: np.ndarray, normals: np.ndarray, xy: np.ndarray) -> np.ndarray:
    slopes = -normals[:, :2] / normals[:, 2:]
    return centers[:, 2] + (slopes * (xy - centers[:, :2])).sum(1)


def bed_heights(cells: SnowCells, points: TruePoints) -> np.ndarray:
    """z [P] of the bed under each point, NaN where it has none."""
    over = cells_over(cells, points)
    z = np.full(len(points), np.nan)
    met = over >= 0
    found = over[met]
    z[met] = _plane_z(
        cells.centers_m.numpy()[found].astype(np.float64),
        cells.normals.numpy()[found].astype(np.float64),
        points.xy[met],
    )
    return z


def at_edges(truth: StreetTruth, points: TruePoints) -> np.ndarray:
    """bool [P]: within EDGE_M the true surface leaves the point's own plane by STEP_M or more."""
    off = np.zeros(len(points), bool)
    steep = np.tan(points.slope)
    for angle in np.arange(8) * (math.pi / 4):
        shift = EDGE_M * np.array([math.cos(angle), math.sin(angle)])
        beside = surface_below(truth, points.xy + shift)
        off |= np.abs(beside - points.z) > STEP_M + EDGE_M * steep
    return off


def covered_shares(cells: SnowCells, flat: TruePoints, edges: np.ndarray) -> dict[str, Any]:
    """Shares of the points that have a cell; of all, of those at no edge, of each class and ring
    about the path.
    """
    covered = cells_over(cells, flat) >= 0
    inner = ~edges & (flat.semantic != SemanticClass.VEGETATION)
    return {**class_shares(covered, flat), "covered_off_edges": float(covered[inner].mean())}


def class_shares(covered: np.ndarray, flat: TruePoints) -> dict[str, Any]:
    classes = {}
    for number in np.unique(flat.semantic):
        own = flat.semantic == number
        classes[SemanticClass(int(number)).name.lower()] = {
            "points": int(own.sum()),
            "covered": float(covered[own].mean()),
        }
    rings, low = {}, 0.0
    for high in RINGS_M:
        own = (flat.from_path_m >= low) & (flat.from_path_m < high)
        rings[f"{low:g}-{high:g} m"] = float(covered[own].mean()) if own.any() else None
        low = high
    crown = flat.semantic == SemanticClass.VEGETATION
    return {
        "covered": float(covered[~crown].mean()),
        "covered_with_crowns": float(covered.mean()),
        "classes": classes,
        "rings": rings,
    }


def sheltered_share(cells: SnowCells, truth: StreetTruth, points: TruePoints) -> dict[str, float]:
    """Shares by area of the cells that lie OVER_M or more beneath the true surface which is open to
    the sky there, and of those that lie as much above it, on nothing.
    """
    centers, sizes = cells.centers_m.numpy().astype(np.float64), cells.sizes_m.numpy()
    low, high = points.xy.min(0), points.xy.max(0)
    inside = ((centers[:, :2] >= low) & (centers[:, :2] <= high)).all(1)
    centers, area = centers[inside], sizes[inside].astype(np.float64) ** 2
    off = centers[:, 2] - surface_below(truth, centers[:, :2])
    whole = max(float(area.sum()), 1e-9)
    return {
        "sheltered": float(area[off < -OVER_M].sum()) / whole,
        "in_the_air": float(area[off > OVER_M].sum()) / whole,
    }


def vehicle_shares(bed: SnowSupport, scene: Scene, truth: StreetTruth) -> dict[str, Any]:
    """Of the cars that drive: share of their tops, less steep than what drivers keep clear, that
    has a cell; and how far those are from the true body.
    """
    covered, errors = [], []
    for actor, mover in zip(scene.actors, truth.street.movers, strict=True):
        if actor.track_id not in bed.actors or not moves(actor):
            continue
        half = np.array(mover.size_m[:2]) / 2
        axes = [np.arange(-h + TOP_PIXEL_M / 2, h, TOP_PIXEL_M) for h in half]
        tops = body_tops(mover.body, np.stack(np.meshgrid(*axes), -1).reshape(-1, 2))
        flat = tops.slope < math.radians(DRIVEN_MAX_SLOPE_DEG)
        tops = tops.chosen(flat & (tops.z > 0))  # above the box's middle: no bumpers and sills
        cells = bed.actors[actor.track_id]
        covered.append(cells_over(cells, tops) >= 0)
        errors.append(bed_heights(cells, tops) - tops.z)
    if not covered:
        return {"points": 0, "covered": None, "bed_error_m": height_error(np.zeros(0))}
    return {
        "points": sum(map(len, covered)),
        "covered": float(np.concatenate(covered).mean()),
        "bed_error_m": height_error(np.concatenate(errors)),
    }


def height_error(off: np.ndarray) -> dict[str, float | None]:
    """Of height differences [P], NaN left out."""
    off = off[np.isfinite(off)]
    if len(off) == 0:
        return {"median": None, "p95": None, "bias": None}
    size = np.abs(off)
    return {
        "median": float(np.median(size)),
        "p95": float(np.quantile(size, 0.95)),
        "bias": float(np.median(off)),
    }
