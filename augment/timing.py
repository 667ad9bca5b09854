"""Times and progress of the passes of a picture.

`with timed("flood: bed"):` stands in a pass and costs two look-ups where nobody listens. `with
stopwatch() as seconds:` around it measures. The GPU is then waited for at both ends of a pass,
which makes the whole slower and each time its own. `with watched(report):` around it reports which
pass has begun, and each step of long preparations (`counted_steps`). It changes no picture and
waits for nothing. An exception that the watcher raises gives up the work inside.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch


class StageTimer:
    """Measures the time of passes, one inside the other.

    `seconds` holds the time of each pass by name, without that of passes inside it.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = time.perf_counter()

    def start(self, name: str) -> None:
        """Begin a pass."""
        self._close()
        self._open.append(name)

    def stop(self) -> None:
        """End the innermost pass."""
        self._close()
        self._open.pop()

    def _close(self) -> None:
        """Add the time since the last change to the innermost open pass."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        now = time.perf_counter()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now


@dataclass(frozen=True)
class PassProgress:
    """Progress of the pass that runs."""

    name: str
    """Name of a pass ("rasterise") or of a preparation ("finding exposed surfaces")."""
    num_done: int = 0
    """Steps that are done."""
    num_steps: int = 0
    """Steps that there are; 0 where the pass has none to count."""


class PassWatch:
    """Reports the passes that run, one inside the other, to a function."""

    def __init__(self, report: Callable[[PassProgress], None]) -> None:
        self._report = report
        self._open: list[PassProgress] = []

    def start(self, name: str, total: int = 0) -> None:
        """Report that a pass begins."""
        progress = PassProgress(name, 0, total)
        self._report(progress)
        self._open.append(progress)

    def advance(self) -> None:
        """Report one step more of the innermost pass."""
        last = self._open[-1]
        self._open[-1] = PassProgress(last.name, last.num_done + 1, last.num_steps)
        self._report(self._open[-1])

    def stop(self, *, has_failed: bool) -> None:
        """End the innermost pass, and report the pass around it."""
        self._open.pop()
        if self._open and not has_failed:  # the pass around it goes on
            self._report(self._open[-1])


_listening: ContextVar[StageTimer | None] = ContextVar("stopwatch", default=None)
_watching: ContextVar[PassWatch | None] = ContextVar("watch", default=None)


class timed:
    """Times the work inside under a name, if a stopwatch runs, and reports it to a watcher."""

    __slots__ = ("_name", "_timer", "_watch")

    def __init__(self, name: str) -> None:
        self._name = name
        self._timer = _listening.get()
        self._watch = _watching.get()

    def __enter__(self) -> None:
        if self._watch is not None:
            self._watch.start(self._name)
        if self._timer is not None:
            self._timer.start(self._name)

    def __exit__(self, kind: object, *_: object) -> None:
        if self._timer is not None:
            self._timer.stop()
        if self._watch is not None:
            self._watch.stop(has_failed=kind is not None)


@contextmanager
def counted_steps(name: str, total: int) -> Iterator[Callable[[], None]]:
    """Report a preparation that takes many steps to a watcher.

    Yields a function, which is to be called after each step.

    Args:
        name: what is prepared, for people: "finding exposed surfaces".
        total: number of steps.
    """
    watch = _watching.get()
    if watch is None:
        yield lambda: None
        return
    watch.start(name, total)
    has_failed = True
    try:
        yield watch.advance
        has_failed = False
    finally:
        watch.stop(has_failed=has_failed)


@contextmanager
def watched(report: Callable[[PassProgress], None]) -> Iterator[None]:
    """Have a function told of the passes that run inside, in this thread or task.

    Args:
        report: called at the start of each pass, after each step of one, and when a pass inside
            another ends. An exception that it raises ends the work inside.
    """
    outer = _watching.set(PassWatch(report))
    try:
        yield
    finally:
        _watching.reset(outer)


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Yield the seconds of the passes that run inside, in this thread or task, by name."""
    timer = StageTimer()
    outer = _listening.set(timer)
    try:
        yield timer.seconds
    finally:
        _listening.reset(outer)
