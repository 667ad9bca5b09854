"""Whole weathered frames on a GPU: their times beside the clean one's, memory, floors, delivery."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from typing import Any

import torch

from augment.cameras import Camera
from augment.plan import Plan, make_plan
from augment.scene import Scene
from augment.views import WeatheredBuffers, begin_view, render_buffers, render_view
from recipes.schema import TIERS, Recipe, Smog, Value, Weather, knobs_of, with_settings
from recipes.weather import Style
from tools.bench_flood_error import PICTURE_ONLY, flood_recipe
from tools.bench_gpu_ceilings import Ceilings
from tools.bench_gpu_raster import difference
from tools.bench_pairs import spread, spread_ratio
from tools.bench_snow_cost import snow_recipe
from tools.gpu_clock import Timing, peak_gpu_mib, times_in_turns
from tools.trade_cases import trade_recipe
from tools.trade_measure import dressed

BACKEND = "cuda"
CLEAN, SMOG, FLOOD, SCREEN = "clean", "smog", "flood balanced", "flood balanced, screen space"
SNOW, SNOW_PIXELS, STYLE = "snow fast tier", "snow per pixel", "style"
ALL = "all at once, balanced"


def frame_recipes(cell_m: float = 0.05) -> dict[str, Recipe]:
    """What is timed, by name: pictures only, at default settings or those of a tier.

    The balanced flood is the reference's, mirrored reflection and all, but for what the tier takes
    back; the fast tier of snow lights it per splat.
    """
    flood = flood_recipe("mirrored", "calm")
    everything = trade_recipe("all").model_copy(update={"output": PICTURE_ONLY})
    return {
        CLEAN: Recipe(output=PICTURE_ONLY),
        SMOG: Recipe(weather=Weather(smog=Smog(visibility_m=200)), output=PICTURE_ONLY),
        FLOOD: balanced(flood),
        SCREEN: balanced(flood, {"weather.flood.reflection": "screen_space"}),
        SNOW: snow_recipe("per_splat", cell_m=cell_m),
        SNOW_PIXELS: snow_recipe("per_pixel", cell_m=cell_m),
        STYLE: Recipe(style=Style(preset="overcast"), output=PICTURE_ONLY),
        ALL: balanced(everything),
    }


def balanced(recipe: Recipe, given: Mapping[str, Value] | None = None) -> Recipe:
    """The recipe as `quality: balanced` would set it, all it gives itself too, but for `given`."""
    tier = TIERS["balanced"]
    chosen = {k.path: tier.get(k.path, k.reference) for k in knobs_of(recipe) if k.chosen}
    return with_settings(recipe, chosen | dict(given or {}))


def bench_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], timing: Timing, ceilings: Ceilings
) -> dict[str, Any]:
    """Times of every recipe's frame, in turns. ms: on the GPU, to finished floats there.
    over_clean: turn by turn. delivered: as `render` takes them, 8 bits on the host.

    The first frame of each compiles, copies the scene and lays snow, which is no frame's time:
    first_s.
    """
    plans = {name: make_plan(recipe, scene) for name, recipe in recipes.items()}

    def frame(name: str, own: Scene) -> WeatheredBuffers:
        return render_buffers(own, camera, plans[name], backend=BACKEND)

    rows: dict[str, dict[str, Any]] = {}
    for name, recipe in recipes.items():  # one after the other: nobody else's snow counts as memory
        own = dressed(scene, recipe, BACKEND)
        start = time.perf_counter()
        frame(name, own)
        timing.clock.wait()
        first_s = time.perf_counter() - start
        memory = peak_gpu_mib(functools.partial(frame, name, own))
        rows[name] = {
            "first_s": first_s,
            "peak_mib": None if memory is None else memory[0],
            "frame_mib": None if memory is None else memory[1],
            "same_bits": torch.equal(frame(name, own).rgb.cpu(), frame(name, own).rgb.cpu()),
            "floor": _floor(own, camera, plans[name], ceilings),
        }
        del own
    scenes = {name: dressed(scene, recipe, BACKEND) for name, recipe in recipes.items()}
    actions = {name: functools.partial(frame, name, own) for name, own in scenes.items()}
    for action in actions.values():  # lays what stays with its scene
        action()
    times = times_in_turns(actions, timing)
    for name, row in rows.items():
        row["ms"] = spread(times[name])
        row["over_clean"] = spread_ratio(times[name], times[CLEAN])
        row["delivered"] = delivered(scenes[name], camera, recipes[name], timing)
    return {
        "camera": f"{camera.name} {camera.width}x{camera.height}, focal length {camera.fx:.0f} px",
        "gaussians": sum(len(part.gaussians) for part in scene.parts_for(camera)),
        "repeats": timing.repeats,
        "frames": rows,
    }


def frame_agreement(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]
) -> dict[str, dict[str, float]]:
    """How far the GPU's colours are from the CPU backend's, by recipe; snow lies where one of them
    found a place for it.
    """
    found = {}
    for name, recipe in recipes.items():
        own, plan = dressed(scene, recipe, BACKEND), make_plan(recipe, scene)
        images = [render_buffers(own, camera, plan, backend=b).rgb for b in (BACKEND, "cpu")]
        found[name] = difference(images[0], images[1])
    return found


def _floor(scene: Scene, camera: Camera, plan: Plan, ceilings: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_floor import frame_floor, noted_passes

    with noted_passes() as passes:
        buffers = render_buffers(scene, camera, plan, backend=BACKEND)
    finished = [buffers.rgb, buffers.depth_m, buffers.water, buffers.snow]
    moved = sum(image.numel() * image.element_size() for image in finished if image is not None)
    return frame_floor(passes, moved).as_dict(ceilings)


def delivered(scene: Scene, camera: Camera, recipe: Recipe, timing: Timing) -> dict[str, Any]:
    """Milliseconds of the host's clock to pictures in 8 bits that lie there: of a view alone, and
    of each of a row of them in which the next is begun before the last is waited for.
    """
    alone = []
    for turn in range(timing.warm_up + timing.repeats):
        start = time.perf_counter()
        render_view(scene, camera, recipe, backend=BACKEND)
        if turn >= timing.warm_up:
            alone.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    pending = begin_view(scene, camera, recipe, backend=BACKEND)
    for _ in range(timing.repeats):
        following = begin_view(scene, camera, recipe, backend=BACKEND)
        pending.result()
        pending = following
    pending.result()
    in_a_row = 1e3 * (time.perf_counter() - start) / (timing.repeats + 1)
    return {"ms": spread(alone), "in_a_row_ms": in_a_row, "views": timing.repeats + 1}


def highest_mib(figures: Mapping[str, Any]) -> float | None:
    """The most that any of the frames' tensors took on the GPU, scene included."""
    found = [row["peak_mib"] for row in figures["frames"].values()]
    return None if None in found or not found else max(found)
