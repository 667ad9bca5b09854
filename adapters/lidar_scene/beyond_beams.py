"""Splats for what photos show as surface and the LiDAR did not reach: storeys, crowns, poles, the
end of the street.

One recorded image after another is compared with the Gaussians so far. Where it shows no sky, and
the Gaussians leave it open, discs in the photo's colours are placed at the depth that
`adapters.lidar_scene.dense_depth` gives. They are small at the photo's edges and large where it is
even, so that far walls need few. A disc that other images see as sky is placed far away, or left
out. The callers are `adapters.lidar_scene.scene` and `adapters.training_views.starting_scene`.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.dense_depth import FAR_M, DenseDepth, KnownSurface, complete_depth
from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels
from adapters.lidar_scene.wall_planes import WallPlanes, find_wall_planes
from adapters.world import join_gaussians
from augment.photo.sky_matte import SkyMatte
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians

logger = logging.getLogger(__name__)

WORK_WIDTH = 480  # columns of the images in which surfaces are added, at most
_OPEN_ALPHA = 0.9  # alpha of the Gaussians so far below which a pixel is open
_SOLID_SHARE = 0.5  # share of sky below which a pixel shows a surface
_BEHIND = 0.002  # gap from a surface that leaks to the disc behind it, as a part of the depth
_BEHIND_M = 0.02  # constant part of that gap, metres
_SIDES_PX = (16, 8, 4, 2, 1)  # sides of discs, pixels
# Largest standard deviations of CIELAB colours within a disc, in turn, until there is room for all.
_COLOR_TOLERANCES = (2.0, 4.0, 8.0, 16.0)
_DEPTH_TOLERANCE = 0.02  # largest standard deviation of the logarithm of depths within a disc
_VIEWS_PER_SHARE = 8  # one view adds the remaining number over this at most, if so many follow
_MIN_COSINE = 0.15  # of the angle between a ray and a wall's normal, to which a disc is stretched
_SURE_SKY = 0.98  # share of sky above which an image shows sky
_MAX_CONFLICTS = 0.3  # part of the images of a disc in which it may cover sky
_SHAPE = SplatShape(sigma_per_spacing=0.65, opacity=0.99)


class SolidView(NamedTuple):
    """A recorded image in which surfaces are added, of H x W pixels."""

    camera: Camera
    """Camera at the image's size."""
    rgb: np.ndarray
    """The photo, uint8 [H, W, 3]."""
    matte: SkyMatte
    """Its sky."""
    excluded: np.ndarray
    """Pixels of the recording car and of moving objects, bool [H, W]."""


# Background and camera to everything that is drawn, the background first.
PosesParts = Callable[[Gaussians, Camera], Sequence[PosedGaussians]]


def add_surfaces_beyond_beams(
    background: Gaussians,
    views: Iterable[SolidView],
    pose_parts: PosesParts,
    *,
    lidar_top_rad: float,
    max_added: int,
) -> Gaussians:
    """Return the background with discs until the views' pixels without sky have a surface.

    Args:
        background: splats of what stands still, with classes.
        views: recorded images, in the order in which they add discs.
        pose_parts: places background and actors for a camera.
        lidar_top_rad: highest elevation that the LiDAR looks at.
        max_added: largest number of discs.
    """
    views = list(views)
    walls = find_wall_planes(background)
    count = len(background)
    for number, view in enumerate(views):
        room = max_added - (len(background) - count)
        room //= min(_VIEWS_PER_SHARE, len(views) - number)
        alpha, known = _draw(background, view.camera, pose_parts)
        is_open = (alpha < _OPEN_ALPHA) & (view.matte.sky_share < _SOLID_SHARE) & ~view.excluded
        is_open &= view.camera.ray_directions().numpy()[..., 2] > -0.5 / view.camera.fy
        if not is_open.any() or room < 1:
            continue
        depth = complete_depth(
            view.camera, view.rgb, view.matte.sky_share, known, walls, lidar_top_rad
        )
        leaks = np.isfinite(known.depth_m)
        depth = depth._replace(
            depth_m=np.where(leaks, depth.depth_m * (1 + _BEHIND) + _BEHIND_M, depth.depth_m)
        )
        cells = _cells(view, depth, is_open, room)
        discs = _discs(view, depth, cells, walls, [other for other in views if other is not view])
        background = join_gaussians([background, discs])
    logger.info("%d splats beyond the LiDAR's view", len(background) - count)
    return background


