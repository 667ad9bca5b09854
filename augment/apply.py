"""Carries out a plan: the order of the effects in plain sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.plan import Plan, make_plan
from augment.render.buffers import EXPECTED_DEPTH, RenderOutput
from augment.render.composite import composite_sky, map_colors, quantise
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import Sky
from augment.stopwatch import lap
from augment.style.looks import look_of
from augment.view_plan import ViewPlan, cover_for, plan_view
from augment.weather.flood_view import Painter, render_flooded
from augment.weather.smog import SmogMedium, fog_raster
from augment.weather.water_plane import plane_depth
from recipes.schema import Recipe

SURFACE_ALPHA = 0.5  # a pixel less covered than this shows more sky than surface: it has no depth


@dataclass(frozen=True, eq=False)
class BareBuffers:
    """What images show of a scene without its snow: see the same fields of WeatheredBuffers."""

    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view in floats. rgb [H, W, 3]: display-encoded, not clamped, sky included.

    raster: the buffers of the scene's surfaces; with water in view, of those under it too, without
    colours. depth_m [H, W]: z along the optical axis of the scene's surface, 0 where there is none;
    None unless planned. water [H, W]: where a ray meets water first; None where no water is in
    view. snow [H, W]: where snow is what the pixel shows; None where none can be in view; it is a
    surface of the scene for raster, depth_m and parts. bare: the scene without it, if planned.
    parts: those drawn, by which splat_ids count. view: what of the plan was carried out.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]
    view: ViewPlan
    water: Bool[Tensor, "H W"] | None = None
    snow: Bool[Tensor, "H W"] | None = None
    bare: BareBuffers | None = None


@dataclass(frozen=True, eq=False)
class FloodedView:
    """What a view's labels under water are measured from.

    level_z_m: the water's surface, scene world. scene_depth_m: float32 [H, W], z of the scene's own
    surface, seen through the water where there is some; 0 = none. None where no water is in
    view, or no label needs it.
    """

    level_z_m: float
    scene_depth_m: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SnowyView:
    """What a view's labels in the snow are measured from.

    surface_depth_m: float32 [H, W], z of the first solid surface, snow included; 0 = none. None
    where no snow is in view, or no label needs it. thickness_m: the layer's depth.
    """

    surface_depth_m: np.ndarray | None
    thickness_m: float


@dataclass(frozen=True, eq=False)
class SmoggyView:
    """What the labels in a view's smog are measured from.

    medium: None where the recipe's smog has no density. surface_depth_m: float32 [H, W], z of the
    surface that is seen through the smog, snow included and water not; 0 = none. None where no
    label needs it. water_level_z_m: of the flood, scene world; None where none is drawn.
    """

    medium: SmogMedium | None
    surface_depth_m: np.ndarray | None
    water_level_z_m: float | None


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W], 0 = none. semantic: uint8 [H, W], SemanticClass.
    instance: uint16 [H, W], 0 = background or sky, else 1 + the actor's index in the scene.
    water: uint8 [H, W], 255 where a ray meets water first, else 0; None where the recipe has no
    flood. flood: None where the recipe has no flood. snow: uint8 [H, W], 255 where snow is what the
    pixel shows, else 0. snow, snowy: None where the recipe has no snow. smoggy: None where it has
    no smog.
    """

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray | None
    semantic: np.ndarray | None
    instance: np.ndarray | None
    water: np.ndarray | None = None
    flood: FloodedView | None = None
    snow: np.ndarray | None = None
    snowy: SnowyView | None = None
    smoggy: SmoggyView | None = None


