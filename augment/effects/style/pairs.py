"""Pairs of a photo and a recoloured copy: what a style network learns from them, and how well it,
or a closed form, does on them.

A recolouring is a change of colours that a camera, a light or a weather makes: exposure, white
balance, contrast, saturation, hue, tint, gamma, a curve, an arbitrary linear part; some reach grey
and night. Put on a photo it gives a style whose perfect result is known; put on two photos, a look
that both share.

Errors of colours are logarithms of mean squares, as their figures are (dB): a pair that is nearly
right goes on counting. With N and S the folded stages of GSCM, x a photo, p its recolouring:

    same         S(p x) N(x) x = p x, and back
    half         the same, with the style from one half of the picture, the colours of the other
    look         S(p y) N(x) x = p x with y another photo, and back
    consistency  N(x) x = N(p x) p x: the paper's L_con
    cycle        S(x) N(x) x = x: the paper's L_cyc
    range        colours of photo x in the style of photo y that are not displayable

Scores are PSNR of same, half and look, and of below: the lower half in the style of the upper one,
which seldom has the same colours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from augment.effects.style.network import SIZE_PX, Gscm, apply_map, compose
from augment.effects.style.statistics import ColorStatistics, mkl_map, statistics_of

GREY = (0.2126, 0.7152, 0.0722)  # luma of sRGB's primaries (ITU-R BT.709)

MIXED_SHARE = 0.5  # of a batch's photos that share their square with another
VARIED = 0.3  # of a recolouring's settings: by how much photos are recoloured before all else


@dataclass(frozen=True)
class RecolorSettings:
    """How far recolourings go: standard deviations, and shares of those that take nearly all
    colour, or light, away.

    exposure, balance: log2 of the gains of all channels, of each. contrast, gamma, saturation: log.
    lift: of each channel. hue_rad: about the grey axis. mix: of the entries of a matrix. curve: of
    a tone curve's strength.
    """

    exposure: float = 0.22
    balance: float = 0.20
    contrast: float = 0.18
    gamma: float = 0.42
    lift: float = 0.07
    saturation: float = 0.38
    hue_rad: float = 0.30
    mix: float = 0.17
    curve: float = 0.90
    grey_share: float = 0.05
    night_share: float = 0.05


@dataclass(frozen=True, eq=False)
class Recoloring:
    """B recolourings: clamp(curve(M c^gamma + b)) with curve(c) = c + s (3 c^2 - 2 c^3 - c).

    maps: float32 [B, 3, 4], (M, b). gamma: float32 [B, 3], above 0. curve: float32 [B], s in
    (-1, 1).
    """

    maps: Float[Tensor, "B 3 4"]
    gamma: Float[Tensor, "B 3"]
    curve: Float[Tensor, "B"]

    def __call__(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Pictures in [0, 1], each under its recolouring, on the device where they lie."""
        maps, gamma, curve = (v.to(images.device) for v in (self.maps, self.gamma, self.curve))
        bent = images.clamp_min(1e-6) ** gamma[:, :, None, None]
        mapped = torch.einsum("bij,bjhw->bihw", maps[:, :, :3], bent)
        mapped = (mapped + maps[:, :, 3, None, None]).clamp(0, 1)
        smooth = mapped * mapped * (3 - 2 * mapped)
        return torch.lerp(mapped, smooth, curve[:, None, None, None])


class PairBatch(NamedTuple):
    """B photos, B others, and both under the same recolourings; float32 [B, 3, S, S] in [0, 1]."""

    photos: Float[Tensor, "B 3 S S"]
    recolored: Float[Tensor, "B 3 S S"]
    others: Float[Tensor, "B 3 S S"]
    others_recolored: Float[Tensor, "B 3 S S"]


def sample_recolorings(
    count: int, generator: torch.Generator, s: RecolorSettings = RecolorSettings()
) -> Recoloring:
    """The same for the same state of the generator."""

    def normal(*shape: int) -> Tensor:
        return torch.randn((count, *shape), generator=generator).clamp(-2.5, 2.5)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    exposure = s.exposure * normal()
    saturation = (s.saturation * normal()).exp()
    kind = torch.rand(count, generator=generator)
    grey = kind < s.grey_share
    night = (kind >= s.grey_share) & (kind < s.grey_share + s.night_share)
    saturation = torch.where(grey, uniform(0.0, 0.3), saturation)
    exposure = torch.where(night, uniform(-3.0, -1.5), exposure)
    gains = 2 ** (exposure[:, None] + s.balance * normal(3))
    gains = gains * torch.where(night[:, None], torch.tensor([0.8, 0.95, 1.25]), torch.ones(3))
    contrast = (s.contrast * normal()).exp()[:, None]
    # Contrast about the middle grey that the exposure makes, so that night stays night.
    middle = 0.43 * gains
    maps = torch.eye(3) + s.mix * normal(3, 3)
    maps = _about_grey(saturation, s.hue_rad * normal()) @ maps
    maps = (contrast * gains)[:, :, None] * maps
    lift = torch.where(night, 0.2, 1.0)[:, None] * s.lift * normal(3)
    offset = middle * (1 - contrast) + lift
    return Recoloring(
        torch.cat([maps, offset[..., None]], dim=2),
        (s.gamma * normal())[:, None].exp() * (0.3 * s.gamma * normal(3)).exp(),
        (s.curve * normal()).clamp(-0.9, 0.9),
    )


