"""Exact smog per pixel, and the errors of splats in smog against it.

The surfaces of the procedural street are known, and so is the distance d of every pixel. The exact
picture is t(d) c + (1 - t(d)) airlight with transmittance t, in squares of these colours where the
smog is mixed in linear light. The colour c is that of the clean splat render, so that only the smog
is compared and not the splats' colours. Silhouettes, where one
pixel shows two distances, count separately.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from adapters.procedural import ExactView, StreetTruth
from augment.render.fog import blend_airlight, optical_depth
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.view.plan import make_plan
from recipes.schema import Recipe
from tools.bench.scenes import CLEAN, frame_of

# The side of the square around a pixel, pixels. A pixel is away from silhouettes if the square
# around it shows one surface.
SMOOTH_SQUARE_PX = 5
SMOOTH_DEPTH_RATIO = 0.1  # The largest relative change of depth within that square.


@dataclass(frozen=True, eq=False)
class TruthView:
    """A camera's clean splat render, and the exact view of the same surfaces."""

    camera: Camera
    """The camera."""
    clean: Tensor
    """[H, W, 3]. The clean splat render."""
    exact: ExactView
    """The exact view, with depth, classes and instances."""
    regions: Mapping[str, np.ndarray]
    """Masks [H, W]: `smooth` is surface away from silhouettes, `silhouette` is other surface."""


def truth_view(scene: Scene, truth: StreetTruth, camera: Camera) -> TruthView:
    """Render a camera's clean and exact views."""
    clean = frame_of(scene, camera, CLEAN)().rgb
    exact = truth.render(camera)
    surface = np.isfinite(exact.depth)
    smooth = surface & away_from_silhouettes(exact)
    return TruthView(camera, clean, exact, {"smooth": smooth, "silhouette": surface & ~smooth})


def smog_error(recipe: Recipe, scene: Scene, view: TruthView) -> np.ndarray:
    """Return the largest channel error [H, W] of splats in smog against exact smog, in 1/255."""
    smog_plan = make_plan(recipe, scene).effect_plans["smog"].data
    fog = smog_plan.fog
    camera = view.camera
    fogged = frame_of(scene, camera, recipe)().rgb
    z = torch.from_numpy(np.where(np.isfinite(view.exact.depth), view.exact.depth, 1.0))
    rays = camera.ray_directions(torch.float64)
    eye_z = float(camera.centre[2])
    lengths = rays.norm(dim=-1)
    tau = optical_depth(fog, z * lengths, eye_z, eye_z + z * rays[..., 2])
    slopes = rays[..., 2] / lengths
    exact = blend_airlight(view.clean.double(), tau, fog, slopes)
    if smog_plan.is_linear:
        airlight = blend_airlight(exact, torch.full_like(tau, torch.inf), fog, slopes)
        t = torch.exp(-tau)[..., None]
        exact = (t * view.clean.double().clamp_min(0) ** 2 + (1 - t) * airlight**2).sqrt()
    return (fogged - exact.float()).abs().amax(-1).numpy() * 255


def away_from_silhouettes(view: ExactView) -> np.ndarray:
    """Mask of pixels away from silhouettes, bool [H, W].

    The square of SMOOTH_SQUARE_PX around such a pixel shows one object and one class, and its depth
    changes by no more than SMOOTH_DEPTH_RATIO.
    """
    kernel = np.ones((SMOOTH_SQUARE_PX, SMOOTH_SQUARE_PX), np.uint8)
    depth = np.where(np.isfinite(view.depth), view.depth, 1e6).astype(np.float32)
    ratio = cv2.dilate(depth, kernel) / np.maximum(cv2.erode(depth, kernel), 1e-6)
    labels = (view.semantic.astype(np.float32) * 1000 + view.instance).astype(np.float32)
    is_one_surface = cv2.dilate(labels, kernel) == cv2.erode(labels, kernel)
    return is_one_surface & (ratio < 1 + SMOOTH_DEPTH_RATIO)
