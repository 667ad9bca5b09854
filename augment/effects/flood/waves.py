"""Gerstner waves: their records, their surface and its normals, in float64.

With the phase theta = k D.x - omega t + phi, the parameter point x of the still plane moves to

    x + sum (S / k) D cos(theta),   level + sum A sin(theta)

k = 2 pi / wavelength, omega^2 = g k tanh(k h) for water of depth h, A is the amplitude, D the
direction and S = Q k A the steepness (Q as in Finch, GPU Gems 1, chapter 1). The surface folds over
itself where sum S exceeds 1. The normal is the cross product of the tangents d/dx and d/dy of the
complete sum; the usual closed form is exact for one wave only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from augment.effects.flood import wave_kernels
from augment.render.buffers import CPU, choose_kernels
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.cameras import Camera
from recipes.flood import Wave, Waves

GRAVITY_MPS2 = 9.80665  # standard gravity, m/s^2
# Length of the tangents' cross product (area of the surface over a unit of the plane) below which
# the surface counts as a cusp.
CUSP_AREA = 1e-12


@dataclass(frozen=True, eq=False)
class WaveSet:
    """N Gerstner waves, float64. N = 0 is still water."""

    directions: Float64[np.ndarray, "N 2"]
    """Unit vectors in world x and y along which the waves travel."""

    amplitudes_m: Float64[np.ndarray, "N"]
    """A, metres."""

    wavelengths_m: Float64[np.ndarray, "N"]
    """2 pi / k, metres."""

    steepness: Float64[np.ndarray, "N"]
    """S = Q k A of each wave; their sum is <= 1."""

    phases_rad: Float64[np.ndarray, "N"]
    """phi, radians."""

    depth_m: float
    """Depth of the water for the dispersion, metres; > 0, may be infinite."""

    def select(self, part: slice) -> WaveSet:
        """Return a part of the waves."""
        names = ("directions", "amplitudes_m", "wavelengths_m", "steepness", "phases_rad")
        return replace(self, **{name: getattr(self, name)[part] for name in names})

    @property
    def is_flat(self) -> bool:
        """True if no wave lifts the surface, so that its normal points up everywhere."""
        return not self.amplitudes_m.any()

    @property
    def wavenumbers(self) -> np.ndarray:
        """k [N], radians per metre."""
        return 2 * math.pi / self.wavelengths_m

    @property
    def tangent_factors(self) -> tuple[np.ndarray, ...]:
        """S (Dx Dx, Dx Dy, Dy Dy) and k A (Dx, Dy), [N] each; see `tangents_of`."""
        (dx, dy) = self.directions.T
        bends = self.steepness
        slopes = self.wavenumbers * self.amplitudes_m
        return bends * dx * dx, bends * dx * dy, bends * dy * dy, slopes * dx, slopes * dy

    @property
    def frequencies_hz(self) -> np.ndarray:
        """omega / 2 pi [N] by the dispersion of gravity waves over a flat bed.

        Surface tension, which dominates below wavelengths of 2 cm, is left out.
        """
        k = self.wavenumbers
        return np.sqrt(GRAVITY_MPS2 * k * np.tanh(k * self.depth_m)) / (2 * math.pi)


@dataclass(frozen=True, eq=False)
class WaveField:
    """The surface at every pixel of a camera; 0 where the ray does not meet the plane."""

    normal_x: Float32[Tensor, "H W"]
    """World x of the unit normal, whose z is positive."""

    normal_y: Float32[Tensor, "H W"]
    """World y of the unit normal."""

    slope_variance: Float32[Tensor, "H W"]
    """Variance of slopes that are too fine for the image, along the ray's horizontal direction."""


