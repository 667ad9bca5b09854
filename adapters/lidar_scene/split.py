"""Separation of sweeps into the static world and every moving object in its own frame.

The callers are `adapters.lidar_scene.scene` and the adapters of datasets.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from adapters.raw_drive import BoxSample, Sweep
from augment.render.cpu.jit import cached_njit
from augment.scene.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.scene.scene import Track
from augment.scene.semantics import SemanticClass

_MERGE_NS = 1_000_000  # two boxes of one object this close in time are one sample
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
class Motion:
    """A track as arrays, which carry points along it, each at its own time.

    Compiled `Track.pose_at`.

    Attributes:
        knots_ns: int64 [T].
        quats: float64 [T, 4], wxyz.
        centres: float64 [T, 3].
    """

    knots_ns: np.ndarray
    quats: np.ndarray
    centres: np.ndarray
    hold_ns: int

    @staticmethod
    def of(track: Track) -> Motion:
        poses = track.world_from_actor
        return Motion(
            knots_ns=track.timestamps_ns.numpy(),
            quats=quat_from_rotmat(poses[:, :3, :3]).numpy(),
            centres=np.ascontiguousarray(poses[:, :3, 3].numpy()),
            hold_ns=track.hold_ns,
        )

    def exists_at(self, timestamps_ns: np.ndarray) -> np.ndarray:
        """Return True for times at which the actor exists, bool [N]."""
        first = self.knots_ns[0] - self.hold_ns
        last = self.knots_ns[-1] + self.hold_ns
        return (timestamps_ns >= first) & (timestamps_ns <= last)

    def pose_at(self, timestamp_ns: int) -> np.ndarray | None:
        """Return world_from_actor, float64 [4, 4], or None if the actor does not exist then."""
        if not self.exists_at(np.array([timestamp_ns]))[0]:
            return None
        pose = np.eye(4)
        _pose(self.knots_ns, self.quats, self.centres, timestamp_ns, pose)
        return pose

    def into_actor(self, points: np.ndarray, timestamps_ns: np.ndarray) -> np.ndarray:
        """Return world points [N, 3], each seen at its own time, in the actor's frame, float64
        [N, 3].

        Callers leave out times at which the actor does not exist.
        """
        out = np.empty((len(points), 3))
        _into(self.knots_ns, self.quats, self.centres, points, timestamps_ns, out)
        return out

    def near(self, points: np.ndarray, timestamps_ns: np.ndarray, size_m: np.ndarray) -> np.ndarray:
        """Return the indices of world points [N, 3] near the actor's box, int64, ascending.

        These points could lie in the box of that size, or within HALO_M of it, at their own times.
        """
        if len(points) == 0:
            return np.zeros(0, dtype=np.int64)
        low, high = self.span(int(timestamps_ns.min()), int(timestamps_ns.max()))
        reach = float(np.linalg.norm(size_m)) / 2 + HALO_M
        index = indices_between(points, low - reach, high + reach)
        return index[self.exists_at(timestamps_ns[index])]

    def span(self, first_ns: int, last_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest coordinates of the centre over a time span, two float64
        [3].
        """
        # Every pose in the span lies between the knots just before and just after it.
        low = max(0, int(np.searchsorted(self.knots_ns, first_ns, side="right")) - 1)
        high = min(len(self.knots_ns) - 1, int(np.searchsorted(self.knots_ns, last_ns)))
        centres = self.centres[low : high + 1]
        return centres.min(axis=0), centres.max(axis=0)


def inside_box(local: np.ndarray, size_m: np.ndarray, margin_m: float) -> np.ndarray:
    """Return True for points (in the box's frame) in the box grown by margin_m, bool [N]."""
    return (np.abs(local) <= size_m / 2 + margin_m).all(axis=1)


