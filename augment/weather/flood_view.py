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

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import AUTO, CUDA
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.clip import ABOVE, BELOW, HeightClip
from augment.render.composite import composite_sky
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians
from augment.sky import Sky
from augment.stopwatch import lap
from augment.weather.flood import FloodMedium, Layer
from augment.weather.pour import both_sides, find_water, pour
from augment.weather.screen_space import ScreenReflection, trace_screen
from augment.weather.smog import SmogMedium, fog_raster
from augment.weather.submerged import view_from_below
from augment.weather.water import HIDDEN_COVER, shade_water
from augment.weather.water_plane import (
    Margins,
    Window,
    mirrored_camera,
    mirrored_window,
    plane_window,
    resized,
)
from augment.weather.water_surface import is_smooth
from augment.weather.wave_field import wave_field
from augment.weather.waves import WaveField

COARSE = 0.25  # resolution of the mirrored view that fills what the screen does not show
REACH_SIGMAS = 3.0  # slopes of the waves that the margins allow for
MOST_MARGIN = 0.25  # of the image's longer side
STEEPEST = 0.65  # fall of the ray whose bed refraction moves the most in the image
MOST_SHIFT = 0.12  # of the image's height


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
    def medium(self) -> SmogMedium | None:
        return self.smog or self.smog_on_buffers

    def draw(
        self,
        camera: Camera,
        clip: HeightClip,
        buffers: frozenset[str],
        wanted: Bool[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """The layer's buffers; its colours are seen through the smog. wanted: as for rasterize."""
        if self.smog_on_buffers is not None:
            buffers = buffers | {EXPECTED_DEPTH}
        raster = rasterize(
            self.parts,
            camera,
            buffers=buffers,
            settings=self.settings,
            smog=self.smog,
            clip=clip,
            wanted=wanted,
            backend=self.backend,
        )
        if self.smog_on_buffers is None:
            return raster
        return replace(raster, rgb=fog_raster(raster, camera, self.smog_on_buffers))

    def layer(
        self, camera: Camera, clip: HeightClip, wanted: Bool[Tensor, "H W"] | None = None
    ) -> Layer:
        buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH})
        return as_layer(camera, self.draw(camera, clip, buffers, wanted))


