"""Rings that drops draw on standing water: the torch definition.

The plane is cut into squares. In each, a few drops at a time meet the water: which and where is a
hash of the square, the drop's number and how often it has fallen, so that the rings at a moment are
a pure function of seed, place and time. A ring of capillary waves runs at their least speed
and fades; its slope at a distance d from the drop, at an age of a share t of its life, is

    SLOPE (1 - t)^2 sin(2 pi x / WAVE_M) exp(-(x / WIDTH_M)^2),   x = d - SPEED_MPS age

along the line to the drop. Drops beyond those few, and rings too fine for a pixel, are a variance
of slope, of the same sum.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood.waves import WaveField
from augment.effects.wet import kernels
from augment.effects.wet.kernels import (
    ENDS,
    FADED_PX,
    FULL_PX,
    LEAST_FALL,
    LEAST_SINE,
    LIFE_NS,
    MAX_DROPS,
    SLOPE,
    SPEED_MPS,
    SQUARE_M,
    WAVE_M,
    WIDTH_M,
)
from augment.render.buffers import AUTO, CPU, kernels_for
from augment.render.threads import kernel_threads
from augment.rng import MIX_A, MIX_B, STEP_X, STEP_Y

_LIFE_S = LIFE_NS * 1e-9
# Mean square of the slopes of one ring, over its life, times its area: m2.
RING_M2 = (
    0.5 * SLOPE**2 * (2 * math.pi * SPEED_MPS * _LIFE_S / 30) * WIDTH_M * math.sqrt(math.pi / 2)
)


class Rings(NamedTuple):
    """Of one moment. share: of the squares' drops that fall. variance: of all slopes. unseen: of
    those that are drawn nowhere. seed, timestamp_ns: what the drops are a function of.
    """

    share: float
    variance: float
    unseen: float
    seed: int
    timestamp_ns: int


def drops_per_m2_s(rate_mm_h: float, least_mm: float = 1.0) -> float:
    """Drops wider than `least_mm` that meet level ground: the sizes of Marshall and Palmer (1948),
    N = 8000 exp(-L D) / (m3 mm), L = 4.1 R^-0.21 / mm, at the speeds of Atlas et al. (1973), v =
    9.65 - 10.3 exp(-0.6 D) m/s, integrated in closed form.
    """
    if rate_mm_h <= 0:
        return 0.0
    rate = 4.1 * rate_mm_h**-0.21
    fast, slow = rate, rate + 0.6
    return 8000 * (
        9.65 * math.exp(-fast * least_mm) / fast - 10.3 * math.exp(-slow * least_mm) / slow
    )


def rings_of(rate_mm_h: float, seed: int, timestamp_ns: int) -> Rings:
    at_once = drops_per_m2_s(rate_mm_h) * _LIFE_S  # rings per m2
    most = MAX_DROPS / SQUARE_M**2
    unseen = max(at_once - most, 0.0) * RING_M2
    return Rings(min(at_once / most, 1.0), at_once * RING_M2, unseen, seed, timestamp_ns)


def ring_slopes(
    rings: Rings,
    x_m: Float[Tensor, "*P"],
    y_m: Float[Tensor, "*P"],
    footprint_m: Float[Tensor, "*P"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes towards x and y, and the variance of what is not in them, at points of the plane
    (float64, world). footprint_m: what a pixel covers along the view.
    """
    x, y = x_m.double(), y_m.double()
    shown = ((WAVE_M / footprint_m.clamp_min(1e-9) - FADED_PX) / (FULL_PX - FADED_PX)).clamp(0, 1)
    shown = (shown * shown * (3 - 2 * shown)).double()
    i, j = torch.floor(x / SQUARE_M).long(), torch.floor(y / SQUARE_M).long()
    slope_x, slope_y = torch.zeros_like(x), torch.zeros_like(y)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            for drop in range(MAX_DROPS):
                u, v, age = _drop(rings, i + di, j + dj, drop)
                dx, dy = x - (i + di + u) * SQUARE_M, y - (j + dj + v) * SQUARE_M
                d = torch.sqrt(dx * dx + dy * dy).clamp_min(1e-4)
                off = d - SPEED_MPS * _LIFE_S * age
                s = SLOPE * (1 - age) ** 2 * torch.exp(-((off / WIDTH_M) ** 2))
                s = s * torch.sin(2 * math.pi * off / WAVE_M) / d
                s = torch.where(off.abs() > ENDS * WIDTH_M, 0.0, s)
                slope_x, slope_y = slope_x + s * dx, slope_y + s * dy
    variance = rings.variance + (rings.unseen - rings.variance) * shown**2
    return (slope_x * shown).float(), (slope_y * shown).float(), variance.float()


