"""What one view of a scene in its weather consists of: buffers in floats, and what is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.effects.flood.flood_view import render_flooded
from augment.effects.flood.water_plane import plane_depth
from augment.effects.style.style import scene_style_of
from augment.jobs.processes import choose_backend
from augment.plan import Plan, ViewPlan, make_plan, plan_view, snow_layers_for
from augment.render.buffers import AUTO, EXPECTED_DEPTH, RenderOutput
from augment.render.composite import composite_sky, map_colors, to_bytes
from augment.render.cuda.runtime import download, resident
from augment.render.fog import Fog, fog_raster
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import Sky
from augment.timing import timed
from recipes.schema import Recipe

SURFACE_ALPHA = 0.5  # a pixel less covered than this shows more sky than surface: it has no depth


@dataclass(frozen=True, eq=False)
class SnowFreeBuffers:
    """The scene without its snow: see the same fields of WeatheredBuffers."""

    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view in floats. rgb: display-encoded, not clamped, sky included.

    raster: buffers of the scene's surfaces, snow included, with water in view also those under it,
    without colours. depth_m: z of the scene's surface, 0 where there is none; None unless planned.
    water: where a ray meets water first; None where none is in view. snow: where snow is what the
    pixel shows; None where none can be in view. bare: the scene without snow, if planned. parts:
    those drawn, by which splat_ids count. view: what of the plan was carried out.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]
    view: ViewPlan
    water: Bool[Tensor, "H W"] | None = None
    snow: Bool[Tensor, "H W"] | None = None
    bare: SnowFreeBuffers | None = None


# ---- What labels are measured from: depths are float32 [H, W], z in metres, 0 = none -------------


@dataclass(frozen=True, eq=False)
class FloodedView:
    """level_z_m: the water's surface, scene world. scene_depth_m: of the scene's own surface, seen
    through the water; None where no water is in view, or no label needs it.
    """

    level_z_m: float
    scene_depth_m: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SnowyView:
    """surface_depth_m: of the first solid surface, snow included; None where no snow is in view, or
    no label needs it. thickness_m: the layer's depth.
    """

    surface_depth_m: np.ndarray | None
    thickness_m: float


@dataclass(frozen=True, eq=False)
class SmoggyView:
    """medium: None where the recipe's smog has no density. surface_depth_m: of the surface that is
    seen through the smog, snow included and water not; None where no label needs it.
    water_level_z_m: of the flood, scene world; None where none is drawn.
    """

    medium: Fog | None
    surface_depth_m: np.ndarray | None
    water_level_z_m: float | None


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """depth_m: of the first solid surface, snow included and water not. snow_m: the snow's depth, 0
    where none is in view. actors: uint16 [H, W], the instance image of those surfaces, which knows
    of actors only; None where there is none. shown_depth_m, shown_classes, shown_snow_m: likewise
    of the surfaces that the view's instance image shows; None without one.
    """

    depth_m: np.ndarray
    snow_m: float
    actors: np.ndarray | None
    shown_depth_m: np.ndarray | None
    shown_classes: np.ndarray | None
    shown_snow_m: float


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W], 0 = none. semantic: uint8 [H, W], SemanticClass.
    instance: uint16 [H, W], 0 = background or sky, else 1 + the actor's index in the scene
    (`augment.jobs.files.label_view` adds boxes without an actor). water, snow: uint8 [H, W], 255
    where a ray meets water first, and where snow is what the pixel shows. What belongs to an effect
    is None where the recipe lacks it. surface: None where nobody asks for boxes.
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
    surface: SurfaceView | None = None


class PendingView:
    """A view that was begun: on a GPU it may still be computed, other backends have finished it."""

    def __init__(self, finish: Callable[[], WeatheredView]) -> None:
        self._finish: Callable[[], WeatheredView] | None = finish
        self._view: WeatheredView | None = None

    def result(self) -> WeatheredView:
        """The view, once it is there; the same one every time. Of one thread at a time."""
        if self._finish is not None:
            self._view, self._finish = self._finish(), None
        assert self._view is not None
        return self._view


# ---- Buffers into images as files hold them ------------------------------------------------------
# On a GPU they are made there, and nobody waits for their copies before they are needed.


@dataclass(frozen=True, eq=False)
class ViewImages:
    """As the fields of WeatheredView; water, snow: None where the buffers have none. scene_depth_m:
    float32 [H, W], the buffers' depth, where labels need it.
    """

    rgb: np.ndarray
    depth_m: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    water: np.ndarray | None = None
    snow: np.ndarray | None = None
    scene_depth_m: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class RequestedImages:
    """What of a view's buffers becomes images.

    shown: the surfaces that depth, semantic and instance images show; parts: those its splat_ids
    count through. first: pixels in which these images show the water instead. plane_z_m: the
    water's surface, scene world, if an eye in the air sees it there; None leaves their depth 0.
    """

    rgb: Float[Tensor, "H W 3"]
    shown: RenderOutput
    parts: tuple[PosedGaussians, ...]
    semantic: bool
    instance: bool
    depth_m: Float[Tensor, "H W"] | None
    scene_depth_m: Float[Tensor, "H W"] | None
    first: Tensor | None
    plane_z_m: float | None
    water: Tensor | None
    snow: Tensor | None


def begin_images(view: WeatheredBuffers, plan: Plan) -> Callable[[], ViewImages]:
    """The images that the plan asks for; what is returned waits for those on a GPU."""
    shown = view.bare or view
    in_air = plan.flood is not None and float(view.camera.centre[2]) > plan.flood.level_z_m
    paints_boxes = plan.instance and plan.finds_boxes  # by depth and class of what is shown
    shows_depth = plan.depth_buffer is not None or (paints_boxes and view.bare is not None)
    requested = RequestedImages(
        rgb=view.rgb,
        shown=shown.raster,
        parts=shown.parts,
        semantic=plan.semantic or paints_boxes,
        instance=plan.instance,
        depth_m=shown.depth_m if shows_depth else None,
        scene_depth_m=view.depth_m if plan.finds_boxes else None,
        first=view.water if plan.shows_water else None,
        plane_z_m=plan.flood.level_z_m if plan.flood is not None and in_air else None,
        water=view.water,
        snow=view.snow,
    )
    images = download(_make_images(requested, view.camera))
    return lambda: ViewImages(**images())


def _make_images(requested: RequestedImages, camera: Camera) -> dict[str, Tensor]:
    """Fields of ViewImages, where the buffers lie."""
    shown, parts, depth = requested.shown, requested.parts, requested.depth_m
    first, device = requested.first, requested.rgb.device
    out: dict[str, Tensor | None] = {}
    if requested.semantic:
        with timed("semantic image"):
            classes = _look_up(shown, _semantic_table(parts, device), int(SemanticClass.SKY))
            out["semantic"] = _with(classes, first, int(SemanticClass.WATER)).to(torch.uint8)
    if requested.instance:
        with timed("instance image"):
            instances = _with(_instances(shown, parts, device), first, 0)
            out["instance"] = instances.to(torch.int16).view(torch.uint16)
    if depth is not None and first is not None:
        with timed("depth image"):
            surface = torch.zeros_like(depth)
            if requested.plane_z_m is not None:
                surface = plane_depth(camera, requested.plane_z_m, device).to(depth.dtype)
            depth = torch.where(first, surface, depth)
    with timed("8 bits"):
        out |= {"rgb": to_bytes(requested.rgb), "depth_m": depth}
    out["scene_depth_m"] = requested.scene_depth_m
    out |= {"water": _mask(requested.water), "snow": _mask(requested.snow)}
    found = {name: image for name, image in out.items() if image is not None}
    return {n: i.float() if i.dtype == torch.float64 else i for n, i in found.items()}


def _mask(shown: Tensor | None) -> Tensor | None:
    """uint8 [H, W]: 255 where `shown`, else 0."""
    return None if shown is None else shown.to(torch.uint8) * 255


def _with(image: Tensor, first: Tensor | None, value: int) -> Tensor:
    """The image, but for `value` where water comes first."""
    return image if first is None else image.masked_fill(first, value)


def _semantic_table(parts: tuple[PosedGaussians, ...], device: torch.device) -> Tensor:
    """int16 [total splats]: the class of every splat, in the order splat_ids counts them."""
    classes = [p.gaussians.semantic for p in parts]
    return torch.cat([
        torch.zeros(len(p.gaussians), dtype=torch.int16, device=device)
        if own is None
        else own if own.device == device else resident(own)
        for p, own in zip(parts, classes, strict=True)
    ])  # fmt: skip


def _instances(
    raster: RenderOutput, parts: tuple[PosedGaussians, ...], device: torch.device
) -> Tensor:
    """int32 [H, W]: the instance of the part whose surface every pixel shows, else 0."""
    assert raster.splat_ids is not None
    ends = np.cumsum([len(part.gaussians) for part in parts])
    table = np.stack([ends, [part.instance_id for part in parts]]).astype(np.int32)
    own = torch.from_numpy(table).to(device)
    part = torch.searchsorted(own[0], raster.splat_ids, right=True).clamp_max(len(parts) - 1)
    return torch.where(_is_surface(raster), own[1][part], 0)


def _look_up(raster: RenderOutput, table: Tensor, none: int) -> Tensor:
    index = raster.splat_ids
    assert index is not None
    if len(table) == 0:  # no part has a splat: an empty background, and actors that are not there
        return torch.full_like(index, none)
    return torch.where(_is_surface(raster), table[index.clamp_min(0)], none)


def _is_surface(raster: RenderOutput) -> Tensor:
    assert raster.splat_ids is not None and raster.alpha is not None
    return (raster.splat_ids >= 0) & (raster.alpha.detach() >= SURFACE_ALPHA)


# ---- A plan carried out: the order of the effects in plain sight ---------------------------------


def render_view(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO
) -> WeatheredView:
    """The view of `camera` (before recipe.render.scale) under the recipe's weather, in 8 bits.

    backend: as for `rasterize`, but "auto" takes the GPU where there is one.
    """
    return begin_view(scene, camera, recipe, backend=backend).result()


def begin_view(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO) -> PendingView:
    """The view of `render_view`, begun: its `result` waits for the GPU; another can be begun."""
    if backend == AUTO:
        backend = choose_backend(backend, scene)
    with timed("plan"):
        plan = make_plan(recipe, scene)
    buffers = render_buffers(scene, camera.scaled(recipe.render.scale), plan, backend=backend)
    images = begin_images(buffers, plan)
    camera = buffers.camera  # and not the buffers, which the images may long outlive
    return PendingView(lambda: _weathered(images(), camera, plan, recipe))


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = AUTO
) -> WeatheredBuffers:
    """The view of `camera` at its own resolution, as floats."""
    with timed("view plan"):
        view = plan_view(plan, scene, camera, backend=backend)
    with timed("parts"):
        look = None if plan.style is None else scene_style_of(scene, plan.style)
        style_parts = None if plan.styles_picture else look
        parts = bare_parts = scene.parts_for(camera, view.actors)
    layers = snow_layers_for(plan, scene, backend=backend) if view.snow else None
    if layers is not None:
        with timed("snow: placement and layer"):
            parts = layers.parts_for(scene, camera, parts, view.snowy, backend=backend)
    sky = scene.sky
    if style_parts is not None:
        parts, sky = style_parts.on(parts, backend=backend), style_parts.sky
    flooded = None
    if plan.flood is not None and view.water:
        fogs_buffers = plan.smog_on_buffers is not None
        renderer = LayerRenderer(parts, sky, plan.smog, fogs_buffers, plan.settings, backend)
        flooded = render_flooded(renderer, camera, plan.flood, view.buffers)
    if flooded is None:
        rgb, raster = _without_water(sky, parts, camera, plan, view.buffers, backend)
    else:
        rgb, raster = flooded.rgb, flooded.scene
        view = view.with_hidden_water() if flooded.is_hidden else view
    if look is not None and plan.styles_picture:
        with timed("style on the picture"):
            rgb = map_colors(rgb, look.maps.picture, backend=backend)
    color_map = scene.color_map(camera) if plan.recorded_exposure else None
    if color_map is not None:  # a camera exposes what the weather has left, so this comes last
        with timed("camera colour map"):
            rgb = map_colors(rgb, color_map, backend=backend)
    water = None if flooded is None else flooded.water
    with timed("depth of surfaces"):
        depth_m = _surface_depth(raster, plan, plan.buffers)
    bare = _bare(raster, bare_parts, camera, plan, view, backend)
    snow = _snow_mask(raster, water)
    return WeatheredBuffers(camera, rgb, raster, depth_m, parts, view, water, snow, bare)


def _surface_depth(raster: RenderOutput, plan: Plan, buffers: frozenset[str]) -> Tensor | None:
    """z of the surfaces by the planned estimator if among the buffers, else by the labels'."""
    by = plan.depth_buffer if plan.depth_buffer in buffers else None
    z = getattr(raster, by or EXPECTED_DEPTH)
    if z is None or raster.alpha is None:
        return None
    return torch.where(raster.alpha >= SURFACE_ALPHA, z, 0.0)


