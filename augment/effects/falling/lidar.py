"""Rain and snowfall on a LiDAR sweep: beams are dimmed by all drops, and end on single near ones.

As Kilic et al. 2021 ("Lidar Light Scattering Augmentation (LISA)"): small scatterers count on
average, by Beer and Lambert, and those that can be seen singly at random.

    surface at R0    (rho / pi) exp(-2 alpha R0) / R0^2
    drop at r        (rho_d / pi) min(1, D / w)^2 exp(-2 alpha r) xi(r) / r^2

The strongest wins. alpha is the extinction of the images, w = aperture + divergence r the beam's
width, and xi what the receiver sees of a near spot (`seen_share`). Drops of n(D) dD a volume are a
Poisson process along the beam, so the strongest echo is stronger than s with probability
1 - exp(-M(s)), M being the mean number of drops that are (`EchoTable`): two numbers a beam,
whatever the rate, tell its strength and place, and more rain differs by nothing else.

Not these drops but their statistics are those of the images: a sweep takes a tenth of a second.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from augment.effects.falling.drops import Kind, sizes_of
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.lidar.codes import LOST, PRECIPITATION

WATER_INDEX_905 = 1.3275  # of water at 0.9 um (Hale and Querry 1973)
# Extinction over backscatter, sr, of ice crystals that lie at random: 25 in CALIPSO's first three
# releases, somewhat more since (Young et al. 2018). Not fitted to a car's sensor: nobody publishes
# its receiver near by, on which echoes of flakes depend as much.
ICE_LIDAR_RATIO_SR = 25.0
_STEP_M = 0.05
_NEAR_M = 5.0
_GROWTH = 0.01  # of the ranges: even ones, then a share of the range
_SIGNALS = 256


def sphere_reflectance(index: float) -> float:
    """rho of a transparent sphere far larger than the wavelength: that of a matt disc as wide which
    gives as much back to where the light comes from.

    Geometric optics on the axis: the front mirrors r, dsigma/dOmega = r a^2 / 4; the back, through
    the front twice, (1 - r)^2 r (a^2 / 4) (n / (2 - n))^2; a matt white disc gives a^2. Left out is
    what travels along the surface (the glory), strong in fog's droplets and not in drops.
    """
    r = ((index - 1) / (index + 1)) ** 2
    return r / 4 * (1 + (1 - r) ** 2 * (index / (2 - index)) ** 2)


DROP_REFLECTANCE = sphere_reflectance(WATER_INDEX_905)  # 0.0235
FLAKE_REFLECTANCE = 2 * math.pi / ICE_LIDAR_RATIO_SR  # 0.25; Q = 2 and matt: S = Q pi / rho


@dataclass(frozen=True, eq=False)
class Scatterers:
    """Drops or flakes in the air. wider_per_m3 [K]: how many are wider than diameters_mm [K], which
    rise. extinction_per_m: of all. reflectance: of one, see sphere_reflectance.
    """

    diameters_mm: Float64[np.ndarray, " K"]
    wider_per_m3: Float64[np.ndarray, " K"]
    extinction_per_m: float
    reflectance: float

    def wider(self, diameter_mm: np.ndarray) -> np.ndarray:
        """How many are wider, 1/m3."""
        return np.interp(diameter_mm, self.diameters_mm, self.wider_per_m3)

    def density(self, diameter_mm: np.ndarray) -> np.ndarray:
        """n(D), 1/m3/mm."""
        per_mm = -np.diff(self.wider_per_m3) / np.diff(self.diameters_mm)
        at = np.searchsorted(self.diameters_mm, diameter_mm, side="right")
        return np.concatenate([[0.0], per_mm, [0.0]])[at]


@functools.lru_cache(maxsize=64)
def scatterers_of(kind: Kind, rate_mm_h: float) -> Scatterers:
    """The drops or flakes of the images, at a rate > 0."""
    sizes = sizes_of(kind, rate_mm_h)
    counts = sizes.counts_per_m3
    larger = counts.sum() - np.cumsum(counts)  # than those of a class
    share = np.linspace(1, 0, sizes.quantiles_m.shape[1])
    wider = larger[:, None] + counts[:, None] * share
    diameters, first = np.unique(1e3 * sizes.quantiles_m, return_index=True)
    reflectance = DROP_REFLECTANCE if kind == "rain" else FLAKE_REFLECTANCE
    return Scatterers(diameters, wider.ravel()[first], sizes.extinction_per_m, reflectance)


@dataclass(frozen=True, eq=False)
class EchoTable:
    """Echoes of single drops. ranges_m [K + 1]: rising, bounds of the steps. signals [S]: rising,
    as of `signal`; the first is the sensor's noise. mean_number [S, K + 1]: of drops nearer than a
    range whose echo is stronger. places [S, K + 1]: of the drops whose echo is just as strong, how
    many are nearer than a range, times a number of the row's own.
    """

    ranges_m: np.ndarray
    signals: np.ndarray
    mean_number: np.ndarray
    places: np.ndarray


@functools.lru_cache(maxsize=64)
def echo_table(scatterers: Scatterers, model: LidarModel) -> EchoTable:
    """The table of a kind of precipitation, up to where its widest drop is too faint."""
    near = np.arange(model.overlap_from_m, _NEAR_M, _STEP_M)
    count = math.ceil(math.log(max(model.reach_m / _NEAR_M, 1.0)) / _GROWTH)
    ranges = np.concatenate([near, _NEAR_M * np.exp(_GROWTH * np.arange(count + 1))])
    r = (ranges[1:] + ranges[:-1]) / 2
    white = seen_share(model, r) * signal(np.exp(-2 * scatterers.extinction_per_m * r), r)
    width_mm = 1e3 * beam_width(model, r)
    share = np.minimum(1.0, scatterers.diameters_mm[-1] / width_mm) ** 2
    strongest = scatterers.reflectance * white * share
    noise = model.noise_signal
    used = int((strongest > noise).nonzero()[0].max(initial=0)) + 1
    ranges = ranges[: used + 1]
    white = white[:used]
    width_mm = width_mm[:used]
    signals = np.geomspace(noise, max(2 * noise, strongest.max()), _SIGNALS)
    with np.errstate(divide="ignore"):  # where nothing comes through
        needed_mm = width_mm * np.sqrt(signals[:, None] / (scatterers.reflectance * white))
    # A drop as wide as the beam gives all that one can.
    needed_mm = np.where(needed_mm <= width_mm, needed_mm, np.inf)
    needed_mm = np.minimum(needed_mm, scatterers.diameters_mm[-1])
    volume = math.pi / 4 * (width_mm / 1e3) ** 2 * np.diff(ranges)
    number = np.cumsum(volume * scatterers.wider(needed_mm), axis=1)
    # dD / ds of the drops whose echo is s is D / 2s.
    place = np.cumsum(volume * scatterers.density(needed_mm) * needed_mm, axis=1)
    nothing = np.zeros((_SIGNALS, 1))
    return EchoTable(ranges, signals, np.hstack([nothing, number]), np.hstack([nothing, place]))


def beam_width(model: LidarModel, ranges_m: np.ndarray) -> np.ndarray:
    """Diameter of the beam, metres."""
    return model.aperture_m + model.divergence_rad * ranges_m


def seen_share(model: LidarModel, ranges_m: np.ndarray) -> np.ndarray:
    """Of the light of a lit spot that meets the receiver's lens, what its field holds."""
    overlap = (ranges_m - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m)
    return np.clip(overlap, 0.0, 1.0) * np.minimum(1.0, ranges_m / model.focus_m) ** 2


