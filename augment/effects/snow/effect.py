"""Snow as an effect: hooks that lay it in a scene, render it, and apply it to boxes and LiDAR."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from augment.effects.effect import (
    PICTURE,
    SCENE,
    Effect,
    EffectInScene,
    EffectPlan,
    JobContext,
    LabelInputs,
    RenderedView,
    Step,
    ViewQuery,
    Visibility,
    skipped_steps,
)
from augment.effects.lidar.beam import Echoes
from augment.effects.snow.changing_snow import ChangingLayers, laid_plan, lay_changing_snow
from augment.effects.snow.glints import GLINT_SIZE_M
from augment.effects.snow.layer import lay_snow
from augment.effects.snow.layer_kernels import MAX_GRAIN_DISTANCE_M
from augment.effects.snow.lidar import intersect_snow
from augment.effects.snow.light import describe_light, find_snow_light
from augment.effects.snow.part_snow import PartSnow, SnowLayers
from augment.effects.snow.plan import SnowPlan, exposure_settings, naming_cell_field
from augment.effects.snow.relief import Carrier, add_grain
from augment.effects.snow.snowy_boxes import count_snow_pixels, extend_boxes_by_snow
from augment.effects.snow.wet_tracks import wet_tracks
from augment.exposure.cells import ExposedSurface
from augment.exposure.exposed_surface import exposed_surface_of, share_exposed_surface
from augment.light.cast_shadows import precompute_shadows
from augment.memo import memo_of
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.render.buffers import EXPECTED_DEPTH, OVERLAY
from augment.render.fog import Fog, optical_depth_numpy
from augment.render.fog_table import local_fog
from augment.scene.bounds import Bounds, bound_points, bound_squares, find_visible_owners
from augment.scene.boxes import NOT_COUNTED, WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.ground import check_metric_and_level
from augment.scene.scene import Gaussians, Scene
from augment.timing import timed
from augment.view.layers import LayerRenderer
from recipes.schema import Recipe
from recipes.snow import Snow

# Labels of the passes, in plans and timings.
LAYER_PASS, LIGHT_PASS = PASSES = ("snow: exposed surface and layer", "snow: light per pixel")
GRAIN_PASS = "snow: grain"
WET_PASS = "snow: wet tracks"
MIN_MASK_SHARE = 0.5  # least share of snow in a pixel of the mask
_CHUNK_M = 8.0  # side of the squares in which snow is bounded
_BOX_MARGIN_M = 0.3  # distance from a vehicle's box within which snow still lies on it


@dataclass(frozen=True)
class SnowView:
    """Snow in one view."""

    owners: frozenset[int]
    """Instance ids of the parts whose snow may be in view."""
    cameras: tuple[Camera, ...]
    """Cameras that look into the scene for this view."""


class SnowEffect(Effect):
    """Snow on surfaces that are open to the sky: new splats over the splats that they bury."""

    name = "snow"
    section = "weather.snow"
    model = Snow
    mask_name = "snow"
    adds_overlays = True
    precomputes_files = True
    kernel_folders = ("augment.exposure",)
    off_switches: ClassVar = {
        LAYER_PASS: ("weather.snow", None),
        LIGHT_PASS: ("weather.snow.shading", "per_splat"),
    }
    # pixels: number that show the box or the snow on it, or NOT_COUNTED without snow in view.
    # snow_pixels: number of them that show snow.
    box_table = BoxTable(
        name="box_snow",
        file="labels/snow.parquet",
        kind="box snow",
        columns={"pixels": np.int64, "snow_pixels": np.int64, "snow_fraction": np.float64},
        sample_columns=("snow_fraction",),
        derived_columns={"snow_fraction": pixel_fraction("snow_pixels")},
        hidden_column="snow_fraction",
    )

    def kernel_key(self, section: Snow) -> Hashable:
        return (section.shading, section.is_scaled) if section.has_effect else None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        snow = self.section_of(recipe)
        if snow is None or not snow.has_effect:
            reason = "the recipe has no snow"
            if snow is not None:
                missing_field = "depth" if snow.depth_m == 0 else "coverage"
                reason = f"the snow has no {missing_field}, so it changes nothing"
            steps = (
                *skipped_steps(PASSES, reason, SCENE),
                *skipped_steps((WET_PASS, GRAIN_PASS), reason, PICTURE),
            )
            return EffectPlan(None, steps)
        check_metric_and_level(scene)
        reason = (
            f"{snow.depth_m:.4g} m deep on {100 * snow.coverage:.3g} % of what is open to the sky, "
            f"no steeper than {snow.max_slope_deg:g} deg and seen by a camera; cells of "
            f"{100 * snow.cell_m:g} cm near the path; {describe_light(scene, snow)}"
        )
        if snow.is_scaled:
            reason += f"; laid once for {snow.laid_depth_m:.3g} m, and scaled"
        if snow.road is not None:
            reason += f"; {snow.road.depth_m:.2g} m on roads"
        levels = (other.water_level_z_m for other in later_plans.values())
        level_z_m = next((level for level in levels if level is not None), None)
        if level_z_m is not None:
            reason += f"; none below the water's level, z = {level_z_m:.2f} m"
        has_wet_ground = recipe.weather.rain is not None and recipe.weather.rain.ground_wetness > 0
        road_wetness = 0.0 if snow.road is None else snow.road.wetness
        has_wet_tracks = (snow.traffic > 0 or road_wetness > 0) and not has_wet_ground
        wet_reason = f"traffic is {snow.traffic:g}"
        if snow.road is not None:
            wet_reason += f", road.wetness {road_wetness:.2g}"
        if has_wet_ground:
            wet_reason = "weather.rain wets the road already"
        shading = f"shading is {snow.shading!r}"
        steps = (
            Step(LAYER_PASS, True, reason, SCENE),
            Step(LIGHT_PASS, snow.shading == "per_pixel", shading, SCENE),
            Step(WET_PASS, has_wet_tracks, wet_reason, PICTURE),
            Step(GRAIN_PASS, snow.grain > 0, f"grain is {snow.grain:g}", PICTURE),
        )
        seed = recipe.seed if snow.seed is None else snow.seed
        needs_depth = snow.grain > 0 or has_wet_tracks
        buffers = {OVERLAY, EXPECTED_DEPTH} if needs_depth else {OVERLAY}
        plan = SnowPlan(snow, seed, level_z_m, has_wet_ground)
        return EffectPlan(plan, steps, frozenset(buffers))

    def sun_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        snow = self.section_of(recipe)
        if snow is None or not snow.is_laid or snow.sun_fade == 0:
            return 1.0, ""
        share = 1 - snow.sun_fade
        return share, f"{self.section} leaves {100 * share:.0f} % of the sun's light"

    def gloss_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        snow = self.section_of(recipe)
        if snow is None or not snow.is_laid or snow.blue_fade == 0:
            return 1.0, ""
        share = 1 - snow.blue_fade
        return share, f"{self.section} leaves {100 * share:.0f} % of the sky's blue"

    def prepare(self, effect: EffectInScene) -> SnowLayers | ChangingLayers:
        build = build_changing_layers if effect.settings.snow.is_scaled else build_snow_layers
        return build(effect.scene, effect.settings, effect.lit_scene, backend=effect.backend)

    def precompute(self, context: JobContext) -> None:
        """Find the exposed surface of the scene, once for all recipes of the job."""
        sections = (self.section_of(recipe) for recipe in context.recipes)
        distinct = dict.fromkeys(
            exposure_settings(snow, context.scene) for snow in sections if snow and snow.is_laid
        )
        for settings in distinct:
            precompute_shadows(context.scene)
            with naming_cell_field():
                share_exposed_surface(
                    context.scene,
                    settings,
                    cameras=context.cameras,
                    folder=context.folder,
                    backend=context.backend,
                    progress=context.progress,
                )

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        layers = _laid_layers(effect)
        boxes = memo_of(layers).get(("boxes of snow",), lambda: _bound_layers(effect.scene, layers))
        owners = find_visible_owners(boxes, query.world_from_parts, query.cameras, query.near_m)
        if not owners:
            why = "neither snow nor what it buries can be in view"
            return Visibility(False, dict.fromkeys((*PASSES, WET_PASS, GRAIN_PASS), why))
        is_lit_per_pixel = any(_is_lit_per_pixel(layers.layer_on(effect.scene, n)) for n in owners)
        why = (
            {} if is_lit_per_pixel else {LIGHT_PASS: "no snow that is lit per pixel can be in view"}
        )
        return Visibility(
            skip_reasons=why,
            instance_ids=frozenset(owners - {0}),
            view_data=SnowView(frozenset(owners), query.cameras),
        )

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        with timed(LAYER_PASS):
            view = effect.view_data
            snow_layers = effect.prepared_data
            if isinstance(snow_layers, ChangingLayers):
                snow = effect.settings.snow
                if view is None:
                    snow_layers = snow_layers.at(snow)
                else:
                    actors = effect.scene.actors
                    track_ids = {actors[n - 1].track_id for n in view.owners if n > 0}
                    snow_layers = snow_layers.at(snow, view.cameras, track_ids)
            parts = snow_layers.parts_for(
                effect.scene,
                camera,
                layers.parts,
                None if view is None else view.owners,
                backend=effect.backend,
            )
            if layers.added_colors is not None:
                in_exposure = layers.added_colors.of_part
                parts = tuple(in_exposure(part) if part.is_overlay else part for part in parts)
        return replace(layers, parts=parts)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        snow = view.raster.overlay
        depth = view.raster.expected_depth
        if not camera.is_orthographic and not effect.settings.has_wet_ground:
            view = _wet_tracks(effect, view, camera)
        if (
            effect.settings.snow.grain == 0
            or camera.is_orthographic
            or snow is None
            or depth is None
        ):
            return view
        layers = _laid_layers(effect)
        masks_before_snow = list(view.masks.values())  # water lies before the snow beneath it
        with timed(GRAIN_PASS):
            rgb = add_grain(
                view.rgb,
                depth,
                snow,
                torch.stack(masks_before_snow).any(0) if masks_before_snow else None,
                camera,
                layers.grain,
                layers.sun,
                _find_carriers(effect, camera),
                extinction_per_m=_extinction_at(camera, view.layers.fog),
                backend=effect.backend,
            )
        return replace(view, rgb=rgb)

    def visible_mask(self, effect: EffectInScene, view: RenderedView) -> Bool[Tensor, "H W"] | None:
        overlay = view.raster.overlay
        return None if overlay is None else overlay >= MIN_MASK_SHARE

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        if _shows_snow(inputs) and inputs.depth_m is not None and inputs.mask is not None:
            thickness_m = inputs.plan.data.snow.depth_m
            counted = count_snow_pixels(boxes, camera, inputs.depth_m, inputs.mask, thickness_m)
            return {"pixels": counted.num_pixels, "snow_pixels": counted.num_marked}
        no_pixels = np.zeros(len(boxes), np.int64)
        return {"pixels": np.full(len(boxes), NOT_COUNTED), "snow_pixels": no_pixels}

    def grow_boxes(self, boxes: WorldBoxes, inputs: LabelInputs) -> WorldBoxes:
        shows_snow = _shows_snow(inputs)
        return extend_boxes_by_snow(boxes, inputs.plan.data.snow.depth_m) if shows_snow else boxes

    def intersect_beams(self, effect: EffectInScene, echoes: Echoes, frame_ns: int) -> None:
        intersect_snow(echoes, effect.scene, effect.settings, echoes.source, frame_ns)


def _wet_tracks(effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
    """Return the view with the bare road in the tracks of traffic wet."""
    layers = effect.prepared_data
    if isinstance(layers, ChangingLayers):
        wet_road = layers.wet_road_at(effect.settings.snow)
    else:
        wet_road = layers.wet_road
    raster = view.raster
    if wet_road is None or raster.alpha is None or raster.expected_depth is None:
        return view
    with timed(WET_PASS):
        share = raster.alpha if raster.overlay is None else raster.alpha - raster.overlay
        for mask in view.masks.values():
            share = torch.where(mask, 0.0, share)
        rgb = wet_tracks(
            view.rgb,
            raster.expected_depth,
            share,
            camera,
            wet_road,
            scene=effect.lit_scene,
            fog=view.layers.fog,
            backend=effect.backend,
        )
    return replace(view, rgb=rgb)


def _find_carriers(snow_effect: EffectInScene, camera: Camera) -> list[Carrier]:
    """Return the vehicles close to the camera that snow lies on."""
    carriers = list[Carrier]()
    for number in sorted(snow_effect.view_data.owners - {0}):
        actor = snow_effect.scene.actors[number - 1]
        world_from_actor = actor.track.pose_at(camera.timestamp_ns)
        half_size_m = np.array(actor.size_m) / 2 + _BOX_MARGIN_M
        if world_from_actor is None or not np.isfinite(half_size_m).all():
            continue
        if float(
            (world_from_actor[:3, 3] - camera.centre).norm()
        ) > MAX_GRAIN_DISTANCE_M + np.linalg.norm(half_size_m):
            continue
        high_corner = half_size_m + np.array([0, 0, 2 * snow_effect.settings.snow.depth_m])
        # Snow below this height is the snow that the vehicle stands in.
        low_corner = np.array([-half_size_m[0], -half_size_m[1], -half_size_m[2] / 3])
        carriers.append(
            Carrier(np.linalg.inv(world_from_actor.double().numpy()), low_corner, high_corner)
        )
    return carriers


def _extinction_at(camera: Camera, fog: Fog | None) -> float:
    """Return the fog's extinction at the camera, 1/metre."""
    fog = local_fog(fog, camera)
    if fog is None:
        return 0.0
    eye_z_m = np.array([float(camera.centre[2])])
    return float(optical_depth_numpy(fog, np.ones(1), eye_z_m, eye_z_m)[0])


