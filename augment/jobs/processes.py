"""Processes of jobs: child processes, interrupts, the output's lock, a shared scene.

`pools` starts worker processes with it, and `render_job` shares an open scene with them. `tools`
and `adapters` ask it for cores.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import io
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import reduction, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO, TypeVar

import numpy as np
import torch

from augment.errors import ClimateGSError, OutputError
from augment.output.atomic import (
    MAX_MARK_BYTES,
    lock_holder,
    make_folder,
    make_output_error,
    open_lock,
    path_below,
    temporary_path,
    wait_for_lock,
)
from augment.output.names import STATE_FOLDER
from augment.render.threads import wait_for_result
from augment.scene.cameras import Frame
from augment.scene.scene import Scene

Result = TypeVar("Result")
# Longest turn of a thread at Python beside a thread that launches kernels, seconds.
_TURN_S = 0.0005


def process_mark(process: int) -> str:
    """Return the number of a living process and its start time; empty if it does not live.

    Process numbers are used again, in containers in every run.
    """
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return ""
    except PermissionError:  # the process lives, and belongs to another user
        pass
    try:
        stat_text = Path(f"/proc/{process}/stat").read_text(errors="replace")
    except OSError:  # no Linux
        return str(process)
    return f"{process} {stat_text.rpartition(')')[2].split()[19]}"  # proc(5): starttime


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# First message of a child that can work.
READY = "ready"


class ChildProcess:
    """Process that is started afresh (`spawn`), at the other end of a connection."""

    is_ready = False

    def __init__(
        self, target: Callable[..., None], *arguments: Any, threads: int, daemon: bool
    ) -> None:
        """Start the process.

        Args:
            target: Called with the child's connection and the arguments.
            threads: Number of threads that the child may use.
        """
        context = multiprocessing.get_context("spawn")
        self.connection, child_connection = context.Pipe()
        self._process = context.Process(
            target=target, args=(child_connection, *arguments), daemon=daemon
        )
        with thread_limits(threads), block_interrupts():
            self._process.start()
        child_connection.close()

    def send(self, message: Any) -> None:
        """Send a message; that a child has just died shows when its connection is read."""
        with contextlib.suppress(OSError):
            self.connection.send(message)

    def reap(self) -> str:
        """Wait for the process to end, and return how it ended: "was killed by SIGKILL", say."""
        self._process.join()
        self.connection.close()
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def kill(self) -> None:
        self._process.kill()
        self.reap()


@dataclass(frozen=True)
class Ended:
    """Stands in place of a child's message: the child has ended."""

    how: str
    """Ending of the child, after "the worker ..."."""


_Child = TypeVar("_Child", bound=ChildProcess)


def receive(children: Collection[_Child], timeout_s: float | None) -> Iterator[tuple[_Child, Any]]:
    """Yield the next message of each child that has sent one, or Ended.

    READY is noted and left out.
    """
    ready_connections = wait([child.connection for child in children], timeout_s)
    for child in [child for child in children if child.connection in ready_connections]:
        try:
            message = child.connection.recv()
        except (EOFError, OSError):
            message = Ended(child.reap())
        if message == READY:
            child.is_ready = True
        else:
            yield child, message


def inbox_of(connection: Connection, on_stop: Callable[[], object]) -> SimpleQueue:
    """Return the queue of the parent's messages, in a child.

    A thread beside the work receives them, so that a stop (None) or the parent's end is noticed at
    once. When the parent ends, the child ends too.

    Args:
        on_stop: Called at a stop.
    """
    inbox = SimpleQueue()

    def listen() -> None:
        while True:
            try:
                message = connection.recv()
            except (EOFError, OSError):
                os._exit(1)  # what is finished is on the disk
            inbox.put(message)
            if message is None:
                on_stop()

    threading.Thread(target=listen, daemon=True).start()
    return inbox


def failed_start(ending: str) -> ClimateGSError:
    """Return the error of a worker that ended before it was ready."""
    return ClimateGSError(
        f"a worker process {ending} while starting; what it printed says more. A script that "
        f"starts workers needs `if __name__ == '__main__':` around its jobs; if memory ran out, "
        f"use fewer workers"
    )


def limit_threads(threads: int) -> None:
    """Limit the threads of a worker's libraries; OpenCV gets only the calling thread."""
    import cv2

    torch.set_num_threads(threads)
    cv2.setNumThreads(1)


