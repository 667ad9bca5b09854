"""What is seen through the water's surface: the bed, through the water over it."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.weather.flood import FloodMedium, Layer
from augment.weather.layer_lookup import (
    SOLID_ALPHA,
    bilinear,
    is_inside,
    point_at,
    project,
    stacked,
)
from augment.weather.smog import SmogMedium, optical_depth
from augment.weather.water_surface import Surface, refracted

BED_STEPS = 2  # corrections of the bed's depth where a refracted ray meets it,
SETTLED_M = 0.01  # unless the last one was smaller
# Where less of any colour comes up from the depth of the bed straight behind a pixel, no bed is
# looked for: a quarter of an 8-bit step at most, but for beds that rise before the pixel's own.
LEAST_TRANSMITTANCE = 1 / 1024
MOST_OPTICAL_DEPTH = -math.log(LEAST_TRANSMITTANCE)


def window_offset(outer: Camera, inner: Camera) -> tuple[int, int]:
    """(left, top) of a window of the image that another window lies in, pixels.

    Raises:
        ValueError: they are not windows of one image.
    """
    left, top = outer.cx - inner.cx, outer.cy - inner.cy
    focal = max(abs(outer.fx / inner.fx - 1), abs(outer.fy / inner.fy - 1))
    apart = float((outer.camera_from_world - inner.camera_from_world).abs().max())
    off_grid = max(abs(left - round(left)), abs(top - round(top)))
    if focal > 1e-9 or apart > 1e-6 or off_grid > 1e-3:
        raise ValueError(
            f"the bed must be seen through a window of the image of camera {inner.name!r}; the "
            f"focal lengths differ by a factor of {1 + focal:.6g}, poses by {apart:.3g}, "
            f"offsets are ({left:.6g}, {top:.6g}) pixels"
        )
    return round(left), round(top)


def through_the_surface(
    surface: Surface,
    normal: Float[Tensor, "H W 3"],
    camera: Camera,
    medium: FloodMedium,
    bed: Layer,
    smog: SmogMedium | None,
) -> Float[Tensor, "H W 3"]:
    """Colour of the light that comes up through the surface: T = a bed + (1 - a) water.

    The bed's depth where the ray meets it is unknown; it starts as that of the bed straight behind
    the pixel, and is corrected by the depth at the pixel found with it. Where that search leaves
    the bed's image or meets a hole, the bed straight behind the pixel is taken, and the water's own
    colour where there is none either, or it lies too deep to be seen. The bed's holes show the
    water's own colour.
    """
    water = water_color(surface, camera, medium, smog)
    own_column, own_row = _own_pixel(bed.camera, camera, normal.dtype)
    own_inside = is_inside(bed.camera, own_column, own_row)
    own_solid, own_point = point_at(bed, own_column, own_row)
    own_solid = own_solid & own_inside
    own_depth = _depth_below(surface, own_point)
    extinction = torch.tensor(medium.extinction_per_m, dtype=normal.dtype)
    bends = medium.refraction_index != 1
    ray = -surface.to_eye  # nothing bends, whatever the waves
    if bends:
        ray = refracted(surface.to_eye, normal, medium.refraction_index)
    opaque = _optical_depth(own_depth / -ray[..., 2], extinction.min())
    own_solid = own_solid & (opaque < MOST_OPTICAL_DEPTH)
    image = stacked(bed)
    own_colors = bilinear(image, own_column, own_row)
    found, depth, colors = own_solid, own_depth, own_colors
    if bends:
        found, depth, colors = _search(surface, ray, bed, image, own_solid, own_depth)
    depth = torch.where(found, depth, own_depth)
    colors = torch.where(found[..., None], colors, own_colors)
    colors = torch.where(own_solid[..., None], colors, 0)
    length = torch.where(own_solid, depth / -ray[..., 2], 0)[..., None]
    a = torch.exp(-_optical_depth(length, extinction))
    return a * (colors[..., :3] + (1 - colors[..., 3:]) * water) + (1 - a) * water


def _search(
    surface: Surface, ray: Tensor, bed: Layer, image: Tensor, found: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(found, depth below the plane, colour and alpha) of the bed along refracted rays."""
    per_depth = ray / -ray[..., 2:]
    going = found
    for _ in range(BED_STEPS):
        column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
        solid, point = point_at(bed, column, row)
        found = found & (~going | (is_inside(bed.camera, column, row) & solid))
        going = going & found
        last, depth = depth, torch.where(going, _depth_below(surface, point), depth)
        going = going & ((depth - last).abs() > SETTLED_M)
    column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
    colors = bilinear(image, column, row)
    found = found & is_inside(bed.camera, column, row) & (colors[..., 3] >= SOLID_ALPHA)
    return found, depth, colors


def _optical_depth(length: Tensor, extinction_per_m: Tensor) -> Tensor:
    return torch.where(length > 0, extinction_per_m * length, 0)  # infinity times no way is none


def _own_pixel(outer: Camera, inner: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    left, top = window_offset(outer, inner)
    row = torch.arange(inner.height, dtype=dtype) + (top + 0.5)
    column = torch.arange(inner.width, dtype=dtype) + (left + 0.5)
    row, column = torch.meshgrid(row, column, indexing="ij")
    return column, row


def _depth_below(surface: Surface, point: Tensor) -> Float[Tensor, "H W"]:
    """Metres of points below the plane, 0 above it. point: relative to the eye."""
    return (-surface.height_m - point[..., 2]).clamp_min(0)


def water_color(
    surface: Surface, camera: Camera, medium: FloodMedium, smog: SmogMedium | None
) -> Float[Tensor, "H W 3"]:
    """Deep water's own colour, seen through the smog before it."""
    dtype = surface.points.dtype
    own = torch.tensor(medium.rgb, dtype=dtype).expand(surface.points.shape)
    if smog is None:
        return own
    t = torch.exp(-smog_before(surface, camera, medium.level_z_m, smog))[..., None]
    return t * own + (1 - t) * torch.tensor(smog.rgb, dtype=dtype)


def smog_before(
    surface: Surface, camera: Camera, level_z_m: float, smog: SmogMedium
) -> Float[Tensor, "H W"]:
    """Optical depth of the smog between the eye and the surface."""
    level = torch.full_like(surface.distance, level_z_m)
    return optical_depth(smog, surface.distance, float(camera.centre[2]), level)
