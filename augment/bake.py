"""Gaussians moved into another frame, and a whole scene in one set of them at a moment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from augment.geometry import multiply_quats, quat_from_rotmat
from augment.render.sh import rotate_sh
from augment.scene import SH_COUNTS, Gaussians, Scene, SemanticClass

_PIECE = 65536  # Gaussians whose colours are turned together


def moved_gaussians(
    gaussians: Gaussians,
    rotation: Float[Tensor, "3 3"],
    shift: Float[Tensor, "3"],
    scale: float = 1.0,
) -> Gaussians:
    """The Gaussians at scale * rotation @ mean + shift: quaternions and SH are turned with them.

    rotation, shift: float64; places are computed in float64 and rounded once.
    """
    means = scale * (gaussians.means.double() @ rotation.T) + shift
    moved = dataclasses.replace(
        gaussians,
        means=means.to(gaussians.means.dtype),
        scales=gaussians.scales if scale == 1.0 else gaussians.scales * scale,
    )
    if torch.equal(rotation, torch.eye(3, dtype=rotation.dtype)):
        return moved
    quat = quat_from_rotmat(rotation).to(gaussians.quats.dtype).expand_as(gaussians.quats)
    sh = gaussians.sh if gaussians.sh_degree == 0 else _turned_sh(gaussians.sh, rotation)
    return dataclasses.replace(moved, quats=multiply_quats(quat, gaussians.quats), sh=sh)


def baked(scene: Scene, timestamp_ns: int) -> Gaussians:
    """Background and the actors that are there at a moment as Gaussians of the scene's world, in
    the colours they have then; in the order of `Scene.parts_at`.

    Colours of a lower degree are filled up with zero bands, unknown classes with UNKNOWN.
    """
    placed = []
    for part in scene.parts_at(timestamp_ns):
        gaussians, pose = part.gaussians, part.world_from_part
        if pose is not None:
            gaussians = moved_gaussians(gaussians, pose[:3, :3], pose[:3, 3])
        placed.append(gaussians)
    return _joined(placed)


def _joined(parts: Sequence[Gaussians]) -> Gaussians:
    if len(parts) == 1:
        return parts[0]
    names = ("means", "quats", "scales", "opacities")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    count = sum(map(len, parts))
    bands = SH_COUNTS[max(part.sh_degree for part in parts if len(part) or count == 0)]
    sh = torch.zeros(count, bands, 3, dtype=parts[0].sh.dtype)
    has_classes = any(part.semantic is not None for part in parts)
    semantic = torch.full((count,), int(SemanticClass.UNKNOWN), dtype=torch.int16)
    start = 0
    for part in parts:
        rows = slice(start, start + len(part))
        sh[rows, : part.sh.shape[1]] = part.sh[:, :bands]
        if part.semantic is not None:
            semantic[rows] = part.semantic
        start = rows.stop
    return Gaussians(**columns, sh=sh, semantic=semantic if has_classes else None)


def _turned_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Tensor:
    """rotate_sh without temporaries as large as the coefficients of a large scene."""
    turned = torch.empty_like(sh)
    for start in range(0, len(sh), _PIECE):
        turned[start : start + _PIECE] = rotate_sh(sh[start : start + _PIECE], rotation)
    return turned
