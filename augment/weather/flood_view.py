"""A view of a flooded scene: the layers that are rasterised, and how they become one picture.

For an eye above the water, a point of a ray lies in front of the water exactly if it lies above its
plane. So nothing has to be guessed from a depth image: the scene is drawn in layers that are cut at
the plane pixel by pixel (augment.render.clip),

    front     what lies above, over the whole image
    bed       what lies below, where the plane is in view
    mirror    what lies above, from the eye mirrored in the plane

    picture = front + (1 - front's alpha) (water, where the ray meets the plane, else the sky)

and nothing in front of the water can leak into refraction or reflection.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, SPLAT_IDS, RenderOutput
from augment.render.clip import ABOVE, BELOW, HeightClip
from augment.render.composite import composite_sky
from augment.render.constants import DEPTH_EPS, RasterSettings
from augment.render.rasterize import REFERENCE, rasterize
from augment.scene import PosedGaussians
from augment.sky import Sky
from augment.weather.flood import FloodMedium, Layer
from augment.weather.screen_space import ScreenReflection, trace_screen
from augment.weather.smog import SmogMedium, fog_raster
from augment.weather.submerged import view_from_below
from augment.weather.water import shade_water
from augment.weather.water_plane import (
    Window,
    mirrored_camera,
    mirrored_window,
    plane_depth,
    plane_window,
)
from augment.weather.wave_field import wave_field
from augment.weather.waves import WaveField

# No water is in view where no pixel shows more of it. Opaque surfaces let up to 4 % through: a splat
# that would bring transmittance to 1e-4 is not blended, whatever is left before it.
VISIBLE = 0.05
COARSE = 0.25  # resolution of the mirrored view that fills what the screen does not show
REACH_SIGMAS = 3.0  # slopes of the waves that the margins allow for
MOST_MARGIN = 0.25  # of the image's longer side


@dataclass(frozen=True, eq=False)
class Painter:
    """Draws the parts of a scene on one side of a level plane.

    smog: blended per Gaussian. smog_on_buffers: applied to finished layers; at most one is set.
    """

    parts: Sequence[PosedGaussians]
    sky: Sky
    settings: RasterSettings
    smog: SmogMedium | None
    smog_on_buffers: SmogMedium | None
    backend: str

    @property
    def fast(self) -> bool:
        return self.backend != REFERENCE

    @property
    def medium(self) -> SmogMedium | None:
        return self.smog or self.smog_on_buffers

    def draw(self, camera: Camera, clip: HeightClip, buffers: frozenset[str]) -> RenderOutput:
        """The layer's buffers; its colours are seen through the smog."""
        if self.smog_on_buffers is not None:
            buffers = buffers | {EXPECTED_DEPTH}
        raster = rasterize(
            self.parts,
            camera,
            buffers=buffers,
            settings=self.settings,
            smog=self.smog,
            clip=clip,
            backend=self.backend,
        )
        if self.smog_on_buffers is None:
            return raster
        return dataclasses.replace(raster, rgb=fog_raster(raster, camera, self.smog_on_buffers))

    def layer(self, camera: Camera, clip: HeightClip) -> Layer:
        return as_layer(camera, self.draw(camera, clip, frozenset({RGB, ALPHA, EXPECTED_DEPTH})))


@dataclass(frozen=True, eq=False)
class FloodedImage:
    """rgb [H, W, 3]: with sky and water, not clamped. scene: the buffers of the scene's own
    surfaces, through the water where there is some. water [H, W]: where a ray meets water first.
    water_depth_m [H, W]: z of the water's surface there, 0 elsewhere.
    """

    rgb: Float[Tensor, "H W 3"]
    scene: RenderOutput
    water: Bool[Tensor, "H W"]
    water_depth_m: Float[Tensor, "H W"]


def as_layer(camera: Camera, raster: RenderOutput) -> Layer:
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    return Layer(camera, raster.rgb, raster.alpha, raster.expected_depth)


