"""`climategs explain`: the plan of a recipe on a scene, and the time of each pass of a frame.

Times are measured on a few of the scene's views.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from adapters.base import open_scene
from augment import effects
from augment.dataset.label_files import forecast_labels
from augment.errors import ClimateGSError
from augment.render.threads import num_kernel_threads
from augment.scene.cameras import Camera
from augment.scene.pinhole_views import covering_camera
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from augment.timing import stopwatch
from augment.view.plan import Plan, make_plan, plan_view
from augment.view.quality import apply_settings, resolve_quality
from augment.view.render_view import render_view
from recipes.fields import with_unchecked_field
from recipes.load import load_recipe
from recipes.moment import SceneTimes
from recipes.schema import SECTIONS, Recipe, free_knobs, settings_of
from recipes.template import RecipeTemplate
from tools.output import compiling_noted, fill
from tools.weather_course import course_of, write_course

FRAME = "frame"  # the whole view
ROUNDS = 3  # of all views; the fastest of each counts
VIEWS = 3


def explain_recipe(
    recipe: str | RecipeTemplate,
    scene_uri: str,
    variant: int = 0,
    *,
    times: bool = True,
    at_s: float | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Resolved numbers, plan and scene facts that decide what is rendered, and, with times, where
    the time of a few rendered views went.

    A quality that has still to choose its settings does so with times, which also takes rendering;
    without, the plan is that of reference. A recipe that changes over time is explained at one
    time of the drive.

    Args:
        recipe: a preset's name, a file, or a template.
        scene_uri: the scene.
        variant: number of the draw.
        times: if True, views are rendered to measure their time.
        at_s: seconds since the drive's first image; None for the drive's middle.
        plot: file for a picture of all numbers that change; None for none.
    """
    template = load_recipe(recipe) if isinstance(recipe, str) else recipe
    if variant >= (count := template.variants):
        variants_text = f"{count} variants, 0 to {count - 1}" if count > 1 else "one variant, 0"
        raise ClimateGSError(f"--variant {variant}: {template.name} has {variants_text}")
    resolved = template.resolve(variant)
    scene = open_scene(scene_uri)
    is_open = resolved.has_open_choice
    if is_open and times:
        with compiling_noted():
            resolved = resolve_quality(resolved, scene, progress=True).recipe
    elif is_open:
        reference = {knob.path: knob.reference for knob in free_knobs(resolved)}
        resolved = apply_settings(resolved, reference)
    drive = scene_times(scene)
    course = course_of(resolved, drive)
    state, moment = _state_at(resolved, drive, at_s)
    if plot is not None:
        write_course(plot, resolved, drive, moment["drive_s"])
    plan = make_plan(state, scene, weather_time_s=moment["weather_s"])
    facts = {
        "recipe": resolved.model_dump(mode="json"),
        "recipe_hash": resolved.hash,
        "moment": moment if course.values or at_s is not None else None,
        "state": state.model_dump(mode="json"),
        "course": course.as_dict(),
        "variants": template.variants,
        "quality": resolved.quality.summary,
        "is_chosen": times or not is_open,
        "settings": settings_of(resolved),
        "scene": {
            "name": scene.name,
            "source": scene.source,
            "cameras": list(scene.camera_names),
            "frames": len(scene.frames),
        },
        "plan": plan.as_dict(),
        "parts": [],
        "labels": forecast_labels(scene, resolved.output),
        "times": None,
    }
    if times and any(frame.cameras for frame in scene.frames):
        with compiling_noted():
            facts["times"] = measure_passes(state, scene)
            facts["parts"] = measure_parts(state, scene)
    return facts | {"views": _view_facts(plan, scene, resolved.render.scale, all_of_it=times)}


def _state_at(
    recipe: Recipe, drive: SceneTimes, at_s: float | None
) -> tuple[Recipe, dict[str, float]]:
    """Return the recipe at a time of the drive, and that time, also of the weather, seconds.

    Args:
        recipe: the recipe.
        drive: the drive's times.
        at_s: seconds since the first image; None for the drive's middle.
    """
    if at_s is not None and not 0 <= at_s <= drive.duration_s + drive.frame_s:
        raise ClimateGSError(
            f"--at {at_s:g}: the scene's drive goes from 0 to {drive.duration_s:g} s after its "
            f"first image"
        )
    drive_s = drive.duration_s / 2 if at_s is None else at_s
    weather_s = recipe.weather.clock.time_s(drive_s)
    moment = {"drive_s": drive_s, "weather_s": weather_s}
    return recipe.at_weather_time(drive, weather_s), moment


