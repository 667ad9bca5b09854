"""Fog: Beer-Lambert extinction towards an airlight colour, uniform or thinning with height.

    t = exp(-tau)          out = t c + (1 - t) c_air          tau = integral of sigma along the ray

The paper's smog equation puts t on the smog's colour. That is inverted; this is the usual form.
sigma is the extinction, 1/m. Uniform fog has tau = sigma d. With a scale height H the extinction is
sigma0 exp(-(z - z0) / H) and

    tau = sigma0 d exp(-min(a, b)) (1 - exp(-|b - a|)) / |b - a|,
    a = (z_eye - z0) / H,  b = (z - z0) / H,

which is symmetric in its two ends and has no large factor that another must cancel.

The airlight may depend on the elevation e of the ray. For an overcast sky, 1 + 2 sin e times the
horizon's luminance is measured and standard (Moon and Spencer 1942; ISO 15469, type 16). Inside
thick fog Eddington's approximation has the same form, 1 + k sin e with k = 3/2 g (1 - a) / (1 + a):
1.0 over asphalt of albedo a = 0.1 for droplets of asymmetry g = 0.85. Below the horizon this form
would fall below zero. There its reciprocal continues with the same slope, which is our choice:

    c_air(e) = c_air g(e)      g = (1 + k sin e)^(1/2.2), e >= 0      g(-e) = 1 / g(e)

The root is what display encoding, close to a power of 2.2, makes of a factor of the luminance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.render.fog_banks import FogBanks

# Exponent of display encoding: display-encoded colour is about this root of luminance.
ENCODING = 2.2
# Largest exponent of density: exp(80) is still finite in float32. Fog that dense has t = 0 at any
# distance.
MAX_EXPONENT = 80.0


@dataclass(frozen=True)
class Fog:
    """Fog in a scene.

    extinction_per_m: extinction at height base_z_m, 1/m.
    airlight_rgb: airlight at the horizon, display-encoded. The rasterisers draw this colour;
        `composite.add_airlight_elevation` adds the dependence on elevation to their images.
    scale_height_m: height over which the fog thins by a factor e, metres; None for uniform fog.
    base_z_m: height of the base, metres, scene world.
    elevation_gain: k / 2 of the module's equation; 0 for the same airlight in all directions.
    varying_airlight_rgb: the share of `airlight_rgb` that g multiplies; None for all of it.
    banks: variation of the extinction in space; None for plain fog. The functions of this file are
        those of plain fog; those of `augment.render.fog_image` are of any fog.
    """

    extinction_per_m: float
    airlight_rgb: tuple[float, float, float]
    scale_height_m: float | None = None
    base_z_m: float = 0.0
    elevation_gain: float = 0.0
    varying_airlight_rgb: tuple[float, float, float] | None = None
    banks: FogBanks | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.extinction_per_m) and self.extinction_per_m >= 0):
            raise ValueError(
                f"extinction_per_m must be finite and >= 0; got {self.extinction_per_m}"
            )
        if self.scale_height_m is not None and not (
            math.isfinite(self.scale_height_m) and self.scale_height_m > 0
        ):
            raise ValueError(f"scale_height_m must be finite and > 0; got {self.scale_height_m}")


def optical_depth(
    fog: Fog,
    ray_distance: Float[Tensor, "*B"],
    eye_z_m: float,
    point_z_m: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B"]:
    """Return tau from the eye to points at a finite distance.

    Args:
        fog: the fog.
        ray_distance: Euclidean distance from the eye to each point, metres.
        eye_z_m: world height of the eye, metres.
        point_z_m: world heights of the points, metres; needed only for fog with a scale height.

    Raises:
        ValueError: the fog has a scale height and point_z_m is missing.
    """
    uniform_depth = fog.extinction_per_m * ray_distance
    if fog.scale_height_m is None:
        return uniform_depth
    if point_z_m is None:
        raise ValueError("point_z_m is needed for fog with a scale height")
    a = (eye_z_m - fog.base_z_m) / fog.scale_height_m
    b = (point_z_m - fog.base_z_m) / fog.scale_height_m
    difference = (b - a).abs()
    is_small = (
        difference < 1e-4
    )  # there 1 - x/2 is exact to float32, and expm1(x)/x would be 0/0 at 0
    safe_difference = torch.where(is_small, torch.ones_like(difference), difference)
    mean_density = torch.where(
        is_small, 1 - difference / 2, -torch.expm1(-safe_difference) / safe_difference
    )
    lower_end = torch.minimum(b, torch.full_like(b, a))
    return uniform_depth * torch.exp((-lower_end).clamp(max=MAX_EXPONENT)) * mean_density


def sky_optical_depth(fog: Fog, slope: Float[Tensor, "*B"], eye_z_m: float) -> Float[Tensor, "*B"]:
    """Return tau along rays that never end.

    It is infinite (t = 0) for uniform fog and for rays that do not climb, else
    sigma0 exp(-a) H / slope.

    Args:
        fog: the fog.
        slope: vertical part of the unit direction of each ray.
        eye_z_m: world height of the eye, metres.
    """
    infinite_depth = torch.full_like(slope, math.inf)
    if fog.extinction_per_m == 0:
        return torch.zeros_like(slope)
    if fog.scale_height_m is None:
        return infinite_depth
    vertical_depth = vertical_optical_depth(fog, eye_z_m)
    is_climbing = slope > 0
    return torch.where(
        is_climbing, vertical_depth / torch.where(is_climbing, slope, 1.0), infinite_depth
    )


def vertical_optical_depth(fog: Fog, eye_z_m: float) -> float:
    """Return tau from the eye straight up to infinity: sigma0 H exp(-(z_eye - z0) / H)."""
    if fog.scale_height_m is None:
        raise ValueError("uniform fog has no top: its vertical optical depth is infinite")
    a = (eye_z_m - fog.base_z_m) / fog.scale_height_m
    return fog.extinction_per_m * fog.scale_height_m * math.exp(min(-a, MAX_EXPONENT))


def blend_airlight(
    rgb: Float[Tensor, "*B 3"],
    tau: Float[Tensor, "*B"],
    fog: Fog,
    slope: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B 3"]:
    """Return t rgb + (1 - t) airlight, with t = exp(-tau). tau = 0 returns the bits of rgb.

    slope: vertical part of the unit direction; None for the airlight of the horizon.
    """
    t = torch.exp(-tau)[..., None]
    airlight = torch.tensor(fog.airlight_rgb, dtype=rgb.dtype, device=rgb.device)
    if slope is not None and fog.elevation_gain > 0:
        airlight = airlight + airlight_gain(fog, slope)
    return t * rgb + (1 - t) * airlight


def airlight_gain(fog: Fog, slope: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Return the airlight in a direction minus the airlight at the horizon; slope as in
    `blend_airlight`.
    """
    growth = torch.log1p(2 * fog.elevation_gain * slope.abs()) / ENCODING * slope.sign()
    varying_rgb = fog.airlight_rgb if fog.varying_airlight_rgb is None else fog.varying_airlight_rgb
    return torch.expm1(growth)[..., None] * growth.new_tensor(varying_rgb)


