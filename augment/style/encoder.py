"""Encoders: a picture to a vector of features, from which GSCM's matrices T are predicted.

Every encoder takes display-encoded pictures [B, 3, S, S] and small copies of them [B, 3, R, R]
whose colour moments were carried to a mean photo's, and returns [B, .width].
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from augment.errors import StyleError
from augment.files.checkpoints import read_state_dict

ENCODERS = ("small", "b0")
LOOKED_AT_PX = 32  # by the small encoder: the arrangement of colours, not the detail
SMALL_CHANNELS = (16, 32, 64, 96, 96)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
B0_WIDTH = 1280


def build_encoder(name: str) -> SmallEncoder | B0Encoder:
    """By name.

    Raises:
        ValueError: there is no such encoder.
        StyleError: its library is not installed.
    """
    if name == "small":
        return SmallEncoder()
    if name == "b0":
        return B0Encoder()
    raise ValueError(f"encoder must be one of {', '.join(ENCODERS)}; got {name!r}")


class SmallEncoder(nn.Module):
    """Five convolutions of stride 2 and a pooling of means and deviations; for the CPU."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 6
        for index, out in enumerate(SMALL_CHANNELS):
            stride = 1 if index == len(SMALL_CHANNELS) - 1 else 2
            layers += [nn.Conv2d(channels, out, 3, stride, 1), nn.GroupNorm(8, out), nn.SiLU()]
            channels = out
        self.layers = nn.Sequential(*layers)
        self.width = 2 * channels

    def forward(
        self, images: Float[Tensor, "B 3 S S"], normal: Float[Tensor, "B 3 R R"]
    ) -> Float[Tensor, "B W"]:
        pictures = (functional.adaptive_avg_pool2d(p, LOOKED_AT_PX) for p in (images, normal))
        features = self.layers(4 * (torch.cat(tuple(pictures), dim=1) - 0.43))
        deviations = (features.var((2, 3), correction=0) + 1e-6).sqrt()
        return torch.cat([features.mean((2, 3)), deviations], dim=1)


class B0Encoder(nn.Module):
    """EfficientNet-B0 (Tan and Le 2019), MONAI's; random weights until some are loaded."""

    def __init__(self) -> None:
        super().__init__()
        try:
            from monai.networks.nets.efficientnet import EfficientNetBN
        except ImportError as error:
            raise StyleError(
                "the encoder b0 is MONAI's EfficientNet, which is not installed: "
                "`pip install 'climategs[efficientnet]'`, or choose the encoder small"
            ) from error
        net = EfficientNetBN("efficientnet-b0", pretrained=False, num_classes=1)
        for classifier in ("_fc", "_dropout"):
            setattr(net, classifier, nn.Identity())
        self.net = net
        self.width = B0_WIDTH
        self.mean = nn.Buffer(torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.std = nn.Buffer(torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    def forward(
        self, images: Float[Tensor, "B 3 S S"], normal: Float[Tensor, "B 3 R R"]
    ) -> Float[Tensor, "B W"]:
        return self.net((images - self.mean) / self.std)


def load_imagenet_weights(encoder: B0Encoder, path: Path) -> None:
    """Fill EfficientNet-B0 with weights trained on ImageNet, from a file the user has.

    path: .safetensors, or a state dict that torch saved. Names are
    torchvision's (`efficientnet_b0`), lukemelas' (`efficientnet-b0`) or MONAI's; what belongs to
    the classifier is left out.

    Raises:
        StyleError: the file cannot be read, or is not of this network.
    """
    found = read_state_dict(path, StyleError, wrapped_in=("state_dict", "model"))
    weights = {name.removeprefix("module."): value for name, value in found.items()}
    own = encoder.net.state_dict()
    names = _names_in_file(own, weights)
    filled: dict[str, Tensor] = {}
    for name, value in own.items():
        given = weights.get(names[name])
        if given is None and name.endswith("num_batches_tracked"):
            given = value
        if given is None or given.shape != value.shape:
            received = "nothing" if given is None else f"a tensor {list(given.shape)}"
            raise StyleError(
                f"{path}: weights of EfficientNet-B0 hold {names[name]!r} as a tensor "
                f"{list(value.shape)}; got {received}. Give torchvision's efficientnet_b0 or "
                f"lukemelas' efficientnet-b0"
            )
        if not bool(torch.isfinite(given).all()):
            raise StyleError(f"{path}: {names[name]!r} holds values that are not finite")
        filled[name] = given.to(value.dtype)
    encoder.net.load_state_dict(filled)


def _names_in_file(own: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Each of MONAI's names to the file's, whichever of the three schemes that has.

    MONAI numbers a block by its stack and over all (`_blocks.1.2`: the second stack's second),
    lukemelas over all (`_blocks.2`), torchvision within its stack (`features.2.1`).
    """
    if "_blocks.0.0._depthwise_conv.weight" in weights:
        return {name: name for name in own}
    luke = "_conv_stem.weight" in weights
    names: dict[str, str] = {}
    first_of: dict[str, int] = {}
    for name in own:
        parts = name.split(".")
        if parts[0] != "_blocks":
            names[name] = name if luke else f"{_TORCHVISION_ENDS[parts[0]]}.{parts[1]}"
            continue
        _, stack, number, part, end = parts
        if luke:
            names[name] = f"_blocks.{number}.{part}.{end}"
            continue
        place = int(number) - first_of.setdefault(stack, int(number))
        inner = _TORCHVISION_FIRST if stack == "0" else _TORCHVISION_PARTS
        names[name] = f"features.{int(stack) + 1}.{place}.block.{inner[part]}.{end}"
    return names


_TORCHVISION_ENDS = {
    "_conv_stem": "features.0.0",
    "_bn0": "features.0.1",
    "_conv_head": "features.8.0",
    "_bn1": "features.8.1",
}
_TORCHVISION_PARTS = {
    "_expand_conv": "0.0",
    "_bn0": "0.1",
    "_depthwise_conv": "1.0",
    "_bn1": "1.1",
    "_se_reduce": "2.fc1",
    "_se_expand": "2.fc2",
    "_project_conv": "3.0",
    "_bn2": "3.1",
}
_TORCHVISION_FIRST = {  # the first stack expands nothing
    "_depthwise_conv": "0.0",
    "_bn1": "0.1",
    "_se_reduce": "1.fc1",
    "_se_expand": "1.fc2",
    "_project_conv": "2.0",
    "_bn2": "2.1",
}
