"""`climategs bench gpu`: measure every figure that the GPU backend is judged by, within minutes.

`measure` runs SECTIONS in the order of their importance and returns their figures, as tables and
as facts. Each section runs in its own process. If a section fails, or if no time is left for it,
its entry says why and the other sections still count. A section may even fail with a GPU fault
that makes the GPU unusable for its process.

Next to a measured time stands its floor, the least time that the work can take. The floor is the
longer of two times: the time to move the bytes of the stages at the speed of a copy, and the time
to do the blends at the speed of a kernel that only blends.

The section "launches" counts the operations that a frame starts on a GPU. It runs without a GPU.
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
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Ground, PosedGaussians, Scene
from augment.view.render_view import begin_view, render_view
from recipes.schema import TIERS, Recipe, knobs_of, with_settings
from tools.bench.effects import fold, placement, time_frames
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
    water_camera,
)
from tools.output import write_json

BACKEND = "cuda"  # The backend that is measured.
BUFFERS = frozenset({RGB, ALPHA})  # The buffers that the rasteriser draws.
SETTINGS = RasterSettings()  # The rasteriser's settings, those of the reference image.
# The fog of the rasteriser's frames with smog.
FOG = Fog(extinction_per_m=0.03, airlight_rgb=(0.7, 0.72, 0.75))
STAGES = ("project", "list", "blend")  # The stages of a frame on the GPU, in their order.
NUM_PLACEMENTS = 3  # The number of times that snow is placed, after a round that does not count.
NUM_PASSES = 3  # The number of frames whose passes are timed, after one that does not count.
# The lines of the document between which the tables are written.
START_MARKER = "<!-- gpu: made by climategs bench gpu --table docs/performance.md -->"
END_MARKER = "<!-- end of gpu -->"


@dataclass(frozen=True)
class Timing:
    """How often and by which clock actions are timed.

    The clock marks the end of every action. The time between two marks is the time on the GPU,
    including the time that the GPU waits for the host's launches. No action waits for the one
    before it, unless its own code does so.
    """

    repeats: int = 30
    """The number of rounds that count."""
    warm_up: int = 5
    """The number of rounds before the first that counts."""
    clock: WallClock = field(default_factory=EventClock)
    """The clock that marks the end of every action."""

    def rounds(
        self, actions: Mapping[str, Action], clock: WallClock | None = None
    ) -> dict[str, list[float]]:
        """Return the seconds of every action in every round that counts.

        Args:
            actions: The actions by name; they take turns within a round.
            clock: Another clock than the record's.
        """
        return rounds(actions, self.repeats, warm_up=self.warm_up, clock=clock or self.clock)


# ---- the least that a frame can take ------------------------------------------------------------

LANES = 256  # The number of pixels that a program of `blend_only` blends.


@triton.jit(do_not_specialize=["steps"])
def blend_only(out, steps, alpha_max, alpha_min, LANES: tl.constexpr):
    """Blend LANES pixels of a row `steps` times with a splat that moves along the row.

    This is the work of a rasteriser's inner loop for one pixel and one splat, without everything
    that is the same for a whole row: a Gaussian, an exponential, the two limits of alpha, the
    transmittance and three colours. The sum is stored so that the compiler can leave nothing out.

    Args:
        out: [programs, LANES], float32. Receives the sum of transmittance and colours.
        steps: The number of blends of each pixel.
        alpha_max: The largest alpha of a splat.
        alpha_min: The smallest alpha that is blended.
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
    """The highest speeds that the GPU reaches, measured."""

    bytes_per_s: float
    """Bytes a second of a copy, read and written together."""
    blends_per_s: float
    """Blends a second of one pixel with one splat, with colour and everything in registers."""

    def ms(self, num_bytes: float, num_blends: float = 0.0) -> float:
        """Return the least milliseconds for the bytes and the blends, both at the same time."""
        return 1e3 * max(num_bytes / self.bytes_per_s, num_blends / self.blends_per_s)


def measure_ceilings(
    timing: Timing, *, copy_bytes: int = 1 << 30, programs: int = 132 * 32, steps: int = 8192
) -> Ceilings:
    """Measure the GPU's ceilings with a copy and with a kernel that only blends.

    The default load is far larger than the caches, and takes far longer than its launches.

    Args:
        timing: How often and by which clock both are timed.
        copy_bytes: The size of the array that is copied.
        programs: The number of programs of the blending kernel.
        steps: The number of blends of each pixel.
    """
    device = gpu_device()
    count = copy_bytes // 4
    source = torch.ones(count, device=device)
    target = torch.zeros(count, device=device)
    out = torch.zeros((programs, LANES), device=device)

    def blend() -> None:
        limits = (SETTINGS.alpha_max, ALPHA_MIN)
        launch(blend_only, (programs,), out, steps, *limits, LANES=LANES, num_warps=8)

    seconds = timing.rounds({"copy": lambda: target.copy_(source), "blend": blend})
    copy_s, blend_s = (statistics.median(times) for times in seconds.values())
    return Ceilings(2 * 4 * count / copy_s, programs * LANES * steps / blend_s)


