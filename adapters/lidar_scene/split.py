"""Sweeps taken apart: the static world, and every moving object in its own frame."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from adapters.lidar_scene.actor_motion import Motion, indices_between, inside_box
from augment.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.scene import Track
from augment.semantics import SemanticClass

# ---- Boxes of moving objects over time, joined into tracks ---------------------------------------

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


# ---- split ---------------------------------------------------------------------------------------

# A moving object's returns stray from its box by timing and labelling: within this of the box a
# return is not static world, and within the smaller margin it is the object's own surface.
HALO_M = 0.35
SKIN_M = 0.1
# Without classes, returns this near the bottom of a box may be road or tyre: neither gets them.
FLOOR_M = 0.15
_FLAT = np.array(
    [SemanticClass.ROAD, SemanticClass.LANE_MARKING, SemanticClass.SIDEWALK, SemanticClass.TERRAIN],
    dtype=np.int16,
)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The usable returns of one frame in the scene's world.

    points: float32 [N, 3]. timestamps_ns: int64 [N]. semantic: int16 [N], SemanticClass values.
    """

    points: np.ndarray
    timestamps_ns: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of one rigid thing. points: float32 [N, 3] in its frame. semantic: int16 [N]."""

    points: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def join(parts: Sequence[PointSet]) -> PointSet:
        return PointSet(
            np.concatenate([p.points for p in parts]), np.concatenate([p.semantic for p in parts])
        )


def is_flat(semantic: np.ndarray) -> np.ndarray:
    """Whether each class is ground that is driven or walked on, bool [N]."""
    return np.isin(semantic, _FLAT)


def split_sweeps(
    sweeps: Sequence[Sweep], tracks: Sequence[ObjectTrack]
) -> tuple[PointSet, tuple[PointSet, ...]]:
    """The static world, and one set a track in the actor's frame.

    Each return is compared with every box as it stood at the return's own time. Ground inside a
    box is ground; where classes are unknown the lowest FLOOR_M of a box is given to nobody.
    """
    static_points, static_semantic = [], []
    actors: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in tracks]
    for sweep in sweeps:
        static = np.ones(len(sweep), dtype=bool)
        for track, (points, semantic) in zip(tracks, actors, strict=True):
            near = _candidates(sweep, track)
            local = track.motion.into_actor(sweep.points[near], sweep.timestamps_ns[near])
            classes = sweep.semantic[near]
            ground = is_flat(classes)
            halo = inside_box(local, track.size_m, HALO_M) & ~ground
            low = local[:, 2] < FLOOR_M - track.size_m[2] / 2
            own = inside_box(local, track.size_m, SKIN_M) & ~ground
            own &= ~(low & (classes == SemanticClass.UNKNOWN))
            static[near[halo]] = False
            points.append(local[own].astype(np.float32))
            semantic.append(classes[own])
        static_points.append(sweep.points[static])
        static_semantic.append(sweep.semantic[static])
    background = _concatenate(static_points, static_semantic)
    return background, tuple(_concatenate(p, s) for p, s in actors)


def _candidates(sweep: Sweep, track: ObjectTrack) -> np.ndarray:
    """Indices of the returns that could lie in the object's box at their own time."""
    if len(sweep) == 0:
        return np.zeros(0, dtype=np.int64)
    times = sweep.timestamps_ns
    low, high = track.motion.span(int(times.min()), int(times.max()))
    reach = float(np.linalg.norm(track.size_m)) / 2 + HALO_M
    near = indices_between(sweep.points, low - reach, high + reach)
    return near[track.motion.exists_at(times[near])]


def _concatenate(points: list[np.ndarray], semantic: list[np.ndarray]) -> PointSet:
    if not points:
        return PointSet(np.zeros((0, 3), np.float32), np.zeros(0, np.int16))
    return PointSet(np.concatenate(points), np.concatenate(semantic))
