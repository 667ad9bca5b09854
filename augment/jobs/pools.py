"""Workers that do one task each at a time: in this process, in several, or on a Ray cluster; and
the loop that gives them work.

What a job's workers do is its setup's: `setup.worker(on_outcome)` makes one, where it runs.
"""

from __future__ import annotations

import _thread
import contextlib
import ctypes
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Protocol, runtime_checkable

import augment
from augment.errors import ClimateGSError, OutputError
from augment.jobs.processes import (
    READY,
    ChildProcess,
    Ended,
    available_cores,
    failed_start,
    inbox_of,
    limit_threads,
    receive,
    sender,
)
from augment.jobs.worker import Outcome, TaskFailed
from augment.render.buffers import CUDA

OnOutcome = Callable[[Outcome], None]
Tick = Callable[[int, Outcome], None]  # the slot, and an image that its worker is done with


@runtime_checkable
class Worker(Protocol):
    """Does one task after the other. An error that concerns the task alone is its result, a
    TaskFailed; one that is raised ends the process.
    """

    def do(self, task: Any) -> Any: ...


@runtime_checkable
class WorkerSetup(Protocol):
    """What all workers of a job share; picklable. on_outcome: hears of every image, from several
    threads.
    """

    @property
    def backend(self) -> str: ...

    @property
    def output(self) -> str:
        """The output, to name it."""
        ...

    def worker(self, on_outcome: OnOutcome) -> Worker: ...


@dataclass(frozen=True)
class Finished:
    """The worker has done its task."""

    slot: int
    result: Any


@dataclass(frozen=True)
class Lost:
    """The worker died at its task; another takes its place. how: "was killed by SIGKILL", say."""

    slot: int
    how: str


Event = Finished | Lost


@runtime_checkable
class WorkerPool(Protocol):
    """Workers are numbered 0 to slots - 1; each has at most one task. A pool tells `tick` of
    finished images, in the thread that waits; a SerialPool in several threads.
    """

    slots: int
    tick: Tick

    def give(self, slot: int, task: Any) -> None:
        """Start a task in a worker that has none."""

    def wait(self, timeout_s: float) -> list[Event]:
        """What has happened, at least one thing unless the time ran out first."""
        ...

    def close(self) -> None:
        """End all workers: each finishes the images it has at hand, and what they hold is free."""


# ---- Tasks given to the workers of a pool, and tried once more where a worker died ---------------

WAIT_S = 1.0


class Work:
    """Tasks for `run_tasks`, and what becomes of them."""

    def tick(self, slot: int, outcome: Outcome) -> None:
        """Hear of an image that a worker is done with."""

    def take(self, slot: int) -> Any:
        """The next task for an idle worker; None where there is none for now."""
        raise NotImplementedError

    def later_s(self) -> float | None:
        """In how many seconds to ask again although no worker is busy; None: all is done."""
        return None

    def retry(self, slot: int, task: Any, why: str) -> Sequence[Any]:
        """What to try, each while no other worker is busy, after the task's worker died or memory
        ran out.
        """
        return [task]

    def done(self, slot: int, task: Any, result: Any) -> None:
        """The task's result, or a TaskFailed."""
        raise NotImplementedError

    def lost(self, slot: int, task: Any, how: str) -> None:
        """The task's worker died when it was tried alone, too."""
        raise NotImplementedError