def _view_facts(plan: Plan, scene: Scene, scale: float, *, all_of_it: bool) -> dict[str, Any]:
    """In how many of the scene's views actors and what effects have masks of (water, snow) can be
    seen; None of an effect that is absent, or that takes long to prepare, unless all_of_it.
    """
    slow_effects = [] if all_of_it else [e.name for e in effects.EFFECTS if e.precomputes_files]
    quick_plan = plan.without_effects(slow_effects)
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    views = [plan_view(quick_plan, scene, camera.scaled(scale)) for camera in cameras]
    return {
        "count": len(views),
        **{
            effect.mask_name: None
            if quick_plan.effect_plans[effect.name].data is None
            else sum(effect.name in view.effect_names for view in views)
            for effect in effects.EFFECTS
            if effect.mask_name is not None
        },
        "actors": sum(bool(view.actor_ids) for view in views) if scene.actors else None,
        "mean_actors": sum(len(view.actor_ids) for view in views) / len(views) if views else None,
        "scene_actors": len(scene.actors),
    }


def measure_passes(recipe: Recipe, scene: Scene, count: int = VIEWS) -> dict[str, Any]:
    """Time a few views pass by pass, with the recipe's scale and outputs, without writing files.

    views: how many were rendered, ROUNDS times each after a warm-up. frame_ms: of one view. share:
    of each pass in it, of those that were measured. folded: shares of what is computed inside the
    rasteriser, by the difference to views without it; they are part of the shares of the passes
    that draw. noise: how far apart these passes' times are from run to run, as a share; a smaller
    difference says nothing. once_s: what was done once for the scene, in seconds.
    """
    cameras = sample_views(scene, count)
    once_s = {}
    plan = make_plan(recipe, scene)
    for effect_in_scene in plan.active_effects(scene):
        if effect_in_scene.hooks.precomputes_files:
            start = time.perf_counter()
            _ = effect_in_scene.prepared_data
            seconds = time.perf_counter() - start
            once_s[plan.effect_plans[effect_in_scene.hooks.name].steps[0].name] = seconds
    # A recipe's runs stand side by side, since a scene keeps the snow of two recipes at most.
    variants = {"": recipe} | without_folded(recipe, scene)
    runs = {name: [_runs(scene, c, variant) for c in cameras] for name, variant in variants.items()}
    # The whole of one run: passes of different runs would not add up to one frame.
    fastest = {
        name: [min(v, key=lambda r: r[FRAME]) for v in views] for name, views in runs.items()
    }
    total = _sum(fastest[""], FRAME)
    drawing_passes = ("rasterise", *(name for e in effects.EFFECTS for name in e.raster_passes))
    passes = dict.fromkeys(name for run in fastest[""] for name in run if name != FRAME)
    share = {name: _sum(fastest[""], name) / total for name in passes}
    share["everything else"] = max(0.0, 1 - sum(share.values()))
    drawn_s = {name: _sum(views, *drawing_passes) for name, views in fastest.items()}
    drawing = [[_sum([run], *drawing_passes) for run in view] for view in runs[""]]
    return {
        "views": len(cameras),
        "rounds": ROUNDS,
        "threads": num_kernel_threads(),
        "frame_ms": 1e3 * total / len(cameras),
        "share": share,
        "folded": {
            name: (drawn_s[""] - seconds) / total for name, seconds in drawn_s.items() if name
        },
        "noise": sum(max(view) - min(view) for view in drawing) / total,
        "once_s": once_s,
    }


def measure_parts(recipe: Recipe, scene: Scene, count: int = VIEWS) -> list[dict[str, Any]]:
    """Count the things of effects' parts in a few views, and time the views without each part.

    Effects have parts that a recipe can turn off one by one, such as the lamps of vehicles.

    Returns:
        for each part that has any things: effect, name, counts (mean number in a view, by kind),
        and ms (processor time of a view, less that without the part).
    """
    cameras = sample_views(scene, count)
    plan = make_plan(recipe, scene)
    parts = []
    for in_scene in plan.active_effects(scene):
        effect = in_scene.hooks
        recipes_without = effect.without_parts(in_scene, recipe)
        views = [effect.count_parts(in_scene, covering_camera(camera)) for camera in cameras]
        counts = {
            name: _mean_counts([view[name] for view in views])
            for name in recipes_without
            if any(view.get(name) for view in views)
        }
        if not counts:
            continue
        seconds = _processor_seconds(
            scene, cameras, {name: recipes_without[name] for name in counts} | {"": recipe}
        )
        parts += [
            {
                "effect": effect.name,
                "name": name,
                "counts": counts[name],
                "ms": 1e3 * (seconds[""] - seconds[name]) / len(cameras),
            }
            for name in counts
        ]
    return parts


def _mean_counts(views: Sequence[Mapping[str, int]]) -> dict[str, float]:
    """Return the mean number of things of each kind in a view."""
    kinds = dict.fromkeys(kind for view in views for kind in view)
    return {kind: sum(view.get(kind, 0) for view in views) / len(views) for kind in kinds}


