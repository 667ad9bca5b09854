"""Reference of the kernels of falling drops in plain NumPy and torch: slow, and easy to check."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.effects.falling.drops import CELL_FACTORS, MAX_IN_CELL
from augment.effects.falling.kernels import EDGE, FADE, LEAST_RADIUS, SOFT
from augment.rng import STEP_X, mix

if TYPE_CHECKING:
    from augment.effects.falling.air import CellWalk, Veil


def find_drops_by_numpy(walk: CellWalk) -> Float32[np.ndarray, "N 9"]:
    """Find drops as kernels.find_drops does, in all cells of the box around each class's view."""
    drops = [_drops_of_class(walk, number) for number in range(len(walk.cells))]
    return np.concatenate(drops).astype(np.float32)


def _drops_of_class(walk: CellWalk, number: int) -> np.ndarray:
    size, reach, farthest, _ = walk.cells[number]
    rows = walk.slabs[walk.slabs[:, 0] == number, 1]
    if len(rows) == 0:
        return np.zeros((0, 9))
    columns = np.arange(*walk.columns[number])
    # The heights of the box: the middle of the view, plus and minus its reach.
    around = farthest * np.sqrt(1 + (walk.lens[4:6] / walk.lens[:2]).sum() ** 2) + reach
    pose = walk.shutter.mean(0)
    eye_z = float(-(pose[:, :3].T @ pose[:, 3])[2])
    heights = (eye_z + np.array([-around, around]) - walk.moves[number, 1, 2]) / size
    levels = np.arange(math.floor(heights[0]) - 1, math.ceil(heights[1]) + 2)
    cells = np.stack(np.meshgrid(rows, columns, levels, indexing="ij"), -1).reshape(-1, 3)
    cells = cells.astype(np.int64)
    middles = (cells + 0.5) * size + walk.moves[number, 1]
    inside = middles @ walk.planes[:, :3].T + walk.planes[:, 3]
    cells = cells[(inside >= -reach).all(1) & (inside[:, 4] <= farthest + reach)]
    factors = np.array(CELL_FACTORS, np.uint64)
    with np.errstate(over="ignore"):
        key = mix(walk.keys[number] + (cells.astype(np.uint64) * factors).sum(1, dtype=np.uint64))
        counts = (key >> np.uint64(11)) / 2.0**53 >= walk.shares[:MAX_IN_CELL, None]
        drop, cell = np.nonzero(counts)
        bits = mix(key[cell] + (drop + 1).astype(np.uint64) * np.uint64(STEP_X))
        more = mix(bits ^ np.uint64(STEP_X))

    def unit(values: np.ndarray, shift: int) -> np.ndarray:
        return ((values >> np.uint64(shift)) & np.uint64(0x1FFFFF)) / 2.0**21

    within = np.stack([unit(bits, shift) for shift in (0, 21, 42)], 1)
    points = (cells[cell] + within) * size + walk.moves[number, 0]
    if walk.sways[0] > 0:
        points = points + sway(points, walk.sways[1], unit(more, 21), float(walk.sways[0]))
    closed = points + (walk.moves[number, 2] - walk.moves[number, 0])
    ends = [
        point @ pose[:, :3].T + pose[:, 3]
        for point, pose in zip((points, closed), walk.shutter, strict=True)
    ]
    quantile_index = unit(more, 0) * (walk.quantiles.shape[1] - 1)
    across = np.interp(quantile_index, np.arange(walk.quantiles.shape[1]), walk.quantiles[number])
    return _streaks(ends[0], ends[1], across, farthest, walk.lens)


def sway(at: np.ndarray, time: float, phase: np.ndarray, speed: float) -> np.ndarray:
    """Return how far eddies and flutter move flakes, [N, 3], as kernels._sway does.

    phase: of the flutter, 0 to 1. speed: of eddies and of flutter, m/s.
    """
    out = np.zeros_like(at)
    for wave in range(3):
        pace = 2.0 + 0.7 * wave
        angle = (1.1 + 0.4 * wave) * at[:, wave] + pace * time
        size = 0.6 * speed / pace
        out[:, (wave + 1) % 3] += size * np.sin(angle)
        out[:, (wave + 2) % 3] += size * np.cos(angle)
    pace = 4 + 8 * phase
    out[:, 0] += speed / pace * np.sin(pace * time + 50 * phase)
    out[:, 1] += speed / pace * np.cos(pace * time + 50 * phase)
    return out


