"""Lamps mirrored in wet ground and in water: long streaks towards the eye.

    L = F(theta_i) D(theta_h) G / (4 cos(theta_o)) I exp(-sigma d) / d^2

of each lamp, analytically, without tracing. D is Beckmann's distribution of roughness m, G is
Smith's masking, F is Fresnel's reflectance for n = 1.33; theta_o is the eye's angle to the water's
normal, theta_i the lamp's to the half vector. The lamp's disc widens m; across the streak, so does
half a pixel, and the light stays the same. At a grazing angle a the
streak is 1 / sin(a) times as long as wide. Things between lamp and water do not hide the lamp,
but for the recording car's beams, which have shadows.

Sources: Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"; Torrance and
Sparrow 1967.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64

from augment.lamps import wet_glint_kernels
from augment.lamps.beam_shadows import BeamShadows
from augment.lamps.lamp import Lamps
from augment.lamps.lamp_lanes import lamp_table, pattern_starts
from augment.lamps.patterns import pattern_value
from augment.lamps.road_unevenness import wave_keys, wave_octaves
from augment.lamps.surface_light import shadow_arrays
from augment.lamps.water_tile_kernels import TILE_PX, WaterArrays, WaterView
from augment.lamps.wet_glint_kernels import (
    MAX_EXPONENT,
    MAX_PIXEL_TILT2,
    MIN_COSINE,
    PIXEL_BLUR,
    REFRACTION_INDEX,
)
from augment.lamps.wet_surface import WetRoad, WetSurface
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera


def add_wet_glints(
    picture: Float32[np.ndarray, "H W 3"],
    lamps: Lamps,
    camera: Camera,
    water: WetSurface | WetRoad,
    *,
    extinctions_per_m: Float64[np.ndarray, "M"] | float = 0.0,
    min_luminance_cd_m2: float = 1e-4,
    lamps_per_pixel: int = 8,
    shadows: BeamShadows | None = None,
) -> None:
    """Add the lamps' glints on water to a picture, in place, without the air before the water.

    Args:
        picture: luminance in linear sRGB, cd/m2.
        lamps: the lamps.
        camera: camera of the picture.
        water: the water, or a road under a film of water.
        extinctions_per_m: extinction of the air between each lamp and the water.
        min_luminance_cd_m2: luminance that need not be added.
        lamps_per_pixel: largest number of lamps that glint in a tile.
        shadows: depth maps from the recording car's lamps.

    Raises:
        ValueError: the images differ in size.
    """
    if picture.shape[:2] != water.share.shape:
        raise ValueError(
            f"picture must be {[*water.share.shape, 3]} (from water); got {list(picture.shape)}"
        )
    if not len(lamps) or not water.share.any():
        return
    pose = camera.world_from_camera.numpy()
    frame = water_frame(water.up)
    eye = np.ascontiguousarray(pose[:3, 3])
    view = WaterView(
        np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy]),
        np.ascontiguousarray(frame @ pose[:3, :3]),
        frame,
        eye,
    )
    maps = np.full(len(lamps), -1, np.int64) if shadows is None else shadows.maps_of(lamps)
    with kernel_threads(water.share.shape[0] // TILE_PX + 1):
        wet_glint_kernels.add_glints(
            _water_arrays(water),
            view,
            lamp_table(lamps, extinctions_per_m, lamps.radii_m**2, frame, eye),
            np.require(lamps.tables, np.float32, ["C", "W"]),
            pattern_starts(lamps),
            maps,
            shadow_arrays(shadows),
            float(min_luminance_cd_m2),
            lamps_per_pixel,
            picture,
        )


def water_frame(up: tuple[float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """Return x, y and z of a frame whose z is a normal, in the world; x is nearest to the world's.

    Args:
        up: unit normal of water, which is about level.
    """
    z = np.array(up, np.float64)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _water_arrays(water: WetSurface | WetRoad) -> WaterArrays:
    """Return the water as the kernel takes it."""
    roughness = np.zeros((0, 0), np.float32)
    tilts = np.zeros((0, 0, 2), np.float32)
    film = np.zeros((0, 0, 3), np.float32)
    if isinstance(water, WetRoad):
        film = water.film
    else:
        roughness = water.roughness
        tilts = tilts if water.tilts is None else water.tilts
    return WaterArrays(
        _writable(water.share),
        _writable(water.depth_m),
        _writable(roughness),
        _writable(tilts),
        _writable(film),
        wave_octaves(),
        wave_keys(),
    )


def _writable(image: np.ndarray) -> np.ndarray:
    """Return an image as kernels are compiled for: contiguous float32 that may be written."""
    return np.require(image, np.float32, ["C", "W"])


# ---- Definition ----------------------------------------------------------------------------------


def glint_luminance(
    lamps: Lamps,
    camera: Camera,
    water: WetSurface,
    *,
    extinctions_per_m: Float64[np.ndarray, "M"] | float = 0.0,
) -> Float64[np.ndarray, "H W M"]:
    """Return the luminance of each lamp's glints: the definition of `add_wet_glints`.

    Args:
        lamps: the lamps.
        camera: camera of the picture.
        water: the water.
        extinctions_per_m: extinction of the air between each lamp and the water.
    """
    rays = camera.ray_directions().double().numpy()
    points = rays * water.depth_m[..., None]
    distance = np.linalg.norm(points, axis=2)
    is_water = (water.share > 0) & (distance > 0)
    to_eye = -points / np.maximum(distance, 1e-9)[..., None]
    up = np.broadcast_to(np.asarray(water.up), rays.shape).copy()
    if water.tilts is not None:
        up[..., :2] += water.tilts
        up[..., 2] = np.sqrt(np.maximum(1 - up[..., 0] ** 2 - up[..., 1] ** 2, 0.01))
    extinctions = np.broadcast_to(extinctions_per_m, (len(lamps),))
    luminance = np.zeros((*distance.shape, len(lamps)))
    for m in range(len(lamps)):
        to_lamp = lamps.positions_m[m] - camera.centre.numpy() - points
        squared = (to_lamp**2).sum(2)
        to_lamp /= np.sqrt(squared)[..., None]
        half = to_lamp + to_eye
        half /= np.linalg.norm(half, axis=2, keepdims=True)
        frame = np.stack([lamps.axes[m], np.cross(lamps.axes[m], lamps.ups[m]), lamps.ups[m]])
        share = pattern_value(
            lamps.tables[lamps.patterns[m]], (-to_lamp @ frame.T).reshape(-1, 3)
        ).reshape(distance.shape)
        radius2 = lamps.radii_m[m] ** 2
        lux = lamps.intensities_cd[m] * share / (squared + radius2)
        lux *= np.exp(-extinctions[m] * np.sqrt(squared))
        rough = np.sqrt(water.roughness.astype(np.float64) ** 2 + 0.25 * radius2 / squared)
        incidence = (to_lamp * half).sum(2)
        cosine_lamp, cosine_eye, cosine_half = ((v * up).sum(2) for v in (to_lamp, to_eye, half))
        tilt = (1 + distance / np.sqrt(squared)) / camera.fx
        tilt /= np.maximum(cosine_eye, MIN_COSINE) + np.maximum(cosine_lamp, MIN_COSINE)
        across_m = np.sqrt(rough**2 + PIXEL_BLUR * np.minimum(tilt**2, MAX_PIXEL_TILT2))
        sideways = np.cross(to_eye, up)
        sideways /= np.maximum(np.linalg.norm(sideways, axis=2, keepdims=True), 1e-9)
        across2 = ((half * sideways).sum(2) / cosine_half) ** 2
        along2 = np.maximum(1 / cosine_half**2 - 1 - across2, 0)
        exponent = along2 / rough**2 + across2 / across_m**2
        spread = np.exp(-exponent) / (math.pi * rough * across_m * cosine_half**4)
        eye = np.maximum(cosine_eye, MIN_COSINE)
        masks = _masking(np.maximum(cosine_lamp, MIN_COSINE), rough) * _masking(eye, rough)
        glint = fresnel_reflectance(np.minimum(incidence, 1)) * spread * masks / (4 * eye)
        is_lit = is_water & (exponent <= MAX_EXPONENT) & (cosine_lamp > 0) & (cosine_eye > 0)
        luminance[..., m] = np.where(is_lit, water.share * lux * glint, 0)
    return luminance


def _masking(cosine: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Return Smith's masking of Beckmann's distribution, by the approximation of Walter et al."""
    tangent = np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine
    a = 1 / np.maximum(m * tangent, 1e-12)
    approximation = (3.535 * a + 2.181 * a * a) / (1 + 2.276 * a + 2.577 * a * a)
    return np.where(a < 1.6, approximation, 1)


def fresnel_reflectance(cosine: np.ndarray) -> np.ndarray:
    """Return the reflectance of water for unpolarised light.

    Args:
        cosine: cosine of the angle of incidence.
    """
    inside = np.sqrt(1 - (1 - cosine**2) / REFRACTION_INDEX**2)
    s = (cosine - REFRACTION_INDEX * inside) / (cosine + REFRACTION_INDEX * inside)
    p = (inside - REFRACTION_INDEX * cosine) / (inside + REFRACTION_INDEX * cosine)
    return 0.5 * (s**2 + p**2)
