"""Gaussians, actors and sky of a raw drive: the same steps for any dataset.

The caller is `adapters.raw_drive`.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from adapters.lidar_scene.beyond_beams import close_above_beams
from adapters.lidar_scene.closing import close_parts
from adapters.lidar_scene.free_space import find_transient_returns
from adapters.lidar_scene.image_views import Body, View, observe_views, read_image
from adapters.lidar_scene.kernels import SkyGatherer
from adapters.lidar_scene.movers import follow_movers
from adapters.lidar_scene.split import (
    SKIN_M,
    ObjectTrack,
    PointSet,
    assign_returns,
    indices_between,
    is_flat,
    join_tracks,
    static_points,
)
from adapters.lidar_scene.surfels import (
    Surfels,
    borrow_colours,
    bridge_gaps,
    fill_ground,
    fill_walls,
    gaussians_from_surfels,
    levels_at,
    set_back,
    surfels_from_points,
    thin_points,
)
from adapters.raw_drive import BoxSample, DriveOptions, RawDrive, TimedBoxes
from adapters.world import join_gaussians
from augment.errors import AdapterError
from augment.photo.own_car import find_own_car_mask, moving_frames
from augment.scene.cameras import Frame
from augment.scene.ground import measure_from_classes
from augment.scene.scene import Actor, Gaussians, Ground, Scene

logger = logging.getLogger(__name__)

# An unseen surfel takes the colour of a seen one up to so many edges away; ground, which goes on
# under and behind what hides it, up to so many metres.
_BORROW_EDGES = 6.0
_BORROW_GROUND_M = 5.0
_MASK_SCALE = 0.25  # scale of the images in which the recording car is looked for
_MEASURED_PART = 0.9  # largest part of max_gaussians for measured points; the rest closes holes
_CLOSED_PART = 0.95  # the same with the splats that close holes; the rest is for upper storeys
_MIN_POINTS = 8  # fewest points that surfaces are sought in
_TRIAL = 3.0  # edge of the trial's voxels over that of the finest voxels
_REACHES_M = (8.0, 16.0)  # radii around the car in which its low height is sought, in turn
_MIN_RETURNS = 200  # fewest returns in such a radius that are trusted
_LOW_QUANTILE = 0.02  # quantile of heights that is low, yet not decided by a single stray return


def views_of(
    frames: Iterable[Frame], used_rows: Mapping[str, float] = MappingProxyType({})
) -> tuple[View, ...]:
    """Return the recorded images of frames.

    used_rows: fraction of usable rows by camera name, see View; 1 for other cameras.
    """
    return tuple(
        View(frame.cameras[name], Path(path), frame.index, used_rows.get(name, 1.0))
        for frame in frames
        for name, path in frame.image_paths.items()
    )


def with_own_car(views: Sequence[View]) -> tuple[View, ...]:
    """Return the images with their pixels of the recording car, if it moved enough to find them."""
    by_camera: dict[str, list[View]] = {}
    for view in views:
        by_camera.setdefault(view.camera.name, []).append(view)
    masks = {}
    for name, camera_views in by_camera.items():
        moving = [camera_views[i] for i in moving_frames([view.camera for view in camera_views])]
        images = [read_image(view.path, _MASK_SCALE) for view in moving]
        image_numbers = [i for i, image in enumerate(images) if image is not None]
        cameras = [moving[i].camera for i in image_numbers]
        masks[name] = find_own_car_mask(cameras, [images[i] for i in image_numbers])
    return tuple(
        dataclasses.replace(view, own_car=mask) if (mask := masks[view.camera.name]).any() else view
        for view in views
    )


def build_lidar_scene(
    drive: RawDrive,
    options: DriveOptions,
    *,
    added: Gaussians | None = None,
    ground: Ground | None = None,
) -> Scene:
    """Build a drive's scene: accumulate its returns, thin them, find surfaces, and colour them.

    Surfels that no image shows take the colour of a near observed one, or are left out. Points
    without neighbours are left out, and actors without Gaussians.

    Args:
        drive: the drive.
        options: options of the opening.
        added: Gaussians of the background from elsewhere.
        ground: the road; measured unless given. If none is found, ground_z_m is a low height.
    """
    path = np.stack([frame.world_from_ego[:3, 3].numpy() for frame in drive.frames])
    times_ns = np.array([frame.timestamp_ns for frame in drive.frames], np.int64)
    tracks = join_tracks(drive.boxes)
    still = _still_boxes(drive)
    is_static, actors = assign_returns(drive.sweeps, tracks)
    is_transient = find_transient_returns(drive.sweeps, is_static, still, path)
    is_static, movers = follow_movers(drive.sweeps, is_static, is_transient, still)
    background = static_points(drive.sweeps, is_static)
    tracks = (*tracks, *(mover.track for mover in movers))
    actors = (*actors, *(mover.points for mover in movers))
    if ground is None:
        ground = measure_from_classes(background.points, background.semantic, path)
    paths = [path, *(_path_in(track, path, times_ns) for track in tracks)]
    measured = options.max_gaussians * (1 if added else _MEASURED_PART)
    sampled = _sample_all([background, *actors], paths, options.voxel_m, int(measured))
    surfels = [surfels_from_points(p.points, e, semantic=p.semantic) for p, e in sampled]
    bodies = [Body(*pair) for pair in zip(surfels, [None, *tracks], strict=True)]
    sky = SkyGatherer(options.sky_size, math.radians(drive.lidar_top_deg))
    views = views_of(drive.used[:: drive.colour_every], drive.used_rows)
    views = with_own_car([v for v in views if v.camera.name not in drive.grey_cameras])
    body_colours, faults = observe_views(bodies, views, sky, image_scale=options.image_scale)
    eyes = np.stack([_eye(frame) for frame in drive.frames])
    eye_paths = [eyes, *(_path_in(track, eyes, times_ns) for track in tracks)]
    shifted = [
        set_back(body_surfels, sample[0].semantic, eye_path)
        for sample, body_surfels, eye_path in zip(sampled, surfels, eye_paths, strict=True)
    ]
    shifted[1:] = [
        _inside(body_surfels, track.size_m / 2 + SKIN_M)
        for body_surfels, track in zip(shifted[1:], tracks, strict=True)
    ]
    parts = [
        _gaussians(*sample, body_surfels, *colours)
        for sample, body_surfels, colours in zip(sampled, shifted, body_colours, strict=True)
    ]
    if added is not None:
        parts[0] = join_gaussians([parts[0], added])
    elif any(map(len, parts)):
        parts = close_parts(
            parts,
            tracks,
            still,
            views,
            sampled[0][0],
            max_gaussians=round(_CLOSED_PART * options.max_gaussians),
        )
        parts[0], sentences = close_above_beams(
            parts,
            tracks,
            views,
            sweeps=drive.sweeps,
            lidar_top_rad=math.radians(drive.lidar_top_deg),
            max_gaussians=options.max_gaussians,
            depth_option=options.depth,
        )
        faults = (*faults, *sentences)
    if not any(map(len, parts)):
        raise AdapterError(
            f"{drive.source}: none of the points that were measured is in any image; check that "
            f"calibration, sweeps and images are of one drive, that camera axes are x right, y "
            f"down, z forward, and that LiDAR and poses are in one world with z up"
        )
    return Scene(
        name=drive.name,
        source=drive.source,
        background=parts[0],
        actors=tuple(
            Actor(track.track_id, track.label, part, track.track, tuple(map(float, track.size_m)))
            for track, part in zip(tracks, parts[1:], strict=True)
            if len(part)
        ),
        sky=sky.finish(),
        frames=drive.frames,
        labels=drive.labels,
        world_origin_m=drive.world_origin_m,
        ground_z_m=low_height(background, path) if ground is None else ground.lowest_z_m,
        ground=ground,
        has_metric_scale=drive.has_metric_scale,
        problems=(*drive.problems, *faults),
    )


def _still_boxes(drive: RawDrive) -> list[BoxSample]:
    """Return one labelled box of each object that does not move."""
    boxes: dict[str, BoxSample | None] = {sample.object_id: None for sample in drive.boxes}
    for frame in drive.used:
        for sample, _ in TimedBoxes(
            frame.index, drive.labels.boxes(frame.index), frame.timestamp_ns
        ).samples(drive.world_origin_m):
            if sample is not None:
                boxes.setdefault(sample.object_id, sample)
    return [sample for sample in boxes.values() if sample is not None]


def without_points(tracks: Sequence[ObjectTrack], scene: Scene) -> tuple[str, ...]:
    """Return a sentence on moving objects without returns, or that no image shows."""
    track_ids = {actor.track_id for actor in scene.actors}
    missing = [track.track_id for track in tracks if track.track_id not in track_ids]
    if not missing:
        return ()
    return (
        f"{len(missing)} moving objects, such as {missing[0]!r}, have too few points in their "
        f"boxes or are in no image: they are not in the scene, their boxes stay in the labels",
    )


def low_height(points: PointSet, path: np.ndarray) -> float | None:
    """Return the lowest height under the path [P, 3] if no road was found, metres.

    It is a low quantile of the returns around each position. The reach widens until there are
    enough returns to trust: the nearest ones are of the recording car and spray.
    """
    widest = _REACHES_M[-1]
    low = path.min(axis=0) - widest
    high = path.max(axis=0) + widest
    near = points.points[indices_between(points.points, low, high)]
    heights = []
    for position in path:
        distance2 = ((near[:, :2] - position[:2]) ** 2).sum(1)
        for reach in _REACHES_M:
            z = near[distance2 < reach**2, 2]
            if len(z) >= _MIN_RETURNS:
                heights.append(float(np.quantile(z, _LOW_QUANTILE)))
                break
    return min(heights) if heights else None


def _sample_all(
    point_sets: Sequence[PointSet], paths: Sequence[np.ndarray], finest_m: float, max_points: int
) -> list[tuple[PointSet, np.ndarray]]:
    """Thin every point set and fill its gaps with one voxel size.

    The size is the smallest from finest_m on that gives max_points at most.

    Args:
        point_sets: the world first.
        paths: the driven path in each set's frame.
        finest_m: smallest voxel size.
        max_points: largest number of points.
    """

    levels = [
        levels_at(point_set.points, path) for point_set, path in zip(point_sets, paths, strict=True)
    ]

    def sample(voxel_m: float) -> tuple[list[tuple[PointSet, np.ndarray]], int]:
        sampled = [
            _sample(point_set, path, level, voxel_m, is_world=i == 0)
            for i, (point_set, path, level) in enumerate(
                zip(point_sets, paths, levels, strict=True)
            )
        ]
        count = sum(len(points) for points, _ in sampled)
        logger.info("%d surfels at a voxel of %.3f m", count, voxel_m)
        return sampled, count

    # A coarse trial tells what the fine one needs: on surfaces the count goes with the square.
    _, trial = sample(_TRIAL * finest_m)
    needed = 1.01 * _TRIAL * (trial / max_points) ** 0.5
    voxel_m = finest_m * max(1.0, needed)
    while True:
        sampled, count = sample(voxel_m)
        if count <= max_points:
            return sampled
        voxel_m *= max(1.02, (count / max_points) ** 0.55)


def _sample(
    points: PointSet, path: np.ndarray, level: np.ndarray, voxel_m: float, *, is_world: bool
) -> tuple[PointSet, np.ndarray]:
    thin, edges = thin_points(points, path, voxel_m=voxel_m, level=level)
    if len(thin) < _MIN_POINTS:
        return thin, edges
    surfels = surfels_from_points(thin.points, edges, semantic=thin.semantic)
    thin = PointSet(surfels.centres, thin.semantic)
    parts = [thin, bridge_gaps(thin, edges, surfels)]
    if is_world:
        parts += [fill_walls(thin, edges, surfels), fill_ground(thin, path, voxel_m=voxel_m)]
    return thin_points(PointSet.join(parts), path, voxel_m=voxel_m)


def _inside(surfels: Surfels, half_m: np.ndarray) -> Surfels:
    """Return the surfels with their centres moved into a box around the zero of their axes.

    half_m: float [3], half its sides.
    """
    return dataclasses.replace(
        surfels, centres=surfels.centres.clip(-half_m, half_m).astype(np.float32)
    )


def _eye(frame: Frame) -> np.ndarray:
    """Return the middle of the frame's cameras, float64 [3], or the car's place without any."""
    if not frame.cameras:
        return frame.world_from_ego[:3, 3].numpy()
    return np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)


def _path_in(track: ObjectTrack, path: np.ndarray, times_ns: np.ndarray) -> np.ndarray:
    """Return the path as seen from the moving object.

    It decides how finely the object is sampled.
    """
    present = track.motion.exists_at(times_ns)
    if not present.any():
        return np.full((1, 3), 1e3)
    return track.motion.into_actor(path[present], times_ns[present])


def _gaussians(
    points: PointSet,
    edges: np.ndarray,
    surfels: Surfels,
    colours: np.ndarray,
    is_observed: np.ndarray,
) -> Gaussians:
    reach = np.where(is_flat(points.semantic), np.float32(_BORROW_GROUND_M), _BORROW_EDGES * edges)
    colours, has_colour = borrow_colours(points.points, colours, is_observed, reach)
    keep = np.flatnonzero(has_colour & ~surfels.isolated)
    return gaussians_from_surfels(surfels.select(keep), colours[keep], points.semantic[keep])
