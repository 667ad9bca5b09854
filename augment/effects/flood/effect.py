"""The flood effect: the water's level in a scene, its picture, box labels and LiDAR.

`FloodEffect` turns a recipe's `weather.flood` into a `FloodMedium`. `flood_view` draws the picture.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from augment.effects.effect import (
    Effect,
    EffectInScene,
    EffectPlan,
    FrontSurface,
    JobContext,
    LabelInputs,
    RenderedView,
    Step,
    ViewQuery,
    Visibility,
    skipped_steps,
)
from augment.effects.flood.flood_medium import FloodMedium
from augment.effects.flood.flood_view import COARSE, MAX_MARGIN, MAX_SHIFT, render_flooded
from augment.effects.flood.lidar import meet_flood
from augment.effects.flood.mirroring_water import mirroring_water
from augment.effects.flood.water_plane import mirrored_camera, plane_depth, plane_window
from augment.effects.flood.waves import make_waves
from augment.effects.lidar.beam import Echoes
from augment.errors import SceneError
from augment.memo import memo_of
from augment.output.box_tables import BoxTable, pixel_fraction
from augment.scene.bounds import lowest_z_m
from augment.scene.boxes import NOT_COUNTED, BoxPixels, WorldBoxes, count_pixels
from augment.scene.cameras import Camera
from augment.scene.ground import ground_of
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.view.layers import LayerRenderer
from recipes.flood import Flood
from recipes.schema import Recipe

PASSES: tuple[str, ...] = (
    "flood: waves",
    "flood: bed",
    "flood: mirrored view",
    "flood: screen march",
)
MIN_DEPTH_M = 0.05  # smallest water depth, metres, that the waves' dispersion takes
# Pixels added to the margins of flood_view, for their rounding and for the blur of splats.
_SPARE_PX = 8.0


class FloodEffect(Effect):
    """Standing water. It draws the scene in layers: above the surface, below it, and mirrored."""

    name = "flood"
    section = "weather.flood"
    model = Flood
    mask_name = "water"
    raster_passes = PASSES[1:3]
    # submerged_fraction: share of the box's height that is under water. pixels: number of pixels
    # that show the box, or NOT_COUNTED in an image without water in view. hidden_pixels: number of
    # those pixels that show the box through water.
    box_table = BoxTable(
        name="box_water",
        file="labels/water.parquet",
        kind="box water",
        columns={
            "submerged_fraction": np.float64,
            "pixels": np.int64,
            "hidden_pixels": np.int64,
            "hidden_fraction": np.float64,
        },
        sample_columns=("submerged_fraction", "hidden_fraction"),
        derived_columns={"hidden_fraction": pixel_fraction("hidden_pixels")},
        hidden_column="hidden_fraction",
    )

    def kernel_key(self, section: Flood) -> Hashable:
        return section.reflection

    def precompute(self, context: JobContext) -> None:
        """Precompute the height of the road."""
        if any(self.section_of(recipe) is not None for recipe in context.recipes):
            with suppress(SceneError):  # every image reports the error itself
                scene = context.scene.as_recorded
                memo_of(scene).put(("ground",), ground_of(scene), shared=True)

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        flood = self.section_of(recipe)
        if flood is None:
            return EffectPlan(
                None, tuple(Step(name, False, "the recipe has no flood") for name in PASSES)
            )
        medium, reason = flood_of_recipe(flood, recipe, scene)
        level_z_m = medium.level_z_m
        if lowest_z_m(scene) >= level_z_m:
            why = f"no splat reaches below the level, z = {level_z_m:.2f} m"
            return EffectPlan(None, skipped_steps(PASSES, why), water_level_z_m=level_z_m)
        return EffectPlan(medium, _steps(medium, reason), water_level_z_m=level_z_m)

    def cameras(self, effect: EffectInScene, camera: Camera) -> tuple[Camera, ...] | None:
        is_drawn = _is_under(effect.settings, camera) or plane_window(
            camera, effect.settings.level_z_m
        )
        return layer_cameras(effect.settings, camera) if is_drawn else None

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        camera = query.camera
        if _is_under(effect.settings, camera):
            why = "the camera is under water: it sees what lies below and what lies above"
            return Visibility(skip_reasons=dict.fromkeys(PASSES, why))
        if plane_window(camera, effect.settings.level_z_m) is None:
            why = "no ray of this camera meets the water's plane"
            return Visibility(False, dict.fromkeys(PASSES, why))
        return Visibility()

    def draw(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera, buffers: frozenset[str]
    ) -> RenderedView | None:
        medium: FloodMedium = effect.settings
        if layers.added_colors is not None:
            medium = replace(medium, rgb=layers.added_colors.of_color(medium.rgb))
        image = render_flooded(layers, camera, medium, buffers)
        if image is None:
            return None
        why = "what stands before the water hides all of it"
        skip_reasons = dict.fromkeys(PASSES if image.is_hidden else (), why)
        view = RenderedView(image.rgb, image.scene, layers, {"water": image.water}, skip_reasons)
        if not layers.needs_lamp_inputs:
            return view
        water = mirroring_water(image, camera, medium.level_z_m)
        return view if water is None else replace(view, waters=(water,))

    def front_surface(self, effect: EffectInScene, camera: Camera) -> FrontSurface | None:
        if _is_under(effect.settings, camera):  # from below, the surface has no depth
            return FrontSurface(int(SemanticClass.WATER), None)
        return FrontSurface(
            int(SemanticClass.WATER), plane_depth(camera, effect.settings.level_z_m)
        )

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        level_z_m = inputs.plan.water_level_z_m
        assert level_z_m is not None
        pixels = np.full(len(boxes), NOT_COUNTED)
        num_hidden = np.zeros(len(boxes), np.int64)
        if inputs.depth_m is not None and inputs.mask is not None:
            counted = count_hidden_pixels(boxes, camera, inputs.depth_m, inputs.mask)
            pixels = counted.num_pixels
            num_hidden = counted.num_marked
        submerged = submerged_fraction(boxes, level_z_m)
        return {"submerged_fraction": submerged, "pixels": pixels, "hidden_pixels": num_hidden}

    def intersect_beams(self, effect: EffectInScene, echoes: Echoes, frame_ns: int) -> None:
        meet_flood(echoes, effect.settings)


def _is_under(medium: FloodMedium, camera: Camera) -> bool:
    return float(camera.centre[2]) <= medium.level_z_m


def flood_of_recipe(flood: Flood, recipe: Recipe, scene: Scene) -> tuple[FloodMedium, str]:
    """Return the flood at its height in the scene, and the text that explains it.

    Args:
        flood: the recipe's section.
        recipe: the recipe. Drops of its rain draw rings on the water.
        scene: the scene; its road gives the height.

    Raises:
        SceneError: the scene's scale, gravity or road is not known.
    """
    rain = recipe.weather.rain
    rain_mm_h = rain.rate_mm_h if rain is not None else 0.0
    speed = recipe.render.speed
    ground = ground_of(scene)
    bases = {"lowest": ground.lowest_z_m, "median": ground.median_z_m, "absolute": 0.0}
    level_z_m = bases[flood.reference] + flood.level_m
    depth_m = max(level_z_m - ground.lowest_z_m, MIN_DEPTH_M)
    medium = FloodMedium(
        level_z_m=level_z_m,
        extinction_per_m=flood.extinction_per_m_rgb,
        rgb=flood.color,
        waves=make_waves(flood.waves, seed=recipe.seed, depth_m=depth_m),
        refraction_index=flood.refraction_index,
        fresnel=flood.fresnel,
        reflection=flood.reflection,
        bed_cut=speed.bed_cut,
        layers_px=speed.layers_px,
        rain_mm_h=rain_mm_h,
        seed=recipe.seed,
    )
    reason = (
        f"surface at z = {level_z_m:.2f} m, {level_z_m - ground.lowest_z_m:.2f} m above the lowest "
        f"road ({ground.source}), reflection {flood.reflection}, "
        f"{len(medium.waves.amplitudes_m)} waves{', rings of drops' if rain_mm_h > 0 else ''}"
    )
    return medium, reason


def _steps(medium: FloodMedium, reason: str) -> tuple[Step, ...]:
    waves = len(medium.waves.amplitudes_m)
    tier = medium.reflection
    mirrored = {
        "sky": "reflection 'sky' shows no scene",
        "screen_space": "at a quarter of the resolution, for what the screen does not show",
        "mirrored": "at full resolution",
    }
    steps = (
        (waves > 0, reason if waves else "the surface is still"),
        (True, f"{reason}; splats are cut at the surface"),
        (tier != "sky", mirrored[tier]),
        (tier == "screen_space", f"reflection is {tier!r}"),
    )
    return tuple(Step(name, *step) for name, step in zip(PASSES, steps, strict=True))


def layer_cameras(medium: FloodMedium, camera: Camera) -> tuple[Camera, ...]:
    """Return cameras that together cover all that the layers of a view with water can show."""
    wide = _grown(camera, MAX_SHIFT * camera.height + _SPARE_PX)
    if medium.reflection == "sky" or _is_under(medium, camera):
        return (wide,)
    margin = MAX_MARGIN * max(camera.width, camera.height) + _SPARE_PX / COARSE
    return wide, _grown(mirrored_camera(camera, medium.level_z_m), margin)


def _grown(camera: Camera, margin_px: float) -> Camera:
    margin = int(np.ceil(margin_px))
    return camera.cropped(-margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)


# ---- Labelled boxes ------------------------------------------------------------------------------


def submerged_fraction(boxes: WorldBoxes, level_z_m: float) -> Float64[np.ndarray, " B"]:
    """Return the share of each box's height that is under water, 0 to 1.

    The corners give the height, also of tilted boxes. A box without height is either under water
    or not. A box whose numbers are not finite has NaN.

    Args:
        boxes: the boxes, in the scene's world.
        level_z_m: height of the water, scene world.
    """
    z = boxes.corners_m[..., 2]  # [B, 8]
    low = z.min(axis=1)
    high = z.max(axis=1)
    height = high - low
    with np.errstate(invalid="ignore"):
        fraction = (level_z_m - low) / np.where(height > 0, height, 1.0)
        flat = np.where(level_z_m > low, 1.0, 0.0)
    fraction = np.where(height > 0, np.clip(fraction, 0.0, 1.0), flat)
    return np.where(boxes.is_usable, fraction, np.nan)


def count_hidden_pixels(
    boxes: WorldBoxes,
    camera: Camera,
    scene_depth_m: Float32[np.ndarray, "H W"],
    water: UInt8[np.ndarray, "H W"],
) -> BoxPixels:
    """Count the pixels that show each box, and those of them (`num_marked`) that water hides.

    Args:
        boxes: the boxes, in the scene's world.
        camera: camera of the image.
        scene_depth_m: z of the scene's surface behind the water, metres; 0 = none.
        water: 255 where water is the first surface.
    """
    return count_pixels(boxes, camera, scene_depth_m, water)
