"""Two ways to run a job's chunks: in this process, or in several worker processes.

Workers are started afresh (`spawn`): nothing of the parent's threads, locks or random state leaks
into them. The parent hands them its open scene (`shared_scene`); it alone decides what runs where,
and writes the journals.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import pickle
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from queue import SimpleQueue

from augment.errors import ClimateGSError, GpuLost, OutputError
from augment.jobs.backends import renders_on_gpu
from augment.jobs.manifest import FAILED
from augment.jobs.processes import (
    InheritedLock,
    OutputLock,
    SharedScene,
    available_cores,
    describe_exit,
    interrupts_blocked,
    quick_turns,
    sender,
    thread_limits,
)
from augment.jobs.view_files import WritePump
from augment.jobs.worker import Chunk, FrameRunner, Outcome, Renderer, Setup, describe
from augment.scene import Scene

# ------------------------------------------------------------------------------------------------
# What a worker process runs: take the scene, render the chunks it is sent, report each image


@dataclass(frozen=True)
class Ready:
    """The scene is there; rendering can begin."""


@dataclass(frozen=True)
class Failure:
    """The worker cannot go on. is_output: what it could not do is write."""

    is_output: bool
    text: str


@dataclass(frozen=True)
class Spent:
    """The worker has ended as it was told to. seconds: by the kinds of `times`."""

    seconds: dict[str, float]


def worker_main(
    connection: Connection,
    setup: Setup,
    shared: SharedScene,
    renderer: Renderer | None,
    threads: int,
    lock: InheritedLock,
) -> None:
    """Serve chunks until told to stop. `lock` is only held: the folder stays ours until we end."""
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(1)
    inbox: SimpleQueue[Chunk | None] = SimpleQueue()
    stopped = threading.Event()
    threading.Thread(target=_listen, args=(connection, inbox, stopped), daemon=True).start()
    send = sender(connection)
    try:
        scene = shared.open()
        for bed in setup.beds:
            bed.take_over(scene)
    except Exception as error:
        send(Failure(False, describe(error, "taking over the scene in a worker process")))
        return
    send(Ready())
    if renders_on_gpu(setup.backend):
        pump = WritePump.beside(setup.backend, threads)
    else:  # one thread and little waiting: the memory of a view counts once per worker
        pump = WritePump(threads=1, waiting=2)
    runner = FrameRunner(scene, setup, renderer, send, pump)
    try:
        with quick_turns(renders_on_gpu(setup.backend)):
            try:
                while True:
                    if inbox.empty():  # the next chunk may depend on what becomes of the last view
                        runner.land()
                    if (chunk := inbox.get()) is None:
                        break
                    runner.run(chunk, stopped.is_set)
            finally:
                seconds = runner.close()
        send(Spent(seconds))
    except OutputError as error:
        send(Failure(True, str(error)))
    except GpuLost:  # as any death of a worker: another one tries what this has in hand
        raise
    except Exception as error:
        send(Failure(False, describe(error, "in a worker process")))


def _listen(connection: Connection, inbox: SimpleQueue, stopped: threading.Event) -> None:
    """Receive beside the rendering, so that a stop or the parent's end is noticed at once."""
    while True:
        try:
            chunk = connection.recv()
        except (EOFError, OSError):
            os._exit(1)  # the parent has gone: nobody is left to report to
        if chunk is None:
            stopped.set()
        inbox.put(chunk)


# ---- executors -----------------------------------------------------------------------------------

STOP_S = 120.0  # how long a worker may take to finish its image when the job stops
CHUNKS_AHEAD = 2  # one being rendered and one waiting, so that no worker idles
_log = logging.getLogger(__name__)

Deliver = Callable[[Outcome], None]


def run_serially(
    scene: Scene, setup: Setup, chunks: Sequence[Chunk], renderer: Renderer | None, deliver: Deliver
) -> dict[str, float]:
    """Render in this thread, encode and write in others. An interrupt ends cleanly.

    Returns seconds by the kinds of `times`.
    """
    pump = WritePump.beside(setup.backend, available_cores())
    runner = FrameRunner(scene, setup, renderer, deliver, pump)
    with quick_turns(renders_on_gpu(setup.backend)):
        try:
            for chunk in chunks:
                runner.run(chunk)
        finally:
            seconds = runner.close()
    return seconds


def run_in_processes(
    setup: Setup,
    chunks: Sequence[Chunk],
    *,
    workers: int,
    shared: SharedScene,
    renderer: Renderer | None,
    deliver: Deliver,
    lock: OutputLock,
) -> dict[str, float]:
    """Render in `workers` processes; `deliver` is called in this thread.

    Returns seconds by the kinds of `times`, without those of workers that died.

    What a dead worker had in hand is tried once more, each image alone; if its process dies again
    the image is recorded as failed.

    Raises:
        ValueError: the renderer cannot be sent to another process.
        OutputError: a worker could not write. ClimateGSError: a worker could not start.
    """
    try:
        reduction.ForkingPickler.dumps(renderer)
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise ValueError(
            f"renderer {renderer!r} cannot be sent to worker processes: {error}; use a function "
            f"defined at the top of a module, or workers=1"
        ) from error
    pool = _Pool(setup, shared, renderer, deliver, lock, chunks)
    pool.run(min(workers, len(chunks)))
    return dict(pool.seconds)