def turns_at(waves: WaveSet, timestamp_ns: int) -> np.ndarray:
    """Return (phi - omega t) / 2 pi of each wave, in [-1, 1], float64 [N].

    The product of frequency and time is reduced in integers and rounded once. In float64 alone a
    phase at 1.7e18 ns would be off by 1e-5 rad and would jump from frame to frame.
    """
    ratios = [float(f).as_integer_ratio() for f in waves.frequencies_hz]
    passed = [(n * timestamp_ns % (d * 10**9)) / (d * 10**9) for n, d in ratios]
    return np.remainder(waves.phases_rad / (2 * math.pi), 1.0) - np.asarray(passed, np.float64)


def phases_of(
    waves: WaveSet, turns: Float64[np.ndarray, "N"], points_xy: Float64[Tensor, "*B 2"]
) -> Float64[Tensor, "*B N"]:
    """Return theta of each wave over parameter points, radians, not reduced.

    turns: result of `turns_at`.
    """
    device = points_xy.device
    per_metre = torch.from_numpy(waves.wavenumbers * waves.directions.T).to(device)
    return points_xy @ per_metre + torch.from_numpy(2 * math.pi * turns).to(device)


def tangents_of(
    waves: WaveSet, theta: Float64[Tensor, "*B N"], weight: Float64[Tensor, "*B N"] | float = 1.0
) -> Float64[Tensor, "*B 5"]:
    """Return the sums over waves of S sin(theta) (Dx Dx, Dx Dy, Dy Dy) and k A cos(theta) D.

    With these sums the tangents are (1 - xx, -xy, gx) and (-xy, 1 - yy, gy).
    """
    factors = torch.from_numpy(np.stack(waves.tangent_factors, axis=1)).to(theta.device)
    squeezes = weight * theta.sin() @ factors[:, :3]
    slopes = weight * theta.cos() @ factors[:, 3:]
    return torch.cat([squeezes, slopes], dim=-1)


def normals_from_tangents(tangents: Float64[Tensor, "*B 5"]) -> Float64[Tensor, "*B 3"]:
    """Return the unit cross product of the two tangents; straight up where both vanish."""
    xx, xy, yy, gx, gy = tangents.unbind(-1)
    # Rounding must not turn the normal over where the surface is about to fold.
    up = ((1 - xx) * (1 - yy) - xy * xy).clamp_min(0)
    normals = torch.stack([-xy * gy - (1 - yy) * gx, -xy * gx - (1 - xx) * gy, up], dim=-1)
    length = normals.norm(dim=-1, keepdim=True)
    level = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=length.device)
    return torch.where(length > CUSP_AREA, normals / length.clamp_min(CUSP_AREA), level)


# ---- Waves drawn for a recipe --------------------------------------------------------------------
# A preset is a spectrum for a flooded street: a fetch of tens of metres, so short waves only, all
# of the same slope (the mean square slope per octave of a wind sea is nearly constant: Phillips
# 1958). The open sea has an rms slope of 0.09 in a wind of 1 m/s, 0.17 at 5 m/s (Cox and Munk 1954:
# mean square 0.003 + 0.00512 U); sheltered water lies below that.

MAX_STEEPNESS = 0.8  # sum over all waves, so that no crest of a preset comes near a cusp
MAX_ANGLE_RAD = math.radians(85)  # between wave and wind: no wave runs against its wind


class _Spectrum(NamedTuple):
    """Spectrum of a preset."""

    shortest_m: float  # shortest wavelength
    longest_m: float  # longest wavelength
    rms_slope: float  # of all waves together
    spread_deg: float  # standard deviation of the directions


_SPECTRA = {
    "calm": _Spectrum(0.06, 1.2, 0.012, 50.0),
    "breeze": _Spectrum(0.08, 2.5, 0.04, 35.0),
    "wind": _Spectrum(0.12, 6.0, 0.09, 28.0),
}