def frame_floor(
    parts: Sequence[PosedGaussians], camera: Camera, images: RenderOutput, ceilings: Ceilings
) -> Figures:
    """Count the bytes and blends of a clean frame's stages, and the least time that they can take.

    Each input is read once and each result is written once. Colours are read only of splats in
    view. What a sort moves on top, and records that several tiles read again, are the cost of an
    implementation and do not count.

    Args:
        parts: The splats of the scene with their poses.
        camera: The camera of the frame.
        images: The frame, drawn.
        ceilings: The GPU's highest speeds.

    Returns:
        Figures: bytes of all and of each stage, milliseconds of each stage and of the frame, and
        numbers of splats, of pairs of splats and tiles, and of blends (`count_blends`).
    """
    splats = project(gather_inputs(parts, camera, SETTINGS, None, None, with_color=True))
    tiles = list_tiles(splats, camera, None)
    blend_counts = count_blends(splats, tiles, camera, SETTINGS)
    num_splats = len(splats.keys)
    num_visible = int((splats.counts > 0).sum())
    record_bytes = splats.records.shape[1] * 4
    # Of all splats the means, scales and opacities; of splats in view the quaternions, too.
    geometry_bytes = num_splats * 4 * (3 + 3 + 1) + num_visible * 4 * 4
    color_bytes = sum(12 * part.gaussians.sh.shape[1] * len(part.gaussians) for part in parts)
    key_bytes = 2 * 4 * num_splats  # The key of depth, and the number of tiles.
    image_bytes = sum(image.nbytes for image in vars(images).values() if image is not None)
    stage_bytes = {
        "project": geometry_bytes
        + color_bytes * num_visible // num_splats
        + key_bytes
        + num_visible * (record_bytes + 8),
        "list": key_bytes
        + num_visible * 8
        + 4 * len(tiles.tile_splat_ids)
        + 4 * len(tiles.tile_offsets),
        "blend": 4 * blend_counts["entries"] + blend_counts["used"] * record_bytes + image_bytes,
    }
    stage_ms = {
        stage: ceilings.ms(num_bytes, blend_counts["done"] if stage == "blend" else 0)
        for stage, num_bytes in stage_bytes.items()
    }
    return {
        "bytes": sum(stage_bytes.values()),
        "bytes_of": stage_bytes,
        "ms": {**stage_ms, "frame": sum(stage_ms.values())},
        "splats": num_splats,
        "visible": num_visible,
        "pairs": len(tiles.tile_splat_ids),
        **blend_counts,
    }


