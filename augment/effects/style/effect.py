"""The effect `style`: colour maps on the scene, or on the finished picture.

It reads the recipe section `style`. The maps come from `augment.effects.style.style`. The list
`augment.effects.EFFECTS` holds the effect.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from augment.effects.effect import (
    PICTURE,
    SCENE,
    Effect,
    EffectInScene,
    EffectPlan,
    JobContext,
    RenderedView,
    Step,
)
from augment.effects.style.color_maps import StyleMaps
from augment.effects.style.style import SceneStyle, scene_style_of, style_maps
from augment.memo import memo_of
from augment.render.composite import apply_color_map
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.timing import timed
from augment.view.layers import LayerRenderer
from recipes.schema import Recipe
from recipes.style import Style

# Time label and plan step of a style that is put on the scene.
SCENE_STEP = "style on the scene"
# Time label and plan step of a style that is put on the finished picture.
PICTURE_STEP = "style on the picture"


@dataclass(frozen=True, eq=False)
class PackedMaps:
    """Maps as NumPy arrays, for other processes.

    The memory of pickled tensors would end with the process that made them.
    """

    arrays: tuple[Any, ...]
    """The fields of `StyleMaps`, in order."""

    @staticmethod
    def of(maps: StyleMaps) -> PackedMaps:
        """Pack the maps."""
        tensors = (getattr(maps, field.name) for field in fields(maps))
        return PackedMaps(tuple(None if t is None else t.numpy() for t in tensors))

    def load(self) -> StyleMaps:
        """Return the maps as tensors."""
        tensors: list[Any] = [
            None if a is None else torch.from_numpy(a.copy()) for a in self.arrays
        ]
        return StyleMaps(*tensors)


class StyleEffect(Effect):
    """Style effect. Maps colours of the scene or picture to those of an image or a preset."""

    name = "style"
    section = "style"
    model = Style
    off_switches: ClassVar = {SCENE_STEP: ("style", None)}

    def kernel_key(self, section: Style) -> Hashable:
        return (section.applied_to, section.method) if section.has_effect else None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        style = self.section_of(recipe)
        if style is None or not style.has_effect:
            off_reason = "the recipe has no style"
            if style is not None:
                off_reason = "the style has no strength, so it changes nothing"
            steps = (
                Step(SCENE_STEP, False, off_reason, SCENE),
                Step(PICTURE_STEP, False, off_reason, PICTURE),
            )
            return EffectPlan(None, steps)
        source_text = f"image {Path(style.image or '').name}"
        if style.preset:
            source_text = f"preset {style.preset!r}"
        style_text = f"{style.method} from {source_text} at strength {style.strength:g}"
        on_picture = style.applied_to == "picture"
        maps_text = "a map for every region" if style.per_region else "one map for all splats"
        evaluation_text = {
            "color": "applied as they are projected",
            "sh": "folded into the background's SH once, applied to actors as they are projected",
        }[style.evaluated]
        other_reason = f"style.applied_to is {style.applied_to!r}"
        scene_reason = (
            f"{style_text}, {maps_text}, {evaluation_text}; snow and water keep their colours"
        )
        steps = (
            Step(SCENE_STEP, not on_picture, other_reason if on_picture else scene_reason, SCENE),
            Step(PICTURE_STEP, on_picture, style_text if on_picture else other_reason, PICTURE),
        )
        return EffectPlan(style, steps)

    def prepare(self, effect: EffectInScene) -> SceneStyle:
        return scene_style_of(effect.scene, effect.settings)

    def relight(self, effect: EffectInScene) -> Scene | None:
        return (
            effect.prepared_data.lighting_scene if effect.settings.applied_to == "scene" else None
        )

    def precompute(self, context: JobContext) -> None:
        """Precompute the maps, so that other processes render no content and read no files."""
        styles = (self.section_of(recipe) for recipe in context.recipes)
        for style in dict.fromkeys(s for s in styles if s and s.has_effect):
            scene = context.scene.as_recorded
            maps = style_maps(scene, style, cameras=context.cameras)
            memo = memo_of(scene)
            memo.put(("style maps", style), PackedMaps.of(maps), shared=True)
            memo.put(("style maps", style), maps)

    def edit_scene(
        self, effect: EffectInScene, layers: LayerRenderer, camera: Camera
    ) -> LayerRenderer:
        if effect.settings.applied_to == "picture":
            return layers
        style = effect.prepared_data
        photo = layers.photo
        if photo is not None:
            photo = replace(photo, style=style.photo_style)
        parts = style.map_parts(layers.parts, backend=effect.backend)
        return replace(layers, parts=parts, sky=style.sky, photo=photo)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        if effect.settings.applied_to != "picture":
            return view
        with timed(PICTURE_STEP):
            rgb = apply_color_map(
                view.rgb, effect.prepared_data.maps.picture, backend=effect.backend
            )
        return replace(view, rgb=rgb)
