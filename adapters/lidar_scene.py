"""Sweeps, tracks and images into Gaussians, actors and sky: the same steps for any dataset."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.box_tracks import ObjectTrack
from adapters.image_views import Body, Seen, View, observe_views
from adapters.lidar_init import borrow_colours, gaussians_from_surfels
from adapters.lidar_split import PointSet, Sweep, split_sweeps
from adapters.lidar_surfels import Surfels, surfels_from_points
from adapters.lidar_voxels import thin_points
from adapters.sky_from_images import SkyGatherer
from augment.scene import Actor, Gaussians
from augment.semantics import SemanticClass
from augment.sky import CubemapSky

logger = logging.getLogger(__name__)

_BORROW_EDGES = 3.0  # an unseen surfel takes the colour of a seen one up to so many edges away
_ROAD_REACH_M = 4.0
_LOW_QUANTILE = 0.02  # a low height that a single stray return does not decide


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """Where the sensors were. positions: float64 [P, 3], scene world. timestamps_ns: int64 [P]."""

    positions: np.ndarray
    timestamps_ns: np.ndarray


@dataclass(frozen=True)
class LidarSceneOptions:
    """voxel_m: edge of a voxel near the path. max_gaussians: voxels grow until no more are needed.
    image_scale: 1, 1/2, 1/4 or 1/8. sky_size: texels along a cube edge. progress: bars on stderr.
    """

    voxel_m: float = 0.04
    max_gaussians: int = 400_000
    image_scale: float = 0.5
    sky_size: int = 768
    progress: bool = False


@dataclass(frozen=True, eq=False)
class LidarScene:
    """What the recordings give before any optimisation; problems one sentence each."""

    background: Gaussians
    actors: tuple[Actor, ...]
    sky: CubemapSky
    ground_z_m: float | None
    problems: tuple[str, ...]


def build_lidar_scene(
    sweeps: Sequence[Sweep],
    tracks: Sequence[ObjectTrack],
    views: Sequence[View],
    path: DrivenPath,
    options: LidarSceneOptions,
) -> LidarScene:
    """Accumulate, thin, find surfaces, colour from images, and turn into Gaussians.

    Surfels that no image shows take the colour of a near seen one, or are left out; so are points
    without neighbours, and actors of which nothing is left.
    """
    background, actors = split_sweeps(sweeps, tracks)
    ground_z_m = road_height(background, path.positions)
    things = _thin_all([background, *actors], [None, *tracks], path, options)
    thinned = [(t, e, surfels_from_points(t.points, e)) for t, e in things]
    bodies = [
        Body(surfels, track)
        for (_, _, surfels), track in zip(thinned, [None, *tracks], strict=True)
    ]
    gatherer = SkyGatherer(options.sky_size)
    seen, problems = observe_views(
        bodies, views, gatherer, image_scale=options.image_scale, progress=options.progress
    )
    gaussians = [
        _finish(points, edges, surfels, colours)
        for (points, edges, surfels), colours in zip(thinned, seen, strict=True)
    ]
    return LidarScene(
        background=gaussians[0],
        actors=_actors(tracks, gaussians[1:]),
        sky=gatherer.finish(),
        ground_z_m=ground_z_m,
        problems=problems,
    )


def road_height(points: PointSet, path: np.ndarray) -> float | None:
    """The lowest height of the road under the path, metres in the world of the points.

    At each position of the path (float [P, 3]) the height is the median of road returns within
    _ROAD_REACH_M, or, where no class says road, a low quantile of all returns there.
    """
    road = np.isin(points.semantic, (SemanticClass.ROAD, SemanticClass.LANE_MARKING))
    heights = _heights(points.points[road], path, 0.5)
    if not heights:
        heights = _heights(points.points, path, _LOW_QUANTILE)
    return min(heights) if heights else None


def _heights(points: np.ndarray, path: np.ndarray, quantile: float) -> list[float]:
    near = ((points[:, :2] > path[:, :2].min(0) - _ROAD_REACH_M).all(1)) & (
        (points[:, :2] < path[:, :2].max(0) + _ROAD_REACH_M).all(1)
    )
    points = points[near]
    heights = []
    for position in path:
        distance2 = ((points[:, :2] - position[:2]) ** 2).sum(1)
        z = points[distance2 < _ROAD_REACH_M**2, 2]
        if len(z):
            heights.append(float(np.quantile(z, quantile)))
    return heights


def _thin_all(
    things: Sequence[PointSet],
    tracks: Sequence[ObjectTrack | None],
    path: DrivenPath,
    options: LidarSceneOptions,
) -> list[tuple[PointSet, np.ndarray]]:
    """Every thing thinned with one voxel size, the smallest that respects max_gaussians."""
    paths = [_path_in(track, path) for track in tracks]
    voxel_m = options.voxel_m
    while True:
        thinned = [
            thin_points(thing, p, voxel_m=voxel_m) for thing, p in zip(things, paths, strict=True)
        ]
        count = sum(len(points) for points, _ in thinned)
        if count <= options.max_gaussians:
            logger.info("%d surfels at a voxel of %.3f m", count, voxel_m)
            return thinned
        # Surfaces: the count falls with the square of the edge, sparse parts more slowly.
        voxel_m *= max(1.02, (count / options.max_gaussians) ** 0.5)


def _path_in(track: ObjectTrack | None, path: DrivenPath) -> np.ndarray:
    """The path as seen from the moving object, which decides how finely it needs to be sampled."""
    if track is None:
        return path.positions
    present = track.motion.exists_at(path.timestamps_ns)
    if not present.any():
        return np.full((1, 3), 1e3)
    return track.motion.into_actor(path.positions[present], path.timestamps_ns[present])


def _finish(points: PointSet, edges: np.ndarray, surfels: Surfels, seen: Seen) -> Gaussians:
    colours, known = borrow_colours(
        points.points, seen.colours, seen.seen, edges * np.float32(_BORROW_EDGES)
    )
    keep = np.flatnonzero(known & ~surfels.isolated)
    return gaussians_from_surfels(surfels.select(keep), colours[keep], points.semantic[keep])


def _actors(tracks: Sequence[ObjectTrack], gaussians: Sequence[Gaussians]) -> tuple[Actor, ...]:
    return tuple(
        Actor(
            track_id=track.track_id,
            label=track.label,
            gaussians=g,
            track=track.track,
            size_m=(float(track.size_m[0]), float(track.size_m[1]), float(track.size_m[2])),
        )
        for track, g in zip(tracks, gaussians, strict=True)
        if len(g)
    )
