"""Records of a flood in a scene, and the Fresnel reflectance of its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.flood.waves import WaveSet
from augment.scene.cameras import Camera

# ---- The water and its layers --------------------------------------------------------------------

MIN_BED_CUT = 0.001  # smallest `bed_cut`: a quarter of an 8-bit step
FresnelModel = Literal["exact", "schlick"]
ReflectionTier = Literal["sky", "screen_space", "mirrored"]


@dataclass(frozen=True, eq=False)
class FloodMedium:
    """Water in a scene."""

    level_z_m: float
    """Height of the surface, which is a plane: scene world, metres."""

    extinction_per_m: tuple[float, float, float]
    """Extinction of red, green and blue in the water, >= 0; it may be infinite."""

    rgb: tuple[float, float, float]
    """Display-encoded colour of deep water from above."""

    waves: WaveSet
    """Waves of the surface; they tilt its normals."""

    refraction_index: float = 1.333
    """Refraction index of water over that of air."""

    fresnel: FresnelModel = "exact"
    """Model of the reflectance."""

    reflection: ReflectionTier = "mirrored"
    """Source of the reflections."""

    bed_cut: float = MIN_BED_CUT
    """Smallest share of the bed's light that counts; a bed of which less comes up is not drawn."""

    layers_px: float = 1.0
    """Width of the pixels of the bed layer and the mirrored view, in pixels of the image."""

    rain_mm_h: float = 0.0
    """Rate of the rain whose drops draw rings on the water."""

    seed: int = 0
    """Seed of these rings."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Image of everything on one side of the water, from one camera."""

    camera: Camera
    """Camera of the image."""

    rgb: Float[Tensor, "H W 3"]
    """Premultiplied, display-encoded colour without sky."""

    alpha: Float[Tensor, "H W"]
    """Opacity."""

    depth: Float[Tensor, "H W"]
    """Expected z in the camera, metres; meaningless where alpha is 0."""


# ---- Reflectance of a water surface for unpolarised light ----------------------------------------
# cosine: of the angle between the ray and the surface normal, in [0, 1]. index: the refraction
# index behind the surface over the index before it; an index of 1 reflects nothing.


def fresnel_reflectance(cosine: Float[Tensor, "*B"], index: float) -> Float[Tensor, "*B"]:
    """Return (Rs + Rp) / 2 of Fresnel's equations; 1 beyond the critical angle if index < 1.

    With c and t the cosines on both sides: Rs = ((c - n t) / (c + n t))^2 and
    Rp = ((n c - t) / (n c + t))^2.
    """
    if index == 1:
        return torch.zeros_like(cosine)
    c = cosine
    t = torch.sqrt((1 - (1 - c * c) / index**2).clamp_min(0))  # 0 beyond the critical angle
    # c = t = 0 is a ray along the surface, which reflects all of it; the quotients would be 0/0.
    is_grazing = (c == 0) & (t == 0)
    c = torch.where(is_grazing, torch.ones_like(c), c)
    rs = (c - index * t) / (c + index * t)
    rp = (index * c - t) / (index * c + t)
    return torch.where(is_grazing, torch.ones_like(c), (rs * rs + rp * rp) / 2)


def schlick_reflectance(cosine: Float[Tensor, "*B"], index: float) -> Float[Tensor, "*B"]:
    """Return Schlick's approximation (1994), F0 + (1 - F0) (1 - cosine)^5.

    F0 = ((n - 1) / (n + 1))^2. It holds for n >= 1 only, because it has no total reflection. At n =
    1.333 it differs from `fresnel_reflectance` by up to 0.009 below 70 degrees, by 0.027 at 75
    degrees and by 0.059 at 84 degrees.
    """
    if index == 1:
        return torch.zeros_like(cosine)
    f0 = ((index - 1) / (index + 1)) ** 2
    return f0 + (1 - f0) * (1 - cosine) ** 5


def reflectance(
    cosine: Float[Tensor, "*B"], index: float, model: FresnelModel
) -> Float[Tensor, "*B"]:
    """Return the reflected share of the light by the model that a recipe names."""
    return (
        fresnel_reflectance(cosine, index)
        if model == "exact"
        else schlick_reflectance(cosine, index)
    )
