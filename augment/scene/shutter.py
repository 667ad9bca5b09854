"""Rolling shutters: the rows or columns of an image are exposed one after another.

The poses at the start and the end of the read-out are stored relative to the camera's, so that a
camera that is moved to another world keeps its shutter.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from augment.scene.geometry import invert_rigid, quat_from_rotmat, rigid, rotmat_from_quat, slerp

ReadOut = Literal["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
READ_OUTS: tuple[str, ...] = get_args(ReadOut)
# Longest read-out that is believed, ns: beyond it, units have been mixed up.
MAX_DURATION_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class RollingShutter:
    """Read-out of an image while the camera moves.

    The camera's own pose and timestamp are those of the middle of the read-out. The pose in between
    is linear in the optical centre and spherical in the rotation, from the start over the middle to
    the end.
    """

    start_from_camera: Float[Tensor, "4 4"]
    """Camera at the start of the read-out, from the camera at its middle; float64, rigid."""
    end_from_camera: Float[Tensor, "4 4"]
    """Camera at the end of the read-out, from the camera at its middle; float64, rigid."""
    read_out: ReadOut
    """Direction in which the rows or columns are read."""
    duration_ns: int
    """Time from the first row (or column) of the whole image to the last, ns."""
    first_share: float = 0.0
    """Share of the read-out at which the image's first border is read; 0 for a whole image."""
    last_share: float = 1.0
    """Share of the read-out at which the image's last border is read; 1 for a whole image."""

    def __post_init__(self) -> None:
        if self.read_out not in READ_OUTS:
            raise ValueError(
                f"read_out of a rolling shutter must be one of {', '.join(READ_OUTS)}; "
                f"got {self.read_out!r}"
            )
        if not 0 <= self.duration_ns <= MAX_DURATION_NS:
            raise ValueError(
                f"duration_ns of a rolling shutter must be from 0 to {MAX_DURATION_NS} ns; "
                f"got {self.duration_ns}"
            )
        for name in ("start_from_camera", "end_from_camera"):
            _check_rigid(name, getattr(self, name))

    @staticmethod
    def between(
        start_camera_from_world: Float[Tensor, "4 4"],
        end_camera_from_world: Float[Tensor, "4 4"],
        *,
        read_out: ReadOut,
        duration_ns: int,
        camera_from_world: Float[Tensor, "4 4"] | None = None,
    ) -> RollingShutter:
        """Return the shutter of a camera whose poses at both ends of the read-out are known.

        Args:
            start_camera_from_world: pose at the start of the read-out, float64.
            end_camera_from_world: pose at its end, float64.
            read_out: direction in which the rows or columns are read.
            duration_ns: time between both.
            camera_from_world: pose at the middle, which the camera gets; None for
                `interpolate_pose` of both at one half.
        """
        if camera_from_world is None:
            camera_from_world = interpolate_pose(
                start_camera_from_world, end_camera_from_world, 0.5
            )
        world_from_camera = invert_rigid(camera_from_world)
        return RollingShutter(
            start_camera_from_world @ world_from_camera,
            end_camera_from_world @ world_from_camera,
            read_out,
            duration_ns,
        )

    @property
    def is_along_rows(self) -> bool:
        """Return True if whole rows are read at once, and False if whole columns are."""
        return self.read_out in ("top_to_bottom", "bottom_to_top")

    def share_at(self, position: float, size: int) -> float:
        """Return the share of the read-out at which a place in the image is read.

        Args:
            position: row or column, pixels, pixel centres at +0.5.
            size: height or width of the image, pixels.
        """
        part = position / size
        if self.read_out in ("bottom_to_top", "right_to_left"):
            part = 1 - part
        return self.first_share + part * (self.last_share - self.first_share)

    def camera_at(
        self, share: float, camera_from_world: Float[Tensor, "4 4"]
    ) -> Float[Tensor, "4 4"]:
        """Return the pose at a share of the read-out, as camera_from_world, float64.

        Args:
            share: 0 at the start, 0.5 at the middle, 1 at the end.
            camera_from_world: pose at the middle.
        """
        if share == 0.5:
            return camera_from_world
        end = self.start_from_camera if share < 0.5 else self.end_from_camera
        identity = torch.eye(4, dtype=torch.float64)
        moved_from_camera = interpolate_pose(identity, end, abs(2 * share - 1))
        return moved_from_camera @ camera_from_world

    def world_from_camera_at(
        self, shares: Float64[np.ndarray, " N"], camera_from_world: Float[Tensor, "4 4"]
    ) -> Float64[np.ndarray, "N 4 4"]:
        """Return the inverse poses of `camera_at` at several shares of the read-out.

        Args:
            shares: 0 at the start, 0.5 at the middle, 1 at the end.
            camera_from_world: pose at the middle.
        """
        camera_from_ends = torch.stack(
            [
                invert_rigid(self.start_from_camera),
                torch.eye(4, dtype=torch.float64),
                invert_rigid(self.end_from_camera),
            ]
        )
        share = torch.from_numpy(shares)
        first = (share >= 0.5).long()
        part = torch.where(first == 0, 2 * share, 2 * share - 1)
        quats = quat_from_rotmat(camera_from_ends[:, :3, :3])
        centres = camera_from_ends[:, :3, 3]
        quat = slerp(quats[first], quats[first + 1], part)
        centre = centres[first] + part[:, None] * (centres[first + 1] - centres[first])
        camera_from_moved = rigid(rotmat_from_quat(quat), centre)
        return (invert_rigid(camera_from_world) @ camera_from_moved).numpy()

    def time_at_ns(self, share: float) -> int:
        """Return the time of a share of the read-out, relative to its middle, ns."""
        return round((share - 0.5) * self.duration_ns)

    def cropped(
        self, left: int, top: int, window: tuple[int, int], size: tuple[int, int]
    ) -> RollingShutter:
        """Return the shutter of a window of the image.

        Args:
            left: column of the window's first pixel.
            top: row of the window's first pixel.
            window: width and height of the window.
            size: width and height of the image.
        """
        if self.is_along_rows:
            borders = (top, top + window[1])
            length = size[1]
        else:
            borders = (left, left + window[0])
            length = size[0]
        shares = sorted(self.share_at(border, length) for border in map(float, borders))
        return dataclasses.replace(self, first_share=shares[0], last_share=shares[1])


