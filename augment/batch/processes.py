"""What worker processes need from the one that starts them."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")
_TURN_S = 0.0005


def process_mark(process: int) -> str:
    """The number of a living process and when it began, else "": numbers return, in containers
    with every run.
    """
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return ""
    except PermissionError:  # it lives, and belongs to another user
        pass
    try:
        facts = Path(f"/proc/{process}/stat").read_text(errors="replace")
    except OSError:  # no Linux
        return str(process)
    return f"{process} {facts.rpartition(')')[2].split()[19]}"  # proc(5): starttime


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_exit(code: int | None) -> str:
    if code is not None and code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


@contextlib.contextmanager
def thread_limits(threads: int) -> Iterator[None]:
    """Environment that makes a child's libraries share the cores; they read it when loaded."""
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    for name, value in before.items():
        limit = min(threads, int(value)) if value and value.isdigit() else threads
        os.environ[name] = str(max(1, limit))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def quick_turns(wanted: bool) -> Iterator[None]:
    """Within it, if it is wanted, a thread waits half a millisecond for its turn at Python and not
    five. One that launches kernels gives its turn away with each of them, and between two launches
    the GPU would wait for whoever encodes.
    """
    before = sys.getswitchinterval()
    if wanted:
        sys.setswitchinterval(min(before, _TURN_S))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """A child started inside never sees Ctrl-C: the parent tells it to stop instead."""
    resource_tracker.ensure_running()  # starting it later, with the child, would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def uninterrupted(call: Callable[[], Result]) -> Result:
    """Run where no signal's exception can come between two steps, and wait for the end.

    Python runs the handlers of signals in the main thread only.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call).result()


def sender(connection: Connection) -> Callable[[Any], None]:
    """In a worker: a send that several threads may call; ends the process if nobody listens."""
    lock = threading.Lock()

    def send(message: Any) -> None:
        with lock:
            try:
                connection.send(message)
            except OSError:
                os._exit(1)

    return send
