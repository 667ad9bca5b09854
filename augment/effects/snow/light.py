"""The light that snow in a scene would stand in: where the sun is, how bright it is, what colour.

A recording rarely shows its sun, and its pictures hold no physical unit. Shadows on the ground
tell how much of the light is the sun's, and the sky where they do not; the sky tells the direction,
unless shadows contradict it; and the road, whose albedo is roughly known, what a surface of a given
albedo looks like at this exposure.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from augment.cast_shadows import SOLID_OPACITY, is_low_and_level, linear_from_display, shadows_of
from augment.memo import memo_of
from augment.render.sh import SH_C0
from augment.scene import Scene
from augment.semantics import SemanticClass
from augment.sky import Sky
from recipes.snow import Snow

FRESH_ALBEDO = 0.85  # `light.brightness` is of this snow; fresh snow has 0.8 to 0.95 (Oke 1987)

# Class, albedo, and whether it is grey, so that its tint is the light's; the best evidence first.
# Oke 1987 lists asphalt 0.05 to 0.20, concrete 0.10 to 0.35, grass 0.16 to 0.26; with the road's a
# little below the middle, snow comes out about as bright as white cars do. None: any class.
_GROUND_ALBEDOS: tuple[tuple[SemanticClass | None, float, bool], ...] = (
    (SemanticClass.ROAD, 0.10, True),
    (SemanticClass.SIDEWALK, 0.22, True),
    (SemanticClass.TERRAIN, 0.18, False),
    (None, 0.12, False),
)
_MIN_SPLATS = 20

_SKY_SAMPLES = 16_384  # over the upper half, one in 1.1 degrees
_SMOOTH_OVER = 40  # of them: a disc 8 degrees wide, so that no single texel wins
_BRIGHTEST = 0.01  # share of the samples that may be the sun's region
_REGION_COSINE = math.cos(math.radians(15.0))
_LOWEST_SINE = math.sin(math.radians(3.0))  # below are skylines

# Contrast: brightest region over the sky's mean. A grey sky that is three times as bright at the
# zenith as at the horizon (Moon and Spencer 1942) has 1.5. Pictures clip at white, so that the sun
# in a sky of bright clouds has little more; a blue sky has the sun at less contrast.
# Blueness: blue over red of the mean, about 1 overcast and 1.8 clear.
_UNIFORM_CONTRAST = 1.2
_GREY_CONTRASTS, _BLUE_CONTRASTS = (1.5, 3.0), (1.2, 1.9)  # overcast below, clear above
_GREY_BLUENESS, _CLEAR_BLUENESS = 1.15, 1.8
_OVERCAST_SHARE, _CLEAR_SHARE = 0.1, 0.9
_LOW_SUN_SHARE, _HIGH_SUN_DEG = 0.5, 30.0  # of that share; the air takes its part of a low sun
_UNKNOWN_SUN_DEG = (135.0, 45.0)  # azimuth, elevation, where the sky shows none

# Light on snow in shadow over light on snow that faces the sun, at no sun and at nothing but sun.
_SHADE_OVERCAST, _SHADE_CLEAR = 0.95, 0.50
_DARKEST_SHADE = 0.35  # as the ground's shadows tell it: snow around lights shadows on snow
_WRAP_OVERCAST, _WRAP_CLEAR = 0.9, 0.5
# Shadows that explain at least so much of the ground's brightness move the sun, if one where the
# sky has it explains less than that share of it.
_TELLING, _AGREEING = 0.15, 0.75
_SUN_TINT = (1.02, 1.0, 0.96)
_TINT_RANGE = (0.8, 1.25)
_KNEE, _CEILING = 0.45, 0.86  # linear; the ceiling is 0.93 display-encoded
_LUMINANCE = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True)
class Illumination:
    """The light on snow. sun: unit, towards the sun, scene world. lit_rgb: display-encoded colour
    of snow that faces the sun, albedo included. shadow_rgb: of snow that the sun does not reach;
    no channel is brighter than lit_rgb's. wrap: how far light reaches around (see SplatShading).
    """

    sun: tuple[float, float, float]
    lit_rgb: tuple[float, float, float]
    shadow_rgb: tuple[float, float, float]
    wrap: float


@dataclass(frozen=True)
class SceneLight:
    """What a scene shows of its light.

    azimuth_deg, elevation_deg: of the sun, 0 degrees azimuth is world +x. sun_share: 0 to 1, of the
    light. shadow_ratio: luminance of shaded over lit ground, 1 where nothing casts a shadow; None
    where the ground does not tell. contrast: of the sky's brightest region over its mean.
    sky_rgb_linear: mean of the upper half by solid angle. ground_albedo: as assumed, None where no
    ground was found. ground_rgb_linear: of what the sun lights, its median where there are no
    shadows; the sky's mean without ground. ground_is_grey: its tint is the light's.
    """

    azimuth_deg: float
    elevation_deg: float
    sun_share: float
    shadow_ratio: float | None
    contrast: float
    sky_rgb_linear: tuple[float, float, float]
    ground_albedo: float | None
    ground_rgb_linear: tuple[float, float, float]
    ground_is_grey: bool


def illumination_of(scene: Scene, snow: Snow) -> Illumination:
    """The light on a recipe's snow in a scene: what the recipe leaves open, the scene answers.

    Level snow in the sun gets radiance = albedo x ground / ground's albedo, in linear light; snow
    that faces the sun is brighter by the wrapped cosine (Green 2004, "Real-time approximations to
    subsurface scattering"), bent below white by a soft shoulder; shadows keep their ratio to it.
    Without ground, snow in shadow gets the mean light of the sky.
    """
    found = light_of(scene)
    light = snow.light
    azimuth_deg, elevation_deg, share = (
        own if given is None else given
        for own, given in (
            (found.azimuth_deg, light.sun_azimuth_deg),
            (found.elevation_deg, light.sun_elevation_deg),
            (found.sun_share, light.sun),
        )
    )
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    flat = math.cos(elevation)
    sun = (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))
    wrap = _mix(_WRAP_OVERCAST, _WRAP_CLEAR, share)
    facing_level = max(0.0, sun[2] + wrap) / (1 + wrap)
    shade = _mix(_SHADE_OVERCAST, _SHADE_CLEAR, share)
    if light.sun is None and found.shadow_ratio is not None:
        # Level snow has the ratio of the level road: s = q (s + (1 - s) facing_level).
        level = found.shadow_ratio * facing_level
        shade = level / max(1 - found.shadow_ratio + level, 1e-6)
        shade = min(max(shade, _DARKEST_SHADE), _SHADE_OVERCAST)
    if light.brightness is None:
        lit = _shoulder(snow.albedo * _facing_light(found, shade, facing_level))
    else:
        given = float(linear_from_display(np.array(light.brightness)))
        lit = min(1.0, given * snow.albedo / FRESH_ALBEDO)
    # A grey road shows the light's colour, but its own and its shadows' as well: a part is taken.
    cast = _tint(found.ground_rgb_linear, 0.25) if found.ground_is_grey else np.ones(3)
    lit_linear = lit * _even(cast * np.asarray(_SUN_TINT) ** share)
    sky_linear = lit * _even(cast * _tint(found.sky_rgb_linear, 0.2 + 0.4 * share))
    lit_rgb, shadow_rgb = (
        _triple(display_from_linear(np.clip(linear, 0, 1)))
        for linear in (lit_linear, _shadow(lit_linear, sky_linear, shade))
    )
    return Illumination(sun, lit_rgb, shadow_rgb, wrap)


def display_from_linear(linear: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 1] of linear light in [0, 1]: the inverse of `linear_from_display`."""
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, linear * 12.92, high)


