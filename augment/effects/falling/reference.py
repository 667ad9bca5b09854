"""Reference of the kernels of falling drops in plain NumPy and torch: slow, and easy to check.

Each function here has the same input and output as a kernel in `drop_kernels`. Tests compare the
two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.effects.falling.drop_kernels import (
    EDGE,
    FADE,
    LEAST_LENGTH,
    LEAST_RADIUS,
    SOFT,
    CellWalk,
    Veil,
)
from augment.effects.falling.drops import CELL_FACTORS, MAX_IN_CELL
from augment.effects.falling.shower import ShowerInView
from augment.effects.falling.shower_kernels import (
    CLOUD_EXTINCTION_PER_M,
    CLOUD_TOP_M,
    LAYER_M,
    LUMP_CLIMB,
    LUMP_DEPTH,
    LUMP_LIGHT,
    LUMP_STEP_M,
    MIN_ALONG_M,
    STEP_M,
)
from augment.rng import STEP_X, mix


def find_drops_by_numpy(walk: CellWalk) -> Float32[np.ndarray, "N 9"]:
    """Find drops as drop_kernels.find_drops does, in all cells about each class's view."""
    drops = [_drops_of_class(walk, number) for number in range(len(walk.cells))]
    return np.concatenate(drops).astype(np.float32)


def _drops_of_class(walk: CellWalk, class_number: int) -> np.ndarray:
    """Return the drops of one size class, [N, 9], in the columns of drop_kernels.find_drops."""
    size, reach, max_depth, _, falling_share = walk.cells[class_number]
    rows = walk.slabs[walk.slabs[:, 0] == class_number, 1]
    if len(rows) == 0:
        return np.zeros((0, 9))
    columns = np.arange(*walk.columns[class_number])
    # The heights of the box: the middle of the view, plus and minus its reach.
    half_height = max_depth * np.sqrt(1 + (walk.lens[4:6] / walk.lens[:2]).sum() ** 2) + reach
    camera_from_world = walk.shutter.mean(0)
    eye_z = float(-(camera_from_world[:, :3].T @ camera_from_world[:, 3])[2])
    heights = (
        eye_z + np.array([-half_height, half_height]) - walk.moves[class_number, 1, 2]
    ) / size
    levels = np.arange(math.floor(heights[0]) - 1, math.ceil(heights[1]) + 2)
    cells = np.stack(np.meshgrid(rows, columns, levels, indexing="ij"), -1).reshape(-1, 3)
    cells = cells.astype(np.int64)
    cell_centres = (cells + 0.5) * size + walk.moves[class_number, 1]
    plane_distances = cell_centres @ walk.planes[:, :3].T + walk.planes[:, 3]
    cells = cells[(plane_distances >= -reach).all(1) & (plane_distances[:, 4] <= max_depth + reach)]
    factors = np.array(CELL_FACTORS, np.uint64)
    with np.errstate(over="ignore"):
        cell_keys = mix(
            walk.keys[class_number] + (cells.astype(np.uint64) * factors).sum(1, dtype=np.uint64)
        )
        is_drop = (cell_keys >> np.uint64(11)) / 2.0**53 >= walk.shares[:MAX_IN_CELL, None]
        drop_numbers, drop_cells = np.nonzero(is_drop)
        bits = mix(cell_keys[drop_cells] + (drop_numbers + 1).astype(np.uint64) * np.uint64(STEP_X))
        more_bits = mix(bits ^ np.uint64(STEP_X))
    # 22 bits are left above the 42nd; `unit` takes 21 of them.
    falls = ((more_bits >> np.uint64(42)) & np.uint64(0x1FFFFF)) / 2.0**21 < falling_share
    drop_cells = drop_cells[falls]
    bits = bits[falls]
    more_bits = more_bits[falls]

    def unit(values: np.ndarray, shift: int) -> np.ndarray:
        return ((values >> np.uint64(shift)) & np.uint64(0x1FFFFF)) / 2.0**21

    cell_fractions = np.stack([unit(bits, shift) for shift in (0, 21, 42)], 1)
    opening_points = (cells[drop_cells] + cell_fractions) * size + walk.moves[class_number, 0]
    if walk.sways[0] > 0:
        opening_points = opening_points + sway(
            opening_points, walk.sways[1], unit(more_bits, 21), float(walk.sways[0])
        )
    closing_points = opening_points + (walk.moves[class_number, 2] - walk.moves[class_number, 0])
    camera_points = [
        time_points @ camera_from_world[:, :3].T + camera_from_world[:, 3]
        for time_points, camera_from_world in zip(
            (opening_points, closing_points), walk.shutter, strict=True
        )
    ]
    quantile_index = unit(more_bits, 0) * (walk.quantiles.shape[1] - 1)
    diameters = np.interp(
        quantile_index, np.arange(walk.quantiles.shape[1]), walk.quantiles[class_number]
    )
    return _streaks(camera_points[0], camera_points[1], diameters, max_depth, walk.lens)