class _Worker:
    """A worker process as its parent sees it."""

    def __init__(self, pool: _Pool) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, child = context.Pipe()
        arguments = (child, pool.setup, pool.shared, pool.renderer, pool.threads)
        self.process = context.Process(
            target=worker_main, args=(*arguments, pool.lock.inherited()), daemon=True
        )
        with thread_limits(pool.threads), interrupts_blocked():
            self.process.start()
        child.close()
        self.is_ready = False
        self.is_stopping = False
        self.on_trial = False  # busy with one image whose worker died before
        self.in_hand: list[Chunk] = []

    def give(self, chunk: Chunk) -> None:
        self.in_hand.append(chunk)
        # A worker that has just died shows itself when its connection is read.
        with contextlib.suppress(OSError):
            self.connection.send(chunk)

    def take(self, outcome: Outcome) -> None:
        """Strike a finished image off what the worker has in hand."""
        for position, chunk in enumerate(self.in_hand):
            if (chunk.variant, chunk.frame) == (outcome.variant, outcome.frame):
                rest = tuple(name for name in chunk.cameras if name != outcome.camera)
                if len(rest) < len(chunk.cameras):
                    kept = [Chunk(chunk.variant, chunk.frame, rest)] if rest else []
                    self.in_hand[position : position + 1] = kept
                    self.on_trial = self.on_trial and bool(kept)
                    return

    def stop(self) -> None:
        self.is_stopping = True
        with contextlib.suppress(OSError):
            self.connection.send(None)


class _Pool:
    def __init__(
        self,
        setup: Setup,
        shared: SharedScene,
        renderer: Renderer | None,
        deliver: Deliver,
        lock: OutputLock,
        chunks: Sequence[Chunk],
    ) -> None:
        self.setup, self.shared, self.renderer = setup, shared, renderer
        self.deliver, self.lock = deliver, lock
        self.waiting = deque(chunks)
        self.retries: deque[Chunk] = deque()
        self.workers: list[_Worker] = []
        self.threads = 1
        self.seconds: Counter[str] = Counter()

    def run(self, count: int) -> None:
        self.threads = max(1, available_cores() // count)
        try:
            for _ in range(count):
                self.workers.append(_Worker(self))
            while self._feed():
                for worker in self._readable(None):
                    self._read(worker)
        finally:
            self._stop()

    def _feed(self) -> bool:
        """Hand out work; False when there is none left, in hand or waiting."""
        for worker in self.workers:
            while self.waiting and not worker.on_trial and len(worker.in_hand) < CHUNKS_AHEAD:
                worker.give(self.waiting.popleft())
            if self.retries and not worker.in_hand:
                worker.on_trial = True
                worker.give(self.retries.popleft())
        return any(worker.in_hand for worker in self.workers)

    def _readable(self, timeout_s: float | None) -> list[_Worker]:
        ready = wait([worker.connection for worker in self.workers], timeout_s)
        return [worker for worker in self.workers if worker.connection in ready]

    def _read(self, worker: _Worker) -> None:
        try:
            message = worker.connection.recv()
        except (EOFError, OSError):
            self._reap_worker(worker)
            return
        if isinstance(message, Ready):
            worker.is_ready = True
        elif isinstance(message, Failure):
            raise (OutputError if message.is_output else ClimateGSError)(message.text)
        elif isinstance(message, Spent):
            self.seconds.update(message.seconds)
        else:
            worker.take(message)
            self.deliver(message)

    def _reap_worker(self, worker: _Worker) -> None:
        """Take a worker that ended out of the pool, and decide about what it had in hand."""
        worker.process.join()
        worker.connection.close()
        self.workers.remove(worker)
        if worker.is_stopping:
            return
        ending = describe_exit(worker.process.exitcode)
        if not worker.is_ready:
            raise ClimateGSError(
                f"a worker process {ending} while starting; what it printed says more. A script "
                f"that starts workers needs `if __name__ == '__main__':` around its jobs; if "
                f"memory ran out, use fewer workers"
            )
        _log.warning("a worker process %s; its images are tried once more", ending)
        for chunk in worker.in_hand:
            for name in chunk.cameras:
                if worker.on_trial:
                    message = (
                        f"the worker process {ending} while rendering this image, and again when "
                        f"it was tried alone; if memory ran out, use fewer workers"
                    )
                    self.deliver(Outcome(chunk.variant, chunk.frame, name, FAILED, message))
                else:
                    self.retries.append(Chunk(chunk.variant, chunk.frame, (name,)))
        if self.waiting or self.retries:
            self.workers.append(_Worker(self))

    def _stop(self) -> None:
        """Let every worker finish the image it is at, and take it in; kill what does not end."""
        deadline = time.monotonic() + STOP_S
        try:
            for worker in self.workers:
                worker.stop()
            while self.workers and time.monotonic() < deadline:
                for worker in self._readable(1.0):
                    with contextlib.suppress(ClimateGSError):  # the first is on its way
                        self._read(worker)
        finally:
            for worker in self.workers:
                worker.process.kill()
                worker.process.join()
                worker.connection.close()
            self.workers = []
