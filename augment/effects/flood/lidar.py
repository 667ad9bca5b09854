"""Standing water on a LiDAR sweep: a flat mirror that swallows 905 nm within centimetres.

A beam that meets the surface at a slant leaves it by reflection, away from the sensor, or enters.
The stronger echo counts:

    bed     rho (1 - F)^2 exp(-2 c l)     from the bed, l metres along the refracted way
    water   (1 - F)^2 R_w cos(theta)      from grains in muddy water, within a hand of its surface

with Fresnel's F and theta the angle of incidence. Left out: the waves' slopes, none of whose
facets faces a sensor on a car but right beside it, and the few, weak mirror images of objects.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from augment.effects.flood.flood import FloodMedium, reflectance
from augment.effects.lidar.beam import Echoes
from augment.effects.lidar.codes import LOST, SCATTERED
from recipes.flood import PURE_WATER_PER_M

# Absorption of pure water at 905 nm. Kou, Labrie and Chylek (1993, "Refractive indices of water and
# ice in the 0.65- to 2.5-um spectral region") have 6.8/m at 900 nm and 14/m at 925 nm; warm water
# has a tenth more. Visible light's 0.06 to 0.3/m does not count against it.
ABSORPTION_905_PER_M = 7.5
BACKWARD = 0.019  # of the light that grains deflect (Petzold 1972, harbour)
MOREL = 0.33  # diffuse reflectance of water over b_b / (a + b_b) (Morel and Prieur 1977)


class WaterEcho(NamedTuple):
    """The M beams that meet the water: their rows; range of the surface, where the air ends; range
    as reported, light being slower in water; what is kept of the bed's echo; whether that is the
    stronger; reflectance of the water.
    """

    rows: np.ndarray
    surface_m: np.ndarray
    range_m: np.ndarray
    kept: np.ndarray
    is_bed: np.ndarray
    reflectance: np.ndarray


def grains_per_m(medium: FloodMedium) -> float:
    """Extinction by grains, which is grey: that of red, less what pure water takes of it."""
    return max(medium.extinction_per_m[0] - PURE_WATER_PER_M[0], 0.0)


def water_reflectance(medium: FloodMedium) -> float:
    """R_w of the muddy water itself at 905 nm; 0 of clear water, 0.33 at most."""
    backward = BACKWARD * min(grains_per_m(medium), 1e9)
    return MOREL * backward / (ABSORPTION_905_PER_M + backward)


def meet_water(
    medium: FloodMedium,
    origins: np.ndarray,
    directions: np.ndarray,
    ends_m: np.ndarray,
    reflectances: np.ndarray,
) -> WaterEcho:
    """The echoes of beams [N] that would reach a surface at ends_m, of a reflectance, under water.

    origins, directions: [N, 3], scene world. Beams that start under water are left out. The bed
    counts as level about the return: a wheel's side is reported too near by about the bend.
    """
    drop = origins[:, 2] - medium.level_z_m
    fall = -directions[:, 2]
    rows = np.flatnonzero((drop > 0) & (fall * ends_m > drop))
    fall = fall[rows]
    ends = ends_m[rows]
    surface = drop[rows] / fall
    index = medium.refraction_index
    passed = 1 - reflectance(torch.from_numpy(np.minimum(fall, 1.0)), index, medium.fresnel).numpy()
    below = np.sqrt(1 - (1 - np.minimum(fall, 1.0) ** 2) / index**2)  # cosine of the bent beam
    way = np.maximum(ends - surface, 0) * fall / np.maximum(below, 1e-9)
    extinction = ABSORPTION_905_PER_M + grains_per_m(medium)
    thin = np.where(way > 0, np.exp(-2 * np.minimum(extinction * way, 400.0)), 1.0)
    kept = passed**2 * thin
    mud = passed**2 * water_reflectance(medium) * fall
    ranges = surface + index * way
    # Echoes of equal reflectance fall with the range squared.
    is_bed = reflectances[rows] * kept / np.maximum(ranges, 1e-9) ** 2 >= mud / surface**2
    return WaterEcho(rows, surface, np.where(is_bed, ranges, surface), kept, is_bed, mud)


def meet_flood(echoes: Echoes, medium: FloodMedium) -> None:
    """A sensor under water sees nothing: its light ends within centimetres."""
    drowned = echoes.origins[:, 2] <= medium.level_z_m
    echoes.codes[drowned & (echoes.ranges_m > 0)] = LOST
    ends = np.where(drowned, 0.0, echoes.ranges_m)
    water = meet_water(medium, echoes.origins, echoes.directions, ends, echoes.reflectance)
    bed = water.is_bed
    mud = ~water.is_bed
    echoes.see_through(water.rows[bed], water.range_m[bed], water.surface_m[bed], water.kept[bed])
    echoes.replace(water.rows[mud], water.surface_m[mud], water.reflectance[mud], SCATTERED)
