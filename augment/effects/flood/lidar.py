"""Standing water on a LiDAR sweep: a flat mirror that absorbs 905 nm within centimetres.

A beam that meets the surface at a slant is reflected away from the sensor, or enters the water.
The stronger of two echoes counts:

    bed     rho (1 - F)^2 exp(-2 c l)     from the bed, l metres along the refracted ray
    water   (1 - F)^2 R_w cos(theta)      from grains in muddy water, within 10 cm of its surface

F is Fresnel's reflectance, theta the angle of incidence and c the extinction. Two things are left
out: the slopes of the waves, whose facets face a sensor on a car only right beside the car, and the
few, weak mirror images of objects.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from augment.effects.flood.flood_medium import FloodMedium, reflectance
from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import LOST, SCATTERED
from recipes.flood import PURE_WATER_PER_M

# Absorption of pure water at 905 nm, 1/metre. Kou, Labrie and Chylek (1993, "Refractive indices of
# water and ice in the 0.65- to 2.5-um spectral region") give 6.8/m at 900 nm and 14/m at 925 nm;
# warm water absorbs a tenth more. The 0.06 to 0.3/m of visible light is negligible beside it.
ABSORPTION_905_PER_M = 7.5
# Share of the light scattered by grains that goes backward (Petzold 1972, harbour water).
BACKSCATTER_SHARE = 0.019
# Diffuse reflectance of water over b_b / (a + b_b) (Morel and Prieur 1977).
MOREL_FACTOR = 0.33


class WaterEcho(NamedTuple):
    """Echoes of the M beams that meet the water."""

    rows: np.ndarray  # [M] rows of the beams
    surface_m: np.ndarray  # [M] range of the water's surface, where the air ends
    range_m: np.ndarray  # [M] reported range; light is slower in water
    bed_gain: np.ndarray  # [M] share of the bed's echo that comes back
    is_bed: np.ndarray  # [M] True if the bed's echo is stronger than the water's
    reflectance: np.ndarray  # [M] reflectance of the water


def grains_per_m(medium: FloodMedium) -> float:
    """Return the extinction by grains, 1/metre.

    It is grey, so it equals the extinction of red less the absorption of pure water.
    """
    return max(medium.extinction_per_m[0] - PURE_WATER_PER_M[0], 0.0)


def water_reflectance(medium: FloodMedium) -> float:
    """Return R_w of the muddy water at 905 nm: 0 for clear water, 0.33 at most."""
    backscatter = BACKSCATTER_SHARE * min(grains_per_m(medium), 1e9)
    return MOREL_FACTOR * backscatter / (ABSORPTION_905_PER_M + backscatter)


def meet_water(
    medium: FloodMedium,
    origins: np.ndarray,
    directions: np.ndarray,
    ends_m: np.ndarray,
    reflectances: np.ndarray,
) -> WaterEcho:
    """Return the echoes of those of N beams that meet the water.

    Beams that start under water are left out. The bed counts as level around the return, so a
    wheel's side is reported too near, by about the bend of the beam.

    Args:
        medium: the water.
        origins: [N, 3], scene world, metres.
        directions: [N, 3], unit, scene world.
        ends_m: [N] range of the first surface that the straight beam would reach.
        reflectances: [N] reflectance of that surface.
    """
    drop = origins[:, 2] - medium.level_z_m
    fall = -directions[:, 2]
    rows = np.flatnonzero((drop > 0) & (fall * ends_m > drop))
    fall = fall[rows]
    ends = ends_m[rows]
    surface = drop[rows] / fall
    index = medium.refraction_index
    entering = (
        1 - reflectance(torch.from_numpy(np.minimum(fall, 1.0)), index, medium.fresnel).numpy()
    )
    cosine_below = np.sqrt(
        1 - (1 - np.minimum(fall, 1.0) ** 2) / index**2
    )  # cosine of the bent beam
    length = np.maximum(ends - surface, 0) * fall / np.maximum(cosine_below, 1e-9)
    extinction = ABSORPTION_905_PER_M + grains_per_m(medium)
    transmittance = np.where(length > 0, np.exp(-2 * np.minimum(extinction * length, 400.0)), 1.0)
    bed_gain = entering**2 * transmittance
    water_echo = entering**2 * water_reflectance(medium) * fall
    ranges = surface + index * length
    # Echoes of equal reflectance fall with the range squared.
    is_bed = (
        reflectances[rows] * bed_gain / np.maximum(ranges, 1e-9) ** 2 >= water_echo / surface**2
    )
    return WaterEcho(rows, surface, np.where(is_bed, ranges, surface), bed_gain, is_bed, water_echo)


def meet_flood(echoes: Echoes, medium: FloodMedium) -> None:
    """Replace the echoes of beams that meet the water.

    A sensor under water receives nothing: its light ends within centimetres.
    """
    is_under = echoes.origins[:, 2] <= medium.level_z_m
    echoes.codes[is_under & (echoes.ranges_m > 0)] = LOST
    ends_m = np.where(is_under, 0.0, echoes.ranges_m)
    water = meet_water(medium, echoes.origins, echoes.directions, ends_m, echoes.reflectance)
    has_bed = water.is_bed
    has_mud = ~water.is_bed
    echoes.move_and_dim(
        water.rows[has_bed],
        water.range_m[has_bed],
        water.surface_m[has_bed],
        water.bed_gain[has_bed],
    )
    echoes.replace_echoes(
        water.rows[has_mud], water.surface_m[has_mud], water.reflectance[has_mud], SCATTERED
    )
