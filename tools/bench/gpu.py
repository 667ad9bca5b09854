"""Every figure that the GPU backend is judged by, in one run of minutes.

Sections run in the order of their weight, each in a process of its own: one that fails, and be it
by a fault that leaves the GPU unusable to its process, or that finds no time left, is said to be
missing, and the others count.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import gc
import importlib.util
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from adapters.base import open_scene
from augment.cameras import Camera
from augment.effects.smog import SmogMedium
from augment.effects.snow.placement import place_snow_support
from augment.effects.snow.snow import placement_settings
from augment.effects.style.color_maps import StyleMaps, style_gaussians
from augment.errors import BackendUnavailable
from augment.plan import make_plan
from augment.render.buffers import ALPHA, RGB, RenderOutput, available_backends
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.views import WeatheredBuffers, begin_view, render_buffers, render_view
from recipes.schema import (
    TIERS,
    Flood,
    Recipe,
    Smog,
    Snow,
    Style,
    Value,
    Weather,
    knobs_of,
    with_settings,
)
from tools.bench.harness import (
    Action,
    Cell,
    Clock,
    Figures,
    Table,
    WallClock,
    figures,
    guarded,
    image_difference,
    machine_facts,
    markdown,
    replace_marked,
    rounds,
    run_in_subprocess,
    spread,
    spread_ms,
    spread_ratio,
    spread_row,
    version_of,
)
from tools.bench.scenes import (
    LARGE_CASE,
    PICTURE_ONLY,
    SMALL_CASE,
    RasterCase,
    flood_recipe,
    random_scene,
    scene_of_recipe,
    smog_recipe,
    snow_recipe,
    style_recipe,
    water_camera,
)
from tools.output import write_json

if TYPE_CHECKING:
    from tools.bench.gpu_ceilings import Ceilings

BACKEND = "cuda"
BUFFERS = frozenset({RGB, ALPHA})
SETTINGS = RasterSettings()
MEDIUM = SmogMedium(sigma_per_m=0.03, rgb=(0.7, 0.72, 0.75))
STAGES = ("project", "list", "blend")
PLACEMENTS = 3  # that count
CLEAN, SMOG, FLOOD, SCREEN = "clean", "smog", "flood balanced", "flood balanced, screen space"
SNOW, SNOW_PIXELS, STYLE = "snow fast tier", "snow per pixel", "style"
ALL = "all at once, balanced"
START = "<!-- gpu: made by climategs bench gpu --table docs/performance.md -->"
END = "<!-- end of gpu -->"


# ---- the GPU: clock, memory, what it is ---------------------------------------------------------


class EventClock:
    """The GPU's: marks are events among its work, so that nothing waits while they are set."""

    def mark(self) -> torch.cuda.Event:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def wait(self) -> None:
        torch.cuda.synchronize()

    def seconds(self, first: torch.cuda.Event, then: torch.cuda.Event) -> float:
        return first.elapsed_time(then) / 1e3


@dataclass(frozen=True)
class Timing:
    """How often and by which clock. warm_up: rounds before the first that counts.

    From one action's mark to its next is the time on the GPU, its waiting for the host's launches
    included; no action waits for the one before unless it does so by itself.
    """

    repeats: int = 30
    warm_up: int = 5
    clock: Clock = field(default_factory=EventClock)

    def rounds(self, actions: Mapping[str, Action], clock: Clock | None = None) -> dict[str, list]:
        own = clock or self.clock
        return rounds(actions, self.repeats, warm_up=self.warm_up, clock=own, progress=False)


def gpu_facts() -> dict[str, Any] | None:
    """Of the current GPU; None where torch sees none."""
    if not torch.cuda.is_available():
        return None
    found = torch.cuda.get_device_properties(torch.cuda.current_device())
    return {
        "name": found.name,
        "memory_gib": round(found.total_memory / 2**30, 1),
        "processors": found.multi_processor_count,
        "capability": f"{found.major}.{found.minor}",
        "cuda": torch.version.cuda,
        "triton": version_of("triton"),
    }


