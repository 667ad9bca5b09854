"""The fine relief of snow close to the camera: crumbs and clods, lit pixel by pixel.

A splat of snow is centimetres wide, which is dozens of pixels a few metres before a car's camera.
Every pixel that shows snow there is made brighter where the surface leans to the sun, and darker
where it leans away or is dull: by noise that is a function of the place and the seed, so that all
cameras and frames see one grain. It is the ground's, or a vehicle's, with which it drives on.
Octaves of the noise that a pixel cannot show are left out (Perlin 1985, "An image synthesizer"), by
its size on the surface: at the rounded edge of a roof noise would draw rings.
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

from augment.cameras import Camera
from augment.effects.snow import kernels
from augment.effects.snow.kernels import FARTHEST_M, GrainView
from augment.render.buffers import AUTO, CPU, kernels_for
from augment.render.threads import kernel_threads

# Brightness per slope of the relief towards the sun, at a clear day's contrast, and per deviation
# of the noise in any light; both at the recipe's grain of 1.
RELIEF, MOTTLE = 0.42, 0.04
_SMOOTH = 1.25  # texels: standard deviation of its blur
_ROWS = 16  # image rows a thread takes at a time


@dataclass(frozen=True)
class Grain:
    """How snow looks from close by. amount: 0 smooth, 1 coarse. contrast: 0 to 1, by how much the
    sun outshines the sky on it. seed: of its noise.
    """

    amount: float
    contrast: float
    seed: int


@dataclass(frozen=True, eq=False)
class Carrier:
    """A vehicle near the camera, with which the grain on it moves. part_from_world: [4, 4]. low,
    high: corners of what carries the snow, in the vehicle's frame.
    """

    part_from_world: np.ndarray
    low: np.ndarray
    high: np.ndarray


def add_grain(
    rgb: Float[Tensor, "H W 3"],
    depth_m: Float[Tensor, "H W"],
    snow: Float[Tensor, "H W"],
    hidden: Bool[Tensor, "H W"] | None,
    camera: Camera,
    grain: Grain,
    sun: tuple[float, float, float],
    carriers: Sequence[Carrier],
    *,
    extinction_per_m: float = 0.0,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """The display-encoded picture with grain on its snow; on the CPU, `rgb` is overwritten.

    depth_m: z of what a pixel shows, 0 = none. snow: its share of a pixel. hidden: pixels that
    show something before it. sun: unit, towards it, world. extinction_per_m: of the fog about the
    camera, whose share of a pixel has no grain. backend: on the CPU, float32 goes through a kernel,
    equal to this definition within float rounding.
    """
    view = _view_of(camera, grain, sun, carriers, extinction_per_m)
    if kernels_for(backend, rgb, depth_m, snow) != CPU:
        return _add_grain(rgb, depth_m, snow, hidden, view)
    bare = np.zeros((0, 0), bool) if hidden is None else hidden.contiguous().numpy()
    rgb = rgb.contiguous()
    with kernel_threads(_ROWS):
        kernels.add_grain(
            *(rgb.numpy(), depth_m.contiguous().numpy(), snow.contiguous().numpy(), bare),
            *(view, noise_table().reshape(-1)),
        )
    return rgb


def _add_grain(
    rgb: Tensor, depth_m: Tensor, snow: Tensor, hidden: Tensor | None, view: GrainView
) -> Tensor:
    """The definition of what the kernel computes, on the tensors' own device."""
    device = rgb.device
    shown = (snow > kernels.MIN_SNOW) & (depth_m > 0) & (depth_m < FARTHEST_M)
    if hidden is not None:
        shown &= ~hidden
    rows, columns = shown.nonzero(as_tuple=True)
    z = depth_m[rows, columns].double()
    lens, pose = view.lens, torch.from_numpy(view.pose).to(device)
    across = (columns + 0.5 - float(lens[2])) / float(lens[0])
    down = (rows + 0.5 - float(lens[3])) / float(lens[1])
    rays = torch.stack([across, down, torch.ones_like(across)], 1).double() @ pose[:, :3].T
    far, pixel_m = (
        z * rays.norm(dim=1),
        _pixels_on_snow(depth_m.double(), rows, columns, rays, view),
    )
    places = z[:, None] * rays + pose[:, 3]
    steps = torch.from_numpy(view.sun).to(device).expand(len(z), 3)
    unmoved = torch.ones(len(z), dtype=torch.bool, device=device)
    for row in view.carriers:
        numbers = torch.from_numpy(row).to(device)
        turn = numbers[:9].reshape(3, 3)
        local = places @ turn.T + numbers[9:12]
        inside = (local >= numbers[12:15]).all(1) & (local <= numbers[15:18]).all(1) & unmoved
        places = torch.where(inside[:, None], local, places)
        steps = torch.where(inside[:, None], (steps @ turn.T), steps)
        unmoved &= ~inside
    bright = _brightness(places, steps, pixel_m, view)
    share = snow[rows, columns].double() * torch.exp(-view.extinction * far)
    share = share * (2 * (1 - far / FARTHEST_M)).clamp(0, 1)
    factor = (1 + share * bright)[:, None]
    out = rgb.clone()
    out[rows, columns] = (rgb[rows, columns].double() * factor).to(rgb.dtype)
    return out