def count_blends(
    splats: CudaSplats, tiles: CudaTiles, camera: Camera, settings: RasterSettings
) -> dict[str, int]:
    """Count the blends of a frame, tile by tile, in plain Torch.

    Args:
        splats: The projected splats.
        tiles: The lists of splats of all tiles.
        camera: The camera of the frame.
        settings: The rasteriser's settings, with the transmittance at which a pixel is finished.

    Returns:
        Numbers by name.
        done: pairs of a pixel and a splat that are blended, as the image's definition asks.
        listed: pairs of a pixel and a splat in the tiles' lists.
        reached: the listed pairs up to where all pixels of their tile are finished.
        entries: entries of lists that are reached.
        used: splats that are in a reached entry.
    """
    stop = settings.transmittance_stop
    device = splats.records.device
    used = torch.zeros(len(splats.records), dtype=torch.bool, device=device)
    totals = torch.zeros(4, dtype=torch.int64, device=device)
    offsets = tiles.tile_offsets.tolist()
    for tile, (first, last) in enumerate(itertools.pairwise(offsets)):
        # Pixel centres of the tile.
        left = TILE * (tile % tiles.columns)
        top = TILE * (tile // tiles.columns)
        x, y = (
            torch.arange(low, min(low + TILE, end), device=device) + 0.5
            for low, end in ((left, camera.width), (top, camera.height))
        )
        y, x = (grid.reshape(-1) for grid in torch.meshgrid(y, x, indexing="ij"))
        # Alpha of every entry of the list at every pixel.
        ids = tiles.tile_splat_ids[first:last].long()
        splat = splats.records[ids].T[..., None]  # [fields, entries, 1]
        dx = x - splat[MEAN_X]
        dy = y - splat[MEAN_Y]
        bend = splat[SHARP_X] * (dx - splat[LEAN_X] * dy)
        log_alpha = splat[LOG_OPACITY] - bend * bend - splat[FALL_Y] * dy * dy
        alpha = log_alpha.exp2().clamp(max=settings.alpha_max)
        alpha = alpha.where(log_alpha >= math.log2(ALPHA_MIN), 0)
        if splats.cuts is not None:
            cut = splats.cuts[ids].T[..., None]
            alpha = alpha * (cut[C_VALUE] + cut[C_X] * dx + cut[C_Y] * dy).clamp(0, 1)
        # Transmittance behind and in front of every entry.
        after = (1 - alpha).cumprod(0)
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        is_blended = (alpha > 0) & (before > stop) & (after > min(stop, TRANSMITTANCE_STOP))
        is_reached = (before > stop).any(1)
        used[ids[is_reached]] = True
        counts = (is_blended.sum(), alpha.numel(), is_reached.sum() * len(x), is_reached.sum())
        totals += torch.stack([torch.as_tensor(count, device=device) for count in counts])
    names = ("done", "listed", "reached", "entries")
    return {**dict(zip(names, totals.tolist(), strict=True)), "used": int(used.sum())}


# ---- the rasteriser on the random scene ---------------------------------------------------------


def draw(
    parts: list[PosedGaussians], camera: Camera, fog: Fog | None = None, timer: Any = None
) -> RenderOutput:
    """Draw a frame of posed splats on the GPU, in smog where `fog` is given."""
    return rasterize_cuda(parts, camera, BUFFERS, SETTINGS, fog, timer=timer)


def measure_raster(case: RasterCase, timing: Timing, ceilings: Ceilings) -> Figures:
    """Measure a frame of the random scene on the GPU: times, stages, memory and floor.

    Times are milliseconds on the GPU, from the call's first work to the finished images in its
    memory. Our frames take turns with gsplat's where gsplat can be run.

    Args:
        case: The random scene and the size of its image.
        timing: How often and by which clock frames are timed.
        ceilings: The GPU's highest speeds, for the floor.
    """
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    frames = {"clean": lambda: draw(parts, camera), "smog": lambda: draw(parts, camera, FOG)}
    # Stages are timed in separate frames, since their timer costs time.
    timed_stages = []
    for _ in range(timing.warm_up + timing.repeats):
        timer = CudaStageTimer()
        draw(parts, camera, timer=timer)
        timed_stages.append(timer.milliseconds())
    # Memory is measured before gsplat's copy of the scene lies on the GPU, too.
    peak, extra = peak_gpu_mib(frames["clean"])
    first, second = ([getattr(draw(parts, camera), n).cpu() for n in sorted(BUFFERS)] for _ in "ab")
    draws = gsplat_draws(gaussians, camera)
    gsplat_frames = {} if isinstance(draws, str) else draws
    seconds = timing.rounds({**frames, **gsplat_frames})
    gsplat = {"left_out": draws}
    if gsplat_frames:
        fastest = min(gsplat_frames, key=lambda name: statistics.median(seconds[name]))
        ratio = spread_ratio(seconds["clean"], seconds[fastest])
        rgb = image_difference(draw(parts, camera).rgb, gsplat_frames[fastest]())
        gsplat = {"way": fastest, "ratio": ratio, "rgb": rgb}
    return {
        "case": case.name,
        "scene_mib": gaussians.nbytes / 2**20,
        "peak_mib": peak,
        "frame_mib": extra,
        "stages_ms": {
            stage: spread([stage_ms[stage] for stage_ms in timed_stages[timing.warm_up :]])
            for stage in STAGES
        },
        "same_bits": all(map(torch.equal, first, second)),
        "floor": frame_floor(parts, camera, draw(parts, camera), ceilings),
        "ms": {name: spread_ms(times) for name, times in seconds.items()},
        "smog_over_clean": spread_ratio(seconds["smog"], seconds["clean"]),
        "gsplat": gsplat,
    }


def gsplat_draws(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Tensor]] | str:
    """Return functions that draw the scene's rgb with gsplat, by name; or why there is none.

    Each function has been called once: the first call compiles kernels where gsplat was installed
    without them.
    """
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed (pip install 'climategs[gsplat]')"
    try:
        draws = {
            f"gsplat, {mode}": _gsplat_draw(gaussians, camera, mode == "packed")
            for mode in ("packed", "unpacked")
        }
        for draw_once in draws.values():
            draw_once()
    except Exception as error:  # gsplat's code may raise any type.
        return f"gsplat failed: {type(error).__name__}: {error}"
    return draws


