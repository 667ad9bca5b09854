"""A view of a flooded scene: the layers that are rasterised, and how they become one picture.

If the eye is above the water, a point of a ray lies in front of the water exactly if it lies above
the water's plane. So the scene is drawn in layers that are cut at the plane pixel by pixel
(augment.render.layout):

    front     the scene above the plane, over the whole image
    bed       the scene below the plane, where the plane is in view
    mirror    the scene above the plane, from the eye mirrored in the plane

    picture = front + (1 - front's alpha) (water, where the ray meets the plane, else the sky)

and nothing in front of the water can leak into refraction or reflection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.effects.flood import water_kernels
from augment.effects.flood.flood_medium import FloodMedium, Layer, fresnel_reflectance
from augment.effects.flood.screen_space import trace_screen
from augment.effects.flood.water import is_smooth, shade_water
from augment.effects.flood.water_kernels import HIDDEN_COVER
from augment.effects.flood.water_plane import (
    Margins,
    Window,
    falling,
    image_coordinates,
    mirrored_camera,
    mirrored_window,
    plane_depth,
    plane_window,
    resized,
)
from augment.effects.flood.waves import WaveField, wave_field
from augment.effects.wet.ripples import add_ring_waves, make_rings
from augment.render.buffers import ALPHA, CPU, EXPECTED_DEPTH, RGB, RenderOutput, choose_kernels
from augment.render.composite import simplify_sky
from augment.render.constants import DEPTH_EPS
from augment.render.fog import Fog, blend_airlight, sky_optical_depth
from augment.render.fog_table import local_fog
from augment.render.layout import ABOVE, BELOW, HeightClip
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.sky import Sky, sample_at
from augment.timing import timed
from augment.view.layers import LayerRenderer

# ---- Layers composited ---------------------------------------------------------------------------


ROWS = 32  # image rows a thread takes at a time


def find_water(
    alpha: Float[Tensor, "H W"], camera: Camera, *, backend: str = CPU
) -> tuple[Bool[Tensor, "H W"], float]:
    """Return the mask of the water for a camera above it, and its largest share of any pixel.

    alpha: opacity of the scene in front of the water. A pixel shows water where alpha leaves more
    than half of it.
    """
    if choose_kernels(backend, alpha) == CPU:
        water = np.empty(tuple(alpha.shape), np.uint8)
        max_shares = np.empty(len(alpha), np.float32)
        with kernel_threads(ROWS):
            water_kernels.find_water(*_rays(camera), alpha.detach().numpy(), max_shares, water)
        return torch.from_numpy(water).view(torch.bool), float(max_shares.max())
    share = torch.where(falling(camera, alpha.device), 1 - alpha, 0)
    return share > 0.5, float(share.max())  # waits for the GPU: the next layers depend on it


def composite_water(
    front: RenderOutput,
    camera: Camera,
    window: Window,
    color: Float[Tensor, "h w 3"],
    renderer: LayerRenderer,
) -> Float[Tensor, "H W 3"]:
    """Return the front layer over the water where rays fall, and over the sky elsewhere.

    Args:
        front: the front layer. On the CPU the kernels write into its colours.
        camera: camera of the image.
        window: the part of the image that can show water.
        color: colour of the water in the window's pixels.
        renderer: the renderer that drew the front layer.
    """
    assert front.rgb is not None and front.alpha is not None
    rgb = front.rgb
    alpha = front.alpha
    in_place = choose_kernels(renderer.backend, rgb, alpha) == CPU
    image = rgb if in_place else rgb.clone()
    dry = _dry_rows(camera)
    mixed_rows = rgb[window.top : dry].clone()  # rows that show water and sky
    if dry:
        above = camera.cropped(0, 0, camera.width, dry)
        image[:dry] = renderer.add_sky(rgb[:dry], alpha[:dry], above)
    if in_place:
        if window.top < dry:  # what falls belongs to the water
            is_water = falling(camera.cropped(0, window.top, camera.width, dry - window.top))
            image[window.top : dry][is_water] = mixed_rows[is_water]
        with kernel_threads(ROWS):
            images = alpha.numpy(), color.contiguous().numpy(), image.numpy()
            rays = _rays(window.of(camera))
            water_kernels.composite_water(*rays, window.top, window.left, *images)
        return image
    mixed = window.cut(rgb) + (1 - window.cut(alpha))[..., None] * color
    num_shared_rows = min(max(dry - window.top, 0), len(mixed))  # rows that show both
    if num_shared_rows:
        hits_plane = falling(
            camera.cropped(window.left, window.top, mixed.shape[1], num_shared_rows), rgb.device
        )
        mixed[:num_shared_rows] = torch.where(
            hits_plane[..., None], mixed[:num_shared_rows], window.cut(image)[:num_shared_rows]
        )
    window.cut(image).copy_(mixed)
    return image


def _dry_rows(camera: Camera) -> int:
    """Return one past the last row in which a ray does not fall."""
    first, last = (falling(camera.cropped(c, 0, 1, camera.height)) for c in (0, camera.width - 1))
    dry = torch.nonzero(~(first & last)[:, 0])
    return int(dry.max()) + 1 if len(dry) else 0


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rise = np.ascontiguousarray(camera.world_from_camera[2, :3].numpy())
    return *image_coordinates(camera), rise


def merge_depths(
    front: RenderOutput,
    behind: RenderOutput,
    window: Window,
    buffers: frozenset[str],
    *,
    backend: str = CPU,
) -> RenderOutput:
    """Return the buffers of two layers as the buffers of one scene, without colour.

    Alpha and expected depth are those that one render would give. Other buffers come from the layer
    that covers more of the pixel.

    Args:
        front: buffers of the whole image. On the CPU the kernels write into them.
        behind: buffers of the window's pixels behind the water.
        window: the window in the image.
        buffers: names of the requested buffers.
        backend: name of the backend.
    """
    assert front.alpha is not None and behind.alpha is not None
    requested = buffers - {RGB, ALPHA}
    if not requested:
        return RenderOutput()
    image_slices, window_slices = window.overlap(front.alpha)
    if choose_kernels(backend, front.alpha) == CPU:
        values = {name: getattr(front, name) for name in (*requested, ALPHA)}
        alphas = (front.alpha.numpy()[image_slices], behind.alpha.numpy()[window_slices])
        with kernel_threads(ROWS):
            for name in sorted(requested):
                front_and_behind = (
                    values[name].numpy()[image_slices],
                    getattr(behind, name).numpy()[window_slices],
                )
                if name == EXPECTED_DEPTH:
                    water_kernels.join_depth(*alphas, *front_and_behind, np.float32(DEPTH_EPS))
                else:
                    water_kernels.join_heavier(*alphas, *front_and_behind)
            water_kernels.join_alpha(*alphas)
        return RenderOutput(**values)
    alpha = front.alpha[image_slices]
    share = (1 - alpha) * behind.alpha[window_slices]
    total = alpha + share
    merged = {ALPHA: total}
    for name in requested:
        front_values = getattr(front, name)[image_slices]
        behind_values = getattr(behind, name)[window_slices]
        if name == EXPECTED_DEPTH:
            merged[name] = (alpha * front_values + share * behind_values) / total.clamp_min(
                DEPTH_EPS
            )
        else:
            merged[name] = torch.where(share > alpha, behind_values, front_values)
    values = {name: getattr(front, name).clone() for name in merged}
    for name, value in merged.items():
        values[name][image_slices] = value
    return RenderOutput(**values)


# ---- The view from under the water, whose surface is taken as flat -------------------------------


def view_from_below(
    front: Layer, air: Layer, medium: FloodMedium, sky: Sky, fog: Fog | None = None
) -> Float[Tensor, "H W 3"]:
    """Return the picture of an eye at or below the water's surface, not clamped.

    Light that the surface reflects back down has the colour of deep water.

    Args:
        front: the scene under water.
        air: the scene above the water, from the same camera.
        medium: the water.
        sky: the sky.
        fog: the fog in the air.
    """
    camera = front.camera
    rgb = front.rgb
    device = front.rgb.device
    lengths = camera.ray_lengths(rgb.dtype, device)
    deep = torch.tensor(medium.rgb, dtype=rgb.dtype, device=device)
    to_bed = transmittance(medium, front.depth * lengths)
    below_surface = to_bed * rgb + front.alpha[..., None] * (1 - to_bed) * deep

    directions = camera.ray_directions(rgb.dtype, device)
    up = directions[..., 2] / lengths
    air_directions = _into_air(directions / lengths[..., None], medium.refraction_index)
    reflected = fresnel_reflectance(up.clamp_min(0), 1 / medium.refraction_index)[..., None]
    sky_behind, fog = simplify_sky(sky, local_fog(fog, camera))
    sky_rgb = sample_at(sky_behind, air_directions)
    if fog is not None:
        tau = sky_optical_depth(fog, air_directions[..., 2], medium.level_z_m)
        sky_rgb = blend_airlight(sky_rgb, tau, fog)
    outside = air.rgb + (1 - air.alpha)[..., None] * sky_rgb
    surface = (1 - reflected) * outside + reflected * deep
    depth = plane_depth(camera, medium.level_z_m, device).to(rgb.dtype)
    hits_plane = depth.isfinite()
    distance = torch.where(hits_plane, depth, torch.zeros_like(depth)) * lengths
    to_surface = transmittance(medium, distance)
    beyond = torch.where(
        hits_plane[..., None],
        to_surface * surface + (1 - to_surface) * deep,
        deep.expand_as(surface),
    )
    return below_surface + (1 - front.alpha)[..., None] * beyond


def transmittance(medium: FloodMedium, length_m: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Return exp(-extinction length) per channel.

    It is 1 over zero length, also if the extinction is infinite.
    """
    extinction = torch.tensor(medium.extinction_per_m, dtype=length_m.dtype, device=length_m.device)
    t = torch.exp(-extinction * length_m[..., None])
    return torch.where((length_m[..., None] == 0) | (extinction == 0), torch.ones_like(t), t)


