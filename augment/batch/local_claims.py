"""Claims among the processes of one machine: the kernel's lock of a file that comes and goes."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from augment.batch.atomic import is_named, make_folder, output_error
from augment.errors import OutputError

_MOST_RACES = 1000  # times that the file is deleted by its holder while it is being opened


class FileClaim:
    """A locked file; see Claim. The file is deleted by its holder, while it holds it."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor = descriptor
        self._process = os.getpid()

    def check(self) -> None:
        if self._descriptor < 0 or not is_named(self._path, self._descriptor):
            raise OutputError(
                f"the claim {self._path} is lost: its file was deleted or the claim released. Do "
                f"not delete {self._path.parent} while jobs are running; run the same command again"
            )

    def release(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor < 0 or self._process != os.getpid():
            return
        # First the name: after it, nobody else can open this file, and who has opened it already
        # sees that it has no name and opens the next one.
        try:
            if is_named(self._path, descriptor):
                self._path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # where there are no others
                    self._path.parent.rmdir()
        except OSError as error:
            raise output_error(self._path, error) from error
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # for forked children too
            os.close(descriptor)

    def __enter__(self) -> FileClaim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def try_lock(path: Path) -> FileClaim | None:
    """Lock the file, which is made if missing; None where another process holds it.

    Raises:
        OutputError: the system refused.
    """
    try:
        for _ in range(_MOST_RACES):
            make_folder(path.parent)
            try:
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            except FileNotFoundError:  # somebody has deleted the folder
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if is_named(path, descriptor):
                    return FileClaim(path, descriptor)
            except BlockingIOError:
                os.close(descriptor)
                return None
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)  # a holder has deleted it since: lock the next one
    except OSError as error:
        raise output_error(path, error) from error
    return None