@contextlib.contextmanager
def thread_limits(threads: int) -> Iterator[None]:
    """Context manager of an environment that makes a child's libraries share the cores.

    The libraries read it when they are loaded.
    """
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    old_values = {name: os.environ.get(name) for name in names}
    for name, value in old_values.items():
        limit = min(threads, int(value)) if value and value.isdigit() else threads
        os.environ[name] = str(max(1, limit))
    try:
        yield
    finally:
        for name, value in old_values.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def shorten_switch_interval(is_enabled: bool) -> Iterator[None]:
    """Context manager that shortens a thread's wait for Python from five milliseconds to 0.5.

    A thread that launches kernels gives its turn away with each kernel, and the GPU would wait for
    the thread that encodes.

    Args:
        is_enabled: If False, nothing changes.
    """
    old_interval_s = sys.getswitchinterval()
    if is_enabled:
        sys.setswitchinterval(min(old_interval_s, _TURN_S))
    try:
        yield
    finally:
        sys.setswitchinterval(old_interval_s)


@contextlib.contextmanager
def block_interrupts() -> Iterator[None]:
    """Context manager in which started children never see Ctrl-C; the parent stops them instead."""
    resource_tracker.ensure_running()  # starting it later, with the child, would lift the block
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)


def run_uninterrupted(call: Callable[[], Result]) -> Result:
    """Run a call where no signal's exception can come between two steps: not in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return call()
    with ThreadPoolExecutor(1) as pool:
        return wait_for_result(pool.submit(call))


def sender(connection: Connection) -> Callable[[Any], None]:
    """Return a send function that several threads of a worker may call.

    It ends the process if the parent has gone.
    """
    lock = threading.Lock()

    def send(message: Any) -> None:
        with lock:
            try:
                connection.send(message)
            except OSError:
                os._exit(1)

    return send


# ---- One job at a time in an output folder -------------------------------------------------------
# The lock is the kernel's (flock on `.climategs/lock`), so it ends with the processes that hold it,
# however they end. Workers inherit it: after a job is killed, the folder stays locked until its
# last worker has ended. flock does not reach across machines on every network file system.

# Longest wait for the workers of a killed job to end, seconds.
ORPHANS_S = 30.0
# Longest wait for a file that another process makes for all of them, seconds.
MAX_SHARING_S = 3600.0


@contextlib.contextmanager
def file_lock(path: Path, activity: str) -> Iterator[None]:
    """Context manager that only one process of this machine enters at a time.

    Args:
        activity: What is done inside, after "another process".

    Raises:
        OutputError: The wait takes too long.
    """
    descriptor = open_lock(path)
    try:
        wait_for_lock(path, descriptor, patience_s=MAX_SHARING_S, activity=activity)
        yield
    finally:
        os.close(descriptor)


class OutputLock:
    """Lock of an output folder, which this process holds while it is entered."""

    def __init__(self, out_dir: Path) -> None:
        self._path = out_dir / STATE_FOLDER / "lock"
        self._descriptor = -1

    def __enter__(self) -> OutputLock:
        path_below(self._path.parent.parent, (STATE_FOLDER,))
        self._descriptor = open_lock(self._path)
        try:
            self._acquire()
        except BaseException:
            os.close(self._descriptor)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)  # without unlocking: a child that still lives keeps its share

    def inherited(self) -> InheritedLock:
        """Return a share of the lock for a child process started with `multiprocessing`."""
        return InheritedLock(self._descriptor)

    def _acquire(self) -> None:
        """Lock the file, and write this process's mark into it.

        Waits for workers of a killed job.
        """
        deadline = time.monotonic() + ORPHANS_S
        while True:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                mark = os.pread(self._descriptor, MAX_MARK_BYTES, 0)
                holder = mark.decode("ascii", "replace").strip()
                if _is_held_by(holder) or time.monotonic() > deadline:
                    process = f" (process {holder.split()[0]})" if holder else ""
                    raise OutputError(
                        f"{self._path.parent.parent} is being written by another job"
                        f"{process or lock_holder(self._descriptor)}; wait for it to end, or "
                        f"choose another output folder"
                    ) from None
                time.sleep(0.05)
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, process_mark(os.getpid()).encode(), 0)


class InheritedLock:
    """Share of the lock that keeps its file open for as long as the child process lives."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __reduce__(self) -> tuple:
        return (_inherit, (reduction.DupFd(self._descriptor),))