def gpu_mib() -> float | None:
    """MiB of tensors that lie on the GPU now; None without one."""
    if not torch.cuda.is_available():
        return None
    gc.collect()
    torch.cuda.synchronize()
    return torch.cuda.memory_allocated() / 2**20


def peak_gpu_mib(action: Action) -> tuple[float, float] | tuple[None, None]:
    """MiB of tensors on the GPU at the action's highest moment: all of them, and above what lay
    there before. None without a GPU. What torch holds free is not counted.
    """
    before = gpu_mib()
    if before is None:
        return None, None
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    kept = action()
    torch.cuda.synchronize()
    highest = torch.cuda.max_memory_allocated() / 2**20
    del kept
    return highest, highest - before


def check_gpu() -> None:
    """Raises BackendUnavailable where there is no GPU to measure."""
    from augment.render.cuda.runtime import has_gpu

    if not has_gpu():
        why = available_backends()["cuda"] or (
            f"torch {torch.__version__} sees no GPU, or TRITON_INTERPRET is set"
        )
        raise BackendUnavailable(f"there is no GPU to measure here: {why}")


# ---- the rasteriser on the random scene ---------------------------------------------------------


def draw(
    parts: list[PosedGaussians], camera: Camera, smog: SmogMedium | None = None, timer: Any = None
) -> RenderOutput:
    from augment.render.cuda import driver as cuda

    return cuda.rasterize_cuda(parts, camera, BUFFERS, SETTINGS, smog, timer=timer)


def measure_raster(case: RasterCase, timing: Timing, ceilings: Ceilings) -> Figures:
    """Milliseconds on the GPU, from the call's first work to the finished images there."""
    from tools.bench.gpu_ceilings import floor_of

    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    frames = {CLEAN: lambda: draw(parts, camera), SMOG: lambda: draw(parts, camera, MEDIUM)}
    stages = [_stages_ms(parts, camera) for _ in range(timing.warm_up + timing.repeats)]
    peak, extra = peak_gpu_mib(frames[CLEAN])  # before gsplat's copy of the scene lies there, too
    pairs = [[getattr(frames[CLEAN](), name).cpu() for name in sorted(BUFFERS)] for _ in "ab"]
    return {
        "case": case.name,
        "scene_mib": gaussians.nbytes / 2**20,
        "peak_mib": peak,
        "frame_mib": extra,
        "stages_ms": {
            name: spread([each[name] for each in stages[timing.warm_up :]]) for name in STAGES
        },
        "same_bits": all(map(torch.equal, *pairs)),
        "floor": floor_of(parts, camera, SETTINGS, frames[CLEAN](), ceilings),
        **_beside_gsplat(frames, gaussians, camera, timing),
    }


def _stages_ms(parts: list[PosedGaussians], camera: Camera) -> dict[str, float]:
    """Of the rasteriser's stages, in a frame of their own."""
    from augment.render.cuda.splats import GpuStageTimer

    timer = GpuStageTimer()
    draw(parts, camera, timer=timer)
    return timer.milliseconds()


def _beside_gsplat(
    frames: Mapping[str, Action], gaussians: Gaussians, camera: Camera, timing: Timing
) -> Figures:
    """Times of our frames, in turns with gsplat's where it can be had."""
    draws = gsplat_draws(gaussians, camera)
    others = {} if isinstance(draws, str) else draws
    seconds = timing.rounds({**frames, **others})
    found: Figures = {
        "ms": {name: spread_ms(each) for name, each in seconds.items()},
        "smog_over_clean": spread_ratio(seconds[SMOG], seconds[CLEAN]),
    }
    if isinstance(draws, str):
        return {**found, "gsplat": {"left_out": draws}}
    fastest = min(others, key=lambda name: statistics.median(seconds[name]))
    ours = draw([PosedGaussians(gaussians)], camera).rgb
    assert ours is not None
    ratio = spread_ratio(seconds[CLEAN], seconds[fastest])
    rgb = image_difference(ours, others[fastest]())
    return {**found, "gsplat": {"way": fastest, "ratio": ratio, "rgb": rgb}}


