"""The training loop of `fit`, and its checkpoints.

A training runs until its last step or a signal. It goes on from a checkpoint to the same bits.

A checkpoint is a file `fit.json` and a file of arrays, which `fit.json` names with its checksum.
`fit.json` is written last and replaced in one step. So a kill at any moment leaves a complete
checkpoint: the new one or the one before.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from augment.errors import OutputError
from augment.jobs.processes import OutputLock
from augment.output.atomic import (
    flush_folder,
    make_folder,
    raise_output_error,
    remove_temporaries,
    temporary_path,
    write_atomic,
)
from augment.output.names import STATE_FOLDER
from augment.progress import ProgressBar
from tools.options import length_of
from tools.output import print_note

EVALUATIONS = 10
CHECKPOINT_S = 120.0
RESERVE = 0.05  # of the time, for evaluations and checkpoints
VERSION = 4
PLAN_FILE = "fit.json"  # the checkpoint's settings, history and names of arrays
REPORT_FILE = "report.json"  # the report of a training, for programs
_STATES = "state-*.safetensors"
_STOPPING = b"\nstopping after this step; interrupt again to stop at once\n"


@dataclass(frozen=True)
class Outcome:
    """The result of a training.

    code: the command's exit code, 130 if it was interrupted. report: the content of report.json.
    """

    code: int
    report: dict[str, Any]


def train(
    options: Any,
    folder: Path,
    locked: Path,
    *,
    report: Path,
    stands: Callable[[], bool],
    show: Callable[[dict[str, Any]], None],
    prepare: Callable[[Checkpoint | None], Any],
    run: Callable[[Any], Outcome],
) -> Outcome:
    """Begin a training, or go on from the checkpoint in `folder`, while no other process does.

    locked: the folder that holds the lock. report, stands(), show(report): of a finished training,
    where its report lies, whether its result is there, and what is printed. prepare(before): what
    `run` takes; None of a new training.

    Raises:
        OutputError: it was begun with other settings, or is being run.
    """
    with OutputLock(locked):
        before = None if options.overwrite else load_checkpoint(folder, arrays=False)
        if before is not None:
            _check_same(options, before)
            if before.finished and stands():
                with contextlib.suppress(OSError, ValueError):  # lost since: it is written again
                    facts = json.loads(report.read_bytes())
                    steps = f"{before.steps} steps"
                    print(f"{options.out} is finished already ({steps}); nothing was done")
                    show(facts)
                    return Outcome(0, facts)
        try:
            prepared = prepare(before)
        except BaseException:
            if not (folder / PLAN_FILE).exists():  # leave no trace of a run that never began
                shutil.rmtree(locked / STATE_FOLDER, ignore_errors=True)
                with contextlib.suppress(OSError):  # not empty
                    locked.rmdir()
            raise
        return run(prepared)


@dataclass(eq=False)
class Training:
    """A trainer at the step to go on from, and its history: rows, and sums since the last row."""

    options: Any
    folder: Path
    trainer: Any
    plan: Checkpoint
    rows: list[dict[str, Any]]
    sums: dict[str, float]
    begun: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        """Return the seconds spent so far, in earlier runs too."""
        return self.plan.seconds + time.perf_counter() - self.begun

    def add(self, values: Mapping[str, float]) -> None:
        """Add numbers to the sums."""
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def add_row(self, **values: Any) -> None:
        """Add a row to the history, at the trainer's step."""
        self.rows.append({"step": int(self.trainer.step), "seconds": self.seconds(), **values})

    def save(self) -> Checkpoint:
        """Save a checkpoint, which does not change what is learnt. Return what its JSON holds."""
        arrays, facts = self.trainer.state()
        step = self.trainer.step
        seconds = self.seconds()
        state = {"step": step, "seconds": seconds, "history": self.rows, "sums": self.sums}
        state |= {"facts": facts, "arrays": arrays}
        return save_checkpoint(self.folder, self.plan.model_copy(update=state))


