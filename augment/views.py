"""One view of a scene in its weather: buffers in floats, and the images that are written."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment import effects
from augment.base_photo import open_photo
from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.effects.effect import Drawn, EffectView
from augment.jobs.layout import TRUST
from augment.jobs.processes import awaited, choose_backend, renders_on_gpu
from augment.own_car import own_car_mask
from augment.plan import BARE, LENS, NOISE, Plan, ViewPlan, make_plan, plan_view
from augment.prune import prune_parts
from augment.render.buffers import AUTO, CPU, EXPECTED_DEPTH, RenderOutput
from augment.render.composite import map_colors
from augment.render.rasterize import rasterize
from augment.render.sensor import add_noise, blur_lens
from augment.render.threads import divided_threads, views_at_once
from augment.scene import PosedGaussians, Scene
from augment.timing import timed
from augment.trust import trust_mask
from augment.view_images import SURFACE_ALPHA, ViewImages, begin_images
from recipes.schema import Recipe

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
    trust = dict[str, np.ndarray]()
    if recipe.output.trust:
        with timed("trust mask"):
            trust[TRUST] = trust_mask(scene, camera, backend=backend)
    own_car = None
    if plan.on_photo and plan.finds_boxes:
        with timed("recording car"):
            own_car = own_car_mask(scene, camera)
    return PendingView(lambda: _weathered(images(), camera, plan, recipe, trust, own_car))


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = AUTO
) -> WeatheredBuffers:
    """The view of `camera` at its own resolution, as floats."""
    with timed("view plan"):
        view = plan_view(plan, scene, camera, backend=backend)
    with timed("parts"):
        bare_parts = scene.parts_for(camera, view.actors)
    color_map = scene.color_map(camera) if plan.recorded_exposure else None
    photo = None
    if plan.on_photo:
        with timed("photo"):
            photo = open_photo(scene, camera, color_map, backend=backend)
    layers = LayerRenderer(bare_parts, scene.sky, None, False, plan.settings, backend, photo)
    for own in view.effects:
        layers = own.effect.edit_scene(own, layers, camera)
    if plan.prune > 0:
        with timed("prune"):
            parts = prune_parts(layers.parts, scene, camera, plan.prune)
            layers = replace(layers, parts=parts, unpruned=layers.parts)
    drawn = _draw(view, layers, camera)
    for own in view.effects:
        drawn = own.effect.edit_image(own, drawn, camera)
    rgb = drawn.rgb
    if color_map is not None:  # a camera exposes what the weather has left, so this comes last
        with timed("camera colour map"):
            rgb = map_colors(rgb, color_map, backend=backend)
    if plan.sensor.psf_px > 0:
        with timed(LENS):
            rgb = blur_lens(rgb, plan.sensor.psf_px)
    if plan.sensor.noise > 0:
        with timed(NOISE):
            noise, seed = plan.sensor.noise, plan.seed
            rgb = add_noise(rgb, noise, camera, seed=seed, scene=scene.name, backend=backend)
    with timed("depth of surfaces"):
        depth_m = _surface_depth(drawn.raster, plan, plan.image_buffers)
    return WeatheredBuffers(
        camera=camera,
        rgb=rgb,
        raster=drawn.raster,
        depth_m=depth_m,
        parts=tuple(layers.parts),
        plan=view.skipping(drawn.skipped),
        masks=_masks(view, drawn),
        bare=_bare(drawn.raster, bare_parts, camera, plan, view, backend),
    )


def _draw(view: ViewPlan, layers: LayerRenderer, camera: Camera) -> Drawn:
    """By the last effect that draws the scene in layers of its own; else whole, before its sky."""
    for own in reversed(view.effects):
        drawn = own.effect.draw(own, layers, camera, view.buffers)
        if drawn is not None:
            return drawn
    return Drawn(*layers.draw_whole(camera, view.buffers), layers)


def _masks(view: ViewPlan, drawn: Drawn) -> dict[str, Tensor]:
    """Where each effect is what a pixel shows: the last one where there are several."""
    masks, opaque = dict[str, Tensor](), list[Tensor]()
    for own in reversed(view.effects):
        mask = own.effect.mask_of(own, drawn)
        if mask is not None and own.effect.mask is not None:
            for later in opaque:
                mask = mask & ~later
            masks[own.effect.mask] = mask
            opaque += [] if own.effect.is_see_through else [mask]
    return masks


def _surface_depth(raster: RenderOutput, plan: Plan, buffers: frozenset[str]) -> Tensor | None:
    """z of the surfaces by the planned estimator if among the buffers, else by the labels'."""
    if plan.depth_buffer is None and not plan.finds_boxes:
        return None
    by = plan.depth_buffer if plan.depth_buffer in buffers else None
    z = getattr(raster, by or EXPECTED_DEPTH)
    if z is None or raster.alpha is None:
        return None
    if z.device.type == "cpu" and not (z.requires_grad or raster.alpha.requires_grad):
        return torch.from_numpy(np.where(raster.alpha.numpy() >= SURFACE_ALPHA, z.numpy(), 0))
    return torch.where(raster.alpha >= SURFACE_ALPHA, z, 0.0)


