"""How water darkens a porous surface, in closed form.

Light that a rough surface of albedo a gives back into a film of water is partly thrown back at the
film's upper side, and meets the surface again (Angstrom 1925; Lekner and Dorf 1988):

    a_wet = (1 - R) (1 - p) a / (1 - p a)

R = 0.0659: diffuse reflectance of water from outside; p = 1 - (1 - R) / n^2 = 0.472: from inside.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.snow.light import SceneLight
from augment.render.sh import SH_C0
from augment.scene import Gaussians

REFRACTION_INDEX = 1.33
OUTSIDE = 0.0659
INSIDE = 1 - (1 - OUTSIDE) / REFRACTION_INDEX**2
BRIGHTEST = 0.95  # albedo of what shines brighter than white: lamps, glare


def wet_albedo(albedo: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Albedo under a film of water, from the dry one, both in [0, 1]."""
    return (1 - OUTSIDE) * (1 - INSIDE) * albedo / (1 - INSIDE * albedo)


def linear_of(rgb: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Linear light of sRGB values (IEC 61966-2-1); those below 0 count as 0."""
    rgb = rgb.clamp_min(0)
    return torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def display_of(linear: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """sRGB values of linear light >= 0."""
    high = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, high)


def white_level(light: SceneLight) -> float:
    """Linear luminance of a white surface that lies level in the scene's light: by its road, whose
    albedo is roughly known, else by its sky.
    """
    r, g, b = light.ground_rgb_linear
    luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b
    return max(luminance / (light.ground_albedo or 1.0), 1e-4)


def wet_ratio(
    rgb: Float[Tensor, "*B 3"], white: float, wetness: Float[Tensor, "*B"] | float
) -> Float[Tensor, "*B 3"]:
    """What display-encoded colours of a surface are multiplied by as it gets wet.

    white: of `white_level`. wetness: 0 dry, 1 wet through, a share of area between.
    """
    linear = linear_of(rgb)
    albedo = (linear / white).clamp(1e-4, BRIGHTEST)
    share = wetness[..., None] if isinstance(wetness, Tensor) else wetness
    wet = linear * (1 + share * (wet_albedo(albedo) / albedo - 1))
    return torch.where(rgb > 1e-4, display_of(wet) / rgb.clamp_min(1e-4), torch.ones_like(rgb))


def darkened(own: Gaussians, wet: Float[Tensor, "N"], white: float) -> Gaussians:
    """The Gaussians as wet as `wet` says, 0 to 1; those of 0 keep their bits.

    The colour that all directions share says how much each channel loses, in all directions.
    """
    rows = torch.nonzero(wet > 0)[:, 0]
    if not len(rows):
        return own
    sh = own.sh.detach().clone()
    base = 0.5 + SH_C0 * sh[rows, 0]
    ratio = wet_ratio(base, white, wet[rows])
    sh[rows] *= ratio[:, None]
    sh[rows, 0] += (ratio - 1) * (0.5 / SH_C0)
    return replace(own, sh=sh)
