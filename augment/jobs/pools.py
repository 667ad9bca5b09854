"""Pools of workers in this process, in several processes or on a Ray cluster, and their work loop.

In: a setup, whose `setup.worker(on_outcome)` makes a worker where it runs, and `Work`, which gives
tasks. Out: results of tasks and outcomes of images. `render_job` and `generate` call it. Each
worker does one task at a time.
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
# Called with a slot and the outcome of an image that its worker has finished.
Tick = Callable[[int, Outcome], None]


@runtime_checkable
class Worker(Protocol):
    """Does one task after the other.

    An error that concerns only the task is returned as a TaskFailed; a raised error ends the
    process.
    """

    def do(self, task: Any) -> Any: ...


@runtime_checkable
class WorkerSetup(Protocol):
    """Everything that all workers of a job share; picklable."""

    @property
    def backend(self) -> str: ...

    @property
    def output(self) -> str:
        """Name of the output, for messages."""
        ...

    def worker(self, on_outcome: OnOutcome) -> Worker: ...


@dataclass(frozen=True)
class Finished:
    """Event: a worker has done its task."""

    slot: int
    """Slot of the worker."""
    result: Any
    """Result of its task."""


@dataclass(frozen=True)
class Lost:
    """Event: a worker died at its task, and another one takes its place."""

    slot: int
    """Slot of the worker."""
    how: str
    """Ending of the worker: "was killed by SIGKILL", say."""


Event = Finished | Lost


@runtime_checkable
class WorkerPool(Protocol):
    """Workers numbered 0 to slots - 1, each with at most one task.

    A pool calls `tick` for every finished image, in the thread that waits; a SerialPool calls it
    from several threads.
    """

    slots: int
    """Number of workers."""
    tick: Tick
    """Called with a slot and the outcome of each finished image."""

    def give(self, slot: int, task: Any) -> None:
        """Start a task in a worker that has none."""

    def wait(self, timeout_s: float) -> list[Event]:
        """Return the events that have happened, at least one unless the time runs out first."""
        ...

    def close(self) -> None:
        """End all workers: each finishes the images at hand, and releases what it holds."""


# ---- Tasks given to the workers of a pool, and tried once more where a worker died ---------------

# Longest wait for an event, seconds.
WAIT_S = 1.0


class Work:
    """Tasks for `run_tasks`, with the handling of their results."""

    def tick(self, slot: int, outcome: Outcome) -> None:
        """Handle an image that a worker has finished."""

    def take(self, slot: int) -> Any:
        """Return the next task for an idle worker; None where there is none for now."""
        raise NotImplementedError

    def later_s(self) -> float | None:
        """Return in how many seconds to ask again although no worker is busy.

        None when all is done.
        """
        return None

    def retry(self, slot: int, task: Any, reason: str) -> Sequence[Any]:
        """Return the tasks to try after the task's worker died or memory ran out.

        Each runs while no other worker is busy.
        """
        return [task]

    def done(self, slot: int, task: Any, result: Any) -> None:
        """Handle the task's result, or a TaskFailed."""
        raise NotImplementedError

    def lost(self, slot: int, task: Any, how: str) -> None:
        """Handle that the task's worker died also when it was tried alone."""
        raise NotImplementedError


def run_tasks(
    pool: WorkerPool,
    work: Work,
    *,
    slots: int | None = None,
    idle: Callable[[], None] = lambda: None,
) -> None:
    """Do all of the work.

    Args:
        slots: Number of workers to use; all if None.
        idle: Called now and then between events.

    Raises:
        OutputError: A worker could not write.
    """
    pool.tick = work.tick
    trials: deque[Any] = deque()
    task_of_slot: dict[int, Any] = {}
    is_trial = False  # True while the only running task is a trial
    while True:
        if trials and not task_of_slot:  # alone: its worker may have died of too little memory
            task_of_slot[0] = trials.popleft()
            is_trial = True
            pool.give(0, task_of_slot[0])
        for slot in range(slots or pool.slots):
            if trials or is_trial:
                break
            if slot not in task_of_slot and (task := work.take(slot)) is not None:
                task_of_slot[slot] = task
                pool.give(slot, task)
        if not task_of_slot:
            later_s = work.later_s()
            if later_s is None:
                return
            time.sleep(min(WAIT_S, later_s))
        for event in pool.wait(WAIT_S) if task_of_slot else ():
            slot = event.slot
            task = task_of_slot.pop(event.slot)
            result = event.result if isinstance(event, Finished) else None
            failure = result if isinstance(result, TaskFailed) else None
            if failure and failure.is_output:  # nothing can be written any more
                raise OutputError(failure.text)
            if isinstance(event, Lost) and is_trial:
                work.lost(slot, task, event.how)
            elif isinstance(event, Lost):
                trials += work.retry(slot, task, f"its worker {event.how}")
            elif failure and failure.of_memory and not is_trial:
                trials += work.retry(slot, task, failure.text)
            else:
                work.done(slot, task, result)
        is_trial = is_trial and bool(task_of_slot)
        idle()


