"""Files that are complete under their final name, or not there at all.

A file is written under a temporary name in its own folder, flushed to the disk, and renamed; then
the folder is flushed, so that the name survives a power cut too.

Temporary names are random: in containers every run has the same process numbers. Who writes a
temporary file holds the kernel's lock of it (flock), which ends with the process, however that
ends. So whoever comes next can tell what a dead one left from what a living one is writing, on
other machines too where the file system has locks among them.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import logging
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from augment.errors import OutputError
from recipes.files import open_file

_log = logging.getLogger(__name__)

TEMPORARY_SUFFIX = ".climategs-tmp"
_MAX_SHOWN = 200  # bytes of the final name in the temporary one, which may have 255
_MAX_WRITING_S = 86400.0  # where the file system has no locks, older files count as left behind

_NOT_WRITABLE = (
    "the folder is not writable for this user: change its permissions or choose another output "
    "folder"
)
_HINTS = {
    errno.ENOSPC: "the disk is full: free some space and run the same command again",
    errno.EDQUOT: "the disk quota is used up: free some space and run the same command again",
    errno.EFBIG: "the file is larger than this system allows (see `ulimit -f`)",
    errno.EACCES: _NOT_WRITABLE,
    errno.EPERM: _NOT_WRITABLE,
    errno.EROFS: "the file system is mounted read-only: choose another output folder",
    errno.ENOTDIR: "a part of this path is a file, not a folder: choose another output folder",
    errno.EEXIST: "a file of this name is in the way: choose another output folder",
}


def write_atomic(path: Path, data: bytes, *, clear: bool = True) -> None:
    """Put `data` at `path`, replacing what was there in one step; see replaced_file."""
    with replaced_file(path, clear=clear) as file:
        file.write(data)


@contextlib.contextmanager
def replaced_file(
    path: Path, *, clear: bool = True, flush: bool = True, ending: str = ""
) -> Iterator[BinaryIO]:
    """A file that takes its name only once it is whole and on the disk; makes missing folders.
    clear: delete what killed writers of this file left. flush: make the name durable too. ending:
    of the temporary name, for libraries that go by it. Raises OutputError: the system refused (disk
    full, no permission ...); `path` is then as it was.
    """
    with refusals_of(path):
        make_folder(path.parent)
        if clear:
            remove_temporaries(path.parent, name=path.name, recursive=False)
        is_ours = False
        while not is_ours:
            temporary = path.with_name(temporary_beside(path).name + ending)
            file = temporary.open("xb")
            try:
                is_ours = _lock_new(temporary, file.fileno())
                if is_ours:
                    yield file
                    file.flush()
                    os.fsync(file.fileno())
                    os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
                file.close()
        if flush:
            flush_folder(path.parent)


# The error numbers of a file system that has no hard links.
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK}


def write_new(path: Path, data: bytes) -> None:
    """Write a file where nothing is, in one step; nothing is replaced, and no link is followed.

    Raises:
        FileExistsError: there is something at the path, be it a link to nothing.
        OutputError: the system refuses.
    """
    with refusals_of(path):
        make_folder(path.parent)
    temporary = temporary_beside(path)
    try:
        try:
            _create_new(temporary, data)
            os.link(temporary, path, follow_symlinks=False)  # where a rename would replace
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            _create_new(path, data)
        finally:
            temporary.unlink(missing_ok=True)
    except FileExistsError:
        raise
    except OSError as error:
        raise output_error(path, error) from error


def _create_new(path: Path, data: bytes) -> None:
    """Write a file that must be new; it goes again where it cannot be written whole."""
    with path.open("xb") as file:
        try:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            path.unlink(missing_ok=True)
            raise


def read_file(path: Path) -> bytes:
    """Return the bytes of a regular file. Raises OSError: there is none, or it is a folder, a pipe
    (which might be waited for without end) or a device.
    """
    with open_file(path) as file:
        return file.read()


def path_below(root: Path, parts: tuple[str, ...]) -> Path:
    """The path of these components, which no link leads out of the root."""
    path = root.joinpath(*parts)
    # Not Path.resolve, which raises RuntimeError where links lead round in circles.
    real, real_root = os.path.realpath(path), os.path.realpath(root)
    if not Path(real).is_relative_to(real_root):
        raise OutputError(
            f"{path} leads through a link to {real}, outside {real_root}; "
            f"put the files themselves under the output folder"
        )
    return path


def temporary_beside(path: Path) -> Path:
    """A new name in the folder of `path`."""
    return path.with_name(f".{_shown(path.name)}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")


def is_named(path: Path, descriptor: int) -> bool:
    """Whether the path is the name of this open file."""
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def make_folder(folder: Path) -> None:
    """Create the folder and its missing parents, each flushed into the one above it."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    flush_folder(folder.parent)