def _processor_seconds(
    scene: Scene, cameras: Sequence[Camera], recipes: Mapping[str, Recipe]
) -> dict[str, float]:
    """Return the processor time of all views under each recipe, the least of ROUNDS in turns."""
    totals = dict.fromkeys(recipes, 0.0)
    for camera in cameras:
        least = dict.fromkeys(recipes, float("inf"))
        for round_number in range(1 + ROUNDS):
            for name, recipe in recipes.items():
                start = time.process_time()
                render_view(scene, camera, recipe)
                seconds = time.process_time() - start
                if round_number > 0:  # the first warms up
                    least[name] = min(least[name], seconds)
        for name in recipes:
            totals[name] += least[name]
    return totals


def sample_views(scene: Scene, count: int) -> list[Camera]:
    """Return some of the scene's views, spread evenly over frames and cameras; or all of them."""
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
    """Return recipes that each lack one pass inside the rasteriser, by the pass's name."""
    runs = {step.name for step in make_plan(recipe, scene).steps if step.runs}
    folded = {name: f for effect in effects.EFFECTS for name, f in effect.off_switches.items()}
    return {
        name: with_unchecked_field(recipe, *change)
        for name, change in folded.items()
        if name in runs
    }


def _runs(scene: Scene, camera: Camera, recipe: Recipe) -> list[dict[str, float]]:
    """Return the seconds of a view's passes, and of all as FRAME, for each run after a warm-up."""
    runs = []
    for _ in range(1 + ROUNDS):
        start = time.perf_counter()
        with stopwatch() as seconds:
            render_view(scene, camera, recipe)
        runs.append(seconds | {FRAME: time.perf_counter() - start})
    return runs[1:]


def _sum(times: Sequence[Mapping[str, float]], *names: str) -> float:
    return sum(best.get(name, 0.0) for best in times for name in names)


def explanation_text(facts: dict[str, Any]) -> str:
    """Return the facts of `explain_recipe` as a page of text."""
    sections = _sections(facts["state"])
    return fill(
        "explain.txt",
        **facts,
        numbers=[item for name, n in sections.items() if n for item in _flat(name, n)],
        rows=_course_lines(facts["course"]),
        passes=_pass_lines(facts["plan"]["steps"], facts["times"]),
        seen=[*(e.mask_name for e in reversed(effects.EFFECTS) if e.mask_name), "actors"],
        absent=[name for name, count in facts["views"].items() if count is None],
    )


def _sections(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of effects that a recipe has, by the last name of their paths."""
    sections = {}
    for path in SECTIONS:
        value: Any = recipe
        for name in path.split("."):
            value = value[name]
        sections[path.rpartition(".")[2]] = value
    return sections


def _course_lines(course: Mapping[str, Any]) -> list[str]:
    """Return a table of the numbers that change: a line of times, then one for each number."""
    values = course["values"]
    if not values:
        return []
    rows = {"seconds of the drive": course["drive_s"], **values}
    if course["weather_s"] != course["drive_s"]:
        rows = {"seconds of the weather": course["weather_s"], **rows}
    texts = {
        name: ["-" if value is None else f"{value:.4g}" for value in row]
        for name, row in rows.items()
    }
    width = max(map(len, texts))
    column = max(len(text) for row in texts.values() for text in row)
    return [
        f"  {name:<{width}}  " + "  ".join(f"{text:>{column}}" for text in row)
        for name, row in texts.items()
    ]


def _pass_lines(steps: list[dict[str, Any]], times: dict[str, Any] | None) -> list[str]:
    """Return a line for each pass, with its share of the time where that was measured."""
    share = times["share"] if times else {}
    step_names = {step["name"] for step in steps if step["runs"]}
    other_names = [name for name in share if name not in step_names]
    width = max(len(name) for name in (*(step["name"] for step in steps), *other_names))
    shares = {step["name"]: _share(step["name"], times) for step in steps if step["runs"]}
    column = max((len(text) for text in shares.values()), default=0)
    lines = [
        f"  {'runs ' if step['runs'] else 'skips'}  {step['name']:<{width}}  "
        f"{shares.get(step['name'], ''):>{column}}{'  ' if column else ''}{step['why']}"
        for step in steps
    ]
    return lines + [
        f"         {name:<{width}}  {_percent(share[name]):>{column}}" for name in other_names
    ]


def _share(name: str, times: dict[str, Any] | None) -> str:
    """Return the time of a pass as text, and in brackets its time inside the rasteriser.

    The text is empty if neither was measured.

    """
    if times is None:
        return ""
    texts = [_percent(times["share"][name])] if name in times["share"] else []
    if name in times["folded"]:
        inside = times["folded"][name]
        noise = times["noise"]
        texts.append(f"({100 * inside:+.1f} %)" if abs(inside) > noise else "(within noise)")
    return " ".join(texts)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _flat(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every number below a field with its dotted path, without fields that are not given."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _flat(f"{path}.{name}", inner)
    elif isinstance(value, (list, tuple)) and any(isinstance(v, dict) for v in value):
        for number, inner in enumerate(value):
            yield from _flat(f"{path}[{number}]", inner)
    elif value is not None:
        yield path, value
