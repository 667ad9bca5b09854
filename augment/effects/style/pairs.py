"""Pairs of a photo and a recoloured copy: training losses and scores of a style.

`augment.effects.style.train` calls `sample_pairs`, `pair_losses` and `score_pairs`. A recolouring
is a change of colours that a camera, a light or a weather makes: exposure, white balance, contrast,
saturation, hue, tint, gamma, a curve, an arbitrary linear part. Some recolourings reach grey and
night. A recoloured photo is a style whose perfect result is known. Two photos with the same
recolouring share a look.

Errors of colours are logarithms of mean squares, as their figures are (dB), so that a pair that is
nearly right still counts. With N and S the folded stages of GSCM, x a photo, p its recolouring:

    same         S(p x) N(x) x = p x, and back
    half         the same, with the style from one half of the picture, the colours of the other
    look         S(p y) N(x) x = p x with y another photo, and back
    consistency  N(x) x = N(p x) p x: the paper's L_con
    cycle        S(x) N(x) x = x: the paper's L_cyc
    range        colours of photo x in the style of photo y that are not displayable

Scores are PSNR of same, half and look, and of below: the lower half of a picture in the style of
the upper half, which seldom has the same colours.
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
from augment.effects.style.statistics import ColorStatistics, color_statistics, mkl_map
from augment.light.srgb import LUMINANCE_WEIGHTS

# Share of a batch's photos that share their square with another photo.
MIXED_SHARE = 0.5
# Factor on RecolorSettings by which each photo is recoloured before it is used.
VARIATION = 0.3


@dataclass(frozen=True)
class RecolorSettings:
    """Strength of recolourings: standard deviations, and shares of extreme recolourings."""

    exposure: float = 0.22
    """Deviation of log2 of the gain of all channels."""

    balance: float = 0.20
    """Deviation of log2 of the gain of each channel."""

    contrast: float = 0.18
    """Deviation of the contrast's natural logarithm."""

    gamma: float = 0.42
    """Deviation of the natural logarithm of gamma."""

    lift: float = 0.07
    """Deviation of the offset of each channel."""

    saturation: float = 0.38
    """Deviation of the saturation's natural logarithm."""

    hue_rad: float = 0.30
    """Deviation of the rotation about the grey axis."""

    mix: float = 0.17
    """Deviation of the entries of an arbitrary matrix that is added."""

    curve: float = 0.90
    """Deviation of the tone curve's strength."""

    grey_share: float = 0.05
    """Share of recolourings that remove nearly all colour."""

    night_share: float = 0.05
    """Share of recolourings that remove nearly all light."""


