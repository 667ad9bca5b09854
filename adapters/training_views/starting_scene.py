"""Starting point of reconstruction: the scene of a recording, completed where LiDAR sees
nothing.

Walls and crowns continue above the LiDAR's view, and behind glass, as in raw scenes
(`adapters.lidar_scene.beyond_beams`). Otherwise they would be learnt into the sky, where fog
swallows them.

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

import cv2
import numpy as np
import torch

from adapters.lidar_scene.beyond_beams import add_surfaces_beyond_beams
from adapters.lidar_scene.solid_views import WORK_WIDTH, SolidView, make_solid_view
from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels
from adapters.training_views.views import RecordedViews
from augment.photo.lidar_view import find_returns
from augment.photo.own_car import spread_evenly
from augment.photo.sky_matte import sky_matte
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.labels import EGO_VEHICLE
from augment.scene.scene import Actor, Gaussians, PosedGaussians, Scene, Track
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

_MAX_WALL_IMAGES = 48  # in which surfaces beyond the LiDAR's view are added
_MAX_WALL_SPLATS = 60_000  # that are added there, over all images

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
    """Return the background with discs where training views show neither sky nor a surface."""
    background = scene.background
    if views.lidar_top_rad is None or background.semantic is None:
        return background
    solid_views = [
        solid_view
        for key in spread_evenly(views.train, _MAX_WALL_IMAGES)
        if (solid_view := _solid_view(scene, views, key)) is not None
    ]

    def pose_parts(background: Gaussians, camera: Camera) -> Sequence[PosedGaussians]:
        return dataclasses.replace(scene, background=background).parts_for(camera)

    return add_surfaces_beyond_beams(
        background,
        solid_views,
        pose_parts,
        lidar_top_rad=views.lidar_top_rad,
        max_added=_MAX_WALL_SPLATS,
    )


def _solid_view(scene: Scene, views: RecordedViews, key: ViewKey) -> SolidView | None:
    """Return a training view with its sky, or None if it is too dark to tell."""
    full_camera = views.camera(key)
    camera = full_camera.scaled(min(1.0, WORK_WIDTH / full_camera.width))
    size = (camera.width, camera.height)
    rgb = cv2.resize(views.image(key), size, interpolation=cv2.INTER_AREA)
    matte = sky_matte(scene, camera, rgb)
    if matte is None:
        return None
    own_car = views.own_car(key).astype(np.float32)
    excluded = cv2.resize(own_car, size, interpolation=cv2.INTER_AREA) > 0
    boxes = [
        (pose.numpy(), np.array(actor.size_m))
        for actor in scene.actors
        if (pose := actor.track.pose_at(camera.timestamp_ns)) is not None
    ]
    has_point = find_returns(scene.background.means.numpy(), camera)
    return make_solid_view(key, camera, rgb, matte, excluded, boxes, has_point)


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
