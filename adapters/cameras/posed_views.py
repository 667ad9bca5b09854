"""Views: the images of a camera file, before they are grouped into frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.plain_files import LARGEST
from augment.errors import AdapterError

_ORTHONORMAL_TOLERANCE = 1e-4  # as in Camera: poses written with four decimals or fewer fail


@dataclass(frozen=True, eq=False)
class PosedView:
    """One posed image in the file's own world (its axes, its unit of length).

    name: the image's name in the file. fx, fy, cx, cy: pixels. world_from_camera: float64 [4, 4],
    OpenCV axes (x right, y down, z forward). image_path: where the image lies, if it does.
    camera, frame: its camera's name and its frame's number where the file says; both or neither.
    timestamp_ns: since the scene's first frame; None where the file has no times.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray
    image_path: str | None = None
    camera: str | None = None
    frame: int | None = None
    timestamp_ns: int | None = None


@dataclass(frozen=True, eq=False)
class ViewSet:
    """All views of a camera file, and what was wrong in it, a sentence each."""

    views: tuple[PosedView, ...]
    problems: tuple[str, ...] = ()


def check_pose(world_from_camera: np.ndarray, *, where: str) -> np.ndarray:
    """The pose as float64 [4, 4] with an exact last row, once it is known to be rigid.

    Raises:
        AdapterError: the rotation is not orthonormal with determinant +1, or a value not finite.
    """
    pose = np.asarray(world_from_camera, dtype=np.float64)
    if not (np.abs(pose) <= LARGEST).all():  # NaN included
        raise AdapterError(
            f"{where}: the pose must be finite, at most {LARGEST:g}; got {pose.tolist()}"
        )
    rotation = pose[:3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
    if error >= _ORTHONORMAL_TOLERANCE:
        raise AdapterError(
            f"{where}: the rotation must be orthonormal to {_ORTHONORMAL_TOLERANCE:g}; it is off "
            f"by {error:.3g} (determinant {determinant:.3g}). Write more decimals, and take any "
            "scale out of the matrix"
        )
    if determinant < 0:
        raise AdapterError(
            f"{where}: the rotation must have determinant +1; got {determinant:.3g}, a mirrored "
            "camera"
        )
    whole = np.eye(4)
    whole[:3] = pose[:3]
    return whole


def look_at_pose(
    position: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray, *, where: str
) -> np.ndarray:
    """world_from_camera of an upright camera at `position` that looks at `target` (world +z up).

    Straight up or down, where upright means nothing, the top of the image points to world +y.

    Raises:
        AdapterError: the two points coincide.
    """
    eye, forward = np.asarray(position, np.float64), np.subtract(target, position, dtype=np.float64)
    length = np.linalg.norm(forward)
    if not (np.isfinite(length) and length > 1e-9):
        raise AdapterError(
            f"{where}: look_at must differ from position; got {list(target)} for both"
        )
    forward /= length
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 1 - 1e-9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = eye
    return pose
