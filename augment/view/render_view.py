"""Rendering of one view of a scene in its weather, as float buffers and as 8-bit images.

In: a scene, a camera, a recipe. Out: `WeatheredBuffers` (tensors, by `render_buffers`) or
`WeatheredView` (arrays as files hold them, by `render_view`). Jobs, the viewer and the tools call
`begin_view` or a `ViewPool`, so that the next view begins before the last one has left the GPU.
`augment.view.plan` decides which passes a view needs; this module runs them in the order of
`EFFECTS`.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from augment import effects
from augment.detail.prune import prune_parts
from augment.effects.effect import EffectInScene, LabelInputs, RenderedView
from augment.exposure.vehicle_cells import parked_vehicles
from augment.light.cast_shadows import faded_shadows
from augment.light.common_exposure import added_colors
from augment.light.sky_gloss import GreyedGloss, find_sky_gloss
from augment.output.layout import TRUST
from augment.photo.greyed_photo import SMALL_PX, grey_photo
from augment.photo.lens_photo import open_lens_photo, scene_colors, transfer_change
from augment.photo.own_car import OwnCar, own_car_in_view
from augment.photo.own_car_snow import cover_own_car
from augment.photo.parked_objects import ObjectBox, ParkedObjects
from augment.photo.photo_objects import copy_size
from augment.photo.recorded_base import PhotoView, mix, open_photo, splat_classes
from augment.photo.trust import trust_mask
from augment.render.backends import choose_backend, renders_on_gpu
from augment.render.buffers import ALPHA, AUTO, CPU, EXPECTED_DEPTH, SPLAT_IDS, RenderOutput
from augment.render.composite import apply_color_map, to_bytes
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.render.sensor import add_noise, blur_lens
from augment.render.threads import num_concurrent_views, split_threads, wait_for_result
from augment.rng import rng_for
from augment.scene.cameras import Camera
from augment.scene.labels import EGO_VEHICLE
from augment.scene.pinhole_scene import pinhole_scene
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.timing import timed
from augment.view.box_labels import OWN_CAR_DEPTH_M
from augment.view.images import ViewImages, start_images
from augment.view.layers import LayerRenderer
from augment.view.lens_view import ViewPicture, draw_through_lens
from augment.view.plan import (
    BARE_SURFACE_PASS,
    GLOSS_PASS,
    LENS_BLUR_PASS,
    SENSOR_NOISE_PASS,
    SHADOW_PASS,
    Plan,
    ViewPlan,
    plan_at,
    plan_view,
)
from augment.view.results import (
    BareBuffers,
    LabelSurfaces,
    PendingView,
    WeatheredBuffers,
    WeatheredView,
)
from recipes.schema import Recipe

# ---- The passes of one view, in the order in which they run --------------------------------------


def render_view(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO
) -> WeatheredView:
    """Render one view under the recipe's weather, in 8 bits.

    Args:
        scene: the scene.
        camera: the view, before recipe.render.scale.
        recipe: the weather and the outputs.
        backend: as for `rasterize`, but "auto" takes the GPU where there is one.
    """
    return begin_view(scene, camera, recipe, backend=backend).result()


def begin_view(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO) -> PendingView:
    """Begin the view of `render_view`; its `result` waits for the GPU.

    Another view can be begun before this one's result is asked for. The arguments are those of
    `render_view`. The view of a camera with a lens or a rolling shutter is finished here.
    """
    scene = pinhole_scene(scene)
    if backend == AUTO:
        backend = choose_backend(backend, scene)
    with timed("plan"):
        recipe, plan = plan_at(recipe, scene, camera.timestamp_ns)
    camera = camera.scaled(recipe.render.scale)
    if not (camera.is_pinhole or camera.is_orthographic):
        finished_view = _render_lens_view(scene, camera, plan, recipe, backend)
        return PendingView(lambda: finished_view)
    buffers = render_buffers(scene, camera, plan, backend=backend)
    images = start_images(buffers, plan)
    # The closure below holds the camera and not the buffers, which the images may long outlive.
    camera = buffers.camera
    trust = dict[str, np.ndarray]()
    if recipe.output.trust:
        with timed("trust mask"):
            trust[TRUST] = trust_mask(scene, camera, backend=backend)
    own_car = None
    if plan.is_on_photo:
        with timed("recording car"):
            own_car = own_car_in_view(scene, camera)
    if own_car is not None:
        trust = {name: np.where(own_car.mask, np.uint8(0), mask) for name, mask in trust.items()}
    active = {effect.hooks.name: effect for effect in plan.active_effects(scene, backend=backend)}
    return PendingView(lambda: _weathered(images(), camera, plan, recipe, active, trust, own_car))


def render_buffers(
    scene: Scene, camera: Camera, plan: Plan, *, backend: str = AUTO
) -> WeatheredBuffers:
    """Render one view as floats.

    Args:
        scene: the scene.
        camera: the view, at the resolution to render; without lens and rolling shutter.
        plan: the passes that the recipe requires (`augment.view.plan.plan_at`).
        backend: as for `rasterize`.
    """
    drawing = _draw_scene(scene, camera, plan, backend=backend)
    return _expose(scene, camera, plan, drawing, backend=backend)


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A picture before the camera's sensor."""

    view: ViewPlan
    """Plan of the view."""
    rendered: RenderedView
    """The picture."""
    color_map: Tensor | None
    """Colour map that the finished picture gets, [3, 4]; None without one."""
    parts: tuple[PosedGaussians, ...]
    """The parts of the scene with what lies on them."""
    bare_parts: tuple[PosedGaussians, ...]
    """The parts of the scene alone."""
    own_car: OwnCar | None
    """The recording car in a recorded image; None where there is none."""


