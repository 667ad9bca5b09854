"""The Gaussians of a run's models: tensors of a checkpoint, activated."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.errors import AdapterError
from augment.files.checkpoints import section, taken, tensor
from augment.geometry import multiply_quats, quat_from_rotmat
from augment.render.sh import SH_C0, rotate_sh
from augment.scene import SH_COUNTS, Gaussians

BACKGROUND, RIGID = "Background", "RigidNodes"
OTHERS = frozenset({"Sky", "Affine", "CamPose", "CamPosePerturb"})  # models without Gaussians
RIGID_KEYS = ("points_ids", "instances_size", "instances_fv", "instances_quats", "instances_trans")
_KEYS = ("_means", "_scales", "_quats", "_opacities", "_features_dc", "_features_rest")
_REASONS = {
    "SMPLNodes": "people need the body model SMPL, which is licensed by itself",
    "DeformableNodes": "they deform over time",
}


def read_gaussians(
    content: Mapping[str, Any], *, step: int, sh_interval: int, where: str
) -> tuple[Gaussians, tuple[str, ...]]:
    """The Gaussians of one model as training rendered them, in its own axes, quaternions as they
    are, and what is left out of them.

    Of spherical harmonics those degrees are kept that training had switched on: one for each
    sh_interval steps. Models without any have colours sigmoid(c), here the degree 0 that gives
    them.

    Raises:
        AdapterError: a tensor is missing, of another shape, or more than the project's own layout.
    """
    more = sorted(set(map(str, content)) - {*_KEYS, *RIGID_KEYS})
    if more:
        raise AdapterError(
            f"{where} holds {', '.join(more[:6])} besides plain Gaussians: they change over time "
            f"in ways that are not known here. Known models are VanillaGaussians and RigidNodes"
        )
    means = tensor(content, "_means", (None, 3), where)
    count = len(means)
    rest = tensor(content, "_features_rest", (count, None, 3), where)
    if rest.shape[1] + 1 not in SH_COUNTS:
        raise AdapterError(
            f"{where}: _features_rest must have 0, 3, 8 or 15 rows (degrees 0 to 3 of spherical "
            f"harmonics); got {rest.shape[1]}"
        )
    degree = SH_COUNTS.index(rest.shape[1] + 1)
    active = min(step // sh_interval, degree)
    sh = torch.empty(count, SH_COUNTS[active], 3)
    taken(tensor(content, "_features_dc", (count, 3), where), sh[:, 0])
    taken(rest[:, : SH_COUNTS[active] - 1], sh[:, 1:])
    if degree == 0:
        sh.sigmoid_().sub_(0.5).div_(SH_C0)
    gaussians = Gaussians(
        means=taken(means),
        quats=taken(tensor(content, "_quats", (count, 4), where)),
        scales=taken(tensor(content, "_scales", (count, 3), where)).exp_(),
        opacities=taken(tensor(content, "_opacities", (count, 1), where)).sigmoid_()[:, 0],
        sh=sh,
    )
    if active == degree:
        return gaussians, ()
    return gaussians, (
        f"{where}: training stopped at step {step}, before spherical harmonics of degree "
        f"{active + 1} to {degree} were switched on; they are left out",
    )


def left_out(models: Mapping[str, Any], where: str) -> tuple[str, ...]:
    """A sentence for each model that is not drawn, with the number of its Gaussians."""
    sentences = []
    for name in models:
        if name in (BACKGROUND, RIGID) or name in OTHERS:
            continue
        content = section(models, name, where)
        means = content.get("_means")
        reason = _REASONS.get(name, "models of this kind are not known here")
        if isinstance(means, Tensor):
            sentences.append(f"{where}: {len(means)} Gaussians of {name} are left out: {reason}")
        else:
            sentences.append(f"{where}: the model {name} is left out: {reason}")
    return tuple(sentences)


def turned_to_actor(
    gaussians: Gaussians, object_from_actor: np.ndarray, scene_from_model: np.ndarray
) -> Gaussians:
    """An object's Gaussians in its actor's axes, colours for directions of the scene's world.

    The project looks up spherical harmonics in directions of the world, whichever way the object
    is turned. scene_from_model: [3, 3].
    """
    sh = gaussians.sh
    if gaussians.sh_degree > 0 and not np.array_equal(scene_from_model, np.eye(3)):
        sh = rotate_sh(sh, torch.from_numpy(scene_from_model))
    if np.array_equal(object_from_actor, np.eye(3)):
        return dataclasses.replace(gaussians, sh=sh)
    actor_from_object = torch.from_numpy(object_from_actor.T.copy())
    turn = quat_from_rotmat(actor_from_object).to(gaussians.quats.dtype)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ actor_from_object.T.to(gaussians.means.dtype),
        quats=multiply_quats(turn.expand_as(gaussians.quats), gaussians.quats),
        sh=sh,
    )
