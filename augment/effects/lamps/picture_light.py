"""Pictures between display-encoded colours and light: relighting and development.

On the CPU kernels do the work; they equal the plain definitions here within 1e-4. Arrays are
float32 on the CPU; callers move those of a GPU.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from augment.effects.lamps import light_kernels
from augment.effects.lamps.exposure import CROSSTALK, MAX_LEAKING, response
from augment.effects.lamps.glare import widen_glare
from augment.effects.lamps.light_kernels import MAX_LIGHT
from augment.light.srgb import display_from_linear, linear_from_display
from augment.render.composite import ROWS_PER_CHUNK
from augment.render.constants import SURFACE_ALPHA
from augment.render.sensor import LEVEL_SD
from augment.render.threads import kernel_threads

# Light, of saturation, that lamps must add for a saturated pixel to be theirs.
MIN_SATURATING_LIGHT = 0.1
# Least reflectance of a surface. Darker colours are shadows of the day; with more than this they
# turn to smoke in the beams, since they lose their texture.
MIN_REFLECTANCE = 0.004
# Greatest reflectance of a surface.
MAX_REFLECTANCE = 0.9
_NONE = np.zeros((0, 0), np.float32)
_NO_DRAWS = np.zeros((0, 0), np.uint8)


def relight(
    rgb: Float32[np.ndarray, "H W 3"],
    added_cd_m2: Float32[np.ndarray, "H W 3"] | None,
    gain: float,
    added_gain: float,
    min_added: float,
    *,
    uses_kernels: bool = True,
) -> tuple[Float32[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Return a picture whose light is scaled and gets that of lamps, and where they saturate it.

    Args:
        rgb: the picture, display-encoded.
        added_cd_m2: luminance that lamps add, cd/m2; None for none.
        gain: factor of the picture's own linear light.
        added_gain: light of the picture for 1 cd/m2.
        min_added: pixels keep their bits if no channel gets more light than this; negative to
            change all.
        uses_kernels: False for the plain definition.

    Returns:
        the picture, display-encoded, not clamped; and the mask of pixels that lamps saturate.
    """
    if not uses_kernels:
        added = np.zeros_like(rgb) if added_cd_m2 is None else added_cd_m2 * np.float32(added_gain)
        light = gain * linear_from_display(np.maximum(rgb, 0).astype(np.float64)) + added
        is_changed = added.max(-1) > min_added
        out = np.where(is_changed[..., None], display_from_linear(light), rgb).astype(np.float32)
        is_saturated = (light.max(-1) >= 1) & (added.max(-1) >= MIN_SATURATING_LIGHT)
        return out, is_saturated & is_changed
    out = np.empty_like(rgb)
    mask = np.empty(rgb.shape[:2], np.bool_)
    with kernel_threads(ROWS_PER_CHUNK):
        light_kernels.relight(
            _rows(rgb),
            _NONE if added_cd_m2 is None else _rows(added_cd_m2),
            np.array([gain, added_gain, MIN_SATURATING_LIGHT], np.float32),
            np.float32(min_added),
            _rows(out),
            mask,
        )
    return out, mask