def _facing_light(found: SceneLight, shade: float, facing_level: float) -> float:
    """Luminance of a white surface that faces the sun."""
    ground = _luminance(np.asarray(found.ground_rgb_linear))
    if found.ground_albedo is None:
        return ground / shade  # it is the sky's, which is all that shadows get
    return ground / found.ground_albedo / _mix(shade, 1.0, facing_level)


def _shadow(lit: np.ndarray, tinted: np.ndarray, shade: float) -> np.ndarray:
    """Linear colour [3] of shadow, `shade` times as bright as lit and of the tint of `tinted`,
    which is as bright as lit; of less tint where a channel would come out above lit's.
    """
    excess = np.maximum(tinted - lit, 1e-12)
    strength = np.minimum(1.0, lit * (1 / shade - 1) / excess).min()
    return np.minimum(shade * (lit + strength * (tinted - lit)), lit)


def light_of(scene: Scene) -> SceneLight:
    """What the scene shows of its light; worked out once per scene object."""
    return memo_of(scene).get(("snow light",), lambda: _find_light(scene))


def _find_light(scene: Scene) -> SceneLight:
    (azimuth_deg, elevation_deg), contrast, sky_rgb = _look_at_sky(scene.sky)
    red, _, blue = _triple(sky_rgb)
    is_blue = _ramp(blue / red, _GREY_BLUENESS, _CLEAR_BLUENESS) if red > 1e-6 else 0.0
    overcast_at, clear_at = (
        _mix(grey, blue, is_blue)
        for grey, blue in zip(_GREY_CONTRASTS, _BLUE_CONTRASTS, strict=True)
    )
    clear = _ramp(contrast, overcast_at, clear_at)
    clear *= _mix(_LOW_SUN_SHARE, 1.0, _ramp(elevation_deg, 0.0, _HIGH_SUN_DEG))
    share, ratio = _mix(_OVERCAST_SHARE, _CLEAR_SHARE, clear), None
    rgb, albedo, is_grey = _look_at_ground(scene) or (sky_rgb, None, False)
    shadows = shadows_of(scene)
    if shadows is not None and albedo is not None:
        ratio = shadows.luminance_ratio
        share = min(max(1 - ratio, _OVERCAST_SHARE), _CLEAR_SHARE)
        if shadows.certainty > 0:
            rgb = rgb ** (1 - shadows.certainty) * np.array(shadows.lit_rgb) ** shadows.certainty
        explains = shadows.certainty * float(shadows.explained.max())
        if explains >= _TELLING and shadows.explained_by(azimuth_deg, elevation_deg) < _AGREEING:
            azimuth_deg, elevation_deg = shadows.azimuth_deg, shadows.elevation_deg
    return SceneLight(
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        sun_share=share,
        shadow_ratio=ratio,
        contrast=contrast,
        sky_rgb_linear=_triple(sky_rgb),
        ground_albedo=albedo,
        ground_rgb_linear=_triple(rgb),
        ground_is_grey=is_grey,
    )