def apply_deferred_fog(
    rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], tau: Float[Tensor, "H W"], fog: Fog
) -> Float[Tensor, "H W 3"]:
    """Return premultiplied colour in deferred fog (the paper's way), sky not included.

    The result is exact for one surface per pixel. All translucent layers of a pixel are fogged at
    their mean distance.

    Args:
        rgb: premultiplied colour.
        alpha: alpha of the surfaces.
        tau: optical depth before the surfaces.
        fog: the fog.
    """
    t = torch.exp(-tau)[..., None]
    airlight = torch.tensor(fog.airlight_rgb, dtype=rgb.dtype, device=rgb.device)
    return t * rgb + (1 - t) * alpha[..., None] * airlight


def optical_depth_numpy(
    fog: Fog,
    ray_distance: np.ndarray,
    eye_z_m: float | np.ndarray,
    point_z_m: np.ndarray,
    *,
    series_below: float = 1e-8,  # there 1 - x/2 is exact to float64
) -> np.ndarray:
    """Return `optical_depth` of NumPy arrays, from one eye or from an eye for each point.

    series_below: height difference, in scale heights, below which a series replaces the quotient.
    """
    uniform_depth = fog.extinction_per_m * ray_distance
    if fog.scale_height_m is None:
        return uniform_depth
    a = (eye_z_m - fog.base_z_m) / fog.scale_height_m
    b = (point_z_m - fog.base_z_m) / fog.scale_height_m
    difference = np.abs(b - a)
    is_small = difference < series_below
    safe_difference = np.where(is_small, 1.0, difference)
    mean_density = np.where(
        is_small, 1 - difference / 2, -np.expm1(-safe_difference) / safe_difference
    )
    return uniform_depth * np.exp(np.minimum(-np.minimum(a, b), MAX_EXPONENT)) * mean_density
