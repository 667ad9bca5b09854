"""Times of passes: `with stopwatch() as seconds:` around, `with timed("flood: bed"):` in a pass,
which costs a look-up where no stopwatch runs. Where one does, the GPU is waited for at both
ends of a pass, which makes the whole slower and each time its own; and what runs inside can be
given up between two passes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch


class StageTimer:
    """seconds: by name, without those of passes inside the pass. before: called before each."""

    def __init__(self, before: Callable[[], None] | None) -> None:
        self.seconds: dict[str, float] = {}
        self._before = before
        self._open: list[str] = []
        self._since = time.perf_counter()

    def start(self, name: str) -> None:
        if self._before is not None:
            self._before()
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


_listening: ContextVar[StageTimer | None] = ContextVar("stopwatch", default=None)


class timed:
    """Counts what runs inside under a name, where a stopwatch runs."""

    __slots__ = ("_name", "_timer")

    def __init__(self, name: str) -> None:
        self._name = name
        self._timer = _listening.get()

    def __enter__(self) -> None:
        if self._timer is not None:
            self._timer.start(self._name)

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.stop()


@contextmanager
def stopwatch(before: Callable[[], None] | None = None) -> Iterator[dict[str, float]]:
    """Seconds of the passes that run inside, in this thread or task, by name. before: called before
    each pass; what it raises ends what runs inside.
    """
    timer = StageTimer(before)
    outer = _listening.set(timer)
    try:
        yield timer.seconds
    finally:
        _listening.reset(outer)