def run_tasks(
    pool: WorkerPool,
    work: Work,
    *,
    slots: int | None = None,
    idle: Callable[[], None] = lambda: None,
) -> None:
    """Do all of the work. slots: of so many workers only. idle: called now and then between events.
    Raises OutputError: a worker could not write.
    """
    pool.tick = work.tick
    trials: deque[Any] = deque()
    busy: dict[int, Any] = {}  # by slot
    is_trial = False  # the one task that is being done
    while True:
        if trials and not busy:  # alone: memory may be what it died of
            busy[0], is_trial = trials.popleft(), True
            pool.give(0, busy[0])
        for slot in range(slots or pool.slots):
            if trials or is_trial:
                break
            if slot not in busy and (task := work.take(slot)) is not None:
                busy[slot] = task
                pool.give(slot, task)
        if not busy:
            later_s = work.later_s()
            if later_s is None:
                return
            time.sleep(min(WAIT_S, later_s))
        for event in pool.wait(WAIT_S) if busy else ():
            slot, task = event.slot, busy.pop(event.slot)
            result = event.result if isinstance(event, Finished) else None
            failed = result if isinstance(result, TaskFailed) else None
            if failed and failed.is_output:  # nothing can be written any more
                raise OutputError(failed.text)
            if isinstance(event, Lost) and is_trial:
                work.lost(slot, task, event.how)
            elif isinstance(event, Lost):
                trials += work.retry(slot, task, f"its worker {event.how}")
            elif failed and failed.of_memory and not is_trial:
                trials += work.retry(slot, task, failed.text)
            else:
                work.done(slot, task, result)
        is_trial = is_trial and bool(busy)
        idle()


def _untold(slot: int, outcome: Outcome) -> None:
    """For a pool that does no work yet."""


# ---- This process alone --------------------------------------------------------------------------


class SerialPool:
    """One worker, which is this process; it works while it is waited for."""

    slots = 1

    def __init__(self, setup: WorkerSetup) -> None:
        self.tick: Tick = _untold
        self._worker = setup.worker(lambda outcome: self.tick(0, outcome))
        self._task: Any = None

    def give(self, slot: int, task: Any) -> None:
        self._task = task

    def wait(self, timeout_s: float) -> list[Event]:
        task, self._task = self._task, None
        return [] if task is None else [Finished(0, self._worker.do(task))]

    def close(self) -> None:
        self._task = None


# ---- A pool of worker processes on this machine, each with a scene of its own --------------------
# One that dies is replaced; all end when this process does.

STOP_S = 60.0  # how long a worker may take to finish the images it has at hand


class _Worker(ChildProcess):
    slot = 0
    has_task = False


