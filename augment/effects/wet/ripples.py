"""Draws the rings of drops on standing water: the torch definition.

Callers: wet ground (`ring_slopes`) and floods (`add_ring_waves`). The plane is cut into squares. In
each square, a few drops at a time meet the water. A hash of the seed, the square, the drop's number
and the number of its falls says which drops fall and where. So the rings at a moment are a pure
function of seed, place and time. A ring spreads at the lowest speed of capillary waves, and fades.
Its slope at a distance d from the drop, when a share t of its life has passed, is

    RING_SLOPE (1 - t)^2 sin(2 pi x / RING_WAVE_M) exp(-(x / RING_WIDTH_M)^2)
    x = d - SPEED_MPS * age

along the line to the drop. Further drops, and rings finer than a pixel, are not drawn. They add to
the variance of slope, so that its total stays the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.flood.waves import WaveField
from augment.effects.wet import film_kernels
from augment.effects.wet.film_kernels import (
    FADED_PX,
    FULL_PX,
    LIFE_NS,
    MAX_DROPS,
    MIN_FALL,
    MIN_FOOTPRINT_SINE,
    RING_END_WIDTHS,
    RING_SLOPE,
    RING_WAVE_M,
    RING_WIDTH_M,
    SPEED_MPS,
    SQUARE_M,
)
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.threads import kernel_threads
from augment.rng import MIX_A, MIX_B, STEP_X, STEP_Y
from augment.scene.cameras import Camera

_LIFE_S = LIFE_NS * 1e-9
# Mean square of the slopes of one ring over its life, times its area, m2.
RING_M2 = (
    0.5
    * RING_SLOPE**2
    * (2 * math.pi * SPEED_MPS * _LIFE_S / 30)
    * RING_WIDTH_M
    * math.sqrt(math.pi / 2)
)


class Rings(NamedTuple):
    """Rings at one moment."""

    share: float  # share of the squares' drops that fall
    variance: float  # variance of all slopes
    undrawn_variance: float  # variance of the slopes of drops that are not drawn
    seed: int  # seed of the drops
    timestamp_ns: int  # the moment


def drops_per_m2_s(rate_mm_h: float, min_diameter_mm: float = 1.0) -> float:
    """Return the rate of drops wider than `min_diameter_mm` that meet level ground, 1/(m2 s).

    Sizes follow Marshall and Palmer (1948), N = 8000 exp(-L D) / (m3 mm), L = 4.1 R^-0.21 / mm.
    Speeds follow Atlas et al. (1973), v = 9.65 - 10.3 exp(-0.6 D) m/s. The integral is in closed
    form.
    """
    if rate_mm_h <= 0:
        return 0.0
    slope_per_mm = 4.1 * rate_mm_h**-0.21
    first_exponent = slope_per_mm
    second_exponent = slope_per_mm + 0.6
    return 8000 * (
        9.65 * math.exp(-first_exponent * min_diameter_mm) / first_exponent
        - 10.3 * math.exp(-second_exponent * min_diameter_mm) / second_exponent
    )


def make_rings(rate_mm_h: float, seed: int, timestamp_ns: int) -> Rings:
    """Return the rings of rain at a moment."""
    rings_per_m2 = drops_per_m2_s(rate_mm_h) * _LIFE_S  # rings per m2
    max_rings_per_m2 = MAX_DROPS / SQUARE_M**2
    unseen_variance = max(rings_per_m2 - max_rings_per_m2, 0.0) * RING_M2
    return Rings(
        min(rings_per_m2 / max_rings_per_m2, 1.0),
        rings_per_m2 * RING_M2,
        unseen_variance,
        seed,
        timestamp_ns,
    )


def ring_slopes(
    rings: Rings,
    x_m: Float[Tensor, "*P"],
    y_m: Float[Tensor, "*P"],
    footprint_m: Float[Tensor, "*P"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return slopes towards x and y, and the variance of what is not in them, at points.

    Args:
        rings: rings of the moment.
        x_m: world.
        y_m: world.
        footprint_m: length that a pixel covers along the view.
    """
    x = x_m.double()
    y = y_m.double()
    visible_share = (
        (RING_WAVE_M / footprint_m.clamp_min(1e-9) - FADED_PX) / (FULL_PX - FADED_PX)
    ).clamp(0, 1)
    visible_share = (visible_share * visible_share * (3 - 2 * visible_share)).double()
    i = torch.floor(x / SQUARE_M).long()
    j = torch.floor(y / SQUARE_M).long()
    slope_x = torch.zeros_like(x)
    slope_y = torch.zeros_like(y)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            for drop in range(MAX_DROPS):
                u, v, age = _drop(rings, i + di, j + dj, drop)
                dx = x - (i + di + u) * SQUARE_M
                dy = y - (j + dj + v) * SQUARE_M
                distance = torch.sqrt(dx * dx + dy * dy).clamp_min(1e-4)
                crest_distance = distance - SPEED_MPS * _LIFE_S * age
                s = RING_SLOPE * (1 - age) ** 2 * torch.exp(-((crest_distance / RING_WIDTH_M) ** 2))
                s = s * torch.sin(2 * math.pi * crest_distance / RING_WAVE_M) / distance
                s = torch.where(crest_distance.abs() > RING_END_WIDTHS * RING_WIDTH_M, 0.0, s)
                slope_x = slope_x + s * dx
                slope_y = slope_y + s * dy
    variance = rings.variance + (rings.undrawn_variance - rings.variance) * visible_share**2
    return (slope_x * visible_share).float(), (slope_y * visible_share).float(), variance.float()


