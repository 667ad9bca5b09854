"""Smog: what it costs, and how far each model is from exact per-pixel smog.

The street's surfaces are known, and so is the distance d of every pixel. The exact picture is
t(d) c + (1 - t(d)) airlight, with c the clean splat render: what is compared is the smog and not
the splats' colour. Silhouettes, where a pixel shows two distances, count separately.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from adapters.procedural import StreetTruth, TrueView
from augment.cameras import Camera
from augment.effects.smog import blend_airlight, optical_depth
from augment.plan import make_plan
from augment.scene import Scene
from augment.semantics import SemanticClass
from augment.views import render_buffers
from recipes.schema import Recipe, Smog, Weather
from tools.bench.effects import CLEAN, QUICK, WHOLE, EffectCase, cost_tables
from tools.bench.harness import Figures, Table, figures, machine_facts
from tools.bench.scenes import PICTURE_ONLY

REGIONS = {
    "road": (SemanticClass.ROAD, SemanticClass.LANE_MARKING),
    "pavement": (SemanticClass.SIDEWALK,),
    "building": (SemanticClass.BUILDING,),
    "vegetation": (SemanticClass.VEGETATION,),
    "vehicle": (SemanticClass.VEHICLE,),
}
SMOGS = {
    "uniform, visibility 80 m": Smog(visibility_m=80),
    "uniform, visibility 300 m": Smog(visibility_m=300),
    "scale height 15 m, visibility 80 m": Smog(visibility_m=80, scale_height_m=15),
}
MODELS = ("per_gaussian", "deferred")
SMOOTH = 5  # px: a pixel is away from silhouettes where this square around it is one surface
SMOOTH_DEPTH = 0.1  # largest relative change of depth within that square


def bench_smog(
    quick: bool = False, *, case: EffectCase | None = None, repeats: int = 7, memory: bool = True
) -> Figures:
    machine, case = machine_facts(), case or (QUICK if quick else WHOLE)
    costs = {
        f"{name}, {model}": (smog_recipe(smog, model), CLEAN)
        for name, smog in SMOGS.items()
        for model in MODELS
    }
    staged = [name for name in costs if name.startswith("uniform, visibility 80 m")]
    tables = cost_tables(case, costs, staged, repeats=repeats, memory=memory)
    scene, truth = case.open_street()
    views = [truth_view(scene, truth, camera) for camera in case.views(scene, 0.5)]
    rows = []
    for name, smog in SMOGS.items():
        for model in MODELS:
            errors = [smog_error(smog_recipe(smog, model), scene, view) for view in views]
            for region in views[0].regions:
                masks = [view.regions[region] for view in views]
                own = np.concatenate([e[mask] for e, mask in zip(errors, masks, strict=True)])
                if len(own):
                    median, p99 = map(float, np.quantile(own, [0.5, 0.99]))
                    above = 100 * float((own > 4).mean())
                    rows.append([name, model, region, len(own), median, p99, above])
    title = f"Largest channel error against exact smog, 1/255: {case.street}"
    columns = ("smog", "model", "region", "pixels", "median", "p99", "above 4/255, %")
    return figures("smog", [*tables, Table(title, columns, rows)], machine=machine)


def smog_recipe(smog: Smog, model: str) -> Recipe:
    smog = smog.model_copy(update={"model": model})
    return Recipe(weather=Weather(smog=smog), output=PICTURE_ONLY)


@dataclass(frozen=True, eq=False)
class TruthView:
    """A camera's clean splat render and the exact picture of the same surfaces. regions: bool
    [H, W]; `smooth` is all pixels away from silhouettes, with the classes as its parts;
    `silhouette` the other surface pixels.
    """

    camera: Camera
    clean: torch.Tensor
    exact: TrueView
    regions: dict[str, np.ndarray]


def truth_view(scene: Scene, truth: StreetTruth, camera: Camera) -> TruthView:
    clean = render_buffers(scene, camera, make_plan(CLEAN, scene)).rgb
    exact = truth.render(camera)
    surface = np.isfinite(exact.depth)
    smooth = surface & away_from_silhouettes(exact.depth, exact.semantic, exact.instance)
    regions = {"smooth": smooth, "silhouette": surface & ~smooth}
    for region, classes in REGIONS.items():
        regions[region] = smooth & np.isin(exact.semantic, [int(c) for c in classes])
    return TruthView(camera, clean, exact, regions)


def smog_error(recipe: Recipe, scene: Scene, view: TruthView) -> np.ndarray:
    """Largest channel error [H, W] of the fogged splats against exact smog, in 1/255."""
    plan, camera = make_plan(recipe, scene), view.camera
    assert plan.smog is not None
    fogged = render_buffers(scene, camera, plan).rgb
    z = torch.from_numpy(np.where(np.isfinite(view.exact.depth), view.exact.depth, 1.0))
    rays, eye_z = camera.ray_directions(torch.float64), float(camera.centre[2])
    tau = optical_depth(plan.smog, z * rays.norm(dim=-1), eye_z, eye_z + z * rays[..., 2])
    exact = blend_airlight(view.clean.double(), tau, plan.smog).float()
    return (fogged - exact).abs().amax(-1).numpy() * 255


def away_from_silhouettes(
    depth: np.ndarray, semantic: np.ndarray, instance: np.ndarray
) -> np.ndarray:
    """Pixels whose square of SMOOTH px shows one object, one class, and little change of depth."""
    kernel = np.ones((SMOOTH, SMOOTH), np.uint8)
    far = np.where(np.isfinite(depth), depth, 1e6).astype(np.float32)
    ratio = cv2.dilate(far, kernel) / np.maximum(cv2.erode(far, kernel), 1e-6)
    labels = (semantic.astype(np.float32) * 1000 + instance).astype(np.float32)
    same = cv2.dilate(labels, kernel) == cv2.erode(labels, kernel)
    return same & (ratio < 1 + SMOOTH_DEPTH)
