"""The effect `lamps`: the hour, lamps and what they light, and the camera's exposure in the dark.

It stands after all weather and before drops on the lens. The finished picture of the day becomes
luminance (`hour`), lamps add theirs to surfaces, air and the picture itself, and an exposure turns
the sum into the picture of a camera. By day the picture keeps its bits where no lamp adds light.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import ClassVar

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
    LabelInputs,
    RenderedView,
    ViewQuery,
    Visibility,
    skipped_steps,
)
from augment.effects.lamps.exposure import READ_NOISE, Exposure
from augment.effects.lamps.glare import add_glare
from augment.effects.lamps.hour import find_hour, night_sky, white_of_picture
from augment.effects.lamps.lamp_light import add_lamp_light
from augment.effects.lamps.light_table import LIGHT_TABLE, measure_light
from augment.effects.lamps.picture_light import decode, develop, relight
from augment.effects.lamps.plan import (
    CAMERA_STEPS,
    GLARE,
    LAMP_STEPS,
    NIGHT_SKY,
    RELIGHT,
    SENSOR,
    SKY_STEPS,
    LightPlan,
    auto_reason,
    is_foul,
    make_light_plan,
    steps_of,
)
from augment.effects.lamps.scene_exposure import exposure_of
from augment.effects.lamps.sky_in_photo import replace_photo_sky
from augment.effects.lamps.view_lamps import describe_lamps, lamps_of_view
from augment.effects.wet.darkening import white_level
from augment.light.scene_light import find_scene_light
from augment.render.buffers import EXPECTED_DEPTH, REFERENCE, SPLAT_IDS
from augment.render.sensor import draw_noise
from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky, CubemapSky
from augment.timing import timed
from augment.view.layers import LayerRenderer
from recipes.light import Light
from recipes.schema import Recipe

# Linear light of the picture below which a lamp changes no pixel by day: an eighth of a grey level
# of a dark pixel.
MIN_ADDED = 3e-5


class LampsEffect(Effect):
    """The hour of the day, lamps, and the camera in the dark."""

    name = "lamps"
    section = "light"
    model = Light
    mask_name = "glare"
    is_see_through = True
    share_column = "glare_fraction"
    sees_exposure = True
    box_table = LIGHT_TABLE
    kernel_folders: ClassVar = ("augment.lamps",)

    def kernel_key(self, section: Light) -> Hashable:
        return section.is_dark if section.has_effect else None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        light = self.section_of(recipe)
        why = ""
        if light is None:
            why = "the recipe has no light"
        elif not light.has_effect:
            why = "by day, and all lamps are off"
        plan = None
        if light is not None and not why:
            hour = find_hour(light, scene, is_foul=is_foul(recipe))
            plan = make_light_plan(recipe, scene, light, hour)
            if not plan.has_lamps and not hour.is_dark:
                why = f"no lamp is on: {auto_reason(recipe, hour)[1]}"
        if plan is None or why:
            sky = skipped_steps(SKY_STEPS, why, SCENE)
            return EffectPlan(
                None, (*sky, *skipped_steps((*LAMP_STEPS, *CAMERA_STEPS), why, PICTURE))
            )
        lamp_reason = describe_lamps(plan, scene, auto_reason(recipe, plan.hour)[1])
        exposure_reason = exposure_of(plan, scene).reason if plan.hour.is_dark else ""
        steps = steps_of(plan, lamp_reason, exposure_reason)
        buffers = {EXPECTED_DEPTH, SPLAT_IDS} if plan.has_signs else {EXPECTED_DEPTH}
        return EffectPlan(plan, steps, frozenset(buffers))

    def sun_share(self, recipe: Recipe, scene: Scene) -> tuple[float, str]:
        light = self.section_of(recipe)
        if light is None or not light.is_dark:
            return 1.0, ""
        return 0.0, f"{self.section}.time is {light.time}: no sun"

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        plan: LightPlan = effect.settings
        lamps = lamps_of_view(plan, effect.scene, query.camera)
        if plan.hour.is_dark:
            return Visibility(view_data=lamps)
        if len(lamps) == 0:
            why = "no lamp that is on is in view"
            return Visibility(False, dict.fromkeys((*LAMP_STEPS, *CAMERA_STEPS), why))
        return Visibility(view_data=lamps)

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        plan: LightPlan = effect.settings
        if not plan.hour.is_dark:
            return layers
        with timed(NIGHT_SKY):
            white = white_level(find_scene_light(effect.lit_scene))
            sky = night_sky(plan.light, plan.hour.white_cd_m2, white)
        return replace(layers, sky=sky, needs_lamp_inputs=plan.has_lamps)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        if camera.is_orthographic:
            return view
        plan: LightPlan = effect.settings
        is_dark = plan.hour.is_dark
        color_map = effect.scene.color_map(camera) if plan.uses_color_map else None
        white = white_of_picture(effect.lit_scene, color_map)
        rgb = view.rgb.detach().cpu().numpy()
        if is_dark and view.layers.photo is not None:
            with timed(NIGHT_SKY):
                rgb = replace_photo_sky(rgb, view, camera, color_map)
        # Light of the picture at 1 cd/m2, and the factor of the picture's own.
        exposure = exposure_of(plan, effect.scene) if is_dark else _day_exposure(plan, white)
        gain = plan.hour.white_cd_m2 / white * exposure.scale if is_dark else 1.0
        added = add_lamp_light(effect, view, camera, rgb, white, MIN_ADDED / exposure.scale)
        with timed(RELIGHT):
            if added is None and not is_dark:
                return view
            out, mask = relight(
                rgb,
                added,
                gain,
                exposure.scale,
                -1.0 if is_dark else MIN_ADDED,
                uses_kernels=effect.backend != REFERENCE,
            )
            device = view.rgb.device
            layers = _exposed_layers(view.layers, gain) if is_dark else view.layers
        return replace(
            view,
            rgb=torch.from_numpy(out).to(device),
            layers=layers,
            masks={**view.masks, "glare": torch.from_numpy(mask).to(device)},
        )

    def reads_neighbours(self, effect: EffectInScene) -> bool:
        return True

    def expose(
        self, effect: EffectInScene, rgb: Float[Tensor, "H W 3"], camera: Camera
    ) -> Float[Tensor, "H W 3"]:
        plan: LightPlan = effect.settings
        if not plan.hour.is_dark or camera.is_orthographic:
            return rgb
        uses_kernels = effect.backend != REFERENCE
        exposure = exposure_of(plan, effect.scene)
        light = plan.light
        glare = None
        with timed(SENSOR):
            linear = decode(rgb.detach().cpu().numpy(), uses_kernels=uses_kernels)
        if light.glare > 0:
            with timed(GLARE):
                glare = add_glare(linear, (camera.fx + camera.fy) / 2, light.glare)
        with timed(SENSOR):
            draws = None
            if light.noise > 0:
                draws = draw_noise(camera, seed=plan.seed, scene=effect.scene.name)
            out = develop(
                linear,
                glare,
                draws,
                exposure.electrons / exposure.scale,
                READ_NOISE,
                light.noise,
                uses_kernels=uses_kernels,
            )
        return torch.from_numpy(out).to(rgb.device)

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        return measure_light(boxes, camera, inputs)


def _day_exposure(plan: LightPlan, white: float) -> Exposure:
    """Return the exposure of a picture of the day, by its white."""
    return Exposure(white / max(plan.hour.white_cd_m2, 1e-9), 1.0, "recorded")


def _exposed_layers(layers: LayerRenderer, gain: float) -> LayerRenderer:
    """Return the layers with the sky as it is exposed, for what looks at it later.

    Args:
        layers: the layers.
        gain: factor of the picture's linear light.
    """
    if layers.fog is not None and layers.fog.scale_height_m is None:
        sky_rgb = torch.tensor(layers.fog.airlight_rgb, dtype=torch.float32)
        scaled, _ = relight(sky_rgb.clamp_min(0).view(1, 1, 3).numpy(), None, gain, 0.0, -1.0)
        return replace(layers, sky=ConstantSky(torch.from_numpy(scaled[0, 0])), fog=None)
    if not isinstance(layers.sky, CubemapSky):
        return layers
    faces = layers.sky.faces
    scaled, _ = relight(faces.flatten(0, 1).numpy(), None, gain, 0.0, -1.0)
    sky = CubemapSky(torch.from_numpy(scaled).view(faces.shape))
    return replace(layers, sky=sky, fog=None)
