"""Fog: Beer-Lambert extinction towards an airlight colour, uniform or thinning with height.

    t = exp(-tau)          out = t c + (1 - t) c_air          tau = integral of sigma along the ray

The paper's smog equation has t on the smog's colour; that is inverted, and this is the usual form.
Uniform fog has tau = sigma d. With a scale height H the density is sigma0 exp(-(z - z0) / H) and

    tau = sigma0 d exp(-min(a, b)) (1 - exp(-|b - a|)) / |b - a|,
    a = (z_eye - z0) / H,  b = (z - z0) / H,

which is symmetric in its two ends and has no large factor that another must cancel.

The airlight may depend on the elevation e of the ray. Of an overcast sky, 1 + 2 sin e times the
horizon's luminance is measured and standard (Moon and Spencer 1942; ISO 15469, type 16). Inside
thick fog Eddington's approximation has the same form, 1 + k sin e with k = 3/2 g (1 - a) / (1 + a):
1.0 over asphalt of albedo a = 0.1 for droplets of asymmetry g = 0.85. Below the horizon, where that
would end below zero, its reciprocal goes on with the same slope, which is a choice of ours:

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

from augment.cameras import Camera
from augment.render.buffers import RenderOutput

ENCODING = 2.2  # display-encoded colour is about this root of luminance
MAX_EXPONENT = 80.0  # exp(80) is still finite in float32; fog that dense has t = 0 at any distance


@dataclass(frozen=True)
class Fog:
    """Fog in a scene, of any kind. sigma_per_m: extinction at height base_z_m (scene world). rgb:
    airlight at the horizon, display-encoded. scale_height_m: None for uniform. overcast: k / 2, 0
    for one airlight in all directions. varying_rgb: of `rgb`, what g multiplies; None for all of
    it. The rasterisers draw `rgb`; `composite.add_elevation` adds the rest to their pictures.
    """

    sigma_per_m: float
    rgb: tuple[float, float, float]
    scale_height_m: float | None = None
    base_z_m: float = 0.0
    overcast: float = 0.0
    varying_rgb: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma_per_m) and self.sigma_per_m >= 0):
            raise ValueError(f"sigma_per_m must be finite and >= 0; got {self.sigma_per_m}")
        if self.scale_height_m is not None and not (
            math.isfinite(self.scale_height_m) and self.scale_height_m > 0
        ):
            raise ValueError(f"scale_height_m must be finite and > 0; got {self.scale_height_m}")


def optical_depth(
    medium: Fog,
    ray_distance: Float[Tensor, "*B"],
    eye_z_m: float,
    point_z_m: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B"]:
    """tau from the eye to points at a finite Euclidean distance (metres).

    point_z_m: their world heights, needed only where the medium has a scale height.
    """
    uniform = medium.sigma_per_m * ray_distance
    if medium.scale_height_m is None:
        return uniform
    if point_z_m is None:
        raise ValueError("point_z_m is needed for fog with a scale height")
    a = (eye_z_m - medium.base_z_m) / medium.scale_height_m
    b = (point_z_m - medium.base_z_m) / medium.scale_height_m
    difference = (b - a).abs()
    small = difference < 1e-4  # there 1 - x/2 is exact to float32, and expm1(x)/x would be 0/0 at 0
    safe = torch.where(small, torch.ones_like(difference), difference)
    mean = torch.where(small, 1 - difference / 2, -torch.expm1(-safe) / safe)
    lower = torch.minimum(b, torch.full_like(b, a))
    return uniform * torch.exp((-lower).clamp(max=MAX_EXPONENT)) * mean


def sky_optical_depth(
    medium: Fog, slope: Float[Tensor, "*B"], eye_z_m: float
) -> Float[Tensor, "*B"]:
    """tau along rays that never end. slope: vertical part of the unit direction.

    Infinite (t = 0) for uniform fog and for rays that do not climb; sigma0 exp(-a) H / slope else.
    """
    infinite = torch.full_like(slope, math.inf)
    if medium.sigma_per_m == 0:
        return torch.zeros_like(slope)
    if medium.scale_height_m is None:
        return infinite
    vertical = vertical_optical_depth(medium, eye_z_m)
    climbing = slope > 0
    return torch.where(climbing, vertical / torch.where(climbing, slope, 1.0), infinite)


def vertical_optical_depth(medium: Fog, eye_z_m: float) -> float:
    """tau from the eye straight up to infinity: sigma0 H exp(-(z_eye - z0) / H)."""
    if medium.scale_height_m is None:
        raise ValueError("uniform fog has no top: its vertical optical depth is infinite")
    a = (eye_z_m - medium.base_z_m) / medium.scale_height_m
    return medium.sigma_per_m * medium.scale_height_m * math.exp(min(-a, MAX_EXPONENT))


def blend_airlight(
    rgb: Float[Tensor, "*B 3"],
    tau: Float[Tensor, "*B"],
    medium: Fog,
    slope: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B 3"]:
    """t rgb + (1 - t) airlight, with t = exp(-tau). tau = 0 returns rgb to the bit.

    slope: vertical part of the unit direction; None for the airlight of the horizon.
    """
    t = torch.exp(-tau)[..., None]
    airlight = torch.tensor(medium.rgb, dtype=rgb.dtype, device=rgb.device)
    if slope is not None and medium.overcast > 0:
        airlight = airlight + airlight_gain(medium, slope)
    return t * rgb + (1 - t) * airlight


def airlight_gain(medium: Fog, slope: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Airlight in a direction less that at the horizon. slope: as of `blend_airlight`."""
    growth = torch.log1p(2 * medium.overcast * slope.abs()) / ENCODING * slope.sign()
    varying = medium.rgb if medium.varying_rgb is None else medium.varying_rgb
    return torch.expm1(growth)[..., None] * growth.new_tensor(varying)


