"""Folders that are replaced as a whole: readers find the old one or the new one, never a mixture.

The new folder is written beside the old under a temporary name, flushed to the disk, and changes
places with it in one step. What else the old folder held moves over afterwards.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from augment.batch.atomic import TEMPORARY_SUFFIX, flush_folder, make_folder, output_error

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h
_CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTTY, errno.EPERM)
_numbers = itertools.count()
_being_written: set[Path] = set()


@contextmanager
def replaced_folder(target: Path, own: Collection[str]) -> Iterator[Path]:
    """A new, empty folder that takes the place of `target` when the block ends without an error.

    own: names of the files that make up such a folder. They must all be written by the block, and
    those of the old folder are deleted; anything else in the old folder is kept.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `target` is then as it was.
    """
    target = target.resolve()  # a link to a folder stays a link
    new = target.with_name(f".{target.name}.{os.getpid()}-{next(_numbers)}{TEMPORARY_SUFFIX}")
    try:
        make_folder(target.parent)
        new.mkdir()
        _being_written.add(new)
        try:
            yield new
            for name in own:
                _flush_file(new / name)
            flush_folder(new)
            _put_in_place(new, target)
            flush_folder(target.parent)
            _clear_leftovers(target, own)
        finally:
            _being_written.discard(new)
            if new.is_dir():
                _clear(new, target, own)
    except OSError as error:
        raise output_error(target, error) from error


def _put_in_place(new: Path, target: Path) -> None:
    if not target.exists() or not any(target.iterdir()):
        os.rename(new, target)  # also over an empty folder
        return
    if _exchange(new, target):
        return
    # A file system that cannot exchange: for an instant the old folder has its temporary name only.
    old = new.with_name(new.name.removesuffix(TEMPORARY_SUFFIX) + ".old" + TEMPORARY_SUFFIX)
    os.rename(target, old)
    try:
        os.rename(new, target)
    except BaseException:
        os.rename(old, target)
        raise
    os.rename(old, new)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step (renameat2); False where the system or file system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    paths = os.fsencode(one), os.fsencode(other)
    if rename(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _CANNOT_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(other))


def _clear_leftovers(target: Path, own: Collection[str]) -> None:
    """Clear what killed processes left beside the folder."""
    pattern = re.compile(
        rf"\.{re.escape(target.name)}\.(\d+)-\d+(\.old)?{re.escape(TEMPORARY_SUFFIX)}"
    )
    for entry in list(target.parent.iterdir()):
        match = pattern.fullmatch(entry.name)
        if match and entry.is_dir() and not _is_in_use(entry, int(match[1])):
            _clear(entry, target, own)


def _clear(old: Path, target: Path, own: Collection[str]) -> None:
    """Delete a temporary folder. Entries that are not ours move to `target`; where they cannot,
    they and the folder stay, since nobody here may decide to delete them.
    """
    for entry in list(old.iterdir()):
        if entry.name in own:
            entry.unlink()
        elif target.is_dir() and not (target / entry.name).exists():
            os.rename(entry, target / entry.name)
    if not any(old.iterdir()):
        old.rmdir()


def _is_in_use(folder: Path, process_id: int) -> bool:
    if process_id == os.getpid():  # numbers return: it may be an earlier process's
        return folder in _being_written
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _flush_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
