"""`climategs style train`: photographs and scenes become a network that maps colours.

OUT holds the network, the report and its curves; OUT/checkpoint what an unfinished training goes on
from. The network's bytes depend on the data, the settings and the number of steps alone.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import shutil
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from adapters.base import open_scene
from augment.effects.style.losses import FeatureExtractor, open_features
from augment.effects.style.network import B0Encoder, load_imagenet_weights, save_network
from augment.effects.style.pairs import recolor
from augment.effects.style.scores import DEFINITIONS, score_photos, score_training
from augment.effects.style.train import (
    Content,
    Draw,
    Photos,
    StepRecord,
    StyleTrainer,
    TrainingPool,
    fixed_threads,
    generator_for,
    new_network,
    pair_loss_of,
    read_photos,
    scene_contents,
)
from augment.errors import ClimateGSError, OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.layout import STATE_FOLDER
from augment.jobs.processes import OutputLock
from tools.fit_checkpoint import (
    Checkpoint,
    check_same,
    load_checkpoint,
    mark_finished,
    save_checkpoint,
)
from tools.fit_loop import CHECKPOINT_S, StopRequest, evaluation_steps
from tools.fit_options import differences
from tools.sheet import write_rgb
from tools.style_curves import draw_style_curves
from tools.style_train_options import StyleTrainOptions, uri_text

NETWORK_FILE, REPORT_FILE, CURVES_FILE = "network.safetensors", "report.json", "curves.png"
ROWS, ROW_STEPS = 40, 50  # of the history; steps averaged into one, at most
SCORED = 16  # contents with a style each, by which a network is scored
TIMED, UNTIMED = 8, 2  # steps from which the number of them is estimated
RESERVE = 0.05  # of the time, for scores and checkpoints


@dataclass(frozen=True)
class StyleTrainOutcome:
    """code: the command's exit code, 130 where it was interrupted. report: as in report.json."""

    code: int
    report: dict[str, Any]


def train_style(
    options: StyleTrainOptions, *, progress: bool = True, checkpoint_s: float = CHECKPOINT_S
) -> StyleTrainOutcome:
    """Trains, or goes on training, into `options.out`; with the ablations where they are asked for.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    if options.ablations:
        from tools.style_ablations import train_ablations

        return train_ablations(options, progress=progress)
    folder = checkpoint_folder(options.out)
    if options.out.exists() and not options.out.is_dir():
        raise OutputError(f"{options.out} is a file: choose another --out")
    with OutputLock(options.out):
        before = None if options.overwrite else load_checkpoint(folder, arrays=False)
        if before is None and not options.overwrite and (options.out / NETWORK_FILE).exists():
            raise OutputError(
                f"{options.out} holds a network, and no checkpoint to go on from: choose another "
                f"--out, or replace it with --overwrite"
            )
        if before is not None:
            check_same(options.out, options.settings(), options.length(), before)
            if before.finished and (done := _finished(options, before)) is not None:
                return done
        try:
            run = _prepare(options, folder, before)
        except BaseException:
            _remove_unused(options.out)
            raise
        return _train(run, progress, checkpoint_s)


def checkpoint_folder(out: Path) -> Path:
    """What a training in this folder goes on from."""
    return out / "checkpoint"


@dataclass(eq=False)
class _Run:
    """All that a training needs, opened and at the step to go on from."""

    options: StyleTrainOptions
    folder: Path
    trainer: StyleTrainer
    features: FeatureExtractor
    plan: Checkpoint
    scored: Draw
    held_out: torch.Tensor
    problems: tuple[str, ...]
    rows: list[dict[str, Any]]
    sums: dict[str, float]
    begun: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        return self.plan.seconds + time.perf_counter() - self.begun


@dataclass(frozen=True, eq=False)
class _Data:
    pool: TrainingPool
    scored: Draw
    held_out: torch.Tensor
    facts: dict[str, Any]
    problems: tuple[str, ...]


def _prepare(options: StyleTrainOptions, folder: Path, before: Checkpoint | None) -> _Run:
    _take_device(options.device)
    data = _open_data(options)
    for problem in data.problems:
        _print_result(f"note: {problem}")
    views, photos = len(data.pool.views), len(data.pool.photos)
    _print_result(
        f"{photos} photos and {views} views of {len(options.scenes)} scenes to learn from"
    )
    features = open_features(options.vgg)
    if before is None:
        plan = Checkpoint(options.settings(), options.length(), options.steps or 0, data.facts)
        if options.budget_s is not None:
            steps, step_s = _estimate(options, data, features)
            plan = dataclasses.replace(plan, steps=steps)
            _print_result(
                f"{1e3 * step_s:.0f} ms a step: {steps} steps make about "
                f"{options.budget_s / 60:g} minutes. --steps {steps} gives the same network again"
            )
        save_checkpoint(folder, plan)
    else:
        plan = load_checkpoint(folder)
        assert plan is not None
        if changed := differences(plan.data, data.facts):
            raise OutputError(
                f"the photos or scenes are not those {options.out} was trained on so far: "
                f"{'; '.join(changed)}. Begin anew with --overwrite, or train into another --out"
            )
    trainer = _trainer(options, plan.steps, data.pool, features)
    if plan.arrays:
        trainer.load_state(plan.arrays, plan.facts)
        _print_result(f"going on after step {plan.step} of {plan.steps}")
    rows, sums = list(plan.history), dict(plan.sums)
    plan = dataclasses.replace(plan, arrays={}, facts={})
    return _Run(
        options=options,
        folder=folder,
        trainer=trainer,
        features=features,
        plan=plan,
        scored=data.scored,
        held_out=data.held_out,
        problems=data.problems,
        rows=rows,
        sums=sums,
    )


def _take_device(device: str) -> None:
    """Make it the current one, on which the renderer's kernels run, too."""
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # of torch without CUDA
        reason = str(error).splitlines()[0]
        raise ClimateGSError(f"--device {device}: {reason}; train on cpu, or cuda") from error
    place = torch.device(device)
    if place.type == "cuda" and place.index is not None:
        torch.cuda.set_device(place)


