"""How long a step of a reconstruction takes, stage by stage, and how much memory it needs.

The number of splats is fixed, so that every step is alike: none are added or removed.
"""

from __future__ import annotations

import dataclasses
import gc
import logging
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from adapters.base import open_scene
from adapters.training_views.views import recorded_views
from adapters.uri import format_uri
from augment.jobs.layout import folder_name, variant_name
from augment.jobs.render_job import RenderJob, run_job
from augment.reconstruct.config import DensifyConfig, FitConfig
from augment.reconstruct.view import ViewSource
from augment.render.cpu.driver import warm_up
from augment.scene import Scene
from recipes.load import load_recipe
from tools.bench.raster import Spread
from tools.bench_memory import RESET_PEAK, return_free_memory, status_mib
from tools.fit_data import can_hold_out, check_recorded, splat_count
from tools.fit_options import resolved_uri, without_growth
from tools.machine import MachineFacts, load_average, machine_facts

SPLATS = 200_000
STREET = "procedural:street?seed=3&frames=4"
STREET_CAMERAS = ("front", "left", "back")
SCALE = 0.25  # of recorded images; 480x270 of full HD
STREET_SCALE = 0.5  # of the street's 960x540
UNTIMED = 6  # first steps: compiling, and every view of a short recording decoded once
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitFigures:
    """stages_ms, step_ms: of the timed steps; step_ms is from call to return. sizes_px: width and
    height by camera. warm_up_s: compiling or loading the kernels and the first steps.

    memory_mib: resident before the trainer was made (Python, scene, images) and at most while it
    ran; None where the system cannot tell.
    """

    machine: MachineFacts
    scene: str
    splats: int
    actors: int
    views: int
    sizes_px: dict[str, tuple[int, int]]
    steps: int
    warm_up_s: float
    stages_ms: dict[str, Spread]
    step_ms: Spread
    memory_mib: dict[str, float] | None
    load_after: float | None


def bench_fit(
    scene_uri: str | None = None, *, quick: bool = False, progress: bool = True
) -> dict[str, Any]:
    """Measures steps on a recording, by default one of the procedural street made for it.

    scene_uri: raw data. Where it makes more than SPLATS Gaussians, SPLATS of them are kept.
    Returns FitFigures as plain numbers for JSON.

    Raises:
        ClimateGSError: the scene cannot be opened or has no recorded images.
    """
    machine = machine_facts()
    with _recording(scene_uri) as (uri, scale):
        scene = open_scene(uri)
        check_recorded(scene)
        scene = _thinned(scene)
        source = recorded_views(scene, scale=scale)
        steps = 20 if quick else 150
        figures = _measure(machine, scene_uri or uri, scene, source, steps, progress)
    return dataclasses.asdict(figures)


def _measure(
    machine: MachineFacts, uri: str, scene: Scene, source: ViewSource, steps: int, progress: bool
) -> FitFigures:
    from augment.reconstruct.trainer import Trainer

    for key in source.train:
        source.load(key)  # as in a long run, where images come from memory
    before = _mark_memory()
    begun = time.perf_counter()
    warm_up()
    config = FitConfig(sh_every=1, densify=without_growth(DensifyConfig()))
    trainer = Trainer(scene, source, config)
    for _ in range(UNTIMED):
        trainer.run_step()
    warm_up_s = time.perf_counter() - begun
    stages: dict[str, list[float]] = {}
    whole: list[float] = []
    for _ in tqdm(range(steps), unit="step", disable=not progress):
        begun = time.perf_counter()
        record = trainer.run_step()
        whole.append(1e3 * (time.perf_counter() - begun))
        for stage, seconds in record.stage_s.items():
            stages.setdefault(stage, []).append(1e3 * seconds)
    memory = None if before is None else {"before": before, "peak": status_mib("VmHWM")}
    cameras = {key.camera: source.camera(key) for key in source.train}
    return FitFigures(
        machine=machine,
        scene=uri,
        splats=len(trainer.splats),
        actors=len(scene.actors),
        views=len(source.train),
        sizes_px={name: (camera.width, camera.height) for name, camera in cameras.items()},
        steps=steps,
        warm_up_s=warm_up_s,
        stages_ms={stage: Spread.of(values) for stage, values in stages.items()},
        step_ms=Spread.of(whole),
        memory_mib=memory,
        load_after=load_average(),
    )


def _mark_memory() -> float | None:
    """MiB resident now, and the high-water mark begins here; None where /proc is missing."""
    if not RESET_PEAK.is_file():
        return None
    gc.collect()
    return_free_memory()
    RESET_PEAK.write_text("5")
    return status_mib("VmRSS")


@contextmanager
def _recording(scene_uri: str | None) -> Iterator[tuple[str, float]]:
    """URI of the recording to fit, and the scale of its images."""
    if scene_uri is not None:
        yield _with_count(scene_uri), SCALE
        return
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as folder:
        street, recipe = open_scene(STREET), load_recipe("clear").resolve(0)
        _log.info("recording %s", STREET)
        run_job(
            RenderJob(STREET, [recipe], folder, cameras=STREET_CAMERAS),
            scene_loader=lambda _uri: street,
        )
        recording = Path(folder) / folder_name(street.name) / variant_name(recipe)
        yield _with_count(f"recording:{recording}"), STREET_SCALE


def _with_count(uri: str) -> str:
    """The URI with a bound that leaves SPLATS or some more."""
    scheme, path, query = resolved_uri(uri)
    if can_hold_out(scheme, path):
        query = {"max_gaussians": str(2 * SPLATS), **query}
    return format_uri(scheme, path, query)


def _thinned(scene: Scene) -> Scene:
    """The scene with SPLATS splats where it has more, left out evenly from the background."""
    count = len(scene.background) - max(0, splat_count(scene) - SPLATS)
    if not 0 < count < len(scene.background):
        return scene
    kept = torch.linspace(0, len(scene.background) - 1, count, dtype=torch.float64).long()
    return dataclasses.replace(scene, background=scene.background.select(kept))


def fit_text(figures: dict[str, Any]) -> str:
    """The figures as a table for people."""
    machine, memory = figures["machine"], figures["memory_mib"]
    sizes = sorted({f"{width}x{height}" for width, height in figures["sizes_px"].values()})
    rows = {**figures["stages_ms"], "whole step": figures["step_ms"]}
    peak = "not measured"
    if memory is not None:
        peak = (
            f"{memory['peak']:.0f} MiB at most, {memory['peak'] - memory['before']:.0f} MiB above "
            f"what scene and images take"
        )
    lines = [
        f"{machine['processor']}, {machine['cores']} cores ({', '.join(machine['simd'])}), "
        f"{machine['threads']} threads ({machine['thread_pool']})",
        f"load {machine['load']} before, {figures['load_after']} after; "
        f"kernels and first steps {figures['warm_up_s']:.1f} s",
        "",
        f"{figures['scene']}",
        f"{figures['splats']} splats, {figures['actors']} actors, {figures['views']} views of "
        f"{', '.join(sizes)}; {figures['steps']} steps  ms:",
        f"  {'':<16}{'median':>9}{'min':>9}{'p90':>9}",
        *(
            f"  {name:<16}{spread['median']:>9.2f}{spread['min']:>9.2f}{spread['p90']:>9.2f}"
            for name, spread in rows.items()
        ),
        f"  memory: {peak}",
    ]
    return "\n".join(lines)
