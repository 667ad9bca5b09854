"""`climategs fit`: recorded images, LiDAR and boxes become a scene of Gaussians.

OUT is the scene; OUT.fit beside it holds the checkpoint and the report. The scene's bytes depend on
the data, the settings and the number of steps alone; times are in OUT.fit only.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapters.base import open_scene
from adapters.datasets import DATASETS
from adapters.recorded_lenses import undistorted_scene, with_lenses_of
from adapters.training_views.checks import check_views, with_camera_times
from adapters.training_views.starting_scene import complete_starting_scene
from adapters.training_views.views import RecordedViews, holdout_step
from adapters.uri import format_uri
from augment.errors import AdapterError, ClimateGSError
from augment.files.scene_file import is_scene_folder, save_scene
from augment.photo.trust import judge_scene
from augment.reconstruct.trainer import StepRecord, Trainer
from augment.reconstruct.view import ViewKey, ViewSource
from augment.scene.cameras import Frame
from augment.scene.scene import Scene
from tools.fit_report import evaluate_views, mean_scores, truth_facts, truth_line, write_report
from tools.options import FitOptions, parse_depth, resolved_uri
from tools.output import check_scene_out, path_beside, print_note
from tools.training import (
    CHECKPOINT_S,
    PLAN_FILE,
    REPORT_FILE,
    RESERVE,
    Checkpoint,
    Outcome,
    Training,
    open_training,
    rounded_steps,
    run_training,
    train,
)

EVALUATED = {"test": 6, "train": 3}  # views looked at during the run; all of them at its end
EVALUATED_WHEN_STOPPED = 12
ROW_STEPS = 50  # steps averaged into one row of the history
HELD_OUT_KEY = "held_out"
MIN_OFFSET_S = 0.005  # of clocks: less moves a camera by centimetres at most, if it is real
SCORES = ("psnr", "ssim", "depth_median_m")  # of a row of the history
_AVERAGED = ("loss", "l1", "ssim", "depth", "sky")

# Of timing a run's first steps, whose number is chosen by the time that there is.
NOMINAL_STEPS = 5000  # of the run that the throw-away trainer believes to be the beginning of
UNTIMED = 3  # steps that compile kernels and touch new memory
MIN_TIMED = 8  # the number of steps that are timed at least
MAX_TIMED = 40  # the number of steps that are timed at most
MAX_TIMED_S = 10.0  # the time after which no further step is timed, in seconds
MIN_PART = 0.2  # of the time, for steps, however long reading takes
# A step's time over a whole run, as a multiple of its first steps' where splats are added.
GROWTH = 1.25


def fit_scene(
    options: FitOptions, *, checkpoint_s: float = CHECKPOINT_S, progress: bool = True
) -> Outcome:
    """Fits, or goes on fitting, `options.scene` into `options.out`.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    folder = state_folder(options.out)
    check_scene_out(
        options.out,
        may_replace=options.overwrite or (folder / PLAN_FILE).is_file(),
        why=f", and there is no {folder} to go on from",
    )

    return train(
        options,
        folder,
        folder,
        report=_report_folder(folder) / REPORT_FILE,
        stands=lambda: is_scene_folder(options.out),
        show=lambda _: _show_end(options.out, folder),
        prepare=lambda before: _prepare(options, folder, before),
        run=lambda run: _run(run, checkpoint_s, progress),
    )


def state_folder(out: Path) -> Path:
    """Folder of a scene's checkpoint and report, which lies beside the scene's own."""
    return path_beside(out, ".fit")


@dataclass(frozen=True, eq=False)
class _Run:
    """All that fitting needs, opened and at the step to go on from."""

    options: FitOptions
    training: Training
    scene: Scene
    source: RecordedViews
    notes: tuple[str, ...]
    checks: dict[str, Any]
    recorded_frames: tuple[Frame, ...] | None
    """Frames with the lenses that the fitted scene gets; None for a scene of pinholes."""

    def problems(self) -> list[str]:
        """Every sentence once; loading views may have added some since they were opened."""
        return list(dict.fromkeys((*self.scene.problems, *self.source.problems, *self.notes)))


