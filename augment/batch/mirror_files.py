"""One file or link of a dataset's copy: put in place whole, and never through what is there.

A file is linked (one inode with the original) or copied, under a temporary name where another one
has the place; then the name is moved. So the original of a link that was there is never written.
"""

from __future__ import annotations

import errno
import itertools
import os
import stat
from pathlib import Path

from augment.batch.atomic import TEMPORARY_SUFFIX, output_error
from augment.errors import OutputError

LINKED, COPIED = "linked", "copied"
# Another disk, a file system without hard links, another user's file, too many links to it.
_CANNOT_LINK = (
    errno.EXDEV,
    errno.EPERM,
    errno.EMLINK,
    errno.EOPNOTSUPP,
    errno.ENOTSUP,
    errno.ENOSYS,
)
_numbers = itertools.count()


def found_as(target: str, original: os.stat_result) -> str | None:
    """How the original is in place: LINKED, COPIED (same size and time), or None: it is not."""
    facts = _facts(target)
    if facts is None or not stat.S_ISREG(facts.st_mode):
        return None
    if (facts.st_dev, facts.st_ino) == (original.st_dev, original.st_ino):
        return LINKED
    same = (facts.st_size, facts.st_mtime_ns) == (original.st_size, original.st_mtime_ns)
    return COPIED if same else None


def link_file(original: str, target: str) -> bool:
    """Give the original a second name; False where the system cannot, and nothing has changed.

    Raises:
        OutputError: the system refused otherwise.
    """
    try:
        if _facts(target) is None:
            os.link(original, target, follow_symlinks=False)
            return True
        temporary = _temporary(target)
        os.link(original, temporary, follow_symlinks=False)
        _move(temporary, target)
    except OSError as error:
        if error.errno in _CANNOT_LINK:
            return False
        raise output_error(Path(target), error) from error
    return True


def copy_file(original: str, target: str) -> None:
    """Copy bytes and time of change.

    Raises:
        OutputError: the system refused; `target` is then as it was.
    """
    try:
        source = os.open(original, os.O_RDONLY)
        try:
            temporary = _temporary(target)
            try:
                _copy(source, temporary)
                _move(temporary, target)
            except BaseException:
                _remove(temporary)
                raise
        finally:
            os.close(source)
    except OSError as error:
        raise output_error(Path(target), error) from error


def write_file(data: bytes, target: str, mtime_ns: int) -> None:
    """Write a file with that time of change.

    Raises:
        OutputError: the system refused; `target` is then as it was.
    """
    temporary = _temporary(target)
    try:
        try:
            with open(temporary, "xb") as file:
                file.write(data)
                file.flush()
                os.utime(file.fileno(), ns=(mtime_ns, mtime_ns))
                os.fsync(file.fileno())
            _move(temporary, target)
        except BaseException:
            _remove(temporary)
            raise
    except OSError as error:
        raise output_error(Path(target), error) from error


def put_link(text: str, target: str) -> bool:
    """A symbolic link that says `text`; False where it is there already.

    Raises:
        OutputError: the system refused.
    """
    try:
        if os.path.islink(target) and os.readlink(target) == text:
            return False
        temporary = _temporary(target)
        os.symlink(text, temporary)
        _move(temporary, target)
    except OSError as error:
        raise output_error(Path(target), error) from error
    return True


def own_folder(folder: str) -> bool:
    """Make sure that a folder of the copy is a real one; True where it had to be made.

    Raises:
        OutputError: a link or file has its name, or the system refused.
    """
    facts = _facts(folder)
    if facts is None:
        try:
            os.mkdir(folder)
        except OSError as error:
            raise output_error(Path(folder), error) from error
        return True
    if not stat.S_ISDIR(facts.st_mode):
        kind = "a link" if stat.S_ISLNK(facts.st_mode) else "a file"
        raise OutputError(
            f"{folder} is {kind}; the copy of the dataset needs a folder of its own there, and "
            f"writes through no link. Delete it, or choose another output folder"
        )
    return False


def others_in(folder: str, expected: set[str]) -> list[str]:
    """Names in a folder of the copy that are not expected; what a killed run left is deleted."""
    others = []
    try:
        for name in sorted(set(os.listdir(folder)) - expected):
            if name.startswith(".") and name.endswith(TEMPORARY_SUFFIX):
                os.unlink(os.path.join(folder, name))
            else:
                others.append(name)
    except OSError as error:
        raise output_error(Path(folder), error) from error
    return others


def _facts(path: str) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None


def _temporary(target: str) -> str:
    name = f".{os.getpid()}-{next(_numbers)}{TEMPORARY_SUFFIX}"
    return os.path.join(os.path.dirname(target), name)


def _copy(source: int, path: str) -> None:
    # Exclusively: an old file of this name might be one with an original.
    descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        at = 0
        while sent := os.sendfile(descriptor, source, at, 1 << 26):
            at += sent
        facts = os.fstat(source)
        os.utime(descriptor, ns=(facts.st_mtime_ns, facts.st_mtime_ns))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _move(temporary: str, target: str) -> None:
    try:
        os.replace(temporary, target)
    except BaseException:
        _remove(temporary)
        raise


def _remove(path: str) -> None:
    if _facts(path) is not None:
        os.unlink(path)