def flush_folder(folder: Path) -> None:
    """Make the names inside the folder durable; of a file, its bytes."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some network file systems cannot flush a folder
            raise
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path, *, name: str = "", recursive: bool = True) -> None:
    """Delete what killed processes left under temporary names; what a living one writes stays.
    name: of the file that they were to become; of any if empty.
    """
    for place, _, names in os.walk(folder):  # passes over folders that vanish meanwhile
        for found in temporary_names(names, name):
            path = Path(place, found)
            with refusals_of(path):
                _clear_abandoned(
                    path, os.O_NONBLOCK, lambda path=path: path.unlink(missing_ok=True)
                )
        if not recursive:
            return


def temporary_names(names: Iterable[str], name: str = "") -> list[str]:
    """Those of the names that `temporary_beside` has made, for the file `name` if it is given."""
    middle = rf"{re.escape(_shown(name))}\.[^.]+(\.old)?" if name else ".*"
    pattern = re.compile(rf"\.{middle}{re.escape(TEMPORARY_SUFFIX)}(\.[^.]+)?", re.DOTALL)
    return [found for found in names if pattern.fullmatch(found)]


@contextlib.contextmanager
def refusals_of(path: Path) -> Iterator[None]:
    """What the system refuses inside is raised as an OutputError that names the path."""
    try:
        yield
    except OSError as error:
        raise output_error(path, error) from error


def output_error(path: Path, error: OSError) -> OutputError:
    """An OutputError that names the file and says what to do."""
    hint = _HINTS.get(error.errno or 0, "check the disk, then run the same command again")
    return OutputError(f"cannot write {path}: {error.strerror}; {hint}")


def _shown(name: str) -> str:
    return os.fsdecode(os.fsencode(name)[:_MAX_SHOWN])


def _lock_new(temporary: Path, descriptor: int) -> bool:
    """Lock a file or folder that was just made; False where it is taken for left behind already."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return is_named(temporary, descriptor)


def _clear_abandoned(path: Path, flags: int, clear: Callable[[], object]) -> None:
    """Clear a temporary file or folder unless a living process writes it. It is locked meanwhile,
    for a process that has just made it to notice. flags: to open it with.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | flags)
    except (FileNotFoundError, PermissionError, NotADirectoryError):  # or of another user
        return
    except OSError as error:
        if error.errno != errno.ELOOP:  # a link, which is not written but made
            raise
        return path.unlink(missing_ok=True)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        is_written = False
    except BlockingIOError:
        is_written = True
    except OSError:  # a file system without locks
        is_written = time.time() - os.fstat(descriptor).st_mtime < _MAX_WRITING_S
    try:
        if not is_written:
            clear()
    finally:
        os.close(descriptor)


# ---- Lock files: whatever else has the name of one stays as it is --------------------------------
# A folder may come from somebody else, and a link in it lead anywhere. Nothing but a mark of who
# holds the lock is ever written into one, and only where nothing else is in it.

MAX_MARK_BYTES = 64
_MARK = re.compile(rb"\d{0,20}( \d{0,20})?\s*")  # as processes.process_mark, cut short by a kill
_POLL_S = 0.05
_SAY_AFTER_S = 2.0  # of waiting


def open_lock(path: Path) -> int:
    """Descriptor of a lock file, open for reading and writing; the file and its folder are made if
    missing. Raises OutputError: the name is that of a link, a pipe, a folder or a device, or the
    file holds something else than a lock's mark; nothing has been changed then.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with refusals_of(path):
        make_folder(path.parent)
        try:
            descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            if error.errno not in _KINDS:
                raise
            raise _no_lock(path, _KINDS[error.errno]) from error
        facts = os.fstat(descriptor)
        kind = "" if stat.S_ISREG(facts.st_mode) else "a pipe or device"
        if not kind and facts.st_size:
            data = os.pread(descriptor, MAX_MARK_BYTES, 0)
            is_ours = facts.st_size <= MAX_MARK_BYTES and _MARK.fullmatch(data)
            kind = "" if is_ours and facts.st_nlink <= 1 else "a file with other content"
        if kind:
            os.close(descriptor)
            raise _no_lock(path, kind)
    return descriptor


def wait_for_lock(path: Path, descriptor: int, *, patience_s: float, doing: str) -> None:
    """Lock the open file; says so once where that takes a while.

    Args:
        path: the file's name, for messages.
        patience_s: how long to wait at most, seconds.
        doing: what the holder does, after "another process".

    Raises:
        OutputError: another process has held it for that long.
    """
    started, is_said = time.monotonic(), False
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waited_s = time.monotonic() - started
        if waited_s > patience_s:
            raise OutputError(
                f"{path}: another process{lock_holder(descriptor)} has held this lock for "
                f"{patience_s:.0f} s ({doing}); end it, then run the same command again"
            )
        if waited_s > _SAY_AFTER_S and not is_said:
            is_said = True
            _log.info(
                "another process%s %s; waiting for it at most %.0f min (%s)",
                *(lock_holder(descriptor), doing, patience_s / 60, path),
            )
        time.sleep(_POLL_S)


