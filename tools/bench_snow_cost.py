"""What snow costs a frame: snowy frames against clean ones in turns, and where their time goes."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

from tqdm import tqdm

from augment.cameras import Camera
from augment.effects.snow.snow import cover_of
from augment.plan import Plan, make_plan
from augment.render.cpu.driver import rasterize_cpu
from augment.scene import Scene
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.weather import Flood, Snow
from tools.bench_flood_error import PICTURE_ONLY
from tools.bench_pairs import spread_ms, spread_ratio, time_frame, time_in_turns, turns

SHADINGS = ("per_splat", "per_pixel")
DEPTH_M = 0.1
STAGES = ("project", "sort", "bin", "raster")
PARTS, REST = "snow put in place", "the rest"


def snow_recipe(
    shading: str = "per_splat",
    *,
    cell_m: float = 0.05,
    output: Output | None = None,
    **weather: Any,
) -> Recipe:
    """Snow as the cost is measured of; weather: what else the recipe has."""
    snow = Snow.model_validate({"depth_m": DEPTH_M, "shading": shading, "cell_m": cell_m})
    return Recipe(weather=Weather(snow=snow, **weather), output=output or PICTURE_ONLY)


def cost_cases(cell_m: float = 0.05) -> dict[str, tuple[Recipe, Recipe]]:
    """The recipe with snow and that without, of every case."""
    smog = Smog(visibility_m=200)
    flood = Flood(level_m=0.15, reference="median")
    default = Output()
    cases = {}
    for shading in SHADINGS:
        cases[shading] = snow_recipe(shading, cell_m=cell_m), Recipe(output=PICTURE_ONLY)
    for shading in SHADINGS:
        cases[f"{shading}, depth and labels"] = (
            snow_recipe(shading, cell_m=cell_m, output=default),
            Recipe(output=default),
        )
    for shading in SHADINGS:
        cases[f"{shading}, smog"] = (
            snow_recipe(shading, cell_m=cell_m, smog=smog),
            Recipe(weather=Weather(smog=smog), output=PICTURE_ONLY),
        )
    cases["per_splat, flood"] = (
        snow_recipe(cell_m=cell_m, flood=flood),
        Recipe(weather=Weather(flood=flood), output=PICTURE_ONLY),
    )
    return cases


def bench_cost(
    scene: Scene, camera: Camera, *, cell_m: float = 0.05, repeats: int, progress: bool = True
) -> dict[str, Any]:
    """Times of all cases and of their stages. repeats: pairs of frames that count."""
    cases, results, stages = cost_cases(cell_m), [], []
    with tqdm(total=len(cases) + len(SHADINGS), disable=not progress) as bar:
        for name, (snowy, clean) in cases.items():
            bar.set_description(name)
            plans = {"clean": make_plan(clean, scene), "snowy": make_plan(snowy, scene)}
            seconds = time_in_turns(scene, camera, plans, repeats)
            results.append(
                {
                    "case": name,
                    "clean_ms": spread_ms(seconds["clean"]),
                    "snowy_ms": spread_ms(seconds["snowy"]),
                    "ratio": spread_ratio(seconds["snowy"], seconds["clean"]),
                }
            )
            bar.update()
        for shading in SHADINGS:
            bar.set_description(f"stages, {shading}")
            stages.append({"shading": shading, **_stages(scene, camera, shading, cell_m, repeats)})
            bar.update()
    return {
        "camera": f"{camera.name} {camera.width}x{camera.height}, focal length {camera.fx:.0f} px",
        "gaussians": sum(len(part.gaussians) for part in scene.parts_for(camera)),
        "repeats": repeats,
        "cases": results,
        "stages": stages,
    }


def _stages(
    scene: Scene, camera: Camera, shading: str, cell_m: float, repeats: int
) -> dict[str, Any]:
    """Milliseconds of each stage of a clean and of a snowy picture, and what they draw."""
    plans = {
        "clean": make_plan(Recipe(output=PICTURE_ONLY), scene),
        "snowy": make_plan(snow_recipe(shading, cell_m=cell_m), scene),
    }
    times: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in plans}
    for repeat in range(repeats + 1):
        for name in turns(plans, repeat):
            for stage, value in _stage_times(scene, camera, plans[name]).items():
                times[name][stage].append(value)
    rows = []
    for stage in (PARTS, *STAGES, REST):
        clean, snowy = (times[name][stage][1:] for name in plans)
        rows.append({"stage": stage, "clean_ms": spread_ms(clean), "snowy_ms": spread_ms(snowy)})
    counts = {
        name: {what: int(times[name][what][-1]) for what in ("splats", "visible", "pairs")}
        for name in plans
    }
    ratio = spread_ratio(*(times[name]["whole"][1:] for name in ("snowy", "clean")))
    return {"stages": rows, "counts": counts, "ratio": ratio}


def _stage_times(scene: Scene, camera: Camera, plan: Plan) -> dict[str, float]:
    """Seconds of one frame's stages, of the frame as a whole right before, and counts."""
    whole = time_frame(scene, camera, plan)
    start = time.perf_counter()
    parts = scene.parts_for(camera)
    if plan.snow is not None:
        parts = cover_of(scene, plan.snow).parts_for(scene, camera)
    placed = time.perf_counter() - start
    times: dict[str, float] = {}
    rasterize_cpu(
        parts, camera, plan.buffers, plan.settings, plan.smog_in_splats, stage_times=times
    )
    times["whole"], times[PARTS] = whole, placed
    times[REST] = whole - placed - sum(times[stage] for stage in STAGES)
    times["splats"] = sum(len(part.gaussians) for part in parts)
    return times
