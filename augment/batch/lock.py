"""One job at a time in an output folder.

The lock is the kernel's (flock on `.climategs/lock`), so it ends with the processes that hold it,
however they end. Worker processes inherit it: after a job is killed, the folder stays locked until
its last worker has gone. flock does not reach across machines on every network file system.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from multiprocessing import reduction
from pathlib import Path
from typing import Any

from augment.batch.atomic import make_folder, output_error
from augment.batch.layout import STATE_FOLDER
from augment.batch.processes import process_mark
from augment.errors import OutputError

ORPHANS_S = 30.0  # how long to wait for the workers of a killed job to notice


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Be the only process of this machine inside; waits for the one that is, however it ends.

    Raises:
        OutputError: the file cannot be made.
    """
    try:
        make_folder(path.parent)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise output_error(path, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


class OutputLock:
    """Holds an output folder for this process while entered.

    Raises:
        OutputError: another job holds it, or the folder cannot be written.
    """

    def __init__(self, out_dir: Path) -> None:
        self._path = out_dir / STATE_FOLDER / "lock"
        self._descriptor = -1

    def __enter__(self) -> OutputLock:
        try:
            make_folder(self._path.parent)
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise output_error(self._path, error) from error
        try:
            self._acquire()
        except BaseException:
            os.close(self._descriptor)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)  # not unlocked: a child that still lives keeps its share

    def inherited(self) -> InheritedLock:
        """A share of the lock for a child process started with `multiprocessing`."""
        return InheritedLock(self._descriptor)

    def _acquire(self) -> None:
        deadline = time.monotonic() + ORPHANS_S
        while True:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
                if _is_held_by(holder) or time.monotonic() > deadline:
                    raise OutputError(
                        f"{self._path.parent.parent} is being written by another job"
                        + (f" (process {holder.split()[0]})" if holder else "")
                        + "; wait for it to end, or choose another output folder"
                    ) from None
                time.sleep(0.05)
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, process_mark(os.getpid()).encode(), 0)


class InheritedLock:
    """Keeps the lock's file open in a child process for as long as the child lives."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __reduce__(self) -> tuple:
        return (_inherit, (reduction.DupFd(self._descriptor),))


def _inherit(duplicate: Any) -> InheritedLock:
    return InheritedLock(duplicate.detach())


def _is_held_by(holder: str) -> bool:
    """Whether the process that took the lock lives; False while its number is being written."""
    number = holder.partition(" ")[0]
    return number.isdigit() and process_mark(int(number)) == holder