def make_waves(recipe: Waves, *, seed: int, depth_m: float) -> WaveSet:
    """Return the recipe's waves.

    The random draw does not depend on scene, frame or camera, so all views of all times show the
    same surface.

    Args:
        recipe: the recipe's section.
        seed: seed if the section has none.
        depth_m: depth of the water, metres, > 0.
    """
    if recipe.components is not None:
        return _from_components(recipe.components, depth_m)
    if recipe.preset == "still":
        return _from_components((), depth_m)
    seed = seed if recipe.seed is None else recipe.seed
    rng = rng_for(seed=seed, scene="", effect="flood waves")
    return _draw(_SPECTRA[recipe.preset], recipe, rng, depth_m)


def _from_components(components: tuple[Wave, ...], depth_m: float) -> WaveSet:
    angles = np.radians([wave.direction_deg for wave in components])
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=np.array([wave.amplitude_m for wave in components], np.float64),
        wavelengths_m=np.array([wave.wavelength_m for wave in components], np.float64),
        steepness=np.array([wave.steepness for wave in components], np.float64),
        phases_rad=np.radians([wave.phase_deg for wave in components]),
        depth_m=depth_m,
    )


def _draw(spectrum: _Spectrum, recipe: Waves, rng: np.random.Generator, depth_m: float) -> WaveSet:
    count = recipe.count
    # One wave in each of `count` equal parts of the octaves, so that none is left empty.
    part = (np.arange(count) + rng.random(count)) / count
    wavelengths = spectrum.shortest_m * (spectrum.longest_m / spectrum.shortest_m) ** part
    spread = math.radians(spectrum.spread_deg) * rng.standard_normal(count)
    angles = math.radians(recipe.direction_deg) + np.clip(spread, -MAX_ANGLE_RAD, MAX_ANGLE_RAD)
    slope = spectrum.rms_slope * math.sqrt(2 / count) * recipe.height  # k A of each wave
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=slope * wavelengths / (2 * math.pi),
        wavelengths_m=wavelengths,
        # Q = 1, the circular orbits of deep water (Gerstner's trochoid), where that leaves room.
        steepness=np.full(count, min(slope, MAX_STEEPNESS / count)),
        phases_rad=rng.uniform(0, 2 * math.pi, count),
        depth_m=depth_m,
    )


# ---- Normals per pixel, and roughness where waves are too fine -----------------------------------
# The footprint of a pixel on the plane is J = d(plane point)/d(pixel), metres per pixel. A wave
# advances by k |J^T D| radians per pixel. A wave shorter than two pixels would alias. Its terms
# therefore fade out between four pixels and two by a smoothstep w, and the slope that it loses
# becomes slope variance along the view: (k A)^2 (1 - w^2) (D.v)^2 / 2, where v is the ray's
# horizontal direction. Bruneton et al. 2010 split a sea into normals and a variance like this.

GONE_WAVELENGTH_PX = 2.0  # wavelength in pixels below which a wave is gone
FULL_WAVELENGTH_PX = 4.0  # wavelength in pixels from which a wave has its full height
FARTHEST_M = 1e7  # depth beyond which a ray counts as parallel to the plane
TOUCHING_M = 1e-9  # an eye closer to the plane than this lies in it and sees nothing of it
# Horizontal part of a ray, at unit z, below which world x is taken as its horizontal direction.
UPRIGHT = 1e-6
ROWS = 8  # image rows that a thread takes at a time
WAVES_PER_STEP = 8  # waves that the definition takes at a time


