"""Drops and flakes: how many of which size fall how fast, and where each of them is at a time.

Sizes follow exponential laws N(D) = N0 exp(-Lambda D), D in mm of water, per m^3 and mm:

    rain  Lambda = 4.1 R^-0.21     Marshall and Palmer 1948, "The distribution of raindrops
                                   with size"
    snow  Lambda = 2.29 R^-0.45    Sekhon and Srivastava 1970, "Snow size spectra and radar
                                   reflectivity"; D of the melted flake

R: mm of water an hour. Fall speeds: Atlas, Srivastava and Sekhon 1973, v = 9.65 - 10.3 exp(-0.6 D)
m/s for rain; v = 0.8 d^0.16 m/s for flakes of d mm (Locatelli and Hobbs 1974, aggregates). N0 is
such that what falls is R.

Of each class of sizes there is a lattice of cells with one drop a cell in the mean, which moves as
one with that class's fall speed and the wind. Drops stand still in it but for the sway of flakes,
so that where one is at a time is a function of the seed, the class, the cell and the time, and of
nothing else. A hash of the cell says how many drops it has (Poisson), where in it, and how large.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.stats import poisson

Kind = Literal["rain", "snow"]

# What a drop takes from the light over its cross-section: as much again as it blocks is diffracted
# (van de Hulst 1957, "Light Scattering by Small Particles", ch. 8).
EXTINCTION_EFFICIENCY = 2.0
NUM_CLASSES = 8
NUM_QUANTILES = 17
MAX_IN_CELL = 5  # one cell in 1700 would have more
_SMALLEST_MM = 0.1
_LARGEST_MM = {"rain": 6.0, "snow": 7.0}  # of water
_SNOW_DENSITY = 0.1  # of a flake, over water
_LEAST_RATE = 1e-3  # mm/h, below which sizes stay: the laws were measured far above
_STEPS = 400  # of the integral over a class


@dataclass(frozen=True, eq=False)
class Sizes:
    """Classes of drops or flakes, smallest first.

    counts_per_m3 [B]. diameters_m [B]: root of the mean square. speeds_mps [B]: of the fall, mean
    by mass. quantiles_m [B, NUM_QUANTILES]: diameters by the share of a class that is smaller,
    evenly spaced. mass_kg [B]: of one, mean.
    """

    counts_per_m3: Float64[np.ndarray, "B"]
    diameters_m: Float64[np.ndarray, "B"]
    speeds_mps: Float64[np.ndarray, "B"]
    quantiles_m: Float64[np.ndarray, "B Q"]
    mass_kg: Float64[np.ndarray, "B"]

    @property
    def extinctions_per_m(self) -> Float64[np.ndarray, "B"]:
        areas = math.pi / 4 * self.diameters_m**2
        return EXTINCTION_EFFICIENCY * self.counts_per_m3 * areas

    @property
    def extinction_per_m(self) -> float:
        """Of visible light, by all of them."""
        return float(self.extinctions_per_m.sum())

    @property
    def rate_mm_h(self) -> float:
        """Water that falls on level ground."""
        return float((self.counts_per_m3 * self.mass_kg * self.speeds_mps).sum()) * 3600

    @property
    def cells_m(self) -> Float64[np.ndarray, "B"]:
        """Size of the lattice's cells, which have one drop each in the mean."""
        return (float(cell_counts()[-1]) / self.counts_per_m3) ** (1 / 3)


@functools.lru_cache(maxsize=64)
def sizes_of(kind: Kind, rate_mm_h: float) -> Sizes:
    """The sizes in rain or snowfall of a rate > 0."""
    rate = max(rate_mm_h, _LEAST_RATE)
    slope = 4.1 * rate**-0.21 if kind == "rain" else 2.29 * rate**-0.45  # per mm
    swelling = 1.0 if kind == "rain" else _SNOW_DENSITY ** (-1 / 3)
    edges = np.geomspace(_SMALLEST_MM, _LARGEST_MM[kind], NUM_CLASSES + 1)
    share = (np.arange(_STEPS) + 0.5) / _STEPS
    water_mm = edges[:-1, None] + share * (edges[1:] - edges[:-1])[:, None]  # [B, _STEPS]
    counts = np.exp(-slope * water_mm) * ((edges[1:] - edges[:-1]) / _STEPS)[:, None]
    across_mm = swelling * water_mm
    speeds = 9.65 - 10.3 * np.exp(-0.6 * water_mm) if kind == "rain" else 0.8 * across_mm**0.16
    speeds = np.maximum(speeds, 0.01)
    mass = math.pi / 6 * 1000 * (water_mm / 1000) ** 3  # kg
    falls = (counts * mass * speeds).sum() * 3600
    total = counts.sum(1)
    number = np.maximum(total, 1e-300)  # of a class that has none
    smaller = np.cumsum(counts, 1) / number[:, None]
    evenly = np.linspace(0, 1, NUM_QUANTILES)
    quantiles = [
        np.interp(evenly, np.append(0, below), np.append(first, mm + (mm[1] - mm[0]) / 2))
        for below, first, mm in zip(smaller, edges[:-1], water_mm, strict=True)
    ]
    return Sizes(
        counts_per_m3=np.maximum(total * (rate_mm_h / falls), 1e-12),
        diameters_m=np.sqrt((counts * across_mm**2).sum(1) / number) / 1000,
        speeds_mps=(counts * mass * speeds).sum(1) / np.maximum((counts * mass).sum(1), 1e-300),
        quantiles_m=swelling * np.array(quantiles) / 1000,
        mass_kg=(counts * mass).sum(1) / number,
    )


# ---- Where each drop is --------------------------------------------------------------------------

CELL_FACTORS = (0x8CB92BA72F3D8DD7, 0xD1B54A32D192ED03, 0xABC98388FB8FAC03)


@functools.cache
def cell_counts() -> Float64[np.ndarray, "6"]:
    """Below which share of the hashes a cell has no more than 0, 1, ... drops, and their mean."""
    below = poisson.cdf(np.arange(MAX_IN_CELL), 1.0)
    return np.append(below, float((1 - below).sum()))
