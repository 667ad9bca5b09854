"""A recording's boxes into timed samples of the objects that move."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from adapters.lidar.box_tracks import BoxSample
from adapters.recording.tables import TimedBoxes
from augment.cameras import Frame
from augment.geometry import rotmat_from_quat

MOVED_M = 1.0  # an object whose boxes lie further apart than this moves
# Attributes that say so themselves, as PandaSet's and the street's boxes do.
STATIONARY = ("stationary", "is_parked")
SIBLING = ("sibling_id", "cuboids.sibling_id")  # another sensor's box of the same object


@dataclass(frozen=True, eq=False)
class RecordedObjects:
    """moving: samples of the objects that move, in order of frames. still: one sample of each
    object that does not. problems: one sentence each."""

    moving: tuple[BoxSample, ...]
    still: tuple[BoxSample, ...]
    problems: tuple[str, ...]


def read_objects(
    frames: Sequence[Frame], boxes: Mapping[int, TimedBoxes], world_origin_m: np.ndarray
) -> RecordedObjects:
    """The objects of the frames. An object moves if an attribute says that it is not stationary or
    if its boxes lie further apart than MOVED_M; others stay part of the static world."""
    samples: list[BoxSample] = []
    labelled: set[str] = set()
    bad, twice = [], []
    for frame in frames:
        timed = boxes.get(frame.index)
        seen: set[str] = set()
        for sample, moves in [] if timed is None else _samples(frame, timed, world_origin_m):
            if sample is None:
                bad.append(frame.index)
            elif sample.object_id in seen:
                twice.append((sample.object_id, frame.index))
            else:
                seen.add(sample.object_id)
                samples.append(sample)
                labelled |= {sample.object_id} if moves else set()
    moving = _moving_ids(samples, labelled)
    still = {s.object_id: s for s in reversed(samples) if s.object_id not in moving}
    problems = []
    if bad:
        problems.append(
            f"labels/boxes.parquet: {len(bad)} boxes, the first in frame {bad[0]}, have a centre, "
            f"size or rotation that is not finite or zero; objects are built without them"
        )
    if twice:
        name, frame = twice[0]
        problems.append(
            f"labels/boxes.parquet: {len(twice)} boxes share track_id and frame with another, such "
            f"as {name!r} in frame {frame}; the first one counts"
        )
    return RecordedObjects(
        tuple(s for s in samples if s.object_id in moving),
        tuple(reversed(still.values())),
        tuple(problems),
    )


def _samples(frame: Frame, timed: TimedBoxes, world_origin_m: np.ndarray):
    """Each box as a sample, None where it is unusable, and whether it is labelled as moving."""
    boxes = timed.boxes
    times = timed.timestamps_ns
    values = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
    good = np.isfinite(values).all(1) & (boxes.sizes_m > 0).all(1)
    good &= np.linalg.norm(boxes.quats, axis=1) > 1e-6
    stationary = next((boxes.attributes[n] for n in STATIONARY if n in boxes.attributes), None)
    siblings = next((boxes.attributes[n] for n in SIBLING if n in boxes.attributes), None)
    for i in range(len(boxes)):
        if not good[i]:
            yield None, False
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotmat_from_quat(torch.from_numpy(boxes.quats[i])).numpy()
        pose[:3, 3] = boxes.centers_m[i] - world_origin_m
        sibling = None if siblings is None else siblings[i]
        sample = BoxSample(
            boxes.track_ids[i],
            sibling if isinstance(sibling, str) and sibling not in ("", "-") else None,
            boxes.labels[i],
            frame.index,
            frame.timestamp_ns if times is None else int(times[i]),
            pose,
            boxes.sizes_m[i],
        )
        yield sample, stationary is not None and _is_false(stationary[i])


def _is_false(value: object) -> bool:
    """False or 0; a missing value says nothing."""
    return isinstance(value, bool | int | np.bool_ | np.integer) and not value


def _moving_ids(samples: Sequence[BoxSample], labelled: set[str]) -> set[str]:
    places: dict[str, list[np.ndarray]] = defaultdict(list)
    for sample in samples:
        places[sample.object_id].append(sample.world_from_box[:2, 3])
    extents = {name: np.ptp(np.array(xy), axis=0) for name, xy in places.items()}
    return labelled | {name for name, extent in extents.items() if np.hypot(*extent) > MOVED_M}
