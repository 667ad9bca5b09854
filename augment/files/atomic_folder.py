"""Folders that are replaced as a whole: readers find the old one or the new one, never a mixture.

The new folder is written beside the old under a temporary name, flushed to the disk, and changes
places with it in one step. What else the old folder held moves over afterwards.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from augment.jobs.atomic import (
    TEMPORARY_SUFFIX,
    flush_folder,
    hold_temporary,
    is_held,
    make_folder,
    output_error,
    temporary_beside,
    temporary_names,
)

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h
_CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTTY, errno.EPERM)


@contextmanager
def replaced_folder(target: Path, own: Collection[str]) -> Iterator[Path]:
    """A new, empty folder that takes the place of `target` when the block ends without an error.

    own: names of the files and folders that make up such a folder. Those of the old folder are
    deleted; anything else in the old folder is kept.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `target` is then as it was.
    """
    target = target.resolve()  # a link to a folder stays a link
    try:
        make_folder(target.parent)
        new, descriptor = _locked_folder(target)
        try:
            yield new
            for path in [*new.rglob("*"), new]:
                flush_folder(path)  # or a file
            _put_in_place(new, target)
            flush_folder(target.parent)
            _clear_leftovers(target, own)
        finally:
            _clear(new, target, own)
            os.close(descriptor)
    except OSError as error:
        raise output_error(target, error) from error


def _locked_folder(target: Path) -> tuple[Path, int]:
    while True:
        new = temporary_beside(target)
        new.mkdir()
        try:
            descriptor = os.open(new, os.O_RDONLY)
        except FileNotFoundError:  # taken for left behind
            continue
        if hold_temporary(new, descriptor):
            return new, descriptor
        os.close(descriptor)


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
    for name in temporary_names(os.listdir(target.parent), target.name):
        entry = target.with_name(name)
        try:
            descriptor = os.open(entry, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:  # a file, gone since, or another user's
            continue
        try:
            if not is_held(descriptor):
                _clear(entry, target, own)
        finally:
            os.close(descriptor)


def _clear(old: Path, target: Path, own: Collection[str]) -> None:
    """Delete a temporary folder. Entries that are not ours move to `target`; where they cannot,
    they and the folder stay, since nobody here may decide to delete them.
    """
    with suppress(FileNotFoundError):  # somebody else who saves there clears it too
        for entry in list(old.iterdir()):
            if entry.name in own and entry.is_dir():
                shutil.rmtree(entry)
            elif entry.name in own:
                entry.unlink()
            elif target.is_dir() and not (target / entry.name).exists():
                os.rename(entry, target / entry.name)
        if not any(old.iterdir()):
            old.rmdir()