def sway(positions: np.ndarray, time: float, phase: np.ndarray, speed: float) -> np.ndarray:
    """Return how far eddies and flutter move flakes, [N, 3], as drop_kernels._sway does.

    Args:
        positions: positions of the flakes, metres, [N, 3].
        time: time in seconds.
        phase: phases of the flutter, 0 to 1, [N].
        speed: speed of the eddies and of the flutter, m/s.
    """
    shifts = np.zeros_like(positions)
    for wave in range(3):
        frequency = 2.0 + 0.7 * wave
        angle = (1.1 + 0.4 * wave) * positions[:, wave] + frequency * time
        amplitude = 0.6 * speed / frequency
        shifts[:, (wave + 1) % 3] += amplitude * np.sin(angle)
        shifts[:, (wave + 2) % 3] += amplitude * np.cos(angle)
    frequency = 4 + 8 * phase
    shifts[:, 0] += speed / frequency * np.sin(frequency * time + 50 * phase)
    shifts[:, 1] += speed / frequency * np.cos(frequency * time + 50 * phase)
    return shifts


def _streaks(
    opening_points: np.ndarray,
    closing_points: np.ndarray,
    diameters: np.ndarray,
    max_depth: float,
    lens: np.ndarray,
) -> np.ndarray:
    """Return the streaks that drops draw in the picture, [N, 9].

    Args:
        opening_points: positions in the camera's frame when the shutter opens, [N, 3].
        closing_points: positions in the camera's frame when the shutter closes, [N, 3].
        diameters: diameters of the drops, metres, [N].
        max_depth: depth up to which this class is drawn.
        lens: focal lengths, principal point, image size, nearest depth, aperture and focus.
    """
    fx, fy, cx, cy, width, height, near, aperture, focus = lens
    is_ahead = np.maximum(opening_points[:, 2], closing_points[:, 2]) > near
    opening_points = opening_points[is_ahead]
    closing_points = closing_points[is_ahead]
    diameters = diameters[is_ahead]
    crossing_share = (near - opening_points[:, 2]) / np.where(
        closing_points[:, 2] == opening_points[:, 2], 1, (closing_points - opening_points)[:, 2]
    )
    crossing = opening_points + crossing_share[:, None] * (closing_points - opening_points)
    crossing[:, 2] = near
    opening_points, closing_points = (
        np.where(ends[:, 2:] < near, crossing, ends) for ends in (opening_points, closing_points)
    )
    z0 = opening_points[:, 2]
    z1 = closing_points[:, 2]
    mean_z = (z0 + z1) / 2
    focal = math.sqrt(fx * fy)
    width_px = diameters / mean_z * focal
    blur = aperture * np.abs(1 / mean_z - 1 / focus) * focal
    outside = np.maximum((width_px + blur) / 2 + 0.5, LEAST_RADIUS)
    inside = np.maximum(np.abs(width_px - blur) / 2 - 0.5, 0)
    u = np.stack([fx * opening_points[:, 0] / z0 + cx, fx * closing_points[:, 0] / z1 + cx])
    v = np.stack([fy * opening_points[:, 1] / z0 + cy, fy * closing_points[:, 1] / z1 + cy])
    fade = np.clip((max_depth - mean_z) / ((1 - FADE) * max_depth), 0, 1)
    # The disc covers as much up to `inside` as in its middle, then less, as a paraboloid, whose
    # integral is pi / 2 (outside^2 + inside^2). It takes two cross-sections.
    cover = width_px**2 / (outside**2 + inside**2) * fade
    is_in_view = (mean_z < max_depth) & (u.max(0) >= -outside) & (v.max(0) >= -outside)
    is_in_view &= (u.min(0) <= width + outside) & (v.min(0) <= height + outside)
    numbers = (u[0], v[0], u[1], v[1], 1 / z0, 1 / z1, inside, outside, cover)
    return np.stack(numbers, 1)[is_in_view]