@dataclass(frozen=True, eq=False)
class FloodedImage:
    """rgb [H, W, 3]: with sky and water, not clamped. scene: buffers of the scene's own surfaces,
    through the water where there is some: those asked for, with alpha, if any besides colour and
    alpha are. water [H, W]: where a ray meets water first. is_hidden: whether what stands before
    the water hides all of it, so that only the front was drawn.
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
    with lap("rasterise"):
        front = painter.draw(camera, above, wanted)
    assert front.rgb is not None and front.alpha is not None
    sky, smog = painter.sky, painter.medium
    backend = _follows(painter.backend, front.alpha)
    with lap("flood: where it is seen"):
        water, most_shown = find_water(front.alpha, camera, backend=backend)
    if most_shown < 1 - HIDDEN_COVER:
        with lap("sky"):
            image = composite_sky(front.rgb, front.alpha, camera, sky, smog=smog, backend=backend)
        return FloodedImage(image, front, water, is_hidden=True)

    crop = window.of(camera)
    cover = window.cut(front.alpha)
    seen = cover <= HIDDEN_COVER
    with lap("flood: waves"):
        field = wave_field(medium.waves, crop, medium.level_z_m, backend=backend)
    margins = _bed_margins(camera, medium)
    bed_window = window.grown(margins)
    bed_camera = bed_window.of(camera)
    with lap("flood: bed"):
        bed = _draw_bed(painter, bed_camera, medium, buffers - {RGB, ALPHA}, margins, seen)
    with lap("flood: mirrored view"):
        mirror = _mirror_layer(painter, camera, medium, window, seen)
    with lap("flood: screen march"):
        screen = _screen_reflection(camera, medium, crop, field, front, backend)
    with lap("flood: colours of the water"):
        color = shade_water(
            crop,
            cover,
            medium,
            field,
            as_layer(bed_camera, bed),
            mirror=mirror,
            screen=screen,
            sky=sky,
            smog=smog,
            backend=backend,
        )
    with lap("flood: layers joined"):
        image = pour(front, camera, window, color, sky, smog, backend=backend)
        scene = both_sides(front, bed, bed_window, buffers, backend=backend)
    return FloodedImage(image, scene, water)


def _follows(backend: str, image: Tensor) -> str:
    """The backend of passes without an image of their own: where layers lie on a GPU, theirs."""
    follows = backend == AUTO and image.device.type != "cpu"
    return CUDA if follows else backend


def _draw_bed(
    painter: Painter,
    camera: Camera,
    medium: FloodMedium,
    scene_buffers: frozenset[str],
    margins: Margins,
    seen: Bool[Tensor, "h w"],
) -> RenderOutput:
    """What lies below the surface, but for what the front hides, and, where only a picture is
    needed, what the water does.
    """
    reach = math.inf if scene_buffers else visible_depth_m(medium)
    below = HeightClip(medium.level_z_m, BELOW, reach, overlaps=True)
    wanted = scene_buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    return painter.draw(camera, below, wanted, margins.around(seen, margins))


def visible_depth_m(medium: FloodMedium) -> float:
    """Depth below the surface from which less than 1/512 of any colour comes up."""
    least = min(medium.extinction_per_m)
    return math.log(512) / least if least > 0 else math.inf


def _mirror_layer(
    painter: Painter,
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
    wanted = margins.around(seen.flip(0), replace(margins, bottom=margins.top))
    if medium.reflection == "screen_space":
        view = view.scaled(COARSE)
        wanted = resized(wanted, view)
    above = HeightClip(medium.level_z_m, ABOVE, overlaps=True)
    return painter.layer(view, above, wanted)


def _screen_reflection(
    camera: Camera,
    medium: FloodMedium,
    crop: Camera,
    field: WaveField,
    front: RenderOutput,
    backend: str,
) -> ScreenReflection | None:
    if medium.reflection != "screen_space":
        return None
    needed = is_smooth(field, crop)  # rough water takes the mirrored view alone
    layer = as_layer(camera, front)
    return trace_screen(layer, crop, medium.level_z_m, needed=needed, backend=backend)


def _mirror_margins(camera: Camera, medium: FloodMedium) -> Margins:
    """What tilted waves look at beyond the flat reflection.

    A slope turns the reflected ray by twice its angle, mostly up or down, where the reflections are
    drawn out. The side below the reflections is the horizon, beyond which no reflection looks.
    """
    waves = medium.waves
    slopes = waves.wavenumbers * waves.amplitudes_m
    tilt = 2 * REACH_SIGMAS * math.sqrt(float((slopes**2).sum()) / 2)
    most = MOST_MARGIN * max(camera.width, camera.height)
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
    depth = min(medium.waves.depth_m, visible_depth_m(medium))
    fall = min(max((camera.height - camera.cy) / camera.fy, 0.1), STEEPEST)
    sine = 1 / (medium.refraction_index * math.hypot(1, fall))
    bent = sine / math.sqrt(1 - sine**2)
    shift = fall * depth * (1 - fall * bent) / (height + fall * depth * bent)
    return Margins(8, 8, 8, int(min(camera.fy * shift, MOST_SHIFT * camera.height)) + 8)


def _from_below(
    painter: Painter, camera: Camera, medium: FloodMedium, buffers: frozenset[str]
) -> FloodedImage:
    """From under the water, or exactly at its surface."""
    wanted = buffers | {RGB, ALPHA, EXPECTED_DEPTH}
    in_air = replace(painter, smog=None, smog_on_buffers=None)
    with lap("rasterise"):
        front = in_air.draw(camera, HeightClip(medium.level_z_m, BELOW), wanted)
        above = HeightClip(medium.level_z_m, ABOVE, overlaps=True)
        air = painter.draw(camera, above, wanted)
    image = view_from_below(
        as_layer(camera, front), as_layer(camera, air), medium, painter.sky, painter.medium
    )
    size = (camera.height, camera.width)
    water = torch.ones(size, dtype=torch.bool, device=image.device)
    whole = Window(0, 0, camera.width, camera.height)
    scene = both_sides(front, air, whole, buffers, backend=painter.backend)
    return FloodedImage(image, scene, water)
