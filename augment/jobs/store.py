"""An output folder as a store of whole files: a folder of this machine, or a place in the cloud.

Paths are relative to the folder, with forward slashes. A file is there whole or not at all.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import secrets
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from random import SystemRandom
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

from augment.errors import OutputError
from augment.jobs.atomic import (
    TEMPORARY_SUFFIX,
    copy_file,
    flush_folder,
    link_file,
    make_folder,
    refusals_of,
    write_atomic,
)
from augment.jobs.layout import path_below, relative_parts
from augment.jobs.processes import uninterrupted

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

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
    """Files below one folder. All methods raise OutputError, and may be called by any thread. A
    store can be pickled and used after a fork: each process opens its own connections. A child of
    os.fork that used S3 must end by os._exit: at a normal exit, pyarrow waits for threads it lacks.
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
    """The store at a path, `file://`, `s3://bucket/path?region=...`, `gs://` or the like. A folder
    appears with its first file, a bucket must exist. S3 takes the options _S3_OPTIONS in the URI,
    and credentials from the environment. Raises OutputError: no such kind of store, or options that
    it does not know.
    """

    if isinstance(uri, Path) or "://" not in uri:
        return LocalStore(Path(uri).absolute())
    if uri.lower().startswith("file:"):
        parsed = urllib.parse.urlsplit(uri)
        if parsed.netloc not in ("", "localhost") or not parsed.path.startswith("/"):
            raise OutputError(f"{uri!r} must be file:///absolute/path")
        return LocalStore(Path(urllib.parse.unquote(parsed.path)))

    return RemoteStore(uri)


def stored_path(path: str, uri: str) -> str:
    """The path with single slashes between its components."""
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
            with _reading(file):
                return file.read_bytes()
        except OutputError as error:
            if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
                raise StoredFileMissing(f"{file} is missing") from None
            raise

    def write(self, path: str, data: bytes) -> None:
        file = self._file(path)
        _with_folder(lambda: write_atomic(file, data, clear=False))

    def put_file(self, path: str, source: Path) -> None:
        """A hard link where the system can, else a copy; either way flushed to the disk."""
        file = self._file(path)
        with _reading(source):
            original = source.resolve(strict=True)
            descriptor = os.open(original, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        _with_folder(lambda: _link_or_copy(original, file))

    def put_files(self, files: Mapping[str, Path]) -> None:
        """As put_file, for files that are durable already; each folder is flushed once, at the end.
        files: the local file by its path here.
        """
        placed = {self._file(path): source for path, source in files.items()}
        for file, source in placed.items():
            _with_folder(lambda file=file, source=source: _link_or_copy(source, file, flush=False))
        for folder in sorted({file.parent for file in placed}):
            with refusals_of(folder):
                flush_folder(folder)

    def list(self, folder: str) -> dict[str, StoredFile]:
        top = self.root if folder == "" else self._file(folder)
        found: dict[str, StoredFile] = {}
        with _reading(top):
            _scan(top, "" if folder == "" else f"{stored_path(folder, self.uri)}/", found)
        return dict(sorted(found.items()))

    def exists(self, path: str) -> bool:
        file = self._file(path)
        with _reading(file):
            return file.is_file()

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
    with refusals_of(file):
        make_folder(file.parent)
        if not link_file(str(original), str(file)):
            copy_file(str(original), str(file))
        if flush:
            flush_folder(file.parent)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot read {path}: {error.strerror}; check that it is a file that this user may read"
        ) from error


# ---- An output folder in the cloud, through pyarrow's file systems -------------------------------
# pyarrow's streams commit what they hold when an exception passes them, or when they are merely
# dropped: an upload that stops half-way would replace an object by half of another one. So data is
# complete before a stream is opened, the stream lives in one uninterruptible step, and the size of
# what arrived is checked.

# An object of these appears once its upload is complete; elsewhere a file grows under its name.
_OBJECT_STORES = ("s3", "gs", "gcs")
_KINDS = (*_OBJECT_STORES, "abfs", "abfss", "hdfs", "viewfs")
_S3_OPTIONS = ("endpoint_override", "scheme", "region",
               "force_virtual_addressing", "tls_ca_file_path")  # fmt: skip
_SECRET_OPTION = re.compile(r"key|secret|token|password|credential|signature|^sig$", re.IGNORECASE)
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_CONNECT_TIMEOUT_S = 10


