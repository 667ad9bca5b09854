"""`climategs style train`: photographs and scenes become a network that maps colours.

OUT holds the network, the report and its curves; OUT/checkpoint what an unfinished training goes on
from. The network's bytes depend on the data, the settings and the number of steps alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch

from adapters.base import open_scene
from augment.effects.style.losses import FeatureExtractor, open_features
from augment.effects.style.network import B0Encoder, load_imagenet_weights, save_network
from augment.effects.style.pairs import recolor
from augment.effects.style.scores import DEFINITIONS, score_photos, score_training
from augment.effects.style.train import (
    Content,
    Draw,
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
from augment.jobs.processes import OutputLock
from tools.fit_options import budget_s, length_of
from tools.output import print_note
from tools.plots import STYLE_PANELS, write_curves
from tools.style_train_options import StyleTrainOptions, uri_text
from tools.training import (
    CHECKPOINT_S,
    Checkpoint,
    Outcome,
    StopRequest,
    check_same,
    differences,
    load_checkpoint,
    mark_finished,
    note_stop,
    remove_unused,
    rounded_steps,
    run_steps,
    save_checkpoint,
)

NETWORK_FILE, REPORT_FILE, CURVES_FILE = "network.safetensors", "report.json", "curves.png"
ROWS, ROW_STEPS = 40, 50  # of the history; steps averaged into one, at most
SCORED = 16  # contents with a style each, by which a network is scored
TIMED, UNTIMED = 8, 2  # steps from which the number of them is estimated
RESERVE = 0.05  # of the time, for scores and checkpoints


def train_style(
    options: StyleTrainOptions, *, progress: bool = True, checkpoint_s: float = CHECKPOINT_S
) -> Outcome:
    """Trains, or goes on training, into `options.out`.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
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
            check_same(options.out, options.settings(), length_of(options), before)
            if before.finished and (done := _finished(options, before)) is not None:
                return done
        try:
            run = _prepare(options, folder, before)
        except BaseException:
            if not folder.exists():
                remove_unused(options.out)
            raise
        return _train(run, progress, checkpoint_s)


def checkpoint_folder(out: Path) -> Path:
    """What a training in this folder goes on from."""
    return out / "checkpoint"


class _Data(NamedTuple):
    """scored: what networks are scored by. held_out: photos."""

    pool: TrainingPool
    scored: Draw
    held_out: torch.Tensor
    facts: dict[str, Any]
    problems: tuple[str, ...]


