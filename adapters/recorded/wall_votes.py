"""Which pieces of continued walls the recorded views agree on, and in what colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.lidar import kernels
from adapters.recorded.wall_views import (
    LIDAR_MARGIN_RAD,
    LIDAR_REACH_M,
    WallView,
    colour_cells,
    elevation_rad,
)

FEW_VIEWS = 3  # that must show a place where a wall goes on, and a piece of it
_SKY_PART, _SEEN_THROUGH_PART = 0.3, 0.3  # of the views of a piece, that end the wall
_SPREAD_LEVELS = 28.0  # of 255: median deviation from the median colour of one surface
_GAP_M = 0.8  # of pieces in a row that fail end a column; a window that mirrors the sky is lower
_NEARER, _NEARER_M = 0.03, 0.3  # tolerance of depth comparisons, relative and in metres
_KEEP_SCORE, _CAMERA_POWER = 0.5, 2.0  # as for the colours of LiDAR's surfaces
_FEATHER = 0.1  # scores fall over this part of the image towards its border


@dataclass(frozen=True, eq=False)
class Columns:
    """Places in plan where a surface goes on. xy: float64 [C, 2]. low_z_m, high_z_m: float64 [C],
    the span that images show. edge_m: float64 [C]. normals: float64 [C, 3], level and unit.
    semantic: int16 [C]."""

    xy: np.ndarray
    low_z_m: np.ndarray
    high_z_m: np.ndarray
    edge_m: np.ndarray
    normals: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, index: np.ndarray) -> Columns:
        return Columns(*(getattr(self, name)[index] for name in Columns.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Pieces:
    """N pieces, column after column, upward. centres: float64 [N, 3]. column, step: int64 [N]."""

    centres: np.ndarray
    column: np.ndarray
    step: np.ndarray

    @staticmethod
    def of(columns: Columns) -> Pieces:
        rows = np.ceil((columns.high_z_m - columns.low_z_m) / columns.edge_m)
        count = np.maximum(rows, 0).astype(np.int64)
        column = np.repeat(np.arange(len(columns)), count)
        step = np.arange(len(column)) - np.repeat(np.cumsum(count) - count, count)
        z = columns.low_z_m[column] + (step + 0.5) * columns.edge_m[column]
        return Pieces(np.concatenate([columns.xy[column], z[:, None]], axis=1), column, step)


def vote(
    pieces: Pieces,
    columns: Columns,
    views: Sequence[WallView],
    looks: Sequence[np.ndarray],
    lidar_top_rad: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Which pieces are surface, bool [N], and their colours, float32 [N, 3]."""
    count = len(pieces.centres)
    scores = np.zeros((count, kernels.KEPT), np.float32)
    colours = np.zeros((count, kernels.KEPT, 3), np.uint8)
    cameras = np.zeros((count, kernels.KEPT), np.uint8)
    shown, sky, through = (np.zeros(count, np.int64) for _ in range(3))
    names = list(dict.fromkeys(view.camera.name for view in views))
    for view, look in zip(views, looks, strict=True):
        seen, rgb, score, empty = _look(pieces.centres, view, lidar_top_rad)
        is_sky = look[colour_cells(rgb)]
        through[seen[empty]] += 1
        sky[seen[is_sky & ~empty]] += 1
        shown[seen[~is_sky & ~empty]] += 1
        worst = scores[seen].argmin(axis=1)
        better = ~empty & (score > scores[seen, worst])
        index, worst = seen[better], worst[better]
        scores[index, worst] = score[better]
        colours[index, worst] = rgb[better]
        cameras[index, worst] = names.index(view.camera.name)
    blended, _ = kernels.blended_colours(scores, colours, cameras, _KEEP_SCORE, _CAMERA_POWER)
    total = shown + sky + through
    good = shown >= min(FEW_VIEWS, len(views))
    good &= (sky <= _SKY_PART * total) & (through <= _SEEN_THROUGH_PART * total)
    good &= _spread(scores, colours, blended) <= _SPREAD_LEVELS
    empty = (through > _SEEN_THROUGH_PART * total) | (total == 0)
    return _without_holes(good, empty, pieces, columns), blended


def _look(
    centres: np.ndarray, view: WallView, lidar_top_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the pieces that nothing hides, their pixels' colours uint8 [M, 3], scores float32
    [M], and whether the view shows that nothing can be there."""
    camera = view.camera
    pose = camera.camera_from_world.numpy()
    local = centres @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    ahead = np.maximum(z, 0.5)
    u = camera.fx * local[:, 0] / ahead + camera.cx
    v = camera.fy * local[:, 1] / ahead + camera.cy
    seen = np.flatnonzero(
        (z > 0.5) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    )
    column, row = u[seen].astype(np.int64), v[seen].astype(np.int64)
    used = view.used[row, column]
    seen, row, column = seen[used], row[used], column[used]
    z, depth = z[seen], view.depth_m[row, column].astype(np.float64)
    slack = _NEARER * z + _NEARER_M
    hidden = z > np.abs(depth) + slack
    offsets = centres[seen] - camera.centre.numpy()
    looked = elevation_rad(offsets) < lidar_top_rad - LIDAR_MARGIN_RAD
    looked &= np.hypot(offsets[:, 0], offsets[:, 1]) < LIDAR_REACH_M
    empty = np.where(depth > 0, np.isfinite(depth) & (z < depth - slack), False)
    empty |= looked & np.isinf(depth)
    border = np.minimum(
        np.minimum(u[seen], camera.width - u[seen]) / camera.width,
        np.minimum(v[seen], camera.height - v[seen]) / camera.height,
    )
    score = (np.minimum(border / _FEATHER, 1.0) + 1e-3) * camera.fx / z
    open_ = ~hidden
    return (
        seen[open_],
        view.rgb[row[open_], column[open_]],
        score[open_].astype(np.float32),
        empty[open_],
    )


def _spread(scores: np.ndarray, colours: np.ndarray, blended: np.ndarray) -> np.ndarray:
    """Median over a piece's observations of their largest deviation from its colour, float [N]."""
    off = np.abs(colours - 255 * blended[:, None]).max(axis=2)
    off = np.where(scores > 0, off, np.nan)
    off[~(scores > 0).any(axis=1)] = np.inf
    return np.nanmedian(off, axis=1)


def _without_holes(
    good: np.ndarray, empty: np.ndarray, pieces: Pieces, columns: Columns
) -> np.ndarray:
    """The good pieces up to where _GAP_M of their column fails, with what they enclose that is not
    surely empty; bool [N]."""
    rows = int(pieces.step.max(initial=-1)) + 1
    last = np.full(len(columns), -1, np.int64)  # the highest good piece below the column's end
    gap = np.ceil(_GAP_M / columns.edge_m).astype(np.int64)
    table = np.zeros((len(columns), rows), np.bool_)
    table[pieces.column, pieces.step] = good
    for step in range(rows):
        goes_on = table[:, step] & (step - last <= gap)
        last[goes_on] = step
    return (good | ~empty) & (pieces.step <= last[pieces.column])
