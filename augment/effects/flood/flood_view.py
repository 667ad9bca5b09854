"""A view of a flooded scene: the layers that are rasterised, and how they become one picture.

For an eye above the water, a point of a ray lies in front of the water exactly if it lies above its
plane. So the scene is drawn in layers that are cut at the plane pixel by pixel
(augment.render.layout),

    front     what lies above, over the whole image
    bed       what lies below, where the plane is in view
    mirror    what lies above, from the eye mirrored in the plane

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

from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.effects.flood import water_kernels
from augment.effects.flood.flood import FloodMedium, Layer, exact
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
from augment.effects.flood.waves import wave_field
from augment.effects.wet.ripples import rings_of, with_rings
from augment.render.buffers import ALPHA, CPU, EXPECTED_DEPTH, RGB, RenderOutput, kernels_for
from augment.render.composite import sky_behind
from augment.render.constants import DEPTH_EPS
from augment.render.fog import Fog, blend_airlight, sky_optical_depth
from augment.render.layout import ABOVE, BELOW, HeightClip
from augment.render.threads import kernel_threads
from augment.sky import Sky, sample_at
from augment.timing import timed

# ---- Layers composited ---------------------------------------------------------------------------


ROWS = 32  # image rows a thread takes at a time


def find_water(
    alpha: Float[Tensor, "H W"], camera: Camera, *, backend: str = CPU
) -> tuple[Bool[Tensor, "H W"], float]:
    """Where a camera above the water sees it first, and the largest share of it in any pixel.

    alpha: of what stands before the water, which is seen where that leaves more than half.
    """
    if kernels_for(backend, alpha) == CPU:
        water = np.empty(tuple(alpha.shape), np.uint8)
        shown = np.empty(len(alpha), np.float32)
        with kernel_threads(ROWS):
            water_kernels.find_water(*_rays(camera), alpha.detach().numpy(), shown, water)
        return torch.from_numpy(water).view(torch.bool), float(shown.max())
    share = torch.where(falling(camera, alpha.device), 1 - alpha, 0)
    return share > 0.5, float(share.max())  # waits for the GPU: what is drawn depends on it


def composite_water(
    front: RenderOutput,
    camera: Camera,
    window: Window,
    color: Float[Tensor, "h w 3"],
    renderer: LayerRenderer,
) -> Float[Tensor, "H W 3"]:
    """front + (1 - front's alpha) times the water's colour where rays fall, the sky's elsewhere.

    color: of the window's pixels. renderer: that drew the front, whose colours the CPU's kernels
    write to.
    """
    assert front.rgb is not None and front.alpha is not None
    rgb = front.rgb
    alpha = front.alpha
    in_place = kernels_for(renderer.backend, rgb, alpha) == CPU
    image = rgb if in_place else rgb.clone()
    dry = _dry_rows(camera)
    both = rgb[window.top : dry].clone()  # rows that show water and sky
    if dry:
        above = camera.cropped(0, 0, camera.width, dry)
        image[:dry] = renderer.add_sky(rgb[:dry], alpha[:dry], above)
    if in_place:
        if window.top < dry:  # what falls belongs to the water
            wet = falling(camera.cropped(0, window.top, camera.width, dry - window.top))
            image[window.top : dry][wet] = both[wet]
        with kernel_threads(ROWS):
            images = alpha.numpy(), color.contiguous().numpy(), image.numpy()
            rays = _rays(window.of(camera))
            water_kernels.composite_water(*rays, window.top, window.left, *images)
        return image
    mixed = window.cut(rgb) + (1 - window.cut(alpha))[..., None] * color
    shared = min(max(dry - window.top, 0), len(mixed))  # rows that show both
    if shared:
        meets = falling(camera.cropped(window.left, window.top, mixed.shape[1], shared), rgb.device)
        mixed[:shared] = torch.where(meets[..., None], mixed[:shared], window.cut(image)[:shared])
    window.cut(image).copy_(mixed)
    return image


def _dry_rows(camera: Camera) -> int:
    """One past the last row in which a ray does not fall."""
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
    """Buffers of two layers as one scene's, colour excepted; behind: what the window shows through
    the water.

    Alpha and expected depth are what one render would give; other buffers are those of the layer
    that covers more of the pixel. backend: the CPU's kernels work in place.
    """
    assert front.alpha is not None and behind.alpha is not None
    requested = buffers - {RGB, ALPHA}
    if not requested:
        return RenderOutput()
    here, there = window.overlap(front.alpha)
    if kernels_for(backend, front.alpha) == CPU:
        values = {name: getattr(front, name) for name in (*requested, ALPHA)}
        alphas = (front.alpha.numpy()[here], behind.alpha.numpy()[there])
        with kernel_threads(ROWS):
            for name in sorted(requested):
                pair = (values[name].numpy()[here], getattr(behind, name).numpy()[there])
                if name == EXPECTED_DEPTH:
                    water_kernels.join_depth(*alphas, *pair, np.float32(DEPTH_EPS))
                else:
                    water_kernels.join_heavier(*alphas, *pair)
            water_kernels.join_alpha(*alphas)
        return RenderOutput(**values)
    alpha = front.alpha[here]
    share = (1 - alpha) * behind.alpha[there]
    total = alpha + share
    merged = {ALPHA: total}
    for name in requested:
        nearer = getattr(front, name)[here]
        other = getattr(behind, name)[there]
        if name == EXPECTED_DEPTH:
            merged[name] = (alpha * nearer + share * other) / total.clamp_min(DEPTH_EPS)
        else:
            merged[name] = torch.where(share > alpha, other, nearer)
    values = {name: getattr(front, name).clone() for name in merged}
    for name, value in merged.items():
        values[name][here] = value
    return RenderOutput(**values)


# ---- The view from under the water, whose surface is taken as flat -------------------------------


def view_from_below(
    front: Layer, air: Layer, medium: FloodMedium, sky: Sky, fog: Fog | None = None
) -> Float[Tensor, "H W 3"]:
    """The picture of an eye at or below the water's surface, not clamped.

    front: what lies under water. air: what lies above, from the same camera. fog: in the air.
    What the surface reflects back down counts as water.
    """
    camera = front.camera
    rgb = front.rgb
    device = front.rgb.device
    lengths = camera.ray_lengths(rgb.dtype, device)
    deep = torch.tensor(medium.rgb, dtype=rgb.dtype, device=device)
    to_bed = transmittance(medium, front.depth * lengths)
    seen = to_bed * rgb + front.alpha[..., None] * (1 - to_bed) * deep

    directions = camera.ray_directions(rgb.dtype, device)
    up = directions[..., 2] / lengths
    bent = _into_air(directions / lengths[..., None], medium.refraction_index)
    reflected = exact(up.clamp_min(0), 1 / medium.refraction_index)[..., None]
    behind, fog = sky_behind(sky, fog)
    sky_rgb = sample_at(behind, bent)
    if fog is not None:
        tau = sky_optical_depth(fog, bent[..., 2], medium.level_z_m)
        sky_rgb = blend_airlight(sky_rgb, tau, fog)
    outside = air.rgb + (1 - air.alpha)[..., None] * sky_rgb
    surface = (1 - reflected) * outside + reflected * deep
    depth = plane_depth(camera, medium.level_z_m, device).to(rgb.dtype)
    meets = depth.isfinite()
    distance = torch.where(meets, depth, torch.zeros_like(depth)) * lengths
    to_surface = transmittance(medium, distance)
    beyond = torch.where(
        meets[..., None], to_surface * surface + (1 - to_surface) * deep, deep.expand_as(surface)
    )
    return seen + (1 - front.alpha)[..., None] * beyond


def transmittance(medium: FloodMedium, length_m: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """exp(-extinction length) per channel; 1 over no length, also where extinction is infinite."""
    extinction = torch.tensor(medium.extinction_per_m, dtype=length_m.dtype, device=length_m.device)
    t = torch.exp(-extinction * length_m[..., None])
    return torch.where((length_m[..., None] == 0) | (extinction == 0), torch.ones_like(t), t)


def _into_air(directions: Float[Tensor, "*B 3"], index: float) -> Float[Tensor, "*B 3"]:
    """Unit directions of rising rays after the surface; level ones beyond the critical angle."""
    flat = index * directions[..., :2]
    rise = (1 - flat.square().sum(-1)).clamp_min(0).sqrt()
    return torch.nn.functional.normalize(torch.cat([flat, rise[..., None]], -1), dim=-1)


# ---- The layers that are drawn -------------------------------------------------------------------

COARSE = 0.25  # resolution of the mirrored view that fills what the screen does not show
REACH_SIGMAS = 3.0  # slopes of the waves that the margins allow for
MAX_MARGIN = 0.25  # of the image's longer side
STEEPEST = 0.65  # fall of the ray whose bed refraction moves the most in the image
MAX_SHIFT = 0.12  # of the image's height
STEEP_PLACES = 17  # along each side of the image, where rays are asked how steep they are
STEEPER = 0.05  # sine of the angle to the horizon that others may have more


@dataclass(frozen=True, eq=False)
class FloodedImage:
    """rgb: with sky and water, not clamped. scene: alpha and the requested buffers of the scene's
    surfaces through the water; empty if only colour and alpha are requested. water: where a ray
    meets water first. is_hidden: the front hides all of it, and nothing else was drawn.
    """

    rgb: Float[Tensor, "H W 3"]
    scene: RenderOutput
    water: Bool[Tensor, "H W"]
    is_hidden: bool = False


def as_layer(camera: Camera, raster: RenderOutput) -> Layer:
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    return Layer(camera, raster.rgb, raster.alpha, raster.expected_depth)


def render_flooded(
    renderer: LayerRenderer, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage | None:
    """The picture of a camera whose image the water's plane may reach; None where it cannot.

    buffers: of the scene's surfaces, as for `rasterize`.
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
        front = renderer.draw(camera, above, requested)
    assert front.rgb is not None and front.alpha is not None
    sky = renderer.sky
    fog = renderer.fog
    backend = renderer.backend
    device = front.alpha.device
    with timed("flood: where it is seen"):
        water, most_shown = find_water(front.alpha, camera, backend=backend)
    if most_shown < 1 - HIDDEN_COVER:
        with timed("sky"):
            image = renderer.add_sky(front.rgb, front.alpha, camera)
        return FloodedImage(image, front, water, is_hidden=True)

    crop = window.of(camera)
    cover = window.cut(front.alpha)
    seen = cover <= HIDDEN_COVER
    with timed("flood: waves"):
        field = wave_field(medium.waves, crop, medium.level_z_m, device=device, backend=backend)
        rings = rings_of(medium.rain_mm_h, medium.seed, camera.timestamp_ns)
        field = with_rings(field, crop, medium.level_z_m, rings, backend=backend)
    margins = _bed_margins(camera, medium)
    bed_window = window.grown(margins)
    bed_camera = bed_window.of(camera)
    with timed("flood: bed"):
        shown = None
        if renderer.photo is not None:  # which shows of the bed what the front leaves free
            shown = torch.zeros(bed_camera.height, bed_camera.width, device=device)
            here, there = bed_window.overlap(front.alpha)
            shown[there] = 1 - front.alpha[here]
        others = buffers - {RGB, ALPHA}
        bed_camera, bed = _draw_bed(renderer, bed_camera, medium, others, margins, seen, shown)
    with timed("flood: mirrored view"):
        mirror = _mirror_layer(renderer, camera, medium, window, seen)
    screen = None
    with timed("flood: screen march"):
        if medium.reflection == "screen_space":
            needed = is_smooth(field, crop)  # rough water takes the mirrored view alone
            layer = as_layer(camera, front)
            screen = trace_screen(layer, crop, medium.level_z_m, needed=needed, backend=backend)
    with timed("flood: colours of the water"):
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
    with timed("flood: layers joined"):
        image = composite_water(front, camera, window, color, renderer)
        scene = merge_depths(front, bed, bed_window, buffers, backend=backend)
    return FloodedImage(image, scene, water)


def _draw_bed(
    renderer: LayerRenderer,
    camera: Camera,
    medium: FloodMedium,
    scene_buffers: frozenset[str],
    margins: Margins,
    seen: Bool[Tensor, "h w"],
    shown: Float[Tensor, "rows columns"] | None,
) -> tuple[Camera, RenderOutput]:
    """What lies below the surface; not what the front hides, nor, in a mere picture, the water.
    With the camera, whose pixels are wider where the picture alone is wanted.
    """
    reach = math.inf if scene_buffers else visible_depth_m(medium, camera)
    below = HeightClip(medium.level_z_m, BELOW, reach, overlaps=True)
    requested = scene_buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    pixel_mask = margins.around(seen, margins)
    if medium.layers_px > 1 and not scene_buffers and shown is None:
        camera = camera.scaled(1 / medium.layers_px)
        pixel_mask = resized(pixel_mask, camera)
        renderer = renderer.for_scale(1 / medium.layers_px)
    return camera, renderer.draw(camera, below, requested, pixel_mask, shown)


def visible_depth_m(medium: FloodMedium, camera: Camera) -> float:
    """Depth below the surface from which no more than the cut comes up of any colour, along the
    camera's steepest ray.
    """
    least = min(medium.extinction_per_m)
    if least == 0:
        return math.inf
    columns = (np.linspace(0, camera.width, STEEP_PLACES) - camera.cx) / camera.fx
    rows = (np.linspace(0, camera.height, STEEP_PLACES) - camera.cy) / camera.fy
    u, v = np.meshgrid(columns, rows)
    right, down, ahead = camera.world_from_camera[2, :3].tolist()
    sine = float((-(u * right + v * down + ahead) / np.sqrt(u * u + v * v + 1)).max())
    sine = min(max(sine, 0.0) + STEEPER, 1.0)  # between those places, and where waves tilt
    inside = math.sqrt(1 - (1 - sine * sine) / medium.refraction_index**2)
    return -math.log(medium.bed_cut) * inside / least


def _mirror_layer(
    renderer: LayerRenderer,
    camera: Camera,
    medium: FloodMedium,
    window: Window,
    seen: Bool[Tensor, "h w"],
) -> Layer | None:
    if medium.reflection == "sky":
        return None
    margins = _mirror_margins(camera, medium)
    place = mirrored_window(window, camera).grown(margins)
    view = place.of(mirrored_camera(camera, medium.level_z_m))
    # Within the window tilted waves look as far down as up.
    pixel_mask = margins.around(seen.flip(0), replace(margins, bottom=margins.top))
    scale = COARSE if medium.reflection == "screen_space" else 1 / medium.layers_px
    if scale != 1:
        view = view.scaled(scale)
        pixel_mask = resized(pixel_mask, view)
        renderer = renderer.for_scale(scale)
    above = HeightClip(medium.level_z_m, ABOVE, overlaps=True)
    buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH})
    return as_layer(view, renderer.draw(view, above, buffers, pixel_mask))


