"""Tracks of what moves in a nuScenes scene, from the boxes of its keyframes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.lidar.box_tracks import BoxSample, ObjectTrack, join_tracks
from adapters.nuscenes.frames import FrameFiles
from adapters.nuscenes.tables import Annotation, Sample, SceneTables, SensorFile

_MOVING = ("vehicle.moving", "pedestrian.moving", "cycle.with_rider")
_MOVED_M = 1.0  # an object that travels further than this moves whatever it is labelled


def read_tracks(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[ObjectTrack, ...]:
    """The moving objects around the given frames, in the scene's world.

    An object moves if any of its boxes in the whole scene says so, or if it travels. Boxes are
    those of the keyframes among the frames' times and of the next on either side, each at the time
    that the LiDAR met it; between them the Track interpolates.
    """
    moving = _moving(tables.samples)
    first, last = frames[0].sweep.timestamp_ns, frames[-1].sweep.timestamp_ns
    times = [sample.timestamp_ns for sample in tables.samples]
    start = max((i for i, time in enumerate(times) if time <= first), default=0)
    stop = min((i for i, time in enumerate(times) if time >= last), default=len(times) - 1)
    sweeps = {file.sample_token: file for file in tables.lidar if file.is_key_frame}
    return join_tracks(
        [
            _box_sample(
                box,
                number,
                _time_met(tables, box, sample, sweeps.get(sample.token)),
                world_origin_m,
            )
            for number, sample in enumerate(tables.samples)
            if start <= number <= stop
            for box in sample.annotations
            if box.instance in moving
        ]
    )


def _box_sample(
    box: Annotation, number: int, time_ns: int, world_origin_m: np.ndarray
) -> BoxSample:
    w, x, y, z = box.quat
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = box.center_m - world_origin_m
    return BoxSample(box.instance, None, box.category, number, time_ns, pose, box.size_m)


def _time_met(
    tables: SceneTables, box: Annotation, sample: Sample, sweep: SensorFile | None
) -> int:
    if sweep is None:
        return sample.timestamp_ns
    direction = (box.center_m - sweep.world_from_sensor[:3, 3]) @ sweep.world_from_ego[:3, :3]
    return sample.timestamp_ns - int(tables.turn.before_ns(direction[None])[0])


def _moving(samples: Sequence[Sample]) -> set[str]:
    positions: dict[str, list[np.ndarray]] = defaultdict(list)
    moving = set()
    for sample in samples:
        for box in sample.annotations:
            positions[box.instance].append(box.center_m[:2])
            if any(name in _MOVING for name in box.attributes):
                moving.add(box.instance)
    travelled = {
        instance
        for instance, places in positions.items()
        if np.hypot(*np.ptp(np.array(places), axis=0)) > _MOVED_M
    }
    return moving | travelled
