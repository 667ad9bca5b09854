"""An output folder in the cloud, through pyarrow's file systems.

pyarrow's streams commit what they hold when an exception passes them, or when they are merely
dropped: an upload that stops half-way would replace an object by half of another one. So data is
complete before a stream is opened, the stream lives in one uninterruptible step, and the size of
what arrived is checked.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from random import SystemRandom
from typing import TYPE_CHECKING, TypeVar

from augment.batch.atomic import TEMPORARY_SUFFIX
from augment.batch.processes import uninterrupted
from augment.batch.remote_errors import advice, is_permanent
from augment.batch.remote_uri import RemoteUri
from augment.batch.store import StoredFile, StoredFileMissing, stored_path
from augment.errors import OutputError

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

_DELETES_AT_ONCE = 8
_of_parents: list[FileSystem | None] = []
_random = SystemRandom()  # the jitter of processes with one seed must differ
_T = TypeVar("_T")


@dataclass(frozen=True)
class Patience:
    """How failures that pass (timeouts, lost connections, 500, 503) are waited out.

    Before attempt n + 1 it waits a random time up to first_wait_s * 2^(n - 1), at most
    longest_wait_s. One request may stand still for timeout_s.
    """

    attempts: int = 6
    first_wait_s: float = 0.5
    longest_wait_s: float = 10.0
    timeout_s: float = 30.0


PATIENCE = Patience()


class RemoteStore:
    """Files below a place that a URI names; see Store.

    Raises:
        OutputError: no such kind of store, or options that it does not know.
    """

    local_dir = None

    def __init__(self, uri: str, patience: Patience | None = None) -> None:
        self._place = RemoteUri.parse(uri)
        self._patience = patience or PATIENCE
        self._reset()

    @property
    def uri(self) -> str:
        return self._place.public

    def __repr__(self) -> str:
        return f"RemoteStore({self.uri!r})"

    def __reduce__(self) -> tuple:
        return (_restored, (self._place, self._patience))

    def read(self, path: str) -> bytes:
        path = stored_path(path, self.uri)
        return self._persist("read", path, lambda system: _read(system, path))

    def write(self, path: str, data: bytes) -> None:
        path = stored_path(path, self.uri)
        put = _put if self._place.writes_whole else _put_and_move
        self._persist("write", path, lambda system: put(system, path, data))

    def put_file(self, path: str, source: Path) -> None:
        """The file is read into memory first: one that fails to be read must not be uploaded."""
        path = stored_path(path, self.uri)
        try:
            data = source.read_bytes()
        except OSError as error:
            raise OutputError(f"cannot read {source}: {error.strerror}") from error
        self.write(path, data)

    def list(self, folder: str) -> dict[str, StoredFile]:
        from pyarrow.fs import FileSelector, FileType

        path = "" if folder == "" else stored_path(folder, self.uri)
        selector = FileSelector(path, allow_not_found=True, recursive=True)
        infos = self._persist("list", path, lambda system: system.get_file_info(selector))
        found = {}
        for info in infos:
            name = info.path
            # Whoever else writes there: what cannot be a path of ours cannot be read either.
            with contextlib.suppress(OutputError):
                is_file = info.type == FileType.File and not name.endswith(TEMPORARY_SUFFIX)
                if is_file and stored_path(name, self.uri) == name:
                    modified = info.mtime.timestamp() if info.mtime is not None else 0.0
                    found[name] = StoredFile(info.size, modified)
        return dict(sorted(found.items()))

    def exists(self, path: str) -> bool:
        path = stored_path(path, self.uri)
        return self._persist("look up", path, lambda system: system.get_file_info(path).is_file)

    def delete(self, paths: Iterable[str]) -> None:
        """Object stores know no folders; but pyarrow leaves an empty marker of the folder."""
        names = [stored_path(path, self.uri) for path in paths]
        if len(names) < 2:
            for name in names:
                self._delete(name)
            return
        with ThreadPoolExecutor(min(len(names), _DELETES_AT_ONCE)) as pool:
            list(pool.map(self._delete, names))

    def _delete(self, path: str) -> None:
        def delete(system: FileSystem) -> None:
            with contextlib.suppress(FileNotFoundError):
                system.delete_file(path)

        self._persist("delete", path, delete)

    def _persist(self, operation: str, path: str, call: Callable[[FileSystem], _T]) -> _T:
        """What the call returns, tried again while it fails for reasons that pass."""
        patience = self._patience
        for attempt in itertools.count(1):
            try:
                return call(self._system())
            except FileNotFoundError as error:
                if operation == "read":
                    raise StoredFileMissing(f"{self._where(path)} is missing") from None
                failure = error
            except Exception as error:  # OSError of pyarrow, or whatever another library raises
                failure = error
            cause = self._place.without_secrets(" ".join(str(failure).split()))
            if is_permanent(failure) or attempt == patience.attempts:
                if isinstance(failure, _WrongSizeError):  # half a file is worse than none
                    with contextlib.suppress(Exception):
                        self._system().delete_file(path)
                times = "" if attempt == 1 else f" after {attempt} attempts"
                # Without its cause, whose text may hold credentials.
                raise OutputError(
                    f"cannot {operation} {self._where(path)}{times}: {cause}; "
                    f"{advice(failure, self._place.scheme)}"
                ) from None
            longest = min(patience.first_wait_s * 2 ** (attempt - 1), patience.longest_wait_s)
            time.sleep(_random.uniform(0, longest))
        raise AssertionError

    def _system(self) -> FileSystem:
        """This process's connections. Those of a parent process must not be used after a fork."""
        if self._process != os.getpid():
            # Closing them here would end the parent's: both share the sockets.
            _of_parents.append(self._opened)
            self._reset()
        with self._lock:
            if self._opened is None:
                self._opened = self._place.open(self._patience.timeout_s)
            return self._opened

    def _reset(self) -> None:
        self._lock = threading.Lock()  # a new one: a thread of the parent may hold the old one
        self._opened: FileSystem | None = None
        self._process = os.getpid()

    def _where(self, path: str) -> str:
        base, _, options = self.uri.partition("?")
        name = "/".join(filter(None, (base.rstrip("/"), path)))
        return f"{name} ({options})" if options else name


class _WrongSizeError(OSError):
    """What was stored is not what was sent."""


def _restored(place: RemoteUri, patience: Patience) -> RemoteStore:
    store = RemoteStore.__new__(RemoteStore)
    store._place, store._patience = place, patience
    store._reset()
    return store


def _read(system: FileSystem, path: str) -> bytes:
    with system.open_input_file(path) as file:
        size = file.size()
        data = file.read(size)
    if len(data) != size:
        raise OSError(f"{len(data)} bytes of {size} arrived")
    return data


def _put(system: FileSystem, path: str, data: bytes) -> None:
    def upload() -> None:
        with system.open_output_stream(path, compression=None) as stream:
            stream.write(data)

    uninterrupted(upload)
    _check_size(system, path, len(data))


def _put_and_move(system: FileSystem, path: str, data: bytes) -> None:
    folder, _, name = path.rpartition("/")
    hidden = f".{name}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}"
    temporary = f"{folder}/{hidden}" if folder else hidden
    if folder:
        system.create_dir(folder, recursive=True)
    try:
        _put(system, temporary, data)
        system.move(temporary, path)
    except BaseException:
        with contextlib.suppress(Exception):
            system.delete_file(temporary)
        raise
    _check_size(system, path, len(data))


def _check_size(system: FileSystem, path: str, expected: int) -> None:
    size = system.get_file_info(path).size
    if size != expected:
        raise _WrongSizeError(f"{size} bytes of {expected} arrived")
