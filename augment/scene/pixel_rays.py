"""Rays of all pixels of any camera, and pixels of points: through its lens and rolling shutter.

Labels are measured with them. A pinhole camera without shutter has faster ways of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from augment.scene.cameras import Camera
from augment.scene.pinhole_views import layout_of

# Depth from which a point is before a camera without lens, metres.
MIN_DEPTH_M = 0.01
# Decimals of a rotation between cameras: 1e-9 radians are far below a pixel.
_TURN_DECIMALS = 9
# Shares of the read-out at which points are projected, to find when they are read.
_NUM_SHARES = 33


@dataclass(frozen=True, eq=False)
class PixelRays:
    """Rays of the pixels of an image: points at depth d are origin + d direction."""

    origins_m: Float64[np.ndarray, "#H #W 3"]
    """Optical centre at the time of the pixel, scene world, metres."""
    directions: Float64[np.ndarray, "H W 3"]
    """Way in the world for a depth of 1, as the camera's lens defines depth."""

    def points_at(
        self, rows: np.ndarray, columns: np.ndarray, depth_m: Float[np.ndarray, " N"]
    ) -> Float64[np.ndarray, "N 3"]:
        """Return the surface points of pixels, scene world.

        Args:
            rows: rows of the pixels.
            columns: their columns.
            depth_m: their depths.
        """
        height, width = self.directions.shape[:2]
        origins = np.broadcast_to(self.origins_m, (height, width, 3))[rows, columns]
        return origins + self.directions[rows, columns] * depth_m[:, None]


def pixel_rays_of(camera: Camera) -> PixelRays:
    """Return the rays of a camera's pixels.

    Args:
        camera: any camera but an orthographic one.
    """
    if camera.lens is None:
        across = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        down = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        local = np.ones((camera.height, camera.width, 3))
        local[..., 0] = across
        local[..., 1] = down[:, None]
    else:
        local = layout_of(camera).rays.astype(np.float64)
        if not camera.lens.is_depth_along_ray:
            local /= local[..., 2:]
    shutter = camera.shutter
    if shutter is None:
        pose = camera.world_from_camera.numpy()
        return PixelRays(pose[:3, 3].reshape(1, 1, 3), local @ pose[:3, :3].T)
    size = camera.height if shutter.is_along_rows else camera.width
    shares = np.array([shutter.share_at(line + 0.5, size) for line in range(size)])
    poses = shutter.world_from_camera_at(shares, camera.camera_from_world)
    lines = (slice(None), None) if shutter.is_along_rows else (None, slice(None))
    rotations = poses[:, :3, :3][lines]  # [H, 1, 3, 3] or [1, W, 3, 3]
    directions = np.matmul(rotations, local[..., None])[..., 0]
    return PixelRays(poses[:, :3, 3][lines], directions)


def local_rays(camera: Camera, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 3"]:
    """Return the ways in the camera's axes for a depth of 1 along the rays of some pixels.

    Args:
        camera: any camera but an orthographic one; a shutter does not count.
        pixels: pixels, which may lie between pixel centres.
    """
    if camera.lens is None:
        across = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        return np.concatenate([across, np.ones((len(pixels), 1))], axis=1)
    rays, _ = camera.lens.rays(pixels, camera.intrinsics)
    return rays if camera.lens.is_depth_along_ray else rays / rays[:, 2:]


def turn_between(camera: Camera, view: Camera) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from a view's axes to a camera's, without its rounding errors.

    So it is the same for all frames of a drive, and serves as a key of what is computed once. It is
    exactly the identity where both look the same way.

    Args:
        camera: the camera.
        view: another camera.
    """
    rotation = camera.camera_from_world[:3, :3]
    if torch.equal(rotation, view.camera_from_world[:3, :3]):  # also where it is not quite rigid
        return np.eye(3)
    turn = rotation @ view.camera_from_world[:3, :3].T
    return np.round(turn.numpy(), _TURN_DECIMALS) + 0.0  # -0.0 is 0.0


def turned_rays(
    view: Camera, camera_from_view: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "H W 3"]:
    """Return the ways for a depth of 1 of a pinhole view's pixels, in the axes of a turned camera.

    Args:
        view: the view.
        camera_from_view: rotation of `turn_between`.
    """
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    x = (columns - view.cx) / view.fx
    y = (rows - view.cy) / view.fy
    return np.stack([x, y, np.ones_like(x)], -1) @ camera_from_view.T


def depth_of(camera: Camera, local_m: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
    """Return the depths of points in the camera's axes: z, or the distance, as the lens says."""
    if camera.lens is not None and camera.lens.is_depth_along_ray:
        return np.linalg.norm(local_m, axis=1)
    return local_m[:, 2]


def project_points(
    camera: Camera, points_m: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 2"], Bool[np.ndarray, " N"]]:
    """Return the pixels of points in the world, and the mask of points that can be shown.

    A rolling shutter reads a point when the row of its pixel is read.

    Args:
        camera: any camera but an orthographic one.
        points_m: the points, scene world.

    Returns:
        Pixels, also beyond the image, NaN where the mask is False.
    """
    if camera.shutter is None:
        return _project(camera, points_m, camera.world_from_camera.numpy())
    shutter = camera.shutter
    size = camera.height if shutter.is_along_rows else camera.width
    axis = 1 if shutter.is_along_rows else 0
    low = min(shutter.first_share, shutter.last_share)
    high = max(shutter.first_share, shutter.last_share)
    shares = np.linspace(low, high, _NUM_SHARES)
    poses = shutter.world_from_camera_at(shares, camera.camera_from_world)
    projected = [_project(camera, points_m, pose) for pose in poses]
    pixels = np.stack([p for p, _ in projected])  # [S, N, 2]
    # Share at which the point's row is read, less the share of the pose: it falls with the share.
    read_shares = shutter.share_at(0.0, size) + pixels[..., axis] * (
        (shutter.share_at(float(size), size) - shutter.share_at(0.0, size)) / size
    )
    excess = np.clip(read_shares, low, high) - shares[:, None]
    with np.errstate(invalid="ignore"):
        last = np.clip((excess > 0).sum(0) - 1, 0, _NUM_SHARES - 2)
    number = np.arange(len(points_m))
    before = excess[last, number]
    after = excess[last + 1, number]
    span = before - after
    part = np.clip(before / np.where(np.abs(span) > 0, span, 1.0), 0.0, 1.0)[:, None]
    out = (1 - part) * pixels[last, number] + part * pixels[last + 1, number]
    return out, ~np.isnan(out[:, 0])


def _project(
    camera: Camera, points_m: Float64[np.ndarray, "N 3"], world_from_camera: np.ndarray
) -> tuple[Float64[np.ndarray, "N 2"], Bool[np.ndarray, " N"]]:
    """Return the pixels of points seen from a pose, NaN where they cannot be shown, and the mask of
    points that can.

    Args:
        camera: the camera, whose pose does not count.
        points_m: the points, scene world.
        world_from_camera: the pose.
    """
    local = (points_m - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    pixels = project_local(camera, local)
    return pixels, ~np.isnan(pixels[:, 0])


def project_local(
    camera: Camera, local_m: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 2"]:
    """Return the pixels of points in the camera's axes, NaN where they cannot be shown.

    Args:
        camera: any camera but an orthographic one; a shutter does not count.
        local_m: the points, metres.
    """
    if camera.lens is not None:
        return camera.lens.project(local_m, camera.intrinsics)[0]
    is_ahead = local_m[:, 2] >= MIN_DEPTH_M
    z = np.where(is_ahead, local_m[:, 2], np.nan)[:, None]
    return local_m[:, :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy)
