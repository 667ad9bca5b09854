"""The road's height in a scene, and how it is known: what a flood's level counts from.

`Scene.ground` where the adapter measured it or the URI says it; else measured here, from the first
of these that gives an answer:

    lidar labels   returns that the dataset's annotators called road
    road splats    the background's Gaussians of that class
    ransac         level planes through low points near the path: LiDAR's, else solid Gaussians
    ego path       where the car must have stood; the adapter's estimate, where it made one

All of it needs metres and a world that is level.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from weakref import WeakKeyDictionary

import numpy as np

from augment.errors import BackendUnavailable, SceneError
from augment.ground_heights import LEVEL_M, Ground, GroundSource, measure_ground
from augment.ground_plane import ground_points
from augment.labels import ClassifiesLidar
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass

logger = logging.getLogger(__name__)

ROAD_CLASSES = (SemanticClass.ROAD, SemanticClass.LANE_MARKING)
CAMERA_HEIGHT_M = 1.5  # a guess: on a car, cameras are 1.2 m to 2 m above the road
# Cameras this far above the ego origin stand on a car whose origin is on the road, or near it.
_EGO_ON_ROAD_M = 0.8
_SWEEP_EVERY_M, _FEWEST_SWEEPS, _MOST_SWEEPS = 20.0, 3, 24
_SOLID_OPACITY = 0.3  # fainter Gaussians are haze and leftovers of training
_MOST_POINTS = 600_000

_measured: WeakKeyDictionary[Scene, Ground] = WeakKeyDictionary()


def ground_of(scene: Scene) -> Ground:
    """The road's heights under the scene's path: the same numbers every time.

    A measurement is remembered for as long as the scene object lives. Sweeps are read from disk;
    a drive of 100 m takes a second or two.

    Raises:
        SceneError: the scene's unit or its vertical is not known (the message asks for both), or it
            has no frames and so no path.
    """
    check_metric_and_level(scene)
    if scene.ground is not None:
        return scene.ground
    ground = _measured.get(scene)
    if ground is None:
        ground = _measured[scene] = _measure(scene)
        logger.info("%s: %s", scene.name, ground_sentence(ground))
    return ground


def check_metric_and_level(scene: Scene) -> None:
    """Raises SceneError, which asks for both, where metres or gravity are not known."""
    unknown = [
        what
        for known, what in (
            (scene.has_known_gravity, "which way is up"),
            (scene.has_metric_scale, "how long a unit is"),
        )
        if not known
    ]
    if not unknown:
        return
    raise SceneError(
        f"scene {scene.name!r} ({scene.source}): its ground cannot be told without metres and "
        f"gravity; not known: {' and '.join(unknown)}. Give both: for a splat file as in "
        f"{_example(scene)}, where up is the file's axis that points up (or up=cameras, their "
        f"mean) and scale is metres per unit (scale=1 if it is in metres); for a recording, poses "
        f'in metres with z up, and no "has_metric_scale": false in calibration.json; for a scene '
        f"folder, fit it again from such a source"
    )


def _example(scene: Scene) -> str:
    """The scene's own URI with what it lacks, or one like it."""
    if not scene.source.startswith("gaussians:"):
        return "gaussians:PATH?up=-y&scale=0.35"
    lacks = ([] if scene.has_known_gravity else ["up=-y"]) + (
        [] if scene.has_metric_scale else ["scale=0.35"]
    )
    return scene.source + ("&" if "?" in scene.source else "?") + "&".join(lacks)


def ground_sentence(ground: Ground) -> str:
    """Heights, source and residual for people."""
    text = (
        f"lowest z = {ground.lowest_z_m:.2f} m, median {ground.median_z_m:.2f} m under the path; "
        f"{ground.source}"
    )
    if ground.points:
        text += f", {ground.points:,} points"
    if ground.residual_m is not None:
        text += f", residual {ground.residual_m * 100:.1f} cm"
    if ground.tilt_deg is not None:
        text += f", tilt {ground.tilt_deg:.1f} deg"
    return text


def measure_from_classes(
    points: np.ndarray, classes: np.ndarray, positions: np.ndarray
) -> Ground | None:
    """The ground from LiDAR points [N, 3] with SemanticClass values [N] (negative: no surface)
    along positions [P, 3], scene world: by their classes where those say road, else by planes.
    None where neither gives an answer.
    """
    road = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road, positions, "lidar labels")
    if ground is None:
        ground = _from_planes(points[classes >= 0], positions)
    return ground


