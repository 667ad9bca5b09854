"""Worker processes that start at once: forks of a server that has imported what they need.

Started afresh, as the library does, each takes seconds for its imports. Where a test is not about
how workers start, it replaces `multiprocessing.get_context` by `quick_context`.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from multiprocessing import forkserver
from pathlib import Path

_FORK_SERVER = multiprocessing.get_context("forkserver")


def start_fork_server(*modules: str) -> None:
    """Start the server, with these modules and what label files need, and wait until it has them.

    Ctrl-C does not reach it.
    """
    multiprocessing.set_forkserver_preload([*modules, "pandas", "pyarrow.parquet"])
    path = os.environ.get("PYTHONPATH")
    # It is told of this process's sys.path, and in Python 3.11 leaves it unused.
    root = Path(__file__).parents[2]
    os.environ["PYTHONPATH"] = os.pathsep.join([str(root), path or ""])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        first = _FORK_SERVER.Process(target=int)
        first.start()
        first.join()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if path is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = path


def quick_context(method: str | None = None):
    """In place of `multiprocessing.get_context`, whatever it is asked for."""
    return _FORK_SERVER


def keep_in_forks() -> None:
    """Forks of this process use its server, and would look for it among their own children."""
    forkserver._forkserver.ensure_running = lambda: None
    multiprocessing.get_context = quick_context


def server_process() -> int | None:
    """The server's number, None where there is none."""
    return forkserver._forkserver._forkserver_pid
