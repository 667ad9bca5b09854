"""Compiled loops over surfels and pixels: which surface a camera sees, and in what colour; and the
sky, a cube map from the pixels that no surface covers.

Everything uncovered is taken as infinitely far: clouds and distant towers truly are; a wall above
the LiDAR's field of view is not, and appears in the right direction but drifts against the scene
as the camera moves. Where some image is sure to show sky in a direction, the others hardly count.
Directions that no image shows are filled smoothly from the sky around them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor

import cv2
import numpy as np
import torch

from augment.cameras import Camera
from augment.jobs.processes import available_cores
from augment.render.cpu.jit import cached_njit
from augment.sky import CubemapSky, directions_of_cubemap

_FEATHER = 0.12  # images fade over this part of their width, so that exposures meet softly
_UNSURE = 0.02  # weight of pixels that may be a wall above the LiDAR's view
_TOP_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
_FILL_ROWS = 64  # of the lat-long image that unseen directions are filled from
_DEFAULT_SKY = (0.7, 0.75, 0.8)  # where no image shows any sky
_PART = 1 << 17  # rows; small ones cost a z-buffer each
KEPT = 12  # observations remembered of each surfel
_NEAR_M = 0.3
_SCORE_FEATHER = 0.1  # scores fall to zero over this part of the image towards its border


def parts_of(count: int) -> list[slice]:
    """Rows in parts of _PART, for threads to take."""
    return [slice(start, start + _PART) for start in range(0, count, _PART)]


def in_parts(function: Callable[[slice], object], count: int) -> None:
    """Call it with all parts of so many rows, on all cores; what it calls leaves the interpreter
    to others."""
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(function, parts_of(count)))


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
        self,
        camera: Camera,
        free: np.ndarray,
        levels: np.ndarray,
        level_sizes: np.ndarray,
        pool: Executor,
    ) -> None:
        """Add one image. free: bool [h, w] at the camera's size, True where nothing was drawn.
        levels: uint8 [L, H, W, 3], the image halved again and again; level_sizes: int [L, 2]."""
        # The level whose pixels are about as wide as a texel.
        texel = 2.0 / self._size * camera.fx * level_sizes[0, 1] / camera.width
        level = int(np.clip(round(np.log2(max(texel, 1.0))), 0, len(levels) - 1))
        rows, columns = level_sizes[level]
        rotation = camera.camera_from_world[:3, :3].numpy().astype(np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        sure, image = self._sure_columns(camera, free), levels[level, :rows, :columns]

        def gather(own: slice) -> None:
            _gather(
                self._directions[own], rotation, lens, free, sure, image,
                np.float32(_FEATHER), np.float32(_UNSURE),
                self._sums[own], self._weights[own], self._sure[own],
            )  # fmt: skip

        list(pool.map(gather, parts_of(len(self._directions))))

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


@cached_njit(nogil=True)
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


@cached_njit(nogil=True)
def draw_depth(
    centres, normals, major, extent, rotation, translation, fx, fy, cx, cy, depth
):  # pragma: no cover - compiled
    """Draw elliptic discs into a z-buffer. extent [N, 2]: half axes, metres. depth [h, w] float32,
    infinite where nothing is; keeps the nearest."""
    height, width = depth.shape
    p, n, e1, e2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(centres)):
        z = translation[2]
        for b in range(3):
            z += rotation[2, b] * centres[i, b]
        if z < _NEAR_M:
            continue
        for a in range(2):
            p[a] = translation[a]
            for b in range(3):
                p[a] += rotation[a, b] * centres[i, b]
        p[2] = z
        radius = max(extent[i, 0], extent[i, 1]) / z
        u, v = fx * p[0] / z + cx, fy * p[1] / z + cy
        ru, rv = fx * radius, fy * radius
        if u + ru < 0 or u - ru > width or v + rv < 0 or v - rv > height:
            continue
        iu, iv = int(np.floor(u)), int(np.floor(v))
        if 0 <= iu < width and 0 <= iv < height and z < depth[iv, iu]:
            depth[iv, iu] = z
        if max(ru, rv) < 0.5:
            continue
        for a in range(3):
            n[a], e1[a] = 0.0, 0.0
            for b in range(3):
                n[a] += rotation[a, b] * normals[i, b]
                e1[a] += rotation[a, b] * major[i, b]
        e2[0] = n[1] * e1[2] - n[2] * e1[1]
        e2[1] = n[2] * e1[0] - n[0] * e1[2]
        e2[2] = n[0] * e1[1] - n[1] * e1[0]
        offset = n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
        span = radius * z
        for y in range(max(0, int(v - rv)), min(height, int(v + rv) + 1)):
            dy = (y + 0.5 - cy) / fy
            for x in range(max(0, int(u - ru)), min(width, int(u + ru) + 1)):
                dx = (x + 0.5 - cx) / fx
                slope = n[0] * dx + n[1] * dy + n[2]
                if abs(slope) < 1e-3:
                    continue
                zt = offset / slope
                if abs(zt - z) > span or zt >= depth[y, x]:
                    continue
                qx, qy, qz = dx * zt - p[0], dy * zt - p[1], zt - z
                a = (qx * e1[0] + qy * e1[1] + qz * e1[2]) / extent[i, 0]
                b = (qx * e2[0] + qy * e2[1] + qz * e2[2]) / extent[i, 1]
                if a * a + b * b <= 1.0:
                    depth[y, x] = zt


@cached_njit(nogil=True)
def observe(
    centres, normals, extent, rotation, translation, fx, fy, cx, cy,
    depth, cover, levels, level_sizes, used_rows, camera, scores, colours, cameras,
):  # fmt: skip  # pragma: no cover - compiled
    """Remember the colour of every surfel that one image shows, if among the KEPT best of its own.

    depth [h, w]: z-buffer of all surfaces. cover [h, w]: z of moving boxes, in front of which lies
    nothing of them; surfels behind are hidden. levels [L, H, W, 3] uint8: the image halved again
    and again, level_sizes [L, 2] their rows and columns. fx.. are of the z-buffer. Updated are
    scores [N, KEPT], colours [N, KEPT, 3] and cameras [N, KEPT]."""
    height, width = depth.shape
    p, n = np.empty(3), np.empty(3)
    for i in range(len(centres)):
        for a in range(3):
            p[a] = translation[a]
            for b in range(3):
                p[a] += rotation[a, b] * centres[i, b]
        z = p[2]
        if z < _NEAR_M:
            continue
        u, v = fx * p[0] / z + cx, fy * p[1] / z + cy
        if not (1 <= u < width - 1 and 1 <= v < min(height - 1, used_rows * height)):
            continue
        x, y = int(u), int(v)
        if cover[y, x] < z:
            continue
        for a in range(3):
            n[a] = 0.0
            for b in range(3):
                n[a] += rotation[a, b] * normals[i, b]
        reach = np.sqrt(p[0] * p[0] + p[1] * p[1] + z * z)
        facing = abs(n[0] * p[0] + n[1] * p[1] + n[2] * z) / reach
        # A surface seen at a slant spans much depth within one z-buffer pixel.
        slant = min(z / fx / max(facing, 0.02), 1.5)
        tolerance = 0.08 + 0.01 * z + slant
        if z > depth[y, x] + tolerance:
            continue
        score = max(facing, 0.03) * fx / z
        border = min(min(u, width - u) / width, min(v, height - v) / height)
        score *= min(border / _SCORE_FEATHER, 1.0)
        # Beside a nearer edge the image may show that edge: calibration is good to a pixel or two.
        for yy in range(y - 1, y + 2):
            for xx in range(x - 1, x + 2):
                if z > depth[yy, xx] + 2 * tolerance or cover[yy, xx] < z:
                    score *= 0.6
        worst = 0
        for j in range(1, scores.shape[1]):
            if scores[i, j] < scores[i, worst]:
                worst = j
        if score <= scores[i, worst]:
            continue
        footprint = np.sqrt(extent[i, 0] * extent[i, 1] * max(facing, 0.1)) * fx / z
        footprint *= level_sizes[0, 1] / width  # in pixels of the sharpest level
        level = min(max(int(np.log2(max(footprint, 1.0))), 0), len(levels) - 1)
        _sample(levels[level], level_sizes[level], u / width, v / height, colours[i, worst])
        scores[i, worst] = score
        cameras[i, worst] = camera


@cached_njit(nogil=True)
def _sample(image, size, u, v, out):  # pragma: no cover - compiled
    """Bilinear colour at relative coordinates, clamped at the border."""
    y = min(max(v * size[0] - 0.5, 0.0), size[0] - 1.0)
    x = min(max(u * size[1] - 0.5, 0.0), size[1] - 1.0)
    y0, x0 = int(y), int(x)
    y1, x1 = min(y0 + 1, size[0] - 1), min(x0 + 1, size[1] - 1)
    fy, fx = y - y0, x - x0
    for c in range(3):
        top = image[y0, x0, c] * (1 - fx) + image[y0, x1, c] * fx
        bottom = image[y1, x0, c] * (1 - fx) + image[y1, x1, c] * fx
        out[c] = np.uint8(top * (1 - fy) + bottom * fy + 0.5)


@cached_njit()
def blended_colours(scores, colours, cameras, keep, power):  # pragma: no cover - compiled
    """Per surfel and camera the median, channel by channel, of observations whose score is at least
    `keep` of that camera's best; cameras are averaged with weights (best score)^power.

    Returns float32 [N, 3] in [0, 1] and seen, bool [N]."""
    count, slots = scores.shape
    out = np.zeros((count, 3), np.float32)
    seen = np.zeros(count, np.bool_)
    values = np.empty(slots, np.uint8)
    for i in range(count):
        total = 0.0
        for first in range(slots):
            best = scores[i, first]
            if best <= 0:
                continue
            leads = True
            for j in range(slots):
                if cameras[i, j] == cameras[i, first] and (
                    scores[i, j] > best or (scores[i, j] == best and j < first)
                ):
                    leads = False
            if not leads:
                continue
            weight = best**power
            total += weight
            for c in range(3):
                n = 0
                for j in range(slots):
                    if cameras[i, j] == cameras[i, first] and scores[i, j] >= keep * best:
                        values[n] = colours[i, j, c]
                        n += 1
                ordered = np.sort(values[:n])
                middle = (np.float32(ordered[(n - 1) // 2]) + np.float32(ordered[n // 2])) / 2
                out[i, c] += weight * middle / np.float32(255)
        if total > 0:
            seen[i] = True
            for c in range(3):
                out[i, c] /= total
    return out, seen