def _measure(scene: Scene) -> Ground:
    if not scene.frames:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no frames, so no path to find the road "
            f"under; give camera_path=FILE, or ground_z=HEIGHT, in its URI"
        )
    positions = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in scene.frames])
    points, classes = _lidar(scene, positions)
    road = points[np.isin(classes, ROAD_CLASSES)]
    ground = measure_ground(road, positions, "lidar labels")
    if ground is None:
        ground = measure_ground(_road_splats(scene.background), positions, "road splats")
    if ground is None and len(points):
        ground = _from_planes(points[classes >= 0], positions)
    if ground is None:
        ground = _from_planes(_below_cameras(scene), positions, level_m=math.inf)
    return _from_path(scene, positions) if ground is None else ground


def _lidar(scene: Scene, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns [N, 3] of a handful of sweeps in the scene's world, and their classes int16 [N]."""
    points, classes = [np.zeros((0, 3))], [np.zeros(0, np.int16)]
    for index in _spread_frames(scene, positions):
        sweep = scene.lidar(index)
        if sweep is None:
            continue
        known = (
            scene.labels.lidar_classes(sweep) if isinstance(scene.labels, ClassifiesLidar) else None
        )
        world = sweep.points_m - scene.world_origin_m
        finite = np.isfinite(world).all(axis=1)
        points.append(world[finite])
        classes.append(
            np.full(int(finite.sum()), SemanticClass.UNKNOWN, np.int16)
            if known is None
            else known[finite]
        )
    return np.concatenate(points), np.concatenate(classes)


def _spread_frames(scene: Scene, positions: np.ndarray) -> Iterator[int]:
    """Numbers of frames spread over the drive, enough that their sweeps overlap."""
    length = float(np.hypot(*np.diff(positions[:, :2], axis=0).T).sum())
    count = min(_MOST_SWEEPS, _FEWEST_SWEEPS + int(length / _SWEEP_EVERY_M), len(scene.frames))
    for place in np.unique(np.linspace(0, len(scene.frames) - 1, count).round().astype(int)):
        yield scene.frames[place].index


def _road_splats(gaussians: Gaussians) -> np.ndarray:
    """Centres [N, 3] of the solid Gaussians of the road."""
    if gaussians.semantic is None:
        return np.zeros((0, 3))
    road = np.isin(gaussians.semantic.numpy(), ROAD_CLASSES)
    road &= gaussians.opacities.numpy() > _SOLID_OPACITY
    return gaussians.means.numpy()[road].astype(np.float64)


def _below_cameras(scene: Scene) -> np.ndarray:
    """Centres [N, 3] of solid Gaussians that are lower than the highest camera, thinned evenly."""
    gaussians = scene.background
    means = gaussians.means.numpy()
    keep = np.flatnonzero(gaussians.opacities.numpy() > _SOLID_OPACITY)
    tops = [float(c.centre[2]) for frame in scene.frames for c in frame.cameras.values()]
    if tops:
        keep = keep[means[keep, 2] < max(tops)]
    return means[keep[:: 1 + len(keep) // _MOST_POINTS]].astype(np.float64)


def _from_planes(
    points: np.ndarray, positions: np.ndarray, *, level_m: float = LEVEL_M
) -> Ground | None:
    """By open3d's planes; None, and a warning, where open3d cannot be had."""
    if len(points) == 0:
        return None
    try:
        found = ground_points(points[:: 1 + len(points) // _MOST_POINTS], positions)
    except BackendUnavailable as error:
        logger.warning("the road is not looked for among unlabelled points: %s", error)
        return None
    return measure_ground(found, positions, "ransac", level_m=level_m)


def _from_path(scene: Scene, positions: np.ndarray) -> Ground:
    """Without points: the adapter's estimate; else the ego origin, where cameras stand above it as
    on a car; else CAMERA_HEIGHT_M below the cameras' mean.
    """
    if scene.ground_z_m is not None:
        return Ground(scene.ground_z_m, scene.ground_z_m, "ego path")
    heights = positions[:, 2]
    cameras = np.array(
        [
            np.mean([float(camera.centre[2]) for camera in frame.cameras.values()])
            if frame.cameras
            else math.nan
            for frame in scene.frames
        ]
    )
    seen = np.isfinite(cameras)
    if seen.any() and np.median((cameras - heights)[seen]) < _EGO_ON_ROAD_M:
        heights = cameras[seen] - CAMERA_HEIGHT_M
    return Ground(float(heights.min()), float(np.median(heights)), "ego path")


__all__ = ["Ground", "GroundSource", "check_metric_and_level", "ground_of", "ground_sentence"]
