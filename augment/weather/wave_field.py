"""What a camera sees of waves: normals per pixel, and roughness where waves are too fine for it.

The footprint of a pixel on the plane is J = d(plane point)/d(pixel), metres per pixel, 2x2. A wave
advances by k |J^T D| radians per pixel, so it is 2 pi / that pixels long there; shorter than two
pixels it cannot be drawn, and its normals would glitter. Its terms are faded out between four
pixels and two by a smoothstep w, and the slope it loses becomes slope variance along the view:
(k A)^2 (1 - w^2) (D.v)^2 / 2, v the ray's horizontal direction (Bruneton et al. 2010 split a sea
into normals and a variance in the same way).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import CPU, CUDA, REFERENCE, kernels_for
from augment.render.gpu import gpu_device
from augment.render.threads import kernel_threads
from augment.weather import waves_kernels
from augment.weather.waves import (
    WaveField,
    WaveSet,
    normals_from_tangents,
    phase_of,
    tangent_terms,
    turns_at,
)

FADED_PX, FULL_PX = 2.0, 4.0  # lengths in pixels at which a wave is gone, and at full height
FARTHEST_M = 1e7  # depth beyond which a ray counts as running beside the plane
TOUCHING_M = 1e-9  # an eye closer to the plane than this lies in it and sees nothing of it
UPRIGHT = 1e-6  # horizontal part of a ray, at unit z, below which its direction is world x
ROWS = 8  # image rows a thread takes at a time


def wave_field(
    waves: WaveSet, camera: Camera, level_z_m: float, *, backend: str = CPU
) -> WaveField:
    """The waves at every pixel of a camera, at its own time. level_z_m: the plane, scene world.

    backend: with kernels by them, equal to the definition in float64 within 1e-5 of a normal's
    components (for surfaces that keep clear of cusps). "cuda" leaves the field on the GPU.

    Raises:
        ValueError: level_z_m is not finite.
    """
    if not math.isfinite(level_z_m):
        raise ValueError(f"level_z_m must be finite; got {level_z_m}")
    height = float(camera.centre[2]) - level_z_m
    kernels = kernels_for(backend)
    is_still = waves.is_flat or abs(height) < TOUCHING_M
    if is_still:
        device = gpu_device() if kernels == CUDA else None
        still = torch.zeros(camera.height, camera.width, device=device)
        return WaveField(still, still, still)
    if kernels == CUDA:
        from augment.weather import cuda_waves

        limits = (UPRIGHT, FADED_PX, FULL_PX)
        return cuda_waves.fill_field(waves, camera, height, farthest=FARTHEST_M, limits=limits)
    return (_define if kernels == REFERENCE else _run_kernel)(waves, camera, height)


def _define(waves: WaveSet, camera: Camera, height: float) -> WaveField:
    rays = camera.ray_directions(torch.float64)
    away = -height / rays[..., 2]
    meets = (away > 0) & (away <= FARTHEST_M)
    away, z = away.where(meets, 0.0), rays[..., 2].where(meets, 1.0)
    points = camera.centre[:2] + away[..., None] * rays[..., :2]
    per_column, per_row = _footprint(camera, rays, away, z)
    level = rays[..., :2].norm(dim=-1, keepdim=True)
    east = torch.tensor([1.0, 0.0], dtype=torch.float64)
    view = torch.where(level >= UPRIGHT, rays[..., :2] / level.clamp_min(UPRIGHT), east)

    tangents = torch.zeros((*away.shape, 5), dtype=torch.float64)
    variance = torch.zeros_like(away)
    turns = turns_at(waves, camera.timestamp_ns)
    for i, direction in enumerate(torch.from_numpy(waves.directions)):
        rate = torch.hypot(per_column @ direction, per_row @ direction)  # metres per pixel
        length_px = float(waves.wavelengths_m[i]) / rate.clamp_min(1e-300)
        t = ((length_px - FADED_PX) / (FULL_PX - FADED_PX)).clamp(0, 1)
        weight = t * t * (3 - 2 * t)
        terms = tangent_terms(waves, i, phase_of(waves, i, turns, points))
        tangents += weight[..., None] * terms
        slope = float(waves.wavenumbers[i] * waves.amplitudes_m[i]) * (view @ direction)
        variance += 0.5 * (1 - weight**2) * slope**2
    normals = normals_from_tangents(tangents)
    fields = (normals[..., 0], normals[..., 1], variance)
    return WaveField(*(field.where(meets, 0.0).float() for field in fields))


def _footprint(camera: Camera, rays: Tensor, away: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Metres of world x and y, [H, W, 2] each, that the plane point moves per column and row."""
    rotation = camera.world_from_camera[:3, :3]
    steps = []
    for turn in (rotation[:, 0] / camera.fx, rotation[:, 1] / camera.fy):
        slide = turn[:2] - (turn[2] / z)[..., None] * rays[..., :2]
        steps.append(away[..., None] * slide)
    return steps[0], steps[1]


def _run_kernel(waves: WaveSet, camera: Camera, height: float) -> WaveField:
    # Zeros cost nothing until they are touched: rows above the horizon never are.
    fields = [np.zeros((camera.height, camera.width), np.float32) for _ in range(3)]
    dx, dy = waves.directions.T
    slopes = waves.wavenumbers * waves.amplitudes_m
    bends = waves.steepness
    terms = [bends * dx * dx, bends * dx * dy, bends * dy * dy, slopes * dx, slopes * dy]
    phases = [
        dx / waves.wavelengths_m,
        dy / waves.wavelengths_m,
        turns_at(waves, camera.timestamp_ns),
    ]
    pose = camera.world_from_camera
    with kernel_threads(ROWS):
        waves_kernels.fill_field(
            pose[:3, :3].contiguous().numpy(),
            pose[:2, 3].contiguous().numpy(),
            height,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
            FARTHEST_M,
            np.array([UPRIGHT, FADED_PX, FULL_PX], np.float32),
            np.stack(phases, axis=1),
            np.stack(terms, axis=1).astype(np.float32),
            *fields,
        )
    return WaveField(*(torch.from_numpy(field) for field in fields))
