"""The thread pool numba's kernels run on: TBB, which survives fork and serves several threads.

numba's own choice is often OpenMP, which kills DataLoader workers forked after the parent has
rendered. pip puts TBB's library where the loader does not look, so it is loaded by its path first.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numba

logger = logging.getLogger(__name__)

TBB_LIBRARY = "libtbb.so.12"
_FALLBACK = "workqueue"  # survives fork too, but runs one kernel at a time
_one_at_a_time = threading.RLock()


@functools.cache
def select_thread_pool() -> str:
    """Choose numba's threading layer, once, before its pool starts; returns the layer's name.

    A layer the user named (NUMBA_THREADING_LAYER) or a pool that runs already is left as it is.
    """
    try:
        return numba.threading_layer()  # the pool runs
    except ValueError:
        pass
    if numba.config.THREADING_LAYER != "default":
        return numba.config.THREADING_LAYER
    layer = "tbb" if _preload_tbb() else _FALLBACK
    if layer == _FALLBACK:
        logger.warning(
            "%s was not found, so renders run one after the other in this process; "
            "install the package 'tbb'",
            TBB_LIBRARY,
        )
    numba.config.THREADING_LAYER = layer
    return layer


def _preload_tbb() -> bool:
    """Load TBB with its symbols visible to numba's pool, which asks for it by name."""
    for path in (*_installed_libraries(), Path(sys.prefix) / "lib" / TBB_LIBRARY, TBB_LIBRARY):
        try:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        except OSError:
            continue
        return True
    return False


def _installed_libraries() -> list[Path]:
    try:
        files = importlib.metadata.files("tbb") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [Path(str(f.locate())).resolve() for f in files if f.name == TBB_LIBRARY]


@contextmanager
def kernel_threads(chunk: int = 1) -> Iterator[None]:
    """Around launches of parallel kernels: hands out work `chunk` iterations at a time.

    Iterations differ much in cost, and a fixed share a thread, numba's default, would leave the
    others waiting for the slowest.
    """
    alone = nullcontext() if select_thread_pool() != _FALLBACK else _one_at_a_time
    with alone, numba.parallel_chunksize(chunk):
        yield


def thread_count() -> int:
    """Threads that kernels launched from this thread use."""
    return numba.get_num_threads()


def limit_threads(count: int) -> None:
    """Use at most `count` threads for kernels launched from this thread.

    Call it in DataLoader workers, so that they do not all want every core.
    """
    if count < 1:
        raise ValueError(f"count must be >= 1 thread; got {count}")
    select_thread_pool()
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