def recolor(
    images: Float[Tensor, "B 3 H W"], generator: torch.Generator
) -> Float[Tensor, "B 3 H W"]:
    """Every picture under a recolouring of its own."""
    return sample_recolorings(len(images), generator)(images)


def sample_pairs(
    photos: Float[Tensor, "P 3 H W"], generator: torch.Generator, batch: int, size_px: int
) -> PairBatch:
    """A batch from photos in [0, 1], on their device; the same for the same state of the CPU's
    generator.

    Photos are cut (half to all of each side), mirrored at random, and squeezed to size_px squares;
    every second one shares its square with another, and each is recoloured a little before all
    else. A hundred photos would be learnt by heart otherwise.

    Raises:
        ValueError: fewer than two photos, of which one could not be the other.
    """
    count = len(photos)
    if count < 2:
        raise ValueError(f"pairs need at least 2 photos; got {count}")
    first = torch.randint(count, (batch,), generator=generator)
    second = (first + torch.randint(1, count, (batch,), generator=generator)) % count
    recoloring = sample_recolorings(batch, generator)
    first = first.to(photos.device)
    second = second.to(photos.device)
    first_photos = _varied(_cut(photos[first], generator, size_px), generator)
    second_photos = _varied(_cut(photos[second], generator, size_px), generator)
    return PairBatch(
        first_photos, recoloring(first_photos), second_photos, recoloring(second_photos)
    )


def _varied(
    photos: Float[Tensor, "B 3 S S"], generator: torch.Generator
) -> Float[Tensor, "B 3 S S"]:
    """Half of the photos take a part, on the right or below, from the one before in the batch;
    then each is recoloured a little."""
    count, _, _, size = photos.shape
    place = torch.arange(size) + 0.5
    start = size * (0.3 + 0.4 * torch.rand((count, 1), generator=generator))
    beyond = (place > start)[:, None]  # [B, 1, S]
    below = (torch.rand((count, 1, 1), generator=generator) < 0.5).expand(-1, size, size)
    foreign = torch.where(below, beyond.transpose(1, 2), beyond)
    foreign = foreign & (torch.rand((count, 1, 1), generator=generator) < MIXED_SHARE)
    mixed = torch.where(foreign[:, None].to(photos.device), photos.roll(1, 0), photos)
    usual = vars(RecolorSettings()).items()
    small_settings = RecolorSettings(**{n: 0.0 if "share" in n else VARIED * v for n, v in usual})
    return sample_recolorings(count, generator, small_settings)(mixed)


def _about_grey(
    saturation: Float[Tensor, "B"], hue_rad: Float[Tensor, "B"]
) -> Float[Tensor, "B 3 3"]:
    """Turn colours about the grey axis, and scale their distance from it; grey stays as it is."""
    third = torch.full((3, 3), 1 / 3)
    cross = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / 3**0.5
    cos = hue_rad.cos()[:, None, None]
    sin = hue_rad.sin()[:, None, None]
    turned = third + cos * (torch.eye(3) - third) + sin * cross  # Rodrigues' formula
    luma = torch.tensor(GREY).expand(3, 3)
    return torch.lerp(luma.expand(len(saturation), 3, 3), turned, saturation[:, None, None])


def _cut(
    photos: Float[Tensor, "B 3 H W"], generator: torch.Generator, size_px: int
) -> Float[Tensor, "B 3 S S"]:
    count = len(photos)
    sides = 0.5 + 0.5 * torch.rand((count, 2), generator=generator)
    centres = (1 - sides) * (2 * torch.rand((count, 2), generator=generator) - 1)
    mirrored = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0] = sides[:, 0] * mirrored
    theta[:, 1, 1] = sides[:, 1]
    theta[:, :, 2] = centres
    theta = theta.to(photos.device)
    grid = functional.affine_grid(theta, [count, 3, size_px, size_px], align_corners=False)
    return functional.grid_sample(photos, grid, padding_mode="border", align_corners=False)


# ---- Losses of pairs -----------------------------------------------------------------------------

_ERROR_FLOOR = 1e-4  # mean square: nothing is gained beyond 40 dB
_STRIDE_PX = 2  # of the pixels whose colours are compared


# In their sum; that of the range is an option of the training.
PAIR_WEIGHTS = {"same": 1.0, "half": 0.5, "look": 1.0, "consistency": 1.0, "cycle": 1.0}


