"""Reflections in flat water found in the camera's own image: a march through its depth.

The torch definition and the launch of the kernels (Lee et al. 2018, "Mipmap-accelerated screen
space reflections").

A mirrored ray starts at the point x = s d where the pixel's ray d (unit z in the camera, eye at 0)
meets the water and runs along d - 2 d_z n, n being the vertical. Let a = -2 d_z, and n's image in
homogeneous pixels N = (fx n_x + cx n_z, fy n_y + cy n_z, n_z). The ray's image is the straight
line from the pixel p towards the vertical's vanishing point, G = N_xy - p n_z. With t pixels gone
along the longer axis of G, whose length there is g = max |G|, and c = (1 + a n_z) / (a g):

    1/z = (1 - c t) / s        metres along the ray = |x| t / (a g (1 - c t))

so that the ray gets infinitely far away at t = 1 / c if c > 0, and comes back to the camera's
plane if c < 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import kernels
from augment.effects.flood.flood import Layer
from augment.effects.flood.water_plane import Window, falling, window_offset
from augment.render.buffers import CPU, kernels_for
from augment.render.threads import kernel_threads

# The kernels' thresholds, as numbers that torch takes.
COVERED, THICKNESS_M, THICKNESS = map(
    float, (kernels.COVERED, kernels.THICKNESS_M, kernels.THICKNESS)
)
HIDDEN_PX = float(kernels.HIDDEN_PX)
NEAR_M = float(kernels.NEAR_M)
AGREEING = float(kernels.AGREEING)
EDGE = float(kernels.EDGE)

SAMPLES = 1 << 23  # that the definition looks at at a time; rays go on by at least MIN_PX
MIN_PX = 16
ROWS = 4  # rows of rays a thread takes at a time


@dataclass(frozen=True, eq=False)
class ScreenReflection:
    """How far the mirrored rays of a window's pixels run until they meet what the image shows.

    layer: what was marched through, with the whole image's camera. distance: metres along the
    mirrored ray from the flat surface; infinite where it ends in the sky or nothing is known.
    weight: how far that can be trusted, 0 to 1.
    """

    layer: Layer
    distance: Float[Tensor, "h w"]
    weight: Float[Tensor, "h w"]


def trace_screen(
    front: Layer,
    camera: Camera,
    level_z_m: float,
    *,
    needed: Bool[Tensor, "h w"] | None = None,
    stride: int = 4,
    backend: str = CPU,
) -> ScreenReflection:
    """What the mirrored rays of the flat surface z = level_z_m meet, for the pixels of `camera`.

    front: what stands above the water, over the whole image. camera: a window of that image, which
    may reach beyond it. needed: the pixels to trace; None for all. The weight is 0 of the others,
    of those that the front covers or whose own ray does not meet the water, and of rays that leave
    the image, come back to the camera's plane, or are lost behind something thin. It falls to 0
    over the outer 4 % of the image.

    backend: the CPU's kernels equal this definition but for rays that graze a silhouette's pixel.
    They trace every `stride`-th pixel of rows and columns, interpolate where four agree and trace
    the rest; it is 1, 2 or 4.

    Raises:
        ValueError: the camera is no window of the front's.
    """
    left, top = window_offset(front.camera, camera)
    size = (camera.height, camera.width)
    device = front.alpha.device
    if float(camera.centre[2]) <= level_z_m:
        distance = torch.full(size, math.inf, device=device)
        return ScreenReflection(front, distance, torch.zeros_like(distance))
    if needed is None:
        needed = torch.ones(size, dtype=torch.bool, device=device)
    if kernels_for(backend, front.alpha.detach()) == CPU:
        vertical = _vertical(front.camera, level_z_m)
        found = _run_kernels(front, camera, vertical, (left, top), stride, needed)
    else:
        found = _trace(front, camera, level_z_m, left, top, needed)
    return ScreenReflection(front, *found)


def _vertical(camera: Camera, level_z_m: float) -> tuple[list[float], list[float], float]:
    """The vertical in the camera, its image N in homogeneous pixels, and the eye's height."""
    up = camera.camera_from_world[:3, 2].tolist()
    image = [camera.fx * up[0] + camera.cx * up[2], camera.fy * up[1] + camera.cy * up[2], up[2]]
    return up, image, float(camera.centre[2]) - level_z_m


