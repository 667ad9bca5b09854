"""Starting point of reconstruction: the scene of a recording, completed where LiDAR sees
nothing.

Walls and crowns continue above the LiDAR's view, and behind glass. Where images show neither sky
nor a surface there, new surface stands straight over the surface below. Otherwise it would be
learnt into the sky, where fog swallows it.

The recording car's own bonnet or roof stands before some cameras. It becomes an actor that travels
with the camera; otherwise it would be learnt into the road below, anew in every frame. It stands
still in the image, so its true distance cannot be told from the images, and need not be: it is
placed near the camera, where nothing else is and other cameras do not look.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels
from adapters.training_views.views import RecordedViews
from adapters.world import join_gaussians
from augment.photo.lidar_view import TOP_MARGIN_RAD
from augment.photo.own_car import spread_evenly
from augment.reconstruct.view import ViewSource
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Actor, Gaussians, Scene, Track
from augment.scene.semantics import SemanticClass

logger = logging.getLogger(__name__)

_PX_PER_SPLAT = 8  # pixels of the recorded image from splat to splat: two at a quarter of its size
_COLUMNS = (160, 320)  # fewest and most splats across a whole image
_MAX_IMAGES = 48  # that the median is taken over
_MIN_SPLATS = 16  # a smaller mask is a speck, not a car
_COVERED = 0.5  # part of a splat's cell that must lie in the mask
_BODY_FAR_M = 1.6  # largest distance of the body along the optical axis
_BODY_NEAR_M = 0.4  # smallest distance of the body along the optical axis
_HALF_WIDTH_M = 0.95  # half a car's width: the body does not reach aside into other cameras' views
_MIN_SLOPE = 0.05  # a roof below the camera is seen at no flatter angle than this
_MARGIN_M = 0.01  # from the body's outermost splats to its box
_BODY_SHAPE = SplatShape(sigma_per_spacing=0.6, opacity=0.95)

_WALLS = (
    SemanticClass.BUILDING,
    SemanticClass.BARRIER,
    SemanticClass.VEGETATION,
    SemanticClass.UNKNOWN,
)
_WALL_COLUMNS = 240  # of the images in which walls are continued: one disc a pixel
_MAX_WALL_IMAGES = 48  # in which walls are continued
_MAX_WALL_M = 80.0  # beyond, a LiDAR's channels lie so far apart that a surface's end is unknown
_MAX_WALL_SPLATS = 60_000  # that are added above walls, over all images
_WALL_SHAPE = SplatShape(sigma_per_spacing=0.6, opacity=0.95)

# Camera axes (x right, y down, z forward) to an actor's (x forward, y left, z up).
_ACTOR_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def complete_starting_scene(scene: Scene, views: RecordedViews) -> Scene:
    """Return the scene with upper walls and with a body of the recording car, from training
    views alone.

    The upper walls are those that the LiDAR does not see. A body is added for every camera that
    sees the car.
    """
    scene = dataclasses.replace(scene, background=continue_walls(scene, views))
    bodies = [ego_body(scene, name, mask, views) for name, mask in views.ego_masks.items()]
    actors = (*scene.actors, *(body for body in bodies if body is not None))
    return dataclasses.replace(scene, actors=actors)


def continue_walls(scene: Scene, views: RecordedViews) -> Gaussians:
    """Return the background with discs where training views show neither sky nor a surface.

    They stand straight over a wall or a crown that reaches the LiDAR's highest view, or that
    continues above them.
    """
    background = scene.background
    if views.lidar_top_rad is None or background.semantic is None:
        return background
    classes = background.semantic.numpy()
    room = _MAX_WALL_SPLATS
    for key in spread_evenly(views.train, _MAX_WALL_IMAGES):
        view = views.load(key)
        camera = view.camera.scaled(min(1.0, _WALL_COLUMNS / view.camera.width))
        parts = dataclasses.replace(scene, background=background).parts_for(camera)
        raster = rasterize(parts, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
        assert raster.alpha is not None
        assert raster.median_depth is not None and raster.splat_ids is not None
        ids = raster.splat_ids.numpy()
        in_background = (ids >= 0) & (ids < len(background))
        semantic = classes[np.where(in_background, ids, 0)]
        size = (camera.width, camera.height)
        closed = view.sky | views.own_car(key)
        above_walls = _above_walls(
            camera,
            np.where(raster.alpha.numpy() >= SURFACE_ALPHA, raster.median_depth.numpy(), np.inf),
            in_background & np.isin(semantic, _WALLS),
            cv2.resize(closed.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0,
            views.lidar_top_rad - TOP_MARGIN_RAD,
        )
        rows, columns = np.nonzero(above_walls.depth > 0)
        room -= len(rows)
        if room < 0:
            break
        rays = camera.ray_directions(torch.float64).numpy()[rows, columns]
        depth = above_walls.depth[rows, columns]
        normals = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        major = np.cross([0.0, 0.0, 1.0], normals)
        major /= np.maximum(np.linalg.norm(major, axis=1, keepdims=True), 1e-9)
        points = camera.centre.numpy() + depth[:, None] * rays
        rgb = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
        discs = gaussians_from_surfels(
            Surfels.discs(points, normals, major, depth / camera.fx),
            (rgb[rows, columns] / 255).astype(np.float32),
            semantic[above_walls.base[rows, columns], columns],
            _WALL_SHAPE,
        )
        background = join_gaussians([background, discs])
        classes = np.append(classes, semantic[above_walls.base[rows, columns], columns])
    logger.info("%d splats above walls", len(background) - len(scene.background))
    return background


class _AboveWalls(NamedTuple):
    """Surface that is added above walls.

    Attributes:
        depth: float64 [H, W], z of the new surface, 0 without one.
        base: int64 [H, W], row of the surface below.
    """

    depth: np.ndarray
    base: np.ndarray


def _above_walls(
    camera: Camera, depth: np.ndarray, is_wall: np.ndarray, closed: np.ndarray, top_rad: float
) -> _AboveWalls:
    """Return the surface to add above walls.

    depth: [H, W], z of surfaces, infinite where there is none. is_wall: bool [H, W]. closed: bool
    [H, W], sky and the recording car. top_rad: highest elevation of the LiDAR's view."""
    height = camera.height
    row = np.arange(height)[:, None]
    solid = np.isfinite(depth)

    def below(mask: np.ndarray) -> np.ndarray:
        """Return each pixel's nearest row of the mask at or below it; height where none is."""
        rows = np.where(mask, row, height)
        return np.minimum.accumulate(rows[::-1], axis=0)[::-1]

    def above(mask: np.ndarray) -> np.ndarray:
        """Return each pixel's nearest row of the mask at or above it; -1 where none is."""
        return np.maximum.accumulate(np.where(mask, row, -1), axis=0)

    base = below(solid)
    goes_on = ~solid & (base < height) & (below(closed) > base)
    base = np.minimum(base, height - 1)
    columns = np.arange(camera.width)[None]
    rays = camera.ray_directions(torch.float64).numpy()
    level = np.hypot(rays[..., 0], rays[..., 1])  # metres on the plan for a metre of depth
    rise_rad = np.arctan2(rays[..., 2], level)
    distance_m = np.where(solid, depth, 0.0)[base, columns] * level[base, columns]
    goes_on &= (rise_rad > 0) & is_wall[base, columns] & (distance_m < _MAX_WALL_M)
    is_enclosed = above(solid) > above(closed)
    goes_on &= is_enclosed | (rise_rad[base, columns] > top_rad)
    return _AboveWalls(np.where(goes_on, distance_m / np.maximum(level, 1e-9), 0.0), base)