def interpolate_pose(
    first: Float[Tensor, "4 4"], second: Float[Tensor, "4 4"], share: float
) -> Float[Tensor, "4 4"]:
    """Return the pose between two `camera_from_world`, which may lie beyond them.

    Args:
        first: pose at share 0, float64.
        second: pose at share 1, float64.
        share: position between both.

    Returns:
        The pose whose optical centre is linear, and whose rotation is spherical, in the share.
    """
    first_world = invert_rigid(first)
    second_world = invert_rigid(second)
    quat = slerp(
        quat_from_rotmat(first_world[:3, :3]),
        quat_from_rotmat(second_world[:3, :3]),
        torch.tensor(share, dtype=torch.float64),
    )
    centre = first_world[:3, 3] + share * (second_world[:3, 3] - first_world[:3, 3])
    return invert_rigid(rigid(rotmat_from_quat(quat), centre))


def _check_rigid(name: str, pose: Tensor) -> None:
    """Raise ValueError unless a pose is float64 [4, 4] and rigid."""
    if pose.dtype != torch.float64 or tuple(pose.shape) != (4, 4):
        raise ValueError(
            f"{name} of a rolling shutter must be float64 [4, 4]; got {pose.dtype} "
            f"{list(pose.shape)}"
        )
    rotation = pose.detach().numpy()[:3, :3]
    with np.errstate(invalid="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_finite = bool(torch.isfinite(pose).all())
    if not (is_finite and error < 1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{name} of a rolling shutter must be rigid with determinant +1 and finite; its "
            f"rotation is off orthonormal by {error:.3g}"
        )