def halve_excess(
    rgb: Float32[np.ndarray, "H W 3"], *, uses_kernels: bool = True
) -> Float32[np.ndarray, "h w 3"] | None:
    """Return the light beyond saturation, the mean of every four pixels; None for none.

    Args:
        rgb: exposed picture, display-encoded; 1 saturates the sensor.
        uses_kernels: False for the plain definition.
    """
    height, width, _ = rgb.shape
    shape = (-(-height // 2), -(-width // 2), 3)
    if not uses_kernels:
        excess = np.zeros((2 * shape[0], 2 * shape[1], 3))
        light = linear_from_display(np.maximum(rgb, 0).astype(np.float64))
        excess[:height, :width] = np.where(rgb > 1, np.maximum(light - 1, 0), 0)
        out = excess.reshape(shape[0], 2, shape[1], 2, 3).mean((1, 3)).astype(np.float32)
        return out if out.any() else None
    out = np.empty(shape, np.float32)
    is_saturated = np.empty(shape[0], np.bool_)
    with kernel_threads(ROWS_PER_CHUNK):
        light_kernels.halve_excess(_rows(rgb), _rows(out), is_saturated)
    return out if is_saturated.any() else None


def develop(
    rgb: Float32[np.ndarray, "H W 3"],
    glare: Float32[np.ndarray, "h w 3"] | None,
    draws: UInt8[np.ndarray, "H W 3"] | None,
    electrons: float,
    read_noise: float,
    noise: float,
    *,
    balance: Float64[np.ndarray, "3"] | None = None,
    uses_kernels: bool = True,
) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture that a sensor makes of light: crosstalk, noise, balance, response curve.

    Args:
        rgb: exposed picture, display-encoded; 1 saturates the sensor.
        glare: light that the lens scatters, at half the resolution; None for none.
        draws: result of `augment.render.sensor.draw_noise`; None for no noise.
        electrons: electrons of a pixel at saturation.
        read_noise: standard deviation of reading, electrons.
        noise: factor of the noise.
        balance: factors of the channels for the white balance; None for 1.
        uses_kernels: False for the plain definition.
    """
    factors = np.ones(3) if balance is None else balance
    per_draw = (noise / LEVEL_SD) ** 2
    per_light = per_draw / electrons
    of_reading = per_draw * (read_noise / electrons) ** 2
    if uses_kernels:
        out = np.empty_like(rgb)
        with kernel_threads(ROWS_PER_CHUNK):
            light_kernels.develop(
                _rows(rgb),
                _NONE if glare is None else _rows(glare),
                _NO_DRAWS if draws is None else _rows(draws),
                np.array([CROSSTALK, per_light, of_reading, *factors, MAX_LEAKING], np.float32),
                _rows(out),
            )
        return out
    total = linear_from_display(np.maximum(rgb, 0).astype(np.float64))
    total += 0 if glare is None else widen_glare(glare, rgb.shape[1], rgb.shape[0])
    excess = np.clip(total - 1, 0, MAX_LEAKING)
    total += CROSSTALK * (excess.sum(-1, keepdims=True) - excess)
    if draws is not None:
        sigma = np.sqrt(per_light * np.maximum(total, 0) + of_reading)
        total += sigma * (draws.astype(np.float64) - 128)
    linear = response(np.clip(total * factors, 0, MAX_LIGHT))
    return display_from_linear(linear).astype(np.float32)


def find_reflectance(
    rgb: Float32[np.ndarray, "H W 3"],
    white: float,
    fog_share: Float32[np.ndarray, "H W"] | None,
    airlight_rgb: tuple[float, float, float],
    *,
    uses_kernels: bool = True,
) -> Float32[np.ndarray, "H W 3"]:
    """Return the reflectance of surfaces, times the transmittance of the fog before them.

    Args:
        rgb: the picture, display-encoded.
        white: linear light of a white surface in it.
        fog_share: share of the airlight in each pixel; None without fog.
        airlight_rgb: colour of the fog, display-encoded.
        uses_kernels: False for the plain definition.
    """
    airlight = linear_from_display(np.maximum(np.asarray(airlight_rgb), 0)).astype(np.float32)
    if uses_kernels:
        out = np.empty_like(rgb)
        with kernel_threads(ROWS_PER_CHUNK):
            light_kernels.find_reflectance(
                _rows(rgb),
                _NONE if fog_share is None else fog_share,
                airlight,
                np.array([1 / white, MIN_REFLECTANCE, MAX_REFLECTANCE], np.float32),
                _rows(out),
            )
        return out
    share = np.zeros(rgb.shape[:2]) if fog_share is None else np.clip(fog_share, 0, 1)
    share = share[..., None].astype(np.float64)
    light = linear_from_display(np.maximum(rgb, 0).astype(np.float64))
    light = (light - share * airlight) / white
    bounds = MIN_REFLECTANCE * (1 - share), MAX_REFLECTANCE * (1 - share)
    return np.clip(light, *bounds).astype(np.float32)


def find_surfaces(
    alpha: Float32[np.ndarray, "H W"],
    depth_m: Float32[np.ndarray, "H W"],
    *,
    uses_kernels: bool = True,
) -> Float32[np.ndarray, "H W"]:
    """Return the depth of pixels that show a surface, 0 for the sky.

    Args:
        alpha: opacity of the pixels.
        depth_m: z of what they show, metres.
        uses_kernels: False for the plain definition.
    """
    if not uses_kernels:
        is_surface = (alpha >= SURFACE_ALPHA) & np.isfinite(depth_m)
        return np.where(is_surface, depth_m, np.float32(0))
    surface_m = np.empty_like(depth_m)
    with kernel_threads(ROWS_PER_CHUNK):
        light_kernels.find_surfaces(alpha, depth_m, np.float32(SURFACE_ALPHA), surface_m)
    return surface_m


def _rows(image: np.ndarray) -> np.ndarray:
    """Return an image [H, W, 3] as rows of numbers [H, 3 W]."""
    return np.ascontiguousarray(image).reshape(image.shape[0], 3 * image.shape[1])
