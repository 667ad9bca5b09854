"""Wet ground as an effect: darker splats, and reflections in the film of water on them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.effect import (
    PICTURE,
    SCENE,
    Effect,
    EffectInScene,
    EffectPlan,
    JobContext,
    RenderedView,
    Step,
    ViewQuery,
    Visibility,
)
from augment.effects.lidar.beam import Echoes
from augment.effects.wet.darkening import darken_gaussians, wet_ratio, white_level
from augment.effects.wet.drying import RoadFilm, drying_map, road_film
from augment.effects.wet.ground_map import (
    EXPOSURE_SETTINGS,
    WetGround,
    WetSplats,
    refusing_cell_size,
    wet_ground,
    wet_splats,
)
from augment.effects.wet.lidar import dim_echoes_by_film, dim_wet_echoes
from augment.effects.wet.mirroring_film import mirroring_film
from augment.effects.wet.reflection import (
    Film,
    Mirror,
    Plane,
    blur_upright,
    find_ground,
    mirror_camera,
    plane_in_view,
    shade_wet,
    wet_by_film,
)
from augment.effects.wet.ripples import make_rings
from augment.exposure.exposed_surface import share_exposed_surface
from augment.light.scene_light import find_scene_light
from augment.memo import memo_of
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.fog import airlight_gain
from augment.render.fog_image import image_optical_depth
from augment.scene.cameras import Camera
from augment.scene.ground import check_metric_and_level
from augment.scene.scene import Gaussians, Scene
from augment.timing import timed
from augment.view.layers import LayerRenderer
from recipes.rain import Rain
from recipes.schema import Recipe

# Labels of the passes, in plans and timings.
DARKENING_PASS, MIRROR_PASS, REFLECTION_PASS = PASSES = (
    "wet ground: darkening",
    "wet ground: mirrored view",
    "wet ground: reflection",
)
# Least transmittance of fog at which a photo's ground has a known colour.
MIN_PHOTO_TRANSMITTANCE = 0.05
# Transmittance at which rendering of the mirrored view stops; a film reflects little of what lies
# behind.
MIRROR_TRANSMITTANCE_STOP = 0.01
MIN_SURFACE_ALPHA = 0.5  # least alpha at which the mirrored view shows a surface
# Depth below the plane down to which things are mirrored, so that they stay whole on uneven ground.
CLIP_DEPTH_M = 0.3
LOWER_MARGIN_PX = 8  # rows below the mirrored rows
# Rows above them, in the image's height: rough ground mirrors higher things, too.
UPPER_MARGIN_SHARE = 0.2


@dataclass(frozen=True)
class WetGroundPlan:
    """Wet ground of a recipe."""

    seed: int  # seed of the puddles' noise
    wetness: float  # 0 to 1
    puddle_share: float  # share of the ground under puddles, 0 to 1
    rate_mm_h: float  # rate of the rain
    mirror_px: float  # width of a pixel of the mirrored view, in pixels of the picture
    film: RoadFilm | None  # water on the road at this moment; None if it has no history

    def puddle_threshold(self, ground: WetGround) -> float:
        """Return the value of PUDDLE_ORDER above which water stands."""
        if self.film is None:
            return ground.find_puddle_threshold(self.puddle_share)
        return ground.interpolate_puddle_threshold(self.puddle_share)


class WetEffect(Effect):
    """Wet ground. Shares the recipe section `weather.rain` with `RainEffect`."""

    name = "wet"
    section = "weather.rain"
    model = Rain
    raster_passes = (MIRROR_PASS,)
    precomputes_files = True
    kernel_folders = ("augment.exposure",)

    def kernel_key(self, section: Rain) -> Hashable:
        return section.road is not None if section.wets_ground else None

    def reads_splats(self, recipe: Recipe) -> bool:
        rain = self.section_of(recipe)
        return rain is not None and rain.wets_ground

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        rain = self.section_of(recipe)
        reason = ""
        if rain is None or not rain.wets_ground:
            reason = "the recipe has no rain" if rain is None else "the rain leaves the ground dry"
        elif rain.wetness is None and not (scene.has_metric_scale and scene.has_known_gravity):
            reason = "wetness is null, and the scene's metres or gravity are not known"
        if rain is None or reason:
            stages = (SCENE, PICTURE, PICTURE)
            return EffectPlan(
                None, tuple(Step(n, False, reason, s) for n, s in zip(PASSES, stages, strict=True))
            )
        check_metric_and_level(scene)
        wet_description = f"wetness {rain.ground_wetness:.2g} of what is open to the sky"
        mirror_px = recipe.render.speed.mirror_px
        mirror_description = f"at 1 / {mirror_px:g} of the resolution, without the ground"
        if rain.road is not None:
            wet_description = f"{rain.road.film_mm:.2g} mm of water on the road"
        steps = (
            Step(DARKENING_PASS, True, wet_description, SCENE if rain.road is None else PICTURE),
            Step(MIRROR_PASS, True, mirror_description, PICTURE),
            Step(
                REFLECTION_PASS,
                True,
                f"{wet_description}; puddles on {100 * rain.puddle_share:.3g} %",
                PICTURE,
            ),
        )
        film = road_film(rain)
        data = WetGroundPlan(
            seed=recipe.seed,
            wetness=rain.ground_wetness if film is None else film.puddle_wetness,
            puddle_share=rain.puddle_share,
            rate_mm_h=rain.rate_mm_h,
            mirror_px=mirror_px,
            film=film,
        )
        return EffectPlan(data, steps, frozenset({EXPECTED_DEPTH}))

    def prepare(self, effect: EffectInScene) -> WetGround:
        return wet_ground(effect.scene, effect.settings.seed, backend=effect.backend)

    def precompute(self, context: JobContext) -> None:
        """Find where rain can fall, once for the job."""
        rains = (self.section_of(recipe) for recipe in context.recipes)
        if any(rain and rain.wets_ground for rain in rains):
            with refusing_cell_size():
                share_exposed_surface(
                    context.scene,
                    EXPOSURE_SETTINGS,
                    cameras=context.cameras,
                    folder=context.folder,
                    backend=context.backend,
                    progress=context.progress,
                )

    def cameras(self, effect: EffectInScene, camera: Camera) -> tuple[Camera, ...] | None:
        plane = _find_plane(effect, camera)
        return (
            None if plane is None else (camera, _mirror_camera(camera, plane, (0, camera.height)))
        )

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        if _find_plane(effect, query.camera) is not None:
            return Visibility()
        reason = "no open ground is in view"
        return Visibility(skip_reasons=dict.fromkeys((MIRROR_PASS, REFLECTION_PASS), reason))

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        if effect.settings.film is not None:  # the picture is darkened, place by place
            return layers
        splats = wet_splats(effect.scene, effect.prepared_data)
        with timed(DARKENING_PASS):
            parts = [
                replace(part, gaussians=_darken_part(part.gaussians, splats, effect))
                if part.instance_id == 0 and not part.is_overlay
                else part
                for part in layers.parts
            ]
        return replace(layers, parts=parts)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        plane = _find_plane(effect, camera)
        depth = view.raster.expected_depth
        alpha = view.raster.alpha
        if plane is None or depth is None or alpha is None:
            return view
        visible_alpha = alpha if view.raster.overlay is None else alpha - view.raster.overlay
        for mask in view.masks.values():
            visible_alpha = torch.where(mask, 0.0, visible_alpha)
        with timed(REFLECTION_PASS):
            share, rows = find_ground(
                camera, depth, visible_alpha, effect.prepared_data, backend=effect.backend
            )
        if rows == (0, 0):
            reason = "no open ground is seen"
            return replace(
                view,
                skip_reasons={**view.skip_reasons, MIRROR_PASS: reason, REFLECTION_PASS: reason},
            )
        rgb = view.rgb
        if effect.settings.film is not None:
            with timed(DARKENING_PASS):
                rgb, share = _wet_by_film(effect, view, camera, share)
            if not bool(share.any()):
                skip_reasons = dict.fromkeys((MIRROR_PASS, REFLECTION_PASS), "no film mirrors")
                return replace(view, rgb=rgb, skip_reasons={**view.skip_reasons, **skip_reasons})
        elif view.layers.photo is not None:
            with timed(DARKENING_PASS):
                rgb = _darken_photo(effect, view, camera, share)
        with timed(MIRROR_PASS):
            mirror = _render_mirror(effect, view.layers, camera, plane, rows)
        with timed(REFLECTION_PASS):
            data = effect.settings
            rings = make_rings(data.rate_mm_h, data.seed, camera.timestamp_ns)
            film = Film(data.wetness, data.puddle_threshold(effect.prepared_data), rings)
            ground_rows = slice(*rows)
            unmirrored_rgb = rgb[ground_rows].clone() if view.layers.needs_lamp_inputs else None
            rgb = shade_wet(
                rgb,
                camera,
                depth,
                share,
                effect.prepared_data,
                film,
                mirror,
                backend=effect.backend,
            )
            view = replace(view, rgb=rgb)
        if unmirrored_rgb is None:
            return view
        with timed("wet ground: water under lamps"):
            road = mirroring_film(
                camera, depth, share, effect.prepared_data, film, plane, data.rate_mm_h
            )
            far_waters = (water.without(road.share > 0) for water in view.waters)
            mirrored_rgb = rgb[ground_rows] - unmirrored_rgb
        return replace(
            view, waters=(*far_waters, road), mirrored_rgb=mirrored_rgb, mirrored_rows=rows
        )

    def attenuate_beams(
        self, effect: EffectInScene, echoes: Echoes, rng: np.random.Generator
    ) -> None:
        data: WetGroundPlan = effect.settings
        ground: WetGround = effect.prepared_data
        if data.film is None:
            dim_wet_echoes(echoes, ground, data.wetness, data.puddle_share)
        else:
            order = drying_map(ground, data.seed)
            dim_echoes_by_film(echoes, ground, order, data.film, data.puddle_threshold(ground))


def _find_plane(wet_effect: EffectInScene, camera: Camera) -> Plane | None:
    """Return the plane of the ground in view, remembered with the camera."""
    return memo_of(camera).get(
        ("wet plane", wet_effect.prepared_data),
        lambda: plane_in_view(camera, wet_effect.prepared_data),
    )


def _mirror_camera(camera: Camera, plane: Plane, rows: tuple[int, int]) -> Camera:
    """Return a camera that sees what the ground in rows of the image mirrors, and more above."""
    view = mirror_camera(camera, plane)
    (first_row, end_row) = rows
    top = camera.height - end_row - int(UPPER_MARGIN_SHARE * camera.height)
    bottom = camera.height - first_row + LOWER_MARGIN_PX
    return view.cropped(0, top, camera.width, bottom - top)


def _render_mirror(
    wet_effect: EffectInScene,
    layers: LayerRenderer,
    camera: Camera,
    plane: Plane,
    rows: tuple[int, int],
) -> Mirror:
    """Render the mirrored view."""
    view = _mirror_camera(camera, plane, rows).scaled(1 / wet_effect.settings.mirror_px)
    splats = wet_splats(wet_effect.scene, wet_effect.prepared_data)
    parts = [
        replace(part, gaussians=_remove_ground(part.gaussians, splats))
        if part.instance_id == 0
        else part
        for part in layers.unpruned_parts
        or layers.parts  # the pruned parts are for views with the ground in them
        if not part.is_overlay
    ]
    stop = max(MIRROR_TRANSMITTANCE_STOP, layers.settings.transmittance_stop)
    settings = replace(layers.settings, transmittance_stop=stop)
    layers = replace(layers, parts=parts, photo=None, settings=settings)
    raster = layers.render_layer(
        view, plane.above(CLIP_DEPTH_M), frozenset({RGB, ALPHA, EXPECTED_DEPTH})
    )
    assert raster.rgb is not None and raster.alpha is not None
    assert raster.expected_depth is not None
    rgb = layers.add_sky(raster.rgb, raster.alpha, view)
    depth = raster.expected_depth
    if depth.device.type == "cpu":  # torch's threads would wait for more work meanwhile
        depth.detach().numpy()[raster.alpha.detach().numpy() < MIN_SURFACE_ALPHA] = 0
    else:
        depth = torch.where(raster.alpha >= MIN_SURFACE_ALPHA, depth, 0.0)
    return Mirror(view, blur_upright(rgb, backend=wet_effect.backend), depth)


def _darken_photo(
    wet_effect: EffectInScene, view: RenderedView, camera: Camera, share: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """Darken the ground of a recorded picture as its splats are darkened.

    Only the part of a pixel's colour that comes through the fog is darkened.
    """
    clear_rgb, transmittance = _without_fog(view, camera)
    white = white_level(find_scene_light(wet_effect.lit_scene))
    ratio = wet_ratio(clear_rgb.clamp_min(0), white, wet_effect.settings.wetness * share)
    return view.rgb + transmittance[..., None] * clear_rgb * (ratio - 1)


def _wet_by_film(
    wet_effect: EffectInScene, view: RenderedView, camera: Camera, share: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Return the picture darkened by the film on the road, and the share that mirrors."""
    data: WetGroundPlan = wet_effect.settings
    ground: WetGround = wet_effect.prepared_data
    assert data.film is not None and view.raster.expected_depth is not None
    clear_rgb = view.rgb
    transmittance = None
    if view.layers.fog is not None:
        clear_rgb, transmittance = _without_fog(view, camera)
    is_shared = view.layers.photo is not None or transmittance is not None
    wet_rgb, mirror_share = wet_by_film(
        clear_rgb.clone() if is_shared else clear_rgb,
        camera,
        view.raster.expected_depth,
        share,
        ground,
        drying_map(ground, data.seed),
        data.film,
        data.puddle_threshold(ground),
        white_level(find_scene_light(wet_effect.lit_scene)),
        backend=wet_effect.backend,
    )
    if transmittance is not None:
        wet_rgb = view.rgb + transmittance[..., None] * (wet_rgb - clear_rgb)
    return wet_rgb, mirror_share


