"""A sky cube map from the pixels of recorded images that no surface covers.

Everything uncovered is taken as infinitely far: clouds and distant towers truly are; a wall above
the LiDAR's field of view is not, and appears in the right direction but drifts against the scene
as the camera moves. Where some image is sure to show sky in a direction, the others hardly count.
Directions that no image shows are filled smoothly from the sky around them.
"""

from __future__ import annotations

import math

import cv2
import numba
import numpy as np
import torch

from augment.cameras import Camera
from augment.sky import CubemapSky, directions_of_cubemap

_FEATHER = 0.12  # images fade over this part of their width, so that exposures meet softly
_UNSURE = 0.02  # weight of pixels that may be a wall above the LiDAR's view
_TOP_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
_FILL_ROWS = 64  # of the lat-long image that unseen directions are filled from
_DEFAULT_SKY = (0.7, 0.75, 0.8)  # where no image shows any sky


class SkyGatherer:
    """Sums of the colours seen in every direction; `finish` divides and fills."""

    def __init__(self, size: int, lidar_top_rad: float) -> None:
        """size: texels along an edge. lidar_top_rad: highest elevation that the LiDAR looks at."""
        self._size = size
        self._sure_below = math.sin(lidar_top_rad - _TOP_MARGIN_RAD)
        self._directions = directions_of_cubemap(size).reshape(-1, 3).numpy()
        self._sums = np.zeros((len(self._directions), 3), np.float32)
        self._weights = np.zeros(len(self._directions), np.float32)
        self._sure = np.zeros(len(self._directions), np.bool_)

    def add(
        self, camera: Camera, free: np.ndarray, levels: np.ndarray, level_sizes: np.ndarray
    ) -> None:
        """Add one image. free: bool [h, w] at the camera's size, True where nothing was drawn.
        levels: uint8 [L, H, W, 3], the image halved again and again; level_sizes: int [L, 2]."""
        # The level whose pixels are about as wide as a texel.
        texel = 2.0 / self._size * camera.fx * level_sizes[0, 1] / camera.width
        level = int(np.clip(round(np.log2(max(texel, 1.0))), 0, len(levels) - 1))
        rows, columns = level_sizes[level]
        _gather(
            self._directions,
            camera.camera_from_world[:3, :3].numpy().astype(np.float32),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
            free,
            self._sure_columns(camera, free),
            levels[level, :rows, :columns],
            np.float32(_FEATHER),
            np.float32(_UNSURE),
            self._sums,
            self._weights,
            self._sure,
        )

    def _sure_columns(self, camera: Camera, free: np.ndarray) -> np.ndarray:
        """Columns of the image whose free top is sky: what is drawn in them ends below the LiDAR's
        highest channel, which therefore looked over it and met nothing."""
        rays = camera.ray_directions().numpy()
        rise = rays[..., 2] / np.linalg.norm(rays, axis=2)
        drawn = ~free
        top = np.where(drawn.any(axis=0), drawn.argmax(axis=0), len(free) - 1)
        return rise[top, np.arange(free.shape[1])] < self._sure_below

    def finish(self) -> CubemapSky:
        """The mean colour of every direction, unseen ones filled."""
        seen = self._weights > 0
        rgb = self._sums / np.maximum(self._weights, 1e-9)[:, None] / np.float32(255)
        if not seen.any():
            rgb[:] = _DEFAULT_SKY
        elif not seen.all():
            source = self._sure if self._sure.any() else seen
            rgb[~seen] = _fill(self._directions, rgb, source)[~seen]
        faces = rgb.reshape(6, self._size, self._size, 3)
        return CubemapSky(torch.from_numpy(np.ascontiguousarray(faces, np.float32)))


def _fill(directions: np.ndarray, rgb: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Colours [N, 3] for all directions, smooth where unseen: normalised averages over ever wider
    areas of a lat-long image, the narrowest that holds anything counting most."""
    rows, columns = _FILL_ROWS, 2 * _FILL_ROWS
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    x = np.clip((azimuth / (2 * np.pi) + 0.5) * columns, 0, columns - 1e-3).astype(np.int64)
    y = np.clip((0.5 - elevation / np.pi) * rows, 0, rows - 1e-3).astype(np.int64)
    cell = (y * columns + x)[seen]
    total = np.bincount(cell, minlength=rows * columns).astype(np.float64)
    image = np.stack(
        [np.bincount(cell, rgb[seen, c].astype(np.float64), rows * columns) for c in range(3)], 1
    )
    # Rows shrink towards the poles: weigh by solid angle so that a pole does not outvote.
    solid = np.cos((np.arange(rows) + 0.5) / rows * np.pi - np.pi / 2).repeat(columns)
    present = (total > 0) * solid
    image = image / np.maximum(total, 1)[:, None] * present[:, None]
    filled = _widen(image.reshape(rows, columns, 3), present.reshape(rows, columns))
    return filled.reshape(-1, 3)[y * columns + x].astype(np.float32)


def _widen(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    rows, columns = weights.shape
    out = np.zeros_like(sums)
    missing = np.ones_like(weights)
    sigma = 1.0
    while sigma <= rows / 2:
        wide = np.dstack([sums, weights]).astype(np.float32)
        margin = min(columns, int(4 * sigma))
        wide = np.concatenate([wide[:, -margin:], wide, wide[:, :margin]], axis=1)
        wide = cv2.GaussianBlur(wide, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
        wide = wide[:, margin : margin + columns]
        trust = np.clip(wide[..., 3] / 0.2, 0, 1) * missing
        out += trust[..., None] * wide[..., :3] / np.maximum(wide[..., 3:], 1e-9)
        missing -= trust
        sigma *= 2.0
    mean = sums.sum((0, 1)) / weights.sum()
    return out + missing[..., None] * mean


@numba.njit(cache=True, nogil=True)
def _gather(
    directions, rotation, intrinsics, free, sure, image, feather, unsure, sums, weights, sure_out
):  # pragma: no cover - compiled
    height, width = free.shape
    rows, columns = image.shape[0], image.shape[1]
    fx, fy, cx, cy = intrinsics
    for i in range(len(directions)):
        d = directions[i]
        z = rotation[2, 0] * d[0] + rotation[2, 1] * d[1] + rotation[2, 2] * d[2]
        if z < 0.1:
            continue
        u = fx * (rotation[0, 0] * d[0] + rotation[0, 1] * d[1] + rotation[0, 2] * d[2]) / z + cx
        if u < 0 or u >= width:
            continue
        v = fy * (rotation[1, 0] * d[0] + rotation[1, 1] * d[1] + rotation[1, 2] * d[2]) / z + cy
        if v < 0 or v >= height or not free[int(v), int(u)]:
            continue
        border = min(min(u, width - u) / width, min(v, height - v) / height)
        weight = min(border / feather, np.float32(1)) + np.float32(1e-3)
        if sure[int(u)]:
            sure_out[i] = True
        else:
            weight *= unsure
        y = min(max(v / height * rows - np.float32(0.5), np.float32(0)), np.float32(rows - 1))
        x = min(max(u / width * columns - np.float32(0.5), np.float32(0)), np.float32(columns - 1))
        y0, x0 = int(y), int(x)
        y1, x1 = min(y0 + 1, rows - 1), min(x0 + 1, columns - 1)
        wy, wx = y - y0, x - x0
        for c in range(3):
            top = image[y0, x0, c] * (1 - wx) + image[y0, x1, c] * wx
            bottom = image[y1, x0, c] * (1 - wx) + image[y1, x1, c] * wx
            sums[i, c] += weight * (top * (1 - wy) + bottom * wy)
        weights[i] += weight
