"""Atomic files and folders: complete under their final name, or absent; and lock files.

In: a path and bytes, or a block that writes. Out: the file or folder. All code that writes files of
an output, of scenes or of caches calls it.

A file is written under a temporary name in its own folder, flushed to the disk, and renamed. Then
the folder is flushed, so that the name survives a power cut too.

Temporary names are random, because in containers every run has the same process numbers. The writer
of a temporary file holds the kernel's lock of it (flock), which ends with the process, however the
process ends. So a later process can tell the files of a dead writer from those of a living one.
This holds across machines too, where the file system shares its locks.
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

# End of all temporary names.
TEMPORARY_SUFFIX = ".climategs-tmp"
# Most bytes of the final name in the temporary one, which may have 255.
_MAX_NAME_BYTES = 200
# Age from which a temporary file counts as left behind where the file system has no locks, seconds.
_MAX_WRITING_S = 86400.0

_NOT_WRITABLE = (
    "the folder is not writable for this user: change its permissions or choose another output "
    "folder"
)
# Advice by the system's error number.
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
    """Put `data` at `path`, replacing an earlier file in one step; see write_file_atomically."""
    with write_file_atomically(path, clear=clear) as file:
        file.write(data)


@contextlib.contextmanager
def write_file_atomically(
    path: Path, *, clear: bool = True, flush: bool = True, ending: str = ""
) -> Iterator[BinaryIO]:
    """Context manager of a new file that takes its name once it is complete and on the disk.

    Missing folders are made.

    Args:
        clear: If True, delete temporary files that killed writers of this file left.
        flush: If True, make the name durable too.
        ending: End of the temporary name, for libraries that choose a format by it.

    Raises:
        OutputError: The system refuses (disk full, no permission ...); `path` is then as it was.
    """
    with raise_output_error(path):
        make_folder(path.parent)
        if clear:
            remove_temporaries(path.parent, name=path.name, recursive=False)
        is_ours = False
        while not is_ours:
            temporary = path.with_name(temporary_path(path).name + ending)
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


# Error numbers of a file system without hard links.
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK}


def write_new_file(path: Path, data: bytes) -> None:
    """Write a file at an unused path in one step; replaces nothing, and follows no link.

    Raises:
        FileExistsError: The path is in use, possibly by a link to nothing.
        OutputError: The system refuses.
    """
    with raise_output_error(path):
        make_folder(path.parent)
    temporary = temporary_path(path)
    try:
        try:
            _create_new(temporary, data)
            os.link(temporary, path, follow_symlinks=False)  # a rename would replace a file
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            _create_new(path, data)
        finally:
            temporary.unlink(missing_ok=True)
    except FileExistsError:
        raise
    except OSError as error:
        raise make_output_error(path, error) from error


def _create_new(path: Path, data: bytes) -> None:
    """Write a file that must be new; it is deleted where it cannot be written completely."""
    with path.open("xb") as file:
        try:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            path.unlink(missing_ok=True)
            raise


def read_file(path: Path) -> bytes:
    """Return the bytes of a regular file.

    Raises:
        OSError: The file does not exist, or is a folder, a device, or a pipe, whose reader could
            wait without end.
    """
    with open_file(path) as file:
        return file.read()


def path_below(root: Path, parts: tuple[str, ...]) -> Path:
    """Return the path of these components below the root.

    Raises:
        OutputError: A link leads out of the root.
    """
    path = root.joinpath(*parts)
    # Path.resolve would raise RuntimeError where links form a circle.
    real_path = os.path.realpath(path)
    real_root = os.path.realpath(root)
    if not Path(real_path).is_relative_to(real_root):
        raise OutputError(
            f"{path} leads through a link to {real_path}, outside {real_root}; "
            f"put the files themselves under the output folder"
        )
    return path


def temporary_path(path: Path) -> Path:
    """Return a new temporary name in the folder of `path`."""
    return path.with_name(f".{_shorten_name(path.name)}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")


def is_named(path: Path, descriptor: int) -> bool:
    """Return True if the path is the name of this open file."""
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
    """Make the names inside the folder durable; for a file, make its bytes durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some network file systems cannot flush a folder
            raise
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path, *, name: str = "", recursive: bool = True) -> None:
    """Delete temporary files of killed processes; files that a living process writes stay.

    Args:
        name: Name of the file that they were to become; of any file if empty.
    """
    for folder_path, _, names in os.walk(folder):  # skips folders that vanish meanwhile
        for temporary_name in temporary_names(names, name):
            path = Path(folder_path, temporary_name)
            with raise_output_error(path):
                _clear_abandoned(
                    path, os.O_NONBLOCK, lambda path=path: path.unlink(missing_ok=True)
                )
        if not recursive:
            return