def _ignore_outcome(slot: int, outcome: Outcome) -> None:
    """Do nothing; for a pool without work."""


# ---- This process alone --------------------------------------------------------------------------


class SerialPool:
    """Pool of one worker, which is this process; it works while it is waited for."""

    slots = 1

    def __init__(self, setup: WorkerSetup) -> None:
        self.tick: Tick = _ignore_outcome
        self._worker = setup.worker(lambda outcome: self.tick(0, outcome))
        self._task: Any = None

    def give(self, slot: int, task: Any) -> None:
        self._task = task

    def wait(self, timeout_s: float) -> list[Event]:
        task = self._task
        self._task = None
        return [] if task is None else [Finished(0, self._worker.do(task))]

    def close(self) -> None:
        self._task = None


# ---- A pool of worker processes on this machine, each with a scene of its own --------------------
# A process that dies is replaced; all end when this process does.

# Longest time for a worker to finish the images at hand, seconds.
STOP_S = 60.0


class _Worker(ChildProcess):
    slot = 0
    has_task = False


class ProcessPool:
    """Pool of `slots` worker processes that share the cores.

    Raises:
        ClimateGSError: From wait: a process ended while starting, and none has ever started.
    """

    def __init__(self, setup: WorkerSetup, slots: int) -> None:
        self.slots = slots
        self.tick = _ignore_outcome
        self._setup = setup
        self._threads = max(1, available_cores() // slots)
        self._workers: dict[int, _Worker] = {}  # by slot
        self._has_started = False  # True once any of them has started

    def give(self, slot: int, task: Any) -> None:
        worker = self._workers.get(slot)
        if worker is None:
            # No daemon: on trial it has child processes itself. It ends when the connection ends.
            arguments = (self._setup, self._threads)
            worker = _Worker(_main, *arguments, threads=self._threads, daemon=False)
            self._workers[slot] = worker
            worker.slot = slot
        worker.has_task = True
        worker.send(task)

    def wait(self, timeout_s: float) -> list[Event]:
        deadline = time.monotonic() + timeout_s
        while True:
            left_s = deadline - time.monotonic()
            messages = list(receive(self._workers.values(), max(0.0, left_s)))
            self._has_started |= any(worker.is_ready for worker in self._workers.values())
            events = [event for w, message in messages if (event := self._event_of(w, message))]
            if events or left_s <= 0:
                return events

    def close(self) -> None:
        workers = list(self._workers.values())
        self._workers = {}
        try:
            for worker in workers:
                worker.send(None)
            deadline = time.monotonic() + STOP_S
            for worker in workers:
                # Late messages are received, or the worker would block on sending them.
                connection = worker.connection
                with contextlib.suppress(EOFError, OSError):
                    while (left_s := deadline - time.monotonic()) > 0 and connection.poll(left_s):
                        self._event_of(worker, connection.recv())
        finally:
            for worker in workers:
                worker.kill()

    def _event_of(self, worker: _Worker, message: Any) -> Event | None:
        """Return the event of a worker's message; None for an image."""
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
    """Run a worker process: do tasks until the connection sends None."""
    limit_threads(threads)
    send = sender(connection)
    # A shell's background job ignores Ctrl-C, and so would `interrupt_main`.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    worker = setup.worker(send)
    working = threading.Event()
    inbox = inbox_of(connection, lambda: _thread.interrupt_main() if working.is_set() else None)
    send(READY)
    with contextlib.suppress(KeyboardInterrupt):  # stopped in the middle of a block
        while (task := inbox.get()) is not None:
            working.set()
            try:
                result = worker.do(task)
            finally:
                working.clear()
            send(result)


# ---- A pool of actors on a Ray cluster, each with a scene of its own -----------------------------
# Images go straight from the actors to the output; only tasks and outcomes of images pass through
# Ray. Ray is an optional extra, imported only when such a pool is made.

# Memory for Ray's objects, bytes; tasks and results are far smaller.
_OBJECT_STORE_BYTES = 100 << 20
# Starts in a row that may fail, for example with their machines, before the job ends.
_MAX_LOST_STARTS = 3
# Time without a worker after which a message says so, seconds.
_LOG_AFTER_S = 60.0
# Environment variables that limit the threads of libraries.
_THREAD_VARIABLES = (
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
)
_log = logging.getLogger(__name__)


def import_ray() -> Any:
    """Import Ray, or raise ClimateGSError that says how to install it."""
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ClimateGSError(
            f'the executor "ray" needs Ray ({error}): pip install "climategs[ray]"'
        ) from error
    return ray


def connect(ray: Any, slots: int | None) -> bool:
    """Connect to a cluster unless this process is connected.

    Returns:
        True if the cluster was started here.
    """
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
            "object_store_memory": _OBJECT_STORE_BYTES,
            # Workers import from the same folders as this process, as with other executors.
            "runtime_env": {
                "env_vars": {"PYTHONPATH": os.pathsep.join(p or "." for p in sys.path)}
            },
        }
    # Ray sends no usage statistics, unless the user has allowed it.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with _keep_sigterm_handler():
        try:
            ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            where = "start Ray here" if is_ours else f"reach the Ray cluster at {address}"
            raise ClimateGSError(f"cannot {where}: {last_line(error)}") from error
    return is_ours


