"""`climategs bench fit`: time of each stage of a training step, memory, and the scores of a fit.

Steps are timed at a fixed number of splats: no splats are added or removed, so that all steps are
alike.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from adapters.base import open_scene
from adapters.training_views.views import RecordedViews
from augment.errors import ClimateGSError
from augment.reconstruct.config import FitConfig, Tuning
from augment.reconstruct.trainer import Trainer
from augment.render.cpu.driver import warm_up
from augment.scene.scene import Scene
from recipes.load import load_recipe
from tools.bench.harness import (
    Figures,
    Table,
    begin_peak,
    figures,
    machine_facts,
    spread_ms,
    status_mib,
)
from tools.bench.scenes import record_street
from tools.fit import NOMINAL_STEPS, fit_scene
from tools.options import FitOptions

# The number of steps before the first timed one. They compile kernels, and decode every view of a
# short recording.
NUM_UNTIMED_STEPS = 6
# The columns of the table of a fit.
FIT_COLUMNS = (
    "fit",
    "steps",
    "PSNR dB",
    "SSIM",
    "FLIP",
    "depth median m",
    "90 % m",
    "true depth median m",
    "90 % m",
    "minutes",
)


@dataclass(frozen=True)
class FitCase:
    """The sizes that are measured."""

    splats: int = 200_000
    """The number of splats of the timed steps."""
    steps: int = 150
    """The number of timed steps."""
    frames: int = 16
    """The number of frames of the street's recording."""
    gaussians: int = 400_000
    """The number of Gaussians of the recorded street."""
    cameras: tuple[str, ...] | None = None
    """The names of the cameras of the street's recording; None for all."""
    render_scale: float = 1.0
    """The scale of the street's recorded images."""
    fit_steps: int = 3000
    """The number of steps of the fit that is compared with the street's exact depth; 0 for none."""
    scale: float = 0.25
    """The scale at which images of the caller's scene are fitted."""
    street_scale: float = 0.5
    """The scale at which the street's images are fitted."""


FULL_CASE = FitCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = FitCase(steps=20, frames=4, cameras=("front", "left", "back"), fit_steps=0)


def measure(quick: bool = False, scene: str | None = None, case: FitCase | None = None) -> Figures:
    """Measure the steps of a reconstruction, and a fit of the procedural street.

    Args:
        quick: True for QUICK_CASE.
        scene: The address of raw data whose steps are timed. By default a drive down the
            procedural street is recorded, and also fitted to every other frame.
        case: Sizes; None for FULL_CASE or QUICK_CASE.

    Raises:
        ClimateGSError: the scene cannot be opened or has no recorded images.
    """
    machine = machine_facts()
    case = case or (QUICK_CASE if quick else FULL_CASE)
    if scene is not None:
        steps, facts = time_steps(scene, case.scale, case)
        return figures("fit", [steps], machine=machine, scene=scene, **facts)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        size = {"frames": case.frames, "gaussians": case.gaussians}
        images = {"scale": case.render_scale, "cameras": case.cameras}
        clear = load_recipe("clear").resolve(0)
        street, recording = record_street(Path(name) / "raw", clear, **images, **size)
        uri = f"recording:{recording}"
        steps, facts = time_steps(uri, case.street_scale, case)
        tables = [steps]
        if case.fit_steps:
            tables.append(_fit_table(uri, Path(name) / "fitted", street.source, case))
    return figures("fit", tables, machine=machine, scene=street.source, **facts)


def _fit_table(uri: str, out: Path, truth: str, case: FitCase) -> Table:
    """Fit the street. Return the scores of held-out views, and of depth against the exact depth."""
    options = {"steps": case.fit_steps, "scale": case.street_scale, "truth": truth}
    report = fit_scene(FitOptions(scene=uri, out=out, **options)).report
    mean = report["mean"]
    exact = (report.get("truth") or {}).get("median", {})
    scores = [mean.get(s) for s in ("psnr", "ssim", "flip", "depth_median_m", "depth_p90_m")]
    depth = exact.get("median_m"), exact.get("p90_m")
    row = ("procedural street", report["step"], *scores, *depth, report["seconds"] / 60)
    return Table("Held-out views", FIT_COLUMNS, [row])


def time_steps(uri: str, scale: float, case: FitCase) -> tuple[Table, Figures]:
    """Time `case.steps` training steps, after NUM_UNTIMED_STEPS steps.

    If the scene has more than `case.splats` Gaussians, only that many are used.

    Args:
        uri: The address of the scene.
        scale: The scale at which its images are fitted.
        case: The sizes.

    Returns:
        The table of the stages, and facts.

    Raises:
        ClimateGSError: the scene has no recorded images.
    """
    scene = open_scene(uri)
    if not any(frame.image_paths for frame in scene.frames):
        raise ClimateGSError(
            f"{scene.source} has no recorded images, so there is nothing to fit to"
        )
    scene = _thinned(scene, case.splats)
    source = RecordedViews(scene, scale=scale)
    for key in source.train:
        source.load(key)  # In a long run, images come from memory, too.
    before = begin_peak()
    started = time.perf_counter()
    warm_up()
    config = FitConfig(densify="none")
    tuning = Tuning(steps_per_sh_band=1)
    trainer = Trainer(scene, source, config, NOMINAL_STEPS, tuning=tuning)
    for _ in range(NUM_UNTIMED_STEPS):
        trainer.run_step()
    warm_up_s = time.perf_counter() - started
    seconds = defaultdict(list)
    for _ in tqdm(range(case.steps), unit="step"):
        started = time.perf_counter()
        record = trainer.run_step()
        seconds["whole step"].append(time.perf_counter() - started)
        for stage, stage_seconds in record.stage_s.items():
            seconds[stage].append(stage_seconds)
    memory = None
    note = ""
    if before is not None:
        memory = {"before": before, "peak": status_mib("VmHWM")}
        note = f"resident at most {memory['peak']:.0f} MiB, {before:.0f} before training"
    sizes = sorted({(c.width, c.height) for c in map(source.camera, source.train)})
    size_text = ", ".join(f"{width}x{height}" for width, height in sizes)
    title = f"A step of {len(trainer.splats):,} splats, {len(source.train)} views of {size_text}"
    rows = [(stage, *spread_ms(stage_seconds).values()) for stage, stage_seconds in seconds.items()]
    facts = {
        "splats": len(trainer.splats),
        "actors": len(scene.actors),
        "steps": case.steps,
        "warm_up_s": warm_up_s,
        "memory_mib": memory,
    }
    return Table(title, ("stage", "ms", "min", "p90"), rows, note), facts


def _thinned(scene: Scene, splats: int) -> Scene:
    """Return a scene with no more than `splats` splats, evenly left out of the background."""
    count = len(scene.background) + sum(len(actor.gaussians) for actor in scene.actors)
    left = len(scene.background) - max(0, count - splats)
    if not 0 < left < len(scene.background):
        return scene
    row_ids = torch.linspace(0, len(scene.background) - 1, left, dtype=torch.float64).long()
    return dataclasses.replace(scene, background=scene.background.select(row_ids))
