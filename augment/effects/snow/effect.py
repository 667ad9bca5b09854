"""Snow as an effect: laid once a scene, seen or not by a camera, met by boxes and beams."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from augment.bounds import Bounds, bound_chunks, bound_points, owners_seen
from augment.boxes import NOT_COUNTED, PlacedBoxes
from augment.cameras import Camera
from augment.cast_shadows import share_shadows
from augment.drawing import LayerRenderer
from augment.effects.effect import (
    PICTURE,
    SCENE,
    Active,
    Drawn,
    Effect,
    EffectView,
    InView,
    Placed,
    Sharing,
    Sight,
    Step,
    skipped,
)
from augment.effects.lidar.beam import Echoes
from augment.effects.snow.kernels import FARTHEST_M
from augment.effects.snow.layer import build_snow_layer
from augment.effects.snow.lidar import meet_snow
from augment.effects.snow.light import illumination_of, told_light
from augment.effects.snow.near_camera import SIZE_M, Layer, SnowLayers
from augment.effects.snow.relief import Carrier, add_grain
from augment.effects.snow.snow import PlacedSnow, placed_in_snow, placement_settings, snow_pixels
from augment.effects.snow.support import share_support, support_of
from augment.ground import check_metric_and_level
from augment.jobs.box_tables import BoxTable, share_of_pixels
from augment.memo import memo_of
from augment.render.buffers import EXPECTED_DEPTH, OVERLAY
from augment.render.fog import Fog, optical_depth_of_arrays
from augment.scene import Gaussians, Scene
from augment.timing import timed
from recipes.schema import Recipe
from recipes.snow import Snow

LAID, PER_PIXEL = PASSES = ("snow: placement and layer", "snow: light per pixel")
GRAIN = "snow: grain"
SHOWN = 0.5  # share of a pixel that is snow where the mask says so
_CHUNK_M = 8.0  # side of the squares that snow is bounded in
_BESIDE_M = 0.3  # of a vehicle's box: snow that still lies on it


class SnowEffect(Effect):
    """Snow on what is open to the sky: splats of its own over those that it buries."""

    name, section, model, mask = "snow", "weather.snow", Snow, "snow"
    lies_on_scene = shares_files = True
    folded: ClassVar = {
        LAID: ("weather.snow", None),
        PER_PIXEL: ("weather.snow.shading", "per_splat"),
    }
    # pixels: that show the box or the snow on it, or NOT_COUNTED in an image without snow in view.
    # snow_pixels: those that show snow.
    table = BoxTable(
        name="box_snow",
        file="labels/snow.parquet",
        kind="box snow",
        columns={"pixels": np.int64, "snow_pixels": np.int64, "snow_fraction": np.float64},
        sampled=("snow_fraction",),
        derived={"snow_fraction": share_of_pixels("snow_pixels")},
        hidden="snow_fraction",
    )

    def kernels(self, section: Snow) -> Hashable:
        return section.shading

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        snow = self.of(recipe)
        if snow is None or not snow.changes:
            reason = "the recipe has no snow"
            if snow is not None:
                nothing = "depth" if snow.depth_m == 0 else "coverage"
                reason = f"the snow has no {nothing}, so it changes nothing"
            steps = (*skipped(PASSES, reason, SCENE), Step(GRAIN, False, reason, PICTURE))
            return Placed(None, steps)
        check_metric_and_level(scene)
        reason = (
            f"{snow.depth_m:g} m deep on {100 * snow.coverage:.3g} % of what is open to the sky, "
            f"no steeper than {snow.max_slope_deg:g} deg and seen by a camera; cells of "
            f"{100 * snow.cell_m:g} cm near the path; {told_light(scene, snow)}"
        )
        levels = (other.water_level_z_m for other in later.values())
        level_z_m = next((level for level in levels if level is not None), None)
        if level_z_m is not None:
            reason += f"; none below the water's level, z = {level_z_m:.2f} m"
        shading = f"shading is {snow.shading!r}"
        steps = (
            Step(LAID, True, reason, SCENE),
            Step(PER_PIXEL, snow.shading == "per_pixel", shading, SCENE),
            Step(GRAIN, snow.grain > 0, f"grain is {snow.grain:g}", PICTURE),
        )
        seed = recipe.seed if snow.seed is None else snow.seed
        buffers = {OVERLAY, EXPECTED_DEPTH} if snow.grain > 0 else {OVERLAY}
        return Placed(PlacedSnow(snow, seed, level_z_m), steps, frozenset(buffers))

    def prepare(self, own: Active) -> SnowLayers:
        return snow_layers_of(own.scene, own.data, own.light, backend=own.backend)

    def share(self, job: Sharing) -> None:
        """Where snow can lie."""
        sections = (self.of(recipe) for recipe in job.recipes)
        distinct = dict.fromkeys(
            placement_settings(snow, job.scene) for snow in sections if snow and snow.changes
        )
        for settings in distinct:
            share_shadows(job.scene)
            share_support(job, settings)

    def in_view(self, own: Active, sight: Sight) -> InView:
        layers = own.prepared
        boxes = memo_of(layers).get(("boxes of snow",), lambda: _bound_layers(own.scene, layers))
        owners = owners_seen(boxes, sight.poses, sight.cameras, sight.near_m)
        if not owners:
            why = "neither snow nor what it buries can be in view"
            return InView(False, dict.fromkeys((*PASSES, GRAIN), why))
        lit = any(_is_lit_per_pixel(layers.layer_on(own.scene, n)) for n in owners)
        why = {} if lit else {PER_PIXEL: "no snow that is lit per pixel can be in view"}
        return InView(skipped=why, owners=frozenset(owners - {0}), seen=frozenset(owners))

    def edit_scene(self, own: Active, layers: LayerRenderer, camera: Camera) -> LayerRenderer:
        with timed(LAID):
            parts = own.prepared.parts_for(
                own.scene, camera, layers.parts, own.seen, backend=own.backend
            )
        return replace(layers, parts=parts)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        snow, depth = drawn.raster.overlay, drawn.raster.expected_depth
        if own.data.snow.grain == 0 or camera.is_orthographic or snow is None or depth is None:
            return drawn
        layers = own.prepared
        hidden = list(drawn.masks.values())  # water lies before the snow beneath it
        with timed(GRAIN):
            rgb = add_grain(
                *(drawn.rgb, depth, snow, torch.stack(hidden).any(0) if hidden else None),
                *(camera, layers.grain, layers.sun, _carriers(own, camera)),
                extinction_per_m=_extinction_at(camera, drawn.layers.fog),
                backend=own.backend,
            )
        return replace(drawn, rgb=rgb)

    def mask_of(self, own: Active, drawn: Drawn) -> Bool[Tensor, "H W"] | None:
        overlay = drawn.raster.overlay
        return None if overlay is None else overlay >= SHOWN

    def measure(
        self, placed: PlacedBoxes, camera: Camera, view: EffectView
    ) -> dict[str, np.ndarray]:
        if _is_seen(view) and view.depth_m is not None and view.mask is not None:
            thickness_m = view.placed.data.snow.depth_m
            counted = snow_pixels(placed, camera, view.depth_m, view.mask, thickness_m)
            return {"pixels": counted.pixels, "snow_pixels": counted.marked}
        none = np.zeros(len(placed), np.int64)
        return {"pixels": np.full(len(placed), NOT_COUNTED), "snow_pixels": none}

    def grow_boxes(self, placed: PlacedBoxes, view: EffectView) -> PlacedBoxes:
        seen = _is_seen(view)
        return placed_in_snow(placed, view.placed.data.snow.depth_m) if seen else placed

    def meet(self, own: Active, echoes: Echoes, frame_ns: int) -> None:
        meet_snow(echoes, own.scene, own.data, echoes.source, frame_ns)


def _carriers(own: Active, camera: Camera) -> list[Carrier]:
    """The vehicles close to the camera that snow lies on."""
    found = list[Carrier]()
    for number in sorted(own.seen - {0}):
        actor = own.scene.actors[number - 1]
        pose = actor.track.pose_at(camera.timestamp_ns)
        half = np.array(actor.size_m) / 2 + _BESIDE_M
        if pose is None or not np.isfinite(half).all():
            continue
        if float((pose[:3, 3] - camera.centre).norm()) > FARTHEST_M + np.linalg.norm(half):
            continue
        high = half + np.array([0, 0, 2 * own.data.snow.depth_m])
        # What lies lower is the snow that the vehicle stands in.
        low = np.array([-half[0], -half[1], -half[2] / 3])
        found.append(Carrier(np.linalg.inv(pose.double().numpy()), low, high))
    return found


def _extinction_at(camera: Camera, fog: Fog | None) -> float:
    """1/metre."""
    if fog is None:
        return 0.0
    eye_z_m = np.array([float(camera.centre[2])])
    return float(optical_depth_of_arrays(fog, np.ones(1), eye_z_m, eye_z_m)[0])


def _is_seen(view: EffectView) -> bool:
    return view.placed.data is not None and view.mask is not None and bool(view.mask.any())


def snow_layers_of(
    scene: Scene, placed: PlacedSnow, light: Scene | None = None, *, backend: str = "auto"
) -> SnowLayers:
    """The snow in the scene. light: the scene whose light it lies in; None for its own. backend:
    that finds where snow can lie, unless that is known (augment.effects.snow.support).

    Raises:
        SceneError: snow cannot be placed in this scene, or not with cells this small.
    """
    support = support_of(scene, placement_settings(placed.snow, scene), backend=backend)
    light = None if light is scene else light

    def lay() -> SnowLayers:
        return build_snow_layer(
            support,
            scene,
            placed.snow,
            illumination_of(light or scene, placed.snow),
            seed=placed.seed,
            water_level_z_m=placed.water_level_z_m,
        )

    return memo_of(scene).get(("snow layers", placed, support, light), lay)


def _bound_layers(scene: Scene, layers: SnowLayers) -> Bounds:
    """Around the snow of the ground and the actors."""
    parts = [(0, layers.ground, scene.background)]
    parts += [(n, layers.layer_on(scene, n), a.gaussians)
        for n, a in enumerate(scene.actors, start=1)]  # fmt: skip
    return Bounds.join(_bound_layer(layer, own, n) for n, layer, own in parts if layer)


def _bound_layer(layer: Layer, own: Gaussians, owner: int) -> Bounds:
    """Around a part's snow, its glints, and what of the part it buries: where none of these is in
    view, the part looks as it does without snow.
    """
    buried = (layer.opacities.numpy() == 0) & (own.opacities.numpy() > 0)
    everywhere = np.ones(len(layer.gaussians), bool)
    snow = bound_chunks(layer.gaussians, everywhere, _CHUNK_M, owner)
    bounds = [snow, bound_chunks(own, buried, _CHUNK_M, owner)]
    if layer.crystals is not None:
        places = layer.crystals.places_m.numpy().astype(np.float64)
        bounds.append(bound_points(places, np.full(len(places), SIZE_M), _CHUNK_M, owner))
    return Bounds.join(bounds)


def _is_lit_per_pixel(layer: Layer | None) -> bool:
    return layer is not None and layer.slopes is not None and layer.normals is None