def _into_air(directions: Float[Tensor, "*B 3"], index: float) -> Float[Tensor, "*B 3"]:
    """Return unit directions of rising rays after the surface; level beyond the critical angle."""
    flat = index * directions[..., :2]
    rise = (1 - flat.square().sum(-1)).clamp_min(0).sqrt()
    return torch.nn.functional.normalize(torch.cat([flat, rise[..., None]], -1), dim=-1)


# ---- The layers that are drawn -------------------------------------------------------------------

# Resolution of the mirrored view that fills the gaps of the screen-space reflections, as a share of
# the image's resolution.
COARSE = 0.25
SLOPE_SIGMAS = 3.0  # slopes of the waves that the margins allow for, in standard deviations
MAX_MARGIN = 0.25  # largest margin of the mirrored view, as a share of the image's longer side
# Fall per metre of the ray whose point on the bed refraction moves most in the image.
MAX_SHIFT_FALL = 0.65
MAX_SHIFT = 0.12  # largest shift of the bed by refraction, as a share of the image's height
NUM_RAYS_PER_SIDE = 17  # rays along each side of the image whose steepness is evaluated
# Largest difference in the sine of the angle to the horizon between these rays and the others.
SINE_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class FloodedImage:
    """Picture of a flooded scene."""

    rgb: Float[Tensor, "H W 3"]
    """Display-encoded colour with sky and water, not clamped."""

    scene: RenderOutput
    """Alpha and the requested buffers of the scene's surfaces, also behind the water; empty if
    only colour and alpha are requested.
    """

    water: Bool[Tensor, "H W"]
    """True where a ray meets water first."""

    is_hidden: bool = False
    """True if the front layer hides all of the water; no other layer was drawn then."""

    field: WaveField | None = None
    """Waves in the window's pixels; None where no surface was drawn from above."""

    window: Window | None = None
    """Part of the image that `field` covers."""