def remove_tree(folder: Path) -> None:
    """Delete a folder with everything in it, if it exists."""
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"cannot delete {folder}: {error.strerror}") from error


def temporary_names(names: Iterable[str], name: str = "") -> list[str]:
    """Return the names that `temporary_path` has made, for the file `name` if it is given."""
    middle = rf"{re.escape(_shorten_name(name))}\.[^.]+(\.old)?" if name else ".*"
    pattern = re.compile(rf"\.{middle}{re.escape(TEMPORARY_SUFFIX)}(\.[^.]+)?", re.DOTALL)
    return [other_name for other_name in names if pattern.fullmatch(other_name)]


@contextlib.contextmanager
def raise_output_error(path: Path) -> Iterator[None]:
    """Context manager that turns refusals of the system into an OutputError that names the path."""
    try:
        yield
    except OSError as error:
        raise make_output_error(path, error) from error


def make_output_error(path: Path, error: OSError) -> OutputError:
    """Return an OutputError that names the file and says what to do."""
    hint = _HINTS.get(error.errno or 0, "check the disk, then run the same command again")
    return OutputError(f"cannot write {path}: {error.strerror}; {hint}")


def _shorten_name(name: str) -> str:
    """Return the part of a file's name that its temporary name repeats."""
    return os.fsdecode(os.fsencode(name)[:_MAX_NAME_BYTES])


def _lock_new(temporary: Path, descriptor: int) -> bool:
    """Lock a new file or folder; False where another process took it for left behind already."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return is_named(temporary, descriptor)


def _clear_abandoned(path: Path, flags: int, clear: Callable[[], object]) -> None:
    """Clear a temporary file or folder unless a living process writes it.

    It is locked meanwhile, so that a process that has just made it notices.

    Args:
        flags: Flags to open it with.
        clear: Deletes it.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | flags)
    except (FileNotFoundError, PermissionError, NotADirectoryError):  # gone, or of another user
        return
    except OSError as error:
        if error.errno != errno.ELOOP:  # anything but a link, which has no writer
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


# ---- Lock files: any other file with such a name stays as it is ----------------------------------
# A folder may come from another person, and a link in it may lead anywhere. Nothing but a mark of
# the lock's holder is ever written into a lock file, and only where the file holds nothing else.

# Longest mark of a lock's holder, bytes.
MAX_MARK_BYTES = 64
# Mark as processes.process_mark makes it, possibly cut short by a kill.
_MARK = re.compile(rb"\d{0,20}( \d{0,20})?\s*")
# Time between two tries to lock, seconds.
_POLL_S = 0.05
# Wait after which a message says so, seconds.
_LOG_AFTER_S = 2.0


