"""A model's actors: Gaussians, tracks at the moments of the images, colours over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from adapters.join import with_class_of
from adapters.street_gaussians.corrections import CameraChanges
from adapters.street_gaussians.parts import Part
from adapters.street_gaussians.poses import PoseChanges, Poses, image_poses, rotations_of
from adapters.street_gaussians.records import ModelConfig, StreetData, TrackedObject
from augment.color_waves import ColorWaves
from augment.scene import Actor
from augment.track import Track

_LONGEST_HOLD_NS = 100_000_000
_SAME_MOMENT_M = 0.01


@dataclass(frozen=True)
class ActorSettings:
    """fourier_scale, opt_track: as in ModelConfig. rotation_bug: as in vehicle_poses."""

    fourier_scale: float
    opt_track: bool
    rotation_bug: bool

    @staticmethod
    def of(config: ModelConfig, *, rotation_bug: bool) -> ActorSettings:
        return ActorSettings(config.fourier_scale, config.opt_track, rotation_bug)


def make_actor(
    data: StreetData,
    tracked: TrackedObject,
    part: Part,
    pose_changes: PoseChanges | None,
    camera_changes: CameraChanges,
    settings: ActorSettings,
) -> tuple[Actor | None, tuple[str, ...]]:
    """The actor of an object's Gaussians, None where no image shows it, and sentences."""
    name = f"obj_{tracked.track_id:03d}"
    times = np.array([image.timestamp_s for image in data.images])
    shown = np.flatnonzero((times >= tracked.start_s) & (times <= tracked.end_s))
    if len(shown) == 0:
        return None, (f"{name} is in none of the images' moments and is left out",)
    poses = image_poses(
        data,
        tracked,
        shown,
        pose_changes,
        interpolate_held_out=settings.opt_track,
        rotation_bug=settings.rotation_bug,
    )
    world_from_actor = _in_world(data, shown, poses, camera_changes)
    stamps = np.array([data.images[i].timestamp_ns for i in shown])
    knots, first, which = np.unique(stamps, return_index=True, return_inverse=True)
    apart = np.linalg.norm(
        world_from_actor[:, :3, 3] - world_from_actor[first[which], :3, 3], axis=1
    ).max()
    problems = []
    if apart > _SAME_MOMENT_M:
        problems.append(
            f"{name} is at places up to {apart:.2f} m apart in images of one moment; the first "
            f"camera's is taken"
        )
    if part.terms is not None and tracked.start_frame == tracked.end_frame:
        problems.append(f"{name} is tracked in one frame only; its colours do not change over time")
    actor = Actor(
        track_id=str(tracked.track_id),
        label=tracked.label,
        gaussians=with_class_of(tracked.label, part.gaussians),
        track=Track(
            torch.from_numpy(knots),
            torch.from_numpy(world_from_actor[first]),
            hold_ns=_hold_ns(knots, data),
        ),
        size_m=tracked.size_m,
        color_waves=_waves(data, tracked, part, shown[first], knots, settings.fourier_scale),
        colors_in_world=True,
    )
    return actor, tuple(problems)


def _in_world(
    data: StreetData, images: np.ndarray, poses: Poses, camera_changes: CameraChanges
) -> np.ndarray:
    """world_from_actor at the moments of images, float64 [T, 4, 4]."""
    ego_from_actor = np.tile(np.eye(4), (len(images), 1, 1))
    ego_from_actor[:, :3, :3] = rotations_of(poses.quats)
    ego_from_actor[:, :3, 3] = poses.positions
    world_from_ego = np.stack([data.images[i].world_from_ego for i in images])
    world_from_moved = camera_changes.inverses[[camera_changes.row(data.images[i]) for i in images]]
    return world_from_moved @ world_from_ego @ ego_from_actor


def _hold_ns(knots: np.ndarray, data: StreetData) -> int:
    """How long the actor stays before and after its knots without getting into other images."""
    stamps = np.array([image.timestamp_ns for image in data.images])
    away = np.concatenate(
        [knots[0] - stamps[stamps < knots[0]], stamps[stamps > knots[-1]] - knots[-1]]
    )
    return int(min([_LONGEST_HOLD_NS, *(away - 1)]))


def _waves(
    data: StreetData,
    tracked: TrackedObject,
    part: Part,
    images: np.ndarray,
    knots: np.ndarray,
    fourier_scale: float,
) -> ColorWaves | None:
    """Colours over time; all images of a frame have the phase of its number."""
    if part.terms is None:
        return None
    span = tracked.end_frame - tracked.start_frame
    frames = np.array([data.images[i].frame for i in images], np.float64)
    phases = (
        fourier_scale * (frames - tracked.start_frame) / span if span else np.zeros(len(images))
    )
    return ColorWaves(part.terms, torch.from_numpy(knots), torch.from_numpy(phases))
