"""Unevenness of wet roads: it breaks the streaks of lamps into glints.

A road's slopes have one variance at all scales together, Beckmann's m^2 / 2 on each axis. A share
of it belongs to waves of OCTAVES_M, evenly. Waves that are longer than two pixels are drawn as
tilts of the mirror, and their variance is taken out of m; so the light stays the same, and streaks
far away, of which a pixel has many waves, are smooth. The waves are fixed to the road: ripples of
rain stand still, too.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt64

from augment.lamps.road_unevenness_kernels import HALF_RANGE, OFFSET, PER_DEVIATION
from augment.lamps.wet_surface import MAX_DEPTH_M, WetRoad, WetSurface
from augment.rng import STEP_X, mix
from augment.scene.cameras import Camera

# Lengths of the waves, metres.
OCTAVES_M = (0.03, 0.06, 0.12, 0.24)
# Share of the slopes' variance that the waves have, away from puddles (chosen by eye).
RESOLVED_SHARE = 0.25
# Angle of an octave's lattice to that of the next one, radians.
_TURN_RAD = 1.1


@functools.cache
def wave_octaves() -> Float64[np.ndarray, "O 3"]:
    """Return the length of each octave's waves, and cosine and sine of its lattice's angle."""
    angles = _TURN_RAD * (np.arange(len(OCTAVES_M)) + 0.5)
    return np.stack([OCTAVES_M, np.cos(angles), np.sin(angles)], axis=1)


@functools.cache
def wave_keys() -> UInt64[np.ndarray, "O"]:
    """Return the key of each octave's random numbers."""
    return mix(np.arange(1, len(OCTAVES_M) + 1, dtype=np.uint64) * np.uint64(STEP_X))


# ---- Definition ----------------------------------------------------------------------------------


def make_uneven(
    water: WetSurface, camera: Camera, resolved: Float32[np.ndarray, "H W"]
) -> WetSurface:
    """Return the water of a road with the road's unevenness as tilts.

    Args:
        water: the water, without tilts.
        camera: camera of the picture.
        resolved: share of the slopes' variance that waves may have in each pixel.
    """
    rays = camera.ray_directions(torch.float64).numpy()
    depth_m = water.depth_m.astype(np.float64)
    is_road = (water.share > 0) & (resolved > 0) & (depth_m > 0) & (depth_m < MAX_DEPTH_M)
    rays = rays[is_road]
    depth_m = depth_m[is_road]
    lengths = np.linalg.norm(rays, axis=1)
    sines = np.abs(rays @ np.asarray(water.up)) / lengths
    footprint_m = depth_m * lengths / camera.fy / np.maximum(sines, 1e-3)
    x_m, y_m, _ = (camera.centre.numpy() + depth_m[:, None] * rays).T
    m2 = water.roughness[is_road].astype(np.float64) ** 2
    variance = 0.5 * m2 * resolved[is_road] / len(OCTAVES_M)
    slopes = np.zeros((len(m2), 2))
    for octave, wave_m in enumerate(OCTAVES_M):
        # Waves shorter than two pixels are roughness.
        weight = np.clip(0.5 * wave_m / footprint_m - 0.5, 0, 1)
        slopes += (weight * np.sqrt(variance))[:, None] * slopes_of_wave(x_m, y_m, octave)
        m2 -= weight**2 * 2 * variance
    roughness = np.array(water.roughness, np.float32)
    roughness[is_road] = np.sqrt(m2)
    tilts = np.zeros((*roughness.shape, 2), np.float32)
    tilts[is_road] = slopes
    return replace(water, roughness=roughness, tilts=tilts)


def water_of_road(road: WetRoad, camera: Camera) -> WetSurface:
    """Return the water on a wet road, in all pixels: the definition of what kernels make of it.

    Args:
        road: the road.
        camera: camera of the picture.
    """
    height, width = road.share.shape
    film = cv2.resize(road.film, (width, height), interpolation=cv2.INTER_LINEAR)
    depth_m = np.where(np.isfinite(road.depth_m), road.depth_m, 0).astype(np.float32)
    share = np.where(depth_m > 0, road.share * film[..., 1], 0).astype(np.float32)
    water = WetSurface(share, film[..., 0], depth_m, road.up)
    return make_uneven(water, camera, film[..., 2])


def slopes_of_wave(
    x_m: Float64[np.ndarray, "N"], y_m: Float64[np.ndarray, "N"], octave: int
) -> Float64[np.ndarray, "N 2"]:
    """Return the tilts of one octave of waves at places, of standard deviation 1.

    Args:
        x_m: x of the places, world, metres.
        y_m: y of the places, world, metres.
        octave: row of OCTAVES_M.
    """
    wave_m, cosine, sine = wave_octaves()[octave]
    x = (cosine * x_m - sine * y_m) * (2 / wave_m)
    y = (sine * x_m + cosine * y_m) * (2 / wave_m)
    column = np.floor(x)
    row = np.floor(y)
    u = _smooth(x - column)[:, None]
    v = _smooth(y - row)[:, None]
    low = (1 - u) * _corners(column, row, octave) + u * _corners(column + 1, row, octave)
    high = (1 - u) * _corners(column, row + 1, octave) + u * _corners(column + 1, row + 1, octave)
    return PER_DEVIATION * ((1 - v) * low + v * high)


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)


def _corners(column: np.ndarray, row: np.ndarray, octave: int) -> Float64[np.ndarray, "N 2"]:
    """Return two numbers from -1 to 1 of each corner of an octave's lattice."""
    j = (column.astype(np.int64) + OFFSET).astype(np.uint64)
    i = (row.astype(np.int64) + OFFSET).astype(np.uint64)
    bits = mix(wave_keys()[octave] ^ mix(j << np.uint64(32) | i))
    halves = np.stack([bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)], axis=-1)
    return halves.astype(np.float64) / HALF_RANGE - 1
