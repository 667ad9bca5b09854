"""LPIPS: perceptual difference of two pictures, by the features of a network (Zhang et al. 2018).

This is version 0.1 of the metric, on AlexNet or VGG-16. The networks are described here, and their
weights come from files that the user has: nothing is downloaded. The first convolution in a file
shows which network it is for.

    heads v0.1     d = sum over layers of the mean over pixels of  w . (f(a) - f(b))^2
    f              the layer's features, each pixel's vector divided by its length
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from augment.errors import MetricError
from augment.files.checkpoints import read_state_dict

# SHIFT and SCALE apply to pictures in [-1, 1]; they are about ImageNet's means and deviations.
SHIFT = (-0.030, -0.088, -0.188)  # mean of red, green and blue, no unit
SCALE = (0.458, 0.448, 0.450)  # standard deviation of red, green and blue, no unit
_MIN_LENGTH = 1e-10  # length added to that of a feature vector, so that a zero vector stays zero


@dataclass(frozen=True)
class Conv:
    """A convolution followed by a ReLU."""

    index: int
    """Its number among torchvision's `features`."""
    channels: int
    """Number of its outputs."""
    kernel: int = 3
    """Side of its kernel."""
    stride: int = 1
    """Its stride."""
    padding: int = 1
    """Its padding."""


@dataclass(frozen=True)
class Architecture:
    """Convolutions of a network."""

    name: str
    """Name of the network."""
    slices: tuple[tuple[Conv, ...], ...]
    """Convolutions whose last output is compared, one slice after the other."""
    pools: tuple[int, ...]
    """Slices that begin with a max pooling of stride 2."""
    pool_px: int
    """Side of these poolings."""
    min_px: int
    """Smallest side of a picture."""


ALEX = Architecture(
    "alex",
    (
        (Conv(0, 64, 11, 4, 2),),
        (Conv(3, 192, 5, 1, 2),),
        (Conv(6, 384),),
        (Conv(8, 256),),
        (Conv(10, 256),),
    ),
    pools=(1, 2),
    pool_px=3,
    min_px=31,
)
VGG16 = Architecture(
    "vgg16",
    (
        (Conv(0, 64), Conv(2, 64)),
        (Conv(5, 128), Conv(7, 128)),
        (Conv(10, 256), Conv(12, 256), Conv(14, 256)),
        (Conv(17, 512), Conv(19, 512), Conv(21, 512)),
        (Conv(24, 512), Conv(26, 512), Conv(28, 512)),
    ),
    pools=(1, 2, 3, 4),
    pool_px=2,
    min_px=16,
)


class Lpips:
    """LPIPS of one network.

    Args:
        architecture: the network.
        weights: tensors by the names of `expected_shapes`, float32.
    """

    def __init__(self, architecture: Architecture, weights: Mapping[str, Tensor]) -> None:
        self.architecture = architecture
        self.name = architecture.name
        self._weights = dict(weights)

    @torch.no_grad()
    def __call__(
        self, a: Float[Tensor, "B 3 H W"], b: Float[Tensor, "B 3 H W"]
    ) -> Float[Tensor, " B"]:
        """Return the distance of each pair of display-encoded pictures in [0, 1]; 0 for equal ones.

        Raises:
            ValueError: shapes differ, or the pictures are too small for the network.
        """
        min_px = self.architecture.min_px
        if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3 or min(a.shape[2:]) < min_px:
            raise ValueError(
                f"pictures must be two of [B, 3, H, W] with H, W >= {min_px} for {self.name}; got "
                f"{list(a.shape)} and {list(b.shape)}"
            )
        total = torch.zeros(len(a))
        pairs = zip(self._features(a), self._features(b), strict=True)
        for number, (features_a, features_b) in enumerate(pairs):
            squared = (_normalised(features_a) - _normalised(features_b)) ** 2
            total += F.conv2d(squared, self._weights[_head(number)]).mean((1, 2, 3))
        return total

    def _features(self, pictures: Tensor) -> list[Tensor]:
        """Return the features of pictures, one tensor for each slice."""
        shift, scale = (torch.tensor(channels)[:, None, None] for channels in (SHIFT, SCALE))
        x = (2 * pictures.float() - 1 - shift) / scale
        features = []
        for number, convs in enumerate(self.architecture.slices):
            if number in self.architecture.pools:
                x = F.max_pool2d(x, self.architecture.pool_px, 2)
            for conv in convs:
                weight, bias = (self._weights[name] for name in _names(number, conv))
                x = F.relu(F.conv2d(x, weight, bias, conv.stride, conv.padding))
            features.append(x)
        return features


def picture_lpips(
    network: Lpips, picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None = None
) -> float:
    """Return the distance of two display-encoded pictures.

    Args:
        network: the metric.
        picture: floats [H, W, 3] in [0, 1].
        reference: floats [H, W, 3] in [0, 1].
        weight: bool [H, W]; where it is False the picture is replaced by the reference, so those
            pixels add nothing of their own. The mean stays one over the whole picture.

    Raises:
        ValueError: as Lpips.
    """
    if weight is not None:
        picture = np.where(weight[..., None], picture, reference)
    a, b = (
        torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
        for image in (picture, reference)
    )
    return float(network(a, b))


