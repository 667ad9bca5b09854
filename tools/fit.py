"""`climategs fit`: recorded images, LiDAR and boxes become a scene of Gaussians.

OUT is the scene; OUT.fit beside it holds the checkpoint and the report. The scene's bytes depend on
the data, the settings and the number of steps alone; times are in OUT.fit only.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from adapters.training_views.views import RecordedViews, holdout_step
from adapters.uri import format_uri
from augment.cameras import Camera
from augment.errors import AdapterError, ClimateGSError, OutputError
from augment.files.scene_file import is_scene_folder
from augment.jobs.processes import OutputLock
from augment.reconstruct.config import FitConfig
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.scene import Scene
from tools.options import FitOptions, budget_s, length_of, parse_depth, resolved_uri
from tools.output import print_note
from tools.training import (
    CHECKPOINT_S,
    PLAN_FILE,
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

if TYPE_CHECKING:
    from augment.reconstruct.trainer import StepRecord, Trainer

EVALUATED = {"test": 6, "train": 3}  # views looked at during the run; all of them at its end
EVALUATED_WHEN_STOPPED = 12
REPORT_FILE = "report.json"
ROW_STEPS = 50  # steps averaged into one row of the history
HELD_OUT_KEY = "held_out"
MIN_OFFSET_S = 0.005  # of clocks: less moves a camera by centimetres at most, if it is real
SCORES = ("psnr", "ssim", "depth_median_m")  # of a row of the history
_HELD_OUT_SCHEMES = ("pandaset", "recording", "nuscenes", "kitti")
_AVERAGED = ("loss", "l1", "ssim", "depth", "sky")

# Of timing a run's first steps, whose number is chosen by the time that there is.
NOMINAL_STEPS = 5000  # of the run that the throw-away trainer believes to be the beginning of
UNTIMED = 3  # steps that compile kernels and touch new memory
MIN_TIMED, MAX_TIMED, MAX_TIMED_S = 8, 40, 10.0
RESERVE = 0.05  # of the time, for evaluations and checkpoints
MIN_PART = 0.2  # of the time, for steps, however long reading takes
# A step's time over a whole run, as a multiple of its first steps' where splats are added.
GROWTH = 1.25


def fit_scene(
    options: FitOptions,
    *,
    parts: FitParts | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    progress: bool = True,
) -> Outcome:
    """Fits, or goes on fitting, `options.scene` into `options.out`.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    folder = state_folder(options.out)
    _check_out(options, folder)
    with OutputLock(folder):
        before = None if options.overwrite else load_checkpoint(folder, arrays=False)
        if before is not None:
            check_same(options.out, options.settings(), length_of(options), before)
            if before.finished and (done := _finished(options, folder, before)) is not None:
                return done
        try:
            run = _prepare(options, parts or real_parts(options.device), folder, before)
        except BaseException:
            if not (folder / PLAN_FILE).exists():
                remove_unused(folder)
            raise
        return _run(run, checkpoint_s, progress)


def state_folder(out: Path) -> Path:
    """Where the checkpoint and the report of a scene folder lie: beside it."""
    out = out.resolve()
    if not out.name:
        raise OutputError(f"--out {out} is the file system's root: name a folder below it")
    return out.with_name(f"{out.name}.fit")


@dataclass(frozen=True)
class FitParts:
    """What a fit puts together, for tests to replace.

    open_scene(uri); views(scene, options); check(scene, source, options): both again, timed anew
    where the clocks disagree, sentences and facts; start(scene, source): with what no sensor gave;
    trainer(scene, source, config); score(scene, source, keys): means over the views, {"psnr",
    "ssim", ...}; save(scene, folder); report(folder, scene, source, history, facts): report.json's
    content.
    """

    open_scene: Callable[[str], Scene]
    views: Callable[[Scene, FitOptions], RecordedViews]
    start: Callable[[Scene, Any], Scene]
    trainer: Callable[[Scene, ViewSource, FitConfig], Trainer]
    score: Callable[[Scene, ViewSource, Sequence[ViewKey]], dict[str, float]]
    save: Callable[[Scene, Path], None]
    report: Callable[..., dict[str, Any]]
    check: Callable[[Scene, Any, FitOptions], Checked] = lambda scene, source, _: Checked(
        scene, source
    )


