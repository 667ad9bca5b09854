"""Compiled loops over surfels and pixels, and the sky that is gathered from images.

`draw_depth` draws surfels into a z-buffer, `observe` stores the colours in which images show them,
`blended_colours` combines the stored colours of each surfel. `SkyGatherer` makes a cube map from
the pixels that show sky. The caller is `adapters.lidar_scene.image_views`.

`augment.photo.sky_regions` says which pixels of an image show sky. Other pixels that no surfel
covers, as those of walls above the LiDAR's field of view, hardly count where another image shows
sky in the same direction. Directions that no image shows are filled smoothly from the sky.

Symbols: u, v are pixel coordinates; x, y, z are metres in the camera's frame; fx, fy, cx, cy are
the pinhole intrinsics in pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor

import cv2
import numpy as np
import torch

from augment.jobs.processes import available_cores
from augment.photo.sky_matte import find_regions
from augment.photo.sky_regions import SOFT_EDGE
from augment.render.cpu.jit import cached_njit
from augment.scene.cameras import Camera
from augment.scene.sky import CubemapSky, directions_of_cubemap

# Images fade out over this fraction of their width, so that different exposures blend softly.
_FEATHER_WIDTH = 0.12
# Weight of uncovered pixels that show no sky.
_UNCERTAIN_WEIGHT = 0.02
# Margin below the LiDAR's highest channel: the camera and the LiDAR stand at different places.
_TOP_MARGIN_RAD = math.radians(4.0)
# Rows of the lat-long image from which directions without observations are filled.
_FILL_ROWS = 64
# Sky colour, RGB in [0, 1], of a drive whose images show no sky.
_DEFAULT_SKY = (0.7, 0.75, 0.8)
# Rows that a thread takes at once. Each slice of surfels costs a z-buffer.
_ROWS_PER_SLICE = 1 << 17
# Observations that are stored per surfel.
NUM_OBSERVATIONS = 12
# Surfels nearer to the camera than this z are ignored.
_MIN_DEPTH_M = 0.3
# Scores fall to zero over this fraction of the image towards its border.
_SCORE_FEATHER_WIDTH = 0.1


def row_slices(count: int) -> list[slice]:
    """Return `count` rows as slices of _ROWS_PER_SLICE, one per task of a thread."""
    return [slice(start, start + _ROWS_PER_SLICE) for start in range(0, count, _ROWS_PER_SLICE)]


def for_row_slices(function: Callable[[slice], object], count: int) -> None:
    """Call a function with every slice of `count` rows, on all cores.

    The function must release the interpreter, else the threads wait for each other.
    """
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(function, row_slices(count)))


class SkyGatherer:
    """Collects the colours of the sky from images: sums per texel of a cube map.

    `add` takes one image. `finish` divides the sums by their weights and fills directions that no
    image shows.
    """

    def __init__(self, size: int, lidar_top_rad: float) -> None:
        """Start with empty sums.

        Args:
            size: texels along an edge of the cube map.
            lidar_top_rad: highest elevation that the LiDAR measures.
        """
        self._size = size
        self._lidar_top_rad = lidar_top_rad
        self._directions = directions_of_cubemap(size).reshape(-1, 3).numpy()
        self._sums = np.zeros((len(self._directions), 3), np.float32)
        self._weights = np.zeros(len(self._directions), np.float32)
        self._has_certain_sky = np.zeros(len(self._directions), np.bool_)

    def add(
        self,
        camera: Camera,
        is_free: np.ndarray,
        levels: np.ndarray,
        level_sizes: np.ndarray,
        pool: Executor,
    ) -> None:
        """Add the sky colours of one image.

        Args:
            camera: the image's camera.
            is_free: bool [h, w] at the camera's size, True where no surface was drawn.
            levels: uint8 [L, H, W, 3], the image halved again and again.
            level_sizes: int [L, 2], rows and columns of the levels.
            pool: threads that run the loops.
        """
        # The level whose pixels are about as wide as a texel.
        texel = 2.0 / self._size * camera.fx * level_sizes[0, 1] / camera.width
        level = int(np.clip(round(np.log2(max(texel, 1.0))), 0, len(levels) - 1))
        num_rows, num_columns = level_sizes[level]
        rotation = camera.camera_from_world[:3, :3].numpy().astype(np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        sharpest = levels[0, : level_sizes[0, 0], : level_sizes[0, 1]]
        is_sky = self._find_sky(camera, is_free, sharpest)
        is_free = is_free | is_sky
        image = levels[level, :num_rows, :num_columns]

        def gather_rows(rows: slice) -> None:
            _gather(
                self._directions[rows],
                rotation,
                lens,
                is_free,
                is_sky,
                image,
                np.float32(_FEATHER_WIDTH),
                np.float32(_UNCERTAIN_WEIGHT),
                self._sums[rows],
                self._weights[rows],
                self._has_certain_sky[rows],
            )

        list(pool.map(gather_rows, row_slices(len(self._directions))))

    def _find_sky(self, camera: Camera, is_free: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Return the pixels that show sky, bool [h, w] at the camera's size.

        In an image that is too dark to tell, they are the free tops of the columns whose surfaces
        end below the LiDAR's highest channel: it looked over them and met nothing.
        """
        kinds = find_regions(image, camera, ~is_free, self._lidar_top_rad)
        if kinds is not None:
            return kinds >= SOFT_EDGE
        rays = camera.ray_directions().numpy()
        rise = rays[..., 2] / np.linalg.norm(rays, axis=2)
        is_covered = ~is_free
        top = np.where(is_covered.any(axis=0), is_covered.argmax(axis=0), len(is_free) - 1)
        max_top_rise = math.sin(self._lidar_top_rad - _TOP_MARGIN_RAD)
        return is_free & (rise[top, np.arange(is_free.shape[1])] < max_top_rise)

    def finish(self) -> CubemapSky:
        """Return the mean colour of every direction; directions that no image shows are filled."""
        has_color = self._weights > 0
        rgb = self._sums / np.maximum(self._weights, 1e-9)[:, None] / np.float32(255)
        if not has_color.any():
            rgb[:] = _DEFAULT_SKY
        elif not has_color.all():
            is_source = self._has_certain_sky if self._has_certain_sky.any() else has_color
            rgb[~has_color] = _fill(self._directions, rgb, is_source)[~has_color]
        faces = rgb.reshape(6, self._size, self._size, 3)
        return CubemapSky(torch.from_numpy(np.ascontiguousarray(faces, np.float32)))


