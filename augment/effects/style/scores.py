"""How well a map of colours from a content and a style picture does, on photographs.

Recoloured photos (see augment.effects.style.pairs) have a known right result:

    same   style: the recoloured photo itself
    half   style: the left half of the recoloured photo; colours: those of the right half
    below  the same with the upper half for the lower, which seldom has the same colours
    look   style: another photo under the same recolouring

Pairs of different photos have none; of them counts how many come out oversaturated.
"""

from __future__ import annotations

import itertools
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
from augment.effects.style.pairs import Recoloring, sample_recolorings
from augment.effects.style.scene_views import folded_pictures
from augment.effects.style.statistics import mkl_map, reinhard_map, statistics_of
from augment.effects.style.train import Draw, transfer_maps

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
            found[name].append(
                _psnr_db(_mapped(method(content, style), content).clamp(0, 1), target)
            )
    return PairScores(**{name: float(np.mean(values)) for name, values in found.items()})


def oversaturated_share(
    method: Method, photos: Float[Tensor, "P 3 S S"], *, pairs: int = 400
) -> float:
    """Of `pairs` pairs of different photos (of all, where there are fewer): those in which the
    pixels with a full channel are more, by OVERSATURATED of all, than in content and style.
    """
    every = list(itertools.permutations(range(len(photos)), 2))
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(every), generator=generator)[:pairs].tolist()
    before = [_saturated(torch.eye(3, 4), photo) for photo in photos]
    beyond = [
        _saturated(method(photos[content], photos[style]), photos[content])
        - max(before[content], before[style])
        for content, style in (every[index] for index in chosen)
    ]
    return float(np.mean(np.array(beyond) > OVERSATURATED))


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


def closed_method(name: str, strength: float = 1.0) -> Method:
    """mkl or reinhard with the limits that recipes have, at a strength; 0 changes nothing."""
    closed = {"mkl": mkl_map, "reinhard": reinhard_map}[name]

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        pixels = (picture.flatten(1).T.numpy() for picture in (content, style))
        from_content, to_style = map(statistics_of, pixels)
        assert from_content is not None and to_style is not None  # every pixel weighs 1
        return torch.lerp(torch.eye(3, 4), closed(from_content, to_style).float(), strength)

    return mapped


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


def _mapped(
    color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]
) -> Float[Tensor, "3 H W"]:
    mapped = torch.einsum("ij,jhw->ihw", color_map[:, :3], picture)
    return mapped + color_map[:, 3, None, None]


def _psnr_db(got: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"]) -> float:
    square = float((got - target).square().mean())
    return -10 * float(np.log10(max(square, 1e-6)))  # 60 dB at most: one black pair is no mean


def _saturated(color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]) -> float:
    """Share of the mapped picture's pixels that have a channel at its end, or beyond."""
    return float((_mapped(color_map, picture) > SATURATED).any(0).float().mean())


# ---- What a training is worth by its own losses, on one fixed draw of contents and styles --------

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
            errors = (cycled.clamp(0, 1) - draw.pictures).square().mean((1, 2, 3)).clamp_min(1e-6)
            return {
                "content_rmse": float((rmse / deviation.clamp_min(1e-6)).mean()),
                "restoration_psnr": float((-10 / math.log(10) * errors.log()).mean()),
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