def as_layer(camera: Camera, raster: RenderOutput) -> Layer:
    """Return a rasterised image with expected depth as a `Layer`."""
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    return Layer(camera, raster.rgb, raster.alpha, raster.expected_depth)


def render_flooded(
    renderer: LayerRenderer, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage | None:
    """Return the picture of a camera; None if its image cannot show the water's plane.

    Args:
        renderer: draws the scene's layers.
        camera: camera of the image.
        medium: the water.
        buffers: requested buffers of the scene's surfaces, as for `rasterize`.
    """
    if float(camera.centre[2]) <= medium.level_z_m:
        return _from_below(renderer, camera, medium, buffers)
    window = plane_window(camera, medium.level_z_m)
    if window is None:
        return None
    above = HeightClip(medium.level_z_m, ABOVE)
    requested = buffers | {RGB, ALPHA}
    if medium.reflection == "screen_space":
        requested = requested | {EXPECTED_DEPTH}
    with timed("rasterise"):
        front = renderer.render_layer(camera, above, requested)
    assert front.rgb is not None and front.alpha is not None
    sky = renderer.sky
    fog = renderer.fog
    backend = renderer.backend
    device = front.alpha.device
    with timed("flood: find water"):
        water, max_water_share = find_water(front.alpha, camera, backend=backend)
    if max_water_share < 1 - HIDDEN_COVER:
        with timed("sky"):
            image = renderer.add_sky(front.rgb, front.alpha, camera)
        return FloodedImage(image, front, water, is_hidden=True)

    crop = window.of(camera)
    cover = window.cut(front.alpha)
    shows_water = cover <= HIDDEN_COVER
    with timed("flood: waves"):
        field = wave_field(medium.waves, crop, medium.level_z_m, device=device, backend=backend)
        rings = make_rings(medium.rain_mm_h, medium.seed, camera.timestamp_ns)
        field = add_ring_waves(field, crop, medium.level_z_m, rings, backend=backend)
    margins = _bed_margins(camera, medium)
    bed_window = window.grown(margins)
    bed_camera = bed_window.of(camera)
    with timed("flood: bed"):
        bed_share = None
        if renderer.photo is not None:  # the photo shows the bed where the front is transparent
            bed_share = torch.zeros(bed_camera.height, bed_camera.width, device=device)
            image_slices, window_slices = bed_window.overlap(front.alpha)
            bed_share[window_slices] = 1 - front.alpha[image_slices]
        scene_buffers = buffers - {RGB, ALPHA}
        bed_camera, bed = _draw_bed(
            renderer, bed_camera, medium, scene_buffers, margins, shows_water, bed_share
        )
    with timed("flood: mirrored view"):
        mirror = _mirror_layer(renderer, camera, medium, window, shows_water)
    screen = None
    if medium.reflection == "screen_space":
        with timed("flood: screen march"):
            needed = is_smooth(field, crop)  # rough water reflects the mirrored view alone
            layer = as_layer(camera, front)
            screen = trace_screen(layer, crop, medium.level_z_m, needed=needed, backend=backend)
    with timed("flood: shade water"):
        color = shade_water(
            crop,
            cover,
            medium,
            field,
            as_layer(bed_camera, bed),
            mirror=mirror,
            screen=screen,
            sky=sky,
            fog=fog,
            backend=backend,
        )
    with timed("flood: composite layers"):
        image = composite_water(front, camera, window, color, renderer)
        scene = merge_depths(front, bed, bed_window, buffers, backend=backend)
    return FloodedImage(image, scene, water, field=field, window=window)


def _draw_bed(
    renderer: LayerRenderer,
    camera: Camera,
    medium: FloodMedium,
    scene_buffers: frozenset[str],
    margins: Margins,
    shows_water: Bool[Tensor, "h w"],
    bed_share: Float[Tensor, "rows columns"] | None,
) -> tuple[Camera, RenderOutput]:
    """Draw the scene below the surface. Return the layer's camera and its buffers.

    Parts that the front layer hides are left out. If no scene buffers are requested, parts that
    the water hides are left out too, and the camera's pixels may be wider.
    """
    reach = math.inf if scene_buffers else visible_depth_m(medium, camera)
    below = HeightClip(medium.level_z_m, BELOW, reach, has_overlap=True)
    requested = scene_buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    pixel_mask = margins.around(shows_water, margins)
    if medium.layers_px > 1 and not scene_buffers and bed_share is None:
        camera = camera.scaled(1 / medium.layers_px)
        pixel_mask = resized(pixel_mask, camera)
        renderer = renderer.for_scale(1 / medium.layers_px)
    return camera, renderer.render_layer(camera, below, requested, pixel_mask, bed_share)


def visible_depth_m(medium: FloodMedium, camera: Camera) -> float:
    """Return the depth below the surface from which at most `bed_cut` of any colour comes up.

    It is measured along the camera's steepest ray.
    """
    min_extinction_per_m = min(medium.extinction_per_m)
    if min_extinction_per_m == 0:
        return math.inf
    columns = (np.linspace(0, camera.width, NUM_RAYS_PER_SIDE) - camera.cx) / camera.fx
    rows = (np.linspace(0, camera.height, NUM_RAYS_PER_SIDE) - camera.cy) / camera.fy
    u, v = np.meshgrid(columns, rows)
    right, down, ahead = camera.world_from_camera[2, :3].tolist()
    sine = float((-(u * right + v * down + ahead) / np.sqrt(u * u + v * v + 1)).max())
    # Other rays, and rays on tilted waves, may be steeper.
    sine = min(max(sine, 0.0) + SINE_TOLERANCE, 1.0)
    cosine_in_water = math.sqrt(1 - (1 - sine * sine) / medium.refraction_index**2)
    return -math.log(medium.bed_cut) * cosine_in_water / min_extinction_per_m


def _mirror_layer(
    renderer: LayerRenderer,
    camera: Camera,
    medium: FloodMedium,
    window: Window,
    shows_water: Bool[Tensor, "h w"],
) -> Layer | None:
    if medium.reflection == "sky":
        return None
    margins = _mirror_margins(camera, medium)
    mirror_window = mirrored_window(window, camera).grown(margins)
    view = mirror_window.of(mirrored_camera(camera, medium.level_z_m))
    # Within the window tilted waves look as far down as up.
    pixel_mask = margins.around(shows_water.flip(0), replace(margins, bottom=margins.top))
    scale = COARSE if medium.reflection == "screen_space" else 1 / medium.layers_px
    if scale != 1:
        view = view.scaled(scale)
        pixel_mask = resized(pixel_mask, view)
        renderer = renderer.for_scale(scale)
    above = HeightClip(medium.level_z_m, ABOVE, has_overlap=True)
    buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH})
    return as_layer(view, renderer.render_layer(view, above, buffers, pixel_mask))