class Checked(NamedTuple):
    """Scene and views after images and LiDAR were compared, what was found, and facts of it."""

    scene: Scene
    source: RecordedViews
    problems: tuple[str, ...] = ()
    facts: Mapping[str, Any] = {}


def real_parts(device: str = "cpu") -> FitParts:
    """The library's own. device: where views are rendered during the fit."""
    from adapters.base import open_scene
    from adapters.training_views.starting_scene import starting_scene
    from augment.files.scene_file import save_scene
    from augment.reconstruct.trainer import Trainer
    from tools.fit_report import evaluate_views, mean_scores, write_report

    def score(scene: Scene, source: ViewSource, keys: Sequence[ViewKey]) -> dict[str, float]:
        means = mean_scores(evaluate_views(scene, source, keys, with_flip=False))
        return {name: means[name] for name in SCORES if name in means}

    return FitParts(
        open_scene=open_scene,
        views=_recorded_views,
        start=starting_scene,
        trainer=partial(Trainer, device=device),
        score=score,
        save=save_scene,
        report=write_report,
        check=_checked,
    )


def _checked(scene: Scene, source: Any, options: FitOptions) -> Checked:
    from adapters.training_views.checks import check_views, with_camera_times

    checks = check_views(scene, source)
    late_s = checks.time_offset_s
    if late_s is None or abs(late_s) < MIN_OFFSET_S:
        return Checked(scene, source, checks.problems, checks.facts)
    timed = with_camera_times(scene, late_s)
    sentence = (
        f"images fit the LiDAR best {abs(late_s) * 1e3:.0f} ms "
        f"{'after' if late_s > 0 else 'before'} their time stamps: every camera is taken to be "
        f"where it was then"
    )
    problems = (*checks.problems, sentence)
    return Checked(timed, _recorded_views(timed, options), problems, checks.facts)


def _recorded_views(scene: Scene, options: FitOptions) -> RecordedViews:
    return RecordedViews(
        scene,
        scale=options.scale,
        cameras=options.camera_names,
        holdout=options.holdout,
        cache_bytes=options.image_cache_mb * 2**20,
        depth=parse_depth(options.depth),
        masks_dir=options.ego_masks,
    )


@dataclass(frozen=True, eq=False)
class _Run:
    """All that fitting needs, opened and at the step to go on from."""

    options: FitOptions
    parts: FitParts
    folder: Path
    scene: Scene
    source: RecordedViews
    notes: tuple[str, ...]
    checks: Mapping[str, Any]
    trainer: Trainer
    plan: Checkpoint
    history: History


def _prepare(options: FitOptions, parts: FitParts, folder: Path, before: Checkpoint | None) -> _Run:
    scene, notes = open_to_fit(options, parts.open_scene)
    checked = parts.check(scene, parts.views(scene, options), options)
    source, notes = checked.source, (*notes, *checked.problems)
    scene = parts.start(checked.scene, source)
    for problem in _problems(scene, source, notes):
        print_note(f"note: {problem}")
    facts = _data_facts(scene, source)
    print_note(
        f"{len(source.train)} images to learn from, {len(source.test)} held out; "
        f"{facts['Gaussians to start from']} Gaussians and {len(scene.actors)} actors to start from"
    )
    if before is None:
        plan = Checkpoint(options.settings(), length_of(options), options.steps or 0, facts)
        if options.steps is None:
            plan = dataclasses.replace(plan, steps=_estimate(options, parts, scene, source))
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
        print_note(f"going on after step {plan.step} of {plan.steps}")
    history = History(plan.history, plan.sums, plan.seconds)
    plan = dataclasses.replace(plan, arrays={}, facts={})  # the trainer has them: free the memory
    return _Run(options, parts, folder, scene, source, notes, checked.facts, trainer, plan, history)