def _bare(
    raster: RenderOutput,
    parts: tuple[PosedGaussians, ...],
    camera: Camera,
    plan: Plan,
    view: ViewPlan,
    backend: str,
) -> BareBuffers | None:
    """raster: of the picture, which is the bare scene where the view has no pass for it."""
    if not plan.bare_buffers:
        return None
    if view.bare_buffers:
        with timed(BARE):
            raster = rasterize(
                parts, camera, buffers=view.bare_buffers, settings=plan.settings, backend=backend
            )
    return BareBuffers(raster, _surface_depth(raster, plan, plan.bare_buffers), parts)


def _weathered(
    images: ViewImages,
    camera: Camera,
    plan: Plan,
    recipe: Recipe,
    trust: Mapping[str, np.ndarray],
    own_car: np.ndarray | None,
) -> WeatheredView:
    """The images with what labels are measured from."""
    masks, views = dict(trust), dict[str, EffectView]()
    for effect in effects.EFFECTS:
        if effect.of(recipe) is None:
            continue
        placed, mask = plan.placed[effect.name], images.masks.get(effect.mask or "")
        is_seen = placed.data is not None and (effect.mask is None or mask is not None)
        depth = images.scene_depth_m if is_seen else None
        views[effect.name] = EffectView(placed, depth, mask, plan.water_level_z_m)
        if effect.mask is not None:
            nowhere = np.zeros((camera.height, camera.width), np.uint8)
            masks[effect.mask] = nowhere if mask is None else mask
    return WeatheredView(
        camera=camera,
        rgb=images.rgb,
        depth_m=None if plan.depth_buffer is None else images.depth_m,
        semantic=images.semantic if plan.semantic else None,
        instance=images.instance,
        masks=masks,
        effects=views,
        surface=_surface_view(images, plan, own_car),
    )


def _surface_view(images: ViewImages, plan: Plan, own_car: np.ndarray | None) -> SurfaceView | None:
    depth, is_bare = images.scene_depth_m, bool(plan.bare_buffers)
    if depth is None:
        return None
    shows_first = plan.shows_first and plan.water_level_z_m is not None
    is_of_depth = not (is_bare or shows_first)  # what the other images show
    return SurfaceView(
        depth_m=depth,
        actors=images.instance if is_of_depth else None,
        classes=images.semantic if is_of_depth else None,
        shown_depth_m=images.depth_m if is_bare else depth,
        shown_classes=images.semantic,
        is_bare=is_bare,
        own_car=own_car,
    )


# ---- What a view consists of ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BareBuffers:
    """The scene without what lies on it: see the same fields of WeatheredBuffers."""

    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]


