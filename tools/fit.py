"""`climategs fit`: recorded images, LiDAR and boxes become a scene of Gaussians.

OUT is the scene; OUT.fit beside it holds the checkpoint and the report. The scene's bytes depend on
the data, the settings and the number of steps alone; times are in OUT.fit only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from augment.errors import OutputError
from augment.files.scene_file import is_scene_folder
from augment.jobs.layout import STATE_FOLDER
from augment.jobs.processes import OutputLock
from augment.reconstruct.view import ViewSource
from augment.scene import Scene
from tools.fit_checkpoint import (
    PLAN_FILE,
    Checkpoint,
    check_same,
    load_checkpoint,
    mark_finished,
    save_checkpoint,
)
from tools.fit_data import FewerTestViews, data_facts, open_to_fit
from tools.fit_loop import CHECKPOINT_S, History, Loop, StopRequest, sample_keys
from tools.fit_options import FitOptions, differences
from tools.fit_parts import FitParts, Fitter, Views, real_parts
from tools.fit_time import estimate_steps
from tools.fit_truth import truth_facts

EVALUATED = {"test": 6, "train": 3}  # views looked at during the run; all of them at its end
EVALUATED_WHEN_STOPPED = 12
REPORT_FILE = "report.json"


@dataclass(frozen=True)
class FitOutcome:
    """code: the command's exit code, 130 where it was interrupted. report: as in report.json."""

    code: int
    report: dict[str, Any]


