"""Times and progress of passes.

`with timed("flood: bed"):` stands in a pass and costs two look-ups where nobody listens.
`with stopwatch() as seconds:` around it measures: the GPU is waited for at both ends of a pass,
which makes the whole slower and each time its own. `with watched(tell):` around it tells which pass
has begun, and of long preparations (`counted`) each step; it changes no picture and waits for
nothing. What the watcher raises gives up what runs inside.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch


class StageTimer:
    """seconds: by name, without those of passes inside the pass."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = time.perf_counter()

    def start(self, name: str) -> None:
        self._close()
        self._open.append(name)

    def stop(self) -> None:
        self._close()
        self._open.pop()

    def _close(self) -> None:
        """Give the time since the last change to the innermost open pass."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        now = time.perf_counter()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now


@dataclass(frozen=True)
class PassProgress:
    """Which pass runs, and how far it has got."""

    name: str
    """The pass's name, as plans have it: "rasterise"; or a preparation's: "placing snow"."""
    done: int = 0
    """Steps that are done."""
    total: int = 0
    """Steps that there are; 0 where the pass has none to count."""


class PassWatch:
    """Tells a function of the passes that run, one inside the other."""

    def __init__(self, tell: Callable[[PassProgress], None]) -> None:
        self._tell = tell
        self._open: list[PassProgress] = []

    def start(self, name: str, total: int = 0) -> None:
        progress = PassProgress(name, 0, total)
        self._tell(progress)
        self._open.append(progress)

    def advance(self) -> None:
        """One step more of the innermost pass."""
        last = self._open[-1]
        self._open[-1] = PassProgress(last.name, last.done + 1, last.total)
        self._tell(self._open[-1])

    def stop(self, *, has_failed: bool) -> None:
        self._open.pop()
        if self._open and not has_failed:  # the pass around it goes on
            self._tell(self._open[-1])


_listening: ContextVar[StageTimer | None] = ContextVar("stopwatch", default=None)
_watching: ContextVar[PassWatch | None] = ContextVar("watch", default=None)


class timed:
    """Counts what runs inside under a name, where a stopwatch runs, and tells a watcher of it."""

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
def counted(name: str, total: int) -> Iterator[Callable[[], None]]:
    """Tell a watcher of a preparation that takes many steps. Yields what is called after each.

    Args:
        name: What is prepared, as people are told: "placing snow".
        total: Steps that there are.
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
def watched(tell: Callable[[PassProgress], None]) -> Iterator[None]:
    """Have a function told of the passes that run inside, in this thread or task.

    Args:
        tell: Called at the start of each pass, after each step of one, and when one that lay inside
            another ends. What it raises ends what runs inside.
    """
    outer = _watching.set(PassWatch(tell))
    try:
        yield
    finally:
        _watching.reset(outer)


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Seconds of the passes that run inside, in this thread or task, by name."""
    timer = StageTimer()
    outer = _listening.set(timer)
    try:
        yield timer.seconds
    finally:
        _listening.reset(outer)
