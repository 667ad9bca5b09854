"""Estimates the light of a scene: the sun's direction and share, the colours of sky and ground.

Input: a `Scene`. Output: `SceneLight`. Callers: effects that lie on the ground or fall.

A recording rarely shows its sun, and its pictures hold no physical unit. Each question has its own
evidence:

- the sun's share of the light: shadows on the ground, or the sky's contrast without them;
- the sun's direction: the sky, unless shadows contradict it;
- the brightness of a given albedo at this exposure: the road, whose albedo is roughly known.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from augment.light.cast_shadows import SOLID_OPACITY, is_low_and_level, shadows_of
from augment.light.srgb import LUMINANCE_WEIGHTS, linear_from_display
from augment.memo import memo_of
from augment.render.sh import SH_C0
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import Sky

# Class, albedo, and whether it is grey, so that its tint is the light's; the best evidence first.
# Oke 1987 lists asphalt 0.05 to 0.20, concrete 0.10 to 0.35, grass 0.16 to 0.26; with the road's a
# little below the middle, white ground comes out as bright as white cars do. None: any class.
_GROUND_ALBEDOS: tuple[tuple[SemanticClass | None, float, bool], ...] = (
    (SemanticClass.ROAD, 0.10, True),
    (SemanticClass.SIDEWALK, 0.22, True),
    (SemanticClass.TERRAIN, 0.18, False),
    (None, 0.12, False),
)
_MIN_SPLATS = 20  # least number of splats of a class
_NUM_SKY_SAMPLES = 16_384  # number of directions over the upper half, one in 1.1 degrees
_NUM_NEIGHBOURS = 40  # number of directions in a disc 8 degrees wide, so that no single texel wins
_SUN_REGION_SHARE = 0.01  # share of the samples that may be the sun's region
_REGION_COSINE = math.cos(math.radians(15.0))  # cosine of the radius of the sun's region
_MIN_SKY_SINE = math.sin(math.radians(3.0))  # sine of the elevation below which skylines are
# Contrast: brightest region over the sky's mean. A grey sky that is three times as bright at the
# zenith as at the horizon (Moon and Spencer 1942) has 1.5. Pictures clip at white, so that the sun
# in a sky of bright clouds has little more; a blue sky has the sun at less contrast.
# Blueness: blue over red of the mean, about 1 overcast and 1.8 clear.
_UNIFORM_CONTRAST = 1.2  # contrast below which the sky shows no sun
# Contrasts of a grey and of a blue sky: overcast below the first, clear above the second.
_GREY_SKY_CONTRASTS = (1.5, 3.0)
_BLUE_SKY_CONTRASTS = (1.2, 1.9)
_GREY_BLUENESS = 1.15  # blueness of a grey sky
_CLEAR_BLUENESS = 1.8  # blueness of a blue sky
_OVERCAST_SHARE = 0.1  # the sun's share of the light under an overcast sky
_CLEAR_SHARE = 0.9  # the sun's share of the light under a clear sky
_LOW_SUN_SHARE = 0.5  # factor of that share at the horizon, where the air dims the sun
_HIGH_SUN_DEG = 30.0  # elevation from which on that factor is 1
_UNKNOWN_SUN_DEG = (135.0, 45.0)  # azimuth and elevation, where the sky shows no sun
# Shadows move the sun if they explain at least the first share of the ground's brightness, and a
# sun where the sky has it explains less than the second share of that.
_MIN_EXPLAINED = 0.15
_MIN_AGREEMENT = 0.75


@dataclass(frozen=True)
class SceneLight:
    """Light that a scene shows."""

    azimuth_deg: float  # azimuth of the sun, 0 is world +x
    elevation_deg: float  # elevation of the sun
    sun_share: float  # share of the light that is the sun's, 0 to 1
    # Luminance of shaded over lit ground; 1 where nothing casts a shadow, None where unknown.
    shadow_ratio: float | None
    contrast: float  # luminance of the sky's brightest region over its mean
    sky_rgb_linear: tuple[float, float, float]  # mean of the upper half by solid angle
    ground_albedo: float | None  # assumed albedo of the ground; None where no ground was found
    # Colour of sunlit ground: its median without shadows; the sky's mean without ground.
    ground_rgb_linear: tuple[float, float, float]
    is_ground_grey: bool  # True if the ground's tint is the light's


def find_scene_light(scene: Scene) -> SceneLight:
    """Return the light that the scene shows; it is computed once for each scene object."""
    scene = scene.as_recorded
    return memo_of(scene).get(("scene light",), lambda: _find_light(scene))


def _find_light(scene: Scene) -> SceneLight:
    """Find the light of a scene by its sky, its ground and its cast shadows."""
    (azimuth_deg, elevation_deg), contrast, sky_rgb = _find_sun_in_sky(scene.sky)
    red, _, blue = three_floats(sky_rgb)
    is_blue = _ramp(blue / red, _GREY_BLUENESS, _CLEAR_BLUENESS) if red > 1e-6 else 0.0
    overcast_contrast, clear_contrast = (
        interpolate(grey, blue, is_blue)
        for grey, blue in zip(_GREY_SKY_CONTRASTS, _BLUE_SKY_CONTRASTS, strict=True)
    )
    clearness = _ramp(contrast, overcast_contrast, clear_contrast)
    clearness *= interpolate(_LOW_SUN_SHARE, 1.0, _ramp(elevation_deg, 0.0, _HIGH_SUN_DEG))
    share = interpolate(_OVERCAST_SHARE, _CLEAR_SHARE, clearness)
    ratio = None
    rgb, albedo, is_grey = _find_ground_colour(scene) or (sky_rgb, None, False)
    shadows = shadows_of(scene)
    if shadows is not None and albedo is not None:
        ratio = shadows.luminance_ratio
        share = min(max(1 - ratio, _OVERCAST_SHARE), _CLEAR_SHARE)
        if shadows.certainty > 0:
            rgb = rgb ** (1 - shadows.certainty) * np.array(shadows.lit_rgb) ** shadows.certainty
        explained_share = shadows.certainty * float(shadows.explained_share.max())
        if (
            explained_share >= _MIN_EXPLAINED
            and shadows.explained_by(azimuth_deg, elevation_deg) < _MIN_AGREEMENT
        ):
            azimuth_deg = shadows.azimuth_deg
            elevation_deg = shadows.elevation_deg
    return SceneLight(
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        sun_share=share,
        shadow_ratio=ratio,
        contrast=contrast,
        sky_rgb_linear=three_floats(sky_rgb),
        ground_albedo=albedo,
        ground_rgb_linear=three_floats(rgb),
        is_ground_grey=is_grey,
    )


def _find_sun_in_sky(sky: Sky) -> tuple[tuple[float, float], float, np.ndarray]:
    """Return the sun's (azimuth, elevation) in degrees, the contrast, and the mean colour.

    The mean colour [3] is linear.
    """
    directions, neighbours = _sky_samples()
    rgb = sky.sample(torch.from_numpy(directions.astype(np.float32))).double().numpy()
    linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1))
    mean_rgb = linear.mean(0)
    smoothed = (linear * np.asarray(LUMINANCE_WEIGHTS)).sum(1)[neighbours].mean(1)
    peak = float(smoothed.max())
    mean = float(smoothed.mean())
    contrast = peak / mean if mean > 1e-6 else 1.0
    if contrast < _UNIFORM_CONTRAST:
        return _UNKNOWN_SUN_DEG, contrast, mean_rgb
    min_luminance = np.quantile(smoothed, 1 - _SUN_REGION_SHARE)
    in_region = (directions * directions[smoothed.argmax()]).sum(1) >= _REGION_COSINE
    weights = np.where(in_region, np.maximum(smoothed - min_luminance, 0), 0)
    if weights.sum() <= 0:  # a plateau wider than the share: take its middle
        weights = np.where(in_region, smoothed, 0)
    x, y, z = (weights[:, None] * directions).sum(0)
    azimuth_deg = math.atan2(y, x)
    elevation_deg = math.atan2(z, math.hypot(x, y))
    return (math.degrees(azimuth_deg), math.degrees(elevation_deg)), contrast, mean_rgb


@functools.cache
def _sky_samples() -> tuple[np.ndarray, np.ndarray]:
    """Return directions above the skyline and the neighbours of each.

    Returns:
        float64 [_NUM_SKY_SAMPLES, 3], unit vectors evenly spread on a golden spiral; and
        [_NUM_SKY_SAMPLES, _NUM_NEIGHBOURS], indices of those around each.
    """
    index = np.arange(_NUM_SKY_SAMPLES)
    z = _MIN_SKY_SINE + (1 - _MIN_SKY_SINE) * (index + 0.5) / _NUM_SKY_SAMPLES
    angle = index * (math.pi * (3 - math.sqrt(5)))
    horizontal = np.sqrt(1 - z * z)
    directions = np.stack([horizontal * np.cos(angle), horizontal * np.sin(angle), z], 1)
    return directions, np.asarray(KDTree(directions).query(directions, _NUM_NEIGHBOURS)[1])


def _find_ground_colour(scene: Scene) -> tuple[np.ndarray, float, bool] | None:
    """Return the ground's median linear colour [3], its albedo, and if it is grey; or None.

    The median is taken by area: layers beneath a surface, which nothing sees, are of fewer and
    smaller splats.
    """
    g = scene.background
    is_solid = (g.opacities > SOLID_OPACITY).numpy()
    for semantic, albedo, is_grey in _GROUND_ALBEDOS:
        if semantic is None:
            is_ground = is_solid & is_low_and_level(g, scene)
        elif g.semantic is None:
            continue
        else:
            is_ground = is_solid & (g.semantic == semantic).numpy()
        if is_ground.sum() < _MIN_SPLATS:
            continue
        sizes = g.scales.double().numpy()[is_ground]
        areas = sizes.prod(1) / np.maximum(sizes.min(1), 1e-12)
        rgb = 0.5 + SH_C0 * g.sh[:, 0].double().numpy()[is_ground]
        linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1))
        return _weighted_median(linear, areas), albedo, is_grey
    return None


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted median of each column of values [N, C]; one weight [N] must be > 0."""
    medians = []
    for column in values.T:
        order = np.argsort(column, kind="stable")
        sums = np.cumsum(weights[order])
        medians.append(column[order][np.searchsorted(sums, sums[-1] / 2)])
    return np.array(medians)


def three_floats(values: np.ndarray) -> tuple[float, float, float]:
    """Return three floats."""
    red, green, blue = (float(value) for value in values)
    return (red, green, blue)


def interpolate(low: float, high: float, share: float) -> float:
    """Interpolate between low and high."""
    return low + share * (high - low)


def _ramp(value: float, low: float, high: float) -> float:
    """Return 0 below low, 1 above high, and a straight line between."""
    return min(1.0, max(0.0, (value - low) / (high - low)))