def path_integral(h2: np.ndarray, start: np.ndarray, length: float) -> np.ndarray:
    """Return the integral of (h2 - x^2)+ over the path x = start to start + length."""
    h = np.sqrt(np.maximum(h2, 0))
    low = np.clip(start, -h, h)
    high = np.clip(start + length, -h, h)
    return h**2 * (high - low) - (high**3 - low**3) / 3


def cover_by_numpy(
    drops: np.ndarray, alpha: np.ndarray, depth: np.ndarray
) -> Float[np.ndarray, "H W"]:
    """Return the share of each pixel that no drop covers, as drop_kernels.cover_pixels does.

    A pixel has the mean of the disc's profile over the path of the disc.

    Args:
        drops: streaks from `find_drops_by_numpy`, [N, 9].
        alpha: opacity of the splats, [H, W].
        depth: depth of the splats, metres, [H, W]; 0 where there are none.
    """
    height, width = depth.shape
    clear = np.ones((height, width))
    for u0, v0, u1, v1, start_per_z, end_per_z, inside, outside, share in drops.astype(np.float64):
        rows = slice(
            max(0, math.floor(min(v0, v1) - outside)), math.ceil(max(v0, v1) + outside) + 1
        )
        columns = slice(max(0, math.floor(min(u0, u1) - outside)), math.ceil(max(u0, u1) + outside))
        y, x = np.mgrid[:height, :width][:, rows, columns] + 0.5
        du = u1 - u0
        dv = v1 - v0
        length = math.hypot(du, dv)
        if length < LEAST_LENGTH:
            length = LEAST_LENGTH
            u0 = (u0 + u1 - LEAST_LENGTH) / 2
            du = LEAST_LENGTH
            dv = 0.0
        along = ((x - u0) * du + (y - v0) * dv) / length**2
        start = -along * length
        across2 = (((x - u0) * dv - (y - v0) * du) / length) ** 2
        integral = path_integral(outside**2 - across2, start, length)
        integral -= path_integral(inside**2 - across2, start, length)
        covered = np.minimum(integral * share / ((outside**2 - inside**2) * length), 1)
        along = along.clip(0, 1)
        per_z = start_per_z + along * (end_per_z - start_per_z)
        surface = depth[rows, columns]
        behind = ((1 - surface * per_z) / SOFT).clip(0, 1)
        hidden_share = np.where(surface > 0, alpha[rows, columns] * behind, 0)
        clear[rows, columns] *= 1 - covered * (1 - hidden_share)
    return clear