def open_training(
    options: Any,
    folder: Path,
    before: Checkpoint | None,
    data: dict[str, Any],
    *,
    trainer: Callable[[int], Any],
    estimate: Callable[[float], tuple[int, float]],
    result: str,
    changed: str,
) -> Training:
    """Return a new training, or the one whose checkpoint is in `folder`.

    trainer: makes one for a number of steps: learning rates that decay need it before the first
    one. estimate(budget_s): the number of steps that fill the time, and seconds of one. result,
    changed: what is made, and what data is not the same, for messages.

    Raises:
        OutputError: the data is not what the checkpoint was made from.
    """
    if before is None:
        steps = options.steps
        if steps is None:
            minutes = length_of(options)["minutes"]
            steps, step_s = estimate(60 * minutes)
            print_note(
                f"{1e3 * step_s:.0f} ms a step at the start: {steps} steps make about {minutes:g} "
                f"minutes. --steps {steps} gives the same {result} again"
            )
        plan = Checkpoint(
            settings=options.settings(), length=length_of(options), steps=steps, data=data
        )
        save_checkpoint(folder, plan)  # in place of what --overwrite gives up
    else:
        plan = load_checkpoint(folder)
        assert plan is not None
        if differing := _differences(plan.data, data):
            raise OutputError(
                f"{changed}: {'; '.join(differing)}. Begin anew with --overwrite, or choose "
                f"another --out"
            )
    new_trainer = trainer(plan.steps)
    if plan.arrays:
        new_trainer.load_state(plan.arrays, plan.facts)
        print_note(f"going on after step {plan.step} of {plan.steps}")
    rows = list(plan.history)
    sums = dict(plan.sums)
    plan = plan.model_copy(update={"arrays": {}, "facts": {}})  # the trainer has them
    return Training(options, folder, new_trainer, plan, rows, sums)


def run_training(
    training: Training,
    name: str,
    *,
    add: Callable[[Any], None],
    score: Callable[[], None],
    postfix: Callable[[Any], Mapping[str, str]],
    write: Callable[[bool], dict[str, Any]],
    checkpoint_s: float = CHECKPOINT_S,
    progress: bool = True,
) -> Outcome:
    """Run steps until the plan's last step, or until a stop is requested.

    add(record): of every step. score(): adds rows to the history, about EVALUATIONS times.
    postfix(record): for the progress bar. write(complete): the result; returns the report.
    """
    trainer = training.trainer
    steps = training.plan.steps
    scored_steps = evaluation_steps(steps)
    save_s = time.monotonic()
    with StopRequest() as stop:
        if trainer.step == 0 and not training.rows:
            score()
        with ProgressBar(
            total=steps, initial=trainer.step, desc=name, unit="step", disable=not progress
        ) as bar:
            while trainer.step < steps and not stop.requested:
                record = trainer.run_step()
                add(record)
                if record.step in scored_steps:
                    score()
                bar.set_postfix(postfix(record), refresh=False)
                bar.update(record.step - bar.n)
                if time.monotonic() - save_s > checkpoint_s and record.step < steps:
                    training.save()
                    save_s = time.monotonic()
        checkpoint = training.save()
        complete = trainer.step >= steps
        report = write(complete)
    if complete:
        _write_plan(training.folder, checkpoint.model_copy(update={"finished": True}))
        return Outcome(0, report)
    overwrite = training.options.overwrite
    command_text = "the same command without --overwrite" if overwrite else "the same command"
    print_note(f"stopped after step {trainer.step} of {steps}; {command_text} goes on from there")
    return Outcome(130, report)


def evaluation_steps(steps: int) -> frozenset[int]:
    """Return about EVALUATIONS evenly spaced steps of a run, with the last step."""
    return frozenset(max(1, round(steps * i / EVALUATIONS)) for i in range(1, EVALUATIONS + 1))


