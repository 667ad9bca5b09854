"""What a flood costs: flooded frames against clean ones, and where their time goes.

Clean and flooded frames alternate, so that what the machine does meanwhile falls on both, and the
ratio is taken pair by pair.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from augment.cameras import Camera
from augment.effects.flood import flood_view
from augment.effects.flood.flood import FresnelModel, ReflectionTier
from augment.plan import Plan, make_plan
from augment.render.layout import BELOW, HeightClip
from augment.scene import Scene
from recipes.schema import Output, Recipe
from tools.bench_flood_error import PICTURE_ONLY, draw, flood_recipe
from tools.bench_flood_masks import FAR_BELOW_M, looking_up
from tools.bench_pairs import spread_ms, spread_ratio, time_frame, time_in_turns

TIERS: tuple[ReflectionTier, ...] = ("sky", "screen_space", "mirrored")
WANTED_SHARE = 1 / 3  # of the image under water
NEAR_SHARE = 0.05  # as much off is about a third, too
ZOOMS = (1.0, 0.8, 1.25, 1.6, 2.0, 2.5)  # the first that is near is taken
LOOK = 0.125  # resolution at which a zoom's share of water is looked up
STAGES = {
    "find_water": "where water is",
    "wave_field": "waves",
    "trace_screen": "march through the screen",
    "shade_water": "shading",
    "pour": "water and sky behind the front",
    "composite_sky": "sky alone",
    "merge_depths": "buffers of both sides",
}
FRONT, BED, MIRROR, REST = "front layer", "bed layer", "mirror layer", "the rest"


@dataclasses.dataclass(frozen=True, eq=False)
class CostCase:
    """A flooded frame and the recipe and camera of the clean one beside it."""

    name: str
    camera: Camera
    recipe: Recipe
    clean: Recipe


def cost_cases(camera: Camera) -> list[CostCase]:
    """Every tier still and with waves, as pictures only; Schlick's formula; depth and labels as by
    default; and views that no water is in.
    """
    none, default = PICTURE_ONLY, Output()
    cases = [
        CostCase(f"{tier}, {waves}", camera, flood_recipe(tier, waves), Recipe(output=none))
        for tier in TIERS
        for waves in ("still", "calm")
    ]
    schlick = flood_recipe("mirrored", "calm", fresnel="schlick")
    cases.append(CostCase("mirrored, calm, schlick", camera, schlick, Recipe(output=none)))
    for tier in TIERS:
        recipe = flood_recipe(tier, "calm", output=default)
        cases.append(
            CostCase(f"{tier}, calm, depth and labels", camera, recipe, Recipe(output=default))
        )
    up, low = flood_recipe(waves="calm"), flood_recipe(level_m=FAR_BELOW_M)
    cases.append(CostCase("looking up", looking_up(camera), up, Recipe(output=none)))
    cases.append(CostCase("level below everything", camera, low, Recipe(output=none)))
    return cases


def bench_camera(scene: Scene, width: int, height: int, backend: str = "auto") -> Camera:
    """The front camera of the middle frame, zoomed where less or more than a third is water."""
    cameras = scene.frames[len(scene.frames) // 2].cameras
    name = min((n for n in cameras if "front" in n), key=len, default=next(iter(cameras)))
    own = cameras[name]

    def zoomed(zoom: float) -> Camera:
        return dataclasses.replace(
            own,
            width=width,
            height=height,
            fx=own.fx * zoom * width / own.width,
            fy=own.fy * zoom * width / own.width,
            cx=width / 2 + zoom * (own.cx - own.width / 2) * width / own.width,
            cy=height / 2 + zoom * (own.cy - own.height / 2) * width / own.width,
        )

    recipe = flood_recipe("sky")
    choice = []
    for camera in map(zoomed, ZOOMS):
        off = abs(water_share(scene, camera.scaled(LOOK), recipe, backend) - WANTED_SHARE)
        if off <= NEAR_SHARE:
            return camera
        choice.append((off, camera))
    return min(choice, key=lambda entry: entry[0])[1]


def water_share(scene: Scene, camera: Camera, recipe: Recipe, backend: str = "auto") -> float:
    return float(draw(scene, camera, recipe, backend).water.mean())


def bench_cost(
    scene: Scene, camera: Camera, *, repeats: int, progress: bool = True
) -> dict[str, Any]:
    """Times of all cases and of their stages. repeats: pairs of frames that count."""
    cases = cost_cases(camera)
    results, stages = [], []
    with tqdm(total=len(cases) + len(TIERS), disable=not progress) as bar:
        for case in cases:
            bar.set_description(case.name)
            results.append(_time_case(scene, case, repeats))
            bar.update()
        for tier in TIERS:
            bar.set_description(f"stages, {tier}")
            stages.append(_stage_case(scene, camera, tier, repeats))
            bar.update()
    return {
        "camera": f"{camera.name} {camera.width}x{camera.height}, focal length {camera.fx:.0f} px",
        "gaussians": sum(len(part.gaussians) for part in scene.parts_for(camera)),
        "water_share": water_share(scene, camera, flood_recipe("sky")),
        "repeats": repeats,
        "cases": results,
        "stages": stages,
        "fresnel": _fresnel_cost(scene, camera, repeats),
    }


def _time_case(scene: Scene, case: CostCase, repeats: int) -> dict[str, Any]:
    plans = {"clean": make_plan(case.clean, scene), "flooded": make_plan(case.recipe, scene)}
    seconds = time_in_turns(scene, case.camera, plans, repeats)
    return {
        "case": case.name,
        "clean_ms": spread_ms(seconds["clean"]),
        "flooded_ms": spread_ms(seconds["flooded"]),
        "ratio": spread_ratio(seconds["flooded"], seconds["clean"]),
    }


def _stage_case(scene: Scene, camera: Camera, tier: ReflectionTier, repeats: int) -> dict[str, Any]:
    """Milliseconds of each stage with waves, and over those of the clean frame before it."""
    clean = make_plan(Recipe(output=PICTURE_ONLY), scene)
    flooded = make_plan(flood_recipe(tier, "calm"), scene)
    times: dict[str, list[float]] = defaultdict(list)
    for _ in range(repeats):
        times["clean"].append(time_frame(scene, camera, clean))
        for name, seconds in _stage_times(scene, camera, flooded).items():
            times[name].append(seconds)
    before = times.pop("clean")
    return {
        "tier": tier,
        "stages": [
            {"stage": name, "ms": spread_ms(seconds), "over_clean": spread_ratio(seconds, before)}
            for name, seconds in times.items()
        ],
    }


def _stage_times(scene: Scene, camera: Camera, plan: Plan) -> dict[str, float]:
    with _timed_stages() as times:
        whole = time_frame(scene, camera, plan)
    return {**times, REST: whole - math.fsum(times.values())}


@contextmanager
def _timed_stages() -> Iterator[dict[str, float]]:
    """Seconds spent in the functions that flooded views are made with, while this is open.

    They are replaced where they are called, so that what is timed is the frame as it is made, and
    not a copy of its order that could grow old.
    """
    times: dict[str, float] = {}
    originals = {name: getattr(flood_view, name) for name in ("rasterize", *STAGES)}

    def layer_name(camera: Camera, clip: HeightClip) -> str:
        if clip.keep == BELOW:
            return BED
        return FRONT if float(camera.centre[2]) > clip.z_m else MIRROR

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = function(*args, **kwargs)
            took = time.perf_counter() - start
            key = STAGES[name] if name in STAGES else layer_name(args[1], kwargs["clip"])
            times[key] = times.get(key, 0.0) + took
            return result

        return run

    try:
        for name, function in originals.items():
            setattr(flood_view, name, timed(name, function))
        yield times
    finally:
        for name, function in originals.items():
            setattr(flood_view, name, function)


def _fresnel_cost(scene: Scene, camera: Camera, repeats: int) -> dict[str, Any]:
    """Shading of still water under the sky tier with both formulas, in turns: where they weigh
    most.
    """
    models: tuple[FresnelModel, ...] = ("schlick", "exact")
    plans = {m: make_plan(flood_recipe("sky", fresnel=m), scene) for m in models}
    seconds: dict[str, list[float]] = {m: [] for m in models}
    for repeat in range(repeats + 1):
        for model in models if repeat % 2 else reversed(models):
            times = _stage_times(scene, camera, plans[model])
            seconds[model].append(times.get(STAGES["shade_water"], math.nan))
    counted = {model: each[1:] for model, each in seconds.items()}
    return {
        "exact_over_schlick": spread_ratio(counted["exact"], counted["schlick"]),
        **{f"{model}_ms": spread_ms(each) for model, each in counted.items()},
    }
