"""Wet ground as an effect: darker splats, and what the film of water on them mirrors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
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
from augment.effects.snow.light import light_of
from augment.effects.snow.support import share_support
from augment.effects.wet.darkening import darkened, linear_of, white_level
from augment.effects.wet.ground import (
    SETTINGS,
    WetGround,
    WetSplats,
    wet_ground,
    wet_splats,
)
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
from augment.ground import check_metric_and_level
from augment.memo import memo_of
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.scene import Gaussians, Scene
from augment.timing import timed
from recipes.rain import Rain
from recipes.schema import Recipe

DARKER, MIRRORED, SHINE = PASSES = (
    "wet ground: darker",
    "wet ground: mirrored view",
    "wet ground: reflection",
)
COARSE = 0.5  # resolution of the mirrored view
LOWERED_M = 0.3  # below the plane: what stands on ground that is no plane is whole
UP_MARGIN = 0.2  # of the image's height, that rough ground looks higher than its mirror


@dataclass(frozen=True)
class PlacedWet:
    """Of a recipe. seed: of the puddles' noise. wetness, puddles: 0 to 1."""

    seed: int
    wetness: float
    puddles: float


class WetEffect(Effect):
    name, section, model = "wet", "weather.rain", Rain
    draws = (MIRRORED,)

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        rain = self.of(recipe)
        if rain is None or rain.wetness_now == 0:
            why = "the recipe has no rain" if rain is None else "the rain leaves the ground dry"
            stages = (SCENE, PICTURE, PICTURE)
            return Placed(None, tuple(Step(n, False, why, s) for n, s in zip(PASSES, stages, strict=True)))
        check_metric_and_level(scene)
        wet = f"wetness {rain.wetness_now:.2g} of what is open to the sky"
        steps = (
            Step(DARKER, True, wet, SCENE),
            Step(MIRRORED, True, "at half the resolution, without the ground", PICTURE),
            Step(SHINE, True, f"{wet}; puddles on {100 * rain.puddles_now:.3g} %", PICTURE),
        )
        data = PlacedWet(recipe.seed, rain.wetness_now, rain.puddles_now)
        return Placed(data, steps, frozenset({EXPECTED_DEPTH}))

    def prepare(self, own: Active) -> WetGround:
        return wet_ground(own.scene, own.data.seed, backend=own.backend)

    def share(self, job: Sharing) -> None:
        found = (self.of(recipe) for recipe in job.recipes)
        if any(rain and rain.wetness_now > 0 for rain in found):
            share_support(job, SETTINGS)

    def cameras(self, own: Active, camera: Camera) -> tuple[Camera, ...] | None:
        plane = _plane(own, camera)
        return None if plane is None else (camera, _mirror_camera(camera, plane))

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
            seen = find_ground(camera, depth, shown, own.prepared)
        if not len(seen.index):
            return drawn
        with timed(MIRRORED):
            mirror = _draw_mirror(own, drawn.layers, camera, plane)
        with timed(SHINE):
            film = Film(own.data.wetness, own.prepared.puddle_level(own.data.puddles))
            rgb = shade_wet(drawn.rgb, camera, seen, film, plane, mirror)
        return replace(drawn, rgb=rgb)


def _plane(own: Active, camera: Camera) -> Plane | None:
    return memo_of(camera).get(("wet plane", own.prepared), lambda: plane_in_view(camera, own.prepared))


def _mirror_camera(camera: Camera, plane: Plane) -> Camera:
    up = int(UP_MARGIN * camera.height)
    view = mirrored_in(camera, plane)
    return view.cropped(0, -up, camera.width, camera.height + up)


def _draw_mirror(own: Active, layers: LayerRenderer, camera: Camera, plane: Plane) -> Mirror:
    view = _mirror_camera(camera, plane).scaled(COARSE)
    splats = wet_splats(own.scene, own.prepared)
    parts = [
        replace(part, gaussians=_without_ground(part.gaussians, splats))
        if part.instance_id == 0
        else part
        for part in layers.parts
        if not part.is_overlay
    ]
    layers = replace(layers, parts=parts, photo=None)
    raster = layers.draw(view, plane.above(LOWERED_M), frozenset({RGB, ALPHA, EXPECTED_DEPTH}))
    rgb = layers.add_sky(raster.rgb, raster.alpha, view)
    depth = torch.where(raster.alpha >= 0.5, raster.expected_depth, 0.0)
    return Mirror(view, blur_upright(linear_of(rgb)), depth)


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