def _draw_scene(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    backend: str,
    is_behind_lens: bool = True,
    photo_view: PhotoView | None = None,
) -> _Drawing:
    """Return the picture of a view before the camera's sensor.

    Args:
        scene: the scene.
        camera: the view.
        plan: the plan of all views.
        backend: as for `rasterize`.
        is_behind_lens: if False, effects on the glass before the lens are left out.
        photo_view: the recorded image in this view of it; None if the image is the camera's own.
    """
    with timed("view plan"):
        view = plan_view(plan, scene, camera, backend=backend)
    own_car = None
    is_fading = plan.sun_share < 1 or plan.gloss_fade > 0
    if plan.is_on_photo and (is_fading or any(map(_is_weather, view.effects))):
        with timed("recording car"):
            lens_camera = None if photo_view is None else photo_view.lens_camera
            own_car = own_car_in_view(scene, camera, lens_camera)
    with timed("collect parts"):
        actor_ids = view.actor_ids
        if own_car is not None:  # the photo shows the car, and a fit's splats of it lie beside it
            actor_ids = [i for i in actor_ids if scene.actors[i - 1].label != EGO_VEHICLE]
        bare_parts = scene.parts_for(camera, actor_ids)
    color_map = scene.color_map(camera) if plan.uses_recorded_exposure else None
    photo = None
    if plan.is_on_photo:
        with timed("photo"):
            # Snow lies on surfaces that the scene has; all else looks at those of the photo.
            finds_sky = plan.depth_buffer is not None or any(
                not effect.hooks.adds_overlays for effect in view.effects
            )
            photo = open_photo(
                scene, camera, color_map, backend=backend, finds_sky=finds_sky, view=photo_view
            )
    layers = LayerRenderer(bare_parts, scene.sky, None, False, plan.settings, backend, photo)
    if photo is not None:
        layers = replace(layers, parked=partial(_parked_objects, scene, bare_parts[0].gaussians))
    if plan.uses_common_exposure:
        layers = replace(layers, added_colors=added_colors(scene, camera))
    for effect in view.effects:
        if is_fading and _is_weather(effect):  # a style comes first, with maps of its own
            layers = _cover_sky(layers, scene, camera, plan, own_car)
            is_fading = False
        layers = effect.hooks.edit_scene(effect, layers, camera)
    if is_fading:
        layers = _cover_sky(layers, scene, camera, plan, own_car)
    if plan.prune > 0:
        with timed("prune"):
            parts = prune_parts(layers.parts, scene, camera, plan.prune)
            layers = replace(layers, parts=parts, unpruned_parts=layers.parts)
    car_rgb = None
    if own_car is not None and photo is not None and layers.photo is not None:
        # In the colours of a style, and with the gloss that it was recorded with.
        car_rgb = replace(layers.photo, pixels=photo.pixels).own_car_colors(own_car.rows)
    rendered = _draw(view, layers, camera)
    picture_effects = [e for e in view.effects if is_behind_lens or not is_on_glass(e)]
    if own_car is None or car_rgb is None:
        for effect in picture_effects:
            rendered = _edit_image(view, effect, rendered, camera, color_map)
    else:
        if plan.covers_own_car:
            rng = rng_for(
                seed=plan.seed, scene=scene.name, effect="snow on the own car", camera=camera.name
            )
            car_rgb = cover_own_car(car_rgb, own_car, rendered.raster, rng=rng)
        rendered = _edit_around_own_car(
            view, picture_effects, rendered, camera, own_car, car_rgb, color_map
        )
    return _Drawing(view, rendered, color_map, tuple(layers.parts), bare_parts, own_car)


