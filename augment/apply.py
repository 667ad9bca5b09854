"""Carries out a plan: the order of the effects in plain sight."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from augment.batch.backends import choose_backend
from augment.cameras import Camera
from augment.plan import Plan, make_plan
from augment.render.backends import AUTO
from augment.render.buffers import EXPECTED_DEPTH, RenderOutput
from augment.render.composite import composite_sky, map_colors
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.sky import Sky
from augment.stopwatch import lap
from augment.style.looks import look_of
from augment.view_images import ViewImages, begin_images
from augment.view_plan import ViewPlan, cover_for, plan_view
from augment.views import (
    SURFACE_ALPHA,
    BareBuffers,
    FloodedView,
    PendingView,
    SmoggyView,
    SnowyView,
    SurfaceView,
    WeatheredBuffers,
    WeatheredView,
)
from augment.weather.flood_view import Painter, render_flooded
from augment.weather.smog import fog_raster
from recipes.schema import Recipe


def render_view(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO
) -> WeatheredView:
    """The view of `camera` (before recipe.render.scale) under the recipe's weather, in 8 bits.

    backend: as for `rasterize`, but "auto" takes the GPU where there is one.
    """
    return begin_view(scene, camera, recipe, backend=backend).result()


def begin_view(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO) -> PendingView:
    """The view of `render_view`, begun: its `result` waits for what the GPU has still to do. In the
    meantime another view can be begun.
    """
    if backend == AUTO:
        backend = choose_backend(backend, scene)
    with lap("plan"):
        plan = make_plan(recipe, scene)
    buffers = render_buffers(scene, camera.scaled(recipe.render.scale), plan, backend=backend)
    images = begin_images(buffers, plan, backend=backend)
    view_camera = buffers.camera  # and not the buffers, which the images may long outlive
    return PendingView(lambda: _weathered(images(), view_camera, plan, recipe))


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = "auto"
) -> WeatheredBuffers:
    """The view of `camera` at its own resolution, as floats."""
    with lap("view plan"):
        view = plan_view(plan, scene, camera, backend=backend)
    with lap("parts"):
        look = None if plan.style is None else look_of(scene, plan.style)
        worn = None if plan.styles_picture else look
        parts = bare_parts = scene.parts_for(camera, view.actors)
    cover = cover_for(plan, scene, backend=backend) if view.snow else None
    if cover is not None:
        with lap("snow: placement and layer"):
            parts = cover.parts_for(scene, camera, parts, view.snowy, backend=backend)
    sky = scene.sky
    if worn is not None:
        parts, sky = worn.on(parts, backend=backend), worn.sky
    flooded = None
    if plan.flood is not None and view.water:
        painter = Painter(
            parts, sky, plan.settings, plan.smog_in_splats, plan.smog_on_buffers, backend
        )
        flooded = render_flooded(painter, camera, plan.flood, view.buffers)
    if flooded is not None:
        rgb, raster = flooded.rgb, flooded.scene
        if flooded.is_hidden:
            view = view.with_hidden_water()
    else:
        rgb, raster = _without_water(sky, parts, camera, plan, view.buffers, backend)
    if look is not None and plan.styles_picture:
        with lap("style on the picture"):
            rgb = map_colors(rgb, look.maps.picture, backend=backend)
    color_map = scene.color_map(camera) if plan.recorded_exposure else None
    if color_map is not None:  # a camera exposes what the weather has left, so this comes last
        with lap("camera colour map"):
            rgb = map_colors(rgb, color_map, backend=backend)
    water = None if flooded is None else flooded.water
    with lap("depth of surfaces"):
        depth_m = _surface_depth(raster, plan, plan.buffers)
    return WeatheredBuffers(
        camera,
        rgb,
        raster,
        depth_m,
        parts,
        view,
        water=water,
        snow=_snow_mask(raster, water),
        bare=_bare(raster, bare_parts, camera, plan, view, backend),
    )


def _surface_depth(raster: RenderOutput, plan: Plan, buffers: frozenset[str]) -> Tensor | None:
    """z of the surfaces by the planned estimator if it is among the buffers, else by the one that
    labels need.
    """
    by = plan.depth_buffer if plan.depth_buffer in buffers else None
    z = getattr(raster, by or EXPECTED_DEPTH)
    if z is None or raster.alpha is None:
        return None
    return torch.where(raster.alpha >= SURFACE_ALPHA, z, 0.0)


def _snow_mask(raster: RenderOutput, water: Tensor | None) -> Tensor | None:
    """Where snow makes up half of the pixel or more; what a ray meets behind water is none."""
    if raster.snow is None:
        return None
    shows = raster.snow >= SURFACE_ALPHA
    return shows if water is None else shows & ~water


def _bare(
    raster: RenderOutput,
    parts: tuple[PosedGaussians, ...],
    camera: Camera,
    plan: Plan,
    view: ViewPlan,
    backend: str,
) -> BareBuffers | None:
    """What images show of the scene without its snow. raster: of the picture, which is that scene
    where the view has no pass for it.
    """
    if not plan.bare_buffers:
        return None
    if view.bare_buffers:
        with lap("snow: bare surface"):
            raster = rasterize(
                parts, camera, buffers=view.bare_buffers, settings=plan.settings, backend=backend
            )
    return BareBuffers(raster, _surface_depth(raster, plan, plan.bare_buffers), parts)


def _without_water(
    sky: Sky,
    parts: tuple[PosedGaussians, ...],
    camera: Camera,
    plan: Plan,
    buffers: frozenset[str],
    backend: str,
) -> tuple[Tensor, RenderOutput]:
    with lap("rasterise"):
        raster = rasterize(
            parts,
            camera,
            buffers=buffers,
            settings=plan.settings,
            smog=plan.smog_in_splats,
            backend=backend,
        )
    assert raster.rgb is not None and raster.alpha is not None
    rgb = raster.rgb
    if plan.smog_on_buffers is not None:
        with lap("smog on buffers"):
            rgb = fog_raster(raster, camera, plan.smog_on_buffers, backend=backend)
    uniform = plan.smog is not None and plan.smog.scale_height_m is None  # hides the sky
    with lap("airlight behind the splats" if uniform else "sky"):
        rgb = composite_sky(rgb, raster.alpha, camera, sky, smog=plan.smog, backend=backend)
    return rgb, raster


def _weathered(images: ViewImages, camera: Camera, plan: Plan, recipe: Recipe) -> WeatheredView:
    """The images with what labels are measured from."""
    weather, depth = recipe.weather, images.scene_depth_m
    flood = snowy = smoggy = None
    if plan.flood_level_z_m is not None:
        seen = plan.flood is not None and images.water is not None
        flood = FloodedView(plan.flood_level_z_m, depth if seen else None)
    snow_m = 0.0
    if weather.snow is not None:
        seen = plan.snow is not None and images.snow is not None and bool(images.snow.any())
        snow_m = weather.snow.depth_m if seen else 0.0
        snowy = SnowyView(depth if seen else None, weather.snow.depth_m)
    if weather.smog is not None:
        level_z_m = None if plan.flood is None else plan.flood.level_z_m
        smoggy = SmoggyView(plan.smog, None if plan.smog is None else depth, level_z_m)
    size = (camera.height, camera.width)
    water, snow = images.water, images.snow
    if weather.flood is not None and water is None:
        water = np.zeros(size, np.uint8)
    if weather.snow is not None and snow is None:
        snow = np.zeros(size, np.uint8)
    return WeatheredView(
        camera=camera,
        rgb=images.rgb,
        depth_m=None if plan.depth_buffer is None else images.depth_m,
        semantic=images.semantic if plan.semantic else None,
        instance=images.instance,
        water=water,
        flood=flood,
        snow=snow,
        snowy=snowy,
        smoggy=smoggy,
        surface=_surface_view(images, plan, snow_m),
    )


def _surface_view(images: ViewImages, plan: Plan, snow_m: float) -> SurfaceView | None:
    """snow_m: of the snow in view."""
    depth = images.scene_depth_m
    if depth is None:
        return None
    is_bare = bool(plan.bare_buffers)
    is_solid = not is_bare and not plan.shows_water
    return SurfaceView(
        depth_m=depth,
        snow_m=snow_m,
        actors=images.instance if is_solid else None,
        shown_depth_m=images.depth_m if is_bare else depth,
        shown_classes=images.semantic,
        shown_snow_m=0.0 if is_bare else snow_m,
    )