def blend_by_torch(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    clear: Float[Tensor, "H W"],
    veil: Veil,
    splats: Float[Tensor, "H W 3"] | None = None,
    shower: ShowerInView | None = None,
) -> Float[Tensor, "H W 3"]:
    """Return the picture behind the drops and their veil, as drop_kernels.blend_falling does.

    With a shower it does as shower_kernels.blend_shower.

    Args:
        rgb: display-encoded picture.
        alpha: opacity of the splats.
        depth: depth of the splats, metres; 0 where there are none.
        clear: share of each pixel that no drop covers.
        veil: veil of the drops that are not drawn.
        splats: colour of the splats alone; None if edges are not separated from the sky.
        shower: the shower; None if the rate is the same everywhere.
    """
    rays, rise, bands, upwards, airlight, glow = (
        torch.from_numpy(numbers).to(rgb.device, rgb.dtype) for numbers in veil
    )
    height, width = depth.shape
    u = (torch.arange(width, device=rgb.device, dtype=rgb.dtype) + 0.5 - rays[2]) * rays[0]
    v = (torch.arange(height, device=rgb.device, dtype=rgb.dtype) + 0.5 - rays[3]) * rays[1]
    v, u = torch.meshgrid(v, u, indexing="ij")
    length = torch.sqrt(1 + u * u + v * v)
    z = depth[..., None]
    extinction, band_start, band_depth, half_inverse, full_depth = bands.unbind(1)
    depth_in_band = torch.minimum((z - band_start).clamp_min(0), band_depth)
    tau = (extinction * (depth_in_band**2 * half_inverse + (z - full_depth).clamp_min(0))).sum(-1)
    slope = rise[0] * u + rise[1] * v + rise[2]
    surface_air = sky_air = airlight
    sky_glow = airlight.new_zeros(3)
    if shower is None:
        sky_transmittance = torch.exp(-(upwards * length / slope.clamp_min(1e-6)).clamp_max(80))
    else:
        rays_in_shower = _rays_in_shower(shower, u, v, depth, slope)
        tau = tau + rays_in_shower.excess
        surface_air = airlight * rays_in_shower.surface_light[..., None]
        through_rain = torch.exp(-(rays_in_shower.sky_depth * length).clamp(0, 80))
        through_cloud = torch.exp(-(rays_in_shower.cloud_depth * length).clamp(0, 80))
        sky_transmittance = through_rain * through_cloud
        cloud = torch.from_numpy(shower.cloud).to(airlight)
        rain_share = (1 - through_rain) * rays_in_shower.sky_light
        cloud_share = through_rain * (1 - through_cloud) * rays_in_shower.cloud_light
        sky_glow = rain_share[..., None] * airlight + cloud_share[..., None] * cloud
        sky_air = airlight.new_zeros(3)
    surface_share = torch.where(depth > 0, alpha, 0)
    surface_transmittance = torch.exp(-(tau * length).clamp(0, 80))
    directions = torch.stack([u, v, torch.ones_like(u)], -1) / length[..., None]
    drop_light = directions @ glow[:, :3].T + glow[:, 3]
    rgb_linear = rgb.clamp_min(0)
    before_surface = surface_air + surface_transmittance[..., None] * (rgb_linear**2 - surface_air)
    before_sky = sky_air + sky_transmittance[..., None] * (rgb_linear**2 - sky_air) + sky_glow
    veiled_rgb = before_sky + surface_share[..., None] * (before_surface - before_sky)
    if splats is not None:
        surface_parts = surface_share[..., None]
        sky_share = 1 - surface_share[..., None]
        sky_rgb = torch.minimum((rgb_linear - splats).clamp_min(0), sky_share)
        surface_rgb = ((rgb_linear - sky_rgb) / surface_parts.clamp_min(EDGE)) ** 2
        sky_rgb = (sky_rgb / sky_share.clamp_min(EDGE)) ** 2
        surface_rgb = surface_air + surface_transmittance[..., None] * (surface_rgb - surface_air)
        sky_rgb = sky_air + sky_transmittance[..., None] * (sky_rgb - sky_air) + sky_glow
        edge_rgb = (
            surface_parts * surface_rgb.clamp_min(0).sqrt()
            + sky_share * sky_rgb.clamp_min(0).sqrt()
        )
        green = rgb[..., 1:2] - splats[..., 1:2]
        is_edge = torch.minimum(torch.minimum(surface_parts, sky_share), green) >= EDGE
        veiled_rgb = torch.where(is_edge, edge_rgb**2, veiled_rgb)
    rgb_linear = veiled_rgb
    return (
        (drop_light + clear[..., None].to(rgb.dtype) * (rgb_linear - drop_light))
        .clamp_min(0)
        .sqrt()
    )