@dataclass(frozen=True)
class RemoteUri:
    """A URI in parts; `public` is the same without its secrets, which repr leaves out."""

    public: str
    scheme: str
    _uri: str = field(repr=False)
    _secrets: tuple[str, ...] = field(repr=False)

    @classmethod
    def parse(cls, uri: str) -> RemoteUri:
        """Take a URI apart."""
        try:
            parsed = urllib.parse.urlsplit(uri)
            query = urllib.parse.parse_qsl(parsed.query, strict_parsing=bool(parsed.query))
        except ValueError as error:
            raise OutputError(f"{uri.partition(':')[0]}://... is no URI: {error}") from None
        user, _, host = parsed.netloc.rpartition("@")
        if parsed.scheme in ("abfs", "abfss") or user == "anonymous":  # a container, nobody
            user, host = "", parsed.netloc
        shown = [(name, value) for name, value in query if not _SECRET_OPTION.search(name)]
        hidden = [value for name, value in query if _SECRET_OPTION.search(name)]
        path, options = parsed.path.rstrip("/"), urllib.parse.urlencode(shown)
        public = urllib.parse.urlunsplit((parsed.scheme, host, path, options, ""))
        _check_kind(parsed.scheme, host, public)
        _check_folder(path, parsed.fragment, public)
        if parsed.scheme == "s3":
            _check_s3_options([name for name, _ in query], public)
        secrets = {*user.split(":"), *map(urllib.parse.unquote, user.split(":")), *hidden}
        return cls(public, parsed.scheme, uri, tuple(sorted(secrets - {""}, key=len, reverse=True)))

    @property
    def writes_whole(self) -> bool:
        """Whether a file appears under its name only when it is complete."""
        return self.scheme in _OBJECT_STORES

    def without_secrets(self, text: str) -> str:
        """The text with user names, passwords and keys of this URI blotted out."""
        for secret in self._secrets:
            text = text.replace(secret, "***")
        return text

    def open(self, timeout_s: float) -> FileSystem:
        """A new file system whose root is the URI's folder; it does not try again by itself. Raises
        OSError: there is no such bucket, no answer ...; others of pyarrow.
        """
        from pyarrow.fs import FileSystem, FileType, SubTreeFileSystem

        if self.scheme == "s3":
            system, root = self._open_s3(timeout_s)
        else:
            system, root = FileSystem.from_uri(self._with_limits(timeout_s))
        bucket = root.split("/")[0]
        if self.writes_whole and system.get_file_info(bucket).type == FileType.NotFound:
            raise OSError(f"there is no bucket {bucket!r}")
        return SubTreeFileSystem(root, system)

    def _with_limits(self, timeout_s: float) -> str:
        """Google's library would try for a quarter of an hour."""
        if self.scheme not in ("gs", "gcs") or "retry_limit_seconds=" in self._uri:
            return self._uri
        mark = "&" if "?" in self._uri else "?"
        return f"{self._uri}{mark}retry_limit_seconds={timeout_s:g}"

    def _open_s3(self, timeout_s: float) -> tuple[FileSystem, str]:
        from pyarrow.fs import AwsStandardS3RetryStrategy, S3FileSystem

        parsed = urllib.parse.urlsplit(self._uri)
        options: dict[str, Any] = dict(urllib.parse.parse_qsl(parsed.query))
        virtual = options.pop("force_virtual_addressing", "false").lower() in ("true", "1")
        user, _, bucket = parsed.netloc.rpartition("@")
        if user:
            name, _, password = user.partition(":")
            options["access_key"] = urllib.parse.unquote(name)
            options["secret_key"] = urllib.parse.unquote(password)
        system = S3FileSystem(
            **options,
            force_virtual_addressing=virtual,
            request_timeout=timeout_s,
            connect_timeout=min(timeout_s, _CONNECT_TIMEOUT_S),
            retry_strategy=AwsStandardS3RetryStrategy(max_attempts=1),
            # A small object takes one request instead of three.
            allow_delayed_open=True,
            # Without it, closing after a part has failed completes an upload that lacks the part.
            background_writes=True,
        )
        return system, (bucket + urllib.parse.unquote(parsed.path)).rstrip("/")


def _check_kind(scheme: str, host: str, public: str) -> None:
    if scheme not in _KINDS and not scheme.startswith("fsspec+"):
        raise OutputError(
            f"{public}: there are no stores of the kind {scheme!r}; use a path of this machine, "
            f"or one of {', '.join(_KINDS)}"
        )
    if scheme in _OBJECT_STORES and not host:
        raise OutputError(f"{public} names no bucket; expected {scheme}://bucket/folder")


