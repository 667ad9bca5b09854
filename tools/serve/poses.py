"""Poses of messages as matrices, and back: checks of what clients send."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.scene.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from tools.serve.errors import invalid
from tools.serve.messages import message_class

# Error of a quaternion's length, at most: float32 leaves 1e-7, and clients interpolate.
_MAX_LENGTH_ERROR = 1e-3
# Distance from the scene's origin, at most, metres.
_MAX_DISTANCE_M = 1e6


def pose_matrix(pose: Any, field: str) -> Tensor:
    """Return the matrix of a `common.Pose`, float64 [4, 4], its quaternion normalised.

    Args:
        pose: the message.
        field: names it in refusals.

    Raises:
        RequestRefused: it has NaN, infinite or huge numbers, or its quaternion is not of length 1.
    """
    position = np.array([pose.vec.x, pose.vec.y, pose.vec.z], np.float64)
    quat = np.array([pose.quat.w, pose.quat.x, pose.quat.y, pose.quat.z], np.float64)
    if not (np.isfinite(position).all() and np.isfinite(quat).all()):
        raise invalid(f"{field}: all numbers must be finite; got {_pose_text(position, quat)}")
    length = float(np.linalg.norm(quat))
    if abs(length - 1) > _MAX_LENGTH_ERROR:
        raise invalid(
            f"{field}.quat must be a unit quaternion (w, x, y, z); its length is {length:.4g}, "
            f"got {_pose_text(position, quat)}"
        )
    if np.abs(position).max() > _MAX_DISTANCE_M:
        raise invalid(
            f"{field}.vec must lie within {_MAX_DISTANCE_M:g} m of the origin of the scene's local "
            f"frame (get_available_trajectories has its path); got {_pose_text(position, quat)}"
        )
    return rigid(rotmat_from_quat(torch.from_numpy(quat)), torch.from_numpy(position))


def pose_message(matrix: Tensor) -> Any:
    """Return the `common.Pose` of a rigid matrix [4, 4]."""
    quat = quat_from_rotmat(matrix[:3, :3]).tolist()
    position = matrix[:3, 3].tolist()
    return message_class("common.Pose")(
        vec=dict(zip("xyz", position, strict=True)), quat=dict(zip("wxyz", quat, strict=True))
    )


def pose_pair(pair: Any, field: str) -> tuple[Tensor, Tensor]:
    """Return the matrices of a `PosePair`, float64 [4, 4]: at the start and at the end.

    A pair with one pose stands for a sensor that does not move.
    """
    has_start = pair.HasField("start_pose")
    has_end = pair.HasField("end_pose")
    if not (has_start or has_end):
        raise invalid(f"{field} is missing: give start_pose and end_pose")
    start = pose_matrix(
        pair.start_pose if has_start else pair.end_pose,
        f"{field}.{'start_pose' if has_start else 'end_pose'}",
    )
    if not (has_start and has_end) or pair.start_pose == pair.end_pose:
        return start, start
    return start, pose_matrix(pair.end_pose, f"{field}.end_pose")


def is_within_rounding(first: Tensor, second: Tensor) -> bool:
    """Return True if two poses differ by no more than the rounding of float32 numbers."""
    eps = float(np.finfo(np.float32).eps)
    furthest_m = max(1.0, float(second[:3, 3].abs().max()))
    turn_error = float((first[:3, :3] - second[:3, :3]).abs().max())
    distance_m = float((first[:3, 3] - second[:3, 3]).abs().max())
    return turn_error <= 8 * eps and distance_m <= 2 * eps * furthest_m


def _pose_text(position: np.ndarray, quat: np.ndarray) -> str:
    """Return a pose for a message."""
    numbers = [", ".join(f"{value:g}" for value in values) for values in (position, quat)]
    return f"vec ({numbers[0]}), quat ({numbers[1]})"
