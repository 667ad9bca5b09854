"""The loss of one view in plain torch: differentiable, float64-capable, the kernels' definition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from augment.cameras import Camera
from augment.reconstruct.config import LossWeights
from augment.reconstruct.view import RecordedView
from augment.sky import CubemapSky, Sky, directions_of_cubemap, sample_within_faces

# ---- The sky that a fit starts from, as a cube map, and what of it is sky at all -----------------

_SIZE = 512  # texels along a cube edge where the starting sky is no cube map
# Sines of elevations: what lies lower is no sky, also where the road falls; the horizon's colour.
_BELOW, _HAZE = -0.05, 0.15


def starting_sky(sky: Sky) -> np.ndarray:
    """float32 [6, R, R, 3]: a copy of a cube map, or any other sky sampled into one."""
    if isinstance(sky, CubemapSky):
        return sky.faces.float().numpy().copy()
    directions = directions_of_cubemap(_SIZE).float()
    return np.ascontiguousarray(sky.sample(directions).float().numpy())


def paint_below_horizon(faces: np.ndarray) -> np.ndarray:
    """Which texels are sky, bool [6 R R]; the others, below the horizon, get its mean colour.

    They are not learnt: a hole in the road must look wrong, not like road infinitely far away,
    which weather would uncover.
    """
    flat = faces.reshape(-1, 3)
    z = directions_of_cubemap(faces.shape[1]).reshape(-1, 3)
    z = torch.nn.functional.normalize(z, dim=1)[:, 2].numpy()
    horizon = (z >= 0) & (z < _HAZE)
    flat[z < _BELOW] = flat[horizon if horizon.any() else z >= 0].mean(0, dtype=np.float64)
    return z >= _BELOW


RADIUS, SIGMA = 5, 1.5
C1, C2 = 0.01**2, 0.03**2
MIN_SKY = 1e-3  # less of the sky shows at most a quarter of an 8-bit step
MIN_ALPHA = 0.05


@dataclass(frozen=True, eq=False)
class ReferenceLoss:
    """Scalars with a graph; see `loss.ViewLoss` for each."""

    total: Tensor
    l1: Tensor
    ssim: Tensor
    depth: Tensor
    sky: Tensor


def reference_picture(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    sky_faces: Float[Tensor, "6 R R 3"],
    color_map: Float[Tensor, "3 4"],
    *,
    least_sky: float = 0.0,
) -> Float[Tensor, "H W 3"]:
    """color_map(rgb + (1 - alpha) sky(direction)); no sky where 1 - alpha < least_sky."""
    through = 1 - alpha
    sky = sample_within_faces(sky_faces, camera.ray_directions(rgb.dtype))
    sky = torch.where((through >= least_sky)[..., None], sky, torch.zeros_like(sky))
    return (rgb + through[..., None] * sky) @ color_map[:, :3].T + color_map[:, 3]


def ssim_map(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """SSIM (Wang et al. 2004) of every pixel and channel, windows as in 3D Gaussian splatting."""
    ticks = torch.arange(-RADIUS, RADIUS + 1, dtype=x.dtype)
    bell = torch.exp(-(ticks**2) / (2 * SIGMA**2))
    window = torch.outer(bell / bell.sum(), bell / bell.sum())[None, None]

    def blur(image: Tensor) -> Tensor:
        return conv2d(image.permute(2, 0, 1)[:, None], window, padding=RADIUS)[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    variance_x = blur(x * x) - mean_x**2
    variance_y = blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    below = (mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2)
    return (above / below).permute(1, 2, 0)


def reference_loss(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    expected_depth: Float[Tensor, "H W"],
    view: RecordedView,
    sky_faces: Float[Tensor, "6 R R 3"],
    color_map: Float[Tensor, "3 4"],
    weights: LossWeights,
) -> ReferenceLoss:
    """The loss of a render of `view.camera` against the view; the dtype is rgb's."""
    dtype = rgb.dtype
    x = reference_picture(rgb, alpha, view.camera, sky_faces, color_map, least_sky=MIN_SKY)
    weight = torch.from_numpy(view.weight).to(dtype)[..., None].expand_as(x)
    fixed = x.detach()
    x = torch.where(weight > 0, x, fixed)
    y = torch.where(weight > 0, torch.from_numpy(view.rgb).to(dtype) / 255, fixed)
    zero = x.new_zeros(())
    l1, ssim = zero, zero + 1
    if float(weight.sum()) > 0:
        l1 = (weight * (x - y).abs()).sum() / weight.sum()
        ssim = (weight * ssim_map(x, y)).sum() / weight.sum()
    depth = _depth_error(expected_depth, alpha, view) if weights.depth != 0 else zero
    sky = (alpha * torch.from_numpy(view.sky)).sum() / alpha.numel()
    total = (1 - weights.d_ssim) * l1 + weights.d_ssim * (1 - ssim) / 2
    total = total + weights.depth * depth + weights.sky * sky
    total = total + weights.surface * _transparency(alpha, view)
    return ReferenceLoss(total=total, l1=l1, ssim=ssim, depth=depth, sky=sky)


def _transparency(alpha: Tensor, view: RecordedView) -> Tensor:
    """Weighted mean of 1 - alpha over the depth priors; 0 without any."""
    weight = torch.from_numpy(view.depth_weight).to(alpha.dtype)
    if not bool(weight.sum() > 0):
        return alpha.new_zeros(())
    seen = alpha.reshape(-1)[torch.from_numpy(view.depth_pixels).long()]
    return ((1 - seen) * weight).sum() / weight.sum()


def _depth_error(expected_depth: Tensor, alpha: Tensor, view: RecordedView) -> Tensor:
    """Mean |1/ED - 1/z| over the view's priors, 0 where alpha <= MIN_ALPHA."""
    pixels = torch.from_numpy(view.depth_pixels).long()
    weight = torch.from_numpy(view.depth_weight).to(expected_depth.dtype)
    if float(weight.sum()) <= 0:
        return expected_depth.new_zeros(())
    expected = expected_depth.reshape(-1)[pixels]
    prior = torch.from_numpy(view.depth_m).to(expected.dtype)
    counts = (alpha.reshape(-1)[pixels] > MIN_ALPHA) & (expected > 0) & (prior > 0)
    difference = torch.where(counts, 1 / torch.where(counts, expected, 1), 0) - torch.where(
        counts, 1 / torch.where(counts, prior, 1), 0
    )
    return (weight * difference.abs()).sum() / weight.sum()
