"""One file or link of a dataset's copy: put in place whole, and never through what is there.

A file is linked (one inode with the original) or copied, under a temporary name where another one
has the place; then the name is moved. So the original of a link that was there is never written.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from augment.batch.atomic import output_error, replaced_file, temporary_beside, temporary_names
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
        try:
            os.link(original, target, follow_symlinks=False)
        except FileExistsError:
            temporary = temporary_beside(Path(target))
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
    with replaced_file(Path(target), clear=False, flush=False) as file:
        source = os.open(original, os.O_RDONLY)
        try:
            at = 0
            while sent := os.sendfile(file.fileno(), source, at, 1 << 26):
                at += sent
            facts = os.fstat(source)
            os.utime(file.fileno(), ns=(facts.st_mtime_ns, facts.st_mtime_ns))
        finally:
            os.close(source)


def write_file(data: bytes, target: str, mtime_ns: int) -> None:
    """Write a file with that time of change.

    Raises:
        OutputError: the system refused; `target` is then as it was.
    """
    with replaced_file(Path(target), clear=False, flush=False) as file:
        file.write(data)
        file.flush()
        os.utime(file.fileno(), ns=(mtime_ns, mtime_ns))


def put_link(text: str, target: str) -> bool:
    """A symbolic link that says `text`; False where it is there already.

    Raises:
        OutputError: the system refused.
    """
    try:
        if os.path.islink(target) and os.readlink(target) == text:
            return False
        temporary = temporary_beside(Path(target))
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
        found = set(os.listdir(folder)) - expected
        left = set(temporary_names(found))
        for name in left:
            os.unlink(os.path.join(folder, name))
        others += sorted(found - left)
    except OSError as error:
        raise output_error(Path(folder), error) from error
    return others


def _facts(path: str) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None


def _move(temporary: Path, target: str) -> None:
    try:
        os.replace(temporary, target)
    finally:
        # Renaming does nothing where both names are links of one file already.
        temporary.unlink(missing_ok=True)
