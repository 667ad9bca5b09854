"""How far each smog model is from the truth: splats under smog against exact per-pixel smog.

The street's surfaces are known, and so is the exact distance d of every pixel. The exact picture
is t(d) c + (1 - t(d)) airlight, with c the clean splat render, so that what is compared is the
smog and not the splats' colour. Silhouettes, where a pixel shows two distances, count separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene
from adapters.procedural import StreetTruth, TrueView, open_truth
from adapters.uri import parse_uri
from augment.cameras import Camera
from augment.effects.smog import SmogMedium, blend_airlight, optical_depth
from augment.plan import make_plan
from augment.scene import Scene
from augment.semantics import SemanticClass
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Smog, Weather

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
STREET, SCALE = "procedural:street?seed=3", 0.5
SMOOTH = 5  # px: a pixel is away from silhouettes where this square around it is one surface
SMOOTH_DEPTH = 0.1  # largest relative change of depth within that square


@dataclass(frozen=True, eq=False)
class TruthView:
    """A camera's clean splat render and the exact picture of the same surfaces."""

    camera: Camera
    clean: torch.Tensor
    exact: TrueView
    regions: dict[str, np.ndarray]


def bench_smog(
    cameras: Sequence[str] = ("front", "left", "back"), frames: Sequence[int] = (0, 5)
) -> dict[str, Any]:
    """Errors of both smog models in 1/255, by smog and region: median, p99, share above 4/255."""
    scene, truth = open_scene(STREET), open_truth(parse_uri(STREET)[2])
    wanted = [scene.frame(f).cameras[c].scaled(SCALE) for f in frames for c in cameras]
    views = [truth_view(scene, truth, camera) for camera in tqdm(wanted, unit="view")]
    results = [
        _measure(name, smog.model_copy(update={"model": model}), scene, views)
        for name, smog in SMOGS.items()
        for model in ("per_gaussian", "deferred")
    ]
    return {"scene": STREET, "cameras": list(cameras), "frames": list(frames), "results": results}


def _measure(name: str, smog: Smog, scene: Scene, views: Sequence[TruthView]) -> dict[str, Any]:
    errors: dict[str, list[np.ndarray]] = {}
    for view in views:
        error = smog_error(smog, scene, view)
        for region, mask in view.regions.items():
            errors.setdefault(region, []).append(error[mask])
    regions = {}
    for region, pieces in errors.items():
        values = np.concatenate(pieces)
        if len(values):
            regions[region] = {
                "pixels": len(values),
                "median": float(np.median(values)),
                "p99": float(np.quantile(values, 0.99)),
                "share_above_4": float((values > 4).mean()),
            }
    return {"smog": name, "model": smog.model, "regions": regions}


def truth_view(scene: Scene, truth: StreetTruth, camera: Camera) -> TruthView:
    """What `smog_error` compares with, and the pixels of each region.

    Regions: `smooth` is all pixels away from silhouettes, `silhouette` the other surface pixels;
    the classes are parts of `smooth`.
    """
    recipe = Recipe(output=Output(depth="none"))
    clean = render_buffers(scene, camera, make_plan(recipe, scene)).rgb
    exact = truth.render(camera)
    surface = np.isfinite(exact.depth)
    smooth = surface & away_from_silhouettes(exact.depth, exact.semantic, exact.instance)
    regions = {"smooth": smooth, "silhouette": surface & ~smooth}
    for region, classes in REGIONS.items():
        regions[region] = smooth & np.isin(exact.semantic, [int(c) for c in classes])
    return TruthView(camera, clean, exact, regions)


def smog_error(smog: Smog, scene: Scene, view: TruthView) -> np.ndarray:
    """Largest channel error [H, W] of the fogged splats against exact smog, in 1/255."""
    recipe = Recipe(weather=Weather(smog=smog), output=Output(depth="none"))
    plan = make_plan(recipe, scene)
    assert plan.smog is not None
    fogged = render_buffers(scene, view.camera, plan).rgb
    depth = np.where(np.isfinite(view.exact.depth), view.exact.depth, 1.0)
    exact = _exact(view.clean, depth, view.camera, plan.smog)
    return (fogged - exact).abs().amax(-1).numpy() * 255


def _exact(
    rgb: torch.Tensor, depth: np.ndarray, camera: Camera, medium: SmogMedium
) -> torch.Tensor:
    z = torch.from_numpy(depth)
    rays = camera.ray_directions(torch.float64)
    eye = float(camera.centre[2])
    tau = optical_depth(medium, z * rays.norm(dim=-1), eye, eye + z * rays[..., 2])
    return blend_airlight(rgb.double(), tau, medium).float()


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


def smog_text(result: dict[str, Any]) -> str:
    """The figures of `bench_smog` as a Markdown table."""
    lines = [
        f"Largest channel error against exact smog, in 1/255; {result['scene']}, "
        f"cameras {', '.join(result['cameras'])}, frames {result['frames']}.",
        "",
        "| smog | model | region | pixels | median | p99 | above 4/255 |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['smog']} | {r['model']} | {region} | {v['pixels']} | {v['median']:.2f} "
        f"| {v['p99']:.2f} | {100 * v['share_above_4']:.1f} % |"
        for r in result["results"]
        for region, v in r["regions"].items()
    ]
    return "\n".join(lines)
