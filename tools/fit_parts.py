"""The pieces that `climategs fit` puts together, each imported when it is first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from augment.reconstruct.config import FitConfig
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene import Scene
from tools.fit_options import FitOptions, parse_depth

MIN_OFFSET_S = 0.005  # of clocks: less moves a camera by centimetres at most, if it is real
SCORES = ("psnr", "ssim", "depth_median_m")  # of a row of the history


class StepFacts(Protocol):
    """What one step of a Trainer reports; stage_s: seconds by stage."""

    @property
    def step(self) -> int: ...
    @property
    def key(self) -> ViewKey: ...
    @property
    def loss(self) -> float: ...
    @property
    def l1(self) -> float: ...
    @property
    def ssim(self) -> float: ...
    @property
    def depth(self) -> float: ...
    @property
    def sky(self) -> float: ...
    @property
    def splats(self) -> int: ...
    @property
    def stage_s(self) -> dict[str, float]: ...


class Fitter(Protocol):
    """A Trainer as its driver sees it."""

    step: int

    def run_step(self) -> StepFacts: ...
    def scene(self) -> Scene: ...
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]: ...
    def load_state(self, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None: ...


class Views(ViewSource, Protocol):
    """A ViewSource that also says what it found wrong with the recorded data."""

    @property
    def problems(self) -> tuple[str, ...]: ...


@dataclass(frozen=True)
class FitParts:
    """open_scene(uri); views(scene, options); check(scene, source, options): both again, timed
    anew where the clocks disagree, and sentences; start(scene, source): with what no sensor gave;
    trainer(scene, source, config);
    score(scene, source, keys): means over the views, {"psnr", "ssim", ...};
    save(scene, folder); report(folder, scene, source, history, facts): report.json's content.
    """

    open_scene: Callable[[str], Scene]
    views: Callable[[Scene, FitOptions], Views]
    start: Callable[[Scene, Any], Scene]
    trainer: Callable[[Scene, ViewSource, FitConfig], Fitter]
    score: Callable[[Scene, ViewSource, Sequence[ViewKey]], dict[str, float]]
    save: Callable[[Scene, Path], None]
    report: Callable[..., dict[str, Any]]
    check: Callable[[Scene, Any, FitOptions], Checked] = lambda scene, source, _: Checked(
        scene, source
    )


@dataclass(frozen=True, eq=False)
class Checked:
    """Scene and views after images and LiDAR were compared, what was found, and facts of it."""

    scene: Scene
    source: Views
    problems: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


def real_parts(device: str = "cpu") -> FitParts:
    """The library's own. device: where views are rendered during the fit."""
    from adapters.base import open_scene
    from adapters.training_views.starting_scene import starting_scene
    from augment.files.scene_file import save_scene
    from augment.reconstruct.trainer import Trainer

    return FitParts(
        open_scene=open_scene,
        views=_recorded_views,
        start=starting_scene,
        trainer=partial(Trainer, device=device),
        score=_mean_scores,
        save=save_scene,
        report=_report,
        check=_checked,
    )


def _checked(scene: Scene, source: Any, options: FitOptions) -> Checked:
    from adapters.training_views.checks import check_views, with_camera_times

    checks = check_views(scene, source)
    late_s = checks.time_offset_s
    if late_s is None or abs(late_s) < MIN_OFFSET_S:
        return Checked(scene, source, checks.problems, checks.facts)
    timed = with_camera_times(scene, late_s)
    sentence = (
        f"images fit the LiDAR best {abs(late_s) * 1e3:.0f} ms "
        f"{'after' if late_s > 0 else 'before'} their time stamps: every camera is taken to be "
        f"where it was then"
    )
    return Checked(
        timed, _recorded_views(timed, options), (*checks.problems, sentence), checks.facts
    )


def _recorded_views(scene: Scene, options: FitOptions) -> Views:
    from adapters.training_views.views import recorded_views

    return recorded_views(
        scene,
        scale=options.scale,
        cameras=options.cameras,
        holdout=options.holdout,
        cache_bytes=options.image_cache_mb * 2**20,
        depth=parse_depth(options.depth),
        masks_dir=options.ego_masks,
    )


def _mean_scores(scene: Scene, source: ViewSource, keys: Sequence[ViewKey]) -> dict[str, float]:
    from tools.fit_scores import evaluate_views, mean_scores

    means = mean_scores(evaluate_views(scene, source, keys, with_flip=False))
    return {name: means[name] for name in SCORES if name in means}


def _report(
    folder: Path, scene: Scene, source: ViewSource, history: list[dict[str, Any]], facts: dict
) -> dict[str, Any]:
    from tools.fit_report import write_report

    return write_report(folder, scene, source, history, facts)