def _snow_mask(raster: RenderOutput, water: Tensor | None) -> Tensor | None:
    """Where snow makes up half of the pixel or more, and not behind water."""
    if raster.overlay is None:
        return None
    is_shown = raster.overlay >= SURFACE_ALPHA
    return is_shown if water is None else is_shown & ~water


def _bare(
    raster: RenderOutput,
    parts: tuple[PosedGaussians, ...],
    camera: Camera,
    plan: Plan,
    view: ViewPlan,
    backend: str,
) -> SnowFreeBuffers | None:
    """raster: of the picture, which is the bare scene where the view has no pass for it."""
    if not plan.bare_buffers:
        return None
    if view.bare_buffers:
        with timed("snow: bare surface"):
            raster = rasterize(
                parts, camera, buffers=view.bare_buffers, settings=plan.settings, backend=backend
            )
    return SnowFreeBuffers(raster, _surface_depth(raster, plan, plan.bare_buffers), parts)


def _without_water(
    sky: Sky,
    parts: tuple[PosedGaussians, ...],
    camera: Camera,
    plan: Plan,
    buffers: frozenset[str],
    backend: str,
) -> tuple[Tensor, RenderOutput]:
    with timed("rasterise"):
        raster = rasterize(
            parts,
            camera,
            buffers=buffers,
            settings=plan.settings,
            fog=plan.smog_in_splats,
            backend=backend,
        )
    assert raster.rgb is not None and raster.alpha is not None
    rgb = raster.rgb
    if plan.smog_on_buffers is not None:
        with timed("smog on buffers"):
            rgb = fog_raster(raster, camera, plan.smog_on_buffers)
    uniform = plan.smog is not None and plan.smog.scale_height_m is None  # hides the sky
    with timed("airlight behind the splats" if uniform else "sky"):
        rgb = composite_sky(rgb, raster.alpha, camera, sky, fog=plan.smog, backend=backend)
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
    water, snow = images.water, images.snow
    if weather.flood is not None and water is None:
        water = np.zeros((camera.height, camera.width), np.uint8)
    if weather.snow is not None and snow is None:
        snow = np.zeros((camera.height, camera.width), np.uint8)
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
    depth, is_bare = images.scene_depth_m, bool(plan.bare_buffers)
    if depth is None:
        return None
    return SurfaceView(
        depth_m=depth,
        snow_m=snow_m,
        actors=None if is_bare or plan.shows_water else images.instance,
        shown_depth_m=images.depth_m if is_bare else depth,
        shown_classes=images.semantic,
        shown_snow_m=0.0 if is_bare else snow_m,
    )