def gsplat_draws(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Tensor]] | str:
    """Ways to draw the scene's rgb with gsplat, by name; or why there is none. The first draw of
    each has been done: it compiles where gsplat was installed without compiled kernels.
    """
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed (pip install 'climategs[gsplat]')"
    try:
        draws = {f"gsplat, {way}": _gsplat_draw(gaussians, camera, way == "packed")
                 for way in ("packed", "unpacked")}  # fmt: skip
        for each in draws.values():
            each()
    except Exception as error:  # another's code, which may fail in ways of its own
        return f"gsplat failed: {type(error).__name__}: {error}"
    return draws


def _gsplat_draw(gaussians: Gaussians, camera: Camera, packed: bool) -> Callable[[], Tensor]:
    from gsplat import rasterization  # type: ignore[import-not-found]

    from augment.render.cuda.runtime import gpu_device

    device = gpu_device()
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    given = {"means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities",
             "colors": "sh"}  # fmt: skip
    arguments = {
        **{k: getattr(gaussians, v).detach().contiguous().to(device) for k, v in given.items()},
        "viewmats": camera.camera_from_world.float().to(device)[None],
        "Ks": torch.tensor([intrinsics], device=device),
        "width": camera.width,
        "height": camera.height,
        "near_plane": SETTINGS.near_m,
        "eps2d": COV2D_BLUR,
        "sh_degree": gaussians.sh_degree,
        "packed": packed,
        "render_mode": "RGB",
    }

    @torch.no_grad()
    def draw_once() -> Tensor:
        return rasterization(**arguments)[0][0]

    return draw_once


# ---- weathered frames, and what is done once for a scene ----------------------------------------


def frame_recipes(cell_m: float = 0.05) -> dict[str, Recipe]:
    """What is timed: pictures only, at default settings or those of a tier. The balanced flood is
    the reference's, mirrored reflection and all, but for what the tier takes back; the fast tier of
    snow lights it per splat.
    """
    flood = flood_recipe("mirrored", "calm")
    weather = Weather(
        smog=Smog(visibility_m=400.0, scale_height_m=120.0),
        flood=Flood(level_m=0.15, turbidity_ntu=20.0),
        snow=Snow(depth_m=0.1, cell_m=cell_m),
    )
    everything = Recipe(weather=weather, style=Style(preset="overcast"), output=PICTURE_ONLY)
    return {
        CLEAN: Recipe(output=PICTURE_ONLY),
        SMOG: smog_recipe(),
        FLOOD: balanced(flood),
        SCREEN: balanced(flood, {"weather.flood.reflection": "screen_space"}),
        SNOW: snow_recipe("per_splat", cell_m=cell_m),
        SNOW_PIXELS: snow_recipe("per_pixel", cell_m=cell_m),
        STYLE: style_recipe(),
        ALL: balanced(everything),
    }


def balanced(recipe: Recipe, given: Mapping[str, Value] | None = None) -> Recipe:
    """The recipe as `quality: balanced` would set it, all it gives itself too, but for `given`."""
    tier = TIERS["balanced"]
    chosen = {k.path: tier.get(k.path, k.reference) for k in knobs_of(recipe) if k.chosen}
    return with_settings(recipe, chosen | dict(given or {}))


def measure_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], timing: Timing
) -> Figures:
    """Every recipe's frame, in turns. ms: on the GPU, to finished floats there. delivered: 8 bits
    on the host.
    """
    rows: dict[str, Figures] = {}

    def frame_of(name: str) -> functools.partial[WeatheredBuffers]:
        own, plan = scene_of_recipe(scene, recipes[name], BACKEND), make_plan(recipes[name], scene)
        frame = functools.partial(render_buffers, own, camera, plan, backend=BACKEND)
        frame()  # compiles, copies the scene and places what stays with it
        return frame

    for name in recipes:  # one after the other: nobody else's snow counts as memory
        frame = frame_of(name)
        peak, extra = peak_gpu_mib(frame)
        same_bits = torch.equal(frame().rgb.cpu(), frame().rgb.cpu())
        rows[name] = {"peak_mib": peak, "frame_mib": extra, "same_bits": same_bits}
        del frame
    actions = {name: frame_of(name) for name in recipes}
    seconds = timing.rounds(actions)
    for name, row in rows.items():
        row["ms"] = spread_ms(seconds[name])
        row["over_clean"] = spread_ratio(seconds[name], seconds[CLEAN])
        row["delivered"] = _delivered(actions[name].args[0], camera, recipes[name], timing)
    return {
        "camera": f"{camera.name} {camera.width}x{camera.height}",
        "gaussians": sum(len(part.gaussians) for part in scene.parts_for(camera)),
        "frames": rows,
    }


