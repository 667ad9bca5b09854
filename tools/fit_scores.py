"""Renders of recorded views, and how far they are from what was recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from tqdm import tqdm

from augment.cameras import Camera
from augment.metrics.image import DepthErrors, depth_errors, flip, psnr, ssim
from augment.plan import make_plan
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.render.buffers import EXPECTED_DEPTH, MEDIAN_DEPTH
from augment.render.composite import quantise
from augment.scene import Scene
from augment.views import SURFACE_ALPHA, render_buffers
from recipes.load import load_recipe
from recipes.schema import Recipe


@dataclass(frozen=True, eq=False)
class RenderedView:
    """What a user gets of a camera without weather. rgb: uint8 [H, W, 3], clamped to [0, 1] and
    rounded to 8 bits. alpha, median_depth_m, expected_depth_m: float32 [H, W].
    """

    rgb: np.ndarray
    alpha: np.ndarray
    median_depth_m: np.ndarray
    expected_depth_m: np.ndarray

    @property
    def has_surface(self) -> np.ndarray:
        """bool [H, W]: where a depth is written to files."""
        return self.alpha >= SURFACE_ALPHA


@dataclass(frozen=True)
class ViewScore:
    """One view's render against its recording.

    psnr (dB), ssim, flip over the pixels of weight > 0, which are the part `scored` of all; NaN
    where there are none, and flip also where it was not asked for. median, expected: errors of
    both depths over the pixels with a depth prior and a surface (alpha >= SURFACE_ALPHA), weighted
    as the priors. no_surface: the part of the pixels with a prior that have none; NaN without
    priors.
    """

    key: ViewKey
    psnr: float
    ssim: float
    flip: float
    scored: float
    median: DepthErrors
    expected: DepthErrors
    no_surface: float

    def numbers(self) -> dict[str, float]:
        """By the names that reports use; depth_* are those of the median depth, as in files."""
        return {
            "psnr": self.psnr,
            "ssim": self.ssim,
            "flip": self.flip,
            "scored": self.scored,
            "depth_median_m": self.median.median_m,
            "depth_p90_m": self.median.p90_m,
            "depth_abs_rel": self.median.abs_rel,
            "depth_within_5cm": self.median.within_5cm,
            "expected_depth_median_m": self.expected.median_m,
            "expected_depth_p90_m": self.expected.p90_m,
            "depth_pixels": float(self.median.pixels),
            "no_surface": self.no_surface,
        }


def evaluate_views(
    scene: Scene,
    source: ViewSource,
    keys: Sequence[ViewKey],
    *,
    with_flip: bool = True,
    progress: bool = False,
) -> list[ViewScore]:
    """The score of every view, at the source's resolution and with recorded exposure.

    Only weights of 0 leave a pixel out: a scene is judged on the whole picture, not where learning
    was easy. with_flip: FLIP takes most of the time, 0.2 s for 480x270 pixels on one core.
    """
    shown = tqdm(keys, desc="evaluate", unit="view", disable=None if progress else True)
    return [_score(key, scene, source.load(key), with_flip) for key in shown]


def mean_scores(scores: Iterable[ViewScore]) -> dict[str, float]:
    """Means over the views by the names of `ViewScore.numbers`, each over the views that have a
    number; names that no view has one for are left out, as are infinite means (equal pictures).
    """
    rows = [score.numbers() for score in scores]
    means: dict[str, float] = {}
    for name in rows[0] if rows else ():
        known = [row[name] for row in rows if not math.isnan(row[name])]
        if known and math.isfinite(mean := float(np.mean(known))):
            means[name] = mean
    return means


def means_by_camera(scores: Sequence[ViewScore]) -> dict[str, dict[str, float]]:
    """`mean_scores` of every camera, with the number of its views."""
    cameras = dict.fromkeys(score.key.camera for score in scores)
    return {
        name: {"views": len(own), **mean_scores(own)}
        for name in cameras
        for own in [[score for score in scores if score.key.camera == name]]
    }


def render_recorded(scene: Scene, camera: Camera) -> RenderedView:
    """The view at the camera's own resolution under no weather, as its camera records it."""
    plan = make_plan(_clear(), scene)
    plan = dataclasses.replace(plan, buffers=plan.buffers | {EXPECTED_DEPTH, MEDIAN_DEPTH})
    buffers = render_buffers(scene, camera, plan)
    raster = buffers.raster
    assert raster.alpha is not None
    assert raster.median_depth is not None and raster.expected_depth is not None
    return RenderedView(
        rgb=quantise(buffers.rgb),
        alpha=raster.alpha.numpy(),
        median_depth_m=raster.median_depth.numpy(),
        expected_depth_m=raster.expected_depth.numpy(),
    )


def found_camera(scene: Scene, key: ViewKey, camera: Camera) -> Camera:
    """`camera` where the fitted scene says that it stood: a fit refines recorded poses."""
    pose = scene.frame(key.frame).cameras[key.camera].camera_from_world
    return dataclasses.replace(camera, camera_from_world=pose)


@cache
def _clear() -> Recipe:
    return load_recipe("clear").resolve(0)


def _score(key: ViewKey, scene: Scene, view: RecordedView, with_flip: bool) -> ViewScore:
    rendered = render_recorded(scene, found_camera(scene, key, view.camera))
    counts = view.weight > 0
    scored = float(counts.mean())
    numbers = {"psnr": math.nan, "ssim": math.nan, "flip": math.nan}
    if scored > 0:
        metrics = {"psnr": psnr, "ssim": ssim, **({"flip": flip} if with_flip else {})}
        weight = None if scored == 1 else counts
        numbers |= {name: m(rendered.rgb, view.rgb, weight) for name, m in metrics.items()}
    return ViewScore(key=key, **numbers, scored=scored, **_depths(rendered, view))


def _depths(rendered: RenderedView, view: RecordedView) -> Mapping[str, DepthErrors | float]:
    at = view.depth_pixels
    surface = rendered.has_surface.reshape(-1)[at]
    used = at[surface]

    def errors(depth_m: np.ndarray) -> DepthErrors:
        true_m, weight = view.depth_m[surface], view.depth_weight[surface]
        return depth_errors(depth_m.reshape(-1)[used], true_m, weight)

    return {
        "median": errors(rendered.median_depth_m),
        "expected": errors(rendered.expected_depth_m),
        "no_surface": float(1 - surface.mean()) if len(at) else math.nan,
    }