def _open_data(options: StyleTrainOptions) -> _Data:
    size = options.picture_px
    views: list[Content] = []
    problems: list[str] = []
    for uri in options.scenes:
        scene = open_scene(uri)
        views += scene_contents(
            scene, options.views, size, with_parts=options.through == "renderer", seed=options.seed
        )
        problems += scene.problems
    photos = read_photos(options.photos, size, holdout=options.holdout)
    pool = TrainingPool(tuple(views), photos.train)
    facts = {
        "views": len(views),
        "views_sha256": _digest(view.picture for view in views),
        "photos": len(photos.train),
        "photos_sha256": _digest([photos.train]),
        "held_out_photos": len(photos.held_out),
        "held_out_sha256": _digest([photos.held_out]),
    }
    pool = pool.to(options.device)  # once, for all trainers
    scored = _scored(pool, photos, options)
    return _Data(pool, scored, photos.held_out, facts, (*problems, *photos.problems))


def _scored(pool: TrainingPool, photos: Photos, options: StyleTrainOptions) -> Draw:
    """What networks are scored by: held-out photos where there are any, and the scenes' views."""
    held_out = photos.held_out.to(options.device)
    apart = TrainingPool(pool.views, held_out) if len(held_out) else pool
    return apart.draw(
        generator_for(0, 0, "scores"),  # whatever the seed: trainings are compared by them
        SCORED,
        scene_share=options.scene_share,
        perturbed=0.5,
        colors=1,
        recolor=recolor,
    )


def _digest(pictures: Iterable[torch.Tensor]) -> str:
    found = hashlib.sha256()
    for picture in pictures:
        found.update(picture.contiguous().numpy().tobytes())
    return found.hexdigest()


def _trainer(
    options: StyleTrainOptions, steps: int, pool: TrainingPool, features: FeatureExtractor
) -> StyleTrainer:
    net = new_network(options.encoder, offset=options.matrix == "3x4", seed=options.seed)
    if options.encoder_weights is not None:
        assert isinstance(net.encoder, B0Encoder)
        load_imagenet_weights(net.encoder, options.encoder_weights)
    return StyleTrainer(
        net,
        pool,
        options.config(steps),
        features,
        recolor=recolor,
        pairs=pair_loss_of(pool, options.config(steps).pair_weights) if options.pairs > 0 else None,
        frozen_norm=options.encoder_weights is not None,
        device=options.device,
    )