def fit_scene(
    options: FitOptions,
    *,
    parts: FitParts | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    progress: bool = True,
) -> FitOutcome:
    """Fits, or goes on fitting, `options.scene` into `options.out`.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    folder = state_folder(options.out)
    _check_out(options, folder)
    with OutputLock(folder):
        before = None if options.overwrite else load_checkpoint(folder, arrays=False)
        if before is not None:
            check_same(options.out, options.settings(), options.length(), before)
            if before.finished and (done := _finished(options, folder, before)) is not None:
                return done
        try:
            run = _prepare(options, parts or real_parts(options.device), folder, before)
        except BaseException:
            _remove_unused(folder)
            raise
        return _run(run, checkpoint_s, progress)


def state_folder(out: Path) -> Path:
    """Where the checkpoint and the report of a scene folder lie: beside it."""
    out = out.resolve()
    if not out.name:
        raise OutputError(f"--out {out} is the file system's root: name a folder below it")
    return out.with_name(f"{out.name}.fit")


@dataclass(frozen=True, eq=False)
class _Run:
    """All that fitting needs, opened and at the step to go on from."""

    options: FitOptions
    parts: FitParts
    folder: Path
    scene: Scene
    source: Views
    notes: tuple[str, ...]
    checks: Mapping[str, Any]
    trainer: Fitter
    plan: Checkpoint
    history: History


def _prepare(options: FitOptions, parts: FitParts, folder: Path, before: Checkpoint | None) -> _Run:
    scene, notes = open_to_fit(options, parts.open_scene)
    checked = parts.check(scene, parts.views(scene, options), options)
    source, notes = checked.source, (*notes, *checked.problems)
    scene = parts.start(checked.scene, source)
    for problem in _problems(scene, source, notes):
        _print_result(f"note: {problem}")
    facts = data_facts(scene, source)
    _print_result(
        f"{len(source.train)} images to learn from, {len(source.test)} held out; "
        f"{facts['Gaussians to start from']} Gaussians and {len(scene.actors)} actors to start from"
    )
    if before is None:
        plan = Checkpoint(options.settings(), options.length(), options.steps or 0, facts)
        if options.budget_s is not None:
            steps = _estimate(options, parts, scene, source)
            plan = dataclasses.replace(plan, steps=steps)
        save_checkpoint(folder, plan)  # in place of what --overwrite gives up
    else:
        plan = load_checkpoint(folder)
        assert plan is not None
        if changed := differences(plan.data, facts):
            raise OutputError(
                f"{options.scene} is not what {options.out} was fitted to so far: "
                f"{'; '.join(changed)}. Begin anew with --overwrite, or fit to another --out"
            )
    trainer = parts.trainer(scene, source, options.config(plan.steps))
    if plan.arrays:
        trainer.load_state(plan.arrays, plan.facts)
        _print_result(f"going on after step {plan.step} of {plan.steps}")
    history = History(plan.history, plan.sums, plan.seconds)
    plan = dataclasses.replace(plan, arrays={}, facts={})  # the trainer has them: free the memory
    return _Run(options, parts, folder, scene, source, notes, checked.facts, trainer, plan, history)


def _estimate(options: FitOptions, parts: FitParts, scene: Scene, source: Views) -> int:
    assert options.budget_s is not None

    def throw_away(steps: int) -> Fitter:
        return parts.trainer(scene, source, options.config(steps))

    _print_result("timing a few steps (kernels are compiled first where they are not yet) ...")
    estimate = estimate_steps(
        throw_away, options.budget_s, views=len(source.train), grows=options.densify != "none"
    )
    _print_result(
        f"{1e3 * estimate.step_s:.0f} ms a step at the start: {estimate.steps} steps make about "
        f"{options.budget_s / 60:g} minutes. --steps {estimate.steps} gives the same scene again"
    )
    return estimate.steps


def _run(run: _Run, checkpoint_s: float, progress: bool) -> FitOutcome:
    begun = time.perf_counter()
    keys = {
        split: sample_keys(getattr(run.source, split), count) for split, count in EVALUATED.items()
    }

    def evaluate() -> dict[str, dict[str, float]]:
        scene = run.trainer.scene()
        return {s: run.parts.score(scene, run.source, k) for s, k in keys.items() if k}

    with StopRequest() as stop:
        loop = Loop(
            trainer=run.trainer,
            steps=run.plan.steps,
            history=run.history,
            evaluate=evaluate,
            save=lambda: save_checkpoint(run.folder, _checkpoint(run)),
            stop=stop,
            checkpoint_s=checkpoint_s,
            progress=progress,
        )
        complete = loop.run()
        _print_result(f"writing {run.options.out} and evaluating all views")
        report = _write(run, complete, time.perf_counter() - begun)
    if complete:
        mark_finished(run.folder)
        return FitOutcome(0, report)
    again = "the same command without --overwrite" if run.options.overwrite else "the same command"
    _print_result(
        f"stopped after step {run.trainer.step} of {run.plan.steps}; {again} goes on from there"
    )
    return FitOutcome(130, report)


def _checkpoint(run: _Run) -> Checkpoint:
    arrays, facts = run.trainer.state()
    return dataclasses.replace(
        run.plan,
        step=run.trainer.step,
        seconds=run.history.spent_s(),
        history=run.history.rows,
        sums=run.history.sums,
        facts=facts,
        arrays=arrays,
    )


def _write(run: _Run, complete: bool, seconds: float) -> dict[str, Any]:
    options = run.options
    made_by = {"command": "fit", "step": run.trainer.step, "steps": run.plan.steps}
    made_by |= {"settings": run.plan.settings, "data": run.plan.data}
    scene = dataclasses.replace(run.trainer.scene(), made_by=made_by)
    run.parts.save(scene, options.out.absolute())
    facts: dict[str, Any] = {
        "scene": options.scene,
        "complete": complete,
        "step": run.trainer.step,
        "steps": run.plan.steps,
        "seconds": run.history.spent_s(),
        "seconds_of_this_run": seconds,
        "data": run.plan.data,
        "settings": run.plan.settings,
        "problems": list(_problems(run.scene, run.source, run.notes)),
        "checks": dict(run.checks),
    }
    source: ViewSource = run.source
    if not complete and len(source.test) > EVALUATED_WHEN_STOPPED:  # someone waits for the end
        source = FewerTestViews(source, sample_keys(source.test, EVALUATED_WHEN_STOPPED))
        facts["problems"].append(
            f"the run was stopped: figures are of {len(source.test)} of the "
            f"{len(run.source.test)} held-out views"
        )
    if options.truth is not None:
        facts["truth"] = truth_facts(options.truth, scene, run.source)
        _print_result(_truth_line(facts["truth"]))
    folder = report_folder(run.folder)
    report = run.parts.report(folder, scene, source, run.history.rows, facts)
    _show_end(options.out, folder)
    return report


def _truth_line(truth: Mapping[str, Any]) -> str:
    depth = truth["median"]
    return (
        f"depth against the street's own: median {100 * depth['median_m']:.1f} cm, 90 % within "
        f"{100 * depth['p90_m']:.1f} cm; {100 * truth['no_surface']:.2f} % of surfaces missing, "
        f"{100 * truth['sky_covered']:.2f} % of the sky covered"
    )


def _problems(scene: Scene, source: Views, notes: tuple[str, ...]) -> tuple[str, ...]:
    """Every sentence once; loading views may have added some since they were opened."""
    return tuple(dict.fromkeys((*scene.problems, *source.problems, *notes)))


def report_folder(folder: Path) -> Path:
    return folder / "report"


def _remove_unused(folder: Path) -> None:
    """Leave no trace of a run that never began: its lock, and the folder if that was all."""
    if not (folder / PLAN_FILE).exists():
        shutil.rmtree(folder / STATE_FOLDER, ignore_errors=True)
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()


def _check_out(options: FitOptions, folder: Path) -> None:
    """What is at --out is a scene, or nothing; known before hours are spent."""
    out = options.out
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not is_scene_folder(out):
        raise OutputError(f"{out} holds something else than a scene: choose another --out")
    if not options.overwrite and load_checkpoint(folder, arrays=False) is None:
        raise OutputError(
            f"{out} holds a scene, and there is no {folder} to go on from: choose another --out, "
            f"or replace it with --overwrite"
        )


def _finished(options: FitOptions, folder: Path, before: Checkpoint) -> FitOutcome | None:
    """The outcome where scene and report stand; None where one of them was lost since."""
    report = report_folder(folder) / REPORT_FILE
    try:
        facts = json.loads(report.read_bytes())
    except (OSError, ValueError):
        return None
    if not is_scene_folder(options.out):
        return None
    print(f"{options.out} is finished already ({before.steps} steps); nothing was done")
    _show_end(options.out, report.parent)
    return FitOutcome(0, facts)


def _show_end(out: Path, folder: Path) -> None:
    table = folder / "report.md"
    if table.is_file():
        print("\n".join(line for line in table.read_text().splitlines() if line.startswith("|")))
    for path in sorted((*folder.glob("*.jpg"), *folder.glob("*.png"), *folder.glob("*.md"))):
        print(f"{path.stem.replace('_', ' ')}: {path}")
    print(f"scene: {out}")
    print(f"render it: climategs render dense-fog --scene 'scene:{out}' --out out/fog")


def _print_result(text: str) -> None:
    print(text, file=sys.stderr)
