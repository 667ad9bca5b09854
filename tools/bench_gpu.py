"""`climategs bench gpu`: every figure that the GPU backend is judged by, in one run of minutes.

Sections run in the order of their weight, each in a process of its own: one that fails, and be it
by a fault that leaves the GPU unusable to its process, or that finds no time left, is said to be
missing, and the others count. What has been measured is written after each.
"""

from __future__ import annotations

import dataclasses
import datetime
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from augment.cameras import Camera
from augment.scene import Scene
from tools.apart import apart, guarded
from tools.bench_gpu_ceilings import Ceilings, Load, measure_ceilings
from tools.bench_scene import DEFAULT_CASES, RasterCase
from tools.gpu_clock import Timing, gpu_facts
from tools.output import write_json
from tools.machine import load_average, machine_facts


@dataclass(frozen=True)
class GpuCase:
    """What is measured on. raster: the random scene. street: of the weathered frames, width x
    height pixels. placement: scenes for snow, besides the street. cell_m: of the snow. minutes:
    after which no further section begins, and one that runs is stopped.
    """

    raster: RasterCase = DEFAULT_CASES[-1]
    street: str = "procedural:street?seed=3&frames=1&gaussians=1000000"
    width: int = 1600
    height: int = 1066
    placement: tuple[str, ...] = ()
    cell_m: float = 0.05
    minutes: float = 9.0
    load: Load = field(default_factory=Load)


WHOLE = GpuCase()
QUICK = GpuCase(
    raster=DEFAULT_CASES[0], street="procedural:street?seed=3&frames=1", width=640, height=426
)


def _ceilings(case: GpuCase, timing: Timing, _: Ceilings | None) -> dict[str, Any]:
    gpu = gpu_facts()
    found = dataclasses.asdict(measure_ceilings(timing, case.load))
    return {**found, "gpu": None if gpu is None else dataclasses.asdict(gpu)}


def _raster(case: GpuCase, timing: Timing, ceilings: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_raster import bench_gpu_case

    return bench_gpu_case(case.raster, timing, ceilings)


def _style(case: GpuCase, timing: Timing, ceilings: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_scene import bench_fold

    return bench_fold(case.raster, timing, ceilings)


def _frames(case: GpuCase, timing: Timing, ceilings: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_frames import bench_frames, frame_recipes

    scene, camera = _street(case)
    found = bench_frames(scene, camera, frame_recipes(case.cell_m), timing, ceilings)
    return {"scene": case.street, **found}


def _street(case: GpuCase) -> tuple[Scene, Camera]:
    from adapters.base import open_scene
    from tools.bench_flood_cost import bench_camera
    from tools.bench_gpu_frames import BACKEND

    scene = open_scene(case.street)
    return scene, bench_camera(scene, case.width, case.height, BACKEND)


def _placement(case: GpuCase, timing: Timing, _: Ceilings) -> dict[str, Any]:
    from adapters.base import open_scene
    from tools.bench_gpu_scene import bench_gpu_placement

    found = []
    for uri in (*case.placement, case.street):
        placed = bench_gpu_placement(open_scene(uri), uri, cell_m=case.cell_m)
        found.append({**placed, "named": uri in case.placement})
    return {"scenes": found}


def _agreement(case: GpuCase, timing: Timing, _: Ceilings) -> dict[str, Any]:
    from tools.bench_gpu_frames import frame_agreement, frame_recipes
    from tools.bench_gpu_raster import case_agreement

    return {
        "raster": case_agreement(case.raster),
        "frames": frame_agreement(*_street(case), frame_recipes(case.cell_m)),
    }


CEILINGS = "ceilings"
SECTIONS: dict[str, Callable[..., dict[str, Any]]] = {
    CEILINGS: _ceilings,
    "raster": _raster,
    "style": _style,
    "frames": _frames,
    "placement": _placement,
    "agreement": _agreement,
}


def bench_gpu(
    case: GpuCase = WHOLE,
    *,
    sections: Sequence[str] = tuple(SECTIONS),
    timing: Timing | None = None,
    json_file: Path | None = None,
    in_processes: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """All figures as plain numbers for JSON; written to json_file after every section.

    in_processes: each section in one of its own.

    Raises:
        ValueError: no such section.
    """
    unknown = sorted(set(sections) - set(SECTIONS))
    if unknown:
        raise ValueError(f"sections are {', '.join(SECTIONS)}; got {', '.join(unknown)}")
    timing, start = timing or Timing(), time.perf_counter()
    figures: dict[str, Any] = _facts(timing) | {
        name: {"left_out": "not asked for"} for name in SECTIONS
    }
    wanted = [name for name in SECTIONS if name in sections or name == CEILINGS]
    ceilings: Ceilings | None = None
    for name in tqdm(wanted, "sections", unit="section", disable=not progress):
        left_s = 60 * case.minutes - (time.perf_counter() - start)
        if name != CEILINGS and ceilings is None:
            figures[name] = {"left_out": "the GPU's ceilings could not be measured"}
            continue
        arguments = (case, timing, ceilings)
        figures[name] = (
            apart(SECTIONS[name], arguments, left_s)
            if in_processes
            else guarded(SECTIONS[name], arguments)
        )
        if name == CEILINGS and "bytes_per_s" in figures[name]:
            figures["gpu"] = figures[name].get("gpu")
            ceilings = Ceilings(**{f: figures[name][f] for f in Ceilings.__dataclass_fields__})
        figures["minutes"] = round((time.perf_counter() - start) / 60, 2)
        figures["load_after"] = load_average()
        if json_file is not None:
            write_json(json_file, figures, say=False)
    return figures


def _facts(timing: Timing) -> dict[str, Any]:
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": dataclasses.asdict(machine_facts()),
        "gpu": None,
        "repeats": timing.repeats,
        "warm_up": timing.warm_up,
    }