def fog_buffers(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    ray_distance: Float[Tensor, "H W"],
    medium: Fog,
    eye_z_m: float,
    point_z_m: Float[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Deferred fog (the paper's way) on premultiplied colour, sky not included.

    ray_distance: of depth divided by alpha. Exact for one surface a pixel; translucent layers are
    all fogged at their mean distance.
    """
    tau = optical_depth(medium, ray_distance, eye_z_m, point_z_m)
    t = torch.exp(-tau)[..., None]
    airlight = torch.tensor(medium.rgb, dtype=rgb.dtype, device=rgb.device)
    return t * rgb + (1 - t) * alpha[..., None] * airlight


def fog_raster(raster: RenderOutput, camera: Camera, medium: Fog) -> Float[Tensor, "H W 3"]:
    """Deferred fog on a render with colour, alpha and expected depth."""
    assert raster.rgb is not None and raster.alpha is not None
    ways = ways_of_raster(raster, camera, medium)
    return fog_buffers(raster.rgb, raster.alpha, ways[0], medium, *ways[1:])


def ways_of_raster(
    raster: RenderOutput, camera: Camera, medium: Fog
) -> tuple[Float[Tensor, "H W"], float, Float[Tensor, "H W"] | None]:
    """Ray distance, the eye's height and the points' of expected depths, as `optical_depth` takes
    them.
    """
    depth = raster.expected_depth
    assert depth is not None
    ray_distance = depth * camera.ray_lengths(depth.dtype, depth.device)
    eye_z_m = float(camera.centre[2])
    point_z_m = None
    if medium.scale_height_m is not None:
        point_z_m = eye_z_m + depth * camera.ray_directions(depth.dtype, depth.device)[..., 2]
    return ray_distance, eye_z_m, point_z_m


def optical_depth_of_arrays(
    medium: Fog,
    distance_m: np.ndarray,
    eye_z_m: float | np.ndarray,
    point_z_m: np.ndarray,
    *,
    series_below: float = 1e-8,  # there 1 - x/2 is exact to float64
) -> np.ndarray:
    """`optical_depth` of NumPy arrays, from one eye or an eye for each point."""
    uniform = medium.sigma_per_m * distance_m
    if medium.scale_height_m is None:
        return uniform
    a = (eye_z_m - medium.base_z_m) / medium.scale_height_m
    b = (point_z_m - medium.base_z_m) / medium.scale_height_m
    difference = np.abs(b - a)
    small = difference < series_below
    safe = np.where(small, 1.0, difference)
    mean = np.where(small, 1 - difference / 2, -np.expm1(-safe) / safe)
    return uniform * np.exp(np.minimum(-np.minimum(a, b), MAX_EXPONENT)) * mean