def _delivered(scene: Scene, camera: Camera, recipe: Recipe, timing: Timing) -> Figures:
    """Milliseconds of the host's clock to pictures in 8 bits that lie there: of a view alone, and
    of each of a row of them in which the next is begun before the last is waited for.
    """
    view = functools.partial(render_view, scene, camera, recipe, backend=BACKEND)
    alone = spread_ms(timing.rounds({"": view}, WallClock())[""])
    start = time.perf_counter()
    pending = begin_view(scene, camera, recipe, backend=BACKEND)
    for _ in range(timing.repeats):
        following = begin_view(scene, camera, recipe, backend=BACKEND)
        pending.result()
        pending = following
    pending.result()
    return {"ms": alone, "row_ms": 1e3 * (time.perf_counter() - start) / (timing.repeats + 1)}


def measure_style(case: RasterCase, timing: Timing, ceilings: Ceilings) -> Figures:
    """Folding one map and writing the mapped SH of random Gaussians of degree 3, on the GPU."""
    from augment.render.cuda.runtime import gpu_device

    own, _ = random_scene(case)
    fields = {f.name: getattr(own, f.name) for f in dataclasses.fields(own)}
    tensors = {k: v.to(gpu_device()) for k, v in fields.items() if isinstance(v, Tensor)}
    gaussians = dataclasses.replace(own, **tensors)
    one = 0.9 * torch.eye(3, 4)
    maps, out = StyleMaps(one[None], one, one), torch.empty_like(gaussians.sh)

    def fold() -> None:
        style_gaussians(gaussians, maps, out=out, backend=BACKEND)

    fold()
    moved = 2 * out.nbytes
    return {
        "gaussians": len(gaussians),
        "ms": spread_ms(timing.rounds({"fold": fold})["fold"]),
        "floor": {"bytes": moved, "ms": {"frame": ceilings.ms(moved)}},
    }


def measure_placement(scene: Scene, uri: str, cell_m: float = 0.05) -> Figures:
    """Seconds of finding where snow can lie, for all cameras, on the host's clock."""
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    settings = placement_settings(Snow(depth_m=0, cell_m=cell_m))
    stages: dict[str, list[float]] = defaultdict(list)
    cells = 0

    def place() -> None:
        nonlocal cells
        found = place_snow_support(scene, cameras, settings, backend=BACKEND)
        cells = len(found.ground)
        for name, seconds in found.seconds.items():
            stages[name].append(seconds)

    seconds = rounds({"place": place}, PLACEMENTS, progress=False)["place"]
    return {
        "scene": scene.name,
        "uri": uri,
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "cameras": len(cameras),
        "cells": cells,
        "place_s": spread(seconds),
        "stages_s": {name: statistics.median(each[1:]) for name, each in stages.items()},
        "peak_mib": peak_gpu_mib(place)[0],
    }


@torch.no_grad()
def raster_agreement(case: RasterCase) -> Figures:
    """How far the GPU's colours are from the CPU backend's, without and with smog."""
    from augment.render.cpu.driver import rasterize_cpu

    gaussians, camera = random_scene(case)
    parts, found = [PosedGaussians(gaussians)], {}
    for name, smog in ((CLEAN, None), (SMOG, MEDIUM)):
        expected = rasterize_cpu(parts, camera, BUFFERS, SETTINGS, smog).rgb
        own = draw(parts, camera, smog).rgb
        assert expected is not None and own is not None
        found[name] = image_difference(own, expected)
    return found


