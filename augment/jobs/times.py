"""Where a job's time goes: seconds by kind of work, and from them what the job was bound by.

In every worker one thread renders and hands finished views to threads that encode and write them.
The rendering thread waits (is *held*) when these have too much in hand, and at the end for what
they still have. Whoever is busiest bounds the job: what others do beside it costs nothing.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

# Of the threads that render. `render` holds `await`: for the view in flight to be done.
RENDER, AWAIT, HELD, RENDERERS = "render", "await", "held", "renderers"
# Of the threads that write.
ENCODE, WRITE, MEASURE, LIDAR, WRITERS = "encode", "write", "measure", "lidar", "writers"
WORKERS = "workers"  # all of a job's workers, from its begin to its end

_WRITING = {ENCODE: "encoding", WRITE: "writing to disk", MEASURE: "boxes", LIDAR: "LiDAR"}
_BESIDE = {
    "open": "opening scenes",
    "settle": "choosing settings",
    "place": "looking where snow can lie",
    "style": "working out styles",
    "labels": "reading labels",
    "share": "handing the scene to workers",
    "finish": "writing manifests",
    "publish": "publishing",
}


class WorkTimes:
    """Seconds by kind of work; several threads may add to them."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._lock = threading.Lock()

    def add(self, kind: str, seconds: float) -> None:
        with self._lock:
            self._seconds[kind] += seconds

    @contextmanager
    def spent(self, *kinds: str) -> Iterator[None]:
        """The time within is added to each of these kinds, also if it ends with an exception."""
        started = time.perf_counter()
        try:
            yield
        finally:
            for kind in kinds:
                self.add(kind, time.perf_counter() - started)

    def so_far(self) -> dict[str, float]:
        with self._lock:
            return dict(self._seconds)


@dataclass(frozen=True)
class Shares:
    """Parts of a job's time, 0 to 1.

    Of the workers' time: rendering; awaiting, the part of rendering that is waiting for views
    in flight; held, waiting for files; beside, all else, and the greatest part of that in words.
    Of the writing threads' time: writing, by kind of work, in words.
    """

    rendering: float
    awaiting: float
    held: float
    beside: float
    beside_by: str
    writing: Mapping[str, float]

    @property
    def bound_by(self) -> str:
        """What the job would have to do faster to end earlier."""
        if sum(self.writing.values()) > self.rendering + self.beside:
            return max(self.writing, key=self.writing.__getitem__)
        return "rendering" if self.rendering >= self.beside else self.beside_by

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        wait = f" ({_percent(self.awaiting)} for views in flight)" if self.awaiting else ""
        beside = f"other work {_percent(self.beside)}, first of all {self.beside_by}"
        kinds = ", ".join(f"{kind} {_percent(share)}" for kind, share in self.writing.items())
        return (
            f"bound by {self.bound_by}: rendering {_percent(self.rendering)} of the time{wait}, "
            f"waiting for files {_percent(self.held)}, {beside}; "
            f"writing threads {_percent(sum(self.writing.values()))} busy ({kinds})"
        )


def shares_of(seconds: Mapping[str, float], held_up: int = 1) -> Shares | None:
    """The shares of a job's seconds by kind of work; None where nothing was rendered.

    held_up: how many workers there are while the job itself does other work than rendering.
    """
    whole, writers = seconds.get(WORKERS, 0.0), seconds.get(WRITERS, 0.0)
    if not (seconds.get(RENDER) and whole and writers):
        return None
    # A worker's writing threads are there as long as the worker is, at work or not.
    writers *= whole / seconds[RENDERERS]
    rendering, held = seconds[RENDER] / whole, seconds.get(HELD, 0.0) / whole
    rest = max(0.0, 1 - rendering - held)
    beside = {words: held_up * seconds.get(k, 0.0) / whole for k, words in _BESIDE.items()}
    beside["workers that start or have nothing to do"] = rest - sum(beside.values())
    return Shares(
        rendering=rendering,
        awaiting=seconds.get(AWAIT, 0.0) / whole,
        held=held,
        beside=rest,
        beside_by=max(beside, key=beside.__getitem__),
        writing={words: seconds.get(kind, 0.0) / writers for kind, words in _WRITING.items()},
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
