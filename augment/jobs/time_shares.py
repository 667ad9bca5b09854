"""Where a job's time goes: seconds by kind of work, and the kind that bounds the job.

In every worker one thread renders and hands finished views to threads that encode and write them.
The rendering thread waits for files while the writing threads have too many views in hand, and at
the end until they have written the last ones. The busiest threads bound the job: the work of the
other threads runs beside it and costs nothing.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

# Kinds of work of the rendering threads. `render` includes `wait_for_views`: waiting for
# the view in flight.
RENDER = "render"
WAIT_FOR_VIEWS = "wait_for_views"
# Waiting for the writing threads.
WAIT_FOR_FILES = "wait_for_files"
# All time of the rendering threads.
RENDERERS = "renderers"
# Kinds of work of the writing threads.
ENCODE = "encode"
WRITE = "write"
MEASURE = "measure"
LIDAR = "lidar"
# All time of the writing threads.
WRITERS = "writers"
# All time of the job's workers, from its begin to its end.
WORKERS = "workers"

# Labels of the writing threads' kinds of work, for people.
_WRITING_LABELS = {ENCODE: "encoding", WRITE: "writing to disk", MEASURE: "boxes", LIDAR: "LiDAR"}
# Labels of the work beside rendering and writing, for people.
_OTHER_LABELS = {
    "open": "opening scenes",
    "choose_settings": "choosing settings",
    "prepare": "preparing effects",
    "read_labels": "reading labels",
    "share_scene": "handing the scene to workers",
    "finish": "writing manifests",
    "publish": "publishing",
}


class WorkTimes:
    """Seconds by kind of work; several threads may add to them."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._lock = threading.Lock()

    def add(self, kind: str, seconds: float) -> None:
        """Add seconds to a kind of work."""
        with self._lock:
            self._seconds[kind] += seconds

    @contextmanager
    def measure(self, *kinds: str) -> Iterator[None]:
        """Context manager that adds the time inside it to each of these kinds.

        The time counts also where the block ends with an exception.
        """
        start_s = time.perf_counter()
        try:
            yield
        finally:
            for kind in kinds:
                self.add(kind, time.perf_counter() - start_s)

    def update(self, seconds: Mapping[str, float]) -> None:
        """Add seconds by kind."""
        for kind, kind_seconds in seconds.items():
            self.add(kind, kind_seconds)

    def so_far(self) -> dict[str, float]:
        """Return a copy of the seconds by kind."""
        with self._lock:
            return dict(self._seconds)


@dataclass(frozen=True)
class TimeShares:
    """Parts of a job's time, 0 to 1."""

    rendering: float
    """Part of the workers' time in which they render."""
    waiting_for_views: float
    """Part of the workers' time in which they wait for views in flight; included in `rendering`."""
    waiting_for_files: float
    """Part of the workers' time in which they wait for files to be written."""
    other_work: float
    """Part of the workers' time for all other work."""
    beside_by: str
    """Label of the greatest part of `beside`."""
    writing: Mapping[str, float]
    """Parts of the writing threads' time, by label of the kind of work."""

    @property
    def bound_by(self) -> str:
        """Label of the work that bounds the job."""
        if sum(self.writing.values()) > self.rendering + self.other_work:
            return max(self.writing, key=self.writing.__getitem__)
        return "rendering" if self.rendering >= self.other_work else self.beside_by

    @property
    def sentence(self) -> str:
        """All shares in one line, for people."""
        wait = (
            f" ({_percent(self.waiting_for_views)} for views in flight)"
            if self.waiting_for_views
            else ""
        )
        beside = f"other work {_percent(self.other_work)}, first of all {self.beside_by}"
        kinds = ", ".join(f"{kind} {_percent(share)}" for kind, share in self.writing.items())
        return (
            f"bound by {self.bound_by}: rendering {_percent(self.rendering)} of the time{wait}, "
            f"waiting for files {_percent(self.waiting_for_files)}, {beside}; "
            f"writing threads {_percent(sum(self.writing.values()))} busy ({kinds})"
        )


def compute_time_shares(
    seconds: Mapping[str, float], num_waiting_workers: int = 1
) -> TimeShares | None:
    """Return the shares of a job's seconds by kind of work; None where nothing was rendered.

    Args:
        seconds: Seconds by kind of work.
        num_waiting_workers: Number of workers that wait while the job itself does other work than
            rendering.
    """
    workers_s = seconds.get(WORKERS, 0.0)
    writers_s = seconds.get(WRITERS, 0.0)
    if not (seconds.get(RENDER) and workers_s and writers_s):
        return None
    # A worker's writing threads exist as long as the worker does, at work or not.
    writers_s *= workers_s / seconds[RENDERERS]
    rendering_share = seconds[RENDER] / workers_s
    waiting_share = seconds.get(WAIT_FOR_FILES, 0.0) / workers_s
    other_share = max(0.0, 1 - rendering_share - waiting_share)
    share_of_label = {
        label: num_waiting_workers * seconds.get(k, 0.0) / workers_s
        for k, label in _OTHER_LABELS.items()
    }
    share_of_label["workers that start or have nothing to do"] = other_share - sum(
        share_of_label.values()
    )
    return TimeShares(
        rendering=rendering_share,
        waiting_for_views=seconds.get(WAIT_FOR_VIEWS, 0.0) / workers_s,
        waiting_for_files=waiting_share,
        other_work=other_share,
        beside_by=max(share_of_label, key=share_of_label.__getitem__),
        writing={
            label: seconds.get(kind, 0.0) / writers_s for kind, label in _WRITING_LABELS.items()
        },
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
