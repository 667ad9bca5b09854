"""How much light a water surface reflects: Fresnel's equations and Schlick's approximation.

`cosine` is that of the angle between the ray and the surface normal, in [0, 1]; `index` is the
refraction index behind the surface over the one before it: n from air into water, 1 / n from water
into air. Light is unpolarised. An index of 1 reflects nothing, exactly.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from augment.weather.flood import FresnelModel


def exact(cosine: Float[Tensor, "*B"], index: float) -> Float[Tensor, "*B"]:
    """(Rs + Rp) / 2 of Fresnel's equations; 1 beyond the critical angle where index < 1.

    With c and t the cosines on both sides: Rs = ((c - n t) / (c + n t))^2 and
    Rp = ((n c - t) / (n c + t))^2.
    """
    _check(index)
    if index == 1:
        return torch.zeros_like(cosine)
    c = cosine
    t = torch.sqrt((1 - (1 - c * c) / index**2).clamp_min(0))  # 0 beyond the critical angle
    # c = t = 0 is a ray along the surface, which it reflects whole; the quotients would be 0/0.
    along = (c == 0) & (t == 0)
    c = torch.where(along, torch.ones_like(c), c)
    rs = (c - index * t) / (c + index * t)
    rp = (index * c - t) / (index * c + t)
    return torch.where(along, torch.ones_like(c), (rs * rs + rp * rp) / 2)


def schlick(cosine: Float[Tensor, "*B"], index: float) -> Float[Tensor, "*B"]:
    """Schlick (1994): F0 + (1 - F0) (1 - cosine)^5 with F0 = ((n - 1) / (n + 1))^2.

    For n >= 1, where the cosine is on the air's side. At n = 1.333 it misses `exact` by up to 0.009
    below 70 degrees, by 0.027 at 75 and by 0.059 at 84.
    """
    _check(index)
    if index < 1:
        raise ValueError(f"Schlick's formula knows no total reflection: index >= 1; got {index}")
    if index == 1:
        return torch.zeros_like(cosine)
    normal = ((index - 1) / (index + 1)) ** 2
    return normal + (1 - normal) * (1 - cosine) ** 5


def reflectance(
    cosine: Float[Tensor, "*B"], index: float, model: FresnelModel
) -> Float[Tensor, "*B"]:
    """Reflected share of the light by the model a recipe names."""
    return exact(cosine, index) if model == "exact" else schlick(cosine, index)


def _check(index: float) -> None:
    if not 0 < index < float("inf"):
        raise ValueError(f"index must be a finite number > 0; got {index}")
