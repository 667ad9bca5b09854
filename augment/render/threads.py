"""Threads of numba's kernels, and threads that draw one view each.

Kernels run on TBB, which survives fork and serves several callers. numba's own choice is often
OpenMP, which kills DataLoader workers that are forked after the parent has rendered. pip puts TBB's
library where the loader does not look, so it is loaded by its path first.
"""

# pyright: reportPrivateImportUsage=false, reportAttributeAccessIssue=false
# (numba has no types: its settings are attributes made at run time)

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import logging
import math
import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

import numba
import torch
from torch.utils.data import get_worker_info

from augment.errors import BackendUnavailable

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

# File name of TBB's library.
TBB_LIBRARY = "libtbb.so.12"
# numba's own layer. It survives fork too, but two callers at a time end the process.
_ONE_CALLER = "workqueue"
# Folder of the control groups.
_CGROUP = Path("/sys/fs/cgroup")

_one_caller_at_a_time = threading.RLock()
# Thread limits by process id: a forked worker does not take its parent's limit.
_limits: dict[int, int] = {}


@functools.cache
def select_thread_pool() -> str:
    """Choose numba's threading layer, once, before its pool starts, and return the layer's name.

    A layer that the user named (NUMBA_THREADING_LAYER) and a running pool are left alone.

    Raises:
        BackendUnavailable: the layer that the user named cannot be used.
    """
    try:
        layer = numba.threading_layer()  # raises while no pool runs
    except ValueError:
        layer = numba.config.THREADING_LAYER
        has_tbb = _preload_tbb()
        if layer == "default":
            layer = numba.config.THREADING_LAYER = "tbb" if has_tbb else _ONE_CALLER
        else:
            layer = _start_named(layer)
    else:
        if layer == "omp":
            logger.warning(
                "numba's threads run on OpenMP already, so worker processes forked from here "
                "cannot render; call augment.render.threads.select_thread_pool() before anything "
                "else that uses numba, or start workers with 'spawn'"
            )
    if layer == _ONE_CALLER:
        logger.warning(
            "%s was not found, so threads of this process render one after the other; "
            "install the package 'tbb'",
            TBB_LIBRARY,
        )
    return layer


def _start_named(layer: str) -> str:
    """Start numba's pool on the layer that the user named, which may stand for several (`safe`).

    Returns the name of the layer that it runs on.
    """
    try:
        numba.get_num_threads()  # starts the pool
        return numba.threading_layer()
    except ValueError as error:
        reason = str(error).splitlines()[0].rstrip(".")
        hint = ": install the package 'tbb'" if layer == "tbb" else ""
        raise BackendUnavailable(
            f"NUMBA_THREADING_LAYER={layer}: {reason}{hint}; or leave the variable unset, and "
            f"a layer that works is chosen (numba has tbb, omp, workqueue, safe, forksafe, "
            f"threadsafe)"
        ) from None


def _preload_tbb() -> bool:
    """Load TBB with its symbols visible, so that numba's pool finds it by name."""
    try:
        files = importlib.metadata.files("tbb") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    installed_paths = [Path(str(f.locate())).resolve() for f in files if f.name == TBB_LIBRARY]
    for path in (*installed_paths, Path(sys.prefix) / "lib" / TBB_LIBRARY, TBB_LIBRARY):
        try:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        except OSError:
            continue
        return True
    return False


@contextmanager
def kernel_threads(chunk: int = 1) -> Iterator[None]:
    """Give the parallel kernels that are launched inside as many threads as `num_kernel_threads`
    says.

    Work is handed out `chunk` iterations at a time, which keeps all threads busy. Iterations differ
    much in cost; with numba's default, one equal share per thread, all would wait for the slowest.
    """
    caller_lock = _one_caller_at_a_time if select_thread_pool() == _ONE_CALLER else nullcontext()
    num_threads_before = numba.get_num_threads()
    with caller_lock, numba.parallel_chunksize(chunk):
        numba.set_num_threads(num_kernel_threads())
        try:
            yield
        finally:
            numba.set_num_threads(num_threads_before)


def num_kernel_threads() -> int:
    """Return the number of threads that kernels launched from this thread use.

    The number is at most numba's own setting and the limit of `limit_threads`. Without such a limit
    it is one in a DataLoader worker, whose siblings want the other cores. Elsewhere it is the
    number of cores that this process may use.
    """
    select_thread_pool()
    limit = _limits.get(os.getpid())
    if limit is None:
        limit = usable_cores() if get_worker_info() is None else 1
    return min(limit, numba.get_num_threads())


def has_concurrent_kernels() -> bool:
    """Return True if several threads of this process can run kernels at the same time."""
    return select_thread_pool() != _ONE_CALLER


# Bytes of work space per splat of a thread that draws its own views.
BYTES_PER_SPLAT = 110
# Bytes of work space of all such threads but the first.
MAX_WORK_SPACE_BYTES = 1 << 29


def num_concurrent_views(gaussians: int) -> int:
    """Return how many views of so many Gaussians are drawn at a time, one thread each."""
    if not has_concurrent_kernels():
        return 1
    return min(
        num_kernel_threads(), 1 + MAX_WORK_SPACE_BYTES // (BYTES_PER_SPLAT * max(gaussians, 1))
    )


def split_threads(count: int) -> ThreadPoolExecutor:
    """Return a pool of `count` threads for whole tasks. They divide the threads of the calling one.

    The calling thread's share is `num_kernel_threads`.
    """
    total = num_kernel_threads()
    torch_threads = torch.get_num_threads()
    all_started = threading.Barrier(count + 1)

    def start(number: int) -> None:
        share = max(1, total // count + (number < total % count))
        numba.set_num_threads(share)  # both are settings of this thread
        torch.set_num_threads(min(share, torch_threads))
        all_started.wait()

    pool = ThreadPoolExecutor(count, thread_name_prefix="view")
    try:
        for number in range(count):  # each task holds its thread until all threads have one
            pool.submit(start, number)
        all_started.wait()
    except BaseException:
        all_started.abort()
        pool.shutdown(wait=False)
        raise
    torch.set_num_threads(torch_threads)  # torch gives new threads the number that was set last
    return pool


def limit_threads(count: int | None) -> None:
    """Use at most `count` threads for every kernel of this process; None removes the limit."""
    if count is None:
        _limits.pop(os.getpid(), None)
    elif count >= 1:
        _limits[os.getpid()] = count
    else:
        raise ValueError(f"count must be >= 1 thread, or None for no limit; got {count}")


def usable_cores() -> int:
    """Return the cores that this process may use: its affinity and its container's quota."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return min(cores, _container_cores() or cores)


@functools.cache
def _container_cores() -> int | None:
    """Return the control group's CPU quota in cores, rounded up; None without a quota."""
    try:
        quota, period = (_CGROUP / "cpu.max").read_text().split()
    except (OSError, ValueError):
        try:
            quota = (_CGROUP / "cpu" / "cpu.cfs_quota_us").read_text().strip()
            period = (_CGROUP / "cpu" / "cpu.cfs_period_us").read_text().strip()
        except OSError:
            return None
    if not quota.isdigit() or not period.isdigit():  # "max" and -1: no quota
        return None
    return max(1, math.ceil(int(quota) / max(int(period), 1)))


def wait_for_result(future: Future[Result]) -> Result:
    """Return the future's result.

    An interrupt in `future.result()` can end as a RuntimeError of its lock, if it comes when the
    lock has just been released; a SimpleQueue has no such moment.
    """
    queue = SimpleQueue()
    future.add_done_callback(queue.put)
    queue.get()
    return future.result()
