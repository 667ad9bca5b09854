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
from jaxtyping import Bool, Float32

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
from augment.effects.lamps.glare import spread_glare, widen_glare
from augment.effects.lamps.hour import find_hour, night_sky, white_of_picture
from augment.effects.lamps.lamp_light import add_lamp_light
from augment.effects.lamps.light_table import (
    EXPOSURE_COLUMNS,
    LIGHT_TABLE,
    measure_exposure,
    measure_light,
)
from augment.effects.lamps.luminance import read_light
from augment.effects.lamps.picture_light import develop, halve_excess, relight
from augment.effects.lamps.plan import (
    CAMERA_STEPS,
    GLARE,
    LAMP_STEPS,
    METER,
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
from augment.effects.lamps.scene_exposure import exposure_of, exposure_of_picture, white_balance_of
from augment.effects.lamps.sky_in_photo import replace_photo_sky
from augment.effects.lamps.sources import count_lamps, without_sources
from augment.effects.lamps.view_lamps import describe_lamps, lamps_of_view
from augment.effects.wet.darkening import white_level
from augment.light.scene_light import find_scene_light
from augment.render.buffers import EXPECTED_DEPTH, REFERENCE
from augment.render.cpu.order import cached_of_tensor
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
# Linear light of a single lamp that may be left out: half a grey level of a black pixel.
MIN_LAMP_LIGHT = 1.5e-4
# The same in fog at dusk and night, where lit air leaves no pixel black.
MIN_LAMP_LIGHT_IN_FOG = 4e-4
# The same by day, whose fog is some hundred grey levels bright: half a level there.
MIN_LAMP_LIGHT_BY_DAY = 1e-3


class LampsEffect(Effect):
    """The hour of the day, lamps, and the camera in the dark."""

    name = "lamps"
    section = "light"
    model = Light
    mask_name = "glare"
    is_see_through = True
    share_column = "glare_fraction"
    sees_exposure = True
    measured_columns = EXPOSURE_COLUMNS
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
        return EffectPlan(plan, steps, frozenset({EXPECTED_DEPTH}))

    def without_parts(self, effect: EffectInScene, recipe: Recipe) -> dict[str, Recipe]:
        return without_sources(effect.settings, effect.scene, recipe)

    def count_parts(self, effect: EffectInScene, camera: Camera) -> dict[str, dict[str, int]]:
        return count_lamps(effect.settings, effect.scene, camera)

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
        exposure = exposure_of_picture(plan, effect.scene, effect.lit_scene, camera)
        gain = plan.hour.white_cd_m2 / white * exposure.scale if is_dark else 1.0
        least_light = MIN_LAMP_LIGHT if is_dark else MIN_LAMP_LIGHT_BY_DAY
        if is_dark and plan.extinction_per_m > 0:
            least_light = MIN_LAMP_LIGHT_IN_FOG
        added = add_lamp_light(
            effect, view, camera, rgb, white, least_light / exposure.scale, color_map
        )
        with timed(RELIGHT):
            if added is None and not is_dark:
                return view
            min_added = -1.0 if is_dark else MIN_ADDED
            uses_kernels = effect.backend != REFERENCE
            numbers = gain, exposure.scale, min_added
            out, mask = relight(rgb, added, *numbers, uses_kernels=uses_kernels)
        if not is_dark and added is not None and mask.any():
            with timed(GLARE):
                # A bright sky by day has no glare.
                glare = _glare(out, camera, plan.light.glare, mask, uses_kernels=uses_kernels)
                rows = None if glare is None else _add_glare(added, glare, exposure.scale)
                if rows is not None:
                    out[rows], _ = relight(
                        rgb[rows], added[rows], *numbers, uses_kernels=uses_kernels
                    )
        with timed(RELIGHT):
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

    def expose(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        plan: LightPlan = effect.settings
        if camera.is_orthographic:
            return view
        exposure = exposure_of_picture(plan, effect.scene, effect.lit_scene, camera)
        if not plan.hour.is_dark:
            return _read_light(effect, view, None, exposure)
        rgb = view.rgb
        uses_kernels = effect.backend != REFERENCE
        light = plan.light
        picture = rgb.detach().cpu().numpy()
        with timed(GLARE):
            glare = _glare(picture, camera, light.glare, uses_kernels=uses_kernels)
        with timed(SENSOR):
            draws = None
            if light.noise > 0:
                draws = draw_noise(camera, seed=plan.seed, scene=effect.scene.name)
            out = develop(
                picture,
                glare,
                draws,
                exposure.electrons / exposure.scale,
                READ_NOISE,
                light.noise,
                balance=white_balance_of(plan, effect.scene),
                uses_kernels=uses_kernels,
            )
        view = _read_light(effect, view, glare, exposure)
        return replace(view, rgb=torch.from_numpy(out).to(rgb.device))

    def measure_view(self, camera: Camera, inputs: LabelInputs) -> dict[str, float]:
        return measure_exposure(camera, inputs)

    def measure_boxes(
        self, boxes: WorldBoxes, camera: Camera, inputs: LabelInputs
    ) -> dict[str, np.ndarray]:
        return measure_light(boxes, camera, inputs)


def _glare(
    picture: Float32[np.ndarray, "H W 3"],
    camera: Camera,
    strength: float,
    mask: Bool[np.ndarray, "H W"] | None = None,
    *,
    uses_kernels: bool,
) -> Float32[np.ndarray, "h w 3"] | None:
    """Return the light that the lens scatters about saturated pixels, at half the resolution.

    None if there is none.

    Args:
        picture: the exposed picture, display-encoded, not clamped.
        camera: the view.
        strength: the recipe's `glare`.
        mask: pixels that have glare; None for all that are saturated.
        uses_kernels: False for the plain definition.
    """
    if strength <= 0:
        return None
    if mask is None:
        excess = halve_excess(picture, uses_kernels=uses_kernels)
    else:
        excess = _masked_excess(picture, mask, uses_kernels=uses_kernels)
    if excess is None:
        return None
    focal_px = (camera.fx + camera.fy) / 2
    return spread_glare(excess, max(camera.width, camera.height), focal_px, strength)


def _masked_excess(
    picture: Float32[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], *, uses_kernels: bool
) -> Float32[np.ndarray, "h w 3"] | None:
    """Return the light beyond saturation of the pixels in a mask, at half the resolution.

    None if there is none.

    Args:
        picture: the exposed picture, display-encoded, not clamped.
        mask: the pixels; at least one is True.
        uses_kernels: False for the plain definition.
    """
    sides = []
    for axis in (1, 0):
        lines = np.flatnonzero(mask.any(axis)).tolist()
        sides.append(slice(lines[0] // 2 * 2, lines[-1] // 2 * 2 + 2))
    box = (sides[0], sides[1])
    lit = np.where(mask[box][..., None], picture[box], np.float32(0))
    excess_of_box = halve_excess(lit, uses_kernels=uses_kernels)
    if excess_of_box is None:
        return None
    height, width = mask.shape
    excess = np.zeros((-(-height // 2), -(-width // 2), 3), np.float32)
    coarse_box = tuple(slice(side.start // 2, side.stop // 2) for side in box)
    excess[coarse_box] = excess_of_box
    return excess


def _add_glare(
    added: Float32[np.ndarray, "H W 3"], glare: Float32[np.ndarray, "h w 3"], scale: float
) -> slice | None:
    """Add glare to the light of lamps, in place, where it can be seen by day.

    Args:
        added: light of lamps, cd/m2.
        glare: light that the lens scatters, of saturation, at half the resolution.
        scale: light of the picture at 1 cd/m2.

    Returns:
        The rows that have glare; None without any.
    """
    peaks = np.maximum(np.maximum(glare[..., 0], glare[..., 1]), glare[..., 2])
    is_seen = peaks >= MIN_LAMP_LIGHT_BY_DAY
    if not is_seen.any():
        return None
    box = []
    for axis, size in ((1, added.shape[0]), (0, added.shape[1])):
        lines = np.flatnonzero(is_seen.any(axis)).tolist()
        box.append(slice(max(2 * lines[0] - 2, 0), min(2 * lines[-1] + 4, size)))
    rows, columns = box
    coarse = (
        slice(rows.start // 2, -(-rows.stop // 2)),
        slice(columns.start // 2, -(-columns.stop // 2)),
    )
    source = np.where(is_seen[coarse][..., None], glare[coarse], np.float32(0))
    height = rows.stop - rows.start
    width = columns.stop - columns.start
    added[rows, columns] += widen_glare(source, width, height) / np.float32(scale)
    return rows


def _read_light(
    effect: EffectInScene, view: RenderedView, glare: np.ndarray | None, exposure: Exposure
) -> RenderedView:
    """Return the view with its luminance, where labels need it, and glare in its mask.

    Args:
        effect: the effect in the scene.
        view: the exposed picture before the sensor.
        glare: light that the lens scatters, at half the resolution, [h, w, 3]; None for none.
        exposure: the camera's exposure.
    """
    plan: LightPlan = effect.settings
    with timed(METER):
        if glare is None and not plan.needs_luminance:
            return view
        reading = read_light(
            view.rgb.detach().cpu().numpy(),
            glare,
            exposure.white_cd_m2,
            needs_luminance=plan.needs_luminance,
            uses_kernels=effect.backend != REFERENCE,
        )
        device = view.rgb.device
        masks = dict(view.masks)
        if glare is not None:
            masks["glare"] = masks["glare"] | torch.from_numpy(reading.is_veiled).to(device)
        luminance = reading.luminance_cd_m2
        if luminance is None:
            return replace(view, masks=masks)
        return replace(view, masks=masks, luminance_cd_m2=torch.from_numpy(luminance).to(device))


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

    def expose_sky() -> CubemapSky:
        scaled, _ = relight(faces.flatten(0, 1).numpy(), None, gain, 0.0, -1.0)
        return CubemapSky(torch.from_numpy(scaled).view(faces.shape))

    sky = cached_of_tensor(faces, f"exposed by {gain!r}", expose_sky)
    return replace(layers, sky=sky, fog=None)
