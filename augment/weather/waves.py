"""Gerstner waves: their records, the surface they make and its normals, in float64.

The parameter point x of the still plane goes, with phase theta = k D.x - omega t + phi, to

    x + sum (S / k) D cos(theta),   level + sum A sin(theta)

k = 2 pi / wavelength, omega^2 = g k tanh(k h) for water of depth h, A the amplitude and S = Q k A
the steepness (Q as in Finch, GPU Gems 1, chapter 1). The surface folds over itself where sum S
exceeds 1. The normal is the cross product of the tangents d/dx and d/dy of the whole sum. The usual
closed form (-sum k A D cos(theta), 1 - sum S sin(theta)) is exact for one wave only, and right for
many to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

GRAVITY_MPS2 = 9.80665
UNIT_ERROR = 1e-6  # of a direction's length, which scales a wavelength no more than this
CUSP = 1e-12  # area that is left of a unit of the plane where the surface counts as a point
STEEPNESS_ROUNDING = 1e-9  # sums of decimal fractions that make 1 on paper


@dataclass(frozen=True, eq=False)
class WaveSet:
    """N Gerstner waves, float64; N may be 0: still water.

    directions [N, 2]: unit, world x and y, where each runs to. amplitudes_m, wavelengths_m,
    steepness (Q k A of each wave; their sum is <= 1), phases_rad [N]. depth_m: of the water, for
    the dispersion; > 0, may be infinite.
    """

    directions: np.ndarray
    amplitudes_m: np.ndarray
    wavelengths_m: np.ndarray
    steepness: np.ndarray
    phases_rad: np.ndarray
    depth_m: float

    def __post_init__(self) -> None:
        count = len(self.wavelengths_m)
        for name in ("directions", "amplitudes_m", "wavelengths_m", "steepness", "phases_rad"):
            values, shape = getattr(self, name), [count, 2] if name == "directions" else [count]
            if values.dtype != np.float64 or list(values.shape) != shape:
                raise ValueError(
                    f"{name} must be float64 {shape} (N={count} from wavelengths_m); "
                    f"got {values.dtype} {list(values.shape)}"
                )
            if not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite; got {values[~np.isfinite(values)][0]}")
        if (self.wavelengths_m <= 0).any():
            raise ValueError(f"wavelengths_m must be > 0; got {self.wavelengths_m.min()}")
        for name in ("amplitudes_m", "steepness"):
            if (getattr(self, name) < 0).any():
                raise ValueError(f"{name} must be >= 0; got {getattr(self, name).min()}")
        lengths = np.hypot(self.directions[:, 0], self.directions[:, 1])
        if (np.abs(lengths - 1) > UNIT_ERROR).any():
            worst = lengths[np.abs(lengths - 1).argmax()]
            raise ValueError(f"directions must be of unit length; got one of length {worst}")
        if self.steepness.sum() > 1 + STEEPNESS_ROUNDING:
            raise ValueError(
                "the waves' steepness must sum to at most 1, or the surface folds over itself; "
                f"got {self.steepness.sum():.6g} from {count} waves: lower their steepness"
            )
        if not self.depth_m > 0:  # also catches NaN
            raise ValueError(f"depth_m must be > 0; got {self.depth_m}")

    @property
    def is_flat(self) -> bool:
        """No wave lifts the surface, so its normal points up everywhere."""
        return not self.amplitudes_m.any()

    @property
    def wavenumbers(self) -> np.ndarray:
        """k [N], radians per metre."""
        return 2 * math.pi / self.wavelengths_m

    @property
    def frequencies_hz(self) -> np.ndarray:
        """omega / 2 pi [N] by the dispersion of gravity waves over a flat bed.

        Surface tension, which rules below 2 cm, is left out.
        """
        k = self.wavenumbers
        return np.sqrt(GRAVITY_MPS2 * k * np.tanh(k * self.depth_m)) / (2 * math.pi)


@dataclass(frozen=True, eq=False)
class WaveField:
    """The surface at every pixel of a camera: what its waves are to the one that sees them.

    normal_x, normal_y: the unit normal's world x and y; its z is positive. slope_variance: of the
    slopes too fine for the image, along the ray's horizontal direction. All 0 where the ray does
    not meet the plane in front of the eye.
    """

    normal_x: Float32[Tensor, "H W"]
    normal_y: Float32[Tensor, "H W"]
    slope_variance: Float32[Tensor, "H W"]


def turns_at(waves: WaveSet, timestamp_ns: int) -> np.ndarray:
    """(phi - omega t) / 2 pi of each wave, in [-1, 1], float64 [N].

    The frequency's float64 times the time is reduced in whole numbers, rounded once: in float64
    alone a phase at 1.7e18 ns would be off by 1e-5 rad and would jump from frame to frame.
    """
    passed = [_fraction_of_turns(float(f), timestamp_ns) for f in waves.frequencies_hz]
    return np.remainder(waves.phases_rad / (2 * math.pi), 1.0) - np.asarray(passed, np.float64)


def _fraction_of_turns(frequency_hz: float, timestamp_ns: int) -> float:
    numerator, denominator = frequency_hz.as_integer_ratio()
    denominator *= 10**9
    return (numerator * timestamp_ns % denominator) / denominator


def displaced_surface(
    waves: WaveSet, points_xy: Float64[Tensor, "*B 2"], timestamp_ns: int
) -> Float64[Tensor, "*B 3"]:
    """Where the parameter points of the plane are at that time; z counts from the still level."""
    surface = torch.cat([points_xy, torch.zeros_like(points_xy[..., :1])], dim=-1)
    turns = turns_at(waves, timestamp_ns)
    for i, (dx, dy) in enumerate(waves.directions.tolist()):
        theta = phase_of(waves, i, turns, points_xy)
        reach = float(waves.steepness[i] / waves.wavenumbers[i])
        lift = float(waves.amplitudes_m[i]) * theta.sin()
        across = reach * theta.cos()
        surface = surface + torch.stack([dx * across, dy * across, lift], dim=-1)
    return surface


def wave_normals(
    waves: WaveSet, points_xy: Float64[Tensor, "*B 2"], timestamp_ns: int
) -> Float64[Tensor, "*B 3"]:
    """Unit normals, upward, of the surface over parameter points, with every wave at full height.

    A cusp, which a total steepness of 1 can have, counts as level.
    """
    tangents = torch.zeros((*points_xy.shape[:-1], 5), dtype=torch.float64)
    turns = turns_at(waves, timestamp_ns)
    for i in range(len(turns)):
        tangents += tangent_terms(waves, i, phase_of(waves, i, turns, points_xy))
    return normals_from_tangents(tangents)


def phase_of(
    waves: WaveSet, index: int, turns: np.ndarray, points_xy: Float64[Tensor, "*B 2"]
) -> Float64[Tensor, "*B"]:
    """theta of one wave over parameter points, radians, not reduced. turns: of `turns_at`."""
    dx, dy = waves.directions[index].tolist()
    way = points_xy[..., 0] * dx + points_xy[..., 1] * dy
    return float(waves.wavenumbers[index]) * way + 2 * math.pi * float(turns[index])


def tangent_terms(
    waves: WaveSet, index: int, theta: Float64[Tensor, "*B"]
) -> Float64[Tensor, "*B 5"]:
    """What one wave adds to the tangents: S sin(theta) (Dx Dx, Dx Dy, Dy Dy), k A cos(theta) D.

    The tangents are (1 - xx, -xy, gx) and (-xy, 1 - yy, gy) with the sums over the waves.
    """
    dx, dy = waves.directions[index].tolist()
    squeeze = float(waves.steepness[index]) * theta.sin()
    slope = float(waves.wavenumbers[index] * waves.amplitudes_m[index]) * theta.cos()
    terms = [dx * dx * squeeze, dx * dy * squeeze, dy * dy * squeeze, dx * slope, dy * slope]
    return torch.stack(terms, dim=-1)


def normals_from_tangents(tangents: Float64[Tensor, "*B 5"]) -> Float64[Tensor, "*B 3"]:
    """The unit cross product of the two tangents; straight up where both vanish."""
    xx, xy, yy, gx, gy = tangents.unbind(-1)
    # Rounding must not turn the normal over where the surface is about to fold.
    up = ((1 - xx) * (1 - yy) - xy * xy).clamp_min(0)
    normals = torch.stack([-xy * gy - (1 - yy) * gx, -xy * gx - (1 - xx) * gy, up], dim=-1)
    length = normals.norm(dim=-1, keepdim=True)
    level = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.where(length > CUSP, normals / length.clamp_min(CUSP), level)
