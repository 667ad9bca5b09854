"""Water of wet ground as lamps are mirrored in it: film on asphalt, puddles, rings of drops.

The numbers are those of `reflection.shade_wet`. They change slowly over the ground, so they are
looked up in some of the pixels; the share of ground in a pixel is exact.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.effects.wet.film_kernels import (
    ASPHALT_ROUGHNESS,
    FILM_SHARE,
    PUDDLE_RIM,
    PUDDLE_ROUGHNESS,
    TRACK_SMOOTHING,
)
from augment.effects.wet.ground_map import WetGround
from augment.effects.wet.reflection import Film, Plane
from augment.lamps.road_unevenness import RESOLVED_SHARE
from augment.lamps.wet_surface import MIN_ROUGHNESS, WetRoad
from augment.scene.cameras import Camera

# Pixels between those in which the map is looked up.
STEP_PX = 4
# Roughness of a film that drops of rain stir, at most.
STIRRED_ROUGHNESS = 0.15
# Rate of rain that stirs the film as far as it goes, mm/h.
_STIRRING_RATE_MM_H = 20.0


def mirroring_film(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    share: Float[Tensor, "H W"],
    ground: WetGround,
    film: Film,
    plane: Plane,
    rate_mm_h: float,
) -> WetRoad:
    """Return the water on the ground of a picture.

    Args:
        camera: camera of the picture.
        depth: z of what a pixel shows, metres.
        share: result of `reflection.find_ground`.
        ground: map of the ground.
        film: water on the ground.
        plane: plane of the ground in view.
        rate_mm_h: rate of the rain, whose drops stir the film.
    """
    ground_share = np.ascontiguousarray(share.detach().cpu().numpy(), np.float32)
    depth_m = np.ascontiguousarray(depth.detach().cpu().numpy(), np.float32)
    # Pixels in the middle of each STEP_PX x STEP_PX.
    first = STEP_PX // 2
    height = -(-max(camera.height - first, 1) // STEP_PX)
    width = -(-max(camera.width - first, 1) // STEP_PX)
    few = np.zeros((height, width, 3), np.float32)
    rows = _rows_of_ground(ground_share, height)
    few[rows] = _film_at(camera, depth_m, ground, film, rate_mm_h, rows, width)
    return WetRoad(ground_share, depth_m, few, plane.up)


def _rows_of_ground(share: Float32[np.ndarray, "H W"], height: int) -> slice:
    """Return the rows of a film's pixels between which ground lies.

    Args:
        share: share of each pixel that shows open ground.
        height: number of the film's rows.
    """
    rows = np.flatnonzero(share.any(1))
    if not len(rows):
        return slice(0, 0)
    return slice(max(int(rows[0]) // STEP_PX - 1, 0), min(int(rows[-1]) // STEP_PX + 2, height))


def _film_at(
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    ground: WetGround,
    film: Film,
    rate_mm_h: float,
    rows: slice,
    width: int,
) -> Float32[np.ndarray, "h w 3"]:
    """Return the numbers of `WetRoad.film` in some of its rows.

    Args:
        camera: camera of the picture.
        depth_m: z of what a pixel shows.
        ground: map of the ground.
        film: water on the ground.
        rate_mm_h: rate of the rain.
        rows: the film's rows.
        width: number of the film's columns.
    """
    i = np.minimum(STEP_PX // 2 + STEP_PX * np.arange(rows.start, rows.stop), camera.height - 1)
    j = np.minimum(STEP_PX // 2 + STEP_PX * np.arange(width), camera.width - 1)
    z = depth_m[i[:, None], j].astype(np.float64)
    z[~np.isfinite(z)] = 0
    u = (j + 0.5 - camera.cx) / camera.fx
    v = ((i + 0.5 - camera.cy) / camera.fy)[:, None]
    axes = camera.world_from_camera[:3, :3].numpy()
    x_m, y_m = (
        torch.from_numpy(z * (axes[k, 0] * u + (axes[k, 1] * v + axes[k, 2]))) + camera.centre[k]
        for k in range(2)
    )
    puddle_order, track = ground.puddles_and_tracks(x_m, y_m).unbind(-1)
    puddle_order = puddle_order.numpy()
    track = track.numpy()
    t = (puddle_order - film.puddle_threshold + PUDDLE_RIM) / (2 * PUDDLE_RIM)
    t = np.clip(t, 0, 1)
    puddle = film.wetness * t * t * (3 - 2 * t)
    stirred_share = min(rate_mm_h / _STIRRING_RATE_MM_H, 1.0)
    # Beckmann's m is sqrt 2 times the standard deviation of slopes along an axis.
    smooth = math.sqrt(2) * ASPHALT_ROUGHNESS
    asphalt = smooth + stirred_share * (max(STIRRED_ROUGHNESS, smooth) - smooth)
    asphalt = asphalt * (1 - TRACK_SMOOTHING * track)
    square = 2 * PUDDLE_ROUGHNESS**2 + film.rings.variance
    puddle_roughness = max(MIN_ROUGHNESS, math.sqrt(square))
    roughness = asphalt + puddle * (puddle_roughness - asphalt)
    film_share = np.clip(FILM_SHARE + 0.1 * track, 0, 1)
    covered = film.wetness * (film_share + (1 - film_share) * puddle)
    return np.stack([roughness, covered, RESOLVED_SHARE * (1 - puddle)], 2).astype(np.float32)
