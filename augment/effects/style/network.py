"""GSCM: the style network, two linear colour maps whose middle matrix an encoder predicts.

Pictures of a scene and of a style come in, one colour map [3, 4] goes out (`gscm_map`).
`augment.effects.style.style` applies the network, `augment.effects.style.train` trains it.

The network is that of Ke et al. 2023 and of ClimateGS, "3D Gaussian Color Mapping". A colour c (a
row) becomes c P T Q. P and Q are trained, and T = E(picture) is a k x k matrix from an encoder E.
The content stage (nGSCM, T = f_c of the content) takes colours to a common space. The style stage
(sGSCM, T = f_s of the style) takes them from there to the style's colours. Nothing in between is
nonlinear, so each stage folds to a 3 x 4 map, and both fold to one.

There are two differences from the paper. c carries a homogeneous 1, so that maps move the mean (the
paper's are 3 x 3). T starts at the transport between the picture's colour moments and those of a
mean photo, and the encoder predicts the matrix that it is multiplied with.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from augment.errors import StyleError
from augment.files.checkpoints import read_state_dict
from augment.output.atomic import write_atomic
from recipes.files import open_file

# ---- Encoders ------------------------------------------------------------------------------------
# An encoder takes display-encoded pictures [B, 3, S, S] and small copies [B, 3, R, R] of them with
# the colour moments of a mean photo. It returns features [B, encoder.width].

# Names of the encoders.
ENCODERS = ("small", "b0")
# Side of the pictures in the small encoder: it sees the arrangement of colours, not the detail.
SMALL_ENCODER_PX = 32
# Output channels of the small encoder's convolutions.
SMALL_CHANNELS = (16, 32, 64, 96, 96)
# Mean colour of ImageNet's pictures, which pretrained networks subtract.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
# Standard deviation of ImageNet's pictures, which pretrained networks divide by.
IMAGENET_STD = (0.229, 0.224, 0.225)
# Number of features of EfficientNet-B0.
B0_WIDTH = 1280


class SmallEncoder(nn.Module):
    """Small encoder for the CPU: five convolutions and a pooling of means and deviations."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        num_inputs = 6
        for index, num_outputs in enumerate(SMALL_CHANNELS):
            stride = 1 if index == len(SMALL_CHANNELS) - 1 else 2
            layers += [
                nn.Conv2d(num_inputs, num_outputs, 3, stride, 1),
                nn.GroupNorm(8, num_outputs),
                nn.SiLU(),
            ]
            num_inputs = num_outputs
        self.layers = nn.Sequential(*layers)
        self.width = 2 * num_inputs

    def forward(
        self, images: Float[Tensor, "B 3 S S"], normal: Float[Tensor, "B 3 R R"]
    ) -> Float[Tensor, "B W"]:
        pictures = (functional.adaptive_avg_pool2d(p, SMALL_ENCODER_PX) for p in (images, normal))
        features = self.layers(4 * (torch.cat(tuple(pictures), dim=1) - 0.43))
        deviations = (features.var((2, 3), correction=0) + 1e-6).sqrt()
        return torch.cat([features.mean((2, 3)), deviations], dim=1)


class B0Encoder(nn.Module):
    """EfficientNet-B0 (Tan and Le 2019) of MONAI, with random weights until some are loaded."""

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
    """Fill EfficientNet-B0 with weights trained on ImageNet, from a file of the user.

    Args:
        encoder: the network to fill; its classifier has no weights.
        path: a .safetensors file or a state dict that torch saved, with the names of torchvision
            (`efficientnet_b0`), of lukemelas (`efficientnet-b0`) or of MONAI.

    Raises:
        StyleError: the file cannot be read, or is not of this network.
    """
    file_weights = read_state_dict(path, StyleError, wrapped_in=("state_dict", "model"))
    weights = {name.removeprefix("module."): value for name, value in file_weights.items()}
    fill_network(
        encoder.net,
        weights,
        path,
        "give torchvision's efficientnet_b0 or lukemelas' efficientnet-b0",
        file_names=_names_in_file(list(encoder.net.state_dict()), weights),
    )


