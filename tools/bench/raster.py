"""`climategs bench raster`: the CPU rasteriser on random scenes.

`measure` times each stage of a frame, smog, memory, blends a second, and the torch reference.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch
from numba import prange

from augment.render.buffers import ALPHA, RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cpu import simd as v8
from augment.render.cpu.driver import rasterize_cpu, warm_up
from augment.render.cpu.jit import kernel
from augment.render.fog import Fog
from augment.render.reference import bin_to_tiles, project_parts, rasterize_reference
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    image_difference,
    machine_facts,
    median_ms,
    peak_mib_in_subprocess,
    rounds,
    spread_ms,
    spread_ratio,
)
from tools.bench.scenes import LARGE_CASE, SMALL_CASE, RasterCase, random_scene

STAGES = ("project", "sort", "bin", "raster")  # The stages of a frame, in their order.
BUFFERS = frozenset({RGB, ALPHA})  # The buffers that are drawn.
SETTINGS = RasterSettings()  # The rasteriser's settings, those of the reference image.
FOG = Fog(extinction_per_m=0.03, airlight_rgb=(0.7, 0.72, 0.75))  # The fog of frames with smog.
# The columns of the table of a frame's work.
COLUMNS = (
    "scene",
    "smog / clear",
    "splats used",
    "pairs",
    "pairs listed",
    "M pairs/s",
    "scene MiB",
    "frame MiB",
)
# The columns of the comparison with the torch reference.
REFERENCE_COLUMNS = (
    "reference ms",
    "cpu ms",
    "speed-up",
    "99.9 % within",
    "max",
    "flipped",
    "pixels",
)
# The columns of the table of blends.
BLEND_COLUMNS = (
    "lanes",
    "M blends/s",
    "M multiply-adds/s",
    "multiply-adds a blend",
    "instructions a blend",
    "share of the machine",
)
# The number of instructions that blend one register of pixels, without loads and stores, by the
# number of lanes of a register. All pixels of the register are blended.
BLEND_INSTRUCTIONS = {16: 20, 8: 23}
SHEETS = 400  # The number of splats that cover the whole image, for blends a second.
SHEETS_SIZE = (640, 480)  # The width and height of that image, pixels.
FMA_ROUNDS = 1 << 21  # The number of rounds of multiply-adds.
# The scene of the torch reference, which it draws within a second.
REFERENCE_CASE = RasterCase(5_000, 320, 240)


@dataclass(frozen=True)
class RasterCases:
    """The random scenes that are measured."""

    scenes: Sequence[RasterCase] = (SMALL_CASE, LARGE_CASE)
    """The scenes of timed frames."""
    reference: RasterCase = REFERENCE_CASE
    """The scene that is also drawn by the torch reference."""
    memory: bool = True
    """True if memory is measured."""


FULL_CASE = RasterCases()  # The case of published figures.
QUICK_CASE = RasterCases((SMALL_CASE,))  # The case of `--quick`.


def measure(quick: bool = False, repeats: int = 7, cases: RasterCases | None = None) -> Figures:
    """Measure the CPU rasteriser.

    Args:
        quick: True for QUICK_CASE.
        repeats: The number of timed rounds, of a clear frame and one with smog, for every scene.
        cases: The scenes; None for FULL_CASE or QUICK_CASE.
    """
    machine = machine_facts()
    cases = cases or (QUICK_CASE if quick else FULL_CASE)
    warm_up_s = warm_up()
    stages = []
    work = []
    facts = []
    for case in cases.scenes:
        case_result = _measure(case, repeats, cases.memory)
        facts.append(case_result)
        timed = {
            **case_result["stages_ms"],
            "frame": case_result["ms"],
            "with smog": case_result["smog_ms"],
        }
        stages += [(case.name, name, *ms.values()) for name, ms in timed.items()]
        rate = case_result["pairs"] / case_result["ms"]["median"] / 1e3
        counts = (case_result["visible"], case_result["pairs"], case_result["listed_pairs"], rate)
        memory = (case_result["scene_mib"], case_result["frame_mib"])
        work.append((case.name, case_result["smog_over_clear"]["median"], *counts, *memory))
    beside = _beside_reference(cases.reference, min(repeats, 3))
    blending = _blending(repeats)
    tables = [
        Table("Frames", ("scene", "stage", "ms", "min", "p90"), stages),
        Table("What a frame takes", COLUMNS, work, "pairs: of splats and 16x16 tiles"),
        Table(
            "Blending on one core, of splats that cover the whole image",
            BLEND_COLUMNS,
            [[*blending.values()]],
            "a blend: of one splat on one pixel, with all that its frame takes; multiply-adds a "
            "blend: how many a loop of nothing else does meanwhile",
        ),
        Table(
            f"Beside the torch reference, {cases.reference.name}",
            REFERENCE_COLUMNS,
            [[*beside.values()]],
            "difference of rgb; flipped: pixels off by more than 0.001",
        ),
    ]
    extra = {"warm_up_s": warm_up_s, "cases": facts, "blending": blending, "reference": beside}
    return figures("raster", tables, machine=machine, **extra)


def _measure(case: RasterCase, repeats: int, memory: bool) -> Figures:
    """Measure frames of one random scene.

    Args:
        case: The scene.
        repeats: The number of rounds that count.
        memory: True if memory is measured.

    Returns:
        Figures, among them
        visible: splats that touch a tile which nearer splats have not filled.
        pairs: pairs of a splat and a tile that its box touches.
        listed_pairs: the pairs of tiles that were not filled, which were blended.
    """
    frame_mib = peak_mib_in_subprocess(frame_of, (case,)) if memory else None
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    stages = []

    def clear() -> None:
        stages.append({})
        rasterize_cpu(parts, camera, BUFFERS, SETTINGS, None, stage_times=stages[-1])

    seconds = rounds({"clear": clear, "smog": lambda: _draw(parts, camera, FOG)}, repeats)
    tiles = bin_to_tiles(project_parts(parts, camera, SETTINGS), camera)
    return {
        "case": case.name,
        "stages_ms": {
            name: spread_ms([stage_s[name] for stage_s in stages[1:]]) for name in STAGES
        },
        "ms": spread_ms(seconds["clear"]),
        "smog_ms": spread_ms(seconds["smog"]),
        "smog_over_clear": spread_ratio(seconds["smog"], seconds["clear"]),
        "visible": int(stages[1]["visible"]),
        "pairs": len(tiles.tile_splat_ids),
        "listed_pairs": int(stages[1]["pairs"]),
        "scene_mib": gaussians.nbytes / 2**20,
        "frame_mib": frame_mib,
    }


@kernel
def multiply_add(rounds, sums):
    """Run twelve chains of fused multiply-adds of v8.WIDE lanes, which keep all units busy.

    Args:
        rounds: The number of rounds of twelve multiply-adds.
        sums: [threads * v8.WIDE], float32. Receives the sums, so that no work is left out.
    """
    for run in prange(sums.size // v8.WIDE):
        lane_index = v8.wide_columns()
        half = v8.broadcast_as(lane_index, np.float32(0.5))
        a = lane_index
        b = lane_index
        c = lane_index
        d = lane_index
        e = lane_index
        f = lane_index
        g = lane_index
        h = lane_index
        i = lane_index
        j = lane_index
        k = lane_index
        m = lane_index
        for _ in range(rounds):
            a = v8.fmuladd(a, half, lane_index)
            b = v8.fmuladd(b, half, lane_index)
            c = v8.fmuladd(c, half, lane_index)
            d = v8.fmuladd(d, half, lane_index)
            e = v8.fmuladd(e, half, lane_index)
            f = v8.fmuladd(f, half, lane_index)
            g = v8.fmuladd(g, half, lane_index)
            h = v8.fmuladd(h, half, lane_index)
            i = v8.fmuladd(i, half, lane_index)
            j = v8.fmuladd(j, half, lane_index)
            k = v8.fmuladd(k, half, lane_index)
            m = v8.fmuladd(m, half, lane_index)
        a = a + b + c
        d = d + e + f
        g = g + h + i
        j = j + k + m
        v8.store(sums, np.uint64(run * v8.WIDE), a + d + g + j)


def _blending(repeats: int) -> Figures:
    """Measure blends a second of one core's time, and multiply-adds a second in turn with them."""
    (width, height) = SHEETS_SIZE
    side = float(SHEETS_SIZE[0])
    means = torch.zeros(SHEETS, 3)
    means[:, 2] = torch.linspace(2, 3, SHEETS)
    sheets = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(SHEETS, 1),
        scales=torch.tensor([[50.0, 50.0, 0.01]]).repeat(SHEETS, 1),
        opacities=torch.full((SHEETS,), 0.01),  # All of them together finish no pixel.
        sh=torch.zeros(SHEETS, 1, 3),
    )
    ahead = torch.eye(4, dtype=torch.float64)
    camera = Camera("sheets", width, height, side, side, width / 2, height / 2, ahead)
    sums = np.zeros(v8.WIDE, np.float32)
    seconds = []
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        for _ in range(repeats + 1):
            marks = [time.thread_time()]
            rasterize_cpu([PosedGaussians(sheets)], camera, BUFFERS, SETTINGS, None)
            marks.append(time.thread_time())
            with kernel_threads():
                multiply_add(FMA_ROUNDS, sums)
            marks.append(time.thread_time())
            seconds.append(np.diff(marks))
    finally:
        numba.set_num_threads(before)
    frame_s, compute_s = np.median(seconds[1:], 0).tolist()
    blends = SHEETS * width * height / frame_s
    fmas = 12 * FMA_ROUNDS * v8.WIDE / compute_s
    instructions = BLEND_INSTRUCTIONS[v8.WIDE]
    return {
        "lanes": v8.WIDE,
        "blends_m_per_s": blends / 1e6,
        "multiply_adds_m_per_s": fmas / 1e6,
        "multiply_adds_per_blend": fmas / blends,
        "instructions_per_blend": instructions,
        "share": instructions * blends / fmas,
    }


def _draw(parts: list[PosedGaussians], camera: Camera, fog: Fog | None = None) -> RenderOutput:
    """Draw a frame with the CPU backend, in smog where `fog` is given."""
    return rasterize_cpu(parts, camera, BUFFERS, SETTINGS, fog)


def frame_of(case: RasterCase) -> Action:
    """Return an action that draws a clear frame, with kernels compiled and the scene in memory."""
    warm_up()
    gaussians, camera = random_scene(case)
    return lambda: _draw([PosedGaussians(gaussians)], camera)


@torch.no_grad()
def _beside_reference(case: RasterCase, repeats: int) -> Figures:
    """Compare the torch reference with the CPU backend on one small scene: times and colours."""
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]

    def reference() -> RenderOutput:
        return rasterize_reference(parts, camera, BUFFERS, SETTINGS, None)

    seconds = rounds({"reference": reference, "cpu": lambda: _draw(parts, camera)}, repeats)
    reference_ms = median_ms(seconds["reference"])
    cpu_ms = median_ms(seconds["cpu"])
    times = {"reference_ms": reference_ms, "cpu_ms": cpu_ms, "speed_up": reference_ms / cpu_ms}
    return {**times, **image_difference(_draw(parts, camera).rgb, reference().rgb)}