def _expose(
    scene: Scene, camera: Camera, plan: Plan, drawing: _Drawing, *, backend: str
) -> WeatheredBuffers:
    """Return the buffers of a view whose picture has been drawn, as the sensor records it.

    Args:
        scene: the scene.
        camera: the view.
        plan: the plan of all views.
        drawing: the picture.
        backend: as for `rasterize`.
    """
    view = drawing.view
    rendered = _record_picture(
        scene, camera, plan, view, drawing.rendered, drawing.color_map, backend
    )
    with timed("depth of surfaces"):
        depth_m = _surface_depth(rendered.raster, plan, plan.image_buffers)
    return WeatheredBuffers(
        camera=camera,
        rgb=rendered.rgb,
        raster=rendered.raster,
        depth_m=depth_m,
        parts=drawing.parts,
        plan=view.skip_steps(rendered.skip_reasons),
        masks=_masks(view, rendered, drawing.own_car),
        bare_buffers=_bare(rendered.raster, drawing.bare_parts, camera, plan, view, backend),
        luminance_cd_m2=rendered.luminance_cd_m2,
    )


def _record_picture(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    view: ViewPlan,
    picture: RenderedView,
    color_map: Tensor | None,
    backend: str,
) -> RenderedView:
    """Return a picture after the camera's colours, its lens's blur and its sensor.

    Args:
        scene: the scene.
        camera: the view.
        plan: the plan of all views.
        view: the plan of this view.
        picture: the picture.
        color_map: the camera's colour map, [3, 4]; None without one.
        backend: as for `rasterize`.
    """
    rendered = picture
    rgb = rendered.rgb
    # A camera exposes what the weather has left, so this comes last if no effect needs it before.
    if color_map is not None and _first_exposed(view) is None:
        with timed("camera colour map"):
            rgb = apply_color_map(rgb, color_map, backend=backend)
    if plan.sensor.psf_px > 0:
        with timed(LENS_BLUR_PASS):
            rgb = blur_lens(rgb, plan.sensor.psf_px)
    rendered = replace(rendered, rgb=rgb)
    for effect in view.effects:
        rendered = effect.hooks.expose(effect, rendered, camera)
    rgb = rendered.rgb
    if plan.sensor.noise > 0:
        with timed(SENSOR_NOISE_PASS):
            noise_sigma = plan.sensor.noise
            noise_seed = plan.seed
            rgb = add_noise(
                rgb, noise_sigma, camera, seed=noise_seed, scene=scene.name, backend=backend
            )
    return replace(rendered, rgb=rgb)


