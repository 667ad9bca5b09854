"""Times of passes, for whoever wants them: `with stopwatch() as seconds:` around rendering.

A pass says `with lap("flood: bed"):`. Where nobody listens that costs a look-up. A GPU works on
while the program goes on: for whoever listens, laps begin and end when it has done what it was
told, which makes the whole slower and each lap's time its own.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType

import torch


class StageTimer:
    """seconds: by name, without what laps inside a lap took."""

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
        """Give the time since the last change to the innermost open lap."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        now = time.perf_counter()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now


_listening: ContextVar[StageTimer | None] = ContextVar("laps", default=None)


class timed:
    """Counts what runs inside under a name, where somebody listens."""

    __slots__ = ("_name", "_timer")

    def __init__(self, name: str) -> None:
        self._name = name
        self._timer = _listening.get()

    def __enter__(self) -> None:
        if self._timer is not None:
            self._timer.start(self._name)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._timer is not None:
            self._timer.stop()


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Seconds of the laps that run inside, in this thread or task, by name."""
    laps = StageTimer()
    before = _listening.set(laps)
    try:
        yield laps.seconds
    finally:
        _listening.reset(before)
