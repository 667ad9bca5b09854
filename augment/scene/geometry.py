"""Rotations, rigid transforms and poses over time.

Quaternions are wxyz; transforms are 4x4 `dst_from_src`, float64 unless said otherwise.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

# ---- Masks in squares of pixels, as tiles need them ----------------------------------------------


def any_in_squares(mask: np.ndarray, side: int) -> np.ndarray:
    """Return the mask of squares with a true pixel, bool [ceil(H / side), ceil(W / side)].

    Row by row first, so that whole rows are compared sixteen and more pixels at a time.

    Args:
        mask: bool [H, W].
        side: side of a square, pixels.
    """
    height, width = mask.shape
    num_whole = height // side
    pixels = mask.view(np.uint8)
    strips = pixels[: num_whole * side].reshape(num_whole, side, width).max(1)
    if num_whole * side < height:
        strips = np.concatenate([strips, pixels[num_whole * side :].max(0, keepdims=True)])
    padded = np.zeros((len(strips), -(-width // side) * side), np.uint8)
    padded[:, :width] = strips
    return padded.reshape(len(strips), -1, side).max(2).astype(bool)


def rotmat_from_quat(quats: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Return rotation matrices of wxyz quaternions of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=0.0).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def quat_from_rotmat(rotations: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Return unit wxyz quaternions (w >= 0) of rotation matrices.

    The four candidates 4 q_i q are all formed, and the one with the largest component is taken.
    This stays accurate at half turns, where the usual trace formula divides by zero.
    """
    m = rotations
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    s01 = m[..., 1, 0]
    s02 = m[..., 2, 0]
    s12 = m[..., 2, 1]
    t01 = m[..., 0, 1]
    t02 = m[..., 0, 2]
    t12 = m[..., 1, 2]
    candidates = torch.stack(
        [
            torch.stack([1 + trace, s12 - t12, t02 - s02, s01 - t01], -1),
            torch.stack([s12 - t12, 1 + 2 * m[..., 0, 0] - trace, s01 + t01, t02 + s02], -1),
            torch.stack([t02 - s02, s01 + t01, 1 + 2 * m[..., 1, 1] - trace, s12 + t12], -1),
            torch.stack([s01 - t01, t02 + s02, s12 + t12, 1 + 2 * m[..., 2, 2] - trace], -1),
        ],
        -2,
    )  # [*B, 4, 4]
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    best_candidates = torch.take_along_dim(candidates, best[..., None, None], dim=-2).squeeze(-2)
    quats = torch.nn.functional.normalize(best_candidates, dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(a: Float[Tensor, "*B 4"], b: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 4"]:
    """Return the Hamilton product a b: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def slerp(
    a: Float[Tensor, "*B 4"], b: Float[Tensor, "*B 4"], fraction: Float[Tensor, "*B"]
) -> Float[Tensor, "*B 4"]:
    """Return the spherical interpolation of unit quaternions, the shorter way round."""
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs().clamp(max=1.0)
    angle = torch.acos(dot)
    fraction = fraction[..., None]
    # sin(angle) of a smaller angle loses its digits; the straight line is exact to float64 there.
    is_near = angle < 1e-6
    sin = torch.where(is_near, torch.ones_like(angle), torch.sin(angle))
    wa = torch.where(is_near, 1 - fraction, torch.sin((1 - fraction) * angle) / sin)
    wb = torch.where(is_near, fraction, torch.sin(fraction * angle) / sin)
    return torch.nn.functional.normalize(wa * a + wb * b, dim=-1)


def rigid(rotation: Tensor, translation: Tensor) -> Float[Tensor, "*B 4 4"]:
    """Return the 4x4 transform of a 3x3 rotation and a translation."""
    out = torch.zeros(*rotation.shape[:-2], 4, 4, dtype=rotation.dtype)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1
    return out


def invert_rigid(transform: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """Return the inverse of a rigid transform, by transposing its rotation."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    return rigid(rotation, -(rotation @ transform[..., :3, 3:]).squeeze(-1))


def transform_points(
    transform: Float[Tensor, "4 4"], points: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3"]:
    """Return points [.., 3] moved by dst_from_src, in the dtype of the points."""
    transform = transform.to(points.dtype)
    return points @ transform[:3, :3].T + transform[:3, 3]