def ego_body(scene: Scene, camera_name: str, mask: np.ndarray, source: ViewSource) -> Actor | None:
    """Return the part of the recording car that a camera sees. None without a mask or images.

    The actor's frame is the camera's own, turned to x forward, y left, z up and moved to the box's
    centre. Its track are the camera's poses at its own times, so that the body stands still in
    every image. Its label is EGO_VEHICLE and its class OTHER: it has no box.

    Args:
        scene: the scene.
        camera_name: the camera.
        mask: bool [H, W] of that camera's images at any scale, True where they show the car.
        source: recorded views. The median over time of the camera's training views gives the
            colours.
    """
    cameras = [frame.cameras[camera_name] for frame in scene.frames if camera_name in frame.cameras]
    first = cameras[0]
    step = first.width / min(max(first.width / _PX_PER_SPLAT, _COLUMNS[0]), _COLUMNS[1])
    grid = first.scaled(min(1.0, 1 / step))
    size = (grid.width, grid.height)
    part = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(part >= _COVERED)
    if len(rows) < _MIN_SPLATS:
        return None
    colours = _median_colours(camera_name, source, size, rows, columns)
    if colours is None:
        return None
    points, spacing = _place(grid, rows, columns)
    gaussians, centre, size_m = _body_gaussians(points, spacing, colours)
    logger.info("%d splats for the recording car in camera %s", len(gaussians), camera_name)
    return Actor(
        track_id=f"{EGO_VEHICLE}:{camera_name}",
        label=EGO_VEHICLE,
        gaussians=gaussians,
        track=_track(cameras, centre),
        size_m=size_m,
    )


