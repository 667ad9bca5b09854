"""GSCM: the style network, two linear colour maps whose middle matrix an encoder predicts.

Ke et al. 2023 and ClimateGS, "3D Gaussian Color Mapping". A colour c (a row) becomes c P T Q, with
P and Q trained and T = E(picture), k x k. The content stage (nGSCM, T = f_c of the content) takes
colours to a common space, the style stage (sGSCM, T = f_s of the style) from there to the style's.
Nothing in between is nonlinear, so each stage folds to a 3x4 map and both to one.

Two departures: c carries a homogeneous 1, so that maps move the mean (the paper's are 3x3). And T
starts at the transport between the picture's colour moments and a mean photo's; the encoder
predicts what to multiply it with.
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
from augment.jobs.atomic import write_atomic
from recipes.files import open_file

# ---- Encoders: pictures [B, 3, S, S], display-encoded, and small copies [B, 3, R, R] whose -------
# colour moments were carried to a mean photo's, become features [B, .width].

ENCODERS = ("small", "b0")
LOOKED_AT_PX = 32  # by the small encoder: the arrangement of colours, not the detail
SMALL_CHANNELS = (16, 32, 64, 96, 96)
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
B0_WIDTH = 1280


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

    path: .safetensors, or a state dict that torch saved, with torchvision's names
    (`efficientnet_b0`), lukemelas' (`efficientnet-b0`) or MONAI's; its classifier is left out.

    Raises:
        StyleError: the file cannot be read, or is not of this network.
    """
    found = read_state_dict(path, StyleError, wrapped_in=("state_dict", "model"))
    weights = {name.removeprefix("module."): value for name, value in found.items()}
    fill_network(
        encoder.net,
        weights,
        path,
        "give torchvision's efficientnet_b0 or lukemelas' efficientnet-b0",
        names=_names_in_file(list(encoder.net.state_dict()), weights),
    )