def open_lock(path: Path) -> int:
    """Open a lock file for reading and writing, and return its descriptor.

    The file and its folder are made if missing.

    Raises:
        OutputError: The name belongs to a link, a pipe, a folder or a device, or the file holds
            something else than a lock's mark; nothing has been changed then.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with raise_output_error(path):
        make_folder(path.parent)
        try:
            descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            if error.errno not in _KINDS:
                raise
            raise _not_a_lock_error(path, _KINDS[error.errno]) from error
        facts = os.fstat(descriptor)
        kind = "" if stat.S_ISREG(facts.st_mode) else "a pipe or device"
        if not kind and facts.st_size:
            data = os.pread(descriptor, MAX_MARK_BYTES, 0)
            is_ours = facts.st_size <= MAX_MARK_BYTES and _MARK.fullmatch(data)
            kind = "" if is_ours and facts.st_nlink <= 1 else "a file with other content"
        if kind:
            os.close(descriptor)
            raise _not_a_lock_error(path, kind)
    return descriptor


def wait_for_lock(path: Path, descriptor: int, *, patience_s: float, activity: str) -> None:
    """Lock the open file; logs a message once where the wait takes a while.

    Args:
        path: Name of the file, for messages.
        patience_s: Longest wait, seconds.
        activity: What the holder does, after "another process".

    Raises:
        OutputError: Another process has held the lock for that long.
    """
    start_s = time.monotonic()
    is_logged = False
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waited_s = time.monotonic() - start_s
        if waited_s > patience_s:
            raise OutputError(
                f"{path}: another process{lock_holder(descriptor)} has held this lock for "
                f"{patience_s:.0f} s ({activity}); end it, then run the same command again"
            )
        if waited_s > _LOG_AFTER_S and not is_logged:
            is_logged = True
            _log.info(
                "another process%s %s; waiting for it at most %.0f min (%s)",
                lock_holder(descriptor),
                activity,
                patience_s / 60,
                path,
            )
        time.sleep(_POLL_S)


def lock_holder(descriptor: int) -> str:
    """Return the holder of the kernel's lock of an open file, as ` (process 1234)`.

    Empty where the system does not tell, as for processes of other machines.
    """
    inode = os.fstat(descriptor).st_ino
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()  # proc(5): 1: FLOCK ADVISORY WRITE 1234 08:01:5678 0 EOF
            is_held = words[1] == "FLOCK" and int(words[5].rpartition(":")[2]) == inode
            if is_held and int(words[4]) > 0:
                return f" (process {words[4]})"
    return ""


# Kinds of things that are no lock file, by the error number of opening one.
_KINDS = {
    errno.ELOOP: "a link",
    errno.EISDIR: "a folder",
    errno.ENXIO: "a device or socket",
    errno.ENODEV: "a device or socket",
}


def _not_a_lock_error(path: Path, kind: str) -> OutputError:
    """Return the error of a path that is not a lock file."""
    return OutputError(
        f"{path} is {kind}, where a lock of climategs was expected: a small file that nothing else "
        f"is kept in. Nothing has been changed. See where it comes from, then delete it, or choose "
        f"another folder"
    )


# ---- Folders replaced in one step: readers find the old one or the new one -----------------------
# The new folder is written beside the old one under a temporary name, flushed to the disk, and
# exchanged with it in one step. Foreign files of the old folder move over afterwards.

# Descriptor that stands for the current folder (linux/fcntl.h).
_AT_FDCWD = -100
# Flag of renameat2 that swaps two names (linux/fs.h).
_RENAME_EXCHANGE = 2
# Error numbers of systems and file systems that cannot swap names.
_CANNOT_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTTY, errno.EPERM)


@contextlib.contextmanager
def write_folder_atomically(target: Path, own_names: Collection[str]) -> Iterator[Path]:
    """Context manager of a new folder that replaces `target` when the block ends without error.

    Args:
        own_names: Names of the files and folders that make up such a folder; anything else in the
            old folder is kept.

    Raises:
        OutputError: The system refuses; `target` is then as it was.
    """
    target = target.resolve()  # a link to a folder stays a link
    with raise_output_error(target):
        make_folder(target.parent)
        new_folder, descriptor = _locked_folder(target)
        try:
            yield new_folder
            for path in [*new_folder.rglob("*"), new_folder]:
                flush_folder(path)
            _put_in_place(new_folder, target)
            flush_folder(target.parent)
            for name in temporary_names(os.listdir(target.parent), target.name):
                old_folder = target.with_name(name)
                _clear_abandoned(
                    old_folder,
                    os.O_DIRECTORY,
                    lambda old_folder=old_folder: _clear(old_folder, target, own_names),
                )
        finally:
            _clear(new_folder, target, own_names)
            os.close(descriptor)


def _locked_folder(target: Path) -> tuple[Path, int]:
    """Make a new folder beside the target; return it and the descriptor that holds its lock."""
    while True:
        new_folder = temporary_path(target)
        new_folder.mkdir()
        with contextlib.suppress(FileNotFoundError):  # another process took it for left behind
            descriptor = os.open(new_folder, os.O_RDONLY)
            if _lock_new(new_folder, descriptor):
                return new_folder, descriptor
            os.close(descriptor)


def _put_in_place(new_folder: Path, target: Path) -> None:
    """Give the new folder the target's name, and the old folder the new one's."""
    if not target.exists() or not any(target.iterdir()):
        os.rename(new_folder, target)  # also over an empty folder
        return
    if _exchange(new_folder, target):
        return
    # The file system cannot exchange names: for an instant the old folder has only a temporary
    # name.
    old_folder = new_folder.with_name(
        new_folder.name.removesuffix(TEMPORARY_SUFFIX) + ".old" + TEMPORARY_SUFFIX
    )
    os.rename(target, old_folder)
    try:
        os.rename(new_folder, target)
    except BaseException:
        os.rename(old_folder, target)
        raise
    os.rename(old_folder, new_folder)


def _exchange(path: Path, other_path: Path) -> bool:
    """Swap two names in one step (renameat2); False where the system or file system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    paths = os.fsencode(path), os.fsencode(other_path)
    if rename(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _CANNOT_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(other_path))


