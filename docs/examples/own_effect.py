"""Add an effect of your own: colours turn to sepia with distance.

Run it with: python docs/examples/own_effect.py [OUTPUT_FOLDER]; docs/effects.md lists all hooks.
"""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
from pydantic import Field

from adapters.base import open_scene
from augment import render_view
from augment.effects import add_effect
from augment.effects.effect import PICTURE, Effect, EffectPlan, Step
from augment.render.buffers import EXPECTED_DEPTH
from recipes.effect import EffectModel
from recipes.load import parse_recipe

STREET = "procedural:street?seed=3&gaussians=60000&frames=2&width=480&height=270"
RECIPE = "version: 1\nweather: {sepia: {half_m: 15}}\n"


class Sepia(EffectModel):  # the recipe section weather.sepia
    half_m: float = Field(gt=0, le=1e6)
    """Depth at which half of a colour is sepia, metres."""


class SepiaEffect(Effect):
    """Fades colours: out = t rgb + (1 - t) sepia, t = 2^(-depth / half_m)."""

    name = "sepia"
    section = "weather.sepia"
    model = Sepia

    def plan_in_scene(self, recipe, scene, later_plans):  # once per recipe and scene
        sepia = self.section_of(recipe)  # None where the recipe has no such section
        step = Step("sepia", sepia is not None, "the recipe says so", PICTURE)
        return EffectPlan(sepia, (step,), buffers=frozenset({EXPECTED_DEPTH} if sepia else ()))

    def edit_image(self, effect, view, camera):  # once per view
        is_sky = view.raster.alpha < 0.5  # infinitely far
        depth = view.raster.expected_depth.masked_fill(is_sky, float("inf"))  # metres [H, W]
        t = (-depth / effect.settings.half_m).exp2()[..., None]
        rgb = view.rgb  # display-encoded [H, W, 3]
        gray = (rgb @ rgb.new_tensor([0.2126, 0.7152, 0.0722]))[..., None]
        return replace(view, rgb=t * rgb + (1 - t) * gray * rgb.new_tensor([1.1, 1, 0.75]))


def main(output_dir: Path) -> None:
    """Write own_effect.png."""
    output_dir.mkdir(parents=True, exist_ok=True)
    add_effect(SepiaEffect())  # before a recipe names it
    recipe = parse_recipe(RECIPE, source="own_effect.py").resolve(0)
    scene = open_scene(STREET)
    view = render_view(scene, scene.frames[0].cameras["front"], recipe)
    path = output_dir / "own_effect.png"
    cv2.imwrite(str(path), view.rgb[..., ::-1])
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