def _names_in_file(own: Sequence[str], weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Each of MONAI's names to the file's, whichever of the three schemes that has.

    MONAI numbers a block by its stack and over all (`_blocks.1.2`: the second stack's second),
    lukemelas over all alone (`_blocks.2`). torchvision's layers have other names (`features.2.1`)
    in the same order.
    """
    if "_conv_stem.weight" in weights:
        by_stack = "_blocks.0.0._depthwise_conv.weight" in weights
        return {n: n if by_stack else re.sub(r"^_blocks\.\d+", "_blocks", n) for n in own}
    layers = {name.rpartition(".")[0] for name in weights if name.startswith("features.")}
    numbered = sorted(layers, key=lambda name: [int(n) for n in re.findall(r"\d+", name)])
    ours = dict.fromkeys(name.rpartition(".")[0] for name in own)
    theirs = dict(itertools.zip_longest(ours, numbered[: len(ours)], fillvalue="features.?"))
    return {n: f"{theirs[n.rpartition('.')[0]]}.{n.rpartition('.')[2]}" for n in own}


def fill_network(
    net: nn.Module,
    tensors: Mapping[str, Tensor],
    path: Path,
    hint: str,
    *,
    names: Mapping[str, str] | None = None,
) -> None:
    """Load the tensors of the file `path`, in any float. names: the file's, of each of the net's.

    Raises:
        StyleError: one is missing, of another shape or kind, or not finite; hint: what to do.
    """
    filled: dict[str, Tensor] = {}
    for own, value in net.state_dict().items():
        name = own if names is None else names[own]
        given = tensors.get(name, value if name.endswith("num_batches_tracked") else None)
        floats = value.is_floating_point()
        if given is None or given.shape != value.shape or given.is_floating_point() != floats:
            got = "nothing" if given is None else f"{given.dtype} {list(given.shape)}"
            raise StyleError(
                f"{path}: {name!r} must be {value.dtype} {list(value.shape)}; got {got}; {hint}"
            )
        if not bool(torch.isfinite(given).all()):
            raise StyleError(f"{path}: {name!r} holds values that are not finite; {hint}")
        filled[own] = given.to(value.dtype)
    net.load_state_dict(filled)


# ---- A picture's colour moments, and the linear maps between them and a mean photo's -------------
# What a global linear map can do depends mostly on the colours' mean and covariance, which no stack
# of convolutions gives exactly, so encoders get them computed. The maps are symmetric and depend on
# one picture only, as the two stages of GSCM do.

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
    """Colour moments of B pictures, float32.

    The matrices act on colours as columns with a homogeneous 1 last.
    """

    features: Float[Tensor, "B F"]
    """MOMENT_FEATURES numbers a picture, about -3 to 3."""

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
        small = functional.adaptive_avg_pool2d(images, SMALL_PX)
        pixels = small.flatten(2)  # [B, 3, N]
        mean = pixels.mean(2)
        centred = pixels - mean[..., None]  # in float32 a difference of moments would be noise
        spread = (centred @ centred.transpose(1, 2)).double() / pixels.shape[2]
        mean = mean.double()
        covariance = spread + FLOOR_STD**2 * torch.eye(3).to(mean)
        reference_mean = torch.tensor(REFERENCE_MEAN).to(mean)
        reference = torch.tensor(REFERENCE_COVARIANCE).to(mean)
        forth, back = _transports(covariance, reference)
        normalise = _affine(forth, reference_mean - (forth @ mean[..., None])[..., 0])
        restore = _affine(back, mean - back @ reference_mean)
        matrix = normalise[:, :3, :3].float()
        normal = torch.einsum("bij,bjhw->bihw", matrix, small)
        normal = normal + normalise[:, :3, 3, None, None].float()
        features = torch.cat(
            [_moment_features(mean, covariance), _of_shape(normal), _levels(normal)], dim=1
        )
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


def _moment_features(
    mean: Float[Tensor, "B 3"], covariance: Float[Tensor, "B 3 3"]
) -> Float[Tensor, "B 9"]:
    """The picture's own mean (3) and root of the covariance (6)."""
    root, _ = _roots(covariance)
    upper = torch.triu_indices(3, 3, device=root.device)
    return torch.cat([4 * mean - 1.7, 8 * root[:, upper[0], upper[1]] - 0.7], dim=1).float()


def _of_shape(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B 9"]:
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


def _levels(normal: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B F"]:
    """Quantiles of the normalised channels (21), and for two pairs of them, near black and white,
    the gain and the offset that would spread them over what is displayed (12): most photos fill
    that range, so levels tell how far light or a camera moved a picture."""
    sample = normal[:, :, ::2, ::2].flatten(2).sort(dim=2).values
    places = [round(level * (sample.shape[2] - 1)) for level in LEVELS]
    # One by one: a list of places would be copied to a GPU, and waited for.
    levels = torch.stack([sample[:, :, place] for place in places], 2).clamp(-1, 2)  # [B, 3, L]
    features = [3 * (levels - 0.43).flatten(1)]
    for index in _PAIRED_LEVELS:
        low = levels[:, :, index]
        high = levels[:, :, -1 - index]
        gain = 1 / (high - low).clamp_min(0.25)
        features += [gain - 1.2, -gain * low]
    return torch.cat(features, dim=1)


SIZE_PX = 256  # of the pictures that the encoder is given
LATENT = 16  # the paper's k
HIDDEN = 96  # of the layer between features and T
HEAD_SCALE = 0.1  # of T, so that a step of the optimiser is a small step of the map


class Gscm(nn.Module):
    """The network. encoder: of ENCODERS.

    Raises:
        ValueError: no such encoder. StyleError: its library is not installed.
    """

    def __init__(self, encoder: str = "small") -> None:
        super().__init__()
        if encoder not in ENCODERS:
            raise ValueError(f"encoder must be one of {', '.join(ENCODERS)}; got {encoder!r}")
        self.encoder_name = encoder
        self.encoder = SmallEncoder() if encoder == "small" else B0Encoder()
        self.hidden = nn.Linear(self.encoder.width + MOMENT_FEATURES, HIDDEN)
        self.head = nn.Linear(HIDDEN, 2 * LATENT**2)
        self.direct = nn.Linear(MOMENT_FEATURES, 2 * LATENT**2, bias=False)
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
        """f_c and f_s: the content stage's T and the style stage's. images: in [0, 1]."""
        moments = image_moments(images)
        features = torch.cat([self.encoder(images, moments.normal), moments.features], dim=1)
        predicted = self.head(nn.functional.silu(self.hidden(features)))
        predicted = HEAD_SCALE * (predicted + self.direct(moments.features))
        content, style = predicted.unflatten(1, (2, LATENT, LATENT)).unbind(1)
        eye = torch.eye(LATENT, device=images.device)
        normalise, restore = self._lifted(moments)
        # Rows: the moments act first on the content and last on the style.
        return normalise @ (eye + content), (eye + style) @ restore

    def content_map(self, f_c: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """nGSCM, folded."""
        return (self.content_p @ f_c @ self.content_q).transpose(1, 2)

    def style_map(self, f_s: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """sGSCM, folded."""
        return (self.style_p @ f_s @ self.style_q).transpose(1, 2)

    def _lifted(self, moments: Moments) -> tuple[Float[Tensor, "B k k"], Float[Tensor, "B k k"]]:
        """The moments' maps of colours, as T's that leave the rest of the space alone."""
        eye, small = (torch.eye(n, device=self.basis.device) for n in (LATENT, 4))
        lift = self.basis.T  # [k, 4]
        maps = (moments.normalise, moments.restore)
        first, second = (eye + lift @ (m.transpose(1, 2) - small) @ lift.T for m in maps)
        return first, second


def compose(
    second: Float[Tensor, "*B 3 4"], first: Float[Tensor, "*B 3 4"]
) -> Float[Tensor, "*B 3 4"]:
    """The map that does `first`, then `second`."""
    matrix = second[..., :3] @ first[..., :3]
    offset = second[..., :3] @ first[..., 3:] + second[..., 3:]
    return torch.cat([matrix, offset], dim=-1)


def apply_map(
    maps: Float[Tensor, "B 3 4"], colors: Float[Tensor, "B *N 3"]
) -> Float[Tensor, "B *N 3"]:
    """Colours under their own map each, not clamped."""
    flat = colors.flatten(1, -2) @ maps[:, :, :3].transpose(1, 2) + maps[:, None, :, 3]
    return flat.view(colors.shape)


def gscm_map(
    net: Gscm, content: Float[Tensor, "B 3 S S"], style: Float[Tensor, "1 3 S S"]
) -> Float[Tensor, "3 4"]:
    """The one map of a scene and a style picture."""
    return compose(style_side(net, style), content_side(net, content))


def content_side(net: Gscm, content: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "3 4"]:
    """nGSCM of a scene, the same for every style; f_c is the mean over the scene's pictures."""
    with in_use(net):
        f_c, _ = net.encode(content)
        return net.content_map(f_c.mean(0, keepdim=True))[0]


def style_side(net: Gscm, style: Float[Tensor, "1 3 S S"]) -> Float[Tensor, "3 4"]:
    """sGSCM of a style picture, the same for every scene."""
    with in_use(net):
        _, f_s = net.encode(style)
        return net.style_map(f_s)[0]


@contextmanager
def one_thread() -> Iterator[None]:
    """torch computes in one thread, so that bits do not depend on how many there are."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def in_use(net: Gscm) -> Iterator[None]:
    """In one thread, without gradients, and not in training; afterwards as before."""
    training = net.training
    try:
        with one_thread(), torch.no_grad():
            net.eval()
            yield
    finally:
        net.train(training)


def _basis() -> Float[Tensor, "4 k"]:
    """Orthonormal rows of cosines (the DCT-II's first): a fixed start that mixes all of k."""
    place = (torch.arange(LATENT, dtype=torch.float64) + 0.5) * torch.pi / LATENT
    basis = torch.stack([torch.cos(row * place) for row in range(4)])
    return (basis / basis.norm(dim=1, keepdim=True)).float()


# ---- Networks in files: safetensors, whose one metadata entry is a header in JSON ----------------
# It says what the network is and, as `about`, how it was trained (free). Tensors may be stored in
# half precision; they are float32 in memory.

METADATA_KEY = "climategs.gscm"
SHIPPED = Path(__file__).parent / "checkpoints" / "gscm-small.safetensors"
_HEADER = {"format": 1, "k": LATENT, "offset": True, "moments": True, "size": SIZE_PX}
_WHAT_TO_DO = "give a file that `climategs style train` wrote, or none for the shipped network"


def save_network(path: Path, net: Gscm, about: Mapping[str, Any]) -> None:
    """Write the network whole or not at all. about: training facts, anything JSON can hold.

    Raises:
        StyleError: a weight is not finite. OutputError: the system refused.
    """
    tensors = {n: value.detach().cpu().contiguous() for n, value in net.state_dict().items()}
    for name, value in tensors.items():
        if not bool(torch.isfinite(value).all()):
            raise StyleError(f"{path}: {name!r} is not finite, so the network was not written")
    header = {**_HEADER, "encoder": net.encoder_name, "about": dict(about)}
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    write_atomic(path, save(tensors, {METADATA_KEY: text}))


def load_network(path: Path | None = None) -> Gscm:
    """Read a network, ready to use (`eval`); the shipped one by default.

    Raises:
        StyleError: there is no such file, or it is no network of this format.
    """
    path = SHIPPED if path is None else path
    header, tensors = _read(path, with_tensors=True)
    net = Gscm(header["encoder"])
    if extra := sorted(tensors.keys() - net.state_dict().keys()):
        raise StyleError(f"{path}: holds tensors of another network: {extra[:3]}; {_WHAT_TO_DO}")
    fill_network(net, tensors, path, _WHAT_TO_DO)
    return net.eval().requires_grad_(False)


def network_facts(path: Path | None = None) -> dict[str, Any]:
    """The header of a network's file: format, encoder, k, offset, moments, size, about.

    Raises:
        StyleError: as load_network, but for the tensors, which are not looked at.
    """
    return _read(SHIPPED if path is None else path, with_tensors=False)[0]


def _read(path: Path, *, with_tensors: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        with safe_open(path, framework="pt") as file:
            names = file.keys() if with_tensors else ()
            return _header(path, file.metadata()), {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise StyleError(
            f"{path}: the style network cannot be read: {error}; {_WHAT_TO_DO}"
        ) from error


def _header(path: Path, metadata: Mapping[str, str] | None) -> dict[str, Any]:
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        raise StyleError(f"{path}: no {METADATA_KEY!r} in the file's metadata; {_WHAT_TO_DO}")
    try:
        header = json.loads(text)
    except ValueError as error:
        raise StyleError(f"{path}: {METADATA_KEY!r} is not JSON: {error}; {_WHAT_TO_DO}") from error
    if not isinstance(header, dict):
        raise StyleError(f"{path}: {METADATA_KEY!r} must be an object; got {text[:60]}")
    for name, value in _HEADER.items():
        if header.get(name) != value:
            raise StyleError(
                f"{path}: {name} must be {value}; got {header.get(name)!r}: the file is of another "
                f"version of climategs; {_WHAT_TO_DO}"
            )
    if header.get("encoder") not in ENCODERS:
        raise StyleError(
            f"{path}: encoder must be one of {', '.join(ENCODERS)}; got {header.get('encoder')!r}"
        )
    return header
