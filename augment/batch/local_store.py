"""An output folder on this machine, or on a file system that it has mounted."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from augment.batch.atomic import (
    TEMPORARY_SUFFIX,
    flush_folder,
    make_folder,
    output_error,
    write_atomic,
)
from augment.batch.layout import path_below
from augment.batch.mirror_files import copy_file, link_file
from augment.batch.store import StoredFile, StoredFileMissing, stored_path
from augment.errors import OutputError

_MOST_RACES = 100  # times that others delete a folder in which a file is just being made


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
    for attempt in range(_MOST_RACES):
        try:
            return write()
        except OutputError as error:
            if not isinstance(error.__cause__, FileNotFoundError) or attempt == _MOST_RACES - 1:
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