def _prepare(options: FitOptions, folder: Path, before: Checkpoint | None) -> _Run:
    opened_scene, notes = open_to_fit(options)
    scene = undistorted_scene(opened_scene)
    recorded_frames = None if scene is opened_scene else opened_scene.frames
    source = _recorded_views(scene, options)
    checks = check_views(scene, source)
    notes = (*notes, *checks.problems)
    late_s = checks.time_offset_s
    if late_s is not None and abs(late_s) >= MIN_OFFSET_S:
        scene = with_camera_times(scene, late_s)
        source = _recorded_views(scene, options)
        sentence = (
            f"images fit the LiDAR best {abs(late_s) * 1e3:.0f} ms "
            f"{'after' if late_s > 0 else 'before'} their time stamps: every camera is taken to be "
            f"where it was then"
        )
        notes = (*notes, sentence)
    scene = complete_starting_scene(scene, source)
    for problem in dict.fromkeys((*scene.problems, *source.problems, *notes)):
        print_note(f"note: {problem}")
    facts = _data_facts(scene, source)
    print_note(
        f"{len(source.train)} images to learn from, {len(source.test)} held out; "
        f"{facts['Gaussians to start from']} Gaussians and {len(scene.actors)} actors to start from"
    )

    def trainer(steps: int) -> Trainer:
        return Trainer(scene, source, options, steps, device=options.device)

    def estimate(budget_s: float) -> tuple[int, float]:
        print_note("timing a few steps (kernels are compiled first where they are not yet) ...")
        grows = options.densify != "none"
        return estimate_steps(trainer, budget_s, views=len(source.train), grows=grows)

    training = open_training(
        options,
        folder,
        before,
        facts,
        trainer=trainer,
        estimate=estimate,
        result="scene",
        changed=f"{options.scene} is not what {options.out} was fitted to so far",
    )
    facts_of_checks = dict(checks.report_facts)
    return _Run(options, training, scene, source, notes, facts_of_checks, recorded_frames)


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

    views: that are learnt from; each costs more the first time, when its image is read. What is
    measured here is not taken off the time to optimise.
    """
    fitter = trainer(NOMINAL_STEPS)
    for _ in range(UNTIMED):
        fitter.run_step()
    loads: list[float] = []
    steps_s: list[float] = []
    start_s = clock()
    while len(steps_s) < MIN_TIMED or (
        len(steps_s) < MAX_TIMED and clock() - start_s < MAX_TIMED_S
    ):
        step_start_s = clock()
        load_s = fitter.run_step().stage_s.get("load", 0.0)
        loads.append(load_s)
        steps_s.append(clock() - step_start_s - load_s)
    step_s = max(statistics.median(steps_s), 1e-6)
    left_s = max(budget_s * (1 - RESERVE) - views * statistics.median(loads), MIN_PART * budget_s)
    return rounded_steps(int(left_s / (step_s * (GROWTH if grows else 1.0)))), step_s


def _run(run: _Run, checkpoint_s: float, progress: bool) -> Outcome:
    training = run.training
    source = run.source
    keys = {split: sample_keys(getattr(source, split), n) for split, n in EVALUATED.items()}

    def score() -> None:
        scene = training.trainer.scene()
        for split, views in keys.items():
            if views:
                means = mean_scores(evaluate_views(scene, source, views, with_flip=False))
                scores = {name: means[name] for name in SCORES if name in means}
                training.add_row(split=split, **scores)

    def add(record: StepRecord) -> None:
        if not math.isfinite(record.loss):
            raise ClimateGSError(
                f"the loss became {record.loss} in step {record.step} (frame {record.key.frame}, "
                f"camera {record.key.camera!r}): expected a finite number. Look at that image and "
                f"its depth priors, or fit without its camera (--cameras)"
            )
        _add_step(training, record)

    def postfix(record: StepRecord) -> dict[str, str]:
        loss = _means(training.sums).get("loss", record.loss)
        latest = {row["split"]: row["psnr"] for row in training.rows if "psnr" in row}
        titles = {"test": "held-out PSNR", "train": "PSNR"}  # held-out views where there are any
        psnr = next(({t: f"{latest[s]:.2f}"} for s, t in titles.items() if s in latest), {})
        return {"loss": f"{loss:.4f}", **psnr}

    return run_training(
        training,
        "fit",
        add=add,
        score=score,
        postfix=postfix,
        write=lambda complete: _write(run, complete),
        checkpoint_s=checkpoint_s,
        progress=progress,
    )


def _add_step(training: Training, record: StepRecord) -> None:
    """Add a step to the sums, and a row to the history where the step completes one."""
    values = {name: float(getattr(record, name)) for name in _AVERAGED}
    values |= {f"stage_s.{stage}": float(s) for stage, s in record.stage_s.items()}
    training.add({"count": 1.0, **values})
    if record.step % ROW_STEPS == 0:
        means = _means(training.sums)
        stages = {n[8:]: v for n, v in means.items() if n.startswith("stage_s.")}
        averages = {name: means[name] for name in _AVERAGED}
        training.add_row(**averages, splats=int(record.splats), stage_s=stages)
        training.sums = {}


def _means(sums: dict[str, float]) -> dict[str, float]:
    """Averages over the steps since the last row."""
    count = sums.get("count", 1.0)
    return {name: total / count for name, total in sums.items() if name != "count"}


def sample_keys(keys: Sequence[ViewKey], count: int) -> tuple[ViewKey, ...]:
    """At most `count` of the views: cameras in turn, spread over the drive."""
    by_camera: dict[str, list[ViewKey]] = {}
    for key in keys:
        by_camera.setdefault(key.camera, []).append(key)
    cameras = list(by_camera.values())
    sample: dict[ViewKey, None] = {}
    for i in range(min(count, len(keys))):
        views = cameras[i % len(cameras)]
        sample[views[int((i + 0.5) / count * len(views))]] = None
    return tuple(sample)


def _write(run: _Run, complete: bool) -> dict[str, Any]:
    options = run.options
    training = run.training
    print_note(f"writing {options.out} and evaluating all views")
    plan = training.plan
    step = training.trainer.step
    made_by = {"command": "fit", "step": step, "steps": plan.steps}
    made_by |= {"settings": plan.settings, "data": plan.data, "fitted": _fitted(run)}
    scene = dataclasses.replace(training.trainer.scene(), made_by=made_by)
    recorded_frames = run.recorded_frames
    stored_scene = scene if recorded_frames is None else with_lenses_of(scene, recorded_frames)
    save_scene(stored_scene, options.out.absolute())
    trust = judge_scene(scene, scale=options.scale)
    for problem in trust.problems:
        print_note(f"not fit for weather: {problem}")
    facts: dict[str, Any] = {
        "scene": options.scene,
        "complete": complete,
        "step": step,
        "steps": plan.steps,
        "seconds": training.seconds(),
        "seconds_of_this_run": training.seconds() - plan.seconds,
        "data": plan.data,
        "settings": plan.settings,
        "problems": run.problems(),
        "checks": run.checks,
        "trust": trust.as_dict(),
    }
    source = run.source
    test = run.source.test
    if not complete and len(test) > EVALUATED_WHEN_STOPPED:  # someone waits for the end
        test = sample_keys(test, EVALUATED_WHEN_STOPPED)
        facts["problems"].append(
            f"the run was stopped: figures are of {len(test)} of the {len(source.test)} held-out "
            f"views"
        )
    if options.truth is not None:
        facts["truth"] = truth_facts(options.truth, scene, source)
        print_note(truth_line(facts["truth"]))
    folder = _report_folder(training.folder)
    report = write_report(folder, scene, source, training.rows, facts, test=test)
    _show_end(options.out, training.folder)
    return report


def _fitted(run: _Run) -> dict[str, Any]:
    """Scale and views that a fit learns from, as augment.photo.trust.FitRecord."""
    views: dict[str, list[int]] = {}
    for key in run.source.train:
        views.setdefault(key.camera, []).append(key.frame)
    return {"scale": run.options.scale, "views": views}


def _report_folder(folder: Path) -> Path:
    return folder / "report"


def _show_end(out: Path, folder: Path) -> None:
    folder = _report_folder(folder)
    table = folder / "report.md"
    if table.is_file():
        print("\n".join(line for line in table.read_text().splitlines() if line.startswith("|")))
    for path in sorted((*folder.glob("*.jpg"), *folder.glob("*.png"), *folder.glob("*.md"))):
        print(f"{path.stem.replace('_', ' ')}: {path}")
    print(f"scene: {out}")
    print(f"render it: climategs render dense-fog --scene 'scene:{out}' --out out/fog")


def open_to_fit(options: FitOptions) -> tuple[Scene, tuple[str, ...]]:
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
        scene = open_scene(format_uri(scheme, path, query))
        guess = None
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
    """True if such a scene can be built without some of its frames."""
    if scheme == "street_gaussians":
        from adapters.street_gaussians.model import is_dataset

        return is_dataset(Path(path))
    return scheme in DATASETS and DATASETS[scheme].is_raw


def _check_recorded(scene: Scene) -> None:
    """Refuse a scene that no camera has recorded, and say how to record it.

    Raises:
        ClimateGSError: it has no images.
    """
    if any(frame.image_paths for frame in scene.frames):
        return
    from augment.output.layout import variant_name
    from augment.output.names import folder_name
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
    test_frames = list(numbers[step - 1 :: step])
    if not test_frames:
        return None
    stride = (
        test_frames[1] - test_frames[0]
        if len(test_frames) > 1
        else max(numbers) - test_frames[0] + 1
    )
    text = f"{test_frames[0]}::{stride}"
    return text if _held(text, numbers) == test_frames else None


def _held(held_out: str, numbers: Sequence[int]) -> list[int]:
    """The frame numbers that start::step holds out."""
    start, _, step = held_out.split(":")
    return [n for n in numbers if n >= int(start) and (n - int(start)) % int(step) == 0]


def _data_facts(scene: Scene, source: ViewSource) -> dict[str, Any]:
    """Counts and a digest of the data, by which a change of the data is noticed."""
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


def _seen(holdout: str, reason: str) -> str:
    return (
        f"--holdout {holdout} keeps frames from the optimiser, not from what it starts with, since "
        f"{reason}: figures on held-out views may be too good"
    )
