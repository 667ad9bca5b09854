"""How exact folded maps are: factor by factor, and in SH against in evaluated colours.

Colours are clamped to >= 0 before they are blended. Mapped as evaluated colours, a splat's colour
is clamped before the map and after it; mapped in its SH, after it alone. So the pictures differ
only where a splat with a colour below 0, as this camera sees it, is blended: in "touched" pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.effects.style.color_maps import styled_scene
from augment.effects.style.network import Gscm, apply_map, compose
from augment.effects.style.style import style_maps
from augment.plan import make_plan
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0, evaluate_sh
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.views import render_buffers
from recipes.schema import Recipe
from recipes.weather import Style
from tools.bench_flood_error import PICTURE_ONLY
from tools.bench_style_network import random_network

VISIBLE = 1 / 255
_COLORS = 4096
_SH3 = 16  # coefficients
_BAND_SPREAD = 0.06  # standard deviation of the coefficients that give a scene directions


def bench_folding(net: Gscm) -> dict[str, float]:
    """Largest difference of colours in [0, 1] mapped factor by factor and by the folded map, of the
    network and of random ones, with and without an offset.
    """
    nets = {
        "network": net,
        "random, 3x4": random_network(),
        "random, 3x3": random_network(offset=False),
    }
    return {name: folding_error(each) for name, each in nets.items()}


def folding_error(net: Gscm) -> float:
    """Over _COLORS colours and pairs of noise pictures of different colours."""
    generator = torch.Generator().manual_seed(0)
    pictures = torch.rand((4, 3, net.size, net.size), generator=generator)
    pictures = pictures * torch.rand((4, 3, 1, 1), generator=generator)
    colors = torch.rand((2, _COLORS, 3), generator=generator)
    with torch.no_grad():
        f_c, f_s = net.encode(pictures)
        f_c, f_s = f_c[:2], f_s[2:]
        factors = net.apply_factors(f_c, f_s, colors)
        folded = apply_map(compose(net.style_map(f_s), net.content_map(f_c)), colors)
    return float((factors - folded).abs().max())


def bench_exact(scene: Scene, camera: Camera, presets: Sequence[str]) -> list[dict[str, Any]]:
    """Of the scene as it is and, where its colours depend on no direction, with some that do."""
    kinds = {f"SH {_degree(scene)}": scene}
    if _degree(scene) == 0:
        kinds["SH 3"] = with_directions(scene)
    found = []
    for kind, each in kinds.items():
        touched = clamped_pixels(each, camera)
        for preset in presets:
            compared = _compare(each, camera, preset, touched)
            found.append({"colors": kind, "preset": preset, **compared})
    return found


def _compare(scene: Scene, camera: Camera, preset: str, touched: np.ndarray) -> dict[str, Any]:
    style = Style(preset=preset)
    fused = make_plan(Recipe(style=style, output=PICTURE_ONLY), scene)
    clean = make_plan(Recipe(output=PICTURE_ONLY), scene)
    in_colors = render_buffers(scene, camera, fused).rgb.numpy()
    in_sh = render_buffers(styled_scene(scene, style_maps(scene, style)), camera, clean).rgb.numpy()
    difference = np.abs(in_colors - in_sh).max(2)
    rest = difference[~touched]
    return {
        "untouched_max": float(rest.max()) if rest.size else 0.0,
        "touched_share": float(touched.mean()),
        "touched_max": float(difference[touched].max()) if touched.any() else 0.0,
        "visible_share": float((difference > VISIBLE).mean()),
    }


def clamped_pixels(scene: Scene, camera: Camera) -> np.ndarray:
    """bool [H, W]: where a splat with a colour below 0, before any map, is blended."""
    marks = [_marked(part, camera) for part in scene.parts_for(camera)]
    seen = rasterize(marks, camera)
    assert seen.rgb is not None
    return seen.rgb[..., 0].numpy() > 0


def _marked(part: PosedGaussians, camera: Camera) -> PosedGaussians:
    """The part with white splats where a colour is below 0, black ones elsewhere."""
    below = (splat_colors(part, camera) < 0).any(1)
    # Far below black, so that rounding shows nothing of it.
    shown = torch.where(below, 0.5 / SH_C0, -1 / SH_C0)[:, None, None].expand(-1, 1, 3)
    gaussians = dataclasses.replace(part.gaussians, sh=shown.contiguous())
    return dataclasses.replace(part, gaussians=gaussians)


def splat_colors(part: PosedGaussians, camera: Camera) -> Tensor:
    """float32 [N, 3]: as the camera sees them, not clamped."""
    eye = camera.centre.double()
    if part.world_from_part is not None:
        to_part = torch.linalg.inv(part.world_from_part)
        eye = to_part[:3, :3] @ eye + to_part[:3, 3]
    away = torch.nn.functional.normalize(part.gaussians.means - eye.float(), dim=1)
    return evaluate_sh(part.gaussians.sh, away) + 0.5


def with_directions(scene: Scene) -> Scene:
    """The scene with SH of degree 3, the bands above its own random and the same every time."""
    rng = np.random.default_rng(0)

    def widened(gaussians: Gaussians) -> Gaussians:
        own = gaussians.sh
        sh = rng.normal(0, _BAND_SPREAD, (len(own), _SH3, 3)).astype(np.float32)
        sh[:, : own.shape[1]] = own.numpy()
        return dataclasses.replace(gaussians, sh=torch.from_numpy(sh))

    return scene.with_gaussians(widened)


def _degree(scene: Scene) -> int:
    parts = scene.all_gaussians
    return max(round(part.sh.shape[1] ** 0.5) - 1 for part in parts)