def told_light(scene: Scene, snow: Snow) -> str:
    """Where the light on a recipe's snow comes from, in a few words."""
    if snow.light.sun is not None:
        return f"light: weather.snow.light.sun is {snow.light.sun:g}"
    found = light_of(scene)
    if found.shadow_ratio is None:
        return f"light: {100 * found.sun_share:.0f} % of it the sun's, by the contrast of the sky"
    if found.shadow_ratio == 1:
        return "light: flat, nothing casts a shadow on the ground"
    return f"light: shadows on the ground have {found.shadow_ratio:.2f} of the light beside them"


def _look_at_sky(sky: Sky) -> tuple[tuple[float, float], float, np.ndarray]:
    """The sun's azimuth and elevation in degrees, the contrast, and the mean linear colour [3]."""
    directions, near = _sky_samples()
    rgb = sky.sample(torch.from_numpy(directions.astype(np.float32))).double().numpy()
    linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1))
    mean_rgb = linear.mean(0)
    smooth = (linear * np.asarray(_LUMINANCE)).sum(1)[near].mean(1)
    peak, mean = float(smooth.max()), float(smooth.mean())
    contrast = peak / mean if mean > 1e-6 else 1.0
    if contrast < _UNIFORM_CONTRAST:
        return _UNKNOWN_SUN_DEG, contrast, mean_rgb
    floor = np.quantile(smooth, 1 - _BRIGHTEST)
    in_region = (directions * directions[smooth.argmax()]).sum(1) >= _REGION_COSINE
    weights = np.where(in_region, np.maximum(smooth - floor, 0), 0)
    if weights.sum() <= 0:  # a plateau wider than the share: its middle
        weights = np.where(in_region, smooth, 0)
    x, y, z = (weights[:, None] * directions).sum(0)
    azimuth_deg, elevation_deg = math.atan2(y, x), math.atan2(z, math.hypot(x, y))
    return (math.degrees(azimuth_deg), math.degrees(elevation_deg)), contrast, mean_rgb