def _estimate(
    options: StyleTrainOptions, data: _Data, features: FeatureExtractor
) -> tuple[int, float]:
    """Steps that fill the time, and seconds of one with all losses, by a trainer thrown away."""
    assert options.budget_s is not None
    timed = dataclasses.replace(options, warm_up=0.0)
    trainer = _trainer(timed, 1000, data.pool, features)
    seconds: list[float] = []
    for _ in range(UNTIMED + TIMED):
        begun = time.perf_counter()
        trainer.run_step()
        seconds.append(time.perf_counter() - begun)
    step_s = sorted(seconds[UNTIMED:])[TIMED // 2]
    steps = int(options.budget_s * (1 - RESERVE) / step_s)
    return max(1, steps if steps < 100 else steps // 50 * 50), step_s


def _train(run: _Run, progress: bool, checkpoint_s: float) -> StyleTrainOutcome:
    with StopRequest() as stop, fixed_threads():
        _steps(run, stop, progress, checkpoint_s)
        complete = run.trainer.step >= run.plan.steps
        report = _write(run, complete)
    if complete:
        mark_finished(run.folder)
        _show_end(run.options.out, report)
        return StyleTrainOutcome(0, report)
    again = "the same command without --overwrite" if run.options.overwrite else "the same command"
    _print_result(
        f"stopped after step {run.trainer.step} of {run.plan.steps}; {again} goes on from there"
    )
    return StyleTrainOutcome(130, report)


def _steps(run: _Run, stop: StopRequest, progress: bool, checkpoint_s: float) -> None:
    trainer, steps = run.trainer, run.plan.steps
    marks, saved = evaluation_steps(steps), time.monotonic()
    with tqdm(
        total=steps, initial=trainer.step, desc="train", unit="step", disable=not progress
    ) as bar:
        if trainer.step == 0 and not run.rows:
            _score(run)
        while trainer.step < steps and not stop.requested:
            record = trainer.run_step()
            _add(run, record)
            if record.step in marks:
                _score(run)
            if run.sums:
                mean = run.sums["loss"] / run.sums["steps"]
                bar.set_postfix({"loss": f"{mean:.4f}"}, refresh=False)
            bar.update()
            if time.monotonic() - saved > checkpoint_s and record.step < steps:
                _save(run)
                saved = time.monotonic()
    _save(run)


def _add(run: _Run, record: StepRecord) -> None:
    """One more step; a row of the history where it completes one."""
    for name, value in {"steps": 1.0, "loss": record.loss}.items():
        run.sums[name] = run.sums.get(name, 0.0) + value
    for name, value in record.terms.items():  # of a part of the steps, where the warm-up ends
        run.sums[f"sum.{name}"] = run.sums.get(f"sum.{name}", 0.0) + value
        run.sums[f"count.{name}"] = run.sums.get(f"count.{name}", 0.0) + 1
    length = min(max(run.plan.steps // ROWS, 1), ROW_STEPS)
    if record.step % length and record.step != run.plan.steps:
        return
    sums, run.sums = run.sums, {}
    names = [name.removeprefix("sum.") for name in sums if name.startswith("sum.")]
    run.rows.append({
        "step": record.step,
        "seconds": run.seconds(),
        "loss": sums["loss"] / sums["steps"],
        **{name: sums[f"sum.{name}"] / sums[f"count.{name}"] for name in names},
    })  # fmt: skip


def _score(run: _Run) -> None:
    scores = score_training(run.trainer.net, run.scored, run.features)
    run.rows.append({"step": run.trainer.step, "seconds": run.seconds(), **scores})


def _save(run: _Run) -> None:
    arrays, facts = run.trainer.state()
    checkpoint = dataclasses.replace(
        run.plan,
        step=run.trainer.step,
        seconds=run.seconds(),
        history=run.rows,
        sums=run.sums,
        facts=facts,
        arrays=arrays,
    )
    save_checkpoint(run.folder, checkpoint)


def _write(run: _Run, complete: bool) -> dict[str, Any]:
    options, net = run.options, run.trainer.net
    about = {
        "command": "style train",
        "step": run.trainer.step,
        "steps": run.plan.steps,
        "features": run.features.name,
        "settings": run.plan.settings,
        "data": run.plan.data,
    }
    save_network(options.out / NETWORK_FILE, net, about, half_precision=options.half_precision)
    scores = score_training(net, run.scored, run.features) | score_photos(net, run.held_out)
    report = {
        **about,
        "complete": complete,
        "network": NETWORK_FILE,
        "parameters": sum(parameter.numel() for parameter in net.parameters()),
        "seconds": run.seconds(),
        "scenes": [uri_text(uri) for uri in options.scenes],
        "problems": list(run.problems),
        "definitions": DEFINITIONS,
        "scores": scores,
        "history": run.rows,
    }
    write_atomic(options.out / REPORT_FILE, (json.dumps(report, indent=1) + "\n").encode())
    curves = draw_style_curves(run.rows)
    if curves is not None:
        write_rgb(options.out / CURVES_FILE, curves)
    return report


def _remove_unused(out: Path) -> None:
    """Leave no trace of a training that never began: its lock, and the folder if that was all."""
    if not checkpoint_folder(out).exists():
        shutil.rmtree(out / STATE_FOLDER, ignore_errors=True)
        with contextlib.suppress(OSError):  # not empty
            out.rmdir()


def _finished(options: StyleTrainOptions, before: Checkpoint) -> StyleTrainOutcome | None:
    """The outcome where network and report stand; None where one of them was lost since."""
    try:
        report = json.loads((options.out / REPORT_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    if not (options.out / NETWORK_FILE).is_file():
        return None
    print(f"{options.out} is finished already ({before.steps} steps); nothing was done")
    _show_end(options.out, report)
    return StyleTrainOutcome(0, report)


def _show_end(out: Path, report: dict[str, Any]) -> None:
    scores = report["scores"]
    print(", ".join(f"{name} {value:.4g}" for name, value in scores.items() if _is_finite(value)))
    print(f"curves: {out / CURVES_FILE}")
    print(f"network: {out / NETWORK_FILE}")


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _print_result(text: str) -> None:
    print(text, file=sys.stderr)