def render_view(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = "auto"
) -> WeatheredView:
    """The view of `camera` (before recipe.render.scale) under the recipe's weather, in 8 bits."""
    with lap("plan"):
        plan = make_plan(recipe, scene)
    buffers = render_buffers(scene, camera.scaled(recipe.render.scale), plan, backend=backend)
    first = buffers.water if plan.shows_water else None  # pixels that show the water itself
    shown = buffers.bare or buffers  # the scene's surfaces that the other images show
    semantic = instance = depth = None
    if plan.semantic:
        with lap("semantic image"):
            table = semantic_table(shown.parts)
            semantic = _look_up(shown.raster, table, int(SemanticClass.SKY), np.uint8)
            if first is not None:
                semantic[first.numpy()] = int(SemanticClass.WATER)
    if plan.instance:
        with lap("instance image"):
            instance = _look_up(shown.raster, instance_table(shown.parts), 0, np.uint16)
            if first is not None:
                instance[first.numpy()] = 0
    if plan.depth_buffer is not None and shown.depth_m is not None:
        depth = shown.depth_m
        if first is not None:
            assert plan.flood is not None
            with lap("depth image"):
                surface = plane_depth(buffers.camera, plan.flood.level_z_m).to(depth.dtype)
                in_air = float(buffers.camera.centre[2]) > plan.flood.level_z_m
                depth = torch.where(first, surface if in_air else torch.zeros_like(depth), depth)
    with lap("8 bits"):
        rgb = quantise(buffers.rgb)
    return WeatheredView(
        camera=buffers.camera,
        rgb=rgb,
        depth_m=None if depth is None else depth.float().numpy(),
        semantic=semantic,
        instance=instance,
        water=_mask(buffers.water, camera=buffers.camera) if recipe.weather.flood else None,
        flood=_flooded(buffers, plan),
        snow=_mask(buffers.snow, camera=buffers.camera) if recipe.weather.snow else None,
        snowy=_snowy(buffers, plan, recipe),
        smoggy=_smoggy(buffers, plan, recipe),
    )


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = "auto"
) -> WeatheredBuffers:
    """The view of `camera` at its own resolution, as floats."""
    with lap("view plan"):
        view = plan_view(plan, scene, camera)
    with lap("parts"):
        look = None if plan.style is None else look_of(scene, plan.style)
        worn = None if plan.styles_picture else look
        parts = bare_parts = scene.parts_for(camera, view.actors)
    cover = cover_for(plan, scene) if view.snow else None
    if cover is not None:
        with lap("snow: placement and layer"):
            parts = cover.parts_for(scene, camera, parts, view.snowy)
    sky = scene.sky
    if worn is not None:
        parts, sky = worn.on(parts), worn.sky
    flooded = None
    if plan.flood is not None and view.water:
        painter = Painter(
            parts, sky, plan.settings, plan.smog_in_splats, plan.smog_on_buffers, backend
        )
        buffers = view.buffers
        if plan.measures_flood and plan.depth_buffer not in buffers:
            buffers = buffers | {EXPECTED_DEPTH}
        flooded = render_flooded(painter, camera, plan.flood, buffers)
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
    return torch.where(raster.alpha >= SURFACE_ALPHA, z, torch.zeros_like(z))


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
            rgb = fog_raster(raster, camera, plan.smog_on_buffers)
    uniform = plan.smog is not None and plan.smog.scale_height_m is None  # hides the sky
    with lap("airlight behind the splats" if uniform else "sky"):
        rgb = composite_sky(rgb, raster.alpha, camera, sky, smog=plan.smog, backend=backend)
    return rgb, raster


def _mask(shown: Tensor | None, *, camera: Camera) -> np.ndarray:
    """uint8 [H, W]: 255 where `shown`, else 0; all 0 where it is None."""
    if shown is None:
        return np.zeros((camera.height, camera.width), np.uint8)
    return shown.numpy().astype(np.uint8) * np.uint8(255)


def _flooded(buffers: WeatheredBuffers, plan: Plan) -> FloodedView | None:
    if plan.flood_level_z_m is None:
        return None
    depth = buffers.depth_m if plan.measures_flood and buffers.water is not None else None
    return FloodedView(plan.flood_level_z_m, None if depth is None else depth.float().numpy())


def _snowy(buffers: WeatheredBuffers, plan: Plan, recipe: Recipe) -> SnowyView | None:
    if recipe.weather.snow is None:
        return None
    in_view = buffers.snow is not None and bool(buffers.snow.any())
    depth = buffers.depth_m if plan.measures_snow and in_view else None
    return SnowyView(None if depth is None else depth.float().numpy(), recipe.weather.snow.depth_m)


def _smoggy(buffers: WeatheredBuffers, plan: Plan, recipe: Recipe) -> SmoggyView | None:
    if recipe.weather.smog is None:
        return None
    depth = buffers.depth_m if plan.measures_smog else None
    level_z_m = None if plan.flood is None else plan.flood.level_z_m
    return SmoggyView(plan.smog, None if depth is None else depth.float().numpy(), level_z_m)


def semantic_table(parts: tuple[PosedGaussians, ...]) -> np.ndarray:
    """int16 [total splats]: the class of every splat, in the order splat_ids counts them."""
    return np.concatenate([
        np.zeros(len(p.gaussians), np.int16)
        if p.gaussians.semantic is None
        else p.gaussians.semantic.numpy()
        for p in parts
    ])  # fmt: skip


def instance_table(parts: tuple[PosedGaussians, ...]) -> np.ndarray:
    """uint16 [total splats]: the instance of every splat, in the order splat_ids counts them."""
    counts = [len(p.gaussians) for p in parts]
    return np.repeat(np.array([p.instance_id for p in parts], np.uint16), counts)


def _look_up(raster: RenderOutput, table: np.ndarray, none: int, dtype: type) -> np.ndarray:
    assert raster.splat_ids is not None and raster.alpha is not None
    index = raster.splat_ids.numpy()
    if len(table) == 0:  # no part has a splat: an empty background, and actors that are not there
        return np.full(index.shape, none, dtype)
    seen = (index >= 0) & (raster.alpha.numpy() >= SURFACE_ALPHA)
    return np.where(seen, table[np.maximum(index, 0)], none).astype(dtype)