def _gsplat_draw(gaussians: Gaussians, camera: Camera, packed: bool) -> Callable[[], Tensor]:
    """Return a function that draws the scene's rgb with gsplat. packed: gsplat's option."""
    from gsplat import rasterization  # type: ignore[import-not-found]

    device = gpu_device()
    # Fields of Gaussians by gsplat's argument.
    tensor_fields = {
        "means": "means",
        "quats": "quats",
        "scales": "scales",
        "opacities": "opacities",
        "colors": "sh",
    }
    arguments = {
        **{
            k: getattr(gaussians, v).detach().contiguous().to(device)
            for k, v in tensor_fields.items()
        },
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
    """Return the recipes of the timed frames by name.

    They draw pictures only, with default settings or those of a tier. The balanced flood is the
    reference's flood, with its mirrored reflection, except for the settings that the tier lowers.
    The fast tier of snow lights snow per splat.

    Args:
        cell_m: Edge of the cells of the snow, metres.
    """
    flood = {**WATER, "waves": {"preset": "calm"}}
    snow = {"depth_m": 0.1, "cell_m": cell_m}
    overcast = {"style": {"preset": "overcast"}}
    weather = {
        "smog": {"visibility_m": 400.0, "scale_height_m": 120.0},
        "flood": {"level_m": 0.15, "turbidity_ntu": 20.0},
        "snow": snow,
    }
    floods = {
        name: recipe_of({"flood": {**flood, "reflection": name}})
        for name in ("mirrored", "screen_space")
    }
    return {
        "clean": CLEAN,
        "smog": recipe_of({"smog": {"visibility_m": 200}}),
        "flood balanced": with_balanced_tier(floods["mirrored"]),
        "flood balanced, screen space": with_balanced_tier(
            floods["screen_space"], "weather.flood.reflection"
        ),
        "snow fast tier": recipe_of({"snow": {**snow, "shading": "per_splat"}}),
        "snow per pixel": recipe_of({"snow": {**snow, "shading": "per_pixel"}}),
        "style": recipe_of(overcast),
        "all at once, balanced": with_balanced_tier(recipe_of({**weather, **overcast})),
    }


def with_balanced_tier(recipe: Recipe, *excluded_paths: str) -> Recipe:
    """Return the recipe with the settings of `quality: balanced`.

    The tier also replaces settings that the recipe gives.

    Args:
        recipe: The recipe.
        excluded_paths: Dotted paths of settings that keep the recipe's value.
    """
    tier = TIERS["balanced"]
    knobs = (
        knob for knob in knobs_of(recipe) if knob.is_selectable and knob.path not in excluded_paths
    )
    return with_settings(recipe, {knob.path: tier.get(knob.path, knob.reference) for knob in knobs})


def measure_frames(
    scene: Scene, camera: Camera, recipes: Mapping[str, Recipe], timing: Timing
) -> Figures:
    """Measure every recipe's frame of a scene on the GPU; the recipes take turns.

    Args:
        scene: The scene.
        camera: The camera of the frames.
        recipes: Recipes by name; "clean" is the one that others are compared with.
        timing: How often and by which clock frames are timed.

    Returns:
        Figures; of each frame "ms" (on the GPU, to finished floats in its memory), "delivered"
        (8-bit pictures on the host, see `_delivered`), memory, and whether two frames are equal.
    """
    rows: dict[str, Figures] = {}
    # Every recipe gets a copy of the scene, since a scene caches what effects place in it.
    scenes = {name: dataclasses.replace(scene) for name in recipes}
    actions = {n: frame_of(scenes[n], camera, recipe, BACKEND) for n, recipe in recipes.items()}
    # The first frames run one after the other, so that no other recipe's snow counts as memory.
    for name, frame in actions.items():
        frame()  # This compiles kernels, copies the scene and places what stays with it.
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
    """Milliseconds of the host's clock until an 8-bit picture is in the host's memory.

    Returns:
        Figures: "ms" of a single view, and "row_ms" of a view in a sequence in which the next view
        is begun before the last one is waited for.
    """
    view = functools.partial(render_view, scene, camera, recipe, backend=BACKEND)
    single_ms = spread_ms(timing.rounds({"": view}, WallClock())[""])
    start = time.perf_counter()
    pending = begin_view(scene, camera, recipe, backend=BACKEND)
    for _ in range(timing.repeats):
        following = begin_view(scene, camera, recipe, backend=BACKEND)
        pending.result()
        pending = following
    pending.result()
    return {"ms": single_ms, "row_ms": 1e3 * (time.perf_counter() - start) / (timing.repeats + 1)}


def measure_passes(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """Measure every pass of a recipe's frame on both backends, waiting for each; milliseconds."""
    recipe_passes: Figures = {}
    for name, recipe in recipes.items():
        scene_copy = dataclasses.replace(scene)
        recipe_passes[name] = {}
        for backend in (BACKEND, CPU):
            _, stages = time_frames(scene_copy, camera, {"": recipe}, NUM_PASSES, backend)
            recipe_passes[name][backend] = stages[""]
    return {"passes": recipe_passes}


# ---- what a frame launches ----------------------------------------------------------------------

# The first letters of torch operations that compute nothing: they reserve memory or read a number.
IDLE_OPERATIONS = ("empty", "new_empty", "_local_scalar_dense")


class TorchOps(TorchDispatchMode):
    """Counts torch operations that start a kernel on a GPU: all but views and IDLE_OPERATIONS."""

    count = 0
    """The number of operations so far."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        is_view = any(r.alias_info and not r.alias_info.is_write for r in func._schema.returns)
        self.count += not (is_view or func.__name__.startswith(IDLE_OPERATIONS))
        return func(*args, **(kwargs or {}))


@contextmanager
def interpreted_kernels() -> Iterator[list[float]]:
    """Yield a list that receives the seconds of every Triton kernel that is interpreted inside.

    Torch operations of the interpreter itself are not counted by TorchOps.
    """
    from triton.runtime.interpreter import GridExecutor

    run = GridExecutor.__call__
    seconds = []

    def timed_run(*arguments: Any, **options: Any) -> None:
        start = time.perf_counter()
        with _disable_current_modes():
            run(*arguments, **options)
        seconds.append(time.perf_counter() - start)

    GridExecutor.__call__ = timed_run
    try:
        yield seconds
    finally:
        GridExecutor.__call__ = run


def count_launches(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """Count the operations that a frame starts on a GPU, with interpreted kernels and no GPU.

    Args:
        scene: The scene.
        camera: The camera. Its picture must be so small that an operation takes no longer than its
            start.
        recipes: Recipes by name.

    Returns:
        Figures; of each frame to finished floats "torch" (torch's operations) and "triton"
        (Triton's kernels), which do not depend on sizes, and "host_ms" (milliseconds of everything
        but the kernels).
    """
    launches: Figures = {}
    for name, recipe in recipes.items():
        scene_copy = dataclasses.replace(scene)
        frame_of(scene_copy, camera, recipe, CPU)()  # This places what stays with the scene.
        frame = frame_of(scene_copy, camera, recipe, BACKEND)
        frame()
        with interpreted_kernels() as kernels:
            start = time.perf_counter()
            frame()
            host_s = time.perf_counter() - start - sum(kernels)
        with interpreted_kernels() as kernels, TorchOps() as ops:
            frame()
        launches[name] = {"torch": ops.count, "triton": len(kernels), "host_ms": 1e3 * host_s}
    return {"launches": launches}


def interpreted_street() -> tuple[Scene, Camera]:
    """Return a scene so small that kernels can be interpreted, and a camera of 24 x 16 pixels.

    The scene has a road and a wall of few splats, with the frames and the sky of the street.
    """
    x, y = np.meshgrid(np.arange(3.0, 13.0, 2), np.arange(-4.0, 5.0, 2))
    road = np.stack([x, y, 0 * x], -1)
    wall = np.stack([0 * x + 13, y, (x - 3) / 2], -1)
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
    """Measure the fold of one colour map into the SH of random Gaussians of degree 3, on the GPU.

    Args:
        case: The random scene.
        timing: How often and by which clock the fold is timed.
        ceilings: The GPU's highest speeds, for the floor.
    """
    host_gaussians, _ = random_scene(case)
    fields = {f.name: getattr(host_gaussians, f.name) for f in dataclasses.fields(host_gaussians)}
    tensors = {k: v.to(gpu_device()) for k, v in fields.items() if isinstance(v, Tensor)}
    gaussians = dataclasses.replace(host_gaussians, **tensors)
    out = torch.empty_like(gaussians.sh)
    action = fold(gaussians, 1, out, BACKEND)
    action()
    floor = {"bytes": 2 * out.nbytes, "ms": {"frame": ceilings.ms(2 * out.nbytes)}}
    ms = spread_ms(timing.rounds({"fold": action})["fold"])
    return {"gaussians": len(gaussians), "ms": ms, "floor": floor}


def measure_placement(scene: Scene, uri: str, cell_m: float = 0.05) -> Figures:
    """Measure the search for places where snow can lie, for all cameras, by the host's clock.

    Args:
        scene: The scene.
        uri: The address of the scene, for the report.
        cell_m: Edge of the cells of the snow, metres.
    """
    place = placement(scene, cell_m, BACKEND)
    return {
        "scene": scene.name,
        "uri": uri,
        "gaussians": len(scene.background) + sum(len(a.gaussians) for a in scene.actors),
        "cameras": len(all_cameras(scene)),
        "cells": len(place().ground),
        "place_s": spread(rounds({"place": place}, NUM_PLACEMENTS)["place"]),
        "peak_mib": peak_gpu_mib(place)[0],
    }


@torch.no_grad()
def raster_agreement(case: RasterCase) -> Figures:
    """Compare the GPU's colours of the random scene with the CPU backend's, clean and in smog."""
    from augment.render.cpu.driver import rasterize_cpu

    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    differences = {}
    for name, fog in (("clean", None), ("smog", FOG)):
        expected = rasterize_cpu(parts, camera, BUFFERS, SETTINGS, fog).rgb
        differences[name] = image_difference(draw(parts, camera, fog).rgb, expected)
    return differences


def frame_agreement(scene: Scene, camera: Camera, recipes: Mapping[str, Recipe]) -> Figures:
    """Compare the GPU's colours of every recipe's frame with the CPU backend's.

    Both backends use the same places of snow: the scene caches them for the second.
    """
    differences = {}
    for name, recipe in recipes.items():
        scene_copy = dataclasses.replace(scene)
        images = [frame_of(scene_copy, camera, recipe, backend)().rgb for backend in (BACKEND, CPU)]
        differences[name] = image_difference(*images)
    return differences


# ---- sections -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class GpuCase:
    """The scenes and sizes that the sections measure."""

    raster: RasterCase = LARGE_CASE
    """The random scene of the rasteriser."""
    street: str = street_uri(gaussians=1_000_000)
    """The address of the scene of the weathered frames."""
    width: int = 1600
    """The width of the weathered frames, pixels."""
    height: int = 1066
    """The height of the weathered frames, pixels."""
    placement: tuple[str, ...] = ()
    """The addresses of scenes in which snow is placed, besides the street."""
    cell_m: float = 0.05
    """The edge of the cells of the snow, metres."""
    load: Mapping[str, int] = field(default_factory=dict)
    """Keyword arguments of `measure_ceilings`: the size of its load."""

    def open_street(self) -> tuple[Scene, Camera]:
        """Return the street and the camera of the weathered frames."""
        scene = open_scene(self.street)
        return scene, water_camera(scene, self.width, self.height, BACKEND)


FULL_CASE = GpuCase()  # The case of published figures.
QUICK_CASE = GpuCase(SMALL_CASE, street_uri(), width=640, height=426)  # The case of `--quick`.
CEILINGS = "ceilings"  # The section that measures the GPU's highest speeds.
LAUNCHES = "launches"  # The section that needs no GPU.
# The names of all sections, in the order in which they run.
SECTIONS = (CEILINGS, "raster", "style", "frames", "passes", "placement", "agreement", LAUNCHES)


def run_section(name: str, case: GpuCase, timing: Timing, ceilings: Ceilings | None) -> Figures:
    """Measure one section.

    Args:
        name: One of SECTIONS.
        case: The scenes and sizes.
        timing: How often and by which clock actions are timed.
        ceilings: The GPU's highest speeds; None for the sections CEILINGS and LAUNCHES.
    """
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
    placements = [measure_placement(open_scene(uri), uri, case.cell_m) for uri in uris]
    return {"scenes": [{**entry, "named": entry["uri"] != case.street} for entry in placements]}


def measure(
    case: GpuCase = FULL_CASE,
    sections: Sequence[str] = SECTIONS,
    timing: Timing | None = None,
    minutes: float = 9.0,
    json_file: Path | None = None,
    in_processes: bool = True,
) -> Figures:
    """Measure sections of the GPU bench and return their figures.

    Args:
        case: The scenes and sizes.
        sections: Names out of SECTIONS.
        timing: How often and by which clock actions are timed; None for the default.
        minutes: The time after which no further section begins and a running one is stopped.
        json_file: The file that receives the figures after every section.
        in_processes: True if each section runs in its own process.

    Raises:
        ValueError: `sections` has an unknown name.
    """
    unknown = sorted(set(sections) - set(SECTIONS))
    if unknown:
        raise ValueError(f"sections are {', '.join(SECTIONS)}; got {', '.join(unknown)}")
    timing = timing or Timing()
    start = time.perf_counter()
    machine = machine_facts()
    facts: Figures = {name: {"left_out": "not asked for"} for name in SECTIONS}
    # All sections but LAUNCHES need the ceilings for their floors.
    requested = {*sections, *([] if set(sections) == {LAUNCHES} else [CEILINGS])}
    ceilings: Ceilings | None = None
    for name in (name for name in SECTIONS if name in requested):
        if name not in (CEILINGS, LAUNCHES) and ceilings is None:
            facts[name] = {"left_out": "the GPU's ceilings could not be measured"}
            continue
        left_s = 60 * minutes - (time.perf_counter() - start)
        work = (run_section, (name, case, timing, ceilings))
        with mock.patch.dict(os.environ, {"TRITON_INTERPRET": "1"} if name == LAUNCHES else {}):
            facts[name] = run_in_subprocess(*work, left_s) if in_processes else run_and_time(*work)
        if "bytes_per_s" in facts[name]:
            ceilings = Ceilings(facts[name]["bytes_per_s"], facts[name]["blends_per_s"])
        write_json(json_file, gpu_figures(facts, timing, machine), say=False)
    return gpu_figures(facts, timing, machine)


# ---- figures to reach, and tables ---------------------------------------------------------------


class Target(NamedTuple):
    """A figure that the backend must reach on one H200."""

    title: str
    """The words of the table's row."""
    unit: str
    """The symbol of the unit; empty for a pure number."""
    limit: float
    """The largest value that meets the target, in the unit."""
    section: str
    """The name of the section that measures the figure."""
    value: Callable[[Figures], Any]
    """A function from the section's facts to the figure, a spread or a number. It raises _Missing
    if the figure was not measured.
    """
    has_floor: bool = False
    """True if the section's facts have a floor of the figure."""


class _Missing(Exception):
    """Raised with the reason why a figure was not measured."""


def _gsplat_ratio(raster: Figures) -> Figures:
    """Return the time of our clean frame over gsplat's, from facts of the section "raster"."""
    if "left_out" in raster["gsplat"]:
        raise _Missing(raster["gsplat"]["left_out"])
    return raster["gsplat"]["ratio"]


def _slowest_named(placement: Figures) -> Figures:
    """Return the seconds of the slowest scene that the caller named; the street does not count."""
    spreads = [entry["place_s"] for entry in placement["scenes"] if entry["named"]]
    if not spreads:
        raise _Missing("no scene was named with --placement")
    return max(spreads, key=lambda seconds: seconds["median"])


def _max_gigabytes(*peaks: float | None) -> float:
    """Return the largest of peaks in MiB as gigabytes."""
    measured_mib = [mib for mib in peaks if mib is not None]
    if len(measured_mib) < len(peaks):
        raise _Missing("no GPU memory was measured")
    return max(measured_mib) * 2**20 / 1e9


def _max_p999(errors: Figures) -> float:
    """Return the largest 99.9th percentile of several image differences."""
    return max(difference["p999"] for difference in errors.values())


# The figures to reach, in the order of the table.
TARGETS = (
    Target("clean frame", "ms", 3.0, "raster", lambda f: f["ms"]["clean"], has_floor=True),
    Target("smog in splats, over clean", "x", 1.1, "raster", lambda f: f["smog_over_clean"]),
    Target(
        "street: smog, over clean", "x", 1.1, "frames", lambda f: f["frames"]["smog"]["over_clean"]
    ),
    Target(
        "street: flood balanced", "ms", 6.0, "frames", lambda f: f["frames"]["flood balanced"]["ms"]
    ),
    Target(
        "street: snow fast tier, over clean",
        "x",
        1.3,
        "frames",
        lambda f: f["frames"]["snow fast tier"]["over_clean"],
    ),
    Target(
        "street: most memory of any frame and its scene",
        "GB",
        2.0,
        "frames",
        lambda f: _max_gigabytes(*(row["peak_mib"] for row in f["frames"].values())),
    ),
    Target(
        "street: rgb off the CPU backend's, 99.9 %, worst frame",
        "",
        1e-3,
        "agreement",
        lambda f: _max_p999(f["frames"]),
    ),
    Target(
        "style: fold and apply to all SH", "ms", 1.0, "style", lambda f: f["ms"], has_floor=True
    ),
    Target("placement of snow, PandaSet", "s", 1.0, "placement", _slowest_named),
    Target(
        "memory of the clean frame and its scene",
        "GB",
        2.0,
        "raster",
        lambda f: _max_gigabytes(f["peak_mib"]),
    ),
    Target("clean frame, over gsplat's", "x", 1.3, "raster", _gsplat_ratio),
    Target(
        "rgb off the CPU backend's, 99.9 %", "", 1e-3, "agreement", lambda f: _max_p999(f["raster"])
    ),
)


def target_row(target: Target, section_facts: Figures) -> tuple[Cell, ...]:
    """Return a target's row of the table.

    Args:
        target: The figure to reach.
        section_facts: The facts of every section, by its name.

    Returns:
        Title; median, least and 90th percentile; limit; "met", "MISSED" or why the figure was not
        measured; floor.
    """
    facts = section_facts[target.section]
    limit = f"{target.limit:g} {target.unit}".strip()
    try:
        if why := facts.get("failed") or facts.get("left_out"):
            raise _Missing(why)
        value = target.value(facts)
    except _Missing as why:
        return (target.title, None, None, None, limit, f"not measured: {why}", None)
    row = tuple(value.values()) if isinstance(value, Mapping) else (value, None, None)
    verdict = "met" if row[0] <= target.limit else "MISSED"
    floor = facts["floor"]["ms"]["frame"] if target.has_floor else None
    return (target.title, *row, limit, verdict, floor)


def gpu_figures(section_facts: Figures, timing: Timing, machine: Figures) -> Figures:
    """Return the facts of all sections and their tables in the form of the JSON file."""
    return figures(
        "gpu",
        gpu_tables(section_facts),
        machine=machine,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        gpu=section_facts[CEILINGS].get("gpu"),
        repeats=timing.repeats,
        warm_up=timing.warm_up,
        sections=dict(section_facts),
    )


def gpu_tables(section_facts: Figures) -> list[Table]:
    """Return the tables of all sections that were measured, from the facts by section."""
    ceilings = section_facts[CEILINGS]
    raster = section_facts["raster"]
    frames = section_facts["frames"]
    note = ""
    if "bytes_per_s" in ceilings:
        note = (
            f"at best, measured: {ceilings['bytes_per_s'] / 1e9:.0f} GB/s copied, "
            f"{ceilings['blends_per_s'] / 1e9:.0f} G blends/s"
        )
    columns = ("what", "measured", "min", "p90", "at most", "", "floor")
    tables = [
        Table(
            "Figures to reach",
            columns,
            [target_row(target, section_facts) for target in TARGETS],
            note,
        )
    ]
    if "ms" in raster:
        floor = raster["floor"]
        note = (
            f"{floor['visible']:,} of {floor['splats']:,} splats in view, {floor['used']:,} before "
            f"pixels are finished; {floor['pairs']:,} pairs of splats and tiles, "
            f"{floor['entries']:,} reached; {floor['done']:,} blends, {floor['reached']:,} tried"
        )
        rows = []
        for name, ms in {**raster["stages_ms"], **raster["ms"]}.items():
            floor_ms = floor["ms"].get(name)
            num_bytes = floor["bytes_of"].get(name)
            if name in ("clean", "smog"):
                floor_ms = floor["ms"]["frame"]
                num_bytes = floor["bytes"]
            cells: Sequence[Cell] = (None, None, None, None)
            if floor_ms is not None and (median := ms["median"]):
                cells = (
                    floor_ms,
                    100 * floor_ms / median,
                    num_bytes / 1e6,
                    num_bytes / median / 1e6,
                )
            rows.append((name, *ms.values(), *cells))
        columns = ("stage", "ms", "min", "p90", "floor ms", "% of it", "MB", "GB/s")
        tables.append(Table(f"Rasteriser, {raster['case']}", columns, rows, note))
    if "frames" in frames:
        columns = (
            "frame",
            "ms",
            "min",
            "p90",
            "x clean",
            "8 bits, alone",
            "in a row",
            "MiB",
            "of it frame",
            "same bits",
        )
        rows = []
        for name, row in frames["frames"].items():
            delivered = (row["delivered"]["ms"]["median"], row["delivered"]["row_ms"])
            memory_and_bits = (row["peak_mib"], row["frame_mib"], row["same_bits"])
            rows.append(
                (
                    name,
                    *row["ms"].values(),
                    row["over_clean"]["median"],
                    *delivered,
                    *memory_and_bits,
                )
            )
        title = f"Street, {frames['gaussians']:,} Gaussians, {frames['camera']}"
        tables.append(Table(title, columns, rows))
    if "passes" in section_facts["passes"]:
        rows = [
            (name, stage, ms, backend_ms[CPU].get(stage))
            for name, backend_ms in section_facts["passes"]["passes"].items()
            for stage, ms in backend_ms[BACKEND].items()
            if max(ms, backend_ms[CPU].get(stage, 0)) >= 0.1
        ]
        columns = ("frame", "pass", "GPU ms", "CPU ms")
        tables.append(Table("Passes, each waited for; below 0.1 ms left out", columns, rows))
    if "launches" in section_facts[LAUNCHES]:
        columns = ("frame", "torch operations", "Triton kernels", "host ms")
        rows = [
            (name, *counts.values()) for name, counts in section_facts[LAUNCHES]["launches"].items()
        ]
        note = "host: of all but Triton's launches, on this machine"
        tables.append(Table("What a frame launches on a GPU", columns, rows, note))
    if "scenes" in section_facts["placement"]:
        columns = ("scene", "Gaussians", "cameras", "cells", "s", "min", "p90")
        keys = ("scene", "gaussians", "cameras", "cells")
        rows = [
            (*map(entry.get, keys), *entry["place_s"].values())
            for entry in section_facts["placement"]["scenes"]
        ]
        tables.append(Table("Where snow lies, once a scene", columns, rows))
    if "frames" in section_facts["agreement"]:
        agreement = section_facts["agreement"]
        differences = {f"random scene, {n}": e for n, e in agreement["raster"].items()}
        differences |= {f"street, {n}": e for n, e in agreement["frames"].items()}
        columns = ("rgb off the CPU backend's", "99.9 %", "max", "off by > 0.001", "pixels")
        tables.append(
            Table("Agreement", columns, [(n, *e.values()) for n, e in differences.items()])
        )
    return tables


def write_table(path: Path, result: Figures) -> None:
    """Write the tables as Markdown between the markers of a document.

    Args:
        path: The document. If it is missing or has no markers, it is written anew.
        result: The figures of `measure`.
    """
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    page = text if START_MARKER in text else f"{START_MARKER}\n{END_MARKER}\n"
    path.write_text(
        replace_marked(page, START_MARKER, END_MARKER, markdown(result)), encoding="utf-8"
    )
