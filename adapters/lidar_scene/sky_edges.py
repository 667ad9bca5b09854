"""Splats that end at the sky line of recorded images.

A splat whose centre lies on a roof reaches over the roof's edge: it hides sky, and wires grow as
thick as a splat. Its standard deviations are shortened towards the sky, and only there: splats of a
wire stay long along it. The caller is `adapters.lidar_scene.beyond_beams`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.solid_views import SolidView, project_into
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians

_SKY_SHARE = 0.5  # share of sky from which a pixel is sky
_REACH = 1.5  # distance over the standard deviation up to which rows of splats hide the sky
_MIN_FACTOR = 0.2  # smallest part of a standard deviation that stays
_END_PARTS = (1.0, 0.5)  # parts of that distance that are looked at, from the far end inward
_HIDDEN_RATIO = 1.05  # depth over that of the known surface from which a splat is hidden
_HIDDEN_M = 0.5  # constant part of that, metres


class _SkyDistance(NamedTuple):
    """Distance of each of H x W pixels from the nearest pixel of sky."""

    distance_px: np.ndarray
    """Distance from the sky's edge, pixels, float32 [H, W]; below 0 in the sky."""
    right_px: np.ndarray
    """Columns to the nearest pixel of sky, int64 [H, W]."""
    down_px: np.ndarray
    """Rows to the nearest pixel of sky, int64 [H, W]."""


def trim_at_sky(gaussians: Gaussians, views: Sequence[SolidView]) -> Gaussians:
    """Return splats that do not reach into the sky of images that show their centres.

    Args:
        gaussians: splats of what stands still.
        views: recorded images with known depths.
    """
    points = gaussians.means.numpy().astype(np.float64)
    scales = gaussians.scales.numpy()
    factors = np.ones((len(points), 3), np.float32)
    for view in views:
        sky_distance = _measure_sky_distance(view.matte.sky_share)
        if sky_distance is None:
            continue
        camera = view.camera
        index, rows, columns, depth_m = project_into(camera, points)
        distance_px = sky_distance.distance_px[rows, columns]
        longest_px = camera.fx * scales[index].max(axis=1) / depth_m
        may_reach = (distance_px > 0) & (distance_px < 2 * _REACH * longest_px)
        if view.known_m is not None:
            known_m = view.known_m[rows, columns]
            may_reach &= depth_m < _HIDDEN_RATIO * known_m + _HIDDEN_M
        index = index[may_reach]
        rows = rows[may_reach]
        columns = columns[may_reach]
        toward = np.stack(
            [sky_distance.right_px[rows, columns], sky_distance.down_px[rows, columns]], axis=1
        )
        toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        axes_px = _project_axes(gaussians, index, view)
        parts2 = np.einsum("kij,ki->kj", axes_px, toward) ** 2  # [K, 3], px^2 towards the sky
        sigma2 = np.maximum(parts2.sum(axis=1), 1e-12)
        factor = np.minimum(1.0, distance_px[may_reach] / (_REACH * np.sqrt(sigma2)))
        factor = np.maximum(factor, _MIN_FACTOR)
        shortened = 1 - (1 - factor)[:, None] * parts2 / sigma2[:, None]
        factors[index] = np.minimum(factors[index], shortened)
    return dataclasses.replace(gaussians, scales=gaussians.scales * torch.from_numpy(factors))


def shorten_ends_in_sky(gaussians: Gaussians, views: Sequence[SolidView]) -> Gaussians:
    """Return splats without ends that images show as sky, wherever their centres are.

    Args:
        gaussians: splats of what stands still.
        views: recorded images.
    """
    points = gaussians.means.numpy().astype(np.float64)
    scales = gaussians.scales.numpy()
    axes = rotmat_from_quat(gaussians.quats).numpy() * scales[:, None, :]  # [N, 3, 3], metres
    factors = np.ones((len(points), 3), np.float32)
    two_longest = np.argsort(-scales, axis=1)[:, :2]
    number = np.arange(len(points))
    for view in views:
        is_sky = view.sure_sky
        if not is_sky.any():
            continue
        for axis in two_longest.T:
            offset = axes[number, :, axis]
            for part in _END_PARTS:
                for sign in (-1, 1):
                    index, rows, columns, _ = project_into(
                        view.camera, points + sign * part * _REACH * offset
                    )
                    index = index[is_sky[rows, columns]]
                    shorter = np.minimum(factors[index, axis[index]], np.float32(part / 2))
                    factors[index, axis[index]] = shorter
    return dataclasses.replace(gaussians, scales=gaussians.scales * torch.from_numpy(factors))


def _measure_sky_distance(sky_share: np.ndarray) -> _SkyDistance | None:
    """Return the distance of each pixel from the sky; None in an image without sky."""
    is_surface = (sky_share < _SKY_SHARE).astype(np.uint8)
    if is_surface.all():
        return None
    distance_px, labels = cv2.distanceTransformWithLabels(
        is_surface, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    sky_rows, sky_columns = np.nonzero(is_surface == 0)
    row_of_label = np.zeros(labels.max() + 1, np.int64)
    column_of_label = np.zeros(labels.max() + 1, np.int64)
    row_of_label[labels[sky_rows, sky_columns]] = sky_rows
    column_of_label[labels[sky_rows, sky_columns]] = sky_columns
    rows, columns = np.indices(sky_share.shape)
    return _SkyDistance(
        distance_px - np.float32(0.5),
        column_of_label[labels] - columns,
        row_of_label[labels] - rows,
    )


def _project_axes(gaussians: Gaussians, index: np.ndarray, view: SolidView) -> np.ndarray:
    """Return the standard deviations of splats along their axes, pixels, float64 [K, 2, 3].

    The second dimension is right and down, the third the splat's axes.

    Args:
        gaussians: the splats.
        index: int64 [K], numbers of those that count.
        view: the image.
    """
    chosen = torch.from_numpy(index)
    pose = view.camera.camera_from_world.numpy().astype(np.float64)
    x, y, z = pose[:3, :3] @ gaussians.means[chosen].numpy().T + pose[:3, 3:]
    axes = rotmat_from_quat(gaussians.quats[chosen]).numpy().astype(np.float64)
    axes = pose[:3, :3] @ (axes * gaussians.scales[chosen].numpy()[:, None, :])  # [K, 3, 3]
    right = view.camera.fx * (axes[:, 0] - (x / z)[:, None] * axes[:, 2]) / z[:, None]
    down = view.camera.fy * (axes[:, 1] - (y / z)[:, None] * axes[:, 2]) / z[:, None]
    return np.stack([right, down], axis=1)