def frame_agreement(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """The same by recipe; snow lies where one of them found a place for it."""
    found = {}
    for name, recipe in recipes.items():
        own, plan = scene_of_recipe(scene, recipe, BACKEND), make_plan(recipe, scene)
        images = [render_buffers(own, camera, plan, backend=b).rgb for b in (BACKEND, "cpu")]
        found[name] = image_difference(images[0], images[1])
    return found


# ---- sections -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class GpuCase:
    """raster: the random scene. street: of the weathered frames, width x height pixels. placement:
    scenes for snow, besides the street. cell_m: of the snow. minutes: after which no further
    section begins, and one that runs is stopped. load: as measure_ceilings takes it.
    """

    raster: RasterCase = LARGE_CASE
    street: str = "procedural:street?seed=3&frames=1&gaussians=1000000"
    width: int = 1600
    height: int = 1066
    placement: tuple[str, ...] = ()
    cell_m: float = 0.05
    minutes: float = 9.0
    load: Mapping[str, int] = field(default_factory=dict)

    def open_street(self) -> tuple[Scene, Camera]:
        scene = open_scene(self.street)
        return scene, water_camera(scene, self.width, self.height, BACKEND)


WHOLE = GpuCase()
QUICK = GpuCase(SMALL_CASE, "procedural:street?seed=3&frames=1", width=640, height=426)
CEILINGS = "ceilings"


SECTIONS = (CEILINGS, "raster", "style", "frames", "placement", "agreement")


def run_section(name: str, case: GpuCase, timing: Timing, ceilings: Ceilings | None) -> Figures:
    """One of SECTIONS; ceilings: None for their own."""
    if ceilings is None:
        from tools.bench.gpu_ceilings import measure_ceilings

        return {
            **dataclasses.asdict(measure_ceilings(timing.rounds, **case.load)),
            "gpu": gpu_facts(),
        }
    recipes = frame_recipes(case.cell_m)
    match name:
        case "raster":
            return measure_raster(case.raster, timing, ceilings)
        case "style":
            return measure_style(case.raster, timing, ceilings)
        case "frames":
            return measure_frames(*case.open_street(), recipes, timing)
        case "agreement":
            frames = frame_agreement(*case.open_street(), recipes)
            return {"raster": raster_agreement(case.raster), "frames": frames}
    uris = (*case.placement, case.street)
    found = [measure_placement(open_scene(uri), uri, case.cell_m) for uri in uris]
    return {"scenes": [{**each, "named": each["uri"] != case.street} for each in found]}


def bench_gpu(
    case: GpuCase = WHOLE,
    *,
    sections: Sequence[str] = SECTIONS,
    timing: Timing | None = None,
    json_file: Path | None = None,
    in_processes: bool = True,
) -> Figures:
    """json_file: gets the figures after every section. in_processes: each section in one of its
    own.

    Raises:
        ValueError: no such section.
    """
    unknown = sorted(set(sections) - set(SECTIONS))
    if unknown:
        raise ValueError(f"sections are {', '.join(SECTIONS)}; got {', '.join(unknown)}")
    timing, start, machine = timing or Timing(), time.perf_counter(), machine_facts()
    found: Figures = {name: {"left_out": "not asked for"} for name in SECTIONS}
    ceilings: Ceilings | None = None
    for name in SECTIONS:
        if name != CEILINGS and name not in sections:
            continue
        if name != CEILINGS and ceilings is None:
            found[name] = {"left_out": "the GPU's ceilings could not be measured"}
            continue
        left_s = 60 * case.minutes - (time.perf_counter() - start)
        work = (run_section, (name, case, timing, ceilings))
        found[name] = run_in_subprocess(*work, left_s) if in_processes else guarded(*work)
        if "bytes_per_s" in found[name]:
            from tools.bench.gpu_ceilings import Ceilings

            ceilings = Ceilings(found[name]["bytes_per_s"], found[name]["blends_per_s"])
        write_json(json_file, gpu_figures(found, timing, machine), say=False)
    return gpu_figures(found, timing, machine)


# ---- figures to reach, and tables ---------------------------------------------------------------


class Target(NamedTuple):
    """What the backend is to reach on one H200. most: in the unit. value: of a section's facts, a
    spread or a number; raises _Missing where it was not measured. floor: as of floor_of, if known.
    """

    what: str
    unit: str
    most: float
    section: str
    value: Callable[[Figures], Any]
    floor: Callable[[Figures], Figures] | None = None


class _Missing(Exception):
    """Why a figure was not measured."""


def _gsplat_ratio(raster: Figures) -> Figures:
    if "left_out" in raster["gsplat"]:
        raise _Missing(raster["gsplat"]["left_out"])
    return raster["gsplat"]["ratio"]


def _slowest_named(placement: Figures) -> Figures:
    """The procedural street alone decides nothing."""
    named = [each["place_s"] for each in placement["scenes"] if each["named"]]
    if not named:
        raise _Missing("no scene was named with --placement")
    return max(named, key=lambda seconds: seconds["median"])


def _gigabytes(*peaks: float | None) -> float:
    known = [mib for mib in peaks if mib is not None]
    if len(known) < len(peaks):
        raise _Missing("no GPU memory was measured")
    return max(known) * 2**20 / 1e9


def _worst(errors: Figures) -> float:
    return max(each["p999"] for each in errors.values())


TARGETS = (
    Target("clean frame", "ms", 3.0, "raster", lambda f: f["ms"][CLEAN], lambda f: f["floor"]),
    Target("smog in splats, over clean", "x", 1.1, "raster", lambda f: f["smog_over_clean"]),
    Target("street: smog, over clean", "x", 1.1, "frames",
           lambda f: f["frames"][SMOG]["over_clean"]),
    Target("street: flood balanced", "ms", 6.0, "frames", lambda f: f["frames"][FLOOD]["ms"]),
    Target("street: snow fast tier, over clean", "x", 1.3, "frames",
           lambda f: f["frames"][SNOW]["over_clean"]),
    Target("street: most memory of any frame and its scene", "GB", 2.0, "frames",
           lambda f: _gigabytes(*(row["peak_mib"] for row in f["frames"].values()))),
    Target("street: rgb off the CPU backend's, 99.9 %, worst frame", "", 1e-3, "agreement",
           lambda f: _worst(f["frames"])),
    Target("style: fold and apply to all SH", "ms", 1.0, "style", lambda f: f["ms"],
           lambda f: f["floor"]),
    Target("placement of snow, PandaSet", "s", 1.0, "placement", _slowest_named),
    Target("memory of the clean frame and its scene", "GB", 2.0, "raster",
           lambda f: _gigabytes(f["peak_mib"])),
    Target("clean frame, over gsplat's", "x", 1.3, "raster", _gsplat_ratio),
    Target("rgb off the CPU backend's, 99.9 %", "", 1e-3, "agreement",
           lambda f: _worst(f["raster"])),
)  # fmt: skip


def target_row(target: Target, found: Figures) -> tuple[Cell, ...]:
    """what, measured, min, p90, at most, met or MISSED or why not measured, floor."""
    facts, limit = found[target.section], f"{target.most:g} {target.unit}".strip()
    try:
        if why := facts.get("failed") or facts.get("left_out"):
            raise _Missing(why)
        value = target.value(facts)
    except _Missing as why:
        return (target.what, None, None, None, limit, f"not measured: {why}", None)
    row = spread_row(value) if isinstance(value, Mapping) else (value, None, None)
    verdict = "met" if row[0] <= target.most else "MISSED"
    floor = None if target.floor is None else target.floor(facts)["ms"]["frame"]
    return (target.what, *row, limit, verdict, floor)


def gpu_figures(found: Figures, timing: Timing, machine: Figures) -> Figures:
    """In the JSON form; facts hold every section's."""
    return figures(
        "gpu",
        gpu_tables(found),
        machine=machine,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        gpu=found[CEILINGS].get("gpu"),
        repeats=timing.repeats,
        warm_up=timing.warm_up,
        sections=dict(found),
    )


def gpu_tables(found: Figures) -> list[Table]:
    ceilings, raster, frames = found[CEILINGS], found["raster"], found["frames"]
    note = ""
    if "bytes_per_s" in ceilings:
        note = (
            f"at best, measured: {ceilings['bytes_per_s'] / 1e9:.0f} GB/s copied, "
            f"{ceilings['blends_per_s'] / 1e9:.0f} G blends/s"
        )
    columns = ("what", "measured", "min", "p90", "at most", "", "floor")
    tables = [Table("Figures to reach", columns, [target_row(t, found) for t in TARGETS], note)]
    if "ms" in raster:
        floor = raster["floor"]
        note = (
            f"{floor['visible']:,} of {floor['splats']:,} splats in view, {floor['used']:,} before "
            f"pixels are finished; {floor['pairs']:,} pairs of splats and tiles, "
            f"{floor['entries']:,} reached; {floor['done']:,} blends, {floor['reached']:,} tried"
        )
        rows = [
            _stage_row(name, raster["stages_ms"][name], floor["ms"][name], floor["bytes_of"][name])
            for name in STAGES
        ]
        whole = floor["ms"]["frame"], floor["bytes"]
        for name, ms in raster["ms"].items():
            rows.append(_stage_row(name, ms, *((None, None) if "gsplat" in name else whole)))
        columns = ("stage", "ms", "min", "p90", "floor ms", "% of it", "MB", "GB/s")
        tables.append(Table(f"Rasteriser, {raster['case']}", columns, rows, note))
    if "frames" in frames:
        columns = ("frame", "ms", "min", "p90", "x clean", "8 bits, alone", "in a row",
                   "MiB", "of it frame", "same bits")  # fmt: skip
        rows = [_frame_row(name, row) for name, row in frames["frames"].items()]
        title = f"Street, {frames['gaussians']:,} Gaussians, {frames['camera']}"
        tables.append(Table(title, columns, rows))
    if "scenes" in found["placement"]:
        columns = ("scene", "Gaussians", "cameras", "cells", "s", "min", "p90", "slowest stages")
        rows = [_placement_row(each) for each in found["placement"]["scenes"]]
        tables.append(Table("Where snow lies, once a scene", columns, rows))
    if "frames" in found["agreement"]:
        each = found["agreement"]
        named = {f"random scene, {n}": e for n, e in each["raster"].items()}
        named |= {f"street, {n}": e for n, e in each["frames"].items()}
        columns = ("rgb off the CPU backend's", "99.9 %", "max", "off by > 0.001", "pixels")
        tables.append(Table("Agreement", columns, [(n, *e.values()) for n, e in named.items()]))
    return tables


def _stage_row(
    name: str, ms: Mapping[str, float], floor: float | None, moved: float | None
) -> tuple[Cell, ...]:
    median = ms["median"]
    if floor is None or moved is None or not median:
        return (name, *spread_row(ms), floor, None, None, None)
    return (name, *spread_row(ms), floor, 100 * floor / median, moved / 1e6, moved / median / 1e6)


def _frame_row(name: str, row: Figures) -> tuple[Cell, ...]:
    ratio = row["over_clean"]["median"]
    delivered = (row["delivered"]["ms"]["median"], row["delivered"]["row_ms"])
    memory = (row["peak_mib"], row["frame_mib"])
    return (name, *spread_row(row["ms"]), ratio, *delivered, *memory, row["same_bits"])


def _placement_row(found: Figures) -> tuple[Cell, ...]:
    slowest = sorted(found["stages_s"].items(), key=lambda item: -item[1])[:3]
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in slowest)
    counts = (found["gaussians"], found["cameras"], found["cells"])
    return (found["scene"], *counts, *spread_row(found["place_s"]), stages)


def write_table(path: Path, result: Figures) -> None:
    """Markdown into a document between its markers; a file without them is written anew."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    page = text if START in text else f"{START}\n{END}\n"
    path.write_text(replace_marked(page, START, END, markdown(result)), encoding="utf-8")
