"""Files that are complete under their final name, or not there at all.

A file is written under a temporary name in its own folder, flushed to the disk, and renamed; then
the folder is flushed, so that the name survives a power cut too.
"""

from __future__ import annotations

import errno
import itertools
import os
from pathlib import Path

from augment.errors import OutputError

TEMPORARY_SUFFIX = ".climategs-tmp"
_numbers = itertools.count()

_HINTS = {
    errno.ENOSPC: "the disk is full: free some space and run the same command again",
    errno.EDQUOT: "the disk quota is used up: free some space and run the same command again",
    errno.EFBIG: "the file is larger than this system allows (see `ulimit -f`)",
    errno.EACCES: "the folder is not writable for this user: change its permissions or choose "
    "another output folder",
    errno.EPERM: "the folder is not writable for this user: change its permissions or choose "
    "another output folder",
    errno.EROFS: "the file system is mounted read-only: choose another output folder",
    errno.ENOTDIR: "a part of this path is a file, not a folder: choose another output folder",
    errno.EEXIST: "a file of this name is in the way: choose another output folder",
}


def write_atomic(path: Path, data: bytes) -> None:
    """Put `data` at `path`, replacing what was there in one step; makes missing folders.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `path` is then as it was.
    """
    try:
        make_folder(path.parent)
        temporary = path.with_name(f".{path.name}.{os.getpid()}-{next(_numbers)}{TEMPORARY_SUFFIX}")
        try:
            _write_flushed(temporary, data)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        flush_folder(path.parent)
    except OSError as error:
        raise output_error(path, error) from error


def make_folder(folder: Path) -> None:
    """Create the folder and its missing parents, each flushed into the one above it."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    flush_folder(folder.parent)


def flush_folder(folder: Path) -> None:
    """Make the names inside the folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some network file systems cannot flush a folder
            raise
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path, *, recursive: bool = True) -> None:
    """Delete what a killed run left under temporary names."""
    pattern = f".*{TEMPORARY_SUFFIX}"
    for path in folder.rglob(pattern) if recursive else folder.glob(pattern):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise output_error(path, error) from error


def output_error(path: Path, error: OSError) -> OutputError:
    """An OutputError that names the file and says what to do."""
    hint = _HINTS.get(error.errno or 0, "check the disk, then run the same command again")
    return OutputError(f"cannot write {path}: {error.strerror}; {hint}")


def _write_flushed(path: Path, data: bytes) -> None:
    descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