def _render_lens_view(
    scene: Scene, camera: Camera, plan: Plan, recipe: Recipe, backend: str
) -> WeatheredView:
    """Return the finished view of a camera with a lens or a rolling shutter.

    Pinhole views are drawn and put together. Then come the effects on the glass before the lens,
    the lens's blur and the sensor, once for the whole picture.

    Args:
        scene: the scene, with pinhole cameras.
        camera: the view, at the resolution to render.
        plan: the plan of all views.
        recipe: the recipe at the moment of the view.
        backend: as for `rasterize`.
    """
    drawings = list[_Drawing]()
    lens_photo = None
    if plan.is_on_photo:
        with timed("photo"):
            lens_photo = open_lens_photo(scene, camera)

    moves_rows = camera.shutter is not None and lens_photo is None
    if moves_rows:
        plan = replace(plan, image_buffers=plan.image_buffers | {ALPHA, EXPECTED_DEPTH})

    def draw(view_camera: Camera, blur_gain: float, lens_camera: Camera) -> ViewPicture:
        photo_view = None
        photo_rgb = None
        if lens_photo is not None:
            with timed("photo"):
                photo_view = PhotoView(
                    lens_photo.pixels_in(lens_camera, view_camera), lens_photo.frame, lens_camera
                )
                color_map = scene.color_map(camera) if plan.uses_recorded_exposure else None
                photo_rgb = scene_colors(photo_view.pixels, color_map)
        blur_px2 = plan.settings.blur_px2 * blur_gain
        plan_of_view = replace(plan, settings=replace(plan.settings, blur_px2=blur_px2))
        drawing = _draw_scene(
            scene,
            view_camera,
            plan_of_view,
            backend=backend,
            is_behind_lens=False,
            photo_view=photo_view,
        )
        drawings.append(drawing)
        rendered = drawing.rendered
        raster = rendered.raster
        buffers = WeatheredBuffers(
            camera=view_camera,
            rgb=rendered.rgb,
            raster=raster,
            depth_m=_surface_depth(raster, plan, plan.image_buffers),
            parts=drawing.parts,
            plan=drawing.view,
            masks=_masks(drawing.view, rendered, drawing.own_car),
            bare_buffers=_bare(
                raster, drawing.bare_parts, view_camera, plan, drawing.view, backend
            ),
        )
        has_trust = recipe.output.trust
        own_car = own_car_in_view(scene, view_camera, lens_camera) if plan.is_on_photo else None
        return ViewPicture(
            rendered.rgb.detach().float().cpu().numpy(),
            start_images(buffers, plan)(),
            trust=trust_mask(scene, view_camera, backend=backend) if has_trust else None,
            own_car=None if own_car is None else own_car.mask,
            motion_depth_m=_motion_depth(raster) if moves_rows else None,
            photo_rgb=photo_rgb,
        )

    num_strips = recipe.render.shutter_strips
    picture = draw_through_lens(camera, num_strips, draw, moves_rows=moves_rows)
    names = {effect.hooks.name for drawing in drawings for effect in drawing.view.effects}
    first = drawings[0]
    effects_in_view = tuple(
        next(
            effect
            for drawing in drawings
            for effect in drawing.view.effects
            if effect.hooks.name == name
        )
        for name in (effect.name for effect in effects.EFFECTS)
        if name in names
    )
    view = replace(first.view, effects=effects_in_view)
    image_camera = camera.without_lens()
    masks = {name: torch.from_numpy(mask) > 0 for name, mask in picture.images.masks.items()}
    picture_rgb = picture.rgb
    if lens_photo is not None and picture.photo_rgb is not None:
        with timed("photo"):
            recorded_rgb = scene_colors(lens_photo.pixels, first.color_map)
            picture_rgb = transfer_change(picture_rgb, picture.photo_rgb, recorded_rgb)
    rendered = RenderedView(
        torch.from_numpy(picture_rgb), RenderOutput(), first.rendered.layers, masks=masks
    )
    glass_effects = [effect for effect in view.effects if is_on_glass(effect)]
    for effect in glass_effects:
        rendered = _edit_image(view, effect, rendered, image_camera, first.color_map)
    rendered = _record_picture(scene, image_camera, plan, view, rendered, first.color_map, backend)
    rgb = rendered.rgb.detach()
    if picture.is_inside is not None and lens_photo is None:
        rgb = torch.where(torch.from_numpy(picture.is_inside)[..., None], rgb, 0.0)
    luminance = rendered.luminance_cd_m2
    images = replace(
        picture.images,
        rgb=to_bytes(rgb).cpu().numpy(),
        masks={
            name: np.where(mask.cpu().numpy(), np.uint8(255), np.uint8(0))
            for name, mask in rendered.masks.items()
        },
        luminance_cd_m2=None if luminance is None else luminance.float().cpu().numpy(),
    )
    own_car = picture.own_car
    car = None if own_car is None else OwnCar(own_car, slice(0, 0), np.zeros((0, camera.width)))
    trust = {} if picture.trust is None else {TRUST: picture.trust}
    if own_car is not None:
        trust = {name: np.where(own_car, np.uint8(0), mask) for name, mask in trust.items()}
    active = {effect.hooks.name: effect for effect in plan.active_effects(scene, backend=backend)}
    return _weathered(images, camera, plan, recipe, active, trust, car)