def _fill(directions: np.ndarray, rgb: np.ndarray, is_source: np.ndarray) -> np.ndarray:
    """Return colours for all directions, smooth where none was observed.

    The result is a normalised average over ever wider areas of a lat-long image. The narrowest area
    that holds an observed direction counts most.

    Args:
        directions: float [N, 3], unit vectors.
        rgb: float [N, 3], colours of the directions.
        is_source: bool [N], directions whose colour is used.

    Returns:
        float32 [N, 3].
    """
    rows = _FILL_ROWS
    columns = 2 * _FILL_ROWS
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    x = np.clip((azimuth / (2 * np.pi) + 0.5) * columns, 0, columns - 1e-3).astype(np.int64)
    y = np.clip((0.5 - elevation / np.pi) * rows, 0, rows - 1e-3).astype(np.int64)
    cell = (y * columns + x)[is_source]
    num_directions = np.bincount(cell, minlength=rows * columns).astype(np.float64)
    image = np.stack(
        [np.bincount(cell, rgb[is_source, c].astype(np.float64), rows * columns) for c in range(3)],
        1,
    )
    # Rows shrink towards the poles: weigh by solid angle so that a pole does not outvote.
    solid = np.cos((np.arange(rows) + 0.5) / rows * np.pi - np.pi / 2).repeat(columns)
    cell_weights = (num_directions > 0) * solid
    image = image / np.maximum(num_directions, 1)[:, None] * cell_weights[:, None]
    widened = _widen(image.reshape(rows, columns, 3), cell_weights.reshape(rows, columns))
    return widened.reshape(-1, 3)[y * columns + x].astype(np.float32)


