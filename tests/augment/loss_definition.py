"""The torch definition of the loss of one view, which the kernels compute; differentiable."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from augment.reconstruct.config import LossWeights
from augment.reconstruct.loss import MIN_ALPHA, MIN_SKY
from augment.reconstruct.view import RecordedView
from augment.scene.cameras import Camera
from augment.scene.sky import sample_within_faces

RADIUS, SIGMA = 5, 1.5
C1, C2 = 0.01**2, 0.03**2


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
    below = (view.camera.ray_directions(dtype)[..., 2] < 0) & ~torch.from_numpy(view.sky)
    total = total + weights.ground * ((1 - alpha) * below).sum() / alpha.numel()
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