@contextlib.contextmanager
def _keep_sigterm_handler() -> Iterator[None]:
    """Context manager that restores the handler for SIGTERM.

    Ray replaces it when it connects.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old_handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old_handler)


def last_line(error: Exception) -> str:
    """Return the last line of an error's text, where a remote traceback says what happened."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:300] if lines else type(error).__name__


class RayPool:
    """Pool of `slots` actors of one CPU each, as many as the cluster has CPUs if None.

    Where the backend is `cuda`, each actor has a GPU and its share of the CPUs, and there are as
    many actors as GPUs. They run on the cluster that this process is connected to, otherwise on the
    one that RAY_ADDRESS names, otherwise on one that is started here and ends with the pool. An
    actor that dies is replaced. Where the cluster has no room for all actors, those that run do the
    work of the others.

    Raises:
        ClimateGSError: Ray is missing, or the cluster cannot be reached. From wait: actors cannot
            start, or no machine of the cluster has a GPU.
    """

    def __init__(self, setup: WorkerSetup, slots: int | None) -> None:
        self._ray = import_ray()
        self._setup = setup
        self.tick = _ignore_outcome
        on_gpu = setup.backend == CUDA
        self._is_ours = connect(self._ray, None if on_gpu else slots)
        self._cpus, self._gpus = (_cpus_of_a_gpu(self._ray), 1) if on_gpu else (1, 0)
        num_units = self._ray.cluster_resources().get("GPU" if on_gpu else "CPU", 1)
        self.slots = slots or max(1, int(num_units))
        self._workers: list[_ActorHandle | None] = [None] * self.slots
        self._waiting_tasks: dict[int, Any] = {}  # by slot, waiting for a worker that is ready
        self._lost_starts = 0
        self._idle_since_s = time.monotonic()
        self._warn_of_local_output()

    def give(self, slot: int, task: Any) -> None:
        self._waiting_tasks[slot] = task
        if self._workers[slot] is None:
            self._workers[slot] = self._start()
        self._dispatch()

    def wait(self, timeout_s: float) -> list[Event]:
        deadline = time.monotonic() + timeout_s
        while True:
            self._dispatch()
            slot_of_source = {
                w.source: slot for slot, w in enumerate(self._workers) if w and w.source
            }
            if not slot_of_source:
                return []
            left_s = deadline - time.monotonic()
            for source in self._ray.wait(list(slot_of_source), timeout=max(0.0, left_s))[0]:
                event = self._read(slot_of_source[source])
                if event is not None:
                    return [event]
            if left_s <= 0:
                self._warn_when_idle()
                return []

    def close(self) -> None:
        workers = [worker for worker in self._workers if worker is not None]
        self._workers = [None] * self.slots
        self._waiting_tasks = {}
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
        """Start an actor."""
        options = {
            "num_cpus": self._cpus,
            "num_gpus": self._gpus,
            "max_restarts": 0,  # the pool notices every death, and tries the block alone
            "max_task_retries": 0,
            "max_concurrency": 2,  # a stop arrives beside the work
            "scheduling_strategy": "SPREAD",
            "runtime_env": {"env_vars": self._environment()},
        }
        actor = self._ray.remote(_Actor).options(**options).remote(self._setup, self._cpus)
        return _ActorHandle(actor, actor.version.remote())

    def _environment(self) -> dict[str, str]:
        """Return the actors' environment variables."""
        limits: dict[str, str] = dict.fromkeys(_THREAD_VARIABLES, str(self._cpus))
        return limits if self._gpus else {**limits, "CUDA_VISIBLE_DEVICES": ""}

    def _dispatch(self) -> None:
        """Send tasks to workers that are ready.

        A slot whose worker is not ready swaps with an idle one.
        """
        for slot, task in list(self._waiting_tasks.items()):
            if not self._is_idle(slot):
                idle_slots = (
                    s
                    for s in range(self.slots)
                    if s not in self._waiting_tasks and self._is_idle(s)
                )
                idle_slot = next(idle_slots, None)
                if idle_slot is None:
                    continue
                workers = self._workers
                workers[slot], workers[idle_slot] = workers[idle_slot], workers[slot]
            worker = self._workers[slot]
            assert worker is not None
            worker.stream = worker.actor.do.remote(task)
            del self._waiting_tasks[slot]

    def _is_idle(self, slot: int) -> bool:
        """Return True if the slot's worker is ready and has no task."""
        worker = self._workers[slot]
        return worker is not None and worker.starting is None and worker.stream is None

    def _read(self, slot: int) -> Event | None:
        """Return the event of a worker's next message; None for an image or a start."""
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
        """Note that an actor has started; refuse another version of this package."""
        if version != augment.__version__:
            raise ClimateGSError(
                f"a machine of the Ray cluster has climategs {version}, this one "
                f"{augment.__version__}: install the same everywhere"
            )
        worker.starting = None
        self._lost_starts = 0

    def _failed_start(self, error: Exception) -> None:
        """Raise ClimateGSError, unless perhaps only a machine was lost."""
        self._lost_starts += 1
        is_setup_failure = getattr(error, "actor_init_failed", False)
        is_setup_failure = is_setup_failure or isinstance(
            error, self._ray.exceptions.RuntimeEnvSetupError
        )
        if is_setup_failure or self._lost_starts >= _MAX_LOST_STARTS:
            raise ClimateGSError(
                f"a Ray actor failed while starting: {last_line(error)}. Every machine of the "
                f"cluster needs climategs, and whatever opens the scenes, installed in the same "
                f"version; if memory ran out, use fewer workers"
            ) from error

    def _finish(self, busy_workers: list[_ActorHandle]) -> None:
        """Let actors finish the images at hand."""
        for worker in busy_workers:
            worker.actor.stop.remote()
        deadline = time.monotonic() + STOP_S
        for worker in busy_workers:
            with contextlib.suppress(self._ray.exceptions.RayError, StopIteration):
                while (left_s := deadline - time.monotonic()) > 0:
                    if self._ray.wait([worker.stream], timeout=left_s)[0]:
                        self._ray.get(next(worker.stream))

    def _warn_when_idle(self) -> None:
        """Log a warning when no actor has worked for a long time."""
        now_s = time.monotonic()
        if not self._waiting_tasks or any(worker and worker.stream for worker in self._workers):
            self._idle_since_s = now_s
        elif now_s - self._idle_since_s > _LOG_AFTER_S:
            self._idle_since_s = now_s
            _log.warning("no CPU of the Ray cluster is free for a worker; waiting for one")

    def _warn_of_local_output(self) -> None:
        """Log a warning where several machines write to a local folder."""
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
    """The pool's side of an actor."""

    actor: Any
    """Handle of Ray."""
    starting: Any
    """Future of its first answer, until the answer has come."""
    stream: Any = None
    """Stream of the messages about its current task."""

    @property
    def source(self) -> Any:
        """Future or stream to wait for; None if there is none."""
        return self.stream if self.starting is None else self.starting


