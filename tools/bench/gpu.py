"""Every figure that the GPU backend is judged by, in one run of minutes.

Sections run in the order of their weight, each in a process of its own: one that fails, and be it
by a fault that leaves the GPU unusable to its process, or that finds no time left, is said to be
missing, and the others count. Beside times stands the least that a picture can take: the longer of
what its stages move, at the speed of a copy, and of its blends, at the speed of a kernel that does
nothing else. What a frame launches is counted where there is no GPU, too.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import importlib.util
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from adapters.base import open_scene
from augment.cameras import Camera
from augment.render.buffers import ALPHA, CPU, RGB, RenderOutput
from augment.render.constants import ALPHA_MIN, COV2D_BLUR, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda.driver import list_tiles, project, rasterize_cuda
from augment.render.cuda.runtime import gpu_device, launch
from augment.render.cuda.splats import TILE, CudaSplats, CudaStageTimer, CudaTiles, gather_inputs
from augment.render.fog import Fog
from augment.render.layout import (
    C_VALUE,
    C_X,
    C_Y,
    FALL_Y,
    LEAN_X,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    SHARP_X,
)
from augment.scene import Gaussians, Ground, PosedGaussians, Scene
from augment.views import begin_view, render_view
from recipes.schema import TIERS, Recipe, knobs_of, with_settings
from tools.bench.harness import (
    Action,
    Cell,
    EventClock,
    Figures,
    Table,
    WallClock,
    figures,
    gpu_facts,
    image_difference,
    machine_facts,
    markdown,
    peak_gpu_mib,
    replace_marked,
    rounds,
    run_and_time,
    run_in_subprocess,
    spread,
    spread_ms,
    spread_ratio,
)
from tools.bench.scenes import (
    CLEAN,
    LARGE_CASE,
    SMALL_CASE,
    WATER,
    RasterCase,
    all_cameras,
    frame_of,
    random_scene,
    recipe_of,
    street_uri,
    time_frames,
    water_camera,
)
from tools.bench.snow import placement
from tools.bench.style import fold
from tools.output import write_json

BACKEND = "cuda"
BUFFERS = frozenset({RGB, ALPHA})
SETTINGS = RasterSettings()
MEDIUM = Fog(extinction_per_m=0.03, airlight_rgb=(0.7, 0.72, 0.75))
STAGES = ("project", "list", "blend")
PLACEMENTS = PASSES = 3  # that count
START = "<!-- gpu: made by climategs bench gpu --table docs/performance.md -->"
END = "<!-- end of gpu -->"


@dataclass(frozen=True)
class Timing:
    """How often and by which clock. warm_up: rounds before the first that counts.

    From one action's mark to its next is the time on the GPU, its waiting for the host's launches
    included; no action waits for the one before unless it does so by itself.
    """

    repeats: int = 30
    warm_up: int = 5
    clock: WallClock = field(default_factory=EventClock)

    def rounds(
        self, actions: Mapping[str, Action], clock: WallClock | None = None
    ) -> dict[str, list[float]]:
        return rounds(actions, self.repeats, warm_up=self.warm_up, clock=clock or self.clock)


# ---- the least that a frame can take ------------------------------------------------------------

LANES = 256  # pixels of a program that only blends


@triton.jit(do_not_specialize=["steps"])
def blend_only(out, steps, alpha_max, alpha_min, LANES: tl.constexpr):
    """LANES pixels of a row, each blended `steps` times with a splat that moves along the row.

    What a rasteriser's inner loop does for a pixel and a splat once all that is the same for a row
    is known: a Gaussian, an exponential, the two limits of alpha, transmittance, three colours. The
    sums are written so that none of it can be left out. out: float32 [programs, LANES].
    """
    pixel = tl.arange(0, LANES)
    x = pixel.to(tl.float32)
    transmittance = tl.full([LANES], 1.0, tl.float32)
    red = tl.zeros([LANES], tl.float32)
    green = tl.zeros([LANES], tl.float32)
    blue = tl.zeros([LANES], tl.float32)
    mean = 0.0
    for _ in range(steps):
        bend = 0.1 * (x - mean)
        alpha = tl.minimum(tl.exp2(-0.5 - bend * bend), alpha_max)
        weight = tl.where(alpha >= alpha_min, alpha * transmittance, 0.0)
        transmittance -= weight
        red += weight * 0.3
        green += weight * 0.5
        blue += weight * 0.7
        mean += 0.37
    tl.store(out + tl.program_id(0) * LANES + pixel, transmittance + red + green + blue)


@dataclass(frozen=True)
class Ceilings:
    """bytes_per_s: read and written, of a copy. blends_per_s: of a pixel and a splat, with colour,
    everything in registers.
    """

    bytes_per_s: float
    blends_per_s: float

    def ms(self, moved: float, blends: float = 0.0) -> float:
        """The least that so many bytes and blends can take, one beside the other."""
        return 1e3 * max(moved / self.bytes_per_s, blends / self.blends_per_s)


def measure_ceilings(
    timing: Timing, *, copy_bytes: int = 1 << 30, programs: int = 132 * 32, steps: int = 8192
) -> Ceilings:
    """The load is far more than caches hold and launches take."""
    device, count = gpu_device(), copy_bytes // 4
    source, target = torch.ones(count, device=device), torch.zeros(count, device=device)
    out = torch.zeros((programs, LANES), device=device)

    def blend() -> None:
        limits = (SETTINGS.alpha_max, ALPHA_MIN)
        launch(blend_only, (programs,), out, steps, *limits, LANES=LANES, num_warps=8)

    seconds = timing.rounds({"copy": lambda: target.copy_(source), "blend": blend})
    copy_s, blend_s = (statistics.median(each) for each in seconds.values())
    return Ceilings(2 * 4 * count / copy_s, programs * LANES * steps / blend_s)


def floor_of(
    parts: Sequence[PosedGaussians], camera: Camera, images: RenderOutput, ceilings: Ceilings
) -> Figures:
    """What a clean frame must move and blend by stage, counted, and the least that it can take.

    Inputs are read once, results written once, of the colours those of splats in view: what a sort
    moves besides, and records that several tiles read, are the price of how it is done.
    """
    splats = project(gather_inputs(parts, camera, SETTINGS, None, None, with_color=True))
    tiles = list_tiles(splats, camera, None)
    counted = count_blends(splats, tiles, camera, SETTINGS)
    count, visible = len(splats.keys), int((splats.counts > 0).sum())
    record = splats.records.shape[1] * 4
    geometry = count * 4 * (3 + 3 + 1) + visible * 4 * 4  # means, scales, opacities; quaternions
    colors = sum(12 * part.gaussians.sh.shape[1] * len(part.gaussians) for part in parts)
    keys = 2 * 4 * count  # of depth, and how many tiles
    drawn = sum(image.nbytes for image in vars(images).values() if image is not None)
    moved = {
        "project": geometry + colors * visible // count + keys + visible * (record + 8),
        "list": keys + visible * 8 + 4 * len(tiles.tile_splat_ids) + 4 * len(tiles.tile_offsets),
        "blend": 4 * counted["entries"] + counted["used"] * record + drawn,
    }
    ms = {n: ceilings.ms(m, counted["done"] if n == "blend" else 0) for n, m in moved.items()}
    return {
        "bytes": sum(moved.values()),
        "bytes_of": moved,
        "ms": {**ms, "frame": sum(ms.values())},
        "splats": count,
        "visible": visible,
        "pairs": len(tiles.tile_splat_ids),
        **counted,
    }


def count_blends(
    splats: CudaSplats, tiles: CudaTiles, camera: Camera, settings: RasterSettings
) -> dict[str, int]:
    """done: pixels and splats that are blended, as the image's definition asks. listed: pixels and
    splats of the tiles' lists. reached: those of them before all pixels of a tile are finished.
    entries: entries of lists that are reached. used: splats that are in one of those.
    """
    stop, device = settings.transmittance_stop, splats.records.device
    used = torch.zeros(len(splats.records), dtype=torch.bool, device=device)
    found = torch.zeros(4, dtype=torch.int64, device=device)
    offsets = tiles.tile_offsets.tolist()
    for tile, (first, last) in enumerate(itertools.pairwise(offsets)):
        left, top = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
        x, y = (
            torch.arange(low, min(low + TILE, end), device=device) + 0.5
            for low, end in ((left, camera.width), (top, camera.height))
        )
        y, x = (each.reshape(-1) for each in torch.meshgrid(y, x, indexing="ij"))
        ids = tiles.tile_splat_ids[first:last].long()
        splat = splats.records[ids].T[..., None]  # [fields, entries, 1]
        dx, dy = x - splat[MEAN_X], y - splat[MEAN_Y]
        bend = splat[SHARP_X] * (dx - splat[LEAN_X] * dy)
        log_alpha = splat[LOG_OPACITY] - bend * bend - splat[FALL_Y] * dy * dy
        alpha = log_alpha.exp2().clamp(max=settings.alpha_max)
        alpha = alpha.where(log_alpha >= math.log2(ALPHA_MIN), 0)
        if splats.cuts is not None:
            cut = splats.cuts[ids].T[..., None]
            alpha = alpha * (cut[C_VALUE] + cut[C_X] * dx + cut[C_Y] * dy).clamp(0, 1)
        after = (1 - alpha).cumprod(0)
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        blended = (alpha > 0) & (before > stop) & (after > min(stop, TRANSMITTANCE_STOP))
        reached = (before > stop).any(1)
        used[ids[reached]] = True
        counts = (blended.sum(), alpha.numel(), reached.sum() * len(x), reached.sum())
        found += torch.stack([torch.as_tensor(each, device=device) for each in counts])
    names = ("done", "listed", "reached", "entries")
    return {**dict(zip(names, found.tolist(), strict=True)), "used": int(used.sum())}


# ---- the rasteriser on the random scene ---------------------------------------------------------


def draw(
    parts: list[PosedGaussians], camera: Camera, fog: Fog | None = None, timer: Any = None
) -> RenderOutput:
    return rasterize_cuda(parts, camera, BUFFERS, SETTINGS, fog, timer=timer)


def measure_raster(case: RasterCase, timing: Timing, ceilings: Ceilings) -> Figures:
    """Milliseconds on the GPU, from the call's first work to the finished images there; ours in
    turns with gsplat's, where it can be had.
    """
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    frames = {"clean": lambda: draw(parts, camera), "smog": lambda: draw(parts, camera, MEDIUM)}
    stages = []
    for _ in range(timing.warm_up + timing.repeats):  # in frames of their own
        timer = CudaStageTimer()
        draw(parts, camera, timer=timer)
        stages.append(timer.milliseconds())
    peak, extra = peak_gpu_mib(frames["clean"])  # before gsplat's copy of the scene lies there, too
    first, second = ([getattr(draw(parts, camera), n).cpu() for n in sorted(BUFFERS)] for _ in "ab")
    draws = gsplat_draws(gaussians, camera)
    others = {} if isinstance(draws, str) else draws
    seconds, gsplat = timing.rounds({**frames, **others}), {"left_out": draws}
    if others:
        fastest = min(others, key=lambda name: statistics.median(seconds[name]))
        ratio = spread_ratio(seconds["clean"], seconds[fastest])
        rgb = image_difference(draw(parts, camera).rgb, others[fastest]())
        gsplat = {"way": fastest, "ratio": ratio, "rgb": rgb}
    return {
        "case": case.name,
        "scene_mib": gaussians.nbytes / 2**20,
        "peak_mib": peak,
        "frame_mib": extra,
        "stages_ms": {s: spread([each[s] for each in stages[timing.warm_up :]]) for s in STAGES},
        "same_bits": all(map(torch.equal, first, second)),
        "floor": floor_of(parts, camera, draw(parts, camera), ceilings),
        "ms": {name: spread_ms(each) for name, each in seconds.items()},
        "smog_over_clean": spread_ratio(seconds["smog"], seconds["clean"]),
        "gsplat": gsplat,
    }


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

    device = gpu_device()
    given = {"means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities",
             "colors": "sh"}  # fmt: skip
    arguments = {
        **{k: getattr(gaussians, v).detach().contiguous().to(device) for k, v in given.items()},
        "viewmats": camera.camera_from_world.float().to(device)[None],
        "Ks": camera.K.float().to(device)[None],
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
    calm = {**WATER, "waves": {"preset": "calm"}}
    layer, overcast = {"depth_m": 0.1, "cell_m": cell_m}, {"style": {"preset": "overcast"}}
    weather = {
        "smog": {"visibility_m": 400.0, "scale_height_m": 120.0},
        "flood": {"level_m": 0.15, "turbidity_ntu": 20.0},
        "snow": layer,
    }
    wet = {name: recipe_of({"flood": {**calm, "reflection": name}})
           for name in ("mirrored", "screen_space")}  # fmt: skip
    return {
        "clean": CLEAN,
        "smog": recipe_of({"smog": {"visibility_m": 200}}),
        "flood balanced": balanced(wet["mirrored"]),
        "flood balanced, screen space": balanced(wet["screen_space"], "weather.flood.reflection"),
        "snow fast tier": recipe_of({"snow": {**layer, "shading": "per_splat"}}),
        "snow per pixel": recipe_of({"snow": {**layer, "shading": "per_pixel"}}),
        "style": recipe_of(overcast),
        "all at once, balanced": balanced(recipe_of({**weather, **overcast})),
    }


def balanced(recipe: Recipe, *kept: str) -> Recipe:
    """The recipe as `quality: balanced` would set it, all it gives itself too, but for `kept`."""
    tier = TIERS["balanced"]
    knobs = (knob for knob in knobs_of(recipe) if knob.is_selectable and knob.path not in kept)
    return with_settings(recipe, {knob.path: tier.get(knob.path, knob.reference) for knob in knobs})


def measure_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], timing: Timing
) -> Figures:
    """Every recipe's frame, in turns. ms: on the GPU, to finished floats there. delivered: 8 bits
    on the host.
    """
    rows: dict[str, Figures] = {}
    scenes = {name: dataclasses.replace(scene) for name in recipes}  # each has a memo of its own
    actions = {n: frame_of(scenes[n], camera, recipe, BACKEND) for n, recipe in recipes.items()}
    for name, frame in actions.items():  # one after the other: nobody else's snow counts as memory
        frame()  # compiles, copies the scene and places what stays with it
        peak, extra = peak_gpu_mib(frame)
        same_bits = torch.equal(frame().rgb.cpu(), frame().rgb.cpu())
        rows[name] = {"peak_mib": peak, "frame_mib": extra, "same_bits": same_bits}
    seconds = timing.rounds(actions)
    for name, row in rows.items():
        row["ms"] = spread_ms(seconds[name])
        row["over_clean"] = spread_ratio(seconds[name], seconds["clean"])
        row["delivered"] = _delivered(scenes[name], camera, recipes[name], timing)
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


def measure_passes(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """Milliseconds of every pass of a frame on the GPU and on the CPU, each waited for."""
    found: Figures = {}
    for name, recipe in recipes.items():
        own, found[name] = dataclasses.replace(scene), {}
        for backend in (BACKEND, CPU):
            _, stages = time_frames(own, camera, {"": recipe}, PASSES, backend)
            found[name][backend] = stages[""]
    return {"passes": found}


# ---- what a frame launches ----------------------------------------------------------------------

# Of torch's operations those that compute nothing: they make memory, or fetch a number.
IDLE = ("empty", "new_empty", "_local_scalar_dense")


class TorchOps(TorchDispatchMode):
    """Counts operations that would start a kernel on a GPU: all but views and IDLE ones."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        is_view = any(r.alias_info and not r.alias_info.is_write for r in func._schema.returns)
        self.count += not (is_view or func.__name__.startswith(IDLE))
        return func(*args, **(kwargs or {}))