def _motion_depth(raster: RenderOutput) -> np.ndarray:
    """Return z of the surfaces by which rows of a rolling shutter are moved, 0 = none."""
    assert raster.alpha is not None and raster.expected_depth is not None
    is_surface = raster.alpha.detach() >= SURFACE_ALPHA
    return torch.where(is_surface, raster.expected_depth.detach(), 0.0).float().cpu().numpy()


def is_on_glass(effect: EffectInScene) -> bool:
    """Return True if the effect lies on the glass before the lens, and so on the whole image."""
    return effect.hooks.section.startswith("camera.")


def _parked_objects(scene: Scene, background: Gaussians) -> ParkedObjects:
    """Return the labelled vehicles of the background that stand still.

    Args:
        scene: the scene.
        background: the Gaussians of its background, without snow.
    """
    vehicles = parked_vehicles(scene)
    boxes = tuple(ObjectBox(v.centre_m, v.rotation, v.size_m) for v in vehicles)
    return ParkedObjects(boxes, background)


def _draw(view: ViewPlan, layers: LayerRenderer, camera: Camera) -> RenderedView:
    """Return the view as rendered by the last effect that draws the scene in layers of its own, or,
    without such an effect, as one layer with its sky.
    """
    for effect in reversed(view.effects):
        rendered = effect.hooks.draw(effect, layers, camera, view.buffers)
        if rendered is not None:
            return rendered
    return RenderedView(*layers.render_with_sky(camera, view.buffers), layers)


def _cover_sky(
    layers: LayerRenderer, scene: Scene, camera: Camera, plan: Plan, own_car: OwnCar | None
) -> LayerRenderer:
    """Return the layers without what the sun and the blue sky of a clear day leave on surfaces.

    Args:
        layers: the layers, before any weather.
        scene: the scene.
        camera: the view.
        plan: the plan of all views.
        own_car: the recording car in a recorded image; None where there is none.
    """
    if plan.sun_share < 1:
        layers = _fade_shadows(layers, scene, plan.sun_share)
    if plan.gloss_fade > 0:
        layers = _grey_gloss(layers, scene, camera, plan.gloss_fade, own_car)
    return layers


def _grey_gloss(
    layers: LayerRenderer, scene: Scene, camera: Camera, fade: float, own_car: OwnCar | None
) -> LayerRenderer:
    """Return the layers with the blue sky in glossy surfaces turned grey.

    Args:
        layers: the layers, before any weather.
        scene: the scene.
        camera: the view.
        fade: how much of the blue turns grey, 0 to 1.
        own_car: the recording car in a recorded image, whose pixels show no surface of the scene;
            None where there is none.
    """
    with timed(GLOSS_PASS):
        gloss = find_sky_gloss(scene)
        if gloss is None:
            return layers
        greyed = GreyedGloss(gloss, fade)
        photo = layers.photo
        if photo is not None:
            small_camera = camera.resized(*copy_size(camera, SMALL_PX))
            raster = rasterize(
                layers.parts,
                small_camera,
                buffers=frozenset({SPLAT_IDS}),
                settings=replace(layers.settings, sh_degree=0),
                backend=layers.backend,
            )
            assert raster.splat_ids is not None
            splat_ids = raster.splat_ids.cpu().long()
            # The last class is that of pixels without a splat, whose id is -1.
            classes = splat_classes(layers.parts, splat_ids.device)
            classes = torch.cat([classes, torch.tensor([-1], dtype=torch.int16)])[splat_ids]
            class_image = classes.numpy()
            if own_car is not None:
                class_image[own_car.mask_at(small_camera.width, small_camera.height)] = -1
            photo = grey_photo(photo, class_image, gloss, fade)
        parts = tuple(part if part.is_overlay else greyed.apply_to(part) for part in layers.parts)
    return replace(layers, parts=parts, photo=photo)