def _clear(old_folder: Path, target: Path, own_names: Collection[str]) -> None:
    """Delete a temporary folder.

    Foreign entries move to `target`. Where they cannot move, they and the folder stay, since this
    code must not decide to delete them.
    """
    # Another process that saves there may clear the folder too.
    with contextlib.suppress(FileNotFoundError):
        for entry in list(old_folder.iterdir()):
            if entry.name in own_names and entry.is_dir():
                shutil.rmtree(entry)
            elif entry.name in own_names:
                entry.unlink()
            elif target.is_dir() and not (target / entry.name).exists():
                os.rename(entry, target / entry.name)
        if not any(old_folder.iterdir()):
            old_folder.rmdir()


# ---- Links and copies of files -------------------------------------------------------------------

# Error numbers for another disk, another user's file, too many links, or no hard links at all.
_CANNOT_LINK = {errno.EXDEV, errno.EPERM, errno.EMLINK}
_CANNOT_LINK |= {errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS}


def link_file(original: str, target: str) -> bool:
    """Give the original a second name; False where the system cannot, and nothing has changed."""
    try:
        try:
            os.link(original, target, follow_symlinks=False)
        except FileExistsError:
            temporary = temporary_path(Path(target))
            os.link(original, temporary, follow_symlinks=False)
            move_temporary(temporary, target)
    except OSError as error:
        if error.errno in _CANNOT_LINK:
            return False
        raise make_output_error(Path(target), error) from error
    return True


def copy_file(original: str, target: str) -> None:
    """Copy a file's bytes and its time of change."""
    with write_file_atomically(Path(target), clear=False, flush=False) as file:
        shutil.copyfile(original, file.name)
        facts = os.stat(original)
        os.utime(file.fileno(), ns=(facts.st_mtime_ns, facts.st_mtime_ns))


def move_temporary(temporary: Path, target: str) -> None:
    """Give a temporary file its final name."""
    try:
        os.replace(temporary, target)
    finally:
        # Renaming does nothing where both names are links of one file already.
        temporary.unlink(missing_ok=True)