@contextmanager
def interpreted_kernels() -> Iterator[list[float]]:
    """Seconds of each of Triton's kernels inside, whose own torch operations nobody counts."""
    from triton.runtime.interpreter import GridExecutor

    run, seconds = GridExecutor.__call__, []

    def timed_run(*arguments: Any, **given: Any) -> None:
        start = time.perf_counter()
        with _disable_current_modes():
            run(*arguments, **given)
        seconds.append(time.perf_counter() - start)

    GridExecutor.__call__ = timed_run
    try:
        yield seconds
    finally:
        GridExecutor.__call__ = run


def count_launches(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """Of a frame to floats on the GPU: torch's operations and Triton's kernels, which do not depend
    on sizes; host_ms: the time of all but the kernels, of a picture so small that operations take
    no longer than it takes to start them. Needs no GPU: kernels are interpreted.
    """
    found: Figures = {}
    for name, recipe in recipes.items():
        own = dataclasses.replace(scene)
        frame_of(own, camera, recipe, CPU)()  # places what stays with the scene
        frame = frame_of(own, camera, recipe, BACKEND)
        frame()
        with interpreted_kernels() as kernels:
            start = time.perf_counter()
            frame()
            host_s = time.perf_counter() - start - sum(kernels)
        with interpreted_kernels() as kernels, TorchOps() as ops:
            frame()
        found[name] = {"torch": ops.count, "triton": len(kernels), "host_ms": 1e3 * host_s}
    return {"launches": found}


def interpreted_street() -> tuple[Scene, Camera]:
    """The street's frame and sky around a road and a wall of few splats, for an interpreter."""
    x, y = np.meshgrid(np.arange(3.0, 13.0, 2), np.arange(-4.0, 5.0, 2))
    road, wall = np.stack([x, y, 0 * x], -1), np.stack([0 * x + 13, y, (x - 3) / 2], -1)
    means = torch.from_numpy(np.concatenate([road, wall])).reshape(-1, 3).float()
    count = len(means)
    scales = torch.tensor([[1.2, 1.2, 0.02], [0.02, 1.2, 1.2]]).repeat_interleave(count // 2, 0)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    splats = Gaussians(means, quats, scales, torch.ones(count), torch.zeros(count, 1, 3))
    ground = Ground(0.0, 0.0, "stated")
    scene = dataclasses.replace(
        open_scene(street_uri(gaussians=60_000)), background=splats, actors=(), ground=ground
    )
    return scene, water_camera(scene, 24, 16, CPU)


# ---- what is done once for a scene --------------------------------------------------------------


def measure_fold(case: RasterCase, timing: Timing, ceilings: Ceilings) -> Figures:
    """Folding one map and writing the mapped SH of random Gaussians of degree 3, on the GPU."""
    own, _ = random_scene(case)
    fields = {f.name: getattr(own, f.name) for f in dataclasses.fields(own)}
    tensors = {k: v.to(gpu_device()) for k, v in fields.items() if isinstance(v, Tensor)}
    gaussians = dataclasses.replace(own, **tensors)
    out = torch.empty_like(gaussians.sh)
    action = fold(gaussians, 1, out, BACKEND)
    action()
    floor = {"bytes": 2 * out.nbytes, "ms": {"frame": ceilings.ms(2 * out.nbytes)}}
    ms = spread_ms(timing.rounds({"fold": action})["fold"])
    return {"gaussians": len(gaussians), "ms": ms, "floor": floor}


def measure_placement(scene: Scene, uri: str, cell_m: float = 0.05) -> Figures:
    """Seconds of finding where snow can lie, for all cameras, on the host's clock."""
    place = placement(scene, cell_m, BACKEND)
    return {
        "scene": scene.name,
        "uri": uri,
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "cameras": len(all_cameras(scene)),
        "cells": len(place().ground),
        "place_s": spread(rounds({"place": place}, PLACEMENTS)["place"]),
        "peak_mib": peak_gpu_mib(place)[0],
    }


@torch.no_grad()
def raster_agreement(case: RasterCase) -> Figures:
    """How far the GPU's colours are from the CPU backend's, without and with smog."""
    from augment.render.cpu.driver import rasterize_cpu

    gaussians, camera = random_scene(case)
    parts, found = [PosedGaussians(gaussians)], {}
    for name, fog in (("clean", None), ("smog", MEDIUM)):
        expected = rasterize_cpu(parts, camera, BUFFERS, SETTINGS, fog).rgb
        found[name] = image_difference(draw(parts, camera, fog).rgb, expected)
    return found


def frame_agreement(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """The same by recipe; snow lies where one of them found a place for it."""
    found = {}
    for name, recipe in recipes.items():
        own = dataclasses.replace(scene)
        images = [frame_of(own, camera, recipe, backend)().rgb for backend in (BACKEND, CPU)]
        found[name] = image_difference(*images)
    return found


# ---- sections -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class GpuCase:
    """raster: the random scene. street: of the weathered frames, width x height pixels. placement:
    scenes for snow, besides the street. cell_m: of the snow. load: as measure_ceilings takes it.
    """

    raster: RasterCase = LARGE_CASE
    street: str = street_uri(gaussians=1_000_000)
    width: int = 1600
    height: int = 1066
    placement: tuple[str, ...] = ()
    cell_m: float = 0.05
    load: Mapping[str, int] = field(default_factory=dict)

    def open_street(self) -> tuple[Scene, Camera]:
        scene = open_scene(self.street)
        return scene, water_camera(scene, self.width, self.height, BACKEND)


WHOLE, QUICK = GpuCase(), GpuCase(SMALL_CASE, street_uri(), width=640, height=426)
CEILINGS, LAUNCHES = "ceilings", "launches"
SECTIONS = (CEILINGS, "raster", "style", "frames", "passes", "placement", "agreement", LAUNCHES)


def run_section(name: str, case: GpuCase, timing: Timing, ceilings: Ceilings | None) -> Figures:
    """One of SECTIONS; ceilings: None for their own."""
    recipes = frame_recipes(case.cell_m)
    match name:
        case "ceilings":
            return {**dataclasses.asdict(measure_ceilings(timing, **case.load)), "gpu": gpu_facts()}
        case "raster":
            return measure_raster(case.raster, timing, ceilings)
        case "style":
            return measure_fold(case.raster, timing, ceilings)
        case "frames":
            return measure_frames(*case.open_street(), recipes, timing)
        case "passes":
            return measure_passes(*case.open_street(), recipes)
        case "agreement":
            frames = frame_agreement(*case.open_street(), recipes)
            return {"raster": raster_agreement(case.raster), "frames": frames}
        case "launches":
            return count_launches(*interpreted_street(), frame_recipes(cell_m=0.4))
    uris = (*case.placement, case.street)
    found = [measure_placement(open_scene(uri), uri, case.cell_m) for uri in uris]
    return {"scenes": [{**each, "named": each["uri"] != case.street} for each in found]}


def measure(
    case: GpuCase = WHOLE,
    sections: Sequence[str] = SECTIONS,
    timing: Timing | None = None,
    minutes: float = 9.0,
    json_file: Path | None = None,
    in_processes: bool = True,
) -> Figures:
    """minutes: after which no further section begins, and one that runs is stopped. json_file: gets
    the figures after every section. in_processes: each section in one of its own.

    Raises:
        ValueError: no such section.
    """
    unknown = sorted(set(sections) - set(SECTIONS))
    if unknown:
        raise ValueError(f"sections are {', '.join(SECTIONS)}; got {', '.join(unknown)}")
    timing, start, machine = timing or Timing(), time.perf_counter(), machine_facts()
    found: Figures = {name: {"left_out": "not asked for"} for name in SECTIONS}
    asked = {*sections, *([] if set(sections) == {LAUNCHES} else [CEILINGS])}
    ceilings: Ceilings | None = None
    for name in (name for name in SECTIONS if name in asked):
        if name not in (CEILINGS, LAUNCHES) and ceilings is None:
            found[name] = {"left_out": "the GPU's ceilings could not be measured"}
            continue
        left_s = 60 * minutes - (time.perf_counter() - start)
        work = (run_section, (name, case, timing, ceilings))
        with mock.patch.dict(os.environ, {"TRITON_INTERPRET": "1"} if name == LAUNCHES else {}):
            found[name] = run_in_subprocess(*work, left_s) if in_processes else run_and_time(*work)
        if "bytes_per_s" in found[name]:
            ceilings = Ceilings(found[name]["bytes_per_s"], found[name]["blends_per_s"])
        write_json(json_file, gpu_figures(found, timing, machine), say=False)
    return gpu_figures(found, timing, machine)


# ---- figures to reach, and tables ---------------------------------------------------------------


class Target(NamedTuple):
    """What the backend is to reach on one H200. most: in the unit. value: of a section's facts, a
    spread or a number; raises _Missing where it was not measured.
    """

    what: str
    unit: str
    most: float
    section: str
    value: Callable[[Figures], Any]
    has_floor: bool = False


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
    Target("clean frame", "ms", 3.0, "raster", lambda f: f["ms"]["clean"], has_floor=True),
    Target("smog in splats, over clean", "x", 1.1, "raster", lambda f: f["smog_over_clean"]),
    Target("street: smog, over clean", "x", 1.1, "frames",
           lambda f: f["frames"]["smog"]["over_clean"]),
    Target("street: flood balanced", "ms", 6.0, "frames",
           lambda f: f["frames"]["flood balanced"]["ms"]),
    Target("street: snow fast tier, over clean", "x", 1.3, "frames",
           lambda f: f["frames"]["snow fast tier"]["over_clean"]),
    Target("street: most memory of any frame and its scene", "GB", 2.0, "frames",
           lambda f: _gigabytes(*(row["peak_mib"] for row in f["frames"].values()))),
    Target("street: rgb off the CPU backend's, 99.9 %, worst frame", "", 1e-3, "agreement",
           lambda f: _worst(f["frames"])),
    Target("style: fold and apply to all SH", "ms", 1.0, "style", lambda f: f["ms"],
           has_floor=True),
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
    row = tuple(value.values()) if isinstance(value, Mapping) else (value, None, None)
    verdict = "met" if row[0] <= target.most else "MISSED"
    floor = facts["floor"]["ms"]["frame"] if target.has_floor else None
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
        rows = []
        for name, ms in {**raster["stages_ms"], **raster["ms"]}.items():
            least, moved = floor["ms"].get(name), floor["bytes_of"].get(name)
            if name in ("clean", "smog"):
                least, moved = floor["ms"]["frame"], floor["bytes"]
            cells: Sequence[Cell] = (None, None, None, None)
            if least is not None and (median := ms["median"]):
                cells = (least, 100 * least / median, moved / 1e6, moved / median / 1e6)
            rows.append((name, *ms.values(), *cells))
        columns = ("stage", "ms", "min", "p90", "floor ms", "% of it", "MB", "GB/s")
        tables.append(Table(f"Rasteriser, {raster['case']}", columns, rows, note))
    if "frames" in frames:
        columns = ("frame", "ms", "min", "p90", "x clean", "8 bits, alone", "in a row",
                   "MiB", "of it frame", "same bits")  # fmt: skip
        rows = []
        for name, row in frames["frames"].items():
            delivered = (row["delivered"]["ms"]["median"], row["delivered"]["row_ms"])
            rest = (row["peak_mib"], row["frame_mib"], row["same_bits"])
            rows.append((name, *row["ms"].values(), row["over_clean"]["median"], *delivered, *rest))
        title = f"Street, {frames['gaussians']:,} Gaussians, {frames['camera']}"
        tables.append(Table(title, columns, rows))
    if "passes" in found["passes"]:
        rows = [
            (name, stage, ms, each[CPU].get(stage))
            for name, each in found["passes"]["passes"].items()
            for stage, ms in each[BACKEND].items()
            if max(ms, each[CPU].get(stage, 0)) >= 0.1
        ]
        columns = ("frame", "pass", "GPU ms", "CPU ms")
        tables.append(Table("Passes, each waited for; below 0.1 ms left out", columns, rows))
    if "launches" in found[LAUNCHES]:
        columns = ("frame", "torch operations", "Triton kernels", "host ms")
        rows = [(name, *each.values()) for name, each in found[LAUNCHES]["launches"].items()]
        note = "host: of all but Triton's launches, on this machine"
        tables.append(Table("What a frame launches on a GPU", columns, rows, note))
    if "scenes" in found["placement"]:
        columns = ("scene", "Gaussians", "cameras", "cells", "s", "min", "p90")
        keys = ("scene", "gaussians", "cameras", "cells")
        rows = [
            (*map(each.get, keys), *each["place_s"].values())
            for each in found["placement"]["scenes"]
        ]
        tables.append(Table("Where snow lies, once a scene", columns, rows))
    if "frames" in found["agreement"]:
        each = found["agreement"]
        named = {f"random scene, {n}": e for n, e in each["raster"].items()}
        named |= {f"street, {n}": e for n, e in each["frames"].items()}
        columns = ("rgb off the CPU backend's", "99.9 %", "max", "off by > 0.001", "pixels")
        tables.append(Table("Agreement", columns, [(n, *e.values()) for n, e in named.items()]))
    return tables


def write_table(path: Path, result: Figures) -> None:
    """Markdown into a document between its markers; a file without them is written anew."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    page = text if START in text else f"{START}\n{END}\n"
    path.write_text(replace_marked(page, START, END, markdown(result)), encoding="utf-8")