def _fade_shadows(layers: LayerRenderer, scene: Scene, sun_share: float) -> LayerRenderer:
    """Return the layers with the cast shadows on the ground faded.

    Args:
        layers: the layers, before any weather.
        scene: the scene.
        sun_share: share of the sun's light that arrives at the ground.
    """
    with timed(SHADOW_PASS):
        shadows = faded_shadows(scene, sun_share)
        if shadows is None:
            return layers
        parts = tuple(
            part if part.instance_id or part.is_overlay else shadows.apply_to(part)
            for part in layers.parts
        )
        photo = layers.photo and replace(layers.photo, faded_shadows=shadows)
    return replace(layers, parts=parts, photo=photo)


def _is_weather(effect: EffectInScene) -> bool:
    """Return True if the effect lies in the air or on the scene: no style, and not on the lens."""
    return effect.hooks.section.startswith("weather.")


def _first_exposed(view: ViewPlan) -> EffectInScene | None:
    """Return the first effect in view that needs the picture after the camera's colour map."""
    return next((effect for effect in view.effects if effect.hooks.sees_exposure), None)


def _edit_image(
    view: ViewPlan,
    effect: EffectInScene,
    rendered: RenderedView,
    camera: Camera,
    color_map: Tensor | None,
) -> RenderedView:
    """Return the picture with an effect on it, after the colour map if the effect is the first
    that needs that.

    Args:
        view: the plan of the view.
        effect: the effect.
        rendered: the picture.
        camera: the view.
        color_map: the camera's colour map, [3, 4]; None without one.
    """
    if color_map is not None and effect is _first_exposed(view):
        with timed("camera colour map"):
            rgb = rendered.rgb.clone()  # which may be the recorded image
            rendered = replace(
                rendered, rgb=apply_color_map(rgb, color_map, backend=effect.backend)
            )
    return effect.hooks.edit_image(effect, rendered, camera)


def _edit_around_own_car(
    view: ViewPlan,
    picture_effects: Sequence[EffectInScene],
    first_view: RenderedView,
    camera: Camera,
    own_car: OwnCar,
    car_rgb: Tensor,
    color_map: Tensor | None,
) -> RenderedView:
    """Return the view with all effects on the picture, and no weather on the recording car.

    The car is put into the picture before effects that the weather leaves to it or whose pixels
    depend on their neighbours, and at the end.

    Args:
        view: the plan of the view.
        picture_effects: effects that edit the picture.
        first_view: the picture before `edit_image` of the effects.
        camera: the view.
        own_car: the recording car in it.
        car_rgb: colours of the car's rows, [h, W, 3].
        color_map: the camera's colour map, [3, 4]; None without one.
    """
    rendered = first_view
    is_car_covered = True
    for effect in picture_effects:
        is_weather = _is_weather(effect)
        if is_car_covered and (not is_weather or effect.hooks.reads_neighbours(effect)):
            rendered = _with_own_car(rendered, first_view, own_car, car_rgb)
            is_car_covered = False
        unedited = rendered
        rendered = _edit_image(view, effect, rendered, camera, color_map)
        if rendered is unedited:
            continue
        is_car_covered = is_weather
        if not is_weather:
            car_rgb = rendered.rgb[own_car.rows].clone()
    return _with_own_car(rendered, first_view, own_car, car_rgb) if is_car_covered else rendered


def _with_own_car(
    rendered: RenderedView, first_view: RenderedView, own_car: OwnCar, car_rgb: Tensor
) -> RenderedView:
    """Return the view with the recording car in given colours, fading out in the car's border.

    Args:
        rendered: the picture, which is written into.
        first_view: the picture before effects edited it. If it is a picture that others read, it
            is copied.
        own_car: the recording car in it.
        car_rgb: colours of the car's rows, [h, W, 3].
    """
    with timed("recording car"):
        if rendered.rgb is first_view.rgb and _is_shared(first_view):
            rendered = replace(rendered, rgb=rendered.rgb.clone())
        weights = torch.from_numpy(own_car.weights).to(rendered.rgb.device)
        rows = rendered.rgb[own_car.rows]
        rows.copy_(mix(rows, car_rgb, weights))
    return rendered


