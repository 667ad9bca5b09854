"""Runs the steps of a reconstruction: history, progress, evaluation, checkpoints, a clean stop."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from tqdm import tqdm

from augment.errors import ClimateGSError
from augment.reconstruct.view import ViewKey
from tools.fit_parts import Fitter, StepFacts

ROW_STEPS = 50  # steps averaged into one row of the history
EVALUATIONS = 10
CHECKPOINT_S = 120.0
_AVERAGED = ("loss", "l1", "ssim", "depth", "sky")
_STOPPING = b"\nstopping after this step; interrupt again to stop at once\n"


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

    def add(self, record: StepFacts) -> None:
        """One more step; a row where it completes one."""
        values = {name: float(getattr(record, name)) for name in _AVERAGED}
        values |= {f"stage_s.{stage}": float(s) for stage, s in record.stage_s.items()}
        for name, value in {"count": 1.0, **values}.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        if record.step % ROW_STEPS == 0:
            self.close_row(record.step, record.splats)

    def close_row(self, step: int, splats: int) -> None:
        means = self.means()
        self.rows.append({
            "step": int(step),
            "seconds": self.spent_s(),
            **{name: means[name] for name in _AVERAGED},
            "splats": int(splats),
            "stage_s": {n[8:]: v for n, v in means.items() if n.startswith("stage_s.")},
        })  # fmt: skip
        self.sums = {}

    def means(self) -> dict[str, float]:
        """Averages over the steps since the last row."""
        count = self.sums.get("count", 1.0)
        return {name: total / count for name, total in self.sums.items() if name != "count"}

    def evaluated(self, step: int, split: str, scores: dict[str, float]) -> None:
        self.rows.append({"step": step, "seconds": self.spent_s(), "split": split, **scores})

    def last_psnr(self) -> tuple[str, float] | None:
        """Split and PSNR of the latest evaluation, of held-out views where there are any."""
        latest = {row["split"]: row["psnr"] for row in self.rows if "psnr" in row}
        return next(((s, latest[s]) for s in ("test", "train") if s in latest), None)


@dataclass(frozen=True)
class Loop:
    """One run from the trainer's step to `steps`.

    evaluate(): scores by split of the scene as it stands. save(): a checkpoint. checkpoint_s: how
    often, in seconds. Neither changes what is learnt.
    """

    trainer: Fitter
    steps: int
    history: History
    evaluate: Callable[[], dict[str, dict[str, float]]]
    save: Callable[[], None]
    stop: StopRequest
    checkpoint_s: float = CHECKPOINT_S
    progress: bool = True

    def run(self) -> bool:
        """Runs until done (True) or asked to stop (False), with a checkpoint at the end.

        Raises:
            ClimateGSError: the loss is no longer a number.
        """
        marks = evaluation_steps(self.steps)
        saved = time.monotonic()
        with tqdm(
            total=self.steps,
            initial=self.trainer.step,
            desc="fit",
            unit="step",
            disable=not self.progress,
        ) as bar:
            if self.trainer.step == 0 and not self.history.rows:
                self._evaluate(0)
            while self.trainer.step < self.steps and not self.stop.requested:
                record = self.trainer.run_step()
                _check_finite(record)
                self.history.add(record)
                if record.step in marks:
                    self._evaluate(record.step)
                self._show(bar, record)
                if time.monotonic() - saved > self.checkpoint_s and record.step < self.steps:
                    self.save()
                    saved = time.monotonic()
        self.save()
        return self.trainer.step >= self.steps

    def _evaluate(self, step: int) -> None:
        for split, scores in self.evaluate().items():
            self.history.evaluated(step, split, scores)

    def _show(self, bar: tqdm, record: StepFacts) -> None:
        shown = {"loss": f"{self.history.means().get('loss', record.loss):.4f}"}
        if latest := self.history.last_psnr():
            split, psnr = latest
            shown["held-out PSNR" if split == "test" else "PSNR"] = f"{psnr:.2f}"
        bar.set_postfix(shown, refresh=False)
        bar.update(record.step - bar.n)


def evaluation_steps(steps: int) -> frozenset[int]:
    """About EVALUATIONS even points of a run, the last step among them."""
    return frozenset(max(1, round(steps * i / EVALUATIONS)) for i in range(1, EVALUATIONS + 1))


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


def _check_finite(record: StepFacts) -> None:
    if not math.isfinite(record.loss):
        raise ClimateGSError(
            f"the loss became {record.loss} in step {record.step} (frame {record.key.frame}, "
            f"camera {record.key.camera!r}): expected a finite number. Look at that image and its "
            f"depth priors, or fit without its camera (--cameras)"
        )