@dataclass(frozen=True, eq=False)
class Recoloring:
    """B recolourings: clamp(curve(M c^gamma + b)) with curve(c) = c + s (3 c^2 - 2 c^3 - c)."""

    maps: Float[Tensor, "B 3 4"]
    """Linear maps (M, b), float32."""

    gamma: Float[Tensor, "B 3"]
    """Exponents of the channels, float32, above 0."""

    curve: Float[Tensor, "B"]
    """Strengths s of the tone curve, float32, in (-1, 1)."""

    def __call__(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Return the pictures, in [0, 1], each under its recolouring, on their device."""
        maps, gamma, curve = (
            values.to(images.device) for values in (self.maps, self.gamma, self.curve)
        )
        gamma_rgb = images.clamp_min(1e-6) ** gamma[:, :, None, None]
        mapped = torch.einsum("bij,bjhw->bihw", maps[:, :, :3], gamma_rgb)
        mapped = (mapped + maps[:, :, 3, None, None]).clamp(0, 1)
        smooth = mapped * mapped * (3 - 2 * mapped)
        return torch.lerp(mapped, smooth, curve[:, None, None, None])


class PairBatch(NamedTuple):
    """B pairs of photos with the same recolouring, float32 in [0, 1]."""

    photos: Float[Tensor, "B 3 S S"]
    """First photo of each pair."""

    recolored: Float[Tensor, "B 3 S S"]
    """First photos under the recolourings."""

    second_photos: Float[Tensor, "B 3 S S"]
    """Second photo of each pair."""

    second_recolored: Float[Tensor, "B 3 S S"]
    """Second photos under the same recolourings."""


def sample_recolorings(
    count: int, generator: torch.Generator, settings: RecolorSettings = RecolorSettings()
) -> Recoloring:
    """Return random recolourings; the same for the same state of the generator.

    Args:
        count: number of recolourings.
        generator: random numbers of the CPU.
        settings: strength of the recolourings.
    """

    def normal(*shape: int) -> Tensor:
        return torch.randn((count, *shape), generator=generator).clamp(-2.5, 2.5)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    exposure = settings.exposure * normal()
    saturation = (settings.saturation * normal()).exp()
    kind_draws = torch.rand(count, generator=generator)
    is_grey = kind_draws < settings.grey_share
    is_night = (kind_draws >= settings.grey_share) & (
        kind_draws < settings.grey_share + settings.night_share
    )
    saturation = torch.where(is_grey, uniform(0.0, 0.3), saturation)
    exposure = torch.where(is_night, uniform(-3.0, -1.5), exposure)
    gains = 2 ** (exposure[:, None] + settings.balance * normal(3))
    gains = gains * torch.where(is_night[:, None], torch.tensor([0.8, 0.95, 1.25]), torch.ones(3))
    contrast = (settings.contrast * normal()).exp()[:, None]
    # Contrast about the middle grey that the exposure makes, so that night stays night.
    middle_grey = 0.43 * gains
    maps = torch.eye(3) + settings.mix * normal(3, 3)
    maps = _turn_about_grey(saturation, settings.hue_rad * normal()) @ maps
    maps = (contrast * gains)[:, :, None] * maps
    lifts = torch.where(is_night, 0.2, 1.0)[:, None] * settings.lift * normal(3)
    offset = middle_grey * (1 - contrast) + lifts
    return Recoloring(
        torch.cat([maps, offset[..., None]], dim=2),
        (settings.gamma * normal())[:, None].exp() * (0.3 * settings.gamma * normal(3)).exp(),
        (settings.curve * normal()).clamp(-0.9, 0.9),
    )


def recolor(
    images: Float[Tensor, "B 3 H W"], generator: torch.Generator
) -> Float[Tensor, "B 3 H W"]:
    """Return every picture under a random recolouring."""
    return sample_recolorings(len(images), generator)(images)


def sample_pairs(
    photos: Float[Tensor, "P 3 H W"], generator: torch.Generator, batch: int, size_px: int
) -> PairBatch:
    """Return a batch of pairs, on the photos' device; the same for the same generator state.

    Photos are cut (half to all of each side), mirrored at random, and squeezed to squares. Every
    second one shares its square with another, and each is recoloured a little. Without this, a
    network would learn a hundred photos by heart.

    Args:
        photos: display-encoded photos in [0, 1].
        generator: random numbers of the CPU.
        batch: number B of pairs.
        size_px: side of the squares.

    Raises:
        ValueError: there are fewer than two photos.
    """
    count = len(photos)
    if count < 2:
        raise ValueError(f"pairs need at least 2 photos; got {count}")
    first = torch.randint(count, (batch,), generator=generator)
    second = (first + torch.randint(1, count, (batch,), generator=generator)) % count
    recoloring = sample_recolorings(batch, generator)
    first = first.to(photos.device)
    second = second.to(photos.device)
    first_photos = _vary(_cut(photos[first], generator, size_px), generator)
    second_photos = _vary(_cut(photos[second], generator, size_px), generator)
    return PairBatch(
        first_photos, recoloring(first_photos), second_photos, recoloring(second_photos)
    )


def _vary(photos: Float[Tensor, "B 3 S S"], generator: torch.Generator) -> Float[Tensor, "B 3 S S"]:
    """Return varied photos.

    Half of them take their right or lower part from the photo before them in the batch. Then each
    is recoloured a little.
    """
    count, _, _, size = photos.shape
    pixel_centres = torch.arange(size) + 0.5
    start = size * (0.3 + 0.4 * torch.rand((count, 1), generator=generator))
    is_right = (pixel_centres > start)[:, None]  # [B, 1, S]
    is_vertical = (torch.rand((count, 1, 1), generator=generator) < 0.5).expand(-1, size, size)
    takes_other_photo = torch.where(is_vertical, is_right.transpose(1, 2), is_right)
    takes_other_photo = takes_other_photo & (
        torch.rand((count, 1, 1), generator=generator) < MIXED_SHARE
    )
    mixed = torch.where(takes_other_photo[:, None].to(photos.device), photos.roll(1, 0), photos)
    default_settings = vars(RecolorSettings()).items()
    small_settings = RecolorSettings(
        **{n: 0.0 if "share" in n else VARIATION * setting for n, setting in default_settings}
    )
    return sample_recolorings(count, generator, small_settings)(mixed)


def _turn_about_grey(
    saturation: Float[Tensor, "B"], hue_rad: Float[Tensor, "B"]
) -> Float[Tensor, "B 3 3"]:
    """Return matrices that turn colours about the grey axis and scale their distance from it."""
    grey_projection = torch.full((3, 3), 1 / 3)
    cross_product = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / 3**0.5
    cos = hue_rad.cos()[:, None, None]
    sin = hue_rad.sin()[:, None, None]
    # Rodrigues' formula.
    hue_matrix = grey_projection + cos * (torch.eye(3) - grey_projection) + sin * cross_product
    luma_matrix = torch.tensor(LUMINANCE_WEIGHTS).expand(3, 3)
    return torch.lerp(
        luma_matrix.expand(len(saturation), 3, 3), hue_matrix, saturation[:, None, None]
    )


def _cut(
    photos: Float[Tensor, "B 3 H W"], generator: torch.Generator, size_px: int
) -> Float[Tensor, "B 3 S S"]:
    """Return random parts of photos, mirrored at random and squeezed to squares."""
    count = len(photos)
    sides = 0.5 + 0.5 * torch.rand((count, 2), generator=generator)
    centres = (1 - sides) * (2 * torch.rand((count, 2), generator=generator) - 1)
    signs = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0] = sides[:, 0] * signs
    theta[:, 1, 1] = sides[:, 1]
    theta[:, :, 2] = centres
    theta = theta.to(photos.device)
    grid = functional.affine_grid(theta, [count, 3, size_px, size_px], align_corners=False)
    return functional.grid_sample(photos, grid, padding_mode="border", align_corners=False)


# ---- Losses of pairs -----------------------------------------------------------------------------

# Mean square error added under the logarithm, so that nothing is gained beyond 40 dB.
_ERROR_FLOOR = 1e-4
# Stride of the pixels whose colours are compared.
_STRIDE_PX = 2

# Weights of the losses in their sum.
PAIR_WEIGHTS = {
    "same": 1.0,
    "half": 0.5,
    "look": 1.0,
    "consistency": 1.0,
    "cycle": 1.0,
    "range": 4.0,
}


def pair_losses(net: Gscm, batch: PairBatch) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of a batch by name, unweighted (see the module's docstring)."""
    count, _, _, size = batch.photos.shape
    pictures = dict(zip(("x", "px", "y", "py"), batch, strict=True))
    # A name is a side (l, r) and a picture; the left half's style meets the right half's colours.
    half_pictures = {
        f"{side}{name}": functional.interpolate(half_picture, (size, size), mode="bilinear")
        for name in ("x", "px")
        for side, half_picture in zip(
            "lr", pictures[name].split([size // 2, size - size // 2], 3), strict=True
        )
    }
    names = [*pictures, *half_pictures]
    f_c, f_s = net.encode(torch.cat([*pictures.values(), *half_pictures.values()]))
    content_maps = dict(zip(names, net.content_map(f_c).split(count), strict=True))
    style_maps = dict(zip(names, net.style_map(f_s).split(count), strict=True))
    colors_of_picture = {name: _colors(picture) for name, picture in pictures.items()}
    colors_of_picture |= {name: _colors(half_pictures[name]) for name in ("rx", "rpx")}

    def styled(content: str, style_name: str) -> Tensor:
        return apply_map(
            compose(style_maps[style_name], content_maps[content]), colors_of_picture[content]
        )

    def error(content: str, style_name: str, target: str) -> Tensor:
        return _log_error(styled(content, style_name), colors_of_picture[target])

    in_content_space = [
        apply_map(content_maps[name], colors_of_picture[name]) for name in ("x", "px")
    ]
    mixed = torch.cat([styled("x", "y"), styled("px", "y"), styled("x", "py")])
    return {
        "same": (error("x", "px", "px") + error("px", "x", "x")) / 2,
        "half": (error("rx", "lpx", "rpx") + error("rpx", "lx", "rx")) / 2,
        "look": (error("x", "py", "px") + error("px", "y", "x")) / 2,
        "consistency": (in_content_space[0] - in_content_space[1]).abs().mean(),
        "cycle": (styled("x", "x") - colors_of_picture["x"]).abs().mean(),
        "range": ((mixed - 1).relu() + (-mixed).relu()).mean(),
    }


def _colors(pictures: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B N 3"]:
    return pictures[:, :, ::_STRIDE_PX, ::_STRIDE_PX].flatten(2).transpose(1, 2)


def _log_error(result: Float[Tensor, "B N 3"], target: Float[Tensor, "B N 3"]) -> Float[Tensor, ""]:
    """Return the mean logarithm of the mean square error of the displayable colours."""
    square = (result.clamp(0, 1) - target).square().mean((1, 2))
    return (square + _ERROR_FLOOR).log().mean()


# ---- Scores: a map of colours from a content and a style picture, on photographs -----------------

# Function from a content picture and a style picture, in [0, 1], to the map of the content.
Method = Callable[[Float[Tensor, "3 H W"], Float[Tensor, "3 A B"]], Float[Tensor, "3 4"]]
# Function from statistics of a content and of a style to the map of the content.
ClosedForm = Callable[[ColorStatistics, ColorStatistics], Float[Tensor, "3 4"]]


def score_pairs(
    method: Method, photos: Float[Tensor, "P 3 S S"], *, repeats: int
) -> dict[str, float]:
    """Return mean PSNR (dB) by name, of each photo under `repeats` fixed recolourings."""
    count = len(photos)
    half = photos.shape[3] // 2
    generator = torch.Generator().manual_seed(0)
    scores: dict[str, list[float]] = {name: [] for name in ("same", "half", "below", "look")}
    for repeat in range(repeats):
        recolorings = sample_recolorings(count, generator)
        for index, photo in enumerate(photos):
            row = slice(index, index + 1)
            recoloring = Recoloring(
                recolorings.maps[row], recolorings.gamma[row], recolorings.curve[row]
            )
            recolored = recoloring(photo[None])[0]
            other = recoloring(photos[(index + 1 + repeat % (count - 1)) % count][None])[0]
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
    """Return the network as a method; all pictures are squeezed to squares, halves too."""

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        squares = [
            functional.interpolate(p[None], (SIZE_PX, SIZE_PX), mode="bilinear", antialias=True)
            for p in (content, style)
        ]
        with torch.no_grad():
            f_c, f_s = net.encode(torch.cat(squares))
            return compose(net.style_map(f_s[1:]), net.content_map(f_c[:1]))[0]

    return mapped


def closed_form_method(closed_form: ClosedForm = mkl_map, strength: float = 1.0) -> Method:
    """Return a closed form as a method, with the limits that recipes have, at a strength."""

    def mapped(content: Tensor, style: Tensor) -> Tensor:
        pixels = (picture.flatten(1).T.numpy() for picture in (content, style))
        from_content, to_style = map(color_statistics, pixels)
        assert from_content is not None and to_style is not None  # every pixel weighs 1
        return torch.lerp(torch.eye(3, 4), closed_form(from_content, to_style).float(), strength)

    return mapped


def mapped_picture(
    color_map: Float[Tensor, "3 4"], picture: Float[Tensor, "3 H W"]
) -> Float[Tensor, "3 H W"]:
    """Return the picture under the map, not clamped."""
    mapped = torch.einsum("ij,jhw->ihw", color_map[:, :3], picture)
    return mapped + color_map[:, 3, None, None]


def _psnr_db(result: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"]) -> float:
    square = float((result - target).square().mean())
    return -10 * float(np.log10(max(square, 1e-6)))  # at most 60 dB, for the mean over pairs
