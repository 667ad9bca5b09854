"""Rain and snowfall on a LiDAR sweep: all drops dim a beam, and single near drops may end it.

The model follows Kilic et al. 2021 ("Lidar Light Scattering Augmentation (LISA)"): small scatterers
count on average, by Beer-Lambert, and single large ones are drawn at random.

    surface at R0    (rho / pi) exp(-2 alpha R0) / R0^2
    drop at r        (rho_d / pi) min(1, D / w)^2 exp(-2 alpha r) xi(r) / r^2

The strongest echo counts. alpha is the extinction of the images, w = aperture + divergence r is the
beam's width, and xi is the share of a near spot's light that the receiver collects
(`receiver_overlap`).
n(D) dD drops per volume are a Poisson process along the beam. So the strongest echo is stronger
than s with probability 1 - exp(-M(s)), where M is the mean number of drops with a stronger echo
(`EchoTable`). Two random numbers a beam, at any rate, give the strength and range of the echo, so
that only the density of drops differs between two rates.

The drops are not those of the images, because a sweep takes a tenth of a second. Their statistics
are the same.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from augment.effects.falling.drops import Kind, sizes_of
from augment.effects.falling.shower import ShowerTable
from augment.effects.lidar.beam import Echoes, LidarModel, signal
from augment.effects.lidar.codes import LOST, PRECIPITATION

WATER_INDEX_905 = 1.3275  # of water at 0.9 um (Hale and Querry 1973)
# Extinction over backscatter, sr, of ice crystals in random orientation: 25 in CALIPSO's first
# three releases, somewhat more since (Young et al. 2018). It is not fitted to a car's sensor: no
# one publishes how such a receiver responds at short range, on which flake echoes depend as much.
ICE_LIDAR_RATIO_SR = 25.0
_STEP_M = 0.05  # step of the tabulated ranges up to _NEAR_M, metres
_NEAR_M = 5.0  # range from which the steps grow, metres
_GROWTH = 0.01  # step beyond _NEAR_M, as a share of the range
_NUM_SIGNALS = 256  # tabulated signals


def sphere_reflectance(index: float) -> float:
    """Return rho of a transparent sphere that is much larger than the wavelength.

    It is the reflectance of a matt disc of the same width that sends as much light back to the
    source. By geometric optics on the axis, the front reflects r, dsigma/dOmega = r a^2 / 4; the
    back, through the front twice, gives (1 - r)^2 r (a^2 / 4) (n / (2 - n))^2; a matt white disc
    gives a^2. Light that travels along the surface (the glory) is left out; it is strong in the
    droplets of fog but not in drops.
    """
    r = ((index - 1) / (index + 1)) ** 2
    return r / 4 * (1 + (1 - r) ** 2 * (index / (2 - index)) ** 2)


DROP_REFLECTANCE = sphere_reflectance(WATER_INDEX_905)  # 0.0235
FLAKE_REFLECTANCE = 2 * math.pi / ICE_LIDAR_RATIO_SR  # 0.25; Q = 2 and matt: S = Q pi / rho


@dataclass(frozen=True, eq=False)
class Scatterers:
    """Drops or flakes in the air."""

    diameters_mm: Float64[np.ndarray, " K"]
    """Diameters, rising."""

    wider_per_m3: Float64[np.ndarray, " K"]
    """Number of drops per cubic metre that are wider than these diameters."""

    extinction_per_m: float
    """Extinction by all drops."""

    reflectance: float
    """Reflectance of one drop, see `sphere_reflectance`."""

    def wider(self, diameter_mm: np.ndarray) -> np.ndarray:
        """Return the number of drops that are wider, 1/m3."""
        return np.interp(diameter_mm, self.diameters_mm, self.wider_per_m3)

    def density(self, diameter_mm: np.ndarray) -> np.ndarray:
        """Return n(D), 1/m3/mm."""
        per_mm = -np.diff(self.wider_per_m3) / np.diff(self.diameters_mm)
        at = np.searchsorted(self.diameters_mm, diameter_mm, side="right")
        return np.concatenate([[0.0], per_mm, [0.0]])[at]


@functools.lru_cache(maxsize=64)
def scatterers_of(kind: Kind, rate_mm_h: float) -> Scatterers:
    """Return the drops or flakes of the images, at a rate > 0."""
    sizes = sizes_of(kind, rate_mm_h)
    counts = sizes.counts_per_m3
    larger = counts.sum() - np.cumsum(counts)  # drops that are larger than those of a class
    share = np.linspace(1, 0, sizes.quantiles_m.shape[1])
    wider = larger[:, None] + counts[:, None] * share
    diameters, first = np.unique(1e3 * sizes.quantiles_m, return_index=True)
    reflectance = DROP_REFLECTANCE if kind == "rain" else FLAKE_REFLECTANCE
    return Scatterers(diameters, wider.ravel()[first], sizes.extinction_per_m, reflectance)


@dataclass(frozen=True, eq=False)
class EchoTable:
    """Echoes of single drops."""

    ranges_m: np.ndarray
    """[K + 1] bounds of the range steps, rising."""

    signals: np.ndarray
    """[S] strengths in the unit of `beam.signal`, rising; the first is the sensor's noise."""

    mean_number: np.ndarray
    """[S, K + 1] mean number of drops nearer than a range with a stronger echo."""

    places: np.ndarray
    """[S, K + 1] number of drops nearer than a range with an echo of just this strength, times a
    factor that is constant in each row.
    """