def _shows_snow(inputs: LabelInputs) -> bool:
    """Tell if the view shows snow."""
    return inputs.plan.data is not None and inputs.mask is not None and bool(inputs.mask.any())


def build_snow_layers(
    scene: Scene, recipe_snow: SnowPlan, light: Scene | None = None, *, backend: str = "auto"
) -> SnowLayers:
    """Return the snow in the scene.

    Args:
        scene: the scene.
        recipe_snow: snow of a recipe.
        light: scene whose light the snow lies in; None for the scene's own.
        backend: backend that finds the exposed surface, unless it is known (see
            augment.exposure.exposed_surface).

    Raises:
        SceneError: this scene cannot have snow, or not with cells this small.
    """
    scene, light = _recorded_scenes(scene, light)
    exposed_surface = _exposed_surface(scene, recipe_snow, backend)

    def build_layers() -> SnowLayers:
        return lay_snow(
            exposed_surface,
            scene,
            recipe_snow.snow,
            find_snow_light(light or scene, recipe_snow.snow),
            seed=recipe_snow.seed,
            water_level_z_m=recipe_snow.water_level_z_m,
        )

    return memo_of(scene).get(("snow layers", recipe_snow, exposed_surface, light), build_layers)


def build_changing_layers(
    scene: Scene, recipe_snow: SnowPlan, light: Scene | None = None, *, backend: str = "auto"
) -> ChangingLayers:
    """Return the snow in the scene, for all depths up to the recipe's `placed_depth_m`.

    The arguments and errors are those of `build_snow_layers`.
    """
    plan = laid_plan(recipe_snow)
    scene, light = _recorded_scenes(scene, light)
    exposed_surface = _exposed_surface(scene, plan, backend)

    def build_layers() -> ChangingLayers:
        illumination = find_snow_light(light or scene, plan.snow)
        return lay_changing_snow(exposed_surface, scene, plan, illumination)

    return memo_of(scene).get(("changing snow", plan, exposed_surface, light), build_layers)