class ProcessPool:
    """`slots` worker processes that share the cores. Raises ClimateGSError: from wait: a process
    ended while starting, and none has ever started.
    """

    def __init__(self, setup: WorkerSetup, slots: int) -> None:
        self.slots, self.tick = slots, _untold
        self._setup = setup
        self._threads = max(1, available_cores() // slots)
        self._workers: dict[int, _Worker] = {}  # by slot
        self._has_started = False  # any of them

    def give(self, slot: int, task: Any) -> None:
        worker = self._workers.get(slot)
        if worker is None:
            # No daemon: on trial it has processes of its own. It ends when the connection does.
            arguments = (self._setup, self._threads)
            worker = _Worker(_main, *arguments, threads=self._threads, daemon=False)
            self._workers[slot] = worker
            worker.slot = slot
        worker.has_task = True
        worker.send(task)

    def wait(self, timeout_s: float) -> list[Event]:
        deadline = time.monotonic() + timeout_s
        while True:
            left = deadline - time.monotonic()
            messages = list(receive(self._workers.values(), max(0.0, left)))
            self._has_started |= any(worker.is_ready for worker in self._workers.values())
            events = [event for w, message in messages if (event := self._event_of(w, message))]
            if events or left <= 0:
                return events

    def close(self) -> None:
        workers, self._workers = list(self._workers.values()), {}
        try:
            for worker in workers:
                worker.send(None)
            deadline = time.monotonic() + STOP_S
            for worker in workers:  # what one still sends is taken in, or it would block on it
                source = worker.connection
                with contextlib.suppress(EOFError, OSError):
                    while (left := deadline - time.monotonic()) > 0 and source.poll(left):
                        self._event_of(worker, source.recv())
        finally:
            for worker in workers:
                worker.kill()

    def _event_of(self, worker: _Worker, message: Any) -> Event | None:
        if isinstance(message, Ended):
            del self._workers[worker.slot]
            if not self._has_started:
                raise failed_start(message.how)
            return Lost(worker.slot, message.how) if worker.has_task else None
        if isinstance(message, Outcome):
            self.tick(worker.slot, message)
            return None
        worker.has_task = False
        return Finished(worker.slot, message)


def _main(connection: Connection, setup: WorkerSetup, threads: int) -> None:
    limit_threads(threads)
    send = sender(connection)
    # A shell's background job ignores Ctrl-C, and so would `interrupt_main`.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    worker = setup.worker(send)
    working = threading.Event()
    inbox = inbox_of(connection, lambda: _thread.interrupt_main() if working.is_set() else None)
    send(READY)
    with contextlib.suppress(KeyboardInterrupt):  # asked to stop in the midst of a block
        while (task := inbox.get()) is not None:
            working.set()
            try:
                result = worker.do(task)
            finally:
                working.clear()
            send(result)


# ---- A pool of actors on a Ray cluster, each with a scene of its own -----------------------------
# What is rendered goes straight from the actors to the output; through Ray pass the tasks, and word
# of every image. Ray is an optional extra, imported only when such a pool is made.

_OBJECTS_BYTES = 100 << 20  # for objects of Ray's; tasks and results are far smaller
_STARTS = 3  # in a row that may be lost, with their machines say, before the job ends
_PATIENCE_S = 60.0  # without a worker, before the log says so
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_log = logging.getLogger(__name__)


def import_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ClimateGSError(
            f'the executor "ray" needs Ray ({error}): pip install "climategs[ray]"'
        ) from error
    return ray


def connect(ray: Any, slots: int | None) -> bool:
    """Connect to a cluster unless this process is. Returns whether it was started here."""
    if ray.is_initialized():
        return False
    address = os.environ.get("RAY_ADDRESS", "")
    if address.startswith("ray://"):
        raise ClimateGSError(
            f"RAY_ADDRESS is {address}: Ray's client protocol is not supported; start the job on a "
            f"machine of the cluster (`ray job submit`, or RAY_ADDRESS=auto there)"
        )
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    is_ours = address in ("", "local")
    if is_ours:
        options |= {
            "address": "local",
            "num_cpus": slots or available_cores(),
            "include_dashboard": False,
            "object_store_memory": _OBJECTS_BYTES,
            # Workers import from where this process does, as those of other executors.
            "runtime_env": {
                "env_vars": {"PYTHONPATH": os.pathsep.join(p or "." for p in sys.path)}
            },
        }
    # What Ray starts sends nothing home, unless the user has said that it may.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with _own_sigterm():
        try:
            ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            where = "start Ray here" if is_ours else f"reach the Ray cluster at {address}"
            raise ClimateGSError(f"cannot {where}: {last_line(error)}") from error
    return is_ours


@contextlib.contextmanager
def _own_sigterm() -> Iterator[None]:
    """Ray sets a handler for SIGTERM when it connects: put back the one there was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def last_line(error: Exception) -> str:
    """The end of an error's text, where a remote traceback says what happened."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:300] if lines else type(error).__name__


class RayPool:
    """`slots` actors of one CPU each, as many as the cluster has CPUs if None; where the backend is
    `cuda`, of a GPU and its share of the CPUs, as many as there are GPUs. They run on the cluster
    that this process is connected to, else on the one that RAY_ADDRESS names, else on one that is
    started here and ends with the pool. One that dies is replaced; where the cluster has no room
    for all, those that run do the work of the others. Raises ClimateGSError: Ray is missing, or the
    cluster cannot be reached; from wait: actors cannot start, or no machine of the cluster has a
    GPU.
    """

    def __init__(self, setup: WorkerSetup, slots: int | None) -> None:
        self._ray = import_ray()
        self._setup, self.tick = setup, _untold
        on_gpu = setup.backend == CUDA
        self._is_ours = connect(self._ray, None if on_gpu else slots)
        self._cpus, self._gpus = (_cpus_of_a_gpu(self._ray), 1) if on_gpu else (1, 0)
        of_all = self._ray.cluster_resources().get("GPU" if on_gpu else "CPU", 1)
        self.slots = slots or max(1, int(of_all))
        self._workers: list[_ActorHandle | None] = [None] * self.slots
        self._given: dict[int, Any] = {}  # by slot, for want of a worker that is ready
        self._lost_starts = 0
        self._quiet_since = time.monotonic()
        self._warn_of_local_output()

    def give(self, slot: int, task: Any) -> None:
        self._given[slot] = task
        if self._workers[slot] is None:
            self._workers[slot] = self._start()
        self._dispatch()

    def wait(self, timeout_s: float) -> list[Event]:
        deadline = time.monotonic() + timeout_s
        while True:
            self._dispatch()
            sources = {w.source: slot for slot, w in enumerate(self._workers) if w and w.source}
            if not sources:
                return []
            left = deadline - time.monotonic()
            for source in self._ray.wait(list(sources), timeout=max(0.0, left))[0]:
                event = self._read(sources[source])
                if event is not None:
                    return [event]
            if left <= 0:
                self._complain()
                return []

    def close(self) -> None:
        workers = [worker for worker in self._workers if worker is not None]
        self._workers, self._given = [None] * self.slots, {}
        if not self._ray.is_initialized():
            return
        try:
            self._finish([worker for worker in workers if worker.stream is not None])
        finally:
            for worker in workers:
                self._ray.kill(worker.actor)
            if self._is_ours:
                self._ray.shutdown()

    def _start(self) -> _ActorHandle:
        options = {
            "num_cpus": self._cpus,
            "num_gpus": self._gpus,
            "max_restarts": 0,  # the pool sees every death, and the block is tried alone
            "max_task_retries": 0,
            "max_concurrency": 2,  # a stop comes in beside the work
            "scheduling_strategy": "SPREAD",
            "runtime_env": {"env_vars": self._environment()},
        }
        actor = self._ray.remote(_Actor).options(**options).remote(self._setup, self._cpus)
        return _ActorHandle(actor, actor.version.remote())

    def _environment(self) -> dict[str, str]:
        limits: dict[str, str] = dict.fromkeys(_THREADS, str(self._cpus))
        return limits if self._gpus else {**limits, "CUDA_VISIBLE_DEVICES": ""}

    def _dispatch(self) -> None:
        """Send tasks to workers that are ready; a slot whose own is not swaps with an idle one."""
        for slot, task in list(self._given.items()):
            if not self._is_idle(slot):
                others = (s for s in range(self.slots) if s not in self._given and self._is_idle(s))
                other = next(others, None)
                if other is None:
                    continue
                workers = self._workers
                workers[slot], workers[other] = workers[other], workers[slot]
            worker = self._workers[slot]
            assert worker is not None
            worker.stream = worker.actor.do.remote(task)
            del self._given[slot]

    def _is_idle(self, slot: int) -> bool:
        worker = self._workers[slot]
        return worker is not None and worker.starting is None and worker.stream is None

    def _read(self, slot: int) -> Event | None:
        worker = self._workers[slot]
        assert worker is not None
        try:
            if worker.starting is not None:
                self._welcome(worker, self._ray.get(worker.starting))
                return None
            message = self._ray.get(next(worker.stream))
        except StopIteration:
            message = None
        except self._ray.exceptions.RayError as error:
            self._ray.kill(worker.actor)
            self._workers[slot] = None
            if worker.starting is None:
                return Lost(slot, _ending(error))
            self._failed_start(error)
            self._workers[slot] = self._start()
            return None
        if isinstance(message, Outcome):
            self.tick(slot, message)
            return None
        worker.stream = None
        if message is None:
            self._ray.kill(worker.actor)
            self._workers[slot] = None
            return Lost(slot, "ended in the midst of its work")
        return Finished(slot, message)

    def _welcome(self, worker: _ActorHandle, version: str) -> None:
        if version != augment.__version__:
            raise ClimateGSError(
                f"a machine of the Ray cluster has climategs {version}, this one "
                f"{augment.__version__}: install the same everywhere"
            )
        worker.starting = None
        self._lost_starts = 0

    def _failed_start(self, error: Exception) -> None:
        """Raise, unless it may be that only a machine was lost."""
        self._lost_starts += 1
        failed = getattr(error, "actor_init_failed", False)
        failed = failed or isinstance(error, self._ray.exceptions.RuntimeEnvSetupError)
        if failed or self._lost_starts >= _STARTS:
            raise ClimateGSError(
                f"a Ray actor failed while starting: {last_line(error)}. Every machine of the "
                f"cluster needs climategs, and whatever opens the scenes, installed in the same "
                f"version; if memory ran out, use fewer workers"
            ) from error

    def _finish(self, busy: list[_ActorHandle]) -> None:
        """Let actors finish the images at hand."""
        for worker in busy:
            worker.actor.stop.remote()
        deadline = time.monotonic() + STOP_S
        for worker in busy:
            with contextlib.suppress(self._ray.exceptions.RayError, StopIteration):
                while (left := deadline - time.monotonic()) > 0:
                    if self._ray.wait([worker.stream], timeout=left)[0]:
                        self._ray.get(next(worker.stream))

    def _complain(self) -> None:
        """Say so when nobody has been at work for long."""
        now = time.monotonic()
        if not self._given or any(worker and worker.stream for worker in self._workers):
            self._quiet_since = now
        elif now - self._quiet_since > _PATIENCE_S:
            self._quiet_since = now
            _log.warning("no CPU of the Ray cluster is free for a worker; waiting for one")

    def _warn_of_local_output(self) -> None:
        nodes = [node for node in self._ray.nodes() if node["Alive"]]
        if len(nodes) > 1 and "://" not in self._setup.output:
            _log.warning(
                "the Ray cluster has %d machines and the output is a folder, %s: it has to be a "
                "shared one, the same on all of them; else write to an object store (s3://...)",
                len(nodes),
                self._setup.output,
            )


@dataclass
class _ActorHandle:
    """An actor as the pool sees it. starting: its first answer, until that has come. stream: of
    the messages about the task that it is at.
    """

    actor: Any
    starting: Any
    stream: Any = None

    @property
    def source(self) -> Any:
        """What to wait for, if anything."""
        return self.stream if self.starting is None else self.starting


class _Actor:
    """The worker's own side, in a process somewhere on the cluster. Tasks are done in a thread of
    its own, which can be interrupted: Ray's main thread cannot.
    """

    def __init__(self, setup: WorkerSetup, threads: int) -> None:
        limit_threads(threads)
        self._inbox: SimpleQueue[Any] = SimpleQueue()
        self._outbox: SimpleQueue[Any] = SimpleQueue()
        self._worker = setup.worker(self._outbox.put)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def version(self) -> str:
        return augment.__version__

    def do(self, task: Any) -> Iterator[Any]:
        """Images as they are finished, then the result; that is missing where it was stopped."""
        self._inbox.put(task)
        while (message := self._outbox.get()) is not None:
            yield message
            if not isinstance(message, Outcome):
                return

    def stop(self) -> None:
        """As Ctrl-C: finish the images at hand, let go of the block, and do no more."""
        thread = ctypes.c_ulong(self._thread.ident or 0)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(KeyboardInterrupt))

    def _work(self) -> None:
        try:
            while True:
                self._outbox.put(self._worker.do(self._inbox.get()))
        except KeyboardInterrupt:
            pass
        finally:
            self._outbox.put(None)


def _cpus_of_a_gpu(ray: Any) -> int:
    """How many CPUs come to a GPU on the machine that has the fewest."""
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    shares = [int(m.get("CPU", 0) / m["GPU"]) for m in machines if m.get("GPU", 0)]
    if not shares:
        raise ClimateGSError(
            "backend 'cuda' on Ray: no machine of the cluster has a GPU that Ray knows of"
        )
    return max(1, min(shares))


def _ending(error: Exception) -> str:
    """How an actor ended, after "the worker ..."; Ray's account is long, and guesses."""
    text = str(error)
    if "OutOfMemoryError" in type(error).__name__ or "low on memory" in text:
        return "was ended by Ray because memory ran out"
    if "worker process has died" in text:
        return "was killed or crashed, or memory ran out"
    if "Unavailable" in type(error).__name__ or ("node" in text and "died" in text):
        return "was lost, perhaps with its machine"
    return f"was lost ({type(error).__name__}: {last_line(error)})"
