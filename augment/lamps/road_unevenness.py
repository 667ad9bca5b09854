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

import numpy as np
from jaxtyping import Float32, Float64, UInt64

from augment.lamps import road_unevenness_kernels
from augment.lamps.road_unevenness_kernels import HALF_RANGE, OFFSET, PER_DEVIATION
from augment.lamps.wet_surface import WetSurface
from augment.render.threads import kernel_threads
from augment.rng import STEP_X, mix
from augment.scene.cameras import Camera

# Lengths of the waves, metres.
OCTAVES_M = (0.03, 0.06, 0.12, 0.24)
# Share of the slopes' variance that the waves have, away from puddles (chosen by eye).
RESOLVED_SHARE = 0.25
# Angle of an octave's lattice to that of the next one, radians.
_TURN_RAD = 1.1


def make_uneven(
    water: WetSurface, camera: Camera, resolved: Float32[np.ndarray, "H W"]
) -> WetSurface:
    """Return the water of a road with the road's unevenness as tilts.

    Args:
        water: the water, without tilts.
        camera: camera of the picture.
        resolved: share of the slopes' variance that waves may have in each pixel.
    """
    pose = camera.world_from_camera.numpy()
    roughness = np.array(water.roughness, np.float32, order="C")
    tilts = np.empty((*roughness.shape, 2), np.float32)
    with kernel_threads(len(roughness)):
        road_unevenness_kernels.tilt_road(
            np.ascontiguousarray(water.share, np.float32),
            np.ascontiguousarray(water.depth_m, np.float32),
            np.ascontiguousarray(resolved, np.float32),
            np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy]),
            np.ascontiguousarray(pose[:3, :3]),
            np.ascontiguousarray(pose[:3, 3]),
            np.array(water.up, np.float64),
            _octaves(),
            _keys(),
            roughness,
            tilts,
        )
    return replace(water, roughness=roughness, tilts=tilts)


@functools.cache
def _octaves() -> Float64[np.ndarray, "O 3"]:
    """Return the length of each octave's waves, and cosine and sine of its lattice's angle."""
    angles = _TURN_RAD * (np.arange(len(OCTAVES_M)) + 0.5)
    return np.stack([OCTAVES_M, np.cos(angles), np.sin(angles)], axis=1)


@functools.cache
def _keys() -> UInt64[np.ndarray, "O"]:
    """Return the key of each octave's random numbers."""
    return mix(np.arange(1, len(OCTAVES_M) + 1, dtype=np.uint64) * np.uint64(STEP_X))


# ---- Definition ----------------------------------------------------------------------------------


def slopes_of_wave(
    x_m: Float64[np.ndarray, "N"], y_m: Float64[np.ndarray, "N"], octave: int
) -> Float64[np.ndarray, "N 2"]:
    """Return the tilts of one octave of waves at places, of standard deviation 1.

    Args:
        x_m: x of the places, world, metres.
        y_m: y of the places, world, metres.
        octave: row of OCTAVES_M.
    """
    wave_m, cosine, sine = _octaves()[octave]
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
    bits = mix(_keys()[octave] ^ mix(j << np.uint64(32) | i))
    halves = np.stack([bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)], axis=-1)
    return halves.astype(np.float64) / HALF_RANGE - 1
