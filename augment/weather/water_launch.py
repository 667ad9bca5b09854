"""Arrays for the kernels that shade water on the CPU, and their launch."""

from __future__ import annotations

from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render.composite import sky_behind
from augment.render.threads import kernel_threads
from augment.sky import (
    ConstantSky,
    CubemapSky,
    LatLongSky,
    Sky,
    bordered_faces,
    directions_of_cubemap,
    with_border,
)
from augment.weather import layer_lookup, mip_kernels, reflection_lookup, refraction, water_surface
from augment.weather import water_kernels as kernels
from augment.weather.flood import FloodMedium, Layer
from augment.weather.screen_space import ScreenReflection
from augment.weather.smog import SmogMedium, optical_depth, vertical_optical_depth
from augment.weather.waves import WaveField

ROWS = 8  # image rows a thread takes at a time: rows without water cost nothing
MIP_ROWS = 32
SKY_SIZE = 256  # texels along a face where a sky that is no cube map is sampled onto one
_known_faces: WeakKeyDictionary[Sky, tuple[int, Tensor]] = WeakKeyDictionary()
LARGEST = 1e30  # stands for infinity: its products with 0 are 0


def shade(
    camera: Camera,
    cover: Tensor,
    hidden_cover: float,
    medium: FloodMedium,
    field: WaveField,
    bed: Layer,
    mirror: Layer | None,
    screen: ScreenReflection | None,
    sky: Sky,
    smog: SmogMedium | None,
) -> Tensor:
    """As `water.shade_water`; smog is None where it has no density."""
    faces, size, layered = flat_faces(sky, smog)
    limit = water_surface.smooth_variance(camera)
    rough = bool((field.slope_variance >= limit).any())
    out = np.empty((camera.height, camera.width, 3), np.float32)
    front, distance, weight = None, cover, cover
    if screen is not None:
        front, distance, weight = screen.layer, screen.distance, screen.weight
    arguments = (
        (np.arange(camera.width, dtype=np.float64) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height, dtype=np.float64) + 0.5 - camera.cy) / camera.fy,
        np.ascontiguousarray(camera.world_from_camera[:3, :3].numpy()),
        _array(cover),
        _array(field.normal_x),
        _array(field.normal_y),
        _array(field.slope_variance),
        *_layer(bed),
        refraction.window_offset(bed.camera, camera),
        *_layer(mirror),
        *_averages(mirror, rough),
        mirror is not None,
        *_layer(front),
        screen is not None,
        _array(distance),
        _array(weight),
        faces.numpy(),
        np.uint64(size),
        medium_numbers(camera, medium, smog, layered),
        _limits(hidden_cover, limit),
        out,
    )
    with kernel_threads(ROWS):
        kernels.shade(*arguments)
    return torch.from_numpy(out)


def _array(part: Tensor) -> np.ndarray:
    return part.detach().float().contiguous().numpy()


def flat_faces(sky: Sky, smog: SmogMedium | None) -> tuple[Tensor, int, SmogMedium | None]:
    """A flat cube map for the kernels, the size of its faces with border, the smog before them.

    The map of a sky that is an image is the same tensor until the image changes.
    """
    seen, layered = sky_behind(sky, smog)
    if isinstance(seen, ConstantSky):
        return _padded(seen.rgb.expand(6, 3, 3, 3)), 3, layered
    if not isinstance(seen, CubemapSky | LatLongSky):
        return _padded(with_border(_sampled(seen))), SKY_SIZE + 2, layered
    image = seen.faces if isinstance(seen, CubemapSky) else seen.image
    known = _known_faces.get(seen)
    if known is None or known[0] != image._version:
        is_cube = isinstance(seen, CubemapSky)
        faces = bordered_faces(seen) if is_cube else with_border(_sampled(seen))
        known = _known_faces[seen] = (image._version, _padded(faces))
    size = seen.faces.shape[1] if isinstance(seen, CubemapSky) else SKY_SIZE
    return known[1], size + 2, layered


def _sampled(sky: Sky) -> Tensor:
    return sky.sample(directions_of_cubemap(SKY_SIZE))