def _mirror_margins(camera: Camera, medium: FloodMedium) -> Margins:
    """What tilted waves look at beyond the flat reflection.

    A slope turns the reflected ray by twice its angle, mostly up or down. The side below the
    reflections is the horizon, beyond which no reflection looks.
    """
    waves = medium.waves
    slopes = waves.wavenumbers * waves.amplitudes_m
    tilt = 2 * REACH_SIGMAS * math.sqrt(float((slopes**2).sum()) / 2)
    most = MAX_MARGIN * max(camera.width, camera.height)
    upwards = int(min(camera.fy * tilt, most)) + 4
    sideways = int(min(0.5 * camera.fx * tilt, most)) + 4
    return Margins(sideways, upwards, sideways, 4)


def _bed_margins(camera: Camera, medium: FloodMedium) -> Margins:
    """By how much refraction may move the bed in the image.

    Seen from a height h, a ray that falls by c per metre meets a bed of depth D, bent to fall by 1
    per t metres, where a straight ray falls by c (h + D) / (h + c D t). So the image moves, down in
    an upright camera's, by c D (1 - c t) / (h + c D t) in tangents, most for c near STEEPEST.
    """
    height = float(camera.centre[2]) - medium.level_z_m
    depth = min(medium.waves.depth_m, visible_depth_m(medium, camera))
    fall = min(max((camera.height - camera.cy) / camera.fy, 0.1), STEEPEST)
    sine = 1 / (medium.refraction_index * math.hypot(1, fall))
    bent = sine / math.sqrt(1 - sine**2)
    shift = fall * depth * (1 - fall * bent) / (height + fall * depth * bent)
    return Margins(8, 8, 8, int(min(camera.fy * shift, MAX_SHIFT * camera.height)) + 8)


def _from_below(
    renderer: LayerRenderer, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage:
    """From under the water, or exactly at its surface."""
    requested = buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    with timed("rasterise"):
        front = renderer.without_fog().draw(camera, HeightClip(medium.level_z_m, BELOW), requested)
        above = HeightClip(medium.level_z_m, ABOVE, overlaps=True)
        air = renderer.draw(camera, above, requested)
    layers = as_layer(camera, front), as_layer(camera, air)
    image = view_from_below(*layers, medium, renderer.sky, renderer.fog)
    water = torch.ones((camera.height, camera.width), dtype=torch.bool, device=image.device)
    whole = Window(0, 0, camera.width, camera.height)
    scene = merge_depths(front, air, whole, buffers, backend=renderer.backend)
    return FloodedImage(image, scene, water)