def _drop(rings: Rings, i: Tensor, j: Tensor, drop: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where in its square (0 to 1) a drop fell last, and the ring's age, 1 for no ring.

    int64 wraps as uint64 does; `_right` shifts as that.
    """
    first = _mix(i * _signed(STEP_X) + j * _signed(STEP_Y) + _signed(rings.seed * 8 + drop))
    passed = rings.timestamp_ns + _right(first, 24) % LIFE_NS
    again, age = passed // LIFE_NS, (passed % LIFE_NS).double() / LIFE_NS
    bits = _mix(first ^ (again * _signed(STEP_X)))
    u, v = _right(bits, 44).double() / 2**20, (_right(bits, 24) & 0xFFFFF).double() / 2**20
    falls = (bits & 0xFFFFF).double() / 2**20 < rings.share
    return u, v, torch.where(falls, age, 1.0)


def _mix(bits: Tensor) -> Tensor:
    """Every bit of the result hangs on every bit of the input (splitmix64)."""
    bits = (bits ^ _right(bits, 30)) * _signed(MIX_A)
    bits = (bits ^ _right(bits, 27)) * _signed(MIX_B)
    return bits ^ _right(bits, 31)


def _right(bits: Tensor, by: int) -> Tensor:
    return (bits >> by) & ((1 << (64 - by)) - 1)


def _signed(number: int) -> int:
    number %= 1 << 64
    return number - (1 << 64) if number >= 1 << 63 else number


# ---- On the waves of a flood ---------------------------------------------------------------------

ROWS = 8  # image rows a thread takes at a time


def with_rings(
    field: WaveField, camera: Camera, level_z_m: float, rings: Rings, *, backend: str = AUTO
) -> WaveField:
    """The surface of a level plane with drops' rings on its waves, where the camera looks down at
    it. backend: the CPU's kernel equals the definition within float rounding.
    """
    height = float(camera.centre[2]) - level_z_m
    if rings.variance == 0 or height <= 0:
        return field
    if kernels_for(backend, field.normal_x) == CPU:
        x, y, variance = (
            part.clone() for part in (field.normal_x, field.normal_y, field.slope_variance)
        )
        pose = camera.world_from_camera.numpy()
        with kernel_threads(ROWS):
            kernels.add_rings(
                np.ascontiguousarray(pose[:3, :3]),
                np.ascontiguousarray(pose[:2, 3]),
                height,
                np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
                *numbers_of(rings),
                *(part.numpy() for part in (x, y, variance)),
            )
        return WaveField(x, y, variance)
    rays = camera.ray_directions(torch.float64, field.normal_x.device)
    meets = rays[..., 2] < -LEAST_FALL
    fall = torch.where(meets, -rays[..., 2], 1.0)
    away = height / fall
    centre, length = camera.centre.to(rays.device), rays.norm(dim=-1)
    x, y = centre[0] + away * rays[..., 0], centre[1] + away * rays[..., 1]
    footprint = away * length / camera.fy / (fall / length).clamp_min(LEAST_SINE)
    slope_x, slope_y, rest = ring_slopes(rings, x, y, footprint)
    nx, ny = field.normal_x, field.normal_y
    nz = (1 - nx * nx - ny * ny).clamp_min(1e-6).sqrt()
    slopes = torch.stack((nx / nz - slope_x, ny / nz - slope_y, torch.ones_like(nz)), -1)
    tilted = torch.nn.functional.normalize(slopes, dim=-1)
    return WaveField(
        torch.where(meets, tilted[..., 0], nx),
        torch.where(meets, tilted[..., 1], ny),
        torch.where(meets, field.slope_variance + 0.5 * rest, field.slope_variance),
    )


def numbers_of(rings: Rings) -> tuple[np.ndarray, np.uint64, np.int64]:
    """As kernels take them."""
    numbers = np.array([rings.share, rings.variance, rings.unseen])
    return numbers, np.uint64(rings.seed * 8 % 2**64), np.int64(rings.timestamp_ns)
