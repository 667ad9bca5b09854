"""Reflections in flat water from the camera's own image: a march through its depth.

This file holds the torch definition and the launch of the kernels (Lee et al. 2018,
"Mipmap-accelerated screen space reflections").

A mirrored ray starts at the point x = s d where the pixel's ray d (unit z in the camera, eye at 0)
meets the water. It runs along d - 2 d_z n, where n is the vertical. Let a = -2 d_z, and let n's
image in homogeneous pixels be N = (fx n_x + cx n_z, fy n_y + cy n_z, n_z). The ray's image is the
straight line from the pixel p towards the vertical's vanishing point, G = N_xy - p n_z. The march
counts t pixels along the longer axis of G, where G has length g = max |G|. With
c = (1 + a n_z) / (a g):

    1/z = (1 - c t) / s        metres along the ray = |x| t / (a g (1 - c t))

The ray gets infinitely far away at t = 1 / c if c > 0, and comes back to the camera's plane if
c < 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.effects.flood import mirror_ray_kernels
from augment.effects.flood.flood_medium import Layer
from augment.effects.flood.water_plane import Window, falling, window_offset
from augment.render.buffers import CPU, choose_kernels
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# The kernels' thresholds as Python floats, which torch accepts.
MIN_COVERED_ALPHA, THICKNESS_M, THICKNESS = map(
    float,
    (mirror_ray_kernels.COVERED, mirror_ray_kernels.THICKNESS_M, mirror_ray_kernels.THICKNESS),
)
HIDDEN_PX = float(mirror_ray_kernels.HIDDEN_PX)
NEAR_M = float(mirror_ray_kernels.NEAR_M)
AGREEING = float(mirror_ray_kernels.AGREEING)
EDGE = float(mirror_ray_kernels.EDGE)

SAMPLES = 1 << 23  # samples that the definition evaluates at a time
MIN_PX = 16  # fewest pixels by which all rays advance at a time
ROWS = 4  # rows of rays that a thread takes at a time


@dataclass(frozen=True, eq=False)
class ScreenReflection:
    """Lengths of the mirrored rays of a window's pixels, up to surfaces that the image shows."""

    layer: Layer
    """The layer of the march, with the whole image's camera."""

    distance: Float[Tensor, "h w"]
    """Metres along the mirrored ray from the flat surface; infinite where the ray ends in the sky
    or its end is unknown.
    """

    weight: Float[Tensor, "h w"]
    """Reliability of the distance, 0 to 1."""


