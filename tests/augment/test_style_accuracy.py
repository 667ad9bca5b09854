"""Where maps of a style in SH are exact, and where a clamp of colours makes them differ.

Colours are clamped to >= 0 before they are blended. Mapped as evaluated colours, a splat's colour
is clamped before the map and after it; mapped in its SH, after it alone. So pictures differ only in
"touched" pixels: where a splat with a colour below 0, as this camera sees it, is blended.
"""

import dataclasses

import numpy as np
import torch

from augment.plan import make_plan
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0, evaluate_sh
from augment.scene import PosedGaussians
from augment.semantics import SemanticClass
from augment.views import render_buffers
from tests.scenes import sh_of
from tests.snow_scenes import drive, sheet, wall
from tools.bench.style import style_recipe


def folding_error(scene, camera):
    """Largest channel difference [H, W] of colours mapped in SH and of mapped colours."""
    recipes = (style_recipe(evaluated=where) for where in ("sh", "color"))
    folded, mapped = (render_buffers(scene, camera, make_plan(r, scene)).rgb for r in recipes)
    return (folded - mapped).abs().amax(2).numpy()


def touched_pixels(scene, camera):
    """bool [H, W]; such splats are drawn white, all others far below black."""
    own = scene.background
    away = torch.nn.functional.normalize(own.means - camera.centre.float(), dim=1)
    below = (evaluate_sh(own.sh, away) + 0.5 < 0).any(1)
    sh = torch.where(below, 0.5 / SH_C0, -1 / SH_C0)[:, None, None].expand(-1, 1, 3).contiguous()
    return rasterize([PosedGaussians(dataclasses.replace(own, sh=sh))], camera).rgb[..., 0] > 0


def with_sh(scene, sh):
    return dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))


def test_maps_in_sh_are_exact_but_where_a_colour_is_below_zero():
    road = sheet((2, 9), (-2, 2), rgb=(0.3, 0.35, 0.3), semantic=int(SemanticClass.ROAD))
    scene = drive(road, wall(9.0, (-3, 3), (0, 2.5)), places=[(0.0, 0.0, 1.5)])
    camera = scene.frames[0].cameras["ahead"]
    assert not touched_pixels(scene, camera).any()
    sh = scene.background.sh.clone()
    sh[: len(road)] = sh_of(np.full((len(road), 3), -0.1))
    dark = with_sh(scene, sh)
    touched = touched_pixels(dark, camera).numpy()
    assert touched[-5:, 60:100].all() and not touched[:20].any()
    assert folding_error(dark, camera).max() < 1e-5  # no directions: known exactly
    error = folding_error(with_sh(dark, torch.cat([sh, torch.zeros(len(sh), 3, 3)], 1)), camera)
    assert error[touched].max() > 1 / 255 > 1e-5 > error[~touched].max()
