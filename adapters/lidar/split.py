"""Sweeps taken apart: the static world, and every moving object in its own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.lidar.actor_motion import indices_between, inside_box
from adapters.lidar.box_tracks import ObjectTrack
from augment.semantics import SemanticClass

# A moving object's returns stray from its box by timing and labelling: within this of the box a
# return is not static world, and within the smaller margin it is the object's own surface.
HALO_M = 0.35
SKIN_M = 0.1
# Without classes, returns this near the bottom of a box may be road or tyre: neither gets them.
FLOOR_M = 0.15
_FLAT = np.array(
    [
        SemanticClass.ROAD,
        SemanticClass.LANE_MARKING,
        SemanticClass.SIDEWALK,
        SemanticClass.TERRAIN,
    ],
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
