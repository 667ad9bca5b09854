"""What the colour mapping network learns from (ClimateGS, "Joint Training Strategy").

Of a content scene or photograph Y_o, seen as the picture I_o, and a style image I_s:

    Z_c = N(f_c(I_o)) Y_o          Y_o in content space (nGSCM)
    Y_s = S(f_s(I_s)) Z_c          the transferred colours (sGSCM)
    Z_s = N(f_c(R(Y_s))) Y_s       what is transferred, taken back to content space
    Y_c = S(f_s(I_o)) Z_c          what is to be Y_o again

    L_con = |Z_c - Z_s| + |R(Z_c) - R(Z_s)|                                   eq. consistency
    L_cyc = |Y_c - Y_o| + |R(Y_c) - I_o|                                      eq. cycle
    L_s   = sum_i |mean phi_i(R(Y_s)) - mean phi_i(I_s)| + |deviation - deviation|   eq. style
    L     = L_s + lambda_con L_con + lambda_cyc L_cyc                         eq. total

The paper does not say which code takes Y_s back: that of its own render is taken here, since with
that of I_s L_con would be L_cyc again, of the style image. Norms are means over colours and pixels,
and over a layer's channels in L_s, so that no loss grows with the number of Gaussians, pixels or
channels. A map acts on Gaussians through their lowest band's colour; on the higher bands, which
hold differences of colours, with its linear part alone.
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

# ---- Features of pictures whose means and deviations say what a picture's style is ---------------
# The paper's layers of VGG-19, trained on ImageNet (Simonyan & Zisserman 2015), where the user has
# the weights; else a bank of fixed filters, which knows colours and contrasts at several scales.
# Both make of pictures [B, 3, H, W], display-encoded RGB about [0, 1], layers [B, C, h, w].

Features = tuple[Tensor, ...]

# Channels of the convolutions up to relu4_1, blocks parted by pooling; and the relus whose outputs
# are taken, by the numbers that torchvision gives them.
_BLOCKS = ((64, 64), (128, 128), (256, 256, 256, 256), (512,))
_TAKEN = {1: "relu1_1", 6: "relu2_1", 11: "relu3_1", 20: "relu4_1"}
MIN_SIDE_PX = 8  # three poolings leave one pixel of it


class Vgg19(nn.Module):
    """VGG-19 up to relu4_1, without gradients of its own."""

    name = "VGG-19 relu1_1 to relu4_1"

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for number, block in enumerate(_BLOCKS):
            if number:
                layers.append(nn.MaxPool2d(2))
            for out in block:
                layers += [nn.Conv2d(channels, out, 3, padding=1), nn.ReLU()]
                channels = out
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
        x = (pictures - self.mean) / self.deviation
        taken = []
        for number, layer in enumerate(self.features):
            x = layer(x)
            if number in _TAKEN:
                taken.append(x)
        return tuple(taken)


# Directions of RGB space. Deviations along six of them in general position determine a covariance:
# luminance, red against green and blue against yellow; then the channels and their differences.
_OPPONENT = (
    (1 / math.sqrt(3), 1 / math.sqrt(3), 1 / math.sqrt(3)),
    (1 / math.sqrt(2), -1 / math.sqrt(2), 0.0),
    (1 / math.sqrt(6), 1 / math.sqrt(6), -2 / math.sqrt(6)),
)
_DIRECTIONS = (
    *_OPPONENT,
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 1 / math.sqrt(2), -1 / math.sqrt(2)),
    (1 / math.sqrt(2), 0.0, -1 / math.sqrt(2)),
)
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)  # about a Gaussian of 1 px
_CONTRAST_GAIN = 2.0  # of edges, which vary less than colours do: about as much deviation


LEVELS = 3


class FilterBank(nn.Module):
    """Needs no weights: the levels of a Gaussian pyramid (Burt & Adelson 1983) from half the
    picture's size on, and at each a layer of colours and a layer of edges.

    Colours: the picture along eight directions of RGB space, three of them opponent colours. Edges:
    first derivatives along x, y and both diagonals (of the steerable family, Freeman & Adelson
    1991) of the opponent colours, their rises and falls apart, so that their means say how much
    contrast there is. A level after the first is left out where it has less than 4 px a side.
    """

    name = "bank of colour and edge filters"

    def __init__(self) -> None:
        super().__init__()
        self.directions = nn.Buffer(torch.tensor(_DIRECTIONS), persistent=False)
        self.blur = nn.Buffer(torch.tensor(_BINOMIAL), persistent=False)

    def forward(self, pictures: Float[Tensor, "B 3 H W"]) -> Features:
        taken: list[Tensor] = []
        level = pictures
        for number in range(LEVELS):
            level = self._halved(level)
            if number and min(level.shape[2:]) < 4:
                break
            colors = torch.einsum("kc,bchw->bkhw", self.directions.to(level.dtype), level)
            taken.append(colors)
            if min(level.shape[2:]) >= 2:
                taken.append(_edges(colors[:, :3]))
        return tuple(taken)

    def _halved(self, x: Tensor) -> Tensor:
        """Blurred, every second pixel; borders are repeated."""
        channels = x.shape[1]
        kernel = self.blur.to(x.dtype)
        across = kernel.expand(channels, 1, 1, 5)
        x = F.conv2d(F.pad(x, (2, 2, 0, 0), "replicate"), across, stride=(1, 2), groups=channels)
        x = F.pad(x, (0, 0, 2, 2), "replicate")
        return F.conv2d(x, across.mT, stride=(2, 1), groups=channels)


def _edges(x: Tensor) -> Tensor:
    """Rises and falls [B, 8 C, H - 1, W - 1] along four directions, over the same length each."""
    a = x[..., :-1, :-1]
    b = x[..., :-1, 1:]
    c = x[..., 1:, :-1]
    d = x[..., 1:, 1:]
    slopes = torch.cat(
        [(b + d - a - c) / 2, (c + d - a - b) / 2, (d - a) / math.sqrt(2), (c - b) / math.sqrt(2)],
        1,
    )
    return _CONTRAST_GAIN * torch.cat([slopes.relu(), (-slopes).relu()], 1)


FeatureExtractor = Vgg19 | FilterBank


def open_features(weights: Path | None) -> FeatureExtractor:
    """VGG-19 with weights from a .safetensors or .pth file that names them as torchvision does
    (layers beyond relu4_1 are left out), or the bank of filters where None is given.

    Raises:
        StyleError: the file cannot be read, or lacks a tensor, or it is of another shape or kind,
            or not finite; says which.
    """
    if weights is None:
        return FilterBank()
    network = Vgg19()
    hint = "expected torchvision's VGG-19 without batch normalisation (features.0.weight ...)"
    fill_network(network, read_state_dict(weights, StyleError), weights, hint)
    return network


# ---- Colours under maps, and distances -----------------------------------------------------------

MIN_VARIANCE = 1e-6  # under the root: a constant feature has a deviation with a gradient


@dataclass(frozen=True, eq=False)
class GaussianColors:
    """Colours of Gaussians. base [B, N, 3]: of the lowest band, display-encoded, 0.5 where it is 0.
    bands [B, N, K - 1, 3]: what the higher bands add, in the same unit at their basis functions'
    value of the lowest one's.
    """

    base: Float[Tensor, "B N 3"]
    bands: Float[Tensor, "B N L 3"]

    def to(self, device: str | torch.device) -> GaussianColors:
        """The same on the device."""
        return GaussianColors(self.base.to(device), self.bands.to(device))

    def mapped(self, maps: Float[Tensor, "B 3 4"]) -> GaussianColors:
        """The colours that maps, one an item, make of these."""
        linear = maps[:, :, :3].mT  # rows of colours are mapped from the right
        bands = self.bands @ linear[:, None] if self.bands.shape[2] else self.bands
        return GaussianColors(self.base @ linear + maps[:, None, :, 3], bands)


def color_distance(first: GaussianColors, second: GaussianColors) -> Float[Tensor, ""]:
    """Mean absolute difference of the base colours, plus that of the higher bands."""
    distance = (first.base - second.base).abs().mean()
    if first.bands.shape[2]:
        distance = distance + (first.bands - second.bands).abs().mean()
    return distance


def picture_distance(
    first: Float[Tensor, "B 3 H W"], second: Float[Tensor, "B 3 H W"]
) -> Float[Tensor, ""]:
    """Mean absolute difference."""
    return (first - second).abs().mean()


def style_loss(rendered: Features, style: Features) -> Float[Tensor, ""]:
    """L_s of two lists of features [B, C, h, w], layer by layer; pictures may differ in size.

    A layer counts with the root mean square over its channels, averaged over B.
    """
    total = rendered[0].new_zeros(())
    for ours, theirs in zip(rendered, style, strict=True):
        for a, b in zip(moments(ours), moments(theirs), strict=True):
            total = total + ((a - b).square().mean(1) + MIN_VARIANCE**2).sqrt().mean()
    return total


def moments(feature: Float[Tensor, "B C H W"]) -> tuple[Tensor, Tensor]:
    """Mean and deviation [B, C] over the pixels."""
    mean = feature.mean((2, 3))
    variance = (feature - mean[:, :, None, None]).square().mean((2, 3))
    return mean, (variance + MIN_VARIANCE).sqrt()


def weighted_sum(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Return the weighted sum of the terms with a weight; the other terms may have any value.

    Raises:
        StyleError: there are none.
    """
    parts = [weights[name] * term for name, term in terms.items() if weights.get(name)]
    if not parts:
        raise StyleError(f"none of the losses {', '.join(terms)} weighs anything: {weights}")
    return torch.stack(parts).sum()