def _draw(
    background: Gaussians, camera: Camera, pose_parts: PosesParts
) -> tuple[np.ndarray, KnownSurface]:
    """Return alpha [H, W] and the surfaces of the Gaussians so far."""
    parts = pose_parts(background, camera)
    raster = rasterize(parts, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
    assert raster.alpha is not None and raster.median_depth is not None
    assert raster.splat_ids is not None and background.semantic is not None
    alpha = raster.alpha.numpy()
    ids = raster.splat_ids.numpy()
    in_background = (ids >= 0) & (ids < len(background))
    semantic = background.semantic.numpy()[np.where(in_background, ids, 0)]
    depth = np.where(alpha >= SURFACE_ALPHA, raster.median_depth.numpy(), np.inf)
    return alpha, KnownSurface(depth, semantic.astype(np.int16), (ids >= len(background)))


class _Cells(NamedTuple):
    """M square cells of pixels."""

    rows: np.ndarray
    """First row of each cell, int64 [M]."""
    columns: np.ndarray
    """First column of each cell, int64 [M]."""
    sides: np.ndarray
    """Side of each cell, pixels, int64 [M]."""

    def select(self, keep: np.ndarray) -> _Cells:
        return _Cells(*(column[keep] for column in self))


def _cells(view: SolidView, depth: DenseDepth, is_open: np.ndarray, room: int) -> _Cells:
    """Return the cells that cover the open pixels, `room` at most.

    A cell is as large as colour and depth are even in it. If there are too many, colours may
    differ more; at last the smallest cells are left out.
    """
    lab = cv2.cvtColor(view.matte.surface_rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    log_depth = np.log(np.maximum(depth.depth_m, 1e-3)).astype(np.float32)
    for tolerance in _COLOR_TOLERANCES:
        cells = _split(lab, log_depth, is_open, tolerance)
        if len(cells.rows) <= room:
            return cells
    largest_first = np.argsort(-cells.sides, kind="stable")[:room]
    return cells.select(np.sort(largest_first))


def _split(lab: np.ndarray, log_depth: np.ndarray, is_open: np.ndarray, tolerance: float) -> _Cells:
    """Return cells of a quadtree: of each open pixel the largest one that is open and even."""
    height, width = is_open.shape
    missing = is_open.copy()
    found = []
    for side in _SIDES_PX:
        rows = height // side
        columns = width // side
        inside = slice(0, rows * side), slice(0, columns * side)

        def mean(image: np.ndarray, inside=inside, size=(columns, rows)) -> np.ndarray:
            return cv2.resize(image[inside], size, interpolation=cv2.INTER_AREA)

        if rows == 0 or columns == 0:
            continue
        is_cell = mean(missing.astype(np.float32)) > 1 - 0.5 / side**2
        if side > 1:
            variance = (mean(lab * lab) - mean(lab) ** 2).sum(-1)
            depth_variance = mean(log_depth * log_depth) - mean(log_depth) ** 2
            is_cell &= (variance < tolerance**2) & (depth_variance < _DEPTH_TOLERANCE**2)
        cell_rows, cell_columns = np.nonzero(is_cell)
        found.append((cell_rows * side, cell_columns * side, np.full(len(cell_rows), side)))
        taken = np.kron(is_cell, np.ones((side, side), np.bool_))
        missing[inside] &= ~taken
    return _Cells(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _discs(
    view: SolidView,
    depth: DenseDepth,
    cells: _Cells,
    walls: WallPlanes,
    others: Sequence[SolidView],
) -> Gaussians:
    """Return a disc for each cell, without those that other images see as sky."""
    camera = view.camera
    half = (cells.sides // 2,) * 2
    middle_rows = np.minimum(cells.rows + half[0], camera.height - 1)
    middle_columns = np.minimum(cells.columns + half[1], camera.width - 1)
    rays = _rays_at(camera, cells.rows + cells.sides / 2, cells.columns + cells.sides / 2)
    depth_m = depth.depth_m[middle_rows, middle_columns]
    wall = depth.wall[middle_rows, middle_columns]
    centre = camera.centre.numpy()
    level = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    conflicts = _conflicts(centre + depth_m[:, None] * rays, others)
    goes_far = np.flatnonzero(conflicts > 0)
    far_m = FAR_M / level[goes_far]
    far_conflicts = _conflicts(centre + far_m[:, None] * rays[goes_far], others)
    better = far_conflicts < conflicts[goes_far]
    depth_m[goes_far[better]] = far_m[better]
    wall[goes_far[better]] = -1
    conflicts[goes_far[better]] = far_conflicts[better]
    keep = conflicts <= _MAX_CONFLICTS
    surfels = _oriented_surfels(
        centre + (depth_m[:, None] * rays), rays, depth_m * cells.sides / camera.fx, wall, walls
    )
    colors, share = _colors_of_cells(view, cells)
    semantic = depth.semantic[middle_rows, middle_columns]
    index = np.flatnonzero(keep)
    discs = gaussians_from_surfels(surfels.select(index), colors[index], semantic[index], _SHAPE)
    opacities = np.minimum(_SHAPE.opacity, 1.2 * (1 - share[index])).astype(np.float32)
    return dataclasses.replace(discs, opacities=torch.from_numpy(opacities))


def _rays_at(camera: Camera, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the directions through image positions, with unit depth, world, float64 [M, 3]."""
    local = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1
    )
    return local @ camera.camera_from_world[:3, :3].numpy().astype(np.float64)


def _oriented_surfels(
    points: np.ndarray, rays: np.ndarray, pitch_m: np.ndarray, wall: np.ndarray, walls: WallPlanes
) -> Surfels:
    """Return discs that lie on their walls, or face the camera.

    Args:
        points: float64 [M, 3], world.
        rays: float64 [M, 3], world.
        pitch_m: float64 [M], distance to the next disc across the rays.
        wall: int64 [M], number of the wall, -1 for none.
        walls: the walls.
    """
    toward = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normals = toward.copy()
    stretch = np.ones(len(points))
    on_wall = wall >= 0
    if on_wall.any():
        plan = walls.normals[wall[on_wall]]
        normals[on_wall] = np.column_stack([plan, np.zeros(len(plan))])
        cosine = np.abs((normals[on_wall] * toward[on_wall]).sum(1))
        stretch[on_wall] = 1 / np.maximum(cosine, _MIN_COSINE)
    major = np.cross([0.0, 0.0, 1.0], normals)
    major /= np.maximum(np.linalg.norm(major, axis=1, keepdims=True), 1e-9)
    surfels = Surfels.discs(points, normals, major, pitch_m)
    spacing = np.stack([pitch_m * stretch, pitch_m], axis=1).astype(np.float32)
    return dataclasses.replace(surfels, spacing=spacing)


def _colors_of_cells(view: SolidView, cells: _Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return mean colours without sky, float32 [M, 3] in [0, 1], and shares of sky, [M]."""
    images = np.dstack([view.matte.surface_rgb.astype(np.float64) / 255, view.matte.sky_share])
    sums = cv2.integral(images)  # [H + 1, W + 1, 4]
    rows = cells.rows
    columns = cells.columns
    last_rows = rows + cells.sides
    last_columns = columns + cells.sides
    total = sums[last_rows, last_columns] - sums[rows, last_columns]
    total += sums[rows, columns] - sums[last_rows, columns]
    means = total / (cells.sides**2)[:, None]
    return means[:, :3].clip(0, 1).astype(np.float32), means[:, 3].clip(0, 1)


def _conflicts(points: np.ndarray, views: Sequence[SolidView]) -> np.ndarray:
    """Return the part of the views that see sky at each point, of those that see it, float64 [M].

    Sky counts if all pixels around are sky as well: depths are not exact.
    """
    num_views = np.zeros(len(points))
    num_sky = np.zeros(len(points))
    for view in views:
        camera = view.camera
        pose = camera.camera_from_world.numpy()
        x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
        front = np.flatnonzero(z > 1.0)
        u = np.floor(camera.fx * x[front] / z[front] + camera.cx).astype(np.int64)
        v = np.floor(camera.fy * y[front] / z[front] + camera.cy).astype(np.int64)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        index = front[inside]
        sure_sky = cv2.erode(view.matte.sky_share, np.ones((3, 3), np.uint8)) > _SURE_SKY
        num_views[index] += 1
        num_sky[index] += sure_sky[v[inside], u[inside]]
    return num_sky / np.maximum(num_views, 1)
