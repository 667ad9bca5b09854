"""Exposure of a camera at dusk and night: from luminance to the light of a display, and noise.

A scene of luminance L gives the sensor E = pi L T / (4 N^2) lux, with the lens's transmittance T
and f-number N. A sensor of ISO speed S saturates at an exposure of 78 / S lux seconds (ISO 12232,
saturation-based speed). A pixel counts photons: 4.1e15 a lumen second at 555 nm.

At 1 cd/m2, f/2, 10 ms, 3 um and a quantum efficiency of 0.6 these are 39 electrons.

The automatic exposure belongs to a scene, not to a picture: it follows from the light of the sky
and of the lamps that do not move, on the road along the recording car's path. So no picture depends
on others, and nothing flickers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from recipes.light import Light

# Transmittance of the lens.
LENS_TRANSMITTANCE = 0.9
# Width of a pixel of the sensor, metres.
PIXEL_M = 3e-6
# Share of the photons that are counted.
QUANTUM_EFFICIENCY = 0.6
# Standard deviation of reading, electrons.
READ_NOISE = 3.0
# Photons in a lumen second at 555 nm: 1 / (683 lm/W) / (h c / 555 nm).
PHOTONS_PER_LUMEN_SECOND = 1 / 683.0 / (6.62607015e-34 * 2.99792458e8 / 555e-9)
# Exposure that saturates a sensor of ISO 1, lux seconds.
SATURATION_LUX_S = 78.0
# Linear light that the automatic exposure gives the road: darker than by day, as pictures of night
# are.
ROAD_TARGET = 0.10
# Smallest ISO speed; brighter scenes shorten the exposure.
MIN_ISO = 100.0
# Linear light from which on the response curve bends.
SHOULDER_START = 0.6
# Share of the light beyond saturation that leaks into the other two channels: lamps turn white.
CROSSTALK = 0.04


@dataclass(frozen=True)
class Exposure:
    """Exposure of a camera."""

    scale: float
    """Linear light of the picture for a luminance of 1 cd/m2; 1 saturates the sensor."""

    electrons: float
    """Electrons that a pixel counts for a luminance of 1 cd/m2."""

    reason: str
    """The exposure in words."""


def electrons_per_cd_m2(exposure_ms: float, f_number: float) -> float:
    """Return the electrons that a pixel counts at 1 cd/m2."""
    lux_s = _image_lux(f_number) * exposure_ms / 1000
    return lux_s * PIXEL_M**2 * PHOTONS_PER_LUMEN_SECOND * QUANTUM_EFFICIENCY


def fixed_exposure(light: Light) -> Exposure:
    """Return the exposure that the recipe gives."""
    scale = _image_lux(light.f_number) * light.exposure_ms / 1000 * light.iso / SATURATION_LUX_S
    words = f"{light.exposure_ms:g} ms, ISO {light.iso:g}, f/{light.f_number:g}"
    return Exposure(scale, electrons_per_cd_m2(light.exposure_ms, light.f_number), words)


def auto_exposure(light: Light, road_cd_m2: float) -> Exposure:
    """Return the exposure that shows the road at ROAD_TARGET, within the recipe's limits.

    Args:
        light: the recipe's section; its exposure_ms and iso are limits.
        road_cd_m2: luminance of the road, cd/m2.
    """
    limit = fixed_exposure(light)
    scale = min(limit.scale, ROAD_TARGET / max(road_cd_m2, 1e-9))
    iso = light.iso * scale / limit.scale
    exposure_ms = light.exposure_ms * min(1.0, iso / min(MIN_ISO, light.iso))
    iso = max(iso, min(MIN_ISO, light.iso))
    words = (
        f"auto: {exposure_ms:.3g} ms, ISO {iso:.3g}, f/{light.f_number:g} "
        f"for a road of {road_cd_m2:.3g} cd/m2"
    )
    return Exposure(scale, electrons_per_cd_m2(exposure_ms, light.f_number), words)


def response(linear: np.ndarray) -> np.ndarray:
    """Return the picture's linear light of exposed light: straight, then a shoulder below 1."""
    room = 1 - SHOULDER_START
    beyond = np.maximum(linear - SHOULDER_START, 0)
    return np.minimum(linear, SHOULDER_START) + room * -np.expm1(-beyond / room)


def _image_lux(f_number: float) -> float:
    """Return the illuminance of the sensor at 1 cd/m2, lux."""
    return math.pi * LENS_TRANSMITTANCE / (4 * f_number**2)