def _streaks(
    opened: np.ndarray, closed: np.ndarray, across: np.ndarray, farthest: float, lens: np.ndarray
) -> np.ndarray:
    """Return drops in the picture from their positions at shutter opening and closing, [N, 3]."""
    fx, fy, cx, cy, width, height, near, aperture, focus = lens
    is_ahead = np.maximum(opened[:, 2], closed[:, 2]) > near
    opened = opened[is_ahead]
    closed = closed[is_ahead]
    across = across[is_ahead]
    cut = (near - opened[:, 2]) / np.where(closed[:, 2] == opened[:, 2], 1, (closed - opened)[:, 2])
    crossing = opened + cut[:, None] * (closed - opened)
    crossing[:, 2] = near
    opened, closed = (np.where(e[:, 2:] < near, crossing, e) for e in (opened, closed))
    z0 = opened[:, 2]
    z1 = closed[:, 2]
    z = (z0 + z1) / 2
    focal = math.sqrt(fx * fy)
    width_px = across / z * focal
    blur = aperture * np.abs(1 / z - 1 / focus) * focal
    outside = np.maximum((width_px + blur) / 2 + 0.5, LEAST_RADIUS)
    inside = np.maximum(np.abs(width_px - blur) / 2 - 0.5, 0)
    u = np.stack([fx * opened[:, 0] / z0 + cx, fx * closed[:, 0] / z1 + cx])
    v = np.stack([fy * opened[:, 1] / z0 + cy, fy * closed[:, 1] / z1 + cy])
    length = np.hypot(u[1] - u[0], v[1] - v[0])
    # Cover is 1 up to `inside`, then falls as a parabola: across a line, and over a disc.
    slope = (2 * outside + inside) * (outside - inside)
    spread = length * (2 * inside + slope / (1.5 * (outside + inside)))
    spread += math.pi / 2 * (outside**2 + inside**2)
    fade = np.clip((farthest - z) / ((1 - FADE) * farthest), 0, 1)
    cover = np.minimum(math.pi / 2 * width_px**2 / spread, 1) * fade
    is_in_view = (z < farthest) & (u.max(0) >= -outside) & (v.max(0) >= -outside)
    is_in_view &= (u.min(0) <= width + outside) & (v.min(0) <= height + outside)
    numbers = (u[0], v[0], u[1], v[1], 1 / z0, 1 / z1, inside, outside, cover)
    return np.stack(numbers, 1)[is_in_view]


def cover_by_numpy(
    drops: np.ndarray, alpha: np.ndarray, depth: np.ndarray
) -> Float[np.ndarray, "H W"]:
    """Return the clear share of each pixel, as kernels.cover_pixels does."""
    height, width = depth.shape
    clear = np.ones((height, width))
    for u0, v0, u1, v1, first_per_z, last_per_z, inside, outside, share in drops.astype(np.float64):
        rows = slice(
            max(0, math.floor(min(v0, v1) - outside)), math.ceil(max(v0, v1) + outside) + 1
        )
        across = slice(max(0, math.floor(min(u0, u1) - outside)), math.ceil(max(u0, u1) + outside))
        y, x = np.mgrid[:height, :width][:, rows, across] + 0.5
        du = u1 - u0
        dv = v1 - v0
        along = ((x - u0) * du + (y - v0) * dv) / max(du * du + dv * dv, 1e-12)
        along = along.clip(0, 1)
        distance2 = (x - u0 - along * du) ** 2 + (y - v0 - along * dv) ** 2
        covered = ((outside**2 - distance2) / (outside**2 - inside**2)).clip(0, 1) * share
        per_z = first_per_z + along * (last_per_z - first_per_z)
        surface = depth[rows, across]
        hidden_weight = ((1 - surface * per_z) / SOFT).clip(0, 1)
        hidden_share = np.where(surface > 0, alpha[rows, across] * hidden_weight, 0)
        clear[rows, across] *= 1 - covered * (1 - hidden_share)
    return clear


def blend_by_torch(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    clear: Float[Tensor, "H W"],
    veil: Veil,
    splats: Float[Tensor, "H W 3"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Blend as kernels.blend_falling does."""
    rays, climb, bands, upwards, airlight, glow = (
        torch.from_numpy(numbers).to(rgb.device, rgb.dtype) for numbers in veil
    )
    height, width = depth.shape
    u = (torch.arange(width, device=rgb.device, dtype=rgb.dtype) + 0.5 - rays[2]) * rays[0]
    v = (torch.arange(height, device=rgb.device, dtype=rgb.dtype) + 0.5 - rays[3]) * rays[1]
    v, u = torch.meshgrid(v, u, indexing="ij")
    length = torch.sqrt(1 + u * u + v * v)
    z = depth[..., None]
    extinction, begin, grows, half_inverse, full_depth = bands.unbind(1)
    inside = torch.minimum((z - begin).clamp_min(0), grows)
    tau = (extinction * (inside**2 * half_inverse + (z - full_depth).clamp_min(0))).sum(-1)
    slope = climb[0] * u + climb[1] * v + climb[2]
    sky = torch.exp(-(upwards * length / slope.clamp_min(1e-6)).clamp_max(80))
    surface_share = torch.where(depth > 0, alpha, 0)
    surface_transmittance = torch.exp(-(tau * length).clamp_max(80))
    directions = torch.stack([u, v, torch.ones_like(u)], -1) / length[..., None]
    light = directions @ glow[:, :3].T + glow[:, 3]
    squared = rgb.clamp_min(0)
    mixed = airlight + (sky + surface_share * (surface_transmittance - sky))[..., None] * (
        squared**2 - airlight
    )
    if splats is not None:
        surface_parts = surface_share[..., None]
        sky_share = 1 - surface_share[..., None]
        sky_part = torch.minimum((squared - splats).clamp_min(0), sky_share)
        surface_part = ((squared - sky_part) / surface_parts.clamp_min(EDGE)) ** 2
        sky_part = (sky_part / sky_share.clamp_min(EDGE)) ** 2
        surface_part = airlight + surface_transmittance[..., None] * (surface_part - airlight)
        sky_part = airlight + sky[..., None] * (sky_part - airlight)
        mixed_edge = (
            surface_parts * surface_part.clamp_min(0).sqrt()
            + sky_share * sky_part.clamp_min(0).sqrt()
        )
        green = rgb[..., 1:2] - splats[..., 1:2]
        is_mixed = torch.minimum(torch.minimum(surface_parts, sky_share), green) >= EDGE
        mixed = torch.where(is_mixed, mixed_edge**2, mixed)
    squared = mixed
    return (light + clear[..., None].to(rgb.dtype) * (squared - light)).clamp_min(0).sqrt()
