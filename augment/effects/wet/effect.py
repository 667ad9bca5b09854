"""Wet ground as an effect: darker splats, and what the film of water on them mirrors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.effects.effect import (
    PICTURE,
    SCENE,
    Active,
    Drawn,
    Effect,
    InView,
    Placed,
    Sharing,
    Sight,
    Step,
)
from augment.effects.lidar.beam import Echoes
from augment.effects.snow.light import light_of
from augment.effects.snow.support import share_support
from augment.effects.wet.darkening import darkened, wet_ratio, white_level
from augment.effects.wet.ground import SETTINGS, WetGround, WetSplats, wet_ground, wet_splats
from augment.effects.wet.lidar import wet_echoes
from augment.effects.wet.reflection import (
    Film,
    Mirror,
    Plane,
    blur_upright,
    find_ground,
    mirrored_in,
    plane_in_view,
    shade_wet,
)
from augment.effects.wet.ripples import rings_of
from augment.ground import check_metric_and_level
from augment.memo import memo_of
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.fog import optical_depth
from augment.scene import Gaussians, Scene
from augment.timing import timed
from recipes.rain import Rain
from recipes.schema import Recipe

DARKER, MIRRORED, SHINE = PASSES = (
    "wet ground: darker",
    "wet ground: mirrored view",
    "wet ground: reflection",
)
LEAST_SEEN = 0.05  # of a photo's ground through fog, below which its colour is not known
STOP = 0.01  # of its transmittance: a film reflects little of what is behind that
SOLID = 0.5  # alpha from which on the mirrored view shows a surface
LOWERED_M = 0.3  # below the plane: what stands on ground that is no plane is whole
LOW_MARGIN_PX = 8
UP_MARGIN = 0.2  # of the image's height, that rough ground looks higher than its mirror


@dataclass(frozen=True)
class PlacedWet:
    """Of a recipe. seed: of the puddles' noise. wetness, puddles: 0 to 1. mirror_px: of the
    picture, that a pixel of the mirrored view is wide.
    """

    seed: int
    wetness: float
    puddles: float
    rate_mm_h: float
    mirror_px: float


class WetEffect(Effect):
    """Ground that rain has wetted: a part of the section that rain in the air is the other of."""

    name, section, model = "wet", "weather.rain", Rain
    draws = (MIRRORED,)
    shares_files = True

    def reads_splats(self, recipe: Recipe) -> bool:
        rain = self.of(recipe)
        return rain is not None and rain.ground_wetness > 0

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        rain = self.of(recipe)
        why = ""
        if rain is None or rain.ground_wetness == 0:
            why = "the recipe has no rain" if rain is None else "the rain leaves the ground dry"
        elif rain.wetness is None and not (scene.has_metric_scale and scene.has_known_gravity):
            why = "wetness is null, and the scene's metres or gravity are not known"
        if rain is None or why:
            stages = (SCENE, PICTURE, PICTURE)
            return Placed(
                None, tuple(Step(n, False, why, s) for n, s in zip(PASSES, stages, strict=True))
            )
        check_metric_and_level(scene)
        wet = f"wetness {rain.ground_wetness:.2g} of what is open to the sky"
        mirrored = f"at 1 / {rain.mirror_px:g} of the resolution, without the ground"
        steps = (
            Step(DARKER, True, wet, SCENE),
            Step(MIRRORED, True, mirrored, PICTURE),
            Step(SHINE, True, f"{wet}; puddles on {100 * rain.puddle_share:.3g} %", PICTURE),
        )
        numbers = rain.ground_wetness, rain.puddle_share, rain.rate_mm_h, rain.mirror_px
        data = PlacedWet(recipe.seed, *numbers)
        return Placed(data, steps, frozenset({EXPECTED_DEPTH}))

    def prepare(self, own: Active) -> WetGround:
        return wet_ground(own.scene, own.data.seed, backend=own.backend)

    def share(self, job: Sharing) -> None:
        found = (self.of(recipe) for recipe in job.recipes)
        if any(rain and rain.ground_wetness > 0 for rain in found):
            share_support(job, SETTINGS)

    def cameras(self, own: Active, camera: Camera) -> tuple[Camera, ...] | None:
        plane = _plane(own, camera)
        return (
            None if plane is None else (camera, _mirror_camera(camera, plane, (0, camera.height)))
        )

    def in_view(self, own: Active, sight: Sight) -> InView:
        if _plane(own, sight.camera) is not None:
            return InView()
        why = "no open ground is in view"
        return InView(skipped=dict.fromkeys((MIRRORED, SHINE), why))

    def edit_scene(self, own: Active, layers: LayerRenderer, camera: Camera) -> LayerRenderer:
        splats = wet_splats(own.scene, own.prepared)
        with timed(DARKER):
            parts = [
                replace(part, gaussians=_wetted(part.gaussians, splats, own))
                if part.instance_id == 0 and not part.is_overlay
                else part
                for part in layers.parts
            ]
        return replace(layers, parts=parts)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        plane = _plane(own, camera)
        depth, alpha = drawn.raster.expected_depth, drawn.raster.alpha
        if plane is None or depth is None or alpha is None:
            return drawn
        shown = alpha if drawn.raster.overlay is None else alpha - drawn.raster.overlay
        for mask in drawn.masks.values():
            shown = torch.where(mask, 0.0, shown)
        with timed(SHINE):
            share, rows = find_ground(camera, depth, shown, own.prepared, backend=own.backend)
        if rows == (0, 0):
            why = "no open ground is seen"
            return replace(drawn, skipped={**drawn.skipped, MIRRORED: why, SHINE: why})
        rgb = drawn.rgb
        if drawn.layers.photo is not None:
            with timed(DARKER):
                rgb = _darken_photo(own, drawn, camera, share)
        with timed(MIRRORED):
            mirror = _draw_mirror(own, drawn.layers, camera, plane, rows)
        with timed(SHINE):
            data = own.data
            rings = rings_of(data.rate_mm_h, data.seed, camera.timestamp_ns)
            film = Film(data.wetness, own.prepared.puddle_level(data.puddles), rings)
            rgb = shade_wet(
                *(rgb, camera, depth, share, own.prepared, film, mirror), backend=own.backend
            )
        return replace(drawn, rgb=rgb)

    def attenuate(self, own: Active, echoes: Echoes, rng: np.random.Generator) -> None:
        wet_echoes(echoes, own.prepared, own.data.wetness, own.data.puddles)


def _plane(own: Active, camera: Camera) -> Plane | None:
    return memo_of(camera).get(
        ("wet plane", own.prepared), lambda: plane_in_view(camera, own.prepared)
    )


def _mirror_camera(camera: Camera, plane: Plane, rows: tuple[int, int]) -> Camera:
    """That sees what the ground in some rows of the image mirrors, and what is above it."""
    view, (first, end) = mirrored_in(camera, plane), rows
    top = camera.height - end - int(UP_MARGIN * camera.height)
    bottom = camera.height - first + LOW_MARGIN_PX
    return view.cropped(0, top, camera.width, bottom - top)


def _draw_mirror(
    own: Active, layers: LayerRenderer, camera: Camera, plane: Plane, rows: tuple[int, int]
) -> Mirror:
    view = _mirror_camera(camera, plane, rows).scaled(1 / own.data.mirror_px)
    splats = wet_splats(own.scene, own.prepared)
    parts = [
        replace(part, gaussians=_without_ground(part.gaussians, splats))
        if part.instance_id == 0
        else part
        for part in layers.unpruned or layers.parts  # pruned for views with the ground in them
        if not part.is_overlay
    ]
    stop = max(STOP, layers.settings.transmittance_stop)
    settings = replace(layers.settings, transmittance_stop=stop)
    layers = replace(layers, parts=parts, photo=None, settings=settings)
    raster = layers.draw(view, plane.above(LOWERED_M), frozenset({RGB, ALPHA, EXPECTED_DEPTH}))
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    rgb = layers.add_sky(raster.rgb, raster.alpha, view)
    depth = raster.expected_depth
    if depth.device.type == "cpu":  # torch's threads would wait for more work meanwhile
        depth.detach().numpy()[raster.alpha.detach().numpy() < SOLID] = 0
    else:
        depth = torch.where(raster.alpha >= SOLID, depth, 0.0)
    return Mirror(view, blur_upright(rgb, backend=own.backend), depth)


def _darken_photo(
    own: Active, drawn: Drawn, camera: Camera, share: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """A recorded picture whose ground is as dark as the splats' is: the part of a pixel's colour
    that comes through the fog.
    """
    photo, fog, rgb = drawn.layers.photo, drawn.layers.fog, drawn.rgb
    assert photo is not None and drawn.raster.expected_depth is not None
    clear, seen = rgb, torch.ones_like(share)
    if fog is not None:
        points = camera.ray_directions(device=rgb.device) * drawn.raster.expected_depth[..., None]
        eye_z_m = float(camera.centre[2])
        seen = torch.exp(
            -optical_depth(fog, points.norm(dim=-1), eye_z_m, eye_z_m + points[..., 2])
        )
        airlight = photo.airlight(fog)
        clear = (rgb - (1 - seen)[..., None] * airlight) / seen.clamp_min(LEAST_SEEN)[..., None]
    white = white_level(light_of(own.light))
    ratio = wet_ratio(clear.clamp_min(0), white, own.data.wetness * share)
    return rgb + seen[..., None] * clear * (ratio - 1)


def _wetted(own: Gaussians, splats: WetSplats, active: Active) -> Gaussians:
    wetness = active.data.wetness
    white = white_level(light_of(active.light))
    return memo_of(own).get(
        ("wetted", wetness, white, splats), lambda: darkened(own, wetness * splats.wet, white)
    )


def _without_ground(own: Gaussians, splats: WetSplats) -> Gaussians:
    return memo_of(own).get(
        ("without ground", splats),
        lambda: replace(own, opacities=torch.where(splats.is_ground, 0.0, own.opacities)),
    )
