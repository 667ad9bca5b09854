"""How well a map of colours from a content and a style picture does, on photographs.

Recoloured photos (see augment.effects.style.pairs) have a known right result:

    same   style: the recoloured photo itself
    half   style: the left half of the recoloured photo; colours: those of the right half
    below  the same with the upper half for the lower, which seldom has the same colours
    look   style: another photo under the same recolouring

Pairs of different photos have none; there the figures say what harm is done:

    gradient_ssim  SSIM of the magnitude of the grey picture's gradient, before and after
    oversaturated  share of pairs in which the pixels with a full channel are more, by OVERSATURATED
                   of all, than in the content and in the style
    conditioning   median of the matrices' condition numbers
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from augment.effects.style.losses import FeatureExtractor, style_loss
from augment.effects.style.network import Gscm, compose
from augment.effects.style.pairs import GREY, Recoloring, sample_recolorings
from augment.effects.style.scene_views import folded_pictures
from augment.effects.style.statistics import ColorStatistics, mkl_map, reinhard_map, statistics_of
from augment.effects.style.train import Draw, transfer_maps
from augment.metrics.image import ssim

OVERSATURATED = 0.2  # of the pixels
SATURATED = 254.5 / 255  # of a channel: displayed as full

# Contents and styles [3, H, W] each, in [0, 1], to the map of the content.
Method = Callable[[Float[Tensor, "3 H W"], Float[Tensor, "3 A B"]], Float[Tensor, "3 4"]]


@dataclass(frozen=True)
class PairScores:
    """Means of PSNR (dB) over recoloured photos."""

    same: float
    half: float
    below: float
    look: float


@dataclass(frozen=True)
class HarmScores:
    """Over pairs of different photos."""

    gradient_ssim: float
    oversaturated: float
    conditioning: float


def score_pairs(
    method: Method, photos: Float[Tensor, "P 3 S S"], *, repeats: int = 4, seed: int = 0
) -> PairScores:
    """Each photo under `repeats` recolourings, the same for the same seed."""
    cases = _cases(photos, repeats, seed)
    half = photos.shape[3] // 2
    found: dict[str, list[float]] = {name: [] for name in ("same", "half", "below", "look")}
    for photo, recolored, other in cases:
        for name, content, style, target in (
            ("same", photo, recolored, recolored),
            ("half", photo[:, :, half:], recolored[:, :, :half], recolored[:, :, half:]),
            ("below", photo[:, half:], recolored[:, :half], recolored[:, half:]),
            ("look", photo, other, recolored),
        ):
            found[name].append(_psnr_db(_shown(method(content, style), content), target))
    return PairScores(**{name: float(np.mean(values)) for name, values in found.items()})


def score_harm(method: Method, photos: Float[Tensor, "P 3 S S"], *, pairs: int = 400) -> HarmScores:
    """`pairs` pairs of different photos (all of them, where there are fewer)."""
    count = len(photos)
    every = [(a, b) for a in range(count) for b in range(count) if a != b]
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(every), generator=generator)[:pairs].tolist()
    gradients = [_gradient(photo) for photo in photos]
    saturated = [_saturated(torch.eye(3, 4), photo) for photo in photos]
    similar: list[float] = []
    oversaturated: list[bool] = []
    conditions: list[float] = []
    for content, style in (every[index] for index in chosen):
        color_map = method(photos[content], photos[style])
        shown = _shown(color_map, photos[content])
        similar.append(ssim(_gradient(shown), gradients[content]))
        got = _saturated(color_map, photos[content])
        beyond = got - max(saturated[content], saturated[style])
        oversaturated.append(beyond > OVERSATURATED)
        conditions.append(float(torch.linalg.cond(color_map[:, :3].double())))
    return HarmScores(
        float(np.mean(similar)), float(np.mean(oversaturated)), float(np.median(conditions))
    )


def least_squares_limit(
    photos: Float[Tensor, "P 3 S S"], *, offset: bool, repeats: int = 4
) -> float:
    """What no map can pass in `same`: the PSNR (dB) of the best 3x4, or 3x3, of each case."""
    found: list[float] = []
    for photo, recolored, _ in _cases(photos, repeats, 0):
        columns, wanted = photo.flatten(1).T.double(), recolored.flatten(1).T.double()
        if offset:
            columns = functional.pad(columns, (0, 1), value=1.0)
        solved = torch.linalg.lstsq(columns, wanted).solution.T.float()
        best = solved if offset else functional.pad(solved, (0, 1))
        found.append(_psnr_db(_shown(best, photo), recolored))
    return float(np.mean(found))


def network_method(net: Gscm) -> Method:
    """The network as a method; halves of pictures are squeezed to squares, as all are."""

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        size = (net.size, net.size)
        squares = [
            functional.interpolate(p[None], size, mode="bilinear", antialias=True)
            for p in (content, style)
        ]
        with torch.no_grad():
            f_c, f_s = net.encode(torch.cat(squares))
            return compose(net.style_map(f_s[1:]), net.content_map(f_c[:1]))[0]

    return mapped


def identity_method(
    content: Float[Tensor, "3 H W"], style: Float[Tensor, "3 A B"]
) -> Float[Tensor, "3 4"]:
    """No change at all."""
    return torch.eye(3, 4)


def closed_method(name: str, strength: float = 1.0) -> Method:
    """mkl or reinhard with the limits that recipes have, at a strength."""
    closed = {"mkl": mkl_map, "reinhard": reinhard_map}[name]

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        full = closed(_statistics(content), _statistics(style)).float()
        return torch.lerp(torch.eye(3, 4), full, strength)

    return mapped


def _statistics(picture: Float[Tensor, "3 H W"]) -> ColorStatistics:
    found = statistics_of(picture.flatten(1).T.numpy())
    assert found is not None  # every pixel weighs 1
    return found


def _cases(
    photos: Float[Tensor, "P 3 S S"], repeats: int, seed: int
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Photo, the photo recoloured, and another photo under the same recolouring."""
    count = len(photos)
    generator = torch.Generator().manual_seed(seed)
    cases: list[tuple[Tensor, Tensor, Tensor]] = []
    for repeat in range(repeats):
        all_of_them = sample_recolorings(count, generator)
        for index in range(count):
            one = slice(index, index + 1)
            look = Recoloring(all_of_them.maps[one], all_of_them.gamma[one], all_of_them.curve[one])
            other = photos[(index + 1 + repeat % (count - 1)) % count]
            photo = photos[index]
            cases.append((photo, look(photo[None])[0], look(other[None])[0]))
    return cases