def _without_fog(
    view: RenderedView, camera: Camera
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Return the picture's surfaces without the fog before them, and the fog's transmittance."""
    photo = view.layers.photo
    fog = view.layers.fog
    rgb = view.rgb
    depth = view.raster.expected_depth
    assert depth is not None
    if fog is None:
        return rgb, torch.ones_like(depth)
    transmittance = torch.exp(-image_optical_depth(fog, camera, depth))
    if photo is not None:
        airlight = photo.airlight(fog)
    else:
        airlight = rgb.new_tensor(fog.airlight_rgb)
        if fog.elevation_gain > 0:
            directions = camera.ray_directions(device=rgb.device)
            slope = directions[..., 2] / directions.norm(dim=-1)
            airlight = airlight + airlight_gain(fog, slope)
    clear_rgb = (rgb - (1 - transmittance)[..., None] * airlight) / transmittance.clamp_min(
        MIN_PHOTO_TRANSMITTANCE
    )[..., None]
    return clear_rgb, transmittance


def _darken_part(gaussians: Gaussians, splats: WetSplats, wet_effect: EffectInScene) -> Gaussians:
    """Return a part's Gaussians, darkened by water; remembered with them."""
    wetness = wet_effect.settings.wetness
    white = white_level(find_scene_light(wet_effect.lit_scene))
    return memo_of(gaussians).get(
        ("wetted", wetness, white, splats),
        lambda: darken_gaussians(gaussians, wetness * splats.wet, white),
    )


def _remove_ground(gaussians: Gaussians, splats: WetSplats) -> Gaussians:
    """Return a part's Gaussians without the ground; remembered with them."""
    return memo_of(gaussians).get(
        ("without ground", splats),
        lambda: replace(
            gaussians, opacities=torch.where(splats.is_ground, 0.0, gaussians.opacities)
        ),
    )
