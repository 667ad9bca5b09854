"""Adds the fine relief of snow close to the camera: crumbs and clods, lit pixel by pixel.

Input: a rendered picture with its depth and its share of snow. Output: the picture with grain.
Caller: `SnowEffect.edit_image`.

A splat of snow is centimetres wide, which is dozens of pixels a few metres before a car's camera.
Every pixel that shows snow there is made brighter where the surface leans to the sun, and darker
where it leans away or is dull. The relief is noise, a function of the place and the seed, so that
all cameras and frames see the same grain. It belongs to the ground, or to a vehicle, with which it
moves. Octaves of the noise that a pixel cannot show are left out (Perlin 1985, "An image
synthesizer"), by the pixel's size on the surface: at the rounded edge of a roof, noise would draw
rings.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from augment.effects.snow import layer_kernels
from augment.effects.snow.layer_kernels import MAX_GRAIN_DISTANCE_M, GrainView
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Brightness per slope of the relief towards the sun at a clear day's contrast, and brightness per
# deviation of the noise in any light. Both hold for the recipe's grain of 1.
GRAIN_RELIEF = 0.42
GRAIN_MOTTLE = 0.04
_NOISE_BLUR_TEXELS = 1.25  # standard deviation of the noise's blur, texels
_ROWS_PER_TASK = 16  # number of image rows that a thread takes at a time


@dataclass(frozen=True)
class Grain:
    """Look of snow from close by."""

    amount: float  # 0 smooth, 1 coarse
    contrast: float  # how much the sun outshines the sky on it, 0 to 1
    seed: int  # seed of the grain's noise


@dataclass(frozen=True, eq=False)
class Carrier:
    """Vehicle near the camera, with which the grain on it moves."""

    part_from_world: np.ndarray  # [4, 4]
    low: np.ndarray  # [3], lowest corner of what carries the snow, in the vehicle's frame
    high: np.ndarray  # [3], highest corner


def add_grain(
    rgb: Float[Tensor, "H W 3"],
    depth_m: Float[Tensor, "H W"],
    snow: Float[Tensor, "H W"],
    occluded: Bool[Tensor, "H W"] | None,
    camera: Camera,
    grain: Grain,
    sun: tuple[float, float, float],
    carriers: Sequence[Carrier],
    *,
    extinction_per_m: float = 0.0,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """Add grain to the snow of a display-encoded picture; on the CPU, `rgb` is overwritten.

    Args:
        rgb: picture.
        depth_m: z of what a pixel shows, 0 = none.
        snow: share of snow in a pixel.
        occluded: pixels that show something before the snow.
        camera: the camera.
        grain: look of the snow.
        sun: unit vector towards the sun, world.
        carriers: vehicles near the camera.
        extinction_per_m: extinction of the fog about the camera; the fog's share of a pixel has no
            grain.
        backend: on the CPU, a kernel works on float32, equal to this definition within float
            rounding.
    """
    view = _grain_view(camera, grain, sun, carriers, extinction_per_m)
    if choose_kernels(backend, rgb, depth_m, snow) != CPU:
        return _add_grain(rgb, depth_m, snow, occluded, view)
    hidden_mask = np.zeros((0, 0), bool) if occluded is None else occluded.contiguous().numpy()
    rgb = rgb.contiguous()
    with kernel_threads(_ROWS_PER_TASK):
        layer_kernels.add_grain(
            rgb.numpy(),
            depth_m.contiguous().numpy(),
            snow.contiguous().numpy(),
            hidden_mask,
            view,
            make_noise_table().reshape(-1),
        )
    return rgb


def _add_grain(
    rgb: Tensor, depth_m: Tensor, snow: Tensor, occluded: Tensor | None, view: GrainView
) -> Tensor:
    """Definition of what the kernel computes, on the tensors' own device."""
    device = rgb.device
    is_snowy = (
        (snow > layer_kernels.MIN_SNOW_SHARE) & (depth_m > 0) & (depth_m < MAX_GRAIN_DISTANCE_M)
    )
    if occluded is not None:
        is_snowy &= ~occluded
    rows, columns = is_snowy.nonzero(as_tuple=True)
    z = depth_m[rows, columns].double()
    lens = view.lens
    pose = torch.from_numpy(view.pose).to(device)
    ray_x = (columns + 0.5 - float(lens[2])) / float(lens[0])
    ray_y = (rows + 0.5 - float(lens[3])) / float(lens[1])
    rays = torch.stack([ray_x, ray_y, torch.ones_like(ray_x)], 1).double() @ pose[:, :3].T
    ray_distance = z * rays.norm(dim=1)
    pixel_m = _pixels_on_snow(depth_m.double(), rows, columns, rays, view)
    places = z[:, None] * rays + pose[:, 3]
    steps = torch.from_numpy(view.sun).to(device).expand(len(z), 3)
    is_on_ground = torch.ones(len(z), dtype=torch.bool, device=device)
    for row in view.carriers:
        numbers = torch.from_numpy(row).to(device)
        turn = numbers[:9].reshape(3, 3)
        local = places @ turn.T + numbers[9:12]
        is_inside = (
            (local >= numbers[12:15]).all(1) & (local <= numbers[15:18]).all(1) & is_on_ground
        )
        places = torch.where(is_inside[:, None], local, places)
        steps = torch.where(is_inside[:, None], (steps @ turn.T), steps)
        is_on_ground &= ~is_inside
    brightness = _brightness(places, steps, pixel_m, view)
    share = snow[rows, columns].double() * torch.exp(-view.extinction * ray_distance)
    share = share * (2 * (1 - ray_distance / MAX_GRAIN_DISTANCE_M)).clamp(0, 1)
    factor = (1 + share * brightness)[:, None]
    grainy_rgb = rgb.clone()
    grainy_rgb[rows, columns] = (rgb[rows, columns].double() * factor).to(rgb.dtype)
    return grainy_rgb


