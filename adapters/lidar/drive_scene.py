"""What a drive's frames give to the scene that is built from its LiDAR, and the Scene itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from adapters.lidar.box_tracks import ObjectTrack
from adapters.lidar.image_views import View
from adapters.lidar.scene import DrivenPath, LidarScene
from augment.cameras import Frame
from augment.labels import LabelSource
from augment.scene import Scene

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