class _RaysInShower(NamedTuple):
    """Numbers of the rays of a picture in a shower, [H, W] each; depths at unit length of a ray."""

    excess: Tensor  # optical depth up to the surface that the rate at the eye leaves out
    surface_light: Tensor  # light of the veil before the surface
    sky_depth: Tensor  # optical depth of the rain before the sky
    cloud_depth: Tensor  # that of the cloud
    sky_light: Tensor  # light of the veil before the sky
    cloud_light: Tensor  # light of the cloud over its mean


def _rays_in_shower(
    shower: ShowerInView, u: Tensor, v: Tensor, depth: Tensor, slope: Tensor
) -> _RaysInShower:
    rows, axes, at_eye, _, lumps, eye = (torch.from_numpy(numbers).to(u) for numbers in shower)

    def integrals(distance: Tensor) -> Tensor:
        x = distance / STEP_M + len(rows) // 2
        low = x.clamp(0, len(rows) - 2).long()
        return rows[low] + (x - low)[..., None] * (rows[low + 1] - rows[low])

    def mean_and_light(distance: Tensor) -> tuple[Tensor, Tensor]:
        in_reach = distance.abs() > MIN_ALONG_M
        parts = integrals(distance)
        mean = torch.where(in_reach, parts[..., 0] / torch.where(in_reach, distance, 1), at_eye[0])
        has_light = in_reach & (parts[..., 0].abs() > 1e-9)
        light = parts[..., 1] / torch.where(has_light, parts[..., 0], 1)
        return mean, torch.where(has_light, light, 1)

    along = axes[0, 0] * u + axes[0, 1] * v + axes[0, 2]
    across = axes[1, 0] * u + axes[1, 1] * v + axes[1, 2]
    per_climb = 1 / slope.clamp_min(1e-6)
    lump = _lump(
        lumps,
        eye[0] + LAYER_M / LUMP_STEP_M * along * per_climb,
        eye[1] + LAYER_M / LUMP_STEP_M * across * per_climb,
    )
    lump = lump * (slope / LUMP_CLIMB - 0.5).clamp(0, 1)
    mean, surface_light = mean_and_light(depth * along)
    base = LAYER_M * along * per_climb
    top = CLOUD_TOP_M * along * per_climb
    sky_mean, sky_light = mean_and_light(base)
    crosses = (top - base).abs() > MIN_ALONG_M
    cover = (integrals(top) - integrals(base))[..., 2] / torch.where(crosses, top - base, 1)
    cover = torch.where(crosses, cover, at_eye[1]) * (1 + LUMP_DEPTH * lump)
    cloud_depth = CLOUD_EXTINCTION_PER_M * (CLOUD_TOP_M - LAYER_M) * per_climb * cover
    excess = depth * (mean - at_eye[0])
    return _RaysInShower(
        excess,
        surface_light,
        LAYER_M * per_climb * sky_mean,
        cloud_depth,
        sky_light,
        1 + LUMP_LIGHT * lump,
    )


def _lump(lumps: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return a periodic tile's values between its cells."""
    size = len(lumps)
    i = x.floor().long() % size
    j = y.floor().long() % size
    right = (i + 1) % size
    below = (j + 1) % size
    x = x - x.floor()
    y = y - y.floor()
    x = x * x * (3 - 2 * x)
    y = y * y * (3 - 2 * y)
    upper = lumps[j, i] + x * (lumps[j, right] - lumps[j, i])
    lower = lumps[below, i] + x * (lumps[below, right] - lumps[below, i])
    return upper + y * (lower - upper)