def _is_shared(rendered: RenderedView) -> bool:
    """Return True if a picture is the photo itself, or one of the scene's buffers."""
    raster_rgb = rendered.raster.rgb
    if raster_rgb is not None and raster_rgb.data_ptr() == rendered.rgb.data_ptr():
        return True
    photo = rendered.layers.photo
    return photo is None or photo.is_land(rendered.rgb)


def _masks(view: ViewPlan, rendered: RenderedView, own_car: OwnCar | None) -> dict[str, Tensor]:
    """Return a bool mask for each effect in view: the pixels that show the effect.

    A pixel that several opaque effects cover belongs to the one that is applied last.

    Args:
        view: the plan of the view.
        rendered: the picture.
        own_car: the recording car, which no weather covers; None where there is none.
    """
    masks = dict[str, Tensor]()
    opaque_masks = list[Tensor]()
    for effect in reversed(view.effects):
        mask = effect.hooks.visible_mask(effect, rendered)
        if mask is not None and effect.hooks.mask_name is not None:
            if own_car is not None and _is_weather(effect):
                mask = mask & ~torch.from_numpy(own_car.mask).to(mask.device)
            for opaque_mask in opaque_masks:
                mask = mask & ~opaque_mask
            masks[effect.hooks.mask_name] = mask
            opaque_masks += [] if effect.hooks.is_see_through else [mask]
    return masks


def _surface_depth(raster: RenderOutput, plan: Plan, buffers: frozenset[str]) -> Tensor | None:
    """Return z of the surfaces, metres, 0 where there is none; None unless the plan needs it.

    The planned depth estimator is taken if it is among `buffers`, else the expected depth, which
    labels are measured from.
    """
    if plan.depth_buffer is None and not plan.finds_boxes:
        return None
    estimator = plan.depth_buffer if plan.depth_buffer in buffers else None
    z = getattr(raster, estimator or EXPECTED_DEPTH)
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
    """Return the buffers of the scene without what lies on it; None unless planned.

    Args:
        raster: buffers of the picture, which shows the bare scene where the view has no pass for
            it.
        parts: the scene's parts, without what effects laid on them.
        camera: the view.
        plan: the plan of all views.
        view: the plan of this view.
        backend: as for `rasterize`.
    """
    if not plan.bare_buffers:
        return None
    if view.bare_buffers:
        with timed(BARE_SURFACE_PASS):
            raster = rasterize(
                parts, camera, buffers=view.bare_buffers, settings=plan.settings, backend=backend
            )
    return BareBuffers(raster, _surface_depth(raster, plan, plan.bare_buffers), parts)


def _weathered(
    images: ViewImages,
    camera: Camera,
    plan: Plan,
    recipe: Recipe,
    active: Mapping[str, EffectInScene],
    trust: Mapping[str, np.ndarray],
    own_car: OwnCar | None,
) -> WeatheredView:
    """Return the finished view: the images, and what labels are measured from.

    Surfaces behind the recording car are left out: a picture that shows the car does not show them.
    """
    car_mask = None if own_car is None else own_car.mask
    masks = dict(trust)
    views = dict[str, LabelInputs]()
    for effect in effects.EFFECTS:
        if effect.section_of(recipe) is None:
            continue
        effect_plan = plan.effect_plans[effect.name]
        mask = images.masks.get(effect.mask_name or "")
        is_in_view = effect_plan.data is not None and (effect.mask_name is None or mask is not None)
        depth = images.scene_depth_m if is_in_view else None
        depth = _outside(car_mask, depth, OWN_CAR_DEPTH_M)
        luminance = images.luminance_cd_m2
        views[effect.name] = LabelInputs(
            plan=effect_plan,
            depth_m=depth,
            mask=mask,
            water_level_z_m=plan.water_level_z_m,
            luminance_cd_m2=luminance,
            effect=active.get(effect.name),
        )
        if effect.mask_name is not None:
            empty_mask = np.zeros((camera.height, camera.width), np.uint8)
            masks[effect.mask_name] = empty_mask if mask is None else mask
    return WeatheredView(
        camera=camera,
        rgb=images.rgb,
        depth_m=None if plan.depth_buffer is None else _outside(car_mask, images.depth_m, 0.0),
        semantic=_outside(car_mask, images.semantic, 0.0) if plan.has_semantic else None,
        instance=_outside(car_mask, images.instance, 0.0),
        masks=masks,
        effects=views,
        surface=_surface_view(images, plan, car_mask),
    )


