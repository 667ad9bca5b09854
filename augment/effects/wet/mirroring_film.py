"""Water of wet ground as lamps are mirrored in it: film on asphalt, puddles, rings of drops.

The numbers are those of `reflection.shade_wet`. They change slowly over the ground, so they are
looked up in some of the pixels; the share of ground in a pixel is exact.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.wet.film_kernels import (
    ASPHALT_ROUGHNESS,
    FILM_SHARE,
    PUDDLE_ORDER,
    PUDDLE_RIM,
    PUDDLE_ROUGHNESS,
    TRACK_SMOOTHING,
    WHEEL_TRACK,
)
from augment.effects.wet.ground_map import WetGround
from augment.effects.wet.reflection import Film, Plane
from augment.lamps.road_unevenness import RESOLVED_SHARE, make_uneven
from augment.lamps.wet_surface import MIN_ROUGHNESS, WetSurface
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
) -> WetSurface:
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
    ground_share = share.detach().cpu().numpy()
    depth_m = depth.detach().float().cpu().numpy()
    first = STEP_PX // 2
    few_depths = torch.from_numpy(np.ascontiguousarray(depth_m[first::STEP_PX, first::STEP_PX]))
    rays = camera.ray_directions(torch.float64)[first::STEP_PX, first::STEP_PX]
    is_finite = few_depths.isfinite()
    points = rays * torch.where(is_finite, few_depths, 0.0).double()[..., None]
    points = points + camera.centre
    channels = ground.interpolate(points[..., 0], points[..., 1]).numpy()
    t = (channels[..., PUDDLE_ORDER] - film.puddle_threshold + PUDDLE_RIM) / (2 * PUDDLE_RIM)
    t = np.clip(t, 0, 1)
    puddle = film.wetness * t * t * (3 - 2 * t)
    stirred_share = min(rate_mm_h / _STIRRING_RATE_MM_H, 1.0)
    track = channels[..., WHEEL_TRACK]
    # Beckmann's m is sqrt 2 times the standard deviation of slopes along an axis.
    smooth = math.sqrt(2) * ASPHALT_ROUGHNESS
    asphalt = smooth + stirred_share * (max(STIRRED_ROUGHNESS, smooth) - smooth)
    asphalt = asphalt * (1 - TRACK_SMOOTHING * track)
    square = 2 * PUDDLE_ROUGHNESS**2 + film.rings.variance
    puddle_roughness = max(MIN_ROUGHNESS, math.sqrt(square))
    roughness = asphalt + puddle * (puddle_roughness - asphalt)
    film_share = np.clip(FILM_SHARE + 0.1 * track, 0, 1)
    covered = film.wetness * (film_share + (1 - film_share) * puddle)
    few = np.stack([roughness, covered, RESOLVED_SHARE * (1 - puddle)], 2).astype(np.float32)
    images = cv2.resize(few, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    water = WetSurface(
        np.ascontiguousarray(ground_share * images[..., 1], np.float32),
        np.ascontiguousarray(images[..., 0]),
        np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32),
        plane.up,
    )
    return make_uneven(water, camera, np.ascontiguousarray(images[..., 2]))
