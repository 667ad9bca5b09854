"""The effect lens drops: drops of water on the camera's glass, the last thing before the sensor."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace

from augment.cameras import Camera
from augment.effects.effect import PICTURE, Active, Drawn, Effect, Placed, Step, skipped
from augment.effects.lens_drops.drops import PlacedDrops, drops_at
from augment.effects.lens_drops.optics import blend_drops, draw_drops, map_surroundings
from augment.scene import Scene
from augment.timing import timed
from recipes.fields import found
from recipes.lens_drops import LensDrops
from recipes.schema import Recipe

ON_GLASS = "lens drops"


class LensDropsEffect(Effect):
    """Drops on the glass before the lens, which show the scene upside down and out of focus."""

    name = "lens_drops"
    section = "camera.lens_drops"
    model = LensDrops
    mask = "lens_drops"
    is_see_through = True
    share_column = "lens_drops_fraction"

    def reads_splats(self, recipe: Recipe) -> bool:
        return False

    def kernels(self, section: LensDrops) -> Hashable:
        return section.changes or None

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        drops = self.of(recipe)
        rate_mm_h = found(recipe, "weather.rain.rate_mm_h") or 0.0
        why = ""
        if drops is None or not drops.changes:
            absent = "the recipe has no drops on the lens"
            why = absent if drops is None else "camera.lens_drops.count is 0"
        elif drops.count is None and rate_mm_h == 0:
            why = "camera.lens_drops.count is null, and there is no rain"
        if drops is None or why:
            return Placed(None, skipped((ON_GLASS,), why, PICTURE))
        blur_mrad = 2000 * drops.aperture_m / drops.glass_m
        many = f"{rate_mm_h:g} mm/h of" if drops.count is None else f"{drops.count}"
        why = (
            f"{many} drops about {drops.radius_mm:g} mm in radius, {drops.glass_m:g} m "
            f"before the lens, blurred over {blur_mrad:.3g} mrad; "
        )
        why += "never wiped" if drops.wiper_s is None else f"wiped every {drops.wiper_s:g} s"
        data = PlacedDrops(drops, recipe.seed, rate_mm_h)
        return Placed(data, (Step(ON_GLASS, True, why, PICTURE),))

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        if camera.is_orthographic:
            return drawn
        with timed(ON_GLASS):
            drops = drops_at(own.data, own.scene, camera)
            lens = own.data.drops
            if len(drops.radii_m) == 0:
                return drawn
            around = map_surroundings(
                drawn.rgb, camera, drawn.layers, level=own.scene.has_known_gravity
            )
            layer, step, margin = draw_drops(
                drops, around, camera, glass_m=lens.glass_m, aperture_m=lens.aperture_m
            )
            rgb, mask = blend_drops(drawn.rgb, layer, step, margin, backend=own.backend)
        return replace(drawn, rgb=rgb, masks={**drawn.masks, self.mask: mask})
