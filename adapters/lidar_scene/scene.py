"""Sweeps, tracks and images into Gaussians, actors and sky: the same steps for any dataset."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from adapters.lidar_scene.actor_motion import indices_between
from adapters.lidar_scene.fill import bridge_gaps, fill_ground, fill_walls
from adapters.lidar_scene.image_views import Body, Seen, View, observe_views
from adapters.lidar_scene.kernels import SkyGatherer
from adapters.lidar_scene.split import ObjectTrack, PointSet, Sweep, is_flat, split_sweeps
from adapters.lidar_scene.surfels import (
    Surfels,
    borrow_colours,
    gaussians_from_surfels,
    surfels_from_points,
    thin_points,
)
from augment.cameras import Frame
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN, MOVED, SCATTERED
from augment.errors import AdapterError
from augment.ground import Ground, measure_from_classes
from augment.labels import LabelSource, LidarSweep
from augment.scene import Actor, Gaussians, Scene
from augment.sky import CubemapSky
from recipes.errors import nearest_word

# ---- scene ---------------------------------------------------------------------------------------

logger = logging.getLogger(__name__)

# An unseen surfel takes the colour of a seen one up to so many edges away; ground, which goes on
# under and behind what hides it, up to so many metres.
_BORROW_EDGES = 6.0
_BORROW_GROUND_M = 5.0
_FEWEST = 8  # points that surfaces are sought in
_TRIAL = 3.0  # voxels of the trial in units of those asked for
_REACHES_M = (8.0, 16.0)
_MIN_RETURNS = 200
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
            if len(z) >= _MIN_RETURNS:
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


# ------------------------------------------------------------------------------------------------
# What a drive's frames give to the scene that is built from its LiDAR, and the Scene itself

_ALL_ROWS: Mapping[str, float] = MappingProxyType({})


def views_of(
    frames: Iterable[Frame], used_rows: Mapping[str, float] = _ALL_ROWS
) -> tuple[View, ...]:
    """The recorded images of frames. used_rows: see View, by camera name; 1 for the others."""
    return tuple(
        View(frame.cameras[name], Path(path), frame.index, used_rows.get(name, 1.0))
        for frame in frames
        for name, path in frame.image_paths.items()
    )


def path_of(frames: Sequence[Frame]) -> DrivenPath:
    """Where the ego was in each frame."""
    return DrivenPath(
        np.stack([frame.world_from_ego[:3, 3].numpy() for frame in frames]),
        np.array([frame.timestamp_ns for frame in frames], np.int64),
    )


def without_points(tracks: Sequence[ObjectTrack], built: LidarScene) -> tuple[str, ...]:
    """A sentence for the moving objects of which nothing was measured, or that no image shows."""
    there = {actor.track_id for actor in built.actors}
    missing = [track.track_id for track in tracks if track.track_id not in there]
    if not missing:
        return ()
    return (
        f"{len(missing)} moving objects, such as {missing[0]!r}, have too few points in their "
        f"boxes or are in no image: they are not in the scene, their boxes stay in the labels",
    )


def scene_of(
    built: LidarScene,
    *,
    name: str,
    source: str,
    frames: tuple[Frame, ...],
    labels: LabelSource,
    world_origin_m: np.ndarray,
    problems: tuple[str, ...],
    has_metric_scale: bool = True,
) -> Scene:
    """The scene of what was built. problems: of reading; those of building follow them."""
    return Scene(
        name=name,
        source=source,
        background=built.background,
        actors=built.actors,
        sky=built.sky,
        frames=frames,
        labels=labels,
        world_origin_m=world_origin_m,
        ground_z_m=built.ground_z_m,
        ground=built.ground,
        has_metric_scale=has_metric_scale,
        problems=(*problems, *built.problems),
    )


# ------------------------------------------------------------------------------------------------
# What the URI of a raw drive may ask for, as in `pandaset:<path>?voxel_m=0.05&frames=0:10`

IMAGE_SCALES = (1.0, 0.5, 0.25, 0.125)  # the fractions a JPEG decodes to without a second resize


@dataclass(frozen=True)
class HeldOut:
    """Frame numbers `first`, `first + step`, ... below `stop` (None: to the end), as `range`."""

    first: int
    stop: int | None = None
    step: int = 1

    def holds(self, frame: int) -> bool:
        inside = frame >= self.first and (self.stop is None or frame < self.stop)
        return inside and (frame - self.first) % self.step == 0

    def __str__(self) -> str:
        return f"{self.first}:{'' if self.stop is None else self.stop}:{self.step}"


@dataclass(frozen=True)
class DriveFrames:
    """Frame numbers of a scene, ascending, and those of them that are held out."""

    numbers: tuple[int, ...]
    held_out: frozenset[int]
    problems: tuple[str, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """The numbers of the frames that the scene is built from."""
        return tuple(number for number in self.numbers if number not in self.held_out)


@dataclass(frozen=True)
class DriveOptions:
    """Options of one opening; a scene is a function of the files and of these.

    first_frame, stop_frame: frame numbers used, stop excluded; None for the sequence's end.
    voxel_m: edge of a voxel near the ego path, metres; it grows with the distance from it.
    max_gaussians: voxels are enlarged until the scene holds no more than about this many.
    image_scale: resolution that images are decoded at for colours and sky. sky_size: texels along
    an edge of the sky's cube map. held_out: frames whose images and sweeps the Gaussians, their
    colours and the sky are made without; they stay in the scene, with cameras, images and labels,
    and their boxes still make tracks.
    """

    first_frame: int = 0
    stop_frame: int | None = None
    voxel_m: float = 0.04
    max_gaussians: int = 500_000
    image_scale: float = 0.5
    sky_size: int = 768
    held_out: HeldOut | None = None

    @staticmethod
    def from_query(
        scheme: str, query: Mapping[str, str], own: Mapping[str, str] | None = None
    ) -> DriveOptions:
        """The options of a URI's query. scheme: for messages. own: keys that the scheme has besides
        and reads itself, with what their values may be.

        Raises:
            AdapterError: an unknown key, or a value of the wrong kind or out of range.
        """
        own = own or {}
        unknown = sorted(set(query) - set(_KEYS) - set(own))
        if unknown:
            kinds = {key: kind for key, (_, kind) in _KEYS.items()} | dict(own)
            allowed = "; ".join(f"{key}: {kind}" for key, kind in kinds.items())
            near = nearest_word(unknown[0], tuple(kinds))
            guess = "" if near is None else f"did you mean {near!r}? "
            raise AdapterError(
                f"{scheme}: unknown option {unknown[0]!r}; {guess}allowed are {allowed}"
            )
        fields: dict[str, Any] = {}
        for key, text in query.items():
            if key in own:
                continue
            parse, kind = _KEYS[key]
            try:
                fields |= parse(key, text)
            except ValueError:
                raise AdapterError(f"{scheme}: {key} must be {kind}; got {text!r}") from None
        return DriveOptions(**fields)

    def keeps(self, frame: int) -> bool:
        return frame >= self.first_frame and (self.stop_frame is None or frame < self.stop_frame)

    def select(self, numbers: Sequence[int], *, where: str) -> DriveFrames:
        """Which of the dataset's frames the scene has.

        numbers: the dataset's, ascending. where: the dataset, for messages.

        Raises:
            AdapterError: no frame is left, or all are held out.
        """
        kept = tuple(number for number in numbers if self.keeps(number))
        if not kept:
            stop = "" if self.stop_frame is None else self.stop_frame
            raise AdapterError(
                f"{where}: frames={self.first_frame}:{stop} selects none of the {len(numbers)} "
                f"frames ({numbers[0]} to {numbers[-1]})"
            )
        if self.held_out is None:
            return DriveFrames(kept, frozenset())
        held = frozenset(filter(self.held_out.holds, kept))
        if len(held) == len(kept):
            raise AdapterError(
                f"{where}: held_out={self.held_out} holds out all {len(kept)} frames ({kept[0]} to "
                f"{kept[-1]}); leave some to build the scene from, as 1::2 does"
            )
        problem = f"held_out={self.held_out} holds out none of frames {kept[0]} to {kept[-1]}"
        return DriveFrames(kept, held, () if held else (problem,))

    def scene_options(self, lidar_top_deg: float) -> LidarSceneOptions:
        """What building takes of these. lidar_top_deg: highest elevation the LiDAR looks at."""
        return LidarSceneOptions(
            voxel_m=self.voxel_m,
            max_gaussians=self.max_gaussians,
            image_scale=self.image_scale,
            sky_size=self.sky_size,
            lidar_top_deg=lidar_top_deg,
        )


def _frames(_: str, text: str) -> dict[str, Any]:
    first, colon, stop = text.partition(":")
    if not colon:
        raise ValueError(text)
    fields = {"first_frame": int(first or 0), "stop_frame": int(stop) if stop else None}
    if fields["first_frame"] < 0 or (stop and fields["stop_frame"] <= fields["first_frame"]):
        raise ValueError(text)
    return fields


def _held_out(key: str, text: str) -> dict[str, Any]:
    parts = text.split(":")
    if len(parts) not in (2, 3):
        raise ValueError(text)
    first, stop, step = (int(part) if part else None for part in (*parts, "")[:3])
    first, step = first or 0, 1 if step is None else step
    if first < 0 or step < 1 or (stop is not None and stop <= first):
        raise ValueError(text)
    return {key: HeldOut(first, stop, step)}


def _integer(low: int, high: int) -> Callable[[str, str], dict[str, Any]]:
    def parse(key: str, text: str) -> dict[str, Any]:
        if not low <= int(text) <= high:
            raise ValueError(text)
        return {key: int(text)}

    return parse


def _voxel(key: str, text: str) -> dict[str, Any]:
    value = float(text)
    if not (math.isfinite(value) and 0.01 <= value <= 2):
        raise ValueError(text)
    return {key: value}


def _scale(key: str, text: str) -> dict[str, Any]:
    if float(text) not in IMAGE_SCALES:
        raise ValueError(text)
    return {key: float(text)}


_KEYS: dict[str, tuple[Callable[[str, str], dict[str, Any]], str]] = {
    "frames": (_frames, "first:stop, frame numbers with stop excluded, either side may be empty"),
    "voxel_m": (_voxel, "a number of metres from 0.01 to 2"),
    "max_gaussians": (_integer(1_000, 20_000_000), "an integer from 1000 to 20000000"),
    "image_scale": (_scale, "one of 1, 0.5, 0.25, 0.125"),
    "sky_size": (_integer(8, 4096), "an integer from 8 to 4096"),
    "held_out": (
        _held_out,
        "first:stop:step, frame numbers with stop excluded, such as 1::2 for every other one",
    ),
}


# ---- Where a drive's world has its origin, so that float32 keeps its digits ----------------------

FAR_FROM_ORIGIN_M = 1000.0  # float32 still resolves a tenth of a millimetre there


def drive_origin(positions_m: np.ndarray) -> np.ndarray:
    """What to subtract from the dataset's coordinates, float64 [3].

    Zero for a drive near the dataset's origin; else whole metres near its start. positions_m:
    float64 [F, 3], where the car was.
    """
    far = np.linalg.norm(positions_m, axis=1).max() > FAR_FROM_ORIGIN_M
    return np.round(positions_m[0]) if far else np.zeros(3)


# ---- Weathered sweeps in the form in which datasets store theirs ---------------------------------


def stored_records(
    records: np.ndarray, columns: Sequence[str], sweep: LidarSweep, world_from_file: np.ndarray
) -> bytes:
    """Records float32 [N, C] of a file with a weathered sweep of them in their place.

    columns: x, y, z, intensity and others, in the file's order. Returns that did not move keep
    their coordinates to the bit; the others are carried back in float64, so that only float32's
    rounding is left: less than 0.01 mm within 100 m of the sensor.
    """
    out = records[sweep.columns[INDEX_COLUMN]]
    moved = np.flatnonzero(np.isin(sweep.columns[CODE_COLUMN], (MOVED, SCATTERED)))
    offsets = sweep.points_m[moved] - world_from_file[:3, 3]
    places = np.linalg.solve(world_from_file[:3, :3], offsets.T)
    for axis, name in enumerate("xyz"):
        out[moved, columns.index(name)] = places[axis]
    out[:, columns.index("intensity")] = sweep.columns["intensity"]
    return out.tobytes()