def _mirror_margins(camera: Camera, medium: FloodMedium) -> Margins:
    """Return the margins around the flat reflection that tilted waves reflect.

    A slope turns the reflected ray by twice its angle, mostly up or down. The side below the
    reflections ends at the horizon, because no reflected ray points below it.
    """
    waves = medium.waves
    slopes = waves.wavenumbers * waves.amplitudes_m
    tilt = 2 * SLOPE_SIGMAS * math.sqrt(float((slopes**2).sum()) / 2)
    max_margin = MAX_MARGIN * max(camera.width, camera.height)
    upwards = int(min(camera.fy * tilt, max_margin)) + 4
    sideways = int(min(0.5 * camera.fx * tilt, max_margin)) + 4
    return Margins(sideways, upwards, sideways, 4)


def _bed_margins(camera: Camera, medium: FloodMedium) -> Margins:
    """Return the margins by which refraction may move the bed in the image.

    The eye is at height h over the water and the bed at depth D. A ray that falls by c per metre is
    bent to fall by 1 per t metres. The straight ray to the same point of the bed falls by
    c (h + D) / (h + c D t). So the image of the bed moves by c D (1 - c t) / (h + c D t) in
    tangents, which is largest for c near MAX_SHIFT_FALL. It moves down in an upright camera.
    """
    height = float(camera.centre[2]) - medium.level_z_m
    depth = min(medium.waves.depth_m, visible_depth_m(medium, camera))
    fall = min(max((camera.height - camera.cy) / camera.fy, 0.1), MAX_SHIFT_FALL)
    sine = 1 / (medium.refraction_index * math.hypot(1, fall))
    metres_per_fall = sine / math.sqrt(1 - sine**2)
    shift = fall * depth * (1 - fall * metres_per_fall) / (height + fall * depth * metres_per_fall)
    return Margins(8, 8, 8, int(min(camera.fy * shift, MAX_SHIFT * camera.height)) + 8)


def _from_below(
    renderer: LayerRenderer, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage:
    """Render the view of an eye under the water or exactly at its surface."""
    requested = buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    with timed("rasterise"):
        front = renderer.without_fog().render_layer(
            camera, HeightClip(medium.level_z_m, BELOW), requested
        )
        above = HeightClip(medium.level_z_m, ABOVE, has_overlap=True)
        air = renderer.render_layer(camera, above, requested)
    layers = as_layer(camera, front), as_layer(camera, air)
    image = view_from_below(*layers, medium, renderer.sky, renderer.fog)
    water = torch.ones((camera.height, camera.width), dtype=torch.bool, device=image.device)
    image_window = Window(0, 0, camera.width, camera.height)
    scene = merge_depths(front, air, image_window, buffers, backend=renderer.backend)
    return FloodedImage(image, scene, water)
