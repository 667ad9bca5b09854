"""Surfaces above the LiDAR's view: upper walls, trees and poles that only the images show.

A scene made from LiDAR ends at the sensor's highest channel; what stands above it is then painted
on the sky, and drifts under parallax. Where the drawn surface of an image ends near that channel it
is taken to go straight up. All views vote on every piece of it: a piece is kept where several show
one colour that is not their sky's, and none looks through it.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from adapters.lidar.initialise import SplatShape, gaussians_from_surfels
from adapters.lidar.surfels import Surfels
from adapters.lidar.voxels import edges_at
from adapters.recorded.wall_views import WallView, sky_colours
from adapters.recorded.wall_votes import FEW_VIEWS, Columns, Pieces, vote
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene import Gaussians, Scene

logger = logging.getLogger(__name__)

MAX_VIEWS = 300  # as many are looked at, evenly over the drive: what is coarse needs no more
VOXEL_M = 0.08
_RIM_MARGIN_RAD = math.radians(3.0)
_MOST_GAUSSIANS = 40_000
_HEIGHT_M = 30.0  # above the lowest camera
_SHAPE = SplatShape(opacity=0.6)  # hides most of the sky, yet gives way while it is learnt


def wall_tops(
    scene: Scene,
    source: ViewSource,
    *,
    lidar_top_deg: float = 15.0,
) -> Gaussians:
    """Degree-0 Gaussians that continue the background above the LiDAR's view; perhaps none.

    scene: as initialised from LiDAR. source: recorded views whose `sky` masks tell what sky looks
    like and whose `weight` masks out the recording car. lidar_top_deg: highest elevation that the
    LiDAR looks at. Deterministic.
    """
    views = _load_views(scene, source, lidar_top_deg)
    path = np.array([frame.world_from_ego[:3, 3].numpy() for frame in scene.frames])
    if not any(len(view.rims.points) for view in views) or len(path) == 0:
        return Gaussians.empty()
    looks = _sky_looks(views)
    voxel_m = VOXEL_M
    while True:
        columns = _columns(views, path, voxel_m)
        pieces = Pieces.of(columns)
        keep, colours = vote(pieces, columns, views, looks, math.radians(lidar_top_deg))
        kept = int(keep.sum())
        logger.info("%d of %d pieces of walls kept at %.3f m", kept, len(keep), voxel_m)
        if kept <= _MOST_GAUSSIANS:
            break
        voxel_m *= max(1.05, math.sqrt(kept / _MOST_GAUSSIANS))
    return _gaussians(pieces, columns, keep, colours)


def _load_views(scene: Scene, source: ViewSource, lidar_top_deg: float) -> list[WallView]:
    every = max(1, math.ceil(len(source.train) / MAX_VIEWS))
    by_camera: dict[str, list[ViewKey]] = defaultdict(list)
    for key in source.train:
        by_camera[key.camera].append(key)
    chosen = [key for group in by_camera.values() for key in group[::every]]
    lowest = math.radians(lidar_top_deg) - _RIM_MARGIN_RAD
    return [WallView.of(scene, source.load(key), lowest) for key in chosen]


def _sky_looks(views: Sequence[WallView]) -> list[np.ndarray]:
    """For each view, which coarse colours are sky."""
    totals: dict[str, np.ndarray] = {}
    for view in views:
        name = view.camera.name
        totals[name] = totals.get(name, 0) + view.sky_counts
    return [sky_colours(view.sky_counts, totals[view.camera.name]) for view in views]


def _columns(views: Sequence[WallView], path: np.ndarray, voxel_m: float) -> Columns:
    """The rims of all views, joined where they stand on one cell of the plan."""
    rims = [view.rims for view in views]
    points = np.concatenate([r.points for r in rims])
    owner = np.repeat(np.arange(len(rims)), [len(r.points) for r in rims])
    edges = edges_at(points, path, voxel_m=voxel_m).astype(np.float64)
    level = np.round(4 * np.log2(edges / voxel_m)).astype(np.int64)
    cell = np.floor(points[:, :2] / edges[:, None]).astype(np.int64) + (1 << 23)
    _, column = np.unique((level << 48) | (cell[:, 0] << 24) | cell[:, 1], return_inverse=True)
    count = int(column.max()) + 1
    seen_by = np.unique(column * len(views) + owner) // len(views)
    enough = np.bincount(seen_by, minlength=count) >= min(FEW_VIEWS, len(views))
    order = np.lexsort((points[:, 2], column))
    sizes = np.bincount(column, minlength=count)
    starts = np.cumsum(sizes) - sizes
    high = np.full(count, -np.inf)
    np.maximum.at(high, column, np.concatenate([r.reach_z_m for r in rims]))
    ceiling = min(float(view.camera.centre[2]) for view in views) + _HEIGHT_M
    normals = np.concatenate([r.normals for r in rims]).astype(np.float64)
    columns = Columns(
        xy=np.stack([np.bincount(column, points[:, a]) / sizes for a in range(2)], axis=1),
        low_z_m=points[order, 2][starts + sizes // 2],
        high_z_m=np.minimum(high, ceiling),
        edge_m=edges[order][starts],
        normals=_level_normals(normals, column, count),
        semantic=_commonest(np.concatenate([r.semantic for r in rims]), column, count),
    )
    return columns.select(enough)


def _level_normals(normals: np.ndarray, column: np.ndarray, count: int) -> np.ndarray:
    """The level direction along which the normals of each column point, whatever their signs."""
    xx, yy, xy = (
        np.bincount(column, normals[:, a] * normals[:, b], count)
        for a, b in ((0, 0), (1, 1), (0, 1))
    )
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def _commonest(semantic: np.ndarray, column: np.ndarray, count: int) -> np.ndarray:
    votes = np.zeros((count, 64), np.int64)
    np.add.at(votes, (column, semantic), 1)
    votes[:, 0] = 0  # UNKNOWN only where nothing else was seen
    return votes.argmax(axis=1).astype(np.int16)


def _gaussians(
    pieces: Pieces, columns: Columns, keep: np.ndarray, colours: np.ndarray
) -> Gaussians:
    column = pieces.column[keep]
    normals = columns.normals[column].astype(np.float32)
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), normals.shape)
    edges = columns.edge_m[column].astype(np.float32)
    surfels = Surfels(
        centres=pieces.centres[keep].astype(np.float32),
        normals=normals,
        major=np.cross(up, normals),
        spacing=np.repeat(edges[:, None], 2, axis=1),
        isolated=np.zeros(len(column), np.bool_),
        neighbours=np.zeros((len(column), 0), np.int64),
    )
    return gaussians_from_surfels(surfels, colours[keep], columns.semantic[column], _SHAPE)
