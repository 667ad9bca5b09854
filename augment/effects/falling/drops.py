"""Drops and flakes: their sizes, numbers and fall speeds, and their positions at a time.

Sizes follow exponential laws N(D) = N0 exp(-Lambda D), D in mm of water, per m^3 and mm:

    rain  Lambda = 4.1 R^-0.21     Marshall and Palmer 1948, "The distribution of raindrops
                                   with size"
    snow  Lambda = 2.29 R^-0.45    Sekhon and Srivastava 1970, "Snow size spectra and radar
                                   reflectivity"; D of the melted flake

R is the rate in mm of water an hour. Fall speeds: v = 9.65 - 10.3 exp(-0.6 D) m/s for rain (Atlas,
Srivastava and Sekhon 1973); v = 0.8 d^0.16 m/s for flakes of d mm (Locatelli and Hobbs 1974,
aggregates). N0 is chosen so that the rate is R.

Each class of sizes has a lattice of cells with one drop a cell in the mean. The lattice moves as a
whole, with the fall speed of the class and the wind. Drops do not move within it, except for the
sway of flakes. So the position of a drop depends only on the seed, the class, the cell and the
time. A hash of the cell gives the number of its drops (Poisson), their positions and their sizes.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.stats import poisson

Kind = Literal["rain", "snow"]

# Extinction cross-section of a drop over its geometric cross-section: a drop diffracts as much
# light again as it blocks (van de Hulst 1957, "Light Scattering by Small Particles", ch. 8).
EXTINCTION_EFFICIENCY = 2.0
NUM_CLASSES = 8  # classes of sizes
NUM_QUANTILES = 17  # tabulated quantiles of the diameters in a class
MAX_IN_CELL = 5  # most drops in a cell; one cell in 1700 would have more
_MIN_DIAMETER_MM = 0.1  # smallest diameter, of water
_MAX_DIAMETER_MM = {"rain": 6.0, "snow": 7.0}  # largest diameter, of water
_SNOW_DENSITY = 0.1  # density of a flake over that of water
# Rate below which sizes stay the same, mm/h: the laws were measured at much higher rates.
_MIN_RATE_MM_H = 1e-3
_NUM_STEPS = 400  # steps of the integral over a class
_NUM_LATTICE_RATES = 33  # rates among which a lattice looks for the most drops


@dataclass(frozen=True, eq=False)
class Sizes:
    """Classes of drops or flakes, smallest first."""

    counts_per_m3: Float64[np.ndarray, "B"]
    """Number of drops per cubic metre."""

    diameters_m: Float64[np.ndarray, "B"]
    """Root mean square of the diameters."""

    speeds_mps: Float64[np.ndarray, "B"]
    """Fall speed, mean by mass."""

    quantiles_m: Float64[np.ndarray, "B Q"]
    """NUM_QUANTILES quantiles of the diameters, at evenly spaced shares."""

    mass_kg: Float64[np.ndarray, "B"]
    """Mean mass of a drop."""

    @property
    def extinctions_per_m(self) -> Float64[np.ndarray, "B"]:
        """Extinction of visible light by each class."""
        areas = math.pi / 4 * self.diameters_m**2
        return EXTINCTION_EFFICIENCY * self.counts_per_m3 * areas

    @property
    def extinction_per_m(self) -> float:
        """Extinction of visible light by all classes."""
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
    """Return the sizes in rain or snowfall of a rate > 0."""
    rate = max(rate_mm_h, _MIN_RATE_MM_H)
    slope = 4.1 * rate**-0.21 if kind == "rain" else 2.29 * rate**-0.45  # per mm
    swelling = 1.0 if kind == "rain" else _SNOW_DENSITY ** (-1 / 3)
    edges = np.geomspace(_MIN_DIAMETER_MM, _MAX_DIAMETER_MM[kind], NUM_CLASSES + 1)
    share = (np.arange(_NUM_STEPS) + 0.5) / _NUM_STEPS
    water_mm = edges[:-1, None] + share * (edges[1:] - edges[:-1])[:, None]  # [B, _STEPS]
    counts = np.exp(-slope * water_mm) * ((edges[1:] - edges[:-1]) / _NUM_STEPS)[:, None]
    across_mm = swelling * water_mm
    speeds = 9.65 - 10.3 * np.exp(-0.6 * water_mm) if kind == "rain" else 0.8 * across_mm**0.16
    speeds = np.maximum(speeds, 0.01)
    mass = math.pi / 6 * 1000 * (water_mm / 1000) ** 3  # kg
    falls = (counts * mass * speeds).sum() * 3600
    total = counts.sum(1)
    number = np.maximum(total, 1e-300)  # a class may be empty
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


@functools.lru_cache(maxsize=64)
def lattice_of(kind: Kind, peak_mm_h: float) -> Sizes:
    """Return sizes at a rate, with the most drops of each class that any smaller rate has."""
    sizes = sizes_of(kind, peak_mm_h)
    lowest = min(peak_mm_h, _MIN_RATE_MM_H)
    rates = np.geomspace(lowest, max(peak_mm_h, lowest), _NUM_LATTICE_RATES)
    counts = [sizes_of.__wrapped__(kind, float(rate)).counts_per_m3 for rate in rates]
    return replace(sizes, counts_per_m3=np.max([sizes.counts_per_m3, *counts], axis=0))


# ---- Positions of drops --------------------------------------------------------------------------

CELL_FACTORS = (0x8CB92BA72F3D8DD7, 0xD1B54A32D192ED03, 0xABC98388FB8FAC03)


@functools.cache
def cell_counts() -> Float64[np.ndarray, "6"]:
    """Return the shares of hashes below which a cell has at most 0, 1, ... drops, and the mean."""
    below = poisson.cdf(np.arange(MAX_IN_CELL), 1.0)
    return np.append(below, float((1 - below).sum()))