def _inherit(duplicate: Any) -> InheritedLock:
    """Return the lock from a duplicated descriptor."""
    return InheritedLock(duplicate.detach())


def _is_held_by(holder: str) -> bool:
    """Return True if the process that took the lock lives.

    Returns False while its number is being written.
    """
    number = holder.partition(" ")[0]
    return number.isdigit() and process_mark(int(number)) == holder


# ---- An open scene in worker processes, neither opened again nor held in memory twice ------------
# All its tensors are written into one temporary file, which workers map into their memory. The
# other parts of the scene are small, and go through the pipe that starts the process.

# Alignment of tensors in the file, bytes: a cache line, and any vector register.
ALIGNMENT = 64


@dataclass(frozen=True)
class SharedScene:
    """A scene and frames to render of it, with their tensors in a file; valid until `remove`."""

    path: str
    """Path of the file."""
    skeleton: bytes
    """Pickle of the scene without its tensors."""

    def open(self) -> tuple[Scene, Sequence[Frame]]:
        """Return the scene and frames, with tensors mapped from the file.

        Writes to the tensors stay in this process. The skeleton is a pickle that comes from the
        parent through the pipe, never from a file.
        """
        load = ForkingPickler.loads  # pyright: ignore[reportAttributeAccessIssue]
        return load(self.skeleton)

    def remove(self) -> None:
        """Delete the file. Processes that have opened the scene keep their mapping."""
        Path(self.path).unlink(missing_ok=True)


def share_scene(scene: Scene, frames: Sequence[Frame], folder: Path) -> SharedScene:
    """Write the tensors into a temporary file of `folder`.

    A later job that holds the folder deletes leftovers.

    Raises:
        OutputError: The file cannot be written.
        ValueError: A part of the scene, such as its label source, cannot be sent to another
            process.
    """
    path = temporary_path(folder / "scene")
    try:
        make_folder(folder)
        with path.open("xb") as file:
            skeleton = io.BytesIO()
            try:
                _ScenePickler(skeleton, file, str(path)).dump((scene, frames))
            except (AttributeError, TypeError, pickle.PicklingError) as error:
                raise ValueError(
                    f"scene {scene.name!r} cannot be sent to worker processes: {error}; its label "
                    f"source and sky must be of importable classes that hold no open files. "
                    f"workers=1 works with any scene"
                ) from error
            file.write(b"\0" * ALIGNMENT)  # an empty file cannot be mapped
    except OSError as error:
        path.unlink(missing_ok=True)
        raise make_output_error(path, error) from error
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return SharedScene(str(path), skeleton.getvalue())


def check_sendable(renderer: object) -> None:
    """Raise ValueError where a job's renderer cannot be sent to other processes."""
    try:
        ForkingPickler.dumps(renderer)
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise ValueError(
            f"renderer {renderer!r} cannot be sent to worker processes: {error}; use a function "
            f"defined at the top of a module, or workers=1"
        ) from error


class _ScenePickler(pickle.Pickler):
    """Pickler that writes tensors to a file and keeps only their places."""

    def __init__(self, skeleton: io.BytesIO, file: BinaryIO, path: str) -> None:
        super().__init__(skeleton, protocol=pickle.HIGHEST_PROTOCOL)
        self._file = file
        self._path = path

    def reducer_override(self, obj: Any) -> Any:
        if not isinstance(obj, torch.Tensor):
            return NotImplemented
        array = obj.detach().contiguous().numpy()
        self._file.write(b"\0" * (-self._file.tell() % ALIGNMENT))
        offset = self._file.tell()
        self._file.write(array.data)
        return _map_tensor, (self._path, offset, array.dtype.str, array.shape)


def _map_tensor(path: str, offset: int, dtype: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Return a tensor mapped from the file."""
    return torch.from_numpy(np.ndarray(shape, dtype, buffer=_mapping(path), offset=offset))


@functools.lru_cache(maxsize=1)
def _mapping(path: str) -> np.memmap:
    """Return the file mapped into memory."""
    return np.memmap(path, np.uint8, mode="c")  # copy on write
