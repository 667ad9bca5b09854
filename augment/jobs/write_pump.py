"""Threads that write files beside the thread that renders. Workers and `mirror` use them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from augment.jobs.processes import run_uninterrupted


class WritePump:
    """Runs writes on threads beside the renderer.

    Few writes wait at a time, so that memory stays bounded. The first exception of a task stops the
    pump: `submit` and `close` raise it.
    """

    def __init__(self, threads: int = 2, waiting: int = 4) -> None:
        """Start the pool of threads.

        Args:
            threads: Number of threads.
            waiting: Most tasks at a time, including those that threads work on.
        """
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="writer")
        self._slots = threading.BoundedSemaphore(waiting)
        self._error: BaseException | None = None

    def submit(self, task: Callable[[], Any]) -> Future:
        """Queue a task; blocks while too many wait. Tasks start in the order of the calls."""
        if self._slots.acquire(blocking=False):
            return self._queue(task)
        # A rendered view is written also where an interrupt comes during the wait.
        return run_uninterrupted(lambda: self._queue_when_free(task))

    def _queue_when_free(self, task: Callable[[], Any]) -> Future:
        self._slots.acquire()
        return self._queue(task)

    def _queue(self, task: Callable[[], Any]) -> Future:
        if self._error is not None:
            self._slots.release()
            raise self._error
        future = self._pool.submit(task)
        future.add_done_callback(self._note_done)
        return future

    def after(self, future: Future, task: Callable[[], Any]) -> None:
        """Run a short task as soon as `future` is done: now, or in the thread that completes it.

        So no thread waits for another thread's task.
        """

        def run(_: Future) -> None:
            try:
                task()
            except BaseException as error:  # a future would only log it
                self._error = self._error or error

        future.add_done_callback(run)

    def close(self) -> None:
        """Wait for all tasks, then raise the first error of one of them.

        An interrupt that comes meanwhile is raised after all tasks are done.
        """
        interrupt: BaseException | None = None
        while True:
            try:
                self._pool.shutdown(wait=True)
                break
            except KeyboardInterrupt as error:
                interrupt = error
        if (error := self._error or interrupt) is not None:
            raise error

    def _note_done(self, future: Future) -> None:
        self._error = self._error or future.exception()
        self._slots.release()
