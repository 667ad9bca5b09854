"""Losses that train the colour mapping network (ClimateGS, "Joint Training Strategy").

`augment.effects.style.train` calls the functions here. Y_o are the colours of a content scene or
photograph, I_o is its picture, I_s a style image, and R renders:

    Z_c = N(f_c(I_o)) Y_o          Y_o in content space (nGSCM)
    Y_s = S(f_s(I_s)) Z_c          the transferred colours (sGSCM)
    Z_s = N(f_c(R(Y_s))) Y_s       the transferred colours, taken back to content space
    Y_c = S(f_s(I_o)) Z_c          the colours that must equal Y_o

    L_con = |Z_c - Z_s| + |R(Z_c) - R(Z_s)|                                   eq. consistency
    L_cyc = |Y_c - Y_o| + |R(Y_c) - I_o|                                      eq. cycle
    L_s   = sum_i |mean phi_i(R(Y_s)) - mean phi_i(I_s)| + |deviation - deviation|   eq. style
    L     = L_s + lambda_con L_con + lambda_cyc L_cyc                         eq. total

The paper does not say which code takes Y_s back to content space. The code of the picture R(Y_s)
is used here: with the code of I_s, L_con would be the cycle loss of the style image. Norms are
means over colours and pixels, and over a layer's channels in L_s, so that no loss grows with the
number of Gaussians, pixels or channels. A map acts on the colour of a Gaussian's lowest band. On
the higher bands, which hold differences of colours, only its linear part acts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from augment.effects.style.network import IMAGENET_MEAN, IMAGENET_STD, fill_network
from augment.errors import StyleError
from augment.files.checkpoints import read_state_dict

# ---- Features of pictures: their means and deviations describe a picture's style -----------------
# With weights from the user these are the paper's layers of VGG-19, trained on ImageNet (Simonyan &
# Zisserman 2015). Otherwise a bank of fixed filters measures colours and contrasts at several
# scales. Both turn pictures [B, 3, H, W], display-encoded RGB about [0, 1], into layers
# [B, C, h, w].

# Layers of features, each [B, C, h, w].
Features = tuple[Tensor, ...]

# Output channels of the convolutions up to relu4_1, in blocks with a pooling between them.
_BLOCK_CHANNELS = ((64, 64), (128, 128), (256, 256, 256, 256), (512,))
# Layers whose outputs are the features, by torchvision's numbers.
_FEATURE_LAYERS = {1: "relu1_1", 6: "relu2_1", 11: "relu3_1", 20: "relu4_1"}
# Shortest side of a picture for VGG-19; three poolings leave one pixel of it.
MIN_SIDE_PX = 8


class Vgg19(nn.Module):
    """VGG-19 up to relu4_1, with frozen weights."""

    name = "VGG-19 relu1_1 to relu4_1"

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        num_inputs = 3
        for block_index, block_channels in enumerate(_BLOCK_CHANNELS):
            if block_index:
                layers.append(nn.MaxPool2d(2))
            for num_outputs in block_channels:
                layers += [nn.Conv2d(num_inputs, num_outputs, 3, padding=1), nn.ReLU()]
                num_inputs = num_outputs
        self.features = nn.Sequential(*layers)
        self.mean, self.deviation = (
            nn.Buffer(torch.tensor(values)[:, None, None], persistent=False)
            for values in (IMAGENET_MEAN, IMAGENET_STD)
        )
        self.requires_grad_(False)

    def forward(self, pictures: Tensor) -> Features:
        if min(pictures.shape[2:]) < MIN_SIDE_PX:
            raise ValueError(
                f"VGG-19 needs pictures of at least {MIN_SIDE_PX} px a side; "
                f"got {list(pictures.shape)}"
            )
        layer_input = (pictures - self.mean) / self.deviation
        features = []
        for number, layer in enumerate(self.features):
            layer_input = layer(layer_input)
            if number in _FEATURE_LAYERS:
                features.append(layer_input)
        return tuple(features)


# Opponent colours in RGB: luminance, red against green, blue against yellow.
_OPPONENT_DIRECTIONS = (
    (1 / math.sqrt(3), 1 / math.sqrt(3), 1 / math.sqrt(3)),
    (1 / math.sqrt(2), -1 / math.sqrt(2), 0.0),
    (1 / math.sqrt(6), 1 / math.sqrt(6), -2 / math.sqrt(6)),
)
# Directions of RGB space: opponent colours, channels and two of their differences. Deviations along
# six of them in general position determine a covariance.
_DIRECTIONS = (
    *_OPPONENT_DIRECTIONS,
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 1 / math.sqrt(2), -1 / math.sqrt(2)),
    (1 / math.sqrt(2), 0.0, -1 / math.sqrt(2)),
)
# Weights of the pyramid's blur, about a Gaussian of 1 px.
_BINOMIAL_WEIGHTS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
# Gain of edges. They vary less than colours do; with it both have about the same deviation.
_EDGE_GAIN = 2.0
# Number of levels of the Gaussian pyramid.
NUM_PYRAMID_LEVELS = 3


class FilterBank(nn.Module):
    """Bank of fixed filters of colours and edges, which needs no weights.

    It has the levels of a Gaussian pyramid (Burt & Adelson 1983) from half the picture's size on,
    and at each level a layer of colours and a layer of edges. Colours are the picture along eight
    directions of RGB space, three of them opponent colours. Edges are first derivatives of the
    opponent colours along x, y and both diagonals (of the steerable family, Freeman & Adelson
    1991). Rises and falls are separate channels, so that their means measure the contrast. A level
    after the first is left out if it has less than 4 px a side.
    """

    name = "bank of colour and edge filters"

    def __init__(self) -> None:
        super().__init__()
        self.directions = nn.Buffer(torch.tensor(_DIRECTIONS), persistent=False)
        self.blur = nn.Buffer(torch.tensor(_BINOMIAL_WEIGHTS), persistent=False)

    def forward(self, pictures: Float[Tensor, "B 3 H W"]) -> Features:
        features: list[Tensor] = []
        level = pictures
        for level_index in range(NUM_PYRAMID_LEVELS):
            level = self._halve(level)
            if level_index and min(level.shape[2:]) < 4:
                break
            colors = torch.einsum("kc,bchw->bkhw", self.directions.to(level.dtype), level)
            features.append(colors)
            if min(level.shape[2:]) >= 2:
                features.append(_edges(colors[:, :3]))
        return tuple(features)

    def _halve(self, x: Tensor) -> Tensor:
        """Return every second pixel of the blurred layer; borders are repeated."""
        channels = x.shape[1]
        kernel = self.blur.to(x.dtype)
        row_kernel = kernel.expand(channels, 1, 1, 5)
        x = F.conv2d(
            F.pad(x, (2, 2, 0, 0), "replicate"), row_kernel, stride=(1, 2), groups=channels
        )
        x = F.pad(x, (0, 0, 2, 2), "replicate")
        return F.conv2d(x, row_kernel.mT, stride=(2, 1), groups=channels)


def _edges(x: Tensor) -> Tensor:
    """Return rises and falls along four directions, per pixel, [B, 8 C, H - 1, W - 1]."""
    a = x[..., :-1, :-1]
    b = x[..., :-1, 1:]
    c = x[..., 1:, :-1]
    d = x[..., 1:, 1:]
    slopes = torch.cat(
        [(b + d - a - c) / 2, (c + d - a - b) / 2, (d - a) / math.sqrt(2), (c - b) / math.sqrt(2)],
        1,
    )
    return _EDGE_GAIN * torch.cat([slopes.relu(), (-slopes).relu()], 1)


FeatureExtractor = Vgg19 | FilterBank


def open_features(weights: Path | None) -> FeatureExtractor:
    """Return the feature extractor: VGG-19 with weights from a file, or the bank of filters.

    Args:
        weights: a .safetensors or .pth file that names its tensors as torchvision does; layers
            beyond relu4_1 are ignored. None for the bank of filters.

    Raises:
        StyleError: the file cannot be read, or a tensor is missing, has another shape or type, or
            is not finite; the message names it.
    """
    if weights is None:
        return FilterBank()
    network = Vgg19()
    hint = "expected torchvision's VGG-19 without batch normalisation (features.0.weight ...)"
    fill_network(network, read_state_dict(weights, StyleError), weights, hint)
    return network


# ---- Colours under maps, and distances -----------------------------------------------------------

# Variance added under the root, so that the deviation of a constant feature has a gradient.
MIN_VARIANCE = 1e-6


@dataclass(frozen=True, eq=False)
class GaussianColors:
    """Colours of Gaussians, display-encoded."""

    base: Float[Tensor, "B N 3"]
    """Colours of the lowest band, 0.5 + C0 sh_00."""

    bands: Float[Tensor, "B N L 3"]
    """Higher bands C0 sh_lm, with L = K - 1: their colours where a basis function equals C0."""

    def to(self, device: str | torch.device) -> GaussianColors:
        """Return the colours on the device."""
        return GaussianColors(self.base.to(device), self.bands.to(device))

    def mapped(self, maps: Float[Tensor, "B 3 4"]) -> GaussianColors:
        """Return the colours under maps, one map per item of the batch."""
        linear = maps[:, :, :3].mT  # rows of colours are mapped from the right
        bands = self.bands @ linear[:, None] if self.bands.shape[2] else self.bands
        return GaussianColors(self.base @ linear + maps[:, None, :, 3], bands)


def color_distance(first: GaussianColors, second: GaussianColors) -> Float[Tensor, ""]:
    """Return the mean absolute difference of the base colours plus that of the higher bands."""
    distance = (first.base - second.base).abs().mean()
    if first.bands.shape[2]:
        distance = distance + (first.bands - second.bands).abs().mean()
    return distance


def picture_distance(
    first: Float[Tensor, "B 3 H W"], second: Float[Tensor, "B 3 H W"]
) -> Float[Tensor, ""]:
    """Return the mean absolute difference of two batches of pictures."""
    return (first - second).abs().mean()


def style_loss(rendered: Features, style: Features) -> Float[Tensor, ""]:
    """Return the style loss L_s of two lists of features.

    The loss of a layer is the root mean square over its channels, averaged over B.

    Args:
        rendered: features of the styled pictures, each [B, C, h, w].
        style: features of the style images, layer by layer; their pictures may have another size.
    """
    total = rendered[0].new_zeros(())
    for rendered_layer, style_layer in zip(rendered, style, strict=True):
        for rendered_moment, style_moment in zip(
            moments(rendered_layer), moments(style_layer), strict=True
        ):
            total = (
                total
                + ((rendered_moment - style_moment).square().mean(1) + MIN_VARIANCE**2)
                .sqrt()
                .mean()
            )
    return total


def moments(feature: Float[Tensor, "B C H W"]) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation over the pixels, each [B, C]."""
    mean = feature.mean((2, 3))
    variance = (feature - mean[:, :, None, None]).square().mean((2, 3))
    return mean, (variance + MIN_VARIANCE).sqrt()


def weighted_sum(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Float[Tensor, ""]:
    """Return the sum of the terms, each times its weight."""
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum()