def _run_kernels(
    front: Layer,
    camera: Camera,
    vertical: tuple[list[float], list[float], float],
    origin: tuple[int, int],
    stride: int,
    needed: Bool[Tensor, "h w"],
) -> tuple[Tensor, Tensor]:
    whole = front.camera
    (up, image, eye_height_m) = vertical
    alpha = front.alpha.detach().contiguous().numpy()
    asked = needed.contiguous().numpy()
    block = kernels.BLOCK
    high, wide = (-(-size // block) * block for size in (whole.height, whole.width))
    pyramid = np.empty((high, wide + wide // 4), np.float32)
    numbers = (*up, *image, whole.fx, whole.fy, whole.cx, whole.cy, eye_height_m)
    numbers += (whole.width, whole.height)
    view = np.array(numbers, np.float32)
    rows = -(-camera.height // stride)
    columns = -(-camera.width // stride)
    ways, trust = np.empty((2, rows, columns), np.float32)
    distance, weight = np.empty((2, camera.height, camera.width), np.float32)
    with kernel_threads(ROWS):
        kernels.build_pyramid(alpha, front.depth.detach().contiguous().numpy(), pyramid)
        traced = pyramid, view, alpha, asked, *origin, stride, ways, trust
        kernels.trace(*traced)
        kernels.spread(*traced, distance, weight)
    return torch.from_numpy(distance), torch.from_numpy(weight)


class _Rays(NamedTuple):
    """Mirrored rays in pixels, [N] or [N, 1]; the letters are the module's.

    x, y: where they start. step_x, step_y: G / g. near: 1 / s. bend: c. scale: a g. end: the t at
    which the march is over; to_sky: infinitely far away. metres: |x|.
    """

    x: Tensor
    y: Tensor
    step_x: Tensor
    step_y: Tensor
    near: Tensor
    bend: Tensor
    scale: Tensor
    end: Tensor
    to_sky: Tensor
    metres: Tensor

    def select(self, index: Tensor) -> _Rays:
        return _Rays(*(part[index] for part in self))

    def inverse_depth(self, t: Tensor) -> Tensor:
        return (1 - self.bend * t) * self.near

    def pixel(self, t: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Column and row after t pixels, inside the image."""
        x = (self.x + t * self.step_x).floor().clamp(0, width - 1)
        return x.long(), (self.y + t * self.step_y).floor().clamp(0, height - 1).long()


def _mirrored_rays(camera: Camera, level_z_m: float, x: Tensor, y: Tensor) -> _Rays:
    """Of the pixels with centres (x, y), which see the water."""
    up, image, eye_height_m = _vertical(camera, level_z_m)
    u = (x - camera.cx) / camera.fx
    v = (y - camera.cy) / camera.fy
    slope = u * up[0] + v * up[1] + up[2]  # d_z < 0
    gx = image[0] - x * up[2]
    gy = image[1] - y * up[2]
    g = torch.maximum(gx.abs(), gy.abs()).clamp_min(1e-9)  # 0 at the point below the eye
    scale = -2 * slope * g
    bend = (1 - 2 * slope * up[2]) / scale
    near = -slope / eye_height_m
    step_x = gx / g
    step_y = gy / g
    far = torch.where(bend > 0, 1 / bend, math.inf)
    back = torch.where(bend < 0, (1 - 1 / (near * NEAR_M)) / bend, math.inf)
    out_x = torch.where(gx > 0, camera.width - x, x) / step_x.abs()
    out_y = torch.where(gy > 0, camera.height - y, y) / step_y.abs()
    leaves = torch.minimum(torch.minimum(out_x, out_y), back)
    metres = torch.sqrt(1 + u * u + v * v) / near
    end = torch.minimum(far, leaves)
    return _Rays(x, y, step_x, step_y, near, bend, scale, end, far <= leaves, metres)


def _trace(
    front: Layer, camera: Camera, level_z_m: float, left: int, top: int, needed: Bool[Tensor, "h w"]
) -> tuple[Tensor, Tensor]:
    """The definition: every pixel, in steps of a pixel along the ray's longer axis."""
    whole = front.camera
    device = front.alpha.device
    alpha = front.alpha.detach()
    depth = front.depth.detach()
    window = Window(left, top, left + camera.width, top + camera.height)
    cover = torch.ones(camera.height, camera.width, dtype=alpha.dtype, device=device)
    here, there = window.overlap(alpha)
    cover[there] = alpha[here]
    asked = needed & (cover < COVERED) & falling(camera, device)
    row, column = torch.nonzero(asked, as_tuple=True)
    x = (column + (left + 0.5)).double()
    y = (row + (top + 0.5)).double()
    rays = _mirrored_rays(whole, level_z_m, x, y)
    solid = torch.where(alpha >= 0.5, 1 / depth.double(), 0.0)
    distance = torch.full(cover.shape, math.inf, device=device)
    weight = torch.zeros_like(distance)
    way, trust = _march(rays, solid)
    distance[row, column] = way.float()
    weight[row, column] = trust.float()
    return distance, weight


def _march(rays: _Rays, solid: Tensor) -> tuple[Tensor, Tensor]:
    """Metres to what is met and its weight. solid [H, W]: the front's inverse depth, 0 if none."""
    height, width = solid.shape
    end_at = torch.full_like(rays.x, math.nan)  # steps to what is met, or to the sky
    met_any = torch.zeros_like(rays.to_sky)
    hidden = torch.zeros_like(rays.x, dtype=torch.long)  # steps behind something without a break
    clean = torch.ones_like(rays.to_sky)  # never was behind anything
    going = torch.arange(len(rays.x), device=solid.device)
    first = 1
    while len(going):
        count = min(max(SAMPLES // len(going), MIN_PX), max(width, height) + 2)
        r = rays.select(going[:, None])
        step = torch.arange(first, first + count, device=solid.device)  # pixels' centres
        over = step - 0.5 >= r.end
        x, y = r.pixel(step, width, height)
        surface = solid[y, x]
        k0 = r.inverse_depth(step - 0.5)
        k1 = r.inverse_depth(torch.minimum(step + 0.5, r.end))
        reached = ~over & (surface > 0) & (torch.minimum(k0, k1) <= surface)
        met = reached & (torch.maximum(k0, k1) >= _back_side(surface))
        lost = reached & ~met
        # Steps behind something: since the last that was not, of this stretch or of those before.
        free = torch.where(lost, first - 1 - hidden[going][:, None], step).cummax(1).values
        stops = over | met | (step - free > HIDDEN_PX)
        at = stops.to(torch.uint8).argmax(1, keepdim=True)
        stopped = stops.gather(1, at)[:, 0]
        was_clean = clean[going] & ~(lost & (step < first + at)).any(1)
        hits = met.gather(1, at)[:, 0] & stopped
        to_sky = over.gather(1, at)[:, 0] & stopped & was_clean & rays.to_sky[going]
        reach = torch.where(hits, (first + at[:, 0]).to(solid.dtype), rays.end[going])
        end_at[going] = torch.where(hits | to_sky, reach, math.nan)
        met_any[going] = hits
        clean[going] = was_clean
        hidden[going] = first + count - 1 - free[:, -1]
        going = going[~stopped]
        first = first + count
    x, y = rays.pixel(end_at.nan_to_num(0), width, height)
    here = solid[y, x]
    t = torch.where(met_any, _refine(rays, solid, x, y), end_at)
    # Not farther than what was met, however the ray grazes it.
    share = torch.maximum(rays.inverse_depth(t), _back_side(here)) / rays.near
    way = torch.where(met_any, rays.metres * t / (rays.scale * share), math.inf)
    return way, _edge_weight(rays, t, width, height).nan_to_num(0)


def _back_side(surface: Tensor) -> Tensor:
    """Inverse depth of the far side of what is seen at an inverse depth > 0."""
    depth = 1 / surface
    return 1 / (depth + (THICKNESS * depth).clamp_min(THICKNESS_M))


def _refine(rays: _Rays, solid: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Where the ray meets the plane through the pixel (x, y) it was found in, at most 1 px off it.

    The plane's inverse depth is linear in the image, by differences to neighbours that agree.
    """
    here = solid[y, x]
    across = _slope(solid, here, y, x, 0, 1)
    down = _slope(solid, here, y, x, 1, 0)
    off_x = x + 0.5 - rays.x
    off_y = y + 0.5 - rays.y
    closing = -rays.bend * rays.near - across * rays.step_x - down * rays.step_y
    meet = (here - across * off_x - down * off_y - rays.near) / closing
    steep = rays.step_x.abs() < rays.step_y.abs()
    middle = torch.where(steep, off_y * rays.step_y, off_x * rays.step_x)
    meet = torch.where(meet.isfinite(), meet, middle)
    meet = torch.minimum(torch.maximum(meet, middle - 1.5), middle + 1.5)
    return torch.minimum(meet.clamp_min(0), rays.end)


def _slope(
    solid: Tensor, here: Tensor, row: Tensor, column: Tensor, down: int, across: int
) -> Tensor:
    """Change of the inverse depth per pixel along one axis."""
    total = torch.zeros_like(here)
    count = torch.zeros_like(here)
    for sign in (-1, 1):
        r = row + sign * down
        c = column + sign * across
        inside = (r >= 0) & (r < solid.shape[0]) & (c >= 0) & (c < solid.shape[1])
        other = solid[r.clamp(0, solid.shape[0] - 1), c.clamp(0, solid.shape[1] - 1)]
        change = other - here
        agrees = inside & (change.abs() < AGREEING * here)
        total += torch.where(agrees, sign * change, 0.0)
        count += agrees
    return total / count.clamp_min(1)


def _edge_weight(rays: _Rays, t: Tensor, width: int, height: int) -> Tensor:
    """1, falling smoothly to 0 over the outer part of the image."""
    weight = torch.ones_like(t)
    for at, size in ((rays.x + t * rays.step_x, width), (rays.y + t * rays.step_y, height)):
        inner = (torch.minimum(at, size - at) / (EDGE * size)).clamp(0, 1)
        weight = weight * inner * inner * (3 - 2 * inner)
    return weight