def wave_field(
    waves: WaveSet,
    camera: Camera,
    level_z_m: float,
    *,
    device: torch.device | None = None,
    backend: str = CPU,
) -> WaveField:
    """Return the waves at every pixel of a camera, at the camera's time.

    Args:
        waves: the waves.
        camera: the camera, with its time.
        level_z_m: height of the still plane, scene world.
        device: device of the result; the CPU if None.
        backend: the CPU's kernel equals the definition within 1e-5 of a normal's components,
            away from cusps.
    """
    height = float(camera.centre[2]) - level_z_m
    if waves.is_flat or abs(height) < TOUCHING_M:
        still = torch.zeros(camera.height, camera.width, device=device)
        return WaveField(still, still, still)
    if choose_kernels(backend) == CPU and (device is None or device.type == "cpu"):
        return _run_kernel(waves, camera, height)
    rays = camera.ray_directions(torch.float64, device)
    depth = -height / rays[..., 2]
    meets = (depth > 0) & (depth <= FARTHEST_M)
    depth = depth.where(meets, 0.0)
    z = rays[..., 2].where(meets, 1.0)
    points = camera.centre[:2].to(rays.device) + depth[..., None] * rays[..., :2]
    per_column, per_row = _footprint(camera, rays, depth, z)
    horizontal_length = rays[..., :2].norm(dim=-1, keepdim=True)
    world_x = torch.tensor([1.0, 0.0], dtype=torch.float64, device=device)
    view = torch.where(
        horizontal_length >= UPRIGHT, rays[..., :2] / horizontal_length.clamp_min(UPRIGHT), world_x
    )

    tangents = torch.zeros_like(rays[..., :1])
    variance = torch.zeros_like(depth)
    turns = turns_at(waves, camera.timestamp_ns)
    for first in range(0, len(turns), WAVES_PER_STEP):
        wave_part = waves.select(slice(first, first + WAVES_PER_STEP))
        theta = phases_of(wave_part, turns[first : first + WAVES_PER_STEP], points)
        directions = torch.from_numpy(wave_part.directions.T).to(rays.device)
        rate = torch.hypot(per_column @ directions, per_row @ directions)  # metres per pixel
        length_px = torch.from_numpy(wave_part.wavelengths_m).to(rays.device) / rate.clamp_min(
            1e-300
        )
        t = ((length_px - GONE_WAVELENGTH_PX) / (FULL_WAVELENGTH_PX - GONE_WAVELENGTH_PX)).clamp(
            0, 1
        )
        weight = t * t * (3 - 2 * t)
        tangents = tangents + tangents_of(wave_part, theta, weight)
        slopes = torch.from_numpy(wave_part.wavenumbers * wave_part.amplitudes_m).to(rays.device)
        lost_variance = (1 - weight**2) * (slopes * (view @ directions)) ** 2
        variance = variance + 0.5 * lost_variance.sum(-1)
    normals = normals_from_tangents(tangents)
    fields = (normals[..., 0], normals[..., 1], variance)
    return WaveField(*(field.where(meets, 0.0).float() for field in fields))


def _footprint(camera: Camera, rays: Tensor, depth: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far the plane point moves per column and per row, metres, [H, W, 2] each."""
    rotation = camera.world_from_camera[:3, :3].to(rays.device)
    across, down = (
        depth[..., None] * (axis[:2] - (axis[2] / z)[..., None] * rays[..., :2])
        for axis in (rotation[:, 0] / camera.fx, rotation[:, 1] / camera.fy)
    )
    return across, down


def _run_kernel(waves: WaveSet, camera: Camera, height: float) -> WaveField:
    # Zeros cost nothing until they are touched: rows above the horizon never are.
    fields = [np.zeros((camera.height, camera.width), np.float32) for _ in range(3)]
    dx, dy = waves.directions.T / waves.wavelengths_m
    phases = [dx, dy, turns_at(waves, camera.timestamp_ns)]
    pose = camera.world_from_camera
    with kernel_threads(ROWS):
        wave_kernels.fill_field(
            pose[:3, :3].contiguous().numpy(),
            pose[:2, 3].contiguous().numpy(),
            height,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
            FARTHEST_M,
            np.array([UPRIGHT, GONE_WAVELENGTH_PX, FULL_WAVELENGTH_PX], np.float32),
            np.stack(phases, axis=1),
            np.stack(waves.tangent_factors, axis=1).astype(np.float32),
            *fields,
        )
    return WaveField(*(torch.from_numpy(field) for field in fields))
