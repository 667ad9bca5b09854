"""An output folder as a store of whole files: a folder of this machine, or a place in the cloud.

Paths are relative to the folder, with forward slashes. A file is there whole or not at all.
"""

from __future__ import annotations

import contextlib
import os
import re
import urllib.parse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from augment.errors import OutputError
from augment.jobs.atomic import (
    TEMPORARY_SUFFIX,
    flush_folder,
    make_folder,
    output_error,
    write_atomic,
)
from augment.jobs.layout import path_below, relative_parts
from augment.jobs.mirror_files import copy_file, link_file

# ---- store ---------------------------------------------------------------------------------------

_UNSAFE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")  # control characters, bytes that are no text


class StoredFileMissing(OutputError):
    """A store has no file of this path."""


@dataclass(frozen=True)
class StoredFile:
    """Size in bytes, and time of the last change by the store's own clock, seconds since 1970."""

    size: int
    modified_s: float


@runtime_checkable
class Store(Protocol):
    """Files below one folder. All methods raise OutputError, and may be called by any thread.

    A store can be pickled and used after a fork: each process opens its own connections. (A child
    that os.fork made and that used S3 must end by os._exit, as those of multiprocessing do: at a
    normal exit, pyarrow waits for threads that did not follow it.)
    """

    @property
    def uri(self) -> str:
        """What open_store takes, without credentials; a local folder's absolute path."""
        ...

    @property
    def local_dir(self) -> Path | None:
        """The folder, where it is on this machine."""
        ...

    def read(self, path: str) -> bytes:
        """The file's bytes; StoredFileMissing where there is none."""
        ...

    def write(self, path: str, data: bytes) -> None:
        """Put the bytes there, durably, in one step that replaces what was there."""
        ...

    def put_file(self, path: str, source: Path) -> None:
        """As write, with the bytes of a local file; a local store may share its disk blocks."""
        ...

    def list(self, folder: str) -> dict[str, StoredFile]:
        """Every file beneath the folder ("" for all), by path relative to the root, sorted."""
        ...

    def exists(self, path: str) -> bool:
        """Whether there is a file of this path."""
        ...

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; those that are missing already are fine."""
        ...


def open_store(uri: str | Path) -> Store:
    """The store at a path, `file://`, `s3://bucket/path?region=...`, `gs://` or the like.

    Nothing is read or made yet: a folder appears with its first file, a bucket must exist.
    S3 takes `endpoint_override`, `scheme`, `region`, `force_virtual_addressing` and
    `tls_ca_file_path` in the URI, and credentials from the environment.

    Raises:
        OutputError: no such kind of store, or options that it does not know.
    """

    if isinstance(uri, Path) or "://" not in uri:
        return LocalStore(Path(uri).absolute())
    if uri.lower().startswith("file:"):
        parsed = urllib.parse.urlsplit(uri)
        if parsed.netloc not in ("", "localhost") or not parsed.path.startswith("/"):
            raise OutputError(f"{uri!r} must be file:///absolute/path")
        return LocalStore(Path(urllib.parse.unquote(parsed.path)))
    from augment.jobs.remote_store import RemoteStore

    return RemoteStore(uri)


def stored_path(path: str, uri: str) -> str:
    """The path with single slashes between its components.

    Raises:
        OutputError: it is absolute, empty, climbs with `..`, or holds control characters.
    """
    parts = relative_parts(path)
    if parts is None or _UNSAFE.search(path):
        raise OutputError(
            f"{uri}: {path!r} is no path of a file there; paths must be relative to it, with "
            f"forward slashes and without '..' or control characters. Where a manifest names "
            f"it, do not trust the folder"
        )
    return "/".join(parts)


# ---- An output folder on this machine, or on a file system that it has mounted -------------------

_MAX_RACES = 100  # times that others delete a folder in which a file is just being made


@dataclass(frozen=True)
class LocalStore:
    """Files below the folder `root`, an absolute path; see Store."""

    root: Path

    @property
    def uri(self) -> str:
        return str(self.root)

    @property
    def local_dir(self) -> Path:
        return self.root

    def read(self, path: str) -> bytes:
        file = self._file(path)
        try:
            return file.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            raise StoredFileMissing(f"{file} is missing") from None
        except OSError as error:
            raise _read_error(file, error) from error

    def write(self, path: str, data: bytes) -> None:
        file = self._file(path)
        _with_folder(lambda: write_atomic(file, data, clear=False))

    def put_file(self, path: str, source: Path) -> None:
        """A hard link where the system can, else a copy; either way flushed to the disk."""
        file = self._file(path)
        try:
            original = source.resolve(strict=True)
            descriptor = os.open(original, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise _read_error(source, error) from error
        _with_folder(lambda: _link_or_copy(original, file))

    def put_files(self, files: Mapping[str, Path]) -> None:
        """As put_file, for files that are durable already; each folder is flushed once, at the end.

        files: the local file by its path here.
        """
        placed = {self._file(path): source for path, source in files.items()}
        for file, source in placed.items():
            _with_folder(lambda file=file, source=source: _link_or_copy(source, file, flush=False))
        for folder in sorted({file.parent for file in placed}):
            try:
                flush_folder(folder)
            except OSError as error:
                raise output_error(folder, error) from error

    def list(self, folder: str) -> dict[str, StoredFile]:
        top = self.root if folder == "" else self._file(folder)
        found: dict[str, StoredFile] = {}
        try:
            _scan(top, "" if folder == "" else f"{stored_path(folder, self.uri)}/", found)
        except OSError as error:
            raise _read_error(top, error) from error
        return dict(sorted(found.items()))

    def exists(self, path: str) -> bool:
        file = self._file(path)
        try:
            return file.is_file()
        except OSError as error:
            raise _read_error(file, error) from error

    def delete(self, paths: Iterable[str]) -> None:
        """Folders that become empty go too, up to the root, which stays."""
        for path in paths:
            file = self._file(path)
            try:
                file.unlink(missing_ok=True)
            except NotADirectoryError:
                continue
            except OSError as error:
                raise OutputError(f"cannot delete {file}: {error.strerror}") from error
            for parent in file.parents:
                if parent == self.root:
                    break
                try:
                    parent.rmdir()
                except FileNotFoundError:
                    continue
                except OSError:  # not empty, or not ours to delete
                    break

    def _file(self, path: str) -> Path:
        return path_below(self.root, tuple(stored_path(path, self.uri).split("/")))


def _scan(folder: Path | str, prefix: str, found: dict[str, StoredFile]) -> None:
    try:
        entries = os.scandir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return
    with entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                _scan(entry.path, f"{prefix}{entry.name}/", found)
            elif entry.is_file() and not entry.name.endswith(TEMPORARY_SUFFIX):
                with contextlib.suppress(FileNotFoundError):  # deleted since
                    facts = entry.stat()
                    found[prefix + entry.name] = StoredFile(facts.st_size, facts.st_mtime)


def _with_folder(write: Callable[[], None]) -> None:
    """Write again where the file's folder, empty until then, was deleted by others meanwhile."""
    for attempt in range(_MAX_RACES):
        try:
            return write()
        except OutputError as error:
            if not isinstance(error.__cause__, FileNotFoundError) or attempt == _MAX_RACES - 1:
                raise


def _link_or_copy(original: Path, file: Path, *, flush: bool = True) -> None:
    try:
        make_folder(file.parent)
        if not link_file(str(original), str(file)):
            copy_file(str(original), str(file))
        if flush:
            flush_folder(file.parent)
    except OSError as error:
        raise output_error(file, error) from error


def _read_error(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"cannot read {path}: {error.strerror}; check that it is a file that this user may read"
    )
