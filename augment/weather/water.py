"""A water surface's picture: what it reflects, and what is seen through it. The torch definition.

water = sum_i w_i F_i R_i + (1 - sum_i w_i F_i) T

i runs over the slopes of the surface inside a pixel, F is the reflected share of the light, R what
comes from the mirrored direction and T what comes up through the surface.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import CPU, REFERENCE, kernels_for
from augment.sky import Sky
from augment.weather import water_launch
from augment.weather.flood import FloodMedium, Layer
from augment.weather.fresnel import reflectance
from augment.weather.reflection_lookup import (
    before_sky,
    mirrored_eye_is,
    reflect_mirror,
    reflect_screen,
    reflect_sky,
)
from augment.weather.refraction import through_the_surface, window_offset
from augment.weather.screen_space import ScreenReflection
from augment.weather.smog import SmogMedium
from augment.weather.water_surface import (
    LEAST_COSINE,
    Surface,
    is_smooth,
    meet_plane,
    mirrored,
    tilted_normals,
)
from augment.weather.waves import WaveField

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
        shade = water_launch.shade if kernels == CPU else _shade_on_gpu
        return shade(camera, cover, HIDDEN_COVER, medium, field, bed, mirror, screen, sky, smog)
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
    from augment.weather import cuda_water

    return cuda_water.shade(*arguments)


def reflected_share(
    surface: Surface, normal: Float[Tensor, "h w 3"], medium: FloodMedium
) -> Float[Tensor, "h w"]:
    """F at a normal; facets that look away from the eye count as seen edge-on."""
    cosine = (normal * surface.to_eye).sum(-1).clamp(LEAST_COSINE, 1)
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