class _Actor:
    """The worker's side of an actor, in a process on the cluster.

    Tasks are done in a separate thread, which can be interrupted; Ray's main thread cannot.
    """

    def __init__(self, setup: WorkerSetup, threads: int) -> None:
        limit_threads(threads)
        self._inbox: SimpleQueue[Any] = SimpleQueue()
        self._outbox: SimpleQueue[Any] = SimpleQueue()
        self._worker = setup.worker(self._outbox.put)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def version(self) -> str:
        """Return the version of this package on the actor's machine."""
        return augment.__version__

    def do(self, task: Any) -> Iterator[Any]:
        """Yield outcomes of images as they are finished, then the result.

        There is no result if the task was stopped.
        """
        self._inbox.put(task)
        while (message := self._outbox.get()) is not None:
            yield message
            if not isinstance(message, Outcome):
                return

    def stop(self) -> None:
        """Finish the images at hand, release the block, and do no more, as with Ctrl-C."""
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
    """Return the number of CPUs for each GPU on the machine that has the fewest."""
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    shares = [int(m.get("CPU", 0) / m["GPU"]) for m in machines if m.get("GPU", 0)]
    if not shares:
        raise ClimateGSError(
            "backend 'cuda' on Ray: no machine of the cluster has a GPU that Ray knows of"
        )
    return max(1, min(shares))


def _ending(error: Exception) -> str:
    """Return how an actor ended, after "the worker ..."; Ray's own account is long, and guesses."""
    text = str(error)
    if "OutOfMemoryError" in type(error).__name__ or "low on memory" in text:
        return "was ended by Ray because memory ran out"
    if "worker process has died" in text:
        return "was killed or crashed, or memory ran out"
    if "Unavailable" in type(error).__name__ or ("node" in text and "died" in text):
        return "was lost, perhaps with its machine"
    return f"was lost ({type(error).__name__}: {last_line(error)})"