def _widen(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Blur sums and weights with ever wider Gaussians, and return the filled colours [h, w, 3]."""
    rows, columns = weights.shape
    out = np.zeros_like(sums)
    remaining = np.ones_like(weights)
    sigma = 1.0
    while sigma <= rows / 2:
        blurred = np.dstack([sums, weights]).astype(np.float32)
        margin = min(columns, int(4 * sigma))
        blurred = np.concatenate([blurred[:, -margin:], blurred, blurred[:, :margin]], axis=1)
        blurred = cv2.GaussianBlur(blurred, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
        blurred = blurred[:, margin : margin + columns]
        trust = np.clip(blurred[..., 3] / 0.2, 0, 1) * remaining
        out += trust[..., None] * blurred[..., :3] / np.maximum(blurred[..., 3:], 1e-9)
        remaining -= trust
        sigma *= 2.0
    mean = sums.sum((0, 1)) / weights.sum()
    return out + remaining[..., None] * mean


@cached_njit(nogil=True)
def _gather(
    directions,
    rotation,
    intrinsics,
    is_free,
    is_sky,
    image,
    feather_width,
    uncertain_weight,
    sums,
    weights,
    has_certain_sky,
):  # pragma: no cover - compiled
    """Add one image's bilinear colours to the sums of the directions that it shows as free or sky.

    `sums`, `weights` and `has_certain_sky` are updated in place.
    """
    height, width = is_free.shape
    image_rows = image.shape[0]
    image_columns = image.shape[1]
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
        if v < 0 or v >= height or not is_free[int(v), int(u)]:
            continue
        border = min(min(u, width - u) / width, min(v, height - v) / height)
        weight = min(border / feather_width, np.float32(1)) + np.float32(1e-3)
        if is_sky[int(v), int(u)]:
            has_certain_sky[i] = True
        else:
            weight *= uncertain_weight
        y = min(
            max(v / height * image_rows - np.float32(0.5), np.float32(0)),
            np.float32(image_rows - 1),
        )
        x = min(
            max(u / width * image_columns - np.float32(0.5), np.float32(0)),
            np.float32(image_columns - 1),
        )
        y0 = int(y)
        x0 = int(x)
        y1 = min(y0 + 1, image_rows - 1)
        x1 = min(x0 + 1, image_columns - 1)
        wy = y - y0
        wx = x - x0
        for c in range(3):
            top = image[y0, x0, c] * (1 - wx) + image[y0, x1, c] * wx
            bottom = image[y1, x0, c] * (1 - wx) + image[y1, x1, c] * wx
            sums[i, c] += weight * (top * (1 - wy) + bottom * wy)
        weights[i] += weight


@cached_njit(nogil=True)
def draw_depth(
    centres, normals, major, extent, rotation, translation, fx, fy, cx, cy, depth
):  # pragma: no cover - compiled
    """Draw elliptic discs into a z-buffer.

    Args:
        centres, normals, major: float [N, 3], world; `major` is the direction of the longer axis.
        extent: float [N, 2], half axes in metres.
        rotation, translation: camera_from_world, [3, 3] and [3].
        fx, fy, cx, cy: pinhole intrinsics in pixels.
        depth: float32 [h, w], infinite where nothing is drawn. It is updated in place and keeps the
            nearest z.
    """
    height, width = depth.shape
    p = np.empty(3)
    n = np.empty(3)
    e1 = np.empty(3)
    e2 = np.empty(3)
    for i in range(len(centres)):
        z = translation[2]
        for b in range(3):
            z += rotation[2, b] * centres[i, b]
        if z < _MIN_DEPTH_M:
            continue
        for a in range(2):
            p[a] = translation[a]
            for b in range(3):
                p[a] += rotation[a, b] * centres[i, b]
        p[2] = z
        radius = max(extent[i, 0], extent[i, 1]) / z
        u = fx * p[0] / z + cx
        v = fy * p[1] / z + cy
        ru = fx * radius
        rv = fy * radius
        if u + ru < 0 or u - ru > width or v + rv < 0 or v - rv > height:
            continue
        iu = int(np.floor(u))
        iv = int(np.floor(v))
        if 0 <= iu < width and 0 <= iv < height and z < depth[iv, iu]:
            depth[iv, iu] = z
        if max(ru, rv) < 0.5:
            continue
        for a in range(3):
            n[a] = 0.0
            e1[a] = 0.0
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
                qx = dx * zt - p[0]
                qy = dy * zt - p[1]
                qz = zt - z
                a = (qx * e1[0] + qy * e1[1] + qz * e1[2]) / extent[i, 0]
                b = (qx * e2[0] + qy * e2[1] + qz * e2[2]) / extent[i, 1]
                if a * a + b * b <= 1.0:
                    depth[y, x] = zt


@cached_njit(nogil=True)
def observe(
    centres, normals, extent, rotation, translation, fx, fy, cx, cy,
    depth, cover, levels, level_sizes, used_rows, camera, scores, colours, cameras,
):  # fmt: skip  # pragma: no cover - compiled
    """Store the colour of every surfel that one image shows.

    A colour is stored if its score is among the NUM_OBSERVATIONS best of its surfel. Surfels that
    are hidden in the z-buffer, or that lie behind a moving box, are skipped.

    Args:
        centres, normals: float [N, 3], in the frame that `rotation` and `translation` map to the
            camera.
        extent: float [N, 2], half axes in metres.
        rotation, translation: to the camera's frame, [3, 3] and [3].
        fx, fy, cx, cy: intrinsics of the z-buffer in pixels.
        depth: float32 [h, w], z-buffer of all surfaces.
        cover: float32 [h, w], z of moving boxes. Nothing of a box lies in front of it; surfels
            behind it are hidden.
        levels: uint8 [L, H, W, 3], the image halved again and again.
        level_sizes: int [L, 2], rows and columns of the levels.
        used_rows: fraction of the image's rows, from the top, that may be used.
        camera: number of the camera.
        scores, colours, cameras: [N, NUM_OBSERVATIONS], with 3 channels for colours. They are
            updated in place.
    """
    height, width = depth.shape
    p = np.empty(3)
    n = np.empty(3)
    for i in range(len(centres)):
        for a in range(3):
            p[a] = translation[a]
            for b in range(3):
                p[a] += rotation[a, b] * centres[i, b]
        z = p[2]
        if z < _MIN_DEPTH_M:
            continue
        u = fx * p[0] / z + cx
        v = fy * p[1] / z + cy
        if not (1 <= u < width - 1 and 1 <= v < min(height - 1, used_rows * height)):
            continue
        x = int(u)
        y = int(v)
        if cover[y, x] < z:
            continue
        for a in range(3):
            n[a] = 0.0
            for b in range(3):
                n[a] += rotation[a, b] * normals[i, b]
        distance = np.sqrt(p[0] * p[0] + p[1] * p[1] + z * z)
        cosine = abs(n[0] * p[0] + n[1] * p[1] + n[2] * z) / distance
        # A surface seen at a slant spans much depth within one z-buffer pixel.
        slant = min(z / fx / max(cosine, 0.02), 1.5)
        tolerance = 0.08 + 0.01 * z + slant
        if z > depth[y, x] + tolerance:
            continue
        score = max(cosine, 0.03) * fx / z
        border = min(min(u, width - u) / width, min(v, height - v) / height)
        score *= min(border / _SCORE_FEATHER_WIDTH, 1.0)
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
        footprint = np.sqrt(extent[i, 0] * extent[i, 1] * max(cosine, 0.1)) * fx / z
        footprint *= level_sizes[0, 1] / width  # in pixels of the sharpest level
        level = min(max(int(np.log2(max(footprint, 1.0))), 0), len(levels) - 1)
        _sample(levels[level], level_sizes[level], u / width, v / height, colours[i, worst])
        scores[i, worst] = score
        cameras[i, worst] = camera


@cached_njit(nogil=True)
def _sample(image, size, u, v, out):  # pragma: no cover - compiled
    """Write the bilinear colour at relative coordinates (u, v), clamped at the border, to `out`."""
    y = min(max(v * size[0] - 0.5, 0.0), size[0] - 1.0)
    x = min(max(u * size[1] - 0.5, 0.0), size[1] - 1.0)
    y0 = int(y)
    x0 = int(x)
    y1 = min(y0 + 1, size[0] - 1)
    x1 = min(x0 + 1, size[1] - 1)
    fy = y - y0
    fx = x - x0
    for c in range(3):
        top = image[y0, x0, c] * (1 - fx) + image[y0, x1, c] * fx
        bottom = image[y1, x0, c] * (1 - fx) + image[y1, x1, c] * fx
        out[c] = np.uint8(top * (1 - fy) + bottom * fy + 0.5)


@cached_njit()
def blended_colours(scores, colours, cameras, keep, power):  # pragma: no cover - compiled
    """Return one colour per surfel from its stored observations.

    A camera's colour is the median, channel by channel, of its observations whose score is at least
    `keep` times the camera's best score. Cameras are averaged with weights (best score)^power.

    Returns:
        Colours, float32 [N, 3] in [0, 1], and a mask of the surfels that have an observation, bool
        [N].
    """
    num_surfels, num_slots = scores.shape
    out = np.zeros((num_surfels, 3), np.float32)
    is_observed = np.zeros(num_surfels, np.bool_)
    values = np.empty(num_slots, np.uint8)
    for i in range(num_surfels):
        weight_sum = 0.0
        for slot in range(num_slots):
            best_score = scores[i, slot]
            if best_score <= 0:
                continue
            is_best_of_camera = True
            for j in range(num_slots):
                if cameras[i, j] == cameras[i, slot] and (
                    scores[i, j] > best_score or (scores[i, j] == best_score and j < slot)
                ):
                    is_best_of_camera = False
            if not is_best_of_camera:
                continue
            weight = best_score**power
            weight_sum += weight
            for c in range(3):
                num_values = 0
                for j in range(num_slots):
                    if cameras[i, j] == cameras[i, slot] and scores[i, j] >= keep * best_score:
                        values[num_values] = colours[i, j, c]
                        num_values += 1
                sorted_values = np.sort(values[:num_values])
                median = (
                    np.float32(sorted_values[(num_values - 1) // 2])
                    + np.float32(sorted_values[num_values // 2])
                ) / 2
                out[i, c] += weight * median / np.float32(255)
        if weight_sum > 0:
            is_observed[i] = True
            for c in range(3):
                out[i, c] /= weight_sum
    return out, is_observed