def _pixels_on_snow(
    depth: Tensor, rows: Tensor, columns: Tensor, rays: Tensor, view: GrainView
) -> Tensor:
    """Sizes of pixels on the surface, metres, as of the kernel's _pixel_on_snow."""
    z, lens, pose = depth[rows, columns], view.lens, torch.from_numpy(view.pose).to(depth.device)
    steps = []
    for axis, own in ((1, columns), (0, rows)):
        near = [(own + way).clamp(0, depth.shape[axis] - 1) for way in (-1, 1)]
        a, b = (depth[(rows, n) if axis else (n, columns)] for n in near)
        change = torch.where((z - a).abs() > (b - z).abs(), z - a, b - z)
        axis_m = z / float(lens[1 - axis])
        steps.append((change[:, None] * rays + axis_m[:, None] * pose[:, 1 - axis]).norm(dim=1))
    lengths = rays.norm(dim=1)
    fall = (rays[:, 2].abs() / lengths).clamp(min=kernels.MIN_FALL)
    level = z * lengths / float(lens[0])
    return torch.stack([steps[0], steps[1] * fall, level]).amax(0) / fall.sqrt()


def _brightness(places: Tensor, steps: Tensor, pixel_m: Tensor, view: GrainView) -> Tensor:
    noise, mask = torch.from_numpy(noise_table()).to(places.device).double(), kernels.GRAIN_SIDE - 1
    places = places + torch.from_numpy(view.shift).to(places.device)
    (x, y, z), (dx, dy) = places.unbind(1), steps[:, :2].unbind(1)
    bright, texel = torch.zeros_like(pixel_m), kernels.COARSEST_TEXEL_M
    cos, sin = kernels.TURN_COS, kernels.TURN_SIN
    for _ in range(kernels.GRAINS):
        shown = (kernels.SHOWN_AT * texel / pixel_m - 1).clamp(0, 1)
        at = torch.stack([x, y, z]) * (1 / texel)
        u, v, w = at - at.floor()
        i, j, k = at.floor().long() & mask
        i1, j1, k1 = (i + 1) & mask, (j + 1) & mask, (k + 1) & mask
        a, b, c, d = (
            torch.lerp(noise[k, row, column], noise[k1, row, column], w)
            for row in (j, j1)
            for column in (i, i1)
        )
        value = (a + u * (b - a)) * (1 - v) + (c + u * (d - c)) * v
        along = ((b - a) * (1 - v) + (d - c) * v) * dx + ((c - a) * (1 - u) + (d - b) * u) * dy
        bright = bright + shown * (view.mottle * value - view.relief * along)
        x, y, dx, dy = (
            cos * x - sin * y,
            sin * x + cos * y,
            cos * dx - sin * dy,
            sin * dx + cos * dy,
        )
        texel *= kernels.FINER
    return bright.clamp(-kernels.MOST_GRAIN, kernels.MOST_GRAIN)


def _view_of(
    camera: Camera,
    grain: Grain,
    sun: tuple[float, float, float],
    carriers: Sequence[Carrier],
    extinction_per_m: float,
) -> GrainView:
    """The kernel's numbers. The sun's level direction alone counts: on level snow a slope changes
    the light by the fall towards the sun.
    """
    level = math.hypot(sun[0], sun[1])
    towards = np.array([sun[0], sun[1], 0.0]) / max(level, 1e-9)
    rows = [
        np.concatenate([c.part_from_world[:3, :3].ravel(), c.part_from_world[:3, 3], c.low, c.high])
        for c in carriers
    ]
    return GrainView(
        lens=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        pose=np.ascontiguousarray(camera.world_from_camera.numpy()[:3]),
        sun=towards,
        shift=_shift_m(grain.seed),
        carriers=np.array(rows, np.float64).reshape(-1, 18),
        relief=grain.amount * grain.contrast * RELIEF,
        mottle=grain.amount * MOTTLE,
        extinction=extinction_per_m,
    )


@functools.cache
def noise_table() -> np.ndarray:
    """float32 [GRAIN_SIDE] * 3 of unit deviation, smooth over some texels, whose faces meet."""
    white = np.random.Generator(np.random.PCG64(0)).standard_normal(3 * (kernels.GRAIN_SIDE,))
    smooth = ndimage.gaussian_filter(white, _SMOOTH, mode="wrap")
    return (smooth / smooth.std()).astype(np.float32)


@functools.lru_cache(8)
def _shift_m(seed: int) -> np.ndarray:
    """Where a recipe's grain begins in the table, float64 [3]."""
    return np.random.Generator(np.random.PCG64(seed)).uniform(0, 100.0, 3)
