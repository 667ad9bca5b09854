"""Smog: its cost, and its errors against exact smog per pixel.

The street's surfaces are known, and so is the distance d of every pixel. The exact picture is
t(d) c + (1 - t(d)) airlight, with c the clean splat render: the smog is compared and not the
splats' colour. Silhouettes, where a pixel shows two distances, count separately.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from adapters.procedural import StreetTruth, TrueView
from augment.cameras import Camera
from augment.plan import make_plan
from augment.render.fog import blend_airlight, optical_depth
from augment.scene import Scene
from recipes.schema import Recipe
from tools.bench.harness import Table
from tools.bench.scenes import CLEAN, EffectCase, cost_tables, frame_of, recipe_of

SMOGS = {
    "uniform, visibility 80 m": {"visibility_m": 80},
    "uniform, visibility 300 m": {"visibility_m": 300},
    "scale height 15 m, visibility 80 m": {"visibility_m": 80, "scale_height_m": 15},
}
SMOOTH = 5  # px: a pixel is away from silhouettes where this square around it is one surface
SMOOTH_DEPTH = 0.1  # largest relative change of depth within that square


def tables(case: EffectCase, repeats: int) -> list[Table]:
    recipes = {
        (name, model): recipe_of({"smog": {**smog, "model": model}})
        for name, smog in SMOGS.items()
        for model in ("per_gaussian", "deferred")
    }
    costs = {", ".join(key): (recipe, CLEAN) for key, recipe in recipes.items()}
    staged = [name for name in costs if name.startswith("uniform, visibility 80 m")]
    scene, truth = case.open_street()
    views = [truth_view(scene, truth, camera) for camera in case.views(scene, 0.5)]
    rows = []
    for key, recipe in recipes.items():
        errors = [smog_error(recipe, scene, view) for view in views]
        for region in views[0].regions:
            masks = [view.regions[region] for view in views]
            masked_errors = np.concatenate([e[mask] for e, mask in zip(errors, masks, strict=True)])
            if len(masked_errors):
                median, p99 = map(float, np.quantile(masked_errors, [0.5, 0.99]))
                rows.append(
                    [
                        *key,
                        region,
                        len(masked_errors),
                        median,
                        p99,
                        100 * float((masked_errors > 4).mean()),
                    ]
                )
    title = f"Largest channel error against exact smog, 1/255: {case.street}"
    columns = ("smog", "model", "region", "pixels", "median", "p99", "above 4/255, %")
    return [*cost_tables(case, costs, staged, repeats), Table(title, columns, rows)]


@dataclass(frozen=True, eq=False)
class TruthView:
    """A camera's clean splat render and the exact picture of the same surfaces. regions: bool
    [H, W]: `smooth`, away from silhouettes, and `silhouette`, the other surface pixels.
    """

    camera: Camera
    clean: Tensor
    exact: TrueView
    regions: Mapping[str, np.ndarray]


def truth_view(scene: Scene, truth: StreetTruth, camera: Camera) -> TruthView:
    clean = frame_of(scene, camera, CLEAN)().rgb
    exact = truth.render(camera)
    surface = np.isfinite(exact.depth)
    smooth = surface & away_from_silhouettes(exact)
    return TruthView(camera, clean, exact, {"smooth": smooth, "silhouette": surface & ~smooth})


def smog_error(recipe: Recipe, scene: Scene, view: TruthView) -> np.ndarray:
    """Largest channel error [H, W] of the fogged splats against exact smog, in 1/255."""
    fog = make_plan(recipe, scene).placed["smog"].data.fog
    camera = view.camera
    fogged = frame_of(scene, camera, recipe)().rgb
    z = torch.from_numpy(np.where(np.isfinite(view.exact.depth), view.exact.depth, 1.0))
    rays = camera.ray_directions(torch.float64)
    eye_z = float(camera.centre[2])
    lengths = rays.norm(dim=-1)
    tau = optical_depth(fog, z * lengths, eye_z, eye_z + z * rays[..., 2])
    exact = blend_airlight(view.clean.double(), tau, fog, rays[..., 2] / lengths).float()
    return (fogged - exact).abs().amax(-1).numpy() * 255


def away_from_silhouettes(view: TrueView) -> np.ndarray:
    """Pixels whose square of SMOOTH px shows one object, one class, and little change of depth."""
    kernel = np.ones((SMOOTH, SMOOTH), np.uint8)
    far = np.where(np.isfinite(view.depth), view.depth, 1e6).astype(np.float32)
    ratio = cv2.dilate(far, kernel) / np.maximum(cv2.erode(far, kernel), 1e-6)
    labels = (view.semantic.astype(np.float32) * 1000 + view.instance).astype(np.float32)
    same = cv2.dilate(labels, kernel) == cv2.erode(labels, kernel)
    return same & (ratio < 1 + SMOOTH_DEPTH)
