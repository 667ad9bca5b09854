"""A water surface's picture: what it reflects, and what is seen through it. The torch definition.

water = sum_i w_i F_i R_i + (1 - sum_i w_i F_i) T

i runs over the slopes of the surface inside a pixel, F is the reflected share of the light, R what
comes from the mirrored direction and T what comes up through the surface.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import refraction
from augment.effects.flood import refraction as layer_lookup
from augment.effects.flood import refraction as reflection_lookup
from augment.effects.flood import refraction as water_surface
from augment.effects.flood import water_kernels as kernels
from augment.effects.flood import water_kernels as mip_kernels
from augment.effects.flood.flood import FloodMedium, Layer, reflectance
from augment.effects.flood.refraction import (
    MIN_COSINE,
    Surface,
    before_sky,
    is_smooth,
    meet_plane,
    mirrored,
    mirrored_eye_is,
    reflect_mirror,
    reflect_screen,
    reflect_sky,
    through_the_surface,
    tilted_normals,
    window_offset,
)
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.waves import WaveField
from augment.effects.smog import SmogMedium, optical_depth, vertical_optical_depth
from augment.render.buffers import CPU, REFERENCE, kernels_for
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

# ---- Arrays for the kernels that shade water on the CPU, and their launch ------------------------

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
    numbers = [hidden_cover, surface.FARTHEST, surface.MIN_COSINE, smooth_variance]
    numbers += [surface.STEEPEST, lookup.MIN_DEPTH, lookup.SOLID_ALPHA, refraction.BED_STEPS]
    numbers += [reflection.EDGE, reflection.MATCH_M, reflection.MATCH_SHARE, refraction.SETTLED_M]
    numbers += [refraction.MAX_OPTICAL_DEPTH, reflection.FAINT]
    return np.asarray(numbers, np.float32)


# ---- water ---------------------------------------------------------------------------------------

# Water that is covered more than this is one colour. Opaque surfaces let up to 4 % through (a splat
# that would bring transmittance to 1e-4 is not blended, whatever is left before it), and what
# shines through them is worth no reflections.
HIDDEN_COVER = 0.95


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
    smog: SmogMedium | None = None,
    backend: str = CPU,
) -> Float[Tensor, "h w 3"]:
    """Colour of the water where the camera's rays meet it, not clamped; 0 where they do not.

    camera: above the water. cover: alpha of what stands before the water; where it is more than
    HIDDEN_COVER the result is the water's own colour, or the smog's. field: of this camera. bed:
    from a window of the same image, best a larger one. mirror: from the eye mirrored in the plane.
    screen: its layer is of the same eye; it serves the pixels that are smooth
    (`water_surface.is_smooth`), in the others' blur a coarse mirror is as sharp. Layers are fogged
    already; smog here dims the sky and the water's own colour. backend: with kernels, float32 goes
    through them, equal to this definition within float rounding, unless gradients are recorded.

    Raises:
        ValueError: the eye is not above the water, or cameras, images and fields do not fit.
    """
    _check(camera, cover, medium, field, bed, mirror, screen)
    if smog is not None and smog.sigma_per_m == 0:
        smog = None
    layers = [
        bed,
        *([] if mirror is None else [mirror]),
        *([] if screen is None else [screen.layer]),
    ]
    images = [cover, *(part for layer in layers for part in (layer.rgb, layer.alpha, layer.depth))]
    kernels = kernels_for(backend, *images)
    if kernels != REFERENCE:
        run = shade if kernels == CPU else _shade_on_gpu
        return run(camera, cover, HIDDEN_COVER, medium, field, bed, mirror, screen, sky, smog)
    surface = meet_plane(camera, medium.level_z_m, bed.rgb.dtype)
    smooth = is_smooth(field, camera)
    taps = tilted_normals(surface, field, smooth)
    below = through_the_surface(surface, taps[0][1], camera, medium, bed, smog)
    out = below
    if medium.refraction_index != 1:
        rays = [mirrored(surface.to_eye, normal) for _, normal in taps]
        above = reflect_sky(surface, rays, camera, medium.level_z_m, sky, smog)
        seen = [torch.zeros_like(below[..., :1]).expand(*cover.shape, 4)] * len(taps)
        if mirror is not None:
            seen = reflect_mirror(surface, rays, mirror, smooth)
        if screen is not None:
            seen = [reflect_screen(surface, rays[0], screen, smooth, seen[0]), *seen[1:]]
        for (weight, normal), color, behind in zip(taps, seen, above, strict=True):
            share = weight * reflected_share(surface, normal, medium)
            out = out + share[..., None] * (before_sky(color, behind) - below)
    plain = torch.tensor(medium.rgb if smog is None else smog.rgb, dtype=out.dtype)
    out = torch.where((cover <= HIDDEN_COVER)[..., None], out, plain)
    return torch.where(surface.meets[..., None], out, 0)


def _shade_on_gpu(*arguments: Any) -> Tensor:
    from augment.effects.flood import cuda_water

    return cuda_water.shade(*arguments)


def reflected_share(
    surface: Surface, normal: Float[Tensor, "h w 3"], medium: FloodMedium
) -> Float[Tensor, "h w"]:
    """F at a normal; facets that look away from the eye count as seen edge-on."""
    cosine = (normal * surface.to_eye).sum(-1).clamp(MIN_COSINE, 1)
    return reflectance(cosine, medium.refraction_index, medium.fresnel)


def _check(
    camera: Camera,
    cover: Tensor,
    medium: FloodMedium,
    field: WaveField,
    bed: Layer,
    mirror: Layer | None,
    screen: ScreenReflection | None,
) -> None:
    eye_z = float(camera.centre[2])
    if not eye_z > medium.level_z_m:
        raise ValueError(
            f"camera {camera.name!r} must be above the water at z = {medium.level_z_m} m; "
            f"its eye is at z = {eye_z} m"
        )
    window_offset(bed.camera, camera)
    parts = {"cover": cover, "field": field.normal_x}
    if screen is not None:
        parts |= {"screen.distance": screen.distance}
    for name, part in parts.items():
        _fits(name, part, camera)
    layers = {
        "bed": bed,
        "mirror": mirror,
        "screen.layer": None if screen is None else screen.layer,
    }
    for name, layer in layers.items():
        if layer is not None:
            _fits(name, layer.alpha, layer.camera)
    if mirror is not None and not mirrored_eye_is(mirror.camera, medium.level_z_m, camera.centre):
        expected = [*camera.centre.tolist()[:2], 2 * medium.level_z_m - eye_z]
        raise ValueError(
            f"the mirror's camera must stand at the mirrored eye {expected}; "
            f"it stands at {mirror.camera.centre.tolist()}"
        )


def _fits(name: str, part: Tensor, camera: Camera) -> None:
    if tuple(part.shape) != (camera.height, camera.width):
        raise ValueError(
            f"{name} must be [{camera.height}, {camera.width}] as its camera {camera.name!r} is; "
            f"got {list(part.shape)}"
        )
