"""Waves drawn from what a recipe says of them.

A preset is a spectrum for a flooded street: a fetch of tens of metres between houses, so short
waves only, all running within some angle of the wind. Every wave has the same slope (the mean
square slope per octave of a wind sea is nearly constant: Phillips 1958), so amplitudes grow with
wavelength.

Cox and Munk 1954 give the mean square slope of the open sea as 0.003 + 0.00512 U for a wind of U
m/s (0.008 + 0.00156 U without waves shorter than about 0.3 m): an rms slope of 0.09 at 1 m/s, 0.17
at 5 m/s. Water between houses is sheltered and has no long fetch, so the presets lie below that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from augment.rng import rng_for
from augment.weather.waves import WaveSet
from recipes.flood import Wave, Waves

MOST_STEEPNESS = 0.8  # of all waves together, so that no crest of a preset comes near a cusp
_WIDEST_RAD = math.radians(85)  # no wave runs against the wind that raised it


@dataclass(frozen=True)
class _Spectrum:
    """Wavelengths, rms slope of all waves together, deviation of their directions."""

    shortest_m: float
    longest_m: float
    rms_slope: float
    spread_deg: float


_SPECTRA = {
    "calm": _Spectrum(0.06, 1.2, 0.012, 50.0),
    "breeze": _Spectrum(0.08, 2.5, 0.04, 35.0),
    "wind": _Spectrum(0.12, 6.0, 0.09, 28.0),
}


def make_waves(recipe: Waves, *, seed: int, depth_m: float) -> WaveSet:
    """The recipe's waves, the same bits for the same recipe, seed and depth.

    seed: taken where the recipe has none of its own. depth_m: of the water, metres, > 0. The draw
    depends on no scene, frame or camera, so all views of all times see one surface.

    Raises:
        ValueError: the components' steepness sums to more than 1, or depth_m is not > 0.
    """
    if recipe.components is not None:
        return _from_components(recipe.components, depth_m)
    if recipe.preset == "still":
        return _from_components((), depth_m)
    seed = seed if recipe.seed is None else recipe.seed
    rng = rng_for(seed=seed, scene="", effect="flood waves")
    return _draw(_SPECTRA[recipe.preset], recipe, rng, depth_m)


def _from_components(components: tuple[Wave, ...], depth_m: float) -> WaveSet:
    angles = np.radians([wave.direction_deg for wave in components])
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=np.array([wave.amplitude_m for wave in components], np.float64),
        wavelengths_m=np.array([wave.wavelength_m for wave in components], np.float64),
        steepness=np.array([wave.steepness for wave in components], np.float64),
        phases_rad=np.radians([wave.phase_deg for wave in components]),
        depth_m=depth_m,
    )


def _draw(spectrum: _Spectrum, recipe: Waves, rng: np.random.Generator, depth_m: float) -> WaveSet:
    count = recipe.count
    # One wave in each of `count` equal parts of the octaves, so that none is left empty.
    part = (np.arange(count) + rng.random(count)) / count
    wavelengths = spectrum.shortest_m * (spectrum.longest_m / spectrum.shortest_m) ** part
    spread = math.radians(spectrum.spread_deg) * rng.standard_normal(count)
    angles = math.radians(recipe.direction_deg) + np.clip(spread, -_WIDEST_RAD, _WIDEST_RAD)
    slope = spectrum.rms_slope * math.sqrt(2 / count) * recipe.height  # k A of each wave
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=slope * wavelengths / (2 * math.pi),
        wavelengths_m=wavelengths,
        # Q = 1, the circular orbits of deep water (Gerstner's trochoid), where that leaves room.
        steepness=np.full(count, min(slope, MOST_STEEPNESS / count)),
        phases_rad=rng.uniform(0, 2 * math.pi, count),
        depth_m=depth_m,
    )
