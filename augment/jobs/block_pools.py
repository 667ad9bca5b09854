"""Workers that do one task each at a time: the interface, and the simplest of them."""

from __future__ import annotations

import _thread
import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from queue import SimpleQueue
from typing import Protocol, runtime_checkable

from augment.errors import ClimateGSError
from augment.jobs.block_worker import BlockWorker, Result, Task, WorkSetup
from augment.jobs.processes import (
    available_cores,
    describe_exit,
    interrupts_blocked,
    sender,
    thread_limits,
)
from augment.jobs.worker import Outcome

# ---- pools ---------------------------------------------------------------------------------------


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
        self._worker_state = BlockWorker(setup, lambda outcome: tick(0, outcome))
        self._task: Task | None = None

    def give(self, slot: int, task: Task) -> None:
        self._task = task

    def wait(self, timeout_s: float) -> list[Event]:
        task, self._task = self._task, None
        return [] if task is None else [Finished(0, self._worker_state.do(task))]

    def close(self) -> None:
        self._task = None


# ---- A pool of worker processes on this machine, each with a scene of its own --------------------
# They are started afresh (`spawn`). One that dies is replaced; all end when this process does.

STOP_S = 60.0  # how long a worker may take to finish the images it has at hand
_READY = "ready"


class ProcessPool:
    """`slots` worker processes that share the cores.

    Raises:
        ClimateGSError: from wait: a process ended while starting, and none has ever started.
    """

    def __init__(self, setup: WorkSetup, tick: Tick, slots: int) -> None:
        self.slots = slots
        self._setup, self._tick = setup, tick
        self._threads = max(1, available_cores() // slots)
        self._workers: list[_Worker | None] = [None] * slots
        self._has_started = False  # any of them

    def give(self, slot: int, task: Task) -> None:
        worker = self._workers[slot]
        if worker is None:
            worker = self._workers[slot] = _Worker(self._setup, self._threads)
        worker.has_task = True
        with contextlib.suppress(OSError):  # one that has just died shows when it is waited for
            worker.connection.send(task)

    def wait(self, timeout_s: float) -> list[Event]:
        deadline = time.monotonic() + timeout_s
        events: list[Event] = []
        while not events:
            left = deadline - time.monotonic()
            started = {w.connection: slot for slot, w in enumerate(self._workers) if w is not None}
            ready = wait(list(started), max(0.0, left))
            if not ready and left <= 0:
                break
            for connection in ready:
                event = self._read(started[connection])  # pyright: ignore[reportArgumentType]
                if event is not None:
                    events.append(event)
        return events

    def close(self) -> None:
        workers = [worker for worker in self._workers if worker is not None]
        self._workers = [None] * self.slots
        try:
            for worker in workers:
                worker.stop()
            deadline = time.monotonic() + STOP_S
            for worker in workers:
                worker.drain(deadline)
        finally:
            for worker in workers:
                worker.kill()

    def _read(self, slot: int) -> Event | None:
        worker = self._workers[slot]
        assert worker is not None
        try:
            message = worker.connection.recv()
        except (EOFError, OSError):
            return self._reap_worker(slot, worker)
        if message == _READY:
            worker.is_ready = self._has_started = True
        elif isinstance(message, Outcome):
            self._tick(slot, message)
        else:
            worker.has_task = False
            return Finished(slot, message)
        return None

    def _reap_worker(self, slot: int, worker: _Worker) -> Event | None:
        """What becomes of the task of a worker that died; of one that had none nothing is lost."""
        worker.process.join()
        worker.connection.close()
        self._workers[slot] = None
        ending = describe_exit(worker.process.exitcode)
        if not worker.is_ready and not self._has_started:
            raise ClimateGSError(
                f"a worker process {ending} while starting; what it printed says more. A script "
                f"that generates with processes needs `if __name__ == '__main__':` around it; if "
                f"memory ran out, use fewer workers"
            )
        return Lost(slot, ending) if worker.has_task else None


class _Worker:
    def __init__(self, setup: WorkSetup, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, child = context.Pipe()
        # No daemon: on trial it has processes of its own. It ends when the connection does.
        self.process = context.Process(target=_main, args=(child, setup, threads))
        with thread_limits(threads), interrupts_blocked():
            self.process.start()
        child.close()
        self.is_ready = self.has_task = False

    def stop(self) -> None:
        with contextlib.suppress(OSError):
            self.connection.send(None)

    def drain(self, deadline: float) -> None:
        """Take in what the worker still says until it ends, or it would block on saying it."""
        with contextlib.suppress(EOFError, OSError):
            while (left := deadline - time.monotonic()) > 0 and self.connection.poll(left):
                self.connection.recv()

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


def _main(connection: Connection, setup: WorkSetup, threads: int) -> None:
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(1)
    send = sender(connection)
    # A shell's background job ignores Ctrl-C, and so would `interrupt_main`.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    workshop = BlockWorker(setup, send)
    inbox: SimpleQueue[Task | None] = SimpleQueue()
    working = threading.Event()
    threading.Thread(target=_listen, args=(connection, inbox, working), daemon=True).start()
    send(_READY)
    with contextlib.suppress(KeyboardInterrupt):  # asked to stop in the midst of a block
        while (task := inbox.get()) is not None:
            working.set()
            try:
                result = workshop.do(task)
            finally:
                working.clear()
            send(result)


def _listen(connection: Connection, inbox: SimpleQueue, working: threading.Event) -> None:
    """Receive beside the work, so that a stop or the parent's end is noticed at once."""
    while True:
        try:
            task = connection.recv()
        except (EOFError, OSError):
            os._exit(1)  # the parent has gone: what is finished is on the disk
        inbox.put(task)
        if task is None and working.is_set():
            _thread.interrupt_main()
