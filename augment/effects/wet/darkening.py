"""Darkens porous surfaces under water, in closed form.

`wet.effect` darkens splats and recorded pictures with it; `wet.reflection` and `wet.lidar` use its
constants and colour conversions. Light that a rough surface of albedo a reflects into a film of
water is partly reflected at the film's upper side, and meets the surface again (Angstrom 1925;
Lekner and Dorf 1988):

    a_wet = (1 - R) (1 - p) a / (1 - p a)

R = 0.0659: diffuse reflectance of water from outside. p = 1 - (1 - R) / n^2 = 0.472: from inside.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from augment.light.scene_light import SceneLight
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians

REFRACTION_INDEX = 1.33  # n, of water
OUTER_REFLECTANCE = 0.0659  # R, diffuse reflectance of water from outside
# p, diffuse reflectance from inside.
INNER_REFLECTANCE = 1 - (1 - OUTER_REFLECTANCE) / REFRACTION_INDEX**2
MAX_ALBEDO = 0.95  # largest albedo, of lamps and glare that shine brighter than white


def wet_albedo(albedo: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Return the albedo under a film of water of a dry albedo, both in [0, 1]."""
    return (
        (1 - OUTER_REFLECTANCE)
        * (1 - INNER_REFLECTANCE)
        * albedo
        / (1 - INNER_REFLECTANCE * albedo)
    )


def to_linear(rgb: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Convert sRGB values to linear light (IEC 61966-2-1); values below 0 count as 0."""
    rgb = rgb.clamp_min(0)
    return torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def to_display(linear: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Convert linear light >= 0 to sRGB values."""
    high = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, high)


def white_level(light: SceneLight) -> float:
    """Return the linear luminance of a white, level surface in the scene's light.

    It follows from the scene's road, whose albedo is roughly known, or else from its sky.
    """
    r, g, b = light.ground_rgb_linear
    luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b
    return max(luminance / (light.ground_albedo or 1.0), 1e-4)


def wet_ratio(
    rgb: Float[Tensor, "*B 3"], white: float, wetness: Float[Tensor, "*B"] | float
) -> Float[Tensor, "*B 3"]:
    """Return the factor by which a surface's display-encoded colours change as it gets wet.

    Args:
        rgb: colours of the dry surface.
        white: result of `white_level`.
        wetness: 0 dry, 1 wet through; between, a share of the area is wet.
    """
    linear = to_linear(rgb)
    albedo = (linear / white).clamp(1e-4, MAX_ALBEDO)
    share = wetness[..., None] if isinstance(wetness, Tensor) else wetness
    wet = linear * (1 + share * (wet_albedo(albedo) / albedo - 1))
    return torch.where(rgb > 1e-4, to_display(wet) / rgb.clamp_min(1e-4), torch.ones_like(rgb))


def darken_gaussians(gaussians: Gaussians, wet: Float[Tensor, "N"], white: float) -> Gaussians:
    """Return the Gaussians as wet as `wet` says, 0 to 1; those of 0 keep their bits.

    The colour that all directions share gives the loss of each channel, in all directions.
    """
    rows = torch.nonzero(wet > 0)[:, 0]
    if not len(rows):
        return gaussians
    sh = gaussians.sh.detach().clone()
    base = 0.5 + SH_C0 * sh[rows, 0]
    ratio = wet_ratio(base, white, wet[rows])
    sh[rows] *= ratio[:, None]
    sh[rows, 0] += (ratio - 1) * (0.5 / SH_C0)
    return replace(gaussians, sh=sh)
