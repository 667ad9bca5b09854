"""The effects rain and snowfall: they edit the finished picture by its depth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from augment.effects.effect import (
    PICTURE,
    Effect,
    EffectInScene,
    EffectPlan,
    JobContext,
    LabelInputs,
    RenderedView,
    Step,
    skipped_steps,
)
from augment.effects.falling.air import Precipitation, cell_walk, draw_falling, find_drops
from augment.effects.falling.drop_covers import cover_of_drops
from augment.effects.falling.drops import Kind
from augment.effects.falling.labels import falling_table, measure_falling
from augment.effects.falling.lidar import precipitation_echoes, scatterers_of
from augment.effects.falling.shower import Shower, reference_place
from augment.effects.falling.shutter import frame_interval_s, motion_of
from augment.effects.lidar.beam import Echoes
from augment.errors import SceneError
from augment.light.cast_shadows import precompute_shadows
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.timing import timed
from recipes.rain import Rain
from recipes.schema import Recipe
from recipes.snowfall import Snowfall

STREAKS = "rain streaks and veil"
FLAKES = "snowflakes and veil"


class FallingEffect(Effect):
    """Precipitation in the air. The data of its plan are a `Precipitation`."""

    is_see_through: ClassVar[bool] = True

    step: ClassVar[str]
    """Name of the pass."""

    kind: ClassVar[Kind]
    """Kind of the precipitation, as in `Precipitation`."""

    def reads_splats(self, recipe: Recipe) -> bool:
        section = self.section_of(recipe)
        return (
            section is not None
            and section.has_effect
            and max(section.sun_fade, section.blue_fade) > 0
        )

    def sun_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        section = self.section_of(recipe)
        if section is None or not section.has_effect or section.sun_fade == 0:
            return 1.0, ""
        share = 1 - section.sun_fade
        return share, f"{self.section} leaves {100 * share:.0f} % of the sun's light"

    def gloss_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        section = self.section_of(recipe)
        if section is None or not section.has_effect or section.blue_fade == 0:
            return 1.0, ""
        share = 1 - section.blue_fade
        return share, f"{self.section} leaves {100 * share:.0f} % of the sky's blue"

    def precompute(self, context: JobContext) -> None:
        sections = map(self.section_of, context.recipes)
        if any(s is not None and s.has_effect and s.sun_fade > 0 for s in sections):
            precompute_shadows(context.scene)

    def kernel_key(self, section: Rain | Snowfall) -> Any:
        return (section.has_effect, section.along is not None) if section.has_effect else None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        section: Rain | Snowfall | None = self.section_of(recipe)
        if section is None or not section.has_effect:
            why = f"the recipe has no {self.name}"
            if section is not None:
                why = f"{self.section}.rate_mm_h is 0"
            return EffectPlan(None, skipped_steps((self.step,), why, PICTURE))
        speed = recipe.render.speed
        is_rain = isinstance(section, Rain)
        precipitation = Precipitation(
            self.kind,
            section.rate_mm_h,
            wind_velocity_mps(section.wind_mps, section.wind_from_deg),
            0.0 if is_rain else section.turbulence_mps,
            recipe.seed,
            recipe.camera.exposure_ms / 1000,
            speed.rain_min_width_px if is_rain else speed.snowfall_min_width_px,
            section.color,
            section.peak_mm_h,
            _shower_of(section, scene, recipe.seed),
        )
        return _plan_of(precipitation, self.step, scene)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        assert self.mask_name is not None
        return _draw_over(effect, view, camera, self.step, self.mask_name)

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        assert self.box_table is not None
        return measure_falling(self.box_table, boxes, camera, inputs)

    def attenuate_beams(
        self, effect: EffectInScene, echoes: Echoes, rng: np.random.Generator
    ) -> None:
        settings: Precipitation = effect.settings
        table = None
        if settings.shower is not None:
            # The sensor's own place: its beams start within a metre of each other.
            origins_m = echoes.origins[echoes.ranges_m > 0]
            if len(origins_m) == 0:
                return
            sensor_m = np.median(origins_m, axis=0)
            table = settings.shower_about(sensor_m)
            settings = replace(settings, rate_mm_h=settings.shower.rate_at(sensor_m))
        scatterers = scatterers_of(settings.kind, float(settings.rate_mm_h))
        precipitation_echoes(echoes, scatterers, rng, table)


class RainEffect(FallingEffect):
    """Rain in the air."""

    name = "rain"
    section = "weather.rain"
    model = Rain
    mask_name = "rain"
    step = STREAKS
    kind = "rain"
    box_table = falling_table("rain", "streak")


class SnowfallEffect(FallingEffect):
    """Snow in the air."""

    name = "snowfall"
    section = "weather.snowfall"
    model = Snowfall
    mask_name = "snowfall"
    step = FLAKES
    kind = "snow"
    box_table = falling_table("snowfall", "flake")


def wind_velocity_mps(speed_mps: float, from_deg: float) -> tuple[float, float]:
    """Return a wind's velocity along x and y. from_deg: 0 comes from +x, 90 from +y."""
    angle = math.radians(from_deg)
    return -speed_mps * math.cos(angle), -speed_mps * math.sin(angle)