def strongest_drops(
    table: EchoTable, ends_m: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Signal [N], 0 where no drop is seen, and range [N] of the strongest drop before ends_m [N].

    Two numbers a beam are drawn, whatever the table holds.
    """
    number = rng.standard_exponential(len(ends_m))
    place = rng.random(len(ends_m))
    strength = np.zeros(len(ends_m))
    ranges = np.zeros(len(ends_m))
    last = np.searchsorted(table.ranges_m, ends_m, side="right") - 1  # whole steps before the end
    last = np.clip(last, 0, len(table.ranges_m) - 1)
    hit = number < table.mean_number[0, last]
    logs = np.log(table.signals[::-1])
    for column in np.unique(last[hit]):
        rows = np.flatnonzero(hit & (last == column))
        means = table.mean_number[::-1, column]  # rising
        strength[rows] = np.exp(np.interp(number[rows], means, logs))
    rows = np.flatnonzero(hit)
    which = np.searchsorted(table.signals, strength[rows], side="right") - 1
    for level in np.unique(which):
        at = rows[which == level]
        places = table.places[level]
        ranges[at] = np.interp(place[at] * places[last[at]], places, table.ranges_m)
    return strength, ranges


def precipitation_echoes(echoes: Echoes, scatterers: Scatterers, rng: np.random.Generator) -> None:
    """Echoes seen through rain or snowfall, noisier by what it takes, or lost to a drop's own."""
    model = echoes.model
    air = echoes.air_m
    before = echoes.gain.copy()
    echoes.gain *= np.exp(-2 * scatterers.extinction_per_m * air)
    echoes.spread_ranges(before, rng.standard_normal(len(air)))
    strength, ranges = strongest_drops(echo_table(scatterers, model), air, rng)
    # Fog between the sensor and the drop, as dense as about the sensor.
    strength *= np.exp(-2 * np.minimum(echoes.haze_per_m * ranges, 300.0))
    echoes.haze_per_m += scatterers.extinction_per_m
    there = np.flatnonzero((strength > 0) & (echoes.ranges_m > 0) & (echoes.codes != LOST))
    surface = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))[there]
    noise = model.noise_reflectance(ranges[there])
    reflectance = strength[there] / signal(np.ones(len(there)), ranges[there])
    wins = (strength[there] > surface) & (reflectance >= noise)
    rows = there[wins]
    echoes.replace(rows, ranges[rows], reflectance[wins], PRECIPITATION)