@functools.lru_cache(maxsize=64)
def echo_table(scatterers: Scatterers, model: LidarModel) -> EchoTable:
    """Return the table of a kind of precipitation, up to the range of its widest drop."""
    near = np.arange(model.overlap_from_m, _NEAR_M, _STEP_M)
    count = math.ceil(math.log(max(model.reach_m / _NEAR_M, 1.0)) / _GROWTH)
    ranges = np.concatenate([near, _NEAR_M * np.exp(_GROWTH * np.arange(count + 1))])
    r = (ranges[1:] + ranges[:-1]) / 2
    white = receiver_overlap(model, r) * signal(np.exp(-2 * scatterers.extinction_per_m * r), r)
    width_mm = 1e3 * beam_width(model, r)
    share = np.minimum(1.0, scatterers.diameters_mm[-1] / width_mm) ** 2
    strongest = scatterers.reflectance * white * share
    noise = model.noise_signal
    num_steps = int((strongest > noise).nonzero()[0].max(initial=0)) + 1
    ranges = ranges[: num_steps + 1]
    white = white[:num_steps]
    width_mm = width_mm[:num_steps]
    signals = np.geomspace(noise, max(2 * noise, strongest.max()), _NUM_SIGNALS)
    with np.errstate(divide="ignore"):  # the transmittance may be 0
        needed_mm = width_mm * np.sqrt(signals[:, None] / (scatterers.reflectance * white))
    # A drop as wide as the beam gives the strongest echo that a drop can give.
    needed_mm = np.where(needed_mm <= width_mm, needed_mm, np.inf)
    needed_mm = np.minimum(needed_mm, scatterers.diameters_mm[-1])
    volume = math.pi / 4 * (width_mm / 1e3) ** 2 * np.diff(ranges)
    number = np.cumsum(volume * scatterers.wider(needed_mm), axis=1)
    # dD / ds of the drops whose echo is s is D / 2s.
    place = np.cumsum(volume * scatterers.density(needed_mm) * needed_mm, axis=1)
    zeros = np.zeros((_NUM_SIGNALS, 1))
    return EchoTable(ranges, signals, np.hstack([zeros, number]), np.hstack([zeros, place]))


def beam_width(model: LidarModel, ranges_m: np.ndarray) -> np.ndarray:
    """Return the diameter of the beam, metres."""
    return model.aperture_m + model.divergence_rad * ranges_m


def receiver_overlap(model: LidarModel, ranges_m: np.ndarray) -> np.ndarray:
    """Return the share of a lit spot's light on the receiver's lens that its field holds."""
    overlap = (ranges_m - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m)
    return np.clip(overlap, 0.0, 1.0) * np.minimum(1.0, ranges_m / model.focus_m) ** 2


def strongest_drops(
    table: EchoTable, ends_m: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw signal [N] (0 without an echo) and range [N] of the strongest drop before ends_m [N].

    Two numbers a beam are drawn for every table.
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
        level_rows = rows[which == level]
        places = table.places[level]
        ranges[level_rows] = np.interp(
            place[level_rows] * places[last[level_rows]], places, table.ranges_m
        )
    return strength, ranges


def precipitation_echoes(
    echoes: Echoes,
    scatterers: Scatterers,
    rng: np.random.Generator,
    shower: ShowerTable | None = None,
) -> None:
    """Weaken echoes by precipitation, add range noise, and replace those that a drop exceeds.

    Args:
        echoes: changed in place.
        scatterers: the drops about the sensor.
        rng: generator of the drops.
        shower: the shower about the sensor; None if the rate is the same everywhere.
    """
    model = echoes.model
    air = echoes.air_path_m
    before = echoes.gain.copy()
    if shower is None:
        optical_depth = scatterers.extinction_per_m * air
    else:
        optical_depth = shower.optical_depth(air[:, None] * echoes.directions)
    echoes.gain *= np.exp(-2 * optical_depth)
    echoes.add_range_noise(before, rng.standard_normal(len(air)))
    strength, ranges = strongest_drops(echo_table(scatterers, model), air, rng)
    # The fog between sensor and drop is taken as dense as at the sensor.
    strength *= np.exp(-2 * np.minimum(echoes.extinction_per_m * ranges, 300.0))
    echoes.extinction_per_m += scatterers.extinction_per_m
    candidates = np.flatnonzero((strength > 0) & (echoes.ranges_m > 0) & (echoes.codes != LOST))
    surface = signal(echoes.reflectance * echoes.gain, np.maximum(echoes.ranges_m, 1e-3))[
        candidates
    ]
    noise = model.noise_reflectance(ranges[candidates])
    reflectance = strength[candidates] / signal(np.ones(len(candidates)), ranges[candidates])
    wins = (strength[candidates] > surface) & (reflectance >= noise)
    rows = candidates[wins]
    echoes.replace_echoes(rows, ranges[rows], reflectance[wins], PRECIPITATION)