@functools.cache
def _sky_samples() -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors above the skyline, evenly spread on a golden spiral, float64 [_SKY_SAMPLES, 3],
    and the numbers of those around each, [_SKY_SAMPLES, _SMOOTH_OVER].
    """
    index = np.arange(_SKY_SAMPLES)
    z = _LOWEST_SINE + (1 - _LOWEST_SINE) * (index + 0.5) / _SKY_SAMPLES
    angle = index * (math.pi * (3 - math.sqrt(5)))
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
    return directions, np.asarray(KDTree(directions).query(directions, _SMOOTH_OVER)[1])


def _look_at_ground(scene: Scene) -> tuple[np.ndarray, float, bool] | None:
    """The ground's median linear colour [3], its albedo, and whether it is grey; None without any.

    By area: layers beneath a surface, which nothing sees, are of fewer and smaller splats.
    """
    g = scene.background
    solid = (g.opacities > SOLID_OPACITY).numpy()
    for semantic, albedo, is_grey in _GROUND_ALBEDOS:
        if semantic is None:
            chosen = solid & is_low_and_level(g, scene)
        elif g.semantic is None:
            continue
        else:
            chosen = solid & (g.semantic == semantic).numpy()
        if chosen.sum() < _MIN_SPLATS:
            continue
        sizes = g.scales.double().numpy()[chosen]
        areas = sizes.prod(1) / np.maximum(sizes.min(1), 1e-12)
        rgb = 0.5 + SH_C0 * g.sh[:, 0].double().numpy()[chosen]
        linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1))
        return _median(linear, areas), albedo, is_grey
    return None


def _median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weighted median of each column of values [N, C], by weights [N] of which one is > 0."""
    medians = []
    for column in values.T:
        order = np.argsort(column, kind="stable")
        sums = np.cumsum(weights[order])
        medians.append(column[order][np.searchsorted(sums, sums[-1] / 2)])
    return np.array(medians)


def _shoulder(luminance: float) -> float:
    """The same up to the knee, then ever slower towards the ceiling, without a kink."""
    if luminance <= _KNEE:
        return luminance
    room = _CEILING - _KNEE
    return _KNEE + room * -math.expm1(-(luminance - _KNEE) / room)


def _tint(rgb_linear: tuple[float, float, float], strength: float) -> np.ndarray:
    """The colour's hue at luminance 1, [3]: 0 strength is white, 1 all of it, within limits."""
    rgb = np.asarray(rgb_linear)
    luminance = _luminance(rgb)
    if luminance < 1e-6:
        return np.ones(3)
    return _even(np.clip((rgb / luminance) ** strength, *_TINT_RANGE))


def _even(rgb: np.ndarray) -> np.ndarray:
    """Scaled to luminance 1."""
    return rgb / _luminance(rgb)


def _luminance(rgb_linear: np.ndarray) -> float:
    return float((rgb_linear * np.asarray(_LUMINANCE)).sum())


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return (red, green, blue)


def _mix(low: float, high: float, share: float) -> float:
    return low + share * (high - low)


def _ramp(value: float, low: float, high: float) -> float:
    """0 below low, 1 above high, straight between."""
    return min(1.0, max(0.0, (value - low) / (high - low)))