def rounded_steps(steps: int) -> int:
    """Round a number of steps: at least 1, and a multiple of 50 where it has hundreds."""
    return max(1, steps if steps < 100 else steps // 50 * 50)


class StopRequest:
    """While entered, the first Ctrl-C or SIGTERM only sets `requested`; the second interrupts.

    Signals are Python's main thread's; elsewhere nothing is caught.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:  # `nohup`, or a script's background
                    self._before[number] = signal.signal(number, self._catch)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _catch(self, _number: int, _frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt("stopped at once; what the last checkpoint holds is kept")
        self.requested = True
        os.write(2, _STOPPING)  # print could meet a half-written line of its own


class Checkpoint(BaseModel):
    """A training after `step` of `steps` steps, as `fit.json` stores it, and its arrays.

    settings, length: the settings and the length that the user chose.
    steps, step: the number of all steps, and of the steps so far.
    data: facts about the recorded data.
    finished: True if the result and its report are written.
    seconds: the time spent so far.
    history: the rows so far. sums: sums over the steps since the last row.
    facts, arrays: the trainer's state. Before the first step there are no arrays.
    state: the file of the arrays and its SHA-256.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int = VERSION
    settings: dict[str, Any]
    length: dict[str, Any]
    steps: int
    data: dict[str, Any]
    step: int = Field(default=0, ge=0)
    finished: bool = False
    seconds: float = 0.0
    history: list[dict[str, Any]] = []
    sums: dict[str, float] = {}
    facts: dict[str, Any] = {}
    state: State | None = None
    arrays: dict[str, Any] = Field(default={}, exclude=True)


class State(BaseModel):
    """The file of a checkpoint's arrays, and its SHA-256.

    `file` is a name without a folder, so that nothing outside the checkpoint's folder is read.
    """

    file: str = Field(pattern=r"^[^/\\]+$")
    sha256: str


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Checkpoint:
    """Replace the folder's checkpoint. Return the content of its JSON file.

    Raises:
        OutputError: the system refused; the checkpoint before is then as it was.
    """
    state = None
    if checkpoint.arrays:
        name = f"state-{checkpoint.step:07d}.safetensors"
        state = State(file=name, sha256=_write_state(folder / name, checkpoint.arrays))
    plan = checkpoint.model_copy(update={"state": state, "arrays": {}})
    _write_plan(folder, plan)
    remove_temporaries(folder, recursive=False)
    # What killed runs left half-written, too; safetensors has temporary names of its own.
    for path in (*folder.glob(_STATES), *folder.glob(".tmp*")):
        if state is None or path.name != state.file:
            with raise_output_error(path):
                path.unlink(missing_ok=True)
    return plan


def _check_same(options: Any, before: Checkpoint) -> None:
    """Refuse to go on with what was begun with other settings or another length; name them all."""
    settings = options.settings()
    length = length_of(options)
    changed = _differences(before.settings, settings)
    if length != before.length and length.get("steps") != before.steps:
        was, now = (" ".join(f"--{n} {v:g}" for n, v in a.items()) for a in (before.length, length))
        changed.append(f"its length was {was} ({before.steps} steps), now {now}")
    if changed:
        raise OutputError(
            f"{options.out} was begun with other settings: {'; '.join(changed)}. Choose another "
            f"--out, or begin anew with --overwrite"
        )


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return every setting that differs as text: `scale was 0.25, now 0.5`."""
    return [
        f"{name} was {before.get(name)}, now {now.get(name)}"
        for name in dict.fromkeys([*before, *now])
        if before.get(name) != now.get(name)
    ]


def load_checkpoint(folder: Path, *, arrays: bool = True) -> Checkpoint | None:
    """Load the folder's checkpoint; None if there is none. arrays: False leaves them on disk.

    Raises:
        OutputError: a file of it is missing, damaged, or of another version.
    """
    path = folder / PLAN_FILE
    if not path.is_file():
        return None
    try:
        plan = json.loads(path.read_bytes())
        version = plan.get("version") if isinstance(plan, dict) else None
        if version != VERSION:
            raise OutputError(
                f"{path} is of version {version}, this program writes {VERSION}: choose another "
                f"--out, or begin anew with --overwrite"
            )
        checkpoint = Checkpoint.model_validate(plan)
    except OSError as error:
        raise OutputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # no JSON, or other fields
        raise _damaged(path, str(error)) from error
    if not (arrays and checkpoint.state):
        return checkpoint
    return checkpoint.model_copy(update={"arrays": _read_state(folder, checkpoint.state)})


def _write_plan(folder: Path, plan: Checkpoint) -> None:
    write_atomic(folder / PLAN_FILE, (json.dumps(plan.model_dump(), indent=1) + "\n").encode())


def _read_state(folder: Path, state: State) -> dict[str, np.ndarray]:
    path = folder / state.file
    try:
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != state.sha256:
                raise _damaged(path, f"its SHA-256 is not the one in {PLAN_FILE}")
        return {name: np.array(array) for name, array in load_file(path).items()}  # ours to change
    except OSError as error:
        raise _damaged(path, f"it cannot be read ({error.strerror})") from error
    except SafetensorError as error:
        raise _damaged(path, str(error)) from error


def _write_state(path: Path, arrays: dict[str, np.ndarray]) -> str:
    """Write arrays under their final name in one step, without a copy in memory. Returns SHA-256.

    Raises:
        OutputError: the system refused.
    """
    temporary = temporary_path(path)
    try:
        with raise_output_error(path):
            make_folder(path.parent)
            save_file({name: np.asarray(a, order="C") for name, a in arrays.items()}, temporary)
            with temporary.open("rb") as file:
                checksum = hashlib.file_digest(file, "sha256").hexdigest()
                os.fsync(file.fileno())
            os.replace(temporary, path)
            flush_folder(path.parent)
    except SafetensorError as error:  # how it reports a full disk
        raise OutputError(f"cannot write {path}: {error}; see whether the disk is full") from error
    finally:
        temporary.unlink(missing_ok=True)
    return checksum


def _damaged(path: Path, problem: str) -> OutputError:
    return OutputError(f"{path} is damaged: {problem}. Begin anew with --overwrite")


# Colours of lines in the curves, which colour-blind readers can tell apart.
_BLUE = "#0072b2"
_ORANGE = "#d55e00"
_GREEN = "#009e73"
Row = Mapping[str, Any]


class Line(NamedTuple):
    """A number of the history's rows. If a split (test, train) is named, only its rows count."""

    key: str
    label: str = ""
    color: str = _BLUE
    split: str | None = None
    is_marked: bool = False


class Panel(NamedTuple):
    """A panel of the chart. last: the format of a line's last value in the legend."""

    title: str
    lines: tuple[Line, ...]
    log: bool = False
    from_zero: bool = False
    last: str = "{:.4g}"


def _by_split(key: str) -> tuple[Line, Line]:
    return (
        Line(key, "held-out views", _ORANGE, "test", True),
        Line(key, "training views", _BLUE, "train", True),
    )


FIT_PANELS = (
    Panel("loss, mean of 50 steps (log scale)", (Line("loss"),), log=True),
    Panel("PSNR, dB", _by_split("psnr"), last="{:.2f}"),
    Panel(
        "median depth error, m (log scale)", _by_split("depth_median_m"), log=True, last="{:.2g}"
    ),
    Panel("Gaussians", (Line("splats", color=_GREEN),), from_zero=True),
)


def write_curves(path: Path, history: Sequence[Row], panels: Sequence[Panel]) -> bool:
    """A PNG with a panel for each quantity that the history knows. False, and a note on stderr,
    where matplotlib is not installed; False where nothing is known.

    history: rows {"step", "seconds", ...}. Values that are no number are left out.

    Raises:
        OutputError: the file cannot be written.
    """
    panel_lines = []
    for panel in panels:
        lines = {line: points for line in panel.lines if (points := _points(history, line))}
        if lines:
            panel_lines.append((panel, lines))
    if not panel_lines:
        return False
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print_note(
            f"note: {path.name} is not drawn, for which matplotlib is missing: "
            f"`pip install 'climategs[plots]'`. The report holds the same numbers as `history`"
        )
        return False
    columns = min(2, len(panel_lines))
    rows = -(-len(panel_lines) // columns)
    figure = Figure(figsize=(7.2 * columns, 4.4 * rows), layout="constrained")
    clock = sorted({(float(r["step"]), float(r["seconds"])) for r in history if "seconds" in r})
    last_step = max(
        step for _, lines in panel_lines for points in lines.values() for step, _ in points
    )
    for number, (panel, lines) in enumerate(panel_lines, 1):
        axes = figure.add_subplot(rows, columns, number)
        _draw_panel(axes, panel, lines, max(last_step, 1.0), clock)
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    write_atomic(path, data.getvalue())
    return True


def _points(history: Sequence[Row], line: Line) -> list[tuple[float, float]]:
    """Return the points (step, value) of a line, in order of steps."""
    return [
        (float(row["step"]), float(value))
        for row in history
        if isinstance(value := row.get(line.key), int | float)
        and math.isfinite(value)
        and row.get("split") == line.split
    ]


def _draw_panel(
    axes: Any,
    panel: Panel,
    lines: Mapping[Line, Sequence[tuple[float, float]]],
    last_step: float,
    clock: Sequence[tuple[float, float]],
) -> None:
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel("steps")
    axes.set_xlim(0, last_step)
    axes.grid(color="#e1e1e1")
    positive = [value for points in lines.values() for _, value in points if value > 0]
    lowest = min(positive, default=1.0) / 1.15
    if panel.log:
        axes.set_yscale("log")
    for line, points in lines.items():
        steps, values = zip(*points, strict=True)
        plot_values = [max(value, lowest) for value in values] if panel.log else values
        marker = "o" if line.is_marked or len(points) == 1 else ""
        label = f"{line.label}: {panel.last.format(values[-1])}" if line.label else None
        axes.plot(steps, plot_values, color=line.color, marker=marker, markersize=4, label=label)
    if panel.from_zero:
        axes.set_ylim(bottom=0)
    if any(line.label for line in lines):
        axes.legend(fontsize="small")
    _draw_clock(axes, clock)


def _draw_clock(axes: Any, clock: Sequence[tuple[float, float]]) -> None:
    """Draw, above the axes, the time at which steps were reached."""
    from matplotlib.ticker import MaxNLocator

    row_steps, seconds = np.array(clock).reshape(-1, 2).T
    if len(clock) < 2 or seconds[-1] <= seconds[0]:
        return
    unit, name = (60.0, "min") if seconds[-1] >= 180 else (1.0, "s")
    # From the first row on: what was spent before it is compiling and opening, not steps.
    first_time = seconds[0] / unit
    last_time = seconds[-1] / unit
    ticks = [
        t for t in MaxNLocator(6).tick_values(first_time, last_time) if first_time <= t <= last_time
    ]
    above = axes.secondary_xaxis("top")
    steps = np.interp([t * unit for t in ticks], np.maximum.accumulate(seconds), row_steps)
    above.set_xticks(steps, [f"{t:g} {name}" for t in ticks], fontsize="small")
