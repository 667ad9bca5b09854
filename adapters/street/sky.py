"""The sky: a gradient with a sun, cumulus clouds, and a hazy skyline below which land begins."""

from __future__ import annotations

import numpy as np
import torch

from adapters.street.lighting import HAZE_RGB, encode_display
from adapters.street.noise import fractal_noise
from augment.sky import CubemapSky, directions_of_cubemap

FACE_SIZE = 512
ZENITH_RGB = np.array([0.16, 0.34, 0.74])
HORIZON_RGB = np.array([0.66, 0.77, 0.92])
CLOUD_RGB = np.array([1.75, 1.72, 1.68])
CLOUD_SHADE_RGB = np.array([0.62, 0.67, 0.74])
CLOUD_HEIGHT = 1.0  # clouds lie on a plane; its height only sets their size against the noise


def build_sky(seed: int, to_sun: np.ndarray) -> CubemapSky:
    """A cubemap of display-encoded colours."""
    directions = directions_of_cubemap(FACE_SIZE).numpy().reshape(-1, 3)
    faces = np.empty_like(directions)
    above = directions[:, 2] > -0.03
    faces[above] = encode_display(_radiance(directions[above], seed, to_sun))
    faces[~above] = encode_display(HAZE_RGB * 0.62)
    cube = faces.reshape(6, FACE_SIZE, FACE_SIZE, 3).astype(np.float32)
    return CubemapSky(torch.from_numpy(cube))


def _radiance(directions: np.ndarray, seed: int, to_sun: np.ndarray) -> np.ndarray:
    """Linear radiance [N, 3] of directions at or above the horizon."""
    up = np.maximum(directions[:, 2], 0)
    fade = (1 - up) ** 3.2
    sky = ZENITH_RGB + fade[:, None] * (HORIZON_RGB - ZENITH_RGB)
    cosine = np.clip(directions @ to_sun.astype(np.float32), -1, 1)
    glow = 0.35 * np.clip(cosine, 0, 1) ** 12 + 0.8 * np.clip(cosine, 0, 1) ** 220
    sky = sky + glow[:, None] * np.array([1.0, 0.93, 0.80])
    sky = _with_clouds(sky, directions, cosine, seed)
    disc = np.clip((cosine - np.cos(0.013)) / (1 - np.cos(0.013)) * 4, 0, 1)
    sky = sky + disc[:, None] * 12.0
    return _with_skyline(sky, directions, seed)


def _with_clouds(
    sky: np.ndarray, directions: np.ndarray, cosine: np.ndarray, seed: int
) -> np.ndarray:
    up = directions[:, 2]
    high = up > 0.02
    d = directions[high]
    plane = d[:, :2] / (d[:, 2:] + 0.12) * CLOUD_HEIGHT
    billow = fractal_noise(plane * 1.1, 6, seed * 7 + 100)
    cover = 0.5 + 0.5 * fractal_noise(plane * 0.35, 2, seed * 7 + 200)
    thick = np.clip((billow + 0.75 * (cover - 0.55)) * 3.2, 0, 1)
    density = thick * thick * (3 - 2 * thick)
    density *= np.clip((up[high] - 0.02) / 0.10, 0, 1)
    # The belly of a thick cloud is grey, its rims towards the sun are bright.
    shade = np.clip(thick * 0.75 - 0.12 * billow, 0, 1)[:, None]
    lit = CLOUD_RGB * (0.82 + 0.25 * np.clip(cosine[high], 0, 1)[:, None] ** 2)
    cloud = lit * (1 - shade) + CLOUD_SHADE_RGB * 1.35 * shade
    far = np.exp(-up[high] / 0.10)[:, None]
    cloud = cloud * (1 - 0.7 * far) + HORIZON_RGB * 0.7 * far
    out = sky.copy()
    out[high] = sky[high] + density[:, None] * 0.92 * (cloud - sky[high])
    return out


def _with_skyline(sky: np.ndarray, directions: np.ndarray, seed: int) -> np.ndarray:
    """Two hazy ridges of hills and woods just above the horizon."""
    near_horizon = np.flatnonzero(directions[:, 2] < 0.12)
    d = directions[near_horizon]
    azimuth = np.arctan2(d[:, 1], d[:, 0])
    # On a circle, so that the ridge closes at azimuth +-pi.
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    elevation = d[:, 2]
    out = sky.copy()
    ridges = (
        (3.0, 0.030, 0.028, np.array([0.50, 0.60, 0.72])),
        (9.0, 0.012, 0.014, HAZE_RGB * 0.62),
    )
    for scale, base, spread, rgb in ridges:
        crest = base + spread * fractal_noise(circle * scale, 4, seed * 7 + 300 + int(scale))
        inside = np.clip((crest - elevation) / 0.004 + 0.5, 0, 1)[:, None]
        out[near_horizon] += inside * (rgb - out[near_horizon])
    return out
