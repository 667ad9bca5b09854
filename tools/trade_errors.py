"""How far pictures and depths are from the reference's, and how much the difference flickers.

A picture's error is its own and its neighbours' in space: PSNR, SSIM, FLIP. Flicker is what is left
in time: let E_t be the picture less the reference's, at frame t. E_(t+1) is warped into frame t by
the reference's depth (augment.metrics.consistency.warp_view), so that the drive's motion does not
count, and flicker is the root mean square of E_t - warped E_(t+1) over pixels that count in both
and all channels: 0 for an error that sticks to the surfaces it is on, sqrt(2) times the error's own
RMS for one that is drawn anew in every frame. On water the depth is that of its surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.effects.flood.water_plane import plane_depth
from augment.jobs.quality import Trial
from augment.metrics.consistency import DepthView, warp_view
from augment.metrics.image import CLOSE_M, flip, ssim
from augment.plan import make_plan
from augment.scene import Scene
from augment.views import SURFACE_ALPHA, render_buffers
from recipes.change import changed
from recipes.schema import Recipe
from tools.trade_cases import DEPTH, View


@dataclass(frozen=True, eq=False)
class Standard:
    """What a reference's view is compared by. first_m, alpha [H, W]: of what a ray meets first,
    water too. surfaces, water, snow [H, W]: where there are such. true_m [H, W]: the scene's exact
    depth, infinite in the sky; None where it is not known, or under snow.
    """

    view: View
    first_m: np.ndarray
    alpha: np.ndarray
    surfaces: np.ndarray
    water: np.ndarray
    snow: np.ndarray
    true_m: np.ndarray | None = None

    def region(self, knob: str) -> np.ndarray:
        """Where a knob's depth errors count: on what its effect covers, else on all surfaces."""
        if knob.startswith("weather.flood."):
            return self.water & self.surfaces
        if knob.startswith("weather.snow."):
            return self.snow
        return self.surfaces


def standard_of(
    scene: Scene, view: View, recipe: Recipe, true_m: np.ndarray | None = None
) -> Standard:
    """recipe: at reference. true_m: as Standard's."""
    if recipe.output.depth == "none":
        recipe = changed(recipe, {DEPTH: "median"})
    plan, camera = make_plan(recipe, scene), view.camera
    buffers = render_buffers(scene, camera, plan)
    assert buffers.depth_m is not None and buffers.raster.alpha is not None
    depth, alpha = buffers.depth_m.clone(), buffers.raster.alpha.clone()
    nowhere = torch.zeros_like(alpha, dtype=torch.bool)
    surfaces = (alpha >= SURFACE_ALPHA) & (depth > 0)
    water = nowhere if buffers.water is None else buffers.water
    if buffers.water is not None:
        assert plan.flood is not None
        depth = torch.where(water, plane_depth(camera, plan.flood.level_z_m).to(depth.dtype), depth)
        alpha[water] = 1.0
    snow = nowhere if buffers.snow is None else buffers.snow
    return Standard(
        view, depth.numpy(), alpha.numpy(), surfaces.numpy(), water.numpy(), snow.numpy(), true_m
    )


@dataclass(frozen=True)
class PictureErrors:
    """mse: mean squared error of display-encoded colours, of which PSNR is made."""

    mse: float
    ssim: float
    flip: float

    @staticmethod
    def between(picture: np.ndarray, reference: np.ndarray) -> PictureErrors:
        """Of uint8 pictures [H, W, 3] of one size."""
        if np.array_equal(picture, reference):  # many settings have no effect on some scene
            return PictureErrors(0.0, 1.0, 0.0)
        error = (picture.astype(np.float64) - reference) / 255
        return PictureErrors(
            float((error**2).mean()), ssim(picture, reference), flip(picture, reference)
        )


def picture_figures(views: Sequence[PictureErrors]) -> dict[str, float | None]:
    """psnr: dB, of the mean squared error of all views; None where there is none. flip, ssim:
    means; worst_flip: of the worst view.
    """
    mse = float(np.mean([view.mse for view in views]))
    return {
        "psnr": None if mse == 0 else -10 * math.log10(mse),
        "ssim": float(np.mean([view.ssim for view in views])),
        "flip": float(np.mean([view.flip for view in views])),
        "worst_flip": max(view.flip for view in views),
    }


def depth_figures(
    depths: Sequence[np.ndarray | None], right: Sequence[np.ndarray], where: Sequence[np.ndarray]
) -> dict[str, float | None]:
    """abs_rel: mean of |depth - right| / right where both have a surface. off_5cm: share of the
    region's pixels, of all views, that are off by more than CLOSE_M or have no depth. None where
    there is no depth, or the region is empty. right, where: by view, [H, W].
    """
    nothing = {"abs_rel": None, "off_5cm": None}
    if any(depth is None for depth in depths):
        return nothing
    errors, relative, counted = [], [], 0
    for depth, true, region in zip(depths, right, where, strict=True):
        assert depth is not None
        own, good = depth[region].astype(np.float64), true[region].astype(np.float64)
        counted += own.size
        known = own > 0
        error = np.abs(own - good)
        errors.append((error > CLOSE_M) | ~known)
        relative.append((error / good)[known])
    if not counted:
        return nothing
    shares = np.concatenate(relative)
    return {
        "abs_rel": float(shares.mean()) if shares.size else None,
        "off_5cm": float(np.concatenate(errors).mean()),
    }


def flicker(
    now: Standard, after: Standard, trials: Sequence[Trial], best: Sequence[Trial]
) -> float:
    """RMS of what changes of the error between two frames, display-encoded, 0 to 1; see the module.

    trials, best: the setting's and the reference's pictures of these two views. NaN where the views
    share no surface.
    """
    if all(np.array_equal(t.picture, b.picture) for t, b in zip(trials, best, strict=True)):
        return 0.0
    first, second = (
        DepthView(
            standard.view.camera,
            (trial.picture.astype(np.float32) - good.picture) / np.float32(255),
            standard.first_m,
            standard.alpha,
        )
        for standard, trial, good in zip((now, after), trials, best, strict=True)
    )
    warped, counts = warp_view(first, second)
    if not counts.any():
        return math.nan
    change = first.picture[counts].astype(np.float64) - warped[counts]
    return math.sqrt(float((change**2).mean()))


def true_depths(uri: str, cameras: Sequence[Camera]) -> list[np.ndarray] | None:
    """z of the procedural street's surfaces, float64 [H, W] each, infinite in the sky; None of
    other scenes.
    """
    from adapters.base import parse_uri
    from adapters.procedural import open_truth

    scheme, _, query = parse_uri(uri)
    if scheme != "procedural":
        return None
    truth = open_truth(query)
    depths = []
    for camera in cameras:
        rays = camera.ray_directions(torch.float64).reshape(-1, 3).numpy()
        hits = truth.cast(camera.centre.numpy(), rays, camera.timestamp_ns, with_rgb=False)
        depth = hits.distance / np.linalg.norm(rays, axis=1)
        depths.append(depth.reshape(camera.height, camera.width))
    return depths