def _names_in_file(net_names: Sequence[str], weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Return the file's name of each tensor, by MONAI's name, for any of three naming schemes.

    MONAI numbers a block by its stack and within the network (`_blocks.1.2` is in the second
    stack). lukemelas numbers it within the network alone (`_blocks.2`). torchvision's layers have
    other names (`features.2.1`) in the same order.
    """
    if "_conv_stem.weight" in weights:
        is_by_stack = "_blocks.0.0._depthwise_conv.weight" in weights
        return {n: n if is_by_stack else re.sub(r"^_blocks\.\d+", "_blocks", n) for n in net_names}
    layer_names = {name.rpartition(".")[0] for name in weights if name.startswith("features.")}
    file_layers = sorted(layer_names, key=lambda name: [int(n) for n in re.findall(r"\d+", name)])
    net_layers = dict.fromkeys(name.rpartition(".")[0] for name in net_names)
    file_layer_of = dict(
        itertools.zip_longest(net_layers, file_layers[: len(net_layers)], fillvalue="features.?")
    )
    return {n: f"{file_layer_of[n.rpartition('.')[0]]}.{n.rpartition('.')[2]}" for n in net_names}


def fill_network(
    net: nn.Module,
    tensors: Mapping[str, Tensor],
    path: Path,
    hint: str,
    *,
    file_names: Mapping[str, str] | None = None,
) -> None:
    """Load a file's tensors, of any float type, into a network.

    Args:
        net: the network to fill.
        tensors: the tensors of the file, by their names there.
        path: the file, for error messages.
        hint: end of the error messages, which tells the user what to do.
        file_names: name in the file of each of the network's tensors; None for equal names.

    Raises:
        StyleError: a tensor is missing, has another shape or type, or is not finite.
    """
    state: dict[str, Tensor] = {}
    for net_name, net_value in net.state_dict().items():
        name = net_name if file_names is None else file_names[net_name]
        file_value = tensors.get(name, net_value if name.endswith("num_batches_tracked") else None)
        is_float = net_value.is_floating_point()
        if (
            file_value is None
            or file_value.shape != net_value.shape
            or file_value.is_floating_point() != is_float
        ):
            received = (
                "nothing" if file_value is None else f"{file_value.dtype} {list(file_value.shape)}"
            )
            raise StyleError(
                f"{path}: {name!r} must be {net_value.dtype} {list(net_value.shape)}; "
                f"got {received}; {hint}"
            )
        if not bool(torch.isfinite(file_value).all()):
            raise StyleError(f"{path}: {name!r} holds values that are not finite; {hint}")
        state[net_name] = file_value.to(net_value.dtype)
    net.load_state_dict(state)


# ---- A picture's colour moments, and the linear maps between them and a mean photo's -------------
# The best global linear map depends mostly on the colours' mean and covariance. No stack of
# convolutions gives them exactly, so they are computed for the network. The maps are symmetric and
# depend on one picture only, as the two stages of GSCM do.

# Mean colour of the mean photo: mean of 87 photos (kodak and open, 128 x 128).
REFERENCE_MEAN = (0.43, 0.43, 0.42)
# Covariance of the mean photo: mean of the covariances of the same 87 photos.
REFERENCE_COVARIANCE = ((0.046, 0.039, 0.033), (0.039, 0.041, 0.036), (0.033, 0.036, 0.038))
# Standard deviation added to every direction of colour; it bounds the gain of grey pictures.
FLOOR_STD = 0.012
# Side of the copy whose moments are taken; it is small because noise and detail are not wanted.
MOMENT_SIDE_PX = 64
# Quantiles of the channels that are features.
QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
# Indices of QUANTILES that are paired with the quantile as far from the other end.
_PAIRED_QUANTILES = (0, 1)
# Number of features that `image_moments` gives for a picture.
NUM_MOMENT_FEATURES = 18 + 3 * len(QUANTILES) + 6 * len(_PAIRED_QUANTILES)


@dataclass(frozen=True, eq=False)
class Moments:
    """Colour moments of B pictures, float32.

    The matrices act on colours as columns with a homogeneous 1 last.
    """

    features: Float[Tensor, "B F"]
    """NUM_MOMENT_FEATURES numbers per picture, about -3 to 3."""

    normal: Float[Tensor, "B 3 R R"]
    """Small copies of the pictures with the mean photo's moments."""

    normalise: Float[Tensor, "B 4 4"]
    """Maps from the picture's moments to the mean photo's."""

    restore: Float[Tensor, "B 4 4"]
    """Inverse of `normalise`."""


def image_moments(images: Float[Tensor, "B 3 H W"]) -> Moments:
    """Return the moments of display-encoded pictures, without gradients.

    The maps are optimal transports between Gaussian distributions of colours (Olkin and Pukelsheim
    1982): A = S^-1/2 (S^1/2 R S^1/2)^1/2 S^-1/2 for covariances S (of the picture) and R (of the
    mean photo).
    """
    with torch.no_grad():
        small_images = functional.adaptive_avg_pool2d(images, MOMENT_SIDE_PX)
        pixels = small_images.flatten(2)  # [B, 3, N]
        mean = pixels.mean(2)
        # The mean is subtracted first: in float32 a difference of moments would be noise.
        centred = pixels - mean[..., None]
        pixel_covariance = (centred @ centred.transpose(1, 2)).double() / pixels.shape[2]
        mean = mean.double()
        covariance = pixel_covariance + FLOOR_STD**2 * torch.eye(3).to(mean)
        reference_mean = torch.tensor(REFERENCE_MEAN).to(mean)
        reference_covariance = torch.tensor(REFERENCE_COVARIANCE).to(mean)
        normalising_matrix, restoring_matrix = _transports(covariance, reference_covariance)
        normalise = _affine(
            normalising_matrix, reference_mean - (normalising_matrix @ mean[..., None])[..., 0]
        )
        restore = _affine(restoring_matrix, mean - restoring_matrix @ reference_mean)
        matrix = normalise[:, :3, :3].float()
        normal = torch.einsum("bij,bjhw->bihw", matrix, small_images)
        normal = normal + normalise[:, :3, 3, None, None].float()
        features = torch.cat(
            [
                _moment_features(mean, covariance),
                _shape_features(normal),
                _quantile_features(normal),
            ],
            dim=1,
        )
        return Moments(features, normal, normalise.float(), restore.float())


def _transports(
    source: Float[Tensor, "B 3 3"], target: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3 3"]]:
    """Return the optimal transports between covariances, and their inverses."""
    root, inverse_root = _roots(source)
    middle, inverse_middle = _roots(root @ target @ root)
    return inverse_root @ middle @ inverse_root, root @ inverse_middle @ root


def _roots(
    matrices: Float[Tensor, "B 3 3"],
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3 3"]]:
    """Return the square roots of positive definite matrices, and their inverses."""
    values, vectors = torch.linalg.eigh(matrices)
    roots = values.clamp_min(1e-12).sqrt()[:, None, :]
    return (vectors * roots) @ vectors.transpose(1, 2), (vectors / roots) @ vectors.transpose(1, 2)


def _affine(matrix: Float[Tensor, "B 3 3"], offset: Float[Tensor, "B 3"]) -> Float[Tensor, "B 4 4"]:
    top = torch.cat([matrix, offset[..., None]], dim=2)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(top).expand(len(top), 1, 4)
    return torch.cat([top, last], dim=1)


def _moment_features(
    mean: Float[Tensor, "B 3"], covariance: Float[Tensor, "B 3 3"]
) -> Float[Tensor, "B 9"]:
    """Return the picture's mean (3) and the square root of its covariance (6), scaled."""
    root, _ = _roots(covariance)
    upper = torch.triu_indices(3, 3, device=root.device)
    return torch.cat([4 * mean - 1.7, 8 * root[:, upper[0], upper[1]] - 0.7], dim=1).float()


def _shape_features(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B 9"]:
    """Return features of the normalised picture, which a change of light hardly changes.

    They are the difference of the upper and the lower half (3), skewness (3) and kurtosis (3).
    """
    centred = normal - normal.mean((2, 3), keepdim=True)
    scaled = centred / centred.flatten(2).std(2).clamp_min(0.05)[..., None, None]
    half = scaled.shape[2] // 2
    upper_half = scaled[:, :, :half].mean((2, 3)) - scaled[:, :, half:].mean((2, 3))
    square = scaled * scaled
    skewness = (square * scaled).mean((2, 3)).clamp(-6, 6) / 2
    kurtosis = (square * square).mean((2, 3)).clamp(0, 40).log1p() - 1.4
    return torch.cat([upper_half, skewness, kurtosis], dim=1)


def _quantile_features(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B F"]:
    """Return quantiles of the normalised channels (21), and gains and offsets from them (12).

    A gain and an offset spread a pair of quantiles, near black and white, over the displayable
    range. Most photos fill that range, so they tell how far light or a camera moved a picture.
    """
    sorted_values = normal[:, :, ::2, ::2].flatten(2).sort(dim=2).values
    ranks = [round(level * (sorted_values.shape[2] - 1)) for level in QUANTILES]
    # The ranks are read one by one: a list of indices would be copied to a GPU, which waits.
    quantile_values = torch.stack([sorted_values[:, :, rank] for rank in ranks], 2).clamp(
        -1, 2
    )  # [B, 3, L]
    features = [3 * (quantile_values - 0.43).flatten(1)]
    for index in _PAIRED_QUANTILES:
        low = quantile_values[:, :, index]
        high = quantile_values[:, :, -1 - index]
        gain = 1 / (high - low).clamp_min(0.25)
        features += [gain - 1.2, -gain * low]
    return torch.cat(features, dim=1)


# Side of the pictures that the encoder takes.
SIZE_PX = 256
# Side of the matrix T, the paper's k.
LATENT_SIZE = 16
# Width of the layer between features and T.
HIDDEN_WIDTH = 96
# Scale of the predicted part of T, so that a step of the optimiser is a small step of the map.
HEAD_SCALE = 0.1


class Gscm(nn.Module):
    """Colour mapping network of two stages.

    Args:
        encoder: name of the encoder, one of ENCODERS.

    Raises:
        ValueError: there is no such encoder.
        StyleError: the encoder's library is not installed.
    """

    def __init__(self, encoder: str = "small") -> None:
        super().__init__()
        if encoder not in ENCODERS:
            raise ValueError(f"encoder must be one of {', '.join(ENCODERS)}; got {encoder!r}")
        self.encoder_name = encoder
        self.encoder = SmallEncoder() if encoder == "small" else B0Encoder()
        self.hidden = nn.Linear(self.encoder.width + NUM_MOMENT_FEATURES, HIDDEN_WIDTH)
        self.head = nn.Linear(HIDDEN_WIDTH, 2 * LATENT_SIZE**2)
        self.direct = nn.Linear(NUM_MOMENT_FEATURES, 2 * LATENT_SIZE**2, bias=False)
        for value in (self.head.weight, self.head.bias, self.direct.weight):
            nn.init.zeros_(value)
        basis = _basis()
        self.basis = nn.Buffer(basis)  # [4, k], orthonormal: how T holds a map of colours
        self.content_p = nn.Parameter(basis.clone())
        self.style_p = nn.Parameter(basis.clone())
        self.content_q = nn.Parameter(basis[:3].T.clone())
        self.style_q = nn.Parameter(basis[:3].T.clone())

    def encode(
        self, images: Float[Tensor, "B 3 S S"]
    ) -> tuple[Float[Tensor, "B k k"], Float[Tensor, "B k k"]]:
        """Return f_c and f_s, the T of the content stage and of the style stage.

        Args:
            images: display-encoded pictures in [0, 1].
        """
        moments = image_moments(images)
        features = torch.cat([self.encoder(images, moments.normal), moments.features], dim=1)
        predicted = self.head(nn.functional.silu(self.hidden(features)))
        predicted = HEAD_SCALE * (predicted + self.direct(moments.features))
        content, style = predicted.unflatten(1, (2, LATENT_SIZE, LATENT_SIZE)).unbind(1)
        eye = torch.eye(LATENT_SIZE, device=images.device)
        normalise, restore = self._lift(moments)
        # Rows: the moments act first on the content and last on the style.
        return normalise @ (eye + content), (eye + style) @ restore

    def content_map(self, f_c: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """Return the folded maps of the content stage, nGSCM."""
        return (self.content_p @ f_c @ self.content_q).transpose(1, 2)

    def style_map(self, f_s: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """Return the folded maps of the style stage, sGSCM."""
        return (self.style_p @ f_s @ self.style_q).transpose(1, 2)

    def _lift(self, moments: Moments) -> tuple[Float[Tensor, "B k k"], Float[Tensor, "B k k"]]:
        """Return the moments' maps as matrices T, which leave all other dimensions unchanged."""
        eye, eye4 = (torch.eye(n, device=self.basis.device) for n in (LATENT_SIZE, 4))
        lift = self.basis.T  # [k, 4]
        maps = (moments.normalise, moments.restore)
        first, second = (eye + lift @ (matrix.transpose(1, 2) - eye4) @ lift.T for matrix in maps)
        return first, second


def compose(
    second: Float[Tensor, "*B 3 4"], first: Float[Tensor, "*B 3 4"]
) -> Float[Tensor, "*B 3 4"]:
    """Return the map that applies `first`, then `second`."""
    matrix = second[..., :3] @ first[..., :3]
    offset = second[..., :3] @ first[..., 3:] + second[..., 3:]
    return torch.cat([matrix, offset], dim=-1)


def apply_map(
    maps: Float[Tensor, "B 3 4"], colors: Float[Tensor, "B *N 3"]
) -> Float[Tensor, "B *N 3"]:
    """Return colours under the map of their batch item, not clamped."""
    flat = colors.flatten(1, -2) @ maps[:, :, :3].transpose(1, 2) + maps[:, None, :, 3]
    return flat.view(colors.shape)


def gscm_map(
    net: Gscm, content: Float[Tensor, "B 3 S S"], style: Float[Tensor, "1 3 S S"]
) -> Float[Tensor, "3 4"]:
    """Return the map from a scene's pictures to a style picture."""
    return compose(style_side(net, style), content_side(net, content))


def content_side(net: Gscm, content: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "3 4"]:
    """Return nGSCM of a scene, which is the same for every style.

    f_c is the mean over the scene's pictures.
    """
    with inference(net):
        f_c, _ = net.encode(content)
        return net.content_map(f_c.mean(0, keepdim=True))[0]


def style_side(net: Gscm, style: Float[Tensor, "1 3 S S"]) -> Float[Tensor, "3 4"]:
    """Return sGSCM of a style picture, which is the same for every scene."""
    with inference(net):
        _, f_s = net.encode(style)
        return net.style_map(f_s)[0]


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread, so that bits do not depend on the number of threads."""
    num_threads_before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(num_threads_before)


@contextmanager
def inference(net: Gscm) -> Iterator[None]:
    """Use the network in evaluation mode, in one thread and without gradients.

    Its mode is restored afterwards.
    """
    was_training = net.training
    try:
        with one_thread(), torch.no_grad():
            net.eval()
            yield
    finally:
        net.train(was_training)


def _basis() -> Float[Tensor, "4 k"]:
    """Return orthonormal rows of cosines (the DCT-II's first), a start that mixes all of k."""
    phase = (torch.arange(LATENT_SIZE, dtype=torch.float64) + 0.5) * torch.pi / LATENT_SIZE
    basis = torch.stack([torch.cos(row * phase) for row in range(4)])
    return (basis / basis.norm(dim=1, keepdim=True)).float()


# ---- Networks in files: safetensors, whose one metadata entry is a header in JSON ----------------
# The header describes the network. Its entry `about` holds facts of the training, in any form.
# Tensors may be stored in half precision; they are float32 in memory.

# Key of the header in the file's metadata.
METADATA_KEY = "climategs.gscm"
# Network that comes with the package.
SHIPPED_CHECKPOINT = Path(__file__).parent / "checkpoints" / "gscm-small.safetensors"
# Entries that the header of every network of this version has.
_HEADER = {"format": 1, "k": LATENT_SIZE, "offset": True, "moments": True, "size": SIZE_PX}
# Advice at the end of error messages.
_HINT = "give a file that `climategs style train` wrote, or none for the shipped network"


def save_network(path: Path, net: Gscm, about: Mapping[str, Any]) -> None:
    """Write the network, complete or not at all.

    Args:
        path: the file to write.
        net: the network.
        about: facts of the training, anything that JSON can hold.

    Raises:
        StyleError: a weight is not finite.
        OutputError: the file cannot be written.
    """
    tensors = {n: value.detach().cpu().contiguous() for n, value in net.state_dict().items()}
    for name, value in tensors.items():
        if not bool(torch.isfinite(value).all()):
            raise StyleError(f"{path}: {name!r} is not finite, so the network was not written")
    header = {**_HEADER, "encoder": net.encoder_name, "about": dict(about)}
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    write_atomic(path, save(tensors, {METADATA_KEY: text}))


def load_network(path: Path | None = None) -> Gscm:
    """Return the network of a file, in evaluation mode; the shipped one by default.

    Raises:
        StyleError: there is no such file, or it is no network of this format.
    """
    path = SHIPPED_CHECKPOINT if path is None else path
    header, tensors = _read_checkpoint(path, with_tensors=True)
    net = Gscm(header["encoder"])
    if extra := sorted(tensors.keys() - net.state_dict().keys()):
        raise StyleError(f"{path}: holds tensors of another network: {extra[:3]}; {_HINT}")
    fill_network(net, tensors, path, _HINT)
    return net.eval().requires_grad_(False)


def network_facts(path: Path | None = None) -> dict[str, Any]:
    """Return the header of a network's file: format, encoder, k, offset, moments, size, about.

    Raises:
        StyleError: there is no such file, or its header is not of this format. The tensors are not
            checked.
    """
    return _read_checkpoint(SHIPPED_CHECKPOINT if path is None else path, with_tensors=False)[0]


def _read_checkpoint(path: Path, *, with_tensors: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the header of a network's file, and its tensors if they are wanted."""
    try:
        open_file(path).close()  # refuses a pipe, which safe_open would wait for
        with safe_open(path, framework="pt") as file:
            names = file.keys() if with_tensors else ()
            return _read_header(path, file.metadata()), {
                name: file.get_tensor(name) for name in names
            }
    except (OSError, SafetensorError) as error:
        raise StyleError(f"{path}: the style network cannot be read: {error}; {_HINT}") from error


def _read_header(path: Path, metadata: Mapping[str, str] | None) -> dict[str, Any]:
    """Return the checked header of a file with this metadata."""
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        raise StyleError(f"{path}: no {METADATA_KEY!r} in the file's metadata; {_HINT}")
    try:
        header = json.loads(text)
    except ValueError as error:
        raise StyleError(f"{path}: {METADATA_KEY!r} is not JSON: {error}; {_HINT}") from error
    if not isinstance(header, dict):
        raise StyleError(f"{path}: {METADATA_KEY!r} must be an object; got {text[:60]}")
    for name, value in _HEADER.items():
        if header.get(name) != value:
            raise StyleError(
                f"{path}: {name} must be {value}; got {header.get(name)!r}: the file is of another "
                f"version of climategs; {_HINT}"
            )
    if header.get("encoder") not in ENCODERS:
        raise StyleError(
            f"{path}: encoder must be one of {', '.join(ENCODERS)}; got {header.get('encoder')!r}"
        )
    return header
