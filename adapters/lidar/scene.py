"""Sweeps, tracks and images into Gaussians, actors and sky: the same steps for any dataset."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.lidar.actor_motion import indices_between
from adapters.lidar.box_tracks import ObjectTrack
from adapters.lidar.bridges import bridge_gaps
from adapters.lidar.ground_fill import fill_ground
from adapters.lidar.image_views import Body, Seen, View, observe_views
from adapters.lidar.initialise import borrow_colours, gaussians_from_surfels
from adapters.lidar.sky import SkyGatherer
from adapters.lidar.split import PointSet, Sweep, is_flat, split_sweeps
from adapters.lidar.surfels import Surfels, surfels_from_points
from adapters.lidar.voxels import thin_points
from adapters.lidar.wall_fill import fill_walls
from augment.ground import Ground, measure_from_classes
from augment.scene import Actor, Gaussians
from augment.sky import CubemapSky

logger = logging.getLogger(__name__)

# An unseen surfel takes the colour of a seen one up to so many edges away; ground, which goes on
# under and behind what hides it, up to so many metres.
_BORROW_EDGES = 6.0
_BORROW_GROUND_M = 5.0
_FEWEST = 8  # points that surfaces are sought in
_TRIAL = 3.0  # voxels of the trial in units of those asked for
_REACHES_M = (8.0, 16.0)
_FEWEST_RETURNS = 200
_LOW_QUANTILE = 0.02  # a low height that a single stray return does not decide


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """Where the sensors were. positions: float64 [P, 3], scene world. timestamps_ns: int64 [P]."""

    positions: np.ndarray
    timestamps_ns: np.ndarray


@dataclass(frozen=True)
class LidarSceneOptions:
    """voxel_m: edge of a voxel near the path. max_gaussians: voxels grow until no more are needed.
    image_scale: 1, 1/2, 1/4 or 1/8. sky_size: texels along a cube edge. lidar_top_deg: highest
    elevation that the LiDAR looks at.
    """

    voxel_m: float = 0.04
    max_gaussians: int = 500_000
    image_scale: float = 0.5
    sky_size: int = 768
    lidar_top_deg: float = 15.0


@dataclass(frozen=True, eq=False)
class LidarScene:
    """What the recordings give before any optimisation; problems one sentence each.

    ground_z_m: the lowest of the ground where that was found, else a low height.
    """

    background: Gaussians
    actors: tuple[Actor, ...]
    sky: CubemapSky
    ground_z_m: float | None
    ground: Ground | None
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
    ground = measure_from_classes(background.points, background.semantic, path.positions)
    things = _sample_all([background, *actors], [None, *tracks], path, options)
    thinned = [(t, e, surfels_from_points(t.points, e, semantic=t.semantic)) for t, e in things]
    bodies = [
        Body(surfels, track)
        for (_, _, surfels), track in zip(thinned, [None, *tracks], strict=True)
    ]
    gatherer = SkyGatherer(options.sky_size, math.radians(options.lidar_top_deg))
    seen, problems = observe_views(bodies, views, gatherer, image_scale=options.image_scale)
    gaussians = [
        _finish(points, edges, surfels, colours)
        for (points, edges, surfels), colours in zip(thinned, seen, strict=True)
    ]
    return LidarScene(
        background=gaussians[0],
        actors=_actors(tracks, gaussians[1:]),
        sky=gatherer.finish(),
        ground_z_m=low_height(background, path.positions) if ground is None else ground.lowest_z_m,
        ground=ground,
        problems=problems,
    )


def low_height(points: PointSet, path: np.ndarray) -> float | None:
    """The lowest height under the path where no road was found, metres in the world of the points.

    At each position of the path (float [P, 3]) it is a low quantile of the returns there. The reach
    widens until there are enough to trust: what is nearest is the recording car and spray.
    """
    widest = _REACHES_M[-1]
    low, high = path.min(axis=0) - widest, path.max(axis=0) + widest
    near = points.points[indices_between(points.points, low, high)]
    heights = []
    for position in path:
        distance2 = ((near[:, :2] - position[:2]) ** 2).sum(1)
        for reach in _REACHES_M:
            z = near[distance2 < reach**2, 2]
            if len(z) >= _FEWEST_RETURNS:
                heights.append(float(np.quantile(z, _LOW_QUANTILE)))
                break
    return min(heights) if heights else None


def _sample_all(
    things: Sequence[PointSet],
    tracks: Sequence[ObjectTrack | None],
    path: DrivenPath,
    options: LidarSceneOptions,
) -> list[tuple[PointSet, np.ndarray]]:
    """Every thing thinned and its gaps filled with one voxel size, the smallest that respects
    max_gaussians."""
    paths = [_path_in(track, path) for track in tracks]

    def sample(voxel_m: float) -> list[tuple[PointSet, np.ndarray]]:
        sampled = [
            _sample(thing, p, voxel_m, is_world=track is None)
            for thing, p, track in zip(things, paths, tracks, strict=True)
        ]
        logger.info("%d surfels at a voxel of %.3f m", _count(sampled), voxel_m)
        return sampled

    # A coarse trial tells what the fine one needs: on surfaces the count goes with the square.
    trial = _count(sample(_TRIAL * options.voxel_m))
    needed = 1.01 * _TRIAL * (trial / options.max_gaussians) ** 0.5
    voxel_m = options.voxel_m * max(1.0, needed)
    while _count(sampled := sample(voxel_m)) > options.max_gaussians:
        voxel_m *= max(1.02, (_count(sampled) / options.max_gaussians) ** 0.55)
    return sampled


def _count(sampled: Sequence[tuple[PointSet, np.ndarray]]) -> int:
    return sum(len(points) for points, _ in sampled)


def _sample(
    thing: PointSet, path: np.ndarray, voxel_m: float, *, is_world: bool
) -> tuple[PointSet, np.ndarray]:
    thin, edges = thin_points(thing, path, voxel_m=voxel_m)
    if len(thin) < _FEWEST:
        return thin, edges
    surfels = surfels_from_points(thin.points, edges, semantic=thin.semantic)
    parts = [thin, bridge_gaps(thin, edges, surfels)]
    if is_world:
        parts += [fill_walls(thin, edges, surfels), fill_ground(thin, path, voxel_m=voxel_m)]
    return thin_points(PointSet.join(parts), path, voxel_m=voxel_m)


def _path_in(track: ObjectTrack | None, path: DrivenPath) -> np.ndarray:
    """The path as seen from the moving object, which decides how finely it needs to be sampled."""
    if track is None:
        return path.positions
    present = track.motion.exists_at(path.timestamps_ns)
    if not present.any():
        return np.full((1, 3), 1e3)
    return track.motion.into_actor(path.positions[present], path.timestamps_ns[present])


def _finish(points: PointSet, edges: np.ndarray, surfels: Surfels, seen: Seen) -> Gaussians:
    reach = np.where(is_flat(points.semantic), np.float32(_BORROW_GROUND_M), _BORROW_EDGES * edges)
    colours, known = borrow_colours(points.points, seen.colours, seen.seen, reach)
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