def _padded(faces: Tensor) -> Tensor:
    """Four numbers a texel, and a row and a texel beyond them."""
    size = faces.shape[1]
    out = np.zeros((6 * size * size + size + 1, 4), np.float32)
    out[: 6 * size * size, :3] = _array(faces).reshape(-1, 3)
    return torch.from_numpy(out.reshape(-1))


def _layer(layer: Layer | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`kernels.View` and images of a layer; of None what nothing will be looked up in."""
    if layer is None:
        nothing = np.zeros(1, np.float32)
        return np.zeros(22, np.float32), nothing, nothing, nothing
    rgb, alpha, depth = (_array(part).reshape(-1) for part in (layer.rgb, layer.alpha, layer.depth))
    return view_numbers(layer.camera), rgb, alpha, depth


def view_numbers(camera: Camera) -> np.ndarray:
    """Float32 [22]: focal length times the camera's right, down (fx, fy) and forward axes;
    coefficients of column, row and 1 in the x, y, z of a pixel's ray; cx, cy, width, height.
    """
    rotation = camera.camera_from_world[:3, :3].numpy()
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    project = rotation * [[fx], [fy], [1.0]]
    rays = rotation.T @ [[1 / fx, 0.0, -cx / fx], [0.0, 1 / fy, -cy / fy], [0.0, 0.0, 1.0]]
    numbers = [*project.reshape(-1), *rays.reshape(-1), cx, cy, camera.width, camera.height]
    return np.asarray(numbers, np.float32)


def _averages(layer: Layer | None, rough: bool) -> tuple[np.ndarray, np.ndarray]:
    """Mip levels in one array, a row and a pixel longer; (first pixel, width, height) of each."""
    if layer is None or not rough:
        return np.zeros(1, np.float32), np.zeros((1, 3), np.int64)
    rgb, alpha = _array(layer.rgb), _array(layer.alpha)
    height, width = alpha.shape
    spare, shapes, first = width + 1, [(0, width, height)], height * width
    while len(shapes) < layer_lookup.MIP_LEVELS and max(height, width) > 1:
        height, width = (height + 1) // 2, (width + 1) // 2
        shapes.append((first, width, height))
        first += height * width
    mips = np.empty((first + spare, 4), np.float32)
    mips[first:] = 0
    images = [mips[start : start + w * h].reshape(h, w, 4) for start, w, h in shapes]
    with kernel_threads(MIP_ROWS):
        mip_kernels.pack(rgb, alpha, images[0])
        for fine, coarse in pairwise(images):
            mip_kernels.halve_mip(fine, coarse)
    return mips.reshape(-1), np.asarray(shapes, np.int64)


def medium_numbers(
    camera: Camera, medium: FloodMedium, smog: SmogMedium | None, layered: SmogMedium | None
) -> np.ndarray:
    """`kernels.Medium`."""
    eye_z, level = float(camera.centre[2]), medium.level_z_m
    per_m, above, airlight = 0.0, -1.0, (0.0, 0.0, 0.0)
    if smog is not None:
        metre, height = torch.tensor([1.0, level], dtype=torch.float64)
        per_m, airlight = float(optical_depth(smog, metre, eye_z, height)), smog.rgb
    if layered is not None:
        above = vertical_optical_depth(layered, level)
    numbers = [eye_z - level, medium.refraction_index, medium.fresnel == "schlick"]
    numbers += [*medium.extinction_per_m, *medium.rgb, per_m, above, *airlight]
    return np.minimum(numbers, LARGEST).astype(np.float32)


def _limits(hidden_cover: float, smooth_variance: float) -> np.ndarray:
    """`kernels.Limits`."""
    surface, lookup, reflection = water_surface, layer_lookup, reflection_lookup
    numbers = [hidden_cover, surface.FARTHEST, surface.LEAST_COSINE, smooth_variance]
    numbers += [surface.STEEPEST, lookup.LEAST_DEPTH, lookup.SOLID_ALPHA, refraction.BED_STEPS]
    numbers += [reflection.EDGE, reflection.MATCH_M, reflection.MATCH_SHARE, refraction.SETTLED_M]
    numbers += [refraction.MOST_OPTICAL_DEPTH, reflection.FAINT]
    return np.asarray(numbers, np.float32)
