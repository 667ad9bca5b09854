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
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import kernels
from augment.effects.flood.flood import Layer
from augment.effects.flood.water_plane import window_offset
from augment.render.buffers import CPU, CUDA, kernels_for
from augment.render.threads import kernel_threads

# The kernels' thresholds, as numbers that torch takes.
COVERED, THICKNESS_M, THICKNESS = map(
    float, (kernels.COVERED, kernels.THICKNESS_M, kernels.THICKNESS)
)
HIDDEN_PX, NEAR_M = float(kernels.HIDDEN_PX), float(kernels.NEAR_M)
AGREEING, EDGE = float(kernels.AGREEING), float(kernels.EDGE)

STEP_PX = 0.25  # of the definition's march
RAYS = 1 << 18  # rays the definition marches at a time
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

    backend: kernels equal this definition but for rays that graze a silhouette's pixel. The CPU's
    trace every `stride`-th pixel of rows and columns, interpolate where four agree and trace the
    rest; it is 1, 2 or 4.

    Raises:
        ValueError: the camera is no window of the front's.
    """
    left, top = window_offset(front.camera, camera)
    size, device = (camera.height, camera.width), front.alpha.device
    if float(camera.centre[2]) <= level_z_m:
        distance = torch.full(size, math.inf, device=device)
        return ScreenReflection(front, distance, torch.zeros_like(distance))
    if needed is None:
        needed = torch.ones(size, dtype=torch.bool, device=device)
    backend = kernels_for(backend, front.alpha.detach())
    vertical = _vertical(front.camera, level_z_m)
    if backend == CUDA:
        from augment.effects.flood import cuda

        found = cuda.trace(front, camera, left, top, needed, vertical)
    elif backend == CPU:
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
    whole, (up, image, eye_height_m) = front.camera, vertical
    alpha = front.alpha.detach().contiguous().numpy()
    asked = needed.contiguous().numpy()
    block = kernels.BLOCK
    high, wide = (-(-size // block) * block for size in (whole.height, whole.width))
    pyramid = np.empty((high, wide + wide // 4), np.float32)
    numbers = (*up, *image, whole.fx, whole.fy, whole.cx, whole.cy, eye_height_m)
    numbers += (whole.width, whole.height)
    view = np.array(numbers, np.float32)
    rows, columns = -(-camera.height // stride), -(-camera.width // stride)
    ways, trust = np.empty((2, rows, columns), np.float32)
    distance, weight = np.empty((2, camera.height, camera.width), np.float32)
    with kernel_threads(ROWS):
        kernels.build_pyramid(alpha, front.depth.detach().contiguous().numpy(), pyramid)
        traced = pyramid, view, alpha, asked, *origin, stride, ways, trust
        kernels.trace(*traced)
        kernels.spread(*traced, distance, weight)
    return torch.from_numpy(distance), torch.from_numpy(weight)


@dataclass(frozen=True, eq=False)
class _Rays:
    """Mirrored rays in pixels; the letters are the module's.

    x, y: where they start. step_x, step_y: G / g. near: 1 / s. bend: c. scale: a g. end: the t at
    which the march is over; to_sky: infinitely far away. metres: |x|.
    """

    x: Float[Tensor, "N"]
    y: Float[Tensor, "N"]
    step_x: Float[Tensor, "N"]
    step_y: Float[Tensor, "N"]
    near: Float[Tensor, "N"]
    bend: Float[Tensor, "N"]
    scale: Float[Tensor, "N"]
    end: Float[Tensor, "N"]
    to_sky: Bool[Tensor, "N"]
    metres: Float[Tensor, "N"]

    def select(self, index: Tensor) -> _Rays:
        return _Rays(*(getattr(self, f.name)[index] for f in fields(self)))

    def inverse_depth(self, t: Tensor) -> Tensor:
        return (1 - self.bend * t) * self.near


def _mirrored_rays(camera: Camera, level_z_m: float, x: Tensor, y: Tensor) -> _Rays:
    """Of the pixels with centres (x, y), which see the water."""
    up, image, eye_height_m = _vertical(camera, level_z_m)
    u, v = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    slope = u * up[0] + v * up[1] + up[2]  # d_z < 0
    gx, gy = image[0] - x * up[2], image[1] - y * up[2]
    g = torch.maximum(gx.abs(), gy.abs()).clamp_min(1e-9)  # 0 at the point below the eye
    scale = -2 * slope * g
    bend = (1 - 2 * slope * up[2]) / scale
    near = -slope / eye_height_m
    step_x, step_y = gx / g, gy / g
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
    """The definition: every pixel, in small steps."""
    whole = front.camera
    row, column = torch.meshgrid(
        torch.arange(camera.height) + top, torch.arange(camera.width) + left, indexing="ij"
    )
    inside = (row >= 0) & (row < whole.height) & (column >= 0) & (column < whole.width)
    cover = torch.ones(row.shape, dtype=front.alpha.dtype)
    cover[inside] = front.alpha.detach()[row[inside], column[inside]]
    asked = needed & (cover < COVERED) & (camera.ray_directions(torch.float64)[..., 2] < 0)
    x, y = column[asked].double() + 0.5, row[asked].double() + 0.5
    rays = _mirrored_rays(whole, level_z_m, x, y)
    solid = torch.where(front.alpha.detach() >= 0.5, 1 / front.depth.detach().double(), 0.0)
    found = [_march(rays.select(part), solid) for part in torch.arange(len(x)).split(RAYS)]
    distance = torch.full(row.shape, math.inf, dtype=torch.float64)
    weight = torch.zeros_like(distance)
    if found:
        distance[asked] = torch.cat([d for d, _ in found])
        weight[asked] = torch.cat([w for _, w in found])
    return distance.float(), weight.float()


def _march(rays: _Rays, solid: Tensor) -> tuple[Tensor, Tensor]:
    """Metres to what is met and its weight. solid [H, W]: the front's inverse depth, 0 if none."""
    height, width = solid.shape
    way = torch.full_like(rays.x, math.inf)
    weight = torch.zeros_like(way)
    hidden = torch.zeros_like(way)  # pixels spent behind something without a break
    lost = torch.zeros_like(rays.to_sky)  # behind something at the last step
    clean = torch.ones_like(lost)  # never was behind anything
    going = torch.arange(len(way))
    first = (rays.x.floor(), rays.y.floor())
    step = 0
    while len(going):
        r = rays.select(going)
        begin, step = step * STEP_PX, step + 1
        over = begin >= r.end
        ends = going[over & r.to_sky & clean[going]]
        weight[ends] = _edge_weight(rays.select(ends), rays.end[ends], width, height)
        finish = torch.minimum(torch.full_like(r.end, step * STEP_PX), r.end)
        middle = 0.5 * (begin + finish)
        x = (r.x + middle * r.step_x).floor().clamp(0, width - 1)
        y = (r.y + middle * r.step_y).floor().clamp(0, height - 1)
        surface = solid[y.long(), x.long()]
        k0, k1 = r.inverse_depth(torch.full_like(r.end, begin)), r.inverse_depth(finish)
        started = (x != first[0][going]) | (y != first[1][going])
        reached = ~over & started & (surface > 0) & (torch.minimum(k0, k1) <= surface)
        met = reached & (torch.maximum(k0, k1) >= _back_side(surface))
        hits = going[met]
        hit, back = r.select(met), _back_side(surface[met])
        t = _refine(hit, solid, x[met], y[met])
        # Not farther than what was met, however the ray grazes it.
        share = torch.maximum(hit.inverse_depth(t), back) / hit.near
        way[hits] = hit.metres * t / (hit.scale * share)
        weight[hits] = _edge_weight(hit, t, width, height)
        lost = reached & ~met
        clean[going[lost]] = False
        hidden[going] = torch.where(lost, hidden[going] + STEP_PX, 0.0)
        going = going[~over & ~met & (hidden[going] <= HIDDEN_PX)]
    return way, weight


def _back_side(surface: Tensor) -> Tensor:
    """Inverse depth of the far side of what is seen at an inverse depth > 0."""
    depth = 1 / surface
    return 1 / (depth + (THICKNESS * depth).clamp_min(THICKNESS_M))


def _refine(rays: _Rays, solid: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Where the ray meets the plane through the pixel (x, y) it was found in, at most 1 px off it.

    The plane's inverse depth is linear in the image, by differences to neighbours that agree.
    """
    column, row = x.long(), y.long()
    here = solid[row, column]
    across = _slope(solid, here, row, column, 0, 1)
    down = _slope(solid, here, row, column, 1, 0)
    off_x, off_y = x + 0.5 - rays.x, y + 0.5 - rays.y
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
    total, count = torch.zeros_like(here), torch.zeros_like(here)
    for sign in (-1, 1):
        r, c = row + sign * down, column + sign * across
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
