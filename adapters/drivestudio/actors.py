"""Rigid objects of a run as actors: their tracks, and which of the data's objects they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from adapters.drivestudio.drive import FRAME_NS, scene_from_model
from adapters.drivestudio.instances import Instance
from adapters.drivestudio.nodes import turned_to_actor
from adapters.drivestudio.run import Run
from adapters.join import with_class_of
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import taken, tensor
from augment.geometry import rigid, rotmat_from_quat, slerp
from augment.scene import Actor, Gaussians, check_gaussians
from augment.track import Track

_LABEL = "vehicle"  # of an object that none of the data's is known to be
_SAME_SIZE_M = 0.01
_NEAR_M = 2.0  # training moves an object less far from where it was labelled
_CLEARER = 2.0  # how many times farther the next candidate must be


@dataclass(frozen=True, eq=False)
class RigidPoses:
    """Where I objects are in the F frames of a run, in the model's world and their boxes' axes.

    positions: float64 [F, I, 3]. rotations: float64 [F, I, 3, 3]. visible: bool [F, I].
    sizes_m: float64 [I, 3].
    """

    positions: np.ndarray
    rotations: np.ndarray
    visible: np.ndarray
    sizes_m: np.ndarray


def read_poses(content: Mapping[str, Any], run: Run, where: str) -> RigidPoses:
    """The poses that frames are rendered with.

    In frames that were not trained on, those are halfway between the frames before and after,
    where both are and the first and last frames are not among them. (The project turns the
    Gaussians themselves, but not their places, by such a frame's own untrained pose. Here one pose
    does both.)

    Raises:
        AdapterError: a tensor is missing, of another shape, or not finite where it is used.
    """
    visible = tensor(content, "instances_fv", (None, None), where, dtype=torch.bool)
    frames, count = visible.shape
    if frames != len(run.frames):
        raise AdapterError(
            f"{where}: instances_fv has {frames} frames; {run.config_file} and {run.data} have "
            f"{len(run.frames)} ({run.frames.start} to {run.frames[-1]}). Is it the scene that the "
            f"run was trained on?"
        )
    quats = taken(tensor(content, "instances_quats", (frames, count, 4), where)).double()
    places = taken(tensor(content, "instances_trans", (frames, count, 3), where)).double()
    sizes = taken(tensor(content, "instances_size", (count, 3), where)).double()
    visible = taken(visible)
    norms = quats.norm(dim=2)
    usable = torch.isfinite(places).all(2) & torch.isfinite(norms) & (norms > 0)
    if not bool((usable | ~visible).all()) or not bool((sizes > 0).all()):
        raise AdapterError(f"{where}: poses or sizes of instances are NaN, infinite or zero")
    quats = torch.where(usable[..., None], quats, torch.tensor([1.0, 0, 0, 0]).double())
    places = torch.where(usable[..., None], places, torch.zeros(3).double())
    quats = quats / quats.norm(dim=2, keepdim=True)
    trained_quats, trained_places = quats.clone(), places.clone()
    for at, number in enumerate(run.frames):
        if not run.is_held_out(number) or at < 2 or at + 1 >= frames:
            continue
        both = (visible[at - 1] & visible[at + 1])[:, None]
        half = torch.full((count,), 0.5, dtype=torch.float64)
        between = slerp(trained_quats[at - 1], trained_quats[at + 1], half)
        quats[at] = torch.where(both, between, quats[at])
        middle = (trained_places[at - 1] + trained_places[at + 1]) / 2
        places[at] = torch.where(both, middle, places[at])
    return RigidPoses(
        places.numpy(), rotmat_from_quat(quats).numpy(), visible.numpy(), sizes.numpy()
    )


def make_actors(
    gaussians: Gaussians,
    owners: np.ndarray,
    poses: RigidPoses,
    identities: Sequence[Instance | None],
    run: Run,
    where: str,
) -> tuple[tuple[Actor, ...], tuple[str, ...]]:
    """One actor for each object that has Gaussians and is in some frame.

    owners: int64 [N], the object of each of the Gaussians. A track has a knot at each frame's time,
    which is that of its images, and the actor is absent from frames in which it is not visible.
    """
    actors, problems, absent = [], [], []
    axes, turn = run.convention.object_from_actor, scene_from_model(run)
    for index, identity in enumerate(identities):
        track_id = f"rigid-{index}" if identity is None else identity.track_id
        own = np.flatnonzero(owners == index)
        seen = np.flatnonzero(poses.visible[:, index])
        if len(own) == 0 or len(seen) == 0:
            absent.append(track_id)
            continue
        rotations = poses.rotations[seen, index]
        try:
            usable, about = check_gaussians(
                gaussians.select(torch.from_numpy(own)), where=f"{where} object {index}"
            )
        except SceneError as error:
            problems.append(str(error))
            continue
        problems += about
        label = _LABEL if identity is None else identity.label
        turned = turned_to_actor(usable, axes, turn)
        actors.append(
            Actor(
                track_id=track_id,
                label=label,
                gaussians=with_class_of(label, turned),
                track=_track(poses.positions[seen, index], rotations @ axes, seen, run, turn),
                size_m=tuple((poses.sizes_m[index] @ np.abs(axes)).tolist()),
                colors_in_world=True,
            )
        )
    if absent:
        problems.append(
            f"{where}: objects without Gaussians, or visible in no frame, are no actors: "
            f"{', '.join(absent)}"
        )
    return tuple(actors), tuple(problems)


def identify(
    poses: RigidPoses,
    instances: Sequence[Instance],
    model_from_dataset: np.ndarray,
    frames: range,
) -> list[Instance | None]:
    """Which of the data's objects each of the model's is; None where that is not clear.

    The model counts objects as it meets them in the LiDAR. One is the same as another that is
    labelled in the frames in which it is visible, of its mean size, and near it throughout.
    """
    numbers = np.array(frames)
    clear: list[Instance | None] = []
    for index in range(poses.visible.shape[1]):
        shown = poses.visible[:, index]
        candidates = []
        for instance in instances:
            if len(instance.frames) == 0:
                continue
            inside = np.isin(instance.frames, numbers)
            if not np.array_equal(instance.frames[inside], numbers[shown]) or not shown.any():
                continue
            size = instance.sizes_m[inside].mean(0)
            if np.abs(size - poses.sizes_m[index]).max() > _SAME_SIZE_M:
                continue
            places = instance.poses[inside, :3, 3] @ model_from_dataset[:3, :3].T
            apart = places + model_from_dataset[:3, 3] - poses.positions[shown, index]
            candidates.append((float(np.linalg.norm(apart, axis=1).mean()), instance))
        candidates.sort(key=lambda candidate: candidate[0])
        is_clear = bool(candidates) and candidates[0][0] < _NEAR_M
        if is_clear and len(candidates) > 1:
            is_clear = candidates[1][0] > _CLEARER * candidates[0][0] + _SAME_SIZE_M
        clear.append(candidates[0][1] if is_clear else None)
    taken_ids = [instance.track_id for instance in clear if instance is not None]
    return [
        None if instance is None or taken_ids.count(instance.track_id) > 1 else instance
        for instance in clear
    ]


def _track(
    positions: np.ndarray, rotations: np.ndarray, seen: np.ndarray, run: Run, turn: np.ndarray
) -> Track:
    poses = rigid(torch.from_numpy(turn @ rotations), torch.from_numpy(positions @ turn.T))
    times = (run.frames.start + seen).astype(np.int64) * FRAME_NS
    return Track(
        torch.from_numpy(times),
        poses,
        hold_ns=FRAME_NS // 2 - 1,  # the frame before and after are without it
        max_gap_ns=FRAME_NS,
    )
