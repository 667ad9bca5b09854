"""A picture's colour moments, and the linear maps between them and a mean photo's.

What a global linear map can do depends mostly on the mean and the covariance of the colours, which
no stack of convolutions gives exactly. So the encoders get them computed, and the maps that they
predict start at the transport of the picture's moments to a mean photo's (content stage) and back
(style stage). Both are symmetric and depend on one picture only, as the two stages of GSCM do.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

# Of 87 photos (kodak and open, 128 x 128): mean over photos of their colours' mean and covariance.
REFERENCE_MEAN = (0.43, 0.43, 0.42)
REFERENCE_COVARIANCE = ((0.046, 0.039, 0.033), (0.039, 0.041, 0.036), (0.033, 0.036, 0.038))
FLOOR_STD = 0.012  # added to every direction of colour: bounds the gain of grey pictures
SMALL_PX = 64  # side of the copy that moments are taken of: noise and detail are no colour
LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)  # quantiles of the channels
_PAIRED_LEVELS = (0, 1)  # of LEVELS, each with the one as far from the other end
MOMENT_FEATURES = 18 + 3 * len(LEVELS) + 6 * len(_PAIRED_LEVELS)


@dataclass(frozen=True, eq=False)
class Moments:
    """Of B pictures. features: float32 [B, MOMENT_FEATURES], about -3 to 3.

    normal: float32 [B, 3, R, R], the small copies with the mean photo's moments.
    normalise, restore: float32 [B, N, N] matrices of colours as columns: from the picture's moments
    to the mean photo's and the inverse; N = 4 (a homogeneous 1 last), or 3 without offset.
    """

    features: Float[Tensor, "B F"]
    normal: Float[Tensor, "B 3 R R"]
    normalise: Float[Tensor, "B N N"]
    restore: Float[Tensor, "B N N"]


def image_moments(images: Float[Tensor, "B 3 H W"], *, offset: bool) -> Moments:
    """Of display-encoded pictures. No gradient passes: pictures are given, not trained.

    The maps are optimal transports between Gaussian distributions of colours (Olkin and Pukelsheim
    1982): A = S^-1/2 (S^1/2 R S^1/2)^1/2 S^-1/2 for covariances S (of the picture) and R (of the
    mean photo). Without offset S and R are second moments about black, so that no mean is moved.
    """
    with torch.no_grad():
        small = functional.adaptive_avg_pool2d(images, SMALL_PX)
        pixels = small.flatten(2)  # [B, 3, N]
        mean = pixels.mean(2)
        centred = pixels - mean[..., None]  # in float32 a difference of moments would be noise
        spread = (centred @ centred.transpose(1, 2)).double() / pixels.shape[2]
        mean = mean.double()
        covariance = spread + FLOOR_STD**2 * torch.eye(3).to(mean)
        reference_mean = torch.tensor(REFERENCE_MEAN).to(mean)
        reference = torch.tensor(REFERENCE_COVARIANCE).to(mean)
        if not offset:
            about_black = reference + reference_mean[:, None] * reference_mean
            own = covariance + mean[:, :, None] * mean[:, None, :]
            normalise, restore = _transports(own, about_black)
        else:
            forth, back = _transports(covariance, reference)
            normalise = _affine(forth, reference_mean - (forth @ mean[..., None])[..., 0])
            restore = _affine(back, mean - back @ reference_mean)
        matrix = normalise[:, :3, :3].float()
        normal = torch.einsum("bij,bjhw->bihw", matrix, small)
        if offset:
            normal = normal + normalise[:, :3, 3, None, None].float()
        features = torch.cat([_own(mean, covariance), _of_shape(normal), _levels(normal)], dim=1)
        return Moments(features, normal, normalise.float(), restore.float())


def _transports(
    of: Float[Tensor, "B 3 3"], to: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3 3"]]:
    """The optimal transport between the covariances, and its inverse."""
    root, inverse_root = _roots(of)
    middle, inverse_middle = _roots(root @ to @ root)
    return inverse_root @ middle @ inverse_root, root @ inverse_middle @ root


def _roots(
    matrices: Float[Tensor, "B 3 3"],
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3 3"]]:
    """The square roots of positive definite matrices, and their inverses."""
    values, vectors = torch.linalg.eigh(matrices)
    root = values.clamp_min(1e-12).sqrt()[:, None, :]
    return (vectors * root) @ vectors.transpose(1, 2), (vectors / root) @ vectors.transpose(1, 2)


def _affine(matrix: Float[Tensor, "B 3 3"], offset: Float[Tensor, "B 3"]) -> Float[Tensor, "B 4 4"]:
    top = torch.cat([matrix, offset[..., None]], dim=2)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(top).expand(len(top), 1, 4)
    return torch.cat([top, last], dim=1)


def _own(mean: Float[Tensor, "B 3"], covariance: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 9"]:
    """The picture's own mean (3) and root of the covariance (6)."""
    root, _ = _roots(covariance)
    upper = torch.triu_indices(3, 3, device=root.device)
    return torch.cat([4 * mean - 1.7, 8 * root[:, upper[0], upper[1]] - 0.7], dim=1).float()


def _of_shape(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B 9"]:
    """Of the normalised picture, which a change of light hardly moves: what the upper half has
    above the lower (3), skewness (3), kurtosis (3)."""
    centred = normal - normal.mean((2, 3), keepdim=True)
    scaled = centred / centred.flatten(2).std(2).clamp_min(0.05)[..., None, None]
    half = scaled.shape[2] // 2
    upper_half = scaled[:, :, :half].mean((2, 3)) - scaled[:, :, half:].mean((2, 3))
    square = scaled * scaled
    skewness = (square * scaled).mean((2, 3)).clamp(-6, 6) / 2
    kurtosis = (square * square).mean((2, 3)).clamp(0, 40).log1p() - 1.4
    return torch.cat([upper_half, skewness, kurtosis], dim=1)


def _levels(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B F"]:
    """Quantiles of the normalised channels (21), and for two pairs of them, near black and white,
    the gain and the offset that would spread them over what is displayed (12): most photos fill
    that range, so levels tell how far light or a camera moved a picture."""
    sample = normal[:, :, ::2, ::2].flatten(2).sort(dim=2).values
    places = [round(level * (sample.shape[2] - 1)) for level in LEVELS]
    # One by one: a list of places would be copied to a GPU, and waited for.
    levels = torch.stack([sample[:, :, place] for place in places], 2).clamp(-1, 2)  # [B, 3, L]
    found = [3 * (levels - 0.43).flatten(1)]
    for index in _PAIRED_LEVELS:
        low, high = levels[:, :, index], levels[:, :, -1 - index]
        gain = 1 / (high - low).clamp_min(0.25)
        found += [gain - 1.2, -gain * low]
    return torch.cat(found, dim=1)