def _pixels_on_snow(
    depth: Tensor, rows: Tensor, columns: Tensor, rays: Tensor, view: GrainView
) -> Tensor:
    """Return sizes of pixels on the surface, metres, as the kernel's _pixel_on_snow does."""
    z = depth[rows, columns]
    lens = view.lens
    pose = torch.from_numpy(view.pose).to(depth.device)
    steps = []
    for axis, indices in ((1, columns), (0, rows)):
        neighbours = [(indices + offset).clamp(0, depth.shape[axis] - 1) for offset in (-1, 1)]
        a, b = (depth[(rows, n) if axis else (n, columns)] for n in neighbours)
        change = torch.where((z - a).abs() > (b - z).abs(), z - a, b - z)
        axis_m = z / float(lens[1 - axis])
        steps.append((change[:, None] * rays + axis_m[:, None] * pose[:, 1 - axis]).norm(dim=1))
    lengths = rays.norm(dim=1)
    fall_sine = (rays[:, 2].abs() / lengths).clamp(min=layer_kernels.MIN_FALL_SINE)
    level_m = z * lengths / float(lens[0])
    return torch.stack([steps[0], steps[1] * fall_sine, level_m]).amax(0) / fall_sine.sqrt()


def _brightness(places: Tensor, steps: Tensor, pixel_m: Tensor, view: GrainView) -> Tensor:
    """Return the change of brightness at points [P, 3], as the kernel's _grain_at does."""
    noise = torch.from_numpy(make_noise_table()).to(places.device).double()
    mask = layer_kernels.GRAIN_TABLE_SIDE - 1
    places = places + torch.from_numpy(view.shift).to(places.device)
    (x, y, z) = places.unbind(1)
    (dx, dy) = steps[:, :2].unbind(1)
    brightness = torch.zeros_like(pixel_m)
    texel = layer_kernels.COARSEST_TEXEL_M
    cos = layer_kernels.TURN_COS
    sin = layer_kernels.TURN_SIN
    for _ in range(layer_kernels.NUM_GRAIN_OCTAVES):
        visible_share = (layer_kernels.VISIBILITY_RATIO * texel / pixel_m - 1).clamp(0, 1)
        texel_position = torch.stack([x, y, z]) * (1 / texel)
        u, v, w = texel_position - texel_position.floor()
        i, j, k = texel_position.floor().long() & mask
        i1 = (i + 1) & mask
        j1 = (j + 1) & mask
        k1 = (k + 1) & mask
        a, b, c, d = (
            torch.lerp(noise[k, row, column], noise[k1, row, column], w)
            for row in (j, j1)
            for column in (i, i1)
        )
        value = (a + u * (b - a)) * (1 - v) + (c + u * (d - c)) * v
        slope = ((b - a) * (1 - v) + (d - c) * v) * dx + ((c - a) * (1 - u) + (d - b) * u) * dy
        brightness = brightness + visible_share * (view.mottle * value - view.relief * slope)
        x, y, dx, dy = (
            cos * x - sin * y,
            sin * x + cos * y,
            cos * dx - sin * dy,
            sin * dx + cos * dy,
        )
        texel *= layer_kernels.TEXEL_RATIO
    return brightness.clamp(-layer_kernels.MAX_GRAIN, layer_kernels.MAX_GRAIN)


def _grain_view(
    camera: Camera,
    grain: Grain,
    sun: tuple[float, float, float],
    carriers: Sequence[Carrier],
    extinction_per_m: float,
) -> GrainView:
    """Return the kernel's numbers.

    Only the sun's level direction counts: on level snow, a slope changes the light by its fall
    towards the sun.
    """
    level = math.hypot(sun[0], sun[1])
    sun_direction = np.array([sun[0], sun[1], 0.0]) / max(level, 1e-9)
    rows = [
        np.concatenate([c.part_from_world[:3, :3].ravel(), c.part_from_world[:3, 3], c.low, c.high])
        for c in carriers
    ]
    return GrainView(
        lens=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        pose=np.ascontiguousarray(camera.world_from_camera.numpy()[:3]),
        sun=sun_direction,
        shift=_shift_m(grain.seed),
        carriers=np.array(rows, np.float64).reshape(-1, 18),
        relief=grain.amount * grain.contrast * GRAIN_RELIEF,
        mottle=grain.amount * GRAIN_MOTTLE,
        extinction=extinction_per_m,
    )


@functools.cache
def make_noise_table() -> np.ndarray:
    """float32 [GRAIN_TABLE_SIDE] * 3 of unit deviation, smooth over texels; its faces meet."""
    white = np.random.Generator(np.random.PCG64(0)).standard_normal(
        3 * (layer_kernels.GRAIN_TABLE_SIDE,)
    )
    smooth = ndimage.gaussian_filter(white, _NOISE_BLUR_TEXELS, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


@functools.lru_cache(8)
def _shift_m(seed: int) -> np.ndarray:
    """Return the offset of a recipe's grain in the table, float64 [3]."""
    return np.random.Generator(np.random.PCG64(seed)).uniform(0, 100.0, 3)