def _median_colours(
    camera_name: str,
    source: ViewSource,
    size: tuple[int, int],
    rows: np.ndarray,
    columns: np.ndarray,
) -> np.ndarray | None:
    """Return the median over the images, float32 [N, 3] in [0, 1], or None without any."""
    camera_keys = [k for k in source.train if k.camera == camera_name]
    stride = max(1, math.ceil(len(camera_keys) / _MAX_IMAGES))
    samples = []
    for key in camera_keys[::stride]:
        rgb = cv2.resize(source.load(key).rgb, size, interpolation=cv2.INTER_AREA)
        samples.append(rgb[rows, columns])
    if not samples:
        return None
    return (np.median(np.stack(samples), axis=0) / 255).astype(np.float32)


def _place(grid: Camera, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the rays through pixels of the grid, and the distance to the next point.

    Points: float64 [N, 3], the camera's frame. Distances: [N]. The points lie on a level surface
    below the camera, such as a roof, as far away as a car's width allows. Where a ray does not go
    down, its point lies on an upright surface."""
    x = (columns + 0.5 - grid.cx) / grid.fx
    y = (rows + 0.5 - grid.cy) / grid.fy
    far_m = float(np.clip(_HALF_WIDTH_M / max(np.abs(x).max(), 1e-6), _BODY_NEAR_M, _BODY_FAR_M))
    down = np.maximum(y, _MIN_SLOPE)
    depth = np.clip(far_m * down.min() / down, _BODY_NEAR_M, far_m)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return rays * depth[:, None], depth / min(grid.fx, grid.fy)


def _body_gaussians(
    points: np.ndarray, spacing: np.ndarray, colours: np.ndarray
) -> tuple[Gaussians, np.ndarray, tuple[float, float, float]]:
    """Return discs that face the camera, and the centre and size of the box around them.

    Discs: in the actor's frame. Centre: float64 [3], metres from the camera, along the actor's
    axes. Size: metres."""
    actor_points = points @ _ACTOR_FROM_CAMERA.T
    normals = actor_points / np.linalg.norm(actor_points, axis=1, keepdims=True)
    major = np.cross([0.0, 0.0, 1.0], normals)
    major /= np.linalg.norm(major, axis=1, keepdims=True)
    low = actor_points.min(axis=0) - _MARGIN_M
    high = actor_points.max(axis=0) + _MARGIN_M
    centre = (low + high) / 2
    surfels = Surfels.discs(actor_points - centre, normals, major, spacing)
    semantic = np.full(len(points), int(SemanticClass.OTHER), np.int16)
    length, width, height = (float(v) for v in high - low)
    return (
        gaussians_from_surfels(surfels, colours, semantic, _BODY_SHAPE),
        centre,
        (length, width, height),
    )


def _track(cameras: Sequence[Camera], centre: np.ndarray) -> Track:
    """Return the track of an actor that moves with the camera.

    Where several images have one time, the first one's pose counts."""
    rotation = torch.from_numpy(_ACTOR_FROM_CAMERA.T.copy())
    camera_from_actor = rigid(rotation, rotation @ torch.from_numpy(centre))
    poses = {}
    for camera in cameras:
        poses.setdefault(camera.timestamp_ns, camera.world_from_camera @ camera_from_actor)
    times = sorted(poses)
    return Track(
        torch.tensor(times, dtype=torch.int64), torch.stack([poses[time] for time in times])
    )
