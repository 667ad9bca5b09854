"""Luminance of exposed pictures for labels, and the pixels that the lens's glare outshines.

On the CPU a kernel does the work; it equals the plain definition here within 1e-4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from augment.effects.lamps.glare import widen_glare
from augment.effects.lamps.luminance_kernels import measure_luminance
from augment.light.srgb import LUMINANCE_WEIGHTS, linear_from_display
from augment.render.composite import ROWS_PER_CHUNK
from augment.render.threads import kernel_threads

# Smallest light of glare, of saturation, that can veil a pixel: a display-encoded 0.1.
MIN_VEIL = 0.01
_NO_GLARE = np.zeros((0, 0, 3), np.float32)
_NO_IMAGE = np.zeros((0, 0), np.float32)


class LightMeter(NamedTuple):
    """Reading of an exposed picture."""

    luminance_cd_m2: Float32[np.ndarray, "H W"] | None
    """Luminance with glare and without noise, cd/m2; None unless asked for."""
    is_veiled: Bool[np.ndarray, "H W"]
    """Pixels in which glare is more than the light of the scene, and MIN_VEIL at least."""


def read_light(
    rgb: Float32[np.ndarray, "H W 3"],
    glare: Float32[np.ndarray, "h w 3"] | None,
    white_cd_m2: float,
    *,
    needs_luminance: bool,
    uses_kernels: bool = True,
) -> LightMeter:
    """Return what a light meter reads behind the lens, in each pixel.

    Args:
        rgb: exposed picture, display-encoded; 1 saturates the sensor.
        glare: light that the lens scatters, at half the resolution; None for none.
        white_cd_m2: luminance that saturates the sensor, cd/m2.
        needs_luminance: False for the veiled pixels alone.
        uses_kernels: False for the plain definition.
    """
    shape = rgb.shape[:2]
    if not uses_kernels:
        weights = np.asarray(LUMINANCE_WEIGHTS)
        light = linear_from_display(np.maximum(rgb, 0).astype(np.float64)) @ weights
        veil = np.zeros(shape)
        if glare is not None:
            veil = widen_glare(glare, rgb.shape[1], rgb.shape[0]).astype(np.float64) @ weights
        luminance = ((light + veil) * white_cd_m2).astype(np.float32)
        return LightMeter(
            luminance if needs_luminance else None, (veil > light) & (veil >= MIN_VEIL)
        )
    luminance = np.empty(shape, np.float32) if needs_luminance else _NO_IMAGE
    is_veiled = np.empty(shape, np.bool_)
    with kernel_threads(ROWS_PER_CHUNK):
        measure_luminance(
            np.ascontiguousarray(rgb),
            _NO_GLARE if glare is None else np.ascontiguousarray(glare),
            np.array([*LUMINANCE_WEIGHTS, white_cd_m2, MIN_VEIL], np.float32),
            luminance,
            is_veiled,
        )
    return LightMeter(luminance if needs_luminance else None, is_veiled)