def indices_between(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the indices of points [N, 3] strictly inside an axis-aligned box, int64, ascending."""
    # One pass without masks: this runs once a box and sweep.
    return _indices_between(points, low.astype(np.float64), high.astype(np.float64))


@cached_njit(nogil=True)
def _indices_between(points, low, high):  # pragma: no cover - compiled
    out = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        if (
            low[0] < points[i, 0] < high[0]
            and low[1] < points[i, 1] < high[1]
            and low[2] < points[i, 2] < high[2]
        ):
            out[count] = i
            count += 1
    return out[:count].copy()


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """One moving object."""

    track_id: str
    label: str
    track: Track
    size_m: np.ndarray

    @cached_property
    def motion(self) -> Motion:
        return Motion.of(self.track)


def join_tracks(samples: Sequence[BoxSample]) -> tuple[ObjectTrack, ...]:
    """Return one track per object, siblings taken together, in order of first appearance.

    If a frame holds several boxes of an object (one per sensor, at its own moment), they become one
    sample of mean time and pose. On a straight path it lies on the path, and disagreement makes no
    jerks.
    """
    names = _unite(samples)
    groups: dict[str, list[BoxSample]] = defaultdict(list)
    for sample in samples:
        groups[names[sample.object_id]].append(sample)
    return tuple(_join(name, group) for name, group in groups.items())


def _unite(samples: Sequence[BoxSample]) -> dict[str, str]:
    """Return the group of every object's name: the name of the group's first box."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while parent.setdefault(name, name) != name:
            name = parent[name]
        return name

    order = {name: i for i, name in reversed(list(enumerate(s.object_id for s in samples)))}
    for sample in samples:
        # A sibling that has no box in these frames names nothing.
        if sample.sibling_id in order:
            a = root(sample.object_id)
            b = root(sample.sibling_id)
            first, second = sorted((a, b), key=order.__getitem__)
            parent[second] = first
    return {name: root(name) for name in order}


def _join(name: str, group: list[BoxSample]) -> ObjectTrack:
    by_frame: dict[int, list[BoxSample]] = defaultdict(list)
    for sample in group:
        by_frame[sample.frame].append(sample)
    merged = sorted(map(_mean_pose, by_frame.values()), key=lambda sample: sample[0])
    knots = [merged[0]]
    for time, pose in merged[1:]:
        if time - knots[-1][0] >= _MERGE_NS:
            knots.append((time, pose))
    track = Track(
        torch.tensor([time for time, _ in knots], dtype=torch.int64),
        torch.stack([pose for _, pose in knots]),
    )
    size_m = np.mean([s.size_m for s in group], axis=0)
    return ObjectTrack(name, group[0].label, track, size_m)


def _mean_pose(boxes: list[BoxSample]) -> tuple[int, torch.Tensor]:
    time = sum(b.timestamp_ns - boxes[0].timestamp_ns for b in boxes) // len(boxes)
    poses = torch.from_numpy(np.stack([b.world_from_box for b in boxes]))
    quats = quat_from_rotmat(poses[:, :3, :3])
    quats = quats * torch.where((quats * quats[:1]).sum(1, keepdim=True) < 0, -1.0, 1.0)
    rotation = rotmat_from_quat(quats.mean(0))
    return time + boxes[0].timestamp_ns, rigid(rotation, poses[:, :3, 3].mean(0))


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of one rigid body. points: float32 [N, 3] in its frame. semantic: int16 [N]."""

    points: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def join(parts: Sequence[PointSet]) -> PointSet:
        if not parts:
            return PointSet(np.zeros((0, 3), np.float32), np.zeros(0, np.int16))
        return PointSet(
            np.concatenate([p.points for p in parts]), np.concatenate([p.semantic for p in parts])
        )


def is_flat(semantic: np.ndarray) -> np.ndarray:
    """Return True for classes that are ground to drive or walk on, bool [N]."""
    return np.isin(semantic, _FLAT)


def split_sweeps(
    sweeps: Sequence[Sweep], tracks: Sequence[ObjectTrack]
) -> tuple[PointSet, tuple[PointSet, ...]]:
    """Return the points of the static world, and one set per track in the actor's frame.

    Each return is assigned by the box as it stood at the return's own time. Ground in a box stays
    ground; without classes the lowest FLOOR_M of a box belongs to the world.
    """
    is_static, actors = assign_returns(sweeps, tracks)
    return static_points(sweeps, is_static), actors


def static_points(sweeps: Sequence[Sweep], is_static: Sequence[np.ndarray]) -> PointSet:
    """Return the points of the returns in the masks, bool [N] of each sweep."""
    return PointSet.join(
        [
            PointSet(sweep.points[mask], sweep.semantic[mask])
            for sweep, mask in zip(sweeps, is_static, strict=True)
        ]
    )


def assign_returns(
    sweeps: Sequence[Sweep], tracks: Sequence[ObjectTrack]
) -> tuple[list[np.ndarray], tuple[PointSet, ...]]:
    """Return a mask of each sweep's returns of the static world, and the points of each track.

    See `split_sweeps`.
    """
    is_static_of_sweep: list[np.ndarray] = []
    actors: list[list[PointSet]] = [[] for _ in tracks]
    for sweep in sweeps:
        is_static = np.ones(len(sweep), dtype=bool)
        for track, parts in zip(tracks, actors, strict=True):
            near = track.motion.near(sweep.points, sweep.timestamps_ns, track.size_m)
            local = track.motion.into_actor(sweep.points[near], sweep.timestamps_ns[near])
            classes = sweep.semantic[near]
            ground = is_flat(classes)
            halo = inside_box(local, track.size_m, HALO_M) & ~ground
            low = local[:, 2] < FLOOR_M - track.size_m[2] / 2
            is_object = inside_box(local, track.size_m, SKIN_M) & ~ground
            is_object &= ~(low & (classes == SemanticClass.UNKNOWN))
            is_static[near[halo]] = False
            parts.append(PointSet(local[is_object].astype(np.float32), classes[is_object]))
        is_static_of_sweep.append(is_static)
    return is_static_of_sweep, tuple(map(PointSet.join, actors))


@cached_njit()
def _pose(knots, quats, centres, time, out):  # pragma: no cover - compiled
    """Interpolate a pose: linear in position, slerp in rotation, held before the first and after
    the last knot.
    """
    last = len(knots) - 1
    i = min(max(np.searchsorted(knots, time, side="right") - 1, 0), max(last - 1, 0))
    f = 0.0
    j = min(i + 1, last)
    if j > i:
        f = min(max((time - knots[i]) / (knots[j] - knots[i]), 0.0), 1.0)
    a = quats[i]
    b = quats[j]
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if dot < 0 else 1.0
    angle = np.arccos(min(abs(dot), 1.0))
    wa = 1.0 - f
    wb = f
    if angle > 1e-6:  # below, sin loses its digits and the straight line is exact
        wa = np.sin(wa * angle) / np.sin(angle)
        wb = np.sin(wb * angle) / np.sin(angle)
    wb *= sign
    w = wa * a[0] + wb * b[0]
    x = wa * a[1] + wb * b[1]
    y = wa * a[2] + wb * b[2]
    z = wa * a[3] + wb * b[3]
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w = w * n
    x = x * n
    y = y * n
    z = z * n
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    out[0, 1] = 2 * (x * y - w * z)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    for k in range(3):
        out[k, 3] = (1.0 - f) * centres[i, k] + f * centres[j, k]


@cached_njit()
def _into(knots, quats, centres, points, times, out):  # pragma: no cover - compiled
    pose = np.eye(4)
    for i in range(len(points)):
        if i == 0 or times[i] != times[i - 1]:
            _pose(knots, quats, centres, times[i], pose)
        dx = points[i, 0] - pose[0, 3]
        dy = points[i, 1] - pose[1, 3]
        dz = points[i, 2] - pose[2, 3]
        for k in range(3):
            out[i, k] = pose[0, k] * dx + pose[1, k] * dy + pose[2, k] * dz