@dataclass(eq=False)
class _Run:
    """All that a training needs, opened and at the step to go on from."""

    options: StyleTrainOptions
    folder: Path
    trainer: StyleTrainer
    features: FeatureExtractor
    plan: Checkpoint
    data: _Data
    rows: list[dict[str, Any]]
    sums: dict[str, float]
    begun: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        return self.plan.seconds + time.perf_counter() - self.begun

    def score(self) -> None:
        """One more row of the history, with what the network is worth now."""
        scores = score_training(self.trainer.net, self.data.scored, self.features)
        self.rows.append({"step": self.trainer.step, "seconds": self.seconds(), **scores})

    def add(self, record: StepRecord) -> None:
        """One more step; a row of the history where it completes one."""
        for name, value in {"steps": 1.0, "loss": record.loss}.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        for name, value in record.terms.items():  # of a part of the steps, where the warm-up ends
            self.sums[f"sum.{name}"] = self.sums.get(f"sum.{name}", 0.0) + value
            self.sums[f"count.{name}"] = self.sums.get(f"count.{name}", 0.0) + 1
        length = min(max(self.plan.steps // ROWS, 1), ROW_STEPS)
        if record.step % length and record.step != self.plan.steps:
            return
        sums, self.sums = self.sums, {}
        names = [name.removeprefix("sum.") for name in sums if name.startswith("sum.")]
        self.rows.append({
            "step": record.step,
            "seconds": self.seconds(),
            "loss": sums["loss"] / sums["steps"],
            **{name: sums[f"sum.{name}"] / sums[f"count.{name}"] for name in names},
        })  # fmt: skip

    def save(self) -> None:
        arrays, facts = self.trainer.state()
        checkpoint = dataclasses.replace(
            self.plan,
            step=self.trainer.step,
            seconds=self.seconds(),
            history=self.rows,
            sums=self.sums,
            facts=facts,
            arrays=arrays,
        )
        save_checkpoint(self.folder, checkpoint)


def _prepare(options: StyleTrainOptions, folder: Path, before: Checkpoint | None) -> _Run:
    _take_device(options.device)
    data = _open_data(options)
    for problem in data.problems:
        print_note(f"note: {problem}")
    views, photos = len(data.pool.views), len(data.pool.photos)
    print_note(f"{photos} photos and {views} views of {len(options.scenes)} scenes to learn from")
    features = open_features(options.vgg)
    if before is None:
        plan = Checkpoint(options.settings(), length_of(options), options.steps or 0, data.facts)
        if (budget := budget_s(options)) is not None:
            steps, step_s = _estimate(options, budget, data.pool, features)
            plan = dataclasses.replace(plan, steps=steps)
            print_note(
                f"{1e3 * step_s:.0f} ms a step: {steps} steps make about {budget / 60:g} minutes. "
                f"--steps {steps} gives the same network again"
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
        print_note(f"going on after step {plan.step} of {plan.steps}")
    rows, sums = list(plan.history), dict(plan.sums)
    plan = dataclasses.replace(plan, arrays={}, facts={})
    return _Run(options, folder, trainer, features, plan, data, rows, sums)


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
    facts = {
        "views": len(views),
        "views_sha256": _digest(view.picture for view in views),
        "photos": len(photos.train),
        "photos_sha256": _digest([photos.train]),
        "held_out_photos": len(photos.held_out),
        "held_out_sha256": _digest([photos.held_out]),
    }
    pool = TrainingPool(tuple(views), photos.train).to(options.device)  # once, for all trainers
    # Networks are scored by held-out photos where there are any, and the scenes' views.
    held_out = photos.held_out.to(options.device)
    scored_pool = TrainingPool(pool.views, held_out) if len(held_out) else pool
    scored = scored_pool.draw(
        generator_for(0, 0, "scores"),  # whatever the seed: trainings are compared by them
        SCORED,
        scene_share=options.scene_share,
        perturbed=0.5,
        colors=1,
        recolor=recolor,
    )
    return _Data(pool, scored, photos.held_out, facts, (*problems, *photos.problems))


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
    config = options.config(steps)
    return StyleTrainer(
        net,
        pool,
        config,
        features,
        recolor=recolor,
        pairs=pair_loss_of(pool, config.pair_weights) if options.pairs > 0 else None,
        frozen_norm=options.encoder_weights is not None,
        device=options.device,
    )


def _estimate(
    options: StyleTrainOptions, budget_s: float, pool: TrainingPool, features: FeatureExtractor
) -> tuple[int, float]:
    """Steps that fill the time, and seconds of one with all losses, by a trainer thrown away."""
    trainer = _trainer(dataclasses.replace(options, warm_up=0.0), 1000, pool, features)
    seconds: list[float] = []
    for _ in range(UNTIMED + TIMED):
        begun = time.perf_counter()
        trainer.run_step()
        seconds.append(time.perf_counter() - begun)
    step_s = sorted(seconds[UNTIMED:])[TIMED // 2]
    return rounded_steps(int(budget_s * (1 - RESERVE) / step_s)), step_s


def _train(run: _Run, progress: bool, checkpoint_s: float) -> Outcome:
    def after_step(record: StepRecord, is_evaluated: bool) -> dict[str, str]:
        run.add(record)
        if is_evaluated:
            run.score()
        return {"loss": f"{run.sums['loss'] / run.sums['steps']:.4f}"} if run.sums else {}

    with StopRequest() as stop, fixed_threads():
        if run.trainer.step == 0 and not run.rows:
            run.score()
        complete = run_steps(
            run.trainer,
            run.plan.steps,
            after_step=after_step,
            save=run.save,
            stop=stop,
            name="train",
            checkpoint_s=checkpoint_s,
            progress=progress,
        )
        report = _write(run, complete)
    if complete:
        mark_finished(run.folder)
        _show_end(run.options.out, report)
        return Outcome(0, report)
    note_stop(run.trainer.step, run.plan.steps, overwrite=run.options.overwrite)
    return Outcome(130, report)


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
    scores = score_training(net, run.data.scored, run.features)
    report = {
        **about,
        "complete": complete,
        "network": NETWORK_FILE,
        "parameters": sum(parameter.numel() for parameter in net.parameters()),
        "seconds": run.seconds(),
        "scenes": [uri_text(uri) for uri in options.scenes],
        "problems": list(run.data.problems),
        "definitions": DEFINITIONS,
        "scores": scores | score_photos(net, run.data.held_out),
        "history": run.rows,
    }
    write_atomic(options.out / REPORT_FILE, (json.dumps(report, indent=1) + "\n").encode())
    write_curves(options.out / CURVES_FILE, run.rows, STYLE_PANELS)
    return report


def _finished(options: StyleTrainOptions, before: Checkpoint) -> Outcome | None:
    """The outcome where network and report stand; None where one of them was lost since."""
    try:
        report = json.loads((options.out / REPORT_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    if not (options.out / NETWORK_FILE).is_file():
        return None
    print(f"{options.out} is finished already ({before.steps} steps); nothing was done")
    _show_end(options.out, report)
    return Outcome(0, report)


def _show_end(out: Path, report: dict[str, Any]) -> None:
    known = {n: v for n, v in report["scores"].items() if isinstance(v, int | float)}
    print(", ".join(f"{name} {v:.4g}" for name, v in known.items() if math.isfinite(v)))
    if (out / CURVES_FILE).is_file():
        print(f"curves: {out / CURVES_FILE}")
    print(f"network: {out / NETWORK_FILE}")
