"""Workers that do one task each at a time: the interface, and the simplest of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from augment.batch.runner import Outcome
from augment.generate.workshop import Result, Task, WorkSetup, Workshop


@dataclass(frozen=True)
class Finished:
    """The worker has done its task."""

    slot: int
    result: Result


@dataclass(frozen=True)
class Lost:
    """The worker died at its task; another takes its place. how: "was killed by SIGKILL", say."""

    slot: int
    how: str


Event = Finished | Lost
Tick = Callable[[int, Outcome], None]  # the slot, and an image that its worker is done with


@runtime_checkable
class WorkerPool(Protocol):
    """Workers are numbered 0 to slots - 1; every one has at most one task.

    A pool tells of images as they are finished through the `tick` that it was made with, called in
    the thread that waits, or, where the work is done in this process, in several threads.
    """

    @property
    def slots(self) -> int: ...

    def give(self, slot: int, task: Task) -> None:
        """Start a task in a worker that has none."""
        ...

    def wait(self, timeout_s: float) -> list[Event]:
        """What has happened, at least one thing unless the time ran out first."""
        ...

    def close(self) -> None:
        """End all workers: each finishes the images it has at hand, and what they hold is free."""
        ...


class SerialPool:
    """One worker, which is this process; it works while it is waited for."""

    slots = 1

    def __init__(self, setup: WorkSetup, tick: Tick) -> None:
        self._workshop = Workshop(setup, lambda outcome: tick(0, outcome))
        self._task: Task | None = None

    def give(self, slot: int, task: Task) -> None:
        self._task = task

    def wait(self, timeout_s: float) -> list[Event]:
        task, self._task = self._task, None
        return [] if task is None else [Finished(0, self._workshop.do(task))]

    def close(self) -> None:
        self._task = None
