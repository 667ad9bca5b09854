"""Gaussians in another frame, and all Gaussians of a scene at one moment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from augment.render.sh import rotate_sh
from augment.scene.geometry import multiply_quats, quat_from_rotmat, rotmat_from_quat
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, Scene
from augment.scene.semantics import SemanticClass

_ROWS_AT_ONCE = 65536  # Gaussians whose colours are rotated together


def transform_gaussians_rigidly(
    gaussians: Gaussians,
    rotation: Float[Tensor, "3 3"],
    shift: Float[Tensor, "3"],
    scale: float = 1.0,
) -> Gaussians:
    """Return the Gaussians at scale * rotation @ mean + shift.

    Quaternions and SH are rotated too. Positions are computed in float64 and rounded once.

    Args:
        gaussians: the Gaussians.
        rotation: float64 [3, 3].
        shift: float64 [3].
        scale: a factor of positions and sizes.
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
    sh = gaussians.sh if gaussians.sh_degree == 0 else _rotate_sh_in_pieces(gaussians.sh, rotation)
    return dataclasses.replace(moved, quats=multiply_quats(quat, gaussians.quats), sh=sh)


def transform_gaussians(gaussians: Gaussians, matrix: Float[Tensor, "3 3"]) -> Gaussians:
    """Return the Gaussians under a linear map without mirrors; their shapes are exact.

    SH rotate by the rotation that is nearest to the map.

    Args:
        gaussians: the Gaussians.
        matrix: float64 [3, 3], with a positive determinant.
    """
    u, stretch, vh = torch.linalg.svd(matrix)
    rotation = u @ vh
    scale = float(stretch.mean())
    no_shift = torch.zeros(3, dtype=torch.float64)
    if float(stretch[0] - stretch[2]) <= 1e-6 * scale:
        if torch.allclose(rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12):
            rotation = torch.eye(3, dtype=torch.float64)  # changes no bit
        return transform_gaussians_rigidly(gaussians, rotation, no_shift, scale)
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1)
    axes = matrix @ rotmat_from_quat(quats) * gaussians.scales.double()[:, None]
    is_usable = axes.isfinite().all(2).all(1)
    axes = torch.where(is_usable[:, None, None], axes, torch.eye(3, dtype=torch.float64))
    axes, scales, _ = torch.linalg.svd(axes)  # covariance = axes scales^2 axes^T
    scales = torch.where(is_usable[:, None], scales, torch.nan)
    axes = axes * torch.linalg.det(axes)[:, None, None]
    moved = transform_gaussians_rigidly(gaussians, rotation, no_shift)
    return dataclasses.replace(
        moved,
        means=(gaussians.means.double() @ matrix.T).to(gaussians.means.dtype),
        quats=quat_from_rotmat(axes).to(gaussians.quats.dtype),
        scales=scales.to(gaussians.scales.dtype),
    )


def bake_scene(scene: Scene, timestamp_ns: int) -> Gaussians:
    """Return the background and the actors of one moment as Gaussians of the scene's world.

    They have the colours of that moment, and the order of `Scene.parts_at`. Colours of a lower
    degree are filled up with zero bands, unknown classes with UNKNOWN.
    """
    parts = []
    for part in scene.parts_at(timestamp_ns):
        gaussians = part.gaussians
        pose = part.world_from_part
        if pose is not None:
            gaussians = transform_gaussians_rigidly(gaussians, pose[:3, :3], pose[:3, 3])
        parts.append(gaussians)
    return concatenate_gaussians(parts)


def concatenate_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the Gaussians of all parts, one part after another.

    Colours of a lower degree are filled up with zero bands, unknown classes with UNKNOWN.
    """
    if len(parts) == 1:
        return parts[0]
    names = ("means", "quats", "scales", "opacities")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    count = sum(map(len, parts))
    bands = NUM_SH_BY_DEGREE[max(part.sh_degree for part in parts if len(part) or count == 0)]
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


def _rotate_sh_in_pieces(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Tensor:
    """Rotate SH without temporaries as large as the coefficients of a large scene."""
    rotated = torch.empty_like(sh)
    for start in range(0, len(sh), _ROWS_AT_ONCE):
        rotated[start : start + _ROWS_AT_ONCE] = rotate_sh(
            sh[start : start + _ROWS_AT_ONCE], rotation
        )
    return rotated
