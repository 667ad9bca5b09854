"""Light of the hour: of a scene's own day, at dusk, and at night.

A scene's colours hold no unit. Relative to a white level surface of the scene (`white_level`) they
become luminances as soon as the illuminance of the ground is known: L = P E / pi, with P the
picture's linear light over that of white. By day E follows from the share of the sun in the scene's
light. At dusk and night E is the sky's and the moon's, and the sky is replaced.

Illuminances that are commonly tabulated: 32,000 to 100,000 lx in the sun, 10,000 to 25,000 by day
out of it, 5,000 under a heavy overcast, 400 at sunset, 3.4 at the dark end of civil twilight, 0.25
under a full moon. Over London the night sky has 0.02 to 0.1 cd/m2. The shape of the glow above the
horizon and the tints are assumed.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch

from augment.effects.wet.darkening import to_display, white_level
from augment.light.scene_light import find_scene_light
from augment.light.srgb import LUMINANCE_WEIGHTS, linear_from_display
from augment.scene.scene import Scene
from augment.scene.sky import CubemapSky, directions_of_cubemap
from recipes.light import Light

# Illuminance of level ground out of the sun by day, lux.
OVERCAST_LUX = 10_000.0
# Illuminance of level ground in full sun, lux.
SUNNY_LUX = 100_000.0
# Illuminance of level ground in fog, rain and snowfall by day, lux.
FOUL_LUX = 5_000.0
# Elevation above which the glow of the horizon has fallen to 1/e, degrees.
GLOW_HEIGHT_DEG = 12.0
# Linear colours of the sky overhead, before they get luminance 1.
_ZENITH_TINTS = {"dusk": (0.45, 0.90, 1.75), "night": (0.85, 0.95, 1.25)}
# Linear colours of the glow at the horizon, before they get luminance 1.
_GLOW_TINTS = {"dusk": (1.20, 0.98, 0.85), "night": (1.35, 0.95, 0.65)}
# Texels along a side of a face of the sky's cube map.
_FACE_PX = 128
# Elevations over which the sky's light on level ground is summed.
_NUM_ELEVATIONS = 180


@dataclass(frozen=True)
class Hour:
    """Light of the sky at the hour of a recipe."""

    is_dark: bool
    """True at dusk and night, whose light replaces the scene's."""

    ground_lux: float
    """Illuminance of level ground by sky, sun and moon, lux."""

    sky_cd_m2: float
    """Mean luminance of the sky, cd/m2."""

    reason: str
    """The light in words."""

    @property
    def white_cd_m2(self) -> float:
        """Return the luminance of a white level surface, cd/m2."""
        return self.ground_lux / math.pi


def find_hour(light: Light, scene: Scene, *, is_foul: bool) -> Hour:
    """Return the light of the recipe's hour in a scene.

    Args:
        light: the recipe's section.
        scene: the scene, whose light says by day how much sun there is.
        is_foul: True if the recipe has fog, rain or snowfall, which keep the sun away.
    """
    sky_cd_m2 = light.sky_luminance
    if light.is_dark:
        assert sky_cd_m2 is not None
        lux = math.pi * sky_cd_m2 + light.moon_lux
        return Hour(True, lux, sky_cd_m2, f"{light.time}: {lux:.3g} lx from sky and moon")
    if sky_cd_m2 is not None:
        lux = math.pi * sky_cd_m2
        return Hour(False, lux, sky_cd_m2, f"day: {lux:.3g} lx, as the recipe says")
    if is_foul:
        return Hour(False, FOUL_LUX, FOUL_LUX / math.pi, f"day in foul weather: {FOUL_LUX:g} lx")
    share = find_scene_light(scene).sun_share
    lux = OVERCAST_LUX * (SUNNY_LUX / OVERCAST_LUX) ** share
    reason = f"day with {100 * share:.0f} % of the light the sun's: {lux:.3g} lx"
    return Hour(False, lux, OVERCAST_LUX / math.pi, reason)


def night_sky(light: Light, white_cd_m2: float, white: float) -> CubemapSky:
    """Return the sky of dusk or night in the codes of a day-lit picture.

    Luminance falls from (1 + glow) at the horizon to 1 overhead, times what gives the sky's
    horizontal illuminance pi times its mean luminance. Below the horizon it stays as it is there.

    Args:
        light: the recipe's section, of a dark hour.
        white_cd_m2: luminance of a white level surface by sky and moon, cd/m2.
        white: linear light of that surface in the scene's colours.
    """
    mean_cd_m2 = light.sky_luminance
    assert mean_cd_m2 is not None
    brightness = mean_cd_m2 / max(white_cd_m2, 1e-9) * white
    return _make_sky(light.time, light.glow, brightness)


@functools.lru_cache(maxsize=8)
def _make_sky(time: str, glow: float, brightness: float) -> CubemapSky:
    """Return the sky of `night_sky`.

    Args:
        time: dusk or night.
        glow: luminance at the horizon over that overhead, less 1.
        brightness: linear light of the mean luminance in the scene's colours.
    """
    elevations = (np.arange(_NUM_ELEVATIONS) + 0.5) * (math.pi / 2 / _NUM_ELEVATIONS)
    weights = np.sin(elevations) * np.cos(elevations)
    scale = weights.sum() / (weights * (1 + glow * _glow_fall(elevations))).sum()
    x, y, z = np.moveaxis(directions_of_cubemap(_FACE_PX).double().numpy(), -1, 0)
    glow_at_texels = glow * _glow_fall(np.arctan2(z, np.hypot(x, y)))[..., None]
    rgb = _tint(_ZENITH_TINTS[time]) + glow_at_texels * _tint(_GLOW_TINTS[time])
    rgb = rgb * (scale * brightness)
    return CubemapSky(to_display(torch.from_numpy(rgb)).float().contiguous())


def _glow_fall(elevations: np.ndarray) -> np.ndarray:
    """Return the glow at elevations in radians over that at the horizon."""
    return np.exp(-np.maximum(elevations, 0) / math.radians(GLOW_HEIGHT_DEG))


def white_of_picture(scene: Scene, color_map: torch.Tensor | None) -> float:
    """Return the linear light of a white level surface in a camera's finished picture.

    Args:
        scene: the scene, whose colours say how bright white is.
        color_map: the camera's colour map [3, 4], which the picture has; None without one.
    """
    white = white_level(find_scene_light(scene))
    if color_map is None:
        return white
    code = to_display(torch.full((3,), white, dtype=torch.float64))
    mapped = color_map[:, :3].double() @ code + color_map[:, 3].double()
    linear = linear_from_display(mapped.clamp_min(0).numpy())
    return max(float(linear @ np.asarray(LUMINANCE_WEIGHTS)), 1e-4)


def _tint(rgb: tuple[float, float, float]) -> np.ndarray:
    """Return a linear colour of luminance 1."""
    color = np.asarray(rgb)
    return color / float(color @ np.asarray(LUMINANCE_WEIGHTS))
