"""Boxes of moving objects over time, joined into tracks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from adapters.lidar.actor_motion import Motion
from augment.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.scene import Track

_MERGE_NS = 1_000_000  # two boxes of one object this close in time are one sample


@dataclass(frozen=True, eq=False)
class BoxSample:
    """One box of a moving object: where it stood at one moment.

    object_id: the dataset's name of the object. sibling_id: the name that another sensor's box of
    the same object goes by, or None. frame: the dataset's frame number. world_from_box: float64
    [4, 4] in the scene's world, box x forward. size_m: length, width, height.
    """

    object_id: str
    sibling_id: str | None
    label: str
    frame: int
    timestamp_ns: int
    world_from_box: np.ndarray
    size_m: np.ndarray


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """One moving object. member_ids: every name its boxes go by, its track_id first. motion: the
    track again, for moving points."""

    track_id: str
    member_ids: tuple[str, ...]
    label: str
    track: Track
    motion: Motion
    size_m: np.ndarray


def join_tracks(samples: Sequence[BoxSample]) -> tuple[ObjectTrack, ...]:
    """One track an object, siblings taken together, in order of first appearance.

    The boxes that one frame holds of an object (one a sensor, each at its sensor's own moment)
    become one sample at the mean time with the mean pose: on a straight path at constant speed
    that lies on the path, and it keeps centimetres of disagreement from becoming jerks.
    """
    names = _unite(samples)
    groups: dict[str, list[BoxSample]] = defaultdict(list)
    for sample in samples:
        groups[names[sample.object_id]].append(sample)
    return tuple(_join(name, group) for name, group in groups.items())


def _unite(samples: Sequence[BoxSample]) -> dict[str, str]:
    """Every object's name to the name of its group: that of its first box."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while parent.setdefault(name, name) != name:
            name = parent[name]
        return name

    order = {name: i for i, name in reversed(list(enumerate(s.object_id for s in samples)))}
    for sample in samples:
        # A sibling that has no box in these frames names nothing.
        if sample.sibling_id in order:
            a, b = root(sample.object_id), root(sample.sibling_id)
            first, second = sorted((a, b), key=order.__getitem__)
            parent[second] = first
    return {name: root(name) for name in order}


def _join(name: str, group: list[BoxSample]) -> ObjectTrack:
    by_frame: dict[int, list[BoxSample]] = defaultdict(list)
    for sample in group:
        by_frame[sample.frame].append(sample)
    merged = sorted(
        (_mean_pose(boxes) for boxes in by_frame.values()), key=lambda sample: sample[0]
    )
    kept = [merged[0]]
    for time, pose in merged[1:]:
        if time - kept[-1][0] >= _MERGE_NS:
            kept.append((time, pose))
    members = dict.fromkeys([name, *(s.object_id for s in group)])
    track = Track(
        torch.tensor([time for time, _ in kept], dtype=torch.int64),
        torch.stack([pose for _, pose in kept]),
    )
    return ObjectTrack(
        track_id=name,
        member_ids=tuple(members),
        label=group[0].label,
        track=track,
        motion=Motion.of(track),
        size_m=np.mean([s.size_m for s in group], axis=0),
    )


def _mean_pose(boxes: list[BoxSample]) -> tuple[int, torch.Tensor]:
    time = sum(b.timestamp_ns - boxes[0].timestamp_ns for b in boxes) // len(boxes)
    poses = torch.from_numpy(np.stack([b.world_from_box for b in boxes]))
    quats = quat_from_rotmat(poses[:, :3, :3])
    quats = quats * torch.where((quats * quats[:1]).sum(1, keepdim=True) < 0, -1.0, 1.0)
    rotation = rotmat_from_quat(quats.mean(0))
    return time + boxes[0].timestamp_ns, rigid(rotation, poses[:, :3, 3].mean(0))