def pair_losses(net: Gscm, batch: PairBatch) -> dict[str, Float[Tensor, ""]]:
    """Each loss, by name, unweighted."""
    count, _, _, size = batch.photos.shape
    pictures = dict(zip(("x", "px", "y", "py"), batch, strict=True))
    # The left half's style on the right half's colours.
    halves = {
        f"{side}{name}": functional.interpolate(part, (size, size), mode="bilinear")
        for name in ("x", "px")
        for side, part in zip(
            "lr", pictures[name].split([size // 2, size - size // 2], 3), strict=True
        )
    }
    names = [*pictures, *halves]
    f_c, f_s = net.encode(torch.cat([*pictures.values(), *halves.values()]))
    normal = dict(zip(names, net.content_map(f_c).split(count), strict=True))
    style = dict(zip(names, net.style_map(f_s).split(count), strict=True))
    colors = {name: _colors(picture) for name, picture in pictures.items()}
    colors |= {name: _colors(halves[name]) for name in ("rx", "rpx")}

    def styled(content: str, by: str) -> Tensor:
        return apply_map(compose(style[by], normal[content]), colors[content])

    def error(content: str, by: str, target: str) -> Tensor:
        return _log_error(styled(content, by), colors[target])

    in_content_space = [apply_map(normal[name], colors[name]) for name in ("x", "px")]
    mixed = torch.cat([styled("x", "y"), styled("px", "y"), styled("x", "py")])
    return {
        "same": (error("x", "px", "px") + error("px", "x", "x")) / 2,
        "half": (error("rx", "lpx", "rpx") + error("rpx", "lx", "rx")) / 2,
        "look": (error("x", "py", "px") + error("px", "y", "x")) / 2,
        "consistency": (in_content_space[0] - in_content_space[1]).abs().mean(),
        "cycle": (styled("x", "x") - colors["x"]).abs().mean(),
        "range": ((mixed - 1).relu() + (-mixed).relu()).mean(),
    }


def _colors(pictures: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B N 3"]:
    return pictures[:, :, ::_STRIDE_PX, ::_STRIDE_PX].flatten(2).transpose(1, 2)


def _log_error(got: Float[Tensor, "B N 3"], target: Float[Tensor, "B N 3"]) -> Float[Tensor, ""]:
    """Mean log of the mean square, of what a display would show."""
    square = (got.clamp(0, 1) - target).square().mean((1, 2))
    return (square + _ERROR_FLOOR).log().mean()


# ---- Scores: a map of colours from a content and a style picture, on photographs -----------------

# Contents and styles [3, H, W] each, in [0, 1], to the map of the content.
Method = Callable[[Float[Tensor, "3 H W"], Float[Tensor, "3 A B"]], Float[Tensor, "3 4"]]
Closed = Callable[[ColorStatistics, ColorStatistics], Float[Tensor, "3 4"]]


def score_pairs(
    method: Method, photos: Float[Tensor, "P 3 S S"], *, repeats: int
) -> dict[str, float]:
    """Means of PSNR (dB) by name, of each photo under `repeats` recolourings, always the same."""
    count = len(photos)
    half = photos.shape[3] // 2
    generator = torch.Generator().manual_seed(0)
    scores: dict[str, list[float]] = {name: [] for name in ("same", "half", "below", "look")}
    for repeat in range(repeats):
        recolorings = sample_recolorings(count, generator)
        for index, photo in enumerate(photos):
            row = slice(index, index + 1)
            look = Recoloring(recolorings.maps[row], recolorings.gamma[row], recolorings.curve[row])
            recolored = look(photo[None])[0]
            other = look(photos[(index + 1 + repeat % (count - 1)) % count][None])[0]
            for name, content, style, target in (
                ("same", photo, recolored, recolored),
                ("half", photo[:, :, half:], recolored[:, :, :half], recolored[:, :, half:]),
                ("below", photo[:, half:], recolored[:, :half], recolored[:, half:]),
                ("look", photo, other, recolored),
            ):
                mapped = mapped_picture(method(content, style), content).clamp(0, 1)
                scores[name].append(_psnr_db(mapped, target))
    return {name: float(np.mean(values)) for name, values in scores.items()}


def network_method(net: Gscm) -> Method:
    """The network as a method; halves of pictures are squeezed to squares, as all are."""

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        squares = [
            functional.interpolate(p[None], (SIZE_PX, SIZE_PX), mode="bilinear", antialias=True)
            for p in (content, style)
        ]
        with torch.no_grad():
            f_c, f_s = net.encode(torch.cat(squares))
            return compose(net.style_map(f_s[1:]), net.content_map(f_c[:1]))[0]

    return mapped


def closed_method(closed: Closed = mkl_map, strength: float = 1.0) -> Method:
    """A closed form with the limits that recipes have, at a strength; 0 changes nothing."""

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        pixels = (picture.flatten(1).T.numpy() for picture in (content, style))
        from_content, to_style = map(statistics_of, pixels)
        assert from_content is not None and to_style is not None  # every pixel weighs 1
        return torch.lerp(torch.eye(3, 4), closed(from_content, to_style).float(), strength)

    return mapped


def mapped_picture(
    color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]
) -> Float[Tensor, "3 H W"]:
    """Not clamped."""
    mapped = torch.einsum("ij,jhw->ihw", color_map[:, :3], picture)
    return mapped + color_map[:, 3, None, None]


def _psnr_db(got: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"]) -> float:
    square = float((got - target).square().mean())
    return -10 * float(np.log10(max(square, 1e-6)))  # 60 dB at most: one black pair is no mean