def _recorded_scenes(scene: Scene, light: Scene | None) -> tuple[Scene, Scene | None]:
    """Return the scene as recorded, and that of its light; None if they are the same."""
    recorded_light = None if light is None else light.as_recorded
    scene = scene.as_recorded
    return scene, None if recorded_light is scene else recorded_light


def _exposed_surface(scene: Scene, recipe_snow: SnowPlan, backend: str) -> ExposedSurface:
    """Return the cells of the scene that a recipe's snow lies on."""
    with naming_cell_field():
        return exposed_surface_of(
            scene, exposure_settings(recipe_snow.snow, scene), backend=backend
        )


def _laid_layers(effect: EffectInScene) -> SnowLayers:
    """Return the snow of a recipe, or the most of it that a changing recipe can have."""
    layers = effect.prepared_data
    return layers.laid if isinstance(layers, ChangingLayers) else layers


def _bound_layers(scene: Scene, layers: SnowLayers) -> Bounds:
    """Return the bounds of the snow on the ground and the actors."""
    parts = [(0, layers.ground, scene.background)]
    parts += [
        (n, layers.layer_on(scene, n), actor.gaussians)
        for n, actor in enumerate(scene.actors, start=1)
    ]
    return Bounds.join(_bound_layer(layer, gaussians, n) for n, layer, gaussians in parts if layer)


def _bound_layer(layer: PartSnow, gaussians: Gaussians, owner: int) -> Bounds:
    """Return the bounds of a part's snow, its glints, and the splats that it buries.

    Where none of these is in view, the part looks as it does without snow.
    """
    is_buried = (layer.visible_opacities.numpy() == 0) & (gaussians.opacities.numpy() > 0)
    everywhere = np.ones(len(layer.gaussians), bool)
    snow = bound_squares(layer.gaussians, everywhere, _CHUNK_M, owner)
    bounds = [snow, bound_squares(gaussians, is_buried, _CHUNK_M, owner)]
    if layer.crystals is not None:
        places = layer.crystals.places_m.numpy().astype(np.float64)
        bounds.append(bound_points(places, np.full(len(places), GLINT_SIZE_M), _CHUNK_M, owner))
    return Bounds.join(bounds)


def _is_lit_per_pixel(layer: PartSnow | None) -> bool:
    """Tell if a layer is lit pixel by pixel."""
    return layer is not None and layer.sunlight_rgb is not None and layer.normals is None