def _estimate(options: FitOptions, parts: FitParts, scene: Scene, source: RecordedViews) -> int:
    """Learning rates that decay need the number of steps before the first one."""
    budget = budget_s(options)
    assert budget is not None
    print_note("timing a few steps (kernels are compiled first where they are not yet) ...")
    steps, step_s = estimate_steps(
        lambda steps: parts.trainer(scene, source, options.config(steps)),
        budget,
        views=len(source.train),
        grows=options.densify != "none",
    )
    print_note(
        f"{1e3 * step_s:.0f} ms a step at the start: {steps} steps make about {budget / 60:g} "
        f"minutes. --steps {steps} gives the same scene again"
    )
    return steps


def estimate_steps(
    trainer: Callable[[int], Trainer],
    budget_s: float,
    *,
    views: int,
    grows: bool,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[int, float]:
    """The number of steps that fill the time, and median seconds of a first step without its
    image's, by a trainer that is thrown away.

    trainer: makes one for a number of steps. views: that are learnt from; each costs more the first
    time, when its image is read. What is measured here is not taken off the time to optimise.
    """
    fitter = trainer(NOMINAL_STEPS)
    for _ in range(UNTIMED):
        fitter.run_step()
    loads: list[float] = []
    others: list[float] = []
    begun = clock()
    while len(others) < MIN_TIMED or (len(others) < MAX_TIMED and clock() - begun < MAX_TIMED_S):
        before = clock()
        load_s = fitter.run_step().stage_s.get("load", 0.0)
        loads.append(load_s)
        others.append(clock() - before - load_s)
    step_s = max(statistics.median(others), 1e-6)
    left_s = max(budget_s * (1 - RESERVE) - views * statistics.median(loads), MIN_PART * budget_s)
    return rounded_steps(int(left_s / (step_s * (GROWTH if grows else 1.0)))), step_s


@dataclass
class History:
    """Rows of averages and evaluations, and the sums of the steps since the last row.

    seconds: spent in earlier runs; what is spent now counts from the moment this is made.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    sums: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    _begun: float = field(default_factory=time.perf_counter)

    def spent_s(self) -> float:
        return self.seconds + time.perf_counter() - self._begun

    def add(self, record: StepRecord) -> None:
        """One more step; a row where it completes one."""
        values = {name: float(getattr(record, name)) for name in _AVERAGED}
        values |= {f"stage_s.{stage}": float(s) for stage, s in record.stage_s.items()}
        for name, value in {"count": 1.0, **values}.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        if record.step % ROW_STEPS == 0:
            means = self.means()
            self.rows.append({
                "step": int(record.step),
                "seconds": self.spent_s(),
                **{name: means[name] for name in _AVERAGED},
                "splats": int(record.splats),
                "stage_s": {n[8:]: v for n, v in means.items() if n.startswith("stage_s.")},
            })  # fmt: skip
            self.sums = {}

    def means(self) -> dict[str, float]:
        """Averages over the steps since the last row."""
        count = self.sums.get("count", 1.0)
        return {name: total / count for name, total in self.sums.items() if name != "count"}

    def add_scores(self, step: int, scores: Mapping[str, Mapping[str, float]]) -> None:
        """An evaluation's, by split."""
        for split, numbers in scores.items():
            self.rows.append({"step": step, "seconds": self.spent_s(), "split": split, **numbers})

    def shown(self, record: StepRecord) -> dict[str, str]:
        """For the progress bar: the mean loss, and the PSNR of the latest evaluation, of held-out
        views where there are any.
        """
        shown = {"loss": f"{self.means().get('loss', record.loss):.4f}"}
        latest = {row["split"]: row["psnr"] for row in self.rows if "psnr" in row}
        for split, title in (("test", "held-out PSNR"), ("train", "PSNR")):
            if split in latest:
                return {**shown, title: f"{latest[split]:.2f}"}
        return shown


def _run(run: _Run, checkpoint_s: float, progress: bool) -> Outcome:
    begun = time.perf_counter()
    trainer, history = run.trainer, run.history
    keys = {
        split: sample_keys(getattr(run.source, split), count) for split, count in EVALUATED.items()
    }

    def evaluate() -> None:
        scene = trainer.scene()
        scores = {s: run.parts.score(scene, run.source, k) for s, k in keys.items() if k}
        history.add_scores(trainer.step, scores)

    def after_step(record: StepRecord, is_evaluated: bool) -> dict[str, str]:
        _check_finite(record)
        history.add(record)
        if is_evaluated:
            evaluate()
        return history.shown(record)

    with StopRequest() as stop:
        if trainer.step == 0 and not history.rows:
            evaluate()
        complete = run_steps(
            trainer,
            run.plan.steps,
            after_step=after_step,
            save=lambda: save_checkpoint(run.folder, _checkpoint(run)),
            stop=stop,
            name="fit",
            checkpoint_s=checkpoint_s,
            progress=progress,
        )
        print_note(f"writing {run.options.out} and evaluating all views")
        report = _write(run, complete, time.perf_counter() - begun)
    if complete:
        mark_finished(run.folder)
        return Outcome(0, report)
    note_stop(trainer.step, run.plan.steps, overwrite=run.options.overwrite)
    return Outcome(130, report)


def _check_finite(record: StepRecord) -> None:
    if not math.isfinite(record.loss):
        raise ClimateGSError(
            f"the loss became {record.loss} in step {record.step} (frame {record.key.frame}, "
            f"camera {record.key.camera!r}): expected a finite number. Look at that image and its "
            f"depth priors, or fit without its camera (--cameras)"
        )


def sample_keys(keys: Sequence[ViewKey], count: int) -> tuple[ViewKey, ...]:
    """At most `count` of the views: cameras in turn, spread over the drive."""
    by_camera: dict[str, list[ViewKey]] = {}
    for key in keys:
        by_camera.setdefault(key.camera, []).append(key)
    cameras = list(by_camera.values())
    chosen: dict[ViewKey, None] = {}
    for i in range(min(count, len(keys))):
        views = cameras[i % len(cameras)]
        chosen[views[int((i + 0.5) / count * len(views))]] = None
    return tuple(chosen)


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
        from tools.fit_report import truth_facts, truth_line

        facts["truth"] = truth_facts(options.truth, scene, run.source)
        print_note(truth_line(facts["truth"]))
    report = run.parts.report(_report_folder(run.folder), scene, source, run.history.rows, facts)
    _show_end(options.out, run.folder)
    return report


def _problems(scene: Scene, source: RecordedViews, notes: tuple[str, ...]) -> tuple[str, ...]:
    """Every sentence once; loading views may have added some since they were opened."""
    return tuple(dict.fromkeys((*scene.problems, *source.problems, *notes)))


def _report_folder(folder: Path) -> Path:
    return folder / "report"


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


def _finished(options: FitOptions, folder: Path, before: Checkpoint) -> Outcome | None:
    """The outcome where scene and report stand; None where one of them was lost since."""
    try:
        facts = json.loads((_report_folder(folder) / REPORT_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    if not is_scene_folder(options.out):
        return None
    print(f"{options.out} is finished already ({before.steps} steps); nothing was done")
    _show_end(options.out, folder)
    return Outcome(0, facts)


def _show_end(out: Path, folder: Path) -> None:
    folder = _report_folder(folder)
    table = folder / "report.md"
    if table.is_file():
        print("\n".join(line for line in table.read_text().splitlines() if line.startswith("|")))
    for path in sorted((*folder.glob("*.jpg"), *folder.glob("*.png"), *folder.glob("*.md"))):
        print(f"{path.stem.replace('_', ' ')}: {path}")
    print(f"scene: {out}")
    print(f"render it: climategs render dense-fog --scene 'scene:{out}' --out out/fog")


# ---- What a reconstruction learns from, with nothing of the held-out frames in it ----------------


def open_to_fit(
    options: FitOptions, open_scene: Callable[[str], Scene]
) -> tuple[Scene, tuple[str, ...]]:
    """The scene to start from, and a sentence if held-out frames may have gone into it.

    Raises:
        AdapterError: as open_scene. ClimateGSError: nothing recorded to learn from, or a URI that
            holds out frames itself.
    """
    scheme, path, query = resolved_uri(options.scene)
    if HELD_OUT_KEY in query:
        raise ClimateGSError(
            f"{options.scene}: leave {HELD_OUT_KEY}={query[HELD_OUT_KEY]} out of the URI; "
            f"--holdout says which frames are held out, of the scene and of the views alike"
        )
    step = holdout_step(options.holdout)
    if step is None or not _can_hold_out(scheme, path):
        scene = open_scene(format_uri(scheme, path, query))
        _check_recorded(scene)
        warning = f"{scheme} scenes cannot be built without them"
        return scene, () if step is None else (_seen(options.holdout, warning),)
    first = query.get("frames", "").partition(":")[0]
    guess = f"{(int(first) if first.isdigit() else 0) + step - 1}::{step}"
    try:
        scene = open_scene(format_uri(scheme, path, {**query, HELD_OUT_KEY: guess}))
    except AdapterError:  # the guess may have held out all frames; another reason comes again
        scene, guess = open_scene(format_uri(scheme, path, query)), None
    _check_recorded(scene)
    numbers = [frame.index for frame in scene.frames]
    better = held_out_range(numbers, step)
    if better is None and len(numbers) >= step:
        warning = "their numbers are at uneven steps"
        return scene, (_seen(options.holdout, warning),)
    if better is not None and (guess is None or _held(better, numbers) != _held(guess, numbers)):
        scene = open_scene(format_uri(scheme, path, {**query, HELD_OUT_KEY: better}))
    return scene, ()


def _can_hold_out(scheme: str, path: str) -> bool:
    """Whether such a scene can be built without some of its frames."""
    if scheme == "street_gaussians":
        from adapters.street_gaussians.model import is_dataset

        return is_dataset(Path(path))
    return scheme in _HELD_OUT_SCHEMES


def _check_recorded(scene: Scene) -> None:
    """Refuse a scene that no camera has recorded, and say how to record it.

    Raises:
        ClimateGSError: it has no images.
    """
    if any(frame.image_paths for frame in scene.frames):
        return
    from augment.jobs.layout import folder_name, variant_name
    from recipes.load import load_recipe

    folder = f"raw/{folder_name(scene.name)}/{variant_name(load_recipe('clear').resolve(0))}"
    raise ClimateGSError(
        f"{scene.source} has no recorded images, so there is nothing to fit it to. Render it "
        f"first, then fit what was rendered:\n"
        f"  climategs render clear --scene '{scene.source}' --out raw\n"
        f"  climategs fit recording:{folder} --out fitted"
    )


def held_out_range(numbers: Sequence[int], step: int) -> str | None:
    """start::step over frame numbers for the frames at positions step - 1, 2 step - 1, ...; None
    where there are none, or no such range holds just them.
    """
    held = list(numbers[step - 1 :: step])
    if not held:
        return None
    stride = held[1] - held[0] if len(held) > 1 else max(numbers) - held[0] + 1
    text = f"{held[0]}::{stride}"
    return text if _held(text, numbers) == held else None


def _held(held_out: str, numbers: Sequence[int]) -> list[int]:
    """The frame numbers that start::step holds out."""
    start, _, step = held_out.split(":")
    return [n for n in numbers if n >= int(start) and (n - int(start)) % int(step) == 0]


def _data_facts(scene: Scene, source: ViewSource) -> dict[str, Any]:
    """What was found in the data, to notice when it is no longer the same."""
    digest = hashlib.sha256()
    for key in (*source.train, *source.test):
        camera = source.camera(key)
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((key.frame, key.camera, camera.timestamp_ns, numbers)).encode())
        digest.update(camera.camera_from_world.numpy().tobytes())
    return {
        "frames": len(scene.frames),
        "train views": len(source.train),
        "held-out views": len(source.test),
        "Gaussians to start from": sum(map(len, scene.all_gaussians)),
        "actors": len(scene.actors),
        "cameras' poses (SHA-256)": digest.hexdigest(),
    }


@dataclass(frozen=True)
class FewerTestViews:
    """A ViewSource of which only some views are held out, to be evaluated sooner."""

    source: ViewSource
    test: tuple[ViewKey, ...]

    @property
    def train(self) -> tuple[ViewKey, ...]:
        return self.source.train

    def camera(self, key: ViewKey) -> Camera:
        return self.source.camera(key)

    def load(self, key: ViewKey) -> RecordedView:
        return self.source.load(key)


def _seen(holdout: str, reason: str) -> str:
    return (
        f"--holdout {holdout} keeps frames from the optimiser, not from what it starts with, since "
        f"{reason}: figures on held-out views may be too good"
    )