def lock_holder(descriptor: int) -> str:
    """` (process 1234)`: who holds the kernel's lock of an open file; empty where the system does
    not tell, as of other machines.
    """
    inode = os.fstat(descriptor).st_ino
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()  # proc(5): 1: FLOCK ADVISORY WRITE 1234 08:01:5678 0 EOF
            is_held = words[1] == "FLOCK" and int(words[5].rpartition(":")[2]) == inode
            if is_held and int(words[4]) > 0:
                return f" (process {words[4]})"
    return ""


_KINDS = {
    errno.ELOOP: "a link",
    errno.EISDIR: "a folder",
    errno.ENXIO: "a device or socket",
    errno.ENODEV: "a device or socket",
}


def _no_lock(path: Path, kind: str) -> OutputError:
    return OutputError(
        f"{path} is {kind}, where a lock of climategs was expected: a small file that nothing else "
        f"is kept in. Nothing has been changed. See where it comes from, then delete it, or choose "
        f"another folder"
    )


# ---- Folders replaced as a whole: readers find the old one or the new one ------------------------
# The new folder is written beside the old under a temporary name, flushed to the disk, and changes
# places with it in one step. What else the old folder held moves over afterwards.

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h
_CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTTY, errno.EPERM)


@contextlib.contextmanager
def replaced_folder(target: Path, own: Collection[str]) -> Iterator[Path]:
    """A new, empty folder that takes the place of `target` when the block ends without an error.
    own: names of the files and folders that make up such a folder; anything else in the old folder
    is kept. Raises OutputError: the system refused; `target` is then as it was.
    """
    target = target.resolve()  # a link to a folder stays a link
    with refusals_of(target):
        make_folder(target.parent)
        new, descriptor = _locked_folder(target)
        try:
            yield new
            for path in [*new.rglob("*"), new]:
                flush_folder(path)
            _put_in_place(new, target)
            flush_folder(target.parent)
            for name in temporary_names(os.listdir(target.parent), target.name):
                old = target.with_name(name)
                _clear_abandoned(old, os.O_DIRECTORY, lambda old=old: _clear(old, target, own))
        finally:
            _clear(new, target, own)
            os.close(descriptor)


def _locked_folder(target: Path) -> tuple[Path, int]:
    while True:
        new = temporary_beside(target)
        new.mkdir()
        with contextlib.suppress(FileNotFoundError):  # taken for left behind
            descriptor = os.open(new, os.O_RDONLY)
            if _lock_new(new, descriptor):
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


def _clear(old: Path, target: Path, own: Collection[str]) -> None:
    """Delete a temporary folder. Entries that are not ours move to `target`; where they cannot,
    they and the folder stay, since nobody here may decide to delete them.
    """
    with contextlib.suppress(FileNotFoundError):  # somebody else who saves there clears it too
        for entry in list(old.iterdir()):
            if entry.name in own and entry.is_dir():
                shutil.rmtree(entry)
            elif entry.name in own:
                entry.unlink()
            elif target.is_dir() and not (target / entry.name).exists():
                os.rename(entry, target / entry.name)
        if not any(old.iterdir()):
            old.rmdir()


# ---- A file of the disk under another name -----------------------------------------------------

# Another disk, another user's file, too many links to it, a file system without hard links.
_CANNOT_LINK = {errno.EXDEV, errno.EPERM, errno.EMLINK}
_CANNOT_LINK |= {errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS}


def link_file(original: str, target: str) -> bool:
    """Give the original a second name; False where the system cannot, and nothing has changed."""
    try:
        try:
            os.link(original, target, follow_symlinks=False)
        except FileExistsError:
            temporary = temporary_beside(Path(target))
            os.link(original, temporary, follow_symlinks=False)
            move_temporary(temporary, target)
    except OSError as error:
        if error.errno in _CANNOT_LINK:
            return False
        raise output_error(Path(target), error) from error
    return True


def copy_file(original: str, target: str) -> None:
    """Copy bytes and time of change."""
    with replaced_file(Path(target), clear=False, flush=False) as file:
        shutil.copyfile(original, file.name)
        facts = os.stat(original)
        os.utime(file.fileno(), ns=(facts.st_mtime_ns, facts.st_mtime_ns))


def move_temporary(temporary: Path, target: str) -> None:
    try:
        os.replace(temporary, target)
    finally:
        # Renaming does nothing where both names are links of one file already.
        temporary.unlink(missing_ok=True)
