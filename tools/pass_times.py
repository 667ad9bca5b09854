"""Where a recipe's frame spends its time, pass by pass, measured on a few of a scene's views."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from augment.cameras import Camera
from augment.plan import cover_for, make_plan
from augment.scene import Scene
from augment.timing import stopwatch
from augment.views import render_view
from recipes.schema import Recipe

DRAWING = ("rasterise", "flood: bed", "flood: mirrored view")  # laps that run the rasteriser
FRAME = "frame"  # the whole view
ROUNDS = 3  # of all views; the fastest of each counts
VIEWS = 3


@dataclass(frozen=True)
class PassTimes:
    """views: how many were rendered, ROUNDS times each after a warm-up. frame_ms: of one view.
    share: of each pass in it, of those that were measured. folded: shares of what is computed
    inside the rasteriser, by the difference to views without it; they are part of the shares of
    the passes that draw. noise: how far apart these passes' times are from run to run, as a share;
    a smaller difference says nothing. once_s: what was done once for the scene, in seconds.
    """

    views: int
    rounds: int
    threads: int
    frame_ms: float
    share: Mapping[str, float]
    folded: Mapping[str, float]
    noise: float
    once_s: Mapping[str, float]

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return {
            "views": self.views,
            "rounds": self.rounds,
            "threads": self.threads,
            "frame_ms": self.frame_ms,
            "share": dict(self.share),
            "folded": dict(self.folded),
            "noise": self.noise,
            "once_s": dict(self.once_s),
        }


def measure_passes(recipe: Recipe, scene: Scene, views: int = VIEWS) -> PassTimes:
    """Renders a few views with a stopwatch. The recipe's scale and outputs count; files do not."""
    from augment.render.threads import thread_count

    cameras = sample_views(scene, views)
    once_s = {}
    if recipe.weather.snow is not None and (plan := make_plan(recipe, scene)).snow is not None:
        start = time.perf_counter()
        cover_for(plan, scene)
        once_s["snow: placement and layer"] = time.perf_counter() - start
    variants = {"": recipe} | without_folded(recipe, scene)
    runs = {name: _runs(scene, cameras, variant) for name, variant in variants.items()}
    times = {name: [_fastest(view) for view in views] for name, views in runs.items()}
    total = _sum(times[""], FRAME)
    passes = dict.fromkeys(name for best in times[""] for name in best if name != FRAME)
    share = {name: _sum(times[""], name) / total for name in passes}
    share["everything else"] = max(0.0, 1 - sum(share.values()))
    folded = {
        name: (_sum(times[""], *DRAWING) - _sum(times[name], *DRAWING)) / total
        for name in variants
        if name
    }
    drawing = [[_sum([run], *DRAWING) for run in view] for view in runs[""]]
    return PassTimes(
        views=len(cameras),
        rounds=ROUNDS,
        threads=thread_count(),
        frame_ms=1e3 * total / len(cameras),
        share=share,
        folded=folded,
        noise=sum(max(view) - min(view) for view in drawing) / total,
        once_s=once_s,
    )


def sample_views(scene: Scene, count: int) -> list[Camera]:
    """So many of the scene's views, or all, spread over frames and cameras alike."""
    views = [camera for frame in scene.frames for camera in frame.cameras.values()]
    if len(views) <= count:
        return views
    # The middles of equal stretches of the drive, in each of which another camera's turn comes.
    picked = []
    for place in range(count):
        frame = scene.frames[(2 * place + 1) * len(scene.frames) // (2 * count)]
        cameras = list(frame.cameras.values())
        picked.append(cameras[place * max(1, len(cameras) // count) % len(cameras)])
    return picked


def without_folded(recipe: Recipe, scene: Scene) -> dict[str, Recipe]:
    """The recipe without each of the passes that run inside the rasteriser, by the pass's name."""
    runs = {step.name for step in make_plan(recipe, scene).steps if step.runs}
    weather, found = recipe.weather, dict[str, Recipe]()
    if "style on the scene" in runs:
        found["style on the scene"] = recipe.model_copy(update={"style": None})
    if "smog per Gaussian" in runs:
        found["smog per Gaussian"] = _with_weather(recipe, smog=None)
    if "snow: placement and layer" in runs and weather.snow is not None:
        found["snow: placement and layer"] = _with_weather(recipe, snow=None)
        if "snow: light per pixel" in runs:
            plain = weather.snow.model_copy(update={"shading": "per_splat"})
            found["snow: light per pixel"] = _with_weather(recipe, snow=plain)
    return found


def _with_weather(recipe: Recipe, **changes: Any) -> Recipe:
    return recipe.model_copy(update={"weather": recipe.weather.model_copy(update=changes)})


def _runs(scene: Scene, cameras: Sequence[Camera], recipe: Recipe) -> list[list[dict[str, float]]]:
    """The laps of every run of each view. A recipe's runs stand side by side, since a scene keeps
    the snow of two recipes at most.
    """
    for camera in cameras:
        render_view(scene, camera, recipe)
    return [[_timed(scene, camera, recipe) for _ in range(ROUNDS)] for camera in cameras]


def _fastest(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    """The whole of one run: passes of different runs would not add up to one frame."""
    return min(runs, key=lambda run: run[FRAME])


def _timed(scene: Scene, camera: Camera, recipe: Recipe) -> dict[str, float]:
    """Seconds of the view's passes, and of the whole as FRAME."""
    start = time.perf_counter()
    with stopwatch() as seconds:
        render_view(scene, camera, recipe)
    return seconds | {FRAME: time.perf_counter() - start}


def _sum(times: Sequence[Mapping[str, float]], *names: str) -> float:
    return sum(best.get(name, 0.0) for best in times for name in names)
