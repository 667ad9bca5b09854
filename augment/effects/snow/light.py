"""Light on snow in a scene: direction, brightness and colour of the sun.

Input: the light that a scene shows (augment.light.scene_light) and the recipe's snow, which
overrides it. Output: `SnowIllumination`. Caller: snow's `effect`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from augment.light.scene_light import SceneLight, find_scene_light, interpolate, three_floats
from augment.light.srgb import display_from_linear, linear_from_display, luminance
from augment.scene.scene import Scene
from recipes.snow import Snow

FRESH_ALBEDO = 0.85  # `light.brightness` is of this snow; fresh snow has 0.8 to 0.95 (Oke 1987)
# Light on snow in shadow over light on snow that faces the sun, without sun and with sun alone.
_SHADE_OVERCAST = 0.95
_SHADE_CLEAR = 0.50
# Least such ratio from shadows on the ground: snow around lights shadows on snow.
_MIN_SHADE = 0.35
# How far light reaches around, without sun and with sun alone.
_WRAP_OVERCAST = 0.9
_WRAP_CLEAR = 0.5
_SUN_TINT = (1.02, 1.0, 0.96)  # linear colour of the sun, relative
_TINT_RANGE = (0.8, 1.25)  # limits of a tint's channels
# Luminance at which the shoulder begins, and its limit; linear. 0.86 is 0.93 display-encoded.
_SHOULDER_KNEE = 0.45
_SHOULDER_CEILING = 0.86


@dataclass(frozen=True)
class SnowIllumination:
    """Light on snow."""

    sun: tuple[float, float, float]  # unit vector towards the sun, world
    lit_rgb: tuple[float, float, float]  # display-encoded colour of snow that faces the sun
    # Display-encoded colour of snow that the sun does not reach; no channel exceeds lit_rgb's.
    shadow_rgb: tuple[float, float, float]
    wrap: float  # how far light reaches around, see SplatShading


def find_snow_light(scene: Scene, snow: Snow) -> SnowIllumination:
    """Estimate the light on a recipe's snow in a scene; the scene fills gaps of the recipe.

    Level snow in the sun gets radiance = albedo x ground / ground's albedo, in linear light. Snow
    that faces the sun is brighter by the wrapped cosine (Green 2004, "Real-time approximations to
    subsurface scattering"), bent below white by a soft shoulder. Shadows keep their ratio to it.
    Without ground, snow in shadow gets the mean light of the sky.
    """
    scene_light = find_scene_light(scene)
    light = snow.light
    azimuth_deg, elevation_deg, share = (
        scene_value if recipe_value is None else recipe_value
        for scene_value, recipe_value in (
            (scene_light.azimuth_deg, light.sun_azimuth_deg),
            (scene_light.elevation_deg, light.sun_elevation_deg),
            (scene_light.sun_share, light.sun),
        )
    )
    azimuth = math.radians(azimuth_deg)
    elevation = math.radians(elevation_deg)
    horizontal = math.cos(elevation)
    sun = (horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation))
    wrap = interpolate(_WRAP_OVERCAST, _WRAP_CLEAR, share)
    facing_level = max(0.0, sun[2] + wrap) / (1 + wrap)
    shade = interpolate(_SHADE_OVERCAST, _SHADE_CLEAR, share)
    if light.sun is None and scene_light.shadow_ratio is not None:
        # Level snow has the ratio of the level road: s = q (s + (1 - s) facing_level).
        level_ratio = scene_light.shadow_ratio * facing_level
        shade = level_ratio / max(1 - scene_light.shadow_ratio + level_ratio, 1e-6)
        shade = min(max(shade, _MIN_SHADE), _SHADE_OVERCAST)
    if light.brightness is None:
        lit = _shoulder(snow.albedo * _facing_light(scene_light, shade, facing_level))
    else:
        recipe_luminance = float(linear_from_display(np.array(light.brightness)))
        lit = min(1.0, recipe_luminance * snow.albedo / FRESH_ALBEDO)
    # A grey road shows the light's colour, but also its own and its shadows': a quarter is taken.
    ground_tint = (
        _tint(scene_light.ground_rgb_linear, 0.25) if scene_light.is_ground_grey else np.ones(3)
    )
    lit_linear = lit * _normalize_luminance(ground_tint * np.asarray(_SUN_TINT) ** share)
    sky_linear = lit * _normalize_luminance(
        ground_tint * _tint(scene_light.sky_rgb_linear, 0.2 + 0.4 * share)
    )
    lit_rgb, shadow_rgb = (
        three_floats(display_from_linear(np.clip(linear, 0, 1)))
        for linear in (lit_linear, _shadow_colour(lit_linear, sky_linear, shade))
    )
    return SnowIllumination(sun, lit_rgb, shadow_rgb, wrap)


def _facing_light(scene_light: SceneLight, shade: float, facing_level: float) -> float:
    """Return the luminance of a white surface that faces the sun."""
    ground = luminance(np.asarray(scene_light.ground_rgb_linear))
    if scene_light.ground_albedo is None:
        return ground / shade  # this is the sky's light, which is all that shadows get
    return ground / scene_light.ground_albedo / interpolate(shade, 1.0, facing_level)


def _shadow_colour(lit: np.ndarray, tinted: np.ndarray, shade: float) -> np.ndarray:
    """Linear colour [3] of shadow, `shade` times as bright as lit, in the tint of `tinted`.

    tinted: colour as bright as lit. The tint is weaker where a channel would exceed lit's.
    """
    excess = np.maximum(tinted - lit, 1e-12)
    strength = np.minimum(1.0, lit * (1 / shade - 1) / excess).min()
    return np.minimum(shade * (lit + strength * (tinted - lit)), lit)


def describe_light(scene: Scene, snow: Snow) -> str:
    """Describe in a few words where the light on a recipe's snow comes from."""
    if snow.light.sun is not None:
        return f"light: weather.snow.light.sun is {snow.light.sun:g}"
    light = find_scene_light(scene)
    if light.shadow_ratio is None:
        return f"light: {100 * light.sun_share:.0f} % of it the sun's, by the contrast of the sky"
    if light.shadow_ratio == 1:
        return "light: flat, nothing casts a shadow on the ground"
    return f"light: shadows on the ground have {light.shadow_ratio:.2f} of the light beside them"


def _shoulder(luminance: float) -> float:
    """Compress luminance above the knee towards the ceiling, without a kink."""
    if luminance <= _SHOULDER_KNEE:
        return luminance
    room = _SHOULDER_CEILING - _SHOULDER_KNEE
    return _SHOULDER_KNEE + room * -math.expm1(-(luminance - _SHOULDER_KNEE) / room)


def _tint(rgb_linear: tuple[float, float, float], strength: float) -> np.ndarray:
    """Hue of the colour at luminance 1, [3]; strength 0 is white, 1 the full hue, within limits."""
    rgb = np.asarray(rgb_linear)
    brightness = luminance(rgb)
    if brightness < 1e-6:
        return np.ones(3)
    return _normalize_luminance(np.clip((rgb / brightness) ** strength, *_TINT_RANGE))


def _normalize_luminance(rgb: np.ndarray) -> np.ndarray:
    """Scale a colour to luminance 1."""
    return rgb / luminance(rgb)