def render_flooded(
    painter: Painter, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage | None:
    """The picture of a camera whose image the water's plane may reach; None where it cannot.

    buffers: of the scene's surfaces, as for `rasterize`.
    """
    window = plane_window(camera, medium.level_z_m)
    if float(camera.centre[2]) <= medium.level_z_m:
        return _from_below(painter, camera, medium, buffers)
    if window is None:
        return None
    return _from_above(painter, camera, medium, buffers, window)


def _from_above(
    painter: Painter,
    camera: Camera,
    medium: FloodMedium,
    buffers: frozenset[str],
    window: Window,
) -> FloodedImage:
    above = HeightClip(medium.level_z_m, ABOVE)
    wanted = buffers | {RGB, ALPHA}
    if medium.reflection == "screen_space":
        wanted = wanted | {EXPECTED_DEPTH}
    front = painter.draw(camera, above, wanted)
    assert front.rgb is not None and front.alpha is not None
    surface = plane_depth(camera, medium.level_z_m).to(front.rgb.dtype)
    shown = torch.where(surface.isfinite(), 1 - front.alpha, torch.zeros_like(front.alpha))
    image = composite_sky(
        front.rgb, front.alpha, camera, painter.sky, smog=painter.medium, fast=painter.fast
    )
    water = shown > 0.5
    depth = torch.where(water, surface, torch.zeros_like(surface))
    if bool((shown <= VISIBLE).all()):
        return FloodedImage(image, front, water, depth)

    crop = window.of(camera)
    field = wave_field(medium.waves, crop, medium.level_z_m, fast=painter.fast)
    bed_window = window.grown(*_bed_margins(camera, medium, window))
    bed_camera = bed_window.of(camera)
    below = HeightClip(medium.level_z_m, BELOW)
    bed = painter.draw(bed_camera, below, buffers | {RGB, ALPHA, EXPECTED_DEPTH})
    color = shade_water(
        crop,
        window.cut(front.alpha),
        medium,
        field,
        as_layer(bed_camera, bed),
        mirror=_mirror_layer(painter, camera, medium, window, field),
        screen=_screen_reflection(painter, camera, medium, crop, front),
        sky=painter.sky,
        smog=painter.medium,
        fast=painter.fast,
    )
    alpha = window.cut(front.alpha)[..., None]
    mixed = window.cut(front.rgb) + (1 - alpha) * color
    meets = window.cut(surface).isfinite()[..., None]
    window.paste(image, torch.where(meets, mixed, window.cut(image)))
    return FloodedImage(image, _both_sides(front, bed, bed_window), water, depth)


def _mirror_layer(
    painter: Painter, camera: Camera, medium: FloodMedium, window: Window, field: WaveField
) -> Layer | None:
    if medium.reflection == "sky":
        return None
    mirrored = mirrored_camera(camera, medium.level_z_m)
    place = mirrored_window(window, camera).grown(*_mirror_margins(camera, field))
    view = place.of(mirrored)
    if medium.reflection == "screen_space":
        view = view.scaled(COARSE)
    return painter.layer(view, HeightClip(medium.level_z_m, ABOVE))


def _screen_reflection(
    painter: Painter, camera: Camera, medium: FloodMedium, crop: Camera, front: RenderOutput
) -> ScreenReflection | None:
    if medium.reflection != "screen_space":
        return None
    layer = as_layer(camera, front)
    return trace_screen(layer, crop, medium.level_z_m, fast=painter.fast)


def _mirror_margins(camera: Camera, field: WaveField) -> tuple[int, int, int, int]:
    """Pixels left, above, right and below that tilted waves look beyond the flat reflection.

    A slope turns the reflected ray by twice its angle, mostly up or down, where the reflections are
    drawn out. The side below the reflections is the horizon, beyond which no reflection looks.
    """
    slopes = field.normal_x.square() + field.normal_y.square() + field.slope_variance
    tilt = 2 * REACH_SIGMAS * float((slopes.mean() / 2).sqrt()) if slopes.numel() else 0.0
    most = MOST_MARGIN * max(camera.width, camera.height)
    upwards = int(min(camera.fy * tilt, most)) + 4
    sideways = int(min(0.5 * camera.fx * tilt, most)) + 4
    return sideways, upwards, sideways, 4


def _bed_margins(camera: Camera, medium: FloodMedium, window: Window) -> tuple[int, int, int, int]:
    """Pixels left, above, right and below by which refraction may move the bed.

    A bent ray meets a bed of depth D nearer to the eye, at height h, than a straight one, by less
    than D / (h + D) in tangents. Only where the plane lies below the image's lower border does it
    leave the image.
    """
    height = float(camera.centre[2]) - medium.level_z_m
    depth = medium.waves.depth_m
    reach = min(camera.fy * depth / (height + depth) * 0.5, 0.12 * camera.height)
    return 8, 8, 8, int(reach) + 8


def _from_below(
    painter: Painter, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage:
    """From under the water, or exactly at its surface."""
    wanted = buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    in_air = dataclasses.replace(painter, smog=None, smog_on_buffers=None)
    front = in_air.draw(camera, HeightClip(medium.level_z_m, BELOW), wanted)
    air = painter.draw(camera, HeightClip(medium.level_z_m, ABOVE), wanted)
    image = view_from_below(
        as_layer(camera, front), as_layer(camera, air), medium, painter.sky, painter.medium
    )
    water = torch.ones(camera.height, camera.width, dtype=torch.bool)
    whole = Window(0, 0, camera.width, camera.height)
    nothing = torch.zeros(camera.height, camera.width, dtype=image.dtype)
    return FloodedImage(image, _both_sides(front, air, whole), water, nothing)


def _both_sides(front: RenderOutput, behind: RenderOutput, window: Window) -> RenderOutput:
    """Buffers of both layers as one scene's, without what the water does to them.

    Alpha and expected depth are what one render would give. Median depth and the heaviest splat
    are those of the layer that covers more of the pixel.
    """
    assert front.alpha is not None and behind.alpha is not None
    covered = torch.zeros_like(front.alpha)
    window.paste(covered, behind.alpha)
    share = (1 - front.alpha) * covered
    alpha = front.alpha + share
    hidden = share > front.alpha
    values: dict[str, Tensor] = {ALPHA: alpha}
    for field in dataclasses.fields(RenderOutput):
        nearer, farther = getattr(front, field.name), getattr(behind, field.name)
        if field.name in (RGB, ALPHA) or nearer is None or farther is None:
            continue
        other = torch.full_like(nearer, -1) if field.name == SPLAT_IDS else torch.zeros_like(nearer)
        window.paste(other, farther)
        if field.name == EXPECTED_DEPTH:
            total = front.alpha * nearer + share * other
            values[field.name] = total / alpha.clamp_min(DEPTH_EPS)
        else:
            values[field.name] = torch.where(hidden, other, nearer)
    return RenderOutput(**values)