def load_lpips(weights: Path, heads: Path | None = None) -> Lpips:
    """Return LPIPS with weights from files: `.safetensors`, or state dicts that torch saved (.pth).

    Args:
        weights: the state dict of a whole `lpips.LPIPS(net="alex")` or `"vgg"`
            (`net.slice1.0.weight`, ..., `lin0.model.1.weight`, ...); or, with `heads`,
            torchvision's `alexnet` or `vgg16` (`features.0.weight`, ...; its classifier is left
            out).
        heads: LPIPS's own file of linear heads (`lin0.model.1.weight`, ...), version 0.1.

    Raises:
        MetricError: no such file, not one of these kinds, or tensors that are missing, of another
            shape or dtype, or not finite; says which.
    """
    tensors = read_state_dict(weights, MetricError)
    file_of_name = dict.fromkeys(tensors, weights)
    if heads is not None:
        head_tensors = read_state_dict(heads, MetricError)
        tensors = tensors | head_tensors
        file_of_name = file_of_name | dict.fromkeys(head_tensors, heads)
    architecture = _recognised(tensors, weights)
    from_torchvision = "features.0.weight" in tensors
    metric_tensors = {}
    for name, shape in expected_shapes(architecture).items():
        stored_name = _torchvision_name(name) if from_torchvision else name
        metric_tensors[name] = _checked(
            tensors.get(stored_name), stored_name, shape, file_of_name.get(stored_name, weights)
        )
    for name, expected in (("shift", SHIFT), ("scale", SCALE)):
        tensor = tensors.get(f"scaling_layer.{name}")
        if tensor is not None and not torch.allclose(
            tensor.flatten().float(), torch.tensor(expected)
        ):
            raise MetricError(
                f"{weights}: scaling_layer.{name} is {tensor.flatten().tolist()}; LPIPS 0.1 has "
                f"{list(expected)}"
            )
    return Lpips(architecture, metric_tensors)


def expected_shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the metric's tensors, by the names that `lpips.LPIPS` gives them."""
    shapes: dict[str, tuple[int, ...]] = {}
    channels = 3
    for number, convs in enumerate(architecture.slices):
        for conv in convs:
            weight, bias = _names(number, conv)
            shapes[weight] = (conv.channels, channels, conv.kernel, conv.kernel)
            shapes[bias] = (conv.channels,)
            channels = conv.channels
        shapes[_head(number)] = (1, channels, 1, 1)
    return shapes


def _names(number: int, conv: Conv) -> tuple[str, str]:
    """Return the names of a convolution's weight and bias."""
    base = f"net.slice{number + 1}.{conv.index}"
    return f"{base}.weight", f"{base}.bias"


def _head(number: int) -> str:
    """Return the name of a slice's linear head."""
    return f"lin{number}.model.1.weight"


def _torchvision_name(name: str) -> str:
    """Return the name that torchvision gives a tensor."""
    return f"features.{name.split('.', 2)[2]}" if name.startswith("net.") else name


def _normalised(features: Tensor) -> Tensor:
    """Return features with each pixel's vector divided by its length."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + _MIN_LENGTH)


def _recognised(tensors: Mapping[str, Tensor], path: Path) -> Architecture:
    """Return the architecture of the tensors of a file.

    Raises:
        MetricError: they are of no known network.
    """
    first_conv = tensors.get("net.slice1.0.weight", tensors.get("features.0.weight"))
    for architecture in (ALEX, VGG16):
        expected_shape = expected_shapes(architecture)["net.slice1.0.weight"]
        if first_conv is not None and tuple(first_conv.shape) == expected_shape:
            return architecture
    text = f"it is {list(first_conv.shape)}" if first_conv is not None else "there is none"
    raise MetricError(
        f"{path}: expected a first convolution net.slice1.0.weight (LPIPS) or features.0.weight "
        f"(torchvision) of AlexNet [64, 3, 11, 11] or VGG-16 [64, 3, 3, 3]; {text}. The file holds "
        f"{', '.join(list(tensors)[:4]) or 'nothing'}"
    )


def _checked(tensor: Tensor | None, name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """Return a tensor as float32.

    Raises:
        MetricError: it is missing, of another shape or dtype, or not finite.
    """
    if tensor is None:
        hint = ". The linear heads have a file of their own: name it too" * name.startswith("lin")
        raise MetricError(f"{path} lacks {name}, a tensor {list(shape)}{hint}")
    if tuple(tensor.shape) != shape or not tensor.dtype.is_floating_point:
        raise MetricError(
            f"{path}: {name} must be floats {list(shape)}; got {tensor.dtype} {list(tensor.shape)}"
        )
    if not bool(torch.isfinite(tensor).all()):
        raise MetricError(f"{path}: {name} holds NaN or infinite values")
    return tensor.float()