def _outside(mask: np.ndarray | None, image: np.ndarray | None, value: float) -> np.ndarray | None:
    """Return an image with a value, in the image's type, where a mask is True."""
    if mask is None or image is None:
        return image
    return np.where(mask, image.dtype.type(value), image)


def _surface_view(
    images: ViewImages, plan: Plan, own_car: np.ndarray | None
) -> LabelSurfaces | None:
    """Return the surfaces that labels are measured from; None where nobody asks for boxes."""
    depth = images.scene_depth_m
    is_bare = bool(plan.bare_buffers)
    if depth is None:
        return None
    shows_first = plan.shows_first_hit and plan.water_level_z_m is not None
    # The other images show the surfaces of this depth, unless they are bare or show the water.
    is_of_depth = not (is_bare or shows_first)
    return LabelSurfaces(
        depth_m=depth,
        actor_instance=images.instance if is_of_depth else None,
        classes=images.semantic if is_of_depth else None,
        instance_depth_m=images.depth_m if is_bare else depth,
        instance_classes=images.semantic,
        is_bare=is_bare,
        own_car=own_car,
    )


# ---- Several views at once -----------------------------------------------------------------------
# On the CPU some work of a view cannot be divided, and threads that share a view wait for each
# other. All cores are busy only if each thread renders a view of its own, in its own work space.


class ViewPool:
    """Begins views of a scene, several at once on threads of their own.

    On a GPU, or where there is only one thread, views are rendered one after the other. Close the
    pool, or use it as a context manager. `num_in_flight` is how many views may be in flight while
    another is begun.

    Args:
        scene: the scene, whose size decides how many threads pay off.
        backend: as for `render_view`.
        max_views: the largest number of views that will be begun.
    """

    def __init__(self, scene: Scene, backend: str = AUTO, max_views: int = sys.maxsize) -> None:
        backend = choose_backend(backend, scene) if backend == AUTO else backend
        self.num_in_flight = int(renders_on_gpu(backend))
        self._threads = None
        if backend == CPU:
            count = min(max_views, num_concurrent_views(sum(map(len, scene.all_gaussians))))
            if count > 1:
                self.num_in_flight = count
                self._threads = split_threads(count)

    def begin(
        self, scene: Scene, camera: Camera, recipe: Recipe, *, backend: str = AUTO
    ) -> PendingView:
        """Begin a view, as the function `begin_view` does."""
        if self._threads is None:
            return begin_view(scene, camera, recipe, backend=backend)
        future = self._threads.submit(
            lambda: begin_view(scene, camera, recipe, backend=backend).result()
        )
        return PendingView(lambda: wait_for_result(future))

    def close(self) -> None:
        """Begin no further view; views that are being rendered are finished, and nobody waits for
        them.
        """
        if self._threads is not None:
            self._threads.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> ViewPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def render_views(
    scene: Scene, cameras: Sequence[Camera], recipe: Recipe, *, backend: str = AUTO
) -> Iterator[WeatheredView]:
    """Yield `render_view` of each camera, in order and to the same bits.

    Several views are rendered at once. The exception of a view has a note that names its camera.

    Args:
        scene: the scene.
        cameras: the views, before recipe.render.scale.
        recipe: the weather and the outputs.
        backend: as for `render_view`.
    """
    with ViewPool(scene, backend, len(cameras)) as pool:
        pending_views = deque[tuple[Camera, PendingView]]()
        for camera in cameras:
            pending_views.append((camera, pool.begin(scene, camera, recipe, backend=backend)))
            if len(pending_views) > pool.num_in_flight:
                yield _finish_view(*pending_views.popleft())
        for pending_view in pending_views:
            yield _finish_view(*pending_view)


def _finish_view(camera: Camera, pending: PendingView) -> WeatheredView:
    """Return the result of a view; an exception gets a note that names its camera."""
    try:
        return pending.result()
    except Exception as error:
        error.add_note(f"in the view of camera {camera.name!r} at {camera.timestamp_ns} ns")
        raise
