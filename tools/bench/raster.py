"""How fast the CPU rasteriser is on random scenes, in time, memory, and beside its definition.

Frames with and without per-Gaussian smog alternate, so that what the machine does meanwhile falls
on both, and their ratio is taken pair by pair.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from augment.cameras import Camera
from augment.effects.smog import SmogMedium
from augment.render.buffers import ALPHA, RGB
from augment.render.constants import RasterSettings
from augment.render.cpu.driver import rasterize_cpu, warm_up
from augment.render.reference import bin_to_tiles, project_parts, rasterize_reference
from augment.scene import PosedGaussians
from tools.bench_memory import peak_extra_mib
from tools.bench_scene import DEFAULT_CASES, RasterCase, random_scene
from tools.machine import MachineFacts, load_average, machine_facts

STAGES = ("project", "sort", "bin", "raster")
BUFFERS = frozenset({RGB, ALPHA})
SETTINGS = RasterSettings()
SMOG = SmogMedium(sigma_per_m=0.03, rgb=(0.7, 0.72, 0.75))
SMALL = RasterCase(5_000, 320, 240)  # what the torch reference draws within a second
FLIP = 1e-3  # a pixel off by more lies on the other side of a cut-off


@dataclass(frozen=True)
class Spread:
    """Of repeated measurements: the least, the median, and what nine of ten stay below."""

    min: float
    median: float
    p90: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        low, middle, high = np.quantile(values, [0, 0.5, 0.9])
        return Spread(float(low), float(middle), float(high))


@dataclass(frozen=True)
class CaseFigures:
    """One scene. *_ms: milliseconds; frame_ms is timed as a whole, from call to images.

    visible: splats that touch a tile which nearer ones have not filled. pairs: of splats and 16x16
    tiles that their boxes touch, filled or not: the work the scene poses to any rasteriser.
    listed_pairs: those of open tiles (of the kernel's own shape) that were in fact blended.
    pairs_per_s: pairs over the median frame. smog_over_clear: ratio of paired frames.
    peak_extra_mib: memory of one frame above its scene; None where the system cannot tell.
    """

    case: str
    repeats: int
    stages_ms: dict[str, Spread]
    frame_ms: Spread
    smog_frame_ms: Spread
    smog_over_clear: Spread
    visible: int
    pairs: int
    listed_pairs: int
    pairs_per_s: float
    scene_mib: float
    peak_extra_mib: float | None


@dataclass(frozen=True)
class ReferenceFigures:
    """The torch reference and the CPU backend on one small scene, float32; differences of rgb."""

    case: str
    reference_ms: Spread
    cpu_ms: Spread
    speed_up: float
    p999_difference: float
    max_difference: float
    flipped_pixels: int
    pixels: int


@dataclass(frozen=True)
class BenchFigures:
    """Everything `bench_raster` measured. warm_up_s: compiling or loading the kernels, once."""

    machine: MachineFacts
    warm_up_s: float
    cases: tuple[CaseFigures, ...]
    reference: ReferenceFigures
    load_after: float | None


def bench_raster(
    cases: Sequence[RasterCase] = DEFAULT_CASES,
    *,
    repeats: int = 7,
    quick: bool = False,
    memory: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """Measure the CPU backend; the figures of BenchFigures as plain numbers for JSON.

    repeats: timed pairs of frames a scene, after one that is not counted. quick: the first case
    only. memory: also start a process a case that measures peak memory.
    """
    if repeats < 1 or not cases:
        raise ValueError(f"need repeats >= 1 and a case; got repeats={repeats}, cases={cases}")
    cases = cases[:1] if quick else cases
    machine = machine_facts()
    warm_up_s = warm_up()
    with tqdm(total=len(cases) * (repeats + 1), unit="pair", disable=not progress) as bar:
        figures = tuple(_measure_case(case, repeats, memory, bar) for case in cases)
    reference = _measure_reference(SMALL, min(repeats, 3))
    report = BenchFigures(machine, warm_up_s, figures, reference, load_average())
    return dataclasses.asdict(report)


def _measure_case(case: RasterCase, repeats: int, memory: bool, bar: tqdm) -> CaseFigures:
    bar.set_description(case.name)
    extra = peak_extra_mib(case) if memory else None
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    stages: list[dict[str, float]] = []
    clear, smog = [], []
    for repeat in range(repeats + 1):
        times: dict[str, float] = {}
        turns = [(None, clear, times), (SMOG, smog, None)]
        for medium, seconds, stage_times in turns if repeat % 2 else reversed(turns):
            seconds.append(_time_frame(parts, camera, medium, stage_times))
        stages.append(times)
        bar.update()
    stages, clear, smog = stages[1:], clear[1:], smog[1:]  # the first touched new memory
    pairs = len(bin_to_tiles(project_parts(parts, camera, SETTINGS), camera).members)
    frame_ms = Spread.of([1e3 * seconds for seconds in clear])
    return CaseFigures(
        case=case.name,
        repeats=repeats,
        stages_ms={name: Spread.of([1e3 * t[name] for t in stages]) for name in STAGES},
        frame_ms=frame_ms,
        smog_frame_ms=Spread.of([1e3 * seconds for seconds in smog]),
        smog_over_clear=Spread.of([s / c for s, c in zip(smog, clear, strict=True)]),
        visible=int(stages[0]["visible"]),
        pairs=pairs,
        listed_pairs=int(stages[0]["pairs"]),
        pairs_per_s=pairs / (frame_ms.median / 1e3),
        scene_mib=gaussians.nbytes / 2**20,
        peak_extra_mib=extra,
    )


def _time_frame(
    parts: list[PosedGaussians],
    camera: Camera,
    smog: SmogMedium | None,
    stage_times: dict[str, float] | None,
) -> float:
    start = time.perf_counter()
    rasterize_cpu(parts, camera, BUFFERS, SETTINGS, smog, stage_times=stage_times)
    return time.perf_counter() - start


@torch.no_grad()
def _measure_reference(case: RasterCase, repeats: int) -> ReferenceFigures:
    gaussians, camera = random_scene(case)
    parts = [PosedGaussians(gaussians)]
    cpu, reference = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        expected = rasterize_reference(parts, camera, BUFFERS, SETTINGS, None)
        reference.append(time.perf_counter() - start)
        cpu.append(_time_frame(parts, camera, None, None))
    actual = rasterize_cpu(parts, camera, BUFFERS, SETTINGS, None)
    assert actual.rgb is not None and expected.rgb is not None
    error = (actual.rgb - expected.rgb).abs().amax(-1).numpy()
    reference_ms = Spread.of([1e3 * seconds for seconds in reference[1:]])
    cpu_ms = Spread.of([1e3 * seconds for seconds in cpu[1:]])
    return ReferenceFigures(
        case=case.name,
        reference_ms=reference_ms,
        cpu_ms=cpu_ms,
        speed_up=reference_ms.median / cpu_ms.median,
        p999_difference=float(np.quantile(error, 0.999)),
        max_difference=float(error.max()),
        flipped_pixels=int((error > FLIP).sum()),
        pixels=error.size,
    )


def bench_text(figures: dict[str, Any]) -> str:
    """The figures as a table for people: medians, with the least and the 90th percentile."""
    machine, reference = figures["machine"], figures["reference"]
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    lines = [
        f"{machine['processor']}, {machine['cores']} cores ({', '.join(machine['simd'])}), "
        f"{machine['threads']} threads ({machine['thread_pool']})",
        f"Python {machine['python']}, {versions}",
        f"load {machine['load']} before, {figures['load_after']} after; "
        f"warm-up {figures['warm_up_s']:.2f} s",
    ]
    for case in figures["cases"]:
        lines += ["", *_case_lines(case)]
    lines += [
        "",
        f"{reference['case']}  torch reference {reference['reference_ms']['median']:.0f} ms, "
        f"cpu {reference['cpu_ms']['median']:.2f} ms: {reference['speed_up']:.0f} times faster",
        f"  rgb differs by {reference['p999_difference']:.1e} (99.9 % of pixels), "
        f"{reference['max_difference']:.1e} at most; {reference['flipped_pixels']} of "
        f"{reference['pixels']} pixels by more than {FLIP:g}",
    ]
    return "\n".join(lines)


def _case_lines(case: dict[str, Any]) -> list[str]:
    rows = {
        **case["stages_ms"],
        "whole frame": case["frame_ms"],
        "with smog": case["smog_frame_ms"],
    }
    memory = case["peak_extra_mib"]
    extra = "not measured"
    if memory is not None:
        extra = f"{memory:.0f} MiB above the scene's {case['scene_mib']:.0f} MiB"
    cost = {name: 100 * (ratio - 1) for name, ratio in case["smog_over_clear"].items()}
    millions = {name: case[name] / 1e6 for name in ("pairs", "listed_pairs", "pairs_per_s")}
    return [
        f"{case['case']}  {case['repeats']} frames  ms:  median      min      p90",
        *(
            f"  {name:<24}{spread['median']:>9.2f}{spread['min']:>9.2f}{spread['p90']:>9.2f}"
            for name, spread in rows.items()
        ),
        f"  smog costs {cost['median']:+.1f} % (least {cost['min']:+.1f}, p90 {cost['p90']:+.1f}, "
        f"of paired frames)",
        f"  {millions['pairs']:.2f} M splat-tile pairs, {millions['listed_pairs']:.2f} M listed, "
        f"{millions['pairs_per_s']:.1f} M pairs/s; {case['visible']} splats used",
        f"  memory of a frame: {extra}",
    ]
