"""Optical depth of the rays of a camera through any fog, plain or with banks, and fog on renders.

The optical depth through banks is that of plain fog times the banks' mean density along the ray,
from one table for a camera (`augment.render.fog_table`). Without banks the functions return what
`augment.render.fog` computes.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.render.buffers import AUTO, RenderOutput
from augment.render.fog import (
    Fog,
    apply_deferred_fog,
    optical_depth,
    optical_depth_numpy,
    sky_optical_depth,
)
from augment.render.fog_bank_kernels import FARTHEST_M
from augment.render.fog_table import image_means, point_means, point_means_numpy
from augment.scene.cameras import Camera


def image_optical_depth(
    fog: Fog, camera: Camera, depth: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return tau from the eye to what the pixels show.

    Args:
        fog: the fog.
        camera: camera of the image.
        depth: z of the pixels, finite, metres.
        backend: as in `image_means`.
    """
    distance = depth * camera.ray_lengths(depth.dtype, depth.device)
    eye_z_m = float(camera.centre[2])
    point_z_m = None
    if fog.scale_height_m is not None:
        point_z_m = eye_z_m + depth * camera.ray_directions(depth.dtype, depth.device)[..., 2]
    tau = optical_depth(fog, distance, eye_z_m, point_z_m)
    return tau if fog.banks is None else tau * image_means(fog, camera, depth, backend=backend)


def point_optical_depth(
    fog: Fog, camera: Camera, offsets: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B"]:
    """Return tau from the eye to points.

    Args:
        fog: the fog.
        camera: the camera.
        offsets: vectors from the eye to the points, in the world's axes, metres.
    """
    eye_z_m = float(camera.centre[2])
    tau = optical_depth(fog, offsets.norm(dim=-1), eye_z_m, eye_z_m + offsets[..., 2])
    return tau if fog.banks is None else tau * point_means(fog, camera, offsets)


def point_optical_depth_numpy(fog: Fog, camera: Camera, points_m: np.ndarray) -> np.ndarray:
    """Return tau from the eye to points [..., 3] in the scene's world, float64."""
    eye = camera.centre.numpy()
    distance = np.linalg.norm(points_m - eye, axis=-1)
    tau = optical_depth_numpy(fog, distance, eye[2], points_m[..., 2])
    return tau if fog.banks is None else tau * point_means_numpy(fog, camera, points_m)


def sky_ray_depth(
    fog: Fog, camera: Camera, directions: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B"]:
    """Return tau along rays that never end; banks farther than their table are its last mean.

    Args:
        fog: the fog.
        camera: the camera.
        directions: unit directions, in the world's axes.
    """
    tau = sky_optical_depth(fog, directions[..., 2], float(camera.centre[2]))
    if fog.banks is None:
        return tau
    return tau * point_means(fog, camera, directions * FARTHEST_M)


def sky_image_depth(
    fog: Fog, camera: Camera, slope: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return tau up to the sky in every pixel.

    Args:
        fog: the fog.
        camera: camera of the image.
        slope: vertical part of the unit direction of each pixel.
        backend: as in `image_means`.
    """
    tau = sky_optical_depth(fog, slope, float(camera.centre[2]))
    if fog.banks is None:
        return tau
    return tau * sky_image_means(fog, camera, slope, backend=backend)


def sky_image_means(
    fog: Fog, camera: Camera, like: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return the mean density of the banks up to the sky in every pixel.

    Args:
        fog: fog with banks.
        camera: camera of the image.
        like: an image of the type and device of the result.
        backend: as in `image_means`.
    """
    return image_means(fog, camera, torch.full_like(like, FARTHEST_M), backend=backend)


def plain_fog_depth(
    fog: Fog, camera: Camera, depth: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return the z at which plain uniform fog is as deep as this fog; for kernels of plain fog.

    Args:
        fog: uniform fog, or any without banks.
        camera: camera of the image.
        depth: z of the pixels, metres.
        backend: as in `image_means`.
    """
    if fog.banks is None:
        return depth
    assert fog.scale_height_m is None
    return depth * image_means(fog, camera, depth, backend=backend)


def fits_plain_kernels(fog: Fog) -> bool:
    """Return True if kernels of plain fog are right for this fog, with `plain_fog_depth`."""
    return fog.banks is None or fog.scale_height_m is None


def apply_fog_to_render(
    raster: RenderOutput, camera: Camera, fog: Fog, *, backend: str = AUTO
) -> Float[Tensor, "H W 3"]:
    """Return the colours of a render in deferred fog.

    Args:
        raster: render with colour, alpha and expected depth.
        camera: camera of the render.
        fog: the fog.
        backend: as in `image_means`.
    """
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    tau = image_optical_depth(fog, camera, raster.expected_depth, backend=backend)
    return apply_deferred_fog(raster.rgb, raster.alpha, tau, fog)
