"""The effect lens drops: drops of water on the camera's glass, the last thing before the sensor."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace

from augment.effects.effect import (
    PICTURE,
    Effect,
    EffectInScene,
    EffectPlan,
    RenderedView,
    Step,
    skipped_steps,
)
from augment.effects.lens_drops.drops import LensDropsPlan, drops_at
from augment.effects.lens_drops.optics import blend_drops, draw_drops, map_surroundings
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.timing import timed
from recipes.fields import section_at
from recipes.lens_drops import LensDrops
from recipes.schema import Recipe

ON_GLASS = "lens drops"


class LensDropsEffect(Effect):
    """Drops on the glass before the lens, which show the scene upside down and out of focus."""

    name = "lens_drops"
    section = "camera.lens_drops"
    model = LensDrops
    mask_name = "lens_drops"
    is_see_through = True
    share_column = "lens_drops_fraction"

    def reads_splats(self, recipe: Recipe) -> bool:
        return False

    def kernel_key(self, section: LensDrops) -> Hashable:
        return section.has_effect or None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        drops = self.section_of(recipe)
        rate_mm_h = section_at(recipe, "weather.rain.rate_mm_h") or 0.0
        why = ""
        if drops is None or not drops.has_effect:
            absent = "the recipe has no drops on the lens"
            why = absent if drops is None else "camera.lens_drops says that there are none"
        elif drops.count is None and drops.share is None and rate_mm_h == 0:
            why = "camera.lens_drops.count is null, and there is no rain"
        if drops is None or why:
            return EffectPlan(None, skipped_steps((ON_GLASS,), why, PICTURE))
        blur_mrad = 2000 * drops.aperture_m / drops.glass_m
        number = f"{rate_mm_h:g} mm/h of"
        if drops.count is not None:
            number = f"{drops.count}"
        elif drops.share is not None:
            number = f"{100 * drops.share:g} % of the picture behind"
        why = (
            f"{number} drops about {drops.radius_mm:g} mm in radius, {drops.glass_m:g} m "
            f"before the lens, blurred over {blur_mrad:.3g} mrad; "
        )
        why += "never wiped" if drops.wiper_s is None else f"wiped every {drops.wiper_s:g} s"
        data = LensDropsPlan(drops, recipe.seed, rate_mm_h)
        return EffectPlan(data, (Step(ON_GLASS, True, why, PICTURE),))

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        if camera.is_orthographic:
            return view
        with timed(ON_GLASS):
            drops = drops_at(effect.settings, effect.scene, camera)
            lens = effect.settings.drops
            if len(drops.radii_m) == 0:
                return view
            around = map_surroundings(
                view.rgb, camera, view.layers, level=effect.scene.has_known_gravity
            )
            layer, step, margin = draw_drops(
                drops, around, camera, glass_m=lens.glass_m, aperture_m=lens.aperture_m
            )
            rgb, mask = blend_drops(view.rgb, layer, step, margin, backend=effect.backend)
        return replace(view, rgb=rgb, masks={**view.masks, self.mask_name: mask})