@dataclass(frozen=True, eq=False)
class WeatheredBuffers:
    """One finished view in floats. rgb: display-encoded, not clamped, sky included.

    raster: buffers of the scene's surfaces, snow included, with water in view also those under it,
    without colours. depth_m: z of the scene's surface, 0 where there is none; None unless planned.
    parts: those drawn, by which splat_ids count. plan: what of it was carried out. masks: where an
    effect is what a pixel shows, by name; of those that can be in view. bare: the scene without
    what lies on it, if planned.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    raster: RenderOutput
    depth_m: Float[Tensor, "H W"] | None
    parts: tuple[PosedGaussians, ...]
    plan: ViewPlan
    masks: Mapping[str, Bool[Tensor, "H W"]] = field(default_factory=dict)
    bare: BareBuffers | None = None


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """What labels are measured from; depths are float32 [H, W], z in metres, 0 = none.

    depth_m: of the first solid surface, snow included and water not. actors: uint16 [H, W], the
    instance image of those surfaces, which knows of actors only; None where there is none.
    shown_depth_m, shown_classes: of the surfaces that the view's instance image shows; None without
    one. is_bare: these are without what lies on the scene. classes: uint8 [H, W], of the surfaces
    of depth_m; None where no image shows them. own_car: bool [H, W], where a recorded picture shows
    the recording car, of which the scene has no surfaces; None where it shows none.
    """

    depth_m: np.ndarray
    actors: np.ndarray | None
    shown_depth_m: np.ndarray | None
    shown_classes: np.ndarray | None
    is_bare: bool
    classes: np.ndarray | None = None
    own_car: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class WeatheredView:
    """One finished view as it is written to files.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W], 0 = none. semantic: uint8 [H, W], SemanticClass.
    instance: uint16 [H, W], 0 = background or sky, else 1 + the actor's index in the scene
    (`augment.jobs.files.label_view` adds boxes without an actor). masks: uint8 [H, W], by name: 255
    where an effect is what the pixel shows, else 0; and of TRUST, 0 to 255. effects: what their
    labels are measured from; of all effects that the recipe has. surface: None where nobody asks
    for boxes.
    """

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray | None
    semantic: np.ndarray | None
    instance: np.ndarray | None
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    effects: Mapping[str, EffectView] = field(default_factory=dict)
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


# ---- Several views at once -----------------------------------------------------------------------
# On the CPU some work of a view cannot be divided, and threads that share a view wait for each
# other: where each has a view of its own, all cores are busy. Every thread has its work space then.


class ViewPool:
    """Begins views of a scene, several at once on threads of their own; on a GPU, or where there is
    one thread, one after the other. ahead: how many may be in flight while more are begun.
    views: how many there will be at most. Close it, or use it as a context manager.
    """

    def __init__(self, scene: Scene, backend: str = AUTO, views: int = sys.maxsize) -> None:
        backend = choose_backend(backend, scene) if backend == AUTO else backend
        self.ahead, self._threads = int(renders_on_gpu(backend)), None
        if backend == CPU:
            count = min(views, views_at_once(sum(map(len, scene.all_gaussians))))
            if count > 1:
                self.ahead, self._threads = count, divided_threads(count)

    def begin(
        self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO
    ) -> PendingView:
        """As the function `begin_view`."""
        if self._threads is None:
            return begin_view(scene, camera, recipe, backend=backend)
        drawn = self._threads.submit(
            lambda: begin_view(scene, camera, recipe, backend=backend).result()
        )
        return PendingView(lambda: awaited(drawn))

    def close(self) -> None:
        """Begin nothing more; what is being drawn is finished without being waited for."""
        if self._threads is not None:
            self._threads.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> ViewPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def render_views(
    scene: Scene, cameras: Sequence[Camera], recipe: Recipe, *, backend: str = AUTO
) -> Iterator[WeatheredView]:
    """`render_view` of each of the cameras, in their order and to the same bits; several are drawn
    at once. The error of a view has a note that names its camera.
    """
    with ViewPool(scene, backend, len(cameras)) as pool:
        begun = deque[tuple[Camera, PendingView]]()
        for camera in cameras:
            begun.append((camera, pool.begin(scene, camera, recipe, backend=backend)))
            if len(begun) > pool.ahead:
                yield _finished(*begun.popleft())
        for one in begun:
            yield _finished(*one)


def _finished(camera: Camera, begun: PendingView) -> WeatheredView:
    try:
        return begun.result()
    except Exception as error:
        error.add_note(f"in the view of camera {camera.name!r} at {camera.timestamp_ns} ns")
        raise