def _shown(
    color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]
) -> Float[Tensor, "3 H W"]:
    mapped = torch.einsum("ij,jhw->ihw", color_map[:, :3], picture)
    return (mapped + color_map[:, 3, None, None]).clamp(0, 1)


def _psnr_db(got: Float[Tensor, "3 H W"], wanted: Float[Tensor, "3 H W"]) -> float:
    square = float((got - wanted).square().mean())
    return -10 * float(np.log10(max(square, 1e-6)))  # 60 dB at most: one black pair is no mean


def _saturated(color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]) -> float:
    """Share of the mapped picture's pixels that have a channel at its end, or beyond."""
    mapped = torch.einsum("ij,jhw->ihw", color_map[:, :3], picture)
    mapped = mapped + color_map[:, 3, None, None]
    return float((mapped > SATURATED).any(0).float().mean())


def _gradient(picture: Float[Tensor, "3 H W"]) -> np.ndarray:
    """float32 [H, W, 3]: the magnitude of the grey picture's central differences, three times."""
    grey = torch.einsum("c,chw->hw", torch.tensor(GREY), picture)
    padded = functional.pad(grey[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return torch.hypot(across, down)[..., None].expand(-1, -1, 3).numpy()


# --------------------------------------------------------------------------------------------------
# What the style network's training is worth, by the losses' own measures: for curves.
# They are defined on one fixed draw of contents and styles, so that networks can be compared.

DEFINITIONS = {
    "content_rmse": "root mean square difference of R(Z_c) and R(Z_s), in units of the deviation "
    "of R(Z_c): 0 where the content space knows nothing of the style; a space that was shrunk "
    "gains nothing",
    "restoration_psnr": "dB, of R(Y_c), clamped to [0, 1], against the original picture; mean over "
    "the pictures",
    "style_loss": "L_s of R(Y_s), clamped to [0, 1], against the style picture",
    "same, half, below, look": "PSNR, dB, of held-out photos in styles with a known right result "
    "(augment.effects.style.scores); mkl_* are the closed form's",
}


def score_training(net: Gscm, draw: Draw, features: FeatureExtractor) -> dict[str, float]:
    """The measures above, by name. The network's mode is as before afterwards."""
    training = net.training
    net.eval()
    try:
        with torch.no_grad():
            maps, rendered = transfer_maps(net, draw, through="picture")
            assert rendered is not None
            content, returned, cycled = (
                folded_pictures(draw.pictures, m)
                for m in (maps.content, maps.returned, maps.cycled)
            )
            deviation = content.std((2, 3), correction=0).mean(1)
            rmse = (content - returned).square().mean((1, 2, 3)).sqrt()
            return {
                "content_rmse": float((rmse / deviation.clamp_min(1e-6)).mean()),
                "restoration_psnr": _psnr(cycled.clamp(0, 1), draw.pictures),
                "style_loss": float(
                    style_loss(features(rendered.clamp(0, 1)), features(draw.styles))
                ),
            }
    finally:
        net.train(training)


def score_photos(net: Gscm, photos: Tensor, *, repeats: int = 2) -> dict[str, float]:
    """PSNR of photos uint8 [P, 3, S, S] with a known right result, and the closed form's beside it;
    nothing of fewer than two photos. The network is left in the mode for use.
    """
    if len(photos) < 2:
        return {}
    net = net.cpu().eval()
    pictures = photos.float() / 255
    ours = score_pairs(network_method(net), pictures, repeats=repeats)
    closed = score_pairs(closed_method("mkl"), pictures, repeats=repeats)
    return asdict(ours) | {f"mkl_{name}": value for name, value in asdict(closed).items()}


def _psnr(found: Tensor, wanted: Tensor) -> float:
    errors = (found - wanted).square().mean((1, 2, 3)).clamp_min(1e-6)  # 60 dB at most
    return float((-10 / math.log(10) * errors.log()).mean())
