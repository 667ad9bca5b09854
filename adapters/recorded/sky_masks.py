"""Pixels that surely show sky, from what the LiDAR saw and what the image looks like.

A column of the image is known where the surfaces drawn in it end below the LiDAR's highest view:
the LiDAR looked over them and met nothing. Where they reach that view, a wall may go on above.
The image then has to agree: sky is smooth and as bright as the rest of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from adapters.lidar.depth import read_returns
from augment.cameras import Camera
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene import Scene

_TOP_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
_FAR_M = 10.0  # from here on LiDAR and cameras see a return at nearly the same elevation
_TOP_QUANTILE = 0.999  # a few returns are stray
_ENOUGH_RETURNS = 5000
_DRAWN_ALPHA = 0.05
_DRAWN_PIXELS = 3  # fewer covered pixels one above another are no surface's edge
_BORDER_PART = 0.008  # of the image's width, that surfaces are grown by: splats end a little early
_SMOOTH_LEVELS = 6.0  # of 255: standard deviation within a small window
_WINDOW_PART = 0.01  # of the image's width
_DARK_LEVELS = 70.0  # of 255: this much darker than the image's bright sky is none
_LEAST_LUMA = 90.0


def lidar_top_rad(scene: Scene, frames: Sequence[int]) -> float | None:
    """Highest elevation that the LiDAR looks at, as cameras see it; None without enough returns.

    Measured from the returns of the given frames: it is too low where nothing tall stood near.
    """
    tops = []
    for index in frames:
        frame = scene.frame(index)
        returns = read_returns(scene, index)
        if returns is None or not frame.cameras:
            continue
        centre = np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)
        offset = returns.points - centre
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        far = distance_m > _FAR_M
        if far.sum() >= _ENOUGH_RETURNS:
            rise = np.arctan2(offset[far, 2], distance_m[far])
            tops.append(float(np.quantile(rise, _TOP_QUANTILE)))
    return float(np.median(tops)) if tops else None


def sky_mask(
    scene: Scene,
    camera: Camera,
    rgb: np.ndarray,
    returns: np.ndarray,
    lidar_top_rad: float | None,
) -> np.ndarray:
    """Pixels of the view that surely show sky, bool [H, W]; none where nothing can be known.

    scene: as initialised from LiDAR. rgb: uint8 [H, W, 3], the recorded image. returns:
    int [M], flat indices of pixels with a LiDAR return. lidar_top_rad: see the function of that
    name.
    """
    none = np.zeros((camera.height, camera.width), np.bool_)
    if lidar_top_rad is None:
        return none
    alpha = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA,)).alpha
    assert alpha is not None
    drawn = alpha.numpy() > _DRAWN_ALPHA
    drawn.reshape(-1)[returns] = True  # thin things that are not in the scene: wires, twigs
    free = _above_surfaces(camera, drawn, lidar_top_rad)
    return free & looks_like_sky(rgb, free)


def _above_surfaces(camera: Camera, drawn: np.ndarray, lidar_top_rad: float) -> np.ndarray:
    """What lies above the top-most surface of its column, where that is sure to be its end."""
    border = max(2, round(_BORDER_PART * camera.width))
    solid = cv2.morphologyEx(
        drawn.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_DRAWN_PIXELS, 1), np.uint8)
    )
    rays = camera.ray_directions().numpy()
    rise = rays[..., 2] / np.linalg.norm(rays, axis=2)
    last = len(drawn) - 1
    top = np.where(solid.any(axis=0), solid.argmax(axis=0), last)
    known = rise[top, np.arange(camera.width)] < math.sin(lidar_top_rad - _TOP_MARGIN_RAD)
    # A column beside one whose surface goes on may show the same surface, leaning.
    known = cv2.erode(known.astype(np.uint8)[None], np.ones((1, 2 * border + 1), np.uint8))[0] > 0
    grown = cv2.dilate(drawn.astype(np.uint8), np.ones((2 * border + 1,) * 2, np.uint8))
    covered = np.maximum.accumulate(grown, axis=0) > 0
    return known[None] & ~covered


def looks_like_sky(rgb: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Pixels that are smooth and about as bright as the bright part of the candidates, bool [H, W].

    Clouds pass; walls, foliage and wires do not, unless they are as bright and as smooth.
    """
    if not candidates.any():
        return np.zeros_like(candidates)
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    side = 2 * max(1, round(_WINDOW_PART * rgb.shape[1] / 2)) + 1
    mean = cv2.blur(luma, (side, side))
    variance = cv2.blur(luma * luma, (side, side)) - mean * mean
    smooth = variance < _SMOOTH_LEVELS**2
    bright = float(np.quantile(luma[candidates], 0.9))
    return smooth & (mean > max(bright - _DARK_LEVELS, _LEAST_LUMA))