def trace_screen(
    front: Layer,
    camera: Camera,
    level_z_m: float,
    *,
    needed: Bool[Tensor, "h w"] | None = None,
    stride: int = 4,
    backend: str = CPU,
) -> ScreenReflection:
    """Trace the mirrored rays of the flat surface z = level_z_m, for the pixels of `camera`.

    The weight is 0 for pixels that are not needed, that the front covers, or whose ray does not
    meet the water. It is 0 for mirrored rays that leave the image, come back to the camera's plane,
    or get lost behind something thin. It falls to 0 over the outer 4 % of the image.

    Args:
        front: the scene above the water, over the whole image.
        camera: a window of that image, which may reach beyond it.
        level_z_m: height of the surface, scene world.
        needed: the pixels to trace; None for all.
        stride: 1, 2 or 4. The kernels trace every `stride`-th pixel of rows and columns,
            interpolate where four of them agree, and trace the other pixels.
        backend: the CPU's kernels equal this definition, except for rays that graze a
            silhouette's pixel.

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
    if choose_kernels(backend, front.alpha.detach()) == CPU:
        vertical = _vertical(front.camera, level_z_m)
        distance_and_weight = _run_kernels(front, camera, vertical, (left, top), stride, needed)
    else:
        distance_and_weight = _trace(front, camera, level_z_m, left, top, needed)
    return ScreenReflection(front, *distance_and_weight)


def _vertical(camera: Camera, level_z_m: float) -> tuple[list[float], list[float], float]:
    """Return the vertical in the camera, its image N in homogeneous pixels, and the eye height."""
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
    image_camera = front.camera
    (up, image, eye_height_m) = vertical
    alpha = front.alpha.detach().contiguous().numpy()
    needed_pixels = needed.contiguous().numpy()
    block = mirror_ray_kernels.BLOCK
    padded_height, padded_width = (
        -(-size // block) * block for size in (image_camera.height, image_camera.width)
    )
    pyramid = np.empty((padded_height, padded_width + padded_width // 4), np.float32)
    numbers = (
        *up,
        *image,
        image_camera.fx,
        image_camera.fy,
        image_camera.cx,
        image_camera.cy,
        eye_height_m,
    )
    numbers += (image_camera.width, image_camera.height)
    view = np.array(numbers, np.float32)
    rows = -(-camera.height // stride)
    columns = -(-camera.width // stride)
    ray_ratios, weights = np.empty((2, rows, columns), np.float32)
    distance, weight = np.empty((2, camera.height, camera.width), np.float32)
    with kernel_threads(ROWS):
        mirror_ray_kernels.build_pyramid(alpha, front.depth.detach().contiguous().numpy(), pyramid)
        traced = pyramid, view, alpha, needed_pixels, *origin, stride, ray_ratios, weights
        mirror_ray_kernels.trace(*traced)
        mirror_ray_kernels.spread(*traced, distance, weight)
    return torch.from_numpy(distance), torch.from_numpy(weight)


class _Rays(NamedTuple):
    """Mirrored rays in pixels, [N] or [N, 1]; the letters are the module's."""

    x: Tensor  # column where the ray starts
    y: Tensor  # row where the ray starts
    step_x: Tensor  # G_x / g
    step_y: Tensor  # G_y / g
    start_inverse_depth: Tensor  # 1 / s
    bend: Tensor  # c
    scale: Tensor  # a g
    end: Tensor  # t at which the march is over
    to_sky: Tensor  # True if the ray is infinitely far away there
    metres: Tensor  # |x|

    def select(self, index: Tensor) -> _Rays:
        return _Rays(*(part[index] for part in self))

    def inverse_depth(self, t: Tensor) -> Tensor:
        return (1 - self.bend * t) * self.start_inverse_depth

    def pixel(self, t: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Return column and row after t pixels, clamped to the image."""
        x = (self.x + t * self.step_x).floor().clamp(0, width - 1)
        return x.long(), (self.y + t * self.step_y).floor().clamp(0, height - 1).long()


def _mirrored_rays(camera: Camera, level_z_m: float, x: Tensor, y: Tensor) -> _Rays:
    """Return the mirrored rays of pixels with centres (x, y), all of which see the water."""
    up, image, eye_height_m = _vertical(camera, level_z_m)
    u = (x - camera.cx) / camera.fx
    v = (y - camera.cy) / camera.fy
    slope = u * up[0] + v * up[1] + up[2]  # d_z < 0
    gx = image[0] - x * up[2]
    gy = image[1] - y * up[2]
    g = torch.maximum(gx.abs(), gy.abs()).clamp_min(1e-9)  # 0 at the point below the eye
    scale = -2 * slope * g
    bend = (1 - 2 * slope * up[2]) / scale
    start_inverse_depth = -slope / eye_height_m
    step_x = gx / g
    step_y = gy / g
    sky_end = torch.where(bend > 0, 1 / bend, math.inf)
    plane_end = torch.where(bend < 0, (1 - 1 / (start_inverse_depth * NEAR_M)) / bend, math.inf)
    out_x = torch.where(gx > 0, camera.width - x, x) / step_x.abs()
    out_y = torch.where(gy > 0, camera.height - y, y) / step_y.abs()
    image_end = torch.minimum(torch.minimum(out_x, out_y), plane_end)
    metres = torch.sqrt(1 + u * u + v * v) / start_inverse_depth
    end = torch.minimum(sky_end, image_end)
    return _Rays(
        x, y, step_x, step_y, start_inverse_depth, bend, scale, end, sky_end <= image_end, metres
    )


def _trace(
    front: Layer, camera: Camera, level_z_m: float, left: int, top: int, needed: Bool[Tensor, "h w"]
) -> tuple[Tensor, Tensor]:
    """Trace every needed pixel, in steps of a pixel along the ray's longer axis."""
    image_camera = front.camera
    device = front.alpha.device
    alpha = front.alpha.detach()
    depth = front.depth.detach()
    window = Window(left, top, left + camera.width, top + camera.height)
    cover = torch.ones(camera.height, camera.width, dtype=alpha.dtype, device=device)
    image_slices, window_slices = window.overlap(alpha)
    cover[window_slices] = alpha[image_slices]
    traced = needed & (cover < MIN_COVERED_ALPHA) & falling(camera, device)
    row, column = torch.nonzero(traced, as_tuple=True)
    x = (column + (left + 0.5)).double()
    y = (row + (top + 0.5)).double()
    rays = _mirrored_rays(image_camera, level_z_m, x, y)
    solid = torch.where(alpha >= 0.5, 1 / depth.double(), 0.0)
    distance = torch.full(cover.shape, math.inf, device=device)
    weight = torch.zeros_like(distance)
    ray_metres, ray_weight = _march(rays, solid)
    distance[row, column] = ray_metres.float()
    weight[row, column] = ray_weight.float()
    return distance, weight


def _march(rays: _Rays, solid: Tensor) -> tuple[Tensor, Tensor]:
    """Return metres to the first surface along each ray, and the weight.

    solid [H, W]: inverse depth of the front layer, 0 without a surface.
    """
    height, width = solid.shape
    end_steps = torch.full_like(rays.x, math.nan)  # steps to the surface that is hit, or to the sky
    has_hit = torch.zeros_like(rays.to_sky)
    num_hidden = torch.zeros_like(
        rays.x, dtype=torch.long
    )  # steps behind something without a break
    never_hidden = torch.ones_like(rays.to_sky)  # never was behind anything
    active = torch.arange(len(rays.x), device=solid.device)
    first_step = 1
    while len(active):
        count = min(max(SAMPLES // len(active), MIN_PX), max(width, height) + 2)
        active_rays = rays.select(active[:, None])
        step = torch.arange(first_step, first_step + count, device=solid.device)  # pixels' centres
        is_over = step - 0.5 >= active_rays.end
        x, y = active_rays.pixel(step, width, height)
        surface = solid[y, x]
        k0 = active_rays.inverse_depth(step - 0.5)
        k1 = active_rays.inverse_depth(torch.minimum(step + 0.5, active_rays.end))
        is_reached = ~is_over & (surface > 0) & (torch.minimum(k0, k1) <= surface)
        is_hit = is_reached & (torch.maximum(k0, k1) >= _back_side(surface))
        is_behind = is_reached & ~is_hit
        # Steps behind something since the last free step, in this stretch or in earlier ones.
        last_free_step = (
            torch.where(is_behind, first_step - 1 - num_hidden[active][:, None], step)
            .cummax(1)
            .values
        )
        is_stop = is_over | is_hit | (step - last_free_step > HIDDEN_PX)
        stop_index = is_stop.to(torch.uint8).argmax(1, keepdim=True)
        has_stopped = is_stop.gather(1, stop_index)[:, 0]
        stays_clean = never_hidden[active] & ~(is_behind & (step < first_step + stop_index)).any(1)
        hits = is_hit.gather(1, stop_index)[:, 0] & has_stopped
        to_sky = (
            is_over.gather(1, stop_index)[:, 0] & has_stopped & stays_clean & rays.to_sky[active]
        )
        end_step = torch.where(
            hits, (first_step + stop_index[:, 0]).to(solid.dtype), rays.end[active]
        )
        end_steps[active] = torch.where(hits | to_sky, end_step, math.nan)
        has_hit[active] = hits
        never_hidden[active] = stays_clean
        num_hidden[active] = first_step + count - 1 - last_free_step[:, -1]
        active = active[~has_stopped]
        first_step = first_step + count
    x, y = rays.pixel(end_steps.nan_to_num(0), width, height)
    surface_at_end = solid[y, x]
    t = torch.where(has_hit, _refine(rays, solid, x, y), end_steps)
    # The end is not beyond the surface that was hit, even if the ray grazes it.
    depth_ratio = (
        torch.maximum(rays.inverse_depth(t), _back_side(surface_at_end)) / rays.start_inverse_depth
    )
    ray_metres = torch.where(has_hit, rays.metres * t / (rays.scale * depth_ratio), math.inf)
    return ray_metres, _edge_weight(rays, t, width, height).nan_to_num(0)


def _back_side(surface: Tensor) -> Tensor:
    """Return the inverse depth of the back of a surface whose front has an inverse depth > 0."""
    depth = 1 / surface
    return 1 / (depth + (THICKNESS * depth).clamp_min(THICKNESS_M))


def _refine(rays: _Rays, solid: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the t at which the ray meets the plane through the surface in pixel (x, y).

    It is at most 1 px off that pixel. The plane's inverse depth is linear in the image; its slopes
    are differences to neighbours that agree.
    """
    inverse_depth = solid[y, x]
    across = _slope(solid, inverse_depth, y, x, 0, 1)
    down = _slope(solid, inverse_depth, y, x, 1, 0)
    off_x = x + 0.5 - rays.x
    off_y = y + 0.5 - rays.y
    closing = -rays.bend * rays.start_inverse_depth - across * rays.step_x - down * rays.step_y
    t_meet = (inverse_depth - across * off_x - down * off_y - rays.start_inverse_depth) / closing
    is_steep = rays.step_x.abs() < rays.step_y.abs()
    middle = torch.where(is_steep, off_y * rays.step_y, off_x * rays.step_x)
    t_meet = torch.where(t_meet.isfinite(), t_meet, middle)
    t_meet = torch.minimum(torch.maximum(t_meet, middle - 1.5), middle + 1.5)
    return torch.minimum(t_meet.clamp_min(0), rays.end)


def _slope(
    solid: Tensor, inverse_depth: Tensor, row: Tensor, column: Tensor, down: int, across: int
) -> Tensor:
    """Return the change of the inverse depth per pixel along one axis."""
    total = torch.zeros_like(inverse_depth)
    count = torch.zeros_like(inverse_depth)
    for sign in (-1, 1):
        neighbour_row = row + sign * down
        neighbour_column = column + sign * across
        inside = (
            (neighbour_row >= 0)
            & (neighbour_row < solid.shape[0])
            & (neighbour_column >= 0)
            & (neighbour_column < solid.shape[1])
        )
        neighbour = solid[
            neighbour_row.clamp(0, solid.shape[0] - 1),
            neighbour_column.clamp(0, solid.shape[1] - 1),
        ]
        change = neighbour - inverse_depth
        agrees = inside & (change.abs() < AGREEING * inverse_depth)
        total += torch.where(agrees, sign * change, 0.0)
        count += agrees
    return total / count.clamp_min(1)


def _edge_weight(rays: _Rays, t: Tensor, width: int, height: int) -> Tensor:
    """Return a weight of 1 that falls smoothly to 0 over the outer part of the image."""
    weight = torch.ones_like(t)
    for coordinate, size in ((rays.x + t * rays.step_x, width), (rays.y + t * rays.step_y, height)):
        inner = (torch.minimum(coordinate, size - coordinate) / (EDGE * size)).clamp(0, 1)
        weight = weight * inner * inner * (3 - 2 * inner)
    return weight