def _drop(rings: Rings, i: Tensor, j: Tensor, drop: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return where in its square (0 to 1) a drop fell last, and the ring's age, 1 for no ring.

    int64 wraps as uint64 does; `_shift_right` shifts as uint64.
    """
    drop_bits = _mix_bits(
        i * _signed(STEP_X) + j * _signed(STEP_Y) + _signed(rings.seed * 8 + drop)
    )
    elapsed_ns = rings.timestamp_ns + _shift_right(drop_bits, 24) % LIFE_NS
    num_falls = elapsed_ns // LIFE_NS
    age = (elapsed_ns % LIFE_NS).double() / LIFE_NS
    bits = _mix_bits(drop_bits ^ (num_falls * _signed(STEP_X)))
    u = _shift_right(bits, 44).double() / 2**20
    v = (_shift_right(bits, 24) & 0xFFFFF).double() / 2**20
    has_fallen = (bits & 0xFFFFF).double() / 2**20 < rings.share
    return u, v, torch.where(has_fallen, age, 1.0)


def _mix_bits(bits: Tensor) -> Tensor:
    """Mix bits (splitmix64): every bit of the result depends on every bit of the input."""
    bits = (bits ^ _shift_right(bits, 30)) * _signed(MIX_A)
    bits = (bits ^ _shift_right(bits, 27)) * _signed(MIX_B)
    return bits ^ _shift_right(bits, 31)


def _shift_right(bits: Tensor, num_bits: int) -> Tensor:
    """Shift right as for uint64."""
    return (bits >> num_bits) & ((1 << (64 - num_bits)) - 1)


def _signed(number: int) -> int:
    """Return the int64 of the same bits as a uint64."""
    number %= 1 << 64
    return number - (1 << 64) if number >= 1 << 63 else number


# ---- On the waves of a flood ---------------------------------------------------------------------

ROWS_PER_TASK = 8  # number of image rows that a thread takes at a time


def add_ring_waves(
    field: WaveField, camera: Camera, level_z_m: float, rings: Rings, *, backend: str = AUTO
) -> WaveField:
    """Return the waves of level water with the rings of drops added.

    Pixels whose ray does not fall towards the water stay as they are. The CPU's kernel and the
    torch code agree within float rounding.

    Args:
        field: normals and variance of slope of the waves, by pixel.
        camera: the camera that sees the water.
        level_z_m: height of the water, world z, metres.
        rings: the rings at a moment.
        backend: AUTO chooses the CPU's kernel where the field lies there.
    """
    height = float(camera.centre[2]) - level_z_m
    if rings.variance == 0 or height <= 0:
        return field
    if choose_kernels(backend, field.normal_x) == CPU:
        x, y, variance = (
            tensor.clone() for tensor in (field.normal_x, field.normal_y, field.slope_variance)
        )
        pose = camera.world_from_camera.numpy()
        with kernel_threads(ROWS_PER_TASK):
            film_kernels.add_rings(
                np.ascontiguousarray(pose[:3, :3]),
                np.ascontiguousarray(pose[:2, 3]),
                height,
                np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
                *ring_arrays(rings),
                *(tensor.numpy() for tensor in (x, y, variance)),
            )
        return WaveField(x, y, variance)
    rays = camera.ray_directions(torch.float64, field.normal_x.device)
    is_hit = rays[..., 2] < -MIN_FALL
    fall = torch.where(is_hit, -rays[..., 2], 1.0)
    ray_depth = height / fall
    centre = camera.centre.to(rays.device)
    length = rays.norm(dim=-1)
    x = centre[0] + ray_depth * rays[..., 0]
    y = centre[1] + ray_depth * rays[..., 1]
    footprint = ray_depth * length / camera.fy / (fall / length).clamp_min(MIN_FOOTPRINT_SINE)
    slope_x, slope_y, rest_variance = ring_slopes(rings, x, y, footprint)
    nx = field.normal_x
    ny = field.normal_y
    nz = (1 - nx * nx - ny * ny).clamp_min(1e-6).sqrt()
    slopes = torch.stack((nx / nz - slope_x, ny / nz - slope_y, torch.ones_like(nz)), -1)
    tilted = torch.nn.functional.normalize(slopes, dim=-1)
    return WaveField(
        torch.where(is_hit, tilted[..., 0], nx),
        torch.where(is_hit, tilted[..., 1], ny),
        torch.where(is_hit, field.slope_variance + 0.5 * rest_variance, field.slope_variance),
    )


def ring_arrays(rings: Rings) -> tuple[np.ndarray, np.uint64, np.int64]:
    """Return rings as kernels take them."""
    numbers = np.array([rings.share, rings.variance, rings.undrawn_variance])
    return numbers, np.uint64(rings.seed * 8 % 2**64), np.int64(rings.timestamp_ns)
