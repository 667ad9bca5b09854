"""The view from under the water: absorption on the way, and the air through Snell's window.

The surface is taken as flat from below, and what it reflects back down as water.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from augment.render.composite import sky_behind
from augment.sky import Sky, sample_at
from augment.weather.flood import FloodMedium, Layer
from augment.weather.fresnel import exact
from augment.weather.smog import SmogMedium, blend_airlight, sky_optical_depth
from augment.weather.water_plane import plane_depth


def view_from_below(
    front: Layer, air: Layer, medium: FloodMedium, sky: Sky, smog: SmogMedium | None = None
) -> Float[Tensor, "H W 3"]:
    """The picture of an eye at or below the water's surface, not clamped.

    front: what lies under water. air: what lies above, from the same camera, on the same device.
    smog: in the air.
    """
    camera = front.camera
    rgb, device = front.rgb, front.rgb.device
    lengths = camera.ray_lengths(rgb.dtype, device)
    deep = torch.tensor(medium.rgb, dtype=rgb.dtype, device=device)
    through = transmittance(medium, front.depth * lengths)
    seen = through * rgb + front.alpha[..., None] * (1 - through) * deep

    directions = camera.ray_directions(rgb.dtype, device)
    up = directions[..., 2] / lengths
    bent = _into_air(directions / lengths[..., None], medium.refraction_index)
    reflected = exact(up.clamp_min(0), 1 / medium.refraction_index)[..., None]
    behind, smog = sky_behind(sky, smog)
    sky_rgb = sample_at(behind, bent)
    if smog is not None:
        tau = sky_optical_depth(smog, bent[..., 2], medium.level_z_m)
        sky_rgb = blend_airlight(sky_rgb, tau, smog)
    outside = air.rgb + (1 - air.alpha)[..., None] * sky_rgb
    surface = (1 - reflected) * outside + reflected * deep
    depth = plane_depth(camera, medium.level_z_m, device).to(rgb.dtype)
    meets = depth.isfinite()
    distance = torch.where(meets, depth, torch.zeros_like(depth)) * lengths
    to_surface = transmittance(medium, distance)
    beyond = torch.where(
        meets[..., None], to_surface * surface + (1 - to_surface) * deep, deep.expand_as(surface)
    )
    return seen + (1 - front.alpha)[..., None] * beyond


def transmittance(medium: FloodMedium, length_m: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """exp(-extinction length) per channel; 1 over no length, also where extinction is infinite."""
    extinction = torch.tensor(medium.extinction_per_m, dtype=length_m.dtype, device=length_m.device)
    t = torch.exp(-extinction * length_m[..., None])
    return torch.where((length_m[..., None] == 0) | (extinction == 0), torch.ones_like(t), t)


def _into_air(directions: Float[Tensor, "*B 3"], index: float) -> Float[Tensor, "*B 3"]:
    """Unit directions of rising rays after the surface; level ones beyond the critical angle."""
    flat = index * directions[..., :2]
    rise = (1 - flat.square().sum(-1)).clamp_min(0).sqrt()
    return torch.nn.functional.normalize(torch.cat([flat, rise[..., None]], -1), dim=-1)