def _shower_of(section: Rain | Snowfall, scene: Scene, seed: int) -> Shower | None:
    """Return the shower of a recipe's section in a scene; None if its rate is the same everywhere.

    Places of one rate are rain that is the same everywhere, if it is the section's own rate.
    """
    places = tuple((place.distance_m, place.rate_mm_h) for place in section.along or ())
    if all(rate == section.rate_mm_h for _, rate in places):
        return None
    direction = wind_velocity_mps(1.0, section.wind_from_deg)
    return Shower(places, direction, reference_place(scene), seed)


def _plan_of(precipitation: Precipitation, step: str, scene: Scene) -> EffectPlan:
    """Return the plan. Raise SceneError if the exposure is longer than the frame interval."""
    interval = frame_interval_s(scene)
    if interval is not None and precipitation.exposure_s >= interval:
        raise SceneError(
            f"camera.exposure_ms = {precipitation.exposure_s * 1000:g} is not below the "
            f"{interval * 1000:.4g} ms between two images of a camera of scene {scene.name!r} "
            f"({scene.source}); set a shorter exposure"
        )
    why = (
        f"{precipitation.rate_mm_h:g} mm/h: "
        f"extinction {1000 * precipitation.sizes.extinction_per_m:.3g}/km, "
        f"shutter open for {precipitation.exposure_s * 1000:g} ms"
    )
    if precipitation.shower is not None:
        rates = [rate for _, rate in precipitation.shower.places]
        why += f"; a shower of {min(rates):g} to {max(rates):g} mm/h along the wind"
    if interval is None:
        why += "; the cameras' speed is not known, so they stand"
    if not scene.has_metric_scale:
        why += "; the scene's unit is not known to be a metre, so sizes are in scene units"
    if not scene.has_known_gravity:
        why += "; it falls along -z, which is not known to point down"
    return EffectPlan(
        precipitation, (Step(step, True, why, PICTURE),), frozenset({ALPHA, EXPECTED_DEPTH})
    )


def _draw_over(
    effect: EffectInScene, view: RenderedView, camera: Camera, step: str, mask: str
) -> RenderedView:
    alpha = view.raster.alpha
    depth = view.raster.expected_depth
    assert alpha is not None and depth is not None
    motion = motion_of(effect.scene, camera)
    precipitation = effect.settings.at(camera)
    with timed(step):
        drops = find_drops(cell_walk(precipitation, camera, motion, effect.lit_scene.name))
        rgb, drop_mask = draw_falling(
            view.rgb,
            alpha,
            depth,
            camera,
            precipitation,
            scene=effect.lit_scene,
            fog=view.layers.fog,
            motion=motion,
            splats=_surfaces_of(view),
            added_colors=view.layers.added_colors,
            drops=drops,
            backend=effect.backend,
        )
    masks = {**view.masks, mask: drop_mask}
    view = replace(view, rgb=rgb, masks=masks)
    if not view.layers.needs_lamp_inputs:
        return view
    with timed(f"{effect.hooks.name}: drops under lamps"):
        is_snow = effect.settings.kind == "snow"
        cover = cover_of_drops(drops, alpha, depth, is_snow=is_snow)
    return replace(view, drop_covers=(*view.drop_covers, cover))


def _surfaces_of(view: RenderedView) -> Float[Tensor, "H W 3"] | None:
    """Return the Gaussians' part of the picture; None if something was drawn over all of it."""
    is_first = not view.masks.keys() & {"rain", "snowfall"}
    photo = view.layers.photo
    if photo is not None:
        alpha = view.raster.alpha
        if alpha is None or not is_first:
            return None
        return photo.surface_part(view.rgb, alpha, view.layers.fog)
    splats = view.raster.rgb
    if splats is None:
        return None
    return splats if is_first and splats.data_ptr() != view.rgb.data_ptr() else None