def _check_folder(path: str, fragment: str, public: str) -> None:
    folder = urllib.parse.unquote(path).removeprefix("/")
    is_clean = "/".join(relative_parts(folder) or ()) == folder and not _CONTROL.search(folder)
    if fragment or not is_clean:
        raise OutputError(
            f"{public}: the folder must be named without '.', '..', '#', backslashes and double "
            f"slashes; write a sign that has a meaning in URIs as %23 and so on"
        )


def _check_s3_options(names: list[str], public: str) -> None:
    for name in names:
        if name not in _S3_OPTIONS:
            raise OutputError(
                f"{public}: S3 has no option {name!r} here; the options are "
                f"{', '.join(_S3_OPTIONS)}. Credentials come from the environment "
                f"(AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY) or ~/.aws"
            )


# ---- What pyarrow's failures of remote file systems mean: whether they pass, and what to do ------
# pyarrow says it in words only: `AWS Error ACCESS_DENIED during PutObject operation: ...`.

_DENIED = re.compile(
    r"ACCESS_DENIED|INVALID_ACCESS_KEY|SIGNATURE_DOES_NOT_MATCH|INVALID_CLIENT_TOKEN|EXPIRED_TOKEN"
    r"|ExpiredToken|UNRECOGNIZED_CLIENT|INVALID_SIGNATURE|MISSING_AUTHENTICATION_TOKEN"
    r"|NOT_INITIALIZED|REQUEST_TIME_TOO_SKEWED|PERMISSION_DENIED|UNAUTHENTICATED|credentials"
    r"|AuthorizationHeaderMalformed|HTTP status 40[13]"
)
_NOWHERE = re.compile(
    r"NO_SUCH_BUCKET|no bucket|RESOURCE_NOT_FOUND|NOT_FOUND|PermanentRedirect|HTTP status 30\d"
)
_REFUSED = re.compile(r"HTTP status 4(?!08|29)\d\d|EntityTooLarge|INVALID_PARAMETER|MALFORMED")

_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (or AWS_PROFILE), the region",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS",
    "gcs": "GOOGLE_APPLICATION_CREDENTIALS",
}
_ENDPOINT = {"s3": ", the region, and the endpoint (endpoint_override or AWS_ENDPOINT_URL)"}


def is_permanent(failure: Exception) -> bool:
    """Whether trying again is of no use."""
    if isinstance(failure, FileNotFoundError | PermissionError | IsADirectoryError):
        return True
    if not isinstance(failure, OSError):  # arguments that pyarrow refuses, what it cannot do ...
        return True
    text = str(failure)
    return any(pattern.search(text) for pattern in (_DENIED, _NOWHERE, _REFUSED))


def advice(failure: Exception, scheme: str) -> str:
    """What to do about it."""
    text = str(failure)
    if isinstance(failure, PermissionError) or _DENIED.search(text):
        named = _CREDENTIALS.get(scheme, "the credentials")
        return f"check {named}, and that they may read, write, list and delete there"
    if isinstance(failure, FileNotFoundError) or _NOWHERE.search(text):
        return f"check the bucket's name, that it exists{_ENDPOINT.get(scheme, '')}"
    if is_permanent(failure):
        return "the store refuses this for good: check its address and options"
    return (
        f"check the network{_ENDPOINT.get(scheme, '')}, then run the same command again: "
        f"every file there is whole"
    )


_DELETES_AT_ONCE = 8
_of_parents: list[FileSystem | None] = []
_random = SystemRandom()  # the jitter of processes with one seed must differ
_T = TypeVar("_T")


@dataclass(frozen=True)
class Patience:
    """How failures that pass (timeouts, lost connections, 500, 503) are waited out. Before attempt
    n + 1 it waits a random time up to first_wait_s * 2^(n - 1), at most longest_wait_s. One request
    may stand still for timeout_s.
    """

    attempts: int = 6
    first_wait_s: float = 0.5
    longest_wait_s: float = 10.0
    timeout_s: float = 30.0


PATIENCE = Patience()


class RemoteStore:
    """Files below a place that a URI names; see Store."""

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
        stored_path(path, self.uri)
        with _reading(source):
            data = source.read_bytes()
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
        if len(names) < 2:  # at the end of a process no thread can be started
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
