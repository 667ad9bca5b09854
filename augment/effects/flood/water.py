"""A water surface's picture: what it reflects, and what is seen through it. The torch definition.

    water = sum_i w_i F_i R_i + (1 - sum_i w_i F_i) T

i runs over the slopes inside a pixel; F: reflected share of the light, R: what comes from the
mirrored direction, T: what comes up through the surface.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import water_kernels as kernels
from augment.effects.flood.flood import FloodMedium, Layer, reflectance
from augment.effects.flood.refraction import (
    MIP_LEVELS,
    before_sky,
    is_smooth,
    meet_plane,
    mirrored,
    reflect_mirror,
    reflect_screen,
    reflect_sky,
    smooth_variance,
    through_the_surface,
    tilted_normals,
)
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.water_kernels import HIDDEN_COVER, MIN_COSINE
from augment.effects.flood.water_plane import image_coordinates, window_offset
from augment.effects.flood.waves import WaveField
from augment.render.buffers import CPU, REFERENCE, kernels_for
from augment.render.composite import sky_behind
from augment.render.fog import Fog, optical_depth, vertical_optical_depth
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


class Water(NamedTuple):
    """What `shade_water` is given; fog is None where it has no density."""

    camera: Camera
    cover: Float[Tensor, "h w"]
    medium: FloodMedium
    field: WaveField
    bed: Layer
    mirror: Layer | None
    screen: ScreenReflection | None
    sky: Sky
    fog: Fog | None


# ---- The kernels' arrays -------------------------------------------------------------------------

ROWS = 8  # image rows a thread takes at a time: rows without water cost nothing
MIP_ROWS = 32
SKY_SIZE = 256  # texels along a face where a sky that is no cube map is sampled onto one
_known_faces: WeakKeyDictionary[Sky, tuple[int, Tensor]] = WeakKeyDictionary()
LARGEST = 1e30  # stands for infinity: its products with 0 are 0


def _shade(water: Water) -> Tensor:
    camera, field, mirror, screen = water.camera, water.field, water.mirror, water.screen
    faces, size, layered = flat_faces(water.sky, water.fog)
    limit = smooth_variance(camera)
    rough = bool((field.slope_variance >= limit).any())
    out = np.empty((camera.height, camera.width, 3), np.float32)
    front, distance, weight = None, water.cover, water.cover
    if screen is not None:
        front, distance, weight = screen.layer, screen.distance, screen.weight
    arguments = (
        *image_coordinates(camera),
        np.ascontiguousarray(camera.world_from_camera[:3, :3].numpy()),
        _array(water.cover),
        *(_array(part) for part in (field.normal_x, field.normal_y, field.slope_variance)),
        *_layer(water.bed),
        window_offset(water.bed.camera, camera),
        *_layer(mirror),
        *_averages(mirror, rough),
        mirror is not None,
        *_layer(front),
        screen is not None,
        _array(distance),
        _array(weight),
        faces.numpy(),
        np.uint64(size),
        medium_numbers(water, layered),
        np.float32(limit),
        out,
    )
    with kernel_threads(ROWS):
        kernels.shade(*arguments)
    return torch.from_numpy(out)


def _array(part: Tensor) -> np.ndarray:
    return part.detach().float().contiguous().numpy()


def flat_faces(sky: Sky, fog: Fog | None) -> tuple[Tensor, int, Fog | None]:
    """(flat cube map, size of its faces with border, the fog before them).

    The map of an image is the same tensor until the image changes.
    """
    seen, layered = sky_behind(sky, fog)
    if isinstance(seen, ConstantSky):
        return _padded(seen.rgb.expand(6, 3, 3, 3)), 3, layered
    if not isinstance(seen, CubemapSky | LatLongSky):
        return _padded(_sampled(seen)), SKY_SIZE + 2, layered
    is_cube = isinstance(seen, CubemapSky)
    image = seen.faces if is_cube else seen.image
    known = _known_faces.get(seen)
    if known is None or known[0] != image._version:
        faces = bordered_faces(seen) if is_cube else _sampled(seen)
        known = _known_faces[seen] = (image._version, _padded(faces))
    return known[1], (len(image[0]) if is_cube else SKY_SIZE) + 2, layered


def _sampled(sky: Sky) -> Tensor:
    return with_border(sky.sample(directions_of_cubemap(SKY_SIZE)))


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
    while len(shapes) < MIP_LEVELS and max(height, width) > 1:
        height, width = (height + 1) // 2, (width + 1) // 2
        shapes.append((first, width, height))
        first += height * width
    mips = np.empty((first + spare, 4), np.float32)
    mips[first:] = 0
    images = [mips[start : start + w * h].reshape(h, w, 4) for start, w, h in shapes]
    with kernel_threads(MIP_ROWS):
        kernels.pack(rgb, alpha, images[0])
        for fine, coarse in pairwise(images):
            kernels.halve_mip(fine, coarse)
    return mips.reshape(-1), np.asarray(shapes, np.int64)


def medium_numbers(water: Water, layered: Fog | None) -> np.ndarray:
    """`kernels.Medium`. layered: the fog before the sky."""
    medium, eye_z = water.medium, float(water.camera.centre[2])
    level = medium.level_z_m
    per_m, above, airlight = 0.0, -1.0, (0.0, 0.0, 0.0)
    if water.fog is not None:
        metre, height = torch.tensor([1.0, level], dtype=torch.float64)
        per_m, airlight = float(optical_depth(water.fog, metre, eye_z, height)), water.fog.rgb
    if layered is not None:
        above = vertical_optical_depth(layered, level)
    numbers = [eye_z - level, medium.refraction_index, medium.fresnel == "schlick"]
    numbers += [*medium.extinction_per_m, *medium.rgb, per_m, above, *airlight]
    return np.minimum(numbers, LARGEST).astype(np.float32)


# ---- The colour of the water ---------------------------------------------------------------------


def shade_water(
    camera: Camera,
    cover: Float[Tensor, "h w"],
    medium: FloodMedium,
    field: WaveField,
    bed: Layer,
    *,
    mirror: Layer | None = None,
    screen: ScreenReflection | None = None,
    sky: Sky,
    fog: Fog | None = None,
    backend: str = CPU,
) -> Float[Tensor, "h w 3"]:
    """Colour of the water where the camera's rays meet it, not clamped; 0 where they do not.

    cover: alpha of what stands before the water; above HIDDEN_COVER the result is the water's own
    colour, or the fog's. bed: from a window of the same image. mirror: from the mirrored eye.
    screen: serves the smooth pixels. Layers are fogged already; fog here dims the sky and the
    water's own colour. backend: kernels equal the definition within float rounding.

    Raises:
        ValueError: the bed's camera and this one are not windows of one image.
    """
    if fog is not None and fog.sigma_per_m == 0:
        fog = None
    water = Water(camera, cover, medium, field, bed, mirror, screen, sky, fog)
    layers = (bed, mirror, None if screen is None else screen.layer)
    images = [(i.rgb, i.alpha, i.depth) for i in layers if i is not None]
    backend = kernels_for(backend, cover, *(part for parts in images for part in parts))
    if backend == CPU:
        return _shade(water)
    if backend != REFERENCE:
        from augment.effects.flood import cuda

        return cuda.shade(water)
    surface = meet_plane(camera, medium.level_z_m, bed.rgb.dtype)
    smooth = is_smooth(field, camera)
    taps = tilted_normals(surface, field, smooth)
    below = through_the_surface(surface, taps[0][1], camera, medium, bed, fog)
    out = below
    if medium.refraction_index != 1:
        rays = [mirrored(surface.to_eye, normal) for _, normal in taps]
        above = reflect_sky(surface, rays, camera, medium.level_z_m, sky, fog)
        seen = [torch.zeros_like(below[..., :1]).expand(*cover.shape, 4)] * len(taps)
        if mirror is not None:
            seen = reflect_mirror(surface, rays, mirror, smooth)
        if screen is not None:
            seen = [reflect_screen(surface, rays[0], screen, smooth, seen[0]), *seen[1:]]
        for (weight, normal), color, behind in zip(taps, seen, above, strict=True):
            # Facets that look away from the eye count as seen edge-on.
            cosine = (normal * surface.to_eye).sum(-1).clamp(MIN_COSINE, 1)
            share = weight * reflectance(cosine, medium.refraction_index, medium.fresnel)
            out = out + share[..., None] * (before_sky(color, behind) - below)
    plain = torch.tensor(medium.rgb if fog is None else fog.rgb, dtype=out.dtype)
    out = torch.where((cover <= HIDDEN_COVER)[..., None], out, plain)
    return torch.where(surface.meets[..., None], out, 0)
